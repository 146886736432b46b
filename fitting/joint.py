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
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array

import brdf
from brdf.precision import Precision, working_precision
from fitting.pixels import Tile, observe
from fitting.problem import state_problem
from fitting.solver.nnls import inverse_diagonal

LARGEST_JACOBIAN = 1 << 27
ROUNDS = 8
# What freed leaves may not go below. A direction or a position has no bound, n is searched by its logarithm.
NOT_NEGATIVE = ("k_a", "k_d", "k_s", "intensity", "radiance", "ambient", "attenuation")


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

    Example:
        >>> target, scene = brdf.read_image("target.exr"), brdf.Scene.load("scene.toml")
        >>> start = brdf.BlinnPhong(k_a=brdf.preset("gold").k_a, k_d=[0.7, 0.6, 0.2], k_s=brdf.preset("gold").k_s, n=40)
        >>> result = fitting.fit_jointly(target, scene, start, lambda material, scenes: (material.k_d, material.n))
        >>> round(float(result.material.n), 2)
        51.2
    """
    if solver not in (None, "lm", "bfgs"):
        raise brdf.InputError("solver", f"is unknown, got {solver!r}", "Use lm, bfgs or None")
    if not (0 < tolerance < 1 and max_steps >= 1):
        came = f"and max_steps must be above 0, got {tolerance!r} and {max_steps!r}"
        raise brdf.InputError("tolerance", came, "Give for example 1e-10 and 256")
    stated = state_problem(target, scene, mask, precision=precision, saturation=saturation)
    with working_precision(precision):
        tiles = list(observe(stated, at_once=True).tiles)
        problem = _freed(brdf.cast((material, stated.scenes), precision), free, tiles)
        jacobian = sum(tile.target.size for tile in tiles) * problem.start().size
        return _solve(problem, solver or ("lm" if jacobian <= LARGEST_JACOBIAN else "bfgs"), tolerance, max_steps)


class _JointProblem(eqx.Module):
    """From a vector of freed numbers to weighted residuals; a pytree, so that its programs are compiled once a shape.

    Attributes:
        leaves: of material and list of scenes.
        tiles: what is compared with.
        shape: of material and scenes.
        places: of the freed leaves.
        names: of the fields that they are.
    """

    leaves: list[Array]
    tiles: list[Tile]
    shape: Any = eqx.field(static=True)
    places: tuple[int, ...] = eqx.field(static=True)
    names: tuple[str, ...] = eqx.field(static=True)

    def freed(self) -> list[Array]:
        """The freed leaves."""
        return [self.leaves[place] for place in self.places]

    def start(self) -> Array:
        """The freed numbers as they are searched: n by its logarithm."""
        both = zip(self.freed(), self.names, strict=True)
        return jnp.concatenate([jnp.ravel(jnp.log(leaf) if name == "n" else leaf) for leaf, name in both])

    def at(self, vector: Array) -> "_JointProblem":
        """The problem with other freed numbers."""
        leaves, begin = list(self.leaves), 0
        for place, name in zip(self.places, self.names, strict=True):
            part = vector[begin : begin + leaves[place].size].reshape(leaves[place].shape)
            leaves[place], begin = jnp.exp(part) if name == "n" else part, begin + part.size
        return eqx.tree_at(lambda problem: problem.leaves, self, leaves)

    def content(self) -> tuple[brdf.Material, list[brdf.Scene]]:
        """Material and scenes."""
        return jax.tree.unflatten(self.shape, self.leaves)

    def residuals(self, vector: Array) -> Array:
        """Weighted residuals of all pictures, one after the other."""
        material, scenes = self.at(vector).content()
        found = []
        for tile, scene in zip(self.tiles, scenes, strict=True):
            residual = brdf.render(material, scene).reshape(tile.target.shape) - tile.target
            if tile.weight is not None:
                counts = tile.weight[:, None] > 0
                residual = jnp.where(counts, residual * jnp.where(counts, tile.weight[:, None], 1) ** 0.5, 0)
            found.append(residual.ravel())
        return jnp.concatenate(found)


def _freed(start: Any, free: Callable[..., Sequence[Any]], tiles: list[Tile]) -> _JointProblem:
    """Find the freed leaves among those of the start, each an array of its own."""
    start = jax.tree.map(jnp.array, start)
    remedy = "Return a tuple of leaves, such as (material.n, scenes[0].lights[0].direction)"
    try:
        freed = [id(leaf) for leaf in free(*start)]
    except TypeError as error:
        raise brdf.InputError("free", f"gives no tuple of leaves ({error})", remedy) from None
    if not freed:
        raise brdf.InputError("free", "names no leaf", "Return the leaves to fit")
    paths = jax.tree_util.tree_leaves_with_path(start)
    own = {
        id(leaf): (place, getattr(path[-1], "name", ""))
        for place, (path, leaf) in enumerate(paths)
        if jnp.issubdtype(leaf.dtype, jnp.floating)
    }
    if not own.keys() >= set(freed):
        raise brdf.InputError("free", "gives what is no number of material or scenes as a whole", remedy)
    if len(set(freed)) < len(freed):
        raise brdf.InputError("free", "gives a leaf twice", remedy)
    places, names = zip(*(own[leaf] for leaf in freed), strict=True)
    leaves, shape = jax.tree.flatten(start)
    return _JointProblem(leaves, tiles, shape, places, names)


@eqx.filter_jit
def _run(
    problem: _JointProblem, vector: Array, held: Array, solver: str, tolerance: float, max_steps: int
) -> optx.Solution:
    """The solver's answer with some of the freed numbers held."""

    def residuals(free: Array, problem: _JointProblem) -> Array:
        return problem.residuals(jnp.where(held, vector, free))

    def cost(free: Array, problem: _JointProblem) -> Array:
        return 0.5 * jnp.sum(residuals(free, problem) ** 2)

    if solver == "lm":
        method = optx.LevenbergMarquardt(rtol=tolerance, atol=tolerance)
        return optx.least_squares(residuals, method, vector, problem, max_steps=max_steps, throw=False)
    method = optx.BFGS(rtol=tolerance, atol=tolerance)
    return optx.minimise(cost, method, vector, problem, max_steps=max_steps, throw=False)


@eqx.filter_jit
def _linearised(problem: _JointProblem, vector: Array) -> tuple[Array, Array]:
    """The residuals and their derivatives, one column of the Jacobian at a time."""
    residuals, along = jax.linearize(problem.residuals, vector)
    return residuals, jax.lax.map(along, jnp.eye(vector.size))


def _solve(problem: _JointProblem, solver: str, tolerance: float, max_steps: int) -> JointResult:
    vector, freed = problem.start(), problem.freed()
    bounded = np.repeat([name in NOT_NEGATIVE for name in problem.names], [leaf.size for leaf in freed])
    held = np.zeros(vector.shape, bool)
    steps, converged, residual, columns = 0, False, np.zeros(0), np.zeros((0, 0))
    for _ in range(ROUNDS):
        solution = _run(problem, vector, jnp.asarray(held), solver, tolerance, max_steps)
        steps += int(solution.stats["num_steps"])
        converged = bool(solution.result == optx.RESULTS.successful)
        vector = jnp.where(held, vector, solution.value)
        below = bounded & np.asarray(vector < 0)
        vector = jnp.where(below, 0, vector)
        residual, columns = (np.asarray(a, np.float64) for a in _linearised(problem, vector))
        inwards = held & (columns @ residual < 0)
        if not below.any() and not inwards.any():
            break
        held = (held | below) & ~inwards
    cost, square, count = float(residual @ residual), 0.0, 0
    for tile in problem.tiles:
        counted = np.asarray(tile.target, np.float64)[... if tile.weight is None else np.asarray(tile.weight) > 0]
        square, count = square + float(np.sum(counted**2)), count + counted.size
    inverse = np.zeros(vector.size)
    inverse[~held] = inverse_diagonal(columns[~held] @ columns[~held].T, 1e-12)
    found = problem.at(vector)
    errors, values = [], [np.asarray(leaf) for leaf in found.freed()]
    deviations = np.sqrt(cost / max(count - vector.size, 1) * inverse).astype(vector.dtype)
    parts = np.split(deviations, np.cumsum([leaf.size for leaf in freed])[:-1])
    for part, leaf, name in zip(parts, values, problem.names, strict=True):
        errors.append(part.reshape(leaf.shape) * (leaf if name == "n" else 1))
    material, scenes = jax.tree.map(np.asarray, found.content())
    residual_share = (cost / square) ** 0.5
    return JointResult(material, scenes, tuple(values), tuple(errors), residual_share, steps, converged, solver)
