"""Least squares under bounds, from the sums of its columns: the coefficients are at least 0, and may have a cap.

| problem | function | how |
| --- | --- | --- |
| many of a few unknowns: a channel at an exponent | `nonnegative_minima` | every active set, best one taken |
| one of any size: what channels share, lights | `nonnegative_minimum` | Lawson and Hanson choose the sets |
"""

import itertools
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from fitting.likelihood import AnyArray

# By so much rounding may lift a sum that has a cap over it.
ROUNDING = 1e-12


@np.errstate(over="ignore", invalid="ignore", divide="ignore")
def solve_active(gram: Any, right: Any, active: Any) -> tuple[Any, Any]:
    """Solve a symmetric system among the active unknowns, 0 beside them, by NumPy or JAX.

    Gauss and Jordan; a symmetric definite system needs no pivoting. On a cap the last pivot is below 0.

    Args:
        gram: (..., U, U).
        right: (..., U).
        active: (..., U).

    Returns:
        The solution, and the smallest share of its diagonal entry that a pivot keeps.
    """
    xp: Any = np if isinstance(gram, np.ndarray) else jnp
    size = gram.shape[-1]
    system = xp.where(active[..., :, None] & active[..., None, :], gram, xp.eye(size, dtype=gram.dtype))
    right = xp.broadcast_to(xp.where(active, right, 0), system.shape[:-1])
    whole, kept = xp.concatenate([system, right[..., None]], axis=-1), xp.inf
    for i in range(size):
        pivot, diagonal = whole[..., i, i], system[..., i, i]
        share = xp.where(diagonal > 0, pivot / xp.where(diagonal > 0, diagonal, 1), xp.where(pivot < 0, xp.inf, 0))
        row = (whole[..., i, :] / xp.where(pivot == 0, 1, pivot)[..., None])[..., None, :]
        others = whole - whole[..., :, i, None] * row
        kept, whole = xp.minimum(kept, share), xp.where(np.arange(size)[:, None] == i, row, others)
    return xp.where(active, whole[..., -1], 0), kept


@np.errstate(over="ignore", invalid="ignore", divide="ignore")
def nonnegative_minima(
    gram: Float[AnyArray, "*#K U U"],
    product: Float[AnyArray, "*K U"],
    start: Float[AnyArray, "*#K U"],
    free: Bool[AnyArray, "*#K U"],
    tolerance: float,
    cap: Float[np.ndarray, "*#K U"] | None = None,
) -> Any:
    """Minimise (x - s) G (x - s) - 2 b (x - s) over x at least 0, and w x at most 1 where there is a cap, exactly.

    A few unknowns have a few active sets: all are solved and the best feasible one is taken. That has no iterations and
    no tolerance on the answer. The step from the start is what is solved for, so no digits are lost near the optimum.
    The multiplier of a cap is one more unknown, which starts at 0.

    Args:
        gram: G, of any number of problems; by NumPy, or by JAX where it is an array of that.
        product: b.
        start: s.
        free: which unknowns may be above 0.
        tolerance: share of a diagonal entry below which what elimination leaves of it counts as rounding: the column
            then depends on the others, and a smaller active set does as well.
        cap: w, at least 0; by NumPy alone.

    Returns:
        x, (..., U).

    Source: for the sets on the cap, Nocedal and Wright, Numerical Optimization, 2006, section 16.5.
    """
    xp: Any = np if isinstance(gram, np.ndarray) else jnp
    unknowns = product.shape[-1]
    start, scale = xp.broadcast_to(start, product.shape), 1.0
    if cap is not None:
        # In units in which each counts 1, or rounding would lift a small one that counts much over the cap.
        scale = np.where(cap > 0, 1 / np.where(cap > 0, cap, 1.0), 1.0)
        gram, product, start = gram * scale[..., :, None] * scale[..., None, :], product * scale, start / scale
        cap = (cap > 0).astype(float)
    system, right, begin = gram, product, start
    if cap is not None:
        more = [(0, 0)] * (product.ndim - 1)
        system = np.pad(gram, np.array([*more, (0, 1), (0, 1)]))
        system[..., -1, :-1] = system[..., :-1, -1] = cap
        right = np.concatenate([product, 1 - np.sum(cap * start, axis=-1, keepdims=True)], axis=-1)
        begin = np.pad(start, np.array([*more, (0, 1)]))
    every = np.array(list(itertools.product([False, True], repeat=right.shape[-1])))
    x, feasible = start, np.zeros(0, bool)
    # Mostly all that may be above 0 are; where one is not, every set is tried.
    for sets in (every[-1:], every) if cap is None and xp is np else (every,):
        active = sets.reshape(-1, *(1,) * (product.ndim - 1), right.shape[-1])
        if cap is None:
            active = active & free
        move, kept = solve_active(system, right + (system @ xp.where(active, 0, begin)[..., None])[..., 0], active)
        x = xp.where(active, begin + move, 0)[..., :unknowns]
        feasible = (kept > tolerance) & xp.all(~active[..., :unknowns] | (free & (x >= 0)), axis=-1)
        if len(sets) == 1 and feasible.all():
            return x[0]
    if cap is not None:
        feasible &= np.sum(cap * x, axis=-1) <= 1 + ROUNDING
    step = x - start
    change = xp.sum(step * ((gram @ step[..., None])[..., 0] - 2 * product), axis=-1)
    best = xp.argmin(xp.where(feasible, change, xp.inf), axis=0)
    return xp.take_along_axis(x, best[None, ..., None], axis=0)[0] * scale


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
    usable = np.diag(gram) > np.finfo(float).tiny
    scale = np.sqrt(np.where(usable, np.diag(gram), 1.0))
    gram, product = gram / np.outer(scale, scale), np.where(usable, product / scale, 0.0)
    signed = np.zeros(product.size, bool) if signed is None else signed
    # Mostly no bound is reached.
    x, _, rank, _ = np.linalg.lstsq(gram, product, rcond=1e-13)
    if rank == product.size and np.all(signed | (x > 0)):
        return x / scale
    passive, x = signed & usable, np.zeros(product.size)
    tolerance = 1e-13 * np.max(np.abs(product), initial=np.finfo(float).tiny)
    for _ in range(4 * product.size + 4):
        while True:
            trial = np.zeros_like(x)
            trial[passive] = np.linalg.lstsq(gram[np.ix_(passive, passive)], product[passive], rcond=1e-13)[0]
            negative = passive & ~signed & (trial <= 0)
            if not negative.any():
                break
            # Towards the trial as far as all stay positive; what comes to 0 first leaves.
            shares = np.full(x.shape, np.inf)
            shares[negative] = x[negative] / np.maximum(x - trial, np.finfo(float).tiny)[negative]
            x = x + np.min(shares) * (trial - x)
            passive &= shares > np.min(shares)
            x = np.where(passive, x, 0.0)
        x = trial
        gain = np.where(passive | ~usable, 0.0, product - gram @ x)
        if not np.max(gain, initial=0.0) > tolerance:
            break
        passive[np.argmax(gain)] = True
    return x / scale


def scaled_inverse(gram: Float[np.ndarray, "U U"], share: float = 1e-12) -> Float[np.ndarray, "U U"]:
    """The inverse of a positive semidefinite matrix whose unknowns are of any size; 0 along what it does not determine.

    Args:
        gram: the matrix; rows and columns of 0 for what is left out.
        share: of the largest eigenvalue, unknowns in units of their own columns; a smaller one determines nothing.
    """
    scale = np.sqrt(np.where(np.diag(gram) > 0, np.diag(gram), 1.0))
    unit = np.outer(scale, scale)
    return np.linalg.pinv(gram / unit, rcond=share, hermitian=True) / unit


def inverse_diagonal(gram: Float[np.ndarray, "U U"], share: float = 1e-10) -> Float[np.ndarray, " U"]:
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
