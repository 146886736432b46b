"""What a run takes: time, the compiler's share of it, and memory."""

import contextlib
import ctypes
import functools
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax.monitoring


class Taken(NamedTuple):
    """What one run took.

    Attributes:
        seconds: without the compiler.
        compiling: seconds of tracing and compiling.
        peak: bytes of resident memory beyond what was resident before; None where the system does not tell.
    """

    seconds: float
    compiling: float
    peak: int | None


_spans: list[tuple[float, float]] = []


@functools.cache
def _listen() -> None:
    """Have JAX tell when it traced, lowered or compiled; such spans lie within each other."""

    def listener(event: str, duration_secs: float, **_: Any) -> None:
        if event.startswith("/jax/core/compile/"):
            now = time.perf_counter()
            _spans.append((now - duration_secs, now))

    jax.monitoring.register_event_duration_secs_listener(listener)


def take(run: Callable[[], Any], *, trimmed: bool = False) -> tuple[Any, Taken]:
    """Run something.

    Args:
        run: what.
        trimmed: whether memory that was freed before is given back first, so that what the run uses again counts.

    Returns:
        What it returned, and what it took.
    """
    _listen()
    _spans.clear()
    if trimmed:
        _trim()
    before = _start_peak()
    start = time.perf_counter()
    outcome = run()
    seconds = time.perf_counter() - start
    compiling, end = 0.0, start
    for first, last in sorted(_spans):
        compiling += max(0.0, last - max(first, end))
        end = max(end, last)
    return outcome, Taken(max(seconds - compiling, 0.0), compiling, _read_peak(before))


def _trim() -> None:
    """Give freed memory back to the system, where the C library can."""
    with contextlib.suppress(AttributeError, OSError):
        ctypes.CDLL(None).malloc_trim(0)


def _start_peak() -> int | None:
    """Bytes now resident, and the kernel's mark of the most set back to it; None where there is no such mark."""
    try:
        Path("/proc/self/clear_refs").write_text("5")
        return _status("VmRSS")
    except OSError:
        return None


def _read_peak(before: int | None) -> int | None:
    """Bytes that were resident at most, beyond those before."""
    return None if before is None else max(_status("VmHWM") - before, 0)


def _status(name: str) -> int:
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(name + ":"):
            return 1024 * int(line.split()[1])
    raise OSError(f"/proc/self/status has no {name}")
