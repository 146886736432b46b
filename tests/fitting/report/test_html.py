"""The report page: complete, self-contained, and shown by a real browser."""

import dataclasses
import pickle
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from browser_pages import asked, needs_browser

import brdf
import fitting
from fitting.report.html import report_page


@pytest.fixture(scope="module")
def page(glossy: fitting.FitResult) -> str:
    return report_page(glossy, source="<b>&target.exr", command="brdf fit '<b>&target.exr'")


def test_page_says_everything(page: str, glossy: fitting.FitResult):
    for word in ("95 % interval", "not reciprocal", "Residual", "brdf fit", "jax", "Is it plausible?", "scanline"):
        assert word in page
    for parameter in glossy.parameters:
        if parameter.value is not None:
            assert f"{parameter.value:.6g}" in page


def test_page_loads_nothing_and_escapes_names(page: str):
    assert not re.findall(r"(?:src|href)=\"(?!data:)|@import|url\(|<script (?!type=\"application/json\")", page)
    assert page.count("<script>") == page.count("script-src 'sha256-") == 1
    assert "<b>&target" not in page
    assert "&lt;b&gt;&amp;target.exr" in page
    assert "Content-Security-Policy" in page


def test_a_result_that_another_process_made_shows_itself(glossy: fitting.FitResult, tmp_path: Path):
    (tmp_path / "result.pickle").write_bytes(pickle.dumps(glossy))
    program = "import pickle, sys; result = pickle.load(open(sys.argv[1], 'rb')); print(result); result.plot()"
    command = [sys.executable, "-W", "ignore", "-c", program, str(tmp_path / "result.pickle")]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=120)
    assert done.stdout.strip() == str(glossy)


def test_results_show_themselves_in_jupyter(glossy: fitting.FitResult):
    assert "95 % interval" in glossy._repr_html_()
    assert repr(glossy).startswith("<FitResult: blinn-phong, k_a[0] not determined: ")
    assert "\n" not in repr(glossy)
    assert f"{glossy['n']:.1f}" == f"{float(glossy['n']):.1f}"
    assert "data:image/png;base64," in (glossy.material._repr_html_() or "")
    assert "not plausible" in brdf.check(glossy.material)._repr_html_()


@needs_browser
@pytest.mark.parametrize("width", [1000, 400])
def test_chromium_shows_the_page(page: str, width: int, tmp_path: Path):
    (tmp_path / "report.html").write_text(page)
    shot = tmp_path / "shot.png"
    seen = asked("open_page", tmp_path / "report.html", shot, width)
    assert seen["requests"] == []
    assert seen["messages"] == []
    assert (seen["pictures"], seen["broken"]) == (4, 0)
    assert seen["width"] <= width  # nothing sticks out sideways, on a telephone either
    pixels = brdf.read_image(shot)
    assert pixels.shape[0] > 800
    assert np.std(pixels) > 0.05


def test_columns_without_content_are_not_shown(matt: fitting.FitResult, page: str):
    """One channel has no name, and without errors there is no interval."""
    parameters = tuple(dataclasses.replace(one, error=None, interval=None) for one in matt.parameters)
    bare = report_page(dataclasses.replace(matt, parameters=parameters))
    assert "<th>value</th>" in bare
    for head in ("channel", "± error", "95 % interval"):
        assert f"<th>{head}</th>" in page
        assert f"<th>{head}</th>" not in bare


@needs_browser
def test_a_spectrum_does_not_widen_the_page(tmp_path: Path):
    shown = brdf.Lambert(k_d=np.linspace(0, 1, 31))._repr_html_()
    (tmp_path / "page.html").write_text(f'<meta charset="utf-8">{shown}')
    assert asked("open_page", tmp_path / "page.html", tmp_path / "shot.png", 700)["width"] <= 700
