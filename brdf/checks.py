"""Values caught at the border: converters for the fields of scenes and materials.

A converter turns what the user gave into a float64 array and refuses what cannot be one. Values that JAX already
holds (arrays and tracers of a transformation) keep their type; only their shape is checked.
"""

import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from brdf.errors import InputError

Parameter = jax.Array | np.ndarray


LARGEST = 1e15
"""Of any number of a scene: squares and products of a few of them stay within float32's 3e38."""


def _array(name: str, value: Any, shape_words: str, largest: float = LARGEST) -> Any:
    if isinstance(value, jax.Array):
        return value
    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        raise InputError(name, f"must be {shape_words}, got {_shown(value)}", "Give plain numbers") from None
    if not np.all(np.isfinite(array)):
        raise InputError(name, f"must be finite, got {_shown(value)}", "Give finite numbers")
    if np.any(np.abs(array) > largest):
        raise InputError(name, f"must be within ± {largest:g}, got {_shown(value)}", "Use another unit")
    return array


def _shown(value: Any) -> str:
    text = repr(value.tolist() if isinstance(value, np.ndarray) else value)
    return text if len(text) <= 60 else text[:57] + "..."


def vector(name: str, largest: float = LARGEST) -> Callable[[Any], Any]:
    """A converter for a position or an edge: three finite numbers up to ``largest``."""

    def convert(value: Any) -> Any:
        array = _array(name, value, "three numbers", largest)
        if array.shape != (3,):
            raise InputError(name, f"must be three numbers, got {_shown(value)}", "Give [x, y, z]")
        return array

    return convert


def direction_value(name: str) -> Callable[[Any], Any]:
    """A converter for a direction of any length: three finite numbers, not all zero."""
    to_vector = vector(name, np.inf)

    def convert(value: Any) -> Any:
        array = to_vector(value)
        if not isinstance(array, np.ndarray):
            return array
        if not np.any(array):
            raise InputError(name, "must not have zero length, got [0, 0, 0]", "Give a direction")
        size = np.max(np.abs(array))
        # Its squares must not leave float32; else it stays as it was given.
        return array if 1e-6 <= size <= 1e6 else array / size

    return convert


def number(
    name: str, low: float = -np.inf, high: float = np.inf, *, above: float = -np.inf, below: float = np.inf
) -> Callable[[Any], Any]:
    """A converter for one number with ``low`` <= x <= ``high`` and ``above`` < x < ``below``."""

    def convert(value: Any) -> Any:
        array = _array(name, value, "a number")
        if array.shape != ():
            raise InputError(name, f"must be one number, got {_shown(value)}", "Give a single number")
        if isinstance(array, np.ndarray):
            _within(name, float(array), low, high, above, below)
        return array

    return convert


def _within(name: str, value: float, low: float, high: float, above: float, below: float) -> None:
    limits = [
        (value < low, f"at least {low:g}"),
        (value > high, f"at most {high:g}"),
        (value <= above, f"greater than {above:g}"),
        (value >= below, f"less than {below:g}"),
    ]
    broken = [words for is_broken, words in limits if is_broken]
    if broken:
        raise InputError(name, f"must be {broken[0]}, got {value:g}", "Correct the value")


def positive(name: str) -> Callable[[Any], Any]:
    """A converter for one number greater than 0."""
    return number(name, above=0.0)


def spectrum(name: str) -> Callable[[Any], Any]:
    """A converter for one value per channel, at least 0; a single number becomes one channel."""

    def convert(value: Any) -> Any:
        array = _array(name, value, "a number per channel")
        if array.ndim == 0:
            array = array.reshape(1)
        if array.ndim != 1 or array.shape[0] == 0:
            raise InputError(name, f"must be a number per channel, got {_shown(value)}", "Give a list of numbers")
        if isinstance(array, np.ndarray) and np.any(array < 0):
            channel = int(np.argmax(array < 0))
            came = f"must be at least 0, got {array[channel]:g} in channel {channel}"
            raise InputError(name, came, "Give values of 0 or more")
        return array

    return convert


MAX_SAMPLES = 1 << 20


def sample_number(value: Any, most: int = MAX_SAMPLES) -> int:
    """A converter for a number of samples: a whole number from 1 to ``most``."""
    remedy = "Give a whole number"
    if isinstance(value, bool) or not isinstance(value, int | np.integer):
        raise InputError("samples", f"must be a whole number, got {value!r}", remedy)
    if not 1 <= value <= most:
        raise InputError("samples", f"must be between 1 and {most}, got {value}", remedy)
    return int(value)


def vertex_list(name: str) -> Callable[[Any], Any]:
    """A converter for corners of a polygon: three points or more."""

    def convert(value: Any) -> Any:
        array = _array(name, value, "a list of points")
        if array.ndim != 2 or array.shape[0] < 3 or array.shape[1] != 3:
            raise InputError(name, f"must be three points or more, got {_shown(value)}", "Give [[x, y, z], ...]")
        return array

    return convert


def coefficients(**given: Any) -> list[Parameter]:
    """The coefficients of a material at one common number of channels, (C,) each.

    Args:
        given: numbers or sequences, by name.

    Raises:
        InputError: naming the one that is not finite, is negative, or does not go with the others.
    """
    checked = [_not_negative(name, value) for name, value in given.items()]
    for name, value in zip(given, checked, strict=True):
        if value.ndim > 1 or value.size == 0:
            raise InputError(name, f"must be one number or one number per channel, got shape {value.shape}")
    channels = max(value.size for value in checked)
    for name, value in zip(given, checked, strict=True):
        if value.size not in (1, channels):
            sizes = ", ".join(f"{n} {v.size}" for n, v in zip(given, checked, strict=True))
            raise InputError(
                name, f"the coefficients differ in their number of channels ({sizes})", "Give each the same"
            )
    return [(np if isinstance(value, np.ndarray) else jnp).broadcast_to(value, (channels,)).copy() for value in checked]


def exponent(given: Any) -> Parameter:
    """The exponent of a material.

    Args:
        given: one number.

    Raises:
        InputError: where it is not finite, negative or beyond `LARGEST`.
    """
    value = _not_negative("n", given)
    if isinstance(value, np.ndarray) and np.any(value > LARGEST):
        raise InputError("n", f"must be at most {LARGEST:g}, got {np.max(value):g}", "Such a lobe is a mirror")
    if value.size != 1:
        raise InputError("n", f"must be one number, got shape {value.shape}", "All channels share one exponent")
    return value.reshape(())


def _not_negative(name: str, given: Any) -> Any:
    """As float64 numpy if the values are known, after checking them; what JAX is tracing passes through."""
    if isinstance(given, list | tuple) and any(isinstance(v, Tracer) for v in given):
        given = jnp.stack([jnp.asarray(v) for v in given])
    if isinstance(given, Tracer):
        return given
    try:
        value = np.asarray(given, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        raise InputError(name, f"must be numbers, got {given!r:.60}") from None
    for channel, number in enumerate(value.ravel()):
        where = f" in channel {channel}" if value.size > 1 else ""
        if not math.isfinite(number):
            raise InputError(name, f"must be finite, got {number}{where}")
        if number < 0:
            raise InputError(name, f"must be at least 0, got {number:g}{where}")
    return value
