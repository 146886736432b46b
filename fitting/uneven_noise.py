"""Noise that is not the same everywhere: each picture, as of other exposures, and value counts by what it knows."""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from fitting.channel_errors import residuals
from fitting.codes import all_between
from fitting.likelihood import Bounds, in_light, interval, is_curved, residual_deviation
from fitting.maximum_likelihood import bounds_of
from fitting.model_fit import ModelFit
from fitting.pixels import Observed, Tile
from fitting.solver.normal_equations import Picture
from fitting.solver.profile import Optimum
from fitting.solver.streams import each
from fitting.uncertainty.noise_model import (
    CHANCE,
    EVEN,
    MOST_VALUES,
    RISE,
    growth_of_channel,
    variance_at,
)

# The noise of one picture is this factor of another's, and more than chance would make it by so many deviations.
UNEVEN, DEVIATIONS = 1.2, 5.0
# All alike, what is noisy leads the rest astray, whose noise then seems larger: so many rounds.
EVENINGS = 2
# How it grows moves numbers, and they how it does; so many rounds at most.
GROWINGS = 6
# In codes: less noise before rounding than this is not told from none.
ROUNDING_HIDES = 0.05
# One of so many values tells how noise grows.
SHARE = 16
# So often it is asked what is to be expected of rounded values, by noise that is even and by noise that grows; until
# one variance for all changes by less than this share, and twice the logarithm of the likelihood by less than this.
FEW_EXPECTATIONS, EXPECTATIONS, SETTLED, ENOUGH_GAIN = 4, 50, 0.02, 0.5
# Of a step: noise before rounding that shows how it grows, and by how much steps that are the same may differ.
NOISY, SAME_STEP = 0.1, 1e-6
# In deviations of the noise, half as far apart as the ends of a value that is not rounded are taken to be.
EXACT = 1e-3
# Steps of single precision, as a share of the brightest value.
ROUNDED = 2.0**-22


def in_codes(observed: Observed) -> Observed:
    """The same, floats beside pictures of codes as codes too: those that single precision rounds them to."""
    targets = observed.problem.targets
    floats = [one.codes is None for one in targets]
    if all(floats) or not any(floats) or any(one.streamed or one.least_squares for one in targets):
        return observed
    step = ROUNDED * float(np.max(observed.brightest))

    def of_tile(tile: Tile, one: int) -> Tile:
        if not floats[one]:
            return tile
        values, bounds = np.asarray(tile.target), tile.bounds
        if bounds is None:
            says = np.ones(1) if tile.weight is None else np.asarray(tile.weight)
            says = says.reshape(len(says), -1) > 0
            lower, upper = np.where(says, values, -np.inf), np.where(says, values, np.inf)
            bounds = all_between(lower, upper, targets[one].pixels.shape[1], 1.0)
        lower, upper = bounds.lower / step - 0.5, bounds.upper / step + 0.5
        return tile._replace(bounds=replace(bounds, lower=lower, upper=upper, scale=np.array(1 / step), exact=False))

    return observed._replace(tiles=each(of_tile, observed.tiles, observed.owner))


class NoiseOfEach(NamedTuple):
    """What least squares leaves of each picture.

    Attributes:
        cost: minus twice the logarithm of the likelihood, each picture having its own.
        variance: in light, over that of the others.
        spread: the noise over that of the others, in codes before rounding where there are such.
        pixels: how many.
        alike: codes of all stand for the same, or there are none.
    """

    cost: float
    variance: Float[np.ndarray, " K"]
    spread: Float[np.ndarray, " K"]
    pixels: Float[np.ndarray, " K"]
    alike: bool

    @property
    def even(self) -> bool:
        """Whether all have the same, but for chance."""
        chance = DEVIATIONS / math.sqrt(np.min(self.pixels))
        return self.alike and bool(np.max(self.variance) < (UNEVEN + chance) ** 2 * np.min(self.variance))


def noise_of_each(
    pictures: Sequence[Picture],
    owner: Int[np.ndarray, " T"],
    rounding: Float[np.ndarray, " C"],
    least_squares: Callable[[Sequence[Picture]], ModelFit],
) -> NoiseOfEach:
    """What least squares leaves, with weights by what it leaves where that is not even.

    Of some pixels of each tile, on the host; no picture has less noise than the rounding of a value.
    """
    found = _left(pictures, owner, rounding, least_squares(pictures).optimum)
    for _ in range(0 if found.even else EVENINGS):
        now = [
            replace(picture, weight=picture.weights * np.full((len(picture.target), 1), 1 / found.variance[one]))
            for picture, one in zip(pictures, owner, strict=True)
        ]
        found = _left(pictures, owner, rounding, least_squares(now).optimum)
    return found


class Left(NamedTuple):
    """What predictions leave of some pixels.

    Attributes:
        counts: which values count.
        residual: of these, whatever they weigh.
        predicted: radiance.
        bounds: of the values; None where they are no codes.
    """

    counts: Bool[np.ndarray, "P C"]
    residual: Float[np.ndarray, "P C"]
    predicted: Float[np.ndarray, "P C"]
    bounds: Bounds | None


def _left(
    pictures: Sequence[Picture], owner: Int[np.ndarray, " T"], rounding: Float[np.ndarray, " C"], optimum: Optimum
) -> NoiseOfEach:
    left = []
    for picture in pictures:
        counts = np.broadcast_to(picture.weights > 0, picture.target.shape)
        predicted = np.asarray(picture.predict(optimum.n, optimum.x))
        left.append(Left(counts, residuals(picture, optimum), predicted, picture.bounds))
    return noise_left(left, owner, rounding)


def noise_left(left: Sequence[Left], owner: Int[np.ndarray, " T"], rounding: Float[np.ndarray, " C"]) -> NoiseOfEach:
    """What is left of each picture, by the picture that each tile is of."""
    counted = [np.sum(one.counts, axis=0) for one in left]
    squares = [np.sum(one.residual**2, axis=0) for one in left]
    of_picture = np.equal.outer(owner, np.arange(np.max(owner) + 1))
    count = np.transpose(counted) @ of_picture
    variance = np.maximum(np.transpose(squares) @ of_picture / np.maximum(count, 1), rounding[:, None] ** 2)
    cost = float(np.sum(count * np.log(variance)))
    variance = np.mean(variance / np.mean(variance, axis=1, keepdims=True), axis=0)
    spread, kinds = np.sqrt(variance), {()}
    for one in range(variance.size) if all(some.bounds for some in left) else ():
        own = [some for some, of in zip(left, owner, strict=True) if of == one]
        bounds = [some.bounds for some in own if some.bounds is not None]
        kinds |= {(*np.ravel(some.scale / some.unit), some.encoding) for some in bounds}
        codes = [some.codes(part.predicted)[0] for some, part in zip(bounds, own, strict=True)]
        step = float(np.mean(np.concatenate([np.zeros(1), *(some.widths for some in bounds)])))
        noise = residual_deviation(bounds, codes) ** 2 - step**2 / 12
        spread[one] = math.sqrt(max(noise, (ROUNDING_HIDES * step) ** 2))
    return NoiseOfEach(cost, variance, spread / np.min(spread), np.max(count, axis=0), len(kinds) <= 2)


def evened(observed: Observed, noise: NoiseOfEach) -> Observed:
    """The same with weights by which each picture counts by what it knows; as it is where all have the same noise."""
    if noise.even:
        return observed
    weight = 1 / (noise.variance * np.average(1 / noise.variance, weights=noise.pixels))

    def of_tile(tile: Tile, one: int) -> Tile:
        own = jnp.ones(len(tile.target), tile.target.dtype) if tile.weight is None else tile.weight
        bounds = tile.bounds
        if bounds is not None:
            bounds = replace(bounds, spread=bounds.spread * noise.spread[one])
        return tile._replace(weight=own * float(weight[one]), bounds=bounds)

    weights = [
        factor * np.asarray(counted if own is None else own)
        for factor, counted, own in zip(weight, observed.counted, observed.weights, strict=True)
    ]
    return observed._replace(tiles=each(of_tile, observed.tiles, observed.owner), weights=weights)


def as_it_grows(observed: Observed, fit: ModelFit) -> Observed | None:
    """The same where noise seems to grow with brightness, as a camera's does, beside codes or what is cut off.

    None where it does not or the user says what it is. What least squares alone says of other pictures has errors that
    allow for it.
    """
    problem, evidence = observed.problem, fit.evidence
    bounds = [tile.bounds for tile in observed.tiles if tile.bounds is not None]
    stated = problem.noise is not None or any(one is not None for one in problem.weights)
    if evidence is None or stated or len(bounds) < len(fit.pictures) or any(one.lossy for one in bounds):
        return None
    # Of one camera, which has taken all of them alike.
    if len({(*np.ravel(one.scale / one.unit), one.encoding) for one in bounds}) > 1:
        return None
    pictures = [replace(picture, bounds=one) for picture, one in zip(fit.pictures, bounds, strict=True)]
    # Whether it grows some tell; how it does, what is cut off shows with more of them.
    again = any(bounds_of(picture).spread.ndim for picture in fit.pictures)
    values = sum(picture.target.size for picture in pictures)
    most = max(MOST_VALUES, again * values // SHARE) // (observed.colour.size * len(bounds))
    some = [_some(picture, most) for picture in pictures]
    widths, size = np.concatenate([bounds_of(picture).widths for picture in some]), 0.0
    step = float(np.max(widths, initial=0.0))
    # What rounding leaves is no noise, and grows with brightness by itself where the steps of floats do.
    if np.any(widths < (1 - SAME_STEP) * step) or evidence.noise < NOISY * step:
        return None
    if is_curved(bounds):
        # Noise grows before a curve.
        light = in_light(list(map(bounds_of, some)))
        some = [replace(picture, bounds=one) for picture, one in zip(some, light, strict=True)]
        size = 1 / float(light[0].scale)
    parts = zip(*(_said(picture, fit.optimum) for picture in some), strict=True)
    channels = [_Said(*channel) for channel in zip(*map(np.hstack, parts), strict=True)]
    now = (np.broadcast_to(bounds_of(picture).spread, picture.target.shape) for picture in fit.pictures)
    spreads = [_each(one, most) for one in now]
    spread = np.concatenate(spreads)
    coefficients = _growth(channels, (evidence.noise * float(np.median(spread))) ** 2)
    if coefficients is None:
        return None

    def variance(picture: Picture) -> np.ndarray:
        """Of values before rounding."""
        value = bounds_of(picture).codes(np.asarray(picture.predict(fit.optimum.n, fit.optimum.x), float))[0]
        return np.maximum(variance_at(coefficients, np.maximum(value, 0)), (ROUNDING_HIDES * step) ** 2)

    # Behind them some of sampled lights are repeated.
    of_some = np.concatenate([variance(picture)[: len(own)] for picture, own in zip(some, spreads, strict=True)])
    if np.ptp(np.log(of_some / spread**2)) < (SETTLED if again else math.log(EVEN)):
        return None
    typical, least = np.median(of_some), np.min(of_some)

    def of_tile(tile: Tile, picture: Picture) -> Tile:
        own = bounds_of(picture).in_light(size) if size else bounds_of(picture)
        before = variance(replace(picture, bounds=own))
        counts = 1.0 if tile.weight is None else np.asarray(tile.weight).reshape(len(before), -1)
        weight = (counts * typical / (before + _widths(own) ** 2 / 12)).astype(tile.target.dtype)
        weight = weight[:, 0] if weight.shape[1] == 1 else weight
        return tile._replace(weight=jnp.asarray(weight), bounds=replace(own, spread=np.sqrt(before / least)))

    tiles, weights = each(of_tile, observed.tiles, pictures), observed.weights
    if not problem.streamed:
        parts = zip(tiles, observed.owner, strict=True)
        of_values = [(np.broadcast_to(np.asarray(tile.weight).T, tile.target.T.shape).T, one) for tile, one in parts]
        weights = [
            np.concatenate([some for some, of in of_values if of == one]).reshape(picture.shape)
            for one, picture in enumerate(observed.shown)
        ]
    return observed._replace(tiles=tiles, weights=weights)


def _widths(bounds: Bounds) -> Float[np.ndarray, "P C"]:
    """Distances of the ends of each code; that of the others where one is open."""
    closed = bounds.ends == 2
    width = np.subtract(bounds.upper, bounds.lower, out=np.zeros(closed.shape), where=closed)
    return np.where(closed, width, np.median(width[closed]) if closed.any() else 1.0)


class _Even(NamedTuple):
    """A variance that does not know of the value.

    Attributes:
        size: how large.
        tells: by how many deviations squares go with the value, all the same.
        cost: minus twice the logarithm of the likelihood.
    """

    size: float
    tells: float
    cost: float


class _Said(NamedTuple):
    """Ends of some codes, what is predicted, and their distance, (C, P); or of a channel."""

    lower: Float[np.ndarray, "*C P"]
    upper: Float[np.ndarray, "*C P"]
    value: Float[np.ndarray, "*C P"]
    width: Float[np.ndarray, "*C P"]

    @property
    def known(self) -> "_Said":
        """Those that have an end."""
        says = np.isfinite(self.lower) | np.isfinite(self.upper)
        return _Said(*(part[says] for part in self))

    def expected(self, variance: Float[np.ndarray, " P"]) -> tuple[Float[np.ndarray, " P"], float]:
        """Squares of the noise before rounding, and minus twice the logarithm of the likelihood.

        What is rounded or cut off is as far off as is to be expected (Dempster, Laird and Rubin 1977).
        """
        deviation = np.sqrt(variance)
        # A value that is not rounded lay about where it is.
        beside = np.where(self.width > 0, 0.0, EXACT * deviation)
        said = interval(self.lower - beside, self.upper + beside, self.value, deviation)
        return variance * (1 + variance * (said.score**2 - said.weight)), -2 * float(np.sum(said.value))

    def even(self, shape: Float[np.ndarray, " P"], start: float) -> _Even:
        """A variance of such a shape."""
        even, squared, cost = start, shape, 0.0
        for _ in range(FEW_EXPECTATIONS):
            squared, cost = self.expected(even * shape)
            last, even = even, float(np.mean(squared / shape))
            if abs(even - last) < SETTLED * last:
                break
        varies = self.value.size > 1 and np.ptp(self.value) > 0
        tells = np.corrcoef(squared / shape, self.value)[0, 1] if varies else 0.0
        return _Even(even, abs(float(tells)) * math.sqrt(self.value.size), cost)

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


def _some(picture: Picture, most: int) -> Picture:
    """Some of the pixels."""
    return picture.in_double(_each(np.arange(len(picture.target)), most))


def _each(pixels: np.ndarray, most: int) -> np.ndarray:
    """One of so many, about ``most`` of them."""
    return pixels[:: max(len(pixels) // most, 1)]


def _said(picture: Picture, optimum: Optimum) -> _Said:
    bounds = bounds_of(picture)
    code = bounds.codes(np.asarray(picture.predict(optimum.n, optimum.x), float))[0]
    return _Said(*(np.asarray(part, float).T for part in (bounds.lower, bounds.upper, code, _widths(bounds))))


def _growth(channels: Sequence[_Said], start: float) -> Float[np.ndarray, "C 3"] | None:
    """Coefficients of the variance before rounding of each channel; None where one in codes, or in light, will do.

    That one is about ``start``.
    """
    channels = [channel.known for channel in channels]
    curved = any(np.ptp(channel.width) > SAME_STEP * np.max(channel.width) for channel in channels)
    light = [channel.even(channel.width**0, start) for channel in channels]
    codes = [channel.even(channel.width**2, start) for channel in channels] if curved else light
    light_does, codes_do = (max(one.tells for one in both) < CHANCE for both in (light, codes))
    if light_does:
        return None
    grows, cost = zip(*(channel.growing(even.size) for channel, even in zip(channels, codes, strict=True)), strict=True)
    # Noise that grows in light is nearly even in codes of a curve.
    return None if codes_do and sum(cost) > sum(one.cost for one in codes) - RISE else np.array(grows)
