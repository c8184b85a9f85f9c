"""Does the belief remember? Stage 1 and 2 with --small, ablations and Believer's belief on one task; stage 2's speed.

Every row is trained for the same number of updates on the same data by the scripts themselves, and read from their
diagnostics.json. The same command goes on with what is unfinished.

Usage:   python benchmark/belief.py                                  (RememberColor3-v0, `make bench-belief`)
         python benchmark/belief.py --env-id InterceptFast-v0 --more-data --rows flow mse none believer --seeds 1 2 3
"""

import ctypes
import statistics
import subprocess
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path

import torch
import torch.nn as nn
import tyro

ROOT = Path(__file__).parent.parent
sys.path += [str(ROOT), str(ROOT / "tests")]
import report  # noqa: E402

import aib_belief  # noqa: E402
from per_step_loop import encode_history_per_step  # noqa: E402

ROWS = {  # what follows --small
    "flow": [],
    "flow, samples": ["--fm-latent", "sample"],
    "flow, images only": ["--no-history-joints"],
    "flow, lambda 0.1": ["--action-lambda", "0.1"],
    "flow, lambda 10": ["--action-lambda", "10"],
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
    """which rows of the table"""
    seeds: list[int] = field(default_factory=lambda: [1])
    """seeds, each with a dataset and a state encoder of its own"""
    more_data: bool = False
    """2,000 episodes and 1,200 updates in place of --small's 640 and 600"""
    speed: bool = True
    """compare stage 2's update with a per-step GRUCell loop"""


def run(command: list[str]) -> None:
    """Run a command with its progress showing."""
    code = subprocess.run([sys.executable, *command]).returncode
    if code:
        sys.exit(code)


def speed(device: torch.device) -> str:
    """One line: stage 2's update against the per-step loop on the same model and batch, as ratios of medians."""
    episodes, steps = (256, 90) if device.type == "cuda" else (8, 60)
    config = {"image_shape": [128, 128, 3], "joints_dim": 0, "gru_layers": 1, "u_dim": 16, "z_dim": 32}
    model = nn.ModuleDict({"belief": aib_belief.AIBBelief(config)})
    model["posterior"] = aib_belief.GaussianMLP(16 + 256, [256, 256], 32, min_std=0.1)
    model["head"] = aib_belief.mlp([2 * 32 + 8 + 1, 256, 8])
    ctypes.CDLL(None).mallopt(-4, 0)  # M_MMAP_MAX: as in aib_belief.main
    ctypes.CDLL(None).mallopt(-1, 2**31 - 1)  # M_TRIM_THRESHOLD: likewise
    model.to(device)
    optimizer = torch.optim.Adam(model.parameters(), lr=3e-4, fused=True)
    batch = {"rgb": torch.randint(0, 256, (steps + 1, episodes, 128, 128, 3), dtype=torch.uint8, device=device)}
    batch |= {"u": torch.randn(steps + 1, episodes, 16, device=device)}
    batch |= {"actions": torch.rand(steps, episodes, 8, device=device) * 2 - 1}
    batch["joints"] = torch.zeros(steps + 1, episodes, 25, device=device)
    whole, per_step = aib_belief.encode_history, encode_history_per_step
    variants = {"per-step loop": (per_step, False), "whole float32": (whole, False), "whole bfloat16": (whole, True)}
    seconds = {name: [] for name in variants}
    for repeat in range(6):
        for name, (encode_history, amp) in variants.items():
            aib_belief.encode_history, model["belief"].history.cnn.amp = encode_history, amp
            start = time.time()
            loss = aib_belief.belief_losses(model, batch, aib_belief.Args())["total"]
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            loss.item()  # waits for a GPU
            if repeat:
                seconds[name].append(time.time() - start)
    base = statistics.median(seconds["per-step loop"])
    ratios = ", ".join(f"{name} {base / statistics.median(seconds[name]):.2f} x" for name in list(variants)[1:])
    return f"stage-2 update, {episodes} episodes x {steps} steps, against a per-step loop in float32: {ratios}"


def main(args: Args) -> None:
    """Run what is missing and print the table."""
    for seed in args.seeds:
        base = ["--env-id", args.env_id, "--seed", str(seed), "--small"]
        stage_1, stage_2 = [], []
        if args.more_data:
            base += ["--num-episodes", "2000"]
            stage_1 = ["--exp-name", "aib_repr_small_2000", "--epochs", "3"]
            stage_2 = ["--repr-dir", "runs/{env_id}__aib_repr_small_2000__{seed}", "--num-updates", "1200"]
        run([str(ROOT / "aib_repr.py"), *base, *stage_1])
        for row in args.rows:
            name = "aib_belief_small" + "".join(f"_{word.strip(',')}" for word in row.split() if row != "flow")
            name = "ppo_believer_small" if row == "believer" else name
            name += "_2000" * args.more_data
            script = ["-c", f"import sys; sys.path.insert(0, {str(ROOT)!r}){BELIEVER}"]
            script = script if row == "believer" else [str(ROOT / "aib_belief.py")]
            run([*script, *base, *stage_2, "--exp-name", name, *ROWS[row]])
    print(report.own_beliefs(report.belief_rows(Path("runs"), ""), args.env_id))
    device = "cuda" if torch.cuda.is_available() else "cpu"
    if args.speed:
        print(speed(torch.device(device)))


if __name__ == "__main__":
    main(tyro.cli(Args))
