"""A fit that was saved comes back: numbers, report and plot; what needs the picture says when it is gone."""

import dataclasses
import json
import sys

import numpy as np
import pytest
from ball_scenes import MATERIAL
from command_runs import run
from small_ball import ball_scene, pictured

import brdf
import fitting


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("fit")
    scene = ball_scene()
    scene.save(folder / "scene.toml")
    brdf.write_image(folder / "photo.exr", pictured(MATERIAL, scene, 0.002))
    result = fitting.fit(brdf.read_picture(folder / "photo.exr"), scene)
    result.save(folder / "out")
    return folder, result


def test_numbers_are_had_by_name(folder):
    result = folder[1]
    assert result["n"] is result.parameters[-1]
    assert list(result) == list(dict.fromkeys(one.name for one in result.parameters))
    assert "n" in result
    assert result in {result}
    assert result["k_d"][1] is result["k_d[1]"]
    assert float(result["n"]) == result.material.n
    np.testing.assert_array_equal(np.asarray(result["k_d"], float), result.material.k_d)
    unknown = dataclasses.replace(result["n"], value=None)
    assert np.isnan(float(unknown))
    with pytest.raises(brdf.InputError, match=r"has no number 'k_x'. It has k_a, k_d, k_s, n"):
        result["k_x"]


def test_numbers_are_a_table_where_pandas_is_there(folder, monkeypatch):
    result = folder[1]
    table = result.to_dataframe()
    assert list(table.index) == [one.key for one in result.parameters]
    assert table.loc["n", ["value", "error"]].tolist() == [float(result["n"]), result["n"].error]
    assert tuple(table.loc["n", ["low", "high"]]) == result["n"].interval
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(brdf.InputError, match="needs pandas"):
        result.to_dataframe()


def test_a_saved_fit_comes_back(folder):
    path, result = folder
    for place in (path / "out", path / "out" / "fit.json"):
        again = fitting.load_result(place)
        assert str(again) == str(result)
        assert again.to_dict() == result.to_dict()
    np.testing.assert_array_equal(again.targets[0], result.targets[0])
    np.testing.assert_array_equal(again.counted[0], result.counted[0])
    np.testing.assert_allclose(again.fitted(), result.fitted(), rtol=1e-6)
    assert len(again.plot().axes) == len(result.plot().axes)
    again.save(path / "again")
    assert str(fitting.load_result(path / "again")) == str(result)


def test_a_picture_that_is_gone_or_changed_is_named_when_it_is_asked_for(folder, tmp_path):
    _, result = folder
    place = tmp_path / "photo.exr"
    brdf.write_image(place, result.targets[0])
    fitting.fit(brdf.read_picture(place), result.scenes[0], model="lambert").save(tmp_path / "out")
    again = fitting.load_result(tmp_path / "out")
    place.rename(tmp_path / "out" / "photo.exr")
    assert again.targets[0].shape == (48, 48, 3)
    (tmp_path / "out" / "photo.exr").rename(tmp_path / "elsewhere.exr")
    assert "lambert fitted to" in str(again)
    assert again.fitted().shape == (48, 48, 3)
    with pytest.raises(brdf.InputError, match=r"photo.exr: which was fitted, cannot be read"):
        again.plot()
    brdf.write_image(place, 2 * result.targets[0])
    with pytest.raises(brdf.InputError, match=r"photo.exr: is not what was fitted"):
        again.plot()


def test_the_report_says_how_a_file_was_read_that_does_not_say_it(folder, tmp_path):
    _, result = folder
    brdf.write_image(tmp_path / "photo.exr", result.targets[0])
    picture = brdf.read_picture(tmp_path / "photo.exr")
    silent = dataclasses.replace(picture, source="assumed", encoding="srgb", path=tmp_path / "photo.png")
    layered = dataclasses.replace(picture, layer="albedo")
    told = (
        (picture, ""),
        (silent, "  read as     sRGB: photo.png does not say how values are encoded"),
        (layered, "  read as     layer albedo: photo.exr names none as the picture"),
    )
    for given, said in told:
        report = str(fitting.fit(given, result.scenes[0], model="lambert"))
        assert (said or "\n") in report
        assert ("read as" in report) == bool(said)


def test_photographs_without_a_file_are_saved_beside_the_fit(tmp_path):
    points = ball_scene().surface_points()
    lights = [[0.3, 0.2, 1.0], [-0.4, 0.1, 1.0]]
    scenes = [brdf.Scene(points=points, lights=[brdf.DirectionalLight(light, 1.0)]) for light in lights]
    targets = [pictured(MATERIAL, scene, 0.002) for scene in scenes]
    result = fitting.fit(targets, scenes, model="blinn-phong")
    result.save(tmp_path)
    assert sorted(path.name for path in tmp_path.glob("*.exr")) == [
        "fitted.exr",
        "scene.aov.exr",
        "target.exr",
        "target1.exr",
    ]
    again = fitting.load_result(tmp_path)
    for index in (0, 1):
        np.testing.assert_allclose(again.targets[index], targets[index], rtol=1e-6)
        np.testing.assert_allclose(again.fitted(index), result.fitted(index), rtol=1e-4, atol=1e-6)
    again.plot()


def test_a_loaded_fit_is_saved_again_with_the_picture_that_was_fitted(folder, tmp_path, monkeypatch):
    _, result = folder
    target = np.asarray(result.targets[0])
    fitting.fit(target, result.scenes[0], model="lambert").save(tmp_path / "array")
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    # A stranger of the same name, where relative paths begin.
    brdf.write_image("target.exr", 0.5 * target)
    fitting.load_result(tmp_path / "array").save("again")
    np.testing.assert_array_equal(fitting.load_result("again").targets[0], target)
    brdf.write_image("photo.exr", target)
    fitting.fit(brdf.read_picture("photo.exr"), result.scenes[0], model="lambert").save("file")
    loaded = fitting.load_result("file")
    brdf.write_image("photo.exr", 0.5 * target)
    with pytest.raises(brdf.InputError, match=r"photo.exr: is not what was fitted"):
        loaded.save("changed")


def test_a_folder_that_is_saved_into_again_holds_the_last_fit_alone(folder, tmp_path, capsys):
    _, result = folder
    out, photo, target = tmp_path / "out", tmp_path / "photo.exr", np.asarray(result.targets[0])
    brdf.write_image(photo, 0.5 * target)
    first = fitting.fit([target, target], [result.scenes[0]] * 2, model="lambert", mask=target[..., 0] > 0.1)
    first.save(out, plot=True)
    (out / "mine.png").write_bytes(b"mine")
    earlier = {"target.exr", "target1.exr", "scene1.toml", "mask.png", "mask1.png", "comparison.png", "mine.png"}
    assert earlier <= {path.name for path in out.iterdir()}
    fitting.fit(brdf.read_picture(photo), result.scenes[0], model="lambert").save(out)
    assert {path.name for path in out.iterdir()} & earlier == {"mine.png"}
    assert run(capsys, "fit", out, "--model", "lambert")[0] == 2  # no target.*: the picture lies elsewhere
    # What the next fit reads stays, though an earlier one has written it.
    first.save(out)
    fitting.fit(brdf.read_picture(out / "target.exr"), result.scenes[0], model="lambert").save(out)
    assert {path.name for path in out.iterdir()} & earlier == {"target.exr", "mine.png"}
    np.testing.assert_array_equal(fitting.load_result(out).targets[0], target)


def test_what_is_no_saved_fit_is_refused(folder, tmp_path):
    with pytest.raises(brdf.InputError, match=r"fit.json: there is no such file"):
        fitting.load_result(tmp_path)
    values = json.loads((folder[0] / "out" / "fit.json").read_text())
    for change in ({"pictures": None}, {"parameters": 3}, {"table": "x"}):
        (tmp_path / "fit.json").write_text(json.dumps(values | change))
        with pytest.raises(brdf.InputError, match=r"fit.json: is (no fit|the fit of a measured)"):
            fitting.load_result(tmp_path)


def test_the_commands_take_what_fit_wrote(folder, tmp_path, capsys):
    out = folder[0] / "out"
    for given in (out, out / "fit.json"):
        assert run(capsys, "render", given, "-o", tmp_path / "a.exr")[0] == 0
        np.testing.assert_allclose(brdf.read_image(tmp_path / "a.exr"), brdf.read_image(out / "fitted.exr"), rtol=1e-6)
        status, said, _ = run(capsys, "check", given)
        assert (status, "not plausible" in said) == (1, True)
        assert run(capsys, "convert", given, tmp_path / "a.gltf")[0] == 0
    assert "--scene: is missing" in run(capsys, "render", "emerald", "-o", tmp_path / "a.exr")[2]
