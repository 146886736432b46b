"""Non-negative least squares of any number of unknowns, from the sums of its columns."""

import numpy as np
from jaxtyping import Bool, Float

DEPENDENT = 1e-10
"""A combination of columns that keeps less than this of their squares is none."""


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
    tolerance = 1e-13 * max(float(np.max(np.abs(product), initial=0.0)), np.finfo(float).tiny)
    for _ in range(4 * product.size + 4):
        while True:
            trial = np.zeros_like(x)
            index = np.flatnonzero(passive)
            if index.size:
                block = gram[np.ix_(index, index)]
                trial[index] = np.linalg.lstsq(block, product[index], rcond=1e-13)[0]
            negative = passive & ~signed & (trial <= 0)
            if not negative.any():
                break
            with np.errstate(divide="ignore", invalid="ignore"):
                shares = np.where(negative, x / (x - trial), np.inf)
            share = float(np.clip(np.nan_to_num(np.min(shares), nan=0.0), 0.0, 1.0))
            x = x + share * (trial - x)
            passive &= ~(negative & ((x <= 1e-15 * np.max(np.abs(x), initial=0.0)) | (shares <= share)))
            x = np.where(passive, x, 0.0)
        x = trial
        gain = np.where(passive | ~usable, -np.inf, product - gram @ x)
        best = int(np.argmax(gain))
        if not gain[best] > tolerance:
            break
        passive[best] = True
    return x / scale
