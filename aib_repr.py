"""AIB stage 1: a compact representation u = phi(s) of privileged state (paper section 3.1, Algorithm 1).

A random policy plays episodes of a MIKASA-Robo task; camera images, joints, actions, rewards and the simulator's
privileged state are stored. A state encoder phi and an observation encoder psi then predict reward and next latents
together, while a KL penalty makes phi keep only what the camera does not show. Only phi goes on to stage 2.

Usage:   python aib_repr.py --env-id InterceptFast-v0
Reads:   nothing
Writes:  runs/{env_id}__{exp_name}__{seed}/: dataset/ (one .npy memory map per array), repr.pt, diagnostics.json
"""

import ctypes
import difflib
import fcntl
import io
import json
import math
import os
import shutil
import signal
import sys
import time
import zipfile
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Literal, NoReturn

import gymnasium as gym
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
    exp_name: str = "aib_repr"
    """results go to runs/{env_id}__{exp_name}__{seed}"""
    seed: int = 1
    """seed of weights, noise and episodes"""
    device: Literal["cpu", "cuda"] | None = None
    """where the networks live; None: cuda if there is one"""
    sim_backend: Literal["physx_cpu", "physx_cuda"] | None = None
    """physics; None: physx_cuda on a cuda device"""
    render_backend: Literal["sapien_cpu", "sapien_cuda"] | None = None
    """renderer; None: sapien_cuda on a cuda device"""
    robot: Literal["panda_wristcam", "panda"] | None = None
    """panda renders 3 times faster on a CPU; None: panda_wristcam, MIKASA's default (quick: panda)"""
    num_workers: int | None = None
    """simulator processes on physx_cpu, which must divide the episodes; None: as many as there are cores"""
    num_envs: int | None = None
    """scenes simulated at a time on physx_cuda, which must divide the episodes; None: 250, quick: 16"""
    quick: bool = False
    """a trial of a minute or two whose results mean nothing"""
    overwrite: bool = False
    """delete what the run directory holds and start anew"""
    checkpoint_minutes: float = 5.0
    """minutes between checkpoints"""

    num_episodes: int | None = None
    """episodes of the random policy; None: 1000, quick: 16"""
    val_share: float | None = None
    """share of the episodes held out; None: 0.05, quick: 0.25"""
    epochs: int | None = None
    """passes over the training transitions; None: 200, quick: 2"""
    batch_size: int = 500
    """transitions per update"""
    learning_rate: float = 3e-4
    """Adam's"""
    u_dim: int = 16
    """size of u"""
    reward_coef: float = 10.0
    """lambda_r"""
    state_coef: float = 0.3
    """lambda_s"""
    obs_coef: float = 0.03
    """lambda_o"""
    kl_coef: float = 0.01
    """lambda_KL; the paper's 0.03, summed over u's dimensions, leaves too little of the cue in u"""
    reward_norm: bool = True
    """standardise rewards; without it the reward term of a random policy is next to nothing"""
    kl_reduction: Literal["sum", "mean"] = "sum"
    """over u's dimensions: sum is the paper's formula, mean what Believer's code does"""
    image_norm: Literal["mean", "none"] = "mean"
    """subtract the dataset's mean image and divide by what varies, or just divide by 255"""
    amp: bool | None = None
    """bfloat16 convolutions; None: on CUDA and on CPUs with bfloat16 instructions"""


DEFAULTS = dict(robot="panda_wristcam", num_envs=250, num_episodes=1000, val_share=0.05, epochs=200)
QUICK = dict(robot="panda", num_envs=16, num_episodes=16, val_share=0.25, epochs=2)


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


# ---------------------------------------------------------------- environments


class TaskView(gym.Wrapper):
    """Split what a task shows from what only the simulator knows, for a batch of B scenes.

    Observation: rgb (B, H, W, 3) uint8 of the base camera and joints (B, 25) float32 (qpos, qvel, tool pose).
    Info, privileged: success (B,), state (B, D) without what is observable, cue (B, K), the memory variable itself.

    On the CPU simulator it also lets hidden objects come back. MIKASA hides an object by writing z = 1000 into its pose
    inside evaluate(). On the GPU this reaches renderer and reward, but not physics. On the CPU it moves the body, so
    the pose from before is put back before physics goes on.
    """

    def __init__(self, env: gym.Env):
        super().__init__(env)
        task, self._poses = env.unwrapped, {}
        task.update_obs_space(self._observation(task._init_raw_obs))
        evaluate = task.evaluate

        def evaluate_and_remember() -> dict:
            self._poses = {actor: actor.pose.raw_pose.clone() for actor in task.scene.actors.values()}
            return evaluate()

        if not task.gpu_sim_enabled:
            task.evaluate = evaluate_and_remember

    def _put_back(self) -> None:
        for actor, pose in self._poses.items():
            if not torch.equal(actor.pose.raw_pose, pose):
                actor.pose = pose

    def _observation(self, obs: dict) -> dict:
        return {"rgb": obs["rgb"][..., :3].contiguous(), "joints": obs["state"]}

    def _info(self, info: dict) -> dict:
        from mani_skill.utils.common import flatten_state_dict

        task = self.env.unwrapped
        mode, task._obs_mode = task._obs_mode, "state_dict"  # MIKASA adds the hidden facts in this mode only
        facts = task._get_obs_extra(info)
        task._obs_mode = mode
        facts.pop("tcp_pose")
        state = flatten_state_dict(facts, use_torch=True).float()
        state = torch.where(state.abs() > 500, 1.0, state)  # z = 1000 of a hidden object would drown all else
        return {
            "success": info["success"].float(),
            "state": state,
            "cue": task.oracle_info.float().reshape(len(state), -1),
        }

    def reset(self, **kwargs: object) -> tuple:
        """See gym.Env.reset."""
        self._put_back()
        obs, info = self.env.reset(**kwargs)
        return self._observation(obs), self._info(info)

    def step(self, action: torch.Tensor) -> tuple:
        """See gym.Env.step."""
        self._put_back()
        obs, reward, terminated, truncated, info = self.env.step(action)
        return self._observation(obs), reward, terminated, truncated, self._info(info)


def make_task(args: "Args", num_scenes: int) -> gym.Env:
    """Build one ManiSkill environment of num_scenes; on physx_cpu that is one, and arrays are numpy without batch."""
    import mikasa_robo_suite.rl.memory_envs  # noqa: F401  (registers the tasks)
    from mani_skill.utils.wrappers import CPUGymWrapper, FlattenRGBDObservationWrapper

    env = gym.make(
        args.env_id,
        num_envs=num_scenes,
        obs_mode="rgb",
        control_mode="pd_joint_delta_pos",
        reward_mode="normalized_dense",
        robot_uids=args.robot,
        sim_backend=args.sim_backend,
        render_backend=args.render_backend,
    )
    env = FlattenRGBDObservationWrapper(env, rgb=True, depth=False, state=True)
    if args.sim_backend == "physx_cuda":
        return TaskView(env)
    torch.set_num_threads(1)  # a process per core
    return CPUGymWrapper(TaskView(env), ignore_terminations=True)


def make_envs(args: "Args", num_episodes: int) -> gym.vector.VectorEnv:
    """Build the environments that play num_episodes in rounds of envs.num_envs whole episodes, without auto-reset.

    physx_cuda: one batch of args.num_envs scenes. physx_cpu: args.num_workers processes of one scene each.
    Fails for an unknown task, assets not at hand, a worker count that leaves a remainder, or no rendering device.
    """
    import mikasa_robo_suite.rl.memory_envs  # noqa: F401  (registers the tasks)
    import sapien
    from mani_skill.utils import assets
    from mani_skill.utils.registration import REGISTERED_ENVS
    from mani_skill.vector.wrappers.gymnasium import ManiSkillVectorEnv

    tasks = {uid: spec for uid, spec in REGISTERED_ENVS.items() if spec.cls.__module__.startswith("mikasa_robo_suite")}
    if args.env_id not in tasks:
        near = difflib.get_close_matches(args.env_id, tasks, cutoff=0)
        fail(f"unknown task --env-id {args.env_id}; the nearest names are {', '.join(near)}")
    for asset in tasks[args.env_id].asset_download_ids or []:
        if not assets.is_data_source_downloaded(asset):
            get = f"python -m mani_skill.utils.download_asset {asset}"
            fail(f"{args.env_id} needs the asset '{asset}', which is not on this machine; fetch it with: {get}")
    if args.num_workers is None:
        cores = len(os.sched_getaffinity(0))
        args.num_workers = max(n for n in range(1, cores + 1) if num_episodes % n == 0)
    size, name = (args.num_workers, "workers") if args.sim_backend == "physx_cpu" else (args.num_envs, "envs")
    if size < 1 or num_episodes % size:
        fail(f"--num-{name} {size} does not divide {num_episodes} episodes; choose a divisor")
    try:
        sapien.render.RenderSystem(sapien.Device(args.render_backend.removeprefix("sapien_")))
    except RuntimeError as error:
        driver = "without a GPU: packages mesa-vulkan-drivers 24.3 or newer and libvulkan1; see README, Troubleshooting"
        fail(f"no rendering device for {args.render_backend} ({error}); install a Vulkan driver ({driver})")
    if args.sim_backend == "physx_cuda":
        return ManiSkillVectorEnv(make_task(args, args.num_envs), auto_reset=False, ignore_terminations=True)
    os.environ.setdefault("LP_NUM_THREADS", "1")  # of Mesa's CPU renderer: a process per core
    threads = torch.get_num_threads()
    signals = {signal.SIGINT, signal.SIGTERM, signal.SIGUSR1}
    signal.pthread_sigmask(signal.SIG_BLOCK, signals)  # workers inherit this: only the main process stops a run
    try:
        workers = [partial(make_task, args, 1)] * args.num_workers
        envs = gym.vector.AsyncVectorEnv(workers, context="spawn", autoreset_mode="Disabled")
    finally:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, signals)
        torch.set_num_threads(threads)
    envs.spec = gym.spec(args.env_id)
    return envs


@contextmanager
def simulator(args: "Args", num_episodes: int) -> Iterator[gym.vector.VectorEnv]:
    """Give the environments of make_envs and leave no process behind; a worker that died ends the run with code 1."""
    envs = make_envs(args, num_episodes)
    processes = getattr(envs, "processes", [])
    try:
        yield envs
    except (EOFError, ConnectionError):
        time.sleep(0.5)  # the exit code of the process that broke the pipe arrives a little later
        codes = [process.exitcode for process in processes if not process.is_alive()]
        mend = "what was saved is whole: run the same command again to go on"
        fail(f"a simulator process of {args.env_id} died with exit code {codes}; {mend}", code=1)
    finally:
        for process in processes:
            process.kill()
            process.join()
        envs.closed = bool(processes)  # then nothing is left for close to do
        envs.close()


def announce_cost(args: "Args", envs: gym.vector.VectorEnv, num_steps: int) -> None:
    """Without a GPU and without --quick, say how long num_steps of simulation take at the rate measured now."""
    if args.quick or args.device == "cuda":
        return
    envs.reset(seed=[0] * envs.num_envs)
    start = time.time()
    for _ in range(10):
        envs.step(np.zeros(envs.action_space.shape, np.float32))
    rate = 10 * envs.num_envs / (time.time() - start)
    hours = f"{num_steps:,} steps at the measured {rate:.0f} steps/s take {num_steps / rate / 3600:.1f} hours"
    print(
        f"no CUDA device: {hours} of simulation, and training comes on top; --quick is a trial of minutes", flush=True
    )


def to_numpy(x: np.ndarray | torch.Tensor) -> np.ndarray:
    """View what the CPU (numpy) or GPU (torch) environments return as a numpy array."""
    return x.cpu().numpy() if isinstance(x, torch.Tensor) else np.asarray(x)


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


def create_dataset(path: Path, args: "Args", shapes: dict[str, tuple]) -> None:
    """Lay out dataset/ on the disk for arrays {name: (shape, dtype)}; fails when there is no room."""
    need = sum(math.prod(shape) * np.dtype(dtype).itemsize for shape, dtype in shapes.values())
    free = shutil.disk_usage(path.parent).free
    if need > free:
        fail(f"{path} needs {need / 1e9:.2f} GB and {free / 1e9:.2f} GB are free; make room or lower --num-episodes")
    path.mkdir(exist_ok=True)
    try:
        for name, (shape, dtype) in shapes.items():
            np.lib.format.open_memmap(path / f"{name}.npy", mode="w+", dtype=dtype, shape=shape)
            with open(path / f"{name}.npy", "r+b") as file:
                os.posix_fallocate(file.fileno(), 0, file.seek(0, os.SEEK_END))  # a full disk must show now, not later
    except OSError as error:
        fail(f"{path} could not be laid out ({error.strerror}); make room or lower --num-episodes")
    meta = {"format": FORMAT, "kind": "dataset", "env_id": args.env_id, "robot": args.robot, "camera": "base_camera"}
    meta |= {"control_mode": "pd_joint_delta_pos", "seed": args.seed, "episodes_done": 0}
    meta["arrays"] = {name: [list(shape), str(np.dtype(dtype))] for name, (shape, dtype) in shapes.items()}
    write_file(path / "meta.json", json.dumps(meta, indent=2).encode())


def collect(args: "Args", data: Path, stop: StopSignal) -> None:
    """Fill dataset/ with args.num_episodes whole episodes of the uniformly random policy, from where it stopped."""
    started, episodes = (data / "meta.json").exists(), args.num_episodes
    mend = "start anew with --overwrite"
    if started and open_dataset(data, mend)[0]["episodes_done"] == episodes:
        return
    with simulator(args, episodes) as envs:
        steps, (action_dim,) = envs.spec.max_episode_steps, envs.single_action_space.shape
        announce_cost(args, envs, episodes * steps)
        if not started:
            obs, info = envs.reset(seed=[0] * envs.num_envs)
            shapes = {
                "rgb": ((episodes, steps + 1, *obs["rgb"].shape[1:]), np.uint8),
                "joints": ((episodes, steps + 1, obs["joints"].shape[1]), np.float32),
                "state": ((episodes, steps + 1, info["state"].shape[1]), np.float32),
                "actions": ((episodes, steps, action_dim), np.float32),
                "rewards": ((episodes, steps), np.float32),
                "success": ((episodes, steps), np.bool_),
                "cue": ((episodes, info["cue"].shape[1]), np.float32),
            }
            create_dataset(data, args, shapes)
        meta, arrays = open_dataset(data, mend, mode="r+")
        bar = tqdm(total=episodes * steps, initial=meta["episodes_done"] * steps, desc="random policy", unit="step")
        for first in range(meta["episodes_done"] // envs.num_envs * envs.num_envs, episodes, envs.num_envs):
            now = np.arange(first, first + envs.num_envs)
            box = [np.random.default_rng([args.seed, n]).uniform(-1, 1, (steps, action_dim)) for n in now]
            arrays["actions"][now] = box
            obs, info = envs.reset(seed=((args.seed * 1_000_000 + now) % 2**29 + 2**30).tolist())
            arrays["cue"][now] = to_numpy(info["cue"])
            for t in range(steps + 1):
                arrays["rgb"][now, t], arrays["joints"][now, t] = to_numpy(obs["rgb"]), to_numpy(obs["joints"])
                arrays["state"][now, t] = to_numpy(info["state"])
                if stop.received:
                    bar.close()
                    stop.leave(data)
                if t < steps:
                    obs, reward, _, _, info = envs.step(arrays["actions"][now, t])
                    arrays["rewards"][now, t] = to_numpy(reward)
                    arrays["success"][now, t] = to_numpy(info["success"]) > 0.5
                    bar.update(envs.num_envs)
            for array in arrays.values():
                array.flush()
            meta["episodes_done"] = int(now[-1]) + 1
            write_file(data / "meta.json", json.dumps(meta, indent=2).encode())
        bar.close()


def read_transitions(data: Path, index: np.ndarray) -> dict[str, torch.Tensor]:
    """Read the transitions (s, o, a, r, s', o') at index (B, 2) of episode and step from dataset/.

    The maps are opened anew each time, so that pages once read do not stay in this process.
    """
    episode, t = index.T
    batch = {}
    for name in ("rgb", "joints", "state", "actions", "rewards"):
        array = np.load(data / f"{name}.npy", mmap_mode="r")
        batch[name] = torch.from_numpy(array[episode, t])
        if name in ("rgb", "joints", "state"):
            batch[f"next_{name}"] = torch.from_numpy(array[episode, t + 1])
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


class ObservationEncoder(nn.Module):
    """psi: rgb (B, H, W, 3) uint8 and joints (B, J), standardised inside, -> Normal over u^o (B, u_dim) (paper 3.1)."""

    def __init__(self, image_shape: tuple[int, ...], joints_dim: int, u_dim: int, amp: bool = False):
        super().__init__()
        self.amp = amp
        self.register_buffer("mean", torch.zeros(joints_dim))
        self.register_buffer("std", torch.ones(joints_dim))
        self.register_buffer("image_mean", torch.zeros(image_shape))
        self.register_buffer("image_std", torch.tensor(255.0))
        self.cnn = orthogonal_init(NatureCNN(image_shape, 256))
        self.net = GaussianMLP(256 + joints_dim, [256, 256], u_dim, min_std=1e-5)

    def forward(self, rgb: torch.Tensor, joints: torch.Tensor) -> Normal:
        with torch.autocast(rgb.device.type, torch.bfloat16, enabled=self.amp):
            image = self.cnn(rgb.float().sub_(self.image_mean).div_(self.image_std))
        return self.net(torch.cat([image.float(), (joints - self.mean) / self.std], -1))


class Predictor(nn.Module):
    """g: (u^s, u^o, a) -> reward (B,) and next latents u^s, u^o (B, u_dim) (Algorithm 1, line 5)."""

    def __init__(self, u_dim: int, action_dim: int):
        super().__init__()
        self.body = nn.Sequential(mlp([2 * u_dim + action_dim, 256, 256, 256]), nn.ReLU())
        self.reward, self.state, self.obs = nn.Linear(256, 1), nn.Linear(256, u_dim), nn.Linear(256, u_dim)

    def forward(self, u_s: torch.Tensor, u_o: torch.Tensor, action: torch.Tensor) -> tuple[torch.Tensor, ...]:
        x = self.body(torch.cat([u_s, u_o, action], -1))
        return self.reward(x).squeeze(-1), self.state(x), self.obs(x)


# ---------------------------------------------------------------- losses (Algorithm 1)


def kl_to_unit_gaussian(q: Normal, reduction: str) -> torch.Tensor:
    """KL[q || N(0, I)] of q over (B, size) (line 10): sum or mean over the dimensions, mean over the batch."""
    kl = kl_divergence(q, Normal(torch.zeros_like(q.mean), torch.ones_like(q.stddev), validate_args=False))
    return (kl.sum(-1) if reduction == "sum" else kl.mean(-1)).mean()


def repr_losses(model: nn.ModuleDict, batch: dict[str, torch.Tensor], kl_reduction: str) -> dict[str, torch.Tensor]:
    """The four terms of Algorithm 1 for a batch of transitions, each a mean over the batch."""
    phi, psi, g = model["phi"], model["psi"], model["g"]
    q_s, q_o = phi(batch["state"]), psi(batch["rgb"], batch["joints"])
    r_hat, s_hat, o_hat = g(q_s.rsample(), q_o.rsample(), batch["actions"])  # lines 4 and 5
    with torch.no_grad():  # line 6; the mean of a target gives the gradient of a sample with less noise
        s_next, o_next = phi(batch["next_state"]).mean, psi(batch["next_rgb"], batch["next_joints"]).mean
    return {
        "reward": (batch["rewards"] - r_hat).square().mean(),  # line 7
        "state": (s_next - s_hat).square().sum(-1).mean(),  # line 8
        "obs": (o_next - o_hat).square().sum(-1).mean(),  # line 9
        "kl": kl_to_unit_gaussian(q_s, kl_reduction),  # line 10
    }


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


def diagnose_repr(
    phi: StateEncoder, arrays: dict[str, np.ndarray], train: np.ndarray, val: np.ndarray
) -> dict[str, float]:
    """What the mean of u holds, held out: active dimensions (std over 0.1) and linear read-outs of cue and state.

    The read-outs see u with noise of std 0.1, the least that stage 2's decoder knows: what drowns in it, no belief is
    asked to remember, however well it could be read from u itself.
    """
    seed_everything(0)

    def rows(episodes: np.ndarray) -> tuple[torch.Tensor, ...]:
        state = torch.from_numpy(arrays["state"][episodes]).to(phi.mean.device)
        cue = torch.from_numpy(arrays["cue"][episodes]).to(phi.mean.device)[:, None].expand(-1, state.shape[1], -1)
        with torch.no_grad():
            return phi(state).mean.flatten(0, 1), cue.flatten(0, 1), state.flatten(0, 1)

    (u, cue, state), (u_val, cue_val, state_val) = rows(train), rows(val)
    active = (u_val.std(0) > 0.1).sum().item()
    u, u_val = (x + 0.1 * torch.randn_like(x) for x in (u, u_val))
    return {
        "active_dimensions": active,
        "cue_readout": score_readout(fit_readout(u, cue), u_val, cue_val),
        "state_readout": score_readout(fit_readout(u, state), u_val, state_val),
    }


# ---------------------------------------------------------------- training


def main(args: Args) -> None:
    """Collect the dataset, train phi, psi and g by Algorithm 1, write repr.pt."""
    keep_freed_memory()
    args = resolve(args, QUICK if args.quick else DEFAULTS)
    args.amp = has_bfloat16(args.device) if args.amp is None else args.amp
    num_val = math.ceil(args.num_episodes * args.val_share)
    if not 0 < num_val < args.num_episodes:
        fail(f"--val-share {args.val_share} of {args.num_episodes} leaves no episode held out or to train on; try 0.05")
    with run_directory(args) as path:
        if (path / "repr.pt").exists():
            print(f"{path / 'repr.pt'} is finished; --overwrite makes it anew")
            return
        stop, data, device = StopSignal(), path / "dataset", torch.device(args.device)
        collect(args, data, stop)
        _, arrays = open_dataset(data, "start anew with --overwrite")
        train, val = np.split(np.arange(args.num_episodes), [-num_val])
        steps, action_dim = arrays["actions"].shape[1:]

        seed_everything(args.seed)
        phi = StateEncoder(arrays["state"].shape[-1], args.u_dim)
        psi = ObservationEncoder(arrays["rgb"].shape[2:], arrays["joints"].shape[-1], args.u_dim, args.amp)
        for encoder, values in ((phi, arrays["state"][train]), (psi, arrays["joints"][train])):
            encoder.mean.copy_(torch.from_numpy(values.mean((0, 1), dtype=np.float64)))
            # the floor keeps a centimetre of jitter from counting as much as the whole table
            encoder.std.copy_(torch.from_numpy(values.std((0, 1), dtype=np.float64).clip(0.05)))
        if args.image_norm == "mean":
            psi.image_mean, psi.image_std = image_statistics(data, train[:256])
        model = nn.ModuleDict({"phi": phi, "psi": psi, "g": Predictor(args.u_dim, action_dim)}).to(device)
        optimizer = torch.optim.Adam(model.parameters(), lr=args.learning_rate, fused=True)
        rewards = arrays["rewards"][train].astype(np.float64)
        r_mean, r_std = (rewards.mean(), rewards.std() + 1e-8) if args.reward_norm else (0.0, 1.0)
        coefs = {"reward": args.reward_coef, "state": args.state_coef, "obs": args.obs_coef, "kl": args.kl_coef}

        def transitions(episodes: np.ndarray) -> np.ndarray:
            return np.stack(np.meshgrid(episodes, np.arange(steps), indexing="ij"), -1).reshape(-1, 2)

        def get_batch(index: np.ndarray) -> dict[str, torch.Tensor]:
            batch = read_transitions(data, index)
            batch["rewards"] = (batch["rewards"] - r_mean) / r_std
            return {name: x.to(device, non_blocking=True) for name, x in batch.items()}

        update, per_epoch = 0, math.ceil(len(train) * steps / args.batch_size)
        if (path / "checkpoint.pt").exists():
            checkpoint = load(path / "checkpoint.pt", "aib_repr checkpoint", "start anew with --overwrite")
            model.load_state_dict(checkpoint["model"])
            optimizer.load_state_dict(checkpoint["optimizer"])
            update = checkpoint["update"]
            print(f"going on with {path} at update {update}", flush=True)
        writer = SummaryWriter(path, purge_step=update + 1)  # of an earlier process, rows up to the checkpoint stay
        bar = tqdm(total=args.epochs * per_epoch, initial=update, desc="stage 1, phi", unit="update")
        saved, ready = time.time(), None
        with ThreadPoolExecutor(1) as pool:  # reads the next batch while this one trains
            while update < args.epochs * per_epoch:
                epoch, number = divmod(update, per_epoch)
                if ready is None:  # line 3: every training transition once an epoch, in random order
                    order = np.random.default_rng([args.seed, epoch]).permutation(transitions(train))
                    batches = np.array_split(order, per_epoch)
                    ready = pool.submit(get_batch, batches[number])
                batch = ready.result()
                ready = pool.submit(get_batch, batches[number + 1]) if number + 1 < per_epoch else None
                seed_everything(args.seed, 1, update)
                losses = repr_losses(model, batch, args.kl_reduction)
                losses["total"] = sum(coef * losses[name] for name, coef in coefs.items())  # line 11
                optimizer.zero_grad()
                losses["total"].backward()
                optimizer.step()
                values = check_finite(losses, f"update {update} of stage 1")
                update += 1
                bar.update()
                if update % 20 == 0:
                    for name, value in values.items():
                        writer.add_scalar(f"losses/{name}", value, update)
                if update % per_epoch == 0:
                    with torch.no_grad():
                        chunks = np.array_split(transitions(val), math.ceil(num_val * steps / args.batch_size))
                        parts = [repr_losses(model, get_batch(chunk), args.kl_reduction) for chunk in chunks]
                    for name in coefs:
                        writer.add_scalar(f"held_out/{name}", torch.stack([p[name] for p in parts]).mean(), update)
                if stop.received or time.time() - saved > 60 * args.checkpoint_minutes:
                    check_finite({n: x.sum() for n, x in model.named_parameters()}, f"update {update} of stage 1")
                    writer.flush()
                    checkpoint = {"update": update, "model": model.state_dict(), "optimizer": optimizer.state_dict()}
                    save(path / "checkpoint.pt", {"kind": "aib_repr checkpoint", **checkpoint})
                    saved = time.time()
                if stop.received:
                    stop.leave(path)
        bar.close()

        report = diagnose_repr(phi, arrays, train, val)
        for name, value in report.items():
            writer.add_scalar(f"diagnostics/{name}", value, update)
        writer.close()
        write_file(path / "diagnostics.json", (json.dumps(report, indent=2) + "\n").encode())
        content = {"kind": "repr", "env_id": args.env_id, "robot": args.robot, "quick": args.quick, "u_dim": args.u_dim}
        content |= {"num_episodes": args.num_episodes, "num_val": num_val, "state_dim": arrays["state"].shape[-1]}
        save(path / "repr.pt", {**content, "phi": {name: value.cpu() for name, value in phi.state_dict().items()}})
        print(f"{path / 'repr.pt'}: " + ", ".join(f"{name} {value:.3g}" for name, value in report.items()))


if __name__ == "__main__":
    main(tyro.cli(Args))
