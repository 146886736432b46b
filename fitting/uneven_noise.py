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
from fitting.likelihood import Bounds, residual_deviation
from fitting.maximum_likelihood import bounds_of, thinned
from fitting.model_fit import ModelFit
from fitting.pixels import Observed, Tile
from fitting.solver.normal_equations import Picture
from fitting.solver.profile import Optimum
from fitting.solver.streams import each
from fitting.uncertainty.interpretation import shared_errors
from fitting.uncertainty.noise_model import noise_model, variance_at

# The noise of one picture is this factor of another's, and more than chance would make it by so many deviations.
UNEVEN, DEVIATIONS = 1.2, 5.0
# All alike, what is noisy leads the rest astray, whose noise then seems larger: so many rounds.
EVENINGS = 2
# In codes: less noise before rounding than this is not told from none.
ROUNDING_HIDES = 0.05
# So many deviations of the noise from where values are cut off nothing of it is.
CLEAR = 3.0
# Of a step: noise before rounding that shows how it grows, and by how much steps that are the same may differ.
NOISY, SAME_STEP = 0.1, 1e-6
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

    return observed._replace(tiles=each(of_tile, observed.tiles, observed.owner))


def as_it_grows(observed: Observed, fit: ModelFit) -> Observed | None:
    """The same where noise grows with brightness, as a camera's does, beside rounded values or what is cut off.

    None where it does not, the user says what it is, or something else is left. What least squares alone says of other
    pictures has errors that allow for it.
    """
    problem, evidence = observed.problem, fit.evidence
    bounds = [picture.bounds for picture in fit.pictures if picture.bounds is not None]
    stated = problem.noise is not None or any(one is not None for one in problem.weights)
    if evidence is None or stated or len(problem.targets) > 1 or len(bounds) < len(fit.pictures):
        return None
    if any(one.lossy or one.encoding != "linear" for one in bounds):
        return None
    some = [_left_of_codes(thinned(picture), fit.optimum) for picture in fit.pictures]
    code, residual, clear, width = (np.concatenate(part) for part in zip(*some, strict=True))
    step = float(np.max(width, initial=0.0))
    # What rounding leaves is no noise, and grows with brightness by itself where the steps of floats do.
    if np.any(width < (1 - SAME_STEP) * step) or evidence.noise < NOISY * step:
        return None
    channels = zip(residual.T, code.T, clear.T, strict=True)
    coefficients = [_growth(*channel, step / math.sqrt(12)) for channel in channels]
    if not any(one[1:].any() for one in coefficients) or shared_errors(evidence, observed)[1].significant:
        return None

    def variance(code: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Of values, and of what they were before rounding."""
        found = variance_at(np.array(coefficients), np.maximum(code, 0))
        return found, np.maximum(found - step**2 / 12, (ROUNDING_HIDES * step) ** 2)

    typical, least = np.median(variance(code)[0]), np.min(variance(code)[1])

    def of_tile(tile: Tile, picture: Picture) -> Tile:
        own = bounds_of(picture)
        rounded, before = variance(own.codes(np.asarray(picture.predict(fit.optimum.n, fit.optimum.x), float))[0])
        counts = 1.0 if tile.weight is None else np.asarray(tile.weight).reshape(len(rounded), -1)
        weight = (counts * typical / rounded).astype(tile.target.dtype)
        weight = weight[:, 0] if weight.shape[1] == 1 else weight
        return tile._replace(weight=jnp.asarray(weight), bounds=replace(own, spread=np.sqrt(before / least)))

    return observed._replace(tiles=each(of_tile, observed.tiles, fit.pictures))


def _left_of_codes(picture: Picture, optimum: Optimum) -> tuple[np.ndarray, ...]:
    """Predictions in codes, what they leave, where that is of noise alone, (P, C) each; and the codes' steps."""
    bounds = bounds_of(picture)
    code = bounds.codes(np.asarray(picture.predict(optimum.n, optimum.x), float))[0]
    closed = bounds.ends == 2
    residual = 0.5 * np.add(bounds.lower, bounds.upper, out=np.zeros(code.shape), where=closed) - code * closed
    reach = CLEAR * math.sqrt(np.sum(residual**2) / max(np.count_nonzero(closed), 1))
    low = np.max(bounds.upper, where=np.isneginf(bounds.lower) & np.isfinite(bounds.upper), initial=-np.inf)
    high = np.min(bounds.lower, where=np.isposinf(bounds.upper) & np.isfinite(bounds.lower), initial=np.inf)
    return code, residual, closed & (code > low + reach) & (code < high - reach), bounds.widths


def _growth(residual: np.ndarray, code: np.ndarray, clear: np.ndarray, rounding: float) -> Float[np.ndarray, " 3"]:
    """Coefficients of a channel's variance, the first alone where it is the same everywhere."""
    if not clear.any():
        return np.array([max(float(np.mean(residual**2)), np.finfo(float).tiny), 0.0, 0.0])
    found = noise_model(residual[clear, None], code[clear, None], np.array([rounding]))
    return np.array([np.mean(residual[clear] ** 2), 0.0, 0.0]) if found is None else found[0]
