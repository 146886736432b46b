"""Draws the target of an example folder with Mitsuba: its material in the light of its scene."""

import json
import tomllib
from pathlib import Path

import numpy as np
import OpenImageIO

__all__ = ["draw_folder", "write_half"]


def write_half(path: Path, picture: np.ndarray) -> None:
    """Writes a half-float OpenEXR file."""
    height, width, channels = picture.shape
    spec = OpenImageIO.ImageSpec(width, height, channels, "half")
    spec.attribute("compression", "zip")
    output = OpenImageIO.ImageOutput.create(str(path))
    pixels = np.ascontiguousarray(picture, np.float32)
    if not (output and output.open(str(path), spec) and output.write_image(pixels) and output.close()):
        raise SystemExit(f"{path}: {output.geterror() if output else OpenImageIO.geterror()}")
    print(f"{path}: {width} x {height}, brightest {picture.max():.4f}, {path.stat().st_size} bytes")


def draw_folder(folder: Path, spp: int) -> None:
    """Draws and writes ``target.exr``.

    Args:
        folder: With ``scene.toml`` and ``truth.json``; files the scene names lie in it.
        spp: Samples per pixel and light, a square number.
    """
    from drawing.mitsuba_scene import render

    scene = tomllib.loads((folder / "scene.toml").read_text(encoding="utf-8"))
    for table in scene["lights"] + scene["shapes"]:
        if "file" in table:
            table["file"] = str(folder / table["file"])
    material = json.loads((folder / "truth.json").read_text(encoding="utf-8"))
    write_half(folder / "target.exr", render(scene, material, spp=spp))
