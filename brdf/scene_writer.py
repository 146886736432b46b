"""A scene as scene.toml, with the files it names beside it."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np

from brdf.files import write_text
from brdf.geometry.surface_points import SurfacePoints
from brdf.geometry.triangles import Mesh, Triangles
from brdf.images.writing import write_image, write_layers
from brdf.lights.environment import EnvironmentMap
from brdf.scene import Scene
from brdf.scene_file import SHAPES


def _toml(value: Any) -> str:
    """A TOML value: what JSON and TOML write alike."""
    if hasattr(value, "shape"):
        value = np.asarray(value, dtype=np.float64).tolist()
    return json.dumps(value)


def _section(header: str, values: dict[str, Any]) -> str:
    return "\n".join([header] + [f"{key} = {_toml(value)}" for key, value in values.items()]) + "\n"


def _fields(item: Any, kind: str | None) -> dict[str, Any]:
    values: dict[str, Any] = {} if kind is None else {"type": kind}
    for field in dataclasses.fields(item):
        if not field.init:
            continue
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
    for index, shape in enumerate(scene.shapes):
        values: dict[str, Any] = _fields(shape, names[type(shape)])
        if isinstance(shape, Triangles):
            values["file"] = f"{path.stem}.shape{index}.obj"
            del values["mesh"]
            write_text(path.with_name(values["file"]), _obj(shape.mesh))
        sections.append(_section("[[shapes]]", values))
    if scene.ambient is not None:
        sections.append(_section("[ambient]", {"intensity": scene.ambient}))
    for index, light in enumerate(scene.lights):
        if isinstance(light, EnvironmentMap):
            name = f"{path.stem}.light{index}.exr"
            write_image(path.with_name(name), np.asarray(light.pixels, np.float32))
            values: dict[str, Any] = {
                "type": light.type_name,
                "file": name,
                "radiance": light.radiance,
                "samples": light.samples,
            }
        else:
            values = _fields(light, light.type_name)
        if scene.visibility and scene.visibility[index] is not None:
            values["visibility"] = f"{path.stem}.visibility{index}.exr"
            mask = np.asarray(scene.visibility[index], np.float32)
            write_image(path.with_name(values["visibility"]), mask[..., None])
        sections.append(_section("[[lights]]", values))
    write_text(path, "\n".join(sections))


def _obj(mesh: Mesh) -> str:
    vertices = [f"v {x!r} {y!r} {z!r}" for x, y, z in mesh.vertices.tolist()]
    faces = [f"f {a} {b} {c}" for a, b, c in (mesh.faces + 1).tolist()]
    return "\n".join([*vertices, *faces]) + "\n"


def _save_points(points: SurfacePoints, path: Path) -> None:
    mask = np.asarray(points.mask)[..., None]
    layers = {
        "position": np.asarray(points.position),
        "normal": np.where(mask, np.asarray(points.normal), 0.0),
        "to_view": np.asarray(points.to_view),
    }
    write_layers(path, layers)
