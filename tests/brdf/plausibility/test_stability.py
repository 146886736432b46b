"""The stability map: float32 holds, and every derivative is finite, over exponent and angle, for every model."""

import numpy as np
import pytest

from benchmarks.stability import StabilityMap, plot_stability, stability_map
from brdf.models import MODELS


@pytest.mark.parametrize("model", MODELS.values())
def test_float32_holds_and_derivatives_are_finite(model):
    found = stability_map(model)
    assert found.finite.all(), [(found.exponents[i], found.angles[j]) for i, j in np.argwhere(~found.finite)]
    usual = (found.exponents >= 1) & (found.exponents <= 1e6)
    assert found.error[usual].max() < 1e-5
    # n < 1 is steep at R.V = 0, and n = 1e8 is a hundred times beyond the contract
    assert found.error.max() < 1e-3


def test_stability_picture_has_a_panel_for_each_map():
    exponents, angles = np.array([1.0, 1e6]), np.array([0.0, 45.0, 90.0])
    finite = np.ones((2, 3), bool)
    holds = StabilityMap("phong", exponents, angles, np.full((2, 3), 1e-7), finite)
    fails = StabilityMap("blinn-phong", exponents, angles, np.full((2, 3), 1e-2), finite & (angles < 90))
    figure = plot_stability([holds, fails])
    titles = [axes.get_title() for axes in figure.axes[:2]]
    assert titles == ["phong\nall derivatives finite", "blinn-phong\n2 not finite"]
