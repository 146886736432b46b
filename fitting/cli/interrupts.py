"""Ctrl-C, and the system's request to end, that are neither lost nor break what is loading.

Python raises `KeyboardInterrupt` wherever it happens to be. Inside a callback of the garbage collector (JAX has one),
of a weak reference or a finaliser it is printed and forgotten, and the command goes on; inside a library that is
loading it can end the process with a fault. In both cases the signal is sent again a little later.
"""

import contextlib
import os
import signal
import sys
import threading
from collections.abc import Iterator
from types import FrameType
from typing import Any

# In seconds; callbacks of the collector take microseconds, modules some milliseconds.
LATER = 0.01


@contextlib.contextmanager
def interruptible() -> Iterator[None]:
    """Within the block Ctrl-C or SIGTERM raises `KeyboardInterrupt`, its argument the number of the signal.

    Where somebody else handles them, nothing changes.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    ours = [number for number, own in handlers.items() if own in (signal.default_int_handler, signal.SIG_DFL)]
    hook, ended = sys.unraisablehook, threading.Event()

    def send_later(number: int) -> None:
        threading.Timer(LATER, lambda: ended.is_set() or os.kill(os.getpid(), number)).start()

    def interrupt(number: int, frame: FrameType | None) -> None:
        while frame is not None:
            if frame.f_code.co_filename.startswith("<frozen importlib"):
                return send_later(number)
            frame = frame.f_back
        raise KeyboardInterrupt(number)

    def unraisable(lost: Any) -> None:
        if isinstance(lost.exc_value, KeyboardInterrupt) and lost.exc_value.args:
            send_later(*lost.exc_value.args)
        else:
            hook(lost)

    sys.unraisablehook = unraisable
    for number in ours:
        signal.signal(number, interrupt)
    try:
        yield
    finally:
        ended.set()
        sys.unraisablehook = hook
        for number in ours:
            signal.signal(number, handlers[number])
