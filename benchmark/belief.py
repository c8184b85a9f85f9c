"""What does each belief remember? Stages 1 and 2 with --small: action heads, ablations, Believer's belief, one task.

All are trained for the same number of updates on the same data by the scripts themselves, and read from their
diagnostics.json. The same command resumes what is unfinished.

Usage:   python benchmark/belief.py                                  (RememberColor3-v0, `make bench-belief`)
         python benchmark/belief.py --env-id InterceptFast-v0 --num-episodes 2000 --num-updates 1200 --seeds 1 2 3
"""

import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path

import report
import tyro

ROOT = Path(__file__).parent.parent
ROWS = {  # arguments of aib_belief.py
    "flow": [],
    "samples": ["--fm-latent", "sample"],
    "images_only": ["--no-history-joints"],
    "mse": ["--action-head", "mse"],
    "none": ["--action-head", "none"],
    "plain": ["--image-norm", "none", "--no-chrono-init", "--bptt-steps", "16"],
    "believer": [],
}
BELIEVER = """
import json, sys
import numpy as np, torch
import aib_belief, ppo_believer as b
args = b.parse_args()
path = b.check_run(args)
episodes, stored = b.load_episodes(args)
b.open_run(path, args)
if not (path / "belief.pt").exists():
    b.train_belief(args, path, episodes, stored)
belief = b.BelieverBelief(b.load(path / "belief.pt", "")["config"])
belief.prior = lambda h: torch.distributions.Normal(torch.zeros(*h.shape[:-1], args.z_dim), 1.0)
posterior = b.GaussianMLP(stored["u_dim"] + 256, [256, 256], args.z_dim, min_std=0.1)
model = torch.nn.ModuleDict({"belief": belief, "posterior": posterior})
model.load_state_dict(b.load(path / "belief_checkpoint.pt", "")["model"])
held_out = np.arange(args.num_episodes)[-stored["num_val"]:]
halves = np.split(held_out, [len(held_out) - len(held_out) // 2])  # as in aib_belief.main
fit, test = (aib_belief.encode(model.to(args.device)["belief"], posterior, episodes, half) for half in halves)
b.save(path / "diagnostics.json", json.dumps(aib_belief.probe_belief(fit, test), indent=2).encode())
"""


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


def run(command: list[str]) -> None:
    """Run a command with its progress showing."""
    code = subprocess.run([sys.executable, *command]).returncode
    if code:
        sys.exit(code)


def main(args: Args) -> None:
    """Run what is missing and print the table."""
    for seed in args.seeds:
        base = ["--env-id", args.env_id, "--seed", str(seed), "--small", "--num-episodes", str(args.num_episodes)]
        run([str(ROOT / "aib_repr.py"), *base, "--exp-name", "aib_repr_compared"])
        base += ["--repr-dir", "runs/{env_id}__aib_repr_compared__{seed}", "--num-updates", str(args.num_updates)]
        for row in args.rows:
            if row == "believer":
                script = ["-c", f"import sys; sys.path.insert(0, {str(ROOT)!r}){BELIEVER}"]
                run([*script, *base, "--exp-name", "ppo_believer_compared"])
            else:
                run([str(ROOT / "aib_belief.py"), *base, "--exp-name", f"aib_belief_{row}", *ROWS[row]])
    print(report.own_beliefs(report.belief_rows(Path("runs"), ""), args.env_id))


if __name__ == "__main__":
    main(tyro.cli(Args))
