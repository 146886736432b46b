"""A model is one class and one entry in `MODELS`, and everything takes it: shown with one that only the tests have.

The property tests of `tests/brdf/test_models.py` run over it as well.
"""

import numpy as np
import pytest
from command_runs import run
from extra_model import Retroreflector
from small_ball import ball_scene, pictured

import brdf
import fitting
from benchmarks.stability import stability_map
from brdf.plausibility.numeric import albedo_of

MATERIAL = Retroreflector(k_a=[0.1, 0.1, 0.1], k_d=[0.3, 0.2, 0.1], k_s=[0.4, 0.3, 0.2], n=20.0)
SCENE = ball_scene()


@pytest.fixture(autouse=True)
def entered(monkeypatch):
    monkeypatch.setitem(brdf.MODELS, Retroreflector.name, Retroreflector)


def test_it_is_rendered():
    points = SCENE.surface_points()
    seen, normal = (np.asarray(leaf, np.float64) for leaf in (points.mask, points.normal))
    light = np.array([0.5, 0.6, 0.7]) / np.linalg.norm([0.5, 0.6, 0.7])
    n_l = np.maximum(normal @ light, 0)
    lobe = np.where((n_l > 0) & (normal[..., 2] > 0), light[2] ** 20, 0)  # the eye is infinitely far along z
    by_hand = MATERIAL.k_d * n_l[..., None] + MATERIAL.k_s * lobe[..., None]
    by_hand = (MATERIAL.k_a * [0.2, 0.2, 0.3] + by_hand * [1.0, 0.8, 0.6]) * seen[..., None]
    np.testing.assert_allclose(brdf.render(MATERIAL, SCENE, precision="float64"), by_hand, atol=1e-6)


def test_it_is_fitted_saved_and_read_by_its_name(tmp_path, capsys):
    camera = brdf.PerspectiveCamera(position=[0, 0, 3], target=[0, 0, 0], up=[0, 1, 0], fov=50, resolution=(48, 48))
    near = ball_scene(brdf.PointLight(position=[0.4, 0.3, 2.5], intensity=[3.0, 3.0, 3.0]), camera=camera)
    result = fitting.fit(pictured(MATERIAL, near), near, model=Retroreflector, precision="float64")
    np.testing.assert_allclose(float(result["n"]), 20, rtol=1e-6)
    result.save(tmp_path, plot=True)
    again = fitting.load_result(tmp_path)
    assert isinstance(again.material, Retroreflector)
    assert str(again) == str(result)
    status, said, _ = run(capsys, "check", tmp_path)
    assert (status, "not plausible" in said) == (1, True)
    for name in ("material.json", "material.mtl"):
        assert brdf.load_material(tmp_path / name).k_d == pytest.approx(result.material.k_d, rel=1e-3)


def test_it_is_checked_drawn_and_exported():
    report = brdf.check(MATERIAL)
    assert report.positivity.verdict == "pass"
    # Not multiplied by N.L, so not reciprocal, as the classic forms are not.
    assert report.reciprocity.verdict == "fail"
    fitting.overview(MATERIAL, report)
    stable = stability_map(Retroreflector, np.array([0.0, 10.0, 1e6]), np.array([0.0, 60.0, 89.0]))
    assert stable.finite.all()
    assert stable.error.max() < 1e-5
    assert "retroreflector" in brdf.export_material(MATERIAL, "json").text
    with pytest.raises(brdf.InputError, match="model retroreflector, whose albedo has no closed form"):
        brdf.directional_albedo(MATERIAL, 0.5)
    curve = fitting.plot_albedo(MATERIAL).axes[0].lines[1]
    angles = np.array([0.0, 40.0])
    np.testing.assert_allclose(np.interp(angles, *curve.get_data()), albedo_of(MATERIAL.reflectance, angles)[:, 0])


def test_pages_say_that_they_draw_another_lobe():
    words = "The lobe of retroreflector is drawn as Blinn-Phong's"
    result = fitting.fit(pictured(MATERIAL, SCENE), SCENE, model=Retroreflector)
    assert words in result.view().text
    normals = np.tile([0.0, 0.0, 1.0], (2, 2, 1))
    lights = [[0, 0, 1], [0.4, 0, 1], [0, 0.4, 1], [-0.4, 0, 1], [0, -0.4, 1], [0.3, 0.3, 1]]
    maps = fitting.fit_maps(np.full((6, 2, 2, 3), 0.5), lights, normals, model="retroreflector")
    assert words in maps.view().text
    for form in ("mtl", "three", "gltf", "mitsuba", "mitsuba-dict", "pytorch3d", "glsl"):
        assert "no word for the lobe of retroreflector" in brdf.export_material(MATERIAL, form).losses[0]
