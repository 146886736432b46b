"""What a material is, and what the models with a lobe share.

The radiance of a point is ``k_a I_a + sum_i I_i [k_d (N.L_i)+ + k_s S(L_i, V)]``; the models differ in the specular
term

    S = scale(n) * (N.L)+^w * cos^n     where N.L > 0 and N.V > 0, else 0,

with w = 0 (classic) or 1 (normalised) and cos = R.V (Phong) or N.H (Blinn-Phong). What remains when cosine and light
are divided out is the BRDF, f_r = [k_d + k_s S / (N.L)] / pi in 1/sr; the ambient term stands in for indirect light
and is no part of it.

A material is a frozen dataclass and a JAX pytree whose leaves are its numbers: differentiate, vmap and optimise it as
it is. Numbers given as plain values are checked once, here, and kept in float64; a formula runs in the precision JAX
has at the call.
"""

import math
from abc import abstractmethod
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from brdf import formatters, vectors
from brdf.checks import Checked, Parameter, coefficients, exponent, instance
from brdf.errors import InputError
from brdf.vectors import Directions, Numbers, Scalars


class Material(Checked):
    """What the five models share: ambient and diffuse coefficients, and how to ask for the reflection.

    Attributes:
        k_a: ambient coefficient, (C,), at least 0.
        k_d: diffuse coefficient, (C,), at least 0: the diffuse albedo.

    Example:
        >>> material = brdf.preset("gold")
        >>> isinstance(material, brdf.Material), float(material.n)
        (True, 51.2)
    """

    k_a: Float[Parameter, " C"] = eqx.field(default=0.0, kw_only=True)
    k_d: Float[Parameter, " C"] = eqx.field(kw_only=True)
    name: ClassVar[str]

    def __post_init__(self):
        """Check the numbers and give the coefficients one number of channels."""
        given = {name: value for name, value in vars(self).items() if name != "n"}
        for name, value in zip(given, coefficients(**given), strict=True):
            setattr(self, name, value)

    def specular(self, normal: Directions, to_light: Directions, to_view: Directions) -> Scalars:
        """The specular term S of the shading equation, without k_s; 0 everywhere for a model that has none.

        Args:
            normal: unit vectors, (..., 3).
            to_light: unit vectors, (..., 3).
            to_view: unit vectors, (..., 3).

        Returns:
            (...), at least 0; 0 where N.L <= 0 or N.V <= 0.
        """
        return jnp.zeros_like(vectors.dot(normal, to_light) + vectors.dot(normal, to_view))

    def reflectance(self, to_light: Directions, to_view: Directions) -> Float[Array, "*batch C"]:
        """The BRDF f_r in 1/sr, in the local frame whose +z axis is the normal.

        Args:
            to_light: unit vectors, (..., 3).
            to_view: unit vectors, (..., 3).

        Returns:
            (..., C), at least 0; 0 where either direction is not above the horizon.
        """
        return _reflectance(self, jnp.asarray(to_light), jnp.asarray(to_view))

    def _albedo(self, to_light: Array, to_view: Array) -> Any:
        """Pi times the BRDF above the horizon."""
        return self.k_d

    def _repr_html_(self) -> str | None:
        """For Jupyter: a lit sphere and the numbers; nothing while JAX traces them."""
        traced = any(isinstance(value, Tracer) for value in vars(self).values())
        return None if traced else formatters.html["material"](self)


@jax.jit
def _reflectance(material: Material, to_light: Array, to_view: Array) -> Array:
    above = (to_light[..., 2] > 0) & (to_view[..., 2] > 0)
    return jnp.where(above[..., None], material._albedo(to_light, to_view), 0.0) / math.pi


class SpecularMaterial(Material):
    """What the four models with a lobe share. The lobe is ``scale(n) (N.L)+^w exp(n log_cosine)``; see the module.

    Attributes:
        k_s: specular coefficient, (C,), at least 0.
        n: exponent, a scalar, at least 0.
        cosine_weighted: whether the lobe is multiplied by N.L (class variable).
    """

    k_s: Float[Parameter, " C"] = eqx.field(kw_only=True)
    n: Float[Parameter, ""] = eqx.field(converter=exponent, kw_only=True)
    cosine_weighted: ClassVar[bool] = False

    @staticmethod
    @abstractmethod
    def log_cosine(normal: Directions, to_light: Directions, to_view: Directions) -> Scalars:
        """Logarithm of the cosine that is raised to n; ``vectors.BELOW_HORIZON`` where it is not positive."""

    @staticmethod
    def scale(n: Numbers) -> Scalars | Float[np.ndarray, "*batch"]:
        """The constant in front of the lobe, n at least 0: 1 in the classic forms, no less in the normalised ones."""
        return jnp.ones_like(n) if isinstance(n, jax.Array) else np.ones_like(n, float)

    def specular(self, normal: Directions, to_light: Directions, to_view: Directions) -> Scalars:
        """The specular term S; see `Material.specular`."""
        lobe = self._lobe(normal, to_light, to_view)
        return lobe * vectors.dot(normal, to_light) if self.cosine_weighted else lobe

    def _albedo(self, to_light: Array, to_view: Array) -> Any:
        lobe = self._lobe(jnp.array([0.0, 0.0, 1.0], to_light.dtype), to_light, to_view)
        if not self.cosine_weighted:
            # eps^2 is zero for a direction, whose horizon is known to eps; below, derivatives would overflow
            cosine = to_light[..., 2]
            lobe = vectors.divide(lobe, jnp.where(cosine > jnp.finfo(cosine.dtype).eps ** 2, cosine, 0.0))
        return self.k_d + self.k_s * lobe[..., None]

    def _lobe(self, normal: Directions, to_light: Directions, to_view: Directions) -> Array:
        """scale(n) cos^n, gated: light does not come through the surface."""
        above = (vectors.dot(normal, to_light) > 0) & (vectors.dot(normal, to_view) > 0)
        lobe = vectors.lobe(self.log_cosine(normal, to_light, to_view), self.n)
        return jnp.where(above, self.scale(self.n) * lobe, 0.0)


def check_single(
    material: Any, usage: str, remedy: str = "Give one: jax.tree.map(lambda leaf: leaf[0], materials)"
) -> None:
    """Refuse what is no material, saying what to write, and several in one, saying what to do with them."""
    instance("material", material, Material, usage)
    if jnp.ndim(material.k_d) != 1:
        raise InputError("material", f"is a stack of {jnp.shape(material.k_d)[0]} materials", remedy)


def check_model(model: Any) -> None:
    """Refuse what is not the class of a material."""
    if not (isinstance(model, type) and issubclass(model, Material)):
        what = model if isinstance(model, str) else type(model).__name__
        raise InputError("model", f"must be the class of a material, got {what}", "Write for example brdf.BlinnPhong")
