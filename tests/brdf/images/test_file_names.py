"""Names that are odd: not UTF-8, no path at all, with line feeds and marks; and what messages make of them."""

import os
import sys

import numpy as np
import pytest
from image_files import REAL, codes, needs, png

import brdf
from brdf.errors import InputError
from brdf.files import read_text, write_text

ODD = os.fsdecode(b"\xff\xfe")
encoded = pytest.mark.skipif(sys.platform != "linux", reason="other systems allow Unicode names alone")


@encoded
@pytest.mark.parametrize("place", ["{}.png", "{}/a.png"])
def test_a_picture_whose_name_is_not_utf8(tmp_path, place):
    path = tmp_path / place.format(ODD)
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(png(codes(4, 5, 3)))
    for reader in (brdf.read_image, brdf.read_picture, brdf.read_layers, brdf.read_mask, brdf.ImageReader):
        with pytest.raises(InputError, match="has a name or folder that is not UTF-8"):
            reader(path)


@encoded
def test_text_files_may_bear_any_name(tmp_path):
    (tmp_path / f"{ODD}.mtl").write_text("newmtl a\nKd 1 1 1\n")
    assert brdf.load_material(tmp_path / f"{ODD}.mtl").name == "lambert"
    brdf.save_material(brdf.Lambert(k_d=[0.5]), tmp_path / f"{ODD}.json")
    assert brdf.load_material(tmp_path / f"{ODD}.json").name == "lambert"
    (tmp_path / f"{ODD}.brdf").write_text("1\n500\n0.2 0 0.3 0 0.5\n0.4 0 1.2 0 1\n")
    assert len(brdf.load_measured(tmp_path / f"{ODD}.brdf").values) == 2


@encoded
def test_writing_into_a_folder_whose_name_is_not_utf8(tmp_path):
    (tmp_path / ODD).mkdir()
    with pytest.raises(InputError, match="not UTF-8"):
        brdf.write_image(tmp_path / ODD / "a.png", np.zeros((4, 4, 3)))
    assert not list((tmp_path / ODD).iterdir())
    brdf.write_image(tmp_path / f"{ODD}.png", np.zeros((4, 4, 3)))  # written under another name, then renamed
    assert (tmp_path / f"{ODD}.png").exists()


@encoded
@needs("rgl")
def test_a_table_whose_name_is_not_utf8(tmp_path):
    pytest.importorskip("mitsuba", reason="needs brdf-fitting[measured]")
    (tmp_path / f"{ODD}.bsdf").write_bytes((REAL / "rgl" / "paper_white_rgb.bsdf").read_bytes())
    with pytest.raises(InputError, match="not UTF-8"):
        brdf.load_measured(tmp_path / f"{ODD}.bsdf")


@pytest.mark.parametrize("name", ["\ud800.png", "a\0b.png", ""])
def test_what_no_system_takes_as_a_name(name):
    for reader in (brdf.read_image, brdf.load_measured, brdf.Scene.load, read_text, brdf.read_mask):
        with pytest.raises(InputError, match=r"is not a path|no such file|is a folder"):
            reader(name)
    with pytest.raises(InputError, match="is not a path"):
        write_text(name, "x")


@pytest.mark.parametrize(
    "name", ["a\nb.png", "-rf.png", "\U0001f600.png", " .png", "a%d%s{}.png", "[bold]x.png", "#.png"]
)
@pytest.mark.parametrize("sound", [True, False])
def test_names_that_mean_something_elsewhere(tmp_path, name, sound):
    (tmp_path / name).write_bytes(png(codes(4, 5, 3))[: None if sound else 40])
    if sound:
        assert brdf.read_image(tmp_path / name).shape == (4, 5, 3)
        return
    with pytest.raises(InputError) as told:
        brdf.read_image(tmp_path / name)
    assert "\n" not in str(told.value)
    assert name.replace("\n", " ").strip() in str(told.value)


@pytest.mark.parametrize("suffix", [".webp", ".fits", ".bmp", ".jxl", ".dpx", ".rla", ".sgi", ".iff", ".zfile", ".jp2"])
def test_the_path_is_said_once(tmp_path, suffix):
    path = tmp_path / f"not a picture{suffix}"
    path.write_bytes(bytes(range(200)))
    with pytest.raises(InputError) as told:
        brdf.read_image(path)
    assert str(told.value).count(str(tmp_path)) == 1
