"""A stratified subsample of the pixels: a few thousand that see every exponent, and the profile that they show.

A lobe of exponent n lights the pixels with ``-log_cos`` below about 1 / n: at n = 1e5 a handful around the peak, while
an n below 1 is told from another by the few that are nearly at 90 degrees from it. So each octave of ``-log_cos`` is a
stratum; sparse ones are kept whole, the others sample to about equal numbers. Weights are the inverse probabilities.

So few pixels are dealt with on the host, in float64: nothing is compiled for them.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple, cast

import jax
import numpy as np
from jaxtyping import Float

from fitting.solver.normal_equations import Picture, Sums

# How many pixels of all pictures together are taken, and how many of each picture at least.
SAMPLE_SIZE = 4096
SMALLEST_SAMPLE = 256

# The strata are counted on every 16th pixel.
_PREVIEW_STRIDE = 16

# A pixel that does not count is in no stratum.
_EXCLUDED = 255

# No more terms than this, pixels times light samples, of one picture.
_TERMS = 1 << 20

# Lobes are evaluated at so many values at a time, which stay in the second-level cache.
_VALUES = 1 << 16


class Subsample(NamedTuple):
    """Some pixels of all pictures, and what they see.

    Attributes:
        parts: of each picture some pixels, in NumPy; weights times ``factor``.
        factor: of each picture, how many pixels each stands for, at least 1; None where every pixel was kept.
        nearest: the smallest ``-log_cos`` of all pixels that count; infinite without a lobe.
    """

    parts: list[Picture]
    factor: list[Float[np.ndarray, " M"] | None]
    nearest: float

    @property
    def whole(self) -> bool:
        """Every pixel that counts was kept."""
        return all(factor is None for factor in self.factor)

    def sums(self, log_n: Float[np.ndarray, " N"], peak: float) -> Sums:
        """What `fitting.solver.normal_equations.sums` gives for all pixels, the reference being 0."""
        totals: list[Sums] = []
        for part in self.parts:
            weight = part.weights.astype(np.float64)
            target = np.where(weight > 0, part.target, 0.0).astype(np.float64)
            diffuse = part.diffuse.astype(np.float64)
            groups = 1 if diffuse.shape[1] == weight.shape[1] == 1 else target.shape[1]
            gram = np.zeros((log_n.size, groups, 4, 4))
            product = np.zeros((log_n.size, target.shape[1], 4))
            for index, value, slope in _lobes(part, log_n, peak):
                for group in range(groups):
                    own = slice(None) if groups == 1 else slice(group, group + 1)
                    heavy = weight[:, min(group, weight.shape[1] - 1)]
                    ambient, lit, *moving = (
                        one[..., min(group, one.shape[-1] - 1)] for one in (part.ambient, diffuse, value, slope)
                    )
                    still = np.stack(np.broadcast_arrays(ambient, lit))
                    fixed = heavy * np.concatenate([still, target[:, own].T])
                    gram[index, group, :2, :2], product[index, own, :2] = fixed[:2] @ still.T, fixed[2:] @ still.T
                    for row, moved in enumerate(moving, 2):
                        by_fixed = moved @ fixed.T
                        gram[index, group, row, :2] = gram[index, group, :2, row] = by_fixed[:, :2]
                        product[index, own, row] = by_fixed[:, 2:]
                        for column, other in enumerate(moving[: row - 1], 2):
                            both = np.einsum("nm,nm,m->n", moved, other, heavy)
                            gram[index, group, row, column] = gram[index, group, column, row] = both
            pixels = np.broadcast_to(np.count_nonzero(weight, axis=0), target.shape[1])
            square = np.sum(weight * target**2, axis=0)
            whole = np.broadcast_to(gram, (*product.shape, 4))
            totals.append(Sums(whole, product, *np.broadcast_arrays(square, pixels, product[..., 0])[:2]))
        return Sums(*(np.sum(leaf, axis=0) for leaf in zip(*totals, strict=True)))

    def spread(
        self, log_n: Float[np.ndarray, " N"], x: Float[np.ndarray, "N C 3"], best: int, peak: float
    ) -> np.ndarray:
        """How far the subsample's profile may be from that of all pixels.

        Args:
            log_n: Natural logarithms of some exponents.
            x: Best coefficients at each.
            best: Which to compare with.
            peak: See :class:`brdf.lobes.Lobe`.

        Returns:
            Horvitz-Thompson variances of the cost at each exponent minus that at the best.
        """
        total = np.zeros(log_n.size)
        for part, factor in zip(self.parts, self.factor, strict=True):
            if factor is None:
                continue
            # A pixel that was certain to be kept adds nothing to the uncertainty.
            unsure = np.flatnonzero(factor > 1)
            part = part.pixels(partial(np.take, indices=unsure, axis=0))
            chance = (1 - 1 / factor[unsure]).astype(np.float32)
            # Fourth powers stay in the range of single precision; NumPy is slow where the last axis is short.
            target = np.where(part.weights > 0, part.target, 0.0)
            scale = float(np.max(np.abs(target), initial=0.0)) or 1.0
            target, weight, diffuse = (a.T.astype(np.float32) for a in (target / scale, part.weights, part.diffuse))
            value = np.concatenate([value for _, value, _ in _lobes(part, log_n, peak)])
            x_a, x_d, x_s = (x / scale).astype(np.float32).transpose(2, 0, 1)[..., None]
            still = x_a * np.asarray(part.ambient, np.float32)[:, None] + x_d * diffuse
            residual = target - still - x_s * value.astype(np.float32).swapaxes(1, 2)
            rise = (residual - residual[best]) * (residual + residual[best]) * weight
            total += scale**4 * np.sum(rise, axis=1, dtype=np.float64) ** 2 @ chance
        return total


def _lobes(part: Picture, log_n: np.ndarray, peak: float) -> Iterator[tuple[slice, np.ndarray, np.ndarray]]:
    """Values and derivatives by log n of the lobe, (N, M, Cb), some exponents at a time."""
    lobe = part.lobe
    if lobe is None:
        nothing = np.zeros((log_n.size, *part.diffuse.shape))
        yield slice(None), nothing, nothing
        return
    values = sum(leaf.size for leaf in jax.tree.leaves((lobe.kept, lobe.fine)))
    step = max(1, _VALUES // max(values, 1))
    for first in range(0, log_n.size, step):
        index = slice(first, first + step)
        n = np.exp(log_n[index])[:, None, None]
        value, slope = map(np.asarray, lobe(cast(Any, n), peak))
        yield index, value, slope * n


def subsample(pictures: Sequence[Picture]) -> Subsample:
    """Take some pixels of each picture.

    Args:
        pictures: all that are searched.

    Returns:
        The pixels kept: all of a small picture, and where there is no lobe.
    """
    size = max(SMALLEST_SAMPLE, SAMPLE_SIZE // len(pictures))
    parts, factors, nearest = [], [], math.inf
    for picture in pictures:
        counts, factor = picture.counts, None
        nearest = min(nearest, -picture.nearest_peak)
        wanted = size if picture.lobe is None else max(SMALLEST_SAMPLE, min(size, _TERMS // picture.lobe.samples))
        if picture.lobe is not None and np.count_nonzero(counts) > wanted + wanted // 4:
            index, factor = stratified(-np.asarray(picture.lobe.peak), counts, wanted)
        else:
            index = np.flatnonzero(counts)
        part = picture.on_host(index)
        weight = part.weights if factor is None else part.weights * factor[:, None]
        parts.append(replace(part, weight=weight))
        factors.append(factor)
    return Subsample(parts, factors, nearest)


def stratified(distance: np.ndarray, counts: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Some pixels, and how many each stands for.

    Args:
        distance: ``-log_cos`` of each pixel.
        counts: which may be taken.
        size: about how many.
    """
    # The octave of a number is its binary exponent, 0 at the peak itself.
    octave = ((distance.astype(np.float32).view(np.int32) >> 23) & 0xFF).astype(np.uint8)
    octave[~counts] = _EXCLUDED
    preview = octave[::_PREVIEW_STRIDE]
    count = np.bincount(preview, minlength=256) * (octave.size / preview.size)
    count[_EXCLUDED] = 0
    # The largest number per octave that fits: the sparse ones leave their part to the others.
    ordered = np.sort(count[count > 0])
    most = (size - np.cumsum(ordered) + ordered) / np.arange(ordered.size, 0, -1)
    share = np.minimum(1.0, np.max(most, initial=0.0) / np.maximum(count, 1.0))
    share[_EXCLUDED] = 0.0
    # Multiples of the golden ratio modulo 1 spread evenly over any run of pixels, without a regular pattern.
    step = np.arange(octave.size, dtype=np.uint32) * np.uint32(2654435769)
    index = np.flatnonzero(step < (share * 0xFFFFFFFF).astype(np.uint32)[octave])
    return index, 1 / share[octave[index]]
