"""Photographs that do not say how they are encoded: read as that under which the model explains their codes better."""

import dataclasses

import numpy as np

from fitting.maps.texels import OUTLIER
from fitting.maps.tiles import TILE, MapProblem

SOME = 4 * TILE
"""Texels that tell, of few rows."""

LESS = 0.9
"""Photographs of 8 bits that do not say so are linear where that leaves less than this share of sRGB's squares."""


def likelier(problem: MapProblem) -> tuple[MapProblem, tuple[str, ...]]:
    """Silent photographs as sRGB or, under distant lights, as linear light: as is left less of some texels' codes.

    Args:
        problem: with silent ones read as sRGB.

    Returns:
        The problem, and what to tell of it.
    """
    given, texels = problem.photographs, problem.texels
    silent = [one.name for one in given.each if one.silent]
    if not silent:
        return problem, ()
    told = "Where you know, say so with the encoding"
    note = f"{silent[0]} does not say how its values are encoded: read as"
    if given.to_light is None or not texels.size:
        return problem, (f"{note} sRGB. {told}",)
    row = texels // given.size[1]
    rows = np.unique(row)
    rows = rows[np.linspace(0, rows.size - 1, -(-min(SOME, texels.size) * rows.size // texels.size)).astype(int)]
    texels = texels[np.isin(row, rows)]
    texels = texels[:: -(-texels.size // SOME)]
    readings = {"sRGB": problem, "linear": dataclasses.replace(problem, photographs=given.as_linear())}
    left = []
    for one in readings.values():
        layers = one.fit(*one.tiles(texels))
        left.append(255 * np.nanmedian(layers["noise"] * np.sqrt(1 + OUTLIER**2 * layers["left_out"])))
    names = list(readings) if left[1] ** 2 >= LESS * left[0] ** 2 else ["linear", "sRGB"]
    less, more = (left[list(readings).index(name)] for name in names)
    note += f" {names[0]}, under which the maps are off by {less:.2g} codes, under {names[1]} by {more:.2g}"
    return readings[names[0]], (f"{note}. {told}",)
