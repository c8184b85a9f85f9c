"""Does the belief remember? Stage 1 and 2 with their ablations and Believer's belief on one task, and stage 2's speed.

Every row is trained for the same number of updates on the same data by the scripts themselves, and read from their
diagnostics.json. Runs are kept in runs/*bench*: the same command goes on with what is unfinished.

Usage:   python benchmark/belief.py                                  (RememberColor3-v0, `make bench-belief`)
         python benchmark/belief.py --env-id InterceptFast-v0 --rows flow "flow lambda 0.1" "flow lambda 10"
"""

import ctypes
import json
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
import aib_belief  # noqa: E402
from per_step_loop import PerStepHistory  # noqa: E402

ROWS = {
    "flow": [],
    "mse": ["--action-head", "mse"],
    "none": ["--action-head", "none"],
    "plain": ["--image-norm", "none", "--no-chrono-init", "--bptt-steps", "16"],
    "believer": [],
    "flow lambda 0.1": ["--action-lambda", "0.1"],
    "flow lambda 10": ["--action-lambda", "10"],
    "flow joints": ["--history-joints"],
}
BELIEVER = """
import ppo_believer as b
args = b.parse_args({}, {}, {})
path = b.open_run(args)
if not (path / "belief.pt").exists():
    b.train_belief(args, path)
"""


@dataclass
class Args:
    env_id: str = "RememberColor3-v0"
    """MIKASA-Robo task"""
    rows: list[str] = field(default_factory=lambda: ["flow", "mse", "none", "plain", "believer"])
    """which rows of the table"""
    robot: str = "panda_wristcam"
    """robot of the scripts"""
    num_episodes: int = 320
    """episodes of the random policy, a tenth of them held out"""
    epochs: int = 13
    """of stage 1, in updates of 100 transitions: some 2,200 updates on 320 episodes of 60 steps"""
    num_updates: int = 240
    """of stage 2"""
    batch_episodes: int = 16
    """whole episodes per update of stage 2"""
    belief_lr: float = 1e-3
    """learning rate of stage 2"""
    speed: bool = True
    """compare stage 2's update with a per-step GRUCell loop"""


def run(command: list[str]) -> float:
    """Run a command with its progress showing; returns the seconds it took."""
    start = time.time()
    code = subprocess.run([sys.executable, *command]).returncode
    if code:
        sys.exit(code)
    return time.time() - start


def speed(device: torch.device) -> str:
    """One line: stage 2's update against the per-step loop on the same model and batch, as ratios of medians."""
    episodes, steps = (256, 90) if device.type == "cuda" else (8, 60)
    config = {"image_shape": [128, 128, 3], "joints_dim": 0, "action_dim": 0, "gru_layers": 1, "u_dim": 16, "z_dim": 32}
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
    whole, per_step = model["belief"].history, PerStepHistory(model["belief"].history).to(device)
    variants = {"per-step loop": (per_step, False), "whole float32": (whole, False), "whole bfloat16": (whole, True)}
    seconds = {name: [] for name in variants}
    for repeat in range(6):
        for name, (history, amp) in variants.items():
            model["belief"].history, whole.cnn.amp = history, amp
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
    base = ["--env-id", args.env_id, "--robot", args.robot]
    repr_dir = Path("runs") / f"{args.env_id}__bench_repr__1"
    sizes = ["--num-episodes", str(args.num_episodes), "--val-share", "0.1", "--epochs", str(args.epochs)]
    sizes += ["--batch-size", "100", "--learning-rate", "1e-3"]
    took = {"stage 1": run([str(ROOT / "aib_repr.py"), *base, "--exp-name", "bench_repr", *sizes, "--num-envs", "20"])}
    updates = ["--repr-dir", str(repr_dir), "--num-updates", str(args.num_updates)]
    updates += ["--batch-episodes", str(args.batch_episodes), "--belief-lr", str(args.belief_lr)]
    reports = {}
    for row in args.rows:
        name = "bench_" + row.replace(" ", "_")
        script = ["-c", f"import sys; sys.path.insert(0, {str(ROOT)!r}){BELIEVER}"]
        script = script if row == "believer" else [str(ROOT / "aib_belief.py")]
        took[row] = run([*script, *base, "--exp-name", name, *updates, *ROWS[row]])
        path = Path("runs") / f"{args.env_id}__{name}__1"
        reports[row] = json.loads((path / "diagnostics.json").read_text())
    stage1 = json.loads((repr_dir / "diagnostics.json").read_text())
    last = len(reports[args.rows[0]]["u_r2_prior"]) - 2
    steps = [4, 9, 30, last]
    device = "cuda" if torch.cuda.is_available() else "cpu"
    print(f"\n{args.env_id}, {args.robot}, {args.num_episodes} episodes (a tenth held out), {args.num_updates}")
    print(f"updates of {args.batch_episodes} episodes, torch {torch.__version__} on {device}")
    print("stage 1: " + ", ".join(f"{name} {value:.3f}" for name, value in stage1.items()))
    print(f"cue read-out: chance {reports[args.rows[0]]['cue_chance']:.3f}; steps {steps}\n")
    columns = [
        "cue from h",
        "cue from particle",
        "R2 of u, prior",
        "nll prior",
        "nll posterior",
        "action R2",
        "flow gain",
    ]
    print("| belief | " + " | ".join(columns) + " | seconds |\n|" + "---|" * (len(columns) + 2))
    for row, report in reports.items():
        cells = [
            " ".join(f"{report[key][t]:.2f}" for t in steps)
            for key in ("cue_from_h", "cue_from_particle", "u_r2_prior")
        ]
        cells += [f"{report[key]:.2f}" for key in ("nll_prior", "nll_posterior")]
        cells += [f"{report['action_readout']:.3f}", f"{report['flow_gain']:.3f}" if "flow_gain" in report else "-"]
        print(f"| {row} | " + " | ".join(cells) + f" | {took[row]:.0f} |")
    ceiling = " ".join(f"{reports[args.rows[0]]['cue_from_u'][t]:.2f}" for t in steps)
    print(f"\nceiling, cue from u: {ceiling}; stage 1 took {took['stage 1']:.0f} s (0 to a few: it was there already)")
    if args.speed:
        print(speed(torch.device(device)))


if __name__ == "__main__":
    main(tyro.cli(Args))
