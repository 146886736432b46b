"""Which deviations of a measured BRDF count: three losses of the literature.

| loss | sum over samples of weight times | when |
| --- | --- | --- |
| "cosine" (default) | [(f - m) cos θ_i]² | Ngan et al. 2005: what pictures under one light show; the peak rules |
| "squared" | (f - m)² | as the table stands; grazing angles count in full |
| "log" | [log(1 + f cos θ_i) - log(1 + m cos θ_i)]² | Löw et al. 2012: high dynamic range, the tails count too |

The weight is the solid angle that a sample stands for, where the table's grid says it. Negative values count in the
squared losses as they are; the logarithmic one leaves them out. `fit_brdf` leaves out angles beyond 80 degrees.
"""

from collections.abc import Callable
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from fitting.measured_result import Losses
from fitting.solver.profile import Optimum

Loss = Literal["cosine", "squared", "log"]

# Reweighting stops when the loss changes by less than this share; it takes 2 to 10 rounds.
_SETTLED = 1e-9
_MOST_ROUNDS = 50


class Samples(NamedTuple):
    """The samples that a loss looks at.

    Attributes:
        to_light: (P, 3).
        to_view: (P, 3).
        values: f_r, (P, C).
        share: solid angle, mean 1, (P,).
        positive: which values the logarithm may see, (P, C).
    """

    to_light: Float[np.ndarray, "P 3"]
    to_view: Float[np.ndarray, "P 3"]
    values: Float[np.ndarray, "P C"]
    share: Float[np.ndarray, " P"]
    positive: np.ndarray

    @property
    def cosine(self) -> Float[np.ndarray, "P 1"]:
        """N.L of each sample."""
        return self.to_light[:, 2:]


def logarithmic(
    samples: Samples,
    solve: Callable[[np.ndarray], Optimum],
    modelled: Callable[[Optimum], np.ndarray],
    start: Optimum,
) -> Optimum:
    """Least logarithmic loss by reweighting: the weighted squares have the gradient of the loss where they settle.

    With a = log(1 + f cos), b = log(1 + m cos) the slope of the loss by m is -2 (a - b) cos / (1 + m cos), that of
    weighted squares -2 w (f - m): equal for w = cos (a - b) / [(f - m) (1 + m cos)].

    Args:
        samples: that count.
        solve: the least weighted squares, by the weights of all values, (P, C).
        modelled: f_r of each sample as an optimum has it, (P, C).
        start: what to return where no round is better.
    """
    cosine = samples.cosine
    clear = np.where(samples.positive, samples.values, 0.0) * cosine
    measured = np.log1p(clear)
    # The first round's weights are the limit for a perfect model, which sees the tails that the peak would drown.
    weight = cosine * cosine / np.square(1 + clear)
    best, least = start, np.inf
    for _ in range(_MOST_ROUNDS):
        found = solve(np.where(samples.positive, samples.share[:, None] * weight, 0.0))
        model = modelled(found) * cosine
        difference = np.where(samples.positive, measured - np.log1p(model), 0.0)
        cost = float(np.sum(samples.share[:, None] * difference * difference))
        if cost >= least * (1 - _SETTLED):
            break
        best, least = found, cost
        step = clear - model
        small = np.abs(step) < 1e-9 * (1 + model)
        weight = cosine * cosine * np.where(small, 1 / (1 + model), difference / np.where(small, 1, step)) / (1 + model)
    return best


def losses_of(samples: Samples, model: Float[np.ndarray, "P C"]) -> Losses:
    """The deviation under each loss, and the share of the light that goes elsewhere.

    Args:
        samples: that count.
        model: f_r of each.
    """
    cosine, share = samples.cosine, samples.share[:, None]
    deviation = samples.values - model

    def relative(weight: np.ndarray) -> float:
        return float((np.sum(weight * deviation**2) / np.sum(weight * samples.values**2)) ** 0.5)

    positive = samples.positive
    logarithms = np.where(
        positive, np.log1p(np.where(positive, samples.values, 0) * cosine) - np.log1p(model * cosine), 0
    )
    total = np.sum(share * positive)
    return Losses(
        cosine=relative(share * cosine**2),
        squared=relative(share * np.ones_like(cosine)),
        log=float((np.sum(share * logarithms**2) / total) ** 0.5) if total > 0 else 0.0,
        misplaced=float(np.sum(share * cosine * np.abs(deviation)) / np.sum(share * cosine * np.abs(samples.values))),
    )
