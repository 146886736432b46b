"""scene.toml: what is written reads back the same, and what is wrong is one line that names file, table and key."""

import re
from pathlib import Path

import jax
import numpy as np
import pytest

import brdf
from benchmarks.fuzz_corpus import CAMERA, LIGHT, POINT, SPHERE
from brdf.geometry.triangles import Mesh
from brdf.images.writing import write_layers

FULL = """
[camera]
type = "perspective"
position = [0.0, 0.5, 4.0]
target = [0.0, 0.0, 0.0]
up = [0.0, 1.0, 0.0]
fov = 36.0
resolution = [40, 30]
viewer = "infinite"

[[shapes]]
type = "sphere"
center = [0.0, 0.0, 0.0]
radius = 1.0

[[shapes]]
type = "rectangle"
center = [0.0, 0.0, -2.0]
edge_u = [2.0, 0.0, 0.0]
edge_v = [0.0, 2.0, 0.0]
fitted = false

[ambient]
intensity = [0.2, 0.3, 0.4]

[[lights]]
type = "directional"
direction = [0.5, 0.6, 0.7]
intensity = [1.0, 0.9, 0.8]

[[lights]]
type = "point"
position = [1.0, 2.0, 3.0]
intensity = [5.0, 5.0, 5.0]
attenuation = [1.0, 0.1, 0.01]
"""

SHORT = """
[camera]
type = "orthographic"
position = [0, 0, 4]
target = [0, 0, 0]
up = [0, 1, 0]
width = 2.2
resolution = [16, 16]

[[shapes]]
type = "sphere"
center = [0, 0, 0]
radius = 1

[ambient]
intensity = [0.1, 0.1, 0.1]

[[lights]]
type = "directional"
direction = [0, 0, 1]
intensity = [1, 1, 1]
"""


LIT = """
[camera]
type = "orthographic"
position = [0, 0, 4]
target = [0, 0, 0]
up = [0, 1, 0]
width = 2.2
resolution = [16, 16]
samples = 3

[[shapes]]
type = "sphere"
center = [0, 0, 0]
radius = 1

[[lights]]
type = "spot"
position = [0, 0, 3]
direction = [0, 0, -1]
cutoff_angle = 30
exponent = 5
intensity = [1, 1, 1]

[[lights]]
type = "rectangle"
center = [0, 0, 3]
edge_u = [0, 1, 0]
edge_v = [1, 0, 0]
radiance = [1, 1, 1]
samples = 25

[[lights]]
type = "polygon"
vertices = [[0, 0, 3], [0, 1, 3], [1, 0, 3]]
radiance = [1, 1, 1]

[[lights]]
type = "sphere"
center = [0, 0, 3]
radius = 0.5
radiance = [1, 1, 1]

[[lights]]
type = "environment"
radiance = [0.1, 0.1, 0.2]
samples = 32
"""


def write(folder: Path, text: str) -> Path:
    path = folder / "scene.toml"
    path.write_text(text)
    return path


def same(a: brdf.Scene, b: brdf.Scene) -> bool:
    leaves_a, structure_a = jax.tree.flatten(a)
    leaves_b, structure_b = jax.tree.flatten(b)
    return structure_a == structure_b and all(map(np.array_equal, leaves_a, leaves_b))


@pytest.mark.parametrize("text", [FULL, SHORT, LIT], ids=["full", "short", "lit"])
def test_a_saved_scene_reads_back_the_same(tmp_path: Path, text: str):
    scene = brdf.Scene.load(write(tmp_path, text))
    scene.save(tmp_path / "again.toml")
    assert same(scene, brdf.Scene.load(tmp_path / "again.toml"))


def test_values_are_read_as_written(tmp_path: Path):
    scene = brdf.Scene.load(write(tmp_path, FULL))
    assert isinstance(scene.camera, brdf.PerspectiveCamera)
    assert scene.camera.viewer == "infinite"
    assert scene.resolution == (40, 30)
    assert [shape.fitted for shape in scene.shapes] == [True, False]
    np.testing.assert_array_equal(scene.ambient, [0.2, 0.3, 0.4])
    point = scene.lights[1]
    assert isinstance(point, brdf.PointLight)
    np.testing.assert_array_equal(point.attenuation, [1.0, 0.1, 0.01])


def test_a_map_travels_with_the_scene(tmp_path: Path):
    pixels = np.random.default_rng(0).uniform(size=(8, 16, 3)).astype(np.float32)
    brdf.write_image(tmp_path / "sky.exr", pixels)
    lit = SHORT + '\n[[lights]]\ntype = "environment"\nfile = "sky.exr"\nradiance = 2\nsamples = 20\n'
    scene = brdf.Scene.load(write(tmp_path, lit))
    assert isinstance(scene.lights[1], brdf.EnvironmentMap)
    (tmp_path / "copy").mkdir()
    scene.save(tmp_path / "copy" / "scene.toml")
    again = brdf.Scene.load(tmp_path / "copy" / "scene.toml")
    white = brdf.Lambert(k_d=1.0)
    expected = brdf.render(white, scene, precision="float64")
    np.testing.assert_allclose(
        brdf.render(white, again, precision="float64"), expected, rtol=1e-6
    )  # float32 in the file


@pytest.mark.parametrize("samples", [20, 256])
def test_a_symmetric_map_is_cut_as_before_when_it_was_saved(tmp_path: Path, samples: int):
    # Of equal parts, and about centres of mass that are whole numbers, rounding to float32 decided.
    down, across = np.linspace(-1, 1, 5)[:, None], np.cos(4 * np.pi * (np.arange(9) + 0.5) / 9)
    for pixels in ((1.2 + across) * (1.5 - down**2), 1.5 + down + 0 * across):
        sky = brdf.EnvironmentMap(pixels[..., None] * [0.3, 0.5, 1.0], samples=samples)
        scene = brdf.Scene.load(write(tmp_path, SHORT))
        brdf.Scene(scene.camera, scene.shapes, lights=[sky]).save(tmp_path / "sky.toml")
        again = brdf.Scene.load(tmp_path / "sky.toml").lights[0]
        np.testing.assert_allclose(again.patches.mean, sky.patches.mean, atol=1e-6)


def test_a_map_of_one_colour_travels_with_the_scene(tmp_path: Path):
    sky = brdf.EnvironmentMap(np.ones((4, 8, 3)) * [0.25, 0.5, 1.0], samples=8)
    scene = brdf.Scene.load(write(tmp_path, SHORT))
    brdf.Scene(scene.camera, scene.shapes, lights=[sky]).save(tmp_path / "🌍\x7f.toml")  # also in the map's name
    again = brdf.Scene.load(tmp_path / "🌍\x7f.toml").lights[0]
    np.testing.assert_allclose(again.emittance, sky.emittance, rtol=1e-6)  # float32 in the file


def test_surface_points_travel_through_an_aov_file(tmp_path: Path):
    rng = np.random.default_rng(1)
    normal = rng.normal(size=(6, 5, 3))
    normal[2, 3] = 0.0
    position = rng.normal(size=(6, 5, 3))
    points = brdf.SurfacePoints.from_normals(normal, position=position, to_view=(0.1, 0.2, 1.0))
    light = brdf.DirectionalLight(direction=[0, 0, 1], intensity=[1.0])
    brdf.Scene(points=points, lights=[light]).save(tmp_path / "scene.toml")
    again = brdf.Scene.load(tmp_path / "scene.toml").surface_points()
    assert not again.mask[2, 3]
    assert np.count_nonzero(~again.mask) == 1
    for name in ("position", "normal", "to_view"):
        expected, got = (np.asarray(getattr(p, name))[points.mask] for p in (points, again))
        np.testing.assert_allclose(got, expected, atol=1e-6)  # the file holds float32


def test_layers_of_an_aov_file_can_be_named(tmp_path: Path):

    normal = np.zeros((3, 4, 3), np.float32)
    normal[..., 2] = 2.0
    write_layers(tmp_path / "aovs.exr", {"shading": normal, "where": normal})
    text = '[aov]\nfile = "aovs.exr"\nnormal = "shading"\nposition = "where"\n'
    points = brdf.Scene.load(write(tmp_path, text)).surface_points()
    np.testing.assert_array_equal(points.normal[0, 0], [0, 0, 1])
    np.testing.assert_array_equal(points.position[0, 0], [0, 0, 2])


def test_points_of_a_perspective_picture_are_seen_from_an_eye(tmp_path: Path):
    text = CAMERA.replace("orthographic", "perspective").replace("width = 2.2", "fov = 40.0") + SPHERE
    points = brdf.Scene.load(write(tmp_path, text + LIGHT)).surface_points()
    seen = np.asarray(points.mask)
    layers = {name: np.where(seen[..., None], getattr(points, name), 0) for name in ("position", "normal")}
    write_layers(tmp_path / "aovs.exr", {name: layer.astype(np.float32) for name, layer in layers.items()})
    again = brdf.Scene.load(write(tmp_path, '[aov]\nfile = "aovs.exr"\neye = [0, 0, 4]\n' + LIGHT)).surface_points()
    np.testing.assert_array_equal(again.mask, seen)
    np.testing.assert_allclose(np.asarray(again.to_view)[seen], np.asarray(points.to_view)[seen], atol=1e-6)


def test_the_unnamed_layer_of_an_aov_file_is_named_by_nothing(tmp_path: Path):
    normal = np.broadcast_to([0.0, 0.0, 1.0], (4, 5, 3))
    write_layers(tmp_path / "aovs.exr", {"": normal, "position": normal})
    (tmp_path / "scene.toml").write_text('[aov]\nfile = "aovs.exr"\nnormal = ""\n' + LIGHT)
    points = brdf.Scene.load(tmp_path / "scene.toml").surface_points()
    np.testing.assert_array_equal(points.normal, normal)


WRONG = {
    "unknown key": (SHORT + "colour = 3\n", "lights[0].colour: is not a known key"),
    "unknown table": (SHORT + "[sky]\n", "sky: is not a known key"),
    "unknown camera": (SHORT.replace("orthographic", "fisheye"), "camera.type: is unknown, got 'fisheye'"),
    "no type": (SHORT.replace('type = "sphere"\n', ""), "shapes[0]: has no type"),
    "missing key": (SHORT.replace("radius = 1\n", ""), "shapes[0]: has no radius"),
    "text for a number": (SHORT.replace("radius = 1", 'radius = "1"'), "shapes[0].radius: must be a number, got '1'"),
    "truth for a number": (
        SHORT.replace("radius = 1", "radius = true"),
        "shapes[0].radius: must be a number, got true",
    ),
    "negative radius": (SHORT.replace("radius = 1", "radius = -1"), "shapes[0].radius: must be greater than 0, got -1"),
    "not a number": (SHORT.replace("radius = 1", "radius = nan"), "shapes[0].radius: must be finite"),
    "two coordinates": (SHORT.replace("[0, 0, 4]", "[0, 4]"), "camera.position: must be three numbers"),
    "zero direction": (
        SHORT.replace("direction = [0, 0, 1]", "direction = [0, 0, 0]"),
        "lights[0].direction: must not",
    ),
    "negative light": (SHORT.replace("[1, 1, 1]", "[1, -1, 1]"), "intensity: must be at least 0, got -1 in channel 1"),
    "channels differ": (SHORT.replace("[1, 1, 1]", "[1, 1]"), "intensity: lights have 2 and 3 channels"),
    "camera in its target": (
        SHORT.replace("position = [0, 0, 4]", "position = [0, 0, 0]"),
        "camera.target: must differ",
    ),
    "up along the view": (SHORT.replace("up = [0, 1, 0]", "up = [0, 0, 1]"), "camera.up: must not be parallel"),
    "half a pixel": (SHORT.replace("[16, 16]", "[16.5, 16]"), "camera.resolution: must be two whole numbers"),
    "no pixel": (SHORT.replace("[16, 16]", "[0, 16]"), "camera.resolution: must be between 1 and"),
    "many pixels": (SHORT.replace("[16, 16]", "[16, 1000000]"), "camera.resolution: must be between 1 and"),
    "nothing to see": (
        SHORT.replace("radius = 1", "radius = 1\nfitted = false"),
        "shapes: has no shape that is fitted",
    ),
    "fitted as text": (
        SHORT.replace("radius = 1", 'radius = 1\nfitted = "no"'),
        "shapes[0].fitted: must be true or false",
    ),
    "shapes as a table": ("[shapes]\ntype = 'sphere'\n", "shapes: must be a list of tables"),
    "lights as numbers": ("lights = [1, 2]\n", "lights[0]: must be a table"),
    "ambient misspelt": (SHORT.replace("intensity = [0.1", "intensty = [0.1"), "ambient.intensty: is not a known key"),
    "ambient without intensity": (SHORT.replace("intensity = [0.1, 0.1, 0.1]", ""), "ambient: has no intensity"),
    "empty": ("# nothing\n", "scene: must have a camera or surface points"),
    "no toml": ("[camera", "is not TOML"),
    "samples as text": (LIT.replace("samples = 25", "samples = 2.5"), "lights[1].samples: must be a whole number"),
    "camera samples": (
        LIT.replace("samples = 3\n", "samples = 0\n"),
        "camera.samples: must be between 1 and",
    ),
    "truth in a vertex": (LIT.replace("[0, 1, 3]", "[0, true, 3]"), "lights[2].vertices: must be a number"),
    "missing map": (SHORT + "[[lights]]\ntype = 'environment'\nfile = 'none.exr'\n", "none.exr: there is no such"),
    "light beyond float32": (SHORT.replace("radius = 1", "radius = 1e30"), "radius: must be within ± 1e+15"),
    "missing mesh": (SHORT + "[[shapes]]\ntype = 'triangles'\nfile = 'none.obj'\n", "none.obj: there is no such"),
    "path out of the folder": ('[aov]\nfile = "../aovs.exr"\n', "aov.file: must stay within the scene's folder"),
    "number for a path": ("[aov]\nfile = 3\n", "aov.file: must be a path, got 3"),
    "missing aov": ('[aov]\nfile = "none.exr"\n', "none.exr: there is no such file"),
}


@pytest.mark.parametrize("case", WRONG, ids=WRONG)
def test_what_is_wrong_is_said_in_one_line(tmp_path: Path, case: str):
    text, words = WRONG[case]
    path = write(tmp_path, text)
    with pytest.raises(brdf.InputError) as caught:
        brdf.Scene.load(path)
    message = str(caught.value)
    assert message.startswith(str(tmp_path))
    assert words in message
    assert "\n" not in message


def test_a_missing_scene_is_said(tmp_path: Path):
    with pytest.raises(brdf.InputError, match="there is no such file"):
        brdf.Scene.load(tmp_path / "none.toml")


AOV = '[aov]\nfile = "n.exr"\n'
SHADOW = LIGHT + 'visibility = "n.exr"\n'
ENVIRONMENT = CAMERA + SPHERE + '[[lights]]\ntype = "environment"\n'
REFUSED = {
    "layer is a list": (AOV + 'normal = ["a"]\n' + LIGHT, r"aov\.normal: must be the name of a layer, got \['a'\]"),
    "layer is a number": (AOV + "position = 3\n" + LIGHT, r"aov\.position: must be the name of a layer, got 3"),
    "layer is missing": (AOV + 'position = "P"\n' + LIGHT, r"n\.exr: has no layer 'P', got the unnamed one, normal"),
    "shadow's layer": (CAMERA + SPHERE + SHADOW + "visibility_layer = []\n", r"lights\[0\]\.visibility_layer: must be"),
    "to_view is text": (AOV + 'to_view = "x"\n' + LIGHT, r"aov\.to_view: must be a number, got 'x'"),
    "to_view is zero": (AOV + "to_view = [0, 0, 0]\n" + LIGHT, r"aov\.to_view: must not have zero length"),
    "to_view is ragged": (AOV + "to_view = [[0], 0, 1]\n" + LIGHT, r"aov\.to_view: must be three numbers"),
    "to_view is short": (AOV + "to_view = [0, 1]\n" + LIGHT, r"aov\.to_view: must be three numbers"),
    "an eye without positions": (AOV + "eye = [0, 0, 4]\n" + LIGHT, r"n\.exr: has no layer of positions, which an eye"),
    "eye and to_view": (AOV + "eye = [0, 0, 4]\nto_view = [0, 0, 1]\n" + LIGHT, r"eye: is given beside to_view"),
    "eye is short": (AOV + "eye = [0, 1]\n" + LIGHT, r"aov\.eye: must be three numbers"),
    "no positions": (AOV + POINT, r"aov: has no layer of positions, but .* lights stand somewhere\. Add the layer"),
    "occluders": (
        AOV + '[[shapes]]\ntype = "sphere"\ncenter = [0, 0, 2]\nradius = 0.5\nfitted = false\n' + LIGHT,
        r"aov: has no layer of positions, but shapes .* stand somewhere\. Add the layer",
    ),
    "empty name": (ENVIRONMENT + 'file = ""\n', r"lights\[0\]\.file: must be a path, got ''"),
    "long list": (
        CAMERA + SPHERE + LIGHT.replace("1.0, ", "1.0, " * 3000),
        r"intensity: has 6001 entries\. Give at most",
    ),
    "long file": ("#" * (5 << 20), r"is larger than 4 MiB"),
    "5,000 digits": (CAMERA + SPHERE + f"x = {'1' * 5000}", r"is not TOML \(Exceeds the limit"),
    "5,000 hexadecimal digits": (CAMERA + SPHERE + f"x = 0x{'f' * 5000}", r"is not TOML \(Exceeds the limit"),
    "300 digits": (CAMERA + SPHERE + LIGHT + f"x = {10**299}", r"lights\[0\]\.x: is not a known key"),
    "not UTF-8": ("# caf\xe9 \n", r"is not UTF-8 text \(line 1"),
}


@pytest.fixture
def folder_with_normals(tmp_path: Path) -> Path:
    normal = np.zeros((8, 8, 3), np.float32)
    normal[..., 2] = 1
    write_layers(tmp_path / "n.exr", {"": normal, "normal": normal})
    return tmp_path


@pytest.mark.parametrize("name", REFUSED)
def test_a_scene_that_is_refused(folder_with_normals, name):
    content, said = REFUSED[name]
    (folder_with_normals / "scene.toml").write_bytes(content.encode("latin-1"))
    with pytest.raises(brdf.InputError) as told:
        brdf.Scene.load(folder_with_normals / "scene.toml")
    assert re.search(said, str(told.value)), told.value
    assert str(told.value).startswith(str(folder_with_normals))


@pytest.mark.parametrize("light", [LIGHT, '[[lights]]\ntype = "environment"\nradiance = 1\n'])
def test_lights_from_far_away_need_no_positions(folder_with_normals, light):
    (folder_with_normals / "scene.toml").write_text(AOV + light)
    assert brdf.Scene.load(folder_with_normals / "scene.toml").points is not None


def test_a_name_that_toml_cannot_hold_is_refused(tmp_path):
    mesh = brdf.Triangles(Mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]]))
    camera = brdf.OrthographicCamera(position=[0, 0, 4], target=[0, 0, 0], up=[0, 1, 0], width=2, resolution=(2, 2))
    with pytest.raises(brdf.InputError, match=r"shape0\.obj: has a name or folder that is not UTF-8"):
        brdf.Scene(camera, [mesh]).save(tmp_path / "s\udcff.toml")
