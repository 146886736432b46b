"""The numeric core of maps: the best material of each texel of a tile, all texels in step.

The photographs of a texel are ``y_p = k_a A_p + k_d D_p + k_s S_p(n)``. The coefficients are linear, so for a given n
the best non-negative ones are a closed form and the search is one-dimensional (variable projection, Golub and Pereyra
1973). It is global: the octaves of n, where the lobe's column is the square of the one before, then Gauss-Newton inside
the bracket about the best of them. The same sums give the standard errors. Where the normal is sought too, Gauss-Newton
takes it and the material together. Noise is even in codes: a value's weight is the square of the slope of its encoding.

Texels lie in the lanes of the processor, the last axis of every array, T. The C channels share the columns, whose
channel axis then is 1. What is more than a product is computed photograph by photograph, a loop over (T,) lanes whose
results XLA stores, and then summed: a sum over photographs that holds more than a product XLA takes lane by lane. What
would underflow is held above, for a processor takes a hundred times longer over such numbers.
"""

import functools
import itertools
import math
import operator
from collections.abc import Collection, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from brdf.models.base import SpecularMaterial
from brdf.vectors import divide, dot, mirror_log_cosine, normalize, perpendicular, square_root

OCTAVES = 16
"""The exponent is sought from 1 to 2^16: beyond, a lobe is narrower than the step between any two lights."""

NARROW = (5.3, 6.5)
"""And here: about n = 4 (N·H)^n is nearly N·L, which k_d takes, and the optimum's basin is narrower than an octave."""

STEPS = 5
"""Gauss-Newton steps in a bracket of two steps of the grid: they converge to single precision."""

CAP = 32.0
"""k_s is at most so many times the brightest value of its texel: where no light comes near the mirror direction, k_s
and n would go up together without end."""

JOINT_STEPS = 5
"""Gauss-Newton steps of material and normal together."""

HIGHLIGHTS = (4.0, 8.0, 16.0, 32.0, 64.0, 128.0, 256.0)
"""Exponents of a highlight that tells where the search for a normal starts."""

GEMAN_MCCLURE = 2.0
"""Where the weight of a residual starts to fall, in deviations."""

OUTLIER = 4.0
"""Residuals beyond so many deviations are no noise: one in 16,000 would be."""

DEPENDENT = 16.0
"""A column depends on others where elimination leaves so few rounding errors of its square."""


class Columns(NamedTuple):
    """What each photograph's light makes of the texels, times the root of the weight of its value: 0 without any.

    Attributes:
        linear: k_a's where there is ambient light, and k_d's, I (N·L)+, U of (P, D, T).
        weight: of the lobe of each of the light's S samples, (P, S, D, T).
        log_cosine: of the lobe, (P, S, T); ``vectors.BELOW_HORIZON`` or anything finite where there is none.
    """

    linear: list[Float[Array, "P D T"]]
    weight: Float[Array, "P S D T"]
    log_cosine: Float[Array, "P S T"]

    def where(self, counts: Float[Array, "P T"]) -> "Columns":
        """Of values that count."""
        counts = counts[:, None]
        return Columns([column * counts for column in self.linear], self.weight * counts[:, None], self.log_cosine)

    def lobe(self, model: Any, log_n: Float[Array, " T"]) -> tuple[Float[Array, "P D T"], Float[Array, "P D T"]]:
        """The lobe's column and its derivative by log n."""
        n = jnp.exp(log_n)
        scale, change = jax.jvp(model.scale, (n,), (n,))

        def of_photograph(photograph: tuple[Array, Array]) -> tuple[Array, Array]:
            exponent = jnp.maximum(n * photograph[1], _lowest(n.dtype))
            lobes = photograph[0] * jnp.exp(exponent)[:, None]
            value, slope = (jnp.sum(one, axis=0) for one in (lobes, lobes * exponent[:, None]))
            return scale * value, scale * slope + change * value

        return jax.lax.map(of_photograph, (self.weight, self.log_cosine))


def _lowest(dtype: Any) -> float:
    """The logarithm of numbers whose squares have products that do not underflow, and that no photograph shows."""
    return 0.24 * math.log(jnp.finfo(dtype).tiny)


class Target(NamedTuple):
    """What the photographs show of the texels, times the root of the weight of each value; 0 without any.

    Attributes:
        shown: (P, C, T).
        summed: over the channels, (P, T): where they have one weight, all that tells of a k_s which these share.
        cap: what k_s may be at most, (T,).
    """

    shown: Float[Array, "P C T"]
    summed: Float[Array, "P T"]
    cap: Float[Array, " T"]

    @classmethod
    def of(cls, shown: Float[Array, "P C T"], root: Any = 1.0) -> "Target":
        """With what follows from it.

        Args:
            shown: not weighted yet.
            root: of the weights, (P, D, T).
        """
        brightest = jnp.max(functools.reduce(jnp.maximum, [shown[:, c] for c in range(shown.shape[1])]), axis=0)
        shown = shown * root
        return cls(shown, over_channels(shown)[:, 0], CAP * jnp.maximum(brightest, 0))

    def where(self, counts: Float[Array, "P T"]) -> "Target":
        """Of values that count."""
        return Target(self.shown * counts[:, None], self.summed * counts, self.cap)

    def grey(self, root: Float[Array, "P D T"]) -> Float[Array, "P T"]:
        """Summed over the channels, without the weights whose root this is."""
        return self.summed if root.shape[1] == 1 else over_channels(divide(self.shown, root))[:, 0]


class TexelFit(NamedTuple):
    """The optimum of each texel. Errors are standard errors in units of the noise, infinite where nothing is known.

    Attributes:
        k: k_a (with ambient light), k_d and (of a model with a lobe) k_s, (C, T) each.
        k_error: of each; at the bound 0 that which it would have without.
        log_n: (T,).
        log_n_error: (T,).
        cost: sum of squared residuals, (T,).
        gain: by how much the last column lowers it, (T,).
        residual: summed over the channels, (P, T).
    """

    k: list[Float[Array, "C T"]]
    k_error: list[Float[Array, "C T"]]
    log_n: Float[Array, " T"]
    log_n_error: Float[Array, " T"]
    cost: Float[Array, " T"]
    gain: Float[Array, " T"]
    residual: Float[Array, "P T"]


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

    def columns(self, model: Any, normal: Any, root: Float[Array, "P D T"]) -> Columns:
        """Of texels with these normals, (3, T), and roots of the weights of their values."""
        axis = jnp.stack(tuple(normal), axis=-1)  # which XLA takes apart again: a transposed array it would copy
        photographs = jnp.asarray(self.to_light), root
        diffuse, weight, log_cosine = jax.lax.map(lambda one: self.of_light(model, axis, *one), photographs)
        ambient = [] if self.ambient is None else [self.ambient * root]
        return Columns([*ambient, diffuse], weight[:, None], log_cosine[:, None])

    def of_light(self, model: Any, axis: Array, to_light: Array, root: Array) -> tuple[Array, Array, Array]:
        """I (N·L)+ and the lobe's weight under one light, (D, T), and the logarithm of its cosine, (T,).

        Args:
            model: class of the material.
            axis: normals, (T, 3).
            to_light: (3,).
            root: of the values' weights, (D, T).
        """
        cosine = dot(axis, to_light)
        diffuse = root * jnp.maximum(cosine, 0)
        if not issubclass(model, SpecularMaterial):
            return diffuse, diffuse, cosine
        shines = jnp.where((cosine > 0) & (dot(axis, self.to_view) > 0), root, 0)
        weight = shines * cosine if model.cosine_weighted else shines
        return diffuse, weight, model.log_cosine(axis, to_light, self.to_view)


# -- normals given -----------------------------------------------------------------------------------------------------


def fit_texels(model: Any, target: Target, columns: Columns, grey: bool, finer: int) -> TexelFit:
    """The best material of each texel whose normal is known.

    Args:
        model: class of the material.
        target: what the photographs show.
        columns: of the lights.
        grey: whether the channels share k_s.
        finer: steps of the grid in each doubling of n: 1 under lights all over the sky, 2 under a ring of them.
    """
    if not issubclass(model, SpecularMaterial):
        return fit_at(model, target, columns, grey, jnp.zeros_like(target.cap))

    def step(_: Any, bracket: Bracket) -> Bracket:
        return bracket.narrowed(*slope_and_curvature(model, target, columns, grey, bracket.log_n))

    bracket = Bracket.about_best(octave_gains(model, target, columns, grey, finer), finer)
    return fit_at(model, target, columns, grey, jax.lax.fori_loop(0, STEPS, step, bracket).log_n)


def fit_unshadowed(
    model: Any, target: Target, columns: Columns, root: Float[Array, "P D T"], grey: bool, finer: int
) -> tuple[TexelFit, Float[Array, "P T"]]:
    """`fit_texels` where some values may lie in cast shadows, and what counted in the end, (P, T).

    Where values look like that the others are fitted without them, then all that is no outlier of that fit. This is
    kept where it explains the values better than a fit of all.
    """
    seen, column = counted(root), over_channels(columns.linear[-1])[:, 0] / root.shape[1]
    diffuse = column if root.shape[1] == 1 else divide(columns.linear[-1], root)[:, 0]
    dark = shadowed(target.grey(root), diffuse, column)
    square, whole = (jnp.sum(one * one, axis=0) for one in (dark, column))

    fit = fit_texels(model, target, columns, grey, finer)
    cost, freedom = penalised(model, fit, seen, seen, grey)
    # a k_d of their own, by its score: how far below the other one, in standard errors
    score = jnp.sum(dark * fit.residual, axis=0)
    variance = len(fit.k[0]) * divide(fit.cost, freedom) * square * (1 - divide(square, whole))
    worth = (score < 0) & (score**2 > jnp.minimum(OUTLIER**2, 0.25 * freedom) * variance)

    def without(_: Any, state: Any) -> Any:
        counts, best = state
        fit = fit_texels(model, target.where(counts), columns.where(counts), grey, finer)
        found = fit, counts, penalised(model, fit, seen, counts, grey)[0]
        best = jax.tree.map(lambda a, b: jnp.where(worth & (found[2] < best[2]), a, b), found, best)
        return _inliers(residual(model, target, columns, fit), seen, counts), best

    trials = jnp.where(jnp.any(worth), 2, 0)
    _, (fit, counts, _) = jax.lax.fori_loop(0, trials, without, (jnp.where(dark > 0, 0, seen), (fit, seen, cost)))
    return fit, counts


def octave_gains(model: Any, target: Target, columns: Columns, grey: bool, finer: int) -> Float[Array, "G T"]:
    """By how much the best material lowers the cost, at each n of the grid: see `fit_texels`."""
    dtype = target.cap.dtype
    gram, moment = _sums(columns.linear, target)
    floor = jnp.exp(_lowest(dtype))
    # all that the loop sums is a column times the lobe's cosine to a power: one multiplication less at each n
    one_weight = columns.weight.shape[2] == 1
    shown = target.summed[:, None] if grey and one_weight else target.shown
    weighted = [column[:, None] * columns.weight for column in (*columns.linear, shown)]

    def gain(power: Array, scale: Array) -> Array:
        *across, shown = (jnp.sum(column * power[:, :, None], axis=(0, 1)) for column in weighted)
        lobe = jnp.sum(columns.weight * power[:, :, None], axis=1)
        moments = [*moment, _of_all(over_channels(shown)[0], target) if grey else shown]
        square = jnp.sum(lobe * lobe, axis=0)
        whole = [*([*row, x] for row, x in zip(gram, across, strict=True)), [*across, square]]
        k = nonnegative(whole, moments, target.cap * scale, grey, steps=1)
        left = [b - 0.5 * sum(map(operator.mul, row, k)) for b, row in zip(moments, whole, strict=True)]
        return over_channels(sum(map(operator.mul, k, left)))[0]

    def octave(powers: list[Array], n: Array) -> tuple[list[Array], Array]:
        gains = [gain(power, scale) for power, scale in zip(powers, model.scale(n), strict=True)]
        return [jnp.maximum(power * power, floor) for power in powers], jnp.stack(gains)

    def at(n: Array) -> Array:
        return jnp.maximum(jnp.exp(n * columns.log_cosine), floor)

    exponents = jnp.asarray(grid(finer), dtype)
    octaves, between = exponents[: -len(NARROW)].reshape(-1, finer), exponents[-len(NARROW) :]
    gains = jax.lax.scan(octave, [at(n) for n in octaves[0]], octaves)[1].reshape(-1, *target.cap.shape)
    return jnp.concatenate([gains, jax.lax.map(lambda n: gain(at(n), model.scale(n)), between)])


def grid(finer: int) -> np.ndarray:
    """The exponents that the search starts with: octaves, or so many steps of each, and then those between."""
    return np.array([*2.0 ** (np.arange(finer * (OCTAVES + 1)) / finer), *NARROW])


class Bracket(NamedTuple):
    """Where log n is, (T,) each."""

    log_n: Float[Array, " T"]
    low: Float[Array, " T"]
    high: Float[Array, " T"]

    @classmethod
    def about_best(cls, gains: Float[Array, "G T"], finer: int) -> "Bracket":
        """About the best sample of the grid, from there: what is downhill of it is lower than all samples."""

        def look(best: tuple[Array, Array], sample: tuple[Array, Array]) -> tuple[Any, None]:
            index, gain = sample
            return (jnp.where(gain > best[1], index, best[0]), jnp.maximum(gain, best[1])), None

        order = np.argsort(grid(finer))
        log_n = jnp.minimum(jnp.log(jnp.asarray(grid(finer)[order], gains.dtype)), OCTAVES * math.log(2.0))
        start = jnp.zeros(gains.shape[1:], int), gains[0]
        (best, _), _ = jax.lax.scan(look, start, (jnp.arange(len(gains)), gains[order]))
        return cls(*(log_n[jnp.clip(best + side, 0, len(log_n) - 1)] for side in (0, -1, 1)))

    def narrowed(self, slope: Array, curvature: Array) -> "Bracket":
        """After a step; a step out of the bracket goes to its middle.

        Args:
            slope: half the negative derivative of the cost.
            curvature: Gauss and Newton's.
        """
        low = jnp.where(slope > 0, self.log_n, self.low)
        high = jnp.where(slope < 0, self.log_n, self.high)
        # At the minimum rounding turns the slope's sign: what leaves the bracket by no more is no reason to halve it.
        new, slack = self.log_n + divide(slope, curvature), 1e-3
        new = jnp.where((new < low - slack) | (new > high + slack), 0.5 * (low + high), new)
        return Bracket(jnp.clip(new, 0, OCTAVES * math.log(2.0)), low, high)


def slope_and_curvature(model: Any, target: Target, columns: Columns, grey: bool, log_n: Array) -> tuple[Array, Array]:
    """Half the negative derivative of the least cost by log n, and Gauss and Newton's curvature, (T,) each."""
    lobe, slope = columns.lobe(model, log_n)
    basis = [*columns.linear, lobe]
    point = _evaluate(basis, [{len(columns.linear): slope}], target, grey)
    return point.slope[0], divide(1.0, point.error[0] ** 2)


def fit_at(
    model: Any, target: Target, columns: Columns, grey: bool, log_n: Float[Array, " T"], *, sure: bool = False
) -> TexelFit:
    """The best coefficients for a given n; their errors allow for that of n, unless n is sure."""
    if not issubclass(model, SpecularMaterial):
        point = _evaluate(columns.linear, [], target, False)
        return TexelFit(point.k, point.k_error, log_n, jnp.full_like(log_n, jnp.inf), *point[-3:])
    lobe, slope = columns.lobe(model, log_n)
    unknowns = [] if sure else [{len(columns.linear): slope}]
    point = _evaluate([*columns.linear, lobe], unknowns, target, grey, free=True)
    log_n_error = jnp.zeros_like(log_n) if sure else point.error[0]
    return TexelFit(point.k, point.k_error, log_n, log_n_error, *point[-3:])


# -- normals sought ----------------------------------------------------------------------------------------------------


def fit_with_normals(
    model: Any,
    target: Target,
    root: Float[Array, "P D T"],
    lights: Distant,
    grey: bool,
    finer: int,
) -> tuple[TexelFit, Array, Array, Array, Array]:
    """The best material and normal of each texel.

    Lambert's law, fitted to what is neither highlight nor shadow, gives a normal, and a highlight alone, as of metals,
    another. The search over n gives each a material, and Gauss-Newton takes the better of them with its normal
    together; what no material explains is left out, n is sought once more, and both together again.

    Args:
        model: class of the material.
        target: what the photographs show.
        root: of the weights, 0 where a value does not count.
        lights: which are distant.
        grey: whether the channels share k_s.
        finer: see `fit_texels`.

    Returns:
        The fit; the normals, (3, T); their standard errors in units of the noise, (T,), the root mean square angle;
        what is lit and what of it is no outlier, (P, T): neither counts in the fit otherwise.
    """
    seen, shown, to_light = counted(root), target.grey(root), jnp.asarray(lights.to_light)

    def again(_: Any, state: Any) -> Any:
        fit, normal, _, _, counts = state
        columns = lights.columns(model, normal, root)
        lit = seen if lights.ambient is not None else jnp.where(columns.linear[0][:, 0] > 0, seen, 0)
        counts = _inliers(residual(model, target, columns, fit), lit, lit * counts)
        some, roots = target.where(counts), root * counts[:, None]
        fit = fit_texels(model, some, lights.columns(model, normal, roots), grey, finer)
        return *_jointly(model, some, roots, lights, grey, fit, normal), lit, counts

    def first(start: tuple[Array, Array]) -> tuple[TexelFit, Array, Array, Array]:
        normal, counts = start
        fit = fit_texels(
            model, target.where(counts), lights.columns(model, normal, root * counts[:, None]), grey, finer
        )
        return fit, normal, counts, penalised(model, fit, seen, counts, grey)[0]

    def unshadowed(_: Any, start: tuple[Array, Array]) -> tuple[Array, Array]:
        counts = seen - shadowed(shown, seen * jnp.maximum(to_light @ start[0], 0), seen)
        return lambert_normals(shown, counts, to_light), counts

    plain = lambert_normals(shown, seen, to_light), seen
    starts = [plain, jax.lax.fori_loop(0, 2, unshadowed, plain)]
    if issubclass(model, SpecularMaterial):
        starts.append((highlight_normals(model, shown, seen, lights), seen))
    found = jax.lax.map(first, jax.tree.map(lambda *some: jnp.stack(some), *starts))
    best = jnp.argmin(found[-1], axis=0)
    fit, normal, counts, _ = jax.tree.map(
        lambda some: jnp.squeeze(jnp.take_along_axis(some, best.reshape(1, *[1] * (some.ndim - 2), -1), 0), 0), found
    )
    return jax.lax.fori_loop(0, 2, again, (fit, normal, seen[0], seen, counts))


def counted(root: Float[Array, "P D T"]) -> Float[Array, "P T"]:
    """1 where a value has a weight, whose root this is."""
    return jnp.where(root[:, 0] > 0, 1, jnp.zeros((), root.dtype))


def residual(model: Any, target: Target, columns: Columns, fit: TexelFit) -> Float[Array, "P T"]:
    """What a fit leaves of the photographs, summed over the channels."""
    lobe = [columns.lobe(model, fit.log_n)[0]] if issubclass(model, SpecularMaterial) else []
    return over_channels(target.shown - sum(map(operator.mul, fit.k, [*columns.linear, *lobe])))[:, 0]


def penalised(model: Any, fit: TexelFit, seen: Array, counts: Array, grey: bool) -> tuple[Array, Array]:
    """The cost of a fit and of what it left out, outliers with the least residual of such; and its freedom; (T,)."""
    channels = len(fit.k[0])
    of_lobe = (1 if grey else channels) if issubclass(model, SpecularMaterial) else 0
    freedom = channels * jnp.sum(counts, axis=0) - (len(fit.k) - (of_lobe > 0)) * channels - of_lobe
    left_out = jnp.sum(seen - counts, axis=0)
    cost = jnp.where(freedom < 3, jnp.inf, fit.cost * (1 + OUTLIER**2 * left_out / jnp.maximum(freedom, 1)))
    return cost, freedom


def shadowed(
    grey: Float[Array, "P T"], diffuse: Float[Array, "P T"], column: Float[Array, "P T"]
) -> Float[Array, "P T"]:
    """A column where the value is less than half of what Lambert's law, fitted to all, tells; elsewhere 0.

    Args:
        grey: what the photographs show.
        diffuse: column of k_d.
        column: the one.
    """
    level = divide(jnp.sum(diffuse * grey, axis=0), jnp.sum(diffuse * diffuse, axis=0))
    return jax.lax.map(lambda one: jnp.where(one[0] < 0.5 * level * one[1], one[2], 0), (grey, diffuse, column))


def _inliers(
    residual: Float[Array, "P T"], seen: Float[Array, "P T"], counts: Float[Array, "P T"]
) -> Float[Array, "P T"]:
    """1 where a residual is no outlier: within `OUTLIER` standard deviations of those that are none.

    Args:
        residual: of all.
        seen: 1 where it counts.
        counts: 1 where none is expected.
    """
    square = residual * residual

    def clip(_: Any, counts: Array) -> Array:
        size = divide(jnp.sum(counts * square, axis=0), jnp.sum(counts, axis=0))
        return jnp.where(square <= OUTLIER**2 * size, seen, 0)

    return jax.lax.fori_loop(0, 4, clip, counts)


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
        return _linear(to_light, lit / (1 + ratio) ** 2, grey)

    return normalize(jax.lax.fori_loop(0, 8, step, _linear(to_light, seen, grey)).T).T


def highlight_normals(
    model: Any, grey: Float[Array, "P T"], seen: Float[Array, "P T"], lights: Distant
) -> Float[Array, "3 T"]:
    """Normals by the highlight's law alone, for the best of some n.

    It is (N·H)^n, or of Phong's models (L·R)^n where R is the view mirrored about N: the n-th root is linear in N or R.
    Weights make the errors of the roots those of the values.
    """
    mirrors = model.log_cosine is mirror_log_cosine
    axes = jnp.asarray(lights.to_light) if mirrors else normalize(lights.to_light + lights.to_view)
    bright = jnp.maximum(divide(grey, jnp.max(grey, axis=0)), jnp.exp(_lowest(grey.dtype)))

    def of_exponent(n: Array) -> tuple[Array, Array]:
        root = jnp.exp(jnp.log(bright) / n)
        vector = _linear(axes, seen * divide(bright, root) ** 2, root)
        cosine = jnp.maximum(axes @ vector, 0)
        return jnp.sum(seen * (bright - cosine**n) ** 2, axis=0), vector

    cost, vector = jax.lax.map(of_exponent, jnp.asarray(HIGHLIGHTS, grey.dtype))
    best = jnp.argmin(cost, axis=0)
    found = normalize(jnp.take_along_axis(vector, best[None, None], axis=0)[0].T)
    return normalize(found + lights.to_view if mirrors else found).T


def _linear(axes: Array, weight: Float[Array, "P T"], value: Float[Array, "P T"]) -> Float[Array, "3 T"]:
    """The vectors whose products with axes, (P, 3), are nearest to values."""
    roots = jnp.sqrt(weight)
    columns = jax.lax.map(lambda one: [axis * one[1][None] for axis in one[0]], (axes, roots))
    gram, moment = _sums(columns, Target.of((roots * value)[:, None]))
    return jnp.stack(_solve(_upper(gram), moment, [], 0)[1])


def _jointly(
    model: Any, target: Target, root: Array, lights: Distant, grey: bool, fit: TexelFit, normal: Array
) -> tuple[TexelFit, Array, Array]:
    """Gauss-Newton of material and normal together; a step that does not lower the cost is cut to a quarter."""
    glossy = issubclass(model, SpecularMaterial)

    def at(log_n: Array, normal: Array, *, free: bool = False) -> _Point:
        frame = perpendicular(normal)
        n = jnp.exp(log_n)
        scale, change = jax.jvp(model.scale, (n,), (n,)) if glossy else (n, n)

        def of_light(photograph: tuple[Array, Array]) -> Any:
            def turned(*tilt: Array) -> tuple[Array, Array, Array]:
                axis = [x + sum(map(operator.mul, tilt, e)) for x, *e in zip(normal, *frame, strict=True)]
                return lights.of_light(model, normalize(jnp.stack(axis, axis=-1)), *photograph)

            one, zero = jnp.ones_like(n), jnp.zeros_like(n)
            terms, first = jax.jvp(turned, (zero, zero), (one, zero))
            tilts = first, jax.jvp(turned, (zero, zero), (zero, one))[1]
            if not glossy:
                return [terms[0]], [[tilt[0]] for tilt in tilts]
            diffuse, weight, log_cosine = terms
            exponent = jnp.maximum(n * log_cosine, _lowest(n.dtype))
            power = jnp.exp(exponent)
            lobe, by_n = scale * weight * power, (scale * exponent + change) * weight * power
            return [diffuse, lobe], [
                [0 * diffuse, by_n],
                *([t[0], scale * power * t[1] + lobe * n * t[2]] for t in tilts),
            ]

        basis, slopes = jax.lax.map(of_light, (jnp.asarray(lights.to_light), root))
        basis = [*([] if lights.ambient is None else [lights.ambient * root]), *basis]
        first, last = int(lights.ambient is not None), len(basis) - 1
        by_n = [{last: slopes[0][1]}] if glossy else []
        tilts = [dict(enumerate(slope, start=first)) for slope in slopes[-2:]]
        return _evaluate(basis, [*by_n, *tilts], target, grey, free=free)

    def step(_: Any, state: Any) -> Any:
        log_n, normal, cost, change = state
        turn = sum(map(operator.mul, change[1:], perpendicular(normal)))
        new = jnp.clip(log_n + change[0], 0, OCTAVES * math.log(2.0)), normalize((normal + turn).T).T
        point = at(*new)
        better = point.cost < cost
        first = [jnp.clip(point.step[0], -1, 1)] if glossy else [jnp.zeros_like(cost)]
        taken = *new, point.cost, [*first, *(jnp.clip(angle, -0.2, 0.2) for angle in point.step[-2:])]
        kept = log_n, normal, cost, [0.25 * x for x in change]
        return jax.tree.map(lambda a, b: jnp.where(better, a, b), taken, kept)

    state = fit.log_n, normal, jnp.full_like(fit.log_n, jnp.inf), [jnp.zeros_like(fit.log_n)] * 3
    log_n, normal, *_ = jax.lax.fori_loop(0, 1 + JOINT_STEPS, step, state)
    point = at(log_n, normal, free=True)
    angle = square_root(point.error[-2] ** 2 + point.error[-1] ** 2)
    log_n_error = point.error[0] if glossy else fit.log_n_error
    return TexelFit(point.k, point.k_error, log_n, log_n_error, *point[-3:]), normal, angle


# -- least squares, one in each lane -----------------------------------------------------------------------------------


class _Point(NamedTuple):
    """The best coefficients at given nonlinear unknowns, and the Gauss-Newton step from there.

    Attributes:
        k: U of (C, T).
        k_error: in units of the noise.
        slope: half the negative derivative of the cost by each nonlinear unknown, (T,).
        step: of each.
        error: of each, in units of the noise.
        cost: sum of squared residuals, (T,).
        gain: by how much the last column lowers it, (T,).
        residual: summed over the channels, (P, T).
    """

    k: list[Array]
    k_error: list[Array]
    slope: list[Array]
    step: list[Array]
    error: list[Array]
    cost: Array
    gain: Array
    residual: Array


def _evaluate(
    columns: list[Array], unknowns: list[dict[int, Array]], target: Target, grey: bool, *, free: bool = False
) -> _Point:
    """The best coefficients, and the Gauss-Newton step of these and the nonlinear unknowns together.

    Args:
        columns: U of (P, D, T); the last is k_s's where unknowns are given that move it.
        unknowns: of each nonlinear one the derivatives of the columns, by their index.
        target: what the photographs show.
        grey: whether the channels share the last coefficient, which has a cap.
        free: whether a k_a or k_d of 0 is as unknown as others, as errors want it: what holds it there is noise, and n
            would seem determined by light that the next draw gives to k_d. In a step it stays where it is.
    """
    count = len(columns)
    slopes = [(i, slope) for unknown in unknowns for i, slope in unknown.items()]
    moved = [*range(count), *(i for i, _ in slopes)]
    shared = {index for index, i in enumerate(moved) if grey and i == count - 1}
    gram, moment = _sums([*columns, *(slope for _, slope in slopes)], target, shared)
    k = nonnegative([row[:count] for row in gram[:count]], moment[:count], target.cap, grey, steps=2)
    left = [b - sum(map(operator.mul, row, k)) for b, row in zip(moment, gram, strict=True)]
    # the derivative by a nonlinear unknown is a combination of derivatives of columns
    index = itertools.count(count)
    parts = [[(i, jnp.ones(()))] for i in range(count)]
    parts += [[(next(index), k[i]) for i in unknown] for unknown in unknowns]
    matrix = {
        (u, v): sum(a * b * gram[i][j] for i, a in parts[u] for j, b in parts[v])
        for u, v in itertools.combinations_with_replacement(range(len(parts)), 2)
    }
    right = [sum(a * left[i] for i, a in part) for part in parts]
    active = [(x > 0) | (free and i < count - 1) for i, x in enumerate(k)]
    active[-1] &= k[-1] < target.cap
    slope, step, error, variance = _solve(matrix, right, active, count - grey)

    def left_of(photograph: Any) -> tuple[Array, Array]:
        residual = photograph[0] - sum(map(operator.mul, k, photograph[1]))
        return over_channels(residual)[0], over_channels(residual * residual)[0]

    residual, square = jax.lax.map(left_of, (target.shown, columns))
    errors = [jnp.broadcast_to(value, target.shown.shape[1:]) for value in error[:count]]
    slope, step, error = (some[len(some) - len(unknowns) :] for some in (slope, step, error))
    gain = over_channels(divide(k[-1] ** 2, variance[count - 1]))[0] / (len(k[-1]) if grey else 1)
    return _Point(k, errors, slope, step, error, jnp.sum(square, axis=0), gain, residual)


def _sums(
    columns: Sequence[Array], target: Target, shared: Collection[int] = ()
) -> tuple[list[list[Array]], list[Array]]:
    """The Gram matrix of columns, (D, T), and their moments with what the photographs show, (C, T).

    Args:
        columns: U of (P, D, T).
        target: what the photographs show.
        shared: columns whose coefficient the channels share.
    """
    size = range(len(columns))
    upper = {(i, j): jnp.sum(columns[i] * columns[j], axis=0) for j in size for i in size[: j + 1]}
    gram = [[upper[min(i, j), max(i, j)] for j in size] for i in size]
    return gram, [_moment(column, target, i in shared) for i, column in enumerate(columns)]


def _moment(column: Float[Array, "P D T"], target: Target, shared: bool) -> Float[Array, "C T"]:
    """Of a column with what the photographs show; where channels share its coefficient the first has that of all."""
    if not shared:
        return jnp.sum(column * target.shown, axis=0)
    shown = target.summed[:, None] if column.shape[1] == 1 else target.shown
    return _of_all(over_channels(jnp.sum(column * shown, axis=0))[0], target)


def _of_all(moment: Array, target: Target) -> Float[Array, "C T"]:
    """The moment of all channels, (T,) or (1, T), as the first one's."""
    return jnp.where(jnp.arange(target.shown.shape[1])[:, None] == 0, moment, 0)


def _upper(gram: list[list[Array]]) -> dict[tuple[int, int], Array]:
    pairs = itertools.combinations_with_replacement(range(len(gram)), 2)
    return {(i, j): gram[i][j] for i, j in pairs}


def over_channels(values: Any) -> Array:
    """The sum over the axis before the last, which stays, term by term: a reduction would not run in the lanes."""
    return functools.reduce(operator.add, (values[..., c : c + 1, :] for c in range(values.shape[-2])))


def _left(square: Array, taken: Array) -> Array:
    """What elimination leaves of a column's square; 0 where that is rounding."""
    left = square - taken
    return jnp.where(left > DEPENDENT * jnp.finfo(left.dtype).eps * square, left, 0)


def nonnegative(
    gram: list[list[Array]], moment: list[Array], high: Float[Array, " T"], grey: bool, *, steps: int
) -> list[Array]:
    """Minimise x G x - 2 b x over 0 <= x, and x <= high for the last one, which channels may share.

    Args:
        gram: G, (D, T).
        moment: b, (C, T).
        high: at least 0.
        grey: whether the channels share the last unknown.
        steps: of Newton's method for it. What is left of its moment is made of straight pieces, one for each set of the
            others at 0, so a few steps end.
    """
    if not grey:
        return _bounded(gram, moment, high)
    # channel by channel, in arrays of their own: a short axis between the lanes would cost four times as much
    last, channels = len(gram) - 1, range(len(moment[-1]))
    grams = [[[x[c % len(x)] for x in row] for row in gram] for c in channels]
    moments = [[b[c] for b in moment] for c in channels]

    def others(shared: Array) -> list[list[Array]]:
        rights = [
            [b - row[-1] * shared for b, row in zip(own[:-1], rows, strict=False)]
            for own, rows in zip(moments, grams, strict=True)
        ]
        inner = [[row[:-1] for row in rows[:-1]] for rows in grams]
        return [_bounded(rows, right, jnp.asarray(jnp.inf)) for rows, right in zip(inner, rights, strict=True)]

    def solved(active: list[list[Array]]) -> Array:
        systems = zip(map(_upper, grams), moments, active, strict=True)
        left = [_eliminate(upper, enumerate(own), moves, range(last))[1] for upper, own, moves in systems]
        square, right = (
            functools.reduce(operator.add, terms)
            for terms in zip(*((matrix[last, last], rest[last]) for matrix, rest in left), strict=True)
        )
        return jnp.clip(divide(right, square), 0, high)

    shared = solved([[jnp.ones(high.shape, bool)] * last for _ in channels])
    for _ in range(steps):
        shared = solved([[x > 0 for x in own] for own in others(shared)])
    free = [jnp.stack(one) for one in zip(*others(shared), strict=True)]
    return [*free, jnp.broadcast_to(shared, moment[-1].shape)]


def _bounded(gram: list[list[Array]], moment: list[Array], high: Array) -> list[Array]:
    """`nonnegative` channel by channel: where the optimum without a bound breaks it, the optimum lies on that bound."""
    (pivot, *row), *rest = gram
    first, *others = moment
    if not others:
        return [jnp.clip(divide(first, pivot), 0, high)]
    ratio = [divide(g, pivot) for g in row]
    block = [line[1:] for line in rest]
    schur = [
        [_left(g, a * b) if i == j else g - a * b for j, (g, b) in enumerate(zip(line, row, strict=True))]
        for i, (line, a) in enumerate(zip(block, ratio, strict=True))
    ]
    free = _bounded(schur, [b - a * first for b, a in zip(others, ratio, strict=True)], high)
    x = divide(first, pivot) - sum(map(operator.mul, ratio, free))
    return [jnp.where(x < 0, a, b) for a, b in zip([0.0, *_bounded(block, others, high)], [x, *free], strict=True)]


def _solve(
    matrix: Mapping[tuple[int, int], Any], right: Sequence[Any], active: list[Array], shared: int
) -> tuple[list[Array], ...]:
    """Solve M x = b by elimination: first each channel's own unknowns, then those that the channels have in common.

    Args:
        matrix: M, the upper triangle, (D, T).
        right: b, (C, T).
        active: which of the first unknowns may move, (C, T).
        shared: the first that all channels share.

    Returns:
        Of each unknown that all share what is left of b for it after those before it, and x, (T,); of all the square
        roots of the diagonal of the inverse, (C, T) or (T,), and the squares of what these are where the unknowns after
        are known.
    """
    shape, count = right[0].shape, len(right)
    always = [jnp.ones(shape, bool)] * (count - len(active))
    system = jax.tree.map(lambda x: jnp.broadcast_to(x, shape), (matrix, dict(enumerate(right)), [*active, *always]))
    # channel by channel, so that what comes out is stored
    own, left = jax.lax.map(lambda channel: _eliminate(channel[0], channel[1], channel[2], range(shared)), system)
    matrix, right = jax.tree.map(lambda x: jnp.sum(x, axis=0), left)
    common, _ = _eliminate(matrix, right, [x[0] for x in system[2]], range(shared, count))
    x, error, covariance = {}, [], {}
    for i in reversed(range(count)):
        inverse, left, moves, row = (own | common)[i]
        x[i] = left * moves - sum(row[j] * x[j] for j in row)
        for j in row:
            covariance[i, j] = covariance[j, i] = -sum(row[k] * covariance[k, j] for k in row)
        covariance[i, i] = inverse - sum(row[k] * covariance[k, i] for k in row)
        error.insert(0, jnp.where(inverse > 0, square_root(covariance[i, i]), jnp.inf))
    left = [left for _, left, *_ in common.values()]
    return left, [x[i] for i in common], error, [inverse for inverse, *_ in (own | common).values()]


def _eliminate(matrix: Any, right: Any, active: Any, first: range) -> tuple[Any, Any]:
    """Eliminate some unknowns of a symmetric system, where they are active.

    Returns:
        Of each the inverse of its pivot, what was left of b, by what that is multiplied, and its row over its pivot;
        and what is left of the matrix and of b.
    """
    matrix, right, rows = dict(matrix), dict(right), {}
    for i in first:
        pivot, own = matrix.pop((i, i)), right.pop(i)
        inverse = divide(1.0, pivot)
        moves = jnp.where(active[i], inverse, 0)
        across = {j: matrix.pop((i, j)) for j in right}
        row = {j: value * moves for j, value in across.items()}
        rows[i] = inverse, own, moves, row
        for j, k in matrix:
            taken = row[j] * across[k]
            matrix[j, k] = _left(matrix[j, k], taken) if j == k else matrix[j, k] - taken
        right = {j: value - row[j] * own for j, value in right.items()}
    return rows, (matrix, right)
