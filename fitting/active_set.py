"""Non-negative least squares of any number of unknowns, from the sums of its columns."""

import numpy as np
from jaxtyping import Float

DEPENDENT = 1e-10
"""A combination of columns that keeps less than this of their squares is none."""


def non_negative(gram: Float[np.ndarray, "N N"], product: Float[np.ndarray, " N"]) -> Float[np.ndarray, " N"]:
    """The x >= 0 with the least x·gram·x / 2 - x·product.

    Args:
        gram: positive semidefinite.
        product: of the columns with the target.

    Source: C. L. Lawson and R. J. Hanson, Solving least squares problems, 1974, chapter 23.
    """
    x = np.zeros(len(product))
    active = np.zeros(len(product), bool)
    smallest = 1e-12 * np.max(np.abs(product), initial=0.0)
    for _ in range(3 * len(product) + 10):
        gain = np.where(active, -np.inf, product - gram @ x)
        if np.max(gain) <= smallest:
            break
        active[np.argmax(gain)] = True
        trial = x
        while active.any():
            trial = np.zeros_like(x)
            inside = np.ix_(active, active)
            trial[active] = np.linalg.lstsq(gram[inside], product[active], rcond=DEPENDENT)[0]
            falling = active & (trial <= 0)
            if not falling.any():
                break
            step = np.min(x[falling] / (x[falling] - trial[falling] + np.finfo(float).tiny))
            x = x + step * (trial - x)
            active &= x > 0
            x = np.where(active, x, 0.0)
        x = trial if active.any() else x
    return x
