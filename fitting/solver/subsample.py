"""A stratified subsample of the pixels: a few thousand that see every exponent, and the profile that they show.

A lobe of exponent n lights the pixels with ``-log_cos`` below about 1 / n: at n = 1e5 a handful around the peak, while
an n below 1 is told from another by the few that are nearly at 90 degrees from it. So each octave of ``-log_cos`` is a
stratum; sparse ones are kept whole, the others sample to about equal numbers. Weights are the inverse probabilities.

So few pixels are dealt with on the host, in float64: nothing is compiled for them.
"""

import functools
import math
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple, cast

import jax
import numpy as np
from jaxtyping import Float

from fitting.solver.normal_equations import Picture, Sums

# How many pixels of all pictures together are taken, and how many of each picture at least.
SAMPLE_SIZE = 2048
SMALLEST_SAMPLE = 256

# The strata are counted on every 16th pixel.
_PREVIEW_STRIDE = 16

# A pixel that does not count is in no stratum.
_EXCLUDED = 255

# No more terms than this, pixels times light samples, of one picture.
_TERMS = 1 << 20

# Lobes are evaluated at so many values at a time.
_VALUES = 1 << 18


# Single precision holds it.
_HUGE = 1e38


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

    def lobes(self, log_n: Float[np.ndarray, " N"], peak: float) -> list["Lobes"]:
        """Of each picture the lobe at some exponents; ``peak`` as in :class:`brdf.lobes.Lobe`."""
        return [_lobes(part, log_n, peak) for part in self.parts]

    def sums(self, lobes: Sequence["Lobes"]) -> Sums:
        """What `fitting.solver.normal_equations.sums` gives for all pixels, the reference being 0."""
        totals = map(_sums, self.parts, lobes)
        return Sums(*(np.sum(leaf, axis=0) for leaf in zip(*totals, strict=True)))

    def spread(self, lobes: Sequence["Lobes"], few: np.ndarray, x: Float[np.ndarray, "N C 3"], best: int) -> np.ndarray:
        """How far the subsample's profile may be from that of all pixels, at a few of the exponents.

        Horvitz-Thompson variances of the cost at each minus that at the best; x are the best coefficients.
        """
        total = np.zeros(few.size)
        for part, factor, lobe in zip(self.parts, self.factor, lobes, strict=True):
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
            value = lobe.value[np.ix_(few, np.arange(len(lobe.value[0])), unsure)].astype(np.float32)
            if len(weight) > 1:
                # Of a lobe that a channel hardly shows, where it counts, the coefficient may be huge.
                value = value * (weight > 0)
            x_a, x_d, x_s = np.minimum(x / scale, _HUGE).astype(np.float32).transpose(2, 0, 1)[..., None]
            still = x_a * np.asarray(part.ambient, np.float32)[:, None] + x_d * diffuse
            residual = target - still - x_s * value
            rise = (residual - residual[best]) * (residual + residual[best]) * weight
            total += scale**4 * np.sum(rise, axis=1, dtype=np.float64) ** 2 @ chance
        return total


class Lobes(NamedTuple):
    """The lobe of some pixels at some exponents, and its derivative by log n."""

    value: Float[np.ndarray, "N Cb M"]
    slope: Float[np.ndarray, "N Cb M"]


def _lobes(part: Picture, log_n: np.ndarray, peak: float) -> Lobes:
    lobe = part.lobe
    if lobe is None:
        return Lobes(*2 * [np.zeros((log_n.size, *part.diffuse.T.shape))])
    values = sum(leaf.size for leaf in jax.tree.leaves((lobe.kept, lobe.fine)))
    step, found = max(1, _VALUES // max(values, 1)), []
    for n in np.split(np.exp(log_n), range(step, log_n.size, step)):
        n = n[:, None, None]
        value, slope = map(np.asarray, lobe(cast(Any, n), peak))
        found.append((value.swapaxes(1, 2), (slope * n).swapaxes(1, 2)))
    return Lobes(*map(np.concatenate, zip(*found, strict=True)))


def _sums(part: Picture, lobes: Lobes) -> Sums:
    weight = part.weights.T.astype(np.float64)
    target = np.where(weight > 0, part.target.T, 0.0).astype(np.float64)
    diffuse = part.diffuse.T.astype(np.float64)
    channels, exponents, shared = len(target), len(lobes.value), len(diffuse) == len(weight) == 1
    gram, product = np.zeros((exponents, channels, 4, 4)), np.zeros((exponents, channels, 4))
    for group in range(1 if shared else channels):
        own = slice(None) if shared else slice(group, group + 1)
        heavy, lit, ambient = (one[min(group, len(one) - 1)] for one in (weight, diffuse, part.ambient))
        # Half of the weight on each side of a product: no array of all exponents is made for it.
        root = np.sqrt(heavy)
        moving = [one[:, min(group, one.shape[1] - 1)] * root for one in lobes]
        fixed = root * np.stack([np.full_like(lit, ambient), lit, *target[own]])
        gram[:, own, :2, :2], product[:, own, :2] = fixed[:2] @ fixed[:2].T, fixed[2:] @ fixed[:2].T
        for row, moved in enumerate(moving, 2):
            # A few at a time: for more BLAS takes several threads, which wait for each other on a busy machine.
            across = np.concatenate([some @ fixed.T for some in np.array_split(moved, -(-exponents // 8))])
            gram[:, own, row, :2] = gram[:, own, :2, row] = across[:, None, :2]
            product[:, own, row] = across[:, 2:]
            for column in range(2, row + 1):
                both = np.einsum("nm,nm->n", moved, moving[column - 2])
                gram[:, own, row, column] = gram[:, own, column, row] = both[:, None]
    pixels, square = np.count_nonzero(weight, axis=1), np.sum(weight * target**2, axis=1)
    return Sums(gram, product, *(np.broadcast_to(one, (exponents, channels)) for one in (square, pixels)))


def subsample(pictures: Sequence[Picture]) -> Subsample:
    """Take some pixels of each picture; all of a small one, and where there is no lobe."""
    size = max(SMALLEST_SAMPLE, SAMPLE_SIZE // len(pictures))
    parts, factors, nearest = [], [], math.inf
    for picture in pictures:
        counts, factor = picture.counts, None
        nearest = min(nearest, -picture.nearest_peak)
        wanted = size if picture.lobe is None else max(SMALLEST_SAMPLE, min(size, _TERMS // picture.lobe.samples))
        if picture.lobe is not None and np.count_nonzero(counts) > wanted + wanted // 4:
            index, factor = stratified(np.asarray(picture.lobe.peak), counts, wanted)
        else:
            index = np.flatnonzero(counts)
        part = picture.on_host(index)
        weight = part.weights if factor is None else part.weights * factor[:, None]
        parts.append(replace(part, weight=weight))
        factors.append(factor)
    return Subsample(parts, factors, nearest)


@functools.lru_cache(maxsize=2)
def _spread(count: int) -> np.ndarray:
    """Multiples of the golden ratio modulo 1, in units of 2^-32: they spread evenly over any run of pixels."""
    return np.arange(count, dtype=np.uint32) * np.uint32(2654435769)


def stratified(log_cos: np.ndarray, counts: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray]:
    """About so many of the pixels that count, and how many each stands for.

    The size of ``log_cos`` is the distance from the peak.
    """
    # The octave of a number is its binary exponent, 0 at the peak itself.
    octave = ((log_cos.astype(np.float32, copy=False).view(np.int32) >> 23) & 0xFF).astype(np.uint8)
    octave |= (~counts).view(np.uint8) * np.uint8(_EXCLUDED)
    preview = octave[::_PREVIEW_STRIDE]
    count = np.bincount(preview, minlength=256) * (octave.size / preview.size)
    count[_EXCLUDED] = 0
    # The largest number per octave that fits: the sparse ones leave their part to the others.
    ordered = np.sort(count[count > 0])
    most = (size - np.cumsum(ordered) + ordered) / np.arange(ordered.size, 0, -1)
    share = np.minimum(1.0, np.max(most, initial=0.0) / np.maximum(count, 1.0))
    share[_EXCLUDED] = 0.0
    index = np.flatnonzero(_spread(octave.size) < (share * 0xFFFFFFFF).astype(np.uint32).take(octave))
    return index, 1 / share[octave[index]]
