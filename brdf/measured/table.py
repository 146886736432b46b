"""Measured BRDFs: tables of f_r at pairs of directions, as gonioreflectometers and material databases give them.

One table holds one isotropic or anisotropic material, any number of channels, in the local frame whose +z axis is the
normal. Negative values are measurement noise (or colours outside a gamut) and are kept.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Float

from brdf.errors import InputError

Evaluation = Callable[[Float[np.ndarray, "P 3"], Float[np.ndarray, "P 3"]], Float[np.ndarray, "P C"]]

LARGEST_ANGLE = 2 * np.pi


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
        evaluate: f_r at any pairs of directions, where the file determines it; None for scattered samples.
    """

    name: str
    to_light: Float[np.ndarray, "P 3"]
    to_view: Float[np.ndarray, "P 3"]
    values: Float[np.ndarray, "P C"]
    channels: tuple[str, ...]
    solid_angle: Float[np.ndarray, " P"]
    left_out: dict[str, int] = dataclasses.field(default_factory=dict)
    evaluate: Evaluation | None = dataclasses.field(default=None, repr=False)

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
        numbers = _numbers("values", values)
        if numbers.ndim == 1:
            numbers = numbers[:, None]
        if numbers.ndim != 2 or numbers.shape[1] == 0:
            raise InputError("values", f"must be of shape (P, C), got {numbers.shape}", "Give a row per sample")
        weight = np.ones(len(numbers)) if solid_angle is None else _numbers("solid_angle", solid_angle)
        for what, array in (("to_light", light), ("to_view", view), ("solid_angle", weight)):
            if len(array) != len(numbers):
                raise InputError(what, f"has {len(array)} rows for {len(numbers)} samples", "Give one per sample")
        if weight.ndim != 1 or not np.all(np.isfinite(weight)) or np.any(weight < 0):
            raise InputError("solid_angle", "must be a finite number of 0 or more per sample", "Correct the values")
        names = channels or tuple(str(channel) for channel in range(numbers.shape[1]))
        if len(names) != numbers.shape[1]:
            raise InputError("channels", f"names {len(names)} of {numbers.shape[1]} channels", "Name each channel")
        counts = dict(left_out or {})
        above = (light[:, 2] > 0) & (view[:, 2] > 0)
        finite = np.all(np.isfinite(numbers), axis=1)
        for reason, kept in (("below the horizon", above), ("not finite", finite | ~above)):
            counts[reason] = counts.get(reason, 0) + int(np.count_nonzero(~kept))
        good = above & finite
        if not good.any():
            gone = ", ".join(f"{count} {reason}" for reason, count in counts.items() if count)
            came = f"has no finite sample above the horizon ({gone or 'none at all'})"
            raise InputError(name, came, "Give a table with samples")
        return cls(
            name=name,
            to_light=light[good],
            to_view=view[good],
            values=numbers[good],
            channels=names,
            solid_angle=weight[good],
            left_out={reason: count for reason, count in counts.items() if count},
            evaluate=evaluate,
        )


def _numbers(name: str, value: Any) -> np.ndarray:
    try:
        return np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        raise InputError(name, f"must be numbers, got {type(value).__name__}", "Give an array") from None


def _directions(name: str, value: Any) -> Float[np.ndarray, "P 3"]:
    vectors = _numbers(name, value)
    if vectors.ndim != 2 or vectors.shape[1] != 3:
        raise InputError(name, f"must be of shape (P, 3), got {vectors.shape}", "Give a direction per sample")
    size = np.max(np.abs(vectors), axis=1, initial=0.0, keepdims=True)
    if not np.all(np.isfinite(size)) or np.any(size == 0):
        raise InputError(name, "must be finite directions that are not zero", "Correct the values")
    vectors = vectors / size
    return vectors / np.sqrt(np.sum(vectors * vectors, axis=1, keepdims=True))


def from_angles(polar: Any, azimuth: Any) -> Float[np.ndarray, "*P 3"]:
    """Unit vectors from angles.

    Args:
        polar: angle from the normal in radians, (...).
        azimuth: angle about the normal from +x towards +y in radians, (...).
    """
    polar, azimuth = np.broadcast_arrays(np.asarray(polar, np.float64), np.asarray(azimuth, np.float64))
    sine = np.sin(polar)
    return np.stack([sine * np.cos(azimuth), sine * np.sin(azimuth), np.cos(polar)], axis=-1)


def from_half_angles(
    theta_h: Any, theta_d: Any, phi_d: Any, phi_h: Any = 0.0
) -> tuple[Float[np.ndarray, "*P 3"], Float[np.ndarray, "*P 3"]]:
    """Light and view directions from Rusinkiewicz' angles.

    Args:
        theta_h: angle between normal and half vector in radians, (...).
        theta_d: angle between half vector and light in radians, (...).
        phi_d: azimuth of the light about the half vector in radians, (...).
        phi_h: azimuth of the half vector in radians, (...).

    Source: S. Rusinkiewicz, "A new change of variables for efficient BRDF representation", EGWR 1998.
    """
    difference = from_angles(theta_d, phi_d)
    cosine, sine = np.cos(theta_h), np.sin(theta_h)
    turned = np.stack(
        [
            cosine * difference[..., 0] + sine * difference[..., 2],
            difference[..., 1],
            cosine * difference[..., 2] - sine * difference[..., 0],
        ],
        axis=-1,
    )
    c, s = np.cos(phi_h), np.sin(phi_h)
    light = np.stack(
        [c * turned[..., 0] - s * turned[..., 1], s * turned[..., 0] + c * turned[..., 1], turned[..., 2]], -1
    )
    half = from_angles(theta_h, phi_h)
    view = 2 * np.sum(half * light, axis=-1, keepdims=True) * half - light
    return light, view
