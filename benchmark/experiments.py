"""The paper's experiments as plain commands: 4 tasks x 3 methods x 3 seeds, and the ablations on InterceptFast-v0.

Three phases, each built on the one before: stage 1, the beliefs, PPO. Every command is one a person could type; a
command that was stopped goes on, and one that is finished does nothing.

Usage:   python benchmark/experiments.py --dry-run             (print the commands)
         python benchmark/experiments.py                       (run them here, one after another)
         bash benchmark/slurm.sh                               (submit them to SLURM)
         python benchmark/experiments.py --phase 3 --index 5   (run one, as the job array does)
"""

import shlex
import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path

import tyro

ROOT = Path(__file__).parent.parent
ABLATIONS = {  # variants of aib_belief.py on InterceptFast-v0: Figures 3 and 4
    "mse": ["--action-head", "mse"],
    "none": ["--action-head", "none"],
    "lambda_0.1": ["--action-lambda", "0.1"],
    "lambda_0.01": ["--action-lambda", "0.01"],
}


@dataclass
class Args:
    tasks: list[str] = field(
        default_factory=lambda: [
            "RememberShapeAndColor3x2-v0",
            "RememberColor9-v0",
            "InterceptMedium-v0",
            "InterceptFast-v0",
        ]
    )
    """tasks of the main experiment"""
    seeds: list[int] = field(default_factory=lambda: [1, 2, 3])
    """seeds of every experiment"""
    ablations: bool = True
    """also the action heads and loss weights on InterceptFast-v0"""
    small: bool = False
    """with the scripts' --small, on any tasks, without ablations"""
    quick: bool = False
    """with the scripts' --quick, likewise"""
    dry_run: bool = False
    """only print the commands"""
    phase: int | None = None
    """only this phase: 1, 2 or 3"""
    index: int | None = None
    """only this command of the phase"""


def commands(args: Args) -> dict[int, list[list[str]]]:
    """The commands of each phase, as lists of words after `python`."""
    phases = {1: [], 2: [], 3: []}
    size = []
    if args.small:
        size.append("--small")
    if args.quick:
        size.append("--quick")
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


def main(args: Args) -> None:
    """Print or run the chosen commands; stops at the first that fails."""
    for phase, todo in commands(args).items():
        if args.phase in (None, phase):
            for words in todo if args.index is None else [todo[args.index]]:
                print(shlex.join(["python", *words]), flush=True)
                if not args.dry_run:
                    code = subprocess.run([sys.executable, str(ROOT / words[0]), *words[1:]]).returncode
                    if code:
                        sys.exit(code)


if __name__ == "__main__":
    main(tyro.cli(Args))
