"""Many fits in one call against as many calls of one fit: time a fit, and how far the numbers differ.

Usage: python -m benchmarks.many [--count 64] [--size 64] [--repeats 9]

Both are timed in turn, compiled; the medians and their ratio are printed, and processor time beside them, which a
loaded machine changes less. Differences are relative, those of n in its standard errors too.
"""

import argparse
import os
import time
from collections.abc import Callable

import numpy as np

import brdf
import fitting
from benchmarks.calibration import ball

NOISE = 0.01
LOOPED = 8


def pictures_of(scenes: list[brdf.Scene], seed: int = 0) -> np.ndarray:
    """A picture of a random material in each scene, with noise."""
    rng = np.random.default_rng(seed)
    found = []
    for scene in scenes:
        k = rng.uniform([[0.05], [0.1], [0.1]], [[0.3], [0.6], [0.6]], (3, 3))
        material = brdf.BlinnPhong(k_a=k[0], k_d=k[1], k_s=k[2], n=float(np.exp(rng.uniform(1, 6))))
        clean = np.asarray(brdf.render(material, scene, precision="float64"))
        found.append(clean + NOISE * rng.standard_normal(clean.shape))
    return np.stack(found)


def milliseconds(run: Callable[[], object]) -> np.ndarray:
    """Wall time and processor time."""
    start = np.array([time.perf_counter(), time.process_time()])
    run()
    return 1e3 * (np.array([time.perf_counter(), time.process_time()]) - start)


def main() -> None:
    """Print times and differences."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=64)
    parser.add_argument("--size", type=int, default=64)
    parser.add_argument("--repeats", type=int, default=9)
    given = parser.parse_args()
    scene = ball(given.size)
    light = scene.lights[0]
    turned = [
        brdf.DirectionalLight(direction=np.add(light.direction, [0.01 * i, 0, 0]), intensity=light.intensity)
        for i in range(given.count)
    ]
    own = [brdf.Scene(camera=scene.camera, shapes=scene.shapes, ambient=scene.ambient, lights=[one]) for one in turned]
    print(f"{given.count} pictures of {given.size}², load {os.getloadavg()[0]:.1f} on {os.cpu_count()} processors")
    for name, scenes in (("one scene", [scene] * given.count), ("scenes of their own", own)):
        exact = pictures_of(scenes)
        for precision in ("float32", "float64"):
            pictures = exact.astype(precision)

            def together(pictures=pictures, scenes=scenes, precision=precision) -> fitting.ManyFits:
                return fitting.fit_many(pictures, scenes, model="blinn-phong", precision=precision)

            def one_by_one(pictures=pictures, scenes=scenes, precision=precision) -> list[fitting.FitResult]:
                some = list(zip(pictures, scenes, strict=True))[:LOOPED]
                return [fitting.fit(*one, model="blinn-phong", precision=precision) for one in some]

            fits, single = together(), one_by_one()
            times = np.array(
                [
                    [milliseconds(together) / given.count, milliseconds(one_by_one) / LOOPED]
                    for _ in range(given.repeats)
                ]
            )
            (wall, used), (looped, _) = np.median(times, axis=0)
            n = np.array([float(one.optimum.n) for one in single])
            relative = np.abs(fits.n[:LOOPED] / n - 1)
            for key in ("k_a", "k_d", "k_s"):
                values = np.array([getattr(one.material, key) for one in single])
                relative = np.maximum(relative, np.max(np.abs(getattr(fits, key)[:LOOPED] / values - 1), axis=1))
            deviations = np.max(np.abs(fits.n[:LOOPED] - n) / fits.errors["n"][:LOOPED])
            print(
                f"{name:<20} {precision}: {wall:6.3f} ms a fit (best {times[:, 0, 0].min():.3f}, "
                f"processor {used:.3f}), "
                f"fit by fit {looped:5.1f} ms, {looped / wall:4.0f} times; "
                f"differ by {relative.max():.1e}, n by {deviations:.1e} errors"
            )


if __name__ == "__main__":
    main()
