"""Arrays in files, ``.npy`` and ``.npz``: sizes are checked before memory is taken, and nothing is unpickled."""

import contextlib
import math
import warnings
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from brdf.errors import InputError
from brdf.files import input_file

# What an archive may unpack to: 8 GiB of values, as for pictures; and how far Deflate can expand its bytes.
MOST_BYTES, EXPANSION = 1 << 33, 1032
REQUIRED, OPTIONAL = ("images", "normal", "light_dirs"), ("light_intensities", "mask")
DAMAGED = "The file is damaged; make it again"


@contextlib.contextmanager
def _told(where, what, remedy):
    """Whatever the readers of damaged files raise, as one line."""
    try:
        yield
    except InputError:
        raise
    except Exception as error:
        reason = str(error).partition("\n")[0][:120] or type(error).__name__
        raise InputError(where, f"{what} ({reason})", remedy) from None


def read_array(file: Any, where: object, size: int) -> np.ndarray:
    """An array from NumPy's format: its claims are held against the size of the file before memory is taken.

    Args:
        file: open for reading bytes.
        where: the file, for messages.
        size: of the file in bytes.

    Raises:
        InputError: where it holds no plain numbers or is damaged.
    """
    # NumPy reads the header as Python: a damaged one raises what its parser does, or warns.
    with _told(where, "is no array", DAMAGED), warnings.catch_warnings(action="ignore"):
        headers = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
        shape, fortran, kind = headers[np.lib.format.read_magic(file)](file)
        if kind.kind not in "biuf":
            raise InputError(where, f"holds {kind}, not numbers", "Save plain arrays")
        count = math.prod(shape)
        if not 0 <= count * kind.itemsize <= size:
            raise InputError(where, f"claims {count} values in {size} bytes", DAMAGED)
        return np.frombuffer(file.read(count * kind.itemsize), kind).reshape(shape, order="F" if fortran else "C")


def read_archive(path: Path) -> dict[str, np.ndarray]:
    """The arrays of a photometric-stereo archive; nothing is unpickled, and nothing else in it is read.

    Args:
        path: an .npz file.

    Raises:
        InputError: where it is no archive, an array is missing, or its claims do not fit its size.
    """
    # Damaged, cut short, with a password, of an unknown method.
    with (
        _told(path, "is no readable archive", "Save it with numpy.savez"),
        zipfile.ZipFile(input_file(path)) as archive,
    ):
        sizes = {info.filename.removesuffix(".npy"): info.file_size for info in archive.infolist()}
        missing = [name for name in REQUIRED if name not in sizes]
        if missing:
            raise InputError(
                path,
                f"holds no array {missing[0]}",
                f"Photographs need {', '.join(REQUIRED)}, and may have {' and '.join(OPTIONAL)}",
            )
        wanted = {name: sizes[name] for name in (*REQUIRED, *OPTIONAL) if name in sizes}
        if sum(wanted.values()) > min(MOST_BYTES, EXPANSION * path.stat().st_size + (1 << 20)):
            raise InputError(path, "claims more than can be in it", DAMAGED)
        arrays = {}
        for name, size in wanted.items():
            with archive.open(f"{name}.npy") as file:
                arrays[name] = read_array(file, f"{path}: {name}", size)
        return arrays
