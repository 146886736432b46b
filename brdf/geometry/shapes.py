"""What a shape is: where rays hit it, for camera and shadows alike; the sphere, and the parallelogram."""

import abc
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from brdf.checks import Checked, Scalar, Vector, checked, edge_value, positive, vector
from brdf.errors import InputError
from brdf.vectors import Components, divide, norm, normalize, square_root


class Hit(NamedTuple):
    """Where rays meet a shape.

    Attributes:
        hit: whether they do, in front of the origin.
        distance: along the ray, in units of its direction's length; any number where it misses.
        position: the point, finite also where the ray misses.
        normal: the unit normal there, finite also where the ray misses.
        shading: the normal of the surface that a flat piece stands for; None where that is ``normal``.
    """

    hit: Array
    distance: Array
    position: Components
    normal: Components
    shading: Components | None = None


class Shape(Checked):
    """A surface that a ray can hit.

    Attributes:
        fitted: False for an occluder, which casts shadows and hides what lies behind it, but is not fitted.
        convex: whether it cannot cast a shadow on its own lit side (class variable).
        rounding: of where rays meet it, as a share of its extent, where the program rounds less (class variable).
    """

    fitted: bool = eqx.field(static=True, default=True, kw_only=True)
    convex: ClassVar[bool] = True
    rounding: ClassVar[float] = 0.0

    @abc.abstractmethod
    def extent(self) -> Array:
        """A length of the order of the shape: rounding moves its surface by some 1e-7 of this and its position."""

    @abc.abstractmethod
    def intersect(self, origin: Components, direction: Components) -> Hit:
        """The nearest hit in front of ``origin``."""

    def cover(self, origin: Components, direction: Components, distance: Any, radius: Any) -> Array:
        """The share of a patch of light that the shape hides, of a mesh that of its middle.

        The light stands in a direction from the origin, at a distance; the patch's radius is an angle.
        """
        hit = self.intersect(origin, direction)
        return jnp.where(hit.hit & (hit.distance < distance), 1.0, 0.0)


def share_beyond(sine: Array, radius: Array) -> Array:
    """The share of a patch of light beyond an edge, of a parabola 3/4 (1 - x²) with the variance of a disc."""
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

    Example:
        >>> ball = brdf.Sphere(center=[0, 0, 0], radius=1)
        >>> pillar = brdf.Sphere(center=[1, 1, 1], radius=0.2, fitted=False)  # only casts a shadow
    """

    center: Vector = checked(vector, "center")
    radius: Scalar = checked(positive, "radius")

    def extent(self) -> Array:
        """The radius."""
        return jnp.asarray(self.radius)

    def intersect(self, origin: Components, direction: Components) -> Hit:
        """The nearest hit in front of ``origin``.

        The half chord comes from the distance of the ray to the centre, not from the quadratic's discriminant, which
        cancels for a small far sphere (Haines, Günther and Akenine-Möller, Ray Tracing Gems 2019, chapter 7).
        """
        center, radius = Components.of(self.center), jnp.asarray(self.radius)
        to_origin = origin - center
        along = to_origin @ direction
        nearest = to_origin - direction * along
        squared_half_chord = radius * radius - nearest @ nearest
        half_chord = square_root(squared_half_chord)
        signed = jnp.where(-along - half_chord > 0, -half_chord, half_chord)
        hit = (squared_half_chord > 0) & (signed - along > 0)
        normal = normalize(nearest + direction * signed)
        return Hit(hit, signed - along, center + normal * radius, normal)

    def cover(self, origin: Components, direction: Components, distance: Any, radius: Any) -> Array:
        """The share of the patch within the cone that the sphere fills; see `Shape.cover`."""
        to_center = Components.of(self.center) - origin
        along, square = to_center @ direction, to_center @ to_center
        miss = norm(to_center - direction * along)
        # of the angle between the direction and the sphere's rim
        tangent = square_root(square - self.radius * self.radius)
        sine = divide(self.radius * along - miss * tangent, square)
        return jnp.where((along > 0) & (along < distance), share_beyond(sine, radius), 0.0)


class Parallelogram(Checked):
    """A flat piece, ``center ± edge_u ± edge_v``, whose front side looks along ``edge_u`` × ``edge_v``."""

    center: Vector = checked(vector, "center")
    edge_u: Vector = checked(edge_value, "edge_u")
    edge_v: Vector = checked(edge_value, "edge_v")

    def __check_init__(self):
        """Refuse edges that are parallel; values under a JAX transformation pass."""
        edge_u, edge_v = self.edge_u, self.edge_v
        if isinstance(edge_u, np.ndarray) and isinstance(edge_v, np.ndarray):
            area, *lengths = map(np.linalg.norm, (np.cross(edge_u, edge_v), edge_u, edge_v))
            if area <= 1e-12 * np.prod(lengths):
                what = f"got {edge_u.tolist()} and {edge_v.tolist()}"
                remedy = "Give two edges that span an area"
                raise InputError("edge_v", f"must not be parallel to edge_u, {what}", remedy)


class Rectangle(Shape, Parallelogram):
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

    def extent(self) -> Array:
        """The larger half-edge's largest component."""
        return jnp.max(jnp.abs(jnp.stack([self.edge_u, self.edge_v])))

    def intersect(self, origin: Components, direction: Components) -> Hit:
        """The hit, from either side; the normal always is that of the front side."""
        center, edge_u, edge_v = map(Components.of, (self.center, self.edge_u, self.edge_v))
        position, distance, normal, slope, (u, v) = meet_plane(origin, direction, center, edge_u, edge_v)
        hit = (slope != 0) & (distance > 0) & (jnp.abs(u) <= 1) & (jnp.abs(v) <= 1)
        return Hit(hit, distance, position, normal)

    def cover(self, origin: Components, direction: Components, distance: Any, radius: Any) -> Array:
        """The share of the patch within the pyramid over the rectangle; see `Shape.cover`."""
        center, *edges = map(Components.of, (self.center, self.edge_u, self.edge_v))
        to_center, normal = center - origin, normalize(edges[0].cross(edges[1]))
        height = to_center @ normal
        side, share = jnp.where(height < 0, -1.0, 1.0), 1.0
        for edge, across in (edges, edges[::-1]):
            # between the two edges along `edge`: beyond the plane through the origin and each
            rims, between = (to_center + across, to_center - across), -1.0
            for rim, inner in (rims, rims[::-1]):
                plane = normalize(edge.cross(rim))
                between += share_beyond(jnp.sign(plane @ inner) * (plane @ direction), radius)
            share *= jnp.maximum(between, 0.0)
        return jnp.where(height * side < distance * (direction @ normal) * side, share, 0.0)


def meet_plane(
    origin: Components, direction: Components, place: Components, edge_u: Components, edge_v: Components
) -> tuple[Components, Array, Components, Array, tuple[Array, Array]]:
    """Where rays meet the plane through a place and two edges that begin there.

    Returns:
        Position, distance, unit normal, the cosine between that and the ray, 0 where they never meet, and how many of
        each edge lead from the place to the position.
    """
    area = edge_u.cross(edge_v)
    normal = normalize(area)
    slope = direction @ normal
    distance = divide((place - origin) @ normal * slope, slope * slope)
    position = origin + direction * distance
    offset = position - place
    # By the normal: the square of a small triangle's area is below all that float32 divides by.
    u, v = (divide(one @ normal, area @ normal) for one in (offset.cross(edge_v), edge_u.cross(offset)))
    return position, distance, normal, slope, (u, v)
