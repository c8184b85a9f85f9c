"""What the tests share: the five scripts as modules, a command line, and one small real run of everything."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

import aib_belief
import aib_repr
import toy

ROOT = Path(__file__).parent.parent
SCRIPTS = ("aib_repr", "aib_belief", "ppo_aib", "ppo_believer", "ppo_baseline")
os.environ["TQDM_MININTERVAL"] = "30"


def run(script: str, *arguments: str, cwd: Path, env: dict | None = None, timeout: float = 600) -> tuple[int, str, str]:
    """Run a script as a user would; exit code, stdout, stderr."""
    command = [sys.executable, str(ROOT / f"{script}.py"), *arguments]
    done = subprocess.run(
        command, cwd=cwd, env={**os.environ, **(env or {})}, capture_output=True, text=True, timeout=timeout
    )
    return done.returncode, done.stdout, done.stderr


@pytest.fixture(scope="session")
def quick_runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder in which the quick runs of all three methods on a real task were made, from nothing."""
    folder = tmp_path_factory.mktemp("quick")
    for script in ("ppo_aib", "ppo_believer", "ppo_baseline"):
        code, out, err = run(script, "--env-id", "RememberShapeAndColor3x2-v0", "--quick", cwd=folder)
        assert code == 0, out + err
        assert "mean nothing" in out
    return folder


@pytest.fixture(scope="session")
def toy_stages(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A runs folder with a barely trained stage 1 and stage 2 of the toy task."""
    folder = tmp_path_factory.mktemp("stages")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setattr(aib_repr, "make_envs", toy.make_envs)
        aib_repr.main(aib_repr.Args(env_id="ToyMemory-v0", num_episodes=20, epochs=1, batch_size=50))
        aib_belief.main(aib_belief.Args(env_id="ToyMemory-v0", num_updates=3, batch_episodes=4))
    return folder / "runs"
