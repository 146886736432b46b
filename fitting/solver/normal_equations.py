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
from typing import Any, NamedTuple, TypeAlias

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

        Args:
            reference: What to add to the residual, as coefficients of the first columns, (..., C, 3) or more.
        """
        missing = self.product.shape[-1] - reference.shape[-1]
        reference = np.pad(reference, np.array([*[(0, 0)] * (reference.ndim - 1), (0, missing)]))
        moved = (self.gram @ reference[..., None])[..., 0]
        square = self.square + np.sum(reference * (2 * self.product + moved), axis=-1)
        return self._replace(product=self.product + moved, square=square)

    def columns(self, basis: np.ndarray) -> "Sums":
        """Sums of other columns, each row of a basis saying what one is made of."""
        product = (basis @ self.product[..., None])[..., 0]
        return self._replace(gram=basis @ self.gram @ basis.swapaxes(-1, -2), product=product)

    def within(self, t: Float[np.ndarray, " T"], width: float, reference: Float[np.ndarray, "C 3"]) -> "Sums":
        """From the sums of a bracket those at some exponents in it, the lobe being Hermite's cubic of its ends.

        Args:
            t: where in the bracket, from 0 to 1.
            width: of the bracket, in log n.
            reference: the reference model, whose lobe was that of the lower end; here it is that of each t.
        """
        basis = np.zeros((t.size, 1, 4, 6))
        basis[..., [0, 1, 2], [0, 1, 2]] = 1.0
        basis[:, 0, 2, 3:] = np.stack([t * width, t * t * (3 - 2 * t), t * t * (t - 1) * width], axis=-1)
        basis[:, 0, 3, 3:] = np.stack([np.ones_like(t), 6 * t * (1 - t) / width, t * (3 * t - 2)], axis=-1)
        return self.about(reference[:, 2:] * (np.eye(6)[2] - basis[..., 2, :])).columns(basis)


def _columns(picture: Picture, log_n: Array, peak: Array) -> list[Array]:
    """Diffuse, lobe, derivative by log n, and for a bracket what Hermite's cubic adds to the straight line."""
    diffuse = picture.diffuse
    if picture.lobe is None:
        return [diffuse, *[jnp.zeros_like(diffuse)] * (2 * log_n.size)]
    ends = [relative_lobe(picture.lobe, at, peak, diffuse.dtype) for at in log_n]
    columns = [diffuse, *(column for end in ends[:1] for column in end)]
    if len(ends) == 2:
        (value, slope), (end_value, end_slope) = ends
        step = (log_n[1] - log_n[0]).astype(diffuse.dtype)
        # Differences are taken per pixel: taken between sums they would lose the digits a narrow bracket lives on.
        columns += [end_value - value - step * slope, end_slope - slope]
    return columns


def _means(picture: Picture, log_n: Array, peak: Array) -> Array:
    """What to take off the columns: their means over some pixels that count, in the pixels' dtype, (R - 1, Cb)."""
    stride = max(1, picture.target.shape[0] // _MEAN_PIXELS)
    few = picture.pixels(lambda a: a[::stride])
    columns = jnp.stack(jnp.broadcast_arrays(*_columns(few, log_n, peak)))
    counts = jnp.broadcast_to(jnp.max(few.weights, axis=1) > 0, columns.shape[1])
    total = jnp.sum(jnp.where(counts[:, None], columns, 0), axis=1)
    return total / jnp.maximum(jnp.sum(counts), 1).astype(total.dtype)


def _summed(columns: int, residuals: int) -> list[tuple[int, int]]:
    """Which products of the columns and of the residuals after them are summed: of two residuals none."""
    size = columns + residuals
    return [(i, j) for i in range(size) for j in range(i, size) if i < columns or i == j]


def _group_sums(columns: Sequence[Array], mean: Array, targets: Array, weight: Array, reference: Array) -> Array:
    """Sums of the channels that share basis and weight, in one loop over the pixels; the last is the pixel count."""
    one = jnp.ones_like(columns[0])
    parts = [one, *(column - mean[i] for i, column in enumerate(columns))]
    for target, (ambient, *coefficients) in zip(targets, reference.T, strict=True):
        model = ambient
        for coefficient, column in zip(coefficients, columns, strict=False):
            model = model + coefficient * column
        parts.append(jnp.where(weight > 0, target - model, 0))
    weighted = [weight * part for part in parts]
    products = [weighted[i] * parts[j] for i, j in _summed(1 + len(columns), len(targets))]
    products.append(jnp.where(weight > 0, one, 0))
    zero = np.zeros((), one.dtype)
    totals = jax.lax.reduce(
        tuple(products),
        (zero,) * len(products),
        lambda left, right: tuple(a + b for a, b in zip(left, right, strict=True)),
        (0,),
    )
    return jnp.stack(totals).astype(jnp.float64)


def _block_sums(picture: Picture, log_n: Array, reference: Array, peak: Array, mean: Array, inside: Any) -> Array:
    """Sums of one block, (G, S); G is 1 where all channels share basis and weight, else C."""
    target = picture.target.T
    columns = [column.T for column in _columns(picture, log_n, peak)]
    # Weights of 1 are constants that the compiler leaves out.
    columns.append(jnp.where(inside, picture.weights.T, 0))
    shared = max(map(len, columns)) == 1 and len(target) <= UNROLLED_CHANNELS
    groups = 1 if shared else len(target)
    *columns, weight = (jnp.broadcast_to(column, (groups, target.shape[1])) for column in columns)
    reference = reference.at[0].multiply(picture.ambient).astype(target.dtype).reshape(3, groups, -1)
    mean = jnp.broadcast_to(mean, (len(columns), groups))
    return jax.vmap(_group_sums, (0, 1, 0, 0, 1))(
        columns, mean, target.reshape(groups, -1, target.shape[1]), weight, reference
    )


@partial(jax.jit, compiler_options=COMPILER_OPTIONS)
def _each(picture: Picture, log_n: Array, reference: Array, peak: Array) -> tuple[Array, Array]:
    """For each row of exponents the sums of one picture, block after block, and what was taken off the columns."""
    count = picture.target.shape[0]
    blocks = max(1, -(-count // BLOCK))
    size = -(-count // blocks)

    def one(log_n: Array) -> tuple[Array, Array]:
        mean = _means(picture, log_n, peak)

        def block_sums(block: Array) -> Array:
            # The last block starts early enough to be whole; what it shares with the one before counts once.
            start = jnp.minimum(block * size, count - size)
            part = picture.pixels(lambda a: jax.lax.dynamic_slice_in_dim(a, start, size))
            inside = True if count % size == 0 else start + jnp.arange(size) >= block * size
            return _block_sums(part, log_n, reference, peak, mean, inside)

        return jnp.sum(jax.lax.map(block_sums, jnp.arange(blocks)), axis=0), mean

    return jax.lax.map(one, log_n)


def _unpack(packed: np.ndarray, mean: np.ndarray, picture: Picture) -> Sums:
    """Undo the packing, and what was done to the columns."""
    channels, columns = picture.target.shape[1], mean.shape[1] + 1
    residuals = channels // packed.shape[1]
    i, j = np.array(_summed(columns, residuals)).T
    products = np.zeros((*packed.shape[:2], *(columns + residuals,) * 2))
    products[..., i, j] = products[..., j, i] = packed[..., :-1]
    square = np.diagonal(products[..., columns:, columns:], axis1=-2, axis2=-1).reshape(-1, channels)
    found = Sums(
        gram=products[..., :columns, :columns],
        product=products[..., columns:, :columns].reshape(-1, channels, columns),
        square=square,
        pixels=np.broadcast_to(packed[..., -1], square.shape),
    )
    # The ambient column is constant and was summed as 1; the others were summed less their means.
    basis = np.zeros((len(mean), channels, max(4, columns), columns)) + np.eye(max(4, columns), columns)
    basis[..., 1:columns, 0] = mean.swapaxes(1, 2)
    basis[..., 0, 0] = picture.ambient
    return found.columns(basis)


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
        packed, mean = _each(picture, log_n[:, None] if grid else log_n[None], reference.T, np.float64(peak))
        part = _unpack(np.asarray(packed), np.asarray(mean, np.float64), picture)
        result = part if result is None else Sums(*map(np.add, result, part))
    assert result is not None
    return result if grid else Sums(*(leaf[0] for leaf in result))
