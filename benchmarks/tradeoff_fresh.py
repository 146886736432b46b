"""What `--accuracy` costs and saves in a process that fits one picture and ends, as the command does.

``python -m benchmarks.tradeoff_fresh [SIZE ...]`` fits a ball of SIZE x SIZE pixels in new processes: all pixels, and
to an accuracy of 1e-2 with the choice among the pixels forced. It prints the seconds of each fit with an empty cache of
compiled programs and with a full one: `fitting.budget.budget` has its constants from their differences.
"""

import os
import subprocess
import sys
import tempfile

SIZES, ROUNDS = (320, 1024, 2048, 4096), 3
FIT = """
import sys, time
import numpy as np, brdf, fitting
from benchmarks.tradeoff import camera, material, scene
from fitting.cli.common import use_compilation_cache
size, accuracy = int(sys.argv[1]), float(sys.argv[2]) or None
place = scene(look=camera(size))
use_compilation_cache()
picture = np.array(brdf.render(material(), place), np.float32)
picture += np.float32(0.01 * picture.mean()) * np.random.default_rng(0).standard_normal(picture.shape, np.float32)
start = time.perf_counter()
fitting.fit(picture, place, model="blinn-phong", accuracy=accuracy)
print(time.perf_counter() - start)
"""


def seconds(size, accuracy, cache):
    """Of one fit in a process of its own."""
    command = [sys.executable, "-c", FIT, str(size), str(accuracy)]
    environment = os.environ | {"XDG_CACHE_HOME": cache}
    return float(subprocess.run(command, capture_output=True, text=True, check=True, env=environment).stdout)


def main(sizes):
    """Measure and print."""
    print(f"{'size':>6}{'all, cold':>12}{'all':>8}{'chosen, cold':>14}{'chosen':>8}  seconds")
    for size in sizes:
        found = []
        for accuracy in (0.0, 1e-2):
            with tempfile.TemporaryDirectory() as cache:
                cold = seconds(size, accuracy, cache)
                found += [cold, min(seconds(size, accuracy, cache) for _ in range(ROUNDS))]
        print(f"{size:>6}{found[0]:>12.2f}{found[1]:>8.2f}{found[2]:>14.2f}{found[3]:>8.2f}", flush=True)


if __name__ == "__main__":
    main(list(map(int, sys.argv[1:])) or SIZES)
