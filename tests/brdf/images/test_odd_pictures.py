"""Rare pictures: formats cut short, odd channels and codes, headers that claim what is not there."""

import struct
import zlib
from pathlib import Path

import numpy as np
import OpenImageIO as oiio  # noqa: N813
import pytest

import brdf
from brdf.errors import InputError

HEIGHT, WIDTH = 40, 60
VALUES = np.random.default_rng(0).random((HEIGHT, WIDTH, 3)).astype(np.float32)
KINDS = {"exr": "float", "tif": "float", "hdr": "float", "pfm": "float", "fits": "float", "rla": "uint16"}
KINDS |= {name: "uint8" for name in ("png", "dpx", "webp", "gif", "tga", "bmp", "jp2", "ppm", "sgi", "iff", "jpg")}


def write(path: Path, values: np.ndarray, kind: str, names: tuple[str, ...] = (), tile: int = 0) -> None:
    spec = oiio.ImageSpec(values.shape[1], values.shape[0], values.shape[2], kind)
    if names:
        spec.channelnames = names
    spec.tile_width = spec.tile_height = tile
    file = oiio.ImageOutput.create(str(path))
    if file is None:
        oiio.geterror()
        pytest.skip(f"OpenImageIO was built without a writer for {path.suffix}")
    assert file.open(str(path), spec), file.geterror()
    assert file.write_image(values), file.geterror()
    assert file.close()


def png(width: int, height: int, depth: int, colour: int, rows: bytes, *before: tuple[bytes, bytes]) -> bytes:
    header = struct.pack(">IIBBBBB", width, height, depth, colour, 0, 0, 0)
    chunks = [(b"IHDR", header), *before, (b"IDAT", zlib.compress(rows)), (b"IEND", b"")]
    packed = [
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data)) for kind, data in chunks
    ]
    return b"\x89PNG\r\n\x1a\n" + b"".join(packed)


@pytest.mark.parametrize("share", [0.3, 0.7])
@pytest.mark.parametrize("suffix", KINDS)
def test_a_file_cut_short_is_told(tmp_path, capfd, suffix, share):
    path = tmp_path / f"cut.{suffix}"
    write(path, VALUES, KINDS[suffix])
    assert brdf.read_image(path).shape == (HEIGHT, WIDTH, 3)
    path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])
    with pytest.raises(InputError, match=r"is damaged|cannot be read as an image"):
        brdf.read_image(path)
    assert capfd.readouterr() == ("", "")


def test_odd_pictures_are_read_right(tmp_path):
    bits = np.random.default_rng(1).integers(0, 2, (5, 16), np.uint8)
    rows = b"".join(b"\0" + row.tobytes() for row in np.packbits(bits, axis=1))
    (tmp_path / "bits.png").write_bytes(png(16, 5, 1, 0, rows))
    np.testing.assert_array_equal(brdf.read_image(tmp_path / "bits.png")[..., 0], bits)
    index = np.random.default_rng(1).integers(0, 3, (5, 7), np.uint8)
    colours = np.array([[255, 0, 0], [0, 255, 0], [0, 0, 255]], np.uint8)
    rows = b"".join(b"\0" + row.tobytes() for row in index)
    (tmp_path / "palette.png").write_bytes(png(7, 5, 8, 3, rows, (b"PLTE", colours.tobytes())))
    np.testing.assert_allclose(brdf.read_image(tmp_path / "palette.png"), colours[index] / 255, atol=1e-7)
    for name, shape in (("one.exr", (1, 1, 3)), ("wide.exr", (1, 16384, 3)), ("tall.exr", (16384, 1, 1))):
        values = np.random.default_rng(2).random(shape).astype(np.float32)
        write(tmp_path / name, values, "float", ("Y",) if shape[2] == 1 else ())
        np.testing.assert_array_equal(brdf.read_image(tmp_path / name), values)
    for name in ("tiles.exr", "tiles.tif"):
        write(tmp_path / name, VALUES, "float", tile=16)
        np.testing.assert_array_equal(brdf.read_image(tmp_path / name), VALUES)
    bands = np.random.default_rng(3).random((4, 6, 5)).astype(np.float32)
    write(tmp_path / "bands.exr", bands, "float", ("b1", "b2", "b3", "b4", "b5"))
    np.testing.assert_array_equal(brdf.read_image(tmp_path / "bands.exr"), bands)
    write(tmp_path / "signed.tif", VALUES, "int16")
    np.testing.assert_allclose(brdf.read_image(tmp_path / "signed.tif"), VALUES, atol=2 / 32767)
    layers = np.concatenate([VALUES, np.full_like(VALUES, np.nan)], axis=-1)
    write(tmp_path / "layers.exr", layers, "float", ("R", "G", "B", "N.X", "N.Y", "N.Z"))
    np.testing.assert_array_equal(brdf.read_image(tmp_path / "layers.exr"), VALUES)


CLAIMS = {
    "huge.png": png(2**31 - 1, 2**31 - 1, 8, 2, b""),
    "wide.png": png(2**30, 1, 16, 6, b""),
    "depth.png": png(60, 40, 3, 2, bytes(181 * 40)),
    "no_palette.png": png(60, 40, 8, 3, bytes(61 * 40)),
    "few_rows.png": png(60, 40, 8, 2, bytes(181 * 10)),
    "huge.hdr": b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 2000000000 +X 2000000000\n",
    "huge.ppm": b"P6 99999999 99999999 255\n",
    "negative.ppm": b"P6 -5 7 255\n12345678",
    "letters.ppm": b"P3\n2 2\n255\n1 2 3 a b c",
    "huge.pfm": b"PF\n999999999 999999999\n-1.0\n",
    "page.jpg": b"<!DOCTYPE html><html>404</html>",
    "drawing.png": b"<svg xmlns='http://www.w3.org/2000/svg'/>",
    "a name with spaces\nand a new line \u00fc \u5b57.png": b"\x89PNG\r\n\x1a\n",
}


@pytest.mark.parametrize("name", CLAIMS)
def test_what_a_header_claims_costs_nothing(tmp_path, name):
    (tmp_path / name).write_bytes(CLAIMS[name])
    with pytest.raises(InputError, match=r"is damaged|cannot be read as an image"):
        brdf.read_picture(tmp_path / name)
