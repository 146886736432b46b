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
from brdf.lights.environment import ConstantEnvironment
from brdf.pixel_area import with_area
from brdf.precision import Precision, cast, working_precision

FEW_SHAPES = 4
"""Up to so many spheres and rectangles are traced anew sooner than what they look like is read."""


def _masks(value: Any) -> tuple[Any, ...]:
    """Given shadow masks: (H, W) values from 0 to 1, or None, one for each light; () where there are none."""
    masks = []
    for mask in several("visibility", value):
        if mask is not None and not isinstance(mask, jax.Array):
            mask = as_numbers("visibility", mask)
            if not np.all((mask >= 0) & (mask <= 1)):
                what = f"must lie between 0 and 1, got {np.min(mask):g} to {np.max(mask):g}"
                raise InputError("visibility", what, "Give the share of the light that each pixel sees")
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
        for name, part, kind in (("camera", self.camera, Camera), ("points", self.points, SurfacePoints)):
            if part is not None:
                instance(name, part, kind, words)
        for name, parts, kind in (("shapes", self.shapes, Shape), ("lights", self.lights, Light)):
            for index, part in enumerate(parts):
                instance(f"{name}[{index}]", part, kind, words)
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
            what = f"has {len(self.visibility)} entries for {len(self.lights)} lights"
            raise InputError("visibility", what, "Give one for each light, None where the shapes tell")
        for mask in self.visibility:
            if mask is not None and mask.shape != self.resolution[::-1]:
                what = f"must be of shape {self.resolution[::-1]}, got {mask.shape}"
                raise InputError("visibility", what, "Give a value per pixel")
        counts = sorted({emittance.shape[0] for emittance in self.emittances()} - {1})
        if len(counts) > 1:
            what = f"lights have {' and '.join(map(str, counts))} channels"
            raise InputError("intensity", what, "Give all lights and the ambient light the same number of channels")

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

    def sees_whole(self, light: Light) -> bool:
        """Whether a light is a sky of one brightness that every point sees all of, above its horizon."""
        return isinstance(light, ConstantEnvironment) and not self.occluders and not self.visibility

    def surface_points(self) -> SurfacePoints:
        """What each pixel sees, (H, W): traced by the camera, or as given."""
        return self.sight().stored()

    def sight(self, rows: tuple[int, int] | None = None) -> Sight:
        """What each pixel sees, for programs that shade it: the rays alone where to trace them takes little time.

        Args:
            rows: the first one, and the one after the last, where not all are wanted; then pixels are seen at their
                centres.
        """
        first, stop = rows or (0, self.resolution[1])
        visibility = None
        if self.visibility:
            unshadowed = np.ones(self.resolution[::-1], bool)
            masks = [unshadowed if mask is None else mask for mask in self.visibility]
            visibility = jnp.stack([mask[first:stop] for mask in masks], axis=-1)
        if self.camera is None:
            assert self.points is not None
            assert rows is None or self.points.area is None
            points = self.points if rows is None else jax.tree.map(lambda leaf: leaf[first:stop], self.points)
            return dataclasses.replace(points, visibility=visibility)
        rays = PrimaryRays(self.camera, self.shapes, np.int32(first), stop - first)
        averaged = rows is None and self.camera.samples > 1
        # To trace them takes less time than to read what they met; meshes are asked on the host.
        quick = len(self.shapes) <= FEW_SHAPES and all(shape.convex for shape in self.shapes)
        if quick and visibility is None and not averaged:
            return rays
        points = dataclasses.replace(rays.stored(), visibility=visibility)
        return with_area(points, self.camera, self.shapes, self.lights, self.occluders) if averaged else points

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
            what = f"must be whole numbers from 0 to {count - 1}"
            raise InputError("pixel", what, "Of a mask, give np.flatnonzero(mask)")
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
        visibility = [None if mask is None else np.asarray(mask).ravel()[pixel] for mask in scene.visibility]
        return Scene(points=points, shapes=hiding, ambient=scene.ambient, lights=scene.lights, visibility=visibility)


def _chosen(points: SurfacePoints, pixel: Any) -> SurfacePoints:
    """Some of the points, in the shape of ``pixel``."""
    area = points.area
    some = dataclasses.replace(points, visibility=None, area=None).pixels(pixel)
    if area is None:
        return some
    slot = np.asarray(area.slot).ravel()[pixel]  # an XLA gather is ten times slower
    has, new = slot >= 0, np.full_like(slot, -1)
    if not has.any():
        return some
    new[has] = np.arange(np.count_nonzero(has))
    fine = dataclasses.replace(area.points, visibility=None).pixels(slot[has])
    return dataclasses.replace(some, area=PixelArea(new, fine))
