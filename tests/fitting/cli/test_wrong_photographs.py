"""Photographs, normals and archives that are damaged or do not fit the options: one line, exit 2, no output."""

import os
import re
from pathlib import Path

import numpy as np
import pytest
from ball_pictures import SHAPE, photographs_in
from command_runs import run

import brdf
from fitting.photographs.archives import read_archive


@pytest.fixture
def photographs(tmp_path):
    return photographs_in(tmp_path)


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


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--ambient"], "--ambient: says nothing of a mirror ball's highlight"),
        (["--saturation", "0.9"], "--saturation: says nothing of a mirror ball's highlight"),
        (["--matt", "--saturation", "nan"], "--saturation: must be a linear"),
        (["--mask", "small.png"], "small.png: is of shape"),
        (["--matt", "--mask", "small.png"], "small.png: is of shape"),
        (["--matt", "--mask", "none.png"], "none.png: there is no such file"),
    ],
)
def test_wrong_options_of_lights(photographs, capsys, monkeypatch, words, said):
    monkeypatch.chdir(photographs)
    brdf.write_image("small.png", np.ones((4, 4, 1), np.float32))
    status, out, err = run(capsys, "lights", "0.png", "--sphere", "30,24,9", *words, "--out", "out.txt")
    assert (status, out) == (2, "")
    assert said in err
    assert err.startswith("error: ")
    assert err.count("\n") == 1
    assert not Path("out.txt").exists()


def test_nothing_else_of_an_archive_is_read(tmp_path):
    np.savez(
        tmp_path / "a.npz",
        images=np.ones((1, 2, 2)),
        normal=np.ones((2, 2, 3)),
        light_dirs=np.ones((1, 3)),
        evil=np.array([print], dtype=object),
    )
    assert set(read_archive(tmp_path / "a.npz")) == {"images", "normal", "light_dirs"}
