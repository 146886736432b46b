"""What a camera's rays meet first."""

from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.core import Tracer
from jaxtyping import Array, Int

from brdf.geometry.base import Shape
from brdf.geometry.camera import Camera
from brdf.geometry.surface_points import NO_SHAPE, SurfacePoints
from brdf.precision import apart


def trace(camera: Camera, shapes: tuple[Shape, ...], column: Any, row: Any) -> SurfacePoints:
    """What the rays through places of the picture meet first, columns and rows in pixels from its upper left corner."""
    origins, directions = camera.rays(column, row)
    distance = jnp.full(origins.shape[:-1], jnp.inf)
    mask = jnp.zeros(origins.shape[:-1], bool)
    index = jnp.full(origins.shape[:-1], NO_SHAPE, jnp.int32)
    position, normal, facet, has_facets = origins, -directions, -directions, False
    for number, shape in enumerate(shapes):
        hit = jax.vmap(jax.vmap(shape.intersect))(origins, directions)
        nearer = hit.hit & (hit.distance < distance)
        distance = jnp.where(nearer, hit.distance, distance)
        mask = jnp.where(nearer, shape.fitted, mask)
        index = jnp.where(nearer, number, index)
        position = jnp.where(nearer[..., None], hit.position, position)
        has_facets |= hit.shading is not None
        facet = jnp.where(nearer[..., None], hit.normal, facet)
        normal = jnp.where(nearer[..., None], hit.normal if hit.shading is None else hit.shading, normal)
    to_view = jnp.where(mask[..., None], camera.to_view(position), normal)
    shape = index if len(shapes) > 1 else None
    return SurfacePoints(position, normal, to_view, mask, shape, facet=facet if has_facets else None)


def shapes_met(camera: Camera, shapes: tuple[Shape, ...], column: Any, row: Any) -> Int[Array, "..."]:
    """Index of the shape that each ray meets first, `NO_SHAPE` for none: what is left of `trace` for counting."""
    return trace(camera, shapes, column, row).met


_compiled = eqx.filter_jit(trace)


def tracing(*arguments: Any) -> Callable[..., SurfacePoints]:
    """`trace` as a program of its own, inside a program of its arguments that is being made too."""
    inside = any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(arguments))
    return partial(apart, _compiled) if inside else _compiled
