"""Pictures written through OpenImageIO, whole or not at all, saying how they are encoded."""

import os
from collections.abc import Mapping
from typing import Any, Literal

import numpy as np
import OpenImageIO as oiio

from brdf.channels import MOST_CHANNELS
from brdf.errors import InputError
from brdf.files import AnyPath, as_path, atomic_path, utf8_name
from brdf.images.encoding import Encoding, encode, parse_encoding
from brdf.images.reading import said

DataType = Literal["uint8", "uint16", "half", "float"]

_FLOATS = {"float": ("linear",), "half": ("linear",)}
_PNG = ("srgb", "linear", 1.8, 2.2, 2.4)
_TIFF = {**_FLOATS, "uint8": ("srgb",), "uint16": ("srgb", "linear")}
_JPEG = {"uint8": ("srgb",)}
# Per suffix the data types that it can hold, and the encodings that a file of each can say, or reading it back would
# guess wrong; the usual one first.
_WRITABLE: dict[str, Mapping[str, tuple[Any, ...]]] = {
    ".exr": _FLOATS,
    ".hdr": {"float": ("linear",)},
    ".png": {"uint8": _PNG, "uint16": _PNG},
    ".tif": _TIFF,
    ".tiff": _TIFF,
    ".jpg": _JPEG,
    ".jpeg": _JPEG,
}
_LARGEST = {"half": 65504.0, "RGBE": 255 / 256 * 2.0**127}
_SPACES = {"linear": "lin_rec709_scene", "srgb": "srgb_rec709_scene"}


def write_image(
    path: AnyPath, array: Any, *, dtype: DataType | None = None, encoding: Encoding | None = None, alpha: Any = None
) -> None:
    """Write linear values as a picture, whole or not at all.

    Args:
        path: the file; its suffix chooses the format: .exr, .hdr, .png, .tif, .tiff, .jpg, .jpeg.
        array: linear values, (H, W) or (H, W, C). In integer formats values are clipped to [0, 1] and NaN becomes 0;
            in HDR, which has no sign, values below 0 and NaN do.
        dtype: "float" or "half" (EXR, TIFF), "uint8" or "uint16" (PNG, TIFF); None for float, or uint8
            in PNG and JPEG.
        encoding: integers only: "srgb" (the default), "linear" or a gamma. The file says which; where the format has no
            words for it, that is an error.
        alpha: coverage (H, W) to store beside the colour, not in JPEG and HDR.

    Raises:
        InputError: if format, data type, encoding and shape do not go together, or the file cannot be written.

    Example:
        >>> ball = brdf.render(brdf.preset("gold"), brdf.Scene.load("scene.toml"))
        >>> brdf.write_image("ball.png", ball)
    """
    suffix, kinds = _format(path)
    kind = dtype or next(iter(kinds))
    if kind not in kinds:
        raise InputError(path, f"{suffix} cannot hold {kind}", f"Use {' or '.join(kinds)}")
    pixels, sayable = _pixels(path, array), kinds[kind]
    if suffix not in (".exr", ".tif", ".tiff") and pixels.shape[2] not in (1, 3):
        what = f"a {suffix} file holds 1 or 3 channels, got {pixels.shape[2]}"
        raise InputError(path, what, "Write .exr or .tif instead")
    if suffix == ".hdr":
        pixels = np.fmax(np.broadcast_to(pixels, (*pixels.shape[:2], 3)), 0.0)
    encoded = parse_encoding("encoding", encoding) or sayable[0]
    if encoded not in sayable:
        words = f"Use {', '.join(map(str, sayable))}"
        raise InputError(path, f"a {suffix} of {kind} cannot say that it is encoded as {encoded}", words)
    if kind.startswith("uint"):
        pixels = encode(np.clip(np.nan_to_num(pixels, nan=0.0), 0.0, 1.0), encoded)
    elif kind == "half" and np.any(np.abs(pixels[np.isfinite(pixels)]) > _LARGEST["half"]):
        raise InputError(path, f"half floats end at {_LARGEST['half']:.0f}", 'Write dtype "float" instead')
    elif suffix == ".hdr" and np.any(pixels > _LARGEST["RGBE"]):
        raise InputError(path, f"values in HDR end at {_LARGEST['RGBE']:.3g}", "Write .exr instead")
    coverage = [] if alpha is None else [np.clip(_pixels(path, alpha), 0.0, 1.0)]
    if coverage and (suffix in (".hdr", ".jpg", ".jpeg") or coverage[0].shape != (*pixels.shape[:2], 1)):
        what = f"alpha of shape {coverage[0].shape[:2]} cannot go with a {suffix} of shape {pixels.shape[:2]}"
        raise InputError(path, what, "Give alpha as (H, W), and a file that can hold it")
    _write(path, {"": pixels}, kind, encoded, coverage)


def write_layers(path: AnyPath, layers: Mapping[str, Any]) -> None:
    """Write layers of one size into an OpenEXR file of floats, whole or not at all.

    They are (H, W) or (H, W, C) values by name; the layer "" is the picture.
    """
    arrays = {layer: _pixels(path, array) for layer, array in layers.items()}
    if _format(path)[0] != ".exr" or len({array.shape[:2] for array in arrays.values()}) != 1:
        raise InputError(path, "layers need an .exr file and one size", "Give arrays of one height and width")
    _write(path, arrays, "float", "linear")


def _format(path):
    suffix = as_path(path).suffix.lower()
    if suffix not in _WRITABLE:
        raise InputError(path, f"{suffix or 'no suffix'} is no image format", f"Use one of {' '.join(_WRITABLE)}")
    return suffix, _WRITABLE[suffix]


def _pixels(path: object, array: Any) -> np.ndarray:
    try:
        pixels = np.asarray(array)
        shape = f"shape {pixels.shape}" if pixels.dtype.kind in "fiub" else "no numbers"
    except (TypeError, ValueError):
        pixels, shape = np.empty(0), "no numbers"
    if pixels.ndim not in (2, 3) or 0 in pixels.shape or shape == "no numbers":
        raise InputError(path, f"a picture is (H, W) or (H, W, C) numbers, got {shape}", "Give such an array")
    return np.atleast_3d(pixels).astype(np.float32, copy=False)


def _write(path, layers, kind, encoding, coverage=()):
    names = []
    for layer, array in layers.items():
        channels = array.shape[2]
        endings = {1: "Y", 3: "XYZ" if layer else "RGB"}.get(channels) or [f"C{index:04d}" for index in range(channels)]
        names += [f"{layer}.{ending}" if layer else ending for ending in endings]
    names += ["A"] * len(coverage)
    if len(names) > MOST_CHANNELS:
        what = f"would have {len(names)} channels, which nothing reads back"
        raise InputError(path, what, f"Write at most {MOST_CHANNELS} into a file")
    pixels = np.ascontiguousarray(np.concatenate([*layers.values(), *coverage], axis=2))
    spec = oiio.ImageSpec(pixels.shape[1], pixels.shape[0], pixels.shape[2], kind)
    spec.channelnames = tuple(names)
    spec.alpha_channel = names.index("A") if coverage else -1
    spec.attribute("oiio:UnassociatedAlpha", 1)
    spec.attribute("DateTime", "")  # or the same picture would be another file a second later
    if as_path(path).suffix.lower().startswith(".jp"):
        spec.attribute("CompressionQuality", 95)
        spec.attribute("jpeg:subsampling", "4:4:4")
    if kind.startswith("uint"):
        power = "" if isinstance(encoding, str) else f"g{round(10 * encoding)}_rec709_scene"
        spec.attribute("oiio:ColorSpace", power or _SPACES[encoding])
    with atomic_path(path) as temporary:
        _ask_for_space(temporary, spec)
        file = oiio.ImageOutput.create(utf8_name(temporary))
        assert file is not None  # of a format that OpenImageIO has
        ok = file.open(str(temporary), spec) and file.write_image(pixels)
        # A remark without a failure does not count: TIFF complains of Exif data that nobody asked for.
        if not (file.close() and ok):
            what = f"cannot be written ({said(file, temporary) or 'no reason given'})"
            raise InputError(path, what, "Check the space left and the size of the picture")


def _ask_for_space(temporary: Any, spec: oiio.ImageSpec) -> None:
    """Find a full disk, a quota or a limit out first: libjpeg ends the program then, libpng and others do not tell."""
    if hasattr(os, "posix_fallocate"):
        with temporary.open("r+b") as file:
            os.posix_fallocate(file.fileno(), 0, 3 * spec.image_bytes() // 2 + (1 << 16))
