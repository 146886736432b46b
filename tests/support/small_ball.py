"""One small ball that the tests of the fit share, so that what is compiled for one serves all."""

import numpy as np

import brdf

SIZE = 48
CAMERA = brdf.OrthographicCamera(position=[0, 0, 4], target=[0, 0, 0], up=[0, 1, 0], width=2.2, resolution=(SIZE, SIZE))
BALL = brdf.Sphere(center=[0, 0, 0], radius=1)
SUN = brdf.DirectionalLight(direction=[0.5, 0.6, 0.7], intensity=[1.0, 0.8, 0.6])
AMBIENT = [0.2, 0.2, 0.3]


def ball_scene(*lights, ambient=AMBIENT, camera=CAMERA) -> brdf.Scene:
    return brdf.Scene(camera=camera, shapes=[BALL], ambient=ambient, lights=lights or [SUN])


def pictured(material: brdf.Material, scene: brdf.Scene, noise=0.0, seed: int = 0) -> np.ndarray:
    """A picture with noise of a standard deviation, one number or one a value."""
    clean = np.asarray(brdf.render(material, scene, precision="float64"))
    return clean + noise * np.random.default_rng(seed).standard_normal(clean.shape)
