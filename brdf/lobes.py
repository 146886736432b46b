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
from numpy.polynomial import chebyshev

from brdf.checks import Scalar
from brdf.geometry.rays import Sight, share_seen
from brdf.geometry.surface_points import SurfacePoints
from brdf.lights.base import Light, Lighting
from brdf.lights.even_sky import Views, seen_under
from brdf.models import MODELS, Material, SpecularMaterial
from brdf.precision import pytree
from brdf.vectors import BELOW_HORIZON, Components, half_log_cosine, mirror_log_cosine

STORED_SAMPLES = 4
"""Up to so many light samples the fit keeps their terms as arrays of their own, of all pixels at once."""

TILE, CHUNK, ROWS = 1 << 12, 64, 3
"""Pixels, and samples, that are dealt with at a time: a megabyte for each of the few values in between.
And rows from which on XLA's product of two matrices is a quick one."""

STACKED_VALUES = 1 << 26
"""Up to so many values the fit keeps the terms of many samples, too, for few pixels: 256 MiB in float32."""

NODES, STEP, NARROWEST, WIDEST = 6, 0.35, 0.04, 1.0
"""A polynomial through so many exponents stands for a lobe over a range of log n: of 0.7 to 4e-6, of 0.04 to 1e-13. One
through nodes so far apart, where the range is wider than `WIDEST`, to 1e-3, which serves to find where to look."""

SHARED = half_log_cosine, mirror_log_cosine
"""Lobes of the models that one program serves."""

NO_LOBE = -1e9
"""The peak of a pixel without a lobe: exp(n * this) = 0 for every n that a fit visits."""


# -- the terms of samples, and their sums ------------------------------------------------------------------------------


@pytree
class OneOf:
    """A model that a program learns when it runs: one program serves all, where making it costs more than running it.

    Attributes:
        models: those it may be.
        index: which of them it is.
    """

    models: tuple[type[Material], ...] = dataclasses.field(metadata={"static": True})
    index: Any = 0

    @classmethod
    def of(cls, model: type[Material]) -> "OneOf":
        """Of all models that have a name and a shared lobe; the model alone where it is none of them."""
        models = tuple(one for one in cls(tuple(MODELS.values())).lobes if one.log_cosine in SHARED)
        return cls(models, np.int32(models.index(model))) if model in models else cls((model,))

    @property
    def lobes(self) -> tuple[type[SpecularMaterial], ...]:
        """The models that have a lobe."""
        return tuple(model for model in self.models if issubclass(model, SpecularMaterial))

    @property
    def log_cosine(self) -> Callable[..., Array]:
        """See `SpecularMaterial.log_cosine`."""
        kinds = list(dict.fromkeys(model.log_cosine for model in self.lobes))
        kind = jnp.array([kinds.index(model.log_cosine) for model in self.lobes])[self.index]
        return partial(jax.lax.switch, kind, kinds)

    def scale(self, n: Array) -> Array:
        """See `SpecularMaterial.scale`."""
        return jax.lax.switch(self.index, [model.scale for model in self.lobes], n)

    @property
    def cosine_weighted(self) -> Array:
        """See `SpecularMaterial`."""
        return jnp.array([model.cosine_weighted for model in self.lobes])[self.index]


class LightTerms(NamedTuple):
    """What light samples of strength 1 add to the basis images at some points, (S, P) each.

    Attributes:
        diffuse: (N·L)+ times the share of the light that arrives.
        weight: that share, times N·L where the model says so, 0 where the lobe is gated.
        log_cosine: logarithm of the lobe's cosine; 0 where the lobe is gated.
    """

    diffuse: Array
    weight: Array
    log_cosine: Array


def light_terms(
    model: OneOf, lighting: Lighting, point: SurfacePoints, kind: type[Light], samples: tuple[Any, Any, Array]
) -> LightTerms:
    """The terms of samples of a kind of light at points, (P,).

    The samples are the light's numbers, (...) each; nodes, (S, ...) each; and which of the scene's lights each of them
    is, (S,).
    """
    numbers, nodes, light = samples
    row = [values[:, None] for values in (*(one[None] for one in numbers), *nodes)]
    sample = kind.sample(point, *(Components.of(one) if one.ndim == 3 else one for one in row))
    cosine = point.normal @ sample.to_light if sample.cosine is None else sample.cosine
    lit, arrives = point.mask & (cosine > 0), 1.0 if point.share is None else point.share
    if lighting.occluders:
        arrives *= share_seen(lighting.occluders, point, sample.to_light, sample.distance, sample.radius)
    if point.visibility is not None:
        arrives *= point.visibility[:, light].T
    diffuse = sample.intensity * (arrives * jnp.where(lit, cosine, 0))
    weight, log_cosine = jnp.zeros_like(diffuse), jnp.zeros_like(diffuse)
    if model.lobes:
        # Of each point, also where a lobe does not ask for the normal.
        log_cosine = jnp.broadcast_to(model.log_cosine(point.normal, sample.to_light, point.to_view), log_cosine.shape)
        shines = lit & (point.normal @ point.to_view > 0) & (log_cosine > 0.5 * BELOW_HORIZON)
        weight = jnp.where(shines, jnp.where(model.cosine_weighted, cosine, sample.above), 0) * arrives
        weight *= sample.intensity if sample.lobe_intensity is None else sample.lobe_intensity
        log_cosine = jnp.where(shines, log_cosine, 0)
    shape = light.size, point.mask.size
    return LightTerms(*(jnp.broadcast_to(part, shape) for part in (diffuse, weight, log_cosine)))


def is_sampled(lighting: Lighting) -> bool:
    """Whether the samples are so many that they are looped over."""
    return lighting.samples > STORED_SAMPLES


def over_samples(model: OneOf, points: SurfacePoints, lighting: Lighting, of_terms: Any) -> tuple[Any, Array]:
    """Add up a function of samples' terms, linear in diffuse and weight, times what the samples emit.

    Of many samples all is done for a tile of pixels and a chunk of samples at a time, which the processor's cache
    holds; what a chunk's samples emit is multiplied with that as a matrix.

    Returns:
        The sums, (P, C) each, in the structure in which ``of_terms`` gives (S, P) values; and the lobe's peak, (P,).
    """

    def added(times: Any, emitted: Array, terms: LightTerms) -> tuple[Any, Array]:
        shines = (terms.weight > 0) & jnp.any(emitted > 0, axis=1, keepdims=True)
        peak = jnp.max(jnp.where(shines, terms.log_cosine, NO_LOBE), axis=0)
        return jax.tree.map(partial(times, emitted), of_terms(terms)), peak

    def together(one: Any, other: Any) -> tuple[Any, Array]:
        return jax.tree.map(jnp.add, one[0], other[0]), jnp.maximum(one[1], other[1])

    def of_tile(tile: SurfacePoints) -> Any:
        def add(total: Any, emitted: Array, *samples: Any) -> Any:
            def add_lit(total: Any) -> Any:
                terms = light_terms(model, lighting, tile, *samples)
                # or each of the sums would make them anew
                return together(total, added(_emitted, emitted, jax.lax.optimization_barrier(terms)))

            return jax.lax.cond(jnp.any(emitted), add_lit, lambda total: total, total)

        nothing = jnp.zeros((lighting.channels, tile.mask.size), jnp.result_type(*tile.normal))
        shapes = jax.eval_shape(of_terms, LightTerms(*3 * [nothing[:1]]))
        total = jax.tree.map(lambda _: nothing, shapes), jnp.full_like(nothing[0], NO_LOBE)
        return jax.tree.map(lambda leaf: leaf.T, over_chunks(add, lighting, CHUNK, total))

    flat, parts = points.flat(), []
    if is_sampled(lighting):
        parts.append(_by_tiles(of_tile, flat))
    else:
        for emitted, program, samples in _programs(model, flat, lighting):
            parts.append(added(_times_emitted, emitted, _joined(jax.lax.map(program, samples))))
    if lighting.sky is not None:
        views, (of_views, peaks) = Views.of(flat), over_samples(model, *seen_under(lighting.sky), of_terms)
        parts.append((jax.tree.map(views.taken, of_views), views.largest(peaks, NO_LOBE)))
    sums, peak = functools.reduce(together, parts)
    return jax.tree.map(points.per_pixel, sums), jnp.max(peak.reshape(-1, points.each), axis=1)


def _programs(
    model: OneOf, points: SurfacePoints, lighting: Lighting
) -> Iterator[tuple[Array, Callable[..., Any], Any]]:
    """Of the lights of each kind what the samples emit, (S, C), what makes terms of a chunk of them, and the chunks."""
    for stack in lighting.stacks:
        emitted, chunks = stack.chunks(CHUNK)
        yield emitted.reshape(-1, emitted.shape[-1]), partial(light_terms, model, lighting, points, stack.kind), chunks


def _joined(terms: LightTerms) -> LightTerms:
    """Of the samples of all chunks, (S, P)."""
    return jax.tree.map(lambda one: one.reshape(-1, one.shape[-1]), terms)


def over_chunks(add: Callable[..., Any], lighting: Lighting, size: int, total: Any) -> Any:
    """Add up over all samples: ``add(total, emitted, kind, samples)``, so many at a time; see `light_terms`."""
    for stack in lighting.stacks:

        @jax.checkpoint
        def add_chunk(total: Any, chunk: Any, kind: type[Light] = stack.kind) -> tuple[Any, None]:
            emitted, samples = chunk
            return add(total, emitted, kind, samples), None

        total, _ = jax.lax.scan(add_chunk, total, stack.chunks(size))
    return total


def _times_emitted(emitted: Array, value: Array) -> Array:
    """The sum over samples of values, (S, P), times what they emit, (S, C), as (P, C)."""
    if len(emitted) > STORED_SAMPLES:
        return _emitted(emitted, value).T
    return functools.reduce(jnp.add, (one[:, None] * light for one, light in zip(value, emitted, strict=True)))


def _emitted(emitted: Array, value: Array) -> Array:
    """The same as (C, P); a product with a matrix of one row would be slow."""
    rows = jnp.pad(emitted.T, ((0, max(0, ROWS - emitted.shape[1])), (0, 0)))
    return jnp.matmul(rows, value, precision="highest")[: emitted.shape[1]]


def _by_tiles(of_tile: Callable[[SurfacePoints], Any], points: SurfacePoints) -> Any:
    """``of_tile`` of all points, tile by tile; the last point fills up the last tile."""
    count = points.mask.size
    tiles = -(-count // TILE)
    size = -(-count // tiles)

    def cut(leaf: Array) -> Array:
        whole = leaf if leaf.ndim else jnp.broadcast_to(leaf, (count,))
        padded = jnp.pad(whole, [(0, tiles * size - count)] + [(0, 0)] * (whole.ndim - 1), mode="edge")
        return padded.reshape(tiles, size, *whole.shape[1:])

    done = jax.lax.map(of_tile, jax.tree.map(cut, points))
    return jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:])[:count], done)


# -- the lobe as a function of the exponent ----------------------------------------------------------------------------


class Near(NamedTuple):
    """Exponents at which a lobe of many samples is tabulated, once for all that is asked of it later.

    Attributes:
        log_n: their logarithms, increasing, (N,): `NODES` exponents equally far apart, so that each lobe is the one
            before times the same; or more, the nodes of Chebyshev over a range of log n.
        peak: about the largest logarithm of the lobe's cosine in any pixel, which the values are relative to.
        fitted: what makes of the values the coefficients of their polynomial in log n by Chebyshev's, (N, N).
    """

    log_n: Any
    peak: Any
    fitted: Any

    @property
    def narrow(self) -> bool:
        """Whether the polynomial through them is as good as the lobe itself."""
        return self.log_n.size == NODES

    @property
    def ends(self) -> tuple[Any, Any]:
        """Logarithms of the exponents between which it serves; the nodes of Chebyshev end short of that."""
        low, high = self.log_n[0], self.log_n[-1]
        beyond = 0.0 if self.narrow else 0.5 * (high - low) * (1 / math.cos(0.5 * math.pi / self.log_n.size) - 1)
        return low - beyond, high + beyond

    @classmethod
    def between(cls, low: float, high: float, peak: float) -> "Near":
        """The nodes between two logarithms of n."""
        # Nodes too close to each other would make slopes of rounding.
        middle, reach = 0.5 * (low + high), 0.5 * max(high - low, NARROWEST)
        if high - low > WIDEST:
            nodes = chebyshev.chebpts1(NODES + math.ceil((high - low) / STEP))
        else:
            nodes = np.log(np.linspace(math.exp(-reach), math.exp(reach), NODES)) / reach
        fitted = np.linalg.inv(chebyshev.chebvander(nodes, nodes.size - 1))
        return cls(middle + reach * nodes, np.float64(peak), fitted)

    def weights(self, xp: Any, log_n: Any) -> tuple[Any, Any]:
        """What multiplies the values at the nodes to give that of their polynomial, and its derivative, (..., N)."""
        count, (low, high) = self.log_n.size, self.ends
        half = 0.5 * (high - low)
        u = (xp.clip(log_n, low, high) - 0.5 * (low + high)) / half
        values = [xp.ones_like(u), u]
        for _ in range(count - 2):
            values.append(2 * u * values[-1] - values[-2])
        polynomials, fitted = xp.stack(values, axis=-1), xp.asarray(self.fitted, u.dtype)
        slopes = xp.asarray(chebyshev.chebder(np.eye(count)), u.dtype) @ fitted
        return polynomials @ fitted, polynomials[..., :-1] @ slopes / half


@pytree
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
        sky: of the angles of view of `brdf.lights.even_sky`, beside the terms that are kept; None without such a sky.
        views: between which of these the pixels are seen.
    """

    peak: Float[Array, " P"]
    model: type[Material] | None = dataclasses.field(default=None, metadata={"static": True})
    kept: tuple[tuple[Array, Array], ...] = ()
    source: tuple[SurfacePoints, Lighting] | None = None
    table: Float[Array, "P N C"] | None = None
    near: Near | None = None
    fine: "Lobe | None" = None
    slot: Int[Array, " P"] | None = None
    sky: "Lobe | None" = None
    views: Views | None = None

    @classmethod
    def of_terms(cls, kept: tuple[tuple[Array, Array], ...]) -> "Lobe":
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
        if self.table is not None and self.near is not None:
            value, slope = _of_table(self.table, self.near, n, peak)
        elif self.source is not None and self.model is not None:
            points, of_terms = self.source[0].in_components(), partial(_relative, n, peak)
            value, slope = over_samples(OneOf((self.model,)), points, self.source[1], of_terms)[0]
        else:
            values, slopes = [], []
            for weight, log_cosine in self.kept:
                power, change = _powers(n, peak, log_cosine)
                values.append(_over_samples(weight, power))
                slopes.append(_over_samples(weight, change))
            if self.sky is not None and self.views is not None:
                for total, part in zip((values, slopes), self.sky(n, peak), strict=True):
                    total.append(self.views.taken(part))
            value, slope = functools.reduce(operator.add, values), functools.reduce(operator.add, slopes)
        if self.fine is None:
            return value, slope
        fine_value, fine_slope = self.fine(n, peak)
        return averaged(self.slot, value, fine_value), averaged(self.slot, slope, fine_slope)

    def pixels(self, choose: Callable[[Any], Any]) -> "Lobe":
        """The same for some of the pixels: ``choose`` is applied to each array whose first axis is the pixels."""
        source = None if self.source is None else (jax.tree.map(choose, self.source[0]), self.source[1])
        own = self.peak, self.kept, self.table, self.slot, self.views
        peak, kept, table, slot, views = jax.tree.map(choose, own)
        return dataclasses.replace(self, peak=peak, kept=kept, source=source, table=table, slot=slot, views=views)

    @property
    def samples(self) -> int:
        """How many light samples add up at a point."""
        if self.source is not None:
            return self.source[1].samples
        between = 0 if self.views is None else self.views.index.shape[1]
        return NODES if self.table is not None else between + sum(log_cosine.shape[1] for _, log_cosine in self.kept)

    def on_host(self, pixel: Int[np.ndarray, " K"]) -> "Lobe":
        """The same for some of the pixels, all terms kept in NumPy."""
        # Where they are made anew, of one size for few numbers of pixels, or each would be compiled.
        count = pixel.size if self.source is None else 1 << max(pixel.size - 1, 0).bit_length()
        filled = np.resize(pixel, count)
        lobe = jax.tree.map(np.asarray, dataclasses.replace(self, fine=None))
        lobe = lobe.pixels(partial(np.take, indices=filled, axis=0))
        if lobe.source is not None and lobe.model is not None:
            made = diffuse_and_kept(OneOf.of(lobe.model), *lobe.source)[1]
            assert made is not None
            lobe = jax.tree.map(np.asarray, dataclasses.replace(made, slot=lobe.slot))
        lobe = lobe.pixels(operator.itemgetter(slice(pixel.size)))
        if self.fine is None:
            return lobe
        slot: Any = lobe.slot
        rows = np.unique(slot[slot >= 0])
        if not rows.size:
            return dataclasses.replace(lobe, slot=None)
        slot = np.where(slot >= 0, np.searchsorted(rows, slot), -1)
        return dataclasses.replace(lobe, fine=self.fine.on_host(rows), slot=slot)


def averaged(slot: Any, centre: Any, fine: Any) -> Any:
    """Values at pixels' centres, (P,) or (..., P, C), and in their place those of the pixels that have finer ones."""
    xp = fine.__array_namespace__()
    axis, has = (0, slot >= 0) if centre.ndim == 1 else (-2, (slot >= 0)[:, None])
    return xp.where(has, xp.take(fine, xp.maximum(slot, 0), axis=axis), centre)


def _powers(n: Any, peak: Any, log_cosine: Any) -> tuple[Any, Any]:
    """The lobe of a cosine relative to a peak, and its derivative."""
    xp = log_cosine.__array_namespace__()
    exponent = xp.minimum(log_cosine - xp.asarray(peak, log_cosine.dtype), 0)
    power = xp.exp(xp.asarray(n, exponent.dtype) * exponent)
    return power, power * exponent


def _relative(n: Any, peak: Any, terms: LightTerms) -> tuple[Array, Array]:
    value, slope = _powers(n, peak, terms.log_cosine)
    return terms.weight * value, terms.weight * slope


def _over_samples(weight: Any, value: Any) -> Any:
    """The sum over samples of values, (..., P, S), times weights, (P, S, C)."""
    if weight.shape[1] == 1:  # NumPy is slow where the last axes are short
        return value * weight[:, 0]
    if isinstance(value, np.ndarray):
        return np.einsum("...ps,psc->...pc", value, weight, optimize=True)  # as matrices: ten times as fast
    return jnp.sum(value[..., None] * weight, axis=-2)


def _of_table(table: Any, near: Near, n: Any, peak: Any) -> tuple[Any, Any]:
    """The lobe and its derivative by the polynomial through what is tabulated."""
    xp = table.__array_namespace__()
    n, dtype = xp.asarray(n, float if xp is np else None), table.dtype
    value, slope = (xp.einsum("...k,pkc->...pc", one.astype(dtype), table) for one in near.weights(xp, xp.log(n)))
    if n.ndim:
        value, slope = value[:, 0, 0], slope[:, 0, 0]
    more = near.peak - peak
    factor = xp.asarray(xp.exp(n * more), dtype)
    return factor * value, factor * (slope / xp.asarray(n, dtype) + xp.asarray(more, dtype) * value)


# -- programs ----------------------------------------------------------------------------------------------------------


@jax.jit
def diffuse_and_peak(model: OneOf, points: SurfacePoints, lighting: Lighting) -> tuple[Array, Lobe | None]:
    """The diffuse basis of pixels, (P, C), and the lobe, where the model has one, of terms that are made anew."""
    diffuse, peak = over_samples(model, points.in_components(), lighting, lambda terms: terms.diffuse)
    return diffuse, Lobe(peak, model.lobes[0], source=(points, lighting)) if model.lobes else None


@jax.jit
def diffuse_and_kept(model: OneOf, sight: Sight, lighting: Lighting) -> tuple[Array, Lobe | None]:
    """The diffuse basis of pixels, and the lobe of the terms of all samples."""
    points = sight.in_components()
    diffuse, kept = jnp.zeros(()), []
    for emitted, program, samples in _programs(model, points.flat(), lighting):
        terms = _joined(jax.lax.map(program, samples))
        diffuse = diffuse + _times_emitted(emitted, terms.diffuse)
        # Of few samples each is an array of its own, which takes less time to read; of an averaged pixel all are one.
        step = len(emitted) if is_sampled(lighting) or points.each > 1 else 1
        for first in range(0, len(emitted), step):
            some = slice(first, first + step)
            weight = (terms.weight[some].T[..., None] * emitted[some]).reshape(-1, points.each * step, emitted.shape[1])
            kept.append((weight, terms.log_cosine[some].T.reshape(weight.shape[:2])))
    lobe = Lobe.of_terms(tuple(kept)) if model.lobes and kept else None
    if lighting.sky is not None:
        views, (of_views, sky) = Views.of(points.flat()), diffuse_and_kept(model, *seen_under(lighting.sky))
        diffuse = diffuse + views.taken(of_views)
        if sky is not None:
            views = views.per_pixel(points.each)
            peak = views.largest(sky.peak, NO_LOBE)
            peak = peak if lobe is None else jnp.maximum(lobe.peak, peak)
            lobe = dataclasses.replace(lobe or Lobe(peak), peak=peak, sky=sky, views=views)
    return points.per_pixel(diffuse), lobe


@jax.jit
def tabulated(
    model: OneOf, points: SurfacePoints, lighting: Lighting, near: Near
) -> tuple[Array, Array, Float[Array, "P N C"] | None]:
    """Of (P,) points under many samples the diffuse basis, the peak and the lobe at some exponents, in one pass."""

    def of_terms(terms: LightTerms) -> Any:
        n = jnp.exp(jnp.asarray(near.log_n)).astype(terms.weight.dtype) if model.lobes else []
        if not model.lobes or not near.narrow:
            return terms.diffuse, [_relative(one, near.peak, terms)[0] for one in n]
        values, step = [_relative(n[0], near.peak, terms)[0]], _powers(n[1] - n[0], near.peak, terms.log_cosine)[0]
        for _ in range(NODES - 1):
            values.append(values[-1] * step)
        return terms.diffuse, values

    (diffuse, values), peak = over_samples(model, points.in_components(), lighting, of_terms)
    return diffuse, peak, jnp.stack(values, axis=1) if values else None
