"""Ways to run one fit: how many pixels and light samples, in which precision.

A configuration only says what differs; running it is `fitting.core.fit_pictures` of the problem that it makes.
"""

import dataclasses
from typing import NamedTuple

import numpy as np

import brdf
from brdf.errors import InputError
from brdf.precision import Precision
from fitting.budget.sampling import PixelSample, sample_counts, sample_pixels, with_samples
from fitting.core import fit_pictures
from fitting.pixels import SYMMETRIC_PIXELS
from fitting.problem import TOP, FitProblem
from fitting.result import FitResult
from fitting.solver.profile import Optimum


@dataclasses.dataclass(frozen=True)
class Configuration:
    """One way to run a fit.

    Attributes:
        model: "auto" or the name of a model.
        precision: "float32" or "float64".
        pixels: about how many of each picture are fitted; None for all.
        samples: of each light with an extent; None for as many as the problem says.
        solver: "separable", "lm" or "bfgs".
        least_squares: also where the picture holds codes, whose likelihood is the default.
    """

    model: str = "auto"
    precision: Precision = "float32"
    pixels: int | None = None
    samples: int | None = None
    solver: str = "separable"
    least_squares: bool = False

    def __str__(self) -> str:
        """In words, what is usual left out."""
        words = [self.model, self.precision, "all pixels" if self.pixels is None else f"{self.pixels} pixels"]
        words += [f"{self.samples} light samples"] if self.samples is not None else []
        words += ["least squares"] if self.least_squares else []
        words += [] if self.solver == "separable" else [self.solver]
        return ", ".join(words)

    def work(self, scene: brdf.Scene) -> float:
        """Of a picture pixels times light samples, twice for float64: what the time grows with."""
        pixels = min(self.pixels or np.inf, np.prod(scene.resolution))
        samples = [self.samples or count if count > 1 else 1 for count in sample_counts(scene)]
        return float(pixels * max(sum(samples), 1) * (2 if self.precision == "float64" else 1))


class Run(NamedTuple):
    """What a configuration gave.

    Attributes:
        problem: as the configuration made it, of whole pictures.
        samples: the pixels of each that were fitted; None for all.
        result: of the fit, for the user's own scenes.
    """

    problem: FitProblem
    samples: list[PixelSample | None]
    result: FitResult

    @property
    def optimum(self) -> Optimum:
        """Of the solver."""
        assert self.result.optimum is not None
        return self.result.optimum


def run(problem: FitProblem, configuration: Configuration) -> Run:
    """Run a fit in a configuration of the separable solver; of all pixels where so few as asked for would not do."""
    how, shown = configuration, problem.shown or problem.scenes
    problem = dataclasses.replace(problem, model=how.model, precision=how.precision)
    if how.samples is not None:
        scenes = [with_samples(scene, how.samples) for scene in problem.scenes]
        problem = dataclasses.replace(problem, scenes=scenes, shown=shown, sample_errors=None)
    if how.least_squares:
        targets = [target._replace(codes=None, least_squares=True) for target in problem.targets]
        problem = dataclasses.replace(problem, targets=targets)
    samples: list[PixelSample | None] = [None] * len(shown)
    if how.pixels is not None:
        kind = brdf.BlinnPhong if how.model == "auto" else brdf.MODELS[how.model]
        shares = [1.0 if mask is None else max(float(np.mean(mask)), 1e-9) for mask in problem.masks]
        pictures = zip(problem.scenes, shares, strict=True)
        samples = [sample_pixels(scene, kind, how.pixels / share) for scene, share in pictures]
    try:
        result = fit_pictures(_subsampled(problem, samples) if any(samples) else problem)
    except InputError:
        if not any(samples):
            raise
        # Nothing to fit among so few pixels: all of them tell, or tell what is wrong.
        return run(problem, dataclasses.replace(how, pixels=None))
    of_whole = {"targets": [target.pixels for target in problem.targets], "scenes": shown}
    for name in ("counted", "weights"):
        every = zip(getattr(result, name), samples, problem.targets, strict=True)
        of_whole[name] = [_in_whole(values, sample, target.pixels.shape[:2]) for values, sample, target in every]
    return Run(problem, samples, dataclasses.replace(result, **of_whole))


def _in_whole(values, sample, shape):
    """What belongs to the pixels of a sample, in the whole picture."""
    if values is None or sample is None:
        return values
    found = np.zeros(shape, values.dtype)
    found.reshape(-1)[sample.pixel] = values.ravel()
    return found


def _subsampled(problem, samples):
    """The problem of some pixels of its pictures, each of which weighs as many as it stands for."""
    pictures, saturation = [], problem.saturation
    given = zip(samples, problem.targets, problem.scenes, problem.masks, problem.weights, strict=True)
    for sample, target, scene, mask, weight in given:
        if sample is None:
            # Beside a picture of which some pixels are fitted, a pixel of a whole one stands for itself.
            weight = np.ones(target.pixels.shape[:2]) if weight is None else weight
            pictures.append((target, scene, mask, weight))
            continue
        pixels = sample.of(target.pixels)
        if saturation is None and target.saturation is None:
            # Pixels may be clipped, so few of them in the sample that the fit would not notice.
            top = TOP * np.max(pixels, initial=-np.inf, where=np.isfinite(pixels))
            if 2 <= np.count_nonzero(pixels >= top) <= SYMMETRIC_PIXELS < np.count_nonzero(target.pixels >= top):
                saturation = float(top)
        # Of pixels that stand for many the codes are a small part of what is not known.
        target = target._replace(pixels=pixels, codes=None, least_squares=True, opaque=None)
        scene = brdf.some_pixels(scene, sample.pixel, precision=problem.precision)
        mask = None if mask is None else sample.of(mask)
        stands_for = sample.stands_for[None]
        pictures.append((target, scene, mask, stands_for if weight is None else sample.of(weight) * stands_for))
    targets, scenes, masks, weights = map(list, zip(*pictures, strict=True))
    how = {"targets": targets, "scenes": scenes, "masks": masks, "weights": weights, "saturation": saturation}
    return dataclasses.replace(problem, **how)
