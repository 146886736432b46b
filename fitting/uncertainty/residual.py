"""What a fit leaves, gone over once: neighbours that err alike, noise that grows with brightness, the highlight.

Errors are taken in units of the noise, 0 where a pixel does not count.
"""

import operator
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from fitting.solver.normal_equations import COMPILER_OPTIONS, FEW_VALUES, AnyArray, Picture
from fitting.solver.profile import Optimum
from fitting.uncertainty.noise_model import noise_model
from fitting.uncertainty.structure import SIZES, Blocks, coarser

# Pairs of neighbours that are looked at in all, about: a correlation is then known to 1 %.
PAIRS, FEWEST_PAIRS, FEWEST_ROWS = 8192, 256, 16
GOLDEN = 0.6180339887498949
# A correlation above this, and above so many of its own standard errors, is structure.
CORRELATED, DEVIATIONS = 0.1, 5.0
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
        largest: value of the lobe in any pixel that counts.
        carrying: how many pixels carry the highlight: the sum of its squares over the largest, over all pictures.
    """

    blocks: list[Blocks]
    neighbours: Neighbours
    errors: Float[np.ndarray, "M C"]
    values: Float[np.ndarray, "M C"]
    largest: float
    carrying: float

    def growing_noise(
        self, noise: Float[np.ndarray, " C"], rounding: Float[np.ndarray, " C"]
    ) -> Float[np.ndarray, "C 3"] | None:
        """How the noise grows with brightness, see `fitting.uncertainty.noise_model`; None where it does not."""
        return noise_model(self.errors * noise, self.values, rounding)


def survey(
    pictures: Sequence[Picture],
    widths: Sequence[int],
    optimum: Optimum,
    noise: Float[np.ndarray, " C"],
    rounding: Float[np.ndarray, " C"],
) -> Residual:
    """Go over what a fit leaves, a picture at a time.

    Args:
        pictures: pixels row by row.
        widths: of the whole of each.
        optimum: what was fitted.
        noise: standard deviation of the weighted residual, (C,).
        rounding: that of a value's rounding, (C,): neighbours in a channel with no more noise are not looked at.
    """
    most = max(FEWEST_PAIRS, PAIRS // len(pictures))
    blocks, pairs, errors, values = [], [], [], []
    largest, carrying = 0.0, 0.0
    for picture, width in zip(pictures, widths, strict=True):
        small = picture.target.size <= FEW_VALUES and not picture.is_sampled
        make = _survey if small else _survey_many
        picture = jax.tree.map(np.asarray, picture) if small else picture
        unit = np.maximum(noise, np.finfo(picture.target.dtype).tiny)
        found = make(picture, np.asarray(optimum.n), optimum.x, unit, width=width)
        left, counts, shown, parts, top, squares = jax.device_get(found)
        blocks.append(Blocks(*parts))
        pairs.append(_neighbours(left.reshape(-1, width, left.shape[1]), counts.reshape(-1, width), most))
        index = np.flatnonzero(counts)
        if len(index) > most:
            # Multiples of the golden ratio keep to no column of the picture.
            index = index[(np.arange(most) * GOLDEN % 1 * len(index)).astype(int)]
        errors.append(left[index])
        values.append(shown[index])
        largest, carrying = max(largest, float(top)), carrying + float(squares)
    error, value = (np.concatenate(parts).astype(np.float64) for parts in (errors, values))
    return Residual(blocks, _going_together(pairs, noise > 2 * rounding), error, value, largest, carrying)


def neighbours_of(images: Sequence[Float[np.ndarray, "H W C"]]) -> Neighbours:
    """How errors of neighbours in some pictures go together.

    Args:
        images: 0 where a pixel does not count.
    """
    pairs = [_neighbours(image, np.any(image != 0, axis=2), PAIRS) for image in images]
    return _going_together(pairs, np.ones(images[0].shape[2], bool))


def structure_warning(known: Neighbours) -> tuple[str, ...]:
    """What to say where neighbours err alike; nothing where they do not.

    Args:
        known: of the residual.
    """
    words = f"the residual has structure: neighbouring pixels err alike (correlation {known.correlation:.2f})"
    words = f"{words}, so model or scene are not the whole truth and the errors are too small"
    return (words,) if known.significant else ()


def _going_together(pairs: Sequence[np.ndarray], channels: Bool[np.ndarray, " C"]) -> Neighbours:
    cross, one, other, count = np.sum(pairs, axis=0) @ channels
    correlation = float(cross / max(np.sqrt(one * other), np.finfo(float).tiny))
    least = max(CORRELATED, DEVIATIONS / max(count / max(np.count_nonzero(channels), 1), 1.0) ** 0.5)
    return Neighbours(correlation, correlation > least)


def _neighbours(
    image: Float[np.ndarray, "H W C"], counts: Bool[np.ndarray, "H W"], most: int
) -> Float[np.ndarray, "4 C"]:
    """Of pairs side by side and one above the other in some rows: products, squares of both, how many pairs."""
    height, width, channels = image.shape
    lit = np.flatnonzero(counts.any(axis=1))
    count = min(len(lit), max(FEWEST_ROWS, most // (2 * width)))
    rows = lit[np.linspace(0, max(len(lit) - 2, 0), count).astype(int)]
    some, found = image[rows], np.zeros((4, channels))
    for one, other in ((some[:, :-1], some[:, 1:]), (some, image[np.minimum(rows + 1, height - 1)])):
        if height == 1 and one is some:
            continue
        both = (one != 0) & (other != 0)
        one, other = one * both, other * both
        products = (np.einsum("hwc,hwc->c", *pair) for pair in ((one, other), (one, one), (other, other)))
        found += [*products, np.count_nonzero(both, axis=(0, 1))]
    return found


def _survey(picture: Picture, n: AnyArray, x: AnyArray, noise: AnyArray, width: int) -> tuple[Any, ...]:
    """Errors, where they count, what is shown, sums over blocks, the lobe's largest value, its squares over that."""
    xp: Any = np if isinstance(picture.diffuse, np.ndarray) else jnp
    shown, lobe = picture.shown_and_lobe(n, x)
    weights = picture.weights
    left = xp.where(weights > 0, picture.target - shown, 0) * xp.sqrt(weights) / xp.asarray(noise, shown.dtype)
    if xp is jnp:
        left, shown, lobe = jax.lax.optimization_barrier((left, shown, lobe))
    image = left.reshape(-1, width, left.shape[1])
    terms = image, image * image, (image != 0).astype(image.dtype)
    blocks = tuple(coarser(part, SIZES[0]) for part in terms) if xp is np else _over_blocks(terms)
    value = xp.max(xp.where(xp.any(weights > 0, axis=1, keepdims=True), lobe, 0), axis=1)
    largest = xp.max(value, initial=0)
    # Squares of a highlight that no pixel sees would fall below the smallest number.
    return (
        left,
        xp.any(left != 0, axis=1),
        shown,
        blocks,
        largest,
        xp.sum((value / xp.where(largest > 0, largest, 1)) ** 2),
    )


_survey_many = jax.jit(_survey, static_argnames="width", compiler_options=COMPILER_OPTIONS)


def _over_blocks(images: tuple[Array, ...]) -> tuple[Array, ...]:
    """One loop for all sums, as in `fitting.solver.normal_equations`."""
    size, (height, width, channels) = SIZES[0], images[0].shape
    shape = -(-height // size), size, -(-width // size), size, channels
    pad = [(0, -height % size), (0, -width % size), (0, 0)]
    terms = tuple(jnp.pad(image, pad).reshape(shape) for image in images)
    zeros = (np.zeros((), terms[0].dtype),) * len(terms)
    return jax.lax.reduce(terms, zeros, lambda one, other: tuple(map(operator.add, one, other)), (1, 3))
