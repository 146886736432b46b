"""Pictures that do not say how they are encoded: which of two interpretations the model explains.

A silent file of 8 bits is taken as sRGB, one of more bits as linear (`brdf.images.encoding`). Neither is known, and
the wrong one bends every shade. Under the right one the model that is fitted leaves less, so both are tried. What each
leaves is compared in the codes of the file, the same numbers under both, with the rounding of a code added to both.
"""

import dataclasses
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

import brdf
import fitting
from brdf.errors import InputError
from brdf.images.encoding import encode
from fitting.cli.common import named_as
from fitting.cli.inputs import FitInputs

if TYPE_CHECKING:
    from fitting.result import FitResult

# The other encoding is taken where it leaves less than this share of the squares that the assumed one leaves...
LESS = 0.9
# ... and one of them is no guess where it leaves less than this share of what the other leaves.
CLEARLY = 0.5
# Pixels on a side that are tried.
SIDE = 512
OTHER: dict[Any, str] = {"linear": "srgb", "srgb": "linear"}
NAMES: dict[Any, str] = {"linear": "linear", "srgb": "sRGB"}


def fit_either(read: Callable[..., FitInputs], say: Callable[[str], None], **how: Any) -> tuple["FitResult", FitInputs]:
    """Read and fit, where a file does not say how it is encoded under that of two interpretations which explains it.

    ``read`` gives the inputs, also with other encodings by file, ``say`` tells what is being done, and ``how`` are
    further arguments of `fitting.fit`. Its seconds are those of the fit after the trial.

    Returns:
        The fit to keep, with a warning where the encoding is a guess or was changed; and what was fitted.
    """
    inputs = read()
    count = len(inputs.pictures)
    what = f"fitting {count} pictures" if count > 1 else "fitting"
    if not inputs.silent:
        say(what)
        return _fit(inputs, how), inputs
    path, assumed = next(iter(inputs.silent.items()))
    say(f"trying {NAMES[assumed]} and {NAMES[OTHER[assumed]]}")
    asked = {name: how[name] for name in ("model", "precision", "saturation", "dark", "noise", "plausible", "loss")}
    warning, trial = "", _tried(inputs, asked)
    try:
        others = read({path: OTHER[encoding] for path, encoding in inputs.silent.items()})
        other = _tried(others, asked)
    except InputError:
        pass  # under the other encoding it cannot be fitted at all
    else:
        # To be compared where both count: each leaves out what under its own encoding is cut off.
        both = list(map(np.logical_and, trial.counted, other.counted))
        both = both if all(counted.any() for counted in both) else None
        is_other, warning = judge(assumed, *(_unexplained(one, both or one.counted) for one in (trial, other)))
        inputs = others if is_other else inputs
    say(what)
    result = _fit(inputs, how)
    warnings = [f"{path.name} does not say how its values are encoded: {warning}"] if warning else []
    return dataclasses.replace(result, warnings=(*result.warnings, *warnings)), inputs


class _Trial(NamedTuple):
    """Pictures, what a fit shows of them, and which pixels counted."""

    pictures: list[brdf.Picture]
    fitted: list[np.ndarray]
    counted: list[np.ndarray]


def _tried(inputs, asked):
    from fitting.core import predictions
    from fitting.problem import state_problem

    pictures, scenes, masks = map(list, zip(*map(_thinned, inputs.pictures, inputs.scenes, inputs.masks), strict=True))
    with named_as({"target": inputs.targets[0]}):
        return _Trial(pictures, *predictions(state_problem(pictures, scenes, masks, **asked)))


def _thinned(picture, scene, mask):
    """Of a large picture every so many rows and columns, which tell a curve as well."""
    height, width = picture.pixels.shape[:2]
    stride = -(-max(height, width) // SIDE)
    if stride == 1:
        return picture, scene, mask
    some = (slice(None, None, stride),) * 2
    alpha, mask = (None if one is None else one[some] for one in (picture.alpha, mask))
    # Pixels of a block of a JPEG are known by their neighbours.
    picture = dataclasses.replace(picture, pixels=picture.pixels[some], alpha=alpha, jpeg=None)
    return picture, brdf.some_pixels(scene, np.arange(height * width).reshape(height, width)[some]), mask


def _fit(inputs, how):
    with named_as({"target": inputs.targets[0]}):
        return fitting.fit(inputs.pictures, inputs.scenes, mask=inputs.masks, **how)


def _unexplained(trial, counted):
    """What a fit leaves of the codes in the files: the share of their squares."""
    left = total = 0.0
    for picture, shown, some in zip(trial.pictures, trial.fitted, counted, strict=True):
        codes, model = (
            encode(np.ascontiguousarray((values / picture.factor)[some], np.float32), picture.encoding)
            for values in (picture.pixels, shown)
        )
        codes = codes.astype(np.float64)
        left += np.sum((codes - model) ** 2) + codes.size * (picture.code_step or 0) ** 2 / 12
        total += np.sum(codes**2)
    return left / total


def judge(assumed: str, left: float, left_other: float) -> tuple[bool, str]:
    """Whether to keep the other encoding; and what to say, nothing where the pictures speak clearly for the assumed.

    ``left`` is the share of the squares that the assumed encoding leaves, ``left_other`` that of the other one.
    """
    if left < CLEARLY * left_other:
        return False, ""
    is_other, is_clear = left_other < LESS * left, left_other < CLEARLY * left
    names = [NAMES[assumed], NAMES[OTHER[assumed]]]
    shares = [f"{100 * share**0.5:.{2 if share < 0.99 else 3}g} %" for share in (left, left_other)]
    (taken, refused), (least, most) = (names[::-1], shares[::-1]) if is_other else (names, shares)
    reads = f"read as {taken}, under which" if is_clear else f"{taken} is a guess. Under it"
    off = f"the fit is off by {least} of the values in the file (rms), under {refused} by {most}"
    know = "Where you know better" if is_clear else "Where you know"
    return is_other, f"{reads} {off}. {know}, say so with --encoding"
