"""Directional albedo against mpmath, adaptive quadrature and the closed forms of DESIGN, with its derivatives."""

import itertools
import math

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
from scipy.integrate import quad

from brdf.albedo import directional_albedo, lobe_albedo
from brdf.models import BlinnPhong, Lambert, NormalizedBlinnPhong, NormalizedPhong, Phong

EXPONENTS = [0.0, 0.01, 0.5, 1.0, 10.0, 33.3, 1e3, 1e5, 1e6]
DEGREES = [0.0, 1e-3, 0.1, 5.0, 30.0, 60.0, 85.0, 89.0, 89.9, 89.99, 89.999, 90.0]
# Angles that float32 holds too, so that one reference serves both precisions.
THETA = np.minimum(np.float32(np.radians(DEGREES)).astype(float), math.pi / 2)


def phong_reference(n, theta):
    """The closed form, with mpmath's quadrature for the incomplete beta function."""
    with mpmath.workdps(25):
        n, theta = mpmath.mpf(n), mpmath.mpf(theta)
        sine, cosine = mpmath.sin(theta), mpmath.cos(theta)
        width = 1 / mpmath.sqrt(n + 1)
        ends = [0, *(x for x in (width, 3 * width, 6 * width, 12 * width, 30 * width) if x < cosine), cosine]
        # 1 - I_{sin^2}(n/2+1, 1/2) = I_{cos^2}(1/2, n/2+1)
        inner = mpmath.quad(lambda t: (1 - t * t) ** (n / 2), ends) if n > 0 else cosine
        incomplete = 2 * inner / mpmath.beta(0.5, n / 2 + 1)
        half_circle = mpmath.beta((n + 1) / 2, 0.5)
        return float(cosine * (1 + incomplete) / 2 + half_circle / (2 * mpmath.pi) * sine ** (n + 2))


def blinn_phong_reference(n, theta):
    """Adaptive quadrature over the half vector's angle; around the normal a rule that is exact for the polynomial."""
    nodes, weights = np.polynomial.legendre.leggauss(24)
    sine, cosine = math.sin(theta), max(math.cos(theta), 0.0) if theta < math.pi / 2 else 0.0

    def ring(alpha):
        x, y = -cosine * math.cos(2 * alpha), sine * math.sin(2 * alpha)
        end = math.pi if x <= -y else 0.0 if x >= y else math.acos(x / y)
        light_half = sine * math.sin(alpha) * np.cos(end * (nodes + 1) / 2) + cosine * math.cos(alpha)
        inner = end * np.sum(weights * 4 * light_half * (2 * light_half * math.cos(alpha) - cosine))
        return math.exp(n * math.log(math.cos(alpha))) * math.sin(alpha) * inner

    width = 1 / math.sqrt(n + 1)
    end = min(math.pi / 4 + theta / 2, 12 * width)
    kinks = [math.pi / 4 - theta / 2, *(x * width for x in (0.25, 1, 2, 3, 5, 7, 10))]
    ends = sorted({0.0, end, *(x for x in kinks if 0 < x < end)})
    total = sum(
        quad(ring, low, high, epsabs=1e-15 * width**2, epsrel=1e-11, limit=300)[0]
        for low, high in itertools.pairwise(ends)
    )
    return (n + 2) * (n + 4) / (8 * (2 ** (-n / 2) + n)) / math.pi * total


REFERENCES = {NormalizedPhong: phong_reference, NormalizedBlinnPhong: blinn_phong_reference}


@pytest.mark.parametrize("n", EXPONENTS)
@pytest.mark.parametrize(("model", "tolerance"), [(NormalizedPhong, 1e-10), (NormalizedBlinnPhong, 1e-8)])
@pytest.mark.filterwarnings("ignore::scipy.integrate.IntegrationWarning")  # asked for more digits than it has
def test_albedo_of_the_normalised_lobes(model, n, tolerance):
    material = model(k_d=0.0, k_s=1.0, n=n)
    double = directional_albedo(material, THETA, precision="float64")
    assert double.dtype == np.float64
    exact = [REFERENCES[model](n, t) for t in THETA]
    np.testing.assert_allclose(double[:, 0], exact, rtol=0, atol=tolerance)
    single = directional_albedo(material, np.float32(THETA), precision="float32")
    np.testing.assert_allclose(single[:, 0], exact, rtol=0, atol=1e-5)


def test_albedos_of_the_design_page():
    for n, expected in ((0, 0.75), (1, 0.609), (10, 0.5047)):
        value = directional_albedo(NormalizedPhong(k_d=0, k_s=1, n=n), np.radians(60), precision="float64")
        np.testing.assert_allclose(value, expected, atol=5e-4 if n < 10 else 5e-5)
    # the popular (n+8) / (8 pi) gains energy: 1.075 at n = 10
    popular = 18 / (8 * float(NormalizedBlinnPhong.scale(10.0)))
    np.testing.assert_allclose(popular, 1.075, atol=5e-4)
    # grazing light, by hand from the integral of cos^(n+1) sin^3
    for n in (0.0, 2.0, 300.0):
        value = directional_albedo(NormalizedBlinnPhong(k_d=0, k_s=1, n=n), np.pi / 2, precision="float64")
        np.testing.assert_allclose(value, 1 / (n + 2 ** (-n / 2)), rtol=1e-9)


@pytest.mark.parametrize("model", [NormalizedPhong, NormalizedBlinnPhong])
def test_no_more_light_leaves_than_arrives_and_most_at_normal_incidence(model):
    """The claim in the class docstrings and in ``check``, over n and theta."""
    with jax.enable_x64(True):
        theta = jnp.linspace(0, np.pi / 2, 301)
        albedo = jax.vmap(lambda n: lobe_albedo(model, n, theta))(jnp.append(0.0, jnp.geomspace(1e-3, 1e7, 200)))
    np.testing.assert_allclose(albedo[:, 0], 1, atol=1e-12)
    assert np.diff(np.asarray(albedo), axis=1).max() < 1e-11


@pytest.mark.parametrize("model", [Phong, BlinnPhong, NormalizedPhong, NormalizedBlinnPhong])
def test_albedo_is_the_integral_of_f_r(model):
    """A furnace: a plain product rule over the hemisphere, for lobes wide enough for it."""
    material = model(k_a=0.3, k_d=[0.2, 0.1], k_s=[0.3, 0.4], n=6.0)
    nodes, weights = np.polynomial.legendre.leggauss(600)
    z, weights = 0.5 * (nodes + 1), 0.5 * weights
    azimuth = np.arange(1200) * (2 * np.pi / 1200)
    radius = np.sqrt(1 - z * z)[:, None]
    view = np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), np.tile(z[:, None], 1200)], -1)
    with jax.enable_x64(True):
        reflectance = jax.jit(model.reflectance)
        for theta in (0.0, 0.7, 1.3):
            light = np.array([math.sin(theta), 0, math.cos(theta)])
            f_r = reflectance(material, light, view)
            expected = np.einsum("z,zac->c", weights * z, f_r) * (2 * np.pi / 1200)
            # 1e-6: the view's horizon and R.V = 0 are kinks for the product rule
            np.testing.assert_allclose(directional_albedo(material, theta), expected, rtol=1e-6)


def test_classic_albedo_diverges_at_grazing_light():
    material = BlinnPhong(k_d=0.2, k_s=[0.0, 0.5], n=10.0)
    albedo = directional_albedo(material, np.array([0.0, 1.5, np.pi / 2]), precision="float64")
    np.testing.assert_allclose(albedo[:, 0], 0.2)
    assert albedo[2, 1] == np.inf
    np.testing.assert_allclose(directional_albedo(Lambert(k_d=[0.3, 0.4]), [0.1, 1.0]), [[0.3, 0.4]] * 2, rtol=1e-6)


@pytest.mark.parametrize("model", [Phong, NormalizedPhong, NormalizedBlinnPhong])
def test_derivatives_of_the_albedo(model):
    with jax.enable_x64(True):
        modes = jax.grad, jax.jacfwd
        derivatives = [jax.jit(mode(lambda n, t: lobe_albedo(model, n, t), argnums=(0, 1))) for mode in modes]
        for n, theta in itertools.product((0.2, 1.0, 30.0, 1e4, 1e6), (0.3, 1.1, 1.55)):
            gradient, forward = (derivative(n, theta) for derivative in derivatives)
            np.testing.assert_allclose(gradient, forward, rtol=1e-9, atol=1e-14 / (n + 1))
            h, k = 1e-3 * n, 1e-3 / math.sqrt(n + 1)
            for i, (dn, dt) in enumerate(((h, 0.0), (0.0, k))):
                f = [float(lobe_albedo(model, n + s * dn, theta + s * dt)) for s in (-2, -1, 1, 2)]
                difference = (8 * (f[2] - f[1]) - (f[3] - f[0])) / (12 * (dn + dt))
                # 1e-14 is what rounding leaves of an albedo; divided by the step it is the floor of a difference
                np.testing.assert_allclose(gradient[i], difference, rtol=1e-6, atol=2e-14 / (dn + dt))


def test_derivative_in_n_against_mpmath():
    with jax.enable_x64(True):
        for n, theta in ((0.5, 0.4), (7.0, 1.2), (500.0, 1.5)):
            step = 1e-4 * n
            expected = (phong_reference(n + step, theta) - phong_reference(n - step, theta)) / (2 * step)
            derivative = jax.grad(lambda n, t: lobe_albedo(NormalizedPhong, n, t))(n, theta)
            np.testing.assert_allclose(derivative, expected, rtol=1e-6)


@pytest.mark.parametrize("x64", [False, True])
def test_derivatives_are_finite_everywhere(x64):
    with jax.enable_x64(x64):
        n, theta = (
            jnp.ravel(x) for x in jnp.meshgrid(jnp.array([0.0, 1e-3, 1.0, 1e6]), jnp.array([0.0, 1.0, np.pi / 2]))
        )
        for model in (Phong, NormalizedPhong, NormalizedBlinnPhong):
            for mode in (jax.grad, jax.jacfwd):
                derivatives = jax.vmap(mode(lambda n, t, m=model: lobe_albedo(m, n, t), argnums=(0, 1)))
                for derivative in jax.jit(derivatives)(n, theta):
                    assert np.all(np.isfinite(derivative))
