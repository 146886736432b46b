"""The notebooks: stored without outputs, through the front door only; `make docs` runs them."""

import ast
from pathlib import Path

import pytest
from project_paths import ROOT

import brdf
import fitting

HERE = ROOT / "notebooks"
NOTEBOOKS = sorted(HERE.glob("[0-9]_*.py"))


def test_all_nine_are_there():
    assert [path.name[0] for path in NOTEBOOKS] == list("123456789")


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook_uses_the_front_door_only(path: Path):
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom | ast.Import):
            modules = [node.module] if isinstance(node, ast.ImportFrom) else [alias.name for alias in node.names]
            assert not any(str(module).startswith(("brdf.", "fitting.")) for module in modules)
            assert not (isinstance(node, ast.ImportFrom) and node.module in ("brdf", "fitting"))
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            public = {"brdf": brdf.__all__, "fitting": fitting.__all__}.get(node.value.id)
            assert public is None or node.attr in public


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook_is_plain_text_with_prose(path: Path):
    text = path.read_text()
    assert "format_name: percent" in text
    assert text.count("# %% [markdown]") >= 4
    assert "`make lab` opens this notebook" in text.split("# %%")[1]
    assert not list(HERE.glob("*.ipynb")), "notebooks are stored as text, without outputs"
