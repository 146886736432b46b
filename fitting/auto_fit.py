"""The model that is fitted where none is named: every family first, then the simplest adequate candidate alone."""

from collections.abc import Sequence

import equinox as eqx
import numpy as np

import brdf
from fitting.core import Job, fit_model, forgotten, optimise
from fitting.selection import FAMILIES, Choice, choose
from fitting.solver.normal_equations import Picture
from fitting.solver.profile import fit_linear
from fitting.solver.streams import each
from fitting.solver.tied import fit_tied
from fitting.uncertainty.covariance import residual_noise
from fitting.uncertainty.interpretation import ModelFit, coefficient_factors
from fitting.uncertainty.noise_model import weighted_sums
from fitting.uncertainty.residual_correlation import structure

# An exponent up to this multiple of the lower bound is at the bound.
WIDEST = 1.01


def fit_simplest(job: Job) -> tuple[ModelFit, Choice]:
    """All families, then the simplest adequate candidate on its own.

    Args:
        job: the pictures.
    """
    names = job.families if job.lit[1].any() else ("lambert",)
    fits: dict[str, ModelFit] = {}
    for name in names:
        # The pictures of one model at a time are in memory.
        fits = {done: forgotten(fit, job) for done, fit in fits.items()}
        fits[name] = fit_model(brdf.MODELS[name], job)
    # A lobe that would be wider than the search allows is no highlight: it mends what Lambert's law leaves at the rim.
    fits = {name: fit for name, fit in fits.items() if fit.optimum.flat or fit.optimum.n > WIDEST * job.n_range[0]}
    fits = fits or {"lambert": fit_model(brdf.Lambert, job)}
    if job.loss != "squared":
        # Weights are part of what is minimised: those of the better family serve all, or costs could not be compared.
        name = min(fits, key=lambda name: float(np.sum(residual_noise(fits[name].optimum, job.rounding))))
        weighed = fits[name].pictures
        fits = {name: _with_weights_of(weighed, fit) for name, fit in fits.items()}
    grey = {name: coefficient_factors(fit.model, fit.optimum.n, job.light.colour)[2] for name, fit in fits.items()}
    best = min(fits.values(), key=lambda fit: float(np.sum(fit.optimum.cost)))
    noise = residual_noise(best.optimum, job.rounding)
    known = structure(best.pictures, job.shapes, best.optimum, job.rounding)
    free = np.logical_or.reduce([fit.free for fit in fits.values()])
    optima = {name: fit.optimum for name, fit in fits.items()}
    whitened = {}
    if known.noise is not None:
        # Each pixel by its own variance, or noise in bright pixels would pass for a highlight.
        whitened = {
            name: weighted_sums(fit.pictures, fit.optimum, known.noise, inverse=True) for name, fit in fits.items()
        }
    choice = choose(optima, free, grey, noise, known.inflation, whitened)
    matt = choice.model in FAMILIES
    chosen = list(fits.values())[-1] if matt else fits[choice.model]
    del best
    fits.clear()
    if all(observation.in_memory for observation in job.observations):
        chosen = chosen._replace(pictures=list(chosen.pictures))
    return (_matt(choice, chosen) if matt else _alone(choice, chosen, grey[choice.model])), choice


def _with_weights_of(weighed: Sequence[Picture], fit: ModelFit) -> ModelFit:
    def taken_over(picture: Picture, other: Picture) -> Picture:
        return eqx.tree_at(lambda p: p.weight, picture, other.weight)

    pictures = each(taken_over, fit.pictures, weighed)
    return fit._replace(pictures=pictures, optimum=optimise(pictures, fit.free, fit.n_range))


def _matt(choice: Choice, fit: ModelFit) -> ModelFit:
    """The chosen candidate without a highlight, fitted to the pixels without what it leaves out."""
    pictures = each(lambda p: Picture(p.target, p.diffuse, None, p.weight, p.ambient), fit.pictures)
    optimum = fit_linear(pictures, free=choice.free)
    return ModelFit(brdf.Lambert, pictures, optimum, choice.free, fit.n_range, None, fit.noise_factor)


def _alone(choice: Choice, fit: ModelFit, grey: np.ndarray) -> ModelFit:
    """The chosen candidate with a highlight, likewise; ``grey`` is how a grey k_s is tied, (C,)."""
    optimum = fit.optimum
    if not np.array_equal(choice.free, fit.free):
        optimum = optimise(fit.pictures, choice.free, fit.n_range)
    tied = grey if choice.grey else None
    if tied is not None:
        single = np.dtype(fit.pictures[0].target.dtype) == np.float32
        optimum = fit_tied(fit.pictures, optimum, choice.free, tied, fit.n_range, single=single)
    return fit._replace(optimum=optimum, free=choice.free, tied=tied)
