"""The examples of a user's own task run as a user would run them, and their pictures hide what must be remembered."""

from pathlib import Path

import numpy as np

from conftest import run


def target_pixels(rgb: np.ndarray) -> np.ndarray:
    """Where pictures (..., H, W, 3) show the green target of gymnasium_task.py."""
    return (rgb == (0, 255, 0)).all(-1)


def disc_pixels(rgb: np.ndarray) -> np.ndarray:
    """Where pictures (..., H, W, 3) show the red rings of maniskill_task.py's disc; the table's brown has less blue."""
    red, green, blue = np.moveaxis(rgb.astype(int), -1, 0)
    return (red > green + 80) & (blue > green)


def run_example(name: str, task: str, folder: Path) -> dict[str, np.ndarray]:
    """Run docs/examples/{name}.py from nothing; the random episodes that stage 1 collected."""
    code, out, err = run(f"docs/examples/{name}", "--quick", "--num-workers", "2", cwd=folder)
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


def test_maniskill_task_shows_its_disc_at_first_and_not_later(tmp_path: Path) -> None:
    episodes = run_example("maniskill_task", "RememberDisc-v0", tmp_path)
    seen = disc_pixels(episodes["rgb"]).sum((2, 3))
    assert seen[:, :5].min() > 100 and seen[:, 5:].max() < 10
    assert (episodes["state"][:, :, :2] == episodes["cue"][:, None]).all(), "the hidden disc stays where it was"
    assert np.ptp(episodes["rewards"].mean(1)) > 0.05, "random actions are rewarded differently for different discs"
