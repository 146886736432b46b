"""Plausibility of a measured table, whose values carry noise: errors are stated in units of it.

The noise is read off the table itself. An isotropic surface shows the same to a view on either side of the plane of
incidence, so that samples of equal angles and of mirrored azimuth repeat each other; where a table holds no such pairs,
or is symmetric by its layout, its noise is not known and the check says so.
"""

import dataclasses
import math

import numpy as np

from brdf.measured.table import Evaluation, MeasuredBRDF, from_angles, to_angles
from brdf.plausibility.numeric import MIRRORED, fibonacci, integrate
from brdf.plausibility.report import ENERGY_LIMIT, Angles, Finding, Report, judged, largest
from brdf.vectors import quotient

# Samples whose angles agree within this many radians are one direction: half a degree.
CELL = math.radians(0.5)
# A typical reciprocity error of up to so many units of noise passes, from so many on it fails.
PASSES, FAILS = 1.5, 3.0
# Where the noise is not known, a larger typical error than this is none that instruments make.
LARGEST_NOISE = 0.1
# Angles of light, in degrees, at which the albedo is taken: beyond, instruments see little, and tables are filled in.
LIGHTS = (5.0, 20.0, 35.0, 50.0, 65.0, 75.0)
# Tolerance of the quadrature, and how many values it may take for each of them.
_QUADRATURE = 1e-3, 10_000
# Where views that were not measured are looked for, and how many times as bright as what was measured next to them they
# may be.
_VIEWS, _BRIGHTER = 2**13, 3.0
# Below this the two sides of a pair agree by construction, not by measurement.
_BY_LAYOUT = 1e-5


def check_table(table: MeasuredBRDF, subject: str | None = None) -> Report:
    """Test a measured BRDF for positivity, reciprocity and energy conservation.

    For reciprocity the value is the typical relative error over the typical noise where that is known.
    """
    samples = table
    if table.evaluate is not None:
        random = np.random.default_rng(20)
        polar = np.arccos(random.uniform(math.cos(math.radians(LIGHTS[-1])), 1, (2, 4000)))
        light, view = from_angles(polar, random.uniform(0, 2 * np.pi, (2, 4000)))
        samples = dataclasses.replace(table, to_light=light, to_view=view, values=table.evaluate(light, view))
    _, repeats = _pairs(samples, exchanged=False)
    typical = float(np.median(repeats)) if repeats.size else 0.0
    # What repeats by the table's layout says nothing of its noise.
    noise = math.nan if typical < _BY_LAYOUT else typical
    return Report(subject or table.name, _positivity(table, noise), _reciprocity(samples, noise), _energy(table))


def _pairs(samples: MeasuredBRDF, *, exchanged: bool) -> tuple[np.ndarray, np.ndarray]:
    """Samples that another one ought to repeat, by their index, and the difference of the two over their mean size.

    The other has light and view exchanged, or the view mirrored at the plane of incidence, as an isotropic surface
    cannot tell.
    """
    light, view, values = samples.to_light, samples.to_view, samples.values
    (a, start), (b, end) = map(to_angles, (light, view))
    if samples.evaluate is not None:
        first = np.arange(len(light))
        repeated = samples.evaluate(*((view, light) if exchanged else (light, from_angles(b, 2 * start - end))))
    else:
        turn = np.where(np.minimum(a, b) < CELL, 0.0, (end - start + np.pi) % (2 * np.pi) - np.pi)
        cells = np.round(np.array([(a, b, turn), (b, a, -turn) if exchanged else (a, b, -turn)]) / CELL)
        cells[:, 2] %= round(2 * np.pi / CELL)
        own, wanted = (list(map(tuple, each.T)) for each in cells)
        rows = {cell: row for row, cell in enumerate(own)}
        partner = np.array([rows.get(cell, -1) for cell in wanted])
        # What stands on the line between the two repeats itself.
        apart = np.abs(a - b if exchanged else turn) > CELL
        first = np.flatnonzero(apart & (partner >= 0) & (partner != np.arange(len(partner))))
        values, repeated = values[first], values[partner[first]]
    known = np.all(np.isfinite(values + repeated), axis=1)
    first, values, repeated = first[known], values[known], repeated[known]
    return first, quotient(np.abs(values - repeated), 0.5 * (np.abs(values) + np.abs(repeated)))


def _positivity(table: MeasuredBRDF, noise: float) -> Finding:
    row, channel = largest(-table.values)
    value, bound = float(table.values[row, channel]), 0.0
    light, view = Angles.of(table.to_light[row]), Angles.of(table.to_view[row])
    sentence = f"no value is below 0, the least is {value:.3g}/sr"
    if value < 0:
        why = f", {table.below_zero}" if table.below_zero else ""
        sentence = f"{table.negative} of {table.values.size} values are below 0{why}; the least, {value:.3g}/sr, "
        sentence += f"for light {light}, view {view}, channel {table.channels[channel]}"
        if not math.isnan(noise):
            bound = noise * float(np.median(np.abs(table.values[:, channel])))
            sentence += f"; the noise of a typical value is {bound:.2g}/sr"
    return judged(value, 0.0, bound, (light, view, channel), sentence, least=True)


def _reciprocity(samples: MeasuredBRDF, noise: float) -> Finding:
    first, difference = _pairs(samples, exchanged=True)
    if not difference.size:
        return _cannot_tell(PASSES, "the table holds no pair of directions both ways round")
    typical, (row, channel) = float(np.median(difference)), largest(difference)
    light, view = Angles.of(samples.to_light[first[row]]), Angles.of(samples.to_view[first[row]])
    where = light, view, channel
    if typical < _BY_LAYOUT:
        sentence = "f_r is the same when light and view change places, as the layout of the table has it"
        return judged(0.0, PASSES, 0.0, where, sentence)
    most = f"the largest, {100 * difference[row, channel]:.3g} %, for light {light}, view {view}"
    said = f"the typical reciprocity error is {{}} over {len(difference)} pairs; {most}".format
    if math.isnan(noise):
        word = "fail" if typical > LARGEST_NOISE else "cannot tell"
        sentence = said(f"{100 * typical:.2g} %") + "; the noise is not known from the table"
        return Finding(word, typical, LARGEST_NOISE, LARGEST_NOISE - typical, 0.0, *where, sentence)
    ratio = typical / noise
    word = "pass" if ratio <= PASSES else "fail" if ratio >= FAILS else "cannot tell"
    # The median of K absolute deviations is known to within 1.2 / sqrt(K) of itself.
    bound = ratio * 1.2 / len(difference) ** 0.5
    sentence = said(f"{ratio:.2g} times the noise ({100 * typical:.2g} % against {100 * noise:.2g} %)")
    return Finding(word, ratio, PASSES, PASSES - ratio, bound, *where, sentence)


def _cannot_tell(limit: float, sentence: str) -> Finding:
    return judged(math.nan, limit, math.nan, (Angles(0.0), None, 0), sentence)


def _energy(table: MeasuredBRDF) -> Finding:
    """What was measured reflects this much at least; the error bound holds what the rest may add."""
    if table.evaluate is None:
        return _cannot_tell(ENERGY_LIMIT, "scattered samples do not say how much light they stand for")
    lights = from_angles(np.radians(LIGHTS), 0.0)
    evaluate, centres = table.evaluate, np.stack([lights * MIRRORED, lights], axis=1)

    def measured(which, views):
        """Of f_r (N.V)."""
        values = evaluate(lights[which], views)
        return np.where(np.isfinite(values), values, 0.0) * views[:, 2:]

    albedo, bounds = integrate(measured, centres, *_QUADRATURE)
    rest = [_not_measured(evaluate, *each) for each in zip(lights, centres, strict=True)]
    reach = bounds + np.array([most for most, _ in rest])
    row, channel = largest(albedo)
    failed = albedo[row, channel] - bounds[row, channel] > ENERGY_LIMIT
    unsure = not failed and np.any(albedo + reach > ENERGY_LIMIT)
    if failed:
        reach = bounds
    elif unsure:
        row, channel = largest(albedo + reach)
    value, bound, light = float(albedo[row, channel]), float(reach[row, channel]), Angles(LIGHTS[row])
    where = f"light {light}, channel {table.channels[channel]}"
    said = f"the largest albedo of light up to {LIGHTS[-1]:g}° is {value:.4g}, for {where}"
    if unsure and rest[row][1]:
        said = f"the albedo for {where}, is at least {value:.4g}; {rest[row][1]}"
    return judged(value, ENERGY_LIMIT, bound, (light, None, channel), said, f"does not conserve energy: {said}")


def _not_measured(evaluate: Evaluation, light: np.ndarray, peaks: np.ndarray) -> tuple[np.ndarray, str]:
    """What albedo the views of a light that were not measured may add, (C,), and in words which share they are.

    They are up to ``_BRIGHTER`` times as bright as the nearest that was measured; where a peak would be they may
    reflect all the light.
    """
    views = np.concatenate([peaks, fibonacci(_VIEWS)])
    values = evaluate(np.broadcast_to(light, views.shape), views)
    known = np.all(np.isfinite(values), axis=1)
    if known.all():
        return np.zeros(values.shape[1]), ""
    gone, solid_angle = views[~known], 2 * np.pi / _VIEWS
    share = np.sum(gone[:, 2]) * solid_angle / np.pi
    words = f"{100 * share:.2g} % of its views, by their cosine, are not measured"
    if not known[: len(peaks)].all():
        return np.ones(values.shape[1]), words + ", among them one that may show a peak"
    from scipy.spatial import KDTree  # it takes long to load

    beside = np.maximum(values[known][KDTree(views[known]).query(gone)[1]], 0.0)
    return _BRIGHTER * solid_angle * gone[:, 2] @ beside, words
