"""The stability map: float32 holds, and every derivative is finite, over exponent and angle, for every model."""

import numpy as np
import pytest

from brdf.models import MODELS
from brdf.plausibility.stability import stability_map


@pytest.mark.parametrize("model", MODELS.values())
def test_float32_holds_and_derivatives_are_finite(model):
    found = stability_map(model)
    assert found.finite.all(), [(found.exponents[i], found.angles[j]) for i, j in np.argwhere(~found.finite)]
    usual = (found.exponents >= 1) & (found.exponents <= 1e6)
    assert found.error[usual].max() < 1e-5
    # n < 1 is steep at R.V = 0, and n = 1e8 is a hundred times beyond the contract
    assert found.error.max() < 1e-3
