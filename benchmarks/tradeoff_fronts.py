"""The measured fronts of three scenes: one directional light, an area light, an environment map.

``python -m benchmarks.tradeoff_fronts FOLDER [SCENE ...]`` writes target and scene of each into a folder, measures and
prints the rows of the front, the default and the recommendation, and saves table and plot. ``python -m
benchmarks.tradeoff_fronts FOLDER TRIES [SCENE ...]`` runs the command ``brdf tradeoff`` as often instead, each time in
a new process, and says how long it took and how often it named the same recommendation.
"""

import collections
import json
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

import brdf
import fitting
from benchmarks.tradeoff import material, sky
from fitting.accuracy.lamps import with_samples

SIZE, NOISE, SECONDS = 512, 0.01, 60.0
SCENES = ("directional", "area", "environment")
COMMAND = "from fitting.cli.main import main; main()"
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
        fine = with_samples(brdf.Scene.load(place / "scene.toml"), 1024)
        picture = np.asarray(brdf.render(material(), fine))
        noise = np.random.default_rng(0).standard_normal(picture.shape)
        brdf.write_image(place / "target.exr", (picture + NOISE * picture.mean() * noise).astype(np.float32))


def fronts(folder, names=SCENES):
    """Measure and print what is on the front."""
    for name in names:
        start = time.perf_counter()
        place = folder / name
        found = fitting.tradeoff(
            brdf.read_image(place / "target.exr"), brdf.Scene.load(place / "scene.toml"), seconds=SECONDS
        )
        found.save(place / "tradeoff")
        print(f"{name}: {time.perf_counter() - start:.0f} s, {'all' if found.complete else 'not all'} measured")
        for row in found.rows:
            if found.marks(row):
                print(f"  {row.name:<60}{1e3 * row.seconds:8.1f} ms  {row.error:.1e}  {found.marks(row)}", flush=True)


def tries(folder, count, names):
    """Run the command again and again."""
    for name in names:
        named, times = collections.Counter(), []
        for _ in range(count):
            start = time.perf_counter()
            command = [sys.executable, "-c", COMMAND, "tradeoff", str(folder / name), "--json"]
            out = subprocess.run(command, capture_output=True, text=True, check=True).stdout
            times.append(time.perf_counter() - start)
            rows = json.loads(out)["rows"]
            named.update(row["name"] for row in rows if "recommended" in row["marks"])
            print(f"{name}: {times[-1]:.1f} s, {len(rows)} rows, {named.most_common(2)}", flush=True)
        print(f"{name}: {count} tries, {np.median(times):.1f} s, at most {max(times):.1f} s, {dict(named)}", flush=True)


def main(folder, *rest):
    """Write the scenes, then measure."""
    write(Path(folder))
    if rest and rest[0].isdigit():
        tries(Path(folder), int(rest[0]), rest[1:] or SCENES)
    else:
        fronts(Path(folder), rest or SCENES)


if __name__ == "__main__":
    main(*sys.argv[1:])
