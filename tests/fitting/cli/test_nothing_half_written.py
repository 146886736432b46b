"""A full disk, or Ctrl-C in the middle: the command leaves nothing."""

import signal
import subprocess

import numpy as np
import pytest
from command_runs import command, refused
from sound_files import scene, sound_files

import brdf


@pytest.fixture
def place(tmp_path):
    return sound_files(tmp_path)


def test_a_full_disk_leaves_nothing(place):
    # A limit on the size of files is the full disk that needs no rights: writes fail half way.
    prefix = (
        "import resource, signal; signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (2000, 2000))\n"
        "import jax; jax.config.update('jax_compilation_cache_dir', '/nonexistent')\n"
    )
    (place / "scene.toml").write_text(scene("[8, 8]", "[64, 64]"))
    before = {path for path in place.iterdir() if path.name != ".cache"}
    words = ["render", "material.json", "--scene", "scene.toml", "-o", "out.exr"]
    with command(*words, cwd=place, prefix="import warnings; warnings.simplefilter('ignore')\n" + prefix) as process:
        _, err = process.communicate(timeout=120)
    assert process.returncode == 2, err
    assert err.splitlines()[-1].startswith("error: out.exr: ")
    assert {path for path in place.iterdir() if path.name != ".cache"} == before


@pytest.fixture
def small_disk(tmp_path):
    """A disk of 48 KiB, in memory."""
    (tmp_path / "disk").mkdir()
    words = ["mount", "-t", "tmpfs", "-o", "size=48k", "tmpfs", str(tmp_path / "disk")]
    try:
        done = subprocess.run(words, capture_output=True, text=True, check=False)
    except OSError as error:
        pytest.skip(f"no mount command: {error}")
    if done.returncode:
        pytest.skip(f"a small disk cannot be mounted here: {done.stderr.strip()}")
    yield tmp_path / "disk"
    subprocess.run(["umount", str(tmp_path / "disk")], check=True)


FILLING = {
    "render": ["render", "material.json", "--scene", "scene.toml", "-o", "disk/out.exr"],
    "fit": ["fit", "target.exr", "--scene", "scene.toml", "--out", "disk/out"],
    "report": ["fit", "target.exr", "--scene", "scene.toml", "--report", "disk/out.html"],
    "convert": ["convert", "material.json", "disk/material.gltf"],
}


@pytest.mark.parametrize("name", FILLING)
def test_a_disk_that_fills_up_leaves_nothing(place, capsys, monkeypatch, small_disk, name):
    monkeypatch.chdir(place)
    (place / "scene.toml").write_text(scene("[8, 8]", "[64, 64]"))
    ball = brdf.render(brdf.Lambert(k_d=[0.5] * 3), brdf.Scene.load(place / "scene.toml"))
    noise = np.random.default_rng(3).random((64, 64, 3), np.float32)
    brdf.write_image(place / "target.exr", np.asarray(ball) + noise)
    (small_disk / "other").write_bytes(bytes(1024 * {"convert": 48, "render": 44}.get(name, 32)))
    refused(capsys, small_disk, "disk/(out|mat).*: there is no space left to write it", *FILLING[name])


@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_in_the_middle_leaves_nothing(place, number, status):
    before = {path for path in place.iterdir() if path.name != ".cache"}
    # The fit waits for a signal at the moment when the files of the result are being written.
    prefix = (
        "import time, brdf.images.writing\n"
        "def slowly(*a, **k):\n    print('writing', flush=True)\n    time.sleep(60)\n"
        "brdf.images.writing.write_image = slowly\n"
    )
    with command("fit", "target.exr", "--scene", "scene.toml", "--out", "out", cwd=place, prefix=prefix) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "writing\n"
        process.send_signal(number)
        _, err = process.communicate(timeout=60)
    assert process.returncode == status
    assert err == "error: interrupted.\n"
    assert {path for path in place.iterdir() if path.name != ".cache"} == before
