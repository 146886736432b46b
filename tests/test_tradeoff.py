"""Fits to an accuracy, and the table of speed against accuracy."""

import csv
import dataclasses
import io
import json
import types

import jax
import numpy as np
import pytest

import brdf
import fitting
from brdf.shading.visibility import OFFSET
from fitting.accuracy import budget, sampling_error
from fitting.accuracy.configurations import Configuration
from fitting.accuracy.deviation import deviation
from fitting.accuracy.lamps import Lamps, with_samples
from fitting.accuracy.pixel_sampling import sample_pixels
from fitting.accuracy.sampling_error import Estimate
from fitting.accuracy.speed_table import Row, Tradeoff
from fitting.accuracy.stopwatch import take
from fitting.cli.main import main

MATERIAL = brdf.BlinnPhong(k_a=[0.2, 0.3, 0.1], k_d=[0.5, 0.3, 0.2], k_s=[0.4, 0.4, 0.4], n=60.0)


def ball(size=192, lights=None, shapes=None):
    camera = brdf.OrthographicCamera(
        position=(0, 0, 4), target=(0, 0, 0), up=(0, 1, 0), width=2.2, resolution=(size, size)
    )
    lights = lights or (brdf.DirectionalLight(direction=(0.5, 0.6, 0.7), intensity=1.0),)
    shapes = shapes or (brdf.Sphere(center=(0, 0, 0), radius=1.0),)
    return brdf.Scene(camera=camera, shapes=shapes, ambient=[0.2], lights=lights)


def noisy(scene, share=0.0, material=MATERIAL):
    picture = np.asarray(brdf.render(material, scene, precision="float64"))
    return picture + share * picture.mean() * np.random.default_rng(7).standard_normal(picture.shape)


@pytest.mark.parametrize("kind", ["one ball", "two shapes", "points", "area"])
def test_some_pixels_see_what_the_whole_picture_shows_there(kind):
    scene = ball(32)
    if kind == "two shapes":
        floor = brdf.Rectangle(center=(0, -0.5, 0), edge_u=(3, 0, 0), edge_v=(0, 0.4, -3))
        scene = ball(32, shapes=(*scene.shapes, floor))
    if kind == "points":
        scene = dataclasses.replace(scene, camera=None, shapes=(), points=scene.surface_points())
    if kind == "area":
        scene = dataclasses.replace(scene, camera=dataclasses.replace(scene.camera, samples=3))
    pixel = np.random.default_rng(0).choice(32 * 32, 200, replace=False)
    whole = np.asarray(brdf.render(MATERIAL, scene, precision="float64")).reshape(-1, 3)[pixel]
    some = brdf.render(MATERIAL, brdf.some_pixels(scene, pixel, precision="float64"), precision="float64")
    # The same arithmetic in another order.
    np.testing.assert_allclose(np.asarray(some)[0], whole, rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize(("height", "width"), [(192, 192), (100, 333)])
def test_a_sample_stands_for_every_pixel_once(height, width):
    camera = dataclasses.replace(ball().camera, resolution=(width, height))
    sample = sample_pixels(dataclasses.replace(ball(), camera=camera), brdf.BlinnPhong, 1024)
    assert sample is not None
    assert sample.stands_for.sum() == height * width
    assert np.unique(sample.pixel).size == sample.pixel.size
    assert sample.pixel.max() < height * width


def test_a_sample_crowds_where_the_highlight_is():
    scene = ball(1024)
    sample = sample_pixels(scene, brdf.BlinnPhong, 1024)
    half = np.array([0.5, 0.6, 0.7]) / np.sqrt(1.1) + np.array([0, 0, 1])
    half /= np.linalg.norm(half)
    column, row = half[0] * 1024 / 2.2 + 512, 512 - half[1] * 1024 / 2.2
    distance = np.hypot(sample.pixel % 1024 + 0.5 - column, sample.pixel // 1024 + 0.5 - row)
    assert np.all(sample.stands_for[distance < 4] == 1)
    assert np.median(sample.stands_for[distance > 300]) >= 64


def test_a_light_map_keeps_its_light_with_other_samples():
    pixels = np.random.default_rng(1).random((16, 32, 3))
    scene = ball(8, (brdf.EnvironmentMap(pixels, radiance=[1.0, 2.0, 3.0], samples=64),))
    lamps = Lamps()
    light = lamps.with_samples(scene, 16).lights[0]
    assert light.samples == 16
    assert lamps.with_samples(scene, 16).lights[0] is light
    np.testing.assert_allclose(light.radiance, scene.lights[0].radiance, rtol=1e-12)
    assert with_samples(ball(8), 4).lights == ball(8).lights


@pytest.mark.parametrize("share", [0.0, 0.03])
def test_the_accuracy_holds_and_is_foretold(share):
    scene = ball()
    picture = noisy(scene, share)
    reference = fitting.fit(picture, scene, model="blinn-phong", precision="float64")
    for accuracy in (1e-1, 1e-2, 1e-4):
        result = fitting.fit(picture, scene, model="blinn-phong", accuracy=accuracy)
        assert result.choice is not None
        assert result.choice.met
        actual = max(deviation(result, reference)[:2])
        assert actual <= accuracy
        # A random error is known to a factor.
        assert actual / 4 < result.choice.chosen.error < actual * 4


def test_an_accuracy_of_noisy_pixels_takes_more_of_them():
    scene = ball(300)
    picture = noisy(scene, 0.1)
    coarse, fine = (fitting.fit(picture, scene, model="blinn-phong", accuracy=a).choice for a in (0.3, 1e-3))
    assert coarse is not None
    assert fine is not None
    assert coarse.pixels < fine.pixels == fine.of_pixels


@pytest.mark.parametrize("kind", ["mask", "weight"])
def test_the_accuracy_holds_where_only_some_pixels_count(kind):
    scene = ball(600)
    picture = noisy(scene, 0.02)
    # Those that hardly count show something else.
    picture[:, :240] *= 1.3
    counts = np.ones((600, 600))
    counts[:, :240] = 0.0 if kind == "mask" else 1e-4
    given = {kind: counts}
    reference = fitting.fit(picture, scene, model="blinn-phong", precision="float64", **given)
    result = fitting.fit(picture, scene, model="blinn-phong", accuracy=3e-2, **given)
    assert result.choice is not None
    assert result.choice.met
    assert result.choice.pixels < 10000
    assert max(deviation(result, reference)[:2]) <= 3e-2


def test_a_small_mask_is_looked_at_whole_and_the_result_says_why():
    scene = ball(600)
    counts = np.zeros((600, 600), bool)
    counts[280:300, 300:330] = True
    result = fitting.fit(noisy(scene), scene, model="lambert", accuracy=1e-1, mask=counts)
    assert result.choice is not None
    assert "all pixels: choosing among so few" in str(result)


def test_a_process_of_one_fit_does_not_compile_what_would_choose():
    scene = ball(300)
    picture = noisy(scene, 0.01)
    with budget.single_fit():
        alone = fitting.fit(picture, scene, model="blinn-phong", accuracy=1e-1)
    again = fitting.fit(picture, scene, model="blinn-phong", accuracy=1e-1)
    assert alone.choice is not None
    assert again.choice is not None
    assert alone.choice.pixels == alone.choice.of_pixels > again.choice.pixels
    assert "in a process of its own" in alone.choice.reason
    assert again.choice.reason == ""


def test_pictures_of_different_sizes_count_by_their_pixels():
    large, small = ball(600), ball(96)
    pictures = [noisy(large), 1.5 * noisy(small)]
    reference = fitting.fit(pictures, [large, small], model="blinn-phong", precision="float64")
    result = fitting.fit(pictures, [large, small], model="blinn-phong", accuracy=1e-1)
    assert result.choice is not None
    assert result.choice.pixels < result.choice.of_pixels
    assert max(deviation(result, reference)[:2]) <= 1e-1


def test_what_float32_does_at_the_edges_of_shadows_is_told():
    floor = brdf.Rectangle(center=(0, -1, 0), edge_u=(100, 0, 0), edge_v=(0, 0, -100))
    camera = brdf.PerspectiveCamera(position=(0, 2, 5), target=(0, 0, 0), up=(0, 1, 0), fov=40, resolution=(256, 256))
    scene = dataclasses.replace(ball(shapes=(ball().shapes[0], floor)), camera=camera)
    picture = noisy(scene)
    reference = fitting.fit(picture, scene, model="blinn-phong", precision="float64")
    result = fitting.fit(picture, scene, model="blinn-phong", accuracy=3e-3)
    assert result.choice is not None
    assert result.precision == "float32"
    # Which pixels cross is chance; that some may, is known.
    assert 1e-5 < result.choice.chosen.bound < 3e-3
    assert max(deviation(result, reference)[:2]) <= result.choice.chosen.bound
    assert fitting.fit(picture, scene, model="blinn-phong", accuracy=1e-4).precision == "float64"


def test_shadow_rays_start_where_the_estimate_thinks():
    assert sampling_error.RAY_START == OFFSET


def test_columns_that_nearly_add_up_are_taken_in_float64():
    # The light meets every point of the sheet alike, as ambient light does.
    sheet = brdf.Rectangle(center=(0, 0, 0), edge_u=(1, 0, 0), edge_v=(0, 1, 0))
    camera = brdf.PerspectiveCamera(
        position=(-2, 0, 0.6), target=(0, 0, 0), up=(0, 0, 1), fov=40, resolution=(128, 128)
    )
    light = brdf.DirectionalLight(direction=(0.95, 0.1, 0.3), intensity=2.0)
    scene = dataclasses.replace(ball(lights=(light,), shapes=(sheet,)), camera=camera)
    result = fitting.fit(noisy(scene, 0.01), scene, model="blinn-phong", accuracy=1e-2)
    assert result.precision == "float64"
    assert result.undetermined


def test_the_time_to_spend_ends_the_search():
    result = fitting.fit(noisy(ball(), 0.1), ball(), model="blinn-phong", seconds=1e-6)
    assert result.choice is not None
    assert len(result.choice.attempts) == 1
    assert "chosen" in str(result)
    assert result.to_dict()["choice"]["seconds"] == 1e-6


@pytest.mark.parametrize(("error", "narrowed"), [(0.01, (15.0, 240.0)), (1.0, None)])
def test_the_next_search_is_narrow_only_where_the_estimate_can_be_believed(error, narrowed):
    n = types.SimpleNamespace(name="n", value=60.0, interval=(59.0, 61.0))
    run = types.SimpleNamespace(result=types.SimpleNamespace(parameters=[n], candidates=()))
    step = types.SimpleNamespace(run=run, estimate=Estimate(error, error, 0.0, error, 0.0))
    assert budget._near(step, {"n_range": (0.1, 1e6)}) == narrowed


@pytest.mark.parametrize(
    ("order", "error", "allowed", "samples"), [(1, 0.4, 0.01, 1024), (2, 0.1, 1e-4, 512), (1, 0.9, 0.01, 64)]
)
def test_light_samples_grow_as_their_error_falls(order, error, allowed, samples):
    told = Estimate(error, error, 0.0, error, 0.0)
    assert budget._more_samples(16, lambda count, _: error * (16 / count) ** order, told, allowed) == samples


def test_the_compiler_is_no_part_of_a_run():
    double = jax.jit(lambda x: 2 * x)
    (_, first), (_, second) = take(lambda: double(1.0)), take(lambda: double(1.0))
    assert first.compiling > 0
    assert second.compiling == 0
    assert first.seconds < first.compiling


@pytest.mark.parametrize("accuracy", [0, -1.0, "fine", True, float("nan")])
def test_what_is_no_accuracy_is_refused(accuracy):
    with pytest.raises(brdf.InputError, match="accuracy: must be a number above 0"):
        fitting.fit(noisy(ball(32)), ball(32), accuracy=accuracy)


def test_weights_count():
    scene = ball(48)
    picture = noisy(scene)
    picture[:, :24] *= 2.0
    weight = np.ones((48, 48))
    weight[:, :24] = 0.0
    result = fitting.fit(picture, scene, model="blinn-phong", precision="float64", weight=weight)
    # The right half is exact.
    np.testing.assert_allclose(result.material.k_d, MATERIAL.k_d, rtol=1e-9)
    for accuracy in (None, 1e-2):
        with pytest.raises(brdf.InputError, match="weight"):
            fitting.fit(picture, scene, weight=weight[:3], accuracy=accuracy)
        with pytest.raises(brdf.InputError, match="weight: must be 0 or more"):
            fitting.fit(picture, scene, weight=-weight, accuracy=accuracy)


def row(name, seconds, error, work, **changes):
    values = {
        "axis": "pixels",
        "configuration": Configuration(),
        "name": name,
        "compile_seconds": 1.0,
        "seconds": seconds,
        "spread": 0.0,
        "runs": 9,
        "peak": None,
        "rms": error,
        "worst": error,
        "parameters": 0.0,
        "work": work,
    }
    return Row(**(values | changes))


def table(*rows, accuracy=1e-3):
    return Tradeoff(rows, "float64", accuracy, len(rows), 1.0)


def test_the_front_holds_what_nothing_beats_in_both():
    rows = row("a", 1.0, 1e-1, 1), row("b", 2.0, 1e-3, 2), row("c", 3.0, 1e-2, 3), row("d", 4.0, 1e-5, 4)
    assert [one.name for one in table(*rows).front] == ["a", "b", "d"]


def test_the_recommendation_is_the_least_work_whatever_the_times_jitter():
    for times in ((1.0, 1.4), (1.4, 1.0)):
        found = table(row("little", times[0], 5e-4, 1), row("much", times[1], 1e-6, 9)).recommended
        assert found is not None
        assert found.name == "little"
    slow = table(row("little", 9.0, 5e-4, 1), row("much", 1.0, 1e-6, 9)).recommended
    assert slow is not None
    assert slow.name == "much"


def test_where_nothing_keeps_the_accuracy_nothing_is_recommended():
    found = table(row("a", 1.0, 1e-2, 1), row("b", 2.0, 1e-1, 2), row("c", 1.0, np.inf, 0))
    assert found.recommended is None
    assert found.closest is not None
    assert found.closest.name == "a"
    assert found.advice.startswith("nothing is recommended")
    assert "the most accurate is a (1e+03 ms, error 0.01)" in found.advice
    assert [found.marks(one) for one in found.rows] == ["most accurate, front", "", ""]


def test_a_table_cut_short_recommends_only_what_keeps_the_accuracy():
    rows = row("coarse", 1.0, 1e-2, 1), row("good", 3.0, 1e-4, 9)
    cut = dataclasses.replace(table(*rows), planned=5)
    assert cut.recommended is rows[1]
    assert "2 of 5 configurations were measured" in cut.advice
    assert "measured" not in table(*rows).advice


def test_only_the_axes_that_a_scene_has_are_tried(tmp_path):
    scene = ball(64)
    found = fitting.tradeoff(noisy(scene, 0.01), scene, seconds=60.0)
    axes = {one.axis for one in found.rows}
    assert {"default", "precision", "model", "solver"} <= axes
    assert not axes & {"samples", "shadows", "render"}
    assert found.recommended in found.rows
    assert found.default is not None
    assert found.default.error < 1e-5
    found.save(tmp_path / "out")
    lines = list(csv.DictReader(io.StringIO((tmp_path / "out" / "tradeoff.csv").read_text())))
    assert [line["name"] for line in lines] == [one.name for one in found.rows]
    assert len(json.loads((tmp_path / "out" / "tradeoff.json").read_text())["rows"]) == len(lines)
    assert (tmp_path / "out" / "tradeoff.png").stat().st_size > 10000
    assert "recommended" in str(found)


def test_ctrl_c_keeps_what_was_measured():
    scene = ball(48)

    def interrupt(done, total):
        assert total > done
        if done == 4:
            raise KeyboardInterrupt

    found = fitting.tradeoff(noisy(scene), scene, progress=interrupt)
    assert not found.complete
    # Each ran once: what is not known at all comes before what is not known well.
    assert len(found.rows) == 4


def test_the_command_measures_a_photograph_of_a_ball(tmp_path, capsys):
    scene = ball(64)
    brdf.write_image(tmp_path / "ball.png", noisy(scene, 0.01).astype(np.float32), encoding="srgb")
    options = ["--sphere", "31.5,31.5,29.09", "--light", "0.5,0.6,0.7", "--ambient", "--seconds", "4", "--json"]
    with pytest.raises(SystemExit) as ended:
        main(["tradeoff", str(tmp_path / "ball.png"), *options])
    assert ended.value.code == 0
    told = json.loads(capsys.readouterr().out)
    assert told["rows"][0]["error"] < 1e-3
    assert told["advice"].startswith("recommended")


def test_the_command_measures_one_picture(tmp_path, capsys):
    normal = np.zeros((8, 8, 3))
    normal[..., 2] = 1.0
    np.savez(tmp_path / "two.npz", images=np.ones((2, 8, 8)), normal=normal, light_dirs=np.ones((2, 3)))
    with pytest.raises(SystemExit) as ended:
        main(["tradeoff", str(tmp_path / "two.npz")])
    assert ended.value.code == 2
    assert "two.npz: holds 2 pictures, and one is measured" in capsys.readouterr().err
