"""What a camera's rays meet first."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float, Int

from brdf.geometry.base import Shape
from brdf.geometry.camera import Camera
from brdf.geometry.surface_points import SurfacePoints
from brdf.precision import apart

NO_SHAPE = -1
"""The index of what is no shape: the background, or points that come from elsewhere."""


@eqx.filter_jit
def look(
    camera: Camera,
    shapes: tuple[Shape, ...],
    visibility: tuple[Float[Array, "rows W"] | None, ...] | None = None,
    first: Int[ArrayLike, ""] = 0,
    count: int | None = None,
) -> SurfacePoints:
    """What the centre of each pixel sees.

    Args:
        camera: where the picture is taken from.
        shapes: what it shows.
        visibility: of the lights, where it is given.
        first: row of the picture.
        count: of rows; None for all from the first one on.
    """

    def centres(camera: Camera, shapes: tuple[Shape, ...], first: Int[ArrayLike, ""]) -> SurfacePoints:
        return trace(camera, shapes, visibility, *camera.rays(first, count))

    return apart(centres, camera, shapes, first)


def trace(
    camera: Camera,
    shapes: tuple[Shape, ...],
    visibility: tuple[Float[Array, "*rays"] | None, ...] | None,
    origins: Float[Array, "*rays 3"],
    directions: Float[Array, "*rays 3"],
) -> SurfacePoints:
    """What some rays of a camera meet first.

    Args:
        camera: whose rays they are.
        shapes: what they may meet.
        visibility: of the lights, where it is given.
        origins: of two axes of rays.
        directions: unit vectors.
    """
    distance = jnp.full(origins.shape[:-1], jnp.inf)
    mask = jnp.zeros(origins.shape[:-1], bool)
    index = jnp.full(origins.shape[:-1], NO_SHAPE, jnp.int32)
    position, normal = origins, -directions
    for number, shape in enumerate(shapes):
        hit = jax.vmap(jax.vmap(shape.intersect))(origins, directions)
        nearer = hit.hit & (hit.distance < distance)
        distance = jnp.where(nearer, hit.distance, distance)
        mask = jnp.where(nearer, shape.fitted, mask)
        index = jnp.where(nearer, number, index)
        position = jnp.where(nearer[..., None], hit.position, position)
        normal = jnp.where(nearer[..., None], hit.normal, normal)
    to_view = jnp.where(mask[..., None], camera.to_view(position), normal)
    return SurfacePoints(position, normal, to_view, mask, index if len(shapes) > 1 else None, visibility)


def shapes_met(
    shapes: tuple[Shape, ...], origins: Float[Array, "*rays 3"], directions: Float[Array, "*rays 3"]
) -> Array:
    """Index of the shape that each ray meets first, `NO_SHAPE` for none: what is left of `trace` for counting.

    Args:
        shapes: what they may meet.
        origins: of two axes of rays.
        directions: unit vectors.
    """
    distance = jnp.full(origins.shape[:-1], jnp.inf)
    index = jnp.full(origins.shape[:-1], NO_SHAPE, jnp.int32)
    for number, shape in enumerate(shapes):
        hit = jax.vmap(jax.vmap(shape.intersect))(origins, directions)
        nearer = hit.hit & (hit.distance < distance)
        distance = jnp.where(nearer, hit.distance, distance)
        index = jnp.where(nearer, number, index)
    return index
