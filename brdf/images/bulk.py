"""What a damaged file may hold so much of that a library takes seconds for it, counted before the file is opened."""

import struct
from pathlib import Path
from typing import BinaryIO

from brdf.errors import InputError

# What programs write stays far below; opening takes seconds for some ten thousand.
MOST_ATTRIBUTES = 1 << 12
MOST_CHANNELS = 1 << 10
MOST_PARTS = 1 << 10
# Each scan of a progressive JPEG file goes over the whole picture. libjpeg-turbo's own tests stop there.
MOST_SCANS = 500

_DAMAGED = "The file is damaged; make it again"
_EXR, _JPEG = b"v/1\x01", b"\xff\xd8\xff"
_SEVERAL_PARTS = 0x1000
_LONGEST_HEADER = 1 << 24


def check_bulk(path: Path) -> None:
    """Refuse an OpenEXR file with too many attributes, channels or parts, and a JPEG file with too many scans.

    Args:
        path: an ordinary file of any format.

    Raises:
        InputError: naming the file, what there is too much of, and the most that is read.
    """
    with path.open("rb") as file:
        magic = file.read(4)
        file.seek(0)
        if magic == _EXR:
            _check_openexr(path, file.read(_LONGEST_HEADER))
        elif magic.startswith(_JPEG):
            _check_jpeg(path, file)


def _check_openexr(path: Path, content: bytes) -> None:
    """Walk along the headers (OpenEXR file layout); what is wrong with them otherwise is OpenEXR's to tell."""
    several = len(content) > 8 and struct.unpack_from("<I", content, 4)[0] & _SEVERAL_PARTS
    at, attributes, parts = 8, 0, 1
    while at < len(content):
        if content[at] == 0:  # the end of a header, two in a row that of all
            at, attributes, parts = at + 1, 0, parts + 1
            if not several or content[at : at + 1] == b"\0":
                return
            _check_count(path, "parts", parts, MOST_PARTS)
            continue
        words = content[at : at + 512].split(b"\0", 2)
        at += sum(len(word) + 1 for word in words[:2])
        if len(words) < 3 or at + 4 > len(content):
            return
        (size,) = struct.unpack_from("<I", content, at)
        at += 4
        if words[1] == b"chlist":
            _check_count(path, "channels", _channels(content[at : at + size]), MOST_CHANNELS)
        at += size
        attributes += 1
        _check_count(path, "attributes", attributes, MOST_ATTRIBUTES)


def _channels(entries: bytes) -> int:
    """How many a list of channels has: of each a name, a null and 16 bytes of what it is."""
    at = count = 0
    while count <= MOST_CHANNELS and at < len(entries) and entries[at]:
        end = entries.find(b"\0", at)
        if end < 0:
            break
        at, count = end + 17, count + 1
    return count


def _check_jpeg(path: Path, file: BinaryIO) -> None:
    scans = 0
    while content := file.read(1 << 20):
        # Compressed data hold no such bytes (ITU T.81, B.1.1.5).
        scans += content.count(b"\xff\xda")
        _check_count(path, "scans", scans, MOST_SCANS)


def _check_count(path: Path, what: str, count: int, most: int) -> None:
    if count > most:
        raise InputError(path, f"holds more than {most} {what}", _DAMAGED)
