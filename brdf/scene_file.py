"""scene.toml as an object. Strict: an unknown key, a wrong type or a missing value names file, table and key."""

import dataclasses
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from brdf.checks import direction_value
from brdf.errors import InputError
from brdf.files import read_toml
from brdf.geometry.base import Shape
from brdf.geometry.camera import CAMERAS
from brdf.geometry.rectangle import Rectangle
from brdf.geometry.sphere import Sphere
from brdf.geometry.surface_points import SurfacePoints
from brdf.geometry.triangles import Triangles, load_mesh
from brdf.images.reading import read_image, read_layers
from brdf.lights.area import PolygonLight, RectangleLight, SphereLight
from brdf.lights.environment import ConstantEnvironment, EnvironmentMap
from brdf.lights.punctual import DirectionalLight, Light, PointLight, SpotLight
from brdf.scene import Scene

SHAPES: dict[str, type[Shape]] = {"sphere": Sphere, "rectangle": Rectangle, "triangles": Triangles}
LIGHTS: dict[str, type[Light]] = {
    light.type_name: light
    for light in (
        DirectionalLight,
        PointLight,
        SpotLight,
        RectangleLight,
        PolygonLight,
        SphereLight,
        ConstantEnvironment,
    )
}
POSITION_LAYERS = ("position", "P")
# Longer lists are no spectrum, no polygon that anybody draws.
MOST_NUMBERS = 4096
MOST_BYTES = 1 << 22
NORMAL_LAYERS = ("normal", "sh_normal", "N")
VIEW_LAYERS = ("to_view",)


class Folder(NamedTuple):
    """Where a scene file stands, and what its paths may reach.

    Attributes:
        path: its folder.
        within: the folder that no path may leave.
    """

    path: Path
    within: Path


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
        fields = {field.name: field for field in dataclasses.fields(cls) if field.init}
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


def _flatten(value: Any) -> Iterator[Any]:
    if isinstance(value, list):
        for item in value:
            yield from _flatten(item)
    else:
        yield value


def _plain(place: str, value: Any) -> Any:
    """A value of the file, refused where Python would silently read a truth value or text as a number."""
    if isinstance(value, list) and len(value) > MOST_NUMBERS:
        raise InputError(place, f"has {len(value)} entries", f"Give at most {MOST_NUMBERS}")
    numbers = list(_flatten(value))
    if any(isinstance(number, bool) for number in numbers) and not place.endswith(".fitted"):
        raise InputError(place, f"must be a number, got {json.dumps(value)}", "Give numbers")
    if place.endswith(".fitted") and not isinstance(value, bool):
        raise InputError(place, f"must be true or false, got {value!r}", "Correct the value")
    if isinstance(value, list) and any(isinstance(number, str) for number in numbers):
        raise InputError(place, f"must be numbers, got {value!r}", "Give numbers without quotes")
    if isinstance(value, str) and not place.endswith((".viewer", ".file")):
        raise InputError(place, f"must be a number, got {value!r}", "Give numbers without quotes")
    return value


def _tables(place: str, values: Any) -> list[_Table]:
    if not isinstance(values, list):
        raise InputError(place, "must be a list of tables", f"Write [[{place.rpartition(': ')[2]}]]")
    return [_Table(f"{place}[{index}]", value) for index, value in enumerate(values)]


def load_scene(path: str | Path, within: str | Path | None = None, tables: dict[str, Any] | None = None) -> Scene:
    """Read a scene file; see `Scene.load`. ``tables`` are what is in it, where it has been parsed already."""
    path = Path(path)
    folder = Folder(path.parent, path.parent if within is None else Path(within))
    values = read_toml(path, MOST_BYTES) if tables is None else tables
    root = _Table(str(path), values)
    place = f"{path}: "
    camera, shapes, points, ambient, lights, masks, has_position = None, [], None, None, [], [], True
    if "camera" in root.values:
        table = _Table(place + "camera", root.pop("camera"))
        camera = table.build(table.choose("type", CAMERAS))
    for table in _tables(place + "shapes", root.pop("shapes", [])):
        shapes.append(_load_shape(table, folder))
    if "aov" in root.values:
        points, has_position = _load_points(_Table(place + "aov", root.pop("aov")), folder)
        if shapes and not has_position:
            came = f"stand somewhere, but {place}aov has no layer of positions"
            raise InputError(place + "shapes", came, "Add the layer, or leave the shapes out")
    if "ambient" in root.values:
        table = _Table(place + "ambient", root.pop("ambient"))
        given = "intensity" in table.values
        value = table.pop("intensity") if given else None
        # A misspelt key is named before the one that it should have been.
        table.done(["intensity"])
        if not given:
            raise InputError(table.place, "has no intensity", "Add intensity = [r, g, b]")
        ambient = _plain(f"{table.place}.intensity", value)
    for table in _tables(place + "lights", root.pop("lights", [])):
        masks.append(_load_mask(table, folder))
        lights.append(_load_light(table, folder))
        if not has_position and not isinstance(lights[-1], DirectionalLight | ConstantEnvironment | EnvironmentMap):
            came = f"stands somewhere, but {place}aov has no layer of positions"
            raise InputError(table.place, came, "Add the layer, or use directional lights")
    if root.values:
        known = "camera, shapes, aov, ambient, lights"
        raise InputError(f"{path}: {next(iter(root.values))}", "is not a known key", f"Known here: {known}")
    try:
        visibility = () if all(mask is None for mask in masks) else masks
        return Scene(camera=camera, shapes=shapes, points=points, ambient=ambient, lights=lights, visibility=visibility)
    except InputError as error:
        raise error.inside(str(path)) from None


def _file(table: _Table, key: str, folder: Folder, example: str) -> Path:
    """The file that a key names."""
    if key not in table.values:
        raise InputError(table.place, f"has no {key}", f'Add {key} = "{example}"')
    name = table.pop(key)
    if not isinstance(name, str) or not name:
        raise InputError(f"{table.place}.{key}", f"must be a path, got {name!r}", f'Give a path like "{example}"')
    return inside(folder, name, f"{table.place}.{key}")


def _load_shape(table: _Table, folder: Folder) -> Shape:
    cls = table.choose("type", SHAPES)
    if cls is not Triangles:
        return table.build(cls)
    mesh = load_mesh(_file(table, "file", folder, "mesh.obj"))
    fitted = _plain(f"{table.place}.fitted", table.pop("fitted", True))
    table.done(["type", "file", "fitted"])
    return Triangles(mesh, fitted=fitted)


def _load_light(table: _Table, folder: Folder) -> Light:
    cls = table.choose("type", LIGHTS)
    if cls is not ConstantEnvironment or "file" not in table.values:
        return table.build(cls)
    path = _file(table, "file", folder, "sky.exr")
    values = {
        key: _plain(f"{table.place}.{key}", table.pop(key)) for key in ("radiance", "samples") if key in table.values
    }
    table.done(["type", "file", "radiance", "samples", "visibility", "visibility_layer"])
    pixels = read_image(path)
    try:
        return EnvironmentMap(pixels, **values)
    except InputError as error:
        raise error.inside(table.place) from None


def _load_mask(table: _Table, folder: Folder) -> Any:
    """How much of the light each pixel sees, where a file tells; the first channel of the picture or layer."""
    if "visibility" not in table.values:
        return None
    path = _file(table, "visibility", folder, "shadow.exr")
    layer = _layer_name(table, "visibility_layer")
    if layer is None:
        return read_image(path, encoding="linear")[..., 0]
    return _layer(read_layers(path), layer, (), path)[..., 0]


def _load_points(table: _Table, folder: Folder) -> tuple[SurfacePoints, bool]:
    """Surface points from the layers of an image file, and whether their positions are among them."""
    path = _file(table, "file", folder, "aovs.exr")
    to_view = _plain(f"{table.place}.to_view", table.pop("to_view"))
    if to_view is not None:
        to_view = direction_value(f"{table.place}.to_view")(to_view)
    names = {key: _layer_name(table, key) for key in ("position", "normal")}
    table.done(["file", "position", "normal", "to_view"])
    layers = read_layers(path)
    normal = _layer(layers, names["normal"], NORMAL_LAYERS, path)
    if normal is None:
        remedy = 'Name the layer: normal = "..."'
        raise InputError(path, f"has no layer of normals, got {_named(layers)}", remedy)
    position = _layer(layers, names["position"], POSITION_LAYERS, path)
    if to_view is None:
        to_view = _layer(layers, None, VIEW_LAYERS, path)
    try:
        towards = (0, 0, 1) if to_view is None else to_view
        return SurfacePoints.from_normals(normal, position=position, to_view=towards), position is not None
    except InputError as error:
        raise error.inside(str(path)) from None


def _layer_name(table: _Table, key: str) -> str | None:
    name = table.pop(key)
    if not isinstance(name, str | None):
        raise InputError(f"{table.place}.{key}", f"must be the name of a layer, got {name!r}", "Give a name in quotes")
    return name


def _named(layers: dict[str, Any]) -> str:
    return ", ".join(name or "the unnamed one" for name in layers)


def _layer(layers: dict[str, Any], name: Any, known: tuple[str, ...], path: Path) -> Any:
    if name is not None:
        if name not in layers:
            raise InputError(path, f"has no layer {name!r}, got {_named(layers)}", "Correct the layer's name")
        return layers[name]
    return next((layers[candidate] for candidate in known if candidate in layers), None)


def inside(folder: Folder, name: str, place: str) -> Path:
    """A file that a scene file names, which must lie within a folder.

    Args:
        folder: of the scene file.
        name: the path as the file gives it.
        place: where it stands, for the message.

    Raises:
        InputError: where the path leaves the folder.
    """
    path = folder.path / name
    try:
        stays = path.resolve().is_relative_to(folder.within.resolve())
    except (ValueError, OSError, RuntimeError):
        raise InputError(place, f"is no path, got {name!r}", "Correct the path") from None
    if not stays:
        own = folder.within == folder.path
        where = "the scene's folder" if own else str(folder.within)
        remedy = "Move the file there, or allow more with within" if own else "Move the file there"
        raise InputError(place, f"must stay within {where}, got {name!r}", remedy)
    return path
