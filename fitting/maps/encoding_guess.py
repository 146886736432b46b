"""Photographs that do not say how they are encoded: read as that under which the model explains their codes better."""

import dataclasses

import numpy as np

from brdf.images.encoding import Encoding
from fitting.maps.texels import OUTLIER
from fitting.maps.tiles import TILE, MapProblem
from fitting.progress import waiting

SOME = 4 * TILE
"""Texels that tell, of few rows."""

LESS = 0.9
"""Silent photographs are read in the unusual way where that leaves less than this share of the squares."""


def likelier(problem: MapProblem) -> tuple[MapProblem, tuple[str, ...]]:
    """Silent photographs as sRGB or linear light: under distant lights as is left less of some texels' codes.

    Args:
        problem: with silent ones read as is usual for their bits.

    Returns:
        The problem, and what to tell of it.
    """
    given, texels = problem.photographs, problem.texels
    silent = next((one for one in given.each if one.silent), None)
    if silent is None:
        return problem, ()
    remedy = "Where you know, say so with the encoding"
    note = f"{silent.name} does not say how its values are encoded: read as"
    usual, other = ("linear", "sRGB") if silent.curve == "linear" else ("sRGB", "linear")
    as_usual = problem, (f"{note} {usual}. {remedy}",)
    if given.to_light is None or not texels.size:
        return as_usual
    row = texels // given.size[1]
    rows = np.unique(row)
    rows = rows[np.linspace(0, rows.size - 1, -(-min(SOME, texels.size) * rows.size // texels.size)).astype(int)]
    texels = texels[np.isin(row, rows)]
    texels = texels[:: -(-texels.size // SOME)]
    readings, left = {}, {}
    encodings: dict[str, Encoding] = {"sRGB": "srgb", "linear": "linear"}
    for name, encoding in encodings.items():
        each = tuple(one.read_as(encoding) if one.silent else one for one in given.each)
        readings[name] = one = dataclasses.replace(problem, photographs=dataclasses.replace(given, each=each))
        with waiting(f"fitting some texels as {name}"):
            layers = {key: layer[: texels.size] for key, layer in one.fit(*one.tiles(texels)).items()}
        codes = 255 * np.sqrt(np.mean(given.unit**2)) * layers["noise"]
        if np.all(np.isnan(codes)):
            return as_usual
        left[name] = np.nanmedian(codes * np.sqrt(1 + OUTLIER**2 * layers["left_out"]))
    if left[other] ** 2 < LESS * left[usual] ** 2:
        usual, other = other, usual
    note += f" {usual}, under which the maps are off by {left[usual]:.2g} codes, under {other} by {left[other]:.2g}"
    return readings[usual], (f"{note}. {remedy}",)
