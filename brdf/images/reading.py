"""Pixels in and out, through OpenImageIO.

Every reader returns float32 values proportional to light, rows from the top, channels last; see
:mod:`brdf.images.encoding` for how an encoding is found. What comes out is the picture that a person would see: the
display window of an OpenEXR file (NaN where it holds no data) and a photograph turned upright. Colour is as stored, not
multiplied by alpha. NaN and infinite values are passed on; who fits leaves them out.

Sizes are checked before memory is taken: one picture in memory may have at most ``MAX_VALUES`` values and needs to fit
into the machine's memory (:class:`ImageReader` reads larger ones by bands), and a header that claims over
``MAX_RATIO`` times the size of its file is refused, beyond a size that harms nobody.
"""

import dataclasses
import os

import numpy as np
from jaxtyping import Bool, Float32

from brdf.files import input_file
from brdf.images.encoding import Encoding, EncodingSource, decode_table
from brdf.images.file import (
    BAND_VALUES,
    MAX_RATIO,
    MAX_VALUES,
    band_rows,
    check_header,
    check_memory,
    open_image,
    parts,
    read_rows,
)
from brdf.images.reader import ImageReader
from brdf.images.writing import write_image, write_layers

__all__ = [
    "MAX_RATIO",
    "MAX_VALUES",
    "ImageReader",
    "Picture",
    "read_image",
    "read_layers",
    "read_mask",
    "read_picture",
    "write_image",
    "write_layers",
]

Array = np.ndarray


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
    """

    pixels: Float32[Array, "height width channels"]
    alpha: Float32[Array, "height width"] | None
    encoding: Encoding
    source: EncodingSource
    bits: int
    saturation: float | None
    factor: float | Array = 1.0

    def scaled(self, factor: float | Array) -> "Picture":
        """The picture in another unit: of another exposure, or under light of another intensity.

        Args:
            factor: what to multiply the values by, above 0, a number or (C,). Where channels differ in it, they clip at
                different levels: clipped pixels become NaN.
        """
        factors = np.asarray(factor, np.float32)
        pixels, saturation = self.pixels * factors, self.saturation
        if saturation is not None and factors.size == 1:
            saturation = saturation * float(factors.reshape(()))
        elif saturation is not None:
            clipped = np.any(self.pixels >= saturation * (1 - 1e-6), axis=-1, keepdims=True)
            pixels, saturation = np.where(clipped, np.float32(np.nan), pixels), np.inf
        return dataclasses.replace(self, pixels=pixels, saturation=saturation, factor=self.factor * factors)

    @property
    def code_step(self) -> float | None:
        """The distance of two codes before decoding, full scale 1; None for floats."""
        return None if self.saturation is None else 1.0 / ((1 << self.bits) - 1)

    def quantisation(self) -> Float32[Array, "height width channels"] | None:
        """The distance of neighbouring codes at each pixel after decoding, in the unit of the pixels; None for floats.

        The rounding error of a pixel is uniform within ± half of it.
        """
        if self.code_step is None:
            return None
        if self.encoding == "linear":
            return np.broadcast_to(np.float32(self.code_step) * np.float32(self.factor), self.pixels.shape)
        table = decode_table(self.encoding, min(self.bits, 16))
        return (np.interp(self.pixels / self.factor, table, np.gradient(table)) * self.factor).astype(np.float32)


def read_image(
    path: str | os.PathLike[str], *, encoding: Encoding | None = None
) -> Float32[Array, "height width channels"]:
    """Read a picture as linear values.

    Args:
        path: an EXR, HDR, PNG, TIFF, JPEG, TGA file or whatever else OpenImageIO reads.
        encoding: "linear", "srgb" or a gamma such as 2.2; None for what the file says (:mod:`brdf.images.encoding`).

    Returns:
        Colour without alpha and further layers: RGB, grey, or all bands of a spectral file in the order of the file.
        Integer files span 0 to 1.

    Raises:
        InputError: if the file cannot be read.
    """
    with ImageReader(path, encoding=encoding) as reader:
        return reader.read()


def read_picture(path: str | os.PathLike[str], *, encoding: Encoding | None = None) -> Picture:
    """Read a picture with alpha, saturation level and quantisation step.

    Args:
        path: the file, as for :func:`read_image`.
        encoding: as for :func:`read_image`.

    Returns:
        The picture.

    Raises:
        InputError: if the file cannot be read.
    """
    with ImageReader(path, encoding=encoding) as reader:
        top, _ = reader.codes
        return Picture(reader.read(), reader.read_alpha(), reader.encoding, reader.source, reader.bits, top)


def read_mask(path: str | os.PathLike[str]) -> Bool[Array, "height width"]:
    """Read which pixels are inside a mask.

    Args:
        path: a picture, white inside and black outside, or one whose alpha channel is the mask.

    Returns:
        True where alpha, or if that leaves out nothing or everything the mean of the channels, is over half of its
        largest value in the file.

    Raises:
        InputError: if the file cannot be read.
    """
    with ImageReader(path, encoding="linear") as reader:
        alpha = reader.read_alpha()
        inside = None if alpha is None else _over_half(alpha)
        if inside is None or inside.all() or not inside.any():
            inside = _over_half(_mean_of_channels(reader))
    return inside


def _mean_of_channels(reader: ImageReader) -> Float32[Array, "height width"]:
    if reader.shape[2] == 1:
        return reader.read()[..., 0]
    mean = np.empty(reader.shape[:2], np.float32)
    check_memory(reader.path, mean.size)
    with np.errstate(over="ignore", invalid="ignore"):  # NaN and infinite values are passed on
        for first, band in reader.bands():
            band.mean(axis=-1, out=mean[first : first + len(band)])
    return mean


def _over_half(values: Float32[Array, "height width"]) -> Bool[Array, "height width"]:
    values = np.nan_to_num(values, copy=False, nan=0.0)
    return values > 0.5 * values.max()


def read_layers(path: str | os.PathLike[str]) -> dict[str, Float32[Array, "height width channels"]]:
    """Read all channels of a file, grouped by layer.

    Args:
        path: usually an OpenEXR file with channels such as ``position.X`` and ``R``.

    Returns:
        Layer name to values as stored, not decoded. The name is what comes before the last dot of the channels' names;
        where they have none, it is the name of the file's part if it has several, else "". Channels are in the order
        R G B A, X Y Z, U V, else in the order of the file.

    Raises:
        InputError: if the file cannot be read.
    """
    file = input_file(path)
    image = open_image(file)
    count = parts(image)
    specs = [image.spec(part) for part in range(count)]
    for spec in specs:
        check_header(file, spec, image.format_name())
    check_memory(file, sum(spec.width * spec.height * spec.nchannels for spec in specs))
    layers: dict[str, Array] = {}
    for part, spec in enumerate(specs):
        own = spec.get_string_attribute("oiio:subimagename", str(part)) if count > 1 else ""
        groups: dict[str, list[int]] = {}
        names = spec.channelnames
        for index, name in enumerate(names):
            groups.setdefault(name.rpartition(".")[0] or own, []).append(index)
        own_layers = {layer: np.empty((spec.height, spec.width, len(groups[layer])), np.float32) for layer in groups}
        order = {layer: _usual_order(names, indices) for layer, indices in groups.items()}
        step = band_rows(spec, BAND_VALUES)
        for start in range(0, spec.height, step):
            rows = start, min(start + step, spec.height)
            pixels = read_rows(file, image, part, rows, (0, spec.nchannels), "float")
            for layer, values in own_layers.items():
                values[rows[0] : rows[1]] = pixels[..., order[layer]]
        layers |= own_layers
    image.close()
    return layers


def _usual_order(names: tuple[str, ...], indices: list[int]) -> list[int]:
    endings = {names[index].rpartition(".")[2].upper(): index for index in indices}
    if len(endings) < len(indices) or not set(endings) <= set("RGBAXYZUV"):
        return indices
    return [endings[letter] for letter in "RGBAXYZUV" if letter in endings]
