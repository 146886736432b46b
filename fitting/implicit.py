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

POLISHING_STEPS = 3


@dataclass(frozen=True)
class Sensitivity:
    """Derivatives of the fitted numbers by one known leaf of shape (S...).

    Attributes:
        k_a: of the ambient coefficient, (C, S...); 0 where it is at its bound or not determined.
        k_d: of the diffuse coefficient, (C, S...).
        k_s: of the specular coefficient, (C, S...).
        n: of the exponent, (S...).
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
        ``fitting.sensitivity(result, lambda scenes: (scenes[0].lights[0].direction,))[0].n``
    """
    if result.loss != "squared":
        raise brdf.InputError("result", f"must be of the squared loss, got {result.loss}", "Fit without a loss")
    scenes = list(result.scenes)
    leaves = tuple(by(scenes))
    if not leaves or not all(hasattr(leaf, "shape") for leaf in leaves):
        raise brdf.InputError("by", "names no leaf of the scenes", "Return the leaves to differentiate by")
    unknowns = _Unknowns(result)
    with working_precision("float64"):
        scenes = brdf.cast(scenes, "float64")
        seen = [_seen(target, counted) for target, counted in zip(result.targets, result.counted, strict=True)]
        known, unravel = jax.flatten_util.ravel_pytree(tuple(by(scenes)))

        def cost(vector: Array, known: Array, seen: Any) -> Array:
            material = unknowns.material(vector)
            moved = eqx.tree_at(lambda places: tuple(by(places)), scenes, unravel(known))
            total = jnp.zeros(())
            for scene, (target, counted) in zip(moved, seen, strict=True):
                residual = jnp.where(counted[..., None], brdf.render(material, scene) - target, 0)
                total = total + 0.5 * jnp.sum(residual * residual)
            return total

        slope = jax.grad(cost)

        @eqx.filter_jit
        def derivatives(vector: Array, seen: Any) -> tuple[Array, Array]:
            def column(direction: Array) -> Array:
                return jax.jvp(lambda v: slope(v, known, seen), (vector,), (direction,))[1]

            return slope(vector, known, seen), jax.lax.map(column, jnp.eye(vector.size))

        @eqx.filter_jit
        def by_known(vector: Array, seen: Any) -> Array:
            def column(direction: Array) -> Array:
                return jax.jvp(lambda k: slope(vector, k, seen), (known,), (direction,))[1]

            return jax.lax.map(column, jnp.eye(known.size))

        vector = unknowns.vector
        hessian = np.eye(vector.size)
        # A fit in float32 stops a little beside the stationary point; Newton's steps go there.
        for _ in range(POLISHING_STEPS):
            gradient, columns = derivatives(jnp.asarray(vector), seen)
            hessian = np.asarray(columns)
            vector = vector - _solve(hessian, np.asarray(gradient))
        moves = -_solve(hessian, np.asarray(by_known(jnp.asarray(vector), seen)).T)
    return tuple(unknowns.derivatives(part, leaf.shape, vector) for part, leaf in _split(moves, leaves))


class _Unknowns:
    """The fitted numbers that may move, as one vector; the exponent by its logarithm."""

    def __init__(self, result: FitResult):
        self.model = type(result.material)
        self.channels = int(np.asarray(result.material.k_d).shape[0])
        self.numbers = {
            key: np.asarray(value, np.float64) for key, value in vars(result.material).items() if value is not None
        }
        self.places: list[tuple[str, int | None]] = []
        # A grey highlight is one number, and the only way for all channels to agree to the last digit.
        k_s = self.numbers.get("k_s", np.zeros(1))
        self.grey = self.channels > 1 and bool(np.all(k_s == k_s[0]))
        for parameter in result.free_parameters:
            if parameter.name == "k_s" and self.grey and parameter.channel:
                continue
            self.places.append((parameter.name, parameter.channel))
        values = [self.numbers[key] if channel is None else self.numbers[key][channel] for key, channel in self.places]
        is_n = np.array([key == "n" for key, _ in self.places], bool)
        self.vector = np.where(is_n, np.log(np.where(is_n, values, 1.0)), values)

    def material(self, vector: Array) -> brdf.Material:
        """The material with the vector's numbers in place."""
        numbers = {key: jnp.asarray(value) for key, value in self.numbers.items()}
        for index, (key, channel) in enumerate(self.places):
            if key == "n":
                numbers[key] = jnp.exp(vector[index])
            elif key == "k_s" and self.grey:
                numbers[key] = jnp.broadcast_to(vector[index], (self.channels,))
            else:
                numbers[key] = numbers[key].at[channel].set(vector[index])
        return self.model(**numbers)

    def derivatives(self, moves: Float[np.ndarray, "K S"], shape: tuple[int, ...], vector: np.ndarray) -> Sensitivity:
        """The rows of the vector's derivative, by name."""
        found = {key: np.zeros((self.channels, *shape)) for key in ("k_a", "k_d", "k_s")} | {"n": np.zeros(shape)}
        for index, (key, channel) in enumerate(self.places):
            row = moves[index].reshape(shape)
            if key == "n":
                found[key] = row * np.exp(vector[index])
            else:
                found[key][slice(None) if key == "k_s" and self.grey else channel] = row
        return Sensitivity(**found)


def _seen(target: np.ndarray, counted: np.ndarray) -> tuple[Array, Array]:
    return jnp.where(counted[..., None], jnp.asarray(target, jnp.float64), 0.0), jnp.asarray(counted)


def _solve(hessian: Float[np.ndarray, "K K"], right: np.ndarray) -> np.ndarray:
    """Scaled by the diagonal, since coefficients and exponent differ by orders of magnitude in what they move."""
    diagonal = np.diag(hessian)
    if not np.all(np.isfinite(hessian)) or np.any(diagonal <= 0):
        raise brdf.InputError("result", "lies at no minimum that the picture determines", "Hold or mask less")
    scale = 1.0 / np.sqrt(diagonal)
    normed = hessian * scale[:, None] * scale
    if np.linalg.eigvalsh(normed)[0] <= 1e-13:
        raise brdf.InputError("result", "is determined only in combinations of its numbers", "Fit a simpler model")
    columns = right if right.ndim == 2 else right[:, None]
    solved = scale[:, None] * np.linalg.solve(normed, scale[:, None] * columns)
    return solved.reshape(right.shape)


def _split(moves: Float[np.ndarray, "K S"], leaves: Sequence[Any]) -> list[tuple[np.ndarray, Any]]:
    ends = np.cumsum([int(np.prod(leaf.shape)) for leaf in leaves])
    return list(zip(np.split(moves, ends[:-1], axis=1), leaves, strict=True))
