"""Measured BRDFs: tables of f_r at pairs of directions, as gonioreflectometers and material databases give them.

One table holds one isotropic or anisotropic material, any number of channels, in the local frame whose +z axis is the
normal. Negative values are measurement noise (or colours outside a gamut) and are kept.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Float

from brdf.errors import InputError, as_numbers

Vectors = Float[np.ndarray, "P 3"]
Values = Float[np.ndarray, "P C"]
Evaluation = Callable[[Vectors, Vectors], Values]
# Light and view of many pairs of directions, and the solid angle that each stands for.
Grid = tuple[Vectors, Vectors, Float[np.ndarray, " P"]]


@dataclasses.dataclass(frozen=True, eq=False)
class MeasuredBRDF:
    """Samples of one BRDF, both directions above the horizon.

    Attributes:
        name: what to call the material.
        to_light: unit vectors, (P, 3), local frame.
        to_view: unit vectors, (P, 3), local frame.
        values: f_r in 1/sr, (P, C), finite; some may be negative.
        channels: their names, such as "red" or "450 nm".
        solid_angle: what share of all pairs of directions each sample stands for, up to a constant, (P,); ones where
            the samples are scattered.
        left_out: how many entries of the file are no samples, by reason.
        evaluate: f_r at any pairs of directions, where the file determines it, NaN where it was not measured; None for
            scattered samples.
        below_zero: why values are below 0, where that is known; else it is noise of the measurement.

    Example:
        >>> up, slanted = [0, 0, 1], [0, 0.6, 0.8]
        >>> brdf.MeasuredBRDF.from_samples(to_light=[up, up], to_view=[up, slanted], values=[0.20, 0.19], name="chalk")
        MeasuredBRDF('chalk', 2 samples x 1 channels, 0 negative values)
    """

    name: str
    to_light: Vectors
    to_view: Vectors
    values: Values
    channels: tuple[str, ...]
    solid_angle: Float[np.ndarray, " P"]
    left_out: dict[str, int] = dataclasses.field(default_factory=dict)
    evaluate: Evaluation | None = dataclasses.field(default=None, repr=False)
    below_zero: str = ""

    @property
    def negative(self) -> int:
        """How many values are below 0."""
        return int(np.count_nonzero(self.values < 0))

    def __repr__(self) -> str:
        """Name and size."""
        samples, channels = self.values.shape
        return f"MeasuredBRDF({self.name!r}, {samples} samples x {channels} channels, {self.negative} negative values)"

    @classmethod
    def from_samples(
        cls,
        to_light: Any,
        to_view: Any,
        values: Any,
        *,
        name: str = "table",
        channels: tuple[str, ...] | None = None,
        solid_angle: Any = None,
        left_out: dict[str, int] | None = None,
        evaluate: Evaluation | None = None,
    ) -> "MeasuredBRDF":
        """A table of samples; those below the horizon or not finite are left out and counted.

        Args:
            to_light: directions, (P, 3), any length but 0.
            to_view: directions, (P, 3), any length but 0.
            values: f_r in 1/sr, (P, C) or (P,).
            name: what to call it.
            channels: their names; numbers by default.
            solid_angle: see the class, (P,), at least 0.
            left_out: what a reader left out before.
            evaluate: see the class.

        Raises:
            InputError: naming the argument, where shapes do not fit or no sample is left.
        """
        light, view = _directions("to_light", to_light), _directions("to_view", to_view)
        numbers = _rows("values", values)
        samples, count = numbers.shape
        weight = np.ones((samples, 1)) if solid_angle is None else _rows("solid_angle", solid_angle, 1)
        for what, array in (("to_light", light), ("to_view", view), ("solid_angle", weight)):
            if len(array) != samples:
                raise InputError(what, f"has {len(array)} rows for {samples} samples", "Give one per sample")
        if not np.all((weight >= 0) & (weight < np.inf)):
            raise InputError("solid_angle", "must be a finite number of 0 or more per sample", "Correct the values")
        channels = channels or tuple(map(str, range(count)))
        if len(channels) != count:
            raise InputError("channels", f"names {len(channels)} of {count} channels", "Name each channel")
        above = (light[:, 2] > 0) & (view[:, 2] > 0)
        good = above & np.all(np.isfinite(numbers), axis=1)
        counts = {"below the horizon": np.count_nonzero(~above), "not finite": np.count_nonzero(above & ~good)}
        counts = {reason: int(number) for reason, number in ((left_out or {}) | counts).items() if number}
        if not good.any():
            gone = ", ".join(f"{number} {reason}" for reason, number in counts.items())
            what = f"has no finite sample above the horizon ({gone or 'none at all'})"
            raise InputError(name, what, "Give a table with samples")
        kept = light[good], view[good], numbers[good], channels, weight[good, 0]
        return cls(name, *kept, left_out=counts, evaluate=evaluate)


def _rows(name, value, columns=None):
    given = as_numbers(name, value)
    rows = given[:, None] if given.ndim == 1 and columns in (None, 1) else given
    if rows.ndim != 2 or 0 == rows.shape[1] or (columns or rows.shape[1]) != rows.shape[1]:
        raise InputError(name, f"must be of shape (P, {columns or 'C'}), got {given.shape}", "Give a row per sample")
    return rows


def _directions(name, value):
    vectors = _rows(name, value, 3)
    size = np.linalg.norm(vectors, axis=1, keepdims=True)
    if not np.all(np.isfinite(size) & (size > 0)):
        raise InputError(name, "must be finite directions that are not zero", "Correct the values")
    return vectors / size


def from_angles(polar: Any, azimuth: Any) -> Vectors:
    """Unit vectors from angles in radians: from the normal, and about it from +x towards +y."""
    sine, cosine, _ = np.broadcast_arrays(np.sin(polar), np.cos(polar), azimuth)
    return np.stack([sine * np.cos(azimuth), sine * np.sin(azimuth), cosine], axis=-1)


def to_angles(vectors: Any) -> tuple[Any, Any]:
    """Angles in radians of vectors of any length, the inverse of `from_angles`; the azimuth from -pi to pi."""
    x, y, z = np.moveaxis(np.asarray(vectors), -1, 0)
    return np.arctan2(np.hypot(x, y), z), np.arctan2(y, x)


def from_half_angles(theta_h: Any, theta_d: Any, phi_d: Any, phi_h: Any = 0.0) -> tuple[Vectors, Vectors]:
    """Light and view directions from Rusinkiewicz' angles.

    Args:
        theta_h: angle between normal and half vector in radians, (...).
        theta_d: angle between half vector and light in radians, (...).
        phi_d: azimuth of the light about the half vector in radians, (...).
        phi_h: azimuth of the half vector in radians, (...).

    Source: S. Rusinkiewicz, "A new change of variables for efficient BRDF representation", EGWR 1998.
    """
    half, down, across = half_frame(theta_h, phi_h)
    x, y, z = np.moveaxis(from_angles(theta_d, phi_d)[..., None], -2, 0)
    beside = x * down + y * across
    return z * half + beside, z * half - beside


def half_frame(theta_h: Any, phi_h: Any) -> tuple[np.ndarray, ...]:
    """The half vector, and the directions in which theta_h and phi_h grow, from these."""
    quarter = 0.5 * np.pi
    return from_angles(theta_h, phi_h), from_angles(theta_h + quarter, phi_h), from_angles(quarter, phi_h + quarter)


def half_angle_grid(shape: tuple[int, int, int], turn: float) -> Grid:
    """Light and view in the middle of each cell of theta_h, theta_d and phi_d, and the solid angle that it stands for.

    Args:
        shape: how many cells; those of theta_h grow with its root, as MERL's do.
        turn: the range of phi_d in radians.

    Returns:
        Light and view, also below the horizon, and the share of all pairs of directions, of mean 1; phi_d fastest.
    """
    root, theta_d, phi_d = ((np.arange(count) + 0.5) / count for count in shape)
    theta_h, theta_d = 0.5 * np.pi * root * root, 0.5 * np.pi * theta_d
    light, view = from_half_angles(*np.meshgrid(theta_h, theta_d, turn * phi_d, indexing="ij"))
    # dω_light dω_view = 4 cos θ_d dω_half dω_difference, and dθ_h is in proportion to the root.
    share = np.outer(np.sin(theta_h) * root, np.sin(theta_d) * np.cos(theta_d)).ravel().repeat(shape[2])
    return light.reshape(-1, 3), view.reshape(-1, 3), share / np.mean(share)


def sampled(grid: Grid, f_r: Evaluation, **options: Any) -> MeasuredBRDF:
    """The table of a BRDF at those pairs of directions of a grid that are above the horizon.

    Options are further arguments of `MeasuredBRDF.from_samples`.
    """
    above = (grid[0][:, 2] > 0) & (grid[1][:, 2] > 0)
    light, view, share = (each[above] for each in grid)
    return MeasuredBRDF.from_samples(light, view, f_r(light, view), solid_angle=share, **options)
