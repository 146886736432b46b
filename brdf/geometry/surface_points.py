"""What the pixels of a picture see."""

import dataclasses
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
        pixel: (K,) which pixels, indices row by row; beyond the last one where an entry is not used.
        slot: (...), for every pixel its place in ``pixel``, -1 where its centre is enough.
        points: (K, M) what those pixels see.
        weight: (K, M) the share of the pixel's area that each point stands for; adds up to 1 with what no shape covers.
    """

    pixel: Int[Array, " K"]
    slot: Int[Array, "*pixels"]
    points: "SurfacePoints"
    weight: Float[Array, "K M"]


class SurfacePoints(eqx.Module):
    """What the pixels see: one surface point each.

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

    Example:
        >>> points = brdf.Scene.load("scene.toml").surface_points()
        >>> points.normal.shape, int(points.mask.sum())
        ((32, 32, 3), 656)
    """

    position: Float[Array, "*pixels 3"]
    normal: Float[Array, "*pixels 3"]
    to_view: Float[Array, "*pixels 3"]
    mask: Bool[Array, "*pixels"]
    shape: Int[Array, "*pixels"] | None = None
    visibility: Float[Array, "*pixels L"] | None = None
    area: PixelArea | None = None
    facet: Float[Array, "*pixels 3"] | None = None

    @property
    def met(self) -> Int[Array, "*pixels"]:
        """Index of the shape that each pixel sees, `NO_SHAPE` for none; where one shape is all there is, that is 0."""
        return jnp.where(self.mask, 0, NO_SHAPE) if self.shape is None else self.shape

    @property
    def shape_of_picture(self) -> tuple[int, ...]:
        """Of the picture."""
        return self.mask.shape

    def in_components(self) -> "Points":
        """The same points, without areas, as programs compute with them."""
        position, normal, to_view = map(Components.of, (self.position, self.normal, self.to_view))
        facet = None if self.facet is None else Components.of(self.facet)
        return Points(position, normal, to_view, self.mask, self.shape, self.visibility, facet)

    def stored(self) -> "SurfacePoints":
        """These points, as those that `brdf.geometry.rays.PrimaryRays` meet."""
        return self

    def pixels(self, index: Any = slice(None)) -> "SurfacePoints":
        """Some of the points of a picture without areas, by their indices row by row."""

        def some(leaf: Any) -> Any:
            # On the host where it can be: XLA compiles each shape, and its gather is ten times slower.
            values = leaf if isinstance(leaf, Tracer) else np.asarray(leaf)
            return values.reshape(-1, *values.shape[self.mask.ndim :])[index]

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
        normal = np.asarray(normal, dtype=np.float64)
        if normal.ndim != 3 or normal.shape[-1] != 3:
            raise InputError("normal", f"must be of shape (H, W, 3), got {normal.shape}", "Give a normal map")
        length = np.sqrt(np.sum(normal * normal, axis=-1))
        seen = np.isfinite(length) & (length > 0)
        position = np.asarray(np.zeros(normal.shape) if position is None else position, dtype=np.float64)
        to_view = np.asarray(to_view, dtype=np.float64)
        if to_view.shape == (3,):
            to_view = np.broadcast_to(direction_value("to_view", to_view), normal.shape)
        for name, value in (("position", position), ("to_view", to_view)):
            if value.shape != normal.shape:
                raise InputError(name, f"must be of shape {normal.shape}, got {value.shape}", "Give a value per pixel")
            seen &= np.all(np.isfinite(value), axis=-1)
        if mask is not None:
            mask = np.asarray(mask, dtype=bool)
            if mask.shape != seen.shape:
                raise InputError("mask", f"must be of shape {seen.shape}, got {mask.shape}", "Give a value per pixel")
            seen &= mask
        view_length = np.sqrt(np.sum(to_view * to_view, axis=-1, keepdims=True))
        upward = np.array([0.0, 0.0, 1.0])
        values: dict[str, Any] = {
            "position": np.where(seen[..., None], position, 0.0),
            "normal": np.where(seen[..., None], normal / np.where(seen, length, 1.0)[..., None], upward),
            "to_view": np.where(seen[..., None], to_view / np.where(view_length > 0, view_length, 1.0), upward),
        }
        return cls(**values, mask=seen)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, eq=False)
class Points:
    """Surface points as programs compute with them: see `SurfacePoints`, whose numbers these are.

    A component that is the same for all of them, as where the eye is infinitely far, may be a single number.
    """

    position: Components
    normal: Components
    to_view: Components
    mask: Bool[Array, "*pixels"]
    shape: Int[Array, "*pixels"] | None = None
    visibility: Float[Array, "*pixels L"] | None = None
    facet: Components | None = None

    def stacked(self) -> SurfacePoints:
        """The same as arrays."""
        vectors = (self.position, self.normal, self.to_view)
        position, normal, to_view = (vector.stacked(self.mask.shape) for vector in vectors)
        facet = None if self.facet is None else self.facet.stacked(self.mask.shape)
        return SurfacePoints(position, normal, to_view, self.mask, self.shape, self.visibility, facet=facet)

    def flat(self) -> "Points":
        """As one row, (P,)."""
        pixels = self.mask.ndim
        return jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[pixels:]) if leaf.ndim else leaf, self)
