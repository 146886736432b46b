"""Which lights a point sees: shadow rays against the scene's shapes.

Light without extent casts hard shadows. A sample of an area light or environment stands for a patch of light, and the
edge of a sphere or rectangle sweeps over it: its light fades out over the patch's width, so a soft shadow needs few
samples and shows no steps. A mesh hides a sample or does not. What can cast a shadow is decided when the program is
compiled: a scene whose shapes cannot shadow anything (one sphere, one rectangle) has no shadow rays.

A hard shadow edge has no derivative: gradients by positions of lights and shapes leave out what a moving edge adds.
They are exact for pixels that no edge passes, for soft shadows of spheres and rectangles, and by intensities.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array

from brdf.geometry.base import Shape
from brdf.geometry.surface_points import Points
from brdf.vectors import Components, largest

OFFSET = 300
"""Shadow rays start this many rounding errors above the surface: 4e-5 of the coordinates in float32."""


def share_seen(
    occluders: tuple[Shape, ...], point: Points, to_light: Components, distance: Array, radius: Array | None
) -> Array:
    """The share of a light sample that points see between the shapes: 0 or 1 for a sample without a radius.

    All shapes of the scene are given, in its order: a point knows by that which of them it lies on.

    Args:
        occluders: the shapes.
        point: in components.
        to_light: unit direction of the sample.
        distance: of the sample.
        radius: the angle of the patch of light that the sample stands for, or None.
    """
    position, normal = point.position, point.normal if point.facet is None else point.facet
    size = jnp.maximum(largest(position), largest(-position))
    rounding = OFFSET * jnp.finfo(size.dtype).eps
    before = distance * (1 - 4 * rounding)
    seen = jnp.ones_like(size) if point.facet is None else jnp.where(normal @ to_light > 0, 1.0, 0.0)
    for index, shape in enumerate(occluders):
        start = position + normal * jax.lax.stop_gradient(rounding * jnp.maximum(size, shape.extent()))
        if radius is None:
            covered = shape.cover(start, to_light, before)
        else:
            covered = shape.cover_patch(start, to_light, before, radius)
        if shape.convex and point.shape is not None:
            covered = jnp.where(point.shape == index, 0.0, covered)  # the horizon has dealt with that
        seen *= 1.0 - covered
    return seen
