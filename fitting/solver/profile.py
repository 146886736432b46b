"""The separable engine: the global optimum of ``sum w (target - x_a A - x_d D - x_s S(n))^2`` over n and x >= 0.

Variable projection (Golub and Pereyra 1973, SIAM J. Numer. Anal. 10, 413): for a given n the best x is a tiny exact
problem, so the search is one-dimensional, in log n. The host drives it and pixels are touched only by
:mod:`fitting.solver.normal_equations`, whose results add up: one picture in memory, a hundred photographs and the tiles
of a file on disk are the same loop.

1. A stratified subsample of each picture (:mod:`fitting.solver.subsample`), or all of a small one, gives the profile
   and its slope on a grid over log n. As a function of log n any lobe varies on a scale of 1 or more, so steps of 0.35
   miss no minimum.
2. The subsample also says how far its profile may be from that of all pixels. If one valley is left at six standard
   deviations, the search goes on there; else the grid is repeated on all pixels where the optimum may be.
3. A bracket is refined on all pixels with one pass at its two ends (:mod:`fitting.solver.refinement`): values and
   slopes of the lobe there, Hermite's cubic in between, so all products needed in the bracket follow from one Gram
   matrix, and the least cost in it is found without a pixel.
4. Passes at the optimum in residual form give the exact cost and a joint Gauss-Newton correction of x and n, repeated
   while it moves n.

A cap on sums of coefficients (k_d + k_s <= 1, what a plausible material keeps) is one more bound of the tiny problem:
the same search under it is as global.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any, cast

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Bool, Float

from fitting.solver.normal_equations import Picture, Sums, sums
from fitting.solver.refinement import (
    GRID_STEP,
    TOLERANCE_DOUBLE,
    TOLERANCE_SINGLE,
    Cap,
    Point,
    Problem,
    enclose,
    gauss_newton,
    problem_of,
    solve_linear,
)
from fitting.solver.streams import Stream, each
from fitting.solver.subsample import Subsample, spread, subsample

# How many pixels of all pictures together the grid is evaluated on, and how many of each picture at least.
SAMPLE_SIZE = 4096
SMALLEST_SAMPLE = 256

# Six standard deviations: one wrong rejection in 1e9, and the variance itself is an estimate.
DEVIATIONS = 6.0

# Rounding above this share of the rise from the best sample to its neighbour, and of the noise's variance, hides both.
UNRESOLVED = 0.1

# Hermite's cubic over a grid cell is within this share of the change that the steeper end's slope would make over it.
GRID_ERROR = 0.02


class Optimum(eqx.Module):
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
        flat: No channel has a specular term, so every n fits equally well.
        grid: Exponents of the profile's samples; empty without a lobe.
        profile: Least cost at each, summed over channels; of the subsample, scaled, where ``profile_sampled``.
        profile_sampled: The profile is that of a subsample of the pixels.
    """

    n: float
    x: Float[np.ndarray, "3 C"]
    cost: Float[np.ndarray, " C"]
    pixels: Float[np.ndarray, " C"]
    gram: Float[np.ndarray, "C 4 4"]
    product: Float[np.ndarray, "C 4"]
    square: Float[np.ndarray, " C"]
    flat: bool
    grid: Float[np.ndarray, " G"]
    profile: Float[np.ndarray, " G"]
    profile_sampled: bool

    @property
    def gauss_newton(self) -> Float[np.ndarray, "C 4 4"]:
        """Half the Gauss-Newton Hessian of the cost by (x_a, x_d, x_s, n), channel by channel."""
        scale = np.ones((self.x.shape[1], 4))
        scale[:, 3] = self.x[2]
        return self.gram * scale[:, :, None] * scale[:, None, :]


def search(
    pictures: Sequence[Picture],
    *,
    n_min: float = 0.1,
    n_max: float = 1e6,
    free: Bool[np.ndarray, "3 C"] | None = None,
    cap: Cap | None = None,
) -> Optimum:
    """Find the global optimum over the exponent and the non-negative coefficients.

    Args:
        pictures: Pictures of one material, all of one dtype and number of channels, or the tiles of a picture. They are
            gone through once per pass over the pixels (three or four times), so a stream that loads each when asked
            for keeps one in memory.
        n_min: Smallest exponent, above 0.
        n_max: Largest exponent.
        free: Which of x_a, x_d, x_s may be above 0, per channel; all by default. If no x_s may be, or no picture has a
            lobe, the problem is linear and n without meaning.
        cap: From the exponent to what x_a, x_d, x_s of each channel count in a sum of at most 1, (3, C); None for no
            such bound.

    Returns:
        The optimum.
    """
    with jax.enable_x64(True):
        problem = problem_of(pictures, (n_min, n_max), free)._replace(cap=cap)
        size = max(SMALLEST_SAMPLE, SAMPLE_SIZE // len(pictures))
        samples = [subsample(picture, size, n_max) for picture in pictures] if problem.lobe else []
        nearest = min((sample.nearest for sample in samples), default=math.inf)
        if nearest < math.inf:
            problem = problem._replace(peak=-nearest)
        else:
            problem = problem._replace(lobe=False)
        if not problem.lobe or n_min == n_max:
            nothing = np.zeros(problem.free.shape)
            return _optimum(*gauss_newton(problem, Point(problem.bounds[0], nothing, nothing[:, 0])), problem)
        found = _search_with_lobe(problem, samples)
        if found is None:
            # Sums in double precision over all pixels, one picture at a time: slow, and rarely needed.
            exact = Stream(lambda i: jax.tree.map(lambda leaf: leaf.astype(np.float64), pictures[i]), len(pictures))
            problem = problem._replace(pictures=exact, tolerance=TOLERANCE_DOUBLE)
            found = _search_with_lobe(problem, each(lambda picture: Subsample(picture, None, 0.0), exact))
        assert found is not None
        return found


def fit_tied(
    pictures: Sequence[Picture],
    optimum: Optimum,
    free: Bool[np.ndarray, "3 C"],
    tied: Float[np.ndarray, " C"],
    n_range: tuple[float, float],
) -> Optimum:
    """The optimum with one specular coefficient for all channels, from that with one for each.

    Args:
        pictures: as they were searched.
        optimum: of the search with the same ``free``.
        free: which coefficients may be above 0.
        tied: x_s is a common factor times this, (C,).
        n_range: bounds of n.
    """
    tied = np.where(free[2], tied, 0.0)
    x = optimum.x.copy()
    x[2] = tied * (x[2] @ tied) / max(tied @ tied, np.finfo(float).tiny)
    with jax.enable_x64(True):
        problem = problem_of(pictures, n_range, free)._replace(tied=tied)
        found = gauss_newton(problem, Point(math.log(optimum.n), x.T, optimum.cost))
    return _optimum(*found, problem, optimum.grid, optimum.profile, sampled=optimum.profile_sampled)


def _search_with_lobe(problem: Problem, samples: Sequence[Subsample]) -> Optimum | None:
    """The search; nothing where single precision does not resolve the profile."""
    few = each(lambda sample: sample.picture, samples)
    rough = rough_model(few)
    lower, upper = problem.bounds
    log_n = np.linspace(lower, upper, max(2, 1 + math.ceil((upper - lower) / GRID_STEP)))
    sampled = any(sample.factor is not None for sample in samples)
    # Most subsamples are float32.
    tolerance = TOLERANCE_SINGLE if sampled else problem.tolerance
    profile, resolved = profile_on_grid(few, log_n, rough, problem._replace(tolerance=tolerance))
    if tolerance == TOLERANCE_SINGLE and not resolved:
        return None
    grid, cost, part = np.exp(log_n), profile.cost.sum(axis=1), profile
    if sampled:
        error, slope_error = sampling_errors(profile, samples, problem.peak)
        position, lowest, possible = _cells(profile, error)
        cell = int(np.argmin(lowest))
        first, last = np.flatnonzero(possible)[[0, -1]]
        curvature = (np.diff(profile.slope) / np.diff(log_n))[cell]
        if last - first <= 3 and curvature > 0:
            # Three standard deviations and what the cubic is off; a bracket that misses moves on.
            half = min(3 * np.max(slope_error[cell : cell + 2]) / curvature + 0.01, GRID_STEP)
            bracket = max(lower, position[cell] - half), min(upper, position[cell] + half)
            point, inside = enclose(problem, *bracket, profile.x[cell])
            if inside:
                return _optimum(*gauss_newton(problem, point), problem, grid, cost, sampled=True)
        part, _ = profile_on_grid(problem.pictures, log_n[max(0, first - 1) : last + 3], rough, problem)
    candidates = [
        gauss_newton(problem, enclose(problem, part.log_n[cell], part.log_n[cell + 1], part.x[cell])[0])
        for cell in _valleys(part, problem.tolerance)
    ]
    # Where the profile is level the best sample may be no worse than what the brackets led to.
    costs = part.cost.sum(axis=1)
    if np.min(costs) < min(np.sum(point.cost) for point, _ in candidates):
        candidates.append(gauss_newton(problem, Point(*(leaf[np.argmin(costs)] for leaf in part))))
    best = min(candidates, key=lambda candidate: float(np.sum(candidate[0].cost)))
    return _optimum(*best, problem, grid, cost, sampled=sampled)


def rough_model(pictures: Iterable[Picture]) -> np.ndarray:
    """Ambient and diffuse from a few hundred pixels of each picture, (C, 3).

    Products are taken of the residual against this model, so that float32 sums lose nothing to the bulk of the picture;
    any model near the target will do.
    """
    gram: Any = 0.0
    for picture in pictures:
        stride = max(1, picture.target.shape[0] // 256)
        # Through NumPy: a slice of an array on the device would be compiled.
        few = replace(picture, lobe=None).pixels(lambda a, stride=stride: cast(Any, np.asarray(a)[::stride]))
        target = np.where(few.weights > 0, few.target, 0).astype(float)
        columns = np.stack(np.broadcast_arrays(few.ambient, few.diffuse, target))
        gram = gram + np.einsum("ipc,jpc->cij", few.weights * columns, columns)
    x = np.linalg.pinv(gram[:, :2, :2], hermitian=True) @ gram[:, :2, 2:]
    return np.pad(x[..., 0], np.array([(0, 0), (0, 1)]))


def profile_on_grid(
    pictures: Iterable[Picture], log_n: np.ndarray, rough: np.ndarray, problem: Problem
) -> tuple[Point, bool]:
    """The profile on a grid, and whether rounding leaves the valley, or what noise leaves of it."""
    parts = sums(pictures, log_n, rough, grid=True, peak=problem.peak)
    profile = solve_linear(parts, log_n, rough, problem)
    cost = profile.cost.sum(axis=1)
    best = int(np.argmin(cost))
    # Where basis images nearly add up to one another, large coefficients cancel, and with them the digits of the
    # products: then several samples may seem to fit exactly. In scenes where they do not, rounding is 1e-5 to 2e-4 of
    # the rise to the next sample (`python -m benchmarks.tradeoff`, its twenty scenes).
    size = np.abs(profile.x[best] - rough) * np.sqrt(np.diagonal(parts.gram[best], axis1=-2, axis2=-1)[:, :3])
    rounding = np.finfo(np.float32).eps * np.sum(np.sum(size, axis=-1) ** 2)
    rise = np.min(np.delete(cost[max(best - 1, 0) : best + 2], min(best, 1))) - cost[best]
    noise = cost[best] / max(np.max(parts.pixels), 1.0)
    return profile, bool(rounding <= UNRESOLVED * max(rise, noise))


def sampling_errors(profile: Point, samples: Sequence[Subsample], peak: float) -> tuple[np.ndarray, np.ndarray]:
    """Standard deviations of a subsample's cost relative to its best sample, and of its slope, over the grid."""
    log_n, best = profile.log_n, np.argmin(profile.cost.sum(axis=1))
    # It varies slowly; every other sample will do.
    few = np.append(np.arange(0, log_n.size - 1, 2), log_n.size - 1)
    variance = np.zeros((2, few.size))
    for sample in samples:
        if sample.factor is not None:
            variance += spread(sample, log_n, profile.x, few, best, peak)
    error, slope_error = (np.interp(log_n, log_n[few], deviation) for deviation in np.sqrt(variance))
    return error, slope_error


def _cells(profile: Point, error: Any = 0.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where in each cell of the grid the cubic through the samples is least, how low, and whether it may be the best.

    Args:
        profile: On the grid.
        error: Standard deviation of the cost at each sample relative to the best.
    """
    t = np.linspace(0.0, 1.0, 33)
    cost, slope = profile.cost.sum(axis=1)[:, None], profile.slope[:, None]
    step = np.diff(profile.log_n)
    values = cost[:-1] + t * t * (3 - 2 * t) * (cost[1:] - cost[:-1])
    values = values + step[:, None] * t * (1 - t) * ((1 - t) * slope[:-1] - t * slope[1:])
    lowest = np.min(values, axis=1)
    steeper, error = (np.maximum(a[:-1], a[1:]) for a in (np.abs(profile.slope), error + np.zeros(len(cost))))
    margin = GRID_ERROR * step * steeper
    best = np.argmin(lowest)
    possible = lowest <= lowest[best] + DEVIATIONS * error + margin + margin[best]
    return profile.log_n[:-1] + t[np.argmin(values, axis=1)] * step, lowest, possible


def _valleys(profile: Point, tolerance: float) -> np.ndarray:
    """Every cell with a minimum of the profile of all pixels that may be the least."""
    _, lowest, possible = _cells(profile)
    # A dent no deeper than rounding is no minimum of its own: where a highlight is smaller than a pixel, the profile is
    # level over decades of n.
    low = np.min(lowest)
    depth = 1e-9 * low + 2 * tolerance * (low + np.max(profile.cost.sum(axis=1))) + np.finfo(float).tiny
    level = np.pad(np.where(possible, np.round((lowest - low) / depth), np.inf), 1, constant_values=np.inf)
    return np.flatnonzero((level[1:-1] < level[:-2]) & (level[1:-1] <= level[2:]))


def _optimum(
    point: Point,
    about: Sums,
    problem: Problem,
    grid: Any = (),
    profile: Any = (),
    *,
    sampled: bool = False,
) -> Optimum:
    """Gather the answer, with the lobe and its derivative by n in place of those relative to the lobe's peak."""
    # An exponent at its bound is the bound, not the exponential of its logarithm.
    known = dict(zip(problem.bounds, problem.n_range, strict=True))
    n = known.get(point.log_n, math.exp(point.log_n))
    decay = math.exp(n * problem.peak)
    basis = np.diag([1.0, 1.0, decay, decay / n])
    basis[3, 2] = decay * problem.peak
    about = about.columns(basis)
    return Optimum(
        n=n,
        x=point.x.T / np.array([[1.0], [1.0], [decay]]),
        cost=point.cost,
        pixels=about.pixels,
        gram=about.gram,
        product=about.product,
        square=about.square,
        flat=not np.any(point.x[:, 2] > 0),
        grid=np.asarray(grid),
        profile=np.asarray(profile),
        profile_sampled=sampled,
    )
