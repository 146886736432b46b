"""What a pixel says: its value before rounding lay between two bounds. Likelihood, score and weight of a prediction.

A file holds codes. A code c says that what it stands for, in codes and before rounding, lay in [c - w, c + w]; the
largest code has no upper bound and 0 no lower one, which is all that clipping and cut-off noise need. With the
prediction z in codes and noise of standard deviation s (before rounding) the probability of an interval is

    P(lower, upper | z, s) = Phi((upper - z) / s) - Phi((lower - z) / s).

Newton's method needs of each pixel its score d log P / dz and its weight -d2 log P / dz2: where least squares takes
the residual over the variance and one over the variance. Both follow from the mean and the variance of a normal number
t known to lie in the interval (a truncated normal distribution): score = E[t] / s, weight = (1 - Var[t]) / s², so the
weight lies between 0 and 1 / s².

The interval is turned so that its middle is not below the prediction, x1 = near end, x2 = far end, in units of s, and
three ways to the same numbers each avoid the differences that the others would take:

* x1 <= 0, the prediction lies inside: erf of both ends add up, and so do all terms of the weight.
* x1 > 0 and the density falls by less than exp(3) across: Gauss-Legendre quadrature about the middle.
* else the far end hardly counts: Mills' ratio Q / phi as a continued fraction, from which the difference that the
  weight needs comes without cancellation.

Sources: A. Cohen, Ann. Math. Statist. 21 (1950) 557, moments of the truncated normal distribution; Abramowitz and
Stegun 26.2.14, the continued fraction.
"""

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from brdf.images.encoding import Encoding

# Distances in units of s beyond which nothing changes; squares of it stay within float32.
_FAR = 1e18
# Across this many powers of e ten nodes integrate the density to 1e-12.
_STEEP, _WIDE = 3.0, 2.5
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(10)
# Terms of the continued fraction: enough for 1e-13 from _SERIES on.
_TERMS = 24
_SERIES = 4.0
# Tables reach so far inside an end and beyond it, in units of s.
_INSIDE, _OUTSIDE, _KNOTS = 9.0, 14.0, 2048
_LOG_ROOT_TWO_PI = 0.5 * math.log(2.0 * math.pi)


# On the host or on the device.
AnyArray: TypeAlias = jax.Array | np.ndarray


class Bounds(eqx.Module):
    """Between which codes the values of a picture lay before rounding.

    Attributes:
        lower: lower end, minus infinity where it is open.
        upper: upper end, infinity where it is open.
        scale: codes where the encoding is 1.
        unit: radiance where the encoding is 1, a number or (C,).
        index: of each pixel in its picture, row by row.
        width: of the picture.
        spread: noise of each pixel over that of the picture, a number or (P, 1).
        encoding: "linear", "srgb" or a gamma.
        lossy: neighbours share errors.
        exact: no rounding: where both ends are there they are the same.
    """

    lower: Float[Array, "P C"]
    upper: Float[Array, "P C"]
    scale: Float[Array, ""] | Float[np.ndarray, ""]
    unit: Float[Array, "*C"] | Float[np.ndarray, "*C"]
    index: Int[AnyArray, " P"]
    width: Int[AnyArray, ""]
    spread: Float[Array, "*P"] | Float[np.ndarray, ""]
    encoding: Encoding = eqx.field(static=True)
    lossy: bool = eqx.field(static=True)
    exact: bool = eqx.field(static=True, default=False)

    def codes(self, radiance: Float[Array, "*shape"]) -> tuple[Float[Array, "*shape"], Float[Array, "*shape"]]:
        """Predictions in codes before rounding, and their derivative by radiance."""
        light, scale = radiance / self.unit, self.scale / self.unit
        if self.encoding == "linear":
            return light * self.scale, jnp.broadcast_to(scale, radiance.shape)
        if self.encoding == "srgb":
            bright = light > 0.0031308
            base, power = jnp.where(bright, light, 1.0), 1.0 / 2.4
            curved = 1.055 * base**power
            code = jnp.where(bright, curved - 0.055, 12.92 * light)
            return code * self.scale, jnp.where(bright, power * curved / base, 12.92) * scale
        # A power is infinitely steep at 0; below a quarter of a code it goes on straight, to no code's edge.
        power = 1.0 / self.encoding
        least = (0.25 / self.scale) ** self.encoding
        base = jnp.maximum(light, least)
        curved = base**power
        slope = power * curved / base
        return (curved + slope * jnp.minimum(light - least, 0.0)) * self.scale, slope * scale

    def pixels(self, choose: Callable[[Any], Array]) -> "Bounds":
        """Those of some pixels."""
        lower, upper, index = choose(self.lower), choose(self.upper), choose(self.index)
        spread = choose(self.spread) if self.spread.ndim else self.spread
        return dataclasses.replace(self, lower=lower, upper=upper, index=index, spread=spread)

    def said(self, code: Float[Array, "P C"], s: Float[Array, ""]) -> "LogLikelihood":
        """What the values say of predicted codes, with noise of standard deviation ``s``."""
        return interval(self.lower, self.upper, code, s * self.spread)


class LogLikelihood(NamedTuple):
    """What pixels say of a prediction.

    Attributes:
        value: logarithm of the probability.
        score: its derivative by the prediction.
        weight: minus its second derivative, 0 to 1 / s².
    """

    value: Float[AnyArray, "*shape"]
    score: Float[AnyArray, "*shape"]
    weight: Float[AnyArray, "*shape"]


def interval(
    lower: Float[Array, "*shape"], upper: Float[Array, "*shape"], predicted: Float[Array, "*shape"], s: Float[Array, ""]
) -> LogLikelihood:
    """The log-likelihood of values known to lie in an interval.

    Args:
        lower: its lower end, minus infinity for an open one.
        upper: its upper end, above the lower one; infinity for an open one.
        predicted: z, in the same units.
        s: standard deviation of the noise before rounding, above 0.
    """
    a = jnp.clip((lower - predicted) / s, -_FAR, _FAR)
    b = jnp.clip((upper - predicted) / s, -_FAR, _FAR)
    above = a + b >= 0
    near, far = jnp.where(above, a, -b), jnp.where(above, b, -a)
    width = jnp.clip((upper - lower) / s, 0.0, 2 * _FAR)
    middle = 0.5 * (near + far)
    decay = width * jnp.minimum(middle, _FAR)
    narrow, inside = (decay <= _STEEP) & (width <= _WIDE), near <= 0
    ends = _Ends(near), _Ends(far)
    by_quadrature = _narrow(jnp.where(narrow, middle, 1.0), jnp.where(narrow, width, 1.0))
    value, mean, weight = (
        jnp.where(narrow, one, jnp.where(inside, two, three))
        for one, two, three in zip(
            by_quadrature,
            _around(*ends, decay, ~narrow & inside),
            _beyond(*ends, width, decay, narrow | inside),
            strict=True,
        )
    )
    return LogLikelihood(value, jnp.where(above, mean, -mean) / s, weight / (s * s))


class Table:
    """The log-likelihood of intervals of one width, tabulated over the prediction: for millions of values on the host.

    Cubic between knots where the derivative is at hand, which is right to 1e-8; beyond the last knot the first terms of
    the tail's series, right to 1e-6 of it.

    Attributes:
        half: half the width, in units of s; 0 for an interval with one end.
    """

    def __init__(self, ratio: float):
        """Tabulate.

        Args:
            ratio: width over s; infinite for an interval with one end.
        """
        finite = math.isfinite(ratio)
        self.half = 0.5 * ratio if finite else 0.0
        self._first = -min(self.half, _INSIDE) if finite else -_INSIDE
        self._step = (_OUTSIDE - self._first) / (_KNOTS - 1)
        with jax.enable_x64(True):
            # Distance beyond the upper end.
            beyond = jnp.linspace(self._first, _OUTSIDE, _KNOTS)
            lower = jnp.full(_KNOTS, -ratio if finite else -jnp.inf)
            parts = _interval(lower, jnp.zeros(_KNOTS), beyond, jnp.ones(()))
        self._value, self._score, self._weight = (np.asarray(part) for part in parts)

    def __call__(self, beyond: Float[np.ndarray, " K"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Value, score by the distance and weight.

        Args:
            beyond: distance of the predictions beyond the nearer end, below 0 inside, in units of s.
        """
        position = np.clip((beyond - self._first) / self._step, 0.0, _KNOTS - 1.000001)
        index = position.astype(np.intp)
        share, step = position - index, self._step
        value = _hermite(self._value, self._score * step, index, share)
        score = _hermite(self._score, -self._weight * step, index, share)
        weight = self._weight[index] + share * (self._weight[index + 1] - self._weight[index])
        inside = beyond < self._first
        if inside.any():
            value[inside], score[inside], weight[inside] = 0.0, 0.0, 0.0
        tail = beyond > _OUTSIDE
        if tail.any():
            x = beyond[tail]
            square = x * x
            value[tail] = -0.5 * square - np.log(x) - _LOG_ROOT_TWO_PI + np.log1p((3 / square - 1) / square)
            score[tail] = -(x + (1 - 2 / square) / x)
            weight[tail] = 1 - (1 - 6 / square) / square
        return value, score, weight


def _hermite(values: np.ndarray, slopes: np.ndarray, index: np.ndarray, share: np.ndarray) -> np.ndarray:
    low, high, start, end = values[index], values[index + 1], slopes[index], slopes[index + 1]
    rise = high - low
    return low + share * (start + share * (3 * rise - 2 * start - end + share * (start + end - 2 * rise)))


table = functools.lru_cache(maxsize=64)(Table)


def tabulated(
    lower: Float[np.ndarray, "P C"], upper: Float[np.ndarray, "P C"], predicted: Float[np.ndarray, "P C"], s: float
) -> LogLikelihood | None:
    """`interval` of values on the host, from tables; None where widths are not those of codes or floating point.

    Args:
        lower: its lower end, minus infinity for an open one.
        upper: its upper end, infinity for an open one.
        predicted: z.
        s: standard deviation of the noise.
    """
    below, above = np.isfinite(lower), np.isfinite(upper)
    closed = below & above
    width = np.subtract(upper, lower, out=np.where(below ^ above, np.inf, 0.0), where=closed)
    mantissa, exponent = np.frexp(width)
    if closed.any() and np.ptp(mantissa[closed]) > 1e-6:
        return None
    value, score, weight = np.zeros(width.shape), np.zeros(width.shape), np.zeros(width.shape)
    high, low = np.where(above, upper, 0.0), np.where(below, lower, 0.0)
    up = above & ~(below & (high + low > 2 * predicted))
    beyond = np.where(up, predicted - high, low - predicted) / s
    kinds = [np.inf, *(mantissa[closed].mean() * 2.0**power for power in np.unique(exponent[closed]))]
    for kind in kinds:
        some = np.isinf(width) if np.isinf(kind) else closed & (np.abs(width - kind) < 1e-3 * kind)
        if some.any():
            value[some], score[some], weight[some] = table(float(kind / s))(beyond[some])
    return LogLikelihood(value, np.where(up, score, -score) / s, weight / s**2)


class _Ends:
    """An end of the interval: x, the normal tail beyond |x|, the density there."""

    def __init__(self, x: Array):
        self.x = x
        self.tail = 0.5 * jax.scipy.special.erfc(jnp.abs(x) * math.sqrt(0.5))
        self.density = jnp.exp(-0.5 * x * x - _LOG_ROOT_TWO_PI)

    def mills(self) -> tuple[Array, Array]:
        """Mills' ratio R = Q(x) / phi(x), and 1 - x R, for x > 0."""
        large = self.x > _SERIES
        at = jnp.where(large, self.x, _SERIES)
        # 1 / R = x + 1 / (x + 2 / (x + 3 / ...)); what follows the first x is (1 - x R) / R.
        tail = jax.lax.fori_loop(0, _TERMS - 1, lambda i, tail: at + (_TERMS - i) / tail, at)
        far = 1.0 / (at + 1.0 / tail)
        near = self.tail / jnp.where(large, 1.0, self.density)
        return jnp.where(large, far, near), jnp.where(large, far / tail, 1.0 - self.x * near)


_interval = jax.jit(interval)


def _around(near: _Ends, far: _Ends, decay: Array, holds: Array) -> tuple[Array, Array, Array]:
    """Logarithm of P, mean, 1 - variance, for x1 <= 0 <= x2."""
    outside = jnp.where(holds, near.tail + far.tail, 0.25)
    mass = 1.0 - outside
    mean = -near.density / mass * jnp.expm1(-jnp.where(holds, decay, 0.0))
    return jnp.log1p(-outside), mean, mean * mean + (far.x * far.density - near.x * near.density) / mass


def _narrow(middle: Array, width: Array) -> tuple[Array, Array, Array]:
    """The same by quadrature about the middle."""

    def add(index: Array, sums: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        node, part = jnp.asarray(_NODES, middle.dtype)[index], jnp.asarray(_WEIGHTS, middle.dtype)[index]
        # From the near end, where the density is largest.
        offset = 0.5 * width * (1.0 + node)
        density = 0.5 * part * jnp.exp(-offset * (middle - 0.5 * width + 0.5 * offset))
        shift = 0.5 * width * node
        return sums[0] + density, sums[1] + density * shift, sums[2] + density * shift * shift

    zero = jnp.zeros_like(middle)
    total, first, second = jax.lax.fori_loop(0, len(_NODES), add, (zero, zero, zero))
    shift = first / total
    near = middle - 0.5 * width
    value = jnp.log(width * total) - 0.5 * near * near - _LOG_ROOT_TWO_PI
    return value, middle + shift, 1.0 - (second / total - shift * shift)


def _beyond(near: _Ends, far: _Ends, width: Array, decay: Array, fails: Array) -> tuple[Array, Array, Array]:
    """The same where the far end counts less; another interval stands in where that fails."""
    near, far = _Ends(jnp.where(fails, 1.0, near.x)), _Ends(jnp.where(fails, 9.0, far.x))
    (mills1, rest1), (mills2, rest2) = near.mills(), far.mills()
    left = jnp.exp(-jnp.where(fails, 40.0, decay))
    mass = mills1 - mills2 * left
    value = jnp.log(mass) - 0.5 * near.x**2 - _LOG_ROOT_TWO_PI
    beyond = jnp.where(left > 0, jnp.minimum(width, _FAR) * (mills1 - mills2) - rest1 - rest2, 0.0)
    return value, (1.0 - left) / mass, (rest1 + left * beyond + left * left * rest2) / mass**2
