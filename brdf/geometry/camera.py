"""Cameras: the rays through places of the picture, and the direction in which each surface point is seen."""

import abc
from functools import partial
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from brdf.checks import Checked, Scalar, Vector, checked, direction_value, number, positive, sample_number, vector
from brdf.errors import InputError
from brdf.vectors import Components, normalize

MAX_RESOLUTION = 1 << 16
MAX_SAMPLES = 256


def _resolution(value: Any) -> tuple[int, int]:
    """Two whole numbers, width and height in pixels."""
    remedy, size = "Give [width, height] in pixels", tuple(value) if np.iterable(value) else ()
    if len(size) != 2 or any(isinstance(one, bool) or not isinstance(one, int | np.integer) for one in size):
        raise InputError("resolution", f"must be two whole numbers, got {repr(value)[:60]}", remedy)
    if not all(1 <= one <= MAX_RESOLUTION for one in size):
        raise InputError("resolution", f"must be between 1 and {MAX_RESOLUTION}, got {repr(value)[:60]}", remedy)
    return int(size[0]), int(size[1])


def _viewer(value: Any) -> str | None:
    """Where the eye is taken to be."""
    if value not in (None, "local", "infinite"):
        raise InputError("viewer", f"must be 'local' or 'infinite', got {value!r}", "Correct the value")
    return value


class Camera(Checked):
    """Where the picture is taken from. Pixel centres lie at half-integers, row 0 is the top.

    Attributes:
        position: of the camera, (3,), world units.
        target: the point in the middle of the picture, (3,), world units.
        up: the direction that points up in the picture, (3,).
        resolution: (width, height) in pixels.
        viewer: "local" takes the eye to be at ``position`` for every point, "infinite" takes it to be infinitely far
            behind the camera, as OpenGL's infinite viewer does. None means local for a perspective camera and
            infinite for an orthographic one. (VTK always puts the eye at the camera.)
        samples: k, so that a pixel where that matters is the average over its area by k × k points; see
            `brdf.pixel_area`. 1 looks at the pixel's centre only.
    """

    position: Vector = checked(vector, "position", kw_only=True)
    target: Vector = checked(vector, "target", kw_only=True)
    up: Vector = checked(direction_value, "up", kw_only=True)
    resolution: tuple[int, int] = eqx.field(static=True, converter=_resolution, kw_only=True)
    viewer: str | None = eqx.field(static=True, default=None, converter=_viewer, kw_only=True)
    samples: int = eqx.field(static=True, converter=partial(sample_number, most=MAX_SAMPLES), default=1, kw_only=True)
    type_name: ClassVar[str]
    default_viewer: ClassVar[str]

    def __check_init__(self):
        """Refuse a camera without a picture plane."""
        if not all(isinstance(value, np.ndarray) for value in (self.position, self.target, self.up)):
            return
        forward = self.target - self.position
        length = np.linalg.norm(forward)
        if length == 0:
            what = f"must differ from position, got {self.target.tolist()} for both"
            raise InputError("target", what, "Move one of them")
        if np.linalg.norm(np.cross(forward, self.up)) <= 1e-9 * length * np.linalg.norm(self.up):
            what = f"must not be parallel to the view, got {self.up.tolist()}"
            raise InputError("up", what, "Give a direction that points up in the picture")

    @abc.abstractmethod
    def rays(self, column: Any, row: Any) -> tuple[Components, Components]:
        """Origin and unit direction of the rays through places, in pixels from the picture's left and upper edge.

        What all of them share is a number.
        """

    @property
    @abc.abstractmethod
    def half_width(self) -> Array:
        """Half the picture's width; of a perspective camera at a distance of 1."""

    def axes(self) -> tuple[Vector, Vector, Vector]:
        """Unit vectors to the right, up and forward in the picture, (3,) each."""
        forward = normalize(self.target - self.position)
        right = normalize(jnp.cross(forward, self.up))
        return right, jnp.cross(right, forward), forward

    def off_axis(self, right: Vector, up: Vector, column: Any, row: Any) -> Components:
        """How far places lie from the middle of the picture along two of its axes, in world units as `half_width`."""
        (width, height), (right, up) = self.resolution, map(Components.of, (right, up))
        x, y = jnp.asarray(column) * 2.0 / width - 1.0, height / width - jnp.asarray(row) * 2.0 / width
        return (right * x + up * y) * self.half_width

    def to_view(self, position: Components) -> Components:
        """Unit directions from surface points towards the eye."""
        if (self.viewer or self.default_viewer) == "local":
            return normalize(Components.of(self.position) - position)
        return Components.of(-self.axes()[2])


class OrthographicCamera(Camera):
    """Parallel rays.

    Args:
        position, target, up, resolution, viewer, samples: see `Camera`.
        width: of the picture, in world units, greater than 0.

    Raises:
        InputError: where a value is not finite or spans no picture.

    Example:
        >>> camera = brdf.OrthographicCamera(
        ...     position=[0, 0, 4], target=[0, 0, 0], up=[0, 1, 0], width=2.2, resolution=[16, 12]
        ... )
        >>> brdf.Scene(camera, [brdf.Sphere([0, 0, 0], 1)]).resolution
        (16, 12)
    """

    width: Scalar = checked(positive, "width", kw_only=True)
    type_name = "orthographic"
    default_viewer = "infinite"

    @property
    def half_width(self) -> Array:
        """In world units."""
        return self.width / 2

    def rays(self, column: Any, row: Any) -> tuple[Components, Components]:
        """Origins on the plane through ``position``, one direction."""
        right, up, forward = self.axes()
        return Components.of(self.position) + self.off_axis(right, up, column, row), Components.of(forward)


class PerspectiveCamera(Camera):
    """Rays from one point.

    Args:
        position, target, up, resolution, viewer, samples: see `Camera`.
        fov: the vertical angle of the picture in degrees, between 0 and 180.

    Raises:
        InputError: where a value is not finite or spans no picture.

    Example:
        >>> camera = brdf.PerspectiveCamera(
        ...     position=[0, 0, 4], target=[0, 0, 0], up=[0, 1, 0], fov=30, resolution=[16, 12]
        ... )
        >>> brdf.Scene(camera, [brdf.Sphere([0, 0, 0], 1)]).surface_points().mask.shape
        (12, 16)
    """

    fov: Scalar = eqx.field(converter=partial(number, "fov", above=0.0, below=180.0), kw_only=True)
    type_name = "perspective"
    default_viewer = "local"

    @property
    def half_width(self) -> Array:
        """The tangent of half the horizontal angle."""
        width, height = self.resolution
        return jnp.tan(jnp.deg2rad(self.fov) / 2) * (width / height)

    def rays(self, column: Any, row: Any) -> tuple[Components, Components]:
        """One origin, a direction per place."""
        right, up, forward = self.axes()
        toward = Components.of(forward) + self.off_axis(right, up, column, row)
        return Components.of(self.position), normalize(toward)


CAMERAS: dict[str, type[Camera]] = {camera.type_name: camera for camera in (OrthographicCamera, PerspectiveCamera)}
