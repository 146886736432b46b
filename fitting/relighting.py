"""Intensities and colours of the lights from a picture, given the material or together with it: light is linear.

A picture is a sum of one picture per light, so with the material known `fitting.fit_jointly` finds its lights from any
start. With the material unknown too the picture is linear in the products of every light's intensity with k_d
and with k_s. Those products say everything but one thing: lights twice as bright on a surface half as bright look the
same. That factor, one for each channel, no picture can determine; here the mean of the lights' factors, which say how
many times as bright as in the scene each is, is 1, and the result says so.
"""

import dataclasses
import time
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Float

import brdf
from brdf.checks import instance
from brdf.errors import InputError
from brdf.precision import Precision
from brdf.vectors import quotient
from fitting.joint import fit_jointly
from fitting.problem import model_name, state_problem
from fitting.report import FitResult
from fitting.result import Parameter

FACTOR = "one factor per channel between material and lights"
ALIKE = "another light or none would look the same"
# Of the brightest light: no light starts darker, for one without light would be held so.
FAINT = 0.01
NO_LOBE = "the picture has no highlight"
KEPT = "no picture determines it; the mean of the lights' factors, over the scene's own intensities, was made 1"


@dataclass(frozen=True, kw_only=True, repr=False)
class LightFit(FitResult):
    """Lights found in a picture: a `FitResult` whose parameters are their emittances.

    Attributes:
        emittances: of each light, then of the ambient light where the scene has any, (L, C).
        factors: the same over those of the scene, (L, C); infinite where that is 0.
        errors: standard errors of the factors, (L, C); infinite where the picture does not determine one. Those of a
            fit of both hold for the material found.

    Example:
        >>> target, scene = brdf.read_image("target.exr"), brdf.Scene.load("scene.toml")
        >>> found = fitting.fit_lights(2 * target, scene, brdf.preset("gold"))  # twice as bright
        >>> found.factors.round(3)
        array([[2., 2., 2.],
               [2., 2., 2.]])
        >>> round(float(found["lights[0].intensity"][0]), 3)
        1.3
    """

    emittances: Float[np.ndarray, "L C"]
    factors: Float[np.ndarray, "L C"]
    errors: Float[np.ndarray, "L C"]

    @property
    def scene(self) -> brdf.Scene:
        """The scene with the emittances found."""
        return self.scenes[0]

    @property
    def undetermined(self) -> dict[str, str]:
        """What the picture cannot tell, and why; also the factor that light and material share."""
        factor = {FACTOR: KEPT} if FACTOR in " ".join(self.warnings) else {}
        return factor | super().undetermined


def fit_lights(
    target: Any, scene: brdf.Scene, material: brdf.Material, *, precision: Precision = "float32", mask: Any = None
) -> LightFit:
    """Fit intensity and colour of every light, given the material.

    Args:
        target: linear values, (H, W, C), or a `brdf.Picture`.
        scene: what it shows; what it says of its lights' emittances is the unit of the factors.
        material: of the surface.
        precision: "float32" or "float64" of the pictures; sums are in float64.
        mask: (H, W), or a file: pixels to look at.

    Returns:
        The emittances, at least 0, with their errors.

    Raises:
        InputError: where the picture does not fit the scene.

    Example:
        >>> target, scene = brdf.read_image("target.exr"), brdf.Scene.load("scene.toml")
        >>> found = fitting.fit_lights(target, scene, brdf.preset("gold"))
        >>> found.emittances.shape  # of the light and the ambient light
        (2, 3)
    """
    targets = state_problem([target], [scene], [mask]).targets
    instance("material", material, brdf.Material, "Write fitting.fit_lights(target, scene, material)")
    if not scene.emittances():
        raise InputError("scene", "has no lights", "Add a [[lights]] table, or [ambient]")
    before = _emittances(scene, targets[0].pixels.shape[-1])
    start = _with_emittances(scene, before)
    found = fit_jointly(targets, start, material, lambda _, s: s[0].emittances(), precision=precision, mask=mask)
    emittances = np.stack(found.values).astype(float)
    with np.errstate(divide="ignore", invalid="ignore"):
        factors, errors = emittances / before, np.stack(found.errors) / before
    fields: dict[str, Any] = {field.name: getattr(found, field.name) for field in dataclasses.fields(FitResult)}
    fields["parameters"] = tuple(dataclasses.replace(one, reason=one.reason and ALIKE) for one in found.parameters)
    return LightFit(**fields, emittances=emittances, factors=factors, errors=errors)


def fit_lights_and_material(
    target: Any,
    scene: brdf.Scene,
    *,
    model: str = "blinn-phong",
    precision: Precision = "float32",
    mask: Any = None,
) -> LightFit:
    """Fit the lights and the material together, up to the one factor per channel that no picture determines.

    They are found by `fitting.fit_jointly`, from the best material under the lights of a matt surface. The ambient
    coefficient cannot be told from the ambient intensity: it is that of the scene, and k_a takes the rest.

    Args:
        target: linear values, (H, W, C), or a `brdf.Picture`.
        scene: what it shows; its lights' emittances are the unit of the factors, whose mean is 1.
        model: the name of the model.
        precision: as for `fit_lights`.
        mask: (H, W), or a file: pixels to look at.

    Returns:
        Lights and material; ``undetermined`` names the factor. The material's numbers come without errors.

    Raises:
        InputError: where the picture does not fit the scene, the model is unknown, or there is no light.

    Example:
        >>> target, scene = brdf.read_image("target.exr"), brdf.Scene.load("scene.toml")
        >>> found = fitting.fit_lights_and_material(target, scene)
        >>> round(float(found.material.n), 1), len(found.undetermined)
        (51.2, 1)
    """
    begun, name = time.perf_counter(), model_name(model)
    if name == "auto":
        raise InputError("model", "is unknown, got 'auto'", f"Use one of {', '.join(brdf.MODELS)}")
    targets = state_problem([target], [scene], [mask]).targets
    if not scene.lights:
        raise InputError("scene", "has no lights", "Add a [[lights]] table")
    count, channels = len(scene.lights), targets[0].pixels.shape[-1]
    before = _emittances(scene, channels)
    # Most of a picture is matt, which tells the lights about rightly from any start.
    matt = fit_lights(targets[0], scene, brdf.Lambert(k_a=np.ones(channels), k_d=np.ones(channels)), mask=mask)
    start = np.maximum(matt.emittances, FAINT * matt.emittances[:count].max(axis=0))
    start = np.where(before > 0, start, 0)  # what is stated dark stays dark
    start[count:] = before[count:]
    # The first light stays what it is, until the mean of all takes its place.
    free = ["intensity"][: count - 1]
    joint = fit_jointly(targets, _with_emittances(scene, start), name, free, mask=mask)
    lit, now = before[:count] > 0, _emittances(joint.scenes[0], channels)[:count]
    mean = quotient(now, before[:count]).sum(axis=0) / np.maximum(lit.sum(axis=0), 1)
    scale = np.where(mean > 0, mean, 1.0)
    k = {key: value * scale if key in ("k_d", "k_s") else value for key, value in vars(joint.material).items()}
    material = dataclasses.replace(joint.material, **k)
    found = fit_lights(targets[0], scene, material, precision=precision, mask=mask)
    matt = not np.any(k.get("k_s", 0))
    parameters = [
        Parameter(key, channel if value.ndim else None, float(one), None)
        for key, value in k.items()
        for channel, one in enumerate(np.ravel(value))
        if not (matt and key == "n")
    ]
    parameters += [Parameter("n", None, None, None, reason=NO_LOBE)] if matt and "n" in k else []
    correlation = np.eye(len(found.correlation) + len(parameters))
    correlation[: -len(parameters), : -len(parameters)] = found.correlation
    return dataclasses.replace(
        found,
        parameters=(*found.parameters, *parameters),
        correlation=correlation,
        warnings=tuple(dict.fromkeys((f"{FACTOR}: {KEPT}", *joint.warnings, *found.warnings))),
        seconds=time.perf_counter() - begun,
    )


def _emittances(scene: brdf.Scene, channels: int) -> Float[np.ndarray, "L C"]:
    """Of each light and then of the ambient light, in so many channels."""
    return np.stack([np.broadcast_to(np.asarray(one, float), channels) for one in scene.emittances()])


def _with_emittances(scene: brdf.Scene, emittances: Float[np.ndarray, "L C"]) -> brdf.Scene:
    """The scene under lights, and ambient light where it has any, of these emittances."""
    pairs = zip(scene.lights, emittances, strict=False)
    lights = [eqx.tree_at(lambda one: one.emittance, light, value) for light, value in pairs]
    return dataclasses.replace(scene, lights=lights, ambient=None if scene.ambient is None else emittances[-1])
