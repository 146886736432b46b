"""``brdf convert``: a material for another program."""

from pathlib import Path
from typing import Annotated

import typer

import brdf
from fitting.cli.common import AMaterial, find_material, show, use_compilation_cache

EXAMPLE = (
    "Example: [bold]brdf convert material.json material.gltf[/bold]\n\n"
    "From the classic table: [bold]brdf convert emerald emerald.json --to three[/bold]"
)


def convert(
    material: AMaterial,
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
    use_compilation_cache()
    loaded, called, note = find_material(material, name)
    export = brdf.save_export(loaded, out, to=to, name="_".join(called.split()), note=note)
    notes = [f"  note: {note}"] if note else []
    show("\n".join([f"wrote {out}", *notes, *(f"  not carried: {loss}" for loss in export.losses)]))
