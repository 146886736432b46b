"""Photographs that do not say how they are encoded: read as that under which the model explains their codes better."""

from typing import Any

import numpy as np

from brdf.images.encoding import Encoding, encode
from fitting.maps.map_inputs import Photographs
from fitting.maps.tiles import TILE, How, fit_band

LESS = 0.9
"""Photographs of 8 bits that do not say so are linear where that leaves less than this share of sRGB's squares."""


def likelier(given: Photographs, surface: Any, how: How) -> tuple[Photographs, tuple[str, ...]]:
    """Silent photographs as sRGB or, under distant lights, as linear light: as is left less of the codes of some rows.

    Args:
        given: read as sRGB.
        surface: what the texels see.
        how: they are fitted.
    """
    width, mask = given.shape[2], np.asarray(surface.mask)
    if surface.normal is not None:
        mask = mask & np.any(np.asarray(surface.normal) != 0, axis=-1)
    rows = np.flatnonzero(np.any(mask, axis=1))
    silent = f"{given.silent[0]} does not say how its values are encoded: read as"
    told = "Where you know, say so with the encoding"
    if given.to_light is None or not rows.size:
        return given, (f"{silent} sRGB. {told}",)
    rows = rows[np.linspace(0, rows.size - 1, min(rows.size, max(1, 4 * TILE // width))).astype(int)]
    other = given.as_linear()  # whose values are the codes
    count, left, codes = rows.size * width, [], other.band(rows, rows.size * width, how.precision)
    codes = np.where(codes < other.top[:, None, None], codes, np.nan)
    readings: tuple[tuple[Photographs, Encoding], ...] = ((given, "srgb"), (other, "linear"))
    for one, encoding in readings:
        texels = -(-count // TILE) * TILE
        layers = fit_band(one, how, one.band(rows, texels, how.precision), surface.some(rows, texels, how.precision))
        shaped = {name: layer[:count].reshape(rows.size, width, *layer.shape[1:]) for name, layer in layers.items()}
        maps, square = how.maps(shaped), np.zeros(count)
        for p, code in enumerate(codes):
            ambient = 0 if maps.k_a is None or how.ambient is None else maps.k_a * how.ambient[p]
            shown = encode((maps.render(given.to_light[p]) + ambient) * one.unit[p], encoding)
            square += np.sum(np.nan_to_num(shown.reshape(code.shape) - code) ** 2, axis=-1)
        shown = np.nansum(codes**2, axis=(0, 2))
        counts = mask[rows].ravel() & (shown > 0)
        left.append(float(np.median(np.sqrt(square[counts] / shown[counts]))) if np.any(counts) else 1.0)
    kept = int(left[1] ** 2 < LESS * left[0] ** 2)
    names = ("sRGB", "linear")
    note = (
        f"{silent} {names[kept]}, under which the maps are off by {100 * left[kept]:.2g} % of a texel's codes, "
        f"under {names[1 - kept]} by {100 * left[1 - kept]:.2g} %. {told}"
    )
    return (given, other)[kept], (note,)
