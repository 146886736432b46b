"""Arrays in files, ``.npy`` and ``.npz``: no memory is filled that the file does not, and nothing is unpickled."""

import contextlib
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


def read_array(file: Any, where: object) -> np.ndarray:
    """An array from NumPy's format; whatever a damaged one claims, no more memory is filled than there is to read.

    Refused where it holds no plain numbers or is damaged; ``where`` names it.
    """
    # NumPy reads the header as Python: a damaged one raises what its parser does, or warns.
    with _told(where, "is no array", "Save plain numbers with numpy.save"), warnings.catch_warnings(action="ignore"):
        array = np.lib.format.read_array(file, allow_pickle=False)
        if array.dtype.kind not in "biuf":
            raise InputError(where, f"holds {array.dtype}, not numbers", "Save plain numbers")
        return array


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
            raise InputError(path, "claims more than can be in it", "The file is damaged; make it again")
        arrays = {}
        for name in wanted:
            with archive.open(f"{name}.npy") as file:
                arrays[name] = read_array(file, f"{path}: {name}")
        return arrays
