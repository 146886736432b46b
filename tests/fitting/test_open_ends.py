"""Noise that is cut off at black or white: such a value says that it was no larger, or no smaller, and no more."""

import numpy as np
import OpenImageIO as oiio
import pytest
from ball_pictures import photograph_scene
from small_ball import ball_scene, pictured

import brdf
import fitting
from brdf.errors import InputError
from brdf.images.encoding import encode
from fitting.photographs.ball import Circle, ball_points

SIZE = 96
POINTS = ball_points((SIZE, SIZE), Circle(47.5, 47.5, 44.0))
SCENE = photograph_scene(brdf.Scene(points=POINTS), (0.5, 0.4, 0.7), ambient=[1.0])
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


def deviations(result: fitting.FitResult, material: brdf.BlinnPhong) -> np.ndarray:
    """Of k_a and k_d from the truth, in their standard errors."""
    errors = {one.name: (one.value, one.error) for one in result.parameters}
    return np.array(
        [(errors[name][0] - float(getattr(material, name)[0])) / errors[name][1] for name in ("k_a", "k_d")]
    )


@pytest.mark.parametrize("bits", [8, None])
@pytest.mark.parametrize(("material", "low"), [(DULL, 0.0), (BRIGHT, -1.0)])
def test_noise_that_is_cut_off_does_not_bend_the_fit(material, low, bits):
    found = {}
    for options in ({"rounding": 0}, {}):
        pictures = [seen(material, 0.03, seed, low=low, bits=bits) for seed in range(DRAWS)]
        results = [fitting.fit(picture, SCENE, model="blinn-phong", **options) for picture in pictures]
        found[len(options)] = np.mean([deviations(result, material) for result in results], axis=0)
    # The mean of six is known to 0.4 of a standard error; least squares is bent.
    assert np.max(np.abs(found[1])) > 1.8
    assert np.all(np.abs(found[0]) < 1.2)


@pytest.mark.parametrize("noise", [0.0, 0.03])
def test_where_no_value_is_at_an_end_least_squares_is_the_answer(noise):
    material = brdf.BlinnPhong(k_a=[0.1], k_d=[0.5], k_s=[0.3], n=30.0)
    picture = seen(material, noise, 0, low=-1.0, bits=None).pixels
    result, plain = (fitting.fit(picture, SCENE, model="blinn-phong", rounding=step) for step in (None, 0))
    assert [one.value for one in result.parameters] == [one.value for one in plain.parameters]


def test_a_floor_of_a_float_picture_that_nothing_lies_below_is_no_matter():
    """The dark side of a clean render is 0 because no light reaches it."""
    scene = brdf.Scene(lights=SCENE.lights, points=SCENE.points)
    picture = np.asarray(brdf.render(DULL, scene))
    result = fitting.fit(picture, scene, model="blinn-phong")
    assert float(result.material.k_d[0]) == pytest.approx(0.5, rel=1e-5)
    assert float(result.material.n) == pytest.approx(30.0, rel=1e-4)


@pytest.mark.parametrize(("name", "kind"), [("ball.exr", "half"), ("ball.exr", "float"), ("ball.hdr", "float")])
def test_noise_may_be_cut_off_at_the_0_of_any_file_of_floats(name, kind, tmp_path):
    dark, found = brdf.Scene(lights=SCENE.lights, points=SCENE.points), []
    for seed in range(DRAWS):
        for scene in (SCENE, dark):
            clean = np.asarray(brdf.render(DULL, scene))
            values = np.maximum(clean + np.random.default_rng(seed).normal(0, 0.03, clean.shape), 0)
            brdf.write_image(tmp_path / name, values, dtype=kind)
            result = fitting.fit(tmp_path / name, scene, model="blinn-phong")
            assert not [words for words in result.warnings if "structure" in words or "[ambient]" in words]
            if scene is SCENE:
                found.append(deviations(result, DULL))
    assert np.all(np.abs(np.mean(found, axis=0)) < 1.2)


@pytest.mark.parametrize("bits", [8, None])
@pytest.mark.parametrize(("k_d", "k_s"), [(0.03, 0.0), (0.0, 0.2)])
def test_of_a_dark_surface_whose_noise_is_cut_off_nothing_is_said_to_err_together(k_d, k_s, bits):
    """Half of the values are 0: a residual whose mean is none only where what they may have been takes their place."""
    material = brdf.BlinnPhong(k_a=[0.0], k_d=[k_d], k_s=[k_s], n=30.0)
    scene, deviation = brdf.Scene(lights=SCENE.lights, points=SCENE.points), []
    for seed in range(2 * DRAWS):
        clean = np.asarray(brdf.render(material, scene))
        values = np.maximum(clean + np.random.default_rng(seed).normal(0, 0.01, clean.shape), 0)
        values = np.rint(values * 255).astype(np.uint8) if bits else values.astype(np.float32)
        result = fitting.fit(values, scene)
        assert not [words for words in result.warnings if "structure" in words]
        found = result["k_d"][0]
        deviation.append((found.value - k_d) / found.error)
    # Of a bound at 0 the upper half of the errors is left, whose mean is 0.4.
    assert np.mean(deviation) < (0.4 if k_d == 0 else 0.0) + 3 / len(deviation) ** 0.5


@pytest.mark.parametrize("by", ["mask", "weight"])
def test_what_is_masked_says_nothing(by):
    picture = seen(DULL, 0.03, 0, low=0.0, bits=None).pixels
    wanted = np.asarray(brdf.render(DULL, SCENE))[..., 0] < 0.5
    result = fitting.fit(picture, SCENE, model="blinn-phong", **{by: wanted.astype(float)})
    assert np.all(np.abs(deviations(result, DULL)) < 4)


def test_weights_are_inverse_variances_beside_open_ends_too():
    clean = np.asarray(brdf.render(DULL, SCENE))
    random, draws = np.random.default_rng(0), []
    noise = np.where(np.arange(SIZE) % 2, 0.1, 0.01)[None, :, None]
    for _ in range(DRAWS):
        picture = np.maximum(clean + noise * random.standard_normal(clean.shape), 0).astype(np.float32)
        weight = np.broadcast_to(noise[..., 0] ** -2, clean.shape[:2])
        draws.append(deviations(fitting.fit(picture, SCENE, model="blinn-phong", weight=weight), DULL))
    assert np.all(np.abs(np.mean(draws, axis=0)) < 1.2)


def test_a_channel_that_is_all_noise_does_not_take_the_others_along():
    clean = np.asarray(brdf.render(DULL, SCENE)) * np.array([1.0, 0.02])
    values = np.maximum(clean + np.random.default_rng(0).normal(0, 0.03, clean.shape), 0).astype(np.float32)
    result = fitting.fit(values, SCENE, model="blinn-phong")
    found = {(one.name, one.channel): one for one in result.parameters}
    for channel, true in enumerate((0.5, 0.01)):
        kept = found[("k_d", channel)]
        assert abs(kept.value - true) < 4 * kept.error


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
    material = fitting.fit(picture, SCENE, model="blinn-phong").material
    assert isinstance(material, brdf.BlinnPhong)
    assert material.k_d == pytest.approx([0.7] * channels, rel=0.02)
    assert material.k_s == pytest.approx([0.6] * channels, rel=0.05)
    assert float(material.n) == pytest.approx(30, rel=0.05)


def test_of_photons_that_are_counted_none_is_a_value():
    material, scene, inside = brdf.BlinnPhong(k_a=[0.1, 0.3, 0.3], k_d=[0.3, 0.5, 0.5], k_s=0.3, n=20), ball_scene(), []
    clean = np.maximum(pictured(material, scene), 0.0)
    for seed in range(6):
        counts = np.random.default_rng(seed).poisson(50 * clean) / 50
        result = fitting.fit(counts, scene, model="blinn-phong", noise=(0, 1 / 50))
        inside.append(abs(float(result["k_a"][0]) - 0.1) < 1.96 * result["k_a"][0].error)
    # Taken for noise that was cut off, zeros made it two thirds of that.
    assert sum(inside) >= 5


@pytest.mark.filterwarnings("error::RuntimeWarning")
@pytest.mark.parametrize("kind", ["sRGB of 8 bits", "floats"])
@pytest.mark.parametrize("green", [2.0, 3.0])
def test_where_one_channel_is_clipped_the_others_tell_the_highlight(green: float, kind: str):
    """Green is clipped at and around all of it; red and blue are nowhere."""
    material = brdf.BlinnPhong(k_a=[0.1, 0.1 * green, 0.1], k_d=[0.5, 0.5 * green, 0.4], k_s=[0.35] * 3, n=60.0)
    sun, random = brdf.DirectionalLight([0.3, -0.4, 1.0], 1.0), np.random.default_rng(4)
    scene = ball_scene(sun, ambient=[0.5] * 3)
    clean = pictured(material, scene)
    if kind == "floats":
        picture = np.minimum(clean + random.normal(0, 0.005, clean.shape), 1.0)
        result = fitting.fit(picture, scene)
    else:
        codes = 255 * encode(np.minimum(clean, 4.0), "srgb") + random.normal(0, 0.7, clean.shape)
        picture = np.rint(np.clip(codes, 0, 255)).astype(np.uint8)
        result = fitting.fit(picture, scene, encoding="srgb")
    clipped = picture >= picture.max()
    assert np.count_nonzero(clipped[..., 1]) > 100 > np.count_nonzero(clipped[..., [0, 2]])
    assert result.surface == "blinn-phong"
    assert not result.warnings
    assert result.left_out["clipped"] == np.count_nonzero(clipped.any(axis=-1))
    assert not np.any(clipped[result.counted[0]])
    for parameter in result.parameters:
        true = np.ravel(getattr(material, parameter.name))[parameter.channel or 0]
        assert abs(float(parameter) - true) < 4 * np.array(parameter.error), parameter


def test_of_clipped_values_nothing_is_said_to_err_together():
    """The errors of those that are surely clipped are next to nothing, and have one sign."""
    material, random = brdf.BlinnPhong(k_a=[0.1], k_d=[1.1], k_s=[0.4], n=20.0), np.random.default_rng(0)
    clean, warnings = np.asarray(brdf.render(material, SCENE)), []
    for _ in range(DRAWS):
        picture = np.rint(np.clip(255 * clean + random.normal(0, 2.0, clean.shape), 0, 255)).astype(np.uint8)
        assert np.mean(picture[POINTS.mask] == 255) > 0.2
        warnings += fitting.fit(picture, SCENE, model="blinn-phong").warnings
    assert not any("structure" in words for words in warnings)


def test_a_channel_that_is_clipped_everywhere_is_told_by_another_picture_or_refused():
    material = brdf.BlinnPhong(k_a=[0.1, 2.2, 0.1], k_d=[0.5, 1.0, 0.4], k_s=[0.35] * 3, n=60.0)
    scenes = [ball_scene(brdf.DirectionalLight([0.3, -0.4, 1.0], e), ambient=[0.5 * e] * 3) for e in (1.0, 0.3)]
    long, short = (np.rint(255 * np.minimum(pictured(material, one), 1.0)).astype(np.uint8) for one in scenes)
    with pytest.raises(InputError, match="is clipped in channel green wherever it sees the object"):
        fitting.fit(long, scenes[0], model="blinn-phong")
    # Where only the unlit side is not clipped, ambient light alone is told.
    material = brdf.BlinnPhong(k_a=[0.1, 1.9, 0.1], k_d=[0.5, 10.0, 0.4], k_s=[0.35] * 3, n=60.0)
    noisy = np.minimum(pictured(material, scenes[0], 0.005), 1.0)
    result = fitting.fit(noisy, scenes[0], model="blinn-phong")
    assert abs(float(result["k_a"][1]) - 1.9) < 4 * np.array(result["k_a"][1].error)
    assert result["k_d"][1].reason == "the values that would tell it are clipped"
    assert result["k_s"][1].reason
    material = brdf.BlinnPhong(k_a=[0.1, 2.2, 0.1], k_d=[0.5, 1.0, 0.4], k_s=[0.35] * 3, n=60.0)
    result = fitting.fit([long, short], scenes, model="blinn-phong")
    for parameter in result.parameters:
        true = np.ravel(getattr(material, parameter.name))[parameter.channel or 0]
        assert abs(float(parameter) - true) < 4 * np.array(parameter.error), parameter


@pytest.mark.parametrize("bits", [8, None])
def test_even_noise_that_is_stated_takes_nothing_from_what_is_clipped(bits):
    picture = seen(brdf.BlinnPhong(k_a=[0.1], k_d=[0.6], k_s=[0.8], n=40.0), 0.03, 0, low=-1.0, bits=bits)
    even = np.ones((SIZE, SIZE))
    plain, *others = (
        fitting.fit(picture, SCENE, model="blinn-phong", **options)
        for options in ({}, {"noise": (0.03, 0)}, {"weight": even}, {"weight": 3 * even})
    )
    for other in others:
        for mine, its in zip(other.parameters, plain.parameters, strict=True):
            assert mine.value == pytest.approx(its.value, rel=2e-5)
            assert mine.error == pytest.approx(its.error, rel=1e-3)


@pytest.mark.parametrize(("k_d", "read", "shot"), [([0.6], 5e-4, 1e-5), ([0.8, 0.02, 0.02], 5e-4, 1e-3)])
def test_noise_that_is_stated_is_that_before_rounding_in_each_channel(k_d, read, shot):
    """With that of rounding, and the mean of the channels, errors were 4 times what was said, of k_d in green 3."""
    truth = brdf.BlinnPhong(k_a=[0.04] * len(k_d), k_d=k_d, k_s=[0.3] * len(k_d), n=30.0)
    clean = np.asarray(brdf.render(truth, SCENE), float)
    off = []
    for seed in range(12):
        noise = np.sqrt(read**2 + shot * clean) * np.random.default_rng(seed).normal(size=clean.shape)
        codes = np.clip(np.rint(255 * (clean + noise)), 0, 255).astype(np.uint8)
        result = fitting.fit(codes, SCENE, model="blinn-phong", noise=(read, shot))
        off.append(
            [
                (one.value - np.ravel(getattr(truth, one.name))[one.channel or 0]) / one.error
                for one in result.parameters
            ]
        )
    assert np.all(np.sqrt(np.mean(np.square(off), axis=0)) < 2.0)
    assert np.sqrt(np.mean(np.square(off))) < 1.3


def test_least_squares_of_what_is_nearly_all_clipped_end():
    """Of a wrong curve, too, the noise of so few pixels being none; the search for an interval went on for ever."""
    scene = ball_scene()
    drawn = np.asarray(brdf.render(brdf.BlinnPhong(k_a=0.2, k_d=[0.6, 0.3, 0.2], k_s=0.3, n=30), scene))
    codes = np.rint(255 * np.minimum(15 * drawn, 1)).astype(np.uint8)
    result = fitting.fit(codes, scene, model="blinn-phong", encoding="srgb", rounding=0)
    assert np.all(np.isfinite(result.material.k_d))
