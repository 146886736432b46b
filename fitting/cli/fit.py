"""``brdf fit``: pictures, photographs of a ball, archives and measured BRDFs."""

import dataclasses
import json
import shlex
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer

import brdf
from brdf.errors import InputError
from brdf.files import check_folder, write_text
from fitting.cli.common import (
    AsJson,
    Model,
    PictureOptions,
    Precision,
    Report,
    check_page,
    named_as,
    show,
    use_compilation_cache,
)
from fitting.cli.devices import all_devices, is_first_process
from fitting.progress import waiting

EXAMPLE = "\n\n".join(
    [
        "Example: [bold]brdf fit photo.exr --scene scene.toml --out result/[/bold]",
        "A folder with target.exr and scene.toml: [bold]brdf fit data/gold-ball[/bold]",
        "A photo of a ball: [bold]brdf fit ball.png --sphere 244.5,144.5,108 --light fit[/bold]",
        "A measured BRDF: [bold]brdf fit gold.binary[/bold]",
    ]
)
LOSS_NAMES = "squared, relative, log, huber or cauchy; for a measured BRDF cosine (its default), squared or log"


def fit(
    target: Annotated[
        list[Path],
        typer.Argument(help="A picture; a folder with target.* and scene.toml; photographs; an .npz; a measured BRDF."),
    ],
    pictures: PictureOptions,
    model: Model = "auto",
    out: Annotated[Path | None, typer.Option(help="A folder for material.json, material.mtl, fitted.exr, ...")] = None,
    precision: Precision = "float32",
    dark: Annotated[float | None, typer.Option(help="Linear values up to here are too dark to count.")] = None,
    noise: Annotated[
        str | None, typer.Option(help="READ,SHOT of the camera: the variance is READ² + SHOT·value.")
    ] = None,
    plausible: Annotated[
        bool, typer.Option("--plausible", help="Hold k_d + k_s <= 1 with a normalised form: brdf check then passes.")
    ] = False,
    loss: Annotated[str | None, typer.Option(help=f"{LOSS_NAMES}.")] = None,
    accuracy: Annotated[
        float | None, typer.Option(help="Relative error that is good enough: as few pixels and samples as keep it.")
    ] = None,
    seconds: Annotated[float | None, typer.Option(help="Time to spend: the most accurate fit that it buys.")] = None,
    free: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME", help="light, intensity, ball or radius: fitted as well, from where the scene says."
        ),
    ] = None,
    devices: Annotated[
        str | None, typer.Option(help="all: spread the pixels over all cores or accelerators, and processes.")
    ] = None,
    plot: Annotated[bool, typer.Option("--plot", help="Also draw comparison.png into --out.")] = False,
    report: Report = None,
    as_json: AsJson = False,
) -> None:
    """Fit a model to a picture: value ± error of every parameter, with no guess to give."""
    from brdf.measured.loading import is_measured

    if plot and out is None:
        raise InputError("--plot", "needs a folder to draw into", "Add --out DIR")
    apart = {"--noise": noise, "--plausible": plausible, "--loss": loss, "--accuracy": accuracy, "--seconds": seconds}
    if free and any(apart.values()):
        came = f"knows nothing of {' and '.join(option for option, given in apart.items() if given)}"
        raise InputError("--free", came, "Leave one of them out")
    check_page(report)
    if out is not None:
        # Told now instead of after the fit.
        check_folder(out)
    notes: tuple[str, ...] = ()
    mesh = all_devices(devices)
    with waiting("reading") as say:
        if len(target) == 1 and is_measured(target[0]):
            if any([*pictures, dark, noise, plausible, accuracy, seconds, free, report, mesh, precision != "float32"]):
                came = "is a measured BRDF; of the options only --model, --loss, --out, --plot and --json concern it"
                raise InputError(target[0], came, "Leave the others out")
            table = brdf.load_measured(target[0])
            use_compilation_cache()
            import fitting

            say("fitting")
            with named_as({table.name: target[0]}):
                result = fitting.fit_brdf(table, model, loss=loss or "cosine")  # pyright: ignore[reportArgumentType]
        else:
            result, notes = _fit_pictures(
                target,
                pictures,
                noise,
                say,
                model=model,
                precision=precision,
                saturation=pictures.saturation,
                dark=dark,
                plausible=plausible,
                loss=loss or "squared",
                accuracy=accuracy,
                seconds=seconds,
                mesh=mesh,
            )
            if free:
                say("fitting jointly")
                result = _freed(result, free)
        if not is_first_process(mesh):
            return
        if out is not None:
            say("saving and drawing" if plot else "saving")
            result.save(out, **({"plot": True} if plot else {}))
        if report is not None:
            say("drawing the page")
            from fitting.report.html import report_page

            command = shlex.join(["brdf", *sys.argv[1:]])
            page = report_page(result, source=target[0].name, command=command)  # pyright: ignore[reportArgumentType]
            write_text(report, page)
    if as_json:
        show(json.dumps(result.to_dict() | ({"notes": notes} if notes else {}), indent=2))
        return
    saved = [] if out is None else [f"saved in {out}"]
    written = [] if report is None else [f"wrote {report}"]
    show("\n".join([*notes, str(result), *saved, *written]))


def _freed(result: Any, names: list[str]) -> Any:
    """The fit again, with what the names say of the scenes freed; where a command was told so, beside the material."""
    import fitting

    # As in their files: what was read has forgotten its codes.
    targets = [
        target if file is None else brdf.read_picture(file["path"], encoding=file["encoding"]).scaled(file["factor"])
        for target, file in zip(result.targets, result.files or [None] * len(result.targets), strict=True)
    ]
    with named_as({"free": "--free"}):
        found = fitting.fit_jointly(targets, result.scenes, result.material, names, mask=result.counted)
    return dataclasses.replace(found, files=result.files, candidates=result.candidates)


def _fit_pictures(
    target: Any, pictures: Any, noise: Any, say: Callable[[str], None], **how: Any
) -> tuple[Any, tuple[str, ...]]:
    """The fit, and what was found out on the way."""
    from fitting.cli.inputs import read_inputs
    from fitting.photographs.light_files import parse_numbers

    given = read_inputs(target, pictures)
    use_compilation_cache()
    from fitting.cli.encoding_trial import fit_either

    how["noise"] = None if noise is None else tuple(parse_numbers(noise, "--noise", 2, "READ,SHOT"))
    result, inputs = fit_either(given, say, **how)
    if not inputs.light_errors:
        return result, inputs.notes
    from fitting.photographs.light_error import with_light_errors

    say("carrying the errors of the lights into those of the numbers")
    try:
        return with_light_errors(result, inputs.light_errors), inputs.notes
    except brdf.InputError:
        words = "the errors of the numbers are those under this light: its own is not in them"
        return result, (*inputs.notes, words)
