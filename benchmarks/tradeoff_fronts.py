"""The measured fronts of three scenes: one directional light, an area light, an environment map.

``python -m benchmarks.tradeoff_fronts FOLDER [SCENE ...]`` writes target and scene of each into a folder, measures,
saves table and plot (those of area light and environment map are kept as ``benchmarks/front_*.png``), and prints as
Markdown what the default takes and what the quickest fit that keeps an accuracy.
``python -m benchmarks.tradeoff_fronts FOLDER PAIRS [SCENE ...]`` runs the command ``brdf tradeoff`` in pairs instead,
each time in a new process, the first of each pair with an empty cache of compiled programs, and says how long it took
and how many pairs named the same recommendation.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

import brdf
import fitting
from benchmarks.tradeoff import material, sky
from fitting.budget.sampling import with_samples

SIZE, NOISE, SECONDS = 512, 0.01, 60.0
SCENES = ("directional", "area", "environment")
LABELS = {"directional": "one directional light", "area": "area light", "environment": "environment map"}
ACCURACIES = (1e-1, 1e-2, 1e-3)
COMMAND = "from fitting.cli.main import run; run()"
SCENE = """
[camera]
type = "orthographic"
position = [0.0, 0.0, 4.0]
target = [0.0, 0.0, 0.0]
up = [0.0, 1.0, 0.0]
width = 2.2
resolution = [{size}, {size}]

[[shapes]]
type = "sphere"
center = [0.0, 0.0, 0.0]
radius = 1.0

[ambient]
intensity = [0.2]

[[lights]]
"""
LIGHTS = {
    "directional": 'type = "directional"\ndirection = [0.5, 0.6, 0.7]\nintensity = [1.0]\n',
    "area": 'type = "rectangle"\ncenter = [2.0, 2.0, 3.0]\nedge_u = [0.0, 0.8, -0.5]\nedge_v = [0.7, 0.0, -0.7]\n'
    "radiance = [3.0]\n",
    "environment": 'type = "environment"\nfile = "sky.exr"\n',
}


def write(folder):
    """Target and scene of each kind of light, with 1 % noise."""
    for name in SCENES:
        place = folder / name
        place.mkdir(parents=True, exist_ok=True)
        if name == "environment":
            brdf.write_image(place / "sky.exr", sky(3).astype(np.float32))
        (place / "scene.toml").write_text(SCENE.format(size=SIZE) + LIGHTS[name])
        if (place / "target.exr").exists():
            continue
        fine = with_samples(brdf.Scene.load(place / "scene.toml"), 4096)
        picture = np.asarray(brdf.render(material(), fine))
        noise = np.random.default_rng(0).standard_normal(picture.shape)
        brdf.write_image(place / "target.exr", (picture + NOISE * picture.mean() * noise).astype(np.float32))


def cell(row):
    """A configuration without what is usual, its time and its error."""
    if row is None:
        return "none measured"
    words = [word for word in row.name.split(", ") if word not in ("blinn-phong", "float32")]
    return f"{', '.join(words)}: {1e3 * row.seconds:.3g} ms, error {row.error:.0e}"


def fronts(folder, names=SCENES):
    """Measure, and print what is on the front."""
    heads = ["scene", "default", *(f"accuracy {accuracy:g}" for accuracy in ACCURACIES)]
    lines = ["| " + " | ".join(heads) + " |", "| --- " * len(heads) + "|"]
    for name in names:
        place = folder / name
        found = fitting.tradeoff(
            brdf.read_image(place / "target.exr"), brdf.Scene.load(place / "scene.toml"), seconds=SECONDS
        )
        found.save(place / "tradeoff")
        print(f"{name}: {found.seconds:.0f} s, {len(found.rows)} of {found.planned} measured", flush=True)
        quickest = [next((row for row in found.front if row.error <= accuracy), None) for accuracy in ACCURACIES]
        lines.append("| " + " | ".join([LABELS[name], *map(cell, (found.default, *quickest))]) + " |")
    print("\n".join(lines))


def recommendation(place, cache):
    """What the command recommends, and the seconds that it took."""
    start = time.perf_counter()
    command = [sys.executable, "-c", COMMAND, "tradeoff", str(place), "--json"]
    environment = os.environ | {"XDG_CACHE_HOME": cache}
    out = subprocess.run(command, capture_output=True, text=True, check=True, env=environment).stdout
    rows = json.loads(out)["rows"]
    named = [row["name"] for row in rows if "recommended" in row["marks"]]
    return (named or ["nothing"])[0], len(rows), time.perf_counter() - start


def pairs(folder, count, names):
    """Run the command again and again."""
    for name in names:
        alike, times = 0, []
        for _ in range(count):
            with tempfile.TemporaryDirectory() as cache:
                cold, warm = (recommendation(folder / name, cache) for _ in range(2))
            alike += cold[0] == warm[0]
            times += [cold[2], warm[2]]
            told = "; ".join(f"{one[0]} ({one[1]} rows, {one[2]:.0f} s)" for one in (cold, warm))
            print(f"{name}: {told}", flush=True)
        print(
            f"{name}: {alike} of {count} pairs alike, {np.median(times):.0f} s, at most {max(times):.0f} s", flush=True
        )


def main(folder, *rest):
    """Write the scenes, then measure."""
    write(Path(folder))
    if rest and rest[0].isdigit():
        pairs(Path(folder), int(rest[0]), rest[1:] or SCENES)
    else:
        fronts(Path(folder), rest or SCENES)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder")
    parser.add_argument("scenes", nargs="*")
    given = parser.parse_args()
    main(given.folder, *given.scenes)
