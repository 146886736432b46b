"""Which lights a point sees: shadow rays against the scene's shapes, or masks that are given.

Light without extent casts hard shadows. A sample of an area light or environment stands for a patch of light, and the
edge of a sphere or rectangle sweeps over it: its light fades out over the patch's width, so a soft shadow needs few
samples and shows no steps. A mesh hides a sample or does not. What can cast a shadow is decided when the program is
compiled: a scene whose shapes cannot shadow anything (one sphere, one rectangle) has no shadow rays.

A hard shadow edge has no derivative: gradients by positions of lights and shapes leave out what a moving edge adds.
They are exact for pixels that no edge passes, for soft shadows of spheres and rectangles, and by intensities.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from brdf.errors import InputError
from brdf.geometry.base import Shape
from brdf.geometry.surface_points import SurfacePoints
from brdf.lights.punctual import Light, LightSample

OFFSET = 300
"""Shadow rays start this many rounding errors above the surface: 4e-5 of the coordinates in float32."""


class Lighting(eqx.Module):
    """The lights, and the shapes that stand in their way.

    Attributes:
        lights: the lights.
        occluders: the scene's shapes in its order; none where they cannot shadow anything that is seen.
    """

    lights: tuple[Light, ...]
    occluders: tuple[Shape, ...] = ()


def occluders(shapes: tuple[Shape, ...], *, traced: bool) -> tuple[Shape, ...]:
    """The shapes that can cast a shadow on what is seen.

    Args:
        shapes: of the scene.
        traced: whether the surface points lie on them.
    """
    return () if traced and len(shapes) == 1 and shapes[0].convex else tuple(shapes)


def share_seen(occluders: tuple[Shape, ...], point: SurfacePoints, sample: LightSample) -> Float[Array, ""]:
    """The share of a light sample that a point sees between the shapes: 0 or 1 for a sample without extent.

    Args:
        occluders: at least one; all shapes of the scene, in its order.
        point: one surface point.
        sample: what the light sends there.
    """
    position, normal = point.position, point.normal
    size = jnp.max(jnp.abs(position))
    rounding = OFFSET * jnp.finfo(jnp.result_type(position)).eps
    seen = jnp.ones_like(size)
    for index, shape in enumerate(occluders):
        start = position + jax.lax.stop_gradient(rounding * jnp.maximum(size, shape.extent())) * normal
        covered = shape.cover(start, sample.to_light, sample.distance * (1 - 4 * rounding), sample.radius)
        if shape.convex and point.shape is not None:
            covered = jnp.where(point.shape == index, 0.0, covered)  # the horizon has dealt with that
        seen *= 1.0 - covered
    return seen


def given_visibility(value: Any) -> tuple[Any, ...]:
    """A converter for given shadow masks: (H, W) values from 0 to 1, or None, one for each light."""
    return tuple(None if mask is None else _mask(mask) for mask in value)


def _mask(mask: Any) -> Any:
    if isinstance(mask, jax.Array):
        return mask
    array = np.asarray(mask, dtype=np.float64)
    if array.ndim != 2:
        raise InputError("visibility", f"must be of shape (H, W), got {array.shape}", "Give a value per pixel")
    if not np.all((array >= 0) & (array <= 1)):
        came = f"must lie between 0 and 1, got {np.min(array):g} to {np.max(array):g}"
        raise InputError("visibility", came, "Give the share of the light that each pixel sees")
    return array
