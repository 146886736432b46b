"""What `brdf fit` is given: a picture with its scene, photographs of a ball, a photometric-stereo archive."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import brdf
from brdf.errors import InputError
from fitting.photographs.archives import ARCHIVE, read_archive, read_array
from fitting.photographs.ball import (
    Circle,
    ball_points,
    find_circle,
    light_from_shading,
    parse_circle,
    photograph_scene,
)
from fitting.photographs.light_files import parse_numbers, read_directions, read_intensities


class Job(NamedTuple):
    """Pictures and scenes to fit.

    Attributes:
        pictures: arrays or `brdf.Picture`s.
        scenes: as many.
        mask: pixels to look at, or None.
        target: the first picture's file, for messages.
        note: what was found out on the way, for the person who waits.
    """

    pictures: list[Any]
    scenes: list[brdf.Scene]
    mask: np.ndarray | None
    target: Path
    note: str = ""


class Options(NamedTuple):
    """The options of the command that say what the pictures show; None where not given.

    Attributes:
        scene: a scene file.
        within: the folder that its paths may not leave.
        sphere: "x,y,radius" of a ball in the picture, or "mask": found in the mask.
        normals: an image of normals, or an .npy file.
        light: "x,y,z" towards the light, or "fit": from the shading.
        lights: a file with a direction per picture.
        intensities: a file with an intensity per picture.
        encoding: of the pictures.
        exposure: one factor, or one per picture: values are divided by it.
        mask: an image.
        ambient: whether photographs are lit from all around as well.
    """

    scene: Path | None = None
    within: Path | None = None
    sphere: str | None = None
    normals: Path | None = None
    light: str | None = None
    lights: Path | None = None
    intensities: Path | None = None
    encoding: Any = None
    exposure: str | None = None
    mask: Path | None = None
    ambient: bool = False


def collect(targets: list[Path], options: Options, read: dict[Path, brdf.Picture]) -> Job:
    """Read what the command was given.

    Args:
        targets: pictures, one folder, or one archive.
        options: see there.
        read: pictures that were read already.

    Raises:
        InputError: naming the file or option.
    """
    if len(targets) == 1 and targets[0].suffix.lower() == ".npz":
        return _archive(targets[0], options)
    if options.sphere is not None or options.normals is not None:
        return _photographs(targets, options, read)
    for name, value in (
        ("--light", options.light),
        ("--lights", options.lights),
        ("--intensities", options.intensities),
    ):
        if value is not None:
            raise InputError(
                name, "says where the light is, but nothing what the picture shows", "Add --sphere x,y,radius"
            )
    if options.ambient:
        raise InputError("--ambient", "is what the scene file says", "Leave it out, or add [ambient] to the scene")
    if len(targets) > 1:
        came = f"{len(targets)} pictures come without their geometry"
        raise InputError("--sphere", came, "Several pictures are fitted with --sphere or --normals, and --lights")
    target, scene = _target_and_scene(targets[0], options.scene)
    picture = read.get(target) or brdf.read_picture(target, encoding=options.encoding)
    mask = None if options.mask is None else brdf.read_mask(options.mask)
    return Job(_exposed([picture], options.exposure), [brdf.Scene.load(scene, within=options.within)], mask, target)


def _target_and_scene(target: Path, scene: Path | None) -> tuple[Path, Path]:
    if not target.is_dir():
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


def _exposed(pictures: list[Any], exposure: str | None) -> list[Any]:
    if exposure is None:
        return pictures
    count = len(exposure.replace(",", " ").split())
    factors = parse_numbers(
        exposure, "--exposure", count if count in (1, len(pictures)) else 1, "one number, or one each"
    )
    if min(factors) <= 0:
        raise InputError("--exposure", f"must be above 0, got {exposure[:60]!r}", "Give a relative exposure time")
    factors = factors * len(pictures) if len(factors) == 1 else factors
    return [_scaled(picture, 1.0 / factor) for picture, factor in zip(pictures, factors, strict=True)]


def _scaled(picture: Any, factor: Any) -> Any:
    """A picture in another unit, and its clipping level and quantisation with it."""
    if not isinstance(picture, brdf.Picture):
        return picture * np.float32(factor)
    return picture.scaled(factor)


def _photographs(targets: list[Path], options: Options, read: dict[Path, brdf.Picture]) -> Job:
    if options.scene is not None:
        raise InputError("--scene", "says what --sphere or --normals says too", "Give one of them")
    if options.sphere is not None and options.normals is not None:
        raise InputError("--normals", "says what --sphere says too", "Give one of them")
    if (options.light is None) == (options.lights is None):
        raise InputError(
            "--light", "or --lights has to say where the light is", "Give x,y,z, fit, or a file of directions"
        )
    count = len(targets)
    directions = intensities = None
    if options.lights is not None:
        directions = read_directions(options.lights, count)
    elif options.light != "fit":
        assert options.light is not None
        one = parse_numbers(options.light, "--light", 3, "x,y,z: x right, y up, z to the camera; or fit")
        if not any(one):
            raise InputError("--light", "must not have zero length, got 0,0,0", "Give a direction")
        directions = np.tile(one, (count, 1))
    if options.intensities is not None:
        intensities = read_intensities(options.intensities, count)
    mask = None if options.mask is None else brdf.read_mask(options.mask)
    pictures = [read.get(target) or brdf.read_picture(target, encoding=options.encoding) for target in targets]
    shapes = {picture.pixels.shape for picture in pictures}
    if len(shapes) > 1:
        sizes = ", ".join(f"{shape[1]} x {shape[0]} x {shape[2]}" for shape in sorted(shapes))
        raise InputError(targets[0], f"and the others differ in size ({sizes})", "Give pictures of one camera")
    points, note = _geometry(pictures[0].pixels.shape[:2], mask, options)
    pictures = _exposed(pictures, options.exposure)
    if directions is None:
        found = [light_from_shading(picture, points) for picture in pictures]
        directions = np.array([one.direction for one in found])
        for target, one in zip(targets, found, strict=True):
            x, y, z = one.direction
            note += f"light of {target.name} from its shading: {x:.4f},{y:.4f},{z:.4f} ± {one.error:.2g}°\n"
    channels = pictures[0].pixels.shape[2]
    if intensities is None:
        intensities = np.ones((count, 1))
    elif intensities.shape[1] not in (1, channels):
        came = f"has {intensities.shape[1]} numbers a line, the pictures {channels} channels"
        raise InputError(options.intensities, came, "Give one intensity per channel")
    job = _normalised(pictures, points, directions, intensities, ambient=options.ambient)
    return Job(*job, mask, targets[0], note)


def _normalised(
    pictures: list[Any],
    points: brdf.SurfacePoints,
    directions: np.ndarray,
    intensities: np.ndarray,
    *,
    ambient: bool,
) -> tuple[list[Any], list[brdf.Scene]]:
    """Pictures as under light of intensity 1, so that every photograph counts alike however bright its light was.

    Ambient light is taken to be the same in all of them, and its intensity, which nobody knows, as 1.
    """
    lamps = list(zip(directions, intensities, strict=True))
    if np.any(intensities <= 0):
        around = [1.0] if ambient else None
        return pictures, [photograph_scene(points, *lamp, ambient=around) for lamp in lamps]
    scaled = [_scaled(picture, 1.0 / light) for picture, light in zip(pictures, intensities, strict=True)]
    return scaled, [photograph_scene(points, way, ambient=1.0 / light if ambient else None) for way, light in lamps]


def _geometry(shape: Any, mask: np.ndarray | None, options: Options) -> tuple[brdf.SurfacePoints, str]:
    if options.normals is not None:
        normal = _read_normals(options.normals)
        if normal.shape[:2] != tuple(shape):
            came = f"is {normal.shape[1]} x {normal.shape[0]}, the pictures {shape[1]} x {shape[0]}"
            raise InputError(options.normals, came, "Give a normal for each pixel")
        return brdf.SurfacePoints.from_normals(normal), ""
    assert options.sphere is not None
    circle, note = find_ball(options.sphere, mask, options.mask)
    try:
        return ball_points(shape, circle), note
    except InputError as error:
        raise InputError("--sphere", error.what, error.remedy) from None


def find_ball(sphere: str, mask: np.ndarray | None, mask_file: Path | None) -> tuple[Circle, str]:
    """The ball that --sphere names, and a line to print where it was found in a mask.

    Args:
        sphere: "x,y,radius" or "mask".
        mask: true on the ball.
        mask_file: where it comes from, for messages.

    Raises:
        InputError: where there is no mask, or no ball in it.
    """
    if sphere != "mask":
        return parse_circle(sphere), ""
    if mask is None:
        raise InputError("--sphere", "is to be found in the mask, but there is none", "Add --mask MASK.png")
    try:
        circle = find_circle(mask)
    except InputError as error:
        raise InputError(mask_file, error.what, error.remedy) from None
    return circle, f"ball found at {circle.x:.2f},{circle.y:.2f},{circle.radius:.2f}\n"


def _read_normals(path: Path) -> np.ndarray:
    """Normals (H, W, 3) from an .npy file, or from a picture: floats as they are, codes as 2 v - 1."""
    if path.suffix.lower() == ".npy":
        with brdf.input_file(path).open("rb") as file:
            normal = read_array(file, path, path.stat().st_size)
        if normal.ndim != 3 or normal.shape[2] != 3 or normal.dtype.kind not in "fiu":
            raise InputError(path, f"is of shape {normal.shape} and type {normal.dtype}", "Give normals (H, W, 3)")
        return normal.astype(np.float64)
    picture = brdf.read_picture(path, encoding="linear")
    if picture.pixels.shape[2] != 3:
        raise InputError(path, f"has {picture.pixels.shape[2]} channels instead of 3", "Give an image of normals")
    if picture.saturation is None:
        return picture.pixels
    normal = 2.0 * picture.pixels - 1.0
    # A code of 0 in all channels, and those around the middle, are how tools write "no surface".
    empty = np.all(picture.pixels == 0, axis=-1) | (np.sum(normal * normal, axis=-1) < 0.25)
    return np.where(empty[..., None], 0.0, normal)


def _archive(path: Path, options: Options) -> Job:
    """Photographs with normals and lights: images (K, H, W[, C]), normal (H, W, 3), light_dirs (K, 3), ...

    ... and where there are: light_intensities (K, C), mask (H, W). Integer images span their type.
    """
    given = {"--scene": options.scene, "--sphere": options.sphere, "--normals": options.normals}
    given |= {"--light": options.light, "--lights": options.lights, "--intensities": options.intensities}
    for name, value in given.items():
        if value is not None:
            raise InputError(name, f"is what {path.name} says itself", "Leave it out")
    arrays = read_archive(path)
    images, normal, directions = (arrays[name] for name in ARCHIVE)
    if images.ndim == 3:
        images = images[..., None]
    count = len(images)
    if images.ndim != 4 or 0 in images.shape:
        raise InputError(f"{path}: images", f"is of shape {images.shape}", "Give (pictures, height, width, channels)")
    if normal.shape != (*images.shape[1:3], 3):
        raise InputError(f"{path}: normal", f"is of shape {normal.shape}", f"Give {(*images.shape[1:3], 3)}")
    if directions.shape != (count, 3) or directions.dtype.kind != "f" or not np.all(np.isfinite(directions)):
        raise InputError(f"{path}: light_dirs", f"is no finite array {(count, 3)}", "Give a direction per picture")
    if not np.all(np.any(directions != 0, axis=1)):
        raise InputError(f"{path}: light_dirs", "has a direction of zero length", "Give a direction per picture")
    intensities = arrays.get("light_intensities", np.ones((count, 1)))
    if intensities.ndim == 1:
        intensities = intensities[:, None]
    if intensities.shape not in ((count, 1), (count, images.shape[3])) or not np.all(np.isfinite(intensities)):
        came = f"is no finite array {(count, images.shape[3])}"
        raise InputError(f"{path}: light_intensities", came, "Give an intensity per picture and channel")
    if np.any(intensities < 0):
        raise InputError(f"{path}: light_intensities", "has values below 0", "Give intensities of 0 or more")
    mask = None if options.mask is None else brdf.read_mask(options.mask)
    if mask is None and "mask" in arrays:
        mask = arrays["mask"] != 0
        if mask.shape != images.shape[1:3]:
            raise InputError(f"{path}: mask", f"is of shape {mask.shape}", f"Give {images.shape[1:3]}")
    points = brdf.SurfacePoints.from_normals(normal, mask=mask)
    pictures = _exposed([_as_picture(image) for image in images], options.exposure)
    job = _normalised(pictures, points, directions, intensities.astype(np.float64), ambient=options.ambient)
    return Job(*job, None, path)


def _as_picture(image: np.ndarray) -> Any:
    """Integers as the picture they would be in a file: linear, with its largest code and its step."""
    if image.dtype.kind not in "ub":
        return image.astype(np.float32)
    bits = 8 * image.dtype.itemsize
    pixels = (image / float((1 << bits) - 1)).astype(np.float32)
    return brdf.Picture(pixels, None, "linear", "format", bits, 1.0)
