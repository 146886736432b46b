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

Those that multiply the highlight by N·L are in ``physical_formats``, the others are here.
"""

import dataclasses
import json
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from brdf.conversions import mirror_from_half, nearest_classic
from brdf.errors import InputError
from brdf.files import write_text
from brdf.materials.files import material_to_dict, to_mtl
from brdf.materials.glsl import glsl_source
from brdf.materials.highlights import brightness, height, rgb
from brdf.materials.physical_formats import mitsuba_dict, to_gltf, to_mitsuba_json, to_mitsuba_xml, to_three
from brdf.models import BlinnPhong, Material, NormalizedPhong, Phong, SpecularMaterial


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
