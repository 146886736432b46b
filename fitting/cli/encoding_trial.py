"""Pictures that do not say how they are encoded: which of two interpretations the model explains.

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
from fitting.cli.inputs import FitInputs, Given, collect
from fitting.result import FitResult

# The other encoding is taken where it leaves less than this share of the squares that the assumed one leaves...
LESS = 0.9
# ... and one of them is no guess where it leaves less than this share of what the other leaves.
CLEARLY = 0.5


def fit_either(given: Given, say: Callable[[str], None] = lambda what: None, **how: Any) -> tuple[FitResult, FitInputs]:
    """Fit, where a file does not say how it is encoded under both interpretations.

    Args:
        given: to the command.
        say: what is being done.
        how: further arguments of `fitting.fit`; seconds are shared by the two fits.

    Returns:
        The fit to keep, with a warning where the encoding is a guess or was changed; and what was fitted.

    Raises:
        InputError: naming the file or option.
    """
    silent = {path: picture for path, picture in given.pictures.items() if picture.source == "assumed"}
    if silent and how["seconds"] is not None:
        how["seconds"] /= 2
    count = len(given.pictures)
    what = f"fitting {count} pictures" if count > 1 else "fitting"
    say(f"{what} as {_name(next(iter(silent.values())).encoding)}" if silent else what)
    inputs, result = _fit(given, {}, how)
    if not silent:
        return result, inputs
    say(f"{what} as {_name(_other(next(iter(silent.values()))))}")
    try:
        others = {path: brdf.read_picture(path, encoding=_other(picture)) for path, picture in silent.items()}
        other_inputs, other = _fit(given, others, how)
    except InputError:
        return result, inputs  # under the other encoding it cannot be fitted at all
    # To be compared where both count: each leaves out what under its own encoding is cut off.
    both = [mine & its for mine, its in zip(result.counted, other.counted, strict=True)]
    common = both if all(counted.any() for counted in both) else None
    shares = _unexplained(inputs, result, common), _unexplained(other_inputs, other, common)
    is_other, warning = judge(given.targets[0], next(iter(silent.values())), shares)
    if is_other:
        result, inputs = other, other_inputs
    return dataclasses.replace(result, warnings=(*result.warnings, *warning)), inputs


def _fit(given: Given, others: dict[Path, brdf.Picture], how: dict[str, Any]) -> tuple[FitInputs, FitResult]:
    inputs = collect(given._replace(pictures=given.pictures | others))
    with named_as({"target": given.targets[0]}):
        return inputs, fitting.fit(inputs.pictures, inputs.scenes, mask=inputs.masks, **how)


def _other(picture: brdf.Picture) -> Any:
    return "srgb" if picture.encoding == "linear" else "linear"


def _name(encoding: Any) -> str:
    return "sRGB" if encoding == "srgb" else str(encoding)


def _unexplained(inputs: FitInputs, result: FitResult, counted: list[np.ndarray] | None) -> float:
    """What a fit leaves of the codes in the files: the share of their squares; None for the pixels that it counts."""
    left = total = 0.0
    for picture, scene, some in zip(inputs.pictures, result.scenes, counted or result.counted, strict=True):
        model = np.broadcast_to(brdf.render(result.material, scene), picture.pixels.shape)
        codes, fitted = (
            encode(np.ascontiguousarray((values / picture.factor)[some], np.float32), picture.encoding)
            for values in (picture.pixels, model)
        )
        codes = codes.astype(np.float64)
        left += np.sum((codes - fitted) ** 2) + codes.size * (picture.code_step or 0) ** 2 / 12
        total += np.sum(codes**2)
    return left / total


def judge(target: Path, picture: brdf.Picture, shares: tuple[float, float]) -> tuple[bool, list[str]]:
    """Which of two encodings to keep, and what to say about it.

    Args:
        target: the first file.
        picture: one that does not say how it is encoded, as assumed.
        shares: what is left as assumed, and the other way.

    Returns:
        Whether it is the other one; and the warning, none where the pictures speak clearly for what was assumed.
    """
    assumed, other = shares
    if assumed < CLEARLY * other:
        return False, []
    is_other, is_clear = other < LESS * assumed, other < CLEARLY * assumed
    names = [_name(one) for one in (picture.encoding, _other(picture))]
    left = [f"{100 * share**0.5:.{2 if share < 0.99 else 3}g} %" for share in shares]
    (taken, refused), (least, most) = (names[::-1], left[::-1]) if is_other else (names, left)
    reads = f"read as {taken}, under which" if is_clear else f"{taken} is a guess. Under it"
    off = f"the fit is off by {least} of the values in the file (rms), under {refused} by {most}"
    know = "Where you know better" if is_clear else "Where you know"
    silent = f"{target.name} does not say how its values are encoded"
    return is_other, [f"{silent}: {reads} {off}. {know}, say so with --encoding"]
