"""What a fit looks at: the pixels that count, and the light's colour taken out of them."""

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
# What counts as the largest value: a few units in the last place of float32 below it, for the arithmetic after clamping.
TOP = 1 - 1e-6


class Observation(NamedTuple):
    """One picture, ready for the engine.

    Attributes:
        target: (P, C), in the precision of the fit.
        weight: (P,), 1 where the pixel counts, else 0; None where all do.
        points: what the pixels see, (H, W).
        left_out: how many pixels were left out, by reason.
        noise: standard deviation of the error that rounding puts into a value; (C,).
    """

    target: Float[Array, "P C"]
    weight: Float[Array, " P"] | None
    points: brdf.SurfacePoints
    left_out: dict[str, int]
    noise: Float[np.ndarray, " C"]


def observe(
    target: Any,
    scene: brdf.Scene,
    *,
    dtype: Any,
    mask: Any = None,
    saturation: float | None = None,
) -> Observation:
    """Decide which pixels of a picture count.

    Args:
        target: (H, W) or (H, W, C) linear values, or a `brdf.Picture`, which knows its largest code.
        scene: of the same resolution.
        dtype: float32 or float64.
        mask: (H, W), pixels to look at.
        saturation: linear value from which on pixels are clipped; None finds out.

    Raises:
        InputError: where nothing is left to fit.
    """
    pixels, known_saturation, step = _pixels(target)
    height, width, channels = pixels.shape
    if (width, height) != scene.resolution:
        came = f"is {width} x {height}, the scene's camera {scene.resolution[0]} x {scene.resolution[1]}"
        raise InputError("target", came, "Give a picture and a camera of the same resolution")
    if scene.channels not in (1, channels):
        came = f"has {channels} channels, the scene's light {scene.channels}"
        raise InputError("target", came, "Give both the same number of channels")
    points = brdf.cast(scene, dtype.name).surface_points()
    seen = np.asarray(points.mask)
    left_out = {"outside the fitted shapes": int(seen.size - np.count_nonzero(seen))}
    if not seen.any():
        raise InputError("target", "has no pixel that sees a fitted shape", "Check camera, shapes and mask")
    if mask is not None:
        mask = np.asarray(mask, dtype=bool)
        if mask.shape != seen.shape:
            raise InputError("mask", f"is of shape {mask.shape}, the target {seen.shape}", "Give a value per pixel")
        left_out["masked"] = int(np.count_nonzero(seen & ~mask))
        seen = seen & mask
        if not seen.any():
            raise InputError("mask", "leaves no pixel that sees a fitted shape", "Check the mask")
    finite = np.isfinite(pixels.sum(axis=-1))
    left_out["not finite"] = int(np.count_nonzero(seen & ~finite))
    good = seen & finite
    if not good.any():
        raise InputError("target", "has no finite value on the object", "Give a picture with values")
    level = known_saturation if saturation is None else saturation
    brightest = np.max(pixels, axis=-1)
    largest = float(np.max(brightest, where=good, initial=-np.inf))
    if not np.any(pixels[good] != 0):
        raise InputError("target", "is black on the object", "Give a picture with light in it")
    if level is None:
        level = _plateau(brightest, largest, good, points, scene)
    if level is not None:
        clipped = good & (brightest >= level)
        left_out["clipped"] = int(np.count_nonzero(clipped))
        good &= ~clipped
        if not good.any():
            came = f"is clipped at {level:g} wherever it sees the object"
            raise InputError("target", came, "Give a darker exposure or a higher saturation")
    weight = None if good.all() else jnp.asarray(good.ravel(), dtype)
    scale = np.max(np.abs(pixels), axis=(0, 1), where=good[..., None], initial=0.0)
    rounding = max(float(np.finfo(dtype).eps), float(np.finfo(pixels.dtype).eps))
    noise = np.maximum(scale * rounding, step / np.sqrt(12.0))
    return Observation(jnp.asarray(pixels.reshape(-1, channels), dtype), weight, points, left_out, noise)


def _pixels(target: Any) -> tuple[np.ndarray, float | None, float]:
    """Values (H, W, C), the largest code where it is known, and the distance of two codes."""
    saturation, step = None, 0.0
    if isinstance(target, brdf.Picture):
        step = float(np.max(target.quantisation())) if target.saturation is not None else 0.0
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
    """The level at which a picture is clipped: many pixels at exactly the largest value, on a surface that is lit unevenly."""
    top = good & (brightest >= largest * TOP)
    if np.count_nonzero(top) <= SYMMETRIC_PIXELS or not scene.lights:
        return None
    diffuse = brdf.basis_images(brdf.Lambert, scene, points=points).diffuse
    light = np.max(np.asarray(diffuse), axis=-1)[top]
    return None if np.ptp(light) <= FLAT * np.max(light) else largest * TOP


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
