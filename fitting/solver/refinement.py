"""From a bracket around one minimum of the profile to the minimum itself, on all pixels."""

import itertools
import math
from collections.abc import Collection
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float

from fitting.solver import enumeration
from fitting.solver.normal_equations import AnyArray, Picture, Sums, sums

# As a function of log n a lobe varies on a scale of 1 or more; steps of the coarse grid, and the widest bracket.
GRID_STEP = 0.35

# Over a bracket this wide Hermite's cubic is within 4e-6 of the lobe; the corrections of the last passes do the rest.
_WIDEST_BRACKET = 0.2

_MOST_BRACKETS = 10
_MOST_CORRECTIONS = 8


class Problem(NamedTuple):
    """What stays the same during one search.

    Attributes:
        free: Which coefficients may be above 0.
        tolerance: What rounding may leave of a column that depends on the others, relative.
        accuracy: How far from the optimum log n may end.
        bounds: Smallest and largest exponent.
        lower: Natural logarithm of the smallest exponent.
        upper: That of the largest.
        peak: Logarithm of the largest cosine of any pixel. Coefficients x_s are relative to ``exp(n peak)``.
    """

    free: Bool[np.ndarray, "C 3"]
    tolerance: Float[np.ndarray, ""]
    accuracy: float
    bounds: tuple[float, float]
    lower: Float[np.ndarray, ""]
    upper: Float[np.ndarray, ""]
    peak: Float[np.ndarray, ""]


class Point(NamedTuple):
    """A candidate: coefficients as (C, 3)."""

    log_n: Float[np.ndarray, ""]
    x: Float[np.ndarray, "C 3"]
    cost: Float[np.ndarray, " C"]


class Start(NamedTuple):
    """Where to polish a minimum: a first bracket in log n, the range it may move in, and a model near by."""

    lower: float
    upper: float
    least: float
    most: float
    x: Float[np.ndarray, "C 3"]


@jax.jit
def solve_linear(parts: Sums, reference: Float[Array, "C 3"], problem: Problem) -> enumeration.Linear:
    """The best coefficients at the exponent of the sums, or at each of a grid."""
    return enumeration.solve(parts.gram, parts.product, parts.square, reference, problem.free, problem.tolerance)


def solve_within(
    parts: Sums,
    t: Float[Array, ""],
    width: Float[Array, ""],
    reference: Float[Array, "C 3"],
    free: Bool[AnyArray, "C 3"],
    tolerance: Float[AnyArray, ""],
) -> enumeration.Linear:
    """The best coefficients at one exponent within a bracket, the lobe there being Hermite's cubic of its ends.

    Args:
        parts: Sums of the bracket.
        t: Where in the bracket, from 0 to 1.
        width: Of the bracket, in log n.
        reference: The reference model of the sums, whose lobe is that of the lower end.
        free: Which coefficients may be above 0.
        tolerance: See :func:`fitting.solver.enumeration.solve`.

    Returns:
        Coefficients, cost and slope.
    """
    # Ambient, diffuse, lobe and derivative as combinations of the columns of a bracket.
    value = jnp.stack([jnp.ones_like(t), t * width, t * t * (3 - 2 * t), t * t * (t - 1) * width])
    slope = jnp.stack([jnp.zeros_like(t), jnp.ones_like(t), 6 * t * (1 - t) / width, t * (3 * t - 2)])
    basis = jnp.eye(4, 6).at[2:, 2:].set(jnp.stack([value, slope]))
    # The reference model gets the lobe of t, which changes its residual.
    change = reference[:, 2:] * (basis[2] - jnp.eye(6)[2])
    moved = jnp.sum(parts.gram * change[:, None, :], axis=2)
    product = jnp.sum(basis * (parts.product - moved)[:, None, :], axis=2)
    square = parts.square + jnp.sum(change * (moved - 2 * parts.product), axis=1)
    half = jnp.sum(basis[None, :, None, :] * parts.gram[:, None, :, :], axis=3)
    gram = jnp.sum(half[:, :, None, :] * basis[None, None, :, :], axis=3)
    return enumeration.solve(gram, product, square, reference, free, tolerance)


@jax.jit
def _solve_bracket(
    parts: Sums, ends: Float[Array, "2"], reference: Float[Array, "C 3"], problem: Problem
) -> tuple[Point, Float[Array, ""]]:
    """The least cost within a bracket, and where it lies, as a share of the bracket."""
    step = ends[1] - ends[0]

    def at(t: Float[Array, ""]) -> enumeration.Linear:
        return solve_within(parts, t, step, reference, problem.free, problem.tolerance)

    shares = jnp.linspace(0.0, 1.0, 9)
    linear = jax.vmap(at)(shares)
    best = jnp.argmin(jnp.sum(linear.cost, axis=1))
    low, high = jnp.maximum(best - 1, 0), jnp.minimum(best + 1, shares.size - 1)
    scale = jnp.max(jnp.abs(linear.slope)) + jnp.finfo(float).tiny
    # What a share of 1e-9 is off, the last correction makes good.

    def slope(t: Float[Array, ""], _: None) -> tuple[Float[Array, ""], tuple[Float[Array, ""], enumeration.Linear]]:
        here = at(t)
        return here.slope / scale, (t, here)

    share, at_root = optx.root_find(
        slope,
        optx.Bisection(rtol=0.0, atol=1e-9, flip=False),
        shares[best],
        options={"lower": shares[low], "upper": shares[high]},
        has_aux=True,
        max_steps=30,
        throw=False,
    ).aux
    crosses = (linear.slope[low] < 0) & (linear.slope[high] > 0)
    share, linear = jax.tree.map(
        lambda root, sample: jnp.where(crosses, root, sample[best]), (share, at_root), (shares, linear)
    )
    return Point(ends[0] + share * step, linear.x, linear.cost), share


def _correct(parts: Sums, point: Point, problem: Problem) -> tuple[Point, float]:
    """One joint Gauss-Newton step from the residual at a point; its active set is kept.

    Args:
        parts: Sums at the point, the reference being its own coefficients.
        point: The point.
        problem: Bounds.

    Returns:
        The new point, and about how far from the optimum in log n it still is.
    """
    active = point.x > 0
    x_s = point.x[:, 2]
    score = np.where(active, parts.product[:, :3], 0.0)
    cross = np.where(active, x_s[:, None] * parts.gram[:, :3, 3], 0.0)
    gram = np.where(active[:, :, None] & active[:, None, :], parts.gram[:, :3, :3], np.eye(3))
    here = Point(point.log_n, point.x, parts.square)
    try:
        solved = np.linalg.solve(gram, np.stack([score, cross], axis=-1))
    except np.linalg.LinAlgError:
        return here, 0.0
    gain, along = solved[..., 0], solved[..., 1]
    curvature = np.sum(x_s * x_s * parts.gram[:, 3, 3])
    left = curvature - np.sum(along * cross)
    move = 0.0
    if left > problem.tolerance * curvature:
        move = (np.sum(x_s * parts.product[:, 3]) - np.sum(along * score)) / left
    log_n = np.clip(point.log_n + move, problem.lower, problem.upper)
    move = log_n - point.log_n
    x = np.where(active, np.maximum(point.x + gain - move * along, 0.0), 0.0)
    step = np.concatenate([x - point.x, (move * x_s)[:, None]], axis=1)
    change = np.einsum("ci,cij,cj->c", step, parts.gram, step) - 2 * np.sum(step * parts.product, axis=1)
    if not np.sum(change) <= 0:
        return here, 0.0
    # A Gauss-Newton step shrinks the error by about the error itself plus the relative uncertainty of n (half of it was
    # seen at 1 and 3 % noise).
    uncertainty = (np.sum(parts.square) / (left * np.sum(parts.pixels))) ** 0.5 if move else 0.0
    return Point(log_n, x, np.maximum(parts.square + change, 0.0)), float(abs(move) * (abs(move) + 2 * uncertainty))


class Polisher(NamedTuple):
    """One search, the host's side of it.

    Attributes:
        pictures: The pictures or tiles; gone through once per pass.
        problem: Bounds.
        tried: The brackets polished so far.
    """

    pictures: Collection[Picture]
    problem: Problem
    tried: list[tuple[float, float]]

    def polish(self, start: Start) -> tuple[Point, bool]:
        """Follow one minimum until it lies inside a bracket narrow enough for the cubic, and say whether it does."""
        lower, upper, x = start.lower, start.upper, start.x
        for attempt in itertools.count(1):
            ends = np.array([lower, upper])
            self.tried.append((lower, upper))
            parts = sums(self.pictures, ends, x, peak=self.problem.peak)
            point, share = jax.tree.map(np.asarray, _solve_bracket(parts, ends, x, self.problem))
            centre, half, x = float(point.log_n), (upper - lower) / 2, point.x
            if (share <= 0 and lower > start.least) or (share >= 1 and upper < start.most):
                half = min(2 * half, GRID_STEP)
            elif 2 * half > _WIDEST_BRACKET:
                # What the cubic leaves of the error of a grid cell is far below this.
                half = _WIDEST_BRACKET / 8
            else:
                return point, True
            if attempt == _MOST_BRACKETS:
                return point, False
            lower, upper = max(start.least, centre - half), min(start.most, centre + half)
        raise AssertionError

    def settle(self, point: Point) -> tuple[Point, Sums]:
        """Residual passes with joint corrections until n stands still: exact cost, sums about the target.

        At each exponent the best coefficients are found anew, so that a coefficient may leave 0 or come to it. Where
        noise leaves n loosely determined a Gauss-Newton step may pass the minimum: a point that costs more than the
        last is brought back, to the minimum of the parabola through both. Nothing is returned on the word of the
        quadratic model unless its step was negligible.
        """
        held: tuple[Point, Sums] | None = None
        slope = 0.0
        for attempt in itertools.count(1):
            reference = point.x
            parts = sums(self.pictures, point.log_n[None], reference, peak=self.problem.peak)
            solved = jax.tree.map(np.asarray, solve_linear(parts, reference, self.problem))
            here, before = Point(point.log_n, solved.x, solved.cost), float(np.sum(parts.square))
            last = math.inf if held is None else float(np.sum(held[0].cost))
            rise = float(np.sum(here.cost)) - last
            if held is not None and rise > float(self.problem.tolerance) * last:
                share = np.clip(-slope / (2 * (rise - slope)), 0.1, 0.5)
                slope *= share
                point = jax.tree.map(lambda old, new, share=share: old + share * (new - old), held[0], here)
                left = math.inf
            else:
                told = parts.about(np.pad(reference, [(0, 0), (0, 1)]))
                held = here, told
                # The sums with the residual against the best coefficients at this exponent.
                parts = parts.about(np.pad(reference - here.x, [(0, 0), (0, 1)]))._replace(square=here.cost)
                point, left = _correct(parts, here, self.problem)
                slope = -2 * float((point.log_n - here.log_n) * np.sum(here.x[:, 2] * parts.product[:, 3]))
                if before > 2 * float(np.sum(here.cost)) + float(self.problem.tolerance) * float(np.sum(told.square)):
                    # A difference of far larger sums: known to fewer digits than about the coefficients themselves.
                    left = math.inf
            if left <= self.problem.accuracy or attempt == _MOST_CORRECTIONS:
                return (point if left <= self.problem.accuracy else held[0]), held[1]
        raise AssertionError
