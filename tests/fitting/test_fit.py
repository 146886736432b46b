"""The front door: random materials come back, pictures combine, and what cannot be used is refused in one sentence."""

import json

import numpy as np
import pytest
from project_paths import ROOT

import brdf
import fitting
from brdf.lights.base import Light

CAMERA = brdf.OrthographicCamera(position=[0, 0, 4], target=[0, 0, 0], up=[0, 1, 0], width=2.2, resolution=(72, 72))
BALL = brdf.Sphere(center=[0, 0, 0], radius=1)
SUN = brdf.DirectionalLight(direction=[0.5, 0.6, 0.7], intensity=[1.0, 0.8, 0.6])
LAMP = brdf.PointLight(position=[-2.0, 1.0, 3.0], intensity=[6.0, 6.0, 6.0])
AMBIENT = [0.2, 0.2, 0.3]


def scene(*lights: Light, ambient=AMBIENT) -> brdf.Scene:
    return brdf.Scene(camera=CAMERA, shapes=[BALL], ambient=ambient, lights=lights)


def rendered(material: brdf.Material, place: brdf.Scene) -> np.ndarray:
    return np.asarray(brdf.render(material, place, precision="float64"))


@pytest.mark.parametrize("model", brdf.MODELS)
@pytest.mark.parametrize("lights", [(SUN,), (SUN, LAMP)], ids=["one light", "two lights"])
def test_random_materials_come_back(model: str, lights: tuple[Light, ...]):
    random = np.random.default_rng(list(brdf.MODELS).index(model))
    for _ in range(3):
        k = {name: random.uniform(0, 0.5, 3) for name in ("k_a", "k_d")}
        if model != "lambert":
            k |= {"k_s": 0.4 * random.uniform(0.1, 1, 3), "n": np.exp(random.uniform(np.log(0.5), np.log(500)))}
        truth = brdf.MODELS[model](**k)
        found = fitting.fit(rendered(truth, scene(*lights)), scene(*lights), model=model, precision="float64").material
        for name, value in k.items():
            # Noise-free float64; the engine stops at 5e-9 of n.
            assert np.asarray(getattr(found, name)) == pytest.approx(value, rel=1e-6, abs=1e-8), name


def test_two_pictures_tell_what_one_does_not():
    truth = brdf.BlinnPhong(k_a=[0.3, 0.2, 0.1], k_d=[0.5, 0.4, 0.3], k_s=0.3, n=40.0)
    dark, light = scene(SUN, ambient=None), scene(SUN)
    one = fitting.fit(rendered(truth, dark), dark, model="blinn-phong", precision="float64")
    assert "k_a" in one.undetermined or "k_a[0]" in one.undetermined
    both = fitting.fit(
        [rendered(truth, dark), rendered(truth, light)], [dark, light], model="blinn-phong", precision="float64"
    )
    assert both.undetermined == {}
    assert both.material.k_a == pytest.approx(truth.k_a, rel=1e-6)
    assert "2 pictures" in str(both)


def test_clipped_and_missing_pixels_are_left_out_and_counted():
    truth = brdf.BlinnPhong(k_a=0.3, k_d=[0.5, 0.4, 0.3], k_s=0.8, n=20.0)
    picture = np.minimum(rendered(truth, scene(SUN)), 0.9)
    picture[30, 30:34] = np.nan
    result = fitting.fit(picture, scene(SUN), model="blinn-phong", precision="float64")
    assert result.left_out["not finite"] == 4
    assert result.left_out["clipped"] > 20
    assert float(result.material.n) == pytest.approx(20.0, rel=1e-6)


def test_the_result_as_json_is_standard_json():
    truth = brdf.BlinnPhong(k_a=0.3, k_d=[0.5, 0.4, 0.3], k_s=0.0, n=20.0)
    result = fitting.fit(rendered(truth, scene(SUN)), scene(SUN), model="blinn-phong")
    values = json.loads(json.dumps(result.to_dict(), allow_nan=False))
    assert values["material"]["n"] is None
    assert values["material"]["k_s"] == [None] * 3
    assert {p["name"]: p["reason"] for p in values["parameters"]}["n"]
    named = fitting.fit(rendered(truth, scene(SUN)), scene(SUN))
    json.dumps(named.to_dict(), allow_nan=False)
    assert [c["chosen"] for c in named.to_dict()["candidates"]].count(True) == 1


def test_float32_and_float64_agree():
    truth = brdf.BlinnPhong(k_a=[0.3, 0.2, 0.1], k_d=[0.5, 0.4, 0.3], k_s=0.3, n=40.0)
    picture = rendered(truth, scene(SUN)).astype(np.float32)
    single, double = (
        fitting.fit(picture, scene(SUN), model="blinn-phong", precision=p) for p in ("float32", "float64")
    )
    # Float32 geometry: some 1e-6 of the lobe.
    assert float(single.material.n) == pytest.approx(float(double.material.n), rel=1e-4)
    assert single.material.k_s == pytest.approx(double.material.k_s, rel=1e-4)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"model": "cook-torrance"}, "model: is unknown, got 'cook-torrance'"),
        ({"precision": "float16"}, "precision: is unknown, got 'float16'"),
        ({"n_range": (10, 1)}, "n_range: must be 0 < lower < upper"),
        ({"mask": np.ones((3, 3), bool)}, "mask: is of shape"),
        ({"mask": np.zeros((72, 72), bool)}, "mask: leaves no pixel"),
        ({"saturation": 1e-9}, "target: is clipped at 1e-09"),
    ],
)
def test_what_cannot_be_used_is_refused(arguments: dict, message: str):
    picture = rendered(brdf.Lambert(k_d=0.5), scene(SUN))
    with pytest.raises(brdf.InputError, match=message):
        fitting.fit(picture, scene(SUN), **arguments)


@pytest.mark.parametrize(
    ("target", "message"),
    [
        ([], "target: is an empty list"),
        (np.zeros((72, 72, 3)), "target: is black on the object"),
        (np.full((72, 72, 3), np.nan), "target: has no finite value"),
        (np.ones((10, 10, 3)), "target: is 10 x 10"),
        (np.ones((72, 72, 3), int), "target: must hold linear floating-point values"),
        ("picture.exr", "target: must be an array, got str"),
    ],
)
def test_targets_that_cannot_be_used_are_refused(target, message: str):
    with pytest.raises(brdf.InputError, match=message):
        fitting.fit(target, scene(SUN))


@pytest.mark.parametrize("factor", [1e-9, 1e9])
def test_the_unit_of_the_picture_does_not_matter(factor: float):
    material = brdf.BlinnPhong(k_d=[0.5, 0.3, 0.1], k_s=[0.3, 0.3, 0.3], n=40.0)
    found = fitting.fit(rendered(material, scene(SUN)) * factor, scene(SUN), model="blinn-phong").material
    assert isinstance(found, brdf.BlinnPhong)
    np.testing.assert_allclose(found.n, 40.0, rtol=1e-4)
    np.testing.assert_allclose(np.asarray(found.k_d) / factor, [0.5, 0.3, 0.1], rtol=1e-4)


@pytest.mark.parametrize("factor", [1e-30, 1e30])
def test_values_out_of_reach_are_refused(factor: float):
    picture = np.asarray(rendered(brdf.Lambert(k_d=0.5), scene(SUN)), np.float64) * factor
    with pytest.raises(brdf.InputError, match=r"^target: has .* out of reach of float32"):
        fitting.fit(picture, scene(SUN))
    found = fitting.fit(picture, scene(SUN), model="lambert", precision="float64").material
    np.testing.assert_allclose(np.asarray(found.k_d) / factor, 0.5, rtol=1e-9)


def test_the_length_of_a_direction_does_not_matter():
    material = brdf.Lambert(k_d=0.5)
    whole = rendered(material, scene(SUN))
    for factor in (1e-200, 1e200):
        light = brdf.DirectionalLight(direction=np.asarray(SUN.direction) * factor, intensity=SUN.intensity)
        np.testing.assert_allclose(rendered(material, scene(light)), whole, rtol=1e-5, atol=1e-7)


def test_a_scene_that_is_not_that_of_the_picture_is_asked_about():
    picture = rendered(brdf.Lambert(k_d=0.5), scene(SUN, ambient=None))
    behind = brdf.DirectionalLight(direction=[-0.9, -0.4, 0.05], intensity=1.0)
    assert any(
        "are light, camera and encoding" in w for w in fitting.fit(picture, scene(behind, ambient=None)).warnings
    )
    assert not fitting.fit(picture, scene(SUN, ambient=None)).warnings


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"weight": np.zeros((72, 72))}, "weight: must be 0 or more, and more somewhere"),
        ({"weight": np.full((72, 72), "1")}, "weight: must hold finite numbers"),
        ({"mask": np.full((72, 72), np.nan)}, "mask: must hold finite numbers"),
        ({"saturation": 0.0}, "saturation: must be above 0"),
        ({"n_range": ("a", 2)}, "n_range: must be 0 < lower < upper"),
        ({"dark": 1e9}, "target: is no brighter than 1e[+]09"),
        ({"model": "ward", "accuracy": 0.01}, "model: is unknown"),
        ({"mask": np.ones((3, 3), bool), "accuracy": 0.01}, "mask: is of shape"),
    ],
)
def test_more_of_what_cannot_be_used_is_refused(arguments: dict, message: str):
    picture = np.minimum(rendered(brdf.Lambert(k_d=0.5), scene(SUN)), 0.3)
    with pytest.raises(brdf.InputError, match=message):
        fitting.fit(picture, scene(SUN), **arguments)


def test_an_accuracy_looks_at_the_size_of_the_picture_too():
    with pytest.raises(brdf.InputError, match="target: is 72 x 36"):
        fitting.fit(rendered(brdf.Lambert(k_d=0.5), scene(SUN))[::2], scene(SUN), accuracy=0.01)


def test_what_weighs_nothing_says_nothing():
    material = brdf.BlinnPhong(k_d=[0.5, 0.3, 0.1], k_s=[0.3, 0.3, 0.3], n=40.0)
    picture = rendered(material, scene(SUN)).astype(np.float32)
    weight = np.full((72, 72), 1e30)
    weight[36, 36], picture[36, 36] = 0.0, 1e11
    found = fitting.fit(picture, scene(SUN), model="blinn-phong", weight=weight).material
    assert isinstance(found, brdf.BlinnPhong)
    np.testing.assert_allclose(found.n, 40.0, rtol=1e-4)


def test_levels_may_be_numpy_numbers():
    picture = rendered(brdf.Lambert(k_d=0.5), scene(SUN))
    assert fitting.fit(picture, scene(SUN), saturation=np.float32(0.3)).left_out["clipped"] > 0


MATT_PAIR = "blinn-phong", "lambert"


@pytest.mark.parametrize("precision", ["float32", "float64"])
def test_a_highlight_that_does_not_stand_out_leaves_the_fit_of_the_matt_rest(precision):
    scene = brdf.Scene.load(ROOT / "data" / "gold-ball" / "scene.toml")
    faint = brdf.BlinnPhong(k_a=[0.1] * 3, k_d=[0.5] * 3, k_s=[0.001] * 3, n=50.0)
    picture = np.asarray(brdf.render(faint, scene, precision="float64"))
    picture = picture + 0.3 * np.random.default_rng(1).standard_normal(picture.shape)
    result = fitting.fit(picture, scene, model="blinn-phong", precision=precision)
    matt = fitting.fit(picture, scene, model="lambert", precision=precision)
    assert not np.any(result.material.k_s)
    assert {one.reason for one in result.parameters if one.name in ("k_s", "n")} == {
        "the highlight does not stand out of the noise"
    }
    np.testing.assert_allclose(result.material.k_d, matt.material.k_d, rtol=1e-6)
    np.testing.assert_allclose(result.residual, matt.residual, rtol=1e-7)
    # The optimum of the search is told all the same.
    assert np.any(result.optimum.x[2] > 0)
    assert np.sum(result.optimum.cost) < np.sum(matt.optimum.cost)
    robust = [fitting.fit(picture, scene, model=name, precision=precision, loss="huber") for name in MATT_PAIR]
    np.testing.assert_allclose(robust[0].material.k_a, robust[1].material.k_a, rtol=1e-4)


def test_what_is_plausible_stays_so_without_its_highlight():
    camera = brdf.OrthographicCamera(
        position=[0.0, 0.0, 4.0], target=[0.0, 0.0, 0.0], up=[0.0, 1.0, 0.0], width=0.8, resolution=(32, 32)
    )
    light = brdf.DirectionalLight(direction=[0.1, 0.1, 1.0], intensity=1.0)
    white = brdf.Scene(camera=camera, shapes=[brdf.Sphere(center=[0.0, 0.0, 0.0], radius=1.0)], lights=[light])
    clean = np.asarray(brdf.render(brdf.Lambert(k_d=[1.0]), white))
    for seed in range(40):
        picture = clean + 0.02 * np.random.default_rng(seed).standard_normal(clean.shape)
        material = fitting.fit(picture, white, model="normalized-phong", plausible=True).material
        assert float(material.k_d[0] + material.k_s[0]) <= 1 + 1e-6
