"""MERL ``.binary`` files: three 32-bit sizes (90, 90, 180), then red, green and blue as doubles in units of their own.

The order is theta_h, theta_d, phi_d, the last one fastest, as in the published reader ``BRDFRead.cpp``. That one looks
up entry ``floor(90 sqrt(theta_h / 90°))``, so entry i of theta_h holds the angles from 90° (i/90)² to 90° ((i+1)/90)²,
and the sample stands in the middle of that root; theta_d and phi_d (0 to 180°, light and view being exchangeable) have
steps of a degree. Source: W. Matusik et al., "A data-driven reflectance model", SIGGRAPH 2003.
"""

import functools
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from brdf.errors import InputError
from brdf.measured.table import Grid, MeasuredBRDF, half_angle_grid, half_frame, sampled, to_angles

SHAPE = (90, 90, 180)
SCALES = np.array([1.0 / 1500.0, 1.15 / 1500.0, 1.66 / 1500.0])
HEADER = np.array(SHAPE, "<i4").tobytes()
SIZE = len(HEADER) + 3 * 8 * math.prod(SHAPE)

# What the file holds where nothing was measured, before scaling, as a rule in all channels; no measurement hits it.
_MISSING = -1.0


@functools.lru_cache(maxsize=1)
def grid() -> Grid:
    """Light and view of every entry, also below the horizon, and the solid angle that it stands for."""
    return half_angle_grid(SHAPE, np.pi)


def load(path: Path) -> MeasuredBRDF:
    """Read an ordinary file; refused where size and header do not fit."""
    content, size = np.fromfile(path, "u1", SIZE), path.stat().st_size
    if size < len(HEADER):
        raise InputError(path, "ends within its header", "The file is damaged; get it again")
    sizes, expected = (" x ".join(map(str, np.frombuffer(head, "<i4", 3))) for head in (content, HEADER))
    if sizes != expected:
        what = f"says it holds {sizes} entries, MERL's hold {expected}"
        raise InputError(path, what, "Give a file of the MERL database, or its layout")
    if size != SIZE:
        raise InputError(path, f"has {size} bytes instead of {SIZE}", "The file is damaged; get it again")
    stored = content[len(HEADER) :].view("<f8").reshape(3, -1)
    light, view, share = grid()
    missing = np.any(stored == _MISSING, axis=0)
    kept = ~missing | (light[:, 2] <= 0) | (view[:, 2] <= 0)
    with np.errstate(over="ignore", invalid="ignore"):
        values = stored.T * SCALES
    values[missing] = np.nan
    return MeasuredBRDF.from_samples(
        light[kept],
        view[kept],
        values[kept],
        name=path.stem,
        channels=("red", "green", "blue"),
        solid_angle=share[kept],
        left_out={"not measured": int(np.count_nonzero(~kept))},
        evaluate=functools.partial(_look_up, values),
    )


def merl_table(f_r: Callable[[Any, Any], Any], *, name: str = "table") -> MeasuredBRDF:
    """The table that a measurement of a BRDF on MERL's grid would give; checks look between its entries too.

    Args:
        f_r: from light and view directions, (P, 3) each, to values in 1/sr, (P, C) or (P,).
        name: what to call it.

    Raises:
        InputError: where the values do not fit.

    Example:
        >>> brdf.merl_table(lambda to_light, to_view: np.full(len(to_light), 0.2), name="chalk")
        MeasuredBRDF('chalk', 1096216 samples x 1 channels, 0 negative values)
    """

    def evaluate(to_light: Any, to_view: Any) -> Any:
        values = np.asarray(f_r(to_light, to_view))
        return values[:, None] if values.ndim == 1 else values

    return sampled(grid(), evaluate, name=name, evaluate=evaluate)


def _look_up(values, to_light, to_view):
    """The entry that directions fall into, as the published reader does it."""
    theta_h, phi_h = to_angles(to_light + to_view)
    half, down, across = half_frame(theta_h, phi_h)
    theta_d, phi_d = to_angles(np.stack([np.sum(axis * to_light, axis=-1) for axis in (down, across, half)], axis=-1))
    position = SHAPE[0] * (theta_h / (0.5 * np.pi)) ** 0.5, np.degrees(theta_d), np.degrees(phi_d % np.pi)
    return values[np.ravel_multi_index(np.floor(position).astype(int), SHAPE, mode="clip")]
