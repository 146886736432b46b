"""Is the simplest adequate model the true one? Scenes with known truth, noise of 0.5 to 3 % of the brightest value.

Usage: python -m benchmarks.selection [--count 500] [--size 128] [--seed 0] [--lambert-only] [--optimism]

A fifth of the scenes shows ambient light alone or none of it reflected, two fifths Lambert, two fifths Phong and
Blinn-Phong (k_s 0.1 .. 0.8, n 3 .. 300), each under one or two directional or point lights. ``--lambert-only`` counts
invented highlights over as many Lambert scenes. ``--optimism`` measures by how many noise variances the best of all
highlights lowers the cost of a Lambert scene, one channel: what `fitting.selection.SEARCHED` stands for.
"""

import argparse
from collections import Counter

import equinox as eqx
import numpy as np

import brdf
import fitting
from brdf.lights.base import Light

FAMILIES = ("ambient", "lambert", "lambert", "phong", "blinn-phong")


def problem(family: str, random: np.random.Generator, size: int) -> tuple[brdf.Material, brdf.Scene]:
    """A random material of a family and a scene to show it.

    Args:
        family: "ambient", "lambert", "phong" or "blinn-phong".
        random: where the numbers come from.
        size: of the picture in pixels.
    """
    with_ambient = family == "ambient" or random.random() < 0.7
    k = {"k_a": random.uniform(0.2, 0.6, 3) * with_ambient, "k_d": random.uniform(0.1, 1, 3) * (family != "ambient")}
    if family in ("phong", "blinn-phong"):
        shade = random.uniform(0.5, 1, 3) if random.random() < 0.5 else np.ones(3)
        k |= {"k_s": random.uniform(0.1, 0.8) * shade, "n": np.exp(random.uniform(np.log(3), np.log(300)))}
    lights = []
    for _ in range(random.integers(1, 3)):
        direction = random.standard_normal(3) * [0.6, 0.6, 0.2] + [0, 0, 1.0]
        direction[2] = max(direction[2], 0.4)
        if random.random() < 0.5:
            lights.append(brdf.DirectionalLight(direction=direction, intensity=[random.uniform(0.5, 1)] * 3))
        else:
            position = 3 * direction / np.linalg.norm(direction)
            lights.append(brdf.PointLight(position=position, intensity=[9 * random.uniform(0.5, 1)] * 3))
    scene = brdf.Scene(
        camera=brdf.OrthographicCamera(
            position=(0, 0, 4), target=(0, 0, 0), up=(0, 1, 0), width=2.2, resolution=(size, size)
        ),
        shapes=(brdf.Sphere(center=(0, 0, 0), radius=1.0),),
        ambient=[0.3, 0.3, 0.3],
        lights=lights,
    )
    model = brdf.MODELS[family if family in brdf.MODELS else "lambert"]
    return model(**k), scene  # pyright: ignore[reportCallIssue]


def named(result: fitting.FitResult) -> str:
    """The family that a fit chose.

    Args:
        result: with its candidates.
    """
    return next(candidate.model for candidate in result.candidates if candidate.chosen)


def optimism(count: int, size: int) -> None:
    """Print what the best highlight gains where there is none.

    Args:
        count: of Lambert scenes.
        size: of the picture in pixels.
    """
    gains = []
    for seed in range(count):
        random = np.random.default_rng([2, seed])
        truth, scene = problem("lambert", random, size)
        picture = np.asarray(brdf.render(truth, scene, precision="float64"))[..., :1]
        picture = picture + 0.02 * random.standard_normal(picture.shape)
        scene = brdf.Scene(
            camera=scene.camera,
            shapes=scene.shapes,
            ambient=[0.3],
            lights=_grey(scene),
        )
        best, plain = (
            float(np.sum(fitting.fit(picture, scene, model=model, precision="float64", saturation=np.inf).optimum.cost))
            for model in ("blinn-phong", "lambert")
        )
        gains.append((plain - best) / 0.02**2)
    print(f"highlights fitted to {count} Lambert scenes lower the cost by {np.mean(gains):.2f} noise variances")
    print(f"in the mean, 99 % by less than {np.quantile(gains, 0.99):.1f}; two unknowns of any other kind by 2")


def _grey(scene: brdf.Scene) -> list[Light]:
    """The same lights with one channel."""
    return [eqx.tree_at(lambda one: one.emittance, light, np.asarray(light.emittance)[:1]) for light in scene.lights]


def main() -> None:
    """Print a table of truth and choice."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=500)
    parser.add_argument("--size", type=int, default=128)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--lambert-only", action="store_true")
    parser.add_argument("--optimism", action="store_true")
    given = parser.parse_args()
    if given.optimism:
        optimism(given.count, given.size)
        return
    table, by_bic = Counter(), 0
    for index in range(given.count):
        random = np.random.default_rng([given.seed, index])
        family = "lambert" if given.lambert_only else FAMILIES[index % len(FAMILIES)]
        truth, scene = problem(family, random, given.size)
        clean = np.asarray(brdf.render(truth, scene, precision="float32"))
        noise = random.uniform(0.005, 0.03)
        noisy = clean + (noise * clean.max() * random.standard_normal(clean.shape)).astype(np.float32)
        result = fitting.fit(noisy, scene, saturation=np.inf)
        found = named(result)
        table[family, found] += 1
        by_bic += min(result.candidates, key=lambda candidate: candidate.bic).model == family
        if found != family:
            print(f"  {index}: {truth}, noise {100 * noise:.1f} %, is called {found}; {result.warnings}")
    right = sum(count for (truth, found), count in table.items() if truth == found)
    lamberts = sum(count for (truth, _), count in table.items() if truth == "lambert")
    invented = sum(count for (truth, found), count in table.items() if truth == "lambert" and "phong" in found)
    for (truth, found), count in sorted(table.items()):
        print(f"{truth:<12} called {found:<12} {count:4d}")
    print(f"right: {right} of {given.count} ({100 * right / given.count:.1f} %); by BIC alone {by_bic}")
    if lamberts:
        print(f"highlights invented: {invented} of {lamberts} Lambert scenes ({100 * invented / lamberts:.1f} %)")


if __name__ == "__main__":
    main()
