"""Arrays in ``.npy`` files: sizes are checked before memory is taken, and nothing is unpickled."""

import math
import warnings
from typing import Any

import numpy as np

from brdf.errors import InputError


def read_array(file: Any, where: object, size: int) -> np.ndarray:
    """An array from NumPy's format: its claims are held against the size of the file before memory is taken.

    Args:
        file: open for reading bytes.
        where: the file, for messages.
        size: of the file in bytes.

    Raises:
        InputError: where it holds no plain numbers or is damaged.
    """
    damaged = "The file is damaged; make it again"
    try:
        headers = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
        read_header = headers[np.lib.format.read_magic(file)]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of what a damaged header looks like as Python
            shape, fortran, kind = read_header(file)
        if kind.kind not in "biuf":
            raise InputError(where, f"holds {kind}, not numbers", "Save plain arrays")
        count = math.prod(shape)
        if not 0 <= count * kind.itemsize <= size:
            raise InputError(where, f"claims {count} values in {size} bytes", damaged)
        return np.frombuffer(file.read(count * kind.itemsize), kind).reshape(shape, order="F" if fortran else "C")
    except InputError:
        raise
    except Exception as error:  # NumPy reads the header as Python: a damaged one raises what its parser does
        reason = str(error).partition("\n")[0][:120] or type(error).__name__
        raise InputError(where, f"is no array ({reason})", damaged) from None
