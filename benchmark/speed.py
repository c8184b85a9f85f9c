"""How fast, as ratios measured in one run: `make bench`.

Stage 2's update against a per-step loop; rollout and update of ppo_baseline.py against the agent and the buffers of
MIKASA-Robo's own PPO script on the same simulator and sizes; what of a rollout is simulator; scaling with workers.

Usage:   python benchmark/speed.py
         python benchmark/speed.py --env-id InterceptFast-v0 --episodes 16
"""

import dataclasses
import os
import resource
import statistics
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Literal

import numpy as np
import torch
import tyro

ROOT = Path(__file__).parent.parent
sys.path += [str(ROOT), str(ROOT / "tests"), str(ROOT / "benchmark")]
import belief  # noqa: E402

import ppo_aib  # noqa: E402
import ppo_baseline  # noqa: E402


@dataclass
class Args:
    env_id: str = "RememberShapeAndColor3x2-v0"
    """MIKASA-Robo task"""
    robot: Literal["panda", "panda_wristcam"] = "panda"
    """panda renders 3 times faster on a CPU"""
    episodes: int = 8
    """episodes per rollout"""
    repeats: int = 3
    """measurements of each, of which the median counts"""


class Clock:
    """Adds up the time spent inside an environment's reset and step."""

    def __init__(self, envs: object):
        self.seconds = 0.0
        for name in ("reset", "step"):
            setattr(envs, name, self._timed(getattr(envs, name)))

    def _timed(self, function: object) -> object:
        def timed(*args: object, **kwargs: object) -> object:
            start = time.perf_counter()
            try:
                return function(*args, **kwargs)
            finally:
                self.seconds += time.perf_counter() - start

        return timed


class MikasaAgent(torch.nn.Module):
    """MIKASA-Robo's agent, seen as ppo_losses wants it: observations -> (policy, value)."""

    def __init__(self, agent: torch.nn.Module):
        super().__init__()
        self.agent = agent

    def forward(self, obs: dict) -> tuple[torch.distributions.Normal, torch.Tensor]:
        """See ppo_baseline.Agent."""
        x = self.agent.get_features({"rgb": obs["rgb"], "state": obs["joints"]})
        mean = self.agent.actor_mean(x)
        return torch.distributions.Normal(mean, self.agent.actor_logstd.exp().expand_as(mean)), self.agent.critic(x)[
            :, 0
        ]


def mikasa(envs: object, seeds: np.ndarray) -> tuple[torch.nn.Module, dict, float]:
    """Play one episode per seed with MIKASA-Robo's agent into its float32 buffers; agent, data, seconds."""
    from baselines.ppo.ppo_memtasks import Agent, DictArray

    steps, device = envs.spec.max_episode_steps, torch.device("cpu")
    obs, _ = envs.reset(seed=seeds[: envs.num_envs].tolist())
    sample = {"rgb": torch.as_tensor(obs["rgb"]), "state": torch.as_tensor(obs["joints"])}
    shell = SimpleNamespace(unwrapped=SimpleNamespace(single_action_space=envs.single_action_space))
    agent = Agent(shell, sample)
    space = ppo_baseline.gym.spaces.Dict(
        {"rgb": envs.single_observation_space["rgb"], "state": envs.single_observation_space["joints"]}
    )
    start = time.perf_counter()
    buffers = DictArray((steps, len(seeds)), space, device=device)
    data = {name: torch.zeros(steps, len(seeds)) for name in ("logprob", "reward")}
    data["action"] = torch.zeros(steps, len(seeds), *envs.single_action_space.shape)
    data["value"] = torch.zeros(steps + 1, len(seeds))
    with torch.no_grad():
        for first in range(0, len(seeds), envs.num_envs):
            now = slice(first, first + envs.num_envs)
            obs, _ = envs.reset(seed=seeds[now].tolist())
            for t in range(steps + 1):
                seen = {"rgb": torch.as_tensor(obs["rgb"]), "state": torch.as_tensor(obs["joints"])}
                action, logprob, _, value = agent.get_action_and_value(seen)
                data["value"][t, now] = value.flatten()
                if t < steps:
                    buffers[t, now] = seen
                    data["action"][t, now], data["logprob"][t, now] = action, logprob
                    obs, reward, _, _, _ = envs.step(action.clamp(-1, 1).numpy())
                    data["reward"][t, now] = torch.as_tensor(reward, dtype=torch.float32)
    data |= {"rgb": buffers["rgb"], "joints": buffers["state"]}
    return MikasaAgent(agent), data, time.perf_counter() - start


def ours(module: object, play: object, steps: int, count: int, seeds: np.ndarray) -> tuple[dict, float]:
    """One rollout of a script; data, seconds."""
    start = time.perf_counter()
    data = module.gather(play(seeds, True), steps, count)
    return data, time.perf_counter() - start


def update(agent: torch.nn.Module, data: dict, args: object) -> float:
    """Seconds of one PPO update."""
    optimizer = torch.optim.Adam(agent.parameters(), lr=1e-4, eps=1e-5, fused=True)
    start = time.perf_counter()
    ppo_baseline.ppo_update(agent, optimizer, data, args, SimpleNamespace(received=False))
    return time.perf_counter() - start


def rows(args: Args) -> Iterator[tuple[str, str]]:
    """Measure, and give the table row by row."""
    yield "stage 2", belief.speed(torch.device("cpu"))
    settings = ppo_baseline.Args(env_id=args.env_id, robot=args.robot, device="cpu", target_kl=1e9, num_minibatches=8)
    settings = ppo_baseline.resolve(settings, ppo_baseline.PPO_DEFAULTS)
    seeds = np.arange(args.episodes)
    with ppo_baseline.simulator(settings, args.episodes) as envs:
        steps, clock = envs.spec.max_episode_steps, Clock(envs)
        agent, play, _ = ppo_baseline.build_ppo(settings, envs, {})
        times = {name: [] for name in ("ours rollout", "mikasa rollout", "ours update", "mikasa update")}
        for _ in range(args.repeats):
            data, seconds = ours(ppo_baseline, play, steps, args.episodes, seeds)
            times["ours rollout"].append(seconds)
            times["ours update"].append(update(agent, data, settings))
            their_agent, their_data, seconds = mikasa(envs, seeds)
            times["mikasa rollout"].append(seconds)
            times["mikasa update"].append(update(their_agent, their_data, settings))
        median = {name: statistics.median(values) for name, values in times.items()}
        for what in ("rollout", "update"):
            ratio = median[f"mikasa {what}"] / median[f"ours {what}"]
            yield f"plain PPO, {what}", f"{ratio:.2f} x as fast as with MIKASA-Robo's own agent and buffers"
        bytes_ours, bytes_theirs = data["rgb"].nbytes, their_data["rgb"].nbytes
        yield "plain PPO, image buffer", f"{bytes_ours / 1e6:.0f} MB against {bytes_theirs / 1e6:.0f} MB"

        config = {"image_shape": [128, 128, 3], "joints_dim": 0, "action_dim": 0, "gru_layers": 1}
        config |= {"u_dim": 16, "z_dim": 32}
        aib = ppo_aib.resolve(ppo_aib.Args(env_id=args.env_id, robot=args.robot, device="cpu"), ppo_aib.PPO_DEFAULTS)
        stored = {"config": config, "weights": ppo_aib.AIBBelief(config).state_dict(), "readout": None}
        for name, module, run in (
            ("plain PPO", ppo_baseline, play),
            ("AIB", ppo_aib, ppo_aib.build_aib(aib, envs, stored)[1]),
            ("AIB, --amp", ppo_aib, ppo_aib.build_aib(dataclasses.replace(aib, amp=True), envs, stored)[1]),
        ):
            shares = []
            for _ in range(args.repeats):
                clock.seconds = 0.0
                _, seconds = ours(module, run, steps, args.episodes, seeds)
                shares.append(1 - clock.seconds / seconds)
            yield f"{name}, rollout", f"{statistics.median(shares):.1%} of the time is not simulator"
    rates = {}
    for workers in range(1, len(os.sched_getaffinity(0)) + 1):
        if args.episodes % workers == 0:
            settings.num_workers = workers
            with ppo_baseline.simulator(settings, args.episodes) as envs:
                _, play, _ = ppo_baseline.build_ppo(settings, envs, {})
                rates[workers] = 1 / min(ours(ppo_baseline, play, steps, args.episodes, seeds)[1] for _ in range(2))
    scaling = ", ".join(f"{workers}: {rate / rates[1]:.2f} x" for workers, rate in rates.items())
    yield "rollout with workers", scaling
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    yield "peak memory of this process", f"{peak:.2f} GB"


def main(args: Args) -> None:
    """Print the table."""
    print(f"{args.env_id}, {args.robot}, {args.episodes} episodes, {len(os.sched_getaffinity(0))} cores\n")
    print("| what | measured |\n|---|---|")
    for name, text in rows(args):
        print(f"| {name} | {text} |", flush=True)


if __name__ == "__main__":
    main(tyro.cli(Args))
