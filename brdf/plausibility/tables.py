"""Plausibility of a measured table, whose values carry noise: errors are stated in units of it.

The noise is read off the table itself. An isotropic surface shows the same to a view on either side of the plane of
incidence, so that samples of equal angles and of mirrored azimuth repeat each other; where a table holds no such pairs,
or is symmetric by its layout, its noise is not known and the check says so.
"""

import dataclasses
import math
from typing import Any

import numpy as np
from jaxtyping import Float

from brdf.measured.table import Evaluation, MeasuredBRDF, Values, from_angles
from brdf.plausibility.report import ENERGY_LIMIT, Angles, Finding, Report, Verdict, verdict

# Samples whose angles agree within this many radians are one direction: half a degree.
CELL = math.radians(0.5)
# A typical reciprocity error of up to so many units of noise passes, from so many on it fails.
PASSES, FAILS = 1.5, 3.0
# Where the noise is not known, a larger typical error than this is none that instruments make.
LARGEST_NOISE = 0.1
# Angles of light, in degrees, at which the albedo is taken.
LIGHTS = (5.0, 20.0, 35.0, 50.0, 65.0, 75.0)
# Below this the two sides of a pair agree by construction, not by measurement.
_BY_LAYOUT = 1e-5


def check_table(table: MeasuredBRDF, subject: str | None = None) -> Report:
    """Test a measured BRDF for positivity, reciprocity and energy conservation.

    Args:
        table: what `load_measured` reads.
        subject: what to call it.

    Returns:
        The report. For reciprocity the value is the typical relative error over the typical noise where that is known.
    """
    samples = table
    if table.evaluate is not None:
        random = np.random.default_rng(20)
        polar = np.arccos(random.uniform(math.cos(math.radians(75)), 1, (2, 4000)))
        light, view = from_angles(polar, random.uniform(0, 2 * np.pi, (2, 4000)))
        values = table.evaluate(light, view)
        samples = dataclasses.replace(table, to_light=light, to_view=view, values=values)
    noise = _median(_pairs(samples, exchanged=False)[1])
    # What repeats by the table's layout says nothing of its noise.
    noise = math.nan if noise < _BY_LAYOUT else noise
    return Report(subject or table.name, _positivity(table, noise), _reciprocity(samples, noise), _energy(table))


def _pairs(samples: MeasuredBRDF, *, exchanged: bool) -> tuple[np.ndarray, Values]:
    """Samples that another one ought to repeat, by their index, and the difference of the two over their mean size.

    The other has light and view exchanged, or the view mirrored at the plane of incidence, as an isotropic surface
    cannot tell.
    """
    light, view, values = samples.to_light, samples.to_view, samples.values
    if samples.evaluate is not None:
        other = view, light
        if not exchanged:
            across = np.cross(light, [0.0, 0.0, 1.0])
            across /= np.linalg.norm(across, axis=1, keepdims=True)
            other = light, view - 2 * np.sum(view * across, axis=1, keepdims=True) * across
        first, repeated = np.arange(len(light)), samples.evaluate(*other)
    else:
        a, b = (np.arctan2(np.hypot(v[:, 0], v[:, 1]), v[:, 2]) for v in (light, view))
        turn = np.arctan2(view[:, 1], view[:, 0]) - np.arctan2(light[:, 1], light[:, 0])
        turn = np.where(np.minimum(a, b) < CELL, 0.0, (turn + np.pi) % (2 * np.pi) - np.pi)
        angles = np.array([(a, b, turn), (b, a, -turn) if exchanged else (a, b, -turn)])
        cells = np.round(angles / CELL)
        cells[:, 2] %= round(2 * np.pi / CELL)
        codes, wanted = np.unique(np.concatenate(cells, axis=1), axis=1, return_inverse=True)[1].reshape(2, -1)
        known, index = np.unique(codes, return_index=True)
        place = np.minimum(np.searchsorted(known, wanted), len(known) - 1)
        # What stands on the line between the two repeats itself.
        apart = np.abs(a - b if exchanged else turn) > CELL
        first = np.flatnonzero((known[place] == wanted) & apart & (index[place] != np.arange(len(codes))))
        values, repeated = values[first], values[index[place[first]]]
    size = 0.5 * (np.abs(values) + np.abs(repeated))
    return first, np.abs(values - repeated) / np.where(size > 0, size, 1.0)


def _median(difference: Values) -> float:
    return float(np.median(difference)) if difference.size else math.nan


def _finding(
    word: Verdict, value: float, limit: float, bound: float, where: tuple[Angles, Angles | None, Any], sentence: str
) -> Finding:
    light, view, channel = where
    return Finding(word, value, limit, limit - value, bound, light, view, int(channel), sentence)


def _cannot_tell(limit: float, sentence: str) -> Finding:
    return _finding("cannot tell", math.nan, limit, math.nan, (Angles(0.0), None, 0), sentence)


def _positivity(table: MeasuredBRDF, noise: float) -> Finding:
    row, channel = np.unravel_index(np.argmin(table.values), table.values.shape)
    value = float(table.values[row, channel])
    bound = 0.0 if math.isnan(noise) else noise * float(np.median(np.abs(table.values[:, channel])))
    light, view = Angles.of(table.to_light[row]), Angles.of(table.to_view[row])
    sentence = f"no value is below 0, the least is {value:.3g}/sr"
    if value < 0:
        where = f"for light {light}, view {view}, channel {table.channels[channel]}"
        sentence = f"{table.negative} of {table.values.size} values are below 0, the least, {value:.3g}/sr, {where}"
        sentence += "" if math.isnan(noise) else f"; the noise of a typical value is {bound:.2g}/sr"
    word = verdict(value, 0.0 if value >= 0 else bound)
    return Finding(word, value, 0.0, value, bound, light, view, int(channel), sentence)


def _reciprocity(samples: MeasuredBRDF, noise: float) -> Finding:
    first, difference = _pairs(samples, exchanged=True)
    if not difference.size:
        return _cannot_tell(PASSES, "the table holds no pair of directions both ways round")
    typical = _median(difference)
    row, channel = np.unravel_index(np.argmax(difference), difference.shape)
    light, view = Angles.of(samples.to_light[first[row]]), Angles.of(samples.to_view[first[row]])
    where = light, view, channel
    if typical < _BY_LAYOUT:
        sentence = "f_r is the same when light and view change places, as the layout of the table has it"
        return _finding("pass", 0.0, PASSES, 0.0, where, sentence)
    worst = f"the largest, {100 * difference[row, channel]:.3g} %, for light {light}, view {view}"
    said, pairs = "the typical reciprocity error is", f"over {len(difference)} pairs; {worst}"
    if math.isnan(noise):
        word = "fail" if typical > LARGEST_NOISE else "cannot tell"
        sentence = (
            f"the typical reciprocity error is {100 * typical:.2g} % {pairs}; the noise is not known from the table"
        )
        return _finding(word, typical, LARGEST_NOISE, 0.0, where, sentence)
    ratio = typical / noise
    word = "pass" if ratio <= PASSES else "fail" if ratio >= FAILS else "cannot tell"
    compared = f"{ratio:.2g} times the noise ({100 * typical:.2g} % against {100 * noise:.2g} %)"
    # The median of K absolute deviations is known to within 1.2 / sqrt(K) of itself.
    bound = ratio * 1.2 / len(difference) ** 0.5
    return _finding(word, ratio, PASSES, bound, where, f"{said} {compared} {pairs}")


def _energy(table: MeasuredBRDF) -> Finding:
    if table.evaluate is None:
        return _cannot_tell(ENERGY_LIMIT, "scattered samples do not say how much light they stand for")
    coarse, fine = (np.stack([_albedo(table.evaluate, polar, fineness) for polar in LIGHTS]) for fineness in (1, 2))
    row, channel = np.unravel_index(np.argmax(fine), fine.shape)
    value, bound = float(fine[row, channel]), 2 * float(np.abs(fine - coarse)[row, channel])
    light = Angles(LIGHTS[row])
    word = verdict(ENERGY_LIMIT - value, bound)
    said = f"the largest albedo is {value:.4g} for light {light}, channel {table.channels[channel]}"
    sentence = f"does not conserve energy: {said}" if word == "fail" else said
    return _finding(word, value, ENERGY_LIMIT, bound, (light, None, channel), sentence)


def _albedo(evaluate: Evaluation, polar: float, fineness: int) -> Float[np.ndarray, " C"]:
    """Reflected share of light from one direction: midpoints in the half vector's angle, where peaks are wide."""
    light = from_angles(math.radians(polar), 0.0)
    rings, sectors = 60 * fineness, 24 * fineness
    root = (np.arange(rings) + 0.5) / rings
    azimuth = (np.arange(sectors) + 0.5) * 2 * np.pi / sectors
    theta = 0.5 * np.pi * root * root
    half = from_angles(theta[:, None], azimuth).reshape(-1, 3)
    along = half @ light
    view = 2 * along[:, None] * half - light
    seen = (along > 0) & (view[:, 2] > 0)
    cell = np.repeat(np.sin(theta) * np.pi * root / rings, sectors) * 2 * np.pi / sectors
    values = evaluate(np.broadcast_to(light, view[seen].shape), view[seen])
    return np.sum(values * (view[seen, 2] * 4 * along[seen] * cell[seen])[:, None], axis=0)
