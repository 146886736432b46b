"""What a person waits for: the command and the fit, as ratios within one run.

    python -m benchmarks.felt            # all rows; or some of: command fit codes lights accuracy

| row | over |
| --- | --- |
| the command, second run, whole process | the import of jax, optimistix and OpenImageIO, whole process |
| `fitting.fit`, compiled, float arrays with 1 % noise | a pass over the pixels that count (`benchmarks.engine`) |
| the same from 8-bit sRGB, without noise and with noise of a code | the same pass |
| area light and sky, default, 512² | the same pass; and seconds |
| `accuracy=1e-2` at 3 % noise | the default's time |

Wall time and, in brackets, processor time, which other programs disturb less; medians of pairs timed in turn.
"""

import argparse
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

import brdf
import fitting
from benchmarks.calibration import ball
from benchmarks.engine import observe, one_pass
from benchmarks.front_door import MATERIAL
from benchmarks.tradeoff_fronts import write as write_scenes
from brdf.images.encoding import encode
from brdf.precision import Precision

IMPORTS = "import jax, optimistix, OpenImageIO"
COMMAND = "from fitting.cli.main import run; run()"
TARGETS = {
    "fit": ["fit", "data/gold-ball", "--out", "OUT"],
    "check": ["check", "OUT/material.json"],
    "convert": ["convert", "OUT/material.json", "OUT/three.json", "--to", "three"],
    "render": ["render", "OUT/material.json", "--scene", "data/gold-ball/scene.toml", "-o", "OUT/again.exr"],
}


def timed(run: Callable[[], Any], who: int = resource.RUSAGE_SELF) -> tuple[float, float]:
    """Wall and processor seconds of a call, of this process or of its children."""

    def spent() -> float:
        used = resource.getrusage(who)
        return used.ru_utime + used.ru_stime

    start, before = time.perf_counter(), spent()
    run()
    return time.perf_counter() - start, spent() - before


def ratio(unit: Callable[[], Any], run: Callable[[], Any], pairs: int, who: int = resource.RUSAGE_SELF) -> np.ndarray:
    """Medians of both over that of the unit, wall and processor; and the wall seconds of both, (2, 2)."""
    times = np.array([[timed(unit, who), timed(run, who)] for _ in range(pairs)])
    one, other = np.median(times, axis=0)
    return np.stack([other / one, [one[0], other[0]]])


def told(row: str, found: np.ndarray) -> None:
    """Print a row."""
    (wall, processor), (one, other) = found
    print(f"{row:64} {wall:6.2f} ({processor:.2f})   {other:.3g} s over {one:.3g} s", flush=True)


def command(pairs: int) -> None:
    """The command's second run, and its first with an empty cache, over the imports."""

    def python(code: str, *arguments: str, cache: str) -> None:
        environment = os.environ | {"XDG_CACHE_HOME": cache}
        for name in ("JAX_COMPILATION_CACHE_DIR", "PYTHONDONTWRITEBYTECODE"):
            environment.pop(name, None)
        called = [sys.executable, "-c", code, *arguments]
        subprocess.run(called, env=environment, check=False, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)

    with tempfile.TemporaryDirectory() as folder:
        for name, words in TARGETS.items():
            words = [word.replace("OUT", folder) for word in words]

            unit = partial(python, IMPORTS, cache=folder)
            run = partial(python, COMMAND, *words, cache=folder)
            if name == "fit":
                first = timed(partial(run, cache=f"{folder}/empty"), resource.RUSAGE_CHILDREN)
                alone = timed(unit, resource.RUSAGE_CHILDREN)
                told("brdf fit, first run", np.array([np.divide(first, alone), [alone[0], first[0]]]))
            run()
            told(f"brdf {name}, second run", ratio(unit, run, pairs, resource.RUSAGE_CHILDREN))


def noisy(scene: brdf.Scene, precision: Precision, noise: float) -> np.ndarray:
    """The picture of a scene, with noise in parts of 1."""
    image = np.asarray(brdf.render(MATERIAL, scene, precision=precision))
    return image + (noise * np.random.default_rng(0).standard_normal(image.shape)).astype(image.dtype)


def counted_pass(scene: brdf.Scene) -> Callable[[], Any]:
    """A pass over as many pixels as count in a scene."""
    count = int(np.sum(np.asarray(scene.surface_points().mask)))
    arrays = [values[:count] for values in observe(int(np.ceil(count**0.5)), 0.01)]
    return lambda: one_pass(*arrays)


def fit(pairs: int, sizes: tuple[int, ...] = (128, 512, 2048)) -> None:
    """`fitting.fit` of a named model and of auto, in passes."""
    for size in sizes:
        scene = ball(size)
        unit = counted_pass(scene)
        for precision in ("float32", "float64"):
            image = noisy(scene, precision, 0.01)
            for model in ("blinn-phong", "auto"):
                run = partial(fitting.fit, image, scene, model=model, precision=precision)
                run()
                told(f"fitting.fit, {size}², {precision}, {model}", ratio(unit, run, pairs))


def codes(pairs: int, size: int = 512) -> None:
    """`fitting.fit` of an 8-bit sRGB picture, in passes."""
    scene = ball(size)
    image = np.asarray(brdf.render(MATERIAL, scene, precision="float64"))
    shown = 255 * np.asarray(encode(0.97 * image / image.max(), "srgb"))
    unit = counted_pass(scene)
    for noise in (0, 1):
        drawn = np.rint(shown + noise * np.random.default_rng(0).standard_normal(shown.shape))
        picture = np.clip(drawn, 0, 255).astype(np.uint8)
        for model in ("blinn-phong", "auto"):
            run = partial(fitting.fit, picture, scene, model=model, encoding="srgb")
            run()
            told(f"fitting.fit, {size}², 8-bit sRGB, noise of {noise} codes, {model}", ratio(unit, run, pairs))


def lights(pairs: int) -> None:
    """The area light and the sky of README's table."""
    with tempfile.TemporaryDirectory() as folder:
        write_scenes(Path(folder))
        for name in ("area", "environment"):
            image = brdf.read_image(f"{folder}/{name}/target.exr")
            scene = brdf.Scene.load(f"{folder}/{name}/scene.toml")
            run = partial(fitting.fit, image, scene, model="blinn-phong")
            run()
            told(f"fitting.fit, {name} at 512², default", ratio(counted_pass(scene), run, min(pairs, 3)))


def accuracy(pairs: int) -> None:
    """`accuracy=1e-2` over the default."""
    for size in (512, 2048):
        scene = ball(size)
        for noise in (0.02, 0.03, 0.04):
            image = noisy(scene, "float32", noise)
            default = partial(fitting.fit, image, scene, model="blinn-phong")
            quick = partial(default, accuracy=1e-2)
            default()
            quick()
            told(f"accuracy=1e-2 over the default, {size}², {100 * noise:.0f} % noise", ratio(default, quick, pairs))


ROWS = {"command": command, "fit": fit, "codes": codes, "lights": lights, "accuracy": accuracy}


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("rows", nargs="*", choices=[*ROWS, []], help="which; all by default")
    parser.add_argument("--pairs", type=int, default=9)
    options = parser.parse_args()
    load = Path("/proc/loadavg")
    print(f"load {load.read_text().split()[0] if load.exists() else 'unknown'} on {os.cpu_count()} processors")
    for name in options.rows or ROWS:
        ROWS[name](options.pairs)


if __name__ == "__main__":
    sys.exit(main())
