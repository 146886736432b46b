"""A ball in a photograph: its outline, as a person types it or a mask shows it, and what each pixel sees of it.

This needs no JAX, whose import would keep a person waiting for an error; `ball_points` alone does.

Pixel coordinates have the centre of the upper left pixel at (0, 0), x to the right and y down; directions have x to the
right, y up and z to the camera, which is taken to be far away (orthographic, view = +z).
"""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

import brdf
from brdf.errors import InputError

# A mask whose outline is further from a circle than this share of its radius, rms, is no ball.
ROUND = 0.05
# So much of the outline has to be on it; the rest may be specks.
OUTLINE = 0.8
SMALLEST_RADIUS = 4.0
# In sides of the picture: of a larger ball it shows normals within some ten degrees, which tell no light.
LARGEST_RADIUS = 5.0


class Circle(NamedTuple):
    """The outline of a ball.

    Attributes:
        x: of its centre, in pixels to the right of the centre of the upper left pixel.
        y: of its centre, in pixels below it.
        radius: in pixels.
    """

    x: float
    y: float
    radius: float


def find_circle(mask: Any) -> Circle:
    """The ball in a mask: the circle through the outline, holes and specks disregarded.

    Args:
        mask: (H, W), true on the ball.

    Raises:
        InputError: where the mask is empty or its outline no circle.
    """
    from scipy.optimize import least_squares  # it takes long to load

    inside = np.asarray(mask, bool)
    if not inside.any():
        raise InputError("mask", "is empty", "Give a mask that is white on the ball")
    outline = np.concatenate([_sides(inside), _sides(inside.T)[::-1]], axis=1)

    def beyond(circle: Any) -> np.ndarray:
        return np.hypot(outline[0] - circle[0], outline[1] - circle[1]) - circle[2]

    # Area and centroid are the start, which holes and specks hardly move.
    y, x = np.argwhere(inside).mean(axis=0)
    start = x, y, np.sqrt(np.count_nonzero(inside) / np.pi)
    circle = Circle(*least_squares(beyond, start, loss="cauchy").x.tolist())
    distance = np.abs(beyond(circle))
    near = distance <= max(1.0, 3 * np.median(distance))
    distance = distance[near] if np.mean(near) >= OUTLINE else distance
    off = np.sqrt(np.mean(distance**2)) / max(circle.radius, 1e-9)
    if off > ROUND:
        raise InputError(
            "mask",
            f"is no ball: its outline is {100 * off:.0f} % of the radius off a circle",
            "Give the mask of a whole ball, or its circle",
        )
    return circle


def _sides(inside: np.ndarray) -> np.ndarray:
    """The outer edges of the first and the last pixel in each row that has one: x and y, (2, K)."""
    rows = np.flatnonzero(inside.any(axis=1))
    first = np.argmax(inside[rows], axis=1) - 0.5
    last = inside.shape[1] - np.argmax(inside[rows, ::-1], axis=1) - 0.5
    return np.array([[*first, *last], [*rows, *rows]])


def ball_normals(shape: tuple[int, int], circle: Circle) -> Float[np.ndarray, "H W 3"]:
    """The normal at the centre of each pixel of a photograph of a ball, seen from far away.

    Args:
        shape: height and width of the picture.
        circle: the ball's outline.

    Returns:
        Normals; 0 beside the ball and where the outline runs through a pixel: a camera mixes what lies behind into it.

    Raises:
        InputError: where the circle is none, too small to tell a normal, far larger than the picture, or outside.
    """
    (height, width), size = shape, f"has a radius of {circle.radius:g} pixels"
    if not np.all(np.isfinite(circle)):
        raise InputError("circle", f"must be finite, got {tuple(circle)}", "Give x, y and radius in pixels")
    if circle.radius < SMALLEST_RADIUS:
        raise InputError(
            "circle", f"{size}, at least {SMALLEST_RADIUS:g} are needed", "Give a ball that is larger in the picture"
        )
    if circle.radius > LARGEST_RADIUS * max(shape):
        raise InputError(
            "circle",
            f"{size} in a picture of {width} x {height}, which is nearly flat there",
            "Give x,y,radius in pixels of this picture",
        )
    x = (np.arange(width) - circle.x) / circle.radius
    y = -(np.arange(height)[:, None] - circle.y) / circle.radius
    half = 0.5 / circle.radius
    inside = (np.abs(x) + half) ** 2 + (np.abs(y) + half) ** 2 <= 1
    if not inside.any():
        raise InputError(
            "circle",
            f"{tuple(circle)} lies outside the picture of {width} x {height} pixels, or is smaller than one of them",
            "x is to the right, y down, from the upper left pixel",
        )
    z = np.sqrt(np.maximum(1 - (x * x + y * y), 0.0))
    normal = np.stack(np.broadcast_arrays(x, y, z), axis=-1)
    return np.where(inside[..., None], normal, 0.0)


def ball_points(shape: tuple[int, int], circle: Circle) -> "brdf.SurfacePoints":
    """What the pixels of a photograph see of a ball.

    Args:
        shape: height and width of the picture.
        circle: the ball's outline.

    Returns:
        Points on the unit ball, (H, W); the mask is true where a whole pixel is on the ball.

    Raises:
        InputError: as `ball_normals`.
    """
    normal = ball_normals(shape, circle)
    return brdf.SurfacePoints.from_normals(normal, position=normal)


def ball_seen(shape: tuple[int, int], circle: Circle) -> "brdf.Scene":
    """A photograph of a ball as a scene without lights: the unit ball, and a camera far away to whom it is the circle.

    Args:
        shape: height and width of the picture.
        circle: the ball's outline, as `ball_normals` takes it.
    """
    (height, width), radius = shape, circle.radius
    x, y = (0.5 * (width - 1) - circle.x) / radius, (circle.y - 0.5 * (height - 1)) / radius
    place = {"position": [x, y, 4.0], "target": [x, y, 0.0], "up": [0.0, 1.0, 0.0]}
    camera = brdf.OrthographicCamera(**place, width=width / radius, resolution=(width, height))
    return brdf.Scene(camera=camera, shapes=(brdf.Sphere(center=[0.0, 0.0, 0.0], radius=1.0),))
