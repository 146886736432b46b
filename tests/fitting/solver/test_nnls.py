"""Non-negative least squares against SciPy."""

import numpy as np
import pytest
from scipy import optimize

from fitting.solver.nnls import nonnegative_minimum


@pytest.mark.parametrize("seed", range(5))
def test_the_minimum_above_zero_is_that_of_scipy(seed: int):
    random = np.random.default_rng(seed)
    columns, target = random.standard_normal((30, 6)), random.standard_normal(30)
    signed = np.array([False, False, True, False, True, False])
    # A signed unknown is the difference of two that are not.
    doubled = np.concatenate([columns, -columns[:, signed]], axis=1)
    expected, _ = optimize.nnls(doubled, target)
    expected[:6][signed] -= expected[6:]
    found = nonnegative_minimum(columns.T @ columns, columns.T @ target, signed)
    assert found == pytest.approx(expected[:6], abs=1e-10)


def test_columns_of_nothing_stay_out_of_the_minimum():
    gram, product = np.diag([2.0, 0.0, 1e-320]), np.array([1.0, 0.0, 1e-300])
    assert nonnegative_minimum(gram, product, np.zeros(3, bool)) == pytest.approx([0.5, 0, 0])
