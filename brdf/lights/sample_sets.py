"""Deterministic sample sets: the nodes and weights of the rules by which lights with an extent are integrated.

All are product rules over the unit square: Gauss-Legendre in s, and in t the same or equal steps of a turn. They have
no noise, so a picture is a smooth function of every parameter of its lights. None has more nodes than are asked for.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from brdf.albedo import gauss_legendre


class SquareRule(NamedTuple):
    """A rule over the unit square, sum w f(s, t) for the integral of f.

    Attributes:
        s: first coordinates, (S,).
        t: second coordinates, (S,).
        weight: (S,), adds up to 1.
    """

    s: Float[np.ndarray, " S"]
    t: Float[np.ndarray, " S"]
    weight: Float[np.ndarray, " S"]


def square_rule(samples: int) -> SquareRule:
    """Gauss-Legendre in both directions, of the largest k × l nodes with k = ⌊√samples⌋."""
    rows = int(np.sqrt(samples))
    return _product(gauss_legendre(samples // rows), gauss_legendre(rows))


def disc_rule(samples: int) -> SquareRule:
    """A rule for a disc or cap: s is its share of the area, t its turn.

    With four times as many turns as radii it is exact for polynomials over the disc of equal degree in both.
    """
    return _turned(samples, round(np.sqrt(samples / 4)))


def hemisphere_rule(samples: int) -> SquareRule:
    """A rule for a hemisphere: s is the cosine to the pole, t the turn, with twice as many turns as cosines."""
    return _turned(samples, round(np.sqrt(samples / 2)))


def ring_rule(samples: int) -> SquareRule:
    """A rule for rings around a centre: s is which ring, t the turn; four rings for every three turns."""
    return _turned(samples, min(samples, round(np.sqrt(samples * 4 / 3))))


def _turned(samples: int, count: int) -> SquareRule:
    count = max(1, count)
    turns = samples // count
    return _product(gauss_legendre(count), ((np.arange(turns) + 0.5) / turns, np.full(turns, 1.0 / turns)))


def _product(first: tuple[np.ndarray, np.ndarray], second: tuple[np.ndarray, np.ndarray]) -> SquareRule:
    (s, s_weight), (t, t_weight) = first, second
    s_all, t_all = (x.ravel() for x in np.meshgrid(s, t, indexing="ij"))
    return SquareRule(s_all, t_all, np.outer(s_weight, t_weight).ravel())
