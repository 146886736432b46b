"""A stratified subsample of a picture: a few thousand pixels that see every exponent.

A lobe of exponent n lights the pixels with ``-log_cos`` below about 1 / n, so at n = 1e5 it covers a handful. A pixel is kept
with probability ``min(1, limit / -log_cos)``: all of the innermost octaves of ``-log_cos``, and about equally many of each
octave further out, since a highlight's pixels multiply by two per octave. Weights are the inverse probabilities.
"""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from fitting.sums import COMPILER_OPTIONS, Picture

# Beyond -log_cos = 1 the lobe of every exponent above 1 is dark, and all that is left to see is ambient and diffuse.
_WIDEST = 1.0

# The limit is read off every 16th pixel, so that no 16 Mpixel array has to be sorted.
_PREVIEW_STRIDE = 16


class Thinned(eqx.Module):
    """Some pixels of a picture.

    Attributes:
        picture: The pixels kept, their weights times ``factor``.
        factor: How many pixels each stands for, at least 1; 0 for padding. None where all pixels were kept.
    """

    picture: Picture
    factor: Float[Array, " M"] | None


def _distance(picture: Picture) -> Float[Array, " P"]:
    assert picture.lobe is not None
    return jnp.clip(-picture.lobe.peak().astype(jnp.float32), 0.0, _WIDEST)


@jax.jit
def _priority(picture: Picture) -> Float[Array, " P"]:
    """Distance from the lobe's centre times a number in [0, 1) that steps evenly through the pixels; least come first."""
    distance = _distance(picture)
    # Multiples of the golden ratio modulo 1 spread evenly over any run of pixels, without a regular pattern.
    even = (jnp.arange(distance.shape[0], dtype=jnp.uint32) * jnp.uint32(2654435769)).astype(jnp.float32) * 2.0**-32
    priority = distance * even
    if picture.weight is None:
        return priority
    weight = picture.weight if picture.weight.ndim == 1 else jnp.max(picture.weight, axis=1)
    return jnp.where(weight > 0, priority, jnp.inf)


@jax.jit
def _keep(picture: Picture, index: Int[Array, " M"], valid: Int[Array, ""], limit: Float[Array, ""]) -> Thinned:
    kept = picture.pixels(lambda a: jnp.take(a, index, axis=0, mode="clip"))
    factor = jnp.where(jnp.arange(index.shape[0]) < valid, jnp.maximum(1.0, _distance(kept) / limit), 0.0)
    factor = factor.astype(picture.target.dtype)
    weight = factor
    if kept.weight is not None:
        weight = kept.weight * (factor if kept.weight.ndim == 1 else factor[:, None])
    weighted = Picture(kept.target, kept.diffuse, kept.lobe, weight, kept.ambient)
    return Thinned(weighted, factor)


def thin(picture: Picture, size: int) -> Thinned:
    """Thin a picture to about ``size`` pixels.

    Args:
        picture: The picture, with a lobe.
        size: How many pixels are wanted.

    Returns:
        The pixels kept: all of them where there are no more than a quarter over ``size``.
    """
    count = picture.target.shape[0]
    capacity = size + size // 4
    if count <= capacity:
        return Thinned(picture, None)
    priority = np.asarray(_priority(picture))
    preview = priority[::_PREVIEW_STRIDE]
    rank = min(max(1, round(size * preview.size / count)), preview.size - 1)
    limit = float(np.partition(preview, rank)[rank])
    index = np.flatnonzero(priority < limit)
    if index.size > capacity:
        chosen = priority[index]
        order = np.argpartition(chosen, capacity)
        limit = float(chosen[order[capacity]])
        index = np.sort(index[order[:capacity]])
    padded = np.zeros(capacity, np.int32)
    padded[: index.size] = index
    # A limit of 0 leaves the pixels at the very centre only; any positive number keeps their factor at 1.
    return _keep(picture, padded, np.int32(index.size), np.float32(max(limit, np.finfo(np.float32).tiny)))


@partial(jax.jit, compiler_options=COMPILER_OPTIONS)
def spread(
    thinned: Thinned, log_n: Float[Array, " N"], x: Float[Array, "N C 3"], best: Int[Array, ""]
) -> tuple[Float[Array, " N"], Float[Array, " N"]]:
    """How far the subsample's profile may be from that of all pixels.

    Args:
        thinned: The subsample of one picture.
        log_n: Natural logarithms of the exponents.
        x: Best coefficients at each.
        best: Which of them is to be compared with.

    Returns:
        Horvitz-Thompson variances of the cost at each exponent minus that at ``best``, and of the profile's slope by
        log n. They add up over pictures.
    """
    picture, factor = thinned.picture, thinned.factor
    lobe, weight = picture.lobe, picture.weight
    assert lobe is not None and weight is not None and factor is not None
    # Channels first: the loops over pixels are then contiguous.
    target = picture.target.T
    weight = jnp.broadcast_to(weight.T, target.shape)
    diffuse = picture.diffuse.T
    ambient = jnp.broadcast_to(picture.ambient, target.shape[0]).astype(target.dtype)

    def residual(at: Float[Array, ""], x: Float[Array, "C 3"]) -> tuple[Float[Array, "C M"], Float[Array, "C M"]]:
        n = jnp.exp(at)
        value, by_n = lobe(n)
        x = x.astype(target.dtype)
        model = (x[:, 0] * ambient)[:, None] + x[:, 1:2] * diffuse + x[:, 2:] * value.T
        return jnp.where(weight > 0, target - model, 0.0), x[:, 2:] * (by_n.T * n.astype(by_n.dtype))

    reference = residual(log_n[best], x[best])[0]
    # A pixel that was sure to be kept adds nothing to the uncertainty.
    chance = jnp.where(factor > 0, 1 - 1 / jnp.maximum(factor, 1), 0.0)
    zero = np.zeros((), target.dtype)

    def one(at: tuple[Float[Array, ""], Float[Array, "C 3"]]) -> tuple[Float[Array, ""], Float[Array, ""]]:
        mine, sensitivity = residual(*at)
        change = jnp.sum(weight * (mine - reference) * (mine + reference), axis=0)
        score = jnp.sum(2 * weight * mine * sensitivity, axis=0)
        pair = (chance * change * change, chance * score * score)
        return jax.lax.reduce(pair, (zero, zero), lambda a, b: (a[0] + b[0], a[1] + b[1]), (0,))

    return jax.lax.map(one, (log_n, x))
