"""How sure a fit is: covariance from the Gauss-Newton Hessian, intervals, and what the picture leaves open."""

import dataclasses
import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from fitting.sample_error import SampleError
from fitting.solver.nnls import scaled_inverse
from fitting.solver.profile import Optimum
from fitting.solver.tied import design_of
from fitting.uncertainty.intervals import NORMAL_95, above_zero

# A squared column keeps less than this of itself when the others are taken out: the two tell the same story.
# Float32 sums leave some 1e-7 of a column that depends on the others.
DEPENDENT_SINGLE, DEPENDENT_DOUBLE = 1e-6, 1e-10
# What the arithmetic of single precision leaves of a number, relative: a few of its rounding errors.
RESOLUTION = 5e-7
# As much of the scatter of independent pixels is there in any case.
LEAST_SCATTER = 1e-6
# A term that moves no pixel by more than this share of the brightest one leaves no trace.
NO_TRACE = 1e-6
# A specular term counts when leaving it out raises the cost by so many noise variances for each of its unknowns.
SIGNIFICANT = 10.0

TERMS = ("k_a", "k_d", "k_s")
LIGHT = ("no ambient light", "no light", "no light")
# What ambient light is taken to add where no more than its sum with the diffuse term is determined.
AMBIENT_SHARE = 0.01


class Sum(NamedTuple):
    """Terms of which the picture determines no more than their sum: each looks like the others.

    Attributes:
        terms: their indices.
        columns: root mean square over pixels of what each shows at 1, (T,).
        value: of all together.
        error: standard error of that.
    """

    terms: Int[np.ndarray, " T"]
    columns: Float[np.ndarray, " T"]
    value: float
    error: float

    @property
    def stand_in(self) -> Float[np.ndarray, " 3"]:
        """Coefficients that show it: of k_a little, of k_d the rest, of k_s nothing."""
        shares, of_two = np.zeros(3), self.terms[self.terms < 2]
        shares[of_two] = 1.0 if of_two.size == 1 else (AMBIENT_SHARE, 1 - AMBIENT_SHARE)
        shares[self.terms] *= self.value / self.columns
        return shares


class Uncertainty(NamedTuple):
    """Errors, and what is not determined.

    Attributes:
        x_error: of the engine's coefficients x_a, x_d, x_s, (3, C); for one at its bound, that which it would have if
            the bound were not there. Infinite where the picture does not determine it.
        x_interval: 95 % interval of each, lower and upper end, (3, C, 2).
        n_error: of n; infinite where the picture does not determine it.
        correlation: of x_a, x_d, x_s (channel after channel each) and n, (3C + 1, 3C + 1); 0 for what is at its bound
            or not determined.
        rise: by how much the cost, summed over channels, rises at the ends of a 95 % interval of n.
        reasons: why a coefficient is not determined, (3, C) of texts; empty where it is.
        n_reason: why n is not; empty where it is.
        sums: by channel, what is determined of several terms together.
    """

    x_error: Float[np.ndarray, "3 C"]
    x_interval: Float[np.ndarray, "3 C 2"]
    n_error: float
    correlation: Float[np.ndarray, "P P"]
    rise: float
    reasons: np.ndarray
    n_reason: str
    sums: dict[int, Sum]


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
    visible: float,
    *,
    single: bool,
    tied: Float[np.ndarray, " C"] | None = None,
    spread: Float[np.ndarray, "C 4 4"] | None = None,
    scatter: Float[np.ndarray, "U U"] | None = None,
    widening: Float[np.ndarray, " U"] | float = 1.0,
    copies: bool = False,
    columns: Float[np.ndarray, "3 C"] | None = None,
    gain: float = 0.0,
    resolution: float = 0.0,
    missed: SampleError | None = None,
    joined: Float[np.ndarray, "U U"] | None = None,
    moved: Float[np.ndarray, "K U"] | None = None,
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
        visible: largest value of the specular term in the picture, over that of the picture.
        single: whether the pixels were float32.
        tied: x_s is a common factor times this, (C,); None where the channels are independent.
        spread: sums of the columns' products times the variance of each pixel, where it is not the same in all.
        scatter: what takes the place of the Hessian times the noise, over all unknowns, where pixels err together.
        widening: what to multiply errors by.
        copies: the channels are copies of each other, and err together.
        columns: root mean square over pixels of what each term shows at 1; None where no pixel weighs more.
        resolution: relative error of a number that is left by the arithmetic of the basis images.
        gain: see `specular_gain`, where more pixels tell of it than those of the optimum's sums.
        missed: what light samples leave out; None where there are none.
        joined: the Hessian of all channels, whose noise is 1, where these err together.
        moved: by how much each of some causes may have moved the unknowns.
    """
    gain = max(gain, specular_gain(optimum, noise))
    columns = rms_columns(optimum) if columns is None else columns
    dependent = DEPENDENT_SINGLE if single else DEPENDENT_DOUBLE
    reasons = np.full(free.shape, "", object)
    n_reason = reasons[2, :] = _without_trace(optimum, gain, visible, grey=tied is not None)
    for term, channel in np.argwhere(~free & (reasons == "")):
        where = "this channel" if free[term].any() else "the scene"
        reasons[term, channel] = f"{LIGHT[term]} in {where}"
    sums = _dependent(optimum, reasons, dependent, columns)
    known, stand_in = reasons == "", optimum.x.copy()
    determined = known.copy()
    for channel, some in sums.items():
        # One takes the place of all, and its error is that of the sum.
        first = some.terms[0]
        stand_in[some.terms, channel] = 0.0
        stand_in[first, channel], determined[first, channel] = some.value / some.columns[0], True
    optimum = dataclasses.replace(optimum, x=stand_in)
    x_error, x_interval, n_error, correlation, rise = _errors(
        optimum,
        determined,
        noise,
        tied,
        spread,
        scatter,
        widening,
        copies,
        dependent,
        resolution,
        missed,
        joined,
        moved,
    )
    sums = {c: some._replace(error=some.columns[0] * x_error[some.terms[0], c]) for c, some in sums.items()}
    alone = x_error
    if scatter is not None:
        # What errs together makes errors larger, but not the numbers less determined.
        alone, *_ = _errors(
            optimum, determined, noise, tied, spread, None, widening, copies, dependent, 0.0, None, joined
        )
    for term, channel in np.argwhere(known):
        largest = max(optimum.square[channel], brightest[channel] ** 2)
        if alone[term, channel] ** 2 * optimum.gram[channel, term, term] > largest:
            reasons[term, channel] = "its error is larger than the whole picture"
            x_error[term, channel] = np.inf
    if not n_reason and not np.isfinite(n_error):
        n_reason = "the highlight fits as well with other exponents and another k_s"
    if n_reason:
        n_error = math.inf
    return Uncertainty(x_error, x_interval, n_error, correlation, rise, reasons, n_reason, sums)


def _without_trace(optimum: Optimum, gain: float, visible: float, *, grey: bool) -> str:
    """Why there is no specular term to speak of; empty where there is one."""
    if optimum.flat:
        return "" if _adds_evenly(optimum) else "the picture has no highlight"
    if visible < NO_TRACE:
        return f"the highlight is below {NO_TRACE:g} of the picture"
    unknowns = 2 if grey else 1 + np.count_nonzero(optimum.x[2] > 0)
    return "" if gain > SIGNIFICANT * unknowns else "the highlight does not stand out of the noise"


def _adds_evenly(optimum: Optimum) -> bool:
    """Whether a highlight shows in each channel what ambient and diffuse light show, as on a plane far away."""
    for gram in optimum.gram[:, :3, :3]:
        others, cross = gram[:2, :2], gram[:2, 2]
        left = gram[2, 2] - cross @ np.linalg.lstsq(others, cross, rcond=DEPENDENT_DOUBLE)[0]
        if not 0 < gram[2, 2] * DEPENDENT_SINGLE >= left:
            return False
    return True


def specular_gain(optimum: Optimum, noise: Float[np.ndarray, " C"]) -> float:
    """By how many noise variances the cost rises without the specular term.

    Args:
        optimum: of the engine.
        noise: standard deviation of the residual, (C,).
    """
    gain = 0.0
    for gram, x, deviation in zip(optimum.gram, optimum.x.T, noise, strict=True):
        others = np.flatnonzero(x[:2] > 0)
        cross = gram[others, 2]
        block = gram[np.ix_(others, others)]
        left = gram[2, 2] - cross @ np.linalg.lstsq(block, cross, rcond=DEPENDENT_DOUBLE)[0]
        gain += x[2] ** 2 * max(left, 0.0) / deviation**2
    return gain


def rms_columns(optimum: Optimum, weight: float = 1.0) -> Float[np.ndarray, "3 C"]:
    """Root mean square over pixels of what each term shows at 1.

    Args:
        optimum: of the engine.
        weight: root of the mean weight of its pixels.
    """
    squares = np.diagonal(optimum.gram[:, :3, :3], axis1=1, axis2=2).T
    return np.sqrt(np.maximum(squares, 0.0) / np.maximum(optimum.pixels, 1)) / weight


def _dependent(optimum: Optimum, reasons: np.ndarray, dependent: float, columns: np.ndarray) -> dict[int, Sum]:
    """Name terms that no pixel sees, or that the others reproduce; of each channel the sum, where that is all."""
    sums = {}
    for channel, column in enumerate(reasons.T):
        gram = optimum.gram[channel, :3, :3]
        scale = np.sqrt(np.maximum(np.diag(gram), 0.0))
        column[(column == "") & (scale == 0)] = "its light reaches no pixel that counts"
        terms = np.flatnonzero(column == "")
        if terms.size < 2:
            continue
        value, vector = np.linalg.eigh(gram[np.ix_(terms, terms)] / np.outer(scale[terms], scale[terms]))
        if value[0] <= dependent:
            ways = np.abs(vector[:, value <= dependent])
            tied = terms[ways.max(axis=1) > 0.1]
            column[tied] = f"only a sum of {' and '.join(TERMS[term] for term in tied)} is determined"
            if ways.shape[1] == tied.size - 1:
                shown = columns[tied, channel]
                sums[channel] = Sum(tied, shown, float(shown @ optimum.x[tied, channel]), math.inf)
    return sums


def _errors(
    optimum: Optimum,
    known: np.ndarray,
    noise: np.ndarray,
    tied: np.ndarray | None,
    spread: np.ndarray | None,
    scatter: np.ndarray | None,
    widening: np.ndarray | float,
    copies: bool,
    dependent: float,
    resolution: float,
    missed: SampleError | None,
    joined: np.ndarray | None,
    moved: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray, float, np.ndarray, float]:
    """Errors and intervals of x, the error of n, the correlation of all unknowns, and the rise of the cost.

    The unknowns are x_a, x_d, x_s, channel after channel each, then n.
    """
    x, channels = optimum.x, noise.size
    size = 3 * channels + 1
    hessian, middle = np.zeros((size, size)), np.zeros((size, size))
    places = [[channel, channels + channel, 2 * channels + channel, size - 1] for channel in range(channels)]
    for channel, block in enumerate(optimum.gauss_newton):
        hessian[np.ix_(places[channel], places[channel])] += block
        scale = np.array([1.0, 1.0, 1.0, x[2, channel]])
        scores = noise[channel] ** 2 * block if spread is None else spread[channel] * np.outer(scale, scale)
        for place in places if copies else places[channel : channel + 1]:
            middle[np.ix_(places[channel], place)] += scores
    if joined is not None:
        hessian = middle = joined
    # What is left may be the dust of arithmetic, which errs together and says nothing.
    alone, middle = middle, middle if scatter is None else scatter + LEAST_SCATTER * middle
    active = known & (x > 0)
    has_n, with_n = bool(active[2].any()), False
    unit = np.eye(size)
    basis = unit[:, np.append(active.ravel(), False)]
    if tied is not None and has_n:
        basis = design_of(active, tied)[:, :-1]
    inverse = _inverse(hessian, basis)
    along = inverse @ hessian[:, -1]
    if has_n:
        left = hessian[-1, -1] - hessian[-1] @ along
        with_n = bool(left > dependent * hessian[-1, -1])
        if with_n:
            inverse = _inverse(hessian, np.column_stack([basis, unit[:, -1]]))
    covariance = inverse @ middle @ inverse
    if scatter is not None:
        # Of a few blocks the scatter alone says too little.
        alike = inverse @ alone @ inverse
        more = max(np.trace(inverse @ scatter) / max(np.trace(inverse @ alone), np.finfo(float).tiny), 1.0)
        variance, least = np.diag(covariance), np.diag(alike) * more
        ratio = np.divide(least, variance, out=np.ones(size), where=variance > 0)
        widening = widening * np.sqrt(np.maximum(ratio, 1.0))
    covariance = covariance * np.outer(widening * np.ones(size), widening * np.ones(size))
    if missed is not None:
        off = missed.shift(np.append(active.ravel(), with_n)) * np.append(np.ones(size - 1), optimum.n)
        covariance = covariance + np.outer(off, off)
    if moved is not None:
        covariance = covariance + moved.T @ moved
    variance = np.maximum(np.diag(covariance), 0.0)
    error, interval = np.full((3, channels), np.inf), np.zeros((3, channels, 2))
    interval[..., 1] = np.inf
    for term, channel in np.argwhere(known):
        index = term * channels + channel
        value, deviation = float(x[term, channel]), math.sqrt(variance[index])
        # Where n is open, what moves along with it is open too.
        if value > 0 and has_n and not with_n and abs(along[index]) * optimum.n > deviation:
            deviation = math.inf
        if not value > 0:
            # Value and error that it would have without the bound.
            direction = unit[index] - inverse @ hessian[:, index]
            left = direction @ hessian @ direction
            deviation = math.inf
            if left > dependent * hessian[index, index]:
                score = optimum.product[channel, term] - optimum.gram[channel, term, :3] @ x[:, channel]
                value, deviation = float(score / left), float(np.sqrt(direction @ middle @ direction) / left)
        deviation = math.hypot(deviation, resolution * value)
        error[term, channel] = deviation
        interval[term, channel] = above_zero(value, deviation)
    scale = np.divide(1.0, np.sqrt(variance), out=np.zeros(size), where=variance > 0)
    n_error, rise = math.inf, 0.0
    if with_n:
        n_error = math.hypot(math.sqrt(variance[-1]), resolution * optimum.n)
        # The noise variance, averaged over channels as n feels it, times the 95 % quantile of chi squared.
        rise = float(NORMAL_95**2 * covariance[-1, -1] / inverse[-1, -1])
    return error, interval, n_error, covariance * np.outer(scale, scale), rise


def _inverse(hessian: np.ndarray, basis: np.ndarray) -> np.ndarray:
    """The inverse of the Hessian among the columns of a basis, 0 beside them."""
    return basis @ scaled_inverse(basis.T @ hessian @ basis, 1e-14) @ basis.T
