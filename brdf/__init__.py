"""Differentiable reflectance: models, lights, scenes, pictures and plausibility checks.

Names load when first used, so that importing the package does not import JAX.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from brdf.albedo import absorbed_fraction, directional_albedo
    from brdf.area_lights import PolygonLight, RectangleLight, SphereLight
    from brdf.camera import Camera, OrthographicCamera, PerspectiveCamera
    from brdf.conversions import (
        exponent_from_roughness,
        exponent_from_slope,
        half_from_mirror,
        mirror_from_half,
        nearest_classic,
        nearest_normalized,
        roughness_from_exponent,
        slope_from_exponent,
    )
    from brdf.display import displayed, lit_sphere, material_html, png_address, report_html
    from brdf.encodings import encode
    from brdf.environment import ConstantEnvironment, EnvironmentMap
    from brdf.errors import InputError
    from brdf.exports import EXPORTS, Export, export_material, mitsuba_dict, save_export
    from brdf.files import atomic_folder, atomic_path, input_file, read_text, write_text
    from brdf.images import ImageReader, Picture, read_image, read_layers, read_mask, read_picture, write_image
    from brdf.light_images import relight, render_lights
    from brdf.lights import DirectionalLight, Light, PointLight, SpotLight
    from brdf.materials import load_material, load_materials, material_from_dict, material_to_dict, save_material
    from brdf.measured import MeasuredBRDF, is_measured, load_measured
    from brdf.measured_merl import merl_table
    from brdf.meshes import Mesh, Triangles, load_mesh
    from brdf.models import (
        MODELS,
        BlinnPhong,
        Lambert,
        Material,
        NormalizedBlinnPhong,
        NormalizedPhong,
        Phong,
        SpecularMaterial,
    )
    from brdf.pixel_choice import some_pixels
    from brdf.plausibility import check
    from brdf.precision import Precision, cast, working_precision
    from brdf.presets import PRESETS, preset
    from brdf.rendering import Basis, BasisImages, Lobe, basis, basis_images, render
    from brdf.report import Finding, Report
    from brdf.scene import Scene
    from brdf.shapes import Rectangle, Shape, Sphere
    from brdf.stability import StabilityMap, stability_map, stability_maps
    from brdf.surface_points import SurfacePoints

_ROOMS = {
    "measured": ["MeasuredBRDF", "is_measured", "load_measured"],
    "measured_merl": ["merl_table"],
    "report": ["Finding", "Report"],
    "plausibility": ["check"],
    "conversions": [
        "exponent_from_roughness",
        "exponent_from_slope",
        "half_from_mirror",
        "mirror_from_half",
        "nearest_classic",
        "nearest_normalized",
        "roughness_from_exponent",
        "slope_from_exponent",
    ],
    "albedo": ["absorbed_fraction", "directional_albedo"],
    "area_lights": ["PolygonLight", "RectangleLight", "SphereLight"],
    "camera": ["Camera", "OrthographicCamera", "PerspectiveCamera"],
    "environment": ["ConstantEnvironment", "EnvironmentMap"],
    "display": ["displayed", "lit_sphere", "material_html", "png_address", "report_html"],
    "encodings": ["encode"],
    "errors": ["InputError"],
    "exports": ["EXPORTS", "Export", "export_material", "mitsuba_dict", "save_export"],
    "presets": ["PRESETS", "preset"],
    "files": ["atomic_folder", "atomic_path", "input_file", "read_text", "write_text"],
    "images": ["ImageReader", "Picture", "read_image", "read_layers", "read_mask", "read_picture", "write_image"],
    "light_images": ["relight", "render_lights"],
    "lights": ["DirectionalLight", "Light", "PointLight", "SpotLight"],
    "meshes": ["Mesh", "Triangles", "load_mesh"],
    "materials": ["load_material", "load_materials", "material_from_dict", "material_to_dict", "save_material"],
    "models": [
        "MODELS",
        "BlinnPhong",
        "Lambert",
        "Material",
        "NormalizedBlinnPhong",
        "NormalizedPhong",
        "Phong",
        "SpecularMaterial",
    ],
    "precision": ["Precision", "cast", "working_precision"],
    "rendering": ["Basis", "BasisImages", "Lobe", "basis", "basis_images", "render"],
    "scene": ["Scene"],
    "stability": ["StabilityMap", "stability_map", "stability_maps"],
    "shapes": ["Rectangle", "Shape", "Sphere"],
    "pixel_choice": ["some_pixels"],
    "surface_points": ["SurfacePoints"],
}
_ROOM_OF = {name: room for room, names in _ROOMS.items() for name in names}

__all__ = sorted(_ROOM_OF)


def __getattr__(name: str) -> Any:
    if name not in _ROOM_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_ROOM_OF[name]}"), name)


def __dir__() -> list[str]:
    return __all__
