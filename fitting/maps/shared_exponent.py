"""An n that texels share: sought as that of one, with the sums of all in place of its own."""

import dataclasses
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

import brdf
from brdf.errors import InputError
from brdf.models.base import SpecularMaterial
from brdf.precision import working_precision
from fitting.maps.map_bands import Bands
from fitting.maps.map_inputs import Photographs
from fitting.maps.texels import STEPS, Bracket
from fitting.maps.tiles import How, Surface, steps_of_grid


def with_shared_n(given: Photographs, surface: Surface, how: How, labels: Any) -> Surface:
    """The n that texels of one label share, and its error: the sums of its texels in place of those of one."""
    (model, *more), (_, height, width, _) = how.models, given.shape
    if more or not issubclass(model, SpecularMaterial):
        raise InputError("labels", "need one model with an exponent", "Name the model, as blinn-phong")
    if surface.normal is None:
        surface = surface._replace(normal=Bands(given, surface, how).fit()["normal"])
    if isinstance(labels, str | Path):
        with brdf.ImageReader(labels, encoding="linear") as reader:
            labels = np.round(reader.read()[..., 0] * (2**reader.bits - 1)).astype(int)
    labels = np.asarray(labels)
    if labels.dtype.kind not in "iub" or labels.shape not in ((), (height, width)):
        came = f"are of shape {labels.shape} and type {labels.dtype}, the photographs of {(height, width)}"
        raise InputError("labels", came, "Give a whole number for each texel, or 0")
    names, index = np.unique(np.broadcast_to(labels, (height, width)), return_inverse=True)
    index = index.reshape(height, width)

    def summed(layer: np.ndarray) -> np.ndarray:
        weights = layer.reshape(-1, layer.shape[2]).T.astype(float)
        return np.stack([np.bincount(index.ravel(), values, names.size) for values in weights])

    def sought(seek: str, shared: Any) -> np.ndarray:
        there = surface._replace(shared=shared)
        (layer,) = Bands(given, there, dataclasses.replace(how, seek=seek)).fit().values()
        return summed(layer)

    with working_precision("float64"):
        bracket = Bracket.about_best(jnp.asarray(sought("gains", None)), steps_of_grid(given))

        def sums(log_n: Any) -> np.ndarray:
            shared = np.stack([np.asarray(log_n)[index], np.zeros((height, width))], axis=-1)
            return sought("slope", shared)

        for _ in range(STEPS):
            slope, curvature, _, _ = sums(bracket.log_n)
            bracket = bracket.narrowed(jnp.asarray(slope), jnp.asarray(curvature))
        log_n = np.asarray(bracket.log_n)
        _, curvature, cost, freedom = sums(log_n)
    noise = cost / np.maximum(freedom, 1)
    error = np.sqrt(np.divide(noise, curvature, out=np.full_like(noise, np.inf), where=curvature > 0))
    return surface._replace(shared=np.stack([log_n[index], error[index]], axis=-1))
