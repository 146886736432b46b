"""Files with too much of something: attributes, channels, parts, scans, tiles; and what is read by bands of rows."""

import struct
import tracemalloc
import warnings

import numpy as np
import OpenImageIO as oiio  # noqa: N813
import pytest
from image_files import chunk, codes, png, random, raw_exr

from brdf.errors import InputError
from brdf.images import bulk
from brdf.images.reading import ImageReader, read_image, read_layers, read_mask, read_picture, write_image
from brdf.materials import material_file as materials


def attribute(name: bytes, kind: bytes, value: bytes) -> bytes:
    return name + b"\0" + kind + b"\0" + struct.pack("<I", len(value)) + value


def channel_list(count: int) -> bytes:
    return b"".join(b"c%05d\0" % index + struct.pack("<IIII", 2, 0, 1, 1) for index in range(count)) + b"\0"


def exr_header(channels: int = 3, further: int = 0, tile: int = 0, before: int = 0) -> bytes:
    """The attributes of one part after the file's layout, of 4 × 4 pixels."""
    window = struct.pack("<4i", 0, 0, 3, 3)
    parts = [attribute(b"preview", b"string", bytes(before))] if before else []
    parts += [attribute(b"channels", b"chlist", channel_list(channels)), attribute(b"lineOrder", b"lineOrder", b"\0")]
    parts += [attribute(name, b"box2i", window) for name in (b"dataWindow", b"displayWindow")]
    parts += [attribute(name, b"float", struct.pack("<f", 1)) for name in (b"pixelAspectRatio", b"screenWindowWidth")]
    parts += [attribute(b"compression", b"compression", b"\0"), attribute(b"screenWindowCenter", b"v2f", bytes(8))]
    parts += [attribute(b"tiles", b"tiledesc", struct.pack("<IIB", tile, tile, 0))] if tile else []
    return b"".join(parts) + b"".join(attribute(b"a%d" % index, b"string", b"x") for index in range(further)) + b"\0"


def exr(flags: int, *headers: bytes) -> bytes:
    return b"v/1\x01" + struct.pack("<I", 2 | flags) + b"".join(headers) + b"\0" * bool(flags & 0x1000) + bytes(4096)


TOO_MUCH = {
    "attributes.exr": (exr(0, exr_header(further=20_000)), "holds more than 4096 attributes"),
    "behind.exr": (exr(0, exr_header(before=1 << 24, further=20_000)), "holds more than 4096 attributes"),
    "channels.exr": (exr(0, exr_header(channels=20_000)), "holds more than 4096 channels"),
    "parts.exr": (exr(0x1000, *[exr_header()] * 2_000), "holds more than 1024 parts"),
    "all.exr": (exr(0x1000, *[exr_header(further=4_000)] * 20), "holds more than 65536 attributes"),
    "layers.exr": (exr(0x1000, *[exr_header(channels=4_000)] * 20), "holds more than 65536 channels"),
    "second.exr": (exr(0x1000, exr_header(), exr_header(further=20_000)), "holds more than 4096 attributes"),
    "tiles.exr": (exr(0x200, exr_header(tile=20_000)), "claims tiles of 20000 × 20000 for 4 × 4 pixels"),
}


@pytest.mark.parametrize("name", TOO_MUCH)
def test_an_openexr_file_with_too_much(tmp_path, name):
    content, said = TOO_MUCH[name]
    (tmp_path / name).write_bytes(content)
    for reader in (read_picture, read_layers, read_mask, ImageReader):
        with pytest.raises(InputError, match=said) as told:
            reader(tmp_path / name)
        assert str(told.value).startswith(f"{tmp_path / name}: ")


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
    monkeypatch.setattr(bulk, "MOST_CHANNELS", 5)
    monkeypatch.setattr(bulk, "MOST_PARTS", 2)
    assert set(read_layers(tmp_path / "a.exr")) == {"left", "right"}
    for limit, below in (("MOST_CHANNELS", 4), ("MOST_PARTS", 1), ("MOST_ATTRIBUTES", 5), ("MOST_IN_ALL", 9)):
        with monkeypatch.context() as lowered:
            lowered.setattr(bulk, limit, below)
            with pytest.raises(InputError, match=f"holds more than {below} "):
                read_layers(tmp_path / "a.exr")


@pytest.mark.parametrize("suffix", [".exr", ".tif"])
def test_as_many_channels_are_read_as_are_written(tmp_path, suffix):
    values = random(2, 3, bulk.MOST_CHANNELS)
    write_image(tmp_path / f"a{suffix}", values)
    np.testing.assert_array_equal(read_image(tmp_path / f"a{suffix}"), values)
    for array, alpha in ((random(2, 3, bulk.MOST_CHANNELS + 1), None), (values, values[..., 0])):
        with pytest.raises(InputError, match=r"would have 4097 channels, .*at most 4096"):
            write_image(tmp_path / f"b{suffix}", array, alpha=alpha)
    assert bulk.MOST_CHANNELS == materials.MOST_CHANNELS


def test_headers_cut_anywhere_are_walked_safely(tmp_path):
    sound = exr(0x1000, exr_header(further=2), exr_header())
    for length in range(4, len(sound) - 4096, 7):
        (tmp_path / "a.exr").write_bytes(sound[:length])
        bulk.check_bulk(tmp_path / "a.exr")


def test_a_jpeg_file_with_too_many_scans(tmp_path):
    write_image(tmp_path / "a.jpg", random(16, 16, 3))
    sound = (tmp_path / "a.jpg").read_bytes()
    assert read_image(tmp_path / "a.jpg").shape == (16, 16, 3)
    scan = sound[sound.rfind(b"\xff\xda") : -2]
    (tmp_path / "a.jpg").write_bytes(sound[:-2] + scan * 1000 + b"\xff\xd9")
    with pytest.raises(InputError, match="holds more than 500 scans"):
        read_image(tmp_path / "a.jpg")


def test_a_jpeg_file_with_something_in_and_behind_it(tmp_path):
    """A thumbnail in a segment, a film behind the end of the image: neither is a scan."""
    write_image(tmp_path / "a.jpg", random(16, 16, 3))
    sound = (tmp_path / "a.jpg").read_bytes()
    expected = read_image(tmp_path / "a.jpg")
    scans = b"\xff\xda\x00\x02" * 1000
    segment = b"\xff\xe5" + struct.pack(">H", 2 + len(scans)) + scans
    for content in (sound + scans, sound[:2] + segment + sound[2:]):
        (tmp_path / "a.jpg").write_bytes(content)
        np.testing.assert_array_equal(read_image(tmp_path / "a.jpg"), expected)
    (tmp_path / "a.jpg").write_bytes(sound[:2] + b"\xff\xfe\x00\x02" * 70_000 + sound[2:])
    with pytest.raises(InputError, match="holds more than 65536 segments"):
        read_image(tmp_path / "a.jpg")


@pytest.mark.parametrize("window", [4, 5, 7, 64])
def test_scans_are_counted_wherever_a_window_ends(tmp_path, monkeypatch, window):
    monkeypatch.setattr(bulk, "_WINDOW", window)
    monkeypatch.setattr(bulk, "MOST_SCANS", 2)
    scan = b"\xff\xda\x00\x06abcd" + b"data\xff\x00more\xff\xd3" * 3
    for scans, film in ((2, b""), (2, scan), (3, b"")):
        # Filling before a marker, a remark that holds one, an end that counts.
        content = b"\xff\xd8\xff\xff\xff\xe0\x00\x06\xff\xda\x00\x02" + scan * scans + b"\xff\xd9" + film
        (tmp_path / "a.jpg").write_bytes(content)
        if scans == 2:
            bulk.check_bulk(tmp_path / "a.jpg")
            continue
        with pytest.raises(InputError, match="holds more than 2 scans"):
            bulk.check_bulk(tmp_path / "a.jpg")


def test_a_tile_far_larger_than_the_picture(tmp_path):
    raw_exr(tmp_path / "a.exr", random(20, 30, 3), "RGB", tile=64)
    np.testing.assert_array_equal(read_image(tmp_path / "a.exr"), random(20, 30, 3))


def test_a_tiny_file_of_many_pixels(tmp_path):
    # The codestream of a JPEG 2000 file says how large it is, and may hold nothing else.
    size = struct.pack(">HHIIIIIIIIH", 47, 0, 4700, 4700, 0, 0, 4700, 4700, 0, 0, 3) + bytes([7, 1, 1] * 3)
    coding = b"\xff\x52\x00\x0c" + bytes([0, 0, 0, 1, 1, 5, 4, 4, 0, 1]) + b"\xff\x5c\x00\x13\x40" + bytes(16)
    tile = b"\xff\x90\x00\x0a" + bytes(7) + b"\x01\xff\x93" + bytes(100) + b"\xff\xd9"
    (tmp_path / "a.j2k").write_bytes(b"\xff\x4f\xff\x51" + size + coding + tile)
    with pytest.raises(InputError, match=r"claims 4700 × 4700 pixels|cannot be read as an image"):
        read_image(tmp_path / "a.j2k")


def test_libpng_is_kept_quiet_in_icons_too(tmp_path, capfd):
    picture = png(codes(16, 16, 4), colour_type=6)
    damaged = picture.replace(picture[-40:-12], bytes(28))
    for content in (damaged, picture[:60], picture[:8] + chunk(b"IHDR", b"") + picture[33:]):
        entry = struct.pack("<BBBBHHII", 16, 16, 0, 0, 1, 32, len(content), 22)
        (tmp_path / "a.ico").write_bytes(struct.pack("<HHH", 0, 1, 1) + entry + content)
        with pytest.raises(InputError, match=r"is damaged|cannot be read as an image"):
            read_image(tmp_path / "a.ico")
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("odd", [np.nan, np.inf, np.float32(3e38)])
def test_a_mask_of_odd_values_is_read_without_a_warning(tmp_path, odd):
    values = np.zeros((6, 8, 3), np.float32)
    values[2:4, 2:5] = 1.0 if np.isnan(odd) else odd
    values[0, 0] = odd
    values[1, 1] = np.inf, -np.inf, 0.0
    raw_exr(tmp_path / "a.exr", values, "RGB")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        inside = read_mask(tmp_path / "a.exr")
    assert inside[2:4, 2:5].all()
    assert inside.sum() == 6 + (not np.isnan(odd))


def test_layers_and_masks_are_read_by_bands(tmp_path, monkeypatch):
    values = np.concatenate([random(50, 20, 3), random(50, 20, 3, seed=1)], axis=-1)
    names = ("R", "G", "B", "N.Z", "N.Y", "N.X")
    for tile in (0, 16):
        raw_exr(tmp_path / "a.exr", values, names, tile=tile)
        with monkeypatch.context() as small:
            small.setattr("brdf.images.reading.BAND_VALUES", 20 * 6 * 7)
            layers = read_layers(tmp_path / "a.exr")
        np.testing.assert_array_equal(layers[""], values[..., :3])
        np.testing.assert_array_equal(layers["N"], values[..., :2:-1])


def white_fax(size: int) -> bytes:
    """A TIFF file of 1-bit pixels in one strip of CCITT Group 4, where a row like the one above is a single bit."""
    strip = b"\xff" * -(-size // 8)
    entries = [
        (256, size),
        (257, size),
        (258, 1),
        (259, 4),
        (262, 0),
        (273, 8),
        (277, 1),
        (278, size),
        (279, len(strip)),
    ]
    strip += bytes(len(strip) % 2)
    directory = b"".join(struct.pack("<HHII", tag, 4, 1, value) for tag, value in entries)
    return b"II*\0" + struct.pack("<I", 8 + len(strip)) + strip + struct.pack("<H", len(entries)) + directory + bytes(4)


def test_large_even_pictures_in_a_few_bytes(tmp_path):
    """Masks and renderings of a small thing, 36 and 53 MB of pixels."""
    (tmp_path / "a.tif").write_bytes(white_fax(6000))
    raw_exr(tmp_path / "a.exr", np.zeros((2160, 4096, 3), np.float32), "RGB", kind="half", compression="dwab")
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


def test_strips_and_tiles_that_a_few_bytes_cannot_hold(tmp_path):
    (tmp_path / "a.tif").write_bytes(white_fax(8200))
    with pytest.raises(InputError, match="claims 8200 × 8200 pixels"):
        read_image(tmp_path / "a.tif")
    # Tiles are unpacked whole: they get no more than other formats, however large the picture claims to be.
    window = struct.pack("<4i", 0, 0, 3, 3)
    large = exr_header(tile=2600).replace(window, struct.pack("<4i", 0, 0, 2299, 2299))
    (tmp_path / "a.exr").write_bytes(exr(0x200, large)[:-4000])
    with pytest.raises(InputError, match="claims tiles of 2600 × 2600 for 2300 × 2300 pixels"):
        read_image(tmp_path / "a.exr")
