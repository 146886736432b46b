"""How the documentation is built: `make docs`. It needs no network, neither to build nor to be read."""

import os
import sys
import tomllib
from pathlib import Path
from typing import Any

from docutils import nodes
from docutils.utils.math.latex2mathml import tex2mathml

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent
sys.path[:0] = [str(HERE), str(ROOT)]
os.environ["PYTHONPATH"] = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])  # for the notebooks
os.environ.setdefault("BRDF_REAL_DATA", str(ROOT.parent / "shared" / "data"))
# Compiled programs are shared by the notebooks, and with the tests: see tests/conftest.py.
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(ROOT / "out" / "compiled"))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
os.environ.setdefault("PYTHONWARNINGS", "ignore:Error reading persistent compilation cache entry")

import reference

project = "brdf-fitting"
author = "the authors of brdf-fitting"
release = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["version"]
extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
exclude_patterns = ["_build", "conf.py", "reference.py", "**/.ipynb_checkpoints"]
html_theme = "furo"
html_title = f"brdf-fitting {release}"
html_copy_source = False
html_show_copyright = False
smartquotes = False  # -- begins an option

# Notebooks are text in jupytext's percent format. A cell that fails or writes to standard error is a warning, and a
# warning fails the build. Widgets would pull scripts from elsewhere: their pictures stand in for them.
nb_custom_formats = {".py": ["jupytext.reads", {"fmt": "py:percent"}]}
nb_execution_mode = "cache"
nb_execution_cache_path = str(ROOT / "out" / ".jupyter_cache")
nb_execution_timeout = 300
nb_execution_raise_on_error = True
nb_output_stderr = "remove-warn"
nb_ipywidgets_js: dict[str, Any] = {}
nb_mime_priority_overrides = [("html", "application/vnd.jupyter.widget-view+json", None)]
myst_enable_extensions = ["dollarmath", "deflist"]
myst_heading_anchors = 3
myst_update_mathjax = False

# Docstrings say shapes and types; jaxtyping's annotations would come out as emphasis and as jaxlib._jax.Array.
autodoc_typehints = "none"
autodoc_preserve_defaults = True
autodoc_member_order = "bysource"
napoleon_attr_annotations = False
napoleon_use_ivar = True
default_role = "code"


def _inline(writer: Any, node: nodes.math) -> None:
    writer.body.append(tex2mathml(node.astext()))
    raise nodes.SkipNode


def _block(writer: Any, node: nodes.math_block) -> None:
    writer.body.append(f'<div class="math" style="overflow-x: auto">{tex2mathml(node.astext(), as_block=True)}</div>')
    raise nodes.SkipNode


def setup(app: Any) -> None:
    """Formulas as MathML, which browsers draw without a program; pages written from the code itself."""
    app.add_html_math_renderer("mathml", inline_renderers=(_inline, None), block_renderers=(_block, None))
    app.connect("autodoc-process-docstring", reference.tables)
    app.connect("autodoc-skip-member", reference.skip)
    app.connect("builder-inited", lambda app: reference.write(Path(app.srcdir)))


html_math_renderer = "mathml"
