"""A page that turns: the fitted surface drawn by the reader's own browser, with its numbers, light and view to move.

The page is one file and asks no network and no kernel for anything. What draws is the GLSL export's own formula with
the numbers as uniforms (`viewer_assets/surface.frag` finds what a pixel sees, the export says what that shows), so that
the browser shows what `brdf.render` shows. What it cannot draw it names: lights with an extent, shadows.
"""

import base64
import dataclasses
import functools
import gzip
import hashlib
import html
import json
import math
from importlib import resources
from pathlib import Path
from string import Template
from typing import Any

import numpy as np

import brdf
from brdf.albedo import lobe_albedo, normalized_form
from brdf.channels import channel_names
from brdf.conversions import nearest_equations
from brdf.display import png_address
from brdf.errors import InputError
from brdf.files import write_text
from brdf.materials.exports import shader
from brdf.models.base import SpecularMaterial
from brdf.precision import working_precision
from fitting.result import FitResult

LARGEST = 512
"""Pixels on a side that the page holds of a picture; of a larger one every second, third, ... pixel."""

FORMATS = ("json", "mtl", "three", "glsl")
_KINDS = {"directional": 0, "point": 1, "spot": 2}
_LOG_N = np.linspace(-1.0, 6.0, 36)
_DEGREES = np.array([*range(0, 80, 2), *range(80, 89), 88.5, 89, 89.3, 89.6, 89.8, 89.9])
_STYLE = """
:root { color-scheme: light dark; }
body { font: 16px/1.45 system-ui, sans-serif; max-width: 62rem; margin: 2rem auto; padding: 0 1rem; }
h1 { font-size: 1.5rem; } h2 { font-size: 1.15rem; margin-top: 2rem; border-bottom: 1px solid #8888; }
.wide { overflow-x: auto; } table { border-collapse: collapse; font-variant-numeric: tabular-nums; }
th, td { padding: 0.15em 0.6em; text-align: right; border-bottom: 1px solid #8884; }
img { max-width: 100%; height: auto; background: white; }
.warning { border-left: 4px solid #d55e00; padding: 0.3em 0.8em; margin: 0.6em 0; }
pre { overflow-x: auto; background: #8882; padding: 0.6em; }
"""


@dataclasses.dataclass(frozen=True)
class Page:
    """A page of its own; Jupyter shows it in a frame, without a kernel, also in a notebook that is only read.

    Attributes:
        text: the HTML.
    """

    text: str = dataclasses.field(repr=False)

    def _repr_html_(self) -> str:
        """For Jupyter: the page in a frame."""
        frame = "width:100%;height:46rem;border:0"
        return f'<iframe style="{frame}" sandbox="allow-scripts" srcdoc="{html.escape(self.text)}"></iframe>'

    def save(self, path: str | Path) -> None:
        """Write the page.

        Args:
            path: an ``.html`` file.

        Raises:
            InputError: where it cannot be written.
        """
        write_text(path, self.text)


def secure_page(title: str, body: str) -> str:
    """A whole page around a body that may hold a viewer. It loads nothing, and runs no program but the viewer's own.

    Args:
        title: as text.
        body: as HTML.
    """
    style, script = _STYLE + _asset("viewer.css"), _asset("viewer.js") if 'id="viewer-data"' in body else ""

    def digest(text: str) -> str:
        return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"

    policy = f"default-src 'none'; img-src data:; style-src-elem {digest(style)}; style-src-attr 'unsafe-inline'"
    policy += f"; script-src {digest(script)}" if script else ""
    run = f"<script>{script}</script>" if script else ""
    return f"""<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta http-equiv="Content-Security-Policy" content="{policy}">
<meta name="viewport" content="width=device-width, initial-scale=1"><title>{html.escape(title)}</title>
<style>{style}</style></head>
<body>
{body}
{run}</body></html>
"""


def view(result: FitResult, picture: int | None) -> Page:
    """The page of `FitResult.view`.

    Args:
        result: of a fit.
        picture: which of its pictures, from 0; None takes the one that is explained worst.
    """
    return Page(secure_page(f"{result.surface}, fitted", viewer(result, picture)))


def viewer(result: FitResult, picture: int | None = None) -> str:
    """The viewer as HTML, for the body of a `secure_page`.

    Args:
        result: of a fit.
        picture: which of its pictures, from 0; None takes the one that is explained worst.
    """
    from fitting.report.plots import shown_picture, window  # Matplotlib takes long to load

    picture = shown_picture(result, picture)
    scene, material = result.scenes[picture], result.material
    names = channel_names(max(material.k_d.shape[0], result.targets[picture].shape[-1]))
    count = len(names)
    chosen = [0, count // 2, count - 1] if count > 3 else [min(channel, count - 1) for channel in range(3)]
    target, fitted = np.asarray(result.targets[picture], np.float32), result.fitted(picture)
    counted = np.asarray(result.counted[picture])
    rows, columns = window(counted)
    left, top = int(columns.start), int(rows.start)
    stride = math.ceil(max(rows.stop - top, columns.stop - left) / LARGEST)
    rows, columns = slice(top, rows.stop, stride), slice(left, columns.stop, stride)
    target, fitted = (_of_channels(image, chosen)[rows, columns] for image in (target, fitted))
    counted = counted[rows, columns]
    drawn, notes = _scene(scene, chosen)
    if count > 3:
        notes.append(f"Of {count} channels three are shown as colours: {', '.join(names[c] for c in chosen)}.")
    if stride > 1:
        notes.append(f"Of the picture every {stride}th column and row is held here.")
    difference = np.abs(np.where(counted[..., None], fitted - np.nan_to_num(target), 0.0)).max(axis=-1)
    # No white that only a few pixels of a highlight reach; and none that is clipped for no reason.
    white = min(4 * np.quantile(target[counted], 0.999), np.max(target[counted])) if counted.any() else 1.0
    drawable = drawn["drawable"]
    data = drawn | {
        "model": material.name,
        "family": _family(material),
        "weighted": getattr(material, "cosine_weighted", False),
        "channels": names,
        "shown": chosen,
        "material": _numbers(material),
        "numbers": _sliders(result, chosen),
        "window": [left, top, target.shape[1], target.shape[0], stride],
        "target": _packed(_with_alpha(target, counted)),
        "still": "" if drawable else _packed(_with_alpha(fitted, counted)),
        "exposure": -math.log2(max(float(white), 1e-12)),
        "residual": max(float(np.quantile(difference[counted], 0.999)) if counted.any() else 1.0, 1e-9),
        "notes": notes,
        "shader": _shaders(type(material)),
        "formats": _formats(material),
    }
    data["albedo"] = {"degrees": _DEGREES.tolist()}
    if isinstance(material, SpecularMaterial):
        data |= _tables(material.name)
    # In a script element nothing but </script and <!-- has a meaning to HTML.
    text = json.dumps(data, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
    still = np.concatenate([brdf.displayed(image, max(white, 1e-12)) for image in (target, fitted)], axis=1)
    return Template(_asset("viewer.html")).substitute(still=png_address(still), data=text)


@functools.cache
def _asset(name: str) -> str:
    return (resources.files("fitting.report") / "viewer_assets" / name).read_text(encoding="utf-8")


def _packed(values: Any) -> str:
    """Numbers as text: float32, gzip, base64."""
    packed = gzip.compress(np.ascontiguousarray(values, np.float32).tobytes(), mtime=0)
    return base64.b64encode(packed).decode()


def _with_alpha(image, counted):
    return np.concatenate([np.nan_to_num(image), counted[..., None]], axis=-1)


def _of_channels(image, chosen):
    """Three colours of an image, or of one colour."""
    return np.take(image, [min(channel, image.shape[-1] - 1) for channel in chosen], axis=-1)


def _family(material):
    if not isinstance(material, SpecularMaterial):
        return None
    return "mirror" if normalized_form(type(material)) is brdf.NormalizedPhong else "half"


def _numbers(material):
    keys = [key for key in ("k_a", "k_d", "k_s", "n") if hasattr(material, key)]
    return {key: np.asarray(getattr(material, key), np.float64).tolist() for key in keys}


def _sliders(result, chosen):
    """What stands at each number's slider; of one that was held in the fit its value alone."""
    fitted = {(one.name, one.channel): one for one in result.parameters}
    rows = []
    for name, values in _numbers(result.material).items():
        for channel in (None,) if name == "n" else sorted(set(chosen) & set(range(len(values)))):
            row = {"name": name, "channel": channel, "value": values if channel is None else values[channel]}
            one = fitted.get((name, channel))
            if one is not None:
                ends = None if one.interval is None else [end if math.isfinite(end) else None for end in one.interval]
                row |= {"value": one.value, "interval": ends, "reason": one.reason}
            rows.append(row)
    return rows


def _scene(scene: brdf.Scene, chosen: list[int]) -> tuple[dict[str, Any], list[str]]:
    """Camera, shapes and lights as the shader takes them, and what it cannot draw of them."""
    shapes = {"spheres": [], "rectangles": [], "meshes": []}
    pivot, unit = _extent(scene)

    def home(position: Any) -> list[float]:
        return ((np.asarray(position, np.float64) - pivot) / unit).tolist()

    for shape in scene.shapes if scene.camera is not None else ():
        if isinstance(shape, brdf.Sphere):
            shapes["spheres"].append([*home(shape.center), float(shape.radius) / unit, shape.fitted])
        elif isinstance(shape, brdf.Rectangle):
            edges = [(np.asarray(edge) / unit).tolist() for edge in (shape.edge_u, shape.edge_v)]
            shapes["rectangles"].append([home(shape.center), *edges, shape.fitted])
        elif isinstance(shape, brdf.Triangles):
            corners = (shape.mesh.vertices[shape.mesh.faces] - pivot) / unit
            flat = shape.mesh.normals is None
            normals = np.repeat(shape.mesh.front[:, None], 3, axis=1) if flat else shape.mesh.normals
            mesh = {"corners": _packed(corners), "normals": _packed(normals), "fitted": shape.fitted}
            shapes["meshes"].append(mesh)
    lights = [_light(light, home, chosen) for light in scene.lights if light.type_name in _KINDS]
    missing = sorted({light.type_name for light in scene.lights if light.type_name not in _KINDS})
    notes = [f"A light of the type {kind} is not drawn: it has an extent." for kind in missing]
    if scene.occluders and scene.lights:
        notes.append("Shadows are not drawn.")
    if any(mask is not None for mask in scene.visibility):
        notes.append("Given shadow masks are not drawn.")
    if scene.camera is None:
        notes.append("What the picture shows came as surface points: it does not turn, a ball stands for it.")
    drawable = not notes
    if not lights and not drawable:
        notes.append("In place of its light stands a directional one.")
        toward = (np.array([-0.5, 0.6, 0.8]) / math.sqrt(1.25)).tolist()
        lights = [{"kind": 0, "place": toward, "intensity": [0.9] * 3} | _NO_CONE]
    if not drawable:
        notes.append("The picture in the fit’s own view and light is shown as it was computed.")
    elif scene.camera is not None and scene.camera.samples > 1:
        notes.append("Each pixel is drawn at its centre; the fit averaged over the pixel’s area.")
    ambient = [0.0] * 3 if scene.ambient is None else _colour(scene.ambient, chosen)
    frame = {"camera": _camera(scene.camera, home, unit), "pivot": pivot.tolist(), "unit": unit}
    frame |= {"traced": scene.camera is not None, "drawable": drawable, "lights": lights, "ambient": ambient}
    return frame | shapes, notes


def _extent(scene):
    """The middle of what is fitted, and half its size."""
    ends = []
    for shape in scene.shapes if scene.camera is not None else ():
        if not shape.fitted:
            continue
        if isinstance(shape, brdf.Sphere):
            center = np.asarray(shape.center, np.float64)
            ends += [center - float(shape.radius), center + float(shape.radius)]
        elif isinstance(shape, brdf.Rectangle):
            center, u, v = (np.asarray(x, np.float64) for x in (shape.center, shape.edge_u, shape.edge_v))
            ends += [center + a * u + b * v for a in (-1, 1) for b in (-1, 1)]
        elif isinstance(shape, brdf.Triangles):
            ends += [shape.mesh.vertices.min(axis=0), shape.mesh.vertices.max(axis=0)]
    if not ends:
        return np.zeros(3), 1.0
    low, high = np.min(ends, axis=0), np.max(ends, axis=0)
    return 0.5 * (low + high), float(0.5 * np.max(high - low))


def _camera(camera, home, unit):
    if camera is None:
        axes = {"right": [1.0, 0.0, 0.0], "up": [0.0, 1.0, 0.0], "forward": [0.0, 0.0, -1.0]}
        place = {"position": [0.0, 0.0, 4.0], "half_width": 1.1, "resolution": [2, 2]}
        return axes | place | {"perspective": False, "local": False}
    position, target, up = (np.asarray(x, np.float64) for x in (camera.position, camera.target, camera.up))
    forward = (target - position) / np.linalg.norm(target - position)
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    width, height = camera.resolution
    perspective = isinstance(camera, brdf.PerspectiveCamera)
    if perspective:
        half_width = math.tan(math.radians(float(camera.fov)) / 2) * width / height
    else:
        half_width = float(camera.width) / 2 / unit
    axes = {"right": right.tolist(), "up": np.cross(right, forward).tolist(), "forward": forward.tolist()}
    local = (camera.viewer or camera.default_viewer) == "local"
    place = {"position": home(position), "half_width": half_width, "resolution": [width, height]}
    return axes | place | {"perspective": perspective, "local": local}


_NO_CONE = {"attenuation": [1.0, 0.0, 0.0], "axis": [0.0, 0.0, -1.0], "cone": [-1.0, 0.0]}


def _light(light, home, chosen):
    kind = _KINDS[light.type_name]
    drawn = {"kind": kind, "intensity": _colour(light.intensity, chosen)} | _NO_CONE
    if kind == 0:
        toward = np.asarray(light.direction, np.float64)
        return drawn | {"place": (toward / np.linalg.norm(toward)).tolist()}
    drawn |= {"place": home(light.position), "attenuation": np.asarray(light.attenuation, np.float64).tolist()}
    if kind == 2:
        axis, cutoff = np.asarray(light.direction, np.float64), float(light.cutoff_angle)
        cone = [math.cos(math.radians(cutoff)) if cutoff < 180 else -1.0, float(light.exponent)]
        drawn |= {"axis": (axis / np.linalg.norm(axis)).tolist(), "cone": cone}
    return drawn


def _colour(values, chosen):
    return _of_channels(np.asarray(values, np.float64), chosen).tolist()


def _shaders(model):
    names = ["K_A", "K_D", *(["K_S"] if issubclass(model, SpecularMaterial) else [])]
    declared = [f"uniform vec3 BRDF_{name};" for name in names]
    if issubclass(model, SpecularMaterial):
        declared.append("uniform float BRDF_N, BRDF_SCALE;")
    material = shader(model, "\n".join(declared))
    return {"material": material, "vertex": _asset("camera.vert"), "fragment": _asset("surface.frag")}


@functools.cache
def _tables(name: str) -> dict[str, Any]:
    """What the page interpolates in log n: the lobe's albedo, and what the nearest normalised form takes."""

    def rounded(values: Any) -> Any:
        return [[float(f"{value:.5g}") for value in row] for row in values]

    model: Any = brdf.MODELS[name]
    with working_precision("float64"):
        lobe = np.asarray(lobe_albedo(model, 10.0 ** _LOG_N[:, None], np.radians(_DEGREES)[None, :]))
    tables = {"albedo": {"log_n": _LOG_N.tolist(), "degrees": _DEGREES.tolist(), "lobe": rounded(lobe)}}
    if model.cosine_weighted:
        return tables
    equations = [nearest_equations(model, normalized_form(model), float(10.0**log_n)) for log_n in _LOG_N]
    return tables | {"nearest": rounded([[*gram[0], gram[1, 1], *cross] for gram, cross in equations])}


def _formats(material):
    formats = {}
    for to in FORMATS:
        try:
            export = brdf.export_material(material, to)
        except InputError as error:
            formats[to] = {"text": "", "losses": [str(error)]}
        else:
            formats[to] = {"text": export.text, "losses": list(export.losses)}
    return formats
