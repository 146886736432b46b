"""What an accuracy of 1e-2 saves on a picture of 4096 x 4096 pixels under one light.

``python -m benchmarks.tradeoff_large [SIZE]`` prints the time of the full fit and of that to the accuracy, in turns,
both compiled before, and the error of the latter against the former.
"""

import sys
import time

import numpy as np

import brdf
import fitting
from benchmarks.tradeoff import camera, material, scene
from fitting.budget.deviation import parameter_deviation

ROUNDS, ACCURACY, NOISE = 5, 1e-2, 0.01


def main(size=4096):
    """Measure and print."""
    place = scene(look=camera(size))
    picture = np.array(brdf.render(material(), place), np.float32)
    deviation = np.float32(NOISE * picture.mean())
    picture += deviation * np.random.default_rng(0).standard_normal(picture.shape, np.float32)
    jobs = {
        "full": lambda: fitting.fit(picture, place, model="blinn-phong"),
        "accuracy": lambda: fitting.fit(picture, place, model="blinn-phong", accuracy=ACCURACY),
    }
    times = {name: [] for name in jobs}
    results = {name: job() for name, job in jobs.items()}
    for _ in range(ROUNDS):
        for name, job in jobs.items():
            start = time.perf_counter()
            job()
            times[name].append(time.perf_counter() - start)
    full, quick = (np.median(times[name]) for name in jobs)
    off = parameter_deviation(results["accuracy"], results["full"])
    choice = results["accuracy"].choice
    print(f"{size} x {size}: full fit {full:.3f} s, accuracy {ACCURACY:g} {1e3 * quick:.1f} ms, 1/{full / quick:.0f}")
    print(f"error {off:.1e}, estimate {choice.chosen.error:.1e}, {choice.chosen.configuration}")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
