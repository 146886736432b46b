"""Fit a model to a measured BRDF: the table is the picture, each sample a pixel with its own directions.

f_r = [k_d + k_s S / (N.L)] / pi is linear in k_d and k_s, so the engine that fits pictures fits tables. What differs is
which deviations count: `fitting.measured_losses`.
"""

import time
from typing import Any, NamedTuple, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

import brdf
from brdf.errors import InputError
from brdf.models.base import SpecularMaterial
from fitting.measured_losses import Loss, Samples, logarithmic, losses_of
from fitting.measured_result import HALF, BrdfCandidate, BrdfFitResult, lowest_cosine
from fitting.result import Parameter
from fitting.solver.normal_equations import OneLightLobe, Picture
from fitting.solver.profile import Optimum, fit_linear, search
from fitting.uncertainty.covariance import residual_noise, uncertainty

N_RANGE = (0.1, 1e6)

# A lobe has to leave less than this share of the squares that Lambert leaves before it is worth its unknowns: half of
# them where Lambert itself explains half of the table, else nine tenths.
WORTH, WORTH_WITHOUT_LAMBERT = 0.5, 0.9
# What Lambert leaves of a table that it describes exactly; a lobe has nothing to explain then.
ROUNDING = 1e-12
# Largest value in 1/sr, and inverse of the least that a table may have as its largest: squares and sums stay in range.
FAR = 1e50
# A cosine's logarithm below this means that the lobe does not reach the sample (see `brdf.vectors`).
_DARK = -1e8


def fit_brdf(
    table: brdf.MeasuredBRDF,
    model: str = "auto",
    *,
    loss: Loss = "cosine",
    max_angle: float = 80.0,
    n_range: tuple[float, float] = N_RANGE,
) -> BrdfFitResult:
    """Fit a model to a measured BRDF: the global optimum, with no start to give.

    Args:
        table: what `brdf.load_measured` reads.
        model: the name of a model, or "auto": Lambert, unless a lobe explains half of the squares that it leaves;
            (a tenth, where Lambert explains less than half of the table); then the form with the least loss.
        loss: "cosine", "squared" or "log"; see `fitting.measured_losses`.
        max_angle: light and view further than this from the normal are left out, in degrees, above 0 to 90.
        n_range: bounds of the exponent, 0 < lower < upper.

    Returns:
        The material with its errors, its deviation under every loss, and a verdict in a sentence.

    Raises:
        InputError: naming the argument.

    Source: A. Ngan, F. Durand and W. Matusik, "Experimental analysis of BRDF models", EGSR 2005; J. Löw, J. Kronander,
    A. Ynnerman and J. Unger, "BRDF models for accurate and efficient rendering of glossy surfaces", TOG 31 (2012) 9.
    """
    start = time.perf_counter()
    if not isinstance(table, brdf.MeasuredBRDF):
        raise InputError("table", f"must be a brdf.MeasuredBRDF, got {type(table).__name__}", "Use brdf.load_measured")
    if model != "auto" and model not in brdf.MODELS:
        raise InputError("model", f"is unknown, got {model!r}", f"Use auto or one of {', '.join(brdf.MODELS)}")
    if loss not in get_args(Loss):
        raise InputError("loss", f"is unknown, got {loss!r}", f"Use one of {', '.join(get_args(Loss))}")
    low, high = n_range
    if not 0 < low < high < np.inf:
        raise InputError("n_range", f"must be 0 < lower < upper, got {n_range}", "Correct the bounds")
    samples, left_out = _samples(table, max_angle)
    if loss == "log":
        left_out["values below 0, out of reach of the logarithm"] = int(np.count_nonzero(~samples.positive))
    names = tuple(brdf.MODELS) if model == "auto" else (model,)
    names = tuple(name for name in names if samples.values.size > _unknowns(name, samples))
    if not names:
        came = f"has {len(samples.values)} samples that count, no more than there are numbers to find"
        raise InputError(table.name, came, "Give a table with more samples, or a model with fewer numbers")
    fits = [_fit_model(name, samples, loss, n_range) for name in names]
    candidates = [fit.candidate for fit in fits]
    chosen = _choose(candidates)
    best = fits[chosen]
    return BrdfFitResult(
        table=table,
        material=best.material,
        loss=loss,
        parameters=best.parameters,
        losses=best.candidate.losses,
        candidates=tuple(candidates),
        chosen=chosen,
        samples=len(samples.values),
        negative=int(np.count_nonzero(samples.values < 0)),
        left_out={reason: count for reason, count in left_out.items() if count},
        max_angle=max_angle,
        seconds=time.perf_counter() - start,
    )


def _samples(table: brdf.MeasuredBRDF, max_angle: float) -> tuple[Samples, dict[str, int]]:
    if not (isinstance(max_angle, int | float) and 0 < max_angle <= 90):
        raise InputError("max_angle", f"must be above 0 and at most 90 degrees, got {max_angle!r}", "Correct it")
    lowest = lowest_cosine(max_angle)
    near = (table.to_light[:, 2] > lowest) & (table.to_view[:, 2] > lowest) & (table.solid_angle > 0)
    left_out = dict(table.left_out)
    left_out[f"further than {max_angle:g}° from the normal"] = int(np.count_nonzero(~near))
    if not near.any():
        raise InputError(table.name, f"has no sample within {max_angle:g}° of the normal", "Raise max_angle")
    values = table.values[near]
    if not values.any():
        raise InputError(table.name, "is black", "Give a table with values")
    if not np.any(values > 0):
        raise InputError(table.name, f"has no value above 0 within {max_angle:g}° of the normal", "Check its sign")
    largest = float(np.max(np.abs(values)))
    if not 1 / FAR <= largest <= FAR:
        raise InputError(table.name, f"holds values of up to {largest:.3g}/sr, as no BRDF does", "Check its unit")
    share = table.solid_angle[near]
    samples = Samples(table.to_light[near], table.to_view[near], values, share / np.mean(share), values >= 0)
    return samples, left_out


def _unknowns(name: str, samples: Samples) -> int:
    channels = samples.values.shape[1]
    return 2 * channels + 1 if issubclass(brdf.MODELS[name], SpecularMaterial) else channels


class _Fit(NamedTuple):
    material: brdf.Material
    parameters: tuple[Any, ...]
    candidate: BrdfCandidate


def _fit_model(name: str, samples: Samples, loss: Loss, n_range: tuple[float, float]) -> _Fit:
    model = brdf.MODELS[name]
    channels = samples.values.shape[1]
    specular = issubclass(model, SpecularMaterial)
    log_cos, reach = _lobe(model, samples)
    free = np.ones((3, channels), bool)
    free[0], free[2] = False, specular

    def solve(weight: Float[np.ndarray, "P C"] | Float[np.ndarray, " P"]) -> Optimum:
        pictures = [_picture(samples, weight, log_cos, reach)]
        with jax.enable_x64(True):
            if specular:
                return search(pictures, n_min=n_range[0], n_max=n_range[1], free=free)
            return fit_linear(pictures, free=free)

    def modelled(optimum: Optimum) -> Float[np.ndarray, "P C"]:
        values = np.broadcast_to(optimum.x[1], samples.values.shape)
        if specular:
            values = values + optimum.x[2] * (reach * np.exp(np.maximum(optimum.n * log_cos, -745.0)))[:, None]
        return values / np.pi

    squared = samples.share * (samples.cosine[:, 0] ** 2 if loss != "squared" else 1.0)
    optimum = solve(squared)
    if loss == "log":
        optimum = logarithmic(samples, solve, modelled, optimum)
    values = modelled(optimum)
    losses = losses_of(samples, values)
    brightest = np.pi * np.max(np.abs(samples.values), axis=0)
    peak = float(np.max(reach * np.exp(np.maximum(optimum.n * log_cos, -745.0)))) if specular else 0.0
    # A lobe that hardly reaches a sample needs a k_s whose square is out of range; it is found to be undetermined.
    with np.errstate(over="ignore", invalid="ignore"):
        sure = uncertainty(
            optimum,
            free,
            residual_noise(optimum, brightest * np.finfo(float).eps),
            brightest,
            specular=specular,
            single=False,
            visible=float(np.max(optimum.x[2]) * peak / np.max(brightest)),
        )
    factors = np.ones((3, channels))
    if specular:
        with jax.enable_x64(True):
            factors[2] = float(model.scale(np.float64(optimum.n)))
    k = optimum.x / factors
    parameters = []
    for term, key in ((1, "k_d"), (2, "k_s"))[: 2 if specular else 1]:
        for channel in range(channels):
            reason = sure.undetermined.get(key) or sure.undetermined.get(key if channels == 1 else f"{key}[{channel}]")
            if reason:
                parameters.append(Parameter(key, channel, None, None, reason=reason))
                k[term, channel] = 0.0
                continue
            error = float(sure.x_error[term, channel] / factors[term, channel])
            value = float(k[term, channel])
            parameters.append(Parameter(key, channel, value, error, at_bound=value == 0))
    if not specular:
        material = brdf.Lambert(k_d=k[1])
    else:
        reason = sure.undetermined.get("n", "")
        parameters.append(
            Parameter("n", None, None if reason else optimum.n, None if reason else sure.n_error, reason=reason)
        )
        material = model(k_d=k[1], k_s=k[2], n=optimum.n if k[2].any() else 0.0)
    value = getattr(losses, loss)
    unknowns = int(np.count_nonzero(k > 0)) + int(bool(k[2].any()))
    return _Fit(material, tuple(parameters), BrdfCandidate(name, unknowns, value, losses, material))


def _lobe(model: type[brdf.Material], samples: Samples) -> tuple[Float[np.ndarray, " P"], Float[np.ndarray, " P"]]:
    """Logarithm of the lobe's cosine, and what multiplies the lobe: S / (N.L) without scale."""
    count = len(samples.values)
    if not issubclass(model, SpecularMaterial):
        return np.zeros(count), np.zeros(count)
    with jax.enable_x64(True):
        normal = jnp.array([0.0, 0.0, 1.0])
        log_cos = np.asarray(model.log_cosine(normal, jnp.asarray(samples.to_light), jnp.asarray(samples.to_view)))
    reach = np.ones(count) if model.cosine_weighted else 1.0 / samples.cosine[:, 0]
    return np.maximum(log_cos, -1e4), np.where(log_cos > _DARK, reach, 0.0)


def _picture(
    samples: Samples, weight: np.ndarray, log_cos: Float[np.ndarray, " P"], reach: Float[np.ndarray, " P"]
) -> Picture:
    """The table as the engine's picture, padded to one of a few sizes so that few programs are compiled."""
    count = len(samples.values)
    power = 1 << max(10, (count - 1).bit_length())
    size = power * 3 // 4 if count <= power * 3 // 4 else power

    def padded(array: np.ndarray) -> Any:
        return jnp.asarray(np.pad(array, [(0, size - count)] + [(0, 0)] * (array.ndim - 1)))

    with jax.enable_x64(True):
        return Picture(
            target=padded(np.pi * samples.values),
            diffuse=jnp.ones((size, 1)),
            lobe=OneLightLobe(padded(log_cos), padded(reach[:, None])),
            weight=padded(weight),
            ambient=jnp.zeros(1),
        )


def _choose(candidates: list[BrdfCandidate]) -> int:
    """Lambert, which comes first, unless a lobe explains enough of the squares that it leaves."""
    if candidates[0].losses.cosine <= ROUNDING:
        return 0
    best = int(np.argmin([candidate.loss for candidate in candidates]))
    lambert = candidates[0]
    worth = WORTH if 1 - lambert.losses.cosine**2 >= HALF else WORTH_WITHOUT_LAMBERT
    return best if candidates[best].loss ** 2 <= worth * lambert.loss**2 else 0
