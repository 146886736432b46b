"""What the fit accepts as a picture, and as numbers about it."""

from typing import Any

import numpy as np

import brdf
from brdf.errors import InputError
from fitting.pixel_survey import TOP


def check_levels(saturation: Any, dark: Any, noise: Any) -> None:
    """Refuse what is no level of a picture.

    Args:
        saturation: None or a linear value.
        dark: None or a linear value.
        noise: None or (read, shot).

    Raises:
        InputError: naming the one that is wrong.
    """
    for name, value in (("saturation", saturation), ("dark", dark)):
        if value is not None and (isinstance(value, bool) or not isinstance(value, int | float) or not value == value):
            raise InputError(name, f"must be a linear value, got {value!r}", "Give a number")
    if noise is None:
        return
    words = "Give (read, shot): the variance of a value is read² + shot · value"
    try:
        read, shot = (float(part) for part in noise)
    except (TypeError, ValueError):
        raise InputError("noise", f"must be two numbers, got {noise!r}", words) from None
    if not (0 <= read < np.inf and 0 <= shot < np.inf and read + shot > 0):
        raise InputError("noise", f"must be two numbers of 0 or more, not both 0, got {noise!r}", words)


def per_pixel(name: str, values: Any, shape: tuple[int, int]) -> np.ndarray:
    """A value per pixel as an array.

    Args:
        name: of the argument.
        values: array-like.
        shape: height and width of the picture.

    Raises:
        InputError: where it is of another shape.
    """
    values = np.asarray(values)
    if values.shape != shape:
        raise InputError(name, f"is of shape {values.shape}, the target {shape}", "Give a value per pixel")
    return values


def pixels_of(target: Any) -> tuple[Any, float | None, float]:
    """Values (H, W, C), the largest code where it is known, and the distance of two codes.

    Args:
        target: an array, a `brdf.Picture`, or a `brdf.ImageReader`, which comes back as it is.

    Raises:
        InputError: where it holds no linear floating-point values.
    """
    saturation, step = None, 0.0
    if isinstance(target, brdf.ImageReader):
        largest, step = target.codes
        return target, None if largest is None else largest * TOP, step
    if isinstance(target, brdf.Picture):
        steps = target.quantisation()
        step = 0.0 if steps is None else float(np.nanmax(steps))
        saturation = None if target.saturation is None else target.saturation * TOP
        target = target.pixels
    if isinstance(target, str | bytes) or not hasattr(target, "__array__"):
        raise InputError("target", f"must be an array, got {type(target).__name__}", "Read it with brdf.read_image")
    pixels = np.asarray(target)
    if pixels.dtype.kind != "f":
        came = f"must hold linear floating-point values, got {pixels.dtype}"
        raise InputError("target", came, "Read it with brdf.read_image, or divide by the largest code")
    if pixels.dtype == np.float16:
        step, pixels = float(np.finfo(np.float16).eps), pixels.astype(np.float32)
    if pixels.ndim == 2:
        pixels = pixels[..., None]
    if pixels.ndim != 3 or 0 in pixels.shape:
        raise InputError("target", f"must be of shape (H, W, C), got {pixels.shape}", "Give one picture")
    return pixels, saturation, step
