"""Lights with an extent: rectangle, polygon and sphere, of uniform radiance.

A patch dA of radiance L at distance d, seen at the angle θ' to its normal, is a sample of intensity
I = L cosθ' dA / (π d²). The samples are the nodes of product rules over that part of the light which stands above the
horizon of the surface point, so that what is left to integrate is smooth also where the light is setting.

Rectangles and polygons shine from their front only and are invisible; lights cast no shadows.

How many samples, S. For lights at a distance of twice their size, above the horizon, the error of the irradiance falls
exponentially in √S: for a rectangle 4e-5 with S = 9, 1e-6 with 16, 1e-9 with 36; a sphere's is exact. Where a light is
setting, a bend is left, and the largest error over a ball falls like S^-1.5 to S^-2: 3e-5, 1e-4 and 2e-4 of the
brightest point with S = 64 for rectangle, polygon and sphere. A lobe asks for nodes closer than its width and then
converges exponentially too: at n = 30, S = 16 leaves 2e-5 for a rectangle, 2e-3 for a polygon, 1e-6 for a sphere; at
n = 1000, S = 64 leaves 1e-3, 2e-2 and 3e-3, S = 256 less than 1e-5 for each, and S = 16 shows the single samples
(``python -m benchmarks.light_samples``).
"""

from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from brdf.checks import direction_value, positive, sample_number, spectrum, vector, vertex_list
from brdf.errors import InputError
from brdf.geometry.rectangle import check_spans_area
from brdf.lights.punctual import Light, LightSample, Place
from brdf.lights.sample_sets import disc_rule, square_rule
from brdf.lights.triangulation import newell_normal, triangulate
from brdf.vectors import divide, dot, norm, normalize, square_root

SAMPLES = 64


def _positive_range(at_0: Array, at_1: Array) -> tuple[Array, Array]:
    """Where in [0, 1] a linear function is positive, given its ends: lower and upper bound, equal where it never is."""
    slope = at_1 - at_0
    crossing = jnp.clip(divide(-at_0 * jnp.sign(slope), jnp.abs(slope)), 0.0, 1.0)
    low = jnp.where(at_0 > 0, 0.0, jnp.where(at_1 > 0, crossing, 0.0))
    high = jnp.where(at_1 > 0, 1.0, jnp.where(at_0 > 0, crossing, 0.0))
    return low, high


class _Strip:
    """A patch whose points are a(t) + s b(t), with a and b linear in t: a parallelogram or a triangle.

    A parallelogram has the ends of a at two corners and b constant, a triangle a at one corner and b turning.
    """

    def __init__(self, start: tuple[Array, Array], edge: tuple[Array, Array]):
        self.start, self.edge = start, edge

    def above(self, node: Any, position: Array, normal: Array) -> tuple[Array, Array, Array]:
        """The node's place in the part above the horizon: s, the point, and the share of the weight that is left."""
        heights = [dot(a - position, normal) for a in self.start]
        slopes = [dot(b, normal) for b in self.edge]
        ends = [_positive_range(heights[0], heights[1])]
        ends.append(_positive_range(heights[0] + slopes[0], heights[1] + slopes[1]))
        empty = [high <= low for low, high in ends]
        low = jnp.minimum(*(jnp.where(none, 1.0, low) for none, (low, _) in zip(empty, ends, strict=True)))
        high = jnp.maximum(*(jnp.where(none, 0.0, high) for none, (_, high) in zip(empty, ends, strict=True)))
        width = jnp.maximum(high - low, 0.0)
        t = low + node.t * width
        height, slope = (first + t * (second - first) for first, second in (heights, slopes))
        bottom, top = _positive_range(height, height + slope)
        s = bottom + node.s * (top - bottom)
        start, edge = (first + t * (second - first) for first, second in (self.start, self.edge))
        return s, start + s * edge, width * (top - bottom)


def _from_patch(radiance: Array, point: Array, area: Array, light_normal: Array, position: Array) -> LightSample:
    """The sample of a patch of a flat light that shines along ``light_normal``."""
    offset = point - position
    squared = dot(offset, offset)
    to_light = normalize(offset)
    facing = jnp.maximum(-dot(to_light, light_normal), 0.0)
    squared_radius = divide(area * facing, np.pi * squared)
    return LightSample(to_light, radiance * squared_radius, norm(offset), square_root(squared_radius))


class RectangleLight(Light):
    """A parallelogram, ``center ± edge_u ± edge_v``, that shines along ``edge_u`` × ``edge_v``.

    Args:
        center: (3,), world units.
        edge_u: half of one edge, (3,), world units.
        edge_v: half of the other edge, (3,), not parallel to ``edge_u``.
        radiance: (C,), the same in all directions of the front side.
        samples: how many light samples at most; see the module for how many it takes.

    Raises:
        InputError: where a value is not finite, the edges are parallel or a radiance is negative.
    """

    center: Float[Array, "3"] = eqx.field(converter=vector("center"))
    edge_u: Float[Array, "3"] = eqx.field(converter=direction_value("edge_u"))
    edge_v: Float[Array, "3"] = eqx.field(converter=direction_value("edge_v"))
    radiance: Float[Array, " C"] = eqx.field(converter=spectrum("radiance"))
    samples: int = eqx.field(static=True, converter=sample_number, default=SAMPLES)
    type_name: ClassVar[str] = "rectangle"
    emittance_name: ClassVar[str] = "radiance"

    def __check_init__(self):
        """Refuse edges that span no area."""
        check_spans_area(self.edge_u, self.edge_v)

    def nodes(self) -> Any:
        """A product rule over the unit square."""
        return square_rule(self.samples)

    def illuminate(self, node: Any, at: Place) -> LightSample:
        """From a patch of the light above the horizon."""
        edge_u, edge_v = jnp.asarray(self.edge_u), jnp.asarray(self.edge_v)
        corner = self.center - edge_u - edge_v
        strip = _Strip((corner, corner + 2 * edge_v), (2 * edge_u, 2 * edge_u))
        _, point, share = strip.above(node, at.position, at.normal)
        area_vector = jnp.cross(edge_u, edge_v)
        area = 4 * norm(area_vector) * node.weight * share
        return _from_patch(self.radiance, point, area, normalize(area_vector), at.position)


class PolygonLight(Light):
    """A flat polygon that shines to the side from which its vertices run counter-clockwise.

    Args:
        vertices: (V, 3) corners in order, at least 3, in one plane; it need not be convex but must not cross itself.
        radiance: (C,), the same in all directions of the front side.
        samples: how many light samples at most, the same number for each triangle it is cut into.

    Raises:
        InputError: where a value is not finite, the polygon has no area, is not flat or crosses itself, or a radiance
            is negative.
    """

    vertices: Float[Array, "V 3"] = eqx.field(converter=vertex_list("vertices"))
    radiance: Float[Array, " C"] = eqx.field(converter=spectrum("radiance"))
    samples: int = eqx.field(static=True, converter=sample_number, default=SAMPLES)
    triangles: tuple[tuple[int, int, int], ...] = eqx.field(static=True, init=False)
    type_name: ClassVar[str] = "polygon"
    emittance_name: ClassVar[str] = "radiance"

    def __post_init__(self):
        """Cut it into triangles, once."""
        self.vertices = vertex_list("vertices")(self.vertices)  # a field's converter would run after this
        self.samples = sample_number(self.samples)
        self.triangles = triangulate(self.vertices)
        if self.samples < len(self.triangles):
            came = f"must be at least {len(self.triangles)} for {len(self.vertices)} vertices, got {self.samples}"
            raise InputError("samples", came, "Give one sample for each triangle at least")

    def nodes(self) -> Any:
        """Which triangle, and a product rule over the unit square of each."""
        rule = square_rule(self.samples // len(self.triangles))
        corners = np.repeat(np.array(self.triangles), len(rule.weight), axis=0)
        tiled = [np.tile(values, len(self.triangles)) for values in rule]
        return jnp.asarray(self.vertices)[corners], type(rule)(*tiled)

    def illuminate(self, node: Any, at: Place) -> LightSample:
        """From a patch of one triangle above the horizon."""
        (a, b, c), rule = node
        strip = _Strip((a, a), (b - a, c - a))
        s, point, share = strip.above(rule, at.position, at.normal)
        double_area = norm(jnp.cross(b - a, c - a))
        axis = normalize(newell_normal(jnp.asarray(self.vertices)))
        return _from_patch(self.radiance, point, double_area * s * rule.weight * share, axis, at.position)


class SphereLight(Light):
    """A sphere of uniform radiance.

    Args:
        center: (3,), world units.
        radius: greater than 0, world units.
        radiance: (C,).
        samples: how many light samples at most; see the module for how many it takes.

    Raises:
        InputError: where a value is not finite, the radius is not positive or a radiance is negative.
    """

    center: Float[Array, "3"] = eqx.field(converter=vector("center"))
    radius: Float[Array, ""] = eqx.field(converter=positive("radius"))
    radiance: Float[Array, " C"] = eqx.field(converter=spectrum("radiance"))
    samples: int = eqx.field(static=True, converter=sample_number, default=SAMPLES)
    type_name: ClassVar[str] = "sphere"
    emittance_name: ClassVar[str] = "radiance"

    def nodes(self) -> Any:
        """A rule over the cap of directions in which a point sees the sphere."""
        return disc_rule(self.samples)

    def illuminate(self, node: Any, at: Place) -> LightSample:
        """From a patch of the cap of directions, above the horizon."""
        offset = self.center - at.position
        distance = norm(offset)
        axis = normalize(offset)
        squared_sine = jnp.minimum(divide(self.radius * self.radius, distance * distance), 1.0)
        height = divide(squared_sine, 1.0 + square_root(1.0 - squared_sine))  # 1 - cos, without cancellation
        across, along = perpendicular(axis)
        turn = 2 * np.pi * node.t
        outward = jnp.cos(turn) * across + jnp.sin(turn) * along
        low, high = _above_horizon(dot(axis, at.normal), dot(outward, at.normal), height)
        share = low + node.s * (high - low)
        below_axis = share * height  # 1 - cos of the angle to the axis
        to_light = (1.0 - below_axis) * axis + square_root(below_axis * (2.0 - below_axis)) * outward
        squared_radius = 2.0 * height * (high - low) * node.weight
        along_ray = distance * (1.0 - below_axis)
        half_chord = square_root(along_ray * along_ray - (distance * distance - self.radius * self.radius))
        visible_side = along_ray - half_chord
        return LightSample(
            normalize(to_light), self.radiance * squared_radius, visible_side, square_root(squared_radius)
        )


def _above_horizon(axial: Array, outward: Array, height: Array) -> tuple[Array, Array]:
    """The part above the horizon of a great circle from a cap's axis to its rim, as shares of the cap's height.

    The circle is ``cos x axis + sin x outward``; at its angle x the sine of the elevation is ``cos x axial + sin x
    outward``, which changes its sign where the cosine is |outward| / √(axial² + outward²).
    """
    cosine = divide(jnp.abs(outward), square_root(axial * axial + outward * outward))
    crossing = jnp.clip(divide(1.0 - cosine, height), 0.0, 1.0)
    low = jnp.where(axial > 0, 0.0, jnp.where(outward > 0, crossing, 0.0))
    high = jnp.where(
        (axial > 0) & (outward >= 0), 1.0, jnp.where(axial > 0, crossing, jnp.where(outward > 0, 1.0, 0.0))
    )
    return low, high


def perpendicular(axis: Array) -> tuple[Array, Array]:
    """Two unit vectors at right angles to a unit vector and to each other.

    Args:
        axis: (3,), unit.

    Source: Duff et al., Building an orthonormal basis, revisited, JCGT 6 (2017).
    """
    x, y, z = axis
    sign = jnp.where(z < 0, -1.0, 1.0)
    a = -1.0 / (sign + z)
    b = x * y * a
    return jnp.stack([1.0 + sign * x * x * a, sign * b, -sign * x]), jnp.stack([b, sign + y * y * a, -y])
