"""Malformed input of every kind, through the command: one line that names file and key, exit 2, and no output."""

import json
import os
import re

import numpy as np
import pytest
from command_runs import command, refused
from sound_files import MATERIAL, SCENE, scene, sound_files

import brdf
from benchmarks.fuzz_corpus import CAMERA, LIGHT, POINT, RECTANGLE, SPHERE
from brdf.errors import InputError

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
    "negative radius": (scene("radius = 1.0", "radius = -1.0"), r"shapes\[0\]\.radius: must be greater than 0"),
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
    "negative ambient": (SCENE + "[ambient]\nintensity = -1\n", r"ambient|intensity: must be at least 0"),
    "unknown table": (SCENE + "[fog]\ndensity = 1\n", r"fog: is not a known key"),
    "not TOML": ("this is none", r"is not TOML"),
    "deep": ("a = " + "[" * 5000, r"is not TOML"),
    "twice": (SCENE + CAMERA, r"is not TOML"),
    "empty": ("", r"is empty"),
    "aov outside": ('[aov]\nfile = "../../etc/passwd"\n' + LIGHT, r"aov\.file: must stay within the scene's folder"),
    "aov absolute": ('[aov]\nfile = "/etc/passwd"\n' + LIGHT, r"aov\.file: must stay within the scene's folder"),
    "aov missing": ('[aov]\nfile = "none.exr"\n' + LIGHT, r"none\.exr: there is no such file"),
    "aov is a number": ("[aov]\nfile = 3\n" + LIGHT, r"aov\.file: must be a path"),
}


MATERIALS = {
    "nan": ('{"model": "lambert", "k_d": [NaN]}', r"k_d: must be finite, got nan"),
    "inf": ('{"model": "lambert", "k_d": [1e999]}', r"k_d: must be finite, got inf"),
    "negative": ('{"model": "lambert", "k_d": [0.5, -0.2]}', r"k_d: must be at least 0, got -0\.2 in channel 1"),
    "negative n": (json.dumps(MATERIAL | {"n": -1}), r"n: must be at least 0"),
    "n is a list": (json.dumps(MATERIAL | {"n": [1, 2]}), r"n: must be one number"),
    "text": (json.dumps(MATERIAL | {"k_s": "white"}), r"k_s: must be a number"),
    "nested": (json.dumps(MATERIAL | {"k_s": [[0.1]]}), r"k_s: must be a number"),
    "true": (json.dumps(MATERIAL | {"k_s": [True]}), r"k_s: must be a number, got true"),
    "empty list": (json.dumps(MATERIAL | {"k_s": []}), r"k_s: must be one number or one number per channel"),
    "channels": (json.dumps(MATERIAL | {"k_s": [1, 1], "k_d": [1, 1, 1]}), r"k_.: the coefficients differ"),
    "no model": ('{"k_d": [0.5]}', r"model: is unknown, got None"),
    "unknown model": ('{"model": "ward", "k_d": [0.5]}', r"model: is unknown, got 'ward'"),
    "model is a list": ('{"model": [], "k_d": [0.5]}', r"model: is unknown"),
    "missing": ('{"model": "phong", "k_d": [0.5]}', r"k_s: is missing"),
    "null n": (json.dumps(MATERIAL | {"n": None}), r"n: is null"),
    "a list": ("[1, 2]", r"must be a JSON object"),
    "not JSON": ("{", r"is not JSON"),
    "found by fuzzing": (json.dumps(MATERIAL | {"k_s": [10**400]}), r"k_s: must be numbers"),
    "deep": ("[" * 100_000, r"is not JSON"),
    "huge number": ('{"model": "lambert", "k_d": [' + "9" * 5000 + "]}", r"not JSON|must be"),
}


MTL = {
    "nothing": ("# nothing\n", r"holds no material"),
    "before newmtl": ("Kd 1 1 1\n", r"line 1: has Kd before any newmtl"),
    "text": ("newmtl a\nKd red\n", r"line 2: Kd must be numbers"),
    "nan": ("newmtl a\nKd nan 1 1\n", r"line 2: Kd must be finite"),
    "two values": ("newmtl a\nKd 1 1\n", r"line 2: Kd has 2 values"),
    "negative": ("newmtl a\nKd 1 -1 1\n", r"k_d: must be at least 0"),
    "negative Ns": ("newmtl a\nKd 1 1 1\nKs 1 1 1\nNs -5\n", r"Ns: must be at least 0"),
    "spectral": ("newmtl a\nKd spectral file.rfl\n", r"line 2: Kd must be numbers"),
    "unknown model": ("# brdf model: ward\nnewmtl a\nKd 1 1 1\n", r"model: is unknown"),
    "several": ("newmtl a\nKd 1 1 1\nnewmtl b\nKd 1 1 1\n", r"holds 2 materials"),
}


@pytest.fixture
def place(tmp_path):
    return sound_files(tmp_path)


@pytest.mark.parametrize("name", SCENES)
def test_scenes(place, capsys, name):
    text, said = SCENES[name]
    (place / "scene.toml").write_text(text)
    words = ["render", place / "material.json", "--scene", place / "scene.toml", "-o", place / "out.exr"]
    refused(capsys, place, f"({re.escape(str(place))}.*)({said})", *words)


@pytest.mark.parametrize("name", MATERIALS)
def test_materials(place, capsys, name):
    text, said = MATERIALS[name]
    (place / "material.json").write_text(text)
    words = ["render", place / "material.json", "--scene", place / "scene.toml", "-o", place / "out.exr"]
    refused(capsys, place, rf"material\.json.*({said})", *words)


@pytest.mark.parametrize("name", MTL)
def test_wavefront_materials(place, capsys, name):
    text, said = MTL[name]
    (place / "material.mtl").write_text(text)
    words = ["render", place / "material.mtl", "--scene", place / "scene.toml", "-o", place / "out.exr"]
    refused(capsys, place, rf"material\.mtl.*({said})", *words)


OPTIONS = {
    "no such material": (
        ["render", "none.json", "--scene", "scene.toml", "-o", "o.exr"],
        "none.json: there is no such",
    ),
    "folder as material": (["render", ".json", "--scene", "scene.toml", "-o", "o.exr"], "is no material|is a folder"),
    "folder as scene": (["render", "material.json", "--scene", ".", "-o", "o.exr"], "is a folder, not a file"),
    "device as scene": (["render", "material.json", "--scene", "/dev/zero", "-o", "o.exr"], "not an ordinary file"),
    "device as picture": (["fit", "/dev/zero", "--scene", "scene.toml"], "not an ordinary file"),
    "pipe as picture": (["fit", "pipe.exr", "--scene", "scene.toml"], "pipe.exr: is not an ordinary file"),
    "text as picture": (["fit", "scene.toml", "--scene", "scene.toml"], "cannot be read as an image"),
    "no picture": (["fit", "none.exr", "--scene", "scene.toml"], "none.exr: there is no such file"),
    "no scene": (["fit", "target.exr"], "target.exr: comes without a scene"),
    "empty folder": (["fit", "empty"], "empty: has no file target"),
    "unknown model": (["fit", "target.exr", "--scene", "scene.toml", "--model", "ward"], "--model: is unknown"),
    "unknown precision": (["fit", "target.exr", "--scene", "scene.toml", "--precision", "half"], "--precision"),
    "unknown encoding": (
        ["fit", "target.exr", "--scene", "scene.toml", "--encoding", "log"],
        "--encoding: encoding must be",
    ),
    "page of another kind": (
        ["fit", "target.exr", "--scene", "scene.toml", "--report", "o.pdf"],
        "o.pdf: is no name of",
    ),
    "nan saturation": (["fit", "target.exr", "--scene", "scene.toml", "--saturation", "nan"], "--saturation"),
    "text saturation": (["fit", "target.exr", "--scene", "scene.toml", "--saturation", "much"], "saturation"),
    "plot without out": (["fit", "target.exr", "--scene", "scene.toml", "--plot"], "--plot: needs a folder"),
    "unknown option": (["fit", "target.exr", "--scene", "scene.toml", "--speed", "1"], "--speed"),
    "unknown command": (["melt", "target.exr"], "melt"),
    "missing argument": (["render"], "[Mm](aterial|ATERIAL)"),
    "unknown suffix": (["render", "material.json", "--scene", "scene.toml", "-o", "o.xyz"], "o.xyz"),
    "out in a missing folder": (["render", "material.json", "--scene", "scene.toml", "-o", "no/o.exr"], "no/o.exr"),
    "out is a folder": (
        ["render", "material.json", "--scene", "scene.toml", "-o", "empty.exr"],
        "empty.exr: is a folder",
    ),
    "check a picture": (["check", "target.exr"], "target.exr: is no material file"),
    "check a missing table": (["check", "none.binary"], "none.binary: there is no such file"),
    "fit a damaged table": (["fit", "short.binary"], "short.binary: has 20 bytes instead of"),
    "fit a table with a scene": (["fit", "short.binary", "--scene", "scene.toml"], "is a measured BRDF"),
    "fit a table with an unknown loss": (["fit", "ok.brdf", "--loss", "huber"], "--loss: is unknown"),
    "mask of another size": (["fit", "target.exr", "--scene", "scene.toml", "--mask", "small.exr"], "small.exr"),
    "picture of another size": (
        ["fit", "small.exr", "--scene", "scene.toml"],
        "small.exr: is 2 x 2, the scene's camera 8",
    ),
    "no such preset": (
        ["convert", "unobtainium", "o.json"],
        "unobtainium: is no material file and no name.* emerald, jade",
    ),
    "name of a preset": (["convert", "emerald", "o.json", "--name", "a"], "--name: chooses from a file"),
    "plausible table": (["fit", "ok.brdf", "--plausible"], "ok.brdf: is a measured BRDF; of the options only"),
    "precision of a table": (["fit", "ok.brdf", "--precision", "float64"], "is a measured BRDF; of the options only"),
    "channels": (["fit", "two.exr", "--scene", "scene.toml"], "two.exr: has 2 channels, the scene's light 3"),
}


@pytest.mark.parametrize("name", OPTIONS)
def test_options_and_paths(place, capsys, monkeypatch, name):
    monkeypatch.chdir(place)
    (place / "empty").mkdir()
    (place / "empty.exr").mkdir()
    (place / ".json").mkdir()
    os.mkfifo(place / "pipe.exr")
    (place / "short.binary").write_bytes(b"\x5a\0\0\0\x5a\0\0\0\xb4\0\0\0" + bytes(8))
    (place / "ok.brdf").write_text("1\n400\n0.1 0 0.2 0 0.3\n0.2 0 0.2 1 0.3\n")
    brdf.write_image(place / "small.exr", np.ones((2, 2, 3), np.float32))
    brdf.write_image(place / "two.exr", np.ones((8, 8, 2), np.float32))
    words, said = OPTIONS[name]
    refused(capsys, place, said, *words)


@pytest.mark.skipif(os.geteuid() == 0, reason="the superuser may read and write everywhere")
def test_paths_without_permission(place, capsys):
    (place / "material.json").chmod(0)
    words = ["render", place / "material.json", "--scene", place / "scene.toml", "-o", place / "out.exr"]
    refused(capsys, place, "permission denied", *words)


def test_enough_kinds_of_input_are_tried():
    assert len(SCENES) + len(MATERIALS) + len(MTL) + len(OPTIONS) >= 110


@pytest.mark.parametrize("name", ["damaged.png", "small.exr"])
def test_what_cannot_be_fitted_is_told_before_jax_is_imported(place, name):
    """The import takes longer than all the rest, and this may be one of a thousand files."""
    (place / "damaged.png").write_bytes(b"\x89PNG\r\n\x1a\n" + bytes(50))
    brdf.write_image(place / "small.exr", np.ones((2, 2, 3), np.float32))
    prefix = "import atexit, sys\natexit.register(lambda: print('jax' in sys.modules))\n"
    for words in (["--scene", "scene.toml"], ["--sphere", "90,9,5", "--light", "0,0,1"]):
        with command("fit", name, *words, cwd=place, prefix=prefix) as process:
            out, err = process.communicate(timeout=60)
        assert (process.returncode, out) == (2, "False\n"), err
        assert err.startswith("error: ")


def test_a_scene_may_be_allowed_to_reach_further(tmp_path):
    (tmp_path / "deep").mkdir()
    normal = np.ones((8, 8, 3), np.float32)
    brdf.write_image(tmp_path / "aovs.exr", normal)
    (tmp_path / "deep" / "scene.toml").write_text('[aov]\nfile = "../aovs.exr"\n' + LIGHT)
    with pytest.raises(InputError, match="or allow more with within"):
        brdf.Scene.load(tmp_path / "deep" / "scene.toml")
    with pytest.raises(InputError, match="has no layer of normals"):  # it was opened
        brdf.Scene.load(tmp_path / "deep" / "scene.toml", within=tmp_path)
    (tmp_path / "deep" / "scene.toml").write_text('[aov]\nfile = "a\\u0000b.exr"\n' + LIGHT)
    with pytest.raises(InputError, match=r"aov\.file: is no path"):
        brdf.Scene.load(tmp_path / "deep" / "scene.toml")


def test_the_library_says_the_same_words(place):
    (place / "scene.toml").write_text(scene("radius = 1.0", "radius = -1.0"))
    with pytest.raises(InputError, match=r"shapes\[0\]\.radius: must be greater than 0, got -1"):
        brdf.Scene.load(place / "scene.toml")
    assert issubclass(InputError, ValueError)
