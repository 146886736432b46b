"""Balls drawn by OpenGL's fixed-function pipeline: is the drawing what it should be, and does the fit read it back?"""

import ctypes.util
import json
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from drawing import numpy_shading
from project_paths import ROOT

import brdf
import fitting

if ctypes.util.find_library("OSMesa") is None:
    pytest.skip("libOSMesa is missing: apt-get install libosmesa6", allow_module_level=True)
opengl_ball = pytest.importorskip("drawing.opengl_ball", reason="PyOpenGL is missing", exc_type=ImportError)

GOLD_BALL = ROOT / "data/gold-ball"
ORTHOGRAPHIC = """
[camera]
type = "orthographic"
position = [0.6, 0.4, 4.0]
target = [0.0, 0.0, 0.0]
up = [0.0, 1.0, 0.0]
width = 2.2
resolution = [192, 192]
"""
PERSPECTIVE = """
[camera]
type = "perspective"
position = [0.6, 0.4, 4.0]
target = [0.0, 0.0, 0.0]
up = [0.0, 1.0, 0.0]
fov = 34.0
resolution = [192, 192]
"""
LOCAL_VIEWER = ORTHOGRAPHIC + 'viewer = "local"\n'
BALL = """
[ambient]
intensity = [0.3, 0.2, 0.25]
[[shapes]]
type = "sphere"
center = [0.0, 0.0, 0.0]
radius = 1.0
"""
SECOND_BALL = """
[[shapes]]
type = "sphere"
center = [0.7, 0.5, 0.9]
radius = 0.3
"""
DIRECTIONAL = """
[[lights]]
type = "directional"
direction = [-0.5, 0.6, 0.8]
intensity = [0.6, 0.55, 0.5]
"""
POINT = """
[[lights]]
type = "point"
position = [1.5, 2.0, 2.5]
intensity = [1.5, 1.4, 1.6]
attenuation = [0.5, 0.2, 0.15]
"""
FAINT = """
[[lights]]
type = "directional"
direction = [0.9, -0.3, 0.3]
intensity = [0.2, 0.3, 0.25]
"""
SCENES = {
    "directional": ORTHOGRAPHIC + BALL + DIRECTIONAL,
    "point": PERSPECTIVE + BALL + POINT,
    "two lights, two balls": PERSPECTIVE + BALL + SECOND_BALL + POINT + FAINT,
}

# Not fitted at small n: OpenGL keeps the highlight where N.V <= 0, as no perspective camera ever sees it.
LOCAL = LOCAL_VIEWER + BALL + DIRECTIONAL

# Rows of the classic material table of OpenGL's teapots.c, and materials near the ends of the range of its exponent.
GOLD = ([0.24725, 0.1995, 0.0745], [0.75164, 0.60648, 0.22648], [0.628281, 0.555802, 0.366065], 51.2)
RUBY = ([0.1745, 0.01175, 0.01175], [0.61424, 0.04136, 0.04136], [0.727811, 0.626959, 0.626959], 76.8)
CYAN_RUBBER = ([0.0, 0.05, 0.05], [0.4, 0.5, 0.5], [0.04, 0.7, 0.7], 10.0)
SHARPEST = ([0.2, 0.2, 0.2], [0.3, 0.1, 0.2], [0.5, 0.6, 0.4], 128.0)
BROADEST = ([0.1, 0.2, 0.3], [0.2, 0.3, 0.4], [0.4, 0.3, 0.2], 5.0)


def _material(numbers: tuple[list[float], list[float], list[float], float]) -> dict[str, Any]:
    return {"model": "blinn-phong", **dict(zip(("k_a", "k_d", "k_s", "n"), numbers, strict=True))}


@pytest.mark.parametrize("scene", [*SCENES.values(), LOCAL], ids=[*SCENES, "local viewer"])
def test_drawing_is_the_shading_equation(scene: str) -> None:
    parsed, material = tomllib.loads(scene), _material(GOLD)
    drawn = opengl_ball.draw_ball(parsed, material)
    sight = numpy_shading.trace(parsed["camera"], parsed["shapes"])
    error = np.abs(drawn - np.minimum(numpy_shading.shade(parsed, material), 1.0))[sight.inside(1)]
    assert np.quantile(error, 0.999) < 2e-4  # faces of a quarter of a pixel: 1e-4 of the lobe at n = 51
    assert error.max() < 1e-2  # the few pixels where a face straddles the terminator, where the highlight jumps to zero
    assert np.count_nonzero(drawn.any(-1) != sight.hit) <= 8  # pixels whose centres lie on the edge


def test_drawing_is_clamped_at_one() -> None:
    scene = tomllib.loads(ORTHOGRAPHIC + BALL + DIRECTIONAL.replace("[0.6, 0.55, 0.5]", "[2.0, 2.0, 2.0]"))
    assert opengl_ball.draw_ball(scene, _material(GOLD)).max() == 1.0


def test_the_bundled_ball_is_what_its_script_draws() -> None:
    scene = tomllib.loads((GOLD_BALL / "scene.toml").read_text(encoding="utf-8"))
    drawn = opengl_ball.draw_ball(scene, json.loads((GOLD_BALL / "truth.json").read_text(encoding="utf-8")))
    # 2^-11: half floats; 1e-4: other versions of Mesa may rasterise a face's edge differently
    np.testing.assert_allclose(brdf.read_image(GOLD_BALL / "target.exr"), drawn, rtol=2.0**-11, atol=1e-4)


@pytest.mark.parametrize("scene", SCENES.values(), ids=SCENES.keys())
@pytest.mark.parametrize("numbers", [GOLD, RUBY, CYAN_RUBBER, SHARPEST, BROADEST], ids=lambda row: f"n={row[-1]}")
def test_fit_reads_the_material_back(scene: str, numbers: tuple[Any, ...], tmp_path: Path) -> None:
    path = tmp_path / "scene.toml"
    path.write_text(scene, encoding="utf-8")
    truth, parsed = _material(numbers), tomllib.loads(scene)
    target = opengl_ball.draw_ball(parsed, truth)
    # OpenGL casts no shadows: pixels that lie in one are left out.
    lit = numpy_shading.shade(parsed, truth, shadows=True) == numpy_shading.shade(parsed, truth)
    found = fitting.fit(target, brdf.Scene.load(path), model="blinn-phong", mask=lit.all(axis=-1)).material
    # The drawing's own faces account for n / (64 R^2) of n, 0.03 % at n = 128, and for a few 1e-5 of the k.
    assert float(found.n) == pytest.approx(truth["n"], rel=2e-3)
    for key in ("k_a", "k_d", "k_s"):
        np.testing.assert_allclose(np.asarray(getattr(found, key)), truth[key], atol=1e-3, err_msg=key)


def test_fit_leaves_saturated_pixels_out(tmp_path: Path) -> None:
    scene = ORTHOGRAPHIC + BALL + DIRECTIONAL.replace("[0.6, 0.55, 0.5]", "[1.0, 1.0, 1.0]")
    path = tmp_path / "scene.toml"
    path.write_text(scene, encoding="utf-8")
    target = opengl_ball.draw_ball(tomllib.loads(scene), _material(GOLD))
    assert np.mean(target == 1.0) > 0.005
    found = fitting.fit(target, brdf.Scene.load(path), model="blinn-phong").material
    assert float(found.n) == pytest.approx(GOLD[-1], rel=2e-3)
    np.testing.assert_allclose(np.asarray(found.k_s), GOLD[2], atol=1e-3)


def test_model_is_named_from_the_pixels_alone(tmp_path: Path) -> None:
    path = tmp_path / "scene.toml"
    path.write_text(SCENES["directional"], encoding="utf-8")
    target = opengl_ball.draw_ball(tomllib.loads(SCENES["directional"]), _material(GOLD))
    assert fitting.fit(target, brdf.Scene.load(path), model="auto").material.name == "blinn-phong"
