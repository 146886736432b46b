"""The sum over light samples: what each adds to the basis images at one point, and the pass that adds it up.

Many samples never mean many images in memory: the pass over samples is a scan, and pixels are taken tile by tile, which
also keeps a tile in the processor's cache while its samples pass.
"""

from collections.abc import Callable, Iterator
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from brdf.geometry.surface_points import SurfacePoints
from brdf.geometry.visibility import Lighting, share_seen
from brdf.lights.punctual import Light, LightSample, Moments, Place
from brdf.models import Material, SpecularMaterial
from brdf.vectors import BELOW_HORIZON, divide, dot, square_root

STORED_SAMPLES = 4
"""Up to so many light samples the fit keeps their terms as arrays; beyond, it makes them anew at each exponent."""

TILE = 8192
"""Pixels that many samples pass over at a time."""

STACKED_VALUES = 1 << 26
"""Up to so many values the fit keeps the terms of many samples, too, for few pixels: 256 MiB in float32."""


class LightTerms(eqx.Module):
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
    model: type[Material], point: SurfacePoints, sample: LightSample, lighting: Lighting, index: int
) -> LightTerms:
    """The terms of one light sample at one point.

    Args:
        model: the class of the material; its values are not needed.
        point: one surface point.
        sample: what the light sends there.
        lighting: whose occluders may stand in between.
        index: of the light.
    """
    cosine, above = _cosine(point, sample)
    lit = point.mask & (cosine > 0)
    intensity = sample.intensity
    if lighting.occluders:
        intensity = intensity * share_seen(lighting.occluders, point, sample)
    given = None if point.visibility is None else point.visibility[index]
    if given is not None:
        intensity = intensity * given
    matt = lit if sample.lobe_only is None else lit & (sample.lobe_only == 0)
    diffuse = intensity * jnp.where(matt, cosine, 0)
    if not issubclass(model, SpecularMaterial):
        return LightTerms(diffuse, jnp.zeros_like(diffuse), jnp.zeros_like(cosine))
    log_cosine = model.log_cosine(point.normal, sample.to_light, point.to_view)
    glossy = lit if sample.lobe_only is None else lit & (sample.lobe_only > 0)
    shines = glossy & (dot(point.normal, point.to_view) > 0) & (log_cosine > 0.5 * BELOW_HORIZON)
    weight = intensity * jnp.where(shines, cosine if model.cosine_weighted else above, 0)
    return LightTerms(diffuse, weight, jnp.where(shines, log_cosine, 0))


def _cosine(point: SurfacePoints, sample: LightSample) -> tuple[Array, Array]:
    """(N·L)+, negative or 0 below the horizon, and the share of the sample's light above the horizon."""
    if sample.moments is None:
        cosine = dot(point.normal, sample.to_light)
        return cosine, jnp.ones_like(cosine)
    return patch_cosine(point.normal, sample.moments)


def patch_cosine(normal: Float[Array, "3"], moments: Moments) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Mean of (N·L)+ over a patch of the sky, and the share of its light above the horizon.

    Exact where the patch does not cross the horizon. Where it does, N·L is taken to be spread by the parabola
    3/4 (1 - x²) that has the patch's mean and variance.

    Args:
        normal: unit, (3,).
        moments: of the patch's directions.
    """
    mean = dot(normal, moments.mean)
    half_width = square_root(5.0 * dot(normal, moments.covariance @ normal))
    x = divide(mean, half_width)
    crosses = (half_width > 0) & (jnp.abs(x) < 1)
    x = jnp.where(crosses, x, 0.0)
    partly = half_width * (3 / 16 + x * (1 / 2 + x * (3 / 8 - x * x / 16)))
    share = 1 / 2 + x * (3 / 4 - x * x / 4)
    return jnp.where(crosses, partly, mean), jnp.where(crosses, share, 1.0)


def _terms_of_node(
    model: type[Material], points: SurfacePoints, lighting: Lighting, index: int, node: Any
) -> LightTerms:
    light = lighting.lights[index]

    def at_point(point: SurfacePoints) -> LightTerms:
        sample = light.illuminate(node, Place(point.position, point.normal, point.to_view))
        return light_terms(model, point, sample, lighting, index)

    return jax.vmap(at_point)(points)


def nodes_of(light: Light, points: SurfacePoints) -> Any:
    """The nodes of a light in the precision of the points.

    Args:
        light: any light.
        points: surface points.
    """
    dtype = jnp.asarray(points.position).dtype
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype), light.nodes())


def each_sample(model: type[Material], points: SurfacePoints, lighting: Lighting) -> Iterator[LightTerms]:
    """The terms of one light sample after the other, for few of them.

    Args:
        model: the class of the material.
        points: (P,) surface points.
        lighting: lights and occluders.
    """
    for number, light in enumerate(lighting.lights):
        nodes = nodes_of(light, points)
        for index in range(sample_count(light)):
            node = jax.tree.map(lambda leaf, i=index: leaf[i], nodes)
            yield _terms_of_node(model, points, lighting, number, node)


def sample_count(light: Light) -> int:
    """The number of samples of a light.

    Args:
        light: any light.
    """
    nodes = jax.eval_shape(light.nodes)
    return jax.tree.leaves(nodes)[0].shape[0]


def light_channels(light: Light) -> int:
    """The number of channels that a light shines in: a map may have more than its emittance.

    Args:
        light: any light.
    """
    at = jnp.zeros(3)

    def sample() -> Array:
        return light.illuminate(
            jax.tree.map(lambda leaf: jnp.asarray(leaf)[0], light.nodes()), Place(at, at, at)
        ).intensity

    return jax.eval_shape(sample).shape[0]


def sum_over_samples(
    model: type[Material],
    points: SurfacePoints,
    lighting: Lighting,
    of_terms: Any,
    *,
    combine: Any = jnp.add,
    start: float = 0.0,
) -> Any:
    """Combine a function of the light terms over all samples, never holding more than one sample's images.

    Args:
        model: the class of the material.
        points: (P,) surface points.
        lighting: lights, at least one, and occluders.
        of_terms: from the `LightTerms` of one sample to a pytree of (P, ...) arrays.
        combine: how two values become one.
        start: what `combine` starts from.
    """

    def of_tile(points: SurfacePoints) -> Any:
        return _sum_over_samples(model, points, lighting, of_terms, combine, start)

    few = sum(map(sample_count, lighting.lights)) <= STORED_SAMPLES
    return of_tile(points) if few else over_tiles(of_tile, points)


def stacked_terms(
    model: type[Material], points: SurfacePoints, lighting: Lighting
) -> tuple[Float[Array, "P C"], Float[Array, "P S C"], Float[Array, "P S"]]:
    """The terms of all samples at once: the sum of the diffuse ones, and weights and cosines of the lobe.

    Args:
        model: the class of the material.
        points: (P,) surface points.
        lighting: lights, at least one, and occluders.
    """

    def of_tile(points: SurfacePoints) -> tuple[Array, Array, Array]:
        each = []
        for index, light in enumerate(lighting.lights):

            def of_node(carry: None, node: Any, index: int = index) -> tuple[None, LightTerms]:
                return carry, _terms_of_node(model, points, lighting, index, node)

            each.append(jax.lax.scan(of_node, None, nodes_of(light, points))[1])
        channels = max(terms.weight.shape[-1] for terms in each)
        wide = [jnp.broadcast_to(terms.weight, (*terms.weight.shape[:-1], channels)) for terms in each]
        diffuse = sum((jnp.sum(terms.diffuse, axis=0) for terms in each[1:]), start=jnp.sum(each[0].diffuse, axis=0))
        log_cosine = jnp.concatenate([terms.log_cosine for terms in each])
        return diffuse, jnp.moveaxis(jnp.concatenate(wide), 0, 1), log_cosine.T

    return over_tiles(of_tile, points)


def over_tiles(function: Callable[[Any], Any], tree: Any) -> Any:
    """``function(tree)``, tile after tile along the first axis.

    Args:
        function: from arrays (P, ...) to arrays (P, ...), row by row.
        tree: arrays of one first axis.
    """
    count = jax.tree.leaves(tree)[0].shape[0]
    if count <= TILE:
        return function(tree)
    tiles = -(-count // TILE)
    size = -(-count // tiles)

    def cut(leaf: Array) -> Array:
        padded = jnp.concatenate([leaf, jnp.broadcast_to(leaf[-1:], (tiles * size - count, *leaf.shape[1:]))])
        return padded.reshape(tiles, size, *leaf.shape[1:])

    done = jax.lax.map(function, jax.tree.map(cut, tree))
    return jax.tree.map(lambda leaf: leaf.reshape(tiles * size, *leaf.shape[2:])[:count], done)


def _sum_over_samples(
    model: type[Material], points: SurfacePoints, lighting: Lighting, of_terms: Any, combine: Any, start: float
) -> Any:
    total = None
    for index, light in enumerate(lighting.lights):
        nodes = nodes_of(light, points)
        first = jax.tree.map(lambda leaf: leaf[0], nodes)

        def of_node(node: Any, index: int = index) -> Any:
            return of_terms(_terms_of_node(model, points, lighting, index, node))

        if sample_count(light) == 1:
            value = of_node(first)
            total = value if total is None else jax.tree.map(combine, total, value)
            continue
        shapes = jax.eval_shape(of_node, first)
        if total is None:
            total = jax.tree.map(lambda leaf: jnp.full(leaf.shape, start, leaf.dtype), shapes)
        # a light of fewer channels than those before it
        total = jax.tree.map(lambda t, s: jnp.broadcast_to(t, np.broadcast_shapes(t.shape, s.shape)), total, shapes)
        step = jax.checkpoint(lambda carry, node, of_node=of_node: (jax.tree.map(combine, carry, of_node(node)), None))
        total, _ = jax.lax.scan(step, total, nodes)
    return total
