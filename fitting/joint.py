"""The general road: any leaf of material and scenes freed and fitted through the differentiable renderer.

The separable fit is faster and needs no start, but knows only k_a, k_d, k_s and n. Here a light's direction, a position
or an intensity can be freed as well. It starts from a material and scenes that are near, usually the separable optimum.

Which solver: Levenberg-Marquardt (Levenberg 1944, Marquardt 1963) while the Jacobian of pixels x freed numbers fits
into `LARGEST_JACOBIAN`, since it needs some ten steps; BFGS beyond, which keeps no Jacobian and needs some hundred.

Bounds: coefficients and emittances may not be negative. A number that leaves its range is held at the bound and the
rest fitted again; it is let go where the cost falls inwards. So a solution at a bound is exactly there.

Of rounded values that is the start: `fitting.joint_likelihood` goes on to what the codes say.
"""

import contextlib
import dataclasses
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float

import brdf
from brdf.errors import InputError
from brdf.images.encoding import Encoding
from brdf.precision import Precision, working_precision
from fitting.codes import Rounding
from fitting.core import fit_pictures
from fitting.joint_likelihood import Likely, most_likely_numbers
from fitting.joint_problem import DIRECTIONS, NOT_NEGATIVE, JointProblem, joint_problem, linearised, named_leaves
from fitting.pixels import Observed, observe
from fitting.problem import CLASSIC, FitProblem, model_name, state_problem
from fitting.progress import waiting
from fitting.report import FitResult
from fitting.result import Parameter
from fitting.solver.nnls import scaled_inverse
from fitting.uncertainty.intervals import NORMAL_95, above_zero
from fitting.uncertainty.noise_model import value_variance
from fitting.uncertainty.residual import NEGLIGIBLE, Neighbours, neighbours_of, structure_warning

LARGEST_JACOBIAN = 1 << 27
ROUNDS = 8
# Pixels so near to an outline that moves do not count: their shading bends, and they may come to see another shape.
AWAY = 2
TINY = np.finfo(float).tiny
OPEN = "only a combination with other freed numbers is determined"
# So many steps in a row, each a quarter of the one before, that lower the cost no more.
STALLED = 16
# A minimum is met where no more than this part of their errors parts the numbers from it.
MET = 0.1


@dataclass(frozen=True, kw_only=True, repr=False)
class JointResult(FitResult):
    """The outcome of a joint fit: a `FitResult` whose parameters are the freed numbers, and what the solver says.

    Attributes:
        values: of the freed leaves.
        errors: their standard errors; of a direction the angle, in degrees; infinite where only a combination of the
            freed numbers is determined.
        steps: of the solver.
        converged: whether the solver said so.
        solver: "lm" or "bfgs".
    """

    values: tuple[np.ndarray, ...]
    errors: tuple[np.ndarray, ...]
    steps: int
    converged: bool
    solver: str


def fit_jointly(
    target: Any,
    scene: brdf.Scene | Sequence[brdf.Scene],
    material: brdf.Material | FitResult | type[brdf.Material] | str = "auto",
    free: Callable[[brdf.Material, list[brdf.Scene]], Sequence[Any]] | str | Sequence[str] | None = None,
    *,
    solver: Literal["lm", "bfgs"] | None = None,
    precision: Precision = "float64",
    mask: Any = None,
    saturation: float | None = None,
    rounding: Rounding = None,
    encoding: Encoding | None = None,
    tolerance: float = 1e-10,
    max_steps: int = 256,
) -> JointResult:
    """Fit any leaves of material and scenes to pictures.

    Args:
        target: linear values, (H, W, C), or a list of pictures.
        scene: what the picture shows, or a list of as many.
        material: to start from, or a result that has one; or a model, from whose separable optimum it starts; or "auto"
            for the simplest adequate model under the scenes that were found.
        free: from material and list of scenes to the leaves to fit, for example
            ``lambda m, s: (m.k_d, m.n, s[0].lights[0].direction)``; all others are held. Or what `FitResult.diagnosis`
            names beside the whole material: "light", "intensity", "ball" or "radius", also "light 1 of picture 0".
            Where camera or shapes are freed, pixels near an outline do not count.
        solver: "lm", "bfgs", or None to choose by size.
        precision: "float32" or "float64".
        mask: (H, W), pixels to look at, or a list, such as ``fitting.fit(target, scene).counted[0]``.
        saturation: see `fitting.fit`.
        rounding: likewise.
        encoding: likewise.
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
        >>> round(float(result["n"]), 2)
        51.2
    """
    begun = time.perf_counter()
    if solver not in (None, "lm", "bfgs"):
        raise InputError("solver", f"is unknown, got {solver!r}", "Use lm, bfgs or None")
    if not (0 < tolerance < 1 and max_steps >= 1):
        came = f"and max_steps must be above 0, got {tolerance!r} and {max_steps!r}"
        raise InputError("tolerance", came, "Give for example 1e-10 and 256")
    names = [free] if isinstance(free, str) else free
    if not (callable(names) or names is None or isinstance(names, Sequence)):
        came = f"must be a function or names, got {type(free).__name__}"
        raise InputError("free", came, "Write lambda material, scenes: (material.n,), or light")
    material = material.material if isinstance(material, FitResult) else material
    freed = named_leaves(names) if isinstance(names, Sequence) else names
    stated = state_problem(
        target, scene, mask, rounding=rounding, encoding=encoding, precision=precision, saturation=saturation
    )
    with working_precision(precision), waiting("fitting jointly"):
        whole = observe(stated, at_once=True)

        def stated_by(start: brdf.Material, scenes: Sequence[brdf.Scene], seen: Observed) -> JointProblem:
            targets, weights = zip(*((tile.target, tile.weight) for tile in seen.tiles), strict=True)
            return joint_problem(brdf.cast((start, list(scenes)), precision), freed, list(targets), list(weights))

        def solve(start: brdf.Material, scenes: Sequence[brdf.Scene]) -> JointResult:
            problem, seen, rounds = stated_by(start, scenes, whole), whole, 0
            while True:
                if problem.moves_outlines:
                    seen = _away_from_outlines(whole, scenes)
                    problem = stated_by(start, scenes, seen)
                result = _solve(problem, seen, solver, tolerance, max_steps)
                start, scenes, rounds = result.material, result.scenes, rounds + 1
                if not problem.moves_outlines or rounds == ROUNDS or _inside(scenes, seen.counted):
                    return result

        if isinstance(material, brdf.Material):
            result = solve(material, stated.scenes)
        else:
            result = _of_model(stated, model_name(material), solve)
    return dataclasses.replace(result, seconds=time.perf_counter() - begun)


def _away_from_outlines(whole: Observed, scenes: Sequence[brdf.Scene]) -> Observed:
    """What is fitted where outlines move: a pixel that comes to see another shape, or none, is no small change."""
    inner = [_alike(scene, AWAY) & counted for scene, counted in zip(scenes, whole.counted, strict=True)]
    seen = observe(dataclasses.replace(whole.problem, masks=inner), at_once=True)
    lost = int(sum(map(np.count_nonzero, whole.counted)) - sum(map(np.count_nonzero, seen.counted)))
    return seen._replace(left_out=whole.left_out | {"near an outline that moves": lost})


def _inside(scenes: Sequence[brdf.Scene], counted: Sequence[np.ndarray]) -> bool:
    """Whether no pixel that counts lies at an outline."""
    return all(np.all(_alike(scene, 1) | ~some) for scene, some in zip(scenes, counted, strict=True))


def _alike(scene: brdf.Scene, reach: int) -> Bool[np.ndarray, "H W"]:
    """Which pixels see what all see that are so many pixels around."""
    from scipy.ndimage import maximum_filter, minimum_filter  # it takes long to load

    met = np.asarray(scene.surface_points().met)
    return minimum_filter(met, 2 * reach + 1, mode="nearest") == maximum_filter(met, 2 * reach + 1, mode="nearest")


def _of_model(stated: FitProblem, model: str, solve: Callable[..., JointResult]) -> JointResult:
    """From the separable optimum of a model; of "auto" the simplest adequate one under the scenes of the best lobe."""

    def separable(model: str, scenes: Sequence[brdf.Scene] = stated.scenes) -> FitResult:
        return fit_pictures(dataclasses.replace(stated, model=model, scenes=list(scenes)))

    if model != "auto":
        return solve(separable(model).material, stated.scenes)
    best = min((solve(separable(name).material, stated.scenes) for name in CLASSIC), key=lambda one: one.residual)
    simplest = separable("auto", best.scenes)
    with contextlib.suppress(InputError):  # of a number that the simplest model has not
        return dataclasses.replace(solve(simplest.material, best.scenes), candidates=simplest.candidates)
    return best


class _UntilNothingIsLeft(optx.LevenbergMarquardt):
    """Ends, too, where rounding hides what a step would gain: a tolerance may ask for less than that."""

    def terminate(self, fn: Any, y: Any, args: Any, options: Any, state: Any, tags: Any) -> tuple[Any, Any]:
        done, result = optx.LevenbergMarquardt.terminate(self, fn, y, args, options, state, tags)
        return done | (state.num_steps_since_acceptance >= STALLED), result


@eqx.filter_jit
def _run(
    problem: JointProblem, vector: Array, held: Array, solver: str, tolerance: float, max_steps: int
) -> optx.Solution:
    """The solver's answer with some of the freed numbers held."""

    def residuals(free: Array, problem: JointProblem) -> Array:
        return problem.residuals(jnp.where(held, vector, free))

    def cost(free: Array, problem: JointProblem) -> Array:
        return 0.5 * jnp.sum(residuals(free, problem) ** 2)

    if solver == "lm":
        solver_class: Any = _UntilNothingIsLeft  # its fields are not what it is made of
        method = solver_class(rtol=tolerance, atol=tolerance)
        return optx.least_squares(residuals, method, vector, problem, max_steps=max_steps, throw=False)
    method = optx.BFGS(rtol=tolerance, atol=tolerance)
    return optx.minimise(cost, method, vector, problem, max_steps=max_steps, throw=False)


def _solve(problem: JointProblem, seen: Observed, solver: str | None, tolerance: float, max_steps: int) -> JointResult:
    vector = problem.start()
    jacobian = sum(target.size for target in problem.targets) * vector.size
    solver = solver or ("lm" if jacobian <= LARGEST_JACOBIAN else "bfgs")
    bounded, held = problem.bounded, np.zeros(vector.shape, bool)
    steps, converged, residual, columns = 0, False, np.zeros(0), np.zeros((0, 0))
    for _ in range(ROUNDS):
        solution = _run(problem, vector, jnp.asarray(held), solver, tolerance, max_steps)
        steps += int(solution.stats["num_steps"])
        converged = bool(solution.result == optx.RESULTS.successful)
        vector = jnp.where(held, vector, solution.value)
        below = bounded & np.asarray(vector < 0)
        vector = jnp.where(below, 0, vector)
        residual, columns = (np.asarray(a, np.float64) for a in linearised(problem, vector))
        slope = columns @ residual
        if solver == "lm" and int(solution.state.num_steps_since_acceptance) >= STALLED:
            own = np.where(held, 0.0, slope)
            left = float(own @ scaled_inverse(columns @ columns.T) @ own)
            converged = left <= MET**2 * float(np.mean(residual**2))
        inwards = held & (slope < 0)
        if not below.any() and not inwards.any():
            break
        held = (held | below) & ~inwards
    vector = np.asarray(vector, np.float64)
    likely = most_likely_numbers(problem, seen, vector)
    if likely is not None:
        vector = likely.vector
        held = bounded & (vector == 0)
        residual = np.asarray(problem.residuals(jnp.asarray(vector)), np.float64)
    found = problem.at(jnp.asarray(vector))
    warnings = () if converged else (f"the solver stopped after {steps} steps without an end: raise max_steps",)
    parts = problem.by_picture(residual)
    residuals = [part.reshape(shown.shape) for part, shown in zip(parts, seen.shown, strict=True)]
    material, scenes = jax.tree.map(np.asarray, found.content())
    left = left_over(seen, scenes, residuals, vector.size, warnings)
    given = jax.tree.leaves((material, seen.problem.scenes))
    known = likely or _by_least_squares(problem, seen, vector, residual, columns, left["noise"])
    parameters, errors, correlation = _with_errors(problem, given, known, held)
    return JointResult(
        **left,
        material=material,
        parameters=parameters,
        correlation=correlation,
        values=tuple(np.asarray(found.leaves[leaf.place]) for leaf in problem.freed),
        errors=errors,
        steps=steps,
        converged=converged,
        solver=solver,
    )


def _by_least_squares(
    problem: JointProblem,
    seen: Observed,
    vector: Float[np.ndarray, " U"],
    residual: Float[np.ndarray, " N"],
    columns: Float[np.ndarray, "U N"],
    noise: Float[np.ndarray, " C"],
) -> Likely:
    """What is known of the numbers where each channel has its noise, which may grow with brightness."""
    counts = np.concatenate([counted.ravel() for counted in seen.counted])
    own = residual.reshape(counts.size, -1)[counts]
    told = np.concatenate([np.asarray(target, np.float64) for target in problem.targets])[counts]
    variance = np.zeros((counts.size, noise.size))
    variance[counts] = value_variance(own, told + own, noise)
    moves = columns.reshape(len(columns), *variance.shape)
    if seen.copies:  # they err together
        moves, variance = moves.sum(axis=2, keepdims=True), variance[:, :1]
    scatter = np.einsum("upc,vpc->uv", moves * variance, moves, optimize=True)
    return Likely(vector, columns @ columns.T, scatter)


def left_over(
    seen: Observed,
    scenes: Sequence[brdf.Scene],
    residuals: Sequence[Float[np.ndarray, "H W C"]],
    unknowns: int,
    warnings: tuple[str, ...],
) -> dict[str, Any]:
    """What a `FitResult` says of the pictures and of what a fit leaves of them.

    Args:
        seen: what was fitted.
        scenes: that were found.
        residuals: of each picture, 0 where a pixel does not count.
        unknowns: how many numbers were found.
        warnings: that come before those of the residual.
    """
    squares = np.sum([np.sum(np.square(residual), axis=(0, 1)) for residual in residuals], axis=0)
    told = [np.asarray(shown, np.float64)[counted] for shown, counted in zip(seen.shown, seen.counted, strict=True)]
    pixels = sum(map(len, told))
    share = (float(np.sum(squares)) / max(sum(float(np.sum(values**2)) for values in told), TINY)) ** 0.5
    known = neighbours_of(residuals) if share > NEGLIGIBLE else Neighbours()
    return seen.told() | {
        "scenes": scenes,
        "noise": np.sqrt(squares / max(pixels - unknowns / squares.size, 1)),
        "structure": known.correlation,
        "residual": share,
        "pixels": pixels,
        "warnings": (*warnings, *structure_warning(known)),
    }


def _with_errors(
    problem: JointProblem, given: Sequence[Any], known: Likely, held: np.ndarray
) -> tuple[tuple[Parameter, ...], tuple[np.ndarray, ...], np.ndarray]:
    """The freed numbers as parameters, their errors leaf by leaf, and the correlation of those that are determined.

    Of a direction the length is no unknown: its errors are those of two small turns across it.
    """
    vector, design = known.vector, np.where(held[:, None], 0.0, problem.design(known.vector))
    covariance, deviation = known.errors(design)
    parameters, errors, at, end = [], [], [], 0
    for leaf in problem.freed:
        first, end = end, end + (2 if leaf.name in DIRECTIONS else leaf.size)
        values, own, bound = vector[leaf.numbers], deviation[first:end], held[leaf.numbers]
        if leaf.name in DIRECTIONS:
            error = float(np.degrees(np.linalg.norm(own)))
            before, after = (one / np.linalg.norm(one) for one in (np.asarray(given[leaf.place], np.float64), values))
            turned = float(np.degrees(np.arctan2(np.linalg.norm(np.cross(before, after)), before @ after)))
            parameters.append(_parameter(leaf.words, None, turned, error, direction=tuple(after.tolist())))
            errors.append(np.asarray(error))
            at.append(-1)
            continue
        values = np.exp(values) if leaf.name == "n" else values
        own = np.where(bound, 0.0, own * (values if leaf.name == "n" else 1.0))
        errors.append(own.reshape(leaf.shape))
        at += range(first, end)
        for index, (value, error) in enumerate(zip(values.tolist(), own.tolist(), strict=True)):
            at_bound = bool(bound[index])
            interval = _interval(leaf.name, value, error) if np.isfinite(error) and not at_bound else None
            channel = index if leaf.shape else None
            parameters.append(_parameter(leaf.words, channel, value, error, interval, at_bound))
    at = np.array(at)[[one.value is not None and not one.at_bound for one in parameters]]
    error = np.sqrt(np.diag(covariance)[at])
    correlation = np.where((at >= 0)[:, None] & (at >= 0), covariance[np.ix_(at, at)] / np.outer(error, error), 0.0)
    np.fill_diagonal(correlation, 1.0)
    return tuple(parameters), tuple(errors), correlation


def _interval(name: str, value: float, error: float) -> tuple[float, float]:
    if name == "n":
        return value * np.exp(-NORMAL_95 * error / value), value * np.exp(NORMAL_95 * error / value)
    if name in NOT_NEGATIVE:
        return above_zero(value, error)
    return value - NORMAL_95 * error, value + NORMAL_95 * error


def _parameter(name: str, channel: int | None, value: float, error: float, *further: Any, **named: Any) -> Parameter:
    """A freed number; without a value where only a combination is determined."""
    known = bool(np.isfinite(error))
    reason = "" if known else OPEN
    return Parameter(name, channel, value if known else None, error, *further, reason=reason, **named)
