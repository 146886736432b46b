"""Input validation: what the fields of scenes and materials take; the name, bound first, is for the message.

Each turns what the user gave into a float64 array and refuses what cannot be one. Values that JAX already
holds (arrays and tracers of a transformation) keep their type; only their shape is checked.
"""

import abc
import inspect
import textwrap
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from brdf.errors import InputError, as_numbers, what_came

# Any: a constructor takes numbers, lists and arrays, of which the checks make arrays.
Parameter = Any
Scalar = Float[Any, ""]
Vector = Float[Any, "3"]
Spectrum = Float[Any, " C"]

LARGEST = 1e15
"""Of any number of a scene, and of an exponent: squares and products of a few of them stay within float32's 3e38."""

MAX_SAMPLES = 1 << 20

SHOWN, LARGE = 8, 31
"""What is shown of things: how many of a list, arrays of up to so many numbers."""


_Meta: Any = abc.ABCMeta if TYPE_CHECKING else type(eqx.Module)


class _Named(_Meta):
    """Of classes that say in one line what they take, where what they are given does not go."""

    def __call__(self, *given: Any, **named: Any) -> Any:
        """Construct it."""
        signature = inspect.signature(self)
        try:
            signature.bind(*given, **named)
        except TypeError as error:
            needed = [f"{name}=..." for name, one in signature.parameters.items() if one.default is one.empty]
            raise InputError(self.__name__, str(error), f"Write {self.__name__}({', '.join(needed)})") from None
        return super().__call__(*given, **named)


class Checked(eqx.Module, metaclass=_Named):
    """What a person makes of numbers: it refuses what cannot be one of its parts, and shows them."""

    def __repr__(self) -> str:
        """Its parts, as one would write them; those that are as usual are left out."""
        parts = [
            f"{name}={shown(value)}"
            for name, one in inspect.signature(type(self)).parameters.items()
            if not (isinstance(value := getattr(self, name), tuple | int | None) and value == one.default)
        ]
        if "(" in "".join(parts):  # other such things stand on lines of their own
            lines = textwrap.indent(",\n".join([*parts, ""]), "    ")
            return f"{type(self).__name__}(\n{lines})"
        return f"{type(self).__name__}({', '.join(parts)})"


def shown(value: Any) -> str:
    """A value as a person writes it: numbers to six digits, of large arrays the shape, of long lists the beginning."""
    if isinstance(value, np.ndarray | jax.Array) and not isinstance(value, Tracer):
        if value.size > LARGE:
            return f"<{' x '.join(map(str, value.shape))} {value.dtype}>"
        value = tuple(value) if value.ndim else float(value)
    if isinstance(value, tuple):
        more = f", ... {len(value) - SHOWN} more" if len(value) > SHOWN else ""
        return f"[{', '.join(map(shown, value[:SHOWN]))}{more}]"
    return f"{value:.6g}" if isinstance(value, float | np.floating) else repr(value)


def instance(name: str, value: Any, kind: type, remedy: str) -> None:
    """Refuse what is of another kind; the remedy says what to write."""
    if not isinstance(value, kind):
        what = f"the class {value.__name__}" if isinstance(value, type) else type(value).__name__
        raise InputError(name, f"must be a {kind.__name__}, got {what}", remedy)


def several(name: str, value: Any) -> tuple[Any, ...]:
    """A list of things."""
    if not isinstance(value, list | tuple):
        raise InputError(name, f"must be a list, got {type(value).__name__}", f"Write {name}=[...]")
    return tuple(value)


def checked(check: Callable[[str, Any], Any], name: str, **field: Any) -> Any:
    """A field whose value passes a check, which names it where it refuses."""
    return eqx.field(converter=partial(check, name), **field)


def _numbers(name, value, words, largest=LARGEST):
    """Finite numbers of any shape."""
    if isinstance(value, jax.Array):
        return value
    array = as_numbers(name, value, words)
    _refuse(name, array, {"finite": np.isfinite(array), f"within ± {largest:g}": ~(np.abs(array) > largest)})
    return array


def _refuse(name, array, limits, place=""):
    """Refuse known numbers of which one is not good, by the words for that."""
    for words, good in limits.items():
        if isinstance(array, np.ndarray) and not np.all(good):
            first = int(np.argmin(good))
            where = place.format(first) if array.size > 1 else ""
            raise InputError(name, f"must be {words}, got {array.flat[first]:g}{where}", "Correct the value")


def _shaped(name, value, fits, words, remedy, largest=LARGEST):
    """Finite numbers of a shape that fits."""
    array = _numbers(name, value, words, largest)
    if not fits(*array.shape):
        raise InputError(name, f"must be {words}, got {what_came(value)}", remedy)
    return array


def vector(name: str, value: Any, largest: float = LARGEST) -> Any:
    """A position or an edge: three finite numbers up to ``largest``."""
    return _shaped(name, value, lambda *shape: shape == (3,), "three numbers", "Give [x, y, z]", largest)


def direction_value(name: str, value: Any) -> Any:
    """A direction of any length: three finite numbers, not all zero."""
    array = vector(name, value, np.inf)
    if not isinstance(array, np.ndarray):
        return array
    size = np.max(np.abs(array))
    if size == 0:
        raise InputError(name, "must not have zero length, got [0, 0, 0]", "Give a direction")
    # Its squares must not leave float32; else it stays as it was given.
    return array if 1e-6 <= size <= 1e6 else array / size


def edge_value(name: str, value: Any) -> Any:
    """An edge: three numbers, in a unit in which areas, their squares, and those times a distance stay in float32."""
    array = vector(name, value)
    if isinstance(array, np.ndarray) and not 1e-8 <= np.max(np.abs(array)) <= 1e8:
        raise InputError(name, f"must be between 1e-08 and 1e+08 long, got {what_came(value)}", "Use another unit")
    return array


def number(
    name: str, value: Any, low: float = -np.inf, high: float = np.inf, above: float = -np.inf, below: float = np.inf
) -> Any:
    """One number with ``low`` <= x <= ``high`` and ``above`` < x < ``below``."""
    array = _numbers(name, value, "a number")
    if array.shape != () or isinstance(value, bool):
        raise InputError(name, f"must be one number, got {what_came(value)}", "Give a single number")
    limits = {f"at least {low:g}": array >= low, f"at most {high:g}": array <= high}
    _refuse(name, array, limits | {f"greater than {above:g}": array > above, f"less than {below:g}": array < below})
    return array


def positive(name: str, value: Any) -> Any:
    """One number greater than 0."""
    return number(name, value, above=0.0)


def spectrum(name: str, value: Any, largest: float = LARGEST) -> Any:
    """One value per channel, from 0 to ``largest``; a single number becomes one channel."""
    words, remedy = "a number per channel", "Give a list of numbers"
    array = _shaped(name, value, lambda count=1, *more: count > 0 and not more, words, remedy, largest)
    _refuse(name, array, {"at least 0": array >= 0}, " in channel {}")
    return array.reshape(-1)


def vertex_list(name: str, value: Any) -> Any:
    """Corners of a polygon: three points or more."""
    words, remedy = "three points or more", "Give [[x, y, z], ...]"
    return _shaped(name, value, lambda count=0, *axes: count >= 3 and axes == (3,), words, remedy)


def sample_number(value: Any, most: int = MAX_SAMPLES) -> int:
    """A number of samples: a whole number from 1 to ``most``."""
    if isinstance(value, bool) or not isinstance(value, int | np.integer):
        raise InputError("samples", f"must be a whole number, got {repr(value)[:60]}", "Give a whole number")
    if not 1 <= value <= most:
        raise InputError("samples", f"must be between 1 and {most}, got {repr(value)[:60]}", "Give a whole number")
    return int(value)


def coefficients(**given: Any) -> list[Array | np.ndarray]:
    """The coefficients of a material at one common number of channels, (C,) each: finite and at least 0."""
    arrays: dict[str, Array | np.ndarray] = {}
    for name, value in given.items():
        arrays[name] = spectrum(name, known(name, value), np.inf)
    channels = max(array.size for array in arrays.values())
    for name, array in arrays.items():
        if array.size not in (1, channels):
            sizes = ", ".join(f"{n} {v.size}" for n, v in arrays.items())
            what = f"the coefficients differ in their number of channels ({sizes})"
            raise InputError(name, what, "Give each the same")
    return [array.repeat(channels // array.size) for array in arrays.values()]


def exponent(given: Any) -> Array | np.ndarray:
    """The exponent of a material: one number from 0 to `LARGEST`."""
    value = known("n", given)
    if value.size != 1:
        raise InputError("n", f"must be one number, got shape {value.shape}", "All channels share one exponent")
    return number("n", value.reshape(()), low=0.0)


def known(name: str, given: Any) -> Any:
    """In float64 of NumPy, but for what JAX is tracing."""
    if isinstance(given, list | tuple) and any(isinstance(value, Tracer) for value in given):
        given = jnp.stack([jnp.asarray(value) for value in given])
    return given if isinstance(given, Tracer) else as_numbers(name, given)
