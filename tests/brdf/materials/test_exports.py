"""Materials for other programs: read by those programs, drawn by them, compared with what we draw."""

import ast
import csv
import ctypes.util
import json
import shutil
import subprocess
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from browser_pages import asked, needs_browser
from project_paths import REAL

import brdf
from brdf.materials.exports import EXPORTS

RGB = {"k_a": [0.1, 0.2, 0.3], "k_d": [0.5, 0.4, 0.3], "k_s": [0.3, 0.35, 0.4]}
LAMBERT = brdf.Lambert(k_a=RGB["k_a"], k_d=RGB["k_d"])
MATERIALS = [LAMBERT] + [model(**RGB, n=24.0) for name, model in brdf.MODELS.items() if name != "lambert"]
WIDTH, SIZE, DIRECTION = 2.2, 128, (0.4, 0.5, 0.8)


def ours(material: brdf.Material, intensity: float = 1.0, ambient: float = 0.0) -> np.ndarray:
    """The same ball through the front door."""
    camera = brdf.OrthographicCamera(
        position=[0, 0, 4], target=[0, 0, 0], up=[0, 1, 0], width=WIDTH, resolution=(SIZE, SIZE)
    )
    light = brdf.DirectionalLight(direction=DIRECTION, intensity=[intensity] * 3)
    scene = brdf.Scene(
        camera=camera,
        shapes=(brdf.Sphere(center=[0, 0, 0], radius=1),),
        lights=(light,),
        ambient=[ambient] * 3 if ambient else None,
    )
    return np.asarray(brdf.render(material, scene, precision="float64"))


def inside(rim: float) -> np.ndarray:
    """Pixels of the ball, but for those where N.V is below the rim: their edges are drawn differently."""
    place = (np.arange(SIZE) + 0.5) / SIZE * WIDTH - WIDTH / 2
    return 1 - place**2 - place[:, None] ** 2 > rim**2


# -- presets -----------------------------------------------------------------------------------------------------------


def test_presets_are_the_24_rows_of_the_classic_table():
    path = REAL / "materials/opengl_teapots_materials.csv"
    if not path.exists():
        pytest.skip(f"{path} is missing")
    rows = list(csv.DictReader(path.read_text().splitlines()))
    assert [row["name"] for row in rows] == list(brdf.PRESETS)
    for row in rows:
        material = brdf.preset(row["name"])
        for key in ("k_a", "k_d", "k_s"):
            expected = [float(row[f"{key.replace('_', '')}_{channel}"]) for channel in "rgb"]
            np.testing.assert_array_equal(np.asarray(getattr(material, key)), expected)
        np.testing.assert_allclose(float(material.n), float(row["exponent_x128"]), rtol=1e-15)


def test_presets_are_found_as_people_write_them():
    assert float(brdf.preset("Cyan Plastic").n) == 32.0
    with pytest.raises(brdf.InputError, match=r"preset: is unknown, got 'unobtainium'\. Use one of emerald"):
        brdf.preset("unobtainium")


# -- what every format promises ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("to", EXPORTS)
@pytest.mark.parametrize("material", MATERIALS, ids=lambda m: m.name)
def test_every_export_says_what_it_loses(material: brdf.Material, to: str, tmp_path: Path):
    export = brdf.save_export(material, tmp_path / "m.any", to=to, name="a_name")
    assert (tmp_path / "m.any").read_text() == export.text
    exact = {"json": True, "glsl": True, "mtl": material.name in ("lambert", "blinn-phong")}
    exact |= {"pytorch3d": material.name in ("lambert", "phong")}
    assert bool(export.losses) == (not exact.get(to, False))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"path": "m.obj"}, r"m\.obj: does not say its format, got \.obj\. Name it"),
        ({"path": "m.obj", "to": "fbx"}, r"to: is unknown, got 'fbx'\. Use one of json"),
    ],
)
def test_wrong_formats_are_named(arguments: dict[str, Any], message: str, tmp_path: Path):
    arguments["path"] = tmp_path / arguments["path"]
    with pytest.raises(brdf.InputError, match=message):
        brdf.save_export(LAMBERT, **arguments)
    assert not list(tmp_path.iterdir())


def test_spectra_go_to_json_alone():
    spectrum = brdf.Lambert(k_d=np.linspace(0, 1, 31))
    assert len(json.loads(brdf.export_material(spectrum, "json").text)["k_d"]) == 31
    with pytest.raises(brdf.InputError, match="has 31 channels, three knows RGB alone"):
        brdf.export_material(spectrum, "three")


def test_one_channel_becomes_grey():
    assert "vec3(0.25, 0.25, 0.25)" in brdf.export_material(brdf.Lambert(k_d=0.25), "glsl").text


@pytest.mark.parametrize("material", MATERIALS, ids=lambda m: m.name)
def test_mtl_gives_mirror_lobes_the_exponent_of_their_half_vector(material: brdf.Material, tmp_path: Path):
    text = brdf.export_material(material, "mtl", name="shiny").text
    assert "newmtl shiny" in text
    expected = {"lambert": None, "phong": 96.0, "normalized-phong": 96.0}.get(material.name, 24.0)
    assert (f"Ns {expected}" in text) == (expected is not None)
    (tmp_path / "m.mtl").write_text(text)
    read = brdf.load_material(tmp_path / "m.mtl")
    assert type(read) is type(material)
    np.testing.assert_allclose(ours(read), ours(material), rtol=1e-12)


# -- PyTorch3D ---------------------------------------------------------------------------------------------------------


def pytorch3d_shading(arguments: dict[str, Any], ambient: float, light: np.ndarray) -> np.ndarray:
    """What `pytorch3d.renderer.mesh.shading._apply_lighting` and `renderer.lights` compute (version 0.7), in NumPy."""
    place = (np.arange(SIZE) + 0.5) / SIZE * WIDTH - WIDTH / 2
    x, y = np.meshgrid(place, -place)
    normal = np.stack([x, y, np.sqrt(np.maximum(1 - x * x - y * y, 0))], -1)
    light = light / np.linalg.norm(light)
    cosine = normal @ light
    reflected = -light + 2 * cosine[..., None] * normal
    alpha = np.maximum(reflected[..., 2], 0) * (cosine > 0)
    ambient_color, diffuse, specular = (np.asarray(arguments[f"{k}_color"]) for k in ("ambient", "diffuse", "specular"))
    image = ambient_color * ambient + diffuse * np.maximum(cosine, 0)[..., None]
    return image + specular * alpha[..., None] ** arguments["shininess"]


@pytest.mark.parametrize("material", MATERIALS[:2], ids=lambda m: m.name)
def test_pytorch3d_arguments_give_its_picture(material: brdf.Material):
    text = brdf.export_material(material, "pytorch3d").text
    arguments = ast.literal_eval(text.partition("MATERIALS = ")[2])
    drawn = pytorch3d_shading(arguments, 0.3, np.array(DIRECTION))
    np.testing.assert_allclose(drawn[inside(0.01)], ours(material, ambient=0.3)[inside(0.01)], atol=1e-12)


# -- GLSL --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("head", ["#version 100\nprecision highp float;\n", "#version 330\n", "#version 450\n"])
@pytest.mark.parametrize("material", MATERIALS, ids=lambda m: m.name)
def test_glsl_compiles(material: brdf.Material, head: str, tmp_path: Path):
    compiler = shutil.which("glslangValidator")
    if compiler is None:
        pytest.skip("glslangValidator is missing: apt-get install glslang-tools")
    old = "100" in head
    path = tmp_path / "shader.frag"
    main = "void main() { COLOUR = vec4(brdf_ambient(vec3(1.0)) + brdf_light(n, l, v, vec3(1.0)), 1.0); }\n"
    outputs = "" if old else "layout(location = 0) out vec4 colour;\n"
    inputs = "".join(
        f"{'varying' if old else f'layout(location = {i}) in' if '450' in head else 'in'} vec3 {name};\n"
        for i, name in enumerate("nlv")
    )
    main = main.replace("COLOUR", "gl_FragColor" if old else "colour")
    path.write_text(head + inputs + outputs + brdf.export_material(material, "glsl").text + main)
    done = subprocess.run([compiler, str(path)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout


@pytest.mark.parametrize("n", [0.5, 24.0, 1e6])
@pytest.mark.parametrize("model", brdf.MODELS.values(), ids=lambda model: model.name)
def test_glsl_draws_our_ball(model: type[brdf.Material], n: float):
    if ctypes.util.find_library("OSMesa") is None:
        pytest.skip("libOSMesa is missing: apt-get install libosmesa6")
    glsl_ball = pytest.importorskip("drawing.glsl_ball", reason="PyOpenGL is missing", exc_type=ImportError)
    material = LAMBERT if model is brdf.Lambert else model(**RGB, n=n)
    lamp = {"direction": DIRECTION, "intensity": [0.9] * 3, "ambient": [0.3] * 3}
    text = brdf.export_material(material, "glsl").text
    drawn = glsl_ball.draw_ball(text, size=SIZE, width=WIDTH, **lamp)
    expected = ours(material, intensity=0.9, ambient=0.3)
    # Single precision: normals are rounded to 6e-8, over which a lobe of n = 1e6 falls by 6e-8 n tan(angle) of itself.
    error = np.abs(drawn - expected)[inside(0.02)] / expected.max()
    assert error.max() < (2e-2 if n > 1e5 else 1e-5)


# -- three.js ----------------------------------------------------------------------------------------------------------


def three(tmp_path: Path, **job: Any) -> tuple[np.ndarray, dict[str, Any]]:
    """The ball as three.js draws it, and what its loader made of the material."""
    pi = np.pi  # three.js counts irradiance: a white Lambertian surface facing a light of intensity pi shows 1
    job = {"size": SIZE, "width": WIDTH, "direction": DIRECTION, "intensity": [pi] * 3, "ambient": [0.0] * 3} | job
    answer = asked("three_ball", job, tmp_path / "picture.bin")
    picture = np.fromfile(tmp_path / "picture.bin", np.float32).reshape(SIZE, SIZE, 3)
    return picture, answer


@needs_browser
@pytest.mark.parametrize(
    ("material", "exact", "tolerance"),
    [
        (LAMBERT, False, 1e-2),  # 8-bit colours: half a code is 0.4 % of a value near 0.3
        (
            MATERIALS[-1],
            True,
            5e-3,
        ),  # the Fresnel term, 1e-4 at this angle, and the rasteriser's 1/256 pixel at the rim
    ],
    ids=["8-bit", "exact"],
)
def test_three_draws_our_ball_where_the_models_agree(
    material: brdf.Material, exact: bool, tolerance: float, tmp_path: Path
):
    words = json.loads(brdf.export_material(material, "three").text)
    drawn, loaded = three(tmp_path, material=words, exact=exact)
    assert loaded["material"]["type"] == ("MeshLambertMaterial" if material is LAMBERT else "MeshPhongMaterial")
    expected = ours(material)
    assert (np.abs(drawn - expected)[inside(0.1)] / expected.max()).max() < tolerance


@needs_browser
def test_three_differs_from_the_classic_form_by_what_is_said(tmp_path: Path):
    """Its highlight has the factors N.L and (n+2)/8 and Schlick's Fresnel term: put them in, and the pictures agree."""
    material = brdf.BlinnPhong(k_d=RGB["k_d"], k_s=RGB["k_s"], n=24.0)
    direction = (0.9, 0.3, -0.4)  # from behind: the Fresnel term is large
    words = json.loads(brdf.export_material(material, "three").text)
    drawn, _ = three(tmp_path, material=words, exact=True, direction=direction)
    light = np.array(direction) / np.linalg.norm(direction)
    view = np.array([0.0, 0.0, 1.0])
    half = (light + view) / np.linalg.norm(light + view)
    place = (np.arange(SIZE) + 0.5) / SIZE * WIDTH - WIDTH / 2
    x, y = np.meshgrid(place, -place)
    normal = np.stack([x, y, np.sqrt(np.maximum(1 - x * x - y * y, 0))], -1)
    cosine = np.maximum(normal @ light, 0)[..., None]
    fresnel = np.exp2((-5.55473 * half[2] - 6.98316) * half[2])
    specular = np.array(words["userData"]["linear"]["specular"])
    lobe = 26 / 8 * np.maximum(normal @ half, 0)[..., None] ** 24
    expected = cosine * (words["userData"]["linear"]["color"] + (specular * (1 - fresnel) + fresnel) * lobe)
    error = np.abs(drawn - expected)[inside(0.2)] / expected.max()
    assert error.max() < 5e-3  # the faces near the rim


@needs_browser
def test_three_loads_the_gltf(tmp_path: Path):
    material = brdf.NormalizedBlinnPhong(k_d=RGB["k_d"], k_s=[0.06, 0.05, 0.04], n=24.0)
    words = json.loads(brdf.export_material(material, "gltf").text)
    drawn, loaded = three(tmp_path, gltf=words)
    assert loaded["material"]["type"] == "MeshPhysicalMaterial"
    np.testing.assert_allclose(loaded["material"]["roughness"], (2 / 26) ** 0.25)
    assert loaded["material"]["metalness"] == 0
    # An approximation, as it says. Measured: 6 % of the brightest value at worst, 2 % in the median.
    error = np.abs(drawn - ours(material))[inside(0.3)] / ours(material).max()
    assert np.median(error) < 0.03
    assert error.max() < 0.1


@needs_browser
@pytest.mark.parametrize("format", ["three", "gltf"])
@pytest.mark.parametrize(
    "material", [LAMBERT, brdf.BlinnPhong(k_d=RGB["k_d"], k_s=[0, 0, 0], n=50.0)], ids=["Lambert", "k_s of 0"]
)
def test_what_has_no_highlight_gets_none_from_grazing_light(format: str, material: brdf.Material, tmp_path: Path):
    """A Fresnel term made one, up to five times as bright as the ball, and with n = 50 a hundred times."""
    direction = np.array([0.9, 0.3, -0.4])
    words = json.loads(brdf.export_material(material, format).text)
    job = {"material": words, "exact": True} if format == "three" else {"gltf": words}
    drawn, _ = three(tmp_path, direction=direction.tolist(), **job)
    place = (np.arange(SIZE) + 0.5) / SIZE * WIDTH - WIDTH / 2
    x, y = np.meshgrid(place, -place)
    normal = np.stack([x, y, np.sqrt(np.maximum(1 - x * x - y * y, 0))], -1)
    cosine = np.maximum(normal @ direction / np.linalg.norm(direction), 0)[..., None]
    expected = cosine * np.asarray(material.k_d)
    assert (np.abs(drawn - expected)[inside(0.2)] / expected.max()).max() < 1e-2


# -- Mitsuba -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("n", [8.0, 100.0, 3000.0])
def test_mitsuba_evaluates_nearly_our_lobe(n: float):
    mitsuba = pytest.importorskip("mitsuba")
    mitsuba.set_variant("scalar_rgb")
    material = brdf.NormalizedBlinnPhong(k_d=RGB["k_d"], k_s=RGB["k_s"], n=n)
    from_dict = mitsuba.load_dict(json.loads(brdf.export_material(material, "mitsuba-dict").text))
    text = brdf.export_material(material, "mitsuba").text
    from_xml = mitsuba.load_string(text).bsdf() if hasattr(mitsuba.load_string(text), "bsdf") else None
    interaction = mitsuba.SurfaceInteraction3f()
    worst = 0.0
    for degrees in np.linspace(-40, 40, 33):
        light, view = (np.array([np.sin(a), 0, np.cos(a)]) for a in np.radians([10.0, degrees]))
        interaction.wi = mitsuba.Vector3f(*view)
        value = np.array(from_dict.eval(mitsuba.BSDFContext(), interaction, mitsuba.Vector3f(*light))) / light[2]
        if from_xml is not None:
            again = np.array(from_xml.eval(mitsuba.BSDFContext(), interaction, mitsuba.Vector3f(*light))) / light[2]
            np.testing.assert_allclose(again, value, rtol=1e-6)
        expected = np.asarray(material.reflectance(light, view))
        worst = max(worst, float(np.max(np.abs(value - expected))))
    mirrored = [np.array([side * np.sin(np.radians(10)), 0, np.cos(np.radians(10))]) for side in (1, -1)]
    peak = np.max(np.asarray(material.reflectance(*mirrored)))
    # cos^n and Beckmann differ by O(1/n), the constants (n+4) and (n+2) by 2/n, 1/cos^2 at 10 degrees is 3 %.
    assert worst < (0.05 + 3 / n) * peak


def test_mitsuba_reads_lambert_exactly():
    mitsuba = pytest.importorskip("mitsuba")
    mitsuba.set_variant("scalar_rgb")
    plugin = mitsuba.load_dict(json.loads(brdf.export_material(brdf.Lambert(k_d=RGB["k_d"]), "mitsuba-dict").text))
    interaction = mitsuba.SurfaceInteraction3f()
    interaction.wi = mitsuba.Vector3f(0, 0, 1)
    value = plugin.eval(mitsuba.BSDFContext(), interaction, mitsuba.Vector3f(0, 0, 1))
    np.testing.assert_allclose(np.array(value) * np.pi, RGB["k_d"], rtol=1e-6)


def test_a_note_in_a_mitsuba_scene_leaves_it_readable():
    text = brdf.export_material(LAMBERT, "mitsuba", note="only 0.2 k_a --- see --plausible").text
    assert ElementTree.fromstring(text).tag == "scene"
    assert "see plausible" in text
