"""scene.toml in and out. Strict: an unknown key, a wrong type or a missing value names file, table and key."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import jax
import numpy as np

from brdf.checks import direction_value, spectrum
from brdf.errors import InputError
from brdf.files import read_toml, write_text
from brdf.geometry.base import Shape
from brdf.geometry.camera import CAMERAS
from brdf.geometry.rectangle import Rectangle
from brdf.geometry.sphere import Sphere
from brdf.geometry.surface_points import SurfacePoints
from brdf.geometry.triangles import Triangles, load_mesh
from brdf.images.reading import read_image, read_layers
from brdf.images.writing import write_image, write_layers
from brdf.lights.area import PolygonLight, RectangleLight, SphereLight
from brdf.lights.base import Light
from brdf.lights.environment import ConstantEnvironment, EnvironmentMap
from brdf.lights.punctual import DirectionalLight, PointLight, SpotLight

SHAPES: dict[str, type[Shape]] = {"sphere": Sphere, "rectangle": Rectangle, "triangles": Triangles}
_LIGHTS = (DirectionalLight, PointLight, SpotLight, RectangleLight, PolygonLight, SphereLight, ConstantEnvironment)
LIGHTS: dict[str, type[Light]] = {light.type_name: light for light in _LIGHTS}
POSITION_LAYERS = ("position", "P")
NORMAL_LAYERS = ("normal", "sh_normal", "N")
VIEW_LAYERS = ("to_view",)

MOST_NUMBERS = 4096
"""Longer lists are no spectrum, no polygon that anybody draws."""

MOST_BYTES = 1 << 22


# -- reading -----------------------------------------------------------------------------------------------------------


class _Table:
    """One table of the file: hands out its keys, and knows which nobody asked for.

    Attributes:
        place: file and table, for messages.
        values: by key, those that have not been handed out.
        within: the folder that no path may leave; None for the scene's own.
    """

    def __init__(self, path: Path, name: str, values: Any, within: Path | None):
        self.path, self.place, self.within = path, f"{path}: {name}", within
        if not isinstance(values, dict):
            raise InputError(self.place, f"must be a table, got {values!r}", "Write it as a [table]")
        self.values = dict(values)

    def plain(self, key: str) -> Any:
        """A value, refused where Python would silently read a truth value or text as a number; None where missing."""
        value, place = self.values.pop(key, None), f"{self.place}.{key}"
        if isinstance(value, list) and len(value) > MOST_NUMBERS:
            raise InputError(place, f"has {len(value)} entries", f"Give at most {MOST_NUMBERS}")
        if key in ("fitted", "smooth"):
            if not isinstance(value, bool):
                raise InputError(place, f"must be true or false, got {value!r}", "Correct the value")
            return value
        leaves = jax.tree.leaves(value)
        if any(isinstance(leaf, bool) for leaf in leaves):
            raise InputError(place, f"must be a number, got {json.dumps(value, default=str)}", "Give numbers")
        if key != "viewer" and any(isinstance(leaf, str) for leaf in leaves):
            words = "numbers" if isinstance(value, list) else "a number"
            raise InputError(place, f"must be {words}, got {value!r}", "Give numbers without quotes")
        return value

    def choose(self, choices: dict[str, Any]) -> Any:
        """The class that the table's ``type`` names."""
        known = ", ".join(choices)
        if "type" not in self.values:
            raise InputError(self.place, "has no type", f"Add type = one of {known}")
        value = self.values.pop("type")
        if not isinstance(value, str) or value not in choices:
            raise InputError(f"{self.place}.type", f"is unknown, got {value!r}", f"Use one of {known}")
        return choices[value]

    def done(self, *known: str) -> None:
        """Refuse a key that nobody asked for."""
        for key in self.values:
            raise InputError(f"{self.place}.{key}", "is not a known key", f"Known here: {', '.join(known)}")

    def build(self, cls: type) -> Any:
        """An object from the keys that bear its fields' names."""
        fields = {field.name: field for field in dataclasses.fields(cls) if field.init}
        values = {name: self.plain(name) for name in fields if name in self.values}
        self.done(*fields)
        for name, field in fields.items():
            if name not in values and field.default is dataclasses.MISSING:
                raise InputError(self.place, f"has no {name}", f"Add {name} = ...")
        return self.made(cls, **values)

    def made(self, make: Any, *arguments: Any, **values: Any) -> Any:
        """What a constructor makes; the table is named where it refuses."""
        try:
            return make(*arguments, **values)
        except InputError as error:
            raise error.inside(self.place) from None

    def file(self, key: str, example: str) -> Path:
        """The file that a key names, which must lie within the folder."""
        if key not in self.values:
            raise InputError(self.place, f"has no {key}", f'Add {key} = "{example}"')
        name, place = self.values.pop(key), f"{self.place}.{key}"
        if not isinstance(name, str) or not name:
            raise InputError(place, f"must be a path, got {name!r}", f'Give a path like "{example}"')
        own = self.path.parent
        within = own if self.within is None else self.within
        try:
            stays = (own / name).resolve().is_relative_to(within.resolve())
        except (ValueError, OSError, RuntimeError):
            raise InputError(place, f"is no path, got {name!r}", "Correct the path") from None
        if not stays:
            where = "the scene's folder" if own == within else str(within)
            remedy = "Move the file there" + (", or allow more with within" if own == within else "")
            raise InputError(place, f"must stay within {where}, got {name!r}", remedy)
        return own / name

    def layer(self, key: str) -> str | None:
        """The name of a layer."""
        name = self.values.pop(key, None)
        if not isinstance(name, str | None):
            came = f"must be the name of a layer, got {name!r}"
            raise InputError(f"{self.place}.{key}", came, "Give a name in quotes")
        return name


def read_parts(path: Path, within: str | Path | None, tables: dict[str, Any] | None) -> dict[str, Any]:
    """Read a scene file; see `brdf.Scene.load`.

    Args:
        path: the file.
        within: a folder that the paths in it may not leave; None takes the file's own.
        tables: what is in it, where it has been parsed already.

    Returns:
        The arguments of `brdf.Scene`.

    Raises:
        InputError: naming file, table and key.
    """
    within = None if within is None else Path(within)
    values = read_toml(path, MOST_BYTES) if tables is None else dict(tables)
    if any(isinstance(leaf, int) and abs(leaf) >> 1000 for leaf in jax.tree.leaves(values)):
        raise InputError(path, "has a whole number of more than 300 digits", "Correct the file")
    camera, points, ambient, has_position = None, None, None, True
    if "camera" in values:
        table = _Table(path, "camera", values.pop("camera"), within)
        camera = table.build(table.choose(CAMERAS))
    shapes = [_read_shape(table) for table in _tables(path, "shapes", values, within)]
    if "aov" in values:
        points, has_position = _read_points(_Table(path, "aov", values.pop("aov"), within))
        if shapes and not has_position:
            came = f"stand somewhere, but {path}: aov has no layer of positions"
            raise InputError(f"{path}: shapes", came, "Add the layer, or leave the shapes out")
    if "ambient" in values:
        table = _Table(path, "ambient", values.pop("ambient"), within)
        given, ambient = "intensity" in table.values, table.plain("intensity")
        # A misspelt key is named before the one that it should have been.
        table.done("intensity")
        if not given:
            raise InputError(table.place, "has no intensity", "Add intensity = [r, g, b]")
        ambient = table.made(spectrum, "intensity", ambient)
    lights, masks = [], []
    for table in _tables(path, "lights", values, within):
        masks.append(_read_mask(table))
        lights.append(_read_light(table))
        if not has_position and not isinstance(lights[-1], DirectionalLight | ConstantEnvironment | EnvironmentMap):
            came = f"stands somewhere, but {path}: aov has no layer of positions"
            raise InputError(table.place, came, "Add the layer, or use directional lights")
    for key in values:
        known = "camera, shapes, aov, ambient, lights"
        raise InputError(f"{path}: {key}", "is not a known key", f"Known here: {known}")
    visibility = () if all(mask is None for mask in masks) else masks
    parts = {"camera": camera, "shapes": shapes, "points": points, "ambient": ambient, "lights": lights}
    return parts | {"visibility": visibility}


def _tables(path: Path, name: str, values: dict[str, Any], within: Path | None) -> list[_Table]:
    tables = values.pop(name, [])
    if not isinstance(tables, list):
        raise InputError(f"{path}: {name}", "must be a list of tables", f"Write [[{name}]]")
    return [_Table(path, f"{name}[{index}]", table, within) for index, table in enumerate(tables)]


def _read_shape(table: _Table) -> Shape:
    cls = table.choose(SHAPES)
    if cls is not Triangles:
        return table.build(cls)
    path = table.file("file", "mesh.obj")
    fitted, smooth = (table.plain(key) if key in table.values else True for key in ("fitted", "smooth"))
    table.done("type", "file", "fitted", "smooth")
    return Triangles(load_mesh(path, smooth=smooth), fitted=fitted)


def _read_light(table: _Table) -> Light:
    cls = table.choose(LIGHTS)
    if cls is not ConstantEnvironment or "file" not in table.values:
        return table.build(cls)
    path = table.file("file", "sky.exr")
    values = {key: table.plain(key) for key in ("radiance", "samples") if key in table.values}
    table.done("type", "file", "radiance", "samples", "visibility", "visibility_layer")
    return table.made(EnvironmentMap, read_image(path), **values)


def _read_mask(table: _Table) -> Any:
    """How much of the light each pixel sees, where a file tells; the first channel of the picture or layer."""
    if "visibility" not in table.values:
        return None
    path, layer = table.file("visibility", "shadow.exr"), table.layer("visibility_layer")
    pixels = read_image(path, encoding="linear") if layer is None else _layer(read_layers(path), layer, (), path)
    return pixels[..., 0]


def _read_points(table: _Table) -> tuple[SurfacePoints, bool]:
    """Surface points from the layers of an image file, and whether their positions are among them."""
    path = table.file("file", "aovs.exr")
    to_view = table.plain("to_view")
    if to_view is not None:
        to_view = direction_value(f"{table.place}.to_view", to_view)
    names = {key: table.layer(key) for key in ("position", "normal")}
    table.done("file", "position", "normal", "to_view")
    layers = read_layers(path)
    normal = _layer(layers, names["normal"], NORMAL_LAYERS, path)
    if normal is None:
        raise InputError(path, f"has no layer of normals, got {_named(layers)}", 'Name the layer: normal = "..."')
    position = _layer(layers, names["position"], POSITION_LAYERS, path)
    if to_view is None:
        to_view = _layer(layers, None, VIEW_LAYERS, path)
    try:
        towards = (0, 0, 1) if to_view is None else to_view
        return SurfacePoints.from_normals(normal, position=position, to_view=towards), position is not None
    except InputError as error:
        raise error.inside(str(path)) from None


def _named(layers: dict[str, Any]) -> str:
    return ", ".join(name or "the unnamed one" for name in layers)


def _layer(layers: dict[str, Any], name: str | None, known: tuple[str, ...], path: Path) -> Any:
    if name is not None and name not in layers:
        raise InputError(path, f"has no layer {name!r}, got {_named(layers)}", "Correct the layer's name")
    candidates = known if name is None else (name,)
    return next((layers[candidate] for candidate in candidates if candidate in layers), None)


# -- writing -----------------------------------------------------------------------------------------------------------


def write_parts(path: str | Path, parts: dict[str, Any], aov: str | None = None) -> None:
    """Write a scene file; see `brdf.Scene.save`.

    Args:
        path: the file.
        parts: the arguments of `brdf.Scene`.
        aov: the file beside it that holds the points already; None writes one.

    Raises:
        InputError: where the file cannot be written.
    """
    path = Path(path)
    kinds = {cls: name for name, cls in (CAMERAS | SHAPES).items()}
    sections = []

    def section(header: str, values: dict[str, Any]) -> None:
        sections.append("\n".join([header, *(f"{key} = {_toml(value)}" for key, value in values.items())]) + "\n")

    def beside(ending: str) -> tuple[str, Path]:
        return f"{path.stem}.{ending}", path.with_name(f"{path.stem}.{ending}")

    camera, points = parts["camera"], parts["points"]
    if camera is not None:
        section("[camera]", {"type": kinds[type(camera)]} | _fields(camera))
    if points is not None and aov is None:
        aov, file = beside("aov.exr")
        normal = np.where(np.asarray(points.mask)[..., None], np.asarray(points.normal), 0.0)
        layers = {"position": np.asarray(points.position), "normal": normal, "to_view": np.asarray(points.to_view)}
        write_layers(file, layers)
    if points is not None:
        section("[aov]", {"file": aov})
    for index, shape in enumerate(parts["shapes"]):
        values = {"type": kinds[type(shape)]} | _fields(shape)
        if isinstance(shape, Triangles):
            values["file"], file = beside(f"shape{index}.obj")
            mesh = shape.mesh
            del values["mesh"]
            lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in mesh.vertices.tolist()]
            if mesh.normals is None:
                values["smooth"] = False
                lines += [f"f {a} {b} {c}" for a, b, c in (mesh.faces + 1).tolist()]
            else:
                lines += [f"vn {x!r} {y!r} {z!r}" for x, y, z in mesh.normals.reshape(-1, 3).tolist()]
                corners = [f"{vertex}//{at}" for at, vertex in enumerate((mesh.faces + 1).ravel().tolist(), start=1)]
                lines += [f"f {a} {b} {c}" for a, b, c in zip(*[iter(corners)] * 3, strict=True)]
            write_text(file, "\n".join(lines) + "\n")
        section("[[shapes]]", values)
    if parts["ambient"] is not None:
        section("[ambient]", {"intensity": parts["ambient"]})
    for index, light in enumerate(parts["lights"]):
        values = {"type": light.type_name}
        if isinstance(light, EnvironmentMap):
            values["file"], file = beside(f"light{index}.exr")
            write_image(file, np.asarray(light.pixels, np.float32))
            values |= {"radiance": light.radiance, "samples": light.samples}
        else:
            values |= _fields(light)
        if parts["visibility"] and parts["visibility"][index] is not None:
            values["visibility"], file = beside(f"visibility{index}.exr")
            write_image(file, np.asarray(parts["visibility"][index], np.float32)[..., None])
        section("[[lights]]", values)
    write_text(path, "\n".join(sections))


def _fields(item: Any) -> dict[str, Any]:
    values = {field.name: getattr(item, field.name) for field in dataclasses.fields(item) if field.init}
    return {name: value for name, value in values.items() if value is not None and (name, value) != ("fitted", True)}


def _toml(value: Any) -> str:
    """A TOML value: what JSON and TOML write alike."""
    return json.dumps(np.asarray(value, dtype=np.float64).tolist() if hasattr(value, "shape") else value)
