"""The shape of the code: imports point down a list without circles, and names do not hide one another.

Imports inside functions count like others; those for type checkers alone do not. Each check is shown to fail.
"""

import ast
import functools
import importlib
from collections import Counter
from collections.abc import Callable, Iterator
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest
from project_paths import ROOT

PACKAGES = ("brdf", "fitting")

# From the bottom to the top; a name stands for all below it that have no line of their own.
LAYERS = """
brdf.errors brdf.formatters brdf.checks brdf.files brdf.channels brdf.arguments brdf.precision brdf.vectors
brdf.models brdf.albedo brdf.conversions
brdf.geometry brdf.lights brdf.lobes brdf.pixel_area brdf.images brdf.scene_file brdf.scene brdf.rendering
brdf.materials brdf.measured brdf.plausibility brdf.display
fitting.progress fitting.likelihood fitting.codes fitting.solver fitting.model_fit
fitting.channel_errors fitting.continuation fitting.maximum_likelihood fitting.light_colour fitting.sample_error
fitting.problem fitting.tile fitting.pixels fitting.selection fitting.budget.choice fitting.budget.sampling
fitting.result
fitting.uncertainty fitting.uneven_noise fitting.growing_noise fitting.doubts fitting.jpeg_errors fitting.core
fitting.joint_problem
fitting.diagnosis fitting.report fitting.light_choice fitting.joint_likelihood fitting.joint
fitting.implicit fitting.relighting fitting.measured_fit fitting.photographs fitting.budget fitting.speed_accuracy
fitting.front_door fitting.functional fitting.many fitting.maps
fitting.cli
""".split()

# What fitting needs of brdf and no user calls.
OPEN_TO_FITTING = set(
    """
brdf.albedo brdf.channels brdf.checks brdf.conversions brdf.display brdf.errors brdf.files brdf.geometry.rays
    brdf.images.encoding
    brdf.images.jpeg brdf.images.writing brdf.lights.base brdf.lobes
    brdf.materials.exports brdf.materials.material_file brdf.measured.loading brdf.measured.table brdf.models.base
    brdf.plausibility.numeric brdf.plausibility.report brdf.precision brdf.rendering
    brdf.vectors
""".split()
)

# It stands on the front door as a notebook does, and its modules bear the names of the commands.
COMMAND = "fitting.cli."

FORBIDDEN = {
    "brdf": {"fitting", "optimistix", "lineax", "typer", "rich", "benchmarks", "data", "drawing", "tests"},
    "fitting": {"benchmarks", "data", "drawing", "tests"},
}


class Tree:
    """The modules of a source tree by name, and what each imports."""

    def __init__(self, root: Path):
        paths = [path for package in PACKAGES for path in sorted((root / package).rglob("*.py"))]
        self.paths = {_name(path.relative_to(root)): path for path in paths}
        self.modules = {package: _public_modules(root / package / "__init__.pyi") for package in PACKAGES}
        self.public = {package: _public_names(root / package / "__init__.pyi") for package in PACKAGES}

    @functools.cached_property
    def imports(self) -> dict[str, set[str]]:
        """Module -> what it imports: modules of the tree, or the first names of others; the root where it is one."""
        return {name: set(self._imported(name)) for name in self.paths}

    @functools.cached_property
    def inner(self) -> dict[str, set[str]]:
        """Module -> modules of the tree that it imports, package roots left out: they load when a name is used."""
        return {
            name: {one for one in found if one in self.paths and one not in PACKAGES and one != name}
            for name, found in self.imports.items()
        }

    def _imported(self, name: str) -> Iterator[str]:
        source = ast.parse(self.paths[name].read_text(encoding="utf-8"))
        for_types = {
            id(inner)
            for node in ast.walk(source)
            if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.dump(node.test)
            for inner in ast.walk(node)
        }
        for node in ast.walk(source):
            if id(node) in for_types:
                continue
            if isinstance(node, ast.Import):
                yield from (alias.name for alias in node.names)
            elif isinstance(node, ast.ImportFrom):
                module = self._absolute(name, node)
                for alias in node.names:
                    inner = f"{module}.{alias.name}"
                    yield inner if inner in self.paths else module
            elif isinstance(node, ast.Call) and "import" in ast.unparse(node.func).rpartition(".")[2]:
                # importlib.import_module, __import__
                yield from (one.value for one in node.args if isinstance(one, ast.Constant) and one.value)

    def _absolute(self, name: str, node: ast.ImportFrom) -> str:
        if not node.level:
            return node.module or ""
        parts = name.split(".")
        is_package = self.paths[name].name == "__init__.py"
        base = parts[: len(parts) - node.level + is_package]
        return ".".join([*base, *([node.module] if node.module else [])])


def _name(path: Path) -> str:
    parts = path.with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def _public_names(stub: Path) -> set[str]:
    if not stub.exists():
        return set()
    nodes = ast.parse(stub.read_text(encoding="utf-8")).body
    return {alias.asname or alias.name for node in nodes if isinstance(node, ast.ImportFrom) for alias in node.names}


def _public_modules(stub: Path) -> set[str]:
    """Modules that are public as a whole."""
    nodes = ast.parse(stub.read_text(encoding="utf-8")).body if stub.exists() else []
    return {
        alias.name for node in nodes if isinstance(node, ast.ImportFrom) and not node.module for alias in node.names
    }


def _layer(module: str, layers: list[str]) -> int:
    """The place of the longest name on the list that the module's name begins with; -1 where there is none."""
    fitting = [layer for layer in layers if f"{module}.".startswith(f"{layer}.")]
    return layers.index(max(fitting, key=len)) if fitting else -1


# -- the rules: each gives what breaks it ------------------------------------------------------------------------------


def without_a_layer(tree: Tree, layers: list[str]) -> list[str]:
    modules = [name for name in tree.paths if name not in PACKAGES]
    unknown = [f"{name} has no layer" for name in modules if _layer(name, layers) < 0]
    return unknown + [f"{layer} is no module" for layer in layers if layer not in tree.paths]


def upwards(tree: Tree, layers: list[str]) -> list[str]:
    return [
        f"{name} imports {other}, which stands above it"
        for name, found in tree.inner.items()
        for other in sorted(found)
        if name not in PACKAGES and _layer(name, layers) < _layer(other, layers)
    ]


def circles(tree: Tree) -> list[str]:
    try:
        tuple(TopologicalSorter(tree.inner).static_order())
    except CycleError as error:
        return [" <- ".join(error.args[1])]
    return []


def roots_from_inside(tree: Tree) -> list[str]:
    return [
        f"{name} imports {package}"
        for package in PACKAGES
        for name, found in tree.imports.items()
        if name.startswith(f"{package}.") and package in found and not name.startswith(COMMAND)
    ]


def forbidden(tree: Tree) -> list[str]:
    return [
        f"{name} imports {other}"
        for name, found in tree.imports.items()
        for other in sorted(found)
        if other.partition(".")[0] in FORBIDDEN[name.partition(".")[0]]
    ]


def hiding(tree: Tree) -> list[str]:
    """A submodule, once imported, would hide the function of the same name."""
    return [
        f"{name} hides {package}.{name.rpartition('.')[2]}"
        for package in PACKAGES
        for name in tree.paths
        if name.startswith(f"{package}.") and not name.startswith(COMMAND)
        if name.rpartition(".")[2] in tree.public[package] - tree.modules[package]
    ]


def names_twice(tree: Tree) -> list[str]:
    files = Counter(
        (name.partition(".")[0], path.name)
        for name, path in tree.paths.items()
        if path.name not in ("__init__.py", "base.py") and not name.startswith(COMMAND)
    )
    return [f"{package} has {count} files {file}" for (package, file), count in files.items() if count > 1]


def reached_into(tree: Tree, open_modules: set[str]) -> list[str]:
    return [
        f"{name} imports {other}"
        for name, found in tree.inner.items()
        for other in sorted(found)
        if name.startswith("fitting.") and other.startswith("brdf.") and other not in open_modules
    ]


RULES: dict[str, Callable[[Tree], list[str]]] = {
    "every module has a layer": lambda tree: without_a_layer(tree, LAYERS),
    "imports point down": lambda tree: upwards(tree, LAYERS),
    "no circles": circles,
    "nobody imports its own package's root": roots_from_inside,
    "brdf knows nothing of fitting, and neither of what is not installed": forbidden,
    "no module bears the name of a public function": hiding,
    "no file name twice in a package": names_twice,
    "fitting reaches only into modules that are open to it": lambda tree: reached_into(tree, OPEN_TO_FITTING),
}


@pytest.fixture(scope="module")
def ours() -> Tree:
    return Tree(ROOT)


@pytest.mark.parametrize("rule", RULES)
def test_the_tree_keeps(rule: str, ours: Tree):
    assert RULES[rule](ours) == []


def test_what_is_open_is_used(ours: Tree):
    used = {other for name, found in ours.inner.items() if name.startswith("fitting.") for other in found}
    assert OPEN_TO_FITTING <= used


@pytest.mark.parametrize("package", PACKAGES)
def test_every_public_name_loads(package: str, ours: Tree):
    module = importlib.import_module(package)
    assert set(module.__all__) == ours.public[package]
    for name in module.__all__:
        assert getattr(module, name) is not None


# -- the rules on trees that break them --------------------------------------------------------------------------------

LOW_AND_HIGH = ["brdf.low", "brdf.high"]

BROKEN: dict[str, tuple[dict[str, str], Callable[[Tree], list[str]], str]] = {
    "no layer": ({"brdf/new.py": ""}, lambda tree: without_a_layer(tree, []), "brdf.new has no layer"),
    "layer without a module": ({}, lambda tree: without_a_layer(tree, ["brdf.old"]), "brdf.old is no module"),
    "upwards": (
        {"brdf/low.py": "import brdf.high", "brdf/high.py": ""},
        lambda tree: upwards(tree, LOW_AND_HIGH),
        "brdf.low imports brdf.high, which stands above it",
    ),
    "upwards, late and relative": (
        {"brdf/low/__init__.py": "", "brdf/low/a.py": "def f():\n    from ..high import g", "brdf/high.py": ""},
        lambda tree: upwards(tree, LOW_AND_HIGH),
        "brdf.low.a imports brdf.high, which stands above it",
    ),
    "upwards through importlib": (
        {"brdf/low.py": "import importlib\nimportlib.import_module('brdf.high')", "brdf/high.py": ""},
        lambda tree: upwards(tree, LOW_AND_HIGH),
        "brdf.low imports brdf.high, which stands above it",
    ),
    "circle": (
        {"brdf/a.py": "from brdf import b", "brdf/b.py": "def f():\n    import brdf.a"},
        circles,
        "brdf.a <- brdf.b <- brdf.a",
    ),
    "root": ({"brdf/a.py": "import brdf"}, roots_from_inside, "brdf.a imports brdf"),
    "name of the root": ({"fitting/a.py": "from fitting import fit"}, roots_from_inside, "fitting.a imports fitting"),
    "relative root": ({"brdf/a.py": "from . import check"}, roots_from_inside, "brdf.a imports brdf"),
    "relative root from below": (
        {"brdf/room/__init__.py": "", "brdf/room/a.py": "from .. import check"},
        roots_from_inside,
        "brdf.room.a imports brdf",
    ),
    "root through importlib": (
        {"brdf/a.py": "from importlib import import_module\nimport_module('brdf').check"},
        roots_from_inside,
        "brdf.a imports brdf",
    ),
    "solver in brdf": ({"brdf/a.py": "import optimistix as optx"}, forbidden, "brdf.a imports optimistix"),
    "benchmarks": ({"fitting/a.py": "from benchmarks.b import c"}, forbidden, "fitting.a imports benchmarks.b"),
    "hidden function": (
        {"brdf/room/check.py": "", "brdf/__init__.pyi": "from .room.front import check as check"},
        hiding,
        "brdf.room.check hides brdf.check",
    ),
    "name twice": (
        {"brdf/files.py": "", "brdf/room/files.py": "", "brdf/room/__init__.py": "", "brdf/__init__.py": ""},
        names_twice,
        "brdf has 2 files files.py",
    ),
    "reached into": (
        {"fitting/a.py": "from brdf.b import c", "brdf/b.py": ""},
        lambda tree: reached_into(tree, set()),
        "fitting.a imports brdf.b",
    ),
}


@pytest.mark.parametrize(("files", "rule", "words"), BROKEN.values(), ids=BROKEN)
def test_a_tree_that_breaks_a_rule_is_seen(
    files: dict[str, str], rule: Callable[[Tree], list[str]], words: str, tmp_path: Path
):
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    found = rule(Tree(tmp_path))
    assert len(found) == 1
    if rule is circles:  # which may be told from any of its modules on
        assert set(found[0].split(" <- ")) == set(words.split(" <- "))
    else:
        assert found == [words]


def test_what_is_for_type_checkers_alone_does_not_count(tmp_path: Path):
    (tmp_path / "brdf").mkdir()
    (tmp_path / "brdf/a.py").write_text("if TYPE_CHECKING:\n    from brdf import b\n    import fitting\n")
    (tmp_path / "brdf/b.py").write_text("import brdf.a\n")
    assert circles(Tree(tmp_path)) == forbidden(Tree(tmp_path)) == []
