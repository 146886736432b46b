"""Sound files to be spoiled, and the command run on what they have become."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import brdf
from benchmarks.fuzz_corpus import CAMERA, LIGHT, SPHERE
from fitting.cli.main import main

ROOT = Path(__file__).parents[1]


SCENE = CAMERA + SPHERE + LIGHT


MATERIAL = {"model": "blinn-phong", "k_a": [0.1], "k_d": [0.5], "k_s": [0.3], "n": 37.5}


def scene(old: str, new: str, base: str = SCENE) -> str:
    """The sound scene, spoiled in one place."""
    assert old in base
    return base.replace(old, new)


def sound_files(folder: Path) -> Path:
    """A scene, a material and a picture of 8 x 8 pixels, to be spoiled one at a time."""
    (folder / "scene.toml").write_text(SCENE)
    (folder / "material.json").write_text(json.dumps(MATERIAL))
    brdf.write_image(folder / "target.exr", np.linspace(0.1, 0.9, 192, dtype=np.float32).reshape(8, 8, 3))
    return folder


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
    code = listen + prefix + "from fitting.cli.main import main; main()"
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
