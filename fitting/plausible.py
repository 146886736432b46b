"""The best plausible material: a normalised form with k >= 0 and k_d + k_s <= 1, held inside the separable solve.

The bound moves with n, since k_s is x_s over the lobe's scale(n); clipping the unbounded optimum afterwards would miss
the best n.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

import brdf
from fitting.light_colour import coefficient_factors
from fitting.solver.nnls import ROUNDING
from fitting.solver.normal_equations import Picture
from fitting.solver.profile import Optimum, search


def is_plausible(optimum: Optimum, model: type[brdf.Material], colour: Float[np.ndarray, " C"]) -> bool:
    """Whether k_d + k_s <= 1 in every channel; `brdf.check` allows 1e-6 more.

    Args:
        optimum: of the solver.
        model: class of the material.
        colour: what was taken out of the lights, (C,).
    """
    k = optimum.x / coefficient_factors(model, optimum.n, colour)
    return bool(np.all(k[1] + k[2] <= 1.0 + ROUNDING))


def fit_plausible(
    pictures: Sequence[Picture],
    optimum: Optimum,
    free: Bool[np.ndarray, "3 C"],
    model: type[brdf.Material],
    colour: Float[np.ndarray, " C"],
    n_range: tuple[float, float],
) -> Optimum:
    """The optimum under k_d + k_s <= 1; the unbounded one where that keeps the bound by itself.

    Args:
        pictures: of one material.
        optimum: without the bound.
        free: which coefficients may be above 0, (3, C).
        model: Lambert or one of the normalised forms.
        colour: what was taken out of the lights, (C,).
        n_range: bounds of the exponent.
    """
    if is_plausible(optimum, model, colour):
        return optimum

    def cap(n: float) -> Float[np.ndarray, "3 C"]:
        counts = 1.0 / coefficient_factors(model, n, colour)
        counts[0] = 0.0
        return counts

    return search(pictures, n_min=n_range[0], n_max=n_range[1], free=free, cap=cap)
