"""The separable engine: the global optimum of ``sum w (target - x_a A - x_d D - x_s S(n))^2`` over n and x >= 0.

Variable projection (Golub and Pereyra 1973, SIAM J. Numer. Anal. 10, 413): for a given n the best x is a tiny exact
problem, so the search is one-dimensional, in log n. The host drives it and pixels are touched only by
:mod:`fitting.engine.sums`, whose results add up: one picture in memory, a hundred photographs and the tiles of a file
on disk are the same loop.

1. A stratified subsample of each picture (:mod:`fitting.engine.thinning`), or all of a small one, gives the profile and
   its slope on a grid over log n (:mod:`fitting.engine.profile`). As a function of log n any lobe varies on a scale of
   1 or more, so steps of 0.35 miss no minimum.
2. The subsample also says how far its profile may be from that of all pixels. If one valley is left at six standard
   deviations, the search goes on there; else the grid is repeated on all pixels where the optimum may be.
3. A bracket is polished on all pixels with one pass at its two ends (:mod:`fitting.engine.polishing`): values and
   slopes of the lobe there, Hermite's cubic in between, so all products needed in the bracket follow from one Gram
   matrix.
4. Passes at the optimum in residual form give the exact cost and a joint Gauss-Newton correction of x and n, repeated
   while it moves n.

What optimistix does. Step 3 leaves a root of a scalar function on an interval, the slope of the profile, at the price
of a 6 x 6 matrix. ``optimistix.root_find`` with ``Bisection`` keeps the bracket whatever active sets do to the slope's
derivative, and needs no derivative to be traced; ``Newton`` takes three times as long to trace and may jump across the
kinks where an unknown leaves zero; ``GoldenSearch`` on the cost itself stops at half the digits. With no pixel inside
the solver, its 30 steps take 0.1 ms, and it is compiled once per number of channels for every picture and lobe.
"""

import math
from collections.abc import Sequence

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Bool, Float

from fitting.engine.pictures import Lobe, OneLightLobe, Picture
from fitting.engine.polishing import GRID_STEP, Point, Polisher, Problem, solve_linear
from fitting.engine.profile import (
    Profile,
    possible_cells,
    profile_on_grid,
    rough_model,
    start_from_sample,
    starts,
    with_errors,
)
from fitting.engine.streams import Stream, each
from fitting.engine.sums import Sums, sums
from fitting.engine.thinning import Thinned, thin

__all__ = ["Lobe", "OneLightLobe", "Optimum", "Picture", "fit_linear", "search"]

# How many pixels of all pictures together the grid is evaluated on, and how many of each picture at least.
SAMPLE_SIZE = 4096
SMALLEST_SAMPLE = 256

# What rounding may leave of a column that depends on the others: a few units in the last place of the pixels.
_TOLERANCE_SINGLE = 2e-7
_TOLERANCE_DOUBLE = 1e-14


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
        brackets: Lower and upper exponent of each bracket polished on all pixels, in order.
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
    brackets: Float[np.ndarray, "B 2"]

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

    Returns:
        The optimum.
    """
    with jax.enable_x64(True):
        first = next(iter(pictures))
        channels = first.target.shape[1]
        free = np.ones((3, channels), bool) if free is None else np.asarray(free)
        single = np.dtype(first.target.dtype) == np.float32
        tolerance, accuracy = (_TOLERANCE_SINGLE, 1e-5) if single else (_TOLERANCE_DOUBLE, 5e-9)
        lower, upper = np.asarray(math.log(n_min)), np.asarray(math.log(n_max))
        bounds = n_min, n_max
        problem = Problem(free.T, np.asarray(tolerance), accuracy, bounds, lower, upper, peak=np.zeros(()))
        if not free[2].any():
            return _search_without_lobe(pictures, problem)
        size = max(SMALLEST_SAMPLE, SAMPLE_SIZE // len(pictures))
        samples = [thin(picture, size, n_max) for picture in pictures]
        if all(sample.picture.lobe is None for sample in samples):
            return _search_without_lobe(pictures, problem)
        nearest = min(sample.nearest for sample in samples)
        problem = problem._replace(peak=np.asarray(-nearest if nearest < math.inf else 0.0))
        if n_min == n_max:
            return _search_at_one(pictures, problem)
        found = _search_with_lobe(pictures, samples, problem, single=single)
        if found is not None:
            return found
        # Sums in double precision over all pixels, one picture at a time: slow, and rarely needed.
        exact = Stream(lambda i: _in_double(pictures[i]), len(pictures))
        problem = problem._replace(tolerance=np.asarray(_TOLERANCE_DOUBLE))
        samples = each(lambda picture: Thinned(picture, None, 0.0), exact)
        found = _search_with_lobe(exact, samples, problem, single=False)
        assert found is not None
        return found


def _in_double(picture: Picture) -> Picture:
    return jax.tree.map(lambda leaf: leaf.astype(np.float64), picture)


def fit_linear(pictures: Sequence[Picture], *, free: Bool[np.ndarray, "3 C"] | None = None) -> Optimum:
    """Ambient and diffuse only: one linear solve, a second in residual form for the exact cost.

    Args:
        pictures: As for :func:`search`; their lobes are not looked at.
        free: Which of x_a, x_d may be above 0.
    """
    channels = next(iter(pictures)).target.shape[1]
    free = np.ones((3, channels), bool) if free is None else np.array(free)
    free[2] = False
    return search(pictures, free=free)


def _search_without_lobe(pictures: Sequence[Picture], problem: Problem) -> Optimum:
    """A linear solve, and a second about its answer for the exact cost."""

    def once(reference: Float[np.ndarray, "C 3"]) -> tuple[Point, Sums]:
        parts = sums(pictures, np.zeros(0), reference)
        # The columns of the lobe are empty.
        gram, product = np.pad(parts.gram, [(0, 0), (0, 2), (0, 2)]), np.pad(parts.product, [(0, 0), (0, 2)])
        parts = Sums(gram, product, parts.square, parts.pixels)
        solved = jax.tree.map(np.asarray, solve_linear(parts, reference, problem))
        return Point(problem.lower, solved.x, solved.cost), parts.about(np.pad(reference, [(0, 0), (0, 1)]))

    first, _ = once(np.zeros(problem.free.shape))
    return _optimum(*once(first.x), problem, None, False, [])


def _search_at_one(pictures: Sequence[Picture], problem: Problem) -> Optimum:
    """The same with the exponent given."""
    x = np.zeros(problem.free.shape)
    parts = sums(pictures, problem.lower[None], x, peak=problem.peak)
    solved = jax.tree.map(np.asarray, solve_linear(parts, x, problem))
    settled = Polisher(pictures, problem, []).settle(Point(problem.lower, solved.x, solved.cost))
    return _optimum(*settled, problem, None, False, [])


def _search_with_lobe(
    pictures: Sequence[Picture], samples: Sequence[Thinned], problem: Problem, *, single: bool
) -> Optimum | None:
    """The search; nothing where it is done in single precision and that does not resolve the profile."""
    few = each(lambda sample: sample.picture, samples)
    rough = rough_model(few)
    count = max(2, 1 + math.ceil((problem.upper - problem.lower) / GRID_STEP))
    log_n = np.linspace(problem.lower, problem.upper, count)
    run = Polisher(pictures, problem, [])
    sampled = any(sample.factor is not None for sample in samples)
    if not sampled:
        profile = part = profile_on_grid(pictures, log_n, rough, problem)
        if single and not profile.resolved():
            return None
    else:
        # Most subsamples are float32.
        profile = profile_on_grid(few, log_n, rough, problem._replace(tolerance=np.asarray(_TOLERANCE_SINGLE)))
        # The subsample is in single precision whatever the pictures are.
        if not profile.resolved():
            return None
        profile = with_errors(profile, samples, problem)
        start = start_from_sample(profile, problem)
        if start is not None:
            point, inside = run.polish(start)
            if inside:
                return _optimum(*run.settle(point), problem, profile, True, run.tried)
        first, last = possible_cells(profile)
        # A few lengths, hence a few compilations.
        length = min(count, 8 * math.ceil((last - first + 4) / 8))
        first = min(max(0, first - 1), count - length)
        part = profile_on_grid(pictures, log_n[first : first + length], rough, problem)
    candidates = [run.settle(run.polish(start)[0]) for start in starts(part, problem)]
    # Where the profile is level the best sample may be no worse than what the brackets led to.
    best = int(np.argmin(part.cost))
    if part.cost[best] < min(np.sum(point.cost) for point, _ in candidates):
        x, cost = np.asarray(part.linear.x[best]), np.asarray(part.linear.cost[best])
        candidates.append(run.settle(Point(part.log_n[best], x, cost)))
    point, about = min(candidates, key=lambda candidate: float(np.sum(candidate[0].cost)))
    return _optimum(point, about, problem, profile, sampled, run.tried)


def _optimum(
    point: Point,
    about: Sums,
    problem: Problem,
    profile: Profile | None,
    sampled: bool,
    tried: list[tuple[float, float]],
) -> Optimum:
    """Gather the answer, with the lobe and its derivative by n in place of those relative to the lobe's peak."""
    # An exponent at its bound is the bound, not the exponential of its logarithm.
    known = dict(zip((float(problem.lower), float(problem.upper)), problem.bounds, strict=True))
    n = known.get(float(point.log_n), math.exp(point.log_n))
    decay = math.exp(n * float(problem.peak))
    columns = np.diag([1.0, 1.0, decay, decay / n])
    columns[3, 2] = decay * float(problem.peak)
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
        brackets=np.exp(np.array(tried).reshape(-1, 2)),
    )
