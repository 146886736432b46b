"""Image files as OpenImageIO opens them, and what it leaves to be checked: sizes, damage, which channels are colour."""

import os
import sys
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import OpenImageIO as oiio  # noqa: N813

from brdf.errors import InputError
from brdf.files import utf8_name
from brdf.images.bulk import check_bulk

MAX_VALUES = 1 << 31
"""Most values (height × width × channels) of a picture in memory: 8 GiB."""
BAND_VALUES = 1 << 22
"""Values of a band, where nobody asks for another number: 16 MiB."""
MAX_RATIO = 1 << 12
"""Most bytes of pixels per byte of file, over 64 MiB in OpenEXR and TIFF and 32 MiB elsewhere; deflate reaches 1032, a
small ball on black in DWAB 2077."""

# To decode so much takes less than half a gigabyte: where all is unpacked at once, with wavelets and such, and where
# that is done strip by strip, by compressions that leave next to nothing of an even area.
_UNSUSPICIOUS_BYTES = 1 << 25
_UNSUSPICIOUS_IN_STRIPS = {"openexr": 1 << 26, "tiff": 1 << 26}
# Remarks that libjpeg makes on sound pictures of some cameras.
_HARMLESS = ("extraneous bytes", "Invalid SOS parameters")
_GIVE_AN_IMAGE = "Give an EXR, HDR, PNG, TIFF or JPEG file"


def said(source: Any, path: str | os.PathLike[str] = "") -> str:
    """What OpenImageIO says went wrong, the first line of it, and forgets then.

    Args:
        source: the image input or output, or the module itself for a file that did not open.
        path: a name to leave out, the message having it already.
    """
    try:
        message = source.geterror()
    except UnicodeDecodeError as error:
        # Bytes of a damaged header, quoted by the reader.
        message = error.object.decode("utf-8", "replace")
    lines = [line.strip() for line in message.splitlines() if line.strip()]
    line = lines[0] if lines else "no reason given"
    if path:
        for named in (f" ({path})", f' ("{path}")', f' for "{path}"', f' "{path}"', f'"{path}" ', f'"{path}": '):
            line = line.replace(named, "")
        line = line.replace(str(path), "it")
    return (line if len(line) <= 200 else line[:197] + "...").rstrip(". ")


_quiet_lock = threading.Lock()
_quiet_depth = 0
_quiet_state: Any = None


@contextmanager
def quiet(format_name: str) -> Iterator[None]:
    """Keep libpng from writing to standard error itself, which no option of OpenImageIO prevents.

    What others write to standard error meanwhile is written when the outermost block ends.

    Args:
        format_name: the format being read or written; only those that libpng reads, "png" and "ico", do anything.
    """
    global _quiet_depth, _quiet_state
    if format_name not in ("png", "ico"):
        yield
        return
    with _quiet_lock:
        _quiet_depth += 1
        if _quiet_depth == 1:
            _quiet_state = _divert()
    try:
        yield
    finally:
        with _quiet_lock:
            _quiet_depth -= 1
            if _quiet_depth == 0 and _quiet_state is not None:
                _restore(*_quiet_state)


def _divert() -> tuple[int, Any] | None:
    try:
        original = os.dup(2)
    except OSError:
        return None  # no standard error, nothing to keep quiet
    caught = tempfile.TemporaryFile()
    os.dup2(caught.fileno(), 2)
    return original, caught


def _restore(original: int, caught: Any) -> None:
    if sys.stderr is not None:
        sys.stderr.flush()
    os.dup2(original, 2)
    os.close(original)
    with caught:
        caught.seek(0)
        others = b"".join(line for line in caught if not line.startswith(b"libpng "))
    if others:
        os.write(2, others)


def open_image(path: Path) -> oiio.ImageInput:
    """Open a file with OpenImageIO; what is no image is an error.

    Args:
        path: an ordinary file.

    Raises:
        InputError: if OpenImageIO cannot read it, or what it claims cannot be in it.
    """
    request = oiio.ImageSpec()
    # Colour as stored: what a half-transparent pixel shows is not darkened.
    request.attribute("oiio:UnassociatedAlpha", 1)
    with path.open("rb") as file:
        kind = {b"\x89PNG": "png", b"\0\0\1\0": "ico"}.get(file.read(4), "")
    check_bulk(path)
    with quiet(kind):
        image = oiio.ImageInput.open(utf8_name(path), request)
    if image is None:
        raise InputError(path, f"cannot be read as an image ({said(oiio, path)})", _GIVE_AN_IMAGE)
    if image.format_name() in ("null", "term"):
        raise InputError(path, "is not an image", _GIVE_AN_IMAGE)
    said(image)  # remarks on metadata; the pixels may be sound
    check_header(path, image.spec(), image.format_name())
    return image


def check_header(path: Path, spec: oiio.ImageSpec, format_name: str) -> None:
    """Refuse what no picture is, before memory is taken for it.

    Args:
        path: the file, for its size and the message.
        spec: the header of one of its parts.
        format_name: as OpenImageIO calls the format.

    Raises:
        InputError: for deep and volume data, and for sizes that the file cannot hold.
    """
    if spec.deep:
        raise InputError(path, "holds deep samples, not pixels", "Flatten it first")
    if spec.depth > 1:
        raise InputError(path, f"holds a volume of depth {spec.depth}, not a picture", "Give one slice of it")
    width, height = max(
        (spec.width, spec.height), (spec.full_width, spec.full_height), key=lambda size: size[0] * size[1]
    )
    claimed, size = width * height * spec.pixel_bytes(native=True), path.stat().st_size
    possible = MAX_RATIO * size
    if min(spec.width, spec.height, spec.nchannels) < 1:
        raise InputError(path, f"claims {spec.width} × {spec.height} pixels", "The file is damaged; make it again")
    what = ""
    if claimed > max(_UNSUSPICIOUS_IN_STRIPS.get(format_name, _UNSUSPICIOUS_BYTES), possible):
        what = f"claims {width} × {height} pixels of {spec.nchannels} channels in {size} bytes"
    # One tile is unpacked whole; rounding up makes it four times the picture at most.
    elif spec.tile_width * spec.tile_height * spec.pixel_bytes(native=True) > max(
        _UNSUSPICIOUS_BYTES, 4 * min(claimed, possible)
    ):
        what = f"claims tiles of {spec.tile_width} × {spec.tile_height} for {width} × {height} pixels"
    if what:
        raise InputError(path, what, "The file is damaged; make it again")


class Channels(NamedTuple):
    """Which part and channels of a file are the picture."""

    part: int
    colour: list[int]
    alpha: int | None


def choose_channels(image: oiio.ImageInput) -> Channels:
    """The channels that are the picture; alpha, depth and further layers are left apart.

    Only OpenEXR files name their channels reliably: R, G, B or Y of the unnamed layer are the picture, in the first
    part that has them, else those of the first layer that has them, else (a spectral file) all channels in the order
    of the file. In other formats the picture is what comes before alpha.
    """
    spec = image.spec()
    if image.format_name() != "openexr":
        # Some readers name an alpha channel beyond the last one.
        known = 0 < spec.alpha_channel < spec.nchannels
        alpha = spec.alpha_channel if known else spec.channelnames.index("A") if "A" in spec.channelnames[1:] else None
        return Channels(0, list(range(spec.nchannels if alpha is None else alpha)), alpha)
    names = [_names(image, part) for part in range(parts(image))]
    for main_only in (True, False):
        for part, of_part in enumerate(names):
            layers = [""] if main_only else dict.fromkeys(name.rpartition(".")[0] for name in of_part)
            # Looked up, not searched for: there may be thousands.
            at = {name: index for index, name in reversed(list(enumerate(of_part)))}
            for layer in layers:
                dot = f"{layer}." if layer else ""
                for wanted in ("rgb", "y"):
                    if all(dot + name in at for name in wanted):
                        return Channels(part, [at[dot + name] for name in wanted], at.get(dot + "a"))
    rest = [index for index, name in enumerate(names[0]) if name not in ("a", "z")] or list(range(len(names[0])))
    return Channels(0, rest, names[0].index("a") if "a" in names[0] and len(names[0]) > 1 else None)


def parts(image: oiio.ImageInput) -> int:
    """The number of parts of a file."""
    return max(1, min(image.spec().get_int_attribute("oiio:subimages"), 1000))


def _names(image: oiio.ImageInput, part: int) -> list[str]:
    return [name.lower() for name in image.spec(part).channelnames]


def band_rows(spec: oiio.ImageSpec, values: int) -> int:
    """How many rows make a band of about so many values: whole tiles and compressed blocks, or they are decoded twice.

    Args:
        spec: the header.
        values: width × channels × rows.
    """
    block = min(spec.tile_height or max(1, spec.get_int_attribute("oiio:RowsPerChunk", 1)), spec.height)
    return max(1, values // (spec.width * spec.nchannels * block)) * block


def read_rows(
    path: Path, image: oiio.ImageInput, part: int, rows: tuple[int, int], channels: tuple[int, int], kind: str
) -> np.ndarray:
    """Rows of the data window, converted by OpenImageIO to one type.

    Args:
        path: the file, for the message.
        image: the open file.
        part: which part of it.
        rows: first row and the one after the last, from the top of the data window.
        channels: first channel and the one after the last.
        kind: "float", "uint8" or "uint16".

    Returns:
        (rows, width, channels).

    Raises:
        InputError: if the data are damaged or missing.
    """
    spec = image.spec(part)
    first, last, width = spec.y + rows[0], spec.y + rows[1], spec.width
    skip = 0
    with quiet(image.format_name()):
        if spec.tile_width:
            # OpenImageIO takes whole tiles only.
            skip = rows[0] % spec.tile_height
            last = min(spec.y - (-rows[1] // spec.tile_height) * spec.tile_height, spec.y + spec.height)
            sides = (spec.x, spec.x + width, first - skip, last, spec.z, spec.z + 1)
            pixels = image.read_tiles(part, 0, *sides, *channels, kind)
        else:
            pixels = image.read_scanlines(part, 0, first, last, spec.z, *channels, kind)
    complaint = said(image, path) if image.has_error else ""
    if pixels is None or (complaint and not any(remark in complaint for remark in _HARMLESS)):
        what = f"is damaged: rows {rows[0]} to {rows[1]} of {spec.height} cannot be read ({complaint or 'no data'})"
        raise InputError(path, what, "Make the file again")
    return pixels.reshape(-1, width, channels[1] - channels[0])[skip : skip + rows[1] - rows[0]]


def check_memory(path: Path, values: int) -> None:
    """Refuse a picture that does not fit into memory as float32.

    Args:
        path: the file, for the message.
        values: height × width × channels.

    Raises:
        InputError: if there are more than ``MAX_VALUES``, or more bytes than the machine has.
    """
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") if hasattr(os, "sysconf") else 4 * MAX_VALUES
    if 4 * values > min(4 * MAX_VALUES, memory):
        what = f"needs {4 * values / 2**30:.1f} GiB, at most {min(4 * MAX_VALUES, memory) / 2**30:.1f} can be had"
        raise InputError(path, what, "Read it by bands of rows with brdf.ImageReader, or make it smaller")
