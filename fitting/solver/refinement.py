"""From near one minimum of the profile to the minimum itself, on all pixels: a pass at each exponent."""

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from fitting.solver.nnls import nonnegative_minima, nonnegative_minimum
from fitting.solver.normal_equations import Picture, Sums, sums
from fitting.solver.tied import design_of, join_channels

# As a function of log n a lobe varies on a scale of 1 or more: the steps of the coarse grid.
GRID_STEP = 0.35

_MOST_CORRECTIONS = 8

# What rounding may leave of a column that depends on the others: a few units in the last place of the pixels.
TOLERANCE_SINGLE = 2e-7
TOLERANCE_DOUBLE = 1e-14
# What it leaves of a cost, over that: the squares of some hundred thousand pixels were off by 4e-7.
COST_ROUNDING = 10.0

Cap = Callable[[float], Float[np.ndarray, "3 C"]]
"""From the exponent to what x_a, x_d, x_s count in a sum that may not exceed 1, channel by channel."""


class Problem(NamedTuple):
    """What stays the same during one search.

    Attributes:
        pictures: The pictures or tiles; gone through once per pass.
        free: Which coefficients may be above 0, (C, 3).
        tolerance: What rounding may leave of a column that depends on the others, relative.
        accuracy: How far from the optimum log n may end.
        n_range: Smallest and largest exponent.
        peak: Logarithm of the largest cosine of any pixel. Coefficients x_s are relative to ``exp(n peak)``.
        cap: A bound on sums of coefficients, or none.
        tied: x_s is a common factor times this, (C,); None where the channels are independent.
    """

    pictures: Sequence[Picture]
    free: np.ndarray
    tolerance: float
    accuracy: float
    n_range: tuple[float, float]
    peak: float = 0.0
    cap: Cap | None = None
    tied: np.ndarray | None = None

    @property
    def bounds(self) -> tuple[float, float]:
        """Of log n."""
        return math.log(self.n_range[0]), math.log(self.n_range[1])


class Point(NamedTuple):
    """An exponent and the best coefficients there; or several, with a leading axis.

    Attributes:
        log_n: Logarithm of the exponent.
        x: Coefficients x_a, x_d, x_s, at least 0, (C, 3).
        cost: Sum of weighted squared residuals, (C,).
        slope: Derivative of the cost by log n, summed over channels.
    """

    log_n: Any
    x: np.ndarray
    cost: np.ndarray
    slope: Any = 0.0


def problem_of(
    pictures: Sequence[Picture], n_range: tuple[float, float], free: Bool[np.ndarray, "3 C"] | None
) -> Problem:
    """The problem of some pictures, all of one dtype, whose coefficients may be above 0 where free."""
    target = pictures[0].target
    free = np.ones((3, target.shape[1]), bool) if free is None else np.asarray(free)
    tolerance, accuracy = (TOLERANCE_SINGLE, 2e-6) if target.dtype == np.float32 else (TOLERANCE_DOUBLE, 1e-10)
    return Problem(pictures, free.T, tolerance, accuracy, n_range)


def solve_linear(parts: Sums, log_n: Float[np.ndarray, " N"], reference: np.ndarray, problem: Problem) -> Point:
    """The best coefficients at each of some exponents, of sums with a leading axis N.

    By the envelope theorem the coefficients may be held for the slope: -2 x_s <S', r>, r the best residual; and where
    the cap is reached, its multiplier times the change of the cap.
    """

    def caps(shift: float) -> np.ndarray:
        """What the coefficients, relative to the peak, count towards the cap; no more than has a finite square."""
        assert problem.cap is not None
        exponents = np.exp(log_n + shift)
        return np.stack([problem.cap(n).T * [1, 1, np.exp(min(-n * problem.peak, 300))] for n in exponents])

    gram, product = parts.gram[..., :3, :3], parts.product[..., :3]
    if problem.tied is None:
        cap = None if problem.cap is None else caps(0.0)
        x = nonnegative_minima(gram, product, reference, problem.free, problem.tolerance, cap)
    else:
        design = design_of(problem.free.T, problem.tied)[:, :-1]
        found = []
        for one in zip(*parts.about(reference)[:3], strict=True):
            whole, right, _ = join_channels(*one, reference[:, 2])
            found.append(design @ nonnegative_minimum(design.T @ whole @ design, design.T @ right))
        x = np.stack(found)[:, :-1].reshape(len(found), 3, -1).swapaxes(1, 2)
    step = x - reference
    pull = parts.product - (parts.gram[..., :3] @ step[..., None])[..., 0]
    change = -np.sum(step * (product + pull[..., :3]), axis=-1)
    slope = -2 * np.sum(x[..., 2] * pull[..., 3], axis=-1)
    if problem.cap is not None:
        # The coefficients above 0 are pulled by multiples of the cap, which add up to 1 where it is reached.
        multiplier = 2 * np.sum(pull[..., :3] * x, axis=-1)
        by_log_n = (caps(1e-4) - caps(-1e-4))[..., 2] / 2e-4
        slope = slope + np.sum(multiplier * x[..., 2] * by_log_n, axis=-1)
    return Point(log_n, x, np.maximum(parts.square + change, 0.0), slope)


def capped_minimum(problem: Problem, point: Point, reach: float) -> tuple[Point, Sums]:
    """The minimum under a cap near an exponent: where the slope is 0, or log n as far as it reaches."""
    from scipy.optimize import brentq  # late: few fits have a cap

    x, found = point.x, dict[float, tuple[Point, Sums]]()
    least, most = problem.bounds
    lower, upper = max(least, point.log_n - reach), min(most, point.log_n + reach)

    def slope(log_n: float) -> float:
        nonlocal x
        if log_n not in found:
            parts = sums(problem.pictures, np.array([log_n]), x, problem.peak)
            solved = solve_linear(parts, np.array([log_n]), x, problem)
            found[log_n] = Point(*(leaf[0] for leaf in solved)), Sums(*(leaf[0] for leaf in parts)).about(x)
            x = found[log_n][0].x
        return float(found[log_n][0].slope)

    ends = slope(lower), slope(upper)
    if ends[0] < 0 < ends[1]:
        root: Any = brentq(slope, lower, upper, xtol=problem.accuracy)
        return found[root]
    return min(found.values(), key=lambda found: float(np.sum(found[0].cost)))


def _correct(parts: Sums, point: Point, problem: Problem, bounds: tuple[float, float]) -> tuple[Point, float]:
    """One joint Gauss-Newton step from a point, whose active set is kept; and about how far off in log n it still is.

    The reference of the sums is the point's own coefficients.
    """
    x_s = point.x[:, 2]
    gram, product, _ = join_channels(*parts[:3], x_s)
    # Of the unknowns those above 0 are columns.
    design = design_of((point.x > 0).T, problem.tied)[:-1]
    design = design[:, np.any(design != 0, axis=0)]
    cross, score = design.T @ gram[:-1, -1], design.T @ product[:-1]
    try:
        gain, along = np.linalg.solve(design.T @ gram[:-1, :-1] @ design, np.stack([score, cross], axis=-1)).T
    except np.linalg.LinAlgError:
        return point, 0.0
    curvature = gram[-1, -1]
    left = curvature - along @ cross
    move = (product[-1] - along @ score) / left if left > problem.tolerance * curvature else 0.0
    # Farther than a step of the grid the derivative says nothing of the lobe.
    log_n = float(np.clip(point.log_n + np.clip(move, -GRID_STEP, GRID_STEP), *bounds))
    move = log_n - point.log_n
    x = np.maximum(point.x + (design @ (gain - move * along)).reshape(3, -1).T, 0.0)
    step = np.column_stack([x - point.x, move * x_s])
    change = np.sum(step * ((parts.gram @ step[..., None])[..., 0] - 2 * parts.product), axis=1)
    if not np.sum(change) <= 0:
        return point, 0.0
    # A Gauss-Newton step shrinks the error by about the error itself plus the relative uncertainty of n (half of it was
    # seen at 1 and 3 % noise).
    uncertainty = (np.sum(parts.square) / (left * np.sum(parts.pixels))) ** 0.5 if move else 0.0
    return Point(log_n, x, np.maximum(parts.square + change, 0.0)), abs(move) * (abs(move) + 2 * uncertainty)


def gauss_newton(problem: Problem, point: Point, reach: float = math.inf) -> tuple[Point, Sums]:
    """Residual passes with joint corrections until n stands still: the minimum, and the sums about the target.

    At each exponent the best coefficients are found anew, so that a coefficient may leave 0 or come to it. Where noise
    leaves n loosely determined a Gauss-Newton step may pass the minimum: a point that costs more than the last is
    brought back, to the minimum of the parabola through both. Nothing is returned on the word of the quadratic model
    unless its step was negligible. The cost of the start is not looked at; log n goes no farther from there than
    ``reach``.
    """
    held, about, slope, last = point, None, 0.0, math.inf
    least, most = problem.bounds
    bounds = max(least, point.log_n - reach), min(most, point.log_n + reach)
    for _ in range(_MOST_CORRECTIONS):
        reference = point.x
        several = sums(problem.pictures, np.array([point.log_n]), reference, problem.peak)
        solved = solve_linear(several, np.array([point.log_n]), reference, problem)
        parts, here = Sums(*(leaf[0] for leaf in several)), Point(*(leaf[0] for leaf in solved))
        cost = np.sum(here.cost)
        if cost - last > COST_ROUNDING * problem.tolerance * last:
            share = np.clip(-slope / (2 * (cost - last - slope)), 0.1, 0.5)
            slope *= share
            point = Point(*(old + share * (new - old) for old, new in zip(held, here, strict=True)))
            continue
        held, about, last = here, parts.about(reference), cost
        # A difference of far larger sums is known to fewer digits than about the coefficients themselves.
        lost = np.sum(parts.square) > 2 * cost + problem.tolerance * np.sum(about.square)
        # The sums with the residual against the best coefficients at this exponent.
        parts = parts.about(reference - here.x)._replace(square=here.cost)
        point, left = _correct(parts, here, problem, bounds) if problem.cap is None else (here, 0.0)
        slope = -2 * (point.log_n - here.log_n) * np.sum(here.x[:, 2] * parts.product[:, 3])
        if lost:
            last = math.inf
        elif left <= problem.accuracy:
            return point, about
    assert about is not None
    return held, about
