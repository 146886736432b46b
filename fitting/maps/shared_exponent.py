"""An n that texels share: sought as that of one, with the sums of all in place of its own."""

import dataclasses
import math
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Int

import brdf
from brdf.errors import InputError
from brdf.models.base import SpecularMaterial
from brdf.precision import working_precision
from brdf.vectors import quotient
from fitting.maps.map_bands import fit_bands
from fitting.maps.texels import STEPS, grid, narrowed, peaks, per_deviation, rivals
from fitting.maps.tiles import MapProblem
from fitting.uncertainty.intervals import NORMAL_95, student_95

BEYOND = 2 * math.log(2.0)
"""Of log n: so far from what normals of their own say may lie what is found with them."""


def label_map(labels: Any, problem: MapProblem) -> Int[np.ndarray, "H W"]:
    """Which texels share n: whole numbers, (H, W), one for all, or a file in which each colour is one."""
    (model, *more), size = problem.models, problem.photographs.size[:2]
    if more or not issubclass(model, SpecularMaterial):
        raise InputError("labels", "need one model with an exponent", "Name the model, as blinn-phong")
    if isinstance(labels, str | Path):
        with brdf.ImageReader(labels, encoding="linear") as reader:
            codes = np.round(reader.read() * (2**reader.bits - 1)).astype(int)
        labels = np.zeros(codes.shape[:2], int)
        for channel in np.moveaxis(codes, -1, 0):
            # Of rows NumPy sorts a hundred times as long.
            labels = np.unique((labels << reader.bits) + channel, return_inverse=True)[1].reshape(labels.shape)
    labels = np.asarray(labels)
    if labels.dtype.kind not in "iub" or labels.shape not in ((), size):
        what = f"are of shape {labels.shape} and type {labels.dtype}, the photographs of {size}"
        raise InputError("labels", what, "Give a whole number for each texel, or 0")
    return np.broadcast_to(labels, size)


def with_shared_n(problem: MapProblem, labels: Int[np.ndarray, "H W"]) -> MapProblem:
    """The n that texels of one label share, and its error: the sums of its texels in place of those of one."""
    surface, size = problem.surface, labels.shape
    if surface.normal is None:
        surface = surface._replace(normal=fit_bands(problem)["normal"])
        problem = dataclasses.replace(problem, refine=True)
    names, index = np.unique(labels, return_inverse=True)
    index = index.reshape(size)

    def of_each(seek: str, log_n: Any) -> np.ndarray:
        there = surface._replace(shared=np.stack([np.asarray(log_n)[index], np.zeros(size)], axis=-1))
        found = fit_bands(dataclasses.replace(problem, surface=there, seek=seek))["sums"]
        return found.reshape(-1, found.shape[2]).T

    def added(each: np.ndarray) -> np.ndarray:
        return np.stack([np.bincount(index.ravel(), row, names.size) for row in each])

    def climbed(bracket: Any) -> np.ndarray:
        """Log n of a bracket, and the sums there: curvature, cost, degrees of freedom and squares of what is shown."""
        for _ in range(STEPS):
            slope, curvature, *_ = added(of_each("slope", bracket[0]))
            bracket = narrowed(bracket, slope, quotient(slope, curvature))
        return np.stack([bracket[0], *added(of_each("slope", bracket[0]))[1:]])

    with working_precision("float64"):
        each = of_each("gains", np.zeros(names.size))
        gains = jnp.asarray(added(each))
        heights, brackets = peaks(gains, grid(problem.finer))
        if problem.refine:  # the gains are those of normals that are each for another n
            brackets = brackets + np.array([[0.0], [-BEYOND], [BEYOND]])
        best = climbed(brackets[0])
        if np.any(rivals(heights, best[2])):
            other = climbed(brackets[1])
            best = np.where(other[2] < best[2], other, best)
        log_n, curvature, cost, freedom, square = best
        freedom = np.maximum(freedom, 1)
        tiny = np.finfo(float).tiny
        variance = np.maximum(cost / freedom, tiny) * (student_95(freedom) / NORMAL_95) ** 2
        error = np.sqrt(quotient(variance, curvature, np.inf))
        apart, worse = np.log(grid(problem.finer))[:, None] - log_n, square - cost - 2 * gains
        # Many texels that hardly tell add up to chance (Q. H. Vuong, Econometrica 57, 1989): what they differ by varies
        # by its square; what those differ by that tell n, by twice itself.
        nearest = np.argmin(np.abs(apart), axis=0)[index.ravel()]
        differ = np.abs(each[nearest, np.arange(index.size)] - each)
        chance = added(np.minimum(differ / variance[index.ravel()], 2) * differ)
        share = per_deviation(worse * np.clip(worse / np.maximum(chance, tiny), 0, 1), variance)
        error = np.maximum(error, np.max(share * np.abs(apart), axis=0))
    shared = np.stack([log_n[index], error[index]], axis=-1)
    return dataclasses.replace(problem, surface=surface._replace(shared=shared))
