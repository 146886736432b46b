"""The simplest adequate model: what it is called, what it costs, and what it is compared with."""

from pathlib import Path

import numpy as np
import pytest
from scipy import optimize
from small_ball import ball_scene, pictured

import brdf
import fitting
from benchmarks.truth import File, ball, just_found
from brdf.images.encoding import encode

SCENE = ball_scene()
K = {"k_a": [0.5, 0.4, 0.3], "k_d": [0.5, 0.2, 0.3]}
GREY = [0.4, 0.4, 0.4]


def fit(material: brdf.Material, noise: float = 0.01, seed: int = 0) -> fitting.FitResult:
    return fitting.fit(pictured(material, SCENE, noise, seed), SCENE, precision="float64", saturation=np.inf)


def chosen(result: fitting.FitResult):
    (found,) = [candidate for candidate in result.candidates if candidate.chosen]
    return found


@pytest.mark.parametrize(
    ("material", "model", "words"),
    [
        (brdf.Lambert(k_a=[0.0] * 3, k_d=[0.0] * 3), "none", "none (black) fitted to"),
        (brdf.Lambert(k_a=[0.5, 0.4, 0.3], k_d=0.0), "ambient", "ambient (no shading) fitted to"),
        (brdf.Lambert(**K), "lambert", "lambert fitted to"),
        (brdf.Phong(**K, k_s=GREY, n=12.0), "phong", "phong fitted to"),
        (brdf.BlinnPhong(**K, k_s=GREY, n=30.0), "blinn-phong", "blinn-phong fitted to"),
    ],
)
def test_the_true_family_is_named(material: brdf.Material, model: str, words: str):
    results = [fit(material, seed=seed) for seed in range(3)]
    assert [chosen(result).model for result in results] == [model] * 3
    assert str(results[0]).startswith(words)


@pytest.mark.parametrize("k_d", [0.05, 0.3, 0.5, 0.6, 0.9])
def test_no_highlight_is_made_of_the_rounding_of_single_precision(k_d: float):
    for k_a in (0.0, 0.1):
        clean = brdf.render(brdf.Lambert(k_a=[k_a] * 3, k_d=[k_d] * 3), SCENE, precision="float32")
        assert fitting.fit(np.asarray(clean), SCENE).surface == "lambert"


@pytest.mark.parametrize("turn", [0.0, 2.0])
def test_a_plain_highlight_of_a_small_picture_is_seen(turn: float):
    """Of 16 x 16 pixels 14 of 20 without noise, and 10 of 16 with a light 2 degrees off, were said to be matt."""
    place = {"position": [0, 0, 4], "target": [0, 0, 0], "up": [0, 1, 0]}
    camera = brdf.OrthographicCamera(**place, width=2.2, resolution=(16, 16))
    for seed in range(8):
        random = np.random.default_rng(seed)
        true, told = np.array([[*random.uniform(-0.6, 0.6, 2), 0.8]] * 2)
        told += np.tan(np.radians(turn)) * np.cross(true, [0, 1, 0])
        material = brdf.BlinnPhong(
            k_a=random.uniform(0.1, 0.4, 3), k_d=random.uniform(0.1, 0.6, 3), k_s=GREY, n=random.uniform(8, 50)
        )
        seen, said = (
            brdf.Scene(camera, [brdf.Sphere([0, 0, 0], 1)], ambient=0.2, lights=[brdf.DirectionalLight(light, 1.0)])
            for light in (true, told)
        )
        result = fitting.fit(pictured(material, seen, 1e-3 * (turn > 0), seed), said)
        assert result.surface == "blinn-phong"


def test_a_grey_highlight_is_told_from_a_coloured_one():
    grey = fit(brdf.BlinnPhong(**K, k_s=GREY, n=30.0))
    assert chosen(grey).highlight == "grey"
    assert np.ptp(grey.material.k_s) < 1e-12
    assert grey.material.n == pytest.approx(30.0, rel=0.02)
    assert chosen(fit(brdf.BlinnPhong(**K, k_s=[0.4, 0.3, 0.2], n=30.0))).highlight == "coloured"


@pytest.mark.parametrize("seed", [0, 1, 5])
def test_what_stays_allows_for_a_highlight_that_was_left_out(seed: int, tmp_path: Path):
    """One about as large as is just found moves k_d by several of the errors that Lambert's law alone would state."""
    one = ball(seed, k_s=just_found(seed, 128, 1 / 255, "linear"))
    result = fitting.fit(File(1.0).picture(one.drawn(), seed, tmp_path), one.scene(), model="auto")
    alone = fitting.fit(File(1.0).picture(one.drawn(), seed, tmp_path), one.scene(), model="lambert")
    assert result.surface == "lambert"
    k_d = result["k_d"][0]
    assert k_d.value == pytest.approx(alone["k_d"][0].value, rel=1e-9)
    assert k_d.error > 1.5 * alone["k_d"][0].error
    assert abs(k_d.value - one.k[1, 0]) < 2.5 * k_d.error


def test_without_an_ambient_term_it_is_left_out_and_bounded_and_the_grey_fit_is_that_of_scipy():
    truth = brdf.BlinnPhong(k_a=0.0, k_d=[0.5, 0.2, 0.3], k_s=GREY, n=30.0)
    result = fit(truth)
    found = result.material
    assert not chosen(result).ambient
    assert np.all(found.k_a == 0)
    assert all(p.interval[0] == 0 and 0 < p.interval[1] < 0.02 for p in result.parameters if p.name == "k_a")
    mask, picture = np.asarray(SCENE.surface_points().mask), pictured(truth, SCENE, 0.01)

    def residual(x: np.ndarray) -> np.ndarray:
        trial = brdf.BlinnPhong(k_d=x[:3], k_s=x[3], n=x[4])
        return (np.asarray(brdf.render(trial, SCENE, precision="float64")) - picture)[mask].ravel()

    scipy = optimize.least_squares(residual, [0.4, 0.3, 0.3, 0.3, 25.0], xtol=1e-14, ftol=1e-14, gtol=1e-14)
    # The numeric Jacobian of SciPy stops at about 1e-8 of the parameters.
    assert [*found.k_d, found.k_s[0], float(found.n)] == pytest.approx(scipy.x, rel=1e-5)


def test_the_expected_error_is_that_of_leaving_pixels_out():
    material = brdf.Lambert(k_a=[0.5, 0.4, 0.3], k_d=[0.5, 0.2, 0.3])
    result = fit(material, noise=0.05)
    lambert = next(c for c in result.candidates if c.model == "lambert" and c.ambient)
    images = brdf.basis_images(brdf.Lambert, SCENE)
    mask, picture = np.asarray(SCENE.surface_points().mask), pictured(material, SCENE, 0.05)
    squares = 0.0
    for channel in range(3):
        parts = (
            np.asarray(image)[..., min(channel, image.shape[-1] - 1)] for image in (images.ambient, images.diffuse)
        )
        columns = np.stack([np.broadcast_to(part, mask.shape)[mask] for part in parts], axis=1)
        hat = np.einsum("pi,ij,pj->p", columns, np.linalg.inv(columns.T @ columns), columns)
        target = picture[mask][:, channel]
        solution = np.linalg.lstsq(columns, target, rcond=None)[0]
        squares += np.mean(((target - columns @ solution) / (1 - hat)) ** 2) / 3
    # To first order in unknowns per pixel, and with the noise estimated.
    assert lambert.held_out**2 - lambert.rms**2 == pytest.approx(squares - lambert.rms**2, rel=0.05)


def test_two_kinds_of_highlight_that_fit_alike_are_both_named():
    result = fit(brdf.BlinnPhong(**K, k_s=[0.1, 0.1, 0.1], n=250.0), noise=0.02)
    assert any("fits as well" in text for text in result.warnings)


def test_the_report_shows_what_the_scene_requires():
    text = str(fit(brdf.Lambert(**K)))
    assert "what the scene requires" in text
    assert "lambert with ambient" in text
    assert "<- chosen" in text


def test_an_exponent_whose_highlight_no_pixel_sees_is_not_looked_at():
    # Noise on ambient light alone: the best highlight of float32 sums lay at 1e6, between pixels, and overflowed.
    for seed in range(4):
        random = np.random.default_rng(seed)
        light = brdf.DirectionalLight(direction=[*random.uniform(-0.5, 0.5, 2), 1.0], intensity=[1.0, 1.0, 1.0])
        scene = ball_scene(light)
        picture = pictured(brdf.Lambert(k_a=0.4, k_d=0.0), scene, 0.003, seed).astype(np.float32)
        assert chosen(fitting.fit(picture, scene, saturation=np.inf)).model == "ambient"


@pytest.mark.parametrize("intensity", [[1.0, 1.0, 1.0], [1.0, 1.0, 0.0]])
def test_a_channel_without_light_does_not_choose_for_the_others(intensity):
    material = brdf.BlinnPhong(k_d=[0.3, 0.5, 0.0], k_s=[0.3, 0.3, 0.0], n=20)
    scene = ball_scene(brdf.DirectionalLight([0.4, 0.5, 0.8], intensity), ambient=None)
    found = fitting.fit(np.rint(255 * pictured(material, scene)).astype(np.uint8), scene).material
    np.testing.assert_allclose(found.k_d[:2], material.k_d[:2], atol=1e-4)
    np.testing.assert_allclose(found.k_s[:2], material.k_s[:2], atol=1e-3)
    np.testing.assert_allclose(found.n, 20, rtol=1e-3)


@pytest.mark.parametrize("n", [75.0, 116.0])
def test_exposures_of_8_bits_tell_the_kind_of_highlight(n: float):
    """Rounding is all the noise: the two models differ in how many values they predict near an edge of a code."""
    material = brdf.Phong(k_a=[0.1, 0.15, 0.2], k_d=[0.5, 0.4, 0.3], k_s=[0.3, 0.2, 0.4], n=n)
    lit = [brdf.DirectionalLight([0.2, -0.4, 1.0], exposure) for exposure in (0.25, 1.0)]
    scenes = [ball_scene(light, ambient=0.3 * light.intensity) for light in lit]
    pictures = [np.rint(255 * encode(pictured(material, scene), "srgb")).astype(np.uint8) for scene in scenes]
    result = fitting.fit(pictures, scenes, encoding="srgb")
    assert result.surface == "phong"
    assert float(result["n"]) == pytest.approx(n, rel=0.01)


def test_a_highlight_of_one_pixel_is_seen_among_codes_without_noise():
    """With it predictions lie within all the codes: nothing is left that could err together."""
    material = brdf.BlinnPhong(k_a=0.2, k_d=0.4, k_s=0.4, n=1e4)
    scene = ball_scene(brdf.DirectionalLight([0.4, 0.5, 0.8], intensity=1.0), ambient=0.5)
    result = fitting.fit(
        np.rint(255 * encode(pictured(material, scene), "srgb")).astype(np.uint8), scene, encoding="srgb"
    )
    assert result.surface != "lambert"
    assert not any("structure" in warning for warning in result.warnings)
    np.testing.assert_allclose([result.material.k_a[0], result.material.k_d[0]], [0.2, 0.4], atol=1e-4)


def test_of_a_light_from_behind_codes_say_what_values_do():
    """No number was free, and of none an error was asked for."""
    camera = brdf.OrthographicCamera(position=[0, 0, 4], target=[0, 0, 0], up=[0, 1, 0], width=2.2, resolution=[32, 32])
    front, behind = (
        brdf.Scene(camera, shapes=[brdf.Sphere([0, 0, 0], 1)], lights=[brdf.DirectionalLight(direction, [1.0])])
        for direction in ([0.5, 0.6, 0.7], [0, 0, -1])
    )
    shown = np.asarray(brdf.render(brdf.BlinnPhong(k_d=[0.5], k_s=[0.3], n=20), front))
    codes = np.rint(255 * shown).clip(0, 255).astype(np.uint8)
    for picture in (codes, codes / np.float32(255)):
        result = fitting.fit(picture, behind)
        assert not np.any(np.asarray(result.material.k_d))
