"""Pictures that do not say how they are encoded: which of two readings the model explains.

A silent file of 8 bits is taken as sRGB, one of more bits as linear (`brdf.images.encoding`). Neither is known, and
the wrong one bends every shade. Under the right one the model that is fitted leaves less, so both are tried. What each
leaves is compared in the codes of the file, the same numbers under both, with the rounding of a code added to both.
"""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

import brdf
import fitting
from brdf.errors import InputError
from brdf.images.encoding import encode
from fitting.cli.common import named_as
from fitting.cli.job import Job
from fitting.result import FitResult

# The other reading is taken where it leaves less than this share of the squares that the assumed one leaves...
LESS = 0.9
# ... and one of them is no guess where it leaves less than this share of what the other leaves.
CLEARLY = 0.5
_NAMES = {"srgb": "sRGB"}


def fit_either(
    read: dict[Path, brdf.Picture], collect: Callable[[dict[Path, brdf.Picture]], Job], how: dict[str, Any]
) -> tuple[FitResult, tuple[str, ...]]:
    """Fit, where a file does not say how it is encoded under both readings.

    Args:
        read: pictures by file, as assumed.
        collect: makes a job of them.
        how: further arguments of `fitting.fit`; seconds are shared by the two fits.

    Returns:
        The fit to keep, with a warning where the reading is a guess or was changed; and the notes of its job.

    Raises:
        InputError: naming the file or option.
    """
    silent = [path for path, picture in read.items() if picture.source == "assumed"]
    if silent and how.get("seconds") is not None:
        how = how | {"seconds": how["seconds"] / 2}
    job = collect(read)
    result = _fit(job, how)
    if not silent:
        return result, job.notes
    try:
        other = collect(read | {path: brdf.read_picture(path, encoding=_other(read[path])) for path in silent})
        other_result = _fit(other, how)
    except InputError:
        return result, job.notes  # the other reading cannot be fitted at all
    is_other, warning = judge((job, other), _on_same_pixels(result, other_result))
    if is_other:
        job, result = other, other_result
    warnings = (*result.warnings, warning) if warning else result.warnings
    return dataclasses.replace(result, warnings=warnings), job.notes


def _fit(job: Job, how: dict[str, Any]) -> FitResult:
    several = len(job.pictures) > 1
    with named_as({"target": job.target}):
        if several:
            return fitting.fit(job.pictures, job.scenes, mask=job.masks, **how)
        return fitting.fit(job.pictures[0], job.scenes[0], mask=job.masks[0], **how)


def _other(picture: brdf.Picture) -> Any:
    return "srgb" if picture.encoding == "linear" else "linear"


def unexplained(job: Job, result: FitResult) -> tuple[float, float]:
    """What a fit leaves of the codes in the files: sums of squares of the deviations and of the codes, full scale 1.

    Args:
        job: what was fitted.
        result: the fit of it.
    """
    left = total = 0.0
    for picture, scene, counted in zip(job.pictures, result.scenes, result.counted, strict=True):
        model = np.asarray(brdf.render(result.material, scene), np.float32)
        codes, fitted = (
            encode(np.ascontiguousarray((values / picture.factor)[counted], np.float32), picture.encoding)
            for values in (picture.pixels, np.broadcast_to(model, picture.pixels.shape))
        )
        deviation = codes.astype(np.float64) - fitted
        left += float(np.sum(deviation**2)) + deviation.size * (picture.code_step or 0.0) ** 2 / 12
        total += float(np.sum(codes.astype(np.float64) ** 2))
    return left, total


def _on_same_pixels(one: FitResult, other: FitResult) -> tuple[FitResult, FitResult]:
    """Both, to be compared where both count: each leaves out what its own reading calls cut off."""
    both = [mine & its for mine, its in zip(one.counted, other.counted, strict=True)]
    if not all(np.any(counted) for counted in both):
        return one, other
    return dataclasses.replace(one, counted=both), dataclasses.replace(other, counted=both)


def judge(jobs: tuple[Job, Job], results: tuple[FitResult, FitResult]) -> tuple[bool, str]:
    """Which of two readings to keep, and what to say about it.

    Args:
        jobs: as assumed, and the other way.
        results: of both.

    Returns:
        Whether it is the other one; and a warning, empty where the pictures speak clearly for what was assumed.
    """
    shares = [left / total for left, total in (unexplained(*pair) for pair in zip(jobs, results, strict=True))]
    picture = next(one for one in jobs[0].pictures if one.source == "assumed")
    assumed, other = (_NAMES.get(str(one), str(one)) for one in (picture.encoding, _other(picture)))
    left, other_left = (f"{100 * share**0.5:.{2 if share < 0.99 else 3}g} %" for share in shares)
    silent = f"{jobs[0].target.name} does not say how its values are encoded"
    leaves = "the fit is off by {} of the values in the file (rms), under {} by {}"
    if shares[1] < CLEARLY * shares[0]:
        told = leaves.format(other_left, assumed, left)
        return True, f"{silent}: read as {other}, under which {told}. Where you know better, say so with --encoding"
    if shares[1] < LESS * shares[0]:
        told = leaves.format(other_left, assumed, left)
        return True, f"{silent}: {other} is a guess. Under it {told}. Where you know, say so with --encoding"
    if shares[0] < CLEARLY * shares[1]:
        return False, ""
    told = leaves.format(left, other, other_left)
    return False, f"{silent}: {assumed} is a guess. Under it {told}. Where you know, say so with --encoding"
