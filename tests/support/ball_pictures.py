"""Photographs of a matt ball, made in plain NumPy."""

import dataclasses
from pathlib import Path

import numpy as np

import brdf
from fitting.photographs.ball import Circle

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


def photograph_scene(seen: brdf.Scene, direction, *, ambient=None) -> brdf.Scene:
    """What pixels see under one distant light."""
    light = brdf.DirectionalLight(direction=direction, intensity=1.0)
    return dataclasses.replace(seen, lights=(light,), ambient=ambient)


def photographs_in(folder: Path) -> Path:
    """Three photographs of a matt ball, of known exposure and light, 16 bit; their lights; a mask of the ball."""
    lights = np.array([[0.3, 0.4, 0.86], [-0.5, 0.1, 0.86], [0.0, -0.5, 0.87]])
    exposures = [1.0, 0.5, 0.8]
    for index, (light, exposure) in enumerate(zip(lights, exposures, strict=True)):
        brdf.write_image(folder / f"{index}.png", shaded(light) * exposure, dtype="uint16", encoding="linear")
    np.savetxt(folder / "lights.txt", lights)
    brdf.write_image(folder / "mask.png", disc(BALL)[..., None].astype(np.float32))
    return folder
