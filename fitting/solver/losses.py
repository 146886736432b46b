"""Other losses than the squared one, by reweighting: each round is a global squared fit with other weights.

What to use when:

| loss | the picture | what counts |
| --- | --- | --- |
| squared | noise of one size everywhere: renders, photographs of middling range | the bright parts |
| relative | high dynamic range; noise in proportion to the value | all parts by the share they are off |
| log | as relative, and values that are off by factors | ratios; twice as bright is as bad as half |
| huber | a few per cent are wrong: interreflection, a shadow the scene does not know | good pixels, bad ones a little |
| cauchy | a good part of the pixels is far off: specks, foreign objects | good pixels only |

Squared error on a sharp highlight drowns the diffuse part; relative and log bring it back. Pixels darker than `DARKEST`
of the picture's mean are taken as if they were that bright, or their noise would rule.

The reweighting. Minimising the sum of rho(r) is solved by weights rho'(r) / r, fixed in each round (Holland and Welsch
1977, Commun. Stat. A6, 813). Huber (1964) and Cauchy cut at the usual 95 % efficiency under normal noise; what is cut
is the residual of all channels of a pixel together, in units of a scale taken from the median.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Literal

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from fitting.solver.normal_equations import Picture
from fitting.solver.profile import Optimum, search, within_sight
from fitting.solver.streams import each

Loss = Literal["squared", "huber", "cauchy", "relative", "log"]
LOSSES: tuple[Loss, ...] = ("squared", "huber", "cauchy", "relative", "log")
# Those whose weights fall with brightness.
RELATIVE = "relative", "log"

# Of the mean value; darker pixels count as if they were that bright in a relative or log loss.
DARKEST = 0.01
# Beyond this many deviations a residual counts as an outlier: 95 % efficiency under normal noise, for one channel.
HUBER, CAUCHY = 1.345, 2.385
# Share of the normal distribution within HUBER deviations, as a normal quantile (for the cube-root approximation).
_QUANTILE = 0.918
# The median of the size of a normal number.
_MEDIAN = 0.6744897501960817
# So many values are enough for a median to 1 %.
_MEDIAN_VALUES = 16384
# Within so many deviations of a limit noise decides whether a value is beyond it.
REACH = 3.0
# So often it is asked which pixels these are: then two sets of them may take turns.
LIMITING_ROUNDS = 8
MOST_ROUNDS = 50
ENOUGH = 1e-4


def reweight(
    pictures: Sequence[Picture],
    optimum: Optimum,
    among: tuple[Bool[np.ndarray, "3 C"], tuple[float, float]],
    loss: Loss,
    rounding: Float[np.ndarray, " C"],
    limits: Sequence[tuple[float, float]],
) -> tuple[Sequence[Picture], Optimum, float]:
    """Fit with a loss of any kind: squared fits, each with the weights of the last one's optimum, until it rests.

    Pixels beyond ``limits``, of each picture, were left out by what they show; so are, by what is predicted, those that
    noise keeps within them or not: of these the ones that are left err to one side.
    ``among`` is which coefficients are free, and between which exponents is sought. No scale is below ``rounding``, the
    standard deviation of a value's. Gives the pictures with the weights of the last round, its optimum, and what the
    weighted residual's standard deviation is multiplied by to give that which the formula for standard errors needs:
    the weights know the residuals.
    """
    now, robust = pictures, loss in ("huber", "cauchy")
    limited = bool(np.isfinite(np.asarray(limits)).any())
    if loss == "squared" and not limited:
        return pictures, optimum, 1.0
    at = optimum
    scale = rounding if robust else DARKEST * _mean(pictures)
    for round_ in range(MOST_ROUNDS):
        # Huber's loss is convex in the coefficients; the first rounds lead Cauchy's to the right one of its minima.
        rule = "huber" if loss == "cauchy" and round_ < 3 else loss
        if robust:
            scale = _scale(pictures, optimum, rounding)
        before, now = optimum, each(partial(_with_weight, optimum=optimum, scale=scale, loss=rule), pictures)
        if limited:
            at = optimum if round_ < LIMITING_ROUNDS else at
            noise = np.sqrt(at.cost / np.maximum(at.pixels, 1)) if loss == "squared" else _scale(pictures, at, rounding)
            now = each(partial(_within, optimum=at, noise=noise), now, pictures, limits)
        optimum = search(now, *within_sight(now, *among))
        if limited and np.any(optimum.pixels == 0):
            # Noise reaches from one limit to the other.
            optimum, limited = before, False
            continue
        if rule == loss and _change(before, optimum) < ENOUGH:
            break
    return now, optimum, _noise_factor(now, pictures, optimum, loss) if robust else 1.0


def _change(before: Optimum, after: Optimum) -> float:
    """The largest relative change of a coefficient, or of n."""
    scale = np.maximum(np.max(np.abs(before.x), axis=0), np.finfo(float).tiny)
    change = float(np.max(np.abs(after.x - before.x) / scale))
    return change if after.flat and before.flat else max(change, abs(np.log(after.n / before.n)))


def _weights(picture: Picture) -> np.ndarray:
    return np.broadcast_to(np.asarray(picture.weights), picture.target.shape)


def _mean(pictures: Sequence[Picture]) -> np.ndarray:
    sums = []
    for picture in pictures:
        size, counted = np.abs(np.asarray(picture.target, np.float64)), _weights(picture) > 0
        sums.append([np.sum(size, axis=0, where=counted), np.sum(counted, axis=0)])
    total, count = np.sum(sums, axis=0)
    return np.maximum(total / np.maximum(count, 1), np.finfo(np.float32).tiny)


def _scale(pictures: Sequence[Picture], optimum: Optimum, rounding: np.ndarray) -> np.ndarray:
    """Standard deviation of the good pixels' residual, from the median of its size."""
    sizes = []
    for picture in pictures:
        stride = max(1, picture.target.shape[0] * len(pictures) // _MEDIAN_VALUES)
        weight = _weights(picture)
        rows = np.flatnonzero(weight.min(axis=1) > 0)[::stride]
        residual = np.asarray(picture.target) - picture.predict(optimum.n, optimum.x)
        sizes.append(np.abs(residual[rows]) * np.sqrt(weight[rows]))
    return np.maximum(np.median(np.concatenate(sizes), axis=0) / _MEDIAN, rounding)


def _with_weight(picture: Picture, optimum: Optimum, scale: np.ndarray, loss: str) -> Picture:
    base = np.asarray(picture.weights)
    weight = weights(loss, np.asarray(picture.target), picture.predict(optimum.n, optimum.x), base, scale)
    return replace(picture, weight=jnp.asarray(weight, picture.target.dtype))


def _within(
    picture: Picture, other: Picture, limits: tuple[float, float], optimum: Optimum, noise: Float[np.ndarray, " C"]
) -> Picture:
    """Without pixels that are predicted near a limit; ``noise`` is that of the other one's weight of 1."""
    predicted, weight = picture.predict(optimum.n, optimum.x), np.asarray(picture.weights)
    margin = REACH * noise / np.sqrt(np.maximum(np.asarray(other.weights), np.finfo(np.float32).tiny))
    inside = np.all((predicted > limits[0] + margin) & (predicted < limits[1] - margin), axis=1, keepdims=True)
    return replace(picture, weight=jnp.asarray(weight * inside, picture.target.dtype))


def weights(
    loss: str,
    target: Float[np.ndarray, "P C"],
    model: Float[np.ndarray, "P C"],
    base: Float[np.ndarray, "P Cw"],
    scale: Float[np.ndarray, " C"],
) -> Float[np.ndarray, "P Cw"]:
    """rho'(r) / r of each pixel, times its own weight under the squared loss.

    The scale is the standard deviation of good residuals, or the darkest value of a relative or log loss.
    """
    target = np.where(base > 0, target, model)
    bright = np.maximum(model, scale)
    if loss == "squared":
        return base
    if loss == "relative":
        return base / bright**2
    if loss == "log":
        excess = np.maximum(target, scale) / bright - 1
        near = np.abs(excess) < 1e-3
        away = np.where(near, 1.0, excess)
        return base * np.where(near, 1 - excess / 2, np.log1p(away) / away) / bright**2
    distance = np.mean(base * ((target - model) / scale) ** 2, axis=1, keepdims=True)
    distance = distance * (_limit(1) / _limit(target.shape[1])) ** 2
    if loss == "huber":
        return base * np.minimum(1.0, HUBER / np.sqrt(np.maximum(distance, HUBER**2)))
    return base / (1 + distance / CAUCHY**2)


def _limit(channels: int) -> float:
    """How large a root mean square over channels the same share of normal pixels has, by Wilson and Hilferty (1931).

    Their cube-root approximation of chi squared.
    """
    return (1 - 2 / (9 * channels) + _QUANTILE * math.sqrt(2 / (9 * channels))) ** 1.5


def _noise_factor(now: Sequence[Picture], base: Sequence[Picture], optimum: Optimum, loss: str) -> float:
    """Huber's (1981, section 7.6) correction: mean(psi²) / mean(psi')² in place of the weighted residual's variance.

    ψ = w r; its derivative is 1 where the loss is quadratic. The weighted Gram matrix is mean(w) times the plain one.
    """
    totals = np.zeros(5)
    for picture, original in zip(now, base, strict=True):
        channels, good = picture.target.shape[1], _weights(original) > 0
        residual = np.asarray(picture.target - picture.predict(optimum.n, optimum.x), np.float64)[good]
        start, weight = (_weights(one)[good].astype(np.float64) for one in (original, picture))
        w, squared = weight / start, start * residual**2
        # Of a pixel's C channels one direction carries the cut: there psi' is that of the loss, in the others w.
        radial = w >= 1 if loss == "huber" else w * (2 * w - 1)
        slope = (radial + (channels - 1) * w) / channels
        totals += [np.sum(w * w * squared), np.sum(w), w.size, np.sum(slope), np.sum(w * squared)]
    psi, weight, count, slope, square = totals
    return math.sqrt(psi * weight * count / square) / slope if square > 0 and slope > 0 else 1.0
