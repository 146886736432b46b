"""What each feature of a scene costs: the time to compile a fit for it, the time to run it, and its arithmetic.

``python -m benchmarks.feature_cost [SIZE]`` fits a picture of SIZE x SIZE pixels with one feature after another and
prints a table in Markdown. What a scene does not require is left out of the program that is compiled for it: its
floating-point operations are the compiler's own count for the basis images of that scene, in which the body of a loop
over light samples counts once.
"""

import argparse

import jax
import numpy as np

import brdf
import fitting
from benchmarks.tradeoff import BALL, FLOOR, camera, sky
from brdf.rendering import basis
from fitting.speed_accuracy import take

ROUNDS, PATIENCE, SAMPLES = 7, 3.0, 64
SUN = brdf.DirectionalLight(direction=(0.5, 0.6, 0.7), intensity=1.0)
LIGHTS = {
    "point light": brdf.PointLight(position=(2, 2, 3), intensity=20.0),
    "spot light": brdf.SpotLight(
        position=(2, 2, 3), direction=(-2, -2, -3), intensity=20.0, cutoff_angle=30.0, exponent=2.0
    ),
    "rectangle, 64 samples": brdf.RectangleLight(
        center=(2, 2, 3), edge_u=(0, 0.8, -0.5), edge_v=(0.7, 0, -0.7), radiance=3.0, samples=SAMPLES
    ),
    "sphere light, 64 samples": brdf.SphereLight(center=(2, 2, 3), radius=0.6, radiance=6.0, samples=SAMPLES),
    "environment map, 64 samples": brdf.EnvironmentMap(sky(3), samples=SAMPLES),
    "constant environment": brdf.ConstantEnvironment(radiance=0.8),
}


def scenes(size):
    """Name, model and scene: a base, then one feature more, then other lights in place of the sun."""
    look, matt, shiny = camera(size), "lambert", "blinn-phong"

    def place(lights=(SUN,), shapes=(BALL,), ambient=None):
        return brdf.Scene(camera=look, shapes=shapes, ambient=ambient, lights=lights)

    yield "diffuse, one directional light", matt, place()
    yield "and ambient", matt, place(ambient=[0.2])
    yield "and specular", shiny, place()
    yield "and ambient, specular", shiny, place(ambient=[0.2])
    yield "and a floor, shadows", shiny, place(shapes=(BALL, FLOOR))
    yield "and a second light", shiny, place((SUN, brdf.DirectionalLight(direction=(-0.6, 0.1, 0.8), intensity=0.5)))
    for name, light in LIGHTS.items():
        yield name, shiny, place((light,))


def operations(model, place):
    """Floating-point operations of the basis images at n = 50, per pixel, as compiled."""
    kind = brdf.MODELS[model]

    def images(scene):
        found = basis(kind, scene)
        return [found.diffuse] + ([] if found.lobe is None else [found.lobe(50.0)[0]])

    small = brdf.some_pixels(place, np.arange(0, np.prod(place.resolution), 97))
    cost = jax.jit(images).lower(brdf.cast(small, "float32")).compile().cost_analysis()
    return cost["flops"] / small.resolution[0]


def main(size):
    """Measure and print."""
    material = brdf.BlinnPhong(k_a=[0.2, 0.3, 0.1], k_d=[0.5, 0.3, 0.2], k_s=[0.4, 0.4, 0.3], n=50.0)
    print("| scene | to compile (s) | to run (ms) | operations per pixel |\n| --- | --- | --- | --- |")
    for name, model, place in scenes(size):
        true = brdf.Lambert(k_d=material.k_d) if model == "lambert" else material
        picture = np.asarray(brdf.render(true, place))
        jax.clear_caches()
        taken = []
        while len(taken) < 2 or (len(taken) <= ROUNDS and sum(one.seconds for one in taken) < PATIENCE):
            taken.append(take(lambda p=picture, s=place, m=model: fitting.fit(p, s, model=m))[1])
        run = 1e3 * min(one.seconds for one in taken[1:])
        print(f"| {name} | {taken[0].compiling:.1f} | {run:.3g} | {operations(model, place):.0f} |", flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("size", type=int, nargs="?", default=512)
    main(parser.parse_args().size)
