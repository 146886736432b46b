"""The scene: what each pixel sees, and the light that falls on it."""

from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from brdf.camera import Camera
from brdf.checks import direction_value, spectrum
from brdf.errors import InputError
from brdf.lights import Light
from brdf.precision import apart
from brdf.shapes import Shape


class SurfacePoints(eqx.Module):
    """What the pixels see: one surface point each.

    Attributes:
        position: (..., 3), world units.
        normal: (..., 3), unit.
        to_view: (..., 3), unit, towards the eye.
        mask: (...), whether the pixel sees a fitted surface; elsewhere the other values are finite and mean nothing.
    """

    position: Float[Array, "*pixels 3"]
    normal: Float[Array, "*pixels 3"]
    to_view: Float[Array, "*pixels 3"]
    mask: Bool[Array, "*pixels"]

    @classmethod
    def from_normals(
        cls,
        normal: Any,
        *,
        position: Any = None,
        mask: Any = None,
        to_view: Any = (0.0, 0.0, 1.0),
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
        if position is None:
            position = np.zeros(normal.shape)
        position = np.asarray(position, dtype=np.float64)
        to_view = np.asarray(to_view, dtype=np.float64)
        if to_view.shape == (3,):
            to_view = np.broadcast_to(direction_value("to_view")(to_view), normal.shape)
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
        return cls(
            position=np.where(seen[..., None], position, 0.0),
            normal=np.where(seen[..., None], normal / np.where(seen, length, 1.0)[..., None], upward),
            to_view=np.where(seen[..., None], to_view / np.where(view_length > 0, view_length, 1.0), upward),
            mask=seen,
        )


def _ambient(value: Any) -> Any:
    return None if value is None else spectrum("intensity")(value)


class Scene(eqx.Module):
    """Camera and shapes, or surface points in their place; lights; ambient light.

    A scene is a pytree: every number in it can be differentiated or fitted. What a scene does not have is None or
    missing, and no arithmetic is compiled for it.

    Args:
        camera: where the picture is taken from; None where ``points`` are given.
        shapes: what it shows.
        points: (H, W) surface points from elsewhere, instead of camera and shapes.
        ambient: intensity of the ambient light, (C,), or None.
        lights: the lights.

    Raises:
        InputError: where the parts do not belong together.
    """

    camera: Camera | None = None
    shapes: tuple[Shape, ...] = eqx.field(converter=tuple, default=())
    points: SurfacePoints | None = None
    ambient: Float[Array, " C"] | None = eqx.field(converter=_ambient, default=None)
    lights: tuple[Light, ...] = eqx.field(converter=tuple, default=())

    def __check_init__(self):
        """Refuse parts that do not belong together."""
        if (self.camera is None) == (self.points is None):
            remedy = "Give either a camera and shapes, or an aov file"
            raise InputError("scene", "must have a camera or surface points, and not both", remedy)
        if self.camera is not None and not any(shape.fitted for shape in self.shapes):
            raise InputError("shapes", "has no shape that is fitted", "Add a [[shapes]] table")
        if self.points is not None and self.shapes and all(shape.fitted for shape in self.shapes):
            remedy = "Set fitted = false: beside surface points, shapes are occluders only"
            raise InputError("shapes", "must not be fitted where surface points are given", remedy)
        counts = sorted({emittance.shape[0] for emittance in self.emittances()})
        if len([count for count in counts if count != 1]) > 1:
            came = f"lights have {' and '.join(map(str, counts))} channels"
            raise InputError("intensity", came, "Give all lights and the ambient light the same number of channels")

    def emittances(self) -> list[Float[Array, " C"]]:
        """The emittance of each light, then the ambient intensity where there is one."""
        ambient = [] if self.ambient is None else [self.ambient]
        return [light.emittance for light in self.lights] + ambient

    @property
    def channels(self) -> int:
        """The number of channels of the light: 1, which serves any picture, or that of the spectra."""
        return max((emittance.shape[0] for emittance in self.emittances()), default=1)

    @property
    def resolution(self) -> tuple[int, int]:
        """Width and height of the picture in pixels."""
        if self.camera is not None:
            return self.camera.resolution
        assert self.points is not None
        height, width = self.points.mask.shape
        return width, height

    def surface_points(self) -> SurfacePoints:
        """What each pixel sees, (H, W): traced by the camera, or as given."""
        if self.points is not None:
            return self.points
        assert self.camera is not None
        return _surface_points(self.camera, self.shapes)

    @classmethod
    def load(cls, path: str | Path) -> "Scene":
        """Read a scene file.

        Args:
            path: a ``scene.toml``; the paths in it are relative to its folder.

        Raises:
            InputError: naming file, table and key.
        """
        from brdf.scene_file import load_scene

        return load_scene(path)

    def save(self, path: str | Path) -> None:
        """Write a scene file that `load` reads back to the same scene.

        Args:
            path: a ``.toml`` file; geometry given as surface points is written beside it as ``<name>.aov.exr``.

        Raises:
            InputError: where the file cannot be written.
        """
        from brdf.scene_file import save_scene

        save_scene(self, path)


@eqx.filter_jit
def _surface_points(camera: Camera, shapes: tuple[Shape, ...]) -> SurfacePoints:
    return apart(_trace, camera, shapes)


def _trace(camera: Camera, shapes: tuple[Shape, ...]) -> SurfacePoints:
    origins, directions = camera.rays()
    distance = jnp.full(origins.shape[:-1], jnp.inf)
    mask = jnp.zeros(origins.shape[:-1], bool)
    position, normal = origins, -directions
    for shape in shapes:
        hit = jax.vmap(jax.vmap(shape.intersect))(origins, directions)
        nearer = hit.hit & (hit.distance < distance)
        distance = jnp.where(nearer, hit.distance, distance)
        mask = jnp.where(nearer, shape.fitted, mask)
        position = jnp.where(nearer[..., None], hit.position, position)
        normal = jnp.where(nearer[..., None], hit.normal, normal)
    to_view = jnp.where(mask[..., None], camera.to_view(position), normal)
    return SurfacePoints(position, normal, to_view, mask)
