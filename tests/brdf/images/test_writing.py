"""Image files written: what reads back, what cannot be written, and a full disk."""

import struct
import subprocess
import sys
import time

import numpy as np
import OpenImageIO as oiio
import pytest
from image_files import ROOT, random

from brdf.errors import InputError
from brdf.images.reading import read_image, read_picture
from brdf.images.writing import write_image, write_layers


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
    for other in (values.transpose(1, 0, 2), values[::-1, ::2], np.broadcast_to(values[:1, :1], values.shape)):
        write_image(tmp_path / "b.exr", other)
        np.testing.assert_array_equal(read_image(tmp_path / "b.exr"), other)


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
        ("missing/a.exr", np.ones((2, 2)), {}, "there is no folder"),
    ],
)
def test_what_cannot_be_written(tmp_path, name, array, options, said):
    with pytest.raises(InputError, match=said):
        write_image(tmp_path / name, array, **options)
    assert not list(tmp_path.iterdir())


def test_hdr_has_no_sign(tmp_path):
    """It held 3 for -1, and 0 0 0 where a value was beyond the format's."""
    path = tmp_path / "a.hdr"
    write_image(path, [[[-1.0, 2.0, 0.5], [np.nan, 0.25, 1e38]]])
    # Half a step above what was written, of the channels' shared exponent.
    half, other = 2**-7, 2.0**118
    expected = [[[half, 2 + half, 0.5 + half], [other, other, 1e38]]]
    np.testing.assert_allclose(read_image(path), expected, rtol=2**-8)
    for beyond in (2e38, np.inf):
        with pytest.raises(InputError, match="values in HDR end at"):
            write_image(path, [[[beyond]]])


@pytest.mark.parametrize("suffix", [".exr", ".tif", ".hdr", ".png", ".jpg"])
def test_a_file_does_not_hang_on_the_time_of_day(tmp_path, suffix, monkeypatch):
    files = []
    for seconds in ("UTC+0", "UTC+1"):
        monkeypatch.setenv("TZ", seconds)
        time.tzset()
        path = tmp_path / f"{seconds}{suffix}"
        write_image(path, np.full((4, 4, 3), 0.5))
        files.append(path.read_bytes())
    assert files[0] == files[1]


@pytest.mark.parametrize(
    ("name", "layers"),
    [("a.png", {"": np.ones((2, 2))}), ("a.exr", {}), ("a.exr", {"a": np.ones((2, 2)), "b": np.ones((2, 3))})],
)
def test_layers_that_cannot_be_written(tmp_path, name, layers):
    with pytest.raises(InputError):
        write_layers(tmp_path / name, layers)


@pytest.mark.parametrize(("suffix", "asked"), [(".exr", 1), (".tif", 0), (".hdr", 0), (".png", 1), (".jpg", 1)])
def test_a_full_disk_leaves_nothing(tmp_path, suffix, asked):
    """Where the system is asked for the space before, and where nobody can be asked and the writer fails."""
    code = """
import resource, signal, sys
import numpy as np
from brdf.errors import InputError
from brdf.images import writing as image_writer
from brdf.images.writing import write_image
if sys.argv[2] == "0":
    image_writer._ask_for_space = lambda *_: None
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))
try:
    write_image(sys.argv[1], np.random.default_rng(0).random((200, 200, 3)))
except InputError as error:
    print(error)
"""
    path = tmp_path / f"a{suffix}"
    path.write_bytes(b"old")
    command = [sys.executable, "-c", code, str(path), str(asked)]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=60, check=False)
    assert result.returncode == 0
    assert result.stdout.startswith((f"{path}: cannot be written", f"{path}: the file would be larger than allowed"))
    assert result.stderr == ""
    assert [item.name for item in tmp_path.iterdir()] == [path.name]
    assert path.read_bytes() == b"old"
