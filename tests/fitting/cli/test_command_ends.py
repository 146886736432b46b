"""How a command ends that cannot go on: full disks, memory that does not suffice, Ctrl-C; it leaves nothing."""

import gc
import importlib
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from command_runs import command, refused
from project_paths import ROOT
from sound_files import scene, sound_files

import brdf
from fitting.cli.interrupts import interruptible
from fitting.photographs.archives import read_archive
from fitting.photographs.light_files import read_directions

COMMAND = "from fitting.cli.main import run; run()"


def checked(**options) -> subprocess.CompletedProcess[str]:
    """``brdf check emerald`` in a process of its own."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT), **options.pop("env", {})}
    environment.pop("JAX_COMPILATION_CACHE_DIR", None)
    words = [sys.executable, "-c", COMMAND, "check", "emerald"]
    return subprocess.run(
        words, env=environment, stderr=subprocess.PIPE, text=True, timeout=120, check=False, **options
    )


def test_a_terminal_that_knows_ascii_alone_and_a_second_run_that_finds_its_programs_compiled(tmp_path):
    for _ in range(2):
        environment = {"PYTHONIOENCODING": "ascii", "XDG_CACHE_HOME": str(tmp_path)}
        done = checked(env=environment, stdout=subprocess.PIPE)
        assert (done.returncode, done.stderr) == (1, "")
        assert "not plausible" in done.stdout
    assert list((tmp_path / "brdf" / "jax").iterdir())


def test_a_user_without_a_home(tmp_path):
    """As in a container that runs under a number which no name belongs to."""
    prefix = "import os, pwd\nos.environ.pop('HOME', 0), os.environ.pop('XDG_CACHE_HOME', 0)\n"
    prefix += "def nobody(_):\n    raise KeyError\npwd.getpwuid = nobody\n"
    with command("--version", cwd=tmp_path, prefix=prefix) as process:
        assert process.communicate(timeout=60)[1] == ""
    assert process.returncode == 0


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

    monkeypatch.setattr("brdf.render", render)
    words = "render", "emerald", "--scene", sound_files(tmp_path) / "scene.toml", "-o", tmp_path / "out.exr"
    refused(capsys, tmp_path, "^error: memory: ", *words)


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


# -- nothing half-written ----------------------------------------------------------------------------------------------


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


# -- Ctrl-C is neither lost nor comes in the middle of what must not be broken off -------------------------------------


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
