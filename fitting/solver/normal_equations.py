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

from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import NamedTuple, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from brdf.lobes import Lobe

# Natural logarithms of what is still well inside float32 and float64, times an exponent of 1e7 too: a compiler that may
# reorder products multiplies the two first, and infinity times the 0 of a dark pixel is no number.
_LARGEST_DECAY_SINGLE = 60.0
_LARGEST_DECAY_DOUBLE = 600.0

# On the host or on the device.
AnyArray: TypeAlias = jax.Array | np.ndarray


class Picture(eqx.Module):
    """One picture, or one tile of one: ``target ~ x_a * ambient + x_d * diffuse + x_s * lobe(n)``.

    Attributes:
        target: Linear radiance; its dtype is the dtype of the pass.
        diffuse: Diffuse basis image; ``Cb`` is 1 where it is the same for all channels, else ``C``.
        lobe: Specular basis image as a function of the exponent, ``None`` for a model without one.
        weight: Weight of each squared residual, at least 0; a target of weight 0 may be anything, NaN too. ``None``
            weighs every pixel 1 and costs nothing.
        ambient: What multiplies ``x_a``, the same for all pixels; 0 in a picture without ambient light.
    """

    target: Float[Array, "P C"]
    diffuse: Float[Array, "P Cb"]
    lobe: Lobe | None = None
    weight: Float[Array, " P"] | Float[Array, "P C"] | None = None
    ambient: Float[AnyArray, " Ca"] = eqx.field(default_factory=lambda: np.ones(1))

    def pixels(self, choose: Callable[[Array], Array]) -> "Picture":
        """The same picture, some of its pixels."""
        return Picture(
            target=choose(self.target),
            diffuse=choose(self.diffuse),
            lobe=None if self.lobe is None else self.lobe.pixels(choose),
            weight=None if self.weight is None else choose(self.weight),
            ambient=self.ambient,
        )

    @eqx.filter_jit
    def predicted(self, n: AnyArray, x: Float[AnyArray, "3 C"]) -> Float[Array, "P C"]:
        """What the model shows, in the dtype of the target."""
        dtype = self.target.dtype
        x = jnp.asarray(x).astype(dtype)
        model = x[0] * jnp.asarray(self.ambient).astype(dtype) + x[1] * self.diffuse
        if self.lobe is not None:
            model = model + x[2] * self.lobe(jnp.asarray(n))[0]
        return jnp.broadcast_to(model, self.target.shape)

    @property
    def weights(self) -> Float[AnyArray, "P Cw"]:
        """Of each pixel, or of all of them where they weigh the same; Cw is 1 or C."""
        if self.weight is None:
            return np.ones((1, 1), self.target.dtype)
        return self.weight if self.weight.ndim == 2 else self.weight[:, None]


def relative_lobe(lobe: Lobe, log_n: Array, peak: Array, dtype: np.dtype) -> tuple[Array, Array]:
    """The lobe relative to its largest value, ``S exp(-n peak)``, and the derivative of that by log n.

    Where no pixel sees the highlight's centre a lobe itself falls by many powers of ten within a step of log n, but its
    shape does not change faster than elsewhere. Past the range of the dtype it counts as dark.
    """
    n = jnp.exp(log_n)
    value, slope = lobe(n)
    decay = n * peak
    limit = _LARGEST_DECAY_SINGLE if dtype == np.float32 else _LARGEST_DECAY_DOUBLE
    scale = jnp.where(-decay < limit, jnp.exp(-decay), 0.0).astype(dtype)
    value = value.astype(dtype)
    slope = slope.astype(dtype) * n.astype(dtype) - value * decay.astype(dtype)
    return value * scale, slope * scale


# 32768 pixels of the six or seven arrays a pass reads stay in the second-level cache.
BLOCK = 32768

# Means of the columns are taken of about this many pixels.
_MEAN_PIXELS = 64

# Beyond this many channels of one grey basis a matrix product is as fast and compiles in a fraction of the time.
UNROLLED_CHANNELS = 4

COMPILER_OPTIONS: dict[str, bool | int | float | str] = {
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

    def about(self, reference: Float[np.ndarray, "C R"]) -> "Sums":
        """The same sums with the residual against the reference model replaced by the target, or by another residual.

        Args:
            reference: What to add to the residual, as coefficients of the columns.
        """
        moved = np.einsum("...ij,...j->...i", self.gram, reference)
        square = self.square + np.sum(reference * (2 * self.product + moved), axis=-1)
        return Sums(self.gram, self.product + moved, square, self.pixels)

    def within(self, t: Float[np.ndarray, " T"], width: float, reference: Float[np.ndarray, "C 3"]) -> "Sums":
        """From the sums of a bracket those at some exponents in it, the lobe being Hermite's cubic of its ends.

        Args:
            t: where in the bracket, from 0 to 1.
            width: of the bracket, in log n.
            reference: the reference model, whose lobe was that of the lower end; here it is that of each t.
        """
        basis = np.zeros((t.size, 4, 6))
        basis[:, [0, 1, 2], [0, 1, 2]] = 1.0
        basis[:, 2, 3:] = np.stack([t * width, t * t * (3 - 2 * t), t * t * (t - 1) * width], axis=-1)
        basis[:, 3, 3:] = np.stack([np.ones_like(t), 6 * t * (1 - t) / width, t * (3 * t - 2)], axis=-1)
        change = reference[:, 2:] * (basis[:, None, 2] - np.eye(6)[2])
        moved = (self.gram @ change[..., None])[..., 0]
        square = self.square + np.sum(change * (moved - 2 * self.product), axis=-1)
        return Sums(
            gram=basis[:, None] @ self.gram @ basis[:, None].swapaxes(-1, -2),
            product=(self.product - moved) @ basis.swapaxes(-1, -2),
            square=square,
            pixels=np.broadcast_to(self.pixels, square.shape),
        )


def _columns(picture: Picture, log_n: Array, peak: Array) -> tuple[Float[Array, "P Cb"], ...]:
    """Diffuse, lobe, derivative by log n, and for a bracket what Hermite's cubic adds to the straight line."""
    lobe, diffuse = picture.lobe, picture.diffuse
    if log_n.shape[0] == 0:
        return (diffuse,)
    if lobe is None:
        return (diffuse,) + (jnp.zeros_like(diffuse),) * (2 * log_n.shape[0])
    value, slope = relative_lobe(lobe, log_n[0], peak, diffuse.dtype)
    if log_n.shape[0] == 1:
        return diffuse, value, slope
    end_value, end_slope = relative_lobe(lobe, log_n[1], peak, diffuse.dtype)
    step = (log_n[1] - log_n[0]).astype(diffuse.dtype)
    # Differences are taken per pixel: taken between sums they would lose the digits that a narrow bracket lives on.
    return diffuse, value, slope, end_value - value - step * slope, end_slope - slope


def _reduce(products: Sequence[Array]) -> Array:
    """All sums in one loop over the pixels."""
    zero = np.zeros((), products[0].dtype)
    totals = jax.lax.reduce(
        tuple(products),
        (zero,) * len(products),
        lambda left, right: tuple(a + b for a, b in zip(left, right, strict=True)),
        (0,),
    )
    return jnp.stack(totals).astype(jnp.float64)


def _means(picture: Picture, log_n: Array, peak: Array) -> Float[Array, "R-1 Cb"]:
    """What to take off the columns: their means over some pixels that count, in the pixels' dtype; Cb is 1 or C."""
    stride = max(1, picture.target.shape[0] // _MEAN_PIXELS)
    few = picture.pixels(lambda a: a[::stride])
    columns = jnp.stack(jnp.broadcast_arrays(*_columns(few, log_n, peak)))
    counts = jnp.broadcast_to(jnp.max(few.weights, axis=1) > 0, columns.shape[1])
    total = jnp.sum(jnp.where(counts[:, None], columns, 0), axis=1)
    return total / jnp.maximum(jnp.sum(counts), 1).astype(total.dtype)


def _block_sums(
    picture: Picture, log_n: Array, reference: Array, peak: Array, mean: Array, inside: Array | bool
) -> Float[Array, "G S"]:
    """Packed sums of one block; G is 1 where all channels share basis and weight, else C.

    Upper triangle of the Gram, columns times residuals, squares, pixel count.
    """
    target = picture.target.T
    # Weights of 1 are constants that the compiler leaves out.
    weight = jnp.where(inside, picture.weights.T, 0)
    lit = [column.T for column in _columns(picture, log_n, peak)]
    ambient = jnp.broadcast_to(picture.ambient, len(target)) * reference[0]
    reference = jnp.stack([ambient, reference[1], reference[2]]).astype(target.dtype)

    def one_group(columns: Sequence[Array], mean: Array, targets: Array, weight: Array, reference: Array) -> Array:
        residuals = []
        for values, (ambient, diffuse, specular) in zip(targets, reference.T, strict=True):
            model = ambient + diffuse * columns[0]
            if len(columns) > 1:
                model = model + specular * columns[1]
            residuals.append(jnp.where(weight > 0, values - model, 0))
        one = jnp.ones_like(columns[0])
        columns = [one, *(column - mean[i] for i, column in enumerate(columns))]
        weighted = [weight * column for column in columns]
        products = [left * right for i, left in enumerate(weighted) for right in columns[i:]]
        products += [left * residual for residual in residuals for left in weighted]
        products += [weight * residual * residual for residual in residuals]
        return _reduce([*products, jnp.where(weight > 0, one, 0)])

    groups = max(len(a) for a in (*lit, weight))
    if groups == 1 and len(target) <= UNROLLED_CHANNELS:
        weight = jnp.broadcast_to(weight[0], target.shape[1])
        return one_group([column[0] for column in lit], mean[:, 0], target, weight, reference)[None]
    columns = [jnp.broadcast_to(column, target.shape) for column in lit]
    means = jnp.broadcast_to(mean, (len(columns), len(target))).T
    weight = jnp.broadcast_to(weight, target.shape)
    return jax.vmap(one_group)(columns, means, target[:, None], weight, reference.T[:, :, None])


def _all_blocks(
    picture: Picture, log_n: Array, reference: Array, peak: Array
) -> tuple[Float[Array, "G S"], Float[Array, "R-1 Cb"]]:
    """Packed sums of one picture, block after block, and what was taken off the columns."""
    count = picture.target.shape[0]
    blocks = max(1, -(-count // BLOCK))
    size = -(-count // blocks)
    mean = _means(picture, log_n, peak)
    if blocks == 1:
        return _block_sums(picture, log_n, reference, peak, mean, True), mean

    def add(block: Array, packed: Array) -> Array:
        # The last block starts early enough to be whole; what it shares with the one before counts once.
        start = jnp.minimum(block * size, count - size)
        part = picture.pixels(lambda a: jax.lax.dynamic_slice_in_dim(a, start, size))
        inside = True if count % size == 0 else start + jnp.arange(size) >= block * size
        return packed + _block_sums(part, log_n, reference, peak, mean, inside)

    shape = jax.eval_shape(lambda: _block_sums(picture, log_n, reference, peak, mean, True))
    return jax.lax.fori_loop(0, blocks, add, jnp.zeros(shape.shape, shape.dtype)), mean


_one = jax.jit(_all_blocks, compiler_options=COMPILER_OPTIONS)


@partial(jax.jit, compiler_options=COMPILER_OPTIONS)
def _each(
    picture: Picture, log_n: Array, reference: Array, peak: Array
) -> tuple[Float[Array, "N G S"], Float[Array, "N R-1 Cb"]]:
    return jax.lax.map(lambda one: _all_blocks(picture, one[None], reference, peak), log_n)


def _unpack(packed: Float[np.ndarray, "*N G S"], mean: Float[np.ndarray, "*N R-1 Cb"], picture: Picture) -> Sums:
    """Undo the packing, and what was done to the columns.

    The ambient column is constant and was summed as 1; the others were summed less their means.
    """
    leading, channels, columns = packed.shape[:-2], picture.target.shape[1], mean.shape[-2] + 1
    place = np.zeros((columns, columns), int)
    triangle = columns * (columns + 1) // 2
    place[np.triu_indices(columns)] = np.arange(triangle)
    place = np.maximum(place, place.T)
    products = triangle + channels // packed.shape[-2] * columns
    # A row of it makes a column of what was summed, in units of the ambient light.
    whole = np.zeros((*leading, mean.shape[-1], columns, columns)) + np.eye(columns)
    whole[..., 1:, 0] = mean.swapaxes(-1, -2)
    scale = np.ones((channels, columns))
    scale[:, 0] = picture.ambient
    gram = whole @ packed[..., place] @ whole.swapaxes(-1, -2) * (scale[:, :, None] * scale[:, None, :])
    product = packed[..., triangle:products].reshape(*leading, channels, columns, 1)
    product = (whole @ product)[..., 0] * scale
    square = packed[..., products:-1].reshape(*leading, channels)
    more = [(0, 0)] * product.ndim + [(0, max(0, 4 - columns))]
    return Sums(
        gram=np.pad(gram, [*more[:-2], more[-1], more[-1]]),
        product=np.pad(product, more[1:]),
        square=square,
        pixels=np.broadcast_to(packed[..., -1], square.shape),
    )


def sums(
    pictures: Iterable[Picture],
    log_n: Float[np.ndarray, " N"],
    reference: Float[np.ndarray, "C 3"],
    *,
    grid: bool = False,
    peak: float = 0.0,
) -> Sums:
    """One pass over the pixels of one or many pictures, each let go before the next is asked for.

    Args:
        pictures: The pictures, or the tiles of one; at least one.
        log_n: Natural logarithms of the exponent. None: the columns are ambient and diffuse, and two of zeros. One:
            also the lobe and its derivative by log n. Two make a bracket: beside value ``s_0`` and derivative ``s_0'``
            at the first, the columns are ``s_1 - s_0 - (log n_1 - log n_0) s_0'`` and ``s_1' - s_0'``.
        reference: Coefficients x_a, x_d, x_s of the reference model; the lobe is that of the first exponent.
        grid: Treat each of ``log_n`` on its own; the sums have a leading axis N.
        peak: Take ``S exp(-n peak)`` for the lobe, its derivative and the reference; see :func:`relative_lobe`.

    Returns:
        The sums over all pixels.
    """
    result: Sums | None = None
    for picture in pictures:
        packed, mean = (_each if grid else _one)(picture, log_n, reference.T, np.float64(peak))
        part = _unpack(np.asarray(packed), np.asarray(mean, np.float64), picture)
        result = part if result is None else Sums(*map(np.add, result, part))
    assert result is not None
    return result


def sums_at(pictures: Iterable[Picture], n: float, x: Float[np.ndarray, "3 C"]) -> Sums:
    """Sums about the target at an optimum, the last column being the derivative by n.

    Args:
        pictures: as they were searched.
        n: the exponent.
        x: the coefficients, which the sums are exact near.
    """
    with jax.enable_x64(True):
        parts = sums(pictures, np.log([n]), x.T).about(np.pad(x.T, [(0, 0), (0, 1)]))
    by_n = np.array([1.0, 1.0, 1.0, 1.0 / n])
    return parts._replace(gram=parts.gram * by_n[:, None] * by_n, product=parts.product * by_n)
