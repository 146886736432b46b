"""Colours that err together: least squares that weighs the channels by what their errors have in common.

A codec for photographs keeps brightness well and colour coarsely: the errors of red, green and blue are large and the
same but for a part that is small. Least squares channel by channel looks for a faint highlight in the large errors of
the colour. With the covariance V of a pixel's errors (generalised least squares; Aitken 1936) it is looked for in the
brightness, and each colour is known as well as the codec kept it.

The residual is a (C,) vector r a pixel; its score is J' W r and its Hessian J' W J with W the inverse of V. The
products of the columns of two channels are those of one channel whose weight is the geometric mean of theirs: the same
pass over the pixels makes them, for C x C channels.
"""

import dataclasses
import math
import operator
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from brdf.vectors import quotient
from fitting.model_fit import ModelFit
from fitting.solver.nnls import nonnegative_minimum
from fitting.solver.normal_equations import Picture, sums
from fitting.solver.profile import Optimum
from fitting.solver.refinement import GRID_STEP
from fitting.solver.tied import NormalEquations, design_of, join_channels

# Pixels on a side of what errors are summed over. The larger ones are the blocks of a codec that keeps colours at half
# the resolution: over these errors of the colours go together. What is kept best errs as over the smaller ones, which
# share a value of the colour: a highlight may be little larger, and what goes together farther is seen in the scores.
SIZE, LARGE = 2, 16
# A lobe is looked for where some pixel shows this share of its peak, and n is no less than this: wider ones look like
# Lambert's law.
SEEN, WIDE = 0.05, 1.0


class Coupled(NamedTuple):
    """What pixels say of numbers that all channels tell of together.

    Attributes:
        gram: products of the columns (ambient, diffuse, lobe and derivative of it by log n) of any two channels,
            weighted by W.
        score: of the columns with the residual, weighted likewise.
    """

    gram: Float[np.ndarray, "C C 4 4"]
    score: Float[np.ndarray, "C 4"]

    def joined(self, x: Float[np.ndarray, "3 C"], by: float = 1.0) -> NormalEquations:
        """Normal equations about 0 in x_a, x_d, x_s, channel after channel, and ``by`` times log n, taken at ``x``."""
        whole, score, _ = join_channels(self.gram, self.score, np.zeros(1), x[2] / by)
        return NormalEquations(whole, score + whole @ np.append(x.ravel(), 0.0), 0.0)


def can_be_coupled(pictures: Sequence[Picture]) -> bool:
    """Whether the channels share their basis images, up to a factor for ambient light."""
    same = all(np.array_equal(picture.ambient, pictures[0].ambient) for picture in pictures)
    return same and pictures[0].target.shape[1] > 1 and all(picture.diffuse.shape[1] == 1 for picture in pictures)


def residuals(picture: Picture, optimum: Optimum) -> Float[np.ndarray, "P C"]:
    """What a fit leaves of working targets, times the root of the weight."""
    weight = np.asarray(picture.weights, np.float64)
    left = np.asarray(picture.target, np.float64) - picture.predict(optimum.n, optimum.x)
    return np.where(weight > 0, left, 0.0) * np.sqrt(weight)


def precision_of(
    left: Sequence[Float[np.ndarray, "P C"]], places: Sequence[tuple[np.ndarray, int]], count: float, rounding: float
) -> Float[np.ndarray, "C C"]:
    """W: the inverse of the covariance of the channels' errors, of a pixel whose neighbours err alike.

    Residuals are in codes, ``places`` the index of the pixels in their picture and its width; each value has at least
    the variance ``rounding``.
    """
    small, large = (rounding * np.eye(left[0].shape[1]) for _ in range(2))
    for values, (pixel, width) in zip(left, places, strict=True):
        row, column = np.divmod(pixel, width)
        for covariance, size in ((small, SIZE), (large, LARGE)):
            block = (row // size) * -(-width // size) + column // size
            together = np.array([np.bincount(block, weights=one) for one in values.T])
            covariance += together @ together.T / count
    root = np.linalg.inv(np.linalg.cholesky(small))
    return np.linalg.inv(large) * np.linalg.eigvalsh(root @ large @ root.T)[0]


def coupled(
    pictures: Sequence[Picture], precision: Float[np.ndarray, "C C"], x: Float[np.ndarray, "3 C"], log_n: np.ndarray
) -> list[Coupled]:
    """One pass: what pixels with working targets say at some exponents, residuals being those of ``x``.

    The noise of each value is that of its picture.
    """
    channels = len(precision)
    one, other = np.divmod(np.arange(channels**2), channels)
    scale = np.ones((channels, 4))
    scale[:, 0] = pictures[0].ambient
    found = sums([_paired(picture, one, other) for picture in pictures], log_n, x.T[other] * scale[other, :3])
    gram = found.gram * (precision[one, other, None, None] * scale[one, :, None] * scale[other, None, :])
    score = found.product * (precision[one, other, None] * scale[one])
    return [
        Coupled(products.reshape(channels, channels, 4, 4), scores.reshape(channels, channels, 4).sum(axis=1))
        for products, scores in zip(gram, score, strict=True)
    ]


def _paired(picture: Picture, one: np.ndarray, other: np.ndarray) -> Picture:
    """A channel for each pair: the columns of the one, the residual of the other."""
    # In NumPy: an XLA gather is ten times slower.
    root = np.sqrt(np.broadcast_to(np.asarray(picture.weights), picture.target.shape))
    return dataclasses.replace(
        picture,
        target=np.asarray(picture.target)[:, other],
        weight=root[:, one] * root[:, other],
        ambient=np.ones(1),
        bounds=None,
    )


def improved(
    pictures: Sequence[Picture], precision: Float[np.ndarray, "C C"], optimum: Optimum, fit: ModelFit, *, anew: bool
) -> Optimum:
    """The optimum nearer to where the channels together put it: anew among all exponents, or a Gauss-Newton step."""
    design, x, log_n = design_of(fit.free, fit.tied), optimum.x, np.array([math.log(optimum.n)])
    anew = anew and bool(fit.free[2].any())
    if anew:
        peak = max(picture.nearest_peak for picture in pictures)
        most = min(fit.n_range[1], math.log(SEEN) / min(peak, math.log(SEEN) / fit.n_range[1]))
        least = max(fit.n_range[0], WIDE)
        steps = max(2, 1 + math.ceil(math.log(max(most / least, 1.0)) / GRID_STEP))
        log_n = np.append(log_n, np.linspace(math.log(least), math.log(max(most, least)), steps))
        design = design[:, :-1]
    signed = np.arange(len(design)) == len(design) - 1
    trials = []
    for at, parts in zip(log_n, coupled(pictures, precision, x, log_n), strict=True):
        normal = parts.joined(x)
        reduced = design.T @ normal.gram @ design
        found = design @ nonnegative_minimum(reduced, design.T @ normal.product, signed @ (design != 0))
        gain = float(2 * normal.product @ found - found @ normal.gram @ found)
        trials.append((gain, found, float(at), parts))
    _, found, at, parts = max(trials, key=operator.itemgetter(0))
    n = float(np.clip(math.exp(at + np.clip(found[-1], -GRID_STEP, GRID_STEP)), *fit.n_range))
    x = np.maximum(found[:-1].reshape(x.shape), 0.0)
    return replaced(optimum, parts, x, n)


def replaced(optimum: Optimum, parts: Coupled, x: Float[np.ndarray, "3 C"], n: float) -> Optimum:
    """An optimum with the sums of each channel for itself, all else as it was; each value has the noise 1."""
    scale = np.array([1.0, 1.0, 1.0, 1 / n])
    gram = np.einsum("ccij->cij", parts.gram) * np.outer(scale, scale)
    shown = (gram[..., :3] @ x.T[..., None])[..., 0]
    product = parts.score * scale + shown
    square = optimum.pixels + np.sum((2 * product - shown)[:, :3] * x.T, axis=1)
    return dataclasses.replace(optimum, n=n, x=x, cost=optimum.pixels, gram=gram, product=product, square=square)


def each_alone(
    picture: Picture, left: Float[np.ndarray, "P C"], precision: Float[np.ndarray, "C C"], optimum: Optimum
) -> Picture:
    """Targets and weights whose score, channel by channel, is that of all channels together.

    ``left`` are the picture's residuals times the root of the weight.
    """
    weight = np.broadcast_to(np.asarray(picture.weights, np.float64), left.shape)
    own = weight * np.diag(precision)
    step = quotient(np.sqrt(weight) * (left @ precision), own)
    return dataclasses.replace(picture, target=picture.predict(optimum.n, optimum.x) + step, weight=own)
