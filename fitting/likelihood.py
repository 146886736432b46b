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
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from brdf.images.encoding import Encoding, decode

# Predictions are the same to such a share of a code, where these are so many values, or so many of one code, and so
# many times as usual.
ALIKE, FEWEST_ALIKE, FEWEST_LEVEL, MORE_ALIKE, MOST_COUNTED = 1024, 64, 16, 10, 1 << 20
# A picture of fewer different predictions is one of planes.
MOST_LEVELS = 32
# Distances in units of s beyond which nothing changes.
_FAR = 1e18
# Across this many powers of e ten nodes integrate the density to 1e-12.
_STEEP, _WIDE = 3.0, 2.5
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(10)
# Terms of the continued fraction: enough for 1e-13 from _SERIES on.
_TERMS = 24
_SERIES = 4.0
# Tables reach so far inside an end and beyond it, in units of s.
_INSIDE, _OUTSIDE, _KNOTS = 9.0, 14.0, 2048
# Widths are powers of two of each other to this share.
_ALIKE = 1e-6
_LOG_ROOT_TWO_PI = 0.5 * math.log(2.0 * math.pi)


# On the host or on the device.
AnyArray: TypeAlias = jax.Array | np.ndarray


def encoded_and_slope(light: AnyArray, encoding: Encoding, steps: Any) -> tuple[Any, Any]:
    """Linear light as it is encoded, and the derivative of that; on the host where the light is.

    There are so many ``steps`` of codes where light and encoding are 1.
    """
    xp: Any = np if isinstance(light, np.ndarray) else jnp
    if encoding == "linear":
        return light, xp.ones_like(light)
    if encoding == "srgb":
        bright, power = light > 0.0031308, 1.0 / 2.4
        all_bright = xp is np and bright.all()
        base = light if all_bright else xp.where(bright, light, 1.0)
        curved = 1.055 * _raised(base, power)
        encoded, slope = curved - 0.055, power * curved / base
        if all_bright:
            return encoded, slope
        return xp.where(bright, encoded, 12.92 * light), xp.where(bright, slope, 12.92)
    # A power is infinitely steep at 0; below a quarter of a code it goes on straight, to no code's edge.
    power = 1.0 / encoding
    least = (0.25 / steps) ** encoding
    base = xp.maximum(light, least)
    curved = _raised(base, power)
    slope = power * curved / base
    return curved + slope * xp.minimum(light - least, 0.0), slope


def _raised(base: AnyArray, power: float) -> Any:
    """Numbers above 0 to a power, by the exponential of the logarithm: a power takes up to three times as long."""
    if not isinstance(base, np.ndarray):
        return jnp.exp(power * jnp.log(base))
    found = np.asarray(np.log(base))
    found *= power
    return np.exp(found, out=found)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, eq=False)
class Bounds:
    """Between which codes the values of a picture lay before rounding.

    Attributes:
        lower: lower end, minus infinity where it is open.
        upper: upper end, infinity where it is open.
        scale: codes where the encoding is 1.
        unit: radiance where the encoding is 1, a number or (C,).
        index: of each pixel in its picture, row by row.
        width: of the picture.
        spread: noise of each value over that of the picture, a number, (P, 1) or (P, C).
        encoding: "linear", "srgb" or a gamma.
        lossy: neighbours share errors.
        exact: no rounding: where both ends are there they are the same.
    """

    lower: Float[np.ndarray, "P C"]
    upper: Float[np.ndarray, "P C"]
    scale: Float[np.ndarray, ""]
    unit: Float[np.ndarray, "*C"]
    index: Int[np.ndarray, " P"]
    width: Int[np.ndarray, ""]
    spread: Float[np.ndarray, "*P_C"]
    encoding: Encoding = dataclasses.field(default="linear", metadata={"static": True})
    lossy: bool = dataclasses.field(default=False, metadata={"static": True})
    exact: bool = dataclasses.field(default=False, metadata={"static": True})

    def codes(self, radiance: Float[AnyArray, "*shape"]) -> tuple[Any, Any]:
        """Predictions in codes before rounding, and their derivative by radiance; on the host where these are."""
        xp: Any = np if isinstance(radiance, np.ndarray) else jnp
        unit, steps = (xp.asarray(part, radiance.dtype) for part in (self.unit, self.scale))
        light, scale = radiance / unit, steps / unit
        encoded, slope = encoded_and_slope(light, self.encoding, steps)
        return encoded * steps, slope * scale

    @property
    def widths(self) -> Float[np.ndarray, " K"]:
        """Distances of the ends, of values that have both."""
        return (self.upper - self.lower)[self.ends == 2]

    @property
    def ends(self) -> UInt8[np.ndarray, "P C"]:
        """How many ends of each value are known: none, one or both."""
        return np.isfinite(self.lower).astype(np.uint8) + np.isfinite(self.upper)

    def in_light(self, size: float = 1.0) -> "Bounds":
        """The same ends in linear light, ``size`` being the unit, as a share of white."""
        steps = float(self.scale)
        lower, upper = (
            np.where(np.isfinite(end), decode(np.where(np.isfinite(end), end, 0.0) / steps, self.encoding) / size, end)
            for end in (self.lower, self.upper)
        )
        return dataclasses.replace(self, lower=lower, upper=upper, scale=np.asarray(1 / size), encoding="linear")

    def near(self, code: Float[np.ndarray, "P C"], distance: float) -> Bool[np.ndarray, " P"]:
        """Which pixels have a value that is predicted, before rounding, beyond an end or near it.

        The distance is that where the noise is that of the picture.
        """
        inside = np.minimum(code - self.lower, self.upper - code)
        return over_channels(np.logical_or, inside < distance * self.spread)

    @property
    def half_open(self) -> Bool[np.ndarray, " P"]:
        """Which pixels have a value of which one end is known."""
        return over_channels(np.logical_or, self.ends == 1)

    @property
    def place(self) -> tuple[Int[np.ndarray, " P"], int]:
        """Index of the pixels in their picture, and its width."""
        return np.asarray(self.index), int(self.width)

    def pixels(self, choose: Callable[[Any], Any]) -> "Bounds":
        """Those of some pixels."""
        lower, upper, index = choose(self.lower), choose(self.upper), choose(self.index)
        spread = choose(self.spread) if self.spread.ndim else self.spread
        return dataclasses.replace(self, lower=lower, upper=upper, index=index, spread=spread)


def over_channels(combine: Callable[[Any, Any], Any], values: AnyArray) -> Any:
    """Of each pixel's values, (P, C), one, on the host or the device.

    A reduction over so short an axis would take fifteen times as long.
    """
    return functools.reduce(combine, [values[:, channel] for channel in range(values.shape[1])])


def is_curved(bounds: Sequence[Bounds]) -> bool:
    """Whether rounded values are not linear in light, and some have both ends."""
    curved = any(own.encoding != "linear" and own.widths.size for own in bounds)
    return curved and not any(own.exact for own in bounds)


def in_light(bounds: Sequence[Bounds]) -> list[Bounds]:
    """The same ends in linear light, for noise that came before the encoding: that of a camera or a path tracer.

    The unit is their median distance in all pictures, or noise of one size would be another one in each.
    """
    size = float(np.median(np.concatenate([own.in_light().widths for own in bounds])))
    return [own.in_light(size) for own in bounds]


def residual_deviation(bounds: Iterable[Bounds], codes: Iterable[Float[np.ndarray, "P C"]]) -> float:
    """Standard deviation of what predictions leave of values with both ends, in codes."""
    squares, count = 0.0, 0
    for own, code in zip(bounds, codes, strict=True):
        closed = own.ends == 2
        middle = 0.5 * np.add(own.lower, own.upper, out=np.zeros(closed.shape), where=closed)
        left = np.where(closed, middle - code, 0.0) / own.spread
        squares, count = squares + float(np.sum(left**2)), count + int(np.count_nonzero(closed))
    return math.sqrt(squares / max(count, 1))


class LogLikelihood(NamedTuple):
    """What pixels say of a prediction.

    Attributes:
        value: logarithm of the probability.
        score: its derivative by the prediction.
        weight: minus its second derivative, 0 to 1 / s².
    """

    value: Float[np.ndarray, "*shape"]
    score: Float[np.ndarray, "*shape"]
    weight: Float[np.ndarray, "*shape"]


# NumPy has no erfc; that of the standard library is for single numbers.
_each_erfc = np.frompyfunc(math.erfc, 1, 1)


def _tail(x: np.ndarray) -> np.ndarray:
    """Of the normal distribution beyond x."""
    return 0.5 * np.asarray(_each_erfc(x * math.sqrt(0.5)), np.float64)


def _density(x: np.ndarray) -> np.ndarray:
    return np.exp(-0.5 * x * x - _LOG_ROOT_TWO_PI)


def _mills(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mills' ratio R = Q(x) / phi(x), and 1 - x R, for x > 0."""
    small, large = np.minimum(x, _SERIES), np.maximum(x, _SERIES)
    # 1 / R = x + 1 / (x + 2 / (x + 3 / ...)); what follows the first x is (1 - x R) / R.
    tail = large
    for term in range(_TERMS, 1, -1):
        tail = large + term / tail
    complement = np.asarray(_each_erfc(small * math.sqrt(0.5)), np.float64)
    near, far = math.sqrt(0.5 * math.pi) * np.exp(0.5 * small * small) * complement, 1.0 / (large + 1.0 / tail)
    return np.where(x > _SERIES, far, near), np.where(x > _SERIES, far / tail, 1.0 - small * near)


def _around(near: np.ndarray, far: np.ndarray, width: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Logarithm of P, mean, 1 - variance, for x1 <= 0 <= x2."""
    outside = _tail(-near) + _tail(far)
    mass = 1.0 - outside
    mean = -_density(near) / mass * np.expm1(-0.5 * width * (near + far))
    return np.log1p(-outside), mean, mean * mean + (far * _density(far) - near * _density(near)) / mass


def _narrow(near: np.ndarray, far: np.ndarray, width: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The same by quadrature about the middle."""
    middle = 0.5 * (near + far)
    total = first = second = np.zeros_like(middle)
    for node, part in zip(_NODES.tolist(), _WEIGHTS.tolist(), strict=True):
        # From the near end, where the density is largest.
        offset, shift = 0.5 * width * (1.0 + node), 0.5 * width * node
        density = 0.5 * part * np.exp(-offset * (middle - 0.5 * width + 0.5 * offset))
        total, first, second = total + density, first + density * shift, second + density * shift * shift
    shift = first / total
    near = middle - 0.5 * width
    value = np.log(width * total) - 0.5 * near * near - _LOG_ROOT_TWO_PI
    return value, middle + shift, 1.0 - (second / total - shift * shift)


def _beyond(near: np.ndarray, far: np.ndarray, width: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The same where the far end counts less."""
    (mills1, rest1), (mills2, rest2) = _mills(near), _mills(far)
    # Of the density at the near end.
    left = np.exp(-0.5 * width * (near + far))
    mass = mills1 - mills2 * left
    value = np.log(mass) - 0.5 * near**2 - _LOG_ROOT_TWO_PI
    beyond = width * (mills1 - mills2) - rest1 - rest2
    return value, (1.0 - left) / mass, (rest1 + left * beyond + left * left * rest2) / mass**2


def interval(
    lower: Float[np.ndarray, "*shape"],
    upper: Float[np.ndarray, "*shape"],
    predicted: Float[np.ndarray, "*shape"],
    s: Float[np.ndarray, "*shape"],
) -> LogLikelihood:
    """The log-likelihood of values known to lie in an interval; infinite ends are open.

    ``s`` is the standard deviation of the noise before rounding, above 0, in the units of ends and predictions.
    """
    a, b = (np.clip((end - predicted) / s, -_FAR, _FAR) for end in (lower, upper))
    above = a + b >= 0
    near, far = np.where(above, a, -b), np.where(above, b, -a)
    width = np.clip((upper - lower) / s, 0.0, 2 * _FAR)
    narrow = (width <= _WIDE) & (0.5 * width * (near + far) <= _STEEP)
    value, mean, weight = found = [np.zeros(width.shape) for _ in range(3)]
    for holds, formula in (
        (narrow, _narrow),
        (~narrow & (near <= 0), _around),
        (~narrow & (near > 0), _beyond),
    ):
        for part, own in zip(found, formula(near[holds], far[holds], width[holds]), strict=True):
            part[holds] = own
    return LogLikelihood(value, np.where(above, mean, -mean) / s, weight / (s * s))


class _Table(NamedTuple):
    """Value, score by the distance, weight and its slope over the distance of a prediction beyond the upper end."""

    first: float
    step: float
    values: Float[np.ndarray, "4 K"]


@functools.lru_cache(maxsize=256)
def _table(ratio: float) -> _Table:
    """Of intervals whose width is so many s; infinite for an interval with one end."""
    first = -min(0.5 * ratio, _INSIDE)
    beyond, step = np.linspace(first, _OUTSIDE, _KNOTS, retstep=True)
    found = interval(np.full(_KNOTS, -ratio), np.zeros(_KNOTS), beyond, np.ones(_KNOTS))
    return _Table(first, float(step), np.stack([*found, np.gradient(found.weight, step)]))


class Values:
    """Some pixels of a picture, and what their values say that lay between bounds, of millions of them on the host.

    Where the widths are powers of two of each other, as those of integers and of floating point, by tables over the
    prediction: by Taylor's series about the nearest knot, value and score right to 1e-8, the weight to 3e-6; beyond the
    last knot the first terms of the tail's series, right to 1e-6 of it.
    """

    def __init__(
        self, which: Bool[np.ndarray, " P"], weight: Float[np.ndarray, "#P #C"], bounds: Bounds, picture: Any = None
    ):
        """Sort the values of some pixels by the width of their intervals.

        ``weight`` is how many each stands for, ``picture`` these pixels alone, where predictions are made of them.
        """
        self.which, self.weight, self.bounds, self.picture = which, weight, bounds, picture
        width = bounds.upper - bounds.lower
        self._tells, closed = width > 0, (width > 0) & np.isfinite(width)
        width = width[closed]
        least = float(np.min(width, initial=np.inf))
        power = np.rint(np.log2(width / least)).astype(np.intp)
        self._tabulated = not bounds.spread.ndim and bool(np.all(np.abs(width / least / 2.0**power - 1) < _ALIKE))
        # The first kind has one end.
        self._kinds = np.append(np.inf, least * 2.0 ** np.arange(np.max(power, initial=0) + 1))
        self._kind = np.zeros(closed.shape, np.intp)
        self._kind[closed] = 1 + power

    def likelihood(self, predicted: Float[np.ndarray, "P C"], noise: float) -> LogLikelihood:
        """What they say of predictions in units of the ends; noise is that before rounding."""
        lower, upper, s = self.bounds.lower, self.bounds.upper, noise * self.bounds.spread
        # Of the nearer end; minus infinity where there is none.
        above, below = predicted - upper, lower - predicted
        up, beyond = above >= below, np.maximum(above, below) / s
        found = LogLikelihood(*(np.zeros(predicted.shape) for _ in range(3)))
        if not self._tabulated:
            some = self._tells & (beyond >= -_INSIDE)
            parts = lower, upper, predicted, np.broadcast_to(s, predicted.shape)
            for part, own in zip(found, interval(*(part[some] for part in parts)), strict=True):
                part[some] = own
            return found
        ratios = self._kinds / s
        # Of two ends so far apart one tells.
        tables = map(_table, np.where(ratios < 2 * _INSIDE, ratios, np.inf).tolist())
        firsts, steps, parts = map(np.stack, zip(*tables, strict=True))
        # The others are sure.
        some = np.flatnonzero(self._tells & (beyond >= firsts[self._kind]))
        beyond, kind = beyond.ravel()[some], self._kind.ravel()[some]
        position = np.minimum((beyond - firsts[kind]) / steps[kind], _KNOTS - 1.0)
        index = np.rint(position)
        away = (position - index) * steps[kind]
        index = index.astype(np.intp) + _KNOTS * kind
        value, score, weight, change = (part[index] for part in np.concatenate(parts, axis=1))
        change *= away
        value += away * (score - away * (0.5 * weight + change / 6))
        score -= away * (weight + 0.5 * change)
        weight += change
        tail = beyond > _OUTSIDE
        if tail.any():
            x = beyond[tail]
            square = x * x
            value[tail] = -0.5 * square - np.log(x) - _LOG_ROOT_TWO_PI + np.log1p((3 / square - 1) / square)
            score[tail] = -(x + (1 - 2 / square) / x)
            weight[tail] = 1 - (1 - 6 / square) / square
        score = np.where(up.ravel()[some], score, -score) / s
        for part, own in zip(found, (value, score, weight / s**2), strict=True):
            part.ravel()[some] = own
        return found


def alike(bounds: Bounds, codes: Float[np.ndarray, "P C"], *, level: bool = False) -> Float[np.ndarray, "P C"]:
    """How many values are predicted as each is, as on an unlit side, and share its rounding error; 0 for few.

    Times the square of the step between codes. With ``level`` only those that also show one code; where some do not,
    noise tells where between codes they lie.
    """
    tells, found, width = bounds.ends > 0, np.zeros(codes.shape), bounds.upper - bounds.lower
    width = np.where(np.isfinite(width), width, np.min(width, initial=1.0, where=width > 0))
    for channel, (one, some) in enumerate(zip(codes.T, tells.T, strict=True)):
        if not some.any():
            continue
        kind, count, many = _of_kinds(one[some], FEWEST_LEVEL if level else FEWEST_ALIKE, planes=level)
        if level:
            shown, one_of = bounds.lower[some, channel] + bounds.upper[some, channel], np.zeros(count.size)
            one_of[kind] = shown
            many &= np.bincount(kind, shown != one_of[kind], count.size) == 0
        found[some, channel] = np.where(many, count, 0.0)[kind] * width[some, channel] ** 2
    return found


def how_many_alike(codes: Float[np.ndarray, " P"]) -> Float[np.ndarray, " P"]:
    """How many values are predicted as each is, in steps between codes; 0 for few."""
    kind, count, many = _of_kinds(codes, FEWEST_ALIKE)
    return np.where(many, count, 0.0)[kind]


def weight_of_alike(count: Float[np.ndarray, "P C"], noise: Any) -> Float[np.ndarray, "P C"]:
    """Of each of N values of noise s that share a rounding error: their mean has a variance of 1 / 12 + s² / N."""
    return 1 / (1 + count / (12 * noise**2))


def _of_kinds(
    codes: Float[np.ndarray, " P"], fewest: int, *, planes: bool = False
) -> tuple[Int[np.ndarray, " P"], Int[np.ndarray, " K"], Bool[np.ndarray, " K"]]:
    """Which kind each prediction is, how many are of each, and whether that is many; few are counted, not sorted.

    With ``planes`` a picture of few kinds is one of planes, whose kinds are all of many.
    """
    code = np.rint(codes * ALIKE)
    least = np.min(code)
    if np.max(code) - least < MOST_COUNTED:
        kind = (code - least).astype(np.int64)
        count = np.bincount(kind)
    else:
        _, kind, count = np.unique(code, return_inverse=True, return_counts=True)
    usual = 0 if planes and np.count_nonzero(count) < MOST_LEVELS else np.median(count[count > 0])
    return kind, count, count > max(fewest, MORE_ALIKE * usual)
