"""The command ``brdf``: the front door for people who work with files.

Help does not import JAX; each command imports what it needs.
"""

import contextlib
import json
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

import typer

app = typer.Typer(
    name="brdf",
    help="Which few numbers make this surface look like that picture.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
)

MODEL_NAMES = ("auto", "lambert", "phong", "blinn-phong", "normalized-phong", "normalized-blinn-phong")
USAGE_ERROR = typer.BadParameter.__mro__[2]  # what a wrong option raises, wherever typer keeps its parser


@app.command(
    epilog="Example: [bold]brdf fit photo.exr --scene scene.toml --out result/[/bold]    or, for a folder with "
    "target.exr and scene.toml: [bold]brdf fit data/gold-ball[/bold]"
)
def fit(
    target: Annotated[Path, typer.Argument(help="A picture, or a folder with target.* and scene.toml.")],
    scene: Annotated[Path | None, typer.Option(help="The scene file; in a folder, scene.toml.")] = None,
    model: Annotated[str, typer.Option(help=f"One of {', '.join(MODEL_NAMES)}.")] = "auto",
    out: Annotated[Path | None, typer.Option(help="A folder for material.json, material.mtl, fitted.exr, ...")] = None,
    precision: Annotated[str, typer.Option(help="float32 or float64.")] = "float32",
    encoding: Annotated[str | None, typer.Option(help="linear, srgb or a gamma; default: what the file says.")] = None,
    saturation: Annotated[float | None, typer.Option(help="Linear values from here on are clipped, not data.")] = None,
    mask: Annotated[Path | None, typer.Option(help="An image: pixels that are 0 there are left out.")] = None,
    plot: Annotated[bool, typer.Option("--plot", help="Also draw comparison.png into --out.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON instead of text.")] = False,
) -> None:
    """Fit a model to a picture: value ± error of every parameter, with no guess to give."""
    target, scene = _target_and_scene(target, scene)
    if plot and out is None:
        raise _input_error("--plot", "needs a folder to draw into", "Add --out DIR")
    arguments = {"target": target, "mask": mask, "model": "--model", "precision": "--precision"}
    with _waiting("fitting"), _named_as(arguments):
        _use_compilation_cache()
        import brdf
        import fitting

        picture = brdf.read_picture(target, encoding=_encoding(encoding))
        result = fitting.fit(
            picture,
            brdf.Scene.load(scene),
            model=model,
            precision=precision,  # pyright: ignore[reportArgumentType]  # fit refuses what it does not know
            saturation=saturation,
            mask=None if mask is None else brdf.read_mask(mask),
        )
        if out is not None:
            result.save(out, plot=plot)
    _print(json.dumps(result.to_dict(), indent=2) if as_json else str(result))
    if out is not None and not as_json:
        _print(f"saved in {out}")


@app.command(epilog="Example: [bold]brdf render material.json --scene scene.toml -o picture.exr[/bold]")
def render(
    material: Annotated[Path, typer.Argument(help="A .json or .mtl file.")],
    scene: Annotated[Path, typer.Option(help="The scene file.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="The picture to write: .exr, .hdr, .png, .tiff or .jpg.")],
    precision: Annotated[str, typer.Option(help="float32 or float64.")] = "float32",
) -> None:
    """Render a material in a scene."""
    with _waiting("rendering"), _named_as({"material": material, "precision": "--precision"}):
        _use_compilation_cache()
        import numpy as np

        import brdf

        loaded = brdf.load_material(material)
        image = brdf.render(loaded, brdf.Scene.load(scene), precision=precision)  # pyright: ignore[reportArgumentType]
        brdf.write_image(out, np.asarray(image))
    _print(f"wrote {out}")


@app.command(
    epilog="Example: [bold]brdf check material.json[/bold]    or in CI: [bold]brdf check scene.mtl --json[/bold]"
)
def check(
    material: Annotated[Path, typer.Argument(help="A .json or .mtl file; of the latter every material is checked.")],
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON instead of text.")] = False,
    plot: Annotated[Path | None, typer.Option(help="A picture of albedo, lobe and reciprocity to write.")] = None,
) -> int:
    """Is a material plausible: positive, reciprocal, energy conserving? Exit 0 if so, 1 if not, 2 if it cannot tell."""
    with _waiting("checking"):
        _use_compilation_cache()
        import brdf

        materials = brdf.load_materials(material)
        reports = {name: brdf.check(one, name=name) for name, one in materials.items()}
        if plot is not None:
            if len(materials) > 1:
                raise _input_error("--plot", f"draws one material, {material} holds {len(materials)}", "Give one")
            from fitting.material_plots import overview

            with brdf.atomic_path(plot) as path:
                overview(next(iter(materials.values()))).savefig(path)
    if as_json:
        _print(json.dumps({name: report.to_json() for name, report in reports.items()}, indent=2))
    else:
        _print("\n\n".join(map(str, reports.values())))
    verdicts = [report.plausible for report in reports.values()]
    return 1 if False in verdicts else 2 if None in verdicts else 0


@contextlib.contextmanager
def _named_as(arguments: dict[str, Any]) -> Iterator[None]:
    """Let an error name the file or option that a person typed, not the argument of the function behind it."""
    from brdf.errors import InputError

    try:
        yield
    except InputError as error:
        typed = arguments.get(error.where)
        if typed is None:
            raise
        raise InputError(typed, error.what, error.remedy) from None


def _target_and_scene(target: Path, scene: Path | None) -> tuple[Path, Path]:
    if not target.is_dir():
        if scene is None:
            raise _input_error(str(target), "comes without a scene", "Add --scene SCENE.toml")
        return target, scene
    candidates = sorted(path for path in target.glob("target.*") if path.is_file())
    if not candidates:
        raise _input_error(str(target), "has no file target.*", "Give the picture, or a folder that holds it")
    if len(candidates) > 1:
        names = ", ".join(path.name for path in candidates)
        raise _input_error(str(target), f"has several targets, {names}", "Name the picture instead of the folder")
    scene = scene or target / "scene.toml"
    return candidates[0], scene


def _encoding(text: str | None) -> str | float | None:
    if text is None:
        return None
    try:
        return float(text)
    except ValueError:
        return text


def _input_error(where: str, what: str, remedy: str) -> Exception:
    from brdf.errors import InputError

    return InputError(where, what, remedy)


def _use_compilation_cache() -> None:
    """Keep compiled programs in the user's cache folder: the second run of the same kind skips the compiler."""
    import jax

    base = os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
    if jax.config.jax_compilation_cache_dir is None:
        jax.config.update("jax_compilation_cache_dir", str(Path(base) / "brdf" / "jax"))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
        jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)


@contextlib.contextmanager
def _waiting(what: str) -> Iterator[None]:
    """A spinner where a person waits; nothing where standard error is no terminal."""
    if not sys.stderr.isatty():
        yield
        return
    from rich.console import Console

    with Console(stderr=True).status(f"{what} ..."):
        yield


def _print(text: str) -> None:
    print(text)  # noqa: T201  # this is the command's output


def main(arguments: list[str] | None = None) -> Any:
    """Run the command; every failure of the user's making is one line on standard error and exit status 2.

    Args:
        arguments: the words after ``brdf``; None takes those of the process.
    """
    from brdf.errors import InputError

    try:
        status = app(args=arguments, prog_name="brdf", standalone_mode=False)
    except InputError as error:
        _fail(str(error))
    except USAGE_ERROR as error:
        _fail(f"{_words(error)} Try brdf --help.")
    except KeyboardInterrupt:
        _fail("interrupted.", status=130)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)
    else:
        sys.exit(status if isinstance(status, int) else 0)


def _words(error: Any) -> str:
    return " ".join(error.format_message().split())


def _fail(message: str, status: int = 2) -> None:
    print(f"error: {message}", file=sys.stderr)  # noqa: T201  # this is the command's one line of failure
    sys.exit(status)
