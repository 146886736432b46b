"""Image files that are damaged, hostile, or more than there is room for: each is a picture or one clear line."""

import os
import struct
import subprocess
import sys
import threading
import tracemalloc
import zlib
from contextlib import suppress
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest
from image_files import BAD_IMAGES, REAL, ROOT, chunk, codes, needs, png, random, raw, raw_png

import brdf
from brdf.errors import InputError
from brdf.files import read_text, write_text
from brdf.images import damage
from brdf.images.reading import ImageReader, read_image, read_layers, read_mask, read_picture
from brdf.images.writing import write_image

READERS = (read_image, read_picture, read_layers, read_mask, ImageReader)


def refused(path, said, readers=READERS):
    """One line that names the file, from every reader."""
    for reader in readers:
        with pytest.raises(InputError, match=said) as told:
            reader(path)
        assert str(told.value).startswith(f"{path}: ")
        assert str(told.value).isprintable()


# --- bytes ------------------------------------------------------------------------------------------------------------


def attribute(name: bytes, kind: bytes, value: bytes) -> bytes:
    return name + b"\0" + kind + b"\0" + struct.pack("<I", len(value)) + value


def channel_list(count: int) -> bytes:
    return b"".join(b"c%05d\0" % index + struct.pack("<IIII", 2, 0, 1, 1) for index in range(count)) + b"\0"


def exr_header(channels: int = 3, further: int = 0, tile: int = 0, before: int = 0, size: int = 4) -> bytes:
    """The attributes of one part after the file's layout."""
    window = struct.pack("<4i", 0, 0, size - 1, size - 1)
    parts = [attribute(b"preview", b"string", bytes(before))] if before else []
    parts += [attribute(b"channels", b"chlist", channel_list(channels)), attribute(b"lineOrder", b"lineOrder", b"\0")]
    parts += [attribute(name, b"box2i", window) for name in (b"dataWindow", b"displayWindow")]
    parts += [attribute(name, b"float", struct.pack("<f", 1)) for name in (b"pixelAspectRatio", b"screenWindowWidth")]
    parts += [attribute(b"compression", b"compression", b"\0"), attribute(b"screenWindowCenter", b"v2f", bytes(8))]
    parts += [attribute(b"tiles", b"tiledesc", struct.pack("<IIB", tile, tile, 0))] if tile else []
    return b"".join(parts) + b"".join(attribute(b"a%d" % index, b"string", b"x") for index in range(further)) + b"\0"


def exr(flags: int, *headers: bytes) -> bytes:
    return b"v/1\x01" + struct.pack("<I", 2 | flags) + b"".join(headers) + b"\0" * bool(flags & 0x1000) + bytes(4096)


def white_fax(size: int) -> bytes:
    """A TIFF file of 1-bit pixels in one strip of CCITT Group 4, where a row like the one above is a single bit."""
    strip = b"\xff" * -(-size // 8)
    tags = {256: size, 257: size, 258: 1, 259: 4, 262: 0, 273: 8, 277: 1, 278: size, 279: len(strip)}
    strip += bytes(len(strip) % 2)
    directory = b"".join(struct.pack("<HHII", tag, 4, 1, value) for tag, value in tags.items())
    return b"II*\0" + struct.pack("<I", 8 + len(strip)) + strip + struct.pack("<H", len(tags)) + directory + bytes(4)


PNG = png(codes(20, 30, 3))
HUGE = chunk(b"IHDR", struct.pack(">IIBBBBB", 30000, 30000, 8, 2, 0, 0, 0))
HUGE_PNG = PNG[:8] + HUGE + chunk(b"IDAT", zlib.compress(bytes(1000))) + chunk(b"IEND", b"")

BAD = {
    "empty.png": (b"", "is empty"),
    "text.exr": (b"Not an image.", "cannot be read as an image"),
    "a.null": (b"x", "cannot be read as an image"),
    "cut.png": (PNG[:200], "is damaged"),
    "flipped.png": (PNG[:200] + b"!" + PNG[201:], "is damaged: the checksum of its IDAT is wrong"),
    "header.png": (PNG[:20] + b"!" + PNG[21:], "is damaged: the checksum of its IHDR is wrong"),
    "huge.png": (HUGE_PNG, "claims"),
    "attributes.exr": (exr(0, exr_header(further=20_000)), "holds more than 4096 attributes"),
    "behind.exr": (exr(0, exr_header(before=1 << 20, further=20_000)), "holds more than 4096 attributes"),
    "channels.exr": (exr(0, exr_header(channels=20_000)), "holds more than 4096 channels"),
    "second.exr": (exr(0x1000, exr_header(), exr_header(further=20_000)), "holds more than 4096 attributes"),
    "tiles.exr": (exr(0x200, exr_header(tile=20_000)), "claims 20000 × 20000 pixels of 3 channels in"),
    "large tiles.exr": (exr(0x200, exr_header(tile=2600, size=2300))[:-4000], "claims 2600 × 2600 pixels"),
    "fax.tif": (white_fax(30_000), "claims 30000 × 30000 pixels"),
}

CLAIMS = {
    "huge.png": raw_png(2**31 - 1, 2**31 - 1, 8, 2, b""),
    "wide.png": raw_png(2**30, 1, 16, 6, b""),
    "depth.png": raw_png(60, 40, 3, 2, bytes(181 * 40)),
    "no_palette.png": raw_png(60, 40, 8, 3, bytes(61 * 40)),
    "few_rows.png": raw_png(60, 40, 8, 2, bytes(181 * 10)),
    "huge.hdr": b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 2000000000 +X 2000000000\n",
    "huge.ppm": b"P6 99999999 99999999 255\n",
    "negative.ppm": b"P6 -5 7 255\n12345678",
    "letters.ppm": b"P3\n2 2\n255\n1 2 3 a b c",
    "huge.pfm": b"PF\n999999999 999999999\n-1.0\n",
    "page.jpg": b"<!DOCTYPE html><html>404</html>",
    "drawing.png": b"<svg xmlns='http://www.w3.org/2000/svg'/>",
}

BAD |= {name: (content, r"is damaged|claims|cannot be read as an image") for name, content in CLAIMS.items()}


@pytest.mark.parametrize("name", BAD)
def test_what_is_no_picture(tmp_path, name, capfd):
    content, said = BAD[name]
    (tmp_path / name).write_bytes(content)
    # Some headers are sound.
    refused(tmp_path / name, said, READERS[:-1] if name in CLAIMS else READERS)
    # What is damaged with sound checksums libpng tells itself.
    assert name in CLAIMS or capfd.readouterr() == ("", "")


def test_what_is_no_file(tmp_path):
    (tmp_path / "folder.exr").mkdir()
    refused(tmp_path / "folder.exr", "is a folder")
    refused(tmp_path / "missing.exr", "no such file")


KINDS = {"exr": "float", "tif": "float", "hdr": "float", "pfm": "float", "fits": "float", "rla": "uint16"}
KINDS |= dict.fromkeys("png dpx webp gif tga bmp jp2 ppm sgi iff jpg".split(), "uint8")


@pytest.mark.parametrize("share", [0.3, 0.7])
@pytest.mark.parametrize("suffix", KINDS)
def test_a_file_cut_short_is_told(tmp_path, capfd, suffix, share):
    path = tmp_path / f"cut.{suffix}"
    if oiio.ImageOutput.create(str(path)) is None:
        oiio.geterror()
        pytest.skip(f"OpenImageIO was built without a writer for {suffix}")
    raw(path, random(40, 60, 3), kind=KINDS[suffix])
    assert read_image(path).shape == (40, 60, 3)
    path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])
    refused(path, r"is damaged|cannot be read as an image", [read_image])
    assert capfd.readouterr() == ("", "")


def test_display_windows_that_are_absurd(tmp_path):
    raw(tmp_path / "a.exr", random(4, 4, 3), "RGB", display=(0, 0, 900_000, 900_000))
    refused(tmp_path / "a.exr", "claims 900000 × 900000 pixels")
    for at in ((100, 0), (0, 100), (-4, 0), (0, -4)):
        raw(tmp_path / "b.exr", random(4, 4, 3), "RGB", display=(*at, 4, 4))
        refused(tmp_path / "b.exr", "no data inside its display window", [read_image])


def test_deep_data_and_volumes(tmp_path):
    spec = oiio.ImageSpec(4, 4, 5, "float")
    spec.channelnames, spec.z_channel, spec.alpha_channel, spec.deep = ("R", "G", "B", "A", "Z"), 4, 3, True
    file = oiio.ImageOutput.create("a.exr")
    assert file.open(str(tmp_path / "a.exr"), spec)
    samples = oiio.DeepData()
    samples.init(16, 5, (oiio.TypeDesc("float"),) * 5, spec.channelnames)
    assert file.write_deep_image(samples)
    assert file.close()
    refused(tmp_path / "a.exr", "deep samples")
    volume = oiio.ImageSpec(4, 4, 3, "float")
    volume.depth = 5
    with pytest.raises(InputError, match="a volume of depth 5"):
        damage.check_header(tmp_path / "a.exr", volume)


def test_a_picture_larger_than_memory(tmp_path, monkeypatch):
    raw(tmp_path / "a.exr", random(40, 40, 3), "RGB")
    monkeypatch.setattr(damage, "MAX_VALUES", 40 * 40 * 3 - 1)
    refused(tmp_path / "a.exr", "by bands of rows", [read_image, read_layers])
    with ImageReader(tmp_path / "a.exr") as reader:
        assert reader.rows(0, 20).shape == (20, 40, 3)


# --- what is at a limit, and what only looks like too much ------------------------------------------------------------


def test_the_walk_along_headers_counts_what_is_there(tmp_path, monkeypatch):
    """At the limits nothing is refused, one below each it is."""
    specs = []
    for name in ("left", "right"):
        spec = oiio.ImageSpec(8, 6, 5, "half")
        spec.attribute("oiio:subimagename", name)
        specs.append(spec)
    file = oiio.ImageOutput.create("a.exr")
    assert file.open(str(tmp_path / "a.exr"), tuple(specs))
    for index, spec in enumerate(specs):
        assert not index or file.open(str(tmp_path / "a.exr"), spec, "AppendSubimage")
        assert file.write_image(random(6, 8, 5))
    assert file.close()
    monkeypatch.setattr(damage, "MOST_CHANNELS", 5)
    assert set(read_layers(tmp_path / "a.exr")) == {"left", "right"}
    for limit, below in (("MOST_CHANNELS", 4), ("MOST_ATTRIBUTES", 5)):
        with monkeypatch.context() as lowered:
            lowered.setattr(damage, limit, below)
            refused(tmp_path / "a.exr", f"holds more than {below} ", [read_layers])


@pytest.mark.parametrize("suffix", [".exr", ".tif"])
def test_as_many_channels_are_read_as_are_written(tmp_path, suffix):
    values = random(2, 3, damage.MOST_CHANNELS)
    write_image(tmp_path / f"a{suffix}", values)
    np.testing.assert_array_equal(read_image(tmp_path / f"a{suffix}"), values)
    with pytest.raises(InputError, match=r"would have 4097 channels, .*at most 4096"):
        write_image(tmp_path / f"b{suffix}", random(2, 3, damage.MOST_CHANNELS + 1))


def test_headers_cut_anywhere_are_walked_safely(tmp_path):
    write_image(tmp_path / "a.jpg", random(16, 16, 3))
    sound = {
        "a.exr": exr(0x1000, exr_header(further=2), exr_header())[:-4096],
        "a.jpg": (tmp_path / "a.jpg").read_bytes(),
    }
    for name, content in sound.items():
        for length in range(4, len(content), 7):
            (tmp_path / name).write_bytes(content[:length])
            damage.check_content(tmp_path / name)


def test_a_jpeg_file_with_too_many_scans(tmp_path):
    write_image(tmp_path / "a.jpg", random(16, 16, 3))
    sound = (tmp_path / "a.jpg").read_bytes()
    expected = read_image(tmp_path / "a.jpg")
    scan = sound[sound.rfind(b"\xff\xda") : -2]
    (tmp_path / "a.jpg").write_bytes(sound[:-2] + scan * 1000 + b"\xff\xd9")
    refused(tmp_path / "a.jpg", "holds more than 500 scans")
    # A thumbnail in a segment, a film behind the end of the image: neither is a scan.
    scans = b"\xff\xda\x00\x02" * 1000
    segment = b"\xff\xe5" + struct.pack(">H", 2 + len(scans)) + scans
    for content in (sound + scans, sound[:2] + segment + sound[2:]):
        (tmp_path / "a.jpg").write_bytes(content)
        np.testing.assert_array_equal(read_image(tmp_path / "a.jpg"), expected)


def test_a_png_without_what_nobody_needs(tmp_path):
    text = bytearray(chunk(b"tEXt", b"Comment\0no more"))
    text[-1] ^= 1
    for content in (PNG[:33] + bytes(text) + PNG[33:], PNG[:-12], PNG + b"and more"):
        (tmp_path / "a.png").write_bytes(content)
        assert read_image(tmp_path / "a.png").shape == (20, 30, 3)


def test_a_tile_larger_than_the_picture(tmp_path):
    raw(tmp_path / "a.exr", random(20, 30, 3), "RGB", tile=64)
    np.testing.assert_array_equal(read_image(tmp_path / "a.exr"), random(20, 30, 3))


def test_large_even_pictures_in_a_few_bytes(tmp_path):
    """Masks and renderings of a small thing, 36 and 53 MB of pixels."""
    (tmp_path / "a.tif").write_bytes(white_fax(6000))
    raw(tmp_path / "a.exr", np.zeros((2160, 4096, 3), np.float32), "RGB", kind="half", compression="dwab")
    for name, shape, value in (("a.tif", (6000, 6000, 1), 1), ("a.exr", (2160, 4096, 3), 0)):
        assert np.prod(shape) > 4096 * (tmp_path / name).stat().st_size
        with ImageReader(tmp_path / name, encoding="linear") as reader:
            assert reader.shape == shape
            np.testing.assert_array_equal(reader.rows(shape[0] - 2, shape[0]), value)


@pytest.mark.parametrize("reader", [read_image, read_mask])
def test_a_picture_in_one_strip_takes_little_more_memory_than_its_values(tmp_path, reader):
    (tmp_path / "a.tif").write_bytes(white_fax(2000))
    reader(tmp_path / "a.tif")  # tables are made once
    tracemalloc.start()
    try:
        assert reader(tmp_path / "a.tif").all()
        _, most = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert most < 10 * 2000 * 2000


# --- files of others, and any -----------------------------------------------------------------------------------------

READ_AND_REPORT = """
import sys
import brdf
for path in sys.argv[1:]:
    for reader in (brdf.read_picture, brdf.read_layers):
        try:
            reader(path)
            print("image")
        except brdf.InputError as error:
            print(error)
# Not getrusage: its peak counts the parent's at the fork.
print(int(open("/proc/self/status").read().split("VmHWM:")[1].split()[0]) // 1024)
"""


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="needs /proc to measure the peak of memory")
@pytest.mark.skipif(not BAD_IMAGES, reason=f"{REAL / 'bad-images'} is missing (BRDF_REAL_DATA)")
def test_damaged_and_hostile_files_are_pictures_or_one_line_in_little_memory():
    assert len(BAD_IMAGES) == 104
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-c", READ_AND_REPORT, *map(str, BAD_IMAGES)]
    result = subprocess.run(command, capture_output=True, text=True, env=environment, timeout=120, check=False)
    assert (result.returncode, result.stderr) == (0, "")
    *lines, megabytes = result.stdout.splitlines()
    for path, line in zip(np.repeat(BAD_IMAGES, 2), lines, strict=True):
        assert line == "image" or line.startswith(f"{path}: ")
    assert int(megabytes) < 500


def test_mutated_files_give_an_image_or_an_error(tmp_path):
    rng = np.random.default_rng(1)
    for suffix, kind in [(".png", None), (".jpg", None), (".tif", "uint8"), (".hdr", None), (".exr", "half")]:
        write_image(tmp_path / f"seed{suffix}", random(16, 24, 3), dtype=kind)
        content = np.frombuffer((tmp_path / f"seed{suffix}").read_bytes(), np.uint8)
        for _ in range(60):
            mutated = content.copy()
            at = rng.integers(0, min(len(mutated), 400), rng.integers(1, 5))
            mutated[at] = rng.integers(0, 256, len(at))
            (tmp_path / f"a{suffix}").write_bytes(mutated.tobytes())
            with suppress(InputError):
                assert read_picture(tmp_path / f"a{suffix}").pixels.ndim == 3


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


# --- odd names --------------------------------------------------------------------------------------------------------

ODD = os.fsdecode(b"\xff\xfe")
encoded = pytest.mark.skipif(sys.platform != "linux", reason="other systems allow Unicode names alone")


@encoded
@pytest.mark.parametrize("place", ["{}.png", "{}/a.png"])
def test_a_picture_whose_name_is_not_utf8(tmp_path, place):
    path = tmp_path / place.format(ODD)
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(PNG)
    for reader in READERS:
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
        write_image(tmp_path / ODD / "a.png", np.zeros((4, 4, 3)))
    assert not list((tmp_path / ODD).iterdir())
    write_image(tmp_path / f"{ODD}.png", np.zeros((4, 4, 3)))  # written under another name, then renamed
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
    for reader in (read_image, brdf.load_measured, brdf.Scene.load, read_text, read_mask):
        with pytest.raises(InputError, match=r"is not a path|no such file|is a folder"):
            reader(name)
    with pytest.raises(InputError, match="is not a path"):
        write_text(name, "x")


NAMES = ["a\nb.png", "-rf.png", "\U0001f600.png", " .png", "a%d%s{}.png", "[bold]x.png", "#.png"]


@pytest.mark.parametrize("name", NAMES)
def test_names_that_mean_something_elsewhere(tmp_path, name):
    (tmp_path / name).write_bytes(PNG)
    assert read_image(tmp_path / name).shape == (20, 30, 3)
    (tmp_path / name).write_bytes(PNG[:40])
    with pytest.raises(InputError) as told:
        read_image(tmp_path / name)
    assert str(told.value).isprintable()
    assert name.replace("\n", " ").strip() in str(told.value)


SUFFIXES = "webp fits bmp jxl dpx rla sgi iff zfile jp2 jpg xyz png tif exr".split()


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_the_path_is_said_once(tmp_path, suffix):
    folder = tmp_path / ("a long name of a folder " * 8)
    folder.mkdir()
    path = folder / f"not a picture.{suffix}"
    path.write_bytes(bytes(range(200)))
    with pytest.raises(InputError) as told:
        read_image(path)
    assert str(told.value).startswith(f"{path}: ".replace(" / ", "/"))
    assert str(told.value).count("a long name of a folder") == 8
