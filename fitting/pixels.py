"""What a fit looks at: the pixels of a picture that count.

A large picture is looked at a band of rows at a time: what its pixels see takes three times the memory of the picture,
and what the engine needs of that a third of it. A picture in a file is not even kept itself: `fitting.solver.streams`.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

import brdf
from brdf.errors import InputError
from fitting.pixel_statistics import FLAT, SYMMETRIC_PIXELS, TOP, Survey, inverse_variance, lit_at_top, survey
from fitting.problem import check_levels, check_sizes, check_weight, per_pixel, pixels_of
from fitting.solver.streams import Stream, each

# How many pixels are looked at together; of a file at least as many rows as its blocks hold, or these are read twice.
TILE_PIXELS = 1 << 18
ALIGNED_ROWS = 64
# Largest value, and inverse of the least, of a picture in single precision: squares of it, of rounding errors a million
# times smaller, and sums over millions of pixels have to stay in its range of 1e-38 to 3e38; double precision reaches
# far beyond what a file can hold.
SINGLE, DOUBLE = 1e12, 1e140
# A file is shown by no more pixels than this along each side.
SHOWN_PIXELS = 1024


class Tile(NamedTuple):
    """A picture, or a band of its rows, ready for the engine.

    Attributes:
        target: (P, C), in the precision of the fit.
        weight: (P,), 0 where the pixel does not count; None where all do, and alike.
        points: what the pixels see, (rows, W).
    """

    target: Float[Array, "P C"]
    weight: Float[Array, " P"] | None
    points: brdf.SurfacePoints


class Observation(NamedTuple):
    """One picture.

    Attributes:
        tiles: all of it, made when asked for.
        in_memory: the picture is; else what is made of it must not be kept either.
        left_out: how many pixels were left out, by reason.
        noise: standard deviation of the error that rounding puts into a value; (C,).
        brightest: largest size of a value that counts; (C,).
        shown: (H, W, C), the picture for people: of a large file every so many pixels.
        scene: what ``shown`` shows.
        counted: (H, W), which pixels of ``shown`` counted.
    """

    tiles: Sequence[Tile]
    in_memory: bool
    left_out: dict[str, int]
    noise: Float[np.ndarray, " C"]
    brightest: Float[np.ndarray, " C"]
    shown: Float[np.ndarray, "H W C"]
    scene: brdf.Scene
    counted: Bool[np.ndarray, "H W"]


class _Band(NamedTuple):
    """Pixels before it is decided which of them count.

    Attributes:
        first: row of the picture.
        values: (P, C), on the host or on the device.
        points: what they see, (rows, W).
        seen: whether they see a fitted shape, (P,).
        looked_at: whether they also are inside the mask, (P,).
    """

    first: int
    values: Float[Array, "P C"]
    points: brdf.SurfacePoints
    seen: Bool[Array, " P"]
    looked_at: Bool[Array, " P"]


def observe(
    target: Any,
    scene: brdf.Scene,
    *,
    dtype: Any,
    mask: Any = None,
    saturation: float | None = None,
    dark: float | None = None,
    noise: tuple[float, float] | None = None,
    weight: Any = None,
    at_once: bool = False,
) -> Observation:
    """Decide which pixels of a picture count.

    Args:
        target: (H, W) or (H, W, C) linear values; a `brdf.Picture`, which knows its largest code; or a
            `brdf.ImageReader`, of which a band of rows is in memory at a time.
        scene: of the same resolution.
        dtype: float32 or float64.
        mask: (H, W), pixels to look at.
        saturation: linear value from which on pixels are clipped; None finds out.
        dark: linear value up to which pixels are too dark to count: none of their channels exceeds it.
        noise: of the camera, (read, shot): the variance of a value is read² + shot · value, and pixels weigh by it.
        weight: (H, W), at least 0, how much each pixel counts beside that.
        at_once: make one tile of the picture, however large it is.

    Raises:
        InputError: where nothing is left to fit, or the arguments do not belong together.
    """
    noise = check_levels(saturation, dark, noise)
    pixels, known_saturation, step = pixels_of(target)
    check_sizes(pixels, scene)
    height, width, channels = pixels.shape
    mask = None if mask is None else per_pixel("mask", mask, (height, width)).astype(bool)
    if weight is not None:
        weight = check_weight(weight, (height, width))
        # What weighs nothing says nothing of clipping or rounding either.
        mask = weight > 0 if mask is None else mask & (weight > 0)
    streamed = isinstance(pixels, brdf.ImageReader)
    if streamed and noise is not None:
        remedy = "Give the picture in memory, or weight in place of noise"
        raise InputError("noise", "needs the whole picture at once, the target is read by bands", remedy)
    averaged = scene.camera is not None and scene.camera.samples > 1
    averaged |= scene.points is not None and scene.points.area is not None
    if streamed and averaged:
        remedy = "Take samples out of the camera, or give the picture in memory"
        raise InputError("target", "is read by bands, where every pixel is seen at its centre", remedy)
    rows = max(TILE_PIXELS // width, ALIGNED_ROWS if streamed else 1)
    rows = height if at_once or noise is not None or averaged else rows
    bands = _bands(pixels, scene, dtype, mask, rows)
    level = known_saturation if saturation is None else saturation
    total, goods = _look(bands, dark, level, keep=not streamed)
    reach = SINGLE if dtype == np.float32 else DOUBLE
    size = max(total.largest, float(np.max(total.scale)))
    if size > 0 and not 1 / reach <= size <= reach:
        came = f"has {size:.3g} as its largest value, out of reach of {dtype.name}"
        raise InputError("target", came, "Bring it nearer to 1 (another exposure), or fit in float64")
    if level is None and total.largest > 0 and total.top > SYMMETRIC_PIXELS and scene.lights:
        level = _plateau(bands, goods, total.largest, scene, dark)
        if level is not None:
            total, goods = _look(bands, dark, level, keep=not streamed)
    left_out = _left_out(total, height * width, masked=mask is not None, level=level, dark=dark)

    kept: dict[int, Any] = {}

    def counts(band: _Band) -> Float[Array, " P"] | None:
        good = goods[band.first] if band.first in goods else _survey(band, dark, level)[0]
        found = None if total.above == height * width else jnp.asarray(good, dtype)
        if noise is not None:
            found = inverse_variance(band.values, jnp.asarray(good), (height, width), *noise, step)
        if weight is not None:
            given = weight[band.first : band.first + band.points.mask.shape[0]]
            given = jnp.asarray(given.ravel(), dtype)
            found = given if found is None else given * found
        return found

    def tile(band: _Band) -> Tile:
        if streamed:
            return Tile(band.values, counts(band), band.points)
        if band.first not in kept:
            kept[band.first] = counts(band)
        return Tile(band.values, kept[band.first], band.points)

    tiles = each(tile, bands)
    resolution = max(float(np.finfo(dtype).eps), 0.0 if streamed else float(np.finfo(pixels.dtype).eps))
    scale = total.scale.astype(np.float64)
    rounding = np.maximum(scale * resolution, step / np.sqrt(12.0))
    if streamed:
        shown = _shown(tiles, scene, channels)
    else:
        counted = np.concatenate(list(goods.values())).reshape(height, width)
        shown = pixels.astype(dtype, copy=False), scene, counted if weight is None else counted & (weight > 0)
    return Observation(tiles, not streamed, left_out, rounding, scale, *shown)


def _bands(pixels: Any, scene: brdf.Scene, dtype: Any, mask: np.ndarray | None, rows: int) -> Sequence[_Band]:
    height, _, channels = pixels.shape

    place = brdf.cast(scene, dtype.name)
    if not isinstance(pixels, brdf.ImageReader):
        pixels = np.asarray(pixels, dtype)

    def values(first: int, last: int) -> Float[Array, "P C"]:
        if isinstance(pixels, brdf.ImageReader):
            return jnp.asarray(pixels.rows(first, last).reshape(-1, channels), dtype)
        # A view: on the device all bands together would be the picture once more.
        return cast(Array, pixels[first:last].reshape(-1, channels))

    def band(first: int, last: int, points: brdf.SurfacePoints) -> _Band:
        seen = jnp.ravel(points.mask)
        looked_at = seen if mask is None else seen & mask[first:last].ravel()
        return _Band(first, values(first, last), points, seen, looked_at)

    if rows >= height:
        whole = band(0, height, place.surface_points())
        return [whole._replace(values=jnp.asarray(whole.values))]
    rows -= rows % ALIGNED_ROWS if rows > ALIGNED_ROWS else 0
    spans = [(first, min(first + rows, height)) for first in range(0, height, rows)]
    return Stream(lambda i: band(*spans[i], place.surface_points(spans[i])), len(spans))


def _survey(band: _Band, dark: float | None, level: float | None) -> tuple[Any, Survey]:
    limits = -np.inf if dark is None else dark, np.inf if level is None else level
    return jax.device_get(survey(band.values, band.seen, band.looked_at, *limits))


def _look(
    bands: Sequence[_Band], dark: float | None, level: float | None, *, keep: bool
) -> tuple[Survey, dict[int, Any]]:
    """What there is to know of all; and which pixels count, by the first row of the band, if that is to be kept."""
    total, goods = None, {}
    for band in bands:
        good, found = _survey(band, dark, level)
        total = found if total is None else total + found
        if keep:
            goods[band.first] = good
    assert total is not None
    return total, goods


def _plateau(
    bands: Sequence[_Band], goods: dict[int, Any], largest: float, scene: brdf.Scene, dark: float | None
) -> float | None:
    """The level at which a picture is clipped: many pixels at exactly the largest value, on a surface lit unevenly."""
    ranges = []
    for band in bands:
        good = goods.get(band.first)
        found = lit_at_top(
            band.values, _survey(band, dark, None)[0] if good is None else good, largest, band.points, scene
        )
        ranges += [] if found is None else [found]
    if not ranges:
        return None
    low, high = min(low for low, _ in ranges), max(high for _, high in ranges)
    return None if high - low <= FLAT * high else largest * TOP


def _left_out(total: Survey, pixels: int, *, masked: bool, level: float | None, dark: float | None) -> dict[str, int]:
    """How many pixels do not count, by reason; an error where none is left."""
    left_out = {"outside the fitted shapes": int(pixels - total.seen)}
    if not total.seen:
        raise InputError("target", "has no pixel that sees a fitted shape", "Check camera, shapes and mask")
    if masked:
        left_out["masked"] = int(total.seen - total.looked_at)
        if not total.looked_at:
            raise InputError("mask", "leaves no pixel that sees a fitted shape", "Check the mask")
    left_out["not finite"] = int(total.looked_at - total.finite)
    if not total.finite:
        raise InputError("target", "has no finite value on the object", "Give a picture with values")
    if level is not None:
        left_out["clipped"] = int(total.finite - total.below)
        if not total.below or (total.below < total.finite and total.above and not total.scale.any()):
            came = f"is clipped at {level:g} wherever it sees the object"
            raise InputError("target", came, "Give a darker exposure or a higher saturation")
    if dark is not None:
        left_out["dark"] = int(total.below - total.above)
        if not total.above:
            came = f"is no brighter than {dark:g} wherever it counts"
            raise InputError("target", came, "Give a brighter picture or a lower dark level")
    if not total.scale.any():
        raise InputError("target", "is black on the object", "Give a picture with light in it")
    return left_out


def _shown(tiles: Sequence[Tile], scene: brdf.Scene, channels: int) -> tuple[np.ndarray, brdf.Scene, np.ndarray]:
    """Every so many pixels of a picture that is not in memory, what they show, and which of them counted."""
    width, height = scene.resolution
    stride = -(-max(width, height) // SHOWN_PIXELS)
    pictures, counted, first = [], [], 0
    for tile in tiles:
        rows = tile.points.mask.shape[0]
        some = slice(-first % stride, None, stride)
        # Copies: a view would keep the whole tile.
        pictures.append(np.asarray(tile.target).reshape(rows, width, channels)[some, ::stride].copy())
        weight = np.ones(rows * width) if tile.weight is None else np.asarray(tile.weight)
        counted.append((weight > 0).reshape(rows, width)[some, ::stride].copy())
        first += rows
    pixel = np.arange(0, height, stride)[:, None] * width + np.arange(0, width, stride)
    dtype = pictures[0].dtype.name
    return np.concatenate(pictures), brdf.some_pixels(scene, pixel, precision=dtype), np.concatenate(counted)
