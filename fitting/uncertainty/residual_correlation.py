"""What a residual gives away: neighbours that err alike, and a highlight that few pixels carry."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from fitting.solver.normal_equations import AnyArray, Picture
from fitting.solver.profile import Optimum
from fitting.uncertainty.noise_model import NoiseModel, noise_model

# Pairs of neighbours that are looked at in all: a correlation is then known to 1 %.
PAIRS = 8192
FEWEST_PAIRS = 256
MOST_PICTURES = 16
# A correlation above this, and above so many of its own standard errors, is structure.
CORRELATED, DEVIATIONS = 0.1, 5.0
# A highlight on fewer pixels, counted by the squares of its values, is sampled too coarsely to trust its shape.
FEW_PIXELS = 4.0
# The pixel nearest to a highlight's centre shows less than this of it: the highlight falls between pixels.
OFF_CENTRE = 0.5


class Structure(NamedTuple):
    """How residuals of neighbouring pixels go together.

    Attributes:
        correlation: of neighbours, over all channels.
        significant: it is too large for chance, and large enough to matter.
        noise: how the noise grows with brightness; None where it does not.
    """

    correlation: float
    significant: bool
    noise: NoiseModel | None = None

    @property
    def inflation(self) -> float:
        """By what factor errors from the formula are too small, at least.

        That of a smooth basis image under noise whose correlation falls off exponentially along rows and columns.
        """
        if not self.significant:
            return 1.0
        correlation = min(self.correlation, 0.999)
        return (1 + correlation) / (1 - correlation)


def structure(
    pictures: Sequence[Picture],
    shapes: Sequence[tuple[int, int]],
    optimum: Optimum,
    rounding: Float[np.ndarray, " C"],
) -> Structure:
    """Correlate the residuals of some neighbouring pixels.

    Args:
        pictures: pixels row by row.
        shapes: height and width of each.
        optimum: what was fitted.
        rounding: standard deviation of a value's rounding, (C,): a residual no larger is not looked at.
    """
    noise = np.sqrt(optimum.cost / np.maximum(optimum.pixels, 1))
    channels = noise > 2 * rounding
    if not channels.any():
        return Structure(0.0, False)
    stride = -(-len(pictures) // MOST_PICTURES)
    some = range(0, len(pictures), stride)
    each = max(FEWEST_PAIRS, PAIRS // len(some))
    products, count, samples = np.zeros((3, noise.size)), 0, []
    for index in some:
        picture = pictures[index]
        weight = None if picture.weight is None else np.asarray(picture.weight)
        if weight is not None and weight.ndim == 2:
            weight = weight.min(axis=1)
        counted = np.ones(shapes[index], bool) if weight is None else (weight > 0).reshape(shapes[index])
        first, second = _neighbours(counted, each)
        count += first.size
        pad = (0, each - first.size)
        pairs = np.stack([np.pad(first, pad), np.pad(second, pad)]).astype(np.int32)
        scaled, value = _scaled(*_residuals(picture, pairs, np.asarray(optimum.n), optimum.x), first.size)
        products += np.stack([np.sum(scaled[i] * scaled[j], axis=0) for i, j in ((0, 1), (0, 0), (1, 1))])
        samples.append((scaled[0], value[0]))
    scale = np.where(channels, noise, np.inf) ** -2.0
    cross, left, right = products @ scale
    correlation = float(cross / max(np.sqrt(left * right), np.finfo(float).tiny))
    least = max(CORRELATED, DEVIATIONS / np.sqrt(max(count, 1)))
    residual, value = (np.concatenate(each) for each in zip(*samples, strict=True))
    return Structure(correlation, correlation > least, noise_model(residual, value, rounding))


def _neighbours(counted: Bool[np.ndarray, "H W"], most: int) -> tuple[Int[np.ndarray, " M"], Int[np.ndarray, " M"]]:
    """Flat indices of pairs that lie side by side, or one above the other, and both count."""
    height, width = counted.shape
    stride = max(1, round(2 * np.sqrt(counted.size / most) / 3))
    rows, columns = np.arange(0, height, stride * 2), np.arange(0, width, stride * 2)
    some = counted[rows]
    row, column = np.nonzero(some[:, :-1] & some[:, 1:])
    beside = rows[row] * width + column
    some = counted[:, columns]
    row, column = np.nonzero(some[:-1] & some[1:])
    above = row * width + columns[column]
    first = np.concatenate([beside, above])
    second = np.concatenate([beside + 1, above + width])
    if first.size > most:
        chosen = np.linspace(0, first.size - 1, most).astype(int)
        first, second = first[chosen], second[chosen]
    return first, second


@eqx.filter_jit
def _residuals(
    picture: Picture, pairs: Int[AnyArray, "2 M"], n: Float[AnyArray, ""], x: Float[AnyArray, "3 C"]
) -> tuple[Float[Array, "M2 C"], Float[Array, "M2 Cw"], Float[Array, "M2 C"]]:
    some = picture.pixels(lambda a: jnp.take(a, pairs.ravel(), axis=0))
    dtype = some.target.dtype
    x = jnp.asarray(x).astype(dtype)
    model = x[0] * jnp.asarray(some.ambient).astype(dtype) + x[1] * some.diffuse
    if some.lobe is not None:
        model = model + x[2] * some.lobe(jnp.asarray(n))[0]
    weight = jnp.ones((1, 1), dtype) if some.weight is None else some.weight.reshape(pairs.size, -1)
    return jnp.where(weight > 0, some.target - model, 0), weight, jnp.broadcast_to(model, some.target.shape)


def _scaled(
    residual: Array, weight: Array, model: Array, valid: int
) -> tuple[Float[np.ndarray, "2 M C"], Float[np.ndarray, "2 M C"]]:
    """Residuals times the root of their weight, and what was fitted; of the first and the second of each pair."""
    scaled = np.asarray(residual, np.float64) * np.sqrt(np.asarray(weight, np.float64))
    shape = (2, -1, scaled.shape[-1])
    return scaled.reshape(shape)[:, :valid], np.asarray(model, np.float64).reshape(shape)[:, :valid]


class Highlight(NamedTuple):
    """What the pixels see of the highlight.

    Attributes:
        largest: value of the lobe in any pixel.
        pixels: how many carry it: the sum of its squares over the largest square, added up over pictures.
        n: its exponent.
        peak: logarithm of the lobe's cosine in the pixel nearest to its centre.
    """

    largest: float
    pixels: float
    n: float
    peak: float

    @property
    def centre(self) -> float:
        """How much of its peak the nearest pixel shows, 0 to 1."""
        return math.exp(self.n * self.peak)

    @property
    def smaller_than_pixel(self) -> bool:
        """Too few pixels see it to tell its shape."""
        return self.pixels < FEW_PIXELS or self.centre < OFF_CENTRE


def highlight(pictures: Sequence[Picture], n: float) -> Highlight:
    """Measure the highlight.

    Args:
        pictures: with a lobe.
        n: exponent.
    """
    largest, pixels, peak = 0.0, 0.0, -math.inf
    for picture in pictures:
        if picture.lobe is not None:
            value, squares, nearest = (float(v) for v in _highlight(picture, np.asarray(n)))
            largest, peak = max(largest, value), max(peak, nearest)
            # Squares of a highlight that no pixel sees fall below the smallest number.
            pixels += squares / value**2 if squares > 0 and value**2 > 0 else 0.0
    return Highlight(largest, pixels, n, min(peak, 0.0))


def nearest_peak(picture: Picture) -> float:
    """Logarithm of the lobe's cosine in the pixel nearest to its centre.

    Args:
        picture: with a lobe.
    """
    return float(_nearest_peak(picture))


@eqx.filter_jit
def _nearest_peak(picture: Picture) -> Array:
    assert picture.lobe is not None
    peak = picture.lobe.peak()
    if picture.weight is not None:
        counted = picture.weight > 0 if picture.weight.ndim == 1 else jnp.any(picture.weight > 0, axis=1)
        peak = jnp.where(counted, peak, -jnp.inf)
    return jnp.max(peak)


@eqx.filter_jit
def _highlight(picture: Picture, n: Float[AnyArray, ""]) -> tuple[Array, Array, Array]:
    assert picture.lobe is not None
    value = jnp.max(picture.lobe(jnp.asarray(n))[0], axis=1)
    peak = picture.lobe.peak()
    if picture.weight is not None:
        counted = picture.weight > 0 if picture.weight.ndim == 1 else jnp.any(picture.weight > 0, axis=1)
        value, peak = jnp.where(counted, value, 0), jnp.where(counted, peak, -jnp.inf)
    return jnp.max(value), jnp.sum(value * value), jnp.max(peak)
