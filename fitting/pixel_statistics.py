"""What there is to know of pixels before the fit looks at them: which see the object, which are clipped or too dark."""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

import brdf

# A plateau of exactly equal largest values has to be larger than symmetry makes it before it counts as clipping.
SYMMETRIC_PIXELS = 8
# Where the diffuse basis varies by less than this over the plateau, the surface is flat there and nothing is clipped.
FLAT = 1e-3
# What counts as the largest value: a few units in the last place of float32 below it, for what follows clamping.
TOP = 1 - 1e-6


class Survey(NamedTuple):
    """What there is to know of the pixels of a picture, or of several of its tiles together.

    Attributes:
        seen: how many see a fitted shape.
        looked_at: how many of these are not masked.
        finite: how many of these are.
        largest: value of any channel among those.
        top: how many of them share it.
        scale: largest size of a value that counts, (C,).
        below: how many of the finite ones are not clipped.
        above: how many of these are not too dark.
    """

    seen: int
    looked_at: int
    finite: int
    largest: float
    top: int
    scale: Float[np.ndarray, " C"]
    below: int
    above: int

    def __add__(self, other: "Survey") -> "Survey":  # pyright: ignore[reportIncompatibleMethodOverride]
        """Of both."""
        one, two = (part.top if part.largest >= max(self.largest, other.largest) * TOP else 0 for part in (self, other))
        return Survey(
            self.seen + other.seen,
            self.looked_at + other.looked_at,
            self.finite + other.finite,
            max(self.largest, other.largest),
            one + two,
            np.maximum(self.scale, other.scale),
            self.below + other.below,
            self.above + other.above,
        )


@jax.jit
def survey(
    values: Float[Array, "P C"], seen: Bool[Array, " P"], looked_at: Bool[Array, " P"], dark: float, level: float
) -> tuple[Bool[Array, " P"], Survey]:
    """Look at pixels.

    Args:
        values: of each.
        seen: whether it sees a fitted shape.
        looked_at: whether it also is inside the mask.
        dark: value up to which it is too dark to count: none of its channels exceeds it.
        level: value from which on it is clipped, infinite where nothing is.

    Returns:
        Which pixels count, and what there is to know.
    """
    brightest = _over_channels(jnp.maximum, values)
    finite = looked_at & jnp.isfinite(_over_channels(jnp.add, values))
    largest = jnp.max(jnp.where(finite, brightest, -jnp.inf))
    count = jnp.count_nonzero
    top = count(finite & (brightest >= largest * TOP))
    below = finite & (brightest < level)
    good = below & (brightest > dark)
    scale = jnp.max(jnp.where(good[:, None], jnp.abs(values), 0), axis=0)
    found = (count(seen), count(looked_at), count(finite), largest, top, scale, count(below), count(good))
    return good, Survey(*found)  # pyright: ignore[reportArgumentType]


def lit_at_top(
    values: Float[Array, "P C"],
    good: Bool[Array, " P"],
    largest: float,
    points: brdf.SurfacePoints,
    scene: brdf.Scene,
) -> tuple[float, float] | None:
    """Between which values the diffuse light lies where a picture shows its largest value; None where it does not.

    Args:
        values: of each pixel.
        good: which count.
        largest: value in the picture.
        points: what the pixels see.
        scene: whose lights they are.
    """
    top = np.asarray(good) & (np.max(np.asarray(values), axis=-1) >= largest * TOP)
    if not top.any():
        return None
    diffuse = brdf.basis_images(brdf.Lambert, scene, points=points).diffuse
    light = np.max(np.asarray(diffuse).reshape(top.size, -1), axis=-1)[top]
    return float(np.min(light)), float(np.max(light))


@functools.partial(jax.jit, static_argnums=2)
def inverse_variance(
    values: Float[Array, "P C"], good: Bool[Array, " P"], shape: tuple[int, int], read: float, shot: float, step: float
) -> Float[Array, " P"]:
    """Inverse variances over their mean; a pixel's channels share the variance of their mean value.

    The value is the mean of 5 x 5 pixels: taken from the pixel itself, weights would favour what noise made darker.

    Args:
        values: of each pixel.
        good: which count; the others weigh 0.
        shape: height and width of the picture.
        read: standard deviation of the noise without light.
        shot: variance over value.
        step: distance of two codes.
    """
    mean = jnp.where(good, _over_channels(jnp.add, values) / values.shape[1], 0.0)
    count = good.astype(values.dtype)
    total, known = _boxed(mean.reshape(shape)).ravel(), _boxed(count.reshape(shape)).ravel()
    smooth = jnp.maximum(total / jnp.maximum(known, 1.0), 0.0)
    # Without read noise a black pixel would weigh infinitely much: quantisation, or a millionth of the mean, stands in.
    least = 1e-6 * shot * jnp.sum(mean) / jnp.maximum(jnp.sum(count), 1.0) + jnp.finfo(values.dtype).tiny
    variance = jnp.maximum(read * read + shot * smooth + step * step / 12.0, least)
    weight = jnp.where(good, jnp.min(jnp.where(good, variance, jnp.inf)) / variance, 0.0)
    return (weight * (jnp.sum(count) / jnp.sum(weight))).astype(values.dtype)


def _boxed(image: Float[Array, "H W"]) -> Float[Array, "H W"]:
    return jax.lax.reduce_window(image, np.zeros((), image.dtype), jax.lax.add, (5, 5), (1, 1), "SAME")


def _over_channels(combine: Any, values: Float[Array, "P C"]) -> Float[Array, " P"]:
    return functools.reduce(combine, [values[:, channel] for channel in range(values.shape[1])])
