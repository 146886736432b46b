"""What the commands share: a spinner, output, errors that name what was typed, the compiler's cache."""

import contextlib
import os
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from brdf.errors import InputError

# As `fitting.fit` takes them; help is shown without importing it.
MODEL_NAMES = ("auto", "lambert", "phong", "blinn-phong", "normalized-phong", "normalized-blinn-phong")


@contextlib.contextmanager
def named_as(arguments: dict[str, Any]) -> Iterator[None]:
    """Let an error name the file or option that a person typed, not the argument of the function behind it.

    Args:
        arguments: what was typed, by argument.
    """
    try:
        yield
    except InputError as error:
        typed = arguments.get(error.where)
        if typed is None:
            raise
        raise InputError(typed, error.what, error.remedy) from None


def use_compilation_cache() -> None:
    """Keep compiled programs in the user's cache folder: the second run of the same kind skips the compiler."""
    import jax

    base = os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
    if jax.config.values["jax_compilation_cache_dir"] is None:
        jax.config.update("jax_compilation_cache_dir", str(Path(base) / "brdf" / "jax"))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
        jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)


@contextlib.contextmanager
def waiting(what: str) -> Iterator[Callable[[str], None]]:
    """A spinner where a person waits; nothing where standard error is no terminal.

    Args:
        what: is being done.

    Yields:
        A function that says what is being done now.
    """
    if not sys.stderr.isatty():
        yield lambda now: None
        return
    from rich.console import Console

    with Console(stderr=True).status(f"{what} ...") as status:
        yield lambda now: status.update(f"{now} ...")


def show(text: str) -> None:
    """Print the command's output.

    Args:
        text: to print.

    Raises:
        InputError: where it cannot be written.
    """
    try:
        print(text, flush=True)  # noqa: T201  # this is the command's output
    except BrokenPipeError:
        raise
    except OSError as error:
        forget_output()
        raise InputError("output", f"cannot be written ({error.strerror})", "Send it elsewhere") from None


def forget_output() -> None:
    """Let what could not be written go, or Python would try once more when it ends."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
