"""Noise that grows with brightness: found in the residual, and taken into account in the errors.

The formula for standard errors wants to know how large the noise is where a parameter is seen. A sharp highlight is
seen in a few bright pixels; if noise is a share of the value, or shot noise, it is larger there than in most of it,
and a single variance would make n and k_s look far better known than they are. So the squared residual of some
thousand pixels is regressed on the fitted value: variance = a + b value + c value². Where that says no more than a
constant does, nothing changes; else the covariance becomes H⁻¹ (Σ v JᵀJ) H⁻¹ with the variance v of each pixel (the
sandwich of Eicker 1967, Huber 1967 and White 1980, but with a smooth v: squared residuals themselves are too few in a
highlight of three pixels).
"""

import dataclasses
import math
import operator
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from brdf.precision import cast
from fitting.channel_errors import residuals
from fitting.solver.nnls import nonnegative_minima
from fitting.solver.normal_equations import AnyArray, Picture, Sums, sums
from fitting.solver.profile import Optimum
from fitting.solver.streams import each

# A correlation of squared residual and value within so many of its standard errors is chance.
CHANCE = 4.0
# So many times the likelihood has to rise (its logarithm, twice) before the variance is taken to vary.
RISE = 20.0
# Below this ratio of the largest to the mean variance it makes no difference.
EVEN = 1.2
MOST_VALUES = 4096
# Of so many pixels at most it is asked what noise knows of their weights.
MOST_PIXELS = 1 << 13
ROUNDS = 6
# A power of the value depends on the others where they leave less of it.
DEPENDENT = 1e-13
# Of noise that does not know of the weights: its variance is one over this power of them.
POWERS = (0.0, 0.25, 0.5, 0.75)


def noise_model(
    residual: Float[np.ndarray, "M C"], value: Float[np.ndarray, "M C"], least: Float[np.ndarray, " C"]
) -> Float[np.ndarray, "C 3"] | None:
    """Whether noise grows with brightness: a, b, c of each channel's variance; None where a constant does as well.

    Residuals of some pixels that count are times the root of their weight; ``least`` is the deviation of rounding
    alone.
    """
    if len(residual) < 10 * ROUNDS:
        return None
    squared = residual**2
    centred, deviation = value - value.mean(axis=0), squared - squared.mean(axis=0)
    scale = np.sqrt(np.sum(centred**2, axis=0) * np.sum(deviation**2, axis=0))
    correlation = np.sum(centred * deviation, axis=0) / np.maximum(scale, np.finfo(float).tiny)
    if np.max(correlation) * np.sqrt(len(value)) < CHANCE:
        return None
    stride = -(-len(value) // MOST_VALUES)
    squared, value = squared[::stride], np.maximum(value[::stride], 0.0)
    channels = range(value.shape[1])
    found = [growth_of_channel(squared[:, c], value[:, c], least[c] ** 2) for c in channels]
    coefficients = np.array([one for one, _ in found])
    variance = variance_at(coefficients, value)
    varied = np.max(variance, axis=0) > EVEN * np.mean(variance, axis=0)
    return coefficients if np.any(varied & (np.array([gain for _, gain in found]) > RISE)) else None


def value_variance(
    residual: Float[np.ndarray, "M C"], value: Float[np.ndarray, "M C"], noise: Float[np.ndarray, " C"]
) -> Float[np.ndarray, "M C"]:
    """The variance of each value: as it grows with brightness, or that of its channel where it does not."""
    model = noise_model(residual, value, np.finfo(float).eps * np.max(np.abs(value), axis=0, initial=0.0))
    return np.broadcast_to(noise**2, value.shape) if model is None else variance_at(model, np.maximum(value, 0.0))


def variance_at(coefficients: Any, value: Any) -> Any:
    """Of noise at some values, (..., C), by the coefficients of each channel."""
    a, b, c = coefficients.T
    return a + value * (b + value * c)


def growth_of_channel(
    squared: np.ndarray, value: np.ndarray, least: float, start: np.ndarray | None = None, terms: int = 3
) -> tuple[np.ndarray, float]:
    """Coefficients of so many powers, and twice the rise of the logarithm of the likelihood over a constant variance.

    From coefficients that are nearly right one round leads on.
    """
    powers = max(float(np.max(value)), np.finfo(float).tiny) ** np.arange(terms)
    columns = value ** np.arange(terms)[:, None] / powers[:, None]
    constant = max(float(np.mean(squared)), least, np.finfo(float).tiny)
    coefficients = constant * np.eye(terms)[0] if start is None else start * powers
    variance = coefficients @ columns
    for _ in range(ROUNDS if start is None else 1):
        # The variance of a squared residual is twice its mean squared; scaled, so that no digit is lost.
        scaled = columns / variance
        gram, product = scaled @ scaled.T, scaled @ (squared / variance)
        coefficients = nonnegative_minima(gram, product, np.zeros(terms), np.ones(terms, bool), DEPENDENT)
        coefficients[0] = max(coefficients[0], least, 1e-6 * constant)
        variance = coefficients @ columns
    gain = np.sum(np.log(constant / variance) + squared / constant - squared / variance)
    return coefficients / powers, float(gain)


@eqx.filter_jit
def _reweighted(picture: Picture, n: AnyArray, x: AnyArray, coefficients: AnyArray, inverse: bool) -> Array:
    value = jnp.maximum(picture.predicted(n, x), 0.0)
    variance = variance_at(jnp.asarray(coefficients, value.dtype), value)
    return picture.weights / variance if inverse else picture.weights * variance


def weighted_sums(
    pictures: Sequence[Picture], optimum: Optimum, coefficients: Float[np.ndarray, "C 3"], *, inverse: bool
) -> Sums:
    """Sums at the optimum with each pixel's weight times its variance, or divided by it: one more pass.

    Columns are ambient, diffuse, lobe, derivative by n, about the target; ``coefficients`` are those of the variance.
    """
    n, x = np.asarray(optimum.n), optimum.x
    return sums_at(pictures, optimum, each(lambda one: _reweighted(one, n, x, coefficients, inverse), pictures))


def sums_at(pictures: Sequence[Picture], optimum: Optimum, weights: Sequence[AnyArray]) -> Sums:
    """Sums at the optimum with other weights."""

    def again(picture: Picture, weight: AnyArray) -> Picture:
        return dataclasses.replace(picture, weight=jnp.asarray(weight, picture.target.dtype))

    with jax.enable_x64(True):
        parts = sums(each(again, pictures, weights), np.log([optimum.n]), optimum.x.T)
    return Sums(*(leaf[0] for leaf in parts)).about(optimum.x.T).columns(np.diag([1.0, 1.0, 1.0, 1.0 / optimum.n]))


def misweighted_sums(
    pictures: Sequence[Picture],
    optimum: Optimum,
    least: Float[np.ndarray, " C"],
    given: Sequence[AnyArray] | None = None,
) -> tuple[Sums, Float[np.ndarray, "C 3"] | None] | None:
    """Sums at the optimum with each pixel's weight times the variance of its weighted residual, where weights vary it.

    Weights of least squares are inverse variances, unless they say what is of interest: those of a soft mask, of a
    region. Then noise is what it is beside them, and errors are those of the sandwich. Some pixels tell which of both,
    how large noise is, and how it grows with brightness, if it does: `noise_model`. The sums are of all. None where
    inverse variances are as likely.

    ``given`` are the weights of each picture that are asked about, a part of its own or, by default, these.
    """
    given = each(lambda picture: picture.weights, pictures) if given is None else given
    stride = -(-sum(int(picture.counts.sum()) for picture in pictures) // MOST_PIXELS)
    parts = [_residual_value_weight(*one, optimum, stride) for one in zip(pictures, given, strict=True)]
    of_channels = max(weight.shape[0] for *_, weight in parts)
    residual, value = (np.concatenate([part[i] for part in parts], axis=1) for i in range(2))
    weight = np.concatenate([np.broadcast_to(one, (of_channels, one.shape[1])) for *_, one in parts], axis=1)
    if not residual.any(axis=1).all():
        return None
    counts = np.broadcast_to(weight > 0, residual.shape)
    log_weight, whole = np.log(np.where(weight > 0, weight, 1.0)), counts.all(axis=0)
    least, best = least / math.exp(np.mean(log_weight) / 2), []
    for power in (*POWERS, 1.0):
        even = residual * np.exp((power - 1) / 2 * log_weight)
        growing = noise_model(even[:, whole].T, value[:, whole].T, least * math.exp(power * np.mean(log_weight) / 2))
        variance = np.mean(even**2, axis=1, where=counts)
        if growing is None:
            growing = variance[:, None] * [1.0, 0.0, 0.0]
        spread = variance_at(growing, np.maximum(value, 0.0).T).T
        # Twice the logarithm of the likelihood, but for a constant; a weight that channels share is that of each.
        likely = np.sum(power * log_weight - np.log(spread) - even**2 / spread, where=counts)
        best.append((float(likely), power, growing))
    likely, power, growing = max(best, key=operator.itemgetter(0))
    if likely < best[-1][0] + RISE:
        return None

    grows = bool(growing[:, 1:].any())

    def beside(picture: Picture, weight: AnyArray) -> AnyArray:
        value = np.maximum(picture.predict(optimum.n, optimum.x), 0.0) if grows else np.zeros((1, len(growing)))
        of_weight = np.asarray(picture.weights, float) * np.asarray(weight, float) ** (1 - power)
        return np.broadcast_to(of_weight * variance_at(growing, value), picture.target.shape)

    # Squares of weights may differ by more than single precision holds.
    double = each(lambda picture: cast(picture, "float64"), pictures)
    return sums_at(double, optimum, each(beside, pictures, given)), growing if grows else None


def _residual_value_weight(
    picture: Picture, weight: AnyArray, optimum: Optimum, stride: int
) -> tuple[Float[np.ndarray, "C K"], Float[np.ndarray, "C K"], Float[np.ndarray, "Cw K"]]:
    """Weighted residuals of some pixels that count, what is predicted, and such weights, which channels may share."""
    pixel = np.flatnonzero(picture.counts)
    # One at random of each so many: a fixed step could meet no more than some columns of a picture.
    first = np.arange(0, pixel.size, stride)
    pixel = pixel[np.minimum(first + np.random.default_rng(0).integers(stride, size=first.size), pixel.size - 1)]
    some = picture.in_double(pixel)
    weight = np.broadcast_to(weight, (len(picture.target), weight.shape[1]))[pixel] * (some.weights > 0)[: pixel.size]
    shown = np.asarray(some.predict(optimum.n, optimum.x), float)
    return residuals(some, optimum)[: pixel.size].T, shown[: pixel.size].T, np.asarray(weight, float).T
