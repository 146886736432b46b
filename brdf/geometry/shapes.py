"""Shapes, and where a ray hits them: the camera and the shadows share it.

Each shape answers for one ray; batching is ``jax.vmap`` outside.
"""

import abc
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from brdf.checks import direction_value, positive, vector
from brdf.errors import InputError
from brdf.vectors import divide, dot, norm, normalize, square_root


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


class Sphere(Shape):
    """A sphere with outward normals.

    Args:
        center: (3,), world units.
        radius: greater than 0, world units.
        fitted: see `Shape`.

    Raises:
        InputError: where a value is not finite or the radius is not positive.
    """

    center: Float[Array, "3"] = eqx.field(converter=vector("center"))
    radius: Float[Array, ""] = eqx.field(converter=positive("radius"))

    def extent(self) -> Float[Array, ""]:
        """The radius."""
        return jnp.asarray(self.radius)

    def intersect(self, origin: Float[Array, "3"], direction: Float[Array, "3"]) -> Hit:
        """The nearest hit in front of ``origin``.

        The half chord comes from the distance of the ray to the centre, not from the quadratic's discriminant, which
        cancels for a small far sphere (Haines, Günther and Akenine-Möller, Ray Tracing Gems 2019, chapter 7).
        """
        to_origin = jnp.asarray(origin - self.center)
        along = dot(to_origin, direction)
        nearest = to_origin - along * direction
        squared_half_chord = self.radius * self.radius - dot(nearest, nearest)
        crosses = squared_half_chord > 0
        half_chord = square_root(squared_half_chord)
        outside = -along - half_chord > 0
        signed = jnp.where(outside, -half_chord, half_chord)
        hit = crosses & (signed - along > 0)
        normal = normalize(nearest + signed * direction)
        return Hit(hit, jnp.where(hit, signed - along, jnp.inf), self.center + self.radius * normal, normal)

    def cover(
        self, origin: Float[Array, "3"], direction: Float[Array, "3"], distance: Float[Array, ""], radius: Array | None
    ) -> Float[Array, ""]:
        """The share of the patch within the cone that the sphere fills; see `Shape.cover`."""
        if radius is None:
            return super().cover(origin, direction, distance, radius)
        to_center = jnp.asarray(self.center - origin)
        along = dot(to_center, direction)
        miss = norm(to_center - along * direction)
        # of the angle between the direction and the sphere's rim
        tangent = square_root(dot(to_center, to_center) - self.radius * self.radius)
        sine = divide(self.radius * along - miss * tangent, dot(to_center, to_center))
        in_front = (along > 0) & (along < distance)
        return jnp.where(in_front, share_beyond(sine, radius), 0.0)


class Rectangle(Shape):
    """A parallelogram, ``center ± edge_u ± edge_v``, whose front side looks along ``edge_u`` × ``edge_v``.

    Args:
        center: (3,), world units.
        edge_u: half of one edge, (3,), world units.
        edge_v: half of the other edge, (3,), not parallel to ``edge_u``.
        fitted: see `Shape`.

    Raises:
        InputError: where a value is not finite or the edges are parallel.
    """

    center: Float[Array, "3"] = eqx.field(converter=vector("center"))
    edge_u: Float[Array, "3"] = eqx.field(converter=direction_value("edge_u"))
    edge_v: Float[Array, "3"] = eqx.field(converter=direction_value("edge_v"))

    def __check_init__(self):
        """Refuse edges that span no area."""
        check_spans_area(self.edge_u, self.edge_v)

    def extent(self) -> Float[Array, ""]:
        """The larger half-edge's largest component."""
        return jnp.maximum(jnp.max(jnp.abs(self.edge_u)), jnp.max(jnp.abs(self.edge_v)))

    def intersect(self, origin: Float[Array, "3"], direction: Float[Array, "3"]) -> Hit:
        """The hit, from either side; the normal always is that of the front side."""
        area_vector = jnp.cross(self.edge_u, self.edge_v)
        normal = normalize(area_vector)
        slope = dot(direction, normal)
        distance = divide(dot(self.center - origin, normal) * slope, slope * slope)
        position = origin + distance * direction
        offset = position - self.center
        squared_area = dot(area_vector, area_vector)
        u = dot(jnp.cross(offset, self.edge_v), area_vector) / squared_area
        v = dot(jnp.cross(self.edge_u, offset), area_vector) / squared_area
        hit = (slope != 0) & (distance > 0) & (jnp.abs(u) <= 1) & (jnp.abs(v) <= 1)
        return Hit(hit, jnp.where(hit, distance, jnp.inf), position, normal)

    def cover(
        self, origin: Float[Array, "3"], direction: Float[Array, "3"], distance: Float[Array, ""], radius: Array | None
    ) -> Float[Array, ""]:
        """The share of the patch within the pyramid over the rectangle; see `Shape.cover`."""
        if radius is None:
            return super().cover(origin, direction, distance, radius)
        to_center = jnp.asarray(self.center - origin)
        normal = normalize(jnp.cross(self.edge_u, self.edge_v))
        height = dot(to_center, normal)
        side = jnp.where(height < 0, -1.0, 1.0)

        def beyond(edge: Array, rim: Array, inner: Array) -> Array:
            """Beyond the plane through the origin and an edge, to the side on which the rectangle lies."""
            plane = normalize(jnp.cross(edge, rim))
            return share_beyond(jnp.sign(dot(plane, inner)) * dot(plane, direction), radius)

        def between(edge: Array, across: Array) -> Array:
            """Between the two edges along ``edge``."""
            one, other = to_center + across, to_center - across
            return jnp.maximum(beyond(edge, one, other) + beyond(edge, other, one) - 1.0, 0.0)

        edge_u, edge_v = jnp.asarray(self.edge_u), jnp.asarray(self.edge_v)
        before = height * side < distance * dot(direction, normal) * side
        return jnp.where(before, between(edge_u, edge_v) * between(edge_v, edge_u), 0.0)


def check_spans_area(edge_u: object, edge_v: object) -> None:
    """Refuse two edges that are parallel; values under a JAX transformation pass.

    Args:
        edge_u: one edge, (3,).
        edge_v: the other edge, (3,).

    Raises:
        InputError: where they are parallel.
    """
    if not (isinstance(edge_u, np.ndarray) and isinstance(edge_v, np.ndarray)):
        return
    area = float(np.linalg.norm(np.cross(edge_u, edge_v)))
    if area <= 1e-12 * float(np.linalg.norm(edge_u) * np.linalg.norm(edge_v)):
        came = f"got {edge_u.tolist()} and {edge_v.tolist()}"
        raise InputError("edge_v", f"must not be parallel to edge_u, {came}", "Give two edges that span an area")
