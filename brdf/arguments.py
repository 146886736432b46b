"""A table of a TOML or JSON file as the arguments of a class or function, strict: what is wrong names file, table, key.

The parameters' names are the keys; their annotations say what is no number: a path, which must stay within a folder,
the name of a layer, a truth value.
"""

import dataclasses
import inspect
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, NewType

import jax

from brdf.channels import MOST_CHANNELS
from brdf.errors import InputError

Layer = NewType("Layer", str)
_WORDS: dict[Any, str] = {Path: "a path", Layer | None: "the name of a layer", bool: "true or false"}


@dataclasses.dataclass
class Table:
    """One table of a file.

    Attributes:
        where: file and table, for messages.
        values: by key.
        folder: of the file, for paths in it.
        within: the folder that these may not leave.
    """

    where: str
    values: Any
    folder: Path = Path()
    within: Path = Path()

    def __post_init__(self):
        """Refuse what is no table."""
        if not isinstance(self.values, dict):
            raise InputError(self.where, f"must be a table, got {self.values!r}", "Write it as a [table]")

    def choose(self, key: str, choices: dict[str, Any]) -> Any:
        """What a value names, which is taken out; refused where it names none of the choices."""
        known = ", ".join(choices)
        if key not in self.values:
            raise InputError(self.where, f"has no {key}", f"Add {key} = one of {known}")
        value = self.values.pop(key)
        if not isinstance(value, str) or value not in choices:
            raise InputError(key, f"is unknown, got {repr(value)[:60]}", f"Use one of {known}").inside(self.where)
        return choices[value]

    def make(self, maker: Callable[..., Any]) -> Any:
        """What a class or function makes of the values: its parameters are the keys, of which no other may be given."""
        parameters, values = inspect.signature(maker).parameters, {}
        try:
            for key, value in self.values.items():
                if key not in parameters:
                    raise InputError(key[:40], "is not a known key", f"Known here: {', '.join(parameters)}")
                values[key] = self._value(key, value, parameters[key].annotation)
            for name, one in parameters.items():
                if name not in values and one.default is one.empty:
                    raise InputError(self.where, f"has no {name}", f"Add {name}")
            return maker(**values)
        except InputError as error:
            known = (self.where, *(str(value) for value in values.values() if isinstance(value, Path)))
            raise error if error.where.startswith(known) else error.inside(self.where) from None

    def _value(self, key, value, kind):
        """A value, refused where Python would silently read a truth value or text as a number."""
        if kind in _WORDS:
            if not isinstance(value, bool if kind is bool else str) or (kind is Path and value == ""):
                raise InputError(key, f"must be {_WORDS[kind]}, got {value!r}", "Correct the value")
            return self._path(key, value) if kind is Path else value
        if isinstance(value, list) and len(value) > MOST_CHANNELS:
            raise InputError(key, f"has {len(value)} entries", f"Give at most {MOST_CHANNELS}")
        for leaf in jax.tree.leaves(value):
            if isinstance(leaf, bool) or (isinstance(leaf, str) and key != "viewer"):
                is_text = isinstance(leaf, str)
                what, quoted = repr(leaf)[:40] if is_text else str(leaf).lower(), " without quotes" * is_text
                raise InputError(key, f"must be a number, got {what}", f"Give numbers{quoted}")
        return value

    def _path(self, key, name) -> Path:
        """The path of a file within the folder."""
        path, own = self.folder / name, self.within == self.folder
        try:
            stays = Path(os.path.realpath(path)).is_relative_to(self.within.resolve())
        except ValueError:
            raise InputError(key, f"is no path, got {name!r}", "Correct the path") from None
        if not stays:
            where, remedy = ("the scene's folder", ", or allow more with within") if own else (self.within, "")
            raise InputError(key, f"must stay within {where}, got {name!r}", f"Move the file there{remedy}")
        return path
