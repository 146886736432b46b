"""Small dense normal equations over all channels at once, for what the channels share: the exponent, a grey k_s.

The engine solves channel by channel. Where one coefficient serves all channels, or a smaller model is to be tried, the
channels' sums are gathered here into one system; no pixel is touched for that.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float

from fitting.solver.nnls import nonnegative_minimum
from fitting.solver.normal_equations import Picture, sums
from fitting.solver.profile import Optimum

MOST_STEPS = 8


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
    variance: Float[np.ndarray, " C"],
) -> NormalEquations:
    """Gather the channels.

    Args:
        gram: of ambient, diffuse, lobe, derivative.
        product: of these with the target.
        square: of the target.
        x_s: what multiplies the derivative.
        variance: of each channel's noise.
    """
    channels = variance.size
    whole, right = np.zeros((3 * channels + 1,) * 2), np.zeros(3 * channels + 1)
    scale = np.ones((channels, 4))
    scale[:, 3] = x_s
    for c in range(channels):
        place = [c, channels + c, 2 * channels + c, 3 * channels]
        whole[np.ix_(place, place)] += gram[c] * np.outer(scale[c], scale[c]) / variance[c]
        right[place] += product[c] * scale[c] / variance[c]
    return NormalEquations(whole, right, float(np.sum(square / variance)))


def design_of(free: Bool[np.ndarray, "3 C"], tied: Float[np.ndarray, " C"] | None) -> Float[np.ndarray, "U V"]:
    """Columns: what each unknown of a smaller model moves; the last one moves n, if any x_s is free.

    Args:
        free: which coefficients it has.
        tied: x_s is a common factor times this, (C,); None where the channels are independent.
    """
    if tied is not None:
        return grey_design(free, tied)
    return np.eye(free.size + 1)[:, np.append(free.ravel(), free[2].any())]


def grey_design(free: Bool[np.ndarray, "3 C"], tied: Float[np.ndarray, " C"]) -> Float[np.ndarray, "U V"]:
    """Columns: x_a and x_d of each channel where free, the common factor of x_s, the shift of n.

    Args:
        free: which coefficients the model has.
        tied: what the common factor is multiplied by in each channel.
    """
    channels = free.shape[1]
    identity = np.eye(free.size + 1)
    chosen = np.append(free[:2].ravel(), np.zeros(channels + 1, bool))
    together = np.concatenate([np.zeros(2 * channels), tied * free[2], [0.0]])
    return np.column_stack([identity[:, chosen], together, identity[:, -1]])


def fit_tied(
    pictures: Sequence[Picture],
    optimum: Optimum,
    free: Bool[np.ndarray, "3 C"],
    tied: Float[np.ndarray, " C"],
    n_range: tuple[float, float],
    *,
    single: bool,
) -> Optimum:
    """The optimum with one specular coefficient for all channels, from that with one for each: Gauss-Newton.

    Args:
        pictures: as they were searched.
        optimum: of the search with the same ``free``.
        free: which coefficients may be above 0.
        tied: x_s is a common factor times this, (C,).
        n_range: bounds of n.
        single: whether the pixels are float32.
    """
    tied = np.where(free[2], tied, 0.0)
    design = grey_design(free, tied)
    channels = tied.size
    signed = np.zeros(design.shape[1], bool)
    signed[-1] = True
    log_n, x = np.log(optimum.n), optimum.x.copy()
    x[2] = tied * (x[2] @ tied) / max(tied @ tied, np.finfo(float).tiny)
    enough = 1e-5 if single else 1e-9
    attempt = 0
    while True:
        attempt += 1
        with jax.enable_x64(True):
            parts = sums(pictures, np.array([log_n]), x.T)
        about = parts.about(np.pad(x.T, [(0, 0), (0, 1)]))
        normal = join_channels(about.gram, about.product, about.square, x[2], np.ones(channels))
        solution = design @ nonnegative_minimum(design.T @ normal.gram @ design, design.T @ normal.product, signed)
        shift = float(np.clip(solution[-1], np.log(n_range[0]) - log_n, np.log(n_range[1]) - log_n))
        reference, slope, at = x, x[2], log_n
        x, log_n = solution[:-1].reshape(3, channels), log_n + np.clip(shift, -0.5, 0.5)
        if abs(shift) <= enough or attempt == MOST_STEPS:
            break
    step = np.column_stack([(x - reference).T, (log_n - at) * slope])
    change = np.einsum("ci,cij,cj->c", step, parts.gram, step) - 2 * np.sum(step * parts.product, axis=1)
    by_n = np.array([1.0, 1.0, 1.0, np.exp(-at)])
    return Optimum(
        n=float(np.exp(log_n)),
        x=x,
        cost=np.maximum(parts.square + change, 0.0),
        pixels=about.pixels,
        gram=about.gram * by_n[:, None] * by_n,
        product=about.product * by_n,
        square=about.square,
        flat=not np.any(x[2] > 0),
        grid=optimum.grid,
        profile=optimum.profile,
        profile_sampled=optimum.profile_sampled,
        brackets=optimum.brackets,
    )
