"""The simplest adequate model: what it is called, what it costs, and what it is compared with."""

import numpy as np
import pytest
from scipy import optimize

import brdf
import fitting
from fitting.solver.nnls import nonnegative_minimum

CAMERA = brdf.OrthographicCamera(position=[0, 0, 4], target=[0, 0, 0], up=[0, 1, 0], width=2.2, resolution=(64, 64))
BALL = brdf.Sphere(center=[0, 0, 0], radius=1)
LIGHT = brdf.DirectionalLight(direction=[0.5, 0.6, 0.7], intensity=[1.0, 1.0, 1.0])
SCENE = brdf.Scene(camera=CAMERA, shapes=[BALL], ambient=[0.2, 0.2, 0.2], lights=[LIGHT])
K = {"k_a": [0.5, 0.4, 0.3], "k_d": [0.5, 0.2, 0.3]}
GREY = [0.4, 0.4, 0.4]


def fit(material: brdf.Material, noise: float = 0.01, seed: int = 0, scene: brdf.Scene = SCENE) -> fitting.FitResult:
    clean = np.asarray(brdf.render(material, scene, precision="float64"))
    picture = clean + noise * np.random.default_rng(seed).standard_normal(clean.shape)
    return fitting.fit(picture, scene, precision="float64", saturation=np.inf)


def chosen(result: fitting.FitResult):
    (found,) = [candidate for candidate in result.candidates if candidate.chosen]
    return found


@pytest.mark.parametrize("seed", range(5))
def test_the_minimum_above_zero_is_that_of_scipy(seed: int):
    random = np.random.default_rng(seed)
    columns, target = random.standard_normal((30, 6)), random.standard_normal(30)
    signed = np.array([False, False, True, False, True, False])
    # A signed unknown is the difference of two that are not.
    doubled = np.concatenate([columns, -columns[:, signed]], axis=1)
    expected, _ = optimize.nnls(doubled, target)
    expected[:6][signed] -= expected[6:]
    found = nonnegative_minimum(columns.T @ columns, columns.T @ target, signed)
    assert found == pytest.approx(expected[:6], abs=1e-10)


def test_columns_of_nothing_stay_out_of_the_minimum():
    gram, product = np.diag([2.0, 0.0, 1e-320]), np.array([1.0, 0.0, 1e-300])
    assert nonnegative_minimum(gram, product, np.zeros(3, bool)) == pytest.approx([0.5, 0, 0])


@pytest.mark.parametrize(
    ("material", "model"),
    [
        (brdf.Lambert(k_a=[0.5, 0.4, 0.3], k_d=0.0), "ambient"),
        (brdf.Lambert(**K), "lambert"),
        (brdf.Phong(**K, k_s=GREY, n=12.0), "phong"),
        (brdf.BlinnPhong(**K, k_s=GREY, n=30.0), "blinn-phong"),
    ],
)
def test_the_true_family_is_named(material: brdf.Material, model: str):
    assert [chosen(fit(material, seed=seed)).model for seed in range(3)] == [model] * 3


def test_a_grey_highlight_is_told_from_a_coloured_one():
    grey = fit(brdf.BlinnPhong(**K, k_s=GREY, n=30.0))
    assert chosen(grey).highlight == "grey"
    assert np.ptp(grey.material.k_s) < 1e-12
    assert grey.material.n == pytest.approx(30.0, rel=0.02)
    assert chosen(fit(brdf.BlinnPhong(**K, k_s=[0.4, 0.3, 0.2], n=30.0))).highlight == "coloured"


def test_an_ambient_term_that_is_not_there_is_left_out_and_bounded():
    result = fit(brdf.BlinnPhong(k_a=0.0, k_d=[0.5, 0.2, 0.3], k_s=GREY, n=30.0))
    assert not chosen(result).ambient
    assert np.all(result.material.k_a == 0)
    assert all(p.interval[0] == 0 and 0 < p.interval[1] < 0.02 for p in result.parameters if p.name == "k_a")


def test_the_grey_fit_is_that_of_scipy():
    truth = brdf.BlinnPhong(k_a=0.0, k_d=[0.5, 0.2, 0.3], k_s=GREY, n=30.0)
    clean = np.asarray(brdf.render(truth, SCENE, precision="float64"))
    picture = clean + 0.01 * np.random.default_rng(0).standard_normal(clean.shape)
    found = fitting.fit(picture, SCENE, precision="float64", saturation=np.inf).material
    assert np.all(found.k_a == 0)
    mask = np.asarray(SCENE.surface_points().mask)

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
    clean = np.asarray(brdf.render(material, SCENE, precision="float64"))
    picture = clean + 0.05 * np.random.default_rng(0).standard_normal(clean.shape)
    images = brdf.basis_images(brdf.Lambert, SCENE)
    mask = np.asarray(SCENE.surface_points().mask)
    columns = np.stack([np.asarray(image)[..., 0][mask] for image in (images.ambient, images.diffuse)], axis=1)
    hat = np.einsum("pi,ij,pj->p", columns, np.linalg.inv(columns.T @ columns), columns)
    solution = np.linalg.lstsq(columns, picture[mask], rcond=None)[0]
    left_out = (picture[mask] - columns @ solution) / (1 - hat)[:, None]
    gain = np.sum(left_out**2) / left_out.size - lambert.rms**2
    # To first order in unknowns per pixel, and with the noise estimated.
    assert lambert.held_out**2 - lambert.rms**2 == pytest.approx(gain, rel=0.05)


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
    camera = brdf.OrthographicCamera(position=[0, 0, 4], target=[0, 0, 0], up=[0, 1, 0], width=2.2, resolution=(96, 96))
    for seed in range(4):
        random = np.random.default_rng(seed)
        light = brdf.DirectionalLight(direction=[*random.uniform(-0.5, 0.5, 2), 1.0], intensity=[1.0, 1.0, 1.0])
        scene = brdf.Scene(camera=camera, shapes=[BALL], ambient=[0.3, 0.3, 0.3], lights=[light])
        picture = np.asarray(brdf.render(brdf.Lambert(k_a=0.4, k_d=0.0), scene, precision="float32"))
        picture = picture + 0.003 * random.standard_normal(picture.shape).astype(np.float32)
        assert chosen(fitting.fit(picture, scene, saturation=np.inf)).model == "ambient"


def test_the_first_line_names_what_was_chosen():
    nothing = fit(brdf.Lambert(k_a=[0.0] * 3, k_d=[0.0] * 3))
    assert str(nothing).startswith("none (black) fitted to")
    flat = fit(brdf.Lambert(k_a=[0.5] * 3, k_d=[0.0] * 3))
    assert str(flat).startswith("ambient (no shading) fitted to")
    assert str(fit(brdf.Lambert(**K))).startswith("lambert fitted to")
