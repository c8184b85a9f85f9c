"""A toy memory task instead of the simulator, for tests of learning: it stands in for make_envs and check_task."""

from collections.abc import Callable
from types import ModuleType

import gymnasium as gym
import numpy as np


class ToyMemory(gym.vector.VectorEnv):
    """See a colour for two steps, nothing for six, and then act on it.

    Three colours name three targets of the first action. The last two of ten steps are rewarded by closeness to the
    target, and only the last one can succeed, by being nearest to the right target: without memory the chance is one
    third, whatever one does. All that happens follows from an episode's seed and the actions.
    """

    STEPS, CUE, GO, SIZE = 10, 2, 8, 36
    COLOURS = np.array([[255, 0, 0], [0, 255, 0], [0, 0, 255]], np.uint8)
    TARGETS = np.array([-0.8, 0.0, 0.8], np.float32)

    def __init__(self, num_envs: int):
        self.num_envs = num_envs
        rgb = gym.spaces.Box(0, 255, (self.SIZE, self.SIZE, 3), np.uint8)
        joints = gym.spaces.Box(-np.inf, np.inf, (3,), np.float32)
        self.single_observation_space = gym.spaces.Dict({"rgb": rgb, "joints": joints})
        self.single_action_space = gym.spaces.Box(-1, 1, (2,), np.float32)
        self.action_space = gym.vector.utils.batch_space(self.single_action_space, num_envs)

    def _observe(self) -> tuple[dict, dict]:
        rgb = self.background.copy()
        if self.t < self.CUE:
            rgb[:, 12:24, 12:24] = self.COLOURS[self.colour][:, None, None]
        if self.t >= self.GO:
            rgb[:, 4:8, 4:8] = 255
        phase = np.full((self.num_envs, 1), self.t / self.STEPS, np.float32)
        obs = {"rgb": rgb, "joints": np.concatenate([self.body, phase], 1)}
        one_hot = np.eye(3, dtype=np.float32)[self.colour]
        success = np.abs(self.action[:, None] - self.TARGETS).argmin(1) == self.colour
        info = {"success": (success & (self.t == self.STEPS)).astype(np.float32)}
        info |= {"state": np.concatenate([one_hot, phase], 1), "cue": self.colour.astype(np.float32)}  # a number
        return obs, info

    def reset(self, *, seed: list[int], options: dict | None = None) -> tuple[dict, dict]:
        """Start one episode per seed."""
        rngs = [np.random.default_rng(s) for s in seed]
        self.t, self.action = 0, np.zeros(self.num_envs, np.float32)
        self.colour = np.array([rng.integers(3) for rng in rngs])
        shade = np.array([rng.integers(90, 130) for rng in rngs], np.uint8)
        self.background = np.broadcast_to(shade[:, None, None, None], (self.num_envs, self.SIZE, self.SIZE, 3)).copy()
        self.body = np.stack([rng.normal(size=2) for rng in rngs]).astype(np.float32)
        return self._observe()

    def step(self, actions: np.ndarray) -> tuple:
        """Act in every episode."""
        assert np.abs(actions).max() <= 1, "actions are clamped to the box"
        self.action = np.asarray(actions)[:, 0]
        self.t += 1
        obs, info = self._observe()
        near = 1 - np.abs(self.action - self.TARGETS[self.colour]) / 2
        reward = (near * (self.t > self.GO)).astype(np.float32)
        ends = np.full(self.num_envs, self.t == self.STEPS)
        return obs, reward, np.zeros_like(ends), ends, info


gym.register("ToyMemory-v0", ToyMemory, max_episode_steps=ToyMemory.STEPS)


def make_envs(args: object) -> ToyMemory:
    """In place of the scripts' make_envs: num_workers episodes at a time."""
    return ToyMemory(args.num_workers)


def take_the_simulators_place(setattr: Callable, module: ModuleType) -> None:
    """Let a script's module play the toy task, by a setattr that may undo it again."""
    if hasattr(module, "make_envs"):
        setattr(module, "make_envs", make_envs)
        setattr(module, "check_task", lambda args: None)
