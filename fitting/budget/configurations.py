"""Ways to run one fit: how many pixels and light samples, in which precision, with shadows or without.

A configuration only says what differs; running it is the front door, `fitting.fit`, on the scene that it makes.
"""

import dataclasses
import time
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np

import brdf
from brdf.errors import InputError
from brdf.precision import Precision, working_precision
from fitting.budget.lamps import Lamps
from fitting.budget.pixel_sampling import PixelSample, sample_pixels
from fitting.core import fit_pictures
from fitting.pixels import SYMMETRIC_PIXELS
from fitting.problem import TOP, Target, as_target, looked_at, state_problem
from fitting.result import FitResult


@dataclasses.dataclass(frozen=True)
class Configuration:
    """One way to run a fit.

    Attributes:
        model: "auto" or the name of a model.
        precision: "float32" or "float64".
        pixels: about how many of each picture are looked at; None for all.
        samples: of each light with an extent; None for those of the scene.
        shadows: whether shapes cast shadows.
        solver: "separable", "lm" or "bfgs".
        tolerance: of the latter two, relative.
    """

    model: str = "auto"
    precision: Precision = "float32"
    pixels: int | None = None
    samples: int | None = None
    shadows: bool = True
    solver: str = "separable"
    tolerance: float | None = None

    def __str__(self) -> str:
        """In words, what is usual left out."""
        words = [self.model, self.precision, "all pixels" if self.pixels is None else f"{self.pixels} pixels"]
        words += [f"{self.samples} light samples"] if self.samples is not None else []
        words += [] if self.shadows else ["no shadows"]
        words += [] if self.solver == "separable" else [f"{self.solver} to {self.tolerance:g}"]
        return ", ".join(words)


class Run(NamedTuple):
    """What a configuration gave.

    Attributes:
        result: of the fit, for the user's own targets and scenes.
        scenes: as the configuration made them, whole pictures.
        samples: the pixels of each that were looked at; None for all.
        seconds: from the targets to the result.
    """

    result: FitResult
    scenes: list[brdf.Scene]
    samples: list[PixelSample | None]
    seconds: float


def casts_shadows(scene: brdf.Scene) -> bool:
    """Whether any shape of a scene may stand in the light of what is seen.

    Args:
        scene: any.
    """
    return bool(scene.lights) and bool(scene.occluders)


def without_shadows(scene: brdf.Scene, precision: Precision) -> brdf.Scene:
    """The scene whose shapes cast no shadows.

    Args:
        scene: any.
        precision: in which its pixels are traced.
    """
    with working_precision(precision):
        points = brdf.cast(scene, precision).surface_points()
    points = eqx.tree_at(lambda p: p.visibility, points, None, is_leaf=lambda leaf: leaf is None)
    return dataclasses.replace(scene, camera=None, shapes=(), points=points)


def run(
    targets: Sequence[Any],
    scenes: Sequence[brdf.Scene],
    configuration: Configuration,
    options: Mapping[str, Any],
    lamps: Lamps,
    n_range: tuple[float, float] | None = None,
) -> Run:
    """Run a fit in a configuration of the separable solver.

    Args:
        targets: pictures.
        scenes: one for each.
        configuration: how.
        options: further arguments of `fitting.fit`: masks, saturation, ...
        lamps: the lights made so far.
        n_range: bounds of the exponent, instead of those of ``options``.
    """
    start = time.perf_counter()
    targets = [as_target(target) for target in targets]
    given, options = options, dict(options) | ({} if n_range is None else {"n_range": n_range})
    how: dict[str, Any] = {"model": configuration.model, "precision": configuration.precision}
    made = [lamps.with_samples(scene, configuration.samples) for scene in scenes]
    if not configuration.shadows:
        made = [without_shadows(scene, configuration.precision) for scene in made]
    masks, weights = (one_each(options.pop(name, None), len(made)) for name in ("mask", "weight"))
    samples: list[PixelSample | None] = [None] * len(made)
    if configuration.pixels is not None:
        kind = brdf.BlinnPhong if configuration.model == "auto" else brdf.MODELS[configuration.model]
        samples = [
            sample_pixels(scene, kind, round(configuration.pixels / max(share_counted(*cut), 1e-9)))
            for scene, *cut in zip(made, masks, weights, strict=True)
        ]
    pictures, places, some_masks, some_weights = [], [], [], []
    for target, scene, mask, weight, sample in zip(targets, made, masks, weights, samples, strict=True):
        if sample is None:
            pictures, places, some_masks = [*pictures, target], [*places, scene], [*some_masks, mask]
            some_weights.append(weight)
            continue
        pictures.append(some_of_target(target, sample))
        places.append(brdf.some_pixels(scene, sample.pixel, precision=configuration.precision))
        some_masks.append(None if mask is None else np.asarray(mask, bool).ravel()[sample.pixel][None])
        stated = 1.0 if weight is None else np.asarray(weight, np.float64).ravel()[sample.pixel]
        some_weights.append((sample.stands_for * stated)[None])
    if any(sample is not None for sample in samples):
        # Beside a picture that is looked at in parts, a pixel of a whole one stands for itself.
        some_weights = [
            np.ones(scene.resolution[::-1]) if one is None else one
            for scene, one in zip(made, some_weights, strict=True)
        ]
    saturation = options.pop("saturation", None)
    if saturation is None:
        saturation = _clipping(targets, pictures, samples)
    how |= {"saturation": saturation, **options}
    try:
        result = fit_pictures(state_problem(pictures, places, some_masks, some_weights, **how))
    except InputError:
        if all(sample is None for sample in samples):
            raise
        # Nothing to fit among so few pixels: all of them tell, or tell what is wrong.
        return run(targets, scenes, dataclasses.replace(configuration, pixels=None), given, lamps, n_range)
    result = dataclasses.replace(
        result,
        targets=[np.asarray(getattr(target, "pixels", target)) for target in targets],
        scenes=list(scenes),
        counted=[_all_of(*each) for each in zip(result.counted, samples, scenes, strict=True)],
    )
    return Run(result, made, samples, time.perf_counter() - start)


def one_each(values: Any, count: int) -> list[Any]:
    """An option of several pictures: the list that was given, or the same for each.

    Args:
        values: a list, or one for all.
        count: how many pictures.
    """
    return list(values) if isinstance(values, list | tuple) else [values] * count


def share_counted(mask: Any, weight: Any) -> float:
    """The share of a picture's pixels that mask and weight let count.

    Args:
        mask: (H, W), or None.
        weight: (H, W), or None.
    """
    kept = looked_at(mask, weight)
    return 1.0 if kept is None else float(np.mean(kept))


def _all_of(counted: np.ndarray, sample: PixelSample | None, scene: brdf.Scene) -> np.ndarray:
    """Which pixels of the whole picture counted, (H, W)."""
    if sample is None:
        return counted
    width, height = scene.resolution
    whole = np.zeros(height * width, bool)
    whole[sample.pixel] = counted.ravel()
    return whole.reshape(height, width)


def some_of_target(target: Any, sample: PixelSample) -> Target:
    """A picture of one row that holds the pixels of a sample.

    Args:
        target: a picture in memory.
        sample: which pixels.
    """
    whole = as_target(target)
    return whole._replace(pixels=whole.pixels.reshape(-1, whole.pixels.shape[-1])[sample.pixel][None])


def target_size(target: Any) -> int:
    """How many pixels a picture has.

    Args:
        target: (H, W) or (H, W, C), or a `brdf.Picture`.
    """
    shape = np.shape(getattr(target, "pixels", target))
    return shape[0] * shape[1]


def _clipping(targets: Sequence[Any], pictures: Sequence[Any], samples: Sequence[Any]) -> float | None:
    """The level at which pictures are clipped, where so few pixels of a sample are that `fit` would not notice."""
    for target, picture, sample in zip(targets, pictures, samples, strict=True):
        if sample is None or target.saturation is not None:
            continue
        some = np.asarray(picture.pixels)
        largest = np.max(some, initial=-np.inf, where=np.isfinite(some))
        count = np.count_nonzero(some >= largest * TOP)
        if (
            2 <= count <= SYMMETRIC_PIXELS
            and np.count_nonzero(np.asarray(target.pixels) >= largest * TOP) > SYMMETRIC_PIXELS
        ):
            return float(largest * TOP)
    return None
