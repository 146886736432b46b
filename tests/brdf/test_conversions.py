"""Exponents, slopes, roughness, and the nearest form."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import minimize

from brdf import conversions
from brdf.errors import InputError
from brdf.models import BlinnPhong, Lambert, NormalizedBlinnPhong, NormalizedPhong, Phong
from brdf.plausibility.verdicts import check


def test_exponents_slopes_and_roughness():
    n = np.array([0.0, 6.0, 50.0, 1e6])
    alpha = conversions.slope_from_exponent(n)
    np.testing.assert_allclose(alpha, np.sqrt(2 / (n + 2)), rtol=1e-15)
    np.testing.assert_allclose(alpha[:2], [1, 0.5])
    np.testing.assert_allclose(conversions.roughness_from_exponent(n), np.sqrt(alpha), rtol=1e-15)
    np.testing.assert_allclose(conversions.exponent_from_slope(alpha), n, rtol=1e-12)
    np.testing.assert_allclose(
        conversions.exponent_from_roughness(conversions.roughness_from_exponent(n)), n, rtol=1e-12, atol=1e-15
    )
    np.testing.assert_array_equal(conversions.half_from_mirror(n), 4 * n)
    np.testing.assert_array_equal(conversions.mirror_from_half(4 * n), n)


def test_conversions_are_differentiable():
    np.testing.assert_allclose(jax.grad(conversions.slope_from_exponent)(6.0), -0.5 / 16, rtol=1e-6)
    np.testing.assert_allclose(jax.jit(jax.grad(conversions.exponent_from_slope))(0.5), -32, rtol=1e-6)


def test_four_times_the_mirror_exponent_gives_the_same_highlight():
    theta, n = np.linspace(-0.1, 0.1, 41), 200.0
    light = np.array([0.5, 0, np.sqrt(0.75)])
    angle = np.radians(-30) + theta
    view = np.stack([np.sin(angle), 0 * angle, np.cos(angle)], -1)
    up = np.array([0.0, 0, 1])
    mirrored = Phong(k_d=0, k_s=1, n=n).specular(up, light, view)
    halved = BlinnPhong(k_d=0, k_s=1, n=conversions.half_from_mirror(n)).specular(up, light, view)
    np.testing.assert_allclose(mirrored, halved, atol=0.01)


@pytest.mark.parametrize(
    ("function", "value"),
    [
        (conversions.exponent_from_slope, 0.0),
        (conversions.exponent_from_slope, 1.5),
        (conversions.exponent_from_roughness, -0.1),
        (conversions.slope_from_exponent, -1.0),
        (conversions.half_from_mirror, np.nan),
    ],
)
def test_what_conversions_refuse(function, value):
    with pytest.raises(InputError, match="must be"):
        function(value)


@pytest.mark.parametrize(("old", "new"), [(Phong, NormalizedPhong), (BlinnPhong, NormalizedBlinnPhong)])
@pytest.mark.parametrize(("k_d", "k_s", "n"), [(0.3, 0.5, 8.0), (0.9, 2.0, 3.0), (1.3, 0.1, 20.0), (0.0, 4.0, 2.0)])
def test_nearest_plausible_form_is_the_constrained_least_squares_one(old, new, k_d, k_s, n):
    """Radiance sampled over lights and sphere pixels, minimised by SciPy."""
    nearest = conversions.nearest_normalized(old(k_a=0.1, k_d=k_d, k_s=k_s, n=n))
    assert type(nearest) is new
    assert nearest.n == n
    assert check(nearest).plausible is True
    z, azimuth = (np.polynomial.legendre.leggauss(60)[0] + 1) / 2, np.arange(48) * (2 * np.pi / 48)
    weight = np.polynomial.legendre.leggauss(60)[1] / 2
    radius = np.sqrt(1 - z * z)
    light = np.stack([radius, 0 * z, z], -1)[:, None, None]
    view = np.stack(
        [radius[:, None] * np.cos(azimuth), radius[:, None] * np.sin(azimuth), z[:, None] + 0 * azimuth], -1
    )
    weights = weight[:, None, None] * (weight * z)[:, None] + 0 * azimuth
    with jax.enable_x64(True):
        up = np.array([0.0, 0, 1])
        target = k_d * light[..., 2] + k_s * old(k_d=0, k_s=1, n=n).specular(up, light, view)
        diffuse, lobe = light[..., 2], np.asarray(new(k_d=0, k_s=1, n=n).specular(up, light, view))
        target = np.asarray(target)

    def error(k):
        return 100 * np.sum(weights * (target - k[0] * diffuse - k[1] * lobe) ** 2)

    bounds = [(0, None), (0, None)]
    best = minimize(error, [0.3, 0.3], bounds=bounds, constraints={"type": "ineq", "fun": lambda k: 1 - k[0] - k[1]})
    found = np.array([nearest.k_d[0], nearest.k_s[0]])
    # the sampling is good to a few 1e-4, and near its minimum the error is flat
    np.testing.assert_allclose(found, best.x, atol=3e-3)


def test_nearest_forms_of_what_needs_none():
    material = NormalizedBlinnPhong(k_a=0.2, k_d=[0.3, 0.1], k_s=[0.2, 0.7], n=40.0)
    same = conversions.nearest_normalized(material)
    for a, b in zip(jax.tree.leaves(material), jax.tree.leaves(same), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9)
    assert type(conversions.nearest_classic(material)) is BlinnPhong
    matt = NormalizedBlinnPhong(k_d=[0.3, 0.1], k_s=[0.2, 0.7], n=0.0)  # its lobe is the diffuse term
    np.testing.assert_allclose(conversions.nearest_normalized(matt).k_d, [0.25, 0.4])
    np.testing.assert_allclose(conversions.nearest_normalized(matt).k_s, [0.25, 0.4])
    far = conversions.nearest_normalized(Phong(k_d=0.3, k_s=0.5, n=1e15))  # at an angle the lobe lights a 1e-15 of it
    np.testing.assert_allclose([far.k_d[0], far.k_s[0]], [0.3, 4 / 3 * 1e-15], rtol=1e-3)
    classic = Phong(k_d=0.5, k_s=3.0, n=12.0)
    np.testing.assert_allclose(conversions.nearest_classic(classic).k_s, 3.0)
    np.testing.assert_allclose(conversions.nearest_normalized(Lambert(k_d=[0.5, 1.5])).k_d, [0.5, 1.0])
    assert jnp.size(conversions.nearest_classic(Lambert(k_d=0.5)).k_d) == 1
