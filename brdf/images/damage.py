"""What is refused before memory and time are taken for it: damaged files, and hostile ones.

OpenImageIO and the libraries below it refuse most. Left to be found here are sizes that the file cannot hold, headers
that take the libraries seconds, and damage that libpng would tell on standard error itself.
"""

import math
import mmap
import os
import re
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
# Name and kind with a null behind each, and the size of the value; of a channel a name, a null and 16 bytes of what it
# is (OpenEXR file layout).
_ATTRIBUTE = re.compile(rb"[^\0]+\0([^\0]+)\0(.{4})", re.DOTALL)
_CHANNEL = re.compile(rb"[^\0]+\0.{16}", re.DOTALL)


def check_content(path: Path) -> None:
    """Refuse what libraries would take long for, or tell on standard error, of an ordinary file that is not empty."""
    checks = {b"v/1\x01": _check_openexr, b"\xff\xd8\xff": _check_jpeg, b"\x89PNG": _check_png}
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
        for magic, check in checks.items():
            if content[: len(magic)] == magic:
                check(path, content)


def _check_openexr(path: Path, content: mmap.mmap) -> None:
    """Count attributes and channels in the header of each part, behind which is a null."""
    at, attributes = 8, 0
    while found := _ATTRIBUTE.match(content, at):
        at = found.end() + int.from_bytes(found[2], "little")
        attributes += 1
        _check_count(path, "attributes", attributes, MOST_ATTRIBUTES)
        if found[1] == b"chlist":
            _check_count(path, "channels", len(_CHANNEL.findall(content, found.end(), at)), MOST_CHANNELS)
        if content[at : at + 1] == b"\0":
            at, attributes = at + 1, 0
            if not content[5] & _SEVERAL_PARTS:
                return


def _check_jpeg(path: Path, content: mmap.mmap) -> None:
    """Count the scans between the segments, which may hold thumbnails, and the end, behind which may be a film."""
    at = 2
    while content[at : at + 1] == b"\xff" and content[at + 1 : at + 2] != b"\xda":
        at += 2 + int.from_bytes(content[at + 2 : at + 4])
    scans = content[at:].partition(b"\xff\xd9")[0].count(b"\xff\xda")
    _check_count(path, "scans", scans, MOST_SCANS)


def _check_png(path: Path, content: mmap.mmap) -> None:
    """Compare the checksums of what a picture needs; libpng leaves other chunks out where theirs are wrong."""
    at, kind = 8, b""
    while kind != b"IEND" and at + 8 <= len(content):
        end = at + 8 + int.from_bytes(content[at : at + 4])
        kind = content[at + 4 : at + 8]
        if not kind.isalpha():
            raise InputError(path, "is damaged: it holds a chunk of no type", _AGAIN)
        if kind[:1].isupper() and zlib.crc32(content[at + 4 : end]) != int.from_bytes(content[end : end + 4]):
            raise InputError(path, f"is damaged: the checksum of its {kind.decode()} is wrong", _AGAIN)
        at = end + 4


def _check_count(path: Path, what: str, count: int, most: int) -> None:
    if count > most:
        raise InputError(path, f"holds more than {most} {what}", _AGAIN)


def check_header(path: Path, spec: oiio.ImageSpec) -> None:
    """Refuse deep and volume data, and sizes that the file cannot hold, by the header of one of its parts."""
    if spec.deep:
        raise InputError(path, "holds deep samples, not pixels", "Flatten it first")
    if spec.depth > 1:
        raise InputError(path, f"holds a volume of depth {spec.depth}, not a picture", "Give one slice of it")
    # A tile is unpacked whole.
    sizes = [(spec.width, spec.height), (spec.full_width, spec.full_height), (spec.tile_width, spec.tile_height)]
    width, height = max(sizes, key=math.prod)
    claimed, size = width * height * spec.pixel_bytes(native=True), path.stat().st_size
    if claimed > max(_UNSUSPICIOUS_BYTES, MAX_RATIO * size) or min(spec.width, spec.height, spec.nchannels) < 1:
        what = f"claims {width} × {height} pixels of {spec.nchannels} channels in {size} bytes"
        raise InputError(path, what, _AGAIN)


def check_memory(path: Path, values: int) -> None:
    """Refuse a picture of more values than `MAX_VALUES`, or than fit into memory as float32."""
    most = MAX_VALUES
    if hasattr(os, "sysconf"):
        most = min(most, os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") // 4)
    if values > most:
        what = f"needs {values / 2**28:.1f} GiB, at most {most / 2**28:.1f} can be had"
        raise InputError(path, what, "Read it by bands of rows with brdf.ImageReader, or make it smaller")
