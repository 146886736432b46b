"""What rays meet: those of a camera, and those from a point to the lights.

Light without extent casts hard shadows. A sample of an area light or environment stands for a patch of light, and the
edge of a sphere or rectangle sweeps over it: its light fades out over the patch's width, so a soft shadow needs few
samples and shows no steps. A mesh hides a sample or does not. What can cast a shadow is decided when the program is
compiled: a scene whose shapes cannot shadow anything (one sphere, one rectangle) has no shadow rays.

A hard shadow edge has no derivative: gradients by positions of lights and shapes leave out what a moving edge adds.
They are exact for pixels that no edge passes, for soft shadows of spheres and rectangles, and by intensities.
"""

import dataclasses
import functools
from functools import partial
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from brdf.geometry.camera import Camera
from brdf.geometry.shapes import Shape
from brdf.geometry.surface_points import NO_SHAPE, SurfacePoints
from brdf.precision import apart, pytree
from brdf.vectors import Components, largest


@jax.jit
def trace(camera: Camera, shapes: tuple[Shape, ...], column: Any, row: Any) -> SurfacePoints:
    """What the rays through places, in pixels from the picture's left and upper edge, meet first of the shapes.

    A program of its own also inside others: what it does is found out once for all of them.
    """
    origin, direction = camera.rays(column, row)
    far = jnp.full(jnp.broadcast_shapes(jnp.shape(column), jnp.shape(row)), jnp.inf)
    nothing = jnp.zeros(far.shape, bool), jnp.full(far.shape, NO_SHAPE, jnp.int32)
    nearest, has_facets = (far, *nothing, origin, -direction, -direction), False
    for number, shape in enumerate(shapes):
        hit = shape.intersect(origin, direction)
        normal = hit.normal if hit.shading is None else hit.shading
        met = hit.distance, shape.fitted, number, hit.position, normal, hit.normal
        nearest = jax.tree.map(partial(jnp.where, hit.hit & (hit.distance < nearest[0])), met, nearest)
        has_facets |= hit.shading is not None
    _, mask, index, position, normal, facet = nearest
    return SurfacePoints(position, normal, camera.to_view(position), mask, index, facet=facet if has_facets else None)


OFFSET = 300
"""What lies less than so many rounding errors above the surface hides nothing: 4e-5 of the coordinates in float32."""


def share_seen(
    occluders: tuple[Shape, ...], point: SurfacePoints, to_light: Components, distance: Array, radius: Array | None
) -> Array:
    """The share of a light sample that points, in components, see between the shapes: 0 or 1 without a radius.

    All shapes of the scene are given, in its order: a point knows by that which of them it lies on. The radius is the
    angle of the patch of light that the sample stands for.
    """
    position, normal = point.position, point.normal if point.facet is None else point.facet
    size = jnp.maximum(largest(position), largest(-position))
    rounding = float(jnp.finfo(size.dtype).eps)
    before = distance * (1 - 4 * OFFSET * rounding)
    facing = normal @ to_light
    seen = jnp.ones_like(size) if point.facet is None else jnp.where(facing > 0, 1.0, 0.0)
    for index, shape in enumerate(occluders):
        least = jnp.maximum(rounding * size, max(rounding, shape.rounding) * shape.extent())
        least = OFFSET * jax.lax.stop_gradient(least)
        if radius is None and shape.convex:
            # From where it is: from above the surface the edge of a hard shadow would lie elsewhere.
            hit = shape.intersect(position, to_light)
            covered = jnp.where(hit.hit & (hit.distance < before) & (hit.distance * facing > least), 1.0, 0.0)
        else:
            covered = shape.cover(position + normal * least, to_light, before, radius)
        if shape.convex and point.shape is not None:
            covered = jnp.where(point.shape == index, 0.0, covered)  # the horizon has dealt with that
        seen *= 1.0 - covered
    return seen


@pytree
class PrimaryRays:
    """The rays through the pixels' centres, whose `SurfacePoints` are made in each program that asks for them.

    To trace a picture's rays against a few spheres and rectangles takes less time than to keep what they meet.

    Attributes:
        camera: where they begin.
        shapes: what they may meet.
        first: row of the picture; no part of a program, or each band of a large picture would be compiled.
        height: how many rows.
        area: none: the centres stand for the pixels.
    """

    camera: Camera
    shapes: tuple[Shape, ...]
    first: Any
    height: int = dataclasses.field(metadata={"static": True})
    area: ClassVar[None] = None

    @property
    def places(self) -> tuple[Any, Any]:
        """Columns and rows of the pixels' centres."""
        rows = self.first + np.arange(self.height, dtype=np.int32)
        return np.arange(self.camera.resolution[0])[None, :] + 0.5, rows[:, None] + 0.5

    @property
    def count(self) -> int:
        """How many rays there are."""
        return self.camera.resolution[0] * self.height

    def in_components(self) -> SurfacePoints:
        """What they meet, (rows, W), made once however often it is read."""
        return apart(trace, self.camera, self.shapes, *self.places)

    def stored(self) -> SurfacePoints:
        """The same as arrays, to be kept."""
        return surface_points(self.camera, self.shapes, *self.places)

    @functools.cached_property
    @jax.jit
    def mask(self) -> Bool[Array, "rows W"]:
        """Which pixels see a fitted surface."""
        return trace(self.camera, self.shapes, *self.places).mask


Sight = SurfacePoints | PrimaryRays
"""What the pixels of a picture see, for programs: points, or the rays that meet them."""


@jax.jit
def surface_points(camera: Camera, shapes: tuple[Shape, ...], column: Any, row: Any) -> SurfacePoints:
    """What the rays through places of the picture meet first."""
    return apart(lambda *rays: trace(*rays).stacked(), camera, shapes, column, row)
