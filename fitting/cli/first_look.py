"""What the command is given, as far as it can be told without JAX, whose import takes longer than reading a picture."""

import tomllib
from collections.abc import Callable
from pathlib import Path

import numpy as np

import brdf
from brdf.errors import InputError
from brdf.files import input_file, read_text
from fitting.cli.picture_options import PictureOptions, encoding_of
from fitting.photographs.ball import Circle, ball_normals, find_circle, parse_circle


def is_archive(targets: list[Path]) -> bool:
    """Whether what was given is an archive of photometric stereo."""
    return len(targets) == 1 and targets[0].suffix.lower() == ".npz"


def is_photograph(options: PictureOptions) -> bool:
    """Whether the options say what the pictures show, instead of a scene file."""
    return options.sphere is not None or options.normals is not None


def read_first(targets: list[Path], options: PictureOptions, tell: Callable[[str], None]) -> dict[Path, brdf.Picture]:
    """Read the pictures, and refuse those that cannot be what the options or the scene file say.

    Args:
        targets: what was given: pictures, a folder or an archive.
        options: see there.
        tell: is called with what is being done.

    Returns:
        Pictures by file; none for an archive.

    Raises:
        InputError: naming the file or option.
    """
    _check_options(targets, options)
    for beside in (options.mask, options.normals, options.lights, options.intensities):
        if beside is not None:
            input_file(beside)
    if is_archive(targets):
        return {}
    files, scene = targets, None
    if not is_photograph(options):
        target, scene = target_and_scene(targets[0], options.scene)
        files = [target]
    # By their headers, before pixels are read: a wrong file may be a large one.
    shapes = set(map(_shape, files))
    if len(shapes) > 1:
        sizes = ", ".join(f"{shape[1]} x {shape[0]} x {shape[2]}" for shape in sorted(shapes))
        raise InputError(files[0], f"and the others differ in size ({sizes})", "Give pictures of one camera")
    shape = shapes.pop()[:2]
    if scene is not None:
        _check_resolution(files[0], shape, scene)
    elif options.sphere is not None and options.sphere != "mask":
        check_ball(shape, parse_circle(options.sphere))
    read = {}
    for index, path in enumerate(files, start=1):
        tell(f"reading {index} of {len(files)}")
        read[path] = brdf.read_picture(path, encoding=encoding_of(options.encoding))
    return read


def _shape(path: Path) -> tuple[int, int, int]:
    with brdf.ImageReader(path) as reader:
        return reader.shape


def _check_options(targets: list[Path], options: PictureOptions) -> None:
    """Refuse options that do not belong together."""
    lights = {"--light": options.light, "--lights": options.lights, "--intensities": options.intensities}
    if is_archive(targets):
        given = {"--scene": options.scene, "--sphere": options.sphere, "--normals": options.normals} | lights
        given["--encoding"] = options.encoding
        for name, value in given.items():
            if value is not None:
                raise InputError(name, f"is what {targets[0].name} says itself", "Leave it out")
    elif is_photograph(options):
        if options.scene is not None:
            raise InputError("--scene", "says what --sphere or --normals says too", "Give one of them")
        if options.sphere is not None and options.normals is not None:
            raise InputError("--normals", "says what --sphere says too", "Give one of them")
        if (options.light is None) == (options.lights is None):
            remedy = "Give x,y,z, fit, or a file of directions"
            raise InputError("--light", "or --lights has to say where the light is", remedy)
    else:
        for name, value in lights.items():
            if value is not None:
                came = "says where the light is, but nothing what the picture shows"
                raise InputError(name, came, "Add --sphere x,y,radius")
        if options.ambient:
            raise InputError("--ambient", "is what the scene file says", "Leave it out, or add [ambient] to the scene")
        if len(targets) > 1:
            came = f"{len(targets)} pictures come without their geometry"
            raise InputError("--sphere", came, "Several pictures are fitted with --sphere or --normals, and --lights")


def target_and_scene(target: Path, scene: Path | None) -> tuple[Path, Path]:
    """The picture and the scene file that a file, or a folder with both, stands for.

    Args:
        target: the file or folder.
        scene: the scene file, where it was given.

    Raises:
        InputError: where one of them is missing.
    """
    if not target.is_dir():
        input_file(target)
        if scene is None:
            raise InputError(
                target, "comes without a scene", "Add --scene SCENE.toml, or --sphere for a photo of a ball"
            )
        return target, scene
    candidates = sorted(path for path in target.glob("target.*") if path.is_file())
    if not candidates:
        raise InputError(target, "has no file target.*", "Give the picture, or a folder that holds it")
    if len(candidates) > 1:
        names = ", ".join(path.name for path in candidates)
        raise InputError(target, f"has several targets, {names}", "Name the picture instead of the folder")
    return candidates[0], scene or target / "scene.toml"


def _check_resolution(target: Path, shape: tuple[int, int], scene: Path) -> None:
    """Tell early what the fit would tell: the scene's camera has another resolution."""
    try:
        width, height = tomllib.loads(read_text(scene))["camera"]["resolution"]
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        if isinstance(error, InputError):
            raise
        return  # whatever else is wrong with the file is told where it is read
    sound = all(type(side) is int and 0 < side <= 1 << 31 for side in (width, height))
    if sound and (width, height) != shape[::-1]:
        came = f"is {shape[1]} x {shape[0]}, the scene's camera {width} x {height}"
        raise InputError(target, came, "Give a picture and a camera of the same resolution")


def find_ball(sphere: str, mask: np.ndarray | None, mask_file: Path | None) -> tuple[Circle, tuple[str, ...]]:
    """The ball that --sphere names, and what to tell where it was found in a mask.

    Args:
        sphere: "x,y,radius" or "mask".
        mask: true on the ball.
        mask_file: where it comes from, for messages.

    Raises:
        InputError: where there is no mask, or no ball in it.
    """
    if sphere != "mask":
        return parse_circle(sphere), ()
    if mask is None:
        raise InputError("--sphere", "is to be found in the mask, but there is none", "Add --mask MASK.png")
    try:
        circle = find_circle(mask)
    except InputError as error:
        raise InputError(mask_file, error.what, error.remedy) from None
    return circle, (f"ball found at {circle.x:.2f},{circle.y:.2f},{circle.radius:.2f}",)


def check_ball(shape: tuple[int, int], circle: Circle) -> None:
    """Refuse a circle that is not in the picture.

    Args:
        shape: height and width of the picture.
        circle: the ball's outline.

    Raises:
        InputError: naming the option.
    """
    try:
        ball_normals(shape, circle)
    except InputError as error:
        raise InputError("--sphere", error.what, error.remedy) from None
