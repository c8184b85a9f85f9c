"""How fast, as ratios measured in one run: `make bench`.

A simulator's step and pictures against MIKASA-Robo's stock environment; steps/s of a rollout of ppo_aib.py by cores,
and of two side by side.

Usage:   python benchmark/speed.py
"""

import multiprocessing
import os

os.environ["CUDA_VISIBLE_DEVICES"] = ""  # speeds on a CPU, also where there is a GPU
import statistics
import sys
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import nullcontext
from pathlib import Path

import gymnasium as gym
import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).parent.parent))
import ppo_aib  # noqa: E402

CONFIG = {"image_shape": [64, 64, 3], "joints_dim": 25, "state_dim": 16, "gru_layers": 1, "u_dim": 16, "z_dim": 32}


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
    return statistics.median(seconds), np.stack(pictures).astype(int)


def rollout_speed(cores: list[int]) -> float:
    """Steps/s of a rollout of ppo_aib.py, 16 episodes of RememberColor3, on given cores; the faster of two."""
    os.sched_setaffinity(0, cores)
    torch.set_num_threads(len(cores))
    args = ppo_aib.Args(env_id="RememberColor3-v0", num_workers=4 * len(cores), image_size=64)
    envs = ppo_aib.make_envs(args)
    agent = ppo_aib.Agent(envs, ppo_aib.AIBBelief(CONFIG), args)
    seconds = []
    for _ in range(2):
        start = time.perf_counter()
        ppo_aib.rollout(envs, agent, args, np.arange(16))
        seconds.append(time.perf_counter() - start)
    envs.close()
    return 16 * gym.spec(args.env_id).max_episode_steps / min(seconds)


def afresh(function: Callable, *arguments: object) -> object:
    """What a function returns in a process of its own, with one thread for each library as in the scripts' workers."""
    os.environ.update(LP_NUM_THREADS="1", OMP_NUM_THREADS="1", OMP_WAIT_POLICY="PASSIVE")
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        return pool.submit(function, *arguments).result()


def row(*cells: str) -> None:
    """Print a row of the table."""
    print(f"| {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    row("what", "measured")
    row("---", "---")
    for env_id in ("InterceptFast-v0", "RememberColor9-v0"):
        (stock, _), (ours, _) = (afresh(simulate, kind, env_id) for kind in ("stock", "ours"))
        row(f"a step, {env_id}", f"{stock / ours:.1f} x as fast as stock ({1000 * stock:.0f} / {1000 * ours:.1f} ms)")
    for task in ("InterceptFast", "RememberColor9", "RememberShapeAndColor3x2", "TakeItBack", "ChainOfColors7"):
        (slow, heavy), (fast, ours) = (afresh(simulate, kind, f"{task}-v0") for kind in ("heavy", "ours"))
        differ = np.abs(heavy - ours).max(-1) > 16
        changed = f"{differ.mean():.2%} of pixels differ by more than 16"
        row(f"decimated meshes, {task}", f"{slow / fast:.1f} x as fast as untouched ones; {changed}")
    cores = sorted(os.sched_getaffinity(0))
    one, every = afresh(rollout_speed, cores[:1]), afresh(rollout_speed, cores)
    row("rollout of AIB, RememberColor3", f"{one:.0f} steps/s on 1 core, {every:.0f} on {len(cores)}")
    with ThreadPoolExecutor(2) as pool:
        together = sum(pool.map(afresh, [rollout_speed] * 2, [cores] * 2))
    row("two rollouts side by side", f"{together / every:.2f} of the steps/s of one alone, on {len(cores)} cores")
