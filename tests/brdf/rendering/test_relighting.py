"""Light is linear: recolouring pictures, and finding the lights in them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import brdf
import fitting

CAMERA = brdf.OrthographicCamera(position=[0, 0, 4], target=[0, 0, 0], up=[0, 1, 0], width=2.2, resolution=[32, 32])
BALL = [brdf.Sphere(center=[0, 0, 0], radius=1)]
MATERIAL = brdf.BlinnPhong(k_a=[0.1, 0.2, 0.1], k_d=[0.5, 0.3, 0.2], k_s=[0.4, 0.4, 0.5], n=30)
INTENSITIES = np.array([[1.0, 0.9, 0.8], [0.3, 0.5, 0.7], [0.2, 0.1, 0.2]])


def scene(intensities: np.ndarray) -> brdf.Scene:
    lights = [
        brdf.DirectionalLight(direction=[0.5, 0.6, 0.7], intensity=intensities[0]),
        brdf.SphereLight(center=[-2, 0.5, 2], radius=0.5, radiance=20 * intensities[1], samples=16),
    ]
    return brdf.Scene(camera=CAMERA, shapes=BALL, lights=lights, ambient=intensities[2])


def test_one_picture_per_light_adds_up_to_the_picture():
    images = np.asarray(brdf.render_lights(MATERIAL, scene(INTENSITIES), precision="float32"))
    assert images.shape == (3, 32, 32, 3)
    whole = np.asarray(brdf.render(MATERIAL, scene(INTENSITIES), precision="float32"))
    np.testing.assert_allclose(images.sum(axis=0), whole, atol=1e-6)


def test_recoloured_pictures_are_those_of_recoloured_lights():
    factors = np.array([[2.0, 0.5, 0.0], [1.0, 3.0, 1.0], [0.0, 1.0, 2.0]])
    images = brdf.render_lights(MATERIAL, scene(INTENSITIES), precision="float32")
    recoloured = brdf.render(MATERIAL, scene(INTENSITIES * factors), precision="float32")
    np.testing.assert_allclose(brdf.relight(images, factors), recoloured, atol=2e-6)  # a few roundings of float32
    for wrong, words in (([1.0, 2.0], "must be of shape"), (["a", "b", "c"], "must be numbers"), (None, "must be")):
        with pytest.raises(brdf.InputError, match=f"factors: {words}"):
            brdf.relight(images, wrong)
    exact = brdf.render_lights(MATERIAL, scene(INTENSITIES), precision="float64")
    np.testing.assert_allclose(brdf.relight(exact, [1, 1, 1]), np.sum(np.asarray(exact), axis=0), rtol=1e-14)
    by_factors = jax.grad(lambda factors: jnp.sum(brdf.relight(images, factors)))(jnp.ones((3, 3)))
    np.testing.assert_allclose(by_factors, np.sum(np.asarray(images), axis=(1, 2)), rtol=1e-5)


def test_lights_are_found_given_the_material():
    target = np.asarray(brdf.render(MATERIAL, scene(INTENSITIES), precision="float32"))
    found = fitting.fit_lights(target, scene(np.ones((3, 3))), MATERIAL)
    expected = INTENSITIES * np.array([[1.0], [20.0], [1.0]])
    np.testing.assert_allclose(found.emittances, expected, rtol=1e-4)
    assert not found.undetermined
    assert found.residual < 1e-5
    assert [one.key for one in found.parameters[:3]] == [f"lights[0].intensity[{channel}]" for channel in range(3)]
    np.testing.assert_allclose(np.asarray(found["lights[1].radiance"], float), found.emittances[1])


def test_lights_of_a_grey_material_are_told_by_their_colours():
    grey = brdf.BlinnPhong(k_a=0.1, k_d=0.5, k_s=0.4, n=30)
    found = fitting.fit_lights(np.asarray(brdf.render(grey, scene(INTENSITIES))), scene(np.ones((3, 3))), grey)
    assert "lights[1].radiance  blue" in str(found)


def test_lights_are_told_saved_and_drawn_as_a_fit_is(tmp_path):
    clean = np.asarray(brdf.render(MATERIAL, scene(INTENSITIES), precision="float64"))
    noisy = clean + np.random.default_rng(0).normal(0, 0.01, clean.shape)
    found = fitting.fit_lights(noisy, scene(np.ones((3, 3))), MATERIAL)
    truth = (INTENSITIES * np.array([[1.0], [20.0], [1.0]])).ravel()
    for one, true in zip(found.parameters, truth, strict=True):
        assert abs(float(one) - true) < 4.5 * one.error
    np.testing.assert_allclose(found.noise, 0.01, rtol=0.1)
    assert not found.warnings
    assert repr(found).startswith("<FitResult: blinn-phong, lights[0].intensity[0] ")
    assert f"  {found.parameters[0].name} red    {found.parameters[0]}" in str(found)
    found.save(tmp_path, plot=True)
    np.testing.assert_allclose(fitting.load_result(tmp_path).fitted(), found.fitted(), rtol=1e-5)


def test_lights_of_rounded_pictures_are_known_by_the_edges_of_codes():
    def suns(intensities: np.ndarray) -> brdf.Scene:
        """Two: a program of lights without an extent is made in a third of the time."""
        lights = [
            brdf.DirectionalLight(direction=direction, intensity=intensity)
            for direction, intensity in zip(([0.5, 0.6, 0.7], [-2, 0.5, 2]), intensities, strict=False)
        ]
        return brdf.Scene(camera=CAMERA, shapes=BALL, lights=lights, ambient=intensities[2])

    clean = np.asarray(brdf.render(MATERIAL, suns(INTENSITIES), precision="float64"))
    codes = np.rint(255 * clean / clean.max()).astype(np.uint8)
    found = fitting.fit_lights(codes, suns(np.ones((3, 3))), MATERIAL)
    truth = INTENSITIES.ravel() / clean.max()
    for one, true in zip(found.parameters, truth, strict=True):
        assert abs(float(one) - true) < 4.5 * one.error
    # Of least squares it is three times as much.
    assert np.mean(found.errors.ravel() * found.emittances.ravel() / found.factors.ravel() / truth) < 7e-4


def test_errors_of_lights_know_noise_that_grows_with_brightness():
    clean = np.asarray(brdf.render(MATERIAL, scene(INTENSITIES), precision="float64"))
    deviation = 0.001 + 0.2 * clean
    noisy = clean + deviation * np.random.default_rng(0).standard_normal(clean.shape)
    found = fitting.fit_lights(noisy, scene(np.ones((3, 3))), MATERIAL)
    columns = brdf.render_lights(MATERIAL, scene(np.ones((3, 3))), precision="float64")
    for channel in range(3):
        own = np.asarray(columns)[..., channel].reshape(3, -1)
        inverse = np.linalg.inv(own @ own.T)
        scatter = own * deviation[..., channel].ravel() ** 2 @ own.T
        np.testing.assert_allclose(found.errors[:, channel] ** 2, np.diag(inverse @ scatter @ inverse), rtol=0.3)


def test_ambient_light_alone_is_found():
    dim, lit = (brdf.Scene(camera=CAMERA, shapes=BALL, ambient=one) for one in ([0.2] * 3, [0.4, 0.3, 0.1]))
    found = fitting.fit_lights(np.asarray(brdf.render(MATERIAL, lit)), dim, MATERIAL)
    np.testing.assert_allclose(found.emittances, [[0.4, 0.3, 0.1]], rtol=1e-5)


def test_lights_that_look_alike_are_not_told_apart():
    light = brdf.DirectionalLight(direction=[0, 0, 1], intensity=[1, 1, 1])
    twice = brdf.Scene(camera=CAMERA, shapes=BALL, lights=[light, light])
    found = fitting.fit_lights(np.asarray(brdf.render(MATERIAL, twice)), twice, MATERIAL)
    assert len(found.undetermined) == 6
    assert "another light or none" in str(found)


def test_lights_and_material_are_found_up_to_one_factor():
    target = np.asarray(brdf.render(MATERIAL, scene(INTENSITIES), precision="float32"))
    found = fitting.fit_lights_and_material(target, scene(np.ones((3, 3))))
    assert isinstance(found.material, brdf.BlinnPhong)
    np.testing.assert_allclose(found.material.n, 30, rtol=1e-3)
    # what one factor per channel cannot change: the ratio of the lights and of the coefficients
    ratio = found.emittances[1] / found.emittances[0]
    np.testing.assert_allclose(ratio, 20 * INTENSITIES[1] / INTENSITIES[0], rtol=1e-3)
    np.testing.assert_allclose(found.material.k_s / found.material.k_d, MATERIAL.k_s / MATERIAL.k_d, rtol=1e-3)
    assert any("one factor per channel" in what for what in found.undetermined)
    np.testing.assert_allclose(brdf.render(found.material, found.scene, precision="float32"), target, atol=1e-4)


@pytest.mark.parametrize(("n", "start"), [(20, (0.2, 3.0)), (40, (0.2, 0.9)), (100, (0.02, 0.1)), (100, (0.02, 3.0))])
def test_lights_and_material_are_found_from_any_start(n: float, start: tuple[float, float]):
    # From the best material under the scene's own lights, n was found as 1.6 to 2.6.
    def lit(*intensities: float) -> brdf.Scene:
        directions = [0.4, 0.5, 0.8], [-0.6, 0.1, 0.7]
        lights = [brdf.DirectionalLight(direction=d, intensity=i) for d, i in zip(directions, intensities, strict=True)]
        return brdf.Scene(camera=CAMERA, shapes=BALL, lights=lights, ambient=0.3)

    target = np.asarray(brdf.render(brdf.BlinnPhong(k_a=0.2, k_d=0.4, k_s=0.3, n=n), lit(0.9, 0.5)))
    found = fitting.fit_lights_and_material(target, lit(*start))
    np.testing.assert_allclose(found.emittances[0] / found.emittances[1], 1.8, rtol=1e-4)
    np.testing.assert_allclose(found.factors[:2].mean(), 1, rtol=1e-6)
    np.testing.assert_allclose(found.material.n, n, rtol=1e-4)


def test_without_a_highlight_n_is_not_determined():
    matt = brdf.Lambert(k_a=MATERIAL.k_a, k_d=MATERIAL.k_d)
    found = fitting.fit_lights_and_material(np.asarray(brdf.render(matt, scene(INTENSITIES))), scene(INTENSITIES))
    assert found["n"].value is None
    assert "no highlight" in found.undetermined["n"]


def test_a_light_that_is_stated_to_be_dark_in_a_channel_stays_dark():
    directions = [0.4, 0.5, 0.8], [-0.6, 0.1, 0.7]
    lights = [
        brdf.DirectionalLight(direction=direction, intensity=intensity)
        for direction, intensity in zip(directions, ([0.9, 0, 0], [0.5] * 3), strict=True)
    ]
    known = brdf.Scene(camera=CAMERA, shapes=BALL, lights=lights, ambient=0.3)
    found = fitting.fit_lights_and_material(np.asarray(brdf.render(MATERIAL, known)), known)
    np.testing.assert_allclose(found.material.n, MATERIAL.n, rtol=1e-5)
    np.testing.assert_allclose(found.emittances[0, 1:], 0, atol=1e-6)
    np.testing.assert_allclose(found.emittances[1], 0.5, rtol=1e-4)
