"""A flat polygon cut into triangles."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from brdf.errors import InputError

FLAT = 1e-6
"""How far a vertex may lie off the plane, as a share of the polygon's size: what six digits in a file leave."""


def newell_normal(vertices: Float[Array, "V 3"]) -> Float[Array, "3"]:
    """Twice the polygon's area times its normal, about which the vertices run counter-clockwise.

    Args:
        vertices: (V, 3), in order.

    Source: I. E. Sutherland, R. F. Sproull and R. A. Schumacker, ACM Computing Surveys 6 (1974), after M. Newell.
    """
    relative = vertices - vertices[0]
    return jnp.sum(jnp.cross(relative, jnp.roll(relative, -1, axis=0)), axis=0)


def triangulate(vertices: Any) -> tuple[tuple[int, int, int], ...]:
    """Cut off ears until a triangle is left; a fan where JAX is tracing the vertices.

    Args:
        vertices: (V, 3), in order.

    Returns:
        Corners of each triangle, in the orientation of the polygon.

    Raises:
        InputError: where the polygon has no area, is not flat or crosses itself.
    """
    if not isinstance(vertices, np.ndarray):
        return tuple((0, last - 1, last) for last in range(2, vertices.shape[0]))
    relative = vertices - vertices[0]
    size = float(np.max(np.abs(vertices - vertices.mean(axis=0))))
    area_vector = np.sum(np.cross(relative, np.roll(relative, -1, axis=0)), axis=0)
    double_area = float(np.linalg.norm(area_vector))
    if double_area <= 1e-12 * size * size:
        raise InputError("vertices", "span no area", "Give the corners of a polygon in order")
    normal = area_vector / double_area
    if np.max(np.abs(relative @ normal)) > FLAT * size:
        raise InputError("vertices", "do not lie in one plane", "Cut the light into flat polygons")
    across = np.linalg.svd(normal[None])[2][1]
    flat = relative @ np.stack([across, np.cross(normal, across)]).T
    return _cut_ears(flat)


def _cut_ears(flat: np.ndarray) -> tuple[tuple[int, int, int], ...]:
    """Meisters' ears; ``flat`` is (V, 2), counter-clockwise."""
    left, triangles = list(range(len(flat))), []
    while len(left) > 3:
        ear = next((i for i in range(len(left)) if _is_ear(flat, left, i)), None)
        if ear is None:
            raise InputError("vertices", "cross each other's edges", "Give the corners of a simple polygon in order")
        a, b, c = left[ear - 1], left[ear], left[(ear + 1) % len(left)]
        if _turn(flat[a], flat[b], flat[c]) > 0:
            triangles.append((a, b, c))
        left.pop(ear)
    return (*triangles, (left[0], left[1], left[2]))


def _is_ear(flat: np.ndarray, left: list[int], index: int) -> bool:
    a, b, c = left[index - 1], left[index], left[(index + 1) % len(left)]
    if _turn(flat[a], flat[b], flat[c]) < 0:
        return False
    others = [flat[other] for other in left if other not in (a, b, c)]
    corners = (flat[a], flat[b], flat[c])
    return not any(all(_turn(corners[i - 1], corners[i], point) > 0 for i in range(3)) for point in others)


def _turn(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> float:
    return float((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]))
