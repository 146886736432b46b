"""The parts of the separable engine: sums, the exact solve, the subsample, the last correction."""

import jax
import numpy as np
import pytest
from engine_pictures import best_at, cost_of, picture
from scipy.optimize import nnls

from fitting.solver.nnls import nonnegative_minima
from fitting.solver.normal_equations import Picture, sums
from fitting.solver.refinement import Point, gauss_newton, problem_of
from fitting.solver.subsample import subsample


@pytest.mark.parametrize("columns", [0, 1, 2])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_sums_are_those_of_numpy(columns, dtype):
    """Ragged blocks too; float32 products are summed in blocks, so they are good to a few 1e-7."""
    one = picture(400, noise=0.1, dtype=dtype).pixels(lambda a: a[:100_003])
    rng = np.random.default_rng(0)
    one = Picture(one.target, one.diffuse, one.lobe, rng.uniform(0, 1, one.target.shape[0]).astype(dtype))
    log_n, reference = np.log([40.0, 45.0])[:columns], rng.uniform(0, 0.3, (3, 3))
    with jax.enable_x64(True):
        found = sums([one], log_n, reference)
    log_cos, gate = np.asarray(one.lobe.log_cos, float), np.asarray(one.lobe.weight, float)[:, 0]
    lobes = [gate * np.exp(np.exp(at) * log_cos) for at in log_n]
    slopes = [lobe * log_cos * np.exp(at) for lobe, at in zip(lobes, log_n, strict=True)]
    basis = [np.ones_like(gate), np.asarray(one.diffuse, float)[:, 0], *lobes[:1], *slopes[:1]]
    if columns == 2:
        basis += [lobes[1] - lobes[0] - (log_n[1] - log_n[0]) * slopes[0], slopes[1] - slopes[0]]
    basis = np.stack(basis)
    known = np.stack([*basis[:2], *basis[2:3]])
    residual = np.asarray(one.target, float).T - reference[:, : len(known)] @ known
    weight = np.asarray(one.weight, float)
    scale = np.sqrt(np.sum(weight * basis**2, axis=1))
    accuracy = 1e-6 if dtype == np.float32 else 1e-12
    gram = (weight * basis) @ basis.T / scale[:, None] / scale
    # The two last columns of a bracket are small differences, and keep as many digits as their pixels have.
    loose = 300 if columns == 2 else 1
    np.testing.assert_allclose(
        found.gram[0, : len(basis), : len(basis)] / scale[:, None] / scale, gram, atol=loose * accuracy
    )
    size = np.sqrt(np.sum(weight * residual**2, axis=1))
    product = (weight * residual) @ basis.T / scale / size[:, None]
    np.testing.assert_allclose(found.product[:, : len(basis)] / scale / size[:, None], product, atol=loose * accuracy)
    np.testing.assert_allclose(found.square, size**2, rtol=10 * accuracy)


def test_nonnegative_solver_against_scipy():
    rng = np.random.default_rng(0)
    columns = rng.standard_normal((200, 20, 3))
    columns[::4, :, 1] = columns[::4, :, 0]
    columns[1::4, :, 2] = 0
    right = rng.standard_normal((200, 20))
    free = rng.random((200, 3)) < 0.8
    gram, product = np.einsum("kpi,kpj->kij", columns, columns), np.einsum("kpi,kp->ki", columns, right)
    found = nonnegative_minima(gram, product, np.zeros((200, 3)), free, 1e-12)
    for k in range(200):
        expected = nnls(columns[k] * free[k], right[k])[1]
        np.testing.assert_allclose(np.linalg.norm(columns[k] @ found[k] - right[k]), expected, rtol=1e-10)
        assert np.all(found[k][~free[k]] == 0)
        assert np.all(found[k] >= 0)


def test_subsample_keeps_the_innermost_pixels_and_the_totals():
    one = picture(512, light=(0.2, 0.1, 1.0))
    with jax.enable_x64(True):
        sample = subsample(one, 4096, 1e6)
    distance = -np.asarray(one.lobe.log_cos)
    factor = np.asarray(sample.factor)
    assert np.count_nonzero(factor) < 5200
    for octave in range(-16, 0):
        here = (distance >= 2.0**octave) & (distance < 2.0 ** (octave + 1))
        kept = -np.asarray(sample.picture.lobe.log_cos)
        kept = (kept >= 2.0**octave) & (kept < 2.0 ** (octave + 1)) & (factor > 0)
        if np.count_nonzero(here) < 100:
            assert np.count_nonzero(kept) == np.count_nonzero(here)
        else:
            # The strata are counted on a sixteenth of the pixels.
            np.testing.assert_allclose(np.sum(factor[kept]), np.count_nonzero(here), rtol=0.2)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize(
    "start",
    [
        pytest.param([[0.2, 0.0, 0.3]] * 3, id="a coefficient at 0 that should not be"),
        pytest.param([[0.05, 0.5, 3e4]] * 3, id="far from any answer"),
    ],
)
def test_the_last_correction_ends_at_a_minimum_and_knows_its_cost(dtype, start):
    one = picture(64, noise=0.01, dtype=dtype)
    with jax.enable_x64(True):
        problem = problem_of([one], (0.1, 1e6), None)._replace(tolerance=1e-14, accuracy=1e-8)
        point, about = gauss_newton(problem, Point(np.log(70.0), np.array(start), np.zeros(3)))
    n = float(np.exp(point.log_n))
    rounding = 3e-6 if dtype == np.float32 else 1e-11
    np.testing.assert_allclose(point.cost, cost_of([one], n, point.x.T), rtol=rounding)
    np.testing.assert_allclose(about.square, np.sum(np.asarray(one.target, float) ** 2, axis=0), rtol=rounding)
    for other in (0.999 * n, 1.001 * n):
        assert np.sum(point.cost) <= best_at([one], other)
