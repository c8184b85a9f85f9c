"""The paper's experiments as plain commands: 4 tasks x 3 methods x 3 seeds, and the ablations on InterceptFast-v0.

Three phases, each built on the one before: stage 1, the beliefs, PPO. A command that was stopped goes on, and one that
is finished does nothing.

Usage:   python benchmark/experiments.py             (print the commands)
         python benchmark/experiments.py | bash -e   (run them here, one after another)
         bash benchmark/slurm.sh                     (submit them to SLURM)
"""

import shlex
from dataclasses import dataclass
from typing import Literal

import tyro

PAPER_TASKS = ("RememberShapeAndColor3x2-v0", "RememberColor9-v0", "InterceptMedium-v0", "InterceptFast-v0")
ABLATIONS = {  # variants of aib_belief.py on InterceptFast-v0: Figures 3 and 4
    "mse": ["--action-head", "mse"],
    "none": ["--action-head", "none"],
    "lambda_0.1": ["--action-lambda", "0.1"],
    "lambda_0.01": ["--action-lambda", "0.01"],
}


@dataclass
class Args:
    tasks: tuple[str, ...] = PAPER_TASKS
    """tasks of the main experiment"""
    seeds: tuple[int, ...] = (1, 2, 3)
    """seeds of every experiment"""
    ablations: bool = True
    """also the action heads and loss weights on InterceptFast-v0"""
    small: bool = False
    """with the scripts' --small, on any tasks, without ablations"""
    phase: Literal[1, 2, 3] | None = None
    """only this phase"""


def commands(args: Args) -> dict[int, list[list[str]]]:
    """The commands of each phase, as lists of words after `python`."""
    phases = {1: [], 2: [], 3: []}
    size = ["--small"] if args.small else []
    for task in args.tasks:
        for seed in args.seeds:
            run = ["--env-id", task, "--seed", str(seed), *size]
            phases[1].append(["aib_repr.py", *run])
            phases[2].append(["aib_belief.py", *run])
            phases[3] += [[f"{script}.py", *run] for script in ("ppo_aib", "ppo_believer", "ppo_baseline")]
    if args.ablations and not size and "InterceptFast-v0" in args.tasks:
        for name, change in ABLATIONS.items():
            for seed in args.seeds:
                run = ["--env-id", "InterceptFast-v0", "--seed", str(seed)]
                belief = f"runs/InterceptFast-v0__aib_belief_{name}__{seed}/belief.pt"
                phases[2].append(["aib_belief.py", *run, "--exp-name", f"aib_belief_{name}", *change])
                phases[3].append(["ppo_aib.py", *run, "--exp-name", f"ppo_aib_{name}", "--belief", belief])
    return phases


if __name__ == "__main__":
    args = tyro.cli(Args)
    for phase, todo in commands(args).items():
        if args.phase in (None, phase):
            for words in todo:
                print(shlex.join([".venv/bin/python", *words]))
