"""How sure a fit is: covariance from the Gauss-Newton Hessian, intervals, and what the picture leaves open."""

import dataclasses
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from brdf.vectors import quotient
from fitting.light_colour import scale_growth
from fitting.model_fit import ModelFit
from fitting.sample_error import SampleError
from fitting.solver.nnls import scaled_inverse
from fitting.solver.profile import Optimum
from fitting.solver.tied import design_of, join_channels
from fitting.uncertainty.intervals import NORMAL_95, above_zero, student_95

# A squared column keeps less than this of itself when the others are taken out: the two tell the same story.
# Float32 sums leave some 1e-7 of a column that depends on the others.
DEPENDENT_SINGLE, DEPENDENT_DOUBLE = 1e-6, 1e-10
# What the arithmetic of single precision leaves of a number, over that which alone would show the picture: a few of its
# rounding errors; and how much of these all pixels share.
RESOLUTION, SHARED = 5e-7, 0.4
# As much of the scatter of independent pixels is there in any case.
LEAST_SCATTER = 1e-6
# A term that moves no pixel by more than this share of the brightest one leaves no trace.
NO_TRACE = 1e-6
LOST_IN_NOISE = "the highlight does not stand out of the noise"
# A specular term counts when leaving it out raises the cost by so many noise variances for each of its unknowns.
SIGNIFICANT = 10.0

TINY = np.finfo(float).tiny
# With less than this of values less unknowns nothing is left to tell an error by.
FEWEST_DEGREES = 0.5
FEW_PIXELS = "as few pixels count as there are numbers: nothing is left to tell its error by"

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


class PixelErrors(NamedTuple):
    """How pixels err.

    Attributes:
        noise: standard deviation of the residual, (C,).
        spread: sums of the columns' products times the variance of each pixel, where it is not the same in all.
        scatter: what takes the place of the Hessian times the noise, over all unknowns, where pixels err together.
        channels: correlation of the channels' errors; None where they err alone.
        missed: what light samples leave out; None where there are none.
    """

    noise: Float[np.ndarray, " C"]
    spread: Float[np.ndarray, "C 4 4"] | None = None
    scatter: Float[np.ndarray, "U U"] | None = None
    channels: Float[np.ndarray, "C C"] | None = None
    missed: SampleError | None = None


class Uncertainty(NamedTuple):
    """Errors, and what is not determined.

    Attributes:
        x_error: of the engine's coefficients x_a, x_d, x_s, (3, C), of the last as it is at the scale of the lobe at
            the optimum; for one at its bound, that which it would have if the bound were not there. Infinite where the
            picture does not determine it.
        x_interval: 95 % interval of each, lower and upper end, (3, C, 2).
        n_error: of n; infinite where the picture does not determine it.
        correlation: of x_a, x_d, x_s (channel after channel each) and n, (3C + 1, 3C + 1); 0 for what is at its bound
            or not determined.
        reach: by how many of its errors a 95 % interval of n reaches.
        delta_cost: by how much the cost, summed over channels, rises at the ends of a 95 % interval of n.
        reasons: why a coefficient is not determined, (3, C) of texts; empty where it is.
        n_reason: why n is not; empty where it is.
        sums: by channel, what is determined of several terms together.
    """

    x_error: Float[np.ndarray, "3 C"]
    x_interval: Float[np.ndarray, "3 C 2"]
    n_error: float
    correlation: Float[np.ndarray, "P P"]
    reach: float
    delta_cost: float
    reasons: np.ndarray
    n_reason: str
    sums: dict[int, Sum]

    def holding(self, x: Float[np.ndarray, "N 3 C"]) -> "Uncertainty":
        """With intervals that hold coefficients which are as likely beside other exponents."""
        low, high = np.moveaxis(self.x_interval, -1, 0)
        ends = np.minimum(low, x.min(axis=0)), np.maximum(high, x.max(axis=0))
        return self._replace(x_interval=np.stack(ends, axis=-1))


def residual_noise(optimum: Optimum, rounding: Float[np.ndarray, " C"]) -> Float[np.ndarray, " C"]:
    """Standard deviation of the residual, not below that of rounding: in a black channel that of the brightest one."""
    degrees = np.maximum(_degrees(optimum), 1)
    least = np.max(optimum.square / degrees) * np.finfo(float).eps ** 2 + TINY
    return np.sqrt(np.maximum(optimum.cost / degrees, np.maximum(rounding**2, least)))


def _degrees(optimum: Optimum) -> Float[np.ndarray, " C"]:
    """Values less unknowns of each channel, which have their part in n."""
    return optimum.pixels - np.count_nonzero(optimum.x > 0, axis=0) - np.any(optimum.x[2] > 0) / optimum.x.shape[1]


def uncertainty(
    fit: ModelFit,
    pixels: PixelErrors,
    reached: Bool[np.ndarray, "3 C"],
    brightest: Float[np.ndarray, " C"],
    visible: float,
    *,
    columns: Float[np.ndarray, "3 C"] | None = None,
    gain: float = 0.0,
    resolution: float = 0.0,
) -> Uncertainty:
    """Errors of a fit.

    The covariance is H⁻¹ (Σ_c σ_c² J_cᵀJ_c) H⁻¹ with the noise σ_c of each channel: channels share n but not their
    noise. Coefficients at their bound are held there; the others' errors hold what these may be.

    Args:
        fit: of one model; where rounded values say more, with the pictures and the optimum of these.
        pixels: how they err.
        reached: which coefficients the light reaches, (3, C).
        brightest: largest value of the picture, (C,).
        visible: largest value of the specular term in the picture, over that of the picture.
        columns: root mean square over pixels of what each term shows at 1; None where no pixel weighs more.
        gain: see `specular_gain`, where more pixels tell of it than those of the optimum's sums.
        resolution: error that is left by the arithmetic of the basis images, over the picture.
    """
    optimum, channels = fit.optimum, pixels.noise.size
    dependent = DEPENDENT_SINGLE if fit.single else DEPENDENT_DOUBLE
    joined = _joined(fit)
    for gram in (optimum.normal(pixels.noise**2).gram, joined):
        gain = gain if gram is None else max(gain, specular_gain(gram, optimum.x))
    reasons, degrees = np.full(reached.shape, "", object), _degrees(optimum)
    n_reason = reasons[2, :] = _without_trace(optimum, gain, visible, grey=fit.tied is not None)
    for term, channel in np.argwhere(~reached & (reasons == "")):
        where = "this channel" if reached[term].any() else "the scene"
        reasons[term, channel] = f"{LIGHT[term]} in {where}"
    reasons[(reasons == "") & (degrees < FEWEST_DEGREES)] = FEW_PIXELS
    n_reason = n_reason or FEW_PIXELS * bool(np.all(degrees < FEWEST_DEGREES))
    sums = _dependent(optimum, reasons, dependent, rms_columns(optimum) if columns is None else columns)
    known, stand_in = reasons == "", optimum.x.copy()
    determined = known.copy()
    for channel, some in sums.items():
        # One takes the place of all, and its error is that of the sum.
        first = some.terms[0]
        stand_in[some.terms, channel] = 0.0
        stand_in[first, channel], determined[first, channel] = some.value / some.columns[0], True
    optimum = dataclasses.replace(optimum, x=stand_in)
    x, active = optimum.x, determined & (optimum.x > 0)
    inner = _covariance(fit, optimum, pixels, active, dependent)
    at_bound = {
        (term, channel): _without_bound(term, channel, optimum, inner, dependent)
        for term, channel in np.argwhere(determined & ~(x > 0)).tolist()
    }
    covariance = _with_bounds(fit, optimum, inner, [off for *_, off in at_bound.values()])
    variance = np.maximum(np.diag(covariance), 0.0)
    # Where this is larger than the picture a number is not determined, whatever others at their bound may be. What errs
    # together makes errors larger, but not the numbers less determined.
    dropped = np.sum(np.square([np.zeros(variance.size), *fit.moved, *fit.dropped]), axis=0)
    own = np.diag(inner.covariance) + dropped if pixels.scatter is None else np.diag(inner.independent)
    deviations = np.sqrt(np.maximum([variance, own], 0.0))
    reaches = [student_95(max(one, FEWEST_DEGREES)) for one in degrees.tolist()]
    x_error, x_interval = np.full(x.shape, np.inf), np.zeros((*x.shape, 2))
    # What arithmetic leaves of a coefficient: as much as an error of all pixels alike, as large as the picture, may
    # make; of a highlight as much as its brightest place may.
    alike = SHARED * np.sqrt(np.diag(inner.inverse)[:-1].reshape(x.shape) * optimum.square)
    arithmetic, of_lobe = resolution * np.maximum(x, alike), resolution / max(visible, resolution, TINY)
    arithmetic[2] = SHARED * of_lobe * x[2]
    x_interval[..., 1] = np.inf
    for term, channel in np.argwhere(determined):
        index = term * channels + channel
        value, deviation, alone = float(x[term, channel]), *deviations[:, index].tolist()
        # Where n is open, what moves along with it is open too.
        if value > 0 and active[2].any() and not inner.with_n and abs(inner.along[index]) * optimum.n > deviation:
            deviation = alone = math.inf
        if (term, channel) in at_bound:
            value, deviation, alone, _ = at_bound[term, channel]
        largest = max(optimum.square[channel], brightest[channel] ** 2)
        deviation = math.hypot(deviation, arithmetic[term, channel])
        wide = deviation * reaches[channel] / NORMAL_95
        x_interval[term, channel], x_error[term, channel] = above_zero(value, wide), deviation
        # What is at its bound may be there, whatever the slope of a likelihood that is nearly flat.
        x_interval[term, channel, 0] *= x[term, channel] > 0
        if known[term, channel] and alone**2 * optimum.gram[channel, term, term] > largest:
            reasons[term, channel] = "its error is larger than the whole picture"
            x_error[term, channel] = np.inf
    sums = {c: some._replace(error=some.columns[0] * x_error[some.terms[0], c]) for c, some in sums.items()}
    scale = quotient(1.0, deviations[0])
    # Of n the channels tell together, where they err alone.
    apart = channels if pixels.channels is None else 1
    reach = student_95(max(apart * float(np.mean(degrees)), FEWEST_DEGREES))
    n_error, delta_cost = math.inf, 0.0
    if inner.with_n:
        # The noise variance, averaged over channels as n feels it, times the square of that reach.
        delta_cost = float(reach**2 * covariance[-1, -1] / inner.inverse[-1, -1])
        n_error = math.inf if n_reason else math.hypot(deviations[0, -1], of_lobe * optimum.n)
    elif not n_reason:
        n_reason = "the highlight fits as well with other exponents and another k_s"
    correlation = covariance * np.outer(scale, scale)
    return Uncertainty(x_error, x_interval, n_error, correlation, reach, delta_cost, reasons, n_reason, sums)


def _joined(fit: ModelFit) -> Float[np.ndarray, "U U"] | None:
    """The Hessian of all channels where these err together, the noise of each being 1; None where they do not."""
    return None if fit.evidence is None or fit.evidence.together is None else fit.evidence.together.gram


class _Covariance(NamedTuple):
    """Of what is active, the rest held; all over x_a, x_d, x_s, channel after channel, and n.

    Attributes:
        hessian: the Hessian, of noise 1.
        inverse: its inverse.
        along: what n moves along.
        with_n: whether n is determined.
        middles: covariances of the scores, with what errs together, and as if pixels erred alone.
        covariance: of the numbers.
        independent: the same as if pixels erred alone.
    """

    hessian: Float[np.ndarray, "U U"]
    inverse: Float[np.ndarray, "U U"]
    along: Float[np.ndarray, " U"]
    with_n: bool
    middles: Float[np.ndarray, "2 U U"]
    covariance: Float[np.ndarray, "U U"]
    independent: Float[np.ndarray, "U U"]


def _covariance(
    fit: ModelFit, optimum: Optimum, pixels: PixelErrors, active: Bool[np.ndarray, "3 C"], dependent: float
) -> _Covariance:
    joined, scatter, missed = _joined(fit), pixels.scatter, pixels.missed
    hessian = optimum.normal().gram if joined is None else joined
    middle = _of_scores(optimum, pixels) if joined is None else joined
    inverse, along, with_n = _inverted(hessian, active, fit.tied, dependent)
    widening = np.ones(len(inverse)) * (1.0 if fit.evidence is None else fit.evidence.widening)
    independent = inverse @ middle @ inverse * np.outer(widening, widening)
    covariance, middles = independent, np.stack([middle, middle])
    if scatter is not None:
        # What is left may be the dust of arithmetic, which errs together and says nothing.
        middles[0] = scatter + LEAST_SCATTER * middle
        covariance = inverse @ middles[0] @ inverse * np.outer(widening, widening)
        # Of a few blocks the scatter alone says too little.
        more = max(np.trace(inverse @ scatter) / max(np.trace(inverse @ middle), TINY), 1.0)
        variance, least = np.diag(covariance), np.diag(independent) * more
        wider = np.sqrt(np.maximum(quotient(least, variance), 1.0))
        covariance = covariance * np.outer(wider, wider)
    if missed is not None:
        off = missed.shifts(np.append(active.ravel(), with_n)) * np.append(np.ones(active.size), optimum.n)
        covariance = covariance + off.T @ off
    return _Covariance(hessian, inverse, along, with_n, middles, covariance, independent)


def _with_bounds(
    fit: ModelFit, optimum: Optimum, inner: _Covariance, offs: Sequence[Float[np.ndarray, " U"]]
) -> Float[np.ndarray, "U U"]:
    """The covariance with what numbers at their bound may be: ``offs`` is how far off others are where one is not.

    Of x_s as it is at the scale of the lobe at the optimum, whatever n is.
    """
    size = len(inner.covariance)
    off = np.array([np.zeros(size), *offs])
    # What was dropped is at its bound too, and counts once.
    beside = [np.sqrt(np.maximum(one**2 - np.sum(off**2, axis=0), 0.0)) * np.sign(one) for one in fit.dropped]
    off = np.vstack([off, *beside, *fit.moved])
    held = np.eye(size)
    held[2 * optimum.x.shape[1] : -1, -1] = -scale_growth(fit.model, optimum.n) * optimum.x[2]
    return held @ (inner.covariance + off.T @ off) @ held.T


def _without_trace(optimum: Optimum, gain: float, visible: float, *, grey: bool) -> str:
    """Why there is no specular term to speak of; empty where there is one."""
    if optimum.flat:
        return "" if _adds_evenly(optimum) else "the picture has no highlight"
    if visible < NO_TRACE:
        return f"the highlight is below {NO_TRACE:g} of the picture"
    unknowns = 2 if grey else 1 + np.count_nonzero(optimum.x[2] > 0)
    return "" if gain > SIGNIFICANT * unknowns else LOST_IN_NOISE


def _adds_evenly(optimum: Optimum) -> bool:
    """Whether a highlight shows in each channel what ambient and diffuse light show, as on a plane far away."""
    for gram in optimum.gram[:, :3, :3]:
        others, cross = gram[:2, :2], gram[:2, 2]
        left = gram[2, 2] - cross @ np.linalg.lstsq(others, cross, rcond=DEPENDENT_DOUBLE)[0]
        if not 0 < gram[2, 2] * DEPENDENT_SINGLE >= left:
            return False
    return True


def specular_gain(gram: Float[np.ndarray, "U U"], x: Float[np.ndarray, "3 C"]) -> float:
    """By how many noise variances the cost rises without the specular term.

    The gram is of x_a, x_d, x_s, channel after channel, and the exponent; the noise of each is 1.
    """
    lobe = np.append(np.zeros(x[:2].size), x[2])
    others = np.flatnonzero(x[:2].ravel() > 0)
    pull = gram[:-1, :-1] @ lobe
    along = scaled_inverse(gram[np.ix_(others, others)], DEPENDENT_DOUBLE) @ pull[others]
    return max(float(lobe @ pull - pull[others] @ along), 0.0)


def rms_columns(optimum: Optimum, weight: float = 1.0) -> Float[np.ndarray, "3 C"]:
    """Root mean square over pixels of what each term shows at 1; ``weight`` is the root of the mean weight of these."""
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


def _of_scores(optimum: Optimum, pixels: PixelErrors) -> Float[np.ndarray, "U U"]:
    """The covariance of the scores by x_a, x_d, x_s, channel after channel, and n, where pixels err alone."""
    scores = pixels.noise[:, None, None] ** 2 * optimum.gram if pixels.spread is None else pixels.spread
    if pixels.channels is not None:
        # The columns of two channels are alike but for their sizes, or nearly so: by the root of each one's products
        # what they share is never more than either has.
        size = np.sqrt(np.maximum(np.diagonal(scores, axis1=1, axis2=2), TINY))
        values, vectors = np.linalg.eigh(scores / (size[:, :, None] * size[:, None]))
        roots = (vectors * np.sqrt(np.maximum(values, 0.0))[:, None]) @ np.swapaxes(vectors, 1, 2) * size[..., None]
        scores = (roots[:, None] @ np.swapaxes(roots, 1, 2)) * pixels.channels[..., None, None]
    return join_channels(scores, optimum.product, optimum.square, optimum.x[2]).gram


def _without_bound(
    term: int, channel: int, optimum: Optimum, inner: _Covariance, dependent: float
) -> tuple[float, float, float, Float[np.ndarray, " U"]]:
    """Value and errors that a coefficient would have without its bound; how far off others are if it is not at it."""
    hessian, size = inner.hessian, len(inner.hessian)
    own = np.eye(size)[term * optimum.x.shape[1] + channel]
    direction = own - inner.inverse @ hessian @ own
    left = direction @ hessian @ direction
    if left <= dependent * (own @ hessian @ own):
        return 0.0, math.inf, math.inf, np.zeros(size)
    score = optimum.product[channel, term] - optimum.gram[channel, term, :3] @ optimum.x[:, channel]
    value, (deviation, alone) = float(score / left), (np.sqrt(direction @ inner.middles @ direction) / left).tolist()
    moved, farthest = direction - own, above_zero(value, deviation)[1] / NORMAL_95
    return value, deviation, alone, np.multiply(moved, farthest, out=np.zeros(size), where=moved != 0)


def _inverted(
    hessian: Float[np.ndarray, "U U"], active: Bool[np.ndarray, "3 C"], tied: np.ndarray | None, dependent: float
) -> tuple[Float[np.ndarray, "U U"], Float[np.ndarray, " U"], bool]:
    """The inverse of the Hessian in what is active, what n moves along, and whether n is determined."""
    has_n = bool(active[2].any())
    design = design_of(active, tied if has_n else None)
    inverse = inverse_among(hessian, design[:, :-1] if has_n else design)
    along = inverse @ hessian[:, -1]
    with_n = has_n and bool(hessian[-1, -1] - hessian[-1] @ along > dependent * hessian[-1, -1])
    return inverse_among(hessian, design) if with_n else inverse, along, with_n


def inverse_among(hessian: Float[np.ndarray, "U U"], basis: Float[np.ndarray, "U V"]) -> Float[np.ndarray, "U U"]:
    """The inverse of a positive semidefinite Hessian among the columns of a basis, 0 beside them."""
    return basis @ scaled_inverse(basis.T @ hessian @ basis, 1e-14) @ basis.T
