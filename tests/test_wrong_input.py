"""Malformed input of every kind, through the command: one line that names file and key, exit 2, and no output."""

import gc
import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

import brdf
from benchmarks.fuzz_corpus import CAMERA, LIGHT, POINT, RECTANGLE, SPHERE
from brdf.errors import InputError
from fitting.cli.interrupts import held, interruptible
from fitting.cli.main import main

ROOT = Path(__file__).parents[1]
REAL = Path(os.environ.get("BRDF_REAL_DATA", ROOT / ".." / "shared" / "data"))

SCENE = CAMERA + SPHERE + LIGHT
MATERIAL = {"model": "blinn-phong", "k_a": [0.1], "k_d": [0.5], "k_s": [0.3], "n": 37.5}


def scene(old: str, new: str, base: str = SCENE) -> str:
    assert old in base
    return base.replace(old, new)


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


def run(capsys, *words: object) -> tuple[int, str, str]:
    with pytest.raises(SystemExit) as done:
        main([str(word) for word in words])
    captured = capsys.readouterr()
    return int(done.value.code or 0), captured.out, captured.err


def refused(capsys, folder: Path, said: str, *words: object) -> None:
    """One line with these words, exit 2, and the folder as it was."""
    before = sorted(folder.rglob("*"))
    status, out, err = run(capsys, *words)
    assert (status, out) == (2, ""), err
    assert err.startswith("error: ")
    assert err.count("\n") == 1
    assert re.search(said, err), err
    assert sorted(folder.rglob("*")) == before


@pytest.fixture
def place(tmp_path):
    """Sound files, to be spoiled one at a time."""
    (tmp_path / "scene.toml").write_text(SCENE)
    (tmp_path / "material.json").write_text(json.dumps(MATERIAL))
    brdf.write_image(tmp_path / "target.exr", np.linspace(0.1, 0.9, 192, dtype=np.float32).reshape(8, 8, 3))
    return tmp_path


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


# -- a process of its own ----------------------------------------------------------------------------------------------


def command(*words: object, cwd: Path, prefix: str = "", **options) -> subprocess.Popen[str]:
    # A shell that runs the tests in the background has them ignore Ctrl-C, and what they start.
    listen = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)\n"
    code = listen + prefix + "from fitting.cli.main import main; main()"
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "XDG_CACHE_HOME": str(cwd / ".cache")}
    return subprocess.Popen(
        [sys.executable, "-c", code, *map(str, words)],
        cwd=cwd,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        **options,
    )


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


def test_a_full_disk_leaves_nothing(place):
    # A limit on the size of files is the full disk that needs no rights: writes fail half way.
    prefix = (
        "import resource, signal; signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (2000, 2000))\n"
        "import jax; jax.config.update('jax_compilation_cache_dir', '/nonexistent')\n"
    )
    (place / "scene.toml").write_text(scene("[8, 8]", "[64, 64]"))
    before = {path for path in place.iterdir() if path.name != ".cache"}
    words = ["render", "material.json", "--scene", "scene.toml", "-o", "out.exr"]
    with command(*words, cwd=place, prefix="import warnings; warnings.simplefilter('ignore')\n" + prefix) as process:
        _, err = process.communicate(timeout=120)
    assert process.returncode == 2, err
    assert err.splitlines()[-1].startswith("error: out.exr: ")
    assert {path for path in place.iterdir() if path.name != ".cache"} == before


@pytest.fixture
def small_disk(tmp_path):
    """A disk of 48 KiB, in memory."""
    (tmp_path / "disk").mkdir()
    words = ["mount", "-t", "tmpfs", "-o", "size=48k", "tmpfs", str(tmp_path / "disk")]
    try:
        done = subprocess.run(words, capture_output=True, text=True, check=False)
    except OSError as error:
        pytest.skip(f"no mount command: {error}")
    if done.returncode:
        pytest.skip(f"a small disk cannot be mounted here: {done.stderr.strip()}")
    yield tmp_path / "disk"
    subprocess.run(["umount", str(tmp_path / "disk")], check=True)


FILLING = {
    "render": ["render", "material.json", "--scene", "scene.toml", "-o", "disk/out.exr"],
    "fit": ["fit", "target.exr", "--scene", "scene.toml", "--out", "disk/out"],
    "report": ["fit", "target.exr", "--scene", "scene.toml", "--report", "disk/out.html"],
    "convert": ["convert", "material.json", "disk/material.gltf"],
}


@pytest.mark.parametrize("name", FILLING)
def test_a_disk_that_fills_up_leaves_nothing(place, capsys, monkeypatch, small_disk, name):
    monkeypatch.chdir(place)
    (place / "scene.toml").write_text(scene("[8, 8]", "[64, 64]"))
    ball = brdf.render(brdf.Lambert(k_d=[0.5] * 3), brdf.Scene.load(place / "scene.toml"))
    noise = np.random.default_rng(3).random((64, 64, 3), np.float32)
    brdf.write_image(place / "target.exr", np.asarray(ball) + noise)
    (small_disk / "other").write_bytes(bytes(1024 * {"convert": 48, "render": 44}.get(name, 32)))
    refused(capsys, small_disk, "disk/(out|mat).*: there is no space left to write it", *FILLING[name])


def test_control_c_in_the_middle_leaves_nothing(place):
    before = {path for path in place.iterdir() if path.name != ".cache"}
    # The fit waits for a signal at the moment when the files of the result are being written.
    prefix = (
        "import time, brdf.images.pictures\n"
        "def slowly(*a, **k):\n    print('writing', flush=True)\n    time.sleep(60)\n"
        "brdf.images.pictures.write_image = slowly\n"
    )
    with command("fit", "target.exr", "--scene", "scene.toml", "--out", "out", cwd=place, prefix=prefix) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "writing\n"
        process.send_signal(signal.SIGINT)
        _, err = process.communicate(timeout=60)
    assert process.returncode == 130
    assert err == "error: interrupted.\n"
    assert {path for path in place.iterdir() if path.name != ".cache"} == before


@pytest.fixture
def listening():
    """Ctrl-C as a program in the foreground has it."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def test_control_c_is_not_lost_in_a_callback_of_the_garbage_collector(listening):
    """What such a callback raises is printed and forgotten; JAX has one."""

    def callback(phase, _):
        if phase == "start":
            os.kill(os.getpid(), signal.SIGINT)
            sum(range(1000))  # the signal is handled here

    gc.callbacks.append(callback)
    try:
        with pytest.raises(KeyboardInterrupt), interruptible():  # noqa: PT012  # the signal comes later
            gc.collect()
            gc.callbacks.remove(callback)
            time.sleep(5)
    finally:
        if callback in gc.callbacks:
            gc.callbacks.remove(callback)


def test_control_c_waits_while_a_library_loads(listening):
    seen = []
    with pytest.raises(KeyboardInterrupt), interruptible(), held():  # noqa: PT012  # the signal comes later
        os.kill(os.getpid(), signal.SIGINT)
        seen.append("loaded")
    assert seen == ["loaded"]
    with interruptible(), held():
        pass  # it is not remembered
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


BAD_IMAGES = REAL / "bad-images"
READ = """
import sys
import brdf
for path in sys.argv[1:]:
    try:
        print("image", brdf.read_picture(path).pixels.shape, flush=True)
    except brdf.InputError as error:
        print("error:", error, flush=True)
# The peak since the program started; getrusage would count the parent's memory at the fork.
print(int(open("/proc/self/status").read().split("VmHWM:")[1].split()[0]) // 1024)
"""


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="needs /proc to measure the peak of memory")
@pytest.mark.skipif(not BAD_IMAGES.is_dir(), reason=f"real data is missing: {BAD_IMAGES} (BRDF_REAL_DATA)")
def test_every_bad_image_is_a_picture_or_one_line():
    files = sorted(path for path in BAD_IMAGES.iterdir() if path.suffix in (".exr", ".png", ".jpg"))
    assert len(files) == 104
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    words = [sys.executable, "-c", READ, *map(str, files)]
    done = subprocess.run(words, capture_output=True, env=environment, timeout=600, check=False)
    assert done.returncode == 0, done.stderr[-500:]
    assert done.stderr == b""
    *lines, megabytes = done.stdout.decode().splitlines()
    assert len(lines) == len(files)
    assert all(line.startswith(("image (", "error: ")) for line in lines)
    assert int(megabytes) < 500
