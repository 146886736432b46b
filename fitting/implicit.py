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

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import brdf
from brdf.checks import instance
from brdf.precision import working_precision
from fitting.joint_problem import JointProblem, joint_problem
from fitting.progress import waiting
from fitting.result import FitResult, of_material_alone
from fitting.solver.nnls import inverse_diagonal, scaled_inverse

NEWTON_STEPS = 3
# Of the largest eigenvalue of the Hessian: a smaller one determines nothing.
DEPENDENT = 1e-13


@dataclass(frozen=True)
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


def sensitivity(result: FitResult, by: Callable[[list[brdf.Scene]], Sequence[Any]]) -> tuple[Sensitivity, ...]:
    """The derivative of a fitted material by what the fit took as known about the scenes.

    Args:
        result: of `fitting.fit` with the squared loss, whose sum of squares is differentiated; masks, weights and
            clipped pixels are respected.
        by: from the list of scenes to their leaves, for example ``lambda scenes: (scenes[0].lights[0].direction,)``.
            A direction's own length changes nothing: the derivative along it is 0.

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
        came = f"must be a function, got {by!r}"
        raise brdf.InputError("by", came, "Write lambda scenes: (scenes[0].lights[0].direction,)")
    if result.loss != "squared":
        raise brdf.InputError("result", f"must be of the squared loss, got {result.loss}", "Fit without a loss")
    leaves = by(list(result.scenes))
    if not isinstance(leaves, Sequence) or not leaves or not all(hasattr(leaf, "shape") for leaf in leaves):
        raise brdf.InputError("by", "names no leaf of the scenes", "Return the leaves to differentiate by")
    names = list(dict.fromkeys(one.name for one in result.free_parameters))
    with working_precision("float64"), waiting("differentiating the fit"):
        start = brdf.cast((result.material, list(result.scenes)), "float64")
        targets = [jnp.asarray(target, jnp.float64).reshape(-1, target.shape[-1]) for target in result.targets]
        weights: list[Array | None] = [jnp.asarray(weight, jnp.float64).ravel() for weight in result.weighed]

        def freed(material: brdf.Material, scenes: list[brdf.Scene]) -> tuple[Any, ...]:
            return (*(getattr(material, name) for name in names), *by(scenes))

        try:
            problem = joint_problem(start, freed, targets, weights)
        except brdf.InputError as error:
            raise brdf.InputError("by", error.what, "Return leaves of the scenes, each once") from None
        vector = np.array(problem.start())
        blocks = [np.arange(vector.size)[leaf.numbers] for leaf in problem.freed]
        index, known = dict(zip(names, blocks, strict=False)), blocks[len(names) :]
        unknowns = _unknowns(result, index, vector.size)
        # A fit in float32 stops a little beside the stationary point; Newton's steps go there.
        hessian = np.eye(len(unknowns))
        for _ in range(NEWTON_STEPS):
            gradient, rows = _curvature(problem, jnp.asarray(vector), jnp.asarray(unknowns))
            hessian = np.asarray(rows) @ unknowns.T
            vector -= unknowns.T @ _solve(hessian, unknowns @ np.asarray(gradient)[:, None])[:, 0]
        directions = np.eye(vector.size)[np.concatenate(known)]
        _, rows = _curvature(problem, jnp.asarray(vector), jnp.asarray(directions))
    moves = -unknowns.T @ _solve(hessian, unknowns @ np.asarray(rows).T)
    if "n" in index:
        moves[index["n"]] *= np.exp(vector[index["n"], None])
    channels: tuple[int, ...] = result.material.k_d.shape
    sizes, found = dict.fromkeys(("k_a", "k_d", "k_s"), channels) | {"n": ()}, []
    for leaf, block in zip(leaves, known, strict=True):
        parts = {key: np.zeros((*size, *leaf.shape)) for key, size in sizes.items()}
        for key, place in index.items():
            parts[key] = moves[np.ix_(place, block - known[0][0])].reshape(parts[key].shape)
        found.append(Sensitivity(**parts))
    return tuple(found)


@eqx.filter_jit
def _curvature(problem: JointProblem, vector: Array, directions: Array) -> tuple[Array, Array]:
    """The gradient of half the sum of squares by all numbers, and how it changes along each direction."""
    gradient = jax.grad(lambda vector: 0.5 * jnp.sum(problem.residuals(vector) ** 2))
    found, along = jax.linearize(gradient, vector)
    return found, jax.lax.map(along, directions)


def _unknowns(result: FitResult, index: dict[str, np.ndarray], size: int) -> Float[np.ndarray, "U S"]:
    """What each unknown moves of all numbers.

    A grey highlight is one number, and the only way for all channels to agree to the last digit.
    """
    k_s = np.asarray(getattr(result.material, "k_s", np.zeros(1)))
    grey = bool(np.all(k_s == k_s[0]))
    rows = {}
    for one in result.free_parameters:
        is_shared = one.channel is None or (grey and one.name == "k_s")
        place = index[one.name] if is_shared else index[one.name][one.channel]
        rows[one.name if is_shared else one.key] = np.isin(np.arange(size), place).astype(float)
    return np.array(list(rows.values()))


def _solve(hessian: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Scaled by the diagonal, since coefficients and exponent differ by orders of magnitude in what they move."""
    if not np.all(np.isfinite(hessian)) or np.any(np.diag(hessian) <= 0):
        raise brdf.InputError("result", "lies at no minimum that the picture determines", "Hold or mask less")
    if np.any(np.isinf(inverse_diagonal(hessian, DEPENDENT))):
        raise brdf.InputError("result", "is determined only in combinations of its numbers", "Fit a simpler model")
    return scaled_inverse(hessian, DEPENDENT) @ right
