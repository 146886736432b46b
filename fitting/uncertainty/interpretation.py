"""From the engine's numbers to a material, its errors, and what a user should know of them."""

import functools
from collections.abc import Sequence
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float

import brdf
from brdf.channels import channel_names
from brdf.models.base import SpecularMaterial
from fitting.result import Parameter
from fitting.solver.normal_equations import Picture
from fitting.solver.profile import Optimum
from fitting.uncertainty.covariance import TERMS, Uncertainty, residual_noise, uncertainty
from fitting.uncertainty.intervals import exponent_interval
from fitting.uncertainty.missing_ambient import missing_ambient
from fitting.uncertainty.noise_model import weighted_sums
from fitting.uncertainty.residual_correlation import Highlight, Structure, highlight, structure

# An interval of n wider than this factor says nothing but its order of magnitude.
WIDEST_INTERVAL = 100.0
# Two parameters whose errors go together more than this are hard to tell apart, if an error is also large.
CORRELATED, LARGE_ERROR = 0.98, 0.05


class ModelFit(NamedTuple):
    """One model fitted to the pictures.

    Attributes:
        model: its class.
        pictures: in the units of the engine, with the weights of the fit.
        optimum: in the units of the engine.
        free: which coefficients could be above 0, (3, C).
        n_range: between which exponents the optimum was searched.
        tied: x_s is a common factor times this, (C,); None where the channels are independent.
        noise_factor: see `fitting.solver.losses.Reweighted`.
        capped: k_d + k_s is held at 1 in some channel.
    """

    model: type[brdf.Material]
    pictures: Sequence[Picture]
    optimum: Optimum
    free: Bool[np.ndarray, "3 C"]
    n_range: tuple[float, float]
    tied: Float[np.ndarray, " C"] | None = None
    noise_factor: float = 1.0
    capped: bool = False


class Interpretation(NamedTuple):
    """What a fit says.

    Attributes:
        material: in the units of the user.
        parameters: each with its error and interval, or why it has none.
        sure: errors of the engine's numbers.
        structure: of the residual.
        highlight: what the pixels see of it; None without one.
        warnings: what a user should know before using the numbers.
    """

    material: brdf.Material
    parameters: tuple[Parameter, ...]
    sure: Uncertainty
    structure: Structure
    highlight: Highlight | None
    warnings: tuple[str, ...]


def interpret(
    fit: ModelFit,
    colour: Float[np.ndarray, " C"],
    rounding: Float[np.ndarray, " C"],
    brightest: Float[np.ndarray, " C"],
    shapes: Sequence[tuple[int, int]],
    required: Bool[np.ndarray, "3 C"],
) -> Interpretation:
    """Tell what a fit says.

    Args:
        fit: of one model.
        colour: what was taken out of the lights, (C,).
        rounding: standard deviation of a value's rounding, (C,).
        brightest: largest value of the pictures, (C,).
        shapes: of the pictures, height and width.
        required: coefficients that the light reaches and that were not left out as needless, (3, C).
    """
    specular = issubclass(fit.model, SpecularMaterial)
    optimum, pictures = fit.optimum, fit.pictures
    single = np.dtype(pictures[0].target.dtype) == np.float32
    factors = coefficient_factors(fit.model, optimum.n, colour)
    rounding = rounding * _typical_weight(pictures)
    noise = residual_noise(optimum, rounding)
    noise = np.maximum(noise * fit.noise_factor, rounding)
    seen = highlight(pictures, optimum.n) if specular and not optimum.flat else None
    visible = 0.0
    if seen is not None:
        visible = float(np.max(optimum.x[2]) * seen.largest / max(np.max(brightest), np.finfo(float).tiny))
    known = structure(pictures, shapes, optimum, rounding)
    spread = None
    if known.noise is not None:
        spread = fit.noise_factor**2 * weighted_sums(pictures, optimum, known.noise, inverse=False).gram
    sure = uncertainty(
        optimum,
        required,
        noise,
        brightest,
        specular=specular,
        visible=visible,
        single=single,
        tied=fit.tied,
        spread=spread,
    )
    interval: tuple[float, float] | None = None
    # At k_d + k_s = 1 the cost still falls across the bound: a profile that does not know it has its least elsewhere.
    if specular and "n" not in sure.undetermined and not fit.capped:
        interval = exponent_interval(
            pictures,
            optimum,
            fit.free,
            sure.n_error,
            sure.rise,
            fit.n_range,
            single=single,
            peak=seen.peak if seen else 0.0,
            tied=fit.tied,
        )
        reason = _open_exponent(interval)
        if reason:
            sure.undetermined["n"] = reason
    k = optimum.x / factors
    for name in sure.undetermined:
        key, _, channel = name.removesuffix("]").partition("[")
        if key != "n":
            k[TERMS.index(key), int(channel) if channel else slice(None)] = 0.0
    if specular:
        material = fit.model(k_a=k[0], k_d=k[1], k_s=k[2], n=0.0 if not k[2].any() else optimum.n)  # pyright: ignore[reportCallIssue]
    else:
        material = fit.model(k_a=k[0], k_d=k[1])  # pyright: ignore[reportCallIssue]
    parameters = _parameters(material, sure, factors, interval, optimum.n)
    warnings = _warnings(known, seen if "k_s" not in sure.undetermined else None, sure, parameters, material)
    ambient = missing_ambient(pictures)
    warnings = (ambient, *warnings) if ambient else warnings
    if fit.capped:
        labels = channel_names(k.shape[1])
        held = ", ".join(labels[channel] for channel in np.flatnonzero(k[1] + k[2] >= 1 - 1e-6))
        where = f" in channel {held}" if held else ""
        words = f"k_d + k_s is held at 1{where}: a brighter material fits better, but is not plausible; "
        warnings = (words + "the errors do not know of that bound", *warnings)
    return Interpretation(material, parameters, sure, known, seen, warnings)


def coefficient_factors(
    model: type[brdf.Material], n: float, colour: Float[np.ndarray, " C"]
) -> Float[np.ndarray, "3 C"]:
    """What the engine's coefficients are divided by to give k_a, k_d, k_s.

    Args:
        model: the class of the material.
        n: exponent.
        colour: what was taken out of the lights, (C,).
    """
    colour = np.where(colour > 0, colour, 1.0)
    factors = np.stack([np.ones_like(colour), colour, colour])
    if issubclass(model, SpecularMaterial):
        factors[2] *= _scale(model, float(n))
    return factors


@functools.lru_cache(maxsize=64)
def _scale(model: type[SpecularMaterial], n: float) -> float:
    """Of the lobe; asked for several times at one exponent."""
    with jax.enable_x64(True):
        return float(model.scale(np.float64(n)))


def _typical_weight(pictures: Sequence[Picture]) -> float:
    """Root of the mean weight of what counts: the unit of the weighted residual."""
    total, count = 0.0, 0.0
    for picture in pictures:
        if picture.weight is None:
            total, count = total + picture.target.shape[0], count + picture.target.shape[0]
        else:
            weight = np.asarray(picture.weight)
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


def _parameters(
    material: brdf.Material,
    sure: Uncertainty,
    factors: np.ndarray,
    interval: tuple[float, float] | None,
    n: float,
) -> tuple[Parameter, ...]:
    found = []
    undetermined = sure.undetermined
    specular = isinstance(material, SpecularMaterial)
    for term, name in enumerate(TERMS if specular else TERMS[:2]):
        for channel, value in enumerate(np.asarray(getattr(material, name))):
            reason = undetermined.get(name) or undetermined.get(f"{name}[{channel}]")
            if reason:
                found.append(Parameter(name, channel, None, None, reason=reason))
                continue
            factor = factors[term, channel]
            low, high = sure.x_interval[term, channel] / factor
            error = float(sure.x_error[term, channel] / factor)
            between = (float(low), float(high))
            found.append(Parameter(name, channel, float(value), error, between, at_bound=bool(value == 0)))
    if specular:
        reason = undetermined.get("n", "")
        if reason:
            found.append(Parameter("n", None, None, None, interval, reason=reason))
        else:
            found.append(Parameter("n", None, float(n), sure.n_error, interval))
    return tuple(found)


def _warnings(
    known: Structure,
    seen: Highlight | None,
    sure: Uncertainty,
    parameters: Sequence[Parameter],
    material: brdf.Material,
) -> tuple[str, ...]:
    found = []
    if known.significant:
        found.append(
            f"the residual has structure: neighbouring pixels err alike (correlation {known.correlation:.2f}), so the "
            "model is not the whole truth, or the picture was smoothed. The errors come from a formula for independent "
            f"noise and are too small, by a factor of {known.inflation:.2g} or more"
        )
    if known.noise is not None:
        found.append(
            "the noise grows with brightness; the errors allow for it, but pixels are weighed alike: told of the "
            "camera's noise, or with the relative loss, the same picture says more"
        )
    if seen is not None and seen.smaller_than_pixel:
        amount = (
            f"{seen.pixels:.1f} pixels carry it"
            if seen.centre >= OFF_CENTRE_TOLD
            else f"the nearest pixel shows {100 * seen.centre:.2g} % of its peak"
        )
        found.append(
            f"the highlight is smaller than a pixel, or nearly so ({amount}): k_s and n hang on each pixel being "
            "sampled at its centre, and a camera averages over pixels. A larger picture or a larger light would tell"
        )
    found += _hard_to_tell(sure, parameters, material)
    return tuple(found)


# Below this share of the peak the distance from the centre says more than the number of pixels.
OFF_CENTRE_TOLD = 0.5


def _hard_to_tell(sure: Uncertainty, parameters: Sequence[Parameter], material: brdf.Material) -> list[str]:
    """Pairs whose errors go together so much that they are known worse apart than together."""
    channels = material.k_d.shape[0]
    place = {name: term * channels for term, name in enumerate(TERMS)} | {"n": 3 * channels}
    pairs: dict[tuple[str, str], tuple[float, int]] = {}
    for i, one in enumerate(parameters):
        for other in parameters[i + 1 :]:
            same = one.channel == other.channel or other.channel is None
            if not (one.value and other.value and same):
                continue
            correlation = sure.correlation[
                place[one.name] + (one.channel or 0), place[other.name] + (other.channel or 0)
            ]
            large = max((p.error or 0.0) / p.value for p in (one, other) if p.value)
            if abs(correlation) > CORRELATED and large > LARGE_ERROR:
                key = (one.name, other.name)
                if abs(correlation) >= abs(pairs.get(key, (0.0, 0))[0]):
                    pairs[key] = (float(correlation), one.channel or 0)
    return [
        f"{one} and {other} are hard to tell apart (correlation {correlation:.3f}): "
        f"their {'sum' if correlation < 0 else 'difference'} is known better than either"
        for (one, other), (correlation, _) in pairs.items()
    ]
