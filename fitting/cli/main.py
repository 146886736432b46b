"""The command ``brdf``: the front door for people who work with files."""

import atexit
import gc
import importlib.metadata
import io
import os
import signal
import sys
from pathlib import Path
from typing import Annotated, Any, NoReturn

import typer

from brdf.errors import InputError
from fitting.cli import check, convert, fit, lights, maps, render, tradeoff
from fitting.cli.common import add_command, show
from fitting.cli.interrupts import interruptible

# What a wrong option raises, wherever typer keeps its parser.
USAGE_ERROR: type[BaseException] = typer.BadParameter.__mro__[2]

app = typer.Typer(
    name="brdf",
    help="Which few numbers make this surface look like that picture.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
)


def _version(wanted: bool) -> None:
    if wanted:
        show(f"brdf-fitting {importlib.metadata.version('brdf-fitting')}")
        raise typer.Exit


@app.callback()
def about(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, metavar="", help="Show the version and exit.")
    ] = False,
) -> None:
    """Which few numbers make this surface look like that picture."""


for function in (fit.fit, maps.maps, lights.lights, render.render, check.check, convert.convert, tradeoff.tradeoff):
    add_command(app, function)


def main(arguments: list[str] | None = None) -> Any:
    """Run the command; every failure of the user's making is one line on standard error and exit status 2."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")  # ± on a terminal that knows ASCII alone
    # What importing and tracing make mostly stays: looking for garbage among it takes a tenth of the time.
    gc.set_threshold(100_000, 20, 20)
    # Products in NumPy are of few rows: cores that share one wait for each other longer than one takes for it.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    _keep_compiled_programs()
    command, words = typer.main.get_command(app), sys.argv[1:] if arguments is None else arguments
    try:
        with interruptible(), command.make_context("brdf", [*words]) as context:
            sys.exit(command.invoke(context) or 0)
    except typer.Exit as done:
        sys.exit(done.exit_code)
    except InputError as error:
        _fail(str(error))
    except USAGE_ERROR as error:
        message = " ".join(error.format_message().split()).rstrip(".")  # pyright: ignore[reportAttributeAccessIssue]
        if not message:  # no command at all: the help has been shown
            sys.exit(2)
        context = getattr(error, "ctx", None)
        _fail(f"{message}. See {'brdf' if context is None else context.command_path} --help.")
    except KeyboardInterrupt as interrupt:
        # As shells expect it of a command that a signal ended: 130 after Ctrl-C, 143 after SIGTERM.
        _fail("interrupted.", 128 + (interrupt.args[0] if interrupt.args else signal.SIGINT))
    except OSError as error:
        if error.filename is not None or error.errno is None:
            raise
        # What the system says of no file is of standard output. What could not be written goes, or Python would try
        # once more when it ends.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        if isinstance(error, BrokenPipeError):
            sys.exit(1)
        _fail(f"output: cannot be written ({error.strerror}). Send it elsewhere.")
    except (MemoryError, RuntimeError) as error:
        # So XLA says it.
        if not isinstance(error, MemoryError) and "RESOURCE_EXHAUSTED" not in str(error):
            raise
        _fail("memory: there is not enough for this. Use fewer pixels or light samples.")


def _keep_compiled_programs():
    """Have JAX keep compiled programs in the user's cache folder: the second run of a kind skips the compiler."""
    try:
        folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache", "brdf", "jax")
        folder.mkdir(parents=True, exist_ok=True)
    except (OSError, RuntimeError):  # JAX would say so for each program; a user of a container may have no home
        return
    settings = {
        "JAX_COMPILATION_CACHE_DIR": str(folder),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "-1",
        # Of each program that it takes from there jaxlib 0.10.1 says, at length, that the compiler's own settings are
        # no features of the machine. What is an error comes as an exception.
        "TF_CPP_MIN_LOG_LEVEL": "3",
    }
    os.environ.update(settings | dict(os.environ))


def run() -> None:
    """The process of the command: `main`, and then its end at once, though in order.

    Python would first take apart, object by object, what ends with the process: a quarter of a second run.
    """
    status: list[int] = []

    def end() -> None:
        if status:  # else: a traceback
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(status[0])

    atexit.register(end)  # what is registered first comes last
    try:
        main()
    except SystemExit as done:
        status.append(int(done.code or 0))
        raise


def _fail(message: str, status: int = 2) -> NoReturn:
    print(f"error: {message}", file=sys.stderr)  # noqa: T201  # this is the command's one line of failure
    sys.exit(status)
