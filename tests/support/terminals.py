"""What a person who waits is told: a terminal that keeps it, in which nobody is patient."""

import io
import sys
import time
from collections.abc import Callable

import pytest

from fitting import progress


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def impatient(monkeypatch: pytest.MonkeyPatch, stream: io.StringIO) -> None:
    """Within the test: between a fixture and the test pytest sets the streams anew."""
    monkeypatch.setattr(sys, "stderr", stream)
    monkeypatch.setattr(progress, "PATIENCE", 0.0)
    monkeypatch.setattr(progress, "EVERY", 0.01)


def until(true: Callable[[], bool]) -> None:
    """Wait for what another thread does, on a slow machine too."""
    for _ in range(1000):
        if true():
            return
        time.sleep(0.01)
    raise AssertionError("was not told")
