"""Measured tables that are no tables: which line, what came, what to do."""

import struct

import pytest

import brdf
from brdf.errors import InputError

CORNELL = "2\n400 500\n0.1 0 0.1 0 0.3 0.4\n# between\n0.2 0 0.1 0 0.3 0.4\n"
ALTA = "#DIM 3 1\n#PARAM_IN ISOTROPIC_TV_TL_DPHI\n0.1 0.2 0.3 0.4\n\n0.2 0.2 0.3 0.4\n"
COSINES = "#DIM 2 1\n#PARAM_IN COS_TH_TD\n0.9 0.9 1\n"
CARTESIAN = "#DIM 6 1\n#PARAM_IN CARTESIAN\n0 0 1 0 0 1 0.3\n"
REFUSED = {
    "degrees.brdf": (CORNELL.replace("0.2 0", "45 0"), r"line 5: has an angle of 45\. Angles are in radians"),
    "nan.brdf": (CORNELL.replace("0.2 0", "0.2 nan"), r"line 5: has an angle of nan"),
    "comma.brdf": (CORNELL.replace(".", ","), r"line 3: must be a number, got '0,1'\. Numbers have a decimal point"),
    "csv.brdf": (CORNELL.replace(" ", ","), r"line 2: must be a number, got '400,500'\. .* spaces between them"),
    "underscore.brdf": (CORNELL.replace("0.4", "1_0"), r"line 3: must be a number, got '1_0'"),
    "utf16.brdf": (CORNELL.encode("utf-16"), r"is neither text in UTF-8 nor a file of MERL or RGL"),
    "magic.bsdf": (b"tenzor_file\0" + bytes(100), r"is neither text in UTF-8 nor a file of MERL or RGL"),
    "head.binary": (struct.pack("<2i", 90, 90), r"ends within its header"),
    "sizes.binary": (struct.pack("<3i", 90, 90, 360) + bytes(99), r"says it holds 90 x 90 x 360 entries"),
    "degrees.alta": (ALTA.replace("0.2 0.2", "0.2 70"), r"line 5: has an angle of 70"),
    "inf.alta": (ALTA.replace("0.2 0.2", "0.2 inf"), r"line 5: has an angle of inf"),
    "no_kind.alta": (ALTA.replace("#PARAM_IN ISOTROPIC_TV_TL_DPHI\n", ""), r"PARAM_IN: is missing\. Known: "),
    "cosine.alta": (COSINES + "0.9 1.5 1\n", r"line 4: has a cosine of 1\.5"),
    "zero.alta": (CARTESIAN + "0 0 0 0 0 1 1\n", r"line 4: has a direction that is zero or not finite"),
    "below.alta": (CARTESIAN.replace("0 0 1 0", "0 0 -1 0"), r"below\.alta: has no finite sample above the horizon"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_a_table_that_is_refused(tmp_path, name):
    content, said = REFUSED[name]
    (tmp_path / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(InputError, match=said) as told:
        brdf.load_measured(tmp_path / name)
    assert str(told.value).startswith(f"{tmp_path / name}: ")


@pytest.mark.parametrize("text", [CORNELL, ALTA, COSINES, CARTESIAN])
@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_what_is_spoiled_above_is_sound(tmp_path, text, end):
    (tmp_path / "a.brdf").write_bytes(text.replace("\n", end).encode())
    assert len(brdf.load_measured(tmp_path / "a.brdf").values) in (1, 2)
