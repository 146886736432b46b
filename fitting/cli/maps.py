"""``brdf maps``: a material for every pixel of one view under many lights."""

import shutil
from pathlib import Path
from typing import Annotated

import typer

from brdf.files import check_folder
from fitting.cli.common import Encoding, Precision, Report, check_page, named_as, show, use_compilation_cache
from fitting.cli.devices import all_devices, is_first_process
from fitting.progress import waiting

EXAMPLE = "Example: [bold]brdf maps photographs/ --normals fit --out maps/[/bold]"

# Below --out, while the maps are being fitted: what is done, from which the same command goes on after an interruption.
BANDS = "bands"


def maps(
    target: Annotated[
        Path, typer.Argument(help="A folder of photographs with an .lp file, or with light_directions.txt.")
    ],
    normals: Annotated[
        str | None,
        typer.Option(help="An image or .npy of normals, or fit; default: the folder's normals.*, else fit."),
    ] = None,
    out: Annotated[Path | None, typer.Option(help="A folder for maps.exr, 16-bit images, glTF and OpenLIME.")] = None,
    model: Annotated[
        str, typer.Option(help="blinn-phong, phong, a normalised form, lambert, or auto.")
    ] = "blinn-phong",
    grey: Annotated[bool, typer.Option("--grey", help="All channels share k_s.")] = False,
    labels: Annotated[
        str | None, typer.Option(help="An image: pixels of one value there share n; or all: every pixel does.")
    ] = None,
    mask: Annotated[Path | None, typer.Option(help="An image: pixels that are 0 there are left out.")] = None,
    ambient: Annotated[
        bool, typer.Option("--ambient", help="The view is lit from all around too: find k_a for that light as 1.")
    ] = False,
    flip_y: Annotated[bool, typer.Option("--flip-y", help="y goes down in the file of normals.")] = False,
    encoding: Encoding = None,
    plot: Annotated[bool, typer.Option("--plot", help="Also draw maps.png into --out.")] = False,
    report: Report = None,
    precision: Precision = "float32",
    devices: Annotated[
        str | None, typer.Option(help="all: every core, accelerator and process that Slurm or mpirun has started.")
    ] = None,
) -> None:
    """Fit k_d, k_s, n and normals to every pixel of photographs under many lights."""
    from brdf.errors import InputError

    if plot and out is None:
        raise InputError("--plot", "needs a folder to draw into", "Add --out DIR")
    check_page(report)
    if out is not None:
        check_folder(out)
        if out.resolve() == target.resolve():
            came = "is the folder of the photographs, whose normals.* and mask.* are read"
            raise InputError("--out", came, "Give another folder")
    mesh = all_devices(devices)
    use_compilation_cache()
    import fitting

    with waiting("fitting"), named_as({"pictures": target}):
        found = fitting.fit_maps(
            target,
            normals=normals,
            model=model,
            specular="grey" if grey else "coloured",
            labels=0 if labels == "all" else labels,
            mask=mask,
            ambient=1.0 if ambient else None,
            flip_y=flip_y,
            encoding=encoding,
            precision=precision,  # pyright: ignore[reportArgumentType]
            mesh=mesh,
            keep=None if out is None else out / BANDS,
        )
        if not is_first_process(mesh):
            return
        if out is not None:
            found.save(out, plot=plot)
            shutil.rmtree(out / BANDS, ignore_errors=True)
        if report is not None:
            found.view(f"Maps of {target.resolve().name}").save(report)
    saved = "nothing saved: give --out DIR" if out is None else f"saved in {out}"
    show("\n".join([str(found), saved, *([] if report is None else [f"wrote {report}"])]))
