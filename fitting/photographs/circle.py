"""The outline of a ball in a photograph: as a person types it, or as a mask shows it.

This needs no JAX, whose import would keep a person waiting for an error.

Pixel coordinates have the centre of the upper left pixel at (0, 0), x to the right and y down; directions have x to the
right, y up and z to the camera.
"""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from brdf.errors import InputError
from fitting.photographs.light_files import parse_numbers

# A mask whose outline is further from a circle than this share of its radius, rms, is no ball.
ROUND = 0.05
# So much of the outline has to be on it; the rest may be specks.
OUTLINE = 0.8
SMALLEST_RADIUS = 4.0


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


def parse_circle(text: str, where: str = "--sphere") -> Circle:
    """A circle as a person types it.

    Args:
        text: "x,y,radius".
        where: the option, for the message.

    Raises:
        InputError: where it is none.
    """
    values = parse_numbers(text, where, 3, "x,y,radius in pixels")
    return check_circle(Circle(*values), where)


def check_circle(circle: Circle, where: str = "circle") -> Circle:
    """The circle, if it is one.

    Args:
        circle: to look at.
        where: for the message.

    Raises:
        InputError: where a number is not finite or the radius is too small to tell a normal.
    """
    if not np.all(np.isfinite(circle)):
        raise InputError(where, f"must be finite, got {tuple(circle)}", "Give x, y and radius in pixels")
    if circle.radius < SMALLEST_RADIUS:
        came = f"has a radius of {circle.radius:g} pixels, at least {SMALLEST_RADIUS:g} are needed"
        raise InputError(where, came, "Give a ball that is larger in the picture")
    return circle


def find_circle(mask: Any) -> Circle:
    """The ball in a mask: the circle through the outline, holes and specks disregarded.

    Args:
        mask: (H, W), true on the ball.

    Raises:
        InputError: where the mask is empty or its outline no circle.
    """
    mask = np.asarray(mask)
    if mask.ndim != 2:
        raise InputError("mask", f"must be of shape (H, W), got {mask.shape}", "Give a mask of one picture")
    inside = mask.astype(bool)
    rows, columns = np.flatnonzero(inside.any(axis=1)), np.flatnonzero(inside.any(axis=0))
    if rows.size == 0:
        raise InputError("mask", "is empty", "Give a mask that is white on the ball")
    height, width = inside.shape
    # The outermost pixels of every row and column; the outline is at their outer edge.
    left, right = np.argmax(inside[rows], axis=1) - 0.5, width - np.argmax(inside[rows, ::-1], axis=1) - 0.5
    top = np.argmax(inside[:, columns], axis=0) - 0.5
    bottom = height - np.argmax(inside[::-1, columns], axis=0) - 0.5
    x = np.concatenate([left, right, columns, columns]).astype(float)
    y = np.concatenate([rows, rows, top, bottom]).astype(float)
    # Area and centroid are the start, which holes and specks hardly move.
    centre_y, centre_x = (float(np.mean(index)) for index in np.nonzero(inside))
    circle = Circle(centre_x, centre_y, float(np.sqrt(np.count_nonzero(inside) / np.pi)))
    near = np.ones(x.size, bool)
    for _ in range(10):
        distance = np.abs(np.hypot(x - circle.x, y - circle.y) - circle.radius)
        near = distance <= max(1.0, 3 * float(np.median(distance)))
        circle = _circle_through(x[near], y[near])
    distance = np.abs(np.hypot(x - circle.x, y - circle.y) - circle.radius)
    off = float(np.sqrt(np.mean(distance[near] ** 2))) / max(circle.radius, 1e-9)
    if np.mean(near) < OUTLINE:
        off = float(np.sqrt(np.mean(distance**2))) / max(circle.radius, 1e-9)
    if off > ROUND:
        came = f"is no ball: its outline is {100 * off:.0f} % of the radius off a circle"
        raise InputError("mask", came, "Give the mask of a whole ball, or its circle")
    return check_circle(circle, "mask")


def _circle_through(x: Float[np.ndarray, " K"], y: Float[np.ndarray, " K"]) -> Circle:
    """The circle of least algebraic distance (Kåsa 1976)."""
    columns = np.stack([x, y, np.ones_like(x)], axis=1)
    a, b, c = np.linalg.lstsq(columns, x * x + y * y, rcond=None)[0]
    centre = 0.5 * a, 0.5 * b
    return Circle(float(centre[0]), float(centre[1]), float(np.sqrt(max(c + centre[0] ** 2 + centre[1] ** 2, 0.0))))


def ball_normals(shape: tuple[int, int], circle: Circle) -> tuple[Float[np.ndarray, "H W 3"], Bool[np.ndarray, "H W"]]:
    """The normal at the centre of each pixel of a photograph of a ball, seen from far away.

    Args:
        shape: height and width of the picture.
        circle: the ball's outline.

    Returns:
        Normals, 0 beside the ball; and which pixels show nothing but the ball. The outline runs through the others: a
        camera mixes what lies behind into them.

    Raises:
        InputError: where the circle is none or lies outside the picture.
    """
    check_circle(circle)
    height, width = shape
    x = (np.arange(width) - circle.x) / circle.radius
    y = -(np.arange(height)[:, None] - circle.y) / circle.radius
    squared = x * x + y * y
    half = 0.5 / circle.radius
    inside = (np.abs(x) + half) ** 2 + (np.abs(y) + half) ** 2 <= 1
    if not inside.any():
        came = f"{tuple(circle)} lies outside the picture of {width} x {height} pixels, or is smaller than one of them"
        raise InputError("circle", came, "x is to the right, y down, from the upper left pixel")
    normal = np.stack([*np.broadcast_arrays(x, y), np.sqrt(np.maximum(1 - squared, 0.0))], axis=-1)
    return np.where(inside[..., None], normal, 0.0), inside
