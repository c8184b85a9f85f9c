"""Memory or reach? How often an agent's hand ends nearest to the right object, on the test episodes of --evaluate.

A success asks for both: a hand at rest within 5 cm of the right object. Which object is nearest at the last step tells
what the agent took for the right one, however well it reached.

Usage:   python benchmark/nearest.py --checkpoint runs/RememberColor3-v0__ppo_aib_small__1/agent.pt
Prints:  the evaluation with nearest_is_right in place of return; writes nothing
"""

import sys
from dataclasses import dataclass
from pathlib import Path

import gymnasium as gym
import numpy as np
import tyro
from torch import Tensor

sys.path.insert(0, str(Path(__file__).parent.parent))
import ppo_aib  # noqa: E402
import ppo_baseline  # noqa: E402
import ppo_believer  # noqa: E402


@dataclass
class Args:
    checkpoint: Path
    """agent.pt of one of the PPO scripts, on a RememberColor, RememberShape or RememberShapeAndColor task"""
    num_eval_episodes: int = 256
    """episodes, the first of --evaluate's"""
    num_workers: int = ppo_baseline.Args.num_workers
    """simulator processes"""


class NearestObject(gym.Wrapper):
    """The reward is 1 where no object is nearer to the hand than the right one, else 0."""

    def step(self, action: np.ndarray) -> tuple:
        obs, _, *others = self.env.step(action)
        task = self.env.unwrapped
        objects = task.cubes if hasattr(task, "cubes") else task.shapes
        distances = [(x.pose.p - task.agent.tcp.pose.p).norm().item() for x in objects.values()]
        return obs, float(task.obj_to_goal_pos.norm().item() <= min(distances) + 1e-4), *others


def nearest_and_success(buffer: dict[str, Tensor]) -> dict[str, float]:
    """Metrics of a rollout, whose rewards are NearestObject's."""
    return {
        "nearest_is_right": buffer["rewards"][-1].mean().item(),
        "success_once": buffer["success"].amax(0).mean().item(),
        "success_at_end": buffer["success"][-1].mean().item(),
    }


def main(args: Args) -> None:
    """Evaluate the agent with other metrics."""
    stored = ppo_baseline.load(args.checkpoint, "name an agent.pt with --checkpoint")
    scripts = {f"{script.__name__} agent": script for script in (ppo_aib, ppo_believer, ppo_baseline)}
    script = scripts.get(stored["kind"])
    if script is None or not stored["env_id"].startswith(("RememberColor", "RememberShape")):
        ppo_baseline.fail(f"{args.checkpoint} is no agent of a task of objects; name one with --checkpoint")
    make_task = script.make_task
    script.make_task = lambda *arguments: NearestObject(make_task(*arguments))
    script.success_and_return = nearest_and_success
    script.save = lambda path, content: None
    settings = script.Args(checkpoint=str(args.checkpoint), sim_backend="physx_cpu", num_workers=args.num_workers)
    settings.num_eval_episodes = args.num_eval_episodes
    script.evaluate_checkpoint(settings)


if __name__ == "__main__":
    main(tyro.cli(Args))
