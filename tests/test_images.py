"""Pixels in and out, against writers and formulas that are not OpenImageIO's."""

import os
import struct
import subprocess
import sys
import threading
import zlib
from contextlib import suppress
from pathlib import Path

import numpy as np
import OpenImageIO as oiio  # noqa: N813
import pytest

from brdf.errors import InputError
from brdf.images import file as image_file
from brdf.images.encodings import decode, encode
from brdf.images.pictures import (
    ImageReader,
    read_image,
    read_layers,
    read_mask,
    read_picture,
    write_image,
    write_layers,
)

PROJECT = Path(__file__).resolve().parent.parent
REAL_DATA = Path(os.environ.get("BRDF_REAL_DATA", PROJECT.parent / "shared" / "data"))
BAD_IMAGES = sorted((REAL_DATA / "bad-images").glob("*.[ejp][xpn][rg]*"))

# OpenColorIO's fast power is off by 2.4e-5 at most over [0, 1], two thirds of a 16-bit code.
CURVE_TOLERANCE = 5e-5


def needs(*parts):
    path = REAL_DATA.joinpath(*parts)
    return pytest.mark.skipif(not path.exists(), reason=f"{path} is missing (BRDF_REAL_DATA)")


def srgb_to_linear(code):
    """IEC 61966-2-1."""
    return np.where(code <= 0.04045, code / 12.92, ((code + 0.055) / 1.055) ** 2.4)


def chunk(kind, data):
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def png(codes, *chunks, colour_type=2):
    """The bytes of a PNG file, after its specification."""
    bits = 8 * codes.dtype.itemsize
    header = struct.pack(">IIBBBBB", codes.shape[1], codes.shape[0], bits, colour_type, 0, 0, 0)
    rows = b"".join(b"\0" + row.astype(row.dtype.newbyteorder(">")).tobytes() for row in codes)
    body = [chunk(b"IHDR", header), *(chunk(*item) for item in chunks), chunk(b"IDAT", zlib.compress(rows))]
    return b"\x89PNG\r\n\x1a\n" + b"".join(body) + chunk(b"IEND", b"")


def profile(curve):
    """The bytes of an ICC profile that holds nothing but the curve, of a length that libpng believes."""
    start = 132 + 3 * 12
    curve += bytes(-len(curve) % 4) + np.random.default_rng(0).bytes(400)
    tags = b"".join(name + struct.pack(">II", start, len(curve)) for name in (b"rTRC", b"gTRC", b"bTRC"))
    size = struct.pack(">I", start + len(curve))
    head = size + bytes(4) + bytes([4, 0x20, 0, 0]) + b"mntrRGB XYZ " + bytes(12) + b"acsp" + bytes(88)
    return head + struct.pack(">I", 3) + tags + curve


def parametric(kind, *numbers):
    return (
        b"para"
        + bytes(4)
        + struct.pack(">HH", kind, 0)
        + b"".join(struct.pack(">i", round(x * 65536)) for x in numbers)
    )


def table(values):
    return b"curv" + bytes(4) + struct.pack(f">I{len(values)}H", len(values), *np.rint(values * 65535).astype(int))


def random(*shape, seed=0):
    return np.random.default_rng(seed).random(shape, np.float32)


def codes(*shape, dtype=np.uint8, seed=0):
    return np.random.default_rng(seed).integers(0, np.iinfo(dtype).max, shape, dtype, endpoint=True)


def raw_exr(path, array, names, *, kind="float", tile=0, data_at=(0, 0), display=None, **attributes):
    """An EXR file by plain OpenImageIO calls."""
    spec = oiio.ImageSpec(array.shape[1], array.shape[0], array.shape[2], kind)
    spec.channelnames = tuple(names)
    spec.tile_width = spec.tile_height = tile
    spec.x, spec.y = data_at
    if display is not None:
        spec.full_x, spec.full_y, spec.full_width, spec.full_height = display
    for name, value in attributes.items():
        spec.attribute(name, value)
    file = oiio.ImageOutput.create(str(path))
    assert file.open(str(path), spec)
    assert file.write_image(np.ascontiguousarray(array))
    assert file.close()
    return path


# --- encodings ---------------------------------------------------------------------------------------------------


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
    "chunks", [[(b"cICP", bytes([9, 16, 0, 1]))], [icc(table(np.linspace(0, 1, 64) ** 5))], [icc(b"mft2" + bytes(40))]]
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
    with pytest.raises(InputError, match="encoding must be linear, srgb or a gamma"):
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


@pytest.mark.parametrize("encoding", ["linear", "srgb", 2.2])
def test_the_quantisation_is_the_distance_of_the_codes(tmp_path, encoding):
    (tmp_path / "a.png").write_bytes(png(GRADIENT))
    picture = read_picture(tmp_path / "a.png", encoding=encoding)
    curve = {"linear": lambda x: x, "srgb": srgb_to_linear, 2.2: lambda x: x**2.2}[encoding]
    middle = np.arange(1, 255)
    expected = (curve((middle + 1) / 255) - curve((middle - 1) / 255)) / 2
    np.testing.assert_allclose(picture.quantisation()[..., 0].ravel()[1:-1], expected, rtol=2e-3, atol=2e-7)


@pytest.mark.parametrize("encoding", ["srgb", 2.2, 1.8])
@pytest.mark.parametrize("shape", [(1,), (7, 5, 1), (33, 41, 4)])
def test_encode_undoes_decode(encoding, shape):
    values = random(*shape)
    np.testing.assert_allclose(encode(decode(values, encoding), encoding), values, rtol=0, atol=CURVE_TOLERANCE)


def test_a_float_file_is_linear_unless_someone_says_otherwise(tmp_path):
    values = random(9, 8, 3)
    raw_exr(tmp_path / "a.exr", values, "RGB")
    raw_exr(tmp_path / "b.exr", values, "RGB", colorInteropID="srgb_rec709_scene")
    assert read_picture(tmp_path / "a.exr").source == "format"
    np.testing.assert_array_equal(read_image(tmp_path / "a.exr"), values)
    for said in (read_image(tmp_path / "a.exr", encoding="srgb"), read_image(tmp_path / "b.exr")):
        np.testing.assert_allclose(said, srgb_to_linear(values), rtol=0, atol=CURVE_TOLERANCE)


@needs("vtk")
def test_the_encodings_of_the_real_files():
    target = read_picture(REAL_DATA / "vtk" / "red-satin" / "target.png")
    assert (target.encoding, target.source, target.bits, target.saturation) == ("linear", "file", 8, 1.0)
    sphere = read_picture(REAL_DATA / "uw-spheres" / "gray" / "gray.0.png")
    assert sphere.source == "assumed"
    tga = read_image(REAL_DATA / "uw-spheres" / "gray" / "gray.0.tga")
    np.testing.assert_array_equal(sphere.pixels, tga)


# --- channels, layers, masks -------------------------------------------------------------------------------------


def test_alpha_is_apart_and_does_not_darken(tmp_path):
    stored = codes(6, 5, 4)
    (tmp_path / "a.png").write_bytes(png(stored, colour_type=6))
    (tmp_path / "b.png").write_bytes(png(stored[..., [0, 3]], colour_type=4))
    for name, channels in (("a.png", 3), ("b.png", 1)):
        picture = read_picture(tmp_path / name, encoding="linear")
        np.testing.assert_allclose(picture.pixels, stored[..., :channels] / 255, rtol=1e-6)
        np.testing.assert_allclose(picture.alpha, stored[..., 3] / 255, rtol=1e-6)
    (tmp_path / "c.png").write_bytes(png(stored[..., :3]))
    assert read_picture(tmp_path / "c.png").alpha is None


def test_grey(tmp_path):
    stored = codes(6, 5, 1)
    (tmp_path / "a.png").write_bytes(png(stored, colour_type=0))
    np.testing.assert_allclose(read_image(tmp_path / "a.png", encoding="linear"), stored / 255, rtol=1e-6)


@pytest.mark.parametrize(
    ("names", "chosen", "alpha"),
    [
        (["R", "G", "B", "A", "Z"], ["R", "G", "B"], "A"),
        (["R", "G", "B", "image.R", "image.G", "image.B", "image.A"], ["R", "G", "B"], None),
        (["Y", "position.X", "position.Y", "position.Z"], ["Y"], None),
        (["beauty.R", "beauty.G", "beauty.B", "beauty.A", "depth.Z"], ["beauty.R", "beauty.G", "beauty.B"], "beauty.A"),
        (["S0", "S1", "S2", "S3", "S4"], ["S0", "S1", "S2", "S3", "S4"], None),
        ([f"S0.{400 + 10 * k},0nm" for k in range(31)], [f"S0.{400 + 10 * k},0nm" for k in range(31)], None),
        (["A", "W"], ["W"], "A"),
        (["Z"], ["Z"], None),
        ([f"C{k:03d}" for k in range(100)], [f"C{k:03d}" for k in range(100)], None),
    ],
)
def test_the_picture_in_an_exr(tmp_path, names, chosen, alpha):
    values = random(5, 4, len(names))
    picture = read_picture(raw_exr(tmp_path / "a.exr", values, names))
    np.testing.assert_array_equal(picture.pixels, values[..., [names.index(name) for name in chosen]])
    if alpha is None:
        assert picture.alpha is None
    else:
        np.testing.assert_array_equal(picture.alpha, values[..., names.index(alpha)])


def test_a_tiff_with_many_bands(tmp_path):
    values = random(5, 4, 31)
    write_image(tmp_path / "a.tif", values)
    np.testing.assert_array_equal(read_image(tmp_path / "a.tif"), values)


def test_layers_there_and_back(tmp_path):
    layers = {"": random(6, 5, 3), "position": random(6, 5, 3, seed=1), "depth": random(6, 5, seed=2)}
    layers["normal"] = random(6, 5, 3, seed=3)
    write_layers(tmp_path / "a.exr", layers)
    back = read_layers(tmp_path / "a.exr")
    assert set(back) == set(layers)
    for name, values in layers.items():
        np.testing.assert_array_equal(back[name], values.reshape(6, 5, -1))
    np.testing.assert_array_equal(read_image(tmp_path / "a.exr"), layers[""])


@needs("aov")
def test_layers_of_a_real_renderer():
    layers = read_layers(REAL_DATA / "aov" / "mitsuba_multi_channels.exr")
    shapes = {name: values.shape for name, values in layers.items()}
    assert shapes == {
        "": (256, 256, 3),
        "depth": (256, 256, 1),
        "image": (256, 256, 4),
        "position": (256, 256, 3),
        "sh_normal": (256, 256, 3),
    }
    lengths = np.linalg.norm(layers["sh_normal"], axis=-1)
    # Averaged over a pixel's samples, lengths at edges lie between.
    assert np.median(np.abs(lengths[lengths > 0.5] - 1)) < 1e-5


def test_parts_of_an_exr(tmp_path):
    values = random(4, 6, 3), random(4, 6, 1, seed=1)
    specs = [oiio.ImageSpec(6, 4, 3, "float"), oiio.ImageSpec(6, 4, 1, "float")]
    specs[0].attribute("oiio:subimagename", "rgb")
    specs[1].attribute("oiio:subimagename", "depth")
    specs[1].channelnames = ("Z",)
    for order in ([0, 1], [1, 0]):
        file = oiio.ImageOutput.create("a.exr")
        assert file.open(str(tmp_path / "a.exr"), tuple(specs[index] for index in order))
        for step, index in enumerate(order):
            if step:
                assert file.open(str(tmp_path / "a.exr"), specs[index], "AppendSubimage")
            assert file.write_image(values[index])
        assert file.close()
        np.testing.assert_array_equal(read_image(tmp_path / "a.exr"), values[0])
        layers = read_layers(tmp_path / "a.exr")
        np.testing.assert_array_equal(layers["rgb"], values[0])
        np.testing.assert_array_equal(layers["depth"], values[1])


def test_masks(tmp_path):
    inside = random(8, 9) > 0.5
    white = np.where(inside, 255, 0).astype(np.uint8)
    (tmp_path / "white.png").write_bytes(png(white[..., None].repeat(3, 2)))
    (tmp_path / "one.png").write_bytes(png(inside.astype(np.uint8)[..., None], colour_type=0))
    (tmp_path / "alpha.png").write_bytes(png(np.dstack([codes(8, 9, 3), white]), colour_type=6))
    (tmp_path / "opaque.png").write_bytes(png(np.dstack([white] * 3 + [np.full_like(white, 255)]), colour_type=6))
    raw_exr(tmp_path / "float.exr", np.where(inside, 1, np.nan)[..., None].astype(np.float32), ["Y"])
    for name, alpha in (("faint.png", 254), ("nothing.png", 0), ("veiled.png", np.where(inside, 255, 200))):
        # Alpha that keeps all pixels, or none, was not meant.
        pixels = np.dstack([white] * 3 + [np.broadcast_to(alpha, white.shape).astype(np.uint8)])
        (tmp_path / name).write_bytes(png(pixels, colour_type=6))
    names = ("white.png", "one.png", "alpha.png", "opaque.png", "float.exr", "faint.png", "nothing.png", "veiled.png")
    for name in names:
        np.testing.assert_array_equal(read_mask(tmp_path / name), inside, err_msg=name)
    (tmp_path / "black.png").write_bytes(png(np.zeros((3, 3, 3), np.uint8)))
    assert not read_mask(tmp_path / "black.png").any()


# --- windows, orientation, bands ---------------------------------------------------------------------------------


@pytest.mark.parametrize("tile", [0, 16])
@pytest.mark.parametrize("shift", [(3, 5), (-4, -7), (0, 0)])
def test_the_display_window_is_the_picture(tmp_path, tile, shift):
    values = random(40, 50, 3)
    path = raw_exr(tmp_path / "a.exr", values, "RGB", tile=tile, data_at=shift, display=(0, 0, 50, 40))
    expected = np.full((40, 50, 3), np.nan, np.float32)
    for y in range(40):
        for x in range(50):
            if 0 <= y - shift[1] < 40 and 0 <= x - shift[0] < 50:
                expected[y, x] = values[y - shift[1], x - shift[0]]
    np.testing.assert_array_equal(read_image(path), expected)
    with ImageReader(path) as reader:
        np.testing.assert_array_equal(np.concatenate([reader.rows(k, k + 8) for k in range(0, 40, 8)]), expected)


@pytest.mark.parametrize("turn", range(1, 9))
def test_a_photograph_comes_upright(tmp_path, turn):
    upright = codes(4, 6, 3)
    # Where the picture's first row and column lie as seen by a person, from the Exif table.
    stored = {
        1: upright,
        2: upright[:, ::-1],
        3: upright[::-1, ::-1],
        4: upright[::-1],
        5: upright.transpose(1, 0, 2),
        6: np.rot90(upright, 1),
        7: upright[::-1, ::-1].transpose(1, 0, 2),
        8: np.rot90(upright, -1),
    }[turn]
    spec = oiio.ImageSpec(stored.shape[1], stored.shape[0], 3, "uint8")
    spec.attribute("Orientation", turn)
    file = oiio.ImageOutput.create("a.tif")
    assert file.open(str(tmp_path / "a.tif"), spec)
    assert file.write_image(np.ascontiguousarray(stored))
    assert file.close()
    np.testing.assert_allclose(read_image(tmp_path / "a.tif", encoding="linear"), upright / 255, rtol=1e-6)
    with ImageReader(tmp_path / "a.tif", encoding="linear") as reader:
        assert reader.shape == (4, 6, 3)
        np.testing.assert_allclose(reader.rows(1, 3), upright[1:3] / 255, rtol=1e-6)


@pytest.mark.parametrize(
    ("suffix", "kind"), [(".exr", "float"), (".exr", "half"), (".png", "uint8"), (".png", "uint16"), (".tif", "uint16")]
)
def test_bands_are_the_picture(tmp_path, suffix, kind):
    write_image(tmp_path / f"a{suffix}", random(133, 57, 3), dtype=kind, alpha=random(133, 57))
    whole = read_picture(tmp_path / f"a{suffix}")
    with ImageReader(tmp_path / f"a{suffix}") as reader:
        assert reader.shape == (133, 57, 3)
        bands = list(reader.bands(values=57 * 4 * 20))
        np.testing.assert_array_equal(np.concatenate([pixels for _, pixels in bands]), whole.pixels)
        starts = [start for start, _ in bands]
        assert starts[0] == 0
        assert len(starts) > 2
        np.testing.assert_array_equal(reader.rows(10, 30), whole.pixels[10:30])
        np.testing.assert_array_equal(reader.alpha_rows(7, 9), whole.alpha[7:9])
        assert reader.rows(5, 5).shape == (0, 57, 3)
        for wrong in ((-1, 3), (0, 134), (5, 4)):
            with pytest.raises(IndexError):
                reader.rows(*wrong)


def test_a_large_picture_is_read_in_bands(tmp_path, monkeypatch):
    values = random(200, 30, 3)
    raw_exr(tmp_path / "a.exr", values, "RGB", tile=16)
    monkeypatch.setattr("brdf.images.reader._BAND_VALUES", 1000)
    np.testing.assert_array_equal(read_image(tmp_path / "a.exr"), values)


# --- writing -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", [(7, 5), (7, 5, 1), (7, 5, 3)])
@pytest.mark.parametrize(
    ("suffix", "kind", "encoding", "tolerance"),
    [
        (".exr", None, None, 0),
        (".exr", "half", None, 2**-12),
        (".hdr", None, None, 2**-8),
        (".tif", None, None, 0),
        (".tif", "uint8", None, 1 / 255),
        (".tiff", "uint16", "linear", 0.51 / 65535),
        (".tif", "uint16", "srgb", 1e-4),
        (".png", None, None, 1 / 255),
        (".png", "uint8", "linear", 0.51 / 255),
        (".png", "uint16", None, 1e-4),
        (".png", "uint16", "linear", 0.51 / 65535),
        (".png", "uint8", 2.2, 1 / 255),
        (".jpg", None, None, 0.2),
    ],
)
def test_what_is_written_reads_back(tmp_path, shape, suffix, kind, encoding, tolerance):
    values = random(*shape)
    path = tmp_path / f"a{suffix}"
    write_image(path, values, dtype=kind, encoding=encoding)
    picture = read_picture(path)
    expected = np.broadcast_to(values.reshape(7, 5, -1), picture.pixels.shape)
    # A code of sRGB is up to 2.28 codes wide in linear light, half of it is the rounding: less than 1.14 codes.
    np.testing.assert_allclose(picture.pixels, expected, rtol=0, atol=1.14 * tolerance + (1e-9 if tolerance else 0))
    assert picture.source != "assumed" or encoding == "linear"
    assert [item.name for item in tmp_path.iterdir()] == [path.name]


def test_a_png_says_how_it_is_encoded(tmp_path):
    write_image(tmp_path / "a.png", random(4, 4, 3))
    write_image(tmp_path / "b.png", random(4, 4, 3), encoding="linear")
    assert b"sRGB" in (tmp_path / "a.png").read_bytes()
    linear = (tmp_path / "b.png").read_bytes()
    assert b"sRGB" not in linear
    assert b"gAMA" + struct.pack(">I", 100000) in linear


def test_a_png_is_encoded_by_the_formula(tmp_path):
    write_image(tmp_path / "a.png", np.linspace(0, 1, 256, dtype=np.float32).reshape(16, 16))
    stored = oiio.ImageInput.open(str(tmp_path / "a.png")).read_image("uint8").ravel()
    linear = np.linspace(0, 1, 256)
    formula = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    np.testing.assert_allclose(stored, 255 * formula, rtol=0, atol=0.51)


def test_numbers_that_are_no_codes(tmp_path):
    write_image(tmp_path / "a.png", np.array([[np.nan, -1, np.inf, 7, -np.inf]]), encoding="linear")
    np.testing.assert_array_equal(read_image(tmp_path / "a.png")[0, :, 0], [0, 0, 1, 1, 0])
    write_image(tmp_path / "a.exr", np.array([[np.nan, -1, np.inf, 7, -np.inf]]))
    np.testing.assert_array_equal(read_image(tmp_path / "a.exr")[0, :, 0], [np.nan, -1, np.inf, 7, -np.inf])


@pytest.mark.parametrize("channels", [2, 4, 31, 100])
@pytest.mark.parametrize("suffix", [".exr", ".tif"])
def test_any_number_of_channels(tmp_path, channels, suffix):
    values, alpha = random(4, 5, channels), random(4, 5, seed=1)
    write_image(tmp_path / f"a{suffix}", values)
    np.testing.assert_array_equal(read_image(tmp_path / f"a{suffix}"), values)
    write_image(tmp_path / "a.exr", values, alpha=alpha)
    picture = read_picture(tmp_path / "a.exr")
    np.testing.assert_array_equal(picture.pixels, values)
    np.testing.assert_array_equal(picture.alpha, alpha)


@pytest.mark.parametrize(
    ("name", "array", "options", "said"),
    [
        ("a.xyz", np.ones((2, 2)), {}, r"\.xyz is no image format\. Use one of \.exr \.hdr \.png"),
        ("a", np.ones((2, 2)), {}, "no suffix"),
        ("a.png", np.ones((2, 2)), {"dtype": "float"}, "cannot hold float. Use uint8 or uint16"),
        ("a.png", np.ones((2, 2, 4)), {}, "holds 1 or 3 channels, got 4"),
        ("a.exr", np.ones((2, 2)), {"encoding": "srgb"}, "cannot say"),
        ("a.tif", np.ones((2, 2)), {"dtype": "uint8", "encoding": "linear"}, "cannot say"),
        ("a.jpg", np.ones((2, 2)), {"encoding": 2.2}, "cannot say"),
        ("a.exr", np.full((2, 2), 1e5), {"dtype": "half"}, "half floats end"),
        ("a.exr", np.ones(3), {}, r"got shape \(3,\)"),
        ("a.exr", np.ones((0, 3)), {}, r"got shape \(0, 3\)"),
        ("a.exr", "pixels", {}, "no numbers"),
        ("a.exr", [[1, 2], [3]], {}, "no numbers"),
        ("a.exr", np.ones((2, 2), complex), {}, "no numbers"),
        ("a.exr", np.ones((2, 2)), {"alpha": np.ones((2, 3))}, "alpha of shape"),
        ("a.jpg", np.ones((2, 2)), {"alpha": np.ones((2, 2))}, "alpha of shape"),
        ("missing/a.exr", np.ones((2, 2)), {}, "no such file or folder"),
    ],
)
def test_what_cannot_be_written(tmp_path, name, array, options, said):
    with pytest.raises(InputError, match=said):
        write_image(tmp_path / name, array, **options)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("name", "layers"),
    [("a.png", {"": np.ones((2, 2))}), ("a.exr", {}), ("a.exr", {"a": np.ones((2, 2)), "b": np.ones((2, 3))})],
)
def test_layers_that_cannot_be_written(tmp_path, name, layers):
    with pytest.raises(InputError):
        write_layers(tmp_path / name, layers)


@pytest.mark.parametrize(
    ("suffix", "reserved"), [(".exr", 1), (".tif", 1), (".hdr", 1), (".png", 1), (".png", 0), (".jpg", 1)]
)
def test_a_full_disk_leaves_nothing(tmp_path, suffix, reserved):
    code = """
import resource, signal, sys
import numpy as np
from brdf.errors import InputError
from brdf.images import writer as image_writer
from brdf.images.pictures import write_image
if sys.argv[2] == "0":
    image_writer._reserve = lambda *_: None
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))
try:
    write_image(sys.argv[1], np.random.default_rng(0).random((200, 200, 3)))
except InputError as error:
    print(error)
"""
    path = tmp_path / f"a{suffix}"
    path.write_bytes(b"old")
    command = [sys.executable, "-c", code, str(path), str(reserved)]
    result = subprocess.run(command, cwd=PROJECT, capture_output=True, text=True, timeout=60, check=False)
    assert result.returncode == 0
    assert result.stdout.startswith((f"{path}: cannot be written", f"{path}: the file would be larger than allowed"))
    assert result.stderr == ""
    assert [item.name for item in tmp_path.iterdir()] == [path.name]
    assert path.read_bytes() == b"old"


# --- wrong input -------------------------------------------------------------------------------------------------


def test_what_is_no_picture(tmp_path):
    (tmp_path / "empty.png").touch()
    (tmp_path / "text.exr").write_text("Not an image.")
    (tmp_path / "a.null").write_text("x")
    (tmp_path / "folder.exr").mkdir()
    for name, said in [
        ("missing.exr", "no such file"),
        ("empty.png", "is empty"),
        ("text.exr", "cannot be read as an image"),
        ("a.null", "image"),
        ("folder.exr", "is a folder"),
    ]:
        for reader in (read_image, read_picture, read_layers, read_mask, ImageReader):
            with pytest.raises(InputError, match=said) as caught:
                reader(tmp_path / name)
            assert str(caught.value).startswith(f"{tmp_path / name}: ")
            assert "\n" not in str(caught.value)


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".tif", ".hdr", ".exr"])
@pytest.mark.parametrize("part", [0.05, 0.5, 0.95])
def test_a_truncated_file(tmp_path, suffix, part, capfd):
    write_image(tmp_path / f"a{suffix}", random(60, 70, 3))
    content = (tmp_path / f"a{suffix}").read_bytes()
    (tmp_path / f"b{suffix}").write_bytes(content[: int(part * len(content))])
    with pytest.raises(InputError, match=r"damaged|cannot be read"):
        read_image(tmp_path / f"b{suffix}")
    assert capfd.readouterr().err == ""


def test_a_picture_that_its_file_cannot_hold(tmp_path):
    huge = struct.pack(">IIBBBBB", 30000, 30000, 8, 2, 0, 0, 0)
    data = (
        b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", huge) + chunk(b"IDAT", zlib.compress(bytes(1000))) + chunk(b"IEND", b"")
    )
    (tmp_path / "a.png").write_bytes(data)
    with pytest.raises(InputError, match="claims"):
        read_image(tmp_path / "a.png")


def test_a_display_window_that_is_absurd(tmp_path):
    raw_exr(tmp_path / "a.exr", random(4, 4, 3), "RGB", display=(0, 0, 900_000, 900_000))
    with pytest.raises(InputError, match="claims 900000 × 900000 pixels"):
        read_image(tmp_path / "a.exr")
    raw_exr(tmp_path / "b.exr", random(4, 4, 3), "RGB", display=(100, 100, 4, 4))
    with pytest.raises(InputError, match="no data inside its display window"):
        read_image(tmp_path / "b.exr")


def test_a_picture_larger_than_memory(tmp_path, monkeypatch):
    raw_exr(tmp_path / "a.exr", random(40, 40, 3), "RGB")
    monkeypatch.setattr(image_file, "MAX_VALUES", 40 * 40 * 3 - 1)
    for reader in (read_image, read_layers):
        with pytest.raises(InputError, match="by bands of rows"):
            reader(tmp_path / "a.exr")
    with ImageReader(tmp_path / "a.exr") as reader:
        assert reader.rows(0, 20).shape == (20, 40, 3)


def test_deep_data(tmp_path):
    spec = oiio.ImageSpec(4, 4, 5, "float")
    spec.channelnames, spec.z_channel, spec.alpha_channel, spec.deep = ("R", "G", "B", "A", "Z"), 4, 3, True
    file = oiio.ImageOutput.create("a.exr")
    assert file.open(str(tmp_path / "a.exr"), spec)
    samples = oiio.DeepData()
    samples.init(16, 5, (oiio.TypeDesc("float"),) * 5, spec.channelnames)
    assert file.write_deep_image(samples)
    assert file.close()
    with pytest.raises(InputError, match="deep samples"):
        read_image(tmp_path / "a.exr")


def test_libpng_is_kept_quiet_but_others_are_heard(capfd):
    with image_file.quiet("png"), image_file.quiet("png"):
        os.write(2, b"libpng error: bad\nsomeone else\n")
        assert capfd.readouterr().err == ""
    assert capfd.readouterr().err == "someone else\n"


def test_reading_in_threads(tmp_path):
    (tmp_path / "a.png").write_bytes(png(codes(64, 64, 3)))
    expected, failed = read_image(tmp_path / "a.png"), []

    def read():
        for _ in range(20):
            if not np.array_equal(read_image(tmp_path / "a.png"), expected):
                failed.append(True)

    threads = [threading.Thread(target=read) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not failed


READ_AND_REPORT = """
import sys
from brdf.errors import InputError
from brdf.images.pictures import read_image, read_layers
for path in sys.argv[1:]:
    for reader in (read_image, read_layers):
        try:
            reader(path)
            print("image")
        except InputError as error:
            print(error)
# Not getrusage: its peak counts the parent's at the fork.
print(int(open("/proc/self/status").read().split("VmHWM:")[1].split()[0]) // 1024)
"""


@pytest.mark.skipif(not BAD_IMAGES, reason=f"{REAL_DATA / 'bad-images'} is missing (BRDF_REAL_DATA)")
@pytest.mark.parametrize("first", range(0, max(len(BAD_IMAGES), 1), 26))
def test_damaged_and_hostile_files(first):
    paths = [str(path) for path in BAD_IMAGES[first : first + 26]]
    command = [sys.executable, "-c", READ_AND_REPORT, *paths]
    result = subprocess.run(command, cwd=PROJECT, capture_output=True, text=True, timeout=120, check=False)
    assert (result.returncode, result.stderr) == (0, "")
    *lines, megabytes = result.stdout.splitlines()
    assert len(lines) == 2 * len(paths)
    for path, line in zip(np.repeat(paths, 2), lines, strict=True):
        assert line == "image" or line.startswith(f"{path}: ")
    # Several files in one process, each within half a gigabyte.
    assert int(megabytes) < 500


@pytest.mark.parametrize("seed", range(8))
def test_mutated_files_give_an_image_or_an_error(tmp_path, seed):
    rng = np.random.default_rng(seed)
    seeds = {}
    for suffix, kind in [(".png", None), (".jpg", None), (".tif", "uint8"), (".hdr", None), (".exr", "half")]:
        write_image(tmp_path / f"seed{suffix}", random(16, 24, 3), dtype=kind)
        seeds[suffix] = np.frombuffer((tmp_path / f"seed{suffix}").read_bytes(), np.uint8)
    for suffix, content in seeds.items():
        for _ in range(20):
            mutated = content.copy()
            at = rng.integers(0, min(len(mutated), 400), rng.integers(1, 5))
            mutated[at] = rng.integers(0, 256, len(at))
            (tmp_path / f"a{suffix}").write_bytes(mutated.tobytes())
            with suppress(InputError):
                assert read_picture(tmp_path / f"a{suffix}").pixels.ndim == 3


def test_messages_do_not_repeat_long_paths_nor_lose_the_name(tmp_path):
    folder = tmp_path / ("a long name of a folder " * 8)
    folder.mkdir()
    for name in ("a picture.jpg", "a picture.xyz", "a picture.png", "a picture.tif", "a picture.exr"):
        (folder / name).write_bytes(b"hello world")
        with pytest.raises(InputError) as told:
            read_image(folder / name)
        assert str(told.value).count("a long name of a folder") == 8
        assert str(told.value).startswith(f"{folder / name}: ".replace(" / ", "/"))


def test_a_reader_is_an_array_for_what_takes_arrays(tmp_path):
    (tmp_path / "a.png").write_bytes(png(codes(5, 7, 3)))
    with ImageReader(tmp_path / "a.png") as reader:
        np.testing.assert_array_equal(np.asarray(reader), read_image(tmp_path / "a.png"))
        assert np.asarray(reader, np.float64).dtype == np.float64
