"""A fit as files."""

import json
from pathlib import Path
from typing import Any

import brdf
from brdf.files import atomic_folder, write_text
from fitting.result import FitResult


def write_report(stage: Path, result: Any) -> None:
    """Write material.json, material.mtl (of 1 or 3 channels) and fit.json.

    Args:
        stage: a folder that is there.
        result: with ``material``, ``undetermined`` and ``to_dict()``.
    """
    names = ["material.json", *(["material.mtl"] if result.material.k_d.shape[0] in (1, 3) else [])]
    for name in names:
        brdf.save_material(result.material, stage / name, undetermined=result.undetermined)
    write_text(stage / "fit.json", json.dumps(result.to_dict(), indent=2) + "\n")


def save(result: FitResult, folder: str | Path, plot: bool) -> None:
    """Write what `FitResult.save` promises: all of it or nothing.

    Args:
        result: of a fit.
        folder: made where missing.
        plot: also comparison.png.

    Raises:
        InputError: where the folder cannot be written.
    """
    with atomic_folder(folder) as stage:
        write_report(stage, result)
        brdf.write_image(stage / "fitted.exr", result.fitted())
        if plot:
            result.plot().savefig(stage / "comparison.png", dpi=150)
