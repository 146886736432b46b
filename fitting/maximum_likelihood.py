"""The most likely material behind rounded values, from least squares on.

Where the noise before rounding is small, least squares is wrong twice: a rounding error is no noise, and a side of the
object that shows one code counts as thousands of independent values. What is maximised here is the likelihood of
`fitting.likelihood`: each value lay somewhere between the bounds that its code states.

The numbers of a picture are its coefficients, in which it is linear, and the exponent; the sums that Newton's method
(`fitting.continuation`) needs are those of least squares. It starts on a stratified subsample; of the whole picture
only the pixels near an edge are gathered for the last steps.
"""

import dataclasses
import math
from collections.abc import Iterator, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from brdf.vectors import quotient
from fitting.channel_errors import can_be_coupled, coupled, each_alone, improved, precision_of, replaced, residuals
from fitting.continuation import (
    ENOUGH_KNOWN,
    FEWEST_VALUES,
    LEAST_NOISE,
    REACH,
    STEP,
    Estimate,
    PictureScore,
    Problem,
    Score,
    at_least_one,
    maximise,
    most_informative,
    most_informative_score,
)
from fitting.likelihood import AnyArray, Bounds, Values, alike, in_light, is_curved, residual_deviation, weight_of_alike
from fitting.model_fit import Evidence, ModelFit
from fitting.solver.normal_equations import COMPILER_OPTIONS, Picture, Sums
from fitting.solver.profile import Optimum, refit, search
from fitting.solver.subsample import Lobes, Subsample, stratified
from fitting.solver.tied import design_of, places_of

SUBSAMPLE = 8192
# The noise of a part of the pixels is known well enough to this factor.
ROUGHLY_KNOWN = 1.2
# In codes: with more noise than this, and no code at an end, a linear picture says what least squares says.
ENOUGH_NOISE = 0.5
FIRST_NOISE = 0.3
# As much of the variance of what is left is noise at least, and not rounding.
LEAST_SHARE = 0.25
# Noise of one size in light, not in codes, where the logarithm of the likelihood is so much larger.
LIKELIER = 2.0
# Less noise than this, in codes, is the same in both.
FAINT = 0.02
# Rounds of least squares in codes; each leaves some hundredth of its change. What ends them: such a change, in standard
# errors, and this one of the noise, or what moves a number by such a part of its error where many ends are open. Then a
# round leaves a good part of the noise's own change, and is taken for so many rounds at most.
MOST_ROUNDS, ENOUGH_CHANGE, ENOUGH_NOISE_CHANGE, ENOUGH_MOVED, MOST_AHEAD = 15, 2.0, 0.02, 0.1, 10.0
# A subsample tells that a model is hopeless where the logarithm of its likelihood is so much below that of another one,
# and by such a share of itself: many pixels are near an edge where the model is wrong, and only there.
FAR_BELOW, FAR_BELOW_SHARE = 1000.0, 0.5
# An open end tells where a value is predicted within so many s of it; noise below this share of the picture is none.
END_REACH, NO_NOISE = 4.0, 1e-5


class Numbers(NamedTuple):
    """What a picture is predicted from; an optimum has both, too.

    Attributes:
        n: exponent.
        x: coefficients x_a, x_d, x_s, at least 0, (3, C).
    """

    n: float
    x: Float[np.ndarray, "3 C"]

    @classmethod
    def of(cls, unknowns: Float[np.ndarray, " U"]) -> "Numbers":
        """The unknowns: coefficients, channel after channel each, and log n."""
        return cls(math.exp(unknowns[-1]), unknowns[:-1].reshape(3, -1))


def most_likely(
    fit: ModelFit, *, grey: np.ndarray | None = None, precision: np.ndarray | None = None, rival: float = -math.inf
) -> ModelFit:
    """A fit by what rounded values and open ends say, from least squares on; as it is where they say no more.

    ``grey`` is x_s of a grey k_s, which a highlight has where channels err together, None for any colour; ``precision``
    that of `Evidence`. Of a fit that is by far less likely than its rival a subsample tells.
    """
    if fit.capped or any(picture.bounds is None for picture in fit.pictures):
        return fit
    optimum, bounds = fit.optimum, list(map(bounds_of, fit.pictures))
    exact, lossy = all(own.exact for own in bounds), any(own.lossy for own in bounds)
    if exact and fit.residual <= NO_NOISE:
        return fit
    noise = _deviation(fit.pictures, optimum)
    if not lossy:
        fit, noise = _where_noise_is_even(fit, noise)
    # Weights of least squares leave out what is clipped, which says something here.
    pictures = [dataclasses.replace(picture, weight=None) for picture in fit.pictures]
    if lossy:
        pictures = [
            dataclasses.replace(one, weight=weight_of_alike(alike(bounds_of(one), _codes(one, optimum)), noise))
            for one in pictures
        ]
    rounding = 0.0 if exact else 1 / 12
    # Of floats the distance of two ends grows with brightness.
    widest = 1.0 if exact else max(float(np.max(bounds_of(thinned(one)).widths, initial=0.0)) for one in pictures)
    if exact or lossy or noise**2 > (ENOUGH_NOISE**2 + rounding) * widest**2:
        even = all(own.encoding == "linear" and not own.spread.ndim for own in map(bounds_of, pictures))
        if even and not lossy and not any(_open_ends_tell(picture, optimum, noise) for picture in pictures):
            return fit
        together = lossy and not fit.copies and (grey is not None or fit.tied is not None) and can_be_coupled(pictures)
        if together and grey is not None:
            fit = fit._replace(tied=np.where(fit.free[2], grey, 0.0))
        evidence = _reweighted(fit._replace(pictures=pictures), noise, rounding, precision, together=together)
    else:
        start = Estimate(np.append(optimum.x.ravel(), math.log(optimum.n)), max(noise, FIRST_NOISE))
        evidence = _near_edges(fit._replace(pictures=pictures), start, rival)
    return fit._replace(
        optimum=dataclasses.replace(optimum, x=evidence.optimum.x, n=evidence.optimum.n), evidence=evidence
    )


def _deviation(pictures: Sequence[Picture], at: Optimum) -> float:
    """Standard deviation of what is left, in codes."""
    some = list(map(thinned, pictures))
    return residual_deviation(map(bounds_of, some), map(partial(_codes, at=at), some))


def thinned(picture: Picture) -> Picture:
    """Every so many of the pixels that say something, which tell the noise as well."""
    bounds = bounds_of(picture)
    tell = np.flatnonzero(np.isfinite(bounds.lower[:, 0]) | np.isfinite(bounds.upper[:, 0]))
    return picture if tell.size <= 2 * SUBSAMPLE else picture.in_double(tell[:: tell.size // SUBSAMPLE])


def _in_light(pictures: Sequence[Picture]) -> list[Picture]:
    bounds = in_light(list(map(bounds_of, pictures)))
    return [dataclasses.replace(picture, bounds=own) for picture, own in zip(pictures, bounds, strict=True)]


def _where_noise_is_even(fit: ModelFit, noise: float) -> tuple[ModelFit, float]:
    """A fit and its noise in codes, or in light where noise of one size there is likelier and more than rounding."""
    some = list(map(thinned, fit.pictures))
    if not is_curved(list(map(bounds_of, some))):
        return fit, noise
    light = _in_light(some)
    after = _deviation(light, fit.optimum)
    if not min(noise, after) > 0:
        return fit, noise
    widths = zip(map(bounds_of, some), map(bounds_of, light), strict=True)
    narrower = np.concatenate([np.log(own.widths / other.widths) for own, other in widths])
    if narrower.size * math.log(noise / after) - float(np.sum(narrower)) < LIKELIER:
        return fit, noise
    fit = fit._replace(pictures=_in_light(fit.pictures))
    return fit, _deviation(fit.pictures, fit.optimum)


def _evener_in_light(problem: "_Separable", at: Estimate, least: float) -> Estimate | None:
    """The most likely numbers with noise of one size in light, where they are likelier than any with it in codes.

    ``least`` is that of `maximise`, the same for both: with less noise any would be likelier.
    """
    if at.noise < FAINT or not is_curved(problem.bounds):
        return None
    light = list(map(_values, _in_light([values.picture for values in problem.pixels])))
    start = Estimate(at.unknowns, max(at.noise, FIRST_NOISE))
    even, *_ = maximise(_Separable(light, problem.design, problem.n_range, problem.copies), start, ROUGHLY_KNOWN, least)
    return even if even.value > at.value + LIKELIER else None


def _near_edges(fit: ModelFit, at: Estimate, rival: float = -math.inf) -> Evidence:
    """Where rounding is most of the noise: what pixels near the edge of a code say."""
    pictures, design = fit.pictures, design_of(fit.free, fit.tied)
    separable = partial(_Separable, design=design, n_range=fit.n_range, copies=fit.copies)
    large = sum(picture.target.shape[0] for picture in pictures) > 2 * SUBSAMPLE
    some = [_stratum(picture, SUBSAMPLE // len(pictures)) for picture in pictures] if large else _gathered(pictures, at)
    problem = separable(some)
    least = FEWEST_VALUES if large else 0.0
    at, precisions, score = maximise(problem, at, ROUGHLY_KNOWN if large else ENOUGH_KNOWN, least)
    if (even := _evener_in_light(problem, at, least)) is not None:
        return _near_edges(fit._replace(pictures=_in_light(pictures)), even, rival)
    if large and rival - at.value < max(FAR_BELOW, FAR_BELOW_SHARE * abs(at.value)):
        # The whole picture has the pixels near an edge that a part of it lacks.
        at = at._replace(noise=most_informative(precisions).noise)
        problem = separable(_gathered(pictures, at))
        at, precisions, score = maximise(problem, at, earlier=precisions)
    rounds = [(problem, precisions)]
    while len(rounds) <= MOST_ROUNDS and (factors := _more_noise(score, at.noise, fit.owner)).any():
        pixels = [_noisier(values, math.exp(factor)) for values, factor in zip(problem.pixels, factors, strict=True)]
        problem = separable(pixels)
        at, precisions, score = maximise(problem, at)
        rounds.append((problem, precisions))
    scores = [(one.score, one.weight, one.values.bounds.place) for one in score.pictures]
    steps = np.concatenate([(one.values.bounds.spread / one.slope).ravel() for one in score.pictures])
    light = at.noise * float(np.median(steps)) if steps.size else 0.0
    score, wider = most_informative_score(at, rounds)
    working = list(map(_newton_picture, score.pictures))
    optimum = _optimum(working, fit, Numbers.of(at.unknowns))
    places = [one.values.bounds.place for one in score.pictures]
    return Evidence(working, optimum, at.noise, at.value, places, wider, scores=scores, light=light)


def _more_noise(score: Score, noise: float, owner: Sequence[int]) -> Float[np.ndarray, " T"]:
    """Logarithms of the factor by which the picture of each tile has more noise than is said; 0 where that will do."""
    if max(owner, default=0) == 0:
        return np.zeros(len(score.pictures))
    _, slope, information = (
        np.bincount(owner, some) for some in zip(*(one.of_noise(noise) for one in score.pictures), strict=True)
    )
    step, largest = slope / np.maximum(information, 1.0), math.log(STEP)
    known = (np.abs(step) < math.log(ENOUGH_KNOWN)) | (step**2 * information < ENOUGH_MOVED)
    own = [noise * float(np.max(one.values.bounds.spread)) for one in score.pictures]
    least = np.minimum(np.log(LEAST_NOISE / np.array(own)), 0.0)
    return np.maximum(np.clip(np.where(known, 0.0, step), -largest, largest)[np.array(owner)], least)


def _noisier(values: Values, factor: float) -> Values:
    bounds = dataclasses.replace(values.bounds, spread=values.bounds.spread * factor)
    return _values(dataclasses.replace(values.picture, bounds=bounds), values.which)


def _optimum(working: Sequence[Picture], fit: ModelFit, at: Numbers) -> Optimum:
    """The optimum of the least squares that takes Newton's step, at which it rests."""
    lobe = bool(fit.free[2].any())
    whole = Subsample(list(working), [None] * len(working), 0.0)
    columns = (picture.columns(at.n)[2:].swapaxes(1, 2) for picture in working)
    parts = whole.sums([Lobes(value[None], at.n * slope[None]) for value, slope in columns])
    # By n, not by its logarithm.
    about = Sums(*(leaf[0] for leaf in parts)).columns(np.diag([1.0, 1.0, lobe, lobe / at.n]))
    cost = np.maximum(about.about(-at.x.T).square, 0.0)
    return dataclasses.replace(fit.optimum, n=at.n, x=at.x, cost=cost, **about._asdict())


def _reweighted(
    fit: ModelFit, noise: float, rounding: float, precision: np.ndarray | None, *, together: bool
) -> Evidence:
    """Where rounding is little beside the noise: least squares in codes, and what an open end says in a value's place.

    Noise is the residual's standard deviation in codes, ``rounding`` what its variance owes to that; ``together``
    channels err together, by a precision that is known or None.
    """
    pictures, optimum, places = fit.pictures, fit.optimum, [bounds_of(picture).place for picture in fit.pictures]
    is_given = precision is not None
    with jax.enable_x64(True):
        both = [(picture, np.flatnonzero(bounds_of(picture).half_open)) for picture in pictures]
        parts, gone = [_working_picture(*one, optimum, noise, rounding) for one in both], math.inf
        for trial in range(MOST_ROUNDS):
            working, before = [part.picture for part in parts], optimum
            if together:
                if not is_given:
                    count = sum(part.closed[1] + part.at_end[1] for part in parts) / optimum.x.shape[1]
                    left = [residuals(picture, optimum) for picture in working]
                    precision = precision_of(left, places, count, rounding)
                assert precision is not None
                optimum = improved(working, precision, optimum, fit, anew=trial == 0)
            elif trial == 0 and fit.tied is None:
                # All alike in light, pixels may have led to another exponent.
                optimum = search(working, fit.free, fit.n_range)
            else:
                optimum = refit(working, optimum, fit.free, fit.n_range, fit.tied)
            parts = [_working_picture(*one, optimum, noise, rounding) for one in both]
            closed, at_end = (np.sum([getattr(part, name) for part in parts], axis=0) for name in ("closed", "at_end"))
            squares, count = (closed + at_end).tolist()
            last, gone = gone, 0.5 * math.log(squares / max(count, 1) / noise**2)
            # The rest of a geometric series (Aitken 1926).
            gone_on = gone / max(1 - max(gone / (last or math.inf), 0.0), 1 / MOST_AHEAD)
            noise *= math.exp(gone_on)
            enough = min(ENOUGH_NOISE_CHANGE, ENOUGH_MOVED * math.sqrt(count) / max(at_end[1], 1))
            if change(before, optimum) < ENOUGH_CHANGE and abs(gone_on) < enough:
                break
        if together:
            assert precision is not None
            return _together([part.picture for part in parts], optimum, noise, places, precision)
    scale = 1 / noise**2
    working, completed = (
        [dataclasses.replace(picture, weight=picture.weights * scale) for picture in both]
        for both in zip(*((part.picture, part.completed) for part in parts), strict=True)
    )
    sums = {name: getattr(optimum, name) * scale for name in ("cost", "gram", "product", "square")}
    value = sum(part.value - float(part.closed @ [scale / 2, math.log(noise)]) for part in parts)
    value += sum(_of_codes(bounds_of(picture)) for picture in pictures)
    optimum = dataclasses.replace(optimum, **sums)
    return Evidence(working, optimum, noise, value, places, np.ones(1), completed=completed)


def _of_codes(bounds: Bounds) -> float:
    """The logarithm of what makes a density at noise 1 the probability of codes, as `_near_edges` has it."""
    both = bounds.ends == 2
    width = np.where(bounds.exact, 1.0, bounds.upper - bounds.lower)[both]
    spread = np.broadcast_to(bounds.spread, both.shape)[both]
    return float(np.sum(np.log(width / (spread * math.sqrt(2 * math.pi)))))


def _together(
    pictures: Sequence[Picture],
    optimum: Optimum,
    noise: float,
    places: Sequence[tuple[np.ndarray, int]],
    precision: np.ndarray,
) -> Evidence:
    """What channels say that err together."""
    left = [residuals(picture, optimum) for picture in pictures]
    value = -0.5 * sum(float(np.sum((values @ precision) * values)) for values in left)
    parts = [each_alone(picture, some, precision, optimum) for picture, some in zip(pictures, left, strict=True)]
    sums = coupled(pictures, precision, optimum.x, np.array([math.log(optimum.n)]))[0]
    normal, optimum = sums.joined(optimum.x, optimum.n), replaced(optimum, sums, optimum.x, optimum.n)
    return Evidence(parts, optimum, noise, value, places, np.ones(1), normal, precision)


def change(before: Optimum, after: Optimum) -> float:
    """The largest change of a number, in standard errors that the others leave by the sums after it."""
    noise = np.maximum(after.cost, np.finfo(float).tiny) / np.maximum(after.pixels, 1)
    # Sums of a column that no pixel shows may end a little below 0.
    information = np.maximum(np.diagonal(after.gram, axis1=1, axis2=2)[:, :3].T, 0.0)
    x = np.abs(after.x - before.x) * np.sqrt(information / noise)
    by_n = abs(after.n - before.n) * np.sqrt(np.sum(after.gauss_newton[:, 3, 3] / noise))
    return float(max(np.max(x), by_n))


@dataclasses.dataclass(frozen=True)
class _WorkingPicture:
    """A picture as least squares takes it.

    Attributes:
        picture: with working targets, and weights in codes².
        completed: with what is to be expected of a value with one end in its place, and all weights those of both.
        closed: squares of the residual in codes times the weight, and how many values that is, of those with both ends.
        at_end: of the others; of squares what is to be expected.
        value: logarithm of the likelihood of these.
    """

    picture: Picture
    completed: Picture
    closed: Float[np.ndarray, "2"]
    at_end: Float[np.ndarray, "2"]
    value: float


def _working_picture(
    picture: Picture, index: Int[np.ndarray, " K"], optimum: Optimum, noise: float, rounding: float
) -> _WorkingPicture:
    """With the pixels that have a value with one end."""
    target, weight, *sums = _linearised(picture, np.asarray(optimum.n), optimum.x)
    others, value = np.zeros(2), 0.0
    taken = completed = dataclasses.replace(picture, target=target, weight=weight, bounds=None)
    if index.size:
        s = math.sqrt(max(noise**2 - rounding, LEAST_SHARE * noise**2))
        values = _values(picture.in_double(index))
        radiance, _ = _predicted(values.picture, optimum)
        code, slope = values.bounds.codes(radiance)
        parts = radiance, slope, values.weight, values.bounds.spread, *values.likelihood(code, s)
        at_end = values.bounds.ends == 1
        radiance, slope, weighs, spread, log_p, score, curvature = (
            np.broadcast_to(part, at_end.shape)[at_end] for part in parts
        )
        target, weight, expected, full = (np.array(part) for part in (target, weight) * 2)
        pixel, channel = np.nonzero(at_end)
        place, own, information = (index[pixel], channel), s * spread, curvature * slope**2
        target[place], weight[place] = radiance + quotient(score * slope, information), weighs * information * noise**2
        expected[place], full[place] = radiance + score * own**2 / slope, weighs * (slope / spread) ** 2
        # Mean square of what the value may have been, about the prediction.
        square = ((score * own) ** 2 + 1 - curvature * own**2) * noise**2
        others, value = np.array([np.sum(weighs * square), np.sum(weighs)]), float(np.sum(weighs * log_p))
        taken, completed = (
            dataclasses.replace(taken, target=jnp.asarray(some), weight=jnp.asarray(weights))
            for some, weights in ((target, weight), (expected, full))
        )
    return _WorkingPicture(taken, completed, np.array(sums), others, value)


@partial(jax.jit, compiler_options=COMPILER_OPTIONS)
def _linearised(picture: Picture, n: AnyArray, x: AnyArray) -> tuple[Array, Array, Array, Array]:
    """Working targets and weights of values with both ends, squares of their residuals in codes, their count."""
    bounds, dtype = bounds_of(picture), picture.target.dtype
    radiance = picture.predicted(n, x)
    # Made once, and not for each of what is asked for.
    radiance, code, slope = jax.lax.optimization_barrier((radiance, *bounds.codes(radiance)))
    closed = jnp.isfinite(bounds.lower) & jnp.isfinite(bounds.upper)
    middle = 0.5 * (jnp.where(closed, bounds.lower, 0.0) + jnp.where(closed, bounds.upper, 0.0))
    residual = jnp.where(closed, middle - code, 0.0)
    counts = jnp.where(closed, picture.weights, 0.0)
    squares = jnp.sum((counts * (residual / bounds.spread) ** 2).astype(jnp.float64))
    weight = (counts * (slope / bounds.spread) ** 2).astype(dtype)
    return (radiance + residual / slope).astype(dtype), weight, squares, jnp.sum(counts.astype(jnp.float64))


class _Separable(Problem):
    """Rounded values, and the model of which they show the coefficients and the exponent."""

    def __init__(
        self, pixels: Sequence[Values], design: Float[np.ndarray, "U V"], n_range: tuple[float, float], copies: bool
    ):
        """State what is fitted.

        ``design`` is what each free number moves of x_a, x_d, x_s, channel after channel, and log n. Channels that are
        copies of each other tell of a number once.
        """
        self.pixels, self.design, self.copies, self.n_range = pixels, design, copies, n_range
        self.bounds, size = [part.bounds for part in pixels], len(design)
        self.exponents, channels = np.arange(size) == size - 1, size // 3
        self.lower, self.upper = (
            np.where(self.exponents, math.log(n), x) for n, x in zip(n_range, (0.0, math.inf), strict=True)
        )
        self.places = places_of(channels)
        self._last: tuple[Any, list[np.ndarray]] = (None, [])

    def codes(self, unknowns: Float[np.ndarray, " U"]) -> list[Float[np.ndarray, "P C"]]:
        """What is predicted, in codes; kept while only the noise changes."""
        if self._last[0] is not unknowns:
            at, found = Numbers.of(unknowns), []
            for part in self.pixels:
                found.append(part.bounds.codes(part.picture.predict(at.n, at.x))[0])
            self._last = unknowns, found
        return self._last[1]

    def taken(self, picture: int, which: Bool[np.ndarray, " P"]) -> Values:
        """Some pixels of a picture."""
        whole = self.pixels[picture]
        return whole if which.all() else _values(whole.picture.in_double(np.flatnonzero(which)), which)

    def shown(self, unknowns: Float[np.ndarray, " U"], values: Sequence[Values]) -> Iterator[tuple[Any, Any]]:
        """What is predicted, and its derivatives by the coefficients and log n."""
        return map(partial(_predicted, at=Numbers.of(unknowns)), [some.picture for some in values])


def _predicted(picture: Picture, at: Numbers | Optimum) -> tuple[Float[np.ndarray, "P C"], Float[np.ndarray, "4 P C"]]:
    """Radiance, and its derivatives by x_a, x_d, x_s and log n."""
    columns = picture.columns(at.n)
    columns[3] *= at.n * at.x[2]
    return columns[0] * at.x[0] + columns[1] * at.x[1] + columns[2] * at.x[2], columns


def _values(picture: Picture, which: Bool[np.ndarray, " P"] | None = None) -> Values:
    """All of a picture on the host in double precision, which is some pixels of another one."""
    which = np.ones(len(picture.target), bool) if which is None else which
    return Values(which, np.asarray(picture.weights), bounds_of(picture), picture)


def _newton_picture(score: PictureScore) -> Picture:
    """Targets and weights with which least squares takes Newton's step."""
    target = score.radiance + quotient(score.score, score.weight)
    return dataclasses.replace(score.values.picture, target=target, weight=score.weight, bounds=None)


def _near(picture: Picture, at: Numbers | Optimum, distance: float) -> Bool[np.ndarray, " P"]:
    """Which pixels say something: those with a value not surely inside its bounds."""
    return bounds_of(picture).near(_codes(picture, at), distance)


def _gathered(pictures: Sequence[Picture], at: Estimate) -> list[Values]:
    """Those of whole pictures."""
    found = []
    for picture in pictures:
        some = np.flatnonzero(at_least_one(_near(picture, Numbers.of(at.unknowns), REACH * at.noise)))
        found.append(_values(picture.in_double(some)))
    return found


def _stratum(picture: Picture, size: int) -> Values:
    """Some of the pixels, weighted by how many each stands for."""
    count = picture.target.shape[0]
    if count <= size:
        return _values(picture.in_double(np.arange(count)))
    nearness = np.zeros(count) if picture.lobe is None else -np.asarray(picture.lobe.peak)
    index, factor = stratified(nearness, np.ones(count, bool), size)
    some = picture.in_double(index)
    weight = np.zeros(len(some.target))
    weight[: index.size] = factor
    return _values(dataclasses.replace(some, weight=weight))


def bounds_of(picture: Any) -> Bounds:
    """Between which codes the values of a picture, or of a tile of pixels, that has such lay."""
    assert picture.bounds is not None
    return picture.bounds


def _codes(picture: Picture, at: Numbers | Optimum) -> np.ndarray:
    """What is predicted, in codes, (P, C), in the precision of the picture."""
    return bounds_of(picture).codes(picture.predict(at.n, at.x))[0]


def _open_ends_tell(picture: Picture, at: Optimum, noise: float) -> bool:
    """Whether some value is known by one end only and is predicted near it."""
    half = bounds_of(picture).half_open
    return bool(half.any()) and bool(np.any(_near(picture, at, END_REACH * noise)[half]))


def highlight_in_codes(pictures: Sequence[Picture], optimum: Optimum) -> float:
    """By how many codes of its file a highlight changes a value at most; infinite where a picture is without codes."""
    matt, most = Numbers(optimum.n, optimum.x * [[1], [1], [0]]), -math.inf
    for picture in pictures:
        if picture.bounds is None or picture.bounds.exact:
            return math.inf
        most = max(most, float(np.max(_codes(picture, optimum) - _codes(picture, matt))))
    return most


def unexplained(picture: Picture, optimum: Optimum) -> np.ndarray:
    """By how much predictions miss the bounds between which the values of a picture lay."""
    bounds, code = bounds_of(picture), _codes(picture, optimum)
    return np.maximum(bounds.lower - code, 0.0) - np.maximum(code - bounds.upper, 0.0)
