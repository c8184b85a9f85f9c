"""Run one script's main on the toy task in a process of its own, and kill it outright at a chosen moment.

python tests/toy_run.py SCRIPT 'JSON of arguments' [MOMENT:COUNT]: at the COUNT-th call of MOMENT (a function of the
script, os.replace, torch.save or env.step) the process gets SIGKILL, as from a scheduler that has lost patience.
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


def main() -> None:
    """See the module's docstring."""
    script, arguments = sys.argv[1], json.loads(sys.argv[2])
    module = importlib.import_module(script)
    toy.take_the_simulators_place(setattr, module)
    if len(sys.argv) > 3:
        moment, count = sys.argv[3].split(":")
        owner = {"os": os, "torch": torch, "env": toy.ToyMemory}.get(moment.split(".")[0], module)
        name = moment.split(".")[-1]
        setattr(owner, name, deadly(getattr(owner, name), int(count)))
    module.main(module.Args(env_id="ToyMemory-v0", **arguments))


if __name__ == "__main__":
    main()
