"""``brdf convert``: a material for another program."""

from pathlib import Path

import typer

import brdf
from fitting.cli.common import find_material, refuse_replacing, show, table_name


def convert(material: str, out: Path, *, to: str | None = None, name: str | None = None) -> None:
    """Write a material as three.js, glTF, Mitsuba, PyTorch3D, GLSL or Wavefront read it, and say what is lost.

    Args:
        material: a .json or .mtl file, a folder of brdf fit --out, or a name of the classic table.
        out: the file to write: .json .mtl .gltf .xml (Mitsuba) .glsl .py (PyTorch3D); or - for standard output.
        to: json, mtl, three, gltf, mitsuba, mitsuba-dict, pytorch3d, glsl; default: by the suffix, json with -.
        name: which material, where an MTL file holds several.

    Example:
        brdf convert material.json material.gltf
        From the classic table: brdf convert emerald emerald.json --to three
    """
    loaded, note = find_material(material, name)
    called = name or table_name(material) or Path(material).stem
    named = {"name": "_".join(called.split()), "note": note}
    piped = str(out) == "-"
    if piped:
        export = brdf.export_material(loaded, to or "json", **named)
        show(export.text.rstrip("\n"))
    else:
        refuse_replacing([Path(material), Path(material, "material.json")], out)
        export = brdf.save_export(loaded, out, to=to, **named)
        show(f"wrote {out}")
    notes = [f"note: {note}"] if note else []
    for line in [*notes, *(f"not carried: {loss}" for loss in export.losses)]:
        typer.echo(f"  {line}", err=piped)
