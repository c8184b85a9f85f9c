"""AIB on a memory task of one's own, a plain Gymnasium environment whose pictures numpy draws.

A point moves in a square. Its target is drawn in the first pictures only, so the agent must remember where it was.

Usage:   python docs/examples/gymnasium_task.py --small
Takes:   --method aib, believer or ppo, and the arguments that all scripts have: --seed, --device, --small, --quick
Writes:  what the method's scripts write, to runs/RememberTarget-v0__...
"""

import argparse
import sys
from pathlib import Path

import gymnasium as gym
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2]))
import aib_belief  # noqa: E402
import aib_repr  # noqa: E402
import ppo_aib  # noqa: E402
import ppo_baseline  # noqa: E402
import ppo_believer  # noqa: E402

TASK = "RememberTarget-v0"
SCRIPTS = {  # of each method, in order
    "aib": (aib_repr, aib_belief, ppo_aib),
    "believer": (aib_repr, ppo_believer),
    "ppo": (ppo_baseline,),
}
GREEN, WHITE = (0, 255, 0), (255, 255, 255)


def draw_square(rgb: np.ndarray, place: np.ndarray, colour: tuple[int, int, int]) -> None:
    """Draw 8 x 8 pixels at a place in [-1, 1] x [-1, 1]."""
    column, row = ((place + 1) * 28).astype(int)
    rgb[row : row + 8, column : column + 8] = colour


class RememberTarget(gym.Env):
    """One environment; gymnasium's vector environment stacks what several of them return."""

    observation_space = gym.spaces.Dict(
        rgb=gym.spaces.Box(0, 255, (64, 64, 3), np.uint8), joints=gym.spaces.Box(-1, 1, (2,), np.float32)
    )
    action_space = gym.spaces.Box(-1, 1, (2,), np.float32)

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[dict, dict]:
        """Place the target. All chance comes from self.np_random, which the seed starts."""
        super().reset(seed=seed)
        self.t = 0
        self.point = np.zeros(2, np.float32)
        self.target = self.np_random.uniform(-0.9, 0.9, 2).astype(np.float32)
        return self.observe()

    def step(self, action: np.ndarray) -> tuple[dict, float, bool, bool, dict]:
        """Move the point. Success does not end the episode, and gym.make truncates it after max_episode_steps."""
        self.t += 1
        self.point = (self.point + 0.15 * action).clip(-1, 1)
        obs, info = self.observe()
        reward = 1 - float(np.linalg.norm(self.point - self.target)) / 3
        return obs, reward, False, False, info

    def observe(self) -> tuple[dict, dict]:
        """Observation, and the info that only training sees."""
        rgb = np.zeros((64, 64, 3), np.uint8)
        draw_square(rgb, self.point, WHITE)
        if self.t < 4:
            draw_square(rgb, self.target, GREEN)
        success = float(np.linalg.norm(self.point - self.target) < 0.2)  # np.bool_ would become an array of objects
        state = np.concatenate([self.target, self.point])
        return {"rgb": rgb, "joints": self.point}, {"success": success, "state": state, "cue": self.target.copy()}


gym.register(TASK, RememberTarget, max_episode_steps=20)


def make_envs(args: object) -> gym.vector.VectorEnv:
    """In place of the scripts' make_envs. A slow simulator is better off in processes of its own:

    gym.make_vec(TASK, args.num_workers, "async", vector_kwargs={"autoreset_mode": "Disabled", "context": "spawn"})
    """
    return gym.make_vec(TASK, args.num_envs, "sync", vector_kwargs={"autoreset_mode": "Disabled"})


def check_envs(envs: gym.vector.VectorEnv, task: str) -> None:
    """Play one episode twice and check what the scripts rely on; an AssertionError says what is wrong."""
    steps, seeds = gym.spec(task).max_episode_steps, list(range(envs.num_envs))
    box = envs.single_action_space
    assert np.all(box.low == -1) and np.all(box.high == 1), f"actions must lie in [-1, 1], not in {box}"
    actions = np.random.default_rng(0).uniform(-1, 1, (steps, *envs.action_space.shape)).astype(np.float32)
    ends = []
    for _ in range(2):
        obs, info = envs.reset(seed=seeds)
        for t in range(steps):
            rgb, joints = obs["rgb"], obs["joints"]
            pictures = rgb.dtype == np.uint8 and rgb.ndim == 4 and min(rgb.shape[1:3]) >= 36 and rgb.shape[3] == 3
            assert pictures, f"rgb must be uint8 of (H, W, 3), at least 36 x 36, not {rgb.dtype} of {rgb.shape[1:]}"
            vectors = joints.dtype == np.float32 and joints.ndim == 2
            assert vectors, f"joints must be float32 of (J,), not {joints.dtype} of {joints.shape[1:]}"
            for name in ("state", "cue", "success"):
                assert name in info, f"info has no {name} at step {t}"
                values = np.asarray(info[name])
                assert values.dtype.kind in "fiu", f"info's {name} must be numbers, not {values.dtype}"
                assert np.isfinite(values).all(), f"info's {name} is not finite at step {t}"
            state = info["state"]
            assert state.ndim == 2, "info's state must be of (D,)"
            if t == 0:
                assert len(seeds) == 1 or (state != state[0]).any(), "different seeds must give different episodes"
                first = {name: (array, array.copy()) for name, array in {**obs, "state": state}.items()}
            obs, reward, terminated, truncated, info = envs.step(actions[t])
            assert t == steps - 1 or not (terminated | truncated).any(), f"an episode ended at step {t + 1} of {steps}"
        for name, (array, copy) in first.items():
            assert np.array_equal(array, copy), f"{name} of the reset was overwritten by a step: return copies"
        ends.append([obs["rgb"], obs["joints"], info["state"], reward])
    for array, again in zip(*ends, strict=True):
        difference = np.abs(array.astype(float) - again).mean()
        assert difference < 1e-3, "an episode must follow from its seed and actions"  # but for rounding


def main() -> None:
    """Run a method's scripts one after another, with the arguments of the command line."""
    parser = argparse.ArgumentParser(add_help=False)
    parser.add_argument("--method", choices=SCRIPTS, default="aib")
    chosen, others = parser.parse_known_args()
    sys.argv[1:] = [*others, "--env-id", TASK]
    scripts = SCRIPTS[chosen.method]
    for script in scripts:
        script.make_envs = make_envs  # not used by aib_belief.py, which has no simulator
        script.check_task = lambda args: None
    arguments = [script.parse_args() for script in scripts]  # all before any runs: a mistake shows at once
    for args in arguments:
        args.sim_backend = "physx_cpu"  # its default with CUDA, physx_cuda, would send actions as tensors
    envs = make_envs(arguments[0])
    check_envs(envs, TASK)
    envs.close()
    for script, args in zip(scripts, arguments, strict=True):
        script.main(args)


if __name__ == "__main__":
    main()
