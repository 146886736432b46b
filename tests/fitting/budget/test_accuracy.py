"""Fits to an accuracy: that it holds, what is chosen for it, and what is said."""

import dataclasses
import types

import numpy as np
import pytest
from ball_scenes import MATERIAL, ball, noisy

import brdf
import fitting
from brdf.geometry.visibility import OFFSET
from fitting.budget import budget, sampling_error
from fitting.budget.deviation import deviation
from fitting.budget.sampling_error import Estimate


@pytest.mark.parametrize("share", [0.0, 0.03])
def test_the_accuracy_holds_and_is_foretold(share):
    scene = ball()
    picture = noisy(scene, share)
    reference = fitting.fit(picture, scene, model="blinn-phong", precision="float64")
    for accuracy in (1e-1, 1e-2, 1e-4):
        result = fitting.fit(picture, scene, model="blinn-phong", accuracy=accuracy)
        assert result.choice is not None
        assert result.choice.met
        actual = max(deviation(result, reference)[:2])
        assert actual <= accuracy
        # A random error is known to a factor.
        assert actual / 4 < result.choice.chosen.error < actual * 4


def test_an_accuracy_of_noisy_pixels_takes_more_of_them():
    scene = ball(300)
    picture = noisy(scene, 0.1)
    coarse, fine = (fitting.fit(picture, scene, model="blinn-phong", accuracy=a).choice for a in (0.3, 1e-3))
    assert coarse is not None
    assert fine is not None
    assert coarse.pixels < fine.pixels == fine.of_pixels


@pytest.mark.parametrize("kind", ["mask", "weight"])
def test_the_accuracy_holds_where_only_some_pixels_count(kind):
    scene = ball(600)
    picture = noisy(scene, 0.02)
    # Those that hardly count show something else.
    picture[:, :240] *= 1.3
    counts = np.ones((600, 600))
    counts[:, :240] = 0.0 if kind == "mask" else 1e-4
    given = {kind: counts}
    reference = fitting.fit(picture, scene, model="blinn-phong", precision="float64", **given)
    result = fitting.fit(picture, scene, model="blinn-phong", accuracy=3e-2, **given)
    assert result.choice is not None
    assert result.choice.met
    assert result.choice.pixels < 10000
    assert max(deviation(result, reference)[:2]) <= 3e-2


def test_pictures_of_different_sizes_count_by_their_pixels():
    large, small = ball(600), ball(96)
    pictures = [noisy(large), 1.5 * noisy(small)]
    reference = fitting.fit(pictures, [large, small], model="blinn-phong", precision="float64")
    result = fitting.fit(pictures, [large, small], model="blinn-phong", accuracy=1e-1)
    assert result.choice is not None
    assert result.choice.pixels < result.choice.of_pixels
    assert max(deviation(result, reference)[:2]) <= 1e-1


def test_what_float32_does_at_the_edges_of_shadows_is_told():
    floor = brdf.Rectangle(center=(0, -1, 0), edge_u=(100, 0, 0), edge_v=(0, 0, -100))
    camera = brdf.PerspectiveCamera(position=(0, 2, 5), target=(0, 0, 0), up=(0, 1, 0), fov=40, resolution=(256, 256))
    scene = dataclasses.replace(ball(shapes=(ball().shapes[0], floor)), camera=camera)
    picture = noisy(scene)
    reference = fitting.fit(picture, scene, model="blinn-phong", precision="float64")
    result = fitting.fit(picture, scene, model="blinn-phong", accuracy=3e-3)
    assert result.choice is not None
    assert result.precision == "float32"
    # Which pixels cross is chance; that some may, is known.
    assert 1e-5 < result.choice.chosen.bound < 3e-3
    assert max(deviation(result, reference)[:2]) <= result.choice.chosen.bound
    assert fitting.fit(picture, scene, model="blinn-phong", accuracy=1e-4).precision == "float64"


def test_shadow_rays_start_where_the_estimate_thinks():
    assert sampling_error.RAY_START == OFFSET


def test_columns_that_nearly_add_up_are_taken_in_float64():
    # The light meets every point of the sheet alike, as ambient light does.
    sheet = brdf.Rectangle(center=(0, 0, 0), edge_u=(1, 0, 0), edge_v=(0, 1, 0))
    camera = brdf.PerspectiveCamera(
        position=(-2, 0, 0.6), target=(0, 0, 0), up=(0, 0, 1), fov=40, resolution=(128, 128)
    )
    light = brdf.DirectionalLight(direction=(0.95, 0.1, 0.3), intensity=2.0)
    scene = dataclasses.replace(ball(lights=(light,), shapes=(sheet,)), camera=camera)
    result = fitting.fit(noisy(scene, 0.01), scene, model="blinn-phong", accuracy=1e-2)
    assert result.precision == "float64"
    assert result.undetermined


def test_the_time_to_spend_ends_the_search():
    result = fitting.fit(noisy(ball(), 0.1), ball(), model="blinn-phong", seconds=1e-6)
    assert result.choice is not None
    assert len(result.choice.attempts) == 1
    assert "chosen" in str(result)
    assert result.to_dict()["choice"]["seconds"] == 1e-6


@pytest.mark.parametrize(("error", "narrowed"), [(0.01, (15.0, 240.0)), (1.0, None)])
def test_the_next_search_is_narrow_only_where_the_estimate_can_be_believed(error, narrowed):
    n = types.SimpleNamespace(name="n", value=60.0, interval=(59.0, 61.0))
    run = types.SimpleNamespace(result=types.SimpleNamespace(parameters=[n], candidates=()))
    step = types.SimpleNamespace(run=run, estimate=Estimate(error, error, 0.0, error, 0.0))
    assert budget._near(step, {"n_range": (0.1, 1e6)}) == narrowed


@pytest.mark.parametrize(
    ("order", "error", "allowed", "samples"), [(1, 0.4, 0.01, 1024), (2, 0.1, 1e-4, 512), (1, 0.9, 0.01, 64)]
)
def test_light_samples_grow_as_their_error_falls(order, error, allowed, samples):
    told = Estimate(error, error, 0.0, error, 0.0)
    assert budget._more_samples(16, lambda count, _: error * (16 / count) ** order, told, allowed) == samples


@pytest.mark.parametrize("accuracy", [0, -1.0, "fine", True, float("nan")])
def test_what_is_no_accuracy_is_refused(accuracy):
    with pytest.raises(brdf.InputError, match="accuracy: must be a number above 0"):
        fitting.fit(noisy(ball(32)), ball(32), accuracy=accuracy)


def test_weights_count():
    scene = ball(48)
    picture = noisy(scene)
    picture[:, :24] *= 2.0
    weight = np.ones((48, 48))
    weight[:, :24] = 0.0
    result = fitting.fit(picture, scene, model="blinn-phong", precision="float64", weight=weight)
    # The right half is exact.
    np.testing.assert_allclose(result.material.k_d, MATERIAL.k_d, rtol=1e-9)
    for accuracy in (None, 1e-2):
        with pytest.raises(brdf.InputError, match="weight"):
            fitting.fit(picture, scene, weight=weight[:3], accuracy=accuracy)
        with pytest.raises(brdf.InputError, match="weight: must be 0 or more"):
            fitting.fit(picture, scene, weight=-weight, accuracy=accuracy)
