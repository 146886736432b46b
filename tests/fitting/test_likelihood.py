"""The likelihood of a rounded value against mpmath, from far tails to intervals of a millionth of the noise."""

import mpmath
import numpy as np

from fitting.likelihood import how_many_alike, interval

TOLERANCE = 1e-10


def exact(lower: float, upper: float, predicted: float, s: float) -> tuple[float, float, float]:
    """Logarithm of the probability, score and weight by their definitions, in 80 digits."""
    with mpmath.workdps(80):
        a, b = ((mpmath.mpf(end) - mpmath.mpf(predicted)) / mpmath.mpf(s) for end in (lower, upper))
        sign = 1
        if a + b < 0:
            a, b, sign = -b, -a, -1
        mass = _tail(a) - _tail(b)
        mean = (mpmath.npdf(a) - mpmath.npdf(b)) / mass
        ends = a * mpmath.npdf(a) - (0 if mpmath.isinf(b) else b * mpmath.npdf(b))
        return float(mpmath.log(mass)), float(sign * mean / s), float((mean**2 - ends / mass) / mpmath.mpf(s) ** 2)


def _tail(x: mpmath.mpf) -> mpmath.mpf:
    return mpmath.mpf(0) if x == mpmath.inf else mpmath.erfc(x / mpmath.sqrt(2)) / 2


def codes(count: int) -> np.ndarray:
    """Lower end, upper end, prediction, s: inside, at an edge, a little and far outside; open ends among them."""
    random = np.random.default_rng(0)
    rows = []
    for index in range(count):
        s, code = 10 ** random.uniform(-3, 3), random.integers(0, 256)
        predicted = [
            random.uniform(-20, 280),
            code + s * random.standard_normal(),
            code + 0.5 + 3 * s * random.standard_normal(),
            -(10 ** random.uniform(-3, 4)),
            10 ** random.uniform(0, 6),
            code - 0.5 - 10 ** random.uniform(-4, 2),
        ][index % 6]
        lower, upper = -np.inf if code == 0 else code - 0.5, np.inf if code == 255 else code + 0.5
        rows.append((lower, upper, predicted, s))
    return np.array(rows)


def test_against_mpmath():
    cases = codes(600)
    for case, row in zip(cases, np.stack(interval(*cases.T), axis=1), strict=True):
        scale = np.array([1.0, 1 / case[3], 1 / case[3] ** 2])
        right = np.array(exact(*case))
        assert np.all(np.abs(row - right) <= TOLERANCE * np.maximum(np.abs(right), 1e-10 * scale)), case


def test_finite_whatever_is_predicted():
    size = 10.0 ** np.arange(-30, 31, 5)
    predicted = np.concatenate([-size, [0.0, 254.5, 255.0], size])
    ends = np.array(
        [(-np.inf, 0.5), (-0.5, 0.5), (127.5, 128.5), (254.5, np.inf), (-np.inf, np.inf), (1.0, 1.0 + 1e-6)]
    )
    noise = 10.0 ** np.arange(-3, 4)
    grid = np.meshgrid(np.arange(len(ends)), predicted, noise, indexing="ij")
    index, predicted, noise = (axis.ravel() for axis in grid)
    found = interval(*ends[index].T, predicted, noise)
    for values in found:
        assert np.all(np.isfinite(values))
    weight = found.weight * noise**2
    assert np.all((weight >= 0) & (weight <= 1 + 10 * np.finfo(float).eps))
    both_open = index == 4
    assert not np.any(found.value[both_open])
    assert not np.any(found.score[both_open])


def test_wide_noise_is_the_normal_density_with_a_twelfth_more_variance():
    """A rounding error is uniform, of variance 1/12: what Sheppard (1898) corrects for."""
    offset = np.linspace(-30, 30, 7)
    rounded = interval(offset - 0.5, offset + 0.5, np.zeros(7), np.full(7, 20.0))
    variance = 400 + 1 / 12
    plain = -0.5 * (offset**2 / variance + np.log(2 * np.pi * variance)), offset / variance, np.full(7, 1 / variance)
    for one, other in zip(rounded, plain, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-6, atol=1e-12)


def test_score_and_weight_are_derivatives():
    for case in codes(12):
        lower, upper, predicted, s = (mpmath.mpf(value) for value in case)
        with mpmath.workdps(80):

            def value(z, lower=lower, upper=upper, s=s):
                return mpmath.log(mpmath.ncdf((upper - z) / s) - mpmath.ncdf((lower - z) / s))

            if abs(predicted - lower) < 8 * s or abs(predicted - upper) < 8 * s:
                slopes = [float(mpmath.diff(value, predicted, order)) for order in (1, 2)]
                _, score, weight = exact(*case)
                np.testing.assert_allclose([score, weight], [slopes[0], -slopes[1]], rtol=1e-9)


def test_predictions_beyond_all_codes_are_counted():
    """Of a highlight whose top is clipped Newton's method may try a k_s without bounds; integers overflowed."""
    shown = np.append(np.full(500, 0.25), np.geomspace(1, 1e30, 50))
    np.testing.assert_array_equal(how_many_alike(shown), np.repeat([500, 0], [500, 50]))
