"""Meshes: shading normals from the file or the faces around, creases, which side is seen, and what is refused."""

from pathlib import Path

import numpy as np
import pytest

import brdf

trimesh = pytest.importorskip("trimesh", reason="trimesh intersects meshes")

CAMERA = brdf.OrthographicCamera(position=[0, 0, 4], target=[0, 0, 0], up=[0, 1, 0], width=2.2, resolution=(48, 48))
SUN = brdf.DirectionalLight(direction=[0.4, 0.5, 0.8], intensity=1.0)
WHITE = brdf.Lambert(k_d=1.0)


def obj(shape, normals: bool = False) -> str:
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in shape.vertices.tolist()]
    lines += [f"vn {x!r} {y!r} {z!r}" for x, y, z in shape.vertices.tolist() if normals]
    corner = "{0}//{0}" if normals else "{0}"
    lines += ["f " + " ".join(corner.format(index + 1) for index in face) for face in shape.faces.tolist()]
    return "\n".join(lines) + "\n"


def load(folder: Path, text: str, **how) -> brdf.Triangles:
    (folder / "mesh.obj").write_text(text)
    return brdf.Triangles(brdf.load_mesh(folder / "mesh.obj", **how))


def picture(shape, material=WHITE, light=SUN, camera=CAMERA):
    return np.asarray(brdf.render(material, brdf.Scene(camera, [shape], lights=[light]), precision="float64"))[..., 0]


def test_a_sphere_of_triangles_is_shaded_as_a_sphere(tmp_path):
    ball, round_ball = trimesh.creation.icosphere(subdivisions=3), picture(brdf.Sphere([0, 0, 0], 1))
    given, found, flat = (
        np.abs(picture(load(tmp_path, obj(ball, normals), smooth=smooth)) - round_ball)
        for normals, smooth in ((True, True), (False, True), (True, False))
    )
    assert np.median(given) < 1e-3
    assert np.median(found) < 1e-3
    assert np.mean(flat) > 5 * max(np.mean(given), np.mean(found))


def test_triangles_of_any_size_are_shaded_smoothly(tmp_path):
    normals = []
    for unit in (1.0, 1e-6):
        ball = trimesh.creation.icosphere(subdivisions=1, radius=unit)
        camera = brdf.OrthographicCamera(
            position=[0, 0, 4 * unit], target=[0, 0, 0], up=[0, 1, 0], width=2.2 * unit, resolution=(8, 8)
        )
        scene = brdf.cast(brdf.Scene(camera, [load(tmp_path, obj(ball))]), "float32")
        normals.append(scene.surface_points().normal)
    np.testing.assert_allclose(*normals, atol=1e-4)


def test_the_faces_around_a_vertex_weigh_by_their_angle(tmp_path):
    # A flat pyramid of three sides, one of them cut in many thin triangles: equal angles, equal weights.
    tilt, fan = np.radians(5.0), 16
    around = np.radians(np.concatenate([[0.0, 120.0], np.linspace(240.0, 360.0, fan)[:-1]]))
    rim = np.stack([np.cos(around), np.sin(around), np.full(around.shape, -np.tan(tilt))], axis=-1)
    vertices, count = np.concatenate([[[0.0, 0.0, 0.0]], rim]), len(rim)
    # The fan lies in one plane.
    a, b = rim[2], rim[0]
    vertices[3:] = [a + share * (b - a) for share in np.linspace(0, 1, fan)[:-1]]
    faces = [[0, 1 + index, 1 + (index + 1) % count] for index in range(count)]
    mesh = load(tmp_path, obj(trimesh.Trimesh(vertices, faces, process=False))).mesh
    np.testing.assert_allclose(mesh.normals[:, 0], np.broadcast_to([0, 0, 1.0], (count, 3)), atol=1e-12)


def test_edges_sharper_than_30_degrees_stay_edges(tmp_path):
    box = load(tmp_path, obj(trimesh.creation.box())).mesh
    np.testing.assert_allclose(box.normals, np.broadcast_to(box.front[:, None], (12, 3, 3)), atol=1e-12)
    can = load(tmp_path, obj(trimesh.creation.cylinder(1.0, 2.0, sections=24))).mesh  # its sides meet at 15°
    side, corners = np.abs(can.front[:, 2]) < 0.5, can.vertices[can.faces]
    np.testing.assert_allclose(can.normals[side], corners[side] * [1, 1, 0], atol=1e-6)
    np.testing.assert_allclose(np.abs(can.normals[~side][..., 2]), 1.0)


def test_vertices_that_a_file_repeats_are_one(tmp_path):
    ball = trimesh.creation.icosphere(subdivisions=2)
    apart = trimesh.Trimesh(ball.vertices[ball.faces.ravel()], np.arange(ball.faces.size).reshape(-1, 3), process=False)
    one, other = (load(tmp_path, obj(shape)).mesh for shape in (ball, apart))
    np.testing.assert_allclose(one.normals, other.normals, atol=1e-12)


def test_the_back_of_a_face_is_not_lit_and_gets_no_light_through_it(tmp_path):
    # A triangle in the plane of the picture whose normals lean so far that they would still face the light.
    leaning = "v -1 -1 0\nv 1 -1 0\nv 0 1 0\nvn 0.95 0 0.3\nf 1//1 2//1 3//1\n"
    shape, beside = load(tmp_path, leaning), brdf.DirectionalLight(direction=[1.0, 0.0, -0.2], intensity=1.0)
    assert picture(shape).max() > 0.5
    assert picture(shape, light=beside).max() == 0
    behind = brdf.OrthographicCamera(
        position=[0, 0, -4], target=[0, 0, 0], up=[0, 1, 0], width=2.2, resolution=(48, 48)
    )
    points = brdf.Scene(behind, [shape], lights=[SUN]).surface_points()
    np.testing.assert_allclose(np.asarray(points.normal)[np.asarray(points.mask)], [[0, 0, 1]] * int(points.mask.sum()))


@pytest.mark.parametrize("smooth", [True, False])
def test_a_scene_file_keeps_the_shading(smooth, tmp_path):
    shape = load(tmp_path, obj(trimesh.creation.icosphere(subdivisions=1)), smooth=smooth)
    scene = brdf.Scene(CAMERA, [shape], lights=[SUN])
    scene.save(tmp_path / "scene.toml")
    again = brdf.Scene.load(tmp_path / "scene.toml")
    for name in ("vertices", "faces", "normals") if smooth else ("vertices", "faces"):
        np.testing.assert_allclose(getattr(again.shapes[0].mesh, name), getattr(shape.mesh, name), atol=1e-15)
    assert ("smooth = false" in (tmp_path / "scene.toml").read_text()) != smooth
    assert f"80 {'smooth' if smooth else 'flat'} faces" in repr(again.shapes[0].mesh)


TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"


@pytest.mark.parametrize(
    ("text", "words"),
    {
        "vertex 0": (f"{TRIANGLE}f 0 1 2\n", "line 4: cannot be read .there is no vertex 0"),
        "far": ("v 0 0 1e300\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "vertices: must be within"),
        "no such vertex": (f"{TRIANGLE}f 1 2 7\n", "faces: name a vertex that is not there"),
        "no such vertex, backwards": (f"{TRIANGLE}f -1 -2 -7\n", "faces: name a vertex that is not there"),
        "no such normal": (f"{TRIANGLE}vn 0 0 1\nf 1//1 2//2 3//1\n", "faces: name a normal that is not there"),
        "no such normal, backwards": (f"{TRIANGLE}vn 0 0 1\nf 1//-1 2//-1 3//-4\n", "line 5: .*1 normals before"),
        "words": (f"{TRIANGLE}f one two three\n", "line 4: cannot be read"),
        "words after a joined line": (
            f"# by C:\\\n{TRIANGLE}f 1 2 \\\n3\nf 1 2 3 # C:\\\nf one two three\n",
            "line 8: cannot be read",
        ),
        "two corners": (f"{TRIANGLE}f 1 2\n", "line 4: .*three corners"),
        "short vertex": (f"v 0 0\n{TRIANGLE}f 1 2 3\n", "line 1: cannot be read"),
        "inside out": (f"{TRIANGLE}vn 0 0 -1\nf 1//1 2//1 3//1\n", "normals: point to the back of the faces"),
        "points alone": (TRIANGLE, "holds no triangles"),
        "nothing": ("", "is empty"),
    }.values(),
)
def test_what_is_no_mesh_is_refused(text, words, tmp_path):
    with pytest.raises(brdf.InputError, match=rf"mesh\.obj.*{words}"):
        load(tmp_path, text)


def test_corners_are_named_in_every_way_that_the_format_knows(tmp_path):
    ways = ["f 1 2 3 4", "f 1/1 2/1 3/1 4/1", "f 1//1 2//1 3//1 4//1", "f 1/1/1 2/1/1 3/1/1 4/1/1", "f -4//-1 -3 -2 -1"]
    square = f"# a square\n{TRIANGLE.replace('v 0 1', 'v 1 1')}v 0 1 0 0.5 0.5 0.5\nvt 0 0\nvn 0 0 2 # up\no it\ns 1\n"
    for way in [*ways, "f 1 2 \\\n3 4"]:
        mesh = load(tmp_path, f"{square}{way}\n").mesh
        np.testing.assert_array_equal(mesh.faces, [[0, 1, 2], [0, 2, 3]])
        np.testing.assert_allclose(mesh.normals, np.broadcast_to([0, 0, 1.0], (2, 3, 3)))
