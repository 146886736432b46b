"""Is it physically plausible? Positivity, reciprocity and energy conservation of a material or of any BRDF.

Of the five models the answers are known on paper, and the numbers only illustrate them:

* positive, because no coefficient is negative;
* Lambert and the normalised forms are reciprocal, because their lobe depends on light and view in the same way. The
  classic forms divide a symmetric lobe by N.L: for k_s > 0 not reciprocal, the more so the more grazing the light;
* the albedo of Lambert is k_d at every angle; that of the normalised forms is largest at normal incidence, k_d + k_s;
  that of the classic forms grows without bound towards grazing light for k_s > 0.

Any other BRDF is examined as a black box, in ``black_box``.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from brdf.albedo import ACCURACY, directional_albedo, lobe_albedo, normalized_form
from brdf.channels import in_channel
from brdf.conversions import nearest_normalized
from brdf.errors import InputError
from brdf.measured.table import MeasuredBRDF
from brdf.models import MODELS, Material, SpecularMaterial
from brdf.plausibility.numeric import GRAZING, check_black_box
from brdf.plausibility.report import ENERGY_LIMIT, RECIPROCITY_LIMIT, Angles, Finding, Report, times, verdict
from brdf.plausibility.tables import check_table
from brdf.precision import cast, working_precision

_ANGLES = np.array([*np.arange(90.0), 89.5, 89.9, GRAZING])
_ROUNDING = 1e-13  # relative; float64 at n = 1e6 reaches 1e-14


def check(brdf: Material | MeasuredBRDF | Callable[[Any, Any], Any], *, name: str | None = None) -> Report:
    """Test a material, or any BRDF, for positivity, reciprocity and energy conservation.

    Args:
        brdf: one of the five models, of known numbers; a measured table, whose errors are told in units of its noise;
            or f_r(to_light, to_view) -> (C,), in 1/sr, of unit vectors (3,) in the local frame whose +z axis is the
            normal, written with ``jax.numpy``.
        name: what to call it in the report.

    Returns:
        The report: three findings with verdict, worst case, margin and error bound; ``print`` it, or see its
        ``plausible``. A "cannot tell" means that the numerical error is larger than the margin.

    Raises:
        InputError: it is neither, or it cannot be called as described.

    Example:
        ``print(brdf.check(brdf.BlinnPhong(k_d=0.3, k_s=0.5, n=50)))``
    """
    if isinstance(brdf, Material):
        if type(brdf) in MODELS.values():
            return _check_material(brdf, name or repr(brdf))
        return check_black_box(brdf.reflectance, name or repr(brdf))
    if isinstance(brdf, MeasuredBRDF):
        return check_table(brdf, name)
    if not callable(brdf):
        raise InputError("brdf", f"must be a material or a function, got {type(brdf).__name__}")
    return check_black_box(brdf, name or getattr(brdf, "__name__", type(brdf).__name__))


def _check_material(material: Material, subject: str) -> Report:
    with working_precision("float64"):
        double = cast(material, "float64")
        findings = _positivity(double), _reciprocity(double), _energy(double)
    fails = any(finding.verdict == "fail" for finding in findings)
    return Report(subject, *findings, nearest=nearest_normalized(material) if fails else None)


def _positivity(material: Material) -> Finding:
    values = _in_plane(material, _ANGLES, _ANGLES)
    side, light, view, channel = (int(i) for i in np.unravel_index(np.argmin(values), values.shape))
    value = float(values[side, light, view, channel])
    to_light, to_view = Angles(_ANGLES[light]), Angles(_ANGLES[view], 180.0 * side)
    bound = _ROUNDING * abs(value)
    word = verdict(value, bound)
    sentence = f"the least f_r is {value:.4g}/sr, because no coefficient is negative"
    if word != "pass":
        sentence = f"negative: f_r is {value:.4g}/sr for light {to_light}, view {to_view}"
    sentence += _named(material, channel)
    return Finding(word, value, 0.0, value, bound, to_light, to_view, channel, sentence)


def _reciprocity(material: Material) -> Finding:
    if not _classic(material):
        normal = Angles(0.0)
        sentence = "f_r is the same when light and view change places"
        return Finding("pass", 0.0, RECIPROCITY_LIMIT, RECIPROCITY_LIMIT, 0.0, normal, normal, 0, sentence)
    # For given angles the lobe, and with it the difference, is largest with light and view on opposite sides.
    light = view = _ANGLES
    best, channel = (0.0, 0.0, 0.0, 0.0), 0
    for _ in range(4):
        there = _in_plane(material, light, view)[1]
        back = np.swapaxes(_in_plane(material, view, light)[1], 0, 1)
        difference = (there - back) / np.maximum(np.maximum(there, back), 1e-300)
        row, column, channel = (int(i) for i in np.unravel_index(np.argmax(difference), difference.shape))
        best = light[row], view[column], float(there[row, column, channel]), float(back[row, column, channel])
        light, view = _closer(light, row), _closer(view, column)
    value = 1.0 - best[3] / best[2]
    to_light, to_view = Angles(best[0]), Angles(best[1], 180.0)
    a, b = f"{to_light.polar:.4g}°", f"{to_view.polar:.4g}°"
    compared = f"f_r({a}→{b}) is {times(best[2] / max(best[3], 1e-300))} f_r({b}→{a})"
    if value < 2 * RECIPROCITY_LIMIT:  # a trace of k_s shows only closer to 90 degrees than the angles go
        value, to_light, compared = 1.0, Angles(90.0), "towards grazing light the ratio grows without bound"
    sentence = f"not reciprocal: the specular term is not multiplied by N·L; {compared}{_named(material, channel)}"
    margin = RECIPROCITY_LIMIT - value
    return Finding("fail", value, RECIPROCITY_LIMIT, margin, _ROUNDING, to_light, to_view, channel, sentence)


def _in_plane(
    material: Material, light: Float[np.ndarray, " a"], view: Float[np.ndarray, " b"]
) -> Float[np.ndarray, "2 a b C"]:
    """f_r for view and light in one plane through the normal: on the same side of it, and on opposite sides.

    The five models have their extremes there.
    """
    return np.asarray(_in_plane_of(material, jnp.asarray(np.radians(light)), jnp.asarray(np.radians(view))))


@jax.jit
def _in_plane_of(material: Material, light: Array, view: Array) -> Array:
    to_light = jnp.stack([jnp.sin(light), jnp.zeros_like(light), jnp.cos(light)], -1)[:, None]
    to_view = jnp.stack([jnp.sin(view), jnp.zeros_like(view), jnp.cos(view)], -1)
    return jnp.stack([material.reflectance(to_light, to_view * jnp.array([side, 1.0, 1.0])) for side in (1.0, -1.0)])


def _closer(angles: Float[np.ndarray, " a"], index: int) -> Float[np.ndarray, " a"]:
    """As many angles, between the neighbours of one of them, and that one."""
    fine = np.linspace(angles[max(index - 1, 0)], angles[min(index + 1, len(angles) - 1)], len(angles))
    fine[np.argmin(np.abs(fine - angles[index]))] = angles[index]
    return fine


def _classic(material: Material) -> bool:
    return (
        isinstance(material, SpecularMaterial)
        and not material.cosine_weighted
        and bool(np.any(np.asarray(material.k_s) != 0))
    )


def _energy(material: Material) -> Finding:
    if isinstance(material, SpecularMaterial) and _classic(material):
        return _classic_energy(material)
    albedo = np.asarray(directional_albedo(material, np.radians(_ANGLES)))
    row, channel = (int(i) for i in np.unravel_index(np.argmax(albedo), albedo.shape))
    value, margin = float(albedo[row, channel]), ENERGY_LIMIT - float(albedo[row, channel])
    lobe = float(np.abs(material.k_s[channel])) if isinstance(material, SpecularMaterial) else 0.0
    bound = ACCURACY["float64"] * lobe + _ROUNDING * abs(value)
    word = verdict(margin, bound)
    to_light = Angles(_ANGLES[row])
    sentence = f"the largest albedo is {value:.7g}, for light at {to_light}{_named(material, channel)}"
    if word == "fail":
        sentence = f"does not conserve energy: {sentence}"
    crossing = 0.0 if word == "fail" else None
    return Finding(word, value, ENERGY_LIMIT, margin, bound, to_light, None, channel, sentence, crossing)


def _classic_energy(material: SpecularMaterial) -> Finding:
    k_d, k_s = np.asarray(material.k_d), np.asarray(material.k_s)

    def albedo(cosine: Float[np.ndarray, " a"]) -> Float[np.ndarray, "a C"]:
        # by the cosine of the light's angle, which resolves grazing light where the angle does not
        angle = jnp.asarray(0.5 * np.pi - np.arcsin(cosine))
        lobe = np.asarray(lobe_albedo(type(material), jnp.asarray(material.n, jnp.float64), angle))
        return k_d + k_s * (lobe / cosine)[:, None]

    cosines = np.concatenate([np.geomspace(1e-14, 1e-3, 64), np.linspace(1e-3, 1.0, 193)[1:]])
    within = 0
    for _ in range(6):  # the albedo exceeds 1 at the first cosines: up to which?
        exceeds = np.append(albedo(cosines).max(axis=1) > 1.0, False)
        within = int(np.argmin(exceeds))
        if within in (0, len(cosines)):
            break
        cosines = np.linspace(cosines[within - 1], cosines[within], len(cosines))
    at_crossing = float(cosines[max(within - 1, 0)])
    crossing = float(np.degrees(np.arccos(at_crossing)))
    worst = min(np.cos(np.radians(GRAZING)), 0.1 * at_crossing)
    values = albedo(np.full(len(cosines), worst))[0]
    channel = int(np.argmax(values))
    value = float(values[channel])
    bound = ACCURACY["float64"] * float(k_s[channel] / (_scale(material) * worst)) + _ROUNDING * value
    to_light = Angles(float(np.degrees(np.arccos(worst))))
    sentence = (
        f"does not conserve energy: the albedo exceeds 1 for light beyond {crossing:.4g}° and grows without bound, "
        f"to {value:.3g} at {to_light}{_named(material, channel)}"
    )
    return Finding(
        "fail", value, ENERGY_LIMIT, ENERGY_LIMIT - value, bound, to_light, None, channel, sentence, crossing
    )


def _scale(material: SpecularMaterial) -> float:
    return float(jax.jit(normalized_form(type(material)).scale)(material.n))


def _named(material: Material, channel: int) -> str:
    return in_channel(channel, material.k_d.shape[-1])
