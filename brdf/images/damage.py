"""What is refused before memory and time are taken for it: damaged files, and hostile ones.

OpenImageIO and the libraries below it refuse most. Left to be found here are sizes that the file cannot hold, headers
that take the libraries seconds, and damage that libpng would tell on standard error itself.
"""

import mmap
import os
import re
import struct
import zlib
from pathlib import Path

import OpenImageIO as oiio

from brdf.channels import MOST_CHANNELS
from brdf.errors import InputError

MAX_VALUES = 1 << 31
"""Most values (height × width × channels) of a picture in memory: 8 GiB."""
MAX_RATIO = 1 << 12
"""Most bytes of pixels per byte of file, beyond 64 MiB; deflate reaches 1032, a small ball on black in DWAB 2077."""
# OpenEXR takes seconds for some ten thousand in one part.
MOST_ATTRIBUTES = 1 << 12
# Each scan of a progressive JPEG file goes over the whole picture. libjpeg-turbo's own tests stop there.
MOST_SCANS = 500

# OpenImageIO's own limit is 1024.
oiio.attribute("limits:channels", MOST_CHANNELS)

_UNSUSPICIOUS_BYTES = 1 << 26
_AGAIN = "The file is damaged; make it again"
_SEVERAL_PARTS = 0x10
# A name, a null and 16 bytes of what it is (OpenEXR file layout).
_CHANNEL = re.compile(rb"[^\0]+\0.{16}", re.DOTALL)
_SCAN = re.compile(rb"\xff\xda")


def check_content(path: Path) -> None:
    """Refuse what libraries would take long for, or tell on standard error.

    Args:
        path: an ordinary file of any format, not empty.

    Raises:
        InputError: naming the file, what there is too much of, and the most that is read; or where a PNG is damaged.
    """
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
        if content[:4] == b"v/1\x01":
            _check_openexr(path, content)
        elif content[:3] == b"\xff\xd8\xff":
            _check_jpeg(path, content)
        elif content[:4] == b"\x89PNG":
            _check_png(path, content)


def _check_openexr(path: Path, content: mmap.mmap) -> None:
    """Walk along the headers: name, kind, size and value of each attribute, a null at the end."""
    at, attributes = 8, 0
    while at < len(content):
        if content[at] == 0:
            at, attributes = at + 1, 0
            if not content[5] & _SEVERAL_PARTS or content[at : at + 1] == b"\0":
                return
        kind = content.find(b"\0", at) + 1
        value = content.find(b"\0", kind) + 5
        if kind == 0 or value == 4 or value > len(content):
            return
        (size,) = struct.unpack_from("<I", content, value - 4)
        attributes += 1
        _check_count(path, "attributes", attributes, MOST_ATTRIBUTES)
        if content[kind : value - 4] == b"chlist\0":
            _check_count(path, "channels", len(_CHANNEL.findall(content, value, value + size)), MOST_CHANNELS)
        at = value + size


def _check_jpeg(path: Path, content: mmap.mmap) -> None:
    """Count the scans between the segments, which may hold thumbnails, and the end, behind which may be a film."""
    at = 2
    while content[at : at + 1] == b"\xff" and content[at + 1 : at + 2] != b"\xda":
        at += 2 + int.from_bytes(content[at + 2 : at + 4])
    end = content.find(b"\xff\xd9", at)
    _check_count(path, "scans", len(_SCAN.findall(content, at, end if end > 0 else len(content))), MOST_SCANS)


def _check_png(path: Path, content: mmap.mmap) -> None:
    """Compare the checksums of what a picture needs; libpng leaves other chunks out where theirs are wrong."""
    at = 8
    while at + 8 <= len(content):
        length, kind = struct.unpack_from(">I4s", content, at)
        if not kind.isalpha():
            raise InputError(path, "is damaged: it holds a chunk of no type", _AGAIN)
        body, at = slice(at + 4, at + 8 + length), at + 12 + length
        if kind[:1].isupper() and content[body.stop : at] != struct.pack(">I", zlib.crc32(content[body])):
            raise InputError(path, f"is damaged: the checksum of its {kind.decode('latin-1')} is wrong", _AGAIN)
        if kind == b"IEND":
            return


def _check_count(path: Path, what: str, count: int, most: int) -> None:
    if count > most:
        raise InputError(path, f"holds more than {most} {what}", _AGAIN)


def check_header(path: Path, spec: oiio.ImageSpec) -> None:
    """Refuse what no picture is.

    Args:
        path: the file, for its size and the message.
        spec: the header of one of its parts.

    Raises:
        InputError: for deep and volume data, and for sizes that the file cannot hold.
    """
    if spec.deep:
        raise InputError(path, "holds deep samples, not pixels", "Flatten it first")
    if spec.depth > 1:
        raise InputError(path, f"holds a volume of depth {spec.depth}, not a picture", "Give one slice of it")
    # A tile is unpacked whole.
    sizes = [(spec.width, spec.height), (spec.full_width, spec.full_height), (spec.tile_width, spec.tile_height)]
    width, height = max(sizes, key=lambda size: size[0] * size[1])
    claimed, size = width * height * spec.pixel_bytes(native=True), path.stat().st_size
    if claimed > max(_UNSUSPICIOUS_BYTES, MAX_RATIO * size) or min(spec.width, spec.height, spec.nchannels) < 1:
        what = f"claims {width} × {height} pixels of {spec.nchannels} channels in {size} bytes"
        raise InputError(path, what, _AGAIN)


def check_memory(path: Path, values: int) -> None:
    """Refuse a picture that does not fit into memory as float32.

    Args:
        path: the file, for the message.
        values: height × width × channels.

    Raises:
        InputError: if there are more than `MAX_VALUES`, or more bytes than the machine has.
    """
    most = MAX_VALUES
    if hasattr(os, "sysconf"):
        most = min(most, os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") // 4)
    if values > most:
        what = f"needs {values / 2**28:.1f} GiB, at most {most / 2**28:.1f} can be had"
        raise InputError(path, what, "Read it by bands of rows with brdf.ImageReader, or make it smaller")
