"""What the pixels see of the highlight."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from fitting.solver.normal_equations import Picture
from fitting.uncertainty.residual import Residual

# A highlight on fewer pixels, counted by the squares of its values, is sampled too coarsely to trust its shape.
FEW_PIXELS = 4.0
# The pixel nearest to a highlight's centre shows less than this of it: the highlight falls between pixels.
OFF_CENTRE = 0.5


class Highlight(NamedTuple):
    """What the pixels see of the highlight.

    Attributes:
        largest: value of the lobe in any pixel.
        pixels: how many carry it: the sum of its squares over the largest square, added up over pictures.
        peak: logarithm of the lobe's cosine in the pixel nearest to its centre.
        centre: how much of the lobe's peak that pixel shows, 0 to 1.
    """

    largest: float
    pixels: float
    peak: float
    centre: float

    @property
    def smaller_than_pixel(self) -> bool:
        """Too few pixels see it to tell its shape."""
        return self.pixels < FEW_PIXELS or self.centre < OFF_CENTRE

    @property
    def broad(self) -> bool:
        """More pixels see it than the four around a peak that falls between them."""
        return self.pixels > 2 * FEW_PIXELS

    def share(self, x: Float[np.ndarray, "3 C"], brightest: Float[np.ndarray, " C"]) -> float:
        """The largest value of the specular term over that of the picture.

        Args:
            x: coefficients.
            brightest: value of each channel.
        """
        return float(np.max(x[2]) * self.largest / max(np.max(brightest), np.finfo(float).tiny))


def highlight(n: float, left: Residual) -> Highlight:
    """What there is to know of a highlight.

    Args:
        n: exponent.
        left: by the fit.
    """
    return Highlight(left.largest, left.carrying, left.peak, math.exp(n * left.peak))


def nearest_peak(pictures: Sequence[Picture]) -> float:
    """Logarithm of the lobe's cosine in the pixel nearest to its centre; 0 without a lobe.

    Args:
        pictures: with or without a lobe.
    """
    return max((picture.nearest_peak for picture in pictures if picture.lobe is not None), default=0.0)
