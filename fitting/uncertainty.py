"""How sure a fit is: standard errors from the Gauss-Newton Hessian, and which parameters the picture does not determine."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from fitting.separable import Optimum

# A squared column keeps less than this of itself when the others are taken out: the two tell the same story.
DEPENDENT = 1e-10
# A term that moves no pixel by more than this share of the brightest one leaves no trace.
NO_TRACE = 1e-6
# A specular term counts when leaving it out raises the cost by so many noise variances for each of its unknowns.
SIGNIFICANT = 10.0
# An exponent whose relative standard error is larger says nothing but its order of magnitude.
LOOSEST = 1.0

TERMS = ("k_a", "k_d", "k_s")


class Uncertainty(NamedTuple):
    """Standard errors, and what is not determined.

    Attributes:
        noise: standard deviation of the residual, (C,), never below what rounding alone gives.
        x_error: of the engine's coefficients x_a, x_d, x_s, (3, C); for one at its bound, that which it would have if
            the bound were not there. Infinite where the picture does not determine it.
        n_error: of n; infinite where the picture does not determine it.
        undetermined: why, by parameter: "n", "k_s", or "k_d[2]" for one channel.
    """

    noise: Float[np.ndarray, " C"]
    x_error: Float[np.ndarray, "3 C"]
    n_error: float
    undetermined: dict[str, str]


def uncertainty(
    optimum: Optimum,
    free: np.ndarray,
    rounding: np.ndarray,
    brightest: np.ndarray,
    *,
    specular: bool,
    n_range: tuple[float, float],
    visible: float,
) -> Uncertainty:
    """Errors of an optimum.

    The covariance is H⁻¹ (Σ_c σ_c² J_cᵀJ_c) H⁻¹ with the noise σ_c of each channel: channels share n but not their noise.

    Args:
        optimum: of the engine.
        free: which coefficients the light reaches, (3, C).
        rounding: standard deviation of a value's rounding, (C,).
        brightest: largest value of the picture, (C,).
        specular: whether the model has a lobe.
        n_range: bounds of the search.
        visible: largest value of the specular term in the picture, over that of the picture.
    """
    channels = optimum.x.shape[1]
    degrees = np.maximum(optimum.pixels - np.count_nonzero(optimum.x > 0, axis=0), 1)
    noise = np.sqrt(np.maximum(optimum.cost / degrees, rounding**2))
    undetermined: dict[str, str] = {}
    if specular:
        reason = _without_trace(optimum, noise, visible)
        if reason:
            undetermined["n"] = undetermined["k_s"] = reason
    known = free.copy()
    known[2] &= specular and "k_s" not in undetermined
    _name_unlit(free, specular, undetermined)
    _name_dependent(optimum, known, undetermined)
    x_error, n_error = _errors(optimum, known, noise)
    for term, channel in np.argwhere(known):
        loose = x_error[term, channel] ** 2 * optimum.gram[channel, term, term] > _square(optimum, channel, brightest)
        if loose:
            name = f"{TERMS[term]}[{channel}]"
            undetermined.setdefault(name, "its error is larger than the whole picture")
            x_error[term, channel] = np.inf
    if specular and "n" not in undetermined:
        if n_error > LOOSEST * optimum.n:
            undetermined["n"] = "the highlight fits as well with any exponent near"
        elif optimum.n >= n_range[1] * (1 - 1e-9):
            undetermined["n"] = f"the highlight is narrower than a pixel shows, n is {n_range[1]:g} or more"
    if "n" in undetermined:
        n_error = np.inf
    if channels == 1:
        undetermined = {name.removesuffix("[0]"): reason for name, reason in undetermined.items()}
    return Uncertainty(noise, x_error, n_error, undetermined)


def _square(optimum: Optimum, channel: int, brightest: np.ndarray) -> float:
    return float(max(optimum.square[channel], brightest[channel] ** 2))


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
            left -= cross @ np.linalg.lstsq(gram[np.ix_(others, others)], cross, rcond=DEPENDENT)[0]
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


def _name_dependent(optimum: Optimum, known: np.ndarray, undetermined: dict[str, str]) -> None:
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
        if value[0] > DEPENDENT:
            continue
        tied = [terms[i] for i in np.flatnonzero(np.abs(vector[:, 0]) > 0.1)]
        names = " and ".join(TERMS[term] for term in tied)
        for term in tied:
            known[term, channel] = False
            undetermined[f"{TERMS[term]}[{channel}]"] = f"only a sum of {names} is determined"


def _errors(optimum: Optimum, known: np.ndarray, noise: np.ndarray) -> tuple[np.ndarray, float]:
    """Standard errors of x and n, each channel's coefficients eliminated from the shared n."""
    channels = known.shape[1]
    x_error = np.full((3, channels), np.inf)
    hessian = optimum.gauss_newton
    information, spread = 0.0, 0.0
    along, inverses = [], []
    for channel in range(channels):
        active = [term for term in range(3) if known[term, channel] and optimum.x[term, channel] > 0]
        gram = hessian[channel][np.ix_(active, active)]
        inverse = np.linalg.pinv(gram, rcond=1e-14, hermitian=True) if active else np.zeros((0, 0))
        cross = hessian[channel][active, 3]
        along.append((active, inverse @ cross))
        inverses.append(inverse)
        left = max(hessian[channel][3, 3] - cross @ inverse @ cross, 0.0)
        information += left
        spread += noise[channel] ** 2 * left
    has_n = information > DEPENDENT * np.sum(hessian[:, 3, 3]) and information > 0
    n_variance = spread / information**2 if has_n else np.inf
    for channel in range(channels):
        active, slope = along[channel]
        for i, term in enumerate(active):
            variance = noise[channel] ** 2 * inverses[channel][i, i]
            if optimum.x[2, channel] > 0 and slope[i] != 0:
                variance += slope[i] ** 2 * n_variance
            x_error[term, channel] = np.sqrt(variance)
        for term in np.flatnonzero(known[:, channel] & (optimum.x[:, channel] == 0)):
            both = [*active, term]
            gram = hessian[channel][np.ix_(both, both)]
            inverse = np.linalg.pinv(gram, rcond=1e-14, hermitian=True)
            x_error[term, channel] = noise[channel] * np.sqrt(max(inverse[-1, -1], 0.0))
    return x_error, float(np.sqrt(n_variance))
