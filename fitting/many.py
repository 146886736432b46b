"""Many fits in one call: pictures of one size, each of a material of its own, through one compiled program.

A fit of a small picture is mostly the host's work between short programs. Here the core of the fit
(`fitting.functional`) runs over all pictures together: in one scene they share the basis images, the lobe on the grid
over n and its Gram matrices, so that of each picture little more is read than its products with those.

What one fit finds out about its picture, clipping, cut-off noise, values that are rounded, holds here too: pictures
that show signs of it are fitted by `fitting.fit`, one by one.
"""

import dataclasses
import functools
import math
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jax.sharding import Mesh
from jaxtyping import Array, Bool, Float

import brdf
from brdf.errors import InputError
from brdf.precision import Precision, working_precision
from brdf.rendering import Basis, basis
from fitting import functional
from fitting.codes import single_values_at_end
from fitting.core import fit_pictures
from fitting.light_colour import coefficient_factors, take_colour_out
from fitting.problem import TOP, FitProblem, state_problem
from fitting.progress import waiting
from fitting.report import FitResult
from fitting.solver.devices import core_count, device_count, gathered, own, placed, spread_over
from fitting.solver.normal_equations import COMPILER_OPTIONS

# So many pictures at a time: their columns stay in the processor's cache.
BATCH = 32
# Of no more pixels lobes are kept at all exponents of the grid.
FEW_PIXELS = 1 << 16
NAMES = ("k_a", "k_d", "k_s", "n")


class ManyFits(Sequence[FitResult]):
    """The fits of many pictures: numbers of all as arrays, and of each the whole result.

    Attributes:
        problem: the pictures and how they were fitted.
        k_a: ambient coefficients, (N, C); 0 where a fit has none.
        k_d: diffuse coefficients, (N, C).
        k_s: specular coefficients of the optima, (N, C); where noise hides a highlight, ``fits[i]`` is without.
        n: exponents of the optima, (N,), see ``k_s``.
        errors: standard errors of these by name, under independent noise; 0 at a bound.
        residual: root mean square of each residual over that of its picture, (N,).
        refused: of pictures that cannot be fitted, black ones or such as the mask leaves nothing of, why, by index.
            Their numbers are NaN, and ``fits[i]`` raises that as an `InputError`.

    Example:
        >>> scene = brdf.Scene.load("scene.toml")
        >>> pictures = np.stack([brdf.render(brdf.preset(name), scene) for name in ("gold", "emerald")])
        >>> fits = fitting.fit_many(pictures, scene, model="blinn-phong")
        >>> len(fits), fits.n.shape, fits[0].surface, round(float(fits[1].material.n), 1)
        (2, (2,), 'blinn-phong', 76.8)
    """

    def __init__(
        self,
        problem: FitProblem,
        numbers: dict[str, np.ndarray],
        done: dict[int, FitResult],
        refused: dict[int, InputError],
    ):
        """Gather what was found; `fit_many` does.

        Args:
            problem: all pictures.
            numbers: of all fits.
            done: results that are known already.
            refused: why others have none.
        """
        self.problem, self._done = problem, done
        self.refused = {index: str(error) for index, error in refused.items()}
        self.k_a, self.k_d, self.k_s, self.n, self.residual = (numbers[name] for name in (*NAMES, "residual"))
        self.errors = {name: numbers[f"{name}_error"] for name in NAMES}

    def __len__(self) -> int:
        """How many pictures."""
        return len(self.problem.targets)

    def __getitem__(self, index: Any) -> Any:
        """The result of one picture with intervals, warnings and report: made by `fitting.fit` when first asked for.

        Raises:
            InputError: where the picture was refused.
        """
        if isinstance(index, slice):
            return [self[i] for i in range(len(self))[index]]
        index = range(len(self))[index]
        if index not in self._done:
            self._done[index] = _fit_alone(self.problem, index)
        return self._done[index]

    def __repr__(self) -> str:
        """How many, of what."""
        height, width, channels = self.problem.targets[0].pixels.shape
        refused = f", {len(self.refused)} refused" if self.refused else ""
        return f"ManyFits({len(self)} pictures, {width} x {height} x {channels}, {self.problem.model}{refused})"


def fit_many(
    pictures: Any,
    scenes: brdf.Scene | Sequence[brdf.Scene],
    *,
    model: Any = "auto",
    precision: Precision = "float32",
    mask: Any = None,
    n_range: tuple[float, float] = (0.1, 1e6),
    mesh: Mesh | None = None,
) -> ManyFits:
    """Fit a material to each of many pictures of one size, as `fitting.fit` does to one.

    Args:
        pictures: (N, H, W, C) linear values, or a list of what `fitting.fit` takes.
        scenes: one scene that all show, or a list of one for each.
        model: the name of a model: then all are fitted together. "auto" compares models for each picture, one by
            one.
        precision: "float32" or "float64".
        mask: (H, W), or a file: pixels to look at in every picture; or a list of one for each.
        n_range: bounds of the exponent.
        mesh: of the devices to deal the pictures out to, see `fitting.fit`; where a model is named.

    Returns:
        The fits: ``fits.n``, ``fits.k_d`` are arrays, ``fits[i]`` is the result of one. Of a picture that cannot be
        fitted the numbers are NaN, and ``fits.refused`` says why.

    Raises:
        InputError: naming the argument, where it cannot be used, or the first picture, where none can be fitted.

    Example:
        >>> scene = brdf.Scene.load("scene.toml")
        >>> pictures = np.stack([brdf.render(brdf.preset(name), scene) for name in ("gold", "ruby")])
        >>> fitting.fit_many(pictures, scene, model="blinn-phong").k_d.shape
        (2, 3)
    """
    if not (isinstance(pictures, list | tuple) or np.ndim(pictures) == 4):
        what = f"must be an array (N, H, W, C) or a list, got {type(pictures).__name__} {np.shape(pictures) or ''}"
        raise InputError("pictures", what.rstrip(), "Stack them, or call fitting.fit for one")
    pictures = list(pictures)
    scenes = [scenes] * len(pictures) if isinstance(scenes, brdf.Scene) else scenes
    mask = mask if isinstance(mask, list | tuple) else [mask] * len(pictures)
    try:
        problem = state_problem(pictures, scenes, mask, model=model, precision=precision, n_range=n_range)
    except InputError as error:
        each = {f"target[{index}]": f"pictures[{index}]" for index in range(len(pictures))}
        raise error.renamed({"target": "pictures", "scene": "scenes"} | each) from None
    shapes = {target.pixels.shape for target in problem.targets}
    if len(shapes) > 1 or problem.streamed:
        what = "are read by bands" if problem.streamed else f"have the shapes {sorted(shapes)}"
        raise InputError("pictures", f"{what}, and are fitted together", "Give arrays of one size, or call fitting.fit")
    with waiting(f"fitting {len(pictures)} pictures"):
        with working_precision(problem.precision), spread_over(mesh):
            plain, numbers = _fit_together(problem)
        done, refused = {}, {}
        for index in map(int, np.flatnonzero(~plain)):
            try:
                done[index] = _fit_alone(problem, index)
            except InputError as error:
                refused[index] = error
    if len(refused) == len(pictures):
        raise refused[0]
    for index, result in done.items():
        for name, value in _numbers_of(result).items():
            numbers.setdefault(name, np.zeros((len(pictures), *value.shape)))[index] = value
    for values in numbers.values():
        values[list(refused)] = np.nan
    return ManyFits(problem, numbers, done, refused)


def _fit_alone(problem: FitProblem, index: int) -> FitResult:
    lists = {name: [getattr(problem, name)[index]] for name in ("targets", "scenes", "masks", "weights")}
    start = time.perf_counter()
    try:
        result = fit_pictures(dataclasses.replace(problem, **lists))
        return dataclasses.replace(result, seconds=time.perf_counter() - start)
    except InputError as error:
        raise error.inside(f"pictures[{index}]") from None


def _numbers_of(result: FitResult) -> dict[str, np.ndarray]:
    found = {"residual": np.asarray(result.residual)}
    for name in NAMES:
        shape = () if name == "n" else result.material.k_d.shape
        errors = [(one.error, one.at_bound) for one in result.parameters if one.name == name]
        errors = [0.0 if at_bound else math.inf if error is None else error for error, at_bound in errors]
        found[name] = np.broadcast_to(getattr(result.material, name, 0.0), shape)
        found[f"{name}_error"] = np.reshape(errors or np.zeros(shape), shape)
    return found


def _fit_together(problem: FitProblem) -> tuple[Bool[np.ndarray, " N"], dict[str, np.ndarray]]:
    """Which pictures need no closer look, and the numbers of all; none where each needs one."""
    (scene, *others), masks, count = problem.scenes, list(map(np.asarray, problem.masks)), len(problem.targets)
    alike = all(one is scene for one in others) and all(np.array_equal(one, masks[0]) for one in masks)
    targets = np.stack([target.pixels for target in problem.targets]).astype(problem.precision, copy=False)
    colour, scenes = take_colour_out(problem.scenes[:1] if alike else problem.scenes, targets.shape[-1])
    # Those of another structure are fitted by themselves.
    same = [_structure(one) == _structure(scenes[0]) for one in scenes]
    stackable = [one if fits else scenes[0] for one, fits in zip(scenes, same, strict=True)]
    stack = brdf.cast(jax.tree.map(lambda *leaves: np.stack(leaves), *stackable), problem.precision)
    both = zip(np.asarray(_seen(stack)), problem.masks, strict=False)
    seen = np.stack([one & (True if some is None else some) for one, some in both])
    exact = [target.codes is None and target.saturation is None for target in problem.targets]
    plain = np.array(exact) & np.array(same)
    if problem.model == "auto" or not (plain.any() and seen.any()):
        return plain & False, {}
    ordinary = _plain(targets, np.broadcast_to(seen, targets.shape[:3]))  # is found out beside the fits
    model = brdf.MODELS[problem.model]
    if alike:
        scene, pixel = brdf.cast(scenes[0], problem.precision), np.flatnonzero(seen)
        images = basis(model, brdf.some_pixels(scene, pixel, precision=problem.precision))
        pictures = {"target": np.take(targets.reshape(count, -1, targets.shape[-1]), pixel, axis=1)}
        shared = {"images": images, "weight": np.ones(pixel.size, targets.dtype), "ambient": scene.ambient}
    else:
        weight = seen.reshape(count, -1).astype(targets.dtype)
        pictures = {"target": targets, "images": _bases(model, stack), "weight": weight, "ambient": stack.ambient}
        shared = {}
    lanes, cores = device_count(), core_count()
    # Equal parts, or each size would be compiled.
    lanes = cores if lanes == 1 and count % (cores * BATCH) == 0 else min(lanes, count)
    mine = own(lanes)
    parts = [placed(lane, (jax.tree.map(lambda leaf, lane=lane: leaf[lane::lanes], pictures), shared)) for lane in mine]

    def solve(part: Any) -> Float[np.ndarray, "N K"]:
        with working_precision(problem.precision):  # each thread has its own
            return np.asarray(_solved(model, *part, problem.n_range), np.float64)

    rows = {}
    with ThreadPoolExecutor(len(mine) or 1) as pool:
        for lane, part in zip(mine, pool.map(solve, parts), strict=True):
            rows |= {lane + lanes * place: row for place, row in enumerate(part)}
    channels = targets.shape[-1]
    table = gathered(rows, count, (7 * channels + 3,))
    ends = np.cumsum([channels] * 3 + [1] + [channels] * 4 + [1])
    k_a, k_d, k_s, n, cost, *errors, square = np.split(table, ends, axis=1)
    factors = coefficient_factors(model, n, colour)
    numbers = {"n": np.where(k_s.any(axis=1), n[:, 0], 0), "n_error": errors[3][:, 0]}
    for name, value, error, by in zip(NAMES, (k_a, k_d, k_s), errors, factors, strict=False):
        numbers |= {name: value / by, f"{name}_error": error / by}
    with np.errstate(invalid="ignore", divide="ignore"):
        return plain & np.asarray(ordinary), numbers | {"residual": np.sqrt(cost.sum(axis=1) / square[:, 0])}


def _structure(scene: brdf.Scene) -> tuple[Any, ...]:
    """What is the same in scenes that differ in nothing but numbers."""
    leaves, structure = jax.tree.flatten(scene)
    return structure, [leaf.shape for leaf in leaves]


@jax.jit
def _seen(scenes: brdf.Scene) -> Bool[Array, "N H W"]:
    return jax.lax.map(lambda scene: scene.surface_points().mask, scenes)


@functools.partial(jax.jit, static_argnums=0)
def _bases(model: type[brdf.Material], scenes: brdf.Scene) -> Basis:
    """A program of its own: inside that of the fits XLA would make geometry and lights anew at every step."""
    return jax.lax.map(functools.partial(basis, model), scenes)


@functools.partial(jax.jit, static_argnums=(0, 3), compiler_options=COMPILER_OPTIONS)
def _solved(
    model: type[brdf.Material], pictures: dict[str, Any], shared: dict[str, Any], n_range: tuple[float, float]
) -> Float[Array, "N K"]:
    """The numbers of the solution of each picture, and the sum of its squares.

    ``shared`` is what of the arguments of `fitting.functional.fit_basis` is the same for all.
    """

    def fit(picture: dict[str, Any]) -> Array:
        given = picture | shared
        counts = given["weight"][:, None] > 0
        values = jnp.where(counts, given["target"].reshape(len(counts), -1), 0)
        alike = bool(shared) and len(counts) <= FEW_PIXELS
        solution = functional.fit_basis(model, **given, n_range=n_range, alike=alike)
        return ravel_pytree((solution, jnp.sum(values * values)))[0]

    return jax.lax.map(fit, pictures, batch_size=BATCH)


@jax.jit
@jax.vmap
def _plain(target: Float[Array, "N H W C"], seen: Bool[Array, "N H W"]) -> Bool[Array, " N"]:
    """Whether all pixels of a picture count, and alike: finite, nothing clipped, no noise cut off."""
    brightest = jnp.max(target, axis=-1)
    largest = jnp.max(jnp.where(seen, brightest, -jnp.inf))
    top = jnp.count_nonzero(seen & (brightest >= largest * TOP))
    least = jnp.min(target, where=jnp.isfinite(target), initial=jnp.inf)
    cut = jax.vmap(single_values_at_end, (-1, None, None))(target, seen, least)
    finite = jnp.all(jnp.isfinite(target) | ~seen[..., None])
    return finite & (largest > 0) & (top <= 1) & ~jnp.any(cut)
