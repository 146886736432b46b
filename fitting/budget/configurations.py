"""Ways to run one fit: how many pixels and light samples, in which precision.

A configuration only says what differs; running it is `fitting.core.fit_pictures` of the problem that it makes.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

import brdf
from brdf.errors import InputError
from brdf.precision import Precision
from fitting.budget.sampling import MadeLights, PixelSample, sample_pixels, with_samples
from fitting.core import fit_pictures
from fitting.pixels import SYMMETRIC_PIXELS
from fitting.problem import TOP, FitProblem
from fitting.result import FitResult

MOST_SAMPLES = 4096


@dataclasses.dataclass(frozen=True)
class Configuration:
    """One way to run a fit.

    Attributes:
        model: "auto" or the name of a model.
        precision: "float32" or "float64".
        pixels: about how many of each picture are fitted; None for all.
        samples: of each light with an extent; None for those of the scene.
        solver: "separable", "lm" or "bfgs".
        tolerance: of the latter two, relative.
        least_squares: also where the picture holds codes, whose likelihood is the default.
    """

    model: str = "auto"
    precision: Precision = "float32"
    pixels: int | None = None
    samples: int | None = None
    solver: str = "separable"
    tolerance: float | None = None
    least_squares: bool = False

    def __str__(self) -> str:
        """In words, what is usual left out."""
        words = [self.model, self.precision, "all pixels" if self.pixels is None else f"{self.pixels} pixels"]
        words += [f"{self.samples} light samples"] if self.samples is not None else []
        words += ["least squares"] if self.least_squares else []
        words += [] if self.solver == "separable" else [f"{self.solver} to {self.tolerance:g}"]
        return ", ".join(words)

    def work(self, pixels: int, scenes: Sequence[brdf.Scene]) -> float:
        """Pixels times light samples, twice for float64, of several pictures of so many pixels."""
        counts = [(self.samples or count) if count else 1 for count in sample_counts(scenes)]
        pixels = min(self.pixels or pixels, pixels)
        return float(pixels * max(sum(counts), 1) * (2 if self.precision == "float64" else 1))


def sample_counts(scenes: Sequence[brdf.Scene]) -> list[int | None]:
    """Of each light the number of samples; None of one without an extent."""
    return [getattr(light, "samples", None) for scene in scenes for light in scene.lights]


class Run(NamedTuple):
    """What a configuration gave.

    Attributes:
        configuration: that ran: of all pixels where so few as were asked for would not do.
        problem: as the configuration made it, of whole pictures.
        samples: the pixels of each that were fitted; None for all.
        result: of the fit, for the user's own scenes.
    """

    configuration: Configuration
    problem: FitProblem
    samples: list[PixelSample | None]
    result: FitResult


def run(
    problem: FitProblem,
    configuration: Configuration,
    lights: MadeLights,
    n_range: tuple[float, float] | None = None,
) -> Run:
    """Run a fit in a configuration of the separable solver.

    Args:
        problem: pictures in memory.
        configuration: how.
        lights: made so far.
        n_range: bounds of the exponent, instead of those of the problem.
    """
    model, precision, pixels = configuration.model, configuration.precision, configuration.pixels
    scenes = [with_samples(scene, configuration.samples, lights) for scene in problem.scenes]
    n_range = n_range or problem.n_range
    made = dataclasses.replace(problem, scenes=scenes, model=model, precision=precision, n_range=n_range)
    if configuration.least_squares:
        plain = [target._replace(codes=None, least_squares=True) for target in problem.targets]
        made = dataclasses.replace(made, targets=plain)
    samples: list[PixelSample | None] = [None] * len(scenes)
    if pixels is not None:
        kind = brdf.BlinnPhong if model == "auto" else brdf.MODELS[model]
        shares = [1.0 if mask is None else max(float(np.mean(mask)), 1e-9) for mask in problem.masks]
        some = zip(scenes, shares, strict=True)
        samples = [sample_pixels(scene, kind, round(pixels / share)) for scene, share in some]
    whole = dataclasses.replace(configuration, pixels=None)
    try:
        result = fit_pictures(_subsampled(made, samples) if any(samples) else made)
    except InputError:
        if not any(samples):
            raise
        # Nothing to fit among so few pixels: all of them tell, or tell what is wrong.
        return run(problem, whole, lights, n_range)
    counted = list(result.counted)
    for index, sample in enumerate(samples):
        if sample is not None:
            counted[index] = np.zeros(scenes[index].resolution[::-1], bool)
            counted[index].ravel()[sample.pixel] = result.counted[index].ravel()
    targets = [target.pixels for target in problem.targets]
    result = dataclasses.replace(result, targets=targets, scenes=problem.scenes, counted=counted)
    return Run(configuration if any(samples) else whole, made, samples, result)


def _subsampled(problem, samples):
    """The problem of some pixels of its pictures, each of which weighs as many as it stands for."""
    targets, scenes, saturation = list(problem.targets), list(problem.scenes), problem.saturation
    masks, weights = list(problem.masks), list(problem.weights)
    for index, sample in enumerate(samples):
        target, weight, mask = targets[index], weights[index], masks[index]
        # Beside a picture of which some pixels are fitted, a pixel of a whole one stands for itself.
        weights[index] = np.ones(target.pixels.shape[:2]) if weight is None else weight
        if sample is None:
            continue
        pixels = some_of(target.pixels, sample)
        # Of pixels that stand for many the codes are a small part of what is not known.
        targets[index] = target._replace(pixels=pixels, codes=None, least_squares=True)
        scenes[index] = brdf.some_pixels(scenes[index], sample.pixel, precision=problem.precision)
        weights[index] = some_of(weights[index], sample) * sample.stands_for
        masks[index] = None if mask is None else some_of(mask, sample)
        if saturation is None and target.saturation is None:
            # Pixels may be clipped, so few of them in the sample that the fit would not notice.
            top = TOP * np.max(pixels, initial=-np.inf, where=np.isfinite(pixels))
            if 2 <= np.count_nonzero(pixels >= top) <= SYMMETRIC_PIXELS < np.count_nonzero(target.pixels >= top):
                saturation = float(top)
    how = {"targets": targets, "scenes": scenes, "masks": masks, "weights": weights, "saturation": saturation}
    return dataclasses.replace(problem, **how)


def some_of(values: Any, sample: PixelSample) -> np.ndarray:
    """What belongs to the pixels of a sample, as a picture of one row; values of (H, W) or (H, W, C)."""
    values = np.asarray(values)
    return values.reshape(-1, *values.shape[2:])[sample.pixel][None]
