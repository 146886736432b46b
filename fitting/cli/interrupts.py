"""Ctrl-C, and the system's request to end, that are neither lost nor break what is loading.

Python raises `KeyboardInterrupt` wherever it happens to be. Inside a callback of the garbage collector (JAX has one),
of a weak reference or a finaliser it is printed and forgotten, and the command goes on; inside a library that is
loading it can end the process with a fault.
"""

import contextlib
import signal
import sys
import threading
from collections.abc import Iterator
from types import FrameType
from typing import Any

# Callbacks of the collector take microseconds; in seconds.
_AGAIN = 0.005
_held = 0
_pending = False
_number: int = signal.SIGINT


@contextlib.contextmanager
def interruptible() -> Iterator[None]:
    """Within the block Ctrl-C or SIGTERM ends the command, once. Where somebody else handles them, nothing changes."""
    alone = threading.current_thread() is threading.main_thread()
    if not alone or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        yield
        return
    alarm = signal.signal(signal.SIGALRM, _interrupt) if hasattr(signal, "SIGALRM") else None
    signal.signal(signal.SIGINT, _interrupt)
    # Else what waits to be complete would stay where it was written.
    ended = signal.getsignal(signal.SIGTERM)
    if ended is signal.SIG_DFL:
        signal.signal(signal.SIGTERM, _interrupt)
    forgotten = sys.unraisablehook

    def again(unraisable: Any) -> None:
        if isinstance(unraisable.exc_value, KeyboardInterrupt) and alarm is not None:
            signal.setitimer(signal.ITIMER_REAL, _AGAIN)
        else:
            forgotten(unraisable)

    sys.unraisablehook = again
    try:
        yield
    finally:
        sys.unraisablehook = forgotten
        signal.signal(signal.SIGINT, signal.default_int_handler)
        if ended is signal.SIG_DFL:
            signal.signal(signal.SIGTERM, ended)
        if alarm is not None:
            signal.setitimer(signal.ITIMER_REAL, 0)
            signal.signal(signal.SIGALRM, alarm)


@contextlib.contextmanager
def held() -> Iterator[None]:
    """Within the block Ctrl-C waits until its end: around imports of compiled libraries."""
    global _held, _pending
    _held += 1
    try:
        yield
    finally:
        _held -= 1
    if _pending and not _held:
        _pending = False
        raise KeyboardInterrupt


def exit_status() -> int:
    """What shells expect of a command that a signal ended: 130 after Ctrl-C, 143 after SIGTERM."""
    return 128 + _number


def _interrupt(number: int, frame: FrameType | None) -> None:
    global _pending, _number
    if number in (signal.SIGINT, signal.SIGTERM):
        _number = number
    if _held:
        _pending = True
    else:
        raise KeyboardInterrupt
