"""Materials for other programs: three.js, glTF, Mitsuba, PyTorch3D, GLSL; each says what it cannot carry.

| format | what it is | exact for |
| --- | --- | --- |
| ``json`` | this toolkit's own | every model |
| ``mtl`` | Wavefront, illum 2 | Blinn-Phong, Lambert |
| ``glsl`` | functions for any shader | every model |
| ``pytorch3d`` | arguments of ``pytorch3d.renderer.Materials`` | Phong, Lambert |
| ``three`` | ``MeshPhongMaterial`` JSON of three.js | Lambert (to 8 bits) |
| ``gltf`` | metallic-roughness material with KHR_materials_specular | nothing: an approximation |
| ``mitsuba``, ``mitsuba-dict`` | XML or dictionary (``mitsuba.load_dict``) of Mitsuba 3 | Lambert |

three.js, glTF and Mitsuba multiply the highlight by N·L; they are given the nearest normalised form. None of them knows
ambient light as a property of the material.

Formats differ most where a highlight peaks: light and view mirror each other about the normal. There every lobe has a
closed form, so that an export can say by how much another program's picture differs, instead of that it does.
"""

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from string import Template
from typing import Any, NamedTuple
from xml.etree import ElementTree

import numpy as np
from jaxtyping import Float

from brdf.albedo import has_other_lobe
from brdf.conversions import (
    mirror_from_half,
    nearest_classic,
    nearest_normalized,
    roughness_from_exponent,
    slope_from_exponent,
)
from brdf.errors import InputError
from brdf.files import as_path, write_text
from brdf.images.encoding import decode, encode
from brdf.materials.material_file import material_to_dict
from brdf.materials.mtl import half_exponent, height, to_mtl
from brdf.models import BlinnPhong, Material, NormalizedPhong, Phong, SpecularMaterial
from brdf.models.base import check_single

Colour = Float[np.ndarray, "3"]

_GRAZING = 60.0  # degrees from the normal: far out, and still seen on a tenth of a ball
_COMMENTS = {"glsl": "// {}", "mitsuba": "<!-- {} -->"}  # of other texts "# {}"
_FRESNEL = "{} adds a Fresnel term: the highlight turns white where light and view are far apart"


class Written(NamedTuple):
    """A material in another program's words.

    Attributes:
        content: what the file holds: text, or values of JSON.
        losses: what the format cannot carry, a sentence each.
        drawn: the radiance that the program shows of a light of intensity 1 where light and view mirror each other at
            an angle of this cosine, (3,); None where it draws the material as it is.
        extras: among the values of JSON, where remarks go; None where the format has no place for them.
    """

    content: Any
    losses: list[str]
    drawn: Callable[[float], Colour] | None = None
    extras: dict[str, Any] | None = None


@dataclasses.dataclass(frozen=True)
class Export:
    """A material in another program's words.

    Attributes:
        text: what the file holds.
        losses: what the format cannot carry of this material, a sentence each; empty where it carries everything.
    """

    text: str
    losses: tuple[str, ...]


def export_material(material: Material, to: str, *, name: str = "fitted", note: str = "") -> Export:
    """A material as another program reads it.

    Args:
        material: any of the five models, of known numbers, with 1 or 3 channels (``json``: any number).
        to: one of json, mtl, three, gltf, mitsuba, mitsuba-dict, pytorch3d, glsl.
        name: what to call it, where the format names its materials.
        note: what to say of it in the file, a line: what a picture left open, say.

    Raises:
        InputError: an unknown format, or channels that the format does not know.

    Example:
        >>> export = brdf.export_material(brdf.preset("gold"), "three")
        >>> export.losses[0]
        'k_a is left out: the format has no ambient coefficient'
    """
    check_single(material, "Write brdf.export_material(material, to)")
    if to not in EXPORTS:
        raise InputError("to", f"is unknown, got {to!r}", f"Use one of {', '.join(EXPORTS)}")
    channels = np.asarray(material.k_d).size
    if to != "json" and channels not in (1, 3):
        raise InputError("material", f"has {channels} channels, {to} knows RGB alone", "Use the format json")
    name, note = (" ".join(text.split()) for text in (name, note))  # a line, whatever came
    content, losses, drawn, extras = EXPORTS[to](material, name)
    if to != "json" and has_other_lobe(type(material)):
        losses = [f"the format has no word for the lobe of {material.name}: it is written as Blinn-Phong's", *losses]
    if drawn is not None:
        losses += _brightness(material, drawn)
    remarks = ({} if to == "json" else {"losses": losses}) | ({"note": note} if note else {})
    if isinstance(content, str):
        lines = [*losses, f"note: {note}"] if note else losses
        comment = _COMMENTS.get(to, "# {}")
        content = "".join(comment.format(line.replace("--", "")) + "\n" for line in lines) + content
    else:
        if extras is not None:
            extras.update(remarks)
        content = json.dumps(content, indent=2) + "\n"
    return Export(content, tuple(losses))


def save_export(
    material: Material, path: str | Path, *, to: str | None = None, name: str = "fitted", note: str = ""
) -> Export:
    """Write a material as another program reads it.

    Args:
        material: as for `export_material`.
        path: the file to write.
        to: as for `export_material`; None goes by the suffix: .json .mtl .gltf .xml .glsl .py.
        name: what to call it.
        note: as for `export_material`.

    Returns:
        What was written, and what it cannot carry.

    Raises:
        InputError: as for `export_material`, or where the file cannot be written.

    Example:
        >>> brdf.save_export(brdf.preset("gold"), "gold.gltf").losses[0]
        'k_a is left out: the format has no ambient coefficient'
    """
    suffix = as_path(path).suffix.lower()
    if to is None and suffix not in _SUFFIXES:
        remedy = f"Name it {' '.join(_SUFFIXES)} or say which of {', '.join(EXPORTS)} you want"
        raise InputError(path, f"does not say its format, got {suffix or 'no suffix'}", remedy)
    export = export_material(material, to or _SUFFIXES[suffix], name=name, note=note)
    write_text(path, export.text)
    return export


# -- what several formats need -----------------------------------------------------------------------------------------


def _rgb(values: Any) -> Colour:
    return np.broadcast_to(np.asarray(values, np.float64), 3)


def _brightness(material: Material, drawn: Callable[[float], Colour]) -> list[str]:
    """How bright another program draws the surface where the highlight peaks, in words; nothing where as it is."""
    if not isinstance(material, SpecularMaterial) or not np.any(material.k_s):
        return []
    ratios = []
    for cosine in np.cos(np.radians([0.0, _GRAZING])):
        weight = height(material) * (cosine if material.cosine_weighted else 1.0)
        ratios.append(np.sum(drawn(cosine)) / np.sum(_rgb(material.k_d) * cosine + _rgb(material.k_s) * weight))
    if np.allclose(ratios, 1.0, rtol=0, atol=1e-3):
        return []
    facing, grazing = (f"{ratio:.2f}" if ratio < 10 else f"{ratio:.0f}" for ratio in ratios)
    return [
        f"at the highlight's peak the surface comes out {facing} times as bright where light and view stand along the "
        f"normal, {grazing} times where they stand {_GRAZING:g}° from it"
    ]


def _normalised(material: Any):
    """The form that a physically based renderer has words for: k_d, k_s, its peak, n of N·H; and what that costs."""
    losses = ["k_a is left out: the format has no ambient coefficient"] if np.any(material.k_a) else []
    if not isinstance(material, SpecularMaterial):
        return _rgb(material.k_d), np.zeros(3), np.zeros(3), 0.0, losses
    if not material.cosine_weighted:
        material = nearest_normalized(material)
        losses.append(
            "the classic highlight is not multiplied by N·L, and here it is: k_d and k_s are those of the nearest "
            "normalised form. A normalised form fitted to the picture itself (--model normalized-blinn-phong, or "
            "--plausible) comes closer"
        )
    if isinstance(material, NormalizedPhong):
        losses.append("the highlight is one of N·H: its exponent is 4 n, of nearly the same highlight as (R·V)^n")
    k_s = _rgb(material.k_s)
    return _rgb(material.k_d), k_s, k_s * height(material), half_exponent(material), losses


def _cut(**colours) -> list[str]:
    return [
        f"{key} is cut at 1, it would be {' '.join(f'{value:.3g}' for value in colour)}"
        for key, colour in colours.items()
        if np.any(colour > 1 + 1e-9)
    ]


# -- JSON, MTL, PyTorch3D ----------------------------------------------------------------------------------------------


def _json(material: Material, name: str) -> Written:
    values = material_to_dict(material)
    return Written(values, [], extras=values)


def _mtl(material, name):
    losses = []
    if isinstance(material, Phong | NormalizedPhong):
        losses.append("MTL's highlight is (N·H)^Ns: Ns is 4 n, of nearly the same highlight as (R·V)^n")
    if isinstance(material, SpecularMaterial) and material.cosine_weighted:
        losses.append("the factor N·L of the highlight is left out: it is brighter towards grazing light")

    def drawn(cosine):
        return _rgb(material.k_d) * cosine + _rgb(material.k_s) * height(material)

    return Written(to_mtl(material, name=name), losses, drawn)


def _pytorch3d(material: Material, name: str) -> Written:
    losses = []
    classic = nearest_classic(material)
    if type(classic) is not type(material):
        losses.append("the factor N·L of the highlight is left out: k_d and k_s are those of the nearest classic form")
    k_d, k_s, shininess = _rgb(classic.k_d), np.zeros(3), 64.0
    if isinstance(classic, SpecularMaterial):
        k_s, shininess = _rgb(classic.k_s), float(classic.n)
        if isinstance(classic, BlinnPhong):
            losses.append("PyTorch3D's highlight is (R·V)^shininess: shininess is n / 4, of nearly the same highlight")
            shininess = float(mirror_from_half(shininess))
    colours = {"ambient": _rgb(classic.k_a), "diffuse": k_d, "specular": k_s}
    values = {f"{key}_color": (tuple(colour.tolist()),) for key, colour in colours.items()}
    lines = [f'    "{key}": {value!r},' for key, value in (values | {"shininess": shininess}).items()]
    head = "# Materials(device=device, **MATERIALS) of pytorch3d.renderer, written by brdf."
    return Written("\n".join([head, "MATERIALS = {", *lines, "}", ""]), losses, lambda cosine: k_d * cosine + k_s)


# -- GLSL: the exact formula -------------------------------------------------------------------------------------------

# No version line, and nothing that GLSL ES 1.00 lacks: for any shader from WebGL 1 to Vulkan.
_SHADER = Template("""\
// $model, written by brdf. Directions are unit vectors that point away from the surface;
// intensity is the radiance that a white Lambertian surface facing the light shows (irradiance / pi).
// radiance = brdf_ambient(I_a) + sum over the lights of brdf_light(N, L, V, I)
$constants

vec3 brdf_ambient(vec3 intensity) {
    return BRDF_K_A * intensity;
}

${lobe}vec3 brdf_light(vec3 normal, vec3 to_light, vec3 to_view, vec3 intensity) {
    float cosine = dot(normal, to_light);
    if (cosine <= 0.0) return vec3(0.0);
$reflected
}
""")

# As in ``vectors``: pow(N·H, n) is off by 6 % at n = 1e6 in single precision.
_SHADER_LOBE = Template("""\
float brdf_log1p(float x) {  // log(1 + x) without losing x to the rounding of 1 + x
    float s = x / (2.0 + x), q = s * s;
    return x < 0.5 ? 2.0 * s * (1.0 + q * (1.0 / 3.0 + q * (0.2 + q * (1.0 / 7.0 + q / 9.0)))) : log(1.0 + x);
}

float brdf_lobe(vec3 normal, vec3 to_light, vec3 to_view) {
    if (dot(normal, to_light) <= 0.0 || dot(normal, to_view) <= 0.0) return 0.0;
    vec3 a = $first;
    vec3 b = $second;
    float along = dot(a, b);
    vec3 across = cross(a, b);
    if (along <= 0.0) return 0.0;
    return BRDF_SCALE * exp(-0.5 * BRDF_N * brdf_log1p(dot(across, across) / (along * along)));
}

""")


def shader(model: type[Material], declarations: str) -> str:
    """The formula of a model in GLSL: brdf_ambient and brdf_light.

    Args:
        model: one of the five models.
        declarations: of ``BRDF_K_A``, ``BRDF_K_D`` and, where there is a lobe, ``BRDF_K_S``, ``BRDF_N`` and
            ``BRDF_SCALE``: constants, uniforms, or globals that the shader sets for each pixel.
    """
    lobe, reflected = "", "    return intensity * BRDF_K_D * cosine;"
    if issubclass(model, SpecularMaterial):
        first, second = "normal", "to_light + to_view"
        if issubclass(model, Phong | NormalizedPhong):
            first, second = "2.0 * dot(normal, to_light) * normal - to_light", "to_view"
        lobe = _SHADER_LOBE.substitute(first=first, second=second)
        weight = " * cosine" if model.cosine_weighted else ""
        reflected = f"    float lobe = brdf_lobe(normal, to_light, to_view){weight};\n"
        reflected += "    return intensity * (BRDF_K_D * cosine + BRDF_K_S * lobe);"
    return _SHADER.substitute(model=model.name, constants=declarations, lobe=lobe, reflected=reflected)


def _glsl(material: Material, name: str) -> Written:
    def number(value: float) -> str:
        text = f"{value:.9g}"
        return text if "." in text or "e" in text else f"{text}.0"

    constants = [
        f"const vec3 BRDF_{key.upper()} = vec3({', '.join(map(number, _rgb(getattr(material, key))))});"
        for key in ("k_a", "k_d", "k_s")
        if hasattr(material, key)
    ]
    if isinstance(material, SpecularMaterial):
        constants.append(f"const float BRDF_N = {number(float(material.n))};")
        constants.append(f"const float BRDF_SCALE = {number(height(material))};")
    return Written(shader(type(material), "\n".join(constants)), [])


# -- three.js ----------------------------------------------------------------------------------------------------------


def _three(material, name):
    k_d, k_s, peak, n, losses = _normalised(material)
    glossy = bool(np.any(k_s))
    if glossy:
        losses.append(_FRESNEL.format("three.js"))
    losses.append("colours are 8-bit sRGB, as MaterialLoader reads them; userData.linear holds them in full")
    # three.js draws specular (n+2)/8 (N·H)^n N·L times Schlick's Fresnel term, which is 1 at normal incidence.
    linear = {"color": k_d, "specular": peak * 8.0 / (n + 2.0)}
    losses += _cut(**linear)
    codes = {key: np.round(255 * encode(np.clip(colour, 0.0, 1.0), "srgb")) for key, colour in linear.items()}
    color, specular = (decode(code / 255, "srgb") for code in codes.values())

    def drawn(cosine: float) -> Colour:
        fresnel = 2.0 ** ((-5.55473 * cosine - 6.98316) * cosine)
        return (color + glossy * (specular * (1 - fresnel) + fresnel) * (n + 2.0) / 8.0) * cosine

    # Where k_s is 0 the Fresnel term would shine all the same.
    kept, kind = (tuple(linear), "MeshPhongMaterial") if glossy else (("color",), "MeshLambertMaterial")
    user_data = {"linear": {key: linear[key].tolist() for key in kept}}
    values = {
        "metadata": {"version": 4.7, "type": "Material", "generator": "brdf"},
        "uuid": "brdf-" + name,
        "type": kind,
        "name": name,
        **{key: int(codes[key] @ [1 << 16, 1 << 8, 1]) for key in kept},  # 0xRRGGBB
        **({"shininess": n} if glossy else {}),
        "userData": user_data,
    }
    return Written(values, losses, drawn, user_data)


# -- glTF --------------------------------------------------------------------------------------------------------------


def _gltf(material, name):
    k_d, f_0, _, n, losses = _normalised(material)
    roughness, glossy = float(roughness_from_exponent(n)), bool(np.any(f_0))
    if glossy:
        losses += [
            "roughness is (2 / (n+2))^(1/4), as is usual: GGX has twice the curvature at its peak, and long tails",
            _FRESNEL.format("glTF"),
            "the diffuse part is k_d / (1 - F0), as the specification mixes; where a viewer adds, it is brighter",
            "without KHR_materials_specular a viewer shows a colourless highlight of reflectance 0.04",
        ]
    losses += _cut(F0=f_0)
    f_0 = np.minimum(f_0, 1.0)  # as viewers do
    base = k_d / np.maximum(1.0 - f_0.max(), 1e-6)  # what the Fresnel layer takes from the diffuse part
    losses += _cut(baseColorFactor=base)
    base = np.minimum(base, 1.0)

    def drawn(cosine):  # appendix B.3 of the specification, with the height-correlated masking of viewers
        square = roughness**4  # of the slope alpha
        fresnel = f_0 + (1.0 - f_0) * (1.0 - cosine) ** 5
        visible = 0.25 / (cosine * np.sqrt(cosine**2 * (1.0 - square) + square))
        return (base * (1.0 - fresnel.max()) + fresnel * visible / square) * cosine

    factors = {"baseColorFactor": [*base.tolist(), 1.0], "metallicFactor": 0.0, "roughnessFactor": roughness}
    # Times the reflectance of a dielectric; of what has no highlight the Fresnel term would be one at grazing angles.
    specular = {"specularColorFactor": (f_0 / 0.04).tolist()} if glossy else {"specularFactor": 0.0}
    entry: dict[str, Any] = {"name": name, "pbrMetallicRoughness": factors}
    entry |= {"extensions": {"KHR_materials_specular": specular}, "extras": {}}
    asset = {"version": "2.0", "generator": "brdf"}
    values = {"asset": asset, "extensionsUsed": ["KHR_materials_specular"], "materials": [entry]}
    return Written(values, losses, drawn, entry["extras"])


# -- Mitsuba -----------------------------------------------------------------------------------------------------------


def _mitsuba_xml(material, name):
    written = _mitsuba(material, name)
    scene = ElementTree.Element("scene", version="3.0.0")
    scene.append(_element(written.content, id=name))
    ElementTree.indent(scene)
    return written._replace(content=ElementTree.tostring(scene, "unicode") + "\n")


def _element(plugin, **attributes):
    element = ElementTree.Element("bsdf", type=plugin["type"], **attributes)
    for key, value in plugin.items():
        kind = "float" if isinstance(value, float) else "string"
        if isinstance(value, dict) and value["type"] == "rgb":
            kind, value = "rgb", ", ".join(map(repr, value["value"]))
        if isinstance(value, dict):
            element.append(_element(value, name=key))
        elif key != "type":
            ElementTree.SubElement(element, kind, name=key, value=str(value))
    return element


def _mitsuba(material, name):
    """The nearest BSDF of Mitsuba 3, and what it cannot carry.

    ``diffuse``, or ``blendbsdf`` of ``diffuse`` and a ``roughconductor`` without Fresnel term (Beckmann, slope
    sqrt(2 / (n+2))): its lobe is (n+2)/(8 π) (N·H)^n near the normal, as that of normalised Blinn-Phong.
    """

    def reflecting(colour: Colour) -> dict[str, Any]:
        return {"type": "rgb", "value": np.clip(colour, 0.0, 1.0).tolist()}

    k_d, k_s, _, n, losses = _normalised(material)
    if not np.any(k_s):
        losses += _cut(reflectance=k_d)
        return Written({"type": "diffuse", "reflectance": reflecting(k_d)}, losses, lambda cosine: k_d * cosine)
    alpha, weight = float(slope_from_exponent(n)), float(k_s.max() / (k_s.max() + k_d.max()))
    diffuse, specular = k_d / max(1.0 - weight, 1e-12), k_s / weight
    losses.append("the lobe is that of microfacets (Beckmann, slope sqrt(2 / (n+2))), narrower and brighter if grazing")
    losses += _cut(reflectance=diffuse, specular_reflectance=specular)

    def drawn(cosine: float) -> Colour:
        lobe = (_beckmann_shadowing(alpha, cosine) / (2.0 * alpha * cosine)) ** 2
        return ((1.0 - weight) * np.clip(diffuse, 0.0, 1.0) + weight * np.clip(specular, 0.0, 1.0) * lobe) * cosine

    conductor = {"type": "roughconductor", "material": "none", "distribution": "beckmann", "alpha": alpha}
    conductor |= {"specular_reflectance": reflecting(specular)}
    parts = {"diffuse": {"type": "diffuse", "reflectance": reflecting(diffuse)}, "conductor": conductor}
    return Written({"type": "blendbsdf", "weight": weight, **parts}, losses, drawn)


def _beckmann_shadowing(alpha: float, cosine: float) -> float:
    """Walter et al., "Microfacet models for refraction", EGSR 2007: the rational fit that Mitsuba uses."""
    a = cosine / (alpha * np.sqrt(1.0 - cosine**2)) if cosine < 1.0 else np.inf
    return 1.0 if a >= 1.6 else (3.535 * a + 2.181 * a**2) / (1.0 + 2.276 * a + 2.577 * a**2)


EXPORTS: dict[str, Callable[[Material, str], Written]] = {
    "json": _json,
    "mtl": _mtl,
    "three": _three,
    "gltf": _gltf,
    "mitsuba": _mitsuba_xml,
    "mitsuba-dict": _mitsuba,
    "pytorch3d": _pytorch3d,
    "glsl": _glsl,
}
"""The formats by name."""

_SUFFIXES = {".json": "json", ".mtl": "mtl", ".gltf": "gltf", ".xml": "mitsuba", ".py": "pytorch3d", ".glsl": "glsl"}
