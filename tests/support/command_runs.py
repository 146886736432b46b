"""The command, run in this process or in one of its own."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from project_paths import ROOT

from fitting.cli.main import main


def run(capsys, *words: object) -> tuple[int, str, str]:
    """Exit status and what was said on either stream."""
    with pytest.raises(SystemExit) as done:
        main([str(word) for word in words])
    captured = capsys.readouterr()
    return int(done.value.code or 0), captured.out, captured.err


def refused(capsys, folder: Path, said: str, *words: object) -> None:
    """One line with these words, exit 2, and the folder as it was."""
    before = sorted(folder.rglob("*"))
    status, out, err = run(capsys, *words)
    assert (status, out) == (2, ""), err
    assert err.startswith("error: ")
    assert err.count("\n") == 1
    assert re.search(said, err), err
    assert sorted(folder.rglob("*")) == before


def command(*words: object, cwd: Path, prefix: str = "", **options) -> subprocess.Popen[str]:
    """The command in a process of its own; the prefix runs before it."""
    # A shell that runs the tests in the background has them ignore Ctrl-C, and what they start.
    listen = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)\n"
    code = listen + prefix + "from fitting.cli import main; main.run()"
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "XDG_CACHE_HOME": str(cwd / ".cache")}
    return subprocess.Popen(
        [sys.executable, "-c", code, *map(str, words)],
        cwd=cwd,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        **options,
    )
