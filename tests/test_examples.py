"""The examples of a user's own task run as a user would run them, and their pictures hide what must be remembered."""

import sys
from collections.abc import Callable
from pathlib import Path

import gymnasium as gym
import imageio.v3 as iio
import numpy as np
import pytest

from conftest import ROOT, run

sys.path.append(str(ROOT / "docs" / "examples"))
from gymnasium_task import RememberTarget, check_envs


def target_pixels(rgb: np.ndarray) -> np.ndarray:
    """Where pictures (..., H, W, 3) show the green target of gymnasium_task.py."""
    return (rgb == (0, 255, 0)).all(-1)


def disc_pixels(rgb: np.ndarray) -> np.ndarray:
    """Where pictures (..., H, W, 3) show the red rings of maniskill_task.py's disc; the table's brown has less blue."""
    red, green, blue = np.moveaxis(rgb.astype(int), -1, 0)
    return (red > green + 80) & (blue > green)


def run_example(name: str, task: str, folder: Path) -> dict[str, np.ndarray]:
    """Run docs/examples/{name}.py from nothing; the random episodes that stage 1 collected."""
    code, out, err = run(f"docs/examples/{name}", "--quick", cwd=folder)
    assert code == 0, out + err
    trained = folder / "runs" / f"{task}__ppo_aib_quick__1"
    assert (trained / "agent.pt").exists()
    assert len((trained / "eval.csv").read_text().splitlines()) == 2, "a header and one evaluation"
    dataset = folder / "runs" / f"{task}__aib_repr_quick__1" / "dataset"
    return {array: np.load(dataset / f"{array}.npy") for array in ("rgb", "state", "cue", "rewards")}


def test_gymnasium_task_draws_its_target_at_first_and_not_later(tmp_path: Path) -> None:
    episodes = run_example("gymnasium_task", "RememberTarget-v0", tmp_path)
    pixels = target_pixels(episodes["rgb"])
    assert (pixels[:, :4].sum((2, 3)) == 64).all() and not pixels[:, 4:].any()
    for first_picture, cue in zip(pixels[:, 0], episodes["cue"], strict=True):
        rows, columns = np.nonzero(first_picture)
        assert (columns.min(), rows.min()) == tuple(((cue + 1) * 28).astype(int)), "the cue is where the target is"
    for method, script in (("believer", "ppo_believer"), ("ppo", "ppo_baseline")):
        code, out, err = run("docs/examples/gymnasium_task", "--quick", "--method", method, cwd=tmp_path)
        assert code == 0, out + err
        assert (tmp_path / "runs" / f"RememberTarget-v0__{script}_quick__1" / "agent.pt").exists()


def test_maniskill_task_shows_its_disc_at_first_and_not_later(tmp_path: Path) -> None:
    episodes = run_example("maniskill_task", "RememberDisc-v0", tmp_path)
    seen = disc_pixels(episodes["rgb"]).sum((2, 3))
    assert seen[:, :5].min() > 100 and seen[:, 5:].max() < 10
    assert (episodes["state"][:, :, :2] == episodes["cue"][:, None]).all(), "the hidden disc stays where it was"
    assert np.ptp(episodes["rewards"].mean(1)) > 0.05, "random actions are rewarded differently for different discs"


def test_the_stored_agent_plays_in_a_loop_of_ones_own(tmp_path: Path) -> None:
    code, out, err = run("docs/examples/play_agent", cwd=tmp_path)
    assert code == 0 and "RememberColor3-v0, seed 0: " in out, out + err
    assert len(iio.imread(tmp_path / "episode.mp4")) == 60


MISTAKES = {  # what a task returns, changed: what check_envs says of it
    "no cue at step 3": lambda env, obs, info: info.pop("cue") if env.t == 3 else None,
    "success must be numbers": lambda env, obs, info: info.update(success=np.bool_(True)),
    "state is not finite at step 2": lambda env, obs, info: info.update(state=info["state"] / (env.t != 2)),
    "different seeds": lambda env, obs, info: info.update(state=np.full(4, env.t)),
    "state must be of": lambda env, obs, info: info.update(state=1.0),
    "follow from its seed": lambda env, obs, info: info.update(state=np.random.default_rng().normal(size=4)),
}


@pytest.mark.parametrize(("message", "spoil"), MISTAKES.items())
def test_a_task_that_breaks_the_contract_is_told_how(message: str, spoil: Callable) -> None:
    class Broken(RememberTarget):
        def observe(self) -> tuple[dict, dict]:
            obs, info = super().observe()
            spoil(self, obs, info)
            return obs, info

    with np.errstate(divide="ignore", invalid="ignore"), pytest.raises(AssertionError, match=message):
        check_task_class(Broken)


def test_actions_that_would_be_clipped_and_shared_observations_are_told() -> None:
    class Broken(RememberTarget):
        action_space = gym.spaces.Box(-2, 2, (2,), np.float32)

    with pytest.raises(AssertionError, match="actions must lie in"):
        check_task_class(Broken)
    with pytest.raises(AssertionError, match="rgb of the reset was overwritten"):
        check_task_class(RememberTarget, copy=False)


def test_an_episode_that_ends_early_is_told_when() -> None:
    class Broken(RememberTarget):
        def step(self, action: np.ndarray) -> tuple[dict, float, bool, bool, dict]:
            obs, reward, _, _, info = super().step(action)
            return obs, reward, self.t == 7, False, info

    check_task_class(RememberTarget)
    with pytest.raises(AssertionError, match="ended at step 7 of 20"):
        check_task_class(Broken)


@pytest.mark.parametrize(
    ("name", "space", "message"),
    [
        ("rgb", gym.spaces.Box(0, 255, (64, 64, 3), np.float32), "not float32"),
        ("joints", gym.spaces.Box(-1, 1, (2,), np.float64), "not float64"),
    ],
)
def test_an_observation_of_the_wrong_type_is_told(name: str, space: gym.Space, message: str) -> None:
    class Broken(RememberTarget):
        observation_space = gym.spaces.Dict({**RememberTarget.observation_space.spaces, name: space})

    with pytest.raises(AssertionError, match=f"{name} must be .* {message}"):
        check_task_class(Broken)


def check_task_class(task: type[gym.Env], **vector_kwargs: bool) -> None:
    """check_envs on two environments of a task of 20 steps."""
    gym.register("Checked-v0", task, max_episode_steps=20)
    vector_kwargs["autoreset_mode"] = "Disabled"
    try:
        check_envs(gym.make_vec("Checked-v0", 2, "sync", vector_kwargs=vector_kwargs), "Checked-v0")
    finally:
        gym.registry.pop("Checked-v0")
