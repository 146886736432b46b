"""The report page: complete, self-contained, and shown by a real browser."""

import dataclasses
import json
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from project_paths import BROWSER

import brdf
import fitting
from fitting.report.html import report_page


@pytest.fixture(scope="module")
def result() -> fitting.FitResult:
    camera = brdf.OrthographicCamera(position=[0, 0, 4], target=[0, 0, 0], up=[0, 1, 0], width=2.2, resolution=(48, 48))
    scene = brdf.Scene(
        camera=camera,
        shapes=(brdf.Sphere(center=[0, 0, 0], radius=1),),
        lights=(brdf.DirectionalLight(direction=[0.4, 0.5, 0.8], intensity=[0.9] * 3),),
    )
    material = brdf.BlinnPhong(k_d=[0.5, 0.4, 0.3], k_s=[0.4, 0.4, 0.4], n=30)
    target = np.asarray(brdf.render(material, scene, precision="float64"))
    target = target + np.random.default_rng(5).normal(0, 0.01, target.shape)
    return fitting.fit(target, scene, model="blinn-phong")


@pytest.fixture(scope="module")
def page(result: fitting.FitResult) -> str:
    return report_page(result, source="<b>&target.exr", command="brdf fit '<b>&target.exr'")


def test_page_says_everything(page: str, result: fitting.FitResult):
    for word in ("95 % interval", "not reciprocal", "Residual", "brdf fit", "jax", "Is it plausible?", "scanline"):
        assert word in page
    for parameter in result.parameters:
        if parameter.value is not None:
            assert f"{parameter.value:.6g}" in page


def test_page_loads_nothing_and_escapes_names(page: str):
    assert not re.findall(r"(?:src|href)=\"(?!data:)|@import|url\(|<script", page)
    assert "<b>&target" not in page
    assert "&lt;b&gt;&amp;target.exr" in page
    assert "Content-Security-Policy" in page


def test_results_show_themselves_in_jupyter(result: fitting.FitResult):
    assert "95 % interval" in result._repr_html_()
    assert "data:image/png;base64," in (result.material._repr_html_() or "")
    assert "not plausible" in brdf.check(result.material)._repr_html_()


@pytest.mark.skipif(
    not (shutil.which("node") and shutil.which("chromium") and (BROWSER / "node_modules").exists()),
    reason="needs node, Debian's chromium, and `npm ci` in tests/browser",
)
@pytest.mark.parametrize("width", [1000, 400])
def test_chromium_shows_the_page(page: str, width: int, tmp_path: Path):
    (tmp_path / "report.html").write_text(page)
    shot = tmp_path / "shot.png"
    command = ["node", str(BROWSER / "open_page.mjs"), str(tmp_path / "report.html"), str(shot), str(width)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=120)
    assert done.returncode == 0, done.stderr
    seen = json.loads(done.stdout)
    assert seen["requests"] == []
    assert seen["messages"] == []
    assert (seen["pictures"], seen["broken"]) == (3, 0)
    assert seen["width"] <= width  # nothing sticks out sideways, on a telephone either
    pixels = brdf.read_image(shot)
    assert pixels.shape[0] > 800
    assert np.std(pixels) > 0.05


def test_columns_without_content_are_not_shown(result: fitting.FitResult):
    """One channel has no name, and without errors there is no interval."""
    (scene,), (target,) = result.scenes, result.targets
    lamp = brdf.DirectionalLight(direction=scene.lights[0].direction, intensity=[0.9])
    grey_scene = brdf.Scene(camera=scene.camera, shapes=scene.shapes, lights=(lamp,))
    grey = fitting.fit(target[..., :1], grey_scene, model="lambert")
    parameters = tuple(dataclasses.replace(one, error=None, interval=None) for one in grey.parameters)
    bare = report_page(dataclasses.replace(grey, parameters=parameters))
    assert "<th>value</th>" in bare
    for head in ("channel", "± error", "95 % interval"):
        assert f"<th>{head}</th>" in report_page(result)
        assert f"<th>{head}</th>" not in bare


@pytest.mark.skipif(
    not (shutil.which("node") and shutil.which("chromium") and (BROWSER / "node_modules").exists()),
    reason="needs node, Debian's chromium, and `npm ci` in tests/browser",
)
def test_a_spectrum_does_not_widen_the_page(tmp_path: Path):
    shown = brdf.Lambert(k_d=np.linspace(0, 1, 31))._repr_html_()
    (tmp_path / "page.html").write_text(f'<meta charset="utf-8">{shown}')
    command = ["node", str(BROWSER / "open_page.mjs"), str(tmp_path / "page.html"), str(tmp_path / "shot.png"), "700"]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=120)
    assert json.loads(done.stdout)["width"] <= 700
