"""Measured tables as text, Cornell's and ALTA's: every parametrisation, real files; and files that are no table."""

import struct

import numpy as np
import pytest
from measured_files import degrees_between
from project_paths import REAL, real_data

import brdf
from brdf.errors import InputError
from brdf.measured.table import from_angles

CORNELL = "# paint\n2\n400 500\n# rows\n0.2 0 0.3 0 0.5 -0.25\n0.4 0.1 1.9 0 1 2\n"
ALTA = '#SAMPLE "x"\n#DIM 3 1\n#PARAM_IN ISOTROPIC_TL_TV_PROJ_DPHI\n0.3 0.4 0.0 2.5\n0.3 0.0 -0.2 1.5\n'
CARTESIAN = "#DIM 6 1\n#PARAM_IN CARTESIAN\n0 0 1 0 0 1 0.3\n"
COSINE = "#DIM 1 1\n#PARAM_IN COS_TH\n"


@pytest.fixture
def load(tmp_path):
    def read(content: str | bytes, name: str = "table.txt") -> brdf.MeasuredBRDF:
        (tmp_path / name).write_bytes(content if isinstance(content, bytes) else content.encode())
        return brdf.load_measured(tmp_path / name)

    return read


@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_cornell_text(load, end):
    table = load(CORNELL.replace("\n", end))
    assert table.channels == ("400 nm", "500 nm")
    assert table.values.tolist() == [[0.5, -0.25]]
    assert table.left_out == {"below the horizon": 1}
    assert table.negative == 1
    assert np.allclose(table.to_light, [[np.sin(0.2), 0, np.cos(0.2)]])
    assert np.allclose(table.to_view, [[np.sin(0.3), 0, np.cos(0.3)]])


@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_alta_projected_angles(load, end):
    table = load(ALTA.replace("\n", end))
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
def test_alta_parametrisations(load, kind, row, light, view):
    table = load(f"#DIM {len(row)} 2\n#PARAM_IN {kind}\n{' '.join(map(repr, map(float, row)))} 1 2\n")
    # Which of the two a symmetric parametrisation calls light is a convention; reciprocity makes it none.
    expected = [from_angles(*light), from_angles(*view)]
    found = [table.to_light[0], table.to_view[0]]
    apart = [np.max(degrees_between(np.array(found), np.array(order))) for order in (expected, expected[::-1])]
    assert min(apart) < 1e-6


def test_alta_confidence_columns_cosine_factor_and_colours(load):
    header = "#DIM 2 1\n#VS 2\n#PARAM_IN RUSIN_TH_TD\n#PARAM_OUT INV_STERADIAN_COSINE_FACTOR\n"
    assert load(f"{header}0 0.3 2 1.9 2.1\n").values[0, 0] == pytest.approx(2 / np.cos(0.3))
    assert load("#DIM 1 3\n#PARAM_IN COS_TH\n#PARAM_OUT RGB_COLOR\n0.5 1 2 3").channels == ("red", "green", "blue")


def test_a_count_of_wavelengths_may_have_a_decimal_point(load):
    assert load(CORNELL.replace("\n2\n", "\n2.0\n")).channels == ("400 nm", "500 nm")


REFUSED = [
    ("# only this", "no numbers"),
    (" ", "no numbers"),
    ("hello world", "line 1: is no measured BRDF, got 'hello'"),
    ("0\n", "no measured BRDF"),
    ("1e9\n1", "no measured BRDF"),
    ("2.5\n1", "no measured BRDF"),
    ("nan\n1", "no measured BRDF"),
    ("2\n400 500\n", "holds no samples"),
    ("2\n400 500\n1 2 3", "line 3: has 3 numbers instead of 6"),
    ("2\n400 500\n" + "0.2 0 0.3 0 0.5\n" * 6, "line 3: has 5 numbers instead of 6"),
    ("1\n400 0.2 0 0.3 0 0.5\n", "line 2: has 7 numbers instead of 2"),
    ("1\n400\n20 0 30 0 1", r"line 3: has an angle of 20\. Angles are in radians"),
    ("1\n400\n0 0 0.3 0 1\nnan 0 0.3 0 1", "line 4: has an angle of nan"),
    ("1\n400\n0.1 0 0.3 0 inf", r"table.txt: has no finite sample above the horizon \(1 not finite\)"),
    ("1\n400\n2 0 0.3 0 1", "no finite sample"),
    (CORNELL.replace(".", ","), r"line 5: must be a number, got '0,2'\. Numbers have a decimal point"),
    (CORNELL.replace(" ", ","), r"line 3: must be a number, got '400,500'\. .* spaces between them"),
    (CORNELL.replace("0.5", "1_0"), r"line 5: must be a number, got '1_0'"),
    (CORNELL.encode("utf-16"), "is neither text in UTF-8 nor a file of MERL or RGL"),
    (b"tenzor_file\0" + bytes(100), "is neither text in UTF-8 nor a file of MERL or RGL"),
    ("#DIM 3\n1 2 3", "DIM: must be two whole numbers"),
    ("#DIM -3 1\n1 2 3", "DIM: must be two whole numbers"),
    ("#DIM 3 99999999999\n1 2 3", "DIM: must be two whole numbers"),
    ("#DIM 9 1\n#PARAM_IN COS_TH\n1 2 3", "DIM: says 9"),
    ("#DIM 3 1\n1 2 3 4", r"PARAM_IN: is missing\. Known: "),
    ("#DIM 3 1\n#PARAM_IN POLAR\n1 2 3 4", "PARAM_IN: is not known, got 'POLAR'"),
    ("#DIM 3 1\n#PARAM_IN COS_TH\n1 2 3 4", "COS_TH has 1"),
    (COSINE, "holds no samples"),
    (f"{COSINE}0.5", "line 3: has 1 numbers instead of 2"),
    (f"{COSINE}0.5 x", "line 3: must be a number, got 'x'"),
    (f"{COSINE}0.5 1\n\n1.5 1", r"line 5: has a cosine of 1\.5"),
    (f"{COSINE}nan 1", "line 3: has a cosine of nan"),
    (f"{COSINE}#PARAM_OUT XYZ_COLOR\n0.5 1", "PARAM_OUT: is no BRDF value"),
    (f"{COSINE}#VS 7\n0.5 1", "VS: must be 0, 1 or 2"),
    (f"{COSINE}#FORMAT binary\n0.5 1", "FORMAT"),
    (f"{ALTA}0.3 70 0 1", "line 6: has an angle of 70"),
    (f"{ALTA}0.3 inf 0 1", "line 6: has an angle of inf"),
    (f"{CARTESIAN}0 0 0 0 0 1 1", "line 4: has a direction that is zero or not finite"),
    (CARTESIAN.replace("0 0 1 0", "0 0 -1 0"), r"table.txt: has no finite sample above the horizon"),
]


@pytest.mark.parametrize(("content", "said"), REFUSED)
def test_a_table_that_is_refused(load, tmp_path, content, said):
    with pytest.raises(InputError, match=said) as error:
        load(content)
    assert str(error.value).startswith(f"{tmp_path / 'table.txt'}: ")
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (struct.pack("<2i", 90, 90), "ends within its header"),
        (struct.pack("<3i", 90, 90, 180), "bytes instead of"),
        (struct.pack("<3i", 90, 90, 180) + bytes(800), "bytes instead of"),
        (struct.pack("<3i", 90, 90, 360) + bytes(99), "says it holds 90 x 90 x 360 entries, MERL's hold 90 x 90 x 180"),
        (struct.pack("<3i", 2**31 - 1, 2**31 - 1, 2**31 - 1) + bytes(100), "says it holds 2147483647 x"),
    ],
)
def test_a_binary_table_that_is_refused(load, tmp_path, content, said):
    with pytest.raises(InputError, match=said) as error:
        load(content, "a.binary")
    assert str(error.value).startswith(f"{tmp_path / 'a.binary'}: ")


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
