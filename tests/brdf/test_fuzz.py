"""Any value in any place of a file gives what it says or one clear error; and what fuzzing found stays found."""

import json
import tomllib

import numpy as np
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import brdf
from benchmarks import fuzz, fuzz_corpus
from brdf.errors import InputError

SETTINGS = settings(
    max_examples=150, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
numbers = st.one_of(st.integers(-(2**70), 2**70), st.floats(), st.sampled_from([0, 1, -1, 0.5, 1e308, 1e-320]))
leaves = st.one_of(st.none(), st.booleans(), numbers, st.text(max_size=8))
anything = st.recursive(
    leaves,
    lambda inner: st.one_of(st.lists(inner, max_size=4), st.dictionaries(st.text(max_size=6), inner, max_size=3)),
)


def places(value, path=()):
    """Every place in a document."""
    yield path
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, inner in items:
        yield from places(inner, (*path, key))


def replaced(value, path, new):
    if not path:
        return new
    copy = dict(value) if isinstance(value, dict) else list(value)
    copy[path[0]] = replaced(copy[path[0]], path[1:], new)
    return copy


def toml_value(value) -> str:
    """Inline TOML; it has no null, so that becomes text."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{json.dumps(key)} = {toml_value(inner)}" for key, inner in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(toml_value, value)) + "]"
    if isinstance(value, bool) or value is None:
        return json.dumps(bool(value))
    if isinstance(value, float):
        return str(value) if np.isfinite(value) else str(value).replace("infinity", "inf")
    return json.dumps(value)


def one_line(error: InputError, path) -> None:
    assert str(error).startswith(str(path))
    assert str(error).isprintable()
    assert str(error).endswith(".")


SCENE = tomllib.loads(fuzz_corpus.SCENE)
SCENE_PLACES = [path for path in places(SCENE) if path]


@SETTINGS
@given(place=st.sampled_from(SCENE_PLACES), value=anything)
def test_any_value_in_any_place_of_a_scene(tmp_path, place, value):
    path = tmp_path / "scene.toml"
    document = replaced(SCENE, place, value)
    text = "\n".join(f"{json.dumps(key)} = {toml_value(inner)}" for key, inner in document.items())
    path.write_text(text.encode("utf-8", "replace").decode(), encoding="utf-8")
    try:
        scene = brdf.Scene.load(path)
    except InputError as error:
        one_line(error, path)
    else:
        assert isinstance(scene, brdf.Scene)


MATERIAL = json.loads(fuzz_corpus.JSON)


@SETTINGS
@given(place=st.sampled_from(list(places(MATERIAL))), value=anything)
def test_any_value_in_any_place_of_a_material(tmp_path, place, value):
    path = tmp_path / "material.json"
    path.write_text(json.dumps(replaced(MATERIAL, place, value)), encoding="utf-8")
    try:
        material = brdf.load_material(path)
    except InputError as error:
        one_line(error, path)
    else:
        assert all(np.all(np.isfinite(leaf)) and np.all(leaf >= 0) for leaf in vars(material).values())


@SETTINGS
@given(
    text=st.text(alphabet=st.characters(codec="utf-8"), max_size=60),
    name=st.sampled_from(["a.toml", "a.json", "a.mtl"]),
)
def test_any_text(tmp_path, text, name):
    path = tmp_path / name
    path.write_text(text, encoding="utf-8", newline="")
    read = brdf.Scene.load if name.endswith("toml") else brdf.load_materials
    try:
        read(path)
    except InputError as error:
        one_line(error, path)


@SETTINGS
@given(
    content=st.binary(max_size=80), name=st.sampled_from(["a.toml", "a.json", "a.mtl", "a.binary", "a.bsdf", "a.exr"])
)
def test_any_bytes(tmp_path, content, name):
    path = tmp_path / name
    path.write_bytes(content)
    readers = {"toml": brdf.Scene.load, "json": brdf.load_materials, "mtl": brdf.load_materials, "exr": brdf.read_image}
    try:
        readers.get(name[2:], brdf.load_measured)(path)
    except InputError as error:
        one_line(error, path)


def test_damaged_files_give_a_value_or_one_error(tmp_path):
    outcomes, found = fuzz.run(3000, 1, 60.0, tmp_path)
    assert found == []
    assert sum(outcomes.values()) > 0
    assert any(outcome.endswith("value") for outcome in outcomes)


def test_the_corpus_is_sound_before_it_is_damaged(tmp_path):
    for suffix, content, reader in fuzz_corpus.corpus(tmp_path):
        if content in (fuzz_corpus.PERSPECTIVE.encode(),) or suffix in (".binary", ".bsdf"):
            continue  # these name files that are missing, or hold headers alone
        path = tmp_path / f"sound{suffix}"
        path.write_bytes(content)
        reader(path)
