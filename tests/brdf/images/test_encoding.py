"""What the codes of an image file mean: what the file says, and what the user says."""

import struct
import zlib

import numpy as np
import pytest
from image_files import (
    CURVE_TOLERANCE,
    REAL,
    codes,
    needs,
    parametric,
    png,
    profile,
    random,
    raw,
    srgb_to_linear,
    table,
)

from brdf.errors import InputError
from brdf.images.encoding import decode, encode, largest_step
from brdf.images.reading import read_image, read_picture

GRADIENT = np.arange(256, dtype=np.uint8).reshape(16, 16, 1).repeat(3, axis=2)
SRGB = srgb_to_linear(GRADIENT / 255)
LINEAR = GRADIENT / 255
GAMMA_22 = (GRADIENT / 255) ** 2.2
SRGB_CURVE = (2.4, 1 / 1.055, 0.055 / 1.055, 1 / 12.92, 0.04045)


def icc(curve):
    return (b"iCCP", b"name\0\0" + zlib.compress(profile(curve)))


@pytest.mark.parametrize(
    ("chunks", "expected", "encoding", "source"),
    [
        ([], SRGB, "srgb", "assumed"),
        ([(b"sRGB", b"\0")], SRGB, "srgb", "file"),
        ([(b"gAMA", struct.pack(">I", 100000))], LINEAR, "linear", "file"),
        ([(b"gAMA", struct.pack(">I", 45455))], GAMMA_22, 2.2, "file"),
        ([(b"gAMA", struct.pack(">I", 0))], SRGB, "srgb", "assumed"),
        ([(b"gAMA", struct.pack(">I", 45455)), (b"sRGB", b"\0")], SRGB, "srgb", "file"),
        ([(b"cICP", bytes([1, 13, 0, 1]))], SRGB, "srgb", "file"),
        ([(b"cICP", bytes([1, 8, 0, 1]))], LINEAR, "linear", "file"),
        ([(b"cICP", bytes([12, 4, 0, 1]))], GAMMA_22, 2.2, "file"),
        ([(b"cICP", bytes([1, 17, 0, 1]))], (GRADIENT / 255) ** 2.6, 2.6, "file"),
        ([(b"cICP", bytes([1, 2, 0, 1])), (b"gAMA", struct.pack(">I", 100000))], LINEAR, "linear", "file"),
        ([icc(parametric(3, *SRGB_CURVE))], SRGB, "srgb", "file"),
        ([icc(parametric(0, 2.2))], GAMMA_22, pytest.approx(2.2, abs=1e-4), "file"),
        ([icc(parametric(3, 1, 1, 0, 1, 0))], LINEAR, "linear", "file"),
        ([icc(table(np.array([])))], LINEAR, "linear", "file"),
        ([icc(table(srgb_to_linear(np.linspace(0, 1, 1024))))], SRGB, "srgb", "file"),
        ([icc(table(np.linspace(0, 1, 256) ** 2.2))], GAMMA_22, 2.2, "file"),
        ([icc(b"curv" + bytes(4) + struct.pack(">IH", 1, 0x0233))], GAMMA_22, 0x0233 / 256, "file"),
        ([icc(table(np.array([]))), (b"gAMA", struct.pack(">I", 45455))], LINEAR, "linear", "file"),
    ],
)
def test_a_png_is_decoded_as_it_says(tmp_path, chunks, expected, encoding, source):
    (tmp_path / "a.png").write_bytes(png(GRADIENT, *chunks))
    picture = read_picture(tmp_path / "a.png")
    assert (picture.encoding, picture.source) == (encoding, source)
    # 0x0233 / 256 is 2.19921875, which moves a middle grey by 1e-4.
    np.testing.assert_allclose(
        picture.pixels, expected, rtol=0, atol=3e-4 if "iCCP" in str(chunks) else CURVE_TOLERANCE
    )
    assert picture.saturation == pytest.approx(1, abs=CURVE_TOLERANCE)
    assert (picture.bits, picture.code_step) == (8, 1 / 255)


@pytest.mark.parametrize(
    "chunks",
    [
        *(
            [(b"cICP", bytes([primaries, transfer, 0, 1]))]
            for primaries, transfer in [(9, 16), (1, 16), (12, 18), (9, 10)]
        ),
        [icc(table(np.linspace(0, 1, 64) ** 5))],
        [icc(b"mft2" + bytes(40))],
    ],
)
def test_an_encoding_that_is_not_known_is_asked_for(tmp_path, chunks):
    (tmp_path / "a.png").write_bytes(png(GRADIENT, *chunks))
    with pytest.raises(InputError, match="Say how it is encoded"):
        read_image(tmp_path / "a.png")
    np.testing.assert_allclose(read_image(tmp_path / "a.png", encoding="linear"), LINEAR, rtol=1e-6)


def test_a_damaged_profile_says_nothing(tmp_path):
    (tmp_path / "a.png").write_bytes(png(GRADIENT, (b"iCCP", b"x\0\0" + zlib.compress(b"\x12" * 300))))
    assert read_picture(tmp_path / "a.png").source == "assumed"


@pytest.mark.parametrize(
    ("encoding", "expected"),
    [("linear", LINEAR), ("srgb", SRGB), ("sRGB", SRGB), (2.2, GAMMA_22), ("2.2", GAMMA_22), (1, LINEAR)],
)
@pytest.mark.parametrize("chunks", [[], [(b"gAMA", struct.pack(">I", 55556))]])
def test_the_user_overrules_the_file(tmp_path, encoding, expected, chunks):
    (tmp_path / "a.png").write_bytes(png(GRADIENT, *chunks))
    picture = read_picture(tmp_path / "a.png", encoding=encoding)
    assert picture.source == "given"
    np.testing.assert_allclose(picture.pixels, expected, rtol=0, atol=CURVE_TOLERANCE)


@pytest.mark.parametrize("encoding", ["rec709", "", 0, -2.2, float("nan"), float("inf"), True, [2.2], 100])
def test_an_encoding_that_is_none(tmp_path, encoding):
    (tmp_path / "a.png").write_bytes(png(GRADIENT))
    with pytest.raises(InputError, match="encoding: must be linear, srgb or a gamma"):
        read_image(tmp_path / "a.png", encoding=encoding)


@pytest.mark.parametrize(("chunks", "expected"), [([], "linear"), ([(b"sRGB", b"\0")], "srgb")])
def test_sixteen_bits(tmp_path, chunks, expected):
    stored = codes(20, 30, 3, dtype=np.uint16)
    (tmp_path / "a.png").write_bytes(png(stored, *chunks))
    picture = read_picture(tmp_path / "a.png")
    assert picture.encoding == expected
    assert (picture.bits, picture.code_step) == (16, 1 / 65535)
    linear = stored / 65535 if expected == "linear" else srgb_to_linear(stored / 65535)
    np.testing.assert_allclose(picture.pixels, linear, rtol=1e-6, atol=0 if expected == "linear" else CURVE_TOLERANCE)


def test_the_largest_step_is_that_of_the_brightest_codes():
    assert largest_step("linear", 8) == pytest.approx(1 / 255)
    assert largest_step("srgb", 8) == pytest.approx(1 - srgb_to_linear(np.array(254 / 255)))


@pytest.mark.parametrize("encoding", ["srgb", 2.2, 1.8])
@pytest.mark.parametrize("shape", [(1,), (7, 5, 1), (33, 41, 4)])
def test_encode_undoes_decode(encoding, shape):
    values = random(*shape)
    np.testing.assert_allclose(encode(decode(values, encoding), encoding), values, rtol=0, atol=CURVE_TOLERANCE)


def test_a_float_file_is_linear_unless_someone_says_otherwise(tmp_path):
    values = random(9, 8, 3)
    raw(tmp_path / "a.exr", values, "RGB")
    raw(tmp_path / "b.exr", values, "RGB", colorInteropID="srgb_rec709_scene")
    assert read_picture(tmp_path / "a.exr").source == "format"
    np.testing.assert_array_equal(read_image(tmp_path / "a.exr"), values)
    for said in (read_image(tmp_path / "a.exr", encoding="srgb"), read_image(tmp_path / "b.exr")):
        np.testing.assert_allclose(said, srgb_to_linear(values), rtol=0, atol=CURVE_TOLERANCE)


@needs("vtk")
def test_the_encodings_of_the_real_files():
    target = read_picture(REAL / "vtk" / "red-satin" / "target.png")
    assert (target.encoding, target.source, target.bits, target.saturation) == ("linear", "file", 8, 1.0)
    sphere = read_picture(REAL / "uw-spheres" / "gray" / "gray.0.png")
    assert sphere.source == "assumed"
    tga = read_image(REAL / "uw-spheres" / "gray" / "gray.0.tga")
    np.testing.assert_array_equal(sphere.pixels, tga)
