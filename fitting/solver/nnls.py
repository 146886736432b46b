"""Least squares under bounds, from the sums of its columns: the coefficients are at least 0, and may have a cap.

| problem | function | how |
| --- | --- | --- |
| many of a few unknowns: a channel at an exponent | `nonnegative_minima` | every active set, best one taken |
| one of any size: what channels share, lights | `nonnegative_minimum` | Lawson and Hanson choose the sets |
"""

import itertools

import numpy as np
from jaxtyping import Bool, Float

# A combination of columns that keeps less than this of their squares is none.
DEPENDENT = 1e-10
# By so much rounding may lift a sum that has a cap over it.
ROUNDING = 1e-12


def _eliminate(
    gram: Float[np.ndarray, "*K U U"], right: Float[np.ndarray, "*K U"], tolerance: float, definite: int
) -> tuple[Float[np.ndarray, "*K U"], Bool[np.ndarray, "*K"]]:
    """The solution, and whether what elimination leaves of the diagonal of the first ``definite`` rows is no rounding.

    Gauss-Jordan; a symmetric definite system needs no pivoting.
    """
    whole = np.concatenate([gram, right[..., None]], axis=-1)
    regular = np.ones(right.shape[:-1], bool)
    for i in range(right.shape[-1]):
        pivot = whole[..., i, i]
        regular &= pivot > tolerance * gram[..., i, i] if i < definite else pivot < 0
        row = whole[..., i, :] / np.where(pivot == 0, 1.0, pivot)[..., None]
        whole -= whole[..., :, i, None] * row[..., None, :]
        whole[..., i, :] = row
    return whole[..., -1], regular


@np.errstate(over="ignore", invalid="ignore", divide="ignore")
def nonnegative_minima(
    gram: Float[np.ndarray, "*K U U"],
    product: Float[np.ndarray, "*K U"],
    start: Float[np.ndarray, "*#K U"],
    free: Bool[np.ndarray, "*#K U"],
    tolerance: float,
    cap: Float[np.ndarray, "*#K U"] | None = None,
) -> Float[np.ndarray, "*K U"]:
    """Minimise (x - s) G (x - s) - 2 b (x - s) over x at least 0, and w x at most 1 where there is a cap, exactly.

    A few unknowns have a few active sets: all are solved and the best feasible one is taken. That has no iterations and
    no tolerance on the answer. The step from the start is what is solved for, so no digits are lost near the optimum.

    Args:
        gram: G, of any number of problems.
        product: b.
        start: s.
        free: which unknowns may be above 0.
        tolerance: share of a diagonal entry below which what elimination leaves of it counts as rounding: the column
            then depends on the others, and a smaller active set does as well.
        cap: w, at least 0.

    Source: for the sets on the cap, Nocedal and Wright, Numerical Optimization, 2006, section 16.5.
    """
    unknowns = product.shape[-1]
    sets = np.array(list(itertools.product([False, True], repeat=unknowns)))
    active = sets.reshape(-1, *(1,) * (product.ndim - 1), unknowns)
    leave = np.where(active, 0.0, start)
    both = active[..., :, None] & active[..., None, :]
    system = np.where(both, gram, np.eye(unknowns))
    right = np.where(active, product + (gram @ leave[..., None])[..., 0], 0.0)
    gain, regular = _eliminate(system, right, tolerance, unknowns)
    x = np.where(active, start + gain, 0.0)
    feasible = regular & np.all(~active | (free & (x >= 0)), axis=-1)
    if cap is not None:
        weight = np.where(active, cap, 0.0)
        feasible &= np.sum(weight * x, axis=-1) <= 1 + ROUNDING
        bordered = np.zeros((*system.shape[:-2], unknowns + 1, unknowns + 1))
        bordered[..., :-1, :-1] = system
        bordered[..., -1, :-1] = bordered[..., :-1, -1] = weight
        room = 1 - np.sum(weight * start, axis=-1, keepdims=True)
        gain, regular = _eliminate(bordered, np.concatenate([right, room], axis=-1), tolerance, unknowns)
        capped = np.where(active, start + gain[..., :-1], 0.0)
        regular &= np.all(~active | (free & (capped >= 0)), axis=-1)
        x, feasible = np.concatenate([x, capped]), np.concatenate([feasible, regular])
    step = x - start
    change = np.sum(step * ((gram @ step[..., None])[..., 0] - 2 * product), axis=-1)
    best = np.argmin(np.where(feasible, change, np.inf), axis=0)
    return np.take_along_axis(x, best[None, ..., None], axis=0)[0]


def nonnegative_minimum(
    gram: Float[np.ndarray, "U U"], product: Float[np.ndarray, " U"], signed: Bool[np.ndarray, " U"] | None = None
) -> Float[np.ndarray, " U"]:
    """Minimise x G x - 2 b x over x at least 0, except where ``signed``: the active set method.

    Args:
        gram: G, positive semidefinite.
        product: b.
        signed: which unknowns may be negative; None for none.

    Source: C. L. Lawson and R. J. Hanson, Solving Least Squares Problems, 1974, chapter 23.
    """
    if not product.size:
        return product
    signed = np.zeros(product.size, bool) if signed is None else signed
    usable = np.diag(gram) > np.finfo(float).tiny
    scale = np.sqrt(np.where(usable, np.diag(gram), 1.0))
    gram, product = gram / np.outer(scale, scale), np.where(usable, product / scale, 0.0)
    passive = signed & usable
    x = np.zeros(product.size)
    tolerance = 1e-13 * max(float(np.max(np.abs(product))), np.finfo(float).tiny)
    for _ in range(4 * product.size + 4):
        while True:
            trial = np.zeros_like(x)
            trial[passive] = np.linalg.lstsq(gram[np.ix_(passive, passive)], product[passive], rcond=1e-13)[0]
            negative = passive & ~signed & (trial <= 0)
            if not negative.any():
                break
            shares = np.full(x.shape, np.inf)
            shares[negative] = x[negative] / np.maximum(x - trial, np.finfo(float).tiny)[negative]
            share = np.min(shares)
            x = x + share * (trial - x)
            passive &= ~(negative & ((x <= 1e-15 * np.max(np.abs(x))) | (shares <= share)))
            x = np.where(passive, x, 0.0)
        x = trial
        gain = np.where(passive | ~usable, -np.inf, product - gram @ x)
        best = int(np.argmax(gain))
        if not gain[best] > tolerance:
            break
        passive[best] = True
    return x / scale


def inverse_diagonal(gram: Float[np.ndarray, "U U"], share: float = DEPENDENT) -> Float[np.ndarray, " U"]:
    """The diagonal of the inverse; infinite for an unknown that takes part in an undetermined combination.

    Args:
        gram: positive semidefinite.
        share: of the largest eigenvalue, unknowns in units of their own columns; a smaller one determines nothing.
    """
    found = np.full(len(gram), np.inf)
    lit = np.diag(gram) > 0
    if lit.any():
        scale = np.sqrt(np.diag(gram)[lit])
        value, vector = np.linalg.eigh(gram[np.ix_(lit, lit)] / np.outer(scale, scale))
        known = value > share * value[-1]
        inverse = np.sum(vector[:, known] ** 2 / value[known], axis=1)
        inverse[np.any(np.abs(vector[:, ~known]) > 1e-3, axis=1)] = np.inf
        found[lit] = inverse / scale**2
    return found
