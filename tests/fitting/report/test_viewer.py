"""The page that turns shows in a browser what `brdf.render` shows, says what it cannot, and loads nothing."""

import dataclasses
import importlib.util
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browser_pages import asked, drawn, needs_browser
from scipy.ndimage import binary_dilation, binary_erosion
from scipy.spatial import ConvexHull

import brdf
import fitting

pytestmark = needs_browser

SIZE = 40  # of the fitted ball; turned, the page draws 13 times as many pixels on a side
LIMIT = 0.51  # of 255 codes: rounding to a code takes 0.5
MESH_LIMIT = 0.55  # corners are placed to 1/256 of a pixel: at an edge the triangle beside it may answer
PLAIN = "exposure=0&srgb=false&marked=false"
MODELS = [
    brdf.Phong(k_a=[0.1], k_d=[0.3, 0.2, 0.1], k_s=0.6, n=30),
    brdf.BlinnPhong(k_a=[0.1], k_d=[0.3, 0.2, 0.1], k_s=0.6, n=30),
    brdf.NormalizedBlinnPhong(k_a=[0.1], k_d=[0.3, 0.2, 0.1], k_s=0.0004, n=30),
    brdf.Lambert(k_a=[0.1], k_d=[0.3, 0.2, 0.1]),
]
DIRECTIONS = [[0.4, 0.5, 0.8], [-0.7, 0.2, 0.5]]


def a_scene(
    light: brdf.DirectionalLight | brdf.PointLight | brdf.SpotLight, camera: brdf.OrthographicCamera | None = None
):
    shown = camera or brdf.PerspectiveCamera(
        position=[0.5, 0.2, 4], target=[0, 0, 0], up=[0, 1, 0], fov=34, resolution=(SIZE, SIZE)
    )
    ball = brdf.Sphere(center=[0, 0, 0], radius=1)
    return brdf.Scene(camera=shown, shapes=(ball,), lights=(light,), ambient=[0.2])


SCENES = {
    "directional": a_scene(
        brdf.DirectionalLight(direction=DIRECTIONS[0], intensity=[0.9]),
        brdf.OrthographicCamera(position=[0, 0, 4], target=[0, 0, 0], up=[0, 1, 0], width=2.2, resolution=(SIZE, SIZE)),
    ),
    "point": a_scene(brdf.PointLight(position=[1.5, 2, 3], intensity=[12.0])),
    "spot": a_scene(brdf.SpotLight([1.5, 2, 3], [-1.4, -2, -3], 12.0, cutoff_angle=12, exponent=30)),
}


def shown_as(result: fitting.FitResult, material: brdf.Material, scene: brdf.Scene) -> fitting.FitResult:
    """A result of another material and scene; the numbers beside it are not looked at."""
    return dataclasses.replace(result, material=material, scenes=[scene], targets=[result.targets[0][..., :3]])


def rotation(axis: Any, degrees: float) -> np.ndarray:
    crossed = np.cross(axis, np.eye(3)).T  # crossed @ v is axis × v; Rodrigues
    return np.eye(3) + np.sin(np.radians(degrees)) * crossed + (1 - np.cos(np.radians(degrees))) * crossed @ crossed


def turned(scene: brdf.Scene, yaw: float, pitch: float, factor: int, place: list[float]) -> brdf.Scene:
    """The scene with the camera turned about the origin: first by pitch about its right axis, then yaw about up."""
    camera = scene.camera
    assert camera is not None
    forward = np.asarray(camera.target) - np.asarray(camera.position)
    right = np.cross(forward, camera.up)
    right /= np.linalg.norm(right)
    up = np.cross(right, forward) / np.linalg.norm(forward)
    turn = rotation(up, yaw) @ rotation(right, pitch)
    places = {key: turn @ np.asarray(getattr(camera, key)) for key in ("position", "target")}
    camera = dataclasses.replace(camera, **places, up=turn @ up, resolution=(SIZE * factor, SIZE * factor))
    key = "direction" if isinstance(scene.lights[0], brdf.DirectionalLight) else "position"
    return dataclasses.replace(scene, camera=camera, lights=(dataclasses.replace(scene.lights[0], **{key: place}),))


def off(codes: np.ndarray, material: brdf.Material, scene: brdf.Scene) -> float:
    """The largest difference from `brdf.render` in codes, silhouettes apart."""
    expected = 255 * np.clip(np.asarray(brdf.render(material, scene, precision="float64")), 0, 1)
    assert codes.shape == expected.shape
    mask, around = np.asarray(scene.surface_points().mask), np.ones((3, 3))
    assert np.all(codes[~binary_dilation(mask, around)] == 0)
    return float(np.max(np.abs(codes - expected)[binary_erosion(mask, around)]))


TURNS = [(0, 0, 1, 0), (25, -15, 13, 0), (-70, 30, 13, 1)]  # yaw, pitch, pixels on a side per pixel, which light
State = tuple[str, brdf.Material, brdf.Scene]  # of the page, and what it should show


def turns(model: brdf.Material) -> list[State]:
    """The ball turned, under lights from two sides, dull and sharp."""
    cases = [(20.0, TURNS[2]), *((10_000.0, turn) for turn in TURNS)] if hasattr(model, "n") else [(None, TURNS[1])]
    states = []
    for n, (yaw, pitch, factor, light) in cases:
        place = DIRECTIONS[light]
        moved = f"&yaw={yaw}&pitch={pitch}" + (f"&light0={','.join(map(str, place))}" if light else "")
        material = dataclasses.replace(model, n=n) if n else model
        scene = turned(SCENES["directional"], yaw, pitch, factor, place)
        states.append((f"{PLAIN}&wipe=0,1{moved}" + (f"&n={n}" if n else ""), material, scene))
    return states


def near(kind: str, place: list[float]) -> list[State]:
    """A near light and a near eye."""
    state = f"{PLAIN}&yaw=20&pitch=10&n=10000&light0={','.join(map(str, place))}"
    return [(state, dataclasses.replace(MODELS[1], n=10_000.0), turned(SCENES[kind], 20, 10, 13, place))]


def smooth_mesh(path: Path) -> tuple[brdf.Scene, list[State]]:
    """A ball of triangles, lit from the eye: that casts no shadow, of which the page has none."""
    down, around = np.arange(1, 12) * np.pi / 12, np.arange(24) * np.pi / 12
    rings = [[0, 1, 0], *([np.sin(a) * np.cos(b), np.cos(a), np.sin(a) * np.sin(b)] for a in down for b in around)]
    corners = np.array([*rings, [0, -1, 0]])
    hull = ConvexHull(corners)
    outward = (
        np.sum(
            np.cross(*(corners[hull.simplices[:, k]] - corners[hull.simplices[:, 0]] for k in (1, 2)))
            * hull.equations[:, :3],
            axis=1,
        )
        > 0
    )
    faces = np.where(outward[:, None], hull.simplices, hull.simplices[:, ::-1])
    lines = [f"v {x} {y} {z}" for x, y, z in corners] + [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in faces]
    path.write_text("\n".join(lines))
    scene = dataclasses.replace(SCENES["directional"], shapes=(brdf.Triangles(brdf.load_mesh(path)),))
    toward = (rotation([0, 1, 0], 25) @ rotation([1, 0, 0], -15) @ [0, 0, 1]).tolist()
    state = f"{PLAIN}&yaw=25&pitch=-15&n=300&light0={','.join(map(str, toward))}"
    return scene, [(state, dataclasses.replace(MODELS[1], n=300.0), turned(scene, 25, -15, 13, toward))]


@pytest.fixture(scope="module")
def pages(glossy: fitting.FitResult, tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[list[State], Any]]:
    """What each page should show, and what a browser, started once for all, shows."""
    folder = tmp_path_factory.mktemp("pages")
    cases = {model.name: (model, SCENES["directional"], turns(model)) for model in MODELS}
    # A spot that is moved aims anew: here it stays where it is.
    cases["point"] = (MODELS[1], SCENES["point"], near("point", [1.0, 2.5, 3.0]))
    cases["spot"] = (MODELS[1], SCENES["spot"], near("spot", [1.5, 2.0, 3.0]))
    if importlib.util.find_spec("trimesh"):
        cases["mesh"] = (MODELS[1], *smooth_mesh(folder / "ball.obj"))
    texts = [
        (shown_as(glossy, material, scene).view().text, [state for state, *_ in states])
        for material, scene, states in cases.values()
    ]
    answers = drawn(texts, folder)
    return {name: (states, answer) for (name, (*_, states)), answer in zip(cases.items(), answers, strict=True)}


@pytest.mark.parametrize("name", [*(model.name for model in MODELS), "point", "spot", "mesh"])
def test_the_page_draws_what_render_draws(name: str, pages: dict[str, tuple[list[State], Any]]):
    if name not in pages:
        pytest.skip("trimesh is missing")
    states, answer = pages[name]
    assert (answer["messages"], answer["requests"]) == ([], [])
    for codes, (state, material, scene) in zip(answer["codes"], states, strict=True):
        assert off(codes, material, scene) <= (MESH_LIMIT if name == "mesh" else LIMIT), state


def test_a_ball_stands_for_surface_points(glossy: fitting.FitResult, tmp_path: Path):
    seen = SCENES["directional"]
    points = dataclasses.replace(seen, camera=None, shapes=(), points=seen.surface_points())
    state = f"{PLAIN}&yaw=20&light0={','.join(map(str, DIRECTIONS[1]))}"
    (answer,) = drawn([(shown_as(glossy, MODELS[1], points).view().text, [state])], tmp_path)
    (codes,) = answer["codes"]
    scene = turned(seen, 20, 0, 1, DIRECTIONS[1])
    camera = dataclasses.replace(scene.camera, resolution=codes.shape[1::-1])
    assert off(codes, MODELS[1], dataclasses.replace(scene, camera=camera)) <= LIMIT


def test_a_bare_power_would_be_seen(glossy: fitting.FitResult, tmp_path: Path):
    """Shows that the limit tells: from n = 1000 on pow(N·H, n) in single precision exceeds it."""
    page = shown_as(glossy, MODELS[1], SCENES["directional"]).view().text
    exact = r"exp\(-0\.5 \* BRDF_N \* brdf_log1p\([^;]*\)\);"
    broken, count = re.subn(exact, "pow(dot(normalize(a), normalize(b)), BRDF_N);", page)
    assert count
    broken = broken.replace("</body>", "<script>alert(1)</script></body>")
    (answer,) = drawn([(broken, [f"{PLAIN}&yaw=25&pitch=-15&n={n}" for n in (1000, 10_000)])], tmp_path)
    scene = turned(SCENES["directional"], 25, -15, 13, DIRECTIONS[0])
    assert "Content Security Policy" in " ".join(answer["messages"])  # a program that is not the page's own
    for codes, n in zip(answer["codes"], (1000.0, 10_000.0), strict=True):
        assert off(codes, dataclasses.replace(MODELS[1], n=n), scene) > LIMIT


def used(text: str, folder: Path) -> dict[str, Any]:
    (folder / "page.html").write_text(text)
    return asked("use_page", folder / "page.html")


def test_a_reader_moves_light_view_and_numbers(glossy: fitting.FitResult, tmp_path: Path):
    seen = used(shown_as(glossy, MODELS[1], SCENES["directional"]).view().text, tmp_path)
    assert seen["messages"] == []
    assert seen["notes"] == []
    assert not seen["fixed"]
    assert "not reciprocal" in seen["verdict"]
    assert seen["pointer"].splitlines()[1].startswith("target")
    x, y, z = map(float, re.fullmatch(r"light0=(.*),(.*),(.*)", seen["on_surface"]).groups())
    normal = np.array([(0.275 - 0.5) * 2.2, (0.5 - 0.35) * 2.2, 0.0])
    normal[2] = np.sqrt(1 - normal @ normal)  # the light mirrors the view about it
    assert np.allclose([x, y, z], 2 * normal[2] * normal - [0, 0, 1], atol=0.1)  # a pixel is 0.055 wide
    yaw = float(re.search(r"yaw=([-\d.]+)", seen["beside"]).group(1))
    assert yaw == pytest.approx(-0.04 * 180, abs=0.5)
    assert seen["unlike"] == 0
    assert seen["own"] == seen["reset"] == ""


def test_copies_are_what_the_export_writes(glossy: fitting.FitResult, tmp_path: Path):
    seen = used(shown_as(glossy, MODELS[0], SCENES["directional"]).view().text, tmp_path)
    copied = seen["copied"]
    (tmp_path / "copied.json").write_text(copied["json"]["text"])
    (tmp_path / "copied.mtl").write_text(copied["mtl"]["text"])
    material = brdf.load_material(tmp_path / "copied.json")
    assert isinstance(material, brdf.Phong)
    assert float(material.n) == 77
    again = brdf.load_material(tmp_path / "copied.mtl")
    assert type(again) is brdf.Phong
    for key in ("k_a", "k_d", "k_s", "n"):
        assert np.allclose(getattr(again, key), getattr(material, key))
    assert copied["glsl"]["text"] == brdf.export_material(material, "glsl").text
    three, exact = (
        json.loads(text) for text in (copied["three"]["text"], brdf.export_material(material, "three").text)
    )
    assert three["shininess"] == exact["shininess"]
    for key in ("color", "specular"):
        assert np.allclose(three["userData"]["linear"][key], exact["userData"]["linear"][key], rtol=0.01)
    assert copied["three"]["losses"]
    assert not copied["json"]["losses"]


def test_what_cannot_be_drawn_is_named_beside_the_still_picture(glossy: fitting.FitResult, tmp_path: Path):
    lamp = brdf.RectangleLight(center=[0, 0, 3], edge_u=[0.5, 0, 0], edge_v=[0, -0.5, 0], radiance=[3.0])
    scene = dataclasses.replace(SCENES["directional"], lights=(lamp,))
    parameters = tuple(
        dataclasses.replace(one, value=None, interval=None, reason="no highlight") if one.name == "n" else one
        for one in glossy.parameters
    )
    result = dataclasses.replace(shown_as(glossy, MODELS[1], scene), parameters=parameters)
    seen = used(result.view().text, tmp_path)
    assert seen["fixed"]
    assert "rectangle" in seen["notes"][0]
    assert "not determined: no highlight" in seen["reasons"]
    assert seen["disabled"] == len(seen["reasons"])
    assert seen["without"] == {"still": True, "viewer": False}


def test_jupyter_shows_the_page_in_a_frame(glossy: fitting.FitResult, tmp_path: Path):
    page = glossy.view()
    shown = page._repr_html_()
    assert shown.startswith("<iframe")
    assert "srcdoc=" in shown
    page.save(tmp_path / "page.html")
    assert (tmp_path / "page.html").read_text() == page.text
    with pytest.raises(brdf.InputError, match="picture: must be from 0 to 0, got 3"):
        glossy.view(3)
