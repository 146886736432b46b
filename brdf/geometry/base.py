"""What a shape is: where rays hit it, for camera and shadows alike."""

import abc
from typing import ClassVar, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from brdf.checks import Checked, Scalar
from brdf.vectors import Components


class Hit(NamedTuple):
    """Where rays meet a shape.

    Attributes:
        hit: whether they do, in front of the origin.
        distance: along the ray, in units of its direction's length; infinite where it misses.
        position: the point, finite also where the ray misses.
        normal: the unit normal there, finite also where the ray misses.
        shading: the normal of the surface that a flat piece stands for; None where that is ``normal``.
    """

    hit: Bool[Array, "*rays"]
    distance: Float[Array, "*rays"]
    position: Components
    normal: Components
    shading: Components | None = None


class Shape(Checked):
    """A surface that a ray can hit.

    Attributes:
        fitted: False for an occluder, which casts shadows and hides what lies behind it, but is not fitted.
        convex: whether it cannot cast a shadow on its own lit side (class variable).
    """

    fitted: bool = eqx.field(static=True, default=True, kw_only=True)
    convex: ClassVar[bool] = True

    @abc.abstractmethod
    def extent(self) -> Scalar:
        """A length of the order of the shape: rounding moves its surface by some 1e-7 of this and its position."""

    @abc.abstractmethod
    def intersect(self, origin: Components, direction: Components) -> Hit:
        """The nearest hit in front of ``origin``."""

    def cover(self, origin: Components, direction: Components, distance: Array) -> Array:
        """1 where the shape hides a point of light, else 0."""
        hit = self.intersect(origin, direction)
        return jnp.where(hit.hit & (hit.distance < distance), 1.0, 0.0)

    def cover_patch(self, origin: Components, direction: Components, distance: Array, radius: Array) -> Array:
        """The share of a patch of light that the shape hides; of its middle, where the shape cannot tell more."""
        return self.cover(origin, direction, distance)


def share_beyond(sine: Array, radius: Array) -> Array:
    """The share of a patch of light beyond an edge, of a parabola 3/4 (1 - x²) with the variance of a disc."""
    x = jnp.clip(sine / (1.118 * jnp.maximum(radius, 1e-6)), -1.0, 1.0)  # √5/2
    return 0.5 + x * (0.75 - 0.25 * x * x)
