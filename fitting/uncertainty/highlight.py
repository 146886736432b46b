"""What the pixels see of the highlight."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

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
        """The largest value of the specular term over that of the picture."""
        return float(np.max(x[2]) * self.largest / max(np.max(brightest), np.finfo(float).tiny))
