"""What is wrong with input, and what the command says: one line that names file, key or option, exit 2, no output.

A case is what lies in the folder beside the sound files, the words of the command, and what it says. Further malformed
materials, tables and pictures stand with their readers, in tests/brdf.
"""

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ball_pictures import SHAPE, photographs_in
from command_runs import refused
from sound_files import SCENE, scene, sound_files

import brdf
from benchmarks.fuzz_corpus import CAMERA, LIGHT, POINT, RECTANGLE, SPHERE

RENDER = "render material.json --scene scene.toml -o out.exr"
FIT = "fit target.exr --scene scene.toml"
BALL = "fit 0.png --sphere 30,24,9"
LIT = f"{BALL} --light 0,0,1"

SCENES = {
    "nan in position": (scene("[0.0, 0.0, 4.0]", "[nan, 0.0, 4.0]"), r"camera\.position: must be finite"),
    "inf in target": (scene("target = [0.0, 0.0, 0.0]", "target = [inf, 0.0, 0.0]"), r"camera\.target: must be finite"),
    "zero up": (scene("[0.0, 1.0, 0.0]", "[0.0, 0.0, 0.0]"), r"camera\.up: must not have zero length"),
    "up along view": (scene("[0.0, 1.0, 0.0]", "[0.0, 0.0, 1.0]"), r"camera\.up"),
    "eye at target": (scene("[0.0, 0.0, 4.0]", "[0.0, 0.0, 0.0]"), r"camera\.(position|target)"),
    "negative width": (scene("width = 2.2", "width = -2.2"), r"camera\.width: must be greater than 0, got -2\.2"),
    "nan width": (scene("width = 2.2", "width = nan"), r"camera\.width: must be finite"),
    "width is text": (scene("width = 2.2", 'width = "2.2"'), r"camera\.width: must be a number"),
    "width is true": (scene("width = 2.2", "width = true"), r"camera\.width: must be a number"),
    "no width": (scene("width = 2.2\n", ""), r"camera: has no width"),
    "no camera type": (scene('type = "orthographic"\n', ""), r"camera: has no type"),
    "unknown camera": (scene('"orthographic"', '"fisheye"'), r"camera\.type: is unknown"),
    "unknown key": (scene("width = 2.2", "width = 2.2\nwidht = 3"), r"camera\.widht: is not a known key"),
    "zero resolution": (scene("[8, 8]", "[0, 8]"), r"camera\.resolution"),
    "negative resolution": (scene("[8, 8]", "[-8, 8]"), r"camera\.resolution"),
    "fractional resolution": (scene("[8, 8]", "[8.5, 8]"), r"camera\.resolution"),
    "one resolution": (scene("[8, 8]", "[8]"), r"camera\.resolution"),
    "huge resolution": (scene("[8, 8]", "[2147483647, 2147483647]"), r"camera\.resolution"),
    "negative radius": (scene("radius = 1.0", "radius = -1.0"), r"shapes\[0\]\.radius: must be greater than 0, got -1"),
    "zero radius": (scene("radius = 1.0", "radius = 0"), r"shapes\[0\]\.radius: must be greater than 0"),
    "inf radius": (scene("radius = 1.0", "radius = inf"), r"shapes\[0\]\.radius: must be finite"),
    "list radius": (scene("radius = 1.0", "radius = [1.0]"), r"shapes\[0\]\.radius: must be one number"),
    "short center": (scene("center = [0.0, 0.0, 0.0]", "center = [0.0, 0.0]"), r"shapes\[0\]\.center: must be three"),
    "empty center": (scene("center = [0.0, 0.0, 0.0]", "center = []"), r"shapes\[0\]\.center: must be three"),
    "nested center": (scene("center = [0.0, 0.0, 0.0]", "center = [[0, 0, 0]]"), r"shapes\[0\]\.center: must be three"),
    "ragged center": (scene("center = [0.0, 0.0, 0.0]", "center = [[0], 0, 0]"), r"shapes\[0\]\.center: must be"),
    "date center": (scene("center = [0.0, 0.0, 0.0]", "center = 2026-01-01"), r"shapes\[0\]\.center: must be"),
    "fitted is text": (scene("radius = 1.0", 'radius = 1.0\nfitted = "no"'), r"shapes\[0\]\.fitted: must be true or"),
    "nothing fitted": (scene("radius = 1.0", "radius = 1.0\nfitted = false"), r"shapes: has no shape that is fitted"),
    "no shapes": (CAMERA + LIGHT, r"shapes: has no shape"),
    "empty shapes": ("shapes = []\n" + CAMERA + LIGHT, r"shapes: has no shape"),
    "shapes is a table": (scene("[[shapes]]", "[shapes]"), r"shapes: must be a list of tables"),
    "shapes is a number": ("shapes = 3\n" + CAMERA + LIGHT, r"shapes: must be a list of tables"),
    "camera is a number": ("camera = 3\n" + SPHERE + LIGHT, r"camera: must be a table"),
    "flat rectangle": (scene("edge_v = [0, 1, 0]", "edge_v = [2, 0, 0]", CAMERA + RECTANGLE), r"edge_v: must not be"),
    "no edge": (scene("edge_v = [0, 1, 0]\n", "", CAMERA + RECTANGLE), r"shapes\[0\]: has no edge_v"),
    "zero direction": (scene("[0.5, 0.6, 0.7]", "[0, 0, 0]"), r"lights\[0\]\.direction: must not have zero length"),
    "nan direction": (scene("[0.5, 0.6, 0.7]", "[0, nan, 0]"), r"lights\[0\]\.direction: must be finite"),
    "negative light": (scene("[1.0, 1.0, 1.0]", "[1.0, -1.0, 1.0]"), r"lights\[0\]\.intensity: .* -1 in channel 1"),
    "empty light": (scene("[1.0, 1.0, 1.0]", "[]"), r"lights\[0\]\.intensity: must be a number per channel"),
    "inf light": (scene("[1.0, 1.0, 1.0]", "[1.0, 1e999, 1.0]"), r"lights\[0\]\.intensity: must be finite"),
    "unknown light": (scene('"directional"', '"sun"'), r"lights\[0\]\.type: is unknown"),
    "no falloff": (SCENE + scene("[0, 0, 1]", "[0, 0, 0]", POINT), r"lights\[1\]\.attenuation"),
    "negative falloff": (SCENE + scene("[0, 0, 1]", "[1, 0, -1]", POINT), r"lights\[1\]\.attenuation"),
    "channels": (SCENE + scene("[1.0]", "[1.0, 1.0]", POINT), r"intensity: lights have 2 and 3 channels"),
    "ambient without intensity": (SCENE + "[ambient]\n", r"ambient: has no intensity"),
    "negative ambient": (SCENE + "[ambient]\nintensity = -1\n", r"ambient\.intensity: must be at least 0"),
    "unknown table": (SCENE + "[fog]\ndensity = 1\n", r"fog: is not a known key"),
    "not TOML": ("this is none", r"is not TOML"),
    "deep": ("a = " + "[" * 5000, r"is not TOML"),
    "twice": (SCENE + CAMERA, r"is not TOML"),
    "empty": ("", r"is empty"),
    "aov outside": ('[aov]\nfile = "../../etc/passwd"\n' + LIGHT, r"aov\.file: must stay within the scene's folder"),
    "aov absolute": ('[aov]\nfile = "/etc/passwd"\n' + LIGHT, r"aov\.file: must stay within the scene's folder"),
    "aov missing": ('[aov]\nfile = "none.exr"\n' + LIGHT, r"none\.exr: there is no such file"),
    "aov is a number": ("[aov]\nfile = 3\n" + LIGHT, r"aov\.file: must be a path"),
    "aov has a zero byte": ('[aov]\nfile = "a\\u0000b.exr"\n' + LIGHT, r"aov\.file: is no path"),
}


def numpy_file(header: bytes) -> bytes:
    return b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header


def bomb(path: Path) -> None:
    """An archive whose directory claims 2^31 bytes for an entry."""
    np.savez_compressed(path, images=np.zeros((20_000, 1000), np.uint8), normal=[0], light_dirs=[0])
    content = path.read_bytes()
    place = content.rindex(b"PK\x01\x02", 0, content.rindex(b"normal.npy"))
    path.write_bytes(content[: place + 24] + (2**31 - 1).to_bytes(4, "little") + content[place + 28 :])


def archive(**arrays: Any) -> dict[str, Any]:
    return {"images": np.ones((3, 4, 5)), "normal": np.ones((4, 5, 3)), "light_dirs": np.ones((3, 3))} | arrays


def picture(value: float = 1.0, shape: tuple[int, int] = (8, 8), channels: int = 3) -> np.ndarray:
    return np.full((*shape, channels), value, np.float32)


def device(path: Path) -> None:
    path.symlink_to("/dev/zero")


def loop(path: Path) -> None:
    path.symlink_to(path)


OBJECTS = np.array([{}, 1], dtype=object)
TABLE = "1\n400\n0.1 0 0.2 0 0.3\n0.2 0 0.2 1 0.3\n"
SHORT = b"\x5a\0\0\0\x5a\0\0\0\xb4\0\0\0" + bytes(8)
IS_TABLE = "is a measured BRDF; of the options only --model"
MISSPELT = "^error: emrald: is no material file and no name of the classic table. The table has emerald.\n$"

# What lies in the folder, by name; the words of the command; what it says, a regular expression.
CASES: list[tuple[dict[str, Any], str, str]] = [
    # usage
    ({}, "fit", r"Missing argument .*\. See brdf fit --help\.$"),
    ({}, "render", "[Mm](aterial|ATERIAL)"),
    ({}, "check a b", r"\. See brdf check --help\.$"),
    ({}, "melt target.exr", r"melt.*\. See brdf --help\.$"),
    ({}, f"{FIT} --speed 1", "No such option: --speed"),
    ({}, f"{FIT} --saturation much", "saturation"),
    # paths
    ({}, "render none.json --scene scene.toml -o o.exr", "none.json: there is no such file"),
    ({}, "check none.json", "^error: none.json: there is no such file"),
    ({}, "check none.binary", "none.binary: there is no such file"),
    ({}, "fit none.exr --scene scene.toml", "none.exr: there is no such file"),
    ({}, "fit none.png", "none.png: there is no such file"),
    ({}, "tradeoff none.png", "none.png: there is no such file"),
    ({}, "render material.json --scene . -o o.exr", "is a folder, not a file"),
    ({}, "fit none.exr --scene scene.toml --out target.exr", "target.exr: a part of the path is not a folder"),
    (
        {},
        "render material.json --scene scene.toml -o no/o.exr",
        "no/o.exr: cannot be written, there is no folder no. Make it first",
    ),
    ({"o.exr": Path.mkdir}, "render material.json --scene scene.toml -o o.exr", "o.exr: is a folder"),
    ({}, "render material.json --scene scene.toml -o o.xyz", "o.xyz"),
    ({".json": Path.mkdir}, "render .json --scene scene.toml -o o.exr", ".json: is a folder without material.json"),
    ({"odd": os.mkfifo}, "fit odd --scene scene.toml", "odd: is not an ordinary file"),
    ({"odd": device}, "fit odd --scene scene.toml", "odd: is not an ordinary file"),
    ({"odd": loop}, "fit odd --scene scene.toml", "odd: the links lead in a circle"),
    ({"odd": Path.mkdir}, "fit odd", "odd: has no file target"),
    ({"odd": os.mkfifo}, "fit target.exr --scene odd", "odd: is not an ordinary file"),
    ({"odd": device}, "tradeoff target.exr --scene odd", "odd: is not an ordinary file"),
    ({"odd": os.mkfifo}, "fit 0.png --sphere mask --mask odd --light 0,0,1", "odd: is not an ordinary file"),
    ({"odd": os.mkfifo}, f"{BALL} --lights odd", "odd: is not an ordinary file"),
    ({"odd": os.mkfifo}, f"{LIT} --intensities odd", "odd: is not an ordinary file"),
    ({"odd": os.mkfifo}, "fit 0.png --normals odd --light 0,0,1", "odd: is not an ordinary file"),
    ({"odd": os.mkfifo}, "lights odd --sphere 4,4,4", "odd: is not an ordinary file"),
    ({"odd.json": os.mkfifo}, "check odd.json", "odd.json: is not an ordinary file"),
    ({"odd.json": loop}, "convert odd.json new.json --to three", "odd.json: the links lead in a circle"),
    ({"odd.exr": os.mkfifo}, "render material.json --scene scene.toml -o odd.exr", "odd.exr: is not an ordinary file"),
    # materials
    ({"material.json": '{"model": "lambert", "k_d": [NaN]}'}, RENDER, "material.json.*k_d: must be finite, got nan"),
    ({"a.mtl": "newmtl a\nKd red\n"}, "check a.mtl", "a.mtl.*line 2: Kd must be numbers"),
    ({}, "check target.exr", "target.exr: is no material file"),
    ({}, "check emrald", MISSPELT),
    ({}, "convert emrald x.json", MISSPELT),
    ({}, "render emrald --scene scene.toml -o x.exr", MISSPELT),
    ({}, "convert unobtainium o.json", "unobtainium: is no material file and no name.* emerald, jade"),
    ({"gold": "{}"}, "check gold", "gold: is no material file, got no suffix"),
    ({}, "convert emerald o.json --name a", "--name: chooses from a file"),
    ({}, "convert gold x.fbx", r"x.fbx: does not say its format, got .fbx. Name it .json"),
    ({}, "convert gold x.json --to fbx", "^error: --to: is unknown, got 'fbx'. Use one of json, mtl, three"),
    ({}, "convert gold no/such/folder/x.json", "x.json: cannot be written, there is no folder no"),
    # measured tables
    (
        {"felt.alta": ""},
        "check felt.alta --plot felt.png",
        "--plot: draws materials, and felt.alta is a measured table",
    ),
    ({}, "check gold --plot gold.xyz", "gold.xyz: is no name of a picture"),
    ({}, "check gold --plot gold_", "gold_: is no name of a picture"),
    ({"short.binary": SHORT}, "fit short.binary", "short.binary: has 20 bytes instead of"),
    ({"short.binary": SHORT}, "fit short.binary --scene scene.toml", IS_TABLE),
    ({"ok.brdf": TABLE}, "fit ok.brdf --loss huber", "^error: --loss: is unknown"),
    ({"ok.brdf": TABLE}, "fit ok.brdf --plausible", f"ok.brdf: {IS_TABLE}"),
    ({"ok.brdf": TABLE}, "fit ok.brdf --precision float64", IS_TABLE),
    # pictures and scenes
    ({}, "fit target.exr", "target.exr: comes without a scene. Add --scene"),
    ({}, "fit scene.toml --scene scene.toml", "scene.toml: cannot be read as an image"),
    ({"target.png": picture()}, "fit .", r"has several targets, target\.exr, target\.png"),
    (
        {"small.exr": picture(shape=(2, 2))},
        "fit small.exr --scene scene.toml",
        "small.exr: is 2 x 2, the scene's camera 8",
    ),
    (
        {"two.exr": picture(channels=2)},
        "fit two.exr --scene scene.toml",
        "two.exr: has 2 channels, the scene's light 3",
    ),
    ({"a.exr": picture(0.0)}, "fit a.exr --scene scene.toml", "a.exr: is black on the object"),
    ({"a.exr": picture(np.nan)}, "fit a.exr --scene scene.toml", "a.exr: has no finite value on the object"),
    ({"scene.toml": scene("center = [0.0", "center = [9.0")}, FIT, "target.exr: has no pixel that sees a fitted shape"),
    ({"scene.toml": SCENE + "colour = 1\n"}, "fit . --out made", r"lights\[0\]\.colour: is not a known key"),
    ({"mask.exr": picture(shape=(2, 2))}, f"{FIT} --mask mask.exr", "mask.exr"),
    # options of a fit
    ({}, f"{FIT} --model ward", "^error: --model: is unknown, got 'ward'"),
    ({}, f"{FIT} --precision half", "^error: --precision: is unknown, got 'half'"),
    ({}, f"{FIT} --encoding log", "^error: --encoding: must be"),
    ({}, f"{FIT} --loss l1", "^error: --loss: is unknown"),
    ({}, f"{FIT} --saturation nan", "^error: --saturation: must be a linear value"),
    ({}, f"{FIT} --saturation 1e-6", "target.exr: is clipped at 1e-06"),
    ({}, f"{FIT} --dark nan", "^error: --dark: must be a linear value"),
    ({}, f"{FIT} --dark -1", "^error: --dark: must be at least 0, got -1"),
    ({}, f"{FIT} --noise 1", "^error: --noise: must be 2 finite numbers"),
    ({}, f"{FIT} --noise -1,0", "^error: --noise: must be two numbers of 0"),
    ({}, f"{FIT} --plot", "^error: --plot: needs a folder"),
    ({}, f"{FIT} --accuracy 1e-3 --devices all", "^error: --devices: spreads all pixels"),
    (
        {},
        f"{FIT} --free light --plausible --loss huber",
        "^error: --free: knows nothing of --plausible and --loss. Leave one",
    ),
    ({}, f"{FIT} --report o.pdf", "o.pdf: is no name of a page"),
    ({"o.html": Path.mkdir}, f"{FIT} --out fitted --report o.html", "o.html: is a folder, not a file"),
    ({}, f"{FIT} --out fitted --report nodir/o.html", "nodir/o.html: cannot be written, there is no folder nodir"),
    ({}, f"{FIT} --ambient", "--ambient: is what the scene file says"),
    ({}, f"{FIT} --light 0,0,1", "--light: says where the light is, but nothing what the picture shows"),
    # photographs
    ({}, "fit 0.png 1.png", "--sphere: 2 pictures come without their geometry"),
    ({}, "fit 0.png 1.png --scene scene.toml", "--scene: tells what one picture shows, 2 are given"),
    ({}, "fit 0.png scene.toml", "scene.toml: is a scene, no picture. Write --scene scene.toml"),
    ({}, "fit 0.png --sphere 1,2", "--light: or --lights has to say"),
    ({}, "fit 0.png --sphere 1,2 --light 0,0,1", "--sphere: must be 3 finite numbers"),
    ({}, "fit 0.png --sphere nan,2,9 --light 0,0,1", "--sphere: must be 3 finite numbers"),
    ({}, "fit 0.png --sphere 10,20,-3 --light 0,0,1", "--sphere: has a radius"),
    ({}, "fit 0.png --sphere 900,20,9 --light 0,0,1", "--sphere: .* outside the picture"),
    ({}, "fit 0.png --sphere mask --light 0,0,1", "--sphere: is to be found in the mask, but there is none"),
    ({"w.png": picture(shape=SHAPE)}, "fit 0.png --sphere mask --mask w.png --light 0,0,1", "w.png: is no ball"),
    (
        {"a.png": picture(shape=(9, 9))},
        "fit 0.png a.png --sphere 4,4,4 --light 0,0,1",
        "0.png: and the others differ in size",
    ),
    ({}, f"{BALL} --light 0,0,0", "--light: must not have zero length"),
    ({}, f"{BALL} --light up", "--light: must be 3 finite numbers"),
    ({}, f"{LIT} --lights lights.txt", "--light: says what --lights says too"),
    ({}, f"{BALL} --lights lights.txt", "lights.txt: has 3 lines for 1 pictures"),
    ({}, f"{BALL} --lights none.txt", "none.txt: there is no such file"),
    ({"i.txt": "1 1"}, f"{LIT} --intensities i.txt", "i.txt: has 2 numbers a line, the pictures 1 channels"),
    ({"i.txt": "-1"}, f"{LIT} --intensities i.txt", "i.txt: line 1: must be 1 numbers of 0 or more"),
    ({"i.txt": "0 0 0"}, f"{LIT} --intensities i.txt", "i.txt: line 1: must be 3 numbers of 0 or more, not all 0"),
    ({}, f"{LIT} --exposure 0", "--exposure: must be above 0"),
    ({}, f"{LIT} --exposure 1e-300", "--exposure: must be above 0, between 1e-12 and"),
    ({}, f"{LIT} --exposure 1,2,3", "--exposure: must be 1 finite"),
    ({}, f"{LIT} --normals 0.png", "--normals: says what --sphere says too"),
    ({}, f"{LIT} --scene a.toml", "--scene: says what --sphere or --normals says too"),
    ({"n.npy": np.ones((2, 2, 3))}, "fit 0.png --normals n.npy --light 0,0,1", "n.npy: is 2 x 2, the pictures 60 x 52"),
    ({"n.npy": np.ones(3)}, "fit 0.png --normals n.npy --light 0,0,1", r"n.npy: must be of shape \(H, W, 3\)"),
    ({"n.npy": OBJECTS}, "fit 0.png --normals n.npy --light 0,0,1", "n.npy: is no array .Object arrays cannot"),
    (
        {"n.npy": numpy_file(b"{'descr': '<f8', 'fortran_order': False, 'shape': (100000, 100000, 3), }")},
        "fit 0.png --normals n.npy --light 0,0,1",
        "n.npy: is no array .*Save plain numbers",
    ),
    # Found by fuzzing: NumPy tokenizes a header that is no literal, and lets the tokenizer's error pass.
    (
        {"n.npy": numpy_file(b"{'descr': '<f 3 , [[]] 3) ,  }\n")},
        "fit 0.png --normals n.npy --light 0,0,1",
        "n.npy: is no array",
    ),
    # A null byte in it, which Python 3.13 calls a system error.
    (
        {"n.npy": numpy_file(b"{'descr': '<f4', \x00}\n")},
        "fit 0.png --normals n.npy --light 0,0,1",
        "n.npy: is no array",
    ),
    ({}, "fit 0.png --normals mask.png --light 0,0,1", r"mask.png: must be of shape \(H, W, 3\), got \(52, 60, 1\)"),
    ({"a.exr": picture(1e30, SHAPE)}, "fit a.exr --sphere 30,24,9 --light 0,0,1", "a.exr: has 1e[+]30 as its largest"),
    ({"a.exr": picture(1e-30, SHAPE)}, "fit a.exr --sphere 30,24,9 --light 0,0,1", "a.exr: has 1e-3. as its largest"),
    ({"a.exr": picture(0.0, SHAPE)}, "fit a.exr --sphere 30,24,9 --light fit", "a.exr: has fewer than ten lit pixels"),
    ({}, f"{BALL} --light fit --saturation nan", "--saturation: must be a linear"),
    # archives
    ({"a.npz": {"a": np.ones(3)}}, "fit a.npz", "a.npz: holds no array images"),
    ({"a.npz": "PK\x03\x04 this is none"}, "fit a.npz", "a.npz: is no readable archive"),
    ({"a.npz": bomb}, "fit a.npz", "a.npz: claims more than can be in it"),
    ({"a.npz": archive(images=OBJECTS)}, "fit a.npz", "a.npz: images: is no array .Object arrays cannot"),
    ({"a.npz": archive(images=np.ones((3, 4, 5), np.int8))}, "fit a.npz", "a.npz: images: holds int8, of which"),
    ({"a.npz": archive(images=np.ones((3, 4, 5), bool))}, "fit a.npz", "a.npz: images: holds bool"),
    ({"a.npz": archive(images=np.ones((3, 4)))}, "fit a.npz", r"a.npz: images: is of shape \(3, 4\)"),
    ({"a.npz": archive(normal=np.ones((4, 4, 3)))}, "fit a.npz", r"a.npz: normal: is of shape \(4, 4, 3\)"),
    ({"a.npz": archive(light_dirs=np.ones((2, 3)))}, "fit a.npz", r"a.npz: light_dirs: is of shape \(2, 3\)"),
    ({"a.npz": archive(light_dirs=np.zeros((3, 3)))}, "fit a.npz", "a.npz: light_dirs: must not have zero length"),
    ({"a.npz": archive(light_dirs=np.full((3, 3), np.nan))}, "fit a.npz", "a.npz: light_dirs: must be finite"),
    ({"a.npz": archive(light_intensities=-np.ones(3))}, "fit a.npz", "a.npz: light_intensities: must be at least 0"),
    ({"a.npz": archive(mask=np.ones((2, 2)))}, "fit a.npz", r"a.npz: mask: is of shape \(2, 2\)"),
    ({"a.npz": archive(mask=np.zeros((4, 5)))}, "fit a.npz", "a.npz: normal: has no normal inside the mask"),
    ({"a.npz": archive()}, "fit a.npz --encoding srgb", "--encoding: is what a.npz says itself"),
    ({"a.npz": archive()}, "fit a.npz --sphere 1,2,9", "--sphere: is what a.npz says itself"),
    ({"a.npz": archive()}, "tradeoff a.npz", "a.npz: holds 3 pictures, and one is measured"),
    # lights of a ball
    ({}, "lights 0.png --sphere 30,24,9 --ambient", "--ambient: says nothing of a mirror ball's highlight"),
    ({}, "lights 0.png --sphere 30,24,9 --saturation 0.9", "--saturation: says nothing of a mirror ball's highlight"),
    ({}, "lights 0.png --sphere 30,24,9 --matt --saturation nan", "--saturation: must be a linear"),
    ({"m.png": picture(shape=(4, 4))}, "lights 0.png --sphere 30,24,9 --mask m.png", "m.png: is of shape"),
    ({"m.png": picture(shape=(4, 4))}, "lights 0.png --sphere 30,24,9 --matt --mask m.png", "m.png: is of shape"),
    ({}, "lights 0.png --sphere 30,24,9 --matt --mask none.png", "none.png: there is no such file"),
]


def make(path: Path, content: Any) -> None:
    if callable(content):
        content(path)
    elif isinstance(content, str):
        path.write_text(content)
    elif isinstance(content, bytes):
        path.write_bytes(content)
    elif isinstance(content, dict):
        np.savez(path, **content)
    elif path.suffix == ".npy":
        np.save(path, content, allow_pickle=True)
    else:
        brdf.write_image(path, content)


@pytest.fixture
def place(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return photographs_in(sound_files(tmp_path))


@pytest.mark.parametrize("name", SCENES)
def test_scenes(place, capsys, name):
    text, said = SCENES[name]
    (place / "scene.toml").write_text(text)
    refused(capsys, place, said, *RENDER.split())


@pytest.mark.parametrize(
    ("files", "words", "said"), CASES, ids=[f"{words} {' '.join(files)}" for files, words, _ in CASES]
)
def test_whatever_else_is_wrong(place, capsys, files, words, said):
    for name, content in files.items():
        make(place / name, content)
    refused(capsys, place, said, *words.split())


def test_a_folder_may_be_called_as_an_option_is(place, capsys):
    (place / "out").mkdir()
    refused(capsys, place, "^error: out: has no file target", "fit", "out")


def test_an_empty_name_of_a_material(place, capsys):
    refused(
        capsys,
        place,
        r"^error: MATERIAL: is empty. Give a .json or .mtl file, or a name such as emerald\.$",
        "check",
        "",
    )


@pytest.mark.skipif(os.geteuid() == 0, reason="the superuser may read and write everywhere")
def test_paths_without_permission(place, capsys):
    (place / "material.json").chmod(0)
    refused(capsys, place, "permission denied", *RENDER.split())
