"""What a JPEG does to the colours of a picture, taken off before it is fitted.

A JPEG keeps brightness well and colours coarsely: in half the resolution, in large steps, and without the changes
within a block that are below half a step. That errs the same way all over a smoothly lit object, so that no residual
shows it and no error of blocks holds it. What it is a look-alike says: the prediction of a first fit, with noise,
through the same codec. The mean of what that changes is taken off the codes.

Source: C. Gourieroux, A. Monfort and E. Renault, "Indirect inference", J. Applied Econometrics 8 (1993) S85.
"""

import dataclasses
import math
from collections.abc import Sequence
from typing import cast

import numpy as np
from jaxtyping import Float

from brdf.images.encoding import decode
from brdf.images.jpeg import Jpeg
from fitting.codes import Codes
from fitting.model_fit import ModelFit
from fitting.pixels import Observed, Tile
from fitting.problem import Target
from fitting.solver.streams import each

# In codes: the noise is no larger than the first of these with which a look-alike is left with as much as the picture.
NOISES = (0.0, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0)
LOOK_ALIKES = 4
# Of a JPEG.
LARGEST_CODE = 255.0


def codec_of(target: Target) -> Jpeg | None:
    """How a picture in colour was compressed; None where it was not, or nobody knows how.

    Args:
        target: any.
    """
    codes = target.codes
    return None if codes is None or codes.values.shape[2] != 3 else codes.jpeg


def without_codec_errors(seen: Observed, fit: ModelFit, codecs: Sequence[Jpeg | None]) -> Observed:
    """The pixels of a problem, less what compression does to a look-alike of each picture.

    Args:
        seen: the pixels.
        fit: a first fit to them.
        codecs: of each picture; those without one stay as they are.
    """
    shown = [_predicted(tile, fit, index) for index, tile in enumerate(seen.tiles)]
    sizes = [math.prod(target.pixels.shape[:2]) for target in seen.problem.targets]
    whole = np.split(np.concatenate(shown), np.cumsum(sizes)[:-1])
    parts = [
        np.zeros_like(some) if codec is None else _codec_errors(codec, cast(Codes, target.codes), some)
        for codec, target, some in zip(codecs, seen.problem.targets, whole, strict=True)
    ]
    errors = np.split(np.concatenate(parts), np.cumsum([len(some) for some in shown])[:-1])
    return seen._replace(tiles=each(_less, seen.tiles, errors))


def _predicted(tile: Tile, fit: ModelFit, index: int) -> Float[np.ndarray, "P C"]:
    """In codes; NaN where a value says nothing."""
    optimum, bounds = fit.optimum, tile.bounds
    if bounds is None:
        return np.full(tile.target.shape, np.nan, np.float32)
    code, _ = bounds.codes(fit.pictures[index].shown(optimum.n, optimum.x).astype(np.float32))
    return np.where(np.isfinite(bounds.lower) | np.isfinite(bounds.upper), code, np.float32(np.nan))


def _codec_errors(codec: Jpeg, codes: Codes, shown: Float[np.ndarray, "P C"]) -> Float[np.ndarray, "P C"]:
    """What compression does to each code of a picture, 0 where nothing is predicted."""
    counts, unit, random = np.isfinite(shown), LARGEST_CODE / codes.scale, np.random.default_rng(0)
    # Beside the object stands what the file shows there; values that were taken out were clipped.
    shows = np.nan_to_num(codes.values.reshape(shown.shape) * unit, nan=LARGEST_CODE)
    clean = np.where(counts, shown * unit, shows)

    def look_alike(noise: float) -> tuple[np.ndarray, np.ndarray]:
        """Before the codec and after it."""
        before = clean + counts * random.standard_normal(clean.shape, np.float32) * np.float32(noise)
        given = np.clip(np.rint(before), 0, LARGEST_CODE).astype(np.uint8)
        return before, codec.through(given.reshape(codes.values.shape)).reshape(shown.shape)

    def left(after: np.ndarray) -> float:
        return float(np.mean((after - clean)[counts] ** 2))

    wanted, known = left(shows), [left(look_alike(NOISES[0])[1])]
    for more in NOISES[1:]:
        if known[-1] >= wanted:
            break
        known.append(left(look_alike(more)[1]))
    noise = float(np.interp(wanted, known, NOISES[: len(known)]))
    some = [look_alike(noise) for _ in range(LOOK_ALIKES)]
    mean = np.mean([after - before for before, after in some], axis=0)
    return np.where(counts, mean / unit, 0.0).astype(np.float32)


def _less(tile: Tile, errors: Float[np.ndarray, "P C"]) -> Tile:
    bounds = tile.bounds
    if bounds is None or not errors.any():
        return tile
    target = np.asarray(tile.target)
    code = np.maximum(bounds.codes(target)[0] - errors, 0.0)
    moved = np.where(errors != 0, decode(code / bounds.scale, bounds.encoding) * bounds.unit, target)
    lower, upper = (end - errors.astype(end.dtype) for end in (bounds.lower, bounds.upper))
    return tile._replace(
        target=moved.astype(target.dtype), bounds=dataclasses.replace(bounds, lower=lower, upper=upper)
    )
