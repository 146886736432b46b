"""Balls drawn by VTK: is the drawing what it should be, and does the fit read it back?"""

import ctypes.util
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from drawing import numpy_shading

import brdf
import fitting

if ctypes.util.find_library("OSMesa") is None:
    pytest.skip("libOSMesa is missing: apt-get install libosmesa6", allow_module_level=True)
vtk_ball = pytest.importorskip("drawing.vtk_ball", reason="vtk is missing", exc_type=ImportError)

PERSPECTIVE = """
[camera]
type = "perspective"
position = [0.6, 0.4, 4.0]
target = [0.0, 0.0, 0.0]
up = [0.0, 1.0, 0.0]
fov = 34.0
resolution = [192, 192]
"""
PARALLEL = """
[camera]
type = "orthographic"
viewer = "local"
position = [0.6, 0.4, 4.0]
target = [0.0, 0.0, 0.0]
up = [0.0, 1.0, 0.0]
width = 2.2
resolution = [192, 192]
"""
BALL = """
[ambient]
intensity = [0.3, 0.2, 0.25]
[[shapes]]
type = "sphere"
center = [0.0, 0.0, 0.0]
radius = 1.0
"""
DIRECTIONAL = """
[[lights]]
type = "directional"
direction = [-0.5, 0.6, 0.8]
intensity = [0.8, 0.75, 0.7]
"""
POINT = """
[[lights]]
type = "point"
position = [1.5, 2.0, 2.5]
intensity = [1.5, 1.4, 1.6]
attenuation = [0.5, 0.2, 0.15]
"""
SCENES = {
    "directional": PERSPECTIVE + BALL + DIRECTIONAL,
    "parallel projection": PARALLEL + BALL + DIRECTIONAL,
    "point and directional": PERSPECTIVE + BALL + POINT + DIRECTIONAL.replace("[0.8, 0.75, 0.7]", "[0.2, 0.2, 0.3]"),
}
KEYS = ("k_a", "k_d", "k_s")


def _satin(n: float) -> dict[str, Any]:
    return {"model": "phong", "k_a": [0.2, 0.1, 0.3], "k_d": [0.55, 0.12, 0.3], "k_s": [0.3, 0.35, 0.25], "n": n}


@pytest.mark.parametrize("scene", SCENES.values(), ids=SCENES.keys())
def test_drawing_is_the_shading_equation(scene: str) -> None:
    parsed, material = tomllib.loads(scene), _satin(24.0)
    drawn = vtk_ball.draw_ball(parsed, material)
    sight = numpy_shading.trace(parsed["camera"], parsed["shapes"])
    error = np.abs(drawn - numpy_shading.shade(parsed, material))
    assert error[sight.inside(1)].max() < 5e-5  # float32 shading of a mesh of 1024 x 512 faces
    assert np.count_nonzero(drawn.any(-1) != sight.hit) <= 8  # pixels whose centres lie on the edge


def test_screenshot_is_the_picture_in_steps_of_eight_bits() -> None:
    parsed, material = tomllib.loads(SCENES["directional"]), _satin(24.0)
    screenshot = vtk_ball.draw_ball(parsed, material, eight_bit=True)
    drawn = vtk_ball.draw_ball(parsed, material)
    np.testing.assert_allclose(screenshot, drawn, atol=0.51 / 255)


@pytest.mark.parametrize("scene", SCENES.values(), ids=SCENES.keys())
@pytest.mark.parametrize("n", [2.5, 24.0, 128.0])
def test_fit_reads_the_material_back(scene: str, n: float, tmp_path: Path) -> None:
    path = tmp_path / "scene.toml"
    path.write_text(scene, encoding="utf-8")
    truth = _satin(n)
    target = vtk_ball.draw_ball(tomllib.loads(scene), truth)
    found = fitting.fit(target, brdf.Scene.load(path), model="phong").material
    assert float(found.n) == pytest.approx(n, rel=1e-3)
    for key in KEYS:
        np.testing.assert_allclose(np.asarray(getattr(found, key)), truth[key], atol=5e-4, err_msg=key)


def test_fit_of_a_screenshot(tmp_path: Path) -> None:
    path = tmp_path / "scene.toml"
    path.write_text(SCENES["directional"], encoding="utf-8")
    truth = _satin(24.0)
    target = vtk_ball.draw_ball(tomllib.loads(SCENES["directional"]), truth, eight_bit=True)
    result = fitting.fit(target, brdf.Scene.load(path), model="auto")
    assert result.material.name == "phong"
    assert float(result.material.n) == pytest.approx(24.0, rel=5e-3)  # the bounds of the shared VTK picture, 8 bit
    for key in KEYS:
        # k_a I_a is what the picture shows: its rounding is divided by an ambient intensity of 0.2
        tolerance = 1e-2 if key == "k_a" else 2e-3
        np.testing.assert_allclose(np.asarray(getattr(result.material, key)), truth[key], atol=tolerance, err_msg=key)
