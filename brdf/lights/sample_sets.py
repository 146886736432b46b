"""Deterministic sample sets: the nodes and weights of the rules by which lights with an extent are integrated.

All are product rules over the unit square: Gauss-Legendre in s, and in t the same or equal steps of a turn. They have
no noise, so a picture is a smooth function of every parameter of its lights. None has more nodes than are asked for.
"""

from typing import NamedTuple

import numpy as np

from brdf.albedo import gauss_legendre


class SquareRule(NamedTuple):
    """A rule over the unit square, sum w f(s, t) for the integral of f.

    Attributes:
        s: first coordinates, (S,).
        t: second coordinates, (S,).
        weight: (S,), adds up to 1.
    """

    s: np.ndarray
    t: np.ndarray
    weight: np.ndarray


def square_rule(samples: int) -> SquareRule:
    """Gauss-Legendre in both directions, of the largest k × l nodes with k = ⌊√samples⌋."""
    rows = int(np.sqrt(samples))
    return _product(gauss_legendre(samples // rows), gauss_legendre(rows))


def turned_rule(samples: int, ratio: float) -> SquareRule:
    """A rule of circles: s is which, t the turn.

    With s a share of a disc's area it is exact for polynomials over the disc, of equal degree in both for a ratio of
    1/4; with s the cosine to the pole of a hemisphere, for one of 1/2.

    Args:
        samples: how many nodes at most.
        ratio: of the number of circles to that of the nodes on each.
    """
    count = int(np.clip(np.round(np.sqrt(samples * ratio)), 1, samples))
    turns = samples // count
    return _product(gauss_legendre(count), ((np.arange(turns) + 0.5) / turns, np.full(turns, 1.0 / turns)))


def _product(first: tuple[np.ndarray, np.ndarray], second: tuple[np.ndarray, np.ndarray]) -> SquareRule:
    s, t = np.meshgrid(first[0], second[0], indexing="ij")
    return SquareRule(s.ravel(), t.ravel(), np.outer(first[1], second[1]).ravel())
