"""What light samples add up to at a point: the diffuse sum, and the cosine lobe averaged over samples and pixel area.

Renderer and fit share it. Many samples never mean many images in memory: the pass over samples is a loop, and pixels
are taken tile by tile, which also keeps a tile in the processor's cache while its samples pass.
"""

import dataclasses
import math
import operator
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from brdf.checks import Scalar, Vector
from brdf.geometry.base import Shape
from brdf.geometry.surface_points import SurfacePoints
from brdf.geometry.visibility import share_seen
from brdf.lights.base import Light, Lighting
from brdf.models.base import Material, SpecularMaterial
from brdf.models.one_of import Model, OneOf, has_lobe
from brdf.vectors import BELOW_HORIZON, Components, divide, dot, quadratic_form, square_root

STORED_SAMPLES = 4
"""Up to so many light samples each is compiled on its own, and the fit keeps its terms as arrays of their own."""

TILE, CHUNK, ROWS = 1 << 12, 32, 3
"""Pixels, and samples, that are dealt with at a time: half a megabyte for each of the few values in between.
And rows from which on XLA's product of two matrices is a quick one."""

STACKED_VALUES = 1 << 26
"""Up to so many values the fit keeps the terms of many samples, too, for few pixels: 256 MiB in float32."""

NODES, STEP, NARROWEST, WIDEST, ROUGH = 5, 0.35, 0.04, 1.0, 1e4
"""A polynomial through so many exponents stands for a lobe: between nodes of Chebyshev over a range of log n of 0.7 to
1e-5, of 0.04 to 1e-11; wider than `WIDEST` at equal steps, to 1e-3, which serves to find where to look.

Up to the last of these as exponent products may be rounded."""

NO_LOBE = -1e9
"""The peak of a pixel without a lobe: exp(n * this) = 0 for every n that a fit visits."""


class LightTerms(NamedTuple):
    """What one light sample adds to the basis images at one point.

    Attributes:
        diffuse: I (N·L)+, (C,).
        weight: I, times N·L where the model says so, 0 where the lobe is gated, (C,).
        log_cosine: logarithm of the lobe's cosine; 0 where the lobe is gated.
    """

    diffuse: Float[Array, "*pixels C"]
    weight: Float[Array, "*pixels C"]
    log_cosine: Float[Array, "*pixels"]


def light_terms(
    model: Model,
    occluders: tuple[Shape, ...],
    kind: type[Light],
    row: tuple[Array, ...],
    light: Int[Array, ""],
    point: SurfacePoints,
) -> LightTerms:
    """The terms at one point of one sample, a row of a stack, of the scene's light of that number."""
    sample = kind.sample(point, *row)
    if sample.moments is None:
        cosine, above = dot(point.normal, sample.to_light), 1.0
    else:
        cosine, above = patch_cosine(point.normal, *sample.moments)
    lit = point.mask & (cosine > 0)
    intensity = sample.intensity
    if occluders:
        intensity = intensity * share_seen(occluders, point, sample.to_light, sample.distance, sample.radius)
    if point.visibility is not None:
        intensity = intensity * point.visibility[light]
    matt = lit if sample.lobe_only is None else lit & (sample.lobe_only == 0)
    diffuse = intensity * jnp.where(matt, cosine, 0)
    if not has_lobe(model):
        return LightTerms(diffuse, 0.0 * diffuse, jnp.zeros_like(cosine))
    log_cosine = model.log_cosine(point.normal, sample.to_light, point.to_view)
    glossy = lit if sample.lobe_only is None else lit & (sample.lobe_only > 0)
    shines = glossy & (dot(point.normal, point.to_view) > 0) & (log_cosine > 0.5 * BELOW_HORIZON)
    weight = intensity * jnp.where(shines, jnp.where(model.cosine_weighted, cosine, above), 0)
    return LightTerms(diffuse, weight, jnp.where(shines, log_cosine, 0))


def patch_cosine(normal: Vector, mean: Vector, covariance: Float[Array, "3 3"]) -> tuple[Scalar, Scalar]:
    """Mean of (N·L)+ over a patch of the sky, and the share of its light above the horizon.

    Exact where the patch does not cross the horizon. Where it does, N·L is taken to be spread by the parabola
    3/4 (1 - x²) that has the patch's mean and variance.
    """
    middle = dot(normal, mean)
    half_width = square_root(5.0 * quadratic_form(normal, covariance))
    x = divide(middle, half_width)
    crosses = (half_width > 0) & (jnp.abs(x) < 1)
    x = jnp.where(crosses, x, 0.0)
    partly = half_width * (3 / 16 + x * (1 / 2 + x * (3 / 8 - x * x / 16)))
    share = 1 / 2 + x * (3 / 4 - x * x / 4)
    return jnp.where(crosses, partly, middle), jnp.where(crosses, share, 1.0)


def sum_over_samples(
    model: Model, points: SurfacePoints, lighting: Lighting, of_terms: Callable[[LightTerms], Any]
) -> Any:
    """Add up a function of one sample's terms at one point, linear in diffuse and weight, over all samples.

    Args:
        model: the class of the material.
        points: (P,).
        lighting: with at least one light.
        of_terms: gives values without an axis of channels where it gets such; of any structure.

    Returns:
        The sums in that structure, (P, C) each.
    """
    if is_sampled(lighting):
        return over_samples(model, points, lighting, of_terms)[0]

    def at_point(point: SurfacePoints) -> Any:
        total = None
        for sample in lighting.each():
            value = of_terms(light_terms(model, lighting.occluders, *sample, point))
            total = value if total is None else jax.tree.map(jnp.add, total, value)
        return total

    return jax.vmap(at_point)(points)


def is_sampled(lighting: Lighting) -> bool:
    """Whether the samples are so many that they are looped over."""
    return lighting.samples > STORED_SAMPLES


def over_samples(
    model: Model,
    points: SurfacePoints,
    lighting: Lighting,
    of_terms: Callable[[LightTerms], Any],
    *,
    rough: bool = False,
) -> tuple[Any, Float[Array, " P"]]:
    """Sums as of `sum_over_samples` for many samples, and the peak of the lobe.

    All is done for a tile of pixels and a chunk of samples at a time, which the processor's cache holds, with light of
    strength 1; what a chunk's samples emit, in C channels, is multiplied with that as a matrix.
    """
    occluders = tuple(_apart(shape) if shape.in_components else shape for shape in lighting.occluders)
    channels = max(one.shape[-1] for stack in lighting.stacks for one in stack.spectra)

    def of_tile(tile: Any) -> Any:
        dtype = tile.normal.parts[0].dtype

        def add(kind: type[Light], numbers: Any, light: Any, total: Any, chunk: tuple[Any, ...]) -> tuple[Any, None]:
            nodes, emitted = chunk[:2]
            shines = emitted.any(axis=1)
            if light is not None:
                shines &= nodes[kind.weighs].reshape(shines.size, -1).any(axis=1)
            added = partial(add_lit, kind, numbers, light)
            return jax.lax.cond(jnp.any(shines), added, lambda before, _: before, total, chunk), None

        def add_lit(kind: type[Light], numbers: Any, light: Any, total: Any, chunk: tuple[Any, ...]) -> Any:
            nodes, emitted = chunk[:2]
            row = (*map(_apart, numbers), *map(_chunk_apart, nodes))
            grey: Any = tuple(1.0 if place in kind.emits else part for place, part in enumerate(row))
            terms = light_terms(model, occluders, kind, grey, light if len(chunk) == 2 else chunk[2], tile)
            terms = LightTerms(*(jnp.broadcast_to(part, (len(emitted), *tile.mask.shape)) for part in terms))
            terms = jax.lax.optimization_barrier(terms)  # or each of the sums would make them anew
            peak = jnp.max(jnp.where(emitted.max(axis=1, keepdims=True) > 0, _peak(terms), NO_LOBE), axis=0)
            added = jax.tree.map(partial(_emitted, emitted), of_terms(terms))
            return jax.tree.map(jnp.add, total[0], added), jnp.maximum(total[1], peak)

        nothing = jnp.zeros((channels, *tile.mask.shape), dtype)
        shapes = jax.eval_shape(of_terms, LightTerms(*3 * [nothing[:1]]))
        total = jax.tree.map(lambda _: nothing, shapes), jnp.full(tile.mask.shape, NO_LOBE, dtype)
        for stack in lighting.stacks:
            kind = stack.kind
            if not stack.nodes:
                chunks = _chunks((stack.numbers, stack.emitted(channels)[:, 0], stack.light))
                total, _ = jax.lax.scan(jax.checkpoint(partial(add, kind, (), None)), total, chunks)
                continue

            def add_light(total: Any, one: Any, kind: type[Light] = kind) -> tuple[Any, None]:
                numbers, light, *samples = one
                step = jax.checkpoint(partial(add, kind, numbers, light))
                return jax.lax.scan(step, total, _chunks(tuple(samples)))

            each = stack.numbers, stack.light, stack.nodes, stack.emitted(channels)
            total, _ = jax.lax.scan(add_light, total, each)
        return jax.tree.map(lambda leaf: leaf.T, total)

    return _by_tiles(of_tile, points, rough)


def _emitted(emitted: Float[Array, "B C"], value: Float[Array, "B P"]) -> Float[Array, "C P"]:
    """The sum over samples; a product with a matrix of one row would be slow."""
    rows = jnp.pad(emitted.T, ((0, max(0, ROWS - emitted.shape[1])), (0, 0)))
    return jnp.matmul(rows, value, precision="highest")[: emitted.shape[1]]


def _apart(tree: Any) -> Any:
    """Vectors in components."""
    return jax.tree.map(lambda leaf: Components.of(leaf) if jnp.ndim(leaf) == 1 else leaf, tree)


def _chunk_apart(values: Array) -> Any:
    """Numbers of B samples as (B, 1), vectors as components of that form, a matrix as rows of such."""
    if values.ndim == 3:
        return tuple(map(_chunk_apart, jnp.unstack(values, axis=1)))
    return values[:, None] if values.ndim == 1 else Components.of(values[:, None])


def _chunks(samples: Any) -> Any:
    """Arrays (S, ...) as (S / B, B, ...); samples of no light fill up the last chunk."""
    count = jax.tree.leaves(samples)[0].shape[0]
    chunks = -(-count // CHUNK)
    size = -(-count // chunks)
    index = np.minimum(np.arange(chunks * size), count - 1).reshape(chunks, size)
    numbers, emitted, *light = jax.tree.map(lambda leaf: leaf[index], samples)
    beyond = np.arange(chunks * size).reshape(chunks, size, 1) >= count
    return numbers, jnp.where(beyond, 0, emitted), *light


def _points_apart(points: SurfacePoints, rough: bool) -> Any:
    """The vectors of (P,) points in components, and the lights that they see along the first axis."""
    seen = None if points.visibility is None else points.visibility.T
    plain = dataclasses.replace(points, visibility=None)
    apart = jax.tree.map(lambda leaf: Components.of(leaf) if leaf.ndim == 2 else leaf, plain)
    normal = dataclasses.replace(apart.normal, rough=rough)
    return dataclasses.replace(apart, normal=normal, visibility=seen)


def _by_tiles(of_tile: Callable[[SurfacePoints], Any], points: SurfacePoints, rough: bool) -> Any:
    """``of_tile`` of all points, tile by tile; the last point fills up the last tile."""
    count = points.mask.size
    tiles = -(-count // TILE)
    size = -(-count // tiles)

    def cut(leaf: Array) -> Array:
        padded = jnp.pad(leaf, [(0, tiles * size - count)] + [(0, 0)] * (leaf.ndim - 1), mode="edge")
        return padded.reshape(tiles, size, *leaf.shape[1:])

    done = jax.lax.map(lambda tile: of_tile(_points_apart(tile, rough)), jax.tree.map(cut, points))
    return jax.tree.map(lambda leaf: leaf.reshape(tiles * size, *leaf.shape[2:])[:count], done)


class Near(NamedTuple):
    """Exponents at which a lobe of many samples is tabulated, once for all that is asked of it later.

    Attributes:
        log_n: their logarithms, increasing, (N,), at least `NODES`.
        peak: about the largest logarithm of the lobe's cosine in any pixel, which the values are relative to.
    """

    log_n: Float[Any, " N"]
    peak: Float[Any, ""]

    @property
    def narrow(self) -> bool:
        """Whether one polynomial goes through all of them."""
        return self.log_n.size == NODES

    @property
    def ends(self) -> tuple[float, float]:
        """Logarithms of the exponents between which it serves; the nodes of Chebyshev end short of that."""
        low, high = float(self.log_n[0]), float(self.log_n[-1])
        beyond = 0.5 * (high - low) * (1 / math.cos(0.5 * math.pi / NODES) - 1) if self.narrow else 0.0
        return low - beyond, high + beyond

    @classmethod
    def between(cls, low: float, high: float, peak: float) -> "Near":
        """The nodes of Chebyshev between two logarithms of n, or many at equal steps where these are far apart."""
        if high - low > WIDEST:
            return cls(np.linspace(low, high, math.ceil((high - low) / STEP) + NODES), np.float64(peak))
        turn = np.cos(np.pi * (np.arange(NODES) + 0.5) / NODES)[::-1]
        # Nodes too close to each other would make slopes of rounding.
        return cls(0.5 * (low + high) + 0.5 * max(high - low, NARROWEST) * turn, np.float64(peak))


def _lagrange(xp: Any, nodes: Any, at: Any) -> Any:
    """What multiplies the values at some nodes to give that of their polynomial, and its derivative, (2, N)."""
    away, weights, slopes = at - nodes, [], []
    for k in range(NODES):
        others = [j for j in range(NODES) if j != k]
        scale = math.prod(nodes[k] - nodes[j] for j in others)
        weights.append(math.prod(away[j] for j in others) / scale)
        slopes.append(sum(math.prod(away[i] for i in others if i != j) for j in others) / scale)
    return xp.stack([xp.stack(weights), xp.stack(slopes)])


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, eq=False)
class Lobe:
    """The specular basis as a function of the exponent, which a fit evaluates again and again.

    The terms of few light samples, or of few pixels, are kept as arrays; those of many are made anew at each
    evaluation, in bounded memory. Where pixels are averaged over their area, theirs is the mean of a finer lobe.
    Arrays of NumPy are evaluated by NumPy.

    Attributes:
        peak: the largest logarithm of the lobe's cosine over the samples, `NO_LOBE` where no sample has one.
        model: the class of the material, where the terms are made anew.
        kept: weights, (P, S, C), and logarithms of the cosine, (P, S), of some samples each.
        source: points (P,) and lights that the terms are made of anew; None where they are kept.
        fine: of the points, (K M,), of those pixels that are averaged; None where no pixel is.
        share: of each point in its pixel, (K, M).
        table: values at some exponents, relative to a peak, (P, N, C); None where nothing is tabulated.
        near: what they are tabulated at.
        slot: for every pixel its row in ``share``, or -1, (P,).
    """

    peak: Float[Array, " P"]
    model: type[Material] | None = dataclasses.field(default=None, metadata={"static": True})
    kept: tuple[tuple[Float[Array, "P S C"], Float[Array, "P S"]], ...] = ()
    source: tuple[SurfacePoints, Lighting] | None = None
    fine: "Lobe | None" = None
    share: Float[Array, "K M"] | None = None
    slot: Int[Array, " P"] | None = None
    table: Float[Array, "P N C"] | None = None
    near: Near | None = None

    @classmethod
    def of_terms(cls, kept: tuple[tuple[Float[Array, "P S C"], Float[Array, "P S"]], ...]) -> "Lobe":
        """The lobe of terms that are kept."""
        peaks = [jnp.where(jnp.max(weight, axis=-1) > 0, log_cosine, NO_LOBE) for weight, log_cosine in kept]
        return cls(jnp.max(jnp.concatenate(peaks, axis=1), axis=1), kept=kept)

    def __call__(self, n: Scalar, peak: Scalar | float = 0.0) -> tuple[Float[Array, "*N P C"], Float[Array, "*N P C"]]:
        """The basis image without the model's scale, and its derivative in n.

        Args:
            n: the exponent; of terms kept in NumPy also several, (N, 1, 1).
            peak: the logarithm of a cosine; the lobe is ``S exp(-n peak)``. Where no pixel sees the highlight's centre
                a lobe itself falls by many powers of ten within a step of log n, but its shape does not change faster
                than elsewhere. What lies nearer to the centre than that counts as if it were there.
        """
        if self.table is not None:
            return self._interpolated(n, peak)
        value: Any = 0.0
        slope: Any = 0.0
        if self.source is None:
            for weight, log_cosine in self.kept:
                xp: Any = np if isinstance(log_cosine, np.ndarray) else jnp
                exponent = xp.minimum(log_cosine - xp.asarray(peak, log_cosine.dtype), 0)
                power = xp.exp(xp.asarray(n, exponent.dtype) * exponent)
                both = power, power * exponent
                if xp is jnp:
                    parts = (jnp.sum(one[..., None] * weight, axis=-2) for one in both)
                elif weight.shape[1:] == (1, 1):  # NumPy is slow where the last axes are short
                    parts = map(operator.mul, both, (weight[:, 0],) * 2)
                else:
                    parts = map(partial(np.einsum, "...ps,psc->...pc"), both, (weight,) * 2)
                value, slope = map(operator.add, (value, slope), parts)
        else:
            assert self.model is not None
            value, slope = sum_over_samples(self.model, *self.source, partial(_relative, n, peak))
        if self.fine is None or self.share is None:
            return value, slope
        fine_value, fine_slope = (average(self.share, fine) for fine in self.fine(n, peak))
        return self._averaged(value, fine_value), self._averaged(slope, fine_slope)

    def _interpolated(self, n: Scalar, peak: Scalar | float) -> tuple[Array, Array]:
        """From the table, by Lagrange's polynomial through the nearest nodes."""
        near, table = self.near, self.table
        assert near is not None
        assert table is not None
        xp: Any = np if isinstance(table, np.ndarray) else jnp
        n = xp.asarray(n, float if xp is np else None)
        nodes = xp.asarray(near.log_n)
        beyond = 0.03 * (nodes[-1] - nodes[0])  # the nodes of Chebyshev end short of their range
        log_n = xp.clip(xp.log(n), nodes[0] - beyond, nodes[-1] + beyond)
        first = xp.clip(xp.searchsorted(nodes, log_n) - NODES // 2, 0, nodes.size - NODES)
        if xp is np:
            weights = np.stack(
                [_lagrange(np, nodes[i : i + NODES], at) for i, at in zip(first.flat, log_n.flat, strict=True)]
            )
            some = np.stack([table[:, i : i + NODES] for i in first.flat])
            value, slope = np.einsum("nwk,npkc->wnpc", weights, some).reshape(2, *n.shape[:-2], *table[:, 0].shape)
        else:
            weights = _lagrange(jnp, jax.lax.dynamic_slice_in_dim(nodes, first, NODES), log_n).astype(table.dtype)
            some = jax.lax.dynamic_slice_in_dim(table, first, NODES, axis=1)
            value, slope = (sum(weight[k] * some[:, k] for k in range(NODES)) for weight in weights)
        more = near.peak - peak
        factor = xp.asarray(xp.exp(n * more), table.dtype)
        slope = slope / xp.asarray(n, table.dtype)
        return factor * value, factor * (slope + xp.asarray(more, table.dtype) * value)

    def pixels(self, choose: Callable[[Array], Array]) -> "Lobe":
        """The same for some of the pixels: ``choose`` is applied to each array whose first axis is the pixels."""
        source = None if self.source is None else (jax.tree.map(choose, self.source[0]), self.source[1])
        peak, kept, slot, table = jax.tree.map(choose, (self.peak, self.kept, self.slot, self.table))
        return Lobe(peak, self.model, kept, source, self.fine, self.share, slot, table, self.near)

    @property
    def samples(self) -> int:
        """How many light samples add up at a point."""
        if self.table is not None:
            return NODES
        return sum(terms[1].shape[1] for terms in self.kept) if self.source is None else self.source[1].samples

    def on_host(self, pixel: Int[np.ndarray, " K"]) -> "Lobe":
        """The same for some of the pixels, all terms kept in NumPy."""
        lobe = jax.tree.map(np.asarray, self).pixels(partial(np.take, indices=pixel, axis=0))
        if self.source is not None and self.model is not None:
            # Of one size for few numbers of pixels, or each would be compiled.
            padded = np.resize(pixel, 1 << max(pixel.size - 1, 0).bit_length())
            points = jax.tree.map(lambda leaf: np.asarray(leaf)[padded], self.source[0])
            terms = _diffuse_and_kept(OneOf.of(self.model), points, self.source[1])[1].kept
            lobe = dataclasses.replace(
                lobe, source=None, kept=jax.tree.map(lambda a: np.asarray(a)[: pixel.size], terms)
            )
        if self.fine is None or self.share is None:
            return lobe
        slot, each = np.asarray(lobe.slot), np.arange(self.share.shape[1])
        rows = np.unique(slot[slot >= 0])
        if not rows.size:
            return dataclasses.replace(lobe, fine=None, share=None, slot=None)
        fine = self.fine.on_host((rows[:, None] * each.size + each).ravel())
        slot = np.where(slot >= 0, np.searchsorted(rows, slot), -1)
        return dataclasses.replace(lobe, fine=fine, share=np.asarray(self.share)[rows], slot=slot)

    def over_areas(self, fine: "Lobe", share: Float[Array, "K M"], slot: Int[Array, " P"]) -> "Lobe":
        """The lobe where some pixels are averaged: that of their points, their shares, and the row of each pixel."""
        lobe = dataclasses.replace(self, fine=fine, share=share, slot=slot)
        peak = lobe._averaged(self.peak, jnp.max(fine.peak.reshape(share.shape), axis=1))
        return dataclasses.replace(lobe, peak=peak)

    def _averaged(self, centre: Array, fine: Array) -> Array:
        """The pixel axis is the last but one of images, the only one of peaks."""
        slot = self.slot
        assert slot is not None
        xp: Any = np if isinstance(fine, np.ndarray) else jnp
        if centre.ndim == 1:
            return xp.where(slot >= 0, fine[xp.maximum(slot, 0)], centre)
        return xp.where((slot >= 0)[:, None], xp.take(fine, xp.maximum(slot, 0), axis=-2), centre)


def _relative(n: Scalar, peak: Scalar | float, terms: LightTerms) -> tuple[Array, Array]:
    """What one sample adds to the lobe relative to a peak, and to its derivative."""
    exponent = jnp.minimum(terms.log_cosine - jnp.asarray(peak, terms.log_cosine.dtype), 0)
    value = terms.weight * jnp.exp(jnp.asarray(n, exponent.dtype) * exponent)
    return value, value * exponent


def _peak(terms: LightTerms) -> Array:
    return jnp.where(terms.weight > 0, terms.log_cosine, NO_LOBE)


def average(weight: Float[Array, "K M"], values: Float[Array, "*N K*M C"]) -> Float[Array, "*N K C"]:
    """The mean of each pixel's points."""
    xp: Any = np if isinstance(values, np.ndarray) else jnp
    return xp.sum(weight[..., None] * values.reshape(*values.shape[:-2], *weight.shape, values.shape[-1]), axis=-2)


def basis_program(
    model: type[Material], points: SurfacePoints, lighting: Lighting
) -> Callable[[], tuple[Float[Array, "P C"], Lobe | None]]:
    """What makes the diffuse basis of P points, of any shape, and the specular one where the model has one."""
    points = points.flat()
    if not is_sampled(lighting):
        return partial(_diffuse_and_terms, OneOf.of(model), points, lighting)
    if issubclass(model, SpecularMaterial):
        if _size(jax.eval_shape(partial(_stacked_terms, model, lighting), points)) <= STACKED_VALUES:
            return partial(_diffuse_and_kept, OneOf.of(model), points, lighting)
    return partial(_diffuse_and_peak, model, points, lighting)


@eqx.filter_jit
def _diffuse_and_terms(model: Model, points: SurfacePoints, lighting: Lighting) -> tuple[Array, Lobe | None]:
    diffuse: Any = 0.0
    kept: tuple[Any, ...] = ()
    for kind, row, light in lighting.each():
        terms = jax.vmap(partial(light_terms, model, lighting.occluders, kind, row, light))(points)
        diffuse, kept = diffuse + terms.diffuse, (*kept, (terms.weight[:, None], terms.log_cosine[:, None]))
    return diffuse, Lobe.of_terms(kept) if has_lobe(model) else None


@eqx.filter_jit
def _diffuse_and_peak(model: type[Material], points: SurfacePoints, lighting: Lighting) -> tuple[Array, Lobe | None]:
    diffuse, peak = over_samples(model, points, lighting, lambda terms: terms.diffuse)
    lobe = Lobe(peak, model, source=(points, lighting)) if issubclass(model, SpecularMaterial) else None
    return diffuse, lobe


@eqx.filter_jit
def _diffuse_and_kept(model: Model, points: SurfacePoints, lighting: Lighting) -> tuple[Array, Lobe]:
    diffuse, kept = _stacked_terms(model, lighting, points)
    return diffuse, Lobe.of_terms(kept)


@eqx.filter_jit
def tabulated(
    model: Model, points: SurfacePoints, lighting: Lighting, near: Near, *, rough: bool
) -> tuple[Float[Array, "P C"], Float[Array, " P"], Float[Array, "P N C"] | None]:
    """Of (P,) points under many samples the diffuse basis, the peak and the lobe at some exponents, in one pass."""

    def of_terms(terms: LightTerms) -> Any:
        dtype = terms.log_cosine.dtype
        exponent = jnp.minimum(terms.log_cosine - jnp.asarray(near.peak, dtype), 0)
        n = jnp.exp(jnp.asarray(near.log_n)).astype(dtype) if has_lobe(model) else []
        return terms.diffuse, [terms.weight * jnp.exp(one * exponent) for one in n]

    (diffuse, values), peak = over_samples(model, points, lighting, of_terms, rough=rough)
    return diffuse, peak, jnp.stack(values, axis=1) if values else None


def _stacked_terms(model: Model, lighting: Lighting, points: SurfacePoints) -> tuple[Any, Any]:
    """Sum of the diffuse terms, and weights and cosines of the lobe, of all samples at once.

    The loop over samples is the outer one: an array of all of them would be made in many steps of its own size.
    """
    diffuse: Any = 0.0
    kept: tuple[Any, ...] = ()
    for stack in lighting.stacks:

        def of_light(one: Any, kind: type[Light] = stack.kind) -> LightTerms:
            numbers, nodes, light = one

            def of_sample(node: tuple[Array, ...]) -> LightTerms:
                of_point = partial(light_terms, model, lighting.occluders, kind, (*numbers, *node), light)
                return jax.vmap(of_point)(points)

            return jax.lax.map(of_sample, nodes) if nodes else of_sample(())

        terms = jax.lax.map(of_light, (stack.numbers, stack.nodes, stack.light))
        terms = jax.tree.map(lambda leaf, count=stack.samples: leaf.reshape(count, points.mask.size, -1), terms)
        diffuse = diffuse + jnp.sum(terms.diffuse, axis=0)
        kept = (*kept, (terms.weight.swapaxes(0, 1), terms.log_cosine[..., 0].T))
    return diffuse, kept


def _size(tree: Any) -> int:
    """The number of values in all arrays."""
    return sum(leaf.size for leaf in jax.tree.leaves(tree))
