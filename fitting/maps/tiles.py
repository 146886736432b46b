"""From the codes of a band of rows to the layers of its maps, a tile of texels at a time."""

import dataclasses
import functools
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

import brdf
from brdf.images.encoding import Encoding
from brdf.lights.base import Lighting, LightStack, stacked
from brdf.lobes import OneOf, light_terms
from brdf.models.base import SpecularMaterial
from brdf.precision import Precision, working_precision
from brdf.vectors import Components, normalize
from fitting.likelihood import encoded_and_slope
from fitting.maps.map_inputs import Photographs
from fitting.maps.map_light_choice import MOST_ERROR
from fitting.maps.map_result import REASONS, Maps
from fitting.maps.texels import (
    OUTLIER,
    Columns,
    Distant,
    Target,
    TexelFit,
    counted,
    fit_at,
    fit_unshadowed,
    fit_with_normals,
    octave_gains,
    over_channels,
    slope_and_curvature,
)

TILE = 528
"""Texels that go through the program in step: what they need stays in the processor's cache. No power of two: rows so
far apart would all fall on the same few places of the cache, and sums over them take up to five times longer. Nor much
more: XLA splits large kernels among threads, which for so little work takes ten times longer."""

RING = 0.15
"""Lights whose heights z spread by less than this are a ring: n shows less well, and the grid is finer."""

LEAST_HIGHLIGHT = 2.0
"""k_s is seen where it exceeds so many of its standard errors."""


@dataclasses.dataclass(frozen=True)
class How:
    """What is fitted: models, grey k_s, the ambient light's columns (P, C), the view, the precision.

    Attributes:
        seek: "layers", or for an n that texels share the "gains" at octaves of n, or the "slope" by log n.
    """

    models: tuple[Any, ...]
    grey: bool
    ambient: np.ndarray | None
    to_view: np.ndarray
    precision: Precision
    seek: str = "layers"

    def maps(self, layers: dict[str, np.ndarray], notes: tuple[str, ...] = ()) -> Maps:
        """The maps of layers, (H, W, ...)."""
        return Maps(models=tuple(one.name for one in self.models), to_view=self.to_view, notes=notes, **layers)


class Surface(NamedTuple):
    """What texels see, (H, W, ...) or some of them one after the other.

    Attributes:
        normal: of any length, 0 or not finite where there is no surface; None where it is sought.
        mask: texels to look at.
        points: where lights are near.
        shared: log n and its standard error, which texels share.
    """

    normal: Any
    mask: Any
    points: brdf.SurfacePoints | None
    shared: Any = None

    def some(self, rows: Any, texels: int, dtype: Any) -> "Surface":
        """Rows of it, padded to so many texels."""

        def cut(leaf: Any) -> np.ndarray:
            part = np.asarray(leaf[rows])
            part = part.reshape(-1, *part.shape[2:])
            found = np.zeros((texels, *part.shape[1:]), dtype if part.dtype.kind == "f" else part.dtype)
            found[: len(part)] = part
            return found

        return jax.tree.map(cut, self)


def steps_of_grid(given: Photographs) -> int:
    """In each doubling of n: see `fit_texels`."""
    return 2 if given.to_light is not None and np.ptp(given.to_light[:, 2]) < RING else 1


def fit_band(given: Photographs, how: How, codes: np.ndarray, surface: Surface) -> dict[str, np.ndarray]:
    """The layers of some texels, one after the other."""
    with working_precision(how.precision):
        dtype = np.dtype(how.precision)
        stacks, occluders = (), ()
        if given.scenes is not None:
            stacks = stacked([scene.lights[0] for scene in given.scenes], dtype)
            occluders = given.scenes[0].occluders
        to_light = np.zeros((given.shape[0], 3)) if given.to_light is None else given.to_light
        ambient = None if how.ambient is None else how.ambient[..., None].astype(dtype)
        distant = Distant(to_light.astype(dtype), (how.to_view / np.linalg.norm(how.to_view)).astype(dtype), ambient)
        photographs = codes, given.top.astype(dtype), given.scale.astype(dtype)
        static = how.models, how.grey, steps_of_grid(given), how.seek, given.curves
        layers = _program(*static, photographs, surface, distant, stacks, occluders)
        return {name: np.asarray(layer) for name, layer in layers.items()}


@eqx.filter_jit
def _program(
    models: tuple[Any, ...],
    grey: bool,
    finer: int,
    seek: str,
    curves: tuple[Encoding, ...],
    photographs: tuple[Any, Any, Any],
    surface: Surface,
    distant: Distant,
    stacks: tuple[LightStack, ...],
    occluders: tuple[Any, ...],
) -> dict[str, Array]:
    """The layers of a band, tile by tile."""
    codes, top, scale = photographs

    def of_tile(tile: Any) -> dict[str, Array]:
        start, (normal, mask, points, shared) = tile
        if normal is not None:
            mask &= functools.reduce(jnp.logical_and, map(jnp.isfinite, normal))
            mask &= functools.reduce(jnp.logical_or, (x != 0 for x in normal))
            axis = [jnp.where(mask, x, upright) for x, upright in zip(normal, (0.0, 0.0, 1.0), strict=True)]
            normal = jnp.stack([*normalize(Components(tuple(axis)))])

        def decoded(tile: Array) -> tuple[Target, Array]:
            shown = [tile[:, :, c].astype(scale.dtype) for c in range(tile.shape[2])]
            counts = functools.reduce(jnp.logical_and, (jnp.isfinite(x) & (x < top[:, None]) for x in shown)) & mask
            # what no light reaches is 0 whatever the texel is, in codes without noise even
            if normal is not None and points is None and distant.ambient is None:
                counts &= sum(distant.to_light[:, i, None] * normal[i] for i in range(3)) > 0
            root, weights = counts[:, None].astype(scale.dtype), 1.0
            if set(curves) != {"linear"}:
                weights = jnp.stack([_slopes(curves, jnp.where(counts, x, 0)) for x in shown], axis=1)
            shown = [jnp.where(counts, x * scale[:, c, None], 0) for c, x in enumerate(shown)]
            return Target.of(jnp.stack(shown, axis=1), weights), root * weights

        # under a condition XLA stores what comes out, and does not decode it anew for each sum
        tile = jax.lax.dynamic_slice_in_dim(codes, start, TILE, axis=1)
        empty = jax.tree.map(lambda one: jnp.zeros(one.shape, one.dtype), jax.eval_shape(decoded, tile))
        target, root = jax.lax.cond(jnp.any(mask), decoded, lambda _: empty, tile)
        found = [_of_model(model, target, root, mask, normal, points, shared) for model in models]
        layers = _simplest(found) if seek == "layers" else found[0]
        return {name: layer.T for name, layer in layers.items()}

    def _of_model(
        model: Any, target: Target, root: Array, mask: Array, normal: Any, points: Any, shared: Any
    ) -> dict[str, Array]:
        tied = grey and issubclass(model, SpecularMaterial)
        if normal is None:
            seen = counted(root)
            fit, normal, tilt, lit, inliers = fit_with_normals(model, target, root, distant, tied, finer)
            left_out = [jnp.sum(a - b, axis=0) for a, b in ((seen, lit), (lit, inliers))]
            return _layers(model, fit, target.where(inliers), inliers, mask, tied, normal, tilt, left_out=left_out)
        if points is None:
            columns = distant.columns(model, normal, root)
        else:
            columns = _near_columns(model, points, stacks, occluders, distant.ambient)
            if distant.ambient is None:
                root *= columns.linear[0][:, :1] > 0
                target = target.where(counted(root))
            linear = [column * root for column in columns.linear]
            columns = columns._replace(linear=linear, weight=columns.weight * root[:, None])
        fit, seen = fit_unshadowed(model, target, columns, root, tied, finer)
        left_out = 0, jnp.sum(counted(root) - seen, axis=0)
        target, columns = target.where(seen), columns.where(seen)
        if seek == "gains":
            return {"gains": jnp.where(mask, octave_gains(model, target, columns, tied, finer), 0)}
        if shared is None:
            return _layers(model, fit, target, seen, mask, tied, normal, None, left_out=left_out)
        log_n, error = shared.T
        if seek == "slope":
            slope, curvature = slope_and_curvature(model, target, columns, tied, log_n)
            cost = fit_at(model, target, columns, tied, log_n).cost
            channels = target.shown.shape[1]
            own = channels * len(columns.linear) + (1 if tied else channels)
            freedom = channels * jnp.sum(seen, axis=0) - own
            sums = jnp.stack([slope, curvature, cost, jnp.maximum(freedom, 0)])
            return {"sums": jnp.where(mask, sums, 0)}
        fit = fit_at(model, target, columns, tied, log_n, sure=True)
        return _layers(model, fit, target, seen, mask, tied, normal, None, error, left_out)

    starts = jnp.arange(0, codes.shape[1], TILE)
    surface = jax.tree.map(lambda leaf: leaf.reshape(-1, TILE, *leaf.shape[1:]), surface)
    if surface.normal is not None:
        surface = surface._replace(normal=jnp.swapaxes(surface.normal, 1, 2))
    tiles = jax.lax.map(of_tile, (starts, surface))
    return {name: layer.reshape(-1, *layer.shape[2:]) for name, layer in tiles.items()}


def _slopes(curves: tuple[Encoding, ...], light: Array) -> Array:
    """How much codes change with light, (P, T): what the roots of weights are, for noise is even in codes."""
    kinds = sorted(set(curves), key=str)
    which = [np.array([curve == kind for curve in curves])[:, None] for kind in kinds]
    return jnp.select(which, [encoded_and_slope(light, kind, 255.0)[1] for kind in kinds])


def _near_columns(model: Any, points: Any, stacks: Any, occluders: Any, ambient: Any) -> Columns:
    """Columns of lights of any kind at the points of a tile, (T,)."""
    terms, order = [], []
    for stack in stacks:

        def of_samples(one: Any, kind: Any = stack.kind) -> Any:
            emitted, *samples = one
            found = light_terms(OneOf((model,)), Lighting((), occluders), points.in_components(), kind, *samples)
            weighted = [part[..., None] * emitted[:, None] for part in (found.diffuse, found.weight)]
            return found._replace(diffuse=weighted[0], weight=weighted[1])

        each = stack.emitted, stack.numbers, stack.nodes, stack.light
        terms.append(jax.lax.map(of_samples, each))
        order.append(stack.light[:, 0])
    every = jax.tree.map(lambda *leaves: jnp.concatenate(leaves)[jnp.argsort(jnp.concatenate(order))], *terms)
    diffuse = jnp.swapaxes(jnp.sum(every.diffuse, axis=1), 1, 2)
    linear = [] if ambient is None else [ambient * jnp.ones_like(diffuse)]
    return Columns([*linear, diffuse], jnp.swapaxes(every.weight, 2, 3), every.log_cosine)


def _layers(
    model: Any,
    fit: TexelFit,
    target: Target,
    seen: Array,
    mask: Array,
    grey: bool,
    normal: Array,
    tilt: Array | None,
    shared: Array | None = None,
    left_out: Any = (0, 0),
) -> dict[str, Array]:
    """The layers of a model's maps, texels last.

    Models are compared by the information criterion of Schwarz as McQuarrie corrects it for few values ("A small-sample
    correction for the Schwarz SIC model selection criterion", Statistics & Probability Letters 44, 1999). What a model
    left out as outliers, each its own, counts with the least residual of such, and what it leaves unlit as noise. A
    highlight is seen where the criterion wants it: of so many exponents one serves noise better than its errors expect.
    """
    channels, lanes = target.shown.shape[1:]
    glossy = issubclass(model, SpecularMaterial)
    k_s, k_s_error = (fit.k[-1], fit.k_error[-1]) if glossy else (jnp.zeros((channels, lanes)),) * 2
    linear = fit.k[:-1] if glossy else fit.k
    of_lobe = glossy * ((1 if grey else channels) + (shared is None))
    unknowns = len(linear) * channels + of_lobe + 2 * (tilt is not None)
    values = channels * jnp.sum(seen, axis=0)

    def price(unknowns: int) -> Array:
        return unknowns * jnp.log(jnp.maximum(values, 1)) * values / jnp.maximum(values - unknowns - 2, 1)

    freedom = values - unknowns
    noise = jnp.where(freedom < 1, jnp.nan, jnp.sqrt(fit.cost / jnp.maximum(freedom, 1)))
    n = jnp.exp(fit.log_n)
    error = noise * fit.log_n_error if shared is None else shared
    gain = values * jnp.log1p(fit.gain / jnp.maximum(fit.cost, jnp.finfo(n.dtype).tiny))
    shows = jnp.any(k_s > LEAST_HIGHLIGHT * noise * k_s_error, axis=0)
    shows &= gain > price(unknowns) - price(unknowns - of_lobe)
    capped = jnp.any(k_s >= target.cap, axis=0)
    tests = (~mask | (values == 0), freedom < 1, ~shows | (not glossy), capped, ~(error <= MOST_ERROR))
    reason = jnp.select(tests, [jnp.uint8(number) for number in range(1, len(REASONS))], jnp.uint8(0))
    known = reason == 0
    inside = reason != REASONS.index("outside")
    names = ("k_a", "k_d")[-len(linear) :]
    layers = {name: jnp.where(inside, k, jnp.nan) for name, k in zip(names, linear, strict=True)}
    layers |= {f"{name}_error": noise * e for name, e in zip(names, fit.k_error, strict=False)}
    square = over_channels(jnp.sum(target.shown * target.shown, axis=0))[0]
    unlit, outliers = left_out
    every = values + channels * (unlit + outliers)
    whole = fit.cost + (channels * unlit + OUTLIER**2 * outliers) * noise**2
    whole = jnp.maximum(whole, jnp.finfo(n.dtype).tiny)
    return layers | {
        "n": jnp.where(known, n, jnp.nan),
        "k_s": jnp.where(known, k_s, jnp.nan),
        "n_error": jnp.where(known, n * error, jnp.nan),
        "k_s_error": jnp.where(known, noise * k_s_error, jnp.nan),
        "fitted_n": n,
        "fitted_k_s": jnp.where(inside, k_s, 0),
        "normal": jnp.where(inside, normal, 0),
        "normal_error": jnp.zeros_like(n) if tilt is None else jnp.degrees(noise * tilt),
        "noise": jnp.where(inside, noise, jnp.nan),
        "left_out": channels * outliers / jnp.maximum(every, 1),
        "determined": known,
        "reason": reason,
        "residual": jnp.where(inside, jnp.sqrt(fit.cost / jnp.where(square > 0, square, 1)), jnp.nan),
        "criterion": jnp.where(freedom < 3, jnp.inf, every * jnp.log(whole) + price(unknowns)),
    }


def _simplest(found: list[dict[str, Array]]) -> dict[str, Array]:
    """Of each texel the layers of the model with the least criterion."""
    best, chosen = found[0], jnp.zeros_like(found[0]["reason"])
    for index, other in enumerate(found[1:], start=1):
        better = other["criterion"] < best["criterion"]
        chosen = jnp.where(better, jnp.uint8(index), chosen)
        best = {name: jnp.where(better, other[name], best[name]) for name in best}
    best.pop("criterion")
    return best | {"chosen": chosen}
