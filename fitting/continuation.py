"""The most likely numbers and noise: Newton's method, from much noise to as little as the values allow.

For a given noise s the logarithm of the likelihood of rounded values (`fitting.likelihood`) is concave in the numbers,
or nearly so, and Newton's step needs of each value its score and weight. With less noise fewer values say something,
those that are predicted near the edge of a code, and the reach of Newton's method shrinks. So s starts at what least
squares leaves, and follows its own score from there, by steps of some factor at most, each time from the last answer.
"""

import copy
import functools
import math
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from brdf.vectors import quotient
from fitting.likelihood import Bounds, LogLikelihood, Values, alike, weight_of_alike
from fitting.solver.nnls import nonnegative_minimum

# In codes: below this the edges of codes are as sharp as the arithmetic of the pictures.
LEAST_NOISE = 1e-4
# A value says nothing where its code is as good as certain: this many s from the nearer edge. One that has come nearer
# than the second on the way is taken in.
REACH, NEARER = 7.0, 5.0
# Newton's steps at one s; a step that gains less ends them, at the last s and on the way there.
MOST_STEPS, LEAST_GAIN, ROUGH_GAIN = 12, 1e-3, 1.0
# The largest change of the logarithm of an exponent in one step.
LARGEST_SHIFT = 0.5
# Steps of so many of the errors that were known with more noise cost something.
STEADY = 10.0
# The noise is known well enough where its step is no larger than this factor; so many steps at most.
ENOUGH_KNOWN, MOST_NOISES = 1.02, 60
MOST_TELLING = 10.0
# So many values have to tell of a number before the Hessian is taken for its error.
FEWEST_VALUES = 6.0
# Steps of the noise are no larger than this factor; where at least so many values tell of each number, than that.
STEP, MANY_VALUES, LONG_STEP = 2.0, 50.0, 4.0
# Where the Hessian is no larger all values are surely inside their codes.
NOTHING = 1e-100
# Pixels whose products are taken at a time: they stay in a core's cache, and cores that shared a product would wait.
PIECE = 1 << 13


class Estimate(NamedTuple):
    """The most likely numbers.

    Attributes:
        unknowns: the numbers, (U,).
        noise: s, in codes.
        value: logarithm of the likelihood.
    """

    unknowns: Float[np.ndarray, " U"]
    noise: float
    value: float = -math.inf


class Score(NamedTuple):
    """What some values say of an estimate.

    Attributes:
        value: logarithm of the likelihood.
        by_log_noise: its derivative by log s.
        noise_information: of log s, by the squares of each value's derivative (Berndt, Hall, Hall, Hausman 1974), none
            above `MOST_TELLING`: those that the model misses would hide what the others say.
        gradient: of the likelihood by the unknowns, (U,).
        hessian: minus the second derivative, (U, U).
        pictures: of each picture.
    """

    value: float
    by_log_noise: float
    noise_information: float
    gradient: Float[np.ndarray, " U"]
    hessian: Float[np.ndarray, "U U"]
    pictures: "Sequence[PictureScore]"


class PictureScore(NamedTuple):
    """What values say of what is shown there.

    Attributes:
        values: which.
        radiance: that is predicted, (P, C).
        slope: of the code by it, (P, C).
        columns: derivatives of the radiance by the unknowns that move each channel, (V, P, C).
        likelihood: by the code.
    """

    values: Values
    radiance: Float[np.ndarray, "P C"]
    slope: Float[np.ndarray, "P C"]
    columns: Float[np.ndarray, "V P C"]
    likelihood: LogLikelihood

    @property
    def score(self) -> Float[np.ndarray, "P C"]:
        """By radiance."""
        return self.values.weight * self.likelihood.score * self.slope

    @property
    def weight(self) -> Float[np.ndarray, "P C"]:
        """By radiance."""
        return self.values.weight * self.likelihood.weight * self.slope**2

    def of_noise(self, noise: float) -> tuple[float, float, float]:
        """The logarithm of the likelihood, its derivative by log s, and what the values tell of that."""
        each = (self.likelihood.score**2 - self.likelihood.weight) * (noise * self.values.bounds.spread) ** 2
        parts = self.likelihood.value, each, np.minimum(each**2, MOST_TELLING)
        value, by_log_noise, information = (float(np.sum(self.values.weight * part)) for part in parts)
        return value, by_log_noise, information

    def sums(self) -> tuple[Float[np.ndarray, "C V V"], Float[np.ndarray, "C V"]]:
        """Products of the columns weighted by the values' weights, and with their scores."""
        columns, weight, score = np.moveaxis(self.columns, -1, 0), self.weight.T[:, None], self.score.T[:, None]
        found = np.zeros((*columns.shape[:2], columns.shape[1] + 1))
        for some in _pieces(columns.shape[2]):
            own = columns[..., some]
            both = np.concatenate([own * weight[..., some], score[..., some]], axis=1)
            found += own @ np.swapaxes(both, 1, 2)
        return found[..., :-1], found[..., -1]


class Problem(ABC):
    """Values, and a model that predicts them.

    Attributes:
        bounds: of each picture, between which codes its values lay.
        design: what each free number moves of the unknowns, (U, V).
        exponents: which unknowns are logarithms of exponents.
        lower: bound of each.
        upper: likewise.
        copies: the channels are copies of each other, and tell of a number once.
        places: of the unknowns that move each channel, (C, V).
    """

    bounds: Sequence[Bounds]
    design: Float[np.ndarray, "U V"]
    exponents: Bool[np.ndarray, " U"]
    lower: Float[np.ndarray, " U"]
    upper: Float[np.ndarray, " U"]
    copies: bool
    places: Int[np.ndarray, "C V"]

    @abstractmethod
    def codes(self, unknowns: Float[np.ndarray, " U"]) -> list[Float[np.ndarray, "P C"]]:
        """What is predicted of all pixels, in codes."""

    @abstractmethod
    def taken(self, picture: int, which: Bool[np.ndarray, " P"]) -> Values:
        """Some pixels of a picture."""

    @abstractmethod
    def shown(self, unknowns: Float[np.ndarray, " U"], values: Sequence[Values]) -> Iterator[tuple[Any, Any]]:
        """What is predicted of some pixels of each picture: radiance, (P, C), and its columns, (V, P, C)."""

    @property
    def signed(self) -> Bool[np.ndarray, " U"]:
        """Which unknowns have no bound at 0, and move relative to where they are."""
        return self.exponents | (self.lower < 0)

    def near(
        self, codes: Sequence[Float[np.ndarray, "P C"]], distance: float, beside: list[Values] | None = None
    ) -> list[Values]:
        """The values that say something: those not surely in their codes, by this distance, and those given beside.

        The latter themselves where there are no others.
        """
        which = [at_least_one(bounds.near(code, distance)) for bounds, code in zip(self.bounds, codes, strict=True)]
        if beside is not None:
            if not any(np.any(some & ~other.which) for some, other in zip(which, beside, strict=True)):
                return beside
            which = [some | other.which for some, other in zip(which, beside, strict=True)]
        return list(map(self.taken, range(len(which)), which))

    def score(self, at: Estimate, values: Sequence[Values]) -> Score:
        """What these values say of an estimate."""
        size = len(self.design)
        pictures, totals, gradient, hessian = [], np.zeros(3), np.zeros(size), np.zeros((size, size))
        for some, (radiance, columns) in zip(values, self.shown(at.unknowns, values), strict=True):
            code, slope = some.bounds.codes(radiance)
            one = PictureScore(some, radiance, slope, columns, some.likelihood(code, at.noise))
            pictures.append(one)
            totals += one.of_noise(at.noise)
            for place, products, scores in zip(self.places, *one.sums(), strict=True):
                hessian[np.ix_(place, place)] += products
                gradient[place] += scores
        value, by_log_noise, information = totals.tolist()
        return Score(value, by_log_noise, information, gradient, hessian, pictures)

    def moved(self, at: Estimate, step: Float[np.ndarray, " U"]) -> Estimate:
        """An estimate with other unknowns, within their bounds."""
        step = np.where(self.exponents, np.clip(step, -LARGEST_SHIFT, LARGEST_SHIFT), step)
        return at._replace(unknowns=np.clip(at.unknowns + step, self.lower, self.upper))

    def squared_shares(self, score: Score, influence: Float[np.ndarray, "U U"]) -> Float[np.ndarray, " U"]:
        """Sums of squares of each value's share in what is known of each unknown.

        The share is its weight times the square of the product of the influence and its derivatives by the unknowns.
        """

        def of_channel(place: Any, columns: Any, weight: Any) -> np.ndarray:
            share = influence[:, place] @ columns
            share *= share
            share *= weight
            return share

        squares = np.zeros(len(influence))
        for one in score.pictures:
            columns, weight = np.moveaxis(one.columns, -1, 0), one.weight.T
            for some in _pieces(columns.shape[2]):
                shares = map(of_channel, self.places, columns[..., some], weight[:, some])
                for share in [sum(shares)] if self.copies else shares:
                    squares += np.einsum("up,up->u", share, share)
        return squares


def _pieces(count: int) -> list[slice]:
    """Of so many pixels those whose products are taken at a time."""
    return [slice(first, first + PIECE) for first in range(0, count, PIECE)]


def at_least_one(which: Bool[np.ndarray, " P"]) -> Bool[np.ndarray, " P"]:
    """With one pixel of a picture whose values are all sure: arrays of no pixels are no pictures."""
    which[:1] |= not which.any()
    return which


class Precision(NamedTuple):
    """What is known of the unknowns at some noise.

    Attributes:
        noise: s.
        information: logarithm of the determinant of the Hessian.
        variance: of each, (U,).
        values: how many tell of it, by their share in the Hessian, (U,).
        by_log_noise: derivative of the likelihood by log s.
    """

    noise: float
    information: float
    variance: Float[np.ndarray, " U"]
    values: Float[np.ndarray, " U"]
    by_log_noise: float


def maximise(
    problem: Problem,
    start: Estimate,
    enough: float = ENOUGH_KNOWN,
    least: float = 0.0,
    earlier: Sequence[Precision] = (),
) -> tuple[Estimate, list[Precision], Score]:
    """The most likely unknowns and noise, what was known of the unknowns with more noise, and what the values say.

    The noise of the start is not much too small. It is known well enough where its step is no larger than the factor
    ``enough``; that of which fewer values than ``least`` tell of a number is not gone below. ``earlier`` is what some
    of the same values knew of about that noise, the last with the least.
    """
    at, precisions, low, high = start, [], -math.inf, math.inf
    while True:
        values = problem.near(problem.codes(at.unknowns), REACH * at.noise)
        at, values, score = _climb(problem, at, ROUGH_GAIN, precisions, values, problem.score(at, values))
        precisions.append(precision(problem, at, score))
        fewest = float(np.min(precisions[-1].values, where=precisions[0].variance > 0, initial=math.inf))
        if fewest < least:
            break
        largest = math.log(LONG_STEP if fewest > MANY_VALUES else STEP)
        now, derivative = math.log(at.noise), score.by_log_noise
        low, high = (max(low, now), high) if derivative > 0 else (low, min(high, now))
        # By the last two scores, of which one takes the place of the other; at first by earlier ones, if there are any.
        slope, last = -score.noise_information, (precisions if len(precisions) > 1 else earlier)[-2:]
        if len(last) > 1:
            slope = (last[1].by_log_noise - last[0].by_log_noise) / math.log(last[1].noise / last[0].noise)
        step = -derivative / slope if slope < 0 else math.copysign(math.inf, derivative)
        step = min(max(step, -largest, math.log(LEAST_NOISE) - now), largest)
        if not low <= now + step <= high:
            step = 0.5 * (low + high) - now
        if abs(step) < math.log(enough) or len(precisions) == MOST_NOISES:
            break
        at = at._replace(noise=math.exp(now + step))
    rough = score
    at, _, score = _climb(problem, at, LEAST_GAIN, precisions, values, rough)
    found = precisions[-1] if score is rough else precision(problem, at, score)
    return at, [*(entry for entry in precisions if entry.noise > at.noise), found], score


def _climb(
    problem: Problem, at: Estimate, enough: float, precisions: Sequence[Precision], values: list[Values], now: Score
) -> tuple[Estimate, list[Values], Score]:
    """Newton's method at a given noise, with the pixels that say something there, to what gains next to nothing.

    What they say nothing of stays where more noise has put it, as a small highlight none of whose pixels lies near an
    edge: steps cost something by the errors that were known.
    """
    design, start = problem.design, at
    damping = 1 / (STEADY**2 * least_variance(precisions)) if precisions else np.zeros(len(design))
    while True:
        for _ in range(MOST_STEPS):
            base = np.where(problem.signed, 0.0, at.unknowns)
            # A little more where nothing is told; of the change alone, or it would pull the numbers towards 0.
            damped = now.hessian + np.diag(damping + 1e-9 * np.diag(now.hessian))
            product = design.T @ (now.gradient + damped @ base)
            signed = problem.signed @ (design != 0)
            step = design @ nonnegative_minimum(design.T @ damped @ design, product, signed) - base
            # What the step is going to gain.
            if step @ (now.gradient - 0.5 * now.hessian @ step) < enough:
                break
            gain = 0.0
            for halvings in range(12):
                trial = problem.moved(at, 0.5**halvings * step)
                trial_score = problem.score(trial, values)
                gain = trial_score.value - now.value
                if gain > 0:
                    at, now = trial, trial_score
                    break
            if gain < enough:
                break
        # Others may say something at the new numbers.
        before, values = values, problem.near(problem.codes(at.unknowns), NEARER * at.noise, values)
        if values is before:
            return at._replace(value=now.value), values, now
        now, first = problem.score(at, values), problem.score(start, values)
        if first.value > now.value:
            # What was left out would have held it back.
            at, now = start, first


def precision(problem: Problem, at: Estimate, score: Score) -> Precision:
    """Variance of each unknown, and how many values tell of it."""
    moved = problem.design[:, (problem.signed | (at.unknowns > 0)) @ np.abs(problem.design) > 0]
    moved = moved[:, np.einsum("uv,uw,wv->v", moved, score.hessian, moved) > NOTHING]
    hessian = moved.T @ score.hessian @ moved
    scale = np.sqrt(np.diag(hessian))
    value, vector = np.linalg.eigh(hessian / np.outer(scale, scale))
    # What nothing tells of has a large variance, not none; a column of zeros is no unknown.
    value = np.maximum(value, np.finfo(float).eps)
    root = moved @ (vector / np.sqrt(value) / scale[:, None])
    influence, information = root @ root.T, float(np.sum(np.log(value)) + 2 * np.sum(np.log(scale)))
    # In units of its own error, or squares overflow where next to nothing tells.
    own = np.sqrt(np.diag(influence))
    relative = quotient(influence, own[:, None])
    total = np.einsum("uv,vw,uw->u", relative, score.hessian, relative)
    squares = problem.squared_shares(score, relative)
    return Precision(at.noise, information, np.diag(influence), quotient(total**2, squares), score.by_log_noise)


def most_informative(precisions: Sequence[Precision]) -> Precision:
    """Where, from much noise to little, the values say most of all unknowns together, and enough of them of each.

    With less noise all pixels of a small highlight may lie well inside their codes, and the Hessian there says nothing.
    """
    enough = [one for one, own in zip(precisions, _enough_values(precisions), strict=True) if np.all(own)]
    return max(enough, key=lambda entry: entry.information)


def _variances(precisions: Sequence[Precision]) -> Float[np.ndarray, "N U"]:
    """Variance of each unknown, infinite where not enough values tell of it."""
    variance = np.array([entry.variance for entry in precisions])
    return np.where(_enough_values(precisions) & (variance > 0), variance, np.inf)


def _enough_values(precisions: Sequence[Precision]) -> Bool[np.ndarray, "N U"]:
    """Of which unknowns enough values tell, and did with more noise too; those that nothing tells of are left out.

    Where few did an estimate may be anywhere between the edges that are left, and many may lie near where it is then.
    """
    unknown = precisions[0].variance == 0
    # With the most noise all values tell.
    found, last = [np.ones(unknown.shape, bool)], precisions[0]
    for entry in precisions[1:]:
        enough = (entry.values >= FEWEST_VALUES) | unknown
        # What was looked at anew starts with more noise again.
        found.append(enough & found[-1] if entry.noise < last.noise else enough)
        last = entry
    return np.array(found)


def least_variance(precisions: Sequence[Precision]) -> Float[np.ndarray, " U"]:
    """Variance of each unknown where it is known best by enough values; infinite where it is not known at all."""
    return np.min(_variances(precisions), axis=0)


def most_informative_score(
    at: Estimate, rounds: Sequence[tuple[Problem, list[Precision]]]
) -> tuple[Score, Float[np.ndarray, " U"]]:
    """What the values say of the most likely unknowns at the noise of which errors are, and what to multiply these by.

    The rounds are several where the noise of one picture beside another's was found in between.
    """
    precisions = [entry for _, some in rounds for entry in some]
    problems = [problem for problem, some in rounds for _ in some]

    @functools.cache
    def shown(problem: Problem) -> tuple[list[np.ndarray], list[np.ndarray]]:
        """Predictions, and how many are alike; in a file with losses these hide what rounding has done."""
        codes = problem.codes(at.unknowns)
        both = zip(problem.bounds, codes, strict=True)
        return codes, [alike(bounds, code, level=True) * (not bounds.lossy) for bounds, code in both]

    @functools.cache
    def here(index: int) -> tuple[Score, Precision]:
        """At these unknowns: elsewhere, as with none at its bound, they may have been told apart better."""
        problem, there = problems[index], at._replace(noise=precisions[index].noise)
        codes, counts = shown(problem)
        values = list(map(copy.copy, problem.near(codes, REACH * there.noise)))
        for some, count in zip(values, counts, strict=True):
            weight = weight_of_alike(count[some.which], there.noise * some.bounds.spread)
            # What fills up the pixels of a compiled program weighs nothing.
            some.weight = some.weight * np.pad(weight, np.array([(0, len(some.bounds.lower) - len(weight)), (0, 0)]))
        score = problem.score(there, values)
        return score, precision(problem, there, score)

    most = most_informative(precisions)
    first = next(index for index, entry in enumerate(precisions) if entry is most)
    score, known = here(first)
    # Each unknown is known as well as where enough values still tell of it, here as on the way.
    least, variances = np.where(known.variance > 0, known.variance, np.inf), _variances(precisions)
    for unknown, variance in enumerate(variances.T):
        for index in np.argsort(variance)[: np.count_nonzero(np.isfinite(variance))].tolist():
            steps = [here(step)[1] for step in range(min(first + 1, index), index + 1)]
            if min(one.values[unknown] for one in steps) >= FEWEST_VALUES:
                least[unknown] = min(least[unknown], steps[-1].variance[unknown] or np.inf)
                break
    least = np.maximum(least, np.min(variances, axis=0))
    ratio = np.divide(least, known.variance, out=np.ones_like(least), where=(known.variance > 0) & np.isfinite(least))
    return score, np.sqrt(ratio)
