"""One model fitted to the pictures: from observations to the engine's arrays, and the search on them."""

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

import brdf
from brdf.models.base import SpecularMaterial
from brdf.precision import Precision
from brdf.rendering import basis
from fitting.light_colour import LightColour
from fitting.pixels import TILE_PIXELS, Observation, Tile
from fitting.solver.losses import Loss, reweight
from fitting.solver.normal_equations import Picture
from fitting.solver.profile import Optimum, fit_linear, search
from fitting.solver.streams import each, joined
from fitting.uncertainty.interpretation import ModelFit
from fitting.uncertainty.residual_correlation import nearest_peak

# The nearest pixel shows exp(-UNSEEN) of a highlight's peak, or more, or the exponent is not looked at.
UNSEEN = 60.0


class Job(NamedTuple):
    """What stays the same for every model.

    Attributes:
        observations: the pictures.
        light: and their lights, colour taken out.
        n_range: bounds of the exponent.
        loss: what is minimised.
        families: models with a highlight that are compared.
    """

    observations: list[Observation]
    light: LightColour
    n_range: tuple[float, float]
    loss: Loss
    families: tuple[str, ...]

    @property
    def shapes(self) -> Sequence[tuple[int, int]]:
        """Height and width of each tile."""
        return each(lambda tile: tile.points.mask.shape, self.tiles)

    @property
    def tiles(self) -> Sequence[Tile]:
        """Of all pictures; a stream where one of them is."""
        return joined([observation.tiles for observation in self.observations])

    @property
    def channels(self) -> int:
        """Of the pictures."""
        return self.observations[0].shown.shape[-1]

    @property
    def pixels(self) -> int:
        """Of all pictures that are shown."""
        return sum(observation.counted.size for observation in self.observations)

    @property
    def rounding(self) -> Float[np.ndarray, " C"]:
        """Standard deviation of a value's rounding."""
        return np.max([observation.noise for observation in self.observations], axis=0)

    @property
    def lit(self) -> Bool[np.ndarray, "2 C"]:
        """Which channels have ambient light, and which have lights."""
        ambient, direct = np.zeros(self.channels, bool), np.zeros(self.channels, bool)
        for scene in self.light.scenes:
            if scene.ambient is not None:
                ambient |= np.asarray(scene.ambient) > 0
            for one in scene.lights:
                direct |= np.asarray(one.emittance) * self.light.colour > 0
        return np.stack([ambient, direct])


def reached(model: type[brdf.Material], job: Job) -> Bool[np.ndarray, "3 C"]:
    """Which coefficients of a model the light reaches.

    Args:
        model: its class.
        job: the pictures.
    """
    ambient, direct = job.lit
    return np.stack([ambient, direct, direct & issubclass(model, SpecularMaterial)])


def _engine_pictures(model: type[brdf.Material], job: Job, *, keep: bool = True) -> Sequence[Picture]:
    def picture(tile: Tile, scene: brdf.Scene) -> Picture:
        dtype = tile.target.dtype
        precision: Precision = "float32" if dtype == np.float32 else "float64"
        ambient = np.zeros(1) if scene.ambient is None else np.asarray(scene.ambient, np.float64)
        images = basis(model, brdf.cast(scene, precision), points=tile.points)
        diffuse = jnp.zeros((tile.target.shape[0], 1), dtype) if images.diffuse is None else images.diffuse
        return Picture(tile.target, diffuse, images.lobe, tile.weight, ambient)

    pictures = []
    for observation, scene in zip(job.observations, job.light.scenes, strict=True):
        some = each(partial(picture, scene=scene), observation.tiles)
        pictures.append(list(some) if keep and observation.in_memory else some)
    return joined(pictures)


def _visible(pictures: Sequence[Picture], n_range: tuple[float, float]) -> tuple[float, float] | None:
    """Exponents of which some pixel sees at least a trace: with larger ones k_s could be anything; None without any."""
    nearest = max((nearest_peak(picture) for picture in pictures if picture.lobe is not None), default=0.0)
    upper = min(n_range[1], UNSEEN / max(-nearest, UNSEEN / n_range[1]))
    return (n_range[0], upper) if upper >= n_range[0] else None


def optimise(pictures: Sequence[Picture], free: Bool[np.ndarray, "3 C"], n_range: tuple[float, float]) -> Optimum:
    """The global optimum, over the exponent too where a highlight is free.

    Args:
        pictures: in the units of the engine.
        free: which coefficients may be above 0.
        n_range: bounds of the exponent.
    """
    if free[2].any():
        return search(pictures, n_min=n_range[0], n_max=n_range[1], free=free)
    return fit_linear(pictures, free=free)


def fit_model(model: type[brdf.Material], job: Job) -> ModelFit:
    """Fit one model with the loss that is asked for.

    Args:
        model: its class.
        job: the pictures.
    """
    free = reached(model, job)
    pictures = _engine_pictures(model, job)
    n_range = job.n_range
    if free[2].any():
        visible = _visible(pictures, job.n_range)
        n_range = visible or n_range
        free[2] &= visible is not None
    found = reweight(pictures, lambda some: optimise(some, free, n_range), job.loss, job.rounding)
    return ModelFit(model, found.pictures, found.optimum, free, n_range, None, found.noise_factor)


def forgotten(fit: ModelFit, job: Job) -> ModelFit:
    """The fit, its pictures made anew when they are asked for, where they are large.

    Args:
        fit: of any model.
        job: the pictures.
    """
    if job.pixels <= TILE_PIXELS or job.loss != "squared":
        return fit
    return fit._replace(pictures=_engine_pictures(fit.model, job, keep=False))


def without_highlight(fit: ModelFit, job: Job) -> ModelFit:
    """The fit of the same model with ambient and diffuse alone.

    Args:
        fit: of a model with a highlight.
        job: the pictures.
    """
    free = fit.free.copy()
    free[2] = False
    # The weights of a robust loss are part of what is fitted.
    pictures = fit.pictures if job.loss == "squared" else _engine_pictures(fit.model, job)
    found = reweight(pictures, lambda some: fit_linear(some, free=free), job.loss, job.rounding)
    return fit._replace(
        pictures=found.pictures, optimum=found.optimum, free=free, tied=None, noise_factor=found.noise_factor
    )
