"""The parallelogram."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from brdf.checks import direction_value, vector
from brdf.errors import InputError
from brdf.geometry.base import Hit, Shape, share_beyond
from brdf.vectors import divide, dot, normalize


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
