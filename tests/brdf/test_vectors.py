"""The cosine lobe and the small vector algebra, against references in higher precision."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from brdf import vectors

EXPONENTS = [0.0, 0.1, 1.0, 10.0, 1e2, 1e3, 1e4, 1e5, 1e6]


def unit(v):
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def frames(count, seed):
    """Random unit vectors with random tangents, in float64."""
    random = np.random.default_rng(seed)
    axis = unit(random.normal(size=(count, 3)))
    return axis, unit(np.cross(axis, random.normal(size=(count, 3)))), random


def angle(a, b):
    """Angle between vectors of any length; long doubles, so that nothing of float32 or float64 rounding is left."""
    a, b = a.astype(np.longdouble), b.astype(np.longdouble)
    cross = np.cross(a, b)
    return np.arctan2(np.sqrt(np.sum(cross * cross, -1)), np.sum(a * b, -1))


def power(theta, n):
    """cos^n for cos > 0, else 0, in long doubles."""
    cosine = np.cos(theta)
    return np.where(cosine > 0, np.exp(n * np.log(np.where(cosine > 0, cosine, 1))), 0).astype(np.float64)


def tilted(axis, tangent, random, n):
    """Vectors at 0 to 6 lobe widths from the axis, within the half sphere where a lobe is wider than that."""
    theta = random.uniform(0, 6, size=(len(axis), 1)) / np.sqrt(max(n, 1e-9))
    theta = theta % np.pi if n < 10 else theta
    return np.cos(theta) * axis + np.sin(theta) * tangent


@pytest.mark.parametrize("n", EXPONENTS)
def test_lobe_in_float32_is_within_1e5_of_the_peak(n):
    axis, tangent, random = frames(1000, seed=1)
    a, b = (v.astype(np.float32) for v in (axis, tilted(axis, tangent, random, n)))
    lobe = jax.jit(vectors.cosine_lobe)(a, b, jnp.float32(n))
    assert lobe.dtype == jnp.float32
    # the contract asks for 1e-5; two roundings of float32 in log and exp leave 2e-7
    np.testing.assert_allclose(lobe, power(angle(a, b), n), rtol=0, atol=1e-6)


@pytest.mark.parametrize("n", EXPONENTS)
@pytest.mark.parametrize("kind", ["half", "mirror"])
def test_whole_lobe_in_float32_from_normal_light_and_view(kind, n):
    normal, _, random = frames(1000, seed=2)
    light = unit(random.normal(size=(1000, 3)))
    light = np.where(np.sum(light * normal, -1, keepdims=True) < 0, -light, light)
    mirrored = 2 * np.sum(light * normal, -1, keepdims=True) * normal - light
    view = tilted(mirrored, unit(np.cross(mirrored, random.normal(size=(1000, 3)))), random, n)
    normal, light, view = (v.astype(np.float32) for v in (normal, light, view))
    log_cosine = {"half": vectors.half_log_cosine, "mirror": vectors.mirror_log_cosine}[kind]
    lobe = jax.jit(lambda *v: vectors.lobe(log_cosine(*v), jnp.float32(n)))(normal, light, view)
    exact = [unit(v.astype(np.longdouble)) for v in (normal, light, view)]
    if kind == "half":
        theta = angle(exact[0], exact[1] + exact[2])
    else:
        theta = angle(2 * np.sum(exact[0] * exact[1], -1, keepdims=True) * exact[0] - exact[1], exact[2])
    # cos^0.1 is steep where R.V is nearly 0, and R.V is known to 6e-8 only
    np.testing.assert_allclose(lobe, power(theta, n), rtol=0, atol=1e-4 if (kind, n) == ("mirror", 0.1) else 1e-5)


def test_lobe_of_exponent_1e8_is_finite_and_at_most_one():
    axis, tangent, random = frames(1000, seed=3)
    a, b = (v.astype(np.float32) for v in (axis, tilted(axis, tangent, random, 1e8)))
    for lobe in (vectors.cosine_lobe(a, b, np.float32(1e8)), vectors.cosine_lobe(a, a, np.float32(1e8))):
        assert np.all(np.isfinite(lobe))
        assert np.all(lobe <= 1)


def test_plain_power_would_not_do():
    axis, tangent, random = frames(1000, seed=1)
    a, b = (v.astype(np.float32) for v in (axis, tilted(axis, tangent, random, 1e6)))
    plain = np.sum(a * b, -1).astype(np.float64) ** 1e6
    assert np.max(np.abs(plain - power(angle(a, b), 1e6))) > 0.01


def test_lobe_in_float64_agrees_with_long_doubles():
    with jax.enable_x64(True):
        for n in EXPONENTS:
            axis, tangent, random = frames(300, seed=4)
            b = tilted(axis, tangent, random, n)
            # 1e-16 of the directions times the slope of the lobe, which is sqrt(n)
            np.testing.assert_allclose(vectors.cosine_lobe(axis, b, n), power(angle(axis, b), n), rtol=0, atol=2e-12)


def test_lobe_tends_to_one_above_the_horizon():
    up, low, below = np.array([0, 0, 1.0]), np.array([1.0, 0, 1e-3]), np.array([1.0, 0, -1e-3])
    assert vectors.cosine_lobe(up, low, 0.0) == 1
    np.testing.assert_allclose(vectors.cosine_lobe(up, low, 1e-6), 1, atol=1e-5)
    assert vectors.cosine_lobe(up, below, 0.0) == 0
    assert vectors.cosine_lobe(up, below, 1e-6) == 0
    assert vectors.log_cosine(up, below) == vectors.BELOW_HORIZON


def test_log_cosine_near_the_horizon_keeps_its_sign_and_digits():
    # float32 rounds the three products of a plain dot product to 6e-8, much more than what is left of it here
    a = np.float32([0.6, 0.8, 1e-8])
    b = np.float32([-0.8, 0.6, 1.0])
    exact = float(a.astype(np.longdouble) @ b.astype(np.longdouble) / np.linalg.norm(b.astype(np.longdouble)))
    np.testing.assert_allclose(np.exp(vectors.log_cosine(a, b)), exact, rtol=1e-3)


def test_lengths_and_directions():
    v = np.array([[3.0, 4.0, 0.0], [0, 0, -2e-30], [1e30, 1e30, 0], [0, 0, 0]], np.float32)
    np.testing.assert_allclose(vectors.norm(v), [5, 2e-30, np.sqrt(2) * 1e30, 0], rtol=1e-6)
    diagonal = np.sqrt(0.5)
    np.testing.assert_allclose(
        vectors.normalize(v), [[0.6, 0.8, 0], [0, 0, -1], [diagonal, diagonal, 0], [0, 0, 0]], rtol=1e-6
    )
    assert vectors.divide(1.0, 0.0) == 0
    np.testing.assert_allclose(vectors.divide(np.array([1.0, 6.0]), [4.0, 3.0]), [0.25, 2.0], rtol=1e-6)


@pytest.mark.parametrize("x64", [False, True])
@pytest.mark.parametrize("mode", [jax.jacfwd, jax.jacrev])
def test_gradient_at_zero_is_zero(mode, x64):
    with jax.enable_x64(x64):
        norm, normalize, divide = (
            jax.jit(mode(one)) for one in (vectors.norm, vectors.normalize, lambda x: vectors.divide(1.0, x))
        )
        zero = jnp.zeros(3)
        light = jnp.array([0.6, 0.0, 0.8])
        np.testing.assert_array_equal(norm(zero), 0)
        np.testing.assert_array_equal(normalize(zero), 0)
        assert divide(0.0) == 0
        assert np.isfinite(norm(1e-37 * light)).all()


@pytest.mark.parametrize("x64", [False, True])
@pytest.mark.parametrize("mode", [jax.jacfwd, jax.jacrev])
def test_lobe_derivatives_are_finite(mode, x64):
    with jax.enable_x64(x64):
        others = [[0, 0, 1], [1, 0, 0], [1, 0, 1e-30], [1, 0, 1e-12], [0.6, 0, 0.8], [0, 0, -1], [0, 0, 0]]
        exponents = [0.0, 1e-3, 0.5, 1.0, 1e6]
        up = jnp.array([0.0, 0.0, 1.0])
        b, n = (jnp.array(v, up.dtype) for v in (others * 5, np.repeat(exponents, 7)))
        derivatives = jax.vmap(mode(vectors.cosine_lobe, argnums=(0, 1, 2)), (None, 0, 0))
        for derivative in jax.jit(derivatives)(up, b, n):
            assert np.isfinite(derivative).all()


def test_mixed_precision_and_integers_are_accepted():
    with jax.enable_x64(True):
        a, b = np.float32([0.6, 0, 0.8]), np.float64([0.6, 0, 0.8])
        for log_cosine in (vectors.half_log_cosine, vectors.mirror_log_cosine):
            np.testing.assert_allclose(log_cosine([0, 0, 1], a, b), log_cosine([0, 0, 1.0], b, b), atol=1e-6)


def test_a_quotient_has_a_number_of_its_own_where_nothing_divides():
    found = vectors.quotient([[1.0, -2.0, 3.0]], np.array([[2.0], [0.0], [-1.0], [np.nan]]))
    np.testing.assert_array_equal(found, [[0.5, -1.0, 1.5], [0, 0, 0], [0, 0, 0], [0, 0, 0]])
    assert vectors.quotient(1.0, np.zeros(()), np.inf) == np.inf
