"""README is what a visitor reads in two minutes, and no link of it or of the documentation leads nowhere."""

import re
from pathlib import Path

import pytest
from project_paths import ROOT

DOCS = sorted((ROOT / "docs").glob("*.md"))
LINK = re.compile(r"\]\((?!https?:|#)([^)#\s]+)")
WRITTEN = ("reference/", "notebooks/")  # by the build, or a folder of its own


def test_readme_is_short():
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= 150


@pytest.mark.parametrize("page", [ROOT / "README.md", ROOT / "data" / "README.md", *DOCS], ids=lambda page: page.name)
def test_links_lead_somewhere(page: Path):
    links = LINK.findall(page.read_text(encoding="utf-8"))
    assert [link for link in links if not link.startswith(WRITTEN) and not (page.parent / link).exists()] == []


def test_every_page_is_on_the_documentation_s_list():
    index = (ROOT / "docs" / "index.md").read_text(encoding="utf-8")
    assert [page.name for page in DOCS if page.stem != "index" and f"\n{page.stem}\n" not in index] == []


def test_the_map_of_the_code_names_files_that_are_there():
    there = {
        path.name for folder in ("brdf", "fitting", "benchmarks", "tests") for path in (ROOT / folder).rglob("*.py")
    }
    named = set(re.findall(r"\w+\.py\b", (ROOT / "docs" / "code_map.md").read_text(encoding="utf-8")))
    assert named - there == set()
