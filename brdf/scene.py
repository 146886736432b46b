"""The scene: what each pixel sees, and the light that falls on it."""

import dataclasses
import math
from functools import partial
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Int

from brdf.checks import Checked, Spectrum, instance, several, spectrum
from brdf.errors import InputError, as_numbers
from brdf.files import as_path
from brdf.geometry.camera import Camera
from brdf.geometry.rays import PrimaryRays, Sight, surface_points
from brdf.geometry.shapes import Shape
from brdf.geometry.surface_points import PixelArea, SurfacePoints
from brdf.lights.base import Light
from brdf.pixel_area import with_area
from brdf.precision import Precision, cast, working_precision


def _masks(value: Any) -> tuple[Any, ...]:
    """Given shadow masks: (H, W) values from 0 to 1, or None, one for each light; () where there are none."""
    masks = []
    for mask in several("visibility", value):
        if mask is not None and not isinstance(mask, jax.Array):
            mask = as_numbers("visibility", mask)
            if not np.all((mask >= 0) & (mask <= 1)):
                came = f"must lie between 0 and 1, got {np.min(mask):g} to {np.max(mask):g}"
                raise InputError("visibility", came, "Give the share of the light that each pixel sees")
        masks.append(mask)
    return () if all(mask is None for mask in masks) else tuple(masks)


class Scene(Checked):
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

    Example:
        >>> scene = brdf.Scene.load("scene.toml")
        >>> scene.resolution, scene.channels, len(scene.lights)
        ((32, 32), 3, 1)
    """

    camera: Camera | None = None
    shapes: tuple[Shape, ...] = eqx.field(converter=partial(several, "shapes"), default=())
    points: SurfacePoints | None = None
    ambient: Spectrum | None = eqx.field(
        converter=lambda value: None if value is None else spectrum("intensity", value), default=None
    )
    lights: tuple[Light, ...] = eqx.field(converter=partial(several, "lights"), default=())
    visibility: tuple[Float[Array, "H W"] | None, ...] = eqx.field(converter=_masks, default=())

    def __check_init__(self):
        """Refuse parts that do not belong together."""
        words = "Write Scene(camera, shapes=[...], lights=[...]), or points=brdf.SurfacePoints.from_normals(...)"
        for name, kind in {"camera": Camera, "points": SurfacePoints, "shapes": Shape, "lights": Light}.items():
            part = getattr(self, name)
            parts = (
                {f"{name}[{index}]": one for index, one in enumerate(part)} if isinstance(part, tuple) else {name: part}
            )
            for place, one in parts.items():
                if one is not None or isinstance(part, tuple):
                    instance(place, one, kind, words)
        fitted = [shape.fitted for shape in self.shapes]
        if (self.camera is None) == (self.points is None):
            remedy = "Give either a camera and shapes, or an aov file"
            raise InputError("scene", "must have a camera or surface points, and not both", remedy)
        if self.camera is not None and not any(fitted):
            raise InputError("shapes", "has no shape that is fitted", "Add a [[shapes]] table")
        if self.points is not None and fitted and all(fitted):
            remedy = "Set fitted = false: beside surface points, shapes are occluders only"
            raise InputError("shapes", "must not be fitted where surface points are given", remedy)
        if self.visibility and len(self.visibility) != len(self.lights):
            came = f"has {len(self.visibility)} entries for {len(self.lights)} lights"
            raise InputError("visibility", came, "Give one for each light, None where the shapes tell")
        for mask in self.visibility:
            if mask is not None and mask.shape != self.resolution[::-1]:
                came = f"must be of shape {self.resolution[::-1]}, got {mask.shape}"
                raise InputError("visibility", came, "Give a value per pixel")
        counts = sorted({emittance.shape[0] for emittance in self.emittances()} - {1})
        if len(counts) > 1:
            came = f"lights have {' and '.join(map(str, counts))} channels"
            raise InputError("intensity", came, "Give all lights and the ambient light the same number of channels")

    def emittances(self) -> list[Spectrum]:
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

    @property
    def occluders(self) -> tuple[Shape, ...]:
        """All shapes; none where they cannot cast a shadow on what is seen."""
        alone = self.camera is not None and len(self.shapes) == 1 and self.shapes[0].convex
        return () if alone else self.shapes

    def surface_points(self, rows: tuple[int, int] | None = None) -> SurfacePoints:
        """What each pixel sees: traced by the camera, or as given.

        Args:
            rows: the first one, and the one after the last, where not all are wanted; then pixels are seen at their
                centres.

        Returns:
            (H, W) points, or as many rows.
        """
        height = self.resolution[1]
        first, stop = rows or (0, height)
        if self.points is not None:
            assert rows is None or self.points.area is None
            points = self.points if rows is None else jax.tree.map(lambda leaf: leaf[first:stop], self.points)
        else:
            assert self.camera is not None
            points = PrimaryRays.of_rows(self.camera, self.shapes, first, stop).stored()
        visibility = None
        if self.visibility:
            unshadowed = np.ones((height, self.resolution[0]), bool)
            masks = [unshadowed if mask is None else mask for mask in self.visibility]
            visibility = jnp.stack([mask[first:stop] for mask in masks], axis=-1)
        points = dataclasses.replace(points, visibility=visibility)
        if rows is not None or self.camera is None or self.camera.samples == 1:
            return points
        return with_area(points, self.camera, self.shapes, self.lights, self.occluders)

    def sight(self, rows: tuple[int, int] | None = None) -> Sight:
        """What each pixel sees, for programs that shade it: the rays alone where to trace them takes little time.

        Args:
            rows: as for `surface_points`.
        """
        camera = self.camera
        if camera is None or (rows is None and camera.samples > 1) or any(mask is not None for mask in self.visibility):
            return self.surface_points(rows)
        rays = PrimaryRays.of_rows(camera, self.shapes, *((0, self.resolution[1]) if rows is None else rows))
        return rays if rays.quick else rays.stored()

    @classmethod
    def load(
        cls, path: str | Path, *, within: str | Path | None = None, tables: dict[str, Any] | None = None
    ) -> "Scene":
        """Read a scene file.

        Args:
            path: a ``scene.toml``; the paths in it are relative to its folder.
            within: a folder that these paths may not leave; None takes the scene's own.
            tables: what is in the file, where it has been parsed already.

        Raises:
            InputError: naming file, table and key.
        """
        from brdf.scene_file import read_parts  # late: it brings the picture library

        parts = read_parts(as_path(path), within, tables)
        try:
            return cls(**parts)
        except InputError as error:
            raise error.inside(path) from None

    def save(self, path: str | Path, *, aov: str | None = None) -> None:
        """Write a scene file that `load` reads back to the same scene.

        Args:
            path: a ``.toml`` file; surface points, meshes, environment maps and shadow masks are written beside it, as
                ``<name>.aov.exr`` and so on.
            aov: the name of a file beside it that holds the surface points already, where several scenes share them.

        Raises:
            InputError: where the file cannot be written.
        """
        from brdf.scene_file import write_scene

        write_scene(path, self, aov)


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

    Example:
        >>> scene = brdf.Scene.load("scene.toml")
        >>> two = brdf.some_pixels(scene, np.array([528, 529]))
        >>> brdf.render(brdf.preset("gold"), two).shape
        (1, 2, 3)
    """
    count = math.prod(scene.resolution)
    if not isinstance(pixel, Tracer):
        pixel = np.asarray(pixel)
        if pixel.dtype.kind not in "iu" or np.any((pixel < 0) | (pixel >= count)):
            came = f"must be whole numbers from 0 to {count - 1}"
            raise InputError("pixel", came, "Of a mask, give np.flatnonzero(mask)")
    pixel = pixel.reshape(1, -1) if pixel.ndim == 1 else pixel
    with working_precision(precision):
        if scene.camera is not None and scene.camera.samples == 1:
            width = scene.camera.resolution[0]
            column, row = pixel % width + 0.5, pixel // width + 0.5
            points = surface_points(scene.camera, scene.shapes, column, row)
        else:
            points = _chosen(cast(scene, precision).surface_points(), pixel)
        # The points know which shape they lie on by its place in the list, so all shapes stay.
        hiding = tuple(dataclasses.replace(shape, fitted=False) for shape in scene.occluders)
        choose = partial(_of_picture, pixel)
        visibility = tuple(None if mask is None else choose(np.asarray(mask, np.float64)) for mask in scene.visibility)
        return Scene(points=points, shapes=hiding, ambient=scene.ambient, lights=scene.lights, visibility=visibility)


def _of_picture(pixel: Any, leaf: Any) -> np.ndarray:
    """Some pixels of (H, W, ...) values; through NumPy: an XLA gather is ten times slower."""
    return np.asarray(leaf).reshape(-1, *leaf.shape[2:])[np.asarray(pixel)]


def _chosen(points: SurfacePoints, pixel: Any) -> SurfacePoints:
    """Some of the points, in the shape of ``pixel``."""
    area = points.area
    some = dataclasses.replace(points, visibility=None, area=None).pixels(pixel)
    if area is None:
        return some
    slot = _of_picture(pixel, area.slot)
    has, new = slot >= 0, np.full_like(slot, -1)
    if not has.any():
        return some
    new[has] = np.arange(np.count_nonzero(has))
    fine = dataclasses.replace(area.points, visibility=None).pixels(slot[has])
    return dataclasses.replace(some, area=PixelArea(new, fine))
