"""What the command writes for others: materials in other programs' words, the report page, pictures."""

import json
import re
from pathlib import Path

import command_runs
import numpy as np
import pytest
from project_paths import ROOT

import brdf


def run(capsys: pytest.CaptureFixture[str], *words: object, status: int = 0) -> str:
    """What the command prints."""
    ended, out, err = command_runs.run(capsys, *words)
    assert ended == status, err
    return out


@pytest.fixture
def photograph(tmp_path: Path) -> Path:
    """An 8-bit sRGB picture of a ball off the middle, with ambient light, made without the toolkit's renderer."""
    x, y = np.meshgrid((np.arange(80) - 42) / 30, -(np.arange(64) - 30) / 30)
    height = 1 - x**2 - y**2
    normal = np.stack([x, y, np.sqrt(np.maximum(height, 0))], -1)
    light = np.array([0.3, 0.5, 0.8]) / np.sqrt(0.98)
    half = light + np.array([0, 0, 1])
    half = half / np.linalg.norm(half)
    lit = np.maximum(normal @ light, 0)[..., None]
    lobe = np.where(lit > 0, np.maximum(normal @ half, 0)[..., None] ** 20, 0)
    linear = np.array([0.1, 0.05, 0.02]) + np.array([0.5, 0.2, 0.1]) * lit + 0.3 * lobe
    linear = np.where(height[..., None] > 0, linear, 0.01)
    brdf.write_image(tmp_path / "ball.png", linear.astype(np.float32))
    return tmp_path / "ball.png"


def test_convert_by_suffix_says_what_is_lost(capsys, tmp_path: Path):
    said = run(capsys, "convert", "gold", tmp_path / "gold.gltf")
    assert f"wrote {tmp_path / 'gold.gltf'}" in said
    assert "not carried: k_a is left out" in said
    assert json.loads((tmp_path / "gold.gltf").read_text())["materials"][0]["name"] == "gold"


def test_convert_to_standard_output_writes_no_file(capsys, tmp_path: Path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert json.loads(run(capsys, "convert", "gold", "-"))["model"] == "blinn-phong"
    assert "const vec3" in run(capsys, "convert", "gold", "-", "--to", "glsl")
    _, out, err = command_runs.run(capsys, "convert", "gold", "-", "--to", "gltf")
    assert json.loads(out)["materials"]
    assert "not carried: k_a is left out" in err
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("lines", "note"),
    [
        ("d 0.5\nmap_Kd -s 2 2 2 wood.png", "note: d 0.5 is not read; map_Kd -s 2 2 2 wood.png is not read"),
        ("Tr 0.25\nmap_Bump bump.png", "note: Tr 0.25 is not read; map_Bump bump.png is not read"),
        ("d 1.000\nTr 0.0\nNi 1.45", ""),
    ],
)
def test_convert_says_what_of_an_mtl_file_it_does_not_read(capsys, tmp_path: Path, lines: str, note: str):
    (tmp_path / "a.mtl").write_text(f"newmtl a\n{lines}\nKd 0.5 0.4 0.3\n")
    said = run(capsys, "convert", tmp_path / "a.mtl", tmp_path / "a.json")
    assert "\n".join(said.splitlines()[1:]).strip() == note


def test_convert_reads_what_it_wrote(capsys, tmp_path: Path):
    run(capsys, "convert", "cyan plastic", tmp_path / "a.mtl")
    run(capsys, "convert", tmp_path / "a.mtl", tmp_path / "a.json")
    assert repr(brdf.load_material(tmp_path / "a.json")) == repr(brdf.preset("cyan_plastic"))
    assert "not carried" not in run(capsys, "convert", tmp_path / "a.json", tmp_path / "a.glsl")


def test_photograph_with_ambient_light_gives_its_numbers_and_a_report(capsys, tmp_path: Path, photograph: Path):
    arguments = ["fit", photograph, "--sphere", "42,30,30", "--light", "0.3,0.5,0.8", "--ambient"]
    said = run(capsys, *arguments, "--out", tmp_path / "out", "--report", tmp_path / "report.html")
    assert f"wrote {tmp_path / 'report.html'}" in said
    found = brdf.load_material(tmp_path / "out" / "material.json")
    # 8 bits: half a code is 4e-3 of a middle value, over some 2500 pixels.
    np.testing.assert_allclose(np.asarray(found.k_a), [0.1, 0.05, 0.02], atol=1e-3)
    np.testing.assert_allclose(np.asarray(found.k_d), [0.5, 0.2, 0.1], atol=2e-3)
    np.testing.assert_allclose(float(found.n), 20, rtol=5e-3)
    assert "ball.png" in (tmp_path / "report.html").read_text()


def test_check_draws_its_picture(capsys, tmp_path: Path):
    brdf.save_material(brdf.preset("ruby"), tmp_path / "ruby.json")
    said = run(capsys, "check", tmp_path / "ruby.json", "--plot", tmp_path / "ruby.png", status=1)
    assert "not plausible" in said
    assert brdf.read_image(tmp_path / "ruby.png").shape[0] > 400


def test_every_command_knows_the_classic_table(capsys, tmp_path: Path, monkeypatch):
    scene = ROOT / "data" / "gold-ball" / "scene.toml"
    monkeypatch.chdir(tmp_path)
    said = run(capsys, "check", "Emerald", status=1)
    assert "emerald: not plausible" in said
    assert re.findall(r"channel (\w+)\.", said) == ["red", "red", "green"]  # as a fit's report names them
    run(capsys, "render", "cyan plastic", "--scene", scene, "-o", "a.exr")
    brdf.save_material(brdf.preset("cyan plastic"), tmp_path / "b.json")
    run(capsys, "render", "b.json", "--scene", scene, "-o", "b.exr")
    np.testing.assert_array_equal(brdf.read_image(tmp_path / "a.exr"), brdf.read_image(tmp_path / "b.exr"))
