"""``brdf tradeoff``: what the choices that a scene offers cost, and what error they make."""

import json
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from brdf.errors import InputError
from brdf.files import check_folder
from fitting.cli.common import MODEL_NAMES, named_as, show, use_compilation_cache
from fitting.cli.interrupts import held
from fitting.cli.picture_options import PictureOptions, takes_picture_options

EXAMPLE = (
    "Example: [bold]brdf tradeoff photo.exr --scene scene.toml --out tradeoff/[/bold]\n\n"
    "A photo of a ball: [bold]brdf tradeoff ball.png --sphere 244.5,144.5,108 --light fit[/bold]"
)


@takes_picture_options
def tradeoff(
    target: Annotated[
        Path, typer.Argument(help="A picture, a folder with target.* and scene.toml, or a photograph of a ball.")
    ],
    pictures: PictureOptions,
    out: Annotated[Path | None, typer.Option(help="A folder for tradeoff.csv, .json, .png and .pdf.")] = None,
    model: Annotated[str, typer.Option(help=f"One of {', '.join(MODEL_NAMES)}.")] = "blinn-phong",
    accuracy: Annotated[float, typer.Option(help="Relative error that the recommendation is to keep.")] = 1e-3,
    seconds: Annotated[float, typer.Option(help="Time that the measuring may take.")] = 45.0,
    render: Annotated[bool, typer.Option("--render", help="Also measure the renderer alone.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON instead of a table.")] = False,
) -> None:
    """Measure speed against accuracy on a scene: pixels, light samples, precision, model, solver.

    Ctrl-C ends the measuring and keeps what was measured.
    """
    from fitting.cli.first_look import read_first

    if out is not None:
        check_folder(out)
    options = {"model": model, "accuracy": accuracy, "seconds": seconds}
    with named_as({name: f"--{name}" for name in options} | pictures.names()):
        read = read_first([target], pictures, lambda now: None)
        with held():
            use_compilation_cache()
            import fitting
            from fitting.cli.inputs import collect

            measure = fitting.tradeoff
        job = collect([target], pictures, read)
        if len(job.pictures) > 1:
            came = f"holds {len(job.pictures)} pictures, and one is measured"
            raise InputError(target, came, "Give one picture with its scene or its light")
        with named_as({"target": job.target}), _Progress() as progress:
            found = measure(
                job.pictures[0],
                job.scenes[0],
                mask=job.masks[0],
                saturation=pictures.saturation,
                render=render,
                progress=progress.step,
                **options,
            )
    silent = [path.name for path, picture in read.items() if picture.source == "assumed"]
    guess = [f"{name} does not say how its values are encoded; --encoding decides" for name in silent]
    notes = [*job.notes, *guess]
    if out is not None:
        found.save(out)
    if as_json:
        show(json.dumps(found.to_dict() | ({"notes": notes} if notes else {}), indent=2))
        return
    for note in notes:
        show(note)
    _print_table(found)
    show(found.advice)
    if out is not None:
        show(f"saved in {out}")


def _print_table(found: Any) -> None:
    """As wide as the terminal; in a pipe, as wide as it takes."""
    from rich.console import Console

    Console(width=None if sys.stdout.isatty() else 160).print(found.table())


class _Progress:
    """A bar with the time left, where standard error is a terminal."""

    def __init__(self) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

        columns = (TextColumn("measuring"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
        self.bar = Progress(*columns, console=Console(stderr=True), disable=not sys.stderr.isatty())
        self.task = self.bar.add_task("measuring", total=None)

    def __enter__(self) -> "_Progress":
        self.bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.bar.stop()

    def step(self, done: int, total: int) -> None:
        """So many runs of so many are done."""
        self.bar.update(self.task, completed=done, total=total)
