"""Draws ``target.exr`` of this folder: the material of ``truth.json`` in the light of ``scene.toml``, by Mitsuba 3.

    python data/area-light/draw.py

Needs Mitsuba and OpenImageIO from PyPI. No part of the toolkit takes part in it.
"""

import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent

if __name__ == "__main__":
    sys.path.insert(0, str(HERE.parent))
    from drawing.draw_folder import draw_folder

    draw_folder(HERE, spp=256)
