"""Directions and the cosine lobe: all the risky arithmetic of the toolkit, and nowhere else.

Vectors lie on the last axis (size 3); everything else broadcasts. Directions are unit vectors that point away from the
surface. Every function is finite, in value and in first derivative (forward and reverse mode), for every finite input.

How the lobe stays accurate. A lobe of exponent ``n`` is 1/sqrt(n) wide: 1e-3 rad at n = 1e6, where float32 rounds a
dot product near 1 to 6e-8 and ``pow(dot, n)`` is 6 % off. So the cosine is never formed near its peak. With the cross
and the dot product of the two directions,

    log cos = -1/2 log(1 + |a x b|^2 / (a . b)^2),

which needs no branch, no root and no unit length, and is as accurate as its two products. Those are formed
without rounding where it matters, in ``products``.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from brdf import products

BELOW_HORIZON = -1e9
"""What the ``*log_cosine`` functions return where the cosine is not positive: exp(n * this) = 0 for any n > 1e-7."""

Directions = Float[ArrayLike, "*#batch 3"]
Numbers = Float[ArrayLike, "*#batch"]
Vectors = Float[Array, "*batch 3"]
Scalars = Float[Array, "*batch"]


# -- lengths and directions --------------------------------------------------------------------------------------------


def dot(a: Directions, b: Directions) -> Scalars:
    """Scalar product over the last axis.

    Args:
        a: vectors, (..., 3).
        b: vectors, (..., 3).

    Returns:
        (...), the batch shapes broadcast.
    """
    product = jnp.asarray(a) * jnp.asarray(b)
    return product[..., 0] + product[..., 1] + product[..., 2]  # the order is fixed, unlike that of a reduction


def norm(v: Directions) -> Scalars:
    """Length of vectors, without underflow or overflow; the gradient at zero is zero, not NaN.

    Args:
        v: vectors, (..., 3), any length.

    Returns:
        (...), at least 0.
    """
    size, unscaled, length = _scaled(v)
    del unscaled
    return jnp.where(size[..., 0] > 0, size[..., 0] * length[..., 0], 0.0)


def normalize(v: Directions) -> Vectors:
    """Unit vectors of the same direction; zero stays zero, with a zero gradient.

    Args:
        v: vectors, (..., 3), any length.

    Returns:
        (..., 3), of length 1 or 0.
    """
    size, unscaled, length = _scaled(v)
    return jnp.where(size > 0, unscaled / length, 0.0)


def _scaled(v: ArrayLike) -> tuple[Array, Array, Array]:
    """Size (0 where the vector is zero), the vector over its size, and the length of that; safe to divide by."""
    v = _floating(v)
    size = jax.lax.stop_gradient(jnp.max(jnp.abs(v), axis=-1, keepdims=True))  # a mere unit: it cancels
    nonzero = size > 4 * jnp.finfo(v.dtype).tiny  # so that 1 / size is finite too
    unscaled = jnp.where(nonzero, v, 1.0) / jnp.where(nonzero, size, 1.0)
    return jnp.where(nonzero, size, 0.0), unscaled, jnp.sqrt(dot(unscaled, unscaled))[..., None]


def mirror(to_light: Directions, normal: Directions) -> Vectors:
    """Mirror direction 2 (N.L) N - L: where a mirror would send the light.

    Args:
        to_light: unit vectors, (..., 3).
        normal: unit vectors, (..., 3).

    Returns:
        (..., 3), unit vectors.
    """
    normal = jnp.asarray(normal)
    return 2.0 * dot(normal, to_light)[..., None] * normal - jnp.asarray(to_light)


def half_vector(to_light: Directions, to_view: Directions) -> Vectors:
    """Half vector (L + V) / |L + V|; zero, with a zero gradient, where L = -V.

    Args:
        to_light: unit vectors, (..., 3).
        to_view: unit vectors, (..., 3).

    Returns:
        (..., 3), unit vectors or zero.
    """
    return normalize(jnp.asarray(to_light) + jnp.asarray(to_view))


def divide(numerator: ArrayLike, denominator: ArrayLike) -> Array:
    """Numerator / denominator where the denominator is positive, else 0; the gradient is finite everywhere.

    Args:
        numerator: any shape.
        denominator: broadcasts against it. What is below 1e-18 (float32) or 1e-153 (float64) counts as zero.

    Returns:
        The quotient, 0 where the denominator is not positive.
    """
    denominator = _floating(denominator)
    positive = denominator > _smallest(denominator.dtype)
    return jnp.where(positive, jnp.asarray(numerator) / jnp.where(positive, denominator, 1.0), 0.0)


def square_root(x: ArrayLike) -> Array:
    """Square root where x is positive, else 0; the gradient is finite everywhere.

    Args:
        x: any shape. What is below 1e-18 (float32) or 1e-153 (float64) counts as zero.

    Returns:
        The root, at least 0.
    """
    x = _floating(x)
    positive = x > _smallest(x.dtype)
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, x, 1.0)), 0.0)


# -- the lobe ----------------------------------------------------------------------------------------------------------


def cosine_lobe(a: Directions, b: Directions, n: Numbers) -> Scalars:
    """The lobe (a.b)+^n of two directions.

    In float32 within 1e-5 of its exact value for those float32 directions up to n = 1e6. At n = 0 it is 1 above the
    horizon (a.b > 0) and 0 elsewhere.

    Args:
        a: directions, (..., 3); lengths that differ from 1 by rounding do not matter.
        b: directions, (..., 3).
        n: exponent, at least 0, (...).

    Returns:
        (...), from 0 to 1.
    """
    return lobe(log_cosine(a, b), n)


def lobe(log_cosine: Numbers, n: Numbers) -> Scalars:
    """The lobe cos^n of a logarithm of the cosine, 0 where that says "below the horizon" (also at n = 0).

    Args:
        log_cosine: what one of the ``*log_cosine`` functions returned, (...).
        n: exponent, at least 0, (...).

    Returns:
        (...), from 0 to 1.
    """
    log_cosine = jnp.asarray(log_cosine)
    above = log_cosine > 0.5 * BELOW_HORIZON
    return jnp.where(above, jnp.exp(n * jnp.where(above, log_cosine, 0.0)), 0.0)


def log_cosine(a: Directions, b: Directions) -> Scalars:
    """Logarithm of the cosine of the angle between two directions, accurate near the peak and near the horizon.

    Args:
        a: directions, (..., 3).
        b: directions, (..., 3).

    Returns:
        (...), at most 0; ``BELOW_HORIZON`` where a.b <= 0.
    """
    a_, b_ = _split(a, b)
    return _from_tangent(products.cross_squared(a_, b_), products.dot(a_, b_))


def half_log_cosine(normal: Directions, to_light: Directions, to_view: Directions) -> Scalars:
    """Logarithm of N.H, of normal and half vector; never forms the half vector, which float32 would round too coarsely.

    Args:
        normal: unit vectors, (..., 3).
        to_light: unit vectors, (..., 3).
        to_view: unit vectors, (..., 3).

    Returns:
        (...), at most 0; ``BELOW_HORIZON`` where N.H <= 0 or L = -V.
    """
    normal_, light, view = _split(normal, to_light, to_view)
    total, _ = products.sum_and_difference(light, view)
    return _from_tangent(products.cross_squared(normal_, total), products.dot(normal_, total))


def mirror_log_cosine(normal: Directions, to_light: Directions, to_view: Directions) -> Scalars:
    """Logarithm of R.V, of mirror direction and view; never forms the mirror direction.

    With s = L + V and d = L - V the distance to the peak is |R - V|^2 = |N x s|^2 + (N.d)^2, and
    log(R.V) = -log(1 + |R - V|^2 / (2 R.V)).

    Args:
        normal: unit vectors, (..., 3).
        to_light: unit vectors, (..., 3).
        to_view: unit vectors, (..., 3).

    Returns:
        (...), at most 0; ``BELOW_HORIZON`` where R.V <= 0.
    """
    normal_, light, view = _split(normal, to_light, to_view)
    total, difference = products.sum_and_difference(light, view)
    along_total, along_difference = products.dot(normal_, total), products.dot(normal_, difference)
    distance = products.cross_squared(normal_, total) + along_difference * along_difference
    # R.V |N|^2 = 2 (N.L)(N.V) - (L.V) |N|^2, where 4 (N.L)(N.V) = (N.s)^2 - (N.d)^2
    twice_product = 0.5 * (along_total - along_difference) * (along_total + along_difference)
    cosine = twice_product - products.dot(light, view) * products.dot(normal_, normal_)
    above = jnp.maximum(cosine, _smallest(cosine.dtype))
    return jnp.where(cosine > 0, -_log1p_ratio(0.5 * distance, above), BELOW_HORIZON)


def log_cosine_of(cosine: Numbers, sine: Numbers) -> Scalars:
    """Logarithm of the cosine of an angle whose cosine and sine are known, accurate also where the cosine is nearly 1.

    Args:
        cosine: (...).
        sine: (...).

    Returns:
        (...), at most 0; ``BELOW_HORIZON`` where the cosine is not positive.
    """
    sine = _floating(sine)
    return _from_tangent(sine * sine, _floating(cosine))


def _from_tangent(cross_squared: Scalars, along: Scalars) -> Scalars:
    above = jnp.maximum(along, _smallest(along.dtype))
    return jnp.where(along > 0, -0.5 * _log1p_ratio(cross_squared, above * above), BELOW_HORIZON)


@jax.custom_jvp
def _log1p_ratio(p: Array, q: Array) -> Array:
    """log(1 + p / q) for p >= 0, q > 0."""
    return jnp.log1p(p / q)


@_log1p_ratio.defjvp
def _log1p_ratio_jvp(primals: tuple[Array, Array], tangents: tuple[Array, Array]) -> tuple[Array, Array]:
    # by hand, because the chain rule through p / q squares q and underflows in float32 near the horizon
    (p, q), (dp, dq) = primals, tangents
    # p + q = |L + V|^2 vanishes where L = -V; the floor keeps n times its inverse, and that over N.L, finite there
    ratio, inverse = p / q, 1.0 / jnp.maximum(p + q, 1e-12 if q.dtype == jnp.float32 else 1e-100)
    return jnp.log1p(ratio), (dp - ratio * dq) * inverse


def _split(*vectors: ArrayLike) -> list[products.Split]:
    """The vectors in one common floating-point type, split for ``products``."""
    dtype = jnp.result_type(*(_floating(v) for v in vectors))
    return [products.split(_floating(v).astype(dtype)) for v in vectors]


def _floating(v: ArrayLike) -> Array:
    v = jnp.asarray(v)
    return v if jnp.issubdtype(v.dtype, jnp.floating) else v.astype(jnp.result_type(float))


def _smallest(dtype: Any) -> float:
    """The smallest cosine told from zero: its inverse square is finite."""
    return 1e-18 if jnp.finfo(dtype).bits <= 32 else 1e-153
