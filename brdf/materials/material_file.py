"""Material files in and out: JSON, which carries everything, and Wavefront MTL (``mtl``), which other programs load.

In JSON a value that a picture could not determine is ``null``; it reads back as 0, which changes no picture. One that
stands for a sum, of which the picture says no more, is a number, and ``note`` says so.
"""

import inspect
import json
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np

from brdf.arguments import Table
from brdf.errors import InputError
from brdf.files import as_path, read_text, write_text
from brdf.materials.mtl import SHOWN, material_from_mtl, read_mtl, to_mtl
from brdf.models import MODELS, Material
from brdf.models.base import check_single

_MOST_BYTES = 1 << 22
_NOTHING: Mapping[str, str] = {}


def load_material(path: str | Path, name: str | None = None) -> Material:
    """Read one material.

    Args:
        path: a ``.json`` or ``.mtl`` file; a folder that a fit was saved in, or its fit.json.
        name: which one, where an MTL file holds several.

    Raises:
        InputError: naming file and key, or where the file holds several materials and no name is given.

    Example:
        >>> brdf.save_material(brdf.Lambert(k_d=0.5), "grey.json")
        >>> brdf.load_material("grey.json")
        Lambert(k_a=[0], k_d=[0.5])
    """
    return read_material(path, name)[0]


def read_material(path: str | Path, name: str | None = None) -> tuple[Material, str]:
    """One material, as for `load_material`, and what its file says that it leaves open; empty where it says nothing."""
    entries = _entries(path)
    names = ", ".join(known[:SHOWN] for known in list(entries)[:10]) + " or another" * (len(entries) > 10)
    if name is None and len(entries) > 1:
        raise InputError(path, f"holds {len(entries)} materials", f"Name one of {names}")
    wanted = next(iter(entries)) if name is None else name
    if wanted not in entries:
        raise InputError(path, f"has no material {wanted[:SHOWN]!r}", f"It holds {names}")
    return _material(path, wanted, entries[wanted])


def load_materials(path: str | Path) -> dict[str, Material]:
    """Read all materials of a file, by name; the one in a JSON file bears the file's name.

    Args:
        path: as for `load_material`.

    Raises:
        InputError: naming file and key.

    Example:
        >>> brdf.save_material(brdf.preset("gold"), "gold.mtl")
        >>> list(brdf.load_materials("gold.mtl"))
        ['fitted']
    """
    return {name: material for name, (material, _) in read_materials(path).items()}


def read_materials(path: str | Path) -> dict[str, tuple[Material, str]]:
    """All materials of a file, by name, each with what the file says that it leaves open."""
    return {name: _material(path, name, entry) for name, entry in _entries(path).items()}


def save_material(material: Material, path: str | Path, *, undetermined: Mapping[str, str] = _NOTHING) -> None:
    """Write a material that `load_material` reads back.

    Args:
        material: any of the models; MTL holds three channels, so one channel is written three times.
        path: a ``.json`` or ``.mtl`` file.
        undetermined: what a picture could not determine, written as ``null`` where it is 0: "n", "k_s" or "k_s[2]" for
            one channel, and why.

    Raises:
        InputError: where the file cannot be written or cannot hold the material.

    Example:
        >>> brdf.save_material(brdf.preset("gold"), "gold.mtl")
    """
    check_single(material, "Write brdf.save_material(material, path)")
    channels, values = material.k_d.size, material_to_dict(material, undetermined=undetermined)
    if _suffix(path, "Name it .json or .mtl") == ".json":
        text = json.dumps(values, indent=2) + "\n"
    elif channels in (1, 3):
        text = to_mtl(material, undetermined=undetermined, note=values.get("note", ""))
    else:
        raise InputError(path, f"cannot hold {channels} channels, MTL knows RGB alone", "Save the material as .json")
    write_text(path, text)


def material_to_dict(material: Material, *, undetermined: Mapping[str, str] = _NOTHING) -> dict[str, Any]:
    """The material as JSON holds it; numbers that are not 0 although no picture determined them are told in a note.

    What is undetermined: see `save_material`.
    """
    values: dict[str, Any] = {"model": material.name}
    names_by_reason: dict[str, dict[str, None]] = {}
    for key in inspect.signature(type(material)).parameters:
        numbers = np.asarray(getattr(material, key), np.float64)
        listed: list[Any] = numbers.ravel().tolist()
        for channel, number in enumerate(listed):
            for name in {key, f"{key}[{channel}]"}.intersection(undetermined):
                if number:
                    names_by_reason.setdefault(undetermined[name], {})[name] = None
                else:
                    listed[channel] = None
        values[key] = listed if numbers.ndim else listed[0]
    if names_by_reason:
        reasons = "; ".join(f"{', '.join(names)}: {reason}" for reason, names in names_by_reason.items())
        values["note"] = f"not determined: {reasons}"
    return values


def material_from_dict(values: Any, where: object = "material") -> Material:
    """The material that JSON holds, see `material_to_dict`; an error names the key and where it stands."""
    if not isinstance(values, dict):
        raise InputError(where, "must be a JSON object", 'Write {"model": ..., "k_d": ...}')
    given = {key: value for key, value in values.items() if key not in ("note", "model")}
    given = jax.tree.map(lambda leaf: 0.0 if leaf is None else leaf, given, is_leaf=lambda leaf: leaf is None)
    table = Table(str(where), {key: given.get(key, value) for key, value in values.items() if key != "note"})
    material = table.make(table.choose("model", MODELS))
    if values.get("n", 0) is None and np.any(material.k_s):
        raise InputError(f"{where}: n", "is null (not determined) although k_s is not 0", "Give n, or k_s = 0")
    return material


def _suffix(path: str | Path, remedy: str) -> str:
    suffix = as_path(path).suffix.lower()
    if suffix not in (".json", ".mtl"):
        raise InputError(path, f"is no material file, got {suffix or 'no suffix'}", remedy)
    return suffix


def _entries(path: str | Path) -> dict[str, Any]:
    """What a file says of each of its materials, by name."""
    if as_path(path).is_dir():
        folder, path = path, Path(path) / "material.json"
        if not path.exists():
            raise InputError(folder, "is a folder without material.json", "Give a file, or what brdf fit --out wrote")
    suffix, text = _suffix(path, "Give a .json or .mtl file"), read_text(path, _MOST_BYTES)
    if suffix == ".mtl":
        return read_mtl(path, text)
    try:
        values = json.loads(text, object_pairs_hook=_each_once)
    except InputError as error:
        raise error.inside(path) from None
    except (ValueError, RecursionError) as error:
        raise InputError(path, f"is not JSON ({error})", "Correct the file") from None
    is_report = isinstance(values, dict) and "model" not in values and "material" in values
    return {Path(path).stem: values["material"] if is_report else values}


def _each_once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    for key, times in Counter(key for key, _ in pairs).items():
        if times > 1:
            raise InputError(key[:SHOWN], "is given twice", "Give it once")
    return dict(pairs)


def _material(path: str | Path, name: str, entry: Any) -> tuple[Material, str]:
    """What is wrong with one material keeps nobody from another of the file."""
    try:
        is_mtl = Path(path).suffix.lower() == ".mtl"
        material = material_from_mtl(entry) if is_mtl else material_from_dict(entry, path)
        return material, entry["note"] if isinstance(entry.get("note"), str) else ""
    except InputError as error:
        raise error if error.where.startswith(str(path)) else error.inside(f"{path}: material {name[:SHOWN]}") from None
