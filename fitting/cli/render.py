"""``brdf render``: a picture of a material in a scene."""

from pathlib import Path
from typing import Any

import brdf
from brdf.errors import InputError
from brdf.files import read_toml
from fitting.cli.common import find_material, named_as, refuse_replacing, show
from fitting.progress import waiting


def render(material: str, *, out: Path, scene: Path | None = None, precision: Any = "float32") -> None:
    """Render a material in a scene.

    Args:
        material: a .json or .mtl file, a folder of brdf fit --out, or a name of the classic table.
        out: the picture to write: .exr, .hdr, .png, .tiff or .jpg.
        scene: the scene file; default: scene.toml beside the file of the material, where brdf fit writes it.
        precision: float32 or float64.

    Example:
        brdf render material.json --scene scene.toml -o picture.exr
        What brdf fit --out wrote: brdf render out/ -o picture.exr
        From the classic table: brdf render emerald --scene scene.toml -o emerald.png
    """
    with waiting("rendering"), named_as({"material": material}):
        loaded, _ = find_material(material)
        if scene is None:
            scene = (Path(material) if Path(material).is_dir() else Path(material).parent) / "scene.toml"
            if Path(material).suffix == ".mtl" or not (Path(material).exists() and scene.is_file()):
                raise InputError("--scene", "is missing", "Add --scene SCENE.toml")
        import jax

        tables = read_toml(scene)
        shown = brdf.Scene.load(scene, tables=tables)
        refuse_replacing([scene.parent / word for word in jax.tree.leaves(tables) if isinstance(word, str)], out)
        brdf.write_image(out, brdf.render(loaded, shown, precision=precision))
    show(f"wrote {out}")
