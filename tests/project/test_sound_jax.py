"""The installed JAX adds up rightly: jaxlib 0.10.2 does not, on the CPU and without a word (jax-ml/jax issue 39103)."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from brdf.precision import UNSOUND, warn_of_unsound

# Relative to the sum of sizes: what adding in blocks may cost.
TOLERANCE = {"float32": 1e-5, "float64": 1e-13}


@pytest.mark.parametrize("precision", TOLERANCE)
@pytest.mark.parametrize("shape", [(32, 8192), (16, 32, 8192), (2048, 3, 4)])
def test_sums_of_products(shape, precision):
    random = np.random.default_rng(0)
    a, b = random.standard_normal((2, *shape)).astype(precision)
    with jax.enable_x64(precision == "float64"):
        found = np.asarray(jax.jit(lambda a, b: (a * b).sum(1))(a, b))
    a, b = a.astype(np.float64), b.astype(np.float64)
    assert np.all(np.abs(found - (a * b).sum(1)) <= TOLERANCE[precision] * np.abs(a * b).sum(1))


@pytest.mark.parametrize("precision", TOLERANCE)
@pytest.mark.parametrize("rows", [16_385, 40_000])
def test_squares_of_many_small_products(rows, precision):
    """Fails on jaxlib 0.10.2 in both precisions."""
    x = np.random.default_rng(0).standard_normal((rows, 3)).astype(precision)
    matrix = np.random.default_rng(1).standard_normal((3, 3)).astype(precision)
    with jax.enable_x64(precision == "float64"):
        found = np.asarray(jax.jit(jax.vmap(lambda row: jnp.sum((matrix @ row) ** 2)))(x))
    right = np.sum((x.astype(np.float64) @ matrix.T.astype(np.float64)) ** 2, axis=1)
    size = np.sum((np.abs(x.astype(np.float64)) @ np.abs(matrix.T.astype(np.float64))) ** 2, axis=1)
    assert np.all(np.abs(found - right) <= TOLERANCE[precision] * size)


@pytest.mark.parametrize("version", UNSOUND)
def test_an_unsound_version_is_told(version):
    with pytest.warns(RuntimeWarning, match=version):
        warn_of_unsound(version)
