"""The pages that the code writes itself: every public name by room, every command with its options."""

import ast
import importlib
import inspect
import re
from collections import defaultdict
from pathlib import Path
from typing import Any

PACKAGES = ("brdf", "fitting")


def write(folder: Path) -> None:
    """Write `reference/` anew.

    Args:
        folder: of the documentation's sources.
    """
    pages = {f"{package}-{room}": page for package in PACKAGES for room, page in _rooms(package).items()}
    pages["commands"] = _commands()
    out = folder / "reference"
    out.mkdir(exist_ok=True)
    for old in out.glob("*.rst"):
        if old.stem not in pages:
            old.unlink()
    for name, text in pages.items():
        path = out / f"{name}.rst"
        if not path.exists() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")


def _rooms(package: str) -> dict[str, str]:
    """A page for each folder or module that `__init__.pyi` takes names from."""
    stub = Path(importlib.import_module(package).__file__ or "").with_suffix(".pyi")
    rooms: dict[str, list[str]] = defaultdict(list)
    for node in ast.parse(stub.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.ImportFrom):
            for alias in node.names:
                room = (node.module or alias.name).partition(".")[0]
                rooms[room].append(_entry(package, node.module or "", alias.name))
    return {room: _heading(f"{package}: {room.replace('_', ' ')}") + "\n".join(found) for room, found in rooms.items()}


def _entry(package: str, module: str, name: str) -> str:
    value = getattr(importlib.import_module(package), name)
    if inspect.ismodule(value):
        return f".. automodule:: {package}.{name}\n   :members:\n"
    if inspect.isclass(value):
        return f".. autoclass:: {package}.{name}\n   :members:\n"
    if callable(value):
        return f".. autofunction:: {package}.{name}\n"
    return f".. autodata:: {package}.{module}.{name}\n   :no-value:\n"


def _heading(text: str, line: str = "=") -> str:
    return f"{text}\n{line * len(text)}\n\n"


def _plain(text: str | None) -> str:
    """Help as text: without rich's marks, and safe within reStructuredText."""
    text = re.sub(r"\[/?(?:bold|dim)\]", "", text or "")
    return re.sub(r"([*`|\\])", r"\\\1", inspect.cleandoc(text))


def tables(*said: Any) -> None:
    """The tables of a docstring, which are Markdown's for those who read it in the code, as reStructuredText.

    Args:
        said: what autodoc hands over; last the lines, which are changed in place.
    """
    lines: list[str] = said[-1]
    done: list[str] = []
    for line in lines:
        if not line.startswith("| "):
            done.append(line)
        elif not re.fullmatch(r"[|\s-]+", line):
            if not (done and done[-1].startswith("     ")):
                done += ["", ".. list-table::", "   :header-rows: 1", ""]
            first, *others = line.strip("| ").split(" | ")
            done += [f"   * - {first}", *(f"     - {cell}" for cell in others)]
    lines[:] = done


def skip(*said: Any) -> bool | None:
    """Leave out the fields of named tuples, which Python documents by their place; the class says what they are.

    Args:
        said: what autodoc hands over; the fourth is the member.
    """
    return True if (getattr(said[3], "__doc__", None) or "").startswith("Alias for field number") else None


def _commands() -> str:
    import typer

    from fitting.cli.main import app

    root: Any = typer.main.get_command(app)
    text = _heading("Commands")
    text += (
        "What ``brdf COMMAND --help`` says. Every failure is one line, ``error: FILE: what is wrong. What to do.``, "
    )
    text += "with exit status 2; results appear whole or not at all.\n\n"
    for name, command in root.commands.items():
        text += _heading(f"brdf {name}", "-") + _plain(command.help) + "\n\n"
        lines = (line for line in _plain(command.epilog).splitlines() if line)
        text += "".join(f"| {line}\n" for line in lines) + "\n"
        for parameter in command.params:
            option = parameter.param_type_name == "option"
            given = [*parameter.opts, *parameter.secondary_opts] if option else [(parameter.name or "").upper()]
            default = parameter.default
            shown = default is not None and default is not False and not callable(default) and default != ()
            after = f" Default: ``{default}``." if option and shown else ""
            text += f"``{', '.join(given)}``\n    {_plain(getattr(parameter, 'help', None)) or '…'}{after}\n\n"
    return text
