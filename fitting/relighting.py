"""Intensities and colours of the lights from a picture, given the material or together with it: light is linear.

A picture is a sum of one picture per light, so with the material known its lights are a non-negative linear problem in
each channel. With the material unknown too the picture is linear in the products of every light's intensity with k_d
and with k_s. Those products say everything but one thing: lights twice as bright on a surface half as bright look the
same. That factor, one for each channel, no picture can determine; here the mean of the lights' intensities keeps the
value it has in the scene, and the result says so.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Float

import brdf
from brdf.checks import instance
from brdf.errors import InputError
from brdf.models.base import SpecularMaterial
from brdf.precision import Precision, working_precision
from fitting.joint import left_over
from fitting.pixels import Observed, observe
from fitting.problem import model_name, state_problem
from fitting.progress import waiting
from fitting.report import FitResult
from fitting.result import Parameter, free_parameters
from fitting.solver.nnls import inverse_diagonal, nonnegative_minimum
from fitting.solver.refinement import GRID_STEP
from fitting.uncertainty.intervals import above_zero

FACTOR = "one factor per channel between material and lights"
KEPT = "no picture determines it; the lights' mean intensity was kept at that of the scene"
N_RANGE = (0.5, 1e5)
CLOSE = 1e-5
_ROUNDS = 200


@dataclass(frozen=True, kw_only=True)
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
    images = np.asarray(brdf.render_lights(material, scene, precision=precision), np.float64)[:, place]
    columns = np.broadcast_to(images, (*images.shape[:2], pixels.shape[1]))
    factors, errors = _intensities(columns, pixels)
    return _result(seen, material, columns, pixels, factors, errors, has_material=False)


def fit_lights_and_material(
    target: Any,
    scene: brdf.Scene,
    *,
    model: str = "blinn-phong",
    precision: Precision = "float32",
    mask: Any = None,
    n_range: tuple[float, float] = N_RANGE,
) -> LightFit:
    """Fit the lights and the material together, up to the one factor per channel that no picture determines.

    For each exponent of a grid, and then around the best, the intensities and the coefficients are
    found in turn, each a non-negative linear problem, until the residual stands still. The ambient coefficient cannot
    be told from the ambient intensity: it is that of the scene, and k_a takes the rest.

    Args:
        target: linear values, (H, W, C), or a `brdf.Picture`.
        scene: what it shows; its lights are the start, and their mean stays what it is.
        model: the name of the model.
        precision: as for `fit_lights`.
        mask: (H, W), pixels to look at.
        n_range: bounds of the exponent.

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
    pixels, place = seen.shown[0][seen.counted[0]].astype(np.float64), seen.counted[0]
    cls: Any = brdf.MODELS[name]
    names = ["k_d", "k_s"] if issubclass(cls, SpecularMaterial) else ["k_d"]
    lights = len(scene.lights)

    def surface(k: Any, n: float) -> brdf.Material:
        return cls(**dict(zip([*names, "k_a"], k, strict=True)), **{"n": n} if len(names) > 1 else {})

    def terms(n: float) -> np.ndarray:
        """One picture per light, and of the ambient light, for k_d = 1, for k_s = 1 and for k_a = 1; (L, T, P, C)."""
        units = [surface(k, n) for k in np.eye(len(names), len(names) + 1)]
        images = [np.asarray(brdf.render_lights(one, scene, precision=precision))[:, place] for one in units]
        found = np.zeros((len(images[0]), len(names) + 1, *pixels.shape))
        found[:, :-1] = np.stack(images, axis=1)
        if scene.ambient is not None:
            found[-1, -1] = scene.ambient
        return found

    with waiting("fitting lights and material"):
        n = _best_exponent(lambda n: _in_turn(terms(n), pixels, lights)[0], n_range) if len(names) > 1 else 1.0
        images = terms(n)
        _, factors, k = _in_turn(images, pixels, lights)
    mean = factors[:lights].mean(axis=0)
    scale = np.where(mean > 0, mean, 1.0)
    factors[:lights] /= scale
    k[:-1] *= scale
    columns = np.einsum("ltpc,tc->lpc", images, k)
    _, errors = _intensities(columns, pixels)
    return _result(seen, surface(k, n), columns, pixels, factors, errors, has_material=True)


def _observed(target: Any, scene: Any, mask: Any, precision: Precision) -> Observed:
    """Which pixels count."""
    problem = state_problem([target], [scene], [mask], precision=precision)
    with working_precision(precision):
        return observe(problem, at_once=True)


def _intensities(columns: np.ndarray, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Factors and their standard errors, channel by channel, (L, C) each; the columns are (L, P, C)."""
    lights, count, channels = columns.shape
    factors, errors = np.zeros((2, lights, channels))
    for c in range(channels):
        gram = columns[..., c] @ columns[..., c].T
        factors[:, c] = nonnegative_minimum(gram, columns[..., c] @ pixels[:, c])
        residual = pixels[:, c] - factors[:, c] @ columns[..., c]
        noise = max(float(np.sum(residual**2)), np.finfo(float).tiny) / max(count - lights, 1)
        errors[:, c] = np.sqrt(noise * inverse_diagonal(gram))
    return factors, errors


def _in_turn(terms: np.ndarray, pixels: np.ndarray, lights: int) -> tuple[float, np.ndarray, np.ndarray]:
    """Least cost at one exponent, the lights' factors, (L, C), and the coefficients with k_a last, (T, C)."""
    shape, channels = terms.shape[:2], pixels.shape[1]
    cost, factors, coefficients = 0.0, np.ones((shape[0], channels)), np.zeros((shape[1], channels))
    for c in range(channels):
        columns = terms[..., c].reshape(-1, len(pixels))
        gram, product = (columns @ columns.T).reshape(*shape, *shape), (columns @ pixels[:, c]).reshape(shape)
        square, last, light = float(pixels[:, c] @ pixels[:, c]), np.inf, np.ones(shape[0])
        now, k = square, np.zeros(shape[1])
        for _ in range(_ROUNDS):
            k = nonnegative_minimum(np.einsum("l,ltms,m->ts", light, gram, light), light @ product)
            by_light = np.einsum("t,ltms,s->lm", k, gram, k)
            light = nonnegative_minimum(by_light, product @ k)
            now = max(float(square - 2 * light @ product @ k + light @ by_light @ light), 0.0)
            # The ambient light keeps its intensity.
            k[-1] *= light[lights:].sum()
            light[lights:] = 1.0
            if last - now <= 1e-12 * square:
                break
            last = now
        cost, factors[:, c], coefficients[:, c] = cost + now, light, k
    return cost, factors, coefficients


def _best_exponent(cost: Callable[[float], float], n_range: tuple[float, float]) -> float:
    """The exponent of least cost: a grid over log n, and finer ones around the best, down to `CLOSE`."""
    low, high = np.log(n_range)
    grid = np.linspace(low, high, 2 + int((high - low) / GRID_STEP))
    while True:
        best = int(np.argmin([cost(float(n)) for n in np.exp(grid)]))
        low, high = grid[max(best - 1, 0)], grid[min(best + 1, len(grid) - 1)]
        if high - low <= CLOSE:
            return float(np.exp(grid[best]))
        grid = np.linspace(low, high, 9)


def _result(
    seen: Observed,
    material: brdf.Material,
    columns: np.ndarray,
    pixels: np.ndarray,
    factors: np.ndarray,
    errors: np.ndarray,
    *,
    has_material: bool,
) -> LightFit:
    """The result; ``has_material`` where the material was found too."""
    scene, channels = seen.problem.scenes[0], pixels.shape[1]
    before = np.stack([np.broadcast_to(np.asarray(one, float), channels) for one in scene.emittances()])
    emittances = before * factors
    lights = tuple(
        eqx.tree_at(lambda one: one.emittance, light, emittance)
        for light, emittance in zip(scene.lights, emittances, strict=False)
    )
    found = eqx.tree_at(lambda s: s.lights, scene, lights)
    if scene.ambient is not None:
        found = eqx.tree_at(lambda s: s.ambient, found, emittances[-1])
    fields = ("radiance" if "radiance" in vars(light) else "intensity" for light in lights)
    names = [f"lights[{index}].{field}" for index, field in enumerate(fields)]
    names += ["ambient"] * (len(emittances) - len(names))
    parameters = [
        _emittance(name, channel, *numbers)
        for name, *rows in zip(names, emittances, before * errors, strict=True)
        for channel, numbers in enumerate(zip(*rows, strict=True))
    ]
    if has_material:
        numbers = {name: np.atleast_1d(value) for name, value in vars(material).items()}
        parameters += [
            Parameter(name, None if name == "n" else channel, float(value), None)
            for name, values in numbers.items()
            for channel, value in enumerate(values)
        ]
    residual = np.zeros((*seen.counted[0].shape, channels))
    residual[seen.counted[0]] = pixels - np.einsum("lc,lpc->pc", factors, columns)
    return LightFit(
        **left_over(seen, [residual], factors.size, (f"{FACTOR}: {KEPT}",) * has_material),
        material=material,
        parameters=tuple(parameters),
        correlation=np.eye(len(free_parameters(parameters))),
        scenes=[found],
        emittances=emittances,
        factors=factors,
        errors=errors,
    )


def _emittance(name: str, channel: int, value: float, error: float) -> Parameter:
    if not np.isfinite(error):
        return Parameter(name, channel, None, float(error), reason="another light or none would look the same")
    return Parameter(name, channel, float(value), float(error), above_zero(float(value), float(error)), not value)
