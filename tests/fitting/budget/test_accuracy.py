"""Fits to an accuracy: that it holds, what is chosen for it, and what is said."""

import dataclasses

import numpy as np
import pytest
from ball_scenes import MATERIAL, ball, noisy

import brdf
import fitting
from benchmarks.tradeoff import deviation
from fitting.budget import escalation
from fitting.budget.choice import Attempt
from fitting.budget.configurations import Configuration

SIZE = 300


@pytest.fixture(autouse=True)
def _as_if_pictures_were_large(monkeypatch):
    monkeypatch.setattr(escalation, "FEW", 1 << 12)


def fit(picture, scene, **how):
    return fitting.fit(picture, scene, model="blinn-phong", **how)


@pytest.mark.parametrize("share", [0.0, 0.03])
def test_the_accuracy_holds_and_is_foretold(share):
    scene = ball(SIZE)
    picture = noisy(scene, share)
    best = fit(picture, scene, precision="float64")
    coarse, fine = results = [fit(picture, scene, accuracy=accuracy) for accuracy in ("1e-1", 1e-3)]
    for result, accuracy in zip(results, (1e-1, 1e-3), strict=True):
        assert result.choice.met
        actual = deviation(result, best)
        assert actual <= accuracy
        # A random error is known to a factor.
        assert actual / 4 < result.choice.chosen.error < actual * 4
    assert coarse.choice.pixels < coarse.choice.of_pixels
    assert (fine.choice.pixels == fine.choice.of_pixels) == (share > 0)


@pytest.mark.parametrize(
    ("noise", "gain", "accuracy"),
    [(0.0, 0.9, 1e-3), (0.05, 1.2, 3e-2)],
    ids=["without noise", "clipped"],
)
def test_the_accuracy_holds_of_codes(noise, gain, accuracy):
    """By least squares of some pixels k_a of codes without noise was 9 times as far off as the bound that was told."""
    scene = ball(SIZE)
    shown = np.asarray(brdf.render(MATERIAL, scene, precision="float64"))
    shown = shown * gain / shown.max() + noise * np.random.default_rng(0).normal(size=shown.shape)
    codes = np.rint(255 * shown).clip(0, 255).astype(np.uint8)
    result = fit(codes, scene, accuracy=accuracy)
    assert result.choice.met
    assert deviation(result, fit(codes, scene)) <= accuracy


@pytest.mark.parametrize("kind", ["mask", "weight"])
def test_the_accuracy_holds_where_only_some_pixels_count(kind):
    scene = ball(400)
    picture = noisy(scene, 0.02)
    # Those that hardly count show something else.
    picture[:, :160] *= 1.3
    counts = np.ones((400, 400))
    counts[:, :160] = 0.0 if kind == "mask" else 1e-4
    best = fit(picture, scene, precision="float64", **{kind: counts})
    result = fit(picture, scene, accuracy=3e-2, **{kind: counts})
    assert result.choice.met
    assert result.choice.pixels < 10000
    assert deviation(result, best) <= 3e-2


def test_pictures_of_different_sizes_count_by_their_pixels():
    large, small = ball(SIZE), ball(96)
    pictures = [noisy(large), 1.5 * noisy(small)]
    best = fit(pictures, [large, small], precision="float64")
    result = fit(pictures, [large, small], accuracy=1e-1)
    assert result.choice.pixels < result.choice.of_pixels
    assert deviation(result, best) <= 1e-1


def test_an_area_light_takes_as_many_samples_as_change_the_answer():
    light = brdf.RectangleLight(center=(2, 2, 3), edge_u=(0, 0.8, -0.5), edge_v=(0.7, 0, -0.7), radiance=3.0)
    scene = ball(40, (light,))
    # So narrow that 16 samples show apart.
    sharp = dataclasses.replace(MATERIAL, n=400.0)
    picture = noisy(ball(40, (dataclasses.replace(light, samples=1024),)), material=sharp)
    result = fit(picture, scene, accuracy=1e-3)
    assert result.choice.met
    assert "light samples left out" in str(result)
    assert abs(float(result.material.n) / 400.0 - 1) <= 1e-3
    assert 0 < fit(picture, scene, accuracy=0.3).choice.chosen.light < 0.06


def test_hard_shadows_are_fitted_in_float64():
    """In float32 some pixels fall on the other side of a shadow's edge."""
    floor = brdf.Rectangle(center=(0, -1, 0), edge_u=(100, 0, 0), edge_v=(0, 0, -100))
    camera = brdf.PerspectiveCamera(position=(0, 2, 5), target=(0, 0, 0), up=(0, 1, 0), fov=40, resolution=(96, 96))
    scene = dataclasses.replace(ball(shapes=(ball().shapes[0], floor)), camera=camera)
    assert fit(noisy(scene), scene, accuracy=3e-3).precision == "float64"


def test_columns_that_nearly_add_up_are_taken_in_float64():
    # The light meets every point of the sheet alike, as ambient light does.
    sheet = brdf.Rectangle(center=(0, 0, 0), edge_u=(1, 0, 0), edge_v=(0, 1, 0))
    camera = brdf.PerspectiveCamera(position=(-2, 0, 0.6), target=(0, 0, 0), up=(0, 0, 1), fov=40, resolution=(96, 96))
    light = brdf.DirectionalLight(direction=(0.95, 0.1, 0.3), intensity=2.0)
    scene = dataclasses.replace(ball(lights=(light,), shapes=(sheet,)), camera=camera)
    result = fit(noisy(scene, 0.01), scene, accuracy=1e-2)
    assert result.precision == "float64"
    assert result.undetermined


def test_under_a_constant_sky_ambient_and_diffuse_light_are_one_and_the_error_is_a_number():
    scene = ball(24, (brdf.ConstantEnvironment(0.8, samples=64),))
    result = fit(noisy(scene), scene, accuracy=1e-1)
    assert result.undetermined
    assert result.choice.met


def test_the_time_to_spend_ends_the_search():
    scene = ball(SIZE)
    result = fit(noisy(scene, 0.1), scene, seconds=1e-6)
    assert len(result.choice.attempts) == 1
    assert "chosen" in str(result)
    assert result.to_dict()["choice"]["seconds"] == 1e-6


@pytest.mark.parametrize(
    ("parts", "accuracy", "better"),
    [
        # pixels, light, rounding: twice as few pixels left out take four times as many.
        ((2 * 0.8e-2, 0.0, 1e-7), 1e-2, {"pixels": 4096}),
        ((0.3, 0.0, 1e-7), 1e-2, {"pixels": None}),
        ((0.0, 0.0, 1e-2), 1e-2, {"precision": "float64"}),
        # Without an accuracy as well.
        ((5e-3, 0.0, 1e-7), None, {"pixels": 8192}),
        # More pixels mend nothing.
        ((1e-3, 2e-2, 1e-7), 1e-2, None),
        ((0.0, 0.0, 0.0), 1e-2, None),
    ],
)
def test_what_makes_most_of_the_error_is_improved(parts, accuracy, better):
    now = Configuration("blinn-phong", "float32", 1024)
    told = Attempt(max(parts), max(parts), *parts)
    expected = None if better is None else dataclasses.replace(now, **better)
    assert escalation._better(now, told, accuracy, 100000) == expected


@pytest.mark.parametrize("accuracy", [0, -1.0, "fine", True, float("nan")])
def test_what_is_no_accuracy_is_refused(accuracy):
    with pytest.raises(brdf.InputError, match="accuracy: must be"):
        fit(np.ones((32, 32, 3)), ball(32), accuracy=accuracy)


def test_weights_count():
    scene = ball(48)
    picture = noisy(scene)
    picture[:, :24] *= 2.0
    weight = np.ones((48, 48))
    weight[:, :24] = 0.0
    result = fit(picture, scene, precision="float64", weight=weight)
    # The right half is exact.
    np.testing.assert_allclose(result.material.k_d, MATERIAL.k_d, rtol=1e-9)
    for accuracy in (None, 1e-2):
        with pytest.raises(brdf.InputError, match="weight"):
            fitting.fit(picture, scene, weight=weight[:3], accuracy=accuracy)
        with pytest.raises(brdf.InputError, match="weight: must be 0 or more"):
            fitting.fit(picture, scene, weight=-weight, accuracy=accuracy)


def test_noise_asks_for_more_pixels_until_a_sample_is_not_worth_it():
    scene = ball(SIZE)
    few, whole = (fit(noisy(scene, noise), scene, accuracy=1e-2).choice for noise in (1e-4, 0.3))
    assert few.met
    assert few.pixels < few.of_pixels
    assert whole.pixels == whole.of_pixels
    assert whole.reason == escalation.REASON_MANY


def test_a_small_mask_is_looked_at_whole_and_the_result_says_why():
    counts = np.zeros((SIZE, SIZE), bool)
    counts[140:160, 150:180] = True
    result = fitting.fit(noisy(ball(SIZE)), ball(SIZE), model="lambert", accuracy=1e-1, mask=counts)
    assert f"all pixels: {escalation.REASON_FEW}" in str(result)
