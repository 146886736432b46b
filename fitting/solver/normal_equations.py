"""What the fit needs of the pixels: Gram matrices of a few basis images, summed in one pass.

The image is linear in ``k_a``, ``k_d``, ``k_s``, so a least-squares fit sees the pixels only through the products of
the basis images with each other and with the target. This module computes those, for a :class:`Picture`, and nothing
else.

How a pass is made. XLA emits one loop per reduction, so some thirty separate sums would evaluate the lobe thirty times
or store it; one variadic ``lax.reduce`` over all products evaluates it once and keeps every sum in a register. Its loop
is vectorised only when the compiler may reorder the additions, which ``xla_cpu_enable_fast_math`` allows; the ``honor``
flags keep NaN, infinity and division as IEEE has them. ``python -m benchmarks.engine`` prints what a pass costs.

Precision. Products are formed in the pixels' own dtype and summed within a block; blocks are added in float64. The
target enters as the residual against a reference model, and the reference is put back in float64, hence the rounding of
a float32 pass scales with the residual and not with the picture. Likewise each column enters less its mean over a few
pixels, which is put back in float64: a surface that is lit alike all over, whose diffuse column is a multiple of the
ambient one, would else seem to differ from it by the rounding of the sums.
"""

import functools
import operator
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, NamedTuple, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from brdf.lobes import Lobe
from brdf.precision import at_a_time, on_accelerator
from fitting.likelihood import AnyArray, Bounds, over_channels
from fitting.solver.devices import device_count, gathered, own, placed


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class Picture:
    """One picture, or one tile of one: ``target ~ x_a * ambient + x_d * diffuse + x_s * lobe(n)``.

    Attributes:
        target: Linear radiance; its dtype is the dtype of the pass.
        diffuse: Diffuse basis image; ``Cb`` is 1 where it is the same for all channels, else ``C``.
        lobe: Specular basis image as a function of the exponent, ``None`` for a model without one.
        weight: Weight of each squared residual, at least 0; a target of weight 0 may be anything, NaN too. ``None``
            weighs every pixel 1 and costs nothing.
        ambient: What multiplies ``x_a``, the same for all pixels; 0 in a picture without ambient light.
        bounds: Between which codes each value lay before rounding; ``None`` for values that no rounding touched.
    """

    target: Float[Array, "P C"]
    diffuse: Float[Array, "P Cb"]
    lobe: Lobe | None = None
    weight: Float[Array, " P"] | Float[Array, "P C"] | None = None
    ambient: Float[AnyArray, " Ca"] = field(default_factory=lambda: np.ones(1))
    bounds: Bounds | None = None

    def pixels(self, choose: Callable[[Any], Any]) -> "Picture":
        """The same picture, some of its pixels."""
        target, diffuse, weight = jax.tree.map(choose, (self.target, self.diffuse, self.weight))
        lobe = None if self.lobe is None else self.lobe.pixels(choose)
        bounds = None if self.bounds is None else self.bounds.pixels(choose)
        return Picture(target, diffuse, lobe, weight, self.ambient, bounds)

    def on_host(self, pixel: Int[np.ndarray, " K"]) -> "Picture":
        """The same picture, some of its pixels, in NumPy: an XLA gather is ten times slower."""
        lobe = None if self.lobe is None else self.lobe.on_host(pixel)
        here = jax.tree.map(np.asarray, replace(self, lobe=None))
        return replace(here.pixels(partial(np.take, indices=pixel, axis=0)), lobe=lobe)

    def in_double(self, pixel: Int[np.ndarray, " K"]) -> "Picture":
        """The same picture, some of its pixels, in NumPy and double precision.

        Where the lobe is made anew at each evaluation some of them are repeated, with bounds that say nothing: programs
        are compiled for a few numbers of pixels only.
        """
        lobe, filled = self.lobe, 0
        if lobe is not None and self.is_sampled:
            filled = -pixel.size % (_FEW if pixel.size <= _FEW else 8 * _FEW)
            pixel = np.append(pixel, np.zeros(filled, pixel.dtype))
            lobe = jax.tree.map(np.asarray, lobe).pixels(partial(np.take, indices=pixel, axis=0))
        elif lobe is not None:
            lobe = lobe.on_host(pixel)
        here = jax.tree.map(np.asarray, replace(self, lobe=None))
        some = replace(here.pixels(partial(np.take, indices=pixel, axis=0)), lobe=lobe)
        some = jax.tree.map(lambda a: np.asarray(a, np.float64) if eqx.is_inexact_array_like(a) else a, some)
        if filled and some.bounds is not None:
            some.bounds.lower[-filled:], some.bounds.upper[-filled:] = -np.inf, np.inf
        return some

    def columns(self, n: float) -> Float[np.ndarray, "4 P C"]:
        """What x_a, x_d, x_s multiply, and the derivative of the last by n, on the host."""
        found = np.zeros((4, *self.target.shape), np.float64)
        found[0], found[1] = self.ambient, self.diffuse
        if self.lobe is not None:
            found[2], found[3] = self.lobe(cast(Any, n)) if self._all_on_host else _lobe(self.lobe, np.asarray(n))
        return found

    @property
    def is_sampled(self) -> bool:
        """Whether the lobe is made anew from its light samples at each evaluation."""
        return self.lobe is not None and self.lobe.source is not None

    @property
    def _all_on_host(self) -> bool:
        return isinstance(self.diffuse, np.ndarray) and not self.is_sampled

    def predicted(self, n: Any, x: Float[AnyArray, "3 C"]) -> Float[AnyArray, "P C"]:
        """What the model shows, in the dtype of the target, as a part of a program or by NumPy."""
        xp: Any = np if isinstance(self.diffuse, np.ndarray) else jnp
        x_a, x_d, x_s = xp.asarray(x, self.target.dtype)
        radiance = x_a * xp.asarray(self.ambient, self.target.dtype) + x_d * self.diffuse
        if self.lobe is not None:
            radiance += x_s * self.lobe(n)[0]
        return xp.broadcast_to(radiance, self.target.shape)

    def predict(self, n: float, x: Float[np.ndarray, "3 C"]) -> Float[np.ndarray, "P C"]:
        """What the model shows, on the host; by NumPy where that takes less time than to trace and load a program."""
        picture = self
        if self.target.size <= FEW_VALUES and device_count() == 1 and not self.is_sampled:
            picture = jax.tree.map(np.asarray, self)
        return np.asarray((Picture.predicted if picture._all_on_host else _predicted)(picture, np.asarray(n), x))

    @property
    def counts(self) -> Bool[np.ndarray, " P"]:
        """Which pixels have a weight above 0, on the host."""
        if self.weight is None:
            return np.ones(self.target.shape[0], bool)
        above = np.asarray(self.weight) > 0
        return above if above.ndim == 1 else over_channels(np.logical_or, above)

    @functools.cached_property
    def nearest_peak(self) -> float:
        """The largest logarithm of the lobe's cosine of any pixel that counts; minus infinity without a lobe."""
        if self.lobe is None:
            return -np.inf
        peak = np.asarray(self.lobe.peak)
        # Mostly the nearest pixel counts; a rounded picture may have none that says something.
        if self.weight is not None and peak.size and not np.all(np.asarray(self.weight)[np.argmax(peak)] > 0):
            peak = np.where(self.counts, peak, -np.inf)
        return float(np.max(peak, initial=-np.inf))

    @property
    def weights(self) -> Float[AnyArray, "P Cw"]:
        """Of each pixel, or of all of them where they weigh the same; Cw is 1 or C."""
        if self.weight is None:
            return np.ones((1, 1), self.target.dtype)
        return self.weight if self.weight.ndim == 2 else self.weight[:, None]


_predicted = eqx.filter_jit(Picture.predicted)


@eqx.filter_jit
def _lobe(lobe: Lobe, n: AnyArray) -> tuple[Array, Array]:
    return lobe(jnp.asarray(n))


# Of a lobe that is made anew at each evaluation this many pixels, or multiples of eight times as many.
_FEW = 2048

# A NumPy evaluation of so many values takes less time than tracing and loading a program for them.
FEW_VALUES = 1 << 19

# 32768 pixels of the six or seven arrays a pass reads stay in the second-level cache.
BLOCK = 32768

# Means of the columns are taken of about this many pixels of each block.
_MEAN_PIXELS = 64

# One program serves up to so many exponents.
_MOST_EXPONENTS = 64

# Beyond this many channels of one grey basis a matrix product is as fast and compiles in a fraction of the time.
UNROLLED_CHANNELS = 4

COMPILER_OPTIONS: Any = {
    "xla_cpu_enable_fast_math": True,
    "xla_cpu_fast_math_honor_nans": True,
    "xla_cpu_fast_math_honor_infs": True,
    "xla_cpu_fast_math_honor_division": True,
    "xla_cpu_fast_math_honor_functions": True,
}


class Sums(NamedTuple):
    """Sums over pixels, float64: all that a least-squares fit needs of pictures.

    The columns are stated by :func:`sums`.

    Attributes:
        gram: Weighted products of the columns.
        product: Weighted products of the columns with the residual against the reference model.
        square: Weighted squares of that residual.
        pixels: How many pixels have a weight above 0.
    """

    gram: Float[np.ndarray, "*K C R R"]
    product: Float[np.ndarray, "*K C R"]
    square: Float[np.ndarray, "*K C"]
    pixels: Float[np.ndarray, "*K C"]

    def about(self, reference: np.ndarray) -> "Sums":
        """The same sums with the residual against the reference model replaced by the target, or by another residual.

        The reference is what to add to the residual, as coefficients of the first columns, (..., C, 3) or more.
        """
        first = slice(reference.shape[-1])
        moved = (self.gram[..., first] @ reference[..., None])[..., 0]
        square = self.square + np.sum(reference * (2 * self.product + moved)[..., first], axis=-1)
        return self._replace(product=self.product + moved, square=square)

    def columns(self, basis: np.ndarray) -> "Sums":
        """Sums of other columns, each row of a basis saying what one is made of."""
        product = (basis @ self.product[..., None])[..., 0]
        return self._replace(gram=basis @ self.gram @ basis.swapaxes(-1, -2), product=product)


def totals(terms: Sequence[Any], combine: Sequence[str], axes: tuple[int, ...]) -> list[Any]:
    """The total of each array of one shape over some axes, by "add" or "maximum"; under JAX in one loop.

    Axes are reduced the last ones first where it matters, as in NumPy.
    """
    if isinstance(terms[0], np.ndarray):
        # One axis after the other: sums over the first are as long as the others.
        found = list(terms)
        for place, axis in enumerate(axes):
            found = [getattr(np, how).reduce(one, axis - place) for how, one in zip(combine, found, strict=True)]
        return found
    if on_accelerator() and len(terms) > 1:
        # What many sums share of a GPU is more than it has; it takes together what it can.
        return [totals([one], [how], axes)[0] for one, how in zip(terms, combine, strict=True)]
    start = tuple(
        np.full((), 0 if how == "add" else -np.inf, one.dtype) for how, one in zip(combine, terms, strict=True)
    )
    combined, call = [getattr(jnp, how) for how in combine], cast(Any, operator.call)

    def both(one: tuple[Array, ...], other: tuple[Array, ...]) -> tuple[Array, ...]:
        return tuple(map(call, combined, one, other))

    return list(jax.lax.reduce(tuple(terms), start, both, axes))


def _summed(columns: int, residuals: int) -> list[tuple[int, int]]:
    """Which products of the columns and of the residuals after them are summed: of two residuals none."""
    size = columns + residuals
    return [(i, j) for i in range(size) for j in range(i, size) if i < columns or i == j]


@partial(jax.jit, compiler_options=COMPILER_OPTIONS)
def _pass(picture: Picture, log_n: Array, count: Array, reference: Array, peak: Array) -> tuple[Array, Array]:
    """For the first exponents the sums of each block of pixels, and what was taken off its columns.

    (exponents, blocks, groups, products), the last product counting the pixels; a group is all the channels where they
    share basis and weight, else one of them. And (exponents, blocks, 3, groups).
    """
    pixels, channels = picture.target.shape
    dtype, blocks = picture.target.dtype, max(1, -(-pixels // at_a_time(BLOCK)))
    size = -(-pixels // blocks)
    shared = picture.diffuse.shape[1] == picture.weights.shape[1] == 1 and channels <= UNROLLED_CHANNELS
    groups = 1 if shared else channels
    ambient, *scales = reference.at[0].multiply(picture.ambient).astype(dtype).reshape(3, groups, -1, 1)
    stride = max(1, size // _MEAN_PIXELS)

    def add_block(step: Array, state: tuple[Array, Array]) -> tuple[Array, Array]:
        index, block = step // blocks, step % blocks
        # The last block starts early enough to be whole; what it shares with the one before counts once.
        start = jnp.minimum(block * size, pixels - size)
        part = picture.pixels(partial(jax.lax.dynamic_slice_in_dim, start_index=start, slice_size=size))
        # Weights of 1 are constants that the compiler leaves out.
        inside = True if pixels % size == 0 else start + jnp.arange(size) >= block * size
        weight = jnp.broadcast_to(jnp.where(inside, part.weights.T, 0), (groups, size))
        few = part.pixels(operator.itemgetter(slice(None, None, stride)))
        counts = jnp.broadcast_to(weight[:, ::stride] > 0, (groups, few.target.shape[0]))
        columns, means, n = [jnp.ones((groups, size), dtype)], [], jnp.exp(log_n[index])
        pairs = [(part.diffuse, few.diffuse)]
        if part.lobe is None or few.lobe is None:
            pairs += 2 * [(jnp.zeros_like(part.diffuse), jnp.zeros_like(few.diffuse))]
        else:
            (value, slope), (some, change) = part.lobe(n, peak), few.lobe(n, peak)
            pairs += [(value, some), (slope * n.astype(dtype), change * n.astype(dtype))]
        for column, sampled in pairs:
            mean = jnp.sum(jnp.where(counts, sampled.T, 0), axis=1) / jnp.maximum(jnp.sum(counts, axis=1), 1)
            means.append(mean.astype(dtype))
            columns.append(jnp.broadcast_to(column.T.astype(dtype), (groups, size)))
        target = part.target.T.reshape(groups, -1, size)
        parts = [columns[0], *(column - mean[:, None] for column, mean in zip(columns[1:], means, strict=True))]
        for i in range(target.shape[1]):
            model = ambient[:, i] + scales[0][:, i] * columns[1] + scales[1][:, i] * columns[2]
            parts.append(jnp.where(weight > 0, target[:, i] - model, 0))
        weighted = [weight * one for one in parts]
        products = [weighted[i] * parts[j] for i, j in _summed(4, target.shape[1])]
        products.append(jnp.where(weight > 0, columns[0], 0))
        summed = totals(products, ["add"] * len(products), (1,))
        found = jnp.stack(summed, axis=1).astype(jnp.float64), jnp.stack(means)
        return jax.tree.map(lambda all_, one: all_.at[index, block].set(one), state, found)

    kinds = len(_summed(4, channels // groups)) + 1
    start = jnp.zeros((_MOST_EXPONENTS, blocks, groups, kinds)), jnp.zeros((_MOST_EXPONENTS, blocks, 3, groups), dtype)
    return jax.lax.fori_loop(0, count * blocks, add_block, start)


def _unpack(packed: np.ndarray, mean: np.ndarray, ambient: AnyArray, channels: int) -> Sums:
    """Undo the packing, and what was done to the columns; the blocks together."""
    groups = packed.shape[2]
    residuals = channels // groups
    i, j = np.array(_summed(4, residuals)).T
    products = np.zeros((*packed.shape[:3], *(4 + residuals,) * 2))
    products[..., i, j] = products[..., j, i] = packed[..., :-1]
    # The ambient column was summed as 1; the others were summed less their means.
    basis = np.zeros((*packed.shape[:3], 1, 4, 4)) + np.eye(4)
    basis[..., 0, 1:, 0] = mean.swapaxes(2, 3)
    columns = Sums(
        gram=products[..., None, :4, :4],
        product=products[..., 4:, :4],
        square=np.diagonal(products[..., 4:, 4:], axis1=-2, axis2=-1),
        pixels=np.broadcast_to(packed[..., -1:], (*packed.shape[:3], residuals)),
    ).columns(basis)
    whole = np.broadcast_to(columns.gram, (*columns.product.shape, 4))
    totals = [np.sum(leaf, axis=1) for leaf in columns._replace(gram=whole)]
    found = Sums(*(leaf.reshape(len(packed), channels, *leaf.shape[3:]) for leaf in totals))
    lit = np.zeros((channels, 4, 4)) + np.eye(4)
    lit[:, 0, 0] = ambient
    return found.columns(lit)


def sums(
    pictures: Sequence[Picture], log_n: Float[np.ndarray, " N"], reference: Float[np.ndarray, "C 3"], peak: float = 0.0
) -> Sums:
    """One pass over the pixels of one or many pictures, or tiles, each let go before the next is asked for.

    Under a mesh each process makes those of its own devices (`fitting.solver.devices`). The columns are ambient,
    diffuse, lobe, and the derivative of that by log n; the last two are 0 without a lobe. Gives the sums at each
    exponent, residuals being those of a model with the reference's coefficients and the exponent's lobe. For the lobe,
    its derivative and the reference ``S exp(-n peak)`` is taken; see :class:`brdf.lobes.Lobe`.
    """
    totals: list[Sums] = []
    for first in range(0, len(log_n), _MOST_EXPONENTS):
        some = log_n[first : first + _MOST_EXPONENTS]
        padded = np.resize(some, _MOST_EXPONENTS)
        passed = {}
        for index in own(len(pictures)):
            picture = placed(index, pictures[index])
            found = _pass(picture, padded, np.int32(some.size), reference.T, np.float64(peak))
            # Under a mesh the next device begins before this one is done.
            passed[index] = jax.block_until_ready(found) if device_count() == 1 else found, picture.ambient
        parts = {}
        shape = some.size, len(reference)
        for index, (found, ambient) in passed.items():
            packed, mean = (np.asarray(leaf)[: some.size].astype(np.float64) for leaf in found)
            part = _unpack(packed, mean, ambient, len(reference))
            parts[index] = np.concatenate([leaf.reshape(*shape, -1) for leaf in part], axis=2)
        table = np.sum(gathered(parts, len(pictures), (*shape, 22)), axis=0)
        gram, product = table[..., :16].reshape(*shape, 4, 4), table[..., 16:20]
        totals.append(Sums(gram, product, table[..., 20], table[..., 21]))
    return Sums(*map(np.concatenate, zip(*totals, strict=True)))
