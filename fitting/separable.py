"""The separable engine: the global optimum of ``sum w (target - x_a A - x_d D - x_s S(n))^2`` over n and x >= 0.

Variable projection (Golub and Pereyra 1973, SIAM J. Numer. Anal. 10, 413): for a given n the best x is a tiny exact problem, so
the search is one-dimensional, in log n. The host drives it and pixels are touched only by :mod:`fitting.sums`, whose results
add up; one picture in memory, a hundred photographs and the tiles of a file on disk are the same loop.

1. A stratified subsample of each picture (:mod:`fitting.thinning`), or all of a small one, gives the profile and its slope on a
   grid over log n. As a function of log n any lobe varies on a scale of 1 or more, so steps of 0.35 miss no minimum.
2. The subsample also says how far its profile may be from that of all pixels. If only one bracket can hold the optimum, at
   six standard deviations, the search goes on there; else the grid is repeated on all pixels.
3. A bracket is polished on all pixels with one pass at its two ends: values and slopes of the lobe there, Hermite's cubic
   in between, so every product needed at any n in the bracket follows from one Gram matrix.
4. Passes at the optimum in residual form give the exact cost and a joint Gauss-Newton correction of x and n, repeated
   while it moves n.

What optimistix does. Step 3 leaves a root of a scalar function, the slope of the profile, on an interval, at the price of a 6 x 6
matrix. ``optimistix.root_find`` with ``Bisection`` keeps the bracket whatever active sets do to the slope's derivative
and needs no derivative to be traced. ``Newton`` jumps across the kinks where an unknown leaves zero and takes three times as
long to trace, ``GoldenSearch`` on the cost itself stops at half the digits. Since no pixel is inside the solver it is compiled
once per number of channels, for every picture, lobe and precision.
"""

import math
from collections.abc import Collection, Iterable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float

from fitting import nonnegative
from fitting.sums import Lobe, OneLightLobe, Picture, Sums, sums
from fitting.thinning import Thinned, spread, thin

__all__ = ["Lobe", "OneLightLobe", "Optimum", "Picture", "fit_linear", "search"]

GRID_STEP = 0.35
SAMPLE_SIZE = 4096
SMALLEST_SAMPLE = 256

# Six standard deviations: one wrong rejection in 1e9, and the variance itself is an estimate.
DEVIATIONS = 6.0

# Hermite's cubic over a grid cell is within this share of the profile's range.
GRID_ERROR = 2e-3

# Hermite's cubic of the lobe over a bracket this wide is within 4e-6 and 3e-7 of it; the last correction squares what is left.
_WIDEST_SINGLE = 0.2
_WIDEST_DOUBLE = 0.1

_MOST_BRACKETS = 200
_MOST_CORRECTIONS = 8


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


class _Problem(eqx.Module):
    """What stays the same during one search."""

    free: Bool[Array, "C 3"]
    tolerance: Float[Array, ""]
    lower: Float[Array, ""]
    upper: Float[Array, ""]


class _Point(eqx.Module):
    """A candidate: coefficients as (C, 3)."""

    log_n: Float[np.ndarray, ""]
    x: Float[np.ndarray, "C 3"]
    cost: Float[np.ndarray, " C"]


@jax.jit
def _solve(parts: Sums, reference: Float[Array, "C 3"], problem: _Problem) -> nonnegative.Linear:
    """The best coefficients at the exponent of the sums, or at each of a grid."""
    return nonnegative.solve(parts.gram, parts.product, parts.square, reference, problem.free, problem.tolerance)


@jax.jit
def _solve_bracket(
    parts: Sums, ends: Float[Array, "2"], reference: Float[Array, "C 3"], problem: _Problem
) -> tuple[_Point, Float[Array, ""]]:
    """The least cost within a bracket, and where it lies, as a share of the bracket."""
    step = ends[1] - ends[0]

    def at(t: Float[Array, ""]) -> nonnegative.Linear:
        # Ambient, diffuse, lobe and derivative, by Hermite's cubic, as combinations of the columns of a bracket.
        value = jnp.stack([jnp.ones_like(t), t * step, t * t * (3 - 2 * t), t * t * (t - 1) * step])
        slope = jnp.stack([jnp.zeros_like(t), jnp.ones_like(t), 6 * t * (1 - t) / step, t * (3 * t - 2)])
        basis = jnp.eye(4, 6).at[2:, 2:].set(jnp.stack([value, slope]))
        # The reference model has the lobe of the lower end; here it gets that of t, which changes its residual.
        change = reference[:, 2:] * (basis[2] - jnp.eye(6)[2])
        moved = jnp.sum(parts.gram * change[:, None, :], axis=2)
        product = jnp.sum(basis * (parts.product - moved)[:, None, :], axis=2)
        square = parts.square + jnp.sum(change * (moved - 2 * parts.product), axis=1)
        half = jnp.sum(basis[None, :, None, :] * parts.gram[:, None, :, :], axis=3)
        gram = jnp.sum(half[:, :, None, :] * basis[None, None, :, :], axis=3)
        return nonnegative.solve(gram, product, square, reference, problem.free, problem.tolerance)

    shares = jnp.linspace(0.0, 1.0, 9)
    linear = jax.vmap(at)(shares)
    best = jnp.argmin(jnp.sum(linear.cost, axis=1))
    low, high = jnp.maximum(best - 1, 0), jnp.minimum(best + 1, shares.size - 1)
    scale = jnp.max(jnp.abs(linear.slope)) + jnp.finfo(float).tiny
    # What a share of 1e-9 is off, the last correction makes good.
    root = optx.root_find(
        lambda t, _: at(t).slope / scale,
        optx.Bisection(rtol=0.0, atol=1e-9, flip=False),
        shares[best],
        options={"lower": shares[low], "upper": shares[high]},
        max_steps=30,
        throw=False,
    ).value
    crosses = (linear.slope[low] < 0) & (linear.slope[high] > 0)
    share = jnp.where(crosses, root, shares[best])
    linear = at(share)
    return _Point(ends[0] + share * step, linear.x, linear.cost), share


def _correct(parts: Sums, point: _Point, problem: _Problem) -> tuple[_Point, float]:
    """One joint Gauss-Newton step from the residual at a point; its active set is kept."""
    active = point.x > 0
    x_s = point.x[:, 2]
    score = np.where(active, parts.product[:, :3], 0.0)
    cross = np.where(active, x_s[:, None] * parts.gram[:, :3, 3], 0.0)
    gram = np.where(active[:, :, None] & active[:, None, :], parts.gram[:, :3, :3], np.eye(3))
    solved = np.linalg.solve(gram, np.stack([score, cross], axis=-1))
    gain, along = solved[..., 0], solved[..., 1]
    curvature = x_s * x_s * parts.gram[:, 3, 3]
    up = np.sum(x_s * parts.product[:, 3]) - np.sum(along * score)
    left = np.sum(curvature) - np.sum(along * cross)
    move = up / left if left > problem.tolerance * np.sum(curvature) else 0.0
    log_n = np.clip(point.log_n + move, problem.lower, problem.upper)
    move = log_n - point.log_n
    x = np.where(active, np.maximum(point.x + gain - move * along, 0.0), 0.0)
    step = np.concatenate([x - point.x, (move * x_s)[:, None]], axis=1)
    change = np.einsum("ci,cij,cj->c", step, parts.gram, step) - 2 * np.sum(step * parts.product, axis=1)
    if np.sum(change) > 0:
        return _Point(point.log_n, point.x, parts.square), 0.0
    return _Point(log_n, x, np.maximum(parts.square + change, 0.0)), abs(float(move))


class _Search(eqx.Module):
    """One search, the host's side of it.

    Attributes:
        pictures: The pictures or tiles; gone through once per pass.
        problem: Bounds.
        single: Whether the pixels are float32.
    """

    pictures: Collection[Picture]
    problem: _Problem
    single: bool

    def bracket(self, centre: float, half: float, x: np.ndarray, tried: list[tuple[float, float]]) -> _Point:
        """Polish one minimum: brackets that follow it until it lies inside one narrow enough for the cubic."""
        lower, upper = float(self.problem.lower), float(self.problem.upper)
        widest = _WIDEST_SINGLE if self.single else _WIDEST_DOUBLE
        while True:
            ends = np.array([max(lower, centre - half), min(upper, centre + half)])
            tried.append((float(ends[0]), float(ends[1])))
            point, share = jax.tree.map(
                np.asarray, _solve_bracket(sums(self.pictures, ends, x), ends, x, self.problem)
            )
            centre, x = float(point.log_n), point.x
            outside = (share <= 0 and ends[0] > lower) or (share >= 1 and ends[1] < upper)
            if outside and len(tried) < _MOST_BRACKETS:
                half = min(2 * half, GRID_STEP)
            elif ends[1] - ends[0] > widest and not outside:
                # The cubic over the wide bracket left an error far below this.
                half = widest / 8
            else:
                return point

    def settle(self, point: _Point) -> tuple[_Point, Sums]:
        """Residual passes with joint corrections until n stands still: exact cost, sums about the target."""
        enough = 1e-4 if self.single else 1e-7
        for _ in range(_MOST_CORRECTIONS):
            x = point.x
            parts = sums(self.pictures, point.log_n[None], x)
            point, move = _correct(parts, point, self.problem)
            if move <= enough:
                break
        return point, parts.about(np.pad(x, [(0, 0), (0, 1)]))


def _solve_without_lobe(parts: Sums, reference: np.ndarray, problem: _Problem) -> tuple[nonnegative.Linear, Sums]:
    """Ambient and diffuse alone; the columns that are missing are empty."""
    wide = Sums(
        np.pad(parts.gram, [(0, 0), (0, 2), (0, 2)]), np.pad(parts.product, [(0, 0), (0, 2)]), parts.square, parts.pixels
    )
    return jax.tree.map(np.asarray, _solve(wide, reference, problem)), wide


class _Profile(eqx.Module):
    """The profile's samples: of a subsample of the pixels or of all of them.

    Attributes:
        log_n: Grid.
        linear: Best coefficients, cost and slope at each.
        error: Standard deviation of the cost relative to the best sample; 0 where all pixels were used.
        slope_error: That of the slope.
    """

    log_n: Float[np.ndarray, " G"]
    linear: nonnegative.Linear
    error: Float[np.ndarray, " G"]
    slope_error: Float[np.ndarray, " G"]

    @property
    def cost(self) -> Float[np.ndarray, " G"]:
        """Cost summed over channels."""
        return np.sum(self.linear.cost, axis=1)

    def fine(self) -> tuple[Float[np.ndarray, "G 8"], Float[np.ndarray, "G 8"]]:
        """Positions and values of the piecewise cubic through samples and slopes, nine per cell, ends included."""
        t = np.linspace(0.0, 1.0, 9)
        cost, slope = self.cost[:, None], np.asarray(self.linear.slope)[:, None]
        step = (self.log_n[1:] - self.log_n[:-1])[:, None]
        values = cost[:-1] + t * t * (3 - 2 * t) * (cost[1:] - cost[:-1])
        values = values + step * t * (1 - t) * ((1 - t) * slope[:-1] - t * slope[1:])
        return self.log_n[:-1, None] + t * step, values


def _rough_model(pictures: Iterable[Picture]) -> Float[np.ndarray, "C 3"]:
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
        columns = np.stack([np.broadcast_to(picture.ambient, target.shape), np.broadcast_to(diffuse, target.shape)])
        gram = gram + np.einsum("ipc,pc,jpc->cij", columns, weight, columns)
        product = product + np.einsum("ipc,pc->ci", columns, weight * target)
    x = np.einsum("cij,cj->ci", np.linalg.pinv(gram, hermitian=True), product)
    return np.pad(x, [(0, 0), (0, 1)])


def _profile(pictures: Collection[Picture], log_n: np.ndarray, rough: np.ndarray, problem: _Problem) -> _Profile:
    """The profile on a grid."""
    linear = jax.tree.map(np.asarray, _solve(sums(pictures, log_n, rough, grid=True), rough, problem))
    return _Profile(log_n, linear, np.zeros(log_n.size), np.zeros(log_n.size))


def _starts(profile: _Profile, sampled: bool) -> list[tuple[float, float]] | None:
    """Where to polish: centres and half-widths in log n, or None where the subsample cannot tell."""
    position, value = profile.fine()
    margin = GRID_ERROR * (np.max(profile.cost) - np.min(profile.cost))
    cell = np.min(value, axis=1)
    best = int(np.argmin(cell))
    if sampled:
        error = np.maximum(profile.error[:-1], profile.error[1:])
        possible = np.flatnonzero(cell - cell[best] <= DEVIATIONS * error + margin)
        if possible[0] < best - 1 or possible[-1] > best + 1:
            return None
        t = int(np.argmin(value[best]))
        slope = np.asarray(profile.linear.slope)
        curvature = (slope[best + 1] - slope[best]) / (profile.log_n[best + 1] - profile.log_n[best])
        if curvature <= 0:
            return None
        half = DEVIATIONS * max(profile.slope_error[best : best + 2]) / curvature
        return [(float(position[best, t]), min(half + 0.04, GRID_STEP))]
    flat_position, flat_value = position.ravel(), value.ravel()
    before = np.concatenate([[np.inf], flat_value[:-1]])
    after = np.concatenate([flat_value[1:], [np.inf]])
    # Cells share their ends, so a minimum there shows twice with equal values.
    lowest = np.flatnonzero((flat_value <= before) & (flat_value <= after) & (flat_value <= cell[best] + margin))
    found: list[tuple[float, float]] = []
    for i in lowest[np.argsort(flat_value[lowest], kind="stable")]:
        if all(abs(flat_position[i] - centre) > GRID_STEP / 4 for centre, _ in found):
            found.append((float(flat_position[i]), GRID_STEP / 2))
    return found


def search(
    pictures: Collection[Picture],
    *,
    n_min: float = 0.1,
    n_max: float = 1e6,
    free: Bool[np.ndarray, "3 C"] | None = None,
) -> Optimum:
    """Find the global optimum over the exponent and the non-negative coefficients.

    Args:
        pictures: Pictures of one material, all of one dtype and number of channels, or the tiles of a picture. They are
            gone through once per pass over the pixels (three or four times), so an object that loads each when asked
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
        # What rounding leaves of a column that depends on the others: a few units in the last place of the pixels.
        tolerance = np.float64(2e-7 if single else 1e-14)
        problem = _Problem(free.T, tolerance, np.float64(math.log(n_min)), np.float64(math.log(n_max)))
        if first.lobe is None or not free[2].any():
            return _search_without_lobe(pictures, n_min, problem)
        return _search_with_lobe(pictures, problem, single)


def _search_without_lobe(pictures: Collection[Picture], n: float, problem: _Problem) -> Optimum:
    """A linear solve, and a second about its answer for the exact cost."""
    x = np.zeros(problem.free.shape)
    for _ in range(2):
        reference = x
        solved, parts = _solve_without_lobe(sums(pictures, np.zeros(0), reference), reference, problem)
        x = solved.x
    about = parts.about(np.pad(reference, [(0, 0), (0, 1)]))
    return _optimum(_Point(np.asarray(math.log(n)), x, solved.cost), about, None, False, [])


def _search_with_lobe(pictures: Collection[Picture], problem: _Problem, single: bool) -> Optimum:
    size = max(SMALLEST_SAMPLE, SAMPLE_SIZE // len(pictures))
    samples = [thin(picture, size) for picture in pictures]
    few = [sample.picture for sample in samples]
    rough = _rough_model(few)
    log_n = np.linspace(problem.lower, problem.upper, max(2, 1 + math.ceil((problem.upper - problem.lower) / GRID_STEP)))
    profile = _profile(few, log_n, rough, problem)
    sampled = any(sample.factor is not None for sample in samples)
    if sampled:
        profile = _with_errors(profile, samples)
    starts = _starts(profile, sampled)
    if starts is None:
        profile, sampled = _profile(pictures, log_n, rough, problem), False
        starts = _starts(profile, sampled)
    assert starts
    run = _Search(pictures, problem, single)
    tried: list[tuple[float, float]] = []
    candidates = []
    for centre, half in starts:
        x = profile.linear.x[np.argmin(np.abs(log_n - centre))]
        candidates.append(run.settle(run.bracket(centre, half, x, tried)))
    point, about = min(candidates, key=lambda candidate: float(np.sum(candidate[0].cost)))
    return _optimum(point, about, profile, sampled, tried)


def _with_errors(profile: _Profile, samples: list[Thinned]) -> _Profile:
    """How far the subsample's profile may be from that of all pixels."""
    best = np.argmin(profile.cost)
    variance, slope_variance = np.zeros(profile.log_n.size), np.zeros(profile.log_n.size)
    for sample in samples:
        if sample.factor is not None:
            part, slope_part = spread(sample, profile.log_n, profile.linear.x, best)
            variance, slope_variance = variance + np.asarray(part), slope_variance + np.asarray(slope_part)
    return _Profile(profile.log_n, profile.linear, variance**0.5, slope_variance**0.5)


def fit_linear(pictures: Collection[Picture], *, free: Bool[np.ndarray, "3 C"] | None = None) -> Optimum:
    """Ambient and diffuse only: one linear solve, a second in residual form for the exact cost.

    Args:
        pictures: As for :func:`search`; their lobes are not looked at.
        free: Which of x_a, x_d may be above 0.
    """
    channels = next(iter(pictures)).target.shape[1]
    free = np.ones((3, channels), bool) if free is None else np.array(free)
    free[2] = False
    return search(pictures, free=free)


def _optimum(
    point: _Point, about: Sums, profile: _Profile | None, sampled: bool, tried: list[tuple[float, float]]
) -> Optimum:
    """Gather the answer."""
    n = math.exp(point.log_n)
    by_n = np.array([1.0, 1.0, 1.0, 1.0 / n])
    return Optimum(
        n=n,
        x=point.x.T,
        cost=point.cost,
        pixels=about.pixels,
        gram=about.gram * by_n[:, None] * by_n,
        product=about.product * by_n,
        square=about.square,
        flat=not np.any(point.x[:, 2] > 0),
        grid=np.zeros(0) if profile is None else np.exp(profile.log_n),
        profile=np.zeros(0) if profile is None else profile.cost,
        profile_sampled=sampled,
        brackets=np.exp(np.array(tried).reshape(-1, 2)),
    )
