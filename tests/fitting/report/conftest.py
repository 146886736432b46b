"""Fits that the pages and pictures of this folder are made of."""

import numpy as np
import pytest

import brdf
import fitting

SIZE = 40


def fit(material: brdf.Material, model: str, noise: float = 0.0) -> fitting.FitResult:
    """A ball of a material, with one pixel that is no number."""
    camera = brdf.OrthographicCamera(
        position=[0, 0, 4], target=[0, 0, 0], up=[0, 1, 0], width=2.2, resolution=(SIZE, SIZE)
    )
    light = brdf.DirectionalLight(direction=[0.4, 0.5, 0.8], intensity=[0.9])
    scene = brdf.Scene(camera=camera, shapes=(brdf.Sphere(center=[0, 0, 0], radius=1),), lights=(light,))
    target = np.array(brdf.render(material, scene, precision="float64"))
    target += np.random.default_rng(5).normal(0, noise, target.shape)
    target[20, 20] = np.nan
    return fitting.fit(target, scene, model=model)


@pytest.fixture(scope="session")
def fit_ball():
    return fit


@pytest.fixture(scope="session")
def glossy() -> fitting.FitResult:
    return fit(brdf.BlinnPhong(k_d=[0.5, 0.4, 0.3], k_s=0.4, n=30), "blinn-phong", noise=0.01)


@pytest.fixture(scope="session")
def matt() -> fitting.FitResult:
    return fit(brdf.Lambert(k_d=0.5), "lambert", noise=1e-3)
