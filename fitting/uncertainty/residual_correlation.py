"""What a residual gives away: neighbours that err alike, and noise that grows with brightness."""

from collections.abc import Sequence
from typing import Any, NamedTuple, cast

import numpy as np
from jaxtyping import Float

from fitting.solver.normal_equations import Picture
from fitting.solver.profile import Optimum
from fitting.uncertainty.noise_model import noise_model

# Pairs of neighbours that are looked at in all: a correlation is then known to 1 %.
PAIRS = 8192
FEWEST_PAIRS = 256
MOST_PICTURES = 16
# A correlation above this, and above so many of its own standard errors, is structure.
CORRELATED, DEVIATIONS = 0.1, 5.0
NEGLIGIBLE = 1e-6


class ResidualCorrelation(NamedTuple):
    """How residuals of neighbouring pixels go together.

    Attributes:
        correlation: of neighbours, over all channels.
        significant: it is too large for chance, and large enough to matter.
        noise: how the noise grows with brightness, see `fitting.uncertainty.noise_model`; None where it does not.
    """

    correlation: float
    significant: bool
    noise: Float[np.ndarray, "C 3"] | None = None

    @property
    def inflation(self) -> float:
        """By what factor errors from the formula are too small, at least.

        That of a smooth basis image under noise whose correlation falls off exponentially along rows and columns.
        """
        if not self.significant:
            return 1.0
        correlation = min(self.correlation, 0.999)
        return (1 + correlation) / (1 - correlation)


def residual_correlation(
    pictures: Sequence[Picture], widths: Sequence[int], optimum: Optimum, rounding: Float[np.ndarray, " C"]
) -> ResidualCorrelation:
    """Correlate the residuals of some neighbouring pixels.

    Args:
        pictures: pixels row by row.
        widths: of the whole of each.
        optimum: what was fitted.
        rounding: standard deviation of a value's rounding, (C,): a residual no larger is not looked at.
    """
    noise = np.sqrt(optimum.cost / np.maximum(optimum.pixels, 1))
    channels = noise > 2 * rounding
    if not channels.any():
        return ResidualCorrelation(0.0, False)
    some = range(0, len(pictures), -(-len(pictures) // MOST_PICTURES))
    most = max(FEWEST_PAIRS, PAIRS // len(some))
    products, count, residuals, values = np.zeros((3, noise.size)), 0, [], []
    for index in some:
        picture = pictures[index]
        first, second = _neighbours(picture.counts.reshape(-1, widths[index]), most)
        count += first.size
        pairs = np.zeros((2, most), np.int32)
        pairs[:, : first.size] = first, second
        residual, root, value = _residuals(picture, pairs, optimum.n, optimum.x)
        scaled = np.asarray(residual, np.float64) * np.sqrt(np.asarray(root, np.float64))
        one, other = scaled.reshape(2, most, -1)[:, : first.size]
        products += np.stack([np.sum(one * other, axis=0), np.sum(one * one, axis=0), np.sum(other * other, axis=0)])
        residuals.append(one)
        values.append(np.asarray(value, np.float64)[: first.size])
    cross, left, right = products @ np.where(channels, noise, np.inf) ** -2.0
    correlation = float(cross / max(np.sqrt(left * right), np.finfo(float).tiny))
    least = max(CORRELATED, DEVIATIONS / np.sqrt(max(count, 1)))
    model = noise_model(np.concatenate(residuals), np.concatenate(values), rounding)
    return ResidualCorrelation(correlation, correlation > least, model)


def _neighbours(counted: np.ndarray, most: int) -> tuple[np.ndarray, np.ndarray]:
    """Flat indices of pairs that lie side by side, or one above the other, and both count."""
    height, width = counted.shape
    stride = 2 * max(1, round(2 * np.sqrt(counted.size / most) / 3))
    rows, columns = np.arange(0, height, stride), np.arange(0, width, stride)
    row, column = np.nonzero(counted[rows, :-1] & counted[rows, 1:])
    beside = rows[row] * width + column
    row, column = np.nonzero(counted[:-1, columns] & counted[1:, columns])
    above = row * width + columns[column]
    first, second = np.concatenate([beside, above]), np.concatenate([beside + 1, above + width])
    if first.size > most:
        chosen = np.linspace(0, first.size - 1, most).astype(int)
        first, second = first[chosen], second[chosen]
    return first, second


def _residuals(picture: Picture, pairs: np.ndarray, n: float, x: np.ndarray) -> tuple[Any, Any, Any]:
    """Residual, weight and model of so few pixels: on the host, where nothing is compiled."""
    some = picture.on_host(pairs.ravel())
    value = 0.0 if some.lobe is None else some.lobe(cast(Any, np.float64(n)))[0]
    model = x[0] * some.ambient + x[1] * some.diffuse + x[2] * value
    return np.where(some.weights > 0, some.target - model, 0), some.weights, model


def correlation_in_rows(residuals: Sequence[Float[np.ndarray, "H W C"]], share_left: float) -> ResidualCorrelation:
    """Correlate the residuals of all neighbours in the rows of pictures.

    Args:
        residuals: 0 where a pixel does not count.
        share_left: of the picture, root mean square; up to `NEGLIGIBLE` it shows where a solver stopped.
    """
    together, alone, pairs = 0.0, 0.0, 0
    for residual in residuals:
        left, right = residual[:, :-1], residual[:, 1:]
        both = (left != 0) & (right != 0)
        together, alone = together + np.sum(left * right), alone + np.sum((left**2 + right**2)[both]) / 2
        pairs += np.count_nonzero(both)
    share = float(together / alone) if alone else 0.0
    enough = max(CORRELATED, DEVIATIONS / max(pairs, 1) ** 0.5)
    return ResidualCorrelation(share, bool(share > enough and share_left > NEGLIGIBLE))


def structure_warning(known: ResidualCorrelation) -> tuple[str, ...]:
    """What to say where neighbours err alike; nothing where they do not.

    Args:
        known: of the residual.
    """
    words = f"the residual has structure: neighbouring pixels err alike (correlation {known.correlation:.2f})"
    words = f"{words}, so model or scene are not the whole truth and the errors are too small"
    return (words,) if known.significant else ()
