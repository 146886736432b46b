"""Lights with an extent: rectangle, polygon and sphere, of uniform radiance.

A patch dA of radiance L at distance d, seen at the angle θ' to its normal, is a sample of intensity
I = L cosθ' dA / (π d²). The samples are the nodes of product rules over that part of the light which stands above the
horizon of the surface point, so that what is left to integrate is smooth also where the light is setting; over flat
lights they are spread by the angles at which the point sees them, so that it is smooth too however near the light is.

Rectangles and polygons shine from their front only and are invisible; lights cast no shadows.

How many samples, S. Above the horizon the error of the irradiance falls exponentially in √S, for lights at a distance
of twice their size fast: for a rectangle 4e-6 with S = 9, 2e-8 with 16, 1e-12 with 36; S = 64 leaves 3e-7 at half
their size and 2e-4 however near they are (a polygon of two triangles 4e-4 and 1e-2); a sphere's is exact. Where a
light is setting, a bend is left, and the largest error over a ball falls like S^-1.5 to S^-2: 3e-5, 1e-4 and 2e-4 of
the brightest point with S = 64 for rectangle, polygon and sphere. A lobe asks for nodes closer than its width and
then converges exponentially too: at n = 30, S = 16 leaves 3e-6 for a rectangle, 9e-4 for a polygon, 1e-6 for a
sphere; at n = 1000, S = 64 leaves 1e-3, 3e-2 and 3e-3, S = 256 less than 5e-5 for each, and S = 16 shows the single
samples (``python -m benchmarks.light_samples``). ``samples`` is what a picture is rendered with; ``fitting.fit`` finds
how many it takes.
"""

import operator
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from brdf.checks import Scalar, Spectrum, Vector, checked, positive, sample_number, spectrum, vector, vertex_list
from brdf.errors import InputError
from brdf.geometry.shapes import Parallelogram
from brdf.geometry.surface_points import SurfacePoints
from brdf.lights.base import Light, LightSample, Rows
from brdf.lights.sample_sets import square_rule, turned_rule
from brdf.vectors import Components, divide, norm, normalize, square_root, turned

SAMPLES = 64

FAR = 1e6
"""Lengths of an edge: points beyond see all of it alike, and points nearer than the inverse as if they were there."""

FLAT = 1e-6
"""How far a vertex may lie off the plane, as a share of the polygon's size: what six digits in a file leave."""


def _positive_range(at_0: Array, at_1: Array) -> tuple[Array, Array]:
    """Where in [0, 1] a linear function is positive, given its ends: lower and upper bound, equal where it never is."""
    slope = at_1 - at_0
    return _between(at_0, at_1, jnp.clip(divide(-at_0 * jnp.sign(slope), jnp.abs(slope)), 0.0, 1.0))


def _between(at_0: Array, at_1: Array, crossing: Array) -> tuple[Array, Array]:
    """The same of any function that changes its sign once at most."""
    low = jnp.where(at_0 > 0, 0.0, jnp.where(at_1 > 0, crossing, 0.0))
    high = jnp.where(at_1 > 0, 1.0, jnp.where(at_0 > 0, crossing, 0.0))
    return low, high


def _foot(start: Components, edge: Components) -> tuple[Array, Array]:
    """Where on the line start + s edge the foot of the origin is, and how far the line is, in lengths of the edge."""
    square = edge @ edge
    foot = -divide(start @ edge, square)
    way = start + edge * foot
    return foot, jnp.clip(divide(square, way @ way), FAR**-2, FAR**2) ** -0.5


def _evenly_seen(low: Array, high: Array, foot: Array, distance: Array, u: Array) -> tuple[Array, Array]:
    """A point of an interval, and how fast it moves with u, of which the tangent of half an angle is a linear function.

    The angle is that to the foot of the interval's line, from the given distance of it; u goes from 0 to 1. What a
    point receives of a line of light is nearly a polynomial of that tangent however near it is, as it is not of the
    place on the line.
    """
    a, b, size = (low - foot) / distance, (high - foot) / distance, (high - low) / distance
    root = jnp.sqrt(1.0 + a * a)
    # Sums and differences of tangents as they are free of cancellation for what is far away, or all around.
    ahead = 1.0 + a * b
    total = root * jnp.sqrt(1.0 + b * b) + jnp.abs(ahead)
    between = jnp.where(ahead > 0, size / total, total / jnp.where(ahead > 0, 1.0, size))
    tangent_low = a / (1.0 + root)
    growth = between * (1.0 + tangent_low * tangent_low) / (1.0 - between * tangent_low)
    tangent = tangent_low + u * growth
    left_low = 2.0 / (1.0 + root)  # 1 - tangent_low²
    left = left_low - u * growth * (tangent_low + tangent)
    place = low + 2.0 * distance * u * growth * (1.0 + tangent * tangent_low) / (left * left_low)
    return place, 2.0 * distance * growth * (1.0 + tangent * tangent) / (left * left)


class FlatLight(Light):
    """A light of patches, whose points are a(t) + s b(t) with s and t from 0 to 1.

    Both a and b are linear in t, and given at t = 0 and t = 1: a parallelogram has a constant b, a triangle a constant
    a. A patch shines to the side from which b and then a grow counter-clockwise.
    """

    @staticmethod
    def sample(point: SurfacePoints, *row: Any) -> LightSample:
        """From a node (s, t) of that part of a patch which stands above the horizon."""
        start_0, start_1, edge_0, edge_1, s, t, weight = row
        starts, edges = (start_0, start_1), (edge_0, edge_1)
        heights = [(a - point.position) @ point.normal for a in starts]
        slopes = [b @ point.normal for b in edges]
        sides = _positive_range(*heights), _positive_range(*map(operator.add, heights, slopes))
        # a side that is wholly below the horizon has no say
        lowest = jnp.minimum(*(jnp.where(high <= low, 1.0, low) for low, high in sides))
        highest = jnp.maximum(*(jnp.where(high <= low, 0.0, high) for low, high in sides))
        highest = jnp.maximum(lowest, highest)
        # across the strips, on a line through that point of the one beneath the surface point which is nearest to it
        unit = divide(1.0, norm(edge_0))
        way, first, turn, step = (
            one * unit for one in (point.position - start_0, edge_0, edge_1 - edge_0, start_1 - start_0)
        )
        front = first.cross(turn + step)
        ahead = (way.cross(turn) - step.cross(first)) @ front
        beneath = divide(-(way.cross(first) @ front) * jnp.sign(ahead), jnp.abs(ahead))
        start, edge = (a + (b - a) * jnp.clip(beneath, lowest, highest) for a, b in (starts, edges))
        along = jnp.clip(_foot(start - point.position, edge)[0], 0.0, 1.0)
        line = start_0 + edge_0 * along - point.position, start_1 - start_0 + (edge_1 - edge_0) * along
        t, of_t = _evenly_seen(lowest, highest, *_foot(*line), t)
        height, slope, start, edge = (a + (b - a) * t for a, b in (heights, slopes, starts, edges))
        bottom, top = _positive_range(height, height + slope)
        s, of_s = _evenly_seen(bottom, top, *_foot(start - point.position, edge), s)
        area_vector = edge.cross(start_1 - start_0 + (edge_1 - edge_0) * s)
        offset = start + edge * s - point.position
        to_light = normalize(offset)
        facing = jnp.maximum(-(to_light @ normalize(area_vector)), 0.0)
        area = norm(area_vector) * weight * of_t * of_s
        squared_radius = divide(area * facing, np.pi * (offset @ offset))
        return LightSample(to_light, squared_radius, norm(offset), square_root(squared_radius))


class RectangleLight(FlatLight, Parallelogram):
    """A parallelogram, ``center ± edge_u ± edge_v``, that shines along ``edge_u`` × ``edge_v``.

    Args:
        center: (3,), world units.
        edge_u: half of one edge, (3,), world units.
        edge_v: half of the other edge, (3,), not parallel to ``edge_u``.
        radiance: (C,), the same in all directions of the front side.
        samples: how many light samples at most; see the module for how many it takes.

    Raises:
        InputError: where a value is not finite, the edges are parallel or a radiance is negative.

    Example:
        >>> window = brdf.RectangleLight([0, 0, 2], edge_u=[0.5, 0, 0], edge_v=[0, -0.5, 0], radiance=3.0)
        >>> window.samples
        64
    """

    radiance: Spectrum = checked(spectrum, "radiance")
    samples: int = eqx.field(static=True, converter=sample_number, default=SAMPLES)
    type_name = "rectangle"

    @property
    def rows(self) -> Rows:
        """The light, and a product rule over the unit square."""
        corner, edge_u, edge_v = self.center - self.edge_u - self.edge_v, 2 * self.edge_u, 2 * self.edge_v
        return (corner, corner + edge_v, edge_u, edge_u), square_rule(self.samples), self.radiance


class PolygonLight(FlatLight):
    """A flat polygon that shines to the side from which its vertices run counter-clockwise.

    Args:
        vertices: (V, 3) corners in order, at least 3, in one plane; it need not be convex but must not cross itself.
        radiance: (C,), the same in all directions of the front side.
        samples: how many light samples at most, the same number for each triangle it is cut into.

    Raises:
        InputError: where a value is not finite, the polygon has no area, is not flat or crosses itself, or a radiance
            is negative.

    Example:
        >>> lamp = brdf.PolygonLight([[0, 0, 2], [0, 1, 2], [1, 0, 2]], radiance=3.0)  # shines down
        >>> lamp.samples
        64
    """

    vertices: Float[Array, "V 3"]
    radiance: Spectrum = checked(spectrum, "radiance")
    samples: int = eqx.field(static=True, default=SAMPLES)
    triangles: tuple[tuple[int, int, int], ...] = eqx.field(static=True, init=False)
    type_name = "polygon"

    def __post_init__(self):
        """Check it, which converters of fields would do after this, and cut it into triangles, once."""
        self.vertices = vertex_list("vertices", self.vertices)
        self.samples = sample_number(self.samples)
        self.triangles = triangulate(self.vertices)
        if self.samples < len(self.triangles):
            what = f"must be at least {len(self.triangles)} for {len(self.vertices)} vertices, got {self.samples}"
            raise InputError("samples", what, "Give one sample for each triangle at least")

    @property
    def rows(self) -> Rows:
        """Triangles, and a product rule over the unit square of each."""
        rule, count = square_rule(self.samples // len(self.triangles)), len(self.triangles)
        a, b, c = (self.vertices[np.repeat(corner, rule.weight.size)] for corner in np.array(self.triangles).T)
        return (), (a, a, b - a, c - a, *(np.tile(values, count) for values in rule)), self.radiance


def triangulate(vertices: Any) -> tuple[tuple[int, int, int], ...]:
    """Cut off ears until a triangle is left (G. H. Meisters, 1975); a fan where JAX is tracing the vertices."""
    if not isinstance(vertices, np.ndarray):
        return tuple((0, last - 1, last) for last in range(2, vertices.shape[0]))
    size = float(np.max(np.abs(vertices - vertices.mean(axis=0))))
    relative = vertices - vertices[0]
    # I. E. Sutherland, R. F. Sproull and R. A. Schumacker, ACM Computing Surveys 6 (1974), after M. Newell.
    area_vector = np.sum(np.cross(relative, np.roll(relative, -1, axis=0)), axis=0)
    double_area = float(np.linalg.norm(area_vector))
    if double_area <= 1e-12 * size * size:
        raise InputError("vertices", "span no area", "Give the corners of a polygon in order")
    normal = area_vector / double_area
    if np.max(np.abs(relative @ normal)) > FLAT * size:
        raise InputError("vertices", "do not lie in one plane", "Cut the light into flat polygons")

    def turn(a: int, b: int, c: int) -> float:
        """Twice the area of the triangle a b c, positive where it turns left."""
        return float(normal @ np.cross(vertices[b] - vertices[a], vertices[c] - vertices[a]))

    def holds(corner: tuple[int, int, int], d: int) -> bool:
        a, b, c = corner
        return d not in corner and min(turn(a, b, d), turn(b, c, d), turn(c, a, d)) > 0

    left, triangles = list(range(len(vertices))), []
    while len(left) > 3:
        corners = zip(left[-1:] + left[:-1], left, left[1:] + left[:1], strict=True)
        ears = (one for one in corners if turn(*one) >= 0 and not any(holds(one, d) for d in left))
        ear = next(ears, None)
        if ear is None:
            raise InputError("vertices", "cross each other's edges", "Give the corners of a simple polygon in order")
        if turn(*ear) > 0:
            triangles.append(ear)
        left.remove(ear[1])
    return (*triangles, (left[0], left[1], left[2]))


class SphereLight(Light):
    """A sphere of uniform radiance, which shines outward: what lies inside sees none of it.

    Args:
        center: (3,), world units.
        radius: greater than 0, world units.
        radiance: (C,).
        samples: how many light samples at most; see the module for how many it takes.

    Raises:
        InputError: where a value is not finite, the radius is not positive or a radiance is negative.

    Example:
        >>> bulb = brdf.SphereLight(center=[0, 0, 2], radius=0.1, radiance=[9.0, 8.0, 7.0], samples=16)
        >>> bulb.samples
        16
    """

    center: Vector = checked(vector, "center")
    radius: Scalar = checked(positive, "radius")
    radiance: Spectrum = checked(spectrum, "radiance")
    samples: int = eqx.field(static=True, converter=sample_number, default=SAMPLES)
    type_name = "sphere"

    @property
    def rows(self) -> Rows:
        """The light, and a rule over the cap of directions in which a point sees it."""
        return (self.center, self.radius), turned_rule(self.samples, 1 / 4), self.radiance

    @staticmethod
    def sample(point: SurfacePoints, *row: Any) -> LightSample:
        """From a patch of the cap of directions, above the horizon."""
        center, radius, s, t, weight = row
        offset = center - point.position
        distance, axis = norm(offset), normalize(offset)
        squared_sine = jnp.where(distance > radius, divide(radius * radius, distance * distance), 0.0)
        height = divide(squared_sine, 1.0 + square_root(1.0 - squared_sine))  # 1 - cos, without cancellation
        outward = turned(axis, t)
        low, high = _arc_above_horizon(axis @ point.normal, outward @ point.normal, height)
        below_axis = (low + s * (high - low)) * height  # 1 - cos of the angle to the axis
        to_light = axis * (1.0 - below_axis) + outward * square_root(below_axis * (2.0 - below_axis))
        squared_radius = 2.0 * height * (high - low) * weight
        along_ray = distance * (1.0 - below_axis)
        half_chord = square_root(along_ray * along_ray - (distance * distance - radius * radius))
        return LightSample(normalize(to_light), squared_radius, along_ray - half_chord, square_root(squared_radius))


def _arc_above_horizon(axial: Array, outward: Array, height: Array) -> tuple[Array, Array]:
    """The part above the horizon of a great circle from a cap's axis to its rim, as shares of the cap's height.

    The circle is ``cos x axis + sin x outward``; at its angle x the sine of the elevation is ``cos x axial + sin x
    outward``, which changes its sign where the cosine is |outward| / √(axial² + outward²).
    """
    cosine = divide(jnp.abs(outward), square_root(axial * axial + outward * outward))
    return _between(axial, outward, jnp.clip(divide(1.0 - cosine, height), 0.0, 1.0))
