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
import jax.flatten_util
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import brdf
from brdf.precision import working_precision
from fitting.result import FitResult

NEWTON_STEPS = 3


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
        result: of `fitting.fit` with the squared loss and without weights; masks and clipped pixels are respected.
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
    if result.loss != "squared":
        raise brdf.InputError("result", f"must be of the squared loss, got {result.loss}", "Fit without a loss")
    scenes = list(result.scenes)
    leaves = tuple(by(scenes))
    if not leaves or not all(hasattr(leaf, "shape") for leaf in leaves):
        raise brdf.InputError("by", "names no leaf of the scenes", "Return the leaves to differentiate by")
    with working_precision("float64"):
        scenes = brdf.cast(scenes, "float64")
        known, unravel = jax.flatten_util.ravel_pytree(tuple(by(scenes)))
        numbers, unravel_numbers, design, index = _unknowns(result)
        vector = np.linalg.pinv(design) @ numbers
        # By arguments, or the pictures would be constants of the program.
        pictures = [
            (jnp.asarray(np.where(counted[..., None], target, 0.0), jnp.float64), jnp.asarray(counted))
            for target, counted in zip(result.targets, result.counted, strict=True)
        ]

        def cost(vector: Array, known: Array, pictures: Any) -> Array:
            values = unravel_numbers(jnp.where(np.any(design, axis=1), design @ vector, numbers))
            material = type(result.material)(**{key: jnp.exp(v) if key == "n" else v for key, v in values.items()})
            moved = eqx.tree_at(lambda scenes: tuple(by(scenes)), scenes, unravel(known))
            total = jnp.zeros(())
            for scene, (target, counted) in zip(moved, pictures, strict=True):
                residual = jnp.where(counted[..., None], brdf.render(material, scene) - target, 0)
                total = total + 0.5 * jnp.sum(residual * residual)
            return total

        def derivatives(vector: Array, known: Array, pictures: Any, *, by_known: bool) -> tuple[Array, Array]:
            """The gradient by the unknowns, and its derivative by the unknowns or by what is known, row by row."""
            gradient = jax.grad(cost)
            if by_known:
                found, along = jax.linearize(lambda known: gradient(vector, known, pictures), known)
            else:
                found, along = jax.linearize(lambda vector: gradient(vector, known, pictures), vector)
            return found, jax.lax.map(along, jnp.eye(known.size if by_known else vector.size))

        compiled = eqx.filter_jit(derivatives)
        hessian = np.eye(vector.size)
        # A fit in float32 stops a little beside the stationary point; Newton's steps go there.
        for _ in range(NEWTON_STEPS):
            gradient, hessian = (np.asarray(a) for a in compiled(jnp.asarray(vector), known, pictures, by_known=False))
            vector = vector - _solve(hessian, gradient[:, None])[:, 0]
        rows = np.asarray(compiled(jnp.asarray(vector), known, pictures, by_known=True)[1])
    moves = -design @ _solve(hessian, rows.T)
    if "n" in index:
        moves[index["n"]] *= np.exp(design @ vector)[index["n"], None]
    channels = len(index["k_d"])
    found, ends = [], np.cumsum([0, *(int(np.prod(leaf.shape)) for leaf in leaves)])
    for leaf, start, end in zip(leaves, ends[:-1], ends[1:], strict=True):
        parts = {key: np.zeros((channels, *leaf.shape)) for key in ("k_a", "k_d", "k_s")}
        parts |= {key: moves[place, start:end].reshape(-1, *leaf.shape) for key, place in index.items()}
        found.append(Sensitivity(**parts | {"n": parts["n"][0] if "n" in parts else np.zeros(leaf.shape)}))
    return tuple(found)


def _unknowns(result: FitResult) -> tuple[np.ndarray, Callable[[Array], Any], np.ndarray, dict[str, np.ndarray]]:
    """The material's numbers as one vector, n by its logarithm: how to undo that, what each unknown moves, and where.

    A grey highlight is one number, and the only way for all channels to agree to the last digit.
    """
    material = {key: np.asarray(value, np.float64) for key, value in vars(result.material).items() if value is not None}
    free = [(parameter.name, parameter.channel) for parameter in result.free_parameters]
    if "n" in material:
        # Of n = 0, which is never free, nothing is asked.
        material["n"] = np.log(np.maximum(material["n"], np.finfo(float).tiny))
    k_s = material.get("k_s", np.zeros(1))
    if np.all(k_s == k_s[0]):
        free = [(name, None if name == "k_s" else channel) for name, channel in free]
    numbers, unravel = jax.flatten_util.ravel_pytree(material)
    index = {
        key: np.atleast_1d(np.asarray(place, int)) for key, place in unravel(jnp.arange(numbers.size * 1.0)).items()
    }
    design = np.zeros((numbers.size, len(set(free))))
    for column, (name, channel) in enumerate(dict.fromkeys(free)):
        design[index[name] if channel is None else index[name][channel], column] = 1.0
    return np.asarray(numbers), unravel, design, index


def _solve(hessian: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Scaled by the diagonal, since coefficients and exponent differ by orders of magnitude in what they move."""
    diagonal = np.diag(hessian)
    if not np.all(np.isfinite(hessian)) or np.any(diagonal <= 0):
        raise brdf.InputError("result", "lies at no minimum that the picture determines", "Hold or mask less")
    scale = 1.0 / np.sqrt(diagonal)[:, None]
    normed = hessian * scale * scale.T
    if np.linalg.eigvalsh(normed)[0] <= 1e-13:
        raise brdf.InputError("result", "is determined only in combinations of its numbers", "Fit a simpler model")
    return scale * np.linalg.solve(normed, scale * right)
