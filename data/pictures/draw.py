"""Draws the pictures of the README, through the front door alone.

    python data/pictures/draw.py        # a minute; writes beside itself

``comparison.png`` is what ``brdf fit data/gold-ball --plot`` draws, ``presets.png`` the classic material table,
``plausibility.png`` what ``brdf check --plot`` draws of its ruby.
"""

from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.figure import Figure

import brdf
import fitting
from brdf.display import lit_sphere

HERE = Path(__file__).resolve().parent
DPI = 110


def comparison() -> Figure:
    """Target, fit, residual, highlight, scanline and profile of the bundled golden ball."""
    folder = HERE.parent / "gold-ball"
    target, scene = brdf.read_picture(folder / "target.exr"), brdf.Scene.load(folder / "scene.toml")
    return fitting.fit(target, scene).plot()


def presets() -> Figure:
    """The 24 materials of the classic table."""
    with matplotlib.rc_context({"font.size": 7}):
        figure = Figure(figsize=(7.2, 3.5), layout="constrained")
        for axes, name in zip(np.ravel(figure.subplots(3, 8)), brdf.PRESETS, strict=True):
            axes.imshow(lit_sphere(brdf.preset(name), 96))
            axes.set_title(name.replace("_", " "), pad=2)
            axes.set_axis_off()
    return figure


def plausibility() -> Figure:
    """The classic ruby: sphere, lobe, albedo and reciprocity."""
    ruby = brdf.preset("ruby")
    return fitting.overview(ruby, brdf.check(ruby, name="ruby"))


def main() -> None:
    """Draws and writes them."""
    for draw in (comparison, presets, plausibility):
        path = HERE / f"{draw.__name__}.png"
        draw().savefig(path, dpi=DPI)
        print(f"{path.name}: {path.stat().st_size // 1024} kB")


if __name__ == "__main__":
    main()
