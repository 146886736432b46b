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

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array

from brdf.geometry.camera import Camera
from brdf.geometry.rays import surface_points, trace
from brdf.geometry.shapes import Shape
from brdf.geometry.surface_points import NO_SHAPE, PixelArea, SurfacePoints
from brdf.lights.base import Light, Lighting, stacked
from brdf.lights.sample_sets import square_rule
from brdf.lobes import STORED_SAMPLES, OneOf, light_terms, over_chunks
from brdf.models import BlinnPhong
from brdf.precision import apart
from brdf.vectors import dot

NARROW = 0.05
"""Pixel size over distance from a lobe's centre from which on a pixel is averaged: 0.01 % of the lobe's peak."""

BENT = 0.9
"""Cosine between neighbouring normals of a mesh below which there is an edge between them."""


def with_area(
    points: SurfacePoints,
    camera: Camera,
    shapes: tuple[Shape, ...],
    lights: Sequence[Light],
    occluders: tuple[Shape, ...],
) -> SurfacePoints:
    """Add the points of those pixels that their centres do not stand for."""
    count = points.count
    if any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves((points, camera, shapes, lights))):
        return _averaged(points, camera, shapes, np.arange(count, dtype=np.int32), np.zeros(0, np.int32))
    index = [place for place, light in enumerate(lights) if light.rows[1][0].shape[0] <= STORED_SAMPLES]
    sharp = stacked([lights[place] for place in index], points.position.dtype, index=index)
    edge, other = np.asarray(_matters(points, camera, shapes, Lighting(sharp, occluders))).reshape(2, count)
    return _averaged(points, camera, shapes, _padded(edge), _padded(other & ~edge))


def _padded(mask: np.ndarray) -> np.ndarray:
    """The pixels and some that are not there, so that few different sizes come up and few programs are compiled."""
    pixel = np.flatnonzero(mask)
    step = 1 << max(4, int(max(len(pixel), 1) - 1).bit_length() - 2)
    return np.pad(pixel, (0, -len(pixel) % step), constant_values=mask.size).astype(np.int32)


def _over_neighbours(change: Any, values: Array) -> Array:
    """The largest change, or whether there is any, between a pixel and its four neighbours."""
    down, right = change(values[1:], values[:-1]), change(values[:, 1:], values[:, :-1])
    found = jnp.zeros(values.shape[:2], down.dtype)
    found = found.at[1:].max(down).at[:-1].max(down)
    return found.at[:, 1:].max(right).at[:, :-1].max(right)


@jax.jit
def _matters(points: SurfacePoints, camera: Camera, shapes: tuple[Shape, ...], lighting: Lighting) -> Array:
    """Through which pixels an edge of a shape passes, and which others are to be averaged."""
    column, row = (np.arange(size + 1.0) for size in camera.resolution)
    corners = apart(lambda *rays: trace(*rays).shape, camera, shapes, column[None], row[:, None])
    seen = [corners[:-1, :-1], corners[1:, :-1], corners[:-1, 1:], corners[1:, 1:], points.met]
    edge = functools.reduce(jnp.logical_or, (one != seen[0] for one in seen))
    matters = jnp.zeros_like(edge)
    if not all(shape.convex for shape in shapes):
        matters |= _over_neighbours(lambda a, b: dot(a, b) < BENT, points.normal)
    flat = points.in_components().flat()

    def or_sample(found: Array, emitted: Array, *samples: Any) -> Array:
        """Whether a highlight is narrow or a light's edge passes."""
        terms = light_terms(OneOf((BlinnPhong,)), lighting, flat, *samples)
        lit = ((terms.diffuse > 0) & jnp.any(emitted > 0)).reshape(edge.shape)
        log_cosine = terms.log_cosine.reshape(edge.shape)
        narrow = _over_neighbours(lambda a, b: jnp.abs(a - b), log_cosine) > 2 * NARROW * jnp.abs(log_cosine)
        return found | (lit & narrow) | _over_neighbours(jnp.not_equal, lit)

    return jnp.stack([edge, over_chunks(or_sample, lighting, 1, matters) & points.mask])


@jax.jit
def _averaged(points: SurfacePoints, camera: Camera, shapes: tuple[Shape, ...], edge: Any, other: Any) -> SurfacePoints:
    """The points of the given pixels, those with an edge first, beside those of the centres."""
    pixel = jnp.concatenate([edge, other])
    width, count, edges = camera.resolution[0], points.count, edge.size
    rule, side = square_rule(camera.samples**2), (np.arange(3 * camera.samples) + 0.5) / (3 * camera.samples)
    column, row = (pixel % width)[:, None], (pixel // width)[:, None]
    fine = surface_points(camera, shapes, column + rule.s, row + rule.t)
    right, down = (grid.ravel() for grid in np.meshgrid(side, side))
    counted = apart(lambda *rays: trace(*rays).shape, camera, shapes, column[:edges] + right, row[:edges] + down)
    share = jnp.broadcast_to(jnp.asarray(rule.weight, fine.position.dtype), fine.mask.shape)
    share = share.at[:edges].set(_by_shares(share[:edges], fine.met[:edges], counted, len(shapes)))
    share = jnp.where((pixel < count)[:, None], share, 0.0)
    visibility = points.visibility
    if visibility is not None:
        seen = jnp.take(visibility.reshape(count, 1, -1), pixel, axis=0, mode="clip")
        visibility = jnp.broadcast_to(seen, (*share.shape, seen.shape[-1]))
    fine = dataclasses.replace(fine, share=share, visibility=visibility)
    slot = jnp.full(count, -1, jnp.int32).at[pixel].set(jnp.arange(pixel.size, dtype=jnp.int32), mode="drop")
    fitted = jnp.array([shape.fitted for shape in shapes] + [False])  # the last is NO_SHAPE
    whole = jnp.all(fine.mask, axis=1).at[:edges].min(jnp.all(fitted[counted], axis=1))
    mask = points.mask.ravel().at[pixel].set(whole, mode="drop").reshape(points.mask.shape)
    return dataclasses.replace(points, mask=mask, area=PixelArea(slot.reshape(mask.shape), fine))


def _by_shares(weight: Array, met: Array, counted: Array, shapes: int) -> Array:
    """Weights that give each shape the share of the pixel that was counted."""
    result = jnp.zeros_like(weight)
    for index in range(NO_SHAPE, shapes):
        mine = met == index
        share = jnp.mean(counted == index, axis=1, dtype=weight.dtype, keepdims=True)
        total = jnp.sum(jnp.where(mine, weight, 0.0), axis=1, keepdims=True)
        result = jnp.where(mine, weight * share / jnp.where(total > 0, total, 1.0), result)
    return result
