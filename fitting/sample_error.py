"""What light samples leave out, told by two counts; and about which exponents they are gone through once for all.

`fitting.budget.light_samples` finds both before all pixels are fitted.
"""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from brdf.lobes import Near
from fitting.solver.nnls import scaled_inverse

# Of log n, to either side: so far a polynomial stands for a lobe.
MOST = 0.35
# Of a lobe's peak the nearest pixel shows the exponential of this, or the lobe is tabulated relative to that.
FAINT = -20.0
# Nearer to an end of what is tabulated than this share of it, or so many errors, an exponent or its interval may lie
# beyond; of log n it is not followed farther.
CLOSE, ERRORS, FARTHEST = 0.05, 3.0, 2.0


class SampleError(NamedTuple):
    """What light samples leave out, for one model.

    Attributes:
        near: where to tabulate its lobe; None where its terms are kept.
        hessian: of x_a, x_d, x_s, channel after channel each, and log n, (U, U).
        scores: of what more samples would change, by each of two steps, and where the picture may show the lights' own
            count instead, of what that would, (K, U).
        profile: exponents, and the least cost at each by the first fit, (2, G).
        size: of both together, root mean square over pixels.
    """

    near: Near | None
    hessian: Float[np.ndarray, "U U"]
    scores: Float[np.ndarray, "K U"]
    profile: Float[np.ndarray, "2 G"]
    size: float

    def shifts(self, active: Bool[np.ndarray, " U"]) -> Float[np.ndarray, "K U"]:
        """How far off each puts the numbers, where some of them are free."""
        return self.scores @ scaled_inverse(self.hessian * np.outer(active, active))


def near_exponent(n: float, reach: float, peak: float) -> Near:
    """Where to tabulate lobes about an exponent: as far as its logarithm reaches to either side.

    ``peak`` is the logarithm of the lobe's cosine in the pixel nearest to its centre.
    """
    return Near.between(math.log(n) - reach, math.log(n) + reach, peak if n * peak < FAINT else 0.0)


def between(near: Near | None, n_range: tuple[float, float]) -> tuple[float, float]:
    """Which of some exponents are tabulated; all of them where nothing is."""
    if near is None:
        return n_range
    low, high = np.clip(np.exp(near.ends), *n_range).tolist()
    return low, high


def nearer(near: Near, n: float, error: float, n_range: tuple[float, float], peak: float, *, last: bool) -> Near | None:
    """Where to tabulate anew, after an exponent was found; None where it is well inside, or nothing else is tried.

    ``error`` is that of its logarithm, several of which are to lie inside too, for its interval.
    """
    (low, high), log_n, (least, most) = near.ends, math.log(n), map(math.log, n_range)
    reach = min(ERRORS * error, FARTHEST)
    edge = max(CLOSE * (high - low), reach)
    below = log_n < low + edge and least < low
    above = log_n > high - edge and most > high
    if not (below or above) and (near.narrow or reach > MOST):
        return None
    if last:
        return Near.between(least, most, peak) if near.narrow else None
    return near_exponent(n, max(reach / (1 - CLOSE), MOST), peak)
