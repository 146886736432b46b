"""Imports point down: brdf knows nothing of fitting, and what loads lazily is what type checkers see."""

import ast
import importlib
from pathlib import Path

import pytest
from project_paths import ROOT


def imported(path: Path) -> set[str]:
    """The modules that a file imports, wherever in the file it does."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found.add(node.module)
    return found


@pytest.mark.parametrize("path", sorted((ROOT / "brdf").rglob("*.py")), ids=lambda path: path.name)
def test_brdf_imports_neither_fitting_nor_its_solvers(path: Path):
    roots = {name.partition(".")[0] for name in imported(path)}
    assert not roots & {"fitting", "optimistix", "lineax", "typer", "rich"}


@pytest.mark.parametrize("package", ["brdf", "fitting"])
def test_every_public_name_loads(package: str):
    module = importlib.import_module(package)
    for name in module.__all__:
        assert getattr(module, name) is not None


def test_no_lazy_name_is_the_name_of_a_module():
    """A submodule, once imported, would hide the function of the same name."""
    for package in ("brdf", "fitting"):
        modules = {path.stem for path in (ROOT / package).glob("*.py")}
        assert not modules & set(importlib.import_module(package).__all__)
