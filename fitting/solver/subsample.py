"""A stratified subsample of a picture: a few thousand pixels that see every exponent.

A lobe of exponent n lights the pixels with ``-log_cos`` below about 1 / n: at n = 1e5 a handful around the peak, while
an n below 1 is told from another by the few that are nearly at 90 degrees from it. So each octave of ``-log_cos`` is a
stratum; sparse ones are kept whole, the others sample to about equal numbers. Weights are the inverse probabilities.
"""

import math
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fitting.solver.normal_equations import Picture, relative_lobe

# The strata are counted on every 16th pixel.
_PREVIEW_STRIDE = 16

# Down to exp(-60) of its value at the centre a lobe is well inside float32.
_LARGEST_DECAY = 60.0

# A pixel of weight 0 is in no stratum.
_EXCLUDED = 255


class Subsample(NamedTuple):
    """Some pixels of a picture.

    Attributes:
        picture: The pixels kept, their weights times ``factor``.
        factor: How many pixels each stands for, at least 1; 0 for padding. None where all pixels were kept.
        nearest: The smallest ``-log_cos`` of all pixels that count; infinite without a lobe.
    """

    picture: Picture
    factor: Float[np.ndarray, " M"] | None
    nearest: float


@jax.jit
def _octaves(picture: Picture) -> tuple[Array, Array]:
    """The octave of ``-log_cos``, which is its binary exponent, 0 at the peak itself; and the smallest ``-log_cos``."""
    assert picture.lobe is not None
    distance = -picture.lobe.peak()
    octave = (jax.lax.bitcast_convert_type(distance.astype(jnp.float32), jnp.int32) >> 23) & 0xFF
    if picture.weight is not None:
        counts = jnp.max(picture.weights, axis=1) > 0
        octave = jnp.where(counts, octave, _EXCLUDED)
        distance = jnp.where(counts, distance, jnp.inf)
    return octave.astype(jnp.uint8), jnp.min(distance)


def _shares(octaves: np.ndarray, size: int) -> np.ndarray:
    """Which share of each octave to keep, so that about ``size`` pixels remain."""
    preview = octaves[::_PREVIEW_STRIDE]
    count = np.bincount(preview, minlength=256) * (octaves.size / preview.size)
    count[_EXCLUDED] = 0
    # The largest number per octave that fits: the sparse ones leave their part to the others.
    ordered = np.sort(count[count > 0])
    most = (size - np.cumsum(ordered) + ordered) / np.arange(ordered.size, 0, -1)
    share = np.minimum(1.0, np.max(most, initial=0.0) / np.maximum(count, 1.0))
    share[_EXCLUDED] = 0.0
    return share


def subsample(picture: Picture, size: int, n_max: float) -> Subsample:
    """Take about ``size`` pixels of a picture.

    Args:
        picture: The picture.
        size: How many pixels are wanted.
        n_max: Largest exponent that they are to be used with.

    Returns:
        The pixels kept: all of them where there is no lobe, or no more than a quarter over ``size``.
    """
    count = picture.target.shape[0]
    capacity = size + size // 4
    if picture.lobe is None:
        return Subsample(picture, None, math.inf)
    octaves, nearest = (np.asarray(a) for a in _octaves(picture))
    if count <= capacity:
        return Subsample(picture, None, float(nearest))
    share = _shares(octaves, size)
    # Multiples of the golden ratio modulo 1 spread evenly over any run of pixels, without a regular pattern.
    step = np.arange(count, dtype=np.uint32) * np.uint32(2654435769)
    while True:
        index = np.flatnonzero(step < (share * 0xFFFFFFFF).astype(np.uint32)[octaves])
        if index.size <= capacity:
            break
        share = share * (0.9 * capacity / index.size)
    # Bracketing needs no more than float32, unless the lobe leaves its range.
    single = n_max * nearest < _LARGEST_DECAY
    # Padding repeats the first pixel with weight 0, for one shape means one compilation.
    padded = np.zeros(capacity, np.intp)
    padded[: index.size] = index

    def choose(a: Array) -> Any:
        # Through NumPy: an XLA gather is ten times slower.
        kept = np.take(np.asarray(a), padded, axis=0)
        return kept.astype(np.float32) if single and kept.dtype == np.float64 else kept

    factor = np.zeros(capacity, np.float32)
    factor[: index.size] = 1 / share[octaves[index]]
    kept = picture.pixels(choose)
    return Subsample(replace(kept, weight=kept.weights * factor[:, None]), factor, float(nearest))


@jax.jit
def spread(
    sample: Subsample, log_n: Array, x: Float[Array, "N C 3"], few: Array, best: Array, peak: Array
) -> tuple[Array, Array]:
    """How far the subsample's profile may be from that of all pixels.

    Args:
        sample: The subsample of one picture.
        log_n: Natural logarithms of the exponents, (N,).
        x: Best coefficients at each.
        few: Which of them to look at.
        best: Which to compare with.
        peak: See :func:`fitting.solver.normal_equations.relative_lobe`.

    Returns:
        Horvitz-Thompson variances of the cost at those exponents minus that at the best, and of the profile's slope by
        log n. They add up over pictures.
    """
    picture, lobe, factor = sample.picture, sample.picture.lobe, sample.factor
    assert lobe is not None
    assert factor is not None
    dtype = picture.target.dtype
    x = x.astype(dtype)
    # A pixel that was certain to be kept adds nothing to the uncertainty.
    chance = jnp.where(factor > 0, 1 - 1 / jnp.maximum(factor, 1), 0.0)

    def residual_and_slope(index: Array) -> tuple[Array, Array]:
        value, slope = relative_lobe(lobe, log_n[index], peak, dtype)
        x_a, x_d, x_s = x[index].T
        model = x_a * jnp.asarray(picture.ambient, dtype) + x_d * picture.diffuse + x_s * value
        return picture.target - model, x_s * slope

    def variance(a: Array) -> Array:
        return jnp.sum(chance * jnp.sum(jnp.where(picture.weights > 0, picture.weights * a, 0), axis=1) ** 2)

    reference, _ = residual_and_slope(best)

    def one(index: Array) -> tuple[Array, Array]:
        residual, slope = residual_and_slope(index)
        return variance((residual - reference) * (residual + reference)), variance(2 * residual * slope)

    return jax.lax.map(one, few)
