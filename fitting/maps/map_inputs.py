"""What maps are made of, in one form: photographs that are read by bands of rows, their lights, and what texels see."""

import dataclasses
import functools
import hashlib
import re
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Bool, Float, Int

import brdf
from brdf.checks import direction_value
from brdf.errors import InputError, as_numbers
from brdf.files import input_file, parse_number, read_text
from brdf.images.encoding import Encoding, decode, encode, parse_encoding
from fitting.photographs.archives import read_array
from fitting.photographs.light_files import MOST_BYTES, read_directions, read_intensities
from fitting.problem import TOP

PICTURES = (".exr", ".hdr", ".png", ".tif", ".tiff", ".jpg", ".jpeg")
# An image's code 0 in all channels, and those about the middle, are how tools write "no surface".
NO_SURFACE = 0.25


@dataclasses.dataclass(frozen=True)
class Photograph:
    """One photograph, which is read by bands of rows.

    Attributes:
        rows: linear values from one row to another.
        shape: height, width, channels.
        name: of the file or argument.
        top: from which value on it is clipped.
        curve: how it is encoded, which tells how exact its values are: noise is even in codes.
        lossy: whether it was compressed with losses.
        opaque: reads which pixels are not fully transparent, (H, W), or None where nobody says.
        step: distance of two codes, the largest being 1; 0 of floats.
        silent: whether it is a file of integers that does not say how it is encoded.
        stated: whether a user says from which value on it is clipped.
        layer: see `brdf.Picture`.
    """

    rows: Callable[[int, int], Float[np.ndarray, "rows W C"]]
    shape: tuple[int, ...]
    name: str
    top: float
    curve: Encoding
    lossy: bool
    opaque: Callable[[], Bool[np.ndarray, "H W"] | None]
    step: float
    silent: bool = False
    stated: bool = False
    layer: str | None = None

    def read_as(self, encoding: Encoding) -> "Photograph":
        """The same file read so, clipped at the same code, or at the linear value that was stated."""
        top = self.top if self.stated else float(decode(encode(np.array(self.top), self.curve), encoding))
        return dataclasses.replace(_opened(self.name, Path(self.name), encoding), top=top, stated=self.stated)


@dataclasses.dataclass(frozen=True)
class Photographs:
    """Photographs of one view, each under its own light.

    Attributes:
        each: of one size.
        unit: what each is divided by, (P, C).
        exposure: what of that ambient light is seen with, too, (P, C).
        to_light: unit, (P, 3); None where ``scenes`` tell.
        scenes: of each photograph with its one light, of intensity 1; None where all lights are distant.
        ambient: what the scenes say of ambient light, (P, C); None where they say nothing.
    """

    each: tuple[Photograph, ...]
    unit: Float[np.ndarray, "P C"]
    exposure: Float[np.ndarray, "P C"]
    to_light: Float[np.ndarray, "P 3"] | None = None
    scenes: tuple[brdf.Scene, ...] | None = None
    ambient: Float[np.ndarray, "P C"] | None = None

    @property
    def size(self) -> tuple[int, ...]:
        """Height, width and channels."""
        return self.each[0].shape

    def opaque(self) -> Bool[np.ndarray, "H W"]:
        """Pixels that no photograph has as fully transparent."""
        found = np.ones(self.size[:2], bool)
        for opaque in (one.opaque() for one in self.each):
            if opaque is not None:
                found &= opaque
        return found

    def tiles(
        self, texels: Int[np.ndarray, " K"], shape: tuple[int, int], lanes: int, precision: str
    ) -> Float[np.ndarray, "P N TILE C"]:
        """What some texels show in all photographs, in tiles of a shape for as many as are given or more.

        Texels are indices, row by row, that rise; black photographs are added up to a multiple of ``lanes``.
        """
        (_, width, channels), (count, size) = self.size, shape
        found = np.zeros((-(-len(self.each) // lanes) * lanes, count * size, channels), precision)
        row, column = np.divmod(texels, width)
        rows = row[np.diff(row, prepend=-1) != 0]
        some = places(np.searchsorted(rows, row) * width + column)
        runs = np.split(rows, np.flatnonzero(np.diff(rows) != 1) + 1)
        for one, values in zip(self.each, found, strict=False):
            parts = [one.rows(run[0], run[-1] + 1) for run in runs]
            shown = parts[0] if len(parts) == 1 else np.concatenate(parts)
            values[: texels.size] = shown.reshape(-1, channels)[some]
        return found.reshape(-1, count, size, channels)


def places(index: Int[np.ndarray, " K"]) -> Any:
    """Indices that rise, as a slice where they follow each other: that is not gathered."""
    follow = index.size and index[-1] - index[0] + 1 == index.size
    return slice(int(index[0]), int(index[-1]) + 1) if follow else index


def fingerprint(*parts: Any) -> str:
    """By which arrays and whatever holds them are known again: by their numbers."""
    leaves, structure = jax.tree.flatten(parts)
    digest = hashlib.sha256(str(structure).encode())
    for leaf in leaves:
        array = isinstance(leaf, np.ndarray | jax.Array)
        digest.update(np.ascontiguousarray(leaf).tobytes() if array else repr(leaf).encode())
    return digest.hexdigest()[:16]


def read_lights(path: str | Path) -> tuple[list[Path], Float[np.ndarray, "P 3"]]:
    """Photographs and their lights from an ``.lp`` file as RTI programs write it; refused with file and line.

    It holds a count, then a line ``name x y z`` a photograph. The last three words before a remark are the numbers: a
    name may hold blanks, and folders, which are looked for beside the file and then left out. A word that begins with
    ``#``, at the start of a line or after its numbers, begins a remark.
    """
    lines = [line.strip() for line in read_text(path, MOST_BYTES).replace("\\", "/").splitlines()]
    numbered = [(number, line) for number, line in enumerate(lines, start=1) if line.partition("#")[0]]
    names, directions = [], []
    for number, line in numbered[1:]:
        name, vector = _named_vector(line)
        if not np.all(np.isfinite(vector)) or not any(vector):
            what = f"must be a name and three numbers that are not all 0, got {line[:60]!r}"
            raise InputError(f"{path}: line {number}", what, "Give name x y z, towards the light")
        file = Path(path).parent / name.strip("\"'")
        names.append(file if file.is_file() else Path(path).parent / file.name)
        directions.append(vector)
    if not names or numbered[0][1].split()[0] != str(len(names)):
        what = f"has {len(names)} lights after the count {numbered[0][1] if numbered else ''!r}"
        raise InputError(path, what, "Give the count, then a line a photograph")
    return names, np.array(directions)


def _named_vector(line: str) -> tuple[str, list[float]]:
    """A name and the three numbers that end the line, or that a remark follows; no numbers where there are none."""
    words = list(re.finditer(r"[^\s,]+", line))
    for first in range(1, len(words) - 2):
        after = words[first + 3 : first + 4]
        if not after or after[0].group().startswith("#"):
            try:
                vector = [parse_number(word.group()) for word in words[first : first + 3]]
            except ValueError:
                continue
            if words[first - 1].group() == "#":  # these are of a remark
                break
            return line[: words[first - 1].end()], vector
    return "", []


def named_directions(path: str | Path, files: Sequence[str | Path]) -> Float[np.ndarray, "P 3"]:
    """The lights of some photographs, by their names, in an ``.lp`` file, which must name each once."""
    listed, directions = read_lights(path)
    index, paths = [], [one.resolve() for one in listed]
    for file in map(Path, files):
        # Of one name in several folders that of the folder.
        whole = file.resolve()
        found = [i for i, one in enumerate(paths) if one == whole]
        found = found or [i for i, one in enumerate(listed) if one.name == file.name]
        if len(found) != 1:
            what = f"names {file.name} {len(found)} times" if found else f"names no {file.name}"
            raise InputError(path, what, "Name each photograph once there, by the name of its file")
        index += found
    return directions[index]


def _by_number(path: Path) -> tuple[list[Any], str]:
    """What sorts 2.png before 10.png."""
    parts = re.split("([0-9]+)", path.name)
    return [int(part) if place % 2 else part for place, part in enumerate(parts)], path.name


def read_folder(folder: Path) -> dict[str, Any]:
    """What a folder of photographs says: ``pictures`` and ``lights``, and ``intensities``, ``mask``, ``normals``.

    It holds one ``.lp`` file, or ``filenames.txt`` and ``light_directions.txt`` as DiLiGenT has them; without the names
    photographs are taken in the order of the numbers in theirs. Hidden files are left out.
    """
    visible = sorted((path for path in folder.iterdir() if not path.name.startswith(".")), key=_by_number)
    tables, names = [path for path in visible if path.suffix.lower() == ".lp"], folder / "filenames.txt"
    found: dict[str, Any] = {}
    if len(tables) == 1:
        found["pictures"] = read_lights(tables[0])[0]
        found["lights"] = named_directions(tables[0], found["pictures"])
    elif (folder / "light_directions.txt").is_file() and not tables:
        lines = read_text(names, MOST_BYTES).split("\n") if names.is_file() else []
        listed = [folder / line.strip() for line in lines if line.strip()]
        beside = ("mask", "normal")
        every = [path for path in visible if path.suffix.lower() in PICTURES]
        found["pictures"] = listed or [path for path in every if not path.stem.lower().startswith(beside)]
        found["lights"] = read_directions(folder / "light_directions.txt", len(found["pictures"]))
        if (folder / "light_intensities.txt").is_file():
            found["intensities"] = read_intensities(folder / "light_intensities.txt", len(found["pictures"]))
    else:
        what = f"has {len(tables)} .lp files and no light_directions.txt" if tables else "has no file of lights"
        raise InputError(folder, what, "Put one lights.lp, or light_directions.txt, beside the photographs")
    for key in ("mask", "normals"):
        beside = [path for path in sorted(folder.glob(f"{key}.*")) if path.suffix.lower() in (*PICTURES, ".npy")]
        found |= {key: beside[0]} if beside else {}
    return found


def normal_map(given: Any, *, flip_y: bool = False) -> Float[np.ndarray, "H W 3"]:
    """Normals, (H, W, 3), from an array, .npy, .exr, or an image of 8 or 16 bits; 0 where there is no surface.

    Floats are taken as they are, codes as n·0.5 + 0.5; ``flip_y`` where y goes down there.
    """
    name, coded, normal = "normals", False, given
    if isinstance(given, str | Path):
        name = str(given)
        if name.lower().endswith(".npy"):
            with input_file(given).open("rb") as file:
                normal = read_array(file, given)
        else:
            with brdf.ImageReader(given, encoding="linear") as reader:
                normal, coded = reader.read(), reader.is_integer
    normal = np.asarray(normal)
    if normal.ndim != 3 or normal.shape[2] != 3 or normal.dtype.kind not in "fiu":
        what = f"must be of shape (H, W, 3), got {normal.shape} of {normal.dtype}"
        raise InputError(name, what, "Give a normal for each pixel")
    if normal.dtype.kind == "u":
        normal, coded = normal / np.float32(np.iinfo(normal.dtype).max), True
    if coded:
        empty, normal = np.all(normal == 0, axis=-1), 2 * normal - 1
        normal[empty | (np.sum(normal * normal, axis=-1) < NO_SURFACE)] = 0
    elif white := next((white for white in (1, 255, 65535) if _looks_coded(normal, white)), None):
        decoded = "2 n - 1" if white == 1 else f"2 n / {white} - 1"
        what = f"hold n·0.5 + 0.5, as images do: {decoded} is of length 1, and nothing is below 0"
        raise InputError(name, what, f"Give {decoded}, or the codes of the image as unsigned integers")
    return normal * np.array([1, -1 if flip_y else 1, 1], np.float32)


def _looks_coded(normal: np.ndarray, white: int) -> bool:
    if np.any(normal < 0):
        return False
    there = normal[np.all(np.isfinite(normal), axis=-1) & np.any(normal != 0, axis=-1)].astype(float) / white
    plain, decoded = (np.median(np.abs(np.sum(n * n, axis=-1) - 1)) if n.size else 0.0 for n in (there, 2 * there - 1))
    return bool(decoded < 0.05 < plain)


def photographs(
    pictures: Any, lights: Any, intensities: Any = None, exposures: Any = None, encoding: Any = None
) -> Photographs:
    """Photographs and lights in one form.

    Args:
        pictures: (P, H, W, C) or (P, H, W) linear values; unsigned integers span their type. Or a list of such
            pictures, `brdf.Picture`, `brdf.ImageReader`, or files.
        lights: (P, 3) towards the lights, P lights, P scenes with one light each, or a text file, or an ``.lp`` file:
            photographs that are files have the lights of their names there, others those of their places.
        intensities: (P,) or (P, C), which the photographs are divided by.
        exposures: (P,), likewise.
        encoding: of files and arrays.

    Raises:
        InputError: naming the photograph or argument.
    """
    for name, given in (("pictures", pictures), ("lights", lights)):
        if not isinstance(given, Iterable | Path):
            what = "are missing" if given is None else f"must be a list, got {type(given).__name__}"
            raise InputError(name, what, "Give a photograph for each light, and a direction towards each light")
    pictures = list(pictures)
    each = [_opened(f"pictures[{i}]", picture, encoding) for i, picture in enumerate(pictures)]
    if not each:
        raise InputError("pictures", "is empty", "Give a photograph for each light")
    first = each[0]
    for one in each:
        if one.shape != first.shape:
            what = f"is of shape {one.shape}, {first.name} of {first.shape}"
            raise InputError(one.name, what, "Give photographs of one size")
    if isinstance(lights, str | Path):
        files = [picture if isinstance(picture, str | Path) else getattr(picture, "path", None) for picture in pictures]
        if Path(lights).suffix.lower() != ".lp":
            lights = read_directions(lights)
        elif None in files:
            lights = read_lights(lights)[1]
        else:
            lights = named_directions(lights, [file for file in files if file is not None])
    lights = list(lights)
    if len(lights) != len(each):
        raise InputError("lights", f"are {len(lights)} for {len(each)} photographs", "Give a light for each photograph")
    factors = functools.partial(_factors, len(each), first.shape[2])
    one = np.ones(len(each))
    exposure = factors("exposures", one if exposures is None else exposures)
    unit = exposure * factors("intensities", one if intensities is None else intensities)
    if all(isinstance(light, brdf.Scene) for light in lights):
        if other := next((i for i, scene in enumerate(lights) if _view(scene) != _view(lights[0])), 0):
            what = "has another camera, or other shapes or points, than lights[0]"
            raise InputError(f"lights[{other}]", what, "Give scenes of one view that differ in their lights")
        scenes, colours, ambient = zip(
            *(_of_scene(f"lights[{i}]", scene, first.shape[2]) for i, scene in enumerate(lights)), strict=True
        )
        unit = unit * factors("lights", colours)
        ambient = np.array(ambient) if np.any(ambient) else None
        return Photographs(tuple(each), unit, exposure, scenes=scenes, ambient=ambient)
    if all(isinstance(light, brdf.DirectionalLight) for light in lights):
        colours = [np.broadcast_to(np.asarray(light.intensity), first.shape[2:]) for light in lights]
        unit, lights = unit * factors("lights", colours), [light.direction for light in lights]
    return Photographs(tuple(each), unit, exposure, _directions(lights))


def _opened(name: str, picture: Any, encoding: Any) -> Photograph:
    if isinstance(picture, str | Path):
        reader = brdf.ImageReader(picture, encoding=encoding)
        silent = reader.is_integer and reader.source in ("assumed", "format")
        return dataclasses.replace(_opened(str(picture), reader, None), silent=silent)
    curve = parse_encoding("encoding", encoding) or "linear"
    if isinstance(picture, brdf.ImageReader | brdf.Picture):
        if encoding is not None:
            raise InputError("encoding", f"is that of files and arrays, {name} is decoded", "Leave it out")
        if isinstance(picture, brdf.ImageReader):
            read, shape, top, opaque = picture.rows, picture.shape, picture.codes[0], picture.read_opaque
            step = picture.is_integer / (2**picture.bits - 1)
        else:
            read, shape, top = (lambda a, b: picture.pixels[a:b]), picture.pixels.shape, picture.saturation
            opaque, step = (lambda: picture.opaque), (picture.code_step or 0.0) * np.max(picture.factor)
        found = Photograph(read, shape, name, (top or np.inf) * TOP, picture.encoding, picture.lossy, opaque, step)
        return dataclasses.replace(found, layer=picture.layer)
    values = np.asarray(picture)
    values = values[..., None] if values.ndim == 2 else values
    integer = values.dtype.kind == "u"
    if values.ndim != 3 or 0 in values.shape or values.dtype.kind not in "fu":
        what = f"is of shape {values.shape} and type {values.dtype}"
        raise InputError(name, what, "Give (H, W, C) floats, or unsigned integers that span their type")
    white = np.float32(np.iinfo(values.dtype).max) if integer else np.float32(np.inf)

    def rows(start: int, stop: int) -> np.ndarray:
        part = values[start:stop]
        return decode(part / white if integer else part, curve)

    top = TOP if integer else np.inf
    return Photograph(rows, values.shape, name, top, curve, lossy=False, opaque=lambda: None, step=float(1 / white))


def _factors(count: int, channels: int, name: str, given: Any) -> Float[np.ndarray, "P C"]:
    values = as_numbers(name, given, remedy="Give a number for each photograph")
    values = values[:, None] if values.ndim == 1 else values
    if values.ndim != 2 or values.shape[0] != count or values.shape[1] not in (1, channels):
        what = f"is of shape {np.shape(given)} for {count} photographs of {channels} channels"
        raise InputError(name, what, "Give a number for each photograph, or one for each of its channels")
    if not np.all((values > 0) & np.isfinite(values)):
        raise InputError(name, f"must be above 0, got {np.min(values):g}", "Leave that photograph out")
    return np.broadcast_to(values, (count, channels))


def _directions(given: Any) -> Float[np.ndarray, "P 3"]:
    rows = as_numbers("lights", given, remedy="Give directions, or for lights that are near a scene with each")
    vectors = np.array([direction_value(f"lights[{i}]", row) for i, row in enumerate(rows)])
    if np.all(vectors[:, 2] < 0):
        raise InputError("lights", "all come from behind the surface", "Give directions towards the lights: z > 0")
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def _view(scene: brdf.Scene) -> str:
    """What texels see is asked of the first scene."""
    return fingerprint(dataclasses.replace(scene, ambient=None, lights=(), visibility=()))


def _of_scene(name: str, scene: brdf.Scene, channels: int) -> tuple[brdf.Scene, np.ndarray, np.ndarray]:
    """A scene whose one light is of intensity 1, what that was, and its ambient light."""
    if len(scene.lights) != 1 or isinstance(scene.lights[0], brdf.EnvironmentMap):
        what = f"has {len(scene.lights)} lights" if len(scene.lights) != 1 else "is lit by an environment map"
        raise InputError(name, what, "Give scenes with one light each, of one colour")
    ambient = np.zeros(channels) if scene.ambient is None else np.asarray(scene.ambient)
    if len(ambient) not in (1, channels):
        what = f"has ambient light of {len(ambient)} channels, the photographs have {channels}"
        raise InputError(name, what, "Give as many as the photographs have, or one for all")
    (light,) = scene.lights
    white = eqx.tree_at(lambda one: one.emittance, light, np.ones(1))
    colour = _factors(1, channels, name, np.asarray(light.emittance)[None])[0]
    return dataclasses.replace(scene, lights=(white,), ambient=None), colour, np.broadcast_to(ambient, channels)
