"""What an export says of the brightness of the highlight, against what the other program shows."""

import ast
import json
import re

import numpy as np
import pytest

import brdf

RGB = {"k_a": [0.1, 0.2, 0.3], "k_d": [0.5, 0.4, 0.3], "k_s": [0.3, 0.35, 0.4]}
WITH_HIGHLIGHT = [
    model(**RGB, n=24.0) for model in (brdf.Phong, brdf.BlinnPhong, brdf.NormalizedPhong, brdf.NormalizedBlinnPhong)
]


def told(material: brdf.Material, to: str) -> np.ndarray:
    """The two ratios that the export states; 1 and 1 where it states none."""
    pattern = r"surface comes out ([\d.]+) times .* normal, ([\d.]+) times where they stand 60° from it"
    found = [re.search(pattern, loss) for loss in brdf.export_material(material, to).losses]
    numbers = [match.groups() for match in found if match]
    assert len(numbers) <= 1
    return np.array(numbers[0] if numbers else (1, 1), float)


def mirrored(degrees: float) -> tuple[np.ndarray, np.ndarray]:
    """Light and view that mirror each other about the normal +z."""
    angle = np.radians(degrees)
    light = np.array([np.sin(angle), 0.0, np.cos(angle)])
    return light, light * [-1, 1, 1]


def shown(material: brdf.Material, degrees: float) -> np.ndarray:
    """The radiance of the material under a light of intensity 1 there."""
    light, view = mirrored(degrees)
    return np.pi * np.asarray(material.reflectance(light, view)) * light[2]


@pytest.mark.parametrize("material", WITH_HIGHLIGHT, ids=lambda m: m.name)
def test_mitsuba_shows_what_is_told(material: brdf.Material):
    mitsuba = pytest.importorskip("mitsuba")
    mitsuba.set_variant("scalar_rgb")
    plugin = mitsuba.load_dict(json.loads(brdf.export_material(material, "mitsuba-dict").text))
    interaction = mitsuba.SurfaceInteraction3f()
    for degrees, ratio in zip(
        (1e-3, 60.0), told(material, "mitsuba"), strict=True
    ):  # Mitsuba evaluates 0 exactly at 0°
        light, view = mirrored(degrees)
        interaction.wi = mitsuba.Vector3f(*view)
        theirs = np.pi * np.array(plugin.eval(mitsuba.BSDFContext(), interaction, mitsuba.Vector3f(*light)))
        np.testing.assert_allclose(theirs.sum() / shown(material, degrees).sum(), ratio, rtol=0.006, atol=0.0051)


@pytest.mark.parametrize("n", [2.0, 24.0, 4000.0])
def test_three_shows_what_is_told(n: float):
    """Its shader: BRDF_BlinnPhong is F (n+2)/(8 π) (N·H)^n (test_exports draws it with three.js itself)."""
    material = brdf.BlinnPhong(k_a=[0.0], k_d=[0.3], k_s=[0.02], n=n)
    words = json.loads(brdf.export_material(material, "three").text)
    colours = [((words[key] & 255) / 255 + 0.055) / 1.055 for key in ("color", "specular")]
    diffuse, specular = (
        colour**2.4 if colour > 0.09 else (words[key] & 255) / 255 / 12.92
        for colour, key in zip(colours, ("color", "specular"), strict=True)
    )
    for degrees, ratio in zip((0.0, 60.0), told(material, "three"), strict=True):
        cosine = np.cos(np.radians(degrees))
        fresnel = np.exp2((-5.55473 * cosine - 6.98316) * cosine)
        theirs = (diffuse + (specular + (1 - specular) * fresnel) * (n + 2) / 8) * cosine
        np.testing.assert_allclose(theirs / shown(material, degrees)[0], ratio, rtol=0.006, atol=0.0051)


@pytest.mark.parametrize("material", WITH_HIGHLIGHT, ids=lambda m: m.name)
def test_gltf_formula_shows_what_is_told(material: brdf.Material):
    """Appendix B of the glTF 2.0 specification, with the names it uses."""
    entry = json.loads(brdf.export_material(material, "gltf").text)["materials"][0]
    c_diff = np.array(entry["pbrMetallicRoughness"]["baseColorFactor"][:3])
    f0 = 0.04 * np.array(entry["extensions"]["KHR_materials_specular"]["specularColorFactor"])
    alpha = entry["pbrMetallicRoughness"]["roughnessFactor"] ** 2
    for degrees, ratio in zip((0.0, 60.0), told(material, "gltf"), strict=True):
        light, view = mirrored(degrees)
        half = (light + view) / np.linalg.norm(light + view)
        n_l, n_v, n_h, v_h = light[2], view[2], half[2], view @ half
        d = alpha**2 / (np.pi * (n_h**2 * (alpha**2 - 1) + 1) ** 2)
        g1 = [2 * x / (x + np.sqrt(alpha**2 + (1 - alpha**2) * x**2)) for x in (n_l, n_v)]
        separable, correlated = g1[0] * g1[1], 1 / (1 / g1[0] + 1 / g1[1] - 1)
        assert separable <= correlated
        fresnel = f0 + (1 - f0) * (1 - v_h) ** 5
        f = (1 - fresnel.max()) * c_diff / np.pi + fresnel * d * correlated / (4 * n_l * n_v)
        np.testing.assert_allclose(
            np.pi * f.sum() * n_l / shown(material, degrees).sum(), ratio, rtol=0.006, atol=0.0051
        )


@pytest.mark.parametrize("material", WITH_HIGHLIGHT, ids=lambda m: m.name)
@pytest.mark.parametrize("to", ["mtl", "pytorch3d"])
def test_classic_formats_show_what_is_told(material: brdf.Material, to: str, tmp_path):
    """Both draw diffuse N·L + specular lobe, and the lobe is 1 at its peak."""
    text = brdf.export_material(material, to).text
    if to == "pytorch3d":
        arguments = ast.literal_eval(text.partition("MATERIALS = ")[2])
        diffuse, specular = (np.array(arguments[f"{key}_color"][0]) for key in ("diffuse", "specular"))
    else:
        rows = {words[0]: words[1:] for words in map(str.split, text.splitlines()) if words}
        diffuse, specular = (np.array(rows[key], float) for key in ("Kd", "Ks"))
    for degrees, ratio in zip((0.0, 60.0), told(material, to), strict=True):
        theirs = diffuse * np.cos(np.radians(degrees)) + specular
        np.testing.assert_allclose(theirs.sum() / shown(material, degrees).sum(), ratio, rtol=0.006, atol=0.0051)


def test_f_0_is_cut_as_viewers_cut_it():
    export = brdf.export_material(brdf.NormalizedBlinnPhong(k_d=[1.5, 0.2, 0.1], k_s=2.0, n=30.0), "gltf")
    specular = json.loads(export.text)["materials"][0]["extensions"]["KHR_materials_specular"]
    assert specular["specularColorFactor"] == [25.0] * 3
    assert "F0 is cut at 1, it would be 2 2 2" in export.losses


@pytest.mark.parametrize("to", ["mtl", "glsl", "pytorch3d"])
def test_name_and_note_are_a_line_each(to: str):
    given = {"name": "a\nKd 9 9 9", "note": "first\r\nnewmtl evil\u2028Kd 7 7 7"}
    plain = {"name": "a", "note": ""}
    text, usual = (brdf.export_material(brdf.preset("gold"), to, **some).text for some in (given, plain))
    assert len(text.splitlines()) == 1 + len(usual.splitlines())


def test_a_classic_form_is_told_what_to_do_about_it():
    losses = " ".join(brdf.export_material(brdf.preset("emerald"), "three").losses)
    assert "--model normalized-blinn-phong" in losses
    assert "--model" not in " ".join(brdf.export_material(WITH_HIGHLIGHT[-1], "three").losses)
    assert "times as bright" not in " ".join(brdf.export_material(brdf.Lambert(k_d=0.5), "three").losses)
