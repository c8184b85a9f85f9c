"""A simulator's step on a CPU against MIKASA-Robo's own, as ratios measured in one run, and its pictures: `make bench`.

Usage:   python benchmark/speed.py
"""

import multiprocessing
import os

os.environ["CUDA_VISIBLE_DEVICES"] = ""  # speeds on a CPU, also where there is a GPU
import statistics
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import gymnasium as gym
import numpy as np

sys.path.insert(0, str(Path(__file__).parent.parent))
import ppo_aib  # noqa: E402


def simulate(kind: str, env_id: str) -> tuple[float, np.ndarray]:
    """Median seconds of a step of one simulator, and 21 pictures (21, H, W, 3).

    kind: stock, MIKASA-Robo's environment; ours; heavy, ours with SAPIEN's own meshes.
    """
    if kind == "stock":
        modes = dict(obs_mode="rgb", control_mode="pd_joint_delta_pos", reward_mode="normalized_dense")
        backends = dict(sim_backend="physx_cpu", render_backend="sapien_cpu")
        env = gym.make(env_id, num_envs=1, robot_uids="panda_wristcam", **modes, **backends)
        env = ppo_aib.wrappers.FlattenRGBDObservationWrapper(env, rgb=True, depth=False, state=True)
        env = ppo_aib.wrappers.CPUGymWrapper(env, ignore_terminations=True)
    else:
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


def afresh(kind: str, env_id: str) -> tuple[float, np.ndarray]:
    """simulate in a process of its own, with one thread for each library as in the scripts' workers."""
    os.environ.update(LP_NUM_THREADS="1", OMP_NUM_THREADS="1", OMP_WAIT_POLICY="PASSIVE")
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        return pool.submit(simulate, kind, env_id).result()


def row(*cells: str) -> None:
    """Print a row of the table."""
    print(f"| {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    row("what", "measured")
    row("---", "---")
    for env_id in ("InterceptFast-v0", "RememberColor9-v0"):
        (stock, _), (ours, _) = (afresh(kind, env_id) for kind in ("stock", "ours"))
        row(f"a step, {env_id}", f"{stock / ours:.1f} x as fast as stock ({1000 * stock:.0f} / {1000 * ours:.1f} ms)")
    for task in ("InterceptFast", "RememberColor9", "RememberShapeAndColor3x2", "TakeItBack", "ChainOfColors7"):
        (slow, heavy), (fast, ours) = (afresh(kind, f"{task}-v0") for kind in ("heavy", "ours"))
        differ = np.abs(heavy - ours).max(-1) > 16
        changed = f"{differ.mean():.2%} of pixels differ by more than 16"
        row(f"decimated meshes, {task}", f"{slow / fast:.1f} x as fast as untouched ones; {changed}")
