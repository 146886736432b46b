"""How far a cheap fit is from the dear one, told beforehand: from a few pixels of the cheap fit alone.

At the optimum θ of a cheap fit, with the residual r and the derivatives J of the model by the parameters at some pixels
of weight w, the normal matrix is H = Σ w JᵀJ, and what makes the fit cheap is a shift of θ to first order:

* pixels left out: their scores w Jᵀr are missing. The variance V of that sum gives the covariance H⁻¹ V H⁻¹ of θ. V is
  that of Horvitz and Thompson 1952, J. Am. Stat. Assoc. 47, 663, for pixels taken each by itself: no less than that of
  one in each square of the picture. Where the model is exact and there is no noise, no pixel is missed.
* least squares, which a sample is fitted by: where noise does not spread values over some codes, or is cut off, the
  likelihood of all pixels says otherwise by up to half a code, or the noise.
* light samples left out: told by `fitting.budget.light_samples`, which looks at the same pixels.
* rounding: a few units in the last place. What it does where terms nearly add up to one another, or to the edges of
  hard shadows, is not estimated but avoided, in float64.

The first is random, and is told as the median and the 95 % quantile of what it does; the others are added to it.
"""

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

import brdf
from brdf.precision import working_precision
from brdf.vectors import quotient
from fitting.budget.choice import Attempt
from fitting.budget.configurations import Run
from fitting.budget.sampling import PixelSample, sample_pixels
from fitting.light_colour import coefficient_factors, take_colour_out
from fitting.result import FitResult
from fitting.solver.nnls import inverse_diagonal, scaled_inverse
from fitting.uncertainty.covariance import TERMS

# Pixels at which the model is evaluated, of all pictures together and of each at least; filled up to a multiple of
# `FILLED`, so that few programs are compiled.
PROBES, FEWEST_PROBES, FILLED = 640, 64, 128
DRAWS = 512
# Where squares of columns leave less than this of one another float32 loses most of its digits.
DEPENDENT = 1e-4
# A kind of coefficient that is smaller than this share of the largest one counts as if it were so large.
SMALLEST = 0.01
# Noise of less than this share of a code leaves what is lit evenly in one of them.
DITHERED = 0.5
# So many pixels that are as dark as any, where more is predicted than this share of the noise, are cut off there.
FEWEST_CUT, LIT = 3, 0.1
# Of log n, for the difference that stands for the lobe's derivative: to 1e-6 of it.
STEP = 1e-4


def sizes(result: FitResult) -> Float[np.ndarray, " 3"]:
    """Of k_a, k_d, k_s the largest channel, but no less than `SMALLEST` of the largest coefficient of all."""
    values = [[one.value or 0.0 for one in result.parameters if one.name == term] for term in TERMS]
    largest = np.array([max(of_term, default=0.0) for of_term in values])
    return np.maximum(largest, max(SMALLEST * largest.max(), np.finfo(float).tiny))


class Probes:
    """Some of the pixels that a fit counts, of all pictures, and what its model says of them, in float64.

    The U unknowns are x_a, x_d, x_s, channel after channel each, and log n.

    Attributes:
        weight: of each in the sums over all pixels, (M,).
        left_out: variance of what each adds to such a sum by the choice of the fit's pixels, over its square, (M,).
        shown: by the fit, (M, C).
        residual: the pictures less that, (M, C).
        jacobian: of what is shown by the unknowns, (M, C, U).
        hessian: Σ w JᵀJ, (U, U).
        known: which unknowns the fit determines, (U,).
        scale: what errors are relative to: of each the largest coefficient of its kind, 1 of log n.
    """

    def __init__(self, run: Run):
        """Choose them, and look at them."""
        problem, result, (self.x, self.n) = run.problem, run.result, (run.optimum.x, run.optimum.n)
        self.model, channels = type(result.material), self.x.shape[1]
        self.seen, parts, most = [], [], max(FEWEST_PROBES, PROBES // len(problem.targets))
        pictures = zip(problem.targets, problem.scenes, result.counted, run.samples, problem.weights, strict=True)
        for target, scene, counted, sample, weight in pictures:
            some = sample or sample_pixels(scene, self.model, most / float(np.mean(counted)))
            some = some or PixelSample(np.arange(counted.size), np.ones(counted.size))
            index = np.flatnonzero(some.of(counted))
            # Of how many that count each is one.
            stride = max(index.size / most, 1.0)
            index = index[(stride * np.arange(index.size / stride)).astype(int)]
            part = PixelSample(some.pixel[index], some.stands_for[index] * stride)
            left_out = (1 - stride / part.stands_for) / stride if sample else np.zeros(index.size)
            # Some twice, so that few programs are compiled.
            filled = np.pad(part.pixel, (0, -index.size % FILLED))
            self.seen.append((brdf.some_pixels(scene, filled, precision="float64"), index.size))
            heavy = part.stands_for * (1.0 if weight is None else part.of(weight)[0])
            parts.append((heavy, left_out, part.of(target.pixels)[0]))
        self.weight, self.left_out, values = map(np.concatenate, zip(*parts, strict=True))
        columns, below, above = (self._columns(problem.scenes, self.n * np.exp(step)) for step in (0.0, -STEP, STEP))
        self.shown = np.einsum("mck,kc->mc", columns, self.x)
        self.residual = values - self.shown
        by_log_n = self.x[2] * (above[..., 2] - below[..., 2]) / (2 * STEP)
        by_x = columns[..., None] * np.eye(channels)[:, None]  # (M, C, 3, C): of a channel its own coefficients alone
        self.jacobian = np.concatenate([by_x.reshape(*by_log_n.shape, -1), by_log_n[..., None]], axis=-1)
        self.hessian = np.einsum("m,mcp,mcq->pq", self.weight, self.jacobian, self.jacobian, optimize=True)
        self.known = np.zeros(3 * channels + 1, bool)
        self.known[: len(result.parameters)] = [one.value is not None for one in result.parameters]
        factors = coefficient_factors(self.model, self.n, take_colour_out(problem.scenes, channels)[0])
        self.scale = np.append((sizes(result)[:, None] * factors).ravel(), 1.0)

    def _columns(self, scenes: Sequence[brdf.Scene], n: float) -> Float[np.ndarray, "M C 3"]:
        """Ambient, diffuse and lobe at an exponent under the lights of some scenes."""
        found, channels = [], self.x.shape[1]
        factors = coefficient_factors(self.model, n, np.ones(channels))
        for (seen, count), grey in zip(self.seen, take_colour_out(scenes, channels)[1], strict=True):
            with working_precision("float64"):
                lit = brdf.cast(dataclasses.replace(seen, lights=grey.lights), "float64")
                images = brdf.basis_images(self.model, lit, np.float64(n))
            columns = np.zeros((count, channels, 3))
            for term, image in enumerate((images.ambient, images.diffuse, images.specular)):
                if image is not None:
                    columns[..., term] = np.asarray(image)[0, :count] / factors[term]
            found.append(columns)
        return np.concatenate(found)

    def under(self, scenes: Sequence[brdf.Scene]) -> Float[np.ndarray, "M C"]:
        """What the fit shows under the lights of other scenes."""
        return np.einsum("mck,kc->mc", self._columns(scenes, self.n), self.x)

    def scores(self, change: Float[np.ndarray, "M C"]) -> Float[np.ndarray, "M U"]:
        """By each pixel: w Jᵀ times a change of the picture."""
        return np.einsum("m,mcp,mc->mp", self.weight, self.jacobian, change, optimize=True)

    def error(self, shift: Float[np.ndarray, "*D U"]) -> Float[np.ndarray, "*D"]:
        """The larger of the relative error of the picture and the largest one of a parameter, unknowns being off."""
        parameters = np.max(np.where(self.known, np.abs(shift) / self.scale, 0.0), axis=-1)
        square = np.maximum(np.sum((shift @ self.hessian) * shift, axis=-1), 0.0)
        whole = self.weight @ np.sum(self.shown**2, axis=1) + np.finfo(float).tiny
        return np.maximum(parameters, np.sqrt(square / whole))


def estimate(run: Run) -> Attempt:
    """The error of a fit."""
    optimum, problem = run.optimum, run.problem
    # More for a lobe so narrow that the rounding of directions counts against its width.
    rounding = float(np.finfo(problem.precision).eps * (1 + 0.005 * np.sqrt(max(optimum.n, 0.0))))
    errors = [inverse_diagonal(gram, DEPENDENT)[np.diag(gram) > 0] for gram in optimum.gauss_newton]
    if problem.precision == "float32" and np.isinf(np.concatenate(errors)).any():
        return Attempt(1.0, 1.0, 0.0, 0.0, 1.0)
    samples = problem.sample_error(run.result.material.name)
    if samples is None and not any(run.samples):
        return Attempt(rounding, 9 * rounding, 0.0, 0.0, rounding)
    probes = Probes(run)
    # Coefficients at their bound count as if they were free, which makes no error smaller.
    determined = probes.known | np.append((optimum.x > 0).ravel(), True)
    inverse = scaled_inverse(probes.hessian * np.outer(determined, determined))
    scores = probes.scores(probes.residual)
    value, vector = np.linalg.eigh(inverse @ (probes.left_out * scores.T) @ scores @ inverse)
    drawn = np.random.default_rng(0).standard_normal((DRAWS, value.size)) * np.sqrt(np.maximum(value, 0.0)) @ vector.T
    light = 0.0 if samples is None else float(np.linalg.norm(probes.error(samples.shifts(determined))))
    squares = _by_least_squares(run, probes)
    error, bound = squares + np.quantile(np.hypot(probes.error(drawn), math.hypot(light, rounding)), [0.5, 0.95])
    pixels = squares + np.quantile(probes.error(drawn), 0.95)
    return Attempt(float(error), float(bound), float(pixels), light, rounding, squares=squares)


def is_dithered(noise: float, step: float) -> bool:
    """Whether noise spreads what is lit evenly over some codes: least squares tells all then, and far less without."""
    return noise**2 >= (DITHERED**2 + 1 / 12) * step**2


def _by_least_squares(run: Run, probes: Probes) -> float:
    """What a sample's least squares may say otherwise than the likelihood of all pixels."""
    noise, channels, even = float(np.max(run.result.noise)), probes.shown.shape[1], 0.0
    cut = bool(run.result.left_out.get("clipped"))
    for target, sample in zip(run.problem.targets, run.samples, strict=True):
        if sample is None or target.least_squares:
            continue
        if target.codes is not None and not is_dithered(noise, target.widest_step):
            even = max(even, 0.5 * target.codes.usual_step)
        else:
            # The least of the picture, where there is light.
            at_end = probes.shown + probes.residual <= np.nanmin(target.pixels)
            cut |= np.count_nonzero(at_end & (probes.shown > LIT * noise)) >= FEWEST_CUT
    every = cut * noise
    # All that is lit evenly is ambient light.
    off = np.maximum(every, even * (np.arange(len(probes.known)) < channels))
    size = np.sqrt(np.diag(probes.hessian) / np.sum(probes.weight))
    return float(probes.error(quotient(off, size)))
