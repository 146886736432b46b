"""Measured BRDFs as samples: their directions, what does not fit together, and whether they are plausible."""

import numpy as np
import pytest
from measured_files import degrees_between

import brdf
from brdf.errors import InputError
from brdf.measured.table import from_angles, from_half_angles


def test_half_angles_give_back_half_and_difference():
    random = np.random.default_rng(4)
    h, d, pd, ph = random.uniform(0, 1.5, 50), random.uniform(0, 1.5, 50), *random.uniform(0, 6.28, (2, 50))
    light, view = from_half_angles(h, d, pd, ph)
    half = light + view
    assert np.allclose(np.linalg.norm(light, axis=1), 1)
    assert np.allclose(np.linalg.norm(view, axis=1), 1)
    assert np.allclose(degrees_between(half, from_angles(h, ph)), 0, atol=1e-6)
    assert np.allclose(degrees_between(half, light), np.degrees(d))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"to_light": np.zeros((2, 3))}, "to_light: must be finite directions"),
        ({"to_view": np.ones((2, 2))}, "to_view: must be of shape"),
        ({"values": np.ones((3, 1))}, "to_light: has 2 rows for 3 samples"),
        ({"values": np.ones((2, 0))}, "values: must be of shape"),
        ({"values": "text"}, "values: must be numbers"),
        ({"values": np.full((2, 1), np.nan)}, "no finite sample"),
        ({"channels": ("a", "b")}, "channels: names 2 of 1"),
        ({"solid_angle": [1, -1]}, "solid_angle: must be"),
        ({"solid_angle": [1, 2, 3]}, "solid_angle: has 3 rows"),
    ],
)
def test_samples_that_do_not_fit(change, said):
    good = {"to_light": [[0, 0, 1], [0, 1, 1]], "to_view": [[0, 0, 1], [0, 1, 1]], "values": [[1.0], [2.0]]}
    with pytest.raises(InputError, match=said):
        brdf.MeasuredBRDF.from_samples(**(good | change))


def scattered(noise: float, skew: float, negative: bool = False) -> brdf.MeasuredBRDF:
    """A goniometer's grid over a smooth BRDF, both ways round and on both sides of the plane of incidence."""
    polar, turn = np.radians([10.0, 25.0, 40.0, 55.0]), np.radians([-120.0, -60.0, 60.0, 120.0])
    a, b, c = (x.ravel() for x in np.meshgrid(polar, polar, turn, indexing="ij"))
    values = 0.3 + 0.1 * np.cos(a) * np.cos(b) + skew * np.cos(a)
    values = values * (1 + noise * np.random.default_rng(5).standard_normal(values.shape))
    if negative:
        values[0] = -0.01
    return brdf.MeasuredBRDF.from_samples(from_angles(a, 0.0), from_angles(b, c), values)


def test_reciprocity_is_told_in_units_of_the_noise():
    plausible = brdf.check(scattered(noise=0.02, skew=0.0)).reciprocity
    assert plausible.verdict == "pass"
    assert plausible.value == pytest.approx(1.0, abs=0.35)  # 48 pairs know a median to some 20 %
    skewed = brdf.check(scattered(noise=0.001, skew=0.2)).reciprocity
    assert skewed.verdict == "fail"
    assert skewed.value > 10
    assert "times the noise" in skewed.sentence


def test_negative_values_are_reported():
    finding = brdf.check(scattered(noise=0.001, skew=0.0, negative=True)).positivity
    assert finding.verdict == "fail"
    assert finding.value == -0.01
    assert "1 of 64 values" in finding.sentence


def test_what_scattered_samples_cannot_tell_is_said():
    report = brdf.check(scattered(noise=0.0, skew=0.0))
    assert report.energy.verdict == "cannot tell"
    assert report.plausible is None
    assert report.to_json()["energy"]["value"] is None
