"""How a fitted material moves when something that the fit took as known moves: implicit differentiation.

At the optimum x*(p) the gradient of the cost C(x, p) by the unknowns x is 0, whatever the known numbers p are. The
implicit function theorem (Dini 1878; for fits: Griewank and Walther, "Evaluating Derivatives", SIAM 2008, chapter 15)
turns that into

    dx*/dp = -(d²C/dx²)^-1 d²C/dx dp,

with the whole Hessian, not Gauss and Newton's: where the model does not explain the picture, the residual bends the
cost. Nothing of the search is differentiated, and no step size is chosen. Numbers at their bound stay there.

Use it to know what an error of a light's direction does to the exponent, or as the derivative of a fit inside a larger
optimisation.
"""

import dataclasses
import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

import brdf
from brdf.checks import instance
from brdf.precision import working_precision
from brdf.rendering import basis_columns
from fitting.joint_problem import QUICKLY_COMPILED, Picture, chosen_leaves, residuals
from fitting.progress import waiting
from fitting.result import FitResult, of_material_alone
from fitting.solver.nnls import inverse_diagonal, scaled_inverse
from fitting.solver.tied import join_channels
from fitting.uncertainty.intervals import widened

NEWTON_STEPS = 3
# Of each picture: an error of an error is no concern.
MOST_PIXELS = 1 << 14
# Of the largest eigenvalue of the Hessian: a smaller one determines nothing.
DEPENDENT = 1e-13


@dataclasses.dataclass(frozen=True)
class Sensitivity:
    """Derivatives of the fitted numbers by one known leaf of shape (S...).

    Attributes:
        k_a: of the ambient coefficient, (C, S...); 0 where it is at its bound or not determined.
        k_d: of the diffuse coefficient, (C, S...).
        k_s: of the specular coefficient, (C, S...).
        n: of the exponent, (S...).

    Example:
        >>> result = fitting.fit(brdf.read_image("target.exr"), brdf.Scene.load("scene.toml"), model="blinn-phong")
        >>> (by_direction,) = fitting.sensitivity(result, lambda scenes: (scenes[0].lights[0].direction,))
        >>> by_direction.k_d.shape  # of each channel, by each component
        (3, 3)
    """

    k_a: Float[np.ndarray, " channels *leaf"]
    k_d: Float[np.ndarray, " channels *leaf"]
    k_s: Float[np.ndarray, " channels *leaf"]
    n: Float[np.ndarray, " *leaf"]


def sensitivity(result: FitResult, by: Callable[[list[brdf.Scene]], Any]) -> tuple[Sensitivity, ...]:
    """The derivative of a fitted material by what the fit took as known about the scenes.

    Args:
        result: of `fitting.fit` with the squared loss, whose sum of squares is differentiated; masks and weights are
            respected. A clipped value, of which the fit knows that it is no less, tells nothing here.
        by: from the list of scenes to a leaf of theirs or several, for example
            ``lambda scenes: (scenes[0].lights[0].direction,)``. A direction's own length changes nothing: the
            derivative along it is 0.

    Returns:
        One for each leaf.

    Raises:
        InputError: where the loss is another, ``by`` names no leaf, or the picture does not determine the numbers.

    Example:
        >>> result = fitting.fit(brdf.read_image("target.exr"), brdf.Scene.load("scene.toml"), model="blinn-phong")
        >>> (by_direction,) = fitting.sensitivity(result, lambda scenes: (scenes[0].lights[0].direction,))
        >>> by_direction.n.shape
        (3,)
    """
    instance("result", result, FitResult, "Give what fitting.fit returns")
    of_material_alone(result)
    if not callable(by):
        what = f"must be a function, got {by!r}"
        raise brdf.InputError("by", what, "Write lambda scenes: (scenes[0].lights[0].direction,)")
    _check_loss(result)
    unknowns = _unknowns(result)
    count = len(unknowns)
    with working_precision("float64"), waiting("differentiating the fit"):
        content = jax.tree.map(jnp.array, brdf.cast((result.material, list(result.scenes)), "float64"))
        flat = [target.reshape(-1, target.shape[-1]) for target in result.targets]
        pictures = brdf.cast(list(zip(flat, map(np.ravel, result.weighed), strict=True)), "float64")
        own = {id(leaf): index for index, leaf in enumerate(jax.tree.leaves(content[1]))}
        leaves = chosen_leaves("by", by, {"scenes": content[1]}, "(scenes[0].lights[0].direction,)")
        curvature = partial(_curvature, content, unknowns, pictures, places=tuple(own[id(leaf)] for leaf in leaves))
        vector = np.concatenate([np.zeros(count), *(np.ravel(np.asarray(leaf)) for leaf in leaves)])
        slope, rows = map(np.asarray, curvature(vector))
        # A fit in float32 stops a little beside the stationary point; Newton's steps go there.
        for _ in range(NEWTON_STEPS):
            vector[:count] -= _inverse(rows[:, :count]) @ slope
            slope, rows = map(np.asarray, curvature(vector))
    moves = np.zeros((3 * result.material.k_d.size + 1, rows.shape[1] - count))
    moves[: unknowns.shape[1]] = -unknowns.T @ _inverse(rows[:, :count]) @ rows[:, count:]
    found, ends = [], np.cumsum([leaf.size for leaf in leaves])
    for leaf, columns in zip(leaves, np.split(moves, ends[:-1], axis=1), strict=True):
        rows = columns.reshape(-1, *leaf.shape)
        k_a, k_d, k_s = np.split(rows[:-1], 3)
        found.append(Sensitivity(k_a, k_d, k_s, rows[-1]))
    return tuple(found)


@partial(jax.jit, static_argnames="places", compiler_options=QUICKLY_COMPILED)
def _curvature(
    content: tuple[brdf.Material, list[brdf.Scene]],
    unknowns: Array,
    pictures: Sequence[Picture],
    vector: Array,
    places: tuple[int, ...],
) -> tuple[Array, Array]:
    """The gradient of half the sum of squares by the unknowns, (U,), and how it changes along all numbers, (V, U).

    The unknowns are what each moves of the material's numbers, (U, S); the vector holds them, then the numbers of the
    leaves of the scenes at ``places``.
    """
    count, (numbers, of_numbers) = len(unknowns), ravel_pytree(content[0])
    leaves, shape = jax.tree.flatten(content[1])
    _, of_known = ravel_pytree([leaves[index] for index in places])

    def cost(vector: Array) -> Array:
        known = dict(zip(places, of_known(vector[count:]), strict=True))
        lit = jax.tree.unflatten(shape, [known.get(index, leaf) for index, leaf in enumerate(leaves)])
        return 0.5 * jnp.sum(residuals(of_numbers(numbers + vector[:count] @ unknowns), lit, pictures) ** 2)

    slope, along = jax.linearize(jax.grad(cost), vector)
    return slope[:count], jax.lax.map(along, jnp.eye(count, vector.size))


def _check_loss(result: FitResult) -> None:
    if result.loss != "squared":
        raise brdf.InputError("result", f"must be of the squared loss, got {result.loss}", "Fit without a loss")


def _unknowns(result: FitResult) -> Float[np.ndarray, "U S"]:
    """What each unknown moves of the material's numbers.

    A grey highlight is one number, and the only way for all channels to agree to the last digit.
    """
    material, rows = result.material, {}
    size, k_s = sum(map(np.size, jax.tree.leaves(material))), np.asarray(getattr(material, "k_s", np.zeros(1)))
    for one in result.free_parameters:
        grey = one.name == "k_s" and np.all(k_s == k_s[0])
        row = rows.setdefault(one.name if grey else one.key, np.zeros(size))
        row[one.place(material.k_d.size)] = 1.0
    return np.array(list(rows.values()))


def _inverse(hessian: Float[np.ndarray, "U U"]) -> Float[np.ndarray, "U U"]:
    """Scaled by the diagonal, since coefficients and exponent differ by orders of magnitude in what they move."""
    if not np.all(np.isfinite(hessian)) or np.any(np.diag(hessian) <= 0):
        raise brdf.InputError("result", "lies at no minimum that the picture determines", "Hold or mask less")
    if np.any(np.isinf(inverse_diagonal(hessian, DEPENDENT))):
        raise brdf.InputError("result", "is determined only in combinations of its numbers", "Fit a simpler model")
    return scaled_inverse(hessian, DEPENDENT)


def with_light_errors(result: FitResult, degrees: Sequence[float]) -> FitResult:
    """A fit whose errors hold those of its lights, to first order and as if they were independent of the picture's.

    Of pictures under one distant light each, whose direction has a standard error in degrees, the root mean square of
    the angle. What the turns of a light change of its picture the numbers follow by least squares, as far as some
    pixels tell; refused where these do not determine the numbers, or the loss is another.
    """
    _check_loss(result)
    if not result.free_parameters:
        return result
    own, channels = _unknowns(result), result.material.k_d.size
    unknowns = np.zeros((len(own), 3 * channels + 1))  # Lambert's law has no highlight
    unknowns[:, : own.shape[1]] = own
    names = "k_a", "k_d", "k_s"
    coefficients = np.array([getattr(result.material, name, np.zeros(channels)) for name in names], np.float64)
    gram, products = np.zeros((channels, 4, 4)), []
    with working_precision("float64"), waiting("differentiating the fit"):
        material = brdf.cast(result.material, "float64")
        for whole, weights, error in zip(result.scenes, result.weighed, degrees, strict=True):
            weight = weights.reshape(math.prod(whole.resolution), -1)
            pixel = np.flatnonzero(np.any(weight > 0, axis=1))
            some = pixel[np.linspace(0, pixel.size - 1, min(pixel.size, MOST_PIXELS)).astype(int)]
            scene = brdf.some_pixels(whole, some, precision="float64")
            shown = _columns(material, scene, np.zeros(3))
            weighted = shown * weight[some] * (pixel.size / some.size)
            gram += np.einsum("ipc,jpc->cij", weighted, shown)
            light: Any = scene.lights[0]
            direction = np.asarray(light.direction, np.float64)
            # Two small turns of it share the angle; it does not matter how long it is.
            length = np.linalg.norm(direction) * math.radians(error) / math.sqrt(2)
            for turn in np.linalg.svd(direction[None])[2][1:] * length:
                change = (_columns(material, scene, turn) - _columns(material, scene, -turn))[:3] / 2
                products.append(np.einsum("ipc,jpc,jc->ci", weighted, change, coefficients))
    joined = [join_channels(gram, product, np.zeros(channels), coefficients[2]) for product in products]
    inverse = unknowns.T @ _inverse(unknowns @ joined[0].gram @ unknowns.T) @ unknowns
    off = np.linalg.norm([inverse @ one.product for one in joined], axis=0).tolist()
    parameters = tuple(widened(one, off[one.place(channels)]) for one in result.parameters)
    return dataclasses.replace(result, parameters=parameters)


def _columns(material: brdf.Material, scene: brdf.Scene, turn: Float[np.ndarray, "3"]) -> Float[np.ndarray, "4 P C"]:
    """What each coefficient, and the exponent but for a factor, moves of some pixels, the light turned."""
    light: Any = scene.lights[0]
    light = dataclasses.replace(light, direction=np.asarray(light.direction, np.float64) + turn)
    return np.asarray(basis_columns(material, dataclasses.replace(scene, lights=(light,))))[:, 0]
