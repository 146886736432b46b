"""The numeric core of maps: the best material of each texel of a tile, all texels in step.

The photographs of a texel are ``y_p = k_a A_p + k_d D_p + k_s S_p(n)``. The coefficients are linear, so for a given n
the best non-negative ones are a closed form and the search is one-dimensional (variable projection, Golub and Pereyra
1973). It is global: a grid over log n, then Gauss-Newton inside the bracket about the best sample. The same sums give
the standard errors. Where the normal is sought too, Gauss-Newton takes it and the material together.

Texels lie in the lanes of the processor, the last axis of every array, T. The P photographs are a loop with
accumulators, several times faster than the same as reductions. Steps are taken from the residual of the last one, so
that single precision loses no digits of the answer. The C channels share the columns, whose channel axis then is 1.
"""

import functools
import math
import operator
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from brdf.models.base import SpecularMaterial
from brdf.vectors import divide, dot, normalize, square_root

OCTAVES = 16
"""The exponent is sought from 1 to 2^16: beyond, a lobe is narrower than the step between any two lights."""

STEPS = 5
"""Gauss-Newton steps in a bracket of two steps of the grid: they converge to single precision."""

CAP = 32.0
"""k_s is at most so many times the brightest value of its texel: where no light comes near the mirror direction, k_s
and n would go up together without end."""

JOINT_STEPS = 3
"""Gauss-Newton steps of material and normal together."""

GEMAN_MCCLURE = 2.0
"""Where the weight of a residual starts to fall, in deviations."""

OUTLIER = 4.0
"""Residuals beyond so many deviations are no noise: one in 16,000 would be."""

DEPENDENT = 16.0
"""A column depends on others where elimination leaves so few rounding errors of its square."""


class Columns(NamedTuple):
    """What each photograph's light makes of the texels; 0 where a value does not count.

    Attributes:
        ambient: (P, D, T); None without ambient light.
        diffuse: I (N·L)+, (P, D, T).
        weight: of the lobe of each of the light's S samples, (P, S, D, T).
        log_cosine: of the lobe, (P, S, T); ``vectors.BELOW_HORIZON`` or anything finite where there is none.
    """

    ambient: Float[Array, "P D T"] | None
    diffuse: Float[Array, "P D T"]
    weight: Float[Array, "P S D T"]
    log_cosine: Float[Array, "P S T"]


class TexelFit(NamedTuple):
    """The optimum of each texel. Errors are standard errors in units of the noise, infinite where nothing is known.

    Attributes:
        k: k_a (with ambient light), k_d and (of a model with a lobe) k_s, (C, T) each.
        k_error: of each; at the bound 0 that which it would have without.
        log_n: (T,).
        log_n_error: (T,).
        cost: sum of squared residuals, (T,).
    """

    k: list[Float[Array, "C T"]]
    k_error: list[Float[Array, "C T"]]
    log_n: Float[Array, " T"]
    log_n_error: Float[Array, " T"]
    cost: Float[Array, " T"]


def distant_columns(model: Any, normal: Array, to_light: Array, to_view: Array, seen: Array) -> Columns:
    """Columns under distant lights.

    Args:
        model: class of the material.
        normal: (3, T), unit.
        to_light: (P, 3), unit.
        to_view: (3,), unit.
        seen: how much each texel counts in each photograph, (P, T).
    """
    axis = _axis(normal)
    columns = jax.lax.map(lambda light: _light_columns(model, axis, light[0], to_view, light[1]), (to_light, seen))
    return Columns(None, columns[0][:, None], columns[1][:, None, None], columns[2][:, None])


def _axis(components: Iterable[Array]) -> Array:
    """Vectors (T, 3) of their components, which XLA takes apart again: a transposed array it would copy."""
    return jnp.stack(tuple(components), axis=-1)


def _light_columns(model: Any, axis: Array, to_light: Array, to_view: Array, seen: Array) -> tuple[Array, Array, Array]:
    """I (N·L)+, the lobe's weight and the logarithm of its cosine under one light, (T,) each."""
    glossy, cosine = issubclass(model, SpecularMaterial), dot(axis, to_light)
    diffuse = seen * jnp.maximum(cosine, 0)
    shines = jnp.where((cosine > 0) & (dot(axis, to_view) > 0), seen, 0)
    weight = shines * cosine if glossy and model.cosine_weighted else shines
    return diffuse, weight, model.log_cosine(axis, to_light, to_view) if glossy else cosine


def fit_texels(model: Any, target: Float[Array, "P C T"], columns: Columns, grey: bool, finer: int) -> TexelFit:
    """The best material of each texel whose normal is known.

    Args:
        model: class of the material.
        target: what the photographs show; 0 where it does not count.
        columns: of the lights.
        grey: whether the channels share k_s.
        finer: steps of the grid in each doubling of n: 1 under lights all over the sky, 2 under a ring of them.
    """
    glossy = issubclass(model, SpecularMaterial)
    if not glossy:
        nothing = jnp.zeros(target.shape[2:], target.dtype)
        linear = [jnp.zeros_like(target[0])] * (1 + (columns.ambient is not None))
        lambert = _evaluate(_linear_columns(columns), [], target, linear, jnp.inf, False, [], False)
        return TexelFit(lambert.k, lambert.k_error, nothing, nothing + jnp.inf, lambert.cost)
    cap = cap_of(target)
    grid = math.log(2.0) * jnp.linspace(0, OCTAVES, OCTAVES * finer + 1, dtype=target.dtype)
    k, best = _search_grid(model, target, columns, cap, grid, grey)
    low, high = grid[jnp.maximum(best - 1, 0)], grid[jnp.minimum(best + 1, grid.size - 1)]

    def at(k: list[Array], log_n: Array, *, about: bool = False) -> _Point:
        lobe, slope = _lobe_and_slope(model, columns, log_n)
        basis = [*_linear_columns(columns), lobe]
        return _evaluate(basis, [slope], target, k, cap, grey, [[(0, len(k) - 1)]], about)

    def step(_: Any, state: Any) -> Any:
        k, log_n, low, high = state
        point = at(k, log_n)
        low, high = jnp.where(point.slope[0] > 0, log_n, low), jnp.where(point.slope[0] < 0, log_n, high)
        # At the minimum rounding turns the slope's sign: what leaves the bracket by no more is no reason to halve it.
        new, slack = log_n + point.step[0], 1e-3
        new = jnp.where((new < low - slack) | (new > high + slack), 0.5 * (low + high), new)
        new = jnp.clip(new, grid[0], grid[-1])
        return point.moved(divide((new - log_n) * point.step[0], point.step[0] ** 2), cap), new, low, high

    k, log_n, _, _ = jax.lax.fori_loop(0, STEPS, step, (k, grid[best], low, high))
    point = at(k, log_n, about=True)
    return TexelFit(point.k, point.k_error, log_n, point.q_error[0], point.cost)


class Distant(NamedTuple):
    """Distant lights.

    Attributes:
        to_light: unit, (P, 3).
        to_view: unit, (3,).
        ambient: column of the ambient light, (P, D, 1), or None.
    """

    to_light: Float[Any, "P 3"]
    to_view: Float[Any, "3"]
    ambient: Float[Any, "P D 1"] | None

    def columns(self, model: Any, normal: Array, seen: Array) -> Columns:
        """Of texels with these normals, (3, T), that count where seen, (P, T)."""
        ambient = None if self.ambient is None else self.ambient * seen[:, None]
        lit = distant_columns(model, normal, self.to_light, self.to_view, seen)
        return lit._replace(ambient=ambient)


def fit_with_normals(
    model: Any,
    target: Float[Array, "P C T"],
    seen: Float[Array, "P T"],
    lights: Distant,
    grey: bool,
    finer: int,
) -> tuple[TexelFit, Array, Array, Array]:
    """The best material and normal of each texel.

    Lambert's law, fitted to what is neither highlight nor shadow, gives a normal, the search over n a material, and
    Gauss-Newton both together; what no material explains is left out, n is sought once more, and both together again.

    Args:
        model: class of the material.
        target: what the photographs show; 0 where it does not count.
        seen: 1 where it counts.
        lights: which are distant.
        grey: whether the channels share k_s.
        finer: see `fit_texels`.

    Returns:
        The fit; the normals, (3, T); their standard errors in units of the noise, (T,), the root mean square angle; and
        what counted in the end, (P, T).
    """

    def again(_: Any, state: Any) -> Any:
        fit, normal, _, _ = state
        columns = lights.columns(model, normal, seen)
        basis = _linear_columns(columns)
        if issubclass(model, SpecularMaterial):
            basis.append(_lobe_and_slope(model, columns, fit.log_n)[0])
        residual = target - sum(map(operator.mul, fit.k, basis))
        counts = _inliers(_over_channels(residual)[:, 0], seen)
        return both(normal, counts)

    def both(normal: Array, counts: Array) -> Any:
        some = target * counts[:, None]
        fit = fit_texels(model, some, lights.columns(model, normal, counts), grey, finer)
        return *_jointly(model, some, counts, lights, grey, fit, normal), counts

    start = lambert_normals(_over_channels(target)[:, 0], seen, lights.to_light)
    first = fit_texels(model, target, lights.columns(model, start, seen), grey, finer), start, seen[0], seen
    return jax.lax.fori_loop(0, 2, again, first)


def _inliers(residual: Float[Array, "P T"], seen: Float[Array, "P T"]) -> Float[Array, "P T"]:
    """1 where a residual is no outlier: within `OUTLIER` standard deviations of those that are none."""

    def clip(_: Any, counts: Array) -> Array:
        size = divide(jnp.sum(counts * residual**2, axis=0), jnp.sum(counts, axis=0))
        return jnp.where(residual**2 <= OUTLIER**2 * size, seen, 0)

    return jax.lax.fori_loop(0, 4, clip, seen)


def lambert_normals(grey: Float[Array, "P T"], seen: Float[Array, "P T"], to_light: Array) -> Float[Array, "3 T"]:
    """Normals by Lambert's law, fitted to what is neither highlight nor shadow.

    Least squares reweighted by Geman and McClure's function of the residual (1985). Its scale is that of the negative
    residuals: highlights are positive.
    """

    def step(_: Any, vector: Array) -> Array:
        predicted = to_light @ vector
        residual, lit = grey - predicted, jnp.where(predicted > 0, seen, 0)
        below = jnp.where(residual < 0, lit, 0)
        scale = divide(jnp.sum(below * residual**2, axis=0), jnp.sum(below, axis=0))
        ratio = divide(residual**2, GEMAN_MCCLURE**2 * scale)
        return _least_squares(lit / (1 + ratio) ** 2, grey, to_light)

    vector = jax.lax.fori_loop(0, 8, step, _least_squares(seen, grey, to_light))
    return normalize(vector.T).T


def _least_squares(weight: Array, values: Array, to_light: Array) -> Array:
    """The vector g of least Σ w (v - L·g)², (3, T)."""

    def moments(weight: Array, value: Array, light: Array) -> Any:
        x = [axis * jnp.ones_like(weight)[None] for axis in light]
        return [[weight * p for p in row] for row in _products(x)], [weight * value * axis for axis in x]

    upper, moment = _total(moments, weight, values, to_light)
    gram = _whole(upper)
    _, vector, _ = _solve(gram, moment, [], 3)
    return jnp.concatenate(vector)


def _jointly(
    model: Any, target: Array, seen: Array, lights: Distant, grey: bool, fit: TexelFit, normal: Array
) -> tuple[TexelFit, Array, Array]:
    """Gauss-Newton of material and normal together; a step that does not lower the cost is cut to a quarter."""
    glossy = issubclass(model, SpecularMaterial)
    cap = cap_of(target)
    first = 1 if lights.ambient is not None else 0
    tilts = [[(1, first), (2, first + 1)], [(3, first), (4, first + 1)]]
    nonlinear = [[(0, first + 1)], *tilts] if glossy else [[(0, first)], [(1, first)]]

    def at(k: list[Array], log_n: Array, normal: Array) -> _Point:
        frame = _frame(normal)

        def of_light(photograph: tuple[Array, Array]) -> list[Array]:
            def columns(log_n: Array, *tilt: Array) -> tuple[Array, Array]:
                axis = normalize(
                    _axis([x + sum(map(operator.mul, tilt, e)) for x, *e in zip(normal, *frame, strict=True)])
                )
                light, shown = photograph
                diffuse, weight, log_cosine = _light_columns(model, axis, light, lights.to_view, shown)
                n = jnp.exp(log_n)
                lobe = model.scale(n) * weight * jnp.exp(n * log_cosine) if glossy else diffuse
                return diffuse[None], lobe[None]

            point, zero, one = (log_n, *[jnp.zeros_like(log_n)] * 2), jnp.zeros_like(log_n), jnp.ones_like(log_n)
            units = [tuple(one if i == j else zero for j in range(3)) for i in range(3)]
            value, slope = jax.jvp(columns, point, units[0])
            (_, first), (_, second) = (jax.jvp(columns, point, unit) for unit in units[1:])
            return [*value, slope[1], *first, *second] if glossy else [value[0], first[0], second[0]]

        found = jax.lax.map(of_light, (lights.to_light, seen))
        ambient = [] if lights.ambient is None else [lights.ambient * seen[:, None]]
        own = 2 if glossy else 1
        return _evaluate([*ambient, *found[:own]], found[own:], target, k, cap, grey, nonlinear, True)

    def limited(point: _Point) -> list[Array]:
        log_n = [jnp.clip(point.step[0], -1, 1)] if glossy else [jnp.zeros_like(point.cost)]
        return [*log_n, *(jnp.clip(angle, -0.2, 0.2) for angle in point.step[-2:])]

    def moved(log_n: Array, normal: Array, step: list[Array]) -> tuple[Array, Array]:
        turned = normalize((normal + sum(map(operator.mul, step[1:], _frame(normal)))).T).T
        return jnp.clip(log_n + step[0], 0, OCTAVES * math.log(2.0)), turned

    def step(_: Any, state: Any) -> Any:
        k, log_n, normal, cost, change = state
        new = moved(log_n, normal, change)
        point = at(k, *new)
        better = point.cost < cost
        choose = lambda a, b: jax.tree.map(lambda x, y: jnp.where(better, x, y), a, b)  # noqa: E731
        shorter = [0.25 * x for x in change]
        return choose((point.k, *new, point.cost, limited(point)), (k, log_n, normal, cost, shorter))

    nothing = [jnp.zeros_like(fit.log_n)] * 3
    state = (fit.k, fit.log_n, normal, jnp.full_like(fit.log_n, jnp.inf), nothing)
    k, log_n, normal, _, _ = jax.lax.fori_loop(0, 1 + JOINT_STEPS, step, state)
    point = at(k, log_n, normal)
    angle = square_root(point.q_error[-2] ** 2 + point.q_error[-1] ** 2)
    log_n_error = point.q_error[0] if glossy else fit.log_n_error
    return TexelFit(point.k, point.k_error, log_n, log_n_error, point.cost), normal, angle


def _frame(normal: Array) -> tuple[Array, Array]:
    """Two unit vectors across each normal, (3, T): Duff et al., Building an orthonormal basis, revisited, JCGT 2017."""
    x, y, z = normal
    sign = jnp.where(z < 0, -1.0, 1.0)
    a = -1.0 / (sign + z)
    b = x * y * a
    return jnp.stack([1 + sign * x * x * a, sign * b, -sign * x]), jnp.stack([b, sign + y * y * a, -y])


def cap_of(target: Float[Array, "P C T"]) -> Float[Array, " T"]:
    """What k_s may be at most."""
    return CAP * jnp.max(target, axis=(0, 1))


# -- sums over the photographs -----------------------------------------------------------------------------------------


def _linear_columns(columns: Columns) -> list[Array]:
    """The columns without the lobe's, (P, D, T): k_a's where there is ambient light, and k_d's."""
    return [column for column in (columns.ambient, columns.diffuse) if column is not None]


def _lobe(weight: Array, log_cosine: Array, n: Array, scale: Any) -> Array:
    """The lobe's column of a photograph, (..., D, T), for exponents (..., 1, T)."""
    return scale * jnp.sum(weight * jnp.exp(n[..., None, :, :] * log_cosine[:, None]), axis=-3)


def _lobe_and_slope(model: Any, columns: Columns, log_n: Array) -> tuple[Array, Array]:
    """The lobe's column of each photograph, (P, D, T), for log n (T,), and its derivative by that."""
    n = jnp.exp(log_n)[None]
    scale, change = jax.jvp(model.scale, (n,), (n,))

    def of_photograph(photograph: tuple[Array, Array]) -> tuple[Array, Array]:
        exponent = n * photograph[1][:, None]
        lobes = photograph[0] * jnp.exp(exponent)
        value, slope = jnp.sum(lobes, axis=0), jnp.sum(lobes * exponent, axis=0)
        return scale * value, scale * slope + change * value

    return jax.lax.map(of_photograph, (columns.weight, columns.log_cosine))


def _total(of_photograph: Callable[..., Any], *stored: Any) -> Any:
    """The sum of a tree of arrays over the photographs, the first axis of what is stored of them."""
    first = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape[1:], leaf.dtype), stored)
    zeros = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(of_photograph, *first))

    def add(total: Any, photograph: Any) -> tuple[Any, None]:
        return jax.tree.map(jnp.add, total, of_photograph(*photograph)), None

    return jax.lax.scan(add, zeros, stored)[0]


def _over_channels(values: Any) -> Array:
    """The sum over the axis before the last, which stays; a reduction would keep XLA from fusing it with the rest."""
    return functools.reduce(operator.add, (values[..., c : c + 1, :] for c in range(values.shape[-2])))


def _products(columns: Sequence[Array]) -> list[list[Array]]:
    """Products of columns: the upper triangle of their Gram matrix, by rows."""
    return [[a * b for b in columns[i:]] for i, a in enumerate(columns)]


def _whole(upper: list[list[Array]]) -> list[list[Array]]:
    """A symmetric matrix from its upper triangle."""
    size = range(len(upper))
    return [[upper[min(i, j)][abs(j - i)] for j in size] for i in size]


def _search_grid(model: Any, target: Array, columns: Columns, cap: Array, grid: Array, grey: bool) -> Any:
    """The coefficients at the best sample of a grid over log n, U of (C, T), and which sample that is, (T,)."""
    log_n = jnp.broadcast_to(grid[:, None], (grid.size, target.shape[2]))

    n = jnp.exp(log_n)[:, None]
    scale = model.scale(n)

    def photograph(values: Array, linear: list[Array], weight: Array, log_cosine: Array) -> Any:
        basis = [*(column[None] for column in linear), _lobe(weight, log_cosine, n, scale)]
        return _products(basis), [column * values for column in basis]

    upper, moment = _total(photograph, target, _linear_columns(columns), columns.weight, columns.log_cosine)
    gram, none = _whole(upper), [jnp.zeros(())] * len(moment)
    k = nonnegative(gram, moment, none, cap, grey, start=jnp.zeros_like(moment[-1]), steps=2)
    left = [b - 0.5 * sum(map(operator.mul, row, k)) for b, row in zip(moment, gram, strict=True)]
    best = jnp.argmax(_over_channels(sum(map(operator.mul, k, left)))[:, 0], axis=0)
    shape = (grid.size, *target.shape[1:])
    return [jnp.take_along_axis(jnp.broadcast_to(x, shape), best[None, None], axis=0)[0] for x in k], best


class _Point(NamedTuple):
    """Everything at one n (and normal): the best coefficients, and the Gauss-Newton step from there.

    Attributes:
        k: U of (C, T).
        change: of each in that step.
        k_error: in units of the noise.
        slope: half the negative derivative of the cost by each nonlinear unknown, (T,).
        step: of each.
        q_error: in units of the noise.
        cost: sum of squared residuals, (T,).
    """

    k: list[Array]
    change: list[Array]
    k_error: list[Array]
    slope: list[Array]
    step: list[Array]
    q_error: list[Array]
    cost: Array

    def moved(self, share: Array, cap: Array) -> list[Array]:
        """The coefficients after a share of the step, within their bounds."""
        k = [jnp.maximum(x + share * change, 0) for x, change in zip(self.k, self.change, strict=True)]
        return [*k[:-1], jnp.minimum(k[-1], cap)]


def _evaluate(
    columns: list[Array],
    slopes: list[Array],
    target: Array,
    k: list[Array],
    cap: Any,
    grey: bool,
    nonlinear: list[list[tuple[int, int]]],
    about: bool,
) -> _Point:
    """The best coefficients near k, and the Gauss-Newton step of these and the nonlinear unknowns together.

    Args:
        columns: of the photographs, U of (P, D, T).
        slopes: derivatives of them.
        target: what the photographs show.
        k: U of (C, T).
        cap: of the last.
        grey: whether the channels share the last.
        nonlinear: of each nonlinear unknown, which derivatives are of which columns.
        about: take products with the residual at k, which loses no digits, instead of the photographs.
    """
    count, start, k = len(k), k[-1], k if about else [jnp.zeros_like(x) for x in k]

    if about:
        difference = lambda one: one[0] - sum(map(operator.mul, k, one[1]))  # noqa: E731
        target = jax.lax.map(difference, (target, columns))

    def of_photograph(basis: list[Array], values: Array) -> Any:
        return _products(basis), [column * values for column in basis], values * values

    upper, moment, cost = _total(of_photograph, [*columns, *slopes], target)
    gram = _whole(upper)
    linear = [row[:count] for row in gram[:count]]
    low = [-x for x in k]
    change = nonnegative(linear, moment[:count], low, cap - k[-1], grey, start=start - k[-1], steps=1)
    new = [b - sum(map(operator.mul, row, change)) for b, row in zip(moment, gram, strict=True)]
    gain = [x * (b + left) for x, b, left in zip(change, moment[:count], new[:count], strict=True)]
    k = list(map(jnp.add, k, change))
    # the derivative by a nonlinear unknown is a combination of derivatives of columns
    parts = [[(i, jnp.ones(()))] for i in range(count)]
    parts += [[(count + slope, k[column]) for slope, column in pairs] for pairs in nonlinear]
    matrix = [[sum(a * b * gram[i][j] for i, a in one for j, b in other) for other in parts] for one in parts]
    right = [sum(a * new[i] for i, a in one) for one in parts]
    active = [x > 0 for x in k]
    active[-1] &= k[-1] < cap
    slope, x, error = _solve(matrix, right, active, count - grey)
    flat = [jnp.ravel(value) for value in (*slope, *x[count:], *error[count:])]
    m = len(nonlinear)
    errors = [jnp.broadcast_to(value, target.shape[1:]) for value in error[:count]]
    return _Point(k, x[:count], errors, flat[:m], flat[m : 2 * m], flat[2 * m :], _over_channels(cost - sum(gain))[0])


# -- small systems, one in each lane -----------------------------------------------------------------------------------


def _left(square: Array, taken: Array) -> Array:
    """What elimination leaves of a column's square; 0 where that is rounding."""
    left = square - taken
    return jnp.where(left > DEPENDENT * jnp.finfo(left.dtype).eps * square, left, 0)


def nonnegative(
    gram: list[list[Array]],
    moment: list[Array],
    low: list[Array],
    high: Array,
    grey: bool,
    *,
    start: Array,
    steps: int,
) -> list[Array]:
    """Minimise x G x - 2 b x over low <= x, and x <= high for the last one, which channels may share.

    Args:
        gram: G, (..., D, T).
        moment: b, (..., C, T).
        low: (C, T), at most 0.
        high: (C, T) or (T,), at least 0.
        grey: whether the channels, on the axis before the last, share the last unknown.
        start: of the last unknown, (..., C, T), where it is shared.
        steps: of Newton's method for it. What is left of its moment is convex and made of straight pieces, one for each
            set of the others at their bounds, so a few steps end, and one is enough where the set is known.
    """
    if not grey:
        return _bounded(gram, moment, low, high)
    inner = [row[:-1] for row in gram[:-1]]
    floor = jnp.broadcast_to(low[-1], moment[-1].shape)[..., :1, :]
    ceiling = jnp.broadcast_to(high, moment[-1].shape)[..., :1, :]

    def slope(shared: Array) -> tuple[Array, list[Array]]:
        right = [b - row[-1] * shared for b, row in zip(moment[:-1], gram[:-1], strict=True)]
        x = _bounded(inner, right, low[:-1], jnp.asarray(jnp.inf))
        left = moment[-1] - sum(map(operator.mul, gram[-1], [*x, shared]))
        return _over_channels(left), x

    shared = start[..., :1, :]
    for _ in range(steps):
        value, change, _ = jax.jvp(slope, (shared,), (jnp.ones_like(shared),), has_aux=True)
        shared = jnp.clip(shared + divide(value, -change), floor, ceiling)
    return [*slope(shared)[1], jnp.broadcast_to(shared, moment[-1].shape)]


def _bounded(gram: list[list[Array]], moment: list[Array], low: list[Array], high: Array) -> list[Array]:
    """`nonnegative` channel by channel: where the optimum without a bound breaks it, the optimum lies on that bound."""
    (pivot, *row), *rest = gram
    first, *others = moment
    if not others:
        return [jnp.clip(divide(first, pivot), low[0], high)]
    ratio = [divide(g, pivot) for g in row]
    block = [line[1:] for line in rest]
    schur = [
        [_left(g, a * b) if i == j else g - a * b for j, (g, b) in enumerate(zip(line, row, strict=True))]
        for i, (line, a) in enumerate(zip(block, ratio, strict=True))
    ]
    free = _bounded(schur, [b - a * first for b, a in zip(others, ratio, strict=True)], low[1:], high)
    x = divide(first, pivot) - sum(map(operator.mul, ratio, free))
    bound = _bounded(block, [b - g * low[0] for b, g in zip(others, row, strict=True)], low[1:], high)
    tight = x < low[0]
    return [jnp.where(tight, a, b) for a, b in zip([low[0], *bound], [x, *free], strict=True)]


def _solve(matrix: Any, right: Any, active: list[Array], shared: int) -> tuple[list[Array], ...]:
    """Solve M x = b by elimination, unknown by unknown; those from ``shared`` on the channels have in common.

    Args:
        matrix: M, (D, T).
        right: b, (C, T).
        active: which of the first unknowns may move, (C, T).
        shared: the first that all channels share.

    Returns:
        What is left of b for the last unknowns, after those with bounds; x; the square roots of the diagonal of the
        inverse.
    """
    size, matrix, right = range(len(right)), [list(row) for row in matrix], list(right)
    rows, slope = [], []
    for i in size:
        if i == shared:
            for j in size[i:]:
                right[j] = _over_channels(right[j])
                for k in size[j:]:
                    whole = jnp.broadcast_to(matrix[j][k], active[0].shape)
                    matrix[j][k] = matrix[k][j] = _over_channels(whole)
        inverse = divide(1.0, matrix[i][i])
        moves = inverse
        if i < len(active):
            moves = jnp.where(active[i] if i < shared else active[i][:1], inverse, 0)
        else:
            slope.append(right[i])
        ratio = {j: matrix[i][j] * moves for j in size[i + 1 :]}
        for j in size[i + 1 :]:
            right[j] = right[j] - ratio[j] * right[i]
            matrix[j][j] = _left(matrix[j][j], ratio[j] * matrix[i][j])
            for k in size[j + 1 :]:
                matrix[j][k] = matrix[k][j] = matrix[j][k] - ratio[j] * matrix[i][k]
        rows.append((inverse, ratio, right[i] * moves))
    x, error, covariance = [], [], {}
    for i in reversed(size):
        inverse, ratio, own = rows[i]
        x.insert(0, own - sum(ratio[j] * x[j - i - 1] for j in ratio))
        for j in ratio:
            covariance[i, j] = covariance[j, i] = -sum(ratio[k] * covariance[k, j] for k in ratio)
        covariance[i, i] = inverse - sum(ratio[k] * covariance[k, i] for k in ratio)
        error.insert(0, jnp.where(inverse > 0, square_root(covariance[i, i]), jnp.inf))
    return slope, x, error
