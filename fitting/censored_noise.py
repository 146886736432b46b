"""Noise that a camera cut off at black or at white, and a fit without the pixels that it bends.

A sensor has no value below black and none above white. Where a surface shows less than some standard deviations of the
noise, the lower half of the noise is missing and the mean is too high; next to a clipped highlight the upper half is
missing, its pixels being left out as clipped. Leaving out pixels by their measured value is what bends the mean. So
pixels are left out by what the fit *predicts* there, which knows nothing of their own noise, and the fit is repeated
until that changes no more.

Source: Foi, Trimeche, Katkovnik and Egiazarian 2008, section IV, "Clipping", for the bent mean.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

import brdf
from brdf.channels import channel_names
from fitting.result import FitResult

# Predictions within so many standard deviations of an end are bent by more than a thousandth of one.
REACH = 3.0
# So many values have to be at the end; symmetry makes up to eight of them equal.
FEWEST = 10
# Noise below this share of a code is that of rounding, which is not cut.
ROUNDED = 0.7
# At least this share of the lit pixels is kept, or the cut is told and not mended.
KEPT = 0.2
ROUNDS = 5
# A window of brightness with fewer pairs of pixels tells no noise of its own.
FEWEST_PAIRS = 50
BLACK, WHITE = "whose noise is cut off at black", "whose noise is cut off at white"


class Cut(NamedTuple):
    """Pixels of one picture that the noise's missing half bends.

    Attributes:
        black: what is left out for the noise that is cut at black, (H, W).
        white: the same at white.
        spared: channels in which too much would have to be left out.
    """

    black: Bool[np.ndarray, "H W"]
    white: Bool[np.ndarray, "H W"]
    spared: tuple[int, ...]


def without_cut_noise(
    whole: FitResult, masks: Sequence[Any], again: Callable[[list[Bool[np.ndarray, "H W"]]], FitResult]
) -> FitResult:
    """The fit without pixels whose noise is cut off, where there are any.

    Args:
        whole: of the fit to all pixels, its pictures in memory.
        masks: pixels that it looked at in each picture, (H, W), or None.
        again: fits to the pixels of other masks.

    Returns:
        The last fit, what it left out named by its reason; the given one where nothing is cut.
    """
    clipped = whole.left_out.get("clipped", 0) >= FEWEST
    if not (clipped or any(_piles_up(*picture) for picture in zip(whole.targets, whole.counted, strict=True))):
        return whole
    allowed = [
        np.ones(counted.shape, bool) if mask is None else np.asarray(mask).astype(bool)
        for mask, counted in zip(masks, whole.counted, strict=True)
    ]
    # Once left out stays out: a threshold that moves to and fro would never end.
    black = [np.zeros(counted.shape, bool) for counted in whole.counted]
    white = [np.zeros(counted.shape, bool) for counted in whole.counted]
    result, spared = whole, set()
    for _ in range(ROUNDS):
        before = _count(black) + _count(white)
        for i, (target, scene) in enumerate(zip(whole.targets, result.scenes, strict=True)):
            counted = whole.counted[i]
            cut = _cut(np.asarray(target), _predicted(result, scene), counted, allowed[i], clipped=clipped)
            black[i] |= cut.black & counted & ~white[i]
            white[i] |= cut.white & counted & ~black[i]
            spared.update(cut.spared)
        if _count(black) + _count(white) <= before * 1.01:
            break
        result = again([ok & ~(one | other) for ok, one, other in zip(allowed, black, white, strict=True)])
    if result is whole and not spared:
        return whole
    left_out = whole.left_out | {BLACK: _count(black), WHITE: _count(white)}
    warnings = result.warnings
    if spared:
        names = channel_names(whole.targets[0].shape[-1])
        where = f" in channel {', '.join(names[channel] for channel in sorted(spared))}" if len(names) > 1 else ""
        words = f"noise is cut off at black or white almost everywhere{where}: the coefficients are bent there"
        warnings = (words, *warnings)
    return dataclasses.replace(result, left_out={reason: n for reason, n in left_out.items() if n}, warnings=warnings)


def warned_of_cut_noise(result: FitResult) -> FitResult:
    """The fit of a picture that is not in memory, with a warning where its noise is cut off.

    Args:
        result: of the fit; what it shows are some of the pixels.
    """
    clipped = result.left_out.get("clipped", 0) >= FEWEST
    share, everywhere = 0.0, False
    for target, scene, counted in zip(result.targets, result.scenes, result.counted, strict=True):
        if clipped or _piles_up(target, counted):
            whole = np.ones(counted.shape, bool)
            cut = _cut(np.asarray(target), _predicted(result, scene), counted, whole, clipped=clipped)
            share = max(share, float(np.mean((cut.black | cut.white)[counted])))
            everywhere |= bool(cut.spared)
    if not (share or everywhere):
        return result
    words = (
        f"noise is cut off at black or white in {100 * share:.2g} % of the pixels, which bends the coefficients: "
        "of a picture in memory such pixels are left out"
    )
    if everywhere:
        words = "noise is cut off at black or white almost everywhere: the coefficients are bent"
    return dataclasses.replace(result, warnings=(words, *result.warnings))


def _count(masks: Sequence[Bool[np.ndarray, "H W"]]) -> int:
    return sum(int(np.count_nonzero(mask)) for mask in masks)


def _piles_up(target: Float[np.ndarray, "H W C"], counted: Bool[np.ndarray, "H W"]) -> bool:
    """Whether noise may be cut at black in some channel; a look that needs no prediction."""
    return any(_single_values_at_end(value, counted) for value in np.moveaxis(target, -1, 0))


def _single_values_at_end(value: Float[np.ndarray, "H W"], counted: Bool[np.ndarray, "H W"]) -> bool:
    """Whether single pixels stand at the lower end among larger ones: what is dark without noise is so in one piece."""
    inside = value[counted]
    if not inside.size or np.count_nonzero(inside == np.min(inside)) < FEWEST:
        return False
    above = counted & (value > np.min(inside))
    return int(np.count_nonzero(above[:, :-2] & (counted & ~above)[:, 1:-1] & above[:, 2:])) >= FEWEST


def _predicted(result: FitResult, scene: brdf.Scene) -> Float[np.ndarray, "H W C"]:
    return np.asarray(brdf.render(result.material, scene, precision=result.precision))


def _cut(
    target: Float[np.ndarray, "H W C"],
    predicted: Float[np.ndarray, "H W C"],
    counted: Bool[np.ndarray, "H W"],
    allowed: Bool[np.ndarray, "H W"],
    *,
    clipped: bool,
) -> Cut:
    """What of one picture is too near to an end, by what is predicted; to white only where pixels were clipped."""
    predicted = np.broadcast_to(predicted, target.shape)
    nowhere = np.zeros(counted.shape, bool)
    if not counted.any():
        return Cut(nowhere, nowhere, ())
    with np.errstate(invalid="ignore"):
        brightest = np.max(target, axis=-1)
    seen = np.isfinite(brightest) & np.any(predicted > 0, axis=-1)
    level = float(np.max(brightest[counted]))
    beyond = brightest[seen & allowed & ~counted & (brightest > level)]
    # Clipped pixels do not count; where none are, white was not reached.
    white = level if clipped and beyond.size >= FEWEST else np.inf
    step = float(np.min(beyond)) - level if beyond.size else 0.0
    lit = counted & np.any(predicted > 0, axis=-1)
    ends: list[tuple[int, np.ndarray, np.ndarray]] = []
    for channel in range(target.shape[-1]):
        value, model = target[..., channel], predicted[..., channel]
        dark, bright = _near_black(value, model, counted), nowhere
        if white < np.inf:
            bright = _near(-value, -model, counted, -white, step)
        ends.append((channel, dark, bright))
    black, top, spared = nowhere, nowhere, []
    for channel, dark, bright in sorted(ends, key=lambda end: np.count_nonzero((end[1] | end[2]) & lit)):
        if not (dark.any() or bright.any()):
            continue
        left = lit & ~(black | top | dark | bright)
        if np.count_nonzero(left) < KEPT * np.count_nonzero(lit):
            spared.append(channel)
        else:
            black, top = black | dark, top | bright
    return Cut(black, top, tuple(spared))


def _near_black(
    value: Float[np.ndarray, "H W"], model: Float[np.ndarray, "H W"], counted: Bool[np.ndarray, "H W"]
) -> Bool[np.ndarray, "H W"]:
    """Pixels predicted so near to black that noise is cut there; none where no single values stand at the end."""
    if not _single_values_at_end(value, counted):
        return np.zeros(counted.shape, bool)
    floor = float(np.min(value[counted]))
    at_end = counted & (value == floor) & (model > 0)
    above = value[counted & (value > floor)]
    if np.count_nonzero(at_end) < FEWEST or not above.size:
        return np.zeros(counted.shape, bool)
    # The cut half of the noise piles up at the end; where noise only thins out, each code holds fewer than the next.
    if np.count_nonzero(at_end) <= np.count_nonzero(above == np.min(above)):
        return np.zeros(counted.shape, bool)
    near = _near(value, model, counted, floor, float(np.min(above)) - floor)
    return near if np.count_nonzero(near & at_end) >= FEWEST else np.zeros(counted.shape, bool)


def _near(
    value: Float[np.ndarray, "H W"],
    model: Float[np.ndarray, "H W"],
    counted: Bool[np.ndarray, "H W"],
    end: float,
    step: float,
) -> Bool[np.ndarray, "H W"]:
    """Pixels predicted within ``REACH`` standard deviations of the lower end, the noise measured just above it."""
    nowhere = np.zeros(counted.shape, bool)
    squares, where = _noise_pairs(value - model, model, counted)
    if squares.size < FEWEST_PAIRS:
        return nowhere
    deviation = float(np.sqrt(np.mean(squares)))
    for _ in range(ROUNDS):
        nearest = end + REACH * deviation
        beside = (where > nearest) & (where < nearest + REACH * deviation)
        if np.count_nonzero(beside) < FEWEST_PAIRS:
            break
        deviation = float(np.sqrt(np.mean(squares[beside])))
    if deviation <= ROUNDED * step:
        return nowhere
    near = counted & (model < end + REACH * deviation)
    return near if np.count_nonzero(near) >= FEWEST else nowhere


def _noise_pairs(
    residual: Float[np.ndarray, "H W"], model: Float[np.ndarray, "H W"], counted: Bool[np.ndarray, "H W"]
) -> tuple[Float[np.ndarray, " M"], Float[np.ndarray, " M"]]:
    """The variance that each pair of near pixels shows, and the mean of what is predicted there.

    Differences of near pixels know nothing of what the model leaves over wide areas; direct neighbours share the noise
    that a camera or a codec smoothed.
    """
    squares, where = [], []
    for first, second in (
        ((slice(None), slice(None, -2)), (slice(None), slice(2, None))),
        ((slice(None, -2), slice(None)), (slice(2, None), slice(None))),
    ):
        both = counted[first] & counted[second]
        difference = (residual[first] - residual[second])[both].astype(np.float64)
        squares.append(0.5 * difference**2)
        where.append(0.5 * (model[first] + model[second])[both])
    return np.concatenate(squares), np.concatenate(where)
