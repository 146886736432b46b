"""What light samples add up to at a point: the diffuse sum, and the cosine lobe averaged over samples and pixel area.

Renderer and fit share it. Many samples never mean many images in memory: the pass over samples is a loop, and pixels
are taken tile by tile, which also keeps a tile in the processor's cache while its samples pass.
"""

import dataclasses
import functools
import math
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
from brdf.vectors import BELOW_HORIZON, Components

STORED_SAMPLES = 4
"""Up to so many light samples the fit keeps their terms as arrays of their own, of all pixels at once."""

TILE, CHUNK, ROWS = 1 << 12, 32, 3
"""Pixels, and samples, that are dealt with at a time: half a megabyte for each of the few values in between.
And rows from which on XLA's product of two matrices is a quick one."""

STACKED_VALUES = 1 << 26
"""Up to so many values the fit keeps the terms of many samples, too, for few pixels: 256 MiB in float32."""

NODES, STEP, NARROWEST, WIDEST = 5, 0.35, 0.04, 1.0
"""A polynomial through so many exponents stands for a lobe over a range of log n: of 0.7 to 1e-5, of 0.04 to 1e-11. One
through nodes so far apart, where the range is wider than `WIDEST`, to 1e-3, which serves to find where to look."""

NO_LOBE = -1e9
"""The peak of a pixel without a lobe: exp(n * this) = 0 for every n that a fit visits."""


# -- the terms of samples, and their sums ------------------------------------------------------------------------------


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
    sample = kind.sample(point, *row)
    cosine = point.normal @ sample.to_light if sample.cosine is None else sample.cosine
    lit, arrives = point.mask & (cosine > 0), 1.0 if point.share is None else point.share
    if lighting.occluders:
        arrives *= share_seen(lighting.occluders, point, sample.to_light, sample.distance, sample.radius)
    if point.visibility is not None:
        arrives *= point.visibility[:, light].T
    diffuse = sample.intensity * (arrives * jnp.where(lit, cosine, 0))
    weight, log_cosine = jnp.zeros_like(diffuse), jnp.zeros_like(diffuse)
    if model.lobes:
        log_cosine = model.log_cosine(point.normal, sample.to_light, point.to_view)
        shines = lit & (point.normal @ point.to_view > 0) & (log_cosine > 0.5 * BELOW_HORIZON)
        weight = jnp.where(shines, jnp.where(model.cosine_weighted, cosine, sample.above), 0) * arrives
        weight *= sample.intensity if sample.lobe_intensity is None else sample.lobe_intensity
        log_cosine = jnp.where(shines, log_cosine, 0)
    shape = light.size, point.mask.size
    return LightTerms(*(jnp.broadcast_to(part, shape) for part in (diffuse, weight, log_cosine)))


def _in_components(values: Array) -> Any:
    """Numbers of S samples as (S, 1), vectors as components of that form."""
    return values[:, None] if values.ndim == 1 else Components.of(values[:, None])


def is_sampled(lighting: Lighting) -> bool:
    """Whether the samples are so many that they are looped over."""
    return lighting.samples > STORED_SAMPLES


def over_samples(
    model: OneOf, points: Points, lighting: Lighting, of_terms: Callable[[LightTerms], Any]
) -> tuple[Any, Float[Array, " P"]]:
    """Add up a function of samples' terms, linear in diffuse and weight, times what the samples emit.

    Of many samples all is done for a tile of pixels and a chunk of samples at a time, which the processor's cache
    holds; what a chunk's samples emit is multiplied with that as a matrix.

    Args:
        model: the class of the material.
        points: one or several a pixel.
        lighting: with at least one light.
        of_terms: gives (S, P) values, in any structure.

    Returns:
        The sums in that structure, (P, C) each, and the peak of the lobe.
    """
    flat = points.flat()
    if is_sampled(lighting):
        sums, peak = _by_tiles(partial(_over_tile, model, lighting, of_terms), flat)
    else:
        parts = [
            (jax.tree.map(partial(_times_emitted, emitted), of_terms(terms)), _peak(terms, emitted))
            for emitted, terms in _terms(model, flat, lighting)
        ]
        sums, peak = functools.reduce(_together, parts)
    return jax.tree.map(points.per_pixel, sums), jnp.max(peak.reshape(-1, points.each), axis=1)


def _together(one: tuple[Any, Array], other: tuple[Any, Array]) -> tuple[Any, Array]:
    return jax.tree.map(jnp.add, one[0], other[0]), jnp.maximum(one[1], other[1])


def _terms(model: OneOf, points: Points, lighting: Lighting) -> Iterator[tuple[Array, LightTerms]]:
    """Of the lights of each kind what the samples emit, (S, C), and their terms, chunk by chunk."""
    for stack in lighting.stacks:

        def of_light(one: Any, kind: type[Light] = stack.kind) -> LightTerms:
            numbers, *chunks = one
            return jax.lax.map(lambda chunk: light_terms(model, lighting, points, kind, numbers, *chunk), (*chunks,))

        nodes, emitted, light = stack.chunks(CHUNK)
        terms = jax.lax.map(of_light, (stack.numbers, nodes, light))
        yield emitted.reshape(-1, emitted.shape[-1]), jax.tree.map(lambda leaf: leaf.reshape(-1, leaf.shape[-1]), terms)


def _times_emitted(emitted: Float[Array, "S C"], value: Float[Array, "S P"]) -> Float[Array, "P C"]:
    """The sum over samples of values times what they emit."""
    if len(emitted) > STORED_SAMPLES:
        return _emitted(emitted, value).T
    parts = (one[:, None] * light for one, light in zip(value, emitted, strict=True))
    return functools.reduce(jnp.add, parts)


def _peak(terms: LightTerms, emitted: Float[Array, "S C"]) -> Float[Array, " P"]:
    shines = (terms.weight > 0) & jnp.any(emitted > 0, axis=1, keepdims=True)
    return jnp.max(jnp.where(shines, terms.log_cosine, NO_LOBE), axis=0)


def _over_tile(
    model: OneOf, lighting: Lighting, of_terms: Callable[[LightTerms], Any], tile: Points
) -> tuple[Any, Array]:
    nothing = jnp.zeros((lighting.channels, tile.mask.size), jnp.result_type(*tile.normal))

    def add(total: Any, kind: type[Light], numbers: Any, nodes: Any, emitted: Array, light: Array) -> Any:
        def add_lit(total: Any) -> Any:
            terms = light_terms(model, lighting, tile, kind, numbers, nodes, light)
            terms = jax.lax.optimization_barrier(terms)  # or each of the sums would make them anew
            return _together(total, (jax.tree.map(partial(_emitted, emitted), of_terms(terms)), _peak(terms, emitted)))

        return jax.lax.cond(jnp.any(emitted), add_lit, lambda total: total, total)

    shapes = jax.eval_shape(of_terms, LightTerms(*3 * [nothing[:1]]))
    total = jax.tree.map(lambda _: nothing, shapes), jnp.full(tile.mask.shape, NO_LOBE, nothing.dtype)
    return jax.tree.map(lambda leaf: leaf.T, over_chunks(add, lighting, CHUNK, total))


def over_chunks(add: Callable[..., Any], lighting: Lighting, size: int, total: Any) -> Any:
    """Add up over all samples: ``add(total, kind, numbers, nodes, emitted, light)``, so many samples at a time."""
    for stack in lighting.stacks:

        def add_light(total: Any, one: Any, kind: type[Light] = stack.kind) -> tuple[Any, None]:
            numbers, *chunks = one
            add_chunk = jax.checkpoint(lambda total, chunk: (add(total, kind, numbers, *chunk), None))
            return jax.lax.scan(add_chunk, total, (*chunks,))

        total, _ = jax.lax.scan(add_light, total, (stack.numbers, *stack.chunks(size)))
    return total


def _emitted(emitted: Float[Array, "B C"], value: Float[Array, "B P"]) -> Float[Array, "C P"]:
    """The sum over samples of values times what they emit; a product with a matrix of one row would be slow."""
    rows = jnp.pad(emitted.T, ((0, max(0, ROWS - emitted.shape[1])), (0, 0)))
    return jnp.matmul(rows, value, precision="highest")[: emitted.shape[1]]


def _by_tiles(of_tile: Callable[[Points], Any], points: Points) -> Any:
    """``of_tile`` of all points, tile by tile; the last point fills up the last tile."""
    count = points.mask.size
    tiles = -(-count // TILE)
    size = -(-count // tiles)

    def cut(leaf: Array) -> Array:
        whole = leaf if leaf.ndim else jnp.broadcast_to(leaf, (count,))
        padded = jnp.pad(whole, [(0, tiles * size - count)] + [(0, 0)] * (whole.ndim - 1), mode="edge")
        return padded.reshape(tiles, size, *whole.shape[1:])

    done = jax.lax.map(of_tile, jax.tree.map(cut, points))
    return jax.tree.map(lambda leaf: leaf.reshape(tiles * size, *leaf.shape[2:])[:count], done)


# -- the lobe as a function of the exponent ----------------------------------------------------------------------------


class Near(NamedTuple):
    """Exponents at which a lobe of many samples is tabulated, once for all that is asked of it later.

    Attributes:
        log_n: their logarithms, the nodes of Chebyshev over a range, increasing, (N,).
        peak: about the largest logarithm of the lobe's cosine in any pixel, which the values are relative to.
    """

    log_n: Float[Any, " N"]
    peak: Float[Any, ""]

    @property
    def narrow(self) -> bool:
        """Whether the polynomial through them is as good as the lobe itself."""
        return self.log_n.shape[0] == NODES

    @property
    def ends(self) -> tuple[Any, Any]:
        """Logarithms of the exponents between which it serves; the nodes end short of that."""
        low, high = self.log_n[0], self.log_n[-1]
        beyond = 0.5 * (high - low) * (1 / math.cos(0.5 * math.pi / self.log_n.shape[0]) - 1)
        return low - beyond, high + beyond

    @classmethod
    def between(cls, low: float, high: float, peak: float) -> "Near":
        """The nodes between two logarithms of n."""
        count = NODES + (math.ceil((high - low) / STEP) if high - low > WIDEST else 0)
        turn = np.cos(np.pi * (np.arange(count) + 0.5) / count)[::-1]
        # Nodes too close to each other would make slopes of rounding.
        return cls(0.5 * (low + high) + 0.5 * max(high - low, NARROWEST) * turn, np.float64(peak))

    def weights(self, xp: Any, log_n: Any) -> tuple[Any, Any]:
        """What multiplies the values at the nodes to give that of their polynomial, and its derivative, (..., N).

        By the discrete orthogonality of Chebyshev polynomials T_m at their nodes: T_m(cos x) = cos(m x).
        """
        low, high = self.ends
        half, count = 0.5 * (high - low), self.log_n.shape[0]
        u = (xp.clip(log_n, low, high) - 0.5 * (low + high)) / half
        values, slopes = [xp.ones_like(u), u], [xp.zeros_like(u), xp.ones_like(u)]
        for _ in range(count - 2):
            slopes.append(2 * values[-1] + 2 * u * slopes[-1] - slopes[-2])
            values.append(2 * u * values[-1] - values[-2])
        order, place = np.arange(count), np.arange(count)[::-1]
        at_nodes = np.cos(np.outer(order, np.pi * (place + 0.5) / count)) * (2 / count)
        at_nodes[0] /= 2
        of_nodes = xp.asarray(at_nodes, u.dtype)
        return xp.stack(values, axis=-1) @ of_nodes, xp.stack(slopes, axis=-1) @ of_nodes / half


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, eq=False)
class Lobe:
    """The specular basis as a function of the exponent, which a fit evaluates again and again.

    The terms of few light samples, or of few pixels, are kept as arrays; those of many are made anew at each
    evaluation, in bounded memory, or tabulated. Where pixels are averaged over their area, theirs is a finer lobe.
    Arrays of NumPy are evaluated by NumPy.

    Attributes:
        peak: the largest logarithm of the lobe's cosine over the samples, `NO_LOBE` where no sample has one.
        model: the class of the material, where the terms are made anew.
        kept: weights, (P, S, C), and logarithms of the cosine, (P, S), of some samples each.
        source: points and lights that the terms are made of anew; None where they are kept.
        table: values at some exponents, relative to a peak, (P, N, C); None where nothing is tabulated.
        near: what they are tabulated at.
        fine: of those pixels that are averaged; None where no pixel is.
        slot: for every pixel its place in ``fine``, or -1, (P,).
    """

    peak: Float[Array, " P"]
    model: type[Material] | None = dataclasses.field(default=None, metadata={"static": True})
    kept: tuple[tuple[Float[Array, "P S C"], Float[Array, "P S"]], ...] = ()
    source: tuple[SurfacePoints, Lighting] | None = None
    table: Float[Array, "P N C"] | None = None
    near: Near | None = None
    fine: "Lobe | None" = None
    slot: Int[Array, " P"] | None = None

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
        found: Any
        if self.table is not None:
            found = self._interpolated(n, peak)
        elif self.source is not None:
            assert self.model is not None
            points, lighting = self.source
            found, _ = over_samples(OneOf((self.model,)), points.in_components(), lighting, partial(_relative, n, peak))
        else:
            parts = [_summed(n, peak, *terms) for terms in self.kept]
            found = tuple(map(sum, zip(*parts, strict=True)))
        if self.fine is not None:
            found = tuple(averaged(self.slot, *both) for both in zip(found, self.fine(n, peak), strict=True))
        return found

    def _interpolated(self, n: Scalar, peak: Scalar | float) -> tuple[Array, Array]:
        near, table = self.near, self.table
        assert near is not None
        assert table is not None
        xp: Any = np if isinstance(table, np.ndarray) else jnp
        n = xp.asarray(n, float if xp is np else None)
        weights = near.weights(xp, xp.log(n).reshape(-1))
        value, slope = (
            xp.einsum("nk,pkc->npc", one.astype(table.dtype), table).reshape(*n.shape[:-2], *table[:, 0].shape)
            for one in weights
        )
        more = near.peak - peak
        factor = xp.asarray(xp.exp(n * more), table.dtype)
        slope = slope / xp.asarray(n, table.dtype)
        return factor * value, factor * (slope + xp.asarray(more, table.dtype) * value)

    def pixels(self, choose: Callable[[Array], Array]) -> "Lobe":
        """The same for some of the pixels: ``choose`` is applied to each array whose first axis is the pixels."""
        source = None if self.source is None else (jax.tree.map(choose, self.source[0]), self.source[1])
        peak, kept, table, slot = jax.tree.map(choose, (self.peak, self.kept, self.table, self.slot))
        return dataclasses.replace(self, peak=peak, kept=kept, source=source, table=table, slot=slot)

    @property
    def samples(self) -> int:
        """How many light samples add up at a point."""
        if self.table is not None:
            return NODES
        return sum(terms[1].shape[1] for terms in self.kept) if self.source is None else self.source[1].samples

    def on_host(self, pixel: Int[np.ndarray, " K"]) -> "Lobe":
        """The same for some of the pixels, all terms kept in NumPy."""
        # Where they are made anew, of one size for few numbers of pixels, or each would be compiled.
        count = pixel.size if self.source is None else 1 << max(pixel.size - 1, 0).bit_length()
        take = partial(np.take, indices=np.resize(pixel, count), axis=0)
        lobe = jax.tree.map(np.asarray, dataclasses.replace(self, fine=None)).pixels(take)
        if lobe.source is not None:
            assert self.model is not None
            made = diffuse_and_kept(OneOf.of(self.model), *lobe.source)[1]
            lobe = jax.tree.map(np.asarray, made).pixels(lambda leaf: leaf[: pixel.size])
        if self.fine is None:
            return lobe
        slot = take(np.asarray(self.slot))[: pixel.size]
        rows = np.unique(slot[slot >= 0])
        if not rows.size:
            return dataclasses.replace(lobe, slot=None)
        slot = np.where(slot >= 0, np.searchsorted(rows, slot), -1)
        return dataclasses.replace(lobe, fine=self.fine.on_host(rows), slot=slot)

    def over_areas(self, fine: "Lobe", slot: Int[Array, " P"]) -> "Lobe":
        """The lobe where some pixels are averaged: the finer one, and the place of each pixel in it."""
        return dataclasses.replace(self, peak=averaged(slot, self.peak, fine.peak), fine=fine, slot=slot)


def averaged(slot: Any, centre: Any, fine: Any) -> Any:
    """Values at pixels' centres, (P,) or (..., P, C), and in their place those of the pixels that have finer ones."""
    xp: Any = np if isinstance(fine, np.ndarray) else jnp
    axis = 0 if centre.ndim == 1 else -2
    has, there = slot >= 0, xp.take(fine, xp.maximum(slot, 0), axis=axis)
    return xp.where(has if centre.ndim == 1 else has[:, None], there, centre)


def _summed(n: Any, peak: Any, weight: Any, log_cosine: Any) -> Iterator[Any]:
    """The lobe of terms that are kept, and its derivative."""
    xp: Any = np if isinstance(log_cosine, np.ndarray) else jnp
    exponent = xp.minimum(log_cosine - xp.asarray(peak, log_cosine.dtype), 0)
    power = xp.exp(xp.asarray(n, exponent.dtype) * exponent)
    for one in (power, power * exponent):
        if weight.shape[1] == 1:  # NumPy is slow where the last axes are short
            yield one * weight[:, 0]
        else:
            yield np.einsum("...ps,psc->...pc", one, weight) if xp is np else jnp.sum(one[..., None] * weight, axis=-2)


def _relative(n: Scalar, peak: Scalar | float, terms: LightTerms) -> tuple[Array, Array]:
    """What samples add to the lobe relative to a peak, and to its derivative."""
    exponent = jnp.minimum(terms.log_cosine - jnp.asarray(peak, terms.log_cosine.dtype), 0)
    value = terms.weight * jnp.exp(jnp.asarray(n, exponent.dtype) * exponent)
    return value, value * exponent


# -- programs ----------------------------------------------------------------------------------------------------------


def basis_terms(model: type[Material], points: Sight, lighting: Lighting) -> tuple[Float[Array, "P C"], Lobe | None]:
    """The diffuse basis of pixels, and the specular one where the model has one."""
    values = points.count * lighting.samples * (1 + lighting.channels)
    if is_sampled(lighting) and (values > STACKED_VALUES or not issubclass(model, SpecularMaterial)):
        return _diffuse_and_peak(OneOf((model,)), points.stored().pixels(), lighting)
    return diffuse_and_kept(OneOf.of(model), points, lighting)


@jax.jit
def _diffuse_and_peak(model: OneOf, points: SurfacePoints, lighting: Lighting) -> tuple[Array, Lobe | None]:
    diffuse, peak = over_samples(model, points.in_components(), lighting, lambda terms: terms.diffuse)
    return diffuse, Lobe(peak, model.lobes[0], source=(points, lighting)) if model.lobes else None


@jax.jit
def diffuse_and_kept(model: OneOf, sight: Sight, lighting: Lighting) -> tuple[Float[Array, "P C"], Lobe | None]:
    """The diffuse basis of pixels, and the lobe of the terms of all samples."""
    points = sight.in_components()
    diffuse, kept = jnp.zeros(()), []
    for emitted, terms in _terms(model, points.flat(), lighting):
        diffuse = diffuse + _times_emitted(emitted, terms.diffuse)
        weight, log_cosine = terms.weight.T[..., None] * emitted, terms.log_cosine.T
        # Of few samples each is an array of its own, which takes less time to read.
        each = 1 if not is_sampled(lighting) and points.each == 1 else len(emitted)
        for first in range(0, len(emitted), each):
            some = weight[:, first : first + each], log_cosine[:, first : first + each]
            rows = points.mask.size // points.each, points.each * each
            kept.append((some[0].reshape(*rows, -1), some[1].reshape(rows)))
    return points.per_pixel(diffuse), Lobe.of_terms(tuple(kept)) if model.lobes else None


@jax.jit
def tabulated(
    model: OneOf, points: SurfacePoints, lighting: Lighting, near: Near
) -> tuple[Float[Array, "P C"], Float[Array, " P"], Float[Array, "P N C"] | None]:
    """Of (P,) points under many samples the diffuse basis, the peak and the lobe at some exponents, in one pass."""

    def of_terms(terms: LightTerms) -> Any:
        n = jnp.exp(jnp.asarray(near.log_n)).astype(terms.weight.dtype) if model.lobes else []
        return terms.diffuse, [_relative(one, near.peak, terms)[0] for one in n]

    (diffuse, values), peak = over_samples(model, points.in_components(), lighting, of_terms)
    return diffuse, peak, jnp.stack(values, axis=1) if values else None
