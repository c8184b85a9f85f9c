"""Killed and stopped runs go on, and end where an uninterrupted run ends, to the last bit."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from conftest import ROOT, SHARES_QUICK_RUNS, SHARES_REFERENCE, TASK, run
from kill_table import KILLS, kill_and_go_on, make_reference, results

CHOSEN = ["env.step:27", "repr_losses:6", "torch.save:2", "ppo_losses:11", "believer_losses:3", "env.step:62"]


@pytest.fixture(scope="module")
def reference(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with uninterrupted runs of every script on the toy task."""
    folder = tmp_path_factory.mktemp("reference")
    make_reference(folder, {script for script, _, _ in KILLS})
    return folder


@SHARES_REFERENCE
@pytest.mark.parametrize(
    "script, moment",
    [
        pytest.param(script, moment, id=f"{script}, {doing}", marks=[] if moment in CHOSEN else pytest.mark.thorough)
        for script, doing, moment in KILLS
    ],
)
def test_a_killed_run_goes_on_to_the_same_end(reference: Path, tmp_path: Path, script: str, moment: str) -> None:
    assert len(results(reference / "runs" / f"ToyMemory-v0__{script}__1")) >= 3
    row = kill_and_go_on(script, moment, reference, tmp_path)
    assert all(row.values()), row


def children(pid: int) -> list[int]:
    """Process numbers of a process's descendants."""
    found = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    return [int(child) for child in found] + [grand for child in found for grand in children(int(child))]


def wait_for(condition: Callable[[], bool], seconds: float = 180) -> None:
    """Wait until a condition holds."""
    end = time.time() + seconds
    while not condition():
        assert time.time() < end
        time.sleep(0.1)


def listen_to_ctrl_c() -> None:
    """Let SIGINT mean what it means in a terminal."""
    signal.signal(signal.SIGINT, signal.default_int_handler)


@SHARES_QUICK_RUNS
def test_real_workers_end_with_their_parent_killed_or_stopped(quick_runs: Path, tmp_path: Path) -> None:
    """Kill a chain of stages outright, stop it by Ctrl-C, then let it go on to the same dataset."""
    meta = tmp_path / "runs" / f"{TASK}__aib_repr_quick__1" / "dataset" / "meta.json"
    command = [sys.executable, str(ROOT / "aib_belief.py"), "--env-id", TASK, "--quick", "--num-workers", "2"]
    for number, episodes in ((signal.SIGKILL, 2), (signal.SIGINT, 4)):
        pipes = dict(stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True)
        # whoever runs the tests in the background has them ignore Ctrl-C, and children inherit that
        process = subprocess.Popen(command, cwd=tmp_path, **pipes, preexec_fn=listen_to_ctrl_c)
        wait_for(lambda: meta.exists() and f'"episodes_done": {episodes}' in meta.read_text())  # noqa: B023
        family = children(process.pid)
        assert len(family) >= 3, "aib_repr.py and its two workers"
        os.killpg(process.pid, number)
        _, err = process.communicate(timeout=60)
        wait_for(lambda: not any(Path(f"/proc/{pid}").exists() for pid in family), 20)  # noqa: B023
        if number == signal.SIGINT:
            said = [line for line in err.splitlines() if line.strip() and "it/s" not in line and "step/s" not in line]
            assert process.returncode == 1 and said == ["stopped; the same command goes on from the last checkpoint"]
    code, out, err = run("aib_repr", "--env-id", TASK, "--quick", cwd=tmp_path)
    assert code == 0, err
    for file in meta.parent.glob("*.npy"):
        ours, other = np.load(file), np.load(quick_runs / f"{TASK}__aib_repr_quick__1" / "dataset" / file.name)
        if file.stem == "rgb":
            assert (ours != other).mean() < 1e-3
        else:  # not to the last bit: PhysX's contacts of several cubes depend on what the process played before
            assert np.allclose(ours, other, atol=1e-5), file
