"""Draws ``sky.exr``, and ``target.exr``: the material of ``truth.json`` in the light of that sky, by Mitsuba 3.

    python data/sky/draw.py

Needs Mitsuba and OpenImageIO from PyPI. No part of the toolkit takes part in it.
"""

import sys
from pathlib import Path

import numpy as np

HERE = Path(__file__).resolve().parent
TOWARDS_SUN = np.array([0.5, 0.6, 0.62])


def sky(height: int, width: int) -> np.ndarray:
    """A blue gradient over dark ground, and a hazy sun; y is up, the middle of the map is seen along +z."""
    down = np.pi * (np.arange(height)[:, None] + 0.5) / height
    turn = 2 * np.pi * (np.arange(width) + 0.5) / width
    up = np.cos(down) + 0 * turn
    to_sun = TOWARDS_SUN / np.linalg.norm(TOWARDS_SUN)
    cosine = np.sin(down) * (to_sun[0] * np.sin(turn) - to_sun[2] * np.cos(turn)) + to_sun[1] * up
    above = 1 / (1 + np.exp(-8 * up))
    blue = (0.4 + 0.3 * up)[..., None] * np.array([0.5, 0.7, 1.0])
    ground = np.array([0.12, 0.1, 0.08])
    sun = 12 * np.exp(60 * (cosine - 1))[..., None] * np.array([1.0, 0.9, 0.75])
    return ground + (above[..., None] * (blue - ground)) + sun


if __name__ == "__main__":
    sys.path.insert(0, str(HERE.parent))
    from drawing.draw_folder import draw_folder, write_half

    write_half(HERE / "sky.exr", sky(128, 256))
    draw_folder(HERE, spp=1024)
