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
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from brdf.checks import Spectrum, checked, sample_number, spectrum
from brdf.errors import InputError
from brdf.geometry.surface_points import Points
from brdf.lights.base import Light, LightSample
from brdf.lights.sample_sets import hemisphere_rule, ring_rule
from brdf.vectors import dot, normalize, perpendicular, square_root, trace

CONSTANT_SAMPLES = 512
MAP_SAMPLES = 1024
STEEPNESS = 7.0
"""The innermost samples of a lobe are exp(-this) times as far from its centre as the horizon."""
LARGEST_MAP = 1 << 21
"""Texels from which on a map is averaged before it is cut: 2048 × 1024."""
FEWEST_ROWS = 64
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
    type_name: ClassVar[str] = "environment"
    emits: ClassVar[tuple[int, ...]] = (0,)
    weighs: ClassVar[int | None] = 2

    def __check_init__(self):
        """Refuse a single sample."""
        if self.samples < 2:
            raise InputError("samples", "must be at least 2 here, got 1", "Give more")

    @property
    def rows(self) -> tuple[tuple[Any, ...], tuple[Any, ...]]:
        """The light, two rules over the hemisphere, and which of the two a row belongs to."""
        half = max(1, self.samples // 2)
        diffuse, lobe = hemisphere_rule(half), ring_rule(self.samples - half)
        rule = [np.concatenate(pair) for pair in zip(diffuse, lobe, strict=True)]
        lobe_only = np.repeat([0.0, 1.0], [diffuse.weight.size, lobe.weight.size])
        return (self.radiance,), (*rule, lobe_only)

    @staticmethod
    def sample(point: Points, *row: Any) -> LightSample:
        """From a patch of the hemisphere above the point."""
        radiance, s, t, weight, lobe_only = row
        normal, to_view = point.normal, point.to_view
        across, along = perpendicular(normal)
        outward = jnp.cos(2 * np.pi * t) * across + jnp.sin(2 * np.pi * t) * along
        even = s * normal + square_root(1.0 - s * s) * outward
        view = jnp.maximum(dot(normal, to_view), 1e-6)
        end = 0.25 * np.pi + 0.5 * jnp.arctan2(dot(outward, to_view), view)
        angle = end * jnp.expm1(STEEPNESS * s) / np.expm1(STEEPNESS)
        half = jnp.cos(angle) * normal + jnp.sin(angle) * outward
        view_half = dot(half, to_view)
        mirrored = 2.0 * view_half * half - to_view
        stretch = end * STEEPNESS * jnp.exp(STEEPNESS * s) / np.expm1(STEEPNESS)
        share = 8.0 * jnp.maximum(view_half, 0.0) * jnp.sin(angle) * stretch
        squared_radius = jnp.where(lobe_only > 0, share, 2.0) * weight
        to_light = normalize(even + lobe_only * (mirrored - even))
        intensity, radius = radiance * squared_radius, square_root(squared_radius)
        return LightSample(to_light, intensity, jnp.asarray(jnp.inf), radius, lobe_only=lobe_only)


Box = tuple[int, int, int, int]
"""A rectangle of the map: first row, row after the last, first column, column after the last."""


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
        radiance: (C,), what multiplies the map; (1,) brightens or darkens it.
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
    type_name: ClassVar[str] = "environment"
    emits: ClassVar[tuple[int, ...]] = (0, 1)
    weighs: ClassVar[int | None] = 0

    def __init__(self, pixels: Any, *, radiance: Any = 1.0, samples: int = MAP_SAMPLES):
        """Take a map's colour out where it has only one, and cut it up."""
        self.samples = sample_number(samples)
        pixels, factor = _checked(pixels), spectrum("radiance", radiance)
        channels = pixels.shape[2]
        if factor.shape[0] not in (1, channels):
            came = f"has {factor.shape[0]} channels, the map {channels}"
            raise InputError("radiance", came, "Give one factor, or one per channel of the map")
        # normalised by each channel's mean, so that the emittance tells the colour of the light
        energy = pixels * _solid_angles(*pixels.shape[:2])[..., None]
        colour = energy.sum(axis=(0, 1)) / (4 * np.pi)
        self.pixels = pixels / np.where(colour > 0, colour, 1.0)
        if np.ptp(self.pixels[..., colour > 0], axis=-1).max() <= 1e-6 * self.pixels.max():
            self.pixels = np.mean(self.pixels[..., colour > 0], axis=-1, keepdims=True)
        self.radiance = factor * colour
        self.patches = cut(np.asarray(self.pixels), self.samples)

    @property
    def rows(self) -> tuple[tuple[Any, ...], tuple[Any, ...]]:
        """The factor and the rectangles of the map."""
        return (self.radiance,), self.patches

    @staticmethod
    def sample(point: Points, *row: Any) -> LightSample:
        """The same at every point: the light of one rectangle of the map."""
        radiance, intensity, mean, covariance = row
        radius = square_root(2.0 * trace(covariance))  # that of a disc of the same variance
        moments = (mean, covariance)
        return LightSample(normalize(mean), radiance * intensity, jnp.asarray(jnp.inf), radius, moments)


def _checked(pixels: Any) -> np.ndarray:
    try:
        array = np.array(pixels, dtype=np.float64)
    except (TypeError, ValueError):
        raise InputError("pixels", "must be numbers", "Give an array of shape (H, W, C)") from None
    if array.ndim != 3 or 0 in array.shape:
        raise InputError("pixels", f"must be of shape (H, W, C), got {array.shape}", "Give a lat-long map")
    bad = ~(np.isfinite(array) & (array >= 0))
    if bad.any():
        lowest = np.min(array, where=np.isfinite(array), initial=0.0)
        count = np.count_nonzero(bad.any(axis=-1))
        message = f"environment map: {count} texels are negative or not finite (down to {lowest:g}); they count as 0."
        warnings.warn(message, UserWarning, stacklevel=3)
        array[bad] = 0.0
    if not array.any():
        raise InputError("pixels", "are all black", "Give a map with light in it, or leave the light out")
    return array


def _solid_angles(height: int, width: int) -> np.ndarray:
    edges = np.cos(np.linspace(0.0, np.pi, height + 1))
    return (-np.diff(edges) * 2 * np.pi / width)[:, None]


def map_directions(height: int, width: int) -> Float[np.ndarray, "H W 3"]:
    """The direction in which each texel's centre is seen, unit vectors."""
    turn = 2 * np.pi * (np.arange(width) + 0.5) / width
    down = np.pi * (np.arange(height)[:, None] + 0.5) / height
    x, z = np.sin(down) * np.sin(turn), -np.sin(down) * np.cos(turn)
    return np.stack([x, np.broadcast_to(np.cos(down), x.shape), z], axis=-1)


def cut(pixels: Float[np.ndarray, "H W C"], samples: int) -> Patches:
    """Cut a map into rectangles, see the module."""
    for axis, fewest in enumerate((FEWEST_ROWS, 2 * FEWEST_ROWS)):
        pixels = np.repeat(pixels, -(-fewest // pixels.shape[axis]), axis)
    moments = _texel_moments(pixels * _solid_angles(*pixels.shape[:2])[..., None])
    while moments.shape[0] * moments.shape[1] > LARGEST_MAP:
        for axis in (0, 1):
            moments = np.add.reduceat(moments, np.arange(0, moments.shape[axis], 2), axis=axis)
    table = np.pad(moments, np.array([(1, 0), (1, 0), (0, 0)])).cumsum(axis=0).cumsum(axis=1)

    def entry(box: Box) -> tuple[float, Box]:
        """Largest spread first: energy times variance of the directions, which is what is left of their length 1."""
        top, bottom, left, right = box
        sums = table[bottom, right] - table[top, right] - table[bottom, left] + table[top, left]
        if sums[0] <= 0:
            return 0.0, box
        variance = 1.0 - float(np.sum((sums[1:4] / sums[0]) ** 2))
        return -float(sums[0]) * variance if variance > 1e-12 else 0.0, box  # rounding aside

    heap = [entry((0, moments.shape[0], 0, moments.shape[1]))]
    done: list[Box] = []
    while heap and len(heap) + len(done) < samples:
        negative_spread, box = heapq.heappop(heap)
        halves = None if negative_spread == 0 else _halves(moments, box)
        if halves is None:
            done.append(box)
            continue
        for half in halves:
            heapq.heappush(heap, entry(half))
    boxes = sorted(done + [box for _, box in heap])
    sums = np.stack([moments[top:bottom, left:right].sum(axis=(0, 1)) for top, bottom, left, right in boxes])
    return _patches(sums[sums[:, 0] > 0], pixels.shape[2])


def _texel_moments(energy: np.ndarray) -> np.ndarray:
    """Per texel: energy, its products with the direction (3) and with pairs of its axes (9), energy of each channel."""
    directions = map_directions(*energy.shape[:2])
    pairs = (directions[..., :, None] * directions[..., None, :]).reshape(*energy.shape[:2], 9)
    weight = energy.sum(axis=-1, keepdims=True)
    return np.concatenate([weight, weight * directions, weight * pairs, energy], axis=-1)


def _halves(moments: np.ndarray, box: Box) -> list[Box] | None:
    """Two rectangles, cut across the longer side at the centre of mass; None for a single texel."""
    top, bottom, left, right = box
    weight = moments[top:bottom, left:right, 0]
    by_row, by_column = weight.sum(axis=1), weight.sum(axis=0)
    height, width = moments.shape[:2]
    row_mean, row_variance = _mean_and_variance(by_row)
    column_mean, column_variance = _mean_and_variance(by_column)
    shrink = np.sin(np.pi * (top + row_mean + 0.5) / height) * 2 * height / width
    if row_variance == 0 and column_variance == 0:
        return None
    if column_variance == 0 or (row_variance >= column_variance * shrink**2 and row_variance > 0):
        middle = top + int(np.clip(np.floor(row_mean) + 1, 1, bottom - top - 1))
        return [(top, middle, left, right), (middle, bottom, left, right)]
    middle = left + int(np.clip(np.floor(column_mean) + 1, 1, right - left - 1))
    return [(top, bottom, left, middle), (top, bottom, middle, right)]


def _mean_and_variance(weight: np.ndarray) -> tuple[float, float]:
    """Of the index, weighted."""
    index, total = np.arange(len(weight)), weight.sum()
    mean = float(np.sum(index * weight) / total)
    return mean, float(np.sum((index - mean) ** 2 * weight) / total)


def _patches(sums: np.ndarray, channels: int) -> Patches:
    mean = sums[:, 1:4] / sums[:, :1]
    covariance = (sums[:, 4:13] / sums[:, :1]).reshape(-1, 3, 3) - mean[:, :, None] * mean[:, None, :]
    # a single texel is a direction, exactly: what rounding leaves of its spread would blur the horizon
    single = np.trace(covariance, axis1=1, axis2=2) <= 1e-12
    covariance[single] = 0.0
    mean[single] /= np.linalg.norm(mean[single], axis=1, keepdims=True)
    return Patches(sums[:, -channels:] / np.pi, mean, covariance)
