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

    monkeypatch.setattr(aib_repr.sapien.physx, "enable_gpu", enable_gpu)
    with pytest.raises(SystemExit) as stop:
        aib_repr.check_task(aib_repr.Args(sim_backend="physx_cuda", robot_triangles=0))
    refused((stop.value.code, *capsys.readouterr()), "physx_cuda does not start", "libcuda.so", "docs/experiments.md")


def test_physx_is_downloaded_by_one_process_at_a_time(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def enable_gpu() -> None:
        with open(tmp_path / ".sapien_physx.lock") as other, pytest.raises(BlockingIOError):
            fcntl.flock(other, fcntl.LOCK_EX | fcntl.LOCK_NB)
        started.append(1)

    started = []
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setattr(aib_repr.sapien.physx, "enable_gpu", enable_gpu)
    aib_repr.check_task(aib_repr.Args(sim_backend="physx_cuda", robot_triangles=0))
    assert started


def test_the_gpus_physics_with_the_cpus_pictures(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    for module in SCRIPTS.values():
        monkeypatch.setattr(module, "CUDA", True)
        monkeypatch.setattr(sys, "argv", ["script", "--sim-backend", "physx_cuda", "--render-backend", "sapien_cpu"])
        with pytest.raises(SystemExit) as stop:
            module.parse_args()
        refused((stop.value.code, *capsys.readouterr()), "physx_cuda needs --render-backend sapien_cuda")


def test_a_folder_that_cannot_be_written() -> None:
    """Even root may not make a folder in /sys."""
    refused(run("ppo_baseline", cwd=Path("/sys")), "cannot be written")


@pytest.mark.parametrize(
    "script, arguments, words",
    [
        ("aib_repr", ["--num-episodes", "0"], ["--num-episodes 0", "at least 1"]),
        ("aib_belief", ["--belief-lr", "-1"], ["--belief-lr -1.0", "at least 0"]),
        ("ppo_aib", ["--learning-rate", "nan"], ["--learning-rate nan"]),
        ("ppo_believer", ["--eval-every", "0"], ["--eval-every 0"]),
        ("ppo_baseline", ["--seed", "-1"], ["--seed -1"]),
        ("ppo_baseline", ["--init-std", "0"], ["--init-std 0.0", "at least 0.001"]),
        ("ppo_baseline", ["--init-std", "0"], ["--init-std 0.0", "at least 0.001"]),
        ("ppo_baseline", ["--noise-beta", "-0.1"], ["--noise-beta -0.1", "between 0 and 2"]),
        ("ppo_baseline", ["--num-eval-episodes", "1"], ["--num-eval-episodes 1 must be at least 2"]),
        ("ppo_aib", ["--noise-beta", "2.5"], ["--noise-beta 2.5", "between 0 and 2"]),
        ("ppo_believer", ["--noise-beta", "nan"], ["--noise-beta nan"]),
        ("ppo_baseline", ["--gamma", "1.5"], ["--gamma 1.5", "between 0 and 1"]),
        ("ppo_aib", ["--small", "--quick"], ["--small and --quick exclude each other"]),
        ("ppo_baseline", ["--exp-name", "a/b"], ["--exp-name a/b", "without /"]),
        ("ppo_aib", ["--image-size", "32"], ["--image-size 32", "at least 36"]),
        ("aib_belief", ["--image-mask", "1.5"], ["--image-mask 1.5", "between 0 and 1"]),
        ("aib_repr", ["--val-fraction", "1.5"], ["--val-fraction 1.5", "between 0 and 1"]),
        ("ppo_believer", ["--num-minibatches", "0"], ["--num-minibatches 0", "at least 1"]),
        (
            "ppo_aib",
            ["--belief", "runs/{env}__aib_belief__1/belief.pt"],
            ["--belief runs/{env}__", "{env_id} and {seed}"],
        ),
        ("ppo_aib", ["--exp-name", "{seed}"], ["--exp-name {seed}", "without / and braces"]),
        ("aib_belief", ["--repr-dir", "runs/{"], ["--repr-dir runs/{ has braces"]),
        ("ppo_aib", ["--belief", "{seed.x}"], ["--belief {seed.x} has braces"]),
        ("ppo_baseline", ["--device", "cuda"], ["no CUDA device", "--device cpu"]),
    ],
)
def test_numbers_and_devices(
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


def test_more_minibatches_than_steps(toy_task: Path, capsys: pytest.CaptureFixture) -> None:
    with pytest.raises(SystemExit) as stop:
        train(ppo_baseline, num_envs=2, num_minibatches=21)
    refused((stop.value.code, *capsys.readouterr()), "--num-minibatches 21", "at most the 20 steps")
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


def write(path: Path, content: bytes) -> Callable[[], object]:
    return lambda: path.write_bytes(content)


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


STAGE_1 = dict(num_episodes=20, val_fraction=0.25, epochs=1, batch_size=50)
STAGE_2 = dict(exp_name="again", num_updates=1)
PPO = dict(num_envs=4, total_timesteps=40, num_eval_episodes=4, num_minibatches=2)
ONLY_EVALUATE = dict(evaluate=True, num_envs=4, num_eval_episodes=4, checkpoint=str(AGENT))
CASES = {  # name: (script, arguments, damage, words of the sentence)
    "nothing held out": (aib_repr, dict(val_fraction=0.0), None, ["--val-fraction 0.0", "--num-episodes"]),
    "all held out": (aib_repr, dict(val_fraction=1.0), None, ["--val-fraction 1.0"]),
    "dataset of another format": (aib_repr, STAGE_1, other_dataset(format=9), ["has format 9", "--overwrite"]),
    "dataset of more episodes": (aib_repr, STAGE_1, other_dataset(num_episodes=30), ["has num_episodes 30"]),
    "repr.pt cut short": (aib_belief, STAGE_2, cut(REPR_PT), ["repr.pt is damaged", "--overwrite"]),
    "repr.pt of another task": (aib_belief, STAGE_2, change(REPR_PT, env_id="X-v0"), ["has env_id X-v0"]),
    "repr.pt of fewer episodes": (
        aib_belief,
        {**STAGE_2, "num_episodes": 30},
        None,
        ["has num_episodes 20"],
    ),
    "belief.pt of fewer episodes": (ppo_aib, {**PPO, "num_episodes": 30}, None, ["belief.pt has num_episodes 20"]),
    "repr.pt of other meshes": (aib_belief, STAGE_2, change(REPR_PT, robot_triangles=0), ["has robot_triangles 0"]),
    "repr.pt of other pictures": (aib_belief, STAGE_2, change(REPR_PT, image_size=64), ["has image_size 64"]),
    "named repr_dir missing": (aib_belief, {**STAGE_2, "repr_dir": "no"}, None, ["no/repr.pt does not exist"]),
    "images cut short": (aib_belief, STAGE_2, cut(DATA / "rgb.npy"), ["dataset is damaged", "--overwrite"]),
    "an array missing": (aib_belief, STAGE_2, (DATA / "cue.npy").unlink, ["dataset is damaged", "cue.npy"]),
    "an array is a text": (aib_belief, STAGE_2, write(DATA / "state.npy", b"hello"), ["dataset is damaged"]),
    "belief.pt cut short": (ppo_aib, PPO, cut(BELIEF_PT), ["belief.pt is damaged", "aib_belief.py"]),
    "belief.pt is repr.pt": (ppo_aib, {**PPO, "belief": str(REPR_PT)}, None, ["has kind repr", "needs aib_belief"]),
    "belief.pt of Believer": (ppo_aib, PPO, change(BELIEF_PT, kind="believer_belief"), ["has kind believer_belief"]),
    "belief.pt of another task": (ppo_aib, PPO, change(BELIEF_PT, env_id="X-v0"), ["has env_id X-v0"]),
    "named belief missing": (ppo_aib, {**PPO, "belief": "no.pt"}, None, ["no.pt does not exist"]),
    "Believer on a damaged repr.pt": (ppo_believer, PPO, cut(REPR_PT), ["repr.pt is damaged"]),
    "agent.pt missing": (ppo_baseline, {**ONLY_EVALUATE, "checkpoint": "no.pt"}, None, ["no.pt does not exist"]),
    "agent.pt of another script": (ppo_aib, ONLY_EVALUATE, None, ["ppo_baseline agent", "needs ppo_aib agent"]),
    "agent.pt cut short": (ppo_baseline, ONLY_EVALUATE, cut(AGENT), ["agent.pt is damaged"]),
    "checkpoint.pt cut short": (ppo_baseline, PPO, cut(CHECKPOINT), ["checkpoint.pt is damaged"]),
    "other arguments": (ppo_baseline, {**PPO, "gamma": 0.5}, None, ["gamma=0.99 there, 0.5 here", "--exp-name"]),
    "run of another script": (ppo_baseline, PPO, rewrite_args(belief="x.pt"), ["belief=x.pt there, None here"]),
    "killed while it was deleted": (
        ppo_baseline,
        PPO,
        write(AGENT.with_name("args.json"), b"{}"),
        ["is half deleted", "--overwrite"],
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
    sizes = {} if module is ppo_baseline else {"num_episodes": 20}
    capfd.readouterr()
    with pytest.raises(SystemExit) as stop:
        train(module, **{**sizes, **arguments})
    out, err = capfd.readouterr()
    refused((stop.value.code, out, err), *words)
    after = snapshot(folder)
    assert {path: after.get(path) for path in before} == before, "nothing is overwritten"


@pytest.mark.parametrize(
    "content, words",
    [
        (b"", ["is damaged"]),
        (b"hello", ["is damaged"]),
        (pickle.dumps(Payload()), ["is damaged"]),
        ({"format": ppo_baseline.FORMAT, "kind": "x", "code": Payload()}, ["is damaged"]),
        ({"format": 99, "kind": "y"}, ["has format 99"]),
        ({"format": ppo_baseline.FORMAT, "kind": "y"}, ["has kind y, this run needs x"]),
        ([1, 2], ["is damaged"]),
    ],
)
def test_what_load_refuses(tmp_path: Path, capsys: pytest.CaptureFixture, content: object, words: list[str]) -> None:
    file = tmp_path / "file.pt"
    if isinstance(content, bytes):
        file.write_bytes(content)
    else:
        torch.save(content, file)
    with pytest.raises(SystemExit) as stop:
        ppo_baseline.load(file, "recreate it", kind="x")
    refused((stop.value.code, *capsys.readouterr()), "file.pt", "recreate it", *words)
    assert not Path("executed").exists(), "no code of a file runs"


def test_a_second_process_is_refused(toy_task: Path, capfd: pytest.CaptureFixture) -> None:
    AGENT.parent.mkdir(parents=True)
    lock = os.open(AGENT.parent, os.O_RDONLY)
    fcntl.flock(lock, fcntl.LOCK_EX)
    with pytest.raises(SystemExit) as stop:
        train(ppo_baseline, **PPO)
    os.close(lock)
    refused((stop.value.code, *capfd.readouterr()), "is another process's")


def test_a_run_does_not_go_on_with_another_input(folder: Path, capfd: pytest.CaptureFixture) -> None:
    """Stopped runs whose earlier stage was made anew in the meantime."""
    train(ppo_aib, **PPO, num_episodes=20)
    change(Path(f"runs/{TOY}__ppo_aib__1/checkpoint.pt"), iteration=0)()
    weights = torch.load(BELIEF_PT, weights_only=True)["belief"]
    retrained = {name: 1.01 * x for name, x in weights.items()}
    for other in (retrained, weights | {"history.gru.bias": torch.zeros(768)}):  # another GRU
        change(BELIEF_PT, belief=other)()
        with pytest.raises(SystemExit) as stop:
            train(ppo_aib, **PPO, num_episodes=20)
        refused((stop.value.code, *capfd.readouterr()), "began with another belief", "--overwrite")
    BELIEF_PT.unlink()
    with pytest.raises(SystemExit) as stop:
        train(ppo_aib, **PPO, num_episodes=20)
    refused((stop.value.code, *capfd.readouterr()), "belief.pt does not exist")
    change(REPR_PT, seed=2)()
    with pytest.raises(SystemExit) as stop:
        train(aib_belief, num_episodes=20, num_updates=3, batch_episodes=4)
    refused((stop.value.code, *capfd.readouterr()), "has repr_crc", "--overwrite")


@pytest.mark.parametrize(
    "script, wrong, words",
    [
        ("aib_repr", dict(val_fraction=0.0), ["--val-fraction 0.0"]),
        ("aib_repr", dict(num_episodes=10**10), ["more than the disk has", "--num-episodes"]),
        ("aib_belief", dict(repr_dir="nope"), ["nope/repr.pt does not exist"]),
        ("ppo_aib", dict(belief="nope.pt"), ["nope.pt does not exist"]),
        ("ppo_believer", dict(repr_dir="nope"), ["nope/repr.pt does not exist"]),
        ("aib_belief", dict(small=True), ["__aib_repr__1/repr.pt does not exist"]),  # --small makes aib_repr_small
        ("ppo_aib", dict(small=True), ["__aib_belief__1/belief.pt does not exist"]),
        ("ppo_baseline", dict(env_id="ToyMemoryy-v0"), ["ToyMemoryy-v0 is no task"]),
    ],
)
def test_overwrite_deletes_nothing_before_the_inputs_are_read(
    toy_task: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture,
    script: str,
    wrong: dict,
    words: list[str],
) -> None:
    module = SCRIPTS[script]
    if script == "ppo_baseline":
        monkeypatch.setattr(module, "check_task", CHECK_TASK)
    args = module.Args(**{"env_id": TOY, **wrong}, overwrite=True)
    path = Path("runs") / f"{args.env_id}__{args.exp_name}__{args.seed}"
    for existing in (False, True):
        if existing:
            path.mkdir(parents=True)
            (path / "agent.pt").write_bytes(b"days of work")
        with pytest.raises(SystemExit) as stop:
            module.main(args)
        refused((stop.value.code, *capfd.readouterr()), *words)
        assert (path / "agent.pt").exists() if existing else not Path("runs").exists()


def test_overwrite_starts_again(folder: Path) -> None:
    leftover = AGENT.parent / "videos" / "old.mp4"
    leftover.write_text("old")
    elsewhere = folder / "elsewhere"
    elsewhere.mkdir()
    AGENT.with_name("linked").symlink_to(elsewhere)
    train(ppo_baseline, **{**PPO, "gamma": 0.5, "overwrite": True})
    assert not leftover.exists() and not AGENT.with_name("linked").exists() and elsewhere.exists()
    assert json.loads((AGENT.parent / "args.json").read_text())["gamma"] == 0.5


def test_nothing_half_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A write that breaks off, as on a full disk, leaves the old file whole."""
    file = tmp_path / "x.pt"
    ppo_baseline.save(file, {"kind": "x", "value": 1})

    def full_disk(content: dict, path: Path) -> None:
        path.write_bytes(b"half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(torch, "save", full_disk)
    with pytest.raises(OSError):
        ppo_baseline.save(file, {"kind": "x", "value": 2})
    assert ppo_baseline.load(file, "", kind="x")["value"] == 1


def test_a_loss_that_is_not_finite_ends_the_run(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    losses, calls = ppo_baseline.ppo_losses, []

    def poisoned(*args: object) -> dict:
        calls.append(1)
        result = losses(*args)
        result["total"] = result["total"] * (float("nan") if len(calls) == 6 else 1)  # in the second iteration
        return result

    monkeypatch.setattr(ppo_baseline, "ppo_losses", poisoned)
    with pytest.raises(RuntimeError, match="non-finite"):
        train(ppo_baseline, **{**PPO, "total_timesteps": 120, "overwrite": True, "target_kl": 1e9})
    checkpoint = torch.load(CHECKPOINT, weights_only=True)
    assert checkpoint["iteration"] == 1
    assert all(np.isfinite(value).all() for value in checkpoint["agent"].values())
