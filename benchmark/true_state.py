"""How far would a perfect belief get? PPO as in ppo_baseline.py, on joints and the true privileged state, no pictures.

Tells a belief that fails from a budget that is too small, at several times the speed. In place of the state the policy
sees u with --phi, what a belief is trained to know, or with --target the target position of a Remember task. With
--pictures it sees the picture, too, as AIB's policy does: what pictures cost PPO.

Usage:   python benchmark/true_state.py --env-id RememberColor5-v0 --small
         python benchmark/true_state.py --env-id RememberColor5-v0 --small \\
             --phi runs/RememberColor5-v0__aib_repr_small__1
         python benchmark/true_state.py --env-id RememberColor5-v0 --small --target
Takes:   the arguments of ppo_baseline.py; always simulates on the CPU
Writes:  runs/{env_id}__true_state__{seed}/ (true_u, true_target; …_pictures; …_small), as ppo_baseline.py; empty videos
"""

import math
import sys
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal

import gymnasium as gym
import numpy as np
import torch
import torch.nn as nn
from torch.distributions import Normal

sys.path.insert(0, str(Path(__file__).parent.parent))
import ppo_baseline  # noqa: E402
from aib_belief import StateEncoder  # noqa: E402
from ppo_baseline import NatureCNN, orthogonal_init  # noqa: E402


@dataclass
class Args(ppo_baseline.Args):
    phi: str | None = None
    """run directory of stage 1, whose state encoder turns the state into u; None: the state itself"""
    target: bool = False
    """the target position in place of the state; only in Remember tasks, whose state is the cue and object positions"""
    pictures: bool = False
    """show the picture, too"""
    sim_backend: Literal["physx_cpu"] = "physx_cpu"


class ShowState(gym.Wrapper):
    """Joints (25 + D,) float32 with the privileged state at their end.

    Without pictures nothing is drawn, and rgb is one black pixel.
    """

    def __init__(self, env: gym.Env, target: bool = False, pictures: bool = False):
        super().__init__(env)
        self.target = target
        if not pictures:
            black = {"base_camera": {"rgb": torch.zeros(1, 1, 1, 3, dtype=torch.uint8)}}
            env.unwrapped._get_obs_sensor_data = lambda: black
        obs, _ = self.reset()
        joints = gym.spaces.Box(-np.inf, np.inf, obs["joints"].shape)
        self.observation_space = gym.spaces.Dict(rgb=gym.spaces.Box(0, 255, obs["rgb"].shape, np.uint8), joints=joints)

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
    """Actor and critic on joints and state, or u in its place, in the sizes of ppo_baseline.Agent.

    With args.pictures also on those.
    """

    def __init__(self, envs: gym.vector.VectorEnv, args: Args, phi: StateEncoder | None = None):
        super().__init__()
        image_shape, (joints_dim,) = (envs.single_observation_space[name].shape for name in ("rgb", "joints"))
        (action_dim,) = envs.single_action_space.shape
        self.cnn = orthogonal_init(NatureCNN(image_shape, 256, args.amp)) if args.pictures else nn.Sequential()
        self.phi = phi
        input_dim = 25 + phi(phi.mean).mean.numel() if phi else joints_dim
        features = 128 if self.cnn else 256 + 128
        self.joints = orthogonal_init(nn.Sequential(nn.Linear(input_dim, features), nn.ReLU()))
        self.actor = orthogonal_init(nn.Sequential(nn.Linear(256 + 128, 512), nn.ReLU(), nn.Linear(512, action_dim)))
        self.critic = orthogonal_init(nn.Sequential(nn.Linear(256 + 128, 512), nn.ReLU(), nn.Linear(512, 1)))
        orthogonal_init(self.actor[-1], 0.01 * 2**0.5)
        self.log_std = nn.Parameter(torch.full((action_dim,), math.log(args.init_std)))

    def forward(self, obs: dict[str, torch.Tensor]) -> tuple[Normal, torch.Tensor]:
        """Policy over actions (B, A) and value (B,) of joints (B, 25 + D) and rgb (B, H, W, 3) uint8."""
        x = obs["joints"]
        if self.phi:
            x = torch.cat([x[:, :25], self.phi(obs["joints"][:, 25:]).mean], -1)
        x = self.joints(x.clamp(-10, 10))  # a ball that is hit spins at hundreds of deviations
        if self.cnn:
            x = torch.cat([self.cnn(obs["rgb"].float().div_(255)), x], -1)
        mean = torch.tanh(self.actor(x))
        return Normal(mean, self.log_std.exp().expand_as(mean), validate_args=False), self.critic(x).squeeze(-1)


def load_phi(args: Args) -> StateEncoder:
    """Stage 1's state encoder from args.phi, frozen."""
    path = Path(args.phi) / "repr.pt"
    stored = ppo_baseline.load(path, env_id=args.env_id)
    phi = StateEncoder(len(stored["phi"]["mean"]), stored["u_dim"])
    phi.load_state_dict(stored["phi"])
    return phi.requires_grad_(False)


if __name__ == "__main__":
    ppo_baseline.Args = Args
    args = ppo_baseline.parse_args()
    phi = load_phi(args) if args.phi else None
    make_task = ppo_baseline.make_task
    ppo_baseline.make_task = lambda *arguments: ShowState(make_task(*arguments), args.target, args.pictures)
    ppo_baseline.Agent = partial(StateAgent, phi=phi)
    ppo_baseline.make_video = lambda data: b""
    name = "true_target" if args.target else "true_u" if phi else "true_state"
    if args.pictures:
        name += "_pictures"
    args.exp_name = args.exp_name.replace("ppo_baseline", name)
    if args.evaluate:
        ppo_baseline.evaluate_checkpoint(args)
    else:
        ppo_baseline.main(args)
