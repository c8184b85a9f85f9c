"""How fast, as ratios measured in one run: `make bench`.

A simulator's step and pictures against MIKASA-Robo's stock environment; the belief's network on small pictures;
steps/s of a rollout of ppo_aib.py by cores, and of two side by side.

Usage:   python benchmark/speed.py
         python benchmark/speed.py --env-id InterceptFast-v0 --episodes 16
"""

import multiprocessing
import os

os.environ["CUDA_VISIBLE_DEVICES"] = ""  # speeds on a CPU, also where there is a GPU
import statistics
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path

import gymnasium as gym
import numpy as np
import torch
import tyro

sys.path.insert(0, str(Path(__file__).parent.parent))
import aib_belief  # noqa: E402
import ppo_aib  # noqa: E402

SIZE = 64  # of pictures, with --small
CONFIG = {"image_shape": [SIZE, SIZE, 3], "joints_dim": 25, "state_dim": 16, "gru_layers": 1, "u_dim": 16, "z_dim": 32}


@dataclass
class Args:
    env_id: str = "RememberColor3-v0"
    """MIKASA-Robo task of the rollouts"""
    episodes: int = 16
    """episodes per rollout"""


def simulate(kind: str, env_id: str) -> tuple[float, np.ndarray]:
    """Median seconds of a step of one simulator, and 21 pictures (21, H, W, 3).

    kind: stock, MIKASA-Robo's environment; ours; heavy, ours with SAPIEN's own shaders and meshes.
    """
    if kind == "stock":
        modes = dict(obs_mode="rgb", control_mode="pd_joint_delta_pos", reward_mode="normalized_dense")
        backends = dict(sim_backend="physx_cpu", render_backend="sapien_cpu")
        env = gym.make(env_id, num_envs=1, robot_uids="panda_wristcam", **modes, **backends)
        env = ppo_aib.wrappers.FlattenRGBDObservationWrapper(env, rgb=True, depth=False, state=True)
        env = ppo_aib.wrappers.CPUGymWrapper(env, ignore_terminations=True)
    else:
        if kind == "heavy":
            ppo_aib.shaders_without_brdf_table = nullcontext
        triangles = 500 if kind == "ours" else 0
        env = ppo_aib.make_task(ppo_aib.Args(env_id=env_id, robot_triangles=triangles), 1)
    pictures, seconds, rng = [env.reset(seed=1)[0]["rgb"]], [], np.random.default_rng(0)
    for _ in range(20):
        action = rng.uniform(-1, 1, 8).astype(np.float32)
        start = time.perf_counter()
        obs, *_ = env.step(action)
        seconds.append(time.perf_counter() - start)
        pictures.append(obs["rgb"])
    return statistics.median(seconds), np.stack(pictures)


def rollout_speed(env_id: str, cores: set[int], episodes: int) -> float:
    """Steps/s of a rollout of ppo_aib.py on given cores; the faster of two."""
    os.sched_setaffinity(0, cores)
    torch.set_num_threads(len(cores))
    args = ppo_aib.Args(env_id=env_id, num_workers=4 * len(cores), image_size=SIZE)
    envs = ppo_aib.make_envs(args)
    agent = ppo_aib.Agent(envs, ppo_aib.AIBBelief(CONFIG), args)
    seconds = []
    for _ in range(2):
        start = time.perf_counter()
        ppo_aib.rollout(envs, agent, args, np.arange(episodes))
        seconds.append(time.perf_counter() - start)
    envs.close()
    return episodes * gym.spec(env_id).max_episode_steps / min(seconds)


def history_seconds(size: int) -> float:
    """Seconds for h of 16 episodes with pictures of size x size and its gradient, on one core; the fastest of three."""
    torch.set_num_threads(1)
    history = aib_belief.HistoryEncoder({**CONFIG, "image_shape": [size, size, 3]})
    batch = {"rgb": torch.zeros(61, 16, size, size, 3, dtype=torch.uint8), "joints": torch.zeros(61, 16, 25)}
    seconds = []
    for _ in range(3):
        start = time.perf_counter()
        aib_belief.encode_history(history, batch).sum().backward()
        seconds.append(time.perf_counter() - start)
    return min(seconds)


def afresh(function: Callable, *arguments: object) -> object:
    """What a function returns in a process of its own, with one thread for each library as in the scripts' workers."""
    os.environ.update(LP_NUM_THREADS="1", OMP_NUM_THREADS="1", OMP_WAIT_POLICY="PASSIVE")
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        return pool.submit(function, *arguments).result()


def rows(args: Args) -> Iterator[tuple[str, str]]:
    """Measure, and give the table row by row."""
    for env_id in ("InterceptFast-v0", "RememberColor9-v0"):
        stock, ours = (afresh(simulate, kind, env_id) for kind in ("stock", "ours"))
        text = f"{stock[0] / ours[0]:.1f} x as fast as stock ({1000 * stock[0]:.0f} / {1000 * ours[0]:.1f} ms)"
        yield f"a step, {env_id}", text
    for task in ("InterceptFast", "RememberColor9", "RememberShapeAndColor3x2", "TakeItBack", "ChainOfColors7"):
        heavy, ours = (afresh(simulate, kind, f"{task}-v0")[1].astype(int) for kind in ("heavy", "ours"))
        difference = np.abs(heavy - ours)
        yield f"pictures, {task}", f"{(difference.max(-1) > 16).mean():.2%} of pixels differ by more than 16"
    large, small = (afresh(history_seconds, size) for size in (128, SIZE))
    yield "belief's network, forward and backward", f"{large / small:.1f} x as fast with {SIZE} pixels as with 128"
    cores = sorted(os.sched_getaffinity(0))
    one, every = (afresh(rollout_speed, args.env_id, set(use), args.episodes) for use in (cores[:1], cores))
    yield f"rollout of AIB, {args.env_id}", f"{one:.0f} steps/s on 1 core, {every:.0f} on {len(cores)}"
    with ThreadPoolExecutor(2) as pool:
        runs = [pool.submit(afresh, rollout_speed, args.env_id, set(cores), args.episodes) for _ in range(2)]
        together = sum(run.result() for run in runs)
    yield "two rollouts side by side", f"{together / every:.2f} of the steps/s of one alone, on {len(cores)} cores"


def main(args: Args) -> None:
    """Print the table."""
    print("| what | measured |\n|---|---|")
    for name, text in rows(args):
        print(f"| {name} | {text} |", flush=True)


if __name__ == "__main__":
    main(tyro.cli(Args))
