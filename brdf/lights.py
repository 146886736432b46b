"""Lights: each turns into light samples (a direction and an intensity) at a surface point.

Intensity means what the classic shading equation means by it: the radiance that a white Lambertian surface facing the
light would show. A light's emittance has C channels. Each light answers for one point and one of its nodes; batching
over points and the sum over nodes are outside.
"""

import abc
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from brdf.checks import direction_value, spectrum, vector
from brdf.errors import InputError
from brdf.vectors import divide, norm, normalize


class LightSample(NamedTuple):
    """What one node of a light sends to one surface point.

    Attributes:
        to_light: unit direction towards the light, (3,).
        intensity: what arrives, (C,), without the cosine at the surface.
        distance: to the light, in world units; infinite for a light at infinity.
    """

    to_light: Float[Array, "3"]
    intensity: Float[Array, " C"]
    distance: Float[Array, ""]


class Light(eqx.Module):
    """A source of light.

    Attributes:
        type_name: what ``type`` in a scene file says.
        emittance_name: the field that holds the emittance, (C,); the picture is linear in it.
    """

    type_name: ClassVar[str]
    emittance_name: ClassVar[str]

    @abc.abstractmethod
    def nodes(self) -> Any:
        """The quadrature nodes: a pytree of arrays with one leading axis, as long as the light has samples."""

    @abc.abstractmethod
    def illuminate(self, node: Any, position: Float[Array, "3"]) -> LightSample:
        """What one node sends to one point.

        Args:
            node: one row of ``nodes()``.
            position: the surface point, (3,), world units.
        """

    @property
    def emittance(self) -> Float[Array, " C"]:
        """The emittance, (C,)."""
        return getattr(self, self.emittance_name)


class DirectionalLight(Light):
    """Parallel light from infinity.

    Args:
        direction: towards the light, (3,), any length but 0.
        intensity: (C,), the radiance that a white Lambertian surface facing the light shows.

    Raises:
        InputError: where a value is not finite, the direction has no length or an intensity is negative.
    """

    direction: Float[Array, "3"] = eqx.field(converter=direction_value("direction"))
    intensity: Float[Array, " C"] = eqx.field(converter=spectrum("intensity"))
    type_name: ClassVar[str] = "directional"
    emittance_name: ClassVar[str] = "intensity"

    def nodes(self) -> Any:
        """One sample, and nothing to say of it."""
        return jnp.zeros((1, 0))

    def illuminate(self, node: Any, position: Float[Array, "3"]) -> LightSample:
        """The same at every point."""
        return LightSample(normalize(jnp.asarray(self.direction)), jnp.asarray(self.intensity), jnp.asarray(jnp.inf))


class PointLight(Light):
    """Light from one point, falling off as OpenGL defines it: 1 / (a + b d + c d²) at distance d.

    Args:
        position: (3,), world units.
        intensity: (C,), at distance 1 with the default attenuation.
        attenuation: (a, b, c), each at least 0 and not all 0. The default (0, 0, 1) is the inverse square law.

    Raises:
        InputError: where a value is not finite, an intensity or an attenuation is negative, or all of the latter are 0.

    Source: OpenGL 1.5 specification, section 2.14.1.
    """

    position: Float[Array, "3"] = eqx.field(converter=vector("position"))
    intensity: Float[Array, " C"] = eqx.field(converter=spectrum("intensity"))
    attenuation: Float[Array, "3"] = eqx.field(converter=direction_value("attenuation"), default=(0.0, 0.0, 1.0))
    type_name: ClassVar[str] = "point"
    emittance_name: ClassVar[str] = "intensity"

    def __check_init__(self):
        """Refuse a falloff that could turn negative."""
        if isinstance(self.attenuation, np.ndarray) and np.any(self.attenuation < 0):
            came = f"must be at least 0, got {self.attenuation.tolist()}"
            raise InputError("attenuation", came, "Give three values of 0 or more")

    def nodes(self) -> Any:
        """One sample, and nothing to say of it."""
        return jnp.zeros((1, 0))

    def illuminate(self, node: Any, position: Float[Array, "3"]) -> LightSample:
        """From the point's distance and direction."""
        offset = self.position - position
        distance = norm(offset)
        a, b, c = self.attenuation
        falloff = divide(1.0, a + b * distance + c * distance * distance)
        return LightSample(normalize(offset), self.intensity * falloff, distance)


LIGHTS: dict[str, type[Light]] = {light.type_name: light for light in (DirectionalLight, PointLight)}
