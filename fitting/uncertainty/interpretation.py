"""From the solver's numbers to a material, its errors, and what a user should know of them."""

import math
from collections.abc import Iterator, Sequence
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

import brdf
from brdf.channels import channel_names
from brdf.models.base import SpecularMaterial
from fitting.channel_errors import residuals
from fitting.light_colour import coefficient_factors
from fitting.maximum_likelihood import bounds_of
from fitting.model_fit import N_RANGE, Evidence, ModelFit
from fitting.pixels import Observed
from fitting.problem import FitProblem
from fitting.result import HELD_PLAUSIBLE, FitResult, Parameter
from fitting.solver.losses import RELATIVE
from fitting.solver.normal_equations import Picture
from fitting.solver.profile import Optimum
from fitting.solver.tied import NormalEquations, design_of
from fitting.uncertainty.covariance import (
    AMBIENT_SHARE,
    RESOLUTION,
    TERMS,
    PixelErrors,
    Sum,
    Uncertainty,
    inverse_among,
    residual_noise,
    rms_columns,
    specular_gain,
    uncertainty,
)
from fitting.uncertainty.highlight import OFF_CENTRE, Highlight
from fitting.uncertainty.intervals import exponent_interval
from fitting.uncertainty.noise_model import misweighted_sums, weighted_sums
from fitting.uncertainty.residual import Neighbours, Residual, residual_statistics, structure_words
from fitting.uncertainty.structure import (
    CODED_SIZES,
    SIZES,
    Blocks,
    Errors,
    Structure,
    of_coded_blocks,
    over_blocks,
    scatter,
    structure,
)

# With less noise than this, in codes, few values say something.
ROUNDED = 0.5
# So little of the brightest value is the arithmetic of the program that drew it, whose errors go together.
ARITHMETIC = 2.0**-15
GROWING = (
    "the noise grows with brightness; the errors allow for it, but {}: told of the camera's noise, or with the "
    "relative loss, the same picture says more"
)
NEAR = "predicted where noise decides whether they are clipped or dark"
# A coefficient of which values that are not clipped tell less than this share of what they tell of another channel's.
CLIPPED_SHARE, CLIPPED = 1e-3, "the values that would tell it are clipped"
# An interval of n wider than this factor says nothing but its order of magnitude.
WIDEST_INTERVAL = 100.0


def interpret(fit: ModelFit, observed: Observed, hidden: str = "", statistics: Residual | None = None) -> FitResult:
    """Tell what a fit says.

    ``hidden`` is why there is no highlight, where a fit with one has found that, ``statistics`` those of what least
    squares leaves, in the unit of the picture, where that has been gone over.
    """
    optimum, pictures, evidence = fit.optimum, fit.pictures, fit.evidence
    about = observed.result_fields() | {"optimum": optimum, "pixels": int(np.min(optimum.pixels))}
    about["residual"] = fit.residual
    if observed.limited:
        every = sum(math.prod(target.pixels.shape[:2]) for target in observed.problem.targets)
        near = every - sum(observed.left_out.values()) - about["pixels"]
        about["left_out"] = observed.left_out | {NEAR: near}
    weight = _typical_weight(pictures)
    rounding, columns = observed.rounding * weight, rms_columns(optimum, weight)
    noise = np.maximum(residual_noise(optimum, rounding) * fit.noise_factor, rounding)
    if statistics is None or weight != 1.0:
        statistics = residual_statistics(pictures, observed.widths, optimum, noise, rounding)
    lobe = None if optimum.flat else statistics.highlight
    visible = 0.0 if lobe is None else lobe.share(optimum.x, observed.brightest)
    # Also of what rounded values say, whose sums are in double precision.
    resolution = RESOLUTION if fit.single else 0.0
    channels = np.ones((noise.size,) * 2) if observed.copies else statistics.channels(noise > 2 * rounding)
    sampled = observed.problem.sample_error(fit.model.name)
    clipped, gain, growing = _clipped(optimum, fit.tied), 0.0, None
    if evidence is None:
        pixels = PixelErrors(noise, channels=channels, missed=sampled)
        pixels, together, growing = _of_values(fit, observed, statistics, pixels, rounding)
    else:
        # What least squares leaves is rounding, which goes together.
        statistics = statistics._replace(neighbours=statistics.neighbours._replace(significant=False))
        # Of a small highlight the pixels near an edge may tell next to nothing.
        gain = specular_gain(optimum.normal(noise**2).gram, optimum.x)
        rounded = fit.pictures
        fit = fit._replace(pictures=evidence.pictures, optimum=evidence.optimum)
        pixels = PixelErrors(np.ones(noise.size), channels=channels, missed=sampled)
        pixels, together = _of_codes(fit, evidence, observed, pixels, rounded)
    # What the light reaches but the simplest model does without is 0, with the error that it would have.
    about_light = observed.reached(fit.model), observed.brightest, visible
    errors = uncertainty(fit, pixels, *about_light, columns=columns, gain=gain, resolution=resolution)
    errors.reasons[clipped & (errors.reasons == "")] = CLIPPED
    interval = None
    # At k_d + k_s = 1 the cost still falls across the bound: a profile that does not know it has its least elsewhere.
    if lobe is not None and not errors.n_reason and not fit.capped:
        interval, likely = exponent_interval(
            fit,
            errors.n_error,
            errors.reach,
            errors.delta_cost,
            lobe.peak,
            parabolic=evidence is not None and evidence.together is not None,
        )
        # Whoever bounds n knows that it is not beyond.
        least, most = observed.problem.n_range
        low = max(interval[0], least if least != N_RANGE[0] else 0.0)
        interval = low, min(interval[1], most if most != N_RANGE[1] else np.inf)
        reason = fit.held(observed.problem.n_range) or _open_exponent(interval)
        errors = errors.holding(likely)._replace(n_reason=reason)
    if hidden:
        errors.reasons[2], errors = hidden, errors._replace(n_reason=hidden)
    material, parameters = material_and_parameters(fit, errors, observed.colour, interval)
    index = [one.place(material.k_d.size) for one in parameters if one.value is not None and not one.at_bound]
    correlation = errors.correlation[np.ix_(index, index)]
    warnings = [_capped(material)] if fit.capped else []
    warnings += _warnings(statistics.neighbours, together, None if all(errors.reasons[2]) else lobe)
    # What the camera says of a pixel's brightness may be off in a channel of strong colour; by shares pixels weigh as
    # they were chosen to.
    told = observed.problem.noise is not None or observed.problem.loss in RELATIVE
    if growing is not None and not told and not any("structure" in text for text in warnings):
        warnings.append(
            GROWING.format("the weights do not" if _is_weighed(observed.problem) else "pixels are weighed alike")
        )
    if errors.sums:
        words = "no more than a sum of several numbers is determined, see there: the material shows it with "
        words += f"{100 * AMBIENT_SHARE:g} % of it as ambient light, if there is any, and the rest as k_d. "
        warnings.append(words + "Another light, or a curved surface, would tell them apart")
    return FitResult(
        material=material,
        parameters=parameters,
        noise=noise,
        structure=statistics.neighbours.correlation,
        highlight_pixels=None if lobe is None else lobe.pixels,
        warnings=tuple(warnings),
        correlation=correlation,
        **about,
    )


def _of_values(
    fit: ModelFit, observed: Observed, statistics: Residual, pixels: PixelErrors, rounding: Float[np.ndarray, " C"]
) -> tuple[PixelErrors, Structure | None, Float[np.ndarray, "C 3"] | None]:
    """How pixels err that least squares fit: beside their noise what errs together, and how their noise grows."""
    optimum, pictures, problem = fit.optimum, fit.pictures, observed.problem
    tell, squared, together = pixels.noise > 2 * rounding, problem.loss == "squared", None
    # Those of a robust loss know the residuals.
    weighed = problem.loss in RELATIVE or (squared and _is_weighed(problem))
    misweighted = misweighted_sums(pictures, optimum, rounding) if weighed else None
    uneven, growing = misweighted or (None, statistics.growing_noise(pixels.noise, rounding))
    # It cannot be told where rounding is most of the noise, or weights are part of what is fitted.
    if squared and tell.any():
        # Channels that err together count once.
        some = np.flatnonzero(tell)[: 1 if pixels.channels is not None else None]
        size = 0.0 if pixels.missed is None else pixels.missed.size
        missed = size * _typical_weight(pictures) / float(np.sqrt(np.mean(pixels.noise[some] ** 2)))
        grids = [grid.channels(some) for grid in statistics.blocks]
        together = structure(grids, even=growing is None and uneven is None, missed=missed)
    # What a bound of the material leaves is no error of the pixels.
    if together is not None and together.significant and not fit.capped:
        errors = (
            Errors(residuals(picture, optimum), np.arange(len(picture.target)), width)
            for picture, width in zip(pictures, observed.widths, strict=True)
        )
        alone = alone_covariance(optimum.normal(), optimum.x, fit.tied)
        pixels = pixels._replace(scatter=scatter(pictures, optimum, errors, alone))
        return pixels, together, growing
    if growing is not None and uneven is None:
        uneven = weighted_sums(pictures, optimum, growing, inverse=False)
    if uneven is not None:
        pixels = pixels._replace(spread=fit.noise_factor**2 * uneven.gram)
    return pixels, together, growing


def _of_codes(
    fit: ModelFit, evidence: Evidence, observed: Observed, pixels: PixelErrors, rounded: Sequence[Picture]
) -> tuple[PixelErrors, Structure | None]:
    """How pixels err whose codes are fitted: beside the noise of their working targets, 1, what errs together."""
    if any(one is not None for one in observed.problem.weights) and evidence.together is None:
        # Of weights the bounds know as of inverse variances.
        known = [1 / np.atleast_2d(bounds_of(one).spread) ** 2 for one in rounded]
        given = [one[pixel] if len(one) > 1 else one for one, (pixel, _) in zip(known, evidence.places, strict=True)]
        if (misweighted := misweighted_sums(fit.pictures, fit.optimum, 0 * pixels.noise, given)) is not None:
            pixels = pixels._replace(spread=misweighted[0].gram)
    alone = None
    if evidence.together is None:
        alone = alone_covariance(fit.optimum.normal(), fit.optimum.x, fit.tied)
    missed = 0.0 if pixels.missed is None else pixels.missed.size
    shared, together, channels = shared_errors(evidence, observed, alone, missed)
    if not (evidence.scores or observed.copies):
        pixels = pixels._replace(channels=channels)
    arithmetic = evidence.light < ARITHMETIC * np.max(observed.brightest)
    return pixels._replace(scatter=shared), None if arithmetic else together


def _is_weighed(problem: FitProblem) -> bool:
    """Whether noise or weights were given."""
    return problem.noise is not None or any(one is not None for one in problem.weights)


def _clipped(optimum: Optimum, tied: np.ndarray | None) -> Bool[np.ndarray, "3 C"]:
    """Coefficients of channels that are clipped wherever another channel tells them: an open end gives no error.

    By least squares, which leave out what is clipped; what channels share by ``tied`` one of them tells.
    """
    squares = np.diagonal(optimum.gram, axis1=1, axis2=2)[:, :3].T
    lost = optimum.pixels < np.max(optimum.pixels)
    found = lost & (squares < CLIPPED_SHARE * np.max(squares, axis=1, keepdims=True))
    found[2] &= tied is None
    return found


def shared_errors(
    evidence: Evidence, observed: Observed, covariance: Float[np.ndarray, "U U"] | None = None, missed: float = 0.0
) -> tuple[Float[np.ndarray, "U U"] | None, Structure, Float[np.ndarray, "C C"] | None]:
    """What takes the place of the Hessian where neighbours share errors, None where they do not; and how much they do.

    Last how the channels' errors go together, where that is known of all values, and neighbours' are not looked at.
    They do in a file that was compressed with losses, or where the residual shows it. The covariance is that of
    `fitting.uncertainty.structure.scatter`, ``missed`` the root mean square of what light samples leave out.
    """
    lossy = any(tile.bounds is not None and tile.bounds.lossy for tile in observed.tiles)
    channels, few = None, evidence.noise < ROUNDED
    left = map(partial(residuals, optimum=evidence.optimum), evidence.pictures)
    errors = map(lambda values, place: Errors(values, *place), left, evidence.places)
    if lossy:
        # The pixels of a block err together in any case.
        errors, some = list(errors), slice(1 if observed.copies else None)
        together = structure([of_coded_blocks(one._replace(values=one.values[:, some])) for one in errors], CODED_SIZES)
    else:
        # With little noise few values say much.
        if evidence.scores:
            errors = list(errors)
            grids = (
                [_scores(*one) for one in evidence.scores] if few else [over_blocks(one, SIZES[0]) for one in errors]
            )
        else:
            unit = np.ones(observed.colour.size)
            statistics = residual_statistics(evidence.completed, observed.widths, evidence.optimum, unit, 0 * unit)
            grids, channels = statistics.blocks, None if observed.copies else statistics.channels(unit > 0)
        # Channels that err together count once.
        some = slice(1 if observed.copies or channels is not None else None)
        missed = missed if evidence.scores and few else missed / evidence.light
        together = structure([grid.channels(some) for grid in grids], even=not few, missed=missed)
    if not (lossy or together.significant):
        return None, together, channels
    return scatter(evidence.pictures, evidence.optimum, errors, covariance), together, channels


def _scores(score: np.ndarray, information: np.ndarray, place: tuple[np.ndarray, int]) -> Blocks:
    """Sums of scores, whose variance is no less than their information.

    Each of many values may say that it is not beyond an edge, which one in a thousand would be.
    """
    sums = over_blocks(Errors(score, *place), SIZES[0])
    of_information = over_blocks(Errors(np.sqrt(information), *place), SIZES[0])
    return sums._replace(squares=np.maximum(sums.squares, of_information.squares))


def alone_covariance(
    normal: NormalEquations, x: Float[np.ndarray, "3 C"], tied: np.ndarray | None
) -> Float[np.ndarray, "U U"]:
    """Covariance of independent pixels whose weights are inverse variances, at an optimum."""
    return inverse_among(normal.gram, design_of(x > 0, tied))


def _typical_weight(pictures: Sequence[Picture]) -> float:
    """Root of the mean weight of what counts: the unit of the weighted residual."""
    total, count = 0.0, 0
    for picture in pictures:
        weight = np.ones(picture.target.shape[0]) if picture.weight is None else np.asarray(picture.weight)
        total, count = total + float(np.sum(weight, dtype=float)), count + np.count_nonzero(weight)
    return float(np.sqrt(total / max(count, 1)))


def _open_exponent(interval: tuple[float, float]) -> str:
    low, high = interval
    if low == 0 and np.isinf(high):
        return "the highlight fits as well with any exponent"
    if np.isinf(high):
        return f"the pixels do not resolve the highlight; n is {low:.3g} or more (95 %)"
    if low == 0:
        return f"the highlight is as wide as the picture shows; n is {high:.3g} or less (95 %)"
    if high > WIDEST_INTERVAL * low:
        return f"anything from {low:.3g} to {high:.3g} fits (95 %)"
    return ""


def material_and_parameters(
    fit: ModelFit, errors: Uncertainty, colour: Float[np.ndarray, " C"], interval: tuple[float, float] | None
) -> tuple[brdf.Material, tuple[Parameter, ...]]:
    """The material that was found, and its numbers with their errors; ``interval`` is that of the exponent.

    What is not determined is 0 in the material, unless it is part of a sum that is: that the material shows. Errors are
    in the units of the solver; the colour was taken out of the lights.
    """
    found: list[Parameter] = []
    k: dict[str, Any] = {}
    optimum, specular = fit.optimum, issubclass(fit.model, SpecularMaterial)
    factors = coefficient_factors(fit.model, optimum.n, colour)
    for term, name in enumerate(TERMS[: 2 + specular]):
        for channel, factor in enumerate(factors[term]):
            if errors.reasons[term, channel]:
                if channel in errors.sums and term in errors.sums[channel].terms:
                    errors.reasons[term, channel] = _in_words(errors.sums[channel], factors[:, channel])
                found.append(Parameter(name, channel, None, None, reason=errors.reasons[term, channel]))
                continue
            value = float(optimum.x[term, channel] / factor)
            low, high = errors.x_interval[term, channel] / factor
            error = float(errors.x_error[term, channel] / factor)
            found.append(Parameter(name, channel, value, error, (float(low), float(high)), at_bound=value == 0))
        k[name] = np.array([parameter.value or 0.0 for parameter in found[-factors.shape[1] :]])
        for channel, total in errors.sums.items():
            k[name][channel] += total.stand_in[term] / factors[term, channel]
    if specular:
        k["n"] = optimum.n if k["k_s"].any() else 0.0
        n, error = (None, None) if errors.n_reason else (float(optimum.n), errors.n_error)
        found.append(Parameter("n", None, n, error, interval, reason=errors.n_reason))
    return fit.model(**k), tuple(found)


def _in_words(total: Sum, factors: Float[np.ndarray, " 3"]) -> str:
    parts = zip(total.terms, total.columns, strict=True)
    terms = " + ".join(f"{column * factors[term]:.4g} {TERMS[term]}" for term, column in parts)
    value = Parameter("", None, total.value, total.error)
    return f"only {terms} = {str(value).partition(' (')[0]} is determined"


def _capped(material: brdf.Material) -> str:
    diffuse, specular = material.k_d, getattr(material, "k_s", 0.0)
    labels = channel_names(diffuse.shape[0])
    held = ", ".join(labels[channel] for channel in np.flatnonzero(diffuse + specular >= 1 - 1e-6))
    where = f" in channel {held}" if held else ""
    return (
        f"{HELD_PLAUSIBLE}{where}: a brighter material fits better, but is not plausible; "
        "the errors do not know of that bound"
    )


def _warnings(neighbours: Neighbours, together: Structure | None, lobe: Highlight | None) -> Iterator[str]:
    shared = together is not None and together.significant
    if (neighbours.significant or shared) and not (together is not None and together.known):
        words = f"{structure_words(neighbours.correlation)}, or the picture was smoothed. "
        if shared:
            words += "The errors allow for that among neighbours, not for what it does to the numbers: "
            words += "they may be too small"
        else:
            words += f"The errors are too small, by a factor of {neighbours.inflation:.2g} or more"
        yield words
    if lobe is not None and lobe.smaller_than_pixel:
        # Below this share of the peak the distance from the centre says more than the number of pixels.
        amount = f"the nearest pixel shows {100 * lobe.centre:.2g} % of its peak"
        if lobe.centre >= OFF_CENTRE:
            amount = f"{lobe.pixels:.1f} pixels carry it"
        if lobe.broad:
            yield (
                f"no pixel that counts shows the middle of the highlight ({amount}): k_s and n are told by its edge "
                "alone. A picture that shows it, and does not clip it, would tell more"
            )
            return
        yield (
            f"the highlight is smaller than a pixel, or nearly so ({amount}): k_s and n hang on each pixel being "
            "sampled at its centre, and a camera averages over pixels. A larger picture or a larger light would tell"
        )
