"""Noise that grows with brightness, as a camera's does, beside rounded values or what is cut off.

What a code leaves beside a prediction is as large as the code lets it be: its expected square, by the noise so far
(Dempster, Laird and Rubin, J. R. Stat. Soc. B 39, 1977). Regressed on the prediction, in light before the curve of an
encoding, these squares tell how the variance grows, and each value weighs by its own.
"""

import math
import operator
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple, TypeVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from fitting.likelihood import Bounds, in_light, interval, is_curved, over_channels
from fitting.pixels import Observed
from fitting.solver.streams import each
from fitting.tile import Tile
from fitting.uncertainty.noise_model import CHANCE, EVEN, MOST_VALUES, RISE, growth_of_channel, variance_at

_F = TypeVar("_F")
# How noise grows moves numbers, and they how it does: so many rounds at most.
GROWINGS = 6
# By so much less pixels err alike where noise that grows is what was left.
LESS_STRUCTURE = 0.25
# One of so many values tells how noise grows.
SHARE = 16
# So often it is asked what is to be expected of rounded values, by noise that is even and by noise that grows; until
# one variance for all changes by less than this share, and twice the logarithm of the likelihood by less than this.
FEW_EXPECTATIONS, EXPECTATIONS, SETTLED, ENOUGH_GAIN = 4, 50, 0.02, 0.5
# Where next to none is cut off weights that are off by less than this are as good.
CUT, ABOUT = 0.01, 0.1
# Of a step: noise before rounding that shows how it grows, less than any that does, and by how much steps that are the
# same may differ.
NOISY, LEAST, SAME_STEP = 0.1, 0.05, 1e-6
# In deviations of the noise, half as far apart as the ends of a value that is not rounded are taken to be.
EXACT = 1e-3


def likeliest(
    first: _F, grown: Callable[[_F], _F | None], value: Callable[[_F], float], alike: Callable[[_F], tuple[bool, float]]
) -> _F:
    """A fit with noise that grows with brightness where that makes the pictures likelier, from one without it.

    ``grown`` makes the fit again with noise as it grows beside the last one, ``value`` is the logarithm of its
    likelihood, and ``alike`` whether pixels err alike more than by chance, and how much.
    """
    last = first
    for _ in range(GROWINGS):
        again = grown(last)
        if again is None or value(again) < value(last) + RISE / 2:
            break
        last = again
    if last is first:
        return first
    # Something else that is left is larger where it is brighter, too.
    significant, excess = alike(last)
    return first if significant and excess > LESS_STRUCTURE * alike(first)[1] else last


class Shown(NamedTuple):
    """What a fit shows of a tile.

    Attributes:
        spread: that of its bounds, as the fit had them.
        predicted: radiance of some pixels by their index, which is ... for all.
    """

    spread: Float[np.ndarray, "*P_C"]
    predicted: Callable[[Any], Float[np.ndarray, "P C"]]


def as_it_grows(observed: Observed, shown: Sequence[Shown], noise: float) -> Observed | None:
    """The same where noise seems to grow with brightness, as a camera's does, beside codes or what is cut off.

    None where it does not or the user says what it is. What least squares alone says of other pictures has errors that
    allow for it. ``noise`` is what the fit found, in codes before rounding.
    """
    problem = observed.problem
    bounds = [tile.bounds for tile in observed.tiles if tile.bounds is not None]
    stated = problem.noise is not None or any(one is not None for one in problem.weights)
    if stated or len(bounds) < len(shown) or any(one.lossy for one in bounds):
        return None
    # Of one camera, which has taken all of them alike.
    if len({(*np.ravel(one.scale / one.unit), one.encoding) for one in bounds}) > 1:
        return None
    # Whether it grows some tell; how it does, what is cut off shows with more of them, and hangs on.
    again = any(one.spread.ndim for one in shown)
    told = [np.bincount(one.ends.ravel(), minlength=3) for one in bounds]
    _, open_, closed = np.sum(told, axis=0).tolist()
    cut = open_ > CUT * closed
    most = max(MOST_VALUES, again * cut * (open_ + closed) // SHARE) // (observed.colour.size * len(bounds))
    index = [_some(one, most) for one in bounds]
    some = [one.pixels(operator.itemgetter(own)) for one, own in zip(bounds, index, strict=True)]
    widths, size = np.concatenate([one.widths for one in some]), 0.0
    step = float(np.max(widths, initial=0.0))
    # What rounding leaves is no noise, and grows with brightness by itself where the steps of floats do.
    if np.any(widths < (1 - SAME_STEP) * step) or noise < NOISY * step:
        return None
    if is_curved(bounds):
        # Noise grows before a curve.
        some = in_light(some)
        size = 1 / float(some[0].scale)
    parts = zip(some, (one.predicted(own) for one, own in zip(shown, index, strict=True)), strict=True)
    ends = [_ends(*part) for part in parts]
    channels = [_Ends(*channel) for channel in zip(*map(np.hstack, zip(*ends, strict=True)), strict=True)]
    now = [np.broadcast_to(one.spread, own.lower.shape) for one, own in zip(shown, bounds, strict=True)]
    spread = np.concatenate([one[own] for one, own in zip(now, index, strict=True)])
    coefficients = _growth(channels, (noise * float(np.median(spread))) ** 2)
    if coefficients is None:
        return None

    def variance(value: Float[np.ndarray, "P C"]) -> Float[np.ndarray, "P C"]:
        """Of predictions before rounding."""
        return np.maximum(variance_at(coefficients, np.maximum(value, 0)), (LEAST * step) ** 2)

    of_some = np.concatenate([variance(one.value.T) for one in ends])
    if np.ptp(np.log(of_some / spread**2)) < (math.log(EVEN) if not again else SETTLED if cut else ABOUT):
        return None
    typical, least = np.median(of_some), np.min(of_some)

    def of_tile(tile: Tile, own: Bounds, one: Shown) -> Tile:
        own = own.in_light(size) if size else own
        before = variance(own.codes(one.predicted(...))[0])
        counts = 1.0 if tile.weight is None else np.asarray(tile.weight).reshape(len(before), -1)
        weight = (counts * typical / (before + _widths(own) ** 2 / 12)).astype(tile.target.dtype)
        weight = weight[:, 0] if weight.shape[1] == 1 else weight
        return tile._replace(weight=jnp.asarray(weight), bounds=replace(own, spread=np.sqrt(before / least)))

    tiles = each(of_tile, observed.tiles, bounds, shown)
    parts = zip(tiles, observed.owner, strict=True)
    weights = [(np.broadcast_to(np.asarray(tile.weight).T, tile.target.T.shape).T, owner) for tile, owner in parts]
    of_pictures = [
        np.concatenate([part for part, owner in weights if owner == one]).reshape(picture.shape)
        for one, picture in enumerate(observed.shown)
    ]
    return observed._replace(tiles=tiles, weights=of_pictures)


def _widths(bounds: Bounds) -> Float[np.ndarray, "P C"]:
    """Distances of the ends of each code; that of the others where one is open."""
    closed = bounds.ends == 2
    width = np.subtract(bounds.upper, bounds.lower, out=np.zeros(closed.shape), where=closed)
    return np.where(closed, width, np.median(width[closed]) if closed.any() else 1.0)


class _Ends(NamedTuple):
    """Ends of some codes, what is predicted between them, and their distance, (C, P); or of a channel."""

    lower: Float[np.ndarray, "*C P"]
    upper: Float[np.ndarray, "*C P"]
    value: Float[np.ndarray, "*C P"]
    width: Float[np.ndarray, "*C P"]

    @property
    def known(self) -> "_Ends":
        """Those that have an end."""
        says = np.isfinite(self.lower) | np.isfinite(self.upper)
        return _Ends(*(part[says] for part in self))

    def expected(self, variance: Float[np.ndarray, " P"]) -> tuple[Float[np.ndarray, " P"], float]:
        """Squares of the noise before rounding, and minus twice the logarithm of the likelihood.

        What is rounded or cut off is as far off as is to be expected (Dempster, Laird and Rubin 1977).
        """
        deviation = np.sqrt(variance)
        # A value that is not rounded lay about where it is.
        beside = np.where(self.width > 0, 0.0, EXACT * deviation)
        said = interval(self.lower - beside, self.upper + beside, self.value, deviation)
        return variance * (1 + variance * (said.score**2 - said.weight)), -2 * float(np.sum(said.value))

    def even(self, shape: Float[np.ndarray, " P"], start: float) -> tuple[float, float, float]:
        """How large a variance of such a shape is that does not know of the value, and its cost.

        Between them by how many deviations squares go with the value, all the same.
        """
        even, squared, cost = start, shape, 0.0
        for _ in range(FEW_EXPECTATIONS):
            squared, cost = self.expected(even * shape)
            last, even = even, float(np.mean(squared / shape))
            if abs(even - last) < SETTLED * last:
                break
        varies = self.value.size > 1 and np.ptp(self.value) > 0
        tells = np.corrcoef(squared / shape, self.value)[0, 1] if varies else 0.0
        return even, abs(float(tells)) * math.sqrt(self.value.size), cost

    def growing(self, start: float) -> tuple[Float[np.ndarray, " 3"], float]:
        """Coefficients of a variance that grows with the value, and its cost."""
        coefficients, cost, value = np.array([start, 0.0, 0.0]), math.inf, np.maximum(self.value, 0.0)
        for _ in range(EXPECTATIONS):
            last = cost
            squared, cost = self.expected(variance_at(coefficients[None], value[:, None])[:, 0])
            coefficients = growth_of_channel(squared, value, 0.0, coefficients)[0]
            if cost > last - ENOUGH_GAIN:
                break
        return coefficients, cost


def _some(bounds: Bounds, most: int) -> Int[np.ndarray, " K"]:
    """About so many of the pixels that say something."""
    tell = np.flatnonzero(over_channels(np.logical_or, bounds.ends > 0))
    return tell[:: max(tell.size // most, 1)]


def _ends(bounds: Bounds, predicted: Float[np.ndarray, "P C"]) -> _Ends:
    code = bounds.codes(predicted)[0]
    return _Ends(*(np.asarray(part, float).T for part in (bounds.lower, bounds.upper, code, _widths(bounds))))


def _growth(channels: Sequence[_Ends], start: float) -> Float[np.ndarray, "C 3"] | None:
    """Coefficients of the variance before rounding of each channel; None where one in codes, or in light, will do.

    That one is about ``start``.
    """
    channels = [channel.known for channel in channels]
    curved = any(np.ptp(channel.width) > SAME_STEP * np.max(channel.width) for channel in channels)
    light = [channel.even(channel.width**0, start) for channel in channels]
    codes = [channel.even(channel.width**2, start) for channel in channels] if curved else light
    light_does, codes_do = (max(tells for _, tells, _ in both) < CHANCE for both in (light, codes))
    if light_does:
        return None
    starts = [size for size, *_ in codes]
    grows, cost = zip(*map(_Ends.growing, channels, starts), strict=True)
    # Noise that grows in light is nearly even in codes of a curve.
    return None if codes_do and sum(cost) > sum(even for *_, even in codes) - RISE else np.array(grows)
