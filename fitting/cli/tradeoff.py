"""``brdf tradeoff``: what the choices that a scene offers cost, and what error they make."""

import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from fitting.cli.common import named_as, show, use_compilation_cache

EXAMPLE = "Example: [bold]brdf tradeoff photo.exr --scene scene.toml --out tradeoff/[/bold]"


def tradeoff(
    target: Annotated[Path, typer.Argument(help="A picture, or a folder with target.* and scene.toml.")],
    scene: Annotated[Path | None, typer.Option(help="The scene file; in a folder, scene.toml.")] = None,
    out: Annotated[Path | None, typer.Option(help="A folder for tradeoff.csv, .json, .png and .pdf.")] = None,
    model: Annotated[str, typer.Option(help="The name of a model, or auto.")] = "blinn-phong",
    accuracy: Annotated[float, typer.Option(help="Relative error that the recommendation is to keep.")] = 1e-3,
    seconds: Annotated[float, typer.Option(help="Time that the measuring may take.")] = 30.0,
    render: Annotated[bool, typer.Option("--render", help="Also measure the renderer alone.")] = False,
    mask: Annotated[Path | None, typer.Option(help="An image: pixels that are 0 there are left out.")] = None,
    saturation: Annotated[float | None, typer.Option(help="Linear values from here on are clipped, not data.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON instead of a table.")] = False,
) -> None:
    """Measure speed against accuracy on a scene: pixels, light samples, precision, model, solver.

    Ctrl-C ends the measuring and keeps what was measured.
    """
    import json

    import brdf
    from fitting.cli.first_look import target_and_scene

    picture_file, scene_file = target_and_scene(target, scene)
    names: dict[str, Any] = {"target": picture_file, "mask": mask, "model": "--model", "accuracy": "--accuracy"}
    with named_as(names | {"seconds": "--seconds", "saturation": "--saturation"}):
        picture = brdf.read_picture(picture_file)
        use_compilation_cache()
        import fitting

        with _Progress() as progress:
            found = fitting.tradeoff(
                picture,
                brdf.Scene.load(scene_file),
                model=model,
                mask=None if mask is None else brdf.read_mask(mask),
                saturation=saturation,
                accuracy=accuracy,
                seconds=seconds,
                render=render,
                progress=progress.step,
            )
    if out is not None:
        found.save(out)
    if as_json:
        show(json.dumps(found.to_dict(), indent=2))
        return
    _print_table(found)
    best = found.recommended
    if best is not None:
        show(f"recommended: {best.name} ({1e3 * best.seconds:.3g} ms, error {best.error:.1g})")
    if not found.complete:
        show("not everything was measured")
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
