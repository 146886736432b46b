"""The command ``brdf``: the front door for people who work with files.

Help does not import JAX; each command imports what it needs.
"""

import importlib.metadata
import json
import os
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from brdf.errors import InputError
from fitting.cli import convert as cli_convert
from fitting.cli import fit as cli_fit
from fitting.cli import tradeoff as cli_tradeoff
from fitting.cli.common import named_as, show, use_compilation_cache, waiting
from fitting.cli.interrupts import interruptible

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
    version: Annotated[bool, typer.Option("--version", callback=_version, is_eager=True, help="Say which.")] = False,
) -> None:
    """Which few numbers make this surface look like that picture."""


INTERRUPTED = 130  # what shells expect after Ctrl-C
# What a wrong option raises, wherever typer keeps its parser.
USAGE_ERROR: type[BaseException] = typer.BadParameter.__mro__[2]


app.command(epilog=cli_fit.EXAMPLE)(cli_fit.fit)
app.command(epilog=cli_fit.LIGHTS_EXAMPLE)(cli_fit.lights)


@app.command(
    epilog="Example: [bold]brdf render material.json --scene scene.toml -o picture.exr[/bold]    or, from the classic "
    "table: [bold]brdf render emerald --scene scene.toml -o emerald.png[/bold]"
)
def render(
    material: Annotated[str, typer.Argument(help="A .json or .mtl file, or a name of the classic table: emerald.")],
    scene: Annotated[Path, typer.Option(help="The scene file.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="The picture to write: .exr, .hdr, .png, .tiff or .jpg.")],
    precision: Annotated[str, typer.Option(help="float32 or float64.")] = "float32",
) -> None:
    """Render a material in a scene."""
    with waiting("rendering"), named_as({"material": material, "precision": "--precision"}):
        use_compilation_cache()
        import numpy as np

        import brdf
        from fitting.cli.materials import find_material

        loaded, _ = find_material(material)
        image = brdf.render(loaded, brdf.Scene.load(scene), precision=precision)  # pyright: ignore[reportArgumentType]
        brdf.write_image(out, np.asarray(image))
    show(f"wrote {out}")


@app.command(
    epilog="Example: [bold]brdf check material.json[/bold]    or in CI: [bold]brdf check scene.mtl --json[/bold]    "
    "or, from the classic table: [bold]brdf check emerald[/bold]"
)
def check(
    material: Annotated[
        str,
        typer.Argument(
            help="A .json, .mtl (every material is checked) or measured BRDF file, or a name of the classic table."
        ),
    ],
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON instead of text.")] = False,
    plot: Annotated[Path | None, typer.Option(help="A picture of albedo, lobe and reciprocity to write.")] = None,
) -> int:
    """Is a material plausible: positive, reciprocal, energy conserving? Exit 0 if so, 1 if not, 2 if it cannot tell."""
    with waiting("checking"):
        use_compilation_cache()
        import brdf
        from fitting.cli.materials import find_materials

        is_table = brdf.is_measured(material)
        if is_table and plot is not None:
            remedy = f"Fit a material to it with brdf fit {material} --out DIR, and check DIR/material.json"
            raise InputError("--plot", f"draws materials, and {material} is a measured table", remedy)
        materials: dict[str, Any] = (
            {Path(material).stem: brdf.load_measured(material)} if is_table else find_materials(material)
        )
        reports = {name: brdf.check(one, name=name) for name, one in materials.items()}
        if plot is not None:
            if len(materials) > 1:
                raise InputError("--plot", f"draws one material, {material} holds {len(materials)}", "Give one")
            from fitting.plots.materials import overview

            with brdf.atomic_path(plot) as path:
                name, one = next(iter(materials.items()))
                overview(one, reports[name]).savefig(path)
    if as_json:
        show(json.dumps({name: report.to_json() for name, report in reports.items()}, indent=2))
    else:
        show("\n\n".join(map(str, reports.values())))
    verdicts = [report.plausible for report in reports.values()]
    return 1 if False in verdicts else 2 if None in verdicts else 0


app.command(epilog=cli_convert.EXAMPLE)(cli_convert.convert)
app.command(epilog=cli_tradeoff.EXAMPLE)(cli_tradeoff.tradeoff)


def main(arguments: list[str] | None = None) -> Any:
    """Run the command; every failure of the user's making is one line on standard error and exit status 2.

    Args:
        arguments: the words after ``brdf``; None takes those of the process.
    """
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
        _fail("interrupted.", status=INTERRUPTED)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)
    else:
        if status == INTERRUPTED:  # typer turns Ctrl-C into a number
            _fail("interrupted.", status=INTERRUPTED)
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
