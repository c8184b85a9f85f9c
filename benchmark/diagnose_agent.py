"""Does an agent fail for want of memory or of skill? The test episodes of --evaluate, with more to tell.

nearest_is_right, on Remember tasks: how often the hand ends nearest to the right object. A success asks for more, a
hand at rest within 5 cm of it. u_r2, of agents with a belief: R2 of u = phi(s) from the mean particle, at every fifth
step of these episodes; well below that of held-out random episodes it means distribution shift. With --swap-particles
each episode shows the particles of another one, so that an agent loses what it owes to its belief.

Usage:   python benchmark/diagnose_agent.py --checkpoint runs/RememberColor3-v0__ppo_aib_small__1/agent.pt
Reads:   phi from stage 1's run of the agent's task, preset and seed, or from --repr-dir
Writes:  diagnosis.json, or with --swap-particles diagnosis_swapped.json, beside the agent: the evaluation with
         nearest_is_right and u_r2 in place of return
"""

import sys
from dataclasses import dataclass
from pathlib import Path

import gymnasium as gym
import numpy as np
import torch
import tyro
from torch import Tensor

sys.path.insert(0, str(Path(__file__).parent.parent))
import aib_belief  # noqa: E402
import ppo_aib  # noqa: E402
import ppo_baseline  # noqa: E402
import ppo_believer  # noqa: E402


@dataclass
class Args:
    checkpoint: Path
    """agent.pt of one of the PPO scripts"""
    repr_dir: Path | None = None
    """run directory of the stage 1 that the agent's belief was trained on"""
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


class RecordState(gym.vector.VectorWrapper):
    """Keeps the privileged state (T+1, num_envs, D) of each round of episodes."""

    rounds: list[list[np.ndarray]] = []

    def reset(self, **kwargs: object) -> tuple:
        obs, info = self.env.reset(**kwargs)
        self.rounds.append([info["state"]])
        return obs, info

    def step(self, actions: np.ndarray) -> tuple:
        *others, info = self.env.step(actions)
        self.rounds[-1].append(info["state"])
        return *others, info


def load_phi(repr_dir: Path) -> aib_belief.StateEncoder:
    """Stage 1's state encoder."""
    stored = aib_belief.load(repr_dir / "repr.pt")
    phi = aib_belief.StateEncoder(len(stored["phi"]["mean"]), stored["u_dim"])
    phi.load_state_dict(stored["phi"])
    return phi.requires_grad_(False)


def diagnose(buffer: dict[str, Tensor], phi: aib_belief.StateEncoder | None) -> dict[str, object]:
    """Metrics of a rollout, whose rewards are NearestObject's and whose states RecordState has."""
    metrics = {
        "nearest_is_right": buffer["rewards"][-1].mean().item(),
        "success_once": buffer["success"].amax(0).mean().item(),
        "success_at_end": buffer["success"][-1].mean().item(),
    }
    if phi:
        state = np.concatenate([np.stack(states) for states in RecordState.rounds], 1)[:, : buffer["success"].shape[1]]
        u, estimate = phi(torch.from_numpy(state).float()).mean, buffer["particles"].cpu().mean(-2)
        metrics["u_r2"] = {t: round(aib_belief.r_squared(u[t], estimate[t]), 3) for t in range(0, len(estimate), 5)}
    return metrics


def main(args: Args) -> None:
    """Evaluate the agent with other metrics."""
    stored = ppo_baseline.load(args.checkpoint)
    scripts = {script.__name__: script for script in (ppo_aib, ppo_believer, ppo_baseline)}
    if stored.get("script") not in scripts:
        ppo_baseline.fail(f"{args.checkpoint} is no agent; name an agent.pt with --checkpoint")
    script = scripts[stored["script"]]
    if args.swap_particles and (script is ppo_baseline or args.num_workers < 2):
        ppo_baseline.fail("--swap-particles needs an agent with a belief, and --num-workers of at least 2")
    forward, make_task = script.Agent.forward, script.make_task
    if args.swap_particles:
        script.Agent.forward = lambda agent, obs: forward(agent, {**obs, "particles": obs["particles"].roll(1, 0)})
    script.make_task = lambda *arguments: NearestObject(make_task(*arguments))
    if script is not ppo_baseline:
        preset = "_quick" if stored["quick"] else "_small" if stored["small"] else ""
        phi = load_phi(args.repr_dir or Path(f"runs/{stored['env_id']}__aib_repr{preset}__{stored['seed']}"))
        make_envs = script.make_envs
        script.make_envs = lambda arguments: RecordState(make_envs(arguments))
    script.success_and_return = lambda buffer: diagnose(buffer, None if script is ppo_baseline else phi)
    save, name = script.save, "diagnosis_swapped.json" if args.swap_particles else "diagnosis.json"
    script.save = lambda path, content: save(path.with_name(name), content) if path.suffix == ".json" else None
    settings = script.Args(checkpoint=str(args.checkpoint), sim_backend="physx_cpu", num_workers=args.num_workers)
    settings.num_eval_episodes = args.num_eval_episodes
    script.evaluate_checkpoint(settings)


if __name__ == "__main__":
    main(tyro.cli(Args))
