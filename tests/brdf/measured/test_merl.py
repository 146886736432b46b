"""MERL tables: synthetic files in the published layout read back, and what is damaged is said in one line."""

import re
import struct

import numpy as np
import pytest
from measured_files import write_merl

import brdf
from brdf.errors import InputError
from brdf.measured import merl as measured_merl
from brdf.measured.table import from_angles


@pytest.fixture(scope="module")
def merl(tmp_path_factory):
    stored = np.random.default_rng(1).uniform(0, 3000, (3, 90 * 90 * 180))
    stored[1, 7] = -5.0
    return write_merl(tmp_path_factory.mktemp("merl") / "gold.binary", stored), stored


def published_lookup(stored, light, view):
    """What the database's own reader does, written from its description: one pair of directions."""
    half = (light + view) / np.linalg.norm(light + view)
    theta_h, phi_h = np.arccos(half[2]), np.arctan2(half[1], half[0])

    def turned(vector, axis, angle):
        return (
            vector * np.cos(angle)
            + np.cross(axis, vector) * np.sin(angle)
            + axis * (axis @ vector) * (1 - np.cos(angle))
        )

    difference = turned(turned(light, np.array([0, 0, 1.0]), -phi_h), np.array([0, 1.0, 0]), -theta_h)
    theta_d, phi_d = np.arccos(difference[2]), np.arctan2(difference[1], difference[0]) % np.pi
    h = int(np.sqrt(theta_h / (np.pi / 2)) * 90)
    d, p = int(theta_d / (np.pi / 2) * 90), int(phi_d / np.pi * 180)
    return stored[:, p + 180 * (d + 90 * h)] * [1 / 1500, 1.15 / 1500, 1.66 / 1500]


def test_a_merl_file_reads_back_exactly(merl):
    path, stored = merl
    table = brdf.load_measured(path)
    light, view, _ = measured_merl.grid()
    above = (light[:, 2] > 0) & (view[:, 2] > 0)
    scaled = stored.T * np.array([1 / 1500, 1.15 / 1500, 1.66 / 1500])
    assert np.array_equal(table.values, scaled[above])
    assert np.allclose(table.to_light, light[above], rtol=0, atol=1e-15)
    assert table.channels == ("red", "green", "blue")
    assert table.left_out == {"below the horizon": int(np.count_nonzero(~above))}


def test_merl_directions_and_lookup_agree_with_the_published_reader(merl):
    path, stored = merl
    table = brdf.load_measured(path)
    random = np.random.default_rng(2)
    polar, azimuth = np.arccos(random.uniform(0.1, 1, (2, 300))), random.uniform(0, 6.28, (2, 300))
    light, view = from_angles(polar[0], azimuth[0]), from_angles(polar[1], azimuth[1])
    expected = np.array([published_lookup(stored, *pair) for pair in zip(light, view, strict=True)])
    assert np.array_equal(table.evaluate(light, view), expected)
    # Every sample's own directions fall into its own entry: it stands in the middle.
    chosen = random.integers(0, len(table.values), 300)
    found = [published_lookup(stored, table.to_light[i], table.to_view[i]) for i in chosen]
    assert np.array_equal(found, table.values[chosen])


def test_merl_entries_that_were_not_measured_are_left_out(tmp_path):
    stored = np.ones((3, 90 * 90 * 180))
    stored[:, 90] = -1.0
    stored[1, 91] = -1.0  # in one channel alone, as no measurement is by chance
    table = brdf.load_measured(write_merl(tmp_path / "a.binary", stored))
    assert table.left_out["not measured"] == 2
    assert table.negative == 0
    light, view, _ = measured_merl.grid()
    assert np.array_equal(np.isnan(table.evaluate(light[89:93], view[89:93])).all(axis=1), [False, True, True, False])


def test_a_merl_file_of_the_right_size_with_a_wrong_header(tmp_path):
    path = tmp_path / "a.binary"
    with path.open("wb") as file:
        file.write(struct.pack("<3i", 90, 90, 181))
        file.truncate(12 + 3 * 8 * 90 * 90 * 180)
    with pytest.raises(InputError, match="90 x 90 x 181"):
        brdf.load_measured(path)


def test_solid_angles_of_the_merl_grid_integrate_to_the_hemispheres():
    # The mean of N.H over all pairs of directions above the horizon: by the grid, and by pairs drawn at random.
    light, view, share = measured_merl.grid()
    above = (light[:, 2] > 0) & (view[:, 2] > 0)
    half = light + view
    cosine = half[:, 2] / np.linalg.norm(half, axis=1)
    random = np.random.default_rng(3)
    z, azimuth = random.uniform(0, 1, (2, 400_000)), random.uniform(0, 2 * np.pi, (2, 400_000))
    pairs = from_angles(np.arccos(z[0]), azimuth[0]) + from_angles(np.arccos(z[1]), azimuth[1])
    expected = np.mean(pairs[:, 2] / np.linalg.norm(pairs, axis=1))
    # 400 000 random pairs know the mean to 2e-4; the grid's own error is below that.
    assert np.average(cosine[above], weights=share[above]) == pytest.approx(expected, abs=1e-3)


def test_energy_of_a_white_merl_table(tmp_path):
    stored = np.full((3, 90 * 90 * 180), 1500 / np.pi) / np.array([[1.0], [1.15], [1.66]])
    table = brdf.load_measured(write_merl(tmp_path / "white.binary", 0.9 * stored))
    report = brdf.check(table)
    # A Lambertian 0.9 exactly; the quadrature's own bound says how exactly.
    assert report.energy.value == pytest.approx(0.9, abs=max(report.energy.error_bound, 2e-3))
    assert report.energy.verdict == "pass"
    assert "of light up to 75°" in report.energy.sentence
    assert report.reciprocity.verdict == "pass"


def test_a_table_of_ones_own_is_checked_between_its_entries():
    """By its entries alone, whose partners are half a degree off, the verdict was that one cannot tell."""

    def lobe(to_light, to_view):
        half = to_light + to_view
        return 0.1 + 0.3 * (half[:, 2] / np.linalg.norm(half, axis=1)) ** 40

    report = brdf.check(brdf.merl_table(lobe))
    assert {report.positivity.verdict, report.reciprocity.verdict, report.energy.verdict} == {"pass"}


def _normalized_blinn_phong(k_d, k_s, n, missing):
    """On MERL's grid, NaN where ``missing``, a function of light, view and half vector, says so."""

    def f_r(light, view):
        half = (light + view) / np.linalg.norm(light + view, axis=1, keepdims=True)
        size = (n + 2) * (n + 4) / (8 * np.pi * (2 ** (-n / 2) + n))
        return np.where(missing(light, view, half), np.nan, k_d / np.pi + k_s * size * half[:, 2] ** n)

    return brdf.merl_table(f_r)


@pytest.mark.parametrize(
    ("k_s", "degrees", "verdict"),
    [
        pytest.param(0.7, 3, "fail", id="above 1 in what is measured"),
        pytest.param(0.7, 8, "cannot tell", id="above 1 with the peak"),
        pytest.param(0.0, 5, "cannot tell", id="a mirror may hide there"),
    ],
)
def test_a_peak_that_was_not_measured_leaves_the_energy_open(k_s, degrees, verdict):
    """It was taken for black: of an albedo of 1.2 the check said that it passes."""
    lowest = np.cos(np.radians(degrees))
    report = brdf.check(_normalized_blinn_phong(0.5, k_s, 40, lambda _light, _view, half: half[:, 2] > lowest))
    assert report.energy.verdict == verdict
    if verdict == "cannot tell":
        told = re.search("; (.*) % of its views, .* not measured, among them one that may", report.energy.sentence)
        assert told
        # A cap of views of twice the angle about the mirror direction; narrower across the plane of incidence.
        cap = np.sin(np.radians(2 * degrees)) ** 2 * np.cos(np.radians(report.energy.to_light.polar)) ** 2
        assert float(told[1]) / 100 == pytest.approx(cap, rel=0.2)
    # The pairs that are left are reciprocal.
    assert report.reciprocity.verdict == "pass"


@pytest.mark.parametrize(("k_d", "verdict"), [(0.4, "pass"), (0.85, "cannot tell")])
def test_grazing_views_that_were_not_measured_may_be_as_bright_as_those_beside_them(k_d, verdict):
    def grazing(light, view, _half):
        return np.minimum(light[:, 2], view[:, 2]) < np.sin(np.radians(15))

    energy = brdf.check(_normalized_blinn_phong(k_d, 0.1, 40, grazing)).energy
    assert energy.verdict == verdict
    # Of the largest albedo, within which light up to 75 degrees and no view beyond takes part.
    assert energy.value < k_d + 0.1 < energy.value + energy.error_bound


def test_no_pair_is_made_of_what_was_not_measured():
    """Such pairs counted as agreeing: where they are most of all, a table that is not reciprocal passed."""

    def f_r(light, view):
        return np.where(light[:, 2] + view[:, 2] > 1, np.nan, 0.1 + 0.3 * light[:, 2])

    assert brdf.check(brdf.merl_table(f_r)).reciprocity.verdict == "fail"
