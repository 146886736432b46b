"""The pass over light samples, and pixels averaged over their area."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import brdf
import fitting
from brdf import lobes, rendering
from brdf.rendering import basis

SIZE = 128
TO_LIGHT = np.array([0.5, 0.6, 0.7]) / np.linalg.norm([0.5, 0.6, 0.7])


def ball(samples: int, size: int = SIZE, **more) -> brdf.Scene:
    camera = brdf.OrthographicCamera(
        position=[0, 0, 4], target=[0, 0, 0], up=[0, 1, 0], width=2.2, resolution=[size, size], samples=samples
    )
    light = brdf.DirectionalLight(direction=TO_LIGHT, intensity=1)
    return brdf.Scene(camera=camera, shapes=[brdf.Sphere(center=[0, 0, 0], radius=1)], **({"lights": [light]} | more))


def glossy(n: float) -> brdf.BlinnPhong:
    return brdf.BlinnPhong(k_a=0.1, k_d=0.5, k_s=0.5, n=n)


@functools.cache
def pixel_averages(n: float, samples: int = 32) -> np.ndarray:
    """The ball in plain NumPy, samples × samples midpoints per pixel."""
    half = TO_LIGHT + np.array([0, 0, 1])
    half /= np.linalg.norm(half)
    at = (np.arange(SIZE * samples) + 0.5) / (SIZE * samples) * 2.2 - 1.1
    rows = []
    for row in range(SIZE):
        x, y = at[None, :], -at[row * samples : (row + 1) * samples, None]
        squared = 1 - x * x - y * y
        z = np.sqrt(np.maximum(squared, 0))
        lit = x * TO_LIGHT[0] + y * TO_LIGHT[1] + z * TO_LIGHT[2]
        cosine = np.maximum(x * half[0] + y * half[1] + z * half[2], 1e-9)
        value = np.where(squared > 0, 0.02 + np.where(lit > 0, 0.5 * lit + 0.5 * cosine**n, 0), 0)
        rows.append(value.reshape(samples, SIZE, samples).mean(axis=(0, 2)))
    return np.stack(rows)


@pytest.mark.parametrize("n", [1e3, 1e4])
def test_a_pixel_is_an_area(n: float):
    expected = pixel_averages(n)
    got = np.asarray(brdf.render(glossy(n), ball(4, ambient=0.2), precision="float32"))[..., 0]
    assert np.max(np.abs(got - expected)) < 0.01 * expected.max()
    centres = np.asarray(brdf.render(glossy(n), ball(1, ambient=0.2), precision="float32"))[..., 0]
    assert np.max(np.abs(centres - expected)) > 0.1 * expected.max()


@pytest.mark.parametrize("n", [15.0, 60.0, 400.0])
def test_what_centres_leave_out_of_wider_highlights_is_next_to_nothing(n: float):
    """Where no edge passes: with 2e-3 of the peak left out n of a picture without noise was 10 errors off."""
    expected = pixel_averages(n)
    got = np.asarray(brdf.render(glossy(n), ball(4, ambient=0.2), precision="float32"))[..., 0]
    x, y = (np.arange(SIZE) + 0.5) / SIZE * 2.2 - 1.1, 1.1 - (np.arange(SIZE)[:, None] + 0.5) / SIZE * 2.2
    lit = x * TO_LIGHT[0] + y * TO_LIGHT[1] + np.sqrt(np.maximum(1 - x * x - y * y, 0)) * TO_LIGHT[2]
    inside = (x * x + y * y < 0.9) & (lit > 0.05)
    assert np.max(np.abs(got - expected)[inside]) < 1.5e-4 * expected.max()


def test_few_pixels_cost_more_than_one_sample():
    area = ball(4, size=256).surface_points().area
    assert area is not None
    assert area.points.mask.shape[1] == 16
    assert np.count_nonzero(np.asarray(area.slot) >= 0) < 0.08 * 256 * 256


def test_a_fit_to_pixel_averages_needs_them():
    n = 1e4
    target = pixel_averages(n)[..., None].astype(np.float32)
    by_area = fitting.fit(target, ball(4, ambient=0.2), model="blinn-phong").material
    by_centres = fitting.fit(target, ball(1, ambient=0.2), model="blinn-phong").material
    assert isinstance(by_area, brdf.BlinnPhong)
    assert isinstance(by_centres, brdf.BlinnPhong)
    np.testing.assert_allclose(by_area.n, n, rtol=0.01)
    np.testing.assert_allclose(by_area.k_s, 0.5, rtol=0.01)
    assert abs(float(by_centres.n) / n - 1) > 0.05


def test_gradients_pass_through_pixel_areas():
    scene = ball(2, size=24)

    def value(n: jax.Array) -> jax.Array:
        return jnp.sum(brdf.render(brdf.BlinnPhong(k_d=0.5, k_s=0.5, n=n), scene) ** 2)

    with jax.enable_x64(True):
        expected = float(value(jnp.asarray(50.01)) - value(jnp.asarray(49.99))) / 0.02
        np.testing.assert_allclose(jax.grad(value)(jnp.asarray(50.0)), expected, rtol=1e-5)
        np.testing.assert_allclose(jax.jit(value)(jnp.asarray(50.0)), value(jnp.asarray(50.0)), rtol=1e-12)

        def by_radius(radius: jax.Array) -> jax.Array:
            moved = ball(2, size=24)
            shape = brdf.Sphere(center=np.zeros(3), radius=radius)
            moved = brdf.Scene(camera=moved.camera, shapes=[shape], lights=moved.lights)
            return jnp.sum(brdf.render(glossy(5), moved)[8:16, 8:16])

        # traced, like the gradient: then every pixel is averaged
        traced = jax.jit(by_radius)
        expected = float(traced(jnp.asarray(1.00001)) - traced(jnp.asarray(0.99999))) / 2e-5
        np.testing.assert_allclose(jax.grad(by_radius)(jnp.asarray(1.0)), expected, rtol=1e-5)


def test_many_samples_pass_tile_by_tile(monkeypatch: pytest.MonkeyPatch):
    light = brdf.SphereLight(center=[1, 1, 3], radius=0.5, radiance=5, samples=16)
    whole = np.asarray(brdf.render(glossy(20), ball(1, size=40, lights=[light]), precision="float32"))
    monkeypatch.setattr(lobes, "TILE", 300)  # 1600 pixels: not a multiple
    jax.clear_caches()
    tiled = np.asarray(brdf.render(glossy(20), ball(1, size=40, lights=[light]), precision="float32"))
    np.testing.assert_allclose(tiled, whole, atol=1e-6)


def test_an_averaged_basis_makes_the_averaged_picture():
    scene, material = ball(3, size=32), glossy(200.0)
    images = basis(brdf.BlinnPhong, scene)
    assert images.diffuse is not None
    assert images.lobe is not None
    value, _ = images.lobe(jnp.asarray(200.0))
    picture = 0.5 * images.diffuse + 0.5 * value
    expected = np.asarray(brdf.render(material, scene))
    np.testing.assert_allclose(np.asarray(picture).reshape(expected.shape), expected, atol=1e-6)
    few = images.lobe.pixels(lambda a: a[100:200])
    np.testing.assert_allclose(few(jnp.asarray(200.0))[0], value[100:200], atol=1e-7)


@pytest.mark.parametrize("shapes", [1, 2])
def test_rays_that_are_traced_anew_see_what_points_that_are_kept_see(shapes: int):
    both = [
        brdf.Sphere(center=[0, 0, 0], radius=1),
        brdf.Rectangle(center=[0, 0, -1], edge_u=[2, 0, 0], edge_v=[0, 2, 0]),
    ]
    camera = brdf.PerspectiveCamera(position=[0, 1, 5], target=[0, 0, 0], up=[0, 1, 0], fov=30, resolution=(24, 20))
    scene = brdf.cast(brdf.Scene(camera, both[:shapes], lights=ball(1).lights), "float32")
    rays, points = scene.sight(), scene.surface_points()
    assert len(jax.tree.leaves(rays)) < len(jax.tree.leaves(scene))  # no pixels
    np.testing.assert_array_equal(rays.mask, points.mask)
    traced, kept = (basis(brdf.BlinnPhong, scene, points=one) for one in (rays, points))
    np.testing.assert_allclose(traced.diffuse, kept.diffuse, atol=1e-6)
    assert traced.lobe is not None
    assert kept.lobe is not None
    np.testing.assert_allclose(traced.lobe(jnp.asarray(20.0))[0], kept.lobe(jnp.asarray(20.0))[0], atol=1e-5)
    some = scene.sight((5, 9))
    np.testing.assert_array_equal(some.mask, np.asarray(points.mask)[5:9])


def directional(count: int, **more) -> list[brdf.DirectionalLight]:
    turns = 2.4 * np.arange(count)
    directions = np.stack([np.cos(turns), np.sin(turns), 1.0 + np.arange(count) / count], axis=-1)
    return [brdf.DirectionalLight(direction=one, intensity=[1.0, 0.5, 0.2], **more) for one in directions / count]


def test_a_thousand_lights_are_one_loop():
    lights = directional(1000)
    few, many = ball(1, size=16, lights=lights[:10]), ball(1, size=16, lights=lights)

    def program(scene: brdf.Scene) -> str:
        return str(jax.make_jaxpr(lambda n: basis_of(scene, n))(20.0))

    def basis_of(scene: brdf.Scene, n: float) -> jax.Array:
        return brdf.basis_images(brdf.BlinnPhong, scene, n).specular

    assert program(many).count(" = ") == program(few).count(" = ")
    image = np.asarray(brdf.render(glossy(20.0), many, precision="float64"))
    parts = [ball(1, size=16, lights=lights[start::4]) for start in range(4)]
    each = [np.asarray(brdf.render(glossy(20.0), part, precision="float64")) for part in parts]
    np.testing.assert_allclose(image, sum(each), rtol=1e-12)


def test_lights_of_any_kind_and_channels_add_up():
    kinds = [
        *directional(2),
        brdf.DirectionalLight(direction=[0, 1, 1], intensity=0.3),
        brdf.PointLight(position=[1, 2, 3], intensity=[5.0, 4.0, 3.0]),
        brdf.SphereLight(center=[-1, 1, 3], radius=0.4, radiance=5, samples=9),
    ]
    masks = np.random.default_rng(0).uniform(size=(len(kinds), 16, 16))
    scene = ball(1, size=16, lights=kinds, visibility=list(masks))
    image = np.asarray(brdf.render(glossy(9.0), scene, precision="float64"))
    each = np.asarray(brdf.render_lights(glossy(9.0), scene, precision="float64"))
    np.testing.assert_allclose(each.sum(axis=0), image, rtol=1e-12)
    images = basis(brdf.BlinnPhong, brdf.cast(scene, "float32"))
    assert images.lobe is not None
    picture = 0.5 * images.diffuse + 0.5 * images.lobe(jnp.asarray(9.0))[0]
    np.testing.assert_allclose(np.asarray(picture).reshape(image.shape), image, atol=1e-5)


@pytest.mark.parametrize("model", [brdf.Phong, brdf.BlinnPhong])
def test_second_derivatives_are_finite_where_a_pixel_misses_the_shapes(model: type[brdf.Material]):
    with jax.enable_x64(True):

        def value(direction: jax.Array) -> jax.Array:
            light = brdf.DirectionalLight(direction=direction, intensity=1.0)
            return jnp.sum(brdf.render(model(k_d=0.5, k_s=0.5, n=20.0), ball(1, size=8, lights=[light])))

        assert np.isfinite(jax.jit(jax.hessian(value))(jnp.asarray(TO_LIGHT))).all()
        assert np.isfinite(jax.jit(jax.hessian(value))(jnp.array([0.3, 0.2, -1.0]))).all()


@pytest.mark.parametrize("model", [brdf.Phong, brdf.NormalizedBlinnPhong])
def test_one_program_under_many_samples_serves_every_lobe_and_number(model):
    # Of few pixels samples are filled up with ones of no light, and the lobe is chosen as the program runs.
    light = brdf.SphereLight(center=[1, 1, 3], radius=0.4, radiance=[2.0, 1.0, 3.0], samples=36)
    scene = ball(1, 24, lights=[light, brdf.PointLight(position=[0, 0, 4], intensity=1.0)])
    images = brdf.basis_images(model, scene, 20.0)
    material = model(k_d=0.3, k_s=[0.2, 0.3, 0.4], n=20.0)
    shown = 0.3 * images.diffuse + np.array([0.2, 0.3, 0.4]) * images.specular
    np.testing.assert_allclose(shown, brdf.render(material, scene), rtol=2e-6, atol=1e-7)
    before = rendering._basis_images._cache_size()
    for other, samples in ((brdf.BlinnPhong, 64), (model, 400)):
        more = dataclasses.replace(scene, lights=(dataclasses.replace(light, samples=samples), scene.lights[1]))
        brdf.basis_images(other, more, 30.0)
    assert rendering._basis_images._cache_size() == before


@pytest.mark.parametrize("draw", [brdf.render, brdf.render_lights])
def test_a_coefficient_that_the_precision_cannot_hold_is_refused(draw):
    scene = ball(1, 8)
    with pytest.raises(brdf.InputError, match=r"k_d: is out of reach of float32, got 1e\+60"):
        draw(brdf.Lambert(k_d=1e60), scene, precision="float32")
