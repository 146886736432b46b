"""What the pixels of a picture see."""

import dataclasses
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float, Int

from brdf.checks import direction_value
from brdf.errors import InputError
from brdf.vectors import Components

NO_SHAPE = -1
"""The index of what is no shape: the background, or points that come from elsewhere."""


class PixelArea(eqx.Module):
    """Several surface points for each of those pixels where one does not stand for the pixel's area.

    Attributes:
        slot: (...), for every pixel its place among those, -1 where its centre is enough.
        points: (K, M) what those pixels see, with the share of the pixel's area that each point stands for.
    """

    slot: Int[Any, "*pixels"]
    points: "SurfacePoints"


class SurfacePoints(eqx.Module):
    """What the pixels see: one surface point each.

    Programs compute with vectors in `Components`, of which one that is the same for all points, as where the eye is
    infinitely far, may be a single number.

    Attributes:
        position: (..., 3), world units.
        normal: (..., 3), unit.
        to_view: (..., 3), unit, towards the eye.
        mask: (...), whether the pixel sees a fitted surface; elsewhere the other values are finite and mean nothing.
            Where a pixel is averaged over its area, whether all of it does.
        shape: (...), index of the shape that each pixel sees; None where the points come from elsewhere.
        visibility: for each of L lights, how much of it each point sees, (..., L), 0 to 1; None where nothing is given.
        area: the pixels that are averaged over their area; None where every pixel's centre stands for it.
        facet: (..., 3), the unit normal of the flat piece that a smooth mesh is made of there; None where that is
            ``normal``. No light comes from behind it, and shadow rays start above it.
        share: of several points in a pixel, (K, M), what each counts for; None for one in each.

    Example:
        >>> points = brdf.Scene.load("scene.toml").surface_points()
        >>> points.normal.shape, int(points.mask.sum())
        ((32, 32, 3), 656)
    """

    position: Float[Any, "*pixels 3"]
    normal: Float[Any, "*pixels 3"]
    to_view: Float[Any, "*pixels 3"]
    mask: Bool[Array, "*pixels"]
    shape: Int[Array, "*pixels"] | None = None
    visibility: Float[Array, "*pixels L"] | None = None
    area: PixelArea | None = None
    facet: Float[Any, "*pixels 3"] | None = None
    share: Float[Array, "K M"] | None = None

    @property
    def met(self) -> Int[Array, "*pixels"]:
        """Index of the shape that each pixel sees, `NO_SHAPE` for none; 0 where the points come from elsewhere."""
        return jnp.where(self.mask, 0, NO_SHAPE) if self.shape is None else self.shape

    @property
    def count(self) -> int:
        """How many points there are."""
        return self.mask.size

    def stored(self) -> "SurfacePoints":
        """These points, as those that `brdf.geometry.rays.PrimaryRays` meet."""
        return self

    def in_components(self) -> "SurfacePoints":
        """The same points, without areas, as programs compute with them."""
        return self._with_vectors(Components.of)

    def stacked(self) -> "SurfacePoints":
        """The same, whose vectors were in components, as arrays."""
        return self._with_vectors(lambda vector: vector.stacked(self.mask.shape))

    def _with_vectors(self, change: Callable[[Any], Any]) -> "SurfacePoints":
        names = "position", "normal", "to_view", "facet"
        vectors = {name: getattr(self, name) for name in names if getattr(self, name) is not None}
        return dataclasses.replace(self, area=None, **{name: change(vector) for name, vector in vectors.items()})

    def flat(self) -> "SurfacePoints":
        """In components, as one row, (P,)."""
        pixels = self.mask.ndim
        return jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[pixels:]) if leaf.ndim else leaf, self)

    @property
    def each(self) -> int:
        """How many points a pixel has."""
        return 1 if self.share is None else self.mask.shape[-1]

    def per_pixel(self, values: Array) -> Array:
        """The sums of (P, C) values of points over those of each pixel."""
        return jnp.sum(values.reshape(-1, self.each, values.shape[-1]), axis=1) if self.each > 1 else values

    def pixels(self, index: Any = slice(None)) -> "SurfacePoints":
        """Some of the pixels of a picture without areas, by their indices row by row."""
        pixels = self.mask.ndim - (self.share is not None)

        def some(leaf: Any) -> Any:
            # On the host where it can be: XLA compiles each shape, and its gather is ten times slower.
            values = leaf if isinstance(leaf, Tracer) else np.asarray(leaf)
            return values.reshape(-1, *values.shape[pixels:])[index]

        return jax.tree.map(some, self)

    @classmethod
    def from_normals(
        cls, normal: Any, *, position: Any = None, mask: Any = None, to_view: Any = (0.0, 0.0, 1.0)
    ) -> "SurfacePoints":
        """Surface points from a normal map, as a scanner, a renderer or photometric stereo gives it.

        Args:
            normal: (H, W, 3), any length; zero or not finite where the pixel sees no surface.
            position: (H, W, 3), world units; may be left out where every light is directional.
            mask: (H, W), bool; further pixels to leave out.
            to_view: direction towards the eye, (3,) for an orthographic picture or (H, W, 3).

        Raises:
            InputError: where the shapes do not belong together.
        """
        normal, to_view = np.asarray(normal, np.float64), np.asarray(to_view, np.float64)
        if normal.ndim != 3 or normal.shape[-1] != 3:
            raise InputError("normal", f"must be of shape (H, W, 3), got {normal.shape}", "Give a normal map")
        if to_view.shape == (3,):
            to_view = np.broadcast_to(direction_value("to_view", to_view), normal.shape)
        position = np.zeros(normal.shape) if position is None else np.asarray(position, np.float64)
        seen = np.ones(normal.shape[:2], bool) if mask is None else np.asarray(mask, bool)
        for name, value in {"position": position, "to_view": to_view, "mask": seen}.items():
            shape = normal.shape[: 2 if value is seen else 3]
            if value.shape != shape:
                raise InputError(name, f"must be of shape {shape}, got {value.shape}", "Give a value per pixel")
        length, view_length = (np.linalg.norm(v, axis=-1, keepdims=True) for v in (normal, to_view))
        finite = np.isfinite(np.concatenate([length, position, to_view], axis=-1)).all(axis=-1)
        seen = seen & (length[..., 0] > 0) & finite
        inside, upward = seen[..., None], [0.0, 0.0, 1.0]
        return cls(
            np.where(inside, position, 0.0),
            np.where(inside, normal / np.where(inside, length, 1.0), upward),
            np.where(inside, to_view / np.where(view_length > 0, view_length, 1.0), upward),
            seen,
        )
