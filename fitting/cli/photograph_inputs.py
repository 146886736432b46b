"""Photographs whose geometry is a ball or normals, and archives of photometric stereo, as pictures and scenes."""

from pathlib import Path
from typing import Any

import numpy as np

import brdf
from brdf.errors import InputError
from brdf.files import input_file
from fitting.cli.common import named_as
from fitting.cli.first_look import check_ball, find_ball
from fitting.cli.job import Job, exposed, opaque, scaled
from fitting.cli.picture_options import PictureOptions
from fitting.photographs.archives import ARCHIVE, read_archive, read_array
from fitting.photographs.ball import ShadingLight, ball_points, light_from_shading, photograph_scene
from fitting.photographs.light_files import parse_numbers, read_directions, read_intensities

# A light from so far behind leaves a crescent of less than three fifths of the ball's radius. On a thin one ambient
# light and a highlight can be taken for each other and for shading, and the jackknife does not see that.
BEHIND = -0.4
THIN_CRESCENT = " (it comes from behind: a highlight on the thin crescent can turn it by several times that)"


def photographs(targets: list[Path], options: PictureOptions, read: dict[Path, brdf.Picture]) -> Job:
    """Photographs under one distant light each.

    Args:
        targets: their files.
        options: what they show.
        read: the pictures, of one size.

    Raises:
        InputError: naming the file or option.
    """
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
    pictures = [read[target] for target in targets]
    points, notes = _geometry(pictures[0].pixels.shape[:2], mask, options)
    pictures = exposed(pictures, options.exposure)
    masks = opaque(mask, pictures)
    if directions is None:
        seen = zip(targets, pictures, masks, strict=True)
        found = [light_of(target, picture, points, one, options) for target, picture, one in seen]
        directions = np.array([one.direction for one in found])
        notes += _told(targets, found)
    channels = pictures[0].pixels.shape[2]
    if intensities is None:
        intensities = np.ones((count, 1))
    elif intensities.shape[1] not in (1, channels):
        came = f"has {intensities.shape[1]} numbers a line, the pictures {channels} channels"
        raise InputError(options.intensities, came, "Give one intensity per channel")
    job = _normalised(pictures, points, directions, intensities, ambient=options.ambient)
    return Job(*job, masks, targets[0], notes)


def light_of(
    target: Path, picture: brdf.Picture, points: brdf.SurfacePoints, mask: np.ndarray | None, options: PictureOptions
) -> ShadingLight:
    """The light of a photograph from its shading.

    Args:
        target: the file.
        picture: of it.
        points: what its pixels see.
        mask: pixels to look at, as `opaque` gives them, or None.
        options: what it shows.

    Raises:
        InputError: naming the file or option.
    """
    with named_as({**options.names(), "picture": target}):
        how = {"saturation": options.saturation, "mask": mask, "ambient": options.ambient}
        return light_from_shading(picture, points, **how)


def _told(targets: list[Path], found: list[ShadingLight]) -> tuple[str, ...]:
    """The lights that the shading told, and how surely; of several, how bright each is beside their mean."""
    mean = sum(one.strength for one in found) / len(found)
    notes = []
    for target, one in zip(targets, found, strict=True):
        x, y, z = one.direction
        brighter = f", {100 * (one.strength / mean - 1):+.1f} % bright" if len(found) > 1 else ""
        notes.append(f"light of {target.name} from its shading: {x:.4f},{y:.4f},{z:.4f} {how_sure(one)}{brighter}")
    return tuple(notes)


def how_sure(light: ShadingLight) -> str:
    """What to say of the error of a light's direction.

    Args:
        light: as the shading tells it.
    """
    return f"± {light.error:.2g}°{THIN_CRESCENT if light.direction[2] < BEHIND else ''}"


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
    alike = [scaled(picture, 1.0 / light) for picture, light in zip(pictures, intensities, strict=True)]
    return alike, [photograph_scene(points, way, ambient=1.0 / light if ambient else None) for way, light in lamps]


def _geometry(
    shape: Any, mask: np.ndarray | None, options: PictureOptions
) -> tuple[brdf.SurfacePoints, tuple[str, ...]]:
    if options.normals is not None:
        normal = _read_normals(options.normals)
        if normal.shape[:2] != tuple(shape):
            came = f"is {normal.shape[1]} x {normal.shape[0]}, the pictures {shape[1]} x {shape[0]}"
            raise InputError(options.normals, came, "Give a normal for each pixel")
        return brdf.SurfacePoints.from_normals(normal), ()
    assert options.sphere is not None
    circle, notes = find_ball(options.sphere, mask, options.mask)
    check_ball(shape, circle)
    return ball_points(shape, circle), notes


def _read_normals(path: Path) -> np.ndarray:
    """Normals (H, W, 3) from an .npy file, or from a picture: floats as they are, codes as 2 v - 1."""
    if path.suffix.lower() == ".npy":
        with input_file(path).open("rb") as file:
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


def archive(path: Path, options: PictureOptions) -> Job:
    """Photographs with normals and lights: images (K, H, W[, C]), normal (H, W, 3), light_dirs (K, 3), ...

    ... and where there are: light_intensities (K, C), mask (H, W). Unsigned images span their type.

    Args:
        path: an .npz file.
        options: what else is known.

    Raises:
        InputError: naming the file and the array.
    """
    arrays = read_archive(path)
    images, normal, directions = (arrays[name] for name in ARCHIVE)
    if images.dtype.kind in "bi":
        came = f"holds {images.dtype}, of which it is not clear what is white"
        raise InputError(f"{path}: images", came, "Save unsigned integers, which span their type, or floats")
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
    if not np.any(points.mask):
        came = "has no normal" if mask is None else "has no normal inside the mask"
        raise InputError(f"{path}: normal", came, "Give a direction (x, y, z) where the surface is")
    pictures = exposed([_as_picture(image) for image in images], options.exposure)
    job = _normalised(pictures, points, directions, intensities.astype(np.float64), ambient=options.ambient)
    return Job(*job, [None] * count, path)


def _as_picture(image: np.ndarray) -> Any:
    """Integers as the picture they would be in a file: linear, with its largest code and its step."""
    if image.dtype.kind != "u":
        return image.astype(np.float32)
    bits = 8 * image.dtype.itemsize
    pixels = (image / float((1 << bits) - 1)).astype(np.float32)
    return brdf.Picture(pixels, None, "linear", "format", bits, 1.0)
