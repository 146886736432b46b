"""The likeliest freed numbers behind rounded values: for any leaf what `fitting.maximum_likelihood` is for k and n."""

import dataclasses
import operator
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from fitting.continuation import Estimate, Problem, Score, Values, maximise, where_most_is_told
from fitting.joint_problem import NOT_NEGATIVE, JointProblem, linearised
from fitting.likelihood import Bounds, Intervals, residual_deviation
from fitting.maximum_likelihood import FIRST_NOISE, alike
from fitting.pixels import Observed
from fitting.solver.nnls import inverse_diagonal, scaled_inverse
from fitting.uncertainty.structure import Errors, block_scatter

# Of the largest eigenvalue of the normal equations: a smaller one determines nothing.
DEPENDENT = 1e-12


class Likely(NamedTuple):
    """Freed numbers and what is known of them.

    Attributes:
        vector: the numbers, as they are searched.
        hessian: of minus the logarithm of the likelihood.
        scatter: what takes its place where neighbours err together: the covariance of the scores.
        widening: what to multiply the errors of each by.
    """

    vector: Float[np.ndarray, " U"]
    hessian: Float[np.ndarray, "U U"]
    scatter: Float[np.ndarray, "U U"] | None = None
    widening: Float[np.ndarray, "*U"] = np.ones(1)

    def errors(self, design: Float[np.ndarray, "U V"]) -> tuple[Float[np.ndarray, "V V"], Float[np.ndarray, " V"]]:
        """Covariance of small changes of the numbers, and their errors; infinite where nothing tells of one alone.

        Args:
            design: what each change moves of the numbers.
        """
        hessian = design.T @ self.hessian @ design
        covariance, variance = scaled_inverse(hessian, DEPENDENT), inverse_diagonal(hessian, DEPENDENT)
        if self.scatter is not None:
            covariance = covariance @ design.T @ self.scatter @ design @ covariance
            variance = np.where(np.isfinite(variance), np.diag(covariance), variance)
        # A turn is as much wider as the part of the direction of which least is known.
        wider = np.max(np.where(design != 0, self.widening[:, None], 0.0), axis=0)
        return covariance, np.sqrt(variance) * np.where(wider > 0, wider, 1.0)


class RoundedPictures(Problem):
    """Rounded pictures, and numbers that move what they show."""

    def __init__(
        self,
        bounds: Sequence[Bounds],
        design: Float[np.ndarray, "U V"],
        places: Int[np.ndarray, "C W"],
        *,
        bounded: Bool[np.ndarray, " U"],
        exponents: Bool[np.ndarray, " U"],
        copies: bool = False,
    ):
        """Take the pictures as they are.

        Args:
            bounds: of each picture, between which codes its values lay.
            design: what each small change moves of the numbers.
            places: of the numbers that move each channel.
            bounded: which numbers are not negative.
            exponents: which are logarithms of exponents.
            copies: the channels are copies of each other, and tell of a number once.
        """
        self.bounds, self.design, self.places, self.copies, self.exponents = bounds, design, places, copies, exponents
        self.lower, self.upper = np.where(bounded, 0.0, -np.inf), np.full(bounded.shape, np.inf)
        self.weights = [np.ones(own.lower.shape) for own in bounds]

    def most_likely(self, vector: Float[np.ndarray, " U"]) -> Likely:
        """What the values say.

        Args:
            vector: the numbers by least squares.
        """
        codes = self.codes(vector)
        noise = max(residual_deviation(self.bounds, codes), FIRST_NOISE)
        if any(own.lossy for own in self.bounds):
            self.weights = [alike(own, code, noise) for own, code in zip(self.bounds, codes, strict=True)]
        at, known, said = maximise(self, Estimate(vector, noise))
        said, wider = where_most_is_told(self, at, known, said)
        return Likely(at.unknowns, said.hessian, self.scatter(said), wider)

    def taken(self, picture: int, which: Bool[np.ndarray, " P"]) -> Values:
        """Some pixels of a picture."""
        some = self.bounds[picture].pixels(operator.itemgetter(which))
        return Values(which, self.weights[picture][which], Intervals(some))

    def scatter(self, said: Score) -> Float[np.ndarray, "U U"] | None:
        """What takes the place of the Hessian where the pixels of a block err together; None where they do not.

        They do in a file that was compressed with losses.

        Args:
            said: of the pixels.
        """
        if not any(bounds.lossy for bounds in self.bounds):
            return None
        parts = []
        for one in said.said:
            bounds, scores = one.values.intervals.bounds, np.zeros((len(self.design), len(one.score)))
            for place, columns, score in zip(self.places, np.moveaxis(one.columns, -1, 0), one.score.T, strict=True):
                scores[place] += columns * score
            parts.append(block_scatter(scores, Errors(one.score, np.asarray(bounds.index), int(bounds.width))))
        return np.sum(parts, axis=0)


def rounded(seen: Observed) -> list[Bounds] | None:
    """Between which codes the values of pictures lay; None where there are others.

    Args:
        seen: what is fitted.
    """
    bounds = [tile.bounds for tile in seen.tiles if tile.bounds is not None and not tile.bounds.exact]
    return bounds if len(bounds) == len(seen.tiles) else None


def most_likely_numbers(problem: JointProblem, seen: Observed, vector: Float[np.ndarray, " U"]) -> Likely | None:
    """What rounded values say, from least squares on; None where there are others.

    Args:
        problem: what is freed, and the pictures.
        seen: what is fitted.
        vector: the freed numbers by least squares.
    """
    bounds = rounded(seen)
    if bounds is None:
        return None
    likely = _RenderedPictures(problem, bounds, vector, copies=seen.copies).most_likely(vector)
    shared = problem.each(lambda leaf: leaf.name not in NOT_NEGATIVE or not leaf.shape)
    # Copies of a value tell no more of what all channels share.
    copies = np.where(shared & seen.copies, seen.colour.size, 1)
    return likely._replace(widening=likely.widening * np.sqrt(copies))


class _RenderedPictures(RoundedPictures):
    """Rounded pictures and the freed numbers of the scenes that they show."""

    def __init__(self, problem: JointProblem, bounds: Sequence[Bounds], start: np.ndarray, *, copies: bool):
        """Take the pictures as they are; `start` is nearly what they say."""
        # What is left of pictures that are black is what the renderer shows.
        black = [jnp.zeros_like(target) for target in problem.targets]
        self._problem = dataclasses.replace(problem, targets=black, weights=[None] * len(bounds))
        places = np.broadcast_to(np.arange(start.size), (bounds[0].lower.shape[1], start.size))
        exponents = problem.each(lambda leaf: leaf.name == "n")
        how = {"bounded": problem.bounded, "exponents": exponents, "copies": copies}
        super().__init__(bounds, problem.design(start), places, **how)

    def codes(self, unknowns: Float[np.ndarray, " U"]) -> list[Float[np.ndarray, "P C"]]:
        """What is predicted, in codes."""
        radiance = self._problem.by_picture(np.asarray(_residuals(self._problem, jnp.asarray(unknowns))))
        return [own.codes(part)[0] for own, part in zip(self.bounds, radiance, strict=True)]

    def shown(self, unknowns: Float[np.ndarray, " U"], values: Sequence[Values]) -> Iterator[tuple[Any, Any]]:
        """What is predicted, and its derivatives by all numbers."""
        found = map(np.asarray, linearised(self._problem, jnp.asarray(unknowns)))
        for some, radiance, part in zip(values, *map(self._problem.by_picture, found), strict=True):
            yield radiance[some.which], part[:, some.which]


@eqx.filter_jit
def _residuals(problem: JointProblem, vector: Array) -> Array:
    return problem.residuals(vector)
