"""Between the solver's numbers and the user's: the colour that all lights share, and the scale of the lobe.

The colour is taken out of the scenes, so that all channels share their basis images.
"""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float

import brdf
from brdf.models.base import SpecularMaterial


def take_colour_out(scenes: Sequence[brdf.Scene], channels: int) -> tuple[Float[np.ndarray, " C"], list[brdf.Scene]]:
    """Split lights of one chromaticity into grey lights and a colour, what to multiply the grey light by.

    1 and the scenes as they were where the lights differ in colour.
    """
    emittances = [np.asarray(emittance, np.float64) for emittance in _emittances(scenes)]
    unchanged = np.ones(channels), list(scenes)
    if all(emittance.shape[0] == 1 for emittance in emittances):
        return unchanged
    table = np.stack([np.broadcast_to(emittance, channels) for emittance in emittances])
    brightest = table[np.argmax(table.sum(axis=1))]
    if not brightest.any():
        return unchanged
    colour = brightest / brightest.max()
    strength = table @ colour / (colour @ colour)
    if np.max(np.abs(table - strength[:, None] * colour)) > 1e-12 * np.max(table):
        return unchanged
    return colour, eqx.tree_at(_emittances, list(scenes), list(strength[:, None]))


def _emittances(scenes: Sequence[brdf.Scene]) -> list[Any]:
    return [light.emittance for scene in scenes for light in scene.lights]


def coefficient_factors(
    model: type[brdf.Material], n: float | Float[np.ndarray, "N 1"], colour: Float[np.ndarray, " C"]
) -> Float[np.ndarray, "3 *N C"]:
    """What the solver's coefficients are divided by to give k_a, k_d, k_s; the colour was taken out of the lights."""
    colour, scale = np.where(colour > 0, colour, 1.0), 1.0
    if issubclass(model, SpecularMaterial):
        with jax.enable_x64(True):
            scale = np.asarray(model.scale(np.float64(n)))
    return np.stack(np.broadcast_arrays(1.0, colour, colour * scale))


def scale_growth(model: type[brdf.Material], n: float) -> float:
    """The derivative by n of the logarithm of a lobe's scale: 0 of the classic forms."""
    if not issubclass(model, SpecularMaterial):
        return 0.0
    # By differences: JAX takes milliseconds to differentiate one number.
    about = np.maximum(n + 1e-5 * (1 + n) * np.array([-1.0, 1.0]), 0.0)
    with jax.enable_x64(True):
        return float(np.diff(np.log(model.scale(about)))[0] / np.diff(about)[0])
