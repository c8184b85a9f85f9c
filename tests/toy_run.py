"""Run scripts' mains on the toy task, each in a process of its own, and kill it outright at a chosen moment.

python tests/toy_run.py reads lines [folder, script, arguments, "MOMENT:COUNT" or ""] as JSON and answers each with an
exit code. At the COUNT-th call of MOMENT (a function of the script, os.replace, torch.save or env.step) the process
gets SIGKILL, as from a scheduler that has lost patience. The processes are forked from this one, as imports take longer
than they do.
"""

import importlib
import json
import os
import signal
import sys
from collections.abc import Callable
from pathlib import Path

import torch

sys.path.insert(0, str(Path(__file__).parent.parent))
import toy  # noqa: E402


def deadly(function: Callable, count: int) -> Callable:
    """The function, but its count-th call kills this process."""
    calls = 0

    def wrapped(*args: object, **kwargs: object) -> object:
        nonlocal calls
        calls += 1
        if calls == count:
            os.kill(os.getpid(), signal.SIGKILL)
        return function(*args, **kwargs)

    return wrapped


def play(script: str, arguments: dict, moment: str) -> None:
    """Run a script's main on the toy task; with a moment, up to it."""
    module = importlib.import_module(script)
    toy.take_the_simulators_place(setattr, module)
    module.VAL_EVERY = 2  # of the scripts that train a belief
    if moment:
        path, count = moment.split(":")
        owner = {"os": os, "torch": torch, "env": toy.ToyMemory}.get(path.split(".")[0], module)
        name = path.split(".")[-1]
        setattr(owner, name, deadly(getattr(owner, name), int(count)))
    module.main(module.Args(env_id="ToyMemory-v0", **arguments))


def main() -> None:
    """See the module's docstring."""
    for name in ("torch._dynamo", "aib_repr", "aib_belief", "ppo_aib", "ppo_believer", "ppo_baseline"):
        importlib.import_module(name)  # torch.optim would import torch._dynamo
    for line in sys.stdin:
        folder, *order = json.loads(line)
        process = os.fork()
        if not process:
            os.chdir(folder)
            os.dup2(os.open(os.devnull, os.O_RDWR), sys.stdout.fileno())
            play(*order)
            return
        print(os.waitstatus_to_exitcode(os.waitpid(process, 0)[1]), flush=True)


if __name__ == "__main__":
    main()
