"""Errors and intervals against dense least squares and SciPy, coverage over draws, and words for what is left open."""

import dataclasses
import re

import numpy as np
import pytest
from scipy import optimize, stats
from small_ball import SIZE, ball_scene, pictured

import brdf
import fitting
from brdf.images.encoding import encode
from brdf.materials.material_file import material_from_dict, material_to_dict, read_material
from fitting.solver.tied import places_of
from fitting.uncertainty.intervals import above_zero, student_95
from fitting.uncertainty.structure import LEAST_HELD, MOST_HELD, Errors, block_scatter

CAMERA = brdf.OrthographicCamera(position=[0, 0, 4], target=[0, 0, 0], up=[0, 1, 0], width=2.2, resolution=(36, 36))
LIGHT = brdf.DirectionalLight(direction=[0.5, 0.6, 0.7], intensity=[1.0])
SCENE = ball_scene(LIGHT, ambient=[0.2], camera=CAMERA)
# Told that nothing is clipped: the largest value of a noisy picture is no plateau.
OPTIONS = {"precision": "float64", "saturation": np.inf}


def columns(n: float, scene: brdf.Scene = SCENE) -> tuple[np.ndarray, np.ndarray]:
    """Ambient, diffuse, lobe and its derivative by n in the pixels that see the ball, by the textbook; and which."""
    points = scene.surface_points()
    mask = np.asarray(points.mask)
    normal = np.asarray(points.normal, np.float64)[mask]
    to_light = np.array([0.5, 0.6, 0.7]) / np.linalg.norm([0.5, 0.6, 0.7])
    half = to_light + np.array([0.0, 0.0, 1.0])
    cosine = np.maximum(normal @ (half / np.linalg.norm(half)), 1e-300)
    lit = normal @ to_light > 0
    lobe = np.where(lit, cosine**n, 0.0)
    ambient = np.full(len(normal), 0.2)
    return np.stack([ambient, np.maximum(normal @ to_light, 0), lobe, lobe * np.log(cosine)]), mask


def noisy(material: brdf.Material, noise, seed: int, scene: brdf.Scene = SCENE) -> np.ndarray:
    return pictured(material, scene, noise, seed)


GLOSS = brdf.BlinnPhong(k_a=0.5, k_d=0.5, k_s=0.6, n=30.0)


@pytest.mark.parametrize("kind", [brdf.BlinnPhong, brdf.NormalizedBlinnPhong])
def test_errors_and_correlations_are_those_of_dense_least_squares(kind: type[brdf.BlinnPhong]):
    n = 30.0 if kind is brdf.BlinnPhong else 8.0
    picture = noisy(kind(k_a=0.5, k_d=0.5, k_s=0.6, n=n), 0.01, 0)
    result = fitting.fit(picture, SCENE, model=kind, **OPTIONS)
    k_a, k_d, k_s, n = (parameter.value for parameter in result.parameters)
    basis, mask = columns(n)
    if kind is brdf.NormalizedBlinnPhong:
        # By how much more k_s is what n takes: of the scale that n has the lobe is a part.
        low, scale, high = ((m + 2) * (m + 4) / (8 * (2 ** (-m / 2) + m)) for m in (n - 1e-4, n, n + 1e-4))
        lobe, slope = basis[2:] * basis[1]
        basis[2:] = scale * lobe, scale * slope + (high - low) / 2e-4 * lobe
    jacobian = basis * np.array([1, 1, 1, k_s])[:, None]
    residual = picture[mask][:, 0] - np.array([k_a, k_d, k_s]) @ basis[:3]
    variance = residual @ residual / (residual.size - 4)
    covariance = variance * np.linalg.inv(jacobian @ jacobian.T)
    error = np.sqrt(np.diag(covariance))
    # Geometry in float64 on both sides; the sums of the engine reorder additions.
    assert [parameter.error for parameter in result.parameters] == pytest.approx(error, rel=1e-5)
    assert result.correlation == pytest.approx(covariance / np.outer(error, error), abs=1e-5)
    many = fitting.fit_many(picture[None], SCENE, model=kind.name, precision="float64")
    assert np.hstack([many.errors[name][0] for name in ("k_a", "k_d", "k_s", "n")]) == pytest.approx(error, rel=1e-5)


def test_the_interval_of_n_ends_where_the_cost_of_scipy_rises_by_chi_squared():
    picture = noisy(brdf.BlinnPhong(k_a=0.5, k_d=0.5, k_s=0.3, n=60.0), 0.05, 3)
    result = fitting.fit(picture, SCENE, model="blinn-phong", **OPTIONS)
    low, high = result.parameters[-1].interval
    n = result.parameters[-1].value

    def cost(n: float) -> float:
        basis, mask = columns(n)
        return optimize.nnls(basis[:3].T, picture[mask][:, 0])[1] ** 2

    assert high - n > 1.1 * (n - low)  # not symmetric, or this shows little
    rise = stats.chi2.ppf(0.95, 1) * result.noise[0] ** 2
    # The ends are interpolated between sixteenths of a bracket.
    assert cost(low) - cost(n) == pytest.approx(rise, rel=0.02)
    assert cost(high) - cost(n) == pytest.approx(rise, rel=0.02)


@pytest.mark.parametrize("truth", [0.0, 0.1, 0.7, 1.5, 2.5, 5.0])
def test_the_interval_above_zero_covers_wherever_the_truth_lies(truth: float):
    estimates = np.linspace(truth - 6, truth + 6, 4001)
    inside = [low <= truth <= high for low, high in (above_zero(x, 1.0) for x in estimates)]
    covered = np.sum(stats.norm.pdf(estimates, truth) * inside) * (estimates[1] - estimates[0])
    # Linear interpolation in a table of 41; estimates far below 0 count as -2, which covers more.
    assert 0.945 <= covered <= 0.965


@pytest.mark.parametrize("codes", [False, True])
@pytest.mark.parametrize("model", ["blinn-phong", "auto"])
def test_noise_that_channels_share_counts_once(codes: bool, model: str):
    """As a path tracer's; three channels of it say no more of n than one."""
    camera = brdf.OrthographicCamera(position=[0, 0, 4], target=[0, 0, 0], up=[0, 1, 0], width=2.2, resolution=[48, 48])
    light = brdf.DirectionalLight([0.4, 0.5, 0.8], [1.0] * 3)
    scene = brdf.Scene(camera, [brdf.Sphere([0, 0, 0], 1)], ambient=[0.2] * 3, lights=[light])
    clean = np.asarray(brdf.render(brdf.BlinnPhong(k_a=0.5, k_d=[0.4, 0.3, 0.2], k_s=0.3, n=40), scene))
    curved, off = encode(clean, "srgb"), []
    for seed in range(30):
        noise = 0.01 * np.random.default_rng(seed).standard_normal((48, 48, 1))
        target = np.rint(255 * np.clip(curved + noise, 0, 1)).astype(np.uint8) if codes else clean + noise
        found = fitting.fit(target, scene, model=model, encoding="srgb" if codes else None)
        if isinstance(found.material, brdf.BlinnPhong):  # now and then Phong's highlight fits as well
            off.append((found["n"].value - 40) / found["n"].error)
    assert len(off) > 25
    assert 0.7 < np.sqrt(np.mean(np.square(off))) < 1.3


def test_intervals_cover_the_truth_in_95_percent_of_draws_at_a_bound_too():
    truth = brdf.BlinnPhong(k_a=0.0, k_d=0.5, k_s=0.6, n=30.0)
    inside = []
    for seed in range(200):
        result = fitting.fit(noisy(truth, 0.02, seed), SCENE, model="blinn-phong", **OPTIONS)
        true = [0.0, 0.5, 0.6, 30.0]
        inside.append([p.interval[0] <= t <= p.interval[1] for p, t in zip(result.parameters, true, strict=True)])
    covered = np.mean(inside, axis=0)
    # Binomial, 200 draws: 1.5 % standard deviation; three of them. 1000 draws of more: benchmarks/calibration.py.
    assert np.all((covered > 0.90) & (covered < 0.995)), covered


def test_what_a_coefficient_at_its_bound_may_be_is_in_the_errors_of_the_others():
    """On a few pixels that are nearly alike k_a comes out as 0 in a third of the draws, and k_d takes its light."""
    mask, inside, bound = np.zeros(CAMERA.resolution, bool), [], 0
    mask[14:20, 14:20] = True
    for seed in range(60):
        picture = noisy(brdf.Lambert(k_a=0.1, k_d=0.5), 0.02, seed)
        result = fitting.fit(picture, SCENE, model="lambert", mask=mask, **OPTIONS)
        low, high = result["k_d"][0].interval
        inside.append(low <= 0.5 <= high)
        bound += result["k_a"][0].at_bound
    assert 10 < bound < 30
    assert np.mean(inside) > 0.9


def test_noise_in_proportion_to_the_value_is_allowed_for():
    truth = brdf.BlinnPhong(k_a=0.1, k_d=0.1, k_s=5.0, n=60.0)
    clean = np.asarray(brdf.render(truth, SCENE, precision="float64"))
    inside = []
    for seed in range(100):
        result = fitting.fit(noisy(truth, 0.02 * clean, seed), SCENE, model="blinn-phong", **OPTIONS)
        low, high = result.parameters[-1].interval
        inside.append(low <= 60.0 <= high)
    assert any("grows with brightness" in text and "weighed alike" in text for text in result.warnings)
    weight = np.linspace(0.5, 1, clean[..., 0].size).reshape(clean.shape[:2])
    result = fitting.fit(noisy(truth, 0.02 * clean, 0), SCENE, model="blinn-phong", weight=weight, **OPTIONS)
    assert any("grows with brightness" in text and "but the weights do not" in text for text in result.warnings)
    # 3 standard deviations of 100 draws; with a single variance it is about a half.
    assert np.mean(inside) > 0.88


def test_a_wrong_model_is_given_away_by_the_structure_of_its_residual():
    wrong = fitting.fit(noisy(GLOSS, 0.01, 1), SCENE, model="lambert", **OPTIONS)
    assert any("structure" in text and "too small" in text for text in wrong.warnings)
    right = fitting.fit(noisy(GLOSS, 0.01, 1), SCENE, model="blinn-phong", **OPTIONS)
    assert right.warnings == ()


def test_without_ambient_light_k_a_is_open():
    scene = ball_scene(LIGHT, ambient=None, camera=CAMERA)
    result = fitting.fit(noisy(GLOSS, 0.01, 0, scene), scene, model="blinn-phong", **OPTIONS)
    assert list(result.undetermined.values()) == ["no ambient light in the scene"]
    assert result.to_dict()["material"]["k_a"] == [None]


def test_a_wall_that_faces_the_light_tells_only_the_sum_of_ambient_and_diffuse():
    wall = brdf.Rectangle(center=[0, 0, 0], edge_u=[2, 0, 0], edge_v=[0, 2, 0])
    light = brdf.DirectionalLight(direction=[0, 0, 1], intensity=[1.0])
    scene = brdf.Scene(camera=CAMERA, shapes=[wall], ambient=[0.2], lights=[light])
    picture = noisy(brdf.Lambert(k_a=0.5, k_d=0.4), 0.01, 0, scene)
    for model in ("lambert", "auto"):
        result = fitting.fit(picture, scene, model=model, **OPTIONS)
        told = re.fullmatch(r"only 0\.2 k_a \+ 1 k_d = (.*) ± (.*) is determined", result["k_a"][0].reason)
        value, error = map(float, told.groups())
        assert abs(value - 0.5) < 4 * error
        assert error == pytest.approx(0.01 / np.sqrt(result.pixels), rel=0.2)
        assert result["k_d"][0].reason == result["k_a"][0].reason
        assert result.surface == "lambert"
        assert any("sum" in warning for warning in result.warnings)
        # The material shows the picture, with 1 % of it as ambient light.
        np.testing.assert_allclose(
            [0.2 * result.material.k_a[0], result.material.k_d[0]], [0.01 * value, 0.99 * value], 1e-3
        )
    again = material_from_dict(result.to_dict()["material"])
    assert float(again.k_d[0]) == float(result.material.k_d[0])


def test_files_and_exports_say_that_a_number_stands_for_a_sum(tmp_path):
    material, reasons = (
        brdf.Lambert(k_a=[0.1, 0.0], k_d=[0.5, 0.5]),
        {"k_a[0]": "only a sum", "k_a[1]": "no ambient light"},
    )
    grey = brdf.Lambert(k_a=0.1, k_d=0.5)
    assert material_to_dict(material, undetermined=reasons)["k_a"] == [0.1, None]
    for name in ("material.json", "material.mtl"):
        brdf.save_material(grey, tmp_path / name, undetermined={"k_a[0]": "only a sum"})
        assert read_material(tmp_path / name)[1] == "not determined: k_a[0]: only a sum"
        brdf.save_material(grey, tmp_path / name)
        assert read_material(tmp_path / name)[1] == ""
    for to in ("json", "mtl", "glsl", "pytorch3d", "three", "gltf", "mitsuba"):
        assert "only a sum" in brdf.export_material(grey, to, note="only a sum").text


@pytest.mark.parametrize("k_s", [0.0, 1e-3])
def test_a_highlight_that_noise_hides_is_not_told(k_s: float):
    result = fitting.fit(
        noisy(brdf.BlinnPhong(k_a=0.5, k_d=0.5, k_s=k_s, n=30.0), 0.01, 2), SCENE, model="blinn-phong", **OPTIONS
    )
    told = {parameter.name: parameter.value for parameter in result.parameters}
    assert told["n"] is None
    assert told["k_s"] is None
    assert result.to_dict()["material"]["n"] is None


def test_a_highlight_smaller_than_a_pixel_is_warned_of():
    result = fitting.fit(
        noisy(brdf.BlinnPhong(k_a=0.5, k_d=0.5, k_s=50.0, n=3000.0), 0.01, 2), SCENE, model="blinn-phong", **OPTIONS
    )
    assert any("smaller than a pixel" in text for text in result.warnings)


def test_a_broad_highlight_whose_middle_does_not_count_is_not_called_small():
    dull = brdf.BlinnPhong(k_a=0.5, k_d=0.5, k_s=0.6, n=30.0)
    edge = np.asarray(brdf.basis_images(brdf.BlinnPhong, SCENE, 30.0).specular)[..., 0] < 0.4
    result = fitting.fit(noisy(dull, 0.001, 2), SCENE, model="blinn-phong", mask=edge, **OPTIONS)
    assert [text for text in result.warnings if "shows the middle of the highlight" in text]
    assert not [text for text in result.warnings if "smaller than a pixel" in text]


@pytest.mark.parametrize("ambient", [None, [0.2]])
def test_a_highlight_that_is_as_even_as_diffuse_light_is_not_denied(ambient):
    """A plane far away, under a distant light; a shadow tells ambient light."""
    shapes = brdf.Rectangle([0, 0, 0], [1, 0, 0], [0, 1, 0]), brdf.Sphere([0.3, 0, 0.6], 0.3, fitted=False)
    scene = brdf.Scene(CAMERA, shapes, ambient=ambient, lights=[LIGHT])
    for seed in range(3):
        result = fitting.fit(noisy(GLOSS, 0.01, seed, scene), scene, model="blinn-phong", **OPTIONS)
        assert result["k_d"][0].reason == result["k_s"][0].reason
        assert re.search(r"only .* k_d \+ .* k_s = .* is determined", result["k_d"][0].reason)
        np.testing.assert_allclose(result.fitted()[18, 18], noisy(GLOSS, 0.0, 0, scene)[18, 18], rtol=0.01)


def test_a_coefficient_at_its_bound_is_zero_with_a_one_sided_interval():
    for seed in range(20):
        truth = brdf.BlinnPhong(k_a=0.0, k_d=0.5, k_s=0.6, n=30.0)
        k_a = fitting.fit(noisy(truth, 0.02, seed), SCENE, model="blinn-phong", **OPTIONS).parameters[0]
        if k_a.at_bound:
            break
    assert k_a.at_bound
    assert k_a.value == 0
    assert k_a.interval[0] == 0 < k_a.interval[1]
    assert "at its bound" in str(k_a)


@pytest.mark.parametrize("model", ["lambert", "blinn-phong"])
@pytest.mark.parametrize("precision", ["float32", "float64"])
def test_a_flat_sheet_under_a_distant_light_tells_only_a_sum_of_ambient_and_diffuse(precision, model):
    """Its diffuse basis image is a multiple of the ambient one, which the rounding of sums must not hide."""
    camera = brdf.PerspectiveCamera(
        position=[0.0, 0.0, 4.0], target=[0.0, 0.0, 0.0], up=[0.0, 1.0, 0.0], fov=25.0, resolution=(64, 64)
    )
    sheet = brdf.Rectangle(center=[0.0, 0.0, 0.0], edge_u=[1.0, 0.0, 0.3], edge_v=[0.0, 1.0, 0.06])
    light = brdf.DirectionalLight(direction=[0.3, 0.4, 0.8], intensity=[1.0, 0.9, 0.8])
    scene = brdf.Scene(camera=camera, shapes=[sheet], lights=[light], ambient=[0.3, 0.3, 0.3])
    truth = brdf.BlinnPhong(k_a=[0.5] * 3, k_d=[0.5] * 3, k_s=[0.3] * 3, n=20.0)
    result = fitting.fit(pictured(truth, scene, 0.01), scene, model=model, precision=precision)
    told = {(one.name, one.channel): one for one in result.parameters}
    for channel in range(3):
        for name in ("k_a", "k_d"):
            assert told[name, channel].value is None
            assert re.match(r"only .* k_a \+ .* k_d = .* is determined", told[name, channel].reason)
    if model == "blinn-phong":
        highlight = told["k_s", 0]
        assert abs(highlight.value - 0.3) < 4 * highlight.error


def test_blocks_that_hold_much_count_as_a_fit_without_them_leaves_them():
    # A lobe in one corner of 48 x 48 pixels, of two channels that share an exponent: a linear problem, fitted again
    # without each block of 8 x 8.
    random, size, channels = np.random.default_rng(0), 48, 2
    row, column = np.divmod(np.arange(size * size), size)
    lobe = np.exp(-((row - 5) ** 2 + (column - 6) ** 2) / 40)
    one = np.stack([np.ones(size * size), random.random(size * size), lobe, lobe * (row - 5) / 5])
    slopes = np.stack([one, 0.5 * one], axis=-1)
    design = np.zeros((size * size, channels, 3 * channels + 1))
    for channel in range(channels):
        design[:, channel, [channel, channels + channel, 2 * channels + channel, -1]] = slopes[..., channel].T
    values = random.standard_normal((size * size, channels))
    blocks = (row // 8) * (size // 8) + column // 8

    def left(some):
        rows = design[some].reshape(-1, design.shape[-1])
        return values - design @ np.linalg.lstsq(rows, values[some].ravel())[0]

    residual, rows = left(blocks >= 0), design.reshape(-1, design.shape[-1])
    covariance = np.linalg.inv(rows.T @ rows)
    expected = np.zeros_like(covariance)
    for block in range(blocks.max() + 1):
        own = design[blocks == block].reshape(-1, design.shape[-1])
        share = np.linalg.eigvals(own.T @ own @ covariance).real
        assert share.max() < MOST_HELD
        without = left(blocks != block) if share.sum() > LEAST_HELD else residual
        score = own.T @ without[blocks == block].ravel()
        expected += np.outer(score, score)
    scores = np.einsum("pcu,pc->up", design, residual)
    errors = Errors(residual, np.arange(size * size), size)
    fitted = slopes, covariance, places_of(channels)
    told, before = block_scatter(scores, errors, fitted), block_scatter(scores, errors)
    np.testing.assert_allclose(told, expected, rtol=1e-9, atol=1e-9 * np.abs(expected).max())
    assert np.all(np.diag(told)[4:] > 1.2 * np.diag(before)[4:])


@pytest.mark.parametrize("seed", [15, 21])
def test_where_the_search_stopped_is_no_structure(seed: int):
    """Of a picture without noise in double precision only that is left."""
    rng, scene = np.random.default_rng(seed), ball_scene()
    material = brdf.Phong(k_a=0.2, n=float(np.exp(rng.uniform(1, 4))), k_d=rng.uniform(0.1, 0.6, 3), k_s=0.3)
    assert not fitting.fit(pictured(material, scene), scene, precision="float64", model="phong").warnings


def test_a_picture_whose_roundings_leave_nothing_open_does_not_end_the_fit():
    x, y = np.meshgrid(np.linspace(-0.7, 0.7, 30), np.linspace(0.7, -0.7, 30))
    normal = np.dstack([x, y, np.sqrt(1 - x * x - y * y)])
    directions = np.array([[0, 0, 1], [0.5, 0, 1], [0, 0.5, 1], [-0.5, -0.3, 1]])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    codes = [np.round(0.6 * np.clip(normal @ one, 0, None) * 65535).astype(np.uint16) for one in directions]
    points = brdf.SurfacePoints.from_normals(normal)
    scenes = [brdf.Scene(points=points, lights=[brdf.DirectionalLight(one, 1.0)]) for one in directions]
    result = fitting.fit(codes, scenes, model="lambert", encoding="linear")
    k_d = result["k_d"][0]
    assert abs(k_d.value - 0.6) < 4 * k_d.error < 1e-6


def test_noise_that_grows_is_seen_on_a_small_ball_in_a_large_picture():
    camera = brdf.OrthographicCamera(
        position=[0, 0, 4], target=[0, 0, 0], up=[0, 1, 0], width=2.2, resolution=(512, 512)
    )
    small = brdf.Sphere(center=[0.62, -0.6, 0], radius=0.07)
    scene = brdf.Scene(camera=camera, shapes=[small], lights=[LIGHT])
    clean = np.asarray(brdf.render(brdf.BlinnPhong(k_d=0.5, k_s=0.4, n=20), scene, precision="float64"))
    result = fitting.fit(clean * (1 + 0.1 * np.random.default_rng(0).normal(size=clean.shape)), scene, model="phong")
    assert any("grows with brightness" in text for text in result.warnings)


def test_the_interval_of_n_is_as_wide_as_its_error_where_a_circle_is_off_in_a_rounded_picture():
    camera = brdf.OrthographicCamera(
        position=[0, 0, 4], target=[0, 0, 0], up=[0, 1, 0], width=2.2, resolution=(200, 200)
    )
    true, told = (
        brdf.Scene(camera=camera, shapes=[brdf.Sphere(center=[off, off, 0], radius=1 + off)], lights=[LIGHT])
        for off in (0.0, 0.01)
    )
    clean = np.asarray(brdf.render(brdf.BlinnPhong(k_d=[0.4, 0.3, 0.2], k_s=0.3, n=40), true))
    codes = np.rint(255 * encode(clean, "srgb")).astype(np.uint8)
    n = fitting.fit(codes, told, encoding="srgb", model="blinn-phong")["n"]
    assert n.error > 0.01 * n.value
    assert n.interval[0] < n.value - 1.5 * n.error < n.value + 1.5 * n.error < n.interval[1]


def test_a_channel_that_is_black_in_a_noisy_picture_does_not_end_the_fit():
    truth = brdf.BlinnPhong(k_a=[0, 0, 0], k_d=[0.5, 0.3, 0], k_s=[0.4, 0.4, 0], n=40)
    picture = noisy(truth, np.array([0.01, 0.01, 0.0]), 0)
    assert fitting.fit(picture, SCENE).surface in ("blinn-phong", "phong")


def test_under_several_lights_channels_that_err_together_have_a_covariance():
    """Their columns are no multiples of each other there."""
    lights = [brdf.DirectionalLight(direction=[0.4, 0.5, 0.8], intensity=[1.0, 0.9, 0.8])]
    lights.append(brdf.DirectionalLight(direction=[-0.8, 0.3, 0.6], intensity=[0.6, 0.6, 0.9]))
    scene, true = ball_scene(*lights, ambient=[0.3, 0.2, 0.1], camera=CAMERA), [0.2, 0.3, 0.4, 0.5, 0.2, 0.1]
    wide, held = brdf.BlinnPhong(k_a=true[:3], k_d=true[3:], k_s=[0.3, 0.3, 0.2], n=1.2), []
    for seed in range(6):
        own, shared = (np.random.default_rng(2 * seed + i).normal(0, 0.007, (36, 36, 3)) for i in range(2))
        result = fitting.fit(pictured(wide, scene) + own + shared[..., :1], scene, model="blinn-phong")
        assert np.min(np.linalg.eigvalsh(result.correlation)) > -1e-6
        assert all(one.error > 1e-4 for one in result.parameters if one.value)
        held += [
            low <= k <= high
            for k, (low, high) in zip(true, (one.interval for one in result.parameters[:6]), strict=True)
        ]
    assert np.mean(held) > 0.85


def test_the_reach_of_an_interval_is_that_of_students_distribution():
    degrees = np.array([2.0, 3.0, 5.5, 20.0, 1000.0])
    assert [student_95(one) for one in degrees] == pytest.approx(stats.t.ppf(0.975, degrees), rel=0.012)
    assert 0.85 < student_95(1.0) / stats.t.ppf(0.975, 1.0) < 1


@pytest.mark.parametrize("pixels", [3, 6])
def test_few_pixels_say_how_little_they_know(pixels):
    dull = brdf.Lambert(k_a=0.5, k_d=0.5)
    seen, held = np.flatnonzero(pictured(dull, SCENE) > 0), []
    for seed in range(60):
        mask = np.zeros(CAMERA.resolution, bool)
        mask.ravel()[np.random.default_rng(seed).choice(seen, pixels, replace=False)] = True
        result = fitting.fit(noisy(dull, 0.01, seed), SCENE, mask=mask, model="lambert")
        held += [low <= 0.5 <= high for low, high in (one.interval for one in result.parameters if one.interval)]
    # By the normal distribution 73 and 86 %.
    assert np.mean(held) > 0.9


def test_as_few_pixels_as_numbers_leave_no_error_to_tell():
    mask = np.zeros(CAMERA.resolution, bool)
    mask[[18, 30], [22, 12]] = True
    result = fitting.fit(noisy(brdf.Lambert(k_a=0.5, k_d=0.5), 0.01, 0), SCENE, mask=mask, model="lambert")
    assert [one.value for one in result.parameters] == [None, None]
    assert "as few pixels" in result.parameters[0].reason


def test_weights_of_one_picture_beside_none_of_another_and_of_every_second_column(monkeypatch: pytest.MonkeyPatch):
    view = brdf.PerspectiveCamera(position=[0, 0, 3], target=[0, 0, 0], up=[0, 1, 0], fov=30, resolution=(SIZE, SIZE))
    plane = brdf.Rectangle([-2, -2, 0], [4, 0, 0], [0, 4, 0])  # in every pixel: no mask makes an array of what is None
    scene = brdf.Scene(view, [plane], lights=[brdf.PointLight(position=[0.3, 0.4, 1], intensity=1.0)])
    clean = np.asarray(brdf.render(brdf.BlinnPhong(k_d=0.3, k_s=0.4, n=30), scene, precision="float64"))
    noise = 0.01 * np.random.default_rng(1).normal(size=(2, *clean.shape))
    weight = np.random.default_rng(2).uniform(0.1, 1, (SIZE, SIZE))

    def error(pictures: list[np.ndarray], weights: list[np.ndarray | None]) -> float:
        scenes = [scene] * len(pictures)
        return fitting.fit(pictures, scenes, model="blinn-phong", weight=weights, **OPTIONS)["n"].error

    pictures = [clean + noise[0] / np.sqrt(weight)[..., None], clean + noise[1]]
    for order in (slice(None), slice(None, None, -1)):
        both = error(pictures[order], [weight, np.ones_like(weight)][order])
        assert error(pictures[order], [weight, None][order]) == pytest.approx(both, rel=1e-4)
        assert error([clean + one for one in noise], [weight, None][order]) > 0
    columns = np.broadcast_to(np.where(np.arange(SIZE) % 2, 0.01, 1.0), weight.shape)
    known = error([clean + noise[0]], [columns])
    monkeypatch.setattr("fitting.uncertainty.noise_model.MOST_PIXELS", SIZE**2 // 4)
    assert error([clean + noise[0]], [columns]) == pytest.approx(known, rel=0.1)


@pytest.mark.parametrize("kind", ["soft mask", "region"])
def test_weights_that_are_no_inverse_variances_make_nothing_surer(kind: str):
    weight = np.full((SIZE, SIZE), 0.01)
    if kind == "region":
        weight[10:30, 12:34] = 1.0
    else:
        weight[np.random.default_rng(5).uniform(size=weight.shape) < 0.1] = 1.0
    material, scene, inside = brdf.BlinnPhong(k_a=[0.3] * 3, k_d=[0.5] * 3, k_s=[0.3] * 3, n=20), ball_scene(), []
    for seed in range(12):
        result = fitting.fit(pictured(material, scene, 0.01, seed), scene, model="blinn-phong", weight=weight)
        assert not result.warnings
        inside += [
            one.interval[0] <= getattr(material, one.name)[one.channel or 0] <= one.interval[1]
            for one in result.parameters
            if one.name != "n"
        ]
    # As inverse variances they would hold half.
    assert np.mean(inside) > 0.88


def test_noise_that_grows_beside_weights_that_are_a_mask_is_allowed_for():
    clean = pictured(GLOSS, SCENE)
    picture = pictured(GLOSS, SCENE, np.sqrt(0.002**2 + 0.001 * clean), 7)
    mask = np.random.default_rng(8).uniform(size=picture.shape[:2]) < 0.5
    hard, soft = (
        fitting.fit(picture, SCENE, model="blinn-phong", **options, **OPTIONS)
        for options in ({"mask": mask}, {"weight": np.where(mask, 1.0, 1e-3)})
    )
    for one, other in zip(hard.parameters, soft.parameters, strict=True):
        # By one variance for all values k_a would have half as much again. What lies outside tells of noise, too.
        assert other.error == pytest.approx(one.error, rel=0.1)


def test_weights_that_codes_are_no_inverse_variances_of_make_nothing_surer():
    clean, off = 255 * pictured(GLOSS, SCENE), []
    for seed in range(16):
        random = np.random.default_rng(seed)
        codes = np.clip(np.rint(clean + 3 * random.standard_normal(clean.shape)), 0, 255).astype(np.uint8)
        weight = np.exp(random.standard_normal(codes.shape[:2]))
        result = fitting.fit(codes, SCENE, model="blinn-phong", weight=weight)
        off += [(p.value - getattr(GLOSS, p.name).item()) / p.error for p in result.parameters]
    # As inverse variances they leave squares of 2.5.
    assert 0.5 < np.mean(np.square(off)) < 1.6


@pytest.mark.parametrize("k_s", [0.3, 0.003])
def test_errors_of_a_render_in_single_precision_hold_what_its_arithmetic_leaves(k_s: float):
    material, off = brdf.BlinnPhong(k_a=0.03, k_d=0.4, k_s=k_s, n=30.0), []
    for seed in (2, 3, 6, 7):
        place = np.random.default_rng(seed).normal(size=2)
        view = brdf.PerspectiveCamera(
            position=[*(0.5 * place), 3], target=[0, 0, 0], up=[0.3, 1, 0.1], fov=40, resolution=(64, 64)
        )
        scene = dataclasses.replace(SCENE, camera=view)
        target = np.asarray(brdf.render(material, scene, precision="float64"), np.float32)
        result = fitting.fit(target, scene, model="blinn-phong")
        off += [(p.value - getattr(material, p.name).item()) / p.error for p in result.parameters]
    # As a share of each number alone it leaves k_a 29, n of a weak highlight 5 errors off.
    assert np.max(np.abs(off)) < 2
    assert np.sqrt(np.mean(np.square(off))) > 0.1
