"""How does u hold the cue and the target position? Linear fits to the u of stage 1's episodes, in Remember tasks.

PPO finds a target position that u encodes in one way for all cues sooner than one that it encodes for each cue apart.
Per time step: the variance of u, and the shares of it that are linear in the target position, in the cue, and in both
and their products; then the error with which the position is a linear function of u.

Usage:   python benchmark/u_geometry.py --repr-dir runs/RememberColor5-v0__aib_repr_small__1
Prints:  rows of task, kl_coef, psi_images, epochs, episodes, step, metric, value
"""

import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import tyro
from sklearn.linear_model import RidgeCV

sys.path.insert(0, str(Path(__file__).parent.parent))
from aib_belief import StateEncoder  # noqa: E402
from ppo_baseline import load  # noqa: E402


@dataclass
class Args:
    repr_dir: Path
    """run directory of stage 1"""
    steps: tuple[int, ...] = (3, 8, 60)
    """time steps: the cue is shown, nothing is shown, the objects stand on the table"""


def linear_fit(x: np.ndarray, y: np.ndarray, train: int) -> np.ndarray:
    """Residuals (N - train, K) of a ridge regression of y (N, K) on x (N, F), fitted on the first train rows."""
    return y[train:] - RidgeCV(np.logspace(-4, 3, 15)).fit(x[:train], y[:train]).predict(x[train:])


def describe(state: np.ndarray, cue: np.ndarray, u: np.ndarray, train: int) -> dict[str, float]:
    """Metrics of one time step: state (N, D), cue (N, K), u (N, u_dim); fitted on the first train episodes."""
    # the state is the cue and a position per object, zeros but for the target's
    target = state[:, cue.shape[1] :].reshape(len(state), -1, 3).sum(1)
    cue_number = np.unique(cue, axis=0, return_inverse=True)[1].reshape(-1)
    one_hot = np.eye(cue_number.max() + 1)[cue_number]
    features = np.concatenate([target, np.ones((len(target), 1))], 1)
    products = (one_hot[:, :, None] * features[:, None]).reshape(len(target), -1)
    total = np.square(u[train:] - u[:train].mean(0)).sum()
    report = {"variance": u.var(0).sum()}
    for name, x in (("target", target), ("cue", one_hot), ("target_x_cue", products)):
        report[f"share_{name}"] = 1 - np.square(linear_fit(x, u, train)).sum() / total
    report["target_error_cm"] = 100 * np.sqrt(np.square(linear_fit(u, target[:, :2], train)).sum(1).mean())
    return report


def main(args: Args) -> None:
    """Print the rows of all steps."""
    stored = load(args.repr_dir / "repr.pt", "name a run of aib_repr.py with --repr-dir", kind="repr")
    phi = StateEncoder(len(stored["phi"]["mean"]), stored["u_dim"])
    phi.load_state_dict(stored["phi"])
    states = np.load(args.repr_dir / "dataset" / "state.npy")
    cue = np.load(args.repr_dir / "dataset" / "cue.npy")
    setting = [stored[name] for name in ("env_id", "kl_coef", "psi_images", "epochs", "num_episodes")]
    for t in args.steps:
        with torch.no_grad():
            u = phi(torch.from_numpy(states[:, t])).mean.numpy()
        for name, value in describe(states[:, t], cue, u, len(u) - stored["num_val"]).items():
            print(*setting, t, name, f"{value:.3f}", sep=",")


if __name__ == "__main__":
    main(tyro.cli(Args))
