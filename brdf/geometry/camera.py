"""Cameras: a ray through the centre of each pixel, and the direction in which each surface point is seen."""

import abc
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Int

from brdf.checks import direction_value, number, positive, sample_number, vector
from brdf.errors import InputError
from brdf.vectors import normalize

MAX_RESOLUTION = 1 << 16
MAX_SAMPLES = 256


def _resolution(value: Any) -> tuple[int, int]:
    """Two whole numbers, width and height in pixels."""
    remedy = "Give [width, height] in pixels"
    try:
        width, height = value
    except (TypeError, ValueError):
        raise InputError("resolution", f"must be two whole numbers, got {value!r}", remedy) from None
    for size in (width, height):
        if isinstance(size, bool) or not isinstance(size, int | np.integer):
            raise InputError("resolution", f"must be two whole numbers, got {value!r}", remedy)
        if not 1 <= size <= MAX_RESOLUTION:
            raise InputError("resolution", f"must be between 1 and {MAX_RESOLUTION}, got {value!r}", remedy)
    return int(width), int(height)


def _viewer(value: Any) -> str | None:
    """Where the eye is taken to be."""
    if value not in (None, "local", "infinite"):
        raise InputError("viewer", f"must be 'local' or 'infinite', got {value!r}", "Correct the value")
    return value


def _samples(value: Any) -> int:
    """Samples along each side of a pixel."""
    return sample_number(value, MAX_SAMPLES)


class Camera(eqx.Module):
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

    position: Float[Array, "3"] = eqx.field(converter=vector("position"), kw_only=True)
    target: Float[Array, "3"] = eqx.field(converter=vector("target"), kw_only=True)
    up: Float[Array, "3"] = eqx.field(converter=direction_value("up"), kw_only=True)
    resolution: tuple[int, int] = eqx.field(static=True, converter=_resolution, kw_only=True)
    viewer: str | None = eqx.field(static=True, default=None, converter=_viewer, kw_only=True)
    samples: int = eqx.field(static=True, converter=_samples, default=1, kw_only=True)
    type_name: ClassVar[str]
    default_viewer: ClassVar[str]

    @abc.abstractmethod
    def rays_through(
        self, x: Float[Array, "*#batch"], y: Float[Array, "*#batch"]
    ) -> tuple[Float[Array, "*batch 3"], Float[Array, "*batch 3"]]:
        """Origin and unit direction of the rays through places of the picture.

        Args:
            x: to the right of the picture's middle, in units of half its width.
            y: up from it, in the same unit.
        """

    def rays(
        self, first: Int[ArrayLike, ""] = 0, count: int | None = None
    ) -> tuple[Float[Array, "rows width 3"], Float[Array, "rows width 3"]]:
        """Origin and unit direction of the ray through each pixel's centre.

        Args:
            first: row.
            count: of rows; None for all from the first one on.
        """
        return self.rays_through(*self.picture_plane(first, count))

    def places_in_pixels(
        self, pixel: Int[Array, " K"], right: Float[Array, " M"], down: Float[Array, " M"]
    ) -> tuple[Float[Array, "K M"], Float[Array, "K M"]]:
        """Places of the picture, for `rays_through`.

        Args:
            pixel: indices, row by row.
            right: places in each pixel, from 0 at its left edge to 1.
            down: from 0 at its upper edge to 1.
        """
        width, height = self.resolution
        column, row = (pixel % width)[:, None] + right, (pixel // width)[:, None] + down
        return column * 2.0 / width - 1.0, height / width - row * 2.0 / width

    def __check_init__(self):
        """Refuse a camera without a picture plane."""
        if not all(isinstance(value, np.ndarray) for value in (self.position, self.target, self.up)):
            return
        forward = np.asarray(self.target) - np.asarray(self.position)
        length = float(np.linalg.norm(forward))
        if length == 0:
            came = f"must differ from position, got {np.asarray(self.target).tolist()} for both"
            raise InputError("target", came, "Move one of them")
        area = float(np.linalg.norm(np.cross(forward, self.up)))
        if area <= 1e-9 * length * float(np.linalg.norm(self.up)):
            came = f"must not be parallel to the view, got {np.asarray(self.up).tolist()}"
            raise InputError("up", came, "Give a direction that points up in the picture")

    def axes(self) -> tuple[Float[Array, "3"], Float[Array, "3"], Float[Array, "3"]]:
        """Unit vectors to the right and up in the picture, and forward into it."""
        forward = normalize(self.target - self.position)
        right = normalize(jnp.cross(forward, self.up))
        return right, jnp.cross(right, forward), forward

    def picture_plane(
        self, first: Int[ArrayLike, ""] = 0, count: int | None = None
    ) -> tuple[Float[Array, "1 width"], Float[Array, "rows 1"]]:
        """Pixel centres, x to the right and y up, in units of half the picture's width; of some rows, see `rays`."""
        width, height = self.resolution
        x = (jnp.arange(width) + 0.5) * 2.0 / width - 1.0
        y = height / width - (jnp.arange(height if count is None else count) + first + 0.5) * 2.0 / width
        return x[None, :], y[:, None]

    def to_view(self, position: Float[Array, "*batch 3"]) -> Float[Array, "*batch 3"]:
        """Unit directions from surface points towards the eye."""
        if (self.viewer or self.default_viewer) == "local":
            return normalize(self.position - position)
        _, _, forward = self.axes()
        return jnp.broadcast_to(-forward, position.shape)


class OrthographicCamera(Camera):
    """Parallel rays.

    Args:
        position, target, up, resolution, viewer, samples: see `Camera`.
        width: of the picture, in world units, greater than 0.

    Raises:
        InputError: where a value is not finite or spans no picture.
    """

    width: Float[Array, ""] = eqx.field(converter=positive("width"), kw_only=True)
    type_name: ClassVar[str] = "orthographic"
    default_viewer: ClassVar[str] = "infinite"

    def rays_through(
        self, x: Float[Array, "*#batch"], y: Float[Array, "*#batch"]
    ) -> tuple[Float[Array, "*batch 3"], Float[Array, "*batch 3"]]:
        """Origins on the plane through ``position``, one direction."""
        right, up, forward = self.axes()
        half_width = self.width / 2
        origins = self.position + half_width * (x[..., None] * right + y[..., None] * up)
        return origins, jnp.broadcast_to(forward, origins.shape)


class PerspectiveCamera(Camera):
    """Rays from one point.

    Args:
        position, target, up, resolution, viewer, samples: see `Camera`.
        fov: the vertical angle of the picture in degrees, between 0 and 180.

    Raises:
        InputError: where a value is not finite or spans no picture.
    """

    fov: Float[Array, ""] = eqx.field(converter=number("fov", above=0.0, below=180.0), kw_only=True)
    type_name: ClassVar[str] = "perspective"
    default_viewer: ClassVar[str] = "local"

    def rays_through(
        self, x: Float[Array, "*#batch"], y: Float[Array, "*#batch"]
    ) -> tuple[Float[Array, "*batch 3"], Float[Array, "*batch 3"]]:
        """One origin, a direction per place."""
        right, up, forward = self.axes()
        width, height = self.resolution
        half_width = jnp.tan(jnp.deg2rad(self.fov) / 2) * (width / height)
        directions = normalize(forward + half_width * (x[..., None] * right + y[..., None] * up))
        return jnp.broadcast_to(self.position, directions.shape), directions


CAMERAS: dict[str, type[Camera]] = {camera.type_name: camera for camera in (OrthographicCamera, PerspectiveCamera)}
