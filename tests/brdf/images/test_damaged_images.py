"""Image files that are damaged, hostile, or more than there is room for."""

import os
import struct
import subprocess
import sys
import threading
import zlib
from contextlib import suppress

import numpy as np
import OpenImageIO as oiio  # noqa: N813
import pytest
from image_files import (
    BAD_IMAGES,
    REAL,
    ROOT,
    chunk,
    codes,
    png,
    random,
    raw_exr,
)

from brdf.errors import InputError
from brdf.images import file as image_file
from brdf.images.reading import (
    ImageReader,
    read_image,
    read_layers,
    read_mask,
    read_picture,
    write_image,
)


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
from brdf.images.reading import read_image, read_layers
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


@pytest.mark.skipif(not BAD_IMAGES, reason=f"{REAL / 'bad-images'} is missing (BRDF_REAL_DATA)")
@pytest.mark.parametrize("first", range(0, max(len(BAD_IMAGES), 1), 26))
def test_damaged_and_hostile_files(first):
    paths = [str(path) for path in BAD_IMAGES[first : first + 26]]
    command = [sys.executable, "-c", READ_AND_REPORT, *paths]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120, check=False)
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
