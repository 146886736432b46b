"""The numeric core of maps: the best material of each texel of a tile, all texels in step.

The photographs of a texel are ``y_p = k_a A_p + k_d D_p + k_s S_p(n)``. The coefficients are linear, so for a given n
the best non-negative ones are a closed form and the search is one-dimensional (variable projection, Golub and Pereyra
1973). It is global: a grid of octaves of n, where the lobe's column is the square of the one before, then Gauss-Newton
in the brackets about its two highest peaks. The same sums give the standard errors. Where the normal is sought too,
Gauss-Newton takes it and the material together. A value's weight is of its noise, which is even in codes or grows with
brightness: see `fitting.maps.tiles`.

The P photographs are the last axis of what is summed over them, (T, P), one array a channel in `Components`, or one for
all where these are alike. What is left of T texels are arrays whose last axis these are; a channel axis stands before
it, C or 1 long. What would underflow is held above, for a processor takes a hundred times longer over such numbers.
"""

import dataclasses
import functools
import itertools
import math
import operator
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from brdf.models.base import SpecularMaterial
from brdf.precision import apart, at_a_time
from brdf.vectors import (
    BELOW_HORIZON,
    Components,
    divide,
    dot,
    largest,
    mirror_log_cosine,
    normalize,
    perpendicular,
    square_root,
)
from fitting.solver.normal_equations import totals
from fitting.uncertainty.intervals import NORMAL_95

OCTAVES = 16
"""The exponent is sought from 1 to 2^16: beyond, a lobe is narrower than the step between any two lights."""

MOST_LOG_N = OCTAVES * math.log(2.0)

TOGETHER = 4
"""Octaves whose sums are taken in one pass: those of more do not fit into a processor's registers."""

BROAD = 4
"""Steps of the grid in each doubling of n up to 2^`TOGETHER`: about n = 4 (N·H)^n is nearly N·L, which k_d takes, and
the cost has minima on either side that are narrower than an octave."""

RIVAL = 1.0
"""The second peak is climbed too where its cost exceeds the first one's by at most so much of what that leads to."""

ALLOWED = 3.0
"""By so many deviations a fit may be worse than the best one and still count: the grid may miss what is within 1.96."""

FEW = 32
"""Texels that are fitted anew at a time, from the second peak or without what lies in cast shadows."""

STEPS = 4
"""Gauss-Newton steps in a bracket of two steps of the grid: they converge to single precision."""

CAP = 32.0
"""The peak of a lobe shows at most so many times the brightest value of its texel: where no light comes near the mirror
direction k_s and n would go up together without end."""

JOINT_STEPS = 5
"""Gauss-Newton steps of material and normal together."""

TURNS = 2
"""How often these are taken without the outliers of the last."""

DARK = 0.15, 0.35
"""Of the level of what is lit: values below the first may lie in a deep shadow, below the second in any."""

FEWEST_BRIGHT = 8
"""Values that tell a material and a normal; where fewer are bright, as of metals, what is dark tells too."""

HIGHLIGHTS = (4.0, 8.0, 16.0, 32.0, 64.0, 128.0, 256.0)
"""Exponents of a highlight that tells where the search for a normal starts."""

GEMAN_MCCLURE = 2.0
"""Where the weight of a residual starts to fall, in deviations."""

RESTARTS = (3.0, 8.0, 32.0, 128.0)
"""Exponents from which minima are sought once more."""

STANDS_OUT = 1.5
"""Of its tile's median: a cost that tells of a minimum that is not the least."""

OUTLIER = 4.0
"""Residuals beyond so many deviations are no noise: one in 16,000 would be."""

DEPENDENT = 16.0
"""A column depends on others where elimination leaves so few rounding errors of its square."""


# -- photographs -------------------------------------------------------------------------------------------------------


def sums(*terms: Components) -> list[Array]:
    """Each term's sum over photographs, (D, T): all in one loop, which computes what several share once."""
    if not terms:
        return []
    rows = [row for term in terms for row in term]
    found = iter(totals(rows, ["add"] * len(rows), (1,)))
    return [jnp.stack([next(found) for _ in term]) for term in terms]


def sums_of(*terms: Array) -> list[Array]:
    """`sums` of terms without channels, (T,) each."""
    return [found[0] for found in sums(*(Components((term,)) for term in terms))]


def over_channels(values: Components) -> Array:
    """The sum over channels, (T, P)."""
    return functools.reduce(operator.add, values)


def beside(of_texels: Any) -> Components:
    """Arrays of texels, for what is beside photographs."""
    return Components(tuple(x[..., None] for x in of_texels))


def lowest(dtype: Any) -> float:
    """The logarithm of numbers whose squares have products that do not underflow, and that no photograph shows."""
    return 0.24 * math.log(jnp.finfo(dtype).tiny)


class Distant(NamedTuple):
    """Distant lights.

    Attributes:
        to_light: unit, (P,) each component; 0 for no light.
        to_view: unit.
        ambient: column of the ambient light, or None.
    """

    to_light: Components
    to_view: Components
    ambient: Components | None

    def terms(self, model: Any, normal: Components) -> tuple[Array, Array, Array]:
        """(N·L)+, the lobe's weight and the logarithm of its cosine, (T, P) each, of normals, (T,)."""
        axis = beside(normal)
        cosine = dot(axis, self.to_light)
        diffuse = jnp.maximum(cosine, 0)
        if not issubclass(model, SpecularMaterial):
            return diffuse, diffuse, cosine
        shines = (cosine > 0) & (dot(axis, self.to_view) > 0)
        weight = jnp.where(shines, cosine if model.cosine_weighted else jnp.ones_like(cosine), 0)
        return diffuse, weight, model.log_cosine(axis, self.to_light, self.to_view)


class TexelFit(NamedTuple):
    """The optimum of each texel. Errors are standard errors in units of the noise, infinite where nothing is known.

    Attributes:
        k: k_a (with ambient light), k_d and (of a model with a lobe) k_s, (C, T) each.
        k_error: of each; at the bound 0 that which it would have without.
        log_n: (T,).
        slope: half the negative derivative of the cost by log n and angles, (T,) each, where these are sought.
        step: Gauss and Newton's.
        error: of each.
        cost: sum of squared residuals, (T,).
        gain: by how much the last column lowers it, (T,).
    """

    k: list[Array]
    k_error: list[Array]
    log_n: Array
    slope: list[Array]
    step: list[Array]
    error: list[Array]
    cost: Array
    gain: Any


class Texels(eqx.Module):
    """Texels of a tile: what their photographs show, and the columns that are to explain it.

    Values and columns are times the root of the weight of each value: 0 where it does not count.

    Attributes:
        model: class of the material.
        grey: whether the channels share k_s.
        finer: steps of the grid in each doubling of n: 1 under lights all over the sky, 2 under a ring of them.
        shown: values, (C, T, P).
        root: of the weights.
        linear: columns of k_a, where there is ambient light, and of k_d, I (N·L)+.
        weight: of the lobe of each of the S samples of a light, (S, T, P) a channel.
        log_cosine: of the lobe, (S, T, P); ``vectors.BELOW_HORIZON`` or anything finite where there is none.
        relative: whether the lobe of a texel is relative to its largest value, and k_s held by no cap: where no more is
            asked for than what is explained.
    """

    model: Any = eqx.field(static=True)
    grey: bool = eqx.field(static=True)
    finer: int = eqx.field(static=True)
    shown: Array
    root: Components
    linear: Any = ()
    weight: Any = None
    log_cosine: Any = None
    relative: bool = eqx.field(static=True, default=False)

    @property
    def glossy(self) -> bool:
        """Whether the model has a lobe."""
        return issubclass(self.model, SpecularMaterial)

    @property
    def values(self) -> Components:
        """What is shown, channel by channel."""
        return Components(tuple(self.shown))

    @property
    def of_lobe(self) -> int:
        """How many coefficients the lobe of a texel has."""
        return self.glossy * (1 if self.grey else len(self.shown))

    @property
    def seen(self) -> Array:
        """1 where a value counts, (T, P)."""
        return (self.root.parts[0] > 0).astype(self.shown.dtype)

    @property
    def cap(self) -> Array:
        """What k_s may be at most, (T,), by the light that arrives; of a matt surface k_d may be anything."""
        if self.relative or not self.glossy:
            return jnp.full_like(self.shown[0, :, 0], jnp.inf)
        brightest, light = (
            jnp.max(largest(self.unweighted(one)), axis=1) for one in (self.values, self.lobe(jnp.ones(())))
        )
        return CAP * divide(jnp.maximum(brightest, 0), light)

    def unweighted(self, values: Components) -> Components:
        """Values or a column without the roots of the weights."""
        return values if len(self.root.parts) == 1 else Components(tuple(map(divide, values, self.root)))

    def where(self, counts: Array) -> "Texels":
        """Of values that count, (T, P)."""
        return jax.tree.map(functools.partial(operator.mul, counts), self)

    def some(self, lanes: Array) -> "Texels":
        """Those of some indices."""
        return jax.tree.map(lambda one: one[..., lanes, :], self)

    def facing(self, normal: Components, lights: Distant) -> "Texels":
        """With the columns of distant lights."""

        def columns(normal, root):
            diffuse, weight, log_cosine = lights.terms(self.model, normal)
            return root * diffuse, root * weight, log_cosine

        diffuse, *lobe = apart(columns, normal, self.root)
        ambient = [] if lights.ambient is None else [self.root * lights.ambient]
        weight, log_cosine = jax.tree.map(lambda one: one[None], lobe)
        return dataclasses.replace(self, linear=[*ambient, diffuse], weight=weight, log_cosine=log_cosine)

    def power(self, n: Any) -> Array:
        """Of the lobe's cosine, (S, T, P)."""
        log_cosine = self.log_cosine
        if self.relative:
            shines = functools.reduce(operator.or_, (weight > 0 for weight in self.weight))
            top = jnp.max(jnp.where(shines, log_cosine, BELOW_HORIZON), axis=(0, -1), keepdims=True)
            log_cosine = jnp.minimum(log_cosine - jax.lax.stop_gradient(top), 0)
        return jnp.exp(jnp.maximum(n * log_cosine, lowest(self.shown.dtype)))

    def lobe(self, power: Array) -> Components:
        """A power of the lobe's cosine, weighted and added up over the samples of each light."""
        return Components(tuple(jnp.sum(weight * power, axis=0) for weight in self.weight))

    def columns(self, log_n: Array) -> list[Components]:
        """All of them, at an exponent, (T,)."""
        n = jnp.exp(log_n)[:, None]
        return [*self.linear, *([self.lobe(self.model.scale(n) * self.power(n))] if self.glossy else [])]

    def residual(self, fit: TexelFit) -> Components:
        """What a fit leaves of the photographs."""
        explained = (column * beside(x) for x, column in zip(fit.k, self.columns(fit.log_n), strict=True))
        return functools.reduce(operator.sub, explained, self.values)

    # -- normals given -------------------------------------------------------------------------------------------------

    def searched(self) -> tuple["Profile", TexelFit]:
        """The grid of n, and the best material of each texel: from its highest peak, of a few from the second too."""
        profile = self.profile()
        found = self.climbed(profile.brackets[0])

        def better(lanes, first):
            second = self.some(lanes).climbed(profile.brackets[1][:, lanes])
            return jax.tree.map(lambda a, b: jnp.where(second.cost < first.cost, b, a), first, second)

        return profile, of_few(rivals(profile.heights, found.cost), found, better)

    def climbed(self, bracket: Array) -> TexelFit:
        """Where Gauss-Newton ends in brackets of log n, (3, T)."""

        def step(_, bracket):
            point = self.evaluated(bracket[0], self.by_log_n(bracket[0]), errors=False)
            return narrowed(bracket, point.slope[0], point.step[0])

        return self.minimum(jax.lax.fori_loop(0, STEPS, step, bracket)[0] if self.glossy else bracket[0])

    def minimum(self, log_n: Array) -> TexelFit:
        """The best coefficients for a given n and their cost; of the others nothing."""
        return self.at(log_n, errors=False, n_known=True)._replace(k_error=[], gain=None)

    def at(self, log_n: Array, *, errors: bool = True, n_known: bool = False) -> TexelFit:
        """The best coefficients for a given n; their errors allow for that of n, unless n is sure."""
        return self.evaluated(log_n, [] if n_known else self.by_log_n(log_n), errors)

    def by_log_n(self, log_n: Array) -> list[Components]:
        """The derivative of the lobe's column, if there is one."""
        return [jax.jvp(lambda x: self.columns(x)[-1], (log_n,), (jnp.ones_like(log_n),))[1]] * self.glossy

    def profile(self) -> "Profile":
        """The best material of each texel at each n of the grid."""
        if not self.glossy:
            nothing = jnp.zeros_like(self.cap)
            brackets = jnp.zeros((2, 3, nothing.size), nothing.dtype)
            return Profile(nothing[None], [], jnp.stack([nothing, nothing - jnp.inf]), brackets)
        dtype, size = self.shown.dtype, len(self.linear) + 2

        def sums_at(powers):
            lobes = map(self.lobe, powers)
            found = sums(*(x * lobe for lobe in lobes for x in (*self.linear, lobe, self.target(size - 2, lobe))))
            return [jnp.stack(found[i::size]) for i in range(size)]

        def octaves(n):
            powers = [self.power(n)]
            for _ in range(TOGETHER - 1):
                powers.append(jnp.maximum(powers[-1] * powers[-1], math.exp(lowest(dtype))))
            return sums_at(powers)

        exponents = grid(self.finer)
        found = jax.lax.map(octaves, jnp.asarray(exponents[::TOGETHER], dtype))
        *across, square, shown = (one.reshape(-1, *one.shape[2:]) for one in found)
        rows = [[*row, x, b] for (*row, b), x in zip(self.products(self.linear), across, strict=True)]
        rows.append([*across, square, shown])
        cap = self.cap * self.model.scale(jnp.asarray(exponents, dtype))[:, None]
        k = nonnegative(rows, cap, self.grey, steps=2)
        lowered = (x * (b - 0.5 * sum(map(operator.mul, row, k))) for x, (*row, b) in zip(k, rows, strict=True))
        gains = jnp.sum(functools.reduce(operator.add, lowered), axis=-2)
        k[-1] /= self.model.scale(jnp.asarray(exponents, dtype))[:, None, None]
        return Profile(gains, k, *peaks(gains, exponents))

    def unshadowed(self) -> "Trial":
        """The best material of each texel, where some values may lie in cast shadows.

        Where values look like that the others are fitted without them, then all that is no outlier of that fit. This is
        kept where it explains the values better than a fit of all.
        """
        seen, diffuse = self.seen, self.linear[-1]
        dark = seen * shadowed(*(over_channels(self.unweighted(one)) for one in (self.values, diffuse)))
        profile, found = self.searched()
        first = Trial.of(self, profile, found, seen)
        # a k_d of their own, by its score: how far below the other one, in standard errors
        terms = sums(self.residual(found) * diffuse * dark, diffuse * diffuse * dark, diffuse * diffuse)
        score, square, whole = (jnp.sum(jnp.broadcast_to(one, self.shown.shape[:2]), axis=0) for one in terms)
        variance = divide(found.cost, first.freedom) * square * (1 - divide(square, whole))
        worth = (score < 0) & (score**2 > jnp.minimum(OUTLIER**2, 0.25 * first.freedom) * variance)

        def anew(lanes, old):
            some, every = self.some(lanes), seen[lanes]

            def again(_, state):
                counts, best = state
                part = some.where(counts)
                trial = Trial.of(some, *part.searched(), counts)
                best = jax.tree.map(lambda a, b: jnp.where(trial.cost < best.cost, b, a), best, trial)
                return inliers(some.residual(trial.found), every, counts), best

            return jax.lax.fori_loop(0, 2, again, (every - dark[lanes], old))[1]

        return of_few(worth, first, anew)

    # -- least squares -------------------------------------------------------------------------------------------------

    def target(self, index: int, column: Components) -> Components:
        """What tells of a column's coefficient: of a k_s that the channels share, and the column, their mean."""
        of_lobe = index - len(self.linear) in (0, 1)  # and its derivative by log n
        shared = self.grey and of_lobe and len(column.parts) == 1
        return Components((over_channels(self.values) / len(self.shown),)) if shared else self.values

    def products(self, columns: list[Components]) -> "Rows":
        """The products of columns with each other and with what the photographs show.

        The sums of the first, linear ones stand by themselves: they are the same for each n, and leave loops over it.
        """
        count, linear, found = len(columns), len(self.linear), {}
        pairs = [(i, j) for i in range(count) for j in range(i, count + 1)]
        for alike in (True, False):
            some = [(i, j) for i, j in pairs if (i < linear and (j < linear or j == count)) == alike]
            others = [self.target(i, columns[i]) if j == count else columns[j] for i, j in some]
            found |= zip(some, sums(*(columns[i] * b for (i, _), b in zip(some, others, strict=True))), strict=True)
        return [[found[min(i, j), max(i, j)] for j in range(count + 1)] for i in range(count)]

    def evaluated(
        self, log_n: Array, slopes: list[Components], errors: bool = True, *, n_known: bool = False
    ) -> TexelFit:
        """The best coefficients, and the Gauss-Newton step of these and the nonlinear unknowns together.

        Slopes are derivatives of what is explained by the nonlinear unknowns: by log n, unless that is known, the first
        of a model with a lobe, of the lobe. With ``errors`` what is at a bound is as unknown as others: what holds it
        there is noise, and n would seem determined by light that the next draw gives to k_d. In a step it stays where
        it is.
        """
        columns = self.columns(log_n)
        count = len(columns)
        rows = self.products([*columns, *slopes])
        k = nonnegative([[*row[:count], row[-1]] for row in rows[:count]], self.cap, self.grey, steps=2 + errors)
        factors: list[Any] = [1.0] * (count + len(slopes))
        if self.glossy and slopes and not n_known:
            factors[count] = k[-1]
        rows = [
            [*(a * x * b for x, b in zip(row, factors, strict=True)), a * (moment - sum(map(operator.mul, row, k)))]
            for a, (*row, moment) in zip(factors, rows, strict=True)
        ]
        active = None
        if not errors:
            active = [*(x > 0 for x in k), *[True] * len(slopes)]
            active[count - 1] &= k[-1] < self.cap
        solved = solve(rows, active, count - self.grey)
        gain = jnp.sum(divide(k[-1] ** 2, solved[count - 1].inverse), axis=0)
        of_channels = k, [one.error for one in solved[:count]]
        k, k_error = ([jnp.broadcast_to(x, self.shown.shape[:2]) for x in some] for some in of_channels)
        slope, step, error = ([getattr(one, name)[0] for one in solved[count:]] for name in ("left", "step", "error"))
        fit = TexelFit(k, k_error, log_n, slope, step, error, gain, gain)
        left = self.residual(fit)
        return fit._replace(cost=jnp.sum(*sums(left * left), axis=0))


def columns_of(
    models: Sequence[Any], chosen: Any, log_n: Array, photographs: int, lit: Callable[[Texels], Texels]
) -> list[Array]:
    """The columns of k_d and k_s, and the derivative of the latter by log n, (T, P, C) each or (T, P, 1).

    Texels have chosen models; ``lit`` gives those of one their columns. Of a model without a lobe the last two are 0.
    """
    one = jnp.ones((1, log_n.size, photographs), log_n.dtype)
    found = [jnp.zeros_like(one[0])[..., None]] * 3
    for index, model in enumerate(models):
        texels = lit(Texels(model, False, 1, one, Components(tuple(one))))
        own = *texels.columns(log_n), *texels.by_log_n(log_n)
        mine = (chosen == index)[:, None, None]
        own = [jnp.stack(new.parts, axis=-1) for new in own]
        found = [jnp.where(mine, new, old) for new, old in itertools.zip_longest(own, found, fillvalue=0)]
    return found


class Profile(NamedTuple):
    """The best fits at each n of the grid, where a search starts.

    Attributes:
        gains: by how much they lower half the cost, (G, T).
        k: as of `TexelFit`, (G, C, T) each, (G, 1, T) where channels share it; of a model without a lobe nothing.
        heights: the two highest peaks of the gains, (2, T).
        brackets: of log n about them, (2, 3, T).
    """

    gains: Array
    k: list[Array]
    heights: Array
    brackets: Array

    def errors(self, fit: TexelFit, square: Array, variance: Array, finer: int) -> list[Array]:
        """Standard errors of k and log n by the profile of their likelihood: how far from a fit all lie that it allows.

        Where what is explained is linear in log n they are the fit's own; where many n serve alike, as of a highlight
        whose top no light shows, far larger. ``square`` is the sum of that of what is shown, (T,).
        """
        log_n = jnp.log(jnp.asarray(grid(finer), square.dtype))[:, None]
        variance = jnp.maximum(variance, jnp.finfo(square.dtype).eps * square)  # what is below is rounding
        share = per_deviation(square - fit.cost - 2 * self.gains, variance)
        apart = [jnp.abs(one - best) for one, best in zip(self.k, fit.k, strict=True)]
        apart = [*(share[:, None] * one for one in apart), share * jnp.abs(log_n - fit.log_n)]
        return [functools.reduce(jnp.maximum, one) for one in apart]


class Trial(NamedTuple):
    """A fit of some of the values, and what it is judged by.

    Attributes:
        profile: where its search started.
        found: the minimum, see `Texels.minimum`.
        counts: 1 where a value counts, (P, T).
        cost: of it and of what it leaves out, which counts as outliers with the least residual of such, (T,).
        freedom: of it, (T,).
        normal: that it is for; None where normals are given.
    """

    profile: Profile
    found: TexelFit
    counts: Array
    cost: Array
    freedom: Array
    normal: Components | None = None

    @classmethod
    def of(cls, texels: Texels, profile: Profile, found: TexelFit, counts: Array, normal: Any = None) -> "Trial":
        """Where some of the values that are seen count."""
        many, left_out = sums_of(counts, texels.seen - counts)
        freedom = len(texels.shown) * (many - len(found.k) + texels.glossy) - texels.of_lobe
        cost = found.cost * (1 + OUTLIER**2 * left_out / jnp.maximum(freedom, 1))
        return cls(profile, found, counts.T, jnp.where(freedom < 3, jnp.inf, cost), freedom, normal)


def of_lanes(tree: Any, lanes: Array) -> Any:
    """Of arrays whose last axis texels are, those of some indices."""
    return jax.tree.map(lambda one: one[..., lanes], tree)


def of_few(left: Array, best: Any, better: Callable[[Array, Any], Any]) -> Any:
    """Fit some texels anew, `FEW` at a time: what is rarely worth it costs little.

    Of what is known of all, texels last, ``better`` is given the indices of a few and what is known of these.
    """

    def step(state):
        left, best = state
        lanes = jnp.nonzero(left, size=min(at_a_time(FEW), left.size), fill_value=left.size - 1)[0]
        new = better(lanes, of_lanes(best, lanes))
        return left.at[lanes].set(False), jax.tree.map(lambda a, b: a.at[..., lanes].set(b), best, new)

    return jax.lax.while_loop(lambda state: jnp.any(state[0]), step, (left, best))[1]


def grid(finer: int) -> list[float]:
    """The exponents that the search starts with, some octaves of each start: broad lobes, then narrow ones."""
    starts = [2.0 ** (part / BROAD) for part in range(BROAD)]
    starts += [2.0 ** (i + part / finer) for i in range(TOGETHER, OCTAVES, TOGETHER) for part in range(finer)]
    return [start * 2.0**octave for start in starts for octave in range(TOGETHER)]


def peaks(gains: Array, exponents: list[float]) -> tuple[Array, Array]:
    """The two highest peaks of gains, (2, T), and their brackets, (2, 3, T).

    A bracket is log n, that of the exponent below and of the one above: what is downhill is between.
    """
    order, number = np.argsort(exponents), np.arange(len(exponents))[:, None]
    log_n = np.log([*np.sort(exponents), 2.0**OCTAVES])
    ends = jnp.asarray(log_n[np.maximum(np.add(number.T, [[0], [-1], [1]]), 0)], gains.dtype)
    gains, least = gains[order], jnp.full_like(gains[:1], -jnp.inf)
    is_peak = (gains > jnp.concatenate([least, gains[:-1]])) & (gains >= jnp.concatenate([gains[1:], least]))
    heights, found = jnp.where(is_peak, gains, -jnp.inf), []
    for _ in range(2):
        highest = jnp.max(heights, axis=0)
        index = jnp.max(jnp.where(heights == highest, number, 0), axis=0)
        heights = jnp.where(number == index, -jnp.inf, heights)
        found.append((highest, ends[:, index]))
    highest, brackets = map(jnp.stack, zip(*found, strict=True))
    return highest, brackets


def rivals(heights: Array, cost: Array) -> Array:
    """Whether the second peak may lead to less than the cost that the first has led to; gains are half of a fall."""
    return heights[0] - heights[1] < 0.5 * RIVAL * cost


def per_deviation(worse: Array, variance: Array) -> Array:
    """What part of the distance to a fit of so much more cost is a standard error.

    0 where the values do not allow for it. Of what a 95 % interval just holds it is 1 / 1.96.
    """
    deviations = jnp.sqrt(jnp.maximum(worse / variance, NORMAL_95**2))
    return jnp.maximum((ALLOWED - deviations) / (ALLOWED - NORMAL_95), 0) / NORMAL_95


def narrowed(bracket: Array, slope: Array, step: Array) -> Array:
    """A bracket, log n and between which it lies, (3, T), after a step; one that leads out of it goes to its middle.

    The slope is half the negative derivative of the cost.
    """
    log_n, low, high = bracket
    low, high = jnp.where(slope > 0, log_n, low), jnp.where(slope < 0, log_n, high)
    # At the minimum rounding turns the slope's sign: what leaves the bracket by no more is no reason to halve it.
    new, slack = log_n + step, 1e-3
    new = jnp.where((new < low - slack) | (new > high + slack), 0.5 * (low + high), new)
    return jnp.stack([jnp.clip(new, 0, MOST_LOG_N), low, high])


def shadowed(shown: Array, diffuse: Array) -> Array:
    """Where values are less than half of what Lambert's law, fitted to all, tells, (T, P); 0 is what does not count."""
    level = divide(*sums_of(shown * diffuse, diffuse * diffuse))
    return shown < 0.5 * level[:, None] * diffuse


def inliers(residual: Components, seen: Array, counts: Array) -> Array:
    """1 where a residual is no outlier: within `OUTLIER` standard deviations of those that are none, (T, P).

    0 where it is not seen; none is expected where it counts.
    """
    square = over_channels(residual) ** 2

    def clip(_: Any, counts: Array) -> Array:
        size = divide(*sums_of(counts * square, counts))
        return jnp.where(square <= OUTLIER**2 * size[:, None], seen, 0)

    return jax.lax.fori_loop(0, 4, clip, counts)


# -- normals sought ----------------------------------------------------------------------------------------------------


def with_normals(texels: Texels, lights: Distant) -> tuple[TexelFit, Profile, Components, Array, Array]:
    """The best material and normal of each texel, under distant lights.

    A highlight alone, as of metals, gives a normal, and Lambert's law, fitted to what is neither highlight nor shadow,
    two others. The search over n gives each a material, and from the best one Gauss-Newton takes it and the normal
    together, `TURNS` times: each time without what the last one does not explain, or shows less than half as bright.
    One loop does all of it, for a second copy of the program would take as long to compile.

    Gives the fit, whose last two errors are those of the normal, and where its search started; the normals, (T,); what
    is lit and what of it is no outlier, (T, P), before the last steps: neither counts in the fit otherwise.
    """
    seen, shown = texels.seen, over_channels(texels.unweighted(texels.values))
    if lights.ambient is not None:
        ambient = over_channels(lights.ambient)
        least = jnp.min(jnp.where(seen * ambient > 0, divide(shown, ambient), jnp.inf), axis=1, keepdims=True)
        shown = seen * (shown - jnp.where(least < jnp.inf, least, 0) * ambient)
    roots = square_root(jnp.maximum(shown, 0))
    # A mean that what is dark does not change, and highlights little; theirs alone it would be where they are all.
    level = jnp.minimum(divide(*sums_of(shown, roots)) ** 2, 2 * divide(*sums_of(roots, seen)) ** 2)
    bright, brighter = (seen * (shown > share * level[:, None]) for share in DARK)
    bright = jnp.where(sums_of(bright)[0][:, None] < FEWEST_BRIGHT, seen, bright)

    def lit(normal):
        return seen if lights.ambient is not None else jnp.where(beside(normal) @ lights.to_light > 0, seen, 0)

    def unshadowed(_, start):
        counts = seen * ~shadowed(shown, seen * jnp.maximum(beside(start[0]) @ lights.to_light, 0))
        return lambert_normals(shown, counts, lights.to_light), counts

    starts = [(lambert_normals(shown, some, lights.to_light), some) for some in (bright, brighter)]
    starts[1] = jax.lax.fori_loop(0, 2, unshadowed, starts[1])
    if texels.glossy:
        starts.insert(0, (highlight_normals(texels.model, shown, bright, lights), bright))
    count, (first, *_) = len(starts), starts
    starts = jax.tree.map(lambda *some: jnp.stack(some), *starts)

    @functools.partial(jax.jit, inline=True)  # its shapes are asked for below: it is traced once
    def tried(i, normal, counts):
        before = lit(normal)
        used = before * counts
        some = texels.where(used)
        there = some.facing(normal, lights)
        profile, found = there.searched()
        start = found.log_n, normal, found.cost
        log_n, normal, least = jax.lax.cond(
            i < count, lambda *same: same, lambda log_n, normal, _: jointly(some, lights, log_n, normal), *start
        )
        there, facing = texels.facing(normal, lights), lit(normal)
        fit = there.where(facing * counts).minimum(log_n)
        residual = there.residual(fit)
        direct = over_channels(there.values - residual)
        if lights.ambient is not None:
            direct -= over_channels(there.linear[0] * beside(fit.k[0]))
        half = facing * (over_channels(residual) >= -0.5 * direct)
        # What is dark where no light falls is explained, too.
        counts = jnp.where(facing > 0, inliers(residual, facing, half), seen - bright)
        cost = jnp.sum(*sums(counts * residual * residual), axis=0)
        trial = Trial.of(texels, profile, fit._replace(cost=cost), counts, normal)
        return trial, before.T, used.T, least

    def step(i, found):
        begins, best = i < count, found[0]
        last = best.normal, best.counts.T
        trial, *values = tried(i, *jax.tree.map(lambda some, last: jnp.where(begins, some[i], last), starts, last))
        # The normal of a highlight alone is not good enough to tell what is none of it.
        trial = trial._replace(counts=jnp.where(i < count - 2, bright.T, trial.counts))
        kept = begins & (best.cost < trial.cost)
        return jax.tree.map(lambda a, b: jnp.where(kept, a, b), found, (trial, *values))

    nothing, *values = jax.tree.map(jnp.zeros_like, jax.eval_shape(tried, 0, *first))
    nothing = nothing._replace(cost=jnp.full_like(nothing.cost, jnp.inf)), *values
    best, before, used, cost = jax.lax.fori_loop(0, count + TURNS, step, nothing)
    some, log_n, normal = texels.where(used.T), best.found.log_n, best.normal
    if texels.glossy:
        log_n, normal, _ = restarted(some, lights, (log_n, normal, cost))
    fit = joint_fit(some.facing(normal, lights), lights, log_n, normal)
    return fit, best.profile, normal, before.T, used.T


def restarted(texels: Texels, lights: Distant, found: tuple[Array, Components, Array]) -> Any:
    """The minimum of material and normal together from other exponents, where a cost stands out of those of the tile.

    A start whose normal is some degrees off favours a broad lobe, and Gauss-Newton may stay there. What was found is
    log n, normal and cost.
    """
    cost = found[2]

    def better(lanes, old):
        some = texels.some(lanes)

        def of_exponent(i, best):
            other = jointly(some, lights, jnp.full_like(old[0], jnp.log(jnp.asarray(RESTARTS))[i]), old[1])
            return jax.tree.map(lambda a, b: jnp.where(other[2] < best[2], b, a), best, other)

        return jax.lax.fori_loop(0, len(RESTARTS), of_exponent, old)

    return of_few(cost > STANDS_OUT * jnp.nanmedian(jnp.where(cost > 0, cost, jnp.nan)), found, better)


def lambert_normals(shown: Array, seen: Array, to_light: Components) -> Components:
    """Normals by Lambert's law, fitted to what is neither highlight nor shadow.

    Least squares reweighted by Geman and McClure's function of the residual (1985). Its scale is that of the negative
    residuals: highlights are positive.
    """

    def step(_, vector):
        predicted = beside(vector) @ to_light
        residual, lit = shown - predicted, jnp.where(predicted > 0, seen, 0)
        below = jnp.where(residual < 0, lit, 0)
        scale = divide(*sums_of(below * residual**2, below))
        ratio = divide(residual**2, GEMAN_MCCLURE**2 * scale[:, None])
        return nearest_vectors(to_light, lit / (1 + ratio) ** 2, shown)

    return normalize(jax.lax.fori_loop(0, 8, step, nearest_vectors(to_light, seen, shown)))


def highlight_normals(model: Any, shown: Array, seen: Array, lights: Distant) -> Components:
    """Normals by the highlight's law alone, for the best of some n.

    It is (N·H)^n, or of Phong's models (L·R)^n where R is the view mirrored about N: the n-th root is linear in N or R.
    Weights make the errors of the roots those of the values.
    """
    mirrors = model.log_cosine is mirror_log_cosine
    axes = lights.to_light if mirrors else normalize(lights.to_light + lights.to_view)
    bright = jnp.maximum(divide(shown, jnp.max(shown, axis=1, keepdims=True)), 0)

    def of_exponent(n):
        vector = nearest_vectors(axes, bright ** (2 - 2 / n), bright ** (1 / n))
        lobe = jnp.maximum(beside(vector) @ axes, 0) ** n
        return *sums_of(seen * (bright - lobe) ** 2), vector

    cost, vectors = jax.lax.map(of_exponent, jnp.asarray(HIGHLIGHTS, shown.dtype))
    best = jnp.argmin(cost, axis=0)[None]
    found = normalize(jax.tree.map(lambda one: jnp.take_along_axis(one, best, axis=0)[0], vectors))
    return normalize(found + lights.to_view) if mirrors else found


def nearest_vectors(axes: Components, weight: Array, value: Array) -> Components:
    """The vectors, (T,), whose products with axes, (P,), are nearest to values, (T, P)."""
    found = sums_of(*(a * b for a in axes * weight for b in (*axes, value)))
    x, y, z = (Components(tuple(found[i : i + 3])) for i in (0, 4, 8))
    inverse = y.cross(z), z.cross(x), x.cross(y)
    vector = functools.reduce(operator.add, map(operator.mul, inverse, found[3::4]))
    return Components(tuple(divide(one, x @ inverse[0]) for one in vector))


def joint_fit(
    texels: Texels, lights: Distant, log_n: Array, normal: Components, *, errors: bool = True, n_known: bool = False
) -> TexelFit:
    """At an exponent, which may be sure, and a normal, which is not, as are none of the coefficients."""

    def columns(*angles):
        first, second = map(operator.mul, perpendicular(normal), angles)
        return texels.facing(normalize(normal + first + second), lights).columns(log_n)

    zero, one = jnp.zeros_like(log_n), jnp.ones_like(log_n)
    turns = [jax.jvp(columns, (zero, zero), way)[1] for way in ((one, zero), (zero, one))]
    k = texels.evaluated(log_n, []).k
    slopes = [functools.reduce(operator.add, map(operator.mul, turn, map(beside, k))) for turn in turns]
    return texels.evaluated(log_n, slopes if n_known else [*texels.by_log_n(log_n), *slopes], errors, n_known=n_known)


def jointly(
    texels: Texels, lights: Distant, log_n: Array, normal: Components, *, n_known: bool = False
) -> tuple[Array, Components, Array]:
    """Gauss-Newton of material and normal together, and the cost; a step that does not lower it is cut to a quarter."""
    of_n = texels.glossy and not n_known

    def step(_, state):
        log_n, normal, cost, change = state
        turn = sum(map(operator.mul, perpendicular(normal), change[-2:]), start=normal)
        new = jnp.clip(log_n + change[0], 0, MOST_LOG_N) if of_n else log_n, normalize(turn)
        point = joint_fit(texels.facing(new[1], lights), lights, *new, errors=False, n_known=n_known)
        most = [1.0] * of_n + [0.2, 0.2]
        taken = *new, point.cost, [jnp.clip(x, -limit, limit) for x, limit in zip(point.step, most, strict=True)]
        kept = log_n, normal, cost, [0.25 * x for x in change]
        return jax.tree.map(lambda a, b: jnp.where(point.cost < cost, a, b), taken, kept)

    state = log_n, normal, jnp.full_like(log_n, jnp.inf), [jnp.zeros_like(log_n)] * (2 + of_n)
    return jax.lax.fori_loop(0, 1 + JOINT_STEPS, step, state)[:3]


# -- least squares, one in each lane -----------------------------------------------------------------------------------

Rows = list[list[Any]]
"""The normal equations G x = b of each lane: the rows of the symmetric G, with b, (C, T), at their ends."""


def nonnegative(rows: Rows, high: Array, grey: bool, steps: int) -> list[Array]:
    """Minimise x G x - 2 b x over 0 <= x, and x <= high for the last one, which channels share where it is grey.

    That takes so many steps of Newton's method. What is left of its moment is made of straight pieces, one for each set
    of the others at 0: a few steps end.
    """
    high = high[..., None, :]
    if not grey:
        return bounded(rows, high)
    *others, (*across, square, moment) = rows
    whole = jnp.sum(
        jnp.broadcast_to(square, jnp.broadcast_shapes(square.shape, rows[0][-1].shape)), axis=-2, keepdims=True
    )

    def free(shared):
        return bounded([[*row, b - a * shared] for *row, a, b in others], jnp.inf)

    def left(shared):
        return jnp.sum(moment - square * shared - sum(map(operator.mul, across, free(shared))), axis=-2, keepdims=True)

    shared = jnp.zeros_like(whole)
    for _ in range(steps):
        value, slope = jax.jvp(left, (shared,), (jnp.ones_like(shared),))
        shared = jnp.clip(shared + divide(value, unless_rounding(-slope, whole)), 0, high)
    return [*free(shared), shared]


def bounded(rows: Rows, high: Any) -> list[Array]:
    """`nonnegative` channel by channel: where the optimum without a bound breaks it, the optimum lies on that bound."""
    (pivot, *_, moment), *rest = rows
    inverse = divide(1.0, pivot)
    if not rest:
        return [jnp.clip(moment * inverse, 0, high)]
    (_, *row, free), *left = swept(rows, 0, inverse)
    others = bounded([line[1:] for line in left], high)
    first = free - sum(map(operator.mul, row, others))
    at_bound = [jnp.zeros_like(first), *bounded([line[1:] for line in rest], high)]
    return [jnp.where(first < 0, a, b) for a, b in zip(at_bound, [first, *others], strict=True)]


class Solved(NamedTuple):
    """Of an unknown: what was left of b for it, the inverse of its pivot, its value and its standard error."""

    left: Array
    inverse: Array
    step: Array
    error: Array


def solve(rows: Rows, active: list[Any] | None, own: int) -> list[Solved]:
    """Solve by elimination: first each channel's ``own`` unknowns, then those that the channels have in common.

    What is not active may not move, and its error is that which it would have. None is for errors: what depends on
    others leaves these as unknown as rounding allows, and no step is to be taken.
    """
    rows = [list(map(functools.partial(jnp.broadcast_to, shape=rows[0][-1].shape), row)) for row in rows]
    eliminated, squares = [], [row[i] for i, row in enumerate(rows)]

    def without(rows: Rows, k: int, square: Array) -> Rows:
        """The rows less an unknown, the next of all; the square of its column."""
        pivot, index = rows[k][k], len(eliminated)
        eliminated.append((rows[k][-1], divide(1.0, pivot)))
        if active is None:
            return swept(rows, k, divide(1.0, jnp.maximum(pivot, rounding_of(square))))
        return swept(rows, k, jnp.where(active[index], eliminated[index][1], 0))

    for k in range(own):
        rows = without(rows, k, squares[k])
    common = [[jnp.sum(x, axis=0, keepdims=True) for x in row[own:]] for row in rows[own:]]
    for k in range(len(common)):
        common = without(common, k, jnp.sum(squares[own + k], axis=0, keepdims=True))
    steps, variances = [row[-1] for row in common], [row[i] for i, row in enumerate(common)]
    for i, row in reversed(list(enumerate(rows[:own]))):
        across = row[own:-1]
        beside = [sum(map(operator.mul, line, across)) for line in common]
        steps.insert(0, row[-1] - sum(x * line[-1] for x, line in zip(across, common, strict=True)))
        variances.insert(0, row[i] + sum(map(operator.mul, across, beside)))
    moves = active or [True] * len(rows)
    return [
        Solved(left, inverse, step, jnp.where(inverse > 0, square_root(jnp.where(move, variance, inverse)), jnp.inf))
        for (left, inverse), step, variance, move in zip(eliminated, steps, variances, moves, strict=True)
    ]


def swept(rows: Rows, k: int, inverse: Array) -> Rows:
    """What is left when an unknown is eliminated, and in its row and column the inverse.

    With 0 for the inverse of its pivot it stays where it is.

    Source: Goodnight, "A tutorial on the SWEEP operator", The American Statistician 33 (1979).
    """
    row = [x * inverse for x in rows[k]]
    found = [[x - line[k] * r for x, r in zip(line, row, strict=True)] for line in rows]
    for i, line in enumerate(rows):
        found[i][i] = unless_rounding(found[i][i], line[i])
        found[i][k] = -line[k] * inverse
    found[k] = [*row[:k], inverse, *row[k + 1 :]]
    return found


def unless_rounding(left: Array, square: Array) -> Array:
    """What elimination leaves of a column's square; 0 where that is rounding."""
    return jnp.where(left > rounding_of(square), left, 0)


def rounding_of(square: Array) -> Array:
    """What elimination may leave of a square though nothing is left."""
    return DEPENDENT * jnp.finfo(square.dtype).eps * square
