"""Photographs that do not say how they are encoded: read as that under which the model explains their codes better."""

import dataclasses

import numpy as np

from fitting.maps.texels import OUTLIER
from fitting.maps.tiles import TILE, MapProblem

LESS = 0.9
"""Photographs of 8 bits that do not say so are linear where that leaves less than this share of sRGB's squares."""


def likelier(problem: MapProblem) -> tuple[MapProblem, tuple[str, ...]]:
    """Silent photographs as sRGB or, under distant lights, as linear light: as is left less of the codes of some rows.

    Args:
        problem: with silent ones read as sRGB.

    Returns:
        The problem, and what to tell of it.
    """
    given, (normal, mask, *_) = problem.photographs, problem.surface
    silent = [one.name for one in given.each if one.silent]
    if not silent:
        return problem, ()
    mask = np.asarray(mask) & (True if normal is None else np.any(np.asarray(normal) != 0, axis=-1))
    rows, told = np.flatnonzero(np.any(mask, axis=1)), "Where you know, say so with the encoding"
    note = f"{silent[0]} does not say how its values are encoded: read as"
    if given.to_light is None or not rows.size:
        return problem, (f"{note} sRGB. {told}",)
    width = given.size[1]
    rows = rows[np.linspace(0, rows.size - 1, min(rows.size, max(1, 4 * TILE // width))).astype(int)]
    readings = {"sRGB": problem, "linear": dataclasses.replace(problem, photographs=given.as_linear())}
    left = []
    for one in readings.values():
        layers = one.fit(*one.tiles(rows, -(-rows.size * width // TILE) * TILE))
        left.append(255 * np.nanmedian(layers["noise"] * np.sqrt(1 + OUTLIER**2 * layers["left_out"])))
    names = list(readings) if left[1] ** 2 >= LESS * left[0] ** 2 else ["linear", "sRGB"]
    less, more = (left[list(readings).index(name)] for name in names)
    note += f" {names[0]}, under which the maps are off by {less:.2g} codes, under {names[1]} by {more:.2g}"
    return readings[names[0]], (f"{note}. {told}",)
