"""Stage 1's dataset with every second episode played by an agent that reaches for an object drawn at random.

Beliefs are trained on a random policy's episodes, in which the arm hardly comes near the objects. Once PPO sends it
there they fail. An agent of true_state.py --target knows how to reach. Here it is shown an object drawn at random in
place of the target, so that where the arm goes tells nothing of the cue. Stage 2 is trained on these; phi stays.

Usage:   python aib_repr.py --env-id RememberColor5-v0 --small
         python benchmark/true_state.py --env-id RememberColor5-v0 --small --target --total-timesteps 100800
         python benchmark/reach.py --env-id RememberColor5-v0
         python aib_belief.py --env-id RememberColor5-v0 --small --exp-name aib_belief_reach \
             --repr-dir 'runs/{env_id}__aib_repr_reach__{seed}'
         python ppo_aib.py --env-id RememberColor5-v0 --small --exp-name ppo_aib_reach \
             --belief 'runs/{env_id}__aib_belief_reach__{seed}/belief.pt'
         (Believer: ppo_believer.py with that --repr-dir)
Reads:   dataset/ and repr.pt of a run of stage 1 on physx_cpu; agent.pt of true_state.py --target
Writes:  runs/{env_id}__{exp_name}__{seed}/: dataset/, repr.pt
"""

import os
import shutil
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import tyro
from tqdm import tqdm

sys.path.insert(0, str(Path(__file__).parent.parent))
import true_state  # noqa: E402

import ppo_baseline  # noqa: E402
from ppo_baseline import fail  # noqa: E402


@dataclass
class Args:
    env_id: str = "RememberColor5-v0"
    """a task of objects on a table: RememberColor, RememberShape, RememberShapeAndColor"""
    seed: int = 1
    """seed of the run of stage 1"""
    repr_dir: str = "runs/{env_id}__aib_repr_small__{seed}"
    """run directory of stage 1"""
    agent: str = "runs/{env_id}__true_target_small__{seed}/agent.pt"
    """agent of true_state.py --target"""
    exp_name: str = "aib_repr_reach"
    """results go to runs/{env_id}__{exp_name}__{seed}"""
    num_workers: int = ppo_baseline.Args.num_workers
    """simulator processes"""


class ShowRandomObject(true_state.ShowState):
    """Joints (25 + 3,) with the position of an object at their end, which the episode's seed draws."""

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple:
        task = self.env.unwrapped
        objects = list((task.cubes if hasattr(task, "cubes") else task.shapes).values())
        self.goal = objects[np.random.default_rng(seed).integers(len(objects))]
        return super().reset(seed=seed, options=options)

    def _show(self, obs: dict, info: dict) -> dict:
        return {**obs, "joints": np.append(obs["joints"], self.goal.pose.p[0].numpy())}


@torch.no_grad()
def main(args: Args) -> None:
    """Copy the run of stage 1 and play every second scene of it anew; whole or not at all."""
    source = Path(args.repr_dir.format(**vars(args)))
    path = Path("runs") / f"{args.env_id}__{args.exp_name}__{args.seed}"
    if not args.env_id.startswith(("RememberColor", "RememberShape")):
        fail(f"--env-id {args.env_id} has no objects to reach for; choose a RememberColor or RememberShape task")
    if path.exists():
        fail(f"{path} exists; choose another --exp-name")
    hint = "name a run of aib_repr.py with --repr-dir"
    stored = ppo_baseline.load(source / "repr.pt", hint, kind="repr", env_id=args.env_id, seed=args.seed)
    if stored["sim_backend"] != "physx_cpu":
        fail(f"{source} is of physx_cuda, which draws scenes by batch; only those of physx_cpu can be played again")
    task = {name: stored[name] for name in ("env_id", "robot_triangles", "image_size")}
    settings = true_state.Args(**task, num_workers=args.num_workers)
    ppo_baseline.check_task(settings)
    file, hint = Path(args.agent.format(**vars(args))), "name an agent.pt of true_state.py --target with --agent"
    weights = ppo_baseline.load(file, hint, kind="ppo_baseline agent", env_id=args.env_id)["agent"]
    if weights["joints_norm.running_mean"].shape != (25 + 3,):
        fail(f"{file} sees other things than joints and a position; {hint}")
    make_task = ppo_baseline.make_task
    ppo_baseline.make_task = lambda *arguments: ShowRandomObject(make_task(*arguments), pictures=True)
    envs = ppo_baseline.make_envs(settings)
    agent = true_state.StateAgent(envs, settings)
    agent.load_state_dict(weights)
    part = path.with_name(path.name + ".part")
    shutil.rmtree(part, ignore_errors=True)
    shutil.copytree(source / "dataset", part / "dataset")
    shutil.copy(source / "repr.pt", part)
    arrays = {file.stem: np.load(file, mmap_mode="r+") for file in (part / "dataset").glob("*.npy")}
    steps = arrays["actions"].shape[1]
    episodes = np.arange(1, stored["num_episodes"], 2)
    torch.manual_seed(args.seed)
    bar = tqdm(total=len(episodes) * steps, desc="reaching", unit="step")
    for first in range(0, len(episodes), envs.num_envs):
        rows = episodes[first : first + envs.num_envs]
        seeds = (args.seed * 1_000_000 + rows) % 2**29 + 2**30  # as in aib_repr.collect_random_episodes
        obs, info = envs.reset(seed=np.resize(seeds, envs.num_envs).tolist())
        for t in range(steps + 1):
            for name, x in (("rgb", obs["rgb"]), ("joints", obs["joints"][:, :25]), ("state", info["state"])):
                arrays[name][rows, t] = x[: len(rows)]
            if t == steps:
                break
            actions = agent({"joints": torch.from_numpy(obs["joints"])})[0].sample().clamp(-1, 1).numpy()
            obs, rewards, _, _, info = envs.step(actions)
            for name, x in (("actions", actions), ("rewards", rewards), ("success", info["success"])):
                arrays[name][rows, t] = x[: len(rows)]
            bar.update(len(rows))
    bar.close()
    envs.close()
    success = arrays["success"][1::2].any(1).mean()
    os.replace(part, path)
    print(f"{path}: {len(episodes)} episodes of reaching, success_once {success:.2f} (chance: one of the objects)")


if __name__ == "__main__":
    main(tyro.cli(Args))
