"""The profile, which is the least cost over the coefficients as a function of log n, and where its minimum may lie."""

from collections.abc import Collection, Iterable, Sequence
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from fitting.engine.nonnegative import Linear
from fitting.engine.pictures import Picture
from fitting.engine.polishing import GRID_STEP, Problem, Start, solve_linear
from fitting.engine.sums import sums
from fitting.engine.thinning import Thinned, spread

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
        rounding: What single precision may put into the cost.
        pixels: How many there are.
    """

    log_n: Float[np.ndarray, " G"]
    linear: Linear
    error: Float[np.ndarray, " G"]
    slope_error: Float[np.ndarray, " G"]
    rounding: Float[np.ndarray, " G"]
    pixels: float

    def resolved(self) -> bool:
        """Whether rounding leaves the valley, or what noise leaves of it.

        Where basis images nearly add up to one another, large coefficients cancel, and with them the digits of the
        products: then several samples may seem to fit exactly. In scenes where they do not, rounding is 1e-5 to 2e-4 of
        the rise to the next sample (`python -m benchmarks.tradeoff`, its twenty scenes).
        """
        best = int(np.argmin(self.cost))
        beside = [i for i in (best - 1, best + 1) if 0 <= i < self.cost.size]
        rise = float(np.min(self.cost[beside])) - self.cost[best]
        noise = self.cost[best] / max(self.pixels, 1.0)
        return self.rounding[best] <= max(UNRESOLVED * rise, UNRESOLVED * noise)

    @property
    def cost(self) -> Float[np.ndarray, " G"]:
        """Cost summed over channels."""
        return np.array(self.linear.cost, np.float64).sum(axis=1)

    def margin(self) -> Float[np.ndarray, " G-1"]:
        """How far the cubic may be from the profile, cell by cell."""
        slope = np.abs(self.linear.slope)
        return GRID_ERROR * np.diff(self.log_n) * np.maximum(slope[:-1], slope[1:])

    def nearest(self, log_n: float) -> Float[np.ndarray, "C 3"]:
        """The best coefficients at the nearest sample."""
        return np.asarray(self.linear.x)[np.argmin(np.abs(self.log_n - log_n))]

    def fine(self) -> tuple[Float[np.ndarray, "G 33"], Float[np.ndarray, "G 33"]]:
        """Positions and values of the piecewise cubic through samples and slopes, 33 per cell, ends included."""
        t = np.linspace(0.0, 1.0, 33)
        cost, slope = self.cost[:, None], np.asarray(self.linear.slope)[:, None]
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


def profile_on_grid(pictures: Collection[Picture], log_n: np.ndarray, rough: np.ndarray, problem: Problem) -> Profile:
    """The profile on a grid."""
    parts = sums(pictures, log_n, rough, grid=True, peak=problem.peak)
    linear = jax.tree.map(np.asarray, solve_linear(parts, rough, problem))
    # What each term of the cost is rounded by, relative to the reference.
    size = np.abs(linear.x - rough) * np.sqrt(np.diagonal(parts.gram, axis1=-2, axis2=-1)[..., :3])
    rounding = np.finfo(np.float32).eps * np.sum(np.sum(size, axis=-1) ** 2, axis=-1)
    return Profile(log_n, linear, np.zeros(log_n.size), np.zeros(log_n.size), rounding, float(np.max(parts.pixels)))


def with_errors(profile: Profile, samples: Sequence[Thinned], problem: Problem) -> Profile:
    """How far the subsample's profile may be from that of all pixels."""
    best = np.argmin(profile.cost)
    log_n, x = profile.log_n, profile.linear.x
    # It varies slowly; every other sample will do.
    few = np.append(np.arange(0, log_n.size - 1, 2), log_n.size - 1)
    variance = np.zeros((2, few.size))
    for sample in samples:
        if sample.factor is not None:
            variance = variance + np.stack(spread(sample, log_n[few], x[few], log_n[best], x[best], problem.peak))
    error, slope_error = (np.interp(log_n, log_n[few], each) for each in variance**0.5)
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
    least, most = float(problem.lower), float(problem.upper)
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
    depth = 1e-9 * low + 2 * float(problem.tolerance) * (low + np.max(profile.cost))
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
