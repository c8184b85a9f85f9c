"""How does u hold the cue and the target position? Linear fits to the u of stage 1's episodes, in Remember tasks.

PPO finds a target position that u encodes in one way for all cues sooner than one that it encodes for each cue apart.
Per time step: the variance of u, and the shares of it that are linear in the target position, in the cue, and in both
and their products; then the error with which the position is a linear function of u.

With --belief, on a dataset of refresh.py, instead what a belief knows on held-out scenes, played by the random policy
and by the agent: R2 of u from its mean particle, and the median error of the target position as read from it by a
linear function of u. An agent pushes its target, which no random episode shows: u_r2_unpushed compares its particles
with u where the random policy left the target, pushed_cm is how far off that is (median).

Usage:   python benchmark/u_geometry.py --repr-dir runs/RememberColor5-v0__aib_repr_small__1
         python benchmark/u_geometry.py --repr-dir runs/RememberColor3-v0__aib_repr_refreshed__1 \
             --belief runs/RememberColor3-v0__aib_belief_small__1/belief.pt
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
from refresh import rows_of  # noqa: E402

from aib_belief import AIBBelief, EpisodeDataset, GaussianMLP, StateEncoder, encode  # noqa: E402
from ppo_aib import load  # noqa: E402


@dataclass
class Args:
    repr_dir: Path
    """run directory of stage 1"""
    steps: tuple[int, ...] = (3, 8, 60)
    """time steps: the cue is shown, nothing is shown, the objects stand on the table"""
    belief: Path | None = None
    """belief.pt of aib_belief.py, of any phi"""


def linear_fit(x: np.ndarray, y: np.ndarray, train: int) -> np.ndarray:
    """Residuals (N - train, K) of a ridge regression of y (N, K) on x (N, F), fitted on the first train rows."""
    return y[train:] - RidgeCV(np.logspace(-4, 3, 15)).fit(x[:train], y[:train]).predict(x[train:])


def target_position(state: np.ndarray, cue_dim: int) -> np.ndarray:
    """Target position (N, 3) in metres: the state is the cue and a position per object, zeros but for the target's."""
    return state[:, cue_dim:].reshape(len(state), -1, 3).sum(1)


def describe(state: np.ndarray, cue: np.ndarray, u: np.ndarray, train: int) -> dict[str, float]:
    """Metrics of one time step: state (N, D), cue (N, K), u (N, u_dim); fitted on the first train episodes."""
    target = target_position(state, cue.shape[1])
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


@torch.no_grad()
def shift(args: Args, states: torch.Tensor, cue_dim: int, num_val: int) -> dict[tuple[int, str], float]:
    """Metrics by time step of a belief on the held-out scenes of a refreshed dataset with states (N, T+1, D)."""
    stored = load(args.belief, "name a belief.pt of aib_belief.py with --belief", kind="aib_belief")
    config = stored["config"]
    belief = AIBBelief(config)
    belief.load_state_dict(stored["belief"])
    u = belief.phi(states).mean
    target = torch.from_numpy(target_position(states.flatten(0, 1).numpy(), cue_dim)[:, :2]).unflatten(0, u.shape[:2])
    _, by_agent = rows_of(len(states) * 2 // 3)
    held_out = np.arange(len(states)) >= len(states) - num_val
    table = slice(20, None)  # the objects stand on the table
    train = np.flatnonzero(~held_out & ~by_agent)
    probe = RidgeCV(np.logspace(-4, 3, 15)).fit(u[train, table].flatten(0, 1), target[train, table].flatten(0, 1))
    episodes = EpisodeDataset(args.repr_dir / "dataset", u, torch.device("cpu"))
    posterior = GaussianMLP(config["u_dim"] + 256, [256, 256], config["z_dim"], min_std=0.1)  # not looked at
    report = {}
    for name, rows in (
        ("random", np.flatnonzero(held_out & ~by_agent)),
        ("agent", np.flatnonzero(held_out & by_agent)),
    ):
        particle = encode(belief, posterior, episodes, rows)["particle"]
        for t in (12, 20, 40, states.shape[1] - 1):
            residual = (particle[:, t] - u[rows, t]).square().sum()
            report[t, f"u_r2_{name}"] = 1 - (residual / (u[rows, t] - u[rows, t].mean(0)).square().sum()).item()
            error = np.linalg.norm(probe.predict(particle[:, t]) - target[rows, t].numpy(), axis=1)
            report[t, f"error_cm_{name}"] = 100 * np.median(error)
            if name == "agent":  # the row before is the random policy's in the same scene, where nothing is pushed
                unpushed = u[rows - 1, t]
                residual = (particle[:, t] - unpushed).square().sum()
                report[t, "u_r2_unpushed"] = 1 - (residual / (unpushed - unpushed.mean(0)).square().sum()).item()
                pushed = (target[rows, t] - target[rows - 1, t]).norm(dim=-1)
                report[t, "pushed_cm"] = 100 * pushed.median().item()
    return report


def main(args: Args) -> None:
    """Print the rows of all steps."""
    stored = load(args.repr_dir / "repr.pt", "name a run of aib_repr.py with --repr-dir", kind="repr")
    phi = StateEncoder(len(stored["phi"]["mean"]), stored["u_dim"])
    phi.load_state_dict(stored["phi"])
    states = torch.from_numpy(np.load(args.repr_dir / "dataset" / "state.npy"))
    cue = np.load(args.repr_dir / "dataset" / "cue.npy")
    report = {}
    if args.belief:
        report = shift(args, states, cue.shape[1], stored["num_val"])
    else:
        for t in args.steps:
            with torch.no_grad():
                u = phi(states[:, t]).mean.numpy()
            for name, value in describe(states[:, t].numpy(), cue, u, len(u) - stored["num_val"]).items():
                report[t, name] = value
    for (t, name), value in report.items():
        setting = [stored[name] for name in ("env_id", "kl_coef", "psi_images", "epochs", "num_episodes")]
        print(*setting, t, name, f"{value:.3f}", sep=",")


if __name__ == "__main__":
    main(tyro.cli(Args))
