"""What does each belief remember? Stages 1 and 2 with --small: action heads, ablations, Believer's belief, one task.

All are trained for the same number of updates on the same data by the scripts themselves, and read from their
diagnostics.json. The same command resumes what is unfinished.

Usage:   python benchmark/belief.py                                  (RememberColor3-v0, `make bench-belief`)
         python benchmark/belief.py --env-id InterceptFast-v0 --num-episodes 2000 --num-updates 1200 --seeds 1 2 3
"""

import json
import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import report
import torch
import tyro

ROOT = Path(__file__).parent.parent
sys.path.insert(0, str(ROOT))
import aib_belief  # noqa: E402
import ppo_believer  # noqa: E402

ROWS = {  # arguments of aib_belief.py
    "flow": [],
    "samples": ["--fm-latent", "sample"],
    "images_only": ["--no-history-joints"],
    "mse": ["--action-head", "mse"],
    "none": ["--action-head", "none"],
    "plain": ["--image-norm", "none", "--no-chrono-init", "--bptt-steps", "16"],
}


@dataclass
class Args:
    env_id: str = "RememberColor3-v0"
    """MIKASA-Robo task"""
    rows: list[str] = field(default_factory=lambda: ["flow", "none", "believer"])
    """which beliefs, of flow, samples, images_only, mse, none, plain, believer"""
    seeds: list[int] = field(default_factory=lambda: [1])
    """seeds, each with a dataset and a state encoder of its own"""
    num_episodes: int = 640
    """random episodes"""
    num_updates: int = 600
    """updates of each belief"""


def run(script: str, words: list[str]) -> None:
    """Run one of the scripts with its progress showing."""
    code = subprocess.run([sys.executable, str(ROOT / script), *words]).returncode
    if code:
        sys.exit(code)


def train_and_probe_believer(args: ppo_believer.Args) -> None:
    """Train Believer's belief where it is missing; writes the diagnostics.json that aib_belief.py writes of its own."""
    path = ppo_believer.check_run(args)
    episodes, stored = ppo_believer.load_episodes(args)
    ppo_believer.open_run(path, args)
    if not (path / "belief.pt").exists():
        ppo_believer.train_belief(args, path, episodes, stored)
    belief = ppo_believer.BelieverBelief(ppo_believer.load(path / "belief.pt", "")["config"])
    belief.prior = lambda h: torch.distributions.Normal(torch.zeros(*h.shape[:-1], args.z_dim), 1.0)
    posterior = ppo_believer.GaussianMLP(stored["u_dim"] + 256, [256, 256], args.z_dim, min_std=0.1)
    model = torch.nn.ModuleDict({"belief": belief, "posterior": posterior})
    model.load_state_dict(ppo_believer.load(path / "belief_checkpoint.pt", "")["model"])
    model.to(args.device)
    held_out = np.arange(args.num_episodes)[-stored["num_val"] :]
    fit_on, test_on = np.split(held_out, [len(held_out) - len(held_out) // 2])  # as in aib_belief.main
    fit, test = (aib_belief.encode(belief, posterior, episodes, index) for index in (fit_on, test_on))
    ppo_believer.save(path / "diagnostics.json", json.dumps(aib_belief.probe_belief(fit, test), indent=2).encode())


def main(args: Args) -> None:
    """Run what is missing and print the table."""
    repr_dir = "runs/{env_id}__aib_repr_compared__{seed}"
    for seed in args.seeds:
        base = ["--env-id", args.env_id, "--seed", str(seed), "--small", "--num-episodes", str(args.num_episodes)]
        run("aib_repr.py", [*base, "--exp-name", "aib_repr_compared"])
        base += ["--repr-dir", repr_dir, "--num-updates", str(args.num_updates)]
        for row in args.rows:
            if row != "believer":
                run("aib_belief.py", [*base, "--exp-name", f"aib_belief_{row}", *ROWS[row]])
        if "believer" in args.rows:
            given = dict(env_id=args.env_id, seed=seed, small=True, exp_name="ppo_believer_compared")
            given |= dict(repr_dir=repr_dir, num_episodes=args.num_episodes, num_updates=args.num_updates)
            train_and_probe_believer(ppo_believer.Args(**(ppo_believer.SMALL | given)))
    print(report.own_beliefs(report.belief_rows(Path("runs"), ""), args.env_id))


if __name__ == "__main__":
    main(tyro.cli(Args))
