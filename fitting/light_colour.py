"""The colour that all lights share, taken out of the scenes: then all channels share their basis images."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float

import brdf


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
