"""``brdf tradeoff``: what the choices that a scene offers cost, and what error they make."""

from pathlib import Path

from brdf.errors import InputError
from fitting.cli.common import PictureOptions, check_outputs, named_as, show_result


def tradeoff(
    target: Path,
    pictures: PictureOptions,
    *,
    out: Path | None = None,
    model: str = "blinn-phong",
    accuracy: float = 1e-3,
    seconds: float = 15.0,
    json: bool = False,
) -> None:
    """Measure speed against accuracy on a scene: pixels, light samples, precision, model, solver.

    Ctrl-C ends the measuring and keeps what was measured.

    Args:
        target: a picture, a folder with target.* and scene.toml, or a photograph of a ball.
        pictures: what it shows.
        out: a folder for tradeoff.csv, .json, .png and .pdf.
        model: one of auto, lambert, phong, blinn-phong, normalized-phong, normalized-blinn-phong.
        accuracy: relative error that the recommendation is to keep.
        seconds: time that the measuring may take.
        json: print JSON instead of text.

    Example:
        brdf tradeoff photo.exr --scene scene.toml --out tradeoff/
        A photo of a ball: brdf tradeoff ball.png --sphere 244.5,144.5,108 --light fit
    """
    from fitting.cli.inputs import read_inputs

    check_outputs(out)
    inputs = read_inputs([target], pictures)
    if len(inputs.pictures) > 1:
        what = f"holds {len(inputs.pictures)} pictures, and one is measured"
        raise InputError(target, what, "Give one picture with its scene or its light")
    import fitting

    with named_as({"target": inputs.targets[0]}):
        found = fitting.tradeoff(
            inputs.pictures[0],
            inputs.scenes[0],
            mask=inputs.masks[0],
            saturation=pictures.saturation,
            model=model,
            accuracy=accuracy,
            seconds=seconds,
        )
    guess = [f"{path.name} does not say how its values are encoded; --encoding decides" for path in inputs.silent]
    if out is not None:
        found.save(out)
    saved = [] if out is None else [f"saved in {out}"]
    show_result(found, [*inputs.notes, *guess], json, "", found.advice, *saved)
