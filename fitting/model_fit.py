"""One model fitted to the pictures, in the units of the solver."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

import brdf
from fitting.solver.normal_equations import Picture
from fitting.solver.profile import Optimum
from fitting.solver.tied import NormalEquations


class Evidence(NamedTuple):
    """What rounded values say, as least squares with weights would: the noise of each is 1.

    Attributes:
        pictures: the pixels that say something, with working targets and weights, in double precision.
        optimum: most likely, with the sums of these.
        noise: before rounding, standard deviation in codes.
        value: logarithm of the likelihood.
        places: of each picture the index of its pixels in the whole one, row by row, and the width of that.
        widening: what to multiply the errors of x_a, x_d, x_s, channel after channel, and n by.
        together: normal equations of all channels at the optimum, where these err together; see
            `fitting.channel_errors`.
        precision: W there, (C, C).
        scores: of each picture at the noise, of whose values few say something: by radiance, with their information and
            the place of their pixels. The pictures are at the noise at which most is told.
        light: the noise in light, of the middle one of these values.
        completed: the pictures with, in the place of a value with one end, what is to be expected of it: the mean of
            these errors is none (generalised residuals; Gourieroux et al., J. Econometrics 34 (1987) 5).
    """

    pictures: Sequence[Picture]
    optimum: Optimum
    noise: float
    value: float
    places: Sequence[tuple[Int[np.ndarray, " P"], int]]
    widening: Float[np.ndarray, " #U"]
    together: NormalEquations | None = None
    precision: Float[np.ndarray, "C C"] | None = None
    scores: Sequence[tuple[Float[np.ndarray, "P C"], Float[np.ndarray, "P C"], tuple[np.ndarray, int]]] = ()
    light: float = np.inf
    completed: Sequence[Picture] = ()

    @property
    def normal(self) -> NormalEquations:
        """Of all channels, by x_a, x_d, x_s, channel after channel, and n."""
        return self.optimum.normal() if self.together is None else self.together


N_RANGE = (0.1, 1e6)
"""Between which exponents is sought where nobody says."""

HELD = 1e-6
"""Of log n: nearer to a bound of its range n is held there."""


class ModelFit(NamedTuple):
    """One model fitted to the pictures.

    Attributes:
        model: its class.
        pictures: with the weights of the fit.
        optimum: of the search.
        free: which coefficients could be above 0, (3, C).
        n_range: between which exponents the optimum was searched.
        tied: x_s is a common factor times this, (C,); None where the channels are independent.
        noise_factor: see `fitting.solver.losses.reweight`.
        capped: k_d + k_s is held at 1 in some channel.
        evidence: what rounded values say; None where least squares is the whole answer.
        owner: of which picture each of ``pictures`` is, which may be a band of it.
        moved: by how much each of some causes may have moved x_a, x_d, x_s, channel after channel, and n, beside what
            pixels leave.
        dropped: the same of terms that were left out.
        copies: the channels are copies of each other.
    """

    model: type[brdf.Material]
    pictures: Sequence[Picture]
    optimum: Optimum
    free: Bool[np.ndarray, "3 C"]
    n_range: tuple[float, float]
    tied: Float[np.ndarray, " C"] | None = None
    noise_factor: float = 1.0
    capped: bool = False
    evidence: Evidence | None = None
    owner: Sequence[int] = ()
    moved: Sequence[Float[np.ndarray, " U"]] = ()
    dropped: Sequence[Float[np.ndarray, " U"]] = ()
    copies: bool = False

    def held(self, n_range: tuple[float, float]) -> str:
        """Why n is none of the pixels': a bound that the user set holds it; empty where none does."""
        bounds = [one for one in n_range if one not in N_RANGE and abs(np.log(self.optimum.n / one)) < HELD]
        return f"it is held at {bounds[0]:g}, a bound of n_range" if bounds else ""

    @property
    def single(self) -> bool:
        """Whether the pixels are float32."""
        return any(np.dtype(picture.target.dtype) == np.float32 for picture in self.pictures)

    @property
    def cost(self) -> float:
        """Sum of weighted squared residuals."""
        return float(np.sum(self.optimum.cost))

    @property
    def residual(self) -> float:
        """Root mean square of the residual over that of the picture."""
        return float(np.sqrt(self.cost / np.sum(self.optimum.square)))
