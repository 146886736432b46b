"""The parallelogram."""

import functools

import jax.numpy as jnp
from jaxtyping import Array

from brdf.checks import Scalar, Vector, checked, edge_value, spans_area, vector
from brdf.geometry.base import Hit, Shape, share_beyond
from brdf.vectors import Components, divide, largest, normalize


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

    def intersect(self, origin: Components, direction: Components) -> Hit:
        """The hit, from either side; the normal always is that of the front side."""
        center, edge_u, edge_v = map(Components.of, (self.center, self.edge_u, self.edge_v))
        area_vector = edge_u.cross(edge_v)
        normal = normalize(area_vector)
        slope = direction @ normal
        distance = divide((center - origin) @ normal * slope, slope * slope)
        position = origin + direction * distance
        offset = position - center
        squared_area = area_vector @ area_vector
        u = offset.cross(edge_v) @ area_vector / squared_area
        v = edge_u.cross(offset) @ area_vector / squared_area
        hit = (slope != 0) & (distance > 0) & (jnp.abs(u) <= 1) & (jnp.abs(v) <= 1)
        return Hit(hit, jnp.where(hit, distance, jnp.inf), position, normal)

    def cover_patch(self, origin: Components, direction: Components, distance: Array, radius: Array) -> Array:
        """The share of the patch within the pyramid over the rectangle; see `Shape.cover_patch`."""
        center, *edges = map(Components.of, (self.center, self.edge_u, self.edge_v))
        to_center = center - origin
        normal = normalize(edges[0].cross(edges[1]))
        height = to_center @ normal
        side = jnp.where(height < 0, -1.0, 1.0)
        share = 1.0
        for edge, across in (edges, edges[::-1]):
            # between the two edges along `edge`: beyond the plane through the origin and each
            rims, between = (to_center + across, to_center - across), -1.0
            for rim, inner in (rims, rims[::-1]):
                plane = normalize(edge.cross(rim))
                between += share_beyond(jnp.sign(plane @ inner) * (plane @ direction), radius)
            share *= jnp.maximum(between, 0.0)
        before = height * side < distance * (direction @ normal) * side
        return jnp.where(before, share, 0.0)
