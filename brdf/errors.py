"""The one error that bad input raises, and numbers that have to be such. JAX is not needed to say so."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any


class InputError(ValueError):
    """Something the user gave cannot be used.

    The message is one line, ``<file or argument>: <what is wrong, what came>. <what to do>``; the command prints it
    after ``error:`` and exits with status 2.

    Example:
        >>> brdf.preset("unobtainium")
        Traceback (most recent call last):
            ...
        brdf.errors.InputError: preset: is unknown, got 'unobtainium'. Use one of emerald, ...
    """

    def __init__(self, where: object, what: str, remedy: str = ""):
        """Build the message.

        Args:
            where: the file or argument at fault.
            what: what is wrong with it and what came, without a full stop.
            remedy: what to do about it, a sentence without its full stop.
        """
        self.where, self.what, self.remedy = str(where), what, remedy
        self.of_file = isinstance(where, Path)
        message = f"{where}: {what}." + (f" {remedy}." if remedy else "")
        printable = "".join(letter if letter.isprintable() else " " for letter in message)
        super().__init__(" ".join(printable.split()))

    def __reduce__(self):
        """As it was made: an error that a process cannot hand to another one takes its whole pool along."""
        return type(self), (Path(self.where) if self.of_file else self.where, self.what, self.remedy)

    def inside(self, where: object) -> "InputError":
        """The same error, with the file or table that the value stood in.

        Args:
            where: the file or table.
        """
        separator = "." if ": " in str(where) else ": "
        return InputError(f"{where}{separator}{self.where}", self.what, self.remedy)

    def renamed(self, names: Mapping[str, object]) -> "InputError":
        """The same error, with the name that the user knows an argument by; itself where it is of another, or a file.

        Args:
            names: by the argument that it names.
        """
        if self.of_file or self.where not in names:  # a file may be called as an argument is
            return self
        return InputError(names[self.where], self.what, self.remedy)


def as_numbers(name: str, value: Any, what: str = "numbers", remedy: str = "Give plain numbers") -> Any:
    """What a person gives for numbers, a float64 array of any shape; refused, by the words for it, where it is none."""
    import numpy as np

    try:
        return np.asarray(value, np.float64)
    except (TypeError, ValueError, OverflowError):
        raise InputError(name, f"must be {what}, got {what_came(value)}", remedy) from None


def what_came(value: Any) -> str:
    """A value in so many letters as a line has room for."""
    text = repr(value.tolist() if hasattr(value, "tolist") else value)
    return text if len(text) <= 60 else text[:57] + "..."
