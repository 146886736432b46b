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
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.flatten_util
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

import brdf
from brdf.checks import instance
from brdf.errors import InputError
from brdf.lobes import Lobe
from brdf.models.base import SpecularMaterial, check_model
from brdf.rendering import Basis, basis
from fitting.solver.nnls import nonnegative_minima, solve_active
from fitting.solver.profile import lowest_in_cells

# As a function of log n a lobe varies on a scale of 1 or more; Hermite's cubic over such a cell finds every valley.
GRID_STEP = 0.7
# Newton's steps double the digits, from a cell's cubic to the end of the precision; a step below CLOSE is one of these.
STEPS = {"float32": 4, "float64": 6}
CLOSE = 1e-3
# The nearest pixel shows exp(-UNSEEN) of a highlight's peak, or more, or the exponent is not looked at.
UNSEEN = 60.0


class Solution(NamedTuple):
    """The optimum as arrays.

    Attributes:
        k_a: (C,), of the ambient light.
        k_d: (C,), of the diffuse basis.
        k_s: (C,), of the lobe.
        n: exponent; 1 without a highlight, where it has no meaning.
        cost: least sum of weighted squared residuals, (C,).
        errors: standard errors of the four under noise that is independent and alike in all pixels of a channel; of
            what is at its bound 0, infinite where the pixels do not determine it.
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
    """Pixels of B groups of channels that share their basis images, G channels each.

    Attributes:
        target: (B, G, P), 0 where a pixel does not count.
        diffuse: (B, P).
        weight: (P,).
        free: which of x_a, x_d, x_s may be above 0, (B, G, 3).
    """

    target: Array
    diffuse: Array
    weight: Array
    free: Array


class _Point(NamedTuple):
    """The best coefficients at an exponent: x (B, G, 3), cost (B, G), and derivatives of the whole cost by log n."""

    x: Array
    cost: Array
    slope: Array
    curvature: Array


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
        InputError: where the model is no class of a material, or the picture is not what the scene shows.

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
    target, (width, height) = jnp.asarray(target), scene.resolution
    if target.shape[:2] != (height, width) or target.ndim != 3:
        came = f"must be of shape ({height}, {width}, C), got {target.shape}"
        raise InputError("target", came, "Give the picture that the scene shows")
    scene = brdf.cast(scene, "float64" if target.dtype == jnp.float64 else "float32")
    points = scene.sight()
    seen = jnp.ravel(points.mask)
    weight = seen if weight is None else seen * jnp.ravel(jnp.asarray(weight))
    solution = fit_basis(target, basis(model, scene, points=points), weight, scene.ambient, n_range)
    k: dict[str, Any] = {"k_a": solution.k_a, "k_d": solution.k_d}
    if issubclass(model, SpecularMaterial):
        k |= {"k_s": solution.k_s / model.scale(solution.n), "n": solution.n}
    return MaterialFit(model(**k), solution)


@eqx.filter_jit
def fit_basis(
    target: Array, images: Basis, weight: Array, ambient: Array | None, n_range: tuple[float, float]
) -> Solution:
    """What `fit` does once the basis images of a scene are known.

    Args:
        target: (..., C), as many pixels as there are.
        images: of the scene.
        weight: of each pixel, (P,).
        ambient: intensity of the ambient light, or None.
        n_range: bounds of the exponent.
    """
    diffuse = jnp.zeros((weight.size, 1), target.dtype) if images.diffuse is None else images.diffuse
    lobe, peak = None, None
    if images.lobe is not None:
        peak = jnp.max(jnp.where(weight > 0, images.lobe.peak, -jnp.inf))
        lobe = eqx.Partial(_value, images.lobe)
    ambient = jnp.zeros(1, target.dtype) if ambient is None else ambient
    target = target.reshape(weight.size, -1)
    return solve(target, diffuse, lobe, ambient=ambient, weight=weight, n_range=n_range, peak=peak)


def _value(lobe: Lobe, n: Array) -> Array:
    return lobe(n)[0]


@eqx.filter_jit
def solve(
    target: Float[ArrayLike, "P C"],
    diffuse: Float[ArrayLike, "P Cb"],
    lobe: Callable[[Float[Array, ""]], Float[Array, "P Cb"]] | None = None,
    *,
    ambient: Float[ArrayLike, " Ca"] = 0.0,
    weight: Float[ArrayLike, " P"] | None = None,
    n_range: tuple[float, float] = (0.1, 1e6),
    peak: Float[ArrayLike, ""] | None = None,
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
            out; None for 0, a highlight whose centre is seen.

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
    dtype, channels = target.dtype, target.shape[1]
    diffuse = jnp.asarray(diffuse, dtype)
    weight = jnp.ones(len(target), dtype) if weight is None else jnp.asarray(weight, dtype)
    ambient = jnp.broadcast_to(jnp.asarray(ambient, dtype), (channels,))
    groups = diffuse.shape[1]
    free = jnp.stack([ambient > 0, *[jnp.ones(channels, bool)] * 2], axis=-1).reshape(groups, -1, 3)
    counted = jnp.where(weight > 0, target.T, 0).reshape(groups, -1, len(target))
    pixels = _Pixels(counted, diffuse.T, weight, free)
    low, high = (jnp.asarray(math.log(bound), dtype) for bound in n_range)
    nearest = jax.lax.stop_gradient(jnp.zeros((), dtype) if peak is None else jnp.minimum(jnp.asarray(peak, dtype), 0))
    if peak is not None:
        high = jnp.log(UNSEEN / jnp.maximum(-nearest, UNSEEN / n_range[1]))
        # Else no exponent is seen, and there is no lobe.
        pixels = pixels._replace(free=free & jnp.stack([True, True, high >= low]))
        high = jnp.maximum(low, high)
    count = max(2, 1 + math.ceil(math.log(n_range[1] / n_range[0]) / GRID_STEP))

    def relative(log_n: Array) -> Array:
        """The lobe relative to its largest value, (B, P)."""
        assert lobe is not None
        n = jnp.exp(log_n)
        return lobe(n).T.astype(dtype) * jnp.exp(-n * nearest)

    def cost(log_n: Array, x: Array) -> Array:
        residual = _residual(pixels, x, None if lobe is None else relative(log_n))
        return jnp.sum(weight * residual * residual, axis=-1)

    def optimality(unknowns: tuple[Array, Array]) -> tuple[Array, Array]:
        """0 at the optimum: the gradient, or what is at its bound."""
        log_n, x = unknowns
        by_n, by_x = jax.grad(lambda *at: jnp.sum(cost(*at)), (0, 1))(log_n, x)
        inside = (log_n > low) & (log_n < high) & jnp.any(x[..., 2] > 0)
        return jnp.where(inside, by_n, log_n), jnp.where(x > 0, by_x, x)

    def search(_: Any, start: tuple[Array, Array]) -> tuple[Array, Array]:
        return start if lobe is None else _search(pixels, relative, low, high, count, start[1])

    start = jnp.zeros((), dtype), _matt(pixels)
    log_n, x = jax.lax.custom_root(optimality, start, search, _solve_linearised)
    n = jnp.exp(log_n)
    x_a, x_d, x_s = x.reshape(channels, 3).T
    unit = jnp.where(ambient > 0, ambient, 1)
    seen = jnp.exp(-n * nearest)
    least = cost(log_n, x)
    lobes = jnp.zeros((groups, 2, len(target)), dtype)
    if lobe is not None:
        value, slope, _ = _derivatives(relative, log_n)
        # With k_s itself held, and not k_s relative to the peak.
        lobes = jnp.stack([value, slope + n * nearest * value], axis=1)
    error, n_error = _errors(pixels, lobes, x, least, bounded=(log_n <= low) | (log_n >= high))
    errors = error[0] / unit, error[1], error[2] * seen, n * n_error
    return Solution(x_a / unit, x_d, x_s * seen, n, least.reshape(channels), errors)


def _solve_linearised(apply: Callable[[Any], Any], right: Any) -> Any:
    """Solve the linearised optimality, scaled by its diagonal: coefficients and exponent move pixels differently."""
    flat, unravel = jax.flatten_util.ravel_pytree(right)
    columns = jax.lax.map(
        lambda unit: jax.flatten_util.ravel_pytree(apply(unravel(unit)))[0], jnp.eye(flat.size, dtype=flat.dtype)
    )
    size = jnp.sqrt(jnp.abs(jnp.diagonal(columns)))
    size = jnp.where(size > 0, size, 1)
    return unravel(jnp.linalg.solve(columns.T / (size[:, None] * size), flat / size) / size)


def _search(
    pixels: _Pixels, relative: Callable[[Array], Array], low: Array, high: Array, count: int, matt: Array
) -> tuple[Array, Array]:
    """The logarithm of the best exponent, and the coefficients there."""

    def at(log_n: Array, x: Array) -> _Point:
        lobes = jnp.stack(_derivatives(relative, log_n), axis=1)
        return _point(pixels, lobes, _residual(pixels, x, lobes[:, 0]), x)

    grid = jnp.linspace(low, high, count)
    residual = _residual(pixels, matt)
    profile = jax.vmap(lambda t: _point(pixels, jnp.stack(_derivatives(relative, t)[:2], 1), residual, matt))(grid)
    cost = jnp.sum(profile.cost, axis=(1, 2))
    position, lowest = lowest_in_cells(grid, cost, profile.slope)
    # What rounding leaves is no valley: of exponents that fit alike the smallest, whose lobe most pixels see.
    lowest = jnp.maximum(lowest, jnp.finfo(cost.dtype).eps ** 2 * jnp.sum(pixels.target**2))
    # Of the two lowest valleys the better one, after a step in each.
    beside = jnp.pad(lowest, 1, constant_values=jnp.inf)
    valleys = jnp.where((lowest < beside[:-2]) & (lowest <= beside[2:]), lowest, jnp.inf)
    _, best = jax.lax.top_k(-valleys, min(2, count - 1))
    points = jax.vmap(lambda cell: at(position[cell], profile.x[cell]))(best)
    gain = points.slope**2 / jnp.where(points.curvature > 0, 2 * points.curvature, jnp.inf)
    first = jnp.argmin(jnp.sum(points.cost, axis=(1, 2)) - gain)
    width = grid[1] - grid[0]
    start = position[best[first]]
    point = jax.tree.map(lambda leaf: leaf[first], points)
    bracket = jnp.maximum(low, start - width), jnp.minimum(high, start + width)

    def step(state: tuple[Any, ...], _: None) -> tuple[tuple[Any, ...], None]:
        log_n, (below, above), point = state
        below, above = jnp.where(point.slope < 0, log_n, below), jnp.where(point.slope > 0, log_n, above)
        newton = log_n - point.slope / jnp.where(point.curvature > 0, point.curvature, 1)
        # What is left at the end is rounding, which respects no bracket.
        inside = ((newton > below) & (newton < above)) | (jnp.abs(newton - log_n) < CLOSE)
        inside &= (point.curvature > 0) & (newton >= low) & (newton <= high)
        # A bound is met at once, and left again where the slope points inwards.
        edge = jnp.where(point.slope < 0, above, below)
        outside = jnp.where((edge == low) | (edge == high), edge, (below + above) / 2)
        log_n = jnp.where(point.slope == 0, log_n, jnp.where(inside, newton, outside))
        return (log_n, (below, above), at(log_n, point.x)), None

    (log_n, _, point), _ = jax.lax.scan(step, (start, bracket, point), None, length=STEPS[pixels.target.dtype.name])
    return log_n, point.x


def _derivatives(function: Callable[[Array], Array], at: Array) -> tuple[Array, Array, Array]:
    """A function of one number, and its first two derivatives."""

    def slope(t: Array) -> tuple[Array, Array]:
        return jax.jvp(function, (t,), (jnp.ones_like(t),))

    (value, first), (_, second) = jax.jvp(slope, (at,), (jnp.ones_like(at),))
    return value, first, second


def _residual(pixels: _Pixels, x: Array, lobe: Array | None = None) -> Array:
    """Of a model, (B, G, P)."""
    shown = x[..., :1] + x[..., 1:2] * pixels.diffuse[:, None]
    if lobe is not None:
        shown = shown + x[..., 2:] * lobe[:, None]
    return jnp.where(pixels.weight > 0, pixels.target - shown, 0)


def _matt(pixels: _Pixels) -> Array:
    """The best ambient and diffuse coefficients, (B, G, 3)."""
    nothing = jnp.zeros((*pixels.free.shape[:2], 3), pixels.target.dtype)
    empty = jnp.zeros((len(pixels.diffuse), 2, len(pixels.weight)), pixels.target.dtype)
    return _point(pixels, empty, pixels.target, nothing).x


def _point(pixels: _Pixels, lobes: Array, residual: Array, x: Array) -> _Point:
    """The best coefficients where the columns are ambient, diffuse, and a lobe with its derivatives by log n.

    Args:
        pixels: what is fitted.
        lobes: the lobe and one or two derivatives, (B, 2 or 3, P).
        residual: of the coefficients ``x``, so that rounding scales with what is left and not with the picture.
        x: (B, G, 3).
    """
    fixed = jnp.stack([jnp.ones_like(pixels.diffuse), pixels.diffuse], axis=1)
    gram = _gram(pixels, fixed, lobes)[:, None]
    weighted = pixels.weight * residual
    product = jnp.concatenate([jnp.einsum("bkp,bgp->bgk", some, weighted) for some in (fixed, lobes)], axis=-1)
    tolerance = 2e-6 if gram.dtype == jnp.float32 else 1e-14
    best = nonnegative_minima(gram[..., :3, :3], product[..., :3], x, pixels.free, tolerance)
    step = best - x
    pull = product - (step[..., None, :] @ gram[..., :3, :])[..., 0, :]
    cost = jnp.sum(weighted * residual, axis=-1) - jnp.sum(step * (product + pull)[..., :3], axis=-1)
    x_s = best[..., 2]
    slope = -2 * jnp.sum(x_s * pull[..., 3])
    if lobes.shape[1] < 3:
        return _Point(best, jnp.maximum(cost, 0), slope, jnp.zeros_like(slope))
    # The Schur complement of the exact Hessian in what is above 0.
    cross = x_s[..., None] * gram[..., 3, :3] - jnp.array([0, 0, 1]) * pull[..., 3:4]
    active = best > 0
    along, _ = solve_active(gram[..., :3, :3], jnp.where(active, cross, 0), active)
    own = x_s**2 * gram[..., 3, 3] - x_s * pull[..., 4]
    return _Point(best, jnp.maximum(cost, 0), slope, 2 * jnp.sum(own - jnp.sum(cross * along, axis=-1)))


def _gram(pixels: _Pixels, fixed: Array, lobes: Array) -> Array:
    """Products of the columns, (B, K, K); those that no lobe enters are the same at every exponent."""
    products = partial(jnp.einsum, "bkp,bjp->bkj", precision="highest")
    lit = products(fixed * pixels.weight, lobes)
    above = jnp.concatenate([products(fixed * pixels.weight, fixed), lit], axis=2)
    below = jnp.concatenate([lit.swapaxes(1, 2), products(lobes * pixels.weight, lobes)], axis=2)
    return jnp.concatenate([above, below], axis=1)


def _errors(pixels: _Pixels, lobes: Array, x: Array, cost: Array, bounded: Array) -> tuple[Array, Array]:
    """Standard errors of x_a, x_d, x_s, (3, C), and of log n: channels share n but not their noise.

    With the coefficients eliminated each channel tells log n with the weight of its Schur complement; what log n errs
    moves the coefficients along.
    """
    fixed = jnp.stack([jnp.ones_like(pixels.diffuse), pixels.diffuse], axis=1)
    gram = jnp.broadcast_to(_gram(pixels, fixed, lobes)[:, None], (*x.shape[:2], 4, 4))
    active, x_s = x > 0, x[..., 2:]
    noise = cost / jnp.maximum(jnp.count_nonzero(pixels.weight) - jnp.count_nonzero(active, axis=-1), 1)
    cross = jnp.where(active, x_s * gram[..., :3, 3], 0)
    along, kept = solve_active(gram[..., :3, :3], cross, active)
    told = x_s[..., 0] ** 2 * gram[..., 3, 3] - jnp.sum(cross * along, axis=-1)
    total = jnp.sum(told)
    by_n = jnp.where(total > 0, jnp.sum(noise * told) / jnp.where(total > 0, total, 1) ** 2, jnp.inf)
    by_n = jnp.where(jnp.any(x_s > 0) & ~bounded, by_n, 0)
    units = jnp.broadcast_to(jnp.eye(3, dtype=x.dtype)[:, None, None], (3, *x.shape))
    inverse, _ = jax.vmap(solve_active, (None, 0, None), -1)(gram[..., :3, :3], units, active)
    own = noise[..., None] * jnp.diagonal(inverse, axis1=-2, axis2=-1)
    variance = own + jnp.where(along == 0, 0, along**2 * by_n)
    variance = jnp.where(active & ((kept[..., None] <= 0) | ~(variance >= 0)), jnp.inf, variance)
    return _root(variance).reshape(-1, 3).T, _root(by_n)


def _root(variance: Array) -> Array:
    """Its square root, of derivative 0 at 0."""
    return jnp.where(variance > 0, jnp.sqrt(jnp.where(variance > 0, variance, 1)), 0)
