"""Normal equations of all channels at once, for what the channels share: the exponent, a grey k_s.

The search solves channel by channel. Where one coefficient serves all channels, or a smaller model is to be tried, the
channels' sums are gathered here into one system; no pixel is touched for that.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float


class NormalEquations(NamedTuple):
    """Normal equations in x_a, x_d, x_s, channel after channel, and the shift of n; channels weighed by their noise.

    Attributes:
        gram: (3C + 1, 3C + 1).
        product: (3C + 1,).
        square: of the target.
    """

    gram: Float[np.ndarray, "U U"]
    product: Float[np.ndarray, " U"]
    square: float


def join_channels(
    gram: Float[np.ndarray, "C 4 4"],
    product: Float[np.ndarray, "C 4"],
    square: Float[np.ndarray, " C"],
    x_s: Float[np.ndarray, " C"],
    variance: Float[np.ndarray, " C"] | float = 1.0,
) -> NormalEquations:
    """Gather the channels.

    Args:
        gram: of ambient, diffuse, lobe, derivative.
        product: of these with the target.
        square: of the target.
        x_s: what multiplies the derivative.
        variance: of each channel's noise.
    """
    channels = x_s.size
    scale = np.ones((channels, 4))
    scale[:, 3] = x_s
    variance = np.broadcast_to(variance, channels)
    whole, right = np.zeros((3 * channels + 1,) * 2), np.zeros(3 * channels + 1)
    for c in range(channels):
        index = [c, channels + c, 2 * channels + c, 3 * channels]
        whole[np.ix_(index, index)] += gram[c] * np.outer(scale[c], scale[c]) / variance[c]
        right[index] += product[c] * scale[c] / variance[c]
    return NormalEquations(whole, right, float(np.sum(square / variance)))


def design_of(free: Bool[np.ndarray, "3 C"], tied: Float[np.ndarray, " C"] | None) -> Float[np.ndarray, "U V"]:
    """Columns: what each unknown of a smaller model moves; the last one moves n, if any x_s is free.

    Args:
        free: which coefficients it has.
        tied: x_s is a common factor times this, (C,), and the factor the last but one; None where the channels are
            independent.
    """
    identity = np.eye(free.size + 1)
    if tied is None:
        return identity[:, np.append(free.ravel(), free[2].any())]
    together = np.concatenate([np.zeros(2 * tied.size), tied * free[2], [0.0]])
    chosen = np.append(free[:2].ravel(), np.zeros(tied.size + 1, bool))
    return np.column_stack([identity[:, chosen], together, identity[:, -1]])
