"""What is being done and for how long, where a person waits: a line in a terminal or below a notebook's cell.

It appears when the waiting gets long, and nothing of it stays.
"""

import contextlib
import contextvars
import sys
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

# In seconds: who waits less asks nothing; how often the line is written anew.
PATIENCE, EVERY = 1.0, 0.5
# One line at a time: what a fit calls is part of it.
_line = threading.Lock()


@contextlib.contextmanager
def waiting(what: str) -> Iterator[Callable[[str], None]]:
    """Tell what is being done while the block runs, which can say what is next; nobody is told in a file or a pipe."""
    write = _terminal() or _notebook()
    if write is None or not _line.acquire(blocking=False):
        yield lambda what: None
        return
    doing, done, begun = [what], threading.Event(), time.monotonic()

    def tell() -> None:
        ended = done.wait(PATIENCE)
        if ended:
            return
        while not ended:
            write(f"{doing[-1]} ... {time.monotonic() - begun:.0f} s")
            ended = done.wait(EVERY)
        write("")

    # In the context of the caller, by which a notebook knows below which cell to write.
    teller = threading.Thread(target=contextvars.copy_context().run, args=(tell,), daemon=True)
    teller.start()
    try:
        yield doing.append
    finally:
        done.set()
        teller.join()
        _line.release()


def _terminal() -> Callable[[str], None] | None:
    stream: Any = sys.stderr
    try:
        if not stream.isatty():
            return None
    except (AttributeError, ValueError):  # there is none, or it is closed
        return None

    def write(text: str) -> None:
        with contextlib.suppress(OSError, ValueError):  # the terminal has gone
            stream.write(f"\r\x1b[2K{text}")
            stream.flush()

    return write


def _notebook() -> Callable[[str], None] | None:
    ipython: Any = sys.modules.get("IPython")
    if ipython is None or not hasattr(ipython.get_ipython(), "kernel"):
        return None
    handles = []

    def write(text: str) -> None:
        shown = {"text/html": f"<i>{text}</i>" if text else "", "text/plain": text}
        if handles:
            handles[0].update(shown, raw=True)
        elif text:
            handles.append(ipython.display.display(shown, raw=True, display_id=True))

    return write
