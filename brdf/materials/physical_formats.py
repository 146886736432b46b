"""Materials for programs that multiply the highlight by N·L: three.js, glTF, Mitsuba.

They are given the nearest normalised form (`nearest_normalized`). None of them knows ambient light as a property of the
material. Each function returns what the file holds, and a sentence for each thing that it cannot carry.
"""

import json
from typing import Any, NamedTuple
from xml.sax.saxutils import quoteattr

import numpy as np

from brdf.conversions import nearest_normalized, roughness_from_exponent, slope_from_exponent
from brdf.images.encodings import decode, encode
from brdf.materials.highlights import Colour, brightness, half_exponent, height, rgb
from brdf.models import Lambert, Material, NormalizedPhong, SpecularMaterial

_DIELECTRIC = 0.04
_NO_AMBIENT = "k_a is left out: the format has no ambient coefficient"
_CLASSIC = (
    "the classic highlight is not multiplied by N·L, and here it is: k_d and k_s are those of the nearest normalised "
    "form. A normalised form fitted to the picture itself (--model normalized-blinn-phong, or --plausible) comes closer"
)


def to_three(material: Material, name: str) -> tuple[str, list[str]]:
    """JSON of a three.js ``MeshPhongMaterial``.

    Args:
        material: any of the five models, with 1 or 3 channels.
        name: of the material.
    """
    plausible, losses = _normalised(material)
    values: dict[str, Any] = {"metadata": {"version": 4.7, "type": "Material", "generator": "brdf"}}
    values |= {"uuid": "brdf-" + name, "type": "MeshPhongMaterial", "name": name}
    k_s, n = np.zeros(3), 30.0
    if isinstance(plausible, SpecularMaterial):
        n = half_exponent(plausible)
        # three.js draws specular (n+2)/8 (N·H)^n N·L times Schlick's Fresnel term, which is 1 at normal incidence.
        k_s = rgb(plausible.k_s) * height(plausible) * 8.0 / (n + 2.0)
        losses.append("three.js adds a Fresnel term: the highlight turns white where light and view are far apart")
    losses.append("colours are 8-bit sRGB, as MaterialLoader reads them; userData.linear holds them in full")
    linear = {"color": rgb(plausible.k_d), "specular": k_s}
    codes = {key: np.round(255 * encode(np.clip(colour, 0.0, 1.0), "srgb")) for key, colour in linear.items()}
    read = {key: decode(code / 255, "srgb") for key, code in codes.items()}
    for key, colour in linear.items():
        losses += _cut(key, colour)

    def drawn(cosine: float) -> Colour:
        fresnel = 2.0 ** ((-5.55473 * cosine - 6.98316) * cosine)
        lobe = (read["specular"] * (1 - fresnel) + fresnel) * (n + 2.0) / 8.0
        return (read["color"] + lobe) * cosine

    losses += brightness(material, drawn)
    values |= {key: _hexadecimal(code) for key, code in codes.items()}
    values |= {"shininess": n, "userData": {"linear": {k: v.tolist() for k, v in linear.items()}, "losses": losses}}
    return json.dumps(values, indent=2) + "\n", losses


def to_gltf(material: Material, name: str) -> tuple[str, list[str]]:
    """A glTF 2.0 file with one metallic-roughness material and KHR_materials_specular.

    Args:
        material: any of the five models, with 1 or 3 channels.
        name: of the material.
    """
    plausible, losses = _normalised(material)
    k_d, f_0, roughness = rgb(plausible.k_d), np.zeros(3), 1.0
    if isinstance(plausible, SpecularMaterial):
        f_0 = rgb(plausible.k_s)
        roughness = float(roughness_from_exponent(half_exponent(plausible)))
        losses.append("roughness is (2 / (n+2))^(1/4): GGX has nearly the lobe's curvature at its peak, but long tails")
        losses.append("glTF adds a Fresnel term: the highlight turns white where light and view are far apart")
        losses.append(
            "the diffuse part is k_d / (1 - F0), as the specification mixes; where a viewer adds, it is brighter"
        )
        losses.append("without KHR_materials_specular a viewer shows a colourless highlight of reflectance 0.04")
    base = k_d / np.maximum(1.0 - f_0.max(), 1e-6)  # what the Fresnel layer takes from the diffuse part
    losses += _cut("baseColorFactor", base)
    base = np.minimum(base, 1.0)

    def drawn(cosine: float) -> Colour:  # appendix B.3 of the specification
        square = roughness**4  # of the slope alpha
        fresnel = f_0 + (1.0 - f_0) * (1.0 - cosine) ** 5
        visible = 0.25 / (cosine * np.sqrt(cosine**2 * (1.0 - square) + square))
        return (base * (1.0 - fresnel.max()) + fresnel * visible / square) * cosine

    losses += brightness(material, drawn)
    entry = {
        "name": name,
        "pbrMetallicRoughness": {
            "baseColorFactor": [*base.tolist(), 1.0],
            "metallicFactor": 0.0,
            "roughnessFactor": roughness,
        },
        "extensions": {"KHR_materials_specular": {"specularColorFactor": (f_0 / _DIELECTRIC).tolist()}},
        "extras": {"losses": losses},
    }
    asset = {"version": "2.0", "generator": "brdf"}
    values = {"asset": asset, "extensionsUsed": ["KHR_materials_specular"], "materials": [entry]}
    return json.dumps(values, indent=2) + "\n", losses


def mitsuba_dict(material: Material) -> dict[str, Any]:
    """The nearest BSDF of Mitsuba 3, for ``mitsuba.load_dict``.

    Args:
        material: any of the five models, of known numbers, with 1 or 3 channels.

    Returns:
        ``diffuse``, or ``blendbsdf`` of ``diffuse`` and a ``roughconductor`` without Fresnel term (Beckmann, slope
        sqrt(2 / (n+2))): its lobe is (n+2)/(8 π) (N·H)^n near the normal, as that of normalised Blinn-Phong.
    """
    return _mitsuba(material).plugin


def to_mitsuba_json(material: Material, name: str) -> tuple[str, list[str]]:
    """`mitsuba_dict` as JSON.

    Args:
        material: any of the five models, with 1 or 3 channels.
        name: is not told: the dictionary has no place for it.
    """
    found = _mitsuba(material)
    return json.dumps(found.plugin, indent=2) + "\n", found.losses


def to_mitsuba_xml(material: Material, name: str) -> tuple[str, list[str]]:
    """`mitsuba_dict` as a scene file of Mitsuba 3, which other scene files can include.

    Args:
        material: any of the five models, with 1 or 3 channels.
        name: the id of the BSDF.
    """
    found = _mitsuba(material)
    comments = [f"  <!-- {loss.replace('--', '')} -->" for loss in found.losses]  # XML allows no -- in a comment
    body = _elements(found.plugin | {"id": name}, None, "  ")
    return "\n".join(['<scene version="3.0.0">', *comments, *body, "</scene>", ""]), found.losses


class _Mitsuba(NamedTuple):
    plugin: dict[str, Any]
    losses: list[str]


def _mitsuba(material: Material) -> _Mitsuba:
    plausible, losses = _normalised(material)
    k_d = rgb(plausible.k_d)
    if not isinstance(plausible, SpecularMaterial) or not np.any(plausible.k_s):
        return _Mitsuba({"type": "diffuse", "reflectance": _mitsuba_colour(k_d)}, losses + _cut("reflectance", k_d))
    k_s, alpha = rgb(plausible.k_s), float(slope_from_exponent(half_exponent(plausible)))
    weight = float(k_s.max() / (k_s.max() + k_d.max()))
    parts = {"reflectance": k_d / max(1.0 - weight, 1e-12), "specular_reflectance": k_s / weight}
    losses.append("the lobe is that of microfacets (Beckmann, slope sqrt(2 / (n+2))), narrower and brighter if grazing")
    for key, colour in parts.items():
        losses += _cut(key, colour)
    cut = {key: np.clip(colour, 0.0, 1.0) for key, colour in parts.items()}

    def drawn(cosine: float) -> Colour:
        lobe = (_beckmann_shadowing(alpha, cosine) / (2.0 * alpha * cosine)) ** 2
        return ((1.0 - weight) * cut["reflectance"] + weight * cut["specular_reflectance"] * lobe) * cosine

    losses += brightness(material, drawn)
    conductor = {"type": "roughconductor", "material": "none", "distribution": "beckmann", "alpha": alpha}
    conductor |= {"specular_reflectance": _mitsuba_colour(parts["specular_reflectance"])}
    diffuse = {"type": "diffuse", "reflectance": _mitsuba_colour(parts["reflectance"])}
    return _Mitsuba({"type": "blendbsdf", "weight": weight, "diffuse": diffuse, "conductor": conductor}, losses)


def _beckmann_shadowing(alpha: float, cosine: float) -> float:
    """Walter et al., "Microfacet models for refraction", EGSR 2007: the rational fit that Mitsuba uses."""
    sine = float(np.sqrt(1.0 - cosine**2))
    if cosine >= 1.6 * alpha * sine:
        return 1.0
    a = cosine / (alpha * sine)
    return (3.535 * a + 2.181 * a**2) / (1.0 + 2.276 * a + 2.577 * a**2)


def _mitsuba_colour(colour: Colour) -> dict[str, Any]:
    return {"type": "rgb", "value": np.clip(colour, 0.0, 1.0).tolist()}


def _elements(plugin: dict[str, Any], key: str | None, indent: str) -> list[str]:
    marks = f" id={quoteattr(plugin['id'])}" if "id" in plugin else "" if key is None else f" name={quoteattr(key)}"
    lines = [f"{indent}<bsdf type={quoteattr(plugin['type'])}{marks}>"]
    for inner, value in plugin.items():
        if inner in ("type", "id"):
            continue
        if isinstance(value, dict) and value["type"] == "rgb":
            numbers = ", ".join(map(repr, value["value"]))
            lines.append(f'{indent}  <rgb name="{inner}" value="{numbers}"/>')
        elif isinstance(value, dict):
            lines += _elements(value, inner, indent + "  ")
        else:
            kind = "string" if isinstance(value, str) else "float"
            lines.append(f'{indent}  <{kind} name="{inner}" value="{value}"/>')
    return [*lines, f"{indent}</bsdf>"]


def _normalised(material: Material) -> tuple[Material, list[str]]:
    """The form that a physically based renderer has words for, and what that costs."""
    losses = [_NO_AMBIENT] if np.any(material.k_a) else []
    if isinstance(material, Lambert) or (isinstance(material, SpecularMaterial) and material.cosine_weighted):
        plausible = material
    else:
        plausible = nearest_normalized(material)
        losses.append(_CLASSIC)
    if isinstance(plausible, NormalizedPhong):
        losses.append("the highlight is one of N·H: its exponent is 4 n, of nearly the same highlight as (R·V)^n")
    return plausible, losses


def _cut(key: str, colour: Colour) -> list[str]:
    if not np.any(colour > 1 + 1e-9):
        return []
    return [f"{key} is cut at 1, it would be {' '.join(f'{value:.3g}' for value in colour)}"]


def _hexadecimal(codes: Colour) -> int:
    """A colour of three bytes as one number, 0xRRGGBB."""
    red, green, blue = map(int, codes)
    return (red << 16) | (green << 8) | blue
