"""Lights: each turns into light samples (a direction and an intensity) at a surface point.

Intensity means what the classic shading equation means by it: the radiance that a white Lambertian surface facing the
light would show. Irradiance is π times that, and a sample of radiance L over the solid angle dω has the intensity
L dω / π. A light's emittance has C channels and the picture is linear in it. Each light answers for one point and one
of its nodes; batching over points and the sum over nodes are outside.

Here are the lights without extent; `brdf.lights.area` has rectangle, polygon and sphere, `brdf.lights.environment` what
surrounds the scene.
"""

import abc
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from brdf.checks import direction_value, number, spectrum, vector
from brdf.errors import InputError
from brdf.vectors import cosine_lobe, divide, dot, norm, normalize


class Moments(NamedTuple):
    """How the light of a sample that stands for a patch of the sky spreads around its direction.

    Attributes:
        mean: of the directions, weighted by radiance, (3,); shorter than 1.
        covariance: of the directions, (3, 3).
    """

    mean: Float[Array, "3"]
    covariance: Float[Array, "3 3"]


class Place(NamedTuple):
    """Where light falls, and whence that is seen.

    Attributes:
        position: of the surface point, (3,), world units.
        normal: unit, (3,).
        to_view: unit direction towards the eye, (3,).
    """

    position: Float[Array, "3"]
    normal: Float[Array, "3"]
    to_view: Float[Array, "3"]


class LightSample(NamedTuple):
    """What one node of a light sends to one surface point.

    Attributes:
        to_light: unit direction towards the light, (3,).
        intensity: what arrives, (C,), without the cosine at the surface.
        distance: to the light, in world units; infinite for a light at infinity.
        radius: angular radius, in radians, of a disc as large as the patch that the sample stands for: shadow edges
            sweep over it. None for light without extent, whose shadows are hard.
        moments: where the sample stands for a patch of the sky, how that spreads; None for a single direction.
        lobe_only: 1 where the sample counts for the specular term alone, 0 where for the diffuse alone; None for both.
    """

    to_light: Float[Array, "3"]
    intensity: Float[Array, " C"]
    distance: Float[Array, ""]
    radius: Float[Array, ""] | None = None
    moments: Moments | None = None
    lobe_only: Float[Array, ""] | None = None


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
    def illuminate(self, node: Any, at: Place) -> LightSample:
        """What one node sends to one point.

        Args:
            node: one row of ``nodes()``.
            at: where: lights with an extent put their samples above its horizon.
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

    def illuminate(self, node: Any, at: Place) -> LightSample:
        """The same at every point."""
        return LightSample(normalize(jnp.asarray(self.direction)), jnp.asarray(self.intensity), jnp.asarray(jnp.inf))


def attenuated(
    position: Float[Array, "3"], intensity: Float[Array, " C"], attenuation: Float[Array, "3"], at: Float[Array, "3"]
) -> LightSample:
    """The light of one point, falling off as 1 / (a + b d + c d²) at distance d.

    Args:
        position: of the light, (3,).
        intensity: (C,).
        attenuation: (a, b, c).
        at: the surface point, (3,).

    Source: OpenGL 1.5 specification, section 2.14.1.
    """
    offset = position - at
    distance = norm(offset)
    a, b, c = attenuation
    falloff = divide(1.0, a + b * distance + c * distance * distance)
    return LightSample(normalize(offset), intensity * falloff, distance)


def _check_attenuation(attenuation: Any) -> None:
    """Refuse a falloff that could turn negative."""
    if isinstance(attenuation, np.ndarray) and np.any(attenuation < 0):
        came = f"must be at least 0, got {attenuation.tolist()}"
        raise InputError("attenuation", came, "Give three values of 0 or more")


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
        _check_attenuation(self.attenuation)

    def nodes(self) -> Any:
        """One sample, and nothing to say of it."""
        return jnp.zeros((1, 0))

    def illuminate(self, node: Any, at: Place) -> LightSample:
        """From the point's distance and direction."""
        return attenuated(self.position, self.intensity, self.attenuation, at.position)


class SpotLight(Light):
    """A point light that shines into a cone: attenuation times cos^exponent of the angle to the axis.

    Outside the cutoff there is no light at all. That edge has no derivative: the gradient by ``cutoff_angle`` is 0, and
    those by position and direction leave out what the moving edge adds.

    Args:
        position: (3,), world units.
        direction: the way it shines, (3,), any length but 0.
        intensity: (C,), on the axis at distance 1 with the default attenuation.
        cutoff_angle: between axis and edge, in degrees, 0 to 90, or 180 for no cutoff.
        exponent: at least 0; 0 is the same brightness over the whole cone.
        attenuation: (a, b, c), as for `PointLight`.

    Raises:
        InputError: where a value is not finite or out of its range.

    Source: OpenGL 1.5 specification, section 2.14.1; there the exponent ends at 128, here it does not.
    """

    position: Float[Array, "3"] = eqx.field(converter=vector("position"))
    direction: Float[Array, "3"] = eqx.field(converter=direction_value("direction"))
    intensity: Float[Array, " C"] = eqx.field(converter=spectrum("intensity"))
    cutoff_angle: Float[Array, ""] = eqx.field(converter=number("cutoff_angle", 0.0, 180.0), default=180.0)
    exponent: Float[Array, ""] = eqx.field(converter=number("exponent", 0.0), default=0.0)
    attenuation: Float[Array, "3"] = eqx.field(converter=direction_value("attenuation"), default=(0.0, 0.0, 1.0))
    type_name: ClassVar[str] = "spot"
    emittance_name: ClassVar[str] = "intensity"

    def __check_init__(self):
        """Refuse what OpenGL does not define."""
        _check_attenuation(self.attenuation)
        if isinstance(self.cutoff_angle, np.ndarray) and 90 < self.cutoff_angle < 180:
            came = f"must be 0 to 90 degrees, or 180, got {float(self.cutoff_angle):g}"
            raise InputError("cutoff_angle", came, "A spot of more than 90 degrees is a point light")

    def nodes(self) -> Any:
        """One sample, and nothing to say of it."""
        return jnp.zeros((1, 0))

    def illuminate(self, node: Any, at: Place) -> LightSample:
        """A point light's, times the spot's factor."""
        sample = attenuated(self.position, self.intensity, self.attenuation, at.position)
        axis = normalize(jnp.asarray(self.direction))
        everywhere = jnp.asarray(self.cutoff_angle) >= 180
        inside = everywhere | (-dot(sample.to_light, axis) >= jnp.cos(jnp.deg2rad(self.cutoff_angle)))
        aligned = jnp.where(jnp.asarray(self.exponent) > 0, cosine_lobe(-sample.to_light, axis, self.exponent), 1.0)
        return sample._replace(intensity=jnp.where(inside, aligned, 0.0) * sample.intensity)
