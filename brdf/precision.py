"""How JAX computes: float32 or float64, chosen per call without touching its global setting, and in which pieces."""

import contextlib
import dataclasses
import importlib.metadata
import typing
import warnings
from collections.abc import Callable
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from brdf.errors import InputError

Precision = Literal["float32", "float64"]
Kind = typing.TypeVar("Kind")

UNSOUND = {
    "0.10.2": "adds up wrongly on the CPU (jax-ml/jax issue 39103)",
    "0.11.0": "crashes on the CPU (jax-ml/jax issue 40412)",
}
"""Versions of jaxlib that are not to be computed with, and why; pyproject.toml excludes them too."""


WIDE = 80
"""An accelerator takes so many times the values that a processor takes at a time."""


def warn_of_unsound(version: str) -> None:
    """Warn where a version of jaxlib is known to compute wrongly."""
    if version in UNSOUND:
        message = f"jaxlib {version} {UNSOUND[version]}: install another version, such as 0.10.1"
        warnings.warn(message, RuntimeWarning, stacklevel=2)


warn_of_unsound(importlib.metadata.version("jaxlib"))


def working_precision(precision: Precision | None) -> contextlib.AbstractContextManager[Any]:
    """A context in which JAX computes in "float32" or "float64"; None leaves JAX as it is, all else is refused."""
    if precision not in (None, "float32", "float64"):
        raise InputError("precision", f"is unknown, got {precision!r}", "Use float32 or float64")
    if precision is None:
        return contextlib.nullcontext()
    return jax.enable_x64(precision == "float64")


def cast(tree: Any, precision: Precision | None) -> Any:
    """A pytree whose floating-point leaves are JAX arrays of the given precision.

    Args:
        tree: any pytree; tracers keep their type where ``precision`` is None.
        precision: "float32", "float64", or None for JAX's own default.

    Raises:
        InputError: where the precision is unknown.

    Example:
        >>> brdf.cast(brdf.preset("gold"), "float32").n.dtype
        dtype('float32')
    """

    def leaf(value: Any) -> Any:
        # Through NumPy, or each kind of number would be compiled.
        array = value if isinstance(value, jax.Array) else np.asarray(value)
        kept = not jnp.issubdtype(array.dtype, np.floating) or (precision is None and array is value)
        return array if kept else array.astype(precision or jnp.result_type(float))

    with working_precision(precision):  # float64 stays what it is outside of it
        return jax.device_put(jax.tree.map(leaf, tree))


def on_accelerator() -> bool:
    """Whether JAX computes on a GPU or TPU."""
    return jax.default_backend() != "cpu"


def at_a_time(count: int) -> int:
    """How many values a program takes at a time: what a processor's cache holds, or `WIDE` times as many."""
    return WIDE * count if on_accelerator() else count


@typing.dataclass_transform(frozen_default=True, field_specifiers=(dataclasses.field,))
def pytree(cls: type[Kind]) -> type[Kind]:
    """A frozen dataclass that JAX takes apart itself: what programs pass from hand to hand."""
    return jax.tree_util.register_dataclass(dataclasses.dataclass(frozen=True, eq=False)(cls))


def apart(function: Callable[..., Any], *arguments: Any) -> Any:
    """``function(*arguments)``, as a computation of its own inside whatever program it becomes part of.

    XLA merges geometry into every loop that reads it and repeats it there; inside a user's own `jax.jit` a rendering
    took 10 times as long, its gradient 6 times. The branch of a conditional is not merged, and this condition always
    holds without the compiler knowing. It asks an argument's floating-point leaf, of which there must be one.
    """
    leaf = next(leaf for leaf in jax.tree.leaves(arguments) if jnp.issubdtype(jnp.result_type(leaf), jnp.floating))
    holds = ~(jnp.ravel(leaf)[0] < -jnp.inf)
    shapes = jax.eval_shape(function, *arguments)
    return jax.lax.cond(holds, function, lambda *_: jax.tree.map(jnp.zeros_like, shapes), *arguments)
