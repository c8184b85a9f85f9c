"""The Believer baseline after stage 1 (Wang et al., 2023): a belief with a fixed prior, then PPO on both.

Where aib_belief.py learns a prior p(z|h) and shapes z by inverse dynamics, Believer draws z from N(0, I) and has no
action head. Networks, settings, PPO and evaluation are those of aib_belief.py and ppo_aib.py.

Usage:   python ppo_believer.py --env-id InterceptFast-v0
         python ppo_believer.py --evaluate --checkpoint runs/InterceptFast-v0__ppo_believer__1/agent.pt
Reads:   --repr-dir, by default runs/{env_id}__aib_repr__{seed}/: dataset/ and repr.pt; or another run's --belief
Writes:  runs/{env_id}__{exp_name}__{seed}/: belief.pt, agent.pt, eval.csv, videos/, TensorBoard events (the belief's
         in belief_events/); args.json, belief_checkpoint.pt and checkpoint.pt to resume; with --evaluate
         evaluation.json and .mp4 beside agent.pt
"""

import difflib
import fcntl
import json
import math
import multiprocessing
import os
import shutil
import signal
import sys
import time
import zipfile
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path
from typing import Literal, NoReturn

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # before torch: idle threads must not starve other runs

import colorednoise
import gymnasium as gym
import imageio.v3 as iio
import mikasa_robo_suite.rl.memory_envs  # noqa: F401  (registers the tasks)
import numpy as np
import sapien
import torch
import trimesh
import tyro
from mani_skill.utils import assets, common, registration, wrappers
from mani_skill.vector.wrappers.gymnasium import ManiSkillVectorEnv
from sapien.render import RenderBodyComponent, RenderShapeTriangleMesh
from torch import Tensor, nn
from torch.distributions import Normal, kl_divergence
from torch.utils.tensorboard import SummaryWriter
from tqdm import tqdm

CUDA = torch.cuda.is_available()
VAL_EVERY = 250  # updates of the belief between checkpoints; after the warm-up each comes with a validation
IMAGE_CHUNK = 1024 if CUDA else 16  # images through the image encoder at a time: what a CPU's cache holds
BFLOAT16 = "bf16" in Path("/proc/cpuinfo").read_text()
if CUDA:
    BFLOAT16 = torch.cuda.is_bf16_supported(including_emulation=False)
# seeds of episodes: PPO's below 2**30, then stage 1's, evaluations' from EVAL_SEED on, --evaluate's from TEST_SEED on
EVAL_SEED = 2**30 + 2**29
TEST_SEED = EVAL_SEED + 2**20
torch.set_float32_matmul_precision("high")  # TF32, where the device has it


# ---------------------------------------------------------------- arguments


@dataclass
class Args:
    env_id: str = "InterceptFast-v0"
    """MIKASA-Robo task"""
    exp_name: str = "ppo_believer"
    """results go to runs/{env_id}__{exp_name}__{seed}"""
    seed: int = 1
    """seed of weights, noise and episodes"""
    device: Literal["cpu", "cuda"] = "cuda" if CUDA else "cpu"
    """where the networks live"""
    sim_backend: Literal["physx_cpu", "physx_cuda"] = "physx_cuda" if CUDA else "physx_cpu"
    """physx_cpu: one process per scene; physx_cuda: all scenes as one batch on the GPU"""
    render_backend: Literal["sapien_cpu", "sapien_cuda"] = "sapien_cuda" if CUDA else "sapien_cpu"
    """renderer"""
    robot_triangles: int = 0 if CUDA else 500
    """draw each robot mesh with about as many triangles; 500: a CPU is 8 to 16 times as fast; 0: all, for physx_cuda"""
    image_size: int = 128
    """width and height of the camera's pictures, in pixels, at least 36; MIKASA-Robo's have 128"""
    num_workers: int = 16 if CUDA else min(16, 2 * len(os.sched_getaffinity(0)))
    """simulator processes on physx_cpu, each 0.7 GB of memory; another number changes episodes by rounding"""
    small: bool = False
    """a reduced setting for a CPU: AIB's three stages take by estimate 3 hours on one core"""
    quick: bool = False
    """a trial of a minute whose results mean nothing"""

    repr_dir: str | None = None
    """run directory of stage 1; by default that of the same task, preset and seed"""
    num_updates: int = 10_000
    """gradient updates of the belief; the paper's 10,000 epochs (Table 2) are taken to be updates"""
    batch_episodes: int = 256
    """whole episodes per update of the belief"""
    belief_lr: float = 3e-4
    """Adam's learning rate for the belief"""
    z_dim: int = 32
    """size of z"""
    beta: float = 1.0
    """weight of KL(q || N(0, I))"""
    image_mask: float = 0.25
    """share of the blocks of 2 x 2 pixels that training hides, against overfitting; 0: none"""
    occlusion: float = 0.5
    """after a warm-up: share of the training episodes in which the object is hidden from a random step on"""
    warmup_updates: int = 0
    """updates on single frames before --num-updates, with a teacher in place of the memory; 0: none, as in the paper"""
    prior_nll: float = 0.0
    """weight of -log p(u|z,h) with z from the prior, which is what the robot has; 0: the paper's loss"""

    belief: str | None = None
    """belief.pt of another run of this script; by default this run trains its own"""
    num_particles: int = 30
    """particles drawn from the belief at every step"""
    total_timesteps: int = 10_000_000
    """environment steps of training; a finished run goes on with a larger number"""
    num_envs: int = 256
    """whole episodes per iteration, each of the task's length; on physx_cuda all begin with the same arm pose"""
    learning_rate: float = 1e-4
    """of Adam, constant"""
    update_epochs: int = 2
    """passes over an iteration's data"""
    num_minibatches: int = 32
    """minibatches per pass"""
    gamma: float = 0.99
    """discount"""
    gae_lambda: float = 0.9
    """lambda of generalised advantage estimation"""
    clip_coef: float = 0.2
    """clipping range of the probability ratio"""
    ent_coef: float = 0.001
    """weight of the entropy bonus"""
    vf_coef: float = 0.5
    """weight of the value loss"""
    max_grad_norm: float = 0.5
    """largest norm of the gradient"""
    target_kl: float = 0.05
    """the update ends before the first minibatch whose approx_kl is larger; inf: never"""
    eval_every: int = 25
    """iterations between evaluations"""
    num_eval_episodes: int = 192
    """episodes per evaluation, always the same ones; --evaluate plays others"""
    init_std: float = math.exp(-0.5)
    """standard deviation of the actions at the start"""
    noise_beta: float = 0.0
    """exponent of the exploration noise's spectrum 1/f**beta: 0 is white, 1 is pink"""
    amp: bool = False
    """image network of the policy in bfloat16"""
    evaluate: bool = False
    """only evaluate --checkpoint; its task, image_size, robot_triangles, num_envs, amp and particles hold"""
    checkpoint: str | None = None
    """the agent.pt that --evaluate evaluates; by default this run's"""


MAY_DIFFER = ("num_workers", "total_timesteps", "checkpoint")  # when a run is resumed
TASKS = {  # other tasks use the defaults, which are Table 5's for Intercept
    "RememberShapeAndColor3x2-v0": dict(total_timesteps=10_380_000, num_envs=200, update_epochs=4, gamma=0.95),
    "RememberColor9-v0": dict(total_timesteps=10_380_000, num_envs=200, gamma=0.95),
    "RememberColor5-v0": dict(gamma=0.95),  # not in Table 5: the discount of RememberColor9
    "RememberColor3-v0": dict(gamma=0.95),
}
SMALL = dict(
    exp_name="ppo_believer_small",
    total_timesteps=240_000,
    num_envs=16,
    num_minibatches=8,
    update_epochs=8,
    target_kl=0.1,
    init_std=0.3,
    noise_beta=0.7,
    image_size=64,
    num_eval_episodes=64,
    amp=BFLOAT16,
    num_updates=1500,
    batch_episodes=16,
    belief_lr=2e-3,
    warmup_updates=2500,
    prior_nll=1.0,
)
QUICK = dict(
    exp_name="ppo_believer_quick",
    total_timesteps=360,
    num_envs=2,
    num_minibatches=4,
    num_eval_episodes=2,
    warmup_updates=2,
    num_updates=4,
    batch_episodes=4,
)


# ---------------------------------------------------------------- networks


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


class NatureCNN(nn.Module):
    """The convolutional network of Mnih et al. (2015): images (B, H, W, C) float -> features (B, size), ReLU last."""

    def __init__(self, image_shape: list[int], size: int, amp: bool):
        super().__init__()
        self.amp = amp  # in bfloat16
        self.conv = nn.Sequential(
            nn.Conv2d(image_shape[-1], 32, 8, stride=4),
            nn.ReLU(),
            nn.Conv2d(32, 64, 4, stride=2),
            nn.ReLU(),
            nn.Conv2d(64, 64, 3, stride=1),
            nn.ReLU(),
            nn.Flatten(),
        )
        flat = self.conv(torch.zeros(1, *image_shape).permute(0, 3, 1, 2)).shape[1]
        self.out = nn.Sequential(nn.Linear(flat, size), nn.ReLU())

    def forward(self, images: Tensor) -> Tensor:
        with torch.autocast(images.device.type, torch.bfloat16, enabled=self.amp):
            return self.out(self.conv(images.permute(0, 3, 1, 2))).float()


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


class BelieverBelief(nn.Module):
    """b(h) of Believer: history encoder, fixed prior N(0, I) and decoder p(u|z,h).

    config: image_shape [H, W, 3], joints_dim, u_dim, z_dim.
    """

    def __init__(self, config: dict):
        super().__init__()
        self.config = config
        self.history = HistoryEncoder(config)
        self.decoder = GaussianMLP(config["z_dim"] + 256, [256, 256], config["u_dim"], min_std=0.1)

    def decode(self, h: Tensor, z_noise: Tensor) -> Normal:
        """Give p(u|z_i,h) of z_i ~ N(0, I), i = 1..n: h (..., 256), noise (..., n, z_dim) -> Normal (..., n, u_dim)."""
        return self.decoder(torch.cat([z_noise, h.unsqueeze(-2).expand(*z_noise.shape[:-1], -1)], -1))


class Agent(nn.Module):
    """Actor and critic on image, joints and belief (paper 3.3): W(b) = W_agg(mean over particles of W_enc(u_i))."""

    def __init__(self, envs: gym.vector.VectorEnv, belief: nn.Module, args: Args):
        super().__init__()
        spaces = envs.single_observation_space
        (action_dim,) = envs.single_action_space.shape
        self.belief = belief.requires_grad_(False).eval()  # frozen; W_enc and W_agg learn with actor and critic
        self.cnn = NatureCNN(spaces["rgb"].shape, 256, args.amp)
        self.joints = nn.Sequential(nn.Linear(spaces["joints"].shape[0], 128), nn.ReLU())
        self.w_enc = mlp([belief.config["u_dim"], 64, 64])
        self.w_agg = mlp([64, 64, 64])
        self.actor = orthogonal_init(mlp([256 + 128 + 64, 512, action_dim]))
        self.critic = orthogonal_init(mlp([256 + 128 + 64, 512, 1]))
        orthogonal_init(self.actor[-1], 0.01 * 2**0.5)  # gains as in ManiSkill's PPO
        self.log_std = nn.Parameter(torch.full((action_dim,), math.log(args.init_std)))

    def forward(self, obs: dict[str, Tensor]) -> tuple[Normal, Tensor]:
        """rgb (B, H, W, 3) uint8, joints (B, J), particles (B, n, u_dim) -> Normal over actions (B, A), value (B,)."""
        image = self.cnn(obs["rgb"].float().div_(255))
        joints = self.joints(obs["joints"])
        belief = self.w_agg(self.w_enc(obs["particles"]).mean(-2))
        x = torch.cat([image, joints, belief], -1)
        mean = torch.tanh(self.actor(x))  # within the box of actions
        return Normal(mean, self.log_std.exp().expand_as(mean), validate_args=False), self.critic(x).squeeze(-1)


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


def believer_losses(model: nn.ModuleDict, batch: dict[str, Tensor], args: Args) -> dict[str, Tensor]:
    """-ELBO with the fixed prior, its KL weighted by beta, and its terms; means over a batch of whole episodes.

    --prior-nll and --warmup-updates add a term each that the paper does not have.
    """
    h, memory = encode_history(model["belief"].history, batch, args.image_mask)
    q = model["posterior"](torch.cat([batch["u"], h], -1))
    decoded = model["belief"].decoder(torch.cat([q.rsample(), h], -1))
    losses = {"nll": -decoded.log_prob(batch["u"]).sum(-1).mean()}
    losses["kl"] = kl_divergence(q, Normal(0.0, 1.0)).sum(-1).mean()
    losses["total"] = losses["nll"] + args.beta * losses["kl"]
    if args.prior_nll:
        losses["prior_nll"] = prior_nll_loss(model["belief"], batch["u"], h)
        losses["total"] = losses["total"] + args.prior_nll * losses["prior_nll"]
    if args.warmup_updates:
        losses["memory"] = memory_loss(model["teacher"], batch["u"], memory)
        losses["total"] = losses["total"] + 10 * losses["memory"]  # 10: of the order of the other terms
    return losses


def compute_gae(rewards: Tensor, values: Tensor, gamma: float, gae_lambda: float) -> Tensor:
    """Generalised advantages (T, N) of whole episodes: rewards (T, N), values (T+1, N) with V(o_T) as the last.

    No done flags: a success ends no episode, and the time limit is a truncation, so V(o_T) is bootstrapped.
    """
    advantages, last = torch.empty_like(rewards), torch.zeros_like(rewards[0])
    deltas = rewards + gamma * values[1:] - values[:-1]
    for t in reversed(range(len(rewards))):
        advantages[t] = last = deltas[t] + gamma * gae_lambda * last
    return advantages


def ppo_losses(agent: nn.Module, batch: dict[str, Tensor], args: Args) -> dict[str, Tensor]:
    """PPO's clipped objective (Schulman et al., 2017) on a minibatch (B, ...), with advantages normalised in it."""
    dist, values = agent(batch)
    log_ratio = dist.log_prob(batch["actions"]).sum(-1) - batch["logprobs"]
    ratio = log_ratio.exp()
    advantages = batch["advantages"]
    # correction=0: a minibatch may have a single step
    advantages = (advantages - advantages.mean()) / (advantages.std(correction=0) + 1e-8)
    clipped = ratio.clamp(1 - args.clip_coef, 1 + args.clip_coef)
    policy_loss = -torch.min(ratio * advantages, clipped * advantages).mean()
    value_loss = 0.5 * (values - batch["returns"]).square().mean()
    entropy = dist.entropy().sum(-1).mean()
    return {
        "policy_loss": policy_loss,
        "value_loss": value_loss,
        "entropy": entropy,
        "total": policy_loss - args.ent_coef * entropy + args.vf_coef * value_loss,
        "approx_kl": (ratio - 1 - log_ratio).mean(),  # Schulman's low-variance estimate
        "clipfrac": ((ratio - 1).abs() > args.clip_coef).float().mean(),
    }


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


def colored_noise(beta: float, shape: tuple[int, ...], rng: np.random.Generator) -> np.ndarray:
    """Noise (..., T) with spectrum 1/f**beta over time (Eberhard et al., 2023); if T >= 30, its std is 1 within 1 %."""
    noise = colorednoise.powerlaw_psd_gaussian(beta, shape, random_state=rng)
    # the package's scale leaves out the power at f = 0: correct it
    frequencies = np.abs(np.fft.fftfreq(shape[-1]))
    power = frequencies.clip(1 / shape[-1]) ** -beta
    return noise * np.sqrt(power[1:].sum() / power.sum())


@torch.no_grad()
def rollout(
    envs: gym.vector.VectorEnv, agent: Agent, args: Args, seeds: np.ndarray, deterministic: bool = False
) -> dict[str, Tensor]:
    """Play one whole episode per seed; deterministic actions are the policy's means.

    Episodes are played in rounds of envs.num_envs. Noise is drawn for each episode before any is played, so results do
    not depend on how many run at once.
    Returns tensors (T, N, ...), as declared below, and values (T+1, N) with V(o_T) as the last.
    """
    steps, num_episodes, device = gym.spec(args.env_id).max_episode_steps, len(seeds), args.device
    spaces, (action_dim,) = envs.single_observation_space, envs.single_action_space.shape
    buffer = {
        "rgb": torch.empty(steps, num_episodes, *spaces["rgb"].shape, dtype=torch.uint8, device=device),
        "joints": torch.empty(steps, num_episodes, *spaces["joints"].shape, device=device),
        "particles": torch.empty(steps, num_episodes, args.num_particles, agent.belief.config["u_dim"], device=device),
        "actions": torch.empty(steps, num_episodes, action_dim, device=device),
        "logprobs": torch.empty(steps, num_episodes, device=device),
        "rewards": torch.empty(steps, num_episodes, device=device),
        "success": torch.empty(steps, num_episodes, device=device),
        "values": torch.empty(steps + 1, num_episodes, device=device),
    }
    noise = colored_noise(args.noise_beta, (num_episodes, action_dim, steps), np.random.default_rng(seeds))
    noise = torch.from_numpy(noise.transpose(2, 0, 1)).float().to(device)
    shape = (steps + 1, num_episodes, args.num_particles)
    z_noise = torch.randn(*shape, agent.belief.config["z_dim"], device=device)
    u_noise = torch.randn(*shape, agent.belief.config["u_dim"], device=device)
    desc = "evaluation" if deterministic else "rollout"
    for first in range(0, num_episodes, envs.num_envs):
        last = min(first + envs.num_envs, num_episodes)
        # the simulator always plays envs.num_envs: the last round repeats episodes, which are not kept
        rows = np.arange(first, first + envs.num_envs) % num_episodes
        obs, _ = envs.reset(seed=seeds[rows].tolist())
        recurrent = None
        for t in tqdm(range(steps + 1), f"{desc}, episode {first} of {num_episodes}", unit="step", leave=False):
            transition = {name: torch.as_tensor(obs[name], device=device) for name in ("rgb", "joints")}
            h, recurrent = agent.belief.history(transition["rgb"], transition["joints"], recurrent)
            p_u = agent.belief.decode(h, z_noise[t, rows])
            # samples of p(u|z,h), as in the authors' code; kept, as fresh ones would change the update's ratio
            transition["particles"] = p_u.mean + p_u.stddev * u_noise[t, rows]
            dist, values = agent(transition)
            buffer["values"][t, first:last] = values[: last - first]
            if t == steps:
                break  # the last observation is only for its value
            actions = dist.mean if deterministic else dist.mean + dist.stddev * noise[t, rows]
            # of the action before clamping, as if noise were white: PPO ignores its correlation in time
            transition |= {"actions": actions, "logprobs": dist.log_prob(actions).sum(-1)}
            controls = actions.clamp(-1, 1)
            if args.sim_backend == "physx_cpu":
                controls = controls.cpu().numpy()
            obs, rewards, _, _, info = envs.step(controls)
            transition |= {"rewards": torch.as_tensor(rewards), "success": torch.as_tensor(info["success"])}
            for name, x in transition.items():
                buffer[name][t, first:last] = x[: last - first]
    return buffer


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


def success_and_return(buffer: dict[str, Tensor]) -> dict[str, float]:
    """success_once, success_at_end (paper, appendix A) and return of a rollout, means over its episodes."""
    return {
        "success_once": buffer["success"].amax(0).mean().item(),
        "success_at_end": buffer["success"][-1].mean().item(),
        "return": buffer["rewards"].sum(0).mean().item(),
    }


def make_video(buffer: dict[str, Tensor]) -> bytes:
    """What the agent's camera saw in a rollout's first 4 episodes, as mp4; a green bar marks success."""
    rgb = buffer["rgb"][:, :4].cpu().numpy().copy()  # (T, 4, H, W, 3)
    steps, episodes = np.nonzero(buffer["success"][:-1, :4].cpu().numpy())
    rgb[steps + 1, episodes, :4] = (0, 255, 0)  # success after step t shows in frame t + 1, in 4 rows of pixels
    rgb = np.concatenate(rgb.swapaxes(0, 1), axis=2)
    size = ["-vf", "scale=-2:256:flags=neighbor"]  # 256 pixels high; -2: width in proportion, rounded to even
    return iio.imwrite("<bytes>", rgb, extension=".mp4", fps=20, macro_block_size=1, output_params=size)


def r_squared(u: Tensor, estimate: Tensor) -> float:
    """R2 of u (M, u_dim) from its estimate: 1 if that is u, 0 if it is no better than the mean of u."""
    return 1 - ((u - estimate).square().sum() / (u - u.mean(0)).square().sum()).item()


def evaluate(
    envs: gym.vector.VectorEnv, agent: Agent, args: Args, first_seed: int = EVAL_SEED
) -> tuple[dict[str, float], bytes]:
    """Metrics and video of args.num_eval_episodes episodes with mean actions, the same episodes every time."""
    torch.manual_seed(0)  # the same noise at every evaluation; main seeds each iteration anew
    buffer = rollout(envs, agent, args, first_seed + np.arange(args.num_eval_episodes), deterministic=True)
    return success_and_return(buffer), make_video(buffer)


# ---------------------------------------------------------------- training


def train_belief(args: Args, path: Path) -> None:
    """Train Believer's belief on stage 1's output as aib_belief.py does; writes belief.pt into path."""
    task = {name: getattr(args, name) for name in ("env_id", "robot_triangles", "image_size")}
    episodes, stored = load_episodes(args, **task)
    num_val = stored["num_val"]
    train, held_out = np.split(np.arange(len(episodes)), [-num_val])
    example = episodes(train[:1])
    config = {
        "image_shape": list(example["rgb"].shape[2:]),
        "joints_dim": example["joints"].shape[-1],
        "u_dim": stored["u_dim"],
        "z_dim": args.z_dim,
    }
    torch.manual_seed(args.seed)
    model = nn.ModuleDict({"belief": BelieverBelief(config)})
    model["posterior"] = GaussianMLP(stored["u_dim"] + 256, [256, 256], args.z_dim, min_std=0.1)
    if args.warmup_updates:
        model["teacher"] = Teacher(config["u_dim"])
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
    if (path / "belief_checkpoint.pt").exists():
        checkpoint = load(path / "belief_checkpoint.pt")
        model.load_state_dict(checkpoint["model"])
        optimizer.load_state_dict(checkpoint["optimizer"])
        completed = checkpoint["update"]
        print(f"resuming {path} at update {completed}", flush=True)
    writer = SummaryWriter(path / "belief_events", purge_step=completed + 1)
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
            losses = believer_losses(model, batch, args)
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
            save(path / "belief_checkpoint.pt", checkpoint)

    # no early stopping: held-out error is best before h holds the cue
    content = {"script": "ppo_believer", **asdict(args), "config": config, "belief": model["belief"].state_dict()}
    save(path / "belief.pt", content)
    u, estimate = validate_belief(model["belief"], episodes, held_out)
    for t in range(len(u)):
        writer.add_scalar("belief/held_out_u_r2_by_step", r_squared(u[t], estimate[t]), t)
    writer.close()
    print(f"{path / 'belief.pt'}, at the last step of held-out episodes: R2 of u {r_squared(u[-1], estimate[-1]):.2f}")


def evaluate_checkpoint(args: Args) -> None:
    """Evaluate the agent of --checkpoint, on test episodes; writes evaluation.json and .mp4 beside it."""
    file = Path(args.checkpoint or f"runs/{args.env_id}__{args.exp_name}__{args.seed}/agent.pt")
    stored = load(file, script="ppo_believer")
    if not os.access(file.parent, os.W_OK):
        fail(f"{file.parent} cannot be written, where evaluation.json and .mp4 would be; copy {file.name} elsewhere")
    for name in ("env_id", "robot_triangles", "image_size", "num_envs", "amp", "num_particles"):
        setattr(args, name, stored[name])
    check_task(args)
    envs = make_envs(args)
    agent = Agent(envs, BelieverBelief(stored["config"]), args).to(args.device)
    agent.load_state_dict(stored["agent"])
    metrics, video = evaluate(envs, agent, args, TEST_SEED)
    metrics |= {"global_step": stored["global_step"], "num_eval_episodes": args.num_eval_episodes}
    report = json.dumps(metrics, indent=2)
    print(f"{file} on test episodes: {report}")
    save(file.with_name("evaluation.json"), report.encode())
    save(file.with_name("evaluation.mp4"), video)
    envs.close()


def main(args: Args) -> None:
    """Train belief and agent of the Believer baseline."""
    check_task(args)
    batch_size = gym.spec(args.env_id).max_episode_steps * args.num_envs
    num_iterations = max(1, args.total_timesteps // batch_size)
    if min(args.num_envs, args.num_minibatches, args.update_epochs, args.eval_every, args.num_eval_episodes) < 1:
        fail("--num-envs, --num-minibatches, --update-epochs, --eval-every and --num-eval-episodes must be at least 1")
    if args.num_minibatches > batch_size:
        fail(f"--num-minibatches {args.num_minibatches} must be at most the {batch_size} steps of an iteration")
    if max(args.gamma, args.gae_lambda) > 1:
        fail(f"--gamma {args.gamma} and --gae-lambda {args.gae_lambda} must be at most 1")
    if args.total_timesteps > 1_000_000 and not CUDA:
        print(f"{args.total_timesteps:,} steps take days without CUDA; --small takes hours", flush=True)
    path = open_run(args)
    checkpoint = load(path / "checkpoint.pt") if (path / "checkpoint.pt").exists() else {}
    if checkpoint.get("iteration", 0) >= num_iterations:
        print(f"{path} is finished; a larger --total-timesteps continues it")
        return
    task = {name: getattr(args, name) for name in ("env_id", "robot_triangles", "image_size")}
    file = Path(args.belief or path / "belief.pt")
    if not args.belief and not file.exists():
        train_belief(args, path)
        torch.cuda.empty_cache()  # the simulator needs the GPU's memory too
    stored = load(file, script="ppo_believer", **task)

    envs = make_envs(args)
    torch.manual_seed(args.seed)
    agent = Agent(envs, BelieverBelief(stored["config"]), args).to(args.device)
    agent.belief.load_state_dict(stored["belief"])
    optimizer = torch.optim.Adam(agent.parameters(), lr=args.learning_rate, eps=1e-5, fused=True)
    completed, evals = checkpoint.get("iteration", 0), checkpoint.get("evals", [])
    if checkpoint:
        agent.load_state_dict(checkpoint["agent"], strict=False)  # without the belief
        optimizer.load_state_dict(checkpoint["optimizer"])
        print(f"resuming {path} at step {completed * batch_size:,}", flush=True)
    writer = SummaryWriter(path, purge_step=completed * batch_size + 1)
    iterations = range(completed + 1, num_iterations + 1)
    bar = tqdm(iterations, "PPO", num_iterations, initial=completed, unit="iteration")

    for iteration in bar:
        start = time.time()
        global_step = iteration * batch_size  # after this iteration
        torch.manual_seed(args.seed * 1_000_000 + iteration)  # so that a resumed run repeats the iteration
        seeds = (args.seed * 1_000_000 + iteration * args.num_envs + np.arange(args.num_envs)) % 2**30
        buffer = rollout(envs, agent, args, seeds)
        scalars = {f"train/{name}": value for name, value in success_and_return(buffer).items()}

        values = buffer.pop("values")  # has T+1 steps: not for the batch
        buffer["advantages"] = compute_gae(buffer["rewards"], values, args.gamma, args.gae_lambda)
        buffer["returns"] = buffer["advantages"] + values[:-1]
        batch = {name: x.flatten(0, 1) for name, x in buffer.items()}
        logged = []  # losses of each minibatch
        for _ in range(args.update_epochs):
            for mb_inds in torch.randperm(batch_size, device=args.device).tensor_split(args.num_minibatches):
                losses = ppo_losses(agent, {name: x[mb_inds] for name, x in batch.items()}, args)
                logged.append({name: x.detach() for name, x in losses.items()})
                stop = losses["approx_kl"] > args.target_kl
                if stop:
                    break
                optimizer.zero_grad()
                losses["total"].backward()
                nn.utils.clip_grad_norm_(agent.parameters(), args.max_grad_norm, error_if_nonfinite=True)
                optimizer.step()
            if stop:
                break
        for name in losses:
            scalars[f"losses/{name}"] = torch.stack([mb[name] for mb in logged]).mean().item()
        explained = 1 - batch["advantages"].var() / batch["returns"].var()  # 1 - Var(returns - values) / Var(returns)
        scalars |= {"losses/explained_variance": explained.item(), "charts/episodic_return": scalars["train/return"]}
        scalars |= {"charts/updates": len(logged) - int(stop), "charts/SPS": batch_size / (time.time() - start)}
        del buffer, batch, losses, logged  # a gigabyte of images, before the evaluation has its own

        if iteration % args.eval_every == 0 or iteration == num_iterations:
            metrics, video = evaluate(envs, agent, args)
            scalars |= {f"eval/{name}": value for name, value in metrics.items()}
            evals.append({"iteration": iteration, "global_step": global_step, **metrics})
            lines = [",".join(evals[0])]
            for row in evals:
                lines.append(",".join(map(str, row.values())))
            save(path / "eval.csv", ("\n".join(lines) + "\n").encode())
            save(path / "videos" / f"step_{global_step:08d}.mp4", video)
            content = {"script": "ppo_believer", **asdict(args), "config": stored["config"]}
            save(path / "agent.pt", {**content, "global_step": global_step, "agent": agent.state_dict()})
            bar.set_postfix(success_once=f"{metrics['success_once']:.2f}")

        for name, value in scalars.items():
            writer.add_scalar(name, value, global_step)
        writer.flush()
        trained = {name: x for name, x in agent.state_dict().items() if not name.startswith("belief.")}
        states = {"agent": trained, "optimizer": optimizer.state_dict()}
        save(path / "checkpoint.pt", {"iteration": iteration, "evals": evals, **states})
    envs.close()
    for name in ("success_once", "success_at_end", "return"):
        values = [row[name] for row in evals]
        print(f"{name}: mean of the last three evaluations {np.mean(values[-3:]):.3f}, maximum {max(values):.3f}")


# ---------------------------------------------------------------- simulator
# identical in the four scripts that simulate


class PrivilegedInfoWrapper(gym.Wrapper):
    """Pictures and privileged state at once, where MIKASA-Robo gives either; objects that it hid come back.

    The task is made with obs_mode state_dict, and _view adds the picture.
    Observation: rgb (B, H, W, 3) uint8 of the base camera; joints (B, 25): 9 positions, 9 velocities, tool pose (7).
    Info, privileged, of which PPO reads success alone: success (B,); cue (B, K), the memory variable; state (B, D), all
    that the task's _get_obs_extra returns but the tool's pose; in MIKASA's tasks the cue is in it.
    """

    def __init__(self, env: gym.Env):
        super().__init__(env)
        self.task = env.unwrapped
        self.poses = []
        task_evaluate = self.task.evaluate

        # MIKASA's evaluate hides objects for the picture by moving them to z = 1000. On physx_cpu they would not come
        # back before the next step's physics: note the poses before it; _view puts them back after the picture.
        def evaluate_and_note_poses() -> dict:
            entities = [actor._objs[0] for actor in self.task.scene.actors.values()]
            self.poses = [(entity, entity.pose) for entity in entities]
            return task_evaluate()

        if not self.task.gpu_sim_enabled:
            self.task.evaluate = evaluate_and_note_poses
        self.task.update_obs_space(common.to_cpu_tensor(self.reset()[0]))  # adds rgb

    def _view(self, obs_dict: dict, info: dict) -> tuple[dict, dict]:
        rgb = self.task._get_obs_sensor_data()["base_camera"]["rgb"]
        rgb = rgb.clone(memory_format=torch.contiguous_format)  # the next picture is drawn over this one
        for entity, pose in self.poses:
            if (entity.pose.p != pose.p).any():
                entity.pose = pose
        seen = {"agent": obs_dict["agent"], "tcp_pose": obs_dict["extra"].pop("tcp_pose")}
        state = common.flatten_state_dict(obs_dict["extra"], use_torch=True).float()
        state = torch.where(state.abs() > 500, 1.0, state)  # hidden objects have z = 1000: 1 in its place
        cue = self.task.oracle_info.float().reshape(len(state), -1)
        obs = {"rgb": rgb, "joints": common.flatten_state_dict(seen, use_torch=True)}
        return obs, {"success": info["success"].float(), "state": state, "cue": cue}

    def reset(self, **kwargs: object) -> tuple:
        return self._view(*self.env.reset(**kwargs))

    def step(self, action: Tensor) -> tuple:
        obs_dict, reward, terminated, truncated, info = self.env.step(action)
        obs, info = self._view(obs_dict, info)
        return obs, reward, terminated, truncated, info


def decimate_meshes(task: gym.Env, triangles: int) -> None:
    """Draw each mesh of the robot with about the given number of triangles at most, and the flat ground with two.

    The Panda and its camera have half a million triangles, the ground 20,000; drawing them takes nine tenths of a step
    on a CPU.
    """
    for link in task.agent.robot.get_links():
        entity = link._objs[0].entity
        old, new = entity.find_component_by_type(RenderBodyComponent), RenderBodyComponent()
        if old is None:
            continue
        for shape in old.render_shapes:
            for part in shape.parts:
                mesh = trimesh.Trimesh(part.vertices, part.triangles, process=False)
                if len(mesh.faces) > triangles:
                    mesh.merge_vertices(digits_vertex=2)  # within 1 cm; in the files triangles share none
                    mesh.update_faces(mesh.nondegenerate_faces())
                    mesh = mesh.simplify_quadric_decimation(face_count=min(triangles, len(mesh.faces)))
                uv = np.zeros((len(mesh.vertices), 2))
                drawn = RenderShapeTriangleMesh(mesh.vertices, mesh.faces, mesh.vertex_normals, uv, part.material)
                drawn.local_pose = shape.local_pose
                new.attach(drawn)
        entity.remove_component(old)
        entity.add_component(new)
    if "ground" in task.scene.actors:  # its texture repeats, so that its four corners show the same
        entity = task.scene.actors["ground"]._objs[0]
        old, new = entity.find_component_by_type(RenderBodyComponent), RenderBodyComponent()
        part = old.render_shapes[0].parts[0]
        x, y, _ = part.vertices.T
        corners = [axis.argmax() for axis in (-x - y, x - y, y - x, x + y)]
        normals, uv = part.get_vertex_normal()[corners], part.get_vertex_uv()[corners]
        faces = np.array([[0, 1, 2], [1, 3, 2]])
        new.attach(RenderShapeTriangleMesh(part.vertices[corners], faces, normals, uv, part.material))
        entity.remove_component(old)
        entity.add_component(new)


def make_task(args: Args, num_scenes: int) -> gym.Env:
    """Build an environment: on physx_cuda a batch of num_scenes scenes, with tensors; else one scene, with arrays."""
    if multiprocessing.parent_process():
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C ends the main process, and a worker ends with it
    env = gym.make(
        args.env_id,
        num_envs=num_scenes,
        obs_mode="state_dict",
        control_mode="pd_joint_delta_pos",
        reward_mode="normalized_dense",
        robot_uids="panda_wristcam",
        sensor_configs={"width": args.image_size, "height": args.image_size},
        sim_backend=args.sim_backend,
        render_backend=args.render_backend,
        reconfiguration_freq=0,  # ShellGame tasks would build the scene, with stock meshes, at every reset
    )
    # _sensors, _objs and _get_obs_sensor_data are ManiSkill's private names: requirements.txt pins its version
    env.unwrapped._sensors.pop("hand_camera", None)  # the policy does not see through it
    if args.robot_triangles:
        decimate_meshes(env.unwrapped, args.robot_triangles)
    env = PrivilegedInfoWrapper(env)
    return env if args.sim_backend == "physx_cuda" else wrappers.CPUGymWrapper(env, ignore_terminations=True)


def make_envs(args: Args) -> gym.vector.VectorEnv:
    """Build environments whose episodes all last max_episode_steps, without auto-reset.

    Actions lie in [-1, 1]: changes of the arm's 7 joint angles, and the gripper's opening.
    physx_cuda: one batch of args.num_envs scenes; torch's draws and the arm's pose follow the first of reset's seeds.
    physx_cpu: up to args.num_workers processes of one scene each, all forked from one that has imported the tasks, or
    spawned beside CUDA, which does not survive a fork.
    """
    if args.sim_backend == "physx_cuda":
        return ManiSkillVectorEnv(make_task(args, args.num_envs), auto_reset=False, ignore_terminations=True)
    os.environ.update(LP_NUM_THREADS="1", OMP_NUM_THREADS="1")  # of each worker: of the CPU renderer and of torch
    workers = [lambda: make_task(args, 1)] * min(args.num_workers, args.num_envs)
    multiprocessing.set_forkserver_preload(["torch", "mikasa_robo_suite.rl.memory_envs"])
    envs = gym.vector.AsyncVectorEnv(workers, context="spawn" if CUDA else "forkserver", autoreset_mode="Disabled")
    gym.logger.min_level = gym.logger.ERROR  # no warning when a run is stopped in the middle of a step
    return envs


def check_task(args: Args) -> None:
    """Fail on an unknown task, assets that are not on this machine, and where simulator or renderer do not start."""
    if not CUDA and "cuda" in args.device + args.sim_backend + args.render_backend:
        fail("torch sees no CUDA device here; use --device cpu --sim-backend physx_cpu --render-backend sapien_cpu")
    if (args.sim_backend, args.render_backend) == ("physx_cuda", "sapien_cpu"):
        fail("--sim-backend physx_cuda needs --render-backend sapien_cuda")
    if args.sim_backend == "physx_cuda" and args.robot_triangles:
        fail(f"physx_cuda needs --robot-triangles 0, not {args.robot_triangles}; physx_cpu is the other --sim-backend")
    if args.image_size < 36:
        fail(f"--image-size {args.image_size} must be at least 36, for the image network")
    tasks = {name: spec for name, spec in registration.REGISTERED_ENVS.items() if "mikasa" in spec.cls.__module__}
    if args.env_id not in tasks:
        nearest = difflib.get_close_matches(args.env_id, tasks) or sorted(tasks)
        fail(f"--env-id {args.env_id} is no task of MIKASA-Robo; choose one of {', '.join(nearest)}")
    for asset in tasks[args.env_id].asset_download_ids or []:
        if not assets.is_data_source_downloaded(asset):
            fail(f"{args.env_id} needs an asset; fetch it with: python -m mani_skill.utils.download_asset {asset}")
    try:
        sapien.render.RenderSystem(sapien.Device(args.render_backend.removeprefix("sapien_")))
        if args.sim_backend == "physx_cuda":
            with open(Path.home() / ".sapien_physx.lock", "w") as lock:
                fcntl.flock(lock, fcntl.LOCK_EX)  # jobs that start together must not download its library together
                sapien.physx.enable_gpu()
    except (OSError, RuntimeError, zipfile.BadZipFile) as error:
        fail(f"{args.render_backend} or {args.sim_backend} does not start ({error}); see docs/experiments.md")


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
        args = parse_args()
        if args.evaluate:
            evaluate_checkpoint(args)
        else:
            main(args)
    except KeyboardInterrupt:
        sys.exit("\nstopped; the same command resumes the run from what was saved last")
    except (EOFError, ConnectionError):  # of the pipe to a simulator
        message = "a simulator process was killed, perhaps as memory ran out; the same command resumes the run"
        print(f"error: {message}", file=sys.stderr, flush=True)
        for worker in multiprocessing.active_children():
            worker.kill()
        os._exit(2)  # gymnasium would still talk to the dead process
