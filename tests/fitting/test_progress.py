"""What a person who waits is told, in a terminal and in a notebook, and that nothing of it stays."""

import contextlib
import io
import sys
import time
import types

import pytest
from terminals import Terminal, impatient, until

from fitting import progress
from fitting.progress import waiting

CLEARED = "\r\x1b[2K"


def test_what_is_done_is_told_and_nothing_stays(monkeypatch: pytest.MonkeyPatch):
    terminal = Terminal()
    impatient(monkeypatch, terminal)
    with waiting("reading") as say:
        until(lambda: "reading ... 0 s" in terminal.getvalue())
        say("fitting")
        until(lambda: "fitting ..." in terminal.getvalue())
        with waiting("a part of it") as inner:
            inner("another")
            time.sleep(0.05)
    assert terminal.getvalue().endswith(CLEARED)
    assert "part" not in terminal.getvalue()
    assert "another" not in terminal.getvalue()


def test_ctrl_c_leaves_nothing_and_the_next_is_told(monkeypatch: pytest.MonkeyPatch):
    terminal = Terminal()
    impatient(monkeypatch, terminal)
    with contextlib.suppress(KeyboardInterrupt), waiting("fitting"):
        until(lambda: "fitting ..." in terminal.getvalue())
        raise KeyboardInterrupt
    assert terminal.getvalue().endswith(CLEARED)
    with waiting("once more"):
        until(lambda: "once more ..." in terminal.getvalue())


def test_who_waits_a_moment_or_reads_a_file_is_told_nothing(monkeypatch: pytest.MonkeyPatch):
    terminal, file = Terminal(), io.StringIO()
    impatient(monkeypatch, terminal)
    monkeypatch.setattr(progress, "PATIENCE", 60.0)
    with waiting("fitting"):
        time.sleep(0.05)
    assert not terminal.getvalue()
    impatient(monkeypatch, file)
    with waiting("fitting"):
        time.sleep(0.05)
    assert not file.getvalue()
    file.close()
    for gone in (file, None, object()):
        monkeypatch.setattr(sys, "stderr", gone)
        with waiting("fitting"):
            pass


def test_a_notebook_shows_one_line_below_its_cell(monkeypatch: pytest.MonkeyPatch):
    shown: list[str] = []

    class Handle:
        def update(self, bundle: dict[str, str], raw: bool) -> None:
            shown.append(bundle["text/plain"])

    def display(bundle: dict[str, str], raw: bool, display_id: bool) -> Handle:
        shown.append(bundle["text/plain"])
        return Handle()

    ipython = types.SimpleNamespace(
        get_ipython=lambda: types.SimpleNamespace(kernel=object()), display=types.SimpleNamespace(display=display)
    )
    monkeypatch.setitem(sys.modules, "IPython", ipython)  # pyright: ignore[reportArgumentType]
    impatient(monkeypatch, io.StringIO())
    with waiting("fitting"):
        until(lambda: len(shown) > 2)
    assert shown[0] == "fitting ... 0 s"
    assert shown[-1] == ""
