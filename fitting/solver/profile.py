"""The separable engine: the global optimum of ``sum w (target - x_a A - x_d D - x_s S(n))^2`` over n and x >= 0.

Variable projection (Golub and Pereyra 1973, SIAM J. Numer. Anal. 10, 413): for a given n the best x is a tiny exact
problem, so the search is one-dimensional, in log n. The host drives it and pixels are touched only by
:mod:`fitting.solver.normal_equations`, whose results add up: one picture in memory, a hundred photographs and the tiles
of a file on disk are the same loop.

1. A stratified subsample of the pixels (:mod:`fitting.solver.subsample`), or all of a small picture, gives the profile
   and its slope on a grid over log n. As a function of log n any lobe varies on a scale of 1 or more, so steps of 0.35
   miss no minimum.
2. The subsample also says how far its profile may be from that of all pixels. If one valley is left at six standard
   deviations, the search goes on there; else the grid is repeated on all pixels where the optimum may be.
3. Passes over all pixels in residual form (:mod:`fitting.solver.refinement`) give the exact cost at an exponent and a
   joint Gauss-Newton correction of x and n, repeated while it moves n.

A cap on sums of coefficients (k_d + k_s <= 1, what a plausible material keeps) is one more bound of the tiny problem:
the same search under it is as global.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from brdf.precision import cast
from fitting.solver.normal_equations import Picture, Sums, sums
from fitting.solver.refinement import (
    GRID_STEP,
    TOLERANCE_DOUBLE,
    TOLERANCE_SINGLE,
    Cap,
    Point,
    Problem,
    capped_minimum,
    gauss_newton,
    problem_of,
    solve_linear,
)
from fitting.solver.streams import Stream
from fitting.solver.subsample import Lobes, Subsample, subsample
from fitting.solver.tied import NormalEquations, join_channels

# Six standard deviations: one wrong rejection in 1e9, and the variance itself is an estimate.
DEVIATIONS = 6.0

# Rounding above this share of the rise from the best sample to its neighbour, and of the noise's variance, hides both.
UNRESOLVED = 0.1

# Hermite's cubic over a grid cell is within this share of the change that the steeper end's slope would make over it.
GRID_ERROR = 0.02

# The nearest pixel shows exp(-UNSEEN) of a highlight's peak, or more, or the exponent is not looked at.
UNSEEN = 60.0


@dataclass(frozen=True, eq=False)
class Optimum:
    """The global optimum, and what error bars, reports and plots need.

    Columns of ``gram`` and ``product`` are ambient, diffuse, lobe, and the lobe's derivative by n (0 without a lobe).

    Attributes:
        n: Exponent, between its bounds; without meaning where ``flat``.
        x: Coefficients x_a, x_d, x_s, at least 0, exactly 0 at the bound.
        cost: Sum of weighted squared residuals.
        pixels: How many pixels count (weight above 0).
        gram: Weighted products of the columns at the optimum.
        product: Weighted products of the columns with the target.
        square: Weighted squares of the target.
        grid: Exponents of the profile's samples; empty without a lobe.
        profile: Least cost at each, summed over channels: of a subsample of many pixels, scaled.
    """

    n: float
    x: Float[np.ndarray, "3 C"]
    cost: Float[np.ndarray, " C"]
    pixels: Float[np.ndarray, " C"]
    gram: Float[np.ndarray, "C 4 4"]
    product: Float[np.ndarray, "C 4"]
    square: Float[np.ndarray, " C"]
    grid: Float[np.ndarray, " G"]
    profile: Float[np.ndarray, " G"]

    @property
    def flat(self) -> bool:
        """No channel has a specular term, so every n fits equally well."""
        return not np.any(self.x[2] > 0)

    @property
    def gauss_newton(self) -> Float[np.ndarray, "C 4 4"]:
        """Half the Gauss-Newton Hessian of the cost by (x_a, x_d, x_s, n), channel by channel."""
        scale = np.ones((self.x.shape[1], 4))
        scale[:, 3] = self.x[2]
        return self.gram * scale[:, :, None] * scale[:, None, :]

    def normal(self, variance: Float[np.ndarray, " C"] | float = 1.0) -> NormalEquations:
        """Normal equations of all channels by the variance of each one's noise."""
        return join_channels(self.gram, self.product, self.square, self.x[2], variance)


def within_sight(
    pictures: Sequence[Picture], free: Bool[np.ndarray, "3 C"], n_range: tuple[float, float]
) -> tuple[Bool[np.ndarray, "3 C"], tuple[float, float]]:
    """What may be above 0, and exponents of which some pixel sees a trace: with larger ones k_s could be anything."""
    if not free[2].any():
        return free, n_range
    peak = max(picture.nearest_peak for picture in pictures)
    upper = min(n_range[1], UNSEEN / max(-peak, UNSEEN / n_range[1]))
    return (free, (n_range[0], upper)) if upper >= n_range[0] else (free & [[True], [True], [False]], n_range)


def search(
    pictures: Sequence[Picture],
    free: Bool[np.ndarray, "3 C"] | None = None,
    n_range: tuple[float, float] = (0.1, 1e6),
    cap: Cap | None = None,
) -> Optimum:
    """Find the global optimum over the exponent and the non-negative coefficients.

    Pictures of one material, or tiles of one, are of one dtype and number of channels. They are gone through once per
    pass over the pixels (three or four times), so a stream that loads each when asked for keeps one in memory. All
    coefficients that are free, or all by default, may be above 0; if no x_s may be, or no picture has a lobe, the
    problem is linear and n without meaning. The cap is from the exponent to what x_a, x_d, x_s of each channel count in
    a sum of at most 1, (3, C).
    """
    with jax.enable_x64(True):
        problem = problem_of(pictures, n_range, free)._replace(cap=cap)
        lower, upper = problem.bounds
        sample = subsample(pictures) if problem.free[:, 2].any() else None
        if sample is None or sample.nearest == math.inf:
            problem = problem._replace(free=problem.free & [True, True, False])
            start = Point(lower, np.zeros(problem.free.shape), np.zeros(len(problem.free)))
            return _optimum(*gauss_newton(problem, start), problem)
        problem = problem._replace(peak=-sample.nearest)
        log_n = np.linspace(lower, upper, max(2, 1 + math.ceil((upper - lower) / GRID_STEP)))
        lobes = sample.lobes(log_n, problem.peak)
        few = sample.sums(lobes)
        profile = solve_linear(few, log_n, np.zeros(problem.free.shape), problem)
        about = np.exp(log_n), profile.cost.sum(axis=1)
        rough = _without_lobe(few)
        if problem.tolerance == TOLERANCE_SINGLE and not _resolved(profile, few, rough):
            # Sums in double precision over all pixels, one picture at a time: slow, and rarely needed.
            exact = Stream(lambda i: cast(pictures[i], "float64"), len(pictures))
            problem = problem._replace(pictures=exact, tolerance=TOLERANCE_DOUBLE)
        minimum = gauss_newton if cap is None else capped_minimum
        if not sample.whole:
            error = _sampling_errors(profile, sample, lobes)
            position, lowest, possible = _cells(profile, error)
            cell = int(np.argmin(lowest))
            first, last = np.flatnonzero(possible)[[0, -1]]
            if last - first <= 3 and profile.slope[cell] < profile.slope[cell + 1]:
                found = minimum(problem, _start(profile, cell, float(position[cell])), GRID_STEP)
                # A minimum at the end of its reach is none, but for the bounds of the search.
                if abs(found[0].log_n - position[cell]) < GRID_STEP or found[0].log_n in problem.bounds:
                    return _optimum(*found, problem, *about)
            log_n = log_n[max(0, first - 1) : last + 3]
            profile = solve_linear(sums(pictures, log_n, rough, problem.peak), log_n, rough, problem)
        candidates = [minimum(problem, start, GRID_STEP) for start in _valleys(profile, problem.tolerance)]
        # Where the profile is level the best sample may be no worse than what the valleys led to.
        costs = profile.cost.sum(axis=1)
        if cap is None and np.min(costs) < min(np.sum(point.cost) for point, _ in candidates):
            candidates.append(gauss_newton(problem, Point(*(leaf[np.argmin(costs)] for leaf in profile)), GRID_STEP))
        best = min(candidates, key=lambda candidate: float(np.sum(candidate[0].cost)))
        return _optimum(*best, problem, *about)


def _start(profile: Point, cell: int, position: float) -> Point:
    """A point in a cell of the grid, with the coefficients of the nearer end."""
    nearer = cell + int(2 * position > profile.log_n[cell] + profile.log_n[cell + 1])
    return Point(position, profile.x[nearer], profile.cost[nearer])


def refit(
    pictures: Sequence[Picture],
    optimum: Optimum,
    free: Bool[np.ndarray, "3 C"],
    n_range: tuple[float, float],
    tied: Float[np.ndarray, " C"] | None = None,
) -> Optimum:
    """The optimum near that of a search with the same ``free``: of other weights, or with one x_s for all channels.

    It is then a common factor times ``tied``; None where the channels are independent.
    """
    x = optimum.x.copy()
    if tied is not None:
        tied = np.where(free[2], tied, 0.0)
        x[2] = tied * (x[2] @ tied) / max(tied @ tied, np.finfo(float).tiny)
    with jax.enable_x64(True):
        problem = problem_of(pictures, n_range, free)._replace(tied=tied)
        if not x[2].any():
            problem = problem._replace(free=problem.free & [True, True, False])
        found = gauss_newton(problem, Point(math.log(optimum.n), x.T, optimum.cost))
    return _optimum(*found, problem, optimum.grid, optimum.profile)


def _without_lobe(few: Sums) -> np.ndarray:
    """Ambient and diffuse alone, (C, 3).

    Products are taken of the residual against this model, so that float32 sums lose nothing to the bulk of the picture;
    any model near the target will do.
    """
    x = np.linalg.pinv(few.gram[0, :, :2, :2], hermitian=True) @ few.product[0, :, :2, None]
    return np.pad(x[..., 0], np.array([(0, 0), (0, 1)]))


def _resolved(profile: Point, few: Sums, rough: np.ndarray) -> bool:
    """Whether single precision leaves the valley, or what noise leaves of it."""
    cost = profile.cost.sum(axis=1)
    best = int(np.argmin(cost))
    # Where basis images nearly add up to one another, large coefficients cancel, and with them the digits of the
    # products: then several samples may seem to fit exactly. In scenes where they do not, rounding is 1e-5 to 2e-4 of
    # the rise to the next sample (`python -m benchmarks.tradeoff`, its twenty scenes).
    size = np.abs(profile.x[best] - rough) * np.sqrt(np.diagonal(few.gram[best], axis1=-2, axis2=-1)[:, :3])
    rounding = np.finfo(np.float32).eps * np.sum(np.sum(size, axis=-1) ** 2)
    rise = np.min(np.delete(cost[max(best - 1, 0) : best + 2], min(best, 1))) - cost[best]
    noise = cost[best] / max(np.max(few.pixels), 1.0)
    return bool(rounding <= UNRESOLVED * max(rise, noise))


def _sampling_errors(profile: Point, sample: Subsample, lobes: Sequence[Lobes]) -> np.ndarray:
    """Standard deviation of a subsample's cost relative to its best sample, over the grid."""
    size, best = profile.log_n.size, int(np.argmin(profile.cost.sum(axis=1)))
    # It varies slowly; every fourth sample will do, and those about the best.
    near = np.clip(np.arange(best - 2, best + 3), 0, size - 1)
    few = np.unique(np.concatenate([np.arange(0, size, 4), near, [size - 1]]))
    variance = sample.spread(lobes, few, profile.x[few], int(np.searchsorted(few, best)))
    return np.interp(profile.log_n, profile.log_n[few], np.sqrt(variance))


def lowest_in_cells(log_n: Any, cost: Any, slope: Any) -> tuple[Any, Any]:
    """Where in each cell of a grid the cubic of Hermite through the samples is least, and how low.

    The slope is the derivative of the cost by log n, (G,); in NumPy or JAX.
    """
    xp: Any = np if isinstance(cost, np.ndarray) else jnp
    t, step = xp.linspace(0.0, 1.0, 33, dtype=log_n.dtype), xp.diff(log_n)
    bent = step[:, None] * t * (1 - t) * ((1 - t) * slope[:-1, None] - t * slope[1:, None])
    # Between slopes of one sign an end is lowest: where a coefficient comes to 0 the cubic would dip below it.
    bent = xp.where(slope[:-1, None] * slope[1:, None] > 0, 0.0, bent)
    values = cost[:-1, None] + t * t * (3 - 2 * t) * xp.diff(cost)[:, None] + bent
    return log_n[:-1] + t[xp.argmin(values, axis=1)] * step, xp.min(values, axis=1)


def _cells(profile: Point, error: Any = 0.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The lowest place in each cell of the grid, how low, and whether it may be the best.

    The error is the standard deviation of the cost at each sample relative to the best.
    """
    position, lowest = lowest_in_cells(profile.log_n, profile.cost.sum(axis=1), profile.slope)
    steeper, error = (np.maximum(a[:-1], a[1:]) for a in (np.abs(profile.slope), error + np.zeros(len(profile.log_n))))
    margin = GRID_ERROR * np.diff(profile.log_n) * steeper
    best = np.argmin(lowest)
    return position, lowest, lowest <= lowest[best] + DEVIATIONS * error + margin + margin[best]


def _valleys(profile: Point, tolerance: float) -> list[Point]:
    """A start in every cell with a minimum of the profile of all pixels that may be the least."""
    position, lowest, possible = _cells(profile)
    # A dent no deeper than rounding is no minimum of its own: where a highlight is smaller than a pixel, the profile is
    # level over decades of n.
    low = np.min(lowest)
    depth = 1e-9 * low + 2 * tolerance * (low + np.max(profile.cost.sum(axis=1))) + np.finfo(float).tiny
    level = np.pad(np.where(possible, np.round((lowest - low) / depth), np.inf), 1, constant_values=np.inf)
    cells = np.flatnonzero((level[1:-1] < level[:-2]) & (level[1:-1] <= level[2:]))
    return [_start(profile, cell, float(position[cell])) for cell in cells.tolist()]


def _optimum(point: Point, about: Sums, problem: Problem, grid: Any = (), profile: Any = ()) -> Optimum:
    """Gather the answer, with the lobe and its derivative by n in place of those relative to the lobe's peak."""
    # An exponent at its bound is the bound, not the exponential of its logarithm.
    known = dict(zip(problem.bounds, problem.n_range, strict=True))
    n = known.get(point.log_n, math.exp(point.log_n))
    decay = math.exp(n * problem.peak)
    basis = np.diag([1.0, 1.0, decay, decay / n])
    basis[3, 2] = decay * problem.peak
    if not problem.free[:, 2].any():
        basis[2:] = 0.0
    about = about.columns(basis)
    return Optimum(
        n=n,
        # Where no pixel sees the lobe it is not free, and its x_s is 0.
        x=point.x.T / np.array([[1.0], [1.0], [decay or 1.0]]),
        cost=point.cost,
        pixels=about.pixels,
        gram=about.gram,
        product=about.product,
        square=about.square,
        grid=np.asarray(grid),
        profile=np.asarray(profile),
    )
