"""One short run of ppo_baseline.py on every MIKASA-Robo task that needs no download, as a table.

Usage:   python benchmark/all_tasks.py                        (all 29)
         python benchmark/all_tasks.py --tasks TakeItBack-v0
"""

import os

os.environ["CUDA_VISIBLE_DEVICES"] = ""  # sizes of one scene on a CPU, also where there is a GPU
import subprocess
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path

import tyro

ROOT = Path(__file__).parent.parent
sys.path.append(str(ROOT))
import ppo_baseline  # noqa: E402


@dataclass
class Args:
    tasks: list[str] = field(default_factory=list)
    """tasks to run; none given: all that need no download"""


def tasks_without_download() -> list[str]:
    """Names of the registered MIKASA tasks that ask for no asset."""
    import mikasa_robo_suite.rl.memory_envs  # noqa: F401  (registers the tasks)
    from mani_skill.utils.registration import REGISTERED_ENVS

    found = {uid: spec for uid, spec in REGISTERED_ENVS.items() if spec.cls.__module__.startswith("mikasa_robo_suite")}
    return sorted(uid for uid, spec in found.items() if not spec.asset_download_ids)


def main(args: Args) -> None:
    """Print the table row by row; exit code 1 when a task fails."""
    print("| task | steps | image | joints | state | cue | seconds | result |\n|" + "---|" * 8)
    failed = 0
    for task in args.tasks or tasks_without_download():
        env = ppo_baseline.make_task(ppo_baseline.Args(env_id=task), 1)
        obs, info = env.reset(seed=0)
        sizes = [ppo_baseline.gym.spec(task).max_episode_steps, "x".join(map(str, obs["rgb"].shape))]
        sizes += [obs["joints"].size, info["state"].size, info["cue"].size]
        env.close()
        start = time.time()
        sizes_of_run = ["--total-timesteps", "1", "--num-envs", "2", "--num-eval-episodes", "2"]
        command = [sys.executable, str(ROOT / "ppo_baseline.py"), "--env-id", task, "--exp-name", "all_tasks"]
        command += ["--quick", "--overwrite", *sizes_of_run]
        done = subprocess.run(command, capture_output=True, text=True)
        result = "pass" if done.returncode == 0 else (done.stderr.strip().splitlines() or ["no message"])[-1]
        failed += done.returncode != 0
        print("| " + " | ".join(map(str, [task, *sizes, f"{time.time() - start:.0f}", result])) + " |", flush=True)
    sys.exit(failed > 0)


if __name__ == "__main__":
    main(tyro.cli(Args))
