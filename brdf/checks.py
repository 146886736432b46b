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
"""Of any number of a scene: squares and products of a few of them stay within float32's 3e38."""

MAX_SAMPLES = 1 << 20

SHOWN, LARGE = 8, 31
"""What is shown of things: how many of a list, arrays of up to so many numbers."""


_Meta: Any = abc.ABCMeta if TYPE_CHECKING else type(eqx.Module)


class _Named(_Meta):
    """Of classes that say in one line what they take, where what they are given does not go."""

    def __call__(self, *given: Any, **named: Any) -> Any:
        """Construct it."""
        try:
            return super().__call__(*given, **named)
        except TypeError:
            signature = inspect.signature(self)
            try:
                signature.bind(*given, **named)
            except TypeError as error:
                needed = (name for name, one in signature.parameters.items() if one.default is one.empty)
                remedy = f"Write {self.__name__}({', '.join(f'{name}=...' for name in needed)})"
                raise InputError(self.__name__, str(error), remedy) from None
            raise


class Checked(eqx.Module, metaclass=_Named):
    """What a person makes of numbers: it refuses what cannot be one of its parts, and shows them."""

    def __repr__(self) -> str:
        """Its parts, as one would write them; those that are as usual are left out."""
        values = {
            name: getattr(self, name)
            for name, one in inspect.signature(type(self)).parameters.items()
            if not (isinstance(value := getattr(self, name), tuple | int | None) and value == one.default)
        }
        parts = [f"{name}={shown(value)}" for name, value in values.items()]
        inner = [one for value in values.values() for one in (value if isinstance(value, tuple) else (value,))]
        if not any(isinstance(one, Checked) for one in inner):
            return f"{type(self).__name__}({', '.join(parts)})"
        lines = "".join(f"{part},\n" for part in parts)
        return f"{type(self).__name__}(\n{textwrap.indent(lines, '    ')})"


def shown(value: Any) -> str:
    """A value as a person writes it: numbers to six digits, of large arrays the shape, of long lists the beginning."""
    if isinstance(value, tuple):
        more = f", ... {len(value) - SHOWN} more" if len(value) > SHOWN else ""
        return f"[{', '.join(map(shown, value[:SHOWN]))}{more}]"
    if isinstance(value, np.ndarray | jax.Array) and not isinstance(value, Tracer):
        array = np.asarray(value)
        if array.size > LARGE:
            return f"<{' x '.join(map(str, array.shape))} {array.dtype}>"
        return f"{array:.6g}" if array.ndim == 0 else shown(tuple(array))
    return f"{value:.6g}" if isinstance(value, float | np.floating) else repr(value)


def instance(name: str, value: Any, kind: type, remedy: str) -> None:
    """Refuse what is of another kind.

    Args:
        name: of the argument.
        value: what came.
        kind: what it must be an instance of.
        remedy: what to write.

    Raises:
        InputError: naming the argument.
    """
    if not isinstance(value, kind):
        came = f"the class {value.__name__}" if isinstance(value, type) else type(value).__name__
        raise InputError(name, f"must be a {kind.__name__}, got {came}", remedy)


def several(name: str, value: Any) -> tuple[Any, ...]:
    """A list of things."""
    if not isinstance(value, list | tuple):
        raise InputError(name, f"must be a list, got {type(value).__name__}", f"Write {name}=[...]")
    return tuple(value)


def checked(check: Callable[[str, Any], Any], name: str, **field: Any) -> Any:
    """A field whose value passes a check, which names it where it refuses."""
    return eqx.field(converter=partial(check, name), **field)


def _array(name: str, value: Any, shape_words: str, largest: float = LARGEST) -> Any:
    if isinstance(value, jax.Array):
        return value
    array = as_numbers(name, value, shape_words)
    if not np.all(np.isfinite(array)):
        raise InputError(name, f"must be finite, got {what_came(value)}", "Give finite numbers")
    if np.any(np.abs(array) > largest):
        raise InputError(name, f"must be within ± {largest:g}, got {what_came(value)}", "Use another unit")
    return array


def vector(name: str, value: Any, largest: float = LARGEST) -> Any:
    """A position or an edge: three finite numbers up to ``largest``."""
    array = _array(name, value, "three numbers", largest)
    if array.shape != (3,):
        raise InputError(name, f"must be three numbers, got {what_came(value)}", "Give [x, y, z]")
    return array


def direction_value(name: str, value: Any) -> Any:
    """A direction of any length: three finite numbers, not all zero."""
    array = vector(name, value, np.inf)
    if not isinstance(array, np.ndarray):
        return array
    if not np.any(array):
        raise InputError(name, "must not have zero length, got [0, 0, 0]", "Give a direction")
    size = np.max(np.abs(array))
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
    array = _array(name, value, "a number")
    if array.shape != () or isinstance(value, bool):
        raise InputError(name, f"must be one number, got {what_came(value)}", "Give a single number")
    if isinstance(array, np.ndarray):
        limits = [
            (array < low, f"at least {low:g}"),
            (array > high, f"at most {high:g}"),
            (array <= above, f"greater than {above:g}"),
            (array >= below, f"less than {below:g}"),
        ]
        for is_broken, words in limits:
            if is_broken:
                raise InputError(name, f"must be {words}, got {array:g}", "Correct the value")
    return array


def positive(name: str, value: Any) -> Any:
    """One number greater than 0."""
    return number(name, value, above=0.0)


def spectrum(name: str, value: Any) -> Any:
    """One value per channel, at least 0; a single number becomes one channel."""
    array = _array(name, value, "a number per channel")
    if array.ndim == 0:
        array = array.reshape(1)
    if array.ndim != 1 or array.shape[0] == 0:
        raise InputError(name, f"must be a number per channel, got {what_came(value)}", "Give a list of numbers")
    if isinstance(array, np.ndarray) and np.any(array < 0):
        channel = int(np.argmax(array < 0))
        came = f"must be at least 0, got {array[channel]:g} in channel {channel}"
        raise InputError(name, came, "Give values of 0 or more")
    return array


def vertex_list(name: str, value: Any) -> Any:
    """Corners of a polygon: three points or more."""
    array = _array(name, value, "a list of points")
    if array.ndim != 2 or array.shape[0] < 3 or array.shape[1] != 3:
        raise InputError(name, f"must be three points or more, got {what_came(value)}", "Give [[x, y, z], ...]")
    return array


def sample_number(value: Any, most: int = MAX_SAMPLES) -> int:
    """A number of samples: a whole number from 1 to ``most``."""
    if isinstance(value, bool) or not isinstance(value, int | np.integer):
        raise InputError("samples", f"must be a whole number, got {value!r}", "Give a whole number")
    if not 1 <= value <= most:
        raise InputError("samples", f"must be between 1 and {most}, got {value}", "Give a whole number")
    return int(value)


def spans_area(edge_u: Any, edge_v: Any) -> None:
    """Refuse two edges, (3,) each, that are parallel; values under a JAX transformation pass.

    Raises:
        InputError: where they are parallel.
    """
    if not (isinstance(edge_u, np.ndarray) and isinstance(edge_v, np.ndarray)):
        return
    area = float(np.linalg.norm(np.cross(edge_u, edge_v)))
    if area <= 1e-12 * float(np.linalg.norm(edge_u) * np.linalg.norm(edge_v)):
        came = f"got {edge_u.tolist()} and {edge_v.tolist()}"
        raise InputError("edge_v", f"must not be parallel to edge_u, {came}", "Give two edges that span an area")


def coefficients(**given: Any) -> list[Array | np.ndarray]:
    """The coefficients of a material at one common number of channels, (C,) each.

    Args:
        given: numbers or sequences, by name.

    Raises:
        InputError: naming the one that is not finite, is negative, or does not go with the others.
    """
    checked = {name: _not_negative(name, value) for name, value in given.items()}
    for name, value in checked.items():
        if value.ndim > 1 or value.size == 0:
            raise InputError(name, f"must be one number or one number per channel, got shape {value.shape}")
    channels = max(value.size for value in checked.values())
    for name, value in checked.items():
        if value.size not in (1, channels):
            sizes = ", ".join(f"{n} {v.size}" for n, v in checked.items())
            came = f"the coefficients differ in their number of channels ({sizes})"
            raise InputError(name, came, "Give each the same")
    each = checked.values()
    return [(np if isinstance(one, np.ndarray) else jnp).broadcast_to(one, (channels,)).copy() for one in each]


def exponent(given: Any) -> Array | np.ndarray:
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
    value = as_numbers(name, given)
    for channel, number in enumerate(value.ravel()):
        where = f" in channel {channel}" if value.size > 1 else ""
        if not np.isfinite(number):
            raise InputError(name, f"must be finite, got {number}{where}")
        if number < 0:
            raise InputError(name, f"must be at least 0, got {number:g}{where}")
    return value
