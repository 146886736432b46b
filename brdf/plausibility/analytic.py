"""Plausibility of the five models: the answers are known on paper, and the numbers only illustrate them.

* positive, because no coefficient is negative;
* Lambert and the normalised forms are reciprocal, because their lobe depends on light and view in the same way. The
  classic forms divide a symmetric lobe by N.L: for k_s > 0 not reciprocal, the more so the more grazing the light;
* the albedo of Lambert is k_d at every angle; that of the normalised forms is largest at normal incidence, k_d + k_s;
  that of the classic forms grows without bound towards grazing light for k_s > 0.
"""

import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from brdf.albedo import ACCURACY, directional_albedo, lobe_albedo, normalized_form
from brdf.channels import in_channel
from brdf.conversions import nearest_normalized
from brdf.models import Material, SpecularMaterial
from brdf.plausibility.report import ENERGY_LIMIT, GRAZING, RECIPROCITY_LIMIT, Angles, Finding, Report, times, verdict
from brdf.precision import cast, working_precision

_ANGLES = np.array([*np.arange(90.0), 89.5, 89.9, GRAZING])
_ROUNDING = 1e-13  # relative; float64 at n = 1e6 reaches 1e-14


def check_material(material: Material, subject: str) -> Report:
    """Test one of the five models.

    Args:
        material: of known numbers.
        subject: what to call it in the report.
    """
    with working_precision("float64"):
        double = cast(material, "float64")
        findings = _positivity(double), _reciprocity(double), _energy(double)
    fails = any(finding.verdict == "fail" for finding in findings)
    return Report(subject, *findings, nearest=nearest_normalized(material) if fails else None)


def _positivity(material: Material) -> Finding:
    values = _in_plane(material, _ANGLES, _ANGLES)
    side, row, column, channel = map(int, np.unravel_index(np.argmin(values), values.shape))
    value = float(values[side, row, column, channel])
    light, view = Angles(_ANGLES[row]), Angles(_ANGLES[column], 180.0 * side)
    bound = _ROUNDING * abs(value)
    word = verdict(value, bound)
    sentence = f"the least f_r is {value:.4g}/sr, because no coefficient is negative"
    if word != "pass":
        sentence = f"negative: f_r is {value:.4g}/sr for light {light}, view {view}"
    return Finding(word, value, 0.0, value, bound, light, view, channel, sentence + _named(material, channel))


def _reciprocity(material: Material) -> Finding:
    if not _diverges(material):
        normal, limit = Angles(0.0), RECIPROCITY_LIMIT
        sentence = "f_r is the same when light and view change places"
        return Finding("pass", 0.0, limit, limit, 0.0, normal, normal, 0, sentence)
    # For given angles the lobe, and with it the difference, is largest with light and view on opposite sides.
    lights = views = _ANGLES
    light = view = larger = smaller = 0.0
    channel = 0
    for _ in range(4):
        there = _in_plane(material, lights, views)[1]
        back = np.swapaxes(_in_plane(material, views, lights)[1], 0, 1)
        difference = (there - back) / np.maximum(np.maximum(there, back), 1e-300)
        row, column, channel = map(int, np.unravel_index(np.argmax(difference), difference.shape))
        light, view = lights[row], views[column]
        larger, smaller = float(there[row, column, channel]), float(back[row, column, channel])
        lights, views = _closer(lights, row), _closer(views, column)
    value, to_light = 1.0 - smaller / larger, Angles(light)
    a, b = f"{light:.4g}°", f"{view:.4g}°"
    compared = f"f_r({a}→{b}) is {times(larger / max(smaller, 1e-300))} f_r({b}→{a})"
    if value < 2 * RECIPROCITY_LIMIT:  # a trace of k_s shows only closer to 90 degrees than the angles go
        value, to_light, compared = 1.0, Angles(90.0), "towards grazing light the ratio grows without bound"
    sentence = f"not reciprocal: the specular term is not multiplied by N·L; {compared}{_named(material, channel)}"
    limit = RECIPROCITY_LIMIT
    return Finding("fail", value, limit, limit - value, _ROUNDING, to_light, Angles(view, 180.0), channel, sentence)


def _in_plane(
    material: Material, light: Float[np.ndarray, " a"], view: Float[np.ndarray, " b"]
) -> Float[np.ndarray, "2 a b C"]:
    """f_r for view and light in one plane through the normal: on the same side of it, and on opposite sides.

    The five models have their extremes there.
    """
    return np.asarray(_in_plane_of(material, jnp.asarray(np.radians(light)), jnp.asarray(np.radians(view))))


@jax.jit
def _in_plane_of(material: Material, light: Array, view: Array) -> Array:
    to_light, to_view = (jnp.stack([jnp.sin(x), jnp.zeros_like(x), jnp.cos(x)], -1) for x in (light, view))
    sides = [to_view * jnp.array([side, 1.0, 1.0]) for side in (1.0, -1.0)]
    return jnp.stack([material.reflectance(to_light[:, None], side) for side in sides])


def _closer(angles: Float[np.ndarray, " a"], index: int) -> Float[np.ndarray, " a"]:
    """As many angles, between the neighbours of one of them, and that one."""
    fine = np.linspace(angles[max(index - 1, 0)], angles[min(index + 1, len(angles) - 1)], len(angles))
    fine[np.argmin(np.abs(fine - angles[index]))] = angles[index]
    return fine


def _diverges(material: Material) -> bool:
    """Whether it is of classic form, and has a highlight."""
    return isinstance(material, SpecularMaterial) and not material.cosine_weighted and bool(np.any(material.k_s != 0))


def _energy(material: Material) -> Finding:
    if isinstance(material, SpecularMaterial) and _diverges(material):
        return _classic_energy(material)
    albedo = np.asarray(directional_albedo(material, np.radians(_ANGLES)))
    row, channel = map(int, np.unravel_index(np.argmax(albedo), albedo.shape))
    value, light = float(albedo[row, channel]), Angles(_ANGLES[row])
    lobe = float(np.abs(material.k_s[channel])) if isinstance(material, SpecularMaterial) else 0.0
    bound = ACCURACY["float64"] * lobe + _ROUNDING * abs(value)
    margin = ENERGY_LIMIT - value
    word = verdict(margin, bound)
    sentence, crossing = f"the largest albedo is {value:.7g}, for light at {light}{_named(material, channel)}", None
    if word == "fail":
        sentence, crossing = f"does not conserve energy: {sentence}", 0.0
    return Finding(word, value, ENERGY_LIMIT, margin, bound, light, None, channel, sentence, crossing)


def _classic_energy(material: SpecularMaterial) -> Finding:
    k_d, k_s = np.asarray(material.k_d), np.asarray(material.k_s)

    def albedo(cosine: float) -> Float[np.ndarray, " C"]:
        # by the cosine of the light's angle, which resolves grazing light where the angle does not
        lobe = lobe_albedo(type(material), jnp.asarray(material.n), jnp.asarray(0.5 * np.pi - np.arcsin(cosine)))
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
        f"to {value:.3g} at {light}{_named(material, channel)}"
    )
    limit = ENERGY_LIMIT
    return Finding("fail", value, limit, limit - value, bound, light, None, channel, sentence, crossing)


def _named(material: Material, channel: int) -> str:
    return in_channel(channel, material.k_d.shape[-1])
