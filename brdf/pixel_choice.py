"""Some of a scene's pixels, without looking at the others."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

from brdf.geometry.base import Shape
from brdf.geometry.camera import Camera
from brdf.geometry.rays import trace
from brdf.geometry.surface_points import PixelArea, SurfacePoints
from brdf.precision import Precision, apart, cast, working_precision
from brdf.scene import Scene


def some_pixels(
    scene: Scene,
    pixel: Int[np.ndarray | Array, " K"] | Int[np.ndarray | Array, "H W"],
    *,
    precision: Precision = "float32",
) -> Scene:
    """The scene of a picture that shows some pixels of another: of one row, (1, K), or of the shape of ``pixel``.

    Only those are traced, unless pixels are averaged over their area: which ones need that, their neighbours tell.

    Args:
        scene: any.
        pixel: indices, row by row.
        precision: in which the pixels are traced.

    Returns:
        A scene with surface points in place of the camera; what casts shadows there does so here.
    """
    shape = (1, pixel.size) if pixel.ndim == 1 else (pixel.shape[0], pixel.shape[1])
    pixel = pixel.reshape(-1)
    with working_precision(precision):
        if scene.camera is None:
            points = _chosen(cast(scene.points, precision), pixel)
        elif scene.camera.samples == 1:
            points = _traced(scene.camera, scene.shapes, pixel)
        else:
            points = _chosen(cast(scene, precision).surface_points(), pixel)
        # The points know which shape they lie on by its place in the list, so all shapes stay.
        casting = scene.lighting.occluders
        hiding = tuple(dataclasses.replace(shape, fitted=False) for shape in casting)
        visibility = tuple(
            None if mask is None else np.asarray(mask, np.float64).ravel()[np.asarray(pixel)].reshape(shape)
            for mask in scene.visibility
        )
        points = _shaped(points, shape)
        return Scene(points=points, shapes=hiding, ambient=scene.ambient, lights=scene.lights, visibility=visibility)


@eqx.filter_jit
def _traced(camera: Camera, shapes: tuple[Shape, ...], pixel: Any) -> SurfacePoints:
    def at(camera: Camera, shapes: tuple[Shape, ...], x: Array, y: Array) -> SurfacePoints:
        return trace(camera, shapes, None, *camera.rays_through(x, y))

    middle = jnp.full(1, 0.5)
    x, y = camera.places_in_pixels(pixel, middle, middle)
    return apart(at, camera, shapes, x.T, y.T)


def _shaped(points: SurfacePoints, shape: tuple[int, int]) -> SurfacePoints:
    """Points of one row, (1, K), in another shape."""
    if points.mask.shape == shape:
        return points
    area = points.area
    plain = eqx.tree_at(lambda p: p.area, points, None, is_leaf=lambda leaf: leaf is None)
    plain = jax.tree.map(lambda leaf: leaf.reshape(*shape, *leaf.shape[2:]), plain)
    if area is not None:
        area = eqx.tree_at(lambda a: a.slot, area, area.slot.reshape(shape))
        plain = eqx.tree_at(lambda p: p.area, plain, area, is_leaf=lambda leaf: leaf is None)
    return plain


def _chosen(points: Any, pixel: Any) -> SurfacePoints:
    """Some of the points, (1, K)."""
    area = points.area
    plain = eqx.tree_at(lambda p: (p.visibility, p.area), points, (None, None), is_leaf=lambda leaf: leaf is None)
    indices = np.asarray(pixel)

    def choose(leaf: Any) -> Any:
        # Through NumPy: an XLA gather is ten times slower.
        flat = np.asarray(leaf)
        return flat.reshape(-1, *flat.shape[points.mask.ndim :])[indices][None]

    some = jax.tree.map(choose, plain)
    if area is None:
        return some
    slot = np.asarray(area.slot).ravel()[indices]
    averaged = np.flatnonzero(slot >= 0)
    # An entry that is not used lies beyond the last pixel.
    rows = slot[averaged] if averaged.size else np.zeros(1, slot.dtype)
    place = averaged if averaged.size else np.array([indices.size])
    new = np.full(indices.size, -1, np.int32)
    new[averaged] = np.arange(averaged.size, dtype=np.int32)
    fine = jax.tree.map(lambda leaf: np.asarray(leaf)[rows], area.points)
    fine = eqx.tree_at(lambda p: p.visibility, fine, None, is_leaf=lambda leaf: leaf is None)
    weight = np.asarray(area.weight)[rows]
    entries: tuple[Any, ...] = (place.astype(np.int32), new[None], fine, weight)
    found = PixelArea(*entries)
    return eqx.tree_at(lambda p: p.area, some, found, is_leaf=lambda leaf: leaf is None)
