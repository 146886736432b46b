"""Differentiable reflectance: models, lights, scenes, pictures and plausibility checks.

Names load when first used, so that importing the package does not import JAX.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from brdf.albedo import absorbed_fraction, directional_albedo
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
    from brdf.errors import InputError
    from brdf.files import atomic_folder, atomic_path, write_text
    from brdf.images import ImageReader, Picture, read_image, read_layers, read_mask, read_picture, write_image
    from brdf.lights import DirectionalLight, Light, PointLight
    from brdf.materials import load_material, load_materials, material_from_dict, material_to_dict, save_material
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
    from brdf.plausibility import check
    from brdf.precision import Precision, cast, working_precision
    from brdf.rendering import Basis, BasisImages, Lobe, basis, basis_images, render
    from brdf.report import Finding, Report
    from brdf.scene import Scene, SurfacePoints
    from brdf.shapes import Rectangle, Shape, Sphere

_ROOMS = {
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
    "camera": ["Camera", "OrthographicCamera", "PerspectiveCamera"],
    "errors": ["InputError"],
    "files": ["atomic_folder", "atomic_path", "write_text"],
    "images": ["ImageReader", "Picture", "read_image", "read_layers", "read_mask", "read_picture", "write_image"],
    "lights": ["DirectionalLight", "Light", "PointLight"],
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
    "scene": ["Scene", "SurfacePoints"],
    "shapes": ["Rectangle", "Shape", "Sphere"],
}
_ROOM_OF = {name: room for room, names in _ROOMS.items() for name in names}

__all__ = sorted(_ROOM_OF)


def __getattr__(name: str) -> Any:
    if name not in _ROOM_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_ROOM_OF[name]}"), name)


def __dir__() -> list[str]:
    return __all__
