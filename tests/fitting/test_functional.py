"""The fit as a pure function: as `fitting.fit` finds it, batched, jitted, and its derivatives against differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_ball import AMBIENT, BALL, CAMERA, ball_scene, pictured

import brdf
from fitting import fit, functional

MATERIAL = brdf.BlinnPhong(k_a=[0.2, 0.1, 0.15], k_d=[0.5, 0.4, 0.3], k_s=[0.3, 0.3, 0.4], n=35.0)
PICTURES = np.stack([pictured(MATERIAL, ball_scene(), 0.01, seed) for seed in range(3)])


@pytest.fixture(autouse=True)
def double():
    with jax.enable_x64(True):
        yield


def numbers(material: brdf.Material) -> np.ndarray:
    return np.concatenate([np.ravel(getattr(material, key)) for key in ("k_a", "k_d", "k_s", "n")])


def test_batched_and_jitted_it_finds_what_fit_finds_with_its_errors():
    found = jax.jit(jax.vmap(lambda picture: functional.fit(picture, ball_scene())))(jnp.asarray(PICTURES))
    for index, picture in enumerate(PICTURES):
        expected = fit(picture, ball_scene(), model="blinn-phong", precision="float64")
        one = jax.tree.map(lambda leaf, index=index: leaf[index], found)
        np.testing.assert_allclose(numbers(one.material), numbers(expected.material), rtol=1e-8)
        errors = np.concatenate([np.ravel(error) for error in one.solution.errors])
        np.testing.assert_allclose(errors, [parameter.error for parameter in expected.parameters], rtol=1e-5)


@pytest.mark.parametrize("kind", [brdf.NormalizedPhong, brdf.Lambert])
def test_other_models_weights_and_values_that_do_not_count(kind: type[brdf.Material]):
    weight = np.ones(PICTURES[0].shape[:2])
    weight[:, :20] = 0
    weight[:, 30:] = 0.01
    own = {key: value for key, value in vars(MATERIAL).items() if key in kind.__dataclass_fields__}
    picture = np.where(weight[..., None] > 0, pictured(kind(**own), ball_scene(), 0.01, 0), np.nan)
    expected = fit(picture, ball_scene(), model=kind.name, precision="float64", weight=weight)
    found = functional.fit(picture, ball_scene(), kind, weight=weight)
    for key, value in vars(expected.material).items():
        np.testing.assert_allclose(getattr(found.material, key), value, rtol=1e-7)
    # Noise is alike in all pixels, whatever their weights: errors were half as large.
    errors = np.concatenate([np.ravel(one) for one in found.solution.errors])
    stated = [one.error for one in expected.parameters]
    np.testing.assert_allclose(errors[:6], stated[:6], rtol=0.1)
    if kind is brdf.NormalizedPhong:
        np.testing.assert_allclose(errors[-1], stated[-1], rtol=0.1)


def test_derivatives_by_picture_and_light_are_those_of_differences():
    direction = jnp.array([0.5, 0.6, 0.7])

    def ravelled(moved, scaled):
        light = brdf.DirectionalLight(direction=direction + moved, intensity=jnp.array([1.0, 0.8, 0.6]))
        scene = brdf.Scene(camera=CAMERA, shapes=[BALL], ambient=AMBIENT, lights=[light])
        found, solution = functional.fit(PICTURES[0] * (1 + scaled * pattern), scene)
        return jnp.concatenate([found.k_a, found.k_d, found.k_s, found.n[None], *map(jnp.ravel, solution.errors)])

    rng = np.random.default_rng(1)
    pattern, mixture, along = rng.standard_normal(PICTURES[0].shape), rng.standard_normal(20), rng.standard_normal(4)

    def mixed(known):
        return mixture @ ravelled(known[:3], known[3])

    step = 1e-5
    value = jax.jit(mixed)
    difference = (value(step * along) - value(-step * along)) / (2 * step)
    np.testing.assert_allclose(jax.jit(jax.grad(mixed))(jnp.zeros(4)) @ along, difference, rtol=1e-5)


def test_what_no_light_reaches_stays_at_its_bound():
    matt = jnp.asarray(pictured(brdf.Lambert(k_d=[0.5, 0.4, 0.3]), ball_scene(ambient=None)))

    def fitted(scale):
        return functional.fit(scale * matt, ball_scene(ambient=None)).material

    found, moves = jax.jvp(fitted, (1.0,), (1.0,))
    np.testing.assert_allclose(found.k_d, [0.5, 0.4, 0.3], rtol=1e-9)
    np.testing.assert_allclose(moves.k_d, [0.5, 0.4, 0.3], rtol=1e-9)
    np.testing.assert_allclose([*found.k_s, *found.k_a, *moves.k_a], 0, atol=1e-12)


def test_of_two_valleys_the_lower_one_and_bounds_of_the_exponent():
    cosine = jnp.linspace(0, 1, 400)[:, None] ** 0.1
    target = 0.2 * cosine**3 + 0.5 * cosine**900
    # Two highlights, and a model of one: the sum of squares has a valley at each.
    found = functional.solve(target, jnp.zeros_like(cosine), lambda n: cosine**n)
    n = np.geomspace(0.1, 1e6, 4000)[:, None]
    lobes = np.asarray(cosine)[:, 0] ** n
    costs = np.sum(np.asarray(target) ** 2) - (lobes @ np.asarray(target)[:, 0]) ** 2 / np.sum(lobes**2, axis=1)
    assert float(found.cost[0]) <= costs.min() + 1e-12
    single = functional.solve(target.astype(np.float32), 0 * cosine, lambda n: cosine**n)
    assert single.k_s.dtype == np.float32
    np.testing.assert_allclose(single.n, found.n, rtol=1e-4)
    held = functional.solve(0.5 * cosine**30, cosine, lambda n: cosine**n, n_range=(50.0, 1e3))
    np.testing.assert_allclose(held.n, 50, rtol=1e-12)


def test_where_no_pixel_counts_numbers_and_derivatives_are_finite():
    def found(picture: jax.Array, weight: jax.Array) -> jax.Array:
        fitted = functional.fit(picture, ball_scene(), weight=weight)
        return jnp.concatenate([jnp.ravel(leaf) for leaf in jax.tree.leaves(fitted)])

    given = jnp.asarray(PICTURES[0]), jnp.zeros(PICTURES[0].shape[:2])
    values, back = jax.vjp(found, *given)
    assert np.all(np.isfinite(values))
    assert all(np.all(np.isfinite(slope)) for slope in back(jnp.ones_like(values)))


def test_errors_have_derivatives_where_no_pixel_counts():
    cosine = jnp.linspace(0.3, 1.0, 50)[:, None]
    target = 0.3 * cosine + 0.6 * cosine**20

    def error(weight: jax.Array) -> jax.Array:
        return functional.solve(target, cosine, lambda n: cosine**n, weight=weight).errors[1][0]

    assert np.all(np.isfinite(jax.grad(error)(jnp.zeros(50))))
