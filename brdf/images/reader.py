"""A picture in a file, read by bands of rows."""

import os
from collections.abc import Iterator
from types import TracebackType
from typing import Any, Self

import numpy as np
import OpenImageIO as oiio  # noqa: N813
from jaxtyping import Float32

from brdf.errors import InputError
from brdf.files import input_file
from brdf.images.encoding import Encoding, EncodingSource, decode, decode_table, find_encoding, parse_encoding
from brdf.images.file import BAND_VALUES, band_rows, check_header, check_memory, choose_channels, open_image, read_rows

LOSSY_TOP = 250 / 255
"""Share of the largest code from which on a file compressed with losses is clipped: at quality 75 a clipped area has
codes between 250 and 255, but for a few at its edge."""

_INTEGER_BITS = {oiio.UINT8: 8, oiio.UINT16: 16}
_NATIVE_BITS = {oiio.UINT8: 8, oiio.INT8: 8, oiio.UINT16: 16, oiio.INT16: 16, oiio.HALF: 16, oiio.DOUBLE: 64}


class ImageReader:
    """A picture in a file, read in bands of rows, so that it may be larger than memory.

    Attributes:
        path: the file.
        shape: height, width and channels of the picture.
        encoding: how values are encoded in the file; rows come out linear.
        source: who says so.
        bits: bits per value in the file.
        is_integer: whether the file holds codes, which end somewhere, not floats.
        has_alpha: whether the file has an alpha channel beside the picture.
    """

    def __init__(self, path: str | os.PathLike[str], *, encoding: Encoding | None = None):
        """Open a file and read its header.

        Args:
            path: the file, in any format that OpenImageIO reads.
            encoding: "linear", "srgb" or a gamma; None for what the file says.

        Raises:
            InputError: if there is no readable picture, or the encoding is unknown.
        """
        given = parse_encoding("encoding", encoding)
        self.path = input_file(path)
        self._image = open_image(self.path)
        self._channels = choose_channels(self._image)
        self._spec = spec = self._image.spec(self._channels.part)
        check_header(self.path, spec, self._image.format_name())
        kinds = spec.channelformats
        kind = (kinds[self._channels.colour[0]] if kinds else spec.format).basetype
        self.is_integer = kind not in (oiio.FLOAT, oiio.HALF, oiio.DOUBLE)
        stored = spec.get_int_attribute("oiio:BitsPerSample")
        self.bits = stored if self.is_integer and 0 < stored <= 32 else _NATIVE_BITS.get(kind, 32)
        self.encoding: Encoding
        self.source: EncodingSource
        if given is None:
            self.encoding, self.source = find_encoding(self.path, self._image.format_name(), spec, self.bits)
        else:
            self.encoding, self.source = given, "given"
        self.has_alpha = self._channels.alpha is not None
        compression = spec.get_string_attribute("compression", "")
        self._is_lossy = self._image.format_name() in ("jpeg", "webp", "heif") or compression.startswith("jpeg")
        self._table_bits = _INTEGER_BITS.get(kind, 0) if self.encoding != "linear" else 0
        self._turn = spec.get_int_attribute("Orientation", 1)
        self._upright: dict[bool, np.ndarray] = {}
        height, width = spec.full_height, spec.full_width
        self.shape = (*((width, height) if self._turn in (5, 6, 7, 8) else (height, width)), len(self._channels.colour))
        if spec.y >= spec.full_y + height or spec.y + spec.height <= spec.full_y:
            raise InputError(self.path, "has no data inside its display window", "Make the file again")

    @property
    def codes(self) -> tuple[float | None, float]:
        """The linear value from which on codes are clipped, and the largest distance of two; None and 0 for floats.

        That is the largest code; after compression with losses a few codes less, among which a clipped area wobbles.
        """
        if not self.is_integer:
            return None, 0.0
        table = decode_table(self.encoding, 8 if self.encoding == "linear" else min(self.bits, 16))
        top = float(decode(np.array([LOSSY_TOP], np.float32), self.encoding)[0]) if self._is_lossy else float(table[-1])
        return top, 1.0 / ((1 << self.bits) - 1) if self.encoding == "linear" else float(np.max(np.diff(table)))

    def __enter__(self) -> Self:
        """The reader itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close the file."""
        self.close()

    def close(self) -> None:
        """Close the file; the reader cannot be used any more."""
        self._image.close()

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        """The whole picture, for what takes arrays."""
        return np.asarray(self.read(), dtype)

    def rows(self, start: int, stop: int) -> Float32[np.ndarray, "rows width channels"]:
        """Rows ``start`` to ``stop`` (not included) of the picture, linear.

        Bands in order from the top are read once; going back makes some formats start over.

        Raises:
            InputError: if the data are damaged or missing.
            IndexError: if there are no such rows.
        """
        return self._rows(start, stop, self._channels.colour, decoded=True)

    def alpha_rows(self, start: int, stop: int) -> Float32[np.ndarray, "rows width"]:
        """The same rows of the alpha channel, from 0 to 1; ones where the file has none."""
        if self._channels.alpha is None:
            return np.ones((stop - start, self.shape[1]), np.float32)
        return self._rows(start, stop, [self._channels.alpha], decoded=False)[..., 0]

    def bands(self, values: int = BAND_VALUES) -> Iterator[tuple[int, Float32[np.ndarray, "rows width channels"]]]:
        """The whole picture in bands of about ``values`` values: first row and pixels of each."""
        step = band_rows(self._spec, values)
        for start in range(0, self.shape[0], step):
            yield start, self.rows(start, min(start + step, self.shape[0]))

    def read(self) -> Float32[np.ndarray, "height width channels"]:
        """The whole picture, linear.

        Raises:
            InputError: if it is too large for memory, or damaged.
        """
        return self._whole(self.shape[2], self.rows)

    def read_alpha(self) -> Float32[np.ndarray, "height width"] | None:
        """The whole alpha channel, None if there is none."""
        if self._channels.alpha is None:
            return None
        return self._whole(1, lambda start, stop: self.alpha_rows(start, stop)[..., None])[..., 0]

    def _whole(self, channels: int, rows: Any) -> np.ndarray:
        height, width, _ = self.shape
        check_memory(self.path, height * width * channels)
        step = band_rows(self._spec, BAND_VALUES)
        if step >= height or self._turn in range(2, 9):
            return rows(0, height)
        pixels = np.empty((height, width, channels), np.float32)
        for start in range(0, height, step):
            stop = min(start + step, height)
            pixels[start:stop] = rows(start, stop)
        return pixels

    def _rows(self, start: int, stop: int, channels: list[int], *, decoded: bool) -> np.ndarray:
        if not 0 <= start <= stop <= self.shape[0]:
            raise IndexError(f"rows {start} to {stop} of a picture with {self.shape[0]} rows")
        if self._turn not in range(2, 9):
            return self._stored(start, stop, channels, decoded=decoded)
        if decoded not in self._upright:
            # A turned photograph cannot be had by rows; kept, it is read once.
            check_memory(self.path, self.shape[0] * self.shape[1] * len(channels))
            stored = self._stored(0, self._spec.full_height, channels, decoded=decoded)
            self._upright[decoded] = np.ascontiguousarray(_upright(stored, self._turn))
        return self._upright[decoded][start:stop].copy()

    def _stored(self, start: int, stop: int, channels: list[int], *, decoded: bool) -> np.ndarray:
        """Rows of the display window, not turned."""
        spec = self._spec
        top, left = spec.full_y - spec.y, spec.full_x - spec.x
        first, last = max(start + top, 0), min(stop + top, spec.height)
        if first >= last:
            return np.full((stop - start, spec.full_width, len(channels)), np.nan, np.float32)
        pixels = self._data(first, last, channels, decoded=decoded)
        if pixels.shape[:2] == (stop - start, spec.full_width) and left == 0:
            return pixels
        framed = np.full((stop - start, spec.full_width, len(channels)), np.nan, np.float32)
        from_x, to_x = max(left, 0), min(left + spec.full_width, spec.width)
        if from_x < to_x:
            framed[first - top - start : last - top - start, from_x - left : to_x - left] = pixels[:, from_x:to_x]
        return framed

    def _data(self, first: int, last: int, channels: list[int], *, decoded: bool) -> np.ndarray:
        """Rows of the data window."""
        low, high = min(channels), max(channels) + 1
        table = decoded and self._table_bits
        kind = f"uint{self._table_bits}" if table else "float"
        pixels = read_rows(self.path, self._image, self._channels.part, (first, last), (low, high), kind)
        if high - low != len(channels) or channels != sorted(channels):
            pixels = pixels[..., [channel - low for channel in channels]]
        if table:
            return _looked_up(decode_table(self.encoding, self._table_bits), pixels)
        pixels = np.ascontiguousarray(pixels)
        return decode(pixels, self.encoding) if decoded else pixels


def _looked_up(table: np.ndarray, codes: np.ndarray) -> np.ndarray:
    """The table's value for each code, a few rows at a time: NumPy makes eight bytes of every code."""
    values = np.empty(codes.shape, table.dtype)
    step = max(1, (1 << 18) // codes[0].size)
    for first in range(0, len(codes), step):
        values[first : first + step] = table[codes[first : first + step]]
    return values


def _upright(stored: np.ndarray, turn: int) -> np.ndarray:
    """Turn a picture as the Exif orientation says (CIPA DC-008, 4.6.4.A)."""
    if turn >= 5:
        stored = stored.swapaxes(0, 1)
    if turn in (2, 3, 6, 7):
        stored = stored[:, ::-1]
    return stored[::-1] if turn in (3, 4, 7, 8) else stored
