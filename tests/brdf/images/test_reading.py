"""Pictures read from files: channels, layers, masks, windows and bands."""

import warnings

import numpy as np
import OpenImageIO as oiio
import pytest
from image_files import REAL, codes, needs, png, random, raw, raw_png

from brdf.errors import InputError
from brdf.images.reading import ImageReader, read_image, read_layers, read_mask, read_picture
from brdf.images.writing import write_image, write_layers

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


def test_a_mantissa_of_radiance_stands_for_the_middle_of_what_was_truncated(tmp_path):
    """As its own library reads them. Skies and photographs were half a step too dark."""
    stored = np.array([[[128, 0, 255, 129], [200, 7, 1, 120]], [[0, 0, 0, 0], [255, 255, 255, 136]]], np.uint8)
    head = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 2 +X 2\n"
    (tmp_path / "a.hdr").write_bytes(head + stored.tobytes())
    expected = (stored[..., :3] + 0.5) * 2.0 ** (stored[..., 3:].astype(float) - 136)
    np.testing.assert_array_equal(read_image(tmp_path / "a.hdr"), np.where(stored[..., 3:] > 0, expected, 0))
    encoded = read_image(tmp_path / "a.hdr", encoding=2.2)
    np.testing.assert_allclose(encoded, np.where(stored[..., 3:] > 0, expected, 0) ** 2.2, rtol=1e-5)
    values = random(40, 50, 3)
    write_image(tmp_path / "b.hdr", values)
    assert abs(np.mean(read_image(tmp_path / "b.hdr") - values)) < 1e-4  # half a step is 1e-3


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
    picture = read_picture(raw(tmp_path / "a.exr", values, names))
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


def test_the_picture_among_layers_is_coloured(tmp_path):
    colour, position = random(6, 5, 3), random(6, 5, 3, seed=1)
    write_layers(tmp_path / "a.exr", {"N": position, "image": colour[..., :1]})
    np.testing.assert_array_equal(read_image(tmp_path / "a.exr"), colour[..., :1])
    names = [*("N.X", "N.Y", "N.Z"), *("diffuse.R", "diffuse.G", "diffuse.B")]
    raw(tmp_path / "b.exr", np.dstack([position, colour]), names)
    np.testing.assert_array_equal(read_image(tmp_path / "b.exr"), colour)


@pytest.mark.parametrize(
    ("layers", "taken", "guess"),
    [
        (("albedo", "beauty"), 1, None),
        (("ViewLayer.Albedo", "ViewLayer.Combined"), 1, None),
        (("diffuse", "RGBA", "specular"), 1, None),
        (("albedo", "diffuse"), 0, "albedo"),
        (("albedo", ""), 1, None),
        (("albedo",), 0, None),
    ],
)
def test_of_several_layers_the_picture_is_the_one_that_renderers_name_so(tmp_path, layers, taken, guess):
    values = [random(6, 5, 3, seed=seed) for seed in range(len(layers))]
    names = [f"{layer}.{channel}".lstrip(".") for layer in layers for channel in "RGB"]
    raw(tmp_path / "a.exr", np.dstack(values), names)
    picture = read_picture(tmp_path / "a.exr")
    np.testing.assert_array_equal(picture.pixels, values[taken])
    assert picture.layer == guess


@pytest.mark.parametrize(("planes", "tile"), [("contig", 0), ("separate", 0), ("separate", 16)])
def test_a_tiff_of_doubles(tmp_path, planes, tile):
    values = random(37, 41, 3).astype(np.float64)
    doubles(tmp_path / "a.tif", values, planes, tile)
    np.testing.assert_allclose(read_image(tmp_path / "a.tif"), values, rtol=1e-6)
    with ImageReader(tmp_path / "a.tif") as reader:
        bands = [reader.rows(start, min(start + 4, 37)) for start in range(0, 37, 4)]
    np.testing.assert_allclose(np.concatenate(bands), values, rtol=1e-6)


def test_a_tiff_of_doubles_that_comes_wrong(tmp_path):
    doubles(tmp_path / "a.tif", np.ones((37, 41, 3)), "contig", 16)
    for read in (read_image, read_layers):
        with pytest.raises(InputError, match="64-bit floats"):
            read(tmp_path / "a.tif")


def doubles(path, values, planes, tile):
    spec = oiio.ImageSpec(values.shape[1], values.shape[0], values.shape[2], "double")
    spec.tile_width = spec.tile_height = tile
    spec.attribute("planarconfig", planes)
    file = oiio.ImageOutput.create(str(path))
    assert file.open(str(path), spec)
    assert file.write_image(values)
    assert file.close()


@needs("aov")
def test_layers_of_a_real_renderer():
    layers = read_layers(REAL / "aov" / "mitsuba_multi_channels.exr")
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


def test_layers_of_one_name_in_two_parts_are_both_read(tmp_path):
    specs, path = [oiio.ImageSpec(6, 4, 3, "float") for _ in range(2)], str(tmp_path / "a.exr")
    file = oiio.ImageOutput.create(path)
    for index, spec in enumerate(specs):
        spec.attribute("oiio:subimagename", ["left", "right"][index])
        spec.channelnames = ("N.X", "N.Y", "N.Z")
    for index in range(2):
        assert file.open(path, specs[1], "AppendSubimage") if index else file.open(path, tuple(specs))
        assert file.write_image(np.full((4, 6, 3), index, np.float32))
    assert file.close()
    assert {name: values.mean() for name, values in read_layers(path).items()} == {"N": 0, "right.N": 1}


def test_masks(tmp_path):
    inside = random(8, 9) > 0.5
    white = np.where(inside, 255, 0).astype(np.uint8)
    (tmp_path / "white.png").write_bytes(png(white[..., None].repeat(3, 2)))
    (tmp_path / "one.png").write_bytes(png(inside.astype(np.uint8)[..., None], colour_type=0))
    (tmp_path / "alpha.png").write_bytes(png(np.dstack([codes(8, 9, 3), white]), colour_type=6))
    (tmp_path / "opaque.png").write_bytes(png(np.dstack([white] * 3 + [np.full_like(white, 255)]), colour_type=6))
    raw(tmp_path / "float.exr", np.where(inside, 1, np.nan)[..., None].astype(np.float32), ["Y"])
    for name, alpha in (("faint.png", 254), ("nothing.png", 0), ("veiled.png", np.where(inside, 255, 200))):
        # Alpha that keeps all pixels, or none, was not meant.
        pixels = np.dstack([white] * 3 + [np.broadcast_to(alpha, white.shape).astype(np.uint8)])
        (tmp_path / name).write_bytes(png(pixels, colour_type=6))
    names = ("white.png", "one.png", "alpha.png", "opaque.png", "float.exr", "faint.png", "nothing.png", "veiled.png")
    for name in names:
        np.testing.assert_array_equal(read_mask(tmp_path / name), inside, err_msg=name)
    (tmp_path / "black.png").write_bytes(png(np.zeros((3, 3, 3), np.uint8)))
    assert not read_mask(tmp_path / "black.png").any()


def test_odd_pictures(tmp_path):
    bits = codes(5, 16) % 2
    rows = b"".join(b"\0" + row.tobytes() for row in np.packbits(bits, axis=1))
    (tmp_path / "bits.png").write_bytes(raw_png(16, 5, 1, 0, rows))
    np.testing.assert_array_equal(read_image(tmp_path / "bits.png")[..., 0], bits)
    index, colours = codes(5, 7) % 3, np.diag([255, 255, 255]).astype(np.uint8)
    rows = b"".join(b"\0" + row.tobytes() for row in index)
    (tmp_path / "palette.png").write_bytes(raw_png(7, 5, 8, 3, rows, (b"PLTE", colours.tobytes())))
    np.testing.assert_array_equal(read_image(tmp_path / "palette.png"), colours[index] / 255)
    for shape in ((1, 1, 3), (1, 16384, 3), (16384, 1, 1)):
        values = random(*shape)
        raw(tmp_path / "a.exr", values, ["Y"] if shape[2] == 1 else ())
        np.testing.assert_array_equal(read_image(tmp_path / "a.exr"), values)
    raw(tmp_path / "signed.tif", random(4, 5, 3), kind="int16")
    np.testing.assert_allclose(read_image(tmp_path / "signed.tif"), random(4, 5, 3), atol=2 / 32767)


# --- windows, orientation, bands ---------------------------------------------------------------------------------


@pytest.mark.parametrize("tile", [0, 16])
@pytest.mark.parametrize("shift", [(3, 5), (-4, -7), (0, 0)])
def test_the_display_window_is_the_picture(tmp_path, tile, shift):
    values = random(40, 50, 3)
    path = raw(tmp_path / "a.exr", values, "RGB", tile=tile, data_at=shift, display=(0, 0, 50, 40))
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
        bands = [reader.rows(start, min(start + 20, 133)) for start in range(0, 133, 20)]
        np.testing.assert_array_equal(np.concatenate(bands), whole.pixels)
        np.testing.assert_array_equal(reader.rows(10, 30), whole.pixels[10:30])
        assert reader.rows(5, 5).shape == (0, 57, 3)
        for wrong in ((-1, 3), (0, 134), (5, 4)):
            with pytest.raises(IndexError):
                reader.rows(*wrong)


def test_tiles_are_read_by_rows(tmp_path):
    values = random(100, 30, 3)
    with ImageReader(raw(tmp_path / "a.exr", values, "RGB", tile=16)) as reader:
        for start, stop in ((0, 100), (3, 9), (15, 17), (90, 100)):
            np.testing.assert_array_equal(reader.rows(start, stop), values[start:stop])


def test_a_reader_is_an_array_for_what_takes_arrays(tmp_path):
    (tmp_path / "a.png").write_bytes(png(codes(5, 7, 3)))
    with ImageReader(tmp_path / "a.png") as reader:
        np.testing.assert_array_equal(np.asarray(reader), read_image(tmp_path / "a.png"))
        assert np.asarray(reader, np.float64).dtype == np.float64


@pytest.mark.parametrize("odd", [np.nan, np.inf, np.float32(3e38)])
def test_a_mask_of_odd_values_is_read_without_a_warning(tmp_path, odd):
    values = np.zeros((6, 8, 3), np.float32)
    values[2:4, 2:5] = 1.0 if np.isnan(odd) else odd
    values[0, 0] = odd
    values[1, 1] = np.inf, -np.inf, 0.0
    raw(tmp_path / "a.exr", values, "RGB")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        inside = read_mask(tmp_path / "a.exr")
    assert inside[2:4, 2:5].all()
    assert inside.sum() == 6 + (not np.isnan(odd))


def test_layers_of_a_cropped_file_lie_on_its_picture(tmp_path):
    values = random(4, 5, 6)
    names = [*"RGB", *(f"normal.{axis}" for axis in "XYZ")]
    path = raw(tmp_path / "a.exr", values, names, data_at=(2, 1), display=(0, 0, 8, 6))
    layers = read_layers(path)
    np.testing.assert_array_equal(layers[""], read_image(path))
    np.testing.assert_array_equal(layers["normal"][1:5, 2:7], values[..., 3:])
    assert np.isnan(layers["normal"]).sum() == 3 * (6 * 8 - 4 * 5)
    beside = raw(tmp_path / "b.exr", values, names, data_at=(12, 1), display=(0, 0, 8, 6))
    assert np.isnan(read_layers(beside)["normal"]).all()


def test_a_picture_shows_in_a_line(tmp_path):
    path = tmp_path / "a.png"
    path.write_bytes(png(codes(6, 5, 3)))
    with ImageReader(path, encoding="srgb") as reader:
        assert repr(reader) == f"ImageReader(6 x 5 x 3, srgb, 8 bits, {path})"
    assert repr(read_picture(path, encoding="srgb")) == f"Picture(6 x 5 x 3, srgb, 8 bits, {path})"
