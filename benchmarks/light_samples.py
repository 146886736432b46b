"""How many light samples a picture takes: the error against many, under lights at a distance of twice their size.

    python -m benchmarks.light_samples

Largest error over a ball of 64 × 64 pixels, relative to the brightest pixel; diffuse alone, and lobes alone.
"""

import argparse

import numpy as np

import brdf
from brdf.lights.base import Light

CAMERA = brdf.OrthographicCamera(position=[0, 0, 4], target=[0, 0, 0], up=[0, 1, 0], width=2.2, resolution=[64, 64])
BALL = [brdf.Sphere(center=[0, 0, 0], radius=1)]
MATERIALS = {
    "diffuse": brdf.Lambert(k_d=1),
    **{f"n = {n}": brdf.BlinnPhong(k_d=0, k_s=1, n=n) for n in (30, 1000)},
}
LIGHTS = {
    "rectangle": lambda samples: brdf.RectangleLight(
        center=[1, 1, 2.5], edge_u=[0, 0.5, 0], edge_v=[0.5, 0, 0], radiance=1, samples=samples
    ),
    "polygon": lambda samples: brdf.PolygonLight(
        vertices=[[0.5, 0.5, 2.5], [0.5, 1.5, 2.5], [1.5, 1.5, 2.5], [1.5, 0.5, 2.5]], radiance=1, samples=samples
    ),
    "sphere": lambda samples: brdf.SphereLight(center=[1, 1, 2.5], radius=0.5, radiance=1, samples=samples),
}
SAMPLES = (4, 16, 36, 64, 144, 256, 576, 1024)


def picture(light: Light, material: brdf.Material) -> np.ndarray:
    """In float64."""
    scene = brdf.Scene(camera=CAMERA, shapes=BALL, lights=[light])
    return np.asarray(brdf.render(material, scene, precision="float64"))


def main() -> None:
    """Prints a table."""
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    print(f"{'':22}" + "".join(f"{samples:>9}" for samples in SAMPLES))
    for kind, light in LIGHTS.items():
        for name, material in MATERIALS.items():
            exact = picture(light(64 * 64), material)
            errors = [np.max(np.abs(picture(light(samples), material) - exact)) / exact.max() for samples in SAMPLES]
            print(f"{kind:11}{name:11}" + "".join(f"{error:9.1e}" for error in errors), flush=True)


if __name__ == "__main__":
    main()
