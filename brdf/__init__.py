"""Differentiable reflectance: models, lights, scenes, pictures and plausibility checks.

Names load when first used, so that importing the package does not import JAX.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from brdf.albedo import absorbed_fraction, directional_albedo
    from brdf.channels import channel_names
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
    from brdf.errors import InputError
    from brdf.files import atomic_folder, atomic_path, check_folder, input_file, parse_number, read_text, write_text
    from brdf.geometry.camera import Camera, OrthographicCamera, PerspectiveCamera
    from brdf.geometry.meshes import Mesh, Triangles, load_mesh
    from brdf.geometry.shapes import Rectangle, Shape, Sphere
    from brdf.geometry.surface_points import SurfacePoints
    from brdf.images.encodings import encode
    from brdf.images.pictures import ImageReader, Picture, read_image, read_layers, read_mask, read_picture, write_image
    from brdf.light_images import relight, render_lights
    from brdf.lights.area import PolygonLight, RectangleLight, SphereLight
    from brdf.lights.environment import ConstantEnvironment, EnvironmentMap
    from brdf.lights.punctual import DirectionalLight, Light, PointLight, SpotLight
    from brdf.materials.exports import EXPORTS, Export, export_material, mitsuba_dict, save_export
    from brdf.materials.files import load_material, load_materials, material_from_dict, material_to_dict, save_material
    from brdf.materials.presets import PRESETS, preset
    from brdf.measured.merl import merl_table
    from brdf.measured.tables import MeasuredBRDF, is_measured, load_measured
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
    from brdf.plausibility.report import Finding, Report
    from brdf.plausibility.stability import StabilityMap, stability_map, stability_maps
    from brdf.plausibility.verdict import check
    from brdf.precision import Precision, cast, working_precision
    from brdf.rendering import Basis, BasisImages, Lobe, basis, basis_images, render
    from brdf.scenes.pixel_choice import some_pixels
    from brdf.scenes.scene import Scene

_ROOMS = {
    "measured.tables": ["MeasuredBRDF", "is_measured", "load_measured"],
    "measured.merl": ["merl_table"],
    "plausibility.report": ["Finding", "Report"],
    "plausibility.verdict": ["check"],
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
    "channels": ["channel_names"],
    "albedo": ["absorbed_fraction", "directional_albedo"],
    "lights.area": ["PolygonLight", "RectangleLight", "SphereLight"],
    "geometry.camera": ["Camera", "OrthographicCamera", "PerspectiveCamera"],
    "lights.environment": ["ConstantEnvironment", "EnvironmentMap"],
    "display": ["displayed", "lit_sphere", "material_html", "png_address", "report_html"],
    "images.encodings": ["encode"],
    "errors": ["InputError"],
    "materials.exports": ["EXPORTS", "Export", "export_material", "mitsuba_dict", "save_export"],
    "materials.presets": ["PRESETS", "preset"],
    "files": [
        "atomic_folder",
        "atomic_path",
        "check_folder",
        "input_file",
        "parse_number",
        "read_text",
        "write_text",
    ],
    "images.pictures": [
        "ImageReader",
        "Picture",
        "read_image",
        "read_layers",
        "read_mask",
        "read_picture",
        "write_image",
    ],
    "light_images": ["relight", "render_lights"],
    "lights.punctual": ["DirectionalLight", "Light", "PointLight", "SpotLight"],
    "geometry.meshes": ["Mesh", "Triangles", "load_mesh"],
    "materials.files": ["load_material", "load_materials", "material_from_dict", "material_to_dict", "save_material"],
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
    "scenes.scene": ["Scene"],
    "plausibility.stability": ["StabilityMap", "stability_map", "stability_maps"],
    "geometry.shapes": ["Rectangle", "Shape", "Sphere"],
    "scenes.pixel_choice": ["some_pixels"],
    "geometry.surface_points": ["SurfacePoints"],
}
_ROOM_OF = {name: room for room, names in _ROOMS.items() for name in names}

__all__ = sorted(_ROOM_OF)


def __getattr__(name: str) -> Any:
    if name not in _ROOM_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_ROOM_OF[name]}"), name)


def __dir__() -> list[str]:
    return __all__
