"""95 % intervals: of a coefficient that cannot be negative, and of the exponent from its profile likelihood."""

import functools
import math
from collections.abc import Callable

import jax
import numpy as np

from fitting.model_fit import ModelFit
from fitting.solver.refinement import problem_of, solve_linear

NORMAL_95 = 1.959963984540054
ONE_SIDED_95 = 1.6448536269514722
# Farther below zero than this an estimate says that the model is wrong, not that the coefficient is surely tiny.
LOWEST = -2.0
# Below this relative error of n the profile is a parabola in log n to within a hundredth of the interval.
PARABOLIC = 0.01
# Hermite's cubic of the lobe over log n holds this far.
WIDEST = 0.35
SHARES = np.linspace(0.0, 1.0, 17)


@functools.cache
def _acceptance() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Truths in units of the error, and between which estimates each is accepted, after Feldman and Cousins."""

    def below(x: np.ndarray) -> np.ndarray:
        return 0.5 * np.array([math.erfc(-size / math.sqrt(2.0)) for size in x])

    truths = np.linspace(0.0, NORMAL_95, 41)
    above = truths[1:]
    low, high = above + ONE_SIDED_95, above + NORMAL_95
    for _ in range(40):
        middle = 0.5 * (low + high)
        other = (above**2 - (middle - above) ** 2) / (2 * above)
        enough = below(middle - above) - below(other - above) > 0.95
        low, high = np.where(enough, low, middle), np.where(enough, middle, high)
    lower = (above**2 - (high - above) ** 2) / (2 * above)
    return truths, np.append(-np.inf, lower), np.append(ONE_SIDED_95, high)


def above_zero(value: float, error: float) -> tuple[float, float]:
    """The 95 % interval of a coefficient that cannot be negative.

    It covers the truth in 95 % of draws wherever the truth lies, at 0 too, where it is one-sided; far from 0 it is
    value ± 1.96 errors. Source: G. J. Feldman and R. D. Cousins, "Unified approach to the classical statistical
    analysis of small signals", Phys. Rev. D 57 (1998) 3873-3889.

    Args:
        value: estimate without the bound; may be negative.
        error: its standard error.

    Returns:
        Lower and upper end; 0 and infinity where the error is infinite.
    """
    if not math.isfinite(error):
        return 0.0, math.inf
    if error == 0 or value >= 2 * NORMAL_95 * error:
        return value - NORMAL_95 * error, value + NORMAL_95 * error
    truths, lower, upper = _acceptance()
    estimate = max(value / error, LOWEST)
    high = estimate + NORMAL_95 if estimate >= 0 else float(np.interp(estimate, lower[1:], truths[1:]))
    low = 0.0 if estimate <= ONE_SIDED_95 else float(np.interp(estimate, upper, truths))
    return low * error, high * error


def exponent_interval(fit: ModelFit, n_error: float, rise: float, peak: float) -> tuple[float, float]:
    """The 95 % profile-likelihood interval of n: where the least cost rises by ``rise``.

    A relative error below a hundredth needs no pixel: there the profile is a parabola in log n. Else the cost is
    followed outwards from the optimum, two brackets of pixels' sums in the ordinary case.

    Args:
        fit: of a model with a lobe.
        n_error: standard error of n.
        rise: of the cost; see `fitting.uncertainty.covariance.Uncertainty`.
        peak: logarithm of the lobe's cosine in the pixel nearest to its centre.

    Returns:
        Lower and upper end; 0 and infinity where the cost does not rise before the bound of the search.
    """
    optimum = fit.optimum
    relative = n_error / optimum.n
    bounds = math.log(fit.n_range[0]), math.log(fit.n_range[1])
    centre = math.log(optimum.n)
    inside = bounds[0] < centre - 3 * relative and centre + 3 * relative < bounds[1]
    if relative < PARABOLIC and inside:
        return optimum.n * math.exp(-NORMAL_95 * relative), optimum.n * math.exp(NORMAL_95 * relative)
    first = min(max(1.1 * NORMAL_95 * relative, 1e-3), WIDEST)
    limit = float(np.sum(optimum.cost)) + rise
    problem = problem_of(fit.pictures, fit.n_range, fit.free)._replace(peak=peak, tied=fit.tied)
    # Relative to the nearest pixel the lobe keeps its size where no pixel sees the centre.
    reference = optimum.x.T * [1.0, 1.0, math.exp(optimum.n * peak)]

    def costs(low: float, high: float) -> np.ndarray:
        with jax.enable_x64(True):
            parts = problem.sums([low, high], reference).within(SHARES, high - low, reference)
        at = low + SHARES * (high - low)
        return solve_linear(parts, at, reference, problem).cost.sum(axis=1)

    low, high = (_end(costs, centre, sign, bound, first, limit) for sign, bound in zip((-1, 1), bounds, strict=True))
    return math.exp(low), math.exp(high)


def _end(
    costs: Callable[[float, float], np.ndarray], start: float, sign: int, bound: float, width: float, limit: float
) -> float:
    """Where the profile crosses the limit on one side of the optimum, in log n; infinite where it does not."""
    while (bound - start) * sign > 1e-9:
        end = bound if (bound - start) * sign < width else start + sign * width
        cost = costs(min(start, end), max(start, end))[::sign]
        position = start + SHARES * (end - start)
        above = np.flatnonzero(cost > limit)
        if above.size == 0:
            start, width = end, WIDEST
            continue
        first = int(above[0])
        if first == 0:
            return float(position[0])
        # Interpolated in the square root of the rise, which is nearly straight.
        least = min(float(cost[0]), limit)
        root = np.sqrt(np.maximum(cost[first - 1 : first + 1] - least, 0.0))
        share = (math.sqrt(limit - least) - root[0]) / max(root[1] - root[0], np.finfo(float).tiny)
        return float(position[first - 1] + min(max(share, 0.0), 1.0) * (position[first] - position[first - 1]))
    return sign * math.inf
