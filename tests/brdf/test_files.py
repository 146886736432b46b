"""Files appear whole or not at all."""

import copy
import errno
import os
import pickle
import signal
import stat
import subprocess
import sys

import pytest
from project_paths import ROOT

from brdf.errors import InputError
from brdf.files import atomic_folder, atomic_path, input_file, write_text


def everything(folder):
    return sorted(str(item.relative_to(folder)) for item in folder.rglob("*"))


def run(code, *arguments):
    command = [sys.executable, "-c", code, *map(str, arguments)]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=60, check=False)


def test_text_is_written_as_it_is(tmp_path):
    write_text(tmp_path / "a.json", "k_d = 0.5 ± 0.1\r\nx\n")
    assert (tmp_path / "a.json").read_bytes() == "k_d = 0.5 ± 0.1\r\nx\n".encode()
    assert everything(tmp_path) == ["a.json"]


def test_the_temporary_name_is_near_with_the_same_suffix(tmp_path):
    with atomic_path(tmp_path / "a.tar.exr") as temporary:
        assert temporary.parent.parent == tmp_path
        assert temporary.suffix == ".exr"
        temporary.write_bytes(b"x")
        assert not (tmp_path / "a.tar.exr").exists()
    assert everything(tmp_path) == ["a.tar.exr"]


@pytest.mark.parametrize("raised", [RuntimeError, KeyboardInterrupt, SystemExit])
def test_a_failed_file_leaves_the_old_one(tmp_path, raised):
    (tmp_path / "a.txt").write_text("old")

    def fail():
        with atomic_path(tmp_path / "a.txt") as temporary:
            temporary.write_text("half of the n")
            raise raised

    with pytest.raises(raised):
        fail()
    assert everything(tmp_path) == ["a.txt"]
    assert (tmp_path / "a.txt").read_text() == "old"


def test_permissions_and_links_survive(tmp_path):
    (tmp_path / "real.txt").write_text("old")
    (tmp_path / "real.txt").chmod(0o640)
    (tmp_path / "link.txt").symlink_to("real.txt")
    write_text(tmp_path / "link.txt", "new")
    assert (tmp_path / "link.txt").is_symlink()
    assert (tmp_path / "real.txt").read_text() == "new"
    assert stat.S_IMODE((tmp_path / "real.txt").stat().st_mode) == 0o640


def test_a_new_file_follows_the_umask(tmp_path):
    before = os.umask(0o027)
    try:
        write_text(tmp_path / "a.txt", "x")
    finally:
        os.umask(before)
    assert stat.S_IMODE((tmp_path / "a.txt").stat().st_mode) == 0o640


@pytest.mark.parametrize(
    ("place", "said"),
    [
        ("missing/a.txt", "cannot be written, there is no folder .*missing. Make it first"),
        ("file/a.txt", "not a folder"),
        ("folder", "is a folder"),
        ("pipe", "not an ordinary file"),
        ("x" * 300, "too long"),
        ("loop", "circle"),
    ],
)
def test_a_place_that_cannot_be_written(tmp_path, place, said):
    (tmp_path / "file").write_text("x")
    (tmp_path / "folder").mkdir()
    (tmp_path / "loop").symlink_to("loop")
    os.mkfifo(tmp_path / "pipe")
    before = everything(tmp_path)
    with pytest.raises(InputError, match=said):
        write_text(tmp_path / place / "a" if place == "loop" else tmp_path / place, "x")
    assert everything(tmp_path) == before


def test_a_device_is_not_replaced():
    with pytest.raises(InputError, match="not an ordinary file"):
        write_text("/dev/null", "x")
    assert stat.S_ISCHR(os.stat("/dev/null").st_mode)


@pytest.mark.skipif(os.geteuid() == 0, reason="the superuser may write everywhere")
def test_a_folder_without_permission(tmp_path):
    tmp_path.chmod(0o500)
    with pytest.raises(InputError, match="permission denied"):
        write_text(tmp_path / "a.txt", "x")


@pytest.mark.parametrize("path", ["", "a\0b", b"a", 3, None])
def test_what_is_no_path(path):
    with pytest.raises(InputError):
        write_text(path, "x")
    with pytest.raises(InputError):
        input_file(path)


def test_a_full_disk(tmp_path):
    code = """
import resource, signal, sys
from brdf.errors import InputError
from brdf.files import atomic_folder, write_text
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))
try:
    write_text(sys.argv[1] + "/a.txt", "x" * 100_000)
except InputError as error:
    print(error)
try:
    with atomic_folder(sys.argv[1] + "/new/out") as folder:
        (folder / "a").write_text("x")
        (folder / "b").write_text("x" * 100_000)
except InputError as error:
    print(error)
"""
    result = run(code, tmp_path)
    assert result.stdout.count("larger than allowed") == 2, result.stderr
    assert everything(tmp_path) == []
    with pytest.raises(InputError, match="no space"), atomic_path(tmp_path / "a"):
        raise OSError(errno.ENOSPC, "x")


@pytest.mark.parametrize("folder", ["out", "new/out"])
def test_a_set_of_files_appears_together(tmp_path, folder):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "mine.txt").write_text("mine")
    (tmp_path / "out" / "a.txt").write_text("old")
    with atomic_folder(tmp_path / folder) as stage:
        (stage / "a.txt").write_text("A")
        (stage / "b.txt").write_text("B")
        assert not (tmp_path / folder / "b.txt").exists()
    assert (tmp_path / folder / "a.txt").read_text() == "A"
    assert (tmp_path / folder / "b.txt").read_text() == "B"
    assert (tmp_path / "out" / "mine.txt").read_text() == "mine"
    assert len(everything(tmp_path)) == (4 if folder == "out" else 7)


def test_what_goes_wrong_in_a_set_is_named_by_its_place(tmp_path):
    def fail(place):
        with atomic_folder(tmp_path / "out") as stage:
            write_text(stage / place, "A")

    with pytest.raises(InputError) as told:
        fail("missing/a.txt")
    assert told.value.where == str(tmp_path / "out" / "missing" / "a.txt")
    assert everything(tmp_path) == []


@pytest.mark.parametrize("raised", [RuntimeError, KeyboardInterrupt])
@pytest.mark.parametrize("folder", ["out", "new/deep/out"])
def test_a_failed_set_leaves_nothing(tmp_path, folder, raised):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "a.txt").write_text("old")

    def fail():
        with atomic_folder(tmp_path / folder) as stage:
            (stage / "a.txt").write_text("A")
            raise raised

    with pytest.raises(raised):
        fail()
    assert everything(tmp_path) == ["out", "out/a.txt"]
    assert (tmp_path / "out" / "a.txt").read_text() == "old"


def test_a_set_that_fails_half_way_into_place_is_taken_back(tmp_path):
    (tmp_path / "a.txt").write_text("old")
    (tmp_path / "c.txt").mkdir()

    def fail():
        with atomic_folder(tmp_path) as stage:
            for name in ("a.txt", "b.txt", "c.txt"):
                (stage / name).write_text("new")

    with pytest.raises(InputError, match=r"c\.txt: is a folder"):
        fail()
    assert everything(tmp_path) == ["a.txt", "c.txt"]
    assert (tmp_path / "a.txt").read_text() == "old"


def test_what_is_outdated_goes_with_a_set_that_comes(tmp_path):
    def save(*names):
        with atomic_folder(tmp_path, ["old.txt", "a.txt", "folder", "never.txt"]) as stage:
            for name in names:
                (stage / name).write_text("new")

    (tmp_path / "folder").mkdir()
    for name in ("old.txt", "mine.txt"):
        (tmp_path / name).write_text("old")
    with pytest.raises(InputError, match="folder: is a folder"):
        save("a.txt", "folder")
    assert everything(tmp_path) == ["folder", "mine.txt", "old.txt"]
    save("a.txt")
    assert everything(tmp_path) == ["a.txt", "folder", "mine.txt"]
    assert (tmp_path / "a.txt").read_text() == "new"


def test_a_folder_that_cannot_be_made(tmp_path):
    (tmp_path / "file").write_text("x")
    for place in ("file", "file/out"):
        with pytest.raises(InputError, match="not a folder"), atomic_folder(tmp_path / place):
            pass
    assert everything(tmp_path) == ["file"]


def test_interrupt_from_outside_leaves_nothing(tmp_path):
    code = """
import signal, sys, time
from brdf.files import atomic_folder
signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell in the background has it ignored
with atomic_folder(sys.argv[1] + "/out") as folder:
    (folder / "a").write_text("x")
    print("ready", flush=True)
    time.sleep(60)
"""
    command = [sys.executable, "-c", code, str(tmp_path)]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == b"ready\n"
        process.send_signal(signal.SIGINT)
        process.wait(timeout=60)
    assert process.returncode != 0
    assert everything(tmp_path) == []


WRITES_FOR_EVER = """
import sys, time
from pathlib import Path
from brdf.files import atomic_folder, atomic_path
folder = Path(sys.argv[1])
with atomic_folder(folder) as stage, atomic_path(folder / "a.txt"):
    (stage / "b.txt").write_text("half")
    print("ready", flush=True)
    time.sleep(60)
"""


def test_what_a_killed_writer_left_the_next_one_removes_and_never_a_live_one(tmp_path):
    def writer():
        command = [sys.executable, "-c", WRITES_FOR_EVER, str(tmp_path)]
        process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True)
        assert process.stdout.readline() == "ready\n"
        return process

    killed = writer()
    killed.kill()
    killed.communicate()
    left = {path.name for path in tmp_path.iterdir()}
    assert len(left) == 2
    (tmp_path / ".brdf-notes").write_text("mine")
    live = writer()
    try:
        staged = {path.name for path in tmp_path.iterdir()} - {".brdf-notes"}
        assert len(staged) == 2
        assert not staged & left
        write_text(tmp_path / "c.txt", "x")
        assert {path.name for path in tmp_path.iterdir()} == staged | {".brdf-notes", "c.txt"}
    finally:
        live.kill()
        live.communicate()
    # Once for each folder and process: here the first run has been.
    run("import sys; from brdf.files import write_text; write_text(sys.argv[1], 'y')", tmp_path / "d.txt")
    assert everything(tmp_path) == [".brdf-notes", "c.txt", "d.txt"]


def test_input_files(tmp_path):
    (tmp_path / "a").write_text("x")
    assert input_file(tmp_path / "a") == tmp_path / "a"
    (tmp_path / "empty").touch()
    os.mkfifo(tmp_path / "pipe")
    for name, said in [("b", "no such"), (".", "folder"), ("empty", "empty"), ("pipe", "ordinary"), ("a/b", "folder")]:
        with pytest.raises(InputError, match=said):
            input_file(tmp_path / name)
    with pytest.raises(InputError, match="not an ordinary file"):
        input_file("/dev/zero")


def test_an_error_comes_out_of_another_process_as_it_was(tmp_path):
    """It broke the whole pool."""
    for where in ("k_d", tmp_path / "a.png"):
        error = InputError(where, "is empty", "Give a file with content")
        for same in (pickle.loads(pickle.dumps(error)), copy.deepcopy(error)):
            assert (str(same), same.of_file) == (str(error), error.of_file)
