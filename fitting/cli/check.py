"""``brdf check``: whether a material is physically plausible."""

import json
from pathlib import Path
from typing import Annotated, Any

import typer

import brdf
from brdf.errors import InputError
from brdf.files import atomic_path
from fitting.cli.common import AsJson, find_materials, show, use_compilation_cache
from fitting.progress import waiting

EXAMPLE = (
    "Example: [bold]brdf check material.json[/bold]\n\n"
    "In CI: [bold]brdf check scene.mtl --json[/bold]\n\n"
    "From the classic table: [bold]brdf check emerald[/bold]"
)


def check(
    material: Annotated[
        str,
        typer.Argument(
            help="A .json, .mtl (all its materials) or measured BRDF file, a folder of brdf fit --out, or a name."
        ),
    ],
    as_json: AsJson = False,
    plot: Annotated[Path | None, typer.Option(help="A picture of albedo, lobe and reciprocity to write.")] = None,
) -> int:
    """Is a material plausible: positive, reciprocal, energy conserving? Exit 0 if so, 1 if not, 2 if it cannot tell."""
    from brdf.measured.loading import is_measured

    with waiting("checking"):
        is_table = is_measured(material)
        if is_table and plot is not None:
            remedy = f"Fit a material to it with brdf fit {material} --out DIR, and check DIR/material.json"
            raise InputError("--plot", f"draws materials, and {material} is a measured table", remedy)
        use_compilation_cache()
        found: dict[str, tuple[Any, str]] = (
            {Path(material).stem: (brdf.load_measured(material), "")} if is_table else find_materials(material)
        )
        reports = {name: (brdf.check(one, name=name), note) for name, (one, note) in found.items()}
        if plot is not None:
            if len(found) > 1:
                raise InputError("--plot", f"draws one material, {material} holds {len(found)}", "Give one")
            from fitting.report.material_plots import overview

            with atomic_path(plot) as path:
                for name, (one, _) in found.items():
                    overview(one, reports[name][0]).savefig(path)
    if as_json:
        told = {name: report.to_json() | ({"note": note} if note else {}) for name, (report, note) in reports.items()}
        show(json.dumps(told, indent=2))
    else:
        show("\n\n".join(f"{report}\n  note: {note}" if note else str(report) for report, note in reports.values()))
    verdicts = [report.plausible for report, _ in reports.values()]
    return 1 if False in verdicts else 2 if None in verdicts else 0
