"""The Believer baseline end to end (Wang et al., 2023): a belief with a fixed prior, then PPO on it and observation.

Where aib_belief.py learns a prior p(z|h) and shapes z by inverse dynamics, Believer draws z from N(0, I) and has no
action head. Networks, settings, PPO, evaluation and tags are those of aib_belief.py and ppo_aib.py.

Usage:   python ppo_believer.py --env-id InterceptFast-v0
         python ppo_believer.py --evaluate --checkpoint runs/InterceptFast-v0__ppo_believer__1/agent.pt
Reads:   runs/{env_id}__aib_repr__{seed}/: dataset/ and repr.pt; where they are missing, runs aib_repr.py first
Writes:  runs/{env_id}__{exp_name}__{seed}/: belief.pt, diagnostics.json, diagnostics.png, agent.pt, eval.csv,
         summary.json, videos/, TensorBoard events
"""

import copy
import ctypes
import difflib
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
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Literal, NoReturn

import gymnasium as gym
import imageio.v3 as iio
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
EVAL_SEED = 2**30 + 2**29  # first seed of the evaluation episodes; training seeds lie below 2**30


@dataclass
class Args:
    env_id: str = "InterceptFast-v0"
    """MIKASA-Robo task"""
    exp_name: str = "ppo_believer"
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
    """simulator processes on physx_cpu, which must divide num_envs; None: as many as there are cores"""
    quick: bool = False
    """a trial of a few minutes whose results mean nothing"""
    overwrite: bool = False
    """delete what the run directory holds and start anew"""
    checkpoint_minutes: float = 5.0
    """minutes between checkpoints"""

    repr_dir: Path | None = None
    """run directory of stage 1; None: runs/{env_id}__aib_repr__{seed}"""
    num_updates: int | None = None
    """gradient updates of the belief; the paper calls them epochs; None: 10000, quick: 4"""
    batch_episodes: int | None = None
    """whole episodes per update of the belief; None: 256, quick: 4"""
    belief_lr: float = 3e-4
    """Adam's learning rate for the belief"""
    z_dim: int = 32
    """size of z"""
    beta: float = 1.0
    """weight of KL(q || N(0, I))"""
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
    """previous actions in the history"""
    belief_amp: bool | None = None
    """bfloat16 convolutions in the belief's training; None: on CUDA and on CPUs with bfloat16 instructions"""
    held_out_every: int = 50
    """updates between looks at the held-out episodes; the best weights are kept"""

    num_particles: int = 30
    """particles drawn from the belief at every step"""
    particle_noise: bool = True
    """draw each particle from the decoder's Gaussian; without it, take its mean"""
    total_timesteps: int | None = None
    """environment steps of training; None: by task, Table 5 (quick: 720)"""
    num_envs: int | None = None
    """whole episodes per iteration, on any number of workers; None: by task, Table 5 (quick: 4)"""
    learning_rate: float = 1e-4
    """Adam's"""
    update_epochs: int | None = None
    """passes over an iteration's data; None: by task, Table 5"""
    num_minibatches: int = 32
    """minibatches per pass"""
    gamma: float | None = None
    """discount; None: by task, Table 5"""
    gae_lambda: float = 0.9
    """lambda of generalised advantage estimation"""
    clip_coef: float = 0.2
    """clipping range of the probability ratio"""
    ent_coef: float = 0.001
    """weight of the entropy bonus"""
    vf_coef: float = 0.5
    """weight of the value loss"""
    max_grad_norm: float = 0.5
    """gradients are scaled down to this norm"""
    target_kl: float = 0.05
    """an iteration's update ends when the policy has moved so far"""
    eval_every: int | None = None
    """iterations between evaluations; None: 25, quick: 2"""
    num_eval_episodes: int | None = None
    """episodes per evaluation, the same every time; None: 192, quick: 4"""
    compile: bool = False
    """compile policy, advantages and update with torch.compile; pays on CUDA"""
    amp: bool = False
    """bfloat16 convolutions in policy and belief"""
    track: bool = False
    """also log to Weights & Biases"""
    evaluate: bool = False
    """only evaluate a checkpoint"""
    checkpoint: Path | None = None
    """the agent.pt to evaluate; None: the one in the run directory"""


BELIEF_DEFAULTS = dict(num_updates=10_000, batch_episodes=256)
BELIEF_QUICK = dict(num_updates=4, batch_episodes=4)
PPO_DEFAULTS = {
    **dict(robot="panda_wristcam", total_timesteps=10_000_000, num_envs=256, update_epochs=2, gamma=0.99),
    **dict(eval_every=25, num_eval_episodes=192),
}
TASKS = {  # Table 5, where it differs from PPO_DEFAULTS
    "RememberShapeAndColor3x2-v0": dict(total_timesteps=10_380_000, num_envs=200, update_epochs=4, gamma=0.95),
    "RememberColor9-v0": dict(total_timesteps=10_380_000, num_envs=200, gamma=0.95),
}
PPO_QUICK = dict(robot="panda", total_timesteps=720, num_envs=4, eval_every=2, num_eval_episodes=4)


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


class Stopped(Exception):
    """Raised inside an iteration once a stop signal came; the iteration is done anew when the run goes on."""


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


# ---------------------------------------------------------------- belief: networks


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


class BelieverBelief(nn.Module):
    """b(h) of Believer: history encoder, fixed prior N(0, I) and decoder p(u|z,h), all that acting needs."""

    def __init__(self, config: dict):
        super().__init__()
        self.config = config
        self.history = HistoryEncoder(config)
        self.decoder = GaussianMLP(config["z_dim"] + 256, [256, 256], config["u_dim"], min_std=0.1)

    def prior(self, h: torch.Tensor) -> Normal:
        """N(0, I), whatever the history: h (..., 256) -> Normal over (..., z_dim)."""
        zeros = torch.zeros(*h.shape[:-1], self.config["z_dim"], device=h.device)
        return Normal(zeros, torch.ones_like(zeros), validate_args=False)

    def decode(self, h: torch.Tensor, z_noise: torch.Tensor) -> Normal:
        """Give p(u|z_i,h) of each z_i ~ N(0, I): h (..., 256), noise (..., n, z_dim) -> Normal over (..., n, u_dim)."""
        return self.decoder(torch.cat([z_noise, h.unsqueeze(-2).expand(*z_noise.shape[:-1], -1)], -1))

    def particles(self, h: torch.Tensor, z_noise: torch.Tensor, u_noise: torch.Tensor) -> torch.Tensor:
        """Draw u_i ~ p(u|z_i,h), z_i ~ N(0, I): h (..., 256), noise (..., n, .) -> (..., n, u_dim)."""
        decoded = self.decode(h, z_noise)
        return decoded.mean + decoded.stddev * u_noise


# ---------------------------------------------------------------- belief: losses


def elbo_terms(belief: nn.Module, posterior: nn.Module, u: torch.Tensor, h: torch.Tensor) -> tuple[torch.Tensor, ...]:
    """Terms of -L_VAE at each step (...,): -log p(u|z,h) and KL(q || p); then z ~ q and the mean of q (..., z_dim)."""
    q = posterior(torch.cat([u, h], -1))
    z = q.rsample()
    nll = -belief.decoder(torch.cat([z, h], -1)).log_prob(u).sum(-1)
    return nll, kl_divergence(q, belief.prior(h)).sum(-1), z, q.mean


def believer_losses(model: nn.ModuleDict, batch: dict[str, torch.Tensor], args: Args) -> dict[str, torch.Tensor]:
    """-ELBO with the fixed prior and its terms, averaged over all steps of a batch of whole episodes."""
    h, _ = model["belief"].history(batch, bptt_steps=args.bptt_steps, amp=args.belief_amp)
    nll, kl, _, _ = elbo_terms(model["belief"], model["posterior"], batch["u"], h)
    losses = {"nll": nll.mean(), "kl": kl.mean()}
    losses["total"] = losses["nll"] + args.beta * losses["kl"]
    return losses


# ---------------------------------------------------------------- belief: diagnostics


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


# ---------------------------------------------------------------- agent


class BeliefAgent(nn.Module):
    """Actor and critic on image, joints and belief (paper 3.3): W(b) = W_agg(mean over particles of W_enc(u_i))."""

    def __init__(self, image_shape: list[int], joints_dim: int, action_dim: int, u_dim: int, amp: bool = False):
        super().__init__()
        self.amp = amp
        self.cnn = orthogonal_init(NatureCNN(image_shape, 256))
        self.joints = orthogonal_init(nn.Linear(joints_dim, 128))
        self.w_enc = orthogonal_init(mlp([u_dim, 64, 64]))
        self.w_agg = orthogonal_init(mlp([64, 64, 64]))
        self.actor = orthogonal_init(mlp([256 + 128 + 64, 512, action_dim]))
        self.critic = orthogonal_init(mlp([256 + 128 + 64, 512, 1]))
        orthogonal_init(self.actor[-1], 0.01 * math.sqrt(2))
        orthogonal_init(self.critic[-1], 1.0)
        self.log_std = nn.Parameter(torch.full((action_dim,), -0.5))

    def forward(self, obs: dict[str, torch.Tensor]) -> tuple[Normal, torch.Tensor]:
        """Policy over actions (B, A) and value (B,) of rgb (B, H, W, 3) uint8, joints (B, J), particles (B, n, u)."""
        belief = self.w_agg(self.w_enc(obs["particles"]).mean(-2))
        with torch.autocast(obs["rgb"].device.type, torch.bfloat16, enabled=self.amp):
            image = self.cnn(obs["rgb"].float().div_(255))
        x = torch.cat([image.float(), self.joints(obs["joints"]), belief], -1)
        mean = torch.tanh(self.actor(x))
        return Normal(mean, self.log_std.exp().expand_as(mean), validate_args=False), self.critic(x).squeeze(-1)


# ---------------------------------------------------------------- rollout, losses, update


@torch.no_grad()
def play_with_belief(
    envs: gym.vector.VectorEnv, agent: BeliefAgent, belief: nn.Module, args: "Args", seeds: np.ndarray, explore: bool
) -> Iterator[dict]:
    """Play one whole episode per seed, in rounds of envs.num_envs; yields each round's steps, t = 0 to T.

    A step holds t, index (a slice: the episodes), rgb, joints, particles, value and cue, then, but for the last,
    action, logprob, reward and success. All noise is drawn before the rounds: results do not depend on the workers.
    """
    steps, device, n = envs.spec.max_episode_steps, torch.device(args.device), args.num_particles
    noise = torch.randn(steps, len(seeds), *envs.single_action_space.shape, device=device) * explore
    z_noise = torch.randn(steps + 1, len(seeds), n, belief.config["z_dim"], device=device)
    u_noise = torch.randn(steps + 1, len(seeds), n, belief.config["u_dim"], device=device) * args.particle_noise
    low, high = (
        torch.as_tensor(x, device=device) for x in (envs.single_action_space.low, envs.single_action_space.high)
    )
    with torch.autocast(device.type, enabled=False):  # around all steps, so that weights are cast to bfloat16 once
        for first in range(0, len(seeds), envs.num_envs):
            index = slice(first, min(first + envs.num_envs, len(seeds)))
            count = index.stop - index.start
            obs, info = envs.reset(seed=np.resize(seeds[index], envs.num_envs).tolist())  # the last may idle
            gru_state, previous = None, torch.zeros(count, len(low), device=device)
            for t in range(steps + 1):
                step = {name: torch.as_tensor(obs[name], device=device)[:count] for name in ("rgb", "joints")}
                now = {"rgb": step["rgb"][None], "joints": step["joints"][None], "previous": previous[None]}
                h, gru_state = belief.history(now, gru_state, amp=args.amp)
                step["cue"] = torch.as_tensor(info["cue"], device=device)[:count]  # for evaluation only
                step["particles"] = belief.particles(h[0], z_noise[t, index], u_noise[t, index])
                policy, step["value"] = agent(step)
                if t < steps:
                    step["action"] = policy.mean + policy.stddev * noise[t, index]
                    step["logprob"] = policy.log_prob(step["action"]).sum(-1)
                    previous = step["action"].clamp(low, high)
                    sent = torch.zeros(envs.num_envs, len(low), device=device)
                    sent[:count] = previous
                    obs, reward, _, _, info = envs.step(
                        sent if args.sim_backend == "physx_cuda" else sent.cpu().numpy()
                    )
                    for name, x in (("reward", reward), ("success", info["success"])):
                        step[name] = torch.as_tensor(x, device=device, dtype=torch.float32)[:count]
                yield {"t": t, "index": index, **step}


def gather(played: Iterator[dict], steps: int, num_episodes: int) -> dict[str, torch.Tensor]:
    """Store what play yields as arrays (T, N, ...), value as (T+1, N); images stay uint8."""
    data = {}
    for step in played:
        for name in step.keys() - {"t", "index", "cue"}:
            x, length = step[name], steps + (name == "value")
            if name not in data:
                data[name] = torch.empty(length, num_episodes, *x.shape[1:], dtype=x.dtype, device=x.device)
            if step["t"] < length:
                data[name][step["t"], step["index"]] = x
    return data


def compute_gae(rewards: torch.Tensor, values: torch.Tensor, gamma: float, gae_lambda: float) -> torch.Tensor:
    """Generalised advantages (T, N) of whole episodes: rewards (T, N), values (T+1, N) with V(o_T) as the last."""
    advantages, last = torch.empty_like(rewards), torch.zeros_like(rewards[0])
    deltas = rewards + gamma * values[1:] - values[:-1]
    for t in reversed(range(len(rewards))):
        advantages[t] = last = deltas[t] + gamma * gae_lambda * last
    return advantages


def ppo_losses(agent: nn.Module, batch: dict[str, torch.Tensor], args: "Args") -> dict[str, torch.Tensor]:
    """PPO's clipped objective (Schulman et al., 2017) on a minibatch, with advantages normalised in it."""
    policy, value = agent(batch)
    log_ratio = policy.log_prob(batch["action"]).sum(-1) - batch["logprob"]
    ratio = log_ratio.exp()
    advantage = (batch["advantage"] - batch["advantage"].mean()) / (batch["advantage"].std() + 1e-8)
    clipped = ratio.clamp(1 - args.clip_coef, 1 + args.clip_coef)
    losses = {"policy_loss": -torch.min(ratio * advantage, clipped * advantage).mean()}
    losses["value_loss"] = 0.5 * (value - batch["return"]).square().mean()
    losses["entropy"] = policy.entropy().sum(-1).mean()
    losses["total"] = losses["policy_loss"] - args.ent_coef * losses["entropy"] + args.vf_coef * losses["value_loss"]
    with torch.no_grad():
        losses["approx_kl"] = (ratio - 1 - log_ratio).mean()  # Schulman's low-variance estimate
        losses["clipfrac"] = (ratio != clipped).float().mean()
    return losses


def ppo_update(
    agent: nn.Module, optimizer: torch.optim.Optimizer, data: dict[str, torch.Tensor], args: "Args", stop: StopSignal
) -> dict[str, float]:
    """Update the agent on what gather stored, until the last epoch or the KL target; returns the last losses."""
    gae, losses_of = compute_gae, ppo_losses
    if args.compile:
        gae, losses_of = torch.compile(gae), torch.compile(losses_of)
    advantage = gae(data["reward"], data["value"], args.gamma, args.gae_lambda)
    data = {**data, "advantage": advantage, "return": advantage + data["value"][:-1], "value": data["value"][:-1]}
    data = {name: x.flatten(0, 1) for name, x in data.items()}
    size, values = len(advantage.flatten()), {}
    for _ in range(args.update_epochs):
        for index in torch.randperm(size, device=advantage.device).tensor_split(args.num_minibatches):
            losses = losses_of(agent, {name: x[index] for name, x in data.items()}, args)
            values = check_finite(losses, "a PPO update")
            if stop.received:
                raise Stopped
            if values["approx_kl"] > args.target_kl:
                return values
            optimizer.zero_grad()
            losses["total"].backward()
            norm = nn.utils.clip_grad_norm_(agent.parameters(), args.max_grad_norm)
            check_finite({"gradient norm": norm}, "a PPO update")
            optimizer.step()
    return values


# ---------------------------------------------------------------- evaluation


def evaluate(played: Iterator[dict], steps: int, num_episodes: int) -> tuple[dict[str, float], np.ndarray]:
    """Success and return of played episodes, and a video (T, H, W, 3) of up to 8 of them, success framed in green."""
    success, reward = np.zeros((steps, num_episodes)), np.zeros((steps, num_episodes))
    frames: list = [[None] * min(8, num_episodes) for _ in range(steps)]
    for step in played:
        t, index = step["t"], step["index"]
        if t < steps:
            success[t, index], reward[t, index] = step["success"].cpu(), step["reward"].cpu()
            for i in range(index.start, min(index.stop, 8)):
                frame = step["rgb"][i - index.start].cpu().numpy().repeat(2, 0).repeat(2, 1)
                if t and success[t - 1, i]:
                    edge = np.ones(frame.shape[:2], bool)
                    edge[6:-6, 6:-6] = False
                    frame[edge] = (0, 255, 0)
                frames[t][i] = frame
    metrics = {
        "success_once": success.max(0).mean(),
        "success_at_end": success[-1].mean(),
        "return": reward.sum(0).mean(),
    }
    rows = [
        np.concatenate([np.concatenate(row[i : i + 4], 1) for i in range(0, len(row) // 4 * 4 or 1, 4)])
        for row in frames
    ]
    return {name: float(value) for name, value in metrics.items()}, np.stack(rows)


def evaluate_with_belief(
    played: Iterator[dict], steps: int, num_episodes: int, readout: dict
) -> tuple[dict[str, float], np.ndarray]:
    """See evaluate; also how well stage 2's linear read-out tells the cue from the mean particle in these episodes.

    The belief was trained on random actions: this shows whether it holds under the policy.
    """
    seen = []

    def watched() -> Iterator[dict]:
        for step in played:
            seen.append((step["particles"].mean(-2).cpu(), step["cue"].cpu()))
            yield step

    metrics, video = evaluate(watched(), steps, num_episodes)
    particle, cue = (torch.cat(column) for column in zip(*seen, strict=True))
    return {**metrics, "cue_readout": score_readout(readout, particle, cue)}, video


def encode_video(frames: np.ndarray) -> bytes:
    """Encode frames (T, H, W, 3) uint8 as an mp4 of 20 frames a second, the robot's control rate."""
    return iio.imwrite("<bytes>", frames, extension=".mp4", fps=20, macro_block_size=1)


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


def train_ppo(
    args: "Args",
    envs: gym.vector.VectorEnv,
    agent: nn.Module,
    play: Callable[[np.ndarray, bool], Iterator[dict]],
    look: Callable[[Iterator[dict]], tuple[dict[str, float], np.ndarray]],
    agent_file: dict,
    path: Path,
    stop: StopSignal,
) -> None:
    """Train by PPO with one whole episode in every environment per iteration, from the checkpoint in path if any.

    play(seeds, explore) yields the steps of whole episodes, look(played) evaluates them. Writes eval.csv, agent.pt
    (agent_file and the weights), videos/, TensorBoard events, and summary.json when it is finished.
    """
    steps, kind, mend = envs.spec.max_episode_steps, "ppo checkpoint", "start anew with --overwrite"
    per_iteration = steps * args.num_envs
    num_iterations = max(1, args.total_timesteps // per_iteration)
    optimizer = torch.optim.Adam(agent.parameters(), lr=args.learning_rate, eps=1e-5, fused=True)
    first, rows = 0, []
    if (path / "checkpoint.pt").exists():
        checkpoint = load(path / "checkpoint.pt", kind, mend)
        agent.load_state_dict(checkpoint["agent"])
        optimizer.load_state_dict(checkpoint["optimizer"])
        first, rows = checkpoint["iteration"], checkpoint["rows"]
        print(f"going on with {path} at step {first * per_iteration:,}", flush=True)
    if args.compile:
        agent.compile()
    writer = SummaryWriter(path, purge_step=first * per_iteration + 1)  # of an earlier process, older rows stay
    bar = tqdm(total=num_iterations * per_iteration, initial=first * per_iteration, desc="PPO", unit="step")
    saved = start = time.time()

    def played(seeds: np.ndarray, explore: bool) -> Iterator[dict]:
        look_bar = tqdm(total=len(seeds) * steps, desc="evaluation", unit="step", leave=False, disable=explore)
        for step in play(seeds, explore):
            if stop.received:
                raise Stopped
            yield step
            (bar if explore else look_bar).update(len(step["value"]) * (step["t"] < steps))
        look_bar.close()

    def log(values: dict[str, float], prefix: str, global_step: int) -> None:
        for name, value in values.items():
            writer.add_scalar(f"{prefix}/{name}", value, global_step)

    for iteration in range(first, num_iterations + 1):
        global_step = iteration * per_iteration
        snapshot = {
            "kind": kind,
            "iteration": iteration,
            "agent": copy.deepcopy(agent.state_dict()),
            "rows": list(rows),
        }
        snapshot["optimizer"] = copy.deepcopy(optimizer.state_dict())
        try:
            last = iteration == num_iterations
            if (last or iteration % args.eval_every == 0) and all(row["iteration"] != iteration for row in rows):
                seed_everything(0)  # every evaluation plays the same episodes with the same noise
                metrics, video = look(played(EVAL_SEED + np.arange(args.num_eval_episodes), False))
                log(metrics, "eval", global_step)
                row = {"iteration": iteration, "global_step": global_step}
                rows.append(row | {name: metrics[name] for name in ("success_once", "success_at_end", "return")})
                lines = [",".join(rows[0])] + [",".join(str(value) for value in row.values()) for row in rows]
                write_file(path / "eval.csv", ("\n".join(lines) + "\n").encode())
                save(path / "agent.pt", {**agent_file, "global_step": global_step, "agent": agent.state_dict()})
                (path / "videos").mkdir(exist_ok=True)
                write_file(path / "videos" / f"step_{global_step:08d}.mp4", encode_video(video))
                bar.set_postfix(success_once=f"{metrics['success_once']:.2f}")
                snapshot["rows"] = list(rows)
            if last:
                break
            if time.time() - saved > 60 * args.checkpoint_minutes:
                writer.flush()
                save(path / "checkpoint.pt", snapshot)
                saved = time.time()
            seed_everything(args.seed, 3, iteration)
            episode = args.seed * 1_000_000 + iteration * args.num_envs + np.arange(args.num_envs)
            began = time.time()
            data = gather(played(episode % 2**30, True), steps, args.num_envs)
            rolled = time.time()
            losses = ppo_update(agent, optimizer, data, args, stop)
        except Stopped:
            writer.flush()
            save(path / "checkpoint.pt", snapshot)
            bar.close()
            stop.leave(path)
        global_step += per_iteration
        once, done = data["success"].max(0)[0].mean().item(), global_step - first * per_iteration
        log(losses, "losses", global_step)
        log({"success_once": once, "return": data["reward"].sum(0).mean().item()}, "train", global_step)
        log({"rollout": rolled - began, "update": time.time() - rolled}, "time", global_step)
        log({"SPS": done / (time.time() - start), "learning_rate": args.learning_rate}, "charts", global_step)
        del data  # a gigabyte of images: not two at a time
    bar.close()
    writer.close()
    summary = {"env_id": args.env_id, "exp_name": args.exp_name, "seed": args.seed, "episodes": args.num_eval_episodes}
    for name in ("success_once", "success_at_end", "return"):
        values = [row[name] for row in rows]
        summary[name] = {"last_three_mean": float(np.mean(values[-3:])), "maximum": max(values)}
        print(f"{name}: mean of the last three evaluations {np.mean(values[-3:]):.3f}, maximum {max(values):.3f}")
    write_file(path / "summary.json", (json.dumps(summary, indent=2) + "\n").encode())
    if args.quick:
        print("this was a --quick trial: the code ran, the numbers mean nothing")


def track(args: "Args", path: Path) -> None:
    """Send what TensorBoard gets to Weights & Biases too; fails when that is not installed."""
    try:
        import wandb
    except ImportError:
        fail("--track needs Weights & Biases, which is not installed; pip install wandb, or leave --track out")
    wandb.init(project="aib", id=path.name, config=asdict(args), dir=path, sync_tensorboard=True, resume="allow")


def evaluate_checkpoint(args: "Args", kind: str, build: Callable) -> None:
    """Evaluate agent.pt on its own task and robot; writes evaluation.json and evaluation.mp4 beside it."""
    file = args.checkpoint or Path("runs") / f"{args.env_id}__{args.exp_name}__{args.seed}" / "agent.pt"
    stored = load(file, kind, "name an agent.pt of this script with --checkpoint")
    for name in stored.keys() & {"env_id", "robot", "num_particles", "particle_noise"}:
        setattr(args, name, stored[name])
    with simulator(args, args.num_envs) as envs:
        agent, play, look = build(args, envs, stored)
        agent.load_state_dict(stored["agent"])
        seed_everything(0)
        metrics, video = look(tqdm(play(EVAL_SEED + np.arange(args.num_eval_episodes), False), desc="evaluation"))
    write_file(file.with_name("evaluation.json"), (json.dumps(metrics, indent=2) + "\n").encode())
    write_file(file.with_name("evaluation.mp4"), encode_video(video))
    print(f"{file}, {args.num_eval_episodes} episodes: " + ", ".join(f"{k} {v:.3f}" for k, v in metrics.items()))


def make_belief(args: Args, path: Path, stop: StopSignal) -> None:
    """Train Believer's belief on stage 1's output and write belief.pt, as aib_belief.py does."""
    device = torch.device(args.device)
    episodes, sizes, cue, stored = load_episodes(Path(args.repr_dir), args, device)
    train, val = np.split(np.arange(stored["num_episodes"]), [-stored["num_val"]])
    seed_everything(args.seed)
    config = {"image_shape": sizes["image_shape"], "gru_layers": args.gru_layers, "u_dim": stored["u_dim"]}
    config |= {"joints_dim": sizes["joints_dim"] * args.history_joints, "z_dim": args.z_dim}
    config |= {"action_dim": sizes["action_dim"] * args.history_actions}
    belief = BelieverBelief(config)
    posterior = GaussianMLP(stored["u_dim"] + 256, [256, 256], args.z_dim, min_std=0.1)
    if args.chrono_init:
        chrono_init(belief.history.gru, sizes["steps"])
    if args.image_norm == "mean":
        belief.history.image_mean, belief.history.image_std = image_statistics(episodes.data, train[:256])
    model = nn.ModuleDict({"belief": belief, "posterior": posterior}).to(device)
    writer = train_belief(args, model, believer_losses, episodes, train, val, path, stop, path / "belief_events")
    fit, test = (encode(belief, posterior, episodes, index) for index in (train[:512], val))
    report, readout = diagnose_belief(fit, test, cue[train[:512]], cue[val])
    write_report(report, path, f"{args.env_id}, {args.exp_name}", writer, args.num_updates)
    writer.close()
    content = {"kind": "believer_belief", "env_id": args.env_id, "robot": args.robot, "quick": args.quick}
    content |= {"config": config, "readout": readout, "training_weights": posterior.cpu().state_dict()}
    save(path / "belief.pt", {**content, "weights": belief.cpu().state_dict()})


def build_believer(args: Args, envs: gym.vector.VectorEnv, stored: dict) -> tuple[BeliefAgent, Callable, Callable]:
    """Make agent, play and look (see train_ppo) from what belief.pt or agent.pt stores of the belief."""
    device, config, space = torch.device(args.device), stored["config"], envs.single_observation_space
    if list(space["rgb"].shape) != config["image_shape"]:
        fail(
            f"the belief was trained on images {config['image_shape']}, {args.env_id} shows {list(space['rgb'].shape)}"
        )
    belief = BelieverBelief(config).to(device)
    belief.load_state_dict(stored["weights"])
    belief.requires_grad_(False)  # only the aggregator in the agent goes on learning
    if args.amp:
        belief.history.cnn.bfloat16()  # once: autocast would cast frozen weights anew at every step
    seed_everything(args.seed)
    sizes = (space["joints"].shape[0], envs.single_action_space.shape[0], config["u_dim"])
    agent = BeliefAgent(config["image_shape"], *sizes, args.amp).to(device)
    look = partial(
        evaluate_with_belief,
        steps=envs.spec.max_episode_steps,
        num_episodes=args.num_eval_episodes,
        readout=stored["readout"],
    )
    return agent, partial(play_with_belief, envs, agent, belief, args), look


def main(args: Args) -> None:
    """Train belief and agent, or with --evaluate only evaluate an agent, of the Believer baseline."""
    defaults = PPO_DEFAULTS | TASKS.get(args.env_id, {}) | BELIEF_DEFAULTS
    keep_freed_memory()
    args = resolve(args, defaults | (PPO_QUICK | BELIEF_QUICK if args.quick else {}))
    args.repr_dir = str(args.repr_dir or Path("runs") / f"{args.env_id}__aib_repr__{args.seed}")
    args.belief_amp = has_bfloat16(args.device) if args.belief_amp is None else args.belief_amp
    if args.evaluate:
        evaluate_checkpoint(args, "ppo_believer agent", build_believer)
        return
    with run_directory(args) as path:
        if (path / "summary.json").exists():
            print(f"{path} is finished; --overwrite makes it anew")
            return
        if args.track:
            track(args, path)
        stop = StopSignal()
        if not (path / "belief.pt").exists():
            make_belief(args, path, stop)
        stored = load(path / "belief.pt", "believer_belief", "start anew with --overwrite")
        with simulator(args, args.num_envs) as envs:
            announce_cost(args, envs, args.total_timesteps)
            agent, play, look = build_believer(args, envs, stored)
            content = {name: stored[name] for name in ("env_id", "robot", "config", "weights", "readout")}
            content |= {"kind": "ppo_believer agent"}
            content |= {"num_particles": args.num_particles, "particle_noise": args.particle_noise}
            train_ppo(args, envs, agent, play, look, content, path, stop)


if __name__ == "__main__":
    main(tyro.cli(Args))
