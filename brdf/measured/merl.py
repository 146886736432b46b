"""MERL ``.binary`` files: three 32-bit sizes (90, 90, 180), then red, green and blue as doubles in units of their own.

The order is theta_h, theta_d, phi_d, the last one fastest, as in the published reader ``BRDFRead.cpp``. That one looks
up entry ``floor(90 sqrt(theta_h / 90°))``, so entry i of theta_h holds the angles from 90° (i/90)² to 90° ((i+1)/90)²,
and the sample stands in the middle of that root; theta_d and phi_d (0 to 180°, light and view being exchangeable) have
steps of a degree. Source: W. Matusik et al., "A data-driven reflectance model", SIGGRAPH 2003.
"""

import functools
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from brdf.errors import InputError
from brdf.measured.table import MeasuredBRDF, from_half_angles

SHAPE = (90, 90, 180)
SCALES = np.array([1.0 / 1500.0, 1.15 / 1500.0, 1.66 / 1500.0])
CHANNELS = ("red", "green", "blue")

_COUNT = SHAPE[0] * SHAPE[1] * SHAPE[2]
_SIZE = 12 + 3 * 8 * _COUNT
# What the file holds where nothing was measured, before scaling.
_MISSING = -1.0


def claims(head: bytes, size: int) -> bool:
    """Whether a file is MERL's by its first bytes or its size.

    Args:
        head: at least 12 bytes of it.
        size: of the file in bytes.
    """
    return size == _SIZE or (len(head) >= 12 and struct.unpack_from("<3i", head) == SHAPE)


@functools.lru_cache(maxsize=1)
def grid() -> tuple[Float[np.ndarray, "P 3"], Float[np.ndarray, "P 3"], Float[np.ndarray, " P"]]:
    """Light and view of every entry, also below the horizon, and the solid angle that it stands for."""
    root = (np.arange(SHAPE[0]) + 0.5) / SHAPE[0]
    theta_h = 0.5 * np.pi * root * root
    theta_d = np.radians(np.arange(SHAPE[1]) + 0.5)
    phi_d = np.radians(np.arange(SHAPE[2]) + 0.5)
    each = np.meshgrid(theta_h, theta_d, phi_d, indexing="ij")
    light, view = from_half_angles(*each)
    # dω_light dω_view = 4 cos θ_d dω_half dω_difference, and dθ_h is in proportion to the root.
    share = (np.sin(theta_h) * root)[:, None, None] * (np.sin(theta_d) * np.cos(theta_d))[None, :, None]
    share = np.broadcast_to(share, SHAPE)
    arrays = light.reshape(-1, 3), view.reshape(-1, 3), share.reshape(-1) / np.mean(share)
    for array in arrays:
        array.setflags(write=False)
    return arrays


def load(path: Path) -> MeasuredBRDF:
    """Read a file.

    Args:
        path: an ordinary file.

    Raises:
        InputError: where size and header do not fit.
    """
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(12)
        if len(head) < 12:
            raise InputError(path, "ends within its header", "The file is damaged; get it again")
        sizes = struct.unpack("<3i", head)
        if sizes != SHAPE:
            came = f"says it holds {' x '.join(map(str, sizes))} entries, MERL's hold {' x '.join(map(str, SHAPE))}"
            raise InputError(path, came, "Give a file of the MERL database, or its layout")
        if size != _SIZE:
            raise InputError(path, f"has {size} bytes instead of {_SIZE}", "The file is damaged; get it again")
        stored = np.frombuffer(file.read(_SIZE - 12), "<f8").reshape(3, _COUNT)
    return _table(stored.T, SCALES, path.stem)


def _table(stored: Float[np.ndarray, "P 3"], scales: np.ndarray, name: str) -> MeasuredBRDF:
    light, view, share = grid()
    missing = np.all(stored == _MISSING, axis=1) & (light[:, 2] > 0) & (view[:, 2] > 0)
    with np.errstate(over="ignore", invalid="ignore"):
        values = stored * scales
    kept = ~missing
    return MeasuredBRDF.from_samples(
        light[kept],
        view[kept],
        values[kept],
        name=name,
        channels=CHANNELS if values.shape[1] == 3 else None,
        solid_angle=share[kept],
        left_out={"not measured": int(np.count_nonzero(missing))},
        evaluate=functools.partial(_look_up, values),
    )


def merl_table(f_r: Callable[[Any, Any], Any], *, name: str = "table") -> MeasuredBRDF:
    """The table that a measurement of a BRDF on MERL's grid would give.

    Args:
        f_r: from light and view directions, (P, 3) each, to values in 1/sr, (P, C) or (P,).
        name: what to call it.

    Raises:
        InputError: where the values do not fit.
    """
    light, view, share = grid()
    above = (light[:, 2] > 0) & (view[:, 2] > 0)
    values = np.asarray(f_r(light[above], view[above]), np.float64)
    return MeasuredBRDF.from_samples(light[above], view[above], values, name=name, solid_angle=share[above])


def _look_up(
    values: Float[np.ndarray, "P C"], to_light: Float[np.ndarray, "Q 3"], to_view: Float[np.ndarray, "Q 3"]
) -> Float[np.ndarray, "Q C"]:
    """The entry that directions fall into, as the published reader does it."""
    half = to_light + to_view
    half = half / np.maximum(np.linalg.norm(half, axis=-1, keepdims=True), 1e-300)
    theta_h = np.arctan2(np.linalg.norm(half[..., :2], axis=-1), half[..., 2])
    along = np.sum(half * to_light, axis=-1)
    theta_d = np.arctan2(np.linalg.norm(np.cross(half, to_light), axis=-1), along)
    # Tangent frame of the half vector: the direction in which theta_h grows, and the azimuth's.
    flat = np.linalg.norm(half[..., :2], axis=-1)
    azimuth = np.where(flat > 0, np.arctan2(half[..., 1], half[..., 0]), 0.0)
    first = np.stack([np.cos(theta_h) * np.cos(azimuth), np.cos(theta_h) * np.sin(azimuth), -np.sin(theta_h)], axis=-1)
    second = np.stack([-np.sin(azimuth), np.cos(azimuth), np.zeros_like(azimuth)], axis=-1)
    phi_d = np.arctan2(np.sum(second * to_light, axis=-1), np.sum(first * to_light, axis=-1)) % np.pi
    place = [
        np.clip(np.floor(position), 0, size - 1).astype(int)
        for position, size in zip(
            (SHAPE[0] * (theta_h / (0.5 * np.pi)) ** 0.5, np.degrees(theta_d), np.degrees(phi_d)), SHAPE, strict=True
        )
    ]
    return values[np.ravel_multi_index(tuple(place), SHAPE)]
