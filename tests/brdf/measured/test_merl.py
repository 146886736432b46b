"""MERL tables: synthetic files in the published layout read back, and what is damaged is said in one line."""

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
    table = brdf.load_measured(write_merl(tmp_path / "a.binary", stored))
    assert table.left_out["not measured"] == 1
    assert table.negative == 0


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
