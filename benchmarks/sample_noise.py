"""How far noise puts a fit of a sample of the pixels off: `SPREAD` of `fitting.budget.escalation`.

``python -m benchmarks.sample_noise [SCENES]`` draws balls under one to three lights with random materials, shiny and
matt ones, fits a sample of each, and prints the median and the quartiles of its error (95 %, of the worst parameter),
times the root of its number of pixels, over noise over the picture's root mean square.
"""

import sys

import numpy as np

import brdf
from benchmarks.tradeoff import scene
from fitting.budget.configurations import Configuration, run
from fitting.budget.error_estimate import estimate
from fitting.budget.escalation import FIRST_PIXELS, noise_and_size
from fitting.problem import state_problem


def drawn(random: np.random.Generator, *, shiny: bool) -> tuple[brdf.Scene, brdf.Material]:
    """A scene and a material."""
    lights = []
    for _ in range(random.integers(1, 4)):
        direction = random.standard_normal(3)
        direction[2] = abs(direction[2]) + 0.3
        lights.append(brdf.DirectionalLight(direction=direction, intensity=random.uniform(0.2, 1.0, 3)))
    k_a, k_d, k_s = random.uniform(0.1, 0.5, 3), random.uniform(0.1, 0.9, 3), random.uniform(0.05, 0.6, 3)
    place = scene(*lights)
    if not shiny:
        return place, brdf.Lambert(k_a=k_a, k_d=k_d)
    return place, brdf.BlinnPhong(k_a=k_a, k_d=k_d, k_s=k_s, n=float(10 ** random.uniform(0.6, 3.3)))


def ratio(random: np.random.Generator, *, shiny: bool) -> float:
    """Of one picture."""
    place, material = drawn(random, shiny=shiny)
    clean = np.asarray(brdf.render(material, place))
    noise = 10 ** random.uniform(-2.3, -1.3) * clean.mean()
    picture = (clean + noise * random.standard_normal(clean.shape)).astype(np.float32)
    done = run(state_problem(picture, place), Configuration(material.name, "float32", FIRST_PIXELS), {})
    told = estimate(done, {})
    deviation, size = noise_and_size(picture)
    sample = done.samples[0]
    assert sample is not None
    return told.bound * np.sqrt(sample.pixel.size) * size / deviation


def main() -> None:
    """Print both."""
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 40
    random = np.random.default_rng(0)
    for name, shiny in (("with a highlight", True), ("without", False)):
        found = [ratio(random, shiny=shiny) for _ in range(count)]
        low, middle, high = np.quantile(found, [0.25, 0.5, 0.75])
        print(f"{name}: {middle:.0f} in the median of {count}, quartiles {low:.0f} and {high:.0f}")


if __name__ == "__main__":
    main()
