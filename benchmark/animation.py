"""The animation of README.md: an AIB agent of RememberColor9-v0 in test episodes, and where its belief has the cube.

Above the agent's picture, below the scene, in which hidden cubes stay visible. The dots are the particles: for each u
the place on the table that a regression on stage 1's episodes finds.

Usage:   python benchmark/animation.py --checkpoint runs/RememberColor9-v0__ppo_aib_small__1/agent.pt --episodes 0 1 2
Reads:   the checkpoint, and dataset/state.npy and repr.pt of --repr-dir
Writes:  benchmark/results/agent.gif
"""

import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import torch
import tyro
from matplotlib import font_manager
from PIL import Image, ImageDraw, ImageFont

sys.path.insert(0, str(Path(__file__).parent.parent))
from diagnose_agent import load_phi

import ppo_aib

STEPS = 60
WIDTH, HEIGHT = 220, 174  # of a picture in the animation
AGENT_BOX = np.array([8, 14, 56, 52]) / 64  # left, top, right, bottom of what is shown of the agent's picture
SCENE_BOX = (110, 170, 330, 344)  # the same of the scene's, in pixels
PHASES = {0: "1. the cue: remember this colour", 5: "2. nothing to see", 10: "3. nine cubes: go to the one you saw"}


def features(u: np.ndarray) -> np.ndarray:
    """1, u and its products: (M, u_dim) -> (M, .)."""
    rows, columns = np.triu_indices(u.shape[1])
    return np.concatenate([np.ones((len(u), 1)), u, u[:, rows] * u[:, columns]], 1)


def places_of_u(repr_dir: Path) -> np.ndarray:
    """Coefficients of the right cube's place (x, y) by features(u), from stage 1's episodes."""
    state = np.load(repr_dir / "dataset" / "state.npy", mmap_mode="r")[:, [2, 7, 12, 30, 50]]
    state = state.reshape(-1, state.shape[-1])  # the right cube's number, then x, y and z of each
    x = 1 + 3 * state[:, 0].astype(int)
    place = np.stack([state[np.arange(len(state)), x + k] for k in range(2)], 1)
    with torch.no_grad():
        u = load_phi(repr_dir)(torch.from_numpy(state)).mean.numpy()
    return np.linalg.lstsq(features(u), place, rcond=None)[0]


def pixels(camera: object, places: np.ndarray) -> np.ndarray:
    """Where a camera sees places (M, 2) on the table, at half a cube's height: (M, 2)."""
    points = np.column_stack([places, np.full(len(places), 0.02), np.ones(len(places))])
    intrinsic = np.asarray(camera.get_intrinsic_matrix()).reshape(3, 3)
    extrinsic = np.asarray(camera.get_extrinsic_matrix()).reshape(-1, 4)[:3]
    x, y, depth = intrinsic @ extrinsic @ points.T
    return np.stack([x / depth, y / depth], 1)


@torch.no_grad()
def play(env: object, agent: torch.nn.Module, episode: int, coefficients: np.ndarray) -> list[tuple]:
    """Of each step of a test episode: the agent's picture, the scene's, the particles' pixels, success so far."""
    torch.manual_seed(episode)
    obs, _ = env.reset(seed=ppo_aib.TEST_SEED + episode)
    recurrent, succeeded, frames = None, False, []
    for _ in range(STEPS):
        rgb, joints = torch.as_tensor(obs["rgb"])[None], torch.as_tensor(obs["joints"])[None]
        h, recurrent = agent.belief.history(rgb, joints, recurrent)
        particles = agent.belief.decode(h, torch.randn(1, 30, agent.belief.config["z_dim"])).sample()
        scene = env.unwrapped.render_rgb_array()[0].numpy()
        camera = env.unwrapped._human_render_cameras["render_camera"].camera
        dots = pixels(camera, features(particles[0].numpy()) @ coefficients)
        frames.append((rgb[0].numpy().copy(), scene.copy(), dots, succeeded))
        dist, _ = agent({"rgb": rgb, "joints": joints, "particles": particles})
        obs, _, _, _, info = env.step(dist.mean[0].numpy())
        succeeded |= bool(info["success"])
    return frames


def draw(played: list[list[tuple]], t: int, font: ImageFont.FreeTypeFont) -> Image.Image:
    """One frame of the animation: the episodes side by side at step t."""
    image = Image.new("RGB", ((WIDTH + 8) * len(played) - 8, 2 * HEIGHT + 58), "white")
    text = ImageDraw.Draw(image)
    text.text((4, 4), PHASES[max(first for first in PHASES if first <= t)], "black", font)
    for k, frames in enumerate(played):
        x, (rgb, scene, dots, succeeded) = k * (WIDTH + 8), frames[t]
        above = Image.fromarray(rgb).crop(tuple(AGENT_BOX * len(rgb))).resize((WIDTH, HEIGHT), Image.NEAREST)
        below = Image.fromarray(scene).crop(SCENE_BOX)
        for column, row in dots - SCENE_BOX[:2]:
            box = (column - 3, row - 3, column + 3, row + 3)
            ImageDraw.Draw(below).ellipse(box, fill="white", outline="black")
        image.paste(above, (x, 26))
        image.paste(below, (x, HEIGHT + 32))
        if succeeded:
            text.text((x + 4, 2 * HEIGHT + 36), "success", "#1f77b4", font)
        elif t == STEPS - 1:
            text.text((x + 4, 2 * HEIGHT + 36), "no success", "#d62728", font)
    return image


def main(
    checkpoint: Path, repr_dir: Path, episodes: list[int], output: Path = Path("benchmark/results/agent.gif")
) -> None:
    """Play the numbered test episodes and draw them."""
    stored = ppo_aib.load(checkpoint, env_id="RememberColor9-v0")
    same = {name: stored[name] for name in ("env_id", "image_size", "robot_triangles", "amp", "num_particles")}
    args = ppo_aib.Args(**same, device="cpu", sim_backend="physx_cpu", render_backend="sapien_cpu", num_envs=1)
    env, coefficients = ppo_aib.make_task(args, 1), places_of_u(repr_dir)
    spaces = SimpleNamespace(single_observation_space=env.observation_space, single_action_space=env.action_space)
    agent = ppo_aib.Agent(spaces, ppo_aib.AIBBelief(stored["config"]), args)
    agent.load_state_dict(stored["agent"])
    played = [play(env, agent, episode, coefficients) for episode in episodes]
    font = ImageFont.truetype(font_manager.findfont("DejaVu Sans"), 15)
    frames = [draw(played, t, font) for t in range(STEPS)]
    strip = Image.fromarray(np.concatenate([np.asarray(frame) for frame in frames[::10]]))
    palette = strip.quantize(255, Image.Quantize.MEDIANCUT, kmeans=2)  # one for all frames
    frames = [frame.quantize(palette=palette, dither=0) for frame in frames]
    durations = [350 if t < 10 else 110 for t in range(STEPS - 1)] + [2500]  # milliseconds
    frames[0].save(output, save_all=True, append_images=frames[1:], duration=durations, loop=0, optimize=True)
    print(output, [frames[-1][3] for frames in played])


if __name__ == "__main__":
    tyro.cli(main)
