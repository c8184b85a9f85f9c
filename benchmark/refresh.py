"""Does a belief still know u when its agent acts? And if not: a dataset with that agent's episodes in it.

A belief is trained on episodes of the random policy. Once PPO has sent the arm elsewhere it may lose what it knew. This
plays every second scene of stage 1's dataset once more with a trained agent, says how well its belief knew u there, and
writes all episodes as a run of stage 1 with the same phi, on which stage 2 trains a refreshed belief. Half as many
episodes come on top, so the stages after it need --num-episodes 960 in place of --small's 640.

Usage:   python benchmark/refresh.py --agent runs/RememberColor3-v0__ppo_aib_small__1/agent.pt
         python aib_belief.py --env-id RememberColor3-v0 --small --num-episodes 960 \
             --repr-dir 'runs/{env_id}__aib_repr_refreshed__{seed}' --exp-name aib_belief_refreshed
         python ppo_aib.py --env-id RememberColor3-v0 --small --num-episodes 960 \
             --belief 'runs/{env_id}__aib_belief_refreshed__{seed}/belief.pt' --exp-name ppo_aib_refreshed
         (Believer: ppo_believer.py with --repr-dir and --exp-name ppo_believer_refreshed)
Reads:   agent.pt of ppo_aib.py or ppo_believer.py; stage 1's dataset/ and repr.pt
Writes:  runs/{env_id}__{exp_name}__{seed}/: dataset/, repr.pt
"""

import math
import os
import shutil
import sys
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path

import gymnasium as gym
import numpy as np
import torch
import tyro
from tqdm import tqdm

sys.path.insert(0, str(Path(__file__).parent.parent))
import ppo_aib  # noqa: E402
import ppo_believer  # noqa: E402
from aib_belief import StateEncoder  # noqa: E402
from ppo_aib import Agent, fail, load  # noqa: E402


@dataclass
class Args:
    agent: str
    """agent.pt of ppo_aib.py or ppo_believer.py"""
    repr_dir: str = "runs/{env_id}__aib_repr_small__{seed}"
    """stage 1's run directory, on which the agent's belief was trained"""
    exp_name: str = "aib_repr_refreshed"
    """results go to runs/{env_id}__{exp_name}__{seed}"""
    num_workers: int = ppo_aib.Args.num_workers
    """simulator processes on physx_cpu"""


def rows_of(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Scene of each row of a refreshed dataset of count scenes, held-out ones last; and whether the agent played it."""
    scenes = np.sort(np.concatenate([np.arange(count), np.arange(1, count, 2)]))
    return scenes, np.diff(scenes, prepend=-1) == 0  # a scene's second episode


@torch.no_grad()
def play(
    envs: gym.vector.VectorEnv, agent: Agent, settings: ppo_aib.Args, seeds: np.ndarray
) -> dict[str, torch.Tensor]:
    """One episode per seed (E,), E at most envs.num_envs, with actions drawn from the policy; what stage 1 keeps of it.

    rgb, joints, state (E, T+1, ...); actions, rewards, success (E, T, ...); cue (E, K); mean particle (E, T+1, u).
    """
    device, config, count = agent.log_std.device, agent.belief.config, envs.num_envs
    obs, info = envs.reset(seed=np.resize(seeds, count).tolist())
    cue, hidden, played = info["cue"], None, defaultdict(list)
    for t in range((steps := gym.spec(settings.env_id).max_episode_steps) + 1):
        step = {name: torch.as_tensor(obs[name], device=device) for name in ("rgb", "joints")}
        noise = [torch.randn(count, settings.num_particles, config[name], device=device) for name in ("z_dim", "u_dim")]
        h, hidden = agent.belief.history(agent.belief.history.embed(step["rgb"], step["joints"])[None], hidden)
        u = agent.belief.decode(h[0], noise[0])
        step["particles"] = u.mean + u.stddev * noise[1]
        seen = {"rgb": obs["rgb"], "joints": obs["joints"], "state": info["state"]}
        seen["particle"] = step["particles"].mean(-2)
        if t < steps:
            seen["actions"] = agent(step)[0].sample().clamp(-1, 1)
            obs, seen["rewards"], _, _, info = envs.step(seen["actions"].cpu().numpy())
            seen["success"] = info["success"]
        for name, x in seen.items():
            played[name].append(torch.as_tensor(np.array(x)) if isinstance(x, np.ndarray) else x.cpu())
    episodes = {name: torch.stack(xs, 1) for name, xs in played.items()} | {"cue": torch.as_tensor(cue).cpu()}
    return {name: x[: len(seeds)] for name, x in episodes.items()}


def main(args: Args) -> None:
    """Play, report, write the mixed dataset whole or not at all."""
    hint = "name an agent.pt of ppo_aib.py or ppo_believer.py with --agent"
    stored = load(Path(args.agent), hint)
    beliefs = {"ppo_aib agent": ppo_aib.AIBBelief, "ppo_believer agent": ppo_believer.BelieverBelief}
    if stored.get("kind") not in beliefs:
        fail(f"{args.agent} is a file of another kind ({stored.get('kind')}); {hint}")
    settings = ppo_aib.Args(num_workers=args.num_workers)  # devices of this machine, the rest as the agent was trained
    for name in ("env_id", "seed", "robot", "robot_triangles", "num_envs", "init_std", "amp", "num_particles"):
        setattr(settings, name, stored[name])
    source = Path(args.repr_dir.format(**vars(settings)))
    task = {name: stored[name] for name in ("env_id", "robot", "robot_triangles")}
    encoder = load(source / "repr.pt", "name its run of aib_repr.py with --repr-dir", kind="repr", **task)
    if encoder["sim_backend"] == "physx_cuda":
        fail(f"{source} is of physx_cuda, which draws scenes by batch; only episodes of physx_cpu can be played again")
    settings.sim_backend = "physx_cpu"
    if "refreshed_by" in encoder:
        fail(f"{source} is a refreshed dataset; name the run of aib_repr.py that it was made from with --repr-dir")
    path = Path("runs") / f"{settings.env_id}__{args.exp_name}__{settings.seed}"
    if path.exists():
        fail(f"{path} exists; choose another --exp-name")
    ppo_aib.check_task(settings)
    files = list((source / "dataset").glob("*.npy"))
    if (size := sum(file.stat().st_size for file in files) * 1.5) > shutil.disk_usage(source).free:
        fail(f"{path} needs {size / 1e9:.1f} GB, more than its disk has free")

    envs, device = ppo_aib.make_envs(settings), torch.device(settings.device)
    belief = beliefs[stored["kind"]](stored["config"], settings.amp)
    agent = Agent(envs, belief, settings).to(device)
    agent.load_state_dict(stored["agent"])
    phi = StateEncoder(len(encoder["phi"]["mean"]), encoder["u_dim"])
    phi.load_state_dict(encoder["phi"])

    count, part = encoder["num_episodes"], path.with_name(path.name + ".part")
    scenes, by_agent = rows_of(count)
    rows = np.flatnonzero(by_agent)
    encoder |= {"num_episodes": len(scenes), "num_val": int((scenes >= count - encoder["num_val"]).sum())}
    shutil.rmtree(part, ignore_errors=True)
    (part / "dataset").mkdir(parents=True)
    arrays = {}
    for file in files:
        random = np.load(file, mmap_mode="r")
        shape = (len(scenes), *random.shape[1:])
        arrays[file.stem] = np.lib.format.open_memmap(part / "dataset" / file.name, "w+", random.dtype, shape)
        arrays[file.stem][~by_agent] = random
    u, particle, success = [], [], []
    torch.manual_seed(settings.seed)
    bar = tqdm(total=len(rows), desc="the agent's episodes", unit="episode")
    for now in np.array_split(rows, math.ceil(len(rows) / envs.num_envs)):
        seeds = (settings.seed * 1_000_000 + scenes[now]) % 2**29 + 2**30  # as in aib_repr.collect_random_episodes
        episodes = play(envs, agent, settings, seeds)
        for name, x in arrays.items():
            x[now] = episodes[name]
        u.append(phi(episodes["state"]).mean.detach())
        particle.append(episodes["particle"])
        success.append(episodes["success"].amax(1))
        bar.update(len(now))
    bar.close()
    envs.close()
    torch.save(encoder | {"refreshed_by": args.agent}, part / "repr.pt")
    os.replace(part, path)
    held_out = rows >= len(scenes) - encoder["num_val"]  # the belief has learnt the other scenes
    u, particle = torch.cat(u)[held_out], torch.cat(particle)[held_out]
    r2 = 1 - (u - particle).square().sum((0, 2)) / (u - u.mean(0)).square().sum((0, 2))
    known = " / ".join(f"{r2[t]:.2f}" for t in (4, 9, 30, -1))
    print(f"{len(rows)} episodes of the agent, success_once {torch.cat(success).mean():.2f}")
    print(f"R2 of u, mean particle, held-out scenes, steps 4 / 9 / 30 / last: {known}")
    print("the same when the policy is random: u_r2_prior in the belief's diagnostics.json")
    print("(Believer's is written by benchmark/belief.py)")
    print(f"{path} is finished; the stages after it need --num-episodes {len(scenes)}")


if __name__ == "__main__":
    try:
        main(tyro.cli(Args))
    except KeyboardInterrupt:
        sys.exit("\nstopped; the same command starts anew")
