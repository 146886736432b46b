"""The five models."""

from brdf.models.base import Material, SpecularMaterial
from brdf.models.blinn_phong import BlinnPhong, NormalizedBlinnPhong
from brdf.models.lambert import Lambert
from brdf.models.phong import NormalizedPhong, Phong

__all__ = [
    "MODELS",
    "BlinnPhong",
    "Lambert",
    "Material",
    "NormalizedBlinnPhong",
    "NormalizedPhong",
    "Phong",
    "SpecularMaterial",
]

MODELS: dict[str, type[Material]] = {
    model.name: model for model in (Lambert, Phong, BlinnPhong, NormalizedPhong, NormalizedBlinnPhong)
}
"""The models by the names that files and the command line use.

Example:
    >>> brdf.MODELS["phong"](k_d=0.3, k_s=0.5, n=50)
    Phong(k_a=[0], k_d=[0.3], k_s=[0.5], n=50)
"""
