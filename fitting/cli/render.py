"""``brdf render``: a picture of a material in a scene."""

from pathlib import Path
from typing import Annotated

import typer

import brdf
from brdf.errors import InputError
from fitting.cli.common import AMaterial, Precision, find_material, named_as, show, use_compilation_cache
from fitting.progress import waiting

EXAMPLE = (
    "Example: [bold]brdf render material.json --scene scene.toml -o picture.exr[/bold]\n\n"
    "What brdf fit --out wrote: [bold]brdf render out/ -o picture.exr[/bold]\n\n"
    "From the classic table: [bold]brdf render emerald --scene scene.toml -o emerald.png[/bold]"
)


def render(
    material: AMaterial,
    out: Annotated[Path, typer.Option("--out", "-o", help="The picture to write: .exr, .hdr, .png, .tiff or .jpg.")],
    scene: Annotated[
        Path | None, typer.Option(help="The scene file; default: that of a folder that brdf fit wrote.")
    ] = None,
    precision: Precision = "float32",
) -> None:
    """Render a material in a scene."""
    with waiting("rendering"), named_as({"material": material}):
        use_compilation_cache()
        loaded, *_ = find_material(material)
        if scene is None:
            scene = (Path(material) if Path(material).is_dir() else Path(material).parent) / "scene.toml"
            if Path(material).suffix == ".mtl" or not scene.is_file():
                raise InputError("--scene", "is missing", "Add --scene SCENE.toml")
        image = brdf.render(loaded, brdf.Scene.load(scene), precision=precision)  # pyright: ignore[reportArgumentType]
        brdf.write_image(out, image)
    show(f"wrote {out}")
