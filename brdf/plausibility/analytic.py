"""Plausibility of the five models: the answers are known on paper, and the numbers only illustrate them.

* positive, because no coefficient is negative;
* Lambert and the normalised forms are reciprocal, because their lobe depends on light and view in the same way. The
  classic forms divide a symmetric lobe by N.L: for k_s > 0 not reciprocal, the more so the more grazing the light;
* the albedo of Lambert is k_d at every angle; that of the normalised forms is largest at normal incidence, k_d + k_s;
  that of the classic forms grows without bound towards grazing light for k_s > 0.
"""

import math

import jax
import numpy as np

from brdf.albedo import ACCURACY, directional_albedo, lobe_albedo, normalized_form
from brdf.channels import in_channel
from brdf.conversions import nearest_normalized
from brdf.measured.table import from_angles
from brdf.models import BlinnPhong, Lambert, Material, NormalizedBlinnPhong, NormalizedPhong, Phong, SpecularMaterial
from brdf.plausibility.report import ENERGY_LIMIT, GRAZING, RECIPROCITY_LIMIT, Angles, Finding, Report, judged, times
from brdf.precision import cast, working_precision

# What is known on paper holds for these alone; a subclass or a new model is looked at like any function.
KNOWN = (Lambert, Phong, BlinnPhong, NormalizedPhong, NormalizedBlinnPhong)

_LIGHTS = np.array([*np.arange(90.0), 89.5, 89.9, GRAZING])
_VIEWS = np.concatenate([_LIGHTS, -_LIGHTS])  # below 0 on the other side of the normal
_ROUNDING = 1e-13  # relative; float64 at n = 1e6 reaches 1e-14


def check_material(material: Material, subject: str) -> Report:
    """Test one of the five models.

    Args:
        material: of known numbers.
        subject: what to call it in the report.
    """
    with working_precision("float64"):
        double = cast(material, "float64")
        classic = isinstance(double, SpecularMaterial) and not double.cosine_weighted and bool(np.any(double.k_s != 0))
        if classic:
            findings = _positivity(double), _classic_reciprocity(double), _classic_energy(double)
        else:
            findings = _positivity(double), _reciprocity(), _energy(double)
    fails = any(finding.verdict == "fail" for finding in findings)
    return Report(subject, *findings, nearest=nearest_normalized(material) if fails else None)


def _positivity(material: Material) -> Finding:
    values = _in_plane(material, _LIGHTS, _VIEWS)
    row, column, channel = map(int, np.unravel_index(np.argmin(values), values.shape))
    value = float(values[row, column, channel])
    light, view = Angles(_LIGHTS[row]), Angles(abs(_VIEWS[column]), 180.0 * (_VIEWS[column] < 0))
    named = in_channel(channel, values.shape[2])
    passed = f"the least f_r is {value:.4g}/sr, because no coefficient is negative{named}"
    failed = f"negative: f_r is {value:.4g}/sr for light {light}, view {view}{named}"
    return judged(value, 0.0, _ROUNDING * abs(value), (light, view, channel), passed, failed, least=True)


def _reciprocity() -> Finding:
    normal = Angles(0.0)
    return judged(0.0, RECIPROCITY_LIMIT, 0.0, (normal, normal, 0), "f_r is the same when light and view change places")


def _classic_reciprocity(material: SpecularMaterial) -> Finding:
    # For a given angle between light and view the difference is largest where they stand on opposite sides of the
    # normal, and the light as low as can be.
    lights, views = np.array([GRAZING]), np.geomspace(GRAZING - 90.0, -90.0, 100_001) + 90.0
    there, back = _in_plane(material, lights, -views)[0], _in_plane(material, views, -lights)[:, 0]
    difference = 1.0 - back / there
    row, channel = map(int, np.unravel_index(np.argmax(difference), difference.shape))
    value, light, view = float(difference[row, channel]), Angles(GRAZING), Angles(views[row], 180.0)
    a, b = f"{light.polar:.4g}°", f"{view.polar:.4g}°"
    ratio = float(there[row, channel] / max(back[row, channel], 1e-300))
    compared = f"f_r({a}→{b}) is {times(ratio)} f_r({b}→{a})"
    if value < 2 * RECIPROCITY_LIMIT:  # a trace of k_s shows only closer to 90 degrees than the angles go
        value, light, compared = 1.0, Angles(90.0), "towards grazing light the ratio grows without bound"
    sentence = f"not reciprocal: the specular term is not multiplied by N·L; {compared}"
    sentence += in_channel(channel, there.shape[1])
    return judged(value, RECIPROCITY_LIMIT, _ROUNDING, (light, view, channel), sentence)


def _in_plane(material: Material, light: np.ndarray, view: np.ndarray) -> np.ndarray:
    """f_r, (a, b, C), for angles of light and view in degrees, in one plane: there the five models have extremes."""
    to_light, to_view = (from_angles(np.radians(angle), 0.0) for angle in (light, view))
    return np.asarray(_reflectance(material, to_light[:, None], to_view))


_reflectance = jax.jit(lambda material, to_light, to_view: material.reflectance(to_light, to_view))


def _energy(material: Material) -> Finding:
    albedo = np.asarray(directional_albedo(material, 0.0))
    channel = int(np.argmax(albedo))
    value, light = float(albedo[channel]), Angles(0.0)
    lobe = float(np.abs(material.k_s[channel])) if isinstance(material, SpecularMaterial) else 0.0
    bound = ACCURACY["float64"] * lobe + _ROUNDING * abs(value)
    words = f"the largest albedo is {value:.7g}, for light at {light}{in_channel(channel, albedo.size)}"
    crossing = 0.0 if value > ENERGY_LIMIT + bound else None
    failed = f"does not conserve energy: {words}"
    return judged(value, ENERGY_LIMIT, bound, (light, None, channel), words, failed, crossing=crossing)


def _classic_energy(material: SpecularMaterial) -> Finding:
    k_d, k_s = np.asarray(material.k_d), np.asarray(material.k_s)

    def albedo(cosine: float) -> np.ndarray:
        # by the cosine of the light's angle, which resolves grazing light where the angle does not
        lobe = lobe_albedo(type(material), material.n, 0.5 * np.pi - np.arcsin(cosine))
        return k_d + k_s * (float(lobe) / cosine)

    within, beyond = 1e-14, 1.0  # the albedo falls as the cosine grows: up to which does it exceed 1?
    if albedo(beyond).max() > 1.0:
        within = beyond
    for _ in range(60):
        middle = math.sqrt(within * beyond)
        within, beyond = (middle, beyond) if albedo(middle).max() > 1.0 else (within, middle)
    crossing = float(np.degrees(np.arccos(within)))
    worst = min(math.cos(math.radians(GRAZING)), 0.1 * within)
    values = albedo(worst)
    channel = int(np.argmax(values))
    value, light = float(values[channel]), Angles(float(np.degrees(np.arccos(worst))))
    scale = float(normalized_form(type(material)).scale(material.n))
    bound = ACCURACY["float64"] * float(k_s[channel] / (scale * worst)) + _ROUNDING * value
    sentence = (
        f"does not conserve energy: the albedo exceeds 1 for light beyond {crossing:.4g}° and grows without bound, "
        f"to {value:.3g} at {light}{in_channel(channel, k_d.size)}"
    )
    return judged(value, ENERGY_LIMIT, bound, (light, None, channel), sentence, crossing=crossing)
