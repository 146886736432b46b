"""A map of what float32 is worth: its error, and whether every derivative is finite, over exponent and angle."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from brdf.models import MODELS, Lambert, Material, SpecularMaterial

EXPONENTS = np.array([0.0, 1e-3, 0.1, 0.5, 1.0, 2.0, 5.0, *np.geomspace(10.0, 1e8, 15)])
ANGLES = np.array([*np.arange(0.0, 85.0, 5.0), 85.0, 87.0, 88.0, 89.0, 89.5, 89.9, 89.99, 89.999, 90.0])
OFFSETS = np.array([-6.0, -3.0, -1.5, -0.7, -0.2, 0.0, 0.2, 0.7, 1.5, 3.0, 6.0])
"""Where the view stands: lobe widths 1 / sqrt(n+1) from the mirror direction, in and across the plane of incidence."""


@dataclasses.dataclass(frozen=True)
class StabilityMap:
    """What was found for one model.

    Attributes:
        model: its name.
        exponents: n, (a,).
        angles: angle of the light in degrees, (b,).
        error: largest difference of the specular term between float32 and float64, evaluated on the same float32
            vectors and relative to the peak of the lobe, over all views, (a, b).
        finite: whether value and all first derivatives, forward and reverse, float32 and float64, were finite, (a, b).
    """

    model: str
    exponents: Float[np.ndarray, " a"]
    angles: Float[np.ndarray, " b"]
    error: Float[np.ndarray, "a b"]
    finite: Bool[np.ndarray, "a b"]


def stability_map(
    model: type[Material], exponents: Float[np.ndarray, " a"] = EXPONENTS, angles: Float[np.ndarray, " b"] = ANGLES
) -> StabilityMap:
    """Compare float32 with float64 and try all derivatives, over exponent and angle of the light.

    Args:
        model: one of the five models.
        exponents: n, at least 0, (a,).
        angles: angle of the light in degrees, 0 to 90, (b,).

    Returns:
        The map.
    """
    n, angle, offset, across = (x.ravel() for x in np.meshgrid(exponents, angles, OFFSETS, [0.0, 1.0], indexing="ij"))
    vectors = _vectors(n, np.radians(angle), offset, across)
    results, finite = [], np.ones(len(n), bool)
    for x64 in (False, True):
        with jax.enable_x64(x64):
            kind = jnp.result_type(float)
            arguments = jnp.asarray(n, kind), jnp.asarray(vectors, kind)
            for function in (_value(model), jax.jacfwd(_value(model), (0, 1)), jax.jacrev(_value(model), (0, 1))):
                leaves = jax.tree.leaves(jax.jit(jax.vmap(function))(*arguments))
                finite &= np.all([np.isfinite(np.asarray(x)).reshape(len(n), -1).all(axis=1) for x in leaves], axis=0)
            results.append(np.asarray(jax.jit(jax.vmap(_value(model)))(*arguments), np.float64)[:, 0])
    shape = len(exponents), len(angles), -1
    difference = np.abs(results[0] - results[1]) / np.maximum(_peak(model, n), 1.0)
    error = np.nan_to_num(difference, nan=np.inf).reshape(shape).max(axis=2)
    return StabilityMap(model.name, exponents, angles, error, finite.reshape(shape).all(axis=2))


def stability_maps() -> list[StabilityMap]:
    """The maps of the five models."""
    return [stability_map(model) for model in MODELS.values()]


def _value(model: type[Material]):
    def value(n: Array, vectors: Float[Array, "3 3"]) -> Array:
        """The specular term, then f_r."""
        material = model(k_d=0.5, k_s=0.5, n=n) if issubclass(model, SpecularMaterial) else Lambert(k_d=0.5)
        return jnp.append(material.specular(*vectors), material.reflectance(vectors[1], vectors[2]))

    return value


def _vectors(n: np.ndarray, theta: np.ndarray, offset: np.ndarray, across: np.ndarray) -> Float[np.ndarray, "m 3 3"]:
    """Normal, light and view, rounded to float32."""
    zero, one = np.zeros_like(theta), np.ones_like(theta)
    light = np.stack([np.sin(theta), zero, np.cos(theta)], -1)
    tilt = offset / np.sqrt(n + 1.0)
    in_plane = np.stack([-np.sin(theta + tilt), zero, np.cos(theta + tilt)], -1)
    beside = np.cos(tilt)[:, None] * light * [-1.0, 1.0, 1.0] + np.sin(tilt)[:, None] * np.array([0.0, 1.0, 0.0])
    view = np.where(across[:, None] > 0, beside, in_plane)
    return np.stack([np.stack([zero, zero, one], -1), light, view], axis=1).astype(np.float32)


def _peak(model: type[Material], n: np.ndarray) -> np.ndarray:
    if not issubclass(model, SpecularMaterial):
        return np.ones_like(n)
    with jax.enable_x64(True):
        return np.asarray(model.scale(n))
