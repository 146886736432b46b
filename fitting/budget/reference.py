"""The fit that others are measured against: float64, all pixels, as many light samples as can be paid for.

A search evaluates the lobe some sixty times; from a good start two Gauss-Newton steps in residual form do, with one
evaluation each. So the reference starts from a fit under the lights as they are and steps under the finer ones.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import numpy as np

import brdf
from fitting.budget.budget import MOST_SAMPLES
from fitting.budget.configurations import Configuration, Run, run, target_size
from fitting.budget.lamps import Lamps, extended
from fitting.budget.linear_system import System
from fitting.light_colour import coefficient_factors, take_colour_out
from fitting.result import FitResult

# A step that changes the parameters by less than this, relative, is the last.
SETTLED = 1e-9
MOST_STEPS = 5


def reference(
    targets: Sequence[Any],
    scenes: Sequence[brdf.Scene],
    model: str,
    options: Mapping[str, Any],
    lamps: Lamps,
    *,
    samples: int = MOST_SAMPLES,
    pixels: int | None = None,
    start_samples: int | None = None,
) -> FitResult:
    """Fit as well as can be.

    Args:
        targets: pictures.
        scenes: one for each.
        model: "auto" or the name of a model.
        options: further arguments of `fitting.fit`.
        lamps: the lights made so far.
        samples: of each light with an extent.
        pixels: how many of each picture; None for all.
        start_samples: of the fit that the steps start from; None for those of the scene.
    """
    if not any(extended(scene) for scene in scenes):
        return run(targets, scenes, Configuration(model, "float64", pixels), options, lamps).result
    start = run(targets, scenes, Configuration(model, "float32", pixels, start_samples), options, lamps)
    fine = [lamps.with_samples(scene, samples) for scene in scenes]
    done = Run(start.result, fine, start.samples, start.seconds)
    for _ in range(MOST_STEPS):
        system = System(done, targets, dict(options), lamps, probes=sum(map(target_size, targets)))
        step = np.where(system.bound, 0.0, system.inverse @ np.where(system.bound, 0.0, system.step))
        done = done._replace(result=_moved(done.result, step, system.light.colour))
        if system.relative(step) < SETTLED:
            break
    return done.result


def under_many_samples(
    target: Any,
    scene: brdf.Scene,
    model: str,
    options: Mapping[str, Any],
    lamps: Lamps,
    pixels: int | None,
    few: int,
) -> FitResult:
    """Fit all pixels of a picture under a few light samples, and add what `MOST_SAMPLES` change at some of the pixels.

    Both fits of some of the pixels see the same noise, which is not in their difference.

    Args:
        target: the picture.
        scene: what it shows.
        model: "auto" or the name of a model.
        options: further arguments of `fitting.fit`.
        lamps: the lights made so far.
        pixels: how many; None for all.
        few: light samples of the fit of all pixels.
    """
    fine = reference([target], [scene], model, options, lamps, pixels=pixels, start_samples=few)
    if pixels is None:
        return fine
    name = fine.material.name
    coarse, whole = (
        run([target], [scene], Configuration(name, "float32", count, few), options, lamps) for count in (pixels, None)
    )
    before, after = coarse.result.optimum, fine.optimum
    step = np.append((after.x - before.x).ravel(), np.log(max(after.n, 1e-3) / max(before.n, 1e-3)))
    return _moved(whole.result, step, take_colour_out([scene], before.x.shape[1]).colour)


def _moved(result: FitResult, step: np.ndarray, colour: np.ndarray) -> FitResult:
    """A result with other parameters."""
    optimum, model = result.optimum, type(result.material)
    n = float(optimum.n * np.exp(step[-1]))
    x = np.maximum(optimum.x + step[:-1].reshape(3, -1), 0.0)
    k = x / coefficient_factors(model, n, colour)
    values: dict[str, Any] = {}
    for term, name in enumerate(("k_a", "k_d", "k_s")):
        if hasattr(result.material, name):
            # What is not determined is 0 in the material.
            values[name] = np.where(np.asarray(getattr(result.material, name)) > 0, k[term], 0.0)
    if "k_s" in values:
        values["n"] = n if values["k_s"].any() else 0.0
    optimum = eqx.tree_at(lambda o: (o.n, o.x), optimum, (n, x))
    return dataclasses.replace(result, material=model(**values), optimum=optimum)
