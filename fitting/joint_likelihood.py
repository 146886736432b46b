"""The likeliest freed numbers behind rounded values: for any leaf what `fitting.maximum_likelihood` is for k and n."""

import dataclasses
import operator
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from fitting.continuation import Estimate, Problem, Score, Values, maximise, where_most_is_told
from fitting.joint_problem import NOT_NEGATIVE, JointProblem, linearised
from fitting.likelihood import Bounds, Intervals, residual_deviation
from fitting.maximum_likelihood import FIRST_NOISE, alike
from fitting.pixels import Observed
from fitting.uncertainty.structure import Errors, block_scatter


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


def most_likely_numbers(problem: JointProblem, seen: Observed, vector: Float[np.ndarray, " U"]) -> Likely | None:
    """What rounded values say, from least squares on; None where there are others.

    Args:
        problem: what is freed, and the pictures.
        seen: what is fitted.
        vector: the freed numbers by least squares.
    """
    bounds = [tile.bounds for tile in seen.tiles if tile.bounds is not None and not tile.bounds.exact]
    if len(bounds) < len(seen.tiles):
        return None
    pictures = RenderedPictures(problem, bounds, vector, copies=seen.copies)
    codes = pictures.codes(vector)
    noise = max(residual_deviation(bounds, codes), FIRST_NOISE)
    if any(own.lossy for own in bounds):
        pictures.weights = [alike(own, code, noise) for own, code in zip(bounds, codes, strict=True)]
    at, known, said = maximise(pictures, Estimate(vector, noise))
    said, wider = where_most_is_told(pictures, at, known, said)
    shared = problem.each(lambda leaf: leaf.name not in NOT_NEGATIVE or not leaf.shape)
    # Copies of a value tell no more of what all channels share.
    copies = np.where(shared & seen.copies, seen.colour.size, 1)
    return Likely(at.unknowns, said.hessian, pictures.scatter(said), wider * np.sqrt(copies))


class RenderedPictures(Problem):
    """Rounded pictures and the freed numbers of the scenes that they show."""

    def __init__(
        self, problem: JointProblem, bounds: Sequence[Bounds], start: Float[np.ndarray, " U"], *, copies: bool
    ):
        """Take the pictures as they are.

        Args:
            problem: what is freed.
            bounds: of each picture, between which codes its values lay.
            start: the freed numbers, or nearly so.
            copies: the channels are copies of each other, and tell of a number once.
        """
        # What is left of pictures that are black is what the renderer shows.
        black = [jnp.zeros_like(target) for target in problem.targets]
        self._problem = dataclasses.replace(problem, targets=black, weights=[None] * len(bounds))
        self.bounds, self.design, self.copies = bounds, problem.design(start), copies
        self.exponents = problem.each(lambda leaf: leaf.name == "n")
        self.lower, self.upper = np.where(problem.bounded, 0.0, -np.inf), np.full(start.shape, np.inf)
        self.weights = [np.ones(own.lower.shape) for own in bounds]
        self.places = np.broadcast_to(np.arange(start.size), (bounds[0].lower.shape[1], start.size))

    def codes(self, unknowns: Float[np.ndarray, " U"]) -> list[Float[np.ndarray, "P C"]]:
        """What is predicted, in codes."""
        radiance = self._problem.by_picture(np.asarray(_residuals(self._problem, jnp.asarray(unknowns))))
        return [own.codes(part)[0] for own, part in zip(self.bounds, radiance, strict=True)]

    def taken(self, picture: int, which: Bool[np.ndarray, " P"]) -> Values:
        """Some pixels of a picture."""
        some = self.bounds[picture].pixels(operator.itemgetter(which))
        return Values(which, self.weights[picture][which], Intervals(some))

    def shown(self, unknowns: Float[np.ndarray, " U"], values: Sequence[Values]) -> Iterator[tuple[Any, Any]]:
        """What is predicted, and its derivatives by all numbers."""
        found = map(np.asarray, linearised(self._problem, jnp.asarray(unknowns)))
        for some, radiance, part in zip(values, *map(self._problem.by_picture, found), strict=True):
            yield radiance[some.which], part[:, some.which]

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
            bounds, scores = one.values.intervals.bounds, np.einsum("upc,pc->up", one.columns, one.score)
            parts.append(block_scatter(scores, Errors(one.score, np.asarray(bounds.index), int(bounds.width))))
        return np.sum(parts, axis=0)


@eqx.filter_jit
def _residuals(problem: JointProblem, vector: Array) -> Array:
    return problem.residuals(vector)
