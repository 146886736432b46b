"""Many devices and machines: tiles of pixels are dealt out to the devices of a mesh, and their sums are added up.

Everything that the search needs of the pixels is sums (`fitting.solver.normal_equations`), so nothing but these crosses
from one device or machine to another: some hundred numbers a pass. Every process runs the same search on the same sums
and comes to the same result; the sums are added in the order of the tiles, whichever device is done first.
"""

import contextlib
import os
from collections.abc import Iterator
from contextvars import ContextVar
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh

from brdf.errors import InputError

_MESH: ContextVar[Mesh | None] = ContextVar("mesh", default=None)


@contextlib.contextmanager
def spread_over(mesh: Any) -> Iterator[None]:
    """Deal the tiles of what is fitted inside out to the devices of a mesh.

    Args:
        mesh: a `jax.sharding.Mesh` of any shape; None for the one device that JAX takes by itself.

    Raises:
        InputError: where it is none, and inside, where another process is lost.
    """
    if mesh is not None and not isinstance(mesh, Mesh):
        remedy = 'Write jax.make_mesh((jax.device_count(),), ("pixels",)), or leave it out'
        raise InputError("mesh", f"must be a jax.sharding.Mesh, got {type(mesh).__name__}", remedy)
    token = _MESH.set(mesh)
    try:
        yield
    finally:
        _MESH.reset(token)


def core_count() -> int:
    """How many cores this process may use: a scheduler may have given it some of the machine's."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def device_count() -> int:
    """How many devices there are to deal tiles out to."""
    mesh = _MESH.get()
    return 1 if mesh is None else mesh.size


def own(count: int) -> list[int]:
    """Which of so many tiles this process deals with."""
    mesh = _MESH.get()
    if mesh is None:
        return list(range(count))
    here, devices = jax.process_index(), mesh.devices.ravel()
    return [i for i in range(count) if devices[i % devices.size].process_index == here]


def placed(index: int, tile: Any) -> Any:
    """A tile, a pytree, on its device; as it is where that is another process's, or there is no mesh."""
    mesh = _MESH.get()
    device = None if mesh is None else mesh.devices.ravel()[index % mesh.size]
    return tile if device is None or device.process_index != jax.process_index() else jax.device_put(tile, device)


def gathered(parts: dict[int, np.ndarray], count: int, shape: tuple[int, ...]) -> np.ndarray:
    """What each tile gave, in the order of the tiles, from all processes, (count, ...), of a shape each.

    Given are the parts of those that this process has dealt with, in float64; refused where another process is lost.
    """
    whole = np.zeros((count, *shape))
    for index, part in parts.items():
        whole[index] = part
    mesh = _MESH.get()
    if mesh is None or len({device.process_index for device in mesh.devices.ravel()}) == 1:
        return whole
    from jax.experimental import multihost_utils  # late: one process needs none of it

    try:
        with jax.enable_x64(True):
            # A tile has one owner, and 0 + x is x.
            return np.sum(multihost_utils.process_allgather(whole), axis=0)
    except (RuntimeError, ValueError) as error:
        words = f"has lost a process ({str(error).splitlines()[0][:120]})"
        raise InputError("mesh", words, "Look at what that one said, and start all of them again") from error
