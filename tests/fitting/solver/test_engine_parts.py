"""The parts of the separable engine: sums, the exact solve, the subsample, the last correction."""

import jax
import numpy as np
import pytest
from engine_pictures import best_at, cost_of, picture, sum_of_lobes
from scipy.optimize import nnls

from fitting.solver.nnls import nonnegative_minima
from fitting.solver.normal_equations import Picture, sums
from fitting.solver.refinement import Point, gauss_newton, problem_of
from fitting.solver.subsample import subsample


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_sums_are_those_of_numpy(dtype):
    """Ragged blocks too; float32 products are summed in blocks, so they are good to a few 1e-7."""
    one = picture(400, noise=0.1, dtype=dtype).pixels(lambda a: a[:100_003])
    rng = np.random.default_rng(0)
    one = Picture(one.target, one.diffuse, one.lobe, rng.uniform(0, 1, one.target.shape[0]).astype(dtype))
    log_n, reference = np.log([40.0, 45.0]), rng.uniform(0, 0.3, (3, 3))
    with jax.enable_x64(True):
        found = sums([one], log_n, reference)
    gate, log_cos = (np.asarray(a, float).ravel() for a in one.lobe.kept[0])
    accuracy = 1e-6 if dtype == np.float32 else 1e-12
    for at, gram_found, product_found, square_found in zip(log_n, *found[:3], strict=True):
        lobe = gate * np.exp(np.exp(at) * log_cos)
        basis = np.stack([np.ones_like(gate), np.asarray(one.diffuse, float)[:, 0], lobe, lobe * log_cos * np.exp(at)])
        residual = np.asarray(one.target, float).T - reference @ basis[:3]
        weight = np.asarray(one.weight, float)
        scale = np.sqrt(np.sum(weight * basis**2, axis=1))
        gram = (weight * basis) @ basis.T / scale[:, None] / scale
        np.testing.assert_allclose(gram_found[0] / scale[:, None] / scale, gram, atol=accuracy)
        size = np.sqrt(np.sum(weight * residual**2, axis=1))
        product = (weight * residual) @ basis.T / scale / size[:, None]
        np.testing.assert_allclose(product_found / scale / size[:, None], product, atol=accuracy)
        np.testing.assert_allclose(square_found, size**2, rtol=10 * accuracy)


@pytest.mark.parametrize("channels", [1, 3])
def test_sums_on_the_host_are_those_of_a_pass(channels):
    """Two light samples; weight and basis of all channels or of each."""
    rng = np.random.default_rng(0)
    log_cos, kept = -rng.uniform(0, 0.2, (500, 2)), rng.uniform(0, 1, (500, 2, channels))
    diffuse, weight, target = (rng.uniform(0, 1, (500, size)) for size in (channels, channels, 3))
    one = Picture(target, diffuse, sum_of_lobes(log_cos, kept), weight, ambient=np.array([0.5]))
    log_n, nothing = np.log([3.0, 40.0]), np.zeros((3, 3))
    sample = subsample([one])
    with jax.enable_x64(True):
        expected = sums([one], log_n, nothing, -sample.nearest)
    found = sample.sums(sample.lobes(log_n, -sample.nearest))
    np.testing.assert_allclose(found.gram[..., :3], expected.gram[..., :3], rtol=1e-10)
    np.testing.assert_allclose(found.product, expected.product, rtol=1e-10)
    np.testing.assert_allclose(found.square, np.broadcast_to(expected.square, found.square.shape), rtol=1e-10)


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


@pytest.mark.parametrize("weight", [None, "even", "none nearest"])
def test_the_nearest_pixel_is_one_that_counts_if_there_is_any(weight):
    one = picture(64)
    peak = np.asarray(one.lobe.peak)
    heavy = None if weight is None else np.where((weight == "even") | (peak < np.max(peak)), 1.0, 0.0)
    one = Picture(one.target, one.diffuse, one.lobe, heavy)
    assert one.nearest_peak == np.max(peak if heavy is None else peak[heavy > 0])
    assert one.pixels(lambda a: a[:0]).nearest_peak == -np.inf


def test_subsample_keeps_the_innermost_pixels_and_the_totals():
    one = picture(512, light=(0.2, 0.1, 1.0))
    with jax.enable_x64(True):
        sample = subsample([one])
    distance, (factor,) = -np.asarray(one.lobe.peak), sample.factor
    assert factor.size < 5200
    for octave in range(-16, 0):
        here = (distance >= 2.0**octave) & (distance < 2.0 ** (octave + 1))
        kept = -sample.parts[0].lobe.peak
        kept = (kept >= 2.0**octave) & (kept < 2.0 ** (octave + 1))
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
