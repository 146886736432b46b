"""Material files: what is written reads back the same, here and in another program's reader."""

import json
from pathlib import Path

import numpy as np
import pytest
from project_paths import REAL

import brdf
from brdf.models.base import SpecularMaterial

K = {"k_a": [0.1, 0.2, 1 / 3], "k_d": [0.5, 0.4, 0.0], "k_s": [0.3, 0.25, 1e-7]}
MATERIALS = [
    brdf.Lambert(k_a=K["k_a"], k_d=K["k_d"]),
    *[model(**K, n=37.123456789012345) for model in brdf.MODELS.values() if issubclass(model, SpecularMaterial)],
]


def same(a: brdf.Material, b: brdf.Material, rtol: float = 0.0) -> bool:
    return type(a) is type(b) and all(
        np.allclose(value, getattr(b, key), rtol=rtol, atol=0) for key, value in vars(a).items()
    )


@pytest.mark.parametrize("material", MATERIALS, ids=lambda material: material.name)
@pytest.mark.parametrize("suffix", [".json", ".mtl"])
def test_a_saved_material_reads_back_the_same(tmp_path: Path, material: brdf.Material, suffix: str):
    brdf.save_material(material, tmp_path / f"m{suffix}")
    # MTL holds k_s times the model's scale: a product and a quotient, half a unit in the last place each.
    assert same(material, brdf.load_material(tmp_path / f"m{suffix}"), rtol=4e-16 if suffix == ".mtl" else 0.0)


def test_any_number_of_channels_in_json(tmp_path: Path):
    material = brdf.BlinnPhong(k_d=np.linspace(0, 1, 31), k_s=0.2, n=5)
    brdf.save_material(material, tmp_path / "m.json")
    assert same(material, brdf.load_material(tmp_path / "m.json"))
    with pytest.raises(brdf.InputError, match="cannot hold 31 channels"):
        brdf.save_material(material, tmp_path / "m.mtl")
    assert [path.name for path in tmp_path.iterdir()] == ["m.json"]


def test_what_is_not_determined_is_null_and_reads_as_zero(tmp_path: Path):
    material = brdf.BlinnPhong(k_d=[0.5, 0.6, 0.7], k_s=0.0, n=0.0)
    brdf.save_material(material, tmp_path / "m.json", undetermined={"n": "", "k_s": "", "k_a[1]": ""})
    stored = json.loads((tmp_path / "m.json").read_text())
    assert stored["n"] is None
    assert stored["k_s"] == [None] * 3
    assert stored["k_a"] == [0.0, None, 0.0]
    assert same(material, brdf.load_material(tmp_path / "m.json"))


def test_another_program_reads_the_mtl(tmp_path: Path):
    trimesh = pytest.importorskip("trimesh", reason="trimesh is not installed (extra: interop)")
    from trimesh.exchange.obj import parse_mtl

    del trimesh
    brdf.save_material(MATERIALS[2], tmp_path / "m.mtl")
    read = parse_mtl((tmp_path / "m.mtl").read_text())["fitted"]
    np.testing.assert_allclose(read["Kd"] if "Kd" in read else read["kd"], K["k_d"])
    np.testing.assert_allclose(read["Ks"] if "Ks" in read else read["ks"], K["k_s"])
    np.testing.assert_allclose(float(np.squeeze(read["Ns"] if "Ns" in read else read["ns"])), MATERIALS[2].n)


@pytest.mark.skipif(not REAL.is_dir(), reason=f"no real data at {REAL} (BRDF_REAL_DATA)")
def test_other_peoples_mtl_files_give_materials_or_one_line():
    files = sorted((REAL / "materials" / "mtl").glob("*.mtl"))
    assert files
    read, refusals = 0, {}
    for path in files:
        try:
            read += len(brdf.load_materials(path))
        except brdf.InputError as error:
            refusals[path] = str(error)
    assert read > len(files) / 2
    assert all(words.startswith(str(path)) and "\n" not in words for path, words in refusals.items())


WRONG = {
    "list": ("[1]", "must be a JSON object"),
    "text": ("{", "is not JSON"),
    "no model": ("{}", "model: is unknown, got None"),
    "model": ('{"model": "ward"}', "model: is unknown, got 'ward'"),
    "missing": ('{"model": "phong", "k_d": [1], "n": 3}', "k_s: is missing"),
    "negative": ('{"model": "lambert", "k_d": [0.5, -0.2]}', "k_d: must be at least 0, got -0.2 in channel 1"),
    "nan": ('{"model": "lambert", "k_d": [NaN]}', "k_d: must be finite"),
    "words": ('{"model": "lambert", "k_d": ["red"]}', "k_d: must be a number"),
    "truth": ('{"model": "lambert", "k_d": [true]}', "k_d: must be a number, got true"),
    "nested": ('{"model": "lambert", "k_d": [[1]]}', "k_d: must be a number"),
    "empty": ('{"model": "lambert", "k_d": []}', "k_d: must be one number"),
    "two n": ('{"model": "phong", "k_d": [1], "k_s": [1], "n": [1, 2]}', "n: must be one number"),
    "channels": ('{"model": "lambert", "k_a": [1, 2], "k_d": [1, 2, 3]}', "number of channels"),
    "twice": ('{"model": "lambert", "k_d": [1], "k_d": [0]}', "k_d: is given twice"),
    "unknown n": ('{"model": "phong", "k_d": [1], "k_s": [1], "n": null}', "n: is null (not determined) although"),
}


@pytest.mark.parametrize("case", WRONG, ids=WRONG)
def test_wrong_json_is_one_line(tmp_path: Path, case: str):
    text, words = WRONG[case]
    path = tmp_path / "m.json"
    path.write_text(text)
    with pytest.raises(brdf.InputError) as caught:
        brdf.load_material(path)
    assert str(caught.value).startswith(str(path))
    assert words in str(caught.value)


WRONG_MTL = {
    "nothing": ("# none\n", "holds no material"),
    "before": ("Kd 1 1 1\n", "line 1: has Kd before any newmtl"),
    "words": ("newmtl a\nKd red\n", "line 2: Kd must be numbers"),
    "nan": ("newmtl a\nKd nan 0 0\n", "line 2: Kd must be finite"),
    "two": ("newmtl a\nKd 1 2\n", "line 2: Kd has 2 values"),
    "negative": ("newmtl a\nKd -1 0 0\n", "k_d: must be at least 0, got -1 in channel 0"),
    "exponent": ("newmtl a\nKs 1 1 1\nNs -3\n", "must be at least 0, got -3"),
    "twice": ("newmtl a\nKd 1 1 1\nnewmtl a\nKd 0 0 0\n", "line 3: names the material a a second time"),
    "several": ("newmtl a\nKd 1 1 1\nnewmtl b\nKd 1 1 1\n", "holds 2 materials"),
}


@pytest.mark.parametrize("case", WRONG_MTL, ids=WRONG_MTL)
def test_wrong_mtl_is_one_line(tmp_path: Path, case: str):
    text, words = WRONG_MTL[case]
    path = tmp_path / "m.mtl"
    path.write_text(text)
    with pytest.raises(brdf.InputError) as caught:
        brdf.load_material(path)
    assert str(caught.value).startswith(str(path))
    assert words in str(caught.value)


@pytest.mark.parametrize("name", ["m.json", "m.mtl"])
def test_a_byte_order_mark_is_no_content(tmp_path: Path, name: str):
    brdf.save_material(brdf.Lambert(k_d=[0.5, 0.4, 0.3]), tmp_path / name)
    text = (tmp_path / name).read_bytes()
    (tmp_path / name).write_bytes(b"\xef\xbb\xbf" + text)
    np.testing.assert_allclose(brdf.load_material(tmp_path / name).k_d, [0.5, 0.4, 0.3])
