"""scene.toml in and out. Strict: an unknown key, a wrong type or a missing value names file, table and key."""

import dataclasses
import inspect
import itertools
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from brdf.arguments import Layer, Table
from brdf.checks import direction_value, spectrum, vector
from brdf.errors import InputError
from brdf.files import read_toml, utf8_name, write_text
from brdf.geometry.camera import CAMERAS
from brdf.geometry.shapes import Rectangle, Shape, Sphere
from brdf.geometry.surface_points import SurfacePoints
from brdf.geometry.triangles import Triangles, load_mesh
from brdf.images.reading import read_image, read_layers
from brdf.images.writing import write_image, write_layers
from brdf.lights.area import PolygonLight, RectangleLight, SphereLight
from brdf.lights.base import Light
from brdf.lights.environment import MAP_SAMPLES, ConstantEnvironment, EnvironmentMap
from brdf.lights.punctual import DirectionalLight, PointLight, SpotLight

SHAPES: dict[str, type[Shape]] = {"sphere": Sphere, "rectangle": Rectangle, "triangles": Triangles}
_LIGHTS = (DirectionalLight, PointLight, SpotLight, RectangleLight, PolygonLight, SphereLight, ConstantEnvironment)
LIGHTS: dict[str, type[Light]] = {light.type_name: light for light in _LIGHTS}
_DISTANT = DirectionalLight | ConstantEnvironment | EnvironmentMap

MOST_BYTES = 1 << 22
# A value of 1 in an HDR file is read as one that was truncated.
WHITE_OF_HDR = 1 + 2**-8


# -- reading -----------------------------------------------------------------------------------------------------------


def read_parts(path: Path, within: str | Path | None, tables: dict[str, Any] | None) -> dict[str, Any]:
    """The arguments of `brdf.Scene` that a file says; see `brdf.Scene.load`."""
    folders = path.parent, path.parent if within is None else Path(within)
    if not folders[1].is_dir():
        raise InputError(folders[1], "is no folder", "Give as within the folder that paths may not leave")
    parts: dict[str, Any] = {}
    for name, value in (read_toml(path, MOST_BYTES) if tables is None else tables).items():
        if name not in _READERS:
            raise InputError(f"{path}: {name}", "is not a known key", f"Known here: {', '.join(_READERS)}")
        several = name in ("shapes", "lights")
        if several and not isinstance(value, list):
            raise InputError(f"{path}: {name}", "must be a list of tables", f"Write [[{name}]]")
        found = {f"{name}[{index}]": one for index, one in enumerate(value)} if several else {name: value}
        read = [_READERS[name](Table(f"{path}: {where}", one, *folders)) for where, one in found.items()]
        parts[name] = read if several else read[0]
    if "aov" in parts:
        parts["points"], has_position = parts.pop("aov")
        far = all(isinstance(light, _DISTANT) for light, _ in parts.get("lights", []))
        if not has_position and not (far and "shapes" not in parts):
            what = "has no layer of positions, but shapes or lights stand somewhere"
            raise InputError(f"{path}: aov", what, "Add the layer, or use directional lights alone")
    if parts.get("lights"):
        parts["lights"], parts["visibility"] = zip(*parts["lights"], strict=True)
    return parts


def _read_shape(table: Any) -> Shape:
    cls = table.choose("type", SHAPES)
    return table.make(_triangles if cls is Triangles else cls)


def _triangles(file: Path, fitted: bool = True, smooth: bool = True):
    return Triangles(load_mesh(file, smooth=smooth), fitted=fitted)


def _read_light(table):
    """A light, and how much of it each pixel sees where a file tells."""
    cls, values = table.choose("type", LIGHTS), table.values
    given = {key: values.pop(key) for key in ("visibility", "visibility_layer") if key in values}
    mask = dataclasses.replace(table, values=given).make(_mask) if given else None
    return table.make(_map if cls is ConstantEnvironment and "file" in values else cls), mask


def _map(file: Path, radiance=1.0, samples=MAP_SAMPLES):
    return EnvironmentMap(read_image(file), radiance=radiance, samples=samples)


def _mask(visibility: Path, visibility_layer: Layer | None = None):
    """The first channel of the picture or layer."""
    if visibility_layer is None:
        share = read_image(visibility, encoding="linear")[..., 0]
        return np.where(share <= WHITE_OF_HDR, np.minimum(share, 1), share)
    return _layer(visibility, read_layers(visibility), visibility_layer)[..., 0]


def _points(file: Path, position: Layer | None = None, normal: Layer | None = None, to_view=None, eye=None):
    """Surface points from the layers of an image file, and whether their positions are among them.

    They are seen from the eye of a perspective picture, or from far away in a direction.
    """
    towards = (0, 0, 1) if to_view is None else direction_value("to_view", to_view)
    layers = read_layers(file)
    normals = _layer(file, layers, normal, "normal", "sh_normal", "N")
    if normals is None:
        raise InputError(file, f"has no layer of normals, got {_named(layers)}", 'Name the layer: normal = "..."')
    positions = _layer(file, layers, position, "position", "P")
    towards = layers.get("to_view", towards) if to_view is None else towards
    if eye is not None:
        place = vector("eye", eye)
        if to_view is not None:
            raise InputError("eye", "is given beside to_view", "Give one of them")
        if positions is None:
            raise InputError(file, "has no layer of positions, which an eye sees", 'Name it: position = "..."')
        if positions.shape[-1] == 3:  # others are refused below
            towards = place - np.where(np.isfinite(positions), positions, 0)
    return SurfacePoints.from_normals(normals, position=positions, to_view=towards), positions is not None


def _named(layers: dict[str, Any]) -> str:
    return ", ".join(name or "the unnamed one" for name in layers)


def _layer(file, layers: dict[str, Any], name: str | None, *usual) -> Any:
    """The layer that is named, or the first of the usual ones that there is."""
    found = [layers[one] for one in (usual if name is None else [name]) if one in layers]
    if name is not None and not found:
        raise InputError(file, f"has no layer {name!r}, got {_named(layers)}", "Correct the layer's name")
    return found[0] if found else None


_READERS: dict[str, Callable[[Table], Any]] = {
    "camera": lambda table: table.make(table.choose("type", CAMERAS)),
    "shapes": _read_shape,
    "aov": lambda table: table.make(_points),
    "ambient": lambda table: table.make(lambda intensity: spectrum("intensity", intensity)),
    "lights": _read_light,
}


# -- writing -----------------------------------------------------------------------------------------------------------


def write_scene(path: str | Path, scene: Any, aov: str | None = None) -> None:
    """Write the file of a `brdf.Scene`; see `brdf.Scene.save`."""
    path, sections = Path(path), []

    def beside(ending, write, content):
        """The name of a file beside the scene's, which is written."""
        file = path.with_name(f"{path.stem}.{ending}")
        name = utf8_name(file.name)  # as TOML holds it
        write(file, content)
        return name

    def section(header: str, fields, **values) -> None:
        values = fields | values
        lines = [f"{key} = {_toml(value)}" for key, value in values.items() if value is not None and value is not True]
        sections.append("\n".join([header, *lines, ""]))

    if scene.camera is not None:
        section("[camera]", _fields(scene.camera), type=scene.camera.type_name)
    if scene.points is not None:
        layers = {name: np.asarray(getattr(scene.points, name)) for name in ("position", "normal", "to_view")}
        layers["normal"] = layers["normal"] * np.asarray(scene.points.mask)[..., None]
        section("[aov]", {}, file=aov or beside("aov.exr", write_layers, layers))
    for index, shape in enumerate(scene.shapes):
        values = {"type": next(name for name, cls in SHAPES.items() if cls is type(shape))}
        if isinstance(shape, Triangles):
            file = beside(f"shape{index}.obj", write_text, _obj(shape.mesh))
            values |= {"mesh": None, "file": file, "smooth": shape.mesh.normals is not None}
        section("[[shapes]]", _fields(shape), **values)
    if scene.ambient is not None:
        section("[ambient]", {}, intensity=scene.ambient)
    for index, (light, mask) in enumerate(itertools.zip_longest(scene.lights, scene.visibility)):
        values = {"type": light.type_name}
        if isinstance(light, EnvironmentMap):
            values |= {"pixels": None, "file": beside(f"light{index}.exr", write_image, light.pixels)}
        if mask is not None:
            values["visibility"] = beside(f"visibility{index}.exr", write_image, mask)
        section("[[lights]]", _fields(light), **values)
    write_text(path, "\n".join(sections))


def _fields(item: Any) -> dict[str, Any]:
    return {name: getattr(item, name) for name in inspect.signature(type(item)).parameters}


def _obj(mesh):
    """A mesh as Wavefront ``.obj``."""

    def rows(word, array):
        return [f"{word} {' '.join(map(repr, row))}" for row in array.tolist()]

    lines = rows("v", mesh.vertices)
    if mesh.normals is None:
        lines += rows("f", mesh.faces + 1)
    else:
        lines += rows("vn", mesh.normals.reshape(-1, 3))
        corners = [f"{vertex}//{at}" for at, vertex in enumerate((mesh.faces + 1).ravel().tolist(), start=1)]
        lines += [f"f {' '.join(face)}" for face in np.reshape(corners, (-1, 3))]
    return "\n".join([*lines, ""])


def _toml(value: Any) -> str:
    """A TOML value: what JSON and TOML write alike."""
    plain = np.asarray(value, np.float64).tolist() if hasattr(value, "shape") else value
    # JSON's pairs of surrogates are none of TOML's escapes, and the one control character that it leaves is refused.
    return json.dumps(plain, ensure_ascii=False).replace("\x7f", "\\u007f")
