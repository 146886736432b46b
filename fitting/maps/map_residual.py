"""What some texels leave of their photographs: how noise grows with brightness, and which lights are not as they say.

Some texels are fitted as if noise were even in codes. All together they tell how its variance
goes with what is shown. A camera's is kept where it is likelier than even noise, and no less likely than a noise of its
own for each texel, as where models do not hold: then nothing is known of a camera.
"""

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from brdf.precision import working_precision
from brdf.vectors import Components, normalize
from fitting.likelihood import encoded_and_slope
from fitting.maps.input_guesses import some_layers
from fitting.maps.texels import OUTLIER, Distant, Texels, columns_of
from fitting.maps.tiles import TILE, MapProblem, near
from fitting.uncertainty.noise_model import RISE, growth_of_channel

MOST_VALUES = 1 << 17
"""So many at most tell."""

DIGITS = 3
"""Of coefficients: what is kept of bands is named by them, also where processes on unlike machines look for them."""

ARITHMETIC = 2.0**-15
"""So little of the brightest value is the arithmetic of the program that drew it."""

NEEDLESS = 2.0
"""So much twice the logarithm of the likelihood rises, with room for chance, by a noise of its own for each texel where
there is none."""

BRIGHT, FEWEST = 0.1, 16
"""Values that tell of a light: of this share of the brightest of a photograph, and at least so many."""

OTHER, DEVIATIONS = 1.1, 8.0
"""A photograph stands apart that is this factor off, and so many times as far as is usual."""

MOST_OTHERS = 0.1
"""Where more than this share is that factor off all of these stand apart, and it may be that the models do not hold."""


class Left(NamedTuple):
    """What some texels leave.

    Attributes:
        values: as photographs have them, NaN where they do not count.
        shown: what is explained of these, above 0 where a light shines.
        slope: of their codes by light.
        inlier: what is no outlier.
        unknowns: of each texel.
    """

    values: Float[np.ndarray, "P T C"]
    shown: Float[np.ndarray, "P T C"]
    slope: Float[np.ndarray, "P T C"]
    inlier: Bool[np.ndarray, "P T C"]
    unknowns: Float[np.ndarray, " T"]


def left_by_some(problem: MapProblem) -> Left | None:
    """What some texels leave; None where there are no texels."""
    given = problem.photographs
    if not problem.texels.size:
        return None
    count, channels, ambient = len(given.each), given.size[2], problem.ambient
    texels, layers = some_layers(problem)
    # Near lights have many samples: a tile's at a time.
    most = texels.size if given.scenes is None else TILE
    stride = max(-(-texels.size * count * channels // MOST_VALUES), -(-texels.size // most))
    texels, layers = texels[::stride], {name: layer[::stride] for name, layer in layers.items()}
    values, surface = problem.tiles(texels)
    values = values[:count].reshape(count, -1, channels)[:, : texels.size]
    points = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:])[: texels.size], surface.points)
    with working_precision(problem.precision):
        lights = given.to_light, problem.to_view, layers["normal"]
        lights = lights if points is None else (points, *problem.near_lights())
        numbers = [layers[name] for name in ("k_d", "fitted_k_s", "fitted_n", "chosen")]
        explained = np.asarray(_explained(problem.models, count, points is None, lights, *numbers), np.float64)
    explained = explained if ambient is None else explained + ambient[:, None] * layers["k_a"]
    shown = explained * given.unit[:, None]
    both = zip(shown, given.each, strict=True)
    slope = np.stack([encoded_and_slope(some, one.curve, 255.0)[1] for some, one in both])
    top = np.array([one.top for one in given.each])[:, None, None]
    noise = layers["noise"][:, None] * np.sqrt(np.mean(given.unit**2, axis=0))
    values = np.where(values < top, values, np.nan)
    inlier = (shown > 0) & (np.abs(values - shown) * slope <= OUTLIER * noise)
    glossy = np.any(layers["fitted_k_s"] > 0, axis=1)
    unknowns = channels * (1 + (ambient is not None)) + glossy * (1 + (1 if problem.grey else channels))
    return Left(values, shown, slope, inlier, unknowns + 2.0 * (problem.surface.normal is None))


def with_noise(problem: MapProblem, left: Left) -> MapProblem:
    """The problem with a camera's noise, which grows with brightness, where what is left says so."""
    many = np.sum(left.inlier, axis=(0, 2))
    counts = left.inlier & (many > 2 * left.unknowns)[:, None]
    squared = (left.values - left.shown) ** 2
    dust = (ARITHMETIC * np.max(left.shown, initial=0.0, where=counts)) ** 2
    if not np.sum(squared, where=counts) > dust * np.count_nonzero(counts):
        return problem
    squared *= (many / np.maximum(many - left.unknowns, 1))[:, None]
    rounding = max(one.step for one in problem.photographs.each) / np.sqrt(12)
    growth = _growth(squared, left.shown, left.slope, counts, rounding)
    return dataclasses.replace(problem, growth=growth)


def _growth(
    squared: np.ndarray, shown: np.ndarray, slope: np.ndarray, counts: np.ndarray, rounding: float
) -> tuple[float, ...]:
    """Of a camera that counts photons: the variance is a constant and so many times the value; about 1.

    None of them where it is even in codes, or each texel has its own. What models leave that do not hold goes with the
    square of the value. ``rounding`` is what codes leave in any case.
    """
    many = np.sum(counts, axis=(0, 2))
    of_texel = np.sum(np.where(counts, squared * slope**2, 0), axis=(0, 2))[many > 0] / many[many > 0]
    many, square, value, codes = many[many > 0], squared[counts], shown[counts], slope[counts]
    least = max(np.finfo(float).eps * float(np.max(value)), rounding) ** 2
    coefficients, _ = growth_of_channel(square, value, least / float(np.max(codes)) ** 2, terms=2)
    variance = coefficients[0] + coefficients[1] * value
    # Twice minus the logarithms of likelihoods.
    growing = float(np.sum(np.log(variance) + square / variance))
    steps = square.size - 2 * float(np.sum(np.log(codes)))
    even = steps + square.size * np.log(max(np.sum(of_texel * many) / square.size, least))
    of_texels = steps + float(np.sum(many * np.log(np.maximum(of_texel, least))))
    if growing > even - RISE or growing > of_texels + NEEDLESS * many.size:
        return ()
    return tuple(float(f"{one:.{DIGITS}g}") for one in coefficients / np.median(variance))


def lights_apart(left: Left, names: Sequence[str]) -> tuple[str, ...]:
    """A note on photographs that stand apart: most of them is brighter, or darker, than what is explained.

    Of one that lies in shadow a part is as bright as that.
    """
    known = np.isfinite(left.values) & np.isfinite(left.shown)
    shown = np.where(known, left.shown, 0)
    bright = known & (shown > BRIGHT * np.max(shown, axis=(1, 2), keepdims=True))
    factor = np.ones(len(names))
    for index, some in enumerate(bright):
        if np.count_nonzero(some) >= FEWEST:
            factor[index] = np.clip(1, *np.quantile(left.values[index][some] / shown[index][some], (0.25, 0.75)))
    off = np.abs(np.log(np.maximum(factor, np.finfo(float).tiny)))
    apart = off > np.log(OTHER)
    many = np.count_nonzero(apart) > MOST_OTHERS * len(names)
    count = int(np.count_nonzero(apart & (many | (off > DEVIATIONS * float(np.median(off))))))
    if not count:
        return ()
    worst = int(np.argmax(off))
    others = f", and {count - 1} more stand apart" if count > 1 else ""
    what = f"{names[worst]} is {max(factor[worst], 0):.2g} times as bright as the others explain it{others}"
    lights = "intensities, exposures and directions of the lights"
    remedy = f"the models do not hold for this surface, or {lights} are wrong" if many else f"check {lights}"
    return (f"{what}: {remedy}",)


@functools.partial(jax.jit, static_argnums=(0, 1, 2))
def _explained(
    models: Sequence[Any],
    photographs: int,
    distant: bool,
    lights: tuple[Any, ...],
    k_d: Array,
    k_s: Array,
    n: Array,
    chosen: Array,
) -> Float[Array, "P T C"]:
    """What the materials of texels show without ambient light.

    The lights are distant ones, the view and the texels' normals; or the texels' points and what `near` takes.
    """

    def lit(texels: Texels) -> Texels:
        if not distant:
            points, stacks, occluders = lights
            return near(texels, stacks, occluders, None, points)
        to_light, to_view, normal = (Components(tuple(jnp.asarray(one, n.dtype).T)) for one in lights)
        return texels.facing(normal, Distant(to_light, normalize(to_view), ambient=None))

    diffuse, lobe, _ = columns_of(models, chosen, jnp.log(n), photographs, lit)
    return jnp.moveaxis(diffuse * k_d[:, None] + lobe * k_s[:, None], 0, 1)
