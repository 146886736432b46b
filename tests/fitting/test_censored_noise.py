"""Noise that is cut off at black or white bends a fit, unless pixels are left out by what is predicted there."""

import numpy as np
import OpenImageIO as oiio  # noqa: N813
import pytest

import brdf
import fitting
from brdf.images.encoding import encode
from fitting.censored_noise import BLACK, WHITE, without_censored_noise
from fitting.cli.main import main
from fitting.photographs.ball import Circle, ball_points
from fitting.photographs.distant_light import photograph_scene
from fitting.problem import state_problem
from fitting.speed_accuracy import Bench, parameter_deviation

SIZE = 96
POINTS = ball_points((SIZE, SIZE), Circle(47.5, 47.5, 44.0))
SCENE = photograph_scene(POINTS, (0.5, 0.4, 0.7), ambient=[1.0])
DULL = brdf.BlinnPhong(k_a=[0.02], k_d=[0.5], k_s=[0.3], n=30.0)
BRIGHT = brdf.BlinnPhong(k_a=[0.1], k_d=[1.0], k_s=[0.2], n=30.0)
DRAWS = 6


def seen(material: brdf.Material, noise: float, seed: int, *, low: float, bits: int | None) -> brdf.Picture:
    """A picture whose noise is cut off below ``low`` and above 1."""
    clean = np.asarray(brdf.render(material, SCENE))
    values = np.clip(clean + np.random.default_rng(seed).normal(0, noise, clean.shape), low, 1.0)
    if bits:
        values = np.rint(values * (2**bits - 1)) / (2**bits - 1)
    return brdf.Picture(values.astype(np.float32), None, "linear", "given", bits or 32, 1.0)


def fitted(picture: brdf.Picture, mended: bool) -> fitting.FitResult:
    with pytest.MonkeyPatch.context() as patch:
        if not mended:
            patch.setattr("fitting.core.without_censored_noise", lambda result, *_: result)
        return fitting.fit(picture, SCENE, model="blinn-phong")


def deviations(result: fitting.FitResult, material: brdf.BlinnPhong) -> np.ndarray:
    """Of k_a and k_d from the truth, in their standard errors."""
    errors = {one.name: (one.value, one.error) for one in result.parameters}
    return np.array(
        [(errors[name][0] - float(getattr(material, name)[0])) / errors[name][1] for name in ("k_a", "k_d")]
    )


@pytest.mark.parametrize("bits", [8, None])
@pytest.mark.parametrize(("material", "low", "reason"), [(DULL, 0.0, BLACK), (BRIGHT, -1.0, WHITE)])
def test_censored_noise_does_not_bend_the_fit(material, low, reason, bits):
    found = {}
    for mended in (False, True):
        results = [fitted(seen(material, 0.03, seed, low=low, bits=bits), mended) for seed in range(DRAWS)]
        found[mended] = np.mean([deviations(result, material) for result in results], axis=0)
        assert all((reason in result.left_out) == mended for result in results)
        assert all((WHITE if reason == BLACK else BLACK) not in result.left_out for result in results)
    # The mean of six is known to 0.4 of a standard error.
    assert np.all(np.abs(found[False]) > 1.8)
    assert np.all(np.abs(found[True]) < 1.4)


@pytest.mark.parametrize("noise", [0.0, 0.03])
def test_what_is_not_cut_is_left_alone(noise):
    # Noise that keeps its lower half; and codes without noise, of which many are 0.
    material = brdf.BlinnPhong(k_a=[0.0], k_d=[0.5], k_s=[0.3], n=30.0)
    picture = seen(material, noise, 0, low=-1.0 if noise else 0.0, bits=None if noise else 8)

    def refused(masks: list) -> fitting.FitResult:
        raise AssertionError("fitted again")

    result = fitting.fit(picture, SCENE, model="blinn-phong")
    assert without_censored_noise(result, [None], refused) is result


@pytest.mark.parametrize("bits", [8, 16])
def test_noise_of_a_flat_dark_side_is_not_cut(bits):
    """Many pixels share the lowest code of a side that ambient light alone reaches, yet fewer than the next."""
    material = brdf.BlinnPhong(k_a=[0.1], k_d=[0.5], k_s=[0.3], n=30.0)
    result = fitting.fit(seen(material, 0.01, 0, low=0.0, bits=bits), SCENE, model="blinn-phong")
    assert BLACK not in result.left_out
    assert WHITE not in result.left_out


def test_a_dark_side_without_noise_is_kept_beside_a_clipped_highlight():
    """A cast shadow that the scene does not know is a misfit, not noise."""
    material = brdf.BlinnPhong(k_a=[0.02], k_d=[0.6], k_s=[0.8], n=40.0)
    clean = np.minimum(np.asarray(brdf.render(material, SCENE)), 0.8).astype(np.float32)
    clean[50:70, 30:45] = float(np.min(clean[np.asarray(POINTS.mask)]))
    assert np.count_nonzero(clean == clean.max()) > 30
    result = fitting.fit(clean, SCENE, model="blinn-phong", loss="huber")
    assert BLACK not in result.left_out


@pytest.mark.parametrize("by", ["mask", "weight"])
def test_what_is_masked_is_not_clipped(by):
    picture = seen(DULL, 0.03, 0, low=0.0, bits=None).pixels
    wanted = np.asarray(brdf.render(DULL, SCENE))[..., 0] < 0.5
    result = fitting.fit(picture, SCENE, model="blinn-phong", **{by: wanted.astype(float)})
    assert result.left_out[BLACK] > 0
    assert WHITE not in result.left_out


def test_a_channel_that_is_all_noise_is_told_and_does_not_take_the_others_along():
    clean = np.asarray(brdf.render(DULL, SCENE)) * np.array([1.0, 0.02])
    values = np.maximum(clean + np.random.default_rng(0).normal(0, 0.03, clean.shape), 0).astype(np.float32)

    result = fitting.fit(values, SCENE, model="blinn-phong")
    assert "channel 1" in result.warnings[0]
    assert "cut off" in result.warnings[0]
    assert 0 < result.left_out[BLACK] < 0.8 * result.pixels
    kept = {(one.name, one.channel): one for one in result.parameters}[("k_d", 0)]
    assert abs(kept.value - 0.5) < 4 * kept.error


def test_the_command_says_how_many_pixels_it_left_out(tmp_path, capsys, monkeypatch):
    picture = seen(DULL, 0.03, 0, low=0.0, bits=8)
    brdf.write_image(tmp_path / "ball.png", picture.pixels, encoding="linear")
    monkeypatch.chdir(tmp_path)
    words = [
        "fit",
        "ball.png",
        "--sphere",
        "47.5,47.5,44",
        "--light",
        "0.5,0.4,0.7",
        "--ambient",
        "--encoding",
        "linear",
    ]
    with pytest.raises(SystemExit) as exit_status:
        main(words)
    assert exit_status.value.code == 0
    assert BLACK in capsys.readouterr().out


@pytest.mark.parametrize("quality", [75, 85, 95])
@pytest.mark.parametrize("channels", [1, 3])
def test_a_clipped_highlight_in_a_jpeg_file_does_not_bend_the_fit(tmp_path, quality, channels):
    shiny = brdf.BlinnPhong(k_a=[0.05] * channels, k_d=[0.7] * channels, k_s=[0.6] * channels, n=30.0)
    values = np.clip(np.asarray(brdf.render(shiny, SCENE)), 0, 1).astype(np.float32)
    codes = np.rint(encode(values, "srgb") * 255).astype(np.uint8)
    spec = oiio.ImageSpec(SIZE, SIZE, channels, "uint8")
    spec.attribute("Compression", f"jpeg:{quality}")
    file = oiio.ImageOutput.create("ball.jpg")
    assert file.open(str(tmp_path / "ball.jpg"), spec)
    assert file.write_image(codes)
    file.close()
    picture = brdf.read_picture(tmp_path / "ball.jpg")
    brightest = picture.pixels[values.max(axis=-1) == 1].max(axis=-1)
    assert brightest.min() < 1  # the plateau is none any more
    assert np.mean(brightest >= picture.saturation) > 0.97
    material = fitted(picture, mended=True).material
    assert isinstance(material, brdf.BlinnPhong)
    assert material.k_d == pytest.approx([0.7] * channels, rel=0.02)
    assert material.k_s == pytest.approx([0.6] * channels, rel=0.05)
    assert float(material.n) == pytest.approx(30, rel=0.05)


def test_solvers_that_are_compared_leave_out_the_same_pixels():
    bench = Bench(state_problem(seen(DULL, 0.03, 0, low=0.0, bits=8), SCENE, model="blinn-phong"))
    solver = next(trial for trial in bench.trials() if trial.axis == "solver")
    assert parameter_deviation(bench.run(solver), bench.best) < 0.05
    # All of the fitted pixels: what is cut off bends this fit as well.
    bench.best.counted[0][:] = True
    assert parameter_deviation(bench.run(solver), bench.best) > 0.08


@pytest.mark.parametrize(("low", "share"), [(0.0, True), (-1.0, False)])
def test_a_file_read_by_bands_is_warned_of(tmp_path, low, share):
    path = tmp_path / "target.exr"
    brdf.write_image(path, seen(DULL, 0.03, 0, low=low, bits=None).pixels)
    with brdf.ImageReader(path) as reader:
        result = fitting.fit(reader, SCENE, model="blinn-phong")
    assert any("noise is cut off at black" in warning for warning in result.warnings) == share


def test_a_file_whose_noise_is_cut_off_almost_everywhere_is_warned_of(tmp_path):
    path = tmp_path / "target.exr"
    dark = brdf.Lambert(k_a=[0.005], k_d=[0.05])
    brdf.write_image(path, seen(dark, 0.05, 0, low=0.0, bits=None).pixels * (POINTS.mask[..., None] > 0))
    with brdf.ImageReader(path) as reader:
        result = fitting.fit(reader, SCENE, model="lambert")
    assert any("almost everywhere" in warning for warning in result.warnings)
