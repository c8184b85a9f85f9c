"""Bad input: one sentence on stderr, exit code 2, before anything slow starts, and nothing overwritten."""

import fcntl
import json
import os
import pickle
import shutil
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

import aib_belief
import aib_repr
import ppo_aib
import ppo_baseline
import ppo_believer
import toy
from conftest import SCRIPTS, TOY, run, train

CHECK_TASK = ppo_baseline.check_task  # the real one, which the toy task does without
NO_DRIVER = {"VK_DRIVER_FILES": "/nonexistent", "VK_ICD_FILENAMES": "/nonexistent"}


def refused(result: tuple[int, str, str], *words: str) -> None:
    """The run ended with exit code 2 and one sentence that holds the words."""
    code, out, err = result
    sentences = [line for line in err.splitlines() if line.startswith("error: ")]
    assert code == 2 and len(sentences) == 1 and "Traceback" not in err, out + err
    for word in words:
        assert word in sentences[0], sentences[0]


@pytest.mark.parametrize(
    "script, arguments, words",
    [
        (
            "ppo_aib",
            ["--env-id", "RememberColour9-v0"],
            ["RememberColour9-v0 is no task", "choose one of RememberColor9-v0"],
        ),
        ("ppo_baseline", ["--env-id", "ShellGameTouch-v0"], ["needs an asset", "download_asset ycb"]),
    ],
)
def test_tasks(tmp_path: Path, script: str, arguments: list[str], words: list[str]) -> None:
    refused(run(script, *arguments, cwd=tmp_path), *words)
    assert not list(tmp_path.iterdir())


def test_no_rendering_device(tmp_path: Path) -> None:
    refused(run("aib_repr", cwd=tmp_path, env=NO_DRIVER), "sapien_cpu or physx_cpu does not start", "experiments.md")
    assert not list(tmp_path.iterdir())


def test_physx_without_its_library(capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch) -> None:
    def enable_gpu() -> None:
        raise OSError("libcuda.so: cannot open shared object file")

    monkeypatch.setattr(aib_repr, "CUDA", True)
    monkeypatch.setattr(aib_repr.sapien.render, "RenderSystem", lambda _: None)
    monkeypatch.setattr(aib_repr.sapien, "Device", str)
    monkeypatch.setattr(aib_repr.sapien.physx, "enable_gpu", enable_gpu)
    with pytest.raises(SystemExit) as stop:
        aib_repr.check_task(aib_repr.Args(sim_backend="physx_cuda", render_backend="sapien_cuda", robot_triangles=0))
    refused((stop.value.code, *capsys.readouterr()), "physx_cuda does not start", "libcuda.so", "docs/experiments.md")


def test_physx_is_downloaded_by_one_process_at_a_time(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def enable_gpu() -> None:
        with open(tmp_path / ".sapien_physx.lock") as other, pytest.raises(BlockingIOError):
            fcntl.flock(other, fcntl.LOCK_EX | fcntl.LOCK_NB)
        started.append(1)

    started = []
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setattr(aib_repr, "CUDA", True)
    monkeypatch.setattr(aib_repr.sapien.render, "RenderSystem", lambda _: None)
    monkeypatch.setattr(aib_repr.sapien, "Device", str)
    monkeypatch.setattr(aib_repr.sapien.physx, "enable_gpu", enable_gpu)
    aib_repr.check_task(aib_repr.Args(sim_backend="physx_cuda", render_backend="sapien_cuda", robot_triangles=0))
    assert started


@pytest.mark.parametrize("script", ["aib_belief", "ppo_believer"])
@pytest.mark.parametrize(
    "wrong, words", [(dict(batch_episodes=0), "--batch-episodes 0"), (dict(image_mask=1.0), "1.0")]
)
def test_no_episodes_or_no_pictures(capsys: pytest.CaptureFixture, script: str, wrong: dict, words: str) -> None:
    with pytest.raises(SystemExit) as stop:
        SCRIPTS[script].load_episodes(SCRIPTS[script].Args(**wrong))
    refused((stop.value.code, *capsys.readouterr()), words, "--image-mask")


def test_what_the_gpus_physics_cannot_draw(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture) -> None:
    for module in (aib_repr, ppo_aib, ppo_believer, ppo_baseline):
        monkeypatch.setattr(module, "CUDA", True)
        with pytest.raises(SystemExit) as stop:
            module.check_task(module.Args(sim_backend="physx_cuda", render_backend="sapien_cpu"))
        refused((stop.value.code, *capsys.readouterr()), "physx_cuda needs --render-backend sapien_cuda")
        with pytest.raises(SystemExit) as stop:
            module.check_task(module.Args(sim_backend="physx_cuda", render_backend="sapien_cuda", robot_triangles=500))
        refused((stop.value.code, *capsys.readouterr()), "physx_cuda needs --robot-triangles 0, not 500")


def test_a_folder_that_cannot_be_written() -> None:
    """Even root may not make a folder in /sys."""
    refused(run("ppo_baseline", cwd=Path("/sys")), "cannot be written")


@pytest.mark.parametrize(
    "script, arguments, words",
    [
        ("aib_repr", ["--num-episodes", "-1"], ["--num-episodes -1 must not be negative"]),
        ("aib_belief", ["--belief-lr", "-1"], ["--belief-lr -1.0 must not be negative"]),
        ("ppo_aib", ["--learning-rate", "nan"], ["--learning-rate nan"]),
        ("ppo_baseline", ["--seed", "-1"], ["--seed -1"]),
        ("ppo_aib", ["--small", "--quick"], ["--small and --quick exclude each other"]),
        ("ppo_baseline", ["--exp-name", "a/b"], ["--exp-name a/b", "without /"]),
    ],
)
def test_numbers(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture,
    script: str,
    arguments: list[str],
    words: list[str],
) -> None:
    monkeypatch.setattr(sys, "argv", [script, *arguments])
    with pytest.raises(SystemExit) as stop:
        SCRIPTS[script].parse_args()
    refused((stop.value.code, *capsys.readouterr()), *words)


@pytest.mark.parametrize(
    "wrong, words",
    [
        (dict(num_minibatches=21), ["--num-minibatches 21", "at most the 20 steps"]),
        (dict(gamma=1.5, num_minibatches=2), ["--gamma 1.5", "at most 1"]),
        (dict(eval_every=0), ["--eval-every", "at least 1"]),
        (dict(image_size=32), ["--image-size 32", "at least 36"]),
        (dict(device="cuda"), ["no CUDA device", "--device cpu"]),
    ],
)
def test_what_would_fail_late(
    toy_task: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, wrong: dict, words: list[str]
) -> None:
    if wrong.keys() & {"image_size", "device"}:
        monkeypatch.setattr(ppo_baseline, "check_task", CHECK_TASK)
    with pytest.raises(SystemExit) as stop:
        train(ppo_baseline, num_envs=2, **wrong)
    refused((stop.value.code, *capsys.readouterr()), *words)
    assert not list(toy_task.iterdir())


# ---------------------------------------------------------------- files, on the toy task's stages

REPR, BELIEF = Path(f"runs/{TOY}__aib_repr__1"), Path(f"runs/{TOY}__aib_belief__1")
AGENT, CHECKPOINT = (Path(f"runs/{TOY}__ppo_baseline__1") / name for name in ("agent.pt", "checkpoint.pt"))
DATA, REPR_PT, BELIEF_PT = REPR / "dataset", REPR / "repr.pt", BELIEF / "belief.pt"


class Payload:
    """Unpickled, it leaves a file called executed."""

    def __reduce__(self) -> tuple:
        return (os.system, ("touch executed",))


def cut(path: Path) -> Callable[[], object]:
    return lambda: path.write_bytes(path.read_bytes()[: path.stat().st_size * 2 // 3])


def change(path: Path, **values: object) -> Callable[[], object]:
    """Rewrite some entries of a .pt file."""
    return lambda: torch.save({**torch.load(path, weights_only=True), **values}, path)


def other_dataset(**values: object) -> Callable[[], object]:
    """A dataset with other entries in its meta.json, on which stage 1 has still to be trained."""

    def damage() -> None:
        REPR_PT.unlink()
        meta = json.loads((DATA / "meta.json").read_text())
        (DATA / "meta.json").write_text(json.dumps({**meta, **values}))

    return damage


def rewrite_args(**values: object) -> Callable[[], object]:
    """Other entries in the args.json of plain PPO's run."""
    file = AGENT.with_name("args.json")
    return lambda: file.write_text(json.dumps({**json.loads(file.read_text()), **values}))


STAGE_1 = dict(num_episodes=20, epochs=1, batch_size=50)
STAGE_2 = dict(exp_name="again", num_updates=1)
PPO = dict(num_envs=4, total_timesteps=40, num_eval_episodes=4, num_minibatches=2)
ONLY_EVALUATE = dict(evaluate=True, num_envs=4, num_eval_episodes=4, checkpoint=str(AGENT))
CASES = {  # name: (script, arguments, damage, words of the sentence)
    "dataset of more episodes": (aib_repr, STAGE_1, other_dataset(num_episodes=30), ["has num_episodes 30"]),
    "repr.pt of another task": (aib_belief, STAGE_2, change(REPR_PT, env_id="X-v0"), ["has env_id X-v0"]),
    "named repr_dir missing": (
        aib_belief,
        {**STAGE_2, "repr_dir": "no"},
        None,
        ["no/repr.pt does not exist", "aib_repr.py --env-id"],
    ),
    "belief.pt of another task": (ppo_aib, PPO, change(BELIEF_PT, env_id="X-v0"), ["has env_id X-v0"]),
    "named belief missing": (ppo_aib, {**PPO, "belief": "no.pt"}, None, ["no.pt does not exist"]),
    "belief.pt of other meshes": (ppo_aib, PPO, change(BELIEF_PT, robot_triangles=0), ["has robot_triangles 0"]),
    "belief.pt of other pictures": (ppo_aib, {**PPO, "belief": str(BELIEF_PT), "image_size": 64}, None, ["image_size"]),
    "belief.pt of AIB for Believer": (ppo_believer, {**PPO, "belief": str(BELIEF_PT)}, None, ["has script aib_belief"]),
    "meta.json cut off": (
        aib_repr,
        STAGE_1,
        lambda: (REPR_PT.unlink(), cut(DATA / "meta.json")()),
        ["meta.json is damaged"],
    ),
    "args.json cut off": (ppo_baseline, PPO, cut(AGENT.with_name("args.json")), ["args.json is damaged"]),
    "checkpoint.pt cut off": (ppo_baseline, PPO, cut(CHECKPOINT), ["checkpoint.pt is damaged"]),
    "agent.pt missing": (ppo_baseline, {**ONLY_EVALUATE, "checkpoint": "no.pt"}, None, ["no.pt does not exist"]),
    "agent.pt of another script": (ppo_aib, ONLY_EVALUATE, None, ["has script ppo_baseline", "needs ppo_aib"]),
    "other arguments": (
        ppo_baseline,
        {**PPO, "gamma": 0.5},
        None,
        ["gamma=0.99 there, 0.5 here", "rm -r"],
    ),
    "runs is a file": (
        ppo_baseline,
        PPO,
        lambda: (shutil.rmtree("runs"), Path("runs").touch()),
        ["cannot be written", "Not a directory"],
    ),
}


@pytest.fixture(scope="module")
def runs(toy_stages: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Copies of the toy task's stages and a plain PPO run."""
    folder = tmp_path_factory.mktemp("runs")
    shutil.copytree(toy_stages, folder / "runs")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        toy.take_the_simulators_place(patch.setattr, ppo_baseline)
        train(ppo_baseline, **PPO)
    return folder / "runs"


@pytest.fixture
def folder(toy_task: Path, runs: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with runs to damage."""
    monkeypatch.setattr(fcntl, "flock", lambda *_: None)  # a lock ends with its process, and this one goes on
    shutil.copytree(runs, toy_task / "runs")
    return toy_task


def snapshot(folder: Path) -> dict[Path, bytes]:
    """Every file of the folder."""
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("name", CASES)
def test_bad_files_and_arguments(folder: Path, capfd: pytest.CaptureFixture, name: str) -> None:
    module, arguments, damage, words = CASES[name]
    if damage:
        damage()
    before = snapshot(folder)
    capfd.readouterr()
    with pytest.raises(SystemExit) as stop:
        train(module, **arguments)
    out, err = capfd.readouterr()
    refused((stop.value.code, out, err), *words)
    after = snapshot(folder)
    assert {path: after.get(path) for path in before} == before, "nothing is overwritten"


def test_no_code_of_a_file_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    torch.save({"env_id": TOY, "code": Payload()}, "file.pt")
    with pytest.raises(pickle.UnpicklingError):
        ppo_baseline.load(Path("file.pt"))
    assert not Path("executed").exists()


def test_a_second_process_is_refused(toy_task: Path, capfd: pytest.CaptureFixture) -> None:
    AGENT.parent.mkdir(parents=True)
    lock = os.open(AGENT.parent, os.O_RDONLY)
    fcntl.flock(lock, fcntl.LOCK_EX)
    with pytest.raises(SystemExit) as stop:
        train(ppo_baseline, **PPO)
    os.close(lock)
    refused((stop.value.code, *capfd.readouterr()), "is another process's")


@pytest.mark.parametrize(
    "script, wrong, words",
    [
        ("aib_belief", dict(repr_dir="nope"), ["nope/repr.pt does not exist"]),
        ("ppo_aib", dict(belief="nope.pt"), ["nope.pt does not exist"]),
        ("ppo_believer", dict(repr_dir="nope"), ["nope/repr.pt does not exist"]),
        ("aib_belief", dict(quick=True), ["__aib_repr_quick__1/repr.pt", "--seed 1 --quick"]),
    ],
)
def test_a_command_can_be_corrected(
    toy_task: Path, capfd: pytest.CaptureFixture, script: str, wrong: dict, words: list[str]
) -> None:
    with pytest.raises(SystemExit) as stop:
        train(SCRIPTS[script], **wrong)
    refused((stop.value.code, *capfd.readouterr()), *words)
    left = {path.name for path in toy_task.rglob("*") if path.is_file()}
    assert left <= {"args.json"}, "which alone does not bind the next run to its arguments"


def test_nothing_half_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture) -> None:
    """A write that breaks off, as on a full disk, leaves the old file whole."""
    file = tmp_path / "x.pt"
    ppo_baseline.save(file, {"value": 1})

    def full_disk(content: dict, path: Path) -> None:
        path.write_bytes(b"half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(torch, "save", full_disk)
    with pytest.raises(SystemExit) as stop:
        ppo_baseline.save(file, {"value": 2})
    refused((stop.value.code, *capsys.readouterr()), "x.pt cannot be written", "No space left", "MB are free")
    assert ppo_baseline.load(file)["value"] == 1 and list(tmp_path.iterdir()) == [file]


def test_a_loss_that_is_not_finite_ends_the_run(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    losses, calls = ppo_baseline.ppo_losses, []

    def poisoned(*args: object) -> dict:
        calls.append(1)
        result = losses(*args)
        result["total"] = result["total"] * (float("nan") if len(calls) == 6 else 1)  # in the second iteration
        return result

    monkeypatch.setattr(ppo_baseline, "ppo_losses", poisoned)
    with pytest.raises(RuntimeError, match="non-finite"):
        train(ppo_baseline, **{**PPO, "exp_name": "poisoned", "total_timesteps": 120, "target_kl": 1e9})
    checkpoint = torch.load(f"runs/{TOY}__poisoned__1/checkpoint.pt", weights_only=True)
    assert checkpoint["iteration"] == 1
    assert all(np.isfinite(value).all() for value in checkpoint["agent"].values())
