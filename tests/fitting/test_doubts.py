"""Inputs that are something else than they are given as are told of, and sound ones are not."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import brdf
import fitting
from brdf.images.encoding import encode

SIDE = (32, 32)


def camera(fov: float = 30.0) -> brdf.PerspectiveCamera:
    return brdf.PerspectiveCamera(position=[0, 0, 4.2], target=[0, 0, 0], up=[0, 1, 0], fov=fov, resolution=SIDE)


def scene(
    direction: Any = (0.5, 0.6, 0.7),
    *,
    fov: float = 30.0,
    ambient: Any = 0.2,
    intensity: float = 1.0,
    flat: bool = False,
) -> brdf.Scene:
    wall = brdf.Rectangle(center=[0, 0, 0], edge_u=[2, 0, 0], edge_v=[0, 2, 0])
    light = brdf.DirectionalLight(direction=direction, intensity=intensity)
    return brdf.Scene(camera(fov), [wall if flat else brdf.Sphere([0, 0, 0], 1)], lights=[light], ambient=ambient)


MATT, GLOSSY = brdf.Lambert(k_a=0.4, k_d=0.7), brdf.BlinnPhong(k_a=0.3, k_d=0.5, k_s=0.3, n=20.0)
AMBIENT = brdf.Lambert(k_a=0.8, k_d=0.0)
RNG = np.random.default_rng(0)


def shown(material: brdf.Material = MATT, noise: float = 0.005, where: brdf.Scene | None = None) -> np.ndarray:
    picture = np.asarray(brdf.render(material, where or scene()), np.float32)
    return picture + np.float32(noise) * RNG.standard_normal(picture.shape, np.float32)


def srgb(material: brdf.Material = MATT, noise: float = 0.005) -> np.ndarray:
    return encode(np.clip(shown(material, noise), 0, 1), "srgb")


def told(picture: np.ndarray, place: brdf.Scene, **options: Any) -> str:
    return " | ".join(fitting.fit(picture, place, **options).warnings)


@pytest.mark.parametrize(
    ("picture", "place", "words"),
    [
        pytest.param(lambda: np.rint(255 * shown().clip(0, 1)), scene(), "whole numbers up to", id="codes as floats"),
        pytest.param(lambda: 255 * shown(), scene(), "k_d is 17", id="0 to 255"),
        pytest.param(srgb, scene(), "sRGB-encoded", id="sRGB"),
        pytest.param(lambda: srgb(GLOSSY), scene(), "sRGB-encoded", id="sRGB, glossy"),
        pytest.param(lambda: srgb(noise=0.0), scene(), "sRGB-encoded", id="sRGB without noise"),
        pytest.param(lambda: np.rint(255 * srgb()).astype(np.uint8), scene(), "sRGB-encoded", id="sRGB codes"),
        pytest.param(shown, scene(fov=np.radians(30.0)), "if these are radians, give fov=30", id="radians"),
        pytest.param(lambda: np.full((*SIDE, 3), 0.5, np.float32), scene(), "the same in every pixel", id="constant"),
        pytest.param(lambda: RNG.random((*SIDE, 3), np.float32), scene(), "may be noise", id="noise"),
        pytest.param(lambda: RNG.standard_normal(SIDE, np.float32), scene(), "may be noise", id="signed noise"),
    ],
)
def test_what_is_something_else_is_told_of(picture: Callable[[], np.ndarray], place: brdf.Scene, words: str):
    assert words in told(picture(), place)


DOUBTS = ("whole numbers", "k_d is", "radians", "the same in every pixel", "may be noise", "sRGB-encoded")
DIM, FLAT, TELE = scene(intensity=1 / np.pi, ambient=0.2), scene(flat=True), scene(fov=2.0)
LIT = brdf.Scene(
    camera(), [brdf.Sphere([0, 0, 0], 1)], lights=[brdf.PointLight(position=[1, 1, 4], intensity=2.0)], ambient=0.1
)


@pytest.mark.parametrize(
    ("picture", "place", "options"),
    [
        pytest.param(shown, scene(), {}, id="matt"),
        pytest.param(lambda: shown(noise=0), scene(), {}, id="without noise"),
        pytest.param(lambda: shown(GLOSSY, 0.05), scene(), {}, id="glossy, much noise"),
        pytest.param(lambda: shown(GLOSSY), scene(), {"model": "lambert"}, id="a wrong model"),
        pytest.param(lambda: shown(GLOSSY), scene([0.6, 0.6, 0.6]), {}, id="a light degrees off"),
        pytest.param(lambda: shown(GLOSSY), scene(ambient=None), {}, id="no ambient light"),
        pytest.param(lambda: 0.9 * shown() + np.float32(0.1), scene(ambient=None), {}, id="black level, no ambient"),
        pytest.param(lambda: np.clip(2 * shown(), 0, 1), scene(), {}, id="clipped"),
        pytest.param(lambda: np.rint(255 * shown().clip(0, 1)).astype(np.uint8), scene(), {}, id="codes"),
        pytest.param(lambda: np.abs(shown()) ** np.float32(0.9), scene(), {}, id="a slight gamma"),
        pytest.param(lambda: 3 * shown(), DIM, {}, id="HDR"),
        pytest.param(shown, DIM, {}, id="an intensity of 1 in place of pi"),
        pytest.param(lambda: shown(where=LIT), LIT, {}, id="point light"),
        pytest.param(lambda: shown(AMBIENT), scene(), {}, id="ambient light alone"),
        pytest.param(lambda: shown(where=FLAT), FLAT, {}, id="a sheet"),
        pytest.param(lambda: shown(where=FLAT, noise=0), FLAT, {}, id="a sheet without noise"),
        pytest.param(lambda: shown(where=TELE), TELE, {}, id="a long lens"),
    ],
)
def test_what_is_sound_is_not_doubted(picture: Callable[[], np.ndarray], place: brdf.Scene, options: dict[str, Any]):
    words = told(picture(), place, **options)
    assert not [doubt for doubt in DOUBTS if doubt in words]


@pytest.mark.parametrize("loss", ["relative", "log"])
def test_dark_codes_that_shares_weigh_are_no_curve(loss: Any):
    where = scene(ambient=None)
    codes = np.clip(np.rint(255 * shown(GLOSSY, 0.004, where)), 0, 255).astype(np.uint8)
    said = fitting.fit(codes, where, model="blinn-phong", loss=loss).warnings
    assert not any("sRGB-encoded" in words for words in said)
