"""The general road: any leaf of material and scenes freed and fitted through the differentiable renderer.

The separable fit is faster and needs no start, but knows only k_a, k_d, k_s and n. Here a light's direction, a position
or an intensity can be freed as well. It starts from a material and scenes that are near, usually the separable optimum.

Which solver: Levenberg-Marquardt (Levenberg 1944, Marquardt 1963) while the Jacobian of pixels x freed numbers fits
into `LARGEST_JACOBIAN`, since it needs some ten steps; BFGS beyond, which keeps no Jacobian and needs some hundred.

Bounds: coefficients and emittances may not be negative. A number that leaves its range is held at the bound and the
rest fitted again; it is let go where the cost falls inwards. So a solution at a bound is exactly there.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import equinox as eqx
import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float

import brdf
from brdf.precision import Precision, working_precision
from fitting.pixels import Tile, observe
from fitting.problem import state_problem

LARGEST_JACOBIAN = 1 << 27
ROUNDS = 8


# What freed leaves may not go below. A direction or a position has no bound, n is searched by its logarithm.
_NOT_NEGATIVE = ("k_a", "k_d", "k_s", "intensity", "radiance", "ambient", "attenuation")


class JointProblem(eqx.Module):
    """From a vector of freed numbers to weighted residuals; a pytree, so that its programs are compiled once a shape.

    Attributes:
        start: material and list of scenes to start from.
        seen: what is compared with.
        places: of the freed leaves among those of ``start``.
        names: of the fields that they are.
    """

    start: Any
    seen: list[Tile]
    places: tuple[int, ...] = eqx.field(static=True)
    names: tuple[str, ...] = eqx.field(static=True)

    @classmethod
    def of(cls, start: Any, free: Callable[..., Sequence[Any]], seen: list[Tile]) -> "JointProblem":
        """Find the freed leaves by putting markers there.

        Raises:
            InputError: where ``free`` does not name distinct leaves.
        """
        remedy = "Return a tuple of leaves, such as (material.n, scenes[0].lights[0].direction)"
        try:
            leaves = tuple(free(*start))
        except TypeError as error:
            raise brdf.InputError("free", f"gives no tuple of leaves ({error})", remedy) from None
        if not leaves:
            raise brdf.InputError("free", "names no leaf", "Return the leaves to fit")
        own = {id(leaf) for leaf in jax.tree.leaves(start)}
        if not all(id(leaf) in own and jnp.issubdtype(leaf.dtype, jnp.floating) for leaf in leaves):
            raise brdf.InputError("free", "gives what is no number of material or scenes as a whole", remedy)
        if len({id(leaf) for leaf in leaves}) < len(leaves):
            raise brdf.InputError("free", "gives a leaf twice", remedy)
        count = len(leaves)
        marked = eqx.tree_at(lambda tree: tuple(free(*tree)), start, [_Marker(index) for index in range(count)])
        paths = jax.tree_util.tree_leaves_with_path(marked, is_leaf=lambda leaf: isinstance(leaf, _Marker))
        found = {
            leaf.index: (place, path[-1].name) for place, (path, leaf) in enumerate(paths) if isinstance(leaf, _Marker)
        }
        places, names = zip(*(found[index] for index in range(count)), strict=True)
        return cls(start, seen, places, names)

    @property
    def is_n(self) -> list[bool]:
        """Which freed leaves are exponents, searched by their logarithm."""
        return [name == "n" for name in self.names]

    @property
    def origin(self) -> Float[Array, " K"]:
        """The vector to start from."""
        return jax.flatten_util.ravel_pytree(self._coded())[0]

    @property
    def lower(self) -> Float[np.ndarray, " K"]:
        """What each entry may not go below."""
        bounds = [
            np.full(np.size(leaf), 0.0 if name in _NOT_NEGATIVE else -np.inf)
            for leaf, name in zip(self._coded(), self.names, strict=True)
        ]
        return np.concatenate(bounds)

    def _coded(self) -> tuple[Array, ...]:
        leaves = jax.tree.leaves(self.start)
        freed = [jnp.asarray(leaves[place]) for place in self.places]
        return tuple(jnp.log(leaf) if is_n else leaf for leaf, is_n in zip(freed, self.is_n, strict=True))

    def unravel(self, vector: Float[Array, " K"]) -> tuple[Array, ...]:
        """A vector's entries leaf by leaf."""
        return jax.flatten_util.ravel_pytree(self._coded())[1](vector)

    def decode(self, vector: Float[Array, " K"]) -> tuple[Array, ...]:
        """The freed leaves."""
        return tuple(
            jnp.exp(leaf) if is_n else leaf for leaf, is_n in zip(self.unravel(vector), self.is_n, strict=True)
        )

    def put(self, vector: Float[Array, " K"]) -> Any:
        """Material and scenes with the freed leaves in place."""
        leaves, shape = jax.tree.flatten(self.start)
        for place, leaf in zip(self.places, self.decode(vector), strict=True):
            leaves[place] = leaf
        return jax.tree.unflatten(shape, leaves)

    def residuals(self, vector: Float[Array, " K"]) -> list[Array]:
        """Weighted residuals of each picture."""
        material, scenes = self.put(vector)
        found = []
        for observation, scene in zip(self.seen, scenes, strict=True):
            residual = brdf.render(material, scene).reshape(observation.target.shape) - observation.target
            if observation.weight is not None:
                counts = observation.weight[:, None] > 0
                residual = jnp.where(counts, residual * jnp.where(counts, observation.weight[:, None], 1) ** 0.5, 0)
            found.append(residual)
        return found


@dataclass(frozen=True)
class _Marker:
    index: int


@dataclass(frozen=True)
class JointResult:
    """The outcome of a joint fit.

    Attributes:
        material: the material, fitted where it was freed.
        scenes: the scenes, likewise.
        values: of the freed leaves.
        errors: their standard errors; infinite where only a combination of the freed numbers is determined.
        residual: root mean square of the residual over that of the pictures.
        steps: of the solver.
        converged: whether the solver said so.
        solver: "lm" or "bfgs".
    """

    material: brdf.Material
    scenes: list[brdf.Scene]
    values: tuple[np.ndarray, ...]
    errors: tuple[np.ndarray, ...]
    residual: float
    steps: int
    converged: bool
    solver: str


def fit_jointly(
    target: Any,
    scene: brdf.Scene | Sequence[brdf.Scene],
    material: brdf.Material,
    free: Callable[[brdf.Material, list[brdf.Scene]], Sequence[Any]],
    *,
    solver: Literal["lm", "bfgs"] | None = None,
    precision: Precision = "float64",
    mask: Any = None,
    saturation: float | None = None,
    tolerance: float = 1e-10,
    max_steps: int = 256,
) -> JointResult:
    """Fit any leaves of material and scenes to pictures.

    Args:
        target: linear values, (H, W, C), or a list of pictures.
        scene: what the picture shows, or a list of as many.
        material: to start from, usually ``fitting.fit(target, scene).material``.
        free: from material and list of scenes to the leaves to fit, for example
            ``lambda m, s: (m.k_d, m.n, s[0].lights[0].direction)``.
        solver: "lm", "bfgs", or None to choose by size.
        precision: "float32" or "float64".
        mask: (H, W), pixels to look at, or a list, such as ``fitting.fit(target, scene).counted[0]``.
        saturation: see `fitting.fit`.
        tolerance: relative and absolute, on the freed numbers and the cost.
        max_steps: of the solver.

    Returns:
        The result. A factor that only scales light and material against each other is not determined by any picture:
        its error is infinite.

    Raises:
        InputError: where an argument cannot be used, or ``free`` does not name distinct leaves.
    """
    if solver not in (None, "lm", "bfgs"):
        raise brdf.InputError("solver", f"is unknown, got {solver!r}", "Use lm, bfgs or None")
    if not (0 < tolerance < 1 and max_steps >= 1):
        came = f"and max_steps must be above 0, got {tolerance!r} and {max_steps!r}"
        raise brdf.InputError("tolerance", came, "Give for example 1e-10 and 256")
    stated = state_problem(target, scene, mask, precision=precision, saturation=saturation)
    with working_precision(precision):
        seen = [observation.tiles[0] for observation in observe(stated, at_once=True)]
        start = brdf.cast((material, stated.scenes), precision)
        problem = JointProblem.of(start, free, seen)
        values = sum(observation.target.size for observation in seen)
        chosen = solver or ("lm" if values * problem.origin.size <= LARGEST_JACOBIAN else "bfgs")
        return _solve(problem, chosen, tolerance, max_steps)


@eqx.filter_jit
def _run(
    problem: JointProblem,
    vector: Float[Array, " K"],
    held: Bool[Array, " K"],
    solver: str,
    tolerance: float,
    max_steps: int,
) -> optx.Solution:
    """The solver's answer with some of the freed numbers held."""

    def residuals(free: Array, problem: JointProblem) -> list[Array]:
        return problem.residuals(jnp.where(held, vector, free))

    if solver == "lm":
        method = optx.LevenbergMarquardt(rtol=tolerance, atol=tolerance)
        return optx.least_squares(residuals, method, vector, problem, max_steps=max_steps, throw=False)

    def cost(free: Array, problem: JointProblem) -> Array:
        return _half_square(residuals(free, problem))

    method = optx.BFGS(rtol=tolerance, atol=tolerance)
    return optx.minimise(cost, method, vector, problem, max_steps=max_steps, throw=False)


@eqx.filter_jit
def _gradient(problem: JointProblem, vector: Float[Array, " K"]) -> Float[Array, " K"]:
    return jax.grad(lambda free: _half_square(problem.residuals(free)))(vector)


def _solve(problem: JointProblem, solver: str, tolerance: float, max_steps: int) -> JointResult:
    vector, lower = problem.origin, problem.lower
    held = np.zeros(lower.shape, bool)
    steps, converged = 0, False
    for _ in range(ROUNDS):
        solution = _run(problem, vector, jnp.asarray(held), solver, tolerance, max_steps)
        steps += int(solution.stats["num_steps"])
        converged = bool(solution.result == optx.RESULTS.successful)
        vector = jnp.where(held, vector, solution.value)
        below = np.asarray(vector) < lower
        vector = jnp.maximum(vector, lower.astype(vector.dtype))
        inwards = held & (np.asarray(_gradient(problem, vector)) < 0)
        if not below.any() and not inwards.any():
            break
        held = (held | below) & ~inwards
    material, scenes = problem.put(vector)
    errors, residual = _errors(problem, vector, held)
    return JointResult(
        material=jax.tree.map(np.asarray, material),
        scenes=[jax.tree.map(np.asarray, scene) for scene in scenes],
        values=tuple(np.asarray(leaf) for leaf in problem.decode(vector)),
        errors=errors,
        residual=residual,
        steps=steps,
        converged=converged,
        solver=solver,
    )


def _half_square(residuals: list[Array]) -> Array:
    return 0.5 * jnp.sum(jnp.stack([jnp.sum(residual * residual) for residual in residuals]))


@eqx.filter_jit
def _column(problem: JointProblem, vector: Float[Array, " K"], direction: Float[Array, " K"]) -> Float[Array, " R"]:
    tangents = jax.jvp(problem.residuals, (vector,), (direction,))[1]
    return jnp.concatenate([tangent.ravel() for tangent in tangents])


@eqx.filter_jit
def _values(problem: JointProblem, vector: Float[Array, " K"]) -> Float[Array, " R"]:
    return jnp.concatenate([residual.ravel() for residual in problem.residuals(vector)])


def _errors(problem: JointProblem, vector: Array, held: np.ndarray) -> tuple[tuple[np.ndarray, ...], float]:
    """Standard errors from the Gauss-Newton Hessian, one column of the Jacobian at a time."""
    size = vector.size
    columns = [np.asarray(_column(problem, vector, direction), np.float64) for direction in jnp.eye(size)]
    gram = np.array([[left @ right for right in columns] for left in columns])
    residual = np.asarray(_values(problem, vector), np.float64)
    square = sum(float(np.sum(np.square(np.asarray(_counted(o)), dtype=np.float64))) for o in problem.seen)
    pixels = sum(int(_counted(o).size) for o in problem.seen)
    variance = float(residual @ residual) / max(pixels - size, 1)
    active = ~held & (np.diag(gram) > 0)
    scale = np.sqrt(np.where(active, np.diag(gram), 1.0))
    covariance = np.full(size, np.inf)
    if active.any():
        normed = (gram / np.outer(scale, scale))[np.ix_(active, active)]
        eigenvalue, eigenvector = np.linalg.eigh(normed)
        known = eigenvalue > 1e-12 * eigenvalue[-1]
        spread = np.sum(eigenvector[:, known] ** 2 / eigenvalue[known], axis=1)
        # A number that takes part in an undetermined combination is itself undetermined.
        spread[np.any(np.abs(eigenvector[:, ~known]) > 1e-3, axis=1)] = np.inf
        covariance[active] = variance * spread / scale[active] ** 2
    covariance[held] = 0.0
    errors = problem.unravel(jnp.asarray(np.sqrt(covariance), vector.dtype))
    leaves = problem.decode(vector)
    found = tuple(
        np.asarray(error * leaf if is_n else error)
        for error, leaf, is_n in zip(errors, leaves, problem.is_n, strict=True)
    )
    return found, float(np.sqrt(residual @ residual / square))


def _counted(observation: Tile) -> np.ndarray:
    target = np.asarray(observation.target)
    return target if observation.weight is None else target[np.asarray(observation.weight) > 0]
