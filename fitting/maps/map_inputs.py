"""What maps are made of, in one form: photographs that are read by bands of rows, their lights, and what texels see."""

import dataclasses
from collections.abc import Callable, Iterable
from concurrent.futures import Executor
from functools import partial
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float, Num

import brdf
from brdf.errors import InputError, as_numbers
from brdf.files import parse_number, read_text
from brdf.images.encoding import Encoding, decode, parse_encoding
from fitting.photographs.archives import read_array
from fitting.photographs.light_files import MOST_BYTES, read_directions, read_intensities

PICTURES = (".exr", ".hdr", ".png", ".tif", ".tiff", ".jpg", ".jpeg")
# An image's code 0 in all channels, and those about the middle, are how tools write "no surface".
NO_SURFACE = 0.25
# Values are clipped from the largest on, but for rounding.
BELOW_TOP = 1 - 1e-6


@dataclasses.dataclass(frozen=True)
class Photographs:
    """Photographs of one view, each under its own light.

    Attributes:
        rows: of each photograph, those from one to another, codes or linear values.
        shape: count, height, width, channels.
        to_light: unit, (P, 3); None where ``scenes`` tell.
        scenes: of each photograph with its one light, of intensity 1; None where all lights are distant.
        ambient: what the scenes say of ambient light, (P, C); None where they say nothing.
        unit: what each photograph is divided by, (P, C).
        codes: the type of ``rows`` where these are codes; None for linear values.
        top: values from which on they are clipped, (P,).
        scale: what values are multiplied with, (P, C): the inverse of ``unit``, and of the largest code.
        curves: how each photograph is encoded, which tells how exact its values are: noise is even in codes.
        silent: names of files of 8 bits that do not say how they are encoded, which were read as sRGB.
        names: of the photographs.
        encoding: as which files and arrays were read, None for what they say.
    """

    rows: tuple[Callable[[int, int], Num[np.ndarray, "rows W C"]], ...]
    shape: tuple[int, int, int, int]
    to_light: Float[np.ndarray, "P 3"] | None
    scenes: tuple[brdf.Scene, ...] | None
    ambient: Float[np.ndarray, "P C"] | None
    unit: Float[np.ndarray, "P C"]
    codes: np.dtype | None
    top: Float[np.ndarray, " P"]
    scale: Float[np.ndarray, "P C"]
    curves: tuple[Encoding, ...]
    silent: tuple[str, ...]
    names: tuple[str, ...]
    encoding: Any

    def as_linear(self) -> "Photographs":
        """The same, silent files read as linear light."""
        readers = {name: brdf.ImageReader(name, encoding="linear") for name in self.silent}
        rows = [
            readers[name].rows if name in readers else read for name, read in zip(self.names, self.rows, strict=True)
        ]
        top = [_top(readers[name]) if name in readers else top for name, top in zip(self.names, self.top, strict=True)]
        curves = ["linear" if name in readers else curve for name, curve in zip(self.names, self.curves, strict=True)]
        return dataclasses.replace(self, rows=tuple(rows), top=np.array(top), curves=tuple(curves), encoding="linear")

    def band(
        self, rows: np.ndarray, texels: int, precision: str, pool: Executor | None = None
    ) -> Num[np.ndarray, "P texels C"]:
        """Some rows of all photographs, one after the other, padded to so many texels.

        Args:
            rows: indices that rise.
            texels: at least as many as the rows have.
            precision: of the result, where values are no codes.
            pool: reads several photographs at a time.
        """
        runs = [(run[0], run[-1] + 1) for run in np.split(rows, np.flatnonzero(np.diff(rows) != 1) + 1)]
        count, _, width, channels = self.shape
        found = np.empty((count, texels, channels), self.codes or precision)

        def fill(photograph: np.ndarray, read: Any) -> None:
            end = 0
            for start, stop in runs:
                begin, end = end, end + (stop - start) * width
                photograph[begin:end] = read(start, stop).reshape(-1, channels)
            photograph[end:] = 0

        list((map if pool is None else pool.map)(fill, found, self.rows))
        return found


def read_lights(path: str | Path) -> tuple[list[Path], Float[np.ndarray, "P 3"]]:
    """Photographs and their lights from a file as RTI programs write it.

    Args:
        path: an ``.lp`` file: a count, then a line ``name x y z`` a photograph. The last three words are the numbers:
            a name may hold blanks, and folders, which are looked for beside the file and then left out. Lines that
            begin with ``#`` are remarks.

    Raises:
        InputError: naming file and line.
    """
    lines = [line.strip() for line in read_text(path, MOST_BYTES).replace("\\", "/").splitlines()]
    numbered = [(number, line) for number, line in enumerate(lines, start=1) if line.partition("#")[0]]
    names, directions = [], []
    for number, line in numbered[1:]:
        words = line.replace(",", " ").replace("\t", " ").split()
        try:
            vector = [parse_number(word) for word in words[-3:]]
        except ValueError:
            vector = []
        if len(words) < 4 or not np.all(np.isfinite(vector)) or not any(vector):
            came = f"must be a name and three numbers that are not all 0, got {line[:60]!r}"
            raise InputError(f"{path}: line {number}", came, "Give name x y z, towards the light")
        for word in reversed(words[-3:]):
            line = line[: line.rindex(word)]
        name = Path(line.rstrip(" ,\t").strip("\"'"))
        folder = Path(path).parent
        names.append(folder / name if (folder / name).is_file() else folder / name.name)
        directions.append(vector)
    if not names or numbered[0][1].split()[0] != str(len(names)):
        came = f"has {len(names)} lights after the count {numbered[0][1] if numbered else ''!r}"
        raise InputError(path, came, "Give the count, then a line a photograph")
    return names, np.array(directions)


def read_folder(folder: Path) -> dict[str, Any]:
    """What a folder of photographs says: ``pictures`` and ``lights``, and ``intensities``, ``mask``, ``normals``.

    Args:
        folder: with one ``.lp`` file, or with ``filenames.txt`` and ``light_directions.txt`` as DiLiGenT has them.

    Raises:
        InputError: naming what is missing.
    """
    tables, names = sorted(folder.glob("*.lp")), folder / "filenames.txt"
    found: dict[str, Any] = {}
    if len(tables) == 1:
        found["pictures"], found["lights"] = read_lights(tables[0])
    elif (folder / "light_directions.txt").is_file() and not tables:
        lines = read_text(names, MOST_BYTES).split("\n") if names.is_file() else []
        listed = [folder / line.strip() for line in lines if line.strip()]
        beside = ("mask", "normal")
        every = [path for path in sorted(folder.iterdir()) if path.suffix.lower() in PICTURES]
        found["pictures"] = listed or [path for path in every if not path.stem.lower().startswith(beside)]
        found["lights"] = read_directions(folder / "light_directions.txt", len(found["pictures"]))
        if (folder / "light_intensities.txt").is_file():
            found["intensities"] = read_intensities(folder / "light_intensities.txt", len(found["pictures"]))
    else:
        came = f"has {len(tables)} .lp files and no light_directions.txt" if tables else "has no file of lights"
        raise InputError(folder, came, "Put one lights.lp, or light_directions.txt, beside the photographs")
    for key, stem in (("mask", "mask"), ("normals", "normals")):
        beside = [path for path in sorted(folder.glob(f"{stem}.*")) if path.suffix.lower() in (*PICTURES, ".npy")]
        found |= {key: beside[0]} if beside else {}
    return found


def normal_map(given: Any, *, flip_y: bool = False) -> Float[np.ndarray, "H W 3"]:
    """Normals from an array or a file: floats as they are, codes as n·0.5 + 0.5; 0 where there is no surface.

    Args:
        given: (H, W, 3); or .npy, .exr, or an image of 8 or 16 bits.
        flip_y: whether y goes down there.

    Raises:
        InputError: naming the file or the argument.
    """
    name, coded = "normals", False
    if not isinstance(given, str | Path):
        normal = np.asarray(given)
    elif Path(given).suffix.lower() == ".npy":
        name = str(given)
        with Path(given).open("rb") as file:
            normal = np.array(read_array(file, given, Path(given).stat().st_size))
    else:
        name = str(given)
        with brdf.ImageReader(given, encoding="linear") as reader:
            normal, coded = reader.read(), reader.is_integer
    if normal.ndim != 3 or normal.shape[2] != 3 or normal.dtype.kind not in "fiu":
        came = f"must be of shape (H, W, 3), got {normal.shape} of {normal.dtype}"
        raise InputError(name, came, "Give a normal for each pixel")
    if normal.dtype.kind == "u":
        normal, coded = normal / np.float32(np.iinfo(normal.dtype).max), True
    if coded:
        empty, normal = np.all(normal == 0, axis=-1), 2 * normal - 1
        normal[empty | (np.sum(normal * normal, axis=-1) < NO_SURFACE)] = 0
    elif _looks_coded(normal):
        came = "hold n·0.5 + 0.5, as images do: 2 n - 1 is of length 1, and nothing is below 0"
        raise InputError(name, came, "Give 2 n - 1, or the codes of the image")
    return normal * np.array([1, -1 if flip_y else 1, 1], np.float32)


def _looks_coded(normal: np.ndarray) -> bool:
    there = normal[np.all(np.isfinite(normal), axis=-1) & np.any(normal != 0, axis=-1)].astype(float)
    plain, decoded = (np.median(np.abs(np.sum(n * n, axis=-1) - 1)) if n.size else 0.0 for n in (there, 2 * there - 1))
    return bool(np.all(there >= 0) and decoded < 0.05 < plain)


def photographs(
    pictures: Any, lights: Any, intensities: Any = None, exposures: Any = None, encoding: Any = None
) -> Photographs:
    """Photographs and lights in one form.

    Args:
        pictures: (P, H, W, C) or (P, H, W) linear values; unsigned integers span their type. Or a list of such
            pictures, `brdf.Picture`, `brdf.ImageReader`, or files.
        lights: (P, 3) towards the lights, P lights, P scenes with one light each, or an ``.lp`` or text file.
        intensities: (P,) or (P, C), which the photographs are divided by.
        exposures: (P,), likewise.
        encoding: of files and arrays.

    Raises:
        InputError: naming the photograph or argument.
    """
    for name, given in (("pictures", pictures), ("lights", lights)):
        if not isinstance(given, Iterable):
            came = "are missing" if given is None else f"must be a list, got {type(given).__name__}"
            raise InputError(name, came, "Give a photograph for each light, and a direction towards each light")
    opened = [_open(f"pictures[{i}]", picture, encoding) for i, picture in enumerate(pictures)]
    if not opened:
        raise InputError("pictures", "is empty", "Give a photograph for each light")
    rows, shapes, names, silent, types, tops, curves = zip(*opened, strict=True)
    for name, shape in zip(names, shapes, strict=True):
        if shape != shapes[0]:
            raise InputError(name, f"is of shape {shape}, {names[0]} of {shapes[0]}", "Give photographs of one size")
    count, channels = len(rows), shapes[0][2]
    if isinstance(lights, str | Path):
        lights = read_lights(lights)[1] if Path(lights).suffix.lower() == ".lp" else read_directions(lights)
    lights = list(lights)
    if len(lights) != count:
        raise InputError("lights", f"are {len(lights)} for {count} photographs", "Give a light for each photograph")
    unit = np.ones((count, channels))
    for name, given in (("intensities", intensities), ("exposures", exposures)):
        if given is not None:
            unit = unit * _factors(name, given, count, channels)
    to_light, scenes, ambient = None, None, None
    if all(isinstance(light, brdf.Scene) for light in lights):
        _refuse_other_views(lights)
        ambient = _ambient(lights, channels)
        scenes, colours = zip(*(_white(f"lights[{i}]", scene) for i, scene in enumerate(lights)), strict=True)
        unit = unit * [_factors(f"lights[{i}]", one[None], 1, channels)[0] for i, one in enumerate(colours)]
    elif all(isinstance(light, brdf.DirectionalLight) for light in lights):
        to_light = _directions([light.direction for light in lights])
        unit = unit * [_factors("lights", np.asarray(light.intensity)[None], 1, channels)[0] for light in lights]
    else:
        to_light = _directions(lights)
    codes = types[0] if len(set(types)) == 1 and types[0].kind == "u" else None
    if codes is None:
        rows = [partial(_linear, read, kind) for read, kind in zip(rows, types, strict=True)]
        tops = [1.0 if kind.kind == "u" else top for top, kind in zip(tops, types, strict=True)]
    scale = 1 / (unit if codes is None else unit * np.iinfo(codes).max)
    told = tuple(filter(None, silent))
    return Photographs(
        tuple(rows),
        (count, *shapes[0]),
        to_light,
        scenes,
        ambient,
        unit,
        codes,
        np.array(tops),
        scale,
        curves,
        told,
        names,
        encoding,
    )


def _linear(read: Any, kind: np.dtype, start: int, stop: int) -> np.ndarray:
    values = read(start, stop)
    return values / np.float32(np.iinfo(kind).max) if kind.kind == "u" else values


def _open(
    name: str, picture: Any, encoding: Any
) -> tuple[Any, tuple[int, int, int], str, str, np.dtype, float, Encoding]:
    """A photograph.

    Returns:
        How to read rows of it; height, width and channels; its name, and that again where it is silent on its encoding;
        the type of the rows, from where on they are clipped, and how they were encoded.
    """
    of_path = isinstance(picture, str | Path)
    if of_path:
        name, picture = str(picture), brdf.ImageReader(picture, encoding=encoding)
    curve = parse_encoding("encoding", encoding) or "linear"
    if not of_path and encoding is not None and isinstance(picture, brdf.ImageReader | brdf.Picture):
        raise InputError("encoding", f"is that of files and arrays, {name} is decoded", "Leave it out")
    if isinstance(picture, brdf.ImageReader):
        silent = of_path and picture.is_integer and picture.bits <= 8 and picture.source in ("assumed", "format")
        silent = name if silent else ""
        return picture.rows, picture.shape, name, silent, np.dtype(np.float32), _top(picture), picture.encoding
    top = np.inf
    if isinstance(picture, brdf.Picture):
        curve, top = picture.encoding, (picture.saturation or np.inf) * BELOW_TOP
        picture = picture.pixels
        return lambda start, stop: picture[start:stop], picture.shape, name, "", picture.dtype, top, curve
    values = np.asarray(picture)
    values = values[..., None] if values.ndim == 2 else values
    if values.ndim != 3 or 0 in values.shape or values.dtype.kind not in "fu":
        came = f"is of shape {values.shape} and type {values.dtype}"
        raise InputError(name, came, "Give (H, W, C) floats, or unsigned integers that span their type")
    if curve != "linear":
        top = BELOW_TOP if values.dtype.kind == "u" else top
        read = partial(_linear, lambda start, stop: values[start:stop], values.dtype)
        kind = np.dtype(np.float32)
        return lambda start, stop: decode(read(start, stop), curve), values.shape, name, "", kind, top, curve
    top = np.iinfo(values.dtype).max if values.dtype.kind == "u" else top
    return lambda start, stop: values[start:stop], values.shape, name, "", values.dtype, top, curve


def _top(reader: brdf.ImageReader) -> float:
    return (reader.codes[0] or np.inf) * BELOW_TOP


def _factors(name: str, given: Any, count: int, channels: int) -> Float[np.ndarray, "P C"]:
    values = as_numbers(name, given, remedy="Give a number for each photograph")
    values = values[:, None] if values.ndim == 1 else values
    if values.ndim != 2 or values.shape[0] != count or values.shape[1] not in (1, channels):
        came = f"is of shape {np.shape(given)} for {count} photographs of {channels} channels"
        raise InputError(name, came, "Give a number for each photograph, or one for each of its channels")
    if not np.all((values > 0) & np.isfinite(values)):
        raise InputError(name, f"must be above 0, got {np.min(values):g}", "Leave that photograph out")
    return np.broadcast_to(values, (count, channels))


def _directions(given: Any) -> Float[np.ndarray, "P 3"]:
    vectors = as_numbers("lights", given, remedy="Give directions, or for lights that are near a scene with each")
    if vectors.ndim != 2 or vectors.shape[1] != 3:
        raise InputError("lights", f"are of shape {vectors.shape}", "Give (P, 3) directions towards the lights")
    length = np.sqrt(np.sum(vectors * vectors, axis=1))
    if not np.all((length > 0) & np.isfinite(length)):
        worst = int(np.argmin(np.where(np.isfinite(length), length, -1)))
        raise InputError(f"lights[{worst}]", f"has no direction, got {vectors[worst].tolist()}", "Give x, y, z")
    return vectors / length[:, None]


def _ambient(scenes: list[brdf.Scene], channels: int) -> Float[np.ndarray, "P C"] | None:
    """Intensities of the scenes' ambient light; None where there is none."""
    found = np.zeros((len(scenes), channels))
    for index, scene in enumerate(scenes):
        if scene.ambient is not None:
            if len(scene.ambient) not in (1, channels):
                came = f"has ambient light of {len(scene.ambient)} channels, the photographs have {channels}"
                raise InputError(f"lights[{index}]", came, "Give as many as the photographs have, or one for all")
            found[index] = scene.ambient
    return found if np.any(found) else None


def _refuse_other_views(scenes: list[brdf.Scene]) -> None:
    """What texels see is asked of the first scene."""
    views = [jax.tree.flatten(dataclasses.replace(one, ambient=None, lights=(), visibility=())) for one in scenes]
    leaves, structure = views[0]
    for index, (others, form) in enumerate(views[1:], start=1):
        same = form == structure and all(
            one is other or np.array_equal(one, other, equal_nan=True)
            for one, other in zip(leaves, others, strict=True)
        )
        if not same:
            came = "has another camera, or other shapes or points, than lights[0]"
            raise InputError(f"lights[{index}]", came, "Give scenes of one view that differ in their lights")


def _white(name: str, scene: brdf.Scene) -> tuple[brdf.Scene, np.ndarray]:
    """A scene whose one light is of intensity 1, and what that was."""
    if len(scene.lights) != 1 or isinstance(scene.lights[0], brdf.EnvironmentMap):
        came = f"has {len(scene.lights)} lights" if len(scene.lights) != 1 else "is lit by an environment map"
        raise InputError(name, came, "Give scenes with one light each, of one colour")
    (light,) = scene.lights
    white = eqx.tree_at(lambda one: one.emittance, light, np.ones(1))
    return dataclasses.replace(scene, lights=(white,), ambient=None), np.asarray(light.emittance)
