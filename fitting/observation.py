"""What a fit looks at: the pixels that count, and the light's colour taken out of them."""

import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

import brdf
from brdf.errors import InputError

# A plateau of exactly equal largest values has to be larger than symmetry makes it before it counts as clipping.
SYMMETRIC_PIXELS = 8
# Where the diffuse basis varies by less than this over the plateau, the surface is flat there and nothing is clipped.
FLAT = 1e-3
# What counts as the largest value: a few units in the last place of float32 below it, for what follows clamping.
TOP = 1 - 1e-6


class Observation(NamedTuple):
    """One picture, ready for the engine.

    Attributes:
        target: (P, C), in the precision of the fit.
        weight: (P,), 1 where the pixel counts, else 0; None where all do.
        points: what the pixels see, (H, W).
        left_out: how many pixels were left out, by reason.
        noise: standard deviation of the error that rounding puts into a value; (C,).
        brightest: largest size of a value that counts; (C,).
    """

    target: Float[Array, "P C"]
    weight: Float[Array, " P"] | None
    points: brdf.SurfacePoints
    left_out: dict[str, int]
    noise: Float[np.ndarray, " C"]
    brightest: Float[np.ndarray, " C"]


def observe(
    target: Any,
    scene: brdf.Scene,
    *,
    dtype: Any,
    mask: Any = None,
    saturation: float | None = None,
    dark: float | None = None,
    noise: tuple[float, float] | None = None,
) -> Observation:
    """Decide which pixels of a picture count.

    Args:
        target: (H, W) or (H, W, C) linear values, or a `brdf.Picture`, which knows its largest code.
        scene: of the same resolution.
        dtype: float32 or float64.
        mask: (H, W), pixels to look at.
        saturation: linear value from which on pixels are clipped; None finds out.
        dark: linear value up to which pixels are too dark to count: none of their channels exceeds it.
        noise: of the camera, (read, shot): the variance of a value is read² + shot · value, and pixels weigh by it.

    Raises:
        InputError: where nothing is left to fit.
    """
    _check_levels(saturation, dark, noise)
    pixels, known_saturation, step = _pixels(target)
    height, width, channels = pixels.shape
    if (width, height) != scene.resolution:
        came = f"is {width} x {height}, the scene's camera {scene.resolution[0]} x {scene.resolution[1]}"
        raise InputError("target", came, "Give a picture and a camera of the same resolution")
    if scene.channels not in (1, channels):
        came = f"has {channels} channels, the scene's light {scene.channels}"
        raise InputError("target", came, "Give both the same number of channels")
    points = brdf.cast(scene, dtype.name).surface_points()
    left_out: dict[str, int] = {}
    values = jnp.asarray(pixels.reshape(-1, channels), dtype)
    seen = jnp.ravel(points.mask)
    looked_at = seen
    if mask is not None:
        mask = np.asarray(mask, dtype=bool)
        if mask.shape != (height, width):
            came = f"is of shape {mask.shape}, the target {(height, width)}"
            raise InputError("mask", came, "Give a value per pixel")
        looked_at = seen & mask.ravel()
    survey = jax.device_get(_survey(values, seen, looked_at))
    left_out["outside the fitted shapes"] = int(seen.size - survey.seen)
    if not survey.seen:
        raise InputError("target", "has no pixel that sees a fitted shape", "Check camera, shapes and mask")
    if mask is not None:
        left_out["masked"] = int(survey.seen - survey.looked_at)
        if not survey.looked_at:
            raise InputError("mask", "leaves no pixel that sees a fitted shape", "Check the mask")
    left_out["not finite"] = int(survey.looked_at - survey.count)
    if not survey.count:
        raise InputError("target", "has no finite value on the object", "Give a picture with values")
    if not survey.scale.any():
        raise InputError("target", "is black on the object", "Give a picture with light in it")
    level = known_saturation if saturation is None else saturation
    good, scale, count = survey.good, survey.scale, int(survey.count)
    if level is None and survey.top > SYMMETRIC_PIXELS:
        brightest = np.max(np.asarray(values), axis=-1).reshape(height, width)
        level = _plateau(brightest, float(survey.largest), good.reshape(height, width), points, scene)
    if level is not None and survey.largest >= level:
        good, scale, below = jax.device_get(_between(values, good, -jnp.inf, level))
        left_out["clipped"] = count - int(below)
        count = int(below)
        if not count or not scale.any():
            came = f"is clipped at {level:g} wherever it sees the object"
            raise InputError("target", came, "Give a darker exposure or a higher saturation")
    elif level is not None:
        left_out["clipped"] = 0
    if dark is not None:
        good, scale, above = jax.device_get(_between(values, good, dark, jnp.inf))
        left_out["dark"] = count - int(above)
        count = int(above)
        if not count:
            came = f"is no brighter than {dark:g} wherever it counts"
            raise InputError("target", came, "Give a brighter picture or a lower dark level")
    weight = None if count == good.size else jnp.asarray(good, dtype)
    if noise is not None:
        weight = _weigh(values, jnp.asarray(good), (height, width), *noise, step)
    rounding = max(float(np.finfo(dtype).eps), float(np.finfo(pixels.dtype).eps))
    error = np.maximum(scale.astype(np.float64) * rounding, step / np.sqrt(12.0))
    return Observation(values, weight, points, left_out, error, scale.astype(np.float64))


class _Survey(NamedTuple):
    """What there is to know of the pixels before they are chosen.

    Attributes:
        good: which see a fitted shape, are not masked and are finite, (P,).
        seen: how many see a fitted shape.
        looked_at: how many of these are not masked.
        count: how many are good.
        largest: value of any channel among the good ones.
        top: how many of these share it.
        scale: largest size of a value, (C,).
    """

    good: Any
    seen: Any
    looked_at: Any
    count: Any
    largest: Any
    top: Any
    scale: Any


@jax.jit
def _survey(values: Float[Array, "P C"], seen: Bool[Array, " P"], looked_at: Bool[Array, " P"]) -> _Survey:
    brightest = _over_channels(jnp.maximum, values)
    good = looked_at & jnp.isfinite(_over_channels(jnp.add, values))
    largest = jnp.max(jnp.where(good, brightest, -jnp.inf))
    top = jnp.count_nonzero(good & (brightest >= largest * TOP))
    count = jnp.count_nonzero
    return _Survey(good, count(seen), count(looked_at), count(good), largest, top, _scale(values, good))


@jax.jit
def _between(values: Float[Array, "P C"], good: Bool[Array, " P"], dark: float, level: float) -> tuple[Any, Any, Any]:
    brightest = _over_channels(jnp.maximum, values)
    good = good & (brightest > dark) & (brightest < level)
    return good, _scale(values, good), jnp.count_nonzero(good)


def _check_levels(saturation: Any, dark: Any, noise: Any) -> None:
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


@functools.partial(jax.jit, static_argnums=2)
def _weigh(
    values: Float[Array, "P C"], good: Bool[Array, " P"], shape: tuple[int, int], read: float, shot: float, step: float
) -> Float[Array, " P"]:
    """Inverse variances over their mean; a pixel's channels share the variance of their mean value.

    The value is the mean of 5 x 5 pixels: taken from the pixel itself, weights would favour what noise made darker.
    """
    mean = jnp.where(good, _over_channels(jnp.add, values) / values.shape[1], 0.0)
    count = good.astype(values.dtype)
    total, known = _boxed(mean.reshape(shape)).ravel(), _boxed(count.reshape(shape)).ravel()
    smooth = jnp.maximum(total / jnp.maximum(known, 1.0), 0.0)
    # Without read noise a black pixel would weigh infinitely much: quantisation, or a millionth of the mean, stands in.
    least = 1e-6 * shot * jnp.sum(mean) / jnp.maximum(jnp.sum(count), 1.0) + jnp.finfo(values.dtype).tiny
    variance = jnp.maximum(read * read + shot * smooth + step * step / 12.0, least)
    weight = jnp.where(good, jnp.min(jnp.where(good, variance, jnp.inf)) / variance, 0.0)
    return (weight * (jnp.sum(count) / jnp.sum(weight))).astype(values.dtype)


def _boxed(image: Float[Array, "H W"]) -> Float[Array, "H W"]:
    return jax.lax.reduce_window(image, np.zeros((), image.dtype), jax.lax.add, (5, 5), (1, 1), "SAME")


def _over_channels(combine: Any, values: Float[Array, "P C"]) -> Float[Array, " P"]:
    return functools.reduce(combine, [values[:, channel] for channel in range(values.shape[1])])


def _scale(values: Float[Array, "P C"], good: Bool[Array, " P"]) -> Float[Array, " C"]:
    return jnp.max(jnp.where(good[:, None], jnp.abs(values), 0), axis=0)


def _pixels(target: Any) -> tuple[np.ndarray, float | None, float]:
    """Values (H, W, C), the largest code where it is known, and the distance of two codes."""
    saturation, step = None, 0.0
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


def _plateau(
    brightest: np.ndarray, largest: float, good: np.ndarray, points: brdf.SurfacePoints, scene: brdf.Scene
) -> float | None:
    """The level at which a picture is clipped: many pixels at exactly the largest value, on a surface lit unevenly."""
    top = good & (brightest >= largest * TOP)
    if np.count_nonzero(top) <= SYMMETRIC_PIXELS or not scene.lights:
        return None
    diffuse = brdf.basis_images(brdf.Lambert, scene, points=points).diffuse
    light = np.max(np.asarray(diffuse), axis=-1)[top]
    return None if np.ptp(light) <= FLAT * np.max(light) else largest * TOP


def weighted(observation: Observation, weight: Any) -> Observation:
    """An observation whose pixels count as much as is said.

    Args:
        observation: a picture.
        weight: (H, W), at least 0; None leaves it as it is.

    Raises:
        InputError: where it has another shape, or is negative or not finite.
    """
    if weight is None:
        return observation
    weight, shape = np.asarray(weight), observation.points.mask.shape
    if weight.shape != shape:
        raise InputError("weight", f"is of shape {weight.shape}, the target {shape}", "Give a value per pixel")
    if not np.all(np.isfinite(weight) & (weight >= 0)):
        raise InputError("weight", "holds values that are negative or not finite", "Give values of 0 or more")
    values = jnp.asarray(weight.ravel(), observation.target.dtype)
    return observation._replace(weight=values if observation.weight is None else values * observation.weight)


class LightColour(NamedTuple):
    """The colour that all lights of some scenes share, and the scenes with grey lights in their place.

    Attributes:
        colour: (C,), what to multiply the grey light by; all 1 where the lights differ in colour.
        scenes: with lights of one channel, or as they were where the lights differ in colour.
    """

    colour: Float[np.ndarray, " C"]
    scenes: list[brdf.Scene]


def take_colour_out(scenes: Sequence[brdf.Scene], channels: int) -> LightColour:
    """Split lights of one chromaticity into grey lights and a colour: then all channels share their basis images.

    Args:
        scenes: any number.
        channels: of the picture.
    """
    emittances = [np.asarray(light.emittance, np.float64) for scene in scenes for light in scene.lights]
    unchanged = LightColour(np.ones(channels), list(scenes))
    if not emittances or all(emittance.shape[0] == 1 for emittance in emittances):
        return unchanged
    table = np.stack([np.broadcast_to(emittance, channels) for emittance in emittances])
    brightest = table[np.argmax(table.sum(axis=1))]
    if not brightest.any():
        return unchanged
    colour = brightest / brightest.max()
    strength = table @ colour / (colour @ colour)
    if np.max(np.abs(table - strength[:, None] * colour)) > 1e-12 * np.max(table):
        return unchanged
    each = iter(strength)
    return LightColour(colour, [_with_strengths(scene, each) for scene in scenes])


def _with_strengths(scene: brdf.Scene, strengths: Any) -> brdf.Scene:
    lights = [eqx.tree_at(lambda light: light.emittance, light, np.array([next(strengths)])) for light in scene.lights]
    return eqx.tree_at(lambda scene: scene.lights, scene, tuple(lights))


def fitted_pixels(observation: Observation) -> Bool[np.ndarray, "H W"]:
    """Which pixels counted, (H, W).

    Args:
        observation: a picture.
    """
    shape = observation.points.mask.shape
    if observation.weight is None:
        return np.ones(shape, bool)
    return np.asarray(jax.device_get(observation.weight) > 0).reshape(shape)
