"""Fewer pixels and fewer light samples: they show what the whole shows, and stand for all of it."""

import dataclasses

import numpy as np
import pytest
from ball_scenes import MATERIAL, ball

import brdf
from fitting.budget.sampling import sample_pixels, with_samples


@pytest.mark.parametrize("kind", ["one ball", "two shapes", "points", "area"])
def test_some_pixels_see_what_the_whole_picture_shows_there(kind):
    scene = ball(32)
    if kind == "two shapes":
        floor = brdf.Rectangle(center=(0, -0.5, 0), edge_u=(3, 0, 0), edge_v=(0, 0.4, -3))
        scene = ball(32, shapes=(*scene.shapes, floor))
    if kind == "points":
        scene = dataclasses.replace(scene, camera=None, shapes=(), points=scene.surface_points())
    if kind == "area":
        scene = dataclasses.replace(scene, camera=dataclasses.replace(scene.camera, samples=3))
    pixel = np.random.default_rng(0).choice(32 * 32, 200, replace=False)
    whole = np.asarray(brdf.render(MATERIAL, scene, precision="float64")).reshape(-1, 3)[pixel]
    some = brdf.render(MATERIAL, brdf.some_pixels(scene, pixel, precision="float64"), precision="float64")
    # The same arithmetic in another order.
    np.testing.assert_allclose(np.asarray(some)[0], whole, rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize(("height", "width"), [(192, 192), (100, 333)])
def test_a_sample_stands_for_every_pixel_once(height, width):
    camera = dataclasses.replace(ball().camera, resolution=(width, height))
    sample = sample_pixels(dataclasses.replace(ball(), camera=camera), brdf.BlinnPhong, 1024)
    assert sample is not None
    assert sample.stands_for.sum() == height * width
    assert np.unique(sample.pixel).size == sample.pixel.size
    assert sample.pixel.max() < height * width


def test_a_sample_crowds_where_the_highlight_is():
    scene = ball(1024)
    sample = sample_pixels(scene, brdf.BlinnPhong, 1024)
    half = np.array([0.5, 0.6, 0.7]) / np.sqrt(1.1) + np.array([0, 0, 1])
    half /= np.linalg.norm(half)
    column, row = half[0] * 1024 / 2.2 + 512, 512 - half[1] * 1024 / 2.2
    distance = np.hypot(sample.pixel % 1024 + 0.5 - column, sample.pixel // 1024 + 0.5 - row)
    assert np.all(sample.stands_for[distance < 4] == 1)
    assert np.median(sample.stands_for[distance > 300]) >= 64


def test_a_light_map_keeps_its_light_with_other_samples():
    pixels = np.random.default_rng(1).random((16, 32, 3))
    scene = ball(8, (brdf.EnvironmentMap(pixels, radiance=[1.0, 2.0, 3.0], samples=64),))
    light = with_samples(scene, 16).lights[0]
    assert light.samples == 16
    assert with_samples(scene, 16).lights[0] is light
    np.testing.assert_allclose(light.radiance, scene.lights[0].radiance, rtol=1e-12)
    assert with_samples(ball(8), 4).lights == ball(8).lights


def test_a_light_of_many_corners_keeps_one_sample_for_each_triangle():
    turn = np.linspace(0, 2 * np.pi, 14)[:-1]
    corners = np.stack([np.cos(turn), np.sin(turn), np.full(13, 3.0)], axis=1)[::-1]
    scene = ball(256, (brdf.PolygonLight(vertices=corners, radiance=2.0),))
    assert with_samples(scene, 4).lights[0].samples == 11
    assert sample_pixels(scene, brdf.BlinnPhong, 1024) is not None
