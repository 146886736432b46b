"""Ctrl-C is neither lost nor comes in the middle of what must not be broken off."""

import gc
import importlib
import os
import signal
import sys
import time

import pytest

from fitting.cli.interrupts import interruptible


@pytest.fixture
def listening():
    """Ctrl-C as a program in the foreground has it."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def test_control_c_is_not_lost_in_a_callback_of_the_garbage_collector(listening):
    """What such a callback raises is printed and forgotten; JAX has one."""

    def callback(phase, _):
        if phase == "start":
            os.kill(os.getpid(), signal.SIGINT)
            sum(range(1000))  # the signal is handled here

    gc.callbacks.append(callback)
    try:
        with pytest.raises(KeyboardInterrupt), interruptible():  # noqa: PT012  # the signal comes later
            gc.collect()
            gc.callbacks.remove(callback)
            time.sleep(5)
    finally:
        if callback in gc.callbacks:
            gc.callbacks.remove(callback)


def test_control_c_waits_while_a_library_loads(listening, tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "slow_library.py").write_text(
        "import os, signal, time\nos.kill(os.getpid(), signal.SIGINT)\ntime.sleep(0.1)\nloaded = True\n"
    )
    with pytest.raises(KeyboardInterrupt), interruptible():  # noqa: PT012  # the signal comes later
        importlib.import_module("slow_library")
        time.sleep(5)
    assert sys.modules.pop("slow_library").loaded
    with interruptible():
        pass  # it is not remembered
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
