"""Files of measured BRDFs in the layouts of MERL and RGL, and the angle between directions."""

import struct
from pathlib import Path

import numpy as np

from brdf.measured import rgl as measured_rgl


def degrees_between(a, b):
    return np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), np.sum(a * b, axis=-1)))


def write_merl(path: Path, stored: np.ndarray, sizes=(90, 90, 180)) -> Path:
    path.write_bytes(struct.pack("<3i", *sizes) + stored.astype("<f8").tobytes())
    return path


def tensor_file(**changes) -> bytes:
    """A small isotropic file: a constant, as far as anyone can tell."""
    one = np.ones
    fields = {
        "description": np.frombuffer(b"test", "u1"),
        "phi_i": np.zeros(1, "<f4"),
        "theta_i": np.linspace(0, 1.5, 4, dtype="<f4"),
        "sigma": one((2, 8), "<f4"),
        "ndf": one((2, 8), "<f4"),
        "vndf": one((1, 4, 8, 8), "<f4"),
        "luminance": one((1, 4, 4, 4), "<f4"),
        "rgb": one((1, 4, 3, 4, 4), "<f4"),
        "jacobian": np.zeros(1, "u1"),
    } | changes
    fields = {name: array for name, array in fields.items() if array is not None}
    codes = {"u1": 1, "u4": 5, "f4": 10}
    head = sum(2 + len(name) + 11 + 8 * array.ndim for name, array in fields.items())
    start, header, body = 18 + head, b"", b""
    for name, array in fields.items():
        code = codes[array.dtype.str[1:]]
        header += (
            struct.pack("<H", len(name)) + name.encode() + struct.pack("<HBQ", array.ndim, code, start + len(body))
        )
        header += struct.pack(f"<{array.ndim}Q", *array.shape)
        body += array.tobytes()
    return measured_rgl.MAGIC + bytes([1, 0]) + struct.pack("<I", len(fields)) + header + body
