"""Plausibility of a measured table, whose values carry noise: errors are stated in units of it.

The noise is read off the table itself. An isotropic surface shows the same to a view on either side of the plane of
incidence, so that samples of equal angles and of mirrored azimuth repeat each other; where a table holds no such pairs,
or is symmetric by its layout, its noise is not known and the check says so.
"""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from brdf.measured.table import Evaluation, MeasuredBRDF, from_angles
from brdf.plausibility.report import ENERGY_LIMIT, Angles, Finding, Report, verdict

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


class _Pairs(NamedTuple):
    """Relative differences of values that ought to be equal.

    Attributes:
        first: index of a sample, (K,).
        second: index of its partner, (K,).
        difference: |a - b| over the mean of |a| and |b|, the largest of all channels' medians apart, (K, C).
    """

    first: np.ndarray
    second: np.ndarray
    difference: Float[np.ndarray, "K C"]

    @property
    def typical(self) -> float:
        """Median over pairs and channels; NaN without pairs."""
        return float(np.median(self.difference)) if self.difference.size else math.nan


def check_table(table: MeasuredBRDF, subject: str | None = None) -> Report:
    """Test a measured BRDF for positivity, reciprocity and energy conservation.

    Args:
        table: what `load_measured` reads.
        subject: what to call it.

    Returns:
        The report. For reciprocity the value is the typical relative error over the typical noise where that is known.
    """
    light, view, values = table.to_light, table.to_view, table.values
    if table.evaluate is not None:
        light, view = _random_directions()
        values = table.evaluate(light, view)
    noise = _repeated(table, light, view, values)
    return Report(
        subject or table.name,
        _positivity(table, noise),
        _reciprocity(table, light, view, values, noise),
        _energy(table),
    )


def _random_directions() -> tuple[Float[np.ndarray, "P 3"], Float[np.ndarray, "P 3"]]:
    random = np.random.default_rng(20)
    polar = np.arccos(random.uniform(math.cos(math.radians(75)), 1, (2, 4000)))
    azimuth = random.uniform(0, 2 * np.pi, (2, 4000))
    return from_angles(polar[0], azimuth[0]), from_angles(polar[1], azimuth[1])


def _angles_of(light: Float[np.ndarray, "P 3"], view: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "P 3"]:
    """Polar angle of light and view, and azimuth of the view from the light's, from -pi to pi."""
    polar = [np.arctan2(np.hypot(v[:, 0], v[:, 1]), v[:, 2]) for v in (light, view)]
    turn = np.arctan2(view[:, 1], view[:, 0]) - np.arctan2(light[:, 1], light[:, 0])
    turn = (turn + np.pi) % (2 * np.pi) - np.pi
    return np.stack([*polar, np.where(np.minimum(*polar) < CELL, 0.0, turn)], axis=-1)


def _matches(angles: Float[np.ndarray, "P 3"], wanted: Float[np.ndarray, "P 3"]) -> tuple[np.ndarray, np.ndarray]:
    """Samples whose angles are those wanted by another, each with one partner."""
    keys = np.round(angles / CELL).astype(np.int64)
    codes = _codes(keys)
    order = np.argsort(codes, kind="stable")
    looked_up = _codes(np.round(wanted / CELL).astype(np.int64))
    place = np.minimum(np.searchsorted(codes[order], looked_up), len(order) - 1)
    partner = order[place]
    found = (codes[partner] == looked_up) & (partner != np.arange(len(order)))
    return np.flatnonzero(found), partner[found]


def _codes(keys: np.ndarray) -> np.ndarray:
    turns = round(2 * np.pi / CELL)
    return (keys[:, 0] * 4 * turns + keys[:, 1]) * 4 * turns + keys[:, 2] % turns


def _differences(a: Float[np.ndarray, "K C"], b: Float[np.ndarray, "K C"]) -> Float[np.ndarray, "K C"]:
    size = 0.5 * (np.abs(a) + np.abs(b))
    return np.abs(a - b) / np.where(size > 0, size, 1.0)


def _repeated(
    table: MeasuredBRDF,
    light: Float[np.ndarray, "P 3"],
    view: Float[np.ndarray, "P 3"],
    values: Float[np.ndarray, "P C"],
) -> float:
    """Typical relative difference of samples that repeat each other by symmetry; NaN where that is not known."""
    angles = _angles_of(light, view)
    if table.evaluate is not None:
        # Only the difference of the azimuths counts for what is isotropic.
        azimuth = np.arctan2(light[:, 1], light[:, 0]) - angles[:, 2]
        mirrored = table.evaluate(light, from_angles(angles[:, 1], azimuth))
        typical = float(np.median(_differences(values, mirrored)))
    else:
        wanted = angles * [1, 1, -1]
        first, second = _matches(angles, wanted)
        apart = np.abs(angles[first, 2]) > CELL
        typical = _Pairs(first, second, _differences(values[first[apart]], values[second[apart]])).typical
    return math.nan if typical < _BY_LAYOUT else typical


def _positivity(table: MeasuredBRDF, noise: float) -> Finding:
    row, channel = np.unravel_index(np.argmin(table.values), table.values.shape)
    value = float(table.values[row, channel])
    bound = 0.0 if math.isnan(noise) else noise * float(np.median(np.abs(table.values[:, channel])))
    light, view = _named(table.to_light[row]), _named(table.to_view[row])
    word = verdict(value, 0.0 if value >= 0 else bound)
    where = f"for light {light}, view {view}, channel {table.channels[channel]}"
    if value >= 0:
        sentence = f"no value is below 0, the least is {value:.3g}/sr"
    else:
        of = f"{table.negative} of {table.values.size} values are below 0, the least, {value:.3g}/sr, {where}"
        sentence = of if math.isnan(noise) else f"{of}; the noise of a typical value is {bound:.2g}/sr"
    return Finding(word, value, 0.0, value, bound, light, view, int(channel), sentence)


def _reciprocity(
    table: MeasuredBRDF,
    light: Float[np.ndarray, "P 3"],
    view: Float[np.ndarray, "P 3"],
    values: Float[np.ndarray, "P C"],
    noise: float,
) -> Finding:
    if table.evaluate is not None:
        first = second = np.arange(len(light))
        difference = _differences(values, table.evaluate(view, light))
    else:
        angles = _angles_of(light, view)
        first, second = _matches(angles, angles[:, [1, 0, 2]] * [1, 1, -1])
        other = np.abs(angles[first, 0] - angles[first, 1]) > CELL
        first, second = first[other], second[other]
        difference = _differences(values[first], values[second])
    if not difference.size:
        nothing = {"value": math.nan, "margin": math.nan, "error_bound": math.nan, "to_view": None, "channel": 0}
        words = "the table holds no pair of directions both ways round"
        return Finding("cannot tell", limit=PASSES, to_light=Angles(0.0), sentence=words, **nothing)
    typical = float(np.median(difference))
    row, channel = np.unravel_index(np.argmax(difference), difference.shape)
    to_light, to_view = _named(light[first[row]]), _named(view[first[row]])
    worst = f"the largest, {100 * difference[row, channel]:.3g} %, for light {to_light}, view {to_view}"
    pairs = f"over {len(difference)} pairs; {worst}"
    if typical < _BY_LAYOUT:
        sentence = "f_r is the same when light and view change places, as the layout of the table has it"
        return Finding("pass", 0.0, PASSES, PASSES, 0.0, to_light, to_view, int(channel), sentence)
    if math.isnan(noise):
        word = "fail" if typical > LARGEST_NOISE else "cannot tell"
        sentence = (
            f"the typical reciprocity error is {100 * typical:.2g} % {pairs}; the noise is not known from the table"
        )
        return Finding(
            word, typical, LARGEST_NOISE, LARGEST_NOISE - typical, 0.0, to_light, to_view, int(channel), sentence
        )
    ratio = typical / noise
    word = "pass" if ratio <= PASSES else "fail" if ratio >= FAILS else "cannot tell"
    compared = f"{ratio:.2g} times the noise ({100 * typical:.2g} % against {100 * noise:.2g} %)"
    sentence = f"the typical reciprocity error is {compared} {pairs}"
    # The median of K absolute deviations is known to within 1.2 / sqrt(K) of itself.
    bound = ratio * 1.2 / len(difference) ** 0.5
    return Finding(word, ratio, PASSES, PASSES - ratio, bound, to_light, to_view, int(channel), sentence)


def _energy(table: MeasuredBRDF) -> Finding:
    if table.evaluate is None:
        words = "scattered samples do not say how much light they stand for"
        nothing = {"value": math.nan, "margin": math.nan, "error_bound": math.nan, "to_view": None, "channel": 0}
        return Finding("cannot tell", limit=ENERGY_LIMIT, to_light=Angles(0.0), sentence=words, **nothing)
    fine = np.stack([_albedo(table.evaluate, polar, 2) for polar in LIGHTS])
    coarse = np.stack([_albedo(table.evaluate, polar, 1) for polar in LIGHTS])
    row, channel = np.unravel_index(np.argmax(fine), fine.shape)
    value, bound = float(fine[row, channel]), 2 * float(np.abs(fine - coarse)[row, channel])
    to_light = Angles(LIGHTS[row])
    word = verdict(ENERGY_LIMIT - value, bound)
    said = f"the largest albedo is {value:.4g} for light {to_light}, channel {table.channels[channel]}"
    sentence = f"does not conserve energy: {said}" if word == "fail" else said
    return Finding(word, value, ENERGY_LIMIT, ENERGY_LIMIT - value, bound, to_light, None, int(channel), sentence)


def _albedo(evaluate: Evaluation, polar: float, fineness: int) -> Float[np.ndarray, " C"]:
    """Reflected share of light from one direction: midpoints in the half vector's angle, where peaks are wide."""
    light = from_angles(math.radians(polar), 0.0)
    count = 60 * fineness, 24 * fineness
    root = (np.arange(count[0]) + 0.5) / count[0]
    azimuth = (np.arange(count[1]) + 0.5) * 2 * np.pi / count[1]
    theta = 0.5 * np.pi * root * root
    half = from_angles(theta[:, None], azimuth[None, :]).reshape(-1, 3)
    along = half @ light
    view = 2 * along[:, None] * half - light
    seen = (along > 0) & (view[:, 2] > 0)
    cell = np.repeat(np.sin(theta) * np.pi * root / count[0], count[1]) * 2 * np.pi / count[1]
    values = evaluate(np.broadcast_to(light, view[seen].shape), view[seen])
    return np.sum(values * (view[seen, 2] * 4 * along[seen] * cell[seen])[:, None], axis=0)


def _named(direction: Float[np.ndarray, "3"]) -> Angles:
    x, y, z = map(float, direction)
    return Angles(math.degrees(math.atan2(math.hypot(x, y), z)), math.degrees(math.atan2(y, x)) % 360)
