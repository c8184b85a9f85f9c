"""What does a belief remember? Linear probes of a run's belief, AIB's or Believer's, on the held-out episodes.

Prints what the beliefs of this task in runs/ remember; compare those that were trained on the same run of stage 1.

Usage:   python benchmark/belief.py --run runs/RememberColor3-v0__aib_belief_small__1
         python benchmark/belief.py --run runs/RememberColor3-v0__ppo_believer_small__1
Reads:   the run's checkpoint, and stage 1's run as its args.json names it
Writes:  diagnostics.json in the run's folder
"""

import json
import math
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import report
import torch
import tyro
from sklearn import linear_model, pipeline, preprocessing
from torch import Tensor, nn
from torch.distributions import Normal

sys.path.insert(0, str(Path(__file__).parent.parent))
import aib_belief  # noqa: E402
import ppo_believer  # noqa: E402


@dataclass
class Args:
    run: Path
    """folder of a finished run of aib_belief.py or ppo_believer.py"""


def are_classes(y: Tensor) -> bool:
    """Whether a cue y (N, K) is one of few integers, a colour or a shape, and not a quantity like a velocity."""
    return bool((y == y.round()).all()) and len(y.unique()) <= 32


def probe_score(x: Tensor, y: Tensor, x_test: Tensor, y_test: Tensor) -> float:
    """Linear probe of y (N, K) from x (N, F): R2, or accuracy of classes, on x_test and y_test.

    Accuracy is the mean over y's columns, R2 that of y as a vector, with a ridge chosen by cross-validation. Columns
    that do not vary are left out; nan when none does.
    """
    classes = are_classes(y)
    model = linear_model.RidgeCV(np.logspace(-3, 4, 8))
    if classes:
        model = linear_model.LogisticRegression(max_iter=1000)
    model = pipeline.make_pipeline(preprocessing.StandardScaler(), model)
    x, y, x_test, y_test = (array.cpu().numpy() for array in (x, y, x_test, y_test))
    varying = np.flatnonzero(np.ptp(y, axis=0))
    scores = [model.fit(x, y[:, k]).score(x_test, y_test[:, k]) for k in varying]
    if not scores:
        return math.nan
    return float(np.average(scores, weights=None if classes else y_test.var(0)[varying]))


@torch.no_grad()
def encode(
    belief: nn.Module, posterior: nn.Module, episodes: aib_belief.EpisodeDataset, cue: Tensor, index: np.ndarray
) -> dict[str, Tensor]:
    """What the belief makes of episodes index (E,); shapes are (E, T+1, ...) but for actions and cue.

    u, actions (E, T, A), cue (E, K): from the episodes; h: of the history
    z_mean: mean of q(z|u,h); u_posterior: u decoded from z_mean
    u_prior: mean of 30 particles, each the mean of p(u|z,h) for one z ~ p(z|h)
    nll_prior: -log of p(u|z,h) averaged over the same 30 z; low as soon as some of them explain u
    nll_posterior: -log p(u|z,h) for one z ~ q(z|u,h)
    """
    belief.eval()
    torch.manual_seed(0)  # the same noise every time, so that errors compare
    num_particles = 30
    parts = []
    for chunk in np.array_split(index, math.ceil(len(index) / 16)):
        batch = episodes(chunk)
        u, h = batch["u"], aib_belief.encode_history(belief.history, batch)[0]
        nll, _, _, mean = aib_belief.elbo_terms(belief, posterior, u, h)
        decoded = belief.decode(h, torch.randn(*h.shape[:-1], num_particles, mean.shape[-1], device=h.device))
        log_p = decoded.log_prob(u.unsqueeze(-2)).sum(-1)
        part = {"h": h, "u": u, "actions": batch["actions"], "z_mean": mean}
        part["u_prior"] = decoded.mean.mean(-2)
        part["u_posterior"] = belief.decoder(torch.cat([mean, h], -1)).mean
        part["nll_prior"] = math.log(num_particles) - log_p.logsumexp(-1)
        part["nll_posterior"] = nll
        part = {name: x.transpose(0, 1) for name, x in part.items()}
        part["cue"] = cue[chunk]
        parts.append(part)
    belief.train()
    return {name: torch.cat([part[name] for part in parts]) for name in parts[0]}


def probe_belief(fit: dict[str, Tensor], test: dict[str, Tensor]) -> dict:
    """What the belief knows of episodes test; linear probes are fitted on episodes fit (both from encode).

    By time step:
    u_r2_prior, u_r2_posterior: R2 of u_prior and u_posterior
    cue_from_h, cue_from_particle, cue_from_u: probes of the memory variable from h, u_prior and u
    Single numbers:
    nll_prior, nll_posterior: means
    action_readout: R2 of a probe of a_t from z_mean at t and t + 1
    cue_chance: accuracy of guessing the cue; 0 where it is a quantity
    """
    report = {name: test[name].mean().item() for name in ("nll_prior", "nll_posterior")}
    total = (test["u"] - test["u"].mean(0)).square().sum((0, 2)).clamp(min=1e-8)
    for name in ("prior", "posterior"):
        residual = (test["u"] - test[f"u_{name}"]).square().sum((0, 2))
        report[f"u_r2_{name}"] = (1 - residual / total).tolist()
    for name, source in (("h", "h"), ("particle", "u_prior"), ("u", "u")):
        scores = []
        for t in range(test[source].shape[1]):
            scores.append(probe_score(fit[source][:, t], fit["cue"], test[source][:, t], test["cue"]))
        report[f"cue_from_{name}"] = scores
    z, z_test = fit["z_mean"], test["z_mean"]
    x = torch.cat([z[:, :-1], z[:, 1:]], -1).flatten(0, 1)
    x_test = torch.cat([z_test[:, :-1], z_test[:, 1:]], -1).flatten(0, 1)
    report["action_readout"] = probe_score(x, fit["actions"].flatten(0, 1), x_test, test["actions"].flatten(0, 1))
    chances = [1 / len(column.unique()) for column in fit["cue"].T if column.min() < column.max()]
    report["cue_chance"] = float(np.mean(chances)) if are_classes(fit["cue"]) and chances else 0.0
    return report


@torch.no_grad()
def flow_gain(head: nn.Module, z: Tensor, action: Tensor) -> tuple[float, float]:
    """L_FM of q's means z (E, T+1, z_dim), and how much larger it is with those of other episodes; action (E, T, A).

    With a gain near 0 the action head reads nothing from z, and so shapes nothing.
    """
    torch.manual_seed(0)
    noise, tau = torch.randn_like(action), torch.rand_like(action[..., :1])
    loss = aib_belief.flow_matching_loss(head, action, z[:, :-1], z[:, 1:], noise, tau).mean()
    z = z.roll(1, 0)  # of other episodes
    shuffled = aib_belief.flow_matching_loss(head, action, z[:, :-1], z[:, 1:], noise, tau).mean()
    return loss.item(), (shuffled - loss).item()


def load_run(run: Path) -> tuple[nn.ModuleDict, object, aib_belief.EpisodeDataset, Tensor, int]:
    """A run's model (belief, posterior, head if there is one), arguments, episodes, cues (N, K), number of held-out."""
    values = json.loads((run / "args.json").read_text())
    believer = "num_particles" in values  # else a run of aib_belief.py
    script = ppo_believer if believer else aib_belief
    args = script.Args(**values)
    episodes, stored = script.load_episodes(args)
    preset = "_quick" if args.quick else "_small" if args.small else ""
    stage_1 = Path(args.repr_dir or f"runs/{args.env_id}__aib_repr{preset}__{args.seed}")
    cue = torch.from_numpy(np.load(stage_1 / "dataset" / "cue.npy"))
    config = aib_belief.load(run / "belief.pt")["config"]
    belief = ppo_believer.BelieverBelief(config) if believer else aib_belief.AIBBelief(config)
    if believer:
        belief.prior = lambda h: Normal(h.new_zeros(*h.shape[:-1], args.z_dim), 1.0)
    model = nn.ModuleDict({"belief": belief})
    model["posterior"] = script.GaussianMLP(config["u_dim"] + 256, [256, 256], args.z_dim, min_std=0.1)
    if not believer and args.action_head != "none":
        action_dim = episodes.arrays["actions"].shape[-1]
        inputs = 2 * args.z_dim + (action_dim + 1 if args.action_head == "flow" else 0)
        model["head"] = aib_belief.mlp([inputs, 256, action_dim])
    checkpoint = aib_belief.load(run / ("belief_checkpoint.pt" if believer else "checkpoint.pt"))
    trained = checkpoint["model"]  # also what helped to train the belief
    model.load_state_dict({name: x for name, x in trained.items() if name.partition(".")[0] in model})
    return model.to(args.device), args, episodes, cue, stored["num_val"]


def main(args: Args) -> None:
    """Write the run's diagnostics.json and print the table of its task."""
    model, trained, episodes, cue, num_val = load_run(args.run)
    held_out = np.arange(len(episodes))[-num_val:]
    fit_on, test_on = np.split(held_out, [num_val - num_val // 2])  # probes are tested on other episodes
    fit, test = (encode(model["belief"], model["posterior"], episodes, cue, index) for index in (fit_on, test_on))
    found = probe_belief(fit, test)
    if getattr(trained, "action_head", "none") == "flow":
        found["flow_loss"], found["flow_gain"] = flow_gain(model["head"], test["z_mean"], test["actions"])
    aib_belief.save(args.run / "diagnostics.json", json.dumps(found, indent=2).encode())
    beliefs = report.select(report.collect(Path("runs"))["beliefs.csv"], task=trained.env_id)
    print(report.beliefs_table(beliefs))


if __name__ == "__main__":
    main(tyro.cli(Args))
