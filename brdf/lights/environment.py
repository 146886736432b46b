"""Light from all around: the same from everywhere, or a lat-long map.

Axes of a map, those of Mitsuba's ``envmap``: y is up, so the first row is seen along +y; left and right edge of the map
are seen along -z, a quarter of the width from the left along +x, the middle along +z, three quarters along -x. With
u to the right and v down, both from 0 to 1, the direction is (sin 2πu sin πv, cos πv, -cos 2πu sin πv). A texel shines
from its whole solid angle, (cos θ₁ - cos θ₂) Δφ; Mitsuba 3.9 has row i of H at v = i / (H - 1) and interpolates, which
is up to half a texel elsewhere.

Where the samples go. The map is cut along rows and columns into as many rectangles as there are samples, always the one
next whose light is spread most (energy times variance of its directions), through its centre of mass. So samples crowd
where the light is. Wide texels are cut up themselves; one bright texel of a fine map costs one sample.
A sample keeps energy, mean and covariance of the directions in its rectangle: the irradiance of rectangles above the
horizon is exact however few there are, and those that the horizon crosses fade in as their spread says. What is sampled
is the shape of shadows and of highlights: a lobe needs the rectangles in its reach to be narrower than itself.

Source of the idea: P. Debevec, A median cut algorithm for light probe sampling, SIGGRAPH 2005 posters.
"""

import heapq
import warnings
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from brdf.checks import Spectrum, checked, sample_number, spectrum
from brdf.errors import InputError, as_numbers
from brdf.geometry.surface_points import SurfacePoints
from brdf.lights.base import Light, LightSample, Rows
from brdf.lights.sample_sets import turned_rule
from brdf.vectors import Components, divide, normalize, square_root, turned

CONSTANT_SAMPLES = 512
MAP_SAMPLES = 1024
STEEPNESS = 7.0
"""The innermost samples of a lobe are exp(-this) times as far from its centre as the horizon."""
LARGEST_MAP = 1 << 21
"""Texels from which on a map is averaged before it is cut: 2048 × 1024."""
SAME = 1e-3
"""By how much variances must differ, relatively, and by how many texels a centre of mass may fall short of a whole
number and yet count as it: rounding of pixels must not decide ties, or a map that was saved would be cut otherwise."""
FINEST, FINER = 1024, 8
"""Texels of a map of fewer rows are cut up too, in so many rows and columns each, and these again."""


class ConstantEnvironment(Light):
    """The same radiance from everywhere.

    Where no shape and no mask hides any of it a lobe is summed up by angles of view, whatever ``samples`` says: see
    `brdf.lights.even_sky`. Elsewhere there are samples at each point.

    Half of the samples serve the diffuse term, by a rule over the hemisphere above each point that is exact for
    it. The others serve the lobe: they lie around the mirror direction, at all distances from it up to the horizon,
    most of them near it, so that they meet a lobe of any exponent from 0 to 1e5. Their half vector H turns about the
    normal N at the angle α, up to which light comes from above the horizon for 2 α < 90° + ψ with
    tan ψ = V·T / N·V and T the direction of the turn; the solid angle of the light is 4 (V·H) that of H.

    With 512 samples a normalised half-vector lobe is within 4e-3 of its albedo at n = 1e5, within 5e-4 up to n = 1000;
    a mirror-vector lobe within 5e-3 for views up to 60 degrees and within 4e-2 nearer to the horizon, where it is round
    and the rings are not.

    Args:
        radiance: (C,).
        samples: how many light samples at most, at least 2, where shapes or masks hide some of it.

    Raises:
        InputError: where a radiance is negative or not finite, or the samples are too few.

    Example:
        >>> ball = brdf.Scene.load("scene.toml")
        >>> outdoors = brdf.Scene(ball.camera, ball.shapes, lights=[brdf.ConstantEnvironment(1.0, samples=64)])
        >>> float(brdf.render(brdf.Lambert(k_d=0.5), outdoors).max().round(3))
        0.5
    """

    radiance: Spectrum = checked(spectrum, "radiance")
    samples: int = eqx.field(static=True, converter=sample_number, default=CONSTANT_SAMPLES)
    type_name = "environment"

    def __check_init__(self):
        """Refuse a single sample."""
        if self.samples < 2:
            raise InputError("samples", "must be at least 2 here, got 1", "Give more")

    @property
    def rows(self) -> Rows:
        """The light, two rules over the hemisphere, and which of the two a row belongs to."""
        half = max(1, self.samples // 2)
        diffuse, lobe = turned_rule(half, 1 / 2), turned_rule(self.samples - half, 4 / 3)
        rule = [np.concatenate(pair) for pair in zip(diffuse, lobe, strict=True)]
        lobe_only = np.repeat([0.0, 1.0], [diffuse.weight.size, lobe.weight.size])
        return (), (*rule, lobe_only), self.radiance

    @staticmethod
    def sample(point: SurfacePoints, *row: Any) -> LightSample:
        """From a patch of the hemisphere above the point."""
        s, t, weight, lobe_only = row
        normal, to_view = point.normal, point.to_view
        outward = turned(normal, t)
        even = normal * s + outward * square_root(1.0 - s * s)
        end = 0.25 * np.pi + 0.5 * jnp.arctan2(outward @ to_view, jnp.maximum(normal @ to_view, 1e-6))
        angle = end * jnp.expm1(STEEPNESS * s) / np.expm1(STEEPNESS)
        half = normal * jnp.cos(angle) + outward * jnp.sin(angle)
        view_half = half @ to_view
        mirrored = half * (2.0 * view_half) - to_view
        stretch = end * STEEPNESS * jnp.exp(STEEPNESS * s) / np.expm1(STEEPNESS)
        share = 8.0 * jnp.maximum(view_half, 0.0) * jnp.sin(angle) * stretch
        squared_radius = jnp.where(lobe_only > 0, share, 2.0) * weight
        to_light = normalize(even + (mirrored - even) * lobe_only)
        return LightSample(
            to_light,
            squared_radius * (1.0 - lobe_only),
            jnp.asarray(jnp.inf),
            square_root(squared_radius),
            lobe_intensity=squared_radius * lobe_only,
        )


class Patches(NamedTuple):
    """The rectangles that a map is cut into.

    Attributes:
        intensity: energy over π, (S, C).
        mean: mean direction, weighted by radiance, (S, 3).
        covariance: of the directions, (S, 3, 3).
    """

    intensity: Float[Any, "S C"]
    mean: Float[Any, "S 3"]
    covariance: Float[Any, "S 3 3"]


class EnvironmentMap(Light):
    """Light from a lat-long map, see the module for its axes.

    Args:
        pixels: (H, W, C) radiance. What is negative or not finite counts as 0, with a warning.
        radiance: (C,), what multiplies the map; (1,) brightens or darkens it, several colour a map of one channel.
        samples: how many light samples at most.

    Raises:
        InputError: where the map is no picture or all black, or a factor is negative.

    Example:
        >>> sky = brdf.EnvironmentMap(np.ones((4, 8, 3)) * [0.3, 0.5, 1.0], samples=64)
        >>> ball = brdf.Scene.load("scene.toml")
        >>> brdf.Scene(ball.camera, ball.shapes, lights=[sky]).channels
        3
    """

    pixels: Float[Array, "H W C"]
    radiance: Spectrum
    patches: Patches
    samples: int = eqx.field(static=True)
    type_name = "environment"

    def __init__(self, pixels: Any, *, radiance: Any = 1.0, samples: int = MAP_SAMPLES):
        """Take a map's colour out where it has only one, and cut it up."""
        self.samples = sample_number(samples)
        pixels, factor = _checked(pixels), spectrum("radiance", radiance)
        own, channels = factor.size, pixels.shape[2]
        if own != channels and 1 not in (own, channels):
            what = f"has {own} channels, the map {channels}"
            raise InputError("radiance", what, "Give one factor, or one per channel of the map")
        # normalised by each channel's mean, so that the emittance tells the colour of the light
        energy = pixels * _solid_angles(*pixels.shape[:2])[..., None]
        colour = energy.sum(axis=(0, 1)) / (4 * np.pi)
        self.pixels = pixels / np.where(colour > 0, colour, 1.0)
        if np.ptp(self.pixels[..., colour > 0], axis=-1).max() <= 1e-6 * self.pixels.max():
            self.pixels = np.mean(self.pixels[..., colour > 0], axis=-1, keepdims=True)
        self.radiance = factor * colour
        self.patches = cut(np.asarray(self.pixels), self.samples)

    @property
    def rows(self) -> Rows:
        """The rectangles of the map, means and rows of covariances."""
        intensity, mean, covariance = self.patches
        return (), (mean, *covariance.swapaxes(0, 1)), self.radiance * intensity

    @staticmethod
    def sample(point: SurfacePoints, *row: Any) -> LightSample:
        """The same at every point: the light of one rectangle of the map."""
        mean, *covariance = row
        (xx, _, _), (_, yy, _), (_, _, zz) = covariance
        radius = square_root(2.0 * (xx + yy + zz))  # that of a disc of the same variance
        spread = Components(tuple(row @ point.normal for row in covariance)) @ point.normal
        cosine, above = patch_cosine(point.normal @ mean, spread)
        return LightSample(normalize(mean), 1.0, jnp.asarray(jnp.inf), radius, cosine, above)


def patch_cosine(middle: Array, variance: Array) -> tuple[Array, Array]:
    """Mean of (N·L)+ over a patch of the sky, and the share of its light above the horizon.

    Exact where the patch does not cross the horizon. Where it does, N·L is taken to be spread by the parabola
    3/4 (1 - x²) that has the patch's mean and variance.
    """
    half_width = square_root(5.0 * variance)
    x = divide(middle, half_width)
    crosses = (half_width > 0) & (jnp.abs(x) < 1)
    x = jnp.where(crosses, x, 0.0)
    partly = half_width * (3 / 16 + x * (1 / 2 + x * (3 / 8 - x * x / 16)))
    share = 1 / 2 + x * (3 / 4 - x * x / 4)
    return jnp.where(crosses, partly, middle), jnp.where(crosses, share, 1.0)


def _checked(pixels: Any) -> np.ndarray:
    array = np.array(as_numbers("pixels", pixels, remedy="Give an array of shape (H, W, C)"))
    if array.ndim != 3 or 0 in array.shape:
        raise InputError("pixels", f"must be of shape (H, W, C), got {array.shape}", "Give a lat-long map")
    bad = ~(np.isfinite(array) & (array >= 0))
    if bad.any():
        lowest, count = np.min(array, where=np.isfinite(array), initial=0.0), np.count_nonzero(bad.any(axis=-1))
        message = f"environment map: {count} texels are negative or not finite (down to {lowest:g}); they count as 0."
        warnings.warn(message, UserWarning, stacklevel=3)
        array[bad] = 0.0
    if not array.any():
        raise InputError("pixels", "are all black", "Give a map with light in it, or leave the light out")
    return array


def _solid_angles(height: int, width: int) -> np.ndarray:
    edges = np.cos(np.linspace(0.0, np.pi, height + 1))
    return (-np.diff(edges) * 2 * np.pi / width)[:, None]


class _Grid(NamedTuple):
    """Cells of one size: the texels of a map, or what one of them is cut up into.

    Attributes:
        moments: of each cell, see `_moments`.
        corner: row and column, in texels of the map, where the first cell begins.
        step: texels along a cell.
    """

    moments: Float[np.ndarray, "R K M"]
    corner: tuple[float, float] = (0.0, 0.0)
    step: float = 1.0

    @property
    def all_cells(self) -> Any:
        """The box of all of them: the first row and that after the last, and such columns."""
        return [[0, count] for count in self.moments.shape[:2]]


def cut(pixels: Float[np.ndarray, "H W C"], samples: int) -> Patches:
    """Cut a map into rectangles, see the module."""
    height, width, channels = pixels.shape
    moments = _moments(pixels, np.linspace(0, np.pi, height + 1), np.linspace(0, 2 * np.pi, width + 1))
    while moments.shape[0] * moments.shape[1] > LARGEST_MAP:
        for axis in (0, 1):
            moments = np.add.reduceat(moments, np.arange(0, moments.shape[axis], 2), axis=axis)

    def entry(grid: _Grid, box: Any) -> tuple[float, Any, _Grid, Any]:
        """Largest spread first: energy times variance of the directions, which is what is left of their length 1.

        Four digits of it: of rectangles that are alike the first comes first, whatever rounding makes of them.
        """
        energy, *first = grid.moments[slice(*box[0]), slice(*box[1]), :4].sum(axis=(0, 1))
        variance = 1.0 - np.sum((np.array(first) / energy) ** 2) if energy > 0 else 0.0
        spread = energy * variance if variance > 1e-12 else 0.0  # rounding aside
        place = [[corner + grid.step * end for end in ends] for corner, ends in zip(grid.corner, box, strict=True)]
        return -float(f"{spread:.4g}"), place, grid, box

    def finer(grid: _Grid, box: Any) -> _Grid:
        """The one cell of a box that is not dark, cut up."""
        some = grid.moments[slice(*box[0]), slice(*box[1]), 0]
        cell = np.unravel_index(np.argmax(some), some.shape)
        row, column = (
            corner + grid.step * (ends[0] + int(offset))
            for corner, ends, offset in zip(grid.corner, box, cell, strict=True)
        )
        down, about = (np.linspace(first, first + grid.step, FINER + 1) for first in (row, column))
        radiance = np.broadcast_to(pixels[int(row), int(column)], (FINER, FINER, channels))
        within = _moments(radiance, np.pi * down / height, 2 * np.pi * about / width)
        return _Grid(within, (row, column), grid.step / FINER)

    whole = _Grid(moments)
    heap, done = [entry(whole, whole.all_cells)], []
    while heap and len(heap) + len(done) < samples:
        best = heapq.heappop(heap)
        negative_spread, _, grid, box = best
        halves = _halves(grid, box, height, width) if negative_spread else []
        if negative_spread and not halves and height < FINEST * grid.step and len(moments) == height:
            grid = finer(grid, box)
            halves = _halves(grid, grid.all_cells, height, width)
        if not halves:
            done.append(best)
        for half in halves:
            heapq.heappush(heap, entry(grid, half))
    patches = sorted(done + heap, key=lambda one: one[1])
    sums = [grid.moments[slice(*rows), slice(*columns)].sum(axis=(0, 1)) for *_, grid, (rows, columns) in patches]
    sums = np.stack(sums)
    return _patches(sums[sums[:, 0] > 0], channels)


def _moments(
    radiance: Float[np.ndarray, "R K C"], down: Float[np.ndarray, " R+1"], about: Float[np.ndarray, " K+1"]
) -> Float[np.ndarray, "R K 13+C"]:
    """Per cell: energy, its products with the direction (3) and with pairs of its axes (9), energy of each channel.

    Means over the cell's solid angle, by integrals of sines and cosines of the angles of its edges, down and about,
    which are equally far apart.
    """
    step, middle, down = about[1] - about[0], 0.5 * (about[1:] + about[:-1]), down[:, None]
    cos, sin = np.cos(down), np.sin(down)
    solid, pair = -np.diff(cos, axis=0), (cos[1:] ** 2 + cos[1:] * cos[:-1] + cos[:-1] ** 2) / 3
    across, slant = np.diff(0.5 * (down - sin * cos), axis=0) / solid, np.diff(sin**3, axis=0) / (3 * solid)
    x, z = (np.sin(step / 2) / (step / 2) * one for one in (np.sin(middle), -np.cos(middle)))
    double_x, double_z = (np.sin(step) / step * one for one in (np.cos(2 * middle), -np.sin(2 * middle)))
    xx, zz, xz = (1 - pair) * (1 - double_x) / 2, (1 - pair) * (1 + double_x) / 2, (1 - pair) * double_z / 2
    xy, yz, y = slant * x, slant * z, (cos[1:] + cos[:-1]) / 2
    means = [across * x, y, across * z, xx, xy, xz, xy, pair, yz, xz, yz, zz]
    energy = radiance * (step * solid)[..., None]
    weight = energy.sum(axis=-1)
    return np.concatenate([np.stack([weight, *(weight * one for one in means)], axis=-1), energy], axis=-1)


def _halves(grid: _Grid, box: Any, height: int, width: int) -> list[Any]:
    """Two rectangles, cut across the longer side at the centre of mass; none where light is in a single cell."""
    weight = grid.moments[..., 0]
    some, means, variances = weight[slice(*box[0]), slice(*box[1])], [], []
    for axis in (0, 1):
        along, index = some.sum(axis=1 - axis), np.arange(some.shape[axis])
        means.append(np.sum(index * along) / np.sum(along))
        variances.append(np.sum((index - means[-1]) ** 2 * along))
    row = grid.corner[0] + grid.step * (box[0][0] + means[0] + 0.5)
    shrink = np.sin(np.pi * row / height) * 2 * height / width
    axis = int(variances[0] < variances[1] * shrink**2 * (1 - SAME))
    axis = axis if variances[axis] else 1 - axis
    if not variances[axis]:
        return []
    first, last = box[axis]
    middle = first + int(np.clip(np.floor(means[axis] + SAME) + 1, 1, last - first - 1))
    return [[*box[:axis], part, *box[axis + 1 :]] for part in ((first, middle), (middle, last))]


def _patches(sums: np.ndarray, channels: int) -> Patches:
    mean = sums[:, 1:4] / sums[:, :1]
    covariance = (sums[:, 4:13] / sums[:, :1]).reshape(-1, 3, 3) - mean[:, :, None] * mean[:, None, :]
    return Patches(sums[:, -channels:] / np.pi, mean, covariance)
