"""AIB stage 2: action-informed belief with a learned prior (paper section 3.2).

A recurrent encoder h of the camera history, a prior p(z|h), a posterior q(z|u,h) and a decoder p(u|z,h) model what
the history tells about u = phi(s). A flow-matching inverse-dynamics head on (z_t, z_t+1) shapes the posterior; the KL
term hands that shape to the prior, which is what the robot has when it acts.

Usage:   python aib_belief.py --env-id InterceptFast-v0
         the published variant: --image-norm none --no-chrono-init --bptt-steps 16, on stage 1 with
         --no-reward-norm --kl-coef 0.03 --kl-reduction mean --image-norm none
Reads:   runs/{env_id}__aib_repr__{seed}/: dataset/ and repr.pt; where they are missing, runs aib_repr.py first
Writes:  runs/{env_id}__{exp_name}__{seed}/: belief.pt, diagnostics.json, diagnostics.png
"""

import copy
import ctypes
import fcntl
import io
import json
import math
import os
import shlex
import shutil
import signal
import subprocess
import sys
import time
import zipfile
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path
from typing import Literal, NoReturn

import matplotlib
import matplotlib.pyplot as plt
import numpy as np
import torch
import torch.nn as nn
import torch.nn.functional as F
import tyro
from torch.distributions import Normal, kl_divergence
from torch.utils.tensorboard import SummaryWriter
from tqdm import tqdm

FORMAT = 1  # of every .pt file and of dataset/: raised when older scripts would misread newer files


@dataclass
class Args:
    env_id: str = "InterceptFast-v0"
    """MIKASA-Robo task"""
    exp_name: str = "aib_belief"
    """results go to runs/{env_id}__{exp_name}__{seed}"""
    seed: int = 1
    """seed of weights, noise and episodes"""
    device: Literal["cpu", "cuda"] | None = None
    """where the networks live; None: cuda if there is one"""
    sim_backend: Literal["physx_cpu", "physx_cuda"] | None = None
    """physics, if stage 1 has to run first; None: physx_cuda on a cuda device"""
    render_backend: Literal["sapien_cpu", "sapien_cuda"] | None = None
    """renderer, if stage 1 has to run first; None: sapien_cuda on a cuda device"""
    robot: Literal["panda_wristcam", "panda"] | None = None
    """panda renders 3 times faster on a CPU; None: panda_wristcam, MIKASA's default (quick: panda)"""
    num_workers: int | None = None
    """simulator processes, if stage 1 has to run first; None: as many as there are cores"""
    quick: bool = False
    """a trial of a minute or two whose results mean nothing"""
    overwrite: bool = False
    """delete what the run directory holds and start anew"""
    checkpoint_minutes: float = 5.0
    """minutes between checkpoints"""

    repr_dir: Path | None = None
    """run directory of stage 1; None: runs/{env_id}__aib_repr__{seed}"""
    num_updates: int | None = None
    """gradient updates; the paper calls them epochs; None: 10000, quick: 4"""
    batch_episodes: int | None = None
    """whole episodes per update; None: 256, quick: 4"""
    belief_lr: float = 3e-4
    """Adam's learning rate"""
    z_dim: int = 32
    """size of z"""
    beta: float = 1.0
    """weight of KL(q || p)"""
    action_head: Literal["flow", "mse", "none"] = "flow"
    """inverse dynamics by flow matching, by regression, or none"""
    action_lambda: float = 1.0
    """weight of the action head's loss"""
    fm_latent: Literal["sample", "mean"] = "sample"
    """what the action head sees of the posterior"""
    bptt_steps: int | None = None
    """cut back-propagation through time after so many steps; None: never"""
    image_norm: Literal["mean", "none"] = "mean"
    """subtract the dataset's mean image and divide by what varies, or just divide by 255"""
    chrono_init: bool = True
    """GRU gates that start out remembering for up to an episode (Tallec and Ollivier, 2018)"""
    gru_layers: int = 1
    """layers of the GRU"""
    history_joints: bool = False
    """joints in the history"""
    history_actions: bool = False
    """previous actions in the history; then z can carry them with no regard for the world"""
    amp: bool | None = None
    """bfloat16 convolutions; None: on CUDA and on CPUs with bfloat16 instructions"""
    held_out_every: int = 50
    """updates between looks at the held-out episodes; the best weights are kept"""


DEFAULTS = dict(robot="panda_wristcam", num_updates=10_000, batch_episodes=256)
QUICK = dict(robot="panda", num_updates=4, batch_episodes=4)


# ---------------------------------------------------------------- dataset


def open_dataset(path: Path, mend: str, mode: str = "r") -> tuple[dict, dict[str, np.ndarray]]:
    """Open dataset/: its meta.json and its arrays as memory maps; fails when something is missing or damaged."""
    try:
        meta = json.loads((path / "meta.json").read_text())
        if meta["format"] != FORMAT:
            fail(f"{path} has format {meta['format']}, this script reads format {FORMAT}; {mend}")
        arrays = {name: np.load(path / f"{name}.npy", mmap_mode=mode) for name in meta["arrays"]}
        for name, (shape, dtype) in meta["arrays"].items():
            if [list(arrays[name].shape), str(arrays[name].dtype)] != [shape, dtype]:
                raise ValueError(f"{name}.npy is not {dtype} {shape}")
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        fail(f"{path} is damaged or incomplete ({error}); {mend}")
    return meta, arrays


class Episodes:
    """Whole episodes of dataset/ with u, time first; images on the device when they fit in half of its free memory."""

    def __init__(self, data: Path, u: torch.Tensor, device: torch.device):
        self.data, self.u, self.device, self.rgb = data, u, device, None
        rgb = np.load(data / "rgb.npy", mmap_mode="r")
        if device.type == "cuda" and rgb.nbytes < torch.cuda.mem_get_info()[0] / 2:
            self.rgb = torch.empty(rgb.shape, dtype=torch.uint8, device=device)
            for i in range(len(rgb)):
                self.rgb[i] = torch.from_numpy(rgb[i])

    def __call__(self, index: np.ndarray) -> dict[str, torch.Tensor]:
        """Episodes index (B,): rgb (T+1, B, H, W, 3), joints, u, previous (T+1, B, .) action, actions (T, B, A).

        The maps are opened anew each time, so that pages once read do not stay in this process.
        """
        index = np.sort(index)
        names = ("joints", "actions") if self.rgb is not None else ("rgb", "joints", "actions")
        arrays = {name: np.load(self.data / f"{name}.npy", mmap_mode="r")[index] for name in names}
        batch = {name: torch.from_numpy(array).to(self.device).transpose(0, 1) for name, array in arrays.items()}
        if self.rgb is not None:
            batch["rgb"] = self.rgb[torch.from_numpy(index).to(self.device)].transpose(0, 1)
        batch["u"] = self.u[torch.from_numpy(index).to(self.device)].transpose(0, 1)
        batch["previous"] = F.pad(batch["actions"], (0, 0, 0, 0, 1, 0))
        return batch


def image_statistics(data: Path, episodes: np.ndarray) -> tuple[torch.Tensor, torch.Tensor]:
    """Mean image (H, W, 3) of the episodes and standard deviation () of what remains, both in units of 0..255."""
    total, square, count = 0.0, 0.0, 0
    for episode in episodes:
        images = np.load(data / "rgb.npy", mmap_mode="r")[episode].astype(np.float32)
        total = total + images.sum(0, dtype=np.float64)
        square = square + np.square(images).sum(0, dtype=np.float64)
        count += len(images)
    mean = total / count
    return torch.from_numpy(mean).float(), torch.tensor(math.sqrt((square / count - mean**2).mean())).float()


# ---------------------------------------------------------------- networks


def mlp(sizes: list[int]) -> nn.Sequential:
    """Linear layers of the given sizes with ReLU between them."""
    layers = [module for i, o in pairwise(sizes) for module in (nn.Linear(i, o), nn.ReLU())]
    return nn.Sequential(*layers[:-1])


class GaussianMLP(nn.Module):
    """Diagonal Gaussian from an MLP, std = softplus + min_std: (..., inputs) -> Normal over (..., size)."""

    def __init__(self, inputs: int, hidden: list[int], size: int, min_std: float):
        super().__init__()
        self.net = mlp([inputs, *hidden, 2 * size])
        self.min_std = min_std

    def forward(self, x: torch.Tensor) -> Normal:
        mean, raw = self.net(x).chunk(2, -1)
        return Normal(mean, F.softplus(raw) + self.min_std, validate_args=False)


class NatureCNN(nn.Module):
    """The convolutional network of Mnih et al. (2015): images (B, H, W, C) float -> features (B, size), ReLU last."""

    def __init__(self, image_shape: tuple[int, ...], size: int):
        super().__init__()
        convs = [nn.Conv2d(image_shape[-1], 32, 8, 4), nn.Conv2d(32, 64, 4, 2), nn.Conv2d(64, 64, 3, 1)]
        self.conv = nn.Sequential(*[module for conv in convs for module in (conv, nn.ReLU())], nn.Flatten())
        with torch.no_grad():
            flat = self.conv(torch.zeros(1, *image_shape).permute(0, 3, 1, 2)).shape[1]
        self.out = nn.Sequential(nn.Linear(flat, size), nn.ReLU())

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        return self.out(self.conv(images.permute(0, 3, 1, 2)))


def orthogonal_init(module: nn.Module, gain: float = math.sqrt(2)) -> nn.Module:
    """Orthogonal weights of the given gain and zero biases in every linear and convolutional layer of module."""
    for layer in module.modules():
        if isinstance(layer, nn.Linear | nn.Conv2d):
            nn.init.orthogonal_(layer.weight, gain)
            nn.init.zeros_(layer.bias)
    return module


class StateEncoder(nn.Module):
    """phi: privileged state (..., D), standardised inside, -> Normal over u (..., u_dim) (paper 3.1)."""

    def __init__(self, state_dim: int, u_dim: int):
        super().__init__()
        self.register_buffer("mean", torch.zeros(state_dim))
        self.register_buffer("std", torch.ones(state_dim))
        self.net = GaussianMLP(state_dim, [256, 256], u_dim, min_std=1e-5)

    def forward(self, state: torch.Tensor) -> Normal:
        return self.net((state - self.mean) / self.std)


class HistoryEncoder(nn.Module):
    """h_t of the history (paper 3.2): NatureCNN, GRU, MLP of the GRU's output and the current embedding.

    Joints and previous actions belong to the history where their sizes in config are not 0.
    """

    def __init__(self, config: dict):
        super().__init__()
        self.register_buffer("image_mean", torch.zeros(config["image_shape"]))
        self.register_buffer("image_std", torch.tensor(255.0))
        self.use_joints, self.use_actions = config["joints_dim"] > 0, config["action_dim"] > 0
        embedding = 512 + config["joints_dim"] + config["action_dim"]
        self.cnn = orthogonal_init(NatureCNN(config["image_shape"], 512))
        self.gru = nn.GRU(embedding, 256, config["gru_layers"])
        self.out = mlp([256 + embedding, 256, 256])

    def forward(
        self,
        batch: dict[str, torch.Tensor],
        state: torch.Tensor | None = None,
        bptt_steps: int | None = None,
        amp: bool = False,
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Encode T steps of B histories: rgb (T, B, H, W, 3) uint8, joints, previous -> h (T, B, 256), GRU state.

        All T * B frames go through the CNN in one call; T = 1 with the last state is the step path of PPO.
        """
        rgb = batch["rgb"]
        with torch.autocast(rgb.device.type, torch.bfloat16, enabled=amp):
            x = self.cnn(rgb.flatten(0, 1).float().sub_(self.image_mean).div_(self.image_std))
        x = [x.float().view(*rgb.shape[:2], -1)]
        x += [batch["joints"]] if self.use_joints else []
        x += [batch["previous"]] if self.use_actions else []
        x, outputs = torch.cat(x, -1), []
        for chunk in x.split(bptt_steps or len(x)):
            output, state = self.gru(chunk, None if state is None else state.detach())
            outputs.append(output)
        return self.out(torch.cat([torch.cat(outputs), x], -1)), state


def chrono_init(gru: nn.GRU, steps: int) -> None:
    """Let the GRU start out remembering for 1 to steps steps: bias log U(1, steps - 1) (Tallec and Ollivier, 2018)."""
    gate = slice(gru.hidden_size, 2 * gru.hidden_size)  # torch orders the gates reset, update, new
    for layer in range(gru.num_layers):
        with torch.no_grad():
            getattr(gru, f"bias_ih_l{layer}")[gate] = torch.empty(gru.hidden_size).uniform_(1, steps - 1).log()
            getattr(gru, f"bias_hh_l{layer}")[gate] = 0


class AIBBelief(nn.Module):
    """b(h): history encoder, learned prior p(z|h) and decoder p(u|z,h), all that acting needs (paper 3.2)."""

    def __init__(self, config: dict):
        super().__init__()
        self.config = config
        self.history = HistoryEncoder(config)
        self.prior = GaussianMLP(256, [256], config["z_dim"], min_std=0.1)
        self.decoder = GaussianMLP(config["z_dim"] + 256, [256, 256], config["u_dim"], min_std=0.1)

    def decode(self, h: torch.Tensor, z_noise: torch.Tensor) -> Normal:
        """Give p(u|z_i,h) of each z_i ~ p(z|h): h (..., 256), noise (..., n, z_dim) -> Normal over (..., n, u_dim)."""
        p = self.prior(h)
        z = p.mean.unsqueeze(-2) + p.stddev.unsqueeze(-2) * z_noise
        return self.decoder(torch.cat([z, h.unsqueeze(-2).expand(*z.shape[:-1], -1)], -1))

    def particles(self, h: torch.Tensor, z_noise: torch.Tensor, u_noise: torch.Tensor) -> torch.Tensor:
        """Draw u_i ~ p(u|z_i,h), z_i ~ p(z|h) (paper 3.3): h (..., 256), noise (..., n, .) -> (..., n, u_dim)."""
        decoded = self.decode(h, z_noise)
        return decoded.mean + decoded.stddev * u_noise


# ---------------------------------------------------------------- losses


def elbo_terms(belief: nn.Module, posterior: nn.Module, u: torch.Tensor, h: torch.Tensor) -> tuple[torch.Tensor, ...]:
    """Terms of -L_VAE at each step (...,): -log p(u|z,h) and KL(q || p); then z ~ q and the mean of q (..., z_dim)."""
    q = posterior(torch.cat([u, h], -1))
    z = q.rsample()
    nll = -belief.decoder(torch.cat([z, h], -1)).log_prob(u).sum(-1)
    return nll, kl_divergence(q, belief.prior(h)).sum(-1), z, q.mean


def flow_matching_loss(
    head: nn.Module, action: torch.Tensor, z: torch.Tensor, z_next: torch.Tensor, noise: torch.Tensor, tau: torch.Tensor
) -> torch.Tensor:
    """L_FM at each step (...,): the velocity at a_tau = (1 - tau) a_0 + tau a_1 against a_1 - a_0; noise is a_0."""
    a_tau = (1 - tau) * noise + tau * action
    velocity = head(torch.cat([a_tau, tau, z, z_next], -1))
    return (velocity - (action - noise)).square().sum(-1)


def regression_loss(head: nn.Module, action: torch.Tensor, z: torch.Tensor, z_next: torch.Tensor) -> torch.Tensor:
    """The ablation's inverse dynamics at each step (...,): squared error of a_t from (z_t, z_t+1)."""
    return (head(torch.cat([z, z_next], -1)) - action).square().sum(-1)


def belief_losses(model: nn.ModuleDict, batch: dict[str, torch.Tensor], args: Args) -> dict[str, torch.Tensor]:
    """L_Total = -L_VAE + lambda L_FM and its terms, averaged over all steps of a batch of whole episodes."""
    h, _ = model["belief"].history(batch, bptt_steps=args.bptt_steps, amp=args.amp)
    nll, kl, z, mean = elbo_terms(model["belief"], model["posterior"], batch["u"], h)
    losses = {"nll": nll.mean(), "kl": kl.mean()}
    losses["total"] = losses["nll"] + args.beta * losses["kl"]
    if args.action_head != "none":
        z, action = mean if args.fm_latent == "mean" else z, batch["actions"]
        if args.action_head == "flow":
            noise, tau = torch.randn_like(action), torch.rand_like(action[..., :1])
            losses["action"] = flow_matching_loss(model["head"], action, z[:-1], z[1:], noise, tau).mean()
        else:
            losses["action"] = regression_loss(model["head"], action, z[:-1], z[1:]).mean()
        losses["total"] = losses["total"] + args.action_lambda * losses["action"]
    return losses


# ---------------------------------------------------------------- diagnostics


def fit_readout(x: torch.Tensor, y: torch.Tensor) -> dict:
    """Fit a linear read-out of y (N, K) from features x (N, F): what a linear map can tell of y.

    Columns of few whole numbers (colours, shapes) are classified by logistic regression, others by least squares.
    """
    mean, std = x.mean(0), x.std(0).clamp(min=1e-6)
    x = torch.cat([(x - mean) / std, torch.ones_like(x[:, :1])], 1)
    columns = []
    for column in y.T:
        if (y == y.round()).all() and len(y.unique()) <= 32:
            classes, target = column.unique(return_inverse=True)
            weight = torch.zeros(x.shape[1], len(classes), device=x.device, requires_grad=True)
            optimizer = torch.optim.LBFGS([weight], max_iter=100, line_search_fn="strong_wolfe")

            def closure(weight: torch.Tensor = weight, target: torch.Tensor = target) -> torch.Tensor:
                weight.grad = None
                loss = F.cross_entropy(x @ weight, target) + 1e-3 * weight.square().sum()
                loss.backward()
                return loss

            optimizer.step(closure)
            columns.append({"weight": weight.detach(), "classes": classes})
        else:
            ridge = 1e-3 * len(x) * torch.eye(x.shape[1], device=x.device)
            columns.append({"weight": torch.linalg.solve(x.T @ x + ridge, x.T @ column[:, None])})
    return {"mean": mean, "std": std, "columns": columns}


def score_readout(readout: dict, x: torch.Tensor, y: torch.Tensor) -> float:
    """Accuracy (classified) or R2 (regressed) of a read-out on x (N, F), y (N, K), mean over the columns that vary."""
    x = torch.cat([(x - readout["mean"]) / readout["std"], torch.ones_like(x[:, :1])], 1)
    scores = []
    for column, target in zip(readout["columns"], y.T, strict=True):
        prediction = x @ column["weight"]
        if "classes" in column:
            scores.append((column["classes"][prediction.argmax(1)] == target).float().mean())
        elif target.std() > 1e-6:
            scores.append(1 - (target - prediction[:, 0]).square().mean() / target.var(correction=0))
    return torch.stack(scores).mean().item() if scores else math.nan


@torch.no_grad()
def encode(belief: nn.Module, posterior: nn.Module, episodes: Episodes, index: np.ndarray) -> dict[str, torch.Tensor]:
    """What the belief makes of episodes index (E,), on the device, each (E, T+1, .): h, u, and

    particle: the mean of 30 decoded prior samples; q: the posterior's mean; posterior: its decoding;
    nll_prior: -log p(u|h) (E, T+1), where p(u|h) is the mean of p(u|z,h) over those 30 samples: a belief that knows
    of three possible places is right about each, which a single sample would not show; nll_posterior: -log p(u|z,h)
    under one z of the posterior; action (E, T, A).
    """
    seed_everything(0)  # the same noise at every look, so that looks compare
    parts = []
    for chunk in np.array_split(index, math.ceil(len(index) / 16)):
        batch = episodes(chunk)
        u, (h, _) = batch["u"], belief.history(batch)
        nll, _, _, mean = elbo_terms(belief, posterior, u, h)
        decoded = belief.decode(h, torch.randn(*h.shape[:-1], 30, mean.shape[-1], device=h.device))
        log_p = decoded.log_prob(u.unsqueeze(-2)).sum(-1)
        part = {"h": h, "u": u, "particle": decoded.mean.mean(-2), "q": mean, "nll_posterior": nll}
        part["nll_prior"] = math.log(30) - log_p.logsumexp(-1)
        part["posterior"] = belief.decoder(torch.cat([mean, h], -1)).mean
        parts.append({name: x.transpose(0, 1) for name, x in {**part, "action": batch["actions"]}.items()})
    return {name: torch.cat([part[name] for part in parts]) for name in parts[0]}


def r2_per_step(prediction: torch.Tensor, target: torch.Tensor) -> list[float]:
    """Share of the variance across episodes that prediction explains at each step: both (E, T, D) -> T numbers."""
    left = (target - prediction).square().sum((0, 2))
    return (1 - left / (target - target.mean(0)).square().sum((0, 2)).clamp(min=1e-8)).tolist()


def diagnose_belief(fit: dict, test: dict, cue_fit: torch.Tensor, cue_test: torch.Tensor) -> tuple[dict, dict]:
    """Report what the belief remembers, from encode's arrays of training (fit) and held-out (test) episodes.

    Lists are per time step. Also returns the read-out of the cue from the mean particle over all steps, for stage 3.
    """
    steps = range(test["u"].shape[1])
    report = {"nll_prior": test["nll_prior"].mean().item(), "nll_posterior": test["nll_posterior"].mean().item()}
    report["prior_gap"] = report["nll_prior"] - report["nll_posterior"]
    report["u_r2_prior"] = r2_per_step(test["particle"], test["u"])
    report["u_r2_posterior"] = r2_per_step(test["posterior"], test["u"])
    for name in ("h", "particle", "u"):
        scores = [score_readout(fit_readout(fit[name][:, t], cue_fit), test[name][:, t], cue_test) for t in steps]
        report[f"cue_from_{name}"] = scores
    pairs = [torch.cat([x["q"][:, :-1], x["q"][:, 1:]], -1).flatten(0, 1) for x in (fit, test)]
    readout = fit_readout(pairs[0], fit["action"].flatten(0, 1))
    report["action_readout"] = score_readout(readout, pairs[1], test["action"].flatten(0, 1))

    def repeat(cue: torch.Tensor) -> torch.Tensor:
        return cue.repeat_interleave(len(steps), 0)

    readout = fit_readout(fit["particle"].flatten(0, 1), repeat(cue_fit))
    report["cue_readout"] = score_readout(readout, test["particle"].flatten(0, 1), repeat(cue_test))
    classes = [len(column["classes"]) for column in readout["columns"] if "classes" in column]
    report["cue_chance"] = float(np.mean([1 / n for n in classes])) if classes else 0.0
    return report, readout


@torch.no_grad()
def flow_gain(head: nn.Module, q: torch.Tensor, action: torch.Tensor) -> float:
    """L_FM with the z of other episodes minus L_FM with the right ones; q (E, T+1, z_dim), action (E, T, A).

    Near 0 the action head reads nothing from z, and so shapes nothing.
    """
    seed_everything(0)
    noise, tau = torch.randn_like(action), torch.rand_like(action[..., :1])
    wrong, right = (flow_matching_loss(head, action, z[:, :-1], z[:, 1:], noise, tau).mean() for z in (q.roll(1, 0), q))
    return (wrong - right).item()


def plot_diagnostics(report: dict, title: str) -> bytes:
    """Draw the report as a PNG: the cue's read-out and the reconstruction of u against time."""
    matplotlib.use("Agg")
    figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4.4), layout="constrained")
    names = {"cue_from_u": "u (ceiling)", "cue_from_h": "h", "cue_from_particle": "mean particle"}
    for (name, label), style in zip(names.items(), ("k:", "C0-", "C1--"), strict=True):
        left.plot(report[name], style, label=label)
    left.axhline(report["cue_chance"], color="grey", linestyle="-.", label="chance")
    left.set(xlabel="step", ylabel="held-out accuracy, or R2", title="cue, linear read-out", ylim=(-0.05, 1.05))
    right.plot(report["u_r2_posterior"], "k:", label="posterior (sees u)")
    right.plot(report["u_r2_prior"], "C1-", label="prior (mean particle)")
    right.set(xlabel="step", ylabel="R2", title="reconstruction of u", ylim=(-0.05, 1.05))
    for axes in (left, right):
        axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.14), ncols=4, frameon=False)
        axes.grid(alpha=0.3)
    gain = "" if "flow_gain" not in report else f", flow gain {report['flow_gain']:.3f}"
    figure.suptitle(f"{title}: action read-out R2 {report['action_readout']:.3f}{gain}")
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110)
    plt.close(figure)
    return buffer.getvalue()


def write_report(report: dict, path: Path, title: str, writer: SummaryWriter, update: int) -> None:
    """Write the report as diagnostics.json, diagnostics.png and TensorBoard curves over time steps; print the gist."""
    write_file(path / "diagnostics.json", (json.dumps(report, indent=2) + "\n").encode())
    write_file(path / "diagnostics.png", plot_diagnostics(report, title))
    for name, value in report.items():
        if isinstance(value, list):
            for t, x in enumerate(value):
                writer.add_scalar(f"diagnostics_per_step/{name}", x, t)
        else:
            writer.add_scalar(f"diagnostics/{name}", value, update)
    gist = {name: value[-1] if isinstance(value, list) else value for name, value in report.items()}
    print("held out, last step: " + ", ".join(f"{name} {value:.3g}" for name, value in gist.items()), flush=True)


# ---------------------------------------------------------------- run directory and files


def fail(message: str, code: int = 2) -> NoReturn:
    """Say on stderr, in one sentence, what is wrong and how to mend it, and leave (exit code 2: bad input)."""
    tqdm.write(f"error: {message}", file=sys.stderr)  # on a line of its own, below any progress bar
    sys.exit(code)


def resolve(args: "Args", defaults: dict) -> "Args":
    """Fill in the arguments left out, so that args.json shows what was used; fails on what can only be a slip."""
    has_cuda = torch.cuda.is_available()
    if not has_cuda and "cuda" in (args.device or "") + (args.sim_backend or ""):
        fail("torch sees no CUDA device here; use --device cpu --sim-backend physx_cpu or leave both out")
    on_gpu = (args.device or ("cuda" if has_cuda else "cpu")) == "cuda"
    backends = ("cuda", "physx_cuda", "sapien_cuda") if on_gpu else ("cpu", "physx_cpu", "sapien_cpu")
    defaults = {**defaults, **dict(zip(("device", "sim_backend", "render_backend"), backends, strict=True))}
    for name, value in defaults.items():
        if getattr(args, name) is None:
            setattr(args, name, value)
    for name, value in asdict(args).items():
        least = 0 if isinstance(value, bool | float) or name == "seed" else 1
        if isinstance(value, int | float) and not value >= least:
            fail(f"--{name.replace('_', '-')} {value} makes no sense; it must be at least {least}")
    return args


def has_bfloat16(device: str) -> bool:
    """Whether bfloat16 is fast on the device: on CUDA, and on CPUs that name such instructions to Linux."""
    return device == "cuda" or "bf16" in Path("/proc/cpuinfo").read_text()


def write_file(path: Path, content: bytes) -> None:
    """Write whole or not at all: to a temporary name in the same folder, flushed to the disk, then renamed."""
    part = path.with_name(path.name + ".part")
    try:
        with open(part, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(part, path)
    except OSError as error:
        part.unlink(missing_ok=True)
        fail(f"{path} could not be written ({error.strerror}); make room or choose another folder: old files are whole")


def save(path: Path, content: dict) -> None:
    """Save a dictionary of tensors, numbers, strings and lists of them as a .pt file, whole or not at all."""
    buffer = io.BytesIO()
    torch.save({"format": FORMAT, **content}, buffer)
    write_file(path, buffer.getvalue())


def load(path: Path, kind: str, mend: str) -> dict:
    """Read a .pt file written by save; fails when it is missing, damaged, of another kind or of another format."""
    content = None
    try:
        with zipfile.ZipFile(path) as archive:  # torch.load does not look at the checksums, zipfile does
            if archive.testzip() is None:
                content = torch.load(path, map_location="cpu", weights_only=True)
    except FileNotFoundError:
        fail(f"{path} does not exist; {mend}")
    except Exception as error:  # zipfile, pickle and torch each say in their own way that bytes are wrong
        fail(f"{path} is damaged or no file of these scripts ({type(error).__name__}); {mend}")
    if not isinstance(content, dict) or "format" not in content:
        fail(f"{path} is damaged or no file of these scripts; {mend}")
    if (content.get("kind"), content["format"]) != (kind, FORMAT):
        fail(f"{path} is a '{content.get('kind')}' of format {content['format']}, not a '{kind}' of {FORMAT}; {mend}")
    return content


@contextmanager
def run_directory(args: "Args") -> Iterator[Path]:
    """Create or re-open runs/{env_id}__{exp_name}__{seed} and lock it.

    Fails when another process works there, or when it was made with other arguments.
    """
    path = Path("runs") / f"{args.env_id}__{args.exp_name}__{args.seed}"
    no_matter = ("overwrite", "checkpoint_minutes", "num_workers", "evaluate", "checkpoint")
    wanted = {name: value for name, value in asdict(args).items() if name not in no_matter}
    wanted = json.loads(json.dumps(wanted, default=str))
    try:
        path.mkdir(parents=True, exist_ok=True)
        lock = os.open(path / "lock", os.O_CREAT | os.O_RDWR)
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        fail(f"another process is working in {path}; wait for it or choose another --exp-name")
    except OSError as error:
        fail(f"{path} cannot be written ({error.strerror}); run from a folder where you may write")
    try:
        if args.overwrite:
            for old in set(path.iterdir()) - {path / "lock"}:
                shutil.rmtree(old) if old.is_dir() else old.unlink()
        record = path / "args.json"
        try:
            made_with = json.loads(record.read_text()) if record.exists() else wanted
        except ValueError:
            fail(f"{record} is damaged; use --overwrite or another --exp-name")
        differ = [f"{k}={made_with.get(k)} there, {v} here" for k, v in wanted.items() if made_with.get(k) != v]
        if differ:
            fail(f"{path} was made with other arguments ({'; '.join(differ)}); use --overwrite or another --exp-name")
        write_file(record, (json.dumps(wanted, indent=2) + "\n").encode())
        yield path
    finally:
        if {entry.name for entry in path.iterdir()} <= {"lock", "args.json"}:
            shutil.rmtree(path)  # a run that wrote nothing leaves nothing
        os.close(lock)


class StopSignal:
    """Remembers SIGINT, SIGTERM or SIGUSR1, so that a loop can save at a safe point; a second Ctrl-C stops at once."""

    def __init__(self) -> None:
        self.received = False
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGUSR1):
            signal.signal(number, self._handle)

    def _handle(self, number: int, frame: object) -> None:
        self.received = True
        signal.signal(signal.SIGINT, signal.default_int_handler)

    def leave(self, path: Path) -> NoReturn:
        """Say how to go on and leave with exit code 0; the caller has saved."""
        print(f"\nstopped; everything is saved in {path}: run the same command again to go on", flush=True)
        sys.exit(0)


def seed_everything(seed: int, *counter: int) -> None:
    """Seed torch from the run's seed and a counter: updates depend on weights and number only, and resume exactly."""
    torch.manual_seed(int(np.random.SeedSequence([seed, *counter]).generate_state(1)[0]))


def keep_freed_memory() -> None:
    """Let glibc keep what is freed: given back, every large tensor costs a page fault per 4 kB, update after update."""
    libc = ctypes.CDLL(None)
    libc.mallopt(-4, 0)  # M_MMAP_MAX: large tensors from the heap too
    libc.mallopt(-1, 2**31 - 1)  # M_TRIM_THRESHOLD: a heap that does not shrink


def check_finite(terms: dict[str, torch.Tensor], where: str) -> dict[str, float]:
    """Turn loss terms into numbers; one that is not finite ends the run with exit code 1 and leaves the checkpoint."""
    numbers = torch.stack([x.detach() for x in terms.values()]).tolist()  # all at once: one wait for the GPU
    values = dict(zip(terms, numbers, strict=True))
    for name, value in values.items():
        if not math.isfinite(value):
            fail(f"{name} is {value} at {where}; the last checkpoint is kept: try a lower --learning-rate", code=1)
    return values


def run_stage(script: str, args: "Args", output: Path) -> None:
    """Make a missing input: run an earlier stage for the same task, seed, device, backends, robot and --quick."""
    path = Path(__file__).with_name(script)
    if not path.exists():
        fail(f"{output} does not exist, and {script}, which makes it, is not beside {Path(__file__).name}")
    command = [sys.executable, str(path)] + ["--quick"] * args.quick
    for name in ("env_id", "seed", "device", "sim_backend", "render_backend", "robot", "num_workers"):
        if getattr(args, name) is not None:
            command += [f"--{name.replace('_', '-')}", str(getattr(args, name))]
    print(f"{output} does not exist yet; making it with\n  {shlex.join(command)}", flush=True)
    # PR_SET_PDEATHSIG = 1: should this process be killed outright, the stage saves and leaves too
    child = subprocess.Popen(command, preexec_fn=lambda: ctypes.CDLL(None).prctl(1, signal.SIGTERM))
    signals = (signal.SIGINT, signal.SIGTERM, signal.SIGUSR1)
    before = [signal.signal(number, lambda *_: child.terminate()) for number in signals]
    code = child.wait()
    for number, handler in zip(signals, before, strict=True):
        signal.signal(number, handler)
    if code or not output.exists():  # failed, or stopped and saved
        sys.exit(code)


def check_same(path: Path, made: dict, args: "Args", mend: str) -> None:
    """Fail when the input at path was made for another task or robot, or by --quick for a run that is not."""
    for name in ("env_id", "robot"):
        if made[name] != getattr(args, name):
            flag = "--" + name.replace("_", "-")
            fail(
                f"{path} was made with {flag} {made[name]}, this run has {getattr(args, name)}; change {flag} or {mend}"
            )
    if made.get("quick") and not args.quick:
        fail(f"{path} was made with --quick and is no basis for a real run; {mend}")


# ---------------------------------------------------------------- training


def load_episodes(repr_dir: Path, args: "Args", device: torch.device) -> tuple[Episodes, dict, torch.Tensor, dict]:
    """Open stage 1's output, made first where missing: episodes with u = mean of phi(s), sizes, cue (N, K), repr.pt."""
    data, file = repr_dir / "dataset", repr_dir / "repr.pt"
    usual = Path("runs") / f"{args.env_id}__aib_repr__{args.seed}"
    mend = f"make it anew with aib_repr.py --env-id {args.env_id} --robot {args.robot} --seed {args.seed} --overwrite"
    if not file.exists() and repr_dir == usual:
        run_stage("aib_repr.py", args, file)
    stored = load(file, "repr", mend)
    meta, arrays = open_dataset(data, mend)
    check_same(file, stored, args, mend)
    check_same(data, meta, args, mend)
    if (stored["num_episodes"], stored["state_dim"]) != (meta["episodes_done"], arrays["state"].shape[-1]):
        fail(f"{file} and {data} do not belong together: episodes or state sizes differ; {mend}")
    phi = StateEncoder(stored["state_dim"], stored["u_dim"])
    phi.load_state_dict(stored["phi"])
    with torch.no_grad():
        u = phi(torch.from_numpy(np.array(arrays["state"]))).mean.to(device)
    sizes = {"image_shape": list(arrays["rgb"].shape[2:]), "steps": arrays["actions"].shape[1]}
    sizes |= {"joints_dim": arrays["joints"].shape[-1], "action_dim": arrays["actions"].shape[-1]}
    return Episodes(data, u, device), sizes, torch.from_numpy(np.array(arrays["cue"])).to(device), stored


def train_belief(
    args: "Args",
    model: nn.ModuleDict,
    losses: Callable,
    episodes: Episodes,
    train: np.ndarray,
    val: np.ndarray,
    path: Path,
    stop: StopSignal,
    events: Path,
) -> SummaryWriter:
    """Train model = {belief, posterior, ...} on losses(model, batch, args), from the checkpoint in path if any.

    Leaves in model the weights with the best held-out -log p(u|h), z drawn from the prior: what deployment needs.
    Returns the TensorBoard writer of the folder events.
    """
    optimizer = torch.optim.Adam(model.parameters(), lr=args.belief_lr, fused=True)
    done, best_nll, best = 0, math.inf, copy.deepcopy(model.state_dict())
    file, kind = path / "belief_checkpoint.pt", "belief checkpoint"
    if file.exists():
        checkpoint = load(file, kind, "start anew with --overwrite")
        model.load_state_dict(checkpoint["model"])
        optimizer.load_state_dict(checkpoint["optimizer"])
        done, best_nll, best = checkpoint["update"], checkpoint["best_nll"], checkpoint["best"]
        print(f"going on with {path} at update {done} of stage 2", flush=True)

    def draw(update: int) -> dict[str, torch.Tensor]:
        rng = np.random.default_rng([args.seed, update])
        return episodes(rng.choice(train, min(args.batch_episodes, len(train)), replace=False))

    writer = SummaryWriter(events, purge_step=done + 1)  # of an earlier process, rows up to the checkpoint stay
    bar = tqdm(total=args.num_updates, initial=done, desc="stage 2, belief", unit="update")
    start = saved = time.time()
    with ThreadPoolExecutor(1) as pool:  # reads the next batch while this one trains
        ready = pool.submit(draw, done)
        for update in range(done + 1, args.num_updates + 1):
            batch = ready.result()
            if update < args.num_updates:
                ready = pool.submit(draw, update)
            seed_everything(args.seed, 2, update)
            terms = losses(model, batch, args)
            optimizer.zero_grad()
            terms["total"].backward()
            optimizer.step()
            values = check_finite(terms, f"update {update} of stage 2")
            bar.update()
            if update == 2 and args.device == "cpu" and not args.quick:
                hours = (time.time() - start) / 2 * args.num_updates / 3600
                bar.write(f"no CUDA device: {args.num_updates} updates at the rate measured take {hours:.1f} hours")
            if update % 10 == 0:
                for name, value in values.items():
                    writer.add_scalar(f"belief/{name}", value, update)
            if update % args.held_out_every == 0 or update == args.num_updates:
                test = encode(model["belief"], model["posterior"], episodes, val)
                values = {name: test[name].mean().item() for name in ("nll_prior", "nll_posterior")}
                for name, value in values.items():
                    writer.add_scalar(f"belief/held_out_{name}", value, update)
                bar.set_postfix(held_out=f"{values['nll_prior']:.2f}")
                if values["nll_prior"] < best_nll:
                    best_nll, best = values["nll_prior"], copy.deepcopy(model.state_dict())
            if stop.received or time.time() - saved > 60 * args.checkpoint_minutes:
                check_finite({n: x.sum() for n, x in model.named_parameters()}, f"update {update} of stage 2")
                checkpoint = {"model": model.state_dict(), "optimizer": optimizer.state_dict(), "best": best}
                writer.flush()
                save(file, {"kind": kind, "update": update, "best_nll": best_nll, **checkpoint})
                saved = time.time()
            if stop.received:
                stop.leave(path)
    bar.close()
    model.load_state_dict(best)
    return writer


def main(args: Args) -> None:
    """Train the belief on whole episodes, keep the weights best on held-out ones, report what it remembers."""
    keep_freed_memory()
    args = resolve(args, QUICK if args.quick else DEFAULTS)
    args.repr_dir = str(args.repr_dir or Path("runs") / f"{args.env_id}__aib_repr__{args.seed}")
    args.amp = has_bfloat16(args.device) if args.amp is None else args.amp
    with run_directory(args) as path:
        if (path / "belief.pt").exists():
            print(f"{path / 'belief.pt'} is finished; --overwrite makes it anew")
            return
        device = torch.device(args.device)
        episodes, sizes, cue, stored = load_episodes(Path(args.repr_dir), args, device)
        stop = StopSignal()
        train, val = np.split(np.arange(stored["num_episodes"]), [-stored["num_val"]])

        seed_everything(args.seed)
        config = {"image_shape": sizes["image_shape"], "gru_layers": args.gru_layers, "u_dim": stored["u_dim"]}
        config |= {"joints_dim": sizes["joints_dim"] * args.history_joints, "z_dim": args.z_dim}
        config |= {"action_dim": sizes["action_dim"] * args.history_actions}
        belief = AIBBelief(config)
        model = nn.ModuleDict({"belief": belief})
        model["posterior"] = GaussianMLP(stored["u_dim"] + 256, [256, 256], args.z_dim, min_std=0.1)
        if args.action_head != "none":
            known = 2 * args.z_dim + (sizes["action_dim"] + 1 if args.action_head == "flow" else 0)
            model["head"] = mlp([known, 256, sizes["action_dim"]])
        if args.chrono_init:
            chrono_init(belief.history.gru, sizes["steps"])
        if args.image_norm == "mean":
            belief.history.image_mean, belief.history.image_std = image_statistics(episodes.data, train[:256])
        model.to(device)
        writer = train_belief(args, model, belief_losses, episodes, train, val, path, stop, path)

        fit, test = (encode(belief, model["posterior"], episodes, index) for index in (train[:512], val))
        report, readout = diagnose_belief(fit, test, cue[train[:512]], cue[val])
        if args.action_head == "flow":
            report["flow_gain"] = flow_gain(model["head"], test["q"], test["action"])
        write_report(report, path, f"{args.env_id}, {args.exp_name}", writer, args.num_updates)
        content = {
            "kind": "aib_belief",
            "env_id": args.env_id,
            "robot": args.robot,
            "quick": args.quick,
            "config": config,
        }
        content |= {"training_weights": {k: v.cpu() for k, v in model.state_dict().items() if k[:6] != "belief"}}
        save(path / "belief.pt", {**content, "readout": readout, "weights": belief.cpu().state_dict()})
        print(f"{path / 'belief.pt'}: {path / 'diagnostics.png'} shows what it remembers")


if __name__ == "__main__":
    main(tyro.cli(Args))
