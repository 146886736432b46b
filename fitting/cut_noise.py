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
    result: FitResult, masks: Sequence[Any], again: Callable[[list[Bool[np.ndarray, "H W"]]], FitResult]
) -> FitResult:
    """The fit without pixels whose noise is cut off, where there are any.

    Args:
        result: of the fit to all pixels, its pictures in memory.
        masks: pixels that it looked at in each picture, (H, W), or None.
        again: fits to the pixels of other masks.

    Returns:
        The last fit, what it left out named by its reason; the given one where nothing is cut.
    """
    whole, found, used = result, [], None
    clipped = result.left_out.get("clipped", 0) >= FEWEST
    if not (clipped or any(_piles_up(*picture) for picture in zip(whole.targets, whole.counted, strict=True))):
        return result
    for _ in range(ROUNDS):
        pictures = zip(whole.targets, result.scenes, whole.counted, strict=True)
        found = [_cut(np.asarray(target), _predicted(result, scene), counted) for target, scene, counted in pictures]
        looked_at = [~(cut.black | cut.white) for cut in found]
        if used is not None:
            # Once left out stays out: a threshold that moves to and fro would never end.
            looked_at = [one & before for one, before in zip(looked_at, used, strict=True)]
        left_out = sum(int(np.count_nonzero(~one)) for one in looked_at)
        before = 0 if used is None else sum(int(np.count_nonzero(~one)) for one in used)
        if left_out <= before * 1.01:
            break
        used = looked_at
        result = again(
            [one if mask is None else one & (np.asarray(mask) > 0) for one, mask in zip(used, masks, strict=True)]
        )
    told = dict(whole.left_out)
    if used is not None:
        gone = [counted & ~one for counted, one in zip(whole.counted, used, strict=True)]
        black = sum(int(np.count_nonzero(one & cut.black)) for one, cut in zip(gone, found, strict=True))
        told |= {BLACK: black, WHITE: sum(int(np.count_nonzero(one)) for one in gone) - black}
    spared = sorted({channel for cut in found for channel in cut.spared})
    warnings = result.warnings
    if spared:
        names = brdf.channel_names(whole.targets[0].shape[-1])
        where = f" in channel {', '.join(names[channel] for channel in spared)}" if len(names) > 1 else ""
        words = f"noise is cut off at black or white almost everywhere{where}: the coefficients are bent there"
        warnings = (words, *warnings)
    if used is None and not spared:
        return result
    return dataclasses.replace(result, left_out={reason: n for reason, n in told.items() if n}, warnings=warnings)


def _piles_up(target: Float[np.ndarray, "H W C"], counted: Bool[np.ndarray, "H W"]) -> bool:
    """A first look, without a prediction: single values at the lower end among larger ones."""
    for value in np.moveaxis(target, -1, 0):
        inside = value[counted]
        if not inside.size or np.count_nonzero(inside == np.min(inside)) < FEWEST:
            continue
        above = counted & (value > np.min(inside))
        # What is dark without noise is dark in one piece.
        if np.count_nonzero(above[:, :-2] & (counted & ~above)[:, 1:-1] & above[:, 2:]) >= FEWEST:
            return True
    return False


def _predicted(result: FitResult, scene: brdf.Scene) -> Float[np.ndarray, "H W C"]:
    return np.asarray(brdf.render(result.material, scene, precision=result.precision))


def _cut(
    target: Float[np.ndarray, "H W C"], predicted: Float[np.ndarray, "H W C"], counted: Bool[np.ndarray, "H W"]
) -> Cut:
    """What of one picture is too near to an end, by what is predicted."""
    predicted = np.broadcast_to(predicted, target.shape)
    nowhere = np.zeros(counted.shape, bool)
    if not counted.any():
        return Cut(nowhere, nowhere, ())
    with np.errstate(invalid="ignore"):
        brightest = np.max(target, axis=-1)
    seen = np.isfinite(brightest) & np.any(predicted > 0, axis=-1)
    level = float(np.max(brightest[counted]))
    beyond = brightest[seen & ~counted & (brightest > level)]
    # Clipped pixels do not count; where none are, white was not reached.
    white = level if beyond.size >= FEWEST else np.inf
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
    """Pixels predicted so near to black that noise is cut there; none where no value stands at the end of the range."""
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
