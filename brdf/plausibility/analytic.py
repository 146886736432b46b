"""Plausibility of the five models: the answers are known on paper, and the numbers only illustrate them.

* positive, because no coefficient is negative;
* Lambert and the normalised forms are reciprocal, because their lobe depends on light and view in the same way. The
  classic forms divide a symmetric lobe by N.L: for k_s > 0 not reciprocal, the more so the more grazing the light;
* the albedo of Lambert is k_d at every angle; that of the normalised forms is largest at normal incidence, k_d + k_s;
  that of the classic forms grows without bound towards grazing light for k_s > 0.
"""

import dataclasses
from typing import Any

import numpy as np

from brdf.albedo import ACCURACY, WITH_CLOSED_FORM, directional_albedo, normalized_form
from brdf.channels import in_channel
from brdf.conversions import nearest_normalized
from brdf.measured.table import from_angles
from brdf.models import Lambert, Material, SpecularMaterial
from brdf.plausibility.report import (
    ENERGY_LIMIT,
    GRAZING,
    RECIPROCITY_LIMIT,
    Angles,
    Finding,
    Report,
    judged,
    largest,
    times,
)
from brdf.precision import cast, working_precision

# What is known on paper holds for these alone; a subclass or a new model is looked at like any function.
KNOWN = (Lambert, *WITH_CLOSED_FORM)

_LIGHTS = np.array([*np.arange(90.0), 89.5, 89.9, GRAZING])
_VIEWS = np.concatenate([_LIGHTS, -_LIGHTS])  # below 0 on the other side of the normal
_UNDERFLOWS = 1e-250  # less than this of f_r has lost digits
_ROUNDING = 1e-13  # relative; float64 at n = 1e6 reaches 1e-14


def check_material(material: Material, subject: str) -> Report:
    """Test one of the five models, of known numbers."""
    with working_precision("float64"):
        double = cast(material, "float64")
        # A lobe that is not multiplied by N.L.
        classic = isinstance(material, SpecularMaterial) and not material.cosine_weighted and bool(np.any(material.k_s))
        findings = _positivity(double), _reciprocity(double, classic), _energy(double, classic)
    fails = any(finding.verdict == "fail" for finding in findings)
    return Report(subject, *findings, nearest=nearest_normalized(material) if fails else None)


def _in_plane(material: Material, light: np.ndarray, view: np.ndarray) -> np.ndarray:
    """f_r, (a, b, C), for angles of light and view in degrees, in one plane: there the five models have extremes."""
    to_light, to_view = (from_angles(np.radians(angle), 0.0) for angle in (light, view))
    return np.asarray(material.reflectance(to_light[:, None], to_view))


def _positivity(material: Material) -> Finding:
    values = _in_plane(material, _LIGHTS, _VIEWS)
    row, column, channel = largest(-values)
    value, view = float(values[row, column, channel]), float(_VIEWS[column])
    where = Angles(float(_LIGHTS[row])), Angles(abs(view), 180.0 * (view < 0)), channel
    words = f"the least f_r is {value:.4g}/sr, because no coefficient is negative"
    words += in_channel(channel, values.shape[2])
    return judged(value, 0.0, _ROUNDING * abs(value), where, words, least=True)


def _reciprocity(material: Material, classic: bool) -> Finding:
    if not classic:
        where = Angles(0.0), Angles(0.0), 0
        return judged(0.0, RECIPROCITY_LIMIT, 0.0, where, "f_r is the same when light and view change places")
    # For a given angle between light and view the difference is largest where they stand on opposite sides of the
    # normal, and the light as low as can be.
    lights, views = np.array([GRAZING]), np.geomspace(GRAZING - 90.0, -90.0, 100_001) + 90.0
    there, back = _in_plane(material, lights, -views)[0], _in_plane(material, views, -lights)[:, 0]
    # A black channel is reciprocal, and so is what underflows.
    ratio = np.divide(there, back, out=np.ones_like(there), where=back > _UNDERFLOWS)
    row, channel = largest(ratio)
    value = 1.0 - 1.0 / float(ratio[row, channel])
    light, view = Angles(GRAZING), Angles(float(views[row]), 180.0)
    a, b = f"{light.polar:.4g}°", f"{view.polar:.4g}°"
    compared = f"f_r({a}→{b}) is {times(float(ratio[row, channel]))} f_r({b}→{a})"
    if value < 2 * RECIPROCITY_LIMIT:  # a trace of k_s shows only closer to 90 degrees than the angles go
        value, light, compared = 1.0, Angles(90.0), "towards grazing light the ratio grows without bound"
    sentence = f"not reciprocal: the specular term is not multiplied by N·L; {compared}"
    sentence += in_channel(channel, there.shape[1])
    return judged(value, RECIPROCITY_LIMIT, _ROUNDING, (light, view, channel), sentence)


def _energy(material: Material, classic: bool) -> Finding:
    def reflected(angle: Any) -> np.ndarray:
        return np.asarray(directional_albedo(material, angle))

    within, beyond = 0.0, 0.5 * np.pi
    for _ in range(9 * classic):  # closer each time: the last angle of the light at which the albedo is within 1
        angles = np.linspace(within, beyond, 101)
        last = np.max(np.flatnonzero(np.max(reflected(angles), axis=1) <= 1.0), initial=0)
        within, beyond = angles[last], angles[last + 1]
    crossing = float(np.degrees(within))
    worst = max(GRAZING, 90.0 - 0.1 * (90.0 - crossing)) if classic else 0.0
    angle, light = np.radians(worst), Angles(worst)
    albedo = reflected(angle)
    channel = int(np.argmax(albedo))
    value, named = float(albedo[channel]), in_channel(channel, albedo.size)
    # towards 90 degrees the cosine knows the rounding of the angle
    bound = (_ROUNDING + np.finfo(float).eps * angle / np.cos(angle)) * abs(value)
    if isinstance(material, SpecularMaterial):
        divisor = normalized_form(type(material)).scale(float(material.n)) * np.cos(angle) if classic else 1.0
        bound += ACCURACY["float64"] * np.asarray(material.k_s)[channel] / divisor
    words = f"the largest albedo is {value:.7g}, for light at {light}"
    if classic and np.asarray(material.k_s)[channel] > 0:
        first = int(np.argmax(reflected(beyond)))
        where = "" if first == channel else f"{in_channel(first, albedo.size)},"
        words = f"the albedo exceeds 1 for light beyond {Angles(crossing)}{where} and grows without bound"
        if value > ENERGY_LIMIT + bound:
            words += f", to {value:.3g} at {light}"
        else:  # a trace of k_s shows only closer to 90 degrees than numbers go
            value, bound, light = float(np.finfo(float).max), 0.0, Angles(90.0)
    failed = f"does not conserve energy: {words}{named}"
    finding = judged(value, ENERGY_LIMIT, float(bound), (light, None, channel), words + named, failed)
    return dataclasses.replace(finding, crossing=crossing if value > ENERGY_LIMIT + bound else None)
