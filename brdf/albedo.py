"""Directional albedo: the fraction of light from one direction that a surface reflects, in closed form or nearly so.

For a lobe the albedo is an integral over the hemisphere of directions. Here one of its two dimensions is done by hand,
the other by Gauss-Legendre rules that follow the lobe: their nodes lie where cos^n is not negligible, whatever the
exponent. Everything is differentiable in n and in the angle, because the integrands are.
"""

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from brdf import vectors
from brdf.checks import instance
from brdf.errors import InputError
from brdf.models import BlinnPhong, Material, NormalizedBlinnPhong, NormalizedPhong, Phong, SpecularMaterial
from brdf.precision import Precision, cast, working_precision
from brdf.vectors import Numbers, Scalars

ACCURACY = {"float64": 1e-10, "float32": 1e-5}
"""Bound on the error of the albedo of a normalised lobe (k_s = 1), tested against mpmath and adaptive quadrature."""

WITH_CLOSED_FORM = (Phong, BlinnPhong, NormalizedPhong, NormalizedBlinnPhong)
"""The models whose lobes have a closed form."""

_NODES = 64
_REACH = 9.0  # cos^n x < exp(-n x^2 / 2): beyond 9 / sqrt(n) it is below 3e-18


def directional_albedo(
    material: Material, theta: Numbers, *, precision: Precision | None = None
) -> Float[Array | np.ndarray, "*batch C"]:
    """The fraction of the light arriving at angle theta that the surface reflects; one minus this is absorbed.

    Ambient light is no part of it. The classic forms with k_s > 0 diverge at grazing light: infinite at pi/2.

    Args:
        material: one of the five models.
        theta: angle of incidence in radians, 0 to pi/2, (...).
        precision: "float32" or "float64"; None leaves JAX as it is. What JAX cannot hold comes as a NumPy array.

    Returns:
        (..., C), at least 0, accurate to ``ACCURACY`` times k_s (classic forms: times k_s / (scale(n) cos theta)).

    Raises:
        InputError: where the material is of another model.

    Example:
        >>> brdf.directional_albedo(brdf.NormalizedPhong(k_d=0.0, k_s=1.0, n=1), np.radians([0, 60])).round(3)
        Array([[1.   ], [0.609]], dtype=float32)
    """
    instance("material", material, Material, "Write brdf.directional_albedo(material, theta)")
    if has_other_lobe(type(material)):
        remedy = "Use brdf.check, which integrates any"
        raise InputError("material", f"is of the model {material.name}, whose albedo has no closed form here", remedy)
    with working_precision(precision):
        result = _albedo(cast(material, precision), jnp.asarray(theta, jnp.result_type(float)))
    # a float64 array of JAX would be cut to float32, with a warning, by the first thing done to it outside the context
    kept = isinstance(result, Tracer) or result.dtype == jnp.result_type(float)
    return result if kept else np.asarray(result)


def has_other_lobe(model: type[Material]) -> bool:
    """Whether the lobe is none of the four that have a closed form; other programs, and pages, draw Blinn-Phong's."""
    return issubclass(model, SpecularMaterial) and model not in WITH_CLOSED_FORM


@jax.jit
def _albedo(material: Material, theta: Array) -> Array:
    diffuse = jnp.broadcast_to(material.k_d, (*theta.shape, material.k_d.shape[-1]))
    if not isinstance(material, SpecularMaterial):
        return diffuse
    lobe = lobe_albedo(type(material), material.n, theta)[..., None]
    if not material.cosine_weighted:
        cosine = jnp.cos(theta)[..., None]
        above = cosine > jnp.finfo(theta.dtype).eps  # what rounding leaves of cos(pi / 2) is zero
        lobe = jnp.where(above, lobe / jnp.where(above, cosine, 1.0), jnp.inf)
        lobe = jnp.where(material.k_s > 0, lobe, 0.0)
    return diffuse + material.k_s * lobe


@functools.partial(jax.jit, static_argnums=0)
def lobe_albedo(model: type[SpecularMaterial], n: Numbers, theta: Numbers) -> Scalars:
    """Albedo of the specular part for k_s = 1 and n >= 0, (...), at angles of incidence in radians, 0 to pi/2, (...).

    The integral over all V of S (N.V) / pi (classic forms, not divided by N.L) or of S (N.V) / (pi N.L) (normalised).
    """
    normalised = normalized_form(model)
    formula = _phong_albedo if normalised is NormalizedPhong else _blinn_phong_albedo
    albedo = formula(*jnp.broadcast_arrays(n, theta))
    return albedo if model.cosine_weighted else albedo / normalised.scale(n)


def normalized_form(model: type[SpecularMaterial]) -> type[SpecularMaterial]:
    """The normalised model of the same lobe; of any other Blinn-Phong's."""
    return NormalizedPhong if issubclass(model, Phong | NormalizedPhong) else NormalizedBlinnPhong


def _phong_albedo(n: Array, theta: Array) -> Array:
    """Albedo of the normalised Phong lobe.

    With c = cos theta, s = sin theta, W = B((n+1)/2, 1/2), which is the integral of sin^n over (0, pi), and J_m, the
    integral of cos^m over (0, asin c), the closed form with the incomplete beta function (its parameters swapped) is

        A = c/2 + W / (2 pi) [(n+1) c J_(n+1) + s^(n+2)].

    J and W are taken at exponents raised by 2 and 4, where their integrands are smooth for every n >= 0.
    """
    cosine, sine = jnp.maximum(jnp.cos(theta), 0.0), jnp.sin(theta)
    power = jnp.exp((n + 2) * vectors.log_cosine_of(sine, cosine))  # s^(n+2)
    inner = ((n + 3) * _cosine_power(n + 3, 0.5 * math.pi - theta) - power * cosine) / (n + 2)
    quarter_circle = _cosine_power(n + 4, jnp.full_like(theta, 0.5 * math.pi))
    half_circle = 2 * quarter_circle * (n + 2) * (n + 4) / ((n + 1) * (n + 3))
    return 0.5 * cosine + half_circle / (2 * math.pi) * ((n + 1) * cosine * inner + power)


def _cosine_power(m: Array, upper: Array) -> Array:
    """Integral of cos^m over (0, upper), m >= 3."""
    nodes, weights = (jnp.asarray(x, upper.dtype) for x in gauss_legendre(_NODES))
    end = jnp.minimum(upper, _REACH / vectors.square_root(m))[..., None]
    x = end * nodes
    return jnp.sum(weights * end * jnp.exp(m[..., None] * vectors.log_cosine_of(jnp.cos(x), jnp.sin(x))), axis=-1)


def _blinn_phong_albedo(n: Array, theta: Array) -> Array:
    """Albedo of the normalised Blinn-Phong lobe.

    Integrated over half vectors H in polar coordinates (alpha, phi) about the normal, with dV = 4 (L.H) dH. At given
    alpha the view lies above the horizon for |phi| < Phi, and the integral over phi is elementary. Phi is pi for
    alpha < 45 deg - theta/2 and 0 for alpha > 45 deg + theta/2, and behaves like a square root at both ends of what
    lies between, which a sin^2 substitution takes away.
    """
    theta = theta[..., None]
    nodes, weights = (jnp.asarray(x, theta.dtype) for x in gauss_legendre(_NODES))
    reach = _REACH / vectors.square_root(n + 1)[..., None]
    first = 0.5 * (0.5 * math.pi - theta)  # up to here all phi see the view above the horizon
    cos_theta, sin_theta = jnp.maximum(jnp.cos(theta), 0.0), jnp.sin(theta)

    def ring(alpha: Array, phi: Array) -> Array:
        """cos^n times the integral over phi of 4 (L.H) (N.V), times sin alpha."""
        cos_alpha, sin_alpha = jnp.cos(alpha), jnp.sin(alpha)
        across = sin_theta * sin_alpha
        value = cos_alpha * across * across * (phi + 0.5 * jnp.sin(2 * phi))
        value += cos_theta * across * jnp.sin(phi) * (4 * cos_alpha * cos_alpha - 1)
        value += cos_theta * cos_theta * cos_alpha * jnp.cos(2 * alpha) * phi
        return 8 * value * sin_alpha * jnp.exp(n[..., None] * vectors.log_cosine_of(cos_alpha, sin_alpha))

    width = jnp.minimum(first, reach)
    full = width * ring(width * nodes, jnp.full_like(nodes, math.pi))

    width = jnp.maximum(jnp.minimum(theta, reach - first), 0.0)
    beyond = width * jnp.sin(0.5 * math.pi * nodes) ** 2  # alpha - first
    cos_phi = -cos_theta * jnp.cos(2 * (first + beyond))  # times sin theta sin 2 alpha
    sin_phi = vectors.square_root(jnp.sin(2 * beyond) * jnp.sin(2 * (theta - beyond)))
    seen = sin_phi > 0
    phi = jnp.where(seen, jnp.arctan2(sin_phi, jnp.where(seen, cos_phi, 1.0)), 0.0)
    partial = width * 0.5 * math.pi * jnp.sin(math.pi * nodes) * ring(first + beyond, phi)
    return NormalizedBlinnPhong.scale(n) / math.pi * jnp.sum(weights * (full + partial), axis=-1)


@functools.cache
def gauss_legendre(count: int) -> tuple[Float[np.ndarray, " count"], Float[np.ndarray, " count"]]:
    """Nodes and weights of the rule on (0, 1)."""
    nodes, weights = np.polynomial.legendre.leggauss(count)
    return 0.5 * (nodes + 1), 0.5 * weights
