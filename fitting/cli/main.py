"""The command ``brdf``: the front door for people who work with files.

Help does not import JAX; each command imports what it needs.
"""

import importlib.metadata
import io
import sys
from typing import Annotated, Any

import typer

from brdf.errors import InputError
from fitting.cli import check, convert, fit, lights, render, tradeoff
from fitting.cli.common import forget_output, show
from fitting.cli.interrupts import exit_status, interruptible

# What typer turns Ctrl-C into.
INTERRUPTED = 130
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
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Show the version and exit.")
    ] = False,
) -> None:
    """Which few numbers make this surface look like that picture."""


app.command(epilog=fit.EXAMPLE)(fit.fit)
app.command(epilog=lights.EXAMPLE)(lights.lights)
app.command(epilog=render.EXAMPLE)(render.render)
app.command(epilog=check.EXAMPLE)(check.check)
app.command(epilog=convert.EXAMPLE)(convert.convert)
app.command(epilog=tradeoff.EXAMPLE)(tradeoff.tradeoff)


def main(arguments: list[str] | None = None) -> Any:
    """Run the command; every failure of the user's making is one line on standard error and exit status 2.

    Args:
        arguments: the words after ``brdf``; None takes those of the process.
    """
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")  # ± on a terminal that knows ASCII alone
    try:
        with interruptible():
            status = app(args=arguments, prog_name="brdf", standalone_mode=False)
    except InputError as error:
        _fail(str(error))
    except USAGE_ERROR as error:
        if not _words(error):  # no command at all: the help has been shown
            sys.exit(2)
        _fail(f"{_words(error).rstrip('.')}. See {_command(error)} --help.")
    except KeyboardInterrupt:
        _fail("interrupted.", status=exit_status())
    except BrokenPipeError:
        forget_output()
        sys.exit(1)
    except (MemoryError, RuntimeError) as error:
        # So XLA says it.
        if not isinstance(error, MemoryError) and "RESOURCE_EXHAUSTED" not in str(error):
            raise
        _fail("memory: there is not enough for this. Use fewer pixels or light samples.")
    else:
        if status == INTERRUPTED:
            _fail("interrupted.", status=exit_status())
        sys.exit(status if isinstance(status, int) else 0)


def _words(error: Any) -> str:
    return " ".join(error.format_message().split())


def _command(error: Any) -> str:
    """The command, as far as it was understood: brdf fit."""
    context = getattr(error, "ctx", None)
    return "brdf" if context is None else context.command_path


def _fail(message: str, status: int = 2) -> None:
    print(f"error: {message}", file=sys.stderr)  # noqa: T201  # this is the command's one line of failure
    sys.exit(status)
