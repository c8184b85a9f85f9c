"""How does u hold the cue and the target position? Linear fits to the u of stage 1's episodes, in Remember tasks.

PPO finds a target position that u encodes in one way for all cues sooner than one that it encodes for each cue apart.
Per time step: the variance of u, and the shares of it that are linear in the target position, in the cue, and in both
and their products; then the error with which the position is a linear function of u.

With --agent also what that agent's belief knows of the target position on the evaluation's episodes, read from the mean
particle by the same linear function: its error, and the distance of the tool from the target.

Usage:   python benchmark/u_geometry.py --repr-dir runs/RememberColor5-v0__aib_repr_small__1
         python benchmark/u_geometry.py --repr-dir runs/RememberColor3-v0__aib_repr_small__1 \
             --agent runs/RememberColor3-v0__ppo_aib_small__1/agent.pt
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
import ppo_aib  # noqa: E402
from aib_belief import StateEncoder  # noqa: E402
from ppo_aib import load  # noqa: E402


@dataclass
class Args:
    repr_dir: Path
    """run directory of stage 1"""
    steps: tuple[int, ...] = (3, 8, 60)
    """time steps: the cue is shown, nothing is shown, the objects stand on the table"""
    agent: Path | None = None
    """agent.pt of ppo_aib.py on the same u"""


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


def play(file: Path) -> dict[str, torch.Tensor]:
    """The evaluation's episodes with the agent of a file: ppo_aib.rollout's arrays."""
    stored = load(file, "name an agent.pt of ppo_aib.py with --agent", kind="ppo_aib agent")
    settings = ppo_aib.Args(env_id=stored["env_id"])
    for name in ("robot", "robot_triangles", "num_envs", "amp", "num_particles", "num_eval_episodes"):
        setattr(settings, name, stored[name])
    envs = ppo_aib.make_envs(settings)
    agent = ppo_aib.Agent(envs, ppo_aib.AIBBelief(stored["config"], settings.amp), settings).to(settings.device)
    agent.load_state_dict(stored["agent"])
    torch.manual_seed(0)
    seeds = ppo_aib.EVAL_SEED + np.arange(settings.num_eval_episodes)
    buffer = ppo_aib.rollout(envs, agent, settings, seeds, deterministic=True)
    envs.close()
    return buffer


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
    if args.agent is None:
        return
    table = slice(20, None)  # the objects stand on the table
    with torch.no_grad():
        u = phi(torch.from_numpy(states[:, table])).mean.flatten(0, 1).numpy()
    target = target_position(states[:, table].reshape(len(u), -1), cue.shape[1])[:, :2]
    probe = RidgeCV(np.logspace(-4, 3, 15)).fit(u, target)
    buffer = play(args.agent)
    for t in (12, 20, 40, -1):
        target = target_position(buffer["state"][t].cpu().numpy(), cue.shape[1])[:, :2]
        particle = buffer["particles"][t].mean(-2).cpu().numpy()
        tool = buffer["joints"][t, :, 18:20].cpu().numpy()
        for name, x in (("particle_error_cm", probe.predict(particle)), ("tool_distance_cm", tool)):
            print(*setting, t, name, f"{100 * np.median(np.linalg.norm(x - target, axis=1)):.2f}", sep=",")


if __name__ == "__main__":
    main(tyro.cli(Args))
