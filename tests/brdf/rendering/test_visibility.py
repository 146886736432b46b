"""Shadows: against the plain NumPy oracle, dense sampling, meshes against shapes, and none where nothing casts any."""

import sys
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from project_paths import ROOT

import brdf
from brdf.geometry.triangles import Mesh
from brdf.lights.base import Light

sys.path.insert(0, str(ROOT / "data"))

CAMERA = {
    "type": "orthographic",
    "position": [0.0, 0.0, 6.0],
    "target": [0.0, 0.0, 0.0],
    "up": [0.0, 1.0, 0.0],
    "width": 4.0,
    "resolution": [48, 48],
}
BALL = {"type": "sphere", "center": [0.0, 0.0, 0.0], "radius": 0.8}
WALL = {"type": "rectangle", "center": [0.0, 0.0, -1.2], "edge_u": [3.0, 0.0, 0.0], "edge_v": [0.0, 3.0, 0.0]}
WHITE = brdf.Lambert(k_d=1.0)


def without_type(table: dict) -> dict:
    return {key: value for key, value in table.items() if key != "type"}


def scene(*lights: Light, shapes: list | None = None, **more) -> brdf.Scene:
    shapes = [brdf.Sphere(**without_type(BALL)), brdf.Rectangle(**without_type(WALL))] if shapes is None else shapes
    return brdf.Scene(camera=brdf.OrthographicCamera(**without_type(CAMERA)), shapes=shapes, lights=lights, **more)


@pytest.mark.parametrize(
    "light",
    [
        {"type": "directional", "direction": [0.6, 0.5, 1.0], "intensity": [1.0, 0.9, 0.8]},
        {"type": "point", "position": [1.5, 1.5, 2.5], "intensity": [6.0, 6.0, 5.0]},
        {
            "type": "spot",
            "position": [1.0, 1.5, 3.0],
            "direction": [-0.25, -0.4, -1.0],
            "cutoff_angle": 30.0,
            "exponent": 8.0,
            "intensity": [9.0, 9.0, 9.0],
        },
    ],
    ids=lambda light: light["type"],
)
def test_hard_shadows_are_those_of_the_oracle(light: dict):
    from drawing.numpy_shading import shade as oracle

    kind = {"directional": brdf.DirectionalLight, "point": brdf.PointLight, "spot": brdf.SpotLight}[light["type"]]
    numbers = {"k_a": [0.0] * 3, "k_d": [0.5, 0.4, 0.3], "k_s": [0.3] * 3, "n": 20.0}
    got = np.asarray(brdf.render(brdf.BlinnPhong(**numbers), scene(kind(**without_type(light))), precision="float64"))
    tables = {"camera": CAMERA, "shapes": [BALL, WALL], "lights": [light]}
    expected = oracle(tables, numbers | {"model": "blinn-phong"}, shadows=True)
    off = np.abs(got - expected).max(axis=-1) > 1e-9
    assert np.count_nonzero(off) <= 2  # a shadow's edge may fall on a pixel's centre
    assert np.count_nonzero(expected[..., 0] == 0) > 50


@pytest.mark.parametrize("precision", ["float32", "float64"])
def test_the_edge_of_a_hard_shadow_lies_where_rays_touch_the_ball(precision: Any):
    """Single precision had it 8e-5 aside, the offset of shadow rays: a pixel in several pictures was lit wrongly."""
    edge, step = -1.2 - 0.8 * np.sqrt(2), 1e-5
    near = {"position": [edge, 0.0, 6.0], "target": [edge, 0.0, 0.0], "width": 64 * step, "resolution": [64, 1]}
    camera = brdf.OrthographicCamera(**without_type(CAMERA | near))
    light = brdf.DirectionalLight(direction=[1.0, 0.0, 1.0], intensity=1)
    picture = brdf.render(WHITE, brdf.Scene(camera, scene().shapes, lights=[light]), precision=precision)
    lit = np.asarray(picture)[0, :, 0] > 0
    assert abs(np.count_nonzero(lit) - 32) <= 1
    assert lit[:31].all()


def test_soft_shadows_need_few_samples():
    def picture(samples: int) -> np.ndarray:
        light = brdf.RectangleLight(
            center=[1.2, 1.3, 2.0], edge_u=[0, 0.5, -0.3], edge_v=[0.5, 0, -0.3], radiance=1, samples=samples
        )
        return np.asarray(brdf.render(WHITE, scene(light), precision="float32"))

    dense = picture(64 * 64)
    assert np.max(np.abs(picture(64) - dense)) < 0.003 * dense.max()


def test_a_scene_that_casts_no_shadow_has_no_shadow_rays():
    light = brdf.DirectionalLight(direction=[0.6, 0.5, 1.0], intensity=1)

    def operations(scene: brdf.Scene) -> int:
        scene = brdf.cast(scene, "float32")
        images = jax.make_jaxpr(lambda points: brdf.basis_images(brdf.Lambert, scene, points=points))
        return str(images(scene.surface_points())).count(" = ")

    ball = scene(light, shapes=[brdf.Sphere(center=[0, 0, 0], radius=0.8)])
    assert ball.occluders == ()
    assert operations(ball) < 0.6 * operations(scene(light))


def test_a_white_mask_may_be_an_hdr_file(tmp_path: Path):
    """Its ones are read as what was truncated to them."""
    brdf.write_image(tmp_path / "white.hdr", np.ones((48, 48, 3)))
    scene(brdf.DirectionalLight(direction=[0, 0, 1], intensity=1)).save(tmp_path / "scene.toml")
    words = (tmp_path / "scene.toml").read_text() + 'visibility = "white.hdr"\n'
    (tmp_path / "scene.toml").write_text(words)
    (mask,) = brdf.Scene.load(tmp_path / "scene.toml").visibility
    np.testing.assert_array_equal(mask, 1)


def test_a_given_mask_stands_in_for_geometry(tmp_path: Path):
    lights = [brdf.DirectionalLight(direction=[0, 0, 1], intensity=1), brdf.PointLight(position=[1, 1, 3], intensity=4)]
    shapes = [brdf.Sphere(center=[0, 0, 0], radius=0.8)]
    mask = np.random.default_rng(0).uniform(size=(48, 48)).astype(np.float32)
    masked = scene(*lights, shapes=shapes, visibility=[None, mask])
    each = np.asarray(brdf.render_lights(WHITE, scene(*lights, shapes=shapes), precision="float32"))
    got = np.asarray(brdf.render(WHITE, masked, precision="float32"))
    np.testing.assert_allclose(got, each[0] + mask[..., None] * each[1], atol=1e-6)
    np.testing.assert_allclose(brdf.render_lights(WHITE, masked, precision="float32").sum(axis=0), got, atol=1e-6)
    masked.save(tmp_path / "scene.toml")
    again = brdf.Scene.load(tmp_path / "scene.toml")
    np.testing.assert_allclose(brdf.render(WHITE, again, precision="float32"), got, atol=1e-6)
    with pytest.raises(brdf.InputError, match="visibility: has 1 entries for 2 lights"):
        scene(*lights, shapes=shapes, visibility=[mask])


def test_occluders_shadow_points_from_elsewhere():
    normal = np.zeros((3, 3, 3))
    normal[..., 2] = 1
    grid = np.stack(np.meshgrid([-1.0, 0, 1], [-1.0, 0, 1], [0.0]), axis=-1)[:, :, 0]
    points = brdf.SurfacePoints.from_normals(normal, position=grid)
    light = brdf.DirectionalLight(direction=[0, 0, 1], intensity=1)
    ball = brdf.Sphere(center=[0, 0, 2], radius=0.5, fitted=False)
    image = np.asarray(brdf.render(WHITE, brdf.Scene(points=points, shapes=[ball], lights=[light])))[..., 0]
    expected = np.ones((3, 3))
    expected[1, 1] = 0
    np.testing.assert_allclose(image, expected)


OBJ = "v -3 -3 -1.2\nv 3 -3 -1.2\nv 3 3 -1.2\nv -3 3 -1.2\nf 1 2 3 4\n"


def test_a_mesh_is_seen_and_shadowed_like_a_rectangle(tmp_path: Path):
    pytest.importorskip("trimesh", reason="trimesh reads and intersects meshes")
    (tmp_path / "wall.obj").write_text(OBJ)
    light = brdf.DirectionalLight(direction=[0.6, 0.5, 1.0], intensity=1)
    ball = brdf.Sphere(**without_type(BALL))
    mesh = brdf.Triangles(brdf.load_mesh(tmp_path / "wall.obj"))
    got = brdf.render(WHITE, scene(light, shapes=[ball, mesh]), precision="float32")
    expected = brdf.render(WHITE, scene(light), precision="float32")
    off = np.abs(np.asarray(got - expected)).max(axis=-1) > 1e-5
    assert np.count_nonzero(off) <= 3  # Embree's float32 decides otherwise at an edge
    scene(light, shapes=[ball, mesh]).save(tmp_path / "scene.toml")
    again = brdf.Scene.load(tmp_path / "scene.toml")
    np.testing.assert_array_equal(brdf.render(WHITE, again, precision="float32"), got)


@pytest.mark.parametrize(("precision", "far"), [("float32", 0.0), ("float64", 0.0), ("float64", 3e4)])
def test_a_mesh_casts_shadows_on_itself(precision: Any, far: float):
    pytest.importorskip("trimesh", reason="trimesh intersects meshes")
    # A floor, and a lid over its middle, turned: in Embree's single precision a ray may start below where it should.
    floor, lid = ([[-h, -h, z], [h, -h, z], [h, h, z], [-h, h, z]] for h, z in ((3.0, 0.0), (0.5, 1.0)))
    turn = np.array([[0.8, 0.0, 0.6], [0.0, 1.0, 0.0], [-0.6, 0.0, 0.8]])
    mesh = Mesh([*floor, *lid] @ turn.T + far, [[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]])
    light = brdf.DirectionalLight(direction=turn @ [1.0, 0.0, 1.0], intensity=1)
    camera = without_type(CAMERA) | {"position": turn @ [0, 0, 6] + far, "target": [far] * 3}
    seen = brdf.Scene(brdf.OrthographicCamera(**camera), [brdf.Triangles(mesh)], lights=[light])
    image = np.asarray(brdf.render(WHITE, seen, precision=precision))[..., 0]
    x = (np.arange(48) + 0.5) / 12 - 2
    row = image[24]
    lit = np.sqrt(0.5)
    np.testing.assert_allclose(row[(x > -1.4) & (x < -0.6)], 0)
    np.testing.assert_allclose(row[(x > -0.4) & (x < 0.4)], lit, rtol=1e-5)
    np.testing.assert_allclose(row[x > 0.6], lit, rtol=1e-5)


def test_five_lights_on_a_mesh_are_the_sum_of_each(tmp_path: Path):
    pytest.importorskip("trimesh", reason="trimesh reads and intersects meshes")
    # so many light samples are looped over
    (tmp_path / "tent.obj").write_text("v -1 -1 0\nv 1 -1 0\nv 0 0 1\nv -1 1 0.8\nv 1 1 0\nf 1 2 3\nf 1 3 4\nf 3 5 4\n")
    mesh = brdf.Triangles(brdf.load_mesh(tmp_path / "tent.obj", smooth=False))
    suns = [brdf.DirectionalLight([x, y, 1.0], intensity=1.0) for x, y in [(-2, 1), (1, 3), (2, -1), (0, -3), (0, 0)]]
    got = brdf.render(WHITE, scene(*suns, shapes=[mesh]), precision="float64")
    each = [brdf.render(WHITE, scene(sun, shapes=[mesh]), precision="float64") for sun in suns]
    np.testing.assert_allclose(got, np.sum(each, axis=0), rtol=1e-12, atol=1e-12)
    assert np.count_nonzero(np.max(each, axis=(0, 3)) > np.min(each, axis=(0, 3))) > 100
