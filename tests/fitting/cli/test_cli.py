"""The command as a person runs it: what it prints, its exit status, the files it leaves."""

import importlib.metadata
import json
import socket
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest
from command_runs import command, refused, run
from project_paths import ROOT
from sound_files import sound_files

import brdf
from benchmarks.fuzz_corpus import LIGHT
from fitting.cli.common import OF_A_FIT
from fitting.photographs.archives import read_archive

SCENE = (ROOT / "data" / "gold-ball" / "scene.toml").read_text().replace("[256, 256]", "[48, 48]")


@pytest.fixture
def folder(tmp_path: Path, monkeypatch) -> Path:
    """A small picture of a known material with its scene."""
    monkeypatch.chdir(tmp_path)
    place = tmp_path / "example"
    place.mkdir()
    (place / "scene.toml").write_text(SCENE)
    material = brdf.BlinnPhong(k_a=[0.1, 0.2, 0.3], k_d=[0.5, 0.4, 0.3], k_s=[0.4, 0.4, 0.4], n=30)
    brdf.write_image(place / "target.exr", brdf.render(material, brdf.Scene.load(place / "scene.toml")))
    return place


def test_help_names_the_commands_and_imports_no_jax():
    code = "import sys; from fitting.cli.main import main\ntry: main(['--help'])\nexcept SystemExit: pass\n"
    code += "assert not {'jax', 'numpy', 'matplotlib'} & set(sys.modules), 'help imports too much'"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert all(word in done.stdout for word in ("fit", "lights", "render", "check", "convert", "tradeoff"))


@pytest.mark.parametrize("name", ["damaged.png", "small.exr"])
def test_what_cannot_be_fitted_is_told_before_jax_is_imported(tmp_path, name):
    """The import takes longer than all the rest, and this may be one of a thousand files."""
    place = sound_files(tmp_path)
    (place / "damaged.png").write_bytes(b"\x89PNG\r\n\x1a\n" + bytes(50))
    brdf.write_image(place / "small.exr", np.ones((2, 2, 3), np.float32))
    told = "(print('jax' in sys.modules, flush=True), end(status))"
    prefix = f"import os, sys\nend = os._exit\nos._exit = lambda status: {told}\n"
    words = ["--scene", "scene.toml"] if name == "small.exr" else ["--sphere", "90,9,5", "--light", "0,0,1"]
    with command("fit", name, *words, cwd=place, prefix=prefix) as process:
        out, err = process.communicate(timeout=60)
    assert (process.returncode, out) == (2, "False\n"), err
    assert err.startswith("error: ")


@pytest.mark.parametrize("words", ["fit example --out", "fit", "convert gold", "check gold --plot"])
def test_what_an_empty_variable_leaves_is_no_path(folder: Path, capsys, words: str):
    """It was the current folder, and what lay there was replaced."""
    refused(capsys, folder.parent, "it is empty", *words.split(), "")


@pytest.mark.parametrize("name", ["fit", "lights", "render", "check", "convert", "tradeoff"])
def test_each_help_text_shows_an_example(capsys, name):
    assert "Example: brdf" in run(capsys, name, "--help")[1]


def test_a_scene_file_is_parsed_once(folder, capsys, monkeypatch):
    parsed, loads = [], tomllib.loads
    monkeypatch.setattr(tomllib, "loads", lambda text: parsed.append(text) or loads(text))
    assert run(capsys, "fit", folder, "--model", "lambert")[0] == 0
    assert parsed == [SCENE]


def test_fit_render_fit_comes_round(folder, capsys):
    words = ["fit", folder, "--out", "a", "--plot", "--model", "blinn-phong", "--precision", "float64"]
    status, out, err = run(capsys, *words)
    assert status == 0, err
    assert "blinn-phong fitted to" in out
    assert out.endswith("saved in a\n")
    saved = folder.parent / "a"
    names = sorted(path.name for path in saved.iterdir())
    assert set(names) >= {"comparison.png", "fit.json", "fitted.exr", "material.json", "material.mtl"}
    assert all(map(OF_A_FIT.fullmatch, names)), names
    values = json.loads((saved / "material.json").read_text())
    assert values["model"] == "blinn-phong"
    # The target is stored in float32.
    np.testing.assert_allclose(values["n"], 30, rtol=1e-4)
    np.testing.assert_allclose(values["k_s"], 0.4, rtol=1e-4)
    status, _, err = run(capsys, "render", "a/material.json", "--scene", folder / "scene.toml", "-o", "again.exr")
    assert status == 0, err
    np.testing.assert_allclose(brdf.read_image("again.exr"), brdf.read_image(folder / "target.exr"), atol=2e-6)


def test_what_is_read_is_not_replaced(folder, capsys):
    """The scene was written anew without its comments, a picture named fitted.exr became the fitted one."""
    before = (folder / "scene.toml").read_bytes()
    for words in ([folder], [folder / "target.exr", "--scene", folder / "scene.toml"]):
        status, _, err = run(capsys, "fit", *words, "--model", "lambert", "--out", folder)
        assert status == 2
        said = f"would replace {folder / 'scene.toml'}, which is read here. Choose another folder.\n"
        assert err == f"error: --out: {said}"
    assert (folder / "scene.toml").read_bytes() == before


def test_a_photograph_a_material_or_a_sky_is_not_replaced(tmp_path, capsys):
    brdf.write_image(tmp_path / "ball.png", np.ones((8, 8, 1)), dtype="uint8")
    brdf.save_material(brdf.preset("gold"), tmp_path / "material.json")
    camera = brdf.OrthographicCamera(position=[0, 0, 4], target=[0, 0, 0], up=[0, 1, 0], resolution=[8, 8], width=2.2)
    sky = brdf.EnvironmentMap(np.ones((8, 16, 3)))
    brdf.Scene(camera, [brdf.Sphere([0, 0, 0], 1)], lights=[sky]).save(tmp_path / "scene.toml")
    (drawn,) = tmp_path.glob("*.exr")
    for words in (
        ["lights", tmp_path / "ball.png", "--sphere", "4,4,3", "--out", tmp_path / "ball.png"],
        ["convert", tmp_path, tmp_path / "material.json"],
        ["render", tmp_path, "-o", drawn],
    ):
        before = {path: path.read_bytes() for path in tmp_path.iterdir()}
        status, _, err = run(capsys, *words)
        assert status == 2
        assert err == f"error: --out: would replace {words[-1]}, which is read here. Choose another file.\n"
        assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_two_processes_that_are_told_of_each_other_fit_together(folder, monkeypatch):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        monkeypatch.setenv("JAX_COORDINATOR_ADDRESS", f"127.0.0.1:{free.getsockname()[1]}")
    monkeypatch.setenv("JAX_NUM_PROCESSES", "2")
    words = ["fit", folder, "--model", "lambert", "--devices", "all"]
    pair = []
    for rank in ("0", "1"):
        monkeypatch.setenv("JAX_PROCESS_ID", rank)
        pair.append(command(*words, cwd=folder.parent))
    ended = [(*one.communicate(timeout=300), one.returncode) for one in pair]
    assert [status for *_, status in ended] == [0, 0], ended
    assert [out.count("lambert fitted to") for out, *_ in ended] == [1, 0]  # the first one tells


def test_json_goes_to_standard_output(folder, capsys):
    values = json.loads(run(capsys, "fit", folder, "--model", "lambert", "--json")[1])
    assert values["material"]["model"] == "lambert"
    assert values["pixels"] > 0


def test_check_exit_statuses(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    brdf.save_material(brdf.Lambert(k_d=[0.5, 0.5, 0.5]), "good.json")
    brdf.save_material(brdf.BlinnPhong(k_d=0.5, k_s=0.5, n=20), "classic.mtl")
    assert run(capsys, "check", "good.json")[0] == 0
    status, out, _ = run(capsys, "check", "classic.mtl")
    assert status == 1
    assert "not reciprocal" in out
    status, out, _ = run(capsys, "check", "classic.mtl", "--json")
    assert status == 1
    assert json.loads(out)


def test_no_command_shows_the_help_and_nothing_else(capsys):
    status, out, err = run(capsys)
    assert status == 2
    assert "Usage" in out + err
    assert "error:" not in err


def test_the_version_is_that_of_the_package(capsys):
    said = f"brdf-fitting {importlib.metadata.version('brdf-fitting')}\n"
    assert run(capsys, "--version") == (0, said, "")


def test_a_scene_may_be_allowed_to_reach_further(tmp_path, capsys):
    (tmp_path / "deep").mkdir()
    file = tmp_path / "deep" / "scene.toml"
    brdf.write_image(tmp_path / "aovs.exr", np.ones((8, 8, 3), np.float32))
    brdf.write_image(tmp_path / "target.exr", np.ones((8, 8, 3), np.float32))
    file.write_text('[aov]\nfile = "../aovs.exr"\n' + LIGHT)
    words = "fit", tmp_path / "target.exr", "--scene", file
    refused(capsys, tmp_path, "or allow more with within", *words)
    refused(capsys, tmp_path, "has no layer of normals", *words, "--within", tmp_path)  # it was opened
    refused(capsys, tmp_path, "nosuch: is no folder", *words, "--within", tmp_path / "nosuch")


def test_nothing_else_of_an_archive_is_read(tmp_path):
    arrays = {"images": np.ones((1, 2, 2)), "normal": np.ones((2, 2, 3)), "light_dirs": np.ones((1, 3))}
    np.savez(tmp_path / "a.npz", **arrays, evil=np.array([print], dtype=object))
    assert set(read_archive(tmp_path / "a.npz")) == set(arrays)


def test_a_number_of_processes_that_is_none_is_told(folder, monkeypatch, capsys):
    monkeypatch.setenv("JAX_NUM_PROCESSES", "two")
    refused(capsys, folder, "JAX_NUM_PROCESSES: must be a whole number, got 'two'", "fit", folder, "--devices", "all")
