"""The general road: freed lights are found again, bounds are met exactly, and what no picture determines is said."""

import json
from pathlib import Path

import numpy as np
import pytest

import brdf
import fitting
from benchmarks.truth import COVERAGE, ball

CAMERA = brdf.OrthographicCamera(position=[0, 0, 4], target=[0, 0, 0], up=[0, 1, 0], width=2.2, resolution=(40, 40))
LARGER = brdf.OrthographicCamera(position=[0, 0, 4], target=[0, 0, 0], up=[0, 1, 0], width=2.2, resolution=(80, 80))
BALL = brdf.Sphere(center=[0, 0, 0], radius=1)
TRUE_DIRECTION = np.array([0.5, 0.6, 0.7]) / np.linalg.norm([0.5, 0.6, 0.7])
MATERIAL = brdf.BlinnPhong(k_a=[0.1, 0.2, 0.0], k_d=[0.5, 0.4, 0.3], k_s=[0.3, 0.2, 0.0], n=25)


def scene(direction, intensity) -> brdf.Scene:
    """Two lights: the known one fixes the factor between light and material."""
    lights = [
        brdf.DirectionalLight(direction=direction, intensity=intensity),
        brdf.DirectionalLight(direction=[-1, 0.2, 0.6], intensity=[0.5, 0.5, 0.5]),
    ]
    return brdf.Scene(camera=CAMERA, shapes=[BALL], ambient=[0.2, 0.2, 0.2], lights=lights)


def angle(a, b) -> float:
    """Degrees between two directions."""
    a, b = a / np.linalg.norm(a), b / np.linalg.norm(b)
    return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b)))


@pytest.fixture(scope="module")
def target() -> np.ndarray:
    return np.asarray(brdf.render(MATERIAL, scene(TRUE_DIRECTION, [1.0, 0.9, 0.8]), precision="float64"))


@pytest.mark.parametrize("solver", ["lm", "bfgs"])
def test_light_and_material_are_found_together(target: np.ndarray, solver):
    away = TRUE_DIRECTION + 0.18 * np.array([0.6, -0.5, 0.0])
    assert angle(away, TRUE_DIRECTION) > 7.9
    known = scene(away, [0.8, 1.0, 0.7])
    start = fitting.fit(target, known, model="blinn-phong", precision="float64").material
    result = fitting.fit_jointly(
        target,
        known,
        start,
        lambda m, s: (m.k_a, m.k_d, m.k_s, m.n, s[0].lights[0].direction, s[0].lights[0].intensity),
        solver=solver,
    )
    light = result.scenes[0].lights[0]
    assert result.converged
    # The picture has no noise: what is left is where the solver stops, its tolerance being 1e-10.
    assert angle(light.direction, TRUE_DIRECTION) < 1e-5
    np.testing.assert_allclose(light.intensity, [1.0, 0.9, 0.8], rtol=1e-7)
    np.testing.assert_allclose(result.material.n, 25, rtol=1e-7)
    np.testing.assert_allclose(result.material.k_s, [0.3, 0.2, 0.0], atol=1e-8)


def test_a_solution_at_a_bound_is_exactly_there():
    dark = scene(TRUE_DIRECTION, [1.0, 1.0, 1.0])
    target = np.asarray(brdf.render(brdf.Lambert(k_d=[0.5, 0.4, 0.3]), dark, precision="float64")) - 0.01
    start = brdf.Lambert(k_a=[0.1, 0.1, 0.1], k_d=[0.2, 0.2, 0.2])
    result = fitting.fit_jointly(target, dark, start, lambda m, s: (m.k_a, m.k_d))
    np.testing.assert_array_equal(result.material.k_a, 0.0)
    separable = fitting.fit(target, dark, model="lambert", precision="float64")
    np.testing.assert_allclose(result.material.k_d, separable.material.k_d, rtol=1e-8)
    np.testing.assert_allclose(result.residual, separable.residual, rtol=1e-8)


def test_both_roads_meet(target: np.ndarray):
    noisy = target + np.random.default_rng(7).normal(0, 0.01, target.shape)
    known = scene(TRUE_DIRECTION, [1.0, 0.9, 0.8])
    separable = fitting.fit(noisy, known, model="blinn-phong", precision="float64")
    joint = fitting.fit_jointly(noisy, known, separable.material, lambda m, s: (m.k_a, m.k_d, m.k_s, m.n))
    np.testing.assert_allclose(joint.material.n, separable.material.n, rtol=1e-6)
    np.testing.assert_allclose(joint.material.k_d, separable.material.k_d, rtol=1e-6)
    np.testing.assert_allclose(joint.residual, separable.residual, rtol=1e-9)


def test_the_factor_between_light_and_material_is_not_determined():
    light = brdf.DirectionalLight(direction=TRUE_DIRECTION, intensity=[1.0])
    alone = brdf.Scene(camera=CAMERA, shapes=[BALL], lights=[light])
    target = np.asarray(brdf.render(brdf.Lambert(k_d=[0.5]), alone, precision="float64"))
    target = target + np.random.default_rng(3).normal(0, 1e-3, target.shape)
    result = fitting.fit_jointly(target, alone, brdf.Lambert(k_d=[0.4]), lambda m, s: (m.k_d, s[0].lights[0].intensity))
    assert result.undetermined.keys() == {"k_d[0]", "lights[0].intensity[0]"}
    assert np.isinf(result.errors[0]).all()
    assert np.isinf(result.errors[1]).all()
    np.testing.assert_allclose(result.values[0] * result.values[1], 0.5, rtol=1e-3)


def test_nothing_to_free_is_an_error(target: np.ndarray):
    known = scene(TRUE_DIRECTION, [1.0, 0.9, 0.8])
    with pytest.raises(brdf.InputError, match="names no leaf"):
        fitting.fit_jointly(target, known, MATERIAL, lambda m, s: ())


@pytest.mark.parametrize(
    ("free", "said"),
    [
        (lambda m, s: (s[0].lights[0],), "no number"),
        (lambda m, s: (m.k_d, m.k_d), "twice"),
        (lambda m, s: (np.ones(3),), "no number"),
        (lambda m, s: (m.k_d[0],), "no number"),
        (lambda m, s: (m.gloss,), "no attribute 'gloss'"),
        (lambda m, s: (s[0].lights[7].direction,), "out of range"),
    ],
)
def test_what_names_no_leaf_is_an_error(target: np.ndarray, free, said):
    with pytest.raises(brdf.InputError, match=said):
        fitting.fit_jointly(target, scene(TRUE_DIRECTION, [1.0, 0.9, 0.8]), MATERIAL, free)


@pytest.mark.parametrize("options", [{"solver": "adam"}, {"tolerance": np.nan}, {"max_steps": 0}])
def test_options_of_the_solver_are_checked(target: np.ndarray, options):
    known = scene(TRUE_DIRECTION, [1.0, 0.9, 0.8])
    with pytest.raises(brdf.InputError, match=next(iter(options))):
        fitting.fit_jointly(target, known, MATERIAL, lambda m, s: (m.n,), **options)


@pytest.mark.parametrize("name", ["light 2", "light 0 of picture 1", "radius 1 of picture 3"])
def test_a_name_that_no_scene_has_is_an_error(target: np.ndarray, name):
    with pytest.raises(brdf.InputError, match=f"names '{name}', which is not in the scenes"):
        fitting.fit_jointly(target, scene(TRUE_DIRECTION, [1.0] * 3), MATERIAL, name)


@pytest.mark.parametrize(("name", "off"), [("ball", 0.6), ("ball", 4.0), ("radius", 0.6)])
def test_an_outline_that_moves_leads_the_material_nowhere(name, off):
    def seen(center, radius=1.0) -> brdf.Scene:
        camera = brdf.PerspectiveCamera(position=[0, 0, 4], target=[0, 0, 0], up=[0, 1, 0], fov=33, resolution=(48, 48))
        light = brdf.DirectionalLight(direction=TRUE_DIRECTION, intensity=1.0)
        return brdf.Scene(camera, [brdf.Sphere(center, radius)], ambient=[1.0], lights=[light])

    truth, pixel = {"k_a": 0.05, "k_d": 0.5, "k_s": 0.3, "n": 12.0}, 2.3 / 48
    told = seen([off * pixel, -off * pixel, 0]) if name == "ball" else seen([0, 0, 0], 1 + off * pixel)
    for seed in range(2):
        clean = np.asarray(brdf.render(brdf.BlinnPhong(**truth), seen([0, 0, 0]), precision="float64"))
        noisy = clean + 0.005 * np.random.default_rng(seed).standard_normal(clean.shape)
        result = fitting.fit_jointly(noisy, told, "blinn-phong", name)
        off_by = [
            (one.value - truth.get(one.name, float("radius" in one.name))) / one.error for one in result.parameters
        ]
        assert np.max(np.abs(off_by)) < 4  # standard errors; 27 to 65 where pixels at the outline count
        assert json.loads(json.dumps(result.to_dict()))["left_out"]["near an outline that moves"] > 100


@pytest.mark.parametrize(("precision", "seed"), [("float64", 4), ("float64", 7), ("float32", 0)])
def test_the_solver_ends_where_rounding_hides_the_rest(precision, seed):
    def lit(direction) -> brdf.Scene:
        return brdf.Scene(CAMERA, [BALL], lights=[brdf.DirectionalLight(direction, 1.0)])

    picture = np.asarray(
        brdf.render(brdf.BlinnPhong(k_d=0.5, k_s=0.3, n=25), lit([0.5, 0.6, 0.7]), precision="float64")
    )
    picture = picture + 0.01 * np.random.default_rng(seed).standard_normal(picture.shape)
    start = brdf.BlinnPhong(k_d=0.4, k_s=0.2, n=20)
    result = fitting.fit_jointly(
        picture,
        lit([0.55, 0.55, 0.7]),
        start,
        lambda m, s: (m.k_d, m.k_s, m.n, s[0].lights[0].direction),
        precision=precision,
    )
    assert result.converged
    assert not result.warnings
    assert result.steps < 60


def test_errors_hold_what_single_precision_leaves_of_a_picture_without_noise(target: np.ndarray):
    known = scene(TRUE_DIRECTION, [1.0, 0.9, 0.8])
    given = brdf.BlinnPhong(k_a=MATERIAL.k_a, k_d=[0.4] * 3, k_s=[0.2] * 3, n=20)
    result = fitting.fit_jointly(target, known, given, lambda m, s: (m.k_d, m.k_s, m.n), precision="float32")
    for one in result.parameters:
        truth = np.resize(getattr(MATERIAL, one.name), 3)[one.channel or 0]
        assert abs(one.value - truth) < 1.96 * one.error < max(4e-6 * truth, 1e-6)


@pytest.mark.parametrize("kind", ["by channel", "by brightness", "copies"])
def test_noise_that_is_not_even_is_in_the_errors_as_in_those_of_a_fit(target: np.ndarray, kind):
    known, noise = scene(TRUE_DIRECTION, [1.0, 0.9, 0.8]), np.random.default_rng(3).standard_normal(target.shape)
    if kind == "copies":
        known = scene(TRUE_DIRECTION, [1.0] * 3)
        picture = np.repeat(target[..., :1] + 0.01 * noise[..., :1], 3, axis=2)
    else:
        picture = target + noise * ([0.001, 0.001, 0.02] if kind == "by channel" else 0.001 + 0.1 * target)
    fitted = fitting.fit(picture, known, model="blinn-phong", precision="float64")
    result = fitting.fit_jointly(picture, known, fitted, lambda m, s: (m.k_d, m.n), precision="float32")
    assert result.converged
    held = fitting.fit_jointly(picture, known, fitted, lambda m, s: (m.k_a, m.k_d, m.k_s, m.n))
    for name, index in (("k_a", 0), ("k_d", 0), ("k_d", 1), ("k_d", 2), ("k_s", 0)):
        # the fit asks some pixels about its noise, this one all
        assert held[name][index].error == pytest.approx(fitted[name][index].error, rel=0.06), name
    assert held["n"].error == pytest.approx(fitted["n"].error, rel=0.06)


@pytest.mark.slow
def test_a_joint_fit_chooses_the_model_and_tells_errors_as_a_fit_does(target: np.ndarray, tmp_path):
    sigma = 0.005
    noisy = target + np.random.default_rng(0).normal(0, sigma, target.shape)
    away = scene(TRUE_DIRECTION + 0.18 * np.array([0.6, -0.5, 0.0]), [1.0, 0.9, 0.8])
    result = fitting.fit_jointly(noisy, away, free=lambda m, s: (m.k_a, m.k_d, m.k_s, m.n, s[0].lights[0].direction))
    assert result.surface == "blinn-phong"
    assert result.candidates
    np.testing.assert_allclose(result.noise, sigma, rtol=0.1)
    found = result["lights[0].direction"]
    assert angle(np.array(found.direction), TRUE_DIRECTION) < 4 * found.error
    # One radian of a light's direction moves a pixel by its diffuse and specular slopes: some 0.005 / sqrt(pixels).
    assert 0.01 < found.error < 0.2
    np.testing.assert_allclose(found.value, angle(away.lights[0].direction, TRUE_DIRECTION), atol=4 * found.error)
    low, high = result["n"].interval
    assert low < 25 < high
    assert abs(float(result["k_d"][1]) - 0.4) < 4 * result["k_d"][1].error
    assert "° (turned by" in str(result)
    assert not result.warnings
    result.save(tmp_path, plot=True)
    again = fitting.load_result(tmp_path)
    assert str(again) == str(result)
    assert again["lights[0].direction"] == found
    assert again.scenes[0].lights[0].direction == pytest.approx(result.scenes[0].lights[0].direction)


@pytest.mark.parametrize(
    ("row", "seed", "closest"),
    [("sRGB 8 bit", 1, 5.0), ("sRGB 8 bit, light noise 0.01", 2, 0.0), ("JPEG q90, noise 1", 1, 0.0)],
)
def test_a_freed_light_is_found_behind_rounded_values_as_the_material_is(
    row: str, seed: int, closest: float, tmp_path: Path
):
    """Within its errors, and far closer than a code where rounding is all the noise there is."""
    file, one = COVERAGE[row], ball(seed, model="blinn-phong")
    picture, told = file.picture(one.drawn(), seed, tmp_path), one.scene()
    true = np.asarray(told.lights[0].direction)
    away = brdf.DirectionalLight(direction=true + 0.02 * np.array([0.6, -0.5, 0.0]), intensity=[1.0])
    wrong = brdf.Scene(told.camera, told.shapes, ambient=told.ambient, lights=[away])
    result = fitting.fit_jointly(picture, wrong, "blinn-phong", "light")
    light = next(parameter for parameter in result.parameters if parameter.direction is not None)
    assert light.error is not None
    assert angle(np.array(light.direction), true) < 4 * light.error
    numbers = {"k_a": one.k[0, 0], "k_d": one.k[1, 0], "k_s": one.k[2, 0], "n": one.n}
    for parameter in result.parameters:
        if parameter.name in numbers:
            off = abs(float(parameter) - numbers[parameter.name])
            assert off < 4 * np.array(parameter.error), parameter
    plain = fitting.fit_jointly(picture, wrong, "blinn-phong", "light", rounding=0)
    assert np.array(plain[light.name].error) > closest * light.error


def test_few_steps_lead_away_from_the_start(target: np.ndarray):
    start = brdf.BlinnPhong(k_a=MATERIAL.k_a, k_d=MATERIAL.k_d, k_s=MATERIAL.k_s, n=18)
    known = scene(TRUE_DIRECTION, [1.0, 0.9, 0.8])
    result = fitting.fit_jointly(target, known, start, lambda m, _: (m.n,), max_steps=4)
    assert abs(result.material.n - 25) < 1
    assert result.steps <= 4


def test_many_lights_that_are_dark_are_told_as_quickly_as_few():
    """Numbers at their bound once took a time that grew as their factorial."""
    random = np.random.default_rng(5)
    directions = np.add(random.normal(size=(16, 3)), [0, 0, 2])
    lights = [brdf.DirectionalLight(direction=direction, intensity=[0.0]) for direction in directions]
    lights[0] = brdf.DirectionalLight(direction=[0.5, 0.6, 0.7], intensity=[1.0])
    lit = brdf.Scene(camera=CAMERA, shapes=[BALL], lights=lights)
    picture = np.asarray(brdf.render(brdf.Lambert(k_d=[0.5]), lit, precision="float64"))
    picture = picture + 0.005 * random.normal(size=picture.shape)
    known = brdf.Scene(
        camera=CAMERA,
        shapes=[BALL],
        lights=[brdf.DirectionalLight(direction=one.direction, intensity=[0.5]) for one in lights],
    )
    result = fitting.fit_lights(picture, known, brdf.Lambert(k_d=[0.5]))
    assert sum(one.at_bound for one in result.parameters) >= 4
    assert all(one.error > 0 for one in result.parameters)


def test_without_a_word_of_scenes_the_material_alone_is_freed(target: np.ndarray):
    known = scene(TRUE_DIRECTION, [1.0, 0.9, 0.8])
    result = fitting.fit_jointly(target, known, MATERIAL)
    assert {one.name for one in result.parameters} == {"k_a", "k_d", "k_s", "n"}
    np.testing.assert_allclose(float(result["n"]), 25, rtol=1e-6)


def test_where_one_channel_is_clipped_the_others_tell_the_light_and_the_highlight():
    material = brdf.BlinnPhong(k_a=[0.1, 0.22, 0.1], k_d=[0.5, 1.1, 0.4], k_s=[0.35] * 3, n=60)
    true, ambient = np.array([0.3, -0.4, 1.0]), [0.5] * 3
    told, wrong = (
        brdf.Scene(CAMERA, [BALL], ambient=ambient, lights=[brdf.DirectionalLight(direction, 1.0)])
        for direction in (true, [0.32, -0.41, 1.0])
    )
    clean = np.asarray(brdf.render(material, told, precision="float64"))
    picture = np.minimum(clean + np.random.default_rng(0).normal(0, 0.005, clean.shape), 1.0)
    result = fitting.fit_jointly(picture, wrong, "blinn-phong", "light")
    assert result.left_out["clipped"] > 200
    assert angle(result.scenes[0].lights[0].direction, true) < 0.1
    for name in ("k_a", "k_d", "k_s"):
        for parameter, value in zip(result[name], getattr(material, name), strict=True):
            assert abs(float(parameter) - value) < 4 * np.array(parameter.error), parameter
    assert abs(float(result["n"]) - 60) < 4 * np.array(result["n"].error) < 4


@pytest.mark.parametrize("off", [-75, -45, 10, 45, 84])
def test_a_light_is_found_from_wherever_it_was_thought_and_its_error_does_not_know_from_where(off):
    across = np.cross(TRUE_DIRECTION, [0.0, 1.0, 0.0])
    across /= np.linalg.norm(across)
    turned = TRUE_DIRECTION * np.cos(np.radians(off)) + across * np.sin(np.radians(off))
    true, thought = (
        brdf.Scene(camera=CAMERA, shapes=[BALL], lights=[brdf.DirectionalLight(direction=one, intensity=[1.0])])
        for one in (TRUE_DIRECTION, turned)
    )
    shiny = brdf.BlinnPhong(k_d=[0.5, 0.3, 0.2], k_s=[0.3, 0.3, 0.3], n=30)
    clean = np.asarray(brdf.render(shiny, true, precision="float64"))
    picture = clean + 0.01 * np.random.default_rng(0).standard_normal(clean.shape)
    result = fitting.fit_jointly(picture, thought, "blinn-phong", "light")
    best = fitting.fit_jointly(picture, true, "blinn-phong", "light")
    assert result.converged
    assert angle(result.scenes[0].lights[0].direction, best.scenes[0].lights[0].direction) < 1e-3
    assert result["lights[0].direction"].error == pytest.approx(best["lights[0].direction"].error, rel=1e-3)
    assert "±" in str(result)


@pytest.mark.parametrize("n", [0.3, 5.0, 500.0, 5000.0])
def test_an_exponent_is_found_from_far_away(target: np.ndarray, n: float):
    start = brdf.BlinnPhong(k_a=MATERIAL.k_a, k_d=[0.4, 0.4, 0.4], k_s=[0.1, 0.1, 0.1], n=n)
    known = scene(TRUE_DIRECTION, [1.0, 0.9, 0.8])
    result = fitting.fit_jointly(target, known, start, lambda m, _: (m.k_d, m.k_s, m.n))
    np.testing.assert_allclose(result.material.n, 25, rtol=1e-6)


@pytest.mark.parametrize("codes", [False, True])
def test_pictures_count_by_their_own_noise_as_in_a_fit(codes: bool):
    directions = [0.6, 0.3, 0.7], [-0.5, 0.4, 0.6]
    scenes = [brdf.Scene(CAMERA, [BALL], lights=[brdf.DirectionalLight(one, [1.0])]) for one in directions]
    random, grey = np.random.default_rng(0), brdf.BlinnPhong(k_d=[0.5], k_s=[0.3], n=30)
    pictures = [
        np.asarray(brdf.render(grey, one, precision="float64")) + noise * random.standard_normal((40, 40, 1))
        for one, noise in zip(scenes, (0.002, 0.05), strict=True)
    ]
    if codes:
        pictures = [np.clip(np.round(255 * one), 0, 255).astype(np.uint8) for one in pictures]
    alone = fitting.fit(pictures, scenes, model="blinn-phong", precision="float64", encoding="linear")
    result = fitting.fit_jointly(pictures, scenes, "blinn-phong", encoding="linear")
    np.testing.assert_allclose(result.material.n, alone.material.n, rtol=1e-4)
    assert result["n"].error == pytest.approx(alone["n"].error, rel=0.05)


@pytest.mark.parametrize("dimmed", [1.0, 0.1])
def test_clipped_floats_say_what_they_say_in_a_fit_whether_all_pictures_have_some_or_one(dimmed: float):
    """Least squares of what is left was up to 6 errors off, and the fit of both where one had none as well."""
    directions, random = ([0.3, 0.2, 0.9], [-0.3, 0.2, 0.9]), np.random.default_rng(8)
    grey, scenes = brdf.BlinnPhong(k_d=[0.4], k_s=[0.3], n=20), []
    for one, intensity in zip(directions, (1.0, dimmed), strict=True):
        scenes.append(brdf.Scene(CAMERA, [BALL], lights=[brdf.DirectionalLight(one, [intensity])]))
    shown = [np.asarray(brdf.render(grey, one, precision="float64")) for one in scenes]
    pictures = [np.minimum(one + 0.01 * random.standard_normal(one.shape), 0.5) for one in shown]
    fitted = fitting.fit(pictures, scenes, model="blinn-phong", precision="float64", saturation=0.5)
    result = fitting.fit_jointly(pictures, scenes, "blinn-phong", saturation=0.5)
    for name, truth in (("k_d", 0.4), ("k_s", 0.3), ("n", 20.0)):
        one, other = (found[name] if name == "n" else found[name][0] for found in (fitted, result))
        assert abs(one.value - truth) < 3 * one.error
        assert other.value == pytest.approx(one.value, abs=0.1 * one.error)
        assert other.error == pytest.approx(one.error, rel=0.05)


def test_a_dark_side_that_is_cut_off_at_0_is_no_structure():
    """It was said to be in half of such pictures."""
    lit = brdf.Scene(LARGER, [BALL], lights=[brdf.DirectionalLight([1, 0.2, -0.1], [1.0])])
    shown = np.asarray(brdf.render(brdf.BlinnPhong(k_d=[0.4], k_s=[0.3], n=20), lit, precision="float64"))
    for seed in range(2):
        picture = np.maximum(shown + 0.02 * np.random.default_rng(seed).standard_normal(shown.shape), 0)
        assert not fitting.fit_jointly(picture, lit, "blinn-phong").warnings


def test_a_light_a_degree_off_is_structure():
    """Which neighbours alone do not tell under such noise."""
    directions = [0.5, 0.6, 0.7], [0.5, 0.588, 0.71]
    true, told = (brdf.Scene(LARGER, [BALL], lights=[brdf.DirectionalLight(one, [1.0])]) for one in directions)
    shown = np.asarray(brdf.render(brdf.BlinnPhong(k_d=[0.4], k_s=[0.3], n=20), true, precision="float64"))
    picture = shown + 0.015 * np.random.default_rng(0).standard_normal(shown.shape)
    assert any("structure" in words for words in fitting.fit_jointly(picture, told, "blinn-phong").warnings)
    assert not fitting.fit_jointly(picture, true, "blinn-phong").warnings


@pytest.mark.parametrize("k_s", [0.0, 0.3])
def test_a_highlight_that_noise_may_have_made_is_not_determined_as_in_a_fit(k_s: float):
    material = brdf.BlinnPhong(k_a=0.2, k_d=0.5, k_s=k_s, n=25)
    shown = brdf.Scene(CAMERA, [BALL], ambient=[0.2], lights=[brdf.DirectionalLight(TRUE_DIRECTION, [1.0])])
    told = brdf.Scene(CAMERA, [BALL], ambient=[0.2], lights=[brdf.DirectionalLight([0.5, 0.62, 0.7], [1.0])])
    clean, start = np.asarray(brdf.render(material, shown)), brdf.BlinnPhong(k_a=0.2, k_d=0.5, k_s=0.1, n=20)
    for seed in range(6):
        target = clean + 0.01 * np.random.default_rng(seed).normal(size=clean.shape)
        numbers = fitting.fit_jointly(
            target, told, start, lambda m, s: (m.k_a, m.k_d, m.k_s, m.n, s[0].lights[0].direction)
        )
        known = numbers["n"].value is not None and numbers["k_s"][0].value is not None
        assert known == (k_s > 0)
        assert known or "does not stand out" in numbers["n"].reason


def test_a_joint_fit_does_not_stay_at_an_exponent_that_the_scene_it_found_does_not_want():
    """The top of the highlight is clipped, and under the light that was told another minimum is the lowest."""
    material = brdf.BlinnPhong(k_a=0.3, k_d=0.464, k_s=0.18, n=66.6)
    place = np.array([-0.679, -0.754, 1.871])
    told, wrong = (
        brdf.Scene(LARGER, [BALL], ambient=[0.2], lights=[brdf.PointLight(at, 3.5)])
        for at in (place, np.array([-0.642, -0.779, 1.994]))
    )
    shown = 255 * np.asarray(brdf.render(material, told, precision="float64"))
    noisy = [np.clip(np.rint(shown + np.random.default_rng(i).normal(size=shown.shape)), 0, 255) for i in range(4)]
    for codes in noisy:
        result = fitting.fit_jointly(codes.astype(np.uint8), wrong, "blinn-phong", ["light", "distance"])
        np.testing.assert_allclose(result.material.k_d, 0.464, rtol=0.01)
        assert 30 < float(result.material.n) < 150
