"""What a shape is: where a ray hits it, for camera and shadows alike. For one ray; batching is ``jax.vmap`` outside."""

import abc
from typing import ClassVar, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool

from brdf.checks import Checked, Scalar, Vector


class Hit(NamedTuple):
    """Where one ray meets a shape.

    Attributes:
        hit: whether it does, in front of the origin.
        distance: along the ray, in units of its direction's length; infinite where it misses.
        position: the point, (3,), finite also where the ray misses.
        normal: the unit normal there, (3,), finite also where the ray misses.
        shading: the normal of the surface that a flat piece stands for, (3,); None where that is ``normal``.
    """

    hit: Bool[Array, ""]
    distance: Scalar
    position: Vector
    normal: Vector
    shading: Vector | None = None


class Shape(Checked):
    """A surface that a ray can hit.

    Attributes:
        fitted: False for an occluder, which casts shadows and hides what lies behind it, but is not fitted.
        in_components: whether the covers take vectors in `brdf.vectors.Components`.
    """

    fitted: bool = eqx.field(static=True, default=True, kw_only=True)
    in_components: ClassVar[bool] = False

    @property
    def convex(self) -> bool:
        """Whether it cannot cast a shadow on its own lit side."""
        return True

    @abc.abstractmethod
    def extent(self) -> Scalar:
        """A length of the order of the shape: rounding moves its surface by some 1e-7 of this and its position."""

    @abc.abstractmethod
    def intersect(self, origin: Vector, direction: Vector) -> Hit:
        """The nearest hit in front of ``origin``."""

    def cover(self, origin: Vector, direction: Vector, distance: Scalar) -> Scalar:
        """1 where the shape hides a point of light, else 0."""
        hit = self.intersect(origin, direction)
        return jnp.where(hit.hit & (hit.distance < distance), 1.0, 0.0)

    def cover_patch(self, origin: Vector, direction: Vector, distance: Scalar, radius: Array) -> Scalar:
        """The share of a patch of light that the shape hides; of its middle, where the shape cannot tell more."""
        return self.cover(origin, direction, distance)


def share_beyond(sine: Scalar, radius: Scalar) -> Scalar:
    """The share of a patch of light beyond an edge, of a parabola 3/4 (1 - x²) with the variance of a disc."""
    x = jnp.clip(sine / (1.118 * jnp.maximum(radius, 1e-6)), -1.0, 1.0)  # √5/2
    return 0.5 + x * (0.75 - 0.25 * x * x)
