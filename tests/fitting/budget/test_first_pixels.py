"""How many pixels a fit of a given accuracy looks at first: by noise, size, and what compiling takes."""

import numpy as np
import pytest
from ball_scenes import MATERIAL, ball, noisy

import brdf
import fitting
from fitting.budget import first_pixels


@pytest.mark.parametrize("noise", [0.0, 1e-3, 0.03])
def test_noise_is_told_from_the_picture_alone(noise):
    clean = np.asarray(brdf.render(MATERIAL, ball(512)))
    lit = clean.any(axis=-1)
    random = np.random.default_rng(2).standard_normal(clean.shape)
    picture = np.where(lit[..., None], clean + noise * random, 0.0)
    size = np.sqrt(np.mean(picture[lit] ** 2, axis=0)).max()
    told = first_pixels.noise_and_size(picture)
    assert told == (pytest.approx(noise, rel=0.1, abs=1e-4), pytest.approx(size, rel=0.1))
    # What is masked may be as rough as it likes.
    rough = np.where(lit[..., None], picture, np.abs(random))
    assert first_pixels.noise_and_size(rough, lit) == pytest.approx(told, rel=0.02, abs=1e-6)
    assert first_pixels.noise_and_size(np.full((8, 8, 1), np.nan)) == (0.0, 0.0)


@pytest.mark.parametrize(("noise", "pixels"), [(1e-4, (1000, 2500)), (0.03, (3000, 30000)), (0.3, (262144, 262144))])
def test_more_noise_asks_for_more_pixels_at_once(noise, pixels):
    scene = ball(512)
    result = fitting.fit(noisy(scene, noise), scene, model="blinn-phong", accuracy=1e-2)
    assert result.choice is not None
    assert len(result.choice.attempts) == 1
    assert result.choice.met
    assert pixels[0] <= result.choice.pixels <= pixels[1]
    assert (first_pixels.NOISY in str(result)) == (pixels[0] == 262144)


def test_a_large_picture_is_not_fitted_whole_on_a_guess():
    """Relief passes for noise, and a picture without noise needs few pixels however rough it is."""
    row, column = np.mgrid[:600, :600]
    slope = np.stack([0.3 * np.sin(2 * np.pi * at / 7) + 0.5 * (at - 300) / 600 for at in (column, row)], axis=-1)
    normal = np.concatenate([slope, np.ones((600, 600, 1))], axis=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    points = brdf.SurfacePoints.from_normals(normal)
    scene = brdf.Scene(points=points, ambient=[0.2], lights=ball().lights)
    picture = np.asarray(brdf.render(MATERIAL, scene))
    assert first_pixels.pixels_for([picture], {}, "blinn-phong", 1e-2) > 36000
    result = fitting.fit(picture, scene, model="blinn-phong", accuracy=1e-2)
    assert result.choice is not None
    assert result.choice.pixels < 10000


def test_noise_of_a_dim_picture_among_bright_ones_asks_for_no_more():
    scene = ball(256)
    bright = noisy(scene, 0.01)
    dim = bright.mean() * 0.01 * np.abs(np.random.default_rng(0).standard_normal(bright.shape))
    alone, both = (first_pixels.pixels_for(some, {}, "blinn-phong", 1e-2) for some in ([bright], [bright, dim]))
    assert alone < both < 4 * alone
    # Of what weighs nothing, nothing is asked.
    weight = [np.ones((256, 256)), np.zeros((256, 256))]
    weighed = first_pixels.pixels_for([bright, dim], {"weight": weight}, "blinn-phong", 1e-2)
    assert weighed == pytest.approx(alone, rel=0.01)


def test_a_small_mask_is_looked_at_whole_and_the_result_says_why():
    scene = ball(600)
    counts = np.zeros((600, 600), bool)
    counts[280:300, 300:330] = True
    result = fitting.fit(noisy(scene), scene, model="lambert", accuracy=1e-1, mask=counts)
    assert result.choice is not None
    assert "all pixels: choosing among so few" in str(result)


def test_a_process_of_one_fit_does_not_compile_what_would_choose():
    scene = ball(300)
    picture = noisy(scene, 0.01)
    with first_pixels.single_fit():
        alone = fitting.fit(picture, scene, model="blinn-phong", accuracy=1e-1)
    again = fitting.fit(picture, scene, model="blinn-phong", accuracy=1e-1)
    assert alone.choice is not None
    assert again.choice is not None
    assert alone.choice.pixels == alone.choice.of_pixels > again.choice.pixels
    assert "in a process of its own" in alone.choice.reason
    assert again.choice.reason == ""
