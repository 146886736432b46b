"""Measured tables: synthetic files in each layout read back, and what is damaged is said in one line."""

import os
import struct
from pathlib import Path

import numpy as np
import pytest

import brdf
from brdf.errors import InputError
from brdf.measured import merl as measured_merl
from brdf.measured import rgl as measured_rgl
from brdf.measured import text as measured_text
from brdf.measured.tables import from_angles, from_half_angles

REAL = Path(os.environ.get("BRDF_REAL_DATA", Path(__file__).parents[1] / ".." / "shared" / "data"))
real_data = pytest.mark.skipif(not REAL.is_dir(), reason=f"real data is missing: {REAL} (BRDF_REAL_DATA)")
CORNELL = "# paint\n2\n400 500\n# rows\n0.2 0 0.3 0 0.5 -0.25\n0.4 0.1 1.9 0 1 2\n"
ALTA = '#SAMPLE "x"\n#DIM 3 1\n#PARAM_IN ISOTROPIC_TL_TV_PROJ_DPHI\n0.3 0.4 0.0 2.5\n0.3 0.0 -0.2 1.5\n'


def degrees_between(a, b):
    return np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), np.sum(a * b, axis=-1)))


def write_merl(path: Path, stored: np.ndarray, sizes=(90, 90, 180)) -> Path:
    path.write_bytes(struct.pack("<3i", *sizes) + stored.astype("<f8").tobytes())
    return path


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


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (struct.pack("<3i", 90, 90, 180), "bytes instead of"),
        (struct.pack("<3i", 90, 90, 180) + bytes(800), "bytes instead of"),
        (struct.pack("<3i", 2**31 - 1, 2**31 - 1, 2**31 - 1) + bytes(100), "says it holds 2147483647 x"),
    ],
)
def test_damaged_merl_files(tmp_path, content, said):
    (tmp_path / "a.binary").write_bytes(content)
    with pytest.raises(InputError, match=said) as error:
        brdf.load_measured(tmp_path / "a.binary")
    assert "a.binary" in str(error.value)


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


def test_half_angles_give_back_half_and_difference():
    random = np.random.default_rng(4)
    h, d, pd, ph = random.uniform(0, 1.5, 50), random.uniform(0, 1.5, 50), *random.uniform(0, 6.28, (2, 50))
    light, view = from_half_angles(h, d, pd, ph)
    half = light + view
    assert np.allclose(np.linalg.norm(light, axis=1), 1)
    assert np.allclose(np.linalg.norm(view, axis=1), 1)
    assert np.allclose(degrees_between(half, from_angles(h, ph)), 0, atol=1e-6)
    assert np.allclose(degrees_between(half, light), np.degrees(d))


def test_cornell_text():
    table = measured_text.parse_cornell(CORNELL, "a.brdf", "a")
    assert table.channels == ("400 nm", "500 nm")
    assert table.values.tolist() == [[0.5, -0.25]]
    assert table.left_out == {"below the horizon": 1}
    assert table.negative == 1
    assert np.allclose(table.to_light, [[np.sin(0.2), 0, np.cos(0.2)]])
    assert np.allclose(table.to_view, [[np.sin(0.3), 0, np.cos(0.3)]])


def test_alta_projected_angles():
    table = measured_text.parse_alta(ALTA, "a.alta", "a")
    assert table.values.tolist() == [[2.5], [1.5]]
    assert np.allclose(table.to_light, np.tile([np.sin(0.3), 0, np.cos(0.3)], (2, 1)))
    assert np.allclose(table.to_view, [[np.sin(0.4), 0, np.cos(0.4)], [0, -np.sin(0.2), np.cos(0.2)]])


@pytest.mark.parametrize(
    ("kind", "row", "light", "view"),
    [
        ("COS_TH", [np.cos(0.5)], (0.5, 0), (0.5, 0)),
        ("COS_TH_TD", [np.cos(0.0), np.cos(0.3)], (0.3, 0), (0.3, np.pi)),
        ("COS_TLV", [np.cos(0.4)], (0, 0), (0.4, 0)),
        ("COS_TLR", [np.cos(0.4)], (0, 0), (0.4, np.pi)),
        ("RUSIN_TH_TD", [0.0, 0.3], (0.3, np.pi / 2), (0.3, -np.pi / 2)),
        ("RUSIN_TH_TD_PD", [0.2, 0.3, 0.0], (0.5, 0), (0.1, np.pi)),
        ("RUSIN_TH_PH_TD_PD", [0.2, 1.0, 0.3, 0.0], (0.5, 1.0), (0.1, 1.0 + np.pi)),
        ("ISOTROPIC_TV_TL_DPHI", [0.2, 0.3, 1.0], (0.3, 1.0), (0.2, 0)),
        ("ISOTROPIC_TV_PROJ_DPHI", [0.3, 0.4], (0, 0), (0.5, np.arctan2(0.4, 0.3))),
        ("SPHERICAL_TL_PL_TV_PV", [0.1, 0.2, 0.3, 0.4], (0.1, 0.2), (0.3, 0.4)),
        ("CARTESIAN", [0, 0, 2.0, 0.6, 0, 0.8], (np.arctan2(0.6, 0.8), 0), (0, 0)),
    ],
)
def test_alta_parametrisations(kind, row, light, view):
    text = f"#DIM {len(row)} 2\n#PARAM_IN {kind}\n{' '.join(map(repr, map(float, row)))} 1 2\n"
    table = measured_text.parse_alta(text, "a", "a")
    # Which of the two a symmetric parametrisation calls light is a convention; reciprocity makes it none.
    expected = [from_angles(*light), from_angles(*view)]
    found = [table.to_light[0], table.to_view[0]]
    apart = [np.max(degrees_between(np.array(found), np.array(order))) for order in (expected, expected[::-1])]
    assert min(apart) < 1e-6


def test_alta_confidence_columns_and_cosine_factor():
    text = "#DIM 2 1\n#VS 2\n#PARAM_IN RUSIN_TH_TD\n#PARAM_OUT INV_STERADIAN_COSINE_FACTOR\n0 0.3 2 1.9 2.1\n"
    table = measured_text.parse_alta(text, "a", "a")
    assert table.values[0, 0] == pytest.approx(2 / np.cos(0.3))


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "no numbers"),
        ("# only this", "no numbers"),
        ("hello world", "line 1: must be a number, got 'hello'"),
        ("0\n", "no measured BRDF"),
        ("1e9\n1", "no measured BRDF"),
        ("2.5\n1", "no measured BRDF"),
        ("nan\n1", "no measured BRDF"),
        ("2\n400 500\n", "not a multiple of 6"),
        ("2\n400 500\n1 2 3", "not a multiple of 6"),
        ("1\n400\n20 0 30 0 1", "an angle of 30"),
        ("2\n400 500\n" + "0.2 0 0.3 0 0.5\n" * 6, "line 4: holds the end of a row and the start of the next"),
        ("1\n400 0.2 0 0.3 0 0.5\n", "line 2: holds the end of a row"),
        ("1\n400\nnan 0 0.3 0 1", "an angle of nan"),
        ("1\n400\n0.1 0 0.3 0 inf", r"table.txt: has no finite sample above the horizon \(1 not finite\)"),
        ("1\n400\n2 0 0.3 0 1", "no finite sample"),
        ("#DIM 3\n1 2 3", "DIM: must be two whole numbers"),
        ("#DIM -3 1\n1 2 3", "DIM: must be two whole numbers"),
        ("#DIM 3 99999999999\n1 2 3", "DIM: must be two whole numbers"),
        ("#DIM 9 1\n1 2 3", "DIM: says 9"),
        ("#DIM 3 1\n1 2 3 4", "PARAM_IN: is not known, got ''"),
        ("#DIM 3 1\n#PARAM_IN COS_TH\n1 2 3 4", "COS_TH has 1"),
        ("#DIM 1 1\n#PARAM_IN COS_TH\n", "holds no samples"),
        ("#DIM 1 1\n#PARAM_IN COS_TH\n0.5", "line 3: has 1 numbers instead of 2"),
        ("#DIM 1 1\n#PARAM_IN COS_TH\n0.5 x", "line 3: must be a number, got 'x'"),
        ("#DIM 1 1\n#PARAM_IN COS_TH\n1.5 1", "cosine that is not within"),
        ("#DIM 1 1\n#PARAM_IN COS_TH\nnan 1", "cosine that is not within"),
        ("#DIM 1 1\n#PARAM_IN COS_TH\n#PARAM_OUT XYZ_COLOR\n0.5 1", "PARAM_OUT: is no BRDF value"),
        ("#DIM 1 1\n#PARAM_IN COS_TH\n#VS 7\n0.5 1", "VS: must be 0, 1 or 2"),
        ("#DIM 1 1\n#PARAM_IN COS_TH\n#FORMAT binary\n0.5 1", "FORMAT"),
        ("#DIM 6 1\n#PARAM_IN CARTESIAN\n0 0 0 0 0 1 1", "a direction that is zero"),
    ],
)
def test_malformed_text(tmp_path, text, said):
    path = tmp_path / "table.txt"
    path.write_text(text or " ")
    with pytest.raises(InputError, match=said) as error:
        brdf.load_measured(path)
    assert str(error.value).startswith(str(path))
    assert "\n" not in str(error.value)


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


def tensor_file(**changes) -> bytes:
    """A small isotropic file: a constant, as far as anyone can tell."""
    one = np.ones
    fields = {
        "description": np.frombuffer(b"test", "u1"),
        "phi_i": np.zeros(1, "<f4"),
        "theta_i": np.linspace(0, 1.5, 4, dtype="<f4"),
        "sigma": one((2, 8), "<f4"),
        "ndf": one((2, 8), "<f4"),
        "vndf": one((1, 4, 8, 8), "<f4"),
        "luminance": one((1, 4, 4, 4), "<f4"),
        "rgb": one((1, 4, 3, 4, 4), "<f4"),
        "jacobian": np.zeros(1, "u1"),
    } | changes
    fields = {name: array for name, array in fields.items() if array is not None}
    codes = {"u1": 1, "u4": 5, "f4": 10}
    head = sum(2 + len(name) + 11 + 8 * array.ndim for name, array in fields.items())
    start, header, body = 18 + head, b"", b""
    for name, array in fields.items():
        code = codes[array.dtype.str[1:]]
        header += (
            struct.pack("<H", len(name)) + name.encode() + struct.pack("<HBQ", array.ndim, code, start + len(body))
        )
        header += struct.pack(f"<{array.ndim}Q", *array.shape)
        body += array.tobytes()
    return measured_rgl.MAGIC + bytes([1, 0]) + struct.pack("<I", len(fields)) + header + body


def test_rgl_fields_are_checked_before_mitsuba_sees_them(tmp_path):
    path = tmp_path / "a.bsdf"
    good = tensor_file()
    assert set(measured_rgl.read_fields(good, path)) >= {"theta_i", "rgb"}
    spoiled = {
        "ends within its header": good[:40],
        "beyond the end": good[:-4],
        "version": good[:12] + bytes([9, 0]) + good[14:],
        "no field rgb": tensor_file(rgb=None),
        "theta_i: does not grow": tensor_file(theta_i=np.zeros(4, "<f4")),
        "not finite": tensor_file(ndf=np.full((2, 8), np.nan, "<f4")),
        "2 channels instead of 3": tensor_file(rgb=np.ones((1, 4, 2, 4, 4), "<f4")),
        "1 x 9 slices": tensor_file(vndf=np.ones((1, 9, 8, 8), "<f4")),
        "jacobian: must be one byte": tensor_file(jacobian=np.zeros(2, "u1")),
        "description: must be text": tensor_file(description=None),
        "sigma: must be 2-dimensional": tensor_file(sigma=np.ones(8, "<f4")),
        "luminance: is of shape": tensor_file(luminance=np.ones((1, 4, 1, 4), "<f4")),
    }
    for said, content in spoiled.items():
        path.write_bytes(content)
        with pytest.raises(InputError, match=said) as error:
            brdf.load_measured(path)
        assert str(error.value).startswith(str(path)), said


def test_rgl_without_mitsuba_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "mitsuba", None)
    (tmp_path / "a.bsdf").write_bytes(tensor_file())
    with pytest.raises(InputError, match=r"Mitsuba, which is not installed.*pip install"):
        brdf.load_measured(tmp_path / "a.bsdf")


@real_data
def test_rgl_white_paper_is_nearly_reciprocal_white():
    pytest.importorskip("mitsuba", reason="the optional extra 'measured' is not installed")
    table = brdf.load_measured(REAL / "rgl" / "paper_white_rgb.bsdf")
    light, view = from_angles(np.radians([30.0]), 0.0), from_angles(np.radians([50.0]), 2.0)
    there, back = table.evaluate(light, view), table.evaluate(view, light)
    # White A4 paper reflects some 85 % of the light nearly evenly.
    assert np.all((there > 0.22) & (there < 0.35))
    assert np.allclose(there, back, rtol=0.03)
    report = brdf.check(table)
    assert report.energy.verdict == "pass"
    assert 0.7 < report.energy.value < 1.0


@real_data
@pytest.mark.parametrize(
    ("name", "samples", "channels"),
    [
        ("cornell/acryl_blue.brdf", 1439, 31),
        ("cornell/cayman.brdf", 1439, 31),
        ("cornell/garnet_red.brdf", 1439, 31),
        ("alta/pink-felt-1d.alta", 90, 3),
        ("alta/retro-gray-tape.dat", 7400, 1),
    ],
)
def test_real_text_tables(name, samples, channels):
    table = brdf.load_measured(REAL / name)
    assert table.values.shape == (samples, channels)
    if "tape" in name:
        brightest = np.argmax(table.values[:, 0])
        assert degrees_between(table.to_light[brightest], table.to_view[brightest]) < 1e-3


# -- plausibility ------------------------------------------------------------------------------------------------------


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


def test_energy_of_a_white_merl_table(tmp_path):
    stored = np.full((3, 90 * 90 * 180), 1500 / np.pi) / np.array([[1.0], [1.15], [1.66]])
    table = brdf.load_measured(write_merl(tmp_path / "white.binary", 0.9 * stored))
    report = brdf.check(table)
    # A Lambertian 0.9 exactly; the quadrature's own bound says how exactly.
    assert report.energy.value == pytest.approx(0.9, abs=max(report.energy.error_bound, 2e-3))
    assert report.energy.verdict == "pass"
    assert report.reciprocity.verdict == "pass"


@pytest.mark.parametrize("spectral", [False, True])
def test_rgl_files_are_evaluated_by_mitsuba(tmp_path, spectral):
    pytest.importorskip("mitsuba", reason="the optional extra 'measured' is not installed")
    changes = {}
    if spectral:
        spectra = np.ones((1, 4, 6, 4, 4), "<f4") * np.arange(1, 7, dtype="<f4")[:, None, None]
        changes = {"rgb": None, "spectra": spectra, "wavelengths": np.linspace(400, 650, 6, dtype="<f4")}
    (tmp_path / "a.bsdf").write_bytes(tensor_file(**changes))
    table = brdf.load_measured(tmp_path / "a.bsdf")
    assert len(table.channels) == (6 if spectral else 3)
    light, view = from_angles(np.array([0.3, 0.8]), 0.0), from_angles(np.array([0.5, 0.2]), 2.0)
    values = table.evaluate(light, view)
    assert np.all(values > 0)
    # Channel k is k times the first one by construction of the file; float32 inside Mitsuba.
    expected = values[:, :1] * (np.arange(1, 7) if spectral else np.ones(3))
    assert np.allclose(values, expected, rtol=1e-4)
