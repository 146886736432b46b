"""Arrays in files, ``.npy`` and ``.npz``: sizes are checked before memory is taken, and nothing is unpickled."""

import tokenize
import warnings
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from brdf.errors import InputError
from brdf.files import input_file

# What an archive may unpack to: 8 GiB of values, as for pictures.
MOST_BYTES = 1 << 33
ARCHIVE = ("images", "normal", "light_dirs")

# What NumPy and zipfile raise for a header that is none: it is read as a Python literal.
_DAMAGE = (
    ValueError,
    OSError,
    EOFError,
    TypeError,
    OverflowError,
    SyntaxError,
    SystemError,  # what Python 3.13 makes of a header with a null byte
    tokenize.TokenError,
    zipfile.BadZipFile,
    zlib.error,
)
# What zipfile raises for an archive that it cannot read: RuntimeError is one with a password.
_DAMAGED_ARCHIVE = (
    zipfile.BadZipFile,
    zipfile.LargeZipFile,
    zlib.error,
    OSError,
    EOFError,
    NotImplementedError,
    RuntimeError,
)


def read_array(file: Any, place: object, size: int) -> np.ndarray:
    """An array from NumPy's format: its claims are held against the size of the file before memory is taken.

    Args:
        file: open for reading bytes.
        place: the file, for messages.
        size: of the file in bytes.

    Raises:
        InputError: where it holds no plain numbers or is damaged.
    """
    try:
        version = np.lib.format.read_magic(file)
        if version not in ((1, 0), (2, 0)):
            raise InputError(place, f"is of NumPy's format {version}", "Save it with numpy.save")
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of what a damaged header looks like as Python
            shape, fortran, kind = read(file)
        count = 1
        for length in shape:
            count *= length
        if kind.hasobject or kind.kind not in "biuf":
            raise InputError(place, f"holds {kind}, not numbers", "Save plain arrays")
        if not 0 <= count * kind.itemsize <= min(size, MOST_BYTES):
            raise InputError(place, f"claims {count} values in {size} bytes", "The file is damaged; make it again")
        content = file.read(count * kind.itemsize)
        if len(content) < count * kind.itemsize:
            raise InputError(place, "ends before its last value", "The file is damaged; make it again")
        return np.frombuffer(content, kind).reshape(shape, order="F" if fortran else "C")
    except _DAMAGE as error:
        if isinstance(error, InputError):
            raise
        reason = str(error).splitlines()[0][:120] if str(error) else type(error).__name__
        raise InputError(place, f"is no array ({reason})", "The file is damaged; make it again") from None


def read_archive(path: Path) -> dict[str, np.ndarray]:
    """The arrays of a photometric-stereo archive; nothing is unpickled, and nothing else in it is read.

    Args:
        path: an .npz file.

    Raises:
        InputError: where it is no archive, an array is missing, or its claims do not fit its size.
    """
    try:
        with zipfile.ZipFile(input_file(path)) as archive:
            sizes = {info.filename: info.file_size for info in archive.infolist()}
            missing = [name for name in ARCHIVE if f"{name}.npy" not in sizes]
            if missing:
                remedy = f"Photographs need {', '.join(ARCHIVE)}, and may have light_intensities and mask"
                raise InputError(path, f"holds no array {missing[0]}", remedy)
            wanted = [name for name in (*ARCHIVE, "light_intensities", "mask") if f"{name}.npy" in sizes]
            if sum(sizes[f"{name}.npy"] for name in wanted) > min(MOST_BYTES, 1032 * path.stat().st_size + (1 << 20)):
                raise InputError(path, "claims more than can be in it", "The file is damaged; make it again")
            arrays = {}
            for name in wanted:
                with archive.open(f"{name}.npy") as file:
                    arrays[name] = read_array(file, f"{path}: {name}", sizes[f"{name}.npy"])
            return arrays
    except _DAMAGED_ARCHIVE as error:
        raise InputError(path, f"is no readable archive ({type(error).__name__})", "Save it with numpy.savez") from None
