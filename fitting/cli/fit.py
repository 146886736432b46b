"""``brdf fit``: pictures, photographs of a ball, archives and measured BRDFs."""

import functools
import shlex
import sys
from pathlib import Path
from typing import Any

import brdf
from brdf.errors import InputError
from brdf.files import write_text
from fitting.cli.common import PictureOptions, all_devices, check_outputs, is_first_process, named_as, show_result
from fitting.progress import waiting


def fit(
    target: list[Path],
    pictures: PictureOptions,
    *,
    model: str = "auto",
    out: Path | None = None,
    precision: str = "float32",
    dark: float | None = None,
    noise: str | None = None,
    plausible: bool = False,
    loss: Any = None,
    accuracy: float | None = None,
    seconds: float | None = None,
    free: list[str] | None = None,
    devices: str | None = None,
    plot: bool = False,
    report: Path | None = None,
    json: bool = False,
) -> None:
    """Fit a model to a picture: value ± error of every parameter, with no guess to give.

    Args:
        target: a picture; a folder with target.* and scene.toml; photographs; an .npz; a measured BRDF.
        pictures: what they show.
        model: one of auto, lambert, phong, blinn-phong, normalized-phong, normalized-blinn-phong.
        out: a folder for material.json, material.mtl, fitted.exr, ...
        precision: float32 or float64.
        dark: linear values up to here are too dark to count.
        noise: READ,SHOT of the camera: the variance is READ² + SHOT·value.
        plausible: hold k_d + k_s <= 1 with a normalised form: brdf check then passes.
        loss: squared, relative, log, huber or cauchy; for a measured BRDF cosine (its default), squared or log.
        accuracy: relative error that is good enough: as few pixels and samples as keep it.
        seconds: time to spend: the most accurate fit that it buys.
        free: light, distance (of a near one), intensity, ball, radius: fitted too, from the scene's; again for more.
        devices: all: spread the pixels over all cores or accelerators, and processes.
        plot: also draw comparison.png into --out.
        report: one .html page with everything, to keep or to send.
        json: print JSON instead of text.

    Example:
        brdf fit photo.exr --scene scene.toml --out result/
        A folder with target.exr and scene.toml: brdf fit data/gold-ball
        A photo of a ball: brdf fit ball.png --sphere 244.5,144.5,108 --light fit
        A measured BRDF: brdf fit gold.binary
    """
    import fitting
    from brdf.measured.loading import is_measured

    apart = {"--noise": noise, "--plausible": plausible, "--loss": loss, "--accuracy": accuracy, "--seconds": seconds}
    if free and any(apart.values()):
        what = f"knows nothing of {' and '.join(option for option, given in apart.items() if given)}"
        raise InputError("--free", what, "Leave one of them out")
    check_outputs(out, plot, report, [*target, *(one for one in pictures if isinstance(one, Path))])
    notes: tuple[str, ...] = ()
    mesh = all_devices(devices)
    with waiting("reading") as say:
        if len(target) == 1 and is_measured(target[0]):
            if any([*pictures, dark, noise, plausible, accuracy, seconds, free, report, mesh, precision != "float32"]):
                what = "is a measured BRDF; of the options only --model, --loss, --out, --plot and --json concern it"
                raise InputError(target[0], what, "Leave the others out")
            table = brdf.load_measured(target[0])
            say("fitting")
            with named_as({table.name: target[0]}):
                result: Any = fitting.fit_brdf(table, model, loss=loss or "cosine")
        else:
            from fitting.cli.encoding_trial import fit_either
            from fitting.cli.inputs import read_inputs
            from fitting.photographs.light_files import parse_numbers

            result, inputs = fit_either(
                functools.partial(read_inputs, target, pictures),
                say,
                model=model,
                precision=precision,
                saturation=pictures.saturation,
                dark=dark,
                noise=None if noise is None else tuple(parse_numbers(noise, "--noise", 2, "READ,SHOT")),
                plausible=plausible,
                loss=loss or "squared",
                accuracy=accuracy,
                seconds=seconds,
                mesh=mesh,
            )
            notes = inputs.notes
            if inputs.light_errors:
                from fitting.implicit import with_light_errors

                say("carrying the errors of the lights into those of the numbers")
                try:
                    result = with_light_errors(result, inputs.light_errors)
                except InputError:
                    notes += ("the errors of the numbers are those under this light: its own is not in them",)
            if free:
                say("fitting jointly")
                # What is too dark a joint fit knows nothing of.
                mask = inputs.masks if dark is None else result.counted
                with named_as({"free": "--free"}):
                    fitted = inputs.pictures, result.scenes, result.material, free
                    result = fitting.fit_jointly(*fitted, mask=mask, saturation=pictures.saturation)
                if model == "auto":
                    notes += ("the model is the simplest adequate one for the scene as it was before",)
        if not is_first_process(mesh):
            return
        if out is not None:
            say("saving and drawing" if plot else "saving")
            result.save(out, plot=plot)
        if report is not None:
            say("drawing the page")
            from fitting.report.html import report_page

            command = shlex.join(["brdf", *sys.argv[1:]])
            write_text(report, report_page(result, source=target[0].name, command=command))
    saved = [] if out is None else [f"saved in {out}"]
    written = [] if report is None else [f"wrote {report}"]
    show_result(result, notes, json, *saved, *written)
