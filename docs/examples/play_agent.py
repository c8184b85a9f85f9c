"""Play an agent of ppo_aib.py in a loop of one's own: by default the one beside this file.

Usage:   python docs/examples/play_agent.py --seed 1
         python docs/examples/play_agent.py --checkpoint runs/RememberColor3-v0__ppo_aib_small__1/agent.pt
Writes:  episode.mp4, what the agent's camera sees, and beside it the scene, in which hidden objects stay visible
"""

import sys
from pathlib import Path

import gymnasium as gym
import imageio.v3 as iio
import numpy as np
import torch
import tyro

sys.path.insert(0, str(Path(__file__).parents[2]))
import ppo_aib

AGENT = Path(__file__).with_name("remember_color3.pt")


@torch.no_grad()
def main(checkpoint: Path = AGENT, seed: int = 0) -> None:
    """Play one episode with mean actions."""
    stored = torch.load(checkpoint, map_location="cpu", weights_only=True)
    same = {name: stored[name] for name in ("env_id", "image_size", "robot_triangles", "amp", "num_particles")}
    args = ppo_aib.Args(**same, device="cpu", num_envs=1, num_workers=1)
    envs = ppo_aib.make_envs(args)
    agent = ppo_aib.Agent(envs, ppo_aib.AIBBelief(stored["config"]), args)
    agent.load_state_dict(stored["agent"])
    torch.manual_seed(seed)  # of the particles
    obs, _ = envs.reset(seed=[seed])
    recurrent, succeeded, frames = None, False, []
    for _ in range(gym.spec(args.env_id).max_episode_steps):
        rgb, joints = torch.as_tensor(obs["rgb"]), torch.as_tensor(obs["joints"])
        (scene,) = envs.call("render_rgb_array")  # ManiSkill's camera for people, (1, 512, 512, 3)
        rows = np.arange(512) * args.image_size // 512  # enlarges the agent's picture to 512 x 512
        frames.append(np.concatenate([obs["rgb"][0][rows][:, rows], scene[0].numpy()], 1))
        h, recurrent = agent.belief.history(rgb, joints, recurrent)
        p_u = agent.belief.decode(h, torch.randn(1, args.num_particles, agent.belief.config["z_dim"]))
        dist, _ = agent({"rgb": rgb, "joints": joints, "particles": p_u.sample()})
        obs, _, _, _, info = envs.step(dist.mean.numpy())
        succeeded |= bool(info["success"][0])
    envs.close()
    iio.imwrite("episode.mp4", frames, fps=10)
    print(f"{args.env_id}, seed {seed}: {'a success' if succeeded else 'no success'}")


if __name__ == "__main__":  # the simulator's process imports this file, too
    tyro.cli(main)
