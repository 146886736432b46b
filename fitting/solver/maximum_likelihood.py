"""The most likely numbers behind rounded values: from least squares on, Newton's method, the noise halved and halved.

Where the noise before rounding is small, least squares is wrong twice: a rounding error is no noise, and a side of the
object that shows one code counts as thousands of independent values. What is maximised here is the likelihood of
`fitting.likelihood`: each value lay somewhere between the bounds that its code states.

For a given noise s (in codes) and exponent the logarithm of the likelihood is concave in the coefficients if the
encoding is linear, and nearly so else. Newton's step needs the score and the weight of each pixel where least squares
needs the residual and 1; the sums are the same (ambient, diffuse, lobe, derivative of the lobe by log n), and the step
is the same non-negative least squares. With less noise fewer pixels say something: those whose prediction is near the
edge of a code. So s starts at what least squares leaves and is halved as long as that makes the picture likelier, each
time from the last answer; that is done on a stratified subsample. Of the whole picture only the pixels near an edge are
gathered for the last steps.
"""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from fitting.likelihood import AnyArray, Bounds, LogLikelihood, tabulated
from fitting.solver.nnls import nonnegative_minimum
from fitting.solver.normal_equations import Picture
from fitting.solver.profile import Optimum, refit, search
from fitting.solver.subsample import stratified
from fitting.solver.tied import design_of, join_channels

# In codes: below this the edges of codes are as sharp as the arithmetic of the basis images.
LEAST_NOISE = 1e-4
# A pixel says nothing where its code is as good as certain: this many s from the nearer edge.
REACH = 7.0
# Newton's steps at one s; a step that gains less ends them.
MOST_STEPS, LEAST_GAIN = 12, 1e-3
# The largest change of log n in one step.
LARGEST_SHIFT = 0.5
# The noise is known well enough where it changes by less than this factor.
ENOUGH_KNOWN = 1.1
# So many values have to tell of a number before the Hessian is taken for its error.
ENOUGH_VALUES = 6.0
SUBSAMPLE = 16384
# Numbers of pixels that are looked at together.
FEW = (2048, 16384)
# In codes: with more noise than this, and no code at an end, a linear picture says what least squares says.
ENOUGH_NOISE = 0.5
FIRST_NOISE = 0.3
# Rounds of least squares in codes; a change below this many standard errors ends them.
MOST_ROUNDS, ENOUGH_CHANGE = 10, 0.02
# An open end tells where a value is predicted within so many s of it; noise below this share of the picture is none.
END_REACH, NO_NOISE = 4.0, 1e-5


class Estimate(NamedTuple):
    """The most likely numbers.

    Attributes:
        x: coefficients x_a, x_d, x_s, at least 0, (3, C).
        log_n: logarithm of the exponent.
        noise: s, in codes.
        value: logarithm of the likelihood.
    """

    x: Float[np.ndarray, "3 C"]
    log_n: float
    noise: float
    value: float = -math.inf


class Evidence(NamedTuple):
    """What rounded values say, as least squares with weights would: the noise of each is 1.

    Attributes:
        pictures: the pixels that say something, with working targets and weights, in double precision.
        optimum: most likely, with the sums of these.
        noise: before rounding, standard deviation in codes.
        value: logarithm of the likelihood.
        places: of each picture the index of its pixels in the whole one, row by row, and the width of that.
        widening: what to multiply the errors of x_a, x_d, x_s, channel after channel, and n by.
    """

    pictures: Sequence[Picture]
    optimum: Optimum
    noise: float
    value: float
    places: Sequence[tuple[Int[np.ndarray, " P"], int]]
    widening: Float[np.ndarray, " U"]


@dataclasses.dataclass(frozen=True)
class Precision:
    """What is known of the unknowns (x_a, x_d, x_s, channel after channel each, log n) at some noise.

    Attributes:
        noise: s.
        information: logarithm of the determinant of the Hessian.
        variance: of each, (U,).
        count: how many values tell of it, by their share in the Hessian, (U,).
    """

    noise: float
    information: float
    variance: Float[np.ndarray, " U"]
    count: Float[np.ndarray, " U"]


class _Sums(NamedTuple):
    value: Any
    by_log_noise: Any
    score: Any
    weight: Any


class _Space(NamedTuple):
    """Where Newton's method may go.

    Attributes:
        design: what each unknown moves of x_a, x_d, x_s, channel after channel, and log n.
        bounds: of log n.
    """

    design: Float[np.ndarray, "U V"]
    bounds: tuple[float, float]


def evidence(
    pictures: Sequence[Picture],
    optimum: Optimum,
    free: Bool[np.ndarray, "3 C"],
    n_range: tuple[float, float],
    tied: Float[np.ndarray, " C"] | None,
) -> Evidence | None:
    """The most likely numbers, from least squares on; None where least squares is the whole answer.

    Args:
        pictures: with bounds.
        optimum: of least squares.
        free: which coefficients may be above 0.
        n_range: bounds of the exponent.
        tied: x_s is a common factor times this, (C,); None where the channels are independent.
    """
    space = _Space(design_of(free, tied), (math.log(n_range[0]), math.log(n_range[1])))
    at = Estimate(optimum.x, math.log(optimum.n), 1.0)
    exact = all(picture.bounds is not None and picture.bounds.exact for picture in pictures)
    deviation = math.sqrt(float(np.sum(optimum.cost)) / max(float(np.sum(optimum.pixels)), 1.0))
    if exact and deviation <= NO_NOISE * float(np.max(optimum.square / np.maximum(optimum.pixels, 1))) ** 0.5:
        return None
    with jax.enable_x64(True):
        # Weights of least squares leave out what is clipped, which says something here.
        pictures = [dataclasses.replace(picture, weight=None) for picture in pictures]
        stated = [_stated(picture, optimum, 1.0, 0.0) for picture in pictures]
        closed = sum(part.closed for part in stated)
        at = at._replace(noise=math.sqrt(sum(part.closed_squares for part in stated) / max(closed, 1)))
        rounding = 0.0 if exact else 1 / 12
        widest = 1.0 if exact else max(_widest(picture) for picture in pictures)
        if exact or at.noise**2 > (ENOUGH_NOISE**2 + rounding) * widest**2:
            linear = all(picture.bounds is not None and picture.bounds.encoding == "linear" for picture in pictures)
            if linear and not any(_open_ends_tell(picture, at) for picture in pictures):
                return None
            return _reweighted(pictures, optimum, free, n_range, tied, at.noise, rounding)
        at = at._replace(noise=max(at.noise, FIRST_NOISE))
        if sum(picture.target.shape[0] for picture in pictures) > 2 * SUBSAMPLE:
            some = [_stratum(picture, SUBSAMPLE // len(pictures)) for picture in pictures]
            at, known = maximise(some, at, space)
            # The whole picture has the pixels near an edge that a part of it lacks.
            at = at._replace(noise=_telling(known).noise)
        at, known = maximise([_gathered(picture, at) for picture in pictures], at, space)
        telling = at._replace(noise=_telling(known).noise)
        near = [_gathered(picture, telling) for picture in pictures]
        widening = _widening(known, _precision(near, telling, _sums(near, telling), space))
        told = [_told(picture, telling) for picture in near]
        working = [_working(picture, said) for picture, said in zip(near, told, strict=True)]
        held = (math.exp(at.log_n),) * 2
        found = search(working, n_min=held[0], n_max=held[1], free=free & (at.x.any() | ~free))
        cost = found.square - 2 * np.einsum("ci,ic->c", found.product[:, :3], at.x)
        cost += np.einsum("ic,cij,jc->c", at.x, found.gram[:, :3, :3], at.x)
    found = dataclasses.replace(found, x=at.x, n=held[0], cost=cost, flat=not np.any(at.x[2] > 0))
    return Evidence(working, found, at.noise, at.value, [_place(picture) for picture in near], widening)


def _reweighted(
    pictures: Sequence[Picture],
    optimum: Optimum,
    free: Bool[np.ndarray, "3 C"],
    n_range: tuple[float, float],
    tied: Float[np.ndarray, " C"] | None,
    noise: float,
    rounding: float,
) -> Evidence:
    """Where rounding is little beside the noise: least squares in codes, and what an open end says in a value's place.

    Args:
        pictures: with bounds.
        optimum: of least squares in radiance.
        free: which coefficients may be above 0.
        n_range: bounds of the exponent.
        tied: x_s is a common factor times this.
        noise: standard deviation of the residual in codes.
        rounding: what its variance owes to rounding.
    """
    stated = [_stated(picture, optimum, noise, rounding) for picture in pictures]
    for _ in range(MOST_ROUNDS):
        before, optimum = optimum, refit([part.picture for part in stated], optimum, free, n_range, tied)
        last, stated = noise, [_stated(picture, optimum, noise, rounding) for picture in pictures]
        noise = math.sqrt(sum(part.squares for part in stated) / max(sum(part.count for part in stated), 1))
        if _change(before, optimum) < ENOUGH_CHANGE and abs(noise / last - 1) < ENOUGH_CHANGE:
            break
    scale = 1 / noise**2
    working = [dataclasses.replace(part.picture, weight=part.picture.weights * scale) for part in stated]
    sums = {name: getattr(optimum, name) * scale for name in ("cost", "gram", "product", "square")}
    value = sum(part.value - part.closed * math.log(noise) - part.closed_squares * scale / 2 for part in stated)
    places = [_place(picture) for picture in pictures]
    return Evidence(working, dataclasses.replace(optimum, **sums), noise, value, places, np.ones(3 * free.shape[1] + 1))


def _change(before: Optimum, after: Optimum) -> float:
    """The largest change of a number, in standard errors that the others leave."""
    noise = np.maximum(after.cost, np.finfo(float).tiny) / np.maximum(after.pixels, 1)
    x = np.abs(after.x - before.x) * np.sqrt(np.diagonal(after.gram, axis1=1, axis2=2)[:, :3].T / noise)
    by_n = abs(after.n - before.n) * np.sqrt(np.sum(after.gauss_newton[:, 3, 3] / noise))
    return float(max(np.max(x), by_n))


@dataclasses.dataclass(frozen=True)
class _Stated:
    """A picture as least squares takes it.

    Attributes:
        picture: with working targets, and weights in codes².
        squares: of the residual in codes; of a value at an open end what is to be expected.
        count: of how many values.
        closed: how many of these have both ends.
        closed_squares: of their residual.
        value: logarithm of the likelihood of the others.
    """

    picture: Picture
    squares: float
    count: int
    closed: int
    closed_squares: float
    value: float


def _stated(picture: Picture, optimum: Optimum, noise: float, rounding: float) -> _Stated:
    bounds = picture.bounds
    assert bounds is not None
    made = jax.device_get(_linearised(picture, np.asarray(optimum.n), optimum.x))
    target, weight = np.array(made[0]), np.array(made[1])
    squares, closed = float(made[2]), int(made[3])
    plain, value, count = squares, 0.0, closed
    half = np.isfinite(np.asarray(bounds.lower)) ^ np.isfinite(np.asarray(bounds.upper))
    index = np.flatnonzero(half.any(axis=1))
    if index.size:
        s = math.sqrt(max(noise**2 - rounding, LEAST_NOISE**2))
        some = _some(dataclasses.replace(picture, bounds=dataclasses.replace(bounds, exact=False)), index)
        told = _told(some, Estimate(optimum.x, math.log(optimum.n), s))
        told = _Told(*(part[..., : index.size, :] for part in told))
        at_end, own = half[index], s * np.asarray(bounds.spread)[index if bounds.spread.ndim else ...]
        curvature = told.weight * told.slope**2
        step = np.divide(told.score * told.slope, curvature, out=np.zeros_like(curvature), where=curvature > 0)
        target[index] = np.where(at_end, told.radiance + step, target[index])
        weight[index] = np.where(at_end, curvature * noise**2, weight[index])
        # Mean square of what the value may have been, about the prediction.
        expected = ((told.score * own) ** 2 + 1 - told.weight * own**2) * noise**2
        squares += float(np.sum(expected, where=at_end))
        value, count = float(np.sum(told.value, where=at_end)), closed + int(np.count_nonzero(at_end))
    taken = dataclasses.replace(picture, target=jnp.asarray(target), weight=jnp.asarray(weight), bounds=None)
    return _Stated(taken, squares, count, closed, plain, value)


@eqx.filter_jit
def _linearised(picture: Picture, n: AnyArray, x: AnyArray) -> tuple[Array, Array, Array, Array]:
    """Working targets and weights of values with both ends, squares of their residuals in codes, their count."""
    bounds = picture.bounds
    assert bounds is not None
    dtype = picture.target.dtype
    radiance = picture.predicted(n, x)
    code, slope = bounds.codes(radiance)
    closed = jnp.isfinite(bounds.lower) & jnp.isfinite(bounds.upper)
    middle = 0.5 * (jnp.where(closed, bounds.lower, 0.0) + jnp.where(closed, bounds.upper, 0.0))
    residual = jnp.where(closed, middle - code, 0.0)
    weight = jnp.where(closed, (slope / bounds.spread) ** 2, 0.0)
    squares = jnp.sum((residual / bounds.spread).astype(jnp.float64) ** 2)
    return (radiance + residual / slope).astype(dtype), weight.astype(dtype), squares, jnp.count_nonzero(closed)


def _place(picture: Picture) -> tuple[np.ndarray, int]:
    """Index of the pixels in their picture, and its width."""
    assert picture.bounds is not None
    return np.asarray(picture.bounds.index), int(picture.bounds.width)


def _telling(known: Sequence[Precision]) -> Precision:
    """Where the values say most of all unknowns together.

    With less noise all pixels of a small highlight may lie well inside their codes, and the Hessian there says nothing.
    """
    return max(known, key=lambda entry: entry.information)


def _widening(known: Sequence[Precision], most: Precision) -> Float[np.ndarray, " U"]:
    """What to multiply errors by: each unknown is known as well as where enough values still tell of it."""
    variance = np.array([entry.variance for entry in known])
    enough = np.array([entry.count for entry in known]) >= ENOUGH_VALUES
    # With the most noise all values tell.
    enough[0] = True
    least = np.min(np.where(enough & (variance > 0), variance, np.inf), axis=0)
    ratio = np.divide(least, most.variance, out=np.ones_like(least), where=(most.variance > 0) & np.isfinite(least))
    return np.sqrt(ratio)


def maximise(pictures: Sequence[Picture], start: Estimate, space: _Space) -> tuple[Estimate, list[Precision]]:
    """The most likely coefficients, exponent and noise; and what was known of them on the way.

    Args:
        pictures: with bounds.
        start: whose noise is where the halving starts.
        space: where to look.
    """
    at, now = _climb(pictures, start, space)
    above, below, known = None, None, [_precision(pictures, at, now, space)]
    # Less noise makes it likelier: halve.
    while now.by_log_noise < 0 and at.noise > LEAST_NOISE:
        above = at, now
        pictures = [_gathered(picture, at) for picture in pictures]
        at, now = _climb(pictures, at._replace(noise=max(at.noise / 2, LEAST_NOISE)), space)
        known.append(_precision(pictures, at, now, space))
    if now.by_log_noise <= 0:
        return at, known
    below = at, now
    while above is None:
        trial, sums = _climb(pictures, at._replace(noise=at.noise * 2), space)
        if sums.by_log_noise < 0:
            above = trial, sums
        else:
            below = at, now = trial, sums
    # In between, where the derivative by the noise is 0.
    for _ in range(3):
        low, high = float(below[1].by_log_noise), float(above[1].by_log_noise)
        share = min(max(low / (low - high), 0.1), 0.9)
        noise = below[0].noise * (above[0].noise / below[0].noise) ** share
        if max(noise, at.noise) < ENOUGH_KNOWN * min(noise, at.noise):
            break
        at, now = _climb(pictures, below[0]._replace(noise=noise), space)
        below, above = ((at, now), above) if now.by_log_noise > 0 else (below, (at, now))
    return at, [*(entry for entry in known if entry.noise > at.noise), _precision(pictures, at, now, space)]


def _precision(pictures: Sequence[Picture], at: Estimate, now: _Sums, space: _Space) -> Precision:
    """Variance of each unknown at some noise, and how many values tell of it."""
    channels = at.x.shape[1]
    whole = join_channels(now.weight, now.score, np.zeros(channels), at.x[2], np.ones(channels)).gram
    active = np.append(at.x.ravel() > 0, at.x[2].any())
    moved = space.design[:, active @ np.abs(space.design) > 0]
    moved = moved[:, np.einsum("uv,uw,wv->v", moved, whole, moved) > np.finfo(float).tiny]
    gram = moved.T @ whole @ moved
    scale = np.sqrt(np.diag(gram))
    value, vector = np.linalg.eigh(gram / np.outer(scale, scale))
    # What nothing tells of has a large variance, not none; a column of zeros is no unknown.
    value = np.maximum(value, np.finfo(float).eps)
    root = moved @ (vector / np.sqrt(value) / scale[:, None])
    influence, information = root @ root.T, float(np.sum(np.log(value)) + 2 * np.sum(np.log(scale)))
    total, squares = np.zeros(len(whole)), np.zeros(len(whole))
    for picture in pictures:
        told = _told(picture, at)
        weight = told.weight * told.slope**2
        for channel in range(channels):
            rows = influence[[channel, channels + channel, 2 * channels + channel, -1]]
            rows = rows * np.array([1.0, 1.0, 1.0, at.x[2, channel]])[:, None]
            share = weight[:, channel] * np.square(rows.T @ told.columns[..., channel])  # (U, P)
            total, squares = total + share.sum(axis=1), squares + np.square(share).sum(axis=1)
    count = np.divide(total**2, squares, out=np.zeros_like(total), where=squares > 0)
    return Precision(at.noise, information, np.diag(influence), count)


def _climb(pictures: Sequence[Picture], at: Estimate, space: _Space) -> tuple[Estimate, _Sums]:
    """Newton's method at a given noise."""
    design, channels = space.design, at.x.shape[1]
    signed = np.zeros(design.shape[1], bool)
    lobe = bool(design[-1].any())
    signed[-1:] = lobe
    now = _sums(pictures, at)
    for _ in range(MOST_STEPS):
        normal = join_channels(now.weight, now.score, np.zeros(channels), at.x[2], np.ones(channels))
        unknowns = np.append(at.x.ravel(), 0.0)
        gram = design.T @ normal.gram @ design
        gram[np.diag_indices_from(gram)] *= 1 + 1e-9
        product = design.T @ (normal.product + normal.gram @ unknowns)
        step = design @ nonnegative_minimum(gram, product, signed) - unknowns
        # What the step is going to gain.
        if step @ (normal.product - 0.5 * normal.gram @ step) < LEAST_GAIN:
            break
        gain = 0.0
        for halvings in range(12):
            share = 0.5**halvings
            x = np.maximum(unknowns[:-1] + share * step[:-1], 0.0).reshape(3, channels)
            shift = float(np.clip(share * step[-1], -LARGEST_SHIFT, LARGEST_SHIFT))
            trial = at._replace(x=x, log_n=float(np.clip(at.log_n + shift, *space.bounds)) if lobe else at.log_n)
            sums = _sums(pictures, trial)
            gain = float(sums.value - now.value)
            if gain > 0:
                at, now = trial, sums
                break
        if gain < LEAST_GAIN:
            break
    return at._replace(value=float(now.value)), now


def _sums(pictures: Sequence[Picture], at: Estimate) -> _Sums:
    """What Newton's step needs, added up over the pictures."""
    parts = []
    for picture in pictures:
        said, bounds = _told(picture, at), picture.bounds
        assert bounds is not None
        weight = np.ones((1, 1)) if picture.weight is None else np.asarray(picture.weights)
        score, curvature = weight * said.score * said.slope, weight * said.weight * said.slope**2
        columns = np.moveaxis(said.columns, -1, 0)  # (C, 4, P)
        parts.append(
            (
                float(np.sum(weight * said.value)),
                float(np.sum(weight * (said.score**2 - said.weight) * (at.noise * np.asarray(bounds.spread)) ** 2)),
                (columns @ score.T[..., None])[..., 0],
                (columns * curvature.T[:, None]) @ np.swapaxes(columns, 1, 2),
            )
        )
    return _Sums(*(sum(part) for part in zip(*parts, strict=True)))


def _in_double(picture: Picture) -> Picture:
    numbers, rest = eqx.partition(picture, eqx.is_inexact_array_like)
    return eqx.combine(jax.tree.map(lambda leaf: jnp.asarray(leaf, np.float64), numbers), rest)


def _gathered(picture: Picture, at: Estimate) -> Picture:
    """The pixels that say something: those not surely inside their bounds."""
    assert picture.bounds is not None
    index = np.flatnonzero(np.any(_inside(picture, at) < REACH, axis=1))
    if _length(index.size) >= picture.target.shape[0] and picture.target.dtype == np.float64:
        return picture
    return _some(picture, index)


def _stratum(picture: Picture, size: int) -> Picture:
    """Some of the pixels, weighted by how many each stands for."""
    count = picture.target.shape[0]
    if count <= size:
        return _in_double(picture)
    nearness = np.zeros(count) if picture.lobe is None else -np.asarray(picture.lobe.peak)
    index, factor = stratified(nearness, np.ones(count, bool), size)
    some = _some(picture, index)
    weight = np.zeros(some.target.shape[0])
    weight[: index.size] = factor
    return dataclasses.replace(some, weight=jnp.asarray(weight))


def _length(count: int) -> int:
    """A few lengths, hence a few compilations."""
    return next((few for few in FEW if count <= few), -(-count // FEW[-1]) * FEW[-1])


def _some(picture: Picture, index: np.ndarray) -> Picture:
    """Some of the pixels, in double precision; what fills up may have lain anywhere."""
    filled = np.arange(_length(index.size))[:, None] >= index.size
    padded = np.concatenate([index, np.zeros(filled.size - index.size, index.dtype)])
    some = _in_double(picture.pixels(lambda values: jnp.asarray(np.take(np.asarray(values), padded, axis=0))))
    assert some.bounds is not None
    lower, upper = np.where(filled, -np.inf, some.bounds.lower), np.where(filled, np.inf, some.bounds.upper)
    bounds = dataclasses.replace(some.bounds, lower=jnp.asarray(lower), upper=jnp.asarray(upper))
    return dataclasses.replace(some, bounds=bounds)


class _Told(NamedTuple):
    """What each value says of a prediction: log-likelihood, score and weight by the predicted code, (P, C).

    Also the radiance that is predicted, the slope of the code by it, and the columns ambient, diffuse, lobe and
    derivative of the lobe by log n, (4, P, C).
    """

    value: Any
    score: Any
    weight: Any
    radiance: Any
    slope: Any
    columns: Any


def _told(picture: Picture, at: Estimate) -> _Told:
    bounds = picture.bounds
    assert bounds is not None
    code, *rest = jax.device_get(_predictions(picture, at.x, np.asarray(at.log_n)))
    said = None
    if not bounds.spread.ndim:
        noise = at.noise * float(bounds.spread)
        said = tabulated(np.asarray(bounds.lower), np.asarray(bounds.upper), code, noise)
    return _Told(*(said or jax.device_get(_said(bounds, code, np.asarray(at.noise)))), *rest)


@eqx.filter_jit
def _said(bounds: Bounds, code: AnyArray, noise: AnyArray) -> LogLikelihood:
    return bounds.said(jnp.asarray(code), jnp.asarray(noise))


@eqx.filter_jit
def _predictions(picture: Picture, x: AnyArray, log_n: AnyArray) -> tuple[Array, Array, Array, Array]:
    """Codes, radiance, slope of the code by it, and columns."""
    assert picture.bounds is not None
    shape = picture.target.shape
    columns = [jnp.asarray(picture.ambient).reshape(1, -1), picture.diffuse, jnp.zeros((1, 1)), jnp.zeros((1, 1))]
    if picture.lobe is not None:
        value, by_n = picture.lobe(jnp.exp(log_n))
        columns[2:] = value, by_n * jnp.exp(log_n)
    columns = jnp.stack([jnp.broadcast_to(column, shape).astype(jnp.float64) for column in columns])
    radiance = columns[0] * x[0] + columns[1] * x[1] + columns[2] * x[2]
    code, slope = picture.bounds.codes(radiance)
    return code, radiance, slope, columns


@eqx.filter_jit
def _codes(picture: Picture, x: AnyArray, log_n: AnyArray) -> Array:
    """What is predicted, in codes."""
    assert picture.bounds is not None
    return picture.bounds.codes(picture.predicted(jnp.exp(log_n), x).astype(jnp.float64))[0]


def _inside(picture: Picture, at: Estimate) -> np.ndarray:
    """How far inside its bounds each prediction is, in standard deviations of the noise, (P, C)."""
    assert picture.bounds is not None
    code = np.asarray(_codes(picture, at.x, np.asarray(at.log_n)))
    inside = np.minimum(code - np.asarray(picture.bounds.lower), np.asarray(picture.bounds.upper) - code)
    return inside / (at.noise * np.asarray(picture.bounds.spread))


def _widest(picture: Picture) -> float:
    """The largest distance of two ends: of floats that grows with brightness."""
    assert picture.bounds is not None
    width = np.asarray(picture.bounds.upper) - np.asarray(picture.bounds.lower)
    return float(np.max(width, where=np.isfinite(width), initial=0.0))


def _open_ends_tell(picture: Picture, at: Estimate) -> bool:
    """Whether some value is known by one end only and is predicted near it."""
    assert picture.bounds is not None
    half = np.isfinite(np.asarray(picture.bounds.lower)) ^ np.isfinite(np.asarray(picture.bounds.upper))
    return bool(half.any()) and bool(np.any(_inside(picture, at)[half] < END_REACH))


def unexplained(picture: Picture, x: np.ndarray, n: float) -> np.ndarray:
    """By how much predictions miss the values, or the bounds between which these lay, times the root of the weight.

    Args:
        picture: of a fit.
        x: coefficients, (3, C).
        n: exponent.
    """
    if picture.bounds is None:
        left = np.asarray(picture.target) - np.asarray(picture.predicted(np.asarray(n), x))
        return np.where(np.asarray(picture.weights) > 0, left, 0.0) * np.sqrt(np.asarray(picture.weights))
    code = np.asarray(_codes(picture, x, np.asarray(np.log(n))))
    lower, upper = np.asarray(picture.bounds.lower), np.asarray(picture.bounds.upper)
    return np.maximum(lower - code, 0.0) - np.maximum(code - upper, 0.0)


def _working(picture: Picture, said: _Told) -> Picture:
    """Targets and weights with which least squares takes Newton's step."""
    weight = said.weight * said.slope**2
    step = np.divide(said.score * said.slope, weight, out=np.zeros_like(weight), where=weight > 0)
    target = jnp.asarray(said.radiance + step)
    return dataclasses.replace(picture, target=target, weight=jnp.asarray(weight), bounds=None)
