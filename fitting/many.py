"""Many fits in one call: pictures of one size, each of a material of its own, through one compiled program.

A fit of a small picture is mostly the host's work between short programs. Here the core of the fit
(`fitting.functional`) runs over all pictures together: in one scene they share the basis images, the lobe on the grid
over n and its Gram matrices, so that of each picture little more is read than its products with those.

What one fit finds out about its picture, clipping, cut-off noise, values that are rounded, holds here too: pictures
that show signs of it are fitted by `fitting.fit`, one by one.
"""

import dataclasses
import functools
from collections.abc import Iterator, Sequence
from typing import Any, overload

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jax.sharding import Mesh
from jaxtyping import Array, Bool, Float

import brdf
from brdf.errors import InputError
from brdf.models.base import SpecularMaterial
from brdf.precision import Precision, working_precision
from brdf.rendering import Basis, basis
from fitting import functional
from fitting.codes import single_values_at_end
from fitting.core import fit_pictures
from fitting.light_colour import take_colour_out
from fitting.pixels import SYMMETRIC_PIXELS
from fitting.problem import TOP, FitProblem, state_problem
from fitting.progress import waiting
from fitting.report import FitResult
from fitting.solver.devices import device_count, gathered, own, placed, spread_over

# So many pictures at a time: their columns stay in the processor's cache.
BATCH = 16
NAMES = ("k_a", "k_d", "k_s", "n")


class ManyFits(Sequence[FitResult]):
    """The fits of many pictures: numbers of all as arrays, and of each the whole result.

    Attributes:
        problem: the pictures and how they were fitted.

    Example:
        >>> scene = brdf.Scene.load("scene.toml")
        >>> pictures = np.stack([brdf.render(brdf.preset(name), scene) for name in ("gold", "emerald")])
        >>> fits = fitting.fit_many(pictures, scene, model="blinn-phong")
        >>> len(fits), fits.n.shape, fits[0].surface, round(float(fits[1].material.n), 1)
        (2, (2,), 'blinn-phong', 76.8)
    """

    def __init__(self, problem: FitProblem, numbers: dict[str, np.ndarray] | None, done: dict[int, FitResult]):
        """Gather what was found; `fit_many` does.

        Args:
            problem: all pictures.
            numbers: of all fits; None takes them from the results.
            done: results that are known already.
        """
        self.problem, self._numbers, self._done = problem, numbers, done

    def __len__(self) -> int:
        """How many pictures."""
        return len(self.problem.targets)

    @overload
    def __getitem__(self, index: int) -> FitResult: ...
    @overload
    def __getitem__(self, index: slice) -> list[FitResult]: ...
    def __getitem__(self, index: int | slice) -> FitResult | list[FitResult]:
        """The result of one picture with intervals, warnings and report: made by `fitting.fit` when first asked for."""
        if isinstance(index, slice):
            return [self[i] for i in range(len(self))[index]]
        index = range(len(self))[index]
        if index not in self._done:
            self._done[index] = _fit_alone(self.problem, index)
        return self._done[index]

    def __repr__(self) -> str:
        """How many, of what."""
        height, width, channels = self.problem.targets[0].pixels.shape
        return f"ManyFits({len(self)} pictures, {width} x {height} x {channels}, {self.problem.model})"

    @functools.cached_property
    def numbers(self) -> dict[str, np.ndarray]:
        """k_a, k_d, k_s (N, C), n and the residual (N,), and errors as ``n_error``; 0 where a fit has none."""
        if self._numbers is not None:
            return self._numbers
        rows = [_numbers_of(result) for result in self]
        return {name: np.stack([row[name] for row in rows]) for name in rows[0]}

    @property
    def k_a(self) -> Float[np.ndarray, "N C"]:
        """Ambient coefficients."""
        return self.numbers["k_a"]

    @property
    def k_d(self) -> Float[np.ndarray, "N C"]:
        """Diffuse coefficients."""
        return self.numbers["k_d"]

    @property
    def k_s(self) -> Float[np.ndarray, "N C"]:
        """Specular coefficients of the optima; where noise hides a highlight, ``fits[i]`` is without."""
        return self.numbers["k_s"]

    @property
    def n(self) -> Float[np.ndarray, " N"]:
        """Exponents of the optima, see ``k_s``."""
        return self.numbers["n"]

    @property
    def errors(self) -> dict[str, np.ndarray]:
        """Standard errors of k_a, k_d, k_s and n, under independent noise; 0 at a bound."""
        return {name: self.numbers[f"{name}_error"] for name in NAMES}

    @property
    def residual(self) -> Float[np.ndarray, " N"]:
        """Root mean square of each residual over that of its picture."""
        return self.numbers["residual"]


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
        model: the name of a model: then all are fitted together. "auto" compares models for each picture, one by one,
            when its result is asked for.
        precision: "float32" or "float64".
        mask: (H, W), pixels to look at in every picture, or a list of one for each.
        n_range: bounds of the exponent.
        mesh: of the devices to deal the pictures out to, see `fitting.fit`; where a model is named.

    Returns:
        The fits: ``fits.n``, ``fits.k_d`` are arrays, ``fits[i]`` is the result of one.

    Raises:
        InputError: naming the argument, where it cannot be used.

    Example:
        >>> scene = brdf.Scene.load("scene.toml")
        >>> pictures = np.stack([brdf.render(brdf.preset(name), scene) for name in ("gold", "ruby")])
        >>> fitting.fit_many(pictures, scene, model="blinn-phong").k_d.shape
        (2, 3)
    """
    pictures = list(pictures)
    scenes = [scenes] * len(pictures) if isinstance(scenes, brdf.Scene) else scenes
    mask = mask if isinstance(mask, list | tuple) else [mask] * len(pictures)
    problem = state_problem(pictures, scenes, mask, model=model, precision=precision, n_range=n_range)
    shapes = {target.pixels.shape for target in problem.targets}
    if len(shapes) > 1 or problem.streamed:
        came = "are read by bands" if problem.streamed else f"have the shapes {sorted(shapes)}"
        raise InputError("pictures", f"{came}, and are fitted together", "Give arrays of one size, or call fitting.fit")
    if problem.model == "auto":
        return ManyFits(problem, None, {})
    with waiting(f"fitting {len(pictures)} pictures"):
        with working_precision(problem.precision), spread_over(mesh):
            numbers, plain = _fit_together(problem)
        done = {int(i): _fit_alone(problem, int(i)) for i in np.flatnonzero(~plain)}
    if numbers is not None:
        for index, result in done.items():
            for name, value in _numbers_of(result).items():
                numbers[name][index] = value
    return ManyFits(problem, numbers, done)


def _fit_alone(problem: FitProblem, index: int) -> FitResult:
    lists = {name: [getattr(problem, name)[index]] for name in ("targets", "scenes", "masks", "weights")}
    try:
        return fit_pictures(dataclasses.replace(problem, **lists))
    except InputError as error:
        raise error.inside(f"pictures[{index}]") from None


def _numbers_of(result: FitResult) -> dict[str, np.ndarray]:
    material, channels = result.material, result.material.k_d.shape[0]
    found = {name: np.asarray(getattr(material, name, np.zeros(channels))) for name in NAMES[:3]}
    found |= {"n": np.asarray(getattr(material, "n", 0.0)), "residual": np.asarray(result.residual)}
    for name in NAMES:
        errors = [0.0 if one.at_bound else one.error for one in result.parameters if one.name == name]
        errors = [np.inf if error is None else error for error in errors] or [0.0]
        found[f"{name}_error"] = np.asarray(errors[0] if name == "n" else np.broadcast_to(errors, channels))
    return found


def _fit_together(problem: FitProblem) -> tuple[dict[str, np.ndarray] | None, Bool[np.ndarray, " N"]]:
    """The numbers of all fits, and which pictures need no closer look; None for the numbers where all need one."""
    model, dtype, count = brdf.MODELS[problem.model], np.dtype(problem.precision), len(problem.targets)
    targets = np.stack([target.pixels for target in problem.targets]).astype(dtype, copy=False)
    channels = targets.shape[-1]
    light = take_colour_out(problem.scenes[:1] if _alike(problem) else problem.scenes, channels)
    scenes = [brdf.cast(scene, problem.precision) for scene in light.scenes]
    allowed = [True if mask is None else mask for mask in problem.masks[: len(scenes)]]
    both = zip(scenes, allowed, strict=True)
    seen = np.stack([np.asarray(scene.surface_points().mask) & mask for scene, mask in both])
    exact = np.array([target.codes is None and target.saturation is None for target in problem.targets])
    plain = exact & np.asarray(_plain(targets, seen))
    if not plain.any():
        return None, plain
    if len(scenes) == 1:
        pixel = np.flatnonzero(seen)
        images = basis(model, brdf.some_pixels(scenes[0], pixel, precision=problem.precision))
        few = jnp.asarray(np.take(targets.reshape(count, -1, channels), pixel, axis=1))
        shared = {"images": images, "weight": jnp.ones(pixel.size, dtype), "ambient": scenes[0].ambient}
        found = _dealt_out({"target": few}, shared, problem.n_range)
    else:
        found = None
        for some in _of_one_structure(scenes):
            stack = jax.tree.map(lambda *leaves: jnp.stack(leaves), *(scenes[i] for i in some))
            weight = jnp.asarray(seen[some].reshape(len(some), -1), dtype)
            given = {"target": jnp.asarray(targets[some]), "images": _bases(model, stack)}
            part = _dealt_out(given | {"weight": weight, "ambient": stack.ambient}, {}, problem.n_range)
            if found is None:
                found = jax.tree.map(lambda leaf: np.zeros((count, *leaf.shape[1:]), leaf.dtype), part)
            jax.tree.map(lambda whole, leaf, some=some: whole.__setitem__(some, leaf), found, part)
    assert found is not None
    solution, square = jax.tree.map(np.array, found)
    factor = np.where(light.colour > 0, light.colour, 1.0)
    scale = model.scale(solution.n)[:, None] if issubclass(model, SpecularMaterial) else 1.0
    numbers = {"n": np.where(solution.k_s.any(axis=1), solution.n, 0), "n_error": solution.errors[3]}
    for name, by, error in zip(NAMES, (1.0, factor, factor * scale), solution.errors, strict=False):
        numbers |= {name: np.array(getattr(solution, name) / by), f"{name}_error": np.array(error / by)}
    with np.errstate(invalid="ignore", divide="ignore"):
        return numbers | {"residual": np.sqrt(solution.cost.sum(axis=1) / square)}, plain


def _alike(problem: FitProblem) -> bool:
    """Whether all pictures show one scene, and the same pixels of it."""
    (scene, *scenes), (mask, *masks) = problem.scenes, [np.asarray(one) for one in problem.masks]
    return all(one is scene for one in scenes) and all(np.array_equal(one, mask) for one in masks)


def _of_one_structure(scenes: Sequence[brdf.Scene]) -> Iterator[list[int]]:
    """Indices of scenes that differ in nothing but numbers, together."""
    groups: dict[Any, list[int]] = {}
    for index, scene in enumerate(scenes):
        leaves, structure = jax.tree.flatten(scene)
        groups.setdefault((structure, tuple(leaf.shape for leaf in leaves)), []).append(index)
    yield from groups.values()


def _dealt_out(pictures: dict[str, Any], shared: dict[str, Any], n_range: Any) -> tuple[functional.Solution, Array]:
    """What is found of pictures, those of each device of the mesh on that device; see `_solved`."""
    if device_count() == 1:
        return _solved(pictures, shared, n_range)
    count = len(pictures["target"])
    if count < device_count():
        came = f"has {device_count()} devices for {count} pictures"
        raise InputError("mesh", came, "Give no more devices than pictures, or leave it out")
    places = np.array_split(np.arange(count), device_count())
    rows, some = {}, None
    for device in own(device_count()):
        mine = jax.tree.map(lambda leaf, some=places[device]: leaf[some], pictures)
        some = _solved(placed(device, mine), placed(device, shared), n_range)
        table = np.asarray(jax.vmap(lambda one: ravel_pytree(one)[0])(some), np.float64)
        rows |= dict(zip(places[device].tolist(), table, strict=True))
    flat, unravel = ravel_pytree(jax.tree.map(lambda leaf: leaf[0], some))
    return jax.vmap(unravel)(jnp.asarray(gathered(rows, count, flat.shape), flat.dtype))


@functools.partial(jax.jit, static_argnums=0)
def _bases(model: type[brdf.Material], scenes: brdf.Scene) -> Basis:
    """A program of its own: inside that of the fits XLA would make geometry and lights anew at every step."""
    return jax.lax.map(functools.partial(basis, model), scenes)


@functools.partial(jax.jit, static_argnums=2)
def _solved(
    pictures: dict[str, Any], shared: dict[str, Any], n_range: tuple[float, float]
) -> tuple[functional.Solution, Array]:
    """The solution of each picture, and the sum of its squares.

    Args:
        pictures: what `fitting.functional.fit_basis` takes, of each picture.
        shared: what of that is the same for all.
        n_range: bounds of the exponent.
    """

    def fit(picture: dict[str, Any]) -> tuple[functional.Solution, Array]:
        given = picture | shared
        counts = given["weight"][:, None] > 0
        values = jnp.where(counts, given["target"].reshape(len(counts), -1), 0)
        return functional.fit_basis(**given, n_range=n_range), jnp.sum(values * values)

    return jax.lax.map(fit, pictures, batch_size=BATCH)


@jax.jit
def _plain(targets: Float[Array, "N H W C"], seen: Bool[Array, "#N H W"]) -> Bool[Array, " N"]:
    """Whether all pixels of a picture count, and alike: finite, nothing clipped, no noise cut off."""

    def plain(target: Array, seen: Array) -> Array:
        brightest = jnp.max(target, axis=-1)
        largest = jnp.max(jnp.where(seen, brightest, -jnp.inf))
        top = jnp.count_nonzero(seen & (brightest >= largest * TOP))
        least = jnp.min(target, where=jnp.isfinite(target), initial=jnp.inf)
        cut = jax.vmap(single_values_at_end, (-1, None, None))(target, seen, least)
        finite = jnp.all(jnp.isfinite(target) | ~seen[..., None])
        return finite & (largest > 0) & (top <= SYMMETRIC_PIXELS) & ~jnp.any(cut)

    return jax.vmap(plain, (0, 0 if len(seen) > 1 else None))(targets, seen if len(seen) > 1 else seen[0])
