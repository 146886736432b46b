"""What is wrong with a scene is named, with its size; nothing is named where nothing is; no scene is too odd to ask."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import brdf
import fitting
from brdf.geometry.triangles import Mesh

SIZE = 64
PIXEL = 2.2 / SIZE
CAMERA = brdf.OrthographicCamera(position=[0, 0, 4], target=[0, 0, 0], up=[0, 1, 0], width=2.2, resolution=(SIZE, SIZE))
LIGHT = brdf.DirectionalLight(direction=[0.4, 0.5, 0.8], intensity=[1.0])
BALL = brdf.Sphere(center=[0, 0, 0], radius=1)
SCENE = brdf.Scene(camera=CAMERA, shapes=[BALL], ambient=[1.0], lights=[LIGHT])
SMALL = dataclasses.replace(SCENE, camera=dataclasses.replace(CAMERA, resolution=(40, 40)))
MATERIAL = brdf.BlinnPhong(k_a=[0.05], k_d=[0.45], k_s=[0.3], n=30)
ACROSS = np.array([0.8, 0.0, -0.4]) / np.sqrt(0.8)


def drawn(scene: brdf.Scene = SCENE, noise: float = 0.004) -> np.ndarray:
    clean = np.asarray(brdf.render(MATERIAL, scene, precision="float64"))
    return clean + np.random.default_rng(1).normal(0, noise, clean.shape)


def with_light(degrees: float) -> brdf.Scene:
    straight, angle = np.array([0.4, 0.5, 0.8]) / np.sqrt(1.05), np.radians(degrees)
    light = dataclasses.replace(LIGHT, direction=np.cos(angle) * straight + np.sin(angle) * ACROSS)
    return dataclasses.replace(SCENE, lights=(light,))


def with_ball(**changed: Any) -> brdf.Scene:
    return dataclasses.replace(SCENE, shapes=(dataclasses.replace(BALL, **changed),))


def fitted(target: Any, scene: Any = SCENE) -> fitting.FitResult:
    return fitting.fit(target, scene, model="blinn-phong")


CLEAN = drawn(noise=0.0)
NOISE = drawn() - CLEAN
WRONG = {
    "light": (drawn(), with_light(2.0), 2.0),
    "ball": (drawn(), with_ball(center=[0.0, 0.5 * PIXEL, 0.0]), 0.5),
    "radius": (drawn(), with_ball(radius=1 + 0.6 * PIXEL), -0.6),
    "gamma": (CLEAN**1.08 + NOISE, SCENE, 8.0),
    "mirrored left-right": (drawn()[:, ::-1], SCENE, 1.0),
    "mirrored upside down": (drawn()[::-1], SCENE, 1.0),
}


@pytest.mark.parametrize("name", WRONG)
def test_what_is_wrong_is_named(name: str):
    target, told, size = WRONG[name]
    result = fitted(target, told)
    cause = result.diagnosis[0]
    assert cause.name == name
    assert abs(cause.size - size) <= max(4 * cause.error, 0.1 * abs(size))
    assert cause.share > 0.8
    assert f"{name}" in str(result).splitlines()[-1]
    assert result.to_dict()["diagnosis"][0]["name"] == name


def test_a_large_one_is_as_large_as_it_is():
    beside = brdf.DirectionalLight(direction=[-0.5, -0.3, 0.8], intensity=[0.6])
    brighter = dataclasses.replace(beside, intensity=np.array([0.75]))
    true, told = (dataclasses.replace(SCENE, ambient=None, lights=(LIGHT, light)) for light in (brighter, beside))
    intensity = fitted(drawn(true), told).diagnosis[0]
    assert "intensity 1" in intensity.name
    turned = fitted(drawn(), with_light(8.0)).diagnosis[0]
    assert turned.name == "light"
    # By slopes alone these were told as 23.3 +- 0.1 or -23.3, and as 7.7 +- 0.1.
    assert min(abs(intensity.size - size) for size in (25.0, -20.0)) < 3 * intensity.error
    assert abs(turned.size - 8.0) < 2.5 * turned.error


@pytest.mark.parametrize("name", ["ball", "radius"])
def test_a_circle_that_is_far_off_is_told(name: str):
    told = with_ball(**{"ball": {"center": [0.0, 3 * PIXEL, 0.0]}, "radius": {"radius": 1 + 3 * PIXEL}}[name])
    cause = fitted(drawn(), told).diagnosis[0]
    # Pixels beside the ball lead the fit astray: it leaves half of the picture, with an n of 2.4.
    assert cause.name == name
    assert abs(cause.size) == pytest.approx(3, abs=2.5 * cause.error)
    assert cause.error < 0.15


def test_a_move_that_changes_nothing_is_none_of_a_light():
    angle = np.linspace(-np.pi / 2, np.pi / 2, 17)
    ring = np.stack([np.sin(angle), 0 * angle, np.cos(angle)], axis=-1)
    lower, corner = np.arange(16), [0.0, 1.0, 0.0]
    faces = [(i, i + 1, i + 18) for i in lower] + [(i, i + 18, i + 17) for i in lower]
    half = brdf.Triangles(Mesh(np.concatenate([ring - corner, ring + corner]), faces))
    true, told = (
        dataclasses.replace(
            SCENE,
            shapes=(half,),
            lights=(brdf.DirectionalLight([np.sin(turn), 0, np.cos(turn)], [1.0]),),
        )
        for turn in np.radians([30, 35])
    )
    # Of the cylinder's normals none leaves the plane in which the light has turned.
    cause = fitted(drawn(true), told).diagnosis[0]
    assert cause.name == "light"
    assert abs(cause.size) == pytest.approx(5, abs=3 * cause.error)


def test_a_plane_that_faces_away_from_its_light_ends_no_diagnosis():
    light = brdf.RectangleLight([1.2, 1.5, 2.4], [0.8, 0, 0], [0, 0.8, 0], [12.0])  # shines away from the ball
    told = dataclasses.replace(SMALL, lights=(light,))
    assert fitted(drawn(SMALL), told).diagnosis is not None


@pytest.mark.parametrize("true", ["phong", "normalized-blinn-phong"])
@pytest.mark.parametrize("codes", [False, True])
def test_another_model_is_named_and_no_ball_or_light_that_is_sound(true: str, codes: bool, tmp_path: Path):
    material = brdf.MODELS[true](k_a=[0.05], k_d=[0.35], k_s=[0.5], n=12)  # pyright: ignore[reportCallIssue]
    target = np.asarray(brdf.render(material, SCENE, precision="float64")) + NOISE
    if codes:
        brdf.write_image(tmp_path / "ball.png", target.astype(np.float32))
        target = brdf.read_picture(tmp_path / "ball.png", encoding="srgb")
    result = fitted(target)
    cause = result.diagnosis[0]
    assert cause.name == f"model {true}"
    assert cause.share > 0.9
    assert f"model {true} would explain" in str(result)
    assert f"--model {true}" in cause.remedy
    assert fitting.fit(target, SCENE, model=true).diagnosis == ()


def test_a_black_level_and_one_of_two_lights_are_named():
    beside = brdf.DirectionalLight(direction=[-0.5, -0.3, 0.8], intensity=[0.6])
    scene = dataclasses.replace(SCENE, ambient=None, lights=(LIGHT, beside))
    target = drawn(scene)
    assert fitted(target + 0.03, scene).diagnosis[0].name == "black"
    brighter = dataclasses.replace(beside, intensity=np.array([0.66]))
    told = dataclasses.replace(scene, lights=(LIGHT, brighter))
    # Either light may be the one: only their ratio shows.
    assert fitted(target, told).diagnosis[0].name in ("intensity 0 or intensity 1", "intensity 1 or intensity 0")


def test_ambient_light_that_a_scene_lacks_is_told_as_such():
    cause = fitted(drawn(), dataclasses.replace(SCENE, ambient=None)).diagnosis[0]
    assert cause.name == "black"
    assert abs(cause.size - 100 * MATERIAL.k_a[0]) < 4 * cause.error
    assert "give the scene the [ambient] light that it lacks" in cause.remedy


def test_nothing_is_named_where_nothing_is_wrong():
    result = fitted(drawn())
    assert result.diagnosis == ()
    assert "would explain" not in str(result)


def test_codes_of_srgb(tmp_path: Path):
    brdf.write_image(tmp_path / "ball.png", drawn().astype(np.float32))
    target = brdf.read_picture(tmp_path / "ball.png", encoding="srgb")
    assert fitted(target).diagnosis == ()
    cause = fitted(target, with_light(2.0)).diagnosis[0]
    assert cause.name == "light"
    assert abs(cause.size - 2.0) < 0.1


@pytest.mark.parametrize("noise", [0.0, 0.05])
def test_a_small_error_of_the_scene_is_seen_behind_rounding_and_rounding_is_none(noise: float):
    codes = 255 * CLEAN / CLEAN.max() + np.random.default_rng(3).normal(0, noise, CLEAN.shape)
    target = np.clip(np.rint(codes), 0, 255).astype(np.uint8)
    assert not any("structure" in words for words in fitted(target).warnings)
    result = fitted(target, with_light(0.15))
    assert any("structure" in words for words in result.warnings)
    assert result.diagnosis[0].name == "light"
    assert abs(result.diagnosis[0].size - 0.15) < 0.05


def test_an_unlit_side_counts_as_one_value_where_rounding_is_the_noise(tmp_path: Path):
    def read(values: np.ndarray) -> brdf.Picture:
        brdf.write_image(tmp_path / "ball.png", values.astype(np.float32))
        return brdf.read_picture(tmp_path / "ball.png", encoding="srgb")

    camera = dataclasses.replace(CAMERA, resolution=(128, 128))
    light = dataclasses.replace(LIGHT, direction=[0.9, 0.3, 0.3])
    scene = brdf.Scene(camera=camera, shapes=[BALL], lights=[light])
    shown = 1.5 * np.asarray(brdf.render(MATERIAL, scene, precision="float64"))
    assert fitted(read(shown), scene).diagnosis == ()
    # Less than half a code: the dark side of thousands of pixels shows 0 all the same.
    cause = fitted(read(shown + 1.4e-4), scene).diagnosis[0]
    assert cause.name.startswith("black")
    assert abs(cause.size - 0.014) < 0.005
    moved = dataclasses.replace(scene, shapes=(dataclasses.replace(BALL, center=[0.02 * 2.2 / 128, 0.0, 0.0]),))
    cause = fitted(read(shown), moved).diagnosis[0]
    assert cause.name.startswith("ball")
    assert abs(cause.size - 0.02) < 4 * cause.error < 0.01


def test_what_errs_together_in_a_clipped_float_picture_is_told():
    target = np.minimum(drawn(noise=0.002), 0.6)
    assert not any("structure" in words for words in fitted(target).warnings)
    result = fitted(target, with_light(1.0))
    assert any("structure" in words for words in result.warnings)
    assert result.diagnosis[0].name == "light"


AREA = brdf.RectangleLight(center=[0, 2, 2], edge_u=[0.5, 0, 0], edge_v=[0, 0, 0.5], radiance=[3.0], samples=4)
ODD = {
    "no light": dataclasses.replace(SCENE, lights=()),
    "environment": dataclasses.replace(SCENE, lights=(brdf.ConstantEnvironment(radiance=[1.0]),), ambient=None),
    "area light": dataclasses.replace(SMALL, lights=(AREA,)),
    "surface points": brdf.some_pixels(SCENE, np.arange(SIZE * SIZE).reshape(SIZE, SIZE)[16:48, 16:48]),
}


@pytest.mark.parametrize("name", [*ODD, "mesh"])
def test_scenes_that_lack_a_cause(name: str, tmp_path: Path):
    if name == "mesh":
        (tmp_path / "mesh.obj").write_text("v -1 -1 0\nv 1 -1 0\nv 0 1 0.5\nf 1 2 3\n")
        scene = dataclasses.replace(SCENE, shapes=(brdf.Triangles(brdf.load_mesh(tmp_path / "mesh.obj")),))
    else:
        scene = ODD[name]
    result = fitting.fit(drawn(scene), scene, model="lambert")
    assert all(cause.share > 0.3 for cause in result.diagnosis)


def test_of_several_pictures_the_one_is_named():
    scenes = [SCENE, with_light(40.0), with_light(-30.0)]
    targets = [drawn(scene) for scene in scenes]
    told = [SCENE, with_light(42.0), with_light(-30.0)]
    assert fitted(targets, told).diagnosis[0].name == "light of picture 1"


def test_a_noisy_picture_hides_nothing_of_the_others():
    """By the noise of all of them together a light of half a degree was found in four of ten, to a tenth of it."""
    scenes = [SCENE, with_light(40.0), with_light(-30.0), with_light(70.0)]
    targets = [drawn(scene, noise) for scene, noise in zip(scenes, (0.002, 0.002, 0.002, 0.05), strict=True)]
    cause = fitted(targets, [with_light(0.5), *scenes[1:]]).diagnosis[0]
    assert cause.name == "light of picture 0"
    assert cause.size == pytest.approx(0.5, abs=4 * cause.error)
    assert cause.error < 0.03


def near(kind: str, place: Any) -> brdf.Scene:
    """A light that looks at the ball, a little above its middle; of many samples fewer pixels."""
    place = np.asarray(place, float)
    lights = {
        "point": lambda: brdf.PointLight(place, 9.0),
        "spot": lambda: brdf.SpotLight(place, -place, 9.0, cutoff_angle=60, exponent=2),
        "sphere": lambda: brdf.SphereLight(place, 0.4, radiance=18.0, samples=16),
    }
    return dataclasses.replace(SMALL if kind == "sphere" else SCENE, lights=(lights[kind](),))


@pytest.mark.parametrize("kind", ["point", "spot", "sphere"])
def test_a_near_light_stands_elsewhere(kind: str):
    place, angle = np.array([1.2, 1.5, 2.4]), np.radians(1.5)
    target = drawn(near(kind, place))
    assert fitted(target, near(kind, place)).diagnosis == ()
    turned = dataclasses.replace(near(kind, place).lights[0])
    field = "center" if hasattr(turned, "center") else "position"
    for name, size, moved in (
        ("light", 1.5, np.cos(angle) * place + np.sin(angle) * np.linalg.norm(place) * ACROSS),
        ("distance", -5.0, place * 1.05),
    ):
        told = dataclasses.replace(near(kind, place), lights=(dataclasses.replace(turned, **{field: moved}),))
        result = fitted(target, told)
        cause = result.diagnosis[0]
        assert name in cause.name
        assert abs(cause.size - size) < max(4 * cause.error, 0.1 * abs(size))
        if kind == "point":
            freed = fitting.fit_jointly(target, told, result, ["light", "distance"])
            np.testing.assert_allclose(freed.values[-1], place, atol=0.05)


@pytest.mark.parametrize("axis", [0, 1])
def test_one_mirrored_picture_of_several_is_named(axis: int):
    scenes = [SCENE, with_light(40.0), with_light(-30.0)]
    targets = [drawn(scene) for scene in scenes]
    targets[1] = np.flip(targets[1], axis)
    name = ["mirrored upside down", "mirrored left-right"][axis]
    assert fitted(targets, scenes).diagnosis[0].name == f"{name} of picture 1"


def test_what_was_named_is_freed():
    target, told, _ = WRONG["light"]
    result = fitting.fit_jointly(target, told, fitted(target, told), "light")
    np.testing.assert_allclose(float(result.parameters[-1]), 2.0, atol=0.15)
    assert result.diagnosis == ()
    ball = fitting.fit_jointly(target, with_ball(radius=1.01), MATERIAL, ["radius"])
    np.testing.assert_allclose(ball.values[-1], 1.0, atol=2e-3)


def test_what_cannot_be_freed_is_told():
    with pytest.raises(brdf.InputError, match="'gamma', which is no number of a scene"):
        fitting.fit_jointly(drawn(), SCENE, MATERIAL, "gamma")


def test_a_picture_that_is_its_own_mirror_image_is_not_mirrored():
    """Another fit of it explains more where the first was no least squares."""
    lit, told = (
        dataclasses.replace(SCENE, lights=(dataclasses.replace(LIGHT, direction=np.array([0.0, height, 0.8])),))
        for height in (0.5, 0.55)
    )
    target = drawn(lit)
    result = fitted((target + target[:, ::-1]) / 2, told)
    other = dataclasses.replace(result.material, n=2 * result.material.n)
    causes = dataclasses.replace(result, material=other).diagnosis
    assert causes
    assert not any("mirrored" in cause.name for cause in causes)


def test_where_nothing_is_left_nothing_is_wrong():
    target = np.asarray(brdf.render(brdf.Lambert(k_a=0.5, k_d=0), SCENE))
    assert fitting.fit(target, SCENE).diagnosis == ()
