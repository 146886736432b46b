"""How pixel values stand for light: linear, sRGB or a power, and what a file says about it.

Only the curve is undone: channels keep the primaries that the file was made with, because a fit treats channels
independently. In order of authority, an encoding is

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
from jaxtyping import Float

from brdf.errors import InputError

Encoding = Literal["linear", "srgb"] | float
EncodingSource = Literal["given", "file", "format", "assumed"]

FLOATS = ("float", "half", "double")
_DISPLAY_FORMATS = ("jpeg", "gif", "webp")
_SPACES: dict[str, Encoding] = {**dict.fromkeys(("lin", "raw", "data", "unknown"), "linear"), "srgb": "srgb"}
_HOW_TO_SAY = 'Say how it is encoded: "linear", "srgb" or a gamma like 2.2'
# Profiles hold 16-bit or s15Fixed16 numbers, tables of 256 entries are common; the curves lie 2e-2 apart.
_CURVE_TOLERANCE = 2e-3
# Chunks with their lengths; a gAMA of 0 means nothing (PNG, 11.3.2.2).
_PNG_SAYS = re.compile(rb"\0\0\0\x01sRGB|\0\0\0\x04gAMA(?!\0{4})")
# By the code for transfer characteristics (ITU-T H.273, table 3); the curve of a BT.709 display is that of BT.1886.
_CICP_TRANSFERS: dict[int, Encoding] = {8: "linear", 13: "srgb", **dict.fromkeys((1, 6, 14, 15), 2.4)}
_CICP_TRANSFERS |= {4: 2.2, 5: 2.8, 17: 2.6}
_CICP_UNSPECIFIED = 2


def parse_encoding(where: object, value: Any) -> Encoding | None:
    """An encoding as the user says it: "linear", "srgb" or a gamma such as 2.2, also as text; None stays None."""
    if value is None:
        return None
    text = str(value).strip().lower()
    if text == "linear" or text == "srgb":
        return text
    try:
        gamma = float(text)
    except ValueError:
        gamma = 0.0
    if not 0.1 <= gamma <= 10.0:
        raise InputError(where, f"must be linear, srgb or a gamma from 0.1 to 10, got {value!r}", _HOW_TO_SAY)
    return "linear" if gamma == 1.0 else gamma


def decode(values: np.ndarray, encoding: Encoding) -> np.ndarray:
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


def encode(values: np.ndarray, encoding: Encoding) -> np.ndarray:
    """Linear values to encoded ones, the inverse of `decode`."""
    if encoding == "linear":
        return values
    if encoding == "srgb":
        upper = 1.055 * np.maximum(values, 0.0031308) ** (1 / 2.4) - 0.055
        return np.where(values <= 0.0031308, 12.92 * values, upper)
    with np.errstate(invalid="ignore"):
        return values ** (1 / encoding)


@functools.lru_cache(maxsize=16)
def decode_table(encoding: Encoding, bits: int) -> Float[np.ndarray, " codes"]:
    """The linear value of every code of an integer file with ``bits`` bits, at most 16."""
    table = decode(np.linspace(0, 1, 1 << bits), encoding)
    table.flags.writeable = False
    return table


def largest_step(encoding: Encoding, bits: int) -> float:
    """The largest distance of two neighbouring codes of an integer file, in linear values."""
    return float(np.max(np.diff(decode_table(encoding, min(bits, 16)))))


def rgbe_step(pixels: Float[np.ndarray, "*shape C"]) -> Float[np.ndarray, "*shape 1"]:
    """The distance of two mantissas of RGBE, of which the brightest channel takes 128 to 255; 0 where all are 0."""
    largest = np.max(pixels, axis=-1, keepdims=True)
    return np.where(largest > 0, np.ldexp(np.ones_like(largest), np.frexp(largest)[1] - 8), 0)


def find_encoding(
    given: Encoding | None, path: Path, format_name: str, spec: Any, bits: int
) -> tuple[Encoding, EncodingSource]:
    """The given encoding, that which a file says, or that which its format or its kind makes likely; and who says so.

    The header is an `OpenImageIO.ImageSpec`, which who only computes with encodings need not import. Refused is an
    encoding that is neither linear, sRGB nor a power.
    """
    if given is not None:
        return given, "given"
    stated = _stated(path, format_name, spec)
    if stated is not None:
        return stated, "file"
    if str(spec.format) in FLOATS:
        return "linear", "format"
    if format_name in _DISPLAY_FORMATS:
        return "srgb", "format"
    return ("srgb" if bits <= 8 else "linear"), "assumed"


def _stated(path: Path, format_name: str, spec: Any) -> Encoding | None:
    attributes = {attribute.name: attribute.value for attribute in spec.extra_attribs}
    _, transfer, *_ = attributes.get("CICP", (0, _CICP_UNSPECIFIED))
    if transfer != _CICP_UNSPECIFIED:
        if transfer not in _CICP_TRANSFERS:
            raise InputError(path, f"is encoded by transfer {transfer} of cICP, which is not known here", _HOW_TO_SAY)
        return _CICP_TRANSFERS[transfer]
    if "ICCProfile" in attributes:
        return _of_profile(path, np.asarray(attributes["ICCProfile"], np.uint8).tobytes())
    if attributes.get("Exif:ColorSpace") == 1:
        return "srgb"
    space = str(attributes.get("oiio:ColorSpace", "")).lower()
    # OpenImageIO names sRGB for silent files of these formats too.
    if format_name == "png":
        with path.open("rb") as file:
            space = space if _PNG_SAYS.search(file.read(1 << 20).partition(b"IDAT")[0]) else ""
    if not space or format_name in (*_DISPLAY_FORMATS, "bmp", "pnm", "ico", "psd"):
        return None
    named = re.match(r"g(\d\d)_", space)
    gamma = (named and int(named[1]) / 10) or attributes.get("oiio:Gamma")
    if gamma:
        return parse_encoding(f"{path}: encoding", round(gamma, 6))
    for start, encoding in _SPACES.items():
        if space.startswith(start):
            return encoding
    raise InputError(path, f"is encoded as {attributes['oiio:ColorSpace']}, which is not known here", _HOW_TO_SAY)


def _of_profile(path: Path, profile: bytes) -> Encoding | None:
    """The curve that an ICC profile holds (ICC.1:2022, 7.3); None if it is damaged and so says nothing."""
    try:
        (count,) = struct.unpack_from(">I", profile, 128)
        tags = [struct.unpack_from(">4sII", profile, 132 + 12 * tag) for tag in range(min(count, 100))]
        curves: set[Encoding | None]
        curves = {_of_curve(profile[start : start + size]) for kind, start, size in tags if kind[1:] == b"TRC"}
    except (struct.error, ValueError):
        return None
    if len(curves) != 1 or None in curves:
        raise InputError(path, "has an ICC profile whose curve is not known here", _HOW_TO_SAY)
    return curves.pop()


def _of_curve(curve: bytes) -> Encoding | None:
    """The encoding whose curve this is (ICC.1:2022, 10.6 and 10.18), None where it is none of those known."""
    at, gamma = np.linspace(0, 1, 256), 1.0
    (number,) = struct.unpack_from(">I", curve, 8)
    if curve[:4] == b"para" and number >> 16 in (0, 3):
        numbers = np.frombuffer(curve, ">i4", 5 if number >> 16 else 1, 12) / 65536
        gamma, a, b, c, d = [*numbers, 1, 0, 0, 0][:5]
        values = np.where(at >= d, np.maximum(a * at + b, 0) ** gamma, c * at)
    elif curve[:4] == b"curv":
        table = np.frombuffer(curve, ">u2", number, 12)
        gamma = table[0] / 256 if number == 1 else 1.0
        values = np.interp(at, np.linspace(0, 1, number), table / 65535) if number > 1 else at**gamma
    else:
        return None
    for known in (float(gamma), "srgb", 2.2, 1.8):
        if np.allclose(decode(at, known), values, rtol=0, atol=_CURVE_TOLERANCE):
            return parse_encoding("ICC profile: encoding", known)
    return None
