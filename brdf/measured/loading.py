"""Read a measured BRDF from a file, told by what is in it and not by its name.

| format | module | what it is |
| --- | --- | --- |
| MERL ``.binary`` | `merl` | Matusik et al. 2003: a full grid in half and difference angles, RGB |
| RGL ``.bsdf`` | `rgl` | Dupuy and Jakob 2018: evaluated by Mitsuba's ``measured`` plugin, an optional extra |
| Cornell text | `text` | goniometer samples with 31 wavelengths |
| ALTA text | `text` | samples in one of ALTA's parametrisations |
"""

import os
from pathlib import Path

from brdf.errors import InputError
from brdf.files import input_file
from brdf.measured import merl, rgl, text
from brdf.measured.table import MeasuredBRDF


def load_measured(path: str | os.PathLike[str]) -> MeasuredBRDF:
    """Read a measured BRDF.

    Args:
        path: a MERL ``.binary``, RGL ``.bsdf``, Cornell or ALTA text file; told by its content.

    Returns:
        The table.

    Raises:
        InputError: naming the file, where it is none of these, damaged, or (RGL) Mitsuba is not installed.

    Example:
        >>> brdf.load_measured("paint.txt")
        MeasuredBRDF('paint', 25 samples x 1 channels, 0 negative values)
    """
    file = input_file(path)
    with file.open("rb") as stream:
        head = stream.read(16)
    is_binary = b"\0" in head  # no text holds one
    is_merl = head.startswith(merl.HEADER) or file.stat().st_size == merl.SIZE
    try:
        if head.startswith(rgl.MAGIC):
            return rgl.load(file)
        # What is binary and named as MERL's is told how it differs.
        if is_merl or (is_binary and file.suffix.lower() == ".binary"):
            return merl.load(file)
        if is_binary:
            what = "is neither text in UTF-8 nor a file of MERL or RGL"
            raise InputError(path, what, "Give a MERL .binary, RGL .bsdf, Cornell or ALTA text file")
        return text.load(file)
    except InputError as error:
        names_the_file = error.where.startswith(str(path))  # else it is the table that is named
        raise error if names_the_file else InputError(path, error.what, error.remedy) from None


def is_measured(path: str | os.PathLike[str]) -> bool:
    """Whether a file's name says that it is a measured BRDF rather than a picture or a material."""
    return Path(path).suffix.lower() in (".binary", ".bsdf", ".brdf", ".alta", ".dat")
