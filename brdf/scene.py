"""The scene: what each pixel sees, and the light that falls on it."""

from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float

from brdf.checks import spectrum
from brdf.errors import InputError
from brdf.geometry.base import Shape
from brdf.geometry.camera import Camera
from brdf.geometry.rays import look
from brdf.geometry.surface_points import SurfacePoints
from brdf.geometry.visibility import Lighting, given_visibility, occluders
from brdf.lights.punctual import Light
from brdf.pixel_area import with_area


def _is_none(value: Any) -> bool:
    return value is None


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
        visibility: for each light (H, W) values from 0 to 1, how much of it each pixel sees, where that is known, or
            None where the shapes tell; () where they tell for all. It multiplies whatever shadows the shapes cast.

    Raises:
        InputError: where the parts do not belong together.
    """

    camera: Camera | None = None
    shapes: tuple[Shape, ...] = eqx.field(converter=tuple, default=())
    points: SurfacePoints | None = None
    ambient: Float[Array, " C"] | None = eqx.field(converter=_ambient, default=None)
    lights: tuple[Light, ...] = eqx.field(converter=tuple, default=())
    visibility: tuple[Float[Array, "H W"] | None, ...] = eqx.field(converter=given_visibility, default=())

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
        if self.visibility and len(self.visibility) != len(self.lights):
            came = f"has {len(self.visibility)} entries for {len(self.lights)} lights"
            raise InputError("visibility", came, "Give one for each light, None where the shapes tell")
        width, height = self.resolution
        for mask in self.visibility:
            if mask is not None and mask.shape != (height, width):
                came = f"must be of shape {(height, width)}, got {mask.shape}"
                raise InputError("visibility", came, "Give a value per pixel")
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

    def surface_points(self, rows: tuple[int, int] | None = None) -> SurfacePoints:
        """What each pixel sees: traced by the camera, or as given.

        Args:
            rows: the first one, and the one after the last, where not all are wanted; then pixels are seen at their
                centres, and numbers of the scene cannot be differentiated.

        Returns:
            (H, W) points, or as many rows.
        """
        if rows is not None:
            return self._some_rows(*rows)
        visibility = self.visibility or None
        if self.points is not None:
            return eqx.tree_at(lambda points: points.visibility, self.points, visibility, is_leaf=_is_none)
        assert self.camera is not None
        points = look(self.camera, self.shapes, visibility)
        return points if self.camera.samples == 1 else with_area(points, self.camera, self.shapes, self.lighting)

    def _some_rows(self, first: int, stop: int) -> SurfacePoints:
        visibility = tuple(None if mask is None else mask[first:stop] for mask in self.visibility) or None
        if self.points is None:
            assert self.camera is not None
            # As an array, or every band would be compiled anew.
            return look(self.camera, self.shapes, visibility, np.asarray(first, np.int32), stop - first)
        if self.points.area is not None:
            raise ValueError("points that are averaged over pixels cannot be cut into rows")
        plain = eqx.tree_at(lambda points: points.visibility, self.points, None, is_leaf=_is_none)
        some = jax.tree.map(lambda leaf: leaf[first:stop], plain)
        return eqx.tree_at(lambda points: points.visibility, some, visibility, is_leaf=_is_none)

    @property
    def lighting(self) -> Lighting:
        """The lights, and the shapes that stand in their way."""
        return Lighting(self.lights, occluders(self.shapes, traced=self.camera is not None))

    @classmethod
    def load(cls, path: str | Path, *, within: str | Path | None = None) -> "Scene":
        """Read a scene file.

        Args:
            path: a ``scene.toml``; the paths in it are relative to its folder.
            within: a folder that these paths may not leave; None takes the scene's own.

        Raises:
            InputError: naming file, table and key.
        """
        from brdf.scene_file import load_scene

        return load_scene(path, within)

    def save(self, path: str | Path) -> None:
        """Write a scene file that `load` reads back to the same scene.

        Args:
            path: a ``.toml`` file; surface points, meshes, environment maps and shadow masks are written beside it, as
                ``<name>.aov.exr`` and so on.

        Raises:
            InputError: where the file cannot be written.
        """
        from brdf.scene_writer import save_scene

        save_scene(self, path)
