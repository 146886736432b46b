"""Every public name has an example in its docstring, and each of them runs as it stands there.

They run in a folder as a user has it: `scene.toml` and a picture of it, a mask, a mesh, a measured table. `brdf`,
`fitting` and `np` are imported, as documentation does it.
"""

import ast
import doctest
import inspect
import itertools
import operator
from pathlib import Path

import numpy as np
import pytest
from project_paths import ROOT

import brdf
import fitting

# Constants: what explains them is the string under their assignment.
CONSTANTS = {"MODELS": "brdf/models/__init__.py", "PRESETS": "brdf/materials/presets.py"}
OPTIONS = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE
NAMES = [("brdf", name) for name in brdf.__all__] + [("fitting", name) for name in fitting.__all__]
NAMES += [("fitting", f"functional.{name}") for name in ("fit", "solve")]


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("examples")
    text = (ROOT / "data" / "gold-ball" / "scene.toml").read_text(encoding="utf-8")
    (folder / "scene.toml").write_text(text.replace("[256, 256]", "[32, 32]"), encoding="utf-8")
    scene = brdf.Scene.load(folder / "scene.toml")
    ball = brdf.render(brdf.preset("gold"), scene)
    brdf.write_image(folder / "target.exr", ball)
    brdf.write_image(folder / "target.png", ball)
    brdf.write_image(folder / "mask.png", np.asarray(scene.surface_points().mask, float))
    corners = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\n"
    (folder / "pyramid.obj").write_text(f"{corners}f 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n")
    angles = np.linspace(0, 1.2, 5)  # a table as Cornell's: one wavelength, then directions and f_r = 0.5 / pi
    rows = "".join(f"{light} 0 {view} 0 {0.5 / np.pi}\n" for light in angles for view in angles)
    (folder / "paint.txt").write_text(f"1\n550\n{rows}")
    tilts = np.array([[0, 0], [1, 0], [0, 1], [-1, 0], [0, -1], [0.4, 0.4]])
    to_light, flat = np.c_[0.5 * tilts, np.ones(6)], np.broadcast_to([0.0, 0.0, 1.0], (4, 4, 3))
    scenes = [scene_of(flat, light) for light in to_light]
    fitting.fit_maps([brdf.render(GLOSSY, one) for one in scenes], to_light, flat).save(folder / "maps")
    return folder


GLOSSY = brdf.BlinnPhong(k_d=[0.3, 0.2, 0.1], k_s=0.5, n=60)


def scene_of(normals: np.ndarray, to_light: np.ndarray) -> brdf.Scene:
    points = brdf.SurfacePoints.from_normals(normals)
    return brdf.Scene(points=points, lights=[brdf.DirectionalLight(to_light, 1.0)])


def documentation(package: str, name: str) -> str:
    if name not in CONSTANTS:
        return inspect.getdoc(operator.attrgetter(name)({"brdf": brdf, "fitting": fitting}[package])) or ""
    body = ast.parse((ROOT / CONSTANTS[name]).read_text(encoding="utf-8")).body
    for assignment, below in itertools.pairwise(body):
        if isinstance(assignment, ast.AnnAssign) and ast.unparse(assignment.target) == name:
            return inspect.cleandoc(ast.literal_eval(below.value)) if isinstance(below, ast.Expr) else ""
    return ""


@pytest.mark.parametrize(("package", "name"), NAMES, ids=lambda value: value)
def test_a_public_name_has_an_example_that_runs(package, name, folder, monkeypatch):
    import matplotlib

    matplotlib.use("agg")
    monkeypatch.chdir(folder)
    text = documentation(package, name)
    globs = {"brdf": brdf, "fitting": fitting, "np": np}
    examples = doctest.DocTestParser().get_doctest(text, globs, f"{package}.{name}", None, 0)
    assert examples.examples, "its docstring has no example"
    said: list[str] = []
    doctest.DocTestRunner(optionflags=OPTIONS).run(examples, out=said.append)
    assert not said, "".join(said)
