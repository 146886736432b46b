"""From a bracket around one minimum of the profile to the minimum itself, on all pixels."""

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from fitting.solver.nnls import nonnegative_minima, nonnegative_minimum
from fitting.solver.normal_equations import Picture, Sums, sums
from fitting.solver.tied import design_of, join_channels

# As a function of log n a lobe varies on a scale of 1 or more; steps of the coarse grid, and the widest bracket.
GRID_STEP = 0.35

# Over a bracket this wide Hermite's cubic is within 4e-6 of the lobe; the corrections of the last passes do the rest.
# Under a cap there are none: a quarter of the width is 256 times closer.
_WIDEST_BRACKET = 0.2
_WIDEST_CAPPED = 0.05

_MOST_BRACKETS = 10
_MOST_CORRECTIONS = 8

# What rounding may leave of a column that depends on the others: a few units in the last place of the pixels.
TOLERANCE_SINGLE = 2e-7
TOLERANCE_DOUBLE = 1e-14

# Of an interval searched: the three samples that the last parabola goes through are so far apart.
_CLOSE, _NEAR = 1e-3, 5e-2

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
        lobe: Whether there is a highlight to search for.
        peak: Logarithm of the largest cosine of any pixel. Coefficients x_s are relative to ``exp(n peak)``.
        cap: A bound on sums of coefficients, or none.
        tied: x_s is a common factor times this, (C,); None where the channels are independent.
    """

    pictures: Sequence[Picture]
    free: np.ndarray
    tolerance: float
    accuracy: float
    n_range: tuple[float, float]
    lobe: bool
    peak: float = 0.0
    cap: Cap | None = None
    tied: np.ndarray | None = None

    @property
    def bounds(self) -> tuple[float, float]:
        """Of log n."""
        return math.log(self.n_range[0]), math.log(self.n_range[1])

    def sums(self, log_n: Any, reference: np.ndarray) -> Sums:
        """One pass over all pixels."""
        return sums(self.pictures, np.array(log_n if self.lobe else []), reference, peak=self.peak)


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
    """The problem of some pictures, all of one dtype.

    Args:
        pictures: of one material.
        n_range: smallest and largest exponent.
        free: which coefficients may be above 0; None for all.
    """
    target = pictures[0].target
    free = np.ones((3, target.shape[1]), bool) if free is None else np.asarray(free)
    tolerance, accuracy = (TOLERANCE_SINGLE, 1e-5) if target.dtype == np.float32 else (TOLERANCE_DOUBLE, 5e-9)
    return Problem(pictures, free.T, tolerance, accuracy, n_range, bool(free[2].any()))


def minimum_between(
    costs: Callable[[np.ndarray], np.ndarray], low: float, high: float, points: int = 17, close: float = _CLOSE
) -> float:
    """Where a function of one number is least: samples, again around the best of them, at last a parabola.

    Args:
        costs: the function, of several numbers at once.
        low: lower bound.
        high: upper bound.
        points: how many are tried at once.
        close: samples go on until they are this share of the range apart.
    """
    width = high - low
    while True:
        at = np.linspace(low, high, points)
        cost = costs(at)
        middle = int(np.clip(np.argmin(cost), 1, points - 2))
        low, here, high = at[middle - 1 : middle + 2]
        if high - here <= close * width:
            break
    before, after = np.diff(cost[middle - 1 : middle + 2])
    bend = after - before
    vertex = here - (high - here) * (before + after) / (2 * bend) if bend > 0 else at[np.argmin(cost)]
    return float(np.clip(vertex, low, high))


def solve_linear(parts: Sums, log_n: Float[np.ndarray, " N"], reference: np.ndarray, problem: Problem) -> Point:
    """The best coefficients at each of some exponents.

    By the envelope theorem the coefficients may be held for the slope: -2 x_s <S', r>, r the best residual; and where
    the cap is reached, its multiplier times the change of the cap.

    Args:
        parts: Sums, columns ambient, diffuse, lobe and derivative by log n; with a leading axis N.
        log_n: The exponents.
        reference: The reference model of the sums, (C, 3).
        problem: Bounds.
    """

    def caps(shift: float) -> np.ndarray:
        """What the coefficients, relative to the peak, count towards the cap."""
        assert problem.cap is not None
        return np.stack([problem.cap(n).T * [1, 1, np.exp(-n * problem.peak)] for n in np.exp(log_n + shift)])

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


def _solve_bracket(problem: Problem, lower: float, upper: float, x: np.ndarray) -> tuple[Point, float]:
    """The least cost within a bracket, and where it lies, as a share of the bracket."""
    parts, width = problem.sums([lower, upper], x), upper - lower

    def at(shares: np.ndarray) -> Point:
        return solve_linear(parts.within(shares, width, x), lower + shares * width, x, problem)

    # Without a cap the cost is smooth, and Gauss-Newton steps follow.
    close = _NEAR if problem.cap is None else _CLOSE
    share = minimum_between(lambda shares: np.sum(at(shares).cost, axis=1), 0.0, 1.0, close=close)
    return Point(*(leaf[0] for leaf in at(np.array([share])))), share


def enclose(problem: Problem, lower: float, upper: float, x: np.ndarray) -> tuple[Point, bool]:
    """Follow one minimum until it lies inside a bracket narrow enough for the cubic, and say whether it does.

    Args:
        problem: What is searched.
        lower: Of the first bracket in log n.
        upper: Likewise.
        x: Coefficients of a model near by, (C, 3).
    """
    least, most = problem.bounds
    widest = _WIDEST_BRACKET if problem.cap is None else _WIDEST_CAPPED
    attempt = 0
    while True:
        attempt += 1
        point, share = _solve_bracket(problem, lower, upper, x)
        half, x = (upper - lower) / 2, point.x
        if (share <= 0 and lower > least) or (share >= 1 and upper < most):
            half = min(2 * half, GRID_STEP)
        elif 2 * half > widest:
            # What the cubic leaves of the error of a grid cell is far below this.
            half = widest / 8
        else:
            return point, True
        if attempt == _MOST_BRACKETS:
            return point, False
        lower, upper = max(least, point.log_n - half), min(most, point.log_n + half)


def _correct(parts: Sums, point: Point, problem: Problem) -> tuple[Point, float]:
    """One joint Gauss-Newton step from a point; its active set is kept.

    Args:
        parts: Sums at the point, the reference being its own coefficients.
        point: The point.
        problem: Bounds.

    Returns:
        The new point, and about how far from the optimum in log n it still is.
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
    log_n = float(np.clip(point.log_n + move, *problem.bounds))
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


def gauss_newton(problem: Problem, point: Point) -> tuple[Point, Sums]:
    """Residual passes with joint corrections until n stands still: exact cost, sums about the target.

    At each exponent the best coefficients are found anew, so that a coefficient may leave 0 or come to it. Where noise
    leaves n loosely determined a Gauss-Newton step may pass the minimum: a point that costs more than the last is
    brought back, to the minimum of the parabola through both. Nothing is returned on the word of the quadratic model
    unless its step was negligible. Under a cap the exponent is that of the bracket.
    """
    held, about, slope, last = point, None, 0.0, math.inf
    for _ in range(_MOST_CORRECTIONS):
        reference = point.x
        parts = problem.sums([point.log_n], reference)
        solved = solve_linear(Sums(*(leaf[None] for leaf in parts)), np.array([point.log_n]), reference, problem)
        here = Point(*(leaf[0] for leaf in solved))
        cost = np.sum(here.cost)
        if cost - last > problem.tolerance * last:
            share = np.clip(-slope / (2 * (cost - last - slope)), 0.1, 0.5)
            slope *= share
            point = Point(*(old + share * (new - old) for old, new in zip(held, here, strict=True)))
            continue
        held, about, last = here, parts.about(reference), cost
        # A difference of far larger sums is known to fewer digits than about the coefficients themselves.
        lost = np.sum(parts.square) > 2 * cost + problem.tolerance * np.sum(about.square)
        # The sums with the residual against the best coefficients at this exponent.
        parts = parts.about(reference - here.x)._replace(square=here.cost)
        point, left = _correct(parts, here, problem) if problem.cap is None else (here, 0.0)
        slope = -2 * (point.log_n - here.log_n) * np.sum(here.x[:, 2] * parts.product[:, 3])
        if lost:
            last = math.inf
        elif left <= problem.accuracy:
            return point, about
    assert about is not None
    return held, about
