"""95 % intervals: of a coefficient that cannot be negative, and of the exponent from its profile likelihood."""

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from fitting.light_colour import coefficient_factors
from fitting.model_fit import ModelFit
from fitting.result import Parameter
from fitting.solver.normal_equations import sums
from fitting.solver.refinement import problem_of, solve_linear

NORMAL_95 = 1.959963984540054
ONE_SIDED_95 = 1.6448536269514722
# Farther below zero than this an estimate says that the model is wrong, not that the coefficient is surely tiny.
LOWEST = -2.0
# Below this relative error of n the profile is a parabola in log n to within a hundredth of the interval.
PARABOLIC = 0.01
# An exponent of a larger error in its logarithm may be any.
UNKNOWN = 700.0
# The widest step outwards in log n, and the share of a step to which an end is found.
WIDEST, CLOSE = 0.35, 1e-3
# So many exponents of other valleys are tried.
OTHERS = 8


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


def student_95(degrees: Any) -> Any:
    """By how many standard errors a 95 % interval reaches where these are known from some degrees of freedom, above 0.

    Source: M. Abramowitz and I. A. Stegun, Handbook of Mathematical Functions, 26.7.5; a tenth short for one degree, a
    hundredth for two.
    """
    z = NORMAL_95
    terms = (
        (z**3 + z) / 4,
        (5 * z**5 + 16 * z**3 + 3 * z) / 96,
        (3 * z**7 + 19 * z**5 + 17 * z**3 - 15 * z) / 384,
        (79 * z**9 + 776 * z**7 + 1482 * z**5 - 1920 * z**3 - 945 * z) / 92160,
    )
    return z + sum(term / degrees ** (power + 1) for power, term in enumerate(terms))


def above_zero(value: float, error: float) -> tuple[float, float]:
    """The 95 % interval of a coefficient that cannot be negative, from an estimate without that bound.

    It covers the truth in 95 % of draws wherever the truth lies, at 0 too, where it is one-sided; far from 0 it is
    value ± 1.96 errors. Source: G. J. Feldman and R. D. Cousins, "Unified approach to the classical statistical
    analysis of small signals", Phys. Rev. D 57 (1998) 3873-3889.
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


def exponent_interval(
    fit: ModelFit, n_error: float, reach: float, delta_cost: float, peak: float, *, parabolic: bool = False
) -> tuple[tuple[float, float], Float[np.ndarray, "N 3 C"]]:
    """The 95 % profile-likelihood interval of n: where the least cost rises by ``delta_cost``; else 0 or infinity.

    And the coefficients that explain most at exponents inside, at the scale of the lobe at the optimum.

    A relative error below a hundredth needs no pixel, nor does a profile that is taken for parabolic: there it is a
    parabola in log n. Else the cost is followed outwards from the optimum, a pass over the pixels at each exponent
    tried. ``reach`` and ``delta_cost`` are those of `fitting.uncertainty.covariance.Uncertainty`, ``peak`` the
    logarithm of the lobe's cosine in the pixel nearest to its centre.
    """
    optimum = fit.optimum
    if not math.isfinite(delta_cost):  # what is left tells no noise
        return (0.0, math.inf), optimum.x[None]
    relative = n_error / optimum.n
    bounds = math.log(fit.n_range[0]), math.log(fit.n_range[1])
    centre = math.log(optimum.n)
    inside = bounds[0] < centre - 3 * relative and centre + 3 * relative < bounds[1]
    if parabolic or (relative < PARABOLIC and inside):
        factor = math.exp(min(reach * relative, UNKNOWN))
        return (optimum.n / factor, optimum.n * factor), optimum.x[None]
    profile = _Profile(fit, peak)
    first = min(max(1.1 * reach * relative, 1e-3), WIDEST)
    low, high = (
        _end(profile.rise, centre, sign, bound, first, delta_cost) for sign, bound in zip((-1, 1), bounds, strict=True)
    )
    # Other valleys, where the search has seen no more, however high what lies between.
    share = 1 + delta_cost / max(profile.least, np.finfo(float).tiny)
    likely = np.log(optimum.grid[optimum.profile <= share * np.min(optimum.profile, initial=np.inf)])
    others = likely[(likely < low) | (likely > high)]
    some = np.unique(np.linspace(0, max(others.size - 1, 0), OTHERS).round().astype(int))[: others.size]
    others = [one for one in others[some].tolist() if profile.rise(one) <= delta_cost]
    if others and others[0] < low:
        low = _end(profile.rise, others[0], -1, bounds[0], WIDEST, delta_cost)
    if others and others[-1] > high:
        high = _end(profile.rise, others[-1], 1, bounds[1], WIDEST, delta_cost)
    return (math.exp(low), math.exp(high)), profile.coefficients(delta_cost)


class _Profile:
    """By how much the least cost rises from the optimum to other exponents, and the coefficients that have it there."""

    def __init__(self, fit: ModelFit, peak: float):
        """Start at the optimum of a fit."""
        self.fit, self.peak = fit, peak
        self.problem = problem_of(fit.pictures, fit.n_range, fit.free)._replace(peak=peak, tied=fit.tied)
        # Relative to the nearest pixel the lobe keeps its size where no pixel sees the centre.
        self.reference = fit.optimum.x.T * [1.0, 1.0, math.exp(fit.optimum.n * peak)]
        # By the same sums: those of an optimum may be scaled to the noise.
        self.tried, self.least = [], 0.0
        self.least = self.rise(math.log(fit.optimum.n))
        self.tried = [(0.0, fit.optimum.x)]

    def rise(self, log_n: float) -> float:
        """From the optimum to an exponent."""
        with jax.enable_x64(True):
            parts = sums(self.problem.pictures, np.array([log_n]), self.reference, self.peak)
            point = solve_linear(parts, np.array([log_n]), self.reference, self.problem)
        n, rise = math.exp(log_n), float(np.sum(point.cost)) - self.least
        scales = [coefficient_factors(self.fit.model, one, np.ones(1)) for one in (self.fit.optimum.n, n)]
        lobe = [[1.0], [1.0], [math.exp(min(-n * self.peak, UNKNOWN))]]
        self.tried.append((rise, point.x[0].T * lobe * scales[0] / scales[1]))
        return rise

    def coefficients(self, limit: float) -> Float[np.ndarray, "N 3 C"]:
        """Where it has risen by no more than a limit, at the scale of the lobe at the optimum."""
        return np.stack([x for rise, x in self.tried if rise <= limit])


def _end(rise_at: Callable[[float], float], start: float, sign: int, bound: float, step: float, limit: float) -> float:
    """Where the profile first rises by a limit on one side of the optimum, in log n; infinite where it does not."""
    inside, below = start, 0.0
    while (bound - inside) * sign > 1e-9:
        outside = min(inside + sign * step, bound, key=lambda end: abs(end - start))
        above = rise_at(outside)
        if above <= limit:
            inside, below, step = outside, max(above, 0.0), WIDEST
            continue
        # The root of the rise is nearly straight.
        while True:
            share = (math.sqrt(limit) - math.sqrt(below)) / (math.sqrt(above) - math.sqrt(below))
            middle = inside + share * (outside - inside)
            if abs(outside - inside) < CLOSE or min(share, 1 - share) * abs(outside - inside) < CLOSE * step:
                return middle
            delta_cost = rise_at(middle)
            if delta_cost > limit:
                outside, above = middle, delta_cost
            else:
                inside, below = middle, max(delta_cost, 0.0)
    return sign * math.inf


def widened(one: Parameter, by: float) -> Parameter:
    """A number to whose error something adds that has this standard error; the ends of its interval move out."""
    if one.value is None or one.error is None or by == 0:
        return one
    error, value, interval = math.hypot(one.error, by), one.value, one.interval
    if interval is not None and not one.error:
        interval = above_zero(value, error)
    elif interval is not None and one.name == "n":  # it need not be even about it: each end by the same factor
        low, high = (value * (end / value) ** (error / one.error) for end in interval)
        interval = low, high
    elif interval is not None:
        low, high = (value + (end - value) * error / one.error for end in interval)
        interval = max(low, 0.0) if interval[0] >= 0 else low, high
    return dataclasses.replace(one, error=error, interval=interval)
