"""Plain PPO on image and joints, the baseline without memory (Schulman et al., 2017; paper, section 4.2).

Usage:   python ppo_baseline.py --env-id InterceptFast-v0
         python ppo_baseline.py --evaluate --checkpoint runs/InterceptFast-v0__ppo_baseline__1/agent.pt
Writes:  runs/{env_id}__{exp_name}__{seed}/: agent.pt, eval.csv, videos/, TensorBoard events; args.json and
         checkpoint.pt to resume; with --evaluate evaluation.json and .mp4 beside agent.pt
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
from torch.distributions import Normal
from torch.utils.tensorboard import SummaryWriter
from tqdm import tqdm

CUDA = torch.cuda.is_available()
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
    exp_name: str = "ppo_baseline"
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
    """image network in bfloat16"""
    evaluate: bool = False
    """only evaluate --checkpoint; its task, image_size, robot_triangles, num_envs and amp hold"""
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
    exp_name="ppo_baseline_small",
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
)
QUICK = dict(
    exp_name="ppo_baseline_quick",
    total_timesteps=360,
    num_envs=2,
    num_minibatches=4,
    num_eval_episodes=2,
)


# ---------------------------------------------------------------- networks


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


class Agent(nn.Module):
    """Actor and critic on image and joints."""

    def __init__(self, envs: gym.vector.VectorEnv, args: Args):
        super().__init__()
        spaces = envs.single_observation_space
        (action_dim,) = envs.single_action_space.shape
        self.cnn = NatureCNN(spaces["rgb"].shape, 256, args.amp)
        self.joints = nn.Sequential(nn.Linear(spaces["joints"].shape[0], 128), nn.ReLU())
        self.actor = orthogonal_init(nn.Sequential(nn.Linear(256 + 128, 512), nn.ReLU(), nn.Linear(512, action_dim)))
        self.critic = orthogonal_init(nn.Sequential(nn.Linear(256 + 128, 512), nn.ReLU(), nn.Linear(512, 1)))
        orthogonal_init(self.actor[-1], 0.01 * 2**0.5)  # gains as in ManiSkill's PPO
        self.log_std = nn.Parameter(torch.full((action_dim,), math.log(args.init_std)))

    def forward(self, obs: dict[str, Tensor]) -> tuple[Normal, Tensor]:
        """rgb (B, H, W, 3) uint8, joints (B, J) -> Normal over actions (B, A), value (B,)."""
        image = self.cnn(obs["rgb"].float().div_(255))
        joints = self.joints(obs["joints"])
        x = torch.cat([image, joints], -1)
        mean = torch.tanh(self.actor(x))  # within the box of actions
        return Normal(mean, self.log_std.exp().expand_as(mean), validate_args=False), self.critic(x).squeeze(-1)


# ---------------------------------------------------------------- losses


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


# ---------------------------------------------------------------- data


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
        "actions": torch.empty(steps, num_episodes, action_dim, device=device),
        "logprobs": torch.empty(steps, num_episodes, device=device),
        "rewards": torch.empty(steps, num_episodes, device=device),
        "success": torch.empty(steps, num_episodes, device=device),
        "values": torch.empty(steps + 1, num_episodes, device=device),
    }
    noise = colored_noise(args.noise_beta, (num_episodes, action_dim, steps), np.random.default_rng(seeds))
    noise = torch.from_numpy(noise.transpose(2, 0, 1)).float().to(device)
    desc = "evaluation" if deterministic else "rollout"
    for first in range(0, num_episodes, envs.num_envs):
        last = min(first + envs.num_envs, num_episodes)
        # the simulator always plays envs.num_envs: the last round repeats episodes, which are not kept
        rows = np.arange(first, first + envs.num_envs) % num_episodes
        obs, _ = envs.reset(seed=seeds[rows].tolist())
        for t in tqdm(range(steps + 1), f"{desc}, episode {first} of {num_episodes}", unit="step", leave=False):
            transition = {name: torch.as_tensor(obs[name], device=device) for name in ("rgb", "joints")}
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


def evaluate(
    envs: gym.vector.VectorEnv, agent: Agent, args: Args, first_seed: int = EVAL_SEED
) -> tuple[dict[str, float], bytes]:
    """Metrics and video of args.num_eval_episodes episodes with mean actions, the same episodes every time."""
    torch.manual_seed(0)  # the same noise at every evaluation; main seeds each iteration anew
    buffer = rollout(envs, agent, args, first_seed + np.arange(args.num_eval_episodes), deterministic=True)
    return success_and_return(buffer), make_video(buffer)


# ---------------------------------------------------------------- training


def evaluate_checkpoint(args: Args) -> None:
    """Evaluate the agent of --checkpoint, on test episodes; writes evaluation.json and .mp4 beside it."""
    file = Path(args.checkpoint or f"runs/{args.env_id}__{args.exp_name}__{args.seed}/agent.pt")
    stored = load(file, script="ppo_baseline")
    if not os.access(file.parent, os.W_OK):
        fail(f"{file.parent} cannot be written, where evaluation.json and .mp4 would be; copy {file.name} elsewhere")
    for name in ("env_id", "robot_triangles", "image_size", "num_envs", "amp"):
        setattr(args, name, stored[name])
    check_task(args)
    envs = make_envs(args)
    agent = Agent(envs, args).to(args.device)
    agent.load_state_dict(stored["agent"])
    metrics, video = evaluate(envs, agent, args, TEST_SEED)
    metrics |= {"global_step": stored["global_step"], "num_eval_episodes": args.num_eval_episodes}
    report = json.dumps(metrics, indent=2)
    print(f"{file} on test episodes: {report}")
    save(file.with_name("evaluation.json"), report.encode())
    save(file.with_name("evaluation.mp4"), video)
    envs.close()


def main(args: Args) -> None:
    """Train an agent that acts on the present observation alone."""
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

    envs = make_envs(args)
    torch.manual_seed(args.seed)
    agent = Agent(envs, args).to(args.device)
    optimizer = torch.optim.Adam(agent.parameters(), lr=args.learning_rate, eps=1e-5, fused=True)
    completed, evals = checkpoint.get("iteration", 0), checkpoint.get("evals", [])
    if checkpoint:
        agent.load_state_dict(checkpoint["agent"])
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
            content = {"script": "ppo_baseline", **asdict(args)}
            save(path / "agent.pt", {**content, "global_step": global_step, "agent": agent.state_dict()})
            bar.set_postfix(success_once=f"{metrics['success_once']:.2f}")

        for name, value in scalars.items():
            writer.add_scalar(name, value, global_step)
        writer.flush()
        states = {"agent": agent.state_dict(), "optimizer": optimizer.state_dict()}
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
