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
from brdf.errors import InputError
from brdf.models.base import SpecularMaterial
from brdf.precision import Precision
from fitting.solver.nnls import inverse_diagonal, nonnegative_minimum
from fitting.solver.refinement import GRID_STEP, minimum_between

UNKNOWN_FACTOR = (
    "one factor per channel between material and lights: the lights' mean intensity was kept at that of the scene"
)
N_RANGE = (0.5, 1e5)
_ROUNDS = 200


@dataclass(frozen=True)
class LightFit:
    """Lights found in a picture.

    Attributes:
        scene: the scene with the emittances found.
        material: the one that was given, or found.
        emittances: of each light, then of the ambient light where the scene has any, (L, C).
        factors: the same over those of the scene, (L, C).
        errors: standard errors of the factors, (L, C); infinite where the picture does not determine one. Those of a
            fit of both hold for the material found.
        residual: root mean square of the residual over that of the picture.
        undetermined: what the picture cannot tell, in words; empty where it tells all.

    Example:
        >>> target, scene = brdf.read_image("target.exr"), brdf.Scene.load("scene.toml")
        >>> fitting.fit_lights(2 * target, scene, brdf.preset("gold")).factors.round(3)  # twice as bright
        array([[2., 2., 2.],
               [2., 2., 2.]])
    """

    scene: brdf.Scene
    material: brdf.Material
    emittances: Float[np.ndarray, "L C"]
    factors: Float[np.ndarray, "L C"]
    errors: Float[np.ndarray, "L C"]
    residual: float
    undetermined: tuple[str, ...]

    def __str__(self) -> str:
        """The report."""
        names = [light.type_name for light in self.scene.lights]
        names += ["ambient"] * (len(self.emittances) - len(names))
        lines = [f"light of {len(names)} sources on {self.material.name}"]
        for name, *numbers in zip(names, self.emittances, self.factors, self.errors, strict=True):
            values = (f"{v:.6g} ± {v * e / f if f > 0 else e:.2g}" for v, f, e in zip(*numbers, strict=True))
            lines.append(f"  {name:<12} {', '.join(values)}")
        lines.append(f"  residual     {100 * self.residual:.3g} % of the picture (rms)")
        return "\n".join(lines + [f"  not determined: {what}" for what in self.undetermined])


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
    pixels, seen = _pixels(target, scene, mask)
    images = np.asarray(brdf.render_lights(material, scene, precision=precision), np.float64)[:, seen]
    columns = np.broadcast_to(images, (*images.shape[:2], pixels.shape[1]))
    factors, errors = _intensities(columns, pixels)
    return _result(scene, material, columns, pixels, factors, errors, ())


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
        Lights and material; ``undetermined`` names the factor.

    Raises:
        InputError: where the picture does not fit the scene, the model is unknown, or there is no light.

    Example:
        >>> target, scene = brdf.read_image("target.exr"), brdf.Scene.load("scene.toml")
        >>> found = fitting.fit_lights_and_material(target, scene)
        >>> round(float(found.material.n), 1), len(found.undetermined)
        (51.2, 1)
    """
    if model not in brdf.MODELS:
        raise InputError("model", f"is unknown, got {model!r}", f"Use one of {', '.join(brdf.MODELS)}")
    if not scene.lights:
        raise InputError("scene", "has no lights", "Add a [[lights]] table")
    pixels, seen = _pixels(target, scene, mask)
    cls: Any = brdf.MODELS[model]
    names = ["k_d", "k_s"] if issubclass(cls, SpecularMaterial) else ["k_d"]
    lights = len(scene.lights)

    def surface(k: Any, n: float) -> brdf.Material:
        return cls(**dict(zip([*names, "k_a"], k, strict=True)), **{"n": n} if len(names) > 1 else {})

    def terms(n: float) -> np.ndarray:
        """One picture per light, and of the ambient light, for k_d = 1, for k_s = 1 and for k_a = 1; (L, T, P, C)."""
        units = [surface(k, n) for k in np.eye(len(names), len(names) + 1)]
        images = [np.asarray(brdf.render_lights(one, scene, precision=precision))[:, seen] for one in units]
        found = np.zeros((len(images[0]), len(names) + 1, *pixels.shape))
        found[:, :-1] = np.stack(images, axis=1)
        if scene.ambient is not None:
            found[-1, -1] = scene.ambient
        return found

    n = _best_exponent(lambda n: _in_turn(terms(n), pixels, lights)[0], n_range) if len(names) > 1 else 1.0
    images = terms(n)
    _, factors, k = _in_turn(images, pixels, lights)
    mean = factors[:lights].mean(axis=0)
    scale = np.where(mean > 0, mean, 1.0)
    factors[:lights] /= scale
    k[:-1] *= scale
    columns = np.einsum("ltpc,tc->lpc", images, k)
    _, errors = _intensities(columns, pixels)
    return _result(scene, surface(k, n), columns, pixels, factors, errors, (UNKNOWN_FACTOR,))


def _pixels(target: Any, scene: brdf.Scene, mask: Any) -> tuple[np.ndarray, np.ndarray]:
    """Values of the pixels that count, (P, C), and which these are, (H, W)."""
    values = np.asarray(target.pixels if isinstance(target, brdf.Picture) else target, np.float64)
    values = values[..., None] if values.ndim == 2 else values
    if values.ndim != 3 or values.shape[1::-1] != scene.resolution:
        came = f"is of shape {values.shape}, the scene {scene.resolution[0]} x {scene.resolution[1]} pixels"
        raise InputError("target", came, "Give a picture and a camera of the same resolution")
    if scene.channels not in (1, values.shape[2]):
        came = f"has {values.shape[2]} channels, the scene's light {scene.channels}"
        raise InputError("target", came, "Give both the same number of channels")
    seen = np.asarray(scene.surface_points().mask) & np.all(np.isfinite(values), axis=-1)
    if mask is not None:
        seen &= np.asarray(mask, bool)
    if not seen.any():
        raise InputError("target", "has no finite pixel that sees a fitted shape", "Check camera, shapes and mask")
    return values[seen], seen


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
    """The exponent of least cost: a grid over log n, then the best cell's neighbourhood."""

    def costs(log_n: np.ndarray) -> np.ndarray:
        return np.array([cost(float(n)) for n in np.exp(log_n)])

    low, high = np.log(n_range)
    grid = np.linspace(low, high, 2 + int((high - low) / GRID_STEP))
    best = int(np.argmin(costs(grid)))
    return float(np.exp(minimum_between(costs, grid[max(best - 1, 0)], grid[min(best + 1, len(grid) - 1)], points=9)))


def _result(
    scene: brdf.Scene,
    material: brdf.Material,
    columns: np.ndarray,
    pixels: np.ndarray,
    factors: np.ndarray,
    errors: np.ndarray,
    undetermined: tuple[str, ...],
) -> LightFit:
    channels = pixels.shape[1]
    before = np.stack([np.broadcast_to(np.asarray(one, float), channels) for one in scene.emittances()])
    emittances = before * factors
    lights = tuple(
        eqx.tree_at(lambda one: one.emittance, light, emittance)
        for light, emittance in zip(scene.lights, emittances, strict=False)
    )
    found = eqx.tree_at(lambda s: s.lights, scene, lights)
    if scene.ambient is not None:
        found = eqx.tree_at(lambda s: s.ambient, found, emittances[-1])
    residual = pixels - np.einsum("lc,lpc->pc", factors, columns)
    share = float((np.sum(residual**2) / max(np.sum(pixels**2), np.finfo(float).tiny)) ** 0.5)
    dark = [
        f"intensity of light {index} in channel {channel}: another light or none would look the same"
        for index, channel in np.argwhere(~np.isfinite(errors))
    ]
    return LightFit(found, material, emittances, factors, errors, share, (*undetermined, *dark))
