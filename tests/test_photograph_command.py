"""Photographs of a ball through the command: encodings, masks, lights, archives, wrong input."""

import json
import os
import re
import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio  # noqa: N813
import pytest
from ball_pictures import BALL, SHAPE, angle, disc, shaded

import brdf
from fitting.cli import encoding_trial
from fitting.cli.job import Job
from fitting.cli.main import main
from fitting.photographs.archives import read_archive
from fitting.photographs.ball import ball_points
from fitting.photographs.circle import Circle
from fitting.photographs.light_files import read_directions


def run(capsys, *words) -> tuple[int, str, str]:
    with pytest.raises(SystemExit) as done:
        main([str(word) for word in words])
    captured = capsys.readouterr()
    return int(done.value.code or 0), captured.out, captured.err


@pytest.fixture
def photographs(tmp_path):
    """Three photographs of a matt ball, of known exposure and light, 16 bit."""
    lights = np.array([[0.3, 0.4, 0.86], [-0.5, 0.1, 0.86], [0.0, -0.5, 0.87]])
    exposures = [1.0, 0.5, 0.8]
    for index, (light, exposure) in enumerate(zip(lights, exposures, strict=True)):
        brdf.write_image(tmp_path / f"{index}.png", shaded(light) * exposure, dtype="uint16", encoding="linear")
    np.savetxt(tmp_path / "lights.txt", lights)
    brdf.write_image(tmp_path / "mask.png", disc(BALL)[..., None].astype(np.float32))
    return tmp_path


def write_silent(path: str, pixels: np.ndarray, encoding: Any, dtype: str) -> None:
    """A PNG file without a word about its encoding: magic, header, one block of pixels, end."""
    largest = np.iinfo(dtype).max
    codes = np.round(brdf.encode(pixels.astype(np.float32), encoding) * largest).astype(f">u{np.dtype(dtype).itemsize}")
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
    assert "encoded" not in out


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
        assert json.loads(out)["left_out"].get("masked", 0) == (0 if whole else 200)


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


def test_lights_from_a_mirror_ball_in_one_command(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    circle = Circle(60.0, 55.0, 50.0)
    points = ball_points((110, 120), circle)
    light = np.array([0.3, 0.2, 0.93]) / np.linalg.norm([0.3, 0.2, 0.93])
    mirrored = 2 * np.asarray(points.normal)[..., 2:] * np.asarray(points.normal) - [0, 0, 1]
    glow = np.where(points.mask, np.exp(300 * (mirrored @ light - 1)), 0)
    brdf.write_image("chrome.png", glow[..., None].astype(np.float32))
    status, out, _ = run(capsys, "lights", "chrome.png", "--sphere", "60,55,50", "--out", "lights.txt")
    assert status == 0
    assert "wrote lights.txt" in out
    assert angle(read_directions("lights.txt", 1)[0], light) < 1.0


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["0.png"], "comes without a scene"),
        (["0.png", "1.png"], "--sphere: 2 pictures"),
        (["0.png", "--light", "0,0,1"], "--light: says where the light is"),
        (["0.png", "--sphere", "1,2"], "--light: or --lights has to say"),
        (["0.png", "--sphere", "1,2", "--light", "0,0,1"], "--sphere: must be 3 finite numbers"),
        (["0.png", "--sphere", "nan,2,9", "--light", "0,0,1"], "--sphere: must be 3 finite numbers"),
        (["0.png", "--sphere", "10,20,-3", "--light", "0,0,1"], "--sphere: has a radius"),
        (["0.png", "--sphere", "900,20,9", "--light", "0,0,1"], "--sphere: .* outside the picture"),
        (["0.png", "--sphere", "mask", "--light", "0,0,1"], "--sphere: is to be found in the mask"),
        (["0.png", "--sphere", "30,24,9", "--light", "0,0,0"], "--light: must not have zero length"),
        (["0.png", "--sphere", "30,24,9", "--light", "up"], "--light: must be 3 finite numbers"),
        (["0.png", "--sphere", "30,24,9", "--light", "0,0,1", "--lights", "lights.txt"], "--light: or --lights"),
        (["0.png", "--sphere", "30,24,9", "--lights", "lights.txt"], "3 lines for 1 pictures"),
        (["0.png", "--sphere", "30,24,9", "--lights", "none.txt"], "none.txt: there is no such file"),
        (["0.png", "--sphere", "30,24,9", "--light", "0,0,1", "--exposure", "0"], "--exposure: must be above 0"),
        (["0.png", "--sphere", "30,24,9", "--light", "0,0,1", "--exposure", "1,2,3"], "--exposure: must be 1 finite"),
        (["0.png", "--sphere", "30,24,9", "--light", "0,0,1", "--noise", "1"], "--noise: must be 2 finite numbers"),
        (["0.png", "--sphere", "30,24,9", "--light", "0,0,1", "--noise", "-1,0"], "--noise: must be two numbers of 0"),
        (["0.png", "--sphere", "30,24,9", "--light", "0,0,1", "--dark", "nan"], "--dark: must be a linear value"),
        (["0.png", "--sphere", "30,24,9", "--light", "0,0,1", "--saturation", "nan"], "--saturation: must be a linear"),
        (["0.png", "--sphere", "30,24,9", "--light", "0,0,1", "--loss", "l1"], "--loss: is unknown"),
        (["0.png", "--sphere", "30,24,9", "--light", "0,0,1", "--normals", "0.png"], "--normals: says what --sphere"),
        (["0.png", "--sphere", "30,24,9", "--light", "0,0,1", "--scene", "a.toml"], "--scene: says what"),
        (["0.png", "--normals", "small.npy", "--light", "0,0,1"], "small.npy: is 2 x 2, the pictures 60 x 52"),
        (["0.png", "--normals", "pickled.npy", "--light", "0,0,1"], "pickled.npy: holds object, not numbers"),
        (["0.png", "--normals", "huge.npy", "--light", "0,0,1"], "huge.npy: claims"),
        (["0.png", "--normals", "header.npy", "--light", "0,0,1"], "header.npy: is no array"),
        (["0.png", "--normals", "null.npy", "--light", "0,0,1"], "null.npy: is no array"),
        (["0.png", "--normals", "mask.png", "--light", "0,0,1"], "mask.png: has 1 channels instead of 3"),
        (["empty.npz"], "empty.npz: holds no array images"),
        (["lights.npz"], "lights.npz: is no readable archive"),
        (["bomb.npz"], "bomb.npz: claims more than can be in it"),
        (["pickled.npz"], "pickled.npz: images: holds object, not numbers"),
        (["shapes.npz"], "shapes.npz: normal: is of shape"),
        (["signed.npz"], "signed.npz: images: holds int8, of which it is not clear what is white"),
        (["flags.npz"], "flags.npz: images: holds bool"),
        (["masked.npz"], "masked.npz: normal: has no normal inside the mask"),
        (["bright.exr", "--sphere", "30,24,9", "--light", "0,0,1"], "bright.exr: has 1e[+]30 as its largest value"),
        (["faint.exr", "--sphere", "30,24,9", "--light", "0,0,1"], "faint.exr: has 1e-3. as its largest value"),
        (["dark.exr", "--sphere", "30,24,9", "--light", "fit"], "dark.exr: has fewer than ten lit pixels"),
        (["0.png", "--sphere", "30,24,9", "--light", "fit", "--saturation", "nan"], "--saturation: must be a linear"),
        (["shapes.npz", "--encoding", "srgb"], "--encoding: is what shapes.npz says itself"),
        (["shapes.npz", "--sphere", "1,2,9"], "--sphere: is what shapes.npz says itself"),
    ],
)
def test_wrong_photographs(photographs, capsys, monkeypatch, words, said):
    monkeypatch.chdir(photographs)
    np.save("small.npy", np.ones((2, 2, 3)))
    np.save("pickled.npy", np.array([{}, 1], dtype=object), allow_pickle=True)
    header = b"{'descr': '<f8', 'fortran_order': False, 'shape': (100000, 100000, 3), }"
    Path("huge.npy").write_bytes(b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header)
    # Found by fuzzing: NumPy tokenizes a header that is no literal, and lets the tokenizer's error pass.
    header = b"{'descr': '<f 3 , [[]] 3) ,  }\n"
    Path("header.npy").write_bytes(b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header)
    # A null byte in it, which Python 3.13 calls a system error.
    header = b"{'descr': '<f4', \x00}\n"
    Path("null.npy").write_bytes(b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header)
    np.savez("empty.npz", a=np.ones(3))
    Path("lights.npz").write_text("PK\x03\x04 this is none")
    np.savez_compressed("bomb.npz", images=np.zeros((20_000, 1000), np.uint8), normal=[0], light_dirs=[0])
    bomb = Path("bomb.npz").read_bytes()
    # The directory's size of the first entry, made 2^31.
    place = bomb.rindex(b"PK\x01\x02", 0, bomb.rindex(b"normal.npy"))
    Path("bomb.npz").write_bytes(bomb[: place + 24] + (2**31 - 1).to_bytes(4, "little") + bomb[place + 28 :])
    np.savez("pickled.npz", images=np.array([{}], dtype=object), normal=[0], light_dirs=[0])
    arrays = {"normal": np.ones((4, 5, 3)), "light_dirs": np.ones((3, 3))}
    np.savez("signed.npz", images=np.ones((3, 4, 5), np.int8), **arrays)
    np.savez("flags.npz", images=np.ones((3, 4, 5), bool), **arrays)
    np.savez("masked.npz", images=np.ones((3, 4, 5)), mask=np.zeros((4, 5)), **arrays)
    for name, factor in (("bright", 1e30), ("faint", 1e-30), ("dark", 0.0)):
        brdf.write_image(f"{name}.exr", np.full((*SHAPE, 1), factor, np.float32))
    np.savez("shapes.npz", images=np.ones((3, 4, 5)), normal=np.ones((4, 4, 3)), light_dirs=np.ones((3, 3)))
    before = sorted(os.listdir())
    status, out, err = run(capsys, "fit", *words, "--out", "out")
    assert (status, out) == (2, "")
    assert re.search(said, err), err
    assert err.startswith("error: ")
    assert err.count("\n") == 1
    assert sorted(os.listdir()) == before


def test_nothing_else_of_an_archive_is_read(tmp_path):
    np.savez(
        tmp_path / "a.npz",
        images=np.ones((1, 2, 2)),
        normal=np.ones((2, 2, 3)),
        light_dirs=np.ones((1, 3)),
        evil=np.array([print], dtype=object),
    )
    assert set(read_archive(tmp_path / "a.npz")) == {"images", "normal", "light_dirs"}


@pytest.mark.parametrize("share", [0.2, 0.7, 0.95])
def test_the_reading_that_leaves_less_is_taken_and_called_a_guess_unless_it_is_clear(share, monkeypatch):
    picture = brdf.Picture(np.ones((2, 2, 1), np.float32), None, "srgb", "assumed", 8, 1.0)
    jobs = (Job([picture], [], [None], Path("a.png")), Job([picture], [], [None], Path("a.png")))
    left = iter([(1.0, 100.0), (share, 100.0)])
    monkeypatch.setattr(encoding_trial, "unexplained", lambda job, result: next(left))
    is_other, words = encoding_trial.judge(jobs, (Any, Any))
    assert is_other == (share < 0.9)
    assert ("a guess" in words) == (share >= 0.5)
    assert words.endswith("say so with --encoding")
