"""Lights against closed forms, and their gradients against central differences."""

import dataclasses
import itertools
import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import brdf
from brdf.lights.base import Light

NORMALS = np.array([[[0, 0, 1.0], [0, 0.5, 0.8], [0.9, 0, 0.3], [0.3, -0.2, 0.5]]])
POINTS = brdf.SurfacePoints.from_normals(NORMALS, position=np.zeros(NORMALS.shape))
UNIT = np.asarray(POINTS.normal)[0]
WHITE = brdf.Lambert(k_d=1.0)
GLOSSY = brdf.BlinnPhong(k_d=0.5, k_s=0.5, n=30)

CENTER, EDGE_U, EDGE_V = np.array([0.3, 0.2, 2.0]), np.array([0.5, 0, 0.1]), np.array([0, -0.5, 0.2])
QUAD = np.array(
    [CENTER - EDGE_U - EDGE_V, CENTER + EDGE_U - EDGE_V, CENTER + EDGE_U + EDGE_V, CENTER - EDGE_U + EDGE_V]
)


def radiance(light: Light, material: brdf.Material = WHITE) -> np.ndarray:
    image = brdf.render(material, brdf.Scene(points=POINTS, lights=[light]), precision="float64")
    return np.asarray(image)[0, :, 0]


def lambert(vertices: np.ndarray) -> np.ndarray:
    """Lambert's formula for a polygon above the horizon, of irradiance over pi."""
    to_corner = vertices / np.linalg.norm(vertices, axis=1, keepdims=True)
    total = 0.0
    for a, b in zip(to_corner, np.roll(to_corner, -1, axis=0), strict=True):
        cross = np.cross(a, b)
        total = total + math.acos(a @ b) * (UNIT @ cross) / np.linalg.norm(cross)
    return np.abs(total) / (2 * math.pi)


@pytest.mark.parametrize(
    "light",
    [
        brdf.RectangleLight(center=CENTER, edge_u=EDGE_U, edge_v=EDGE_V, radiance=1, samples=64),
        brdf.PolygonLight(vertices=QUAD, radiance=1, samples=64),
    ],
    ids=["rectangle", "polygon"],
)
def test_flat_lights_follow_lamberts_formula(light: Light):
    # twice their size away, 64 samples: 1e-4 is asked for
    np.testing.assert_allclose(radiance(light), lambert(QUAD), rtol=1e-6)


@pytest.mark.parametrize("degrees", [90, 40])
@pytest.mark.parametrize(("size", "height", "error"), [(2.0, 1.0, 6e-4), (20.0, 1.0, 1e-2), (0.5, 0.01, 1e-2)])
def test_flat_lights_may_be_large_and_near(size: float, height: float, error: float, degrees: float):
    """With samples spread evenly over it a light of 20 times its distance gave a tenth of what it gives."""
    center, u = np.array([0.2 * size, 0, height]), np.array([0, size, 0])
    v = size * np.array([math.sin(math.radians(degrees)), math.cos(math.radians(degrees)), 0])
    quad = center + np.array([-u - v, v - u, u + v, u - v])
    rectangle = brdf.RectangleLight(center=center, edge_u=u, edge_v=v, radiance=1, samples=64)
    polygon = brdf.PolygonLight(vertices=quad[::-1], radiance=1, samples=64)
    exact = lambert(quad)[0]
    assert radiance(rectangle)[0] == pytest.approx(exact, rel=3e-4)
    assert radiance(polygon)[0] == pytest.approx(exact, rel=error)


@pytest.mark.parametrize("unit", [1e-7, 1e-4, 1e4, 1e7])
def test_a_scene_looks_the_same_in_every_unit(unit: float):
    def picture(unit: float) -> np.ndarray:
        floor = brdf.Rectangle(center=[0, 0, 0], edge_u=[2 * unit, 0, 0], edge_v=[0, 2 * unit, 0])
        place = {"position": [0, 0, 4 * unit], "target": [0, 0, 0], "up": [0, 1, 0]}
        camera = brdf.OrthographicCamera(width=3 * unit, resolution=(6, 6), **place)
        lamp = brdf.PointLight([unit, 0, unit], 1.0, attenuation=[0, 0.5 / unit, 1 / unit**2])
        window = brdf.RectangleLight(unit * CENTER, edge_u=unit * EDGE_U, edge_v=unit * EDGE_V, radiance=1)
        return np.asarray(brdf.render(GLOSSY, brdf.Scene(camera, [floor], lights=[lamp, window])))

    np.testing.assert_allclose(picture(unit), picture(1.0), rtol=1e-4)


def test_a_polygon_need_not_be_convex():
    corner = [[0, 0], [1, 0], [1, 0.3], [0.3, 0.3], [0.3, 1], [0, 1]]
    bent = np.array([[x, y, 2.0] for x, y in corner])[::-1]
    light = brdf.PolygonLight(vertices=bent, radiance=1, samples=256)
    assert len(light.triangles) == 4
    np.testing.assert_allclose(radiance(light), lambert(bent), rtol=1e-6)


def test_a_sphere_follows_the_cap():
    distance, radius = np.linalg.norm(CENTER), 0.5
    expected = (radius / distance) ** 2 * (UNIT @ CENTER) / distance
    for samples in (4, 64):  # the rule is exact for what a cap needs
        light = brdf.SphereLight(center=CENTER, radius=radius, radiance=1, samples=samples)
        np.testing.assert_allclose(radiance(light), expected, rtol=1e-12)


def test_a_setting_light_is_integrated_over_what_is_left_of_it():
    center, half = np.array([1.0, 0.2, 0.1]), np.array([0, 0, 0.5])
    light = brdf.RectangleLight(center=center, edge_u=[0, 0.5, 0], edge_v=-half, radiance=1, samples=64)
    above = np.array([[1, -0.3, 0.0], [1, 0.7, 0], [1, 0.7, 0.6], [1, -0.3, 0.6]])
    np.testing.assert_allclose(radiance(light)[0], lambert(above)[0], rtol=1e-3)


def test_error_falls_with_the_number_of_samples():
    exact = lambert(QUAD)
    errors = [
        np.max(np.abs(radiance(brdf.PolygonLight(vertices=QUAD, radiance=1, samples=2 * k * k)) / exact - 1))
        for k in (1, 2, 3, 4)
    ]
    assert all(finer < 0.3 * coarser for coarser, finer in itertools.pairwise(errors))


def test_rectangles_and_polygons_shine_from_their_front_only():
    away = brdf.RectangleLight(center=CENTER, edge_u=EDGE_V, edge_v=EDGE_U, radiance=1)
    np.testing.assert_array_equal(radiance(away), 0)
    np.testing.assert_array_equal(radiance(brdf.PolygonLight(vertices=QUAD[::-1], radiance=1)), 0)


@pytest.mark.parametrize("height", [-0.5, 0.0, 0.5])
def test_a_sphere_shines_outward_only(height: float):
    around = brdf.SphereLight(center=[0.1, 0, height], radius=1, radiance=1)
    np.testing.assert_array_equal(radiance(around), 0)


@pytest.mark.parametrize(("angle", "factor"), [(0.0, 1.0), (20.0, math.cos(math.radians(20)) ** 8), (31.0, 0.0)])
def test_a_spot_falls_off_as_opengl_has_it(angle: float, factor: float):
    tilted = [math.sin(math.radians(angle)), 0, -math.cos(math.radians(angle))]
    spot = brdf.SpotLight(position=[0, 0, 2], direction=tilted, intensity=3, cutoff_angle=30, exponent=8)
    np.testing.assert_allclose(radiance(spot)[0], 3 / 4 * factor, rtol=1e-12)


def test_white_in_a_constant_environment_shows_its_radiance():
    np.testing.assert_allclose(radiance(brdf.ConstantEnvironment(radiance=1.0)), 1, atol=1e-12)
    # of a map the rectangles that the horizon crosses are approximated; DESIGN asks for 1e-4 of the constant one
    np.testing.assert_allclose(radiance(brdf.EnvironmentMap(np.ones((64, 128, 3)))), 1, atol=3e-4)


@pytest.mark.parametrize("n", [1.0, 30.0, 1000.0, 1e5])
def test_a_constant_environment_shows_the_albedo(n: float):
    from brdf.albedo import directional_albedo

    material = brdf.NormalizedBlinnPhong(k_d=0.3, k_s=0.5, n=n)  # reciprocal: light from all around, seen from one side
    got = radiance(brdf.ConstantEnvironment(radiance=1.0, samples=1024), material)
    expected = directional_albedo(material, np.arccos(UNIT[:, 2]), precision="float64")[:, 0]
    np.testing.assert_allclose(got, expected, atol=2e-4)


@pytest.mark.parametrize(
    ("row", "column", "direction"),
    [(64, 32, (1, 0, 0)), (64, 64, (0, 0, 1)), (64, 96, (-1, 0, 0)), (0, 5, (0, 1, 0)), (64, 0, (0, 0, -1))],
)
def test_axes_of_a_map_are_those_of_mitsuba(row: int, column: int, direction: tuple[float, ...]):
    pixels = np.zeros((128, 128, 1))
    pixels[row, column] = 1.0
    light = brdf.EnvironmentMap(pixels)
    np.testing.assert_allclose(np.asarray(light.patches.mean)[0], direction, atol=0.06)  # a texel is 0.05 wide


def test_one_bright_texel_is_nearly_a_directional_light():
    pixels = np.zeros((128, 256, 3))
    pixels[20, 140] = [5, 4, 3]
    turn, down = 2 * math.pi * 140.5 / 256, math.pi * 20.5 / 128
    direction = [math.sin(turn) * math.sin(down), math.cos(down), -math.cos(turn) * math.sin(down)]
    solid_angle = 2 * math.pi / 256 * (math.cos(math.pi * 20 / 128) - math.cos(math.pi * 21 / 128))
    sun = brdf.DirectionalLight(direction=direction, intensity=np.array([5, 4, 3]) * solid_angle / math.pi)
    np.testing.assert_allclose(radiance(brdf.EnvironmentMap(pixels), GLOSSY), radiance(sun, GLOSSY), rtol=4e-3)


@pytest.mark.parametrize("samples", [16, 1024])
def test_irradiance_from_above_the_horizon_is_exact(samples: int):
    """Light of a texel comes from its whole solid angle; from its middle it was 5e-5 too bright in a map like this."""
    sky = np.zeros((16, 32, 1))
    sky[:6] = np.random.default_rng(0).uniform(0, 1, (6, 32, 1))
    down = np.linspace(0, math.pi, 17)
    exact = np.diff(np.sin(down) ** 2) / 2 @ np.sum(sky[..., 0], axis=1) * (2 * math.pi / 32) / math.pi
    up = brdf.SurfacePoints.from_normals(np.array([[[0.0, 1.0, 0.0]]]), to_view=(0, 1, 0))
    scene = brdf.Scene(points=up, lights=[brdf.EnvironmentMap(sky, samples=samples)])
    np.testing.assert_allclose(brdf.render(WHITE, scene, precision="float64"), [[[exact]]], rtol=1e-9)


def test_a_wide_texel_shines_from_its_whole_solid_angle():
    texels = np.random.default_rng(3).gamma(0.5, size=(4, 8, 1))
    fine = np.repeat(np.repeat(texels, 32, axis=0), 32, axis=1)
    few, many = (radiance(brdf.EnvironmentMap(each), GLOSSY) for each in (texels, fine))
    np.testing.assert_allclose(few, many, rtol=2e-3)  # a point for each texel is 5 % off


def test_a_bright_texel_is_as_wide_in_a_highlight_as_it_is():
    texel = np.zeros((8, 16, 1))
    texel[3, 8] = 1.0
    fine = brdf.EnvironmentMap(np.kron(texel, np.ones((128, 128, 1))), samples=16384)
    few, many = (radiance(each, brdf.BlinnPhong(k_d=0, k_s=1, n=40)) for each in (brdf.EnvironmentMap(texel), fine))
    np.testing.assert_allclose(few[:2], many[:2], rtol=2e-3)


def test_a_map_of_one_colour_gives_it_to_the_emittance():
    pixels = np.random.default_rng(0).uniform(size=(8, 16, 1)) * np.array([1.0, 0.5, 0.25])
    light = brdf.EnvironmentMap(pixels)
    assert light.pixels.shape[2] == 1
    np.testing.assert_allclose(light.emittance / light.emittance[0], [1, 0.5, 0.25], rtol=1e-6)


def test_a_narrow_highlight_of_a_wide_texel_is_that_of_its_whole_solid_angle():
    """Against a sum over 256 x 256 directions of the texel: at n = 600 the lobe is 2.3 degrees wide, the texel 5.6."""
    pixels, n, place = np.full((32, 64, 1), 1e-6), 600.0, (np.arange(256) + 0.5) / 256
    pixels[6, 33] = 1.0
    both = np.meshgrid(math.pi * (6 + place) / 32, math.pi * (33 + place) / 32)
    down, turn = (one.ravel() for one in both)
    to_light = np.stack([np.sin(turn) * np.sin(down), np.cos(down), -np.cos(turn) * np.sin(down)], axis=-1)
    solid_angle = np.sin(down) * (math.pi / 32 / 256) ** 2
    middle = np.average(to_light, axis=0, weights=solid_angle)
    normal = np.array([middle + shift for shift in ([0, 1.0, 0], [0, 1.0, 0.1], [0.2, 1.0, 0.0])])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    half = to_light + np.array([0.0, 1.0, 0.0])
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    expected = np.maximum(normal @ half.T, 0) ** n @ solid_angle / math.pi
    points = brdf.SurfacePoints.from_normals(normal[None], to_view=(0, 1, 0))
    scene = brdf.Scene(points=points, lights=[brdf.EnvironmentMap(pixels)])
    found = brdf.render(brdf.BlinnPhong(k_d=0.0, k_s=1.0, n=n), scene, precision="float64")
    np.testing.assert_allclose(np.asarray(found)[0, :, 0], expected, rtol=2e-3, atol=1e-4 * expected.max())


def test_negative_texels_are_clamped_and_said():
    pixels = np.ones((4, 8, 3))
    pixels[0, 0] = -1
    with pytest.warns(UserWarning, match="1 texels are negative or not finite"):
        light = brdf.EnvironmentMap(pixels)
    assert np.all(np.asarray(light.pixels) >= 0)


SMOOTH = {
    "spot": brdf.SpotLight(
        position=[0.5, 0.4, 2], direction=[-0.2, -0.2, -1], intensity=3, cutoff_angle=60, exponent=8
    ),
    "rectangle": brdf.RectangleLight(center=CENTER, edge_u=EDGE_U, edge_v=EDGE_V, radiance=2, samples=16),
    "polygon": brdf.PolygonLight(vertices=QUAD, radiance=2, samples=18),
    "sphere": brdf.SphereLight(center=CENTER, radius=0.5, radiance=2, samples=16),
    "setting sphere": brdf.SphereLight(center=[1, 0.2, 0.15], radius=0.5, radiance=2, samples=16),
    "constant": brdf.ConstantEnvironment(radiance=1.0, samples=32),
    "point": brdf.PointLight(position=[0.5, 0.4, 2], intensity=3),
    "directional": brdf.DirectionalLight(direction=[0.5, 0.4, 2], intensity=3),
}


@pytest.mark.parametrize("name", SMOOTH)
def test_gradients_are_central_differences(name: str):
    light = SMOOTH[name]
    fields = [f.name for f in dataclasses.fields(light) if not f.metadata.get("static") and f.name != "triangles"]
    with jax.enable_x64(True):

        def value(light: Light) -> jax.Array:
            return jnp.sum(jnp.sin(1 + brdf.render(GLOSSY, brdf.Scene(points=POINTS, lights=[light]))))

        gradient = eqx.filter_grad(value)(brdf.cast(light, "float64"))
        for field in fields:
            start = np.asarray(getattr(light, field), float)
            for index in np.ndindex(start.shape):
                step = np.zeros(start.shape)
                step[index] = 1e-5
                ends = [
                    float(value(eqx.tree_at(lambda one, f=field: getattr(one, f), light, start + sign * step)))
                    for sign in (1, -1)
                ]
                expected = (ends[0] - ends[1]) / 2e-5
                got = float(np.asarray(getattr(gradient, field))[index])
                assert abs(got - expected) <= 1e-3 * abs(expected) + 1e-8, (field, index, got, expected)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: brdf.SphereLight(center=[0, 0, 0], radius=1, radiance=1, samples=0), "samples: must be between 1"),
        (lambda: brdf.PolygonLight(vertices=[[0, 0, 0], [1, 0, 0]], radiance=1), "vertices: must be three points"),
        (lambda: brdf.PolygonLight(vertices=np.eye(3)[:1].repeat(3, 0), radiance=1), "vertices: span no area"),
        (
            lambda: brdf.PolygonLight(vertices=[[0, 0, 0], [1, 0, 0], [1, 1, 0.2], [0, 1, 0]], radiance=1),
            "vertices: do not lie in one plane",
        ),
        (
            lambda: brdf.SpotLight(position=[0, 0, 1], direction=[0, 0, -1], intensity=1, cutoff_angle=120),
            "cutoff_angle: must be 0 to 90 degrees, or 180",
        ),
        (lambda: brdf.EnvironmentMap(np.zeros((4, 8, 3))), "pixels: are all black"),
    ],
)
def test_what_is_no_light_is_refused(make, words: str):
    with pytest.raises(brdf.InputError) as caught:
        make()
    assert words in str(caught.value)


@pytest.mark.parametrize("kind", [brdf.BlinnPhong, brdf.Phong])
@pytest.mark.parametrize("n", [1.0, 2000.0])
def test_a_sky_that_is_seen_whole_is_that_of_samples_above_each_point(kind: type, n: float):
    """Of which more are taken, and which adds to other lights; from behind a surface has no highlight."""
    camera = brdf.OrthographicCamera(position=[0, 0, 4], target=[0, 0, 0], up=[0, 1, 0], width=2.2, resolution=(16, 16))
    sky, sun = brdf.ConstantEnvironment([1.0, 0.5], samples=4096), brdf.DirectionalLight([1, 1, 1], [0.5])
    ball, material = brdf.Sphere([0, 0, 0], 1), kind(k_d=0.3, k_s=0.5, n=n)
    both = brdf.Scene(camera=camera, shapes=[ball], lights=[sky, sun])
    picture = np.asarray(brdf.render(material, both, precision="float64"))
    sampled = dataclasses.replace(both, visibility=[np.ones((16, 16)), None])
    assert both.sees_whole(sky)
    assert not sampled.sees_whole(sky)
    expected = np.asarray(brdf.render(material, sampled, precision="float64"))
    np.testing.assert_allclose(picture, expected, atol=2e-3 * expected.max())
    each = np.asarray(brdf.render_lights(material, both, precision="float64"))
    np.testing.assert_allclose(each.sum(axis=0), picture, atol=1e-12)
    behind = brdf.SurfacePoints.from_normals(np.array([[[0.0, 0.6, -0.8]]]))
    shown = brdf.render(material, brdf.Scene(points=behind, lights=[sky]), precision="float64")
    np.testing.assert_allclose(shown, 0.3 * np.array([[[1.0, 0.5]]]), atol=1e-6)
