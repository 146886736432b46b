"""Normal equations of all channels at once, for what the channels share: the exponent, a grey k_s.

The search solves channel by channel. Where one coefficient serves all channels, or a smaller model is to be tried, the
channels' sums are gathered here into one system; no pixel is touched for that.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

# Of the largest of a channel.
LEAST_VARIANCE = 1e-10


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
    gram: Float[np.ndarray, "C 4 4"] | Float[np.ndarray, "C C 4 4"],
    product: Float[np.ndarray, "C 4"],
    square: Float[np.ndarray, " C"],
    x_s: Float[np.ndarray, " C"],
    variance: Float[np.ndarray, " C"] | float = 1.0,
) -> NormalEquations:
    """Gather the channels' products of ambient, diffuse, lobe and derivative, which x_s multiplies, by their noise.

    They are those of a channel, or of any two where these err together.
    """
    channels = x_s.size
    variance = np.broadcast_to(variance, channels)
    # A black channel may have no noise at all, and still leaves the others their digits.
    variance = np.maximum(variance, LEAST_VARIANCE * np.max(variance))
    columns = np.zeros((channels, 4, 3 * channels + 1))
    np.put_along_axis(columns, places_of(channels)[:, :, None], 1.0, axis=2)
    columns[:, 3] *= x_s[:, None]
    rows = columns.swapaxes(1, 2) / variance[:, None, None]
    whole = rows @ gram @ columns if gram.ndim == 3 else rows[:, None] @ gram @ columns
    right = (rows @ product[..., None])[..., 0]
    return NormalEquations(
        whole.reshape(-1, *whole.shape[-2:]).sum(axis=0), right.sum(axis=0), float(np.sum(square / variance))
    )


def places_of(channels: int) -> Int[np.ndarray, "C 4"]:
    """Where x_a, x_d, x_s of each channel and the shift of n stand among the unknowns of all."""
    own = np.arange(3 * channels).reshape(3, channels)
    return np.vstack([own, np.full(channels, 3 * channels)]).T


def design_of(free: Bool[np.ndarray, "3 C"], tied: Float[np.ndarray, " C"] | None) -> Float[np.ndarray, "U V"]:
    """Columns: what each unknown of a smaller model moves; the last one moves n, if any x_s is free.

    Where x_s is a common factor times ``tied`` the factor is the last but one.
    """
    identity = np.eye(free.size + 1)
    if tied is None:
        return identity[:, np.append(free.ravel(), free[2].any())]
    together = np.concatenate([np.zeros(2 * tied.size), tied * free[2], [0.0]])
    chosen = np.append(free[:2].ravel(), np.zeros(tied.size + 1, bool))
    return np.column_stack([identity[:, chosen], together, identity[:, -1]])
