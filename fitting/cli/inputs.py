"""What the command is given: a picture with its scene, photographs of a ball, a photometric-stereo archive.

`read_inputs` refuses, before JAX is imported, which takes longer than reading a picture, what does not go together;
`collect` makes pictures and scenes of the rest.
"""

import itertools
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import brdf
from brdf.errors import InputError
from brdf.files import input_file, read_toml
from fitting.cli.common import PictureOptions, named_as
from fitting.photographs.archives import read_archive
from fitting.photographs.ball import Circle, ball_normals, ball_points, find_circle, parse_circle
from fitting.photographs.light_files import parse_numbers, read_directions, read_intensities

Array = np.ndarray

# A light from so far behind leaves a crescent of less than three fifths of the ball's radius. On a thin one ambient
# light and a highlight can be taken for each other and for shading, and the jackknife does not see that.
BEHIND = -0.4
THIN_CRESCENT = " (it comes from behind: a highlight on the thin crescent can turn it by several times that)"


class Given(NamedTuple):
    """What was typed, read as far as that needs no JAX.

    Attributes:
        targets: the files of the pictures, or the archive.
        options: what they show.
        pictures: by file; none for an archive.
        scene: the scene file and its tables, where there is one.
    """

    targets: list[Path]
    options: PictureOptions
    pictures: dict[Path, brdf.Picture]
    scene: tuple[Path, dict[str, Any]] | None = None


class FitInputs(NamedTuple):
    """Pictures and scenes to fit.

    Attributes:
        pictures: as many as scenes.
        scenes: what they show.
        masks: pixels that count in each, or None for all.
        notes: what was found out on the way, for the person who waits.
        light_errors: of the directions of lights that were found from the shading, in degrees.
    """

    pictures: list[brdf.Picture]
    scenes: list["brdf.Scene"]
    masks: list[Array | None]
    notes: tuple[str, ...] = ()
    light_errors: tuple[float, ...] = ()


def read_inputs(targets: list[Path], options: PictureOptions) -> Given:
    """Read the pictures, and refuse those that cannot be what the options or the scene file say.

    Args:
        targets: what was given: pictures, a folder or an archive.
        options: what they show.

    Raises:
        InputError: naming the file or option.
    """
    _check_options(targets, options)
    for beside in (options.mask, options.normals, options.lights, options.intensities):
        if beside is not None:
            input_file(beside)
    if _is_archive(targets):
        return Given(targets, options, {})
    circle = None if options.sphere in (None, "mask") else parse_circle(options.sphere)
    scene, resolution = None, None
    if options.sphere is None and options.normals is None:
        target, file = _target_and_scene(targets[0], options.scene)
        targets, scene = [target], (file, read_toml(file))
        camera = scene[1].get("camera")
        resolution = camera.get("resolution") if isinstance(camera, dict) else None
    pictures = {path: brdf.read_picture(path, encoding=options.encoding) for path in targets}
    shapes = sorted({picture.pixels.shape for picture in pictures.values()})
    height, width, _ = shapes[0]
    sizes = ", ".join(f"{shape[1]} x {shape[0]} x {shape[2]}" for shape in shapes)
    came = f"and the others differ in size ({sizes})"
    _require(len(shapes) == 1, targets[0], came, "Give pictures of one camera")
    if isinstance(resolution, list) and resolution != [width, height]:
        came = f"is {width} x {height}, the scene's camera {' x '.join(map(str, resolution))}"
        raise InputError(targets[0], came, "Give a picture and a camera of the same resolution")
    if circle is not None:
        ball_normals((height, width), circle)
    return Given(targets, options, pictures, scene)


def _is_archive(targets: list[Path]) -> bool:
    return len(targets) == 1 and targets[0].suffix.lower() == ".npz"


def _require(fine: Any, where: object, came: str, remedy: str) -> None:
    if not fine:
        raise InputError(where, came, remedy)


def _check_options(targets: list[Path], options: PictureOptions) -> None:
    """Refuse options that do not belong together."""
    refused = ("light", "lights", "intensities")
    came, remedy = "says where the light is, but nothing what the picture shows", "Add --sphere x,y,radius"
    if _is_archive(targets):
        refused += ("scene", "sphere", "normals", "encoding")
        came, remedy = f"is what {targets[0].name} says itself", "Leave it out"
    elif options.sphere is not None or options.normals is not None:
        remedy = "Give one of them"
        _require(options.scene is None, "--scene", "says what --sphere or --normals says too", remedy)
        _require(None in (options.sphere, options.normals), "--normals", "says what --sphere says too", remedy)
        came, remedy = "or --lights has to say where the light is", "Give x,y,z, fit, or a file of directions"
        _require((options.light is None) != (options.lights is None), "--light", came, remedy)
        return
    for name in refused:
        _require(getattr(options, name) is None, f"--{name}", came, remedy)
    if not _is_archive(targets):
        remedy = "Leave it out, or add [ambient] to the scene"
        _require(not options.ambient, "--ambient", "is what the scene file says", remedy)
        for path in targets[1:]:
            _require(path.suffix != ".toml", path, "is a scene, no picture", f"Write --scene {path}")
        remedy = "Give one; in Python fitting.fit takes lists of pictures and of scenes"
        told = f"tells what one picture shows, {len(targets)} are given"
        _require(options.scene is None or len(targets) == 1, "--scene", told, remedy)
        remedy = "Several pictures are fitted with --sphere or --normals, and --lights"
        _require(len(targets) == 1, "--sphere", f"{len(targets)} pictures come without their geometry", remedy)


def _target_and_scene(target: Path, scene: Path | None) -> tuple[Path, Path]:
    """The picture and the scene file that a file, or a folder with both, stands for."""
    if target.is_dir():
        found = sorted(path for path in target.glob("target.*") if path.is_file())
        _require(found, target, "has no file target.*", "Give the picture, or a folder that holds it")
        came = f"has several targets, {', '.join(path.name for path in found)}"
        _require(len(found) == 1, target, came, "Name the picture instead of the folder")
        return found[0], scene or target / "scene.toml"
    input_file(target)
    if scene is None:
        remedy = "Add --scene SCENE.toml, or --sphere for a photo of a ball"
        raise InputError(target, "comes without a scene", remedy)
    return target, scene


def collect(given: Given) -> FitInputs:
    """What the command was given, ready to fit.

    Photographs come as under light of intensity 1, so that each counts alike however bright its light was. Ambient
    light is taken to be the same in all of them, and its intensity, which nobody knows, as 1.

    Args:
        given: as `read_inputs` read it, or with other interpretations of its files.

    Raises:
        InputError: naming the file or option.
    """
    targets, options, read, scene = given
    mask = None if options.mask is None else brdf.read_mask(options.mask)
    masks: Any
    named: dict[str, Any] = {}
    if _is_archive(targets):
        pictures, points, directions, intensities = _read_photographs(targets[0], mask)
        pictures, masks, notes = _exposed(pictures, options.exposure), [None] * len(pictures), ()
        light_errors = ()
        named = {"direction": f"{targets[0]}: light_dirs", "intensity": f"{targets[0]}: light_intensities"}
    else:
        pictures = _exposed([read[target] for target in targets], options.exposure)
        masks = visible(mask, pictures)
        if scene is not None:
            from brdf.scene import load_scene

            return FitInputs(pictures, [load_scene(scene[0], options.within, scene[1])], masks)
        points, directions, intensities, light_errors, notes = _photographs(targets, options, pictures, mask, masks)
    from fitting.photographs.distant_light import photograph_scene

    around = np.ones((len(pictures), 1))
    if np.all(intensities > 0):
        pictures = [picture.scaled(1.0 / intensity) for picture, intensity in zip(pictures, intensities, strict=True)]
        intensities, around = around, 1.0 / intensities
    with named_as(named):
        scenes = [
            photograph_scene(points, direction, intensity, ambient=ambient if options.ambient else None)
            for direction, intensity, ambient in zip(directions, intensities, around, strict=True)
        ]
    return FitInputs(pictures, scenes, masks, notes, light_errors)


def _exposed(pictures: list[brdf.Picture], exposure: str | None) -> list[brdf.Picture]:
    """Pictures in one unit, by one relative exposure or one for each, as typed."""
    if exposure is None:
        return pictures
    count = len(pictures) if len(exposure.replace(",", " ").split()) == len(pictures) else 1
    factors = parse_numbers(exposure, "--exposure", count, "one number, or one each")
    came = f"must be above 0, got {exposure[:60]!r}"
    _require(min(factors) > 0, "--exposure", came, "Give a relative exposure time")
    return [picture.scaled(1.0 / factor) for picture, factor in zip(pictures, itertools.cycle(factors), strict=False)]


def visible(mask: Array | None, pictures: list[brdf.Picture]) -> list[Array | None]:
    """Pixels that count in each picture: those of the mask without the fully transparent ones, which show nothing.

    Args:
        mask: (H, W), or None.
        pictures: where alpha is 0 everywhere it was not meant.

    Raises:
        InputError: where the mask is not of their size.
    """
    masks = []
    for picture in pictures:
        shape, alpha = picture.pixels.shape[:2], picture.alpha
        counts = alpha > 0 if alpha is not None and alpha.any() else None
        if mask is not None:
            came = f"is of shape {mask.shape}, the target {shape}"
            _require(mask.shape == shape, "mask", came, "Give a value per pixel")
            counts = mask if counts is None else counts & mask
        masks.append(counts)
    return masks


def ball_in(sphere: str, mask: Array | None) -> tuple[Circle, tuple[str, ...]]:
    """The ball that --sphere names, and what to tell where it was found in a mask.

    Args:
        sphere: "x,y,radius" or "mask".
        mask: true on the ball.

    Raises:
        InputError: where there is no mask, or no ball in it.
    """
    if sphere != "mask":
        return parse_circle(sphere), ()
    _require(mask is not None, "--sphere", "is to be found in the mask, but there is none", "Add --mask MASK.png")
    circle = find_circle(mask)
    return circle, (f"ball found at {circle.x:.2f},{circle.y:.2f},{circle.radius:.2f}",)


def _photographs(targets: list[Path], options: PictureOptions, pictures: Any, mask: Any, masks: Any) -> Any:
    """What the pixels of photographs under one distant light each see, the lights, and what to tell of it."""
    count, (height, width, channels), notes = len(targets), pictures[0].pixels.shape, ()
    light_errors: tuple[float, ...] = ()
    if options.normals is None:
        circle, notes = ball_in(options.sphere or "", mask)
        points = ball_points((height, width), circle)
    else:
        from fitting.maps.map_inputs import normal_map

        points = brdf.SurfacePoints.from_normals(normal_map(options.normals))
        came = f"is {points.mask.shape[1]} x {points.mask.shape[0]}, the pictures {width} x {height}"
        _require(points.mask.shape == (height, width), options.normals, came, "Give a normal for each pixel")
    if options.lights is not None:
        directions = _directions(options.lights, targets)
    elif options.light == "fit":
        found = [light_of(*one, points, options) for one in zip(targets, pictures, masks, strict=True)]
        directions, mean = [light.direction for light in found], sum(light.strength for light in found) / count
        for target, light in zip(targets, found, strict=True):
            brighter = f", {100 * (light.strength / mean - 1):+.1f} % bright" if count > 1 else ""
            direction = ",".join(f"{value:.4f}" for value in light.direction)
            notes += (f"light of {target.name} from its shading: {direction} {stated_error(light)}{brighter}",)
        light_errors = tuple(light.error for light in found)
    else:
        direction = parse_numbers(options.light or "", "--light", 3, "x,y,z: x right, y up, z to the camera; or fit")
        _require(any(direction), "--light", "must not have zero length, got 0,0,0", "Give a direction")
        directions = [direction] * count
    intensities = np.ones((count, 1))
    if options.intensities is not None:
        intensities = read_intensities(options.intensities, count)
        came = f"has {intensities.shape[1]} numbers a line, the pictures {channels} channels"
        _require(intensities.shape[1] in (1, channels), options.intensities, came, "Give one intensity per channel")
    return points, directions, intensities, light_errors, notes


def _directions(path: Path, targets: list[Path]) -> Any:
    """The light of each photograph: by its name from an ``.lp`` file, else line by line."""
    if path.suffix.lower() != ".lp":
        return read_directions(path, len(targets))
    from fitting.maps.map_inputs import read_lights

    names, directions = read_lights(path)
    by_name = {name.name: direction for name, direction in zip(names, directions, strict=True)}
    for target in targets:
        _require(target.name in by_name, path, f"names no {target.name}", "Name the photographs as the file does")
    return [by_name[target.name] for target in targets]


def light_of(
    target: Path,
    picture: brdf.Picture,
    mask: Array | None,
    points: "brdf.SurfacePoints",
    options: PictureOptions,
) -> Any:
    """The light of a photograph from its shading, a `fitting.photographs.distant_light.ShadingLight`.

    Args:
        target: the file.
        picture: of it.
        mask: pixels that count, as `visible` gives them, or None.
        points: what its pixels see.
        options: what it shows.

    Raises:
        InputError: naming the file.
    """
    from fitting.photographs.distant_light import light_from_shading

    counts = True if mask is None else mask
    with named_as({"picture": target}):
        return light_from_shading(picture, points, saturation=options.saturation, mask=counts, ambient=options.ambient)


def stated_error(light: Any) -> str:
    """What to say of the error of a light's direction.

    Args:
        light: as the shading tells it.
    """
    from fitting.photographs.distant_light import DOUBTFUL

    doubt = ""
    if light.direction[2] < BEHIND:
        doubt = THIN_CRESCENT
    elif light.unexplained > DOUBTFUL:
        share = 100 * light.unexplained
        doubt = f" (the shading leaves {share:.0f} % of the light unexplained: it can be off by several times that)"
    return f"± {light.error:.2g}°{doubt}"


def _read_photographs(path: Path, mask: Any) -> Any:
    """Pictures, points, directions and intensities of an archive.

    It holds images (K, H, W[, C]), normal (H, W, 3) and light_dirs (K, 3), and may hold light_intensities (K, C) and
    mask (H, W). Unsigned images span their type.
    """
    arrays = read_archive(path)
    images, normal, directions = arrays["images"], arrays["normal"], arrays["light_dirs"]
    came = f"holds {images.dtype}, of which it is not clear what is white"
    remedy = "Save unsigned integers, which span their type, or floats"
    _require(images.dtype.kind not in "bi", f"{path}: images", came, remedy)
    images = images[..., None] if images.ndim == 3 else images
    remedy = "Give (pictures, height, width, channels)"
    _require(images.ndim == 4 and images.size > 0, f"{path}: images", f"is of shape {images.shape}", remedy)
    count, height, width, channels = images.shape
    intensities = arrays.get("light_intensities", np.ones(count))
    intensities = intensities[:, None] if intensities.ndim == 1 else intensities
    mask = arrays.get("mask", np.ones((height, width))) if mask is None else mask
    for name, array, shape in (
        ("normal", normal, (height, width, 3)),
        ("light_dirs", directions, (count, 3)),
        ("light_intensities", intensities, (count, 1 if intensities.shape[1:] == (1,) else channels)),
        ("mask", mask, (height, width)),
    ):
        _require(array.shape == shape, f"{path}: {name}", f"is of shape {array.shape}", f"Give {shape}")
    points = brdf.SurfacePoints.from_normals(normal, mask=mask != 0)
    came = "has no normal" if np.all(mask) else "has no normal inside the mask"
    _require(np.any(points.mask), f"{path}: normal", came, "Give a direction (x, y, z) where the surface is")
    # As in a file: linear, integers with their largest code.
    is_code = images.dtype.kind == "u"
    bits, pixels = 8 * images.dtype.itemsize, images / float(np.iinfo(images.dtype).max if is_code else 1)
    top = 1.0 if is_code else None
    pictures = [brdf.Picture(one, None, "linear", "format", bits, top) for one in pixels.astype(np.float32)]
    return pictures, points, directions, intensities
