"""Least squares under bounds, from the sums of its columns: the coefficients are at least 0, and may have a cap.

| problem | function | how |
| --- | --- | --- |
| many of a few unknowns: a channel at an exponent | `nonnegative_minima` | one unknown after the other, by recursion |
| one of any size: what channels share, lights | `nonnegative_minimum` | Lawson and Hanson choose the sets |
"""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from brdf.vectors import quotient
from fitting.likelihood import AnyArray

# Points where diffuse and lobe have a cap to themselves, in units of that: one, and how ambient and lobe move it; then
# those where the lobe has all of it.
_SHARED = np.array([0.0, 1.0, 0.0]), np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 1.0]])
_OF_LOBE = np.array([0.0, 0.0, 1.0]), np.array([[1.0, 0.0, 0.0]])


def above(gram: Any, product: Any, low: Any, free: Any, least: Any) -> Any:
    """Minimise x G x - 2 b x over x at least ``low``, exactly, by NumPy or JAX; (..., U).

    The others are solved for with the first unknown eliminated. The problem is convex: where that puts the first below
    its bound, the minimum lies on the bound, and the others are solved for there. An unknown that is not free stays
    there, and so does one of whose diagonal entry elimination does not leave more than ``least``.
    """
    xp: Any = np if isinstance(gram, np.ndarray) else jnp
    moves = free[..., :1] & (gram[..., :1, 0] > least[..., :1])
    pivot, across = xp.where(moves, gram[..., :1, 0], 1), gram[..., 0, 1:]
    slope, first = across / pivot, product[..., :1] / pivot
    if product.shape[-1] == 1:
        return xp.where(moves & (first > low), first, low)
    others = low[..., 1:], free[..., 1:], least[..., 1:]
    left = gram[..., 1:, 1:] - slope[..., :, None] * across[..., None, :]
    rest = above(left, product[..., 1:] - first * across, *others)
    first = first - xp.sum(slope * rest, axis=-1, keepdims=True)
    moves, inside = moves & (first > low[..., :1]), xp.concatenate([first, rest], axis=-1)
    if xp is np and moves.all():
        return inside
    rest = above(gram[..., 1:, 1:], product[..., 1:] - across * low[..., :1], *others)
    return xp.where(moves, inside, xp.concatenate([low[..., :1], rest], axis=-1))


@np.errstate(over="ignore", invalid="ignore", divide="ignore")
def nonnegative_minima(
    gram: Float[AnyArray, "*#K U U"],
    product: Float[AnyArray, "*K U"],
    start: Float[AnyArray, "*#K U"],
    free: Bool[AnyArray, "*#K U"],
    tolerance: float,
    cap: Float[np.ndarray, "*#K 3"] | None = None,
) -> Any:
    """Minimise (x - s) G (x - s) - 2 b (x - s) over x at least 0, and w x at most 1 where there is a cap, exactly.

    That has no iterations and no tolerance on the answer. The step from the start s is what is solved for, so no digits
    are lost near the optimum. Of any number of problems; by NumPy, or without a cap by JAX where G is an array of that.
    What elimination leaves of a diagonal entry counts as rounding below that share of it, the tolerance: the column
    then depends on the others, and a smaller active set does as well. The cap is w of ambient, diffuse and lobe: 0, and
    two numbers above it.
    """
    xp: Any = np if isinstance(gram, np.ndarray) else jnp
    start, square = xp.broadcast_to(start, product.shape), xp.diagonal(gram, axis1=-2, axis2=-1)
    x = start + above(gram, product, -start, free, tolerance * square)
    if cap is None or not (over := np.sum(cap * x, axis=-1, keepdims=True) > 1).any():
        return x
    # Where the minimum is beyond the cap, that below it lies on it. In units in which each counts 1, or rounding would
    # lift a small one that counts much over the cap.
    unit = quotient(1.0, cap, 1.0)
    gram, product, start = gram * unit[..., :, None] * unit[..., None, :], product * unit, start / unit
    shared, of_lobe = (_on_face(gram, product, start, free, tolerance, *face) for face in (_SHARED, _OF_LOBE))
    return np.where(over, unit * np.where(free[..., 1:2] & (shared[..., 1:2] >= 0), shared, of_lobe), x)


def _on_face(gram: Any, product: Any, start: Any, free: Any, tolerance: float, point: Any, moves: Any) -> np.ndarray:
    """The minimum among the points that some unknowns at least 0 lead to."""
    some = moves.max(axis=0) > 0
    begin, square = start[..., some], np.diagonal(gram, axis1=-2, axis2=-1)
    pull = product - (gram @ (point + begin @ moves - start)[..., None])[..., 0]
    step = above(moves @ gram @ moves.T, pull @ moves.T, -begin, free[..., some], tolerance * square @ moves.T**2)
    return point + (begin + step) @ moves


def nonnegative_minimum(
    gram: Float[np.ndarray, "U U"], product: Float[np.ndarray, " U"], signed: Bool[np.ndarray, " U"] | None = None
) -> Float[np.ndarray, " U"]:
    """Minimise x G x - 2 b x over x at least 0, except where ``signed``: the active set method.

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

    That is eigenvalues below a share of the largest, unknowns in units of their own columns.
    """
    scale = np.sqrt(np.where(np.diag(gram) > 0, np.diag(gram), 1.0))
    unit = np.outer(scale, scale)
    return np.linalg.pinv(gram / unit, rcond=share, hermitian=True) / unit


def inverse_diagonal(gram: Float[np.ndarray, "U U"], share: float = 1e-10) -> Float[np.ndarray, " U"]:
    """The diagonal of `scaled_inverse`; infinite for an unknown that takes part in what that leaves out."""
    scale = np.sqrt(np.where(np.diag(gram) > 0, np.diag(gram), 1.0))
    value, vector = np.linalg.eigh(gram / np.outer(scale, scale))
    known = value > max(share * value[-1], 0.0)
    inverse = np.sum(vector[:, known] ** 2 / value[known], axis=1) / scale**2
    return np.where(np.all(np.abs(vector[:, ~known]) <= 1e-3, axis=1), inverse, np.inf)
