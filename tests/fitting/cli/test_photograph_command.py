"""Photographs of a ball through the command: encodings, masks, lights, archives."""

import json
import re
import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
import pytest
from ball_pictures import BALL, SHAPE, angle, disc, photograph_scene, photographs_in, shaded
from command_runs import run

import brdf
from brdf.images.encoding import encode
from fitting.cli import encoding_trial
from fitting.core import predictions
from fitting.photographs.ball import Circle, ball_points, ball_seen
from fitting.photographs.light_files import read_directions


@pytest.fixture
def photographs(tmp_path):
    return photographs_in(tmp_path)


def write_silent(path: str, pixels: np.ndarray, encoding: Any, dtype: str) -> None:
    """A PNG file without a word about its encoding: magic, header, one block of pixels, end."""
    largest = np.iinfo(dtype).max
    codes = np.round(encode(pixels.astype(np.float32), encoding) * largest).astype(f">u{np.dtype(dtype).itemsize}")
    height, width, channels = codes.shape
    header = struct.pack(">IIBBBBB", width, height, 8 * codes.itemsize, {1: 0, 3: 2}[channels], 0, 0, 0)
    rows = b"".join(b"\0" + row.tobytes() for row in codes)
    content = b"\x89PNG\r\n\x1a\n"
    for kind, data in ((b"IHDR", header), (b"IDAT", zlib.compress(rows)), (b"IEND", b"")):
        content += struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
    Path(path).write_bytes(content)


def write_layered(path: str, pixels: np.ndarray) -> None:
    """Grey and alpha, as they are."""
    spec = oiio.ImageSpec(pixels.shape[1], pixels.shape[0], 2, "float")
    spec.channelnames, spec.alpha_channel = ("Y", "A"), 1
    spec.attribute("oiio:UnassociatedAlpha", 1)
    output = oiio.ImageOutput.create(path)
    assert output.open(path, spec)
    assert output.write_image(pixels)
    output.close()


def k_d(text: str) -> float:
    values = [one for one in json.loads(text[text.index("{") :])["parameters"] if one["name"] == "k_d"]
    return values[0]["value"]


def test_several_photographs_in_one_command(photographs, capsys, monkeypatch):
    monkeypatch.chdir(photographs)
    shared = ["fit", "0.png", "1.png", "2.png", "--encoding", "linear", "--exposure", "1,0.5,0.8", "--json"]
    shared += ["--model", "lambert"]
    circle = f"{BALL.x},{BALL.y},{BALL.radius}"
    status, out, _ = run(capsys, *shared, "--sphere", circle, "--lights", "lights.txt")
    assert status == 0
    assert k_d(out) == pytest.approx(0.8, rel=1e-3)  # 16-bit codes
    directions = Path("lights.txt").read_text().splitlines()
    listed = [f"{name}.png {directions[name]}" for name in (2, 0, 1)]
    Path("rti.lp").write_text("\n".join(["3", *listed]))
    status, out, _ = run(capsys, *shared, "--sphere", circle, "--lights", "rti.lp")
    assert k_d(out) == pytest.approx(0.8, rel=1e-3)
    Path("other.lp").write_text(f"1\n{listed[0]}")
    status, _, told = run(capsys, *shared, "--sphere", circle, "--lights", "other.lp")
    assert status == 2
    assert "other.lp: names no 0.png" in told
    status, out, _ = run(capsys, *shared, "--sphere", circle, "--light", "fit")
    assert k_d(out) == pytest.approx(0.8, rel=1e-3)
    assert len(re.findall("from its shading", out)) == 3
    status, out, _ = run(capsys, *shared, "--sphere", "mask", "--mask", "mask.png", "--lights", "lights.txt")
    assert "ball found at 30." in out
    assert k_d(out) == pytest.approx(0.8, rel=0.02)  # the circle is known to a third of a pixel


@pytest.mark.parametrize(("light", "warns"), [((0.3, 0.4, 0.86), False), ((0.5, 0.3, -0.8), True)])
def test_a_light_from_behind_is_told_with_what_its_error_does_not_say(tmp_path, capsys, monkeypatch, light, warns):
    monkeypatch.chdir(tmp_path)
    brdf.write_image("ball.exr", shaded(light))
    words = ["fit", "ball.exr", "--sphere", f"{BALL.x},{BALL.y},{BALL.radius}", "--light", "fit", "--model", "lambert"]
    status, out, err = run(capsys, *words)
    assert status == 0, err
    assert ("it comes from behind" in out) == warns


@pytest.mark.parametrize("dtype", ["uint8", "uint16"])
@pytest.mark.parametrize("encoding", ["linear", "srgb"])
def test_a_file_that_does_not_say_its_encoding_is_read_as_the_model_explains_it(
    tmp_path, capsys, monkeypatch, dtype, encoding
):
    monkeypatch.chdir(tmp_path)
    write_silent("ball.png", shaded((0.3, 0.4, 0.86)), encoding, dtype)
    assert brdf.read_picture("ball.png").source == "assumed"
    words = ["fit", "ball.png", "--sphere", f"{BALL.x},{BALL.y},{BALL.radius}", "--light", "fit"]
    status, out, err = run(capsys, *words, "--model", "lambert", "--json")
    assert status == 0, err
    report = json.loads(out)
    assert k_d(out) == pytest.approx(0.8, rel=0.01)  # 8-bit codes
    assumed = "srgb" if dtype == "uint8" else "linear"
    told = [one for one in report["warnings"] if "does not say how its values are encoded" in one]
    assert len(told) == (encoding != assumed)
    # What the user says stands, however little it explains.
    wrong = "linear" if encoding == "srgb" else "srgb"
    _, out, _ = run(capsys, *words, "--encoding", wrong, "--model", "lambert", "--json")
    assert k_d(out) != pytest.approx(0.8, rel=0.05)
    assert not any("encoded" in warning for warning in json.loads(out)["warnings"])


def test_of_a_large_picture_some_pixels_tell_its_encoding(tmp_path, capsys, monkeypatch):
    """The trial knows nothing of --seconds: of all pixels of a large one it took longer than these."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(encoding_trial, "SIDE", 40)
    tried = []

    def remembered(problem):
        tried.append([target.pixels.shape for target in problem.targets])
        return predictions(problem)

    monkeypatch.setattr("fitting.core.predictions", remembered)
    write_silent("ball.png", shaded((0.3, 0.4, 0.86)), "linear", "uint8")
    brdf.write_image("mask.png", np.ones(SHAPE))
    words = ["--sphere", f"{BALL.x},{BALL.y},{BALL.radius}", "--light", "0.3,0.4,0.86", "--mask", "mask.png"]
    status, out, err = run(capsys, "fit", "ball.png", *words, "--model", "lambert")
    assert status == 0, err
    assert "read as linear" in out
    assert len(tried) == 2
    assert max(max(shape) for shapes in tried for shape in shapes) <= 40


@pytest.mark.parametrize("brightest", [2.0, 8.0])
def test_the_encoding_of_a_clipped_photograph_is_told_by_the_channels_that_are_not(
    tmp_path, capsys, monkeypatch, brightest
):
    """Where red is clipped the others show the curve; of whole pixels alone both explained what was left."""
    monkeypatch.chdir(tmp_path)
    colour = brightest * np.array([1.0, 0.4, 0.1])
    write_silent("ball.png", np.minimum(shaded((0.3, 0.4, 0.86)) * colour, 1), "linear", "uint8")
    words = ["--sphere", f"{BALL.x},{BALL.y},{BALL.radius}", "--light", "0.3,0.4,0.86", "--model", "lambert"]
    status, out, err = run(capsys, "fit", "ball.png", *words)
    assert status == 0, err
    ((left, other),) = re.findall(r"read as linear.* off by ([\d.]+) % .* sRGB by ([\d.]+) %", out)
    assert float(left) < 0.15 * float(other)


@pytest.mark.parametrize("whole", [False, True])
def test_transparent_pixels_show_nothing_unless_all_are(tmp_path, capsys, monkeypatch, whole):
    monkeypatch.chdir(tmp_path)
    picture = np.concatenate([shaded((0.3, 0.4, 0.86)), np.ones((*SHAPE, 1), np.float32)], axis=-1)
    picture[10:30, 20:30] = [5.0, 0.0]  # what a tool writes where it cut something out
    if whole:
        picture[:] = np.concatenate([shaded((0.3, 0.4, 0.86)), np.zeros((*SHAPE, 1), np.float32)], axis=-1)
    write_layered("ball.exr", picture)
    for light in ("0.3,0.4,0.86", "fit"):
        words = ["fit", "ball.exr", "--sphere", f"{BALL.x},{BALL.y},{BALL.radius}", "--light", light]
        status, out, err = run(capsys, *words, "--model", "lambert", "--json")
        assert status == 0, err
        assert k_d(out) == pytest.approx(0.8, rel=1e-5)
        # The outline runs through some pixels, too.
        rim = np.count_nonzero(ball_seen(SHAPE, BALL).surface_points().mask) - np.count_nonzero(
            ball_points(SHAPE, BALL).mask
        )
        assert json.loads(out)["left_out"]["masked"] == rim + (0 if whole else 200)


def test_a_saved_fit_is_made_again_from_its_scene_and_mask(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    scene = photograph_scene(ball_seen((80, 80), Circle(40, 39, 30.3)), (0.3, 0.4, 0.9))
    picture = np.asarray(brdf.render(brdf.BlinnPhong(k_d=[0.4, 0.3, 0.2], k_s=0.3, n=40), scene))
    on_ball = np.asarray(ball_points((80, 80), Circle(40, 39, 30.3)).mask)
    brdf.write_image("ball.png", np.where(on_ball[..., None], picture, 0.9))  # a bright background, and a mixed rim
    words = ["--model", "blinn-phong", "--json"]
    first = run(capsys, "fit", "ball.png", "--sphere", "40,39,30.3", "--light", "0.3,0.4,0.9", "--out", "out", *words)
    again = run(capsys, "fit", "ball.png", "--scene", "out/scene.toml", "--mask", "out/mask.png", *words)
    before, after = (json.loads(out)["parameters"] for _, out, _ in (first, again))
    for one, other in zip(before, after, strict=True):
        assert one["value"] == (other["value"] and pytest.approx(other["value"], rel=1e-6))


def test_a_circle_that_is_off_is_named_and_freed(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    true = brdf.BlinnPhong(k_d=[0.4, 0.3, 0.2], k_s=0.3, n=40)
    scene = photograph_scene(ball_seen((120, 120), Circle(60, 59, 48)), (0.3, 0.4, 0.9))
    brdf.write_image("ball.png", np.asarray(brdf.render(true, scene)))
    words = ["fit", "ball.png", "--sphere", "60,59,49", "--light", "0.3,0.4,0.9", "--model", "blinn-phong"]
    status, out, err = run(capsys, *words)
    assert status == 0, err
    assert re.search(r"cause\? +radius off by -(0\.9|1)", out)
    status, out, err = run(capsys, *words, "--free", "radius", "--json")
    assert status == 0, err
    n = next(one for one in json.loads(out)["parameters"] if one["name"] == "n")
    assert abs(n["value"] - 40) < 4 * n["error"] < 0.1


def test_what_is_clipped_is_told_as_clipped_where_a_light_is_freed(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    true = brdf.BlinnPhong(k_d=[0.4, 0.3, 0.2], k_s=0.5, n=40)
    scene = photograph_scene(ball_seen((120, 120), Circle(60, 59, 48)), (0.3, 0.4, 0.9))
    brdf.write_image("ball.png", np.minimum(np.asarray(brdf.render(true, scene)), 0.6))
    words = ["fit", "ball.png", "--sphere", "60,59,48", "--light", "0.31,0.4,0.9", "--model", "blinn-phong"]
    found, left_out = {}, []
    for more in ((), ("--free", "light")):
        status, out, err = run(capsys, *words, "--saturation", "0.59", "--precision", "float64", "--json", *more)
        assert status == 0, err
        found = json.loads(out)
        left_out.append(found["left_out"])
    assert left_out[0] == left_out[1]
    assert found["left_out"]["clipped"] > 0
    n = next(one for one in found["parameters"] if one["name"] == "n")
    assert abs(n["value"] - 40) < 4 * n["error"] < 0.4


def test_what_a_mask_hides_does_not_pull_the_light(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    picture, mask = shaded((0.3, 0.4, 0.86)), np.ones((*SHAPE, 1), np.float32)
    picture[5:30, 12:40], mask[5:30, 12:40] = 0.7, 0.0
    brdf.write_image("ball.exr", picture)
    brdf.write_image("mask.png", mask)
    words = ["fit", "ball.exr", "--sphere", f"{BALL.x},{BALL.y},{BALL.radius}", "--light", "fit", "--mask", "mask.png"]
    status, out, err = run(capsys, *words, "--model", "lambert", "--json")
    assert status == 0, err
    assert k_d(out) == pytest.approx(0.8, rel=1e-4)


def test_a_picture_that_fits_both_ways_says_that_its_encoding_is_a_guess(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    dirt = np.random.default_rng(5).uniform(0.1, 1.0, (*SHAPE, 1))
    write_silent("ball.png", shaded((0, 0, 1)) * dirt, "srgb", "uint8")
    circle = f"{BALL.x},{BALL.y},{BALL.radius}"
    status, out, err = run(capsys, "fit", "ball.png", "--sphere", circle, "--light", "0,0,1", "--model", "lambert")
    assert status == 0, err
    assert len(re.findall(r"sRGB is a guess\. Under it .* linear", out)) == 1


def test_normals_and_archives_say_the_same(photographs, capsys, monkeypatch):
    monkeypatch.chdir(photographs)
    points = ball_points(SHAPE, BALL)
    normal = np.where(np.asarray(points.mask)[..., None], np.asarray(points.normal), 0)
    np.save("normal.npy", normal)
    brdf.write_image("normal.exr", normal.astype(np.float32))
    lights = np.loadtxt("lights.txt")
    images = np.stack([np.round(shaded(light) * 65535) for light in lights]).astype(np.uint16)
    np.savez("ball.npz", images=images, normal=normal, light_dirs=lights, mask=disc(BALL))
    found = []
    for index, file in enumerate(("normal.npy", "normal.exr")):
        words = ["fit", "0.png", "--light", "0.3,0.4,0.86", "--normals", file, "--encoding", "linear"]
        status, out, err = run(capsys, *words, "--model", "lambert", "--json")
        assert status == 0, (index, err)
        found.append(k_d(out))
    status, out, err = run(capsys, "fit", "ball.npz", "--model", "lambert", "--json")
    assert status == 0, err
    assert np.allclose([*found, k_d(out)], 0.8, rtol=1e-3)


def test_a_mask_leaves_out_more_of_an_archive_than_its_own(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    points, light = ball_points(SHAPE, BALL), (0.3, 0.4, 0.86)
    picture, known, shown = shaded(light), np.asarray(points.mask).copy(), np.ones((*SHAPE, 1), np.float32)
    picture[10:15, 20:30] = picture[30:35, 20:30] = 0.9
    known[10:15, 20:30] = False
    shown[30:35, 20:30] = 0.0
    brdf.write_image("mask.png", shown)
    np.savez("ball.npz", images=picture[None], normal=np.asarray(points.normal), light_dirs=[light], mask=known)
    status, out, err = run(capsys, "fit", "ball.npz", "--mask", "mask.png", "--model", "lambert", "--json")
    assert status == 0, err
    assert k_d(out) == pytest.approx(0.8, rel=1e-5)


def test_codes_of_an_archive_count_where_its_lights_are_freed(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    lights, intensities = np.array([[0.3, 0.4, 0.86], [-0.5, 0.1, 0.86]]), [0.7, 1.2]
    pictures = [shaded(light) * intensity for light, intensity in zip(lights, intensities, strict=True)]
    images, points = np.round(np.stack(pictures) * 255).astype(np.uint8), ball_points(SHAPE, BALL)
    normal = np.where(np.asarray(points.mask)[..., None], np.asarray(points.normal), 0)
    np.savez("ball.npz", images=images, normal=normal, light_dirs=lights, light_intensities=intensities)
    status, out, err = run(capsys, "fit", "ball.npz", "--model", "lambert", "--free", "light", "--json")
    assert status == 0, err
    found = next(one for one in json.loads(out)["parameters"] if one["name"] == "k_d")
    # By least squares 4e-5.
    assert abs(found["value"] - 0.8) < 4 * found["error"] < 1e-4


def test_lights_from_a_matt_ball_in_one_command(photographs, capsys, monkeypatch):
    monkeypatch.chdir(photographs)
    words = ["lights", "0.png", "1.png", "--sphere", f"{BALL.x},{BALL.y},{BALL.radius}", "--encoding", "linear"]
    status, out, err = run(capsys, *words, "--matt", "--out", "found.txt")
    assert status == 0, err
    assert out == "wrote found.txt\n"
    for light, found in zip(np.loadtxt("lights.txt"), read_directions("found.txt", 2), strict=False):
        assert angle(found, light) < 0.05  # 16-bit codes
    assert len(re.findall(r"# ± [\d.e-]+°", Path("found.txt").read_text(encoding="utf-8"))) == 2


@pytest.mark.parametrize("hidden_by", ["alpha", "--mask", "--saturation", "--ambient"])
def test_lights_of_a_matt_ball_are_those_that_the_fit_takes(tmp_path, capsys, monkeypatch, hidden_by):
    monkeypatch.chdir(tmp_path)
    light, patch = (0.3, 0.4, 0.86), (slice(5, 30), slice(12, 40))
    picture = shaded(light) + 0.002 * np.random.default_rng(8).standard_normal((*SHAPE, 1)).astype(np.float32)
    opaque, words = np.ones((*SHAPE, 1), np.float32), []
    if hidden_by in ("alpha", "--mask"):
        picture[patch], opaque[patch] = 0.7, 0.0
    if hidden_by == "--mask":
        brdf.write_image("mask.png", opaque)
        words, opaque = ["--mask", "mask.png"], np.ones_like(opaque)
    elif hidden_by == "--saturation":
        picture, words = np.minimum(picture, 0.5), ["--saturation", "0.5"]
    elif hidden_by == "--ambient":
        picture, words = picture + np.float32(0.2), ["--ambient"]
    write_layered("ball.exr", np.concatenate([picture, opaque], axis=-1))
    shared = ["ball.exr", "--sphere", f"{BALL.x},{BALL.y},{BALL.radius}"]
    status, out, err = run(capsys, "lights", *shared, "--matt", *words)
    assert status == 0, err
    assert angle([float(one) for one in out.split()[:3]], light) < 0.3  # some 6 times what the noise does
    _, told, _ = run(capsys, "fit", *shared, "--light", "fit", "--model", "lambert", *words)
    numbers = [re.findall(r"-?\d\.\d+", text)[:4] for text in (out, told[told.index("from its shading") :])]
    assert np.allclose(*(np.array(one, float) for one in numbers), rtol=0, atol=5e-5)  # four decimals
    if words:
        status, plain, err = run(capsys, "lights", *shared, "--matt")
        assert status == 0 or "is not shaded like this surface" in err
        assert status == 2 or angle([float(one) for one in plain.split()[:3]], light) > 1.0


@pytest.mark.parametrize("hidden_by", ["alpha", "mask"])
def test_a_highlight_that_is_not_to_be_seen_is_none(tmp_path, capsys, monkeypatch, hidden_by):
    monkeypatch.chdir(tmp_path)
    rows, columns = np.mgrid[: SHAPE[0], : SHAPE[1]]
    picture = np.exp(-((columns - BALL.x) ** 2 + (rows - BALL.y) ** 2) / 4)[..., None]
    opaque = np.ones_like(picture)
    picture[15:18, 38:41], opaque[15:18, 38:41] = 2.0, 0.0
    brdf.write_image("mask.png", opaque)
    write_layered("ball.exr", np.concatenate([picture, opaque if hidden_by == "alpha" else opaque**0], axis=-1))
    words = ["lights", "ball.exr", "--sphere", f"{BALL.x},{BALL.y},{BALL.radius}"]
    status, out, err = run(capsys, *words, *(["--mask", "mask.png"] if hidden_by == "mask" else []))
    assert status == 0, err
    assert angle([float(one) for one in out.split()], (0, 0, 1)) < 2.6  # half a pixel


@pytest.mark.parametrize(("light", "off", "doubted"), [((0.3, 0.2, 0.93), 1.0, 0), ((0.3, 0.2, -1.0), 5.0, 1)])
def test_lights_from_a_mirror_ball_in_one_command(tmp_path, capsys, monkeypatch, light, off, doubted):
    monkeypatch.chdir(tmp_path)
    circle = Circle(60.0, 55.0, 50.0)
    points = ball_points((110, 120), circle)
    light = np.array(light) / np.linalg.norm(light)
    mirrored = 2 * np.asarray(points.normal)[..., 2:] * np.asarray(points.normal) - [0, 0, 1]
    glow = np.where(points.mask, np.exp(300 * (mirrored @ light - 1)), 0)
    brdf.write_image("chrome.png", glow[..., None].astype(np.float32))
    status, out, _ = run(capsys, "lights", "chrome.png", "--sphere", "60,55,50", "--out", "lights.txt")
    assert status == 0
    assert "wrote lights.txt" in out
    assert angle(read_directions("lights.txt", 1)[0], light) < off
    assert Path("lights.txt").read_text().count("# it comes from behind") == doubted


@pytest.mark.parametrize("share", [0.2, 0.7, 0.95])
def test_the_encoding_that_leaves_less_is_taken_and_called_a_guess_unless_it_is_clear(share):
    is_other, words = encoding_trial.judge("srgb", 0.01, 0.01 * share)
    assert is_other == (share < 0.9)
    assert ("a guess" in words) == (share >= 0.5)
    assert words.endswith("say so with --encoding")
