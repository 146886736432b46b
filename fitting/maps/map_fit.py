"""Maps from photographs: every texel's material, band of rows by band of rows."""

import dataclasses
import functools
import os
from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

import brdf
from brdf.errors import InputError
from brdf.images.encoding import Encoding, encode
from brdf.lights.base import LightStack, stacked
from brdf.lobes import light_terms
from brdf.models.base import SpecularMaterial
from brdf.precision import Precision, working_precision
from brdf.vectors import Components, normalize
from fitting.maps import map_inputs
from fitting.maps.kept_bands import KeptBands
from fitting.maps.map_inputs import Photographs
from fitting.maps.map_light_choice import MOST_ERROR
from fitting.maps.map_result import REASONS, Maps
from fitting.maps.texels import (
    STEPS,
    Bracket,
    Columns,
    Distant,
    Target,
    TexelFit,
    fit_at,
    fit_texels,
    fit_with_normals,
    octave_gains,
    over_channels,
    slope_and_curvature,
)
from fitting.progress import waiting
from fitting.solver.devices import device_count, gathered, own, placed, spread_over

TILE = 528
"""Texels that go through the program in step: what they need stays in the processor's cache. No power of two: rows so
far apart would all fall on the same few places of the cache, and sums over them take up to five times longer."""

BAND = 124 * TILE
"""Texels that are read and laid out at a time."""

RING = 0.15
"""Lights whose heights z spread by less than this are a ring: n shows less well, and the grid is finer."""

LESS = 0.9
"""Photographs of 8 bits that do not say so are linear where that leaves less than this share of sRGB's squares."""

LEAST_HIGHLIGHT = 2.0
"""k_s is seen where it exceeds so many of its standard errors."""


def fit_maps(
    pictures: Any,
    lights: Any = None,
    normals: Any = None,
    *,
    intensities: Any = None,
    exposures: Any = None,
    ambient: Any = None,
    to_view: Any = (0.0, 0.0, 1.0),
    model: str = "blinn-phong",
    specular: str = "coloured",
    mask: Any = None,
    encoding: Any = None,
    flip_y: bool = False,
    precision: Precision = "float32",
    labels: Any = None,
    mesh: Any = None,
    keep: str | Path | None = None,
) -> Maps:
    """Fit a material to every texel of one view under many lights: the global optimum of each, with errors.

    Args:
        pictures: photographs of one size, (P, H, W, C) linear values or a list of arrays, `brdf.Picture`,
            `brdf.ImageReader` or files; or a folder with an ``.lp`` file, or with DiLiGenT's text files.
        lights: towards the lights, (P, 3), x right, y up, z to the camera; or directional lights; or scenes with one
            light of any kind each, whose camera and shapes tell what texels see, cast shadows left out; or an ``.lp``
            or text file. None for the folder's.
        normals: (H, W, 3); a file (.npy, .exr, or an image with n·0.5 + 0.5, y up); "fit" to find them too, under
            distant lights. None for the scene's or the folder's ``normals.*``, else they are found.
        intensities: of the lights, (P,) or (P, C): photographs are divided by them.
        exposures: of the photographs, (P,), likewise.
        ambient: intensity of the ambient light, a number or (C,), where there is some: k_a is found too.
        to_view: towards the camera, which is far away.
        model: "lambert", "phong", "blinn-phong" or a normalised form; "auto" for the simplest of Lambert, Phong and
            Blinn-Phong that serves each texel, by the Bayesian information criterion.
        specular: "coloured", or "grey": the channels share k_s.
        mask: (H, W), or a file: texels to look at. None for the folder's ``mask.*``, else all.
        encoding: of the files: "linear", "srgb" or a gamma; None for what they say. Where files of 8 bits say nothing,
            the one is taken that the model explains better, and a note says so.
        flip_y: whether y goes down in a file of normals.
        precision: "float32" or "float64".
        labels: (H, W) whole numbers, or a file of them as codes: texels with the same one share n, which then is known
            far better than each could tell; 0 for all texels. None for an n of each.
        mesh: a `jax.sharding.Mesh` of the devices to deal bands of rows out to, on one machine or, under
            `jax.distributed`, on many: each process reads and fits those of its own devices. None for all cores.
        keep: a folder for the bands that are done. A call with the same inputs goes on from there, where one was
            interrupted; processes take the bands of the others from it, so all must see it.

    Returns:
        The maps.

    Raises:
        InputError: naming the photograph or argument.

    Example:
        >>> to_light = np.array([[0, 0, 1], [0.5, 0, 1], [0, 0.5, 1], [-0.5, 0, 1], [0, -0.5, 1], [0.2, 0.2, 1]])
        >>> normals = np.broadcast_to([0.0, 0.0, 1.0], (4, 4, 3))
        >>> truth = brdf.BlinnPhong(k_d=[0.3, 0.2, 0.1], k_s=0.5, n=60)
        >>> points = brdf.SurfacePoints.from_normals(normals)
        >>> scenes = [brdf.Scene(points=points, lights=[brdf.DirectionalLight(v, 1.0)]) for v in to_light]
        >>> maps = fitting.fit_maps([brdf.render(truth, scene) for scene in scenes], to_light, normals)
        >>> round(float(maps.n[0, 0]), 2), np.round(maps.k_d[0, 0], 3)
        (60.0, array([0.3, 0.2, 0.1], dtype=float32))

    Source: variable projection, Golub and Pereyra 1973; see `fitting.maps.texels`.
    """
    if isinstance(pictures, str | Path) and Path(pictures).is_dir():
        found = map_inputs.read_folder(Path(pictures))
        pictures, lights = found["pictures"], found["lights"] if lights is None else lights
        intensities = found.get("intensities") if intensities is None else intensities
        normals = found.get("normals") if normals is None else normals
        mask = found.get("mask") if mask is None else mask
    elif isinstance(pictures, str | Path):
        raise InputError(pictures, "is no folder", "Give a folder of photographs with their lights, or a list of files")
    if specular not in ("coloured", "grey"):
        raise InputError("specular", f"must be coloured or grey, got {specular!r}", "Choose one of them")
    models = _models(model)
    given = map_inputs.photographs(pictures, lights, intensities, exposures, encoding)
    surface = _surface(given, normals, mask, to_view, flip_y)
    how = _How(models, specular == "grey", _ambient(ambient, given), np.asarray(to_view, float), precision)
    notes: tuple[str, ...] = ()
    if given.silent and given.to_light is not None:
        other = map_inputs.photographs(pictures, lights, intensities, exposures, "linear")
        given, notes = _likelier(given, other, surface, how)
    with spread_over(mesh):
        if labels is not None:
            surface = _with_shared_n(given, surface, how, labels)
        layers = _Bands(given, surface, how, keep).fit()
    if not np.any(layers["reason"] != REASONS.index("outside")):
        raise InputError("pictures", "show no texel that counts", "Check mask, normals and clipping")
    return dataclasses.replace(_maps(layers, how, notes), to_light=given.to_light)


def _maps(layers: dict[str, np.ndarray], how: "_How", notes: tuple[str, ...] = ()) -> Maps:
    return Maps(models=tuple(one.name for one in how.models), to_view=how.to_view, notes=notes, **layers)


@dataclasses.dataclass(frozen=True)
class _How:
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


def _models(model: str) -> tuple[Any, ...]:
    if model == "auto":
        return brdf.Lambert, brdf.Phong, brdf.BlinnPhong
    if model not in brdf.MODELS:
        raise InputError("model", f"is unknown, got {model!r}", f"Use auto, {', '.join(brdf.MODELS)}")
    return (brdf.MODELS[model],)


def _ambient(ambient: Any, given: Photographs) -> np.ndarray | None:
    if ambient is None:
        return None
    values = np.asarray(ambient, float).reshape(-1)
    if values.size not in (1, given.shape[3]) or not np.all((values > 0) & np.isfinite(values)):
        came = f"must be 1 or {given.shape[3]} numbers above 0, got {ambient!r:.60}"
        raise InputError("ambient", came, "Give the intensity of the ambient light")
    columns = values / given.unit
    return columns[:, :1] if np.all(columns == columns[:, :1]) else columns


def _surface(given: Photographs, normals: Any, mask: Any, to_view: Any, flip_y: bool) -> "_Surface":
    """What the texels see."""
    _, height, width, _ = given.shape
    if mask is None:
        mask = np.ones((height, width), bool)
    mask = brdf.read_mask(mask) if isinstance(mask, str | Path) else np.asarray(mask, bool)
    if mask.shape != (height, width):
        came = f"is of shape {mask.shape}, the photographs of {(height, width)}"
        raise InputError("mask", came, "Give a value for each pixel")
    if given.scenes is not None:
        if normals is not None:
            raise InputError("normals", "are told by the scenes", "Leave them out")
        points = given.scenes[0].surface_points()
        if points.mask.shape != (height, width):
            came = f"show {points.mask.shape[1]} x {points.mask.shape[0]} pixels, the photographs {width} x {height}"
            raise InputError("lights", came, "Give scenes of the photographs' size")
        points = dataclasses.replace(points, mask=points.mask & mask, area=None)
        return _Surface(points.normal, points.mask, points)
    if normals is None or (isinstance(normals, str) and normals == "fit"):
        return _Surface(None, mask, None)
    name = "normals"
    if isinstance(normals, str | Path):
        name, normals = str(normals), map_inputs.read_normal_map(normals, flip_y=flip_y)
    normals = np.asarray(normals)
    if normals.shape != (height, width, 3):
        came = f"are of shape {normals.shape}, the photographs of {(height, width)}"
        raise InputError(name, came, "Give a normal for each pixel")
    return _Surface(normals, mask, None)


class _Surface(NamedTuple):
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

    def some(self, rows: Any, texels: int, dtype: Any) -> "_Surface":
        """Rows of it, padded to so many texels."""

        def cut(leaf: Any) -> np.ndarray:
            part = np.asarray(leaf[rows])
            part = part.reshape(-1, *part.shape[2:])
            found = np.zeros((texels, *part.shape[1:]), dtype if part.dtype.kind == "f" else part.dtype)
            found[: len(part)] = part
            return found

        return jax.tree.map(cut, self)


class _Bands:
    """Bands of rows, from the top: each is read, fitted on a core or device while others are, and kept where asked."""

    def __init__(self, given: Photographs, surface: _Surface, how: _How, keep: str | Path | None):
        self.given, self.surface, self.how = given, surface, how
        _, height, width, _ = given.shape
        count = min(height, max(-(-height * width // BAND), device_count()))
        self.rows = -(-height // count)
        self.starts = range(0, height, self.rows)
        self.texels = -(-self.rows * width // TILE) * TILE
        self.kept = None if keep is None else KeptBands(keep, given, (how, surface[:2], surface.shared, self.rows))

    def fit(self) -> dict[str, np.ndarray]:
        """The layers, (H, W, ...)."""
        mine, count = own(len(self.starts)), len(self.starts)
        if len(mine) < count and self.kept is None:
            raise InputError("keep", "is missing", "Give a folder that all processes see, for the bands of each")
        _, height, width, _ = self.given.shape
        layers: dict[str, np.ndarray] = {}

        def place(index: int, band: dict[str, np.ndarray]) -> None:
            start = self.starts[index]
            stop = min(start + self.rows, height)
            for name, values in band.items():
                if name not in layers:
                    layers[name] = np.empty((height, width, *values.shape[1:]), values.dtype)
                texels = values[: (stop - start) * width]
                layers[name][start:stop] = texels.reshape(stop - start, width, *values.shape[1:])

        with waiting("fitting maps") as say:
            for done, (index, band) in enumerate(self._each(mine), start=1):
                place(index, band)
                say(f"fitting maps, {100 * done // len(mine)} % done")
        if len(mine) < count and self.kept is not None:
            gathered({}, 1, (1,))  # until all processes have kept theirs
            for index in sorted(set(range(count)) - set(mine)):
                place(index, self.kept.read(self.starts[index]) or {})
            gathered({}, 1, (1,))  # and have read those of the others
        return layers

    def _each(self, mine: list[int]) -> Iterator[tuple[int, dict[str, np.ndarray]]]:
        queue: deque[tuple[int, Future]] = deque()
        workers = os.cpu_count() or 1
        with ThreadPoolExecutor(workers) as pool:
            for index in mine:
                start, precision = self.starts[index], self.how.precision
                band = None if self.kept is None else self.kept.read(start)
                if band is not None:
                    yield index, band
                    continue
                rows = np.arange(start, min(start + self.rows, self.given.shape[1]))
                codes = self.given.band(rows, self.texels, precision, pool)
                with working_precision(precision):
                    placed_there = placed(index, (codes, self.surface.some(rows, self.texels, precision)))
                queue.append((index, pool.submit(_fit_band, self.given, self.how, *placed_there)))
                if len(queue) > workers:
                    yield self._done(*queue.popleft())
            for one in queue:
                yield self._done(*one)

    def _done(self, index: int, future: Future) -> tuple[int, dict[str, np.ndarray]]:
        band = future.result()
        if self.kept is not None:
            self.kept.write(self.starts[index], band)
        return index, band


def _with_shared_n(given: Photographs, surface: _Surface, how: _How, labels: Any) -> _Surface:
    """The n that texels of one label share, and its error: the sums of its texels in place of those of one."""
    (model, *more), (_, height, width, _) = how.models, given.shape
    if more or not issubclass(model, SpecularMaterial):
        raise InputError("labels", "need one model with an exponent", "Name the model, as blinn-phong")
    if surface.normal is None:
        surface = surface._replace(normal=_Bands(given, surface, how, None).fit()["normal"])
    if isinstance(labels, str | Path):
        with brdf.ImageReader(labels, encoding="linear") as reader:
            labels = np.round(reader.read()[..., 0] * (2**reader.bits - 1)).astype(int)
    labels = np.asarray(labels)
    if labels.dtype.kind not in "iub" or labels.shape not in ((), (height, width)):
        came = f"are of shape {labels.shape} and type {labels.dtype}, the photographs of {(height, width)}"
        raise InputError("labels", came, "Give a whole number for each texel, or 0")
    names, index = np.unique(np.broadcast_to(labels, (height, width)), return_inverse=True)
    index = index.reshape(height, width)

    def summed(layer: np.ndarray) -> np.ndarray:
        weights = layer.reshape(-1, layer.shape[2]).T.astype(float)
        return np.stack([np.bincount(index.ravel(), values, names.size) for values in weights])

    def sought(seek: str, shared: Any) -> np.ndarray:
        there = surface._replace(shared=shared)
        (layer,) = _Bands(given, there, dataclasses.replace(how, seek=seek), None).fit().values()
        return summed(layer)

    with working_precision("float64"):
        bracket = Bracket.about_best(jnp.asarray(sought("gains", None)), _finer(given))

        def sums(log_n: Any) -> np.ndarray:
            shared = np.stack([np.asarray(log_n)[index], np.zeros((height, width))], axis=-1)
            return sought("slope", shared)

        for _ in range(STEPS):
            slope, curvature, _, _ = sums(bracket.log_n)
            bracket = bracket.narrowed(jnp.asarray(slope), jnp.asarray(curvature))
        log_n = np.asarray(bracket.log_n)
        _, curvature, cost, freedom = sums(log_n)
    noise = cost / np.maximum(freedom, 1)
    error = np.sqrt(np.divide(noise, curvature, out=np.full_like(noise, np.inf), where=curvature > 0))
    return surface._replace(shared=np.stack([log_n[index], error[index]], axis=-1))


def _finer(given: Photographs) -> int:
    return 2 if given.to_light is not None and np.ptp(given.to_light[:, 2]) < RING else 1


def _fit_band(given: Photographs, how: _How, codes: np.ndarray, surface: _Surface) -> dict[str, np.ndarray]:
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
        layers = _program(
            how.models, how.grey, _finer(given), how.seek, photographs, surface, distant, stacks, occluders
        )
        return {name: np.asarray(layer) for name, layer in layers.items()}


@eqx.filter_jit
def _program(
    models: tuple[Any, ...],
    grey: bool,
    finer: int,
    seek: str,
    photographs: tuple[Any, Any, Any],
    surface: _Surface,
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
            shown = [jnp.where(counts, x * scale[:, c, None], 0) for c, x in enumerate(shown)]
            return Target.of(jnp.stack(shown, axis=1)), counts.astype(scale.dtype)

        # under a condition XLA stores what comes out, and does not decode it anew for each sum
        tile = jax.lax.dynamic_slice_in_dim(codes, start, TILE, axis=1)
        empty = jax.tree.map(lambda one: jnp.zeros(one.shape, one.dtype), jax.eval_shape(decoded, tile))
        target, seen = jax.lax.cond(jnp.any(mask), decoded, lambda _: empty, tile)
        found = [_of_model(model, target, seen, mask, normal, points, shared) for model in models]
        layers = _simplest(found) if seek == "layers" else found[0]
        return {name: layer.T for name, layer in layers.items()}

    def _of_model(
        model: Any, target: Target, seen: Array, mask: Array, normal: Any, points: Any, shared: Any
    ) -> dict[str, Array]:
        tied = grey and issubclass(model, SpecularMaterial)
        if normal is None:
            fit, normal, normal_error, seen = fit_with_normals(model, target, seen, distant, tied, finer)
            return _layers(model, fit, Target.of(target.shown * seen[:, None]), seen, mask, tied, normal, normal_error)
        if points is None:
            columns = distant.columns(model, normal, seen)
        else:
            columns = _near_columns(model, points, stacks, occluders, distant.ambient)
            if distant.ambient is None:
                seen *= columns.linear[0][:, 0] > 0
            linear = [column * seen[:, None] for column in columns.linear]
            columns = columns._replace(linear=linear, weight=columns.weight * seen[:, None])
            target = Target.of(target.shown * seen[:, None])
        if seek == "gains":
            return {"gains": jnp.where(mask, octave_gains(model, target, columns, tied, finer), 0)}
        if shared is None:
            fit = fit_texels(model, target, columns, tied, finer)
            return _layers(model, fit, target, seen, mask, tied, normal, None)
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
        return _layers(model, fit, target, seen, mask, tied, normal, None, error)

    starts = jnp.arange(0, codes.shape[1], TILE)
    surface = jax.tree.map(lambda leaf: leaf.reshape(-1, TILE, *leaf.shape[1:]), surface)
    if surface.normal is not None:
        surface = surface._replace(normal=jnp.swapaxes(surface.normal, 1, 2))
    tiles = jax.lax.map(of_tile, (starts, surface))
    return {name: layer.reshape(-1, *layer.shape[2:]) for name, layer in tiles.items()}


def _near_columns(model: Any, points: Any, stacks: Any, occluders: Any, ambient: Any) -> Columns:
    """Columns of lights of any kind at the points of a tile, (T,)."""
    terms, order = [], []
    for stack in stacks:
        rows, lights = stack.rows()

        def of_sample(one: Any, kind: Any = stack.kind) -> Any:
            row, light = one
            return jax.vmap(partial(light_terms, model, occluders, kind, row, light))(points)

        found = jax.lax.map(of_sample, (rows, lights))
        terms.append(jax.tree.map(partial(_by_light, stack.light.shape[0]), found))
        order.append(stack.light)
    every = jax.tree.map(lambda *leaves: jnp.concatenate(leaves)[jnp.argsort(jnp.concatenate(order))], *terms)
    diffuse = jnp.swapaxes(jnp.sum(every.diffuse, axis=1), 1, 2)
    linear = [] if ambient is None else [ambient * jnp.ones_like(diffuse)]
    return Columns([*linear, diffuse], every.weight[..., 0], every.log_cosine)


def _by_light(lights: int, samples: Array) -> Array:
    return samples.reshape(lights, -1, *samples.shape[1:])


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
) -> dict[str, Array]:
    """The layers of a model's maps, texels last."""
    channels, lanes = target.shown.shape[1:]
    glossy = issubclass(model, SpecularMaterial)
    k_s, k_s_error = (fit.k[-1], fit.k_error[-1]) if glossy else (jnp.zeros((channels, lanes)),) * 2
    linear = fit.k[:-1] if glossy else fit.k
    unknowns = len(linear) * channels + glossy * (2 if grey else channels + 1) + 2 * (tilt is not None)
    values = channels * jnp.sum(seen, axis=0)
    freedom = values - unknowns
    noise = jnp.sqrt(fit.cost / jnp.maximum(freedom, 1))
    n = jnp.exp(fit.log_n)
    error = noise * fit.log_n_error if shared is None else shared
    shows = jnp.any(k_s > LEAST_HIGHLIGHT * noise * k_s_error, axis=0)
    capped = jnp.any(k_s >= target.cap, axis=0)
    tests = (~mask | (values == 0), freedom < 1, ~shows | (not glossy), capped, ~(error <= MOST_ERROR))
    reason = jnp.zeros(lanes, jnp.uint8)
    for number, holds in reversed([*enumerate(tests, start=1)]):
        reason = jnp.where(holds, jnp.uint8(number), reason)
    known = reason == 0
    inside = reason != REASONS.index("outside")
    names = ("k_a", "k_d")[-len(linear) :]
    layers = {name: jnp.where(inside, k, jnp.nan) for name, k in zip(names, linear, strict=True)}
    layers |= {f"{name}_error": noise * e for name, e in zip(names, fit.k_error, strict=False)}
    square = over_channels(jnp.sum(target.shown * target.shown, axis=0))[0]
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
        "determined": known,
        "reason": reason,
        "residual": jnp.where(inside, jnp.sqrt(fit.cost / jnp.where(square > 0, square, 1)), jnp.nan),
        "criterion": values * jnp.log(jnp.maximum(fit.cost, jnp.finfo(n.dtype).tiny)) + unknowns * jnp.log(values + 1),
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


def _likelier(given: Photographs, other: Photographs, surface: Any, how: _How) -> tuple[Photographs, tuple[str, ...]]:
    """Silent photographs as sRGB or as linear light: as the model leaves less of the codes of some rows.

    Args:
        given: read as sRGB.
        other: read as linear light, whose values are the codes.
        surface: what the texels see.
        how: they are fitted.
    """
    _, height, width, _ = given.shape
    rows = np.linspace(0, height - 1, min(height, max(1, 4 * TILE // width))).astype(int)
    assert given.to_light is not None
    count, left, codes = rows.size * width, [], other.band(rows, rows.size * width, how.precision)
    codes = np.where(codes < other.top[:, None, None], codes, np.nan)
    readings: tuple[tuple[Photographs, Encoding], ...] = ((given, "srgb"), (other, "linear"))
    for one, encoding in readings:
        texels = -(-count // TILE) * TILE
        layers = _fit_band(one, how, one.band(rows, texels, how.precision), surface.some(rows, texels, how.precision))
        shaped = {name: layer[:count].reshape(rows.size, width, *layer.shape[1:]) for name, layer in layers.items()}
        maps, square = _maps(shaped, how), np.zeros(count)
        for p, code in enumerate(codes):
            ambient = 0 if maps.k_a is None or how.ambient is None else maps.k_a * how.ambient[p]
            shown = encode((maps.render(given.to_light[p]) + ambient) * one.unit[p], encoding)
            square += np.sum(np.nan_to_num(shown.reshape(code.shape) - code) ** 2, axis=-1)
        left.append(float(np.nanmedian(np.sqrt(square / np.nansum(codes**2, axis=(0, 2))))))
    kept = int(left[1] ** 2 < LESS * left[0] ** 2)
    names = ("sRGB", "linear")
    note = (
        f"{given.silent[0]} does not say how its values are encoded: read as {names[kept]}, under which the maps are "
        f"off by {100 * left[kept]:.2g} % of a texel's codes, under {names[1 - kept]} by {100 * left[1 - kept]:.2g} %. "
        "Where you know, say so with the encoding"
    )
    return (given, other)[kept], (note,)
