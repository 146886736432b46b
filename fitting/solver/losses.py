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

from collections.abc import Callable, Sequence
from functools import partial
from typing import Literal, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from fitting.solver.normal_equations import Picture
from fitting.solver.profile import Optimum
from fitting.solver.streams import each

Loss = Literal["squared", "huber", "cauchy", "relative", "log"]
LOSSES: tuple[Loss, ...] = ("squared", "huber", "cauchy", "relative", "log")

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
MOST_ROUNDS = 50
ENOUGH = 1e-4


class Reweighted(NamedTuple):
    """The outcome of a reweighted fit.

    Attributes:
        optimum: of the last round.
        pictures: with the weights of the last round.
        noise_factor: what the weighted residual's standard deviation is multiplied by to give that which the formula
            for standard errors needs: the weights know the residuals.
    """

    optimum: Optimum
    pictures: Sequence[Picture]
    noise_factor: float = 1.0


def iterate(
    pictures: Sequence[Picture],
    optimise: Callable[[Sequence[Picture]], Optimum],
    working: Callable[[Optimum, int], Callable[[Picture], Picture]],
    at_rest: Callable[[Optimum, Optimum], bool],
) -> Reweighted:
    """The one reweighted loop: squared fits, each of pictures made from the last one's optimum, until it rests.

    A likelihood whose first and second derivative by the prediction m are the score s and -w asks for the target
    m + s / w with the weight w (Green 1984, J. R. Stat. Soc. B 46, 149); a loss with weights, for the target itself.

    Args:
        pictures: as for the search.
        optimise: the squared fit.
        working: from the last optimum and the number of the round to what makes a picture's target and weight.
        at_rest: from the last optimum and the next whether the rounds are over.
    """
    now, optimum = pictures, optimise(pictures)
    for round_ in range(MOST_ROUNDS):
        before, now = optimum, each(working(optimum, round_), pictures)
        optimum = optimise(now)
        if at_rest(before, optimum):
            break
    return Reweighted(optimum, now)


def reweight(
    pictures: Sequence[Picture],
    optimise: Callable[[Sequence[Picture]], Optimum],
    loss: Loss,
    rounding: Float[np.ndarray, " C"],
) -> Reweighted:
    """Fit with a loss of any kind.

    Args:
        pictures: as for the search.
        optimise: the squared fit.
        loss: one of `LOSSES`.
        rounding: standard deviation of a value's rounding, (C,); no scale is smaller.
    """
    if loss == "squared":
        return Reweighted(optimise(pictures), pictures)
    floor = DARKEST * _mean(pictures)
    rule: str = loss

    def working(optimum: Optimum, round_: int) -> Callable[[Picture], Picture]:
        nonlocal rule
        # Huber's loss is convex in the coefficients; the first rounds lead Cauchy's to the right one of its minima.
        rule = "huber" if loss == "cauchy" and round_ < 3 else loss
        scale = floor if loss in ("relative", "log") else _scale(pictures, optimum, rounding)
        return partial(_with_weight, optimum=optimum, scale=scale, loss=rule)

    found = iterate(pictures, optimise, working, lambda *both: rule == loss and _change(*both) < ENOUGH)
    if loss in ("relative", "log"):
        return found
    return found._replace(noise_factor=_noise_factor(found.pictures, pictures, found.optimum, loss))


def cut(channels: int) -> float:
    """By what factor the cut of one channel changes for the root mean square over several.

    Wilson and Hilferty's cube-root approximation of chi squared (1931) keeps the share of normal pixels beyond it.

    Args:
        channels: how many.
    """

    def limit(degrees: int) -> float:
        return float((1 - 2 / (9 * degrees) + _QUANTILE * np.sqrt(2 / (9 * degrees))) ** 1.5)

    return limit(channels) / limit(1)


def _change(before: Optimum, after: Optimum) -> float:
    """The largest relative change of a coefficient, or of n."""
    scale = np.maximum(np.max(np.abs(before.x), axis=0), np.finfo(float).tiny)
    change = float(np.max(np.abs(after.x - before.x) / scale))
    return change if after.flat and before.flat else max(change, abs(np.log(after.n / before.n)))


def _mean(pictures: Sequence[Picture]) -> np.ndarray:
    total, count = 0.0, 0.0
    for picture in pictures:
        counted = np.broadcast_to(np.asarray(picture.weights) > 0, picture.target.shape)
        total = total + np.sum(np.abs(np.asarray(picture.target, np.float64)), axis=0, where=counted)
        count = count + np.sum(counted, axis=0)
    return np.maximum(total / np.maximum(count, 1), np.finfo(np.float32).tiny)


def _scale(pictures: Sequence[Picture], optimum: Optimum, rounding: np.ndarray) -> np.ndarray:
    """Standard deviation of the good pixels' residual, from the median of its size."""
    sizes = []
    for picture in pictures:
        stride = max(1, picture.target.shape[0] * len(pictures) // _MEDIAN_VALUES)
        residual = np.abs(np.asarray(picture.target - picture.predicted(np.asarray(optimum.n), optimum.x)))
        weight = np.broadcast_to(np.asarray(picture.weights), residual.shape)
        rows = np.flatnonzero(weight.min(axis=1) > 0)[::stride]
        sizes.append(residual[rows] * np.sqrt(weight[rows]))
    return np.maximum(np.median(np.concatenate(sizes), axis=0) / _MEDIAN, rounding)


def _with_weight(picture: Picture, optimum: Optimum, scale: np.ndarray, loss: str) -> Picture:
    model = np.asarray(picture.predicted(np.asarray(optimum.n), optimum.x))
    weight = weights(loss, np.asarray(picture.target), model, np.asarray(picture.weights), scale)
    weight = jnp.asarray(weight, picture.target.dtype)
    return eqx.tree_at(lambda p: p.weight, picture, weight, is_leaf=lambda leaf: leaf is None)


def weights(
    loss: str,
    target: Float[np.ndarray, "P C"],
    model: Float[np.ndarray, "P C"],
    base: Float[np.ndarray, "P Cw"],
    scale: Float[np.ndarray, " C"],
) -> Float[np.ndarray, "P Cw"]:
    """rho'(r) / r of each pixel, times its own weight.

    Args:
        loss: "huber", "cauchy", "relative" or "log".
        target: the picture.
        model: what it is compared with.
        base: weight of each pixel under the squared loss; 0 where it does not count.
        scale: standard deviation of good residuals; or the darkest value of a relative or log loss, (C,).
    """
    target = np.where(base > 0, target, model)
    if loss == "relative":
        return base / np.maximum(model, scale) ** 2
    if loss == "log":
        bright, value = np.maximum(model, scale), np.maximum(target, scale)
        excess = value / bright - 1
        near = np.abs(excess) < 1e-3
        away = np.where(near, 1.0, excess)
        return base * np.where(near, 1 - excess / 2, np.log1p(away) / away) / bright**2
    distance = np.mean(base * ((target - model) / scale) ** 2, axis=1, keepdims=True) / cut(target.shape[1]) ** 2
    if loss == "huber":
        return base * np.minimum(1.0, HUBER / np.sqrt(np.maximum(distance, HUBER**2)))
    return base / (1 + distance / CAUCHY**2)


def _noise_factor(now: Sequence[Picture], base: Sequence[Picture], optimum: Optimum, loss: str) -> float:
    """Huber's (1981, section 7.6) correction: mean(psi²) / mean(psi')² in place of the weighted residual's variance.

    ψ = w r; its derivative is 1 where the loss is quadratic. The weighted Gram matrix is mean(w) times the plain one.
    """
    psi, slope, weights, squares, count = 0.0, 0.0, 0.0, 0.0, 0.0
    for picture, original in zip(now, base, strict=True):
        residual = np.asarray(picture.target - picture.predicted(np.asarray(optimum.n), optimum.x), np.float64)
        start = np.broadcast_to(np.asarray(original.weights, np.float64), residual.shape)
        weight = np.broadcast_to(np.asarray(picture.weights, np.float64), residual.shape)
        good = start > 0
        w = np.where(good, weight / np.where(good, start, 1.0), 0.0)
        squared = np.where(good, start * np.where(good, residual, 0.0) ** 2, 0.0)
        # Of a pixel's C channels one direction carries the cut: there psi' is that of the loss, in the others w.
        radial = np.where(w < 1, 0.0, 1.0) if loss == "huber" else w * (2 * w - 1)
        channels = residual.shape[1]
        slope += np.sum(np.where(good, (radial + (channels - 1) * w) / channels, 0.0))
        psi += np.sum(w * w * squared)
        squares += np.sum(w * squared)
        weights += np.sum(w)
        count += np.count_nonzero(good)
    if not (count and squares and slope > 0):
        return 1.0
    return float(np.sqrt((psi / count) * (weights / count) / (slope / count) ** 2 / (squares / count)))
