"""What the command is given: a picture with its scene, photographs of a ball, a photometric-stereo archive.

What does not go together is refused before JAX is imported, which takes longer than reading a picture.
"""

import dataclasses
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import brdf
from brdf.errors import InputError
from brdf.files import input_file, read_toml
from fitting.cli.common import PictureOptions, named_as
from fitting.photographs.archives import read_archive
from fitting.photographs.ball import Circle, ball_points, ball_seen, find_circle
from fitting.photographs.light_files import parse_numbers, read_directions, read_intensities

# Beyond these single precision has no numbers for the pixels.
EXPOSURES = 1e-12, 1e12
# Of each kind of input: the options that say what it says itself or nothing of it, why, and what to do.
REFUSED = {
    "archive": (
        ("light", "lights", "intensities", "scene", "sphere", "normals", "encoding"),
        "is what {} says itself",
        "Leave it out",
    ),
    "photographs": (("scene",), "says what --sphere or --normals says too", "Give one of them"),
    "scene": (
        ("light", "lights", "intensities"),
        "says where the light is, but nothing what the picture shows",
        "Add --sphere x,y,radius",
    ),
}


class FitInputs(NamedTuple):
    """Pictures and scenes to fit.

    Attributes:
        targets: the files of the pictures, or the archive.
        pictures: as many as scenes.
        scenes: what they show.
        masks: pixels that count in each, or None for all.
        notes: what was found out on the way, for the person who waits.
        light_errors: of the directions of lights that were found from the shading, in degrees.
    """

    targets: list[Path]
    pictures: list[brdf.Picture]
    scenes: list["brdf.Scene"]
    masks: list[Any]
    notes: tuple[str, ...] = ()
    light_errors: tuple[float, ...] = ()

    @property
    def silent(self) -> dict[Path, Any]:
        """The files that do not say how they are encoded, and as what they were read."""
        return {one.path: one.encoding for one in self.pictures if one.path and one.source == "assumed"}


def _require(fine: Any, where: object, what, remedy: str) -> None:
    if not fine:
        raise InputError(where, what, remedy)


def read_inputs(targets: list[Path], options: PictureOptions, encodings: dict[Path, Any] | None = None) -> FitInputs:
    """Read what the command was given, pictures, a folder or an archive, ready to fit.

    Photographs come as under light of intensity 1, so that each counts alike however bright its light was. Ambient
    light is taken to be the same in all of them, and its intensity, which nobody knows, as 1. Files that do not say how
    they are encoded are read by ``encodings``, else as it is assumed of them.
    """
    kind = "scene" if options.sphere is None and options.normals is None else "photographs"
    kind = "archive" if len(targets) == 1 and targets[0].suffix.lower() == ".npz" else kind
    _check_options(kind, targets, options)
    for beside in (options.normals, options.lights, options.intensities):
        if beside is not None:
            input_file(beside)
    mask = None if options.mask is None else brdf.read_mask(options.mask)
    if kind == "archive":
        (path,) = targets
        pictures, seen, directions, intensities = _archived(path)
        inputs = FitInputs(targets, _exposed(pictures, options), [], masks_of(pictures, mask))
        names = {"direction": f"{path}: light_dirs", "intensity": f"{path}: light_intensities"}
    else:
        inputs, file, tables = _read_pictures(kind, targets, options, encodings or {}, mask)
        if file is not None:
            return inputs._replace(scenes=[brdf.Scene.load(file, within=options.within, tables=tables)])
        points, seen, notes = _seen(inputs.pictures[0].pixels.shape[:2], options, mask)
        # A pixel that the ball's outline runs through shows what lies behind, too.
        on_it = np.asarray(points.mask)
        masks = [on_it if mask is None else on_it & mask for mask in inputs.masks]
        directions, inputs = _directions(inputs._replace(notes=notes, masks=masks), points, options)
        intensities, names = _intensities(options.intensities, inputs.pictures), {}
    pictures, around = inputs.pictures, np.ones((len(inputs.pictures), 1))
    if np.all(intensities > 0):
        pictures = [picture.scaled(1.0 / intensity) for picture, intensity in zip(pictures, intensities, strict=True)]
        intensities, around = around, 1.0 / intensities
    with named_as(names):
        scenes = [
            dataclasses.replace(
                seen,
                lights=(brdf.DirectionalLight(direction=direction, intensity=intensity),),
                ambient=ambient if options.ambient else None,
            )
            for direction, intensity, ambient in zip(directions, intensities, around, strict=True)
        ]
    return inputs._replace(pictures=pictures, scenes=scenes)


def _check_options(kind, targets: list[Path], options: PictureOptions) -> None:
    """Refuse options that do not belong together."""
    names, what, remedy = REFUSED[kind]
    for name in names:
        _require(getattr(options, name) is None, f"--{name}", what.format(targets[0].name), remedy)
    if kind == "photographs":
        for one, other in (("normals", "sphere"), ("light", "lights")):
            alone = None in (getattr(options, one), getattr(options, other))
            _require(alone, f"--{one}", f"says what --{other} says too", "Give one of them")
        remedy = "Give x,y,z, fit, or a file of directions"
        _require(options.light or options.lights, "--light", "or --lights has to say where the light is", remedy)
    if kind == "scene":
        count, remedy = len(targets), "Leave it out, or add [ambient] to the scene"
        _require(not options.ambient, "--ambient", "is what the scene file says", remedy)
        for path in targets[1:]:
            _require(path.suffix != ".toml", path, "is a scene, no picture", f"Write --scene {path}")
        what = f"tells what one picture shows, {count} are given"
        remedy = "Give one; in Python fitting.fit takes lists of pictures and of scenes"
        _require(options.scene is None or count == 1, "--scene", what, remedy)
        remedy = "Several pictures are fitted with --sphere or --normals, and --lights"
        _require(count == 1, "--sphere", f"{count} pictures come without their geometry", remedy)


def _read_pictures(kind, targets, options, encodings, mask):
    """Pictures of one size, which is that of their scene; and the scene file with its tables, where there is one."""
    file = tables = resolution = None
    if kind == "scene":
        target, file = _target_and_scene(targets[0], options.scene)
        targets, tables = [target], read_toml(file)
        camera = tables.get("camera")
        resolution = camera.get("resolution") if isinstance(camera, dict) else None
    pictures = [brdf.read_picture(path, encoding=encodings.get(path, options.encoding)) for path in targets]
    shapes = sorted({picture.pixels.shape for picture in pictures})
    height, width, _ = shapes[0]
    sizes = ", ".join(f"{shape[1]} x {shape[0]} x {shape[2]}" for shape in shapes)
    _require(len(shapes) == 1, targets[0], f"and the others differ in size ({sizes})", "Give pictures of one camera")
    if isinstance(resolution, list):
        what = f"is {width} x {height}, the scene's camera {' x '.join(map(str, resolution))}"
        remedy = "Give a picture and a camera of the same resolution"
        _require(resolution == [width, height], targets[0], what, remedy)
    pictures = _exposed(pictures, options)
    return FitInputs(targets, pictures, [], masks_of(pictures, mask)), file, tables


def _target_and_scene(target, scene):
    """The picture and the scene file that a file, or a folder with both, stands for."""
    if target.is_dir():
        found = sorted(path for path in target.glob("target.*") if path.is_file())
        _require(found, target, "has no file target.*", "Give the picture, or a folder that holds it")
        what = f"has several targets, {', '.join(path.name for path in found)}"
        _require(len(found) == 1, target, what, "Name the picture instead of the folder")
        return found[0], scene or target / "scene.toml"
    input_file(target)
    _require(scene, target, "comes without a scene", "Add --scene SCENE.toml, or --sphere for a photo of a ball")
    return target, scene


def _exposed(pictures: list[brdf.Picture], options) -> list[brdf.Picture]:
    """Pictures in one unit, by one relative exposure or one for each, as typed."""
    typed, count = options.exposure, len(pictures)
    if typed is None:
        return pictures
    wanted = count if len(typed.replace(",", " ").split()) == count else 1
    factors = parse_numbers(typed, "--exposure", wanted, "one number, or one each")
    least, most = EXPOSURES
    what = f"must be above 0, between {least:g} and {most:g}, got {typed[:60]!r}"
    _require(least <= min(factors) and max(factors) <= most, "--exposure", what, "Give a relative exposure time")
    return [picture.scaled(1.0 / factor) for picture, factor in zip(pictures, np.resize(factors, count), strict=True)]


def masks_of(pictures: list[brdf.Picture], mask: Any) -> list[Any]:
    """The mask, (H, W) or None, of each picture; refused where it is not of their size."""
    if mask is not None:
        for shape in (picture.pixels.shape[:2] for picture in pictures):
            what = f"is of shape {mask.shape}, the target {shape}"
            _require(mask.shape == shape, "mask", what, "Give a value per pixel")
    return [mask] * len(pictures)


def ball_in(sphere: str, mask: Any) -> tuple[Circle, tuple[str, ...]]:
    """The ball that --sphere names, "x,y,radius" or "mask", and what to tell where it was found in a mask."""
    if sphere != "mask":
        return Circle(*parse_numbers(sphere, "--sphere", 3, "x,y,radius in pixels")), ()
    _require(mask is not None, "--sphere", "is to be found in the mask, but there is none", "Add --mask MASK.png")
    circle = find_circle(mask)
    return circle, (f"ball found at {circle.x:.2f},{circle.y:.2f},{circle.radius:.2f}",)


def _seen(shape, options, mask):
    """What the pixels of photographs see, the same as a scene without lights, and what to tell of it."""
    if options.normals is None:
        circle, notes = ball_in(options.sphere, mask)
        return ball_points(shape, circle), ball_seen(shape, circle), notes
    from fitting.maps.map_inputs import normal_map

    points = brdf.SurfacePoints.from_normals(normal_map(options.normals))
    height, width = points.mask.shape
    what = f"is {width} x {height}, the pictures {shape[1]} x {shape[0]}"
    _require(points.mask.shape == shape, options.normals, what, "Give a normal for each pixel")
    return points, brdf.Scene(points=points), ()


def _directions(inputs, points, options) -> Any:
    """The direction of the light of each photograph; and the inputs with what the shading tells of it."""
    targets, file = inputs.targets, options.lights
    if file is not None and file.suffix.lower() == ".lp":
        from fitting.maps.map_inputs import named_directions

        return list(named_directions(file, [target.name for target in targets])), inputs
    if file is not None:
        return read_directions(file, len(targets)), inputs
    if options.light != "fit":
        direction = parse_numbers(options.light, "--light", 3, "x,y,z: x right, y up, z to the camera; or fit")
        _require(any(direction), "--light", "must not have zero length, got 0,0,0", "Give a direction")
        return [direction] * len(targets), inputs
    from fitting.photographs.distant_light import light_from_shading

    found, how = [], {"saturation": options.saturation, "ambient": options.ambient}
    for target, picture, mask in zip(targets, inputs.pictures, inputs.masks, strict=True):
        with named_as({"picture": target}):
            found.append(light_from_shading(picture, points, mask=mask, **how))
    mean, notes = np.mean([light.strength for light in found]), [*inputs.notes]
    for target, light in zip(targets, found, strict=True):
        brighter = f", {100 * (light.strength / mean - 1):+.1f} % bright" if len(found) > 1 else ""
        direction = ",".join(f"{value:.4f}" for value in light.direction)
        notes.append(f"light of {target.name} from its shading: {direction} {light.stated_error}{brighter}")
    errors = tuple(light.error for light in found)
    return [light.direction for light in found], inputs._replace(notes=tuple(notes), light_errors=errors)


def _intensities(path, pictures):
    """Of the light of each photograph, 1 where no file says them."""
    if path is None:
        return np.ones((len(pictures), 1))
    intensities, channels = read_intensities(path, len(pictures)), pictures[0].pixels.shape[2]
    what = f"has {intensities.shape[1]} numbers a line, the pictures {channels} channels"
    _require(intensities.shape[1] in (1, channels), path, what, "Give one intensity per channel")
    return intensities


def _archived(path):
    """Pictures, a scene without lights, directions and intensities of an archive.

    It holds images (K, H, W[, C]), normal (H, W, 3) and light_dirs (K, 3), and may hold light_intensities (K, C) and
    mask (H, W). Unsigned images span their type.
    """
    arrays = read_archive(path)
    images = arrays["images"]
    what = f"holds {images.dtype}, of which it is not clear what is white"
    remedy = "Save unsigned integers, which span their type, or floats"
    _require(images.dtype.kind not in "bi", f"{path}: images", what, remedy)
    images = images[..., None] if images.ndim == 3 else images
    what, remedy = f"is of shape {images.shape}", "Give (pictures, height, width, channels)"
    _require(images.ndim == 4 and images.size > 0, f"{path}: images", what, remedy)
    count, height, width, channels = images.shape
    arrays = {"mask": np.ones((height, width)), "light_intensities": np.ones(count)} | arrays
    intensities = arrays["light_intensities"]
    arrays["light_intensities"] = intensities = intensities[:, None] if intensities.ndim == 1 else intensities
    each = 1 if intensities.shape[1:] == (1,) else channels
    shapes = {"normal": (height, width, 3), "light_dirs": (count, 3), "light_intensities": (count, each)}
    for name, shape in (shapes | {"mask": (height, width)}).items():
        _require(arrays[name].shape == shape, f"{path}: {name}", f"is of shape {arrays[name].shape}", f"Give {shape}")
    points = brdf.SurfacePoints.from_normals(arrays["normal"], mask=arrays["mask"] != 0)
    what = "has no normal" if np.all(arrays["mask"]) else "has no normal inside the mask"
    _require(np.any(points.mask), f"{path}: normal", what, "Give a direction (x, y, z) where the surface is")
    # As in a file: linear, integers with their largest code.
    top, bits = 1.0 if images.dtype.kind == "u" else None, 8 * images.dtype.itemsize
    pixels = (images / (np.iinfo(images.dtype).max if top else 1)).astype(np.float32)
    pictures = [brdf.Picture(one, None, "linear", "format", bits, top) for one in pixels]
    return pictures, brdf.Scene(points=points), arrays["light_dirs"], intensities
