"""Render random materials in float64 and fit them: does every number come back, or is it said not to be determined?

Usage: python -m benchmarks.round_trip [--count 200] [--size 256] [--models phong ...] [--seed 0]

200 materials of each of Phong, Blinn-Phong and Lambert, n log-uniform in 0.5 .. 1e5, k_s down to 0, one or two lights,
with and without ambient light. A value is wrong if n is off by more than 0.1 %, or a k by more than 1e-4; a value is
also wrong if it is told although it leaves no trace in the picture (a specular term below 1e-6 of the brightest pixel,
an ambient term without ambient light).
"""

import argparse
from collections import Counter

import numpy as np

import brdf
import fitting
from brdf.models.base import SpecularMaterial

MODELS = ("lambert", "phong", "blinn-phong")
NO_TRACE = 1e-6


def problem(model: str, random: np.random.Generator, size: int) -> tuple[brdf.Material, brdf.Scene]:
    """A random material and scene.

    Args:
        model: name of the material's model.
        random: where the numbers come from.
        size: of the picture in pixels.
    """
    k = {"k_a": random.uniform(0, 0.5, 3), "k_d": random.uniform(0, 1, 3)}
    if model != "lambert":
        strength = 0.0 if random.random() < 0.05 else 10 ** random.uniform(-3, 0)
        k |= {"k_s": strength * random.uniform(0.2, 1, 3), "n": 10 ** random.uniform(np.log10(0.5), 5)}
    lights = []
    for _ in range(random.integers(1, 3)):
        direction = random.standard_normal(3) * [0.7, 0.7, 0.3] + [0, 0, 1.0]
        direction[2] = max(direction[2], 0.2)
        if random.random() < 0.5:
            lights.append(brdf.DirectionalLight(direction=direction, intensity=random.uniform(0.3, 1.5, 3)))
        else:
            position = 3 * direction / np.linalg.norm(direction)
            lights.append(brdf.PointLight(position=position, intensity=9 * random.uniform(0.3, 1.5, 3)))
    scene = brdf.Scene(
        camera=brdf.OrthographicCamera(
            position=(0, 0, 4), target=(0, 0, 0), up=(0, 1, 0), width=2.2, resolution=(size, size)
        ),
        shapes=(brdf.Sphere(center=(0, 0, 0), radius=1.0),),
        ambient=None if random.random() < 0.2 else random.uniform(0.05, 0.5, 3),
        lights=lights,
    )
    return brdf.MODELS[model](**k), scene  # pyright: ignore[reportCallIssue]


def complaints(result: fitting.FitResult, truth: brdf.Material, scene: brdf.Scene) -> list[str]:
    """What is wrong with a result.

    Args:
        result: of a fit to the noise-free picture.
        truth: the material in it.
        scene: the scene of it.
    """
    specular = isinstance(truth, SpecularMaterial)
    share = 0.0
    if specular:
        alone = type(truth)(k_a=0.0, k_d=0.0, k_s=truth.k_s, n=truth.n)
        whole = np.asarray(brdf.render(truth, scene, precision="float64"))
        share = float(np.max(np.asarray(brdf.render(alone, scene, precision="float64"))) / np.max(whole))
    found = []
    for one in result.parameters:
        name = one.name if one.channel is None else f"{one.name}[{one.channel}]"
        true = np.asarray(getattr(truth, one.name)).reshape(-1)[one.channel or 0]
        silent = share < NO_TRACE if one.name in ("k_s", "n") else one.name == "k_a" and scene.ambient is None
        if one.value is None:
            # Near the limit either is right.
            clear = one.name == "k_d" or (one.name == "k_a" and scene.ambient is not None)
            if clear or (one.name in ("k_s", "n") and share > 100 * NO_TRACE):
                found.append(f"{name} = {true:.4g} is not told: {one.reason} (specular share {share:.2g})")
        elif silent:
            found.append(f"{name} is told, {one.value:.4g}, though it leaves no trace (share {share:.2g})")
        elif one.name == "n" and abs(one.value / true - 1) > 1e-3:
            found.append(f"n = {true:.6g} is told as {one.value:.6g} ± {one.error:.2g} (share {share:.2g})")
        elif one.name != "n" and abs(one.value - true) > 1e-4:
            found.append(f"{name} = {true:.6g} is told as {one.value:.6g} ± {one.error:.2g} (share {share:.2g})")
    return found


def main() -> None:
    """Print what came out wrong, and how many."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--size", type=int, default=256)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--models", nargs="+", default=MODELS)
    given = parser.parse_args()
    for model in given.models:
        random = np.random.default_rng([given.seed, MODELS.index(model)])
        wrong, told, worst = 0, Counter(), 0.0
        for index in range(given.count):
            truth, scene = problem(model, random, given.size)
            picture = np.asarray(brdf.render(truth, scene, precision="float64"))
            result = fitting.fit(picture, scene, model=model, precision="float64")
            found = complaints(result, truth, scene)
            wrong += bool(found)
            for text in found:
                print(f"  {model} {index}: {text}")
            for one in result.parameters:
                told[one.name, one.value is not None] += 1
                if one.name == "n" and one.value is not None:
                    worst = max(worst, abs(one.value / float(truth.n) - 1))
        open_ = {name: told[name, False] for name, _ in told}
        print(f"{model}: {given.count - wrong} of {given.count} right; worst n off by {worst:.1e}; not told: {open_}")


if __name__ == "__main__":
    main()
