"""What a fit leaves, gone over once: neighbours that err alike, noise that grows with brightness, the highlight.

Errors are taken in units of the noise, 0 where a pixel does not count.
"""

import math
from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from fitting.likelihood import AnyArray
from fitting.solver.normal_equations import COMPILER_OPTIONS, FEW_VALUES, UNROLLED_CHANNELS, Picture, totals
from fitting.solver.profile import Optimum
from fitting.uncertainty.highlight import Highlight
from fitting.uncertainty.noise_model import noise_model
from fitting.uncertainty.structure import SIZES, Blocks

# So many pixels are looked at one by one, with those beside and below them: in all, and of each picture at least.
SOME_PIXELS, FEWEST_PIXELS = 4096, 128
GOLDEN = 0.6180339887498949
# A correlation above this, and above so many of its own standard errors, is structure.
CORRELATED, DEVIATIONS = 0.1, 5.0
# A correlation above this is told.
TOLD = 0.05
# Up to this share of the picture a residual shows where a solver stopped.
NEGLIGIBLE = 1e-6


class Neighbours(NamedTuple):
    """How errors of neighbouring pixels go together.

    Attributes:
        correlation: over all channels.
        significant: it is too large for chance, and large enough to matter.
    """

    correlation: float = 0.0
    significant: bool = False

    @property
    def inflation(self) -> float:
        """By what factor errors from the formula are too small, at least.

        That of a smooth basis image under noise whose correlation falls off exponentially along rows and columns.
        """
        correlation = min(self.correlation, 0.999) if self.significant else 0.0
        return (1 + correlation) / (1 - correlation)


class Residual(NamedTuple):
    """What a fit leaves.

    Attributes:
        blocks: sums over the smallest blocks, of each picture.
        neighbours: correlation of channels whose noise is more than rounding.
        errors: of some pixels that count, (M, C).
        values: that the model shows there.
        highlight: what the pixels see of it.
    """

    blocks: list[Blocks]
    neighbours: Neighbours
    errors: Float[np.ndarray, "M C"]
    values: Float[np.ndarray, "M C"]
    highlight: Highlight

    def channels(self, tell: Bool[np.ndarray, " C"]) -> Float[np.ndarray, "C C"] | None:
        """Correlation of the channels' errors; None where no two err together whose noise is more than rounding."""
        size = np.sqrt(np.maximum(np.sum(self.errors**2, axis=0), np.finfo(float).tiny))
        found, own = (self.errors.T @ self.errors) / np.outer(size, size), np.eye(size.size)
        least = max(CORRELATED, DEVIATIONS / max(len(self.errors), 1) ** 0.5)
        together = (np.abs(found) > least) & np.outer(tell, tell)
        if not np.any(together & (own == 0)):
            return None
        # Without those that chance makes it may be no correlation: the nearest that is one.
        values, vectors = np.linalg.eigh(np.where(together, found, own))
        nearest = (vectors * np.maximum(values, 0.0)) @ vectors.T
        return nearest / np.sqrt(np.outer(np.diag(nearest), np.diag(nearest)))

    def growing_noise(
        self, noise: Float[np.ndarray, " C"], rounding: Float[np.ndarray, " C"]
    ) -> Float[np.ndarray, "C 3"] | None:
        """How the noise grows with brightness, see `fitting.uncertainty.noise_model`; None where it does not."""
        return noise_model(self.errors * noise, self.values, rounding)


def variance_inflation(channels: Float[np.ndarray, "C C"] | None) -> float:
    """By what factor errors of what all channels share are too small at most, where each counts as one of its own.

    By the correlation of their errors; None where they err alone.
    """
    return 1.0 if channels is None else float(np.sqrt(np.linalg.eigvalsh(channels)[-1]))


def residual_statistics(
    pictures: Sequence[Picture],
    widths: Sequence[int],
    optimum: Optimum,
    noise: Float[np.ndarray, " C"],
    rounding: Float[np.ndarray, " C"],
) -> Residual:
    """Go over what a fit leaves, a picture at a time, its pixels row by row, and its whole width.

    Noise is the weighted residual's; neighbours in a channel with no more than that of rounding are not looked at.
    """
    most = max(FEWEST_PIXELS, SOME_PIXELS // len(pictures))
    blocks, pairs, errors, values = [], [], [], []
    # The lobe is taken relative to its largest value in any picture, or squares of a highlight that no pixel sees would
    # fall below the smallest number.
    peak = 0.0 if optimum.flat else min(max(picture.nearest_peak for picture in pictures), 0.0)
    decay, largest, squares = math.exp(optimum.n * peak), 0.0, 0.0
    for picture, width in zip(pictures, widths, strict=True):
        small = picture.target.size <= FEW_VALUES and not picture.is_sampled
        picture = jax.tree.map(np.asarray, picture) if small else picture
        unit = np.maximum(noise, np.finfo(picture.target.dtype).tiny)
        at = np.asarray(optimum.n), peak, optimum.x * np.array([[1.0], [1.0], [decay]]), unit
        places = _places(picture.counts, width, most)
        if small:
            *parts, lobe = _residual_and_values(picture, *at)
            found = _over_blocks(parts[0], lobe, width)
            residual, predicted = (np.concatenate(part)[:, places] for part in parts)
        else:
            found = _over_blocks_many(picture, *at, width=width)
            few = picture.in_double(places.ravel())
            parts = (_residual_and_values_jitted if few.is_sampled else _residual_and_values)(few, *at)[:2]
            shape = len(noise), *places.shape
            residual, predicted = (np.concatenate(part)[:, : places.size].reshape(shape) for part in parts)
        *sums, own, top = jax.device_get(found)
        # Of each channel or group sums, squares and counts, one after the other: (R, Q, C) of each kind.
        blocks.append(Blocks(*(np.moveaxis(np.concatenate(sums[kind::3]), 0, -1) for kind in range(3))))
        largest, squares = max(largest, float(np.max(top))), squares + float(np.sum(own[0]))
        pairs.append(_pairs(residual, places))
        counts = np.any(residual[:, 0] != 0, axis=0)
        errors.append(residual[:, 0, counts])
        values.append(predicted[:, 0, counts])
    error, value = (np.concatenate(parts, axis=1).T.astype(np.float64) for parts in (errors, values))
    lobe = Highlight(decay * largest, squares / (largest or 1.0) ** 2, peak, decay)
    return Residual(blocks, _correlation(pairs, noise > 2 * rounding), error, value, lobe)


def neighbours_of(images: Sequence[Float[np.ndarray, "H W C"]]) -> Neighbours:
    """How errors of neighbours in some pictures go together; 0 where a pixel does not count."""
    pairs = []
    for image in images:
        left = image.reshape(-1, image.shape[2])
        places = _places(np.any(left != 0, axis=1), image.shape[1], SOME_PIXELS)
        pairs.append(_pairs(left.T[:, places], places))
    return _correlation(pairs, np.ones(images[0].shape[2], bool))


def structure_words(correlation: float) -> str:
    """What to say where pixels err alike; sums over blocks of them may tell more than what neighbours correlate by."""
    words = "the residual has structure: neighbouring pixels err alike"
    words += f" (correlation {correlation:.2f})" if correlation > TOLD else ""
    return f"{words}, so the model or the scene is not the whole truth"


def _correlation(pairs: Sequence[np.ndarray], channels: Bool[np.ndarray, " C"]) -> Neighbours:
    cross, one, other, count = np.sum(pairs, axis=0) @ channels
    correlation = float(cross / max(np.sqrt(one * other), np.finfo(float).tiny))
    least = max(CORRELATED, DEVIATIONS / max(count / max(np.count_nonzero(channels), 1), 1.0) ** 0.5)
    return Neighbours(correlation, correlation > least)


def _places(counts: Bool[np.ndarray, " P"], width: int, most: int) -> Int[np.ndarray, "3 M"]:
    """Some pixels that count, those beside them and those below; where there is none, themselves."""
    index = np.flatnonzero(counts)
    if len(index) > most:
        # Multiples of the golden ratio keep to no column of the picture.
        index = index[np.sort((np.arange(most) * GOLDEN % 1 * len(index)).astype(int))]
    below = index + width
    return np.stack([index, index + ((index + 1) % width > 0), np.where(below < counts.size, below, index)])


def _pairs(residual: Float[np.ndarray, "C 3 M"], places: Int[np.ndarray, "3 M"]) -> Float[np.ndarray, "4 C"]:
    """Of pairs side by side and one above the other: products, squares of both, how many pairs."""
    one, other = residual[:, :1], residual[:, 1:]
    both = (one != 0) & (other != 0) & (places[1:] > places[0])
    one, other = one * both, other * both
    return np.array([np.sum(term, axis=(1, 2)) for term in (one * other, one * one, other * other, both)])


def _residual_and_values(
    picture: Picture, n: AnyArray, peak: AnyArray | float, x: Float[AnyArray, "3 C"], noise: AnyArray
) -> tuple[list[Any], list[Any], Any]:
    """Of each channel, or of all together where they are many, errors and what is shown, (G, P); and the lobe, (P,).

    In NumPy or JAX; lobe and x_s are relative to the power n of the cosine whose logarithm is ``peak``.
    """
    xp: Any = np if isinstance(picture.diffuse, np.ndarray) else jnp
    channels, dtype = picture.target.shape[1], picture.target.dtype
    lobe = xp.zeros_like(picture.diffuse) if picture.lobe is None else picture.lobe(n, peak)[0]
    values = picture.target, xp.asarray(picture.ambient, dtype)[None], picture.diffuse, lobe, picture.weights
    x, noise = xp.asarray(x, dtype), xp.asarray(noise, dtype)
    residual, predicted, step = [], [], 1 if channels <= UNROLLED_CHANNELS else channels
    for first in range(0, channels, step):
        some = slice(first, first + step)
        target, ambient, diffuse, value, weight = (one.T[some] if one.shape[1] > 1 else one.T for one in values)
        x_a, x_d, x_s, unit = (one[some, None] for one in (*x, noise))
        predicted.append(xp.broadcast_to(x_a * ambient + x_d * diffuse + x_s * value, target.shape))
        residual.append(xp.where(weight > 0, target - predicted[-1], 0) * xp.sqrt(weight) / unit)
    return residual, predicted, xp.max(xp.where(picture.weights > 0, lobe, 0), axis=1)


def _over_blocks(residual: list[Any], lobe: Any, width: int) -> list[Any]:
    """Over blocks, (G, R, Q): of each group of channels sums of errors, of their squares, and how many count.

    Then the sum of the lobe's squares, and its largest value.
    """
    xp: Any = np if isinstance(lobe, np.ndarray) else jnp
    terms = [term for error in residual for term in (error, error * error, (error != 0).astype(error.dtype))]
    terms += [xp.broadcast_to(one, residual[0].shape) for one in (lobe * lobe, lobe)]
    size, step = SIZES[0], len(residual[0])

    def blocked(term: Any) -> Any:
        image = term.reshape(step, -1, width)
        whole = xp.pad(image, [(0, 0), (0, -image.shape[1] % size), (0, -width % size)])
        return whole.reshape(step, whole.shape[1] // size, size, -1, size)

    return totals(list(map(blocked, terms)), [*["add"] * (len(terms) - 1), "maximum"], (2, 4))


_residual_and_values_jitted = jax.jit(_residual_and_values)


@partial(jax.jit, static_argnames="width", compiler_options=COMPILER_OPTIONS)
def _over_blocks_many(picture: Picture, *at: Any, width: int) -> list[Any]:
    residual, _, lobe = _residual_and_values(picture, *at)
    return _over_blocks(residual, lobe, width)
