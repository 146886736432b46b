"""The likeliest freed numbers behind rounded values: for any leaf what `fitting.maximum_likelihood` is for k and n."""

import dataclasses
import operator
from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from fitting.continuation import LARGEST_SHIFT, Estimate, Score, maximise, noise_score, together, where_most_is_told
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
    at, known = maximise(pictures, Estimate(vector, noise))
    said, wider = where_most_is_told(pictures, at, known)
    freed = list(zip(problem.names, problem.freed(), strict=True))
    shared = np.repeat(
        [name not in NOT_NEGATIVE or not leaf.ndim for name, leaf in freed], [leaf.size for _, leaf in freed]
    )
    # Copies of a value tell no more of what all channels share.
    copies = np.where(shared & seen.copies, seen.colour.size, 1)
    return Likely(at.unknowns, said.hessian, pictures.scatter(said), wider * np.sqrt(copies))


class _Some(NamedTuple):
    """Some pixels of a picture, and between which codes their values lay."""

    which: Bool[np.ndarray, " P"]
    weight: Float[np.ndarray, "P C"]
    bounds: Bounds
    intervals: Intervals


class _Said(NamedTuple):
    """What values of some pixels say: score and weight by radiance, (P, C), and its derivatives by the numbers."""

    some: _Some
    score: Float[np.ndarray, "P C"]
    weight: Float[np.ndarray, "P C"]
    columns: Float[np.ndarray, "U P C"]


class RenderedPictures:
    """Rounded pictures and the freed numbers of the scenes that they show: a `fitting.continuation.Problem`."""

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
        self._problem = dataclasses.replace(problem, weights=[None] * len(bounds))
        self._bounds, self.design, self.signed = bounds, problem.design(start), ~problem.bounded
        self._exponents, self._copies = problem.exponents, copies
        self.weights = [np.ones(own.lower.shape) for own in bounds]

    def codes(self, vector: Float[np.ndarray, " U"]) -> list[Float[np.ndarray, "P C"]]:
        """What is predicted, in codes.

        Args:
            vector: freed numbers.
        """
        radiance = self._radiance(np.asarray(_residuals(self._problem, jnp.asarray(vector))))
        return [own.codes(part)[0] for own, part in zip(self._bounds, radiance, strict=True)]

    def near(self, at: Estimate, reach: float, beside: list[_Some] | None = None) -> list[_Some]:
        """The pixels that say something, and those beside."""
        both = zip(self._bounds, self.codes(at.unknowns), strict=True)
        which = [bounds.near(code, reach * at.noise) for bounds, code in both]
        if beside is not None:
            which = together(which, [one.which for one in beside])
        if which is None:
            return beside or []
        found = []
        for some, weight, bounds in zip(which, self.weights, self._bounds, strict=True):
            part = bounds.pixels(operator.itemgetter(some))
            found.append(_Some(some, weight[some], part, Intervals(part.lower, part.upper, part.spread)))
        return found

    def score(self, at: Estimate, values: Sequence[_Some]) -> Score:
        """What some pixels say."""
        residuals, columns = (
            np.asarray(part, np.float64) for part in linearised(self._problem, jnp.asarray(at.unknowns))
        )
        parts = np.split(columns, np.cumsum([target.size for target in self._problem.targets])[:-1], axis=1)
        said, totals, gradient, hessian = [], np.zeros(3), np.zeros(len(columns)), np.zeros((len(columns),) * 2)
        for some, radiance, part in zip(values, self._radiance(residuals), parts, strict=True):
            code, slope = some.bounds.codes(radiance[some.which])
            told = some.intervals.said(code, at.noise)
            totals += noise_score(told, at.noise * some.bounds.spread, some.weight)
            own = part.reshape(len(part), *radiance.shape)[:, some.which]
            one = _Said(some, some.weight * told.score * slope, some.weight * told.weight * slope**2, own)
            flat = own.reshape(len(own), -1)
            gradient += flat @ one.score.ravel()
            hessian += (flat * one.weight.ravel()) @ flat.T
            said.append(one)
        value, by_log_noise, information = totals.tolist()
        return Score(value, by_log_noise, information, gradient, hessian, said)

    def moved(self, at: Estimate, step: Float[np.ndarray, " U"]) -> Estimate:
        """Another estimate, within the bounds."""
        step = np.where(self._exponents, np.clip(step, -LARGEST_SHIFT, LARGEST_SHIFT), step)
        unknowns = at.unknowns + step
        return at._replace(unknowns=np.where(self.signed, unknowns, np.maximum(unknowns, 0.0)))

    def active(self, at: Estimate) -> Bool[np.ndarray, " U"]:
        """Those that are not at their bound."""
        return self.signed | (at.unknowns > 0)

    def squared_shares(self, at: Estimate, said: Score, influence: Float[np.ndarray, "U U"]) -> Float[np.ndarray, " U"]:
        """Sums of squares of each value's share."""
        squares = np.zeros(len(influence))
        for one in said.said:
            share = np.einsum("uv,vpc->upc", influence, one.columns, optimize=True) ** 2 * one.weight
            share = share.sum(axis=-1, keepdims=True) if self._copies else share
            squares += np.einsum("upc,upc->u", share, share)
        return squares

    def scatter(self, said: Score) -> Float[np.ndarray, "U U"] | None:
        """What takes the place of the Hessian where the pixels of a block err together; None where they do not.

        They do in a file that was compressed with losses.

        Args:
            said: of the pixels.
        """
        if not any(bounds.lossy for bounds in self._bounds):
            return None
        parts = []
        for one in said.said:
            bounds, scores = one.some.bounds, np.einsum("upc,pc->up", one.columns, one.score)
            parts.append(block_scatter(scores, Errors(one.score, np.asarray(bounds.index), int(bounds.width))))
        return np.sum(parts, axis=0)

    def _radiance(self, residuals: Float[np.ndarray, " N"]) -> list[Float[np.ndarray, "P C"]]:
        targets = [np.asarray(target, np.float64) for target in self._problem.targets]
        parts = np.split(np.asarray(residuals, np.float64), np.cumsum([target.size for target in targets])[:-1])
        return [part.reshape(target.shape) + target for part, target in zip(parts, targets, strict=True)]


@eqx.filter_jit
def _residuals(problem: JointProblem, vector: Array) -> Array:
    return problem.residuals(vector)
