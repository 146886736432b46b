"""The three tests of plausibility for a BRDF of which nothing is known but how to call it.

Where the lobes are, and how narrow, has to be found out. Values are taken on a grid of a quarter of a degree over the
hemisphere for several directions of the other vector, both ways round, and around the places where BRDFs have their
peaks (mirror, retro and normal direction, at all scales down to 1e-5 rad). The worst are then improved by a random
search with a fixed seed. For the energy the peaks found announce the lobes to the adaptive quadrature.

What that cannot see: a feature narrower than half a degree in light *and* view at once, away from those places.
"""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Float

from brdf.channels import in_channel
from brdf.plausibility.quadrature import integrate
from brdf.plausibility.report import (
    ENERGY_LIMIT,
    RECIPROCITY_LIMIT,
    Angles,
    Finding,
    Report,
    not_finite,
    times,
    verdict,
)
from brdf.plausibility.search import (
    GRAZING,
    Sampler,
    Scan,
    degrees,
    direction,
    directions,
    improved,
    inequality,
    lifted,
)

_COARSE = 1e-5  # tolerance of the quadrature for directions that turn out not to matter


def check_black_box(f_r: Callable[[Any, Any], Any], subject: str) -> Report:
    """Test positivity, reciprocity and energy conservation of any BRDF; see the module for how.

    Args:
        f_r: f_r(to_light, to_view) -> (C,), in 1/sr, of unit vectors in the local frame whose +z axis is the normal.
            It is traced by JAX and evaluated in float64 where it lets itself be.
        subject: what to call it in the report.

    Returns:
        The report.

    Raises:
        InputError: f_r cannot be traced or does not return one number per channel.
    """
    sample = Sampler(f_r)
    random = np.random.default_rng(20)
    scan = Scan(sample, random)
    positivity = _positivity(sample, scan, random)
    reciprocity = _reciprocity(sample, scan, random)
    energy = _energy(sample, scan, random)
    if sample.not_finite is not None:
        light, view = (_angles(v) for v in sample.not_finite)
        positivity, reciprocity, energy = (not_finite(f, light, view) for f in (positivity, reciprocity, energy))
    return Report(subject, positivity, reciprocity, energy)


def _positivity(sample: Sampler, scan: Scan, random: np.random.Generator) -> Finding:
    light, view = improved(lambda a, b: -sample(a, b).min(axis=1), scan.negative, random)
    values = sample(light, view)
    row, channel = np.unravel_index(np.argmin(values), values.shape)
    value = float(values[row, channel])
    bound = _noise(lambda a, b: sample(a, b)[:, channel], light[row], view[row], sample, random)
    limit = -1e-9 * scan.scale
    to_light, to_view = _angles(light[row]), _angles(view[row])
    word = verdict(value - limit, bound)
    where = f"for light {to_light}, view {to_view}{_channel(sample, channel)}"
    sentence = (
        f"negative: f_r is {value:.4g}/sr {where}" if word == "fail" else f"the least f_r is {value:.4g}/sr {where}"
    )
    return Finding(word, value, limit, value - limit, bound, to_light, to_view, int(channel), sentence)


def _reciprocity(sample: Sampler, scan: Scan, random: np.random.Generator) -> Finding:
    def errors(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return inequality(sample(a, b), sample(b, a), scan.scale)

    light, view = improved(lambda a, b: errors(a, b).max(axis=1), scan.unequal, random)
    values = errors(light, view)
    row, channel = np.unravel_index(np.argmax(values), values.shape)
    value = float(values[row, channel])
    bound = _noise(lambda a, b: errors(a, b)[:, channel], light[row], view[row], sample, random)
    pair = [light[row], view[row]]
    there, back = (float(sample(a[None], b[None])[0, channel]) for a, b in (pair, pair[::-1]))
    if abs(there) < abs(back):
        pair, there, back = pair[::-1], back, there
    to_light, to_view = _angles(pair[0]), _angles(pair[1])
    margin = RECIPROCITY_LIMIT - value
    word = verdict(margin, bound)
    sentence = f"f_r changes by at most {value:.2g} of its value when light and view change places"
    if word == "fail":
        compared = f"{there:.4g}/sr, but {back:.4g}/sr the other way round"
        if 0 < back < there < 1e4 * back:
            compared = f"{times(there / back)} f_r({to_view} → {to_light})"
        sentence = f"not reciprocal: f_r({to_light} → {to_view}) is {compared}{_channel(sample, channel)}"
    return Finding(word, value, RECIPROCITY_LIMIT, margin, bound, to_light, to_view, int(channel), sentence)


def _noise(
    function: Callable[[np.ndarray, np.ndarray], np.ndarray],
    light: np.ndarray,
    view: np.ndarray,
    sample: Sampler,
    random: np.random.Generator,
) -> float:
    """How much a value scatters under changes of the directions by a few roundings, which are below all real change."""
    shake = 4 * sample.epsilon * random.standard_normal((2, 64, 3))
    values = function(lifted(light + shake[0]), lifted(view + shake[1]))
    return 2 * float(np.ptp(values)) + 4 * sample.epsilon * float(np.max(np.abs(values)))


def _energy(sample: Sampler, scan: Scan, random: np.random.Generator) -> Finding:
    polars = np.array([*np.arange(0, 90, 5.0), 88.0, 89.0, 89.9, *(90.0 - np.geomspace(1e-2, 1e-8, 4))])
    azimuths = np.array([0.0]) if _isotropic(sample, scan, random) else np.arange(8) * 45.0
    lights = np.array([direction(p, a) for p in polars for a in (azimuths if p else azimuths[:1])])
    lights = np.concatenate([lights, *(light[:1] for light, _ in scan.bright)])
    albedo, bound = _albedos(sample, scan, lights, random, _COARSE)
    for step in (2.5, 0.8, 0.25, 0.08):
        top = lights[np.argmax(albedo.max(axis=1))]
        polar, azimuth = degrees(top)
        around = [(p, 0.0) for p in (-1.0, -0.5, 0.5, 1.0)]
        if len(azimuths) > 1:
            around += [(p, a) for p in (-1.0, 0.0, 1.0) for a in (-4.0, -1.5, 1.5, 4.0)]
        angles = {(min(max(polar + step * p, 0.0), max(polar, GRAZING)), azimuth + step * a) for p, a in around}
        more = np.array([direction(*pair) for pair in sorted(angles)])
        found = _albedos(sample, scan, more, random, _COARSE)
        lights = np.concatenate([lights, more])
        albedo, bound = np.concatenate([albedo, found[0]]), np.concatenate([bound, found[1]])
    tolerance = np.full(len(lights), _COARSE)
    for _ in range(60):  # sharpen those that decide, as long as they do not
        row = int(np.argmax(np.max(albedo + bound, axis=1)))
        if not _undecided(albedo, bound) or tolerance[row] < 1e-11:
            break
        tolerance[row] *= 0.02
        albedo[row], bound[row] = (x[0] for x in _albedos(sample, scan, lights[row : row + 1], random, tolerance[row]))
    fails = np.any(albedo - bound > ENERGY_LIMIT)
    row, channel = np.unravel_index(np.argmax(albedo - bound if fails else albedo + bound), albedo.shape)
    value, error = float(albedo[row, channel]), float(bound[row, channel])
    to_light = _angles(lights[row])
    word = verdict(ENERGY_LIMIT - value, error)
    sentence = f"the largest albedo is {value:.6g} for light {to_light}{_channel(sample, channel)}"
    if word == "fail":
        sentence = f"does not conserve energy: {sentence}"
    return Finding(word, value, ENERGY_LIMIT, ENERGY_LIMIT - value, error, to_light, None, int(channel), sentence)


def albedo_of(f_r: Callable[[Any, Any], Any], polar: Float[np.ndarray, " K"]) -> Float[np.ndarray, "K C"]:
    """Albedo of any BRDF for lights in the plane of azimuth 0, to about 1e-4.

    Args:
        f_r: f_r(to_light, to_view) -> (C,), as for ``check_black_box``.
        polar: angles of the light in degrees, (K,).

    Returns:
        (K, C).
    """
    sample, random = Sampler(f_r), np.random.default_rng(20)
    lights = np.array([direction(p, 0.0) for p in polar])
    return _albedos(sample, Scan(sample, random), lights, random, _COARSE)[0]


def _undecided(albedo: np.ndarray, bound: np.ndarray) -> bool:
    return bool(np.any(albedo + bound > ENERGY_LIMIT) and not np.any(albedo - bound > ENERGY_LIMIT + 1e-3))


def _isotropic(sample: Sampler, scan: Scan, random: np.random.Generator) -> bool:
    light, view = (random.permutation(directions(2048)) for _ in range(2))
    light, view = np.concatenate([light, scan.bright[0][0]]), np.concatenate([view, scan.bright[0][1]])
    there = sample(light, view)
    for angle in (0.7, 2.0, 4.4):
        turn = np.array([[math.cos(angle), -math.sin(angle), 0], [math.sin(angle), math.cos(angle), 0], [0, 0, 1]])
        if inequality(there, sample(light @ turn.T, view @ turn.T), scan.scale).max() > 1e-5:
            return False
    return True


def _albedos(
    sample: Sampler, scan: Scan, lights: np.ndarray, random: np.random.Generator, tolerance: float
) -> tuple[np.ndarray, np.ndarray]:
    """Albedos (K, C) and bounds on their errors, for lights (K, 3)."""

    def evaluate(which: np.ndarray, views: np.ndarray) -> np.ndarray:
        return sample(lights[which], views) * views[:, 2:]

    centres = _centres(sample, scan, lights, random)
    budget = 3_000_000 + 60_000 * len(lights)
    result = integrate(evaluate, len(lights), centres, tolerance=tolerance, budget=budget)
    return result.value, result.error_bound + 50 * sample.epsilon * np.abs(result.value)


def _centres(sample: Sampler, scan: Scan, lights: np.ndarray, random: np.random.Generator) -> list[np.ndarray]:
    """For each light the views where a narrow lobe may sit: the typical places, and the brightest found near by."""
    coarse = directions(2**12)
    up = np.array([[0.0, 0.0, 1.0]])
    bright_light, bright_view = (np.concatenate([pair[side] for pair in scan.bright[:18:2]]) for side in (0, 1))
    halves = lifted(bright_light + bright_view)
    starts = []
    for light in lights:
        same_half = 2 * (halves @ light)[:, None] * halves - light
        places = [light * [[-1, -1, 1]], light[None], up, bright_view, same_half[same_half[:, 2] > 0]]
        candidates = np.concatenate([coarse, *places])
        value = (sample(light[None], candidates) * candidates[:, 2:]).max(axis=1)
        order = np.argsort(-value)[:6]
        starts.append(np.concatenate([candidates[order], light * [[-1, -1, 1]]]))
    each = len(starts[0])
    pairs = [(np.repeat(lights, each, axis=0), np.concatenate(starts))]
    _, found = improved(
        lambda a, b: (sample(a, b) * b[:, 2:]).max(axis=1), pairs, random, move_light=False, rounds=25, tries=12
    )
    return [
        np.concatenate([found[i * each : (i + 1) * each], light * [[-1, -1, 1]], light[None]])
        for i, light in enumerate(lights)
    ]


def _angles(direction: np.ndarray) -> Angles:
    return Angles(*degrees(direction))


def _channel(sample: Sampler, channel: Any) -> str:
    return in_channel(int(channel), sample.channels)
