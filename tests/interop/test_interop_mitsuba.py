"""A ball before a wall against Mitsuba 3, under each kind of light, with shadows."""

import sys
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from project_paths import ROOT

import brdf
import fitting
from brdf.lights.base import Light

pytest.importorskip("mitsuba", reason="Mitsuba 3 renders the reference")
sys.path.insert(0, str(ROOT / "data"))

SIZE = 24
CAMERA = {
    "type": "orthographic",
    "position": [0.0, 0.0, 6.0],
    "target": [0.0, 0.0, 0.0],
    "up": [0.0, 1.0, 0.0],
    "width": 4.0,
    "resolution": [SIZE, SIZE],
}
BALL = {"type": "sphere", "center": [0.0, 0.0, 0.0], "radius": 0.8}
WALL = {"type": "rectangle", "center": [0.0, 0.0, -1.2], "edge_u": [3.0, 0.0, 0.0], "edge_v": [0.0, 3.0, 0.0]}
NUMBERS: dict[str, Any] = {"k_a": [0.1] * 3, "k_d": [0.5, 0.4, 0.3], "k_s": [0.4] * 3, "n": 30.0}
AMBIENT = [0.5, 0.5, 0.5]
RADIANCE = [3.0, 2.5, 2.0]

LIGHTS: dict[str, dict[str, Any]] = {
    "directional": {"direction": [0.6, 0.5, 1.0], "intensity": [1.0, 0.9, 0.8]},
    "point": {"position": [1.5, 1.5, 2.5], "intensity": [6.0, 6.0, 5.0]},
    "spot": {
        "position": [1.0, 1.5, 3.0],
        "direction": [-0.25, -0.4, -1.0],
        "cutoff_angle": 30.0,
        "exponent": 8.0,
        "intensity": [12.0, 12.0, 12.0],
    },
    "rectangle": {
        "center": [1.2, 1.3, 2.0],
        "edge_u": [0.0, 0.5, -0.3],
        "edge_v": [0.5, 0.0, -0.3],
        "radiance": RADIANCE,
    },
    "polygon": {
        "vertices": [[0.9, 1.7, 1.89], [1.6, 1.9, 1.595], [1.8, 0.8, 1.8], [0.8, 0.6, 2.2]],
        "radiance": RADIANCE,
    },
    "sphere": {"center": [1.3, 1.2, 2.0], "radius": 0.5, "radiance": RADIANCE},
    "environment": {"radiance": [1.0, 0.9, 0.8]},
    "map": {},
}

# Of lights with an extent, which all hand their samples to one lobe, each has one of the models, and one has both.
CASES = [(kind, "phong") for kind in ("directional", "point", "spot", "rectangle", "polygon", "environment")]
CASES += [(kind, "blinn-phong") for kind in ("directional", "point", "spot", "rectangle", "sphere", "map")]


def light_of(kind: str, values: dict[str, Any], folder: Path) -> tuple[dict[str, Any], Light]:
    if kind == "map":
        turn, down = 2 * np.pi * (np.arange(512) + 0.5) / 512, np.pi * (np.arange(256)[:, None] + 0.5) / 256
        directions = 0.5 * np.sin(down) * np.sin(turn) + 0.5 * np.cos(down) - 0.707 * np.sin(down) * np.cos(turn)
        pixels = np.exp(4 * (directions - 1))[..., None] * np.array(RADIANCE) + 0.2
        path = folder / "sky.exr"
        brdf.write_image(path, pixels.astype(np.float32))
        return {"type": "environment", "file": str(path)}, brdf.EnvironmentMap(brdf.read_image(path), samples=256)
    kinds: dict[str, Any] = {
        "directional": brdf.DirectionalLight,
        "point": brdf.PointLight,
        "spot": brdf.SpotLight,
        "rectangle": brdf.RectangleLight,
        "polygon": brdf.PolygonLight,
        "sphere": brdf.SphereLight,
        "environment": brdf.ConstantEnvironment,
    }
    more = {} if kind in ("directional", "point", "spot") else {"samples": 256}
    return values | {"type": kind}, kinds[kind](**values, **more)


def away_from_edges(labels: np.ndarray) -> np.ndarray:
    padded = np.pad(labels, 2, mode="edge")
    height, width = labels.shape
    shifts = [padded[i : i + height, j : j + width] for i in range(5) for j in range(5)]
    return np.all([shift == labels for shift in shifts], axis=0)


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "model"), CASES)
def test_a_picture_is_mitsubas(kind: str, model: str, tmp_path: Path):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of Mitsuba's own making
        from drawing import mitsuba_scene

        table, light = light_of(kind, LIGHTS[kind], tmp_path)
        tables = {
            "camera": CAMERA,
            "shapes": [BALL, WALL],
            "lights": [table],
            "ambient": {"intensity": AMBIENT},
        }
        spp = 1024 if "env" in kind or kind == "map" else 100
        expected = mitsuba_scene.render(tables, NUMBERS | {"model": model}, spp=spp)
    camera = brdf.OrthographicCamera(**{key: value for key, value in CAMERA.items() if key != "type"})
    shapes = [
        brdf.Sphere(center=[0, 0, 0], radius=0.8),
        brdf.Rectangle(center=[0, 0, -1.2], edge_u=[3, 0, 0], edge_v=[0, 3, 0]),
    ]
    scene = brdf.Scene(camera=camera, shapes=shapes, lights=[light], ambient=AMBIENT)
    material: Any = brdf.MODELS[model]
    got = np.asarray(brdf.render(material(**NUMBERS), scene, precision="float32"))
    inside = away_from_edges(np.asarray(scene.surface_points().shape))
    inside &= away_from_edges((expected[..., 0] > 0.0501).astype(int))  # in shadow there is ambient light only
    difference = (np.abs(got - expected) / expected)[inside]
    # Mitsuba's own noise of these sample numbers is 0.1 %, with a constant environment 0.2 %
    assert np.median(difference) < (0.003 if kind == "environment" else 0.002)
    assert np.percentile(difference, 99) < 0.02


def test_a_smooth_mesh_is_mitsubas(tmp_path: Path):
    """The exponent of a picture that Mitsuba made of the same mesh comes back; flat shading of it costs a tenth."""
    trimesh = pytest.importorskip("trimesh", reason="trimesh intersects meshes")
    from drawing import mitsuba_scene

    path, ball = tmp_path / "ball.obj", trimesh.creation.icosphere(subdivisions=2, radius=1.5)
    lines = [f"v {x} {y} {z}\nvn {x} {y} {z}" for x, y, z in ball.vertices.tolist()]
    corners = [f"f {a}//{a} {b}//{b} {c}//{c}" for a, b, c in (ball.faces + 1).tolist()]
    path.write_text("\n".join(lines + corners))
    light = LIGHTS["directional"]
    tables = {
        "camera": CAMERA,
        "shapes": [{"type": "triangles", "file": path}],
        "lights": [light | {"type": "directional"}],
    }
    numbers = NUMBERS | {"model": "blinn-phong", "k_a": [0.0] * 3}
    expected = mitsuba_scene.render(tables, numbers, spp=1)
    camera = brdf.OrthographicCamera(**{key: value for key, value in CAMERA.items() if key != "type"})
    exponents = {}
    for shading in (True, False):
        shape = brdf.Triangles(brdf.load_mesh(path, smooth=shading))
        scene = brdf.Scene(camera, [shape], lights=[brdf.DirectionalLight(**light)])
        exponents[shading] = fitting.fit(expected, scene, model="blinn-phong", precision="float64").material.n
        if shading:
            got = brdf.render(brdf.BlinnPhong(k_d=NUMBERS["k_d"], k_s=NUMBERS["k_s"], n=30.0), scene)
            inside = away_from_edges(np.asarray(scene.surface_points().mask).astype(int))
            np.testing.assert_allclose(np.asarray(got)[inside], expected[inside], atol=1e-5)
    np.testing.assert_allclose(exponents[True], NUMBERS["n"], rtol=0.01)
    assert abs(exponents[False] / NUMBERS["n"] - 1) > 0.05
