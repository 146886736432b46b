"""The front door: from pictures and scenes to a material, its errors, and what they cannot tell."""

import dataclasses
import time
from collections.abc import Sequence
from typing import Any

import numpy as np

import brdf
from brdf.errors import InputError
from brdf.precision import Precision, working_precision
from fitting.auto_fit import fit_simplest
from fitting.censored_noise import warned_of_cut_noise, without_cut_noise
from fitting.core import Job, fit_model, reached, without_highlight
from fitting.light_colour import take_colour_out
from fitting.pixels import Observation, observe
from fitting.plausible import fit_plausible, is_plausible
from fitting.problem import (
    check_levels,
    check_range,
    check_sizes,
    check_weight,
    looked_at,
    per_pixel,
    pictures_and_scenes,
    pixels_of,
    relative_weights,
)
from fitting.report import FitResult
from fitting.result import free_parameters
from fitting.selection import Choice
from fitting.solver.losses import LOSSES, Loss
from fitting.uncertainty.covariance import TERMS
from fitting.uncertainty.interpretation import Interpretation, ModelFit, interpret

N_RANGE = (0.1, 1e6)
AUTO = ("phong", "blinn-phong")
PLAUSIBLE = ("normalized-phong", "normalized-blinn-phong")
# A residual above this share of the picture: what the scene says is probably not what the picture shows.
UNEXPLAINED = 0.5


def fit(
    target: Any,
    scene: brdf.Scene | Sequence[brdf.Scene],
    *,
    model: str = "auto",
    precision: Precision = "float32",
    mask: Any = None,
    saturation: float | None = None,
    n_range: tuple[float, float] = N_RANGE,
    loss: Loss = "squared",
    dark: float | None = None,
    noise: tuple[float, float] | None = None,
    weight: Any = None,
    plausible: bool = False,
    accuracy: float | None = None,
    seconds: float | None = None,
) -> FitResult:
    """Fit a material to a picture, or to several pictures of one material: the global optimum, with no start to give.

    Args:
        target: linear values, (H, W, C) or (H, W), or a `brdf.Picture`; a `brdf.ImageReader` for a file that is larger
            than memory, which is read by bands of rows, several times (of censored noise it only warns); or a list.
        scene: what the picture shows; a list of as many where there are several pictures.
        model: "auto" for the simplest adequate of Lambert, Phong and Blinn-Phong, or the name of a model.
        precision: "float32" or "float64".
        mask: (H, W), pixels to look at; a list where there are several pictures.
        saturation: linear value from which on pixels are clipped and do not count. None takes the largest code of an
            integer file, or the largest value where many pixels share it exactly.
        n_range: bounds of the exponent, 0 < lower < upper.
        loss: "squared"; "relative" or "log" for high dynamic range; "huber" or "cauchy" where some pixels show what the
            scene does not know. See `fitting.solver.losses` for what to use when.
        dark: linear value up to which pixels are too dark to count. By the value itself: where noise is large that
            leaves out what noise made darker, and ``noise`` is the better way.
        noise: of the camera, (read, shot): the variance of a value is read² + shot · value, and pixels weigh by its
            inverse. None weighs all alike.
        weight: (H, W), how much each pixel counts beside that, at least 0; a list where there are several pictures.
        plausible: hold k_d + k_s <= 1 inside the fit, with a normalised form or Lambert, so that `brdf.check` passes;
            see `fitting.plausible`.
        accuracy: relative error that is good enough: the cheapest number of pixels and light samples and the cheapest
            precision that keep it are chosen, see `fitting.budget.budget`; the result's ``choice`` says which and
            why. None looks at all pixels under the lights as they are.
        seconds: the same for the time to spend; what it buys is the most accurate fit.

    Returns:
        The result.

    Raises:
        InputError: naming the argument, where it cannot be used.

    Source: Golub and Pereyra 1973, variable projection; see `fitting.solver.profile`.
    """
    start = time.perf_counter()
    targets, scenes, masks, weights = pictures_and_scenes(target, scene, mask, weight)
    if model != "auto" and model not in brdf.MODELS:
        raise InputError("model", f"is unknown, got {model!r}", f"Use auto or one of {', '.join(brdf.MODELS)}")
    if plausible and model in AUTO:
        remedy = f"Use auto, normalized-{model}, or a normalised form of your choice"
        raise InputError("model", f"{model} is neither reciprocal nor energy conserving, so never plausible", remedy)
    if loss not in LOSSES:
        raise InputError("loss", f"is unknown, got {loss!r}", f"Use one of {', '.join(LOSSES)}")
    check_range(n_range)
    if accuracy is not None or seconds is not None:
        from fitting.budget.budget import fit_within

        if any(isinstance(one, brdf.ImageReader) for one in targets):
            words = "is read by bands of rows; accuracy and seconds choose among pixels in memory"
            raise InputError("target", words, "Read it with brdf.read_image, or leave accuracy and seconds out")
        check_levels(saturation, dark, noise)
        for picture, place, one, other in zip(targets, scenes, masks, weights, strict=True):
            pixels, _, _ = pixels_of(picture)
            check_sizes(pixels, place)
            if one is not None:
                per_pixel("mask", one, pixels.shape[:2])
            if other is not None:
                check_weight(other, pixels.shape[:2])
        how = {"mask": masks, "saturation": saturation, "n_range": n_range, "dark": dark, "weight": weights}
        beside = {"loss": loss != "squared", "noise": noise is not None, "plausible": plausible}
        return fit_within(targets, scenes, model, precision, how, beside, accuracy=accuracy, seconds=seconds)
    cuts = {"saturation": saturation, "dark": dark, "noise": noise}
    weights = relative_weights(weights)

    def fit_to(masks: list[Any]) -> FitResult:
        with working_precision(precision):
            observations = [
                observe(picture, place, dtype=np.dtype(precision), mask=one, weight=other, **cuts)
                for picture, place, one, other in zip(targets, scenes, masks, weights, strict=True)
            ]
            return _fit_observed(observations, scenes, model, precision, n_range, loss, plausible, start)

    result = fit_to(masks)
    if any(isinstance(one, brdf.ImageReader) for one in targets):
        return warned_of_cut_noise(result)
    return without_cut_noise(result, list(map(looked_at, masks, weights)), fit_to)


def _fit_observed(
    observations: list[Observation],
    scenes: list[brdf.Scene],
    model: str,
    precision: Precision,
    n_range: tuple[float, float],
    loss: Loss,
    plausible: bool,
    start: float,
) -> FitResult:
    counts = {observation.shown.shape[-1] for observation in observations}
    if len(counts) > 1:
        raise InputError("target", f"pictures have {counts} channels", "Give pictures with the same number")
    light = take_colour_out(scenes, counts.pop())
    job = Job(observations, light, n_range, loss, PLAUSIBLE if plausible else AUTO)
    if model == "auto":
        fitted, choice = fit_simplest(job)
    else:
        fitted, choice = fit_model(brdf.MODELS[model], job), None
    if plausible:
        fitted = _held_plausible(fitted, job)
    told, optimum = _interpret(fitted, job, choice), fitted.optimum
    if _is_dropped(fitted, told):
        # Or ambient and diffuse would be the ones that go with the highlight.
        fitted, why = without_highlight(fitted, job), told.sure.undetermined["n"]
        if plausible:
            fitted = _held_plausible(fitted, job)
        told = _with_reason(_interpret(fitted, job, choice), why)
    result = _result(fitted, told, choice, job, precision, time.perf_counter() - start)
    return dataclasses.replace(result, optimum=optimum)


def _held_plausible(fit: ModelFit, job: Job) -> ModelFit:
    colour = job.light.colour
    if is_plausible(fit.optimum, fit.model, colour):
        return fit
    optimum = fit_plausible(fit.pictures, fit.optimum, fit.free, fit.model, colour, fit.n_range)
    # What the bound adds to the residual is no noise: that of the fit without it says what stands out.
    noise = fit.noise_factor * float(np.sqrt(np.sum(fit.optimum.cost) / np.sum(optimum.cost)))
    return fit._replace(optimum=optimum, tied=None, capped=True, noise_factor=noise)


def _interpret(fit: ModelFit, job: Job, choice: Choice | None) -> Interpretation:
    brightest = np.max([observation.brightest for observation in job.observations], axis=0)
    # What the light reaches but the simplest model does without is 0, with the error that it would have.
    share = float(np.sqrt(np.sum(fit.optimum.cost) / np.sum(fit.optimum.square)))
    told = interpret(fit, job.light.colour, job.rounding, brightest, job.shapes, reached(fit.model, job))
    if share > UNEXPLAINED:
        words = f"the model leaves {100 * share:.0f} % of the picture: are light, camera and encoding what they were?"
        told = told._replace(warnings=(words, *told.warnings))
    if choice is None or not choice.rivals:
        return told
    names = " and ".join(choice.rivals)
    rival = f"{names} fits as well as {fit.model.name}: the picture does not tell the two highlights apart"
    return told._replace(warnings=(*told.warnings, rival))


def _is_dropped(fit: ModelFit, told: Interpretation) -> bool:
    """Whether there is a highlight in the numbers that is left out of the material, as it does not stand out."""
    lost = told.sure.undetermined
    return not fit.capped and bool(fit.optimum.x[2].any()) and "n" in lost and lost.get("k_s") == lost["n"]


def _with_reason(told: Interpretation, why: str) -> Interpretation:
    """Why there is no highlight, which a fit without one does not know."""
    parameters = tuple(
        dataclasses.replace(one, reason=why) if one.name in ("k_s", "n") and one.value is None else one
        for one in told.parameters
    )
    return told._replace(parameters=parameters)


def _result(
    fit: ModelFit,
    told: Interpretation,
    choice: Choice | None,
    job: Job,
    precision: Precision,
    seconds: float,
) -> FitResult:
    optimum, observations = fit.optimum, job.observations
    left_out: dict[str, int] = {}
    for observation in observations:
        for reason, count in observation.left_out.items():
            left_out[reason] = left_out.get(reason, 0) + count
    channels = optimum.x.shape[1]
    free = free_parameters(told.parameters)
    index = [3 * channels if p.channel is None else TERMS.index(p.name) * channels + p.channel for p in free]
    return FitResult(
        material=told.material,
        parameters=told.parameters,
        noise=told.sure.noise,
        structure=told.structure.correlation,
        highlight_pixels=None if told.highlight is None else told.highlight.pixels,
        residual=float(np.sqrt(np.sum(optimum.cost) / np.sum(optimum.square))),
        pixels=int(optimum.pixels[0]),
        left_out=left_out,
        warnings=told.warnings,
        candidates=() if choice is None else choice.candidates,
        correlation=told.sure.correlation[np.ix_(index, index)],
        optimum=optimum,
        loss=job.loss,
        precision=precision,
        seconds=seconds,
        targets=[observation.shown for observation in observations],
        scenes=[observation.scene for observation in observations],
        counted=[observation.counted for observation in observations],
    )
