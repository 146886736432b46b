"""Directions and the cosine lobe: all the risky arithmetic of the toolkit, and nowhere else.

Vectors lie on the last axis (size 3); everything else broadcasts. Directions are unit vectors that point away from the
surface. Every function is finite, in value and in first derivative (forward and reverse mode), for every finite input.

How the lobe stays accurate. A lobe of exponent ``n`` is 1/sqrt(n) wide: 1e-3 rad at n = 1e6, where float32 rounds a
dot product near 1 to 6e-8 and ``pow(dot, n)`` is 6 % off. So the cosine is never formed near its peak. With the cross
and the dot product of the two directions,

    log cos = -1/2 log(1 + |a x b|^2 / (a . b)^2),

which needs no branch, no root and no unit length, and is as accurate as its two products.

Those are formed without rounding where it matters. A vector is split into a leading part on a grid of 2^-11, whose
products and short sums float32 holds exactly, and a small rest (after T. J. Dekker, "A floating-point technique for
extending the available precision", Numer. Math. 18 (1971) 224-242; the fixed grid makes it safe against fused
multiply-adds). The leading part has no derivative, the rest has all of it, and the products are bilinear: so automatic
differentiation gives the derivative of the plain product. In float64 there is nothing to gain, and nothing is split.
"""

import dataclasses
import functools
import math
import operator
from collections.abc import Callable, Iterator
from functools import partialmethod
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from brdf.precision import pytree

BELOW_HORIZON = -1e9
"""What the ``*log_cosine`` functions return where the cosine is not positive: exp(n * this) = 0 for any n > 1e-7."""

_SMALLEST = {np.dtype(np.float32): 1e-18, np.dtype(np.float64): 1e-153}
"""The smallest cosine told from zero: its inverse square is finite."""

Numbers = Float[ArrayLike, "*#batch"]
Scalars = Float[Array, "*batch"]


# -- vectors in components -----------------------------------------------------------------------------------------


def _componentwise(operation: Callable[[Any, Any], Any]) -> Callable[["Components", Any], "Components"]:
    def applied(one: "Components", other: Any) -> "Components":
        parts, others = one.parts, other.parts if isinstance(other, Components) else (other,)
        count = max(len(parts), len(others))
        return Components(tuple(map(operation, parts * (count // len(parts)), others * (count // len(others)))))

    return applied


@pytree
class Components:
    """A vector, or a spectrum, whose components are arrays of their own, which broadcast.

    A loop over thousands of points reads such components in one run each, and is some ten times as fast as one over
    arrays whose last axis is short. What takes vectors here takes these too.

    Attributes:
        parts: the components.
    """

    parts: tuple[Array, ...]
    __array_ufunc__ = None  # an operation with an array of NumPy is ours too

    @classmethod
    def of(cls, vector: Any) -> "Components":
        """The components along an array's last axis."""
        return vector if isinstance(vector, cls) else cls(tuple(jnp.unstack(jnp.asarray(vector), axis=-1)))

    def stacked(self, shape: tuple[int, ...] = ()) -> Array:
        """As an array, the components along its last axis; they are broadcast to a shape."""
        shape = np.broadcast_shapes(shape, *(one.shape for one in self.parts))
        return jnp.stack([jnp.broadcast_to(one, shape) for one in self.parts], axis=-1)

    def __iter__(self) -> Iterator[Array]:
        """Component after component."""
        return iter(self.parts)

    # Of vectors, or of one and a number; a vector of a single component counts for each.
    __add__ = __radd__ = _componentwise(operator.add)
    __sub__ = _componentwise(operator.sub)
    __mul__ = __rmul__ = _componentwise(operator.mul)

    def __rsub__(self, other: Any) -> "Components":
        """The opposite of the difference."""
        return -self + other

    def __neg__(self) -> "Components":
        """The opposite."""
        return self * -1

    def __matmul__(self, other: "Components") -> Array:
        """Scalar product."""
        # The order is fixed, unlike that of a reduction.
        return functools.reduce(operator.add, map(operator.mul, self.parts, other.parts))

    def cross(self, other: "Components") -> "Components":
        """Vector product."""
        (ax, ay, az), (bx, by, bz) = self.parts, other.parts
        return Components((ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx))


Directions = Float[ArrayLike, "*#batch 3"] | Components


def largest(v: Directions) -> Array:
    """The largest component."""
    return functools.reduce(jnp.maximum, Components.of(v))


# -- lengths and directions --------------------------------------------------------------------------------------------


def dot(a: Directions, b: Directions) -> Scalars:
    """Scalar product over the last axis."""
    return Components.of(a) @ Components.of(b)


def normalize(v: Any) -> Any:
    """Unit vectors of the same direction, without underflow or overflow; zero stays zero, with a zero gradient."""
    parts = v if isinstance(v, Components) else Components.of(_floating(v))
    size = jax.lax.stop_gradient(functools.reduce(jnp.maximum, map(jnp.abs, parts)))  # a mere unit: it cancels
    nonzero = size > 4 * jnp.finfo(size.dtype).tiny  # so that 1 / size is finite too
    unscaled = [jnp.where(nonzero, one, 0.0) / jnp.where(nonzero, size, 1.0) for one in parts]
    squared = functools.reduce(operator.add, map(operator.mul, unscaled, unscaled))
    length = jnp.sqrt(jnp.where(nonzero, squared, 1.0))
    # A division last: XLA's CPU compiler repeats all but divisions and roots in each loop that reads them.
    found = Components(tuple(one / length for one in unscaled))
    return found if isinstance(v, Components) else jnp.stack(found.parts, axis=-1)


def norm(v: Directions) -> Scalars:
    """Length of vectors, without underflow or overflow; the gradient at zero is zero, not NaN."""
    return dot(v, normalize(v))


def perpendicular(axis: Any) -> tuple[Any, ...]:
    """Two unit vectors at right angles to a unit vector and to each other; the components lie on the first axis.

    Source: Duff et al., Building an orthonormal basis, revisited, JCGT 6 (2017).
    """
    x, y, z = axis
    sign = jnp.where(z < 0, -1.0, 1.0)
    a = -1.0 / (sign + z)
    b = x * y * a
    across, along = (1.0 + sign * x * x * a, sign * b, -sign * x), (b, sign + y * y * a, -y)
    return tuple(Components(one) if isinstance(axis, Components) else jnp.stack(one) for one in (across, along))


def turned(axis: Components, turn: Array) -> Components:
    """Unit vectors at right angles to unit vectors, turned about these by a share of a whole turn."""
    across, along = perpendicular(axis)
    return across * jnp.cos(2 * math.pi * turn) + along * jnp.sin(2 * math.pi * turn)


def divide(numerator: ArrayLike, denominator: ArrayLike) -> Array:
    """Numerator / denominator where that is positive (above 1e-18 in float32, 1e-153 in float64), else 0."""
    denominator = _floating(denominator)
    positive = denominator > _SMALLEST[denominator.dtype]
    return jnp.where(positive, jnp.asarray(numerator) / jnp.where(positive, denominator, 1.0), 0.0)


def quotient(numerator: Any, denominator: Any, otherwise: float = 0.0) -> Any:
    """In NumPy, without a derivative: numerator / denominator where that is positive, else another number."""
    shape = np.broadcast_shapes(np.shape(numerator), np.shape(denominator))
    return np.divide(numerator, denominator, out=np.full(shape, otherwise), where=denominator > 0)


def square_root(x: ArrayLike) -> Array:
    """Square root where x is positive (above 1e-18 in float32, 1e-153 in float64), else 0."""
    x = _floating(x)
    positive = x > _SMALLEST[x.dtype]
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, x, 1.0)), 0.0)


def _floating(v: ArrayLike) -> Array:
    v = jnp.asarray(v)
    return v.astype(jnp.result_type(v, 1.0))


# -- the lobe ----------------------------------------------------------------------------------------------------------


def cosine_lobe(a: Directions, b: Directions, n: Numbers) -> Scalars:
    """The lobe (a.b)+^n of two directions.

    In float32 within 1e-5 of its exact value for those float32 directions up to n = 1e6. At n = 0 it is 1 above the
    horizon (a.b > 0) and 0 elsewhere.
    """
    return lobe(log_cosine(a, b), n)


def lobe(log_cosine: Numbers, n: Numbers) -> Scalars:
    """The lobe cos^n of a logarithm of the cosine, 0 where that says "below the horizon" (also at n = 0)."""
    log_cosine = jnp.asarray(log_cosine)
    above = log_cosine > 0.5 * BELOW_HORIZON
    return jnp.where(above, jnp.exp(n * jnp.where(above, log_cosine, 0.0)), 0.0)


def log_cosine(a: Directions, b: Directions) -> Scalars:
    """Logarithm of the cosine of the angle between two directions, accurate near the peak and near the horizon."""
    first, second = _split(a, b)
    across = first.cross(second)
    return _from_tangent(across @ across, first @ second)


def half_log_cosine(normal: Directions, to_light: Directions, to_view: Directions) -> Scalars:
    """Logarithm of N.H, of normal and half vector, which is never formed: float32 would round it too coarsely."""
    axis, _, total, _ = _about(normal, to_light, to_view)
    across = axis.cross(total)
    return _from_tangent(across @ across, axis @ total)


def mirror_log_cosine(normal: Directions, to_light: Directions, to_view: Directions) -> Scalars:
    """Logarithm of R.V, of mirror direction and view; never forms the mirror direction.

    With s = L + V and d = L - V the distance to the peak is ‖R - V‖² = ‖N × s‖² + (N.d)², and
    log(R.V) = -log(1 + ‖R - V‖² / (2 R.V)).
    """
    axis, product, total, difference = _about(normal, to_light, to_view)
    along_total, along_difference, across = axis @ total, axis @ difference, axis.cross(total)
    distance = across @ across + along_difference * along_difference
    # R.V |N|^2 = 2 (N.L)(N.V) - (L.V) |N|^2, where 4 (N.L)(N.V) = (N.s)^2 - (N.d)^2
    twice_product = 0.5 * (along_total - along_difference) * (along_total + along_difference)
    cosine = twice_product - product * (axis @ axis)
    # (1 + distance / (2 cos))^2 = 1 + (distance cos + distance^2 / 4) / cos^2
    return _from_tangent(distance * (cosine + 0.25 * distance), cosine)


def log_cosine_of(cosine: Numbers, sine: Numbers) -> Scalars:
    """Logarithm of the cosine of an angle whose cosine and sine are known, accurate also where that is nearly 1."""
    sine = _floating(sine)
    return _from_tangent(sine * sine, _floating(cosine))


@jax.custom_jvp
def _from_tangent(p: Array, q: Array) -> Array:
    """-1/2 log(1 + p / q^2) for p >= 0, ``BELOW_HORIZON`` where q <= 0."""
    above = jnp.maximum(q, _SMALLEST[q.dtype])
    return jnp.maximum(-0.5 * jnp.log1p(jnp.where(q > 0, p / (above * above), jnp.inf)), BELOW_HORIZON)


@_from_tangent.defjvp
def _from_tangent_jvp(primals: tuple[Array, Array], tangents: tuple[Array, Array]) -> tuple[Array, Array]:
    # by hand, because the chain rule through p / q^2 squares that and underflows in float32 near the horizon
    (p, q), (dp, dq) = primals, tangents
    above = jnp.where(q > 0, jnp.maximum(q, _SMALLEST[q.dtype]), 1.0)
    p = jnp.where(q > 0, p, 0.0)
    # p + q^2 = |L + V|^2 vanishes where L = -V; the floor keeps n times its inverse, and that over N.L, finite there
    sum_of_squares = jnp.maximum(p + above * above, 1e-12 if q.dtype == jnp.float32 else 1e-100)
    slope = (p / above * dq - 0.5 * dp) / sum_of_squares
    return _from_tangent(*primals), jnp.where(q > 0, slope, 0.0)


# -- products that float32 does not round ------------------------------------------------------------------------------

_GRID = 2048.0  # products of two leading parts are multiples of 2^-22, so sums of a few stay below 2^24 steps


@dataclasses.dataclass(frozen=True)
class _Split:
    """A float32 vector as an exact sum of a leading part on a coarse grid and a rest.

    Components are kept apart: a compiler that sees (..., 3) arrays stacked again computes each of them three times.
    """

    value: Components
    high: Components
    low: Components

    def __matmul__(self, other: "_Split") -> Array:
        """The scalar product of vectors whose components lie within +-2."""
        rest = Components((*self.high, *self.low)) @ Components((*other.low, *other.value))
        return self.high @ other.high + rest

    def cross(self, other: "_Split") -> Components:
        """The vector product of such."""
        return self.high.cross(other.high) + (self.high.cross(other.low) + self.low.cross(other.value))

    def _with(self, operation: Any, other: "_Split | Components") -> "_Split":
        """Sum or difference; a vector that is not split is a small one."""
        if isinstance(other, Components):
            return _Split(operation(self.value, other), self.high, operation(self.low, other))
        value, high = operation(self.value, other.value), operation(self.high, other.high)
        return _Split(value, high, operation(self.low, other.low))

    __add__, __sub__ = partialmethod(_with, operator.add), partialmethod(_with, operator.sub)


def _split(*vectors: Directions) -> Any:
    """Vectors whose components lie within +-1 in one common floating-point type, float32 in parts."""
    given, found = list(map(Components.of, vectors)), []
    dtype = jnp.result_type(*jax.tree.leaves(given), 1.0)
    for vector in given:
        value = Components(tuple(one.astype(dtype) for one in vector.parts))
        # no derivative: the rest carries it
        high = Components(tuple(map(jnp.round, (value * _GRID).parts))) * (1.0 / _GRID)
        found.append(_Split(value, high, value - high) if dtype == jnp.float32 else value)
    return found


def _about(normal: Directions, to_light: Directions, to_view: Directions) -> tuple[Any, Array, Any, Any]:
    """The normal, L . V, and sum and difference of L and V after giving both one length.

    Rounding makes their lengths differ by 1e-7: by the excess (|L|^2 - |V|^2) / 4 = (s . d) / 4.
    """
    axis, light, view = _split(normal, to_light, to_view)
    total, difference = light + view, light - view
    excess = 0.25 * (difference @ total)
    light, view = light - Components.of(to_light) * excess, view + Components.of(to_view) * excess
    return axis, light @ view, light + view, light - view
