"""The sphere."""

import jax.numpy as jnp
from jaxtyping import Array

from brdf.checks import Scalar, Vector, checked, positive, vector
from brdf.geometry.base import Hit, Shape, share_beyond
from brdf.vectors import Components, divide, norm, normalize, square_root


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

    def extent(self) -> Scalar:
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
        outside = -along - half_chord > 0
        signed = jnp.where(outside, -half_chord, half_chord)
        hit = (squared_half_chord > 0) & (signed - along > 0)
        normal = normalize(nearest + direction * signed)
        return Hit(hit, jnp.where(hit, signed - along, jnp.inf), center + normal * radius, normal)

    def cover_patch(self, origin: Components, direction: Components, distance: Array, radius: Array) -> Array:
        """The share of the patch within the cone that the sphere fills; see `Shape.cover_patch`."""
        to_center = Components.of(self.center) - origin
        along = to_center @ direction
        miss = norm(to_center - direction * along)
        # of the angle between the direction and the sphere's rim
        tangent = square_root(to_center @ to_center - self.radius * self.radius)
        sine = divide(self.radius * along - miss * tangent, to_center @ to_center)
        in_front = (along > 0) & (along < distance)
        return jnp.where(in_front, share_beyond(sine, radius), 0.0)
