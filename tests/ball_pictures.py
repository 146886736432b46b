"""Photographs of a ball, made in plain NumPy."""

import numpy as np

from fitting.photographs.circle import Circle

BALL = Circle(30.3, 24.8, 21.6)
SHAPE = (52, 60)


def angle(a, b) -> float:
    a, b = np.asarray(a) / np.linalg.norm(a), np.asarray(b) / np.linalg.norm(b)
    return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b)))


def disc(circle: Circle, shape=SHAPE) -> np.ndarray:
    y, x = np.mgrid[: shape[0], : shape[1]]
    return (x - circle.x) ** 2 + (y - circle.y) ** 2 < circle.radius**2


def shaded(direction, k_d=0.8, circle: Circle = BALL, shape=SHAPE) -> np.ndarray:
    """Lambert's law on a ball, in plain numpy."""
    y, x = np.mgrid[: shape[0], : shape[1]]
    normal_x, normal_y = (x - circle.x) / circle.radius, -(y - circle.y) / circle.radius
    normal_z = np.sqrt(np.maximum(1 - normal_x**2 - normal_y**2, 0))
    light = np.asarray(direction) / np.linalg.norm(direction)
    value = k_d * np.maximum(normal_x * light[0] + normal_y * light[1] + normal_z * light[2], 0)
    return np.where(disc(circle, shape), value, 0.0)[..., None].astype(np.float32)
