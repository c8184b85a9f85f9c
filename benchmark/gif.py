"""A small GIF of an evaluation video, for a README: every other frame at half the size, cubes in their colours.

Usage:   python benchmark/gif.py runs/RememberColor3-v0__ppo_aib_small__1/videos/step_00240000.mp4 agent.gif
"""

import sys

import imageio.v3 as iio
import numpy as np
from PIL import Image

COLOURS = [(255, 0, 0), (0, 255, 0), (0, 0, 255), (150, 0, 0), (0, 150, 0), (0, 0, 150)]


def main(video: str, gif: str) -> None:
    """Write the GIF; its palette keeps a place for the cubes, which are too few pixels to get one otherwise."""
    frames = iio.imread(video)[::2, ::2, ::2]
    width = frames.shape[2] // len(COLOURS) + 1
    cubes = np.repeat(np.array(COLOURS, np.uint8), width, 0)[: frames.shape[2]]
    cubes = np.broadcast_to(cubes, frames.shape[1:])
    palette = Image.fromarray(np.concatenate([*frames[::6], cubes])).quantize(128, Image.Quantize.MEDIANCUT)
    images = [Image.fromarray(x).quantize(palette=palette, dither=Image.Dither.NONE) for x in frames]
    images[0].save(gif, save_all=True, append_images=images[1:] + images[-1:] * 8, duration=100, loop=0)


if __name__ == "__main__":
    main(*sys.argv[1:])
