"""Intensities and colours of the lights from a picture, given the material or together with it: light is linear.

A picture is a sum of one picture per light, so with the material known its lights are a non-negative linear problem in
each channel. With the material unknown too the picture is linear in the products of every light's intensity with k_d
and with k_s. Those products say everything but one thing: lights twice as bright on a surface half as bright look the
same. That factor, one for each channel, no picture can determine; here the mean of the lights' intensities keeps the
value it has in the scene, and the result says so.

Least squares is the whole answer for floats; of rounded values it is the start: `fitting.joint_likelihood`.
"""

import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float

import brdf
from brdf.checks import instance
from brdf.errors import InputError
from brdf.models.base import SpecularMaterial
from brdf.precision import Precision, working_precision
from fitting.continuation import Values
from fitting.joint import fit_jointly, left_over
from fitting.joint_likelihood import RoundedPictures, rounded
from fitting.likelihood import Bounds, in_any_channel
from fitting.pixels import Observed, observe
from fitting.problem import model_name, state_problem
from fitting.report import FitResult
from fitting.result import Parameter, free_parameters
from fitting.solver.nnls import inverse_diagonal, nonnegative_minimum, scaled_inverse
from fitting.uncertainty.intervals import above_zero
from fitting.uncertainty.noise_model import value_variance

FACTOR = "one factor per channel between material and lights"
KEPT = "no picture determines it; the lights' mean intensity was kept at that of the scene"


@dataclass(frozen=True, kw_only=True, repr=False)
class LightFit(FitResult):
    """Lights found in a picture: a `FitResult` whose parameters are their emittances.

    Attributes:
        emittances: of each light, then of the ambient light where the scene has any, (L, C).
        factors: the same over those of the scene, (L, C).
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
        scene: what it shows; where its lights have an emittance of 0 in a channel that stays 0.
        material: of the surface.
        precision: "float32" or "float64" of the pictures; sums are in float64.
        mask: (H, W), pixels to look at.

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
    seen = _observed(target, scene, mask, precision)
    instance("material", material, brdf.Material, "Write fitting.fit_lights(target, scene, material)")
    pixels, place = seen.shown[0][seen.counted[0]].astype(np.float64), seen.counted[0]
    images = np.asarray(brdf.render_lights(material, scene, precision=precision), np.float64)
    images = np.broadcast_to(images, (*images.shape[:3], pixels.shape[1])).reshape(len(images), -1, pixels.shape[1])
    columns = images[:, place.ravel()]
    factors, errors = _intensities(columns, pixels)
    if (bounds := rounded(seen)) is not None:
        factors, errors = _of_codes(bounds[0], images, factors, np.isfinite(errors))
    before = _emittances(scene, pixels.shape[1])
    emittances = before * factors
    fields = ("radiance" if "radiance" in vars(light) else "intensity" for light in scene.lights)
    names = [f"lights[{index}].{field}" for index, field in enumerate(fields)]
    names += ["ambient"] * (len(emittances) - len(names))
    parameters = [
        _emittance(name, channel, *numbers)
        for name, *rows in zip(names, emittances, before * errors, strict=True)
        for channel, numbers in enumerate(zip(*rows, strict=True))
    ]
    residual = np.zeros((*place.shape, pixels.shape[1]))
    residual[place] = pixels - _sum(factors, columns)
    return LightFit(
        **left_over(seen, [_with_emittances(scene, emittances)], [residual], factors.size, ()),
        material=material,
        parameters=tuple(parameters),
        correlation=np.eye(len(free_parameters(parameters))),
        emittances=emittances,
        factors=factors,
        errors=errors,
    )


def fit_lights_and_material(
    target: Any,
    scene: brdf.Scene,
    *,
    model: str = "blinn-phong",
    precision: Precision = "float32",
    mask: Any = None,
) -> LightFit:
    """Fit the lights and the material together, up to the one factor per channel that no picture determines.

    They are found by `fitting.fit_jointly`, from the best material under the scene's own lights. The ambient
    coefficient cannot be told from the ambient intensity: it is that of the scene, and k_a takes the rest.

    Args:
        target: linear values, (H, W, C), or a `brdf.Picture`.
        scene: what it shows; its lights are the start, and their mean stays what it is.
        model: the name of the model.
        precision: as for `fit_lights`.
        mask: (H, W), pixels to look at.

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
    name = model_name(model)
    if name == "auto":
        raise InputError("model", "is unknown, got 'auto'", f"Use one of {', '.join(brdf.MODELS)}")
    seen = _observed(target, scene, mask, precision)
    if not scene.lights:
        raise InputError("scene", "has no lights", "Add a [[lights]] table")
    keys = ["k_a"] * (scene.ambient is not None) + ["k_d"]
    keys += ["k_s", "n"] * issubclass(brdf.MODELS[name], SpecularMaterial)

    def leaves(material: Any, scenes: Sequence[brdf.Scene]) -> list[Any]:
        return [*(getattr(material, key) for key in keys), *(light.emittance for light in scenes[0].lights)]

    before = _emittances(scene, seen.shown[0].shape[-1])
    joint = fit_jointly(target, _with_emittances(scene, before), name, leaves, mask=mask)
    now = _emittances(joint.scenes[0], before.shape[1])
    lights = slice(len(scene.lights))
    mean = np.divide(now, before, out=np.zeros_like(now), where=before > 0)[lights].mean(axis=0)
    scale = np.where(mean > 0, mean, 1.0)
    scaled = {key: getattr(joint.material, key) * scale for key in {"k_d", "k_s"}.intersection(keys)}
    material = dataclasses.replace(joint.material, **scaled)
    found = fit_lights(target, scene, material, precision=precision, mask=mask)
    numbers = {key: np.atleast_1d(value) for key, value in vars(material).items()}
    parameters = [
        *found.parameters,
        *(
            Parameter(key, None if key == "n" else channel, float(value), None)
            for key, values in numbers.items()
            for channel, value in enumerate(values)
        ),
    ]
    return dataclasses.replace(
        found,
        parameters=tuple(parameters),
        correlation=np.eye(len(free_parameters(parameters))),
        warnings=(f"{FACTOR}: {KEPT}", *found.warnings),
    )


def _observed(target: Any, scene: Any, mask: Any, precision: Precision) -> Observed:
    """Which pixels count."""
    problem = state_problem([target], [scene], [mask], precision=precision)
    with working_precision(precision):
        return observe(problem, at_once=True)


def _intensities(columns: np.ndarray, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Factors and their standard errors, channel by channel, (L, C) each; the columns are (L, P, C)."""
    lights, count, channels = columns.shape
    factors, errors = np.zeros((2, lights, channels))
    grams = np.einsum("lpc,mpc->clm", columns, columns, optimize=True)
    for c, gram in enumerate(grams):
        factors[:, c] = nonnegative_minimum(gram, columns[..., c] @ pixels[:, c])
    value = _sum(factors, columns)
    squares = np.maximum(np.sum((pixels - value) ** 2, axis=0), np.finfo(float).tiny)
    variance = value_variance(pixels - value, value, np.sqrt(squares / max(count - lights, 1)))
    for c, gram in enumerate(grams):
        moves = scaled_inverse(gram) @ columns[..., c]
        errors[:, c] = np.sqrt(np.where(np.isfinite(inverse_diagonal(gram)), moves**2 @ variance[:, c], np.inf))
    return factors, errors


def _of_codes(bounds: Bounds, images: np.ndarray, factors: np.ndarray, known: np.ndarray) -> tuple[np.ndarray, ...]:
    """Factors and errors by what rounded values say, from those of least squares; the images are (L, P, C)."""
    tell = np.flatnonzero(in_any_channel(bounds.ends > 0))
    picture = _LitPicture(bounds.pixels(partial(np.take, indices=tell, axis=0)), images[:, tell], known)
    likely, errors = picture.most_likely(factors.ravel()), np.full(known.shape, np.inf)
    errors[known] = likely.errors(picture.design)[1]
    return likely.vector.reshape(known.shape), errors


class _LitPicture(RoundedPictures):
    """A rounded picture that is linear in its lights, channel by channel."""

    def __init__(self, bounds: Bounds, columns: Float[np.ndarray, "L P C"], known: Bool[np.ndarray, "L C"]):
        """Take the picture of each light, and which of their factors are determined."""
        self._columns, none = columns, np.zeros(known.size, bool)
        places = np.arange(known.size).reshape(known.shape).T
        super().__init__([bounds], np.eye(known.size)[:, known.ravel()], places, bounded=~none, exponents=none)

    def codes(self, unknowns: Float[np.ndarray, " U"]) -> list[Float[np.ndarray, "P C"]]:
        """What is predicted, in codes."""
        return [self.bounds[0].codes(_sum(unknowns, self._columns))[0]]

    def shown(self, unknowns: Float[np.ndarray, " U"], values: Sequence[Values]) -> Iterator[tuple[Any, Any]]:
        """What is predicted, and its derivatives by each channel's factors."""
        for some in values:
            columns = self._columns[:, some.which]
            yield _sum(unknowns, columns), columns


def _sum(factors: np.ndarray, images: Float[np.ndarray, "L P C"]) -> Float[np.ndarray, "P C"]:
    return np.einsum("lc,lpc->pc", factors.reshape(len(images), -1), images)


def _emittances(scene: brdf.Scene, channels: int) -> Float[np.ndarray, "L C"]:
    """Of each light and then of the ambient light, in so many channels."""
    return np.stack([np.broadcast_to(np.asarray(one, float), channels) for one in scene.emittances()])


def _with_emittances(scene: brdf.Scene, emittances: Float[np.ndarray, "L C"]) -> brdf.Scene:
    """The scene under lights, and ambient light where it has any, of these emittances."""
    lights = tuple(
        eqx.tree_at(lambda one: one.emittance, light, emittance)
        for light, emittance in zip(scene.lights, emittances, strict=False)
    )
    found = eqx.tree_at(lambda s: s.lights, scene, lights)
    return found if scene.ambient is None else eqx.tree_at(lambda s: s.ambient, found, emittances[-1])


def _emittance(name: str, channel: int, value: float, error: float) -> Parameter:
    if not np.isfinite(error):
        return Parameter(name, channel, None, float(error), reason="another light or none would look the same")
    return Parameter(name, channel, float(value), float(error), above_zero(float(value), float(error)), not value)
