"""Sums of channels that err together, against all pixels at once."""

import jax
import numpy as np

import brdf
from benchmarks.truth import ball
from brdf.rendering import basis
from fitting.channel_errors import coupled, each_alone, precision_of, residuals
from fitting.solver.normal_equations import Picture
from fitting.solver.profile import search


def test_scores_and_hessian_are_those_of_generalised_least_squares():
    one, random = ball(3, channels=3, size=24), np.random.default_rng(0)
    scene = one.scene()
    with jax.enable_x64(True):
        points = brdf.cast(scene, "float64").surface_points()
        images = basis(brdf.Phong, brdf.cast(scene, "float64"), points=points)
        target = np.asarray(one.drawn().reshape(-1, 3) + 0.01 * random.standard_normal((24 * 24, 3)))
        weight = random.uniform(0.5, 2.0, target.shape) * np.asarray(points.mask).reshape(-1, 1)
        picture = Picture(jax.numpy.asarray(target), images.diffuse, images.lobe, jax.numpy.asarray(weight))
        optimum = search([picture])
        left = residuals(picture, optimum)
        places = [(np.arange(24 * 24), 24)]
        precision = precision_of([left], places, float(np.count_nonzero(weight) / 3), 1e-6)
        said = coupled([picture], precision, optimum.x, np.array([np.log(optimum.n)]))[0].joined(optimum.x, optimum.n)
        columns, alone = picture.columns(optimum.n), each_alone(picture, left, precision, optimum)
    columns[3] *= optimum.x[2]
    jacobian = np.zeros((len(target), 3, 10))
    for c in range(3):
        jacobian[:, c, [c, 3 + c, 6 + c, 9]] = (columns[..., c] * np.sqrt(weight[:, c])).T
    whole = np.einsum("pcu,cd,pdv->uv", jacobian, precision, jacobian)
    score = np.einsum("pcu,cd,pd->u", jacobian, precision, left)
    base = np.append(optimum.x.ravel(), 0.0)
    np.testing.assert_allclose(said.gram, whole, rtol=1e-9, atol=1e-9 * np.max(whole))
    np.testing.assert_allclose(said.product - said.gram @ base, score, rtol=1e-7, atol=1e-9 * np.max(said.product))
    # Channel by channel, the working targets give the same score.
    again = np.einsum("pcu,pc->u", jacobian, residuals(alone, optimum) * np.sqrt(np.diag(precision)))
    np.testing.assert_allclose(again, score, rtol=1e-9, atol=1e-9 * np.max(said.product))


def test_errors_in_common_are_told_from_those_of_each_channel():
    random, places = np.random.default_rng(1), [(np.arange(128 * 128), 128)]
    colour = np.kron(random.standard_normal((8 * 8, 2)).reshape(8, 8, 2), np.ones((16, 16, 1))).reshape(-1, 2)
    bright = 0.5 * random.standard_normal(128 * 128)
    left = np.column_stack([bright + colour[:, 0], bright - colour[:, 0] - colour[:, 1], bright + colour[:, 1]])
    covariance = np.linalg.inv(precision_of([left], places, len(left), 0.0))
    # The mean of the channels is free of the colours' errors; those go together over 256 pixels.
    grey = np.ones(3) / 3
    assert 0.5 < grey @ covariance @ grey / 0.25 < 2
    apart = np.array([1.0, 0.0, -1.0])
    assert apart @ covariance @ apart > 50
