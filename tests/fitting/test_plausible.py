"""The bounded fit: what it returns passes the check, and no general solver finds better in the same family."""

import numpy as np
import pytest
from scipy.optimize import minimize

import brdf
import fitting
from brdf.models.base import SpecularMaterial
from brdf.precision import working_precision

CAMERA = brdf.OrthographicCamera(position=[0, 0, 4], target=[0, 0, 0], up=[0, 1, 0], width=2.2, resolution=(32, 32))
BALL = brdf.Sphere(center=[0, 0, 0], radius=1)


def random_case(seed: int) -> tuple[np.ndarray, brdf.Scene]:
    """A picture of a material that is plausible or not, classic or normalised, with noise."""
    rng = np.random.default_rng(seed)
    light = brdf.DirectionalLight(direction=rng.normal(size=3) + np.array([0, 0, 2]), intensity=rng.uniform(0.5, 1, 3))
    scene = brdf.Scene(camera=CAMERA, shapes=[BALL], ambient=[0.2] * 3, lights=[light])
    names = ["phong", "blinn-phong", "normalized-phong", "normalized-blinn-phong"]
    model = brdf.MODELS[names[seed % 4]]
    assert issubclass(model, SpecularMaterial)
    k = {name: rng.uniform(0, 1.2, 3) for name in ("k_a", "k_d", "k_s")}
    material = model(**k, n=10 ** rng.uniform(0, 3))
    picture = np.asarray(brdf.render(material, scene, precision="float64"))
    return picture + rng.normal(0, rng.uniform(0.001, 0.05), picture.shape), scene


def best_of_slsqp(target: np.ndarray, scene: brdf.Scene, model: type, starts: int, seed: int) -> float:
    """The least squares of the family under the bounds: k by SLSQP for each channel, n by many starts and a search."""
    seen = np.asarray(scene.surface_points().mask)
    wanted = target[seen]

    def cost(log_n: float) -> float:
        images = brdf.basis_images(model, brdf.cast(scene, "float64"), np.exp(log_n))
        total = 0.0
        for channel in range(3):
            columns = [
                np.asarray(image)[seen][:, channel] for image in (images.ambient, images.diffuse, images.specular)
            ]
            basis = np.stack(columns, axis=1)
            gram, right = basis.T @ basis, basis.T @ wanted[:, channel]
            size = np.trace(gram)

            def square(k, gram=gram, right=right, size=size):
                return (k @ gram @ k - 2 * k @ right) / size

            def slope(k, gram=gram, right=right, size=size):
                return 2 * (gram @ k - right) / size

            bounded = {"type": "ineq", "fun": lambda k: 1 - k[1] - k[2], "jac": lambda k: np.array([0.0, -1.0, -1.0])}
            found = minimize(
                square,
                np.array([0.1, 0.3, 0.3]),
                jac=slope,
                bounds=[(0, None)] * 3,
                constraints=[bounded],
                method="SLSQP",
                options={"ftol": 1e-14, "maxiter": 200},
            )
            total += found.fun * size + float(wanted[:, channel] @ wanted[:, channel])
        return total

    with working_precision("float64"):
        rng = np.random.default_rng(seed)
        grid = np.sort(rng.uniform(np.log(0.1), np.log(1e4), starts))
        costs = [cost(log_n) for log_n in grid]
        low = grid[max(int(np.argmin(costs)) - 1, 0)]
        high = grid[min(int(np.argmin(costs)) + 1, starts - 1)]
        fine = [cost(log_n) for log_n in np.linspace(low, high, starts)]
    return min(*costs, *fine)


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.filterwarnings("ignore:Values in x were outside bounds:RuntimeWarning")  # SciPy's own, from inside SLSQP
def test_it_passes_the_check_and_no_solver_does_better(seed: int):
    target, scene = random_case(seed)
    name = ["normalized-phong", "normalized-blinn-phong"][seed // 4 % 2]
    result = fitting.fit(target, scene, model=name, plausible=True, precision="float64")
    assert brdf.check(result.material).plausible
    rendered = np.asarray(brdf.render(result.material, scene, precision="float64"))
    seen = np.asarray(scene.surface_points().mask)
    cost = float(np.sum((rendered - target)[seen] ** 2))
    assert cost <= 1.001**2 * best_of_slsqp(target, scene, type(result.material), 24, seed)


def test_auto_chooses_among_the_plausible_forms():
    target, scene = random_case(3)
    result = fitting.fit(target, scene, plausible=True)
    assert result.material.name in ("lambert", "normalized-phong", "normalized-blinn-phong")
    assert brdf.check(result.material).plausible


def test_a_plausible_picture_is_fitted_as_without_the_bound():
    _, scene = random_case(0)
    material = brdf.NormalizedPhong(k_a=[0.1] * 3, k_d=[0.3] * 3, k_s=[0.4] * 3, n=40)
    target = np.asarray(brdf.render(material, scene, precision="float64"))
    bounded, free = (
        fitting.fit(target, scene, model="normalized-phong", plausible=one, precision="float64")
        for one in (True, False)
    )
    assert bounded.material.n == free.material.n
    assert not any("held at 1" in warning for warning in bounded.warnings)


def test_a_bright_lambertian_surface_ends_at_the_bound():
    _, scene = random_case(0)
    target = np.asarray(brdf.render(brdf.Lambert(k_d=[1.3, 0.5, 0.2]), scene, precision="float64"))
    result = fitting.fit(target, scene, model="lambert", plausible=True, precision="float64")
    assert result.material.k_d[0] == pytest.approx(1, abs=1e-12)
    np.testing.assert_allclose(result.material.k_d[1:], [0.5, 0.2], rtol=1e-9)
    assert any("held at 1 in channel red" in warning for warning in result.warnings)


def test_a_classic_form_is_refused():
    target, scene = random_case(0)
    with pytest.raises(brdf.InputError, match="phong is neither reciprocal nor energy conserving"):
        fitting.fit(target, scene, model="phong", plausible=True)


def test_what_moves_along_the_bound_is_not_differentiated_as_if_it_were_free():
    scene = brdf.Scene(camera=CAMERA, shapes=[BALL], lights=[brdf.DirectionalLight([0.4, 0.5, 0.8], [1.0, 1.0, 1.0])])
    bright = brdf.NormalizedBlinnPhong(k_d=[0.8, 0.3, 0.2], k_s=0.5, n=10)
    target = np.asarray(brdf.render(bright, scene, precision="float64"))
    result = fitting.fit(target, scene, model="normalized-blinn-phong", plausible=True)
    for ask in (
        lambda: fitting.sensitivity(result, lambda s: (s[0].lights[0].intensity,)),
        lambda: fitting.next_light(result),
    ):
        with pytest.raises(brdf.InputError, match=r"result: has a bound: k_d \+ k_s is held at 1"):
            ask()


@pytest.mark.parametrize("noise", [0.0, 1.0])
def test_what_codes_say_breaks_no_bound(noise: float):
    """What the likelihood of rounded values found without the bound was told in its place."""
    light = brdf.DirectionalLight([0.3, 0.4, 0.8], 0.3)
    scene = brdf.Scene(camera=CAMERA, shapes=[BALL], lights=[light])
    shown = 255 * np.asarray(brdf.render(brdf.NormalizedBlinnPhong(k_d=0.6, k_s=0.5, n=12), scene, precision="float64"))
    codes = np.clip(np.rint(shown + noise * np.random.default_rng(0).normal(size=shown.shape)), 0, 255).astype(np.uint8)
    result = fitting.fit(codes, scene, model="normalized-blinn-phong", plausible=True)
    material = result.material
    assert isinstance(material, SpecularMaterial)
    np.testing.assert_allclose(np.add(material.k_d, material.k_s), 1.0, atol=1e-9)
    assert brdf.check(material).plausible
    assert any("held at 1" in words for words in result.warnings)
