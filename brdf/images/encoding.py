"""How pixel values stand for light: linear, sRGB or a power, and what a file says about it.

Only the curve is undone: channels keep the primaries that the file was made with, because
a fit treats channels independently. In order of authority, an encoding is

| source     | what decides                                                                                    |
| ---------- | ----------------------------------------------------------------------------------------------- |
| `given`    | the user                                                                                        |
| `file`     | PNG cICP, ICC profile, sRGB, gAMA; Exif colour space; OpenEXR interoperability id; TGA gamma; … |
| `format`   | floats are linear; JPEG, GIF and WebP are sRGB                                                  |
| `assumed`  | the file is silent: integers of up to 8 bits are taken as sRGB, of more as linear               |
"""

import functools
import re
import struct
from pathlib import Path
from typing import Any, Literal

import numpy as np
import OpenImageIO as oiio  # noqa: N813
from jaxtyping import Float, Float32, UInt8

from brdf.errors import InputError

Encoding = Literal["linear", "srgb"] | float
EncodingSource = Literal["given", "file", "format", "assumed"]

_DISPLAY_FORMATS = ("jpeg", "gif", "webp")
_HOW_TO_SAY = 'Say how it is encoded: "linear", "srgb" or a gamma like 2.2'
# g, a, b, c, d of y = (a x + b)^g for x >= d, c x below: sRGB as ICC profiles of type 4 hold it.
_SRGB_PARAMETERS = (2.4, 1 / 1.055, 0.055 / 1.055, 1 / 12.92, 0.04045)
# Profiles hold 16-bit or s15Fixed16 numbers, tables of 256 entries are common; the curves lie 2e-2 apart.
_CURVE_TOLERANCE = 2e-3


def parse_encoding(where: object, value: Any) -> Encoding | None:
    """An encoding as the user says it.

    Args:
        where: the argument or key, for the message.
        value: "linear", "srgb", a gamma (also as text) such as 2.2, or None for what the file says.

    Returns:
        The encoding, None if the file shall decide.

    Raises:
        InputError: if it is none of these.
    """
    if value is None:
        return None
    text = str(value).strip().lower()
    if text in ("linear", "srgb"):
        return "linear" if text == "linear" else "srgb"
    try:
        gamma = float(text)
    except ValueError:
        gamma = 0.0
    if isinstance(value, bool) or not 0.1 <= gamma <= 10.0:
        raise InputError(where, f"encoding must be linear, srgb or a gamma from 0.1 to 10, got {value!r}", _HOW_TO_SAY)
    return "linear" if gamma == 1.0 else gamma


def decode(values: Float[np.ndarray, "..."], encoding: Encoding) -> Float[np.ndarray, "..."]:
    """Encoded values, 1 at the largest code, to linear ones; NaN and infinite values stay what they are.

    Source: IEC 61966-2-1 for sRGB, whose lower part goes on below 0; powers of negative values are NaN.
    """
    if encoding == "linear":
        return values
    if encoding == "srgb":
        upper = (np.maximum(values, 0.04045) + 0.055) / 1.055
        return np.where(values <= 0.04045, values / 12.92, upper**2.4)
    with np.errstate(invalid="ignore"):
        return values**encoding


def encode(values: Float[np.ndarray, "..."], encoding: Encoding) -> Float[np.ndarray, "..."]:
    """Linear values to encoded ones, the inverse of `decode`."""
    if encoding == "linear":
        return values
    if encoding == "srgb":
        upper = 1.055 * np.maximum(values, 0.0031308) ** (1 / 2.4) - 0.055
        return np.where(values <= 0.0031308, 12.92 * values, upper)
    with np.errstate(invalid="ignore"):
        return values ** (1 / encoding)


@functools.lru_cache(maxsize=16)
def decode_table(encoding: Encoding, bits: int) -> Float32[np.ndarray, " codes"]:
    """The linear value of every code of an integer file with ``bits`` bits (8 or 16)."""
    codes = np.arange(1 << bits, dtype=np.float32) / np.float32((1 << bits) - 1)
    table = decode(codes, encoding)
    table.setflags(write=False)
    return table


def find_encoding(path: Path, format_name: str, spec: oiio.ImageSpec, bits: int) -> tuple[Encoding, EncodingSource]:
    """What a file says of its encoding, or what its format or its kind makes likely.

    Args:
        path: the file.
        format_name: OpenImageIO's name of the format.
        spec: the header as OpenImageIO reads it.
        bits: bits per value as stored.

    Returns:
        The encoding and where it comes from.

    Raises:
        InputError: if the file states an encoding that is neither linear, sRGB nor a power.
    """
    stated = _stated(path, format_name, spec)
    if stated is not None:
        return stated, "file"
    if spec.format.basetype in (oiio.FLOAT, oiio.HALF, oiio.DOUBLE):
        return "linear", "format"
    if format_name in _DISPLAY_FORMATS:
        return "srgb", "format"
    return ("srgb" if bits <= 8 else "linear"), "assumed"


def _stated(path: Path, format_name: str, spec: oiio.ImageSpec) -> Encoding | None:
    attributes = {attribute.name: attribute.value for attribute in spec.extra_attribs}
    space = str(attributes.get("oiio:ColorSpace", ""))
    # OpenImageIO names sRGB for silent PNG files too, and overlooks what profiles say.
    chunks = _png_chunks(path) if format_name == "png" else set()
    if "CICP" in attributes:
        return _of_space(path, space, attributes)
    if "ICCProfile" in attributes:
        return _of_profile(path, np.asarray(attributes["ICCProfile"], np.uint8))
    if attributes.get("Exif:ColorSpace") == 1:
        return "srgb"
    if format_name == "png":
        return _of_space(path, space, attributes) if chunks & {b"sRGB", b"gAMA"} else None
    if format_name in (*_DISPLAY_FORMATS, "bmp", "pnm", "ico", "psd") or not space:
        return None
    return _of_space(path, space, attributes)


def _of_space(path: Path, space: str, attributes: dict[str, Any]) -> Encoding:
    """The curve of a colour space by OpenImageIO's name for it."""
    if "oiio:Gamma" in attributes:
        return parse_encoding(path, round(float(attributes["oiio:Gamma"]), 6)) or "linear"
    name = space.lower()
    if name.startswith(("lin", "raw", "data", "unknown")):
        return "linear"
    if name.startswith("srgb"):
        return "srgb"
    power = re.match(r"g(\d)(\d)_", name)
    if power:
        return float(f"{power[1]}.{power[2]}")
    raise InputError(path, f"is encoded as {space}, which is not known here", _HOW_TO_SAY)


def _png_chunks(path: Path) -> set[bytes]:
    """The kinds of the chunks before the pixels; a gAMA of 0, which means nothing (PNG, 11.3.2.2), is none."""
    kinds: set[bytes] = set()
    with path.open("rb") as file:
        file.seek(8)
        while len(head := file.read(8)) == 8 and head[4:] not in (b"IDAT", b"IEND") and len(kinds) < 100:
            (length,), kind = struct.unpack(">I", head[:4]), head[4:]
            content = file.tell()
            if kind != b"gAMA" or any(file.read(min(length, 4))):
                kinds.add(kind)
            file.seek(content + length + 4)
    return kinds


def _of_profile(path: Path, profile: UInt8[np.ndarray, " bytes"]) -> Encoding | None:
    """The curve that an ICC profile holds (ICC.1:2022, 10.6 and 10.18); None if it is damaged and so says nothing."""
    data = profile.tobytes()
    try:
        (count,) = struct.unpack_from(">I", data, 128)
        tags = [struct.unpack_from(">4sII", data, 132 + 12 * tag) for tag in range(min(count, 100))]
        curves: set[Encoding | None] = {
            _of_curve(data[start : start + size]) for kind, start, size in tags if kind[1:] == b"TRC"
        }
    except struct.error:
        return None
    if len(curves) != 1 or None in curves:
        raise InputError(path, "has an ICC profile whose curve is not known here", _HOW_TO_SAY)
    return curves.pop()


def _of_curve(curve: bytes) -> Encoding | None:
    if curve[:4] == b"para":
        (kind,) = struct.unpack_from(">H", curve, 8)
        numbers = [number / 65536 for number in struct.unpack_from(f">{(1, 3, 4, 5, 7)[min(kind, 4)]}i", curve, 12)]
        if np.allclose(numbers, _SRGB_PARAMETERS[: len(numbers)], rtol=0, atol=_CURVE_TOLERANCE) and kind == 3:
            return "srgb"
        # A power of one with a slope of one, however many further numbers a writer adds for the unused lower part.
        straight = kind == 0 or (numbers[1] == 1 and not any(numbers[5:]) and not numbers[2])
        return _power(numbers[0]) if straight and (kind in (0, 1) or numbers[0] == 1) else None
    (count,) = struct.unpack_from(">I", curve, 8)
    if curve[:4] != b"curv":
        return None
    if count < 2:
        return _power(struct.unpack_from(">H", curve, 12)[0] / 256) if count else "linear"
    values = np.asarray(struct.unpack_from(f">{count}H", curve, 12)) / 65535
    at = np.linspace(0, 1, count, dtype=np.float32)
    known: tuple[Encoding, ...] = ("linear", "srgb", 2.2, 1.8)
    return next((form for form in known if np.allclose(decode(at, form), values, atol=_CURVE_TOLERANCE)), None)


def _power(gamma: float) -> Encoding | None:
    return ("linear" if gamma == 1 else gamma) if 0.1 <= gamma <= 10 else None
