"""The command as a person runs it: a process of its own, its output, its exit status, the files it leaves."""

import importlib.metadata
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from project_paths import ROOT

import brdf
from fitting.cli.main import main

EXAMPLE = ROOT / "data" / "gold-ball"
SCENE = (EXAMPLE / "scene.toml").read_text().replace("[256, 256]", "[48, 48]")


@pytest.fixture(scope="session")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("cache")


@pytest.fixture
def run(cache: Path, tmp_path: Path):
    def command(*words: object, status: int = 0) -> subprocess.CompletedProcess[str]:
        done = subprocess.run(
            [sys.executable, "-c", "from fitting.cli.main import main; main()", *map(str, words)],
            capture_output=True,
            text=True,
            cwd=tmp_path,
            env={**os.environ, "PYTHONPATH": str(ROOT), "XDG_CACHE_HOME": str(cache)},
            check=False,
        )
        assert done.returncode == status, done.stderr
        return done

    return command


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A small picture of a known material with its scene."""
    place = tmp_path / "example"
    place.mkdir()
    (place / "scene.toml").write_text(SCENE)
    material = brdf.BlinnPhong(k_a=[0.1, 0.2, 0.3], k_d=[0.5, 0.4, 0.3], k_s=[0.4, 0.4, 0.4], n=30)
    picture = np.asarray(brdf.render(material, brdf.Scene.load(place / "scene.toml"), precision="float64"))
    brdf.write_image(place / "target.exr", picture)
    return place


def test_help_names_the_commands_and_imports_no_jax(run):
    assert all(word in run("--help").stdout for word in ("fit", "render", "check"))
    code = "import sys; from fitting.cli.main import main\ntry: main(['--help'])\nexcept SystemExit: pass\n"
    code += "assert not {'jax', 'numpy', 'matplotlib'} & set(sys.modules), 'help imports too much'"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("command", ["fit", "render", "check"])
def test_each_help_text_shows_an_example(run, command: str):
    assert "Example: brdf" in run(command, "--help").stdout


def test_fit_a_folder_and_save(run, folder: Path):
    printed = run("fit", folder, "--out", "result", "--plot", "--precision", "float64").stdout
    assert "blinn-phong fitted to" in printed
    saved = folder.parent / "result"
    names = sorted(path.name for path in saved.iterdir())
    assert names == ["comparison.png", "fit.json", "fitted.exr", "material.json", "material.mtl"]
    values = json.loads((saved / "material.json").read_text())
    assert values["model"] == "blinn-phong"
    # The target is stored in float32.
    np.testing.assert_allclose(values["n"], 30, rtol=1e-4)
    np.testing.assert_allclose(values["k_s"], 0.4, rtol=1e-4)


def test_json_goes_to_standard_output(run, folder: Path):
    values = json.loads(run("fit", folder, "--model", "lambert", "--json").stdout)
    assert values["material"]["model"] == "lambert"
    assert values["pixels"] > 0


def test_fit_render_fit_comes_round(run, folder: Path):
    run("fit", folder, "--model", "blinn-phong", "--out", "a", "--precision", "float64")
    run("render", "a/material.json", "--scene", folder / "scene.toml", "-o", "again.exr")
    target = brdf.read_image(folder / "target.exr")
    again = brdf.read_image(folder.parent / "again.exr")
    np.testing.assert_allclose(again, target, atol=2e-6)


def spoil(folder: Path, how: str) -> list[object]:
    """Make one thing wrong and return the words of the command."""
    target, scene = folder / "target.exr", folder / "scene.toml"
    pixels = brdf.read_image(target)
    if how == "wrong path":
        return ["fit", folder / "none.exr", "--scene", scene]
    if how == "no scene named":
        return ["fit", target]
    if how == "no target":
        target.unlink()
    if how == "two targets":
        brdf.write_image(folder / "target.png", np.clip(pixels, 0, 1))
    if how == "unknown key":
        scene.write_text(SCENE + "colour = 1\n")
    if how == "other size":
        brdf.write_image(target, pixels[:40])
    if how == "off the object":
        scene.write_text(SCENE.replace("center = [0.0, 0.0, 0.0]", "center = [9.0, 0.0, 0.0]"))
    if how == "black":
        brdf.write_image(target, np.zeros_like(pixels))
    if how == "nan":
        brdf.write_image(target, np.full_like(pixels, np.nan))
    if how == "unknown model":
        return ["fit", folder, "--model", "ward"]
    if how == "unknown precision":
        return ["fit", folder, "--precision", "float16"]
    if how == "unknown encoding":
        return ["fit", folder, "--encoding", "film"]
    if how == "unknown option":
        return ["fit", folder, "--fast"]
    if how == "no argument":
        return ["fit"]
    if how == "plot without folder":
        return ["fit", folder, "--plot"]
    if how == "saturated":
        return ["fit", folder, "--saturation", "1e-6"]
    if how == "text as picture":
        target.write_text("no picture")
    if how == "a file as folder":
        (folder / "out").write_text("")
        return ["fit", folder, "--out", folder / "out"]
    if how == "mask of another size":
        brdf.write_image(folder / "mask.png", np.ones((9, 9, 1)))
        return ["fit", folder, "--mask", folder / "mask.png"]
    return ["fit", folder]


@pytest.mark.parametrize(
    ("how", "words"),
    [
        ("wrong path", "none.exr: there is no such file"),
        ("no scene named", "comes without a scene. Add --scene"),
        ("no target", "has no file target.*"),
        ("two targets", "has several targets, target.exr, target.png"),
        ("unknown key", "lights[0].colour: is not a known key"),
        ("other size", "target.exr: is 48 x 40, the scene's camera 48 x 48"),
        ("off the object", "target.exr: has no pixel that sees a fitted shape"),
        ("black", "target.exr: is black on the object"),
        ("nan", "target.exr: has no finite value on the object"),
        ("unknown model", "--model: is unknown, got 'ward'"),
        ("unknown precision", "--precision: is unknown, got 'float16'"),
        ("unknown encoding", "film"),
        ("unknown option", "No such option: --fast"),
        ("no argument", "Missing argument"),
        ("plot without folder", "--plot: needs a folder"),
        ("saturated", "target.exr: is clipped at 1e-06"),
        ("text as picture", "target.exr"),
        ("a file as folder", "a part of the path is not a folder"),
        ("mask of another size", "mask"),
    ],
)
def test_what_is_wrong_is_one_line_and_leaves_no_file(run, folder: Path, how: str, words: str):
    command = spoil(folder, how)
    if "--out" not in command and how != "plot without folder":
        command += ["--out", folder.parent / "made"]
    done = run(*command, status=2)
    assert done.stdout == ""
    assert done.stderr.startswith("error: ")
    assert done.stderr.count("\n") == 1
    assert words in done.stderr
    assert "Traceback" not in done.stderr
    assert not (folder.parent / "made").exists()


def test_check_exit_statuses(run, tmp_path: Path):
    brdf.save_material(brdf.Lambert(k_d=[0.5, 0.5, 0.5]), tmp_path / "good.json")
    brdf.save_material(brdf.BlinnPhong(k_d=0.5, k_s=0.5, n=20), tmp_path / "classic.mtl")
    run("check", "good.json", status=0)
    printed = run("check", "classic.mtl", status=1).stdout
    assert "not reciprocal" in printed
    values = json.loads(run("check", "classic.mtl", "--json", status=1).stdout)
    assert values
    assert run("check", "none.json", status=2).stderr.startswith("error: none.json: there is no such file")


def test_no_command_shows_the_help_and_nothing_else(capsys):
    with pytest.raises(SystemExit) as caught:
        main([])
    assert caught.value.code == 2
    out, err = capsys.readouterr()
    assert "Usage" in out + err
    assert "error:" not in err


def test_the_version_is_that_of_the_package(capsys):
    with pytest.raises(SystemExit) as caught:
        main(["--version"])
    assert caught.value.code == 0
    assert capsys.readouterr().out.strip() == f"brdf-fitting {importlib.metadata.version('brdf-fitting')}"


@pytest.mark.parametrize("command", ["fit", "tradeoff"])
def test_a_missing_picture_is_missing_whatever_else_is(command: str, tmp_path: Path, capsys):
    with pytest.raises(SystemExit) as caught:
        main([command, str(tmp_path / "none.png")])
    assert caught.value.code == 2
    assert "none.png: there is no such file" in capsys.readouterr().err
