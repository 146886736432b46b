"""scene.toml in and out. Strict: an unknown key, a wrong type or a missing value names file, table and key."""

import dataclasses
import json
import tomllib
from pathlib import Path
from typing import Any

import numpy as np

from brdf.camera import CAMERAS, Camera
from brdf.errors import InputError
from brdf.files import read_text, write_text
from brdf.images import read_layers, write_layers
from brdf.lights import LIGHTS
from brdf.scene import Scene, SurfacePoints
from brdf.shapes import Rectangle, Shape, Sphere

SHAPES: dict[str, type[Shape]] = {"sphere": Sphere, "rectangle": Rectangle}
POSITION_LAYERS = ("position", "P")
NORMAL_LAYERS = ("normal", "sh_normal", "N")
VIEW_LAYERS = ("to_view",)


class _Table:
    """One table of the file: hands out its keys, and knows which nobody asked for."""

    def __init__(self, place: str, values: Any):
        if not isinstance(values, dict):
            raise InputError(place, f"must be a table, got {values!r}", "Write it as a [table]")
        self.place = place
        self.values = dict(values)

    def pop(self, key: str, default: Any = None) -> Any:
        return self.values.pop(key, default)

    def choose(self, key: str, choices: dict[str, Any]) -> Any:
        """The class that the table's ``type`` names."""
        known = ", ".join(choices)
        if key not in self.values:
            raise InputError(self.place, f"has no {key}", f"Add {key} = one of {known}")
        value = self.pop(key)
        if not isinstance(value, str) or value not in choices:
            raise InputError(f"{self.place}.{key}", f"is unknown, got {value!r}", f"Use one of {known}")
        return choices[value]

    def done(self, known: list[str]) -> None:
        if self.values:
            key = next(iter(self.values))
            raise InputError(f"{self.place}.{key}", "is not a known key", f"Known here: {', '.join(known)}")

    def build(self, cls: type) -> Any:
        """An object from the keys that bear its fields' names."""
        fields = {field.name: field for field in dataclasses.fields(cls)}
        values = {name: _plain(f"{self.place}.{name}", self.pop(name)) for name in fields if name in self.values}
        self.done(list(fields))
        missing = [name for name, field in fields.items() if name not in values and not _has_default(field)]
        if missing:
            raise InputError(self.place, f"has no {missing[0]}", f"Add {missing[0]} = ...")
        try:
            return cls(**values)
        except InputError as error:
            raise error.inside(self.place) from None


def _has_default(field: Any) -> bool:
    return field.default is not dataclasses.MISSING or field.default_factory is not dataclasses.MISSING


def _plain(place: str, value: Any) -> Any:
    """A value of the file, refused where Python would silently read a truth value or text as a number."""
    numbers = value if isinstance(value, list) else [value]
    if any(isinstance(number, bool) for number in numbers) and not place.endswith(".fitted"):
        raise InputError(place, f"must be a number, got {json.dumps(value)}", "Give numbers")
    if place.endswith(".fitted") and not isinstance(value, bool):
        raise InputError(place, f"must be true or false, got {value!r}", "Correct the value")
    if isinstance(value, list) and any(isinstance(number, str) for number in value):
        raise InputError(place, f"must be numbers, got {value!r}", "Give numbers without quotes")
    if isinstance(value, str) and not place.endswith((".viewer", ".file")):
        raise InputError(place, f"must be a number, got {value!r}", "Give numbers without quotes")
    return value


def _tables(place: str, values: Any) -> list[_Table]:
    if not isinstance(values, list):
        raise InputError(place, "must be a list of tables", f"Write [[{place.rpartition(': ')[2]}]]")
    return [_Table(f"{place}[{index}]", value) for index, value in enumerate(values)]


def load_scene(path: str | Path) -> Scene:
    """Read a scene file; see `Scene.load`."""
    path = Path(path)
    values = _read_toml(path)
    root = _Table(str(path), values)
    place = f"{path}: "
    camera, shapes, points, ambient, lights = None, [], None, None, []
    if "camera" in root.values:
        table = _Table(place + "camera", root.pop("camera"))
        camera = table.build(table.choose("type", CAMERAS))
    for table in _tables(place + "shapes", root.pop("shapes", [])):
        shapes.append(table.build(table.choose("type", SHAPES)))
    if "aov" in root.values:
        points = _load_points(_Table(place + "aov", root.pop("aov")), path.parent)
    if "ambient" in root.values:
        table = _Table(place + "ambient", root.pop("ambient"))
        if "intensity" not in table.values:
            raise InputError(table.place, "has no intensity", "Add intensity = [r, g, b]")
        ambient = _plain(f"{table.place}.intensity", table.pop("intensity"))
        table.done(["intensity"])
    for table in _tables(place + "lights", root.pop("lights", [])):
        lights.append(table.build(table.choose("type", LIGHTS)))
    if root.values:
        known = "camera, shapes, aov, ambient, lights"
        raise InputError(f"{path}: {next(iter(root.values))}", "is not a known key", f"Known here: {known}")
    try:
        return Scene(camera=camera, shapes=shapes, points=points, ambient=ambient, lights=lights)
    except InputError as error:
        raise error.inside(str(path)) from None


def _read_toml(path: Path) -> dict[str, Any]:
    try:
        return tomllib.loads(read_text(path))
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise InputError(path, f"is not TOML ({error})", "Correct the file") from None


def _load_points(table: _Table, folder: Path) -> SurfacePoints:
    """Surface points from the layers of an image file."""
    if "file" not in table.values:
        raise InputError(table.place, "has no file", 'Add file = "aovs.exr"')
    name = _plain(f"{table.place}.file", table.pop("file"))
    if not isinstance(name, str):
        raise InputError(f"{table.place}.file", f"must be a path, got {name!r}", "Give the path of an EXR file")
    to_view = table.pop("to_view")
    names = {key: table.pop(key) for key in ("position", "normal")}
    table.done(["file", "position", "normal", "to_view"])
    path = inside(folder, name, f"{table.place}.file")
    layers = read_layers(path)
    normal = _layer(layers, names["normal"], NORMAL_LAYERS, path)
    if normal is None:
        remedy = 'Name the layer: normal = "..."'
        raise InputError(path, f"has no layer of normals, got {', '.join(layers)}", remedy)
    position = _layer(layers, names["position"], POSITION_LAYERS, path)
    if to_view is None:
        to_view = _layer(layers, None, VIEW_LAYERS, path)
    try:
        return SurfacePoints.from_normals(normal, position=position, to_view=(0, 0, 1) if to_view is None else to_view)
    except InputError as error:
        raise error.inside(str(path)) from None


def _layer(layers: dict[str, Any], name: Any, known: tuple[str, ...], path: Path) -> Any:
    if name is not None:
        if name not in layers:
            raise InputError(path, f"has no layer {name!r}, got {', '.join(layers)}", "Correct the layer's name")
        return layers[name]
    return next((layers[candidate] for candidate in known if candidate in layers), None)


def inside(folder: Path, name: str, place: str) -> Path:
    """A file that a scene file names, which must lie within the scene's folder.

    Args:
        folder: of the scene file.
        name: the path as the file gives it.
        place: where it stands, for the message.

    Raises:
        InputError: where the path leaves the folder.
    """
    path = folder / name
    if not path.resolve().is_relative_to(folder.resolve()):
        raise InputError(place, f"must stay within the scene's folder, got {name!r}", "Move the file there")
    return path


def _toml(value: Any) -> str:
    """A TOML value: what JSON and TOML write alike."""
    if hasattr(value, "shape"):
        value = np.asarray(value, dtype=np.float64).tolist()
    return json.dumps(value)


def _section(header: str, values: dict[str, Any]) -> str:
    return "\n".join([header] + [f"{key} = {_toml(value)}" for key, value in values.items()]) + "\n"


def _fields(item: Any, kind: str | None) -> dict[str, Any]:
    values = {} if kind is None else {"type": kind}
    for field in dataclasses.fields(item):
        name, value = field.name, getattr(item, field.name)
        if value is not None and not (name == "fitted" and value):
            values[name] = list(value) if isinstance(value, tuple) else value
    return values


def save_scene(scene: Scene, path: str | Path) -> None:
    """Write a scene file; see `Scene.save`."""
    path = Path(path)
    sections = []
    if scene.camera is not None:
        sections.append(_section("[camera]", _fields(scene.camera, scene.camera.type_name)))
    if scene.points is not None:
        name = path.stem + ".aov.exr"
        _save_points(scene.points, path.with_name(name))
        sections.append(_section("[aov]", {"file": name}))
    names = {cls: name for name, cls in SHAPES.items()}
    sections += [_section("[[shapes]]", _fields(shape, names[type(shape)])) for shape in scene.shapes]
    if scene.ambient is not None:
        sections.append(_section("[ambient]", {"intensity": scene.ambient}))
    sections += [_section("[[lights]]", _fields(light, light.type_name)) for light in scene.lights]
    write_text(path, "\n".join(sections))


def _save_points(points: SurfacePoints, path: Path) -> None:
    mask = np.asarray(points.mask)[..., None]
    layers = {
        "position": np.asarray(points.position),
        "normal": np.where(mask, np.asarray(points.normal), 0.0),
        "to_view": np.asarray(points.to_view),
    }
    write_layers(path, layers)
