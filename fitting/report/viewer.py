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
from brdf.albedo import has_other_lobe, lobe_albedo, normalized_form
from brdf.conversions import nearest_equations
from brdf.errors import InputError
from brdf.materials.exports import shader
from brdf.materials.material_file import material_to_dict
from brdf.models.base import SpecularMaterial
from brdf.precision import working_precision
from fitting.report.page import Page, Shown, asset, packed, secure_page, shown_picture, stage, white
from fitting.result import FitResult

LARGEST = 512
"""Pixels on a side that the page holds of a picture; of a larger one every second, third, ... pixel."""

FORMATS = ("json", "mtl", "three", "glsl")
KINDS = ("directional", "point", "spot")
_LOG_N = np.linspace(-1.0, 6.0, 36)
_DEGREES = np.array([*range(0, 80, 2), *range(80, 89), 88.5, 89, 89.3, 89.6, 89.8, 89.9])


def view(result: FitResult, picture: int | None) -> Page:
    """The page of `FitResult.view`."""
    return Page(secure_page(f"{result.surface}, fitted", viewer(result, picture), "viewer.js"))


def viewer(result: FitResult, picture: int | None = None) -> str:
    """The viewer as HTML, for the body of a `secure_page`; None takes the picture that is explained worst."""
    picture = shown_picture(result, picture)
    material, counted = result.material, np.asarray(result.counted[picture])
    shown = Shown.of(counted, max(material.k_d.size, result.targets[picture].shape[-1]), LARGEST)
    target, fitted = (shown.pixels(image) for image in (result.targets[picture], result.fitted(picture)))
    target, counted = target.astype(np.float32), counted[shown.rows, shown.columns]
    drawn, notes = _scene(result.scenes[picture], other_lobes(type(material)))
    difference = np.abs(fitted - np.nan_to_num(target)).max(axis=-1)[counted]
    brightest = white(target[counted])
    still = [np.concatenate([np.nan_to_num(image), counted[..., None]], axis=-1) for image in (target, fitted)]
    target_data, fitted_data = map(_packed, still)
    mirror = isinstance(material, SpecularMaterial) and normalized_form(type(material)) is brdf.NormalizedPhong
    numbers = material_to_dict(material)
    data = {
        "model": numbers.pop("model"),
        "family": "mirror" if mirror else "half",
        "weighted": getattr(material, "cosine_weighted", False),
        "material": numbers,
        "parameters": [one.to_dict() for one in result.parameters],
        "target": target_data,
        "still": "" if drawn["drawable"] else fitted_data,
        "exposure": -math.log2(brightest),
        "residual": max(float(np.quantile(difference, 0.999)), 1e-9) if counted.any() else 1.0,
        "notes": [*notes, *shown.notes],
        "shader": _shaders(type(material)),
        "formats": {to: _format(material, to) for to in FORMATS},
    }
    beside = np.concatenate([brdf.displayed(image, brightest) for image in (target, fitted)], axis=1)
    return stage("surface.html", shown.data | drawn | data | _tables(material.name), beside)


def other_lobes(*models: type[brdf.Material]) -> list[str]:
    """What a page says of models whose lobes it draws as another one's."""
    others = filter(has_other_lobe, models)
    return [f"The lobe of {model.name} is drawn as Blinn-Phong's, as is its albedo." for model in others]


def _scene(scene, notes):
    """Camera, shapes and lights as a scene file has them, and what the page cannot draw of them beside such notes."""
    traced, shapes = scene.camera is not None, []
    pivot, unit = _extent([shape for shape in scene.shapes if traced and shape.fitted])
    for shape in scene.shapes if traced else ():
        if isinstance(shape, brdf.Triangles):
            corners, normals = shape.mesh.vertices[shape.mesh.faces], shape.mesh.normals
            normals = np.repeat(shape.mesh.front[:, None], 3, axis=1) if normals is None else normals
            mesh = {"corners": _packed((corners - pivot) / unit), "normals": _packed(normals)}
            shapes.append(mesh | {"fitted": shape.fitted})
        else:
            shapes.append(_fields(shape))
    lights = [light for light in scene.lights if light.type_name in KINDS]
    missing = sorted({light.type_name for light in scene.lights} - {*KINDS})
    notes = [*notes, *(f"A light of the type {kind} is not drawn: it has an extent." for kind in missing)]
    if scene.occluders and scene.lights:
        notes.append("Shadows are not drawn.")
    if scene.visibility:
        notes.append("Given shadow masks are not drawn.")
    if not traced:
        notes.append("What the picture shows came as surface points: it does not turn, a ball stands for it.")
    drawable = not notes
    if not lights and not drawable:
        notes.append("In place of its light stands a directional one.")
        lights = [brdf.DirectionalLight([-0.5, 0.6, 0.8], [0.9])]
    if not drawable:
        notes.append("The picture in the fit’s own view and light is shown as it was computed.")
    elif scene.camera.samples > 1:
        notes.append("Each pixel is drawn at its centre; the fit averaged over the pixel’s area.")
    return {
        "camera": _camera(scene.camera) if traced else None,
        "pivot": pivot.tolist(),
        "unit": unit,
        "shapes": shapes,
        "lights": [_fields(light) | {"type": light.type_name} for light in lights],
        "ambient": [0.0] if scene.ambient is None else np.asarray(scene.ambient, np.float64).tolist(),
        "drawable": drawable,
    }, notes


def _packed(values):
    return packed(values.astype(np.float32))


def _fields(item: Any) -> dict[str, Any]:
    return {name: np.asarray(value, np.float64).tolist() for name, value in vars(item).items()}


def _camera(camera):
    places = {name: np.asarray(getattr(camera, name), np.float64).tolist() for name in ("position", "target", "up")}
    with working_precision("float64"):
        return places | {
            "half_width": float(camera.half_width),
            "resolution": [*camera.resolution],
            "perspective": isinstance(camera, brdf.PerspectiveCamera),
            "local": (camera.viewer or camera.default_viewer) == "local",
        }


def _extent(shapes):
    """The middle of what is fitted, and half its size."""
    ends = []
    for shape in shapes:
        if isinstance(shape, brdf.Triangles):
            ends.append(shape.mesh.vertices)
        else:
            sphere = isinstance(shape, brdf.Sphere)
            reach = shape.radius if sphere else np.abs(shape.edge_u) + np.abs(shape.edge_v)
            ends.append([shape.center - reach, shape.center + reach])
    if not ends:
        return np.zeros(3), 1.0
    points = np.concatenate(ends, dtype=np.float64)
    low, high = np.min(points, axis=0), np.max(points, axis=0)
    return 0.5 * (low + high), float(0.5 * np.max(high - low))


def _shaders(model):
    shiny = issubclass(model, SpecularMaterial)
    colours = [f"uniform vec3 BRDF_{name};" for name in ("K_A", "K_D", "K_S")[: 2 + shiny]]
    material = shader(model, "\n".join([*colours, *["uniform float BRDF_N, BRDF_SCALE;"] * shiny]))
    return {"vertex": asset("camera.vert"), "fragment": material + asset("display.frag") + asset("surface.frag")}


@functools.cache
def _tables(name: str) -> dict[str, Any]:
    """What the page interpolates in log n: the lobe's albedo, and what the nearest normalised form takes."""

    def rounded(values: Any) -> Any:
        return [[float(f"{value:.5g}") for value in row] for row in values]

    model: Any = brdf.MODELS[name]
    if not issubclass(model, SpecularMaterial):
        return {"albedo": {"degrees": _DEGREES.tolist()}}
    with working_precision("float64"):
        lobe = np.asarray(lobe_albedo(model, 10.0 ** _LOG_N[:, None], np.radians(_DEGREES)[None, :]))
    tables = {"albedo": {"log_n": _LOG_N.tolist(), "degrees": _DEGREES.tolist(), "lobe": rounded(lobe)}}
    if model.cosine_weighted:
        return tables
    equations = [nearest_equations(model, normalized_form(model), float(10.0**log_n)) for log_n in _LOG_N]
    return tables | {"nearest": rounded([[*gram[0], gram[1, 1], *cross] for gram, cross in equations])}


def _format(material, to):
    try:
        export = brdf.export_material(material, to)
    except InputError as error:
        return {"text": "", "losses": [str(error)]}
    return {"text": export.text, "losses": list(export.losses)}
