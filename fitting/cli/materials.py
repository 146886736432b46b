"""What MATERIAL on the command line stands for: a file, or a name of the classic table."""

import difflib
from pathlib import Path

import brdf


def find_material(text: str, name: str | None = None) -> tuple[brdf.Material, str]:
    """One material, and what it is called.

    Args:
        text: a file, or a name of the classic table such as emerald; a file goes before a name.
        name: which one, where an MTL file holds several.

    Raises:
        InputError: naming the file or the option.
    """
    key = _table_name(text)
    if key is None:
        return brdf.load_material(text, name), name or Path(text).stem
    if name is not None:
        raise brdf.InputError("--name", f"chooses from a file, and {key} is one material", "Leave it out")
    return brdf.preset(key), key


def find_materials(text: str) -> dict[str, brdf.Material]:
    """Every material of a file, or the one of the classic table, by name.

    Args:
        text: see `find_material`.

    Raises:
        InputError: naming the file.
    """
    key = _table_name(text)
    return brdf.load_materials(text) if key is None else {key: brdf.preset(key)}


def _table_name(text: str) -> str | None:
    """The name in the classic table; None where a file is meant."""
    if not text.strip():
        raise brdf.InputError("MATERIAL", "is empty", "Give a .json or .mtl file, or a name such as emerald")
    path, key = Path(text), text.strip().lower().replace(" ", "_").replace("-", "_")
    if key in brdf.PRESETS and not path.is_file():
        return key
    if path.suffix or path.exists():
        return None
    close = difflib.get_close_matches(key, brdf.PRESETS)
    remedy = f"The table has {' and '.join(close)}" if close else f"Give a file, or one of {', '.join(brdf.PRESETS)}"
    came = "is no material file and no name of the classic table"
    raise brdf.InputError(text, came, remedy)
