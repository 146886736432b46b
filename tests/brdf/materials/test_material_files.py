"""Material files: what is written reads back; what others wrote is read as they mean it, or one line says why not."""

import json
from pathlib import Path

import numpy as np
import pytest
from project_paths import REAL

import brdf

K = {"k_a": [0.1, 0.2, 1 / 3], "k_d": [0.5, 0.4, 0.0], "k_s": [0.3, 0.25, 1e-7]}
MATERIALS = [
    brdf.Lambert(k_a=K["k_a"], k_d=K["k_d"]),
    *[model(**K, n=37.123456789012345) for name, model in brdf.MODELS.items() if name != "lambert"],
]


def same(a: brdf.Material, b: brdf.Material, rtol: float = 0.0) -> bool:
    return type(a) is type(b) and all(
        np.allclose(value, getattr(b, key), rtol=rtol, atol=0) for key, value in vars(a).items()
    )


def load(tmp_path: Path, content: bytes | str, suffix: str) -> brdf.Material:
    path = tmp_path / f"a{suffix}"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return brdf.load_material(path)


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
    brdf.save_material(material, tmp_path / "m.mtl", undetermined={"n": ""})
    assert "# not determined by the picture: n\n" in (tmp_path / "m.mtl").read_text()


@pytest.mark.parametrize("name", ["m.json", "m.mtl"])
def test_a_byte_order_mark_is_no_content(tmp_path: Path, name: str):
    brdf.save_material(brdf.Lambert(k_d=[0.5, 0.4, 0.3]), tmp_path / name)
    text = (tmp_path / name).read_bytes()
    (tmp_path / name).write_bytes(b"\xef\xbb\xbf" + text)
    np.testing.assert_allclose(brdf.load_material(tmp_path / name).k_d, [0.5, 0.4, 0.3])


# -- other programs ----------------------------------------------------------------------------------------------------


def test_another_program_reads_the_mtl(tmp_path: Path):
    pytest.importorskip("trimesh", reason="trimesh is not installed (extra: interop)")
    from trimesh.exchange.obj import parse_mtl

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


@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
@pytest.mark.parametrize("start", ["", "\ufeff", "\t", "# a comment that ends so \\\n"])
def test_lines_of_an_mtl_file_may_go_on(tmp_path: Path, start: str, end: str):
    text = (
        start + "newmtl\ta b # first\nKd 1 \\\n\t0.5 0.25 # red\nKs 1 \\\n1 \\\n 1\nNs \\\n 30\nd 1\nmap_Kd a.png\n\\"
    )
    material = load(tmp_path, text.replace("\n", end), ".mtl")
    assert isinstance(material, brdf.BlinnPhong)
    np.testing.assert_array_equal(material.k_d, [1, 0.5, 0.25])
    assert float(material.n) == 30


@pytest.mark.parametrize(
    ("text", "model"),
    [
        ("newmtl a\nKd .5\nKs .2\nNs 2\n", brdf.BlinnPhong),
        ("newmtl a\nKd .5 .5 .5\n", brdf.Lambert),
        ("newmtl a\nKd .5 .5 .5\nKs .1 .1 .1 \\", brdf.BlinnPhong),
        ("newmtl a\nKd .5 .5 .5\nKs 1 1 1\nillum 1\n", brdf.Lambert),
        ("# brdf model: normalized-phong\nnewmtl a\nKd .5 .5 .5\nNs 8\n", brdf.NormalizedPhong),
        ("# brdf model: lambert\nnewmtl a\nKd .5 .5 .5\nKs 1 1 1\n", brdf.Lambert),
    ],
)
def test_what_an_mtl_file_says_is_the_model_it_means(tmp_path: Path, text: str, model: type[brdf.Material]):
    material = load(tmp_path, text, ".mtl")
    assert type(material) is model
    np.testing.assert_array_equal(material.k_d, [0.5] * 3)


def test_a_comment_names_the_model_of_the_next_material_alone(tmp_path: Path):
    brdf.save_material(MATERIALS[1], tmp_path / "phong.mtl")
    brdf.save_material(MATERIALS[2], tmp_path / "blinn.mtl")
    both = (tmp_path / "phong.mtl").read_text() + (tmp_path / "blinn.mtl").read_text().replace("fitted", "other")
    (tmp_path / "both.mtl").write_text(both)
    read = brdf.load_materials(tmp_path / "both.mtl")
    assert [type(material) for material in read.values()] == [brdf.Phong, brdf.BlinnPhong]


# -- malformed materials -----------------------------------------------------------------------------------------------

LIMIT_OF_CHANNELS = json.dumps({"model": "lambert", "k_d": [0.5] * 5000})

MALFORMED = {
    "list": (".json", "[1]", "a.json: must be a JSON object"),
    "no JSON": (".json", "{", "is not JSON"),
    "nested too deeply": (".json", "[" * 100_000, "is not JSON"),
    "number of 5,000 digits": (".json", '{"model": "lambert", "k_d": %s}' % ("9" * 5000), "is not JSON"),
    "no model": (".json", "{}", "a.json: has no model. Add model = one of lambert, phong"),
    "unknown model": (".json", '{"model": "ward"}', "model: is unknown, got 'ward'"),
    "a model of null": (".json", '{"model": null}', "model: is unknown, got None"),
    "unknown key": (
        ".json",
        '{"model": "lambert", "k_d": [1], "gloss": 1}',
        "a.json: gloss: is not a known key. Known here: k_a, k_d.",
    ),
    "key of another model": (
        ".json",
        '{"model": "lambert", "k_d": [1], "n": 3}',
        "n: is not a known key. Known here: k_a, k_d.",
    ),
    "missing": (".json", '{"model": "phong", "k_d": [1], "n": 3}', "a.json: has no k_s. Add k_s"),
    "negative": (".json", '{"model": "lambert", "k_d": [0.5, -0.2]}', "k_d: must be at least 0, got -0.2 in channel 1"),
    "not a number": (".json", '{"model": "lambert", "k_d": [NaN]}', "k_d: must be finite"),
    "words": (".json", '{"model": "lambert", "k_d": ["red"]}', "k_d: must be a number"),
    "truth": (".json", '{"model": "lambert", "k_d": [true]}', "k_d: must be a number, got true"),
    "nested": (".json", '{"model": "lambert", "k_d": [[1]]}', "k_d: must be a number"),
    "empty": (".json", '{"model": "lambert", "k_d": []}', "k_d: must be a number per channel"),
    "two n": (".json", '{"model": "phong", "k_d": [1], "k_s": [1], "n": [1, 2]}', "n: must be one number"),
    "channels": (".json", '{"model": "lambert", "k_a": [1, 2], "k_d": [1, 2, 3]}', "number of channels"),
    "many channels": (".json", LIMIT_OF_CHANNELS, "k_d: has 5000 entries. Give at most 4096."),
    "key twice": (".json", '{"model": "lambert", "k_d": [1], "k_d": [0]}', "a.json: k_d: is given twice"),
    "unknown n": (
        ".json",
        '{"model": "phong", "k_d": [1], "k_s": [1], "n": null}',
        "n: is null (not determined) although k_s is not 0",
    ),
    "no material": (".mtl", "# none\n", "holds no material"),
    "before newmtl": (".mtl", "Kd 1 1 1\n", "line 1: has Kd before any newmtl"),
    "colour names": (".mtl", "newmtl a\nKd red\n", "line 2: Kd must be numbers"),
    "illum": (".mtl", "newmtl a\nillum two\n", "line 2: illum must be numbers, got 'two'. Give one number."),
    "comma": (".mtl", "newmtl a\nKd 0,5 0,5\n", "line 2: Kd must be numbers, got '0,5 0,5'. Give RGB values."),
    "underscore": (".mtl", "newmtl a\nKd 1_0 1 1\n", "must be numbers, got '1_0 1 1'"),
    "other digits": (".mtl", "newmtl a\nKd ٣ 1 1\n", "must be numbers"),
    "CIE XYZ": (".mtl", "newmtl a\nKd xyz 0.3 0.4 0.5\n", "spectral curves and XYZ are not read"),
    "MTL not a number": (".mtl", "newmtl a\nKd nan 0 0\n", "line 2: Kd must be finite numbers, got 'nan 0 0'"),
    "two values": (".mtl", "newmtl a\nKd 1 2\n", "line 2: Kd has 2 values. Give 1 or 3."),
    "no value": (".mtl", "newmtl a\nKd\n", "line 2: Kd has 0 values. Give 1 or 3."),
    "joined": (".mtl", "newmtl a\nKd 1 \\\n1\n", "line 2: Kd has 2 values"),
    "after a joined line": (".mtl", "newmtl a\nKd 1 \\\n1 1\nKd 1 1\n", "line 4: Kd has 2 values"),
    "MTL negative": (".mtl", "newmtl a\nKd -1 0 0\n", "a.mtl: material a.k_d: must be at least 0, got -1 in channel 0"),
    "negative exponent": (".mtl", "newmtl a\nKs 1 1 1\nNs -3\n", "Ns: must be at least 0, got -3"),
    "texture alone": (
        ".mtl",
        "newmtl a\nmap_Kd -s 2 2 2 wood.png\n",
        "material a.Kd: is missing beside the texture wood.png, which is not read. Add the mean colour as Kd.",
    ),
    "unknown model in a comment": (".mtl", "# brdf model: ward\nnewmtl a\nKd 1 1 1\n", "model: is unknown, got 'ward'"),
    "name twice": (".mtl", "newmtl a\nKd 1 1 1\nnewmtl a\n", "line 3: names the material a a second time"),
    "long name twice": (".mtl", f"newmtl {'x' * 999}\n" * 2, f"names the material {'x' * 40} a second time"),
    "several": (".mtl", "newmtl a\nKd 1 1 1\nnewmtl b\nKd 1 1 1\n", "holds 2 materials. Name one of a, b."),
    "many": (
        ".mtl",
        "".join(f"newmtl m{i}\nKd 1 1 1\n" for i in range(300)),
        "holds 300 materials. Name one of m0, m1, m2, m3, m4, m5, m6, m7, m8, m9 or another.",
    ),
    "UTF-16": (".mtl", "newmtl a\n".encode("utf-16"), "is not UTF-8 text (line 1: "),
    "UTF-16 without a mark": (".mtl", "newmtl a\n".encode("utf-16-be"), "is not UTF-8 text (it holds null bytes)"),
    "Latin-1": (".mtl", "newmtl a\nnewmtl café\n".encode("latin-1"), "is not UTF-8 text (line 2: "),
    "large": (".mtl", b"newmtl a\n" * 600_000, "is larger than 4 MiB"),
    "another format": (".obj", "newmtl a\n", "is no material file, got .obj. Give a .json or .mtl file."),
    "no suffix": ("", "newmtl a\n", "is no material file, got no suffix"),
}


@pytest.mark.parametrize(("suffix", "content", "message"), MALFORMED.values(), ids=MALFORMED)
def test_a_malformed_material_is_one_line(tmp_path: Path, suffix: str, content: bytes | str, message: str):
    with pytest.raises(brdf.InputError) as caught:
        load(tmp_path, content, suffix)
    told = str(caught.value)
    assert told.startswith(f"{tmp_path / 'a'}{suffix}: ")
    assert message in told
    assert len(told) < 500


def test_as_many_channels_as_a_spectrum_has(tmp_path: Path):
    assert load(tmp_path, LIMIT_OF_CHANNELS.replace("0.5, ", "", 1000), ".json").k_d.shape == (4000,)


def test_a_suffix_that_holds_no_material_is_not_written(tmp_path: Path):
    with pytest.raises(brdf.InputError, match=r"is no material file, got \.txt\. Name it \.json or \.mtl"):
        brdf.save_material(MATERIALS[0], tmp_path / "m.txt")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("spoiled", ["newmtl a\nmap_Kd wood.png\n", "newmtl a\nKd 1 1 1\nKs 1 1 1\nNs -5\n"])
def test_what_is_wrong_with_one_material_keeps_nobody_from_another(tmp_path: Path, spoiled: str):
    (tmp_path / "a.mtl").write_text(spoiled + "newmtl b\nKd 0.5 0.25 0.5\n")
    np.testing.assert_array_equal(brdf.load_material(tmp_path / "a.mtl", "b").k_d, [0.5, 0.25, 0.5])
    for refused in (lambda path: brdf.load_material(path, "a"), brdf.load_materials):
        with pytest.raises(brdf.InputError, match=r"a\.mtl: material a\.(Kd|Ns): "):
            refused(tmp_path / "a.mtl")
    with pytest.raises(brdf.InputError, match="holds 2 materials"):
        brdf.load_material(tmp_path / "a.mtl")
    with pytest.raises(brdf.InputError, match=r"has no material 'c'\. It holds a, b"):
        brdf.load_material(tmp_path / "a.mtl", "c")
