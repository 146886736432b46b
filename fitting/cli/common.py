"""What the commands share: options, errors that name what was typed, materials, output, the compiler's cache.

Help does not import JAX or NumPy; each command imports what it needs.
"""

import contextlib
import difflib
import functools
import inspect
import os
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated, Any, NamedTuple, get_args

import typer

import brdf
from brdf.errors import InputError

# As `fitting.fit` takes them; help is shown without importing it.
MODEL_NAMES = ("auto", "lambert", "phong", "blinn-phong", "normalized-phong", "normalized-blinn-phong")


# What help shows that an option takes.
TAKES = ((bool, ""), (Path, "PATH"), (float, "NUMBER"), (int, "NUMBER"), (str, "TEXT"), (Any, "TEXT"))


Encoding = Annotated[
    Any,
    typer.Option(
        help="linear, srgb or a gamma; default: what the file says.",
        rich_help_panel="What the pictures show",
        parser=str,
    ),
]


Model = Annotated[str, typer.Option(help=f"One of {', '.join(MODEL_NAMES)}.")]
Precision = Annotated[str, typer.Option(help="float32 or float64.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print JSON instead of text.")]
AMaterial = Annotated[
    str, typer.Argument(help="A .json or .mtl file, a folder of brdf fit --out, or a name of the classic table.")
]


Report = Annotated[Path | None, typer.Option(help="One .html page with everything, to keep or to send.")]


def check_page(path: Path | None) -> None:
    """Tell before the work that a page cannot be written.

    Args:
        path: of the page, or None.

    Raises:
        InputError: naming it.
    """
    if path is not None and path.suffix.lower() not in (".html", ".htm"):
        raise InputError(path, "is no name of a page", "Name it .html")
    if path is not None and not path.absolute().parent.is_dir():
        raise InputError(path, f"cannot be written, {path.parent} is no folder", "Make it first")


def _option(said: str, *names: str) -> Any:
    return typer.Option(*names, help=said, rich_help_panel="What the pictures show")


class PictureOptions(NamedTuple):
    """What the options say of the pictures, as typed; None where not given. Their help is their description."""

    scene: Annotated[Path | None, _option("The scene file; in a folder, scene.toml.")] = None
    within: Annotated[
        Path | None, _option("The folder that paths in the scene file may not leave; default: its own.")
    ] = None
    sphere: Annotated[
        str | None,
        _option("A ball in the photograph: x,y,radius in pixels from the upper left one, or mask: found in --mask."),
    ] = None
    normals: Annotated[
        Path | None, _option("Normals of the pixels: an image or .npy; x right, y up, z to the camera.")
    ] = None
    light: Annotated[
        str | None, _option("Towards the light: x,y,z (right, up, to the camera), or fit: from the shading.")
    ] = None
    lights: Annotated[
        Path | None, _option("A text file with such a direction for each picture, or an .lp file that names them.")
    ] = None
    intensities: Annotated[Path | None, _option("A text file with the light's intensity for each picture.")] = None
    ambient: Annotated[
        bool, _option("A photograph is lit from all around too: find k_a for that light as 1.", "--ambient")
    ] = False
    encoding: Encoding = None
    exposure: Annotated[str | None, _option("Relative exposure to divide by, one or one each.")] = None
    mask: Annotated[Path | None, _option("An image: pixels that are 0 there are left out.")] = None
    saturation: Annotated[float | None, _option("Linear values from here on are clipped, not data.")] = None


def as_command(function: Callable[..., Any]) -> Callable[..., Any]:
    """A command whose errors name the options that were typed, not the arguments of the functions behind.

    In place of a parameter ``pictures`` it takes an option for each field of `PictureOptions`.

    Args:
        function: what the command does.
    """
    own = inspect.signature(function).parameters
    shown = inspect.signature(PictureOptions).parameters if "pictures" in own else {}

    @functools.wraps(function)
    def command(**given: Any) -> Any:
        options = {name: value for name, value in given.items() if name not in ("target", "material")}
        typed = {name: value if isinstance(value, Path) else f"--{name}" for name, value in options.items()}
        if shown:
            given["pictures"] = PictureOptions(**{name: given.pop(name) for name in shown})
        with named_as(typed | {"circle": "--sphere"}):
            return function(**given)

    every = [one.replace(kind=one.KEYWORD_ONLY) for one in (*own.values(), *shown.values()) if one.name != "pictures"]
    for one in every:
        kind, about, *_ = (*get_args(one.annotation), None, None)
        if isinstance(about, typer.models.OptionInfo) and about.metavar is None:
            # A switch takes nothing, so nothing is shown behind it.
            about.metavar = next((word for type_, word in TAKES if type_ in (kind, *get_args(kind))), None)
    command.__signature__ = inspect.Signature(every)  # pyright: ignore[reportAttributeAccessIssue]
    return command


@contextlib.contextmanager
def named_as(typed: dict[str, Any]) -> Iterator[None]:
    """Let an error name the file or option that a person typed.

    Args:
        typed: by the argument that the error would name.
    """
    try:
        yield
    except InputError as error:
        if error.where not in typed:
            raise
        raise InputError(typed[error.where], error.what, error.remedy) from None


def find_material(text: str, name: str | None = None) -> tuple["brdf.Material", str, str]:
    """One material, what it is called, and what its file says that it leaves open.

    Args:
        text: a file, or a name of the classic table such as emerald; a file goes before a name.
        name: which one, where an MTL file holds several.

    Raises:
        InputError: naming the file or the option.
    """
    key = _table_name(text)
    if key is None:
        from brdf.materials.material_file import read_material

        material, note = read_material(text, name)
        return material, name or Path(text).stem, note
    if name is not None:
        raise InputError("--name", f"chooses from a file, and {key} is one material", "Leave it out")
    return brdf.preset(key), key, ""


def find_materials(text: str) -> dict[str, tuple["brdf.Material", str]]:
    """Every material of a file, or the one of the classic table, by name, with what its file says that it leaves open.

    Args:
        text: see `find_material`.

    Raises:
        InputError: naming the file.
    """
    key = _table_name(text)
    if key is not None:
        return {key: (brdf.preset(key), "")}
    from brdf.materials.material_file import read_materials

    return read_materials(text)


def _table_name(text: str) -> str | None:
    """The name in the classic table; None where a file is meant."""
    if not text.strip():
        raise InputError("MATERIAL", "is empty", "Give a .json or .mtl file, or a name such as emerald")
    path, key = Path(text), text.strip().lower().replace(" ", "_").replace("-", "_")
    if key in brdf.PRESETS and not path.is_file():
        return key
    if path.suffix or path.exists():
        return None
    close = difflib.get_close_matches(key, brdf.PRESETS)
    remedy = f"The table has {' and '.join(close)}" if close else f"Give a file, or one of {', '.join(brdf.PRESETS)}"
    raise InputError(text, "is no material file and no name of the classic table", remedy)


def use_compilation_cache() -> None:
    """Keep compiled programs in the user's cache folder: the second run of the same kind skips the compiler."""
    # Of each program that it takes from there jaxlib 0.10.1 says, at length, that the compiler's own settings are no
    # features of the machine. What is an error comes as an exception.
    os.environ["TF_CPP_MIN_LOG_LEVEL"] = "3"
    import jax

    base = os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
    if jax.config.values["jax_compilation_cache_dir"] is None:
        jax.config.update("jax_compilation_cache_dir", str(Path(base) / "brdf" / "jax"))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
        jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)


def show(text: str) -> None:
    """Print the command's output.

    Args:
        text: to print.

    Raises:
        InputError: where it cannot be written.
    """
    try:
        print(text, flush=True)  # noqa: T201  # this is the command's output
    except BrokenPipeError:
        raise
    except OSError as error:
        forget_output()
        raise InputError("output", f"cannot be written ({error.strerror})", "Send it elsewhere") from None


def forget_output() -> None:
    """Let what could not be written go, or Python would try once more when it ends."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
