"""A picture that is read by bands of rows gives the fit of the picture in memory."""

import dataclasses
import weakref
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
import pytest

import brdf
import fitting
from brdf import lobes
from brdf.geometry import rays
from fitting import core, pixels
from fitting.solver.streams import Stream, each, joined

MATERIAL = brdf.BlinnPhong(k_a=[0.05, 0.04, 0.03], k_d=[0.5, 0.3, 0.1], k_s=[0.3, 0.25, 0.2], n=60.0)
SIZE = (64, 60)


def scene(**changes) -> brdf.Scene:
    camera = brdf.OrthographicCamera(
        position=[0.0, 0.0, 4.0], target=[0.0, 0.0, 0.0], up=[0.0, 1.0, 0.0], width=2.4, resolution=SIZE
    )
    light = brdf.DirectionalLight(direction=[0.4, 0.5, 0.8], intensity=[0.9, 0.8, 0.7])
    occluder = brdf.Sphere(center=[0.9, 0.9, 1.4], radius=0.3, fitted=False)
    parts = {
        "camera": camera,
        "shapes": [brdf.Sphere(center=[0.0, 0.0, 0.0], radius=1.0), occluder],
        "lights": [light],
        "ambient": [0.2, 0.2, 0.2],
    }
    return brdf.Scene(**(parts | changes))


def picture(noise: float = 0.01) -> np.ndarray:
    clean = np.asarray(brdf.render(MATERIAL, scene()))
    return (clean + noise * np.random.default_rng(3).standard_normal(clean.shape)).astype(np.float32)


@pytest.fixture(autouse=True)
def small_bands(monkeypatch):
    """Five bands of one size."""
    monkeypatch.setattr(pixels, "TILE_PIXELS", 12 * SIZE[0] + 5)
    monkeypatch.setattr(pixels, "KEPT_PIXELS", 0)
    monkeypatch.setattr(pixels, "ALIGNED_ROWS", 12)


def test_a_clipped_highlight_is_left_out_by_what_is_predicted(tmp_path: Path):
    clean, off = np.asarray(brdf.render(MATERIAL, scene())), []
    for seed in range(4):
        noise = 0.02 * np.random.default_rng(seed).standard_normal(clean.shape)
        brdf.write_image(tmp_path / "clipped.exr", np.minimum(clean + noise, 0.5).astype(np.float32))
        with brdf.ImageReader(tmp_path / "clipped.exr") as reader:
            k_s = fitting.fit(reader, scene(), model="blinn-phong")["k_s"][0]
        off.append((k_s.value - MATERIAL.k_s[0]) / k_s.error)
    assert abs(np.mean(off)) < 1.0


def test_a_band_of_which_no_pixel_counts_tells_of_nothing_that_errs_together(tmp_path: Path):
    clean = np.asarray(brdf.render(MATERIAL, scene()))
    coarse = np.random.default_rng(0).standard_normal((-(-clean.shape[0] // 4), -(-clean.shape[1] // 4), 1))
    noise = 0.03 * np.kron(coarse, np.ones((4, 4, 1)))[: clean.shape[0], : clean.shape[1]]
    brdf.write_image(tmp_path / "blocks.exr", (clean + noise).astype(np.float32))
    below = np.arange(clean.shape[0])[:, None] * np.ones(clean.shape[1]) > clean.shape[0] / 2
    with brdf.ImageReader(tmp_path / "blocks.exr") as reader:
        result = fitting.fit(reader, scene(), model="blinn-phong", mask=below)
    assert any("structure" in words for words in result.warnings)
    assert abs(result["k_d"][0].value - MATERIAL.k_d[0]) < 4 * result["k_d"][0].error


def test_a_clipped_picture_in_tiles_is_fitted_as_a_whole_one(monkeypatch):
    clean = np.asarray(brdf.render(MATERIAL, scene()))
    noise = 0.02 * np.random.default_rng(5).standard_normal(clean.shape)
    target = np.minimum(clean + noise, 0.5).astype(np.float32)
    tiled = fitting.fit(target, scene(), model="blinn-phong")
    monkeypatch.setattr(pixels, "KEPT_PIXELS", target.size)
    whole = fitting.fit(target, scene(), model="blinn-phong")
    # What is clipped says that it is no less; in tiles that was left out, and k_s 3 errors too low.
    for mine, its in zip(tiled.parameters, whole.parameters, strict=True):
        assert mine.value == pytest.approx(its.value, abs=0.02 * its.error)
        assert mine.error == pytest.approx(its.error, rel=0.02)


def same(streamed: fitting.FitResult, whole: fitting.FitResult, tolerance: float = 2e-5):
    assert type(streamed.material) is type(whole.material)
    for mine, its in zip(streamed.parameters, whole.parameters, strict=True):
        assert (mine.name, mine.channel, mine.reason) == (its.name, its.channel, its.reason)
        if its.value is not None:
            assert its.error is not None
            np.testing.assert_allclose(mine.value, its.value, atol=0.02 * its.error + tolerance, rtol=tolerance)
            # How the noise grows with brightness is asked of other pixels.
            np.testing.assert_allclose(mine.error, its.error, rtol=0.2, atol=1e-7)
    assert streamed.left_out == whole.left_out
    assert streamed.pixels == whole.pixels
    np.testing.assert_allclose(streamed.residual, whole.residual, rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize(("model", "rows"), [("auto", 12), ("lambert", 13)])
def test_file_and_memory_agree(tmp_path: Path, monkeypatch, model: str, rows: int):
    # Of 13 rows the last band is shorter.
    monkeypatch.setattr(pixels, "TILE_PIXELS", rows * SIZE[0])
    monkeypatch.setattr(pixels, "ALIGNED_ROWS", rows)
    path = tmp_path / "target.exr"
    brdf.write_image(path, picture())
    whole = fitting.fit(brdf.read_image(path), scene(), model=model)
    with brdf.ImageReader(path) as reader:
        same(fitting.fit(reader, scene(), model=model), whole)


@pytest.mark.parametrize("options", [{"loss": "huber"}, {"plausible": True}, {"dark": 0.05}])
def test_options_agree(tmp_path: Path, options: dict):
    path = tmp_path / "target.exr"
    brdf.write_image(path, picture())
    whole = fitting.fit(brdf.read_image(path), scene(), **options)
    with brdf.ImageReader(path) as reader:
        same(fitting.fit(reader, scene(), **options), whole, 1e-3)


@pytest.mark.parametrize(
    "true", [MATERIAL, brdf.Phong(k_d=[0.5] * 3, k_s=[0.3] * 3, n=20.0), brdf.Lambert(k_d=[0.5] * 3)]
)
def test_one_model_at_a_time_is_in_memory(monkeypatch, true):
    """Of a large picture, what the engine needs of the model before is made anew where it is asked for again."""
    clean = np.asarray(brdf.render(true, scene()))
    noisy = clean + 0.01 * np.random.default_rng(0).standard_normal(clean.shape)
    alive = []

    fit_model = core._fit_model

    def watched(model, observed):
        alive.append(sum(reference() is not None for reference in seen))
        fit = fit_model(model, observed)
        seen.extend(weakref.ref(picture.diffuse) for picture in fit.pictures)
        return fit

    seen: list[weakref.ref] = []
    monkeypatch.setattr(core, "_fit_model", watched)
    cut = fitting.fit(noisy, scene())
    assert alive == [0, 0]
    monkeypatch.setattr(pixels, "TILE_PIXELS", noisy[..., 0].size)
    seen.clear()
    whole = fitting.fit(noisy, scene())
    assert alive[2:] == [0, 1]
    same(cut, whole)


@pytest.mark.parametrize(("most", "name"), [(1024, "linear.png"), (30, "linear.png"), (30, "half.exr")])
def test_codes_coarser_than_noise_are_fitted_as_codes(tmp_path: Path, monkeypatch, most: int, name: str):
    """By least squares coefficients were up to 80 of their errors off."""
    monkeypatch.setattr(pixels, "SHOWN_PIXELS", most)
    clean = np.asarray(brdf.render(MATERIAL, scene(), precision="float64"))
    kind: Any = "uint8" if name.endswith("png") else "half"
    brdf.write_image(tmp_path / name, clean, dtype=kind, encoding="linear")
    with brdf.ImageReader(tmp_path / name, encoding="linear") as reader:
        found = fitting.fit(reader, scene(), model="blinn-phong")
    whole = fitting.fit(brdf.read_picture(tmp_path / name, encoding="linear"), scene(), model="blinn-phong")
    for one, other in zip(found.parameters, whole.parameters, strict=True):
        truth = np.ravel(getattr(MATERIAL, one.name))[one.channel or 0]
        assert abs(float(one) - truth) < 4 * one.error
        assert one.error == pytest.approx(other.error, rel=1e-3) if most > 60 else 1 < one.error / other.error < 40


def test_neighbours_of_a_lossy_file_err_together_also_where_it_is_read_by_bands(tmp_path: Path):
    brdf.write_image(tmp_path / "ball.jpg", picture())
    with brdf.ImageReader(tmp_path / "ball.jpg") as reader:
        found = fitting.fit(reader, scene(), model="blinn-phong")
    whole = fitting.fit(tmp_path / "ball.jpg", scene(), model="blinn-phong")
    for one, other in zip(found.parameters, whole.parameters, strict=True):
        assert (float(one), one.error) == pytest.approx((float(other), other.error), rel=1e-4)


def test_a_stated_rounding_is_that_of_a_file_read_by_bands(tmp_path: Path):
    clean = np.asarray(brdf.render(MATERIAL, scene(), precision="float64"))
    path = tmp_path / "linear.png"
    brdf.write_image(path, clean, dtype="uint8", encoding="linear")
    with brdf.ImageReader(path, encoding="linear") as reader:
        found = fitting.fit(reader, scene(), model="blinn-phong", rounding=0)
    whole = fitting.fit(brdf.read_image(path, encoding="linear"), scene(), model="blinn-phong", rounding=0)
    assert float(found["n"]) == pytest.approx(float(whole["n"]), rel=1e-5)
    assert float(found["n"]) != pytest.approx(60.0, rel=1e-3)


def test_codes_finer_than_noise_are_fitted_on_all_pixels(tmp_path: Path, monkeypatch):
    """A bright pixel, and one that is infinite, beside the ball are no reason to look at some of the others."""
    monkeypatch.setattr(pixels, "SHOWN_PIXELS", 30)
    values = picture()
    values[0, 0], values[0, 3] = 1000.0, np.inf
    brdf.write_image(tmp_path / "half.exr", values, dtype="half")
    with brdf.ImageReader(tmp_path / "half.exr") as reader:
        assert fitting.fit(reader, scene(), model="blinn-phong").pixels == 2241


def test_bands_share_their_programs():
    """Or the first fit of a picture of 64 bands would compile each of them."""
    programs: tuple[Any, ...] = lobes.diffuse_and_kept, rays.PrimaryRays.__dict__["mask"].func
    before = [program._cache_size() for program in programs]
    cameras = dataclasses.replace(scene().camera, resolution=(50, 60))
    place = scene(camera=cameras)
    fitting.fit(np.asarray(brdf.render(MATERIAL, place)), place, model="blinn-phong")
    # The picture is rendered, and its bands are fitted.
    assert [program._cache_size() - count for program, count in zip(programs, before, strict=True)] == [1, 1]


@pytest.mark.parametrize("light", ["area", "distant"])
def test_bands_without_a_pixel_and_far_from_the_highlight(light: str):
    """Relative to the peak of a band beside the highlight a lobe that is tabulated would be infinite."""
    lights = {"distant": scene().lights[0]}
    lights["area"] = brdf.RectangleLight(
        center=[1.5, 2.0, 3.0], edge_u=[0.05, 0, 0], edge_v=[0, -0.05, 0], radiance=[900.0] * 3, samples=16
    )
    place = scene(lights=[lights[light]], shapes=[brdf.Sphere(center=[0.0, 0.0, 0.0], radius=1.0)])
    sharp = brdf.BlinnPhong(k_a=0.1, k_d=0.4, k_s=0.5, n=800)
    target = np.asarray(brdf.render(sharp, place)) + 0.003 * np.random.default_rng(0).standard_normal((60, 64, 3))
    target[-13:] = np.nan
    n = fitting.fit(target, place, model="blinn-phong")["n"]
    assert n.value is not None, n.reason
    assert abs(n.value - 800) < 4 * n.error


def test_mask_weight_and_several_pictures(tmp_path: Path):
    path = tmp_path / "target.exr"
    brdf.write_image(path, picture())
    values = brdf.read_image(path)
    mask = np.add.outer(np.arange(SIZE[1]), np.arange(SIZE[0])) % 7 > 0
    weight = np.random.default_rng(0).uniform(0.5, 2.0, mask.shape)
    other = np.asarray(brdf.render(MATERIAL, scene()))
    options = {"mask": mask, "weight": weight}
    whole = fitting.fit([values, other], scene(), **options)
    with brdf.ImageReader(path) as reader:
        same(fitting.fit([reader, other], scene(), **options), whole)


def test_what_is_fully_transparent_does_not_count(tmp_path: Path):
    path, values = tmp_path / "target.exr", picture()
    opaque = np.add.outer(np.arange(SIZE[1]), np.arange(SIZE[0])) % 7 > 0
    values[~opaque] = 5.0  # what a tool writes where it cut something out
    spec = oiio.ImageSpec(*SIZE, 4, "float")
    buffer = oiio.ImageBuf(spec)
    buffer.set_pixels(oiio.ROI(), np.dstack([values, opaque.astype(np.float32)]))
    assert buffer.write(str(path))
    whole = fitting.fit(np.where(opaque[..., None], values, 0), scene(), mask=opaque, model="blinn-phong")
    with brdf.ImageReader(path) as reader:
        for given in (path, brdf.read_picture(path), reader):
            same(fitting.fit(given, scene(), model="blinn-phong"), whole)


@pytest.mark.parametrize("suffix", [".png", ".tif", ".exr"])
def test_clipping_is_found_across_bands(tmp_path: Path, suffix: str):
    path = tmp_path / f"target{suffix}"
    brdf.write_image(path, np.minimum(picture() * 2.0, 1.0))
    # Below it there is nothing; in memory, too, clipped pixels are left out beside a dark level.
    whole = fitting.fit(brdf.read_picture(path), scene(), dark=1e-6)
    assert whole.left_out["clipped"] > 20
    with brdf.ImageReader(path) as reader:
        same(fitting.fit(reader, scene(), dark=1e-6), whole, 2e-3)


def test_surface_points_in_place_of_a_camera(tmp_path: Path):
    path = tmp_path / "target.exr"
    brdf.write_image(path, picture())
    points = scene(shapes=[brdf.Sphere(center=[0.0, 0.0, 0.0], radius=1.0)]).surface_points()
    mapped = scene(camera=None, shapes=[], points=points)
    whole = fitting.fit(brdf.read_image(path), mapped)
    with brdf.ImageReader(path) as reader:
        same(fitting.fit(reader, mapped), whole)


def test_large_file_is_shown_by_some_of_its_pixels(tmp_path: Path, monkeypatch):
    monkeypatch.setattr(pixels, "SHOWN_PIXELS", 20)
    path = tmp_path / "target.exr"
    brdf.write_image(path, picture(0.0))
    with brdf.ImageReader(path) as reader:
        result = fitting.fit(reader, scene())
    assert result.targets[0].shape == (15, 16, 3)
    np.testing.assert_allclose(result.targets[0], picture(0.0)[::4, ::4])
    assert result.counted[0].shape == (15, 16)
    fitted = result.fitted(0)
    np.testing.assert_allclose(fitted[result.counted[0]], result.targets[0][result.counted[0]], atol=1e-4)
    result.save(tmp_path / "out")
    assert brdf.read_image(tmp_path / "out" / "fitted.exr").shape == (15, 16, 3)


@pytest.mark.parametrize(
    ("options", "name"),
    [({"noise": (0.01, 0.0)}, "noise"), ({"accuracy": 0.01}, "target"), ({"seconds": 1.0}, "target")],
)
def test_what_needs_the_whole_picture_says_so(tmp_path: Path, options: dict, name: str):
    path = tmp_path / "target.exr"
    brdf.write_image(path, picture())
    with brdf.ImageReader(path) as reader, pytest.raises(brdf.InputError, match=f"^{name}: .*bands"):
        fitting.fit(reader, scene(), **options)


def test_pixels_as_areas_are_refused(tmp_path: Path):
    path = tmp_path / "target.exr"
    brdf.write_image(path, picture())
    camera = brdf.OrthographicCamera(
        position=[0.0, 0.0, 4.0], target=[0.0, 0.0, 0.0], up=[0.0, 1.0, 0.0], width=2.4, resolution=SIZE, samples=2
    )
    with brdf.ImageReader(path) as reader, pytest.raises(brdf.InputError, match="centre"):
        fitting.fit(reader, scene(camera=camera))


def test_a_stream_keeps_one_element():
    made = []

    def make(i: int) -> list[int]:
        made.append(i)
        return [i]

    stream = Stream(make, 3)
    assert [element[0] for element in stream] == [0, 1, 2]
    assert stream[2] is stream[2]
    assert made == [0, 1, 2]
    with pytest.raises(IndexError):
        stream[3]
    doubled = each(lambda element, factor: element[0] * factor, stream, [1, 10, 100])
    assert isinstance(doubled, Stream)
    assert list(doubled) == [0, 10, 200]
    assert list(joined([doubled, [7]])) == [0, 10, 200, 7]
    assert joined([[1], [2, 3]]) == [1, 2, 3]


def test_points_that_carry_pixel_areas_are_looked_at_whole():
    material = brdf.BlinnPhong(k_d=[0.3, 0.3, 0.3], k_s=[0.3, 0.3, 0.3], n=20000.0)
    camera = brdf.OrthographicCamera(
        position=[0.0, 0.0, 4.0], target=[0.0, 0.0, 0.0], up=[0.0, 1.0, 0.0], width=2.4, resolution=SIZE, samples=3
    )
    place = scene(camera=camera)
    mapped = scene(camera=None, shapes=[], points=place.surface_points())
    values = np.asarray(brdf.render(material, mapped))
    found = fitting.fit(values, mapped, model="blinn-phong").material
    assert isinstance(found, brdf.BlinnPhong)
    np.testing.assert_allclose(found.n, 20000.0, rtol=1e-3)


def test_the_joint_road_takes_large_pictures():
    start = brdf.BlinnPhong(k_a=MATERIAL.k_a, k_d=MATERIAL.k_d, k_s=MATERIAL.k_s, n=55.0)
    found = fitting.fit_jointly(picture(0.0), scene(), start, free=lambda material, scenes: [material.n])
    np.testing.assert_allclose(found.material.n, MATERIAL.n, rtol=1e-4)
