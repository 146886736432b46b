"""How the noise of photographs grows with brightness, as a camera's does: what their values are weighed by.

Some texels are fitted as if noise were even in codes. What they leave tells, all together, how the variance goes with
what they show; that is kept where it is likelier than even noise, and no less likely than a noise of its own for each
texel, as where models do not hold: then nothing is known of a camera. They also tell of a light that is not as bright
as it is said to be.
"""

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from brdf.precision import working_precision
from brdf.vectors import Components
from fitting.likelihood import encoded_and_slope
from fitting.maps.input_guesses import some_layers
from fitting.maps.texels import OUTLIER, Distant, Texels
from fitting.maps.tiles import MapProblem
from fitting.uncertainty.noise_model import RISE, growth_of_channel

MOST_VALUES = 1 << 17
"""So many at most tell."""

DIGITS = 3
"""Of coefficients: what is kept of bands is named by them, also where processes on unlike machines look for them."""

ARITHMETIC = 2.0**-15
"""So little of the brightest value is the arithmetic of the program that drew it."""

BRIGHT, FEWEST = 0.1, 16
"""Values that tell of a light: of this share of the brightest of a photograph, and at least so many."""

OTHER, DEVIATIONS = 1.1, 8.0
"""A photograph stands apart that is this factor off, and so many times as far as is usual."""

MOST_OTHERS = 0.1
"""Where more than this share of the photographs stand apart it is not their lights."""

NEEDLESS = 2.0
"""So much twice the logarithm of the likelihood rises, with room for chance, by a noise of its own for each texel where
there is none."""


def with_noise(problem: MapProblem) -> tuple[MapProblem, tuple[str, ...]]:
    """The problem with noise that grows with brightness where that is likelier, under distant lights; what to tell.

    That is of photographs whose lights are probably brighter or darker than they are said to be.
    """
    given = problem.photographs
    if given.to_light is None or not problem.texels.size:
        return problem, ()
    texels, layers = some_layers(problem)
    stride = -(-texels.size * len(given.each) * given.size[2] // MOST_VALUES)
    texels, layers = texels[::stride], {name: layer[::stride] for name, layer in layers.items()}
    values = problem.tiles(texels)[0]
    values = values[: len(given.each)].reshape(len(given.each), -1, given.size[2])[:, : texels.size]
    with working_precision(problem.precision):
        numbers = {name: layers[name] for name in ("k_d", "fitted_k_s", "fitted_n", "normal", "chosen")}
        explained = np.asarray(_explained(problem.models, given.to_light, problem.to_view, **numbers), np.float64)
    if problem.ambient is not None:
        explained = explained + problem.ambient[:, None] * layers["k_a"]
    shown = explained * given.unit[:, None]
    both = zip(shown, given.each, strict=True)
    slope = np.stack([encoded_and_slope(values, one.curve, 255.0)[1] for values, one in both])
    top = np.array([one.top for one in given.each])[:, None, None]
    noise = layers["noise"][:, None] * np.sqrt(np.mean(given.unit**2, axis=0))
    squared = (values - shown) ** 2
    with np.errstate(invalid="ignore"):
        counts = (values < top) & (shown > 0)
        notes = _of_lights(np.where(counts, values, np.nan), shown, [one.name for one in given.each])
        counts &= squared * slope**2 <= (OUTLIER * noise) ** 2
    channels, glossy = given.size[2], np.any(layers["fitted_k_s"] > 0, axis=1)
    unknowns = (
        channels * (1 + (problem.ambient is not None))
        + glossy * (1 + (1 if problem.grey else channels))
        + 2 * (problem.surface.normal is None)
    )
    many = np.sum(counts, axis=(0, 2))
    counts &= (many > 2 * unknowns)[:, None]
    least = (ARITHMETIC * np.max(shown, initial=0.0, where=counts)) ** 2
    if not np.sum(squared, where=counts) > least * np.count_nonzero(counts):
        return problem, notes
    squared = squared * (many / np.maximum(many - unknowns, 1))[:, None]
    growth = _growth(squared, shown, slope, counts, max(one.step for one in given.each) / np.sqrt(12))
    return dataclasses.replace(problem, growth=growth), notes


def _of_lights(values: np.ndarray, shown: np.ndarray, names: Sequence[str]) -> tuple[str, ...]:
    """Photographs that stand apart from the others: most of it is brighter, or darker, than what is explained.

    Of one that lies in shadow a part is as bright as that.
    """
    known = np.isfinite(values) & np.isfinite(shown)
    shown = np.where(known, shown, 0)
    bright = known & (shown > BRIGHT * np.max(shown, axis=(1, 2), keepdims=True))
    factor = np.ones(len(names))
    for index, some in enumerate(bright):
        if np.count_nonzero(some) >= FEWEST:
            factor[index] = np.clip(1, *np.quantile(values[index][some] / shown[index][some], (0.25, 0.75)))
    off = np.abs(np.log(np.maximum(factor, np.finfo(float).tiny)))
    apart = off > max(np.log(OTHER), DEVIATIONS * float(np.median(off)))
    count = int(np.count_nonzero(apart))
    if not 0 < count <= MOST_OTHERS * len(names):
        return ()
    worst = int(np.argmax(off))
    others = f", and {count - 1} more stand apart" if count > 1 else ""
    what = f"{names[worst]} is {max(factor[worst], 0):.2g} times as bright as the others explain it{others}"
    return (f"{what}: check intensities, exposures and directions of the lights",)


def _growth(
    squared: np.ndarray, shown: np.ndarray, slope: np.ndarray, counts: np.ndarray, rounding: float
) -> tuple[float, ...]:
    """Of a camera that counts photons: the variance is a constant and so many times the value; about 1.

    None of them where it is even in codes, or each texel has its own. What models leave that do not hold goes with the
    square of the value. ``rounding`` is what codes leave in any case.
    """
    many = np.sum(counts, axis=(0, 2))
    some = np.sum(np.where(counts, squared * slope**2, 0), axis=(0, 2))[many > 0]
    many, square, value, codes = many[many > 0], squared[counts], shown[counts], slope[counts]
    least = max(np.finfo(float).eps * float(np.max(value)), rounding / float(np.max(codes))) ** 2
    coefficients, _ = growth_of_channel(square, value, least, terms=2)
    variance = coefficients[0] + coefficients[1] * value
    growing = float(np.sum(np.log(variance) + square / variance))
    steps = square.size - 2 * float(np.sum(np.log(codes)))
    even = steps + square.size * np.log(max(np.sum(some) / square.size, least))
    of_texels = steps + float(np.sum(many * np.log(np.maximum(some / many, least))))
    if growing > even - RISE or growing > of_texels + NEEDLESS * many.size:
        return ()
    return tuple(float(f"{one:.{DIGITS}g}") for one in coefficients / np.median(variance))


@functools.partial(jax.jit, static_argnums=0)
def _explained(
    models: Sequence[Any],
    to_light: Array,
    to_view: Array,
    *,
    k_d: Array,
    fitted_k_s: Array,
    fitted_n: Array,
    normal: Array,
    chosen: Array,
) -> Float[Array, "P T C"]:
    """What the materials of texels show under distant lights, without ambient light."""
    dtype, to_view = k_d.dtype, to_view / jnp.linalg.norm(to_view)
    lights = Distant(Components(tuple(jnp.asarray(to_light.T, dtype))), Components(tuple(to_view.astype(dtype))), None)
    one = jnp.ones((1, len(k_d), len(to_light)), dtype)
    found = jnp.zeros((*one.shape[1:], k_d.shape[1]), dtype)
    for index, model in enumerate(models):
        texels = Texels(model, False, 1, one, Components(tuple(one))).facing(Components(tuple(normal.T)), lights)
        columns = (column.parts[0][..., None] for column in texels.columns(jnp.log(fitted_n)))
        shown = sum(column * k[:, None] for column, k in zip(columns, (k_d, fitted_k_s), strict=False))
        found = jnp.where(chosen[:, None, None] == index, shown, found)
    return jnp.moveaxis(found, 0, 1)
