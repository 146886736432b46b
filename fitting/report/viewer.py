"""A page that turns: the fitted surface drawn by the reader's own browser, with its numbers, light and view to move.

What draws is the GLSL export's own formula with the numbers as uniforms (`viewer_assets/surface.frag` finds what a
pixel sees, the export says what that shows), so that the browser shows what `brdf.render` shows. What it cannot draw it
names: lights with an extent, shadows.
"""

import functools
import math
from typing import Any

import numpy as np

import brdf
from brdf.albedo import lobe_albedo, normalized_form
from brdf.conversions import nearest_equations
from brdf.errors import InputError
from brdf.materials.exports import shader
from brdf.models.base import SpecularMaterial
from brdf.precision import working_precision
from fitting.report.page import Page, Shown, asset, packed, secure_page, stage, white
from fitting.result import FitResult

LARGEST = 512
"""Pixels on a side that the page holds of a picture; of a larger one every second, third, ... pixel."""

FORMATS = ("json", "mtl", "three", "glsl")
_KINDS = {"directional": 0, "point": 1, "spot": 2}
_LOG_N = np.linspace(-1.0, 6.0, 36)
_DEGREES = np.array([*range(0, 80, 2), *range(80, 89), 88.5, 89, 89.3, 89.6, 89.8, 89.9])


def view(result: FitResult, picture: int | None) -> Page:
    """The page of `FitResult.view`.

    Args:
        result: of a fit.
        picture: which of its pictures, from 0; None takes the one that is explained worst.
    """
    return Page(secure_page(f"{result.surface}, fitted", viewer(result, picture), "viewer.js"))


def viewer(result: FitResult, picture: int | None = None) -> str:
    """The viewer as HTML, for the body of a `secure_page`.

    Args:
        result: of a fit.
        picture: which of its pictures, from 0; None takes the one that is explained worst.
    """
    from fitting.report.plots import shown_picture  # Matplotlib takes long to load

    picture = shown_picture(result, picture)
    scene, material = result.scenes[picture], result.material
    counted = np.asarray(result.counted[picture])
    shown = Shown.of(counted, max(material.k_d.shape[0], result.targets[picture].shape[-1]), LARGEST)
    target, fitted = (shown.pixels(image) for image in (result.targets[picture], result.fitted(picture)))
    target, counted = target.astype(np.float32), counted[shown.rows, shown.columns]
    drawn, notes = _scene(scene, shown)
    difference = np.abs(np.where(counted[..., None], fitted - np.nan_to_num(target), 0.0)).max(axis=-1)
    brightest = white(target[counted])
    data = (
        shown.data
        | drawn
        | {
            "model": material.name,
            "family": _family(material),
            "weighted": getattr(material, "cosine_weighted", False),
            "material": _numbers(material),
            "numbers": _sliders(result, shown.channels),
            "target": _packed(_with_alpha(target, counted)),
            "still": "" if drawn["drawable"] else _packed(_with_alpha(fitted, counted)),
            "exposure": -math.log2(brightest),
            "residual": max(float(np.quantile(difference[counted], 0.999)) if counted.any() else 1.0, 1e-9),
            "notes": [*notes, *shown.notes],
            "shader": _shaders(type(material)),
            "formats": _formats(material),
        }
    )
    data["albedo"] = {"degrees": _DEGREES.tolist()}
    if isinstance(material, SpecularMaterial):
        data |= _tables(material.name)
    still = np.concatenate([brdf.displayed(image, brightest) for image in (target, fitted)], axis=1)
    return stage("surface.html", data, still)


def _packed(values):
    return packed(np.asarray(values, np.float32))


def _with_alpha(image, counted):
    return np.concatenate([np.nan_to_num(image), counted[..., None]], axis=-1)


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


def _scene(scene: brdf.Scene, shown: Shown) -> tuple[dict[str, Any], list[str]]:
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
    lights = [_light(light, home, shown) for light in scene.lights if light.type_name in _KINDS]
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
    ambient = [0.0] * 3 if scene.ambient is None else _colour(scene.ambient, shown)
    camera = _camera_of_a_ball(shown) if scene.camera is None else _camera(scene.camera, home, unit)
    frame = {"camera": camera, "pivot": pivot.tolist(), "unit": unit}
    frame |= {"traced": scene.camera is not None, "drawable": drawable, "lights": lights, "ambient": ambient}
    return frame | shapes, notes


def _extent(scene):
    """The middle of what is fitted, and half its size."""
    ends = [_outline(shape) for shape in scene.shapes if shape.fitted] if scene.camera is not None else []
    if not ends:
        return np.zeros(3), 1.0
    ends = np.concatenate(ends)
    low, high = np.min(ends, axis=0), np.max(ends, axis=0)
    return 0.5 * (low + high), float(0.5 * np.max(high - low))


def _outline(shape):
    """Points that reach as far as the shape along each axis."""
    if isinstance(shape, brdf.Triangles):
        return shape.mesh.vertices
    center = np.asarray(shape.center, np.float64)
    if isinstance(shape, brdf.Sphere):
        return center + float(shape.radius) * np.array([[-1.0], [1.0]])
    u, v = (np.asarray(edge, np.float64) for edge in (shape.edge_u, shape.edge_v))
    return np.array([center + a * u + b * v for a in (-1, 1) for b in (-1, 1)])


def _camera_of_a_ball(shown):
    """From which a ball of radius 1 stands in the middle of what is shown."""
    left, top, width, height, stride = shown.data["window"]
    resolution = [2 * first + stride * (count - 1) + 1 for first, count in ((left, width), (top, height))]
    axes = {"right": [1.0, 0.0, 0.0], "up": [0.0, 1.0, 0.0], "forward": [0.0, 0.0, -1.0], "position": [0.0, 0.0, 4.0]}
    half_width = 1.1 * resolution[0] / (stride * min(width, height))
    return axes | {"half_width": half_width, "resolution": resolution, "perspective": False, "local": False}


def _camera(camera, home, unit):
    perspective = isinstance(camera, brdf.PerspectiveCamera)
    with working_precision("float64"):
        axes = {name: axis.tolist() for name, axis in zip(("right", "up", "forward"), camera.axes(), strict=True)}
        half_width = float(camera.half_width) / (1.0 if perspective else unit)
    local = (camera.viewer or camera.default_viewer) == "local"
    place = {"position": home(camera.position), "half_width": half_width, "resolution": [*camera.resolution]}
    return axes | place | {"perspective": perspective, "local": local}


_NO_CONE = {"attenuation": [1.0, 0.0, 0.0], "axis": [0.0, 0.0, -1.0], "cone": [-1.0, 0.0]}


def _light(light, home, shown):
    kind = _KINDS[light.type_name]
    drawn = {"kind": kind, "intensity": _colour(light.intensity, shown)} | _NO_CONE
    if kind == 0:
        toward = np.asarray(light.direction, np.float64)
        return drawn | {"place": (toward / np.linalg.norm(toward)).tolist()}
    drawn |= {"place": home(light.position), "attenuation": np.asarray(light.attenuation, np.float64).tolist()}
    if kind == 2:
        axis, cutoff = np.asarray(light.direction, np.float64), float(light.cutoff_angle)
        cone = [math.cos(math.radians(cutoff)) if cutoff < 180 else -1.0, float(light.exponent)]
        drawn |= {"axis": (axis / np.linalg.norm(axis)).tolist(), "cone": cone}
    return drawn


def _colour(values, shown):
    return shown.colours(np.asarray(values, np.float64)).tolist()


def _shaders(model):
    names = ["K_A", "K_D", *(["K_S"] if issubclass(model, SpecularMaterial) else [])]
    declared = [f"uniform vec3 BRDF_{name};" for name in names]
    if issubclass(model, SpecularMaterial):
        declared.append("uniform float BRDF_N, BRDF_SCALE;")
    material = shader(model, "\n".join(declared))
    return {"vertex": asset("camera.vert"), "fragment": material + asset("display.frag") + asset("surface.frag")}


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
