"""Files in and out: what may be read, and results that appear whole or not at all.

A result is written into a hidden folder beside its place and moved when it is complete, so that an error, a full disk
or Ctrl-C leaves whatever was there before, and nothing else. Renaming guards against a dying program, not against a
power cut: nothing is forced to the disk. What a program leaves that is killed on the spot, the next that writes into
the same folder removes: who writes there shares a lock on it, which the system lets go of when the writer ends.
"""

import errno
import os
import shutil
import stat
import tempfile
import tomllib
from collections.abc import Collection, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

from brdf.errors import InputError

try:
    import fcntl
except ImportError:  # on Windows, where nothing is removed
    fcntl = None

_STAGED = ".brdf-staged-"
# Where the system's own words would not do.
_REMEDIES = {
    errno.ENOSPC: ("there is no space left to write it", "Free some space or write elsewhere"),
    errno.EFBIG: ("the file would be larger than allowed here", "Write elsewhere or raise the limit"),
    errno.ENOENT: ("there is no such file or folder", "Check the path"),
    errno.ENOTDIR: ("a part of the path is not a folder", "Check the path"),
    errno.EEXIST: ("a part of the path is not a folder", "Check the path"),
    errno.EISDIR: ("is a folder, not a file", "Give the path of a file"),
    errno.ELOOP: ("the links lead in a circle", "Check the path"),
}
_REMEDY = "Check the path, its permissions and the space left there"
MAX_TEXT_BYTES = 1 << 24
AnyPath = str | os.PathLike[str]


@contextmanager
def _told(path: AnyPath) -> Iterator[None]:
    """What the operating system refuses, as the one line that names what the user gave."""
    try:
        yield
    except OSError as error:
        words = (error.strerror or type(error).__name__).lower()
        what, remedy = _REMEDIES.get(error.errno or 0, (words, _REMEDY))
        raise InputError(path, what, remedy) from None


def as_path(path: Any) -> Path:
    """The path that a person gives as text or a `Path`; anything else is refused."""
    if not isinstance(path, str | os.PathLike) or not isinstance(os.fspath(path), str):
        raise InputError("path", f"must be text, got {type(path).__name__}", "Give the path of a file")
    text = os.fspath(path)
    with suppress(UnicodeEncodeError):
        if text and b"\0" not in os.fsencode(text):
            return Path(path)
    raise InputError(repr(text), "is not a path", "Give the path of a file")


def utf8_name(path: AnyPath) -> str:
    """A path as text, for libraries that know names in UTF-8 alone; refused where the name is other bytes."""
    try:
        os.fspath(path).encode()
    except UnicodeEncodeError:
        raise InputError(path, "has a name or folder that is not UTF-8", "Rename it") from None
    return os.fspath(path)


def input_file(path: AnyPath) -> Path:
    """The path of a file, refused where it is missing, unreadable, empty, or a folder, a device or a pipe."""
    file = as_path(path)
    with _told(path):
        if _ordinary(path, file).st_size == 0:
            raise InputError(path, "is empty", "Give a file with content")
        file.open("rb").close()
    return file


def _ordinary(path, file):
    """The status of what has to be an ordinary file: a pipe without a writer would block an open for ever."""
    status = file.stat()
    if not stat.S_ISREG(status.st_mode):
        what = "is a folder, not a file" if stat.S_ISDIR(status.st_mode) else "is not an ordinary file"
        raise InputError(path, what, "Give the path of a file")
    return status


@contextmanager
def atomic_path(path: AnyPath) -> Iterator[Path]:
    """A temporary name near ``path``, with the same suffix, that becomes ``path`` when the block ends well.

    An empty file of that name exists. On any exception, Ctrl-C among them, it is deleted and ``path`` stays as it was.
    An existing file is replaced and keeps its permissions; a link keeps pointing at the file that is replaced. Refused
    is what is no ordinary file, and a folder that is missing, full or not writable.
    """
    target = Path(os.path.realpath(as_path(path)))
    with _told(path):
        if target.exists():
            _ordinary(path, target)
        if not os.path.lexists(target.parent):
            what = f"cannot be written, there is no folder {as_path(path).parent}"
            raise InputError(path, what, "Make it first")
        with _staging(target.parent) as stage:
            temporary = stage / f"new{target.suffix}"
            temporary.touch()
            yield temporary
            if target.exists():
                shutil.copymode(target, temporary)
            temporary.replace(target)


@contextmanager
def _staging(folder: Path) -> Iterator[Path]:
    """A hidden folder in another one, gone at the end; what writers that are no more have staged there goes first."""
    with ExitStack() as lock:
        with suppress(OSError):  # nobody may look, or the file system knows no locks
            if fcntl is not None:
                descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
                lock.callback(os.close, descriptor)
                with suppress(OSError):  # others write there
                    fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    for abandoned in folder.glob(f"{_STAGED}*"):
                        shutil.rmtree(abandoned)
                fcntl.flock(descriptor, fcntl.LOCK_SH)
        with tempfile.TemporaryDirectory(prefix=_STAGED, dir=folder, ignore_cleanup_errors=True) as stage:
            yield Path(stage)


def write_text(path: AnyPath, text: str) -> None:
    """Write a text file, whole or not at all, as UTF-8 with newlines as they are."""
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8", newline="")


@contextmanager
def atomic_folder(path: AnyPath, outdated: Collection[str] = ()) -> Iterator[Path]:
    """A folder to write a set of files into, which appear together in ``path`` when the block ends well.

    It is empty, on the same file system, and takes files, not folders; ``path`` is made, with its parents, where
    missing. On any exception nothing has changed: no file of the set appears, files that were there keep their content,
    and folders made on the way are gone. Of other files in an existing folder those named ``outdated`` go, as a set
    before this one left them; the rest is left alone. Refused is a folder that cannot be made or written, or in which a
    folder stands where a file of the set belongs.
    """
    folder = Path(os.path.realpath(as_path(path)))
    missing = [parent for parent in (folder, *folder.parents) if not os.path.exists(parent)]
    new = folder
    try:
        with _told(path):
            folder.mkdir(parents=True, exist_ok=True)
            with _staging(folder) as stage:
                new, old = stage / "new", stage / "old"
                new.mkdir()
                old.mkdir()
                yield new
                _move_together(new, old, folder, outdated)
    except InputError as error:
        # Named as it would have been in its place: where it was written is gone by now.
        staged = Path(error.where)
        if not staged.is_relative_to(new):
            raise
        raise InputError(Path(path) / staged.relative_to(new), error.what, error.remedy) from None
    finally:
        for parent in missing:
            with suppress(OSError):
                parent.rmdir()  # refused where there is something in it


def _move_together(new: Path, old: Path, folder: Path, outdated: Collection[str]) -> None:
    """Move the new files into place and what is outdated away; if one fails, put back the old ones."""
    with ExitStack() as undo:
        for place in (folder / name for name in outdated):
            if place.is_file() and not (new / place.name).exists():
                undo.callback((old / place.name).replace, place)
                place.rename(old / place.name)
        for file in list(new.iterdir()):
            place = folder / file.name
            if place.is_dir():
                raise InputError(place, "is a folder, not a file", "Move it away or choose another folder")
            if place.exists():
                undo.callback((old / file.name).replace, place)
                place.rename(old / file.name)
            else:
                undo.callback(place.unlink, missing_ok=True)
            file.rename(place)
        undo.pop_all()


def read_text(path: AnyPath, most: int = MAX_TEXT_BYTES) -> str:
    """The text of a file of up to so many bytes, UTF-8 with or without a byte-order mark; refused where it is none."""
    with input_file(path).open("rb") as file:
        content = file.read(most + 1)
    remedy = "Give a text file, saved as UTF-8"
    if len(content) > most:
        raise InputError(path, f"is larger than {most >> 20} MiB", "Check what it is, or make it smaller")
    try:
        text = content.decode("utf-8-sig")  # some editors write a byte-order mark
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        raise InputError(path, f"is not UTF-8 text (line {line}: {error.reason})", remedy) from None
    if "\0" in text:
        raise InputError(path, "is not UTF-8 text (it holds null bytes)", remedy)
    return text


def continued_lines(text: str) -> Iterator[tuple[int, str]]:
    """Lines with those that a backslash at their end goes on with, and the number of the first; no remark goes on."""
    start, begun = 0, ""
    for number, line in enumerate([*text.splitlines(), ""], start=1):  # which ends a line that would go on
        start = start if begun else number
        line = begun + line.strip()
        begun = line[:-1] + " " if line.endswith("\\") and "#" not in line else ""
        if not begun:
            yield start, line


def read_toml(path: AnyPath, most: int = MAX_TEXT_BYTES) -> dict[str, Any]:
    """The tables of a TOML file of at most so many bytes; refused where it is none."""
    text = read_text(path, most)
    try:
        tables = tomllib.loads(text)
        repr(tables)  # numbers of more digits than Python writes
        return tables
    except (ValueError, RecursionError) as error:  # ValueError: also of more digits than Python reads
        raise InputError(path, f"is not TOML ({error})", "Correct the file") from None


def parse_number(word: str) -> float:
    """A number as text files hold it; ValueError also for 1_0 and other scripts' digits, which Python would read."""
    if "_" in word or not word.isascii():
        raise ValueError(word)
    return float(word)
