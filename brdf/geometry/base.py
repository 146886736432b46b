"""Shapes, and where a ray hits them: the camera and the shadows share it.

Each shape answers for one ray; batching is ``jax.vmap`` outside.
"""

import abc
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float


class Hit(NamedTuple):
    """Where one ray meets a shape.

    Attributes:
        hit: whether it does, in front of the origin.
        distance: along the ray, in units of its direction's length; infinite where it misses.
        position: the point, (3,), finite also where the ray misses.
        normal: the unit normal there, (3,), finite also where the ray misses.
    """

    hit: Bool[Array, ""]
    distance: Float[Array, ""]
    position: Float[Array, "3"]
    normal: Float[Array, "3"]


class Shape(eqx.Module):
    """A surface that a ray can hit.

    Attributes:
        fitted: False for an occluder, which casts shadows and hides what lies behind it, but is not fitted.
    """

    fitted: bool = eqx.field(static=True, default=True, kw_only=True)

    @property
    def convex(self) -> bool:
        """Whether it cannot cast a shadow on its own lit side."""
        return True

    @abc.abstractmethod
    def extent(self) -> Float[Array, ""]:
        """A length of the order of the shape: rounding moves its surface by some 1e-7 of this and its position."""

    @abc.abstractmethod
    def intersect(self, origin: Float[Array, "3"], direction: Float[Array, "3"]) -> Hit:
        """The nearest hit in front of ``origin``.

        Args:
            origin: where the ray starts, (3,).
            direction: its unit direction, (3,).
        """

    def cover(
        self, origin: Float[Array, "3"], direction: Float[Array, "3"], distance: Float[Array, ""], radius: Array | None
    ) -> Float[Array, ""]:
        """The share of a patch of light that the shape hides, 0 or 1 where it cannot tell more.

        Args:
            origin: the point that the light falls on, (3,).
            direction: towards the middle of the patch, unit, (3,).
            distance: of the patch.
            radius: angular radius of the patch; None for a point.
        """
        hit = self.intersect(origin, direction)
        return jnp.where(hit.hit & (hit.distance < distance), 1.0, 0.0)


def share_beyond(sine: Float[Array, ""], radius: Float[Array, ""]) -> Float[Array, ""]:
    """The share of a patch of light beyond an edge, of a parabola 3/4 (1 - x²) with the variance of a disc.

    Args:
        sine: of the angle by which the patch's middle is beyond the edge.
        radius: angular radius of the patch; below a millionth of a radian it counts as that.
    """
    x = jnp.clip(sine / (1.118 * jnp.maximum(radius, 1e-6)), -1.0, 1.0)  # √5/2
    return 0.5 + x * (0.75 - 0.25 * x * x)
