"""Light from all around: the same from everywhere, or a lat-long map.

Axes of a map, those of Mitsuba's ``envmap``: y is up, so the first row is seen along +y; left and right edge of the map
are seen along -z, a quarter of the width from the left along +x, the middle along +z, three quarters along -x. With
u to the right and v down, both from 0 to 1, the direction is (sin 2πu sin πv, cos πv, -cos 2πu sin πv). A texel shines
from its whole solid angle, (cos θ₁ - cos θ₂) Δφ.

Where the samples go. The map is cut along rows and columns into as many rectangles as there are samples, always the one
next whose light is spread most (energy times variance of its directions), through its centre of mass. So samples crowd
where the light is; a map with one bright texel costs one sample, unless the texels are wide and are cut up themselves.
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
FEWEST_ROWS = 128
"""A map of fewer has wide texels, which are cut up too: in so many rows, and twice as many columns, at least."""


class ConstantEnvironment(Light):
    """The same radiance from everywhere.

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
        samples: how many light samples at most, at least 2.

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


def cut(pixels: Float[np.ndarray, "H W C"], samples: int) -> Patches:
    """Cut a map into rectangles, see the module."""
    for axis, fewest in enumerate((FEWEST_ROWS, 2 * FEWEST_ROWS)):
        pixels = np.repeat(pixels, -(-fewest // pixels.shape[axis]), axis)
    moments = _texel_moments(pixels * _solid_angles(*pixels.shape[:2])[..., None])
    while moments.shape[0] * moments.shape[1] > LARGEST_MAP:
        for axis in (0, 1):
            moments = np.add.reduceat(moments, np.arange(0, moments.shape[axis], 2), axis=axis)

    def entry(*box: tuple[int, int]) -> tuple[float, Any]:
        """Largest spread first: energy times variance of the directions, which is what is left of their length 1.

        Four digits of it: of rectangles that are alike the first comes first, whatever rounding makes of them.
        """
        energy, *first = moments[slice(*box[0]), slice(*box[1]), :4].sum(axis=(0, 1))
        variance = 1.0 - np.sum((np.array(first) / energy) ** 2) if energy > 0 else 0.0
        spread = energy * variance if variance > 1e-12 else 0.0  # rounding aside
        return -float(f"{spread:.4g}"), box

    heap, done = [entry((0, moments.shape[0]), (0, moments.shape[1]))], []
    while heap and len(heap) + len(done) < samples:
        negative_spread, box = heapq.heappop(heap)
        halves = _halves(moments[..., 0], box) if negative_spread else None
        if halves is None:
            done.append(box)
        for half in halves or ():
            heapq.heappush(heap, entry(*half))
    boxes = sorted(done + [box for _, box in heap])
    sums = np.stack([moments[slice(*rows), slice(*columns)].sum(axis=(0, 1)) for rows, columns in boxes])
    return _patches(sums[sums[:, 0] > 0], pixels.shape[2])


def _texel_moments(energy: np.ndarray) -> np.ndarray:
    """Per texel: energy, its products with the direction (3) and with pairs of its axes (9), energy of each channel.

    Means over the texel's solid angle, by integrals of sines and cosines of the angles down and about.
    """
    height, width = energy.shape[:2]
    step, down = 2 * np.pi / width, np.linspace(0.0, np.pi, height + 1)[:, None]
    cos, sin, middle = np.cos(down), np.sin(down), step * (np.arange(width) + 0.5)
    solid, pair = -np.diff(cos, axis=0), (cos[1:] ** 2 + cos[1:] * cos[:-1] + cos[:-1] ** 2) / 3
    across, slant = np.diff(0.5 * (down - sin * cos), axis=0) / solid, np.diff(sin**3, axis=0) / (3 * solid)
    x, z = (np.sin(step / 2) / (step / 2) * one for one in (np.sin(middle), -np.cos(middle)))
    double_x, double_z = (np.sin(step) / step * one for one in (np.cos(2 * middle), -np.sin(2 * middle)))
    xx, zz, xz = (1 - pair) * (1 - double_x) / 2, (1 - pair) * (1 + double_x) / 2, (1 - pair) * double_z / 2
    xy, yz, y = slant * x, slant * z, (cos[1:] + cos[:-1]) / 2
    means = [across * x, y, across * z, xx, xy, xz, xy, pair, yz, xz, yz, zz]
    weight = energy.sum(axis=-1)
    return np.concatenate([np.stack([weight, *(weight * one for one in means)], axis=-1), energy], axis=-1)


def _halves(weight: np.ndarray, box: Any) -> list[Any] | None:
    """Two rectangles, cut across the longer side at the centre of mass; None for a single texel."""
    height, width = weight.shape
    some, means, variances = weight[slice(*box[0]), slice(*box[1])], [], []
    for axis in (0, 1):
        along, index = some.sum(axis=1 - axis), np.arange(some.shape[axis])
        means.append(np.sum(index * along) / np.sum(along))
        variances.append(np.sum((index - means[-1]) ** 2 * along))
    shrink = np.sin(np.pi * (box[0][0] + means[0] + 0.5) / height) * 2 * height / width
    axis = int(variances[0] < variances[1] * shrink**2 * (1 - SAME))
    axis = axis if variances[axis] else 1 - axis
    if not variances[axis]:
        return None
    first, last = box[axis]
    middle = first + int(np.clip(np.floor(means[axis] + SAME) + 1, 1, last - first - 1))
    return [[*box[:axis], part, *box[axis + 1 :]] for part in ((first, middle), (middle, last))]


def _patches(sums: np.ndarray, channels: int) -> Patches:
    mean = sums[:, 1:4] / sums[:, :1]
    covariance = (sums[:, 4:13] / sums[:, :1]).reshape(-1, 3, 3) - mean[:, :, None] * mean[:, None, :]
    return Patches(sums[:, -channels:] / np.pi, mean, covariance)
