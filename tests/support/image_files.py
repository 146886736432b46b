"""Image files made byte by byte, and where the real and the damaged ones are."""

import os
import struct
import zlib
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest
from project_paths import ROOT

REAL = Path(os.environ.get("BRDF_REAL_DATA", ROOT.parent / "shared" / "data"))
BAD_IMAGES = sorted((REAL / "bad-images").glob("*.[ejp][xpn][rg]*"))

# Rounding in float32.
CURVE_TOLERANCE = 2e-7


def needs(*parts):
    path = REAL.joinpath(*parts)
    return pytest.mark.skipif(not path.exists(), reason=f"{path} is missing (BRDF_REAL_DATA)")


def srgb_to_linear(code):
    """IEC 61966-2-1."""
    return np.where(code <= 0.04045, code / 12.92, ((code + 0.055) / 1.055) ** 2.4)


def chunk(kind, data):
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def raw_png(width, height, bits, colour_type, rows, *chunks):
    """The bytes of a PNG file, after its specification; each row begins with its filter."""
    header = struct.pack(">IIBBBBB", width, height, bits, colour_type, 0, 0, 0)
    body = [(b"IHDR", header), *chunks, (b"IDAT", zlib.compress(rows)), (b"IEND", b"")]
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunk(*item) for item in body)


def png(codes, *chunks, colour_type=2):
    """A PNG file of whole bytes."""
    height, width, _ = codes.shape
    rows = b"".join(b"\0" + row.astype(row.dtype.newbyteorder(">")).tobytes() for row in codes)
    return raw_png(width, height, 8 * codes.dtype.itemsize, colour_type, rows, *chunks)


def profile(curve):
    """The bytes of an ICC profile that holds nothing but the curve, of a length that libpng believes."""
    start = 132 + 3 * 12
    curve += bytes(-len(curve) % 4) + np.random.default_rng(0).bytes(400)
    tags = b"".join(name + struct.pack(">II", start, len(curve)) for name in (b"rTRC", b"gTRC", b"bTRC"))
    size = struct.pack(">I", start + len(curve))
    head = size + bytes(4) + bytes([4, 0x20, 0, 0]) + b"mntrRGB XYZ " + bytes(12) + b"acsp" + bytes(88)
    return head + struct.pack(">I", 3) + tags + curve


def parametric(kind, *numbers):
    return (
        b"para"
        + bytes(4)
        + struct.pack(">HH", kind, 0)
        + b"".join(struct.pack(">i", round(x * 65536)) for x in numbers)
    )


def table(values):
    return b"curv" + bytes(4) + struct.pack(f">I{len(values)}H", len(values), *np.rint(values * 65535).astype(int))


def random(*shape, seed=0):
    return np.random.default_rng(seed).random(shape, np.float32)


def codes(*shape, dtype=np.uint8, seed=0):
    return np.random.default_rng(seed).integers(0, np.iinfo(dtype).max, shape, dtype, endpoint=True)


def raw(path, array, names=(), *, kind="float", tile=0, data_at=(0, 0), display=None, **attributes):
    """A file of any format by plain OpenImageIO calls."""
    spec = oiio.ImageSpec(array.shape[1], array.shape[0], array.shape[2], kind)
    if names:
        spec.channelnames = tuple(names)
    spec.tile_width = spec.tile_height = tile
    spec.x, spec.y = data_at
    if display is not None:
        spec.full_x, spec.full_y, spec.full_width, spec.full_height = display
    for name, value in attributes.items():
        spec.attribute(name, value)
    file = oiio.ImageOutput.create(str(path))
    assert file.open(str(path), spec)
    assert file.write_image(np.ascontiguousarray(array))
    assert file.close()
    return path
