"""Pages as a headless browser draws them."""

import base64
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


def asked(program: str, *arguments: Any) -> Any:
    """What a program of tests/browser answers."""
    command = ["node", str(BROWSER / program), *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def drawn(pages: list[tuple[str, list[str]]], folder: Path) -> list[dict[str, Any]]:
    """What the browser draws of each page in each state, (H, W, 3) codes."""
    job = []
    for index, (text, states) in enumerate(pages):
        (folder / f"{index}.html").write_text(text)
        job.append({"page": str(folder / f"{index}.html"), "states": states})
    (folder / "job.json").write_text(json.dumps(job))
    answers = asked("turn_page.mjs", folder / "job.json")
    for answer in answers:
        answer["codes"] = [
            np.frombuffer(base64.b64decode(one["pixels"]), np.uint8).reshape(one["height"], one["width"], 4)[..., :3]
            for one in answer["canvases"]
        ]
    return answers
