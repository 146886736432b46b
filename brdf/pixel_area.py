"""A pixel is an area: where its centre does not stand for it, several points do.

Photographs and renderers average over a pixel. Almost everywhere the picture is so smooth that the centre's value is
that average; it is not where an edge passes (of a shape, of a hard shadow, of the light's horizon) and where a
highlight is narrow against the pixel. Only there a pixel gets k × k points, those of a Gauss-Legendre rule,
and where an edge passes the share of the pixel that each shape covers is counted by 3 k × 3 k further rays.

Which pixels need it does not depend on the exponent: at the distance x from a lobe's centre no exponent's lobe is off
by more than 0.05 (p/x)² of its peak for a pixel of size p (the largest second derivative of exp(-n x²/2) over all n,
times p²/24). Pixels with p/x above `NARROW` are averaged. Lights with an extent are left out of this: a lobe that their
samples resolve is wider than a pixel.

Where camera, shapes or lights are being differentiated, which pixels need it cannot be asked, and all of them get k × k
points.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float, Int

from brdf.geometry.base import Shape
from brdf.geometry.camera import Camera
from brdf.geometry.rays import NO_SHAPE, shapes_met, trace
from brdf.geometry.surface_points import PixelArea, SurfacePoints
from brdf.geometry.visibility import Lighting, share_seen
from brdf.light_sum import STORED_SAMPLES, nodes_of, sample_count
from brdf.lights.punctual import Place
from brdf.lights.sample_sets import square_rule
from brdf.precision import apart
from brdf.vectors import dot, half_log_cosine

NARROW = 0.2
"""Pixel size over distance from a lobe's centre from which on a pixel is averaged: 0.2 % of the lobe's peak."""

BENT = 0.9
"""Cosine between neighbouring normals of a mesh below which there is an edge between them."""


def with_area(points: SurfacePoints, camera: Camera, shapes: tuple[Shape, ...], lighting: Lighting) -> SurfacePoints:
    """Add the points of those pixels that their centres do not stand for.

    Args:
        points: (H, W) what the centres see.
        camera: whose ``samples`` says how many points a pixel gets along each side.
        shapes: of the scene.
        lighting: lights and occluders.
    """
    count = points.mask.size
    if any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves((points, camera, shapes, lighting))):
        return _averaged(points, camera, shapes, np.arange(count, dtype=np.int32), np.zeros(0, np.int32))
    edge, other = np.asarray(_matters(points, camera, shapes, lighting)).reshape(2, count)
    return _averaged(points, camera, shapes, *(_padded(np.flatnonzero(mask), count) for mask in (edge, other & ~edge)))


def _padded(pixel: Int[np.ndarray, " K"], count: int) -> Int[np.ndarray, " padded"]:
    """The pixels and some that are not there, so that few different sizes come up and few programs are compiled."""
    step = 1 << max(4, int(max(len(pixel), 1) - 1).bit_length() - 2)
    padded = np.full(step * -(-len(pixel) // step), count, np.int32)
    padded[: len(pixel)] = pixel
    return padded


def _neighbours_differ(values: Array, differ: Any = jnp.not_equal) -> Bool[Array, "H W"]:
    """Whether any of a pixel's four neighbours differs from it."""
    down, right = differ(values[1:], values[:-1]), differ(values[:, 1:], values[:, :-1])
    found = jnp.zeros(values.shape[:2], bool)
    found = found.at[1:].max(down).at[:-1].max(down)
    return found.at[:, 1:].max(right).at[:, :-1].max(right)


@eqx.filter_jit
def _matters(
    points: SurfacePoints, camera: Camera, shapes: tuple[Shape, ...], lighting: Lighting
) -> Bool[Array, "2 H W"]:
    """Through which pixels an edge of a shape passes, and which others are to be averaged."""
    width, height = camera.resolution
    x = jnp.arange(width + 1) * 2.0 / width - 1.0
    y = height / width - jnp.arange(height + 1) * 2.0 / width
    corners = apart(shapes_met, shapes, *camera.rays_through(x[None, :], y[:, None]))
    one = corners[1:, 1:]
    edge = jnp.zeros(one.shape, bool)
    for other in (corners[:-1, :-1], corners[1:, :-1], corners[:-1, 1:]):
        edge |= other != one
    centre = jnp.where(points.mask, 0, NO_SHAPE) if points.shape is None else points.shape
    if points.shape is not None or all(shape.fitted for shape in shapes):
        edge |= centre != one if points.shape is not None else (centre == NO_SHAPE) != (one == NO_SHAPE)
    matters = jnp.zeros_like(edge)
    if not all(shape.convex for shape in shapes):
        matters |= points.mask & _neighbours_differ(points.normal, lambda a, b: dot(a, b) < BENT)
    for index, light in enumerate(lighting.lights):
        if sample_count(light) <= STORED_SAMPLES:
            matters |= points.mask & _light_matters(points, lighting, index)
    return jnp.stack([edge, matters])


def _light_matters(points: SurfacePoints, lighting: Lighting, index: int) -> Bool[Array, "H W"]:
    """Whether a highlight is narrow or a light's edge passes."""
    light = lighting.lights[index]
    node = jax.tree.map(lambda leaf: leaf[0], nodes_of(light, points))

    def at_point(point: SurfacePoints) -> tuple[Array, Array]:
        sample = light.illuminate(node, Place(point.position, point.normal, point.to_view))
        lit = (dot(point.normal, sample.to_light) > 0) & jnp.any(sample.intensity > 0)
        if lighting.occluders:
            lit &= share_seen(lighting.occluders, point, sample) > 0
        return lit, half_log_cosine(point.normal, sample.to_light, point.to_view)

    lit, log_cosine = jax.vmap(jax.vmap(at_point))(eqx.tree_at(lambda p: p.visibility, points, None, is_leaf=_is_none))
    steps = jnp.zeros_like(log_cosine)
    for axis in (0, 1):
        change = jnp.abs(jnp.diff(log_cosine, axis=axis))
        first, second = [(slice(1, None),), (slice(None, -1),)]
        whole = (slice(None),) * axis
        steps = steps.at[whole + first].max(change).at[whole + second].max(change)
    narrow = lit & (steps > 2 * NARROW * jnp.abs(log_cosine))
    return narrow | _neighbours_differ(lit)


def _is_none(value: Any) -> bool:
    return value is None


@eqx.filter_jit
def _averaged(points: SurfacePoints, camera: Camera, shapes: tuple[Shape, ...], edge: Any, other: Any) -> SurfacePoints:
    """The points of the given pixels, those with an edge first, beside those of the centres."""
    count = points.mask.size
    pixel = jnp.concatenate([edge, other])
    rule = square_rule(camera.samples**2)
    origins, directions = camera.rays_through(*camera.places_in_pixels(pixel, jnp.asarray(rule.s), jnp.asarray(rule.t)))
    visibility = points.visibility
    if visibility is not None:
        visibility = tuple(None if mask is None else _spread(mask, pixel, rule.s.size) for mask in visibility)
    fine = apart(trace, camera, shapes, visibility, origins, directions)
    met = jnp.where(fine.mask, 0, NO_SHAPE) if fine.shape is None else fine.shape
    side = 3 * camera.samples
    steps = (jnp.arange(side) + 0.5) / side
    right, down = (grid.ravel() for grid in jnp.meshgrid(steps, steps))
    counted = apart(shapes_met, shapes, *camera.rays_through(*camera.places_in_pixels(jnp.asarray(edge), right, down)))
    weight = jnp.broadcast_to(jnp.asarray(rule.weight, fine.position.dtype), met.shape)
    weight = jnp.concatenate(
        [_by_shares(weight[: edge.size], met[: edge.size], counted, len(shapes)), weight[edge.size :]]
    )
    used = pixel < count
    weight = jnp.where(used[:, None], weight, 0.0)
    slot = jnp.full(count, -1, jnp.int32).at[pixel].set(jnp.arange(pixel.size, dtype=jnp.int32), mode="drop")
    fitted = jnp.array([shape.fitted for shape in shapes] + [False])  # the last is NO_SHAPE
    whole = jnp.all(fine.mask, axis=1).at[: edge.size].min(jnp.all(fitted[counted], axis=1))
    mask = points.mask.ravel().at[pixel].set(whole, mode="drop").reshape(points.mask.shape)
    area = PixelArea(pixel, slot.reshape(points.mask.shape), fine, weight)
    return eqx.tree_at(lambda p: (p.mask, p.area), points, (mask, area), is_leaf=_is_none)


def _by_shares(
    weight: Float[Array, "K M"], met: Int[Array, "K M"], counted: Int[Array, "K N"], shapes: int
) -> Float[Array, "K M"]:
    """Weights that give each shape the share of the pixel that was counted."""
    result = jnp.zeros_like(weight)
    for index in range(NO_SHAPE, shapes):
        mine = met == index
        share = jnp.mean(counted == index, axis=1, dtype=weight.dtype)
        total = jnp.sum(jnp.where(mine, weight, 0.0), axis=1)
        result = jnp.where(mine, weight * (share / jnp.where(total > 0, total, 1.0))[:, None], result)
    return result


def _spread(mask: Float[Array, "H W"], pixel: Int[Array, " K"], samples: int) -> Float[Array, "K M"]:
    """A pixel's value for each of its points."""
    return jnp.broadcast_to(jnp.take(jnp.asarray(mask).ravel(), pixel, mode="clip")[:, None], (pixel.size, samples))
