"""``brdf render``: a picture of a material in a scene."""

from pathlib import Path
from typing import Annotated

import typer

import brdf
from fitting.cli.common import AMaterial, Precision, find_material, named_as, show, use_compilation_cache, waiting

EXAMPLE = (
    "Example: [bold]brdf render material.json --scene scene.toml -o picture.exr[/bold]\n\n"
    "From the classic table: [bold]brdf render emerald --scene scene.toml -o emerald.png[/bold]"
)


def render(
    material: AMaterial,
    scene: Annotated[Path, typer.Option(help="The scene file.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="The picture to write: .exr, .hdr, .png, .tiff or .jpg.")],
    precision: Precision = "float32",
) -> None:
    """Render a material in a scene."""
    with waiting("rendering"), named_as({"material": material}):
        use_compilation_cache()
        loaded, _ = find_material(material)
        image = brdf.render(loaded, brdf.Scene.load(scene), precision=precision)  # pyright: ignore[reportArgumentType]
        brdf.write_image(out, image)
    show(f"wrote {out}")
