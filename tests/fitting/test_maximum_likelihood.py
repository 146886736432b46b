"""Numbers behind rounded values: balls of another renderer, saved as files are, against what they were drawn with."""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from small_ball import ball_scene, pictured

import brdf
import fitting
from benchmarks.truth import COVERAGE, LAMBERT, ball, meshed
from brdf.images.encoding import Encoding, decode, encode
from fitting.codes import find_codes

# In standard errors: five of some two hundred numbers would be chance once in ten thousand runs.
FAR = 5.0


def deviations(row: str, seed: int, folder: Path) -> dict[str, tuple[float, float]]:
    """Of each number from the truth, and in standard errors; infinite where it is not determined."""
    file = COVERAGE[row]
    one = ball(seed, channels=file.channels)
    result = fitting.fit(file.picture(one.drawn(), seed, folder), one.scene(), model=one.model)
    found = {}
    for parameter in result.parameters:
        term = {"k_a": 0, "k_d": 1, "k_s": 2, "n": 3}[parameter.name]
        true = one.n if term == 3 else float(one.k[term, min(parameter.channel or 0, one.k.shape[1] - 1)])
        off = np.inf if parameter.value is None else parameter.value - true
        found[parameter.key] = off, off / (parameter.error or 1.0)
    return found


@pytest.mark.parametrize(
    "row", ["linear 8 bit", "sRGB 8 bit", "grey as RGB", "12 in 16 bit", "half", "RGBE", "JPEG q90"]
)
def test_files_without_noise_are_read_within_their_errors(row: str, tmp_path: Path):
    for seed in (1, 2, 4):
        found = deviations(row, seed, tmp_path)
        assert max(abs(far) for _, far in found.values()) < FAR, (seed, found)
        if not row.startswith("JPEG"):
            assert abs(found["k_d[0]"][0]) < 3e-5, (seed, found)


@pytest.mark.parametrize("row", ["sRGB 8 bit", "half", "sRGB 8 bit, camera"])
def test_the_residual_told_is_that_of_the_picture(row: str, tmp_path: Path):
    """Behind codes it was that of the values near an edge, with noise that grows a weighted one: a fifth of it."""
    file = COVERAGE[row]
    one = ball(3, channels=file.channels)
    result = fitting.fit(file.picture(one.drawn(), 3, tmp_path), one.scene(), model=one.model)
    (target,), (counted,) = result.targets, result.counted
    left = (target - np.asarray(brdf.render(result.material, one.scene())))[counted]
    assert result.residual == pytest.approx(np.linalg.norm(left) / np.linalg.norm(target[counted]), rel=5e-3)


@pytest.mark.parametrize(
    ("pictures", "size", "seed"),
    [(2, 96, 5050), (5, 64, 6062)],
    ids=["a highlight was lost", "a picture of which all values are sure"],
)
def test_several_files_without_noise_are_read_as_one_is(pictures: int, size: int, seed: int):
    """A part of them ended at more noise in codes than in light, where it was taken to be: few pixels were left."""
    files, scenes, material, white = several(pictures, size, seed, "srgb")
    found = fitting.fit(files, scenes, model=type(material), encoding="srgb")
    for name in ("k_a", "k_d", "k_s"):
        assert found[name][0].value == pytest.approx(float(getattr(material, name)[0]) / white, rel=3e-3), name
    assert found["n"].value == pytest.approx(float(material.n), rel=3e-3)


@pytest.mark.parametrize("seed", [8000, 8001])
def test_one_wrong_light_of_several_is_told_from_files_without_noise(seed: int):
    """The picture under it was taken to be noisy, and was lost beside what the others say."""
    files, scenes, material, _ = several(3, 48, seed, "linear")
    assert not fitting.fit(files, scenes, model=type(material)).warnings
    (light,) = scenes[1].lights
    assert isinstance(light, brdf.DirectionalLight)
    turned = dataclasses.replace(light, direction=np.asarray(light.direction) + 0.05 * np.eye(3)[0])
    scenes[1] = dataclasses.replace(scenes[1], lights=(turned,))
    result = fitting.fit(files, scenes, model=type(material))
    assert any("structure" in text for text in result.warnings)
    assert result.diagnosis[0].name.startswith("light")


@pytest.mark.parametrize("seed", range(5001, 5015, 2))
def test_rounding_is_no_structure_of_a_joint_fit(seed: int):
    files, scenes, material, _ = several(3, 48, seed, "linear")
    assert not fitting.fit_jointly(files, scenes, type(material)).warnings


def several(
    pictures: int, size: int, seed: int, encoding: Encoding
) -> tuple[list[np.ndarray], list[brdf.Scene], brdf.Phong | brdf.BlinnPhong, float]:
    """Files of a ball without noise, each under a light of its own, its material, and what is white in them."""
    random = np.random.default_rng(seed)
    model = [brdf.Phong, brdf.BlinnPhong][seed % 2]
    k_a, k_d, k_s = (random.uniform(low, high) for low, high in ((0.1, 0.6), (0.1, 0.5), (0.1, 0.5)))
    n, ambient = np.exp(random.uniform(np.log(4), np.log(150))), random.uniform(0.1, 0.3)
    camera = brdf.OrthographicCamera(
        position=[0, 0, 4], target=[0, 0, 0], up=[0, 1, 0], width=2.2, resolution=[size, size]
    )
    towards = [[*random.uniform(-0.8, 0.8, 2), 1.0] for _ in range(pictures)]
    scenes = [
        brdf.Scene(camera, [brdf.Sphere([0, 0, 0], 1)], ambient=[ambient], lights=[light])
        for light in (brdf.DirectionalLight(one, intensity=[random.uniform(0.5, 1.2)]) for one in towards)
    ]
    material = model(k_a=k_a, k_d=k_d, k_s=k_s, n=n)
    drawn = [np.asarray(brdf.render(material, scene, precision="float64")) for scene in scenes]
    white = float(np.max(drawn)) / 0.95
    return [np.rint(255 * encode(one / white, encoding)).astype(np.uint8) for one in drawn], scenes, material, white


def test_whole_numbers_in_floats_are_codes_that_were_rounded():
    """They lie on the levels of RGBE too, which truncates: half a code of bias."""
    one = ball(1, size=48)
    result = fitting.fit(np.rint(200 * one.drawn()), one.scene(), model=one.model)
    for found, true in zip(result["k_d"], one.k[1], strict=True):
        assert abs(found.value - 200 * true) < 5 * found.error < 0.1


@pytest.mark.parametrize(
    ("values", "levels"),
    [
        (lambda drawn: decode(np.rint(255 * encode(drawn, "srgb")) / 255, "srgb"), "8-bit sRGB files"),
        (lambda drawn: np.rint(4095 * drawn) * 16 / 65535, "12-bit linear files"),
        (lambda drawn: np.rint(np.rint(1023 * drawn) * 65535 / 1023) / 65535, "10-bit linear files"),
        (lambda drawn: drawn.astype(np.float16).astype(np.float32), "half floats"),
        (lambda drawn: np.rint(200 * drawn), "whole numbers"),
        (lambda drawn: (4e4 * drawn).astype(np.float16).astype(np.float32), "half floats"),
        (lambda drawn: drawn, ""),
    ],
)
def test_floats_on_the_levels_of_files_are_said_to_be_codes(values: Callable[[np.ndarray], np.ndarray], levels: str):
    one = ball(1, size=48)
    result = fitting.fit(values(one.drawn()), one.scene(), model=one.model)
    assert result.levels == levels
    assert (f"read as     codes: all values lie on the levels of {levels}" in str(result)) == bool(levels)
    # Neither does what is no number say anything, nor is there a warning of it.
    broken = values(one.drawn())
    broken[20:24], broken[24] = np.nan, np.inf
    assert fitting.fit(broken, one.scene(), model=one.model).levels == levels


@pytest.mark.parametrize("spread", [lambda code: code << 6, lambda code: np.rint(code * 65535 / 1023)])
@pytest.mark.parametrize("rounding", [None, 0])
def test_10_bits_in_16_are_clipped_at_their_own_largest_code(spread: Callable[[Any], Any], rounding: int | None):
    one = ball(1, size=64)
    stored = spread(np.minimum(np.rint(1.3 * 1023 * one.drawn()), 1023).astype(int)).astype(np.uint16)
    result = fitting.fit(stored, one.scene(), model=one.model, rounding=rounding)
    assert result.left_out["clipped"] == np.count_nonzero(stored == stored.max()) > 10
    true = 1.3 * float(stored.max()) / 65535 * one.k[1, 0]
    assert abs(result["k_d"][0].value - true) < (1e-4 if rounding is None else 2e-3)


@pytest.mark.parametrize("row", ["sRGB 8 bit, light noise 0.0005", "sRGB 8 bit, light noise 0.01"])
def test_noise_that_comes_before_the_encoding_is_larger_in_dark_codes(row: str, tmp_path: Path):
    for seed in (1, 2, 4, 6):
        found = deviations(row, seed, tmp_path)
        assert max(abs(far) for _, far in found.values()) < FAR, (seed, found)
    one = ball(3, ambient=False)
    result = fitting.fit(COVERAGE[row].picture(one.drawn(), 3, tmp_path), one.scene(), model=one.model)
    assert not any("structure" in words for words in result.warnings)


def test_a_dark_picture_beside_a_bright_one_takes_nothing_from_what_that_says():
    """Noise of one size in light is the same in both: the dark one tells next to nothing."""
    size, random, errors = 64, np.random.default_rng(0), []
    for seed in range(3):
        one = ball(seed, size=size)
        bright, drawn = one.scene(), one.drawn()
        lamp = dataclasses.replace(bright.lights[0], intensity=[0.03])
        dark, pictures = dataclasses.replace(bright, ambient=[0.03], lights=(lamp,)), []
        for share in (1.0, 0.03):
            noisy = drawn * share + random.normal(0, 0.004, drawn.shape) * (drawn > 0)
            pictures.append(np.rint(255 * encode(np.clip(noisy, 0, 1), "srgb")).astype(np.uint8))
        both = fitting.fit(pictures, [bright, dark], model=one.model, encoding="srgb").material
        alone = fitting.fit(pictures[0], bright, model=one.model, encoding="srgb").material
        errors.append([np.abs(found.k_d - one.k[1])[0] for found in (both, alone)])
    both, alone = np.sqrt(np.mean(np.square(errors), axis=0))
    assert both < 1.2 * alone


def test_codes_beside_floats_whose_noise_was_cut_off_at_black():
    one = ball(0, ambient=False)
    drawn, random = one.drawn(), np.random.default_rng(0)
    codes = brdf.Picture(
        np.float32(decode(np.rint(255 * encode(drawn, "srgb")) / 255, "srgb")), None, "srgb", "given", 8, 1.0
    )
    floats = np.maximum(drawn + random.normal(0, 0.02, drawn.shape), 0)
    found = fitting.fit([codes, floats], [one.scene(), one.scene()], model=one.model).material
    np.testing.assert_allclose(found.k_d, one.k[1], rtol=1e-3)


@pytest.mark.parametrize("curve", ["linear", "srgb"])
def test_a_plane_that_shows_one_code_is_known_to_a_rounding_error(curve: Encoding):
    """Thousands of its values are one: they lie anywhere within that code."""
    camera = brdf.OrthographicCamera(position=[0, 0, 4], target=[0, 0, 0], up=[0, 1, 0], width=2, resolution=(48, 48))
    plane, hiding = brdf.Rectangle([0, 0, 0], [0.9, 0, 0], [0, 0.9, 0]), brdf.Sphere([0.3, 0, 0.6], 0.3, fitted=False)
    scene = brdf.Scene(camera, [plane, hiding], ambient=[0.2], lights=[brdf.DirectionalLight([0.3, 0.4, 0.8], 0.9)])
    for k_d in (0.523, 0.411, 0.357):
        picture = encode(np.asarray(brdf.render(brdf.Lambert(k_a=0.31, k_d=k_d), scene)), curve)
        result = fitting.fit(np.rint(255 * picture).astype(np.uint8), scene, encoding=curve)
        assert result.surface == "lambert"
        for name, true in (("k_a", 0.31), ("k_d", k_d)):
            assert abs(result[name][0].value - true) < 3 * result[name][0].error < 0.5


def lit_ball() -> brdf.Scene:
    camera = brdf.OrthographicCamera(position=[0, 0, 4], target=[0, 0, 0], up=[0, 1, 0], width=2.2, resolution=(96, 96))
    light = brdf.DirectionalLight([0.4, 0.5, 0.8], [1.0] * 3)
    return brdf.Scene(camera, [brdf.Sphere([0, 0, 0], 1)], ambient=[0.2] * 3, lights=[light])


@pytest.mark.parametrize("kind", ["webp", "tiff", "lossless"])
def test_a_highlight_keeps_its_colour_in_files_whose_codec_is_not_known(kind: str, tmp_path: Path):
    scene, material = lit_ball(), brdf.BlinnPhong(k_a=[0.5, 0.3, 0.2], k_d=[0.4, 0.2, 0.1], k_s=[0.3, 0.2, 0.3], n=40)
    clean, path = np.asarray(brdf.render(material, scene)), tmp_path / f"target.{'tif' if kind == 'tiff' else 'webp'}"
    noisy = np.clip(clean + 0.005 * np.random.default_rng(0).standard_normal(clean.shape), 0, 1)
    codes = np.rint(255 * encode(noisy, "srgb")).astype(np.uint8)
    how: dict[str, dict[str, Any]] = {"tiff": {"compression": "jpeg", "quality": 90}, "lossless": {"lossless": True}}
    Image.fromarray(codes).save(path, **how.get(kind, {"quality": 90}))
    found = fitting.fit(path, scene)
    for name in ("k_a", "k_d", "k_s"):
        for channel, true in enumerate(np.asarray(getattr(material, name))):
            one = found[name][channel]
            assert abs(one.value - true) < 4 * one.error
    if kind == "lossless":
        assert found["k_d"][0].error == fitting.fit(codes, scene, encoding="srgb")["k_d"][0].error


def scene_of_many_edges(seed: int) -> tuple[brdf.Scene, type[Any], dict[str, Any]]:
    """Two balls on a plane, seen near by, under lights of three kinds, the first that shows a highlight."""
    random = np.random.default_rng(seed)
    while True:
        camera = brdf.PerspectiveCamera(
            position=[random.uniform(-2, 2), random.uniform(0.8, 2.5), random.uniform(2.5, 4)],
            target=random.uniform(-0.2, 0.2, 3),
            up=[random.uniform(-0.2, 0.2), 1, 0],
            fov=random.uniform(35, 60),
            resolution=(64, 56),
        )
        shapes = [
            brdf.Sphere([-0.4, 0, 0], 0.7),
            brdf.Sphere([0.8, -0.35, 0.4], 0.45),
            brdf.Rectangle([0, -0.8, 0], [0, 0, 2.2], [2.2, 0, 0]),
        ]
        towards, shining = np.add(random.normal(size=3), [0, 1, 0.5]), random.uniform(0.1, 0.5, 3)
        near = {"position": random.uniform([-2, 1, 0], [2, 3, 3]), "intensity": random.uniform(1, 3, 3)}
        spot = {"position": random.uniform([-2, 1, 0], [2, 3, 3]), "intensity": random.uniform(2, 5, 3)}
        spot |= {"cutoff_angle": float(random.choice([15, 25, 40])), "exponent": float(random.choice([0, 2, 9]))}
        at = random.uniform(-0.4, 0.4, 3)
        lights = [
            brdf.DirectionalLight(towards, intensity=shining),
            brdf.PointLight(**near, attenuation=(0.2, 0.1, 0.7)),
            brdf.SpotLight(**spot, direction=at - spot["position"]),
        ]
        model = [brdf.BlinnPhong, brdf.Phong][random.integers(2)]
        ambient, sky = random.random() < 0.5, random.uniform(0.1, 0.3, 3)
        k_a = random.uniform(0.1, 0.5, 3) if ambient else np.zeros(3)
        k = {"k_a": k_a, "k_d": random.uniform(0.1, 0.7, 3), "k_s": random.uniform(0.05, 0.5, 3)}
        n = float(np.exp(random.uniform(1, 5)))
        scene = brdf.Scene(camera, shapes, lights=lights, ambient=sky if ambient else None)
        image = np.asarray(brdf.render(model(**k, n=n), scene, precision="float64"))
        lobe = np.asarray(brdf.basis_images(model, scene, n).specular) * k["k_s"]
        if np.count_nonzero(lobe.max(axis=-1) > 0.05 * image.max()) > 40:
            return scene, model, {"image": 0.95 * image / image.max(), "k_s": 0.95 * k["k_s"] / image.max()}


@pytest.mark.parametrize(("seed", "encoding"), [(7, "linear"), (100, "linear"), (1371, "srgb")])
def test_where_few_values_tell_of_a_number_what_lies_near_it_then_does_not(seed: int, encoding: Encoding):
    """The likelihood is flat between some edges, and was taken to be steep where the estimate lay among others."""
    scene, model, truth = scene_of_many_edges(seed)
    picture = np.rint(255 * encode(truth["image"], encoding)).astype(np.uint8)
    result = fitting.fit(picture, scene, model=model, encoding=encoding)
    for one, true in zip(result["k_s"], truth["k_s"], strict=True):
        assert abs(one.value - true) < 4 * one.error
        assert one.error < 0.01 * true


def test_radiance_files_are_known_as_their_library_reads_them_and_as_others_do():
    """A step lies above what most programs read."""
    one = np.random.default_rng(0).uniform(0, 1, (16, 16, 3)) * np.array([1.0, 0.3, 0.01])
    step = 2.0 ** (np.floor(np.log2(one.max(axis=-1, keepdims=True))) - 7)
    read, all_bounds = np.floor(one / step) * step, []
    for pixels in (read, read + 0.5 * step):
        codes = find_codes(pixels.astype(np.float32), None, None, None)
        assert codes is not None
        assert codes.levels == "RGBE files"
        all_bounds.append(codes.bounds(slice(0, 16), np.ones(256, bool), None, 1.0))
        lower, upper = (end / codes.scale for end in (all_bounds[-1].lower, all_bounds[-1].upper))
        assert np.all((lower <= one.reshape(-1, 3)) & (one.reshape(-1, 3) <= upper))
    for name in ("lower", "upper"):
        np.testing.assert_array_equal(*(getattr(bounds, name) for bounds in all_bounds))


@pytest.mark.parametrize("writer", ["hdr", "floor"])
@pytest.mark.parametrize("noise", [0.002, 0.01])
def test_what_a_writer_truncated_is_half_a_step_darker(writer: str, noise: float, tmp_path: Path):
    """Of noise that is larger than the steps least squares is enough, of the middle of what a code stands for."""
    scene, material = lit_ball(), brdf.BlinnPhong(k_a=0.5, k_d=[0.4, 0.3, 0.2], k_s=0.3, n=40)
    truth, off = {"k_a": [0.5] * 3, "k_d": [0.4, 0.3, 0.2], "k_s": [0.3] * 3, "n": [40.0]}, []
    clean = np.asarray(brdf.render(material, scene))
    for seed in range(4):
        values = np.maximum(clean + noise * np.random.default_rng(seed).standard_normal(clean.shape), 0)
        if writer == "hdr":
            brdf.write_image(tmp_path / "target.hdr", values.astype(np.float32))
            found = fitting.fit(tmp_path / "target.hdr", scene, model="blinn-phong")
        else:
            codes = np.floor(255 * np.clip(values, 0, 1)).astype(np.uint8)
            found = fitting.fit(codes, scene, model="blinn-phong", rounding="floor")
        for one in found.parameters:
            off.append((one.value - truth[one.name][one.channel or 0]) / one.error)
    assert np.sqrt(np.mean(np.square(off))) < 1.5


def test_a_small_highlight_none_of_whose_values_lies_near_an_edge_is_there_all_the_same(tmp_path: Path):
    """At the noise where the picture is likeliest the pixels that tell are all elsewhere."""
    found = deviations("linear 8 bit", 188, tmp_path)
    assert max(abs(far) for _, far in found.values()) < FAR, found


@pytest.mark.parametrize("seed", [1, 8, 11])
def test_normals_of_a_mesh_are_no_highlight(seed: int, tmp_path: Path):
    file = LAMBERT["mesh of 96 rings"]
    for k_s in (0.0, 0.01):
        one = ball(seed, model="" if k_s else "lambert", k_s=k_s or None)
        result = fitting.fit(file.picture(one.drawn(meshed(96)), seed, tmp_path), one.scene())
        assert bool(k_s) == (result.surface != "lambert"), (k_s, result.surface)


@pytest.mark.parametrize("row", ["colour JPEG q90", "colour JPEG q90, noise 1"])
def test_a_faint_highlight_of_a_colour_jpeg_is_found_in_its_brightness(row: str, tmp_path: Path):
    """Its colours err by twice as much as the highlight adds, and by no highlight's shape."""
    file = LAMBERT[row]
    for seed in (2, 3, 8):
        for k_s in (0.0, 0.01):
            one = ball(seed, model="" if k_s else "lambert", channels=3, k_s=k_s or None)
            result = fitting.fit(file.picture(one.drawn(), seed, tmp_path), one.scene())
            assert bool(k_s) == (result.surface != "lambert"), (seed, k_s, result.surface)
            if k_s:
                assert np.allclose(result.material.k_s, 0.01, rtol=0.5), (seed, result.material)


def test_what_rounding_leaves_does_not_make_up_for_the_wrong_highlight(tmp_path: Path):
    """It is judged by least squares, and stands in the table with the others."""
    one = ball(1)
    file = COVERAGE["linear 8 bit"]
    result = fitting.fit(file.picture(one.drawn(), 1, tmp_path), one.scene())
    rivals = [candidate for candidate in result.candidates if candidate.model == "phong" and candidate.ambient]
    assert result.surface == one.model == "blinn-phong"
    assert rivals
    assert all(rival.excess > 1000 for rival in rivals)
    (chosen,) = (candidate for candidate in result.candidates if candidate.chosen)
    assert chosen.rms < chosen.held_out < 1.1 * chosen.rms


def test_highlights_near_edges_and_beyond_are_compared_by_one_likelihood():
    # With noise of half a code the wrong highlight leaves enough for least squares in codes, the right one does not.
    for seed in (6, 11, 12, 21):
        drawn = ball(seed, channels=3, size=48)
        noisy = np.random.default_rng(seed).normal(255 * encode(drawn.drawn(), "srgb"), 0.5)
        codes = np.clip(np.rint(noisy), 0, 255).astype(np.uint8)
        assert fitting.fit(codes, drawn.scene(), encoding="srgb").surface == drawn.model


@pytest.mark.parametrize("kind", [np.uint8, np.uint16, np.float16])
@pytest.mark.parametrize("half_edge", [0.7, 1.2])
def test_a_plane_of_one_code_is_known_to_half_a_code(kind: type, half_edge: float):
    camera = brdf.OrthographicCamera(position=[0, 0, 4], target=[0, 0, 0], up=[0, 1, 0], width=2, resolution=[48, 48])
    shapes = [brdf.Rectangle(center=[0, 0, 0], edge_u=[half_edge, 0, 0], edge_v=[0, half_edge, 0])]
    lights = [brdf.DirectionalLight(direction=[0, 0, 1], intensity=[1.0])]
    scene = brdf.Scene(camera=camera, shapes=shapes, lights=lights)
    drawn = np.asarray(brdf.render(brdf.Lambert(k_d=[0.80503]), scene, precision="float64"))
    top = np.iinfo(kind).max if issubclass(kind, np.integer) else 1
    picture = (np.rint(top * drawn) if top > 1 else drawn).astype(kind)
    found = fitting.fit(picture, scene, model="lambert")["k_d"][0]
    half_step = 0.5 / top if top > 1 else 0.25 * np.finfo(np.float16).eps
    assert found.error is not None
    assert 0.5 * half_step < found.error < half_step
    assert abs(float(found) - 0.80503) < 1.8 * found.error


def test_a_channel_that_no_light_shades_is_known_to_half_a_code():
    codes, scene = lambert_codes([1.0, 0.0, 0.5], k_a=0.25, k_d=0.5)
    k_a = fitting.fit(codes, scene, model="lambert")["k_a"]
    # Half a code is 0.01 of it.
    assert 0.005 < k_a[1].error < 0.01
    assert abs(float(k_a[1]) - 0.25) < 1.8 * k_a[1].error
    assert max(k_a[0].error, k_a[2].error) < 2e-4


@pytest.mark.parametrize("seed", range(3))
def test_a_named_model_finds_no_highlight_that_rounding_makes(seed: int):
    random = np.random.default_rng(seed)
    k_a, k_d = random.uniform(0.1, 0.5, 3), random.uniform(0.05, 0.7, 3)
    found = fitting.fit(*lambert_codes([1.0] * 3, k_a, k_d), model="blinn-phong")
    assert not np.any(found.material.k_s)
    for name, true in (("k_a", k_a), ("k_d", k_d)):
        for one, value in zip(found[name], true, strict=True):
            assert abs(float(one) - value) < 3 * one.error


def lambert_codes(intensity, k_a, k_d) -> tuple[np.ndarray, brdf.Scene]:
    """A ball of a Lambert surface in 8 bits, without noise."""
    scene = ball_scene(brdf.DirectionalLight([0.4, 0.5, 0.8], intensity), ambient=[0.2] * 3)
    return np.rint(255 * pictured(brdf.Lambert(k_a=k_a, k_d=k_d), scene)).astype(np.uint8), scene


@pytest.mark.parametrize(("direction", "n"), [([0.9, 0.3, 0.4], 0.4), ([0.5, 0.6, 0.7], 0.6)])
def test_an_unlit_side_of_one_code_has_one_rounding_error(direction: list[float], n: float):
    """It was hundreds of independent values, 6.7 and 5.5 standard errors of k_a beside a lobe that is much like it."""
    material = brdf.BlinnPhong(k_a=0.3, k_d=0.4 if n < 0.5 else 0.3, k_s=0.3, n=n)
    scene = ball_scene(brdf.DirectionalLight(direction, [0.9]), ambient=[0.3])
    result = fitting.fit(np.rint(255 * pictured(material, scene)).astype(np.uint8), scene, model="blinn-phong")
    for found in result.parameters:
        assert abs(found.value - float(np.ravel(getattr(material, found.name))[0])) < 2 * found.error


def test_what_is_at_its_bound_lies_in_its_interval():
    scene = ball_scene(brdf.DirectionalLight([0.5, 0.6, 0.7], [0.9]), ambient=[0.3])
    metal = brdf.BlinnPhong(k_d=0, k_s=0.9, n=60)
    result = fitting.fit(np.rint(255 * pictured(metal, scene)).astype(np.uint8), scene, model="blinn-phong")
    assert [found.interval[0] for found in (*result["k_a"], *result["k_d"])] == [0, 0]
