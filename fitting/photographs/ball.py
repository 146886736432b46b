"""Photographs of a ball: what each pixel sees, and where the light comes from, without a camera file.

A circle in the picture gives every normal on the ball. Pixel coordinates have the centre of the upper left pixel at
(0, 0), x to the right and y down; directions have x to the right, y up and z to the camera, which is taken to be far
away (orthographic, view = +z).

The direction of a distant light comes from a mirror ball in the same place (`light_from_highlight`), or from the
shading of the matt ball itself (`light_from_shading`).
"""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

import brdf
from brdf.errors import InputError
from fitting.photographs.circle import Circle, ball_normals
from fitting.photographs.shading import fit_shading

# What belongs to a highlight: its core is looked for above one share of the brightest pixel; it reaches down to half of
# the brightest, within a share of the radius around it.
CORE, HIGHLIGHT, HIGHLIGHT_RADIUS = 0.9, 0.5, 0.12


def ball_points(shape: tuple[int, int], circle: Circle) -> brdf.SurfacePoints:
    """What the pixels of a photograph see of a ball.

    Args:
        shape: height and width of the picture.
        circle: the ball's outline.

    Returns:
        Points on the unit ball, (H, W); the mask is true where a whole pixel is on the ball.

    Raises:
        InputError: where the circle is none or lies outside the picture.
    """
    normal, _ = ball_normals(shape, circle)
    return brdf.SurfacePoints.from_normals(normal, position=normal)


def _grey(picture: Any) -> Float[np.ndarray, "H W"]:
    pixels = np.asarray(picture.pixels if isinstance(picture, brdf.Picture) else picture, np.float64)
    if pixels.ndim not in (2, 3) or 0 in pixels.shape:
        raise InputError("picture", f"must be of shape (H, W, C), got {pixels.shape}", "Read it with brdf.read_picture")
    return pixels if pixels.ndim == 2 else pixels.mean(axis=-1)


def _seen(points: brdf.SurfacePoints, mask: Any) -> Bool[np.ndarray, "H W"]:
    seen = np.asarray(points.mask)
    if mask is None:
        return seen
    if np.shape(mask) != seen.shape:
        raise InputError("mask", f"is of shape {np.shape(mask)}, the points {seen.shape}", "Give one of its size")
    return seen & np.asarray(mask, bool)


def light_from_highlight(picture: Any, circle: Circle, *, mask: Any = None) -> Float[np.ndarray, "3"]:
    """Direction towards a distant light from its reflection in a mirror ball.

    Args:
        picture: linear values, (H, W, C) or (H, W), or a `brdf.Picture`, of the mirror ball.
        circle: its outline.
        mask: (H, W), pixels to look at.

    Returns:
        The unit direction, 2 (N.V) N - V at the middle of the highlight.

    Raises:
        InputError: where the ball is not in the picture or shows no highlight.
    """
    grey = _grey(picture)
    points = ball_points((grey.shape[0], grey.shape[1]), circle)
    inside = _seen(points, mask) & np.isfinite(grey)
    largest = float(np.max(grey, where=inside, initial=-np.inf))
    if not largest > 0:
        raise InputError("picture", "is black on the mirror ball", "Give a picture with a highlight")
    rows, columns = np.nonzero(inside & (grey >= CORE * largest))
    if rows.size > 0.25 * np.count_nonzero(inside):
        raise InputError("picture", "has no highlight: a quarter of the ball is as bright", "Give a darker exposure")
    x, y = float(np.median(columns)), float(np.median(rows))
    if not np.any(np.hypot(columns - x, rows - y) <= HIGHLIGHT_RADIUS * circle.radius):
        # The median fell between two lights.
        x, y = float(columns[0]), float(rows[0])
    rows, columns = np.nonzero(inside & (grey >= HIGHLIGHT * largest))
    for _ in range(20):
        near = np.hypot(columns - x, rows - y) <= HIGHLIGHT_RADIUS * circle.radius
        x, y = float(columns[near].mean()), float(rows[near].mean())
    flat = np.array([(x - circle.x) / circle.radius, -(y - circle.y) / circle.radius])
    z = np.sqrt(max(1 - flat @ flat, 0.0))
    return np.array([2 * z * flat[0], 2 * z * flat[1], 2 * z * z - 1])


class ShadingLight(NamedTuple):
    """A distant light as the shading of a matt surface tells it.

    Attributes:
        direction: towards it, unit, (3,).
        strength: what a pixel that faces it shows: diffuse albedo times intensity.
        error: standard error of the direction in degrees, the root mean square of the angle to the true one, from the
            residual; it knows that what the model leaves goes together over parts of the surface, not what it does to
            the direction everywhere alike.
        pixels: how many told it.
    """

    direction: Float[np.ndarray, "3"]
    strength: float
    error: float
    pixels: int


def light_from_shading(
    picture: Any,
    points: brdf.SurfacePoints,
    *,
    saturation: float | None = None,
    mask: Any = None,
    ambient: bool = False,
) -> ShadingLight:
    """Direction of a distant light from the shading: Lambert's law and a highlight where the light comes in.

    Args:
        picture: linear values, (H, W, C) or (H, W), or a `brdf.Picture`.
        points: what each pixel sees.
        saturation: linear value from which on pixels are clipped; None takes the largest code of an integer file.
        mask: (H, W), pixels to look at.
        ambient: whether the surface is lit from all around as well.

    Returns:
        Direction and strength, found robustly so that highlights and cast shadows do not pull.

    Raises:
        InputError: where fewer than ten pixels are lit or they do not determine a direction.
    """
    grey = _grey(picture)
    if saturation is not None and not saturation > 0:
        raise InputError("saturation", f"must be a linear value above 0, got {saturation!r}", "Give a number")
    if isinstance(picture, brdf.Picture) and saturation is None:
        saturation = picture.saturation
    normal, shape = np.asarray(points.normal, np.float64), np.shape(points.mask)
    if grey.shape != shape:
        raise InputError("picture", f"is of shape {grey.shape}, the points {shape}", "Give points of its size")
    good = _seen(points, mask) & np.isfinite(grey)
    if saturation is not None:
        values = np.asarray(getattr(picture, "pixels", picture))
        good &= (values if values.ndim == 2 else np.max(values, axis=-1)) < saturation
    value, normal = grey[good], normal[good]
    found = fit_shading(value, normal, np.argwhere(good), ambient=ambient)
    strength = float(np.linalg.norm(found.light))
    return ShadingLight(found.light / strength, strength, found.error, found.pixels)


def photograph_scene(
    points: brdf.SurfacePoints, direction: Any, intensity: Any = 1.0, *, ambient: Any = None
) -> brdf.Scene:
    """The scene of a photograph under one distant light.

    Args:
        points: what the pixels see.
        direction: towards the light, (3,), of any length but 0.
        intensity: of it, a number or one per channel; where it is not known, 1: k_d then is k_d times the intensity.
        ambient: intensity of the ambient light, or None.

    Raises:
        InputError: naming the argument.
    """
    light = brdf.DirectionalLight(direction=direction, intensity=intensity)
    return brdf.Scene(points=points, lights=(light,), ambient=ambient)
