"""Does a belief trained on light pictures read the cue from stock pictures, and how well from its own?

Takes the belief of `aib_belief.py --small`, made first where it is missing, collects episodes of another seed twice,
with light and with untouched meshes, and fits the cue's read-out on light episodes the belief was not trained on.

Usage:   python benchmark/meshes.py
"""

import json
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import tyro

ROOT = Path(__file__).parent.parent
sys.path.append(str(ROOT))
import aib_belief  # noqa: E402


@dataclass
class Args:
    env_id: str = "RememberColor3-v0"
    """MIKASA-Robo task"""
    num_test: int = 64
    """episodes of either kind to test on"""


def run(*command: str) -> None:
    """Run a script with its progress showing."""
    code = subprocess.run([sys.executable, str(ROOT / command[0]), *command[1:]]).returncode
    if code:
        sys.exit(code)


def main(args: Args) -> None:
    """Run what is missing and print the read-outs."""
    task, runs = ["--env-id", args.env_id, "--sim-backend", "physx_cpu"], Path("runs")
    run("aib_belief.py", *task, "--small", "--robot-triangles", "500")
    repr_dir = runs / f"{args.env_id}__aib_repr_small__1"
    for triangles in (500, 0):
        test = ["--num-episodes", str(args.num_test), "--epochs", "1", "--seed", "2", "--val-fraction", "0.5"]
        run("aib_repr.py", *task, *test, "--robot-triangles", str(triangles), "--exp-name", f"meshes_test_{triangles}")

    stored = torch.load(runs / f"{args.env_id}__aib_belief_small__1" / "belief.pt", weights_only=True)
    stored_repr = torch.load(repr_dir / "repr.pt", weights_only=True)
    phi = aib_belief.StateEncoder(len(stored_repr["phi"]["mean"]), stored_repr["u_dim"])
    phi.load_state_dict(stored_repr["phi"])
    belief = aib_belief.AIBBelief(stored["config"])
    belief.load_state_dict(stored["belief"])
    # encode asks for a posterior too; what it says is not looked at
    posterior = aib_belief.GaussianMLP(stored_repr["u_dim"] + 256, [256, 256], stored["z_dim"], min_std=0.1)

    def encode(path: Path, count: int) -> dict[str, torch.Tensor]:
        """aib_belief.encode of the last episodes of a dataset."""
        state = torch.from_numpy(np.load(path / "dataset" / "state.npy"))
        with torch.no_grad():
            episodes = aib_belief.EpisodeDataset(path / "dataset", phi(state).mean, torch.device("cpu"))
        return aib_belief.encode(belief, posterior, episodes, np.arange(len(state))[-count:])

    fit = encode(repr_dir, stored_repr["num_val"])
    report = {}
    for name, triangles in (("light", 500), ("stock", 0)):
        test = encode(runs / f"{args.env_id}__meshes_test_{triangles}__2", args.num_test)
        pairs = zip(fit["particle"].unbind(1), test["particle"].unbind(1), strict=True)
        scores = [aib_belief.probe_score(x, fit["cue"], x_test, test["cue"]) for x, x_test in pairs]
        report[name] = {"last step": scores[-1], "mean over steps": float(np.mean(scores))}
    print(json.dumps(report, indent=2))


if __name__ == "__main__":
    main(tyro.cli(Args))
