"""What photographs, normals and single texels do not say of themselves: of two readings that which explains more."""

import dataclasses

import numpy as np
from jaxtyping import Int

from brdf.images.encoding import Encoding
from brdf.models.base import SpecularMaterial
from fitting.maps.texels import OUTLIER
from fitting.maps.tiles import TILE, MapProblem
from fitting.progress import waiting

SOME = 4 * TILE
"""Texels that tell, of few rows."""

LESS = 0.9
"""Silent photographs are read in the unusual way where that leaves less than this share of the squares."""

ROUNDS = 50
"""Of expectation and maximisation."""

MISFIT, FAR_LESS = 0.1, 0.5
"""Normals are doubted where they leave this share of what photographs show, and seem to be upside down where turning
them leaves less than that share of the squares."""


def likelier(problem: MapProblem) -> tuple[MapProblem, tuple[str, ...]]:
    """Silent photographs as sRGB or linear light: under distant lights as is left less of some texels' codes.

    Given as is usual for their bits; with the problem comes what to tell of it.
    """
    given = problem.photographs
    silent = next((one for one in given.each if one.silent), None)
    if silent is None:
        return problem, ()
    remedy = "Where you know, say so with the encoding"
    note = f"{silent.name} does not say how its values are encoded: read as"
    usual, other = ("linear", "sRGB") if silent.curve == "linear" else ("sRGB", "linear")
    encodings: dict[str, Encoding] = {"sRGB": "srgb", "linear": "linear"}
    readings = {}
    for name, encoding in encodings.items():
        each = tuple(one.read_as(encoding) if one.silent else one for one in given.each)
        readings[name] = dataclasses.replace(problem, photographs=dataclasses.replace(given, each=each))
    left = {name: _left(one) for name, one in readings.items()}
    if any(np.isnan(one) for one in left.values()):
        return problem, (f"{note} {usual}. {remedy}",)
    if left[other] ** 2 < LESS * left[usual] ** 2:
        usual, other = other, usual
    note += f" {usual}, under which the maps are off by {left[usual]:.2g} codes, under {other} by {left[other]:.2g}"
    return readings[usual], (f"{note}. {remedy}",)


def upside_down(problem: MapProblem, residual: np.ndarray) -> tuple[str, ...]:
    """A note where some texels fit far better with y of the given normals turned: in many programs it goes down.

    The residual is that of the maps, over what photographs show; of normals that are not given nothing is said.
    """
    surface = problem.surface
    if surface.normal is None or surface.points is not None or not np.nanmedian(residual) > MISFIT:
        return ()
    turned = surface._replace(normal=surface.normal * np.array([1, -1, 1], np.float32))
    left, otherwise = map(_left, (problem, dataclasses.replace(problem, surface=turned)))
    if not otherwise**2 < FAR_LESS * left**2:
        return ()
    what = f"y of the normals and of the lights disagree: turned over, they leave {otherwise / left:.2g} of the misfit"
    return (f"{what}. Where y goes down in the normals, flip_y (--flip-y) says so",)


def with_prices(problem: MapProblem) -> MapProblem:
    """The problem with a price on each lobe: of two that serve a texel alike it then has that which more texels have.

    The price is minus twice the logarithm of the lobe's share over the largest, as criteria are of the likelihood. The
    shares among texels that show a lobe are found by expectation and maximisation (Dempster, Laird and Rubin, J. R.
    Stat. Soc. B 39, 1977) from some of them. A problem of one model stays as it is.
    """
    glossy = np.array([issubclass(model, SpecularMaterial) for model in problem.models])
    if np.count_nonzero(glossy) < 2 or not problem.texels.size:
        return problem
    criteria = some_layers(problem)[1]["criteria"].astype(float)
    shine = criteria[np.isfinite(criteria).all(axis=1) & glossy[np.argmin(criteria, axis=1)]][:, glossy]
    if not shine.size:
        return problem
    likelihood, shares = np.exp(-0.5 * (shine - np.min(shine, axis=1, keepdims=True))), np.ones(shine.shape[1])
    for _ in range(ROUNDS):
        parts = likelihood * shares
        # No lobe is ruled out by some texels.
        shares = np.mean(parts / np.sum(parts, axis=1, keepdims=True), axis=0) + 1 / len(shine)
    prices = np.zeros(len(glossy))
    # Rounded: what is kept of bands is named by them, also where processes on unlike machines look for it.
    prices[glossy] = np.round(-2 * np.log(shares / np.max(shares)), 1)
    return dataclasses.replace(problem, prices=tuple(prices.tolist()))


def _left(problem: MapProblem) -> float:
    """What is left of some texels' codes, under distant lights; NaN where none of them tells."""
    given = problem.photographs
    if given.to_light is None or not problem.texels.size:
        return np.nan
    _, layers = some_layers(problem)
    codes = 255 * np.sqrt(np.mean(given.unit**2)) * layers["noise"] * np.sqrt(1 + OUTLIER**2 * layers["left_out"])
    return float(np.nanmedian(codes)) if np.any(np.isfinite(codes)) else np.nan


def some_layers(problem: MapProblem) -> tuple[Int[np.ndarray, " K"], dict[str, np.ndarray]]:
    """Some texels, of which there are any, and their layers."""
    texels = problem.texels
    row = texels // problem.photographs.size[1]
    rows = np.unique(row)
    rows = rows[np.linspace(0, rows.size - 1, -(-min(SOME, texels.size) * rows.size // texels.size)).astype(int)]
    texels = texels[np.isin(row, rows)]
    texels = texels[:: -(-texels.size // SOME)]
    with waiting("fitting some texels"):
        return texels, {name: layer[: texels.size] for name, layer in problem.fit(*problem.tiles(texels)).items()}
