"""What a picture vouches for: the codes behind its values, and how far each can be wrong.

| the picture | its codes | a value lay |
| --- | --- | --- |
| integer files, arrays | as stored, in steps as the codes used show (12 bits may stand in 16) | half a step around |
| half floats | the values | half a unit in the last place around |
| RGBE (.hdr) | the mantissas; channels share an exponent | up to a step above: the format truncates |
| float32 | none | where it is |

The largest code of an integer picture has no upper bound and 0 no lower one: that is clipping and cut-off noise.
A float array whose values all lie on the levels of one of these, or are whole numbers, is taken as such.
"""

import math
from typing import Any, Literal, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Float32, Int, UInt

from brdf.errors import InputError
from brdf.images.encoding import Encoding, decode, encode, rgbe_step
from brdf.images.jpeg import Jpeg
from fitting.likelihood import AnyArray, Bounds

Rounding = float | np.ndarray | Literal["floor"] | None
# Whether a picture lies on levels is told by so many values first.
_FIRST = 64
# So far from a code a value may lie that stands for it: rounding errors of float32, and of the curves.
_TOLERANCE = {255: 2e-3, 65535: 2e-2}
_CURVES: tuple[Encoding, ...] = ("linear", "srgb")
# So many values of a float picture share its least one where noise was cut off; symmetry makes up to eight equal.
_FEWEST_ENDS = 10
# Fewer different codes than this may be chance.
_FEWEST = 6
# Half of all codes are those of one bit less.
_FEWEST_STRETCHED = 32
# Beyond so many codes the basis images of single precision err by a good part of what the edges of codes tell.
FINE = 8192
# Pixels on a side of what a codec for photographs transforms together; twice that where colours have half the
# resolution.
BLOCK = 8
# So many values tell the usual step.
SOME_VALUES = 1 << 16
# Bits of a half float.
HALF = 16


class Codes(NamedTuple):
    """The codes of a picture, in units of their step.

    Attributes:
        values: (H, W, C).
        below: how far below its code a value may have lain, a number or (H, W, C).
        above: how far above.
        ends: codes whose lower and upper bound are open.
        scale: codes where the encoding is 1.
        encoding: "linear", "srgb" or a gamma.
        unit: radiance where the encoding is 1, a number or (C,).
        lossy: the file was compressed with losses.
        jpeg: how a JPEG was.
        levels: the files on whose levels all values lie, in words; empty where it was said that there are codes.
    """

    values: Float[np.ndarray, "H W C"]
    below: float | np.ndarray
    above: float | np.ndarray
    ends: tuple[float, float]
    scale: float
    encoding: Encoding
    unit: float | np.ndarray = 1.0
    lossy: bool = False
    jpeg: Jpeg | None = None
    levels: str = ""

    @property
    def fine(self) -> bool:
        """Single precision does not resolve a small share of a step."""
        return FINE < self.ends[1] < np.inf

    @property
    def largest(self) -> float:
        """Linear value of the code from which on values are clipped; infinite where there is none."""
        share = self.ends[1] / self.scale
        return float(decode(np.array(share), self.encoding) * np.max(self.unit)) if np.isfinite(share) else np.inf

    @property
    def usual_step(self) -> float:
        """Distance of the two ends of a linear value: the median of those above 0, of every so many pixels."""
        shape, stride = self.values.shape, 1 + math.isqrt(self.values.size // SOME_VALUES)
        arrays = (self.values, self.below, self.above, self.unit)
        parts = [np.broadcast_to(part, shape)[::stride, ::stride] for part in arrays]
        some = np.isfinite(parts[0]) & (parts[0] > 0)
        code, below, above, unit = (part[some] for part in parts)
        ends = (decode(np.maximum(end, 0) / self.scale, self.encoding) for end in (code + above, code - below))
        return float(np.median(np.subtract(*ends) * unit)) if some.any() else 0.0

    def middle(self, pixels: Float[np.ndarray, "H W C"]) -> Float[np.ndarray, "H W C"]:
        """Linear values where they most likely lay: those of a writer that truncated half a step above their codes."""
        if np.ndim(self.below) or self.below > 0:
            return pixels
        inside = (self.values > self.ends[0]) & (self.values < self.ends[1])
        moved = decode((self.values + 0.5 * self.above) / self.scale, self.encoding) * self.unit
        return np.where(inside, moved, pixels).astype(pixels.dtype)

    def bounds(
        self, rows: slice, valid: Bool[np.ndarray, " P"], level: float | None, spread: np.ndarray | float
    ) -> Bounds:
        """Between which codes the values of some rows lay; those of pixels that are not valid may have lain anywhere.

        From the radiance ``level`` on, or the largest code, values are clipped; ``spread`` is the noise of each pixel
        over that of the picture, a number or (P, 1).
        """
        channels = self.values.shape[2]

        def flat(values: Any) -> Any:
            return values[rows].reshape(-1, channels) if np.ndim(values) else values

        if self.lossy:
            inside = valid & ~_mixed(~valid.reshape(-1, self.values.shape[1]), BLOCK if channels == 1 else 2 * BLOCK)
            # Or the picture is too small to do without.
            valid = inside if 2 * np.count_nonzero(inside) >= np.count_nonzero(valid) else valid
        # Of each value: to stretch something over so short an axis takes several times as long.
        code, good = flat(self.values), np.repeat(valid, channels).reshape(-1, channels)
        top = np.asarray(self.ends[1], code.dtype)
        if level is not None and np.isfinite(level):
            clipped = np.rint(self.scale * encode(level / np.asarray(self.unit, np.float64), self.encoding))
            top = np.minimum(top, clipped.astype(code.dtype))
        lower = np.where(good & (code > self.ends[0]), np.minimum(code, top) - flat(self.below), -np.inf)
        upper = np.where(good & (code < top), code + flat(self.above), np.inf)
        how = {"encoding": self.encoding, "lossy": self.lossy}
        return all_between(lower, upper, self.values.shape[1], spread, self.scale, self.unit, **how)


def _mixed(beside: Bool[np.ndarray, "H W"], size: int) -> Bool[np.ndarray, " P"]:
    """Pixels of blocks into which compression mixes what lies beside the object."""
    height, width = beside.shape
    rows = np.logical_or.reduceat(beside, np.arange(0, height, size), axis=0)
    blocks = np.logical_or.reduceat(rows, np.arange(0, width, size), axis=1)
    return blocks.repeat(size, axis=0).repeat(size, axis=1)[:height, :width].ravel()


def find_codes(
    pixels: Float[np.ndarray, "H W C"],
    encoding: Encoding | None,
    bits: int | None,
    rounding: Rounding,
    unit: float | np.ndarray = 1.0,
    stored: UInt[np.ndarray, "H W C"] | None = None,
) -> Codes | None:
    """The codes behind linear values; None where no rounding touched them.

    Args:
        pixels: linear values.
        encoding: of the codes, where a file says so.
        bits: of an integer file, and `HALF`, without an encoding, of half floats; None where neither is known.
        rounding: the full step between neighbouring values in the unit of the pixels; 0 for none, "floor" where the
            writer truncated, None finds out.
        unit: radiance of the largest code of a file, a number or (C,).
        stored: the codes themselves, of integers that are at hand.

    Raises:
        InputError: where they were truncated to no levels that are known.
    """
    if rounding is not None and not (isinstance(rounding, str) and rounding == "floor"):
        return _stated(pixels, rounding)
    if bits is not None and encoding is not None:
        top = 255 if bits <= 8 else 65535
        found = _integers(_nearest_codes(pixels / unit, encoding, top) if stored is None else stored, encoding, top)
        found = None if found is None else found._replace(unit=unit)
    else:
        found = _levels(pixels, half=bits == HALF)
    if rounding == "floor":
        if found is None:
            what, remedy = "is floor, but the values stand on no levels of a file", "Give codes, as uint8 or uint16"
            raise InputError("rounding", what, remedy)
        found = found._replace(below=0.0, above=1.0)
    return found


def open_ends(
    values: Float[np.ndarray, "P C"],
    valid: Bool[np.ndarray, " P"],
    floor: float,
    level: float | None,
    spread: np.ndarray | float,
    width: int,
) -> Bounds | None:
    """Which values of a float picture say no more than that they were below or above; None where none does.

    At ``floor``, the picture's least value, noise was cut off where several values share it; the rest is that of
    `Codes.bounds`.
    """
    low, high = values <= floor, level is not None and values >= level
    if np.count_nonzero(low) < _FEWEST_ENDS and not np.any(high):
        return None
    good = valid[:, None]
    low, high = good & low, good & high
    images = np.moveaxis(values.reshape(-1, width, values.shape[1]), -1, 0)
    low &= np.array([single_values_at_end(image, valid.reshape(-1, width), floor) for image in images])
    if not (low.any() or high.any()):
        return None
    lower = np.where(good & ~low, np.where(high, level or np.inf, values), -np.inf)
    upper = np.where(good & ~high, values, np.inf)
    return all_between(lower, upper, width, spread, exact=True)


def all_between(
    lower: np.ndarray, upper: np.ndarray, width: int, spread: Any, scale: Any = 1.0, unit: Any = 1.0, **how: Any
) -> Bounds:
    """Bounds of all pixels, row by row, in the precision of the fit.

    Ends are in codes, of which ``scale`` are where the encoding is 1, and the radiance ``unit``, a number or (C,);
    ``how`` are other attributes of `fitting.likelihood.Bounds`.
    """
    lower, upper = (end.astype(jnp.result_type(float), copy=False) for end in (lower, upper))
    scale, unit, spread = (np.asarray(part, np.float64) for part in (scale, unit, spread))
    return Bounds(lower, upper, scale, unit, np.arange(len(lower)), np.asarray(width), spread, **how)


def single_values_at_end(
    value: Float[AnyArray, "H W"], counted: Bool[AnyArray, "H W"], least: float | AnyArray
) -> Bool[AnyArray, ""]:
    """Whether single pixels stand at the lower end among larger ones: what is dark without noise is so in one piece.

    Of one channel, on the host or traced; ``least`` is the value of the picture.
    """
    at_end, above = counted & (value <= least), counted & (value > least)
    single = above[:, :-2] & at_end[:, 1:-1] & above[:, 2:]
    return (at_end.sum() >= _FEWEST_ENDS) & (single.sum() >= _FEWEST_ENDS)


def _stated(pixels: np.ndarray, rounding: Any) -> Codes | None:
    """Steps of a size that the user states."""
    try:
        step = np.asarray(rounding, np.float64)
        np.broadcast_shapes(step.shape, pixels.shape)
    except ValueError:
        step = np.array(np.nan)
    if not np.all(np.isfinite(step) & (step >= 0)):
        words = 'Give the full step between neighbouring values, 0 for none, or "floor"'
        raise InputError("rounding", f"must be 0 or more and fit the picture, got {rounding!r}", words)
    if not np.any(step > 0):
        return None
    size = float(np.median(step[step > 0]))
    half = 0.5 * np.maximum(step, 1e-6 * size) / size
    half = float(half) if half.ndim == 0 else np.broadcast_to(half, pixels.shape)
    return Codes(pixels / size, half, half, (-np.inf, np.inf), 1 / size, "linear")


def _nearest_codes(pixels: np.ndarray, encoding: Encoding, top: int) -> Float32[np.ndarray, "H W C"]:
    with np.errstate(invalid="ignore"):
        return np.rint(encode(np.asarray(pixels, np.float32), encoding) * np.float32(top))


def _integers(codes: np.ndarray, encoding: Encoding, top: int, fewest: int = 1) -> Codes | None:
    """Of an integer file with so many different ones; the step is the greatest common divisor of what is used."""
    whole = codes.ravel() if codes.dtype.kind == "u" else codes[np.isfinite(codes)].astype(np.int64)
    least = int(np.min(whole, initial=0))
    used = np.flatnonzero(np.bincount(whole - least)) + least
    if used.size < fewest:
        return None
    inside = used[(used > 0) & (used < top)]
    # Few codes may have a divisor by chance.
    step = int(np.gcd.reduce(inside)) if inside.size >= _FEWEST else 1
    levels = _stretched(used, top) if step == 1 and inside.size >= _FEWEST_STRETCHED else None
    if levels is not None:
        counted = np.full(top + 1, np.nan, np.float32)
        counted[levels] = np.arange(levels.size)
        known = np.isfinite(codes)
        codes = np.where(known, counted[np.where(known, codes, 0).astype(np.int64)], np.float32(np.nan))
        return Codes(codes, 0.5, 0.5, (0.0, levels.size - 1.0), levels.size - 1.0, encoding)
    codes = codes.astype(np.float32)
    if step > 1 and used[-1] == top and top % step:
        # Clipped to the largest number of the file, not to a code of the sensor.
        codes[codes == top] = np.ceil(top / step) * step
    largest = float(top // step)
    return Codes(codes / np.float32(step), 0.5, 0.5, (0.0, largest), top / step, encoding)


def _stretched(used: np.ndarray, top: int) -> Int[np.ndarray, " L"] | None:
    """The codes of fewer bits that were spread over those of a file, its largest being theirs; None where none were."""
    for bits in range(top.bit_length() - 1, 8, -1):
        code, most = np.arange(1 << bits), (1 << bits) - 1
        exact = code * top / most
        # Rounded, truncated, or their own first bits again where they have none.
        replicated = (code << (top.bit_length() - bits)) | (code >> max(2 * bits - top.bit_length(), 0))
        for levels in (np.rint(exact).astype(np.int64), exact.astype(np.int64), replicated):
            if np.array_equal(levels[np.rint(used * (most / top)).astype(np.int64)], used):
                return levels
    return None


def _levels(pixels: np.ndarray, *, half: bool) -> Codes | None:
    """Of a float array, which may be known to hold half floats: those of a file whose levels hold all values."""
    stride = max(1, pixels.size // _FIRST)
    for every in (stride, 1):
        some = pixels.ravel()[::every]
        some = some[np.isfinite(some)]
        if some.size == 0 or np.any(some < 0):
            return None
        fitting: list[tuple[int, Encoding]]
        fitting = [(top, curve) for top in _TOLERANCE for curve in _CURVES if _on_levels(some, curve, top)]
        with np.errstate(over="ignore", under="ignore"):
            halves = bool(np.all(some == some.astype(np.float16)))
        rgbe = pixels if every > 1 else _mantissas(pixels)
        whole = some.max() > 1 and some.max() <= max(_TOLERANCE) and bool(np.all(some == np.rint(some)))
        if not (fitting or halves or rgbe is not None or whole):
            return None
    if all(np.unique(values).size < _FEWEST for values in (some[::stride], some)):
        if not half:
            return None
        fitting, rgbe, whole = [], None, False
    for top, curve in fitting:
        found = _integers(_nearest_codes(pixels, curve, top), curve, top, _FEWEST)
        if found is not None:
            bits = int(np.ceil(np.log2(found.ends[1] + 1)))
            return found._replace(levels=f"{bits}-bit {'sRGB' if curve == 'srgb' else curve} files")
    if whole and (some.max() <= min(_TOLERANCE) or (rgbe is None and not halves)):
        # Codes that nobody divided by the largest; those of half floats and RGBE are whole only where they are bright.
        top = min(top for top in _TOLERANCE if some.max() <= top)
        found = _integers(_nearest_codes(pixels / top, "linear", top), "linear", top, _FEWEST)
        if found is None:
            return None
        # How many codes there are beyond those of 8 bits nobody says.
        ends = found.ends if top == min(_TOLERANCE) else (found.ends[0], np.inf)
        return found._replace(unit=float(top), ends=ends, levels="whole numbers")
    # A float's 0 is no end of its own, but noise may have been cut off there.
    images = np.moveaxis(pixels if rgbe is None else rgbe, -1, 0)
    cut = any(single_values_at_end(image, np.isfinite(image), 0.0) for image in images)
    ends = (0.0 if cut else -np.inf, np.inf)
    if rgbe is not None:
        step = rgbe_step(pixels)
        unit = float(np.median(step[step > 0]))
        above = np.broadcast_to(np.maximum(step, 1e-30) / unit, pixels.shape)
        return Codes((rgbe * above).astype(np.float32), 0.0, above, ends, 1 / unit, "linear", levels="RGBE files")
    if halves:
        known = np.where(np.isfinite(pixels), np.maximum(pixels, 6e-5), 1.0)
        ulp = np.spacing(known.astype(np.float16)).astype(np.float64)
        unit = float(np.median(ulp[pixels > 0])) if np.any(pixels > 0) else 1.0
        around = 0.5 * ulp / unit
        return Codes((pixels / unit).astype(np.float32), around, around, ends, 1 / unit, "linear", levels="half floats")
    return None


def _on_levels(values: np.ndarray, curve: Encoding, top: int) -> bool:
    codes = encode(values.astype(np.float32), curve) * np.float32(top)
    return bool(np.all(codes <= top + 0.5) and np.all(np.abs(codes - np.rint(codes)) < _TOLERANCE[top]))


def _mantissas(pixels: np.ndarray) -> np.ndarray | None:
    """Of the values of an RGBE file, half a step above them or, as many programs read it, as they are; else None."""
    if pixels.shape[-1] != 3 or not np.all(np.isfinite(pixels)):
        return None
    step = rgbe_step(pixels)
    if not np.any(step > 0):
        return None
    codes = pixels / np.where(step > 0, step, 1.0)
    whole = np.floor(codes)
    return whole if np.all(codes == whole) or np.all((codes == whole + 0.5) | (step == 0)) else None
