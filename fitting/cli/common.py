"""What the commands share: how a function becomes a command, materials by name, devices, output.

Help does not import JAX or NumPy; each command imports what it needs.
"""

import contextlib
import difflib
import functools
import inspect
import json
import os
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any, NamedTuple, get_args

import typer

import brdf
from brdf.errors import InputError
from brdf.files import atomic_folder, atomic_path

# By what Slurm, Open MPI and, where there is neither, the user say how many processes there are.
PROCESSES = ("SLURM_NTASKS", "OMPI_COMM_WORLD_SIZE", "JAX_NUM_PROCESSES")

# What help shows that an option takes, where that is no text.
TAKES = {bool: "", Path: "PATH", float: "NUMBER"}


# Files that a fit, or maps, write into their folder; a picture that came as a file stays where it is.
OF_A_FIT = re.compile(
    r"(scene|mask)\d*\.(toml|png|aov\.exr)|fitted\.exr|fit\.(json|npz)|material\.(json|mtl)|comparison\.png"
)
OF_MAPS = re.compile(
    r"(maps|info)\.json|maps\.exr|material\.gltf|"
    r"(maps|k_d|k_s|normals|(openlime_)?gloss|openlime_k[ds]|base_color|metallic_roughness|specular_color|residual)\.png"
)


class PictureOptions(NamedTuple):
    """What the options say of the pictures, as typed; None where not given. Their help is what stands here.

    Attributes:
        scene: the scene file; in a folder, scene.toml.
        within: the folder that paths in the scene file may not leave; default: its own.
        sphere: a ball in the photograph: x,y,radius in pixels from the upper left one, or mask: found in --mask.
        normals: normals of the pixels: an image or .npy; x right, y up, z to the camera.
        light: towards the light: x,y,z (right, up, to the camera), or fit: from the shading.
        lights: a text file with such a direction for each picture, or an .lp file that names them.
        intensities: a text file, a line for each picture, a number or one per channel, to divide it by.
        ambient: a photograph is lit from all around too: find k_a for that light as 1.
        encoding: linear, srgb or a gamma; default: what the file says.
        exposure: relative exposure to divide by, one or one each.
        mask: an image: pixels that are 0 there are left out.
        saturation: linear values from here on are clipped, not data.
    """

    scene: Path | None = None
    within: Path | None = None
    sphere: str | None = None
    normals: Path | None = None
    light: str | None = None
    lights: Path | None = None
    intensities: Path | None = None
    ambient: bool = False
    encoding: Any = None
    exposure: str | None = None
    mask: Path | None = None
    saturation: float | None = None


def add_command(app: typer.Typer, function: Callable[..., Any]) -> None:
    """Make a command of a function, whose docstring is the help.

    Before ``*`` stand arguments, behind it options; in place of ``pictures`` there is an option for each field of
    `PictureOptions`. An error names the file or option that was typed, not the argument of the function behind.
    """
    own = inspect.signature(function).parameters
    fields = inspect.signature(PictureOptions).parameters if "pictures" in own else {}
    shown = [_typed(one, function, None) for name, one in own.items() if name != "pictures"]
    shown += [_typed(one, PictureOptions, "What the pictures show") for one in fields.values()]

    @functools.wraps(function)
    def command(**given) -> Any:
        options = {name: value for name, value in given.items() if name not in ("target", "material")}
        typed = {name: value if isinstance(value, Path) else _flag(name) for name, value in options.items()}
        if fields:
            given["pictures"] = PictureOptions(**{name: given.pop(name) for name in fields})
        targets = given["target"] if isinstance(given.get("target"), list) else []
        typed |= {f"target[{index}]": path for index, path in enumerate(targets) if len(targets) > 1}
        with named_as(typed | {"circle": "--sphere", "mesh": "--devices"}):
            return function(**given)

    command.__signature__ = inspect.Signature(shown)  # pyright: ignore[reportAttributeAccessIssue]
    text = inspect.getdoc(function) or ""
    examples = re.sub(r"(brdf .+)", r"[bold]\1[/bold]\n", inspect.cleandoc(text.partition("\nExample:\n")[2]))
    app.command(help=text.partition("\n\nArgs:")[0], epilog=f"Example: {examples}")(command)


def _typed(one, documented, panel):
    """A parameter as it is typed: an argument, or an option where it has to be named."""
    kind = str if one.annotation is Any else one.annotation
    said = re.search(rf"^    {one.name}: (.+(\n     .+)*)", inspect.getdoc(documented) or "", re.MULTILINE)
    words = " ".join(said[1].split()) if said else ""
    parser = _path if Path in (kind, *get_args(kind)) else None
    if panel is None and one.kind is not one.KEYWORD_ONLY:
        about = typer.Argument(help=words, parser=parser)
    else:
        names = [_flag(one.name), *(["-o"] if one.name == "out" else [])]
        takes = next((word for known, word in TAKES.items() if known in (kind, *get_args(kind))), "TEXT")
        about = typer.Option(*names, help=words, metavar=takes, rich_help_panel=panel, parser=parser)
    return one.replace(kind=one.KEYWORD_ONLY, annotation=Annotated[kind, about])


def _path(text: str) -> Path:
    """What was typed; what an empty shell variable leaves is none, or it would be the current folder."""
    if not text:
        raise typer.BadParameter("it is empty")
    return Path(text)


def _flag(name):
    return f"--{name.replace('_', '-')}"


@contextlib.contextmanager
def named_as(typed: dict[str, Any]) -> Iterator[None]:
    """Let an error name the file or option that a person typed, by the argument that it would name."""
    try:
        yield
    except InputError as error:
        raise error.renamed(typed) from None


def find_material(text: str, name: str | None = None) -> tuple["brdf.Material", str]:
    """One material, of a file or else of the classic table, and what its file says that it leaves open.

    The name says which one, where an MTL file holds several.
    """
    key = table_name(text)
    if key is None:
        from brdf.materials.material_file import read_material

        return read_material(text, name)
    if name is not None:
        raise InputError("--name", f"chooses from a file, and {key} is one material", "Leave it out")
    return brdf.preset(key), ""


def table_name(text: str) -> str | None:
    """The name in the classic table that is typed; None where a file is meant, and refused where it is neither."""
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


def all_devices(devices: str | None) -> Any:
    """The mesh of every core or accelerator, and every process that a scheduler has started; None where not asked for.

    Refused is what is not "all".
    """
    if devices is None:
        return None
    if devices != "all":
        raise InputError("--devices", f"must be all, got {devices!r}", "Write --devices all, or leave it out")
    import jax

    from fitting.solver.devices import core_count

    if "xla_force_host_platform_device_count" not in os.environ.get("XLA_FLAGS", ""):
        # Of the host platform alone: where there is an accelerator it is that that is taken.
        with contextlib.suppress(RuntimeError):  # JAX has begun, with the devices that it has
            jax.config.update("jax_num_cpu_devices", core_count())
    for name in (*PROCESSES, "JAX_PROCESS_ID"):
        if not (told := os.environ.get(name, "1")).isdecimal():
            raise InputError(name, f"must be a whole number, got {told!r}", "Correct or unset this variable")
    if any(int(os.environ.get(name, "1")) > 1 for name in PROCESSES) and not jax.distributed.is_initialized():
        jax.config.update("jax_cpu_collectives_implementation", "gloo")
        # JAX reads the address of the first one by itself, and asks Slurm and Open MPI for the rest.
        names = "JAX_NUM_PROCESSES", "JAX_PROCESS_ID"
        count, rank = (int(os.environ[name]) if name in os.environ else None for name in names)
        jax.distributed.initialize(num_processes=count, process_id=rank)
    return jax.make_mesh((jax.device_count(),), ("pixels",))


def is_first_process(mesh: Any) -> bool:
    """Whether this process is the one that writes and prints; the mesh is that of `all_devices`."""
    return mesh is None or mesh.local_devices[0].process_index == 0


class _TrialError(Exception):
    """Ends a trial of writing, of which nothing stays."""


def refuse_replacing(given: Iterable[Path | None], out: Path, kind: str = "file") -> None:
    """Refuse to write over what is read."""
    for read in filter(None, given):
        if read.exists() and read.resolve() == out.resolve():
            raise InputError("--out", f"would replace {read}, which is read here", f"Choose another {kind}")


def check_outputs(
    out: Path | None,
    plot: bool = False,
    page: Path | None = None,
    given: Iterable[Path | None] = (),
    written: re.Pattern[str] = OF_A_FIT,
) -> None:
    """Refuse before the work what could not be written after it, or would replace what is ``given``.

    That is a folder of results, the picture that is drawn into it, and the page of a report.
    """
    for path in filter(None, given):
        read = path / "scene.toml" if path.is_dir() else path
        if out is not None and written.fullmatch(read.name):
            refuse_replacing([read], out / read.name, "folder")
    if plot and out is None:
        raise InputError("--plot", "needs a folder to draw into", "Add --out DIR")
    if page is not None and page.suffix.lower() not in (".html", ".htm"):
        raise InputError(page, "is no name of a page", "Name it .html")
    # Refused before there are any results; nothing of the trial stays.
    if page is not None and (out is None or page.resolve().parent != out.resolve()):
        with contextlib.suppress(_TrialError), atomic_path(page):
            raise _TrialError
    if out is not None:
        with atomic_folder(out):
            pass


def show(content: Any) -> None:
    """Print the command's output: text, or what JSON holds."""
    print(content if isinstance(content, str) else json.dumps(content, indent=2), flush=True)  # noqa: T201  # the one place


def show_result(result: Any, notes: Sequence[str], as_json: bool, *lines: str) -> None:
    """Print a result, with what was found out on the way, and further lines below it where it is not JSON."""
    if as_json:
        show(result.to_dict() | ({"notes": notes} if notes else {}))
    else:
        show("\n".join([*notes, str(result), *lines]))
