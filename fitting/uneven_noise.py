"""Pictures of different noise, as of other exposures: each counts by what it knows."""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from fitting.channel_errors import residuals
from fitting.codes import all_between
from fitting.likelihood import Bounds, residual_deviation
from fitting.model_fit import ModelFit
from fitting.pixels import Observed
from fitting.solver.normal_equations import Picture
from fitting.solver.profile import Optimum
from fitting.solver.streams import Stream, each
from fitting.tile import Tile

# The noise of one picture is this factor of another's, and it is likelier so by more than chance by so many deviations.
UNEVEN, DEVIATIONS = 1.2, 5.0
# All alike, what is noisy leads the rest astray, whose noise then seems larger: so many rounds.
EVENINGS = 2
# In codes: less noise before rounding than this is not told from none.
ROUNDING_HIDES = 0.05
# Steps of single precision, as a share of the brightest value.
ROUNDED = 2.0**-22


def with_bounds(observed: Observed, *, in_codes: bool = False) -> Observed:
    """The same with bounds of all values, where some have such.

    Floats beside pictures of codes, or ``in_codes``, are codes too: those that single precision rounds them to. Beside
    others that are clipped or cut off they are exact.
    """
    targets, tiles = observed.problem.targets, observed.tiles
    floats = [one.codes is None for one in targets]
    if not any(floats) or any(one.streamed or one.least_squares for one in targets):
        return observed
    # Tiles that are made anew each time are asked only where something is clipped.
    clipped = bool(observed.left_out.get("clipped"))
    some = clipped if isinstance(tiles, Stream) else any(tile.bounds is not None for tile in tiles)
    if all(floats) and not some:
        return observed
    exact, step = all(floats) and not in_codes, ROUNDED * float(np.max(observed.brightest))

    def of_tile(tile: Tile, one: int) -> Tile:
        if not floats[one]:
            return tile
        values, bounds = np.asarray(tile.target), tile.bounds
        if bounds is None:
            says = np.ones(1) if tile.weight is None else np.asarray(tile.weight)
            says = says.reshape(len(says), -1) > 0
            lower, upper = np.where(says, values, -np.inf), np.where(says, values, np.inf)
            bounds = all_between(lower, upper, targets[one].pixels.shape[1], 1.0, exact=True)
        if exact:
            return tile._replace(bounds=bounds)
        lower, upper = bounds.lower / step - 0.5, bounds.upper / step + 0.5
        return tile._replace(bounds=replace(bounds, lower=lower, upper=upper, scale=np.array(1 / step), exact=False))

    return observed._replace(tiles=each(of_tile, tiles, observed.owner))


class NoiseOfEach(NamedTuple):
    """What least squares leaves of each picture.

    Attributes:
        cost: minus twice the logarithm of the likelihood, each picture having its own.
        variance: in light, over that of the others.
        spread: the noise over that of the others, in codes before rounding where there are such.
        pixels: how many.
        alike: codes of all stand for the same, or there are none.
        deviations: by how many that makes them likelier than chance would.
    """

    cost: float
    variance: Float[np.ndarray, " K"]
    spread: Float[np.ndarray, " K"]
    pixels: Float[np.ndarray, " K"]
    alike: bool
    deviations: float

    @property
    def even(self) -> bool:
        """Whether all have the same, but for chance."""
        near = np.max(self.variance) < UNEVEN**2 * np.min(self.variance)
        return self.alike and bool(near or self.deviations < DEVIATIONS)


def noise_of_each(
    pictures: Sequence[Picture],
    owner: Int[np.ndarray, " T"],
    roundings: Float[np.ndarray, "K C"],
    least_squares: Callable[[Sequence[Picture]], ModelFit],
) -> NoiseOfEach:
    """What least squares leaves, with weights by what it leaves where that is not even.

    Of some pixels of each tile, on the host.
    """
    found = _left(pictures, owner, roundings, least_squares(pictures).optimum)
    for _ in range(0 if found.even else EVENINGS):
        now = [
            replace(picture, weight=picture.weights * np.full((len(picture.target), 1), 1 / found.variance[one]))
            for picture, one in zip(pictures, owner, strict=True)
        ]
        found = _left(pictures, owner, roundings, least_squares(now).optimum)
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
    pictures: Sequence[Picture], owner: Int[np.ndarray, " T"], roundings: Float[np.ndarray, "K C"], optimum: Optimum
) -> NoiseOfEach:
    left = []
    for picture in pictures:
        counts = np.broadcast_to(picture.weights > 0, picture.target.shape)
        predicted = np.asarray(picture.predict(optimum.n, optimum.x))
        left.append(Left(counts, residuals(picture, optimum), predicted, picture.bounds))
    return noise_left(left, owner, roundings)


def noise_left(left: Sequence[Left], owner: Int[np.ndarray, " T"], roundings: Float[np.ndarray, "K C"]) -> NoiseOfEach:
    """What is left of each picture, by the picture that each tile is of; no less than its values are rounded by."""
    counted = [np.sum(one.counts, axis=0) for one in left]
    squares = [np.sum(one.residual**2, axis=0) for one in left]
    of_picture = np.equal.outer(owner, np.arange(np.max(owner) + 1))
    count = np.transpose(counted) @ of_picture
    variance = np.maximum(np.transpose(squares) @ of_picture / np.maximum(count, 1), roundings.T**2)
    cost = float(np.sum(count * np.log(np.where(variance > 0, variance, 1))))
    # What a noise of its own gains each of them where all have the same (Bartlett, Proc. R. Soc. A 160 (1937) 268).
    many, together = np.sum(count, axis=1), np.sum(count * variance, axis=1)
    alike = float(np.sum(many * np.log(np.where(together > 0, together, 1) / np.maximum(many, 1))))
    own = count[count > 0]
    gain = alike - cost - np.sum(1 + 1 / (3 * own))
    deviations = float(gain / math.sqrt(max(np.sum(2 + 4 / (3 * own)), 1)))
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
    return NoiseOfEach(cost, variance, spread / np.min(spread), np.max(count, axis=0), len(kinds) <= 2, deviations)


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
    roundings = observed.roundings * np.sqrt(weight)[:, None]
    return observed._replace(tiles=each(of_tile, observed.tiles, observed.owner), weights=weights, roundings=roundings)
