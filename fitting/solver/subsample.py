"""A stratified subsample of a picture: a few thousand pixels that see every exponent.

A lobe of exponent n lights the pixels with ``-log_cos`` below about 1 / n: at n = 1e5 a handful around the peak, while
an n below 1 is told from another by the few that are nearly at 90 degrees from it. So each octave of ``-log_cos`` is a
stratum; sparse ones are kept whole, the others sample to about equal numbers. Weights are the inverse probabilities.
"""

import math
from functools import partial
from typing import NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, UInt8

from fitting.solver.normal_equations import COMPILER_OPTIONS, UNROLLED_CHANNELS, AnyArray, Picture, relative_lobe

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
    factor: Float[AnyArray, " M"] | None
    nearest: float


@jax.jit
def _octaves(picture: Picture) -> tuple[UInt8[Array, " P"], Float[Array, ""]]:
    """The octave of ``-log_cos``, which is its binary exponent, 0 at the peak itself; and the smallest ``-log_cos``."""
    assert picture.lobe is not None
    distance = -picture.lobe.peak()
    octave = (jax.lax.bitcast_convert_type(distance.astype(jnp.float32), jnp.int32) >> 23) & 0xFF
    if picture.weight is not None:
        weight = picture.weight if picture.weight.ndim == 1 else jnp.max(picture.weight, axis=1)
        octave = jnp.where(weight > 0, octave, _EXCLUDED)
        distance = jnp.where(weight > 0, distance, jnp.inf)
    return octave.astype(jnp.uint8), jnp.min(distance)


@jax.jit
def _chosen(octaves: UInt8[Array, " P"], share: Float[Array, "256"]) -> Bool[Array, " P"]:
    """Which pixels are kept, given the share of each octave."""
    # Multiples of the golden ratio modulo 1 spread evenly over any run of pixels, without a regular pattern.
    step = jnp.arange(octaves.shape[0], dtype=jnp.uint32) * jnp.uint32(2654435769)
    return step.astype(jnp.float32) * 2.0**-32 < share[octaves]


def _shares(octaves: UInt8[np.ndarray, " P"], size: int) -> Float[np.ndarray, "256"]:
    """Which share of each octave to keep, so that about ``size`` pixels remain."""
    preview = octaves[::_PREVIEW_STRIDE]
    count = np.bincount(preview, minlength=256) * (octaves.size / preview.size)
    count[_EXCLUDED] = 0
    # The largest number per octave that fits: the sparse ones leave their part to the others.
    rest, most = float(size), 0.0
    ordered = np.sort(count[count > 0])
    for i, here in enumerate(ordered):
        most = rest / (ordered.size - i)
        if here > most:
            break
        rest -= here
    share = np.minimum(1.0, most / np.maximum(count, 1.0))
    share[_EXCLUDED] = 0.0
    return share.astype(np.float32)


def subsample(picture: Picture, size: int, n_max: float) -> Subsample:
    """Take about ``size`` pixels.

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
    octaves, nearest = _octaves(picture)
    nearest = float(nearest)
    if count <= capacity:
        return Subsample(picture, None, nearest)
    share = _shares(np.asarray(octaves), size)
    index = np.flatnonzero(np.asarray(_chosen(octaves, share)))
    while index.size > capacity:
        share = share * np.float32(0.9 * capacity / index.size)
        index = np.flatnonzero(np.asarray(_chosen(octaves, share)))
    # Bracketing needs no more than float32, unless the lobe leaves its range.
    single = n_max * nearest < _LARGEST_DECAY
    # Padding repeats the first pixel with weight 0, for one shape means one compilation.
    padded = np.zeros(capacity, np.intp)
    padded[: index.size] = index

    def choose(a: Array) -> Array:
        # Through NumPy: an XLA gather is ten times slower.
        kept = np.take(np.asarray(a), padded, axis=0)
        return cast(Array, kept.astype(np.float32) if single and kept.dtype == np.float64 else kept)

    factor = np.zeros(capacity, np.float32)
    factor[: index.size] = 1 / share[np.asarray(octaves)[index]]
    kept = picture.pixels(choose)
    weight = cast(Array, factor)
    if kept.weight is not None:
        weight = kept.weight * (factor if kept.weight.ndim == 1 else factor[:, None])
    return Subsample(Picture(kept.target, kept.diffuse, kept.lobe, weight, kept.ambient), factor, nearest)


@partial(jax.jit, compiler_options=COMPILER_OPTIONS)
def spread(
    sample: Subsample,
    log_n: Float[AnyArray, " N"],
    x: Float[AnyArray, "N C 3"],
    best_log_n: Float[AnyArray, ""],
    best_x: Float[AnyArray, "C 3"],
    peak: Float[AnyArray, ""],
) -> tuple[Float[Array, " N"], Float[Array, " N"]]:
    """How far the subsample's profile may be from that of all pixels.

    Args:
        sample: The subsample of one picture.
        log_n: Natural logarithms of the exponents.
        x: Best coefficients at each.
        best_log_n: Natural logarithm of the exponent to compare with.
        best_x: Best coefficients there.
        peak: See :func:`fitting.solver.normal_equations.relative_lobe`.

    Returns:
        Horvitz-Thompson variances of the cost at each exponent minus that at the best, and of the profile's slope by
        log n. They add up over pictures.
    """
    picture, factor = sample.picture, sample.factor
    lobe, weight = picture.lobe, picture.weight
    assert lobe is not None
    assert weight is not None
    assert factor is not None
    shape = picture.target.shape
    dtype = picture.target.dtype
    # Channels first, and one at a time: the loops over pixels are then contiguous and evaluate the lobe once.
    channels = (
        picture.target.T,
        jnp.broadcast_to(weight if weight.ndim == 2 else weight[:, None], shape).T,
        jnp.broadcast_to(picture.diffuse, shape).T,
        jnp.broadcast_to(picture.ambient, shape[1:]).astype(dtype),
    )
    unroll = min(shape[1], UNROLLED_CHANNELS)

    def lit(at: Float[Array, ""]) -> tuple[Float[Array, "C M"], Float[Array, "C M"]]:
        value, by_log_n = relative_lobe(lobe, at, jnp.asarray(peak), dtype)
        return jnp.broadcast_to(value, shape).T, jnp.broadcast_to(by_log_n, shape).T

    # A pixel that was sure to be kept adds nothing to the uncertainty.
    chance = jnp.where(factor > 0, 1 - 1 / jnp.maximum(factor, 1), 0.0)
    zero = np.zeros((), dtype)
    model, _ = lit(jnp.asarray(best_log_n))

    def one(at: tuple[Float[Array, ""], Float[Array, "C 3"]]) -> tuple[Float[Array, ""], Float[Array, ""]]:
        def channel(carry: tuple, each: tuple) -> tuple[tuple, None]:
            (target, weight, diffuse, ambient), value, by_log_n, best_value, x, best_x = each
            mine = target - x[0] * ambient - x[1] * diffuse - x[2] * value
            other = target - best_x[0] * ambient - best_x[1] * diffuse - best_x[2] * best_value
            change = jnp.where(weight > 0, weight * (mine - other) * (mine + other), 0.0)
            score = jnp.where(weight > 0, 2 * weight * mine * x[2] * by_log_n, 0.0)
            return (carry[0] + change, carry[1] + score), None

        nothing = jnp.zeros(shape[0], dtype)
        each = (channels, *lit(at[0]), model, at[1], best_x.astype(dtype))
        (change, score), _ = jax.lax.scan(channel, (nothing, nothing), each, unroll=unroll)
        pair = (chance * change * change, chance * score * score)
        return jax.lax.reduce(pair, (zero, zero), lambda a, b: (a[0] + b[0], a[1] + b[1]), (0,))

    return jax.lax.map(one, (log_n, x.astype(dtype)))
