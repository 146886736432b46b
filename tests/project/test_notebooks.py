"""The notebooks: stored without outputs, through the front door only, and run to a picture without a warning."""

import ast
import importlib.util
import sys
from pathlib import Path

import pytest
from project_paths import ROOT

import brdf
import fitting

HERE = ROOT / "notebooks"
NOTEBOOKS = sorted(HERE.glob("[0-9]_*.py"))


def test_all_seven_are_there():
    assert [path.name[0] for path in NOTEBOOKS] == list("1234567")


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
    assert not list(HERE.glob("*.ipynb")), "notebooks are stored as text, without outputs"


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # Jupyter's own machinery; the notebooks' warnings are looked for in their output
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook_runs_to_a_picture(path: Path, tmp_path: Path):
    for name in ("jupytext", "nbconvert", "ipykernel"):
        pytest.importorskip(name, reason="needs the extra `notebooks`")
    spec = importlib.util.spec_from_file_location("run_notebooks", HERE / "run.py")
    assert spec is not None
    assert spec.loader is not None
    run = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = run
    spec.loader.exec_module(run)
    notebook = run.execute(path, tmp_path)
    assert run.faults(notebook) == []
    assert len(list(tmp_path.glob("*.png"))) == len(run.pictures(notebook)) > 0
