"""What photographs tell of their values themselves: from which on they are clipped, and how bright they are."""

import dataclasses
import functools
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
from jaxtyping import Float

from brdf.errors import InputError, as_numbers, what_came
from fitting.likelihood import over_channels
from fitting.maps.map_inputs import Photograph, places
from fitting.maps.tiles import MapProblem
from fitting.pixels import DOUBLE, SYMMETRIC_PIXELS
from fitting.problem import TOP
from fitting.solver.devices import core_count

SPIKE = 4
"""Values are clipped where so many times those just below them share the largest."""

JUST_BELOW = 1 / 256
"""Share of the largest value; the next largest one is always just below."""

ALIKE = 0.02
"""Share of the largest value by which texels that are alike differ at most, as where they are rounded to 8 bits."""

ROWS = 256
"""Rows that are read at a time."""

SINGLE = 1e30
"""Largest value, and inverse of the least, of a stack in single precision: it is of 1 when it is fitted."""


def with_levels(problem: MapProblem, saturation: Any = None) -> tuple[MapProblem, float, tuple[str, ...]]:
    """Photographs clipped where many texels of the stack share its largest value, and in a unit in which that is of 1.

    They are clipped where they say so themselves, and from ``saturation`` on. With the problem come the power of two by
    which its photographs are divided and what to tell of it; values out of reach of the precision are refused.
    """
    given, texels = problem.photographs, places(problem.texels)
    each, notes = given.each, ()
    brightest = [functools.partial(_brightest, one, texels) for one in each]
    with ThreadPoolExecutor(core_count()) as pool:
        largest = np.array(list(pool.map(lambda read: _two_largest(read()), brightest)))
    top, size = float(np.max(largest)), float(np.max(largest[:, 0] / np.mean(given.unit, axis=1)))
    if saturation is not None:
        value = as_numbers("saturation", saturation)
        if value.ndim or not value > 0:
            what = f"must be a number above 0, got {what_came(saturation)}"
            raise InputError("saturation", what, "Give the linear value of clipped pixels")
        each = tuple(dataclasses.replace(one, top=float(value) * TOP, stated=True) for one in each)
    elif top < max(one.top for one in each) and _is_clipped(brightest, largest):
        each = tuple(dataclasses.replace(one, top=min(one.top, top * TOP)) for one in each)
        notes = (f"many values share the largest, {top:.6g}: they are taken as clipped. Say otherwise with saturation",)
    if size <= 0:
        return problem, 1.0, ()
    reach = SINGLE if problem.precision == "float32" else DOUBLE
    for value in (size, top):
        if not 1 / reach <= value <= reach:
            what = f"have {value:.3g} as their largest value, out of reach of {problem.precision}"
            raise InputError("pictures", what, "Bring it nearer to 1, by another unit or by the intensities")
    unit = float(2.0 ** np.floor(np.log2(size)))
    photographs = dataclasses.replace(given, each=each, unit=given.unit * unit)
    return dataclasses.replace(problem, photographs=photographs), unit, notes


def in_unit(layers: dict[str, np.ndarray], unit: float) -> dict[str, np.ndarray]:
    """Layers of photographs that were divided by a unit, a power of two, as they are of those themselves."""
    of_light = ("k_", "fitted_k_s", "noise")
    return {
        name: layer * layer.dtype.type(unit) if name.startswith(of_light) else layer for name, layer in layers.items()
    }


def _brightest(one: Photograph, texels: Any) -> Float[np.ndarray, " K"]:
    """The brightest channel of each texel; NaN where one is missing."""
    height, _, channels = one.shape
    # By bands: in memory is one value a texel of one photograph.
    bands = (one.rows(first, min(first + ROWS, height)) for first in range(0, height, ROWS))
    values = np.concatenate([over_channels(np.maximum, band.reshape(-1, channels)) for band in bands])[texels]
    values[~np.isfinite(values)] = np.nan
    return values


def _two_largest(values: Float[np.ndarray, " K"]) -> tuple[float, float]:
    """The largest value, and the largest of those that do not share it; -infinite where there is none."""
    largest = np.fmax.reduce(values, initial=-np.inf)
    return float(largest), float(np.max(values, initial=-np.inf, where=values < largest * TOP))


def _is_clipped(brightest: list[Callable[[], Float[np.ndarray, " K"]]], largest: Float[np.ndarray, "P 2"]) -> bool:
    """Whether the largest value is a plateau above which there was more, of texels that differ elsewhere.

    Those of a smooth maximum have many just below; those of one material on a plane are alike under all lights.
    """
    level = np.max(largest) * TOP
    edge = min(np.max(largest, initial=-np.inf, where=largest < level) * TOP, level * (1 - JUST_BELOW))
    at_top, just_below, count = np.zeros(1, bool), 0, 0
    for values in (read() for read, (own, _) in zip(brightest, largest, strict=True) if own >= edge):
        at_top = at_top | (values >= level)
        count += np.count_nonzero(values >= level)
        just_below += np.count_nonzero((values >= edge) & (values < level))
    if count <= max(SYMMETRIC_PIXELS, SPIKE * just_below):
        return False
    for values in (read()[at_top] for read in brightest):
        lower = values[values < level]
        if lower.size and np.ptp(lower) > ALIKE * level:
            return True
    return False
