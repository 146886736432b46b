"""Wavefront MTL: the materials that other programs load. illum 2 is Blinn-Phong, (N·H)^Ns.

A highlight that MTL has no word for is written as the nearest one it has, and a comment, which other readers skip,
names the model, so that what was saved reads back.
"""

from collections.abc import Collection
from typing import Any

import numpy as np

from brdf.conversions import half_from_mirror, mirror_from_half
from brdf.errors import InputError
from brdf.files import continued_lines, parse_number
from brdf.models import MODELS, BlinnPhong, Lambert, Material, NormalizedPhong, Phong, SpecularMaterial

SHOWN = 40  # the first letters of a word that messages show
_COMMENTS = {"model": "# brdf model:", "note": "# note:"}
_TEXTURE = "map_kd"
# Opacity and transparency of what hides all behind it: other values, as textures, are told as not read.
_OPAQUE = {"d": 1.0, "tr": 0.0}
_COEFFICIENTS = {"ka": "k_a", "kd": "k_d", "ks": "k_s"}


def half_exponent(material: SpecularMaterial) -> float:
    """The exponent of N·H that gives nearly the highlight of this material."""
    n = float(material.n)
    return float(half_from_mirror(n)) if isinstance(material, Phong | NormalizedPhong) else n


def height(material: SpecularMaterial) -> float:
    """The constant before the lobe, 1 in the classic forms."""
    return float(material.scale(np.float64(material.n)))


def to_mtl(material: Material, *, name: str = "fitted", undetermined: Collection[str] = (), note: str = "") -> str:
    """The material, of 1 or 3 channels, as MTL holds it.

    Comments tell what a picture could not determine, and the note, which is a line.
    """
    lines = ["# Wavefront material, linear values"]
    if type(material) is not BlinnPhong:
        lines.append(f"{_COMMENTS['model']} {material.name}")
    if undetermined:
        lines.append(f"# not determined by the picture: {', '.join(undetermined)}")
    if note:
        lines.append(f"{_COMMENTS['note']} {note}")
    lines.append(f"newmtl {name}")
    colours, illum = [material.k_a, material.k_d, 0.0], 1
    if isinstance(material, SpecularMaterial):
        lines.append(f"Ns {half_exponent(material)!r}")
        colours[2], illum = np.asarray(material.k_s, np.float64) * height(material), 2
    for key, colour in zip("ads", colours, strict=True):
        numbers = np.broadcast_to(np.asarray(colour, np.float64), 3).tolist()
        lines.append(f"K{key} {' '.join(map(repr, numbers))}")
    return "\n".join([*lines, f"illum {illum}", ""])


def read_mtl(path: Any, text: str) -> dict[str, dict[str, Any]]:
    """What the lines of each material say, for `material_from_mtl`, by name; what is not read is told in its note."""
    entries: dict[str, dict[str, Any]] = {}
    name, comments = None, {}
    for number, line in continued_lines(text):
        where = f"{path}: line {number}"
        for key, comment in _COMMENTS.items():
            if line.startswith(comment):
                comments[key] = line.removeprefix(comment).strip()
        word, *given = line.partition("#")[0].split() or [""]
        key = word.lower()
        if key == "newmtl":
            name = line[len(word) :].strip() or "unnamed"
            if name in entries:
                what = f"names the material {name[:SHOWN]} a second time"
                raise InputError(where, what, "Give each a name of its own")
            entries[name], comments = comments, {}
        elif key in (*_COEFFICIENTS, "ns", "illum", _TEXTURE):
            if name is None:
                raise InputError(where, f"has {word} before any newmtl", "Start the material with newmtl NAME")
            entries[name][key] = given[-1:] or [word] if key == _TEXTURE else _numbers(where, word, given)
        if name is not None and (key.startswith("map_") or (key in _OPAQUE and not _equals(given[-1:], _OPAQUE[key]))):
            unread = f"{' '.join([word, *given])[:SHOWN]} is not read"
            entries[name]["note"] = "; ".join(filter(None, [entries[name].get("note"), unread]))
    if not entries:
        raise InputError(path, "holds no material", "Give a file with a newmtl line")
    return entries


def _equals(given: list[str], number: float) -> bool:
    try:
        return [parse_number(one) for one in given] == [number]
    except ValueError:
        return False


def _numbers(where: str, word, given) -> list[float]:
    wanted, remedy = ((1, 3), "Give RGB values") if word.lower() in _COEFFICIENTS else ((1,), "Give one number")
    what = f"got {' '.join(given)[:SHOWN]!r}"
    try:
        numbers = [parse_number(number) for number in given]
    except ValueError:
        more = "; spectral curves and XYZ are not read" if given[0].lower() in ("spectral", "xyz") else ""
        raise InputError(where, f"{word} must be numbers, {what}", f"{remedy}{more}") from None
    if not np.all(np.isfinite(numbers)):
        raise InputError(where, f"{word} must be finite numbers, {what}", "Give finite numbers")
    if len(numbers) not in wanted:
        raise InputError(where, f"{word} has {len(numbers)} values", f"Give {' or '.join(map(str, wanted))}")
    return numbers


def material_from_mtl(entry: dict[str, Any]) -> Material:
    """The material of which an entry of `read_mtl` tells; an error names the key."""
    if _TEXTURE in entry and "kd" not in entry:
        what = f"is missing beside the texture {''.join(entry[_TEXTURE])[:SHOWN]}, which is not read"
        raise InputError("Kd", what, "Add the mean colour as Kd")
    name, (illum,), (exponent,) = entry.get("model"), entry.get("illum", [2.0]), entry.get("ns", [1.0])
    colours = {key: np.broadcast_to(entry.get(word, [0.0]), 3) for word, key in _COEFFICIENTS.items()}
    if name is not None and name not in MODELS:
        raise InputError("model", f"is unknown, got {name!r}", f"Use one of {', '.join(MODELS)}")
    model = MODELS[name or "blinn-phong"]
    if not issubclass(model, SpecularMaterial) or illum < 2 or (name is None and "ks" not in entry):
        return Lambert(k_a=colours["k_a"], k_d=colours["k_d"])
    if exponent < 0:
        raise InputError("Ns", f"must be at least 0, got {exponent:g}", "Correct the value")
    n = float(mirror_from_half(exponent)) if issubclass(model, Phong | NormalizedPhong) else exponent
    colours["k_s"] = colours["k_s"] / float(model.scale(np.float64(n)))
    return model(**colours, n=n)
