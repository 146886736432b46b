"""Which pixels of a picture count, and how much.

A large picture is taken a band of rows at a time: what its pixels see takes three times the memory of the picture, and
what the solver needs of that a third of it. A picture in a file is not even kept itself: `fitting.solver.streams`.
"""

import dataclasses
import functools
import itertools
from collections import Counter
from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

import brdf
from brdf.errors import InputError
from brdf.geometry.rays import Sight
from brdf.models.base import SpecularMaterial
from brdf.precision import Precision, at_a_time
from fitting.codes import Rounding, open_ends
from fitting.light_colour import take_colour_out
from fitting.likelihood import over_channels
from fitting.problem import TOP, FitProblem, Target, as_target, has_pixel_areas
from fitting.solver.devices import device_count
from fitting.solver.normal_equations import COMPILER_OPTIONS, FEW_VALUES, totals
from fitting.solver.streams import Stream, each, joined
from fitting.tile import Tile

# How many pixels are taken together; of a file at least as many rows as its blocks hold, or these are read twice.
TILE_PIXELS = 1 << 18
ALIGNED_ROWS = 64
# Pictures of no more pixels are not cut into tiles, whose geometry is made anew for each pass over them.
KEPT_PIXELS = 1 << 22
# Largest value, and inverse of the least, of a picture in single precision: squares of it, of rounding errors a million
# times smaller, and sums over millions of pixels have to stay in its range of 1e-38 to 3e38; in double precision
# their sixth powers do (how the noise grows with brightness), still far beyond what a file can hold.
SINGLE, DOUBLE = 1e12, 1e48
# What is left of a picture without noise in double precision, over its brightest value, tells where the search stopped.
CONVERGED = 1e-10
# A file is shown by no more pixels than this along each side.
SHOWN_PIXELS = 1024
# So many equal largest values symmetry may make; then others of the largest come in pairs, too: so many are looked at.
SYMMETRIC_PIXELS, OTHERS = 8, 32
# Where the diffuse basis varies by less than this over the plateau, the surface is flat there and nothing is clipped.
FLAT = 1e-3


class Observed(NamedTuple):
    """A problem whose pixels are known: what stays the same for every model.

    Attributes:
        problem: what is fitted.
        colour: what all lights share, taken out of the tiles' scenes, (C,).
        tiles: of all pictures, made when asked for; a stream where one of them is.
        owner: of which picture each tile is.
        roundings: standard deviation of the error that rounding, or the search, puts into a value of each picture,
            times the root of the picture's weight, (K, C).
        brightest: largest size of a value that counts, (C,).
        limits: beyond which pixels of each picture were left out by what they show, as dark or clipped.
        left_out: how many pixels were left out, by reason.
        shown: the pictures for people, (H, W, C) each: of a large file every so many pixels.
        scenes: what these show.
        counted: which of their pixels counted, in every channel, (H, W) each.
        weights: how much they did, (H, W) each; None where all alike.
    """

    problem: FitProblem
    colour: Float[np.ndarray, " C"]
    tiles: Sequence[Tile]
    owner: Sequence[int]
    roundings: Float[np.ndarray, "K C"]
    brightest: Float[np.ndarray, " C"]
    limits: list[tuple[float, float]]
    left_out: dict[str, int]
    shown: list[np.ndarray]
    scenes: list[brdf.Scene]
    counted: list[np.ndarray]
    weights: list[np.ndarray | None]

    @property
    def widths(self) -> list[int]:
        """Of the picture of each tile."""
        return [self.problem.targets[picture].pixels.shape[1] for picture in self.owner]

    @property
    def limited(self) -> bool:
        """Whether pixels were left out by what they show."""
        return bool(np.isfinite(np.asarray(self.limits)).any())

    @property
    def rounding(self) -> Float[np.ndarray, " C"]:
        """The largest of any picture."""
        return np.max(self.roundings, axis=0)

    @property
    def copies(self) -> bool:
        """Whether the channels are copies of each other: grey that was saved as colour."""
        return all(_grey(picture) for picture in self.shown)

    def result_fields(self) -> dict[str, Any]:
        """What a `FitResult` says of the pictures."""
        targets = self.problem.targets
        return {
            "left_out": self.left_out,
            "loss": self.problem.loss,
            "precision": self.problem.precision,
            "targets": self.shown,
            "scenes": self.problem.shown or self.scenes,
            "counted": self.counted,
            "weights": self.weights,
            "files": [target.file for target in targets],
            "levels": next((one.codes.levels for one in targets if one.codes is not None), ""),
        }

    def reached(self, model: type[brdf.Material]) -> Bool[np.ndarray, "3 C"]:
        """Which coefficients of a model the light reaches."""
        reached = np.zeros((3, self.colour.size), bool)
        for scene in self.problem.scenes:
            if scene.ambient is not None:
                reached[0] |= np.asarray(scene.ambient) > 0
            for light in scene.lights:
                reached[1] |= np.asarray(light.emittance) > 0
        reached[2] = reached[1] & issubclass(model, SpecularMaterial)
        return reached


class _Band(NamedTuple):
    """Pixels before it is decided which of them count; ``values`` (P, C) lie on the host or on the device."""

    rows: slice
    values: Any
    points: Sight
    allowed: Any


class Statistics(NamedTuple):
    """What there is to know of the pixels of a picture, or of some of its bands together.

    Attributes:
        counts: pixels that see a fitted shape; of these inside the mask; of these finite; of these not clipped in any
            channel; of these, or of those with a channel that is not, not too dark.
        largest: finite value of any channel.
        top: how many pixels share it.
        least: value of any pixel, seen or not.
        scale: largest size of a value that counts and is not clipped, (C,).
    """

    counts: Any
    largest: Any
    top: Any
    least: Any
    scale: Any


def observe(problem: FitProblem, *, at_once: bool = False) -> Observed:
    """Decide which pixels of each picture count, refused where none is left; in one tile where at once."""
    colour, grey = take_colour_out(problem.scenes, problem.targets[0].pixels.shape[-1])
    given = zip(problem.targets, problem.scenes, grey, problem.masks, problem.weights, strict=True)
    parts = []
    for index, picture in enumerate(given):
        try:
            parts.append(_observe(problem, at_once, *picture))
        except InputError as error:
            names = {name: f"{name}[{index}]" for name in ("target", "mask")} if len(problem.targets) > 1 else {}
            raise error.renamed(names) from None
    tiles, rounding, brightest, limits, counts, shown, scenes, counted, weights = map(list, zip(*parts, strict=True))
    left_out: Counter[str] = Counter()
    for some in counts:
        left_out.update(some)
    return Observed(
        problem,
        colour,
        joined(tiles),
        [picture for picture, some in enumerate(tiles) for _ in range(len(some))],
        np.stack(rounding),
        np.max(brightest, axis=0),
        limits,
        dict(left_out),
        shown,
        scenes,
        counted,
        weights,
    )


def _grey(picture: np.ndarray) -> bool:
    if picture.shape[-1] == 1:
        return False
    some = picture[:: max(1, picture.shape[0] // 8)]
    return all(
        np.array_equal(image[..., 0], image[..., channel], equal_nan=True)
        for image in (some, picture)
        for channel in range(1, picture.shape[-1])
    )


def _observe(
    problem: FitProblem, at_once: bool, target: Target, scene: brdf.Scene, grey: brdf.Scene, mask: Any, given: Any
) -> tuple[Any, ...]:
    """Tiles, rounding, brightest value, limits, pixels left out, and what is shown: see `Observed`."""
    dtype, noise, dark = np.dtype(problem.precision), problem.noise, problem.dark
    height, width = target.pixels.shape[:2]
    grey = brdf.cast(grey, problem.precision)
    bands = _bands(target, grey, dtype, mask, at_once or noise is not None)
    level = target.saturation if problem.saturation is None else problem.saturation
    # Other losses, dark levels and steps of 0 are ways of one's own to say what pixels say.
    plain = dark is None and problem.loss == "squared" and not target.least_squares and not target.streamed
    # Where one channel is clipped the others say what they say.
    apart = plain and target.pixels.shape[2] > 1
    found, total = _statistics(bands, level, dark, apart=apart, keep=not target.streamed)
    reach = SINGLE if dtype == np.float32 else DOUBLE
    size = max(float(total.largest), float(np.max(total.scale)))
    if size > 0 and not 1 / reach <= size <= reach:
        what = f"has {size:.3g} as its largest value, out of reach of {dtype.name}"
        raise InputError("target", what, "Bring it nearer to 1 (another exposure), or fit in float64")
    # Where all of a single picture share one value nothing is below it: it is a constant, not a level.
    constant = total.top == total.counts[2] and len(problem.targets) == 1
    if level is None and total.largest > 0 and total.top > 1 and not constant and scene.lights:
        many = total.top > SYMMETRIC_PIXELS
        level = (
            _plateau(bands, found, float(total.largest), grey) if many else _few_at_top(bands, found, int(total.top))
        )
        if level is not None:
            found, total = _statistics(bands, level, dark, apart=apart, keep=not target.streamed)
    left_out = _left_out(total, height * width, level, dark, masked=mask is not None)

    def tile(band: _Band, counted: tuple[np.ndarray, Statistics]) -> Tile:
        good, weight, spread = counted[0], None, 1.0
        if noise is not None:
            seen = np.asarray(band.allowed) & np.all(np.isfinite(np.asarray(band.values)), axis=-1)
            values = np.where(seen[:, None], np.asarray(band.values), 0.0).reshape(target.pixels.shape)
            variance = _variance(values, seen.reshape(height, width), *map(float, noise))
            rounded = variance + target.step**2 / 12.0
            weight = (good[:, None] / (rounded * np.mean(1 / rounded[good]))).astype(dtype)
            weight = weight[:, 0] if weight.shape[1] == 1 else weight
            # Of the values as they were before rounding, over that of the surest.
            spread = np.sqrt(variance / np.min(variance[good]))
        elif total.counts[-1] < height * width:
            weight = good.astype(dtype)
        if given is not None:
            stated = given[band.rows].ravel().astype(dtype)
            weight = stated if weight is None else (stated * weight.T).T
            spread = spread / np.sqrt(np.where(stated > 0, stated, 1.0))[:, None]
        bounds = None
        if plain:
            valid, (_, allowed, finite, *_) = np.asarray(band.allowed), counted[1].counts
            if finite < allowed:
                valid = valid & np.all(np.isfinite(np.asarray(band.values)), axis=-1)
            if target.codes is not None:
                bounds = target.codes.bounds(band.rows, valid, level, spread)
            else:
                # Where a camera reads without noise no photon came to what is 0, and nothing was cut off.
                floor = total.least if noise is None or noise[0] > 0 else -np.inf
                bounds = open_ends(np.asarray(band.values), valid, floor, level, spread, width)
        if apart and level is not None:
            below = good[:, None] & (np.asarray(band.values) < level)
            if np.count_nonzero(below) < below.shape[1] * np.count_nonzero(good):
                weight = below.astype(dtype) * (1 if weight is None else weight.reshape(len(weight), -1))
        return Tile(band.values, None if weight is None else jax.device_put(weight), band.points, grey, bounds)

    tiles = each(tile, bands, found)
    brightest = total.scale.astype(np.float64)
    resolution = max(float(np.finfo(dtype).eps), CONVERGED)
    if target.streamed:
        values, thinned, allowed, weights = _thinned(target, scene, problem.precision, mask, given)
        thin = _bands(target._replace(pixels=values), thinned, dtype, allowed, at_once=True)
        (counted, _), *_ = _statistics(thin, level, dark, apart=apart, keep=True)[0]
        shown = values.astype(dtype, copy=False), thinned, counted.reshape(values.shape[:2])
        weights = None if weights is None else weights * shown[-1]
    else:
        resolution = max(resolution, float(np.finfo(target.pixels.dtype).eps))
        counted = np.concatenate([good for good, _ in found]).reshape(height, width)
        if apart and level is not None:
            # What looks at residuals looks at pixels that are whole, where there are any.
            whole = counted & np.all(np.asarray(target.pixels) < level, axis=-1)
            counted = whole if whole.any() else counted
        shown = target.pixels.astype(dtype, copy=False), scene, counted
        weights, weighed = None, given is not None or noise is not None
        if weighed or (apart and level is not None):
            own = [np.ones(len(one.target)) if one.weight is None else np.asarray(one.weight) for one in tiles]
            # Where a channel is clipped and others are not these have weights of their own.
            several = max(one.ndim for one in own) > 1
            if several:
                own = [np.broadcast_to(one.T, tile.target.shape[::-1]).T for one, tile in zip(own, tiles, strict=True)]
            if weighed or several:
                weights = np.concatenate(own).reshape(target.pixels.shape if several else (height, width))
    rounding = np.maximum(brightest * resolution, target.step / np.sqrt(12.0))
    # Where pixels tell by likelihood an end says what it says, and plain least squares is what it is.
    by_value = left_out.get("clipped") and not (plain or target.least_squares)
    limits = (dark if left_out.get("dark") else -np.inf), (level if by_value else np.inf)
    return tiles, rounding, brightest, limits, left_out, *shown, weights


def _bands(
    target: Target, scene: brdf.Scene, dtype: np.dtype, mask: np.ndarray | None, at_once: bool
) -> Sequence[_Band]:
    height, width, channels = target.pixels.shape
    pixels = target.pixels if target.streamed else np.asarray(target.pixels, dtype)

    def band(first: int, last: int) -> _Band:
        points = scene.sight(None if last - first == height else (first, last))
        # Here and below through NumPy, or each conversion would be compiled.
        allowed = np.asarray(points.mask).ravel()
        if mask is not None:
            allowed = allowed & mask[first:last].ravel()
        if target.streamed:
            values = jnp.asarray(target.pixels.rows(first, last).reshape(-1, channels), dtype)
        else:
            # A view: on the device all bands together would be the picture once more.
            values = pixels[first:last].reshape(-1, channels)
        return _Band(slice(first, last), values, points, allowed)

    rows = max(at_a_time(TILE_PIXELS) // width, ALIGNED_ROWS if target.streamed else 1)
    rows = height if height * width <= KEPT_PIXELS and not target.streamed else rows
    rows = min(rows, -(-height // device_count()))
    if at_once or has_pixel_areas(scene) or rows >= height:
        whole = band(0, height)
        return [whole._replace(values=jax.device_put(whole.values))]
    rows -= rows % ALIGNED_ROWS if rows > ALIGNED_ROWS else 0
    return Stream(lambda i: band(i * rows, min((i + 1) * rows, height)), -(-height // rows))


def _statistics(
    bands: Sequence[_Band], level: float | None, dark: float | None, *, apart: bool, keep: bool
) -> tuple[Sequence[tuple[np.ndarray, Statistics]], Statistics]:
    """Which pixels of each band count and what there is to know of them, made anew where not kept; and of all."""
    limits = np.inf if level is None else level, -np.inf if dark is None else dark

    def of_band(band: _Band) -> tuple[np.ndarray, Statistics]:
        seen = np.count_nonzero(band.points.mask), np.count_nonzero(band.allowed)
        if band.values.size > FEW_VALUES:
            good, own = _count_many(band.values, band.allowed, *limits, apart=apart)
        else:
            with np.errstate(invalid="ignore", over="ignore"):
                good, own = _count(np.asarray(band.values), band.allowed, *limits, apart=apart, xp=np)
        return good, own._replace(counts=(*seen, *own.counts))

    def together(one: Statistics, other: Statistics) -> Statistics:
        largest = max(one.largest, other.largest)
        top = sum(int(part.top) for part in (one, other) if part.largest >= largest * TOP)
        least, scale = min(one.least, other.least), np.maximum(one.scale, other.scale)
        return Statistics(np.add(one.counts, other.counts), largest, top, least, scale)

    found = each(of_band, bands)
    # Those that are kept are under way together.
    found = jax.device_get(list(found)) if keep else each(jax.device_get, found)
    return found, functools.reduce(together, (statistics for _, statistics in found))


def _count(values: Any, allowed: Any, level: float, dark: float, *, apart: bool, xp: Any) -> tuple[Any, Statistics]:
    """Which pixels count, and what there is to know of them, in NumPy or JAX; apart, those with a channel below."""
    brightest, dimmest = (over_channels(choose, values) for choose in (xp.maximum, xp.minimum))
    whole = xp.isfinite(over_channels(xp.add, values))
    finite = allowed & whole
    below = finite & (brightest < level)
    good = (finite & (dimmest < level) if apart else below) & (brightest > dark)
    masks, bright = (finite, below, good), xp.where(finite, brightest, -xp.inf)
    sizes = [xp.where(good & (one < level), xp.abs(one), 0) for one in (values[:, c] for c in range(values.shape[1]))]
    terms = [*(mask.astype(np.int32) for mask in masks), bright, *sizes]
    found = totals(terms, ["add"] * len(masks) + ["maximum"] * (1 + len(sizes)), (0,))
    counts, (largest, *scale) = found[: len(masks)], found[len(masks) :]
    top = xp.count_nonzero(bright >= largest * TOP)
    least = xp.min(xp.where(whole, dimmest, xp.inf))
    return good, Statistics(tuple(counts), largest, top, least, xp.stack(scale))


_count_many = jax.jit(partial(_count, xp=jnp), static_argnames="apart", compiler_options=COMPILER_OPTIONS)


def _plateau(
    bands: Sequence[_Band], found: Sequence[tuple[np.ndarray, Statistics]], largest: float, scene: brdf.Scene
) -> float | None:
    """The level at which a picture is clipped: many pixels at exactly the largest value, on a surface lit unevenly."""
    low, high = np.inf, -np.inf
    for band, (good, _) in zip(bands, found, strict=True):
        top = good & (np.max(np.asarray(band.values), axis=-1) >= largest * TOP)
        if top.any():
            diffuse = brdf.basis_images(brdf.Lambert, scene, points=band.points).diffuse
            light = np.max(np.asarray(diffuse).reshape(top.size, -1), axis=-1)[top]
            low, high = min(low, float(np.min(light))), max(high, float(np.max(light)))
    return None if high - low <= FLAT * high else largest * TOP


def _few_at_top(bands: Sequence[_Band], found: Sequence[tuple[np.ndarray, Statistics]], top: int) -> float | None:
    """The level at which so few pixels are clipped: they show the largest value, and of the next no two are alike."""
    brightest = np.full(OTHERS + top, -np.inf)
    for band, (good, _) in zip(bands, found, strict=True):
        both = np.append(brightest, np.max(np.asarray(band.values)[good], axis=-1))
        brightest = np.partition(both, -brightest.size)[-brightest.size :]
    *others, largest = np.sort(brightest)[: OTHERS + 1].tolist()
    return largest * TOP if all(one < other * TOP for one, other in itertools.pairwise(others)) else None


def _left_out(
    total: Statistics, pixels: int, level: float | None, dark: float | None, *, masked: bool
) -> dict[str, int]:
    """How many pixels do not count, by reason; an error where none is left."""
    seen, allowed, finite, below, counted = (int(count) for count in total.counts)
    black = not total.scale.any()
    left_out = {"outside the fitted shapes": pixels - seen}
    if not seen:
        raise InputError("target", "has no pixel that sees a fitted shape", "Check camera, shapes and mask")
    if masked:
        left_out["masked"] = seen - allowed
        if not allowed:
            raise InputError("mask", "leaves no pixel that sees a fitted shape", "Check mask and alpha")
    left_out["not finite"] = allowed - finite
    if not finite:
        raise InputError("target", "has no finite value on the object", "Give a picture with values")
    if level is not None:
        left_out["clipped"] = finite - below
        if not max(below, counted) or (below < finite and counted and black):
            where = "or black wherever" if counted else "wherever"
            what = f"is clipped at {level:.5g} {where} it sees the object"
            raise InputError("target", what, "Give a darker exposure or a higher saturation")
    if dark is not None:
        left_out["dark"] = below - counted
        if not counted:
            what = f"is no brighter than {dark:g} wherever it counts"
            raise InputError("target", what, "Give a brighter picture or a lower dark level")
    if black:
        raise InputError("target", "is black on the object", "Give a picture with light in it")
    return left_out


def _thinned(target: Target, scene: brdf.Scene, precision: Precision, *of_pixels: Any) -> tuple[Any, ...]:
    """Of a picture that is read by bands every so many pixels, what they show, and what else there is of each."""
    width, height = scene.resolution
    stride = -(-max(width, height) // SHOWN_PIXELS)
    pixel = np.arange(0, height, stride)[:, None] * width + np.arange(0, width, stride)
    values = []
    for first in range(0, height, ALIGNED_ROWS):
        rows = target.pixels.rows(first, min(first + ALIGNED_ROWS, height))
        values.append(rows[-first % stride :: stride, ::stride].copy())  # a view would keep the whole band
    rest = [None if one is None else one[::stride, ::stride] for one in of_pixels]
    return np.concatenate(values), brdf.some_pixels(scene, pixel, precision=precision), *rest


def in_memory(problem: FitProblem, rounding: Rounding) -> FitProblem:
    """With some pixels, evenly spread, of the pictures that are read by bands."""

    def some(target: Target, scene: brdf.Scene, *of_pixels: Any) -> tuple[Any, ...]:
        if not target.streamed:
            return target, scene, *of_pixels
        values, *rest = _thinned(target, scene, problem.precision, *of_pixels)
        picture = target.pixels.picture(values)
        # Pixels of a block of a JPEG are known by their neighbours.
        picture = picture if values.shape == target.pixels.shape else dataclasses.replace(picture, jpeg=None)
        return as_target(picture, rounding), *rest

    parts = zip(problem.targets, problem.scenes, problem.masks, problem.weights, strict=True)
    targets, scenes, masks, weights = map(list, zip(*(some(*one) for one in parts), strict=True))
    return dataclasses.replace(problem, targets=targets, scenes=scenes, masks=masks, weights=weights, shown=None)


def _variance(
    values: Float[np.ndarray, "H W C"], seen: Bool[np.ndarray, "H W"], read: float, shot: float
) -> Float[np.ndarray, "P C"]:
    """Of a camera's noise in each value.

    The value is the mean of 5 x 5 pixels: taken from the pixel itself, weights would favour what noise made darker.
    """
    from scipy.ndimage import uniform_filter  # it takes long to load

    total, known = (
        uniform_filter(image.astype(np.float64), size=5, mode="constant", axes=(0, 1))
        for image in (values, seen[..., None])
    )
    # A pixel that is seen is one of its 25.
    smooth = np.maximum(total / np.maximum(known, 1 / 25), 0.0)
    # Without read noise a black pixel would weigh infinitely much: a millionth of the mean stands in.
    least = 1e-6 * shot * np.mean(values[seen]) + np.finfo(values.dtype).tiny
    return np.maximum(read * read + shot * smooth, least).reshape(-1, values.shape[-1])
