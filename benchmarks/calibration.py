"""Do the 95 % intervals cover the truth in 95 % of draws? Pictures of four materials with fresh noise each time.

Usage: python -m benchmarks.calibration [--draws 1000] [--size 64] [--json FILE]

Printed for each material: the share of draws in which the interval of each k and of n holds the true value, the share
with n not determined, and the size of the error stated beside that seen. The last two materials have k_a = 0, at its
bound; there the interval is one-sided, and covers as often as the others (Feldman and Cousins 1998).
"""

import argparse
import json
from collections import defaultdict
from pathlib import Path

import numpy as np

import brdf
import fitting

NOISE = 0.02
MATERIALS = {
    "satin": brdf.BlinnPhong(k_a=[0.3, 0.2, 0.1], k_d=[0.5, 0.4, 0.3], k_s=[0.3, 0.4, 0.5], n=8.0),
    "gloss": brdf.BlinnPhong(k_a=[0.2, 0.2, 0.2], k_d=[0.6, 0.1, 0.3], k_s=[0.5, 0.5, 0.4], n=60.0),
    "sharp, k_a = 0": brdf.BlinnPhong(k_a=[0.0, 0.0, 0.0], k_d=[0.4, 0.3, 0.2], k_s=[0.8, 0.6, 0.7], n=400.0),
    "satin, k_a = 0": brdf.BlinnPhong(k_a=[0.0, 0.0, 0.0], k_d=[0.5, 0.4, 0.3], k_s=[0.3, 0.4, 0.5], n=8.0),
}


def ball(size: int) -> brdf.Scene:
    """A ball under one directional light.

    Args:
        size: of the picture in pixels.
    """
    return brdf.Scene(
        camera=brdf.OrthographicCamera(
            position=(0, 0, 4), target=(0, 0, 0), up=(0, 1, 0), width=2.2, resolution=(size, size)
        ),
        shapes=(brdf.Sphere(center=(0, 0, 0), radius=1.0),),
        ambient=[0.2, 0.2, 0.2],
        lights=(brdf.DirectionalLight(direction=(0.5, 0.6, 0.7), intensity=[1.0, 1.0, 1.0]),),
    )


def coverage(material: brdf.Material, draws: int, size: int, seed: int) -> dict[str, dict[str, float]]:
    """How often the intervals cover.

    Args:
        material: the truth, a model with a highlight.
        draws: of the noise.
        size: of the picture in pixels.
        seed: of the noise.
    """
    scene = ball(size)
    clean = np.asarray(brdf.render(material, scene, precision="float64"))
    random = np.random.default_rng(seed)
    inside, values, errors = defaultdict(list), defaultdict(list), defaultdict(list)
    for _ in range(draws):
        noisy = clean + NOISE * random.standard_normal(clean.shape)
        # Told that nothing is clipped: the largest value of a noisy picture is no plateau.
        result = fitting.fit(noisy, scene, model=material.name, precision="float64", saturation=np.inf)
        for one in result.parameters:
            key = one.name if one.channel is None else f"{one.name}[{one.channel}]"
            truth = np.asarray(getattr(material, one.name)).reshape(-1)[one.channel or 0]
            inside[key].append(one.interval is not None and one.interval[0] <= truth <= one.interval[1])
            if one.value is not None:
                values[key].append(one.value)
                errors[key].append(one.error)
    return {
        key: {
            "covered": float(np.mean(inside[key])),
            "determined": len(values[key]) / draws,
            "stated": float(np.median(errors[key])),
            "seen": float(np.std(values[key])),
        }
        for key in inside
    }


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--draws", type=int, default=1000)
    parser.add_argument("--size", type=int, default=64)
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    table = {}
    for index, (name, material) in enumerate(MATERIALS.items()):
        table[name] = coverage(material, given.draws, given.size, seed=index)
        print(f"{name}, n = {float(material.n):g}, noise {NOISE:g}, {given.size}² pixels, {given.draws} draws")
        for key, row in table[name].items():
            print(
                f"  {key:<7} covered {100 * row['covered']:5.1f} %   determined {100 * row['determined']:5.1f} %   "
                f"error stated {row['stated']:.3g}, seen {row['seen']:.3g}"
            )
    shares = [row["covered"] for rows in table.values() for row in rows.values()]
    print(f"all intervals: {100 * min(shares):.1f} to {100 * max(shares):.1f} %")
    if given.json:
        given.json.write_text(json.dumps(table, indent=2) + "\n")


if __name__ == "__main__":
    main()
