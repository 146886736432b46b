"""Materials for other programs: three.js, glTF, Mitsuba, PyTorch3D, GLSL; each says what it cannot carry.

| format | what it is | exact for |
| --- | --- | --- |
| ``json`` | this toolkit's own | every model |
| ``mtl`` | Wavefront, illum 2 | Blinn-Phong, Lambert |
| ``glsl`` | functions for any shader | every model |
| ``pytorch3d`` | arguments of ``pytorch3d.renderer.Materials`` | Phong, Lambert |
| ``three`` | ``MeshPhongMaterial`` JSON of three.js | Lambert (to 8 bits) |
| ``gltf`` | metallic-roughness material with KHR_materials_specular | nothing: an approximation |
| ``mitsuba``, ``mitsuba-dict`` | XML or dictionary of Mitsuba 3 | Lambert |

three.js, glTF and Mitsuba multiply the highlight by N·L: they are given the nearest normalised form
(`nearest_normalized`). None of them knows ambient light as a property of the material.
"""

import dataclasses
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np
from jaxtyping import Float

from brdf.conversions import (
    half_from_mirror,
    mirror_from_half,
    nearest_classic,
    nearest_normalized,
    roughness_from_exponent,
    slope_from_exponent,
)
from brdf.errors import InputError
from brdf.files import write_text
from brdf.images.encodings import encode
from brdf.materials.files import material_to_dict, to_mtl
from brdf.materials.glsl import glsl_source
from brdf.models import BlinnPhong, Lambert, Material, NormalizedPhong, Phong, SpecularMaterial

Colour = Float[np.ndarray, "3"]

_DIELECTRIC = 0.04
_NO_AMBIENT = "k_a is left out: the format has no ambient coefficient"


@dataclasses.dataclass(frozen=True)
class Export:
    """A material in another program's words.

    Attributes:
        text: what the file holds.
        losses: what the format cannot carry of this material, a sentence each; empty where it carries everything.
    """

    text: str
    losses: tuple[str, ...]


def export_material(material: Material, to: str, *, name: str = "fitted") -> Export:
    """A material as another program reads it.

    Args:
        material: any of the five models, of known numbers, with 1 or 3 channels (``json``: any number).
        to: one of `EXPORTS`.
        name: what to call it, where the format names its materials.

    Raises:
        InputError: an unknown format, or channels that the format does not know.
    """
    if to not in EXPORTS:
        raise InputError("to", f"is unknown, got {to!r}", f"Use one of {', '.join(EXPORTS)}")
    channels = np.asarray(material.k_d).size
    if to != "json" and channels not in (1, 3):
        raise InputError("material", f"has {channels} channels, {to} knows RGB alone", "Use the format json")
    return EXPORTS[to](material, name)


def save_export(material: Material, path: str | Path, *, to: str | None = None, name: str = "fitted") -> Export:
    """Write a material as another program reads it.

    Args:
        material: as for `export_material`.
        path: the file to write.
        to: one of `EXPORTS`; None goes by the suffix: .json .mtl .gltf .xml .glsl .py.
        name: what to call it.

    Returns:
        What was written, and what it cannot carry.

    Raises:
        InputError: as for `export_material`, or where the file cannot be written.
    """
    suffix = Path(path).suffix.lower()
    if to is None and suffix not in _SUFFIXES:
        remedy = f"Name it {' '.join(_SUFFIXES)} or say which of {', '.join(EXPORTS)} you want"
        raise InputError(path, f"does not say its format, got {suffix or 'no suffix'}", remedy)
    export = export_material(material, to or _SUFFIXES[suffix], name=name)
    write_text(path, export.text)
    return export


def _json(material: Material, name: str) -> Export:
    return Export(json.dumps(material_to_dict(material), indent=2) + "\n", ())


def _mtl(material: Material, name: str) -> Export:
    losses = []
    if isinstance(material, Phong | NormalizedPhong):
        losses.append("MTL's highlight is (N·H)^Ns: Ns is 4 n, of nearly the same highlight as (R·V)^n")
    if isinstance(material, SpecularMaterial) and material.cosine_weighted:
        losses.append("the factor N·L of the highlight is left out: it is brighter towards grazing light")
    return Export(to_mtl(material, name=name), tuple(losses))


def _glsl(material: Material, name: str) -> Export:
    return Export(glsl_source(material), ())


def _pytorch3d(material: Material, name: str) -> Export:
    losses = []
    classic = nearest_classic(material)
    if type(classic) is not type(material):
        losses.append("the factor N·L of the highlight is left out: k_d and k_s are those of the nearest classic form")
    k_s, shininess = np.zeros(3), 64.0
    if isinstance(classic, SpecularMaterial):
        k_s, shininess = _rgb(classic.k_s), float(classic.n)
        if isinstance(classic, BlinnPhong):
            losses.append("PyTorch3D's highlight is (R·V)^shininess: shininess is n / 4, of nearly the same highlight")
            shininess = float(mirror_from_half(shininess))
    lines = ["# Materials(device=device, **MATERIALS) of pytorch3d.renderer, written by brdf."]
    lines += [f"# {loss}." for loss in losses]
    lines += ["MATERIALS = {"]
    for key, value in {"ambient": classic.k_a, "diffuse": classic.k_d, "specular": k_s}.items():
        lines.append(f'    "{key}_color": ({tuple(_rgb(value).tolist())!r},),')
    return Export("\n".join([*lines, f'    "shininess": {shininess!r},', "}", ""]), tuple(losses))


def _three(material: Material, name: str) -> Export:
    plausible, losses = _normalised(material)
    values: dict[str, Any] = {"metadata": {"version": 4.7, "type": "Material", "generator": "brdf"}}
    values |= {"uuid": "brdf-" + name, "type": "MeshPhongMaterial", "name": name}
    k_s, n = np.zeros(3), 30.0
    if isinstance(plausible, SpecularMaterial):
        n = _half_exponent(plausible)
        # three.js draws specular (n+2)/8 (N·H)^n N·L times Schlick's Fresnel term, which is 1 at normal incidence.
        k_s = _rgb(plausible.k_s) * float(plausible.scale(np.float64(plausible.n))) * 8.0 / (n + 2.0)
        losses.append("three.js adds a Fresnel term: the highlight turns white where light and view are far apart")
    losses.append("colours are 8-bit sRGB, as MaterialLoader reads them; userData.linear holds them in full")
    linear = {"color": _rgb(plausible.k_d), "specular": k_s}
    for key, colour in linear.items():
        if np.any(colour > 1):
            losses.append(f"{key} is cut at 1, it would be {_words(colour)}")
    values |= {key: _hexadecimal(colour) for key, colour in linear.items()}
    values |= {"shininess": n, "userData": {"linear": {k: v.tolist() for k, v in linear.items()}, "losses": losses}}
    return Export(json.dumps(values, indent=2) + "\n", tuple(losses))


def _gltf(material: Material, name: str) -> Export:
    plausible, losses = _normalised(material)
    k_d, f_0, roughness = _rgb(plausible.k_d), np.zeros(3), 1.0
    if isinstance(plausible, SpecularMaterial):
        f_0 = _rgb(plausible.k_s)
        roughness = float(roughness_from_exponent(_half_exponent(plausible)))
        losses.append("roughness is (2 / (n+2))^(1/4): GGX has the lobe's height at its peak, but longer tails")
        losses.append("glTF adds a Fresnel term: the highlight turns white where light and view are far apart")
        losses.append(
            "the diffuse part is k_d / (1 - F0), as the specification mixes; where a viewer adds, it is brighter"
        )
        losses.append("without KHR_materials_specular a viewer shows a colourless highlight of reflectance 0.04")
    base = k_d / np.maximum(1.0 - f_0.max(), 1e-6)  # what the Fresnel layer takes from the diffuse part
    if np.any(base > 1):
        losses.append(f"baseColorFactor is cut at 1, it would be {_words(base)}")
    entry = {
        "name": name,
        "pbrMetallicRoughness": {
            "baseColorFactor": [*np.minimum(base, 1.0).tolist(), 1.0],
            "metallicFactor": 0.0,
            "roughnessFactor": roughness,
        },
        "extensions": {"KHR_materials_specular": {"specularColorFactor": (f_0 / _DIELECTRIC).tolist()}},
        "extras": {"losses": losses},
    }
    asset = {"version": "2.0", "generator": "brdf"}
    values = {"asset": asset, "extensionsUsed": ["KHR_materials_specular"], "materials": [entry]}
    return Export(json.dumps(values, indent=2) + "\n", tuple(losses))


def mitsuba_dict(material: Material) -> dict[str, Any]:
    """The nearest BSDF of Mitsuba 3, for ``mitsuba.load_dict``.

    Args:
        material: any of the five models, of known numbers, with 1 or 3 channels.

    Returns:
        ``diffuse``, or ``blendbsdf`` of ``diffuse`` and a ``roughconductor`` without Fresnel term (Beckmann, slope
        sqrt(2 / (n+2))): its lobe is (n+2)/(8 π) (N·H)^n near the normal, as that of normalised Blinn-Phong.
    """
    return _mitsuba(material)[0]


def _mitsuba(material: Material) -> tuple[dict[str, Any], list[str]]:
    plausible, losses = _normalised(material)
    k_d = _rgb(plausible.k_d)
    if not isinstance(plausible, SpecularMaterial) or not np.any(plausible.k_s):
        if np.any(k_d > 1):
            losses.append(f"reflectance is cut at 1, it would be {_words(k_d)}")
        return {"type": "diffuse", "reflectance": _mitsuba_colour(k_d)}, losses
    n, k_s = _half_exponent(plausible), _rgb(plausible.k_s)
    weight = float(k_s.max() / (k_s.max() + k_d.max()))
    parts = {"reflectance": k_d / max(1.0 - weight, 1e-12), "specular_reflectance": k_s / weight}
    losses.append("the lobe is that of microfacets (Beckmann, slope sqrt(2 / (n+2))) with masking: darker when grazing")
    for key, colour in parts.items():
        if np.any(colour > 1 + 1e-9):
            losses.append(f"{key} is cut at 1, it would be {_words(colour)}")
    conductor = {"type": "roughconductor", "material": "none", "distribution": "beckmann"}
    conductor |= {"alpha": float(slope_from_exponent(n))}
    conductor |= {"specular_reflectance": _mitsuba_colour(parts["specular_reflectance"])}
    diffuse = {"type": "diffuse", "reflectance": _mitsuba_colour(parts["reflectance"])}
    return {"type": "blendbsdf", "weight": weight, "diffuse": diffuse, "conductor": conductor}, losses


def _mitsuba_colour(colour: Colour) -> dict[str, Any]:
    return {"type": "rgb", "value": np.clip(colour, 0.0, 1.0).tolist()}


def _mitsuba_json(material: Material, name: str) -> Export:
    values, losses = _mitsuba(material)
    return Export(json.dumps(values, indent=2) + "\n", tuple(losses))


def _mitsuba_xml(material: Material, name: str) -> Export:
    values, losses = _mitsuba(material)
    comments = [f"  <!-- {loss} -->" for loss in losses]
    body = _elements(values | {"id": name}, None, "  ")
    return Export("\n".join(['<scene version="3.0.0">', *comments, *body, "</scene>", ""]), tuple(losses))


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
        losses.append(
            "the classic highlight is not multiplied by N·L: k_d and k_s are those of the nearest normalised form"
        )
    if isinstance(plausible, NormalizedPhong):
        losses.append("the highlight is one of N·H: its exponent is 4 n, of nearly the same highlight as (R·V)^n")
    return plausible, losses


def _half_exponent(material: SpecularMaterial) -> float:
    n = float(material.n)
    return float(half_from_mirror(n)) if isinstance(material, Phong | NormalizedPhong) else n


def _rgb(values: Any) -> Colour:
    return np.broadcast_to(np.asarray(values, np.float64), (3,)).copy()


def _words(colour: Colour) -> str:
    return " ".join(f"{value:.3g}" for value in colour)


def _hexadecimal(linear: Colour) -> int:
    """An sRGB colour as one number, 0xRRGGBB."""
    red, green, blue = (round(255 * value) for value in encode(np.clip(linear, 0.0, 1.0), "srgb").tolist())
    return (red << 16) | (green << 8) | blue


EXPORTS: dict[str, Callable[[Material, str], Export]] = {
    "json": _json,
    "mtl": _mtl,
    "three": _three,
    "gltf": _gltf,
    "mitsuba": _mitsuba_xml,
    "mitsuba-dict": _mitsuba_json,
    "pytorch3d": _pytorch3d,
    "glsl": _glsl,
}
"""The formats by name."""

_SUFFIXES = {".json": "json", ".mtl": "mtl", ".gltf": "gltf", ".xml": "mitsuba", ".py": "pytorch3d", ".glsl": "glsl"}

__all__: Sequence[str] = ["EXPORTS", "Export", "export_material", "mitsuba_dict", "save_export"]
