"""``brdf convert``: a material for another program."""

from pathlib import Path
from typing import Annotated, Any

import typer

EXAMPLE = (
    "Example: [bold]brdf convert material.json material.gltf[/bold]    or, from the classic table: "
    "[bold]brdf convert emerald emerald.json --to three[/bold]"
)


def convert(
    material: Annotated[str, typer.Argument(help="A .json or .mtl file, or a name of the classic table: emerald.")],
    out: Annotated[
        Path, typer.Argument(help="The file to write: .json .mtl .gltf .xml (Mitsuba) .glsl .py (PyTorch3D).")
    ],
    to: Annotated[
        str | None,
        typer.Option(help="json, mtl, three, gltf, mitsuba, mitsuba-dict, pytorch3d, glsl; default: by the suffix."),
    ] = None,
    name: Annotated[str | None, typer.Option(help="Which material, where an MTL file holds several.")] = None,
) -> None:
    """Write a material as three.js, glTF, Mitsuba, PyTorch3D, GLSL or Wavefront read it, and say what is lost."""
    import brdf

    loaded, called = _material(material, name)
    try:
        export = brdf.save_export(loaded, out, to=to, name="_".join(called.split()))
    except brdf.InputError as error:
        if error.where == "to":
            raise brdf.InputError("--to", error.what, error.remedy) from None
        raise
    for line in (f"wrote {out}", *(f"  not carried: {loss}" for loss in export.losses)):
        print(line)  # noqa: T201  # this is the command's output


def _material(material: str, name: str | None) -> tuple[Any, str]:
    """A material of a file or of the classic table, and what it is called; a file goes before a name of the table."""
    import brdf

    path, key = Path(material), material.strip().lower().replace(" ", "_").replace("-", "_")
    if key in brdf.PRESETS and not path.is_file():
        if name is not None:
            raise brdf.InputError("--name", f"chooses from a file, and {key} is one material", "Leave it out")
        return brdf.preset(key), key
    if not path.suffix and not path.exists():
        names = ", ".join(brdf.PRESETS)
        came = "is no material file and no name of the classic table"
        raise brdf.InputError(material, came, f"Give a .json or .mtl file, or one of {names}")
    return brdf.load_material(material, name), name or path.stem
