"""Material files as other programs write them, and far too large: read as they mean it, or one line says why not."""

import json

import numpy as np
import pytest

import brdf
from brdf.errors import InputError


def load(tmp_path, content: bytes | str, suffix: str = ".mtl") -> brdf.Material:
    path = tmp_path / f"a{suffix}"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return brdf.load_material(path)


@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
@pytest.mark.parametrize("start", ["", "\ufeff", "\t", "# a comment that ends so \\\n"])
def test_lines_of_an_mtl_file_may_go_on(tmp_path, start, end):
    text = (
        start + "newmtl\ta b # first\nKd 1 \\\n\t0.5 0.25 # red\nKs 1 \\\n1 \\\n 1\nNs \\\n 30\nd 1\nmap_Kd a.png\n\\"
    )
    material = load(tmp_path, text.replace("\n", end))
    assert isinstance(material, brdf.BlinnPhong)
    np.testing.assert_array_equal(material.k_d, [1, 0.5, 0.25])
    assert float(material.n) == 30


REFUSED = {
    "UTF-16": ("newmtl a\nKd 1 1 1\n".encode("utf-16"), r"not UTF-8 text \(line 1: .*saved as UTF-8"),
    "UTF-16 without a mark": ("newmtl a\nKd 1 1 1\n".encode("utf-16-be"), "null bytes"),
    "Latin-1": ("newmtl a\nnewmtl café\n".encode("latin-1"), r"not UTF-8 text \(line 2: "),
    "a texture alone": (
        "newmtl a\nmap_Kd -s 2 2 2 wood.png\n",
        r"material a\.Kd: is missing beside the texture wood\.png, .*Add",
    ),
    "no value": ("newmtl a\nKd\n", r"line 2: Kd has 0 values\. Give 1 or 3"),
    "illum": ("newmtl a\nillum two\n", r"line 2: illum must be numbers, got 'two'\. Give one number"),
    "comma": ("newmtl a\nKd 0,5 0,5 0,5\n", r"line 2: Kd must be numbers, got '0,5 0,5 0,5'\. Give RGB values\.$"),
    "xyz": ("newmtl a\nKd xyz 0.3 0.4 0.5\n", "spectral curves and XYZ are not read"),
    "after a joined line": ("newmtl a\nKd 1 \\\n1 1\nKd 1 1\n", r"line 4: Kd has 2 values"),
    "joined": ("newmtl a\nKd 1 \\\n1\n", r"line 2: Kd has 2 values"),
    "underscore": ("newmtl a\nKd 1_0 1 1\n", "must be numbers, got '1_0 1 1'"),
    "other digits": ("newmtl a\nKd ٣ 1 1\n", "must be numbers"),
    "many": (
        "".join(f"newmtl m{i}\nKd 1 1 1\n" for i in range(300)),
        r"300 materials\. Name one of .* m9 or another\.$",
    ),
    "long name": (f"newmtl {'x' * 999}\nKd 1 1 1\n" * 2, r"names the material x{40} a second time"),
    "large": (b"newmtl a\n" * 600_000, "is larger than 4 MiB"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_an_mtl_file_that_is_refused(tmp_path, name):
    content, said = REFUSED[name]
    with pytest.raises(InputError, match=said) as told:
        load(tmp_path, content)
    assert str(told.value).startswith(str(tmp_path / "a.mtl"))
    assert len(str(told.value)) < 500


@pytest.mark.parametrize("spoiled", ["newmtl a\nmap_Kd wood.png\n", "newmtl a\nKd 1 1 1\nKs 1 1 1\nNs -5\n"])
def test_what_is_wrong_with_one_material_keeps_nobody_from_another(tmp_path, spoiled):
    (tmp_path / "a.mtl").write_text(spoiled + "newmtl b\nKd 0.5 0.25 0.5\n")
    np.testing.assert_array_equal(brdf.load_material(tmp_path / "a.mtl", "b").k_d, [0.5, 0.25, 0.5])
    for refused in (lambda path: brdf.load_material(path, "a"), brdf.load_materials):
        with pytest.raises(InputError, match=r"a\.mtl: material a\.(Kd|Ns): "):
            refused(tmp_path / "a.mtl")
    with pytest.raises(InputError, match="holds 2 materials"):
        brdf.load_material(tmp_path / "a.mtl")


def test_more_channels_than_a_spectrum_has(tmp_path):
    text = json.dumps({"model": "lambert", "k_d": [0.5] * 5000})
    with pytest.raises(InputError, match=r"k_d: has 5000 channels\. Give at most 4096"):
        load(tmp_path, text, ".json")
    assert load(tmp_path, text.replace("0.5, ", "", 1000), ".json").k_d.shape == (4000,)


def test_the_key_given_twice_is_found_among_many(tmp_path):
    keys = ", ".join(f'"x{index}": 1' for index in range(2_000))
    with pytest.raises(InputError, match="k_d: is given twice"):
        load(tmp_path, f'{{"model": "lambert", {keys}, "k_d": [1], "k_d": [0]}}', ".json")
