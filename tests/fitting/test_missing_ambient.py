"""A hint at ambient light that the scene does not have: where the dark side is bright, and nowhere else."""

import numpy as np
import pytest

import brdf
import fitting

CAMERA = brdf.OrthographicCamera(position=[0, 0, 4], target=[0, 0, 0], up=[0, 1, 0], width=2.2, resolution=(64, 64))
BALL = brdf.Sphere(center=[0, 0, 0], radius=1)
MATERIAL = brdf.BlinnPhong(k_a=[0.4] * 3, k_d=[0.5, 0.4, 0.3], k_s=[0.3] * 3, n=30.0)
SIDE, FRONT = [0.8, 0.5, 0.4], [0.0, 0.0, 1.0]


def scene(direction: list[float], ambient: float | None) -> brdf.Scene:
    light = brdf.DirectionalLight(direction=direction, intensity=[0.9] * 3)
    return brdf.Scene(camera=CAMERA, shapes=(BALL,), lights=(light,), ambient=[ambient] * 3 if ambient else None)


@pytest.mark.parametrize(
    ("direction", "there", "known", "told"),
    [
        (SIDE, 0.2, None, True),
        (SIDE, None, None, False),
        (SIDE, 0.2, 0.2, False),
        (SIDE, 0.004, None, False),  # 0.7 % of the lit side: less than is worth a word
        (FRONT, 0.2, None, False),  # nothing is dark that could tell
    ],
    ids=["missing", "not there", "known", "a trace", "no dark side"],
)
def test_the_hint_comes_where_the_dark_side_is_bright(direction, there, known, told: bool):
    target = np.asarray(brdf.render(MATERIAL, scene(direction, there), precision="float64"))
    target = target + np.random.default_rng(0).normal(0, 0.01, target.shape)
    warnings = fitting.fit(target, scene(direction, known), model="blinn-phong").warnings
    assert any("[ambient]" in warning for warning in warnings) == told


def test_the_hint_says_how_bright():
    target = np.asarray(brdf.render(MATERIAL, scene(SIDE, 0.2), precision="float64"))
    normals = scene(SIDE, None).surface_points().normal
    cosine = np.asarray(normals) @ np.array(SIDE)
    on_ball = target.sum(axis=-1) > 0
    share = target[on_ball & (cosine <= 0)].mean() / target[on_ball & (cosine > 0)].mean()
    (hint,) = [w for w in fitting.fit(target, scene(SIDE, None)).warnings if "[ambient]" in w]
    assert f"still shows {100 * share:.2g} % of its lit side" in hint
