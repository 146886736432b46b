"""Pages as a headless browser draws them."""

import atexit
import base64
import functools
import json
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from project_paths import BROWSER

needs_browser = pytest.mark.skipif(
    not (shutil.which("node") and shutil.which("chromium") and (BROWSER / "node_modules").exists()),
    reason="needs node, Debian's chromium, and `npm ci` in tests/browser",
)


@functools.cache
def browser() -> subprocess.Popen[str]:
    """Started once for all pages; it ends when this process does, which ends its standard input."""
    started = subprocess.Popen(
        ["node", str(BROWSER / "serve.mjs")], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    atexit.register(started.communicate)
    return started


def asked(program: str, *called: Any) -> Any:
    """What a program of tests/browser answers."""
    if browser().poll() is not None:  # one that ended tells why on standard error
        browser.cache_clear()
    asking, answering = browser().stdin, browser().stdout
    assert asking is not None
    assert answering is not None
    print(json.dumps([program, *called], default=str), file=asking, flush=True)
    line = answering.readline()
    assert line, "the browser has ended"
    answer = json.loads(line)
    assert "error" not in answer, answer["error"]
    return answer


def drawn(pages: list[tuple[str, list[str]]], folder: Path) -> list[dict[str, Any]]:
    """What the browser draws of each page in each state, (H, W, 3) codes."""
    job = []
    for index, (text, states) in enumerate(pages):
        (folder / f"{index}.html").write_text(text)
        job.append({"page": str(folder / f"{index}.html"), "states": states})
    answers = asked("turn_page", job)
    for answer in answers:
        answer["codes"] = [
            np.frombuffer(base64.b64decode(one["pixels"]), np.uint8).reshape(one["height"], one["width"], 4)[..., :3]
            for one in answer["canvases"]
        ]
    return answers
