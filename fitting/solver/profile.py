"""The separable engine: the global optimum of ``sum w (target - x_a A - x_d D - x_s S(n))^2`` over n and x >= 0.

Variable projection (Golub and Pereyra 1973, SIAM J. Numer. Anal. 10, 413): for a given n the best x is a tiny exact
problem, so the search is one-dimensional, in log n. The host drives it and pixels are touched only by
:mod:`fitting.solver.normal_equations`, whose results add up: one picture in memory, a hundred photographs and the tiles
of a file
on disk are the same loop.

1. A stratified subsample of each picture (:mod:`fitting.solver.subsample`), or all of a small one, gives the profile
   and
   its slope on a grid over log n (:mod:`fitting.solver.profile`). As a function of log n any lobe varies on a scale of
   1 or more, so steps of 0.35 miss no minimum.
2. The subsample also says how far its profile may be from that of all pixels. If one valley is left at six standard
   deviations, the search goes on there; else the grid is repeated on all pixels where the optimum may be.
3. A bracket is refined on all pixels with one pass at its two ends (:mod:`fitting.solver.refinement`): values and
   slopes of the lobe there, Hermite's cubic in between, so all products needed in the bracket follow from one Gram
   matrix, and Brent's method finds the least cost in it without a pixel.
4. Passes at the optimum in residual form give the exact cost and a joint Gauss-Newton correction of x and n, repeated
   while it moves n.

A cap on sums of coefficients (k_d + k_s <= 1, what a plausible material keeps) is one more bound of the tiny problem:
the same search under it is as global.
"""

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

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
    Linear,
    Point,
    Problem,
    Start,
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


class Profile(NamedTuple):
    """The profile's samples: of a subsample of the pixels or of all of them.

    Attributes:
        log_n: Grid.
        linear: Best coefficients, cost and slope at each.
        error: Standard deviation of the cost relative to the best sample; 0 where all pixels were used.
        slope_error: That of the slope.
        resolved: Whether rounding leaves the valley, or what noise leaves of it.
    """

    log_n: Float[np.ndarray, " G"]
    linear: Linear
    error: Float[np.ndarray, " G"]
    slope_error: Float[np.ndarray, " G"]
    resolved: bool

    @property
    def cost(self) -> Float[np.ndarray, " G"]:
        """Cost summed over channels."""
        return self.linear.cost.sum(axis=1)

    def margin(self) -> Float[np.ndarray, " G-1"]:
        """How far the cubic may be from the profile, cell by cell."""
        slope = np.abs(self.linear.slope)
        return GRID_ERROR * np.diff(self.log_n) * np.maximum(slope[:-1], slope[1:])

    def nearest(self, log_n: float) -> Float[np.ndarray, "C 3"]:
        """The best coefficients at the nearest sample."""
        return self.linear.x[np.argmin(np.abs(self.log_n - log_n))]

    def fine(self) -> tuple[Float[np.ndarray, "G 33"], Float[np.ndarray, "G 33"]]:
        """Positions and values of the piecewise cubic through samples and slopes, 33 per cell, ends included."""
        t = np.linspace(0.0, 1.0, 33)
        cost, slope = self.cost[:, None], self.linear.slope[:, None]
        step = (self.log_n[1:] - self.log_n[:-1])[:, None]
        values = cost[:-1] + t * t * (3 - 2 * t) * (cost[1:] - cost[:-1])
        values = values + step * t * (1 - t) * ((1 - t) * slope[:-1] - t * slope[1:])
        return self.log_n[:-1, None] + t * step, values


def rough_model(pictures: Iterable[Picture]) -> Float[np.ndarray, "C 3"]:
    """Ambient and diffuse from a few hundred pixels of each picture.

    Products are taken of the residual against this model, so that float32 sums lose nothing to the bulk of the picture;
    any model near the target will do.
    """
    gram, product = 0.0, 0.0
    for picture in pictures:
        stride = max(1, picture.target.shape[0] // 256)
        # Through NumPy: a slice of an array on the device would be compiled.
        target, diffuse = (np.asarray(a)[::stride].astype(float) for a in (picture.target, picture.diffuse))
        weight = np.ones((1, 1)) if picture.weight is None else np.asarray(picture.weight)[::stride]
        weight = np.broadcast_to(weight if weight.ndim == 2 else weight[:, None], target.shape)
        target = np.where(weight > 0, target, 0.0)
        # (C, P, 2), so that the products are matrix products, channel by channel.
        columns = np.stack([np.broadcast_to(a, target.shape).T for a in (picture.ambient, diffuse)], axis=-1)
        weighted = (columns * weight.T[:, :, None]).swapaxes(1, 2)
        gram = gram + weighted @ columns
        product = product + (weighted @ target.T[:, :, None])[:, :, 0]
    x = np.einsum("cij,cj->ci", np.linalg.pinv(gram, hermitian=True), product)
    return np.pad(x, [(0, 0), (0, 1)])


def profile_on_grid(pictures: Iterable[Picture], log_n: np.ndarray, rough: np.ndarray, problem: Problem) -> Profile:
    """The profile on a grid."""
    parts = sums(pictures, log_n, rough, grid=True, peak=problem.peak)
    linear = solve_linear(parts, log_n, rough, problem)
    cost, nothing = linear.cost.sum(axis=1), np.zeros(log_n.size)
    best = int(np.argmin(cost))
    # Where basis images nearly add up to one another, large coefficients cancel, and with them the digits of the
    # products: then several samples may seem to fit exactly. In scenes where they do not, rounding is 1e-5 to 2e-4 of
    # the rise to the next sample (`python -m benchmarks.tradeoff`, its twenty scenes).
    size = np.abs(linear.x[best] - rough) * np.sqrt(np.diagonal(parts.gram[best], axis1=-2, axis2=-1)[:, :3])
    rounding = np.finfo(np.float32).eps * np.sum(np.sum(size, axis=-1) ** 2)
    rise = np.min(np.delete(cost[max(best - 1, 0) : best + 2], min(best, 1))) - cost[best]
    noise = cost[best] / max(np.max(parts.pixels), 1.0)
    return Profile(log_n, linear, nothing, nothing, bool(rounding <= UNRESOLVED * max(rise, noise)))


def with_errors(profile: Profile, samples: Sequence[Subsample], problem: Problem) -> Profile:
    """How far the subsample's profile may be from that of all pixels."""
    log_n, best = profile.log_n, np.argmin(profile.cost)
    # It varies slowly; every other sample will do.
    few = np.append(np.arange(0, log_n.size - 1, 2), log_n.size - 1)
    variance = np.zeros((2, few.size))
    for sample in samples:
        if sample.factor is not None:
            variance += spread(sample, log_n, profile.linear.x, few, best, problem.peak)
    error, slope_error = (np.interp(log_n, log_n[few], each) for each in np.sqrt(variance))
    return profile._replace(error=error, slope_error=slope_error)


def possible_cells(profile: Profile) -> tuple[int, int]:
    """First and last grid cell of a subsample's profile that may hold the optimum of all pixels."""
    lowest = np.min(profile.fine()[1], axis=1)
    best = np.argmin(lowest)
    error = np.maximum(profile.error[:-1], profile.error[1:])
    margin = profile.margin()
    possible = np.flatnonzero(lowest - lowest[best] <= DEVIATIONS * error + margin + margin[best])
    return int(possible[0]), int(possible[-1])


def start_from_sample(profile: Profile, problem: Problem) -> Start | None:
    """The valley of a subsample's profile, where that is clear."""
    position, value = profile.fine()
    cell, t = np.unravel_index(np.argmin(value), value.shape)
    first, last = possible_cells(profile)
    slope = profile.linear.slope
    curvature = (slope[cell + 1] - slope[cell]) / (profile.log_n[cell + 1] - profile.log_n[cell])
    if last - first > 3 or curvature <= 0:
        return None
    centre = float(position[cell, t])
    # Three standard deviations and what the cubic is off; a bracket that misses moves on.
    half = min(3 * float(np.max(profile.slope_error[cell : cell + 2])) / curvature + 0.01, GRID_STEP)
    least, most = problem.bounds
    return Start(max(least, centre - half), min(most, centre + half), least, most, profile.nearest(centre))


def starts(profile: Profile, problem: Problem) -> list[Start]:
    """Every cell of the profile of all pixels that may hold the optimum, the most promising first."""
    position, value = profile.fine()
    cells, inside = value.shape
    flat = value.ravel()
    low = np.min(flat)
    best = int(np.argmin(np.min(value, axis=1)))
    margin = profile.margin()
    limit = np.repeat(low + margin + margin[best], inside)
    before = np.concatenate([[np.inf], flat[:-1]])
    after = np.concatenate([flat[1:], [np.inf]])
    minima = np.flatnonzero((flat <= before) & (flat <= after) & (flat <= limit))
    # A dent no deeper than rounding is no minimum of its own: where a highlight is smaller than a pixel, the profile is
    # level over decades of n.
    depth = 1e-9 * low + 2 * problem.tolerance * (low + np.max(profile.cost))
    found: list[int] = []
    for i in minima[np.argsort(flat[minima], kind="stable")]:
        if all(np.max(flat[min(i, j) : max(i, j) + 1]) > flat[i] + depth for j in found):
            found.append(int(i))
    starts = []
    for i in found:
        cell, t = divmod(i, inside)
        # The cubic cannot tell on which side of a sample a minimum beside it lies.
        first = cell - 1 if t == 0 and cell > 0 else cell
        last = cell + 1 if t == inside - 1 and cell < cells - 1 else cell
        least, most = float(profile.log_n[first]), float(profile.log_n[last + 1])
        lower, upper = float(profile.log_n[cell]), float(profile.log_n[cell + 1])
        starts.append(Start(lower, upper, least, most, profile.nearest(float(position[cell, t]))))
    return starts


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
        samples: Sequence[Subsample] = []
        if problem.lobe:
            size = max(SMALLEST_SAMPLE, SAMPLE_SIZE // len(pictures))
            samples = [subsample(picture, size, n_max) for picture in pictures]
            problem = problem._replace(lobe=any(sample.picture.lobe is not None for sample in samples))
        if problem.lobe:
            nearest = min(sample.nearest for sample in samples)
            problem = problem._replace(peak=-nearest if nearest < math.inf else 0.0)
        if not problem.lobe or n_min == n_max:
            nothing = np.zeros(problem.free.shape)
            return _optimum(*gauss_newton(problem, Point(problem.bounds[0], nothing, nothing[:, 0])), problem)
        found = _search_with_lobe(problem, samples)
        if found is not None:
            return found
        # Sums in double precision over all pixels, one picture at a time: slow, and rarely needed.
        exact = Stream(lambda i: jax.tree.map(lambda leaf: leaf.astype(np.float64), pictures[i]), len(pictures))
        problem = problem._replace(pictures=exact, tolerance=TOLERANCE_DOUBLE)
        found = _search_with_lobe(problem, each(lambda picture: Subsample(picture, None, 0.0), exact))
        assert found is not None
        return found


def fit_linear(
    pictures: Sequence[Picture], *, free: Bool[np.ndarray, "3 C"] | None = None, cap: Cap | None = None
) -> Optimum:
    """Ambient and diffuse only: one linear solve, a second in residual form for the exact cost.

    Args:
        pictures: As for :func:`search`; their lobes are not looked at.
        free: Which of x_a, x_d may be above 0.
        cap: As for :func:`search`.
    """
    channels = next(iter(pictures)).target.shape[1]
    free = np.ones((3, channels), bool) if free is None else np.array(free)
    free[2] = False
    return search(pictures, free=free, cap=cap)


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
        found = _optimum(*gauss_newton(problem, Point(math.log(optimum.n), x.T, optimum.cost)), problem)
    profile = (optimum.grid, optimum.profile, optimum.profile_sampled)
    return eqx.tree_at(lambda o: (o.grid, o.profile, o.profile_sampled), found, profile)


def _search_with_lobe(problem: Problem, samples: Sequence[Subsample]) -> Optimum | None:
    """The search; nothing where single precision does not resolve the profile."""
    few = each(lambda sample: sample.picture, samples)
    rough = rough_model(few)
    lower, upper = problem.bounds
    count = max(2, 1 + math.ceil((upper - lower) / GRID_STEP))
    log_n = np.linspace(lower, upper, count)
    sampled = any(sample.factor is not None for sample in samples)
    # Most subsamples are float32.
    profile = profile_on_grid(few, log_n, rough, problem._replace(tolerance=TOLERANCE_SINGLE) if sampled else problem)
    part = profile
    if (sampled or problem.tolerance == TOLERANCE_SINGLE) and not profile.resolved:
        return None
    if sampled:
        profile = with_errors(profile, samples, problem)
        start = start_from_sample(profile, problem)
        if start is not None:
            point, inside = enclose(problem, start)
            if inside:
                return _optimum(*gauss_newton(problem, point), problem, profile, sampled=True)
        first, last = possible_cells(profile)
        part = profile_on_grid(problem.pictures, log_n[max(0, first - 1) : last + 3], rough, problem)
    candidates = [gauss_newton(problem, enclose(problem, start)[0]) for start in starts(part, problem)]
    # Where the profile is level the best sample may be no worse than what the brackets led to.
    best = int(np.argmin(part.cost))
    if part.cost[best] < min(np.sum(point.cost) for point, _ in candidates):
        point = Point(float(part.log_n[best]), part.linear.x[best], part.linear.cost[best])
        candidates.append(gauss_newton(problem, point))
    point, about = min(candidates, key=lambda candidate: float(np.sum(candidate[0].cost)))
    return _optimum(point, about, problem, profile, sampled=sampled)


def _optimum(
    point: Point, about: Sums, problem: Problem, profile: Profile | None = None, *, sampled: bool = False
) -> Optimum:
    """Gather the answer, with the lobe and its derivative by n in place of those relative to the lobe's peak."""
    # An exponent at its bound is the bound, not the exponential of its logarithm.
    known = dict(zip(problem.bounds, problem.n_range, strict=True))
    n = known.get(point.log_n, math.exp(point.log_n))
    decay = math.exp(n * problem.peak)
    columns = np.diag([1.0, 1.0, decay, decay / n])
    columns[3, 2] = decay * problem.peak
    x = point.x.T.copy()
    x[2] /= decay
    return Optimum(
        n=n,
        x=x,
        cost=point.cost,
        pixels=about.pixels,
        gram=columns @ about.gram @ columns.T,
        product=about.product @ columns.T,
        square=about.square,
        flat=not np.any(point.x[:, 2] > 0),
        grid=np.zeros(0) if profile is None else np.exp(profile.log_n),
        profile=np.zeros(0) if profile is None else profile.cost,
        profile_sampled=sampled,
    )
