"""Ctrl-C is neither lost nor comes in the middle of what must not be broken off."""

import gc
import os
import signal
import time

import pytest

from fitting.cli.interrupts import held, interruptible


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


def test_control_c_waits_while_a_library_loads(listening):
    seen = []
    with pytest.raises(KeyboardInterrupt), interruptible(), held():  # noqa: PT012  # the signal comes later
        os.kill(os.getpid(), signal.SIGINT)
        seen.append("loaded")
    assert seen == ["loaded"]
    with interruptible(), held():
        pass  # it is not remembered
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
