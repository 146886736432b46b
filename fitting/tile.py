"""A picture, or a band of its rows, ready for the solver; and what a fitted material shows of one."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import brdf
from brdf.geometry.rays import Sight
from brdf.lobes import STORED_SAMPLES, Near
from brdf.precision import Precision, cast, working_precision
from brdf.rendering import basis
from fitting.light_colour import coefficient_factors, take_colour_out
from fitting.likelihood import Bounds
from fitting.solver.normal_equations import FEW_VALUES, Picture


class Tile(NamedTuple):
    """A picture, or a band of its rows, ready for the solver.

    Attributes:
        target: (P, C), in the precision of the fit.
        weight: (P,), 0 where the pixel does not count; None where all do, and alike.
        points: what the pixels see, (rows, W).
        scene: of the picture, in the precision of the fit.
        bounds: between which codes each value lay before rounding; None for values that no rounding touched.
    """

    target: Float[Array, "P C"]
    weight: Float[Array, " P"] | Float[Array, "P C"] | None
    points: Sight
    scene: brdf.Scene
    bounds: Bounds | None = None


def picture_of(model: type[brdf.Material], tile: Tile, near: Near | None = None) -> Picture:
    """A tile as the solver takes it; ``near`` is that of `brdf.rendering.basis`."""
    ambient = np.zeros(1) if tile.scene.ambient is None else np.asarray(tile.scene.ambient, np.float64)
    # What a file's largest code stands for has no weight, but a say.
    counts = None if tile.weight is None or tile.bounds is not None else np.asarray(tile.weight) > 0
    images = basis(model, tile.scene, points=tile.points, near=near, counts=counts)
    diffuse = images.diffuse
    if diffuse is None:
        diffuse = jnp.zeros((tile.target.shape[0], 1), tile.target.dtype)
    return Picture(tile.target, diffuse, images.lobe, tile.weight, ambient, tile.bounds)


def drawn(material: brdf.Material, scene: brdf.Scene, precision: Precision) -> Float[np.ndarray, "H W C"]:
    """What `brdf.render` makes of a fitted material; a small picture by programs that a fit has loaded."""
    (width, height), channels = scene.resolution, max(scene.channels, material.k_d.size)
    with working_precision(precision):
        colour, (grey,) = take_colour_out([cast(scene, precision)], channels)
        points, samples = grey.sight(), sum(len(light.rows[1][0]) for light in grey.lights)
        if points.area is not None or samples > STORED_SAMPLES or width * height * channels > FEW_VALUES:
            return np.asarray(brdf.render(material, scene, precision=precision))
        nothing = jax.device_put(np.zeros((width * height, channels), precision))
        picture, n = picture_of(type(material), Tile(nothing, None, points, grey)), float(getattr(material, "n", 1.0))
        k = np.stack([np.broadcast_to(getattr(material, name, 0.0), channels) for name in ("k_a", "k_d", "k_s")])
        # By the colour itself: of a channel without light the factor is 1.
        by = coefficient_factors(type(material), n, np.ones(channels)) * [np.ones(channels), colour, colour]
        values = picture.predict(n, k * by)
        return np.where(np.ravel(points.mask)[:, None], values, 0).reshape(height, width, channels)
