"""Exact non-negative least squares for the three coefficients of one channel, from its sums.

Three unknowns have eight active sets: all are solved at once and the best feasible one is taken. That is exact, has no
iterations, no tolerance on the answer, and runs over any number of channels and exponents in parallel. Written out by
entries instead of in small matrices, it compiles to a single loop.
"""

import itertools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from fitting.solver.normal_equations import AnyArray

# Which of ambient, diffuse, specular are above zero. A linear bound, x_d u + x_s v <= 1, would add the sets that lie on
# it.
ACTIVE_SETS = np.array(list(itertools.product([False, True], repeat=3)))


class Linear(NamedTuple):
    """The best coefficients at a fixed exponent.

    Attributes:
        x: Coefficients x_a, x_d, x_s, at least 0.
        cost: Sum of weighted squared residuals.
        slope: Derivative of the cost by log n, summed over channels.
    """

    x: Float[Array, "*K C 3"]
    cost: Float[Array, "*K C"]
    slope: Float[Array, "*K"]


def _divide(numerator: Float[Array, "*K"], pivot: Float[Array, "*K"]) -> Float[Array, "*K"]:
    """The quotient, 0 where the pivot is not above 0: such a column has no trace."""
    return jnp.where(pivot > 0, numerator / jnp.where(pivot > 0, pivot, 1.0), 0.0)


def solve(
    gram: Float[AnyArray, "*K C 4 4"],
    product: Float[AnyArray, "*K C 4"],
    square: Float[AnyArray, "*K C"],
    reference: Float[AnyArray, "C 3"],
    free: Bool[AnyArray, "C 3"],
    tolerance: Float[AnyArray, ""],
) -> Linear:
    """The non-negative coefficients that minimise the weighted squared residual, and the slope of that minimum.

    By the envelope theorem the coefficients may be held for the slope: -2 x_s <S', r>, r the best residual.

    Args:
        gram: Products of ambient, diffuse, lobe S and its derivative S' by log n.
        product: Products of these with the residual against the reference model.
        square: Squares of that residual.
        reference: Coefficients of the reference model.
        free: Which coefficients may be above 0.
        tolerance: Share of a diagonal entry below which what elimination leaves of it counts as rounding: the column
            then depends on the others, and a smaller active set does as well.

    Returns:
        Coefficients, cost and slope.
    """
    start = [reference[..., i] for i in range(3)]
    sets = ACTIVE_SETS.reshape(8, *(1,) * square.ndim, 3)
    active = [sets[..., i] for i in range(3)]

    def entry(i: int, j: int) -> Float[Array, "8 *K C"]:
        return jnp.where(active[i] & active[j], gram[..., i, j], 0.0)

    # The step from the reference is what is solved for, so no digits are lost where the two models nearly agree: near
    # the optimum. An inactive coefficient steps to 0.
    leave = [jnp.where(active[i], 0.0, start[i]) for i in range(3)]
    b = [
        jnp.where(active[i], product[..., i] + sum(gram[..., i, j] * leave[j] for j in range(3)), 0.0) for i in range(3)
    ]
    # L D L' of the active columns.
    d_0 = entry(0, 0)
    l_10, l_20 = _divide(entry(0, 1), d_0), _divide(entry(0, 2), d_0)
    d_1 = entry(1, 1) - l_10 * entry(0, 1)
    rest = entry(1, 2) - l_20 * entry(0, 1)
    l_21 = _divide(rest, d_1)
    d_2 = entry(2, 2) - l_20 * entry(0, 2) - l_21 * rest
    y_1 = b[1] - l_10 * b[0]
    y_2 = b[2] - l_20 * b[0] - l_21 * y_1
    gain_2 = _divide(y_2, d_2)
    gain_1 = _divide(y_1, d_1) - l_21 * gain_2
    gain_0 = _divide(b[0], d_0) - l_10 * gain_1 - l_20 * gain_2
    step = [gain - left for gain, left in zip([gain_0, gain_1, gain_2], leave, strict=True)]
    x = [jnp.where(active[i], start[i] + step[i], 0.0) for i in range(3)]

    feasible = jnp.ones_like(gain_0, bool)
    for i, pivot in enumerate([d_0, d_1, d_2]):
        allowed = free[..., i] & (x[i] >= 0) & (pivot > tolerance * gram[..., i, i])
        feasible = feasible & (~active[i] | allowed)
    change = sum(step[i] * (sum(gram[..., i, j] * step[j] for j in range(3)) - 2 * product[..., i]) for i in range(3))
    zero = np.zeros((), square.dtype)
    change, *x = jax.lax.reduce(
        (jnp.where(feasible, change, jnp.inf), *x),
        (np.array(np.inf, square.dtype), zero, zero, zero),
        lambda a, b: tuple(jnp.where(a[0] <= b[0], u, v) for u, v in zip(a, b, strict=True)),
        (0,),
    )
    score = product[..., 3] - sum(gram[..., 3, i] * (x[i] - start[i]) for i in range(3))
    return Linear(
        x=jnp.stack(x, axis=-1),
        cost=jnp.maximum(square + change, 0.0),
        slope=-2 * jnp.sum(x[2] * score, axis=-1),
    )
