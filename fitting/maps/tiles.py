"""From the values of a band of rows to the layers of its maps, a tile of texels at a time."""

import dataclasses
import functools
import operator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Int

import brdf
from brdf.images.encoding import Encoding
from brdf.lights.base import Lighting, LightStack, stacked
from brdf.lobes import OneOf, light_terms
from brdf.models.base import SpecularMaterial
from brdf.precision import Precision, apart, at_a_time, working_precision
from brdf.vectors import Components, divide, normalize, square_root
from fitting.likelihood import encoded_and_slope
from fitting.maps.map_inputs import Photographs, places
from fitting.maps.map_light_choice import MOST_ERROR
from fitting.maps.map_result import REASONS
from fitting.maps.texels import (
    MOST_LOG_N,
    OUTLIER,
    Distant,
    Profile,
    TexelFit,
    Texels,
    Trial,
    joint_fit,
    jointly,
    sums,
    sums_of,
    with_normals,
)
from fitting.solver.devices import placed
from fitting.solver.normal_equations import COMPILER_OPTIONS
from fitting.uncertainty.intervals import NORMAL_95, student_95

TILE = 432
"""Texels that go through the program in step: what they need stays in the processor's cache."""

CHUNK = 16
"""Tiles that a processor's program goes through: one serves maps of all sizes."""

LANES = 8
"""Photographs are as many as a multiple of this: what is left over a processor would take one by one."""

RING = 0.15
"""Lights whose heights z spread by less than this are a ring: n shows less well, and the grid is finer."""

ALIKE = 1e-3
"""Of light: values that differ less have the curve's own slope between them."""

WEIGHINGS = 2
"""Fits of values whose weights hang on brightness: by what is shown, then by what is explained, by the last model:
of weights it tells as well as another one would."""

LEAST_HIGHLIGHT = 2.0
"""k_s is determined where it exceeds so many of its standard errors."""


def tiles_of_program(tile: int) -> int:
    """How many tiles of so many texels a program goes through."""
    return max(1, CHUNK * TILE // tile)


class Surface(NamedTuple):
    """What texels see, (H, W, ...), or tiles of some, (N, TILE, ...).

    Attributes:
        normal: of any length, 0 or not finite where there is no surface; None where it is sought.
        mask: texels to look at.
        points: where lights are near.
        shared: log n and its standard error, which texels share.
    """

    normal: Any
    mask: Any
    points: brdf.SurfacePoints | None = None
    shared: Any = None


@dataclasses.dataclass(frozen=True)
class MapProblem:
    """What is fitted to what.

    Attributes:
        photographs: with their lights.
        surface: what all texels see.
        models: of which each texel has the simplest that serves it.
        prices: of each model, what its criterion is raised by; none for 0.
        grey: whether channels share k_s.
        ambient: columns of the ambient light, (P, C) or (P, 1); None where there is none.
        to_view: towards the camera, of any length.
        precision: float32 or float64.
        seek: "layers", or for an n that texels share the "gains" on the grid of n, or the "slope" by log n.
        refine: whether the normals are refined at an n that texels share.
        growth: the variance of values is the first and so many times what they show; none where it is even in codes.
    """

    photographs: Photographs
    surface: Surface
    models: tuple[Any, ...]
    grey: bool
    ambient: np.ndarray | None
    to_view: np.ndarray
    precision: Precision
    prices: tuple[float, ...] = ()
    seek: str = "layers"
    refine: bool = False
    growth: tuple[float, ...] = ()

    @property
    def finer(self) -> int:
        """Steps of the grid in each doubling of n: see `Texels`."""
        to_light = self.photographs.to_light
        return 2 if to_light is not None and np.ptp(to_light[:, 2]) < RING else 1

    @property
    def texels(self) -> Int[np.ndarray, " K"]:
        """Indices of those that see something, row by row."""
        seen, normal = np.asarray(self.surface.mask), self.surface.normal
        if normal is not None:
            square = np.einsum("ijk,ijk->ij", normal, normal, dtype=float)
            seen = seen & (square > 0) & (square < np.inf)
        return np.flatnonzero(seen)

    def tiles(self, texels: Int[np.ndarray, " K"]) -> tuple[np.ndarray, Surface]:
        """What some texels show, (P, N, TILE, C), and see, (N, TILE, ...); one lane at least is left over."""
        tile = at_a_time(TILE)
        most = tile * tiles_of_program(tile)
        size = -(-(texels.size + 1) // most) * most

        def cut(leaf: Any) -> np.ndarray:
            leaf = np.asarray(leaf)
            part = leaf.reshape(-1, *leaf.shape[2:])[places(texels)]
            found = np.zeros((size, *part.shape[1:]), self.precision if part.dtype.kind == "f" else part.dtype)
            found[: len(part)] = part
            return found.reshape(-1, tile, *part.shape[1:])

        values = self.photographs.tiles(texels, (size // tile, tile), LANES, self.precision)
        return values, jax.tree.map(cut, self.surface)

    def near_lights(self) -> tuple[Any, Any]:
        """Stacks of the lights of scenes, and what casts shadows there; none where lights are distant."""
        scenes = self.photographs.scenes
        if scenes is None:
            return (), ()
        return stacked([scene.lights[0] for scene in scenes], np.dtype(self.precision)), scenes[0].occluders

    def fit(self, values: np.ndarray, surface: Surface, band: int = 0) -> dict[str, np.ndarray]:
        """The layers of some tiles, (N * TILE, ...); what a lane without a texel has comes after those with one.

        Where there are several models the criterion of each is a layer, "criteria"; the band has its device.
        """
        given, dtype = self.photographs, np.dtype(self.precision)
        curves = tuple(one.curve for one in given.each)
        black = -len(curves) % LANES  # photographs that are added
        kind = self.models, self.grey, self.finer, self.seek, self.refine
        static = *kind, (*curves, *curves[-1:] * black), bool(self.growth)
        with working_precision(self.precision):
            to_light = np.zeros((len(curves), 3)) if given.to_light is None else given.to_light
            of_photographs = [np.array([one.top for one in given.each]), 1 / given.unit, _weights(given.unit), to_light]
            of_photographs += [] if self.ambient is None else [self.ambient]
            of_photographs = [
                np.append(one, np.zeros((black, *one.shape[1:])), axis=0).T.astype(dtype) for one in of_photographs
            ]
            view = self.to_view / np.linalg.norm(self.to_view)
            rounding = max(one.step for one in given.each) / np.sqrt(12 * np.mean(given.unit**2))
            prices = np.array(self.prices or [0.0] * len(self.models), dtype)
            growth = np.array(self.growth or [1, 0], dtype)
            more = dtype.type(rounding), prices, growth, view.astype(dtype), *self.near_lights()
            # All tiles that hold a texel, and the first lane that holds none.
            _, count, tile, _ = values.shape
            used, found, size = np.arange(count) <= np.count_nonzero(surface.mask) // tile, [], tiles_of_program(tile)
            for first in range(0, count, size):
                some = slice(first, first + size)
                part = placed(band, (used[some], values[:, some], jax.tree.map(operator.itemgetter(some), surface)))
                found.append(_program(*static, *part, of_photographs, *more))
            return {name: np.concatenate([np.asarray(layers[name]) for layers in found]) for name in found[0]}


# Tiles are small: dealing parts of one out to threads would take ten times as long as the work.
@functools.partial(
    jax.jit,
    static_argnums=range(7),
    compiler_options=COMPILER_OPTIONS | {"xla_disable_hlo_passes": "cpu-parallel-task-assigner"},
)
def _program(
    models: tuple[Any, ...],
    grey: bool,
    finer: int,
    seek: str,
    refine: bool,
    curves: tuple[Encoding, ...],
    grows: bool,
    used: Array,
    values: Array,
    surface: Surface,
    of_photographs: list[Array],
    rounding: Array,
    prices: Array,
    growth: Array,
    to_view: Array,
    stacks: tuple[LightStack, ...],
    occluders: tuple[Any, ...],
) -> dict[str, Array]:
    """The layers of some tiles, one by one; 0 of those that are not used."""
    top, scale, weight, to_light, *ambient = of_photographs
    scale, weight = scale[:, None], weight[:, None]
    ambient = Components(tuple(ambient[0])) if ambient else None
    lights = Distant(Components(tuple(to_light)), Components(tuple(to_view)), ambient)
    is_even = not grows and set(curves) == {"linear"}

    @functools.partial(jax.jit, inline=True)  # its shapes are asked for below: it is traced once
    def of_tile(tile):
        number, (normal, mask, points, shared) = tile
        if normal is not None:
            mask &= jnp.all(jnp.isfinite(normal) & jnp.any(normal != 0, axis=1, keepdims=True), axis=1)
            upright = jnp.array([0, 0, 1], normal.dtype)
            normal = normalize(Components.of(jnp.where(mask[:, None], normal, upright)))

        def decoded(values, number):
            shown = jnp.transpose(values[:, number], (2, 1, 0))
            counts = jnp.all(jnp.isfinite(shown) & (shown < top), axis=0) & mask[:, None]
            # what no light reaches is 0 whatever the texel is, in codes without noise even
            if normal is not None and points is None and ambient is None:
                counts &= lights.terms(brdf.Lambert, normal)[0] > 0
            shown = jnp.where(counts, shown, 0)
            return shown * scale, Components(tuple(counts * rooted(shown, shown)))

        def rooted(shown, explained):
            """Roots of the weights of what is shown, and explained as so bright."""
            if grows:
                return weight * jax.lax.rsqrt(growth[0] + growth[1] * jnp.maximum(explained, 0))
            return weight if is_even else weight * _slopes(curves, shown, explained)

        light, root = apart(decoded, values, number)
        if is_even:
            return fitted(light, root, normal, mask, points, shared)[0]

        @functools.partial(jax.jit, inline=True)
        def again(_, state):
            """The layers, and weights by what is explained: by the values those would count that noise made darker."""
            root = state[1]
            layers, explained = fitted(light, root, normal, mask, points, shared)
            explained = jnp.stack([divide(*both) for both in zip(explained, root, strict=True)]) / scale
            # Photographs that were added have no scale.
            return layers, Components(tuple(jnp.where(root.parts[0] > 0, rooted(light / scale, explained), 0)))

        nothing = jax.tree.map(jnp.zeros_like, jax.eval_shape(again, 0, (None, root))[0])
        return jax.lax.fori_loop(0, WEIGHINGS, again, (nothing, root))[0]

    def fitted(light, root, normal, mask, points, shared):
        """The layers of a tile, and what the last model explains of its values, times the roots of their weights."""
        shown, found, explained = light * jnp.stack(root.parts), [], root
        for index, model in enumerate(models):
            texels = Texels(model, grey and issubclass(model, SpecularMaterial), finer, shown, root)
            if normal is None:
                fit, profile, normals, lit, counts = with_normals(texels, lights)
                texels = texels.facing(normals, lights)
                layers = _layers(texels, fit, lit, counts, mask, normals, rounding, profile, lights=lights)
            else:
                if points is None:
                    texels = texels.facing(normal, lights)
                else:
                    texels = near(texels, stacks, occluders, ambient, points)
                best = texels.unshadowed()
                fit = best.found
                layers = _of_normals(texels, best, mask, normal, rounding, shared, seek, lights if refine else None)
            explained = texels.values - texels.residual(fit)
            layers["criterion"] = layers.get("criterion", 0.0) + prices[index]  # of sums there is none
            found.append(layers | {"chosen": jnp.full(mask.shape, index, jnp.uint8)})
        criteria = jnp.stack([one["criterion"] for one in found])
        layers = functools.reduce(
            lambda a, b: {name: jnp.where(b["criterion"] < a["criterion"], b[name], a[name]) for name in a}, found
        )
        layers |= {"criteria": criteria} if len(models) > 1 else {}
        return {name: layer.T for name, layer in layers.items() if name != "criterion"}, explained

    def of_used(tile):
        empty = jax.tree.map(lambda layer: jnp.zeros(layer.shape, layer.dtype), jax.eval_shape(of_tile, tile[1:]))
        return jax.lax.cond(tile[0], of_tile, lambda _: empty, tile[1:])

    tiles = jax.lax.map(of_used, (used, jnp.arange(len(used)), surface))
    return {name: layer.reshape(-1, *layer.shape[2:]) for name, layer in tiles.items()}


def _weights(unit: np.ndarray) -> np.ndarray:
    """What the roots of weights are by the unit, (P, C) or (P, 1): noise is even before photographs are divided."""
    weight = unit / np.sqrt(np.mean(unit**2, axis=0))
    return weight[:, :1] if np.allclose(weight, weight[:, :1], rtol=1e-6) else weight


def _slopes(curves: tuple[Encoding, ...], shown: Array, explained: Array) -> Array:
    """How much codes change with light: what the roots of weights are, for noise is even in codes.

    Squares have the derivatives of those of codes where their weight is the slope at what is explained, times that
    between it and what is shown.
    """
    kinds = sorted(set(curves), key=str)
    which = [np.resize([curve == kind for curve in curves], shown.shape[-1]) for kind in kinds]
    found = []
    for kind in kinds:
        (code, _), (other, slope) = (encoded_and_slope(light, kind, 255.0) for light in (shown, explained))
        differ = jnp.abs(shown - explained) > ALIKE * (jnp.abs(shown) + jnp.abs(explained))
        between = jnp.where(differ, (code - other) / jnp.where(differ, shown - explained, 1), slope)
        found.append(jnp.sqrt(slope * between))
    return jnp.select(which, found)


def near(texels: Texels, stacks: Any, occluders: Any, ambient: Components | None, points: Any) -> Texels:
    """With the columns of lights of any kind at the points of a tile, (T,)."""

    def columns(points):
        terms, size = [], (texels.shown.shape[-1], max(stack.light.shape[1] for stack in stacks))
        for stack in stacks:

            def of_samples(one, kind=stack.kind):
                emitted, *samples = one
                model = OneOf((texels.model,))
                found = light_terms(model, Lighting((), occluders), points.in_components(), kind, tuple(samples))
                diffuse, weight = (part[..., None] * emitted[:, None] for part in (found.diffuse, found.weight))
                return found._replace(diffuse=diffuse, weight=weight)

            def of_photographs(leaf, light=stack.light):
                """0 of those with another kind of light, and of samples beyond this light's own."""
                none = jnp.zeros((*size, *leaf.shape[2:]), leaf.dtype)
                return none.at[light[:, 0], : light.shape[1]].set(leaf)

            found = jax.lax.map(of_samples, (stack.emitted, stack.numbers, stack.nodes, stack.light))
            terms.append(jax.tree.map(of_photographs, found))
        every = jax.tree.map(lambda *leaves: jnp.moveaxis(sum(leaves), 0, -1), *terms)
        diffuse = jnp.moveaxis(jnp.sum(every.diffuse, axis=0), 1, 0)
        return diffuse, jnp.moveaxis(every.weight, 2, 0), every.log_cosine

    diffuse, weight, log_cosine = apart(columns, points)
    if ambient is None:
        texels = texels.where((diffuse[0] > 0).astype(diffuse.dtype))
    linear = [texels.root * Components(tuple(diffuse))]
    linear = linear if ambient is None else [texels.root * ambient, *linear]
    return dataclasses.replace(
        texels, linear=linear, weight=texels.root * Components(tuple(weight)), log_cosine=log_cosine
    )


def _of_normals(
    texels: Texels,
    best: Trial,
    mask: Array,
    normal: Components,
    rounding: Array,
    shared: Any,
    seek: str,
    lights: Distant | None,
) -> dict[str, Array]:
    """What is sought where normals are given, or are refined under lights."""
    counts = best.counts.T
    # With a k_s held by a cap, or lobes that underflow, texels without a highlight would tell the n that all share.
    texels = dataclasses.replace(texels, relative=seek != "layers")
    some = texels.where(counts)
    if seek == "gains":
        return {"sums": jnp.where(mask, some.profile().gains, 0)}
    if lights is not None:
        normal = jointly(some, lights, shared[:, 0], normal, n_known=True)[1]
        texels = texels.facing(normal, lights)
        some = texels.where(counts)
    fit = some.at if lights is None else functools.partial(joint_fit, some, lights, normal=normal)
    if seek == "slope":
        point = fit(log_n=shared[:, 0], errors=False)
        freedom = best.freedom - len(point.error[1:])  # of angles
        square = jnp.sum(*sums(some.values * some.values), axis=0)
        left = [point.slope[0], divide(1.0, point.error[0] ** 2), point.cost, jnp.maximum(freedom, 0), square]
        return {"sums": jnp.where(mask, jnp.stack(left), 0)}
    if shared is None:
        return _layers(texels, some.at(best.found.log_n), texels.seen, counts, mask, normal, rounding, best.profile)
    log_n, error = shared.T
    known = jnp.where(error < jnp.inf, error, 0)
    found, change = jax.jvp(lambda x: fit(log_n=x, n_known=True), (log_n,), (known,))
    lit = texels.seen
    return _layers(texels, found, lit, counts, mask, normal, rounding, None, (error, change.k), lights=lights)


def _without_lobe(
    texels: Texels, fit: TexelFit, normal: Components, lights: Distant | None
) -> tuple[TexelFit, Components, Array]:
    """The fit of a matt surface, under lights with a normal of its own; that; and by how much more it costs."""
    matt = dataclasses.replace(texels, model=brdf.Lambert, grey=False)
    if lights is None:
        return matt.at(fit.log_n, errors=False), normal, fit.gain
    own, cost = jointly(matt, lights, fit.log_n, normal)[1:]
    return joint_fit(matt.facing(own, lights), lights, fit.log_n, own), own, cost - fit.cost


def _layers(
    texels: Texels,
    fit: TexelFit,
    lit: Array,
    counts: Array,
    mask: Array,
    normal: Components,
    rounding: Array,
    profile: Profile | None,
    shared: tuple[Array, list[Array]] | None = None,
    *,
    lights: Distant | None = None,
) -> dict[str, Array]:
    """The layers of a model's maps, texels last; ``lights`` where normals are sought.

    Errors are such that 1.96 of them reach as far as Student's distribution has it.

    Models are compared by the information criterion of Schwarz as McQuarrie corrects it for few values ("A small-sample
    correction for the Schwarz SIC model selection criterion", Statistics & Probability Letters 44, 1999). What a model
    left out as outliers, each its own, counts with the least residual of such, and what it leaves unlit as noise. A
    highlight is seen where the criterion wants it: of so many exponents one serves noise better than its errors expect.
    """
    some = texels.where(counts)
    channels, glossy, tiny = len(texels.shown), texels.glossy, jnp.finfo(texels.shown.dtype).tiny
    values, unlit, outliers = (channels * one for one in sums_of(counts, texels.seen - lit, lit - counts))
    *linear, k_s = fit.k if glossy else [*fit.k, jnp.zeros_like(fit.k[0])]
    angles = fit.error[glossy and shared is None :]
    of_lobe = texels.of_lobe + glossy * (shared is None)
    unknowns = len(linear) * channels + of_lobe + len(angles)

    def price(unknowns: int) -> Array:
        return unknowns * jnp.log(jnp.maximum(values, 1)) * values / jnp.maximum(values - unknowns - 2, 1)

    freedom = values - unknowns
    # Codes that are explained exactly, as where all are 0, were rounded all the same.
    deviation = jnp.where(freedom < 1, jnp.nan, jnp.sqrt(fit.cost / jnp.maximum(freedom, 1)))
    noise = jnp.maximum(deviation, rounding)
    reach = jnp.maximum(deviation * student_95(jnp.maximum(freedom, 1)) / NORMAL_95, rounding)
    n = jnp.exp(fit.log_n)
    square = jnp.sum(*sums(some.values * some.values), axis=0)
    k_error, error = [reach * own for own in fit.k_error], jnp.full_like(n, jnp.inf)
    if shared is not None:
        error, change = shared
        k_error = list(map(jnp.hypot, k_error, change))
    elif glossy and profile is not None:
        error = reach * fit.error[0]
        allowed = profile.errors(fit, square, jnp.maximum(reach**2, tiny), some.finer)
        *k_error, error = map(jnp.maximum, [*k_error, error], allowed)
    capped = jnp.any(k_s >= some.cap, axis=0)
    shows, moved = jnp.zeros(mask.shape, bool), [jnp.zeros_like(k) for k in linear]
    if glossy:
        # Where none is seen noise has put one between the lights, where it could be anything: k_d is that without it.
        plain, own, gain = _without_lobe(some, fit, normal, lights)
        gain = values * jnp.log1p(jnp.maximum(gain, 0) / jnp.maximum(fit.cost, tiny))
        shows = gain > price(unknowns) - price(unknowns - of_lobe)
        moved = [jnp.where(shows, 0, two - one) for one, two in zip(linear, plain.k, strict=True)]
        linear = list(map(operator.add, linear, moved))
        normal = Components(tuple(jnp.where(shows, *both) for both in zip(normal.parts, own.parts, strict=True)))
        if lights is not None:
            of_own = [reach * one for one in plain.k_error]
            k_error[:-1] = [jnp.where(shows, *both) for both in zip(k_error[:-1], of_own, strict=True)]
            angles = [jnp.where(shows, *both) for both in zip(angles, plain.error, strict=True)]
    loose = ~(error <= MOST_ERROR) | ~jnp.any(k_s > LEAST_HIGHLIGHT * k_error[-1], axis=0)
    tilt = square_root(sum((angle**2 for angle in angles), start=jnp.zeros_like(n)))
    loose |= ~(tilt < jnp.inf)
    # At an end of what is sought it may be beyond.
    loose |= (fit.log_n <= 0) | (fit.log_n >= MOST_LOG_N)
    # the first that holds
    reason = jnp.zeros(mask.shape, jnp.uint8)
    for number, test in zip(
        range(len(REASONS) - 1, 0, -1),
        (loose, capped, ~shows | (not glossy), freedom < 1, ~mask),
        strict=True,
    ):
        reason = jnp.where(test, jnp.uint8(number), reason)
    known, inside = reason == 0, reason != REASONS.index("outside")
    names = ("k_a", "k_d")[-len(linear) :]
    there = inside & (values > 0) & (shows | (tilt < jnp.inf))
    layers = {name: jnp.where(there, k, jnp.nan) for name, k in zip(names, linear, strict=True)}
    # Errors allow for what was dropped.
    errors = map(jnp.hypot, k_error, moved)
    layers |= {f"{name}_error": one for name, one in zip(names, errors, strict=True)}
    every = values + unlit + outliers
    whole = jnp.maximum(fit.cost + (unlit + OUTLIER**2 * outliers) * noise**2, tiny)
    return layers | {
        "n": jnp.where(known, n, jnp.nan),
        "k_s": jnp.where(known, k_s, jnp.nan),
        "n_error": jnp.where(known, n * error, jnp.nan),
        "k_s_error": jnp.where(known, k_error[-1], jnp.nan),
        "fitted_n": n,
        "fitted_k_s": jnp.where(inside & shows, k_s, 0),
        "normal": jnp.where(inside, jnp.stack(normal.parts), 0),
        "normal_error": jnp.degrees(jnp.where(inside, reach * tilt, jnp.nan)) if angles else jnp.zeros_like(n),
        "noise": jnp.where(inside, noise, jnp.nan),
        "left_out": outliers / jnp.maximum(every, 1),
        "determined": known,
        "reason": reason,
        "residual": jnp.where(inside, jnp.sqrt(fit.cost / jnp.where(square > 0, square, 1)), jnp.nan),
        "criterion": jnp.where(freedom < 3, jnp.inf, every * jnp.log(whole) + price(unknowns)),
    }
