"""Draws ``target.exr`` of this folder: the material of ``truth.json`` in the light of ``scene.toml``, by OpenGL.

    python data/gold-ball/draw.py

Needs PyOpenGL and OpenImageIO from PyPI and libosmesa6 from Debian. No part of the toolkit takes part in it.
"""

import json
import sys
import tomllib
from pathlib import Path

import OpenImageIO

HERE = Path(__file__).resolve().parent


def main() -> None:
    """Draws and writes the picture; refuses one that OpenGL clamped."""
    sys.path.insert(0, str(HERE.parent))
    from drawing.opengl_ball import draw_ball

    scene = tomllib.loads((HERE / "scene.toml").read_text(encoding="utf-8"))
    material = json.loads((HERE / "truth.json").read_text(encoding="utf-8"))
    picture = draw_ball(scene, material)
    if picture.max() >= 1:
        raise SystemExit("OpenGL clamped the picture at 1: lower the light's intensity")
    height, width, channels = picture.shape
    spec = OpenImageIO.ImageSpec(width, height, channels, "half")
    spec.attribute("compression", "zip")
    path = str(HERE / "target.exr")
    output = OpenImageIO.ImageOutput.create(path)
    if not (output and output.open(path, spec) and output.write_image(picture) and output.close()):
        raise SystemExit(f"{path}: {output.geterror() if output else OpenImageIO.geterror()}")
    print(f"{path}: {width} x {height}, brightest {picture.max():.4f}, {Path(path).stat().st_size} bytes")


if __name__ == "__main__":
    main()
