"""``brdf lights``: directions of distant lights from photographs of a ball."""

from pathlib import Path
from typing import Any

import brdf
from brdf.errors import InputError
from brdf.files import write_text
from fitting.cli.common import named_as, refuse_replacing, show
from fitting.progress import waiting


def lights(
    target: list[Path],
    *,
    sphere: str,
    mask: Path | None = None,
    out: Path | None = None,
    encoding: Any = None,
    matt: bool = False,
    ambient: bool = False,
    saturation: float | None = None,
) -> None:
    """Find where the light comes from by its highlight on a mirror ball: x right, y up, z to the camera.

    Args:
        target: photographs of a mirror ball, one per light; of a matt one with --matt.
        sphere: the ball: x,y,radius in pixels from the upper left one, or mask: found in --mask.
        mask: an image: pixels that are 0 there are left out; for --sphere mask those beside the ball.
        out: a text file to write: a direction a line.
        encoding: linear, srgb or a gamma; default: what the file says.
        matt: the ball is matt: its shading tells the light, not a highlight.
        ambient: with --matt: the ball is lit from all around too.
        saturation: with --matt: linear values from here on are clipped, not data.

    Example:
        brdf lights chrome.*.png --sphere 253.5,148,119.5 --out lights.txt
    """
    for name, given in (("--ambient", ambient), ("--saturation", saturation is not None)):
        if given and not matt:
            raise InputError(name, "says nothing of a mirror ball's highlight", "Leave it out, or add --matt")
    if out is not None:
        refuse_replacing([*target, mask], out)
    with waiting("finding the lights"):
        from fitting.cli.inputs import ball_in, masks_of

        pictures = [brdf.read_picture(path, encoding=encoding) for path in target]
        inside = None if mask is None else brdf.read_mask(mask)
        circle, notes = ball_in(sphere, inside)
        lines = [f"# {note}" for note in notes]
        from fitting.photographs.ball import ball_points
        from fitting.photographs.distant_light import FAR_BEHIND, FROM_OUTLINE, light_from_highlight, light_from_shading

        for path, picture, counts in zip(target, pictures, masks_of(pictures, inside), strict=True):
            with named_as({"picture": path}):
                if matt:
                    points = ball_points(picture.pixels.shape[:2], circle)
                    light = light_from_shading(picture, points, saturation=saturation, mask=counts, ambient=ambient)
                    direction, error = light.direction, f"  # {light.stated_error}"
                else:
                    direction = light_from_highlight(picture, circle, mask=counts)
                    error = f"  # {FROM_OUTLINE}" if direction[2] < FAR_BEHIND else ""
            lines.append(" ".join(f"{value:.6f}" for value in direction) + error)
    text = "\n".join(lines)
    if out is not None:
        write_text(out, text + "\n")
    show(text if out is None else f"wrote {out}")
