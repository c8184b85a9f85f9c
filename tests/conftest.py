"""What the tests share: a command line, the toy task in the simulator's place, and one small real run of everything."""

import os

os.environ["CUDA_VISIBLE_DEVICES"] = ""  # the tests are for the CPU, where runs repeat to the last bit
import subprocess
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
import torch

import aib_belief
import aib_repr
import ppo_aib
import ppo_baseline
import ppo_believer
import toy

ROOT = Path(__file__).parent.parent
SCRIPTS = {module.__name__: module for module in (aib_repr, aib_belief, ppo_aib, ppo_believer, ppo_baseline)}
TASK, TOY = "RememberColor9-v0", "ToyMemory-v0"
ONE_ITERATION = ["--total-timesteps", "120"]  # of PPO with --quick
os.environ["TQDM_MININTERVAL"] = "30"
if "PYTEST_XDIST_WORKER" in os.environ:  # a core for each process
    torch.set_num_threads(1)
    os.environ["OMP_NUM_THREADS"] = "1"


def run(script: str, *arguments: str, cwd: Path, env: dict | None = None, timeout: float = 600) -> tuple[int, str, str]:
    """Run a script as a user would; exit code, stdout, stderr."""
    # a warning on account of a script's own line is an error
    command = [sys.executable, "-W", "error:::__main__", str(ROOT / f"{script}.py"), *arguments]
    done = subprocess.run(
        command, cwd=cwd, env={**os.environ, **(env or {})}, capture_output=True, text=True, timeout=timeout
    )
    return done.returncode, done.stdout, done.stderr


@pytest.fixture(scope="session")
def quick_runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The runs folder of --quick runs of all three methods on a real task, made from nothing."""
    folder = tmp_path_factory.mktemp("quick")
    for script in ("ppo_aib", "ppo_believer", "ppo_baseline"):
        code, out, err = run(script, "--env-id", TASK, "--quick", *ONE_ITERATION, cwd=folder)
        assert code == 0, out + err
    return folder / "runs"


@pytest.fixture(scope="session")
def toy_stages(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A runs folder with a barely trained stage 1 and stage 2 of the toy task."""
    folder = tmp_path_factory.mktemp("stages")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        toy.take_the_simulators_place(patch.setattr, aib_repr)
        aib_repr.main(aib_repr.Args(env_id=TOY, num_episodes=20, epochs=1, batch_size=50))
        aib_belief.main(aib_belief.Args(env_id=TOY, num_updates=3, batch_episodes=4))
    return folder / "runs"


@pytest.fixture
def toy_task(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """Let every script play the toy task, in a folder of its own."""
    for module in SCRIPTS.values():
        toy.take_the_simulators_place(monkeypatch.setattr, module)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def spaces(image_shape: list[int], joints_dim: int, action_dim: int) -> SimpleNamespace:
    """What an agent wants to know of its environments."""
    rgb = gym.spaces.Box(0, 255, image_shape, np.uint8)
    joints = gym.spaces.Box(-np.inf, np.inf, (joints_dim,), np.float32)
    return SimpleNamespace(
        single_observation_space={"rgb": rgb, "joints": joints},
        single_action_space=gym.spaces.Box(-1, 1, (action_dim,), np.float32),
    )


def train(module: ModuleType, **arguments: object) -> Path:
    """Train, or with evaluate only evaluate, on the toy task; the run directory."""
    args = module.Args(env_id=TOY, **arguments)
    if arguments.get("evaluate"):
        module.evaluate_checkpoint(args)
    else:
        module.main(args)
    return Path("runs") / f"{TOY}__{args.exp_name}__{args.seed}"
