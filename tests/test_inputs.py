"""Bad input: one sentence on stderr, exit code 2, before the simulator starts, and nothing left behind."""

import fcntl
import json
import os
import pickle
import shutil
import subprocess
from collections.abc import Callable, Iterator
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
from conftest import run

NO_DRIVER = {"VK_DRIVER_FILES": "/nonexistent", "VK_ICD_FILENAMES": "/nonexistent"}


def refused(result: tuple[int, str, str], *words: str) -> None:
    """The run ended with exit code 2 and one sentence that holds the words."""
    code, out, err = result
    sentences = [line for line in err.splitlines() if line.startswith("error: ")]
    assert code == 2 and len(sentences) == 1 and "Traceback" not in err, out + err
    for word in words:
        assert word in sentences[0], sentences[0]


@pytest.mark.parametrize(
    "arguments, words",
    [
        (["--env-id", "RememberColour9-v0"], ["unknown task", "RememberColor9-v0"]),
        (["--num-workers", "3"], ["--num-workers 3", "256 episodes", "divisor"]),
        (["--env-id", "ShellGameTouch-v0"], ["'ycb'", "download_asset ycb"]),
        (["--device", "cuda"], ["no CUDA device", "--device cpu"]),
    ],
)
def test_arguments_of_the_simulator(tmp_path: Path, arguments: list[str], words: list[str]) -> None:
    refused(run("ppo_baseline", *arguments, cwd=tmp_path), *words)
    assert not list(tmp_path.glob("runs/*"))


def test_no_rendering_device(tmp_path: Path) -> None:
    refused(run("aib_repr", cwd=tmp_path, env=NO_DRIVER), "no rendering device", "mesa-vulkan-drivers")


def test_the_first_stage_that_fails_ends_the_chain(tmp_path: Path) -> None:
    refused(run("ppo_aib", "--env-id", "Nonsense-v0", cwd=tmp_path), "unknown task")
    assert not list(tmp_path.glob("runs/*"))


def test_other_arguments_in_an_existing_run(tmp_path: Path) -> None:
    folder = tmp_path / "runs" / "InterceptFast-v0__ppo_baseline__1"
    folder.mkdir(parents=True)
    (folder / "args.json").write_text(json.dumps({"env_id": "InterceptFast-v0", "gamma": 0.5}))
    (folder / "agent.pt").write_text("precious")
    refused(run("ppo_baseline", cwd=tmp_path), "gamma=0.5 there, 0.99 here", "--overwrite", "--exp-name")
    assert (folder / "agent.pt").read_text() == "precious"


# ---------------------------------------------------------------- files, on the toy task's stages

TOY = "ToyMemory-v0"
REPR, BELIEF = Path(f"runs/{TOY}__aib_repr__1"), Path(f"runs/{TOY}__aib_belief__1")
AGENT = Path(f"runs/{TOY}__ppo_baseline__1/agent.pt")
DATA = REPR / "dataset"


class Payload:
    """Unpickled, it leaves a file called executed."""

    def __reduce__(self) -> tuple:
        return (os.system, ("touch executed",))


def cut(path: Path) -> Callable[[], object]:
    return lambda: path.write_bytes(path.read_bytes()[: path.stat().st_size * 2 // 3])


def flip(path: Path, share: float = 0.5) -> Callable[[], object]:
    def damage() -> None:
        content = bytearray(path.read_bytes())
        content[int(len(content) * share)] ^= 0xFF
        path.write_bytes(bytes(content))

    return damage


def write(path: Path, content: bytes) -> Callable[[], object]:
    return lambda: path.write_bytes(content)


def change(path: Path, **values: object) -> Callable[[], object]:
    """Rewrite some entries of a .pt or .json file."""

    def damage() -> None:
        if path.suffix == ".pt":
            torch.save({**torch.load(path, weights_only=True), **values}, path)
        else:
            path.write_text(json.dumps({**json.loads(path.read_text()), **values}))

    return damage


def replace_array(name: str, array: np.ndarray) -> Callable[[], object]:
    return lambda: np.save(DATA / f"{name}.npy", array)


def other_camera(path: Path) -> None:
    config = torch.load(path, weights_only=True)["config"]
    change(path, config={**config, "image_shape": [8, 8, 3]})()


def code_in(path: Path) -> Callable[[], object]:
    return lambda: torch.save({"format": 1, "kind": "aib_belief", "x": Payload()}, path)


BELIEF_PT, REPR_PT, META = BELIEF / "belief.pt", REPR / "repr.pt", DATA / "meta.json"
STAGE_2 = dict(exp_name="again", num_updates=1)
PPO = dict(num_envs=4, total_timesteps=40)
LOOK = dict(evaluate=True, num_envs=4, num_eval_episodes=4, checkpoint=AGENT)
CASES = {  # name: (script, arguments, damage, words of the sentence)
    "no held-out share": (aib_repr, dict(val_share=0.0), None, ["--val-share 0.0", "try 0.05"]),
    "all held out": (aib_repr, dict(val_share=1.0), None, ["--val-share 1.0"]),
    "no episodes": (aib_repr, dict(num_episodes=0), None, ["--num-episodes 0", "at least 1"]),
    "negative rate": (ppo_baseline, dict(learning_rate=-1.0), None, ["--learning-rate -1.0"]),
    "rate not a number": (ppo_baseline, dict(learning_rate=float("nan")), None, ["--learning-rate nan"]),
    "no disk for it": (
        aib_repr,
        dict(exp_name="big", num_episodes=10**12, num_workers=1),
        None,
        ["GB are free", "--num-episodes"],
    ),
    "track without wandb": (ppo_baseline, dict(track=True), None, ["--track", "pip install wandb"]),
    "repr.pt cut short": (aib_belief, STAGE_2, cut(REPR_PT), ["repr.pt is damaged", "--overwrite"]),
    "repr.pt, a weight changed": (aib_belief, STAGE_2, flip(REPR_PT), ["repr.pt is damaged"]),
    "repr.pt, its head changed": (aib_belief, STAGE_2, flip(REPR_PT, 0), ["repr.pt is damaged"]),
    "repr.pt empty": (aib_belief, STAGE_2, write(REPR_PT, b""), ["repr.pt is damaged"]),
    "repr.pt from the future": (aib_belief, STAGE_2, change(REPR_PT, format=9), ["format 9"]),
    "repr.pt of another task": (aib_belief, STAGE_2, change(REPR_PT, env_id="X-v0"), ["--env-id X-v0"]),
    "repr.pt of another robot": (aib_belief, STAGE_2, change(REPR_PT, robot="panda"), ["--robot panda"]),
    "repr.pt of a trial": (aib_belief, STAGE_2, change(REPR_PT, quick=True), ["--quick", "no basis"]),
    "repr.pt of other episodes": (aib_belief, STAGE_2, change(REPR_PT, num_episodes=7), ["do not belong together"]),
    "repr.pt of other sizes": (aib_belief, STAGE_2, change(REPR_PT, state_dim=3), ["do not belong together"]),
    "named repr_dir missing": (aib_belief, {**STAGE_2, "repr_dir": Path("no")}, None, ["no/repr.pt does not exist"]),
    "code in repr.pt": (aib_belief, STAGE_2, code_in(REPR_PT), ["repr.pt is damaged"]),
    "images cut short": (aib_belief, STAGE_2, cut(DATA / "rgb.npy"), ["dataset is damaged", "--overwrite"]),
    "an array missing": (aib_belief, STAGE_2, (DATA / "cue.npy").unlink, ["dataset is damaged", "cue.npy"]),
    "meta.json broken": (aib_belief, STAGE_2, write(META, b"{"), ["dataset is damaged"]),
    "meta.json not ours": (aib_belief, STAGE_2, write(META, b"[]"), ["dataset is damaged"]),
    "dataset from the future": (aib_belief, STAGE_2, change(META, format=9), ["format 9"]),
    "dataset of another task": (aib_belief, STAGE_2, change(META, env_id="X-v0"), ["dataset", "--env-id X-v0"]),
    "dataset unfinished": (aib_belief, STAGE_2, change(META, episodes_done=5), ["do not belong together"]),
    "array of another type": (aib_belief, STAGE_2, replace_array("cue", np.zeros((20, 1))), ["cue.npy is not float32"]),
    "array of another shape": (
        *(aib_belief, STAGE_2, replace_array("rgb", np.zeros((20, 11, 8, 8, 3), np.uint8))),
        ["rgb.npy is not uint8"],
    ),
    "belief.pt cut short": (ppo_aib, PPO, cut(BELIEF_PT), ["belief.pt is damaged"]),
    "belief.pt, a weight changed": (ppo_aib, PPO, flip(BELIEF_PT), ["belief.pt is damaged"]),
    "belief.pt is a text": (ppo_aib, PPO, write(BELIEF_PT, b"hello"), ["belief.pt is damaged"]),
    "belief.pt is repr.pt": (ppo_aib, {**PPO, "belief": REPR_PT}, None, ["is a 'repr'", "not a 'aib_belief'"]),
    "belief.pt of Believer": (ppo_aib, PPO, change(BELIEF_PT, kind="believer_belief"), ["'believer_belief'"]),
    "belief.pt of another task": (ppo_aib, PPO, change(BELIEF_PT, env_id="X-v0"), ["--env-id X-v0"]),
    "belief.pt of another camera": (ppo_aib, PPO, lambda: other_camera(BELIEF_PT), ["images [8, 8, 3]"]),
    "belief.pt of a trial": (ppo_aib, PPO, change(BELIEF_PT, quick=True), ["no basis for a real run"]),
    "named belief missing": (ppo_aib, {**PPO, "belief": Path("no.pt")}, None, ["no.pt does not exist"]),
    "code in belief.pt": (ppo_aib, PPO, code_in(BELIEF_PT), ["belief.pt is damaged"]),
    "a bare pickle as belief.pt": (ppo_aib, PPO, write(BELIEF_PT, pickle.dumps(Payload())), ["belief.pt is damaged"]),
    "Believer on a damaged repr.pt": (ppo_believer, PPO, cut(REPR_PT), ["repr.pt is damaged"]),
    "agent.pt missing": (ppo_baseline, {**LOOK, "checkpoint": Path("no.pt")}, None, ["no.pt does not exist"]),
    "agent.pt of another script": (ppo_aib, LOOK, None, ["'ppo_baseline agent'", "not a 'ppo_aib agent'"]),
    "agent.pt cut short": (ppo_baseline, LOOK, cut(AGENT), ["agent.pt is damaged"]),
    "agent.pt from the future": (ppo_baseline, LOOK, change(AGENT, format=9), ["format 9"]),
    "agent.pt of another camera": (ppo_baseline, LOOK, change(AGENT, image_shape=[8, 8, 3]), ["[8, 8, 3]"]),
    "code in agent.pt": (ppo_baseline, LOOK, code_in(AGENT), ["agent.pt is damaged"]),
    "args.json broken": (ppo_baseline, PPO, write(AGENT.with_name("args.json"), b"{"), ["args.json is damaged"]),
    "runs is a file": (ppo_baseline, PPO, lambda: (shutil.rmtree("runs"), Path("runs").touch()), ["cannot be written"]),
}


@pytest.fixture
def folder(toy_stages: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder with copies of the toy task's stages and of a plain PPO agent, where the scripts play the toy task."""
    for module in (aib_repr, ppo_aib, ppo_believer, ppo_baseline):
        monkeypatch.setattr(module, "make_envs", toy.make_envs)
    shutil.copytree(toy_stages, tmp_path / "runs")
    monkeypatch.chdir(tmp_path)
    AGENT.parent.mkdir()
    agent = ppo_baseline.Agent([36, 36, 3], 3, 2)
    content = {"kind": "ppo_baseline agent", "env_id": TOY, "robot": "panda_wristcam", "image_shape": [36, 36, 3]}
    ppo_baseline.save(AGENT, {**content, "agent": agent.state_dict()})
    yield tmp_path


def snapshot(folder: Path) -> dict[Path, bytes]:
    """Every file of the folder."""
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("name", CASES)
def test_bad_files_and_arguments(folder: Path, capfd: pytest.CaptureFixture, name: str) -> None:
    module, arguments, damage, words = CASES[name]
    if damage:
        damage()
    before = snapshot(folder)
    with pytest.raises(SystemExit) as stop:
        module.main(module.Args(env_id=TOY, **arguments))
    out, err = capfd.readouterr()
    refused((stop.value.code, out, err), *words)
    after = snapshot(folder)
    assert {path: after.get(path) for path in before} == before, "nothing is overwritten"
    assert not (folder / "executed").exists(), "no code of a file runs"


def test_table_of_bad_inputs_is_long_enough() -> None:
    assert len(CASES) >= 30


def test_a_second_process_is_refused(folder: Path, capfd: pytest.CaptureFixture) -> None:
    with open(AGENT.parent / "lock", "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        with pytest.raises(SystemExit) as stop:
            ppo_baseline.main(ppo_baseline.Args(env_id=TOY, **PPO))
    refused((stop.value.code, *capfd.readouterr()), "another process is working in")


def test_a_folder_that_cannot_be_written() -> None:
    """Even root may not make a folder in /sys."""
    refused(run("ppo_baseline", cwd=Path("/sys")), "cannot be written", "where you may write")


def test_a_full_disk_leaves_the_last_good_files(
    folder: Path,
    tmp_path_factory: pytest.TempPathFactory,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture,
) -> None:
    small = tmp_path_factory.mktemp("small")
    mounted = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=6m", "tmpfs", small], capture_output=True)
    if mounted.returncode:
        pytest.skip("a small file system cannot be mounted here")
    try:
        monkeypatch.chdir(small)
        arguments = dict(
            env_id=TOY, num_envs=4, total_timesteps=80, num_eval_episodes=4, eval_every=1, num_minibatches=2
        )
        with pytest.raises(SystemExit) as stop:
            ppo_baseline.main(ppo_baseline.Args(**arguments, checkpoint_minutes=0.0))
        refused((stop.value.code, *capfd.readouterr()), "could not be written", "No space left")
        left = {path.name for path in small.rglob("*") if path.is_file()}
        assert not [name for name in left if name.endswith(".part")]
        for path in small.rglob("*.pt"):
            torch.load(path, weights_only=True)
    finally:
        monkeypatch.chdir(folder)
        subprocess.run(["umount", small], check=True)


@pytest.mark.parametrize("where", ["weights", "loss"])
def test_numbers_that_are_not_finite_end_the_run(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture, where: str
) -> None:
    arguments = dict(env_id=TOY, num_envs=4, total_timesteps=120, eval_every=9, num_eval_episodes=4, num_minibatches=2)
    losses, calls = ppo_baseline.ppo_losses, []

    def poisoned(agent: torch.nn.Module, batch: dict, args: object) -> dict:
        calls.append(1)
        result = losses(agent, batch, args)
        if len(calls) == 7:  # in the second of three iterations
            result["value_loss" if where == "loss" else "total"] *= float("nan")
        return result

    monkeypatch.setattr(ppo_baseline, "ppo_losses", poisoned)
    with pytest.raises(SystemExit) as stop:
        ppo_baseline.main(ppo_baseline.Args(**arguments, checkpoint_minutes=0.0))
    err = capfd.readouterr().err
    assert stop.value.code == 1 and "is nan at a PPO update" in err and "the last checkpoint is kept" in err
    checkpoint = torch.load(AGENT.with_name("checkpoint.pt"), weights_only=True)
    assert checkpoint["iteration"] == 1
    assert all(torch.isfinite(value).all() for value in checkpoint["agent"].values())
