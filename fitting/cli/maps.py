"""``brdf maps``: a material for every pixel of one view under many lights."""

import shutil
from pathlib import Path
from typing import Any

from brdf.errors import InputError
from fitting.cli.common import OF_MAPS, all_devices, check_outputs, is_first_process, named_as, show
from fitting.progress import waiting

# Below --out, while the maps are being fitted: what is done, from which the same command goes on after an interruption.
BANDS = "bands"


def maps(
    target: Path,
    *,
    normals: str | None = None,
    out: Path | None = None,
    model: str = "blinn-phong",
    grey: bool = False,
    labels: str | None = None,
    mask: Path | None = None,
    ambient: bool = False,
    flip_y: bool = False,
    saturation: float | None = None,
    encoding: Any = None,
    plot: bool = False,
    report: Path | None = None,
    precision: Any = "float32",
    devices: str | None = None,
) -> None:
    """Fit k_d, k_s, n and normals to every pixel of photographs under many lights.

    Args:
        target: a folder of photographs with an .lp file, or with light_directions.txt.
        normals: an image or .npy of normals, or fit; default: the folder's normals.*, else fit.
        out: a folder for maps.exr, 16-bit images, glTF and OpenLIME.
        model: blinn-phong, phong, a normalised form, lambert, or auto.
        grey: all channels share k_s.
        labels: an image: pixels of one colour there share n; or all: every pixel does.
        mask: an image: pixels that are 0 there are left out.
        ambient: the view is lit from all around too: find k_a for that light as 1.
        flip_y: y goes down in the file of normals.
        saturation: linear values from here on are clipped, not data.
        encoding: linear, srgb or a gamma; default: what the file says.
        plot: also draw maps.png into --out.
        report: one .html page with everything, to keep or to send.
        precision: float32 or float64.
        devices: all: every core, accelerator and process that Slurm or mpirun has started.

    Example:
        brdf maps photographs/ --normals fit --out maps/
    """
    named = (Path(one) for one in (normals, labels, mask) if one not in (None, "fit", "all"))
    check_outputs(out, plot, report, named, OF_MAPS)
    if out is not None and out.resolve() == target.resolve():
        what = "is the folder of the photographs, whose normals.* and mask.* are read"
        raise InputError("--out", what, "Give another folder")
    mesh = all_devices(devices)
    import fitting

    with named_as({"pictures": target}):
        found = fitting.fit_maps(
            target,
            normals=normals,
            model=model,
            specular="grey" if grey else "coloured",
            labels=0 if labels == "all" else labels,
            mask=mask,
            ambient=1.0 if ambient else None,
            flip_y=flip_y,
            saturation=saturation,
            encoding=encoding,
            precision=precision,
            mesh=mesh,
            keep=None if out is None else out / BANDS,
        )
    if not is_first_process(mesh):
        return
    with waiting("saving"):
        if out is not None:
            found.save(out, plot=plot)
            shutil.rmtree(out / BANDS, ignore_errors=True)
        if report is not None:
            found.view(f"Maps of {target.resolve().name}").save(report)
    saved = "nothing saved: give --out DIR" if out is None else f"saved in {out}"
    show("\n".join([str(found), saved, *([] if report is None else [f"wrote {report}"])]))
