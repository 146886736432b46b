"""What the fit accepts as a picture, and as numbers about it."""

import math
from numbers import Real
from typing import Any

import numpy as np

import brdf
from brdf.errors import InputError
from fitting.pixel_statistics import TOP


def check_levels(saturation: Any, dark: Any, noise: Any) -> tuple[float, float] | None:
    """Refuse what is no level of a picture.

    Args:
        saturation: None or a linear value.
        dark: None or a linear value.
        noise: None or (read, shot).

    Returns:
        The noise, as numbers.

    Raises:
        InputError: naming the one that is wrong.
    """
    for name, value in (("saturation", saturation), ("dark", dark)):
        if value is not None and (isinstance(value, bool) or not isinstance(value, Real) or math.isnan(value)):
            raise InputError(name, f"must be a linear value, got {value!r}", "Give a number")
    if saturation is not None and not saturation > 0:
        raise InputError("saturation", f"must be above 0, got {saturation}", "Give the value of clipped pixels")
    if noise is None:
        return None
    words = "Give (read, shot): the variance of a value is read² + shot · value"
    try:
        read, shot = (float(part) for part in noise)
    except (TypeError, ValueError):
        raise InputError("noise", f"must be two numbers, got {noise!r}", words) from None
    if not (0 <= read < np.inf and 0 <= shot < np.inf and read + shot > 0):
        raise InputError("noise", f"must be two numbers of 0 or more, not both 0, got {noise!r}", words)
    return read, shot


def pictures_and_scenes(
    target: Any, scene: Any, mask: Any, weight: Any
) -> tuple[list[Any], list[brdf.Scene], list[Any], list[Any]]:
    """What was given for one picture or for several, as lists of one length.

    Args:
        target: a picture or a list of them.
        scene: a scene for all, or a list.
        mask: likewise, or None.
        weight: likewise.

    Raises:
        InputError: where they are not as many, or a scene is none.
    """
    several = isinstance(target, list | tuple)
    targets = list(target) if several else [target]
    scenes = list(scene) if isinstance(scene, list | tuple) else [scene] * len(targets)
    masks, weights = (
        list(values) if several and isinstance(values, list | tuple) else [values] * len(targets)
        for values in (mask, weight)
    )
    if not targets:
        raise InputError("target", "is an empty list", "Give at least one picture")
    for name, values in (("scene", scenes), ("mask", masks), ("weight", weights)):
        if len(values) != len(targets):
            raise InputError(name, f"has {len(values)} entries for {len(targets)} pictures", "Give one for each")
    if not all(isinstance(one, brdf.Scene) for one in scenes):
        raise InputError("scene", f"must be a brdf.Scene, got {type(scene).__name__}", "Use brdf.Scene.load")
    return targets, scenes, masks, weights


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
    if values.dtype.kind not in "biuf" or not np.all(np.isfinite(values)):
        raise InputError(name, f"must hold finite numbers, got {values.dtype}", "Give a value per pixel")
    return values


def check_weight(weight: Any, shape: tuple[int, int]) -> np.ndarray:
    """How much each pixel counts, as an array.

    Args:
        weight: array-like.
        shape: height and width of the picture.

    Raises:
        InputError: where it is of another shape, or counts nothing, or less than that.
    """
    weight = per_pixel("weight", weight, shape)
    if not np.all(weight >= 0) or not np.any(weight > 0):
        raise InputError("weight", "must be 0 or more, and more somewhere", "Give values of 0 or more")
    return weight


def looked_at(mask: Any, weight: Any) -> Any:
    """Pixels that a mask allows and that weigh something, (H, W); None where all do.

    Args:
        mask: as given to `fitting.fit`, checked.
        weight: likewise.
    """
    given = [np.asarray(mask).astype(bool)] if mask is not None else []
    given += [np.asarray(weight) > 0] if weight is not None else []
    return np.logical_and.reduce(given) if given else None


def relative_weights(weights: list[Any]) -> list[Any]:
    """Weights of several pictures over the largest of them all, so that single precision holds them.

    Args:
        weights: an array or None for each picture; what is no array of numbers is passed on.
    """
    arrays = [None if weight is None else np.asarray(weight) for weight in weights]
    numeric = [array for array in arrays if array is not None and array.dtype.kind in "biuf" and array.size]
    largest = max((float(np.max(array)) for array in numeric), default=1.0)
    if not 0 < largest < np.inf or len(numeric) < sum(array is not None for array in arrays):
        return arrays
    return [None if array is None else array / largest for array in arrays]


def check_sizes(pixels: Any, scene: brdf.Scene) -> None:
    """Refuse a picture that is not of its scene's size, or not of its light's channels.

    Args:
        pixels: what has a shape (H, W, C).
        scene: what it shows.

    Raises:
        InputError: naming the target.
    """
    height, width, channels = pixels.shape
    if (width, height) != scene.resolution:
        came = f"is {width} x {height}, the scene's camera {scene.resolution[0]} x {scene.resolution[1]}"
        raise InputError("target", came, "Give a picture and a camera of the same resolution")
    if scene.channels not in (1, channels):
        came = f"has {channels} channels, the scene's light {scene.channels}"
        raise InputError("target", came, "Give both the same number of channels")


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


def check_range(n_range: Any) -> None:
    """Refuse what are no bounds of the exponent.

    Args:
        n_range: 0 < lower < upper.

    Raises:
        InputError: naming it.
    """
    try:
        low, high = (float(bound) for bound in n_range)
    except (TypeError, ValueError):
        low = high = math.nan
    if not 0 < low < high < math.inf:
        raise InputError("n_range", f"must be 0 < lower < upper, got {n_range}", "Correct the bounds")
