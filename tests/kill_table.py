"""Kill every stage at many moments, let it go on, and compare with a run that was never interrupted: test_resume.py."""

import json
import subprocess
import sys
from functools import cache
from pathlib import Path

import numpy as np
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

ROOT = Path(__file__).parent.parent
PPO = dict(num_envs=8, num_minibatches=4, eval_every=1, num_eval_episodes=4, num_workers=3)
SIZES = {
    "aib_repr": dict(num_episodes=12, epochs=3, batch_size=30, num_workers=2),
    "aib_belief": dict(warmup_updates=2, num_updates=4, batch_episodes=4, prior_nll=1.0),
    "ppo_aib": dict(total_timesteps=240, **PPO),
    "ppo_believer": dict(
        total_timesteps=160,
        warmup_updates=2,
        num_updates=2,
        batch_episodes=4,
        **PPO,
    ),
    "ppo_baseline": dict(total_timesteps=240, **PPO),
}
KILLS = [  # script, what it was doing, the moment
    ("aib_repr", "collecting, first round", "env.step:5"),
    ("aib_repr", "collecting, third round", "env.step:27"),
    ("aib_repr", "renaming meta.json", "os.replace:4"),
    ("aib_repr", "stage 1, first update", "repr_losses:1"),
    ("aib_repr", "stage 1, in the second epoch", "repr_losses:6"),
    ("aib_repr", "stage 1, held-out losses", "repr_losses:4"),
    ("aib_repr", "renaming a checkpoint", "os.replace:9"),
    ("aib_belief", "stage 2, first update", "warmup_loss:1"),
    ("aib_belief", "stage 2, between checkpoints", "belief_losses:2"),
    ("aib_belief", "stage 2, held-out look", "validate_belief:2"),
    ("aib_belief", "writing a checkpoint", "torch.save:2"),
    ("aib_belief", "renaming belief.pt", "os.replace:5"),
    ("ppo_aib", "PPO, evaluation", "env.step:45"),
    ("ppo_aib", "PPO, update", "ppo_losses:11"),
    ("ppo_aib", "PPO, second rollout", "env.step:64"),
    ("ppo_aib", "PPO, making a video", "make_video:2"),
    ("ppo_aib", "PPO, writing agent.pt", "torch.save:3"),
    ("ppo_aib", "PPO, renaming eval.csv", "os.replace:6"),
    ("ppo_believer", "Believer, its belief", "believer_losses:1"),
    ("ppo_believer", "Believer, PPO update", "ppo_losses:9"),
    ("ppo_baseline", "plain PPO, writing the first checkpoint, after agent.pt", "torch.save:2"),
    ("ppo_baseline", "plain PPO, second rollout", "env.step:62"),
]


@cache
def server() -> subprocess.Popen:
    """The process that starts processes; it ends with the tests."""
    pipes = dict(stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
    return subprocess.Popen([sys.executable, str(ROOT / "tests" / "toy_run.py")], **pipes)


def start(script: str, folder: Path, moment: str = "") -> int:
    """Run a script on the toy task in folder, to be killed at a moment; the exit code."""
    print(json.dumps([str(folder), script, SIZES[script], moment]), file=server().stdin, flush=True)
    return int(server().stdout.readline())


def results(folder: Path) -> dict[str, object]:
    """All that a finished run must repeat to the last bit: weights, evaluations, dataset."""
    found = {}
    for file in sorted(folder.rglob("*")):
        name = str(file.relative_to(folder))
        if file.suffix == ".npy":
            found[name] = np.load(file).tobytes()
        elif file.suffix == ".csv" or file.name in ("diagnostics.json", "meta.json"):
            found[name] = file.read_bytes()
        elif file.suffix == ".pt":
            found[name] = flatten(torch.load(file, weights_only=True))
    return found


def flatten(x: object) -> object:
    """Nested dictionaries and lists with tensors as bytes, so that == compares them exactly."""
    if isinstance(x, dict):
        return {name: flatten(value) for name, value in x.items()}
    if isinstance(x, list):
        return [flatten(value) for value in x]
    return x.numpy().tobytes() if isinstance(x, torch.Tensor) else x


def curves(folder: Path) -> dict[str, list]:
    """TensorBoard's curves as (step, value), without those that measure time; each step must be there once."""
    found = {}
    for part in (folder, folder / "belief_events"):  # Believer's belief has its own
        events = EventAccumulator(str(part)).Reload() if part.exists() else None
        for tag in events.Tags()["scalars"] if events else ():
            if not tag.startswith("charts/"):
                found[tag] = [(row.step, repr(row.value)) for row in events.Scalars(tag)]  # nan too is equal to nan
                if tag.endswith("by_step"):  # of the finished belief, and by time step: a killed run writes it again
                    found[tag] = sorted({*found[tag]})
    return found


def readable(folder: Path) -> bool:
    """Whether every file of the folder that has its final name can be read."""
    for file in folder.rglob("*"):
        if file.suffix == ".pt":
            torch.load(file, weights_only=True)
        elif file.suffix == ".json":
            json.loads(file.read_text())
        elif file.suffix == ".csv":
            assert len({line.count(",") for line in file.read_text().splitlines()}) == 1
    return True


def make_reference(folder: Path, scripts: set[str]) -> None:
    """Run the scripts without interruption, the earlier stages first."""
    for script in SIZES:
        if script in scripts or script in ("aib_repr", "aib_belief"):
            assert start(script, folder) == 0, script


def kill_and_go_on(script: str, moment: str, reference: Path, folder: Path) -> dict[str, bool]:
    """Kill a script at a moment, look at its files, run it again, compare with the reference."""
    needs = {"aib_belief": "aib_repr", "ppo_aib": "aib_belief", "ppo_believer": "aib_repr"}
    (folder / "runs").mkdir()
    if script in needs:
        stage = Path("runs") / f"ToyMemory-v0__{needs[script]}__1"
        (folder / stage).symlink_to(reference / stage)
    killed = start(script, folder, moment) == -9
    run = Path("runs") / f"ToyMemory-v0__{script}__1"
    whole = readable(folder / run)
    finished = start(script, folder) == 0
    same = finished and results(folder / run) == results(reference / run)
    row = {"killed": killed, "files whole": whole, "finished": finished, "bit-identical": same}
    return row | {"same curves": finished and curves(folder / run) == curves(reference / run)}
