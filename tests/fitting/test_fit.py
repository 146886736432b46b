"""The front door: random materials come back, pictures combine, and what cannot be used is refused in one sentence."""

import json

import numpy as np
import pytest
from small_ball import CAMERA, SIZE, SUN, ball_scene, pictured

import brdf
import fitting

LAMP = brdf.PointLight(position=[-2.0, 1.0, 3.0], intensity=[6.0, 6.0, 6.0])
SCENE = ball_scene()
SHINY = brdf.BlinnPhong(k_a=[0.3, 0.2, 0.1], k_d=[0.5, 0.4, 0.3], k_s=0.3, n=40.0)
MATT = pictured(brdf.Lambert(k_d=0.5), SCENE)


@pytest.mark.parametrize("model", brdf.MODELS)
@pytest.mark.parametrize("lights", [(SUN,), (SUN, LAMP)], ids=["one light", "two lights"])
def test_random_materials_come_back(model: str, lights: tuple):
    random = np.random.default_rng(list(brdf.MODELS).index(model))
    scene = ball_scene(*lights)
    for _ in range(3):
        k = {name: random.uniform(0, 0.5, 3) for name in ("k_a", "k_d")}
        if model != "lambert":
            k |= {"k_s": 0.4 * random.uniform(0.1, 1, 3), "n": np.exp(random.uniform(np.log(0.5), np.log(500)))}
        truth = brdf.MODELS[model](**k)
        found = fitting.fit(pictured(truth, scene), scene, model=model, precision="float64").material
        for name, value in k.items():
            # Noise-free float64; the solver stops at 5e-9 of n.
            assert np.asarray(getattr(found, name)) == pytest.approx(value, rel=1e-6, abs=1e-8), name


def test_two_pictures_tell_what_one_does_not():
    dark = ball_scene(ambient=None)
    one = fitting.fit(pictured(SHINY, dark), dark, model="blinn-phong", precision="float64")
    assert "k_a[0]" in one.undetermined
    pictures = [pictured(SHINY, dark), pictured(SHINY, SCENE)]
    both = fitting.fit(pictures, [dark, SCENE], model="blinn-phong", precision="float64")
    assert both.undetermined == {}
    assert both.material.k_a == pytest.approx(SHINY.k_a, rel=1e-6)
    assert "2 pictures" in str(both)


def test_a_picture_under_a_lamp_of_one_colour_is_drawn_in_that_colour():
    """Channels without light were drawn as bright as the others."""
    lamps = [brdf.DirectionalLight(direction=[0.4, 0.5, 0.8], intensity=colour) for colour in ([1, 0, 0], [1, 1, 1])]
    scenes = [ball_scene(lamp, ambient=None) for lamp in lamps]
    result = fitting.fit([pictured(SHINY, scene) for scene in scenes], scenes, model="blinn-phong")
    for index, scene in enumerate(scenes):
        np.testing.assert_allclose(result.fitted(index), brdf.render(result.material, scene), atol=1e-6)


def test_a_constant_picture_is_not_taken_for_a_clipped_one():
    result = fitting.fit(np.full_like(MATT, 0.5), SCENE, model="lambert")
    assert not result.left_out.get("clipped")
    assert result.pixels == np.count_nonzero(SCENE.surface_points().mask)


def test_of_several_pictures_one_that_shows_one_value_is_clipped():
    with pytest.raises(brdf.InputError, match=r"target\[1\]: is clipped at"):
        fitting.fit([MATT, np.ones_like(MATT)], [SCENE, SCENE])


def test_clipped_and_missing_pixels_are_left_out_and_counted():
    truth = brdf.BlinnPhong(k_a=0.3, k_d=[0.5, 0.4, 0.3], k_s=0.8, n=20.0)
    picture = np.minimum(pictured(truth, SCENE), 0.9)
    picture[20, 20:24] = np.nan
    result = fitting.fit(picture, SCENE, model="blinn-phong", precision="float64")
    assert result.left_out["not finite"] == 4
    assert result.left_out["clipped"] > 10
    assert float(result.material.n) == pytest.approx(20.0, rel=1e-6)


@pytest.mark.parametrize("few", [2, 5])
def test_a_few_clipped_pixels_are_known_by_their_one_value(few: int):
    truth = brdf.BlinnPhong(k_a=0.3, k_d=[0.5, 0.4, 0.3], k_s=0.8, n=20.0)
    clean = pictured(truth, SCENE)
    assert not fitting.fit(clean, SCENE, model="blinn-phong").left_out.get("clipped")
    noisy = (clean + np.random.default_rng(1).normal(0, 0.003, clean.shape)).astype(np.float32)
    level = np.sort(noisy.max(axis=-1), axis=None)[-few]
    result = fitting.fit(np.minimum(noisy, level), SCENE, model="blinn-phong")
    assert result.left_out["clipped"] == few
    told = fitting.fit(np.minimum(noisy, level), SCENE, model="blinn-phong", saturation=level)
    np.testing.assert_allclose(result.material.k_s, told.material.k_s, rtol=1e-4)
    np.testing.assert_allclose(result.material.n, told.material.n, rtol=1e-4)


def test_the_result_as_json_is_standard_json():
    matt = pictured(brdf.BlinnPhong(k_a=0.3, k_d=[0.5, 0.4, 0.3], k_s=0.0, n=20.0), SCENE)
    result = fitting.fit(matt, SCENE, model="blinn-phong")
    values = json.loads(json.dumps(result.to_dict(), allow_nan=False))
    assert values["material"]["n"] is None
    assert values["material"]["k_s"] == [None] * 3
    assert {p["name"]: p["reason"] for p in values["parameters"]}["n"]
    chosen = fitting.fit(matt, SCENE)
    json.dumps(chosen.to_dict(), allow_nan=False)
    assert [c["chosen"] for c in chosen.to_dict()["candidates"]].count(True) == 1


def test_float32_and_float64_agree():
    picture = pictured(SHINY, SCENE).astype(np.float32)
    single, double = (
        fitting.fit(picture, SCENE, model="blinn-phong", precision=p).material for p in ("float32", "float64")
    )
    # Float32 geometry: some 1e-6 of the lobe.
    assert float(single.n) == pytest.approx(float(double.n), rel=1e-4)
    assert single.k_s == pytest.approx(double.k_s, rel=1e-4)


WHOLE = (SIZE, SIZE)
REFUSED = [
    ({"model": "cook-torrance"}, "model: is unknown, got 'cook-torrance'"),
    ({"model": "ward", "accuracy": 0.01}, "model: is unknown"),
    ({"model": "phong", "plausible": True}, "model: phong is neither reciprocal nor energy conserving"),
    ({"precision": "float16"}, "precision: is unknown, got 'float16'"),
    ({"loss": "absolute"}, "loss: is unknown, got 'absolute'"),
    ({"n_range": (10, 1)}, "n_range: must be 0 < lower < upper"),
    ({"n_range": ("a", 2)}, "n_range: must be 0 < lower < upper"),
    ({"mask": np.ones((3, 3), bool)}, "mask: is of shape"),
    ({"mask": np.ones((3, 3), bool), "accuracy": 0.01}, "mask: is of shape"),
    ({"mask": np.zeros(WHOLE, bool)}, "mask: leaves no pixel"),
    ({"mask": np.full(WHOLE, np.nan)}, "mask: must hold finite numbers"),
    ({"weight": np.zeros(WHOLE)}, "weight: must be 0 or more, and more somewhere"),
    ({"weight": -np.ones(WHOLE)}, "weight: must be 0 or more, and more somewhere"),
    ({"weight": np.full(WHOLE, "1")}, "weight: must hold finite numbers"),
    ({"saturation": 1e-9}, "target: is clipped at 1e-09"),
    ({"saturation": 0.0}, "saturation: must be above 0"),
    ({"saturation": "high"}, "saturation: must be a linear value, got 'high'"),
    ({"dark": True}, "dark: must be a linear value, got True"),
    ({"dark": 1e9}, "target: is no brighter than 1e[+]09"),
    ({"noise": 0.1}, "noise: must be two numbers, got 0.1"),
    ({"noise": (0.0, 0.0)}, "noise: must be two numbers of 0 or more, not both 0"),
    ({"target": []}, "target: is an empty list"),
    ({"target": np.zeros((*WHOLE, 3))}, "target: is black on the object"),
    ({"target": (MATT > [0.1, 0.2, 0.3]) * 1.0}, "target: is clipped at 1 or black wherever it sees the object"),
    ({"target": np.full((*WHOLE, 3), np.nan)}, "target: has no finite value"),
    ({"target": np.ones((10, 10, 3))}, "target: is 10 x 10"),
    ({"target": MATT[::2], "accuracy": 0.01}, f"target: is {SIZE} x {SIZE // 2}"),
    ({"target": np.ones((*WHOLE, 3), int)}, "target: must hold floating-point values, or codes"),
    ({"target": np.ones((2, *WHOLE, 3))}, "target: must be of shape"),
    ({"target": MATT[..., :2]}, "target: has 2 channels, the scene's light 3"),
    ({"target": "picture.exr"}, "picture.exr: there is no such file"),
    ({"target": MATT * 1e-30}, "target: has .* out of reach of float32"),
    ({"target": MATT * 1e30}, "target: has .* out of reach of float32"),
    ({"target": MATT * np.float64(-1e80), "precision": "float64"}, "target: has .* out of reach of float64"),
    ({"scene": "scene.toml"}, "scene: must be a brdf.Scene, got str"),
    ({"scene": [SCENE, SCENE]}, "scene: has 2 entries for 1 pictures"),
    ({"target": [MATT, MATT], "mask": [None]}, "mask: has 1 entries for 2 pictures"),
    ({"scene": ball_scene(camera=CAMERA.__class__(**(vars(CAMERA) | {"target": [9, 0, 4]})))}, "target: has no pixel"),
    (
        {
            "target": [MATT, MATT[..., :1]],
            "scene": [SCENE, ball_scene(brdf.DirectionalLight(direction=[0, 0, 1], intensity=1.0), ambient=[0.2])],
        },
        "target: pictures have {.*} channels",
    ),
]


@pytest.mark.parametrize(("arguments", "message"), REFUSED)
def test_what_cannot_be_used_is_refused(arguments: dict, message: str):
    arguments = {"target": np.minimum(MATT, 0.3), "scene": SCENE} | arguments
    with pytest.raises(brdf.InputError, match=f"^{message}"):
        fitting.fit(**arguments)


@pytest.mark.parametrize("factor", [1e-9, 1e9])
def test_the_unit_of_the_picture_does_not_matter(factor: float):
    material = brdf.BlinnPhong(k_d=[0.5, 0.3, 0.1], k_s=[0.3, 0.3, 0.3], n=40.0)
    found = fitting.fit(pictured(material, SCENE) * factor, SCENE, model="blinn-phong").material
    np.testing.assert_allclose(found.n, 40.0, rtol=1e-4)
    np.testing.assert_allclose(np.asarray(found.k_d) / factor, [0.5, 0.3, 0.1], rtol=1e-4)


@pytest.mark.parametrize("factor", [1e-30, 1e30])
def test_float64_reaches_farther(factor: float):
    found = fitting.fit(MATT * factor, SCENE, model="lambert", precision="float64").material
    np.testing.assert_allclose(np.asarray(found.k_d) / factor, 0.5, rtol=1e-9)


def test_the_length_of_a_direction_does_not_matter():
    for factor in (1e-200, 1e200):
        light = brdf.DirectionalLight(direction=np.asarray(SUN.direction) * factor, intensity=SUN.intensity)
        picture = pictured(brdf.Lambert(k_d=0.5), ball_scene(light))
        np.testing.assert_allclose(picture, MATT, rtol=1e-5, atol=1e-7)


def test_a_scene_that_is_not_that_of_the_picture_is_asked_about():
    truth = ball_scene(ambient=None)
    picture = pictured(brdf.Lambert(k_d=0.5), truth)
    light = brdf.DirectionalLight(direction=[-0.9, -0.4, 0.05], intensity=[1.0, 1.0, 1.0])
    behind = ball_scene(light, ambient=None)
    assert any("are light, camera and encoding" in words for words in fitting.fit(picture, behind).warnings)
    assert not fitting.fit(picture, truth).warnings


def test_what_weighs_nothing_says_nothing():
    picture = pictured(SHINY, SCENE).astype(np.float32)
    weight = np.full(WHOLE, 1e30)
    weight[24, 24], picture[24, 24] = 0.0, 1e11
    found = fitting.fit(picture, SCENE, model="blinn-phong", weight=weight).material
    np.testing.assert_allclose(found.n, 40.0, rtol=1e-4)


def test_levels_may_be_numpy_numbers():
    assert fitting.fit(MATT, SCENE, saturation=np.float32(0.3)).left_out["clipped"] > 0


@pytest.mark.parametrize("precision", ["float32", "float64"])
def test_a_highlight_that_does_not_stand_out_leaves_the_fit_of_the_matt_rest(precision):
    faint = brdf.BlinnPhong(k_a=[0.1] * 3, k_d=[0.5] * 3, k_s=[0.001] * 3, n=50.0)
    picture = pictured(faint, SCENE, 0.3, seed=1)
    result, matt = (fitting.fit(picture, SCENE, model=m, precision=precision) for m in ("blinn-phong", "lambert"))
    assert not np.any(result.material.k_s)
    reasons = {parameter.reason for parameter in result.parameters if parameter.name in ("k_s", "n")}
    assert reasons == {"the highlight does not stand out of the noise"}
    np.testing.assert_allclose(result.material.k_d, matt.material.k_d, rtol=1e-6)
    np.testing.assert_allclose(result.residual, matt.residual, rtol=1e-7)
    # The optimum of the search is told all the same.
    assert np.any(result.optimum.x[2] > 0)
    assert np.sum(result.optimum.cost) < np.sum(matt.optimum.cost)
    robust = [
        fitting.fit(picture, SCENE, model=m, precision=precision, loss="huber") for m in ("blinn-phong", "lambert")
    ]
    np.testing.assert_allclose(robust[0].material.k_a, robust[1].material.k_a, rtol=1e-4)


def test_errors_of_the_matt_rest_allow_for_a_highlight_that_may_be_there():
    faint, off = brdf.BlinnPhong(k_a=0.3, k_d=0.5, k_s=0.006, n=8.0), []
    for seed in range(20):
        result = fitting.fit(pictured(faint, SCENE, 0.02, seed), SCENE, model="blinn-phong")
        assert not np.any(result.material.k_s)
        off += [(number.value - 0.5) / number.error for number in result["k_d"]]
    assert np.sqrt(np.mean(np.square(off))) < 1.5  # as if there were none 2.0 of 60 draws, with that allowed for 1.26


def test_what_is_plausible_stays_so_without_its_highlight():
    camera = brdf.OrthographicCamera(
        position=[0.0, 0.0, 4.0], target=[0.0, 0.0, 0.0], up=[0.0, 1.0, 0.0], width=0.8, resolution=(32, 32)
    )
    light = brdf.DirectionalLight(direction=[0.1, 0.1, 1.0], intensity=1.0)
    white = ball_scene(light, ambient=None, camera=camera)
    for seed in range(15):
        picture = pictured(brdf.Lambert(k_d=[1.0]), white, 0.02, seed)
        material = fitting.fit(picture, white, model="normalized-phong", plausible=True).material
        assert float(material.k_d[0] + material.k_s[0]) <= 1 + 1e-6


@pytest.mark.parametrize(("n", "bounds", "at"), [(400.0, (1, 128), "128"), (20.0, (50, 1000), "50")])
def test_an_exponent_that_its_range_holds_is_told_as_that(n, bounds, at):
    picture = pictured(brdf.BlinnPhong(k_a=0.1, k_d=0.5, k_s=0.3, n=n), SCENE, 0.01)
    result = fitting.fit(picture, SCENE, model="blinn-phong", n_range=bounds)
    assert result["n"].reason == f"it is held at {at}, a bound of n_range"
    assert float(result.material.n) == pytest.approx(float(at))
    low, high = result["n"].interval
    assert bounds[0] <= low <= high <= bounds[1]
