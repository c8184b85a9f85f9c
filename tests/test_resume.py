"""Killed and stopped runs go on, and end where an uninterrupted run ends, to the last bit."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from conftest import ROOT, run
from kill_table import KILLS, SIZES, kill_and_go_on, make_reference, results

TASK = "RememberShapeAndColor3x2-v0"
CHOSEN = ["env.step:27", "repr_losses:5", "os.replace:11", "belief_losses:4", "encode:2", "ppo_losses:11", "os.fsync:6"]


@pytest.fixture(scope="module")
def reference(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with uninterrupted runs of the three stages on the toy task."""
    folder = tmp_path_factory.mktemp("reference")
    make_reference(folder, {"ppo_aib"})
    return folder


@pytest.mark.slow
@pytest.mark.parametrize("moment", CHOSEN)
def test_a_killed_run_goes_on_to_the_same_end(reference: Path, tmp_path: Path, moment: str) -> None:
    (script,) = {script for script, _, when in KILLS if when == moment}
    assert len(results(reference / "runs" / f"ToyMemory-v0__{script}__1")) >= 2
    row = kill_and_go_on(script, moment, reference, tmp_path)
    assert all(row.values()), row


def children(pid: int) -> list[int]:
    """Process numbers of a process's descendants."""
    found = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    return [int(child) for child in found] + [grand for child in found for grand in children(int(child))]


def all_gone(processes: list[int], seconds: float = 20) -> bool:
    """Whether the processes end within some seconds."""
    end = time.time() + seconds
    while any(Path(f"/proc/{pid}").exists() for pid in processes):
        if time.time() > end:
            return False
        time.sleep(0.2)
    return True


def start(script: str, cwd: Path) -> subprocess.Popen:
    """Start a quick run on the real simulator."""
    command = [sys.executable, str(ROOT / f"{script}.py"), "--env-id", TASK, "--quick"]
    return subprocess.Popen(command, cwd=cwd, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def wait_for(condition: object, process: subprocess.Popen, seconds: float = 180) -> None:
    """Wait until a condition holds while the process lives."""
    end = time.time() + seconds
    while not condition():
        assert process.poll() is None and time.time() < end, process.communicate()
        time.sleep(0.1)


@pytest.mark.slow
def test_a_killed_collection_goes_on_and_leaves_no_process(quick_runs: Path, tmp_path: Path) -> None:
    data = tmp_path / "runs" / f"{TASK}__aib_repr__1" / "dataset"
    process = start("aib_repr", tmp_path)
    wait_for(
        lambda: (data / "meta.json").exists() and '"episodes_done": 4' in (data / "meta.json").read_text(), process
    )
    workers = children(process.pid)
    assert len(workers) >= 2
    process.kill()
    process.communicate()
    assert all_gone(workers)
    code, out, err = run("aib_repr", "--env-id", TASK, "--quick", cwd=tmp_path)
    assert code == 0, err
    assert results(data) == results(quick_runs / "runs" / f"{TASK}__aib_repr__1" / "dataset")


@pytest.mark.slow
def test_a_stop_signal_saves_and_leaves_with_code_0(quick_runs: Path, tmp_path: Path) -> None:
    path = tmp_path / "runs" / f"{TASK}__ppo_baseline__1"
    process = start("ppo_baseline", tmp_path)
    wait_for(lambda: (path / "eval.csv").exists(), process)
    time.sleep(2)
    workers = children(process.pid)
    os.kill(process.pid, signal.SIGTERM)
    out, err = process.communicate(timeout=30)
    assert process.returncode == 0 and "run the same command again" in out and "Traceback" not in err, out + err
    assert all_gone(workers)
    code, out, err = run("ppo_baseline", "--env-id", TASK, "--quick", cwd=tmp_path)
    assert code == 0 and "going on with" in out, out + err
    assert results(path) == results(quick_runs / "runs" / f"{TASK}__ppo_baseline__1")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGUSR1])
def test_ctrl_c_and_sigusr1_do_the_same(tmp_path: Path, number: signal.Signals) -> None:
    arguments = json.dumps({**SIZES["ppo_baseline"], "total_timesteps": 10**6})
    command = [sys.executable, str(ROOT / "tests" / "toy_run.py"), "ppo_baseline", arguments]
    process = subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    wait_for(lambda: (tmp_path / "runs" / "ToyMemory-v0__ppo_baseline__1" / "checkpoint.pt").exists(), process)
    process.send_signal(number)
    out, err = process.communicate(timeout=30)
    assert process.returncode == 0 and "run the same command again" in out and "Traceback" not in err, out + err


@pytest.mark.slow
def test_a_dead_worker_ends_the_run_with_its_exit_code(tmp_path: Path) -> None:
    process = start("aib_repr", tmp_path)
    data = tmp_path / "runs" / f"{TASK}__aib_repr__1" / "dataset"
    wait_for(lambda: (data / "meta.json").exists(), process)
    time.sleep(1)
    spawned = [pid for pid in children(process.pid) if b"spawn_main" in Path(f"/proc/{pid}/cmdline").read_bytes()]
    os.kill(spawned[0], signal.SIGKILL)
    out, err = process.communicate(timeout=60)
    assert process.returncode == 1 and "died with exit code [-9]" in err and "run the same command again" in err
    assert all_gone(spawned)
