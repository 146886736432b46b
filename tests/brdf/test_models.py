"""The five models: formulas, gates, derivatives, and what a material refuses."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from extra_model import Retroreflector

from brdf import check
from brdf.errors import InputError
from brdf.models import MODELS, BlinnPhong, Lambert, NormalizedBlinnPhong, NormalizedPhong, Phong, SpecularMaterial

UP = np.array([0.0, 0.0, 1.0])
# With one that only the tests have: what is said of a model holds for any that is added.
LOBES = [*(model for model in MODELS.values() if issubclass(model, SpecularMaterial)), Retroreflector]
ALL = [Lambert, *LOBES]
NORMALISED = [model for model in LOBES if model.cosine_weighted]


def make(model, n=20.0, k_s=(0.5, 0.4, 0.3)):
    k = dict(k_a=[0.1, 0.2, 0.3], k_d=[0.3, 0.2, 0.1])
    return model(**k) if model is Lambert else model(**k, k_s=list(k_s), n=n)


def directions(count, seed):
    """Random unit vectors of the upper hemisphere, away from its edge."""
    v = np.random.default_rng(seed).normal(size=(count, 3))
    v[:, 2] = np.abs(v[:, 2]) + 0.1
    return v / np.linalg.norm(v, axis=1, keepdims=True)


def textbook(model, normal, light, view, n):
    """S as the papers write it, in NumPy."""
    n_l, n_v = normal @ light, normal @ view
    if n_l <= 0 or n_v <= 0 or model is Lambert:
        return 0.0
    if model in (Phong, NormalizedPhong):
        cosine = max((2 * n_l * normal - light) @ view, 0.0)
    elif model is Retroreflector:
        cosine = max(light @ view, 0.0)
    else:
        cosine = max(normal @ (light + view) / np.linalg.norm(light + view), 0.0)
    factor = {
        Phong: 1.0,
        Retroreflector: 1.0,
        BlinnPhong: 1.0,
        NormalizedPhong: (n + 2) / 2 * n_l,
        NormalizedBlinnPhong: (n + 2) * (n + 4) / (8 * (2 ** (-n / 2) + n)) * n_l,
    }[model]
    return factor * cosine**n


@pytest.mark.parametrize("model", ALL)
@pytest.mark.parametrize("n", [0.3, 1.0, 25.0, 900.0])
def test_specular_term_and_reflectance_are_those_of_the_papers(model, n):
    material = make(model, n)
    with jax.enable_x64(True):
        normals, lights, views = (directions(50, seed) for seed in (1, 2, 3))
        result = jax.jit(model.specular)(material, normals, lights, views)
        expected = [textbook(model, *vectors, n) for vectors in zip(normals, lights, views, strict=True)]
        np.testing.assert_allclose(result, expected, rtol=1e-11, atol=1e-14)
        f_r = jax.jit(model.reflectance)(material, lights, views)
        k_s = 0 if model is Lambert else material.k_s
        for i in range(50):
            s = textbook(model, UP, lights[i], views[i], n)
            np.testing.assert_allclose(f_r[i], (material.k_d + k_s * s / lights[i, 2]) / np.pi, rtol=1e-11)


@pytest.mark.parametrize("model", LOBES)
def test_specular_is_scale_times_cosine_times_lobe(model):
    with jax.enable_x64(True):
        light, view = directions(20, 4), directions(20, 5)
        weight = light[:, 2] if model.cosine_weighted else 1.0
        parts = model.scale(37.0) * weight * jnp.exp(37.0 * model.log_cosine(UP, light, view))
        np.testing.assert_allclose(make(model, 37.0).specular(UP, light, view), parts, rtol=1e-12, atol=1e-300)


@pytest.mark.parametrize("model", ALL)
def test_no_light_comes_through_the_surface(model):
    sunk = [np.array([np.sqrt(1 - height**2), 0, height]) for height in (0.0, -1e-6, -0.3, -1.0)]
    light = np.array([*sunk, *[UP] * 4, *sunk])
    view = np.array([*[UP] * 4, *sunk, *sunk])
    np.testing.assert_array_equal(make(model, n=0.0).specular(UP, light, view), 0)
    np.testing.assert_array_equal(make(model, n=0.0).reflectance(light, view), 0)


def test_exponent_zero_is_a_constant_lobe():
    light, view = directions(20, 6), directions(20, 7)
    np.testing.assert_allclose(make(BlinnPhong, 0.0).specular(UP, light, view), 1)
    np.testing.assert_allclose(make(NormalizedBlinnPhong, 0.0).specular(UP, light, view), light[:, 2], rtol=1e-6)


@pytest.mark.parametrize("model", [Lambert, *NORMALISED])
@pytest.mark.parametrize("n", [0.0, 3.0, 1e4])
def test_reciprocal_where_promised(model, n):
    with jax.enable_x64(True):
        light, view = directions(200, 8), directions(200, 9)
        reflectance = jax.jit(model.reflectance)
        there, back = (reflectance(make(model, n), *pair) for pair in ((light, view), (view, light)))
        np.testing.assert_allclose(there, back, rtol=1e-9)


@pytest.mark.parametrize("model", NORMALISED)
@pytest.mark.parametrize("n", [0.5, 6.0, 100.0])
def test_what_is_normalised_conserves_energy(model, n):
    report = check(model(k_d=0.0, k_s=1.0, n=n))
    assert report.energy.verdict == "pass", report.energy


# -- derivatives -------------------------------------------------------------------------------------------------------

LEVEL = np.array([1.0, 0.0, 0.0])
SLANT = np.array([0.6, 0.0, 0.8])
CORNERS = {
    "light opposite the view": (UP, LEVEL, -LEVEL),
    "light opposite the view, upright": (UP, UP, -UP),
    "all along the normal": (UP, UP, UP),
    "light at the horizon": (UP, LEVEL, SLANT),
    "view at the horizon": (UP, SLANT, LEVEL),
    "both at the horizon": (UP, LEVEL, np.array([0.0, 1.0, 0.0])),
    "light nearly at the horizon": (UP, np.array([1.0, 0.0, 1e-12]), SLANT),
    "light just above the horizon": (UP, np.array([1.0, 0.0, 1e-30]), np.array([-1.0, 0.0, 1e-30])),
    "light below the horizon": (UP, np.array([0.6, 0.0, -0.8]), SLANT),
    "view below the horizon": (UP, SLANT, np.array([0.6, 0.0, -0.8])),
    "view at a right angle to the mirror direction": (UP, SLANT, np.array([0.8, 0.0, 0.6])),
}


@pytest.mark.parametrize("x64", [False, True])
@pytest.mark.parametrize("model", ALL)
def test_derivatives_are_finite_at_the_corners(model, x64):
    with jax.enable_x64(x64):

        def both(n, k_s, vectors):
            material = model(k_a=0.1, k_d=0.3 * k_s) if model is Lambert else model(k_a=0.1, k_d=k_s, k_s=k_s, n=n)
            return jnp.append(material.reflectance(vectors[1], vectors[2]), material.specular(*vectors))

        cases = [(n, k, name) for n in (0.0, 1e-3, 0.5, 1.0, 1e6) for k in (0.0, 0.5) for name in CORNERS]
        n, k = (jnp.array([case[i] for case in cases]) for i in range(2))
        vectors = jnp.array([CORNERS[name] for _, _, name in cases])
        functions = both, jax.jacfwd(both, argnums=(0, 1, 2)), jax.jacrev(both, argnums=(0, 1, 2))
        for leaf in jax.tree.leaves(jax.jit(jax.vmap(lambda *at: [one(*at) for one in functions]))(n, k, vectors)):
            finite = np.all(np.isfinite(np.asarray(leaf).reshape(len(cases), -1)), axis=1)
            assert np.all(finite), [case for case, good in zip(cases, finite, strict=True) if not good]


@pytest.mark.parametrize("n", [0.5, 5.0, 60.0, 3e3])
@pytest.mark.parametrize("model", ALL)
def test_derivatives_agree_with_differences_and_with_each_other(model, n):
    with jax.enable_x64(True):
        material = jax.tree.map(jnp.asarray, make(model, n))
        leaves, structure = jax.tree.flatten(material)
        sizes = np.cumsum([leaf.size for leaf in leaves])[:-1]

        def value(x):
            """One number of everything: twice three, three, and all numbers of the material."""
            normal, light, view = x[0:3], x[3:6], x[6:9]
            parts = [p.reshape(leaf.shape) for p, leaf in zip(jnp.split(x[9:], sizes), leaves, strict=True)]
            m = jax.tree.unflatten(structure, parts)
            return jnp.append(m.reflectance(light, view), m.specular(normal, light, view))

        # near the peak, where there is something to see; away from kinks
        wide = 1 / np.sqrt(n + 1)
        normal = np.array([0.2 * wide, -0.1 * wide, 1.0])
        light, view = np.array([0.5, 0.2, 0.7]), np.array([-0.5 + 0.3 * wide, -0.2, 0.7 - 0.2 * wide])
        numbers = np.concatenate([np.ravel(leaf) for leaf in leaves])
        x = np.concatenate([*(v / np.linalg.norm(v) for v in (normal, light, view)), numbers])
        forward, backward = jax.jit(jax.jacfwd(value))(x), jax.jit(jax.jacrev(value))(x)
        scale = np.max(np.abs(forward), axis=1, keepdims=True)
        np.testing.assert_allclose(forward / scale, backward / scale, rtol=0, atol=1e-12)
        # fourth-order differences: error h^4 times the fifth derivative, against 1e-16 / h of rounding
        h = 2e-3 * wide * np.where(np.arange(len(x)) < 9, 1.0, np.maximum(1.0, np.abs(x)))
        steps = np.diag(h) * np.array([-2, -1, 1, 2])[:, None, None]
        two_down, down, up, two_up = jax.jit(jax.vmap(value))((x + steps).reshape(-1, len(x))).reshape(4, len(x), -1)
        difference = (8 * (up - down) - (two_up - two_down)).T / (12 * h)
        np.testing.assert_allclose(difference / scale, forward / scale, rtol=0, atol=1e-6)


# -- materials as data -------------------------------------------------------------------------------------------------


def test_models_are_named():
    assert list(MODELS)[:5] == ["lambert", "phong", "blinn-phong", "normalized-phong", "normalized-blinn-phong"]
    assert all(MODELS[name].name == name for name in MODELS)


def test_coefficients_share_their_channels():
    material = BlinnPhong(k_d=[0.1, 0.2, 0.3], k_s=0.5, n=10)
    assert material.k_a.shape == material.k_s.shape == (3,)
    assert material.n.shape == ()
    assert all(leaf.dtype == np.float64 for leaf in jax.tree.leaves(material))
    assert Lambert(k_d=0.5).k_d.shape == (1,)
    assert repr(material) == "BlinnPhong(k_a=[0, 0, 0], k_d=[0.1, 0.2, 0.3], k_s=[0.5, 0.5, 0.5], n=10)"


def test_a_material_is_a_pytree_and_can_be_made_inside_a_transformation():
    def brightness(k_d, n):
        return NormalizedPhong(k_d=k_d, k_s=0.5, n=n).reflectance(UP, UP).sum()

    gradient = jax.jit(jax.grad(brightness, argnums=(0, 1)))(jnp.array([0.1, 0.2]), 10.0)
    np.testing.assert_allclose(gradient[0], 1 / np.pi, rtol=1e-6)
    np.testing.assert_allclose(gradient[1], 2 * 0.5 * 0.5 / np.pi, rtol=1e-6)
    assert len(jax.tree.leaves(make(Phong))) == 4
    many = jax.vmap(lambda n: Phong(k_d=0.1, k_s=0.2, n=n))(jnp.arange(3.0))
    assert many.n.shape == (3,)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (dict(k_d=[0.1, -0.2, 0.3]), "k_d: must be at least 0, got -0.2 in channel 1."),
        (dict(k_s=float("nan")), "k_s: must be finite, got nan."),
        (dict(n=-1), "n: must be at least 0, got -1."),
        (dict(n=[1, 2]), "n: must be one number, got shape (2,). All channels share one exponent."),
        (dict(k_a="red"), "k_a: must be numbers, got 'red'."),
        (dict(k_d=[[0.1]]), "k_d: must be a number per channel, got [[0.1]]."),
        (dict(k_d=[0.1, 0.2]), "k_d: the coefficients differ in their number of channels (k_a 1, k_d 2, k_s 3)."),
    ],
)
def test_what_a_material_refuses(given, message):
    with pytest.raises(InputError, match=re.escape(message)):
        Phong(**(dict(k_d=0.1, k_s=[0.1, 0.2, 0.3], n=10.0) | given))


@pytest.mark.parametrize("model", ALL)
def test_a_missing_coefficient_is_said_of_its_model(model):
    with pytest.raises(InputError, match=rf"^{model.__name__}: missing a required argument: 'k_d'"):
        model(**({} if model is Lambert else dict(k_s=0.5, n=10.0)))


def test_only_lobes_have_an_exponent():
    assert not issubclass(Lambert, SpecularMaterial)
    assert all(issubclass(model, SpecularMaterial) for model in LOBES)
