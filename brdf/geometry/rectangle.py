"""The parallelogram."""

import functools
from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array

from brdf.checks import Scalar, Vector, checked, edge_value, spans_area, vector
from brdf.geometry.base import Hit, Shape, share_beyond
from brdf.vectors import cross, divide, dot, largest, normalize


class Rectangle(Shape):
    """A parallelogram, ``center ± edge_u ± edge_v``, whose front side looks along ``edge_u`` × ``edge_v``.

    Args:
        center: (3,), world units.
        edge_u: half of one edge, (3,), world units.
        edge_v: half of the other edge, (3,), not parallel to ``edge_u``.
        fitted: see `Shape`.

    Raises:
        InputError: where a value is not finite or the edges are parallel.

    Example:
        >>> floor = brdf.Rectangle(center=[0, -1, 0], edge_u=[0, 0, 2], edge_v=[2, 0, 0])  # looks up, along y
    """

    in_components: ClassVar[bool] = True
    center: Vector = checked(vector, "center")
    edge_u: Vector = checked(edge_value, "edge_u")
    edge_v: Vector = checked(edge_value, "edge_v")

    def __check_init__(self):
        """Refuse edges that span no area."""
        spans_area(self.edge_u, self.edge_v)

    def extent(self) -> Scalar:
        """The larger half-edge's largest component."""
        sizes = [largest(edge) for edge in (self.edge_u, -self.edge_u, self.edge_v, -self.edge_v)]
        return functools.reduce(jnp.maximum, sizes)

    def intersect(self, origin: Vector, direction: Vector) -> Hit:
        """The hit, from either side; the normal always is that of the front side."""
        area_vector = cross(self.edge_u, self.edge_v)
        normal = normalize(area_vector)
        slope = dot(direction, normal)
        distance = divide(dot(self.center - origin, normal) * slope, slope * slope)
        position = origin + distance * direction
        offset = position - self.center
        squared_area = dot(area_vector, area_vector)
        u = dot(cross(offset, self.edge_v), area_vector) / squared_area
        v = dot(cross(self.edge_u, offset), area_vector) / squared_area
        hit = (slope != 0) & (distance > 0) & (jnp.abs(u) <= 1) & (jnp.abs(v) <= 1)
        return Hit(hit, jnp.where(hit, distance, jnp.inf), position, normal)

    def cover_patch(self, origin: Vector, direction: Vector, distance: Scalar, radius: Array) -> Scalar:
        """The share of the patch within the pyramid over the rectangle; see `Shape.cover_patch`."""
        to_center = self.center - origin
        normal = normalize(cross(self.edge_u, self.edge_v))
        height = dot(to_center, normal)
        side = jnp.where(height < 0, -1.0, 1.0)
        share = 1.0
        for edge, across in ((self.edge_u, self.edge_v), (self.edge_v, self.edge_u)):
            # between the two edges along `edge`: beyond the plane through the origin and each
            rims, between = (to_center + across, to_center - across), -1.0
            for rim, inner in (rims, rims[::-1]):
                plane = normalize(cross(edge, rim))
                between += share_beyond(jnp.sign(dot(plane, inner)) * dot(plane, direction), radius)
            share *= jnp.maximum(between, 0.0)
        before = height * side < distance * dot(direction, normal) * side
        return jnp.where(before, share, 0.0)
