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
from typing import Any

import numpy as np

from brdf.channels import channel_names
from fitting.result import FitResult
from fitting.solver.normal_equations import AnyArray

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


def without_censored_noise(
    whole: FitResult, masks: Sequence[Any], again: Callable[[list[np.ndarray]], FitResult] | None
) -> FitResult:
    """The fit without pixels whose noise is cut off, where there are any.

    Args:
        whole: of the fit to all pixels.
        masks: pixels that it may take in each picture, (H, W), or None.
        again: fits to the pixels of other masks; None where that cannot be, and a warning has to do.

    Returns:
        The last fit, what it left out named by its reason; the given one where nothing is cut.
    """
    clipped = whole.left_out.get("clipped", 0) >= FEWEST
    if not (clipped or any(_piles_up(*picture) for picture in zip(whole.targets, whole.counted, strict=True))):
        return whole
    allowed = [
        np.ones(counted.shape, bool) if mask is None or again is None else mask
        for mask, counted in zip(masks, whole.counted, strict=True)
    ]
    # Once left out stays out: a threshold that moves to and fro would never end.
    black = [np.zeros(counted.shape, bool) for counted in whole.counted]
    white = [np.zeros(counted.shape, bool) for counted in whole.counted]
    result, spared = whole, set()
    for _ in range(ROUNDS):
        before = _count(black + white)
        for i, target in enumerate(whole.targets):
            predicted = np.broadcast_to(result.fitted(i), target.shape)
            at_black, at_white, lost = _censored(target, predicted, whole.counted[i], allowed[i], clipped=clipped)
            black[i] |= at_black & ~white[i]
            white[i] |= at_white & ~black[i]
            spared.update(lost)
        if again is None or _count(black + white) <= before * 1.01:
            break
        result = again([free & ~(dark | bright) for free, dark, bright in zip(allowed, black, white, strict=True)])
    warnings = result.warnings
    if again is None:
        left = zip(black, white, whole.counted, strict=True)
        share = max(float(np.mean((dark | bright)[counted])) for dark, bright, counted in left)
        if spared:
            warnings = ("noise is cut off at black or white almost everywhere: the coefficients are bent", *warnings)
        elif share:
            words = (
                f"noise is cut off at black or white in {100 * share:.2g} % of the pixels, which bends the "
                "coefficients: of a picture in memory such pixels are left out"
            )
            warnings = (words, *warnings)
        return dataclasses.replace(result, warnings=warnings)
    left_out = dict(whole.left_out)
    for reason, some in ((BLACK, black), (WHITE, white)):
        left_out[reason] = _count(some)
    if spared:
        names = channel_names(whole.targets[0].shape[-1])
        where = f" in channel {', '.join(names[channel] for channel in sorted(spared))}" if len(names) > 1 else ""
        words = f"noise is cut off at black or white almost everywhere{where}: the coefficients are bent there"
        warnings = (words, *warnings)
    elif result is whole:
        return whole
    return dataclasses.replace(result, left_out={reason: n for reason, n in left_out.items() if n}, warnings=warnings)


def _count(masks: Sequence[np.ndarray]) -> int:
    return sum(int(np.count_nonzero(mask)) for mask in masks)


def _piles_up(target: np.ndarray, counted: np.ndarray) -> bool:
    """Whether noise may be cut at black in some channel; a look that needs no prediction."""
    return any(single_values_at_end(value, counted) for value in np.moveaxis(target, -1, 0))


def single_values_at_end(value: AnyArray, counted: AnyArray) -> Any:
    """Whether single pixels stand at the lower end among larger ones: what is dark without noise is so in one piece.

    Args:
        value: of one channel, (H, W), on the host or traced.
        counted: which pixels count.
    """
    least = value.min(where=counted, initial=np.inf)
    at_end, above = counted & (value == least), counted & (value > least)
    single = above[:, :-2] & at_end[:, 1:-1] & above[:, 2:]
    return (at_end.sum() >= FEWEST) & (single.sum() >= FEWEST)


def _censored(
    target: np.ndarray, predicted: np.ndarray, counted: np.ndarray, allowed: np.ndarray, *, clipped: bool
) -> tuple[np.ndarray, np.ndarray, list[int]]:
    """What of one picture is predicted too near to black, and to white where pixels were clipped.

    Args:
        target: (H, W, C).
        predicted: likewise.
        counted: pixels that were fitted, (H, W).
        allowed: pixels that the mask allows.
        clipped: whether some were.

    Returns:
        (H, W) for black, for white; and the channels in which too much would have to be left out.
    """
    black = white = nowhere = np.zeros(counted.shape, bool)
    spared: list[int] = []
    if not counted.any():
        return black, white, spared
    with np.errstate(invalid="ignore"):
        brightest = np.max(target, axis=-1)
    shown = np.any(predicted > 0, axis=-1)
    level = float(np.max(brightest[counted]))
    # Clipped pixels do not count; where none are, white was not reached.
    beyond = brightest[np.isfinite(brightest) & shown & allowed & ~counted & (brightest > level)]
    reached = clipped and beyond.size >= FEWEST
    lit = counted & shown
    ends = []
    for channel in range(target.shape[-1]):
        value, model = target[..., channel], predicted[..., channel]
        bright = nowhere
        if reached:
            bright = _near(-value, -model, counted, -level, float(np.min(beyond)) - level)
        ends.append((channel, _near_black(value, model, counted), bright))
    for channel, dark, bright in sorted(ends, key=lambda end: np.count_nonzero((end[1] | end[2]) & lit)):
        if not (dark.any() or bright.any()):
            continue
        if np.count_nonzero(lit & ~(black | white | dark | bright)) < KEPT * np.count_nonzero(lit):
            spared.append(channel)
        else:
            black, white = black | dark, white | bright
    return black, white, spared


def _near_black(value: np.ndarray, model: np.ndarray, counted: np.ndarray) -> np.ndarray:
    """Pixels predicted so near to black that noise is cut there; none where no single values stand at the end."""
    nowhere = np.zeros(counted.shape, bool)
    if not single_values_at_end(value, counted):
        return nowhere
    floor = float(np.min(value[counted]))
    at_end = counted & (value == floor) & (model > 0)
    above = value[counted & (value > floor)]
    step = float(np.min(above))
    # The cut half of the noise piles up at the end; where noise only thins out, each code holds fewer than the next.
    if np.count_nonzero(at_end) < FEWEST or np.count_nonzero(at_end) <= np.count_nonzero(above == step):
        return nowhere
    near = _near(value, model, counted, floor, step - floor)
    return near if np.count_nonzero(near & at_end) >= FEWEST else nowhere


def _near(value: np.ndarray, model: np.ndarray, counted: np.ndarray, end: float, step: float) -> np.ndarray:
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
    near = counted & (model < end + REACH * deviation)
    return near if deviation > ROUNDED * step and np.count_nonzero(near) >= FEWEST else nowhere


def _noise_pairs(residual: np.ndarray, model: np.ndarray, counted: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The variance that each pair of near pixels shows, and the mean of what is predicted there.

    Differences of near pixels know nothing of what the model leaves over wide areas; direct neighbours share the noise
    that a camera or a codec smoothed.
    """
    squares, where = [], []
    for left, value, good in ((residual, model, counted), (residual.T, model.T, counted.T)):
        both = good[:, :-2] & good[:, 2:]
        difference = (left[:, :-2] - left[:, 2:])[both].astype(np.float64)
        squares.append(0.5 * difference**2)
        where.append(0.5 * (value[:, :-2] + value[:, 2:])[both])
    return np.concatenate(squares), np.concatenate(where)
