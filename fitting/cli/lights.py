"""``brdf lights``: directions of distant lights from photographs of a ball."""

from pathlib import Path
from typing import Annotated

import typer

from brdf.errors import InputError
from brdf.files import write_text
from fitting.cli.common import named_as, show
from fitting.cli.interrupts import held
from fitting.cli.picture_options import ENCODINGS, PictureOptions, encoding_of

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
    encoding: Annotated[str | None, typer.Option(help=ENCODINGS)] = None,
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
    with held():
        import brdf.images.reading
        from fitting.cli.first_look import check_ball, find_ball
        from fitting.cli.job import opaque
        from fitting.cli.photograph_inputs import how_sure, light_of
        from fitting.photographs.ball import ball_points, light_from_highlight
    options = PictureOptions(sphere=sphere, mask=mask, ambient=ambient, encoding=encoding, saturation=saturation)
    with named_as(options.names()):
        pictures = [brdf.read_picture(path, encoding=encoding_of(encoding)) for path in target]
    inside = None if mask is None else brdf.read_mask(mask)
    circle, notes = find_ball(sphere, inside, mask)
    for picture in pictures:
        check_ball(picture.pixels.shape[:2], circle)
    lines = []
    for path, picture, seen in zip(target, pictures, opaque(inside, pictures), strict=True):
        said = ""
        if matt:
            light = light_of(path, picture, ball_points(picture.pixels.shape[:2], circle), seen, options)
            direction, said = light.direction, f"  # {how_sure(light)}"
        else:
            with named_as({**options.names(), "picture": path}):
                direction = light_from_highlight(picture, circle, mask=seen)
        lines.append(" ".join(f"{value:.6f}" for value in direction) + said)
    text = "\n".join([*(f"# {line}" for line in notes), *lines]) + "\n"
    if out is not None:
        write_text(out, text)
    show(text.rstrip() if out is None else f"wrote {out}")
