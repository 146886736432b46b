"""How sure a fit is: covariance from the Gauss-Newton Hessian, intervals, and what the picture leaves open."""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from fitting.solver.profile import Optimum
from fitting.uncertainty.intervals import NORMAL_95, above_zero

# A squared column keeps less than this of itself when the others are taken out: the two tell the same story.
# Float32 sums leave some 1e-7 of a column that depends on the others.
DEPENDENT_SINGLE, DEPENDENT_DOUBLE = 1e-6, 1e-10
# A term that moves no pixel by more than this share of the brightest one leaves no trace.
NO_TRACE = 1e-6
# A specular term counts when leaving it out raises the cost by so many noise variances for each of its unknowns.
SIGNIFICANT = 10.0

TERMS = ("k_a", "k_d", "k_s")


class Uncertainty(NamedTuple):
    """Errors, and what is not determined.

    Attributes:
        noise: standard deviation of the residual, (C,), never below what rounding alone gives.
        x_error: of the engine's coefficients x_a, x_d, x_s, (3, C); for one at its bound, that which it would have if
            the bound were not there. Infinite where the picture does not determine it.
        x_interval: 95 % interval of each, lower and upper end, (3, C, 2).
        n_error: of n; infinite where the picture does not determine it.
        correlation: of x_a, x_d, x_s (channel after channel each) and n, (3C + 1, 3C + 1); 0 for what is at its bound
            or not determined.
        rise: by how much the cost, summed over channels, rises at the ends of a 95 % interval of n.
        undetermined: why, by parameter: "n", "k_s", or "k_d[2]" for one channel.
    """

    noise: Float[np.ndarray, " C"]
    x_error: Float[np.ndarray, "3 C"]
    x_interval: Float[np.ndarray, "3 C 2"]
    n_error: float
    correlation: Float[np.ndarray, "P P"]
    rise: float
    undetermined: dict[str, str]


def residual_noise(optimum: Optimum, rounding: Float[np.ndarray, " C"]) -> Float[np.ndarray, " C"]:
    """Standard deviation of the residual, never below that of rounding.

    Args:
        optimum: of the engine.
        rounding: standard deviation of a value's rounding, (C,).
    """
    degrees = np.maximum(optimum.pixels - np.count_nonzero(optimum.x > 0, axis=0), 1)
    return np.sqrt(np.maximum(optimum.cost / degrees, np.maximum(rounding**2, np.finfo(float).tiny)))


def uncertainty(
    optimum: Optimum,
    free: Bool[np.ndarray, "3 C"],
    noise: Float[np.ndarray, " C"],
    brightest: Float[np.ndarray, " C"],
    *,
    specular: bool,
    visible: float,
    single: bool,
    tied: Float[np.ndarray, " C"] | None = None,
    spread: Float[np.ndarray, "C 4 4"] | None = None,
) -> Uncertainty:
    """Errors of an optimum.

    The covariance is H⁻¹ (Σ_c σ_c² J_cᵀJ_c) H⁻¹ with the noise σ_c of each channel: channels share n but not their
    noise. Coefficients at their bound are held there: given that, the others are estimated as if it were known, and
    their intervals cover as they should (the score of the bound coefficient is uncorrelated with them).

    Args:
        optimum: of the engine.
        free: which coefficients the light reaches, (3, C).
        noise: standard deviation of the residual, (C,).
        brightest: largest value of the picture, (C,).
        specular: whether the model has a lobe.
        visible: largest value of the specular term in the picture, over that of the picture.
        single: whether the pixels were float32.
        tied: x_s is a common factor times this, (C,); None where the channels are independent.
        spread: sums of the columns' products times the variance of each pixel, where it is not the same in all.
    """
    channels = optimum.x.shape[1]
    dependent = DEPENDENT_SINGLE if single else DEPENDENT_DOUBLE
    undetermined: dict[str, str] = {}
    if specular:
        reason = _without_trace(optimum, noise, visible)
        if reason:
            undetermined["n"] = undetermined["k_s"] = reason
    known = free.copy()
    known[2] &= specular and "k_s" not in undetermined
    _name_unlit(free, specular, undetermined)
    _name_dependent(optimum, known, undetermined, dependent)
    system = _System(optimum, known, noise, tied, spread, dependent)
    x_error, x_interval, n_error = system.errors()
    for term, channel in np.argwhere(known):
        largest = max(optimum.square[channel], brightest[channel] ** 2)
        if x_error[term, channel] ** 2 * optimum.gram[channel, term, term] > largest:
            name = f"{TERMS[term]}[{channel}]"
            undetermined.setdefault(name, "its error is larger than the whole picture")
            x_error[term, channel] = np.inf
    if specular and "n" not in undetermined and not np.isfinite(n_error):
        undetermined["n"] = "the highlight fits as well with other exponents and another k_s"
    if "n" in undetermined:
        n_error = np.inf
    if channels == 1:
        undetermined = {name.removesuffix("[0]"): reason for name, reason in undetermined.items()}
    return Uncertainty(noise, x_error, x_interval, n_error, system.correlation(), system.rise, undetermined)


def _without_trace(optimum: Optimum, noise: np.ndarray, visible: float) -> str:
    """Why there is no specular term to speak of; empty where there is one."""
    if optimum.flat:
        return "the picture has no highlight"
    if visible < NO_TRACE:
        return f"the highlight is below {NO_TRACE:g} of the picture"
    gain = 0.0
    for channel in range(optimum.x.shape[1]):
        gram = optimum.gram[channel, :3, :3]
        others = [term for term in (0, 1) if optimum.x[term, channel] > 0]
        left = gram[2, 2]
        if others:
            cross = gram[np.ix_(others, [2])][:, 0]
            left -= cross @ np.linalg.lstsq(gram[np.ix_(others, others)], cross, rcond=DEPENDENT_DOUBLE)[0]
        gain += optimum.x[2, channel] ** 2 * max(left, 0.0) / noise[channel] ** 2
    unknowns = 1 + np.count_nonzero(optimum.x[2] > 0)
    return "" if gain > SIGNIFICANT * unknowns else "the highlight does not stand out of the noise"


def _name_unlit(free: np.ndarray, specular: bool, undetermined: dict[str, str]) -> None:
    words = ("no ambient light", "no light", "no light")
    for term in range(3 if specular else 2):
        if TERMS[term] in undetermined:
            continue
        if not free[term].any():
            undetermined[TERMS[term]] = f"{words[term]} in the scene"
            continue
        for channel in np.flatnonzero(~free[term]):
            undetermined[f"{TERMS[term]}[{channel}]"] = f"{words[term]} in this channel"


def _name_dependent(optimum: Optimum, known: np.ndarray, undetermined: dict[str, str], dependent: float) -> None:
    """Find terms that the others reproduce; takes them out of ``known``."""
    for channel in range(known.shape[1]):
        gram = optimum.gram[channel, :3, :3]
        terms = list(np.flatnonzero(known[:, channel]))
        scale = np.sqrt(np.maximum(np.diag(gram), 0.0))
        for term in terms:
            if scale[term] == 0:
                known[term, channel] = False
                undetermined[f"{TERMS[term]}[{channel}]"] = "its light reaches no pixel that counts"
        terms = [term for term in terms if known[term, channel]]
        if len(terms) < 2:
            continue
        normed = gram[np.ix_(terms, terms)] / np.outer(scale[terms], scale[terms])
        value, vector = np.linalg.eigh(normed)
        if value[0] > dependent:
            continue
        tied = [terms[i] for i in np.flatnonzero(np.abs(vector[:, 0]) > 0.1)]
        names = " and ".join(TERMS[term] for term in tied)
        for term in tied:
            known[term, channel] = False
            undetermined[f"{TERMS[term]}[{channel}]"] = f"only a sum of {names} is determined"


class _System:
    """The normal equations of all unknowns: x_a, x_d, x_s channel after channel, then n."""

    def __init__(
        self,
        optimum: Optimum,
        known: np.ndarray,
        noise: np.ndarray,
        tied: np.ndarray | None,
        spread: np.ndarray | None,
        dependent: float,
    ):
        channels = noise.size
        size = 3 * channels + 1
        self.optimum, self.known, self.dependent = optimum, known, dependent
        self.hessian, self.spread = np.zeros((size, size)), np.zeros((size, size))
        for channel, block in enumerate(optimum.gauss_newton):
            place = np.ix_(*2 * [[channel, channels + channel, 2 * channels + channel, size - 1]])
            self.hessian[place] += block
            if spread is None:
                self.spread[place] += noise[channel] ** 2 * block
            else:
                scale = np.array([1.0, 1.0, 1.0, optimum.x[2, channel]])
                self.spread[place] += spread[channel] * np.outer(scale, scale)
        active = known & (optimum.x > 0)
        self.has_n = bool(active[2].any())
        columns = [row for row in np.eye(size)[:-1][active.ravel()]]
        if tied is not None and self.has_n:
            columns = [row for row in np.eye(size)[:-1][np.concatenate([active[:2].ravel(), np.zeros(channels, bool)])]]
            columns.append(np.concatenate([np.zeros(2 * channels), tied * active[2], [0.0]]))
        self.with_n = False
        self._reduce(columns)
        if self.has_n:
            n = np.eye(size)[-1]
            cross = self.basis.T @ self.hessian @ n
            self.along = self.basis @ self.inverse @ cross
            left = self.hessian[-1, -1] - cross @ self.inverse @ cross
            self.with_n = bool(left > dependent * self.hessian[-1, -1])
            if self.with_n:
                self._reduce([*columns, n])
        self.covariance = self.basis @ self.inverse @ self._middle() @ self.inverse @ self.basis.T

    def _reduce(self, columns: list[np.ndarray]) -> None:
        self.basis = np.stack(columns, axis=1) if columns else np.zeros((self.hessian.shape[0], 0))
        reduced = self.basis.T @ self.hessian @ self.basis
        scale = np.sqrt(np.maximum(np.diag(reduced), np.finfo(float).tiny))
        normed = reduced / np.outer(scale, scale)
        inverse = np.linalg.pinv(normed, rcond=1e-14, hermitian=True) if columns else normed
        self.inverse = inverse / np.outer(scale, scale)

    def _middle(self) -> np.ndarray:
        return self.basis.T @ self.spread @ self.basis

    @property
    def rise(self) -> float:
        """The noise variance, averaged over channels as n feels it, times the 95 % quantile of chi squared."""
        if not self.with_n:
            return 0.0
        return float(NORMAL_95**2 * self.covariance[-1, -1] / (self.basis @ self.inverse @ self.basis.T)[-1, -1])

    def correlation(self) -> np.ndarray:
        """Of the unknowns; 0 for those that are not free."""
        deviation = np.sqrt(np.maximum(np.diag(self.covariance), 0.0))
        inverse = np.where(deviation > 0, 1 / np.where(deviation > 0, deviation, 1.0), 0.0)
        return self.covariance * np.outer(inverse, inverse)

    def errors(self) -> tuple[np.ndarray, np.ndarray, float]:
        """Standard errors and 95 % intervals of x, standard error of n."""
        x, channels = self.optimum.x, self.known.shape[1]
        error, interval = np.full((3, channels), np.inf), np.zeros((3, channels, 2))
        interval[..., 1] = np.inf
        for term, channel in np.argwhere(self.known):
            index = term * channels + channel
            if x[term, channel] > 0:
                value = float(x[term, channel])
                deviation = math.sqrt(max(float(self.covariance[index, index]), 0.0))
                # Where n is open, what moves along with it is open too.
                if self.has_n and not self.with_n and abs(self.along[index]) * self.optimum.n > deviation:
                    deviation = math.inf
            else:
                value, deviation = self._released(term, channel, index)
            error[term, channel] = deviation
            interval[term, channel] = above_zero(value, deviation)
        n_variance = self.covariance[-1, -1] if self.with_n else np.inf
        return error, interval, float(np.sqrt(n_variance))

    def _released(self, term: int, channel: int, index: int) -> tuple[float, float]:
        """Value and error that a coefficient at its bound would have without the bound."""
        gram, x = self.optimum.gram[channel], self.optimum.x[:, channel]
        score = self.optimum.product[channel, term] - gram[term, :3] @ x
        direction = -self.basis @ self.inverse @ (self.basis.T @ self.hessian[:, index])
        direction[index] += 1.0
        left = direction @ self.hessian @ direction
        if left <= self.dependent * self.hessian[index, index]:
            return 0.0, np.inf
        return float(score / left), float(np.sqrt(direction @ self.spread @ direction) / left)
