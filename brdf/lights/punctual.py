"""Lights without extent: directional, point and spot."""

from functools import partial
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from brdf.checks import Scalar, Spectrum, Vector, checked, direction_value, number, spectrum, vector
from brdf.errors import InputError
from brdf.geometry.surface_points import SurfacePoints
from brdf.lights.base import Light, LightSample
from brdf.vectors import cosine_lobe, divide, norm, normalize


class DirectionalLight(Light):
    """Parallel light from infinity.

    Args:
        direction: towards the light, (3,), any length but 0.
        intensity: (C,), the radiance that a white Lambertian surface facing the light shows.

    Raises:
        InputError: where a value is not finite, the direction has no length or an intensity is negative.

    Example:
        >>> sun = brdf.DirectionalLight(direction=[0, 3, 4], intensity=[1.0, 0.9, 0.8])
        >>> ball = brdf.Scene.load("scene.toml")
        >>> brdf.Scene(ball.camera, ball.shapes, lights=[sun]).channels
        3
    """

    direction: Vector = checked(direction_value, "direction")
    intensity: Spectrum = checked(spectrum, "intensity")
    type_name = "directional"

    @staticmethod
    def sample(point: SurfacePoints, *row: Any) -> LightSample:
        """The same at every point."""
        (direction,) = row
        return LightSample(normalize(direction), 1.0, jnp.asarray(jnp.inf))


def _attenuation(value: Any) -> Any:
    """(a, b, c), none of which may let the light turn negative."""
    value = vector("attenuation", value)
    if isinstance(value, np.ndarray) and not (np.all(value >= 0) and np.any(value > 0)):
        what = f"must be at least 0, and more somewhere, got {value.tolist()}"
        raise InputError("attenuation", what, "Give three values of 0 or more")
    return value


class PointLight(Light):
    """Light from one point, falling off as OpenGL defines it: 1 / (a + b d + c d²) at distance d.

    Args:
        position: (3,), world units.
        intensity: (C,), at distance 1 with the default attenuation.
        attenuation: (a, b, c), each at least 0 and not all 0. The default (0, 0, 1) is the inverse square law.

    Raises:
        InputError: where a value is not finite, an intensity or an attenuation is negative, or all of the latter are 0.

    Example:
        >>> lamp = brdf.PointLight(position=[0, 0, 2], intensity=4.0)
        >>> lamp.attenuation
        array([0., 0., 1.])

    Source: OpenGL 1.5 specification, section 2.14.1.
    """

    position: Vector = checked(vector, "position")
    intensity: Spectrum = checked(spectrum, "intensity")
    attenuation: Vector = eqx.field(converter=_attenuation, default=(0.0, 0.0, 1.0))
    type_name = "point"

    @staticmethod
    def sample(point: SurfacePoints, *row: Any) -> LightSample:
        """From the light's distance and direction."""
        position, (a, b, c) = row
        offset = position - point.position
        distance = norm(offset)
        falloff = divide(1.0, a + b * distance + c * distance * distance)
        return LightSample(normalize(offset), falloff, distance)


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

    Example:
        >>> spot = brdf.SpotLight(position=[0, 0, 2], direction=[0, 0, -1], intensity=4.0, cutoff_angle=30, exponent=2)
        >>> float(spot.cutoff_angle)
        30.0

    Source: OpenGL 1.5 specification, section 2.14.1; there the exponent ends at 128, here it does not.
    """

    position: Vector = checked(vector, "position")
    direction: Vector = checked(direction_value, "direction")
    intensity: Spectrum = checked(spectrum, "intensity")
    cutoff_angle: Scalar = eqx.field(converter=partial(number, "cutoff_angle", low=0.0, high=180.0), default=180.0)
    exponent: Scalar = eqx.field(converter=partial(number, "exponent", low=0.0), default=0.0)
    attenuation: Vector = eqx.field(converter=_attenuation, default=(0.0, 0.0, 1.0))
    type_name = "spot"

    def __check_init__(self):
        """Refuse what OpenGL does not define."""
        if isinstance(self.cutoff_angle, np.ndarray) and 90 < self.cutoff_angle < 180:
            what = f"must be 0 to 90 degrees, or 180, got {float(self.cutoff_angle):g}"
            raise InputError("cutoff_angle", what, "A spot of more than 90 degrees is a point light")

    @staticmethod
    def sample(point: SurfacePoints, *row: Any) -> LightSample:
        """A point light's, times the spot's factor."""
        position, direction, cutoff_angle, exponent, attenuation = row
        sample = PointLight.sample(point, position, attenuation)
        axis = normalize(direction)
        inside = (cutoff_angle >= 180) | (-(sample.to_light @ axis) >= jnp.cos(jnp.deg2rad(cutoff_angle)))
        aligned = jnp.where(exponent > 0, cosine_lobe(-sample.to_light, axis, exponent), 1.0)
        return sample._replace(intensity=jnp.where(inside, aligned, 0.0) * sample.intensity)
