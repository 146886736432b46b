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
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from fitting.likelihood import AnyArray, Bounds, Intervals
from fitting.model_fit import Evidence, ModelFit
from fitting.solver.nnls import nonnegative_minimum
from fitting.solver.normal_equations import Picture
from fitting.solver.profile import Optimum, refit
from fitting.solver.subsample import stratified
from fitting.solver.tied import design_of, join_channels

# In codes: below this the edges of codes are as sharp as the arithmetic of the basis images.
LEAST_NOISE = 1e-4
# A pixel says nothing where its code is as good as certain: this many s from the nearer edge.
REACH = 7.0
# One that has come nearer than this on the way is taken in.
NEARER = 5.0
# Newton's steps at one s; a step that gains less ends them.
MOST_STEPS, LEAST_GAIN = 12, 1e-3
# The largest change of log n in one step.
LARGEST_SHIFT = 0.5
# The noise is known well enough where it changes by less than this factor.
ENOUGH_KNOWN = 1.02
# Where the Hessian is no larger all values are surely inside their codes.
NOTHING = 1e-100
# So many values have to tell of a number before the Hessian is taken for its error.
FEWEST_VALUES = 6.0
SUBSAMPLE = 16384
# In codes: with more noise than this, and no code at an end, a linear picture says what least squares says.
ENOUGH_NOISE = 0.5
FIRST_NOISE = 0.3
# Rounds of least squares in codes; each leaves some hundredth of its change. What ends them: such a change, in standard
# errors, and this one of the noise.
MOST_ROUNDS, ENOUGH_CHANGE, ENOUGH_NOISE_CHANGE = 10, 2.0, 0.02
# Predictions are the same to such a share of a code, where these are so many values, and so many times as usual.
ALIKE, FEWEST_ALIKE, MORE_ALIKE = 1024, 64, 10
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
    told: Sequence["_Told"]


class _Space(NamedTuple):
    """Where Newton's method may go.

    Attributes:
        design: what each unknown moves of x_a, x_d, x_s, channel after channel, and log n.
        bounds: of log n.
    """

    design: Float[np.ndarray, "U V"]
    bounds: tuple[float, float]


class _Pixels(NamedTuple):
    """Some pixels of a picture, on the host in double precision.

    Attributes:
        picture: its weight is how many pixels each stands for; None for one.
        intervals: between which codes the values lay.
    """

    picture: Picture
    intervals: Intervals

    @classmethod
    def of(cls, picture: Picture) -> "_Pixels":
        """All of a picture on the host."""
        bounds = _bounds(picture)
        return cls(picture, Intervals(bounds.lower, bounds.upper, bounds.spread))

    def some(self, which: Bool[np.ndarray, " P"]) -> "_Pixels":
        """Some of them, or themselves where these are all."""
        return self if which.all() else _Pixels.of(self.picture.in_double(np.flatnonzero(which)))


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


def most_likely(fit: ModelFit, *, copies: bool = False) -> ModelFit:
    """A fit by what rounded values and open ends say, from least squares on; as it is where they say no more.

    Args:
        fit: by least squares.
        copies: the channels are copies of each other.
    """
    if fit.capped or any(picture.bounds is None for picture in fit.pictures):
        return fit
    optimum, exact = fit.optimum, all(bounds.exact for bounds in map(_bounds, fit.pictures))
    deviation = math.sqrt(float(np.sum(optimum.cost)) / max(float(np.sum(optimum.pixels)), 1.0))
    if exact and deviation <= NO_NOISE * float(np.max(optimum.square / np.maximum(optimum.pixels, 1))) ** 0.5:
        return fit
    at = Estimate(optimum.x, math.log(optimum.n), 1.0)
    squares, counts = zip(*(_squares(picture, at) for picture in fit.pictures), strict=True)
    at = at._replace(noise=math.sqrt(sum(squares) / max(sum(counts), 1)))
    lossy = any(bounds.lossy for bounds in map(_bounds, fit.pictures))
    # Weights of least squares leave out what is clipped, which says something here.
    weights = [_alike(picture, at) if lossy else None for picture in fit.pictures]
    pictures = list(map(_with_weight, fit.pictures, weights))
    rounding = 0.0 if exact else 1 / 12
    widest = 1.0 if exact else max(_widest(picture) for picture in pictures)
    if exact or lossy or at.noise**2 > (ENOUGH_NOISE**2 + rounding) * widest**2:
        linear = all(bounds.encoding == "linear" for bounds in map(_bounds, pictures))
        if linear and not lossy and not any(_open_ends_tell(picture, at) for picture in pictures):
            return fit
        said = _reweighted(fit._replace(pictures=pictures), at.noise, rounding)
    else:
        at = at._replace(noise=max(at.noise, FIRST_NOISE))
        # Copies of a value tell no more of what all channels share.
        fewest = np.full(optimum.x.size + 1, FEWEST_VALUES)
        fewest[-1] *= optimum.square.size if copies else 1
        said = _near_edges(fit._replace(pictures=pictures), at, fewest)
    found = said.optimum
    optimum = dataclasses.replace(optimum, x=found.x, n=found.n, flat=found.flat)
    return fit._replace(optimum=optimum, evidence=said)


def _with_weight(picture: Picture, weight: np.ndarray | None) -> Picture:
    return dataclasses.replace(picture, weight=weight)


def _alike(picture: Picture, at: Estimate) -> Float[np.ndarray, "P C"]:
    """Weights for values whose prediction is the same, as on an unlit side: these share one rounding error.

    It came before the losses of the file, which hide it. N values of noise s whose mean has a further error of variance
    1 / 12 weigh 1 / (1 + N / 12 s²) each.
    """
    bounds, code = _bounds(picture), np.rint(_codes(picture, at) * ALIKE).astype(np.int64)
    tells, weight = np.isfinite(bounds.lower) | np.isfinite(bounds.upper), np.ones(code.shape)
    for one, some, own in zip(code.T, tells.T, weight.T, strict=True):
        _, kind, count = np.unique(one[some], return_inverse=True, return_counts=True)
        many = count > max(FEWEST_ALIKE, MORE_ALIKE * np.median(count)) if count.size else count > 0
        own[some] = np.where(many, 1 / (1 + count / (12 * at.noise**2)), 1.0)[kind]
    return weight


def _near_edges(fit: ModelFit, at: Estimate, fewest: Float[np.ndarray, " U"]) -> Evidence:
    """Where rounding is most of the noise: what pixels near the edge of a code say."""
    least, most = map(math.log, fit.n_range)
    pictures, space = fit.pictures, _Space(design_of(fit.free, fit.tied), (least, most))
    if sum(picture.target.shape[0] for picture in pictures) > 2 * SUBSAMPLE:
        at, known = maximise([_stratum(picture, SUBSAMPLE // len(pictures)) for picture in pictures], at, space)
        # The whole picture has the pixels near an edge that a part of it lacks.
        at = at._replace(noise=_telling(known, fewest).noise)
    near = [np.flatnonzero(_near(picture, at, REACH)) for picture in pictures]
    gathered = [_Pixels.of(picture.in_double(some)) for picture, some in zip(pictures, near, strict=True)]
    at, known = maximise(gathered, at, space)
    telling = at._replace(noise=_telling(known, fewest).noise)
    near = [part.some(_near(part.picture, telling, REACH)) for part in gathered]
    sums = _sums(near, telling)
    widening = _widening(known, _precision(telling, sums, space), fewest)
    working = [_working(pixels.picture, said) for pixels, said in zip(near, sums.told, strict=True)]
    optimum = _optimum(working, sums, fit, at)
    return Evidence(working, optimum, at.noise, at.value, [_place(part.picture) for part in near], widening)


def _optimum(working: Sequence[Picture], sums: _Sums, fit: ModelFit, at: Estimate) -> Optimum:
    """The optimum of the least squares that takes Newton's step, at which it rests."""
    scale, steps = np.ones(4), np.zeros(at.x.shape[1])
    # By n, not by its logarithm.
    scale[3] = math.exp(-at.log_n)
    if not fit.free[2].any():
        scale[2:] = 0.0
    gram, score = sums.weight * scale[:, None] * scale, sums.score * scale
    product = score + np.einsum("cij,jc->ci", gram[..., :3], at.x)
    square, count = np.zeros_like(steps), np.zeros_like(steps)
    for picture in working:
        weight = np.asarray(picture.weights)
        left = np.asarray(picture.target) - picture.predicted(np.exp(at.log_n), at.x)
        steps += np.sum(weight * left**2, axis=0)
        square += np.sum(weight * np.asarray(picture.target) ** 2, axis=0)
        count += np.count_nonzero(weight, axis=0)
    flat = not np.any(at.x[2] > 0)
    return dataclasses.replace(
        fit.optimum,
        **{"n": math.exp(at.log_n), "x": at.x, "cost": steps, "pixels": count, "gram": gram, "product": product},
        square=square,
        flat=flat,
    )


def _reweighted(fit: ModelFit, noise: float, rounding: float) -> Evidence:
    """Where rounding is little beside the noise: least squares in codes, and what an open end says in a value's place.

    Args:
        fit: by least squares in radiance.
        noise: standard deviation of the residual in codes.
        rounding: what its variance owes to rounding.
    """
    pictures, optimum = fit.pictures, fit.optimum
    with jax.enable_x64(True):
        stated = [_stated(picture, optimum, noise, rounding) for picture in pictures]
        for _ in range(MOST_ROUNDS):
            working = [part.picture for part in stated]
            before, optimum = optimum, refit(working, optimum, fit.free, fit.n_range, fit.tied)
            last, stated = noise, [_stated(picture, optimum, noise, rounding) for picture in pictures]
            noise = math.sqrt(sum(part.squares for part in stated) / max(sum(part.count for part in stated), 1))
            if _change(before, optimum) < ENOUGH_CHANGE and abs(noise / last - 1) < ENOUGH_NOISE_CHANGE:
                break
    scale = 1 / noise**2
    working = [dataclasses.replace(part.picture, weight=part.picture.weights * scale) for part in stated]
    sums = {name: getattr(optimum, name) * scale for name in ("cost", "gram", "product", "square")}
    value = sum(part.value - part.closed * math.log(noise) - part.closed_squares * scale / 2 for part in stated)
    widening = np.ones(3 * fit.free.shape[1] + 1)
    optimum = dataclasses.replace(optimum, **sums)
    return Evidence(working, optimum, noise, value, [_place(picture) for picture in pictures], widening)


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
        squares: of the residual in codes times the weight; of a value at an open end what is to be expected.
        count: of how many values, by their weight.
        closed: how many of these have both ends.
        closed_squares: of their residual.
        value: logarithm of the likelihood of the others.
    """

    picture: Picture
    squares: float
    count: float
    closed: float
    closed_squares: float
    value: float


def _stated(picture: Picture, optimum: Optimum, noise: float, rounding: float) -> _Stated:
    bounds = _bounds(picture)
    made = jax.device_get(_linearised(picture, np.asarray(optimum.n), optimum.x))
    target, weight = np.array(made[0]), np.array(made[1])
    squares, closed = float(made[2]), float(made[3])
    plain, value, count = squares, 0.0, closed
    half = np.isfinite(bounds.lower) ^ np.isfinite(bounds.upper)
    index = np.flatnonzero(half.any(axis=1))
    if index.size:
        s = math.sqrt(max(noise**2 - rounding, LEAST_NOISE**2))
        pixels = _Pixels.of(picture.in_double(index))
        (told,) = _sums([pixels], Estimate(optimum.x, math.log(optimum.n), s)).told
        told = _Told(*(part[..., : index.size, :] for part in told))
        at_end, own = half[index], s * bounds.spread[index if bounds.spread.ndim else ...]
        weighs = np.broadcast_to(pixels.picture.weights, told.value.shape)[: index.size]
        curvature = told.weight * told.slope**2
        step = np.divide(told.score * told.slope, curvature, out=np.zeros_like(curvature), where=curvature > 0)
        target[index] = np.where(at_end, told.radiance + step, target[index])
        weight[index] = np.where(at_end, weighs * curvature * noise**2, weight[index])
        # Mean square of what the value may have been, about the prediction.
        expected = ((told.score * own) ** 2 + 1 - told.weight * own**2) * noise**2
        squares += float(np.sum(weighs * expected, where=at_end))
        value, count = float(np.sum(weighs * told.value, where=at_end)), closed + float(np.sum(weighs, where=at_end))
    taken = dataclasses.replace(picture, target=jnp.asarray(target), weight=jnp.asarray(weight), bounds=None)
    return _Stated(taken, squares, count, closed, plain, value)


@eqx.filter_jit
def _linearised(picture: Picture, n: AnyArray, x: AnyArray) -> tuple[Array, Array, Array, Array]:
    """Working targets and weights of values with both ends, squares of their residuals in codes, their count."""
    bounds, dtype = _bounds(picture), picture.target.dtype
    radiance = picture.predicted(n, x)
    code, slope = bounds.codes(radiance)
    closed = jnp.isfinite(bounds.lower) & jnp.isfinite(bounds.upper)
    middle = 0.5 * (jnp.where(closed, bounds.lower, 0.0) + jnp.where(closed, bounds.upper, 0.0))
    residual = jnp.where(closed, middle - code, 0.0)
    counts = jnp.where(closed, picture.weights, 0.0)
    squares = jnp.sum((counts * (residual / bounds.spread) ** 2).astype(jnp.float64))
    weight = (counts * (slope / bounds.spread) ** 2).astype(dtype)
    return (radiance + residual / slope).astype(dtype), weight, squares, jnp.sum(counts.astype(jnp.float64))


def _place(picture: Picture) -> tuple[np.ndarray, int]:
    """Index of the pixels in their picture, and its width."""
    bounds = _bounds(picture)
    return np.asarray(bounds.index), int(bounds.width)


def _telling(known: Sequence[Precision], fewest: Float[np.ndarray, " U"]) -> Precision:
    """Where the values say most of all unknowns together, and enough of them of each.

    With less noise all pixels of a small highlight may lie well inside their codes, and the Hessian there says nothing.
    """
    enough = [entry for entry in known[1:] if np.all((entry.count >= fewest) | (known[0].variance == 0))]
    return max([known[0], *enough], key=lambda entry: entry.information)


def _widening(known: Sequence[Precision], most: Precision, fewest: Float[np.ndarray, " U"]) -> Float[np.ndarray, " U"]:
    """What to multiply errors by: each unknown is known as well as where enough values still tell of it."""
    variance = np.array([entry.variance for entry in known])
    enough = np.array([entry.count for entry in known]) >= fewest
    # With the most noise all values tell.
    enough[0] = True
    least = np.min(np.where(enough & (variance > 0), variance, np.inf), axis=0)
    ratio = np.divide(least, most.variance, out=np.ones_like(least), where=(most.variance > 0) & np.isfinite(least))
    return np.sqrt(ratio)


def maximise(pixels: Sequence[_Pixels], start: Estimate, space: _Space) -> tuple[Estimate, list[Precision]]:
    """The most likely coefficients, exponent and noise; and what was known of them on the way.

    Args:
        pixels: of each picture.
        start: whose noise is where the halving starts.
        space: where to look.
    """
    at, now = _climb(pixels, start, space)
    above, known = None, [_precision(at, now, space)]
    # Less noise makes it likelier: halve.
    while now.by_log_noise < 0 and at.noise > LEAST_NOISE:
        above = at, now
        at, now = _climb(pixels, at._replace(noise=max(at.noise / 2, LEAST_NOISE)), space)
        known.append(_precision(at, now, space))
    if now.by_log_noise <= 0:
        return at, known
    below = at, now
    while above is None:
        trial, sums = _climb(pixels, at._replace(noise=at.noise * 2), space)
        if sums.by_log_noise < 0:
            above = trial, sums
        else:
            below = at, now = trial, sums
    # In between, where the derivative by the noise is 0.
    for _ in range(3):
        low, high = float(below[1].by_log_noise), float(above[1].by_log_noise)
        share = min(max(low / (low - high), 0.01), 0.99)
        noise = below[0].noise * (above[0].noise / below[0].noise) ** share
        if max(noise, at.noise) < ENOUGH_KNOWN * min(noise, at.noise):
            break
        at, now = _climb(pixels, at._replace(noise=noise), space)
        below, above = ((at, now), above) if now.by_log_noise > 0 else (below, (at, now))
    return at, [*(entry for entry in known if entry.noise > at.noise), _precision(at, now, space)]


def _precision(at: Estimate, now: _Sums, space: _Space) -> Precision:
    """Variance of each unknown at some noise, and how many values tell of it."""
    channels = at.x.shape[1]
    whole = join_channels(now.weight, now.score, np.zeros(channels), at.x[2], np.ones(channels)).gram
    active = np.append(at.x.ravel() > 0, at.x[2].any())
    moved = space.design[:, active @ np.abs(space.design) > 0]
    moved = moved[:, np.einsum("uv,uw,wv->v", moved, whole, moved) > NOTHING]
    gram = moved.T @ whole @ moved
    scale = np.sqrt(np.diag(gram))
    value, vector = np.linalg.eigh(gram / np.outer(scale, scale))
    # What nothing tells of has a large variance, not none; a column of zeros is no unknown.
    value = np.maximum(value, np.finfo(float).eps)
    root = moved @ (vector / np.sqrt(value) / scale[:, None])
    influence, information = root @ root.T, float(np.sum(np.log(value)) + 2 * np.sum(np.log(scale)))
    total, squares = np.zeros(len(whole)), np.zeros(len(whole))
    # In units of its own error, or squares overflow where next to nothing tells.
    own = np.sqrt(np.diag(influence))
    relative = influence / np.where(own > 0, own, 1.0)[:, None]
    for said in now.told:
        weight = said.weight * said.slope**2
        for channel in range(channels):
            rows = relative.T[[channel, channels + channel, 2 * channels + channel, -1]]
            rows = rows * np.array([1.0, 1.0, 1.0, at.x[2, channel]])[:, None]
            share = weight[:, channel] * np.square(rows.T @ said.columns[..., channel])  # (U, P)
            total, squares = total + share.sum(axis=1), squares + np.square(share).sum(axis=1)
    count = np.divide(total**2, squares, out=np.zeros_like(total), where=squares > 0)
    return Precision(at.noise, information, np.diag(influence), count)


def _climb(whole: Sequence[_Pixels], at: Estimate, space: _Space) -> tuple[Estimate, _Sums]:
    """Newton's method at a given noise, with the pixels that say something there."""
    design, channels = space.design, at.x.shape[1]
    signed = np.zeros(design.shape[1], bool)
    lobe = bool(design[-1].any())
    signed[-1:] = lobe
    pictures, now = [part.picture for part in whole], None
    kept = list(map(partial(_near, at=at, reach=REACH), pictures))
    while True:
        if now is not None:
            # Others may say something at the new numbers.
            near = list(map(np.logical_or, kept, map(partial(_near, at=at, reach=NEARER), pictures)))
            if all(map(np.array_equal, near, kept)):
                return at._replace(value=float(now.value)), now
            kept = near
        pixels = list(map(_Pixels.some, whole, kept))
        now = _sums(pixels, at)
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
                sums = _sums(pixels, trial)
                gain = float(sums.value - now.value)
                if gain > 0:
                    at, now = trial, sums
                    break
            if gain < LEAST_GAIN:
                break


def _sums(pixels: Sequence[_Pixels], at: Estimate) -> _Sums:
    """What Newton's step needs, added up over the pictures."""
    parts, told = [], []
    for part in pixels:
        weight, bounds = part.picture.weights, _bounds(part.picture)
        columns = part.picture.columns(math.exp(at.log_n))
        columns[3] *= math.exp(at.log_n)
        radiance = columns[0] * at.x[0] + columns[1] * at.x[1] + columns[2] * at.x[2]
        code, slope = bounds.codes(radiance)
        said = _Told(*part.intervals.said(code, at.noise), radiance, slope, columns)
        told.append(said)
        own = at.noise * bounds.spread
        score, curvature = weight * said.score * said.slope, weight * said.weight * said.slope**2
        columns = np.moveaxis(said.columns, -1, 0)  # (C, 4, P)
        parts.append(
            (
                float(np.sum(weight * said.value)),
                float(np.sum(weight * (said.score**2 - said.weight) * own**2)),
                (columns @ score.T[..., None])[..., 0],
                (columns * curvature.T[:, None]) @ np.swapaxes(columns, 1, 2),
            )
        )
    value, by_log_noise, score, weight = (sum(part) for part in zip(*parts, strict=True))
    return _Sums(value, by_log_noise, score, weight, told)


def _near(picture: Picture, at: Estimate, reach: float) -> Bool[np.ndarray, " P"]:
    """Which pixels say something: those with a value not surely inside its bounds, by so many s."""
    bounds, code = _bounds(picture), _codes(picture, at)
    inside = np.minimum(code - bounds.lower, bounds.upper - code)
    return np.any(inside < reach * at.noise * bounds.spread, axis=1)


def _stratum(picture: Picture, size: int) -> _Pixels:
    """Some of the pixels, weighted by how many each stands for."""
    count = picture.target.shape[0]
    if count <= size:
        return _Pixels.of(picture.in_double(np.arange(count)))
    nearness = np.zeros(count) if picture.lobe is None else -np.asarray(picture.lobe.peak)
    index, factor = stratified(nearness, np.ones(count, bool), size)
    some = _Pixels.of(picture.in_double(index))
    weight = np.zeros(some.picture.target.shape[0])
    weight[: index.size] = factor
    return some._replace(picture=dataclasses.replace(some.picture, weight=weight))


def _bounds(picture: Picture) -> Bounds:
    assert picture.bounds is not None
    return picture.bounds


def _codes(picture: Picture, at: Estimate) -> np.ndarray:
    """What is predicted, in codes, (P, C)."""
    radiance = np.asarray(picture.predicted(np.exp(at.log_n), at.x), np.float64)
    return _bounds(picture).codes(radiance)[0]


def _squares(picture: Picture, at: Estimate) -> tuple[float, int]:
    """Of the residual in codes, summed over values with both ends, and their number."""
    bounds = _bounds(picture)
    closed = np.isfinite(bounds.lower) & np.isfinite(bounds.upper)
    middle = 0.5 * np.add(bounds.lower, bounds.upper, out=np.zeros(closed.shape), where=closed)
    left = np.where(closed, middle - _codes(picture, at), 0.0) / bounds.spread
    return float(np.sum(left**2)), int(np.count_nonzero(closed))


def _widest(picture: Picture) -> float:
    """The largest distance of two ends: of floats that grows with brightness."""
    width = _bounds(picture).upper - _bounds(picture).lower
    return float(np.max(width, where=np.isfinite(width), initial=0.0))


def _open_ends_tell(picture: Picture, at: Estimate) -> bool:
    """Whether some value is known by one end only and is predicted near it."""
    half = np.any(np.isfinite(_bounds(picture).lower) ^ np.isfinite(_bounds(picture).upper), axis=1)
    return bool(half.any()) and bool(np.any(_near(picture, at, END_REACH)[half]))


def highlight_in_codes(picture: Picture, x: np.ndarray, n: float) -> float:
    """By how many codes of its file a highlight changes a value at most; infinite without codes.

    Args:
        picture: of a fit.
        x: coefficients, (3, C).
        n: exponent.
    """
    if picture.bounds is None or picture.bounds.exact:
        return math.inf
    shown = [_codes(picture, Estimate(some, math.log(n), 1.0)) for some in (x, x * [[1], [1], [0]])]
    return float(np.max(shown[0] - shown[1]))


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
    code = _codes(picture, Estimate(x, math.log(n), 1.0))
    return np.maximum(picture.bounds.lower - code, 0.0) - np.maximum(code - picture.bounds.upper, 0.0)


def _working(picture: Picture, said: _Told) -> Picture:
    """Targets and weights with which least squares takes Newton's step."""
    weight = said.weight * said.slope**2
    step = np.divide(said.score * said.slope, weight, out=np.zeros_like(weight), where=weight > 0)
    return dataclasses.replace(picture, target=said.radiance + step, weight=weight, bounds=None)
