"""Products of directions that float32 does not round: for the cosine lobe in ``vectors``, which says why.

A vector is split into a leading part on a grid of 2^-11, whose products and short sums float32 holds exactly, and a
small rest (after T. J. Dekker, "A floating-point technique for extending the available precision", Numer. Math. 18
(1971) 224-242; the fixed grid makes it safe against fused multiply-adds). The leading part has no derivative, the rest
has all of it, and the products are bilinear: so automatic differentiation gives the derivative of the plain product. In
float64 there is nothing to gain, and nothing is split.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array

# Components are kept apart here: a compiler that sees (..., 3) arrays stacked again computes each of them three times.
Components = tuple[Array, Array, Array]

_GRID = 2048.0  # products of two leading parts are multiples of 2^-22, so sums of a few stay below 2^24 steps


class Split(NamedTuple):
    """A vector as an exact sum of a leading part on a coarse grid and a rest; in float64 the leading part is all."""

    value: Components
    high: Components
    low: Components | None


def split(v: Array) -> Split:
    """The parts of vectors (..., 3) whose components lie within +-1."""
    value = (v[..., 0], v[..., 1], v[..., 2])
    if v.dtype != jnp.float32:
        return Split(value, value, None)
    high = _each(lambda x: jnp.round(x * _GRID) * (1.0 / _GRID), value)  # has no derivative: the rest carries it
    return Split(value, high, _each(jnp.subtract, value, high))


def _each(function: Callable[..., Array], *vectors: Components) -> Components:
    x, y, z = (function(*components) for components in zip(*vectors, strict=True))
    return x, y, z


def dot(a: Split, b: Split) -> Array:
    """Scalar product of vectors whose components lie within +-2."""
    if a.low is None or b.low is None:
        return _plain_dot(a.value, b.value)
    return _plain_dot(a.high, b.high) + (_plain_dot(a.high, b.low) + _plain_dot(a.low, b.value))


def cross_squared(a: Split, b: Split) -> Array:
    """Squared length of the cross product of vectors whose components lie within +-2."""
    cross = _plain_cross(a.high, b.high)
    if a.low is not None and b.low is not None:
        rest = _each(jnp.add, _plain_cross(a.high, b.low), _plain_cross(a.low, b.value))
        cross = _each(jnp.add, cross, rest)
    return _plain_dot(cross, cross)


def sum_and_difference(a: Split, b: Split) -> tuple[Split, Split]:
    """Sum and difference of two unit vectors, after giving them one length: rounding makes those differ by 1e-7."""
    total, difference = _combine(jnp.add, a, b), _combine(jnp.subtract, a, b)
    excess = 0.25 * dot(difference, total)  # (|a|^2 - |b|^2) / 4: a shrinks by that and b grows
    return _shorten(total, difference, excess), _shorten(difference, total, excess)


def _combine(operation: Callable[[Array, Array], Array], a: Split, b: Split) -> Split:
    low = None if a.low is None or b.low is None else _each(operation, a.low, b.low)
    return Split(_each(operation, a.value, b.value), _each(operation, a.high, b.high), low)


def _shorten(a: Split, b: Split, factor: Array) -> Split:
    """The vector a - factor b, for a small factor."""
    value = _each(lambda x, y: x - factor * y, a.value, b.value)
    if a.low is None:
        return Split(value, value, None)
    return Split(value, a.high, _each(lambda x, y: x - factor * y, a.low, b.value))


def _plain_dot(a: Components, b: Components) -> Array:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _plain_cross(a: Components, b: Components) -> Components:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
