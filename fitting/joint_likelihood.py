"""What pictures say of freed numbers: the likeliest behind rounded values, and how sure they are.

For any leaf what `fitting.maximum_likelihood` is for k and n.
"""

import dataclasses
import operator
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from fitting.continuation import Estimate, Precision, Problem, Score, maximise, most_informative_score
from fitting.joint_problem import JointProblem, linearised
from fitting.likelihood import Bounds, Values, alike, in_light, is_curved, residual_deviation, weight_of_alike
from fitting.maximum_likelihood import FAINT, FIRST_NOISE, LIKELIER
from fitting.pixels import Observed
from fitting.solver.nnls import inverse_diagonal, scaled_inverse
from fitting.uncertainty.structure import Errors, block_scatter

# Of the largest eigenvalue of the normal equations: a smaller one determines nothing.
DEPENDENT = 1e-12


class Information(NamedTuple):
    """Freed numbers and what is known of them.

    Attributes:
        vector: the numbers.
        hessian: of minus the logarithm of the likelihood, or of half the sum of squares.
        scatter: covariance of the scores; None where that is the Hessian.
        widening: what to multiply the errors of each by.
        noise: before rounding, standard deviation in codes; none where least squares is the whole answer.
        value: logarithm of the likelihood.
        shown: radiance that is predicted of each picture.
        at_ends: of each picture by how much more is predicted than is to be expected of values of which one end is
            known, in light; NaN of the others.
    """

    vector: Float[np.ndarray, " U"]
    hessian: Float[np.ndarray, "U U"]
    scatter: Float[np.ndarray, "U U"] | None = None
    widening: Float[np.ndarray, "*U"] = np.ones(1)
    noise: float = 0.0
    value: float = -np.inf
    shown: Sequence[Float[np.ndarray, "P C"]] = ()
    at_ends: Sequence[Float[np.ndarray, "P C"]] = ()

    def errors(self) -> tuple[Float[np.ndarray, "U U"], Float[np.ndarray, " U"]]:
        """Covariance of the numbers and their errors, infinite where nothing tells of one alone.

        What is at a bound is as unknown as it would be without it, to itself and to the others: noise holds it there.
        """
        covariance, variance = scaled_inverse(self.hessian, DEPENDENT), inverse_diagonal(self.hessian, DEPENDENT)
        if self.scatter is not None:
            covariance = covariance @ self.scatter @ covariance
            variance = np.where(np.isfinite(variance), np.diag(covariance), variance)
        return covariance, np.sqrt(variance) * self.widening


def by_least_squares(
    vector: Float[np.ndarray, " U"],
    columns: Float[np.ndarray, "U N"],
    counts: Bool[np.ndarray, " P"],
    variance: Float[np.ndarray, "K C"],
    *,
    copies: bool,
) -> Information:
    """What least squares knows of numbers, by the residuals' derivatives by them and the variance of what counts.

    Copies are channels that err together.
    """
    # Of pixels that do not count in every channel the usual one.
    every = np.tile(np.mean(variance, axis=0), (counts.size, 1))
    every[counts] = variance
    moves = columns.reshape(len(columns), *every.shape)
    if copies:
        moves, every = moves.sum(axis=2, keepdims=True), every[:, :1]
    scatter = np.einsum("upc,vpc->uv", moves * every, moves, optimize=True)
    return Information(vector, columns @ columns.T, scatter)


def most_likely_numbers(
    problem: JointProblem, observed: Observed, vector: Float[np.ndarray, " U"]
) -> Information | None:
    """What rounded values say, from the freed numbers of least squares on; None where there are others."""
    bounds = [tile.bounds for tile in observed.tiles if tile.bounds is not None and not tile.bounds.exact]
    if len(bounds) < len(observed.tiles):
        return None
    pictures = _RoundedPictures(problem, bounds, observed)
    at, precisions, score = _maximised(pictures, vector)
    if at.noise >= FAINT and is_curved(bounds) and not pictures.lossy:
        even = _RoundedPictures(problem, in_light(bounds), observed)
        found = _maximised(even, at.unknowns)
        if found[0].value > at.value + LIKELIER:
            pictures, (at, precisions, score) = even, found
    score, wider = most_informative_score(at, [(pictures, precisions)])
    # Copies of a value tell no more of what all channels share.
    shared = problem.each(lambda leaf: not leaf.bounded) & observed.copies
    scatter = pictures.scatter(score) if pictures.lossy else None
    wider = wider * np.sqrt(np.where(shared, observed.colour.size, 1))
    radiance = pictures.radiance(at.unknowns)
    ends = pictures.at_ends(radiance, at.noise)
    return Information(at.unknowns, score.hessian, scatter, wider, at.noise, at.value, radiance, ends)


def _maximised(pictures: "_RoundedPictures", start: Float[np.ndarray, " U"]) -> tuple[Estimate, list[Precision], Score]:
    codes = pictures.codes(start)
    noise = max(residual_deviation(pictures.bounds, codes), FIRST_NOISE)
    if pictures.lossy:
        counts = map(alike, pictures.bounds, codes)
        pictures.weights = [weight_of_alike(count, noise) for count in counts]
    return maximise(pictures, Estimate(start, noise))


class _RoundedPictures(Problem):
    """Rounded pictures, and the freed numbers that move what they show."""

    def __init__(self, problem: JointProblem, bounds: Sequence[Bounds], observed: Observed):
        # What is left of pictures that are black is what the renderer shows; by the program that makes residuals.
        black = [
            (np.zeros_like(target), None if weight is None else np.ones_like(weight))
            for target, weight in problem.pictures
        ]
        self._problem = dataclasses.replace(problem, pictures=black)
        self.bounds, self.copies, self.lossy = bounds, observed.copies, any(own.lossy for own in bounds)
        bounded, self.exponents = problem.each(lambda leaf: leaf.bounded), problem.each(lambda leaf: leaf.name == "n")
        self.lower, self.upper = np.where(bounded, 0.0, -np.inf), np.full(bounded.size, np.inf)
        self.design = np.eye(bounded.size)
        self.places = np.broadcast_to(np.arange(bounded.size), (observed.colour.size, bounded.size))
        self.weights = [np.ones(own.lower.shape) for own in bounds]

    def codes(self, unknowns: Float[np.ndarray, " U"]) -> list[Float[np.ndarray, "P C"]]:
        """What is predicted, in codes."""
        return [own.codes(part)[0] for own, part in zip(self.bounds, self.radiance(unknowns), strict=True)]

    def radiance(self, unknowns: Float[np.ndarray, " U"]) -> list[Float[np.ndarray, "P C"]]:
        """What is predicted."""
        return self._problem.by_picture(self._problem.residuals(jnp.asarray(unknowns)))

    def shown(self, unknowns: Float[np.ndarray, " U"], values: Sequence[Values]) -> Iterator[tuple[Any, Any]]:
        """What is predicted, and its derivatives by all numbers."""
        found = map(self._problem.by_picture, linearised(self._problem, jnp.asarray(unknowns)))
        for some, radiance, part in zip(values, *found, strict=True):
            yield radiance[some.which], part[:, some.which]

    def taken(self, picture: int, which: Bool[np.ndarray, " P"]) -> Values:
        """Some pixels of a picture."""
        some = self.bounds[picture].pixels(operator.itemgetter(which))
        return Values(which, self.weights[picture][which], some)

    def at_ends(self, radiance: Sequence[Float[np.ndarray, "P C"]], noise: float) -> list[Float[np.ndarray, "P C"]]:
        """That of `Information`: minus generalised residuals, see `fitting.model_fit.Evidence`."""
        found = []
        for index, (own, shown) in enumerate(zip(self.bounds, radiance, strict=True)):
            left, some = np.full(shown.shape, np.nan), own.half_open
            if some.any():
                values = self.taken(index, some)
                code, slope = values.bounds.codes(np.asarray(shown, np.float64)[some])
                _, score, _ = values.likelihood(code, noise)
                expected = score * (noise * values.bounds.spread) ** 2 / slope
                left[some] = np.where(values.bounds.ends == 1, -expected, np.nan)
            found.append(left)
        return found

    def scatter(self, score: Score) -> Float[np.ndarray, "U U"]:
        """What takes the place of the Hessian in a file that was compressed: the pixels of a block err together."""
        parts, covariance = [], scaled_inverse(score.hessian, DEPENDENT)
        for one in score.pictures:
            scores = np.einsum("upc,pc->up", one.columns, one.score)
            fitted = one.columns * np.sqrt(np.maximum(one.weight, 0)), covariance, self.places
            parts.append(block_scatter(scores, Errors(one.score, *one.values.bounds.place), fitted))
        return np.sum(parts, axis=0)
