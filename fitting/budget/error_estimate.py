"""How far a cheap fit is from the dear one, told beforehand: from a few pixels of the cheap fit alone.

At the optimum θ of a cheap fit, with the residual r and the derivatives J of the model by the parameters at some pixels
of weight w, the normal matrix is H = Σ w JᵀJ, and what makes the fit cheap is a shift of θ to first order:

* pixels left out: their scores w Jᵀr are missing. The variance V of that sum gives the covariance H⁻¹ V H⁻¹ of θ. V is
  that of a stratified sum with one pixel per stratum, taken from the differences of neighbouring strata (Cochran 1977,
  Sampling Techniques, section 5A.12). Where the model is exact and there is no noise, no pixel is missed.
* light samples left out: H⁻¹ Jᵀ (fine − coarse), the model with more light samples less the model with those used.
* rounding: a few units in the last place. What it does where terms nearly add up to one another, or to the edges of
  hard shadows, is not estimated but avoided, in float64.

The first is random, and is told as the median and the 95 % quantile of what it does; the others are added to it.
"""

from typing import NamedTuple

import numpy as np

import brdf
from brdf.precision import working_precision
from fitting.budget.configurations import MOST_SAMPLES, Run, some_of
from fitting.budget.sampling import MadeLights, PixelSample, sample_pixels, with_samples
from fitting.light_colour import coefficient_factors, take_colour_out
from fitting.solver.nnls import scaled_inverse

# Pixels at which the model is evaluated, of all pictures together and of each at least; filled up to a multiple of
# `FILLED`, so that few programs are compiled.
PROBES, FEWEST_PROBES, FILLED = 640, 64, 128
DRAWS = 512
# Columns of length 1 that leave less than this of one another make float32 lose most of its digits.
DEPENDENT = 0.01
# A kind of coefficient that is smaller than this share of the largest one counts as if it were so large.
SMALLEST = 0.01
# What light samples leave out is told to first order only: the bound allows for this factor.
MARGIN = 2.0
# Of log n, for the difference that stands for the lobe's derivative: to 1e-6 of it.
STEP_OF_LOG_N = 1e-4
# What a sum of so many samples is compared with: the next step, as a factor.
STEP = 4


class Estimate(NamedTuple):
    """The error of a cheap fit, relative: see `fitting.speed_accuracy.parameter_deviation`.

    Attributes:
        error: its median.
        bound: not exceeded in 95 % of cases.
        pixels: the part (bound) of the pixels left out.
        light: the part of the light samples left out.
        rounding: the part of rounding.
    """

    error: float
    bound: float
    pixels: float
    light: float
    rounding: float


def estimate(run: Run, lights: MadeLights) -> Estimate:
    """The error of a fit; ``lights`` are those made so far."""
    optimum, how = run.result.optimum, run.configuration
    assert optimum is not None
    # More for a lobe so narrow that the rounding of directions counts against its width.
    rounding = float(np.finfo(how.precision).eps * (3 + 0.01 * np.sqrt(max(optimum.n, 0.0))))
    if how.precision == "float32" and _nearly_dependent(optimum.gauss_newton):
        return Estimate(1.0, 1.0, 0.0, 0.0, 1.0)
    finer = None if how.samples is None or how.samples >= MOST_SAMPLES else min(STEP * how.samples, MOST_SAMPLES)
    if how.pixels is None and finer is None:
        return Estimate(rounding, 3 * rounding, 0.0, 0.0, rounding)
    grey = take_colour_out(run.problem.scenes, optimum.x.shape[1])
    system = _sums(run, grey.scenes, finer, lights)
    at_bound, known = np.append((optimum.x <= 0).ravel(), False), np.zeros(system.gradient.size, bool)
    known[: len(run.result.parameters)] = [one.value is not None for one in run.result.parameters]
    factors = coefficient_factors(type(run.result.material), optimum.n, grey.colour)
    k = np.where(known[:-1].reshape(3, -1), optimum.x / factors, 0.0)
    least = max(SMALLEST * float(np.max(k)), np.finfo(float).tiny)
    scale = np.append((np.maximum(np.max(k, axis=1), least)[:, None] * factors).ravel(), 1.0)
    told = (np.diag(system.hessian) > 0) & (known | ~at_bound)
    inverse = scaled_inverse(np.where(np.outer(told, told), system.hessian, 0.0), 1e-13)

    def above_bound(shift):
        """Coefficients at their bound leave it upwards only."""
        return np.where(at_bound, np.maximum(shift, 0.0), shift)

    def relative(shift):
        """The larger of the relative error of the picture and the largest one of a parameter."""
        parameters = np.max(np.where(known, np.abs(shift) / scale, 0.0), axis=-1)
        square = np.sum((shift @ system.hessian) * shift, axis=-1)
        return np.maximum(parameters, np.sqrt(np.maximum(square, 0.0) / system.square))

    value, vector = np.linalg.eigh(inverse @ system.spread @ inverse)
    draws = np.random.default_rng(0).standard_normal((DRAWS, value.size)) * np.sqrt(np.maximum(value, 0.0))
    # What the bound held back is part of it: without it such a coefficient would be off by chance alone.
    held = inverse @ np.where(at_bound, system.gradient, 0.0)
    drawn = above_bound(draws @ vector.T + held) - above_bound(held)
    missed = inverse @ system.light
    light, pixels = float(relative(missed)), float(np.quantile(relative(drawn), 0.95))
    error, bound = np.quantile(np.hypot(relative(drawn + missed), rounding), [0.5, 0.95])
    return Estimate(float(error), float(bound) + (MARGIN - 1) * light, pixels, light, rounding)


def jacobian_places(optimum):
    """From the columns of each channel to x_a, x_d, x_s, channel after channel each, and log n, (C, 4, U)."""
    channels = optimum.x.shape[1]
    place = np.zeros((channels, 4, 3 * channels + 1))
    for channel in range(channels):
        place[channel, range(3), channel + channels * np.arange(3)] = 1.0
        place[channel, 3, -1] = optimum.x[2, channel]
    return place


def _nearly_dependent(gram):
    """Whether the columns of a fit so nearly add up to one another that float32 cannot tell what they add up to."""
    size = np.sqrt(np.einsum("cii->ci", gram))
    size = np.where(size > 0, size, np.inf)  # a column of nothing depends on none
    normed = gram / (size[:, :, None] * size[:, None, :]) + np.isinf(size)[:, :, None] * np.eye(4)
    return np.any(np.linalg.eigvalsh(normed) < DEPENDENT**2)


def filled(pixel):
    """Pixels and more of them, so that few programs are compiled."""
    return np.pad(pixel, (0, FILLED - pixel.size % FILLED))


def at_probes(seen, model, n, channels):
    """Ambient, diffuse and lobe at the pixels of a scene made of some, (M, C, 3)."""
    with working_precision("float64"):
        lit = brdf.cast(seen, "float64")
        images = brdf.basis_images(model, lit, np.float64(n))
    factors = coefficient_factors(model, n, np.ones(channels))
    columns = np.zeros((seen.points.mask.size, channels, 3))
    for column, image in enumerate((images.ambient, images.diffuse, images.specular)):
        if image is not None:
            columns[..., column] = np.asarray(image)[0] / factors[column]
    return columns


def derivatives(seen, model, n, channels):
    """Of the picture by x_a, x_d, x_s and, for x_s = 1, log n, (M, C, 4)."""
    before, after = (at_probes(seen, model, n * np.exp(step), channels) for step in (-STEP_OF_LOG_N, STEP_OF_LOG_N))
    slope = (after[..., 2:] - before[..., 2:]) / (2 * STEP_OF_LOG_N)
    return np.concatenate([at_probes(seen, model, n, channels), slope], axis=-1)


class _Sums(NamedTuple):
    """Of x_a, x_d, x_s, channel after channel each, and log n, (P,).

    Attributes:
        hessian: Σ w JᵀJ, (P, P).
        gradient: Σ w Jᵀr, (P,).
        spread: variance of that sum by the choice of the pixels, (P, P).
        light: Σ w Jᵀ (fine − coarse), (P,).
        square: Σ w times the picture of the fit squared, which errors of the picture are relative to.
    """

    hessian: np.ndarray
    gradient: np.ndarray
    spread: np.ndarray
    light: np.ndarray
    square: float


def _sums(run, scenes, finer, lights):
    """Sums over some pixels of all pictures; ``finer`` is a number of light samples to compare with, or None."""
    problem, optimum, model = run.problem, run.result.optimum, type(run.result.material)
    channels = optimum.x.shape[1]
    size, place = 3 * channels + 1, jacobian_places(optimum)
    hessian, spread = np.zeros((size, size)), np.zeros((size, size))
    gradient, light, square = np.zeros(size), np.zeros(size), np.finfo(float).tiny
    most = max(FEWEST_PROBES, PROBES // len(problem.targets))
    pictures = zip(problem.targets, scenes, run.result.counted, run.samples, problem.weights, strict=True)
    for target, scene, counted, sample, weight in pictures:
        part, share, stride = probes(scene, model, counted.ravel(), sample, weight, most)
        share = share[:, None]

        seen = brdf.some_pixels(scene, filled(part.pixel), precision="float64")
        columns = derivatives(seen, model, optimum.n, channels)[: part.pixel.size]
        coarse = np.einsum("mck,kc->mc", columns[..., :3], optimum.x)
        # What does not count may be no number.
        residual = np.where(share > 0, some_of(target.pixels, part)[0] - coarse, 0.0)
        jacobian = np.einsum("mci,cip->mcp", columns, place)
        weighed = share[..., None] * jacobian
        scores = np.einsum("mcp,mc->mp", weighed, residual)
        hessian += np.einsum("mcp,mcq->pq", weighed, jacobian, optimize=True)
        gradient += scores.sum(axis=0)
        square += np.sum(share * coarse**2)
        if sample is not None:
            # A pixel here stands for `stride` pixels of the sample, whose own chance is what counts.
            chance = 1 - stride / np.maximum(part.stands_for, stride)
            change = np.diff(scores / stride, axis=0)
            spread += 0.5 * stride * (change * np.minimum(chance[1:], chance[:-1])[:, None]).T @ change
        if finer is not None:
            more = at_probes(with_samples(seen, finer, lights), model, optimum.n, channels)[: part.pixel.size]
            # A coarser model gives more of what it lacks, hence the sign.
            light -= np.einsum("mcp,mc->p", weighed, np.einsum("mck,kc->mc", more, optimum.x) - coarse)
    return _Sums(hessian, gradient, spread, light, square)


def probes(scene, model, counted, sample, weight, most):
    """At most so many of the fitted pixels that count, or that border on one that does in the sample's order.

    Returns:
        The pixels, the weight of each, and for how many fitted pixels each stands.
    """
    if sample is None:
        sample = sample_pixels(scene, model, round(most / max(float(np.mean(counted)), 1e-9)))
    if sample is None:
        sample = PixelSample(np.arange(counted.size), np.ones(counted.size))
    counts = counted[sample.pixel]
    near = counts.copy()
    # What the borders of the object take from a sample is part of its chance.
    near[1:] |= counts[:-1]
    near[:-1] |= counts[1:]
    index, stride = np.flatnonzero(near), 1.0
    if index.size > most:
        stride = index.size / most
        index = index[np.arange(most) * index.size // most]
    part = PixelSample(sample.pixel[index], sample.stands_for[index] * stride)
    given = 1.0 if weight is None else weight.ravel()[part.pixel]
    return part, np.where(counts[index], part.stands_for, 0.0) * given, stride
