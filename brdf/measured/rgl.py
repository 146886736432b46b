"""RGL ``.bsdf`` files, evaluated by Mitsuba's ``measured`` plugin: ``pip install brdf-fitting[measured]``.

Mitsuba trusts what a file says of itself, so its fields are checked here first: names, types, shapes, and that every
one lies within the file. Source: J. Dupuy and W. Jakob, "An adaptive parameterization for efficient material
acquisition and rendering", SIGGRAPH Asia 2018; the layout is Mitsuba's ``tensor_file`` 1.0.
"""

import dataclasses
import io
import math
import struct
from pathlib import Path
from typing import Any

import numpy as np

from brdf.errors import InputError
from brdf.files import utf8_name
from brdf.measured.table import MeasuredBRDF, half_angle_grid, sampled

MAGIC = b"tensor_file\0"

_MOST_FIELDS = 64
_MOST_BYTES = 1 << 31
_TYPES = {5: np.dtype("<u4"), 10: np.dtype("<f4")}  # others count in bytes
_BYTE, _FLOAT = 1, 10
# The dimensions of a field, those of one letter alike: azimuths and polar angles of the light, channels, others.
_LAYOUT = {"phi_i": "p", "theta_i": "t", "sigma": "..", "ndf": "..", "vndf": "pt..", "luminance": "ptxy"}
_SPECTRAL = {"wavelengths": "c", "spectra": "ptcxy"}
_ONE_IS_ENOUGH = "pc"
_REPAIR = "The file is damaged; get it again"
# Half angle, difference angle and azimuth: the samples that a fit sees. The files hold 32 x 32 views for 8 lights.
_GRID = (90, 30, 36)


def read_fields(content: bytes, where: object) -> dict[str, tuple[int, np.ndarray]]:
    """The arrays that a tensor file says it holds, each found to lie within it; refused where the file is damaged.

    Returns:
        By name, the code of its type and the array.
    """
    stream, fields = io.BytesIO(content), {}
    stream.seek(len(MAGIC))

    def take(layout: str) -> tuple[Any, ...]:
        return struct.unpack(f"<{layout}", stream.read(struct.calcsize(f"<{layout}")))

    try:
        major, minor, count = take("BBI")
        if (major, minor) != (1, 0) or count > _MOST_FIELDS:
            raise InputError(where, f"is of version {major}.{minor} with {count} fields", "Version 1.0 is read")
        for _ in range(count):
            name = stream.read(*take("H")).decode("ascii", "replace")
            dimensions, kind, start = take("HBQ")
            shape, dtype = take(f"{dimensions}Q"), _TYPES.get(kind, np.dtype("u1"))
            if dimensions > 8 or start + math.prod(max(length, 1) for length in shape) * dtype.itemsize > len(content):
                raise InputError(f"{where}: {name[:40]}", "reaches beyond the end of the file", _REPAIR)
            fields[name] = kind, np.frombuffer(content, dtype, math.prod(shape), start).reshape(shape)
    except struct.error:
        raise InputError(where, "ends within its header", _REPAIR) from None
    return fields


def _check(content, where):
    """Names of the channels, after finding that Mitsuba can read the file."""
    fields = read_fields(content, where)

    def demand(name, good, what):
        if not good:
            raise InputError(f"{where}: {name}", what, _REPAIR)

    spectral = "spectra" in fields and "rgb" not in fields
    sizes = {} if spectral else {"c": 3}
    for name, letters in (_LAYOUT | (_SPECTRAL if spectral else {"rgb": "ptcxy"})).items():
        if name not in fields:
            raise InputError(where, f"has no field {name}", "Give an isotropic or anisotropic file of the RGL database")
        kind, values = fields[name]
        fits = kind == _FLOAT and values.ndim == len(letters)
        for letter, size in zip(letters, values.shape, strict=False):
            fits &= size >= (1 if letter in _ONE_IS_ENOUGH else 2)
            fits &= letter == "." or sizes.setdefault(letter, size) == size
        given = f"got {list(values.shape)} of type {kind}"
        demand(name, fits, f"must be {len(letters)}-dimensional float32 that fits to the other fields, {given}")
        demand(name, np.isfinite(values).all(), "holds values that are not finite")
        demand(name, len(letters) > 1 or np.all(np.diff(values) > 0), "does not grow from entry to entry")
    for name, what in (("jacobian", "one byte"), ("description", "text")):
        kind, values = fields.get(name, (0, np.empty(0)))
        sound = kind == _BYTE and values.ndim == 1 and (name == "description" or values.size == 1)
        demand(name, sound, f"must be {what}")
    if spectral:
        return tuple(f"{wavelength:g} nm" for wavelength in fields["wavelengths"][1])
    return ("red", "green", "blue")


def load(path: Path) -> MeasuredBRDF:
    """Read a file, evaluated on a grid of half and difference angles; refused if damaged or without Mitsuba."""
    if path.stat().st_size > _MOST_BYTES:
        raise InputError(path, f"is larger than {_MOST_BYTES >> 30} GiB", "Give a .bsdf file of the RGL database")
    channels = _check(path.read_bytes(), path)
    evaluate = _evaluation(path, channels)
    table = sampled(half_angle_grid(_GRID, 2 * np.pi), evaluate, name=path.stem, channels=channels, evaluate=evaluate)
    return dataclasses.replace(table, below_zero="which Mitsuba's interpolation of the file makes, no measurement")


def _evaluation(path, channels):
    try:
        import mitsuba
    except ImportError:
        remedy = "Install it: pip install brdf-fitting[measured]"
        raise InputError(path, "is read through Mitsuba, which is not installed", remedy) from None
    wavelengths = [float(name.removesuffix(" nm")) for name in channels if name.endswith("nm")]
    before = mitsuba.variant()
    try:
        # The vectorised variants compile through LLVM, which ends the process where its version does not suit them.
        mitsuba.set_variant("scalar_spectral" if wavelengths else "scalar_rgb")
        plugin: Any = mitsuba.load_dict({"type": "measured", "filename": utf8_name(path)})
        context, vector = mitsuba.BSDFContext(), mitsuba.Vector3f
        interaction: Any = mitsuba.SurfaceInteraction3f()
    except (RuntimeError, ImportError) as error:
        raise InputError(path, f"Mitsuba cannot read it ({str(error).splitlines()[0]})", _REPAIR) from None
    finally:
        if before:
            mitsuba.set_variant(before)
    together = 4 if wavelengths else 3  # channels that Mitsuba evaluates at once

    def evaluate(to_light, to_view):
        to_light, to_view = np.broadcast_arrays(to_light, to_view)
        values = np.zeros((len(to_light), len(channels)))
        for first in range(0, len(channels), together):
            if wavelengths:
                interaction.wavelengths = (wavelengths[first:] + wavelengths[-1:] * 3)[:4]
            rows = values[:, first : first + together]
            for row, light, view in zip(rows, to_light.tolist(), to_view.tolist(), strict=True):
                # The files hold views for directions of light; Mitsuba's "wi" is the one, its "wo" the other.
                interaction.wi = vector(*light)
                row[:] = list(plugin.eval(context, interaction, vector(*view)))[: len(row)]
        cosine = to_view[:, 2:]
        return np.where((cosine > 0) & (to_light[:, 2:] > 0), values / np.where(cosine > 0, cosine, 1.0), 0.0)

    return evaluate
