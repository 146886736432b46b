"""Measured tables as text, Cornell's and ALTA's: every parametrisation, real files, and what is malformed."""

import numpy as np
import pytest
from measured_files import degrees_between
from project_paths import REAL, real_data

import brdf
from brdf.errors import InputError
from brdf.measured import text as measured_text
from brdf.measured.table import from_angles

CORNELL = "# paint\n2\n400 500\n# rows\n0.2 0 0.3 0 0.5 -0.25\n0.4 0.1 1.9 0 1 2\n"


ALTA = '#SAMPLE "x"\n#DIM 3 1\n#PARAM_IN ISOTROPIC_TL_TV_PROJ_DPHI\n0.3 0.4 0.0 2.5\n0.3 0.0 -0.2 1.5\n'


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
        ("1\n400\n20 0 30 0 1", "line 3: has an angle of 20"),
        ("2\n400 500\n" + "0.2 0 0.3 0 0.5\n" * 6, "line 4: holds the end of a row and the start of the next"),
        ("1\n400 0.2 0 0.3 0 0.5\n", "line 2: holds the end of a row"),
        ("1\n400\nnan 0 0.3 0 1", "an angle of nan"),
        ("1\n400\n0.1 0 0.3 0 inf", r"table.txt: has no finite sample above the horizon \(1 not finite\)"),
        ("1\n400\n2 0 0.3 0 1", "no finite sample"),
        ("#DIM 3\n1 2 3", "DIM: must be two whole numbers"),
        ("#DIM -3 1\n1 2 3", "DIM: must be two whole numbers"),
        ("#DIM 3 99999999999\n1 2 3", "DIM: must be two whole numbers"),
        ("#DIM 9 1\n1 2 3", "DIM: says 9"),
        ("#DIM 3 1\n1 2 3 4", "PARAM_IN: is missing"),
        ("#DIM 3 1\n#PARAM_IN COS_TH\n1 2 3 4", "COS_TH has 1"),
        ("#DIM 1 1\n#PARAM_IN COS_TH\n", "holds no samples"),
        ("#DIM 1 1\n#PARAM_IN COS_TH\n0.5", "line 3: has 1 numbers instead of 2"),
        ("#DIM 1 1\n#PARAM_IN COS_TH\n0.5 x", "line 3: must be a number, got 'x'"),
        ("#DIM 1 1\n#PARAM_IN COS_TH\n1.5 1", "line 3: has a cosine of 1.5"),
        ("#DIM 1 1\n#PARAM_IN COS_TH\nnan 1", "line 3: has a cosine of nan"),
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
