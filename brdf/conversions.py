"""From one description of gloss to another: exponent, slope, glTF roughness; classic and normalised forms.

Plain numbers are converted in float64, whatever JAX is set to; what JAX is tracing keeps its type.
"""

import functools
import inspect
from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Float

from brdf import vectors
from brdf.albedo import gauss_legendre, lobe_albedo, normalized_form
from brdf.errors import InputError
from brdf.models import BlinnPhong, Lambert, Material, NormalizedPhong, Phong, SpecularMaterial
from brdf.models.base import check_single
from brdf.precision import working_precision
from brdf.vectors import Numbers, Scalars

_NODES = 400  # over the light's angle: the integrands have at worst a layer 1 / sqrt(n) wide at 90 degrees


def _converter(formula: Callable[..., Any]) -> Callable[[Numbers], Scalars]:
    """The formula of one number, which is checked by its name: exponents are at least 0, the others in (0, 1]."""
    (name,) = inspect.signature(formula).parameters
    wanted = "at least 0" if name == "n" else "above 0 and at most 1"

    @functools.wraps(formula)
    def convert(value: Any) -> Any:
        if isinstance(value, Tracer):
            return formula(value)
        numbers = np.asarray(value, np.float64)
        right = (numbers >= 0) if name == "n" else (numbers > 0) & (numbers <= 1)
        wrong = ~(right & np.isfinite(numbers))
        if np.any(wrong):
            raise InputError(name, f"must be {wanted}, got {numbers[wrong].flat[0]:g}")
        with working_precision("float64"):
            return np.asarray(formula(jnp.asarray(numbers)))

    return convert


@_converter
def slope_from_exponent(n: Numbers) -> Scalars:
    """Microfacet slope alpha = sqrt(2 / (n+2)) of a half-vector exponent.

    Args:
        n: half-vector exponent, at least 0, (...).

    Returns:
        (...), above 0 to 1. Source: Walter et al., "Microfacet models for refraction", EGSR 2007, section 5.2.

    Example:
        >>> float(brdf.slope_from_exponent(6.0))
        0.5
    """
    return vectors.square_root(2.0 / (n + 2.0))


@_converter
def exponent_from_slope(alpha: Numbers) -> Scalars:
    """Half-vector exponent n = 2 / alpha^2 - 2 of a microfacet slope.

    Args:
        alpha: microfacet slope, above 0 to 1, (...).

    Returns:
        (...), at least 0.

    Example:
        >>> float(brdf.exponent_from_slope(0.5))
        6.0
    """
    return jnp.asarray(2.0 * (1.0 - alpha) * (1.0 + alpha) / (alpha * alpha))


@_converter
def roughness_from_exponent(n: Numbers) -> Scalars:
    """Perceptual roughness of glTF, sqrt(alpha) = (2 / (n+2))^(1/4), of a half-vector exponent.

    Args:
        n: half-vector exponent, at least 0, (...).

    Returns:
        (...), above 0 to 1. Source: glTF 2.0 specification, appendix B: alpha = roughness^2.

    Example:
        >>> float(brdf.roughness_from_exponent(30.0))
        0.5
    """
    return vectors.square_root(slope_from_exponent(n))


@_converter
def exponent_from_roughness(roughness: Numbers) -> Scalars:
    """Half-vector exponent n = 2 / roughness^4 - 2 of the perceptual roughness of glTF.

    Args:
        roughness: above 0 to 1, (...).

    Returns:
        (...), at least 0.

    Example:
        >>> float(brdf.exponent_from_roughness(0.5))
        30.0
    """
    return exponent_from_slope(roughness * roughness)


@_converter
def half_from_mirror(n: Numbers) -> Scalars:
    """Half-vector exponent of nearly the same highlight as a mirror exponent: 4 n.

    The angle of the half vector is half the angle of the mirror direction in the plane of incidence, so that lobes of
    the two agree to second order about their peak there; across it the half-vector lobe is narrower at grazing angles.

    Args:
        n: mirror exponent (R.V), at least 0, (...).

    Returns:
        (...), at least 0.

    Example:
        >>> float(brdf.half_from_mirror(10.0))
        40.0
    """
    return jnp.multiply(4.0, n)


@_converter
def mirror_from_half(n: Numbers) -> Scalars:
    """Mirror exponent of nearly the same highlight as a half-vector exponent: n / 4; see ``half_from_mirror``.

    Args:
        n: half-vector exponent (N.H), at least 0, (...).

    Returns:
        (...), at least 0.

    Example:
        >>> float(brdf.mirror_from_half(40.0))
        10.0
    """
    return jnp.multiply(0.25, n)


def nearest_normalized(material: Material) -> Material:
    """The nearest plausible material: normalised, with k_d + k_s <= 1 in every channel.

    Nearest means: of the same lobe and exponent, with the least mean square difference of radiance over the pixels of a
    sphere, averaged over all directions of light. Ambient light is kept. A Lambert material stays one.

    Args:
        material: one of the five models, of known numbers.

    Returns:
        ``NormalizedPhong``, ``NormalizedBlinnPhong`` or ``Lambert``.

    Example:
        >>> brdf.nearest_normalized(brdf.Phong(k_d=0.3, k_s=0.5, n=50))
        NormalizedPhong(k_a=[0], k_d=[0.3...], k_s=[0...], n=50)
    """
    check_single(material, "Write brdf.nearest_normalized(material)")
    if not isinstance(material, SpecularMaterial):
        return Lambert(k_a=material.k_a, k_d=np.clip(np.asarray(material.k_d), 0.0, 1.0))
    return _nearest(material, normalized_form(type(material)))


def nearest_classic(material: Material) -> Material:
    """The nearest material of classic form; nearest as in ``nearest_normalized``, without the bound on k_d + k_s.

    Args:
        material: one of the five models, of known numbers.

    Returns:
        ``Phong``, ``BlinnPhong`` or ``Lambert``.

    Example:
        >>> brdf.nearest_classic(brdf.NormalizedPhong(k_d=0.3, k_s=0.6, n=50))
        Phong(k_a=[0], k_d=[0.354...], k_s=[10.28...], n=50)
    """
    check_single(material, "Write brdf.nearest_classic(material)")
    if not isinstance(material, SpecularMaterial):
        return material
    return _nearest(material, _classic_form(type(material)))


def _classic_form(model: type[SpecularMaterial]) -> type[SpecularMaterial]:
    return Phong if normalized_form(model) is NormalizedPhong else BlinnPhong


def _nearest(material: SpecularMaterial, model: type[SpecularMaterial]) -> SpecularMaterial:
    n = float(np.asarray(material.n))
    gram, cross = nearest_equations(type(material), model, n)
    k_d, k_s = np.asarray(material.k_d, np.float64), np.asarray(material.k_s, np.float64)
    right = np.outer(k_d, gram[:, 0]) + np.outer(k_s, cross)
    pairs = np.array([_constrained(gram, each, model.cosine_weighted) for each in right])
    return model(k_a=material.k_a, k_d=pairs[:, 0], k_s=pairs[:, 1], n=n)


def nearest_equations(
    given: type[SpecularMaterial], model: type[SpecularMaterial], n: float
) -> tuple[Float[np.ndarray, "2 2"], Float[np.ndarray, " 2"]]:
    """The normal equations of the nearest k_d and k_s: gram x = gram[:, 0] k_d + cross k_s.

    ``given`` is the form that k_d and k_s are of, ``model`` the one that is wanted; both have the exponent n.
    """
    # Light is uniform over the hemisphere, the view in proportion to N.V, as a sphere shows it to a far camera. Then
    # every entry of the normal equations is an integral over the light's angle of an albedo of exponent n or 2 n.
    nodes, weights = gauss_legendre(_NODES)
    theta = 0.5 * np.pi * nodes
    weights, cosine = weights * np.sin(theta), np.cos(theta)
    with working_precision("float64"):
        single, double = np.asarray(lobe_albedo(_classic_form(model), np.array([[n], [2 * n]]), theta))
        to, of = (float(m.scale(n)) * (cosine if m.cosine_weighted else 1.0) for m in (model, given))
    mixed, pure = np.sum(weights * cosine * to * single), np.sum(weights * to * to * double)
    gram = np.array([[np.sum(weights * cosine**2), mixed], [mixed, pure]])
    return gram, np.array([np.sum(weights * cosine * of * single), np.sum(weights * to * of * double)])


def _constrained(gram: Float[np.ndarray, "2 2"], right: Float[np.ndarray, " 2"], bounded: bool) -> np.ndarray:
    """The x >= 0 (with sum <= 1 if bounded) of least x' gram x / 2 - right' x: a bound that is broken is reached."""
    size = np.sqrt(np.diag(gram))  # of radiance, which a lobe of n = 1e15 has a ten-millionth of
    # At n = 0 a lobe may be the diffuse term: they share it.
    best = np.linalg.lstsq(gram / np.outer(size, size), right / size, rcond=1e-12)[0]
    if best.min() <= 1e-12 * best.max():
        best = np.where(best == best.max(), right / size, 0.0)
    best = best / size
    if bounded and best.sum() > 1:
        along = np.array([-1.0, 1.0])  # from (1, 0) to (0, 1)
        share = np.clip(along @ (right - gram[:, 0]) / max(along @ gram @ along, 1e-12), 0.0, 1.0)
        best = np.array([1 - share, share])
    return best
