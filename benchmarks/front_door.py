"""What a whole fit costs, in passes: geometry, choice of pixels, search, error bars, structure of the residual.

Usage: python -m benchmarks.front_door [--size 512] [--repeats 15] [--parts]

A pass is that of `benchmarks.engine`. Both are timed in turn, and the ratio of the medians is printed.
"""

import argparse
import cProfile
import pstats

import numpy as np

import brdf
import fitting
from benchmarks.calibration import ball
from benchmarks.engine import prepare, seconds
from brdf.precision import Precision

MATERIAL = brdf.BlinnPhong(k_a=[0.1, 0.2, 0.3], k_d=[0.5, 0.4, 0.3], k_s=[0.3, 0.35, 0.4], n=50.0)
NOISE = 0.01


def main() -> None:
    """Print the ratios."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--size", type=int, default=512)
    parser.add_argument("--repeats", type=int, default=15)
    parser.add_argument("--parts", action="store_true", help="also print where the time goes")
    given = parser.parse_args()
    _, one_pass = prepare(given.size, NOISE, np.float64)
    scene = ball(given.size)
    for precision in ("float32", "float64"):
        image = np.asarray(brdf.render(MATERIAL, scene, precision=precision))
        image = image + (NOISE * np.random.default_rng(0).standard_normal(image.shape)).astype(image.dtype)
        for model in ("blinn-phong", "auto"):

            def fit(image: np.ndarray = image, model: str = model, precision: Precision = precision) -> None:
                fitting.fit(image, scene, model=model, precision=precision)

            fit()
            times = np.array([[seconds(one_pass), seconds(fit)] for _ in range(given.repeats)])
            one, whole = np.median(times, axis=0)
            print(
                f"{given.size}², {precision}, {model:<12} {whole / one:5.1f} passes   "
                f"(best of each {times[:, 1].min() / times[:, 0].min():.1f}; a pass takes {1e3 * one:.2f} ms)"
            )
            if given.parts:
                profile = cProfile.Profile()
                profile.runcall(fit)
                pstats.Stats(profile).sort_stats("cumtime").print_stats("fitting|brdf", 30)


if __name__ == "__main__":
    main()
