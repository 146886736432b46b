"""Pictures and scenes to fit, and the unit of their values."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import brdf
from brdf.errors import InputError
from fitting.photographs.light_files import parse_numbers


class Job(NamedTuple):
    """Pictures and scenes to fit.

    Attributes:
        pictures: arrays or `brdf.Picture`s.
        scenes: as many.
        masks: pixels to look at in each, or None for all.
        target: the first picture's file, for messages.
        notes: what was found out on the way, for the person who waits.
    """

    pictures: list[Any]
    scenes: list[brdf.Scene]
    masks: list[np.ndarray | None]
    target: Path
    notes: tuple[str, ...] = ()


def exposed(pictures: list[Any], exposure: str | None) -> list[Any]:
    """Pictures in one unit.

    Args:
        pictures: arrays or `brdf.Picture`s.
        exposure: one relative exposure, or one for each, as typed; None leaves them alone.

    Raises:
        InputError: where it is none.
    """
    if exposure is None:
        return pictures
    count = len(exposure.replace(",", " ").split())
    factors = parse_numbers(
        exposure, "--exposure", count if count in (1, len(pictures)) else 1, "one number, or one each"
    )
    if min(factors) <= 0:
        raise InputError("--exposure", f"must be above 0, got {exposure[:60]!r}", "Give a relative exposure time")
    factors = factors * len(pictures) if len(factors) == 1 else factors
    return [scaled(picture, 1.0 / factor) for picture, factor in zip(pictures, factors, strict=True)]


def scaled(picture: Any, factor: Any) -> Any:
    """A picture in another unit, and its clipping level and quantisation with it.

    Args:
        picture: an array or a `brdf.Picture`.
        factor: to multiply by, a number or one per channel.
    """
    if not isinstance(picture, brdf.Picture):
        return picture * np.float32(factor)
    return picture.scaled(factor)


def opaque(mask: np.ndarray | None, pictures: list[Any]) -> list[np.ndarray | None]:
    """Pixels to look at in each picture: those of the mask without the fully transparent ones, which show nothing.

    Args:
        mask: (H, W), or None.
        pictures: arrays or `brdf.Picture`s. Where alpha is 0 everywhere it was not meant.
    """
    masks = []
    for picture in pictures:
        alpha = getattr(picture, "alpha", None)
        visible = None if alpha is None or not alpha.any() or alpha.all() else alpha > 0
        if visible is None or (mask is not None and mask.shape != visible.shape):
            masks.append(mask)
        else:
            masks.append(visible if mask is None else visible & mask)
    return masks
