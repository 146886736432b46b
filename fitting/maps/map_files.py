"""Maps as files for this program and for others, and as a figure."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

import brdf
from brdf.files import as_path, atomic_folder, write_text
from brdf.images.writing import write_layers
from brdf.models.base import SpecularMaterial
from brdf.vectors import mirror_log_cosine
from fitting.maps.texels import OCTAVES
from fitting.report.page import asset

if TYPE_CHECKING:
    from fitting.maps.map_result import Maps

DIELECTRIC = 0.04
"""Reflectance at normal incidence that glTF takes for granted; KHR_materials_specular multiplies it."""

OPENLIME_LEAST = 0.004
"""The shader draws no highlight of a slope below 0.0032."""

MOST_REFLECTANCE = 0.98
"""The diffuse part is what facets let through: some has to be left."""


def write_maps(maps: "Maps", folder: str | Path, *, plot: bool = False) -> None:
    """Write what `Maps.save` promises."""
    layers = maps.layers()
    k_d, k_s = np.nan_to_num(maps.k_d), maps.fitted_k_s
    # Highlights that are not determined may be anything, and some outliers: neither must darken the rest.
    sure = maps.determined if maps.determined.any() else np.ones_like(maps.determined)

    def brightest(values):
        return float(np.percentile(values, 99.9)) or 1.0

    scale = {"k_d": brightest(k_d), "k_s": brightest(k_s[sure])}
    gloss = np.log2(np.maximum(maps.fitted_n, 1)) / OCTAVES
    half_n, f_0 = _as_facets(maps)
    known = sure[..., None] * f_0
    scale["openlime"] = brightest(np.maximum(k_d, known))
    of_openlime, limits = _openlime_images(k_d / scale["openlime"], f_0 / scale["openlime"], half_n)
    roughness = np.asarray(brdf.roughness_from_exponent(half_n))
    # Of a glTF material no part is above 1 and what shines is taken from what is diffuse: both are made darker alike.
    scale["material"] = max(1.0, brightest(np.max(k_d, axis=-1) + np.max(known, axis=-1)))
    base = k_d / scale["material"]
    f_0 = np.minimum(f_0 / scale["material"], np.clip(1 - np.max(base, axis=-1, keepdims=True), 0, MOST_REFLECTANCE))
    strongest = brightest(f_0[sure])
    f_0 = np.minimum(f_0, strongest)
    base /= 1 - np.max(f_0, axis=-1, keepdims=True)
    inside = np.any(maps.normal != 0, axis=-1)
    normals = np.where(inside[..., None], 0.5 * maps.normal + 0.5, 0.5)
    images = {
        "k_d": (k_d / scale["k_d"], "linear"),
        "k_s": (k_s / scale["k_s"], "linear"),
        "normals": (normals, "linear"),
        "gloss": (gloss, "linear"),
        "base_color": (base, "srgb"),
        "metallic_roughness": (np.stack([0 * gloss, roughness, 0 * gloss], axis=-1), "linear"),
        "specular_color": (f_0 / strongest, "srgb"),
        "residual": (np.nan_to_num(maps.residual), "linear"),
        **{name: (values, "linear") for name, values in of_openlime.items()},
    }
    height, width = maps.n.shape
    about = {
        "models": maps.models,
        "to_view": maps.to_view.tolist(),
        "to_light": None if maps.to_light is None else maps.to_light.tolist(),
        "intensity": None if maps.intensity is None else maps.intensity.tolist(),
        "notes": maps.notes,
        "layers": {name: str(values.dtype) for name, values in layers.items()},
        "scale": scale,
        "gloss": f"log2(n) / {OCTAVES}",
    }
    outdated = ["maps.png"] if (as_path(folder) / "maps.json").is_file() else []
    with atomic_folder(folder, outdated) as stage:
        write_layers(stage / "maps.exr", {name: np.asarray(values, np.float32) for name, values in layers.items()})
        for name, (values, encoding) in images.items():
            values = (
                values
                if values.ndim == 2 or values.shape[2] in (1, 3)
                else np.repeat(values.mean(axis=-1)[..., None], 3, axis=-1)
            )
            brdf.write_image(stage / f"{name}.png", values, dtype="uint16", encoding=encoding)
        if plot:
            draw_maps(maps).savefig(stage / "maps.png", dpi=110)
        write_text(stage / "maps.json", json.dumps(about, indent=2) + "\n")
        gltf = asset("maps.gltf").replace("ASPECT", str(width / height))
        write_text(stage / "material.gltf", gltf.replace("SPECULAR", str(strongest / DIELECTRIC)))
        write_text(stage / "info.json", json.dumps(_openlime_info(width, height, limits), indent=2) + "\n")


def _as_facets(maps: "Maps") -> tuple[np.ndarray, np.ndarray]:
    """Half-vector exponents, and the reflectance at normal incidence with which facets shine as brightly."""
    half_n, height = np.copy(maps.fitted_n), np.ones_like(maps.fitted_n)
    for index, model in enumerate(brdf.MODELS[name] for name in maps.models):
        if issubclass(model, SpecularMaterial):
            own = maps.chosen == index
            half_n[own] *= 4 if model.log_cosine is mirror_log_cosine else 1
            height[own] = model.scale(maps.fitted_n[own])
    # facets of slope alpha show F_0 / (4 alpha²) where the classic highlight shows k_s, and alpha² is 2 / (n+2)
    return half_n, maps.fitted_k_s * (8 * height / (half_n + 2))[..., None]


def _openlime_images(
    k_d: np.ndarray, f_0: np.ndarray, half_n: np.ndarray
) -> tuple[dict[str, np.ndarray], tuple[float, float]]:
    """What OpenLIME's shader draws as we do but for a factor, and between which slopes its gloss lies.

    (kd / π + ks exp(-tan²θ / α²) / (4 π α² √(N·L N·V))) N·L with α = (1 - glossiness)⁴ spread over these, θ between N
    and H; it is Ward's lobe, whose width and height at N = H = L are ours.
    """
    slope = np.maximum(brdf.slope_from_exponent(half_n), OPENLIME_LEAST)
    limits = min(0.01, float(np.min(slope))), max(0.5, float(np.max(slope)))
    least, most, own = (1 - np.asarray(one) ** 0.25 for one in (limits[1], limits[0], slope))
    return {"openlime_kd": k_d, "openlime_ks": f_0, "openlime_gloss": (own - least) / (most - least)}, limits


def _openlime_info(width: int, height: int, limits: tuple[float, float]) -> dict[str, Any]:
    """What OpenLIME's LayerBRDF is given: where its four channels are, and the range of one."""
    channels = {name: f"openlime_{name}.png" for name in ("kd", "ks", "gloss")} | {"normals": "normals.png"}
    return {
        "type": "brdf",
        "width": width,
        "height": height,
        "channels": channels,
        "colorspaces": {"kd": "linear", "ks": "linear"},
        "alphaLimits": limits,
    }


def draw_maps(maps: "Maps") -> Any:
    """The figure of `Maps.plot`."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12, 7), layout="constrained")
    axes = figure.subplots(2, 3).ravel()
    k_d, k_s = np.nan_to_num(maps.k_d), np.nan_to_num(maps.k_s)
    pictures = [
        ("k_d", brdf.displayed(k_d / (np.percentile(k_d, 99.5) or 1)), {}),
        ("k_s", brdf.displayed(k_s / (np.percentile(k_s, 99.5) or 1)), {}),
        ("normal", np.clip(0.5 * maps.normal + 0.5, 0, 1), {}),
        ("log2 n", np.log2(maps.n), {"vmin": 0, "vmax": OCTAVES, "cmap": "viridis"}),
        ("error of ln n", maps.n_error / maps.n, {"vmin": 0, "vmax": 0.25, "cmap": "magma"}),
        ("residual", maps.residual, {"vmin": 0, "cmap": "magma"}),
    ]
    for place, (name, values, how) in zip(axes, pictures, strict=True):
        shown = place.imshow(values, interpolation="nearest", **how)
        place.set(title=name, xticks=[], yticks=[])
        if how:
            figure.colorbar(shown, ax=place, shrink=0.8)
    return figure
