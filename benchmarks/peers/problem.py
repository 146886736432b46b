"""The problem that every peer gets, the start it is given, the optimum it should find, and the clock.

The arrays are those of `benchmarks.engine`: N·L, log(N·H) and a noisy target of three channels. The ten unknowns are
k_a, k_d and k_s of each channel and log n, which suits local solvers better than n: the exponent stays above 0, and the
cost is closer to a parabola.
"""

import math
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from benchmarks import engine

NOISE = 0.01
N_START = 10.0
ACCURACY = 1e-3  # worst relative error of the ten, of n instead of log n


class Problem(NamedTuple):
    """What a peer works on.

    Attributes:
        size: edge of the picture in pixels.
        n_dot_l: diffuse basis image.
        log_cos: logarithm of the lobe's cosine.
        target: linear values.
        start: n = 10 with the best k of that exponent; no peer is charged for it.
        optimum: of the sum of squares, in float64.
    """

    size: int
    n_dot_l: Float[np.ndarray, " P"]
    log_cos: Float[np.ndarray, " P"]
    target: Float[np.ndarray, "P 3"]
    start: Float[np.ndarray, " 10"]
    optimum: Float[np.ndarray, " 10"]

    def columns(self, log_n: float) -> Float[np.ndarray, "3 P"]:
        """Basis images."""
        return columns(self.n_dot_l, self.log_cos, log_n)

    def residual(self, x: Float[np.ndarray, " 10"]) -> Float[np.ndarray, " 3P"]:
        """Channel after channel."""
        return (x[:9].reshape(3, 3).T @ self.columns(x[9]) - self.target.T).ravel()

    def jacobian(self, x: Float[np.ndarray, " 10"]) -> Float[np.ndarray, "3P 10"]:
        """Derivatives of the residual."""
        basis = self.columns(x[9])
        slope = math.exp(x[9]) * self.log_cos * basis[2]
        # Column after column in memory, as LAPACK wants it.
        found = np.zeros((10, 3, slope.size))
        for channel in range(3):
            found[channel:9:3, channel] = basis
            found[9, channel] = x[6 + channel] * slope
        return found.reshape(10, -1).T

    def error(self, x: Float[np.ndarray, " 10"]) -> float:
        """Worst relative error."""
        if not np.all(np.isfinite(x)) or x[9] > 100:
            return math.inf  # a wild trial
        return max(float(np.max(np.abs(x[:9] / self.optimum[:9] - 1))), abs(math.expm1(x[9] - self.optimum[9])))


def columns(n_dot_l: np.ndarray, log_cos: np.ndarray, log_n: float) -> Float[np.ndarray, "3 P"]:
    """Ambient, diffuse and lobe."""
    return np.stack([np.ones_like(n_dot_l), n_dot_l, np.exp(math.exp(log_n) * log_cos)])


def make(size: int) -> Problem:
    """The problem at one size."""
    n_dot_l, log_cos, target = engine.observe(size, NOISE)
    basis = columns(n_dot_l, log_cos, math.log(N_START))
    k = np.linalg.solve(basis @ basis.T, basis @ target)
    # Peers with bounds start inside them.
    start = np.append(np.maximum(k, 1e-3).ravel(), math.log(N_START))
    return Problem(size, n_dot_l, log_cos, target, start, _optimum(n_dot_l, log_cos, target))


def _optimum(n_dot_l: np.ndarray, log_cos: np.ndarray, target: np.ndarray) -> Float[np.ndarray, " 10"]:
    """Gauss-Newton from the numbers that the picture was drawn with, until the steps are rounding."""
    x = np.append(engine.X.ravel(), math.log(engine.N))
    for _ in range(20):
        basis = columns(n_dot_l, log_cos, x[9])
        basis = np.concatenate([basis, math.exp(x[9]) * log_cos * basis[2:]])
        gram, product = basis @ basis.T, basis @ (target - basis[:3].T @ x[:9].reshape(3, 3))
        normal, right = np.zeros((10, 10)), np.zeros(10)
        for channel in range(3):
            # The unknowns of this channel, and the one that all share.
            own = [channel, 3 + channel, 6 + channel, 9]
            scale = np.array([1.0, 1.0, 1.0, x[6 + channel]])
            normal[np.ix_(own, own)] += gram * np.outer(scale, scale)
            right[own] += product[:, channel] * scale
        step = np.linalg.solve(normal, right)
        x = x + step
        if np.max(np.abs(step / x)) < 1e-12:
            return x
    raise RuntimeError(f"Gauss-Newton did not settle, last step {step}")


class Trace:
    """Notes the unknowns of each evaluation and the time."""

    def __init__(self) -> None:
        """Start the clock."""
        self.noted: list[tuple[float, np.ndarray]] = []
        self.since = time.perf_counter()

    def __call__(self, x: Any) -> None:
        """Note one evaluation."""
        self.noted.append((self.elapsed(), np.array(x, np.float64)))

    def elapsed(self) -> float:
        """Seconds since the start."""
        return time.perf_counter() - self.since

    def reached(self, problem: Problem) -> float | None:
        """Seconds until the first evaluation within the accuracy; a kind measure, since it may have been a trial."""
        return next((seconds for seconds, x in self.noted if problem.error(x) <= ACCURACY), None)


class Answer(NamedTuple):
    """Where a peer stopped.

    Attributes:
        x: the unknowns.
        says: its own word on why.
    """

    x: Any
    says: str


Run = Callable[[Trace], Answer]
