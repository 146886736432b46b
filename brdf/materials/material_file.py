"""Material files: JSON, which carries everything, and Wavefront MTL, which other programs load.

In JSON a value that a picture could not determine is ``null``; it reads back as 0, which changes no picture.
"""

import dataclasses
import json
import math
from collections import Counter
from collections.abc import Callable, Collection, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from brdf.errors import InputError
from brdf.files import parse_number, read_text, write_text
from brdf.models import MODELS, BlinnPhong, Lambert, Material, SpecularMaterial

# Says in a comment, which other readers skip, what MTL has no word for.
MTL_MODEL = "# brdf model:"
_MTL_EXPONENT = {"phong": 4.0, "normalized-phong": 4.0}
# The first letters of a word that messages show.
_SHOWN = 40
# As for measured tables: more are no spectrum.
MOST_CHANNELS = 4096
_MOST_BYTES = 1 << 22
_TEXTURE = "map_kd"
SPECTRAL = {"ka": "k_a", "kd": "k_d", "ks": "k_s"}


def load_material(path: str | Path, name: str | None = None) -> Material:
    """Read one material.

    Args:
        path: a ``.json`` or ``.mtl`` file.
        name: which one, where an MTL file holds several.

    Raises:
        InputError: naming file and key, or where the file holds several materials and no name is given.
    """
    materials = _readers(path)
    if name is None and len(materials) > 1:
        raise InputError(path, f"holds {len(materials)} materials", f"Name one of {_some(materials)}")
    wanted = next(iter(materials)) if name is None else name
    if wanted not in materials:
        raise InputError(path, f"has no material {wanted[:_SHOWN]!r}", f"It holds {_some(materials)}")
    return materials[wanted]()


def _some(names: Collection[str]) -> str:
    """The first names, cut where they are long."""
    first = ", ".join(name[:_SHOWN] for name in list(names)[:10])
    return first if len(names) <= 10 else f"{first} or another"


def load_materials(path: str | Path) -> dict[str, Material]:
    """Read all materials of a file, by name; the one in a JSON file bears the file's name.

    Args:
        path: a ``.json`` or ``.mtl`` file.

    Raises:
        InputError: naming file and key.
    """
    return {name: read() for name, read in _readers(path).items()}


def _readers(path: str | Path) -> dict[str, Callable[[], Material]]:
    """What makes each material of a file, by name; what is wrong with one alone keeps nobody from another."""
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix == ".json":
        return {path.stem: partial(_from_json, path, read_text(path, _MOST_BYTES))}
    if suffix == ".mtl":
        entries = _mtl_entries(path, read_text(path, _MOST_BYTES))
        return {name: partial(_mtl_material, path, name, entry) for name, entry in entries.items()}
    raise InputError(path, f"is no material file, got {suffix or 'no suffix'}", "Give a .json or .mtl file")


def save_material(material: Material, path: str | Path, *, undetermined: Collection[str] = ()) -> None:
    """Write a material that `load_material` reads back.

    Args:
        material: any of the models; MTL holds three channels, so one channel is written three times.
        path: a ``.json`` or ``.mtl`` file.
        undetermined: what a picture could not determine, written as ``null``: "n", "k_s" or "k_s[2]" for one channel.

    Raises:
        InputError: where the file cannot be written or cannot hold the material.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix == ".json":
        write_text(path, json.dumps(material_to_dict(material, undetermined=undetermined), indent=2) + "\n")
    elif suffix == ".mtl":
        channels = material.k_d.shape[0]
        if channels not in (1, 3):
            came = f"cannot hold {channels} channels, MTL knows RGB alone"
            raise InputError(path, came, "Save the material as .json")
        write_text(path, to_mtl(material, undetermined=undetermined))
    else:
        raise InputError(path, f"is no material file, got {suffix or 'no suffix'}", "Name it .json or .mtl")


def material_to_dict(material: Material, *, undetermined: Collection[str] = ()) -> dict[str, Any]:
    """The material as JSON holds it.

    Args:
        material: any of the models.
        undetermined: see `save_material`.
    """
    values: dict[str, Any] = {"model": material.name}
    for key in _parameters(type(material)):
        array = np.asarray(getattr(material, key), dtype=np.float64)
        if array.ndim == 0:
            values[key] = None if key in undetermined else float(array)
            continue
        values[key] = [
            None if key in undetermined or f"{key}[{channel}]" in undetermined else float(value)
            for channel, value in enumerate(array)
        ]
    return values


def material_from_dict(values: Any) -> Material:
    """The material that JSON holds. Keys that are no parameter of the model are left alone.

    Args:
        values: what `material_to_dict` gives.

    Raises:
        InputError: naming the key.
    """
    if not isinstance(values, dict):
        raise InputError("material", "must be a JSON object", 'Write {"model": ..., "k_d": ...}')
    name = values.get("model")
    if not isinstance(name, str) or name not in MODELS:
        raise InputError("model", f"is unknown, got {repr(name)[:_SHOWN]}", f"Use one of {', '.join(MODELS)}")
    model = MODELS[name]
    found = {key: values[key] for key in _parameters(model) if key in values}
    missing = [key for key in _parameters(model) if key not in values and key != "k_a"]
    if missing:
        raise InputError(missing[0], "is missing", f"{name} needs {', '.join(_parameters(model))}")
    for key, value in found.items():
        if isinstance(value, list) and len(value) > MOST_CHANNELS:
            raise InputError(key, f"has {len(value)} channels", f"Give at most {MOST_CHANNELS}")
        for number in value if isinstance(value, list) else [value]:
            if number is not None and (isinstance(number, bool) or not isinstance(number, int | float)):
                raise InputError(key, f"must be a number, got {json.dumps(number)[:40]}", "Give numbers or null")
    known = {key: _nulls_as_zero(value) for key, value in found.items()}
    if found.get("n", 0) is None and np.any(np.asarray(known["k_s"]) != 0):
        raise InputError("n", "is null (not determined) although k_s is not 0", "Give n, or k_s = 0")
    return model(**known)


def _nulls_as_zero(value: Any) -> Any:
    if isinstance(value, list):
        return [0.0 if number is None else number for number in value]
    return 0.0 if value is None else value


def _parameters(model: type[Material]) -> list[str]:
    return [field.name for field in dataclasses.fields(model)]


def _without_repetition(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    entries = dict(pairs)
    if len(entries) < len(pairs):
        (twice, _), *_ = Counter(key for key, _ in pairs).most_common(1)
        raise InputError(twice[:_SHOWN], "is given twice", "Give it once")
    return entries


def _from_json(path: Path, text: str) -> Material:
    try:
        return material_from_dict(json.loads(text, object_pairs_hook=_without_repetition))
    except InputError as error:
        raise error.inside(path) from None
    except (ValueError, RecursionError) as error:
        raise InputError(path, f"is not JSON ({error})", "Correct the file") from None


def to_mtl(material: Material, *, name: str = "fitted", undetermined: Collection[str] = ()) -> str:
    """The material as MTL holds it: illum 2 is Blinn-Phong, (N·H)^Ns.

    The Ns of a mirror lobe (R·V)^n is 4 n, of nearly the same highlight (see `half_from_mirror`); a comment names the
    model, so that `load_material` gives back what was saved.

    Args:
        material: any of the models, with 1 or 3 channels.
        name: what ``newmtl`` calls it.
        undetermined: see `save_material`.
    """
    lines = ["# Wavefront material, linear values"]
    if type(material) is not BlinnPhong:
        lines.append(f"{MTL_MODEL} {material.name}")
    if undetermined:
        lines.append(f"# not determined by the picture: {', '.join(undetermined)}")
    lines.append(f"newmtl {name}")
    scale = 1.0
    if isinstance(material, SpecularMaterial):
        scale = float(material.scale(np.float64(material.n)))
        lines.append(f"Ns {float(material.n) * _MTL_EXPONENT.get(material.name, 1.0)!r}")
    for key, factor in (("k_a", 1.0), ("k_d", 1.0), ("k_s", scale)):
        values = np.asarray(getattr(material, key, 0.0), dtype=np.float64) * factor
        red, green, blue = np.broadcast_to(values, (3,)).tolist()
        lines.append(f"K{key[-1]} {red!r} {green!r} {blue!r}")
    lines.append(f"illum {2 if isinstance(material, SpecularMaterial) else 1}")
    return "\n".join(lines) + "\n"


def _logical_lines(text: str) -> Iterator[tuple[int, str]]:
    """Lines by the number of their first, those that end in a backslash joined with the next."""
    joined, first = "", 1
    for number, line in enumerate(text.splitlines(), start=1):
        joined += line.strip()
        if joined.endswith("\\") and not joined.startswith("#"):
            joined = joined[:-1] + " "
            continue
        yield first, joined
        joined, first = "", number + 1
    if joined:
        yield first, joined


def _mtl_entries(path: Path, text: str) -> dict[str, dict[str, Any]]:
    """What the lines of each material say."""
    entries: dict[str, dict[str, Any]] = {}
    current: dict[str, Any] | None = None
    model_comment = None
    for number, stripped in _logical_lines(text):
        place = f"{path}: line {number}"
        if stripped.startswith(MTL_MODEL):
            model_comment = stripped.removeprefix(MTL_MODEL).strip()
            continue
        words = stripped.partition("#")[0].split()
        if not words:
            continue
        key = words[0].lower()
        if key == "newmtl":
            name = stripped[len("newmtl") :].strip() or "unnamed"
            if name in entries:
                came = f"names the material {name[:_SHOWN]} a second time"
                raise InputError(place, came, "Give each a name of its own")
            current = entries[name] = {"model": model_comment}
            continue
        if key not in (*SPECTRAL, "ns", "illum", _TEXTURE):
            continue
        if current is None:
            raise InputError(place, f"has {words[0]} before any newmtl", "Start the material with newmtl NAME")
        current[key] = words[-1] if key == _TEXTURE else _mtl_numbers(place, words)
    if not entries:
        raise InputError(path, "holds no material", "Give a file with a newmtl line")
    return entries


def _mtl_numbers(place: str, words: list[str]) -> list[float]:
    key, *given = words
    wanted, remedy = ((1, 3), "Give RGB values") if key.lower() in SPECTRAL else ((1,), "Give one number")
    came = f"got {' '.join(given)[:_SHOWN]!r}"
    try:
        numbers = [parse_number(word) for word in given]
    except ValueError:
        more = "; spectral curves and XYZ are not read" if given[0].lower() in ("spectral", "xyz") else ""
        raise InputError(place, f"{key} must be numbers, {came}", f"{remedy}{more}") from None
    if not all(map(math.isfinite, numbers)):
        raise InputError(place, f"{key} must be finite numbers, {came}", "Give finite numbers")
    if len(numbers) not in wanted:
        raise InputError(place, f"{key} has {len(numbers)} values", f"Give {' or '.join(map(str, wanted))}")
    return numbers * 3 if key.lower() in SPECTRAL and len(numbers) == 1 else numbers


def _mtl_material(path: Path, name: str, entry: dict[str, Any]) -> Material:
    try:
        return _material_of(entry)
    except InputError as error:
        raise error.inside(f"{path}: material {name[:_SHOWN]}") from None


def _material_of(entry: dict[str, Any]) -> Material:
    if _TEXTURE in entry and "kd" not in entry:
        came = f"is missing beside the texture {entry[_TEXTURE][:_SHOWN]}, which is not read"
        raise InputError("Kd", came, "Add the mean colour as Kd")
    values = {name: entry.get(key, [0.0, 0.0, 0.0]) for key, name in SPECTRAL.items()}
    name = entry["model"]
    if name is not None and name not in MODELS:
        raise InputError("model", f"is unknown, got {name!r}", f"Use one of {', '.join(MODELS)}")
    illum = entry.get("illum", [2.0])[0]
    if name == Lambert.name or illum < 2 or (name is None and "ks" not in entry):
        return Lambert(k_a=values["k_a"], k_d=values["k_d"])
    model = BlinnPhong if name is None else MODELS[name]
    assert issubclass(model, SpecularMaterial)
    n = entry.get("ns", [1.0])[0] / _MTL_EXPONENT.get(model.name, 1.0)
    if n < 0:
        raise InputError("Ns", f"must be at least 0, got {n:g}", "Correct the value")
    scale = float(model.scale(np.float64(n)))
    return model(k_a=values["k_a"], k_d=values["k_d"], k_s=np.asarray(values["k_s"]) / scale, n=n)
