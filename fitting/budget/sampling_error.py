"""How far a cheap fit is from the dear one, told beforehand: from a few pixels of the cheap fit alone.

At the optimum θ of a cheap fit, with the normal matrix H, residual r and derivatives J of its parameters
(`fitting.budget.linear_system`), everything that makes the fit cheap is a shift of θ to first order:

* pixels left out: their scores w Jᵀr are missing. The variance V of that sum gives the covariance H⁻¹ V H⁻¹ of θ. Where
  the model is exact and there is no noise, no pixel is missed.
* light samples left out: H⁻¹ Jᵀ (fine − coarse), the model with more light samples less the model with those used.
* rounding: the Newton step that is left when the model is evaluated in float64, or, where few pixels are looked at,
  H⁻¹ Jᵀ (double − single).
* shadows in float32: their rays start higher above the surface, which moves a shadow's edge over a few pixels. Which,
  is told by lifting the points many times as far: each pixel that then crosses an edge stands for so many fewer.

The first and the last are random, and are told as the median and the 95 % quantile of what they do; the others are
added to them.
"""

import functools
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float

import brdf
from brdf.precision import Precision, working_precision
from fitting.budget.linear_system import System
from fitting.budget.pixel_sampling import traceable
from fitting.budget.probes import columns_in, crossed, difference, shadow_changes
from fitting.solver.profile import Optimum

DRAWS = 512
# Columns of length 1 that leave less than this of one another make float32 lose most of its digits.
DEPENDENT = 0.01
# Shadow rays start so many rounding errors above the surface (`brdf.geometry.visibility`), relative to coordinates.
RAY_START = 300
# A shift of a shadow's edge by that much is seen by few pixels: they are lifted so many times as far.
LIFT = 512
# Pixels among which those at the edges of shadows are looked for.
AT_EDGES = 8192
# What light samples leave out is told to first order only: the bound allows for this factor.
MARGIN = 2.0
# What a sum of so many samples is compared with: the next step, as a factor.
STEP = 4


class Shifts(NamedTuple):
    """By how much the parameters of a cheap fit are off.

    The parameters are x_a, x_d, x_s, channel after channel each, and log n: (P,).

    Attributes:
        drawn: random shifts by the pixels left out, (D, P).
        shadows: random shifts by the pixels at the edges of shadows, (D, P).
        light: shift by the light samples left out, (P,).
        rounding: by rounding, (P,).
    """

    drawn: Float[np.ndarray, "D P"]
    shadows: Float[np.ndarray, "D P"]
    light: Float[np.ndarray, " P"]
    rounding: Float[np.ndarray, " P"]


class Estimate(NamedTuple):
    """The error of a cheap fit, relative: see `fitting.budget.deviation`.

    Attributes:
        error: its median.
        bound: not exceeded in 95 % of cases.
        pixels: the part (bound) of the pixels left out.
        light: the part of the light samples left out.
        rounding: the part of rounding.
    """

    error: float
    bound: float
    pixels: float
    light: float
    rounding: float


def rounding_by_rule(n: float, precision: Precision) -> float:
    """What rounding does to a fit of all pixels, of no more account than its order of magnitude.

    A few units in the last place, more for a lobe so narrow that the rounding of directions counts against its width.

    Args:
        n: exponent.
        precision: of the fit.
    """
    return float(np.finfo(precision).eps * (3 + 0.01 * np.sqrt(max(n, 0.0))))


def nearly_dependent(optimum: Optimum) -> bool:
    """Whether the columns of a fit so nearly add up to one another that float32 cannot tell what they add up to.

    Args:
        optimum: of the fit.
    """
    matrices = optimum.gauss_newton
    square = np.einsum("cii->ci", matrices)
    size = np.sqrt(np.where(square > 0, square, 1.0))
    # A column of nothing depends on none.
    normed = matrices / (size[:, :, None] * size[:, None, :]) + np.where(square > 0, 0.0, 1.0)[:, :, None] * np.eye(4)
    return bool(np.any(np.linalg.eigvalsh(normed) < DEPENDENT**2))


def _shifts(system: System, finer: int | None = None, *, measured: bool = True) -> Shifts:
    """By how much the parameters are off.

    Args:
        system: of the cheap fit.
        finer: the number of light samples to compare with; None where no light has samples to choose.
        measured: whether what rounding does is measured; 0 where not.
    """
    # What the bound held back is part of it: without it such a coefficient would be off by chance alone.
    held = np.where(system.bound, system.step, 0.0)
    covariance = system.inverse @ system.spread @ system.inverse
    value, vector = np.linalg.eigh(covariance)
    root = vector * np.sqrt(np.maximum(value, 0.0))
    draws = _normal_draws(value.size) @ root.T
    drawn = _settled(system, draws + system.inverse @ held) - _settled(system, (system.inverse @ held)[None])
    nothing = np.zeros(value.size)
    light = nothing if finer is None else system.inverse @ _of_light(system, None, finer)
    if not measured or system.run.result.precision == "float64":
        rounding = nothing
    elif system.many or system.skipped:
        rounding = system.inverse @ _of_rounding(system)
    else:
        rounding = system.inverse @ np.where(system.bound, 0.0, system.step)
    return Shifts(drawn, _of_shadows(system), light, rounding)


@functools.cache
def _normal_draws(size: int) -> Float[np.ndarray, "D P"]:
    return np.random.default_rng(0).standard_normal((DRAWS, size))


def _of_shadows(system: System) -> Float[np.ndarray, "D P"]:
    """Random shifts by pixels that float32 puts on the other side of a shadow's edge."""
    size = 3 * system.channels + 1
    shifts = np.zeros((DRAWS, size))
    if not system.shadows or system.run.result.precision == "float64":
        return shifts
    random = np.random.default_rng(1)
    lift = LIFT * RAY_START * float(np.finfo(np.float32).eps)
    for index in range(len(system.parts)):
        part = system.part(index, AT_EDGES // len(system.parts), brdf.Lambert)
        with working_precision("float64"):
            scene, pixel = system.traced(index, part, "float64")
            n, x = np.asarray(max(system.optimum.n, 1e-3)), system.optimum.x
            found = np.asarray(shadow_changes(system.model, scene, pixel, lift, part.weight, n, x))
        at_edge = np.flatnonzero(np.any(found, axis=(1, 2)))
        # So many pixels of the fit each one of these stands for.
        stands_for = part.sample.stands_for[at_edge] if part.complete else np.full(at_edge.size, part.stride)
        effect = np.zeros((at_edge.size, size))
        for channel, place in enumerate(system.places):
            effect[:, place] += found[at_edge, channel] * np.array([1.0, 1.0, 1.0, x[2, channel]])
        crossings = random.poisson(stands_for / LIFT, (DRAWS, at_edge.size))
        shifts += crossings @ (effect / stands_for[:, None])
    return shifts @ system.inverse


def _settled(system: System, draws: Float[np.ndarray, "D P"]) -> Float[np.ndarray, "D P"]:
    """Coefficients at their bound leave it upwards only."""
    return np.where(system.bound, np.maximum(draws, 0.0), draws)


def _of_light(system: System, coarse: int | None, fine: int) -> Float[np.ndarray, " P"]:
    """Products of the derivatives with what more light samples change."""
    total = np.zeros(3 * system.channels + 1)
    for index, part in enumerate(system.parts):
        with working_precision("float64"):
            scene, pixel = system.light.scenes[index], part.sample.pixel.astype(np.int32)
            if traceable(scene):
                few, many = (system.lamps.with_samples(scene, samples) for samples in (coarse, fine))
            else:
                few, many = (system.place(index, part, samples, "float64") for samples in (coarse, fine))
                pixel = None
            n, x = np.asarray(max(system.optimum.n, 1e-3)), system.optimum.x
            found = np.asarray(difference(system.model, few, many, pixel, part.weight, n, x))
        for channel, place in enumerate(system.places):
            total[place] += found[channel] * np.array([1.0, 1.0, 1.0, system.optimum.x[2, channel]])
    return total


def _of_rounding(system: System) -> Float[np.ndarray, " P"]:
    """Products of the derivatives with what float64 changes."""
    return np.sum([_of_single(system, index, part.weight) for index, part in enumerate(system.parts)], axis=0)


def _of_single(system: System, index: int, weight: np.ndarray) -> Float[np.ndarray, " P"]:
    """What float32 changes, told by the products of the columns with the model in both precisions."""
    found = []
    for precision in ("float64", "float32"):
        with working_precision(precision):
            scene, pixel = system.traced(index, system.parts[index], precision)
            n = np.float64(max(system.optimum.n, 1e-3))
            shape = (weight.size, system.channels)
            columns, seen = jax.device_get(columns_in(system.model, scene, pixel, n, shape, precision))
        picture = np.einsum("mck,kc->mc", columns[..., :3].astype(np.float64), system.optimum.x)
        found.append((columns.astype(np.float64), picture, seen))
    (columns, double, seen), (others, single, _) = found
    if system.shadows:
        # A pixel that is lit in one and not in the other is told of by `_of_shadows`.
        seen = seen & ~np.asarray(crossed(columns, others))
    products = np.einsum("m,mci,mc->ci", np.where(seen, weight, 0.0), columns, single - double)
    total = np.zeros(3 * system.channels + 1)
    for channel, place in enumerate(system.places):
        total[place] -= products[channel] * np.array([1.0, 1.0, 1.0, system.optimum.x[2, channel]])
    return total


def light_error(system: System, samples: int, finer: int) -> float:
    """What so many samples of each light leave out, told by more of them at the parameters of this fit.

    Args:
        system: of the cheap fit.
        samples: of each light.
        finer: more of them.
    """
    return float(system.relative(system.inverse @ _of_light(system, samples, finer)))


def estimate(system: System, finer: int | None = None, *, rule: float | None = None) -> Estimate:
    """The error of the fit.

    Args:
        system: of the cheap fit.
        finer: the number of light samples to compare with; None where no light has samples to choose.
        rule: what rounding does, where its order of magnitude is enough to know; None measures it.
    """
    shifts = _shifts(system, finer, measured=rule is None)
    together = alone = system.relative(shifts.drawn)
    light, rounding = float(system.relative(shifts.light)), float(system.relative(shifts.rounding))
    if shifts.shadows.any():
        rounding = max(rounding, float(np.quantile(system.relative(shifts.shadows), 0.95)))
    if light or rounding:
        together = system.relative(shifts.drawn + shifts.shadows + shifts.light + shifts.rounding)
    if rule is not None:
        together, rounding = np.hypot(together, rule), max(rounding, rule)
    middle, bound = map(float, np.quantile(together, [0.5, 0.95]))
    return Estimate(middle, bound + (MARGIN - 1) * light, float(np.quantile(alone, 0.95)), light, rounding)
