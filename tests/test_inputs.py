"""Bad input: one sentence on stderr, exit code 2, before the simulator starts, and nothing left behind."""

import json
from pathlib import Path

import pytest

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
