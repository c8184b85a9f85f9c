"""How fast, as ratios measured in one run: `make bench`.

A simulator's start, step and pictures against MIKASA-Robo's stock environment; steps/s of a rollout of ppo_aib.py by
cores, and of two side by side; stage 2's update against a per-step loop; rollout and update of ppo_baseline.py against
the agent and the buffers of MIKASA-Robo's own PPO script on the same simulator and sizes; what of a rollout is
simulator.

Usage:   python benchmark/speed.py
         python benchmark/speed.py --env-id InterceptFast-v0 --episodes 16
"""

import multiprocessing
import os

os.environ["CUDA_VISIBLE_DEVICES"] = ""  # speeds on a CPU, also where there is a GPU
import resource
import statistics
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import torch
import tyro

ROOT = Path(__file__).parent.parent
sys.path += [str(ROOT), str(ROOT / "tests"), str(ROOT / "benchmark")]
import belief  # noqa: E402

import ppo_aib  # noqa: E402
import ppo_baseline  # noqa: E402

CONFIG = {"image_shape": [128, 128, 3], "joints_dim": 0, "state_dim": 16, "gru_layers": 1, "u_dim": 16, "z_dim": 32}


@dataclass
class Args:
    env_id: str = "RememberShapeAndColor3x2-v0"
    """MIKASA-Robo task"""
    episodes: int = 16
    """episodes per rollout"""
    repeats: int = 3
    """measurements of each, of which the median counts"""


class Clock:
    """Adds up the time spent inside an environment's reset and step."""

    def __init__(self, envs: object):
        self.seconds = 0.0
        for name in ("reset", "step"):
            setattr(envs, name, partial(self._timed, getattr(envs, name)))

    def _timed(self, function: Callable, *args: object, **kwargs: object) -> object:
        start = time.perf_counter()
        result = function(*args, **kwargs)
        self.seconds += time.perf_counter() - start
        return result


class MikasaAgent(torch.nn.Module):
    """MIKASA-Robo's agent, seen as ppo_losses wants it: observations -> (policy, value)."""

    def __init__(self, agent: torch.nn.Module):
        super().__init__()
        self.agent = agent

    def forward(self, obs: dict) -> tuple[torch.distributions.Normal, torch.Tensor]:
        """See ppo_baseline.Agent."""
        x = self.agent.get_features({"rgb": obs["rgb"], "state": obs["joints"]})
        mean = self.agent.actor_mean(x)
        policy = torch.distributions.Normal(mean, self.agent.actor_logstd.exp().expand_as(mean))
        return policy, self.agent.critic(x)[:, 0]


def mikasa(envs: object, steps: int, seeds: np.ndarray) -> tuple[torch.nn.Module, dict, float]:
    """Play an episode of so many steps per seed with MIKASA-Robo's agent into its float32 buffers; also the seconds."""
    from baselines.ppo.ppo_memtasks import Agent, DictArray

    device = torch.device("cpu")
    obs, _ = envs.reset(seed=seeds[: envs.num_envs].tolist())
    sample = {"rgb": torch.as_tensor(obs["rgb"]), "state": torch.as_tensor(obs["joints"])}
    shell = SimpleNamespace(unwrapped=SimpleNamespace(single_action_space=envs.single_action_space))
    agent = Agent(shell, sample)
    space = ppo_baseline.gym.spaces.Dict(
        {"rgb": envs.single_observation_space["rgb"], "state": envs.single_observation_space["joints"]}
    )
    start = time.perf_counter()
    buffers = DictArray((steps, len(seeds)), space, device=device)
    data = {name: torch.zeros(steps, len(seeds)) for name in ("logprobs", "rewards")}
    data["actions"] = torch.zeros(steps, len(seeds), *envs.single_action_space.shape)
    data["values"] = torch.zeros(steps + 1, len(seeds))
    with torch.no_grad():
        for first in range(0, len(seeds), envs.num_envs):
            now = slice(first, first + envs.num_envs)
            obs, _ = envs.reset(seed=seeds[now].tolist())
            for t in range(steps + 1):
                seen = {"rgb": torch.as_tensor(obs["rgb"]), "state": torch.as_tensor(obs["joints"])}
                action, logprob, _, value = agent.get_action_and_value(seen)
                data["values"][t, now] = value.flatten()
                if t < steps:
                    buffers[t, now] = seen
                    data["actions"][t, now], data["logprobs"][t, now] = action, logprob
                    obs, reward, _, _, _ = envs.step(action.clamp(-1, 1).numpy())
                    data["rewards"][t, now] = torch.as_tensor(reward, dtype=torch.float32)
    data |= {"rgb": buffers["rgb"], "joints": buffers["state"]}
    return MikasaAgent(agent), data, time.perf_counter() - start


def update(agent: torch.nn.Module, data: dict, args: ppo_baseline.Args) -> float:
    """Seconds of one PPO update on a rollout, as in ppo_baseline.main."""
    optimizer = torch.optim.Adam(agent.parameters(), lr=1e-4, eps=1e-5, fused=True)
    start, values = time.perf_counter(), data["values"]
    advantage = ppo_baseline.compute_gae(data["rewards"], values, args.gamma, args.gae_lambda)
    data = {**data, "advantages": advantage, "returns": advantage + values[:-1]}
    batch = {name: x.flatten(0, 1) for name, x in data.items() if name != "values"}
    for _ in range(args.update_epochs):
        for index in torch.randperm(advantage.numel()).tensor_split(args.num_minibatches):
            losses = ppo_baseline.ppo_losses(agent, {name: x[index] for name, x in batch.items()}, args)
            optimizer.zero_grad()
            losses["total"].backward()
            torch.nn.utils.clip_grad_norm_(agent.parameters(), args.max_grad_norm)
            optimizer.step()
    return time.perf_counter() - start


def timed(function: Callable, *arguments: object) -> tuple[object, float]:
    """What a call returns, and its seconds."""
    start = time.perf_counter()
    return function(*arguments), time.perf_counter() - start


def simulate(kind: str, env_id: str, robot: str) -> tuple[float, float, np.ndarray]:
    """CPU-seconds to build and reset one simulator, median seconds of a step, and 21 pictures (21, H, W, 3).

    kind: stock, MIKASA-Robo's environment; ours; heavy, ours with SAPIEN's own shaders and meshes.
    """
    start = time.process_time()
    if kind == "stock":
        modes = dict(obs_mode="rgb", control_mode="pd_joint_delta_pos", reward_mode="normalized_dense")
        backends = dict(sim_backend="physx_cpu", render_backend="sapien_cpu")
        env = gym.make(env_id, num_envs=1, robot_uids=robot, **modes, **backends)
        env = ppo_baseline.wrappers.FlattenRGBDObservationWrapper(env, rgb=True, depth=False, state=True)
        env = ppo_baseline.wrappers.CPUGymWrapper(env, ignore_terminations=True)
    else:
        if kind == "heavy":
            ppo_baseline.shaders_without_brdf_table = nullcontext
        triangles = 500 * (kind == "ours")
        env = ppo_baseline.make_task(ppo_baseline.Args(env_id=env_id, robot=robot, robot_triangles=triangles), 1)
    pictures, seconds, rng = [env.reset(seed=1)[0]["rgb"]], [], np.random.default_rng(0)
    start = time.process_time() - start
    for _ in range(20):
        action = rng.uniform(-1, 1, 8).astype(np.float32)
        (obs, *_), duration = timed(env.step, action)
        pictures.append(obs["rgb"])
        seconds.append(duration)
    return start, statistics.median(seconds), np.stack(pictures)


def rollout_rate(env_id: str, cores: set[int], episodes: int) -> float:
    """Steps/s of a rollout of ppo_aib.py on the given cores, the faster of two."""
    os.sched_setaffinity(0, cores)
    torch.set_num_threads(len(cores))
    args = ppo_aib.Args(env_id=env_id, num_workers=2 * len(cores))
    envs = ppo_aib.make_envs(args)
    agent = ppo_aib.Agent(envs, ppo_aib.AIBBelief(CONFIG), args)
    seeds = np.arange(episodes)
    seconds = [timed(ppo_aib.rollout, envs, agent, args, seeds)[1] for _ in range(2)]
    envs.close()
    return episodes * ppo_aib.gym.spec(env_id).max_episode_steps / min(seconds)


def afresh(function: Callable, *arguments: object) -> object:
    """What a function returns in a process of its own, with one thread for each library as in the scripts' workers."""
    os.environ.update(LP_NUM_THREADS="1", OMP_NUM_THREADS="1", OMP_WAIT_POLICY="PASSIVE")
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        return pool.submit(function, *arguments).result()


def simulator_rows(args: Args) -> Iterator[tuple[str, str]]:
    """What our simulator costs against the stock one, and what its pictures lose."""
    for env_id in ("InterceptFast-v0", "RememberColor9-v0"):
        for robot in ("panda_wristcam", "panda"):
            stock, ours = (afresh(simulate, kind, env_id, robot) for kind in ("stock", "ours"))
            text = f"step {stock[1] / ours[1]:.1f} x as fast as stock ({1000 * stock[1]:.0f} / {1000 * ours[1]:.1f} ms)"
            text += f", start {ours[0] / stock[0]:.2f} of stock's CPU time ({stock[0]:.1f} s, {ours[0]:.1f} s)"
            yield f"one simulator, {env_id}, {robot}", text
    tasks = ["InterceptFast", "RememberColor9", "RememberShapeAndColor3x2", "TakeItBack", "ChainOfColors7"]
    for env_id in (f"{task}-v0" for task in tasks):
        heavy, ours = (afresh(simulate, kind, env_id, "panda_wristcam")[2].astype(int) for kind in ("heavy", "ours"))
        difference = np.abs(heavy - ours)
        share, mean = (difference.max(-1) > 16).mean(), difference.mean()
        yield f"pictures, {env_id}", f"{share:.2%} of pixels differ by more than 16, mean difference {mean:.2f}"
    cores = sorted(os.sched_getaffinity(0))
    one, every = (afresh(rollout_rate, args.env_id, set(use), args.episodes) for use in (cores[:1], cores))
    yield f"rollout of AIB, {args.env_id}", f"{one:.0f} steps/s on 1 core, {every:.0f} on {len(cores)}"
    with ThreadPoolExecutor(2) as pool:
        runs = [pool.submit(afresh, rollout_rate, args.env_id, set(cores), args.episodes) for _ in range(2)]
        together = sum(run.result() for run in runs)
    yield "two rollouts side by side", f"{together / every:.2f} of the steps/s of one alone, on {len(cores)} cores"


def rows(args: Args) -> Iterator[tuple[str, str]]:
    """Measure, and give the table row by row."""
    yield from simulator_rows(args)
    yield "stage 2", belief.speed(torch.device("cpu"))
    cores = len(os.sched_getaffinity(0))
    settings = ppo_baseline.Args(env_id=args.env_id, num_minibatches=8)
    seeds, envs = np.arange(args.episodes), ppo_baseline.make_envs(settings)
    clock = Clock(envs)
    agent = ppo_baseline.Agent(envs, settings)
    times = {name: [] for name in ("our rollout", "mikasa rollout", "our update", "mikasa update")}
    for _ in range(args.repeats):
        data, seconds = timed(ppo_baseline.rollout, envs, agent, settings, seeds)
        times["our rollout"].append(seconds)
        times["our update"].append(update(agent, data, settings))
        their_agent, their_data, seconds = mikasa(envs, len(data["rewards"]), seeds)
        times["mikasa rollout"].append(seconds)
        times["mikasa update"].append(update(their_agent, their_data, settings))
    median = {name: statistics.median(values) for name, values in times.items()}
    for what in ("rollout", "update"):
        ratio = median[f"mikasa {what}"] / median[f"our {what}"]
        yield f"plain PPO, {what}", f"{ratio:.2f} x as fast as with MIKASA-Robo's own agent and buffers"
    bytes_ours, bytes_theirs = data["rgb"].nbytes, their_data["rgb"].nbytes
    yield "plain PPO, image buffer", f"{bytes_ours / 1e6:.0f} MB against {bytes_theirs / 1e6:.0f} MB"

    shares = {"plain PPO": (ppo_baseline.rollout, agent)}
    for name, amp in (("AIB", False), ("AIB, --amp", True)):
        believing = ppo_aib.Agent(envs, ppo_aib.AIBBelief(CONFIG, amp), ppo_aib.Args(amp=amp))
        shares[name] = (ppo_aib.rollout, believing)
    for name, (play, player) in shares.items():
        measured = []
        for _ in range(args.repeats):
            clock.seconds = 0.0
            _, seconds = timed(play, envs, player, ppo_aib.Args(env_id=args.env_id, device="cpu"), seeds)
            measured.append(1 - clock.seconds / seconds)
        yield f"{name}, rollout", f"{statistics.median(measured):.1%} of the time is not simulator"
    envs.close()

    rates = {}
    for workers in (1, cores, 2 * cores, 4 * cores):
        settings.num_workers = workers
        envs = ppo_baseline.make_envs(settings)
        rates[workers] = 1 / min(timed(ppo_baseline.rollout, envs, agent, settings, seeds)[1] for _ in range(2))
        envs.close()
    yield "rollout with workers", ", ".join(f"{workers}: {rate / rates[1]:.2f} x" for workers, rate in rates.items())
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    yield "peak memory of this process", f"{peak:.2f} GB"


def main(args: Args) -> None:
    """Print the table."""
    print(f"{args.env_id}, {args.episodes} episodes, {len(os.sched_getaffinity(0))} cores\n")
    print("| what | measured |\n|---|---|")
    for name, text in rows(args):
        print(f"| {name} | {text} |", flush=True)


if __name__ == "__main__":
    main(tyro.cli(Args))
