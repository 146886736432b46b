"""A fit as files, and back."""

import hashlib
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import brdf
from brdf.errors import InputError
from brdf.files import as_path, atomic_folder, read_text, write_text
from brdf.materials.material_file import material_from_dict
from fitting.budget.choice import Attempt, BudgetChoice
from fitting.result import FitResult, Parameter
from fitting.selection import Candidate
from fitting.solver.profile import Optimum


def write_report(stage: Path, result: Any, plot: bool, **further: Any) -> None:
    """Write material.json, material.mtl (of 1 or 3 channels), fit.json and, where it is wanted, comparison.png.

    The result has ``material``, ``undetermined``, ``to_dict()`` and ``plot()``; ``further`` is held by fit.json, too,
    and the names of all files of the set, of which this is the last.
    """
    for suffix in ("json", "mtl") if result.material.k_d.size in (1, 3) else ("json",):
        brdf.save_material(result.material, stage / f"material.{suffix}", undetermined=result.undetermined)
    if plot:
        result.plot().savefig(stage / "comparison.png", dpi=150)
    further["written"] = sorted(["fit.json", *(file.name for file in stage.iterdir())])
    write_text(stage / "fit.json", json.dumps(result.to_dict() | further, indent=2) + "\n")


def outdated(folder: str | Path, files: Sequence[Any] = ()) -> set[str]:
    """What the fit that was saved in a folder has written there, but for pictures that the next one was fitted to."""
    try:
        written = json.loads((as_path(folder) / "fit.json").read_bytes())["written"]
        read = {Path(file["path"]).resolve() for file in files if file}
        return {name for name in written if name == Path(name).name and (Path(folder) / name).resolve() not in read}
    except (OSError, ValueError, KeyError, TypeError):
        return set()  # there is none, or of another version


def save(result: FitResult, folder: str | Path, plot: bool) -> None:
    """Write what `FitResult.save` promises: all of it or nothing."""
    with atomic_folder(folder, outdated(folder, result.files)) as stage:
        pictures = [_write_picture(stage, result, index) for index in range(len(result.scenes))]
        arrays = dict(vars(result.optimum)) if result.optimum else {}
        for name, images in (("counted", result.counted), ("weights", result.weights)):
            arrays |= {f"{name}{index}": image for index, image in enumerate(images) if image is not None}
        np.savez_compressed(stage / "fit.npz", **arrays)
        brdf.write_image(stage / "fitted.exr", result.fitted())
        write_report(stage, result, plot, pictures=pictures)


def _write_picture(stage: Path, result: FitResult, index: int) -> dict[str, Any]:
    """Write one scene, and its picture where no file holds it; what fit.json says of them."""
    scene, file, number = result.scenes[index], result.files[index] if result.files else None, index or ""
    is_shared = index > 0 and scene.points is not None and scene.points is result.scenes[0].points
    scene.save(stage / f"scene{number}.toml", aov="scene.aov.exr" if is_shared else None)
    if result.left_out.get("masked"):
        brdf.write_image(stage / f"mask{number}.png", np.asarray(result.counted[index], np.float32)[..., None])
    if file is None:
        path = stage / f"target{number}.exr"
        brdf.write_image(path, np.asarray(result.targets[index], np.float32))
        file = {"path": path.name, "encoding": "linear", "factor": 1.0}
    else:
        path = Path(file["path"]).absolute()
        file = file | {"path": str(path)}
    return file | {"sha256": _checked(path, file), "scene": f"scene{number}.toml"}


def _checked(path: Path, file: dict[str, Any]) -> str:
    """The digest of a picture, refused where it is known not to be what was fitted."""
    try:
        with path.open("rb") as opened:
            found = hashlib.file_digest(opened, "sha256").hexdigest()
    except OSError as error:
        remedy = "Put it there again, or beside fit.json"
        raise InputError(path, f"which was fitted, cannot be read ({error.strerror})", remedy) from None
    if file.get("sha256", found) != found:
        raise InputError(path, "is not what was fitted, it has changed since", "Put that back, or fit again")
    return found


def _place(folder: Path, file: dict[str, Any]) -> Path:
    """Where a picture is, or beside fit.json where it has moved."""
    path, beside = folder / file["path"], folder / Path(file["path"]).name
    return beside if beside.is_file() and not path.is_file() else path


@dataclass(frozen=True)
class _Pictures(Sequence[np.ndarray]):
    """The pictures of a saved fit, read when they are asked for, if they still are what was fitted."""

    folder: Path
    files: list[dict[str, Any]]
    precision: str

    def __len__(self) -> int:
        return len(self.files)

    def __getitem__(self, index: Any) -> Any:
        file = self.files[index]
        path = _place(self.folder, file)
        _checked(path, file)
        picture = brdf.read_picture(path, encoding=file["encoding"]).scaled(np.asarray(file["factor"]))
        return picture.pixels.astype(self.precision)


def load_result(folder: str | Path) -> FitResult:
    """Read a fit that `FitResult.save` or ``brdf fit --out`` wrote: to report, plot or render it.

    Args:
        folder: as it was written, or the fit.json in it.

    Returns:
        The result. A picture that was in a file is read again when it is asked for; where that file has moved it is
        looked for beside fit.json.

    Raises:
        InputError: where there is no such fit; when a picture is asked for, where it is gone or not what was fitted.

    Example:
        >>> target, scene = brdf.read_picture("target.exr"), brdf.Scene.load("scene.toml")
        >>> fitting.fit(target, scene, model="blinn-phong").save("saved")
        >>> result = fitting.load_result("saved")
        >>> round(float(result["n"]), 2), result.targets[0].shape
        (51.2, (32, 32, 3))
    """
    path = as_path(folder)
    path = path if path.suffix.lower() == ".json" else path / "fit.json"
    folder = path.parent
    try:
        values = json.loads(read_text(path))
        if "table" in values:
            remedy = "Its material is what brdf.load_material reads"
            raise InputError(path, "is the fit of a measured BRDF, which holds no picture", remedy)
        pictures = values.pop("pictures")
        with np.load(folder / "fit.npz") as arrays:
            arrays = dict(arrays)
        optimum = {name: arrays[name][()] for name in Optimum.__dataclass_fields__ if name in arrays}
        values |= {
            "material": material_from_dict(values["material"]),
            "parameters": tuple(map(_parameter, values["parameters"])),
            "noise": np.array(values["noise"]),
            "warnings": tuple(values["warnings"]),
            "candidates": tuple(Candidate(**one) for one in values["candidates"]),
            "correlation": np.array(values["correlation"]["matrix"]),
            "optimum": Optimum(**optimum) if optimum else None,
            "choice": _choice(**values["choice"]) if values["choice"] else None,
            "targets": _Pictures(folder, pictures, values["precision"]),
            "scenes": [brdf.Scene.load(folder / picture["scene"]) for picture in pictures],
            "counted": [arrays[f"counted{index}"] for index in range(len(pictures))],
            "weights": [arrays.get(f"weights{index}") for index in range(len(pictures))],
            # What was an array is one again, and stands in no file of its own.
            "files": [
                file | {"path": str(_place(folder, file))} if Path(file["path"]).is_absolute() else None
                for file in pictures
            ],
        }
        return FitResult(**{name: values[name] for name in FitResult.__dataclass_fields__ if name in values})
    except InputError:
        raise
    except (KeyError, TypeError, ValueError, OSError) as error:
        raise InputError(path, f"is no fit that this version saved ({error})", "Fit and save again") from None


def _parameter(values: dict[str, Any]) -> Parameter:
    low, high = values["interval"] or (None, None)
    ends = (-math.inf if low is None else low, math.inf if high is None else high)
    direction = values["direction"] and tuple(values["direction"])
    values |= {"interval": values["interval"] and ends, "reason": values["reason"] or "", "direction": direction}
    return Parameter(**values)


def _choice(basis, attempts, **values):
    return BudgetChoice(**values, attempts=tuple(Attempt(**one) for one in attempts))
