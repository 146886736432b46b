"""The derivative of a fit by what it took as known, against fits at shifted lights."""

import dataclasses
from typing import Any

import numpy as np
import pytest

import brdf
import fitting
from fitting.implicit import with_light_errors

DIRECTION = np.array([0.4, 0.5, 0.8])
SIZE = 64


def scene(direction: np.ndarray = DIRECTION, intensity: float = 0.9, ambient: float | None = 0.3) -> brdf.Scene:
    camera = brdf.OrthographicCamera(
        position=[0, 0, 4], target=[0, 0, 0], up=[0, 1, 0], width=2.2, resolution=(SIZE, SIZE)
    )
    return brdf.Scene(
        camera=camera,
        shapes=(brdf.Sphere(center=[0, 0, 0], radius=1),),
        lights=(brdf.DirectionalLight(direction=direction, intensity=[intensity] * 3),),
        ambient=None if ambient is None else [ambient] * 3,
    )


def picture(case: str) -> np.ndarray:
    """Explained by the model but for noise, or not explained: the residual then takes part in the derivative."""
    kind = brdf.Phong if case == "another model" else brdf.BlinnPhong
    material = kind(k_a=[0.2, 0.1, 0.3], k_d=[0.5, 0.4, 0.1], k_s=[0.4, 0.3, 0.6], n=20.0)
    clean = np.asarray(brdf.render(material, scene(), precision="float64"))
    return clean + np.random.default_rng(7).normal(0, 0.01, clean.shape)


def test_channels_that_are_not_clipped_count_where_another_is():
    """Of whole pixels alone n moved by a sixth less, green k_s by 13 times as much, or nothing was determined."""
    clean = np.minimum(picture("explained"), 0.6)

    def found(x: float) -> fitting.FitResult:
        known = scene(DIRECTION + x * np.eye(3)[0])
        return fitting.fit(clean, known, model="blinn-phong", precision="float64", saturation=0.6)

    result, step = found(0.0), 1e-4
    assert result.weighed[0].shape == clean.shape
    (moves,) = fitting.sensitivity(result, lambda scenes: (scenes[0].lights[0].direction,))
    difference = (numbers(found(step).material) - numbers(found(-step).material)) / (2 * step)
    np.testing.assert_allclose(moves.n[0], difference[-1], rtol=0.08)
    np.testing.assert_allclose(moves.k_d[:, 0], difference[3:6], rtol=0.08, atol=0.01)


def numbers(material: brdf.Material) -> np.ndarray:
    return np.concatenate([np.ravel(getattr(material, key)) for key in ("k_a", "k_d", "k_s", "n")])


def fitted(target: np.ndarray, how: dict[str, Any], **lamp: Any) -> np.ndarray:
    return numbers(fitting.fit(target, scene(**lamp), model="blinn-phong", precision="float64", **how).material)


def row(found: fitting.Sensitivity, *place: int) -> np.ndarray:
    return np.array([*found.k_a[:, *place], *found.k_d[:, *place], *found.k_s[:, *place], found.n[place]])


@pytest.mark.parametrize("case", ["noise", "another model", "weights", "noise of a camera"])
def test_light_direction_moves_the_fit_as_fits_at_shifted_lights_say(case: str):
    target, how = picture(case), {}
    if case == "weights":
        how = {"weight": np.linspace(0.1, 1, SIZE * SIZE).reshape(SIZE, SIZE)}
    elif case == "noise of a camera":
        how = {"noise": (0.005, 0.01)}
    result = fitting.fit(target, scene(), model="blinn-phong", precision="float64", **how)
    found = fitting.sensitivity(result, lambda scenes: (scenes[0].lights[0].direction,))[0]
    step = 1e-4
    for axis in range(3):
        shift = step * np.eye(3)[axis]
        ends = [fitted(target, how, direction=DIRECTION + sign * shift) for sign in (1, -1)]
        expected = (ends[0] - ends[1]) / (2 * step)
        # The central difference is off by step², the fits by 1e-10 / step.
        np.testing.assert_allclose(row(found, axis), expected, rtol=1e-3, atol=1e-3 * np.abs(expected).max() * 1e-2)
    np.testing.assert_allclose(found.n @ DIRECTION, 0, atol=1e-8 * np.abs(found.n).max())


def test_pictures_of_different_noise_move_the_fit_by_what_they_know():
    """Counted alike, n moved by 0.57 of what it does."""
    other = scene(np.array([-0.5, 0.3, 0.8]))
    material = brdf.BlinnPhong(k_a=[0.2, 0.1, 0.3], k_d=[0.5, 0.4, 0.1], k_s=[0.4, 0.3, 0.6], n=20.0)
    clean = [np.asarray(brdf.render(material, one, precision="float64")) for one in (scene(), other)]
    rng = np.random.default_rng(3)
    pictures = [one + rng.normal(0, noise, one.shape) for one, noise in zip(clean, (0.01, 0.03), strict=True)]

    def found(shift: np.ndarray) -> fitting.FitResult:
        return fitting.fit(pictures, [scene(DIRECTION + shift), other], model="blinn-phong", precision="float64")

    (moves,) = fitting.sensitivity(found(np.zeros(3)), lambda scenes: (scenes[0].lights[0].direction,))
    for axis, shift in enumerate(1e-4 * np.eye(3)):
        difference = (numbers(found(shift).material) - numbers(found(-shift).material)) / 2e-4
        np.testing.assert_allclose(row(moves, axis), difference, rtol=0.02, atol=0.01)


def test_several_leaves_and_a_fit_in_float32():
    target = picture("noise")
    result = fitting.fit(target.astype(np.float32), scene(), model="blinn-phong")
    by_light, by_ambient = fitting.sensitivity(result, lambda s: (s[0].lights[0].intensity, s[0].ambient))
    k_d, k_a = np.asarray(result.material.k_d), np.asarray(result.material.k_a)
    # Twice the light is half the coefficient, channel by channel.
    np.testing.assert_allclose(by_light.k_d, np.diag(-k_d / 0.9), atol=2e-5)
    np.testing.assert_allclose(by_ambient.k_a, np.diag(-k_a / 0.3), atol=2e-5)
    np.testing.assert_allclose(by_ambient.n, 0, atol=1e-6)
    (alone,) = fitting.sensitivity(result, lambda s: s[0].ambient)
    np.testing.assert_allclose(alone.k_a, by_ambient.k_a, atol=1e-6)


def test_errors_hold_what_turned_lights_change():
    target, degrees, squares = picture("noise"), 0.3, np.zeros(10)
    result = fitting.fit(target, scene(), model="blinn-phong", precision="float64")
    wider = with_light_errors(result, [degrees])
    for turn in np.linalg.svd(DIRECTION[None])[2][1:]:
        # Half the difference of fits under lights turned by one standard error each way, of each of two turns.
        step = np.radians(degrees) / np.sqrt(2) * np.linalg.norm(DIRECTION) * turn
        ahead, behind = (fitted(target, {}, direction=DIRECTION + sign * step) for sign in (1, -1))
        squares += ((ahead - behind) / 2) ** 2
    grown = []
    for before, after in zip(result.parameters, wider.parameters, strict=True):
        error, low, high = np.array([after.error, *(after.interval or (np.nan, np.nan))], float)
        np.testing.assert_allclose(error, np.hypot(np.array(before.error), squares[before.place(3)] ** 0.5), rtol=0.05)
        assert low < np.min(before.interval or np.nan) < np.max(before.interval or np.nan) < high
        grown.append(error / np.array(before.error))
    assert max(grown) > 2


def test_errors_of_lights_hold_what_channels_say_that_are_not_clipped():
    """Of whole pixels alone those of k_s were up to four times as large."""
    clean = np.minimum(picture("noise"), 0.6)
    result = fitting.fit(clean, scene(), model="blinn-phong", precision="float64", saturation=0.6)
    assert result.weighed[0].ndim == 3
    (moves,) = fitting.sensitivity(result, lambda scenes: (scenes[0].lights[0].direction,))
    turns = np.linalg.svd(DIRECTION[None])[2][1:] * np.linalg.norm(DIRECTION) * np.radians(0.3) / np.sqrt(2)
    for before, after in zip(result.parameters, with_light_errors(result, [0.3]).parameters, strict=True):
        slope = getattr(moves, before.name) if before.channel is None else getattr(moves, before.name)[before.channel]
        assert before.error is not None
        assert after.error == pytest.approx(np.hypot(before.error, np.linalg.norm(turns @ slope)), rel=0.1)


def test_errors_of_lights_are_those_of_least_squares():
    result = fitting.fit(picture("noise"), scene(), model="blinn-phong", loss="log")
    with pytest.raises(brdf.InputError, match="squared loss"):
        with_light_errors(result, [0.3])
    nothing = dataclasses.replace(result, loss="squared", parameters=())
    assert with_light_errors(nothing, [0.3]) is nothing


def test_numbers_at_their_bound_stay_there():
    target = np.asarray(brdf.render(brdf.Lambert(k_d=[0.5, 0.4, 0.3]), scene(), precision="float64"))
    target = target + np.random.default_rng(3).normal(0, 1e-3, target.shape)
    result = fitting.fit(target, scene(), model="lambert", precision="float64")
    bound = [parameter.channel for parameter in result.parameters if parameter.name == "k_a" and parameter.at_bound]
    found = fitting.sensitivity(result, lambda s: (s[0].lights[0].direction,))[0]
    assert bound
    assert not np.any(found.k_a[bound])
    assert not np.any(found.n)


def test_what_cannot_be_differentiated_is_named():
    result = fitting.fit(picture("noise"), scene(), model="blinn-phong", loss="huber")
    with pytest.raises(brdf.InputError, match="must be of the squared loss, got huber"):
        fitting.sensitivity(result, lambda s: (s[0].ambient,))
    result = fitting.fit(picture("noise"), scene(), model="blinn-phong")
    with pytest.raises(brdf.InputError, match="by: names no leaf"):
        fitting.sensitivity(result, lambda s: ())
    with pytest.raises(brdf.InputError, match="by: gives a leaf twice"):
        fitting.sensitivity(result, lambda s: (s[0].ambient, s[0].ambient))
