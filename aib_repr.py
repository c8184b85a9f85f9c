"""AIB stage 1: a random-policy dataset and a compact encoder of the privileged state (paper section 3.1, Algorithm 1).

The encoder phi turns the privileged state s into a short code u. Together with psi, an encoder of the observation o, it
learns to predict the reward and the next codes. A KL penalty removes from u what does not help, or what o shows anyway.

Usage:   python aib_repr.py --env-id InterceptFast-v0
Writes:  runs/{env_id}__{exp_name}__{seed}/: dataset/, repr.pt, TensorBoard events; args.json and checkpoint.pt to
         resume
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
import zipfile
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path
from typing import Literal, NoReturn

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # before torch: idle threads must not starve other runs

import gymnasium as gym
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
BFLOAT16 = "bf16" in Path("/proc/cpuinfo").read_text()
if CUDA:
    BFLOAT16 = torch.cuda.is_bf16_supported(including_emulation=False)
torch.set_float32_matmul_precision("high")  # TF32, where the device has it


# ---------------------------------------------------------------- arguments


@dataclass
class Args:
    env_id: str = "InterceptFast-v0"
    """MIKASA-Robo task"""
    exp_name: str = "aib_repr"
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

    num_envs: int = 50
    """at most this many scenes at a time; physx_cuda draws one arm pose for all of them"""
    num_episodes: int = 2000
    """episodes of the random policy"""
    epochs: int = 200
    """passes over the training transitions"""
    batch_size: int = 500
    """transitions per update"""
    learning_rate: float = 3e-4
    """of Adam, constant"""
    u_dim: int = 16
    """size of u"""
    reward_coef: float = 10.0
    """lambda_r"""
    state_coef: float = 0.3
    """lambda_s"""
    obs_coef: float = 0.03
    """lambda_o"""
    kl_coef: float = 0.03
    """lambda_KL, of the KL's mean over u's dimensions, as in Believer's code"""
    amp: bool = BFLOAT16
    """image network in bfloat16"""


MAY_DIFFER = ("num_workers",)  # when a run is resumed
TASKS = {}  # the paper has one setting of this stage for all tasks
SMALL = dict(
    exp_name="aib_repr_small",
    num_envs=32,
    num_episodes=4000,
    image_size=64,
    epochs=7,
    batch_size=100,
    learning_rate=1e-3,
)
QUICK = dict(exp_name="aib_repr_quick", num_envs=8, num_episodes=8, epochs=2)


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


class ObservationEncoder(nn.Module):
    """psi: rgb (B, H, W, 3) uint8 and joints (B, J), standardised inside, -> Normal over u^o (B, u_dim) (paper 3.1)."""

    def __init__(self, image_shape: list[int], joints_dim: int, u_dim: int, amp: bool = False):
        super().__init__()
        self.register_buffer("image_mean", torch.zeros(image_shape))
        self.register_buffer("image_std", torch.tensor(255.0))
        self.register_buffer("joints_mean", torch.zeros(joints_dim))
        self.register_buffer("joints_std", torch.ones(joints_dim))
        self.cnn = orthogonal_init(NatureCNN(image_shape, 256, amp))
        self.net = GaussianMLP(256 + joints_dim, [256, 256], u_dim, min_std=1e-5)

    def forward(self, rgb: Tensor, joints: Tensor) -> Normal:
        image = self.cnn(rgb.float().sub_(self.image_mean).div_(self.image_std))
        return self.net(torch.cat([image, (joints - self.joints_mean) / self.joints_std], -1))


class Predictor(nn.Module):
    """g: (u^s, u^o, a) -> (standardised) reward (B,) and next latents u^s, u^o (B, u_dim) (Algorithm 1, line 5)."""

    def __init__(self, u_dim: int, action_dim: int):
        super().__init__()
        self.heads = [1, u_dim, u_dim]
        self.net = mlp([2 * u_dim + action_dim, 256, 256, 256, sum(self.heads)])
        self.register_buffer("reward_mean", torch.zeros(()))
        self.register_buffer("reward_std", torch.ones(()))

    def forward(self, u_s: Tensor, u_o: Tensor, action: Tensor) -> tuple[Tensor, ...]:
        reward, next_u_s, next_u_o = self.net(torch.cat([u_s, u_o, action], -1)).split(self.heads, -1)
        return reward.squeeze(-1), next_u_s, next_u_o


# ---------------------------------------------------------------- losses


def repr_losses(model: nn.ModuleDict, batch: dict[str, Tensor], args: Args) -> dict[str, Tensor]:
    """The terms of Algorithm 1 for a batch of transitions (B, ...), each a mean over the batch."""
    phi, psi, g = model["phi"], model["psi"], model["g"]
    q_s, q_o = phi(batch["state"]), psi(batch["rgb"], batch["joints"])
    r_hat, s_hat, o_hat = g(q_s.rsample(), q_o.rsample(), batch["actions"])  # lines 4 and 5
    with torch.no_grad():  # line 6; the mean of a target gives the gradient of a sample with less noise
        s_next, o_next = phi(batch["next_state"]).mean, psi(batch["next_rgb"], batch["next_joints"]).mean
    loss_r = ((batch["rewards"] - g.reward_mean) / g.reward_std - r_hat).square().mean()  # line 7
    loss_s = (s_next - s_hat).square().sum(-1).mean()  # line 8
    loss_o = (o_next - o_hat).square().sum(-1).mean()  # line 9
    kl = kl_divergence(q_s, Normal(0.0, 1.0)).mean()  # line 10; a mean over dimensions, too
    # line 11
    total = args.reward_coef * loss_r + args.state_coef * loss_s + args.obs_coef * loss_o + args.kl_coef * kl
    return {"reward": loss_r, "state": loss_s, "obs": loss_o, "kl": kl, "total": total}


# ---------------------------------------------------------------- data


def random_actions(args: Args, episode: int, steps: int, action_dim: int) -> np.ndarray:
    """Actions (T, A) of an episode, uniform in [-1, 1]; they depend on --seed and the episode's number alone."""
    rng = np.random.default_rng([args.seed, episode])
    return rng.uniform(-1, 1, (steps, action_dim)).astype(np.float32)


def reserve(file: Path) -> None:
    """Give a sparse file all its bytes: written through a memory map, a full disk would kill the process."""
    size = file.stat().st_size
    try:
        with file.open("rb+") as opened:
            os.posix_fallocate(opened.fileno(), 0, size)
    except OSError as error:
        shutil.rmtree(file.parent)  # incomplete without this array
        fail(f"{file} needs {size / 1e9:.1f} GB ({error.strerror}); make room or lower --num-episodes")


def collect_random_episodes(args: Args, path: Path) -> dict[str, np.ndarray]:
    """Play N whole episodes with uniformly random actions into dataset/, from where it stopped. Returns its arrays:

    rgb (N, T+1, H, W, 3) uint8; joints, state (N, T+1, .); actions (N, T, A); rewards, success (N, T); cue, the memory
    variable (N, K).
    """
    meta, arrays = {**asdict(args), "episodes_done": 0}, {}
    if (path / "meta.json").exists():
        meta = load(path / "meta.json")
        arrays = {file.stem: np.load(file, mmap_mode="r+") for file in path.glob("*.npy")}
    if meta["episodes_done"] == args.num_episodes:
        return arrays
    envs, count = make_envs(args), args.num_episodes
    steps, (action_dim,) = gym.spec(args.env_id).max_episode_steps, envs.single_action_space.shape
    bar = tqdm(total=count, initial=meta["episodes_done"], desc="random policy", unit="episode")
    for first in range(meta["episodes_done"], count, envs.num_envs):
        rows = np.arange(first, first + envs.num_envs) % count  # the last round is filled up with repetitions
        kept = rows[: count - first]
        seeds = (args.seed * 1_000_000 + rows) % 2**29 + 2**30  # above those of PPO's training, below its evaluation's
        obs, info = envs.reset(seed=seeds.tolist())
        frame = common.to_numpy({**obs, "state": info["state"]})
        actions = np.stack([random_actions(args, episode, steps, action_dim) for episode in rows])
        cue = common.to_numpy(info["cue"]).reshape(len(rows), -1)  # in Rotate tasks it changes: what is left to turn
        if not arrays:
            path.mkdir(exist_ok=True)
            shapes = {"actions": (steps, action_dim), "rewards": (steps,), "success": (steps,), "cue": cue.shape[1:]}
            for name, x in frame.items():
                shapes[name] = (steps + 1, *x.shape[1:])
            for name, shape in shapes.items():
                dtype = {"rgb": np.uint8, "success": np.bool_}.get(name, np.float32)
                arrays[name] = np.lib.format.open_memmap(path / f"{name}.npy", "w+", dtype, (count, *shape))
                reserve(path / f"{name}.npy")
        arrays["cue"][kept], arrays["actions"][kept] = cue[: len(kept)], actions[: len(kept)]
        for t in range(steps + 1):
            for name, x in frame.items():
                arrays[name][kept, t] = x[: len(kept)]
            if t == steps:
                break
            obs, rewards, _, _, info = envs.step(actions[:, t])
            frame = common.to_numpy({**obs, "state": info["state"]})
            arrays["rewards"][kept, t] = common.to_numpy(rewards)[: len(kept)]
            arrays["success"][kept, t] = common.to_numpy(info["success"])[: len(kept)]
        bar.update(len(kept))
        meta["episodes_done"] = first + len(kept)
        save(path / "meta.json", json.dumps(meta, indent=2).encode())
    bar.close()
    envs.close()
    return arrays


class TransitionDataset:
    """Transitions of dataset/, on the disk, or on the GPU where they fit there."""

    def __init__(self, dataset: Path, device: str):
        self.device, self.arrays = device, {}
        self.with_next = ["rgb", "joints", "state"]  # arrays of T+1 steps, of which a transition has two
        for name in (*self.with_next, "actions", "rewards"):
            x = torch.from_numpy(np.load(dataset / f"{name}.npy", mmap_mode="c"))  # torch warns of read-only arrays
            fits = device == "cuda" and x.nbytes < torch.cuda.mem_get_info()[0] / 2
            self.arrays[name] = x.to(device) if fits else x

    def __call__(self, index: np.ndarray) -> dict[str, Tensor]:
        """Transitions (s, o, a, r, s', o') number index (B,), counted through all episodes (line 3), each (B, ...)."""
        episode, t = np.divmod(index, self.arrays["actions"].shape[1])
        batch = {name: x[episode, t] for name, x in self.arrays.items()}
        for name in self.with_next:
            batch[f"next_{name}"] = self.arrays[name][episode, t + 1]
        return {name: x.to(self.device) for name, x in batch.items()}


# ---------------------------------------------------------------- training


def main(args: Args) -> None:
    """Collect the dataset, train phi, psi and g by Algorithm 1, write repr.pt."""
    check_task(args)
    path = open_run(args)
    if (path / "repr.pt").exists():
        print(f"{path / 'repr.pt'} is finished")
        return
    meta = path / "dataset" / "meta.json"
    if meta.exists():  # dataset/ may be a copy from another run
        same = ("env_id", "robot_triangles", "image_size", "num_episodes")
        load(meta, **{name: getattr(args, name) for name in same})
    arrays = collect_random_episodes(args, path / "dataset")
    transitions = TransitionDataset(path / "dataset", args.device)
    num_val = max(4, args.num_episodes // 10)  # held out from stages 1 and 2: the last ones
    train = {name: x[:-num_val] for name, x in arrays.items()}
    steps, action_dim = arrays["actions"].shape[1:]

    torch.manual_seed(args.seed)
    phi = StateEncoder(arrays["state"].shape[-1], args.u_dim)
    psi = ObservationEncoder(list(arrays["rgb"].shape[2:]), arrays["joints"].shape[-1], args.u_dim, args.amp)
    g = Predictor(args.u_dim, action_dim)
    for name, mean, std in (("state", phi.mean, phi.std), ("joints", psi.joints_mean, psi.joints_std)):
        mean.copy_(torch.from_numpy(train[name].mean((0, 1), dtype=np.float64)))
        # the floor keeps a centimetre of jitter from counting as much as the whole table
        std.copy_(torch.from_numpy(train[name].std((0, 1), dtype=np.float64).clip(0.05)))
    frames = np.array(train["rgb"][:128, ::8], np.float32)  # a sample that fits into memory
    psi.image_mean = torch.from_numpy(frames.mean((0, 1)))
    psi.image_std = torch.tensor((frames - frames.mean((0, 1))).std())
    # without this the reward term of a random policy is next to nothing
    g.reward_mean.fill_(train["rewards"].mean(dtype=np.float64))
    g.reward_std.fill_(train["rewards"].std(dtype=np.float64) + 1e-8)
    model = nn.ModuleDict({"phi": phi, "psi": psi, "g": g}).to(args.device)
    optimizer = torch.optim.Adam(model.parameters(), lr=args.learning_rate, fused=True)
    train_inds, val_inds = np.split(np.arange(args.num_episodes * steps), [-num_val * steps])
    updates_per_epoch, completed = math.ceil(len(train_inds) / args.batch_size), 0
    if (path / "checkpoint.pt").exists():
        checkpoint = load(path / "checkpoint.pt")
        model.load_state_dict(checkpoint["model"])
        optimizer.load_state_dict(checkpoint["optimizer"])
        completed = checkpoint["epoch"]
        print(f"resuming {path} at epoch {completed}", flush=True)
    writer = SummaryWriter(path, purge_step=completed * updates_per_epoch + 1)
    bar = tqdm(range(completed, args.epochs), "phi", args.epochs, initial=completed, unit="epoch")

    for epoch in bar:
        torch.manual_seed(args.seed * 1_000_000 + epoch)  # so that a resumed run repeats the epoch
        order = np.random.default_rng([args.seed, epoch]).permutation(train_inds)
        for index in np.array_split(order, updates_per_epoch):
            losses = repr_losses(model, transitions(index), args)
            optimizer.zero_grad()
            losses["total"].backward()
            # clips nothing, stops at NaN
            nn.utils.clip_grad_norm_(model.parameters(), math.inf, error_if_nonfinite=True)
            optimizer.step()

        with torch.no_grad():
            val_batch = transitions(np.random.default_rng(0).choice(val_inds, min(1000, len(val_inds)), replace=False))
            val_losses = repr_losses(model, val_batch, args)
            active = (phi(val_batch["state"]).mean.std(0) > 0.1).sum()
        bar.set_postfix(held_out_reward=f"{val_losses['reward']:.2f}")
        update = (epoch + 1) * updates_per_epoch
        writer.add_scalar("held_out/active_dimensions", active, update)  # of u; the others have collapsed
        for name, loss in losses.items():
            writer.add_scalar(f"losses/{name}", loss, update)
            writer.add_scalar(f"held_out/{name}", val_losses[name], update)
        writer.flush()
        checkpoint = {"epoch": epoch + 1, "model": model.state_dict(), "optimizer": optimizer.state_dict()}
        save(path / "checkpoint.pt", checkpoint)

    content = {**asdict(args), "num_val": num_val, "phi": phi.state_dict(), "norm": dict(psi.named_buffers())}
    save(path / "repr.pt", content)
    print(f"{path / 'repr.pt'} is finished")


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
        main(parse_args())
    except KeyboardInterrupt:
        sys.exit("\nstopped; the same command resumes the run from what was saved last")
    except (EOFError, ConnectionError):  # of the pipe to a simulator
        message = "a simulator process was killed, perhaps as memory ran out; the same command resumes the run"
        print(f"error: {message}", file=sys.stderr, flush=True)
        for worker in multiprocessing.active_children():
            worker.kill()
        os._exit(2)  # gymnasium would still talk to the dead process
