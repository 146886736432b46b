"""Noise that differs between pictures, as of other exposures, or grows with brightness: what is noisy counts less."""

import numpy as np
import pytest
from small_ball import SIZE, SUN, ball_scene, pictured

import brdf
import fitting
from brdf.images.encoding import encode

OTHER = brdf.DirectionalLight(direction=[-0.5, 0.3, 0.8], intensity=[1.0, 0.8, 0.6])
SCENES = [ball_scene(SUN), ball_scene(OTHER)]
MATERIAL = brdf.BlinnPhong(k_a=[0.3] * 3, k_d=[0.4, 0.3, 0.2], k_s=[0.2] * 3, n=30.0)
DRAWS = 8


def drawn(noises, seed: int, *, codes: bool) -> list[np.ndarray]:
    parts = zip(SCENES, noises, (2 * seed, 2 * seed + 1), strict=True)
    values = [pictured(MATERIAL, *part) for part in parts]
    return [np.clip(np.rint(255 * one), 0, 255).astype(np.uint8) if codes else one.astype(np.float32) for one in values]


def deviations(result: fitting.FitResult, factor: float = 1.0) -> np.ndarray:
    numbers = factor * MATERIAL.k_a, factor * MATERIAL.k_d, factor * MATERIAL.k_s, MATERIAL.n
    true = dict(zip(("k_a", "k_d", "k_s", "n"), map(np.atleast_1d, numbers), strict=True))
    return np.array([(one.value - true[one.name][one.channel or 0]) / one.error for one in result.parameters])


# In codes 0, 0.2, 0.8, 13: rounding hides the noise, or not.
@pytest.mark.parametrize(
    ("noises", "codes"),
    [((0.003, 0.05), False), ((0.003, 0.05), True), ((0.0, 0.0008), True), ((0.05, 0.0008), True)],
)
def test_pictures_of_different_noise_count_by_what_they_know(noises, codes):
    quiet, found = int(np.argmin(noises)), []
    for seed in range(DRAWS):
        pictures = drawn(noises, seed, codes=codes)
        result = fitting.fit(pictures, SCENES)
        assert result.warnings == ()
        alone = fitting.fit(pictures[quiet], SCENES[quiet], model="blinn-phong")
        # All alike, the noisy picture would make these errors many times as large; of k_a an unlit side may tell less.
        for both, one in zip(result.parameters, alone.parameters, strict=True):
            assert both.error < (1.5 if one.name == "k_a" else 1.05) * one.error
        found.append(deviations(result))
    # Nearly as many within two of their errors as should be.
    assert np.mean(np.abs(found) < 2) > 0.88
    assert np.max(np.abs(found)) < 5


@pytest.mark.parametrize(("kind", "noise"), [(np.uint16, 0.0), (np.float32, 0.0), (np.float32, 0.004)])
def test_pictures_of_any_kind_stand_beside_each_other(kind, noise):
    """By least squares numbers of these were four to nine of their errors off."""
    found = []
    for seed in range(DRAWS):
        # Without noise only another brightness makes another draw.
        factor = 1 + 0.01 * seed
        fine, coarse = (factor * one for one in drawn((noise, 0.0), seed, codes=False))
        fine = fine if kind == np.float32 else np.rint(np.clip(fine, 0, 1) * 65535)
        pictures = [fine.astype(kind), np.rint(255 * coarse).astype(np.uint8)]
        result = fitting.fit(pictures, SCENES, model="blinn-phong")
        assert result.warnings == ()
        found.append(deviations(result, factor))
        # Beside what is known exactly to single precision all is.
        assert noise > 0 or max(one.error / one.value for one in result.parameters) < 1e-4
    assert np.mean(np.abs(found) < 2) > 0.85
    assert np.max(np.abs(found)) < 5


@pytest.mark.parametrize("fine", [np.uint16, np.float32])
def test_a_coarse_picture_takes_nothing_from_a_fine_one(fine):
    """All were said to have the rounding of the coarsest: errors were fifty times those of the fine picture alone."""
    coarse, sharp = drawn((1 / 255, 1 / 65535), 0, codes=False)
    sharp = np.rint(np.clip(65535 * sharp, 0, 65535)).astype(fine) if fine == np.uint16 else sharp
    pictures = [np.clip(np.rint(255 * coarse), 0, 255).astype(np.uint8), sharp]
    both = fitting.fit(pictures, SCENES, model="blinn-phong")
    alone = fitting.fit(pictures[1], SCENES[1], model="blinn-phong")
    for one, other in zip(both.parameters, alone.parameters, strict=True):
        assert one.error < 1.2 * other.error
    assert np.max(np.abs(deviations(both))) < 4


@pytest.mark.parametrize("codes", [False, True])
def test_bands_of_a_picture_have_its_noise_and_some_see_nothing(codes, monkeypatch):
    pictures = drawn((0.001, 0.02), 0, codes=codes)
    whole = fitting.fit(pictures, SCENES, model="blinn-phong")
    monkeypatch.setattr(fitting.pixels, "TILE_PIXELS", 96)
    monkeypatch.setattr(fitting.pixels, "KEPT_PIXELS", 0)
    bands = fitting.fit(pictures, SCENES, model="blinn-phong")
    for one, other in zip(whole.parameters, bands.parameters, strict=True):
        assert abs(one.value - other.value) < 0.3 * one.error
        assert other.error == pytest.approx(one.error, rel=0.1)


def test_many_pictures_of_a_few_values_have_one_noise():
    """Each by what is left of it, k_s and n were 1.7 of their errors off: of three values noise is anything."""
    random = np.random.default_rng(0)
    lights = random.normal(size=(24, 3)) * [0.6, 0.6, 0.1] + [0, 0, 1.0]
    points = brdf.SurfacePoints.from_normals(np.array([[[0.1, 0.05, 1.0]]]))
    scenes = [brdf.Scene(points=points, lights=[brdf.DirectionalLight(light, 1.0)]) for light in lights]
    clean, off = [np.asarray(brdf.render(MATERIAL, scene, precision="float64")) for scene in scenes], []
    for _ in range(2 * DRAWS):
        pictures = [one + 0.004 * random.normal(size=one.shape) for one in clean]
        result = fitting.fit(pictures, scenes, model="blinn-phong", precision="float64")
        k_s, n = result["k_s"][0], result["n"]
        off.append([(k_s.value - 0.2) / k_s.error, (n.value - 30) / n.error])
    assert np.sqrt(np.mean(np.square(off))) < 1.4


def test_pictures_of_one_noise_are_weighed_alike():
    pictures = drawn((0.01, 0.01), 0, codes=False)
    both, alike = (fitting.fit(pictures, SCENES, weight=one) for one in (None, [np.ones(pictures[0].shape[:2])] * 2))
    assert [one.value for one in both.parameters] == pytest.approx([one.value for one in alike.parameters], rel=1e-6)


def test_weights_of_a_picture_that_is_clipped_in_some_channels_stand_beside_those_of_another():
    pictures = drawn((0.01, 0.01), 0, codes=False)
    pictures[1] = np.minimum(pictures[1], 0.4)  # of red and green
    weight = [np.linspace(0.5, 1.5, one[..., 0].size).reshape(one.shape[:2]) for one in pictures]
    result = fitting.fit(pictures, SCENES, weight=weight, model="blinn-phong")
    assert np.all(np.abs(deviations(result)) < 4)


def test_pictures_all_of_whose_pixels_count_differ_in_noise():
    normals = np.stack(np.broadcast_arrays(*np.mgrid[-0.5:0.5:24j, -0.5:0.5:24j], 1.0), axis=-1)
    points = brdf.SurfacePoints.from_normals(normals / np.linalg.norm(normals, axis=-1, keepdims=True))
    scenes = [brdf.Scene(points=points, lights=scene.lights) for scene in SCENES]
    pictures = [pictured(brdf.Lambert(k_d=0.4), *part) for part in zip(scenes, (0.001, 0.02), (0, 1), strict=True)]
    pictures = [one.astype(np.float32) for one in pictures]
    both, alone = (fitting.fit(*some, model="lambert") for some in ((pictures, scenes), (pictures[0], scenes[0])))
    assert both["k_d"][0].error == pytest.approx(alone["k_d"][0].error, rel=0.05)


def off_by(numbers, shot, kind, lights=((0.4, 0.5, 0.8),), **fit) -> np.ndarray:
    """By how many of its errors each number is off, of balls whose noise grows with brightness."""
    suns = [brdf.DirectionalLight(direction=direction, intensity=[1.0]) for direction in lights]
    scenes, off = [ball_scene(sun, ambient=[0.5]) for sun in suns], []
    for draw in range(DRAWS):
        pictures = []
        for seed, scene in enumerate(scenes, draw * len(scenes)):
            clean = pictured(brdf.BlinnPhong(**numbers), scene)
            noise = np.sqrt(0.002**2 + shot * clean)
            picture = np.clip(pictured(brdf.BlinnPhong(**numbers), scene, noise, seed), 0, 1)
            picture = encode(picture, "srgb") if kind == "srgb" else picture
            floats = kind == "clipped"
            pictures.append(picture.astype(np.float32) if floats else np.rint(255 * picture).astype(np.uint8))
        how = {"clipped": {"saturation": 1.0}, "srgb": {"encoding": "srgb"}}.get(kind, {})
        if fit:
            result = fitting.fit_jointly(pictures, scenes, **fit, **how)
        else:
            result = fitting.fit(pictures, scenes, model="blinn-phong", **how)
        found = [one for one in result.parameters if one.name in numbers]
        off.append([(one.value - numbers[one.name]) / one.error for one in found])
    return np.sqrt(np.mean(np.square(off), axis=0))


@pytest.mark.parametrize("kind", ["linear", "srgb", "clipped"])
def test_noise_that_grows_beside_what_is_clipped_is_weighed_by_value(kind):
    """Of one size for all, k_s was 2.3 of its errors off in the mean of these."""
    off = off_by({"k_a": 0.1, "k_d": 0.6, "k_s": 0.8, "n": 20.0}, 4e-3, kind)
    assert np.sqrt(np.mean(off**2)) < 1.15


@pytest.mark.parametrize("kind", ["linear", "srgb"])
def test_noise_that_grows_and_is_cut_off_is_known_by_what_is_to_be_expected(kind):
    """Of one size for all, k_a was 4 of its errors off in the mean of these."""
    assert np.all(off_by({"k_a": 0.005, "k_d": 0.5, "k_s": 0.2, "n": 20.0}, 1e-3, kind) < 1.6)


def test_noise_that_grows_is_that_of_all_pictures():
    both = (0.4, 0.5, 0.8), (-0.7, 0.2, 0.6)
    off = off_by({"k_a": 0.1, "k_d": 0.5, "k_s": 0.3, "n": 20.0}, 1e-3, "linear", both)
    assert np.sqrt(np.mean(off**2)) < 1.2


@pytest.mark.parametrize("kind", ["linear", "srgb"])
def test_noise_that_grows_is_that_of_a_joint_fit(kind):
    """Of one size for all, k_s of linear codes was 2.4 of its errors off, k_d of those of a curve 1.8."""
    numbers = {"k_a": 0.1, "k_d": 0.6, "k_s": 0.8, "n": 20.0}
    off = off_by(numbers, 4e-3, kind, material="blinn-phong", free="light")
    assert np.sqrt(np.mean(off**2)) < 1.15


def test_noise_that_grows_is_found_on_a_small_object_in_a_large_picture():
    """Of pixels anywhere next to none were of the object: n was as uncertain as of noise that is even."""
    sun = brdf.DirectionalLight(direction=[0.4, 0.5, 0.8], intensity=[1.0])
    wide = brdf.OrthographicCamera(
        position=[0, 0, 4], target=[0, 0, 0], up=[0, 1, 0], width=22.0, resolution=(10 * SIZE, 10 * SIZE)
    )
    near, far = ball_scene(sun, ambient=[0.5]), ball_scene(sun, ambient=[0.5], camera=wide)
    material = brdf.BlinnPhong(k_a=0.1, k_d=0.6, k_s=0.8, n=20.0)
    noise = np.sqrt(0.002**2 + 4e-3 * pictured(material, near))
    codes = np.rint(255 * np.clip(pictured(material, near, noise, 0), 0, 1)).astype(np.uint8)
    beside = 9 * SIZE // 2
    padded = np.pad(codes, ((beside, beside), (beside, beside), (0, 0)))
    one, other = (fitting.fit(*some, model="blinn-phong")["n"] for some in ((codes, near), (padded, far)))
    assert other.value == pytest.approx(one.value, rel=2e-3)
    assert other.error == pytest.approx(one.error, rel=0.02)


def test_rounding_does_not_make_noise_grow():
    """Of a fifth of a code: taken for such, k_a and k_d were 2.5 of their errors off in the mean."""
    scene, off = ball_scene(brdf.DirectionalLight(direction=[0.4, 0.5, 0.8], intensity=[1.0])), []
    numbers = {"k_a": 0.1, "k_d": 0.5, "k_s": 0.3, "n": 20.0}
    for seed in range(DRAWS):
        codes = np.rint(255 * pictured(brdf.BlinnPhong(**numbers), scene, 0.2 / 255, seed))
        result = fitting.fit(codes.clip(0, 255).astype(np.uint8), scene, model="blinn-phong")
        off.append([(one.value - numbers[one.name]) / one.error for one in result.parameters])
    assert np.all(np.sqrt(np.mean(np.square(off), axis=0)) < 1.5)


def test_rounding_of_half_floats_is_no_noise_that_grows():
    """Taken for such, n was twice as far off and its error half as large again."""
    scene = ball_scene(brdf.DirectionalLight(direction=[0.4, 0.5, 0.8], intensity=[1.0]), ambient=[0.5])
    halves = pictured(brdf.BlinnPhong(k_a=0.1, k_d=0.5, k_s=0.3, n=30.0), scene).astype(np.float16)
    n = fitting.fit(halves.astype(np.float32), scene, model="blinn-phong")["n"]
    assert abs(n.value - 30) < 3 * n.error < 3 * 0.0017
