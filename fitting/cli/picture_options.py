"""The options that say what pictures show, which ``brdf fit`` and ``brdf tradeoff`` share."""

import functools
import inspect
import typing
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import typer

_PANEL = "What the pictures show"
ENCODINGS = "linear, srgb or a gamma; default: what the file says."


def _option(said: str, *names: str) -> Any:
    return typer.Option(*names, help=said, rich_help_panel=_PANEL)


class PictureOptions(NamedTuple):
    """What the options say of the pictures, as typed; None where not given. Their help is their description."""

    scene: Annotated[Path | None, _option("The scene file; in a folder, scene.toml.")] = None
    within: Annotated[
        Path | None, _option("The folder that paths in the scene file may not leave; default: its own.")
    ] = None
    sphere: Annotated[
        str | None,
        _option("A ball in the photograph: x,y,radius in pixels from the upper left one, or mask: found in --mask."),
    ] = None
    normals: Annotated[
        Path | None, _option("Normals of the pixels: an image or .npy; x right, y up, z to the camera.")
    ] = None
    light: Annotated[
        str | None, _option("Towards the light: x,y,z (right, up, to the camera), or fit: from the shading.")
    ] = None
    lights: Annotated[Path | None, _option("A text file with such a direction for each picture.")] = None
    intensities: Annotated[Path | None, _option("A text file with the light's intensity for each picture.")] = None
    ambient: Annotated[
        bool, _option("A photograph is lit from all around too: find k_a for that light as 1.", "--ambient")
    ] = False
    encoding: Annotated[str | None, _option(ENCODINGS)] = None
    exposure: Annotated[str | None, _option("Relative exposure to divide by, one or one each.")] = None
    mask: Annotated[Path | None, _option("An image: pixels that are 0 there are left out.")] = None
    saturation: Annotated[float | None, _option("Linear values from here on are clipped, not data.")] = None

    def names(self) -> dict[str, Any]:
        """What a person typed for the arguments of the functions behind, for messages."""
        return {"mask": self.mask, "saturation": "--saturation", "encoding": "--encoding"}


def takes_picture_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Give a command an option for each field of `PictureOptions`, in place of its parameter ``pictures``.

    Args:
        command: has the parameter.
    """
    hints = typing.get_type_hints(PictureOptions, include_extras=True)
    options = [
        inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=hints[name])
        for name, default in PictureOptions._field_defaults.items()
    ]

    @functools.wraps(command)
    def with_options(**given: Any) -> Any:
        pictures = PictureOptions(**{name: given.pop(name) for name in PictureOptions._fields})
        return command(pictures=pictures, **given)

    own = inspect.signature(command)
    parameters = [one.replace(kind=one.KEYWORD_ONLY) for one in own.parameters.values() if one.name != "pictures"]
    with_options.__signature__ = own.replace(parameters=[*parameters, *options])  # pyright: ignore[reportAttributeAccessIssue]
    return with_options


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
