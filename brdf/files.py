"""Files in and out: what may be read, and results that appear whole or not at all.

A result is written under a temporary name beside its place and renamed when it is complete, so that an error, a full
disk or Ctrl-C leaves whatever was there before, and nothing else. Renaming guards against a dying program, not against
a power cut: nothing is forced to the disk.
"""

import errno
import os
import secrets
import shutil
import stat
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from brdf.errors import InputError

_REMEDIES = {
    errno.ENOSPC: ("there is no space left to write it", "Free some space or write elsewhere"),
    errno.EDQUOT: ("the disk quota is used up", "Free some space or write elsewhere"),
    errno.EFBIG: ("the file would be larger than allowed here", "Write elsewhere or raise the limit"),
    errno.EACCES: ("permission denied", "Change the permissions or choose another place"),
    errno.EPERM: ("permission denied", "Change the permissions or choose another place"),
    errno.EROFS: ("the file system is read-only", "Choose another place"),
    errno.ENOENT: ("there is no such file or folder", "Check the path"),
    errno.ENOTDIR: ("a part of the path is not a folder", "Check the path"),
    errno.EISDIR: ("is a folder, not a file", "Give the path of a file"),
    errno.ENAMETOOLONG: ("the name is too long", "Choose a shorter name"),
    errno.ELOOP: ("the links lead in a circle", "Check the path"),
}


def file_error(path: str | os.PathLike[str], error: OSError) -> InputError:
    """The one-line error for what the operating system refused.

    Args:
        path: the file or folder that the user named.
        error: what the system said.

    Returns:
        The error to raise.
    """
    what, remedy = _REMEDIES.get(error.errno or 0, (error.strerror or type(error).__name__, "Check the path"))
    return InputError(os.fspath(path), what, remedy)


def input_file(path: str | os.PathLike[str]) -> Path:
    """The path of an ordinary, readable file that is not empty.

    Args:
        path: the file.

    Returns:
        The same path.

    Raises:
        InputError: if the file is missing, a folder, a device or a pipe, unreadable or empty.
    """
    try:
        with open(_plain(path), "rb", opener=_open_without_waiting) as file:
            status = os.fstat(file.fileno())
    except OSError as error:
        raise file_error(path, error) from None
    if not stat.S_ISREG(status.st_mode):
        raise InputError(os.fspath(path), "is not an ordinary file", "Give the path of a file")
    if status.st_size == 0:
        raise InputError(os.fspath(path), "is empty", "Give a file with content")
    return Path(path)


def _open_without_waiting(path: str, flags: int) -> int:
    # A named pipe without a writer would block the plain open for ever.
    return os.open(path, flags | getattr(os, "O_NONBLOCK", 0))


def _plain(path: str | os.PathLike[str]) -> str:
    if not isinstance(path, str | os.PathLike) or not isinstance(os.fspath(path), str):
        raise InputError(repr(path), f"a path must be text, got {type(path).__name__}", "Give the path of a file")
    text = os.fspath(path)
    try:
        is_path = bool(text) and b"\0" not in os.fsencode(text)
    except UnicodeEncodeError:
        is_path = False
    if not is_path:
        raise InputError(repr(text), "is not a path", "Give the path of a file")
    return text


def utf8_name(path: str | os.PathLike[str]) -> str:
    """A path as text, for libraries that know names in UTF-8 alone.

    Args:
        path: a file that may bear any name that the system allows.

    Raises:
        InputError: where the name is other bytes.
    """
    name = os.fspath(path)
    try:
        name.encode()
    except UnicodeEncodeError:
        raise InputError(name, "has a name or folder that is not UTF-8", "Rename it") from None
    return name


@contextmanager
def atomic_path(path: str | os.PathLike[str]) -> Iterator[Path]:
    """A temporary name beside ``path``, with the same suffix, that becomes ``path`` when the block ends well.

    On any exception, Ctrl-C among them, the temporary file is deleted and ``path`` stays as it was. An existing file
    is replaced and keeps its permissions; a link keeps pointing at the file that is replaced.

    Args:
        path: the file to write.

    Yields:
        The name to write to; an empty file of that name exists.

    Raises:
        InputError: if the folder is missing or not writable, the disk is full, or ``path`` is no ordinary file.
    """
    target = Path(os.path.realpath(_plain(path)))
    if os.path.isdir(target):
        raise InputError(os.fspath(path), "is a folder, not a file", "Give the path of a file")
    if os.path.islink(target):
        # What a resolved path cannot be, unless its links lead in a circle.
        raise file_error(path, OSError(errno.ELOOP, os.strerror(errno.ELOOP)))
    if os.path.exists(target) and not os.path.isfile(target):
        raise InputError(os.fspath(path), "is not an ordinary file", "Give the path of a file")
    temporary = target.with_name(f".{secrets.token_hex(6)}{target.suffix}")
    try:
        os.close(os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))
        yield temporary
        if target.exists():
            shutil.copymode(target, temporary)
        temporary.replace(target)
    except OSError as error:
        raise file_error(path, error) from None
    finally:
        # After success the name is gone already.
        with suppress(OSError):
            temporary.unlink()


def write_text(path: str | os.PathLike[str], text: str) -> None:
    """Write a text file, whole or not at all, as UTF-8 with newlines as they are.

    Args:
        path: the file; an existing one is replaced.
        text: the content.

    Raises:
        InputError: if the file cannot be written.
    """
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8", newline="")


@contextmanager
def atomic_folder(path: str | os.PathLike[str]) -> Iterator[Path]:
    """A folder to write a set of files into, which appear together in ``path`` when the block ends well.

    On any exception nothing has changed: no file of the set appears, files that were there keep their content, and
    folders made on the way are gone. Other files in an existing folder are left alone.

    Args:
        path: the folder of results; made, with its parents, where missing.

    Yields:
        An empty folder on the same file system; it takes files, not folders.

    Raises:
        InputError: if the folder cannot be made or written, or a folder stands where a file of the set belongs.
    """
    folder = Path(os.path.realpath(_plain(path)))
    made: list[Path] = []
    stage = folder / f".{secrets.token_hex(6)}"
    complete = False
    try:
        _make_folders(folder, made)
        stage.mkdir()
        (stage / "new").mkdir()
        (stage / "old").mkdir()
        yield stage / "new"
        _move_together(stage, folder)
        complete = True
    except OSError as error:
        raise file_error(path, error) from None
    except InputError as error:
        # Named as it would have been in its place: where it was written is gone by now.
        staged = Path(error.where)
        if not staged.is_relative_to(stage / "new"):
            raise
        raise InputError(Path(path) / staged.relative_to(stage / "new"), error.what, error.remedy) from None
    finally:
        shutil.rmtree(stage, ignore_errors=True)
        if not complete:
            for parent in reversed(made):
                with suppress(OSError):
                    parent.rmdir()


class _Enough(Exception):  # noqa: N818  # no error: the end of a trial
    """Nothing is to be written."""


def check_folder(path: str | os.PathLike[str]) -> None:
    """Refuse a folder of results that cannot be made or written, before there are any; nothing of the trial stays.

    Args:
        path: the folder.

    Raises:
        InputError: if it cannot be made or written.
    """
    with suppress(_Enough), atomic_folder(path):
        raise _Enough


def _make_folders(folder: Path, made: list[Path]) -> None:
    if folder.is_symlink():
        raise OSError(errno.ELOOP, os.strerror(errno.ELOOP))
    if folder.exists() and not folder.is_dir():
        raise NotADirectoryError(errno.ENOTDIR, os.strerror(errno.ENOTDIR))
    for parent in [*reversed(folder.parents), folder]:
        if not parent.exists():
            parent.mkdir()
            made.append(parent)


def _move_together(stage: Path, folder: Path) -> None:
    """Move the new files into place; if one fails, put back the old ones."""
    placed: list[str] = []
    set_aside: list[str] = []
    names = sorted(item.name for item in (stage / "new").iterdir())
    try:
        for name in names:
            if (folder / name).is_dir():
                raise InputError(folder / name, "is a folder, not a file", "Move it away or choose another folder")
            if (folder / name).exists():
                # Noted first, so that Ctrl-C between the two lines cannot lose the old file.
                set_aside.append(name)
                (folder / name).rename(stage / "old" / name)
            placed.append(name)
            (stage / "new" / name).rename(folder / name)
    except BaseException:
        for name in placed:
            if not (stage / "new" / name).exists():
                (folder / name).unlink(missing_ok=True)
        for name in set_aside:
            if (stage / "old" / name).exists():
                (stage / "old" / name).replace(folder / name)
        raise


MAX_TEXT_BYTES = 1 << 24


def read_text(path: str | os.PathLike[str], most: int = MAX_TEXT_BYTES) -> str:
    """Read a text file.

    Args:
        path: the file, UTF-8, with or without a byte-order mark.
        most: how many bytes it may have.

    Returns:
        Its content.

    Raises:
        InputError: if the file cannot be read, is too large or is not text.
    """
    with input_file(path).open("rb") as file:
        content = file.read(most + 1)
    if len(content) > most:
        raise InputError(os.fspath(path), f"is larger than {most >> 20} MiB", "Check what it is, or make it smaller")
    try:
        text = content.decode("utf-8-sig")  # some editors write a byte-order mark
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        what = f"is not UTF-8 text (line {line}: {error.reason})"
        raise InputError(os.fspath(path), what, "Give a text file, saved as UTF-8") from None
    if "\0" in text:
        raise InputError(os.fspath(path), "is not UTF-8 text (it holds null bytes)", "Give a text file, saved as UTF-8")
    return text


def read_toml(path: str | os.PathLike[str], most: int = MAX_TEXT_BYTES) -> dict[str, Any]:
    """Read a TOML file.

    Args:
        path: the file.
        most: how many bytes it may have.

    Raises:
        InputError: if the file cannot be read, is too large or is not TOML.
    """
    try:
        return tomllib.loads(read_text(path, most))
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise InputError(path, f"is not TOML ({error})", "Correct the file") from None


def parse_number(word: str) -> float:
    """A number as text files hold it; Python's own reading would take 1_0 and the digits of other scripts.

    Args:
        word: without white space.

    Raises:
        ValueError: if it is none.
    """
    if "_" in word or not word.isascii():
        raise ValueError(word)
    return float(word)
