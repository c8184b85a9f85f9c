"""Does an agent fail for want of memory or of skill? The test episodes of --evaluate, with more to tell.

nearest_is_right, on Remember tasks: how often the hand ends nearest to the right object. A success asks for more, a
hand at rest within 5 cm of it. With --swap-particles each episode shows the particles of another one, so that an agent
loses what it owes to its belief.

Usage:   python benchmark/diagnose_agent.py --checkpoint runs/RememberColor3-v0__ppo_aib_small__1/agent.pt
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
    """agent.pt of one of the PPO scripts"""
    swap_particles: bool = False
    """show the particles of another episode"""
    num_eval_episodes: int = 256
    """episodes, the first of --evaluate's"""
    num_workers: int = ppo_baseline.Args.num_workers
    """simulator processes; episodes played at the same time swap their particles, so at least 2"""


class NearestObject(gym.Wrapper):
    """The reward is 1 where no object is nearer to the hand than the right one, else 0; nan without objects."""

    def step(self, action: np.ndarray) -> tuple:
        obs, _, *others = self.env.step(action)
        task = self.env.unwrapped
        objects = getattr(task, "cubes", None) or getattr(task, "shapes", {})
        distances = [(x.pose.p - task.agent.tcp.pose.p).norm().item() for x in objects.values()]
        nearest = float(task.obj_to_goal_pos.norm().item() <= min(distances) + 1e-4) if objects else float("nan")
        return obs, nearest, *others


def nearest_and_success(buffer: dict[str, Tensor]) -> dict[str, float]:
    """Metrics of a rollout, whose rewards are NearestObject's."""
    return {
        "nearest_is_right": buffer["rewards"][-1].mean().item(),
        "success_once": buffer["success"].amax(0).mean().item(),
        "success_at_end": buffer["success"][-1].mean().item(),
    }


def main(args: Args) -> None:
    """Evaluate the agent with other metrics."""
    kind = ppo_baseline.load(args.checkpoint).get("script")
    scripts = {script.__name__: script for script in (ppo_aib, ppo_believer, ppo_baseline)}
    if kind not in scripts:
        ppo_baseline.fail(f"{args.checkpoint} is no agent; name an agent.pt with --checkpoint")
    script = scripts[kind]
    if args.swap_particles and (script is ppo_baseline or args.num_workers < 2):
        ppo_baseline.fail("--swap-particles needs an agent with a belief, and --num-workers of at least 2")
    forward, make_task = script.Agent.forward, script.make_task
    if args.swap_particles:
        script.Agent.forward = lambda agent, obs: forward(agent, {**obs, "particles": obs["particles"].roll(1, 0)})
    script.make_task = lambda *arguments: NearestObject(make_task(*arguments))
    script.success_and_return = nearest_and_success
    script.save = lambda path, content: None
    settings = script.Args(checkpoint=str(args.checkpoint), sim_backend="physx_cpu", num_workers=args.num_workers)
    settings.num_eval_episodes = args.num_eval_episodes
    script.evaluate_checkpoint(settings)


if __name__ == "__main__":
    main(tyro.cli(Args))
