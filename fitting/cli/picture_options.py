"""The options that say what pictures show, which ``brdf fit`` and ``brdf tradeoff`` share."""

from pathlib import Path
from typing import Annotated, Any

import typer

SceneFile = Annotated[Path | None, typer.Option("--scene", help="The scene file; in a folder, scene.toml.")]
Within = Annotated[Path | None, typer.Option("--within", help="The folder that paths in the scene file may not leave.")]
Encoding = Annotated[
    str | None, typer.Option("--encoding", help="linear, srgb or a gamma; default: what the file says.")
]
Saturation = Annotated[
    float | None, typer.Option("--saturation", help="Linear values from here on are clipped, not data.")
]
Mask = Annotated[Path | None, typer.Option("--mask", help="An image: pixels that are 0 there are left out.")]
Sphere = Annotated[
    str | None,
    typer.Option("--sphere", help="A ball in the photograph: x,y,radius in pixels from the upper left one, or: mask."),
]
Normals = Annotated[
    Path | None, typer.Option("--normals", help="Normals of the pixels: an image or .npy, x right, y up.")
]
Light = Annotated[
    str | None,
    typer.Option("--light", help="Towards the light: x,y,z (right, up, to the camera), or fit: from the shading."),
]
Lights = Annotated[Path | None, typer.Option("--lights", help="A text file with such a direction for each picture.")]
Intensities = Annotated[
    Path | None, typer.Option("--intensities", help="A text file with the light's intensity for each.")
]
Ambient = Annotated[
    bool,
    typer.Option("--ambient", help="A photograph is lit from all around too: find k_a for that light as 1."),
]
Exposure = Annotated[
    str | None, typer.Option("--exposure", help="Relative exposure, one or one each: values are divided.")
]


def encoding_of(text: str | None) -> Any:
    """An encoding as typed: a gamma becomes a number.

    Args:
        text: what was typed, or None.
    """
    if text is None:
        return None
    try:
        return float(text)
    except ValueError:
        return text
