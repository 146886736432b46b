"""The general road: any leaf of material and scenes freed and fitted through the differentiable renderer.

The separable fit is faster and needs no start, but knows only k_a, k_d, k_s and n. Here a light's direction, a position
or an intensity can be freed as well. It starts from a material and scenes that are near, usually the separable optimum.

Which solver: Gauss and Newton's steps, while each gains. Where one does not, Levenberg-Marquardt (Levenberg 1944,
Marquardt 1963) while the Jacobian of pixels x freed numbers fits into `LARGEST_JACOBIAN`, since it needs some ten
steps; BFGS beyond, which keeps no Jacobian and needs some hundred.

Bounds: coefficients and emittances may not be negative. A number that leaves its range is held at the bound and the
rest fitted again; it is let go where the cost falls inwards. So a solution at a bound is exactly there.

Of rounded values that is the start: `fitting.joint_likelihood` goes on to what the codes say.
"""

import contextlib
import dataclasses
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float

import brdf
from brdf.errors import InputError
from brdf.images.encoding import Encoding
from brdf.precision import Precision, working_precision
from brdf.vectors import quotient
from fitting.codes import Rounding
from fitting.core import fit_pictures
from fitting.growing_noise import Shown, as_it_grows, likeliest
from fitting.joint_likelihood import Information, by_least_squares, most_likely_numbers
from fitting.joint_problem import JointProblem, Leaf, degrees_between, joint_problem, linearised, named_leaves
from fitting.jpeg_errors import APPROACH, ENOUGH_CHANGE, MOST_FITS, LookAlikes, codec_of
from fitting.model_fit import N_RANGE
from fitting.pixels import Observed, observe
from fitting.problem import CLASSIC, FitProblem, model_name, state_problem
from fitting.progress import waiting
from fitting.report import FitResult
from fitting.result import Parameter
from fitting.solver.nnls import nonnegative_minimum, scaled_inverse
from fitting.tile import Tile
from fitting.uncertainty.covariance import LOST_IN_NOISE, RESOLUTION, SIGNIFICANT
from fitting.uncertainty.intervals import NORMAL_95, above_zero, widened
from fitting.uncertainty.noise_model import value_variance
from fitting.uncertainty.residual import NEGLIGIBLE, Neighbours, neighbours_of, structure_words
from fitting.uncertainty.structure import CODED_SIZES, SIZES, Errors, of_coded_blocks, over_blocks, structure
from fitting.uneven_noise import EVENINGS, Left, NoiseOfEach, evened, noise_left, with_bounds

SOLVERS: dict[str, Any] = {"lm": optx.LevenbergMarquardt, "bfgs": optx.BFGS}
LARGEST_JACOBIAN = 1 << 27
ROUNDS, FEWEST_STEPS = 8, 32
# A picture is linear in these: one step of Gauss and Newton is the answer.
EMITTANCES = ("intensity", "radiance", "ambient")
# Pixels so near to an outline that moves do not count: their shading bends, and they may come to see another shape.
AWAY = 2
TINY = np.finfo(float).tiny
OPEN = "only a combination with other freed numbers is determined"
# A combination of which pictures tell so little stays as it is, or as rounding errors tell.
DAMPED = 1e-9
# A lobe is not linear in log n beyond.
FARTHEST = 1.0
# Of a lobe that went to nothing other exponents are tried once.
RESTARTS = (1.0, 4.0, 16.0, 64.0, 256.0, 1024.0)
# Logarithms of exponents that far apart, and so many errors, are of different minima.
ELSEWHERE, ELSEWHERE_ERRORS = 0.1, 3.0
# A minimum is met where no more than this part of their errors parts the numbers from it.
MET = 0.1


@dataclass(frozen=True, kw_only=True, repr=False, eq=False)
class JointResult(FitResult):
    """The outcome of a joint fit: a `FitResult` whose parameters are the freed numbers, and what the solver says.

    Attributes:
        values: of the freed leaves.
        errors: their standard errors; of a direction the angle, in degrees; infinite where only a combination of the
            freed numbers is determined.
        steps: of the solver.
        converged: whether the solver said so.
        solver: "lm", "bfgs", or "gauss-newton" where its steps were enough.
    """

    values: tuple[np.ndarray, ...]
    errors: tuple[np.ndarray, ...]
    steps: int
    converged: bool
    solver: str


class _Solved(NamedTuple):
    """A result, what is known of its numbers, what its pictures show, and how neighbours err alike."""

    result: JointResult
    information: Information
    shown: Sequence[Shown]
    neighbours: Neighbours

    @property
    def cost(self) -> float:
        """By which results of the same pictures are compared: the likelihood's, or what is left where it has no say."""
        value = self.information.value
        return -value if math.isfinite(value) else self.result.residual


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
        free: from material and list of scenes to the leaf or leaves to fit, for example
            ``lambda m, s: (m.k_d, m.n, s[0].lights[0].direction)``; all others are held. Or what `FitResult.diagnosis`
            names beside the whole material: "light" or "distance" (of a near light its place), "intensity", "ball" or
            "radius", also "light 1 of picture 0"; None for the material alone.
            Where camera or shapes are freed, pixels near an outline do not count.
        solver: "lm", "bfgs", or None for Gauss and Newton's steps, and where they do not gain one of these by size.
        precision: "float32" or "float64".
        mask: (H, W), or a file: pixels to look at; or a list, such as ``fitting.fit(target, scene).counted[0]``.
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
    if solver not in (None, *SOLVERS):
        raise InputError("solver", f"is unknown, got {solver!r}", "Use lm, bfgs or None")
    if not (0 < tolerance < 1 and max_steps >= 1):
        what = f"and max_steps must be above 0, got {tolerance!r} and {max_steps!r}"
        raise InputError("tolerance", what, "Give for example 1e-10 and 256")
    if not (callable(free) or free is None or isinstance(free, Sequence)):
        what = f"must be a function or names, got {type(free).__name__}"
        raise InputError("free", what, "Write lambda material, scenes: (material.n,), or light")
    by_name = not callable(free)
    if not callable(free):
        free = named_leaves([free] if isinstance(free, str) else list(dict.fromkeys(map(str, free or ()))))
    material = material.material if isinstance(material, FitResult) else material
    stated = state_problem(
        target, scene, mask, rounding=rounding, encoding=encoding, precision=precision, saturation=saturation
    )
    shown = stated.targets[0].pixels.shape[-1]
    if isinstance(material, brdf.Material) and (own := material.k_d.size) not in (1, shown):
        raise InputError(
            "material", f"has {own} channels, the picture {shown}", "Give both the same number of channels"
        )
    with working_precision(precision), waiting("fitting jointly"):
        whole = _observed(stated)
        look_alikes = LookAlikes.of(whole)

        def minimum(observed: Observed, start: brdf.Material, scenes: Sequence[brdf.Scene]) -> _Solved:
            pictures = [(tile.target, tile.weight) for tile in observed.tiles]
            problem = joint_problem(brdf.cast((start, list(scenes)), precision), free, pictures)
            return _solve(problem, observed, solver, tolerance, max_steps, look_alikes.widening)

        def solve(
            start: brdf.Material, scenes: Sequence[brdf.Scene], rounds: int = ROUNDS, *noises: NoiseOfEach
        ) -> _Solved:
            freed = joint_problem((start, list(scenes)), free).freed
            moves = any("camera." in leaf.words or "shapes[" in leaf.words for leaf in freed)
            plain = _away_from_outlines(whole, scenes) if moves else whole
            plain = plain._replace(tiles=look_alikes.taken_off(plain.tiles))
            solved = minimum(evened(plain, noises[-1]) if noises else plain, start, scenes)
            result = solved.result
            if len(plain.tiles) > 1 and len(noises) < EVENINGS:
                noise = _noise_of_each(result, plain)
                if not noise.even:
                    return solve(result.material, result.scenes, rounds, *noises, noise)
            if rounds > 1 and moves and not _inside(result.scenes, plain.counted):
                return solve(result.material, result.scenes, rounds - 1, *noises)

            def grown(last: _Solved) -> _Solved | None:
                uneven = as_it_grows(plain, last.shown, last.information.noise) if last.shown else None
                return None if uneven is None else minimum(uneven, last.result.material, last.result.scenes)

            def alike(one: _Solved) -> tuple[bool, float]:
                return one.neighbours.significant, one.neighbours.correlation

            return likeliest(solved, grown, lambda one: one.information.value, alike)

        if isinstance(material, brdf.Material):
            solved = solve(material, stated.scenes)
        else:
            solved = _of_model(stated, model_name(material), solve)
        if solved.result.left_out.get("clipped") and (by_name or {"k_d", "k_s", "n"} <= set(solved.result)):
            solved = _sought_again(stated, solved, solve)
        result = solved.result
        # Of channels that are copies of each other a codec takes nothing away.
        if not whole.copies and any(map(codec_of, whole.problem.targets)):
            result = _without_codec_errors(result, look_alikes, whole, solve)
    return dataclasses.replace(result, seconds=time.perf_counter() - begun)


def _observed(problem: FitProblem) -> Observed:
    """What pixels say: floats that are clipped, cut off or beside codes as codes, for these have one likelihood."""
    return with_bounds(observe(problem, at_once=True), in_codes=True)


def _away_from_outlines(whole: Observed, scenes: Sequence[brdf.Scene]) -> Observed:
    """What is fitted where outlines move: a pixel that comes to see another shape, or none, is no small change."""
    inner = [_alike(scene, AWAY) & counted for scene, counted in zip(scenes, whole.counted, strict=True)]
    observed = _observed(dataclasses.replace(whole.problem, masks=inner))
    lost = int(sum(map(np.count_nonzero, whole.counted)) - sum(map(np.count_nonzero, observed.counted)))
    return observed._replace(left_out=whole.left_out | {"near an outline that moves": lost})


def _radiance(result: JointResult, observed: Observed) -> list[Float[np.ndarray, "P C"]]:
    """What is predicted of each picture."""
    shown = zip(observed.tiles, result.scenes, strict=True)
    return [np.asarray(brdf.render(result.material, scene)).reshape(tile.target.shape) for tile, scene in shown]


def _without_codec_errors(
    result: JointResult, look_alikes: LookAlikes, whole: Observed, solve: Callable[..., _Solved]
) -> JointResult:
    """Less what codecs do to look-alikes of what is predicted, again until these come no nearer to the pictures."""
    moved = np.zeros(len(result.parameters))
    for _ in range(MOST_FITS):
        if not look_alikes.are_nearer(whole.tiles, _radiance(result, whole)):
            break
        last, result = result, solve(result.material, result.scenes).result
        if len(last.parameters) != len(result.parameters):  # a highlight that went to nothing is freed no more
            moved = np.zeros(len(result.parameters))
            continue
        moved = _changes(last, result)
        errors = [one.error or math.inf for one in result.parameters]
        if look_alikes.enough or np.all(moved < np.multiply(ENOUGH_CHANGE, errors)):
            break
    return _wider(result, APPROACH * moved)


def _changes(last: JointResult, result: JointResult) -> Float[np.ndarray, " F"]:
    """By how much each number has changed; 0 where it is not determined."""
    both = zip(last.parameters, result.parameters, strict=True)
    return np.array([abs((a.value or 0) - b.value) if b.value is not None else 0.0 for a, b in both])


def _wider(result: JointResult, moved: Float[np.ndarray, " F"]) -> JointResult:
    """A result whose numbers may each be off by so much beside their errors."""
    parameters = list(map(widened, result.parameters, moved.tolist()))
    of_leaves = [[one.error for one in parameters if one.name == name] for name in dict.fromkeys(result)]
    errors = [np.array(own, float).reshape(old.shape) for own, old in zip(of_leaves, result.errors, strict=True)]
    return dataclasses.replace(result, parameters=tuple(parameters), errors=tuple(errors))


def _noise_of_each(result: JointResult, observed: Observed) -> NoiseOfEach:
    """What is left of each picture."""
    left = []
    for tile, predicted in zip(observed.tiles, _radiance(result, observed), strict=True):
        weight = np.ones(1) if tile.weight is None else np.asarray(tile.weight)
        counts = np.broadcast_to(weight.reshape(len(weight), -1) > 0, predicted.shape)
        left.append(Left(counts, np.where(counts, np.asarray(tile.target) - predicted, 0), predicted, tile.bounds))
    return noise_left(left, np.asarray(observed.owner), observed.roundings)


def _inside(scenes: Sequence[brdf.Scene], counted: Sequence[np.ndarray]) -> bool:
    """Whether no pixel that counts lies at an outline."""
    return all(np.all(_alike(scene, 1) | ~some) for scene, some in zip(scenes, counted, strict=True))


def _alike(scene: brdf.Scene, reach: int) -> Bool[np.ndarray, "H W"]:
    """Which pixels see what all see that are so many pixels around."""
    from scipy.ndimage import maximum_filter, minimum_filter  # it takes long to load

    met = np.asarray(scene.surface_points().met)
    return minimum_filter(met, 2 * reach + 1, mode="nearest") == maximum_filter(met, 2 * reach + 1, mode="nearest")


def _of_model(stated: FitProblem, model: str, solve: Callable[..., _Solved]) -> _Solved:
    """From the separable optimum of a model; of "auto" the simplest adequate one under the scenes of the best lobe."""
    separable = partial(_separable, stated)
    if model != "auto":
        return solve(separable(model, stated.scenes).material, stated.scenes)
    tried = (solve(separable(name, stated.scenes).material, stated.scenes) for name in CLASSIC)
    best = min(tried, key=lambda one: one.cost)
    simplest = separable("auto", best.result.scenes)
    with contextlib.suppress(InputError):  # of a number that the simplest model has not
        solved = solve(simplest.material, best.result.scenes)
        return solved._replace(result=dataclasses.replace(solved.result, candidates=simplest.candidates))
    return best


def _separable(stated: FitProblem, model: str, scenes: Sequence[brdf.Scene]) -> FitResult:
    return fit_pictures(dataclasses.replace(stated, model=model, scenes=list(scenes)))


def _sought_again(stated: FitProblem, solved: _Solved, solve: Callable[..., _Solved]) -> _Solved:
    """What was found, or what is found from the best of all exponents under its scenes, where that is elsewhere.

    Under the scenes that were told a clipped highlight may lead to another minimum, or seem to be none.
    """
    result = solved.result
    with contextlib.suppress(InputError):
        best = _separable(stated, result.material.name, result.scenes).material
        n, found = (max(float(getattr(one, "n", 0.0)), TINY) for one in (best, result.material))
        known = result["n"] if "n" in set(result) else None
        spread = float(known.error) / float(known.value) if known and known.value else 0.0
        if n > TINY and abs(math.log(n) - math.log(found)) > max(ELSEWHERE, ELSEWHERE_ERRORS * spread):
            other = solve(best, result.scenes)
            if other.cost < solved.cost:
                return other._replace(result=dataclasses.replace(other.result, candidates=result.candidates))
    return solved


@jax.jit
def _within(vector: Array, of_n: Array, bounded: Array) -> Array:
    """Freed numbers, none beyond its bound."""
    return jnp.where(of_n, jnp.clip(vector, *np.log(N_RANGE)), jnp.where(bounded & (vector < 0), 0, vector))


def _residuals(free: Array, given: tuple[JointProblem, Array, Array]) -> Array:
    problem, vector, held = given
    return problem.residuals(jnp.where(held, vector, free))


def _step(
    vector: Array, linear: tuple[Any, Any], bounded: Bool[np.ndarray, " U"]
) -> tuple[Float[np.ndarray, " U"], Float[np.ndarray, " U"], float]:
    """Gauss and Newton's step under the bounds, however little it gains: from where, the step, and its square.

    ``linear`` are the residuals and their derivatives; what is bounded may not be negative.
    """
    (residual, columns), epsilon = (np.asarray(a, np.float64) for a in linear), float(jnp.finfo(vector.dtype).eps)
    gram, base = columns @ columns.T, np.where(bounded, np.asarray(vector, np.float64), 0.0)
    gram[np.diag_indices_from(gram)] *= 1 + max(DAMPED, 10 * epsilon)
    step = nonnegative_minimum(gram, gram @ base - columns @ residual, ~bounded) - base
    return base, step, float(step @ gram @ step)


def _minimum(
    problem: JointProblem, brightest: float, solver: str | None, tolerance: float, max_steps: int
) -> tuple[JointProblem, dict[str, Any]]:
    """The least sum of squares that is found from a start: the problem there, and what a result says of the search.

    ``brightest`` is the pictures' largest value.
    """
    vector = problem.start()
    # Gauss and Newton's steps lead to the minimum from most starts, and compile half as much as a solver.
    whole = solver is None or all(leaf.name in EMITTANCES for leaf in problem.freed)
    jacobian = sum(target.size for target, _ in problem.pictures) * vector.size
    solver = solver or ("lm" if jacobian <= LARGEST_JACOBIAN else "bfgs")
    epsilon = float(jnp.finfo(vector.dtype).eps)
    # Of a smaller step rounding hides what it gains.
    close, unseen = max(tolerance, epsilon**0.5), max(tolerance, epsilon) * brightest
    method = SOLVERS[solver](rtol=close, atol=close)
    # Steps that rounding hides the gains of are tried for ever: it is asked several times.
    each = max(FEWEST_STEPS, -(-max_steps // ROUNDS)) if solver == "lm" else max_steps
    bounded, held = problem.each(lambda leaf: leaf.bounded), np.zeros(vector.shape, bool)
    of_n = problem.each(lambda leaf: leaf.name == "n")
    steps, converged, near, least, best = 0, False, whole, np.inf, problem
    of_k_s = problem.each(lambda leaf: leaf.name == "k_s")
    lobes = bool(of_n.any() and of_k_s.any())
    # Whether the last move was a step of Gauss and Newton's, and whether one has led astray.
    stepped, astray = whole, False
    for trial in range(ROUNDS * (2 + whole)):
        whole = whole and trial < ROUNDS
        vector = _within(vector, of_n, bounded)
        # Turns from here on are those of what was found.
        problem = problem.at(vector)
        vector = problem.start()
        residual, columns = (np.asarray(a, np.float64) for a in linearised(problem, vector))
        cost = float(residual @ residual)
        enough = MET**2 * np.mean(residual**2)
        # At a bend, as where a pixel sees a light set, such a step gains nothing, and what a solver says holds.
        if converged := bool(astray and near and abs(least - cost) <= enough):
            break
        better = cost <= least * (1 + epsilon**0.5)
        # What a solver leaves below a bound costs more at it, until the rest is fitted again.
        if not (better or (cost < np.inf and not stepped)):
            vector, problem, whole, near, stepped, astray = best.start(), best, False, False, False, not whole
            continue
        steps += whole
        if better:
            least, best = min(cost, least), problem
        base, step, gain = _step(vector, (residual, columns), bounded)
        step /= max(1.0, float(np.max(np.abs(step), where=of_n, initial=0.0)) / FARTHEST)
        met = gain <= enough + residual.size * unseen**2
        if met and lobes and not np.any(base[of_k_s]):
            # Of a lobe that is not there n says nothing: it may be that of another one.
            starts = [jnp.where(of_n, log_n, vector) for log_n in np.log(RESTARTS)]
            gains = [_step(one, linearised(problem, one), bounded)[2] for one in starts]
            lobes, met = False, max(gains) <= enough
            if not met:
                vector, near = starts[int(np.argmax(gains))], whole
                continue
        if steps >= max_steps and not met:
            break
        if met or (near and not astray):
            before, held, near, stepped = held, bounded & (base + step == 0), whole, True
            vector = vector + step
            if converged := bool(met and better) and np.array_equal(held, before):
                best = problem.at(vector)
                break
            continue
        # What a solver knows nothing of: a number at its bound stays there but where the cost falls inwards.
        held = bounded & np.asarray(vector == 0) & (columns @ residual >= 0)
        given, most = (problem, vector, jnp.asarray(held)), min(each, max_steps - steps)
        solution = optx.least_squares(_residuals, method, vector, given, max_steps=most, throw=False)
        steps += int(solution.stats["num_steps"])
        near, stepped = solution.result == optx.RESULTS.successful, False
        vector = jnp.where(held, vector, solution.value)
    return best, {"steps": steps, "converged": converged, "solver": "gauss-newton" if whole else solver}


def _solve(
    problem: JointProblem,
    observed: Observed,
    solver: str | None,
    tolerance: float,
    max_steps: int,
    widening: float,
) -> _Solved:
    problem, search = _minimum(problem, float(np.max(observed.brightest)), solver, tolerance, max_steps)
    bounded = problem.each(lambda leaf: leaf.bounded)
    vector = np.asarray(problem.start(), np.float64)
    held = bounded & (vector == 0)
    residual, columns = (np.asarray(a, np.float64) for a in linearised(problem, problem.start()))
    information = most_likely_numbers(problem, observed, vector)
    if information is not None:
        information = information._replace(widening=information.widening * widening)
        problem, held = problem.at(jnp.asarray(information.vector)), bounded & (information.vector == 0)
        residual = np.asarray(problem.residuals(problem.start()), np.float64)
    counts = np.concatenate([counted.ravel() for counted in observed.counted])
    left = residual.reshape(counts.size, -1)[counts]
    values = np.concatenate([np.asarray(target, np.float64) for target, _ in problem.pictures])[counts]
    squares = np.sum(left**2, axis=0)
    noise = np.sqrt(squares / max(len(left) - vector.size / squares.size, 1))
    share = float(np.sum(squares) / max(np.sum(values**2), TINY)) ** 0.5
    parts = problem.by_picture(residual)
    if information is not None:
        parts = list(map(_at_ends, parts, observed.tiles, information.at_ends))
    images = map(np.reshape, parts, (shown.shape for shown in observed.shown))
    neighbours = Neighbours()
    if share > NEGLIGIBLE:
        neighbours = neighbours_of(list(images))
        together = neighbours.significant, noise > 2 * observed.rounding
        neighbours = neighbours._replace(significant=_err_together(parts, observed, *together))
    if information is None:
        variance = value_variance(left, values + left, noise)
        information = by_least_squares(vector, columns, counts, variance, copies=observed.copies)
    material, scenes = jax.tree.map(np.asarray, problem.content())
    given = jax.tree.leaves((material, observed.problem.scenes))
    parameters, correlation = _parameters(problem, given, information, held)
    errors = [[one.error for one in parameters if one.name == leaf.words] for leaf in problem.freed]
    shapes = [() if leaf.is_direction else problem.leaves[leaf.position].shape for leaf in problem.freed]
    steps = search["steps"]
    remedy = "raise max_steps of fit_jointly" if steps >= max_steps else "start nearer, or free fewer numbers"
    warnings = () if search["converged"] else (f"the solver stopped after {steps} steps without an end: {remedy}",)
    if neighbours.significant:
        warnings += (f"{structure_words(neighbours.correlation)}: the errors are too small",)
    result = JointResult(
        **observed.result_fields() | {"scenes": scenes} | search,
        material=material,
        parameters=parameters,
        correlation=correlation,
        noise=noise,
        structure=neighbours.correlation,
        residual=share,
        pixels=len(left),
        warnings=warnings,
        values=tuple(np.asarray(problem.leaves[leaf.position]) for leaf in problem.freed),
        errors=tuple(np.array(own, float).reshape(shape) for own, shape in zip(errors, shapes, strict=True)),
    )
    bounds = (tile.bounds for tile in observed.tiles if tile.bounds is not None)
    shown = [Shown(own.spread, one.__getitem__) for own, one in zip(bounds, information.shown, strict=False)]
    return _Solved(result, information, shown, neighbours)


def _at_ends(
    residual: Float[np.ndarray, "P C"], tile: Tile, expected: Float[np.ndarray, "P C"]
) -> Float[np.ndarray, "P C"]:
    """Weighted residuals, with what is to be expected in the place of those of values of which one end is known."""
    weight = np.ones((1, 1)) if tile.weight is None else np.asarray(tile.weight).reshape(len(residual), -1)
    return np.where(np.isnan(expected), residual, expected * np.sqrt(weight))


def _err_together(
    residual: Sequence[Float[np.ndarray, "P C"]], observed: Observed, neighbours: bool, tell: Bool[np.ndarray, " C"]
) -> bool:
    """Whether pixels err together; those of compressed files beyond the blocks of these, whose errors know of it.

    In others neighbours may, or blocks of pixels in the channels whose noise is more than rounding: that errs together.
    """
    lossy = any(tile.bounds is not None and tile.bounds.lossy for tile in observed.tiles)
    some, grids = slice(1 if observed.copies else None), []
    for tile, width, own in zip(observed.tiles, observed.widths, residual, strict=True):
        # Blocks that an outline crosses say nothing.
        left = own if tile.bounds is None else np.where(tile.bounds.ends > 0, own, 0)
        # The noise may be the same in all channels.
        left = left[:, some] if lossy else np.sum(left, axis=1, keepdims=True, where=tell)
        errors = Errors(left, np.arange(len(left)), width)
        grids.append(of_coded_blocks(errors) if lossy else over_blocks(errors, SIZES[0]))
    beyond = structure(grids, CODED_SIZES if lossy else SIZES).significant
    return beyond or bool(neighbours and not lossy and np.any(tell))


def _parameters(
    problem: JointProblem, given: Sequence[Any], information: Information, held: Bool[np.ndarray, " U"]
) -> tuple[tuple[Parameter, ...], Float[np.ndarray, "F F"]]:
    """The freed numbers with their errors, and the correlation of those that are determined.

    Of a direction the length is no unknown: its error is that of two small turns across it.
    """
    covariance, deviation = information.errors()
    lost = _lost_in_noise(problem, information.vector, covariance, deviation)
    found: list[Parameter] = []
    places: list[int] = []
    for leaf in problem.freed:
        stored = np.asarray(problem.leaves[leaf.position])
        value, own = stored.astype(np.float64), deviation[leaf.numbers]
        if stored.dtype == np.float32:
            # Unknowns are turns of a direction, and of n its logarithm.
            own = np.hypot(own, RESOLUTION * (1 if leaf.is_direction or leaf.name == "n" else np.max(np.abs(value))))
        if leaf.is_direction:
            turned, size = degrees_between(np.asarray(given[leaf.position], np.float64), value), np.linalg.norm(own)
            towards = tuple((value / np.linalg.norm(value)).tolist())
            rows = [(-1, Parameter(leaf.words, None, turned, float(np.degrees(size)), direction=towards))]
        else:
            rows, errors = [], own * value if leaf.name == "n" else own
            for index, (one, error) in enumerate(zip(value.ravel().tolist(), errors.tolist(), strict=True)):
                place, channel = leaf.numbers.start + index, index if value.ndim else None
                ends, at_bound = _interval(leaf, one, error), bool(held[place])
                rows.append((place, Parameter(leaf.words, channel, one, error, ends, at_bound)))
        for place, one in rows:
            reason = LOST_IN_NOISE if lost and leaf.name in ("k_s", "n") else OPEN
            known = one.error is not None and np.isfinite(one.error) and reason == OPEN
            found.append(one if known else Parameter(leaf.words, one.channel, None, one.error, reason=reason))
            if known and not one.at_bound:
                places.append(place)
    error = np.sqrt(np.diag(covariance)[places])
    at = np.array(places, int)
    both, unit = (at >= 0)[:, None] & (at >= 0), np.outer(error, error)
    correlation = np.where(both, quotient(covariance[np.ix_(at, at)], unit), 0.0)
    np.fill_diagonal(correlation, 1.0)
    return tuple(found), correlation


def _lost_in_noise(
    problem: JointProblem,
    vector: Float[np.ndarray, " U"],
    covariance: Float[np.ndarray, "U U"],
    deviation: Float[np.ndarray, " U"],
) -> bool:
    """Whether a highlight whose k_s and n are freed does not stand out: its exponent is the best of many, as in `fit`.

    By how much the cost would rise without it tells the covariance of k_s at a given n.
    """
    leaves = {leaf.name: leaf.numbers for leaf in problem.freed if leaf.name in ("k_s", "n")}
    if len(leaves) < 2:
        return False
    k_s, n = vector[leaves["k_s"]], leaves["n"].start
    if not np.any(k_s):
        return True
    if not np.all(np.isfinite([*deviation[leaves["k_s"]], deviation[n]])):
        return False
    with_n = covariance[leaves["k_s"], n]
    left = covariance[leaves["k_s"], leaves["k_s"]] - np.outer(with_n, with_n) / max(covariance[n, n], TINY)
    return float(k_s @ scaled_inverse(left) @ k_s) <= SIGNIFICANT * (1 + np.count_nonzero(k_s))


def _interval(leaf: Leaf, value: float, error: float) -> tuple[float, float]:
    if leaf.name == "n":
        with np.errstate(over="ignore"):  # open above
            return value * np.exp(-NORMAL_95 * error / value), value * np.exp(NORMAL_95 * error / value)
    return above_zero(value, error) if leaf.bounded else (value - NORMAL_95 * error, value + NORMAL_95 * error)
