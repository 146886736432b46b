"""RGL ``.bsdf`` files, evaluated by Mitsuba's ``measured`` plugin: ``pip install brdf-fitting[measured]``.

Mitsuba trusts what a file says of itself, so its fields are checked here first: names, types, shapes, and that every
one lies within the file. Source: J. Dupuy and W. Jakob, "An adaptive parameterization for efficient material
acquisition and rendering", SIGGRAPH Asia 2018; the layout is Mitsuba's ``tensor_file`` 1.0.
"""

import dataclasses
import math
import struct
import threading
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from brdf.errors import InputError
from brdf.files import utf8_name
from brdf.measured.table import Evaluation, MeasuredBRDF, from_half_angles

MAGIC = b"tensor_file\0"

_MOST_FIELDS = 64
_MOST_BYTES = 1 << 31
_TYPES = {1: np.dtype("u1"), 5: np.dtype("<u4"), 10: np.dtype("<f4")}
_REPAIR = "The file is damaged; get it again"
# Half angle, difference angle and azimuth: the samples that a fit sees. The files hold 32 x 32 views for 8 lights.
_GRID = (90, 30, 36)
_variant_lock = threading.Lock()


@dataclasses.dataclass(frozen=True)
class Field:
    """One array of the file.

    Attributes:
        kind: code of its type.
        shape: its sizes.
        start: where it begins, in bytes.
    """

    kind: int
    shape: tuple[int, ...]
    start: int

    @property
    def count(self) -> int:
        """How many entries it has."""
        return math.prod(self.shape)


def read_fields(content: bytes, place: object) -> dict[str, Field]:
    """The arrays that a tensor file says it holds, each found to lie within it.

    Args:
        content: of the file.
        place: the file, for messages.

    Raises:
        InputError: where the file is damaged.
    """

    def take(layout: str, at: int) -> tuple[Any, ...]:
        try:
            return struct.unpack_from("<" + layout, content, at)
        except struct.error:
            raise InputError(place, "ends within its header", _REPAIR) from None

    if not content.startswith(MAGIC):
        raise InputError(place, "is no tensor file", "Give a .bsdf file of the RGL database")
    version = take("BB", len(MAGIC))
    (count,) = take("I", 14)
    if version != (1, 0) or count > _MOST_FIELDS:
        raise InputError(place, f"is of version {version[0]}.{version[1]} with {count} fields", "Version 1.0 is read")
    at, fields = 18, {}
    for _ in range(count):
        (length,) = take("H", at)
        name = content[at + 2 : at + 2 + length].decode("ascii", "replace")
        dimensions, kind, start = take("HBQ", at + 2 + length)
        if dimensions > 8:
            raise InputError(f"{place}: {name[:40]}", f"has {dimensions} dimensions", _REPAIR)
        at += 2 + length + 11
        shape = take(f"{dimensions}Q", at)
        at += 8 * dimensions
        field = Field(kind, shape, start)
        size = _TYPES[kind].itemsize if kind in _TYPES else 1
        if start + field.count * size > len(content):
            raise InputError(f"{place}: {name[:40]}", "reaches beyond the end of the file", _REPAIR)
        fields[name] = field
    return fields


def _check(content: bytes, place: object) -> tuple[str, ...]:
    """Names of the channels, after finding that Mitsuba can read the file."""
    fields = read_fields(content, place)

    def numbers(name: str, dimensions: int, smallest: int = 1) -> Float[np.ndarray, "..."]:
        field = fields.get(name)
        if field is None:
            raise InputError(place, f"has no field {name}", "Give an isotropic or anisotropic file of the RGL database")
        if field.kind != 10 or len(field.shape) != dimensions or min(field.shape, default=0) < smallest:
            came = f"must be {dimensions}-dimensional and of type float32, got {list(field.shape)} of type {field.kind}"
            raise InputError(f"{place}: {name}", came, _REPAIR)
        values = np.frombuffer(content, "<f4", field.count, field.start).reshape(field.shape)
        if not np.all(np.isfinite(values)):
            raise InputError(f"{place}: {name}", "holds values that are not finite", _REPAIR)
        return values

    phi, theta = numbers("phi_i", 1), numbers("theta_i", 1, 2)
    for name, angles in (("phi_i", phi), ("theta_i", theta)):
        if np.any(np.diff(angles) <= 0):
            raise InputError(f"{place}: {name}", "does not grow from entry to entry", _REPAIR)
    numbers("sigma", 2, 2)
    numbers("ndf", 2, 2)
    spectral = "spectra" in fields and "rgb" not in fields
    colour = numbers("spectra" if spectral else "rgb", 5)
    leading = {"vndf": numbers("vndf", 4).shape[:2], "luminance": numbers("luminance", 4).shape[:2]}
    leading["colour"] = colour.shape[:2]
    for name, shape in leading.items():
        if shape != (phi.size, theta.size):
            came = f"has {shape[0]} x {shape[1]} slices for {phi.size} x {theta.size} directions of light"
            raise InputError(f"{place}: {name}", came, _REPAIR)
    for name in ("vndf", "luminance"):
        if min(fields[name].shape[2:]) < 2:
            raise InputError(f"{place}: {name}", f"is of shape {list(fields[name].shape)}", _REPAIR)
    if min(colour.shape[3:]) < 2 or colour.shape[3:] != fields["luminance"].shape[2:]:
        raise InputError(f"{place}: colour", f"is of shape {list(colour.shape)}", _REPAIR)
    jacobian = fields.get("jacobian")
    if jacobian is None or jacobian.kind != 1 or jacobian.shape != (1,):
        raise InputError(f"{place}: jacobian", "must be one byte", _REPAIR)
    description = fields.get("description")
    if description is None or description.kind != 1 or len(description.shape) != 1:
        raise InputError(f"{place}: description", "must be text", _REPAIR)
    if not spectral:
        if colour.shape[2] != 3:
            raise InputError(f"{place}: rgb", f"has {colour.shape[2]} channels instead of 3", _REPAIR)
        return ("red", "green", "blue")
    wavelengths = numbers("wavelengths", 1, 2)
    if wavelengths.size != colour.shape[2] or np.any(np.diff(wavelengths) <= 0):
        raise InputError(f"{place}: wavelengths", "does not fit to the spectra", _REPAIR)
    return tuple(f"{wavelength:g} nm" for wavelength in wavelengths)


def load(path: Path) -> MeasuredBRDF:
    """Read a file and evaluate it on a grid of half and difference angles.

    Args:
        path: an ordinary file.

    Raises:
        InputError: where the file is damaged or Mitsuba is not installed.
    """
    if path.stat().st_size > _MOST_BYTES:
        raise InputError(path, f"is larger than {_MOST_BYTES >> 30} GiB", "Give a .bsdf file of the RGL database")
    content = path.read_bytes()
    channels = _check(content, path)
    del content
    evaluate = _evaluation(path, channels)
    root = (np.arange(_GRID[0]) + 0.5) / _GRID[0]
    theta_h = 0.5 * np.pi * root * root
    theta_d = (np.arange(_GRID[1]) + 0.5) * 0.5 * np.pi / _GRID[1]
    phi_d = (np.arange(_GRID[2]) + 0.5) * 2 * np.pi / _GRID[2]
    light, view = from_half_angles(*np.meshgrid(theta_h, theta_d, phi_d, indexing="ij"))
    # As for MERL's grid: dω_light dω_view = 4 cos θ_d dω_half dω_difference.
    share = (np.sin(theta_h) * root)[:, None, None] * (np.sin(theta_d) * np.cos(theta_d))[None, :, None]
    share = np.broadcast_to(share / np.mean(share), _GRID)
    above = (light[..., 2] > 0) & (view[..., 2] > 0)
    light, view = light[above], view[above]
    return MeasuredBRDF.from_samples(
        light,
        view,
        evaluate(light, view),
        name=path.stem,
        channels=channels,
        solid_angle=share[above],
        evaluate=evaluate,
    )


def _evaluation(path: Path, channels: tuple[str, ...]) -> Evaluation:
    try:
        import mitsuba
    except ImportError:
        remedy = "Install it: pip install brdf-fitting[measured]"
        raise InputError(path, "is read through Mitsuba, which is not installed", remedy) from None
    spectral = channels[0].endswith("nm")
    # The vectorised variants compile through LLVM, which ends the process where its version does not suit them.
    variant = "scalar_spectral" if spectral else "scalar_rgb"
    with _variant_lock:
        before = mitsuba.variant()
        try:
            mitsuba.set_variant(variant)
            plugin: Any = mitsuba.load_dict({"type": "measured", "filename": utf8_name(path)})
            context: Any = mitsuba.BSDFContext()
            interaction: Any = mitsuba.SurfaceInteraction3f()
            vector = mitsuba.Vector3f
        except (RuntimeError, ImportError) as error:
            raise InputError(path, f"Mitsuba cannot read it ({str(error).splitlines()[0]})", _REPAIR) from None
        finally:
            if before:
                mitsuba.set_variant(before)

    def evaluate(to_light: Float[np.ndarray, "P 3"], to_view: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "P C"]:
        to_light, to_view = np.broadcast_arrays(to_light, to_view)
        values = np.zeros((len(to_light), len(channels)))
        for first in range(0, len(channels), 4 if spectral else len(channels)):
            if spectral:
                four = [float(name.split()[0]) for name in channels[first : first + 4]]
                interaction.wavelengths = [*four, *[four[-1]] * (4 - len(four))]
            for index, (light, view) in enumerate(zip(to_light.tolist(), to_view.tolist(), strict=True)):
                # The files hold views for directions of light; Mitsuba's "wi" is the one, its "wo" the other.
                interaction.wi = vector(*light)
                found = plugin.eval(context, interaction, vector(*view))
                last = min(first + len(found), len(channels))
                values[index, first:last] = [found[i] for i in range(last - first)]
        cosine = to_view[:, 2:]
        return np.where((cosine > 0) & (to_light[:, 2:] > 0), values / np.where(cosine > 0, cosine, 1.0), 0.0)

    return evaluate
