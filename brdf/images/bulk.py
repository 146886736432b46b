"""What a damaged file may hold so much of that a library takes seconds for it, counted before the file is opened."""

import re
import struct
from pathlib import Path
from typing import BinaryIO

import OpenImageIO as oiio  # noqa: N813

from brdf.errors import InputError

# What programs write stays far below; opening takes seconds for some ten thousand in one part.
MOST_ATTRIBUTES = 1 << 12
# As for materials and measured tables: more are no spectrum.
MOST_CHANNELS = 1 << 12
MOST_PARTS = 1 << 10
# Attributes, or channels, of all parts together.
MOST_IN_ALL = 1 << 16
# Each scan of a progressive JPEG file goes over the whole picture. libjpeg-turbo's own tests stop there.
MOST_SCANS = 500
# A segment has up to 64 KiB: more would be 4 GiB of remarks.
MOST_SEGMENTS = 1 << 16

# OpenImageIO's own limit is 1024.
oiio.attribute("limits:channels", MOST_CHANNELS)

_DAMAGED = "The file is damaged; make it again"
_EXR, _JPEG = b"v/1\x01", b"\xff\xd8\xff"
_SEVERAL_PARTS = 0x1000
# Two names of 255 bytes, each with a null, and a size.
_LONGEST_START = 516
# A name of 255 bytes, a null and 16 bytes of what it is, of each channel and one too many.
_LONGEST_LIST = (MOST_CHANNELS + 1) * 272
# A marker with something behind it: no stuffed byte, filling, restart or TEM (ITU T.81, B.1.1.2 to B.1.1.5).
_MARKER = re.compile(rb"\xff[\x02-\xcf\xd8-\xfe]")
_END, _SCAN = 0xD9, 0xDA
_WINDOW = 1 << 20


def check_bulk(path: Path) -> None:
    """Refuse an OpenEXR file with too many attributes, channels or parts, and a JPEG file with too many scans.

    Of an OpenEXR file each part may have ``MOST_ATTRIBUTES`` and ``MOST_CHANNELS``, and all parts ``MOST_IN_ALL`` of
    either. Of a JPEG file what comes before the end of the image counts; phones append films to it.

    Args:
        path: an ordinary file of any format.

    Raises:
        InputError: naming the file, what there is too much of, and the most that is read.
    """
    with path.open("rb") as file:
        magic = file.read(4)
        if magic == _EXR:
            _check_openexr(path, file)
        elif magic.startswith(_JPEG):
            _check_jpeg(path, file)


def _check_openexr(path: Path, file: BinaryIO) -> None:
    """Walk along the headers (OpenEXR file layout); what is wrong with them otherwise is OpenEXR's to tell."""
    flags = file.read(4)
    several = len(flags) == 4 and struct.unpack("<I", flags)[0] & _SEVERAL_PARTS
    at, parts, attributes, all_attributes, all_channels = 8, 1, 0, 0, 0
    while True:
        file.seek(at)
        start = file.read(_LONGEST_START)
        if start[:1] == b"\0":  # the end of a header, two in a row that of all
            at, attributes, parts = at + 1, 0, parts + 1
            if not several or start[1:2] == b"\0":
                return
            _check_count(path, "parts", parts, MOST_PARTS)
            continue
        words = start.split(b"\0", 2)
        length = sum(len(word) + 1 for word in words[:2])
        if len(words) < 3 or length + 4 > len(start):
            return
        (size,) = struct.unpack_from("<I", start, length)
        at += length + 4
        if words[1] == b"chlist":
            file.seek(at)
            channels = _channels(file.read(min(size, _LONGEST_LIST)))
            all_channels += channels
            _check_count(path, "channels", channels, MOST_CHANNELS)
            _check_count(path, "channels", all_channels, MOST_IN_ALL)
        at += size
        attributes, all_attributes = attributes + 1, all_attributes + 1
        _check_count(path, "attributes", attributes, MOST_ATTRIBUTES)
        _check_count(path, "attributes", all_attributes, MOST_IN_ALL)


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
    """Go from segment to segment by their lengths, and by their markers over what else there is, as libjpeg does."""
    at, segments, scans = 2, 0, 0
    while True:
        file.seek(at)
        window = file.read(_WINDOW)
        if len(window) < 4:
            return
        done = 0
        while (found := _MARKER.search(window, done)) and found.end() + 2 <= len(window):
            marker = window[found.end() - 1]
            if marker == _END:
                return
            segments, scans = segments + 1, scans + (marker == _SCAN)
            _check_count(path, "scans", scans, MOST_SCANS)
            _check_count(path, "segments", segments, MOST_SEGMENTS)
            # The length counts its own two bytes.
            done = found.end() + max(2, int.from_bytes(window[found.end() : found.end() + 2]))
        # The last byte may be the first of a marker.
        at += found.start() if found else max(done, len(window) - 1)


def _check_count(path: Path, what: str, count: int, most: int) -> None:
    if count > most:
        raise InputError(path, f"holds more than {most} {what}", _DAMAGED)
