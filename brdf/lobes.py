"""What light samples add up to at a point: the diffuse sum, and the cosine lobe averaged over samples and pixel area.

Renderer and fit share it. Many samples never mean many images in memory: the pass over samples is a loop, and pixels
are taken tile by tile, which also keeps a tile in the processor's cache while its samples pass.
"""

import dataclasses
import functools
import math
import operator
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from brdf.checks import Scalar
from brdf.geometry.rays import Sight
from brdf.geometry.surface_points import Points, SurfacePoints
from brdf.geometry.visibility import share_seen
from brdf.lights.base import Light, Lighting
from brdf.models.base import Material, SpecularMaterial
from brdf.models.one_of import OneOf
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
    """What light samples of strength 1 add to the basis images at some points.

    Attributes:
        diffuse: (N·L)+ times the share of the light that arrives.
        weight: that share, times N·L where the model says so, 0 where the lobe is gated.
        log_cosine: logarithm of the lobe's cosine; 0 where the lobe is gated.
    """

    diffuse: Float[Array, "S P"]
    weight: Float[Array, "S P"]
    log_cosine: Float[Array, "S P"]


def light_terms(
    model: OneOf,
    lighting: Lighting,
    point: Points,
    kind: type[Light],
    numbers: tuple[Array, ...],
    nodes: tuple[Array, ...],
    light: Int[Array, " S"],
) -> LightTerms:
    """The terms of samples of a light.

    Args:
        model: the class of the material.
        lighting: with the shapes that cast shadows.
        point: (P,).
        kind: of light.
        numbers: of the light, (...) each.
        nodes: of its samples, (S, ...) each.
        light: which of the scene's lights each of them is.
    """
    row = (*(_in_components(values[None]) for values in numbers), *map(_in_components, nodes))
    row = tuple(1.0 if place in kind.emits else part for place, part in enumerate(row))
    sample = kind.sample(point, *row)
    if sample.moments is None:
        cosine, above = dot(point.normal, sample.to_light), 1.0
    else:
        cosine, above = patch_cosine(point.normal, *sample.moments)
    lit = point.mask & (cosine > 0)
    intensity = sample.intensity
    if lighting.occluders:
        seen = share_seen(lighting.occluders, point, sample.to_light, sample.distance, sample.radius)
        intensity = intensity * seen
    if point.visibility is not None:
        intensity = intensity * point.visibility[:, light].T
    matt = lit if sample.lobe_only is None else lit & (sample.lobe_only == 0)
    diffuse = intensity * jnp.where(matt, cosine, 0)
    weight, log_cosine = jnp.zeros_like(diffuse), jnp.zeros_like(diffuse)
    if model.lobes:
        log_cosine = model.log_cosine(point.normal, sample.to_light, point.to_view)
        glossy = lit if sample.lobe_only is None else lit & (sample.lobe_only > 0)
        shines = glossy & (dot(point.normal, point.to_view) > 0) & (log_cosine > 0.5 * BELOW_HORIZON)
        weight = intensity * jnp.where(shines, jnp.where(model.cosine_weighted, cosine, above), 0)
        log_cosine = jnp.where(shines, log_cosine, 0)
    shape = light.size, point.mask.size
    return LightTerms(*(jnp.broadcast_to(part, shape) for part in (diffuse, weight, log_cosine)))


def _in_components(values: Array) -> Any:
    """Numbers of S samples as (S, 1), vectors as components of that form, a matrix as rows of such."""
    if values.ndim == 3:
        return tuple(map(_in_components, jnp.unstack(values, axis=1)))
    return values[:, None] if values.ndim == 1 else Components.of(values[:, None])


def patch_cosine(normal: Components, mean: Components, covariance: tuple[Components, ...]) -> tuple[Array, Array]:
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


def is_sampled(lighting: Lighting) -> bool:
    """Whether the samples are so many that they are looped over."""
    return lighting.samples > STORED_SAMPLES


def over_samples(
    model: OneOf,
    points: Points,
    lighting: Lighting,
    of_terms: Callable[[LightTerms], Any],
    *,
    rough: bool = False,
) -> tuple[Any, Float[Array, " P"]]:
    """Add up a function of samples' terms, linear in diffuse and weight, times what the samples emit.

    Of many samples all is done for a tile of pixels and a chunk of samples at a time, which the processor's cache
    holds; what a chunk's samples emit is multiplied with that as a matrix.

    Args:
        model: the class of the material.
        points: any.
        lighting: with at least one light.
        of_terms: gives (S, P) values, in any structure.
        rough: whether products of vectors may be rounded; see `brdf.vectors.Components`.

    Returns:
        The sums in that structure, (P, C) each, and the peak of the lobe.
    """
    points, parts = points.flat(), []
    if is_sampled(lighting):
        return _by_tiles(partial(_over_tile, model, lighting, of_terms), points, rough)
    for emitted, terms in _few_terms(model, points, lighting):
        parts.append((jax.tree.map(partial(_times_emitted, emitted), of_terms(terms)), _peak(terms, emitted)))
    return parts[0] if len(parts) == 1 else functools.reduce(_together, parts)


def _together(one: tuple[Any, Array], other: tuple[Any, Array]) -> tuple[Any, Array]:
    return jax.tree.map(jnp.add, one[0], other[0]), jnp.maximum(one[1], other[1])


def _few_terms(model: OneOf, points: Points, lighting: Lighting) -> Iterator[tuple[Array, LightTerms]]:
    """What the samples of each light emit, (S, C), and their terms."""
    for stack in lighting.stacks:
        for index, emitted in enumerate(stack.emitted()):
            one: Any = jax.tree.map(operator.itemgetter(index), (stack.numbers, stack.nodes, stack.light))
            yield emitted, light_terms(model, lighting, points, stack.kind, *one)


def _many_terms(model: OneOf, points: Points, lighting: Lighting) -> Iterator[tuple[Array, LightTerms]]:
    """The same of all lights of a kind; all samples at once would be made in many steps of their own size."""
    for stack in lighting.stacks:
        nodes, light, emitted = stack.chunks(CHUNK)

        def of_light(one: Any, kind: type[Light] = stack.kind) -> LightTerms:
            numbers, *chunks = one
            return jax.lax.map(lambda chunk: light_terms(model, lighting, points, kind, numbers, *chunk), (*chunks,))

        terms = jax.lax.map(of_light, (stack.numbers, nodes, light))
        yield emitted.reshape(-1, stack.channels), jax.tree.map(lambda leaf: leaf.reshape(-1, leaf.shape[-1]), terms)


def _times_emitted(emitted: Float[Array, "S C"], value: Float[Array, "S P"]) -> Float[Array, "P C"]:
    """The sum over samples of values times what they emit."""
    if len(emitted) > STORED_SAMPLES:
        return _emitted(emitted, value).T
    return functools.reduce(operator.add, (one[:, None] * light for one, light in zip(value, emitted, strict=True)))


def _peak(terms: LightTerms, emitted: Float[Array, "S C"]) -> Float[Array, " P"]:
    shines = (terms.weight > 0) & jnp.any(emitted > 0, axis=1, keepdims=True)
    return jnp.max(jnp.where(shines, terms.log_cosine, NO_LOBE), axis=0)


def _over_tile(
    model: OneOf, lighting: Lighting, of_terms: Callable[[LightTerms], Any], tile: Points
) -> tuple[Any, Array]:
    channels = max(stack.channels for stack in lighting.stacks)
    nothing = jnp.zeros((channels, tile.mask.size), jnp.result_type(*tile.normal))

    def add(total: Any, kind: type[Light], numbers: Any, nodes: Any, light: Array, emitted: Array) -> Any:
        shines = jnp.any(emitted) & (True if kind.weighs is None else jnp.any(nodes[kind.weighs]))

        def add_lit(total: Any) -> Any:
            terms = light_terms(model, lighting, tile, kind, numbers, nodes, light)
            terms = jax.lax.optimization_barrier(terms)  # or each of the sums would make them anew
            return _together(total, (jax.tree.map(partial(_emitted, emitted), of_terms(terms)), _peak(terms, emitted)))

        return jax.lax.cond(shines, add_lit, lambda total: total, total)

    shapes = jax.eval_shape(of_terms, LightTerms(*3 * [nothing[:1]]))
    total = jax.tree.map(lambda _: nothing, shapes), jnp.full(tile.mask.shape, NO_LOBE, nothing.dtype)
    return jax.tree.map(lambda leaf: leaf.T, over_chunks(add, lighting, CHUNK, total))


def over_chunks(add: Callable[..., Any], lighting: Lighting, size: int, total: Any) -> Any:
    """Add up over all samples: ``add(total, kind, numbers, nodes, light, emitted)``, so many samples at a time."""
    for stack in lighting.stacks:

        def add_light(total: Any, one: Any, kind: type[Light] = stack.kind) -> tuple[Any, None]:
            numbers, *chunks = one

            @jax.checkpoint
            def add_chunk(total: Any, chunk: Any) -> tuple[Any, None]:
                return add(total, kind, numbers, *chunk), None

            return jax.lax.scan(add_chunk, total, tuple(chunks))

        total, _ = jax.lax.scan(add_light, total, (stack.numbers, *stack.chunks(size)))
    return total


def _emitted(emitted: Float[Array, "B C"], value: Float[Array, "B P"]) -> Float[Array, "C P"]:
    """The sum over samples of values times what they emit; a product with a matrix of one row would be slow."""
    rows = jnp.pad(emitted.T, ((0, max(0, ROWS - emitted.shape[1])), (0, 0)))
    return jnp.matmul(rows, value, precision="highest")[: emitted.shape[1]]


def _by_tiles(of_tile: Callable[[Points], Any], points: Points, rough: bool) -> Any:
    """``of_tile`` of all points, tile by tile; the last point fills up the last tile."""
    count = points.mask.size
    tiles = -(-count // TILE)
    size = -(-count // tiles)

    def cut(leaf: Array) -> Array:
        whole = leaf if leaf.ndim else jnp.broadcast_to(leaf, (count,))
        padded = jnp.pad(whole, [(0, tiles * size - count)] + [(0, 0)] * (whole.ndim - 1), mode="edge")
        return padded.reshape(tiles, size, *whole.shape[1:])

    def of_cut(tile: Points) -> Any:
        return of_tile(dataclasses.replace(tile, normal=dataclasses.replace(tile.normal, rough=rough)))

    done = jax.lax.map(of_cut, jax.tree.map(cut, points))
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
            points, lighting = self.source
            of_terms = partial(_relative, n, peak)
            (value, slope), _ = over_samples(OneOf((self.model,)), points.in_components(), lighting, of_terms)
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
            terms: Any = _diffuse_and_kept(OneOf.of(self.model), points, self.source[1])[1]
            lobe = dataclasses.replace(
                lobe, source=None, kept=jax.tree.map(lambda a: np.asarray(a)[: pixel.size], terms.kept)
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


def average(weight: Float[Array, "K M"], values: Float[Array, "*N K*M C"]) -> Float[Array, "*N K C"]:
    """The mean of each pixel's points."""
    xp: Any = np if isinstance(values, np.ndarray) else jnp
    return xp.sum(weight[..., None] * values.reshape(*values.shape[:-2], *weight.shape, values.shape[-1]), axis=-2)


def basis_terms(model: type[Material], points: Sight, lighting: Lighting) -> tuple[Float[Array, "P C"], Lobe | None]:
    """The diffuse basis of P points, of any shape, and the specular one where the model has one."""
    values = (
        math.prod(points.shape_of_picture) * lighting.samples * (1 + max(stack.channels for stack in lighting.stacks))
    )
    if is_sampled(lighting) and (values > STACKED_VALUES or not issubclass(model, SpecularMaterial)):
        return _diffuse_and_peak(OneOf((model,)), points.stored().pixels(), lighting)
    return _diffuse_and_kept(OneOf.of(model), points, lighting)


@jax.jit
def _diffuse_and_peak(model: OneOf, points: SurfacePoints, lighting: Lighting) -> tuple[Array, Lobe | None]:
    diffuse, peak = over_samples(model, points.in_components(), lighting, lambda terms: terms.diffuse)
    return diffuse, Lobe(peak, model.lobes[0], source=(points, lighting)) if model.lobes else None


@jax.jit
def _diffuse_and_kept(model: OneOf, points: Sight, lighting: Lighting) -> tuple[Array, Lobe | None]:
    flat, diffuse, kept = points.in_components().flat(), jnp.zeros(()), []
    for emitted, terms in (_many_terms if is_sampled(lighting) else _few_terms)(model, flat, lighting):
        diffuse = diffuse + _times_emitted(emitted, terms.diffuse)
        one = terms.weight.T[..., None] * emitted, terms.log_cosine.T
        # Of few samples each is an array of its own, which takes less time to read.
        kept += [one] if is_sampled(lighting) else zip(*(jnp.split(part, len(emitted), 1) for part in one), strict=True)
    return diffuse, Lobe.of_terms(tuple(kept)) if model.lobes else None


@partial(jax.jit, static_argnames="rough")
def tabulated(
    model: OneOf, points: SurfacePoints, lighting: Lighting, near: Near, *, rough: bool
) -> tuple[Float[Array, "P C"], Float[Array, " P"], Float[Array, "P N C"] | None]:
    """Of (P,) points under many samples the diffuse basis, the peak and the lobe at some exponents, in one pass."""

    def of_terms(terms: LightTerms) -> Any:
        dtype = terms.log_cosine.dtype
        exponent = jnp.minimum(terms.log_cosine - jnp.asarray(near.peak, dtype), 0)
        n = jnp.exp(jnp.asarray(near.log_n)).astype(dtype) if model.lobes else []
        return terms.diffuse, [terms.weight * jnp.exp(one * exponent) for one in n]

    (diffuse, values), peak = over_samples(model, points.in_components(), lighting, of_terms, rough=rough)
    return diffuse, peak, jnp.stack(values, axis=1) if values else None
