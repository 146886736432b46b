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
"""

import dataclasses
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple
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
from brdf.images.encoding import decode, encode
from brdf.materials.material_file import material_to_dict, to_mtl
from brdf.models import BlinnPhong, Lambert, Material, NormalizedPhong, Phong, SpecularMaterial

Colour = Float[np.ndarray, "3"]

_GRAZING = 60.0  # degrees from the normal: far out, and still seen on a tenth of a ball


def rgb(values: Any) -> Colour:
    """Three channels in float64; one channel is grey.

    Args:
        values: (1,) or (3,).
    """
    return np.broadcast_to(np.asarray(values, np.float64), (3,)).copy()


def half_exponent(material: SpecularMaterial) -> float:
    """The exponent of N·H that gives nearly the highlight of this material.

    Args:
        material: with a highlight.
    """
    n = float(material.n)
    return float(half_from_mirror(n)) if isinstance(material, Phong | NormalizedPhong) else n


def height(material: SpecularMaterial) -> float:
    """The constant before the lobe, 1 in the classic forms.

    Args:
        material: with a highlight.
    """
    return float(material.scale(np.float64(material.n)))


def brightness(material: Material, drawn: Callable[[float], Colour]) -> list[str]:
    """How bright another program draws the peak of the highlight, in words.

    Args:
        material: any of the five models, with 1 or 3 channels.
        drawn: the radiance that the other program shows of a light of intensity 1 where light and view mirror each
            other at an angle of this cosine, (3,).

    Returns:
        A sentence with the ratio of the means over the channels at 0° and at 60° from the normal; nothing where there
        is no highlight, or where both ratios are 1 to a thousandth.
    """
    if not isinstance(material, SpecularMaterial) or not np.any(material.k_s):
        return []
    ratios = []
    for cosine in (1.0, float(np.cos(np.radians(_GRAZING)))):
        weight = height(material) * (cosine if material.cosine_weighted else 1.0)
        ratios.append(float(np.sum(drawn(cosine)) / np.sum(rgb(material.k_d) * cosine + rgb(material.k_s) * weight)))
    if np.allclose(ratios, 1.0, rtol=0, atol=1e-3):
        return []
    facing, grazing = (f"{ratio:.2f}" if ratio < 10 else f"{ratio:.0f}" for ratio in ratios)
    return [
        f"at its peak the highlight comes out {facing} times as bright where light and view stand along the normal, "
        f"{grazing} times where they stand {_GRAZING:g}° from it"
    ]


_LIGHT = """\
vec3 brdf_light(vec3 normal, vec3 to_light, vec3 to_view, vec3 intensity) {
    float cosine = dot(normal, to_light);
    if (cosine <= 0.0) return vec3(0.0);
"""

_LOBE = """\
float brdf_log1p(float x) {  // log(1 + x) without losing x to the rounding of 1 + x
    return x < 1e-3 ? x * (1.0 - x * (0.5 - x * 0.3333333)) : log(1.0 + x);
}

float brdf_lobe(vec3 normal, vec3 to_light, vec3 to_view) {
    if (dot(normal, to_light) <= 0.0 || dot(normal, to_view) <= 0.0) return 0.0;
    vec3 a = @FIRST@;
    vec3 b = @SECOND@;
    float along = dot(a, b);
    vec3 across = cross(a, b);
    if (along <= 0.0) return 0.0;
    return BRDF_SCALE * exp(-0.5 * BRDF_N * brdf_log1p(dot(across, across) / (along * along)));
}

"""


def glsl_source(material: Material, notes: Sequence[str] = ()) -> str:
    """Functions ``brdf_ambient`` and ``brdf_light`` that compute the shading equation for one material.

    Args:
        material: any of the five models, of known numbers, with 1 or 3 channels.
        notes: sentences to put at the head as comments.

    Returns:
        GLSL functions, to be added to a shader.
    """
    lines = [f"// {material.name}, written by brdf. Directions are unit vectors that point away from the surface;"]
    lines += ["// intensity is the radiance that a white Lambertian surface facing the light shows (irradiance / pi)."]
    lines += ["// radiance = brdf_ambient(I_a) + sum over the lights of brdf_light(N, L, V, I)"]
    lines += [f"// {note}" for note in notes]
    specular = isinstance(material, SpecularMaterial)
    for name in ("k_a", "k_d", "k_s") if specular else ("k_a", "k_d"):
        lines.append(f"const vec3 BRDF_{name.upper()} = {_vec3(np.asarray(getattr(material, name)))};")
    if specular:
        lines.append(f"const float BRDF_N = {_number(float(material.n))};")
        lines.append(f"const float BRDF_SCALE = {_number(float(material.scale(np.float64(material.n))))};")
    lines += ["", "vec3 brdf_ambient(vec3 intensity) {", "    return BRDF_K_A * intensity;", "}", ""]
    text = "\n".join(lines) + "\n"
    if not specular:
        return text + _LIGHT + "    return intensity * BRDF_K_D * cosine;\n}\n"
    mirror = isinstance(material, Phong | NormalizedPhong)
    first = "2.0 * dot(normal, to_light) * normal - to_light" if mirror else "normal"
    second = "to_view" if mirror else "to_light + to_view"
    text += _LOBE.replace("@FIRST@", first).replace("@SECOND@", second) + _LIGHT
    weight = " * cosine" if material.cosine_weighted else ""
    text += f"    float lobe = brdf_lobe(normal, to_light, to_view){weight};\n"
    return text + "    return intensity * (BRDF_K_D * cosine + BRDF_K_S * lobe);\n}\n"


def _vec3(values: np.ndarray) -> str:
    return f"vec3({', '.join(_number(float(value)) for value in np.broadcast_to(values, (3,)))})"


def _number(value: float) -> str:
    text = f"{value:.9g}"
    return text if "." in text or "e" in text else text + ".0"


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
    text, losses = EXPORTS[to](material, name)
    return Export(text, tuple(losses))


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


def _json(material: Material, name: str) -> tuple[str, list[str]]:
    return json.dumps(material_to_dict(material), indent=2) + "\n", []


def _mtl(material: Material, name: str) -> tuple[str, list[str]]:
    losses = []
    if isinstance(material, Phong | NormalizedPhong):
        losses.append("MTL's highlight is (N·H)^Ns: Ns is 4 n, of nearly the same highlight as (R·V)^n")
    if isinstance(material, SpecularMaterial) and material.cosine_weighted:
        losses.append("the factor N·L of the highlight is left out: it is brighter towards grazing light")
        bare = rgb(material.k_s) * height(material)
        losses += brightness(material, lambda cosine: rgb(material.k_d) * cosine + bare)
    return to_mtl(material, name=name), losses


def _glsl(material: Material, name: str) -> tuple[str, list[str]]:
    return glsl_source(material), []


def _pytorch3d(material: Material, name: str) -> tuple[str, list[str]]:
    losses = []
    classic = nearest_classic(material)
    if type(classic) is not type(material):
        losses.append("the factor N·L of the highlight is left out: k_d and k_s are those of the nearest classic form")
    k_s, shininess = np.zeros(3), 64.0
    if isinstance(classic, SpecularMaterial):
        k_s, shininess = rgb(classic.k_s), float(classic.n)
        if isinstance(classic, BlinnPhong):
            losses.append("PyTorch3D's highlight is (R·V)^shininess: shininess is n / 4, of nearly the same highlight")
            shininess = float(mirror_from_half(shininess))
    losses += brightness(material, lambda cosine: rgb(classic.k_d) * cosine + k_s)
    lines = ["# Materials(device=device, **MATERIALS) of pytorch3d.renderer, written by brdf."]
    lines += [f"# {loss}." for loss in losses]
    lines += ["MATERIALS = {"]
    for key, value in {"ambient": classic.k_a, "diffuse": classic.k_d, "specular": k_s}.items():
        lines.append(f'    "{key}_color": ({tuple(rgb(value).tolist())!r},),')
    return "\n".join([*lines, f'    "shininess": {shininess!r},', "}", ""]), losses


EXPORTS: dict[str, Callable[[Material, str], tuple[str, list[str]]]] = {
    "json": _json,
    "mtl": _mtl,
    "three": to_three,
    "gltf": to_gltf,
    "mitsuba": to_mitsuba_xml,
    "mitsuba-dict": to_mitsuba_json,
    "pytorch3d": _pytorch3d,
    "glsl": _glsl,
}
"""The formats by name: each gives what the file holds, and a sentence for each thing that it cannot carry."""

_SUFFIXES = {".json": "json", ".mtl": "mtl", ".gltf": "gltf", ".xml": "mitsuba", ".py": "pytorch3d", ".glsl": "glsl"}

__all__: Sequence[str] = ["EXPORTS", "Export", "export_material", "mitsuba_dict", "save_export"]
