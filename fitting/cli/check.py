"""``brdf check``: whether a material is physically plausible."""

from pathlib import Path
from typing import Any

import brdf
from brdf.errors import InputError
from brdf.files import atomic_path
from fitting.cli.common import show, table_name
from fitting.progress import waiting

# What a drawing may be written as.
DRAWN = (".png", ".pdf", ".svg", ".jpg")


def check(material: str, *, json: bool = False, plot: Path | None = None) -> int:
    """Is a material plausible: positive, reciprocal, energy conserving? Exit 0 if so, 1 if not, 2 if it cannot tell.

    Args:
        material: a .json, .mtl (all its materials) or measured BRDF file, a folder of brdf fit --out, or a name.
        json: print JSON instead of text.
        plot: a picture of albedo, lobe and reciprocity to write.

    Example:
        brdf check material.json
        In CI: brdf check scene.mtl --json
        From the classic table: brdf check emerald
    """
    from brdf.measured.loading import is_measured

    if plot is not None and plot.suffix.lower() not in DRAWN:
        raise InputError(plot, "is no name of a picture", f"Name it {', '.join(DRAWN)}")
    with waiting("checking"):
        found: dict[str, tuple[Any, str]]
        if is_measured(material):
            if plot is not None:
                remedy = f"Fit a material to it with brdf fit {material} --out DIR, and check DIR/material.json"
                raise InputError("--plot", f"draws materials, and {material} is a measured table", remedy)
            found = {Path(material).stem: (brdf.load_measured(material), "")}
        elif key := table_name(material):
            found = {key: (brdf.preset(key), "")}
        else:
            from brdf.materials.material_file import read_materials

            found = read_materials(material)
        if plot is not None and len(found) > 1:
            raise InputError("--plot", f"draws one material, {material} holds {len(found)}", "Give one")
        reports = {name: brdf.check(one, name=name) for name, (one, _) in found.items()}
        if plot is not None:
            from fitting.report.material_plots import overview

            with atomic_path(plot) as path:
                for name, (one, _) in found.items():
                    overview(one, reports[name]).savefig(path)
    notes = {name: {"note": note} if note else {} for name, (_, note) in found.items()}
    if json:
        show({name: report.to_json() | notes[name] for name, report in reports.items()})
    else:
        lines = ["\n  note: ".join([str(report), *notes[name].values()]) for name, report in reports.items()]
        show("\n\n".join(lines))
    verdicts = [report.plausible for report in reports.values()]
    return 1 if False in verdicts else 2 if None in verdicts else 0
