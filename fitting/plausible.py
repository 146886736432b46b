"""The best plausible material: a normalised form with k >= 0 and k_d + k_s <= 1, held inside the separable solve.

For a given n the problem stays tiny and exact: a convex quadratic of three unknowns per channel under four linear
bounds, whose active sets can be enumerated (Nocedal and Wright 2006, Numerical Optimization, section 16.5). So the
search stays one-dimensional in log n. Its bound moves with n, since k_s is x_s over the lobe's scale(n); clipping the
unbounded optimum afterwards would miss the best n.
"""

import itertools
import math
from collections.abc import Collection
from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Bool, Float

import brdf
from fitting.light_colour import coefficient_factors
from fitting.solver.normal_equations import Picture, Sums, sums
from fitting.solver.profile import Optimum
from fitting.solver.subsample import subsample

GRID_STEP = 0.35
# The grid looks at so many pixels of each picture, the polishing at all.
SAMPLE_SIZE = 1 << 16
# Valleys of the grid that are polished, and how far apart in log n golden section ends; the cost is flat to its square.
VALLEYS = 3
CLOSE = 1e-5
GOLDEN = (math.sqrt(5.0) - 1.0) / 2.0
# k_d + k_s may be so far above 1 by rounding; `brdf.check` allows 1e-6.
ROUNDING = 1e-12


class _Bound(NamedTuple):
    """What is allowed.

    Attributes:
        model: class of the material.
        colour: what was taken out of the lights, (C,).
        free: which coefficients may be above 0, (3, C).
    """

    model: type[brdf.Material]
    colour: Float[np.ndarray, " C"]
    free: Bool[np.ndarray, "3 C"]

    def weights(self, n: float) -> Float[np.ndarray, "C 3"]:
        """What x_a, x_d, x_s count in k_d + k_s <= 1."""
        weights = 1.0 / coefficient_factors(self.model, n, self.colour)
        weights[0] = 0.0
        return weights.T


def is_plausible(optimum: Optimum, model: type[brdf.Material], colour: Float[np.ndarray, " C"]) -> bool:
    """Whether k_d + k_s <= 1 in every channel.

    Args:
        optimum: of the engine.
        model: class of the material.
        colour: what was taken out of the lights, (C,).
    """
    k = optimum.x / coefficient_factors(model, optimum.n, colour)
    return bool(np.all(k[1] + k[2] <= 1.0 + ROUNDING))


def fit_plausible(
    pictures: Collection[Picture],
    optimum: Optimum,
    free: Bool[np.ndarray, "3 C"],
    model: type[brdf.Material],
    colour: Float[np.ndarray, " C"],
    n_range: tuple[float, float],
) -> Optimum:
    """The optimum under k_d + k_s <= 1; the unbounded one where that keeps the bound by itself.

    Args:
        pictures: of one material.
        optimum: without the bound.
        free: which coefficients may be above 0, (3, C).
        model: Lambert or one of the normalised forms.
        colour: what was taken out of the lights, (C,).
        n_range: bounds of the exponent.
    """
    if is_plausible(optimum, model, colour):
        return optimum
    with jax.enable_x64(True):
        return _search(pictures, optimum, _Bound(model, colour, free), n_range)


def _search(pictures: Collection[Picture], optimum: Optimum, bound: _Bound, n_range: tuple[float, float]) -> Optimum:
    """The bounded optimum, global over log n."""
    if not bound.free[2].any():
        return _at(pictures, optimum, None, bound)
    low, high = math.log(n_range[0]), math.log(n_range[1])
    grid = np.linspace(low, high, max(2, 1 + math.ceil((high - low) / GRID_STEP)))
    sample = [subsample(picture, SAMPLE_SIZE, n_range[1]).picture for picture in pictures]
    reference = np.zeros((optimum.x.shape[1], 3))
    parts = sums(sample, grid, reference, grid=True)
    rough = np.array(
        [_solve(_one_of(parts, index), reference, bound, math.exp(log_n))[1].sum() for index, log_n in enumerate(grid)]
    )
    before, after = np.append(np.inf, rough[:-1]), np.append(rough[1:], np.inf)
    valleys = np.flatnonzero((rough <= before) & (rough <= after))
    best = sorted(valleys, key=lambda index: rough[index])[:VALLEYS]
    ends = [
        _golden(pictures, bound, reference, grid[max(index - 1, 0)], grid[min(index + 1, grid.size - 1)])
        for index in best
    ]
    log_n = min(ends)[1]
    return _at(pictures, optimum, log_n, bound)


def _cost(pictures: Collection[Picture], bound: _Bound, reference: np.ndarray, log_n: float) -> float:
    parts = sums(pictures, np.array([log_n]), reference)
    return float(np.sum(_solve(parts, reference, bound, math.exp(log_n))[1]))


def _golden(
    pictures: Collection[Picture], bound: _Bound, reference: np.ndarray, low: float, high: float
) -> tuple[float, float]:
    """Least cost and its log n between two others (Kiefer 1953); an end of the range counts as well."""

    def at(log_n: float) -> tuple[float, float]:
        return _cost(pictures, bound, reference, log_n), log_n

    inner, outer = at(high - GOLDEN * (high - low)), at(low + GOLDEN * (high - low))
    ends = [at(low), at(high)]
    while high - low > CLOSE:
        if inner[0] <= outer[0]:
            high, outer = outer[1], inner
            inner = at(high - GOLDEN * (high - low))
        else:
            low, inner = inner[1], outer
            outer = at(low + GOLDEN * (high - low))
    return min(inner, outer, *ends)


def _at(pictures: Collection[Picture], optimum: Optimum, log_n: float | None, bound: _Bound) -> Optimum:
    """The bounded optimum at an exponent: two passes, the second in residual form for the exact cost."""
    n = optimum.n if log_n is None else math.exp(log_n)
    exponents = np.zeros(0) if log_n is None else np.array([log_n])
    nothing = np.zeros((optimum.x.shape[1], 3))
    reference, _ = _solve(sums(pictures, exponents, nothing), nothing, bound, n)
    parts = sums(pictures, exponents, reference)
    x, cost = _solve(parts, reference, bound, n)
    columns = parts.gram.shape[-1]
    about = parts.about(np.pad(reference, [(0, 0), (0, columns - 3)]) if columns > 3 else reference[:, :columns])
    missing = 4 - columns
    # The engine's last column is the derivative by log n, that of an optimum the derivative by n.
    scale = np.array([1.0, 1.0, 1.0, 1.0 / n])
    gram = np.pad(about.gram, [(0, 0), (0, missing), (0, missing)]) * np.outer(scale, scale)
    product = np.pad(about.product, [(0, 0), (0, missing)]) * scale
    return eqx.tree_at(
        lambda o: (o.n, o.x, o.cost, o.gram, o.product, o.square, o.flat),
        optimum,
        (n, x.T, cost, gram, product, about.square, not np.any(x[:, 2] > 0)),
    )


def _one_of(parts: Sums, index: int) -> Sums:
    return Sums(*(leaf[index] for leaf in parts))


def _solve(
    parts: Sums, reference: Float[np.ndarray, "C 3"], bound: _Bound, n: float
) -> tuple[Float[np.ndarray, "C 3"], Float[np.ndarray, " C"]]:
    """The best coefficients at one exponent, and their cost, channel by channel."""
    columns = min(parts.gram.shape[-1], 3)
    weights, free = bound.weights(n)[:, :columns], bound.free.T[:, :columns]
    best_x, best_cost = np.zeros(reference.shape), np.zeros(reference.shape[0])
    for channel in range(reference.shape[0]):
        gram = parts.gram[channel, :columns, :columns]
        product, start = parts.product[channel, :columns], reference[channel, :columns]
        right = gram @ start + product
        sets = [np.array(active) & free[channel] for active in itertools.product([False, True], repeat=columns)]
        points = [
            _stationary(gram, right, active, capped, weights[channel]) for active in sets for capped in (False, True)
        ]
        found = [x for x in points if x is not None]
        changes = [(x - start) @ gram @ (x - start) - 2 * (x - start) @ product for x in found]
        chosen = int(np.argmin(changes))
        best_x[channel, :columns] = found[chosen]
        best_cost[channel] = max(parts.square[channel] + changes[chosen], 0.0)
    return best_x, best_cost


def _stationary(
    gram: np.ndarray, right: np.ndarray, active: np.ndarray, capped: bool, weights: np.ndarray
) -> np.ndarray | None:
    """The stationary point of an active set, or None where it leaves the bounds."""
    x = np.zeros(gram.shape[0])
    count = int(np.count_nonzero(active))
    if capped and not weights[active].any():
        return None
    if count:
        system = np.zeros((count + 1, count + 1)) if capped else np.zeros((count, count))
        system[:count, :count] = gram[np.ix_(active, active)]
        wanted = right[active]
        if capped:
            # Weights brought to the size of the Gram, so that neither drowns in the other's rounding.
            size = max(float(np.max(np.abs(system))), np.finfo(float).tiny) / float(np.max(weights[active]))
            system[count, :count] = system[:count, count] = weights[active] * size
            wanted = np.append(wanted, size)
        x[active] = np.linalg.lstsq(system, wanted, rcond=1e-14)[0][:count]
    tall = 1.0 + ROUNDING
    return x if np.all(x >= 0) and weights @ x <= tall else None
