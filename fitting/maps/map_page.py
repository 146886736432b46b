"""Maps as a page: the reader's browser relights them, as `Maps.render` does, by the GLSL export's own formula."""

import html
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

import brdf
from brdf.albedo import normalized_form
from brdf.display import png_address
from brdf.materials.exports import shader
from fitting.maps.texels import OCTAVES
from fitting.report.page import Page, Shown, asset, packed, secure_page, stage
from fitting.report.viewer import other_lobes

if TYPE_CHECKING:
    from fitting.maps.map_result import Maps

LARGEST = 1024
"""Texels on a side that the page holds; of larger maps every second, third, ... texel."""

LIGHT = np.array([-0.48, 0.6, 0.64])
"""Towards the first light: from the left above."""

_SCALES = {
    "normalized-phong": "0.5 * (n + 2.0)",
    "normalized-blinn-phong": "(n + 2.0) * (n + 4.0) / (8.0 * (exp2(-0.5 * n) + n))",
}


def maps_html(maps: "Maps") -> str:
    """What Jupyter shows of maps: under a light, and the report."""
    _, picture = _relit(maps, 256)
    address = png_address(brdf.displayed(picture, _range(picture)[1]))
    return f'<img src="{address}"><pre>{html.escape(str(maps))}</pre>'


def maps_page(maps: "Maps", title: str, reasons: Sequence[str]) -> Page:
    """One self-contained HTML page that shows the maps, under a light that moves and one by one.

    The title is text, ``reasons`` what ``reason`` of the maps means.
    """
    outside = reasons.index("outside")
    shown, picture = _relit(maps, LARGEST)
    part = (shown.rows, shown.columns)
    k_d, k_s = (np.nan_to_num(shown.pixels(k)) for k in (maps.k_d, maps.fitted_k_s))
    residual, error = np.nan_to_num(maps.residual[part]), np.nan_to_num(maps.n_error[part] / maps.n[part], nan=-1.0)
    log_n = np.log2(np.maximum(maps.fitted_n[part], 1))
    inside = maps.reason[part] != outside
    n, left, brightest = (_range(values[inside]) for values in (log_n, residual, picture))
    views = {
        "relit": (brightest, ""),
        "k_d": (_range(k_d[inside]), ""),
        "k_s": (_range(k_s[inside]), ""),
        "n": (n, f"n, by its logarithm: blue {2 ** n[0]:.3g}, yellow {2 ** n[1]:.3g}."),
        "normal": ([0, 1], "x to the right, y up, z to the eye: red, green, blue."),
        "determined": ([0, 1], "Whether n and k_s are determined, and why not:"),
        "error of n": ([0, 0.25], "Standard error of ln n: blue 0, yellow 0.25 and above, dark unknown."),
        "residual": (left, f"Of the photographs, blue {100 * left[0]:.2g} %, yellow {100 * left[1]:.2g} %."),
    }
    data = shown.data | {
        "models": list(maps.models),
        "maps": [{"name": name, "range": ends, "legend": legend} for name, (ends, legend) in views.items()],
        "reasons": list(reasons),
        "outside": outside,
        "octaves": OCTAVES,
        "to_view": (maps.to_view / np.linalg.norm(maps.to_view)).tolist(),
        "light": LIGHT.tolist(),
        "exposure": -math.log2(brightest[1]),
        "surface": packed(_surface(maps.normal[part], log_n, maps.reason[part] + 8 * maps.chosen[part])),
        "k_d": packed(_halves(k_d, residual)),
        "k_s": packed(_halves(k_s, error)),
        "text": str(maps),
        "notes": [*other_lobes(*(brdf.MODELS[name] for name in maps.models)), *shown.notes],
        "drawable": True,
        "shader": {
            "defined": [f"REASONS {len(reasons)}", f"OUTSIDE {outside}", f"OCTAVES {OCTAVES}.0"],
            "vertex": asset("camera.vert"),
            "fragments": [_fragment(name) for name in maps.models],
        },
    }
    body = f"<h1>{html.escape(title)}</h1>\n" + stage("maps.html", data, brdf.displayed(picture, brightest[1]))
    return Page(secure_page(title, body, "maps.js"))


def _relit(maps, largest):
    shown = Shown.of(np.any(maps.normal != 0, axis=-1), maps.k_d.shape[-1], largest)
    return shown, shown.pixels(maps.render(LIGHT))


def _range(values):
    """What is shown between, or as black and white: some outliers must not darken the rest."""
    low, high = np.percentile(values, [0.5, 99.5]).tolist() if values.size else (0.0, 1.0)
    return [low, max(high, low + 1e-6)]


def _surface(normal, log_n, kind):
    """Normal, exponent and kind in 16 bits each: normals within 5e-5 radians, n within 1e-4 of itself."""
    folded = normal / np.maximum(np.sum(np.abs(normal), axis=-1, keepdims=True), 1e-6)
    x, y, z = np.moveaxis(folded, -1, 0)
    below = z < 0
    square = [np.where(below, (1 - abs(b)) * np.where(a < 0, -1, 1), a) for a, b in ((x, y), (y, x))]
    codes = [32767 * one + 32767 for one in square]
    return np.round(np.stack([*codes, log_n * (65535 / OCTAVES), kind], axis=-1)).astype(np.uint16)


def _halves(colours, number):
    """Half floats, within 5e-4 of each as a share of it."""
    most = np.finfo(np.float16).max
    return np.clip(np.concatenate([colours, number[..., None]], axis=-1), -1, most).astype(np.float16)


def _fragment(name):
    numbers = "vec3 BRDF_K_A, BRDF_K_D, BRDF_K_S;\nfloat BRDF_N, BRDF_SCALE;\n"
    model: Any = brdf.MODELS[name]
    weighted = getattr(model, "cosine_weighted", False)
    scale = _SCALES[normalized_form(model).name] if weighted else "1.0"
    numbers += f"float brdf_scale(float n) {{ return {scale}; }}"
    return shader(model, numbers) + asset("display.frag") + asset("maps.frag")
