"""Does ``fit(accuracy=...)`` keep its word on scenes unlike those it was made with?

``python -m benchmarks.tradeoff_unlike [NAME ...]`` prints, for each of a dozen scenes and each accuracy, the error
against the reference of `benchmarks.tradeoff` and the estimate, and a summary. Nothing is timed, so that it can run
beside other work.
"""

import dataclasses
import sys
import tempfile
from pathlib import Path

import numpy as np

import brdf
from benchmarks.tradeoff import BALL, OPTIONS, SIZE, SUN, camera, material, photograph, scene, study, summary

SECOND = brdf.Sphere(center=(0.7, 0.75, 1.2), radius=0.3)
SMALL_BALL = brdf.Sphere(center=(-0.2, -0.2, 0.0), radius=0.6)
TILE = "v 0.2 0.3 1.2\nv 0.9 0.3 1.0\nv 0.5 0.9 1.4\nf 1 2 3\n"


def floor(size):
    """A floor below the ball, far around it."""
    return brdf.Rectangle(center=(0, -1, 0), edge_u=(size, 0, 0), edge_v=(0, 0, -size))


def view(fov, distance, height=0.0):
    """A perspective camera."""
    return brdf.PerspectiveCamera(
        position=(0, height, distance), target=(0, 0, 0), up=(0, 1, 0), fov=fov, resolution=(SIZE, SIZE)
    )


def distant(direction, intensity):
    """A directional light."""
    return brdf.DirectionalLight(direction=direction, intensity=intensity)


def saved(picture, folder, **how):
    """A picture as a file of 8 bits holds it."""
    path = Path(folder) / "picture.png"
    brdf.write_image(path, picture, encoding="srgb", **how)
    return brdf.read_picture(path)


def scenes(folder):
    """Name: scene, picture, model, options."""

    def plain(name, place, true=None, model="blinn-phong", noise=0.01, **options):
        return name, place, photograph(name, place, true or material(), noise), model, OPTIONS | options

    ways = (-0.6, 0.1, 0.8), (0.5, 0.6, 0.7), (0, -0.7, 0.7)
    coloured = [distant(way, colour) for way, colour in zip(ways, np.eye(3), strict=True)]
    yield plain("one light a colour", scene(*coloured), noise=0.02)
    point = brdf.PointLight(position=(-2, 1, 2), intensity=[6.0, 8.0, 9.0])
    yield plain("four lights", scene(SUN, point, distant((-0.8, 0.1, 0.5), 0.3), distant((0, -0.9, 0.4), 0.2)))
    yield plain("close camera", scene(look=view(80, 1.8)), material(200.0))
    spot = brdf.SpotLight(position=(2, 3, 3), direction=(-2, -3, -3), intensity=30.0, cutoff_angle=25.0, exponent=3.0)
    yield plain("spot, shadow", scene(spot, shapes=(BALL, floor(3)), look=view(40, 5, 2)))
    yield plain("two balls, shadow", scene(shapes=(SMALL_BALL, SECOND)), noise=0.0)
    yield plain("two balls, noise", scene(shapes=(SMALL_BALL, SECOND)), noise=0.02)
    yield plain("wide floor", scene(shapes=(BALL, floor(100)), look=view(40, 5, 2)), noise=0.0)
    yield plain("wide floor, noise", scene(shapes=(BALL, floor(100)), look=view(40, 5, 2)))
    (Path(folder) / "tile.obj").write_text(TILE)
    mesh = brdf.Triangles(brdf.load_mesh(Path(folder) / "tile.obj"), fitted=False)
    inside = np.zeros((SIZE, SIZE), bool)
    inside[120:400, 60:300] = True
    yield plain("mesh, mask", scene(shapes=(BALL, mesh)), mask=inside)
    yield plain("far ball", scene(look=camera(width=30.0)))
    sheet = brdf.Rectangle(center=(0, 0, 0), edge_u=(1, 0, 0), edge_v=(0, 1, 0))
    low = dataclasses.replace(view(40, 1), position=(-2, 0, 0.6), up=(0, 0, 1))
    grazing = plain("grazing sheet", scene(distant((0.95, 0.1, 0.3), 2.0), shapes=(sheet,), look=low), material(100.0))
    yield grazing
    rows, columns = np.mgrid[:SIZE, :SIZE]
    checks = 1 + 0.3 * (((rows // 24) + (columns // 24)) % 2)[..., None]
    name, place, picture, *rest = plain("textured", scene(shapes=(BALL, floor(3)), look=view(40, 5, 2)))
    yield name, place, (picture * checks).astype(np.float32), *rest
    name, place, picture, *rest = plain("8 bits, clipped", scene(distant((0.5, 0.6, 0.7), 1.6)))
    yield name, place, saved(np.clip(picture, 0, 1), folder), *rest
    name, place, picture, *rest = plain("low light", scene(), noise=0.3)
    yield name, place, saved(np.clip(0.01 * picture, 0, 1), folder), *rest
    name, place, picture, *rest = plain("auto", scene(look=camera(400)), model="auto", noise=0.03)
    yield name, place, picture, *rest


def main(names):
    """Run the scenes named, or all."""
    found = []
    with tempfile.TemporaryDirectory() as folder:
        for name, *rest in scenes(folder):
            if not names or name in names:
                place, picture, model, options = rest
                found += study(name, place, picture, model, options, timed=False)
                summary(found)


if __name__ == "__main__":
    main(sys.argv[1:])
