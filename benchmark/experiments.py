"""The paper's experiments as shell commands: 4 tasks x 3 methods x 3 seeds, and the ablations on InterceptFast-v0.

They come in blocks of one task and one seed: episodes, phi, a belief of AIB, PPO of three methods, tests of the agents.
All blocks of one seed come before those of the next, so that what has been run is a complete table of fewer seeds. A
command that was stopped goes on, and one that is finished does nothing.

Usage:   python benchmark/experiments.py             (print the commands)
         python benchmark/experiments.py | bash -e   (run them here, one after another)
         bash benchmark/slurm.sh                     (submit those of stages 1 to 3 to SLURM)
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import tyro

PAPER_TASKS = ("RememberShapeAndColor3x2-v0", "RememberColor9-v0", "InterceptMedium-v0", "InterceptFast-v0")
ABLATED = "InterceptFast-v0"
ABLATIONS = {  # variants of aib_belief.py on that task: Figures 3 and 4
    "none": "--action-head none",
    "mse": "--action-head mse",
    "lambda_0.1": "--action-lambda 0.1",
    "lambda_0.01": "--action-lambda 0.01",
}
METHODS = ("ppo_aib", "ppo_believer", "ppo_baseline")


@dataclass
class Args:
    tasks: tuple[str, ...] = PAPER_TASKS
    """tasks of the main experiment"""
    seeds: tuple[int, ...] = (1, 2, 3)
    """seeds of every experiment"""
    ablations: bool = True
    """also the action heads and loss weights on InterceptFast-v0, where it is among the tasks"""
    small: bool = False
    """with the scripts' --small, and plain PPO also with as many steps as AIB has with its random episodes"""
    delete_pictures: bool = False
    """delete a block's pictures, gigabytes, once its beliefs are trained and probed; not those that ablations need"""
    phase: Literal[1, 2, 3] | None = None
    """only the commands of this stage"""


def block(args: Args, task: str, seed: int) -> Iterator[tuple[int, str]]:
    """Stage (4: tests) and command of everything of one task and seed but the ablations."""
    preset, suffix = (" --small", "_small") if args.small else ("", "")
    run = f"--env-id {task} --seed {seed}{preset}"
    yield 1, f"aib_repr.py {run}"
    yield 2, f"aib_belief.py {run}"
    for method in METHODS:
        yield 3, f"{method}.py {run}"
        yield from tests(f"runs/{task}__{method}{suffix}__{seed}", f"{method}.py {run}")
    for script in ("aib_belief", "ppo_believer"):
        yield from probes(f"runs/{task}__{script}{suffix}__{seed}")
    if args.delete_pictures and not (args.ablations and task == ABLATED):
        yield 4, f"rm -f runs/{task}__aib_repr{suffix}__{seed}/dataset/rgb.npy"
    if args.small:
        own, equal = (f"runs/{task}__{name}__{seed}" for name in ("ppo_baseline_small", "ppo_baseline_equal"))
        more = 4000 * (90 if task.startswith("Intercept") else 60)  # steps of the random episodes
        longer = f"ppo_baseline.py {run} --exp-name ppo_baseline_equal --total-timesteps {240_000 + more}"
        kept = " ".join(f"{own}/{name}" for name in ("agent.pt", "eval.csv", "checkpoint.pt"))
        yield 4, f"[ -e {equal}/checkpoint.pt ] || {{ mkdir -p {equal} && cp {kept} {equal}/; }}"
        yield 3, longer
        yield from tests(equal, longer)


def ablations(args: Args, seed: int) -> Iterator[tuple[int, str]]:
    """Stage and command of AIB with other action heads and loss weights, on the episodes and phi of the block."""
    task, preset, suffix = (ABLATED, " --small", "_small") if args.small else (ABLATED, "", "")
    for name, change in ABLATIONS.items():
        run = f"--env-id {task} --seed {seed}{preset}"
        belief = f"runs/{task}__aib_belief{suffix}_{name}__{seed}"
        agent = f"ppo_aib.py {run} --exp-name ppo_aib{suffix}_{name} --belief {belief}/belief.pt"
        yield 2, f"aib_belief.py {run} --exp-name aib_belief{suffix}_{name} {change}"
        yield from probes(belief)
        yield 3, agent
        yield from tests(f"runs/{task}__ppo_aib{suffix}_{name}__{seed}", agent)


def tests(folder: str, command: str) -> Iterator[tuple[int, str]]:
    """The last agent on 256 test episodes, and what it makes of its belief."""
    yield 4, f"[ -e {folder}/evaluation.json ] || .venv/bin/python {command} --evaluate --num-eval-episodes 256"
    yield 4, diagnosis(folder, "diagnosis.json", "")
    if "ppo_baseline" not in command:
        yield 4, diagnosis(folder, "diagnosis_swapped.json", " --swap-particles")


def diagnosis(folder: str, file: str, flag: str) -> str:
    """The command that writes the file."""
    script = ".venv/bin/python benchmark/diagnose_agent.py"
    return f"[ -e {folder}/{file} ] || {script} --checkpoint {folder}/agent.pt{flag}"


def probes(folder: str) -> Iterator[tuple[int, str]]:
    """What the belief of a run knows of held-out episodes."""
    yield 4, f"[ -e {folder}/diagnostics.json ] || .venv/bin/python benchmark/belief.py --run {folder}"


def commands(args: Args) -> list[tuple[int, str]]:
    """Stage and command of everything, in order."""
    found = []
    for seed in args.seeds:
        for task in args.tasks:
            found += block(args, task, seed)
    if args.ablations and ABLATED in args.tasks:
        for seed in args.seeds:
            found += ablations(args, seed)
    return [(phase, line if line.startswith(("[", "rm")) else f".venv/bin/python {line}") for phase, line in found]


if __name__ == "__main__":
    args = tyro.cli(Args)
    for phase, line in commands(args):
        if args.phase in (None, phase):
            print(line)
