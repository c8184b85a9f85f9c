"""The three stages and both baselines from nothing, as a user runs them with --quick, on the real simulator.

All tests that use these runs are in this file, since test processes share files, not tests (see Makefile).
"""

import csv
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import gymnasium as gym
import imageio.v3 as iio
import numpy as np
import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

import aib_repr
from conftest import ONE_ITERATION, ROOT, TASK, run

sys.path.append(str(ROOT / "benchmark"))
import diagnose_agent  # noqa: E402


def test_dataset(quick_runs: Path) -> None:
    data = quick_runs / f"{TASK}__aib_repr_quick__1" / "dataset"
    meta = json.loads((data / "meta.json").read_text())
    assert (meta["env_id"], meta["robot_triangles"], meta["episodes_done"]) == (TASK, 500, 8)
    arrays = {file.stem: np.load(file) for file in data.glob("*.npy")}
    state_dim = arrays["state"].shape[-1]
    expected = {
        "rgb": ((8, 61, 128, 128, 3), np.uint8),
        "joints": ((8, 61, 25), np.float32),
        "state": ((8, 61, state_dim), np.float32),
        "actions": ((8, 60, 8), np.float32),
        "rewards": ((8, 60), np.float32),
        "success": ((8, 60), np.bool_),
        "cue": ((8, 1), np.float32),
    }
    assert {name: (array.shape, array.dtype) for name, array in arrays.items()} == expected
    assert np.abs(arrays["actions"]).max() <= 1 and abs(arrays["actions"].std() - 3**-0.5) < 0.02, "uniform"
    assert len(np.unique(arrays["actions"].reshape(8, -1), axis=0)) == 8 and len(np.unique(arrays["cue"], axis=0)) > 1
    assert (arrays["rgb"][:, 0] != arrays["rgb"][:, 30]).any((1, 2, 3)).all()
    phi = torch.load(data.parent / "repr.pt", weights_only=True)["phi"]
    assert phi["std"].min() == np.float32(0.05), "what hardly varies in the state counts for little"


@pytest.mark.parametrize("script", ["ppo_aib", "ppo_believer", "ppo_baseline"])
def test_results(quick_runs: Path, script: str) -> None:
    path = quick_runs / f"{TASK}__{script}_quick__1"
    rows = list(csv.DictReader((path / "eval.csv").open()))
    columns = ["iteration", "global_step", "success_once", "success_at_end", "return"]
    assert list(rows[0]) == columns
    assert [row["global_step"] for row in rows] == ["120"]
    agent = torch.load(path / "agent.pt", weights_only=True)
    assert (agent["script"], agent["env_id"], agent["global_step"]) == (script, TASK, 120)
    events = EventAccumulator(str(path)).Reload()
    tags = {
        "charts/SPS",
        "charts/updates",
        "charts/episodic_return",
        "losses/explained_variance",
        "losses/policy_loss",
        "losses/value_loss",
        "losses/approx_kl",
    }
    tags |= {"train/success_once", "eval/success_once", "eval/success_at_end", "eval/return"}
    assert tags <= set(events.Tags()["scalars"])
    video = iio.imread(sorted((path / "videos").iterdir())[-1])
    assert video.shape == (60, 256, 512, 3) and np.abs(video[0].astype(int) - video[-1]).mean() > 1


def test_stages_leave_their_diagnostics(quick_runs: Path) -> None:
    for script in ("aib_belief", "ppo_believer"):
        path = quick_runs / f"{TASK}__{script}_quick__1"
        code, out, err = run("benchmark/belief", "--run", str(path), cwd=quick_runs.parent)
        assert code == 0, out + err
        report = json.loads((path / "diagnostics.json").read_text())
        assert {"nll_prior", "nll_posterior", "action_readout", "cue_chance"} <= report.keys()
        assert ("flow_gain" in report) == (script == "aib_belief")
        assert len(report["cue_from_h"]) == len(report["u_r2_prior"]) == 61
    events = EventAccumulator(str(quick_runs / f"{TASK}__ppo_believer_quick__1" / "belief_events")).Reload()
    assert "belief/held_out_error" in events.Tags()["scalars"]
    events = EventAccumulator(str(quick_runs / f"{TASK}__aib_repr_quick__1")).Reload()
    assert {"held_out/active_dimensions", "held_out/kl", "losses/reward"} <= set(events.Tags()["scalars"])


def test_a_finished_run_is_left_as_it_is(quick_runs: Path) -> None:
    path = quick_runs / f"{TASK}__ppo_baseline_quick__1"
    before = {file: file.stat().st_mtime_ns for file in path.rglob("*.pt")}
    code, out, _ = run("ppo_baseline", "--env-id", TASK, "--quick", *ONE_ITERATION, cwd=quick_runs.parent)
    assert code == 0 and "is finished" in out
    assert before == {file: file.stat().st_mtime_ns for file in path.rglob("*.pt")}


def test_evaluate_alone_plays_its_episodes_with_the_stored_agent(quick_runs: Path) -> None:
    path = quick_runs / f"{TASK}__ppo_aib_quick__1"
    options = ["--checkpoint", str(path / "agent.pt"), "--num-eval-episodes", "2"]
    code, out, err = run("ppo_aib", "--evaluate", *options, cwd=quick_runs.parent)
    assert code == 0, err
    metrics = json.loads((path / "evaluation.json").read_text())
    last = list(csv.DictReader((path / "eval.csv").open()))[-1]
    assert metrics.keys() == last.keys() - {"iteration"} | {"num_eval_episodes"}
    assert metrics["global_step"] == int(last["global_step"]) and metrics["num_eval_episodes"] == 2
    assert metrics["return"] != pytest.approx(float(last["return"]), rel=1e-5), "test episodes, not those of training"
    assert json.dumps(metrics, indent=2) in out and (path / "evaluation.mp4").stat().st_size > 1000


@pytest.mark.thorough
def test_the_animation_shows_every_step(quick_runs: Path, tmp_path: Path) -> None:
    agent, stage_1 = (quick_runs / f"{TASK}__{name}_quick__1" for name in ("ppo_aib", "aib_repr"))
    options = ["--checkpoint", str(agent / "agent.pt"), "--repr-dir", str(stage_1), "--episodes", "0"]
    code, out, err = run("benchmark/animation", *options, "--output", str(tmp_path / "agent.gif"), cwd=tmp_path)
    assert code == 0, out + err
    assert len(iio.imread(tmp_path / "agent.gif")) == gym.spec(TASK).max_episode_steps


@pytest.mark.thorough
def test_an_agent_is_diagnosed_and_nothing_else_is_written(
    quick_runs: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    monkeypatch.chdir(quick_runs.parent)
    agent = Path("runs") / f"{TASK}__ppo_aib_quick__1" / "agent.pt"
    before = {file: file.stat().st_mtime_ns for file in quick_runs.rglob("*")}
    found = []
    for options in ([], ["--swap-particles"]):
        arguments = ["--checkpoint", str(agent), "--num-eval-episodes", "2", "--num-workers", "2", *options]
        code, out, err = run("benchmark/diagnose_agent", *arguments, cwd=quick_runs.parent)
        assert code == 0, err
        found.append(json.loads(out[out.index("{") :]))
        file = quick_runs.parent / agent.with_name("diagnosis_swapped.json" if options else "diagnosis.json")
        assert json.loads(file.read_text()) == found[-1]
        file.unlink()
        assert 0 <= found[-1]["nearest_is_right"] <= 1
    assert found[0]["u_r2"] != found[1]["u_r2"], "other particles, other actions, other states"
    after = {file: file.stat().st_mtime_ns for file in quick_runs.rglob("*")}
    folder = quick_runs / agent.parent.name  # in which files came and went
    assert {**after, folder: 0} == {**before, folder: 0}, "nothing else is written"

    def refused(words: str, args: diagnose_agent.Args) -> None:
        with pytest.raises(SystemExit):
            diagnose_agent.main(args)
        assert words in capsys.readouterr().err

    refused("is no agent", diagnose_agent.Args(agent.with_name("checkpoint.pt")))
    plain = Path("runs") / f"{TASK}__ppo_baseline_quick__1" / "agent.pt"
    refused("needs an agent with a belief", diagnose_agent.Args(plain, swap_particles=True))


def test_an_episode_follows_from_its_seed_and_actions_in_whatever_process(quick_runs: Path) -> None:
    dataset = quick_runs / f"{TASK}__aib_repr_quick__1" / "dataset"
    arrays = {file.stem: np.load(file) for file in dataset.glob("*.npy")}
    assert json.loads((dataset / "meta.json").read_text())["episodes_done"] == 8
    env = aib_repr.make_task(aib_repr.Args(env_id=TASK), 1)
    obs, info = env.reset(seed=1_000_005 % 2**29 + 2**30)
    for t in range(20):
        # not to the last bit: PhysX's contacts of several cubes depend on what the process played before
        assert (arrays["rgb"][5, t] != obs["rgb"]).mean() < 1e-3
        for name, x in (("joints", obs["joints"]), ("state", info["state"])):
            assert np.allclose(arrays[name][5, t], x, atol=1e-5), (name, t)
        obs, reward, _, _, info = env.step(arrays["actions"][5, t])
        assert np.isclose(arrays["rewards"][5, t], reward, atol=1e-5)
    assert not np.array_equal(arrays["rgb"][5, 0], arrays["rgb"][6, 0]), "two seeds are two episodes"
    env.close()


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


def test_real_workers_end_with_their_parent_killed_or_stopped(tmp_path: Path) -> None:
    """Kill a chain of stages outright, let it go on, stop it by Ctrl-C."""
    meta = tmp_path / "runs" / f"{TASK}__aib_repr_quick__1" / "dataset" / "meta.json"
    command = [sys.executable, str(ROOT / "ppo_aib.py"), "--env-id", TASK, "--quick", "--num-workers", "2"]
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
            said = [line for line in err.splitlines() if line.strip() and "%|" not in line]  # no progress bars
            stopped = "stopped; the same command resumes the run from what was saved last"
            assert process.returncode == 1 and set(said) == {stopped}, said
