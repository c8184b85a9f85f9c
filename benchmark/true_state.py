"""How far would a perfect belief get? PPO as in ppo_baseline.py, on joints and the true privileged state, no pictures.

Tells a belief that fails from a budget that is too small, at several times the speed. In place of the state the policy
sees u with --phi, what a belief is trained to know, or with --target the target position of a Remember task.

Usage:   python benchmark/true_state.py --env-id RememberColor5-v0 --small
         python benchmark/true_state.py --env-id RememberColor5-v0 --small --phi 'runs/{env_id}__aib_repr_small__{seed}'
         python benchmark/true_state.py --env-id RememberColor5-v0 --small --target
Takes:   the arguments of ppo_baseline.py; always simulates on the CPU
Writes:  runs/{env_id}__true_state__{seed}/ (true_u, true_target; or …_small), as ppo_baseline.py does; empty videos
"""

import math
import os
import sys
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import gymnasium as gym
import numpy as np
import torch
import torch.nn as nn
from torch.distributions import Normal

sys.path.insert(0, str(Path(__file__).parent.parent))
import ppo_baseline  # noqa: E402
from aib_belief import StateEncoder  # noqa: E402
from ppo_baseline import orthogonal_init  # noqa: E402


@dataclass
class Args(ppo_baseline.Args):
    phi: str | None = None
    """run directory of stage 1, whose state encoder turns the state into u; None: the state itself"""
    target: bool = False
    """the target position in place of the state; only in Remember tasks, whose state is the cue and object positions"""


class ShowState(gym.Wrapper):
    """Joints (25 + D,) float32 with the privileged state at their end; rgb is one black pixel, nothing is drawn."""

    def __init__(self, env: gym.Env, target: bool = False):
        super().__init__(env)
        self.target = target
        black = {"base_camera": {"rgb": torch.zeros(1, 1, 1, 3, dtype=torch.uint8)}}
        env.unwrapped._get_obs_sensor_data = lambda: black
        size = self.reset()[0]["joints"].shape
        spaces = {"rgb": gym.spaces.Box(0, 255, (1, 1, 3), np.uint8), "joints": gym.spaces.Box(-np.inf, np.inf, size)}
        self.observation_space = gym.spaces.Dict(spaces)

    def _show(self, obs: dict, info: dict) -> dict:
        shown = info["state"]
        if self.target:  # the state holds a position per object, zeros but for the target's
            shown = shown[len(info["cue"]) :].reshape(-1, 3).sum(0)
        return {**obs, "joints": np.append(obs["joints"], shown)}

    def reset(self, **kwargs: object) -> tuple:
        obs, info = self.env.reset(**kwargs)
        return self._show(obs, info), info

    def step(self, action: np.ndarray) -> tuple:
        obs, reward, terminated, truncated, info = self.env.step(action)
        return self._show(obs, info), reward, terminated, truncated, info


class StateAgent(nn.Module):
    """Actor and critic on joints and state, or u in its place, in the sizes of ppo_baseline.Agent."""

    def __init__(self, envs: gym.vector.VectorEnv, args: ppo_baseline.Args, phi: StateEncoder | None = None):
        super().__init__()
        (joints_dim,), (action_dim,) = envs.single_observation_space["joints"].shape, envs.single_action_space.shape
        self.phi = phi
        input_dim = 25 + phi(phi.mean).mean.numel() if phi else joints_dim
        self.joints_norm = nn.BatchNorm1d(joints_dim, affine=False, momentum=None).eval()
        self.joints = orthogonal_init(nn.Sequential(nn.Linear(input_dim, 256 + 128), nn.ReLU()))
        self.actor = orthogonal_init(nn.Sequential(nn.Linear(256 + 128, 512), nn.ReLU(), nn.Linear(512, action_dim)))
        self.critic = orthogonal_init(nn.Sequential(nn.Linear(256 + 128, 512), nn.ReLU(), nn.Linear(512, 1)))
        orthogonal_init(self.actor[-1], 0.01 * 2**0.5)
        self.log_std = nn.Parameter(torch.full((action_dim,), math.log(args.init_std)))

    def forward(self, obs: dict[str, torch.Tensor]) -> tuple[Normal, torch.Tensor]:
        """Policy over actions (B, A) and value (B,) of joints (B, 25 + D)."""
        x = self.joints_norm(obs["joints"])
        if self.phi:
            x = torch.cat([x[:, :25], self.phi(obs["joints"][:, 25:]).mean], -1)
        x = self.joints(x)
        mean = torch.tanh(self.actor(x))
        return Normal(mean, self.log_std.exp().expand_as(mean), validate_args=False), self.critic(x).squeeze(-1)


def make_envs(args: ppo_baseline.Args) -> gym.vector.VectorEnv:
    """Up to args.num_workers processes of one scene each, all episodes of max_episode_steps, no auto-reset."""
    os.environ.update(OMP_NUM_THREADS="1")  # of the workers
    workers = [lambda: ShowState(ppo_baseline.make_task(args, 1), args.target)] * min(args.num_workers, args.num_envs)
    return gym.vector.AsyncVectorEnv(workers, context="spawn", autoreset_mode="Disabled")


def load_phi(args: Args) -> StateEncoder:
    """Stage 1's state encoder from args.phi, frozen."""
    path = Path(args.phi.format(**vars(args))) / "repr.pt"
    stored = ppo_baseline.load(path, "name a run of aib_repr.py with --phi", env_id=args.env_id, kind="repr")
    phi = StateEncoder(len(stored["phi"]["mean"]), stored["u_dim"])
    phi.load_state_dict(stored["phi"])
    return phi.requires_grad_(False)


if __name__ == "__main__":
    ppo_baseline.Args = Args
    args = ppo_baseline.parse_args()
    phi = load_phi(args) if args.phi else None
    ppo_baseline.Agent, ppo_baseline.make_envs = partial(StateAgent, phi=phi), make_envs
    ppo_baseline.make_video = lambda data: b""
    name = "true_target" if args.target else "true_u" if phi else "true_state"
    args.exp_name, args.sim_backend = args.exp_name.replace("ppo_baseline", name), "physx_cpu"
    ppo_baseline.main(args)
