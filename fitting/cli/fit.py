"""``brdf fit`` and ``brdf lights``: pictures, photographs of a ball, archives and measured BRDFs."""

import dataclasses
import json
import shlex
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer

from fitting.cli.common import named_as, show, use_compilation_cache, waiting
from fitting.cli.interrupts import held
from fitting.cli.picture_options import (
    Ambient,
    Encoding,
    Exposure,
    Intensities,
    Light,
    Lights,
    Mask,
    Normals,
    Saturation,
    SceneFile,
    Sphere,
    Within,
    encoding_of,
)

EXAMPLE = (
    "Example: [bold]brdf fit photo.exr --scene scene.toml --out result/[/bold]    or, for a folder with "
    "target.exr and scene.toml: [bold]brdf fit data/gold-ball[/bold]    a photo of a ball: "
    "[bold]brdf fit ball.png --sphere 244.5,144.5,108 --light fit[/bold]    a measured BRDF: "
    "[bold]brdf fit gold.binary[/bold]"
)
LIGHTS_EXAMPLE = "Example: [bold]brdf lights chrome.*.png --sphere 253.5,148,119.5 --out lights.txt[/bold]"
MODEL_NAMES = ("auto", "lambert", "phong", "blinn-phong", "normalized-phong", "normalized-blinn-phong")
LOSS_NAMES = "squared, relative, log, huber or cauchy; for a measured BRDF cosine (its default), squared or log"


def fit(
    target: Annotated[
        list[Path],
        typer.Argument(help="A picture; a folder with target.* and scene.toml; photographs; an .npz; a measured BRDF."),
    ],
    scene: SceneFile = None,
    within: Within = None,
    model: Annotated[str, typer.Option(help=f"One of {', '.join(MODEL_NAMES)}.")] = "auto",
    out: Annotated[Path | None, typer.Option(help="A folder for material.json, material.mtl, fitted.exr, ...")] = None,
    precision: Annotated[str, typer.Option(help="float32 or float64.")] = "float32",
    encoding: Encoding = None,
    saturation: Saturation = None,
    dark: Annotated[float | None, typer.Option(help="Linear values up to here are too dark to count.")] = None,
    mask: Mask = None,
    sphere: Sphere = None,
    normals: Normals = None,
    light: Light = None,
    lights: Lights = None,
    intensities: Intensities = None,
    ambient: Ambient = False,
    exposure: Exposure = None,
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
    plot: Annotated[bool, typer.Option("--plot", help="Also draw comparison.png into --out.")] = False,
    report: Annotated[Path | None, typer.Option(help="One .html page with everything, to keep or to send.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON instead of text.")] = False,
) -> None:
    """Fit a model to a picture: value ± error of every parameter, with no guess to give."""
    import brdf

    if plot and out is None:
        raise brdf.InputError("--plot", "needs a folder to draw into", "Add --out DIR")
    if report is not None and report.suffix.lower() not in (".html", ".htm"):
        raise brdf.InputError(report, "is no name of a page", "Name it .html")
    notes: tuple[str, ...] = ()
    with waiting("fitting") as tell:
        with held():
            import brdf.images.pictures
        if len(target) == 1 and brdf.is_measured(target[0]):
            given = (
                scene,
                within,
                encoding,
                saturation,
                dark,
                mask,
                sphere,
                normals,
                light,
                lights,
                intensities,
                exposure,
                noise,
                accuracy,
                seconds,
            )
            result = _fit_table(
                target[0],
                model,
                loss,
                any(option is not None for option in given) or plot or report or ambient or plausible,
            )
            if out is not None:
                _save(result, out)
        else:
            options = {
                "scene": scene,
                "within": within,
                "sphere": sphere,
                "normals": normals,
                "light": light,
                "lights": lights,
            }
            options |= {
                "intensities": intensities,
                "encoding": encoding_of(encoding),
                "exposure": exposure,
                "mask": mask,
            }
            options |= {"ambient": ambient, "saturation": saturation}
            names = {"model": "--model", "precision": "--precision", "dark": "--dark", "noise": "--noise"}
            names |= {"mask": mask, "loss": "--loss", "saturation": "--saturation", "accuracy": "--accuracy"}
            names |= {"seconds": "--seconds", "encoding": "--encoding"}
            with named_as(names):
                result, notes = _fit_pictures(
                    target,
                    options,
                    tell,
                    model=model,
                    precision=precision,
                    saturation=saturation,
                    dark=dark,
                    noise=noise,
                    loss=loss or "squared",
                    plausible=plausible,
                    accuracy=accuracy,
                    seconds=seconds,
                )
            if out is not None:
                _save(result, out, plot=plot)
            if report is not None:
                from fitting.html_report import report_page

                command = shlex.join(["brdf", *sys.argv[1:]])
                brdf.write_text(report, report_page(result, source=target[0].name, command=command))
    if as_json:
        show(json.dumps(result.to_dict() | ({"notes": notes} if notes else {}), indent=2))
    else:
        show("\n".join([*notes, str(result)]))
    if out is not None and not as_json:
        show(f"saved in {out}")
    if report is not None and not as_json:
        show(f"wrote {report}")


def _fit_table(path: Path, model: str, loss: str | None, has_picture_options: Any) -> Any:
    import brdf

    if has_picture_options:
        came = "is a measured BRDF; of the options only --model, --loss, --out and --json concern it"
        raise brdf.InputError(path, came, "Leave the others out")
    table = brdf.load_measured(path)
    with named_as({"model": "--model", "loss": "--loss", table.name: path}):
        with held():
            use_compilation_cache()
            import fitting

            fit_brdf = fitting.fit_brdf
        return fit_brdf(table, model, loss=loss or "cosine")  # pyright: ignore[reportArgumentType]  # refused there


def _fit_pictures(
    target: list[Path], options: dict[str, Any], tell: Callable[[str], None], *, noise: str | None, **how: Any
) -> tuple[Any, tuple[str, ...]]:
    """The fit, and what was found out on the way."""
    from fitting.cli.first_look import Options, read_first

    # Pictures are read before JAX is imported: a damaged one is told at once.
    given = Options(**options)
    read = read_first(target, given, tell)
    tell("fitting")
    with held():
        use_compilation_cache()
        from fitting.accuracy.budget import single_fit
        from fitting.cli.encoding_trial import fit_either
        from fitting.cli.inputs import collect
        from fitting.photographs.light_files import parse_numbers

    numbers = None if noise is None else parse_numbers(noise, "--noise", 2, "READ,SHOT")
    how["noise"] = None if numbers is None else (numbers[0], numbers[1])
    with single_fit():
        result, notes = fit_either(read, lambda pictures: collect(target, given, pictures), how)
    names = tuple(path.name for path in read)
    return (dataclasses.replace(result, names=names) if len(names) == len(result.targets) else result), notes


def _save(result: Any, out: Path, **how: bool) -> None:
    import brdf

    try:
        result.save(out, **how)
    except brdf.InputError as error:
        # What is gone by now was the place where the files wait until they are complete.
        raise brdf.InputError(error.where if Path(error.where).exists() else out, error.what, error.remedy) from None


def lights(
    target: Annotated[list[Path], typer.Argument(help="Photographs of a mirror ball, one per light.")],
    sphere: Annotated[str, typer.Option(help="The ball: x,y,radius in pixels from the upper left one, or: mask.")],
    mask: Annotated[Path | None, typer.Option(help="An image that is white on the ball, for --sphere mask.")] = None,
    out: Annotated[Path | None, typer.Option(help="A text file to write: a direction a line.")] = None,
    encoding: Encoding = None,
    matt: Annotated[bool, typer.Option("--matt", help="The ball is matt: the shading tells, not a highlight.")] = False,
) -> None:
    """Where the light comes from, by the highlight on a mirror ball: x right, y up, z to the camera."""
    import brdf

    with named_as({"encoding": "--encoding"}):
        pictures = [brdf.read_picture(path, encoding=encoding_of(encoding)) for path in target]
    inside = None if mask is None else brdf.read_mask(mask)
    from fitting.cli.first_look import check_ball, find_ball

    circle, notes = find_ball(sphere, inside, mask)
    for picture in pictures:
        check_ball(picture.pixels.shape[:2], circle)
    from fitting.photographs.ball import ball_points, light_from_highlight, light_from_shading

    lines = []
    for path, picture in zip(target, pictures, strict=True):
        with named_as({"picture": path}):
            if matt:
                direction = light_from_shading(picture, ball_points(picture.pixels.shape[:2], circle)).direction
            else:
                direction = light_from_highlight(picture, circle)
        lines.append(" ".join(f"{value:.6f}" for value in direction))
    text = "\n".join([*(f"# {line}" for line in notes), *lines]) + "\n"
    if out is not None:
        brdf.write_text(out, text)
    show(text.rstrip() if out is None else f"wrote {out}")
