"""The front door: from pictures and scenes to a material, its errors, and what they cannot tell."""

import time
from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import brdf
from brdf.errors import InputError
from fitting.observation import LightColour, Observation, fitted_pixels, observe, take_colour_out
from fitting.result import Candidate, FitResult, Parameter
from fitting.separable import Optimum, Picture, fit_linear, search
from fitting.uncertainty import Uncertainty, uncertainty

N_RANGE = (0.1, 1e6)
AUTO = ("lambert", "phong", "blinn-phong")


def fit(
    target: Any,
    scene: brdf.Scene | Sequence[brdf.Scene],
    *,
    model: str = "auto",
    precision: brdf.Precision = "float32",
    mask: Any = None,
    saturation: float | None = None,
    n_range: tuple[float, float] = N_RANGE,
) -> FitResult:
    """Fit a material to a picture, or to several pictures of one material: the global optimum, with no start to give.

    Args:
        target: linear values, (H, W, C) or (H, W), or a `brdf.Picture`; or a list of them.
        scene: what the picture shows; a list of as many where there are several pictures.
        model: "auto" for the simplest adequate of Lambert, Phong and Blinn-Phong, or the name of a model.
        precision: "float32" or "float64".
        mask: (H, W), pixels to look at; a list where there are several pictures.
        saturation: linear value from which on pixels are clipped and do not count. None takes the largest code of an
            integer file, or the largest value where many pixels share it exactly.
        n_range: bounds of the exponent, 0 < lower < upper.

    Returns:
        The result.

    Raises:
        InputError: naming the argument, where it cannot be used.

    Source: Golub and Pereyra 1973, variable projection; see `fitting.separable`.
    """
    start = time.perf_counter()
    targets, scenes, masks = _pictures(target, scene, mask)
    if model != "auto" and model not in brdf.MODELS:
        raise InputError("model", f"is unknown, got {model!r}", f"Use auto or one of {', '.join(brdf.MODELS)}")
    low, high = n_range
    if not 0 < low < high < np.inf:
        raise InputError("n_range", f"must be 0 < lower < upper, got {n_range}", "Correct the bounds")
    with brdf.working_precision(precision):
        dtype = np.dtype(precision)
        observations = [
            observe(picture, place, dtype=dtype, mask=one, saturation=saturation)
            for picture, place, one in zip(targets, scenes, masks, strict=True)
        ]
        counts = {observation.target.shape[1] for observation in observations}
        if len(counts) > 1:
            raise InputError("target", f"pictures have {counts} channels", "Give pictures with the same number")
        light = take_colour_out(scenes, counts.pop())
        names = AUTO if model == "auto" else (model,)
        if not any(scene.lights for scene in scenes):
            names = ("lambert",) if model == "auto" else names
        fits = [_fit_model(brdf.MODELS[name], observations, light, n_range) for name in names]
    chosen, candidates = _choose(fits)
    return _result(fits[chosen], candidates, observations, targets, scenes, precision, time.perf_counter() - start)


def _pictures(target: Any, scene: Any, mask: Any) -> tuple[list[Any], list[brdf.Scene], list[Any]]:
    several = isinstance(target, list | tuple)
    targets = list(target) if several else [target]
    scenes = list(scene) if isinstance(scene, list | tuple) else [scene] * len(targets)
    masks = list(mask) if several and isinstance(mask, list | tuple) else [mask] * len(targets)
    if not targets:
        raise InputError("target", "is an empty list", "Give at least one picture")
    for name, values in (("scene", scenes), ("mask", masks)):
        if len(values) != len(targets):
            raise InputError(name, f"has {len(values)} entries for {len(targets)} pictures", "Give one for each")
    if not all(isinstance(one, brdf.Scene) for one in scenes):
        raise InputError("scene", f"must be a brdf.Scene, got {type(scene).__name__}", "Use brdf.Scene.load")
    return targets, scenes, masks


class ModelFit(NamedTuple):
    """One model fitted to the pictures.

    Attributes:
        material: in the units of the user.
        optimum: in the units of the engine.
        sure: errors of the engine's numbers.
        factors: what a coefficient of the engine is divided by, (3, C).
        unknowns: how many numbers were free.
    """

    material: brdf.Material
    optimum: Optimum
    sure: Uncertainty
    factors: Float[np.ndarray, "3 C"]
    unknowns: int


def _fit_model(
    model: type[brdf.Material],
    observations: list[Observation],
    light: LightColour,
    n_range: tuple[float, float],
) -> ModelFit:
    pictures, channels = [], observations[0].target.shape[1]
    ambient_light = np.zeros(channels)
    lit = np.zeros(channels, bool)
    for observation, scene in zip(observations, light.scenes, strict=True):
        dtype = observation.target.dtype
        ambient = np.zeros(1) if scene.ambient is None else np.asarray(scene.ambient, np.float64)
        ambient_light = np.maximum(ambient_light, ambient)
        basis = brdf.basis(model, brdf.cast(scene, dtype.name), points=observation.points)
        diffuse = jnp.zeros((observation.target.shape[0], 1), dtype) if basis.diffuse is None else basis.diffuse
        for one in scene.lights:
            lit |= np.asarray(one.emittance) * light.colour > 0
        pictures.append(Picture(observation.target, diffuse, basis.lobe, observation.weight, ambient))
    specular = issubclass(model, brdf.SpecularMaterial)
    free = np.stack([ambient_light > 0, lit, lit & specular])
    if specular and lit.any():
        optimum = search(pictures, n_min=n_range[0], n_max=n_range[1], free=free)
    else:
        optimum = fit_linear(pictures, free=free)
    return _interpret(model, optimum, free, observations, pictures, light.colour, n_range)


def _interpret(
    model: type[brdf.Material],
    optimum: Optimum,
    free: np.ndarray,
    observations: list[Observation],
    pictures: list[Picture],
    colour: np.ndarray,
    n_range: tuple[float, float],
) -> ModelFit:
    """From the engine's numbers to a material and its errors."""
    specular = issubclass(model, brdf.SpecularMaterial)
    colour = np.where(colour > 0, colour, 1.0)
    factors = np.stack([np.ones_like(colour), colour, colour])
    if specular:
        with jax.enable_x64(True):
            factors[2] *= float(model.scale(np.float64(optimum.n)))
    rounding = np.max([observation.noise for observation in observations], axis=0)
    brightest = np.max([_brightest(observation) for observation in observations], axis=0)
    visible = 0.0
    if specular and not optimum.flat:
        highlight = max(float(_highlight(picture, optimum.n)) for picture in pictures if picture.lobe is not None)
        visible = float(np.max(optimum.x[2]) * highlight / max(np.max(brightest), np.finfo(float).tiny))
    sure = uncertainty(optimum, free, rounding, brightest, specular=specular, n_range=n_range, visible=visible)
    k = optimum.x / factors
    for name in sure.undetermined:
        key, _, channel = name.removesuffix("]").partition("[")
        if key != "n":
            k[("k_a", "k_d", "k_s").index(key), int(channel) if channel else slice(None)] = 0.0
    if specular:
        material = model(k_a=k[0], k_d=k[1], k_s=k[2], n=0.0 if not k[2].any() else optimum.n)
    else:
        material = model(k_a=k[0], k_d=k[1])
    active = optimum.x > 0
    unknowns = int(np.count_nonzero(active)) + int(specular and bool(active[2].any()))
    return ModelFit(material, optimum, sure, factors, unknowns)


@eqx.filter_jit
def _highlight(picture: Picture, n: float) -> Array:
    assert picture.lobe is not None
    value, _ = picture.lobe(jnp.asarray(n))
    seen = value if picture.weight is None else jnp.where(picture.weight[:, None] > 0, value, 0)
    return jnp.max(seen)


def _brightest(observation: Observation) -> np.ndarray:
    pixels = np.asarray(observation.target)
    if observation.weight is None:
        return np.max(pixels, axis=0)
    counted = (np.asarray(observation.weight) > 0)[:, None]
    return np.max(pixels, axis=0, where=counted, initial=0.0)


def _choose(fits: list[ModelFit]) -> tuple[int, tuple[Candidate, ...]]:
    """The simplest adequate model: the smallest Bayesian information criterion (Schwarz 1978)."""
    count = float(np.sum(fits[0].optimum.pixels))
    floor = np.min([fit.sure.noise for fit in fits], axis=0)
    values = []
    for fit in fits:
        squares = np.sum(np.maximum(fit.optimum.cost, 0.0) / floor**2)
        values.append(squares + fit.unknowns * np.log(count))
    chosen = int(np.argmin(values))
    candidates = tuple(
        Candidate(
            model=fit.material.name,
            unknowns=fit.unknowns,
            rms=float(np.sqrt(np.sum(fit.optimum.cost) / count)),
            bic=float(value - values[chosen]),
            chosen=index == chosen,
        )
        for index, (fit, value) in enumerate(zip(fits, values, strict=True))
    )
    return chosen, candidates


def _parameters(fit: ModelFit) -> tuple[Parameter, ...]:
    found = []
    undetermined = fit.sure.undetermined
    specular = isinstance(fit.material, brdf.SpecularMaterial)
    for term, name in enumerate(("k_a", "k_d", "k_s") if specular else ("k_a", "k_d")):
        for channel, value in enumerate(np.asarray(getattr(fit.material, name))):
            reason = undetermined.get(name) or undetermined.get(f"{name}[{channel}]")
            if reason:
                found.append(Parameter(name, channel, None, None, reason=reason))
                continue
            error = float(fit.sure.x_error[term, channel] / fit.factors[term, channel])
            found.append(Parameter(name, channel, float(value), error, at_bound=bool(value == 0)))
    if specular:
        reason = undetermined.get("n", "")
        if reason:
            found.append(Parameter("n", None, None, None, reason=reason))
        else:
            found.append(Parameter("n", None, float(fit.optimum.n), fit.sure.n_error))
    return tuple(found)


def _result(
    fit: ModelFit,
    candidates: tuple[Candidate, ...],
    observations: list[Observation],
    targets: list[Any],
    scenes: list[brdf.Scene],
    precision: brdf.Precision,
    seconds: float,
) -> FitResult:
    optimum = fit.optimum
    left_out: dict[str, int] = {}
    for observation in observations:
        for reason, count in observation.left_out.items():
            left_out[reason] = left_out.get(reason, 0) + count
    shapes = [observation.points.mask.shape for observation in observations]
    return FitResult(
        material=fit.material,
        parameters=_parameters(fit),
        noise=fit.sure.noise,
        residual=float(np.sqrt(np.sum(optimum.cost) / np.sum(optimum.square))),
        pixels=int(optimum.pixels[0]),
        left_out=left_out,
        warnings=(),
        candidates=candidates,
        optimum=optimum,
        precision=precision,
        seconds=seconds,
        targets=[
            np.asarray(observation.target).reshape(*shape, -1)
            for observation, shape in zip(observations, shapes, strict=True)
        ],
        scenes=scenes,
        counted=[fitted_pixels(observation) for observation in observations],
    )
