"""What the separable search is given and gives back: bounds, zeros, weights, channels, several pictures, no lobe."""

import jax
import numpy as np
import pytest
from engine_pictures import X, ball, best_at, cost_of, one_light_lobe, picture

from fitting.solver.normal_equations import Picture
from fitting.solver.profile import search
from fitting.solver.streams import Stream


@pytest.mark.parametrize(("dtype", "tolerance"), [(np.float32, 1e-4), (np.float64, 1e-8)])
@pytest.mark.parametrize("n", [0.3, 1.7, 30.0, 2000.0, 40000.0])
def test_recovers_what_was_rendered(n, dtype, tolerance):
    """Tolerances for a worst relative error."""
    found = search([picture(192, n, dtype=dtype)])
    np.testing.assert_allclose(found.n, n, rtol=tolerance)
    np.testing.assert_allclose(found.x, X, rtol=tolerance)
    assert not found.flat


@pytest.mark.parametrize(("n", "expected"), [(0.3, 0.5), (60.0, 20.0)])
@pytest.mark.parametrize("size", [48, 160])
def test_exponent_at_its_bound(n, expected, size):
    one = picture(size, n, noise=0.01)
    found = search([one], n_range=(0.5, 20.0))
    assert found.n == expected
    np.testing.assert_allclose(np.sum(found.cost), best_at([one], expected), rtol=1e-9)


def test_exponent_given():
    one = picture(48, 30.0, noise=0.01)
    found = search([one], n_range=(20.0, 20.0))
    np.testing.assert_allclose(found.n, 20.0, rtol=1e-14)
    np.testing.assert_allclose(np.sum(found.cost), best_at([one], 20.0), rtol=1e-10)


@pytest.mark.parametrize("size", [40, 120])
def test_no_specular_trace(size):
    x = X * np.array([[1], [1], [0]])
    one = picture(size, x=x)
    found = search([one])
    assert np.sum(found.cost) < 1e-24 * np.sum(one.target**2)
    np.testing.assert_allclose(found.x[:2], x[:2], atol=1e-12)
    # A target below the diffuse model where the lobe would be: the coefficient is exactly 0, and n without meaning.
    dip = picture(size, x=X * np.array([[1], [1], [-0.1]]))
    found = search([dip], n_range=(30.0, 1e3))
    assert found.flat
    assert np.all(found.x[2] == 0)
    assert np.isfinite(found.n)


def test_unknowns_at_zero_are_exactly_zero():
    x = np.array([[0.0, 0.1, 0.0], [0.4, 0.0, 0.3], [0.2, 0.3, 0.0]])
    found = search([picture(64, x=x, noise=0.0)])
    np.testing.assert_allclose(found.x, x, atol=1e-12)
    rng = np.random.default_rng(3)
    one = picture(64, x=x)
    noisy = Picture(one.target - 0.02 + 0.01 * rng.standard_normal(one.target.shape), one.diffuse, one.lobe)
    found = search([noisy])
    assert np.all(found.x[0, [0, 2]] == 0)
    np.testing.assert_allclose(np.sum(found.cost), best_at([noisy], found.n), rtol=1e-10)


def test_all_zero_target_and_one_zero_channel():
    found = search([picture(64, x=np.zeros((3, 3)))])
    assert found.flat
    assert not np.any(found.x)
    assert not np.any(found.cost)
    x = X * np.array([1, 0, 1])
    found = search([picture(64, x=x)])
    np.testing.assert_allclose(found.x, x, atol=1e-12)
    assert not np.any(found.x[:, 1])


@pytest.mark.parametrize(("size", "per_channel"), [(48, True), (128, False)])
def test_pixels_of_weight_zero_may_hold_anything(size, per_channel):
    rng = np.random.default_rng(1)
    one = picture(size, noise=0.02)
    weight = rng.uniform(0.5, 2, one.target.shape if per_channel else one.target.shape[:1])
    out = rng.random(weight.shape[0]) < 0.3
    weight[out] = 0
    target = np.array(one.target)
    target[out] = np.nan
    spoilt = Picture(target, one.diffuse, one.lobe, weight)
    found = search([spoilt])
    kept = Picture(target[~out], one.diffuse[~out], one.lobe.pixels(lambda a: a[~out]), weight[~out])
    alone = search([kept])
    np.testing.assert_allclose(found.n, alone.n, rtol=1e-8)
    np.testing.assert_allclose(found.x, alone.x, rtol=1e-8)
    np.testing.assert_allclose(found.cost, cost_of([kept], found.n, found.x), rtol=1e-10)
    assert np.all(found.pixels == np.count_nonzero(~out))


@pytest.mark.parametrize(("channels", "coloured"), [(1, False), (3, True), (5, False), (31, True)])
def test_channels_and_coloured_lights(channels, coloured):
    rng = np.random.default_rng(channels)
    (cosine,), (log_cos,), (gate,) = ball(96, [(0.5, 0.6, 0.7)])
    colour = rng.uniform(0.5, 1.5, channels) if coloured else np.ones(1)
    diffuse, weight = cosine[:, None] * colour, gate[:, None] * colour**2
    x = rng.uniform(0.05, 0.5, (3, channels))
    target = x[0] + x[1] * diffuse + x[2] * weight * np.exp(60.0 * log_cos)[:, None]
    found = search([Picture(target, diffuse, one_light_lobe(log_cos, weight))])
    np.testing.assert_allclose(found.n, 60.0, rtol=1e-9)
    np.testing.assert_allclose(found.x, x, rtol=1e-9)


def test_many_pictures_are_one_sum():
    lights = [(0.5, 0.6, 0.7), (-0.5, 0.2, 0.9), (0.1, -0.7, 0.8)]
    each = [picture(64, 150.0, noise=0.01, light=light, seed=i) for i, light in enumerate(lights)]
    each[1] = Picture(each[1].target - X[0], each[1].diffuse, each[1].lobe, ambient=np.zeros(1))
    found = search(each)
    np.testing.assert_allclose(found.cost, cost_of(each, found.n, found.x), rtol=1e-10)
    dense = min(best_at(each, n) for n in found.n * np.geomspace(0.98, 1.02, 81))
    assert np.sum(found.cost) <= dense * (1 + 1e-9)
    np.testing.assert_allclose(found.x, X, atol=0.01)


def test_tiles_from_a_source_that_loads_each_give_the_same():
    whole = picture(192, 300.0, noise=0.02)
    rows = np.array_split(np.arange(whole.target.shape[0]), 5)

    loaded = []

    def load(i: int) -> Picture:
        loaded.append(i)
        return whole.pixels(lambda a: a[rows[i]])

    found, at_once = search(Stream(load, len(rows))), search([whole])
    np.testing.assert_allclose(found.n, at_once.n, rtol=1e-9)
    np.testing.assert_allclose(found.x, at_once.x, rtol=1e-9)
    # Shape, subsample, one bracket or two, one correction or two.
    assert len(loaded) <= 6 * len(rows)


def test_free_holds_unknowns_at_zero():
    free = np.array([[False, True, True], [True] * 3, [True, False, True]])
    one = picture(64, noise=0.02)
    found = search([one], free=free)
    assert np.all(found.x[~free] == 0)
    assert np.all(found.x[free] > 0)
    np.testing.assert_allclose(found.cost, cost_of([one], found.n, found.x), rtol=1e-10)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_without_a_lobe_is_linear_least_squares(dtype):
    one = picture(96, noise=0.05, dtype=dtype)
    found = search([one], free=np.array([[True] * 3, [True] * 3, [False] * 3]))
    columns = np.stack([np.ones(one.diffuse.shape[0]), one.diffuse[:, 0].astype(float)], axis=1)
    expected, square, *_ = np.linalg.lstsq(columns, one.target.astype(float), rcond=None)
    accuracy = 1e-5 if dtype == np.float32 else 1e-11
    np.testing.assert_allclose(found.x[:2], expected, rtol=accuracy)
    np.testing.assert_allclose(found.cost, square, rtol=accuracy)
    assert not np.any(found.x[2])
    alone = search([one], free=np.array([[True] * 3, [False] * 3, [False] * 3]))
    np.testing.assert_allclose(alone.x[0], np.mean(one.target.astype(float), axis=0), rtol=accuracy)


def test_dependent_columns():
    """A plane facing the light: ambient and diffuse cannot be told apart, and the fit is no worse for it."""
    one = picture(64, noise=0.01)
    plane = Picture(one.target, np.full_like(one.diffuse, 0.8), one.lobe)
    found = search([plane])
    np.testing.assert_allclose(np.sum(found.cost), best_at([plane], found.n), rtol=1e-9)


def test_what_comes_with_the_optimum():
    one = picture(40, noise=0.02)
    found = search([one])
    with jax.enable_x64(True):
        value, slope = (np.asarray(a)[:, 0] for a in one.lobe(np.float64(found.n)))
    basis = np.stack([np.ones_like(value), one.diffuse[:, 0], value, slope])
    np.testing.assert_allclose(found.gram, np.broadcast_to(basis @ basis.T, (3, 4, 4)), rtol=1e-6)
    np.testing.assert_allclose(found.product, one.target.T @ basis.T, rtol=1e-6)
    np.testing.assert_allclose(found.square, np.sum(one.target**2, axis=0), rtol=1e-12)
    assert np.all(found.pixels == one.target.shape[0])
    assert found.grid.shape == found.profile.shape
    np.testing.assert_allclose(found.profile[20], best_at([one], found.grid[20]), rtol=1e-9)
    np.testing.assert_allclose(found.gauss_newton[:, 3, 3], found.x[2] ** 2 * found.gram[:, 3, 3])
