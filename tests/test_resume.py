"""Killed and stopped runs go on, and end where an uninterrupted run ends, to the last bit."""

from pathlib import Path

import pytest

from kill_table import KILLS, kill_and_go_on, make_reference, results

CHOSEN = ["env.step:27", "repr_losses:6", "torch.save:2", "ppo_losses:11", "believer_losses:3", "env.step:62"]


@pytest.fixture(scope="module")
def reference(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with uninterrupted runs of every script on the toy task."""
    folder = tmp_path_factory.mktemp("reference")
    make_reference(folder, {script for script, _, _ in KILLS})
    return folder


@pytest.mark.parametrize(
    "script, moment",
    [
        pytest.param(script, moment, id=f"{script}, {doing}", marks=[] if moment in CHOSEN else pytest.mark.thorough)
        for script, doing, moment in KILLS
    ],
)
def test_a_killed_run_goes_on_to_the_same_end(reference: Path, tmp_path: Path, script: str, moment: str) -> None:
    assert len(results(reference / "runs" / f"ToyMemory-v0__{script}__1")) >= 2
    row = kill_and_go_on(script, moment, reference, tmp_path)
    assert all(row.values()), row
