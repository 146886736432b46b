"""Deterministic sample sets: the nodes and weights of the rules by which lights with an extent are integrated.

All are product rules. They have no noise, so a picture is a smooth function of every parameter of its lights.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float


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


def gauss_legendre(count: int) -> tuple[Float[np.ndarray, " count"], Float[np.ndarray, " count"]]:
    """Nodes and weights over (0, 1), exact for polynomials up to degree 2 count - 1.

    Args:
        count: at least 1.
    """
    nodes, weights = np.polynomial.legendre.leggauss(count)
    return 0.5 * (nodes + 1), 0.5 * weights


def square_rule(samples: int) -> SquareRule:
    """Gauss-Legendre in both directions, with as many nodes as go into the number of samples.

    Args:
        samples: at least 1; the rule has at most so many nodes, the largest k × l with k = ⌊√samples⌋.
    """
    rows = int(np.sqrt(samples))
    s, s_weight = gauss_legendre(samples // rows)
    t, t_weight = gauss_legendre(rows)
    return _product(s, s_weight, t, t_weight)


def disc_rule(samples: int) -> SquareRule:
    """A rule for a disc or cap: Gauss-Legendre in s, its share of the area, and equal steps of t, its turn.

    With four times as many turns as radii it is exact for polynomials over the disc of equal degree in both.

    Args:
        samples: at least 1; the rule has at most so many nodes.
    """
    radii = max(1, round(np.sqrt(samples / 4)))
    s, s_weight = gauss_legendre(radii)
    turns = samples // radii
    t, t_weight = (np.arange(turns) + 0.5) / turns, np.full(turns, 1.0 / turns)
    return _product(s, s_weight, t, t_weight)


def hemisphere_rule(samples: int) -> SquareRule:
    """A rule for a hemisphere: Gauss-Legendre in s, the cosine to the pole, and equal steps of t, the turn.

    Args:
        samples: at least 1; the rule has at most so many nodes, twice as many turns as cosines.
    """
    cosines = max(1, round(np.sqrt(samples / 2)))
    s, s_weight = gauss_legendre(cosines)
    turns = samples // cosines
    t, t_weight = (np.arange(turns) + 0.5) / turns, np.full(turns, 1.0 / turns)
    return _product(s, s_weight, t, t_weight)


def ring_rule(samples: int) -> SquareRule:
    """A rule for rings around a centre: Gauss-Legendre in s, which ring, and equal steps of t, the turn.

    Args:
        samples: at least 1; the rule has at most so many nodes, four rings for every three turns.
    """
    rings = max(1, round(np.sqrt(samples * 4 / 3)))
    rings = min(rings, samples)
    s, s_weight = gauss_legendre(rings)
    turns = samples // rings
    t, t_weight = (np.arange(turns) + 0.5) / turns, np.full(turns, 1.0 / turns)
    return _product(s, s_weight, t, t_weight)


def _product(s: np.ndarray, s_weight: np.ndarray, t: np.ndarray, t_weight: np.ndarray) -> SquareRule:
    s_all, t_all = (x.ravel() for x in np.meshgrid(s, t, indexing="ij"))
    return SquareRule(s_all, t_all, np.outer(s_weight, t_weight).ravel())
