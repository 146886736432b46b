"""How a command ends that cannot go on: output that cannot be written, memory that does not suffice, wrong files."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from command_runs import refused
from project_paths import ROOT
from sound_files import sound_files

import brdf
from fitting.photographs.archives import read_archive
from fitting.photographs.light_files import read_directions

CHECK = "import sys; from fitting.cli.main import main; main(['check', 'emerald'])"


def checked(**options) -> subprocess.CompletedProcess[str]:
    """``brdf check emerald`` in a process of its own."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT), **options.pop("env", {})}
    words = [sys.executable, "-c", CHECK]
    return subprocess.run(
        words, env=environment, stderr=subprocess.PIPE, text=True, timeout=120, check=False, **options
    )


def test_a_terminal_that_knows_ascii_alone():
    done = checked(env={"PYTHONIOENCODING": "ascii"}, stdout=subprocess.PIPE)
    assert (done.returncode, done.stderr) == (1, "")
    assert "not plausible" in done.stdout


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_output_that_cannot_be_written():
    with open("/dev/full", "w") as full:
        done = checked(stdout=full)
    assert done.returncode == 2
    assert done.stderr.startswith("error: output: cannot be written (No space left on device)")
    assert done.stderr.count("\n") == 1


@pytest.mark.parametrize(
    "error", [MemoryError(), RuntimeError("RESOURCE_EXHAUSTED: Out of memory allocating 1 bytes.")]
)
def test_memory_that_does_not_suffice(tmp_path, capsys, monkeypatch, error):
    def render(*_, **__):
        raise error

    monkeypatch.setattr("brdf.rendering.render", render)
    words = "render", "emerald", "--scene", sound_files(tmp_path) / "scene.toml", "-o", tmp_path / "out.exr"
    refused(capsys, tmp_path, "^error: memory: ", *words)


def test_a_folder_that_cannot_be_written_is_told_before_the_fit(tmp_path, capsys):
    (sound_files(tmp_path) / "file").write_text("")
    words = "fit", tmp_path / "missing.exr", "--scene", tmp_path / "scene.toml", "--out", tmp_path / "file"
    refused(capsys, tmp_path, "file: a part of the path is not a folder", *words)


def test_an_archive_whose_compressed_bytes_are_damaged(tmp_path):
    path = tmp_path / "ball.npz"
    random = np.random.default_rng(0)
    np.savez_compressed(path, images=random.random((2, 9, 9)), normal=np.zeros((9, 9, 3)), light_dirs=np.eye(3)[:2])
    content = path.read_bytes()
    refusals = []
    for place in range(50, 90):
        path.write_bytes(content[:place] + bytes([content[place] ^ 0xFF]) + content[place + 1 :])
        try:
            read_archive(path)  # some bytes say nothing
        except brdf.InputError as error:
            refusals.append(str(error))
    assert len(refusals) > 10
    assert all("ball.npz" in one for one in refusals)
    assert any("no readable archive (error)" in one or "no array" in one for one in refusals)


@pytest.mark.parametrize("word", ["1_0", "١"])  # the second is a digit of another script
def test_numbers_of_lights_are_plain(tmp_path, word):
    (tmp_path / "lights.txt").write_text(f"0 0 {word}\n", encoding="utf-8")
    with pytest.raises(brdf.InputError, match=r"lights\.txt: line 1"):
        read_directions(tmp_path / "lights.txt")


def test_an_exponent_beyond_reach_is_refused():
    with pytest.raises(brdf.InputError, match=r"^n: must be at most 1e\+15, got 1e\+300"):
        brdf.Phong(k_d=0.5, k_s=0.5, n=1e300)
