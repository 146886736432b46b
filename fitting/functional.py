"""The core of the fit as a function of arrays: for use inside `jax.jit`, `jax.vmap` and `jax.grad`.

What `fitting.fit` does on the host, with masks, errors and warnings, is here one pure program with fixed trip counts:
the global optimum of ``sum w (target - k_a I_a - k_d D - k_s S(n))²`` over n and k >= 0.

| you want | use |
| --- | --- |
| a material as a function of a picture and a scene, to differentiate or to batch | `fit` |
| the same for basis images of your own: another lobe, another renderer | `solve` |
| errors, intervals, warnings, masks found by themselves | `fitting.fit`, `fitting.fit_many` |

How. For a given n the best k is a tiny exact problem (variable projection, Golub and Pereyra 1973, SIAM J. Numer. Anal.
10, 413). A grid over log n with slopes gives Hermite's cubic in each cell; the two lowest valleys are evaluated, and
the better one is followed by Newton's steps with the exact second derivative, kept inside a bracket.

Derivatives come from the implicit function theorem at the optimum and not from the search: ``dθ/dp = -H⁻¹ ∂g/∂p`` with
the gradient g and the whole Hessian H of the cost. Numbers at their bound stay there; an n without a highlight has the
derivative 0.

Precision is that of the arrays. In float32, pictures of up to some 10⁵ pixels lose nothing that a picture's noise
leaves; larger ones are for `fitting.fit`, which adds up in float64.

Example:
    >>> import jax, jax.numpy as jnp
    >>> target, scene = brdf.read_image("target.exr"), brdf.Scene.load("scene.toml")
    >>> def n_under(direction):
    ...     light = brdf.DirectionalLight(direction=direction, intensity=scene.lights[0].intensity)
    ...     lit = brdf.Scene(camera=scene.camera, shapes=scene.shapes, ambient=scene.ambient, lights=(light,))
    ...     return fitting.functional.fit(target, lit).material.n
    >>> jax.grad(n_under)(jnp.asarray(scene.lights[0].direction)).shape
    (3,)
"""

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Float

import brdf
from brdf.checks import instance
from brdf.errors import InputError
from brdf.models.base import SpecularMaterial, check_model
from brdf.rendering import Basis, basis
from fitting.problem import check_exponents
from fitting.solver.nnls import nonnegative_minima
from fitting.solver.normal_equations import totals
from fitting.solver.profile import UNSEEN, lowest_in_cells

# As a function of log n a lobe varies on a scale of 1 or more; Hermite's cubic over such a cell finds every valley.
GRID_STEP = 0.7
# Newton's steps double the digits, from a cell's cubic to the end of the precision.
STEPS = {"float32": 4, "float64": 6}


class Solution(NamedTuple):
    """The optimum as arrays.

    Attributes:
        k_a: (C,), of the ambient light.
        k_d: (C,), of the diffuse basis.
        k_s: (C,), of the lobe.
        n: exponent; of Lambert 1. Without a highlight, k_s being 0, it has no meaning.
        cost: least sum of weighted squared residuals, (C,).
        errors: standard errors of the four under noise that is independent and alike in all pixels of a channel; of
            what is at its bound 0, infinite where the pixels do not determine it. Over the model's scale that of k_s
            is the error of the material's.
    """

    k_a: Float[Array, " C"]
    k_d: Float[Array, " C"]
    k_s: Float[Array, " C"]
    n: Float[Array, ""]
    cost: Float[Array, " C"]
    errors: tuple[Array, Array, Array, Array]


class MaterialFit(NamedTuple):
    """A material and how well it fits.

    Attributes:
        material: the fitted material, a pytree.
        solution: the same as arrays, with cost and errors; ``k_s`` there is without the model's scale.
    """

    material: brdf.Material
    solution: Solution


class _Pixels(NamedTuple):
    """Pixels of C channels, which share a basis image (B = 1) or have their own (B = C).

    Attributes:
        target: (C, P), 0 where a pixel does not count.
        diffuse: (B, P).
        weight: (P,).
        free: which of x_a, x_d, x_s may be above 0, (C, 3).
    """

    target: Array
    diffuse: Array
    weight: Array
    free: Array

    def residual(self, x: Array, lobe: Array) -> Array:
        """What coefficients (C, 3) and a lobe (B, P) leave, (C, P)."""
        shown = x[:, :1] + x[:, 1:2] * self.diffuse + x[:, 2:] * lobe
        return jnp.where(self.weight > 0, self.target - shown, 0)

    def columns(self, *lobes: Array) -> tuple[Array, Array]:
        """Columns ambient, diffuse and others, weighted, (B, K, P), and their products with each other, (B, K, K)."""
        columns = jnp.stack([jnp.ones_like(self.diffuse), self.diffuse, *lobes], axis=1)
        weighted = columns * self.weight
        return weighted, jnp.einsum("bkp,bjp->bkj", weighted, columns, precision="highest")


class _Sums(NamedTuple):
    """Over pixels: of the columns' products, (B, 4, 4), of those with a residual, (C, 4), and of its square, (C,)."""

    gram: Array
    product: Array
    square: Array


class _Point(NamedTuple):
    """The best coefficients at an exponent, (C, 3); their cost, and its derivative by log n."""

    x: Array
    cost: Array
    slope: Array


def fit(
    target: Float[ArrayLike, "H W C"],
    scene: brdf.Scene,
    model: type[brdf.Material] = brdf.BlinnPhong,
    *,
    weight: Float[ArrayLike, "H W"] | None = None,
    n_range: tuple[float, float] = (0.1, 1e6),
) -> MaterialFit:
    """Fit a material to a picture: a pure function, differentiable in every leaf of the picture and the scene.

    Args:
        target: linear values.
        scene: what the picture shows.
        model: the class of the material.
        weight: of each pixel, at least 0; None for 1. Pixels that see no fitted shape weigh nothing.
        n_range: bounds of the exponent, numbers.

    Returns:
        The material, and cost and errors.

    Raises:
        InputError: where the model is no class of a material, the picture is not what the scene shows or holds codes,
            or another argument cannot be used.

    Example:
        >>> import jax, jax.numpy as jnp
        >>> target, scene = brdf.read_image("target.exr"), brdf.Scene.load("scene.toml")
        >>> pictures = jnp.stack([target, 0.5 * target])
        >>> found = jax.jit(jax.vmap(lambda picture: fitting.functional.fit(picture, scene)))(pictures)
        >>> found.material.k_d.shape, bool(jnp.allclose(found.material.k_d[0], 2 * found.material.k_d[1], rtol=1e-3))
        ((2, 3), True)
    """
    check_model(model)
    instance("scene", scene, brdf.Scene, "Write fitting.functional.fit(target, scene)")
    check_exponents(n_range)
    target, (width, height) = jnp.asarray(target), scene.resolution
    channels = target.shape[-1] if scene.channels == 1 and target.ndim == 3 else scene.channels
    if target.shape != (height, width, channels):
        shown = "C" if scene.channels == 1 else channels
        what = f"must be of shape ({height}, {width}, {shown}), got {target.shape}"
        raise InputError("target", what, "Give the picture that the scene shows")
    if not jnp.issubdtype(target.dtype, jnp.floating):
        remedy = "Decode it, as brdf.read_image does, or use fitting.fit, which knows what codes say"
        raise InputError("target", f"must hold linear values, got codes of type {target.dtype}", remedy)
    target = target.astype(jnp.promote_types(target.dtype, jnp.float32))
    if weight is not None:
        counts = isinstance(weight, Tracer) or np.all(np.asarray(weight) >= 0)
        if np.shape(weight) != (height, width) or not counts:
            what = f"must be of shape ({height}, {width}) and at least 0, got shape {np.shape(weight)}"
            raise InputError("weight", what, "Give a weight for each pixel, 0 for those that do not count")
    scene = brdf.cast(scene, "float64" if target.dtype == jnp.float64 else "float32")
    points = scene.sight()
    seen = jnp.ravel(points.mask)
    weight = seen if weight is None else seen * jnp.ravel(jnp.asarray(weight))
    solution = fit_basis(model, target, basis(model, scene, points=points), weight, scene.ambient, n_range)
    k: dict[str, Any] = {"k_a": solution.k_a, "k_d": solution.k_d}
    if issubclass(model, SpecularMaterial):
        k |= {"k_s": solution.k_s / model.scale(solution.n), "n": solution.n}
    return MaterialFit(model(**k), solution)


@eqx.filter_jit
def fit_basis(
    model: type[brdf.Material],
    target: Array,
    images: Basis,
    weight: Array,
    ambient: Array | None,
    n_range: tuple[float, float],
    alike: bool = False,
) -> Solution:
    """What `fit` does once the basis images of a scene are known: of a target (..., C) of P pixels and weights (P,)."""
    scale = model.scale if issubclass(model, SpecularMaterial) else None
    diffuse = jnp.zeros((weight.size, 1), target.dtype) if images.diffuse is None else images.diffuse
    lobe, peak = images.lobe, jnp.zeros(())
    if lobe is not None:
        peak = jnp.max(jnp.where(weight > 0, lobe.peak, -jnp.inf))
        lobe = eqx.Partial(lambda lobe, n: lobe(n)[0], lobe)
    ambient = jnp.zeros(1) if ambient is None else ambient
    target = target.reshape(weight.size, -1)
    known: dict[str, Any] = {"ambient": ambient, "weight": weight, "n_range": n_range, "peak": peak}
    return solve(target, diffuse, lobe, **known, scale=scale, alike=alike)


@eqx.filter_jit
def solve(
    target: Float[ArrayLike, "P C"],
    diffuse: Float[ArrayLike, "P Cb"],
    lobe: Callable[[Float[Array, ""]], Float[Array, "P Cb"]] | None = None,
    *,
    ambient: Float[ArrayLike, " Ca"] = 0.0,
    weight: Float[ArrayLike, " P"] | None = None,
    n_range: tuple[float, float] = (0.1, 1e6),
    peak: Float[ArrayLike, ""] = 0.0,
    scale: Callable[..., Any] | None = None,
    alike: bool = False,
) -> Solution:
    """The optimum of ``target ~ k_a ambient + k_d diffuse + k_s lobe(n)``, all k at least 0.

    Args:
        target: linear values; where a weight is 0 anything, NaN too.
        diffuse: basis image, of all channels alike (Cb = 1) or of each.
        lobe: from the exponent to the specular basis image, differentiable twice; None without one.
        ambient: intensity of the ambient light, 1 or C values; 0 without.
        weight: of each squared residual; None for 1.
        n_range: bounds of the exponent, numbers.
        peak: the largest logarithm of the lobe's cosine in any pixel, so that exponents that no pixel sees are left
            out; 0 for a highlight whose centre is seen.
        scale: from the exponent to what k_s is divided by to give the coefficient whose error is asked for, such as
            `brdf.NormalizedPhong.scale`; None for 1.
        alike: under `jax.vmap` all but the target is the same: a third less time, while the lobes of all exponents of
            the search are kept.

    Returns:
        The optimum; differentiable in all arrays, those that ``lobe`` closes over too.

    Example:
        >>> import jax.numpy as jnp
        >>> cosine = jnp.linspace(0.5, 1.0, 200)[:, None]
        >>> target = 0.3 * cosine + 0.6 * cosine**20
        >>> found = fitting.functional.solve(target, cosine, lambda n: cosine**n)
        >>> print(f"{found.k_d[0]:.2f} {found.k_s[0]:.2f} {found.n:.1f}")
        0.30 0.60 20.0
    """
    target = jnp.asarray(target)
    dtype, (count, channels) = target.dtype, target.shape
    weight = jnp.ones(count, dtype) if weight is None else jnp.asarray(weight, dtype)
    ambient = jnp.broadcast_to(jnp.asarray(ambient, dtype), (channels,))
    nearest = jax.lax.stop_gradient(jnp.minimum(jnp.asarray(peak, dtype), 0))
    # Where no pixel sees an exponent there is no lobe; nor one by whose peak to divide.
    seen = -nearest * n_range[0] <= UNSEEN
    nearest = jnp.where(seen, nearest, 0)
    low, high = jnp.asarray(math.log(n_range[0]), dtype), jnp.log(UNSEEN / jnp.maximum(-nearest, UNSEEN / n_range[1]))
    free = jnp.stack(jnp.broadcast_arrays(ambient > 0, True, seen), axis=-1)
    high = jnp.maximum(low, high)
    pixels = _Pixels(jnp.where(weight > 0, target.T, 0), jnp.asarray(diffuse, dtype).T, weight, free)
    cells = max(1, math.ceil(math.log(n_range[1] / n_range[0]) / GRID_STEP))

    def relative(log_n: Array) -> Array:
        """The lobe relative to its largest value, (B, P)."""
        if lobe is None:
            return jnp.zeros_like(pixels.diffuse)
        n = jnp.exp(log_n)
        return lobe(n).T.astype(dtype) * jnp.exp(-n * nearest)

    def cost(log_n: Array, x: Array) -> Array:
        return jnp.sum(weight * pixels.residual(x, relative(log_n)) ** 2, axis=-1)

    def optimality(unknowns: tuple[Array, Array]) -> tuple[Array, Array]:
        """0 at the optimum: the gradient, or what is at its bound."""
        log_n, x = unknowns
        by_n, by_x = jax.grad(lambda *at: jnp.sum(cost(*at)), (0, 1))(log_n, x)
        inside = (log_n > low) & (log_n < high) & jnp.any(x[:, 2] > 0)
        return jnp.where(inside, by_n, log_n), jnp.where(x > 0, by_x, x)

    def search(_: Any, start: tuple[Array, Array]) -> tuple[Array, Array]:
        return start if lobe is None else _search(pixels, relative, jnp.linspace(low, high, 1 + cells), start[1], alike)

    def tangent(apply: Callable[[Any], Any], right: Any) -> Any:
        operator = lx.FunctionLinearOperator(apply, jax.eval_shape(lambda: right))
        return lx.linear_solve(operator, right, lx.LU()).value

    none = jnp.zeros_like(pixels.diffuse)
    fixed, nothing = jax.lax.stop_gradient(pixels), jnp.zeros((channels, 3), dtype)  # a start, of no derivative
    matt = _point(free, _sums(fixed, (none, none), fixed.target), nothing).x
    log_n, x = jax.lax.custom_root(optimality, (jnp.zeros((), dtype), matt), search, tangent)
    n, least = jnp.exp(log_n), cost(log_n, x)
    value, slope = _with_slope(relative, log_n)
    # With k_s itself held, by its scale, and not k_s relative to the peak.
    held = (log_n <= low) | (log_n >= high)
    growth = n * nearest
    if scale is not None:
        growth += jax.grad(lambda log_n: jnp.log(scale(jnp.exp(log_n))))(log_n)
    error, n_error = _errors(pixels, (value, slope + growth * value), x, least, held)
    units = jnp.stack(jnp.broadcast_arrays(1 / jnp.where(ambient > 0, ambient, 1), 1, jnp.exp(-n * nearest)))
    k_a, k_d, k_s = x.T * units
    return Solution(k_a, k_d, k_s, n, least, (*(error.T * units), n * n_error))


def _search(
    pixels: _Pixels, relative: Callable[[Array], Array], grid: Array, matt: Array, alike: bool
) -> tuple[Array, Array]:
    """The logarithm of the best exponent, and the coefficients there."""

    def at(log_n: Array, x: Array) -> tuple[Array, Array, _Point]:
        """The slope of the least cost, its derivative, and more of what is there; told about some coefficients."""

        def slope(log_n: Array) -> tuple[Array, _Point]:
            lobes = _with_slope(relative, log_n)
            point = _point(pixels.free, _sums(pixels, lobes, pixels.residual(x, lobes[0])), x)
            return point.slope, point

        return jax.jvp(slope, (log_n,), (jnp.ones_like(log_n),), has_aux=True)

    residual = pixels.residual(matt, jnp.zeros_like(pixels.diffuse))
    if alike:
        on_grid = _sums_of_alike(pixels, relative, grid, residual)
    else:
        on_grid = jax.lax.map(lambda log_n: _sums(pixels, _with_slope(relative, log_n), residual), grid)
    profile = jax.vmap(lambda sums: _point(pixels.free, sums, matt))(on_grid)
    position, lowest = lowest_in_cells(grid, profile.cost, profile.slope)
    # What rounding leaves is no valley: of exponents that fit alike the smallest, whose lobe most pixels see.
    lowest = jnp.maximum(lowest, jnp.finfo(lowest.dtype).eps ** 2 * jnp.sum(pixels.target**2))
    # Of the two lowest valleys the better one, after a step in each.
    beside = jnp.pad(lowest, 1, constant_values=jnp.inf)
    valleys = jnp.where((lowest < beside[:-2]) & (lowest <= beside[2:]), lowest, jnp.inf)
    _, best = jax.lax.top_k(-valleys, min(2, lowest.size))
    found = jax.lax.map(lambda start: at(*start), (position[best], profile.x[best]))
    slope, curvature, points = found
    # No further than the next exponent of the grid: where the lobe is nearly one of the other columns the cost is all
    # but straight.
    width = grid[1] - grid[0]
    moved = jnp.where(curvature > 0, jnp.minimum(jnp.abs(slope) / curvature, width), 0)
    first = jnp.argmin(points.cost - moved * (jnp.abs(slope) - curvature * moved / 2))
    log_n = position[best[first]]
    bracket = jnp.maximum(grid[0], log_n - width), jnp.minimum(grid[-1], log_n + width)

    def step(state: tuple[Any, ...], _: None) -> tuple[tuple[Any, ...], None]:
        log_n, (below, above), (slope, curvature, point) = state
        bracket = jnp.where(slope < 0, log_n, below), jnp.where(slope > 0, log_n, above)
        down = -jnp.sign(slope) * jnp.where(curvature > 0, jnp.abs(slope) / curvature, width)
        log_n = jnp.clip(log_n + down, *bracket)
        return (log_n, bracket, at(log_n, point.x)), None

    start = log_n, bracket, jax.tree.map(lambda leaf: leaf[first], found)
    (log_n, _, (*_, point)), _ = jax.lax.scan(step, start, None, length=STEPS[pixels.target.dtype.name])
    return log_n, point.x


def _with_slope(relative: Callable[[Array], Array], log_n: Array) -> tuple[Array, Array]:
    return jax.jvp(relative, (log_n,), (jnp.ones_like(log_n),))


@jax.custom_jvp
def _totals(terms: list[Array]) -> list[Array]:
    """Sums over the last axis, and of their derivatives, all in one loop.

    In forward mode alone: the search has no other, for it is the optimum that is differentiated.
    """
    return totals(terms, ["add"] * len(terms), (terms[0].ndim - 1,))


@_totals.defjvp
def _totals_jvp(terms: Any, changes: Any) -> Any:
    found = _totals([*terms[0], *changes[0]])
    return found[: len(found) // 2], found[len(found) // 2 :]


def _weighted(pixels: _Pixels, lobes: Sequence[Array]) -> tuple[list[Array], Array]:
    """Columns ambient, diffuse, a lobe and its derivative by log n, (B, P) each, and their products with each other."""
    columns = [jnp.ones_like(pixels.diffuse), pixels.diffuse, *lobes]
    weighted, size = [column * pixels.weight for column in columns], range(len(columns))
    pairs = [(i, j) for i in size for j in size if i <= j]
    found = dict(zip(pairs, _totals([weighted[i] * columns[j] for i, j in pairs]), strict=True))
    gram = jnp.stack([jnp.stack([found[min(i, j), max(i, j)] for j in size], axis=-1) for i in size], axis=-1)
    return weighted, gram


def _sums(pixels: _Pixels, lobes: Sequence[Array], residual: Array) -> _Sums:
    """At an exponent with that lobe and derivative; the residual is (C, P)."""
    weighted, gram = _weighted(pixels, lobes)
    *product, square = _totals([one * residual for one in (*weighted, pixels.weight * residual)])
    return _Sums(gram, jnp.stack(product, axis=-1), square)


def _sums_of_alike(pixels: _Pixels, relative: Callable[[Array], Array], grid: Array, residual: Array) -> _Sums:
    """`_sums` at each of some exponents, which pictures of one scene share but for a product of two matrices."""

    def of_lobe(log_n: Array) -> tuple[Array, Array]:
        weighted, gram = _weighted(pixels, _with_slope(relative, log_n))
        return jnp.stack(weighted[2:]), gram

    lobes, gram = jax.lax.map(of_lobe, grid)
    (base, _), (channels, _) = pixels.diffuse.shape, residual.shape
    # Channels that share the basis are rows of one matrix.
    rows = residual.reshape(base, channels // base, -1)
    of_lobes = jnp.einsum("gkbp,bcp->gbck", lobes, rows, precision="highest").reshape(len(grid), channels, -1)
    linear = _sums(pixels, (), residual)
    product = jnp.broadcast_to(linear.product, (len(grid), channels, 2))
    square = jnp.broadcast_to(linear.square, (len(grid), channels))
    return _Sums(gram, jnp.concatenate([product, of_lobes], axis=-1), square)


def _point(free: Array, sums: _Sums, x: Array) -> _Point:
    """The best coefficients.

    The sums tell of the residual of ``x``, (C, 3), so that rounding scales with what is left and not with the picture.
    """
    gram, product, square = sums
    tolerance = 2e-6 if gram.dtype == jnp.float32 else 1e-14
    best = nonnegative_minima(gram[:, :3, :3], product[:, :3], x, free, tolerance)
    step = best - x
    pull = product - (step[:, None] @ gram[:, :3])[:, 0]
    cost = square - jnp.sum(step * (product + pull)[:, :3], axis=-1)
    return _Point(best, jnp.sum(jnp.maximum(cost, 0)), -2 * jnp.sum(best[:, 2] * pull[:, 3]))


def _errors(pixels: _Pixels, lobes: Sequence[Array], x: Array, cost: Array, held: Array) -> tuple[Array, Array]:
    """Standard errors of x_a, x_d, x_s, (C, 3), and of log n: channels share n but not their noise.

    With the coefficients eliminated each channel tells log n by what its derivative has of its own; what log n errs
    moves the coefficients along. Noise is alike in all pixels, whatever their weights (White, Econometrica 48, 1980).
    """
    (weighted, gram), active, x_s = pixels.columns(*lobes), x > 0, x[:, 2]
    squared = jnp.einsum("bkp,bjp->bkj", weighted, weighted, precision="highest")
    both = active[:, :, None] & active[:, None]
    inverse = jnp.where(both, jnp.linalg.inv(jnp.where(both, gram[:, :3, :3], jnp.eye(3, dtype=x.dtype))), 0)
    along = (inverse @ (x_s[:, None] * gram[:, :3, 3])[..., None])[..., 0]
    own = jnp.concatenate([-along, x_s[:, None]], axis=-1)[..., None]
    known = jnp.sum(jnp.swapaxes(own, 1, 2) @ gram @ own)
    of_own = squared @ own
    by_channel = jnp.sum(own * of_own, axis=(1, 2))
    known = jnp.where(known > 0, known, jnp.inf)
    unknowns = jnp.sum(inverse * squared[:, :3, :3], axis=(1, 2)) + jnp.sum(by_channel) / known / x_s.size
    whole = jnp.sum(pixels.weight)
    left = jnp.where(whole - unknowns > jnp.finfo(x.dtype).eps * whole, whole - unknowns, 1)
    noise = cost / left
    moves = jnp.any(x_s > 0) & ~held
    by_n = jnp.where(moves, jnp.where(known < jnp.inf, jnp.sum(noise * by_channel) / known**2, jnp.inf), 0)
    variance = noise[:, None] * jnp.diagonal(inverse @ squared[:, :3, :3] @ inverse, axis1=1, axis2=2)
    together = noise[:, None] * (inverse @ of_own[:, :3])[..., 0] / known
    variance += jnp.where(moves & (along != 0), along * (along * by_n - 2 * together), 0)
    return _root(jnp.where(variance >= 0, variance, jnp.inf)), _root(by_n)


def _root(variance: Array) -> Array:
    """Its square root, of derivative 0 at 0."""
    return jnp.where(variance > 0, jnp.sqrt(jnp.where(variance > 0, variance, 1)), 0)
