"""Pictures read through OpenImageIO.

Every reader returns float32 values proportional to light, rows from the top, channels last; see
`brdf.images.encoding` for how an encoding is found. What comes out is the picture that a person would see: the display
window of an OpenEXR file (NaN where it holds no data) and a photograph turned upright. Colour is as stored, not
multiplied by alpha. NaN and infinite values are passed on; who fits leaves them out.

Sizes are checked before memory is taken (`brdf.images.damage`); `ImageReader` reads pictures larger than memory.
"""

import contextlib
import dataclasses
import itertools
import re
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
from jaxtyping import Bool, Float32

from brdf.errors import InputError
from brdf.files import AnyPath, input_file, utf8_name
from brdf.images.damage import check_content, check_header, check_memory
from brdf.images.encoding import (
    FLOATS,
    Encoding,
    EncodingSource,
    decode,
    decode_table,
    find_encoding,
    largest_step,
    parse_encoding,
    rgbe_step,
)
from brdf.images.jpeg import Jpeg

BAND = 256
"""Rows of alpha that are read at a time."""

LOSSY_TOP = 250 / 255
"""Share of the largest code from which on a file compressed with losses is clipped: at quality 75 a clipped area has
codes between 250 and 255, but for a few at its edge."""

PICTURE_LAYERS = ("", "beauty", "c", "color", "colour", "combined", "composite", "image", "rgb", "rgba")
"""How renderers call the layer that is the picture, in small letters; Blender's is the last part of its name."""

# Remarks that libjpeg makes on sound pictures of some cameras.
_HARMLESS = ("extraneous bytes", "Invalid SOS parameters")


@dataclasses.dataclass(frozen=True, eq=False)
class Picture:
    """A picture with what its file tells about it.

    Attributes:
        pixels: linear values.
        alpha: coverage from 0 to 1, None if the file has none.
        encoding: how the file holds the values: "linear", "srgb" or a gamma.
        source: who says so: "given" (the user), "file", "format" (it knows no other), or "assumed".
        bits: bits per value in the file.
        saturation: the linear value of the largest code, where an integer file ends; a little less where the file is
            compressed with losses (`ImageReader.codes`); None for floats. Infinite where the clipped pixels were taken
            out, see `scaled`.
        factor: what the linear values of the file were multiplied by, a number or (C,).
        path: the file; None where it came from none.
        lossy: the file was compressed with losses, so that neighbours share errors.
        jpeg: how a JPEG in colour was; None for other files.
        layer: the one that was taken of several where none is named as renderers name the picture (`read_layers` has
            them all); else None.

    Example:
        >>> picture = brdf.read_picture("target.exr")
        >>> picture.pixels.shape, picture.alpha, picture.encoding
        ((32, 32, 3), None, 'linear')
    """

    pixels: Float32[np.ndarray, "height width channels"]
    alpha: Float32[np.ndarray, "height width"] | None
    encoding: Encoding
    source: EncodingSource
    bits: int
    saturation: float | None
    factor: float | np.ndarray = 1.0
    path: Path | None = None
    lossy: bool = False
    jpeg: Jpeg | None = None
    layer: str | None = None

    def __repr__(self) -> str:
        """In a line: size, encoding, bits and file."""
        return _in_a_line(self, self.pixels.shape)

    def scaled(self, factor: float | np.ndarray) -> "Picture":
        """The picture in another unit: of another exposure, or under light of another intensity.

        Args:
            factor: what to multiply the values by, above 0, a number or (C,). Where channels differ in it, they clip at
                different levels: clipped pixels become NaN.
        """
        factors = np.asarray(factor, np.float32)
        pixels, saturation = self.pixels * factors, self.saturation
        if saturation is not None and factors.size == 1:
            saturation *= factors.item()
        elif saturation is not None:
            clipped = np.any(self.pixels >= saturation * (1 - 1e-6), axis=-1, keepdims=True)
            pixels, saturation = np.where(clipped, np.float32(np.nan), pixels), np.inf
        return dataclasses.replace(self, pixels=pixels, saturation=saturation, factor=self.factor * factors)

    @property
    def opaque(self) -> Bool[np.ndarray, "height width"] | None:
        """Pixels that are not fully transparent; None where nobody says."""
        return None if self.alpha is None else _usable(self.alpha > 0)

    @property
    def code_step(self) -> float | None:
        """The distance of two codes before decoding, full scale 1; None for floats."""
        return None if self.saturation is None else 1.0 / ((1 << self.bits) - 1)


def _in_a_line(one: "Picture | ImageReader", shape: tuple[int, ...]) -> str:
    size, name = " x ".join(map(str, shape)), "" if one.path is None else f", {one.path}"
    return f"{type(one).__name__}({size}, {one.encoding}, {one.bits} bits{name})"


class ImageReader(contextlib.AbstractContextManager):
    """A picture in a file, read by bands of rows, so that it may be larger than memory.

    Attributes:
        path: the file.
        shape: height, width and channels of the picture.
        encoding: how values are encoded in the file; rows come out linear.
        source: who says so.
        bits: bits per value in the file.
        is_integer: whether the file holds codes, which end somewhere, not floats.
        layer: see `Picture`.

    Example:
        >>> with brdf.ImageReader("target.exr") as reader:
        ...     upper = reader.rows(0, reader.shape[0] // 2)
        >>> upper.shape
        (16, 32, 3)
    """

    def __init__(self, path: AnyPath, *, encoding: Encoding | None = None):
        """Open a file and read its header.

        Args:
            path: the file, in any format that OpenImageIO reads.
            encoding: "linear", "srgb" or a gamma; None for what the file says.

        Raises:
            InputError: if there is no readable picture, or the encoding is unknown.
        """
        given = parse_encoding("encoding", encoding)
        self.path = input_file(path)
        self._image = _open(self.path)
        self._part, self._colour, self._alpha, self.layer = _choose_channels(self._image)
        self._spec = spec = self._image.spec(self._part)
        check_header(self.path, spec)
        kind, name = spec.channelformat(self._colour[0]), self._image.format_name()
        self.is_integer = str(kind) not in FLOATS
        stored = spec.get_int_attribute("oiio:BitsPerSample")
        self.bits = stored if self.is_integer and 0 < stored <= 32 else 8 * kind.basesize()
        self.encoding: Encoding
        self.source: EncodingSource
        self.encoding, self.source = find_encoding(given, self.path, name, spec, self.bits)
        packed = spec.get_string_attribute("compression")
        self.lossy = name in ("jpeg", "webp", "heif") or packed.startswith(("jpeg", "dwa", "b44"))
        if name == "webp":
            self.lossy = not _is_lossless_webp(self.path)
        self.jpeg = Jpeg.of(self.path) if name == "jpeg" else None
        turn = spec.get_int_attribute("Orientation", 1)
        self._turn = turn if turn in range(2, 9) else 1
        # A turned photograph cannot be had by rows, and OpenImageIO 3.2 reads 64-bit TIFFs wrongly by rows.
        self._by_rows = self._turn == 1 and not _is_double_tiff(self._image)
        self._upright = None
        height, width = spec.full_height, spec.full_width
        self.shape = (*((width, height) if self._turn > 4 else (height, width)), len(self._colour))
        below, right = spec.y - spec.full_y, spec.x - spec.full_x
        if not (-spec.height < below < height and -spec.width < right < width):
            raise InputError(self.path, "has no data inside its display window", "Make the file again")

    @property
    def codes(self) -> tuple[float | None, float]:
        """The linear value from which on codes are clipped, and the largest distance of two; None and 0 for floats.

        That is the largest code; after compression with losses a few codes less, among which a clipped area wobbles.
        """
        if not self.is_integer:
            return None, 0.0
        top = decode(np.array(LOSSY_TOP if self.lossy else 1.0), self.encoding)
        return float(top), largest_step(self.encoding, self.bits)

    def __repr__(self) -> str:
        """In a line: size, encoding, bits and file."""
        return _in_a_line(self, self.shape)

    def __exit__(self, *raised: object) -> None:
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
        if not 0 <= start <= stop <= self.shape[0]:
            raise IndexError(f"rows {start} to {stop} of a picture with {self.shape[0]} rows")
        if self._by_rows:
            return _shown(self.path, self._image, self._part, self._colour, start, stop, self.encoding)
        if self._upright is None:  # kept whole, it is read once
            self._upright = self._whole(self._colour, self.encoding)
        return self._upright[start:stop]

    def read(self) -> Float32[np.ndarray, "height width channels"]:
        """The whole picture, linear.

        Raises:
            InputError: if it is too large for memory, or damaged.
        """
        check_memory(self.path, int(np.prod(self.shape)))
        return self.rows(0, self.shape[0])

    def picture(self, pixels: Float32[np.ndarray, "H W C"]) -> Picture:
        """Pixels of the file, with what it tells about them.

        Args:
            pixels: as `rows` gives them.
        """
        about = {name: getattr(self, name) for name in ("encoding", "source", "bits", "path", "lossy", "jpeg", "layer")}
        return Picture(pixels, None, saturation=self.codes[0], **about)

    def read_alpha(self) -> Float32[np.ndarray, "height width"] | None:
        """The whole alpha channel, None if there is none."""
        if self._alpha is None:
            return None
        check_memory(self.path, self.shape[0] * self.shape[1])
        return self._whole([self._alpha], "linear")[..., 0]

    def read_opaque(self) -> Bool[np.ndarray, "height width"] | None:
        """Pixels that are not fully transparent; None where nobody says. Read by bands of rows."""
        if self._alpha is None:
            return None
        if not self._by_rows:
            return _usable(self._whole([self._alpha], "linear")[..., 0] > 0)
        edges = [*range(0, self.shape[0], BAND), self.shape[0]]
        bands = (
            _shown(self.path, self._image, self._part, [self._alpha], first, stop, "linear")[..., 0] > 0
            for first, stop in itertools.pairwise(edges)
        )
        return _usable(np.concatenate(list(bands)))

    def _whole(self, channels, encoding):
        """All rows, turned as the Exif orientation says (CIPA DC-008, 4.6.4.A)."""
        turn, height = self._turn, self._spec.full_height
        stored = _shown(self.path, self._image, self._part, channels, 0, height, encoding)
        if turn > 4:
            stored = stored.swapaxes(0, 1)
        if turn in (2, 3, 6, 7):
            stored = stored[:, ::-1]
        return np.ascontiguousarray(stored[::-1] if turn in (3, 4, 7, 8) else stored)


def _usable(opaque: np.ndarray) -> np.ndarray | None:
    # Alpha that is 0 everywhere was not meant, and what is opaque everywhere leaves nothing out.
    return opaque if opaque.any() and not opaque.all() else None


def _open(path: Path) -> oiio.ImageInput:
    check_content(path)
    request = oiio.ImageSpec()
    # Colour as stored: what a half-transparent pixel shows is not darkened.
    request.attribute("oiio:UnassociatedAlpha", 1)
    image = oiio.ImageInput.open(utf8_name(path), request)
    if image is None or image.format_name() in ("null", "term"):
        what = f"cannot be read as an image ({said(oiio, path) or 'no reason given'})"
        raise InputError(path, what, "Give an EXR, HDR, PNG, TIFF or JPEG file")
    said(image, path)  # remarks on metadata; the pixels may be sound
    spec = image.spec()
    check_header(path, spec)
    if _is_double_tiff(image) and (spec.tile_width or spec.height == 1):
        raise InputError(path, "holds 64-bit floats, which OpenImageIO reads wrongly", "Save it as 32-bit floats")
    return image


def _is_double_tiff(image: oiio.ImageInput) -> bool:
    """Whether OpenImageIO 3.2 reads it right only as a whole: rows and tiles of such files come as garbage."""
    spec = image.spec()
    separate = spec.get_string_attribute("planarconfig") == "separate"
    return image.format_name() == "tiff" and str(spec.format) == "double" and not separate


def said(source: Any, path: AnyPath) -> str:
    """What OpenImageIO says went wrong, the first line of it, and forgets then.

    The source is an image input or output, or the module itself for a file that did not open. The path is left out,
    the message having it already.
    """
    try:
        message = source.geterror()
    except UnicodeDecodeError as error:
        # Bytes of a damaged header, quoted by the reader.
        message = error.object.decode("utf-8", "replace")
    name = re.escape(str(path))
    message = re.sub(f'( for)? [("]+{name}[)"]+|"{name}":? ', "", message).replace(str(path), "it")
    line = next(filter(None, map(str.strip, message.splitlines())), "")
    return (line if len(line) <= 200 else line[:197] + "...").rstrip(". ")


def _layers(image: oiio.ImageInput) -> dict[tuple[int, str], dict[str, int]]:
    """The channels of each part and layer, by what comes after the last dot of their names."""
    layers = {}
    for part in range(max(1, image.spec().get_int_attribute("oiio:subimages"))):
        for channel, name in enumerate(image.spec(part).channelnames):
            layer, _, ending = name.rpartition(".")
            layers.setdefault((part, layer), {})[ending.upper()] = channel
    return layers


def _choose_channels(image: oiio.ImageInput) -> tuple[int, list[int], int | None, str | None]:
    """The part and channels that are the picture, and its alpha; depth and further layers are left apart.

    At the end the layer, where that is a guess, else None.

    Only OpenEXR files name their channels reliably: R, G, B, else Y of the unnamed layer are the picture, in the first
    part that has them, else those of the first layer that has them (not the Y of X, Y, Z), else (a spectral
    file) all channels in the order of the file. Parts and layers that are named as pictures are (`PICTURE_LAYERS`) go
    before others that have them. In other formats the picture is what comes before alpha.
    """
    names = image.spec().channelnames
    every = list(range(len(names)))
    if image.format_name() != "openexr":
        # By its name: some readers number an alpha channel beyond the last one.
        alpha = names.index("A") if "A" in names[1:] else None
        return 0, every[:alpha], alpha, None
    layers = _layers(image)
    for named, wanted in itertools.product((False, True), ("RGB", "Y")):
        found = {}
        for (part, layer), at in layers.items():
            axis = named and wanted == "Y" and "X" in at  # of a position or a normal
            if bool(layer) == named and set(wanted) <= set(at) and not axis:
                found[part, layer] = layer or image.spec(part).get_string_attribute("oiio:subimagename")
        usual = [key for key, name in found.items() if name.rpartition(".")[2].lower() in PICTURE_LAYERS]
        if found:
            key = (usual or list(found))[0]
            at, guess = layers[key], None if usual or len(found) == 1 else found[key]
            return key[0], [at[letter] for letter in wanted], at.get("A"), guess
    apart = layers.get((0, ""), {})
    rest = [channel for channel in every if channel not in (apart.get("A"), apart.get("Z"))]
    return 0, rest or every, apart.get("A") if rest else None, None


def _shown(path, image, part, channels: list[int], start: int, stop: int, encoding: Encoding = "linear") -> np.ndarray:
    """Rows of the display window of a part, linear, (rows, width, channels); NaN where there are no data."""
    spec = image.spec(part)
    shown = np.full((stop - start, spec.full_width, len(channels)), np.nan, np.float32)
    top, left = spec.y - spec.full_y, spec.x - spec.full_x
    first, last = max(start - top, 0), min(stop - top, spec.height)
    if first >= last:
        return shown
    low, high = min(channels), max(channels) + 1
    coded = encoding != "linear" and str(spec.channelformat(low)) not in FLOATS
    kind = "uint16" if coded else "float"
    # OpenImageIO takes whole tiles only.
    tile = spec.tile_height if spec.tile_width else 1
    skip, end = first % tile, min(-(-last // tile) * tile, spec.height)
    rows = spec.y + first - skip, spec.y + end
    if spec.tile_width:
        columns = spec.x, spec.x + spec.width
        pixels = image.read_tiles(part, 0, *columns, *rows, spec.z, spec.z + 1, low, high, kind)
    else:
        pixels = image.read_scanlines(part, 0, *rows, spec.z, low, high, kind)
    complaint = said(image, path)
    if pixels is None or (complaint and not any(remark in complaint for remark in _HARMLESS)):
        what = f"is damaged: rows {first} to {last} of {spec.height} cannot be read ({complaint or 'no data'})"
        raise InputError(path, what, "Make the file again")
    pixels = pixels.reshape(-1, spec.width, high - low)[
        skip : skip + last - first, max(-left, 0) : max(spec.full_width - left, 0)
    ]
    if channels != list(range(low, high)):
        pixels = pixels[..., [channel - low for channel in channels]]
    if image.format_name() == "hdr":
        # Radiance truncates: a mantissa stands for what lies between it and the next (G. Ward, Graphics Gems II, 1991).
        pixels = pixels + 0.5 * rgbe_step(pixels)
    table = decode_table(encoding, 16).astype(np.float32) if coded else None
    for row, stored in enumerate(pixels, start=first + top - start):  # NumPy makes eight bytes of every code
        shown[row, max(left, 0) :][: len(stored)] = decode(stored, encoding) if table is None else table[stored]
    return shown


def read_image(path: AnyPath, *, encoding: Encoding | None = None) -> Float32[np.ndarray, "height width channels"]:
    """Read a picture as linear values.

    Args:
        path: an EXR, HDR, PNG, TIFF, JPEG, TGA file or whatever else OpenImageIO reads.
        encoding: "linear", "srgb" or a gamma such as 2.2; None for what the file says (`brdf.images.encoding`).

    Returns:
        Colour without alpha and further layers: RGB, grey, or all bands of a spectral file in the order of the file.
        Integer files span 0 to 1.

    Raises:
        InputError: if the file cannot be read.

    Example:
        >>> target = brdf.read_image("target.exr")
        >>> target.shape, target.dtype
        ((32, 32, 3), dtype('float32'))
    """
    with ImageReader(path, encoding=encoding) as reader:
        return reader.read()


def read_picture(path: AnyPath, *, encoding: Encoding | None = None) -> Picture:
    """Read a picture with alpha, saturation level and distance of its codes.

    Args:
        path: the file, as for `read_image`.
        encoding: as for `read_image`.

    Raises:
        InputError: if the file cannot be read.

    Example:
        >>> picture = brdf.read_picture("target.png")
        >>> picture.encoding, picture.bits, picture.saturation
        ('srgb', 8, 1.0)
    """
    with ImageReader(path, encoding=encoding) as reader:
        return dataclasses.replace(reader.picture(reader.read()), alpha=reader.read_alpha())


def read_mask(path: AnyPath) -> Bool[np.ndarray, "height width"]:
    """Read which pixels are inside a mask.

    Args:
        path: a picture, white inside and black outside, or one whose alpha channel is the mask.

    Returns:
        True where alpha, or if that leaves out nothing or everything the mean of the channels, is over half of its
        largest value in the file.

    Raises:
        InputError: if the file cannot be read.

    Example:
        >>> mask = brdf.read_mask("mask.png")
        >>> mask.shape, mask.dtype
        ((32, 32), dtype('bool'))
    """
    with ImageReader(path, encoding="linear") as reader:
        alpha = reader.read_alpha()
        inside = _over_half(np.zeros(1) if alpha is None else alpha)
        if inside.all() or not inside.any():
            with np.errstate(over="ignore", invalid="ignore"):  # NaN and infinite values are passed on
                inside = _over_half(reader.read().mean(axis=-1))
    return inside


def _over_half(values: np.ndarray) -> np.ndarray:
    values = np.nan_to_num(values, copy=False, nan=0.0)
    return values > 0.5 * values.max()


def read_layers(path: AnyPath) -> dict[str, Float32[np.ndarray, "height width channels"]]:
    """Read all channels of a file, grouped by layer.

    Args:
        path: usually an OpenEXR file with channels such as ``position.X`` and ``R``.

    Returns:
        Layer name to values as stored, not decoded. The name is what comes before the last dot of the channels' names;
        where they have none, it is the name of the file's part if it has several, else "". A layer of a later part
        whose name is taken has its part's before it. Channels are in the order R G B A, X Y Z, U V, else in the order
        of the file.

    Raises:
        InputError: if the file cannot be read.

    Example:
        >>> {name: values.shape for name, values in brdf.read_layers("target.exr").items()}
        {'': (32, 32, 3)}
    """
    file, layers = input_file(path), {}
    image = _open(file)
    found = _layers(image)
    specs = {part: image.spec(part) for part, _ in found}
    for spec in specs.values():
        check_header(file, spec)
    check_memory(file, sum(spec.full_width * spec.full_height * spec.nchannels for spec in specs.values()))
    for part, spec in specs.items():
        own = spec.get_string_attribute("oiio:subimagename", str(part)) if len(specs) > 1 else ""
        pixels = _shown(file, image, part, list(range(spec.nchannels)), 0, spec.full_height)
        for (of_part, layer), at in found.items():
            if of_part == part:
                usual = sorted(at, key=lambda ending: "RGBAXYZUV".find(ending) % 10)  # others last
                name = layer or own
                name = f"{own}.{name}" if name in layers else name
                layers[name] = pixels[..., [at[ending] for ending in usual]]
    image.close()
    return layers


def _is_lossless_webp(path: Path) -> bool:
    """Whether the first picture of a WebP file is in a chunk of that kind.

    Source: RFC 9649, section 2.
    """
    with path.open("rb") as file:
        file.seek(12)
        while len(head := file.read(8)) == 8:
            if head[:4] in (b"VP8L", b"VP8 "):
                return head[:4] == b"VP8L"
            size = int.from_bytes(head[4:], "little")
            file.seek(size + size % 2, 1)
    return False
