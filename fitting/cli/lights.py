"""``brdf lights``: directions of distant lights from photographs of a ball."""

from pathlib import Path
from typing import Annotated, Any

import typer

import brdf
from brdf.errors import InputError
from brdf.files import write_text
from fitting.cli.common import Encoding, PictureOptions, named_as, show
from fitting.progress import waiting

EXAMPLE = "Example: [bold]brdf lights chrome.*.png --sphere 253.5,148,119.5 --out lights.txt[/bold]"


def lights(
    target: Annotated[
        list[Path], typer.Argument(help="Photographs of a mirror ball, one per light; of a matt one with --matt.")
    ],
    sphere: Annotated[
        str, typer.Option(help="The ball: x,y,radius in pixels from the upper left one, or mask: found in --mask.")
    ],
    mask: Annotated[
        Path | None,
        typer.Option(help="An image: pixels that are 0 there are left out; for --sphere mask those beside the ball."),
    ] = None,
    out: Annotated[Path | None, typer.Option(help="A text file to write: a direction a line.")] = None,
    encoding: Encoding = None,
    matt: Annotated[
        bool, typer.Option("--matt", help="The ball is matt: its shading tells the light, not a highlight.")
    ] = False,
    ambient: Annotated[
        bool, typer.Option("--ambient", help="With --matt: the ball is lit from all around too.")
    ] = False,
    saturation: Annotated[
        float | None, typer.Option(help="With --matt: linear values from here on are clipped, not data.")
    ] = None,
) -> None:
    """Find where the light comes from by its highlight on a mirror ball: x right, y up, z to the camera."""
    for name, given in (("--ambient", ambient), ("--saturation", saturation is not None)):
        if given and not matt:
            raise InputError(name, "says nothing of a mirror ball's highlight", "Leave it out, or add --matt")
    with waiting("finding the lights"):
        lines = _lines(target, sphere, mask, encoding, matt, PictureOptions(ambient=ambient, saturation=saturation))
    text = "\n".join(lines)
    if out is not None:
        write_text(out, text + "\n")
    show(text if out is None else f"wrote {out}")


def _lines(target: Any, sphere: str, mask: Any, encoding: Any, matt: bool, options: PictureOptions) -> list[str]:
    """What the text file holds: remarks, and a direction for each photograph."""
    from fitting.cli.inputs import ball_in, light_of, stated_error, visible

    pictures = [brdf.read_picture(path, encoding=encoding) for path in target]
    inside = None if mask is None else brdf.read_mask(mask)
    circle, notes = ball_in(sphere, inside)
    lines = [f"# {note}" for note in notes]
    from fitting.photographs.ball import ball_points
    from fitting.photographs.distant_light import light_from_highlight

    for path, picture, counts in zip(target, pictures, visible(inside, pictures), strict=True):
        if matt:
            light = light_of(path, picture, counts, ball_points(picture.pixels.shape[:2], circle), options)
            direction, error = light.direction, f"  # {stated_error(light)}"
        else:
            with named_as({"picture": path}):
                direction, error = light_from_highlight(picture, circle, mask=True if counts is None else counts), ""
        lines.append(" ".join(f"{value:.6f}" for value in direction) + error)
    return lines
