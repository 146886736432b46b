"""A map of what float32 is worth: its error, and whether every derivative is finite, over exponent and angle."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from brdf.measured.table import from_angles
from brdf.models import Material, SpecularMaterial
from brdf.models.base import check_model

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

    Example:
        >>> errors = brdf.stability_map(brdf.Lambert, np.array([0.0]), np.array([0.0, 60.0])).error
        >>> bool(errors.max() < 1e-5)
        True
    """
    check_model(model)

    def value(n: Array, vectors: Float[Array, "3 3"]) -> Array:
        """The specular term, then f_r."""
        material = model(k_d=0.5, k_s=0.5, n=n) if issubclass(model, SpecularMaterial) else model(k_d=0.5)
        return jnp.append(material.specular(*vectors), material.reflectance(vectors[1], vectors[2]))

    grid = np.meshgrid(exponents, np.radians(angles), OFFSETS, [False, True], indexing="ij")
    n, angle, offset, across = (x.ravel() for x in grid)
    vectors = _vectors(angle, offset / np.sqrt(n + 1.0), across[:, None])
    terms, finite = [], np.ones(len(n), bool)
    for x64 in (False, True):
        with jax.enable_x64(x64):
            arguments = [jnp.asarray(x, jnp.result_type(float)) for x in (n, vectors)]
            functions = value, jax.jacfwd(value, (0, 1)), jax.jacrev(value, (0, 1))
            outcomes = [jax.jit(jax.vmap(function))(*arguments) for function in functions]
        for leaf in jax.tree.leaves(outcomes):
            finite &= np.isfinite(np.asarray(leaf)).reshape(len(n), -1).all(axis=1)
        terms.append(np.asarray(outcomes[0], np.float64)[:, 0])
    peak = np.maximum(model.scale(n), 1.0) if issubclass(model, SpecularMaterial) else 1.0
    shape = len(exponents), len(angles), -1
    error = np.nan_to_num(np.abs(terms[0] - terms[1]) / peak, nan=np.inf).reshape(shape).max(axis=2)
    return StabilityMap(model.name, exponents, angles, error, np.all(finite.reshape(shape), axis=2))


def _vectors(theta: np.ndarray, tilt: np.ndarray, across: np.ndarray) -> Float[np.ndarray, "m 3 3"]:
    """Normal, light and view, rounded to float32; the view tilts from the mirror direction, in or across the plane."""
    light, tilt = from_angles(theta, 0.0), tilt[:, None]
    sideways = np.where(across, [0.0, 1.0, 0.0], from_angles(-theta - 0.5 * np.pi, 0.0))
    view = np.cos(tilt) * light * [-1.0, 1.0, 1.0] + np.sin(tilt) * sideways
    return np.stack([np.broadcast_to([0.0, 0.0, 1.0], light.shape), light, view], axis=1).astype(np.float32)
