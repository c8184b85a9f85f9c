"""AIB stage 2: action-informed belief with a learned prior (paper section 3.2).

A recurrent encoder h of the history, a prior p(z|h), a posterior q(z|u,h) and a decoder p(u|z,h) model what the history
tells about u = phi(s). A flow-matching inverse-dynamics head on (z_t, z_t+1) shapes the posterior; the KL term
transfers it to the prior, the only one available at deployment. With --warmup-updates the history encoder first
learns, on single frames, to find in a picture the object that is to be remembered.

Usage:   python aib_belief.py --env-id InterceptFast-v0
Reads:   --repr-dir, by default runs/{env_id}__aib_repr__{seed}/: dataset/ and repr.pt
Writes:  runs/{env_id}__{exp_name}__{seed}/: belief.pt, TensorBoard events; args.json and checkpoint.pt to resume
"""

import fcntl
import json
import math
import os
import shutil
import signal
import sys
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path
from typing import Literal, NoReturn

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # before torch: idle threads must not starve other runs

import numpy as np
import torch
import tyro
from torch import Tensor, nn
from torch.distributions import Normal, kl_divergence
from torch.utils.tensorboard import SummaryWriter
from tqdm import tqdm

CUDA = torch.cuda.is_available()
VAL_EVERY = 250  # updates of the belief between checkpoints; after the warm-up each comes with a validation
IMAGE_CHUNK = 1024 if CUDA else 16  # images through the image encoder at a time: what a CPU's cache holds
torch.set_float32_matmul_precision("high")  # TF32, where the device has it


# ---------------------------------------------------------------- arguments


@dataclass
class Args:
    env_id: str = "InterceptFast-v0"
    """MIKASA-Robo task"""
    exp_name: str = "aib_belief"
    """results go to runs/{env_id}__{exp_name}__{seed}"""
    seed: int = 1
    """seed of weights, noise and episodes"""
    device: Literal["cpu", "cuda"] = "cuda" if CUDA else "cpu"
    """where the networks live"""
    small: bool = False
    """a reduced setting for a CPU: AIB's three stages take by estimate 3 hours on one core"""
    quick: bool = False
    """a trial of a minute whose results mean nothing"""

    repr_dir: str | None = None
    """run directory of stage 1; by default that of the same task, preset and seed"""
    num_updates: int = 10_000
    """gradient updates of the belief; the paper's 10,000 epochs (Table 3) are taken to be updates"""
    batch_episodes: int = 256
    """whole episodes per update of the belief"""
    belief_lr: float = 3e-4
    """Adam's learning rate for the belief"""
    z_dim: int = 32
    """size of z"""
    beta: float = 1.0
    """weight of KL(q || p)"""
    action_head: Literal["flow", "mse", "none"] = "flow"
    """inverse dynamics by flow matching, by regression, or none"""
    action_lambda: float = 1.0
    """weight of the action head's loss"""
    fm_latent: Literal["mean", "sample"] = "mean"
    """z in L_FM: the mean of q; or a sample of q, which is the paper's choice and mostly noise at first"""
    image_mask: float = 0.25
    """share of the blocks of 2 x 2 pixels that training hides, against overfitting; 0: none"""
    occlusion: float = 0.5
    """after a warm-up: share of the training episodes in which the object is hidden from a random step on"""
    warmup_updates: int = 0
    """updates on single frames before --num-updates, with a teacher in place of the memory; 0: none, as in the paper"""
    prior_nll: float = 0.0
    """weight of -log p(u|z,h) with z from the prior, which is what the robot has; 0: the paper's loss"""


MAY_DIFFER = ()  # of open_run: arguments that may change when a run is resumed
TASKS = {}  # of parse_args: defaults by task; the paper has one setting of this stage for all
SMALL = dict(
    exp_name="aib_belief_small",
    num_updates=1500,
    batch_episodes=16,
    belief_lr=2e-3,
    warmup_updates=2500,
    prior_nll=1.0,
)
QUICK = dict(exp_name="aib_belief_quick", warmup_updates=2, num_updates=4, batch_episodes=4)


# ---------------------------------------------------------------- networks
# identical in all scripts that have them: belief.pt is written by one and read by another


def mlp(sizes: list[int]) -> nn.Sequential:
    """Linear layers of the given sizes with ReLU between them."""
    layers = []
    for inputs, outputs in pairwise(sizes):
        layers += [nn.Linear(inputs, outputs), nn.ReLU()]
    return nn.Sequential(*layers[:-1])


class GaussianMLP(nn.Module):
    """Diagonal Gaussian from an MLP, std = softplus + min_std: (..., inputs) -> Normal over (..., size)."""

    def __init__(self, inputs: int, hidden: list[int], size: int, min_std: float):
        super().__init__()
        self.net = mlp([inputs, *hidden, 2 * size])
        self.min_std = min_std

    def forward(self, x: Tensor) -> Normal:
        mean, raw = self.net(x).chunk(2, -1)
        return Normal(mean, nn.functional.softplus(raw) + self.min_std, validate_args=False)


def orthogonal_init(module: nn.Module, gain: float = 2**0.5) -> nn.Module:
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

    def forward(self, state: Tensor) -> Normal:
        return self.net((state - self.mean) / self.std)


KEY_DIM = 16  # of a query, and of the keys that it is compared with
PLACE_DIM = 2 + 8  # coordinates and values of what a query finds
MEMORY_DIM = 32  # of which the first KEY_DIM ask
NUM_COLOURS = 16  # of the palette
KEYPOINTS_DIM = 3 * NUM_COLOURS  # of each colour: row, column, and whether it is there


class ImageEncoder(nn.Module):
    """What can be found in an image: 16 x 16 patches with keys to ask for, and a keypoint for each colour of a palette.

    Keys hold no coordinates, so that layouts of scenes cannot be memorised. A keypoint, as the place of a moving ball,
    is where its colour is: the spatial softmax of Levine et al. (2016) over single pixels, but of a palette's colours
    in place of learnt features, of which some seeds miss the ball.
    """

    def __init__(self, image_shape: list[int]):
        super().__init__()
        height, width, _ = image_shape
        self.every = max(1, min(height, width) // 64)  # of the pixels that keypoints look at
        self.patch = min(height, width) // 16 // self.every * self.every  # pixels
        self.register_buffer("mean", torch.zeros(image_shape))
        self.register_buffer("std", torch.tensor(255.0))
        self.register_buffer("palette", torch.zeros(NUM_COLOURS, 3))
        patches = [torch.linspace(-1, 1, length // self.patch) for length in (height, width)]
        pixels = [torch.linspace(-1, 1, len(range(0, length, self.every))) for length in (height, width)]
        self.register_buffer("patch_coordinates", torch.cartesian_prod(*patches))
        self.register_buffer("pixel_coordinates", torch.cartesian_prod(*pixels))
        self.token = orthogonal_init(nn.Sequential(mlp([3 * self.patch**2 + NUM_COLOURS, 64, 64]), nn.ReLU()))
        self.token_heads = nn.Linear(64, KEY_DIM + 8)

    def forward(self, rgb: Tensor, mask: float = 0.0) -> tuple[Tensor, Tensor, Tensor]:
        """Images (B, H, W, 3) uint8 -> keys (B, N, 16) and contents (B, N, 10) of N patches, keypoints (B, 48).

        Contents are coordinates and values. mask, in training: share of the blocks of 2 x 2 pixels that the patches
        have replaced by the mean.
        """
        likeness = self.likeness(rgb)
        weights = likeness.flatten(2)
        places = weights @ self.pixel_coordinates / weights.sum(-1, keepdim=True)
        most = nn.functional.max_pool2d(likeness, likeness.shape[2:]).flatten(2)  # on a CPU faster than amax
        keypoints = torch.cat([places, most], -1).flatten(1)
        images = (rgb.float() - self.mean) / self.std
        if mask:
            batch, height, width, _ = rgb.shape
            kept = torch.rand(batch, (height + 1) // 2, (width + 1) // 2, device=rgb.device) >= mask
            kept = kept.repeat_interleave(2, 1).repeat_interleave(2, 2)[:, :height, :width]
            images = images * kept.unsqueeze(-1)
        patches = images.unfold(1, self.patch, self.patch).unfold(2, self.patch, self.patch).flatten(1, 2).flatten(2)
        shown = nn.functional.avg_pool2d(likeness, self.patch // self.every).flatten(2).mT
        # 10: a small object shows its colour in a few pixels of a patch
        tokens = self.token(torch.cat([patches, 10 * shown], -1))
        keys, values = self.token_heads(tokens).split([KEY_DIM, 8], -1)
        contents = torch.cat([self.patch_coordinates.expand(len(rgb), -1, -1), values], -1)
        return keys, contents, keypoints

    @torch.no_grad()
    def likeness(self, rgb: Tensor) -> Tensor:
        """Images (B, H, W, 3) uint8 -> how like their pixels are to each colour (B, 16, H / every, W / every).

        It is exp(-d^2 / 2), with the distance d of two colours in units of 16 levels of 255.
        """
        colours = rgb[:, :: self.every, :: self.every].movedim(-1, 1).float()
        # -d^2 / 2 as a 1 x 1 convolution; in place, as large temporary tensors take a CPU longer than the arithmetic
        x = nn.functional.conv2d(colours, self.palette[:, :, None, None], -self.palette.square().sum(1) / 2)
        x -= colours.square().sum(1, keepdim=True) / 2
        return x.div_(16**2).clamp_(min=-40).exp_()  # exp of less is subnormal, which is slow on a CPU


def spread_colours(colours: Tensor) -> Tensor:
    """A palette (NUM_COLOURS, 3): of the colours (M, 3) each the farthest from the mean and from those before."""
    chosen = [colours.mean(0)]
    distance = torch.full((len(colours),), math.inf, device=colours.device)
    for _ in range(NUM_COLOURS):
        distance = torch.minimum(distance, (colours - chosen[-1]).square().sum(-1))
        chosen.append(colours[distance.argmax()])
    return torch.stack(chosen[1:])


class HistoryEncoder(nn.Module):
    """h_t of the observations o_0, ..., o_t: memory asks, the picture answers.

    The paper (3.2) says only that a GRU summarises the history; this network is ours, as a flattened CNN memorises the
    layouts of its training scenes.
    1. memory = code(state of the GRU before o_t), of which the first half asks.
    2. A query made of that half attends to the patches of o_t, which gives a place: coordinates and values. Where the
       attention is not sure, as the arm hides the object, the place stays the one of the step before.
    3. h_t = MLP(memory, place, keypoints) + linear(joints). The GRU then gets place and keypoints of o_t.
    Past actions (E.2) are not in the history: the joints at t and t + 1 show a_t anyway.
    """

    def __init__(self, config: dict):
        super().__init__()
        self.image = ImageEncoder(config["image_shape"])
        self.register_buffer("joints_mean", torch.zeros(config["joints_dim"]))
        self.register_buffer("joints_std", torch.ones(config["joints_dim"]))
        self.code = nn.Linear(256, MEMORY_DIM)
        self.query = orthogonal_init(mlp([KEY_DIM, 64, KEY_DIM]))
        self.sure = nn.Linear(1, 1)  # of the attention's largest weight w; at first sigmoid(10 w - 4)
        nn.init.constant_(self.sure.weight, 10.0)
        nn.init.constant_(self.sure.bias, -4.0)
        self.place = orthogonal_init(mlp([PLACE_DIM + KEYPOINTS_DIM, 64, 64]))
        self.out = orthogonal_init(mlp([MEMORY_DIM + 64, 256, 256]))
        self.arm = nn.Linear(config["joints_dim"], 256)
        nn.init.zeros_(self.arm.weight)  # joints identify an episode: let the rest learn first
        nn.init.zeros_(self.arm.bias)
        self.gru = nn.GRUCell(64, 256)

    def ask(self, memory: Tensor, keys: Tensor, contents: Tensor) -> tuple[Tensor, Tensor]:
        """Memory (B, 32), of which the first KEY_DIM ask -> place (B, 10), weights of the patches (B, N).

        Without the usual 1 / sqrt(16), logits of normalised query and keys lie in [-16, 16], and softmax can single out
        one patch of hundreds.
        """
        query = nn.functional.layer_norm(self.query(memory[:, :KEY_DIM]), [KEY_DIM])
        keys = nn.functional.layer_norm(keys, [KEY_DIM])
        weights = (keys * query.unsqueeze(-2)).sum(-1).softmax(-1)
        return (weights.unsqueeze(-1) * contents).sum(-2), weights

    def keep(self, place: Tensor, weights: Tensor, before: Tensor) -> Tensor:
        """The place (B, 10) as far as the attention, of weights (B, N), is sure of it; else the one before."""
        sure = self.sure(weights.amax(-1, keepdim=True)).sigmoid()
        return before + sure * (place - before)

    def step(
        self, hidden: Tensor, place: Tensor, keys: Tensor, contents: Tensor, keypoints: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """One step of the recurrence: the GRU's state (B, 256) and the place (B, 10) before; what ImageEncoder found.

        Returns memory (B, 32), embedded places (B, 64), and the GRU's state and the place after.
        """
        memory = self.code(hidden)
        place = self.keep(*self.ask(memory, keys, contents), place)
        embedded = self.place(torch.cat([place, keypoints], -1))
        return memory, embedded, self.gru(embedded, hidden), place

    def combine(self, memory: Tensor, embedded: Tensor, joints: Tensor) -> Tensor:
        """h (..., 256) of memory (..., 32), embedded places (..., 64) and joints (..., J)."""
        arm = self.arm((joints - self.joints_mean) / self.joints_std)
        return self.out(torch.cat([memory, embedded], -1)) + arm

    def forward(self, rgb: Tensor, joints: Tensor, recurrent: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """One step: rgb (B, H, W, 3) uint8, joints (B, J), recurrent state before (None: 0) -> h (B, 256), and after.

        The recurrent state is the GRU's and the place, (B, 256 + 10).
        """
        if recurrent is None:
            recurrent = joints.new_zeros(len(rgb), 256 + PLACE_DIM)
        memory, embedded, *after = self.step(*recurrent.split([256, PLACE_DIM], -1), *self.image(rgb))
        return self.combine(memory, embedded, joints), torch.cat(after, -1)


def chrono_init(gru: nn.GRUCell, steps: int) -> None:
    """Let the GRU begin with time constants of 2 to steps: bias log U(1, steps - 1) (Tallec and Ollivier, 2018)."""
    # PyTorch's order is reset, update, new; h' = (1 - update) * new + update * h
    update = slice(gru.hidden_size, 2 * gru.hidden_size)
    with torch.no_grad():
        gru.bias_ih[update] = torch.empty(gru.hidden_size).uniform_(1, steps - 1).log()
        gru.bias_hh[update] = 0


class AIBBelief(nn.Module):
    """b(h): history encoder, learned prior p(z|h) and decoder p(u|z,h) (paper 3.2).

    config: image_shape [H, W, 3], joints_dim, u_dim, z_dim.
    """

    def __init__(self, config: dict):
        super().__init__()
        self.config = config
        self.history = HistoryEncoder(config)
        self.prior = GaussianMLP(256, [256], config["z_dim"], min_std=0.1)
        self.decoder = GaussianMLP(config["z_dim"] + 256, [256, 256], config["u_dim"], min_std=0.1)

    def decode(self, h: Tensor, z_noise: Tensor) -> Normal:
        """p(u|z_i,h) for n samples z_i ~ p(z|h): h (..., 256), z_noise (..., n, z_dim) -> Normal (..., n, u_dim)."""
        p = self.prior(h)
        z = p.mean.unsqueeze(-2) + p.stddev.unsqueeze(-2) * z_noise
        return self.decoder(torch.cat([z, h.unsqueeze(-2).expand(*z.shape[:-1], -1)], -1))


# ---------------------------------------------------------------- losses


def encode_images(image: nn.Module, rgb: Tensor, mask: float = 0.0) -> list[Tensor]:
    """What ImageEncoder finds in images (M, H, W, 3), IMAGE_CHUNK of them at a time."""
    return [torch.cat(x) for x in zip(*(image(chunk, mask) for chunk in rgb.split(IMAGE_CHUNK)), strict=True)]


def encode_history(history: nn.Module, batch: dict[str, Tensor], mask: float = 0.0) -> tuple[Tensor, Tensor]:
    """h (T+1, B, 256) and memory (T+1, B, 32) of whole episodes: rgb (T+1, B, H, W, 3) uint8, joints (T+1, B, J)."""
    num_steps, num_episodes = batch["rgb"].shape[:2]
    seen = encode_images(history.image, batch["rgb"].flatten(0, 1), mask)
    seen = [x.unflatten(0, (num_steps, num_episodes)) for x in seen]
    hidden, place = batch["joints"].new_zeros(num_episodes, 256), batch["joints"].new_zeros(num_episodes, PLACE_DIM)
    memories, embedded = [], []
    for t in range(num_steps):
        memory, found, hidden, place = history.step(hidden, place, *(x[t] for x in seen))
        memories.append(memory)
        embedded.append(found)
    memory = torch.stack(memories)
    return history.combine(memory, torch.stack(embedded), batch["joints"]), memory


def elbo_terms(belief: nn.Module, posterior: nn.Module, u: Tensor, h: Tensor) -> tuple[Tensor, ...]:
    """The two terms of -L_VAE, of u (..., u_dim) and h (..., 256), and z.

    Returns -log p(u|z,h) at a sample z ~ q (...,), KL(q || p) (...,), that sample (..., z_dim), q's mean (..., z_dim).
    """
    q = posterior(torch.cat([u, h], -1))
    z = q.rsample()
    nll = -belief.decoder(torch.cat([z, h], -1)).log_prob(u).sum(-1)
    return nll, kl_divergence(q, belief.prior(h)).sum(-1), z, q.mean


def flow_matching_loss(
    head: nn.Module, action: Tensor, z: Tensor, z_next: Tensor, noise: Tensor, tau: Tensor
) -> Tensor:
    """L_FM at each step (...,): the velocity at a_tau = (1 - tau) a_0 + tau a_1 against a_1 - a_0.

    action a_1 and noise a_0 (..., A); z and z_next (..., z_dim); tau (..., 1) in [0, 1].
    """
    a_tau = (1 - tau) * noise + tau * action
    velocity = head(torch.cat([a_tau, tau, z, z_next], -1))
    return (velocity - (action - noise)).square().sum(-1)


def belief_losses(model: nn.ModuleDict, batch: dict[str, Tensor], args: Args) -> dict[str, Tensor]:
    """L_Total = -L_VAE + lambda L_FM, with the KL in L_VAE weighted by beta, and its terms; means over the batch.

    batch: of EpisodeDataset. --fm-latent: z in L_FM is q's mean, or a sample of q (the paper's choice).
    --action-head mse: the squared error of the predicted action in place of L_FM; none: neither.
    --prior-nll and --warmup-updates add a term each that the paper does not have.
    """
    h, memory = encode_history(model["belief"].history, batch, args.image_mask)
    nll, kl, z_sample, z_mean = elbo_terms(model["belief"], model["posterior"], batch["u"], h)
    losses = {"nll": nll.mean(), "kl": kl.mean()}
    losses["total"] = losses["nll"] + args.beta * losses["kl"]
    if args.action_head != "none":
        latent = z_mean if args.fm_latent == "mean" else z_sample
        action, z, z_next = batch["actions"], latent[:-1], latent[1:]
        if args.action_head == "flow":
            noise, tau = torch.randn_like(action), torch.rand_like(action[..., :1])
            losses["action"] = flow_matching_loss(model["head"], action, z, z_next, noise, tau).mean()
        else:
            losses["action"] = (model["head"](torch.cat([z, z_next], -1)) - action).square().sum(-1).mean()
        losses["total"] = losses["total"] + args.action_lambda * losses["action"]
    if args.prior_nll:
        losses["prior_nll"] = prior_nll_loss(model["belief"], batch["u"], h)
        losses["total"] = losses["total"] + args.prior_nll * losses["prior_nll"]
    if args.warmup_updates:
        losses["memory"] = memory_loss(model["teacher"], batch["u"], memory)
        losses["total"] = losses["total"] + 10 * losses["memory"]  # 10: of the order of the other terms
    return losses


# ---------------------------------------------------------------- warm-up
# not in the paper, and off unless --warmup-updates or --prior-nll is given, as by --small: how attention learns to find
# objects, and the losses that come with it


class Teacher(nn.Module):
    """What to remember at step t, told by the first privileged state: u_0 (B, u_dim), t (B,) -> memory (B, 16)."""

    def __init__(self, u_dim: int):
        super().__init__()
        self.standardise = nn.BatchNorm1d(u_dim, eps=0.05**2, affine=False)  # as if each std were at least 0.05
        self.net = orthogonal_init(mlp([u_dim + 1, 64, KEY_DIM]))

    def forward(self, u_0: Tensor, t: Tensor) -> Tensor:
        return self.net(torch.cat([self.standardise(u_0), t.log1p().unsqueeze(-1)], -1))


def warmup_loss(model: nn.ModuleDict, batch: dict[str, Tensor], args: Args) -> Tensor:
    """How well the history encoder finds what it is asked for, in single frames (B, ...): a squared error, mean ().

    There is no memory in them: the teacher's, of the privileged state at the episode's start, asks in place of the
    GRU's (as in the first phase of Kumar et al., 2021). The error is that of u, decoded with z from the prior: the mean
    of two, from memory and place, and from the place alone.
    """
    belief, history, u = model["belief"], model["belief"].history, batch["u"]
    keys, contents, keypoints = encode_images(history.image, batch["rgb"], args.image_mask)
    memory = model["teacher"](batch["u_0"], batch["t"])
    memory = nn.functional.pad(memory, (0, MEMORY_DIM - KEY_DIM))  # the half that does not ask is empty
    place, _ = history.ask(memory, keys, contents)
    # the teacher's memory and the keypoints tell much of u: with them alone the attention would not learn to look
    embedded = history.place(torch.cat([place, torch.zeros_like(keypoints)], -1))
    errors = []
    for seen_memory in (memory, torch.zeros_like(memory)):
        h = history.combine(seen_memory, embedded, history.joints_mean)  # joints would identify an episode
        decoded = belief.decode(h, torch.randn(len(h), 1, args.z_dim, device=h.device)).mean.squeeze(-2)
        errors.append((decoded - u).square().sum(-1).mean())
    return sum(errors) / 2


@torch.no_grad()
def hide_objects(model: nn.ModuleDict, batch: dict[str, Tensor], share: float, rng: np.random.Generator) -> None:
    """In a share of episodes hide the place that the teacher asks for, from a random step on, as the arm hides objects.

    Changes rgb (T+1, B, H, W, 3), a copy of the dataset's: a rectangle of one colour, as wide and high as a quarter to
    a half of the picture.
    """
    rgb, history = batch["rgb"], model["belief"].history
    episodes = np.flatnonzero(rng.random(rgb.shape[1]) < share)
    if not len(episodes):
        return
    t = rng.integers(len(rgb), size=len(episodes))
    memory = model["teacher"](batch["u"][0, episodes], torch.from_numpy(t).to(rgb.device))
    keys, contents, *_ = history.image(rgb[t, episodes])
    place, _ = history.ask(memory, keys, contents)
    size = np.array(rgb.shape[2:4])
    centres = (place[:, :2].cpu().numpy() + 1) / 2 * size  # in pixels, within half a patch
    for step, episode, centre in zip(t, episodes, centres, strict=True):
        half = rng.integers(size // 8, size // 4)
        top, left = (centre - half).clip(0).astype(int)
        bottom, right = (centre + half).astype(int)
        colour = torch.from_numpy(rng.integers(256, size=3, dtype=np.uint8)).to(rgb.device)
        rgb[step:, episode, top:bottom, left:right] = colour


def prior_nll_loss(belief: nn.Module, u: Tensor, h: Tensor) -> Tensor:
    """-log p(u|z,h) with z from the prior, which is what the robot has: u (..., u_dim), h (..., 256) -> mean ()."""
    decoded = belief.decode(h, torch.randn(*h.shape[:-1], 1, belief.config["z_dim"], device=h.device))
    return -decoded.log_prob(u.unsqueeze(-2)).sum(-1).mean()


def memory_loss(teacher: nn.Module, u: Tensor, memory: Tensor) -> Tensor:
    """Squared error of the half of the memory (T+1, B, 32) that asks from the teacher's: u (T+1, B, u_dim) -> ()."""
    num_frames, num_episodes = u.shape[:2]
    t = torch.arange(num_frames, device=u.device).repeat_interleave(num_episodes)
    wanted = teacher(u[0].repeat(num_frames, 1), t).detach().unflatten(0, (num_frames, num_episodes))
    return (memory[..., :KEY_DIM] - wanted).square().sum(-1).mean()


# ---------------------------------------------------------------- data


class EpisodeDataset:
    """Whole episodes of dataset/ and their u (N, T+1, u_dim), on the disk, or on the GPU where they fit there."""

    def __init__(self, dataset: Path, u: Tensor, device: str):
        self.device, self.arrays = device, {"u": u.to(device)}
        for name in ("rgb", "joints", "actions"):
            x = torch.from_numpy(np.load(dataset / f"{name}.npy", mmap_mode="c"))  # torch warns of "r", read-only
            fits = device == "cuda" and x.nbytes < torch.cuda.mem_get_info()[0] / 2
            self.arrays[name] = x.to(device) if fits else x

    def __len__(self) -> int:
        return len(self.arrays["u"])

    def __call__(self, index: np.ndarray) -> dict[str, Tensor]:
        """Episodes index (B,): rgb (T+1, B, H, W, 3), joints, u (T+1, B, .), actions (T, B, A)."""
        return {name: x[index].to(self.device).transpose(0, 1) for name, x in self.arrays.items()}

    def frames(self, episode: np.ndarray, t: np.ndarray) -> dict[str, Tensor]:
        """Single frames of episodes (B,) at steps t (B,): rgb (B, H, W, 3), u, t, and the episode's first u, u_0."""
        batch = {name: self.arrays[name][episode, t].to(self.device) for name in ("rgb", "u")}
        return batch | {"u_0": self.arrays["u"][episode, 0].to(self.device), "t": torch.from_numpy(t).to(self.device)}


def load_episodes(args: Args, **expected: object) -> tuple[EpisodeDataset, dict]:
    """Open stage 1's output: episodes with u = mean of phi(s), and repr.pt, checked by load."""
    if args.batch_episodes < 1 or args.image_mask >= 1:
        fail(f"--batch-episodes {args.batch_episodes} must be at least 1, --image-mask {args.image_mask} below 1")
    preset = "small" if args.small else "quick" if args.quick else ""
    suffix, flag = (f"_{preset}", f"--{preset}") if preset else ("", "")
    path = Path(args.repr_dir or f"runs/{args.env_id}__aib_repr{suffix}__{args.seed}")
    if not (path / "repr.pt").exists():
        command = f"python aib_repr.py --env-id {args.env_id} --seed {args.seed} {flag}"
        fail(f"{path / 'repr.pt'} does not exist; correct --repr-dir, or run first: {command}")
    stored = load(path / "repr.pt", **expected)
    phi = StateEncoder(len(stored["phi"]["mean"]), stored["u_dim"])
    phi.load_state_dict(stored["phi"])
    with torch.no_grad():
        u = phi(torch.from_numpy(np.load(path / "dataset" / "state.npy"))).mean
    return EpisodeDataset(path / "dataset", u, args.device), stored


# ---------------------------------------------------------------- evaluation


@torch.no_grad()
def validate_belief(belief: nn.Module, episodes: EpisodeDataset, index: np.ndarray) -> tuple[Tensor, Tensor]:
    """u and mean particle, of 30 means of p(u|z,h), both (T+1, E, u_dim), of episodes index (E,)."""
    torch.manual_seed(0)  # the same noise every time, so that errors compare
    num_particles = 30
    u, estimate = [], []
    for chunk in np.array_split(index, math.ceil(len(index) / 16)):
        batch = episodes(chunk)
        h = encode_history(belief.history, batch)[0]
        z_noise = torch.randn(*h.shape[:-1], num_particles, belief.config["z_dim"], device=h.device)
        decoded = belief.decode(h, z_noise)
        u.append(batch["u"])
        estimate.append(decoded.mean.mean(-2))
    return torch.cat(u, 1), torch.cat(estimate, 1)


def r_squared(u: Tensor, estimate: Tensor) -> float:
    """R2 of u (M, u_dim) from its estimate: 1 if that is u, 0 if it is no better than the mean of u."""
    return 1 - ((u - estimate).square().sum() / (u - u.mean(0)).square().sum()).item()


# ---------------------------------------------------------------- training


def main(args: Args) -> None:
    """Train the belief on whole episodes, report what it remembers of held-out ones."""
    if args.device == "cuda" and not CUDA:
        fail("torch sees no CUDA device here; use --device cpu")
    path = open_run(args)
    if (path / "belief.pt").exists():
        print(f"{path / 'belief.pt'} is finished")
        return
    episodes, stored = load_episodes(args, env_id=args.env_id)
    num_val = stored["num_val"]
    train, held_out = np.split(np.arange(len(episodes)), [-num_val])
    example = episodes(train[:1])
    action_dim = example["actions"].shape[-1]
    config = {
        "image_shape": list(example["rgb"].shape[2:]),
        "joints_dim": example["joints"].shape[-1],
        "u_dim": stored["u_dim"],
        "z_dim": args.z_dim,
    }
    torch.manual_seed(args.seed)
    model = nn.ModuleDict({"belief": AIBBelief(config)})
    # belief.pt holds the belief alone; all else serves its training
    model["posterior"] = GaussianMLP(stored["u_dim"] + 256, [256, 256], args.z_dim, min_std=0.1)
    if args.warmup_updates:
        model["teacher"] = Teacher(config["u_dim"])
    if args.action_head != "none":
        inputs = 2 * args.z_dim + (action_dim + 1 if args.action_head == "flow" else 0)
        model["head"] = mlp([inputs, 256, action_dim])
    history = model["belief"].history
    chrono_init(history.gru, len(example["actions"]))
    history.image.mean, history.image.std = stored["norm"]["image_mean"], stored["norm"]["image_std"]
    rng = np.random.default_rng(args.seed)
    pictures = episodes.frames(rng.choice(train, 64), rng.integers(len(example["rgb"]), size=64))["rgb"].cpu()
    history.image.palette = spread_colours(pictures.flatten(0, -2).float())
    history.joints_mean, history.joints_std = stored["norm"]["joints_mean"], stored["norm"]["joints_std"]
    model.to(args.device)
    optimizer = torch.optim.Adam(model.parameters(), lr=args.belief_lr, fused=True)
    completed = 0
    if (path / "checkpoint.pt").exists():
        checkpoint = load(path / "checkpoint.pt")
        model.load_state_dict(checkpoint["model"])
        optimizer.load_state_dict(checkpoint["optimizer"])
        completed = checkpoint["update"]
        print(f"resuming {path} at update {completed}", flush=True)
    writer = SummaryWriter(path, purge_step=completed + 1)
    num_updates = args.warmup_updates + args.num_updates
    bar = tqdm(range(completed + 1, num_updates + 1), "belief", num_updates, initial=completed, unit="update")

    for update in bar:
        rng = np.random.default_rng([args.seed, update])
        torch.manual_seed(args.seed * 1_000_000 + update)  # so that a resumed run repeats the update
        warming_up = update <= args.warmup_updates
        if warming_up:
            progress = (update - 1) / args.warmup_updates
        else:
            progress = (update - args.warmup_updates - 1) / args.num_updates
            if progress == 0:  # Adam's averages of the warm-up's small gradients would make too large steps
                optimizer.state.clear()
        # falls to 0 over the second half of each phase, which lowers the error of the last weights
        optimizer.param_groups[0]["lr"] = args.belief_lr * min(1, 2 * (1 - progress))
        if args.warmup_updates:  # after it image encoder and teacher stay as they are: updates are twice as fast
            history.image.requires_grad_(warming_up)
            model["teacher"].train(warming_up)
        if warming_up:
            episode = rng.choice(train, 8 * args.batch_episodes)
            # early steps more often (density t^(-1/3)), as they show what is to be remembered
            t = (len(example["rgb"]) * rng.random(len(episode)) ** 1.5).astype(int)
            frames = episodes.frames(episode, t)
            losses = {"total": warmup_loss(model, frames, args)}
        else:
            batch = episodes(rng.choice(train, min(args.batch_episodes, len(train)), replace=False))
            if args.warmup_updates:  # else the teacher knows nothing
                hide_objects(model, batch, args.occlusion, rng)
            losses = belief_losses(model, batch, args)
        optimizer.zero_grad()
        losses["total"].backward()
        # one bad batch can erase what h remembers
        nn.utils.clip_grad_norm_(model.parameters(), 10.0, error_if_nonfinite=True)
        optimizer.step()
        if update % 10 == 0:
            for name, value in losses.items():
                writer.add_scalar(f"{'warmup' if warming_up else 'belief'}/{name}", value, update)

        if update % VAL_EVERY == 0 or update == num_updates:
            if not warming_up:  # a warm-up trains no memory
                u, estimate = validate_belief(model["belief"], episodes, held_out)
                error = (u - estimate).square().sum(-1).mean().item()
                writer.add_scalar("belief/held_out_error", error, update)
                bar.set_postfix(held_out_error=f"{error:.3f}")
            writer.flush()
            checkpoint = {"update": update, "model": model.state_dict(), "optimizer": optimizer.state_dict()}
            save(path / "checkpoint.pt", checkpoint)

    u, estimate = validate_belief(model["belief"], episodes, held_out)  # again: a resumed run may skip the loop
    for t in range(len(u)):
        writer.add_scalar("belief/held_out_u_r2_by_step", r_squared(u[t], estimate[t]), t)
    writer.close()
    # the last weights: the error on held-out episodes is lowest before h has learnt the cue
    content = {"script": "aib_belief", **asdict(args), "config": config}
    content |= {name: stored[name] for name in ("robot_triangles", "image_size")}
    save(path / "belief.pt", {**content, "belief": model["belief"].state_dict()})
    print(f"{path / 'belief.pt'}, at the last step of held-out episodes: R2 of u {r_squared(u[-1], estimate[-1]):.2f}")


# ---------------------------------------------------------------- files
# identical in all scripts that have them


def fail(message: str) -> NoReturn:
    """Say on stderr, in one sentence, what is wrong and what to do, and leave with exit code 2."""
    tqdm.write(f"error: {message}", file=sys.stderr)  # on a line of its own, below any progress bar
    sys.exit(2)


def parse_args() -> Args:
    """Read the command line; defaults follow --env-id, --small and --quick, so that --help shows what will run."""
    chosen, _ = tyro.cli(Args, add_help=False, return_unknown_args=True)  # only for what selects the defaults
    settings = TASKS.get(chosen.env_id, {}) | (QUICK if chosen.quick else SMALL if chosen.small else {})
    args = tyro.cli(Args, default=Args(env_id=chosen.env_id, **settings), description=__doc__.partition("Usage:")[0])
    if args.small and args.quick:
        fail("--small and --quick exclude each other; give one of them")
    if "/" in args.exp_name:
        fail(f"--exp-name {args.exp_name} must be a folder's name, without /")
    for name, value in asdict(args).items():
        if isinstance(value, int | float) and not value >= 0:  # NaN, too
            fail(f"--{name.replace('_', '-')} {value} must not be negative")
    return args


def open_run(args: Args) -> Path:
    """Make runs/{env_id}__{exp_name}__{seed} and lock it until this process ends.

    Fails when another process has the lock, or when the run was begun with other arguments.
    """
    path = Path("runs") / f"{args.env_id}__{args.exp_name}__{args.seed}"
    try:
        path.mkdir(parents=True, exist_ok=True)
        fcntl.flock(os.open(path, os.O_RDONLY), fcntl.LOCK_EX | fcntl.LOCK_NB)  # held as long as the process lives
    except OSError as error:
        fail(f"{path} is another process's or cannot be written ({error.strerror}); wait or choose another --exp-name")
    given, changed = asdict(args), []
    if (path / "args.json").exists() and len(list(path.iterdir())) > 1:  # more than its arguments
        for name, value in load(path / "args.json").items():
            if name in given and name not in MAY_DIFFER and value != given[name]:
                changed.append(f"{name}={value} there, {given[name]} here")
    if changed:
        fail(
            f"{path} was begun with other arguments ({'; '.join(changed)}); "
            f"delete it with rm -r {path}, or choose another --exp-name"
        )
    save(path / "args.json", json.dumps(given, indent=2).encode())
    return path


def save(path: Path, content: dict | bytes) -> None:
    """Write a .pt file (dict) or plain bytes whole or not at all: to a temporary name, then renamed."""
    part = path.with_name(path.name + ".part")
    try:
        path.parent.mkdir(exist_ok=True)
        torch.save(content, part) if isinstance(content, dict) else part.write_bytes(content)
        os.replace(part, path)
    except (OSError, RuntimeError) as error:  # torch.save says of a full disk: RuntimeError
        part.unlink(missing_ok=True)
        free = shutil.disk_usage(path.parent).free / 1e6
        fail(f"{path} cannot be written ({error}; {free:.0f} MB are free); make room, and the same command goes on")


def load(path: Path, **expected: object) -> dict:
    """Read a .pt or .json file that save wrote; fails where it is missing, damaged, or other than expected."""
    if not path.exists():
        fail(f"{path} does not exist; run the script that writes it first, or correct the path")
    try:
        content = torch.load(path, map_location="cpu") if path.suffix == ".pt" else json.loads(path.read_text())
    except (EOFError, RuntimeError, ValueError):
        fail(f"{path} is damaged; copy it anew, or delete what the run wrote and start it again")
    for name, value in expected.items():
        if content.get(name) != value:
            fail(f"{path} has {name} {content.get(name)}, this run needs {value}")
    return content


if __name__ == "__main__":
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # what a scheduler sends is a Ctrl-C, too
    try:
        main(parse_args())
    except KeyboardInterrupt:
        sys.exit("\nstopped; the same command resumes the run from what was saved last")
