"""``brdf tradeoff``: what the choices that a scene offers cost, and what error they make."""

import json
from pathlib import Path
from typing import Annotated

import typer

from brdf.errors import InputError
from brdf.files import check_folder
from fitting.cli.common import AsJson, Model, PictureOptions, named_as, show, use_compilation_cache

EXAMPLE = (
    "Example: [bold]brdf tradeoff photo.exr --scene scene.toml --out tradeoff/[/bold]\n\n"
    "A photo of a ball: [bold]brdf tradeoff ball.png --sphere 244.5,144.5,108 --light fit[/bold]"
)


def tradeoff(
    target: Annotated[
        Path, typer.Argument(help="A picture, a folder with target.* and scene.toml, or a photograph of a ball.")
    ],
    pictures: PictureOptions,
    out: Annotated[Path | None, typer.Option(help="A folder for tradeoff.csv, .json, .png and .pdf.")] = None,
    model: Model = "blinn-phong",
    accuracy: Annotated[float, typer.Option(help="Relative error that the recommendation is to keep.")] = 1e-3,
    seconds: Annotated[float, typer.Option(help="Time that the measuring may take.")] = 15.0,
    as_json: AsJson = False,
) -> None:
    """Measure speed against accuracy on a scene: pixels, light samples, precision, model, solver.

    Ctrl-C ends the measuring and keeps what was measured.
    """
    from fitting.cli.inputs import collect, read_inputs

    if out is not None:
        check_folder(out)
    given = read_inputs([target], pictures)
    use_compilation_cache()
    import fitting

    inputs = collect(given)
    if len(inputs.pictures) > 1:
        came = f"holds {len(inputs.pictures)} pictures, and one is measured"
        raise InputError(target, came, "Give one picture with its scene or its light")
    with named_as({"target": given.targets[0]}):
        found = fitting.tradeoff(
            inputs.pictures[0],
            inputs.scenes[0],
            mask=inputs.masks[0],
            saturation=pictures.saturation,
            model=model,
            accuracy=accuracy,
            seconds=seconds,
        )
    silent = [path.name for path, picture in given.pictures.items() if picture.source == "assumed"]
    guess = [f"{name} does not say how its values are encoded; --encoding decides" for name in silent]
    notes = [*inputs.notes, *guess]
    if out is not None:
        found.save(out)
    if as_json:
        show(json.dumps(found.to_dict() | ({"notes": notes} if notes else {}), indent=2))
        return
    saved = [] if out is None else [f"saved in {out}"]
    show("\n".join([*notes, str(found), "", found.advice, *saved]))
