"""How materials and reports show themselves: pictures for a screen, and HTML for Jupyter and report files.

The HTML needs nothing from a network and takes its colours from the page it stands in.
"""

import base64
import html
import io
import math
from collections.abc import Callable, Container
from typing import Any

import numpy as np
from jaxtyping import Float

from brdf.channels import channel_names
from brdf.images.encoding import encode
from brdf.models import Material
from brdf.plausibility.report import Report

_CELL = "padding:0.15em 0.8em;text-align:right;white-space:nowrap"
_MARKS = {"pass": "✓ pass", "fail": "✗ fail", "cannot tell": "? cannot tell"}


def displayed(linear: Float[np.ndarray, "H W C"], white: float = 1.0) -> Float[np.ndarray, "H W 3"]:
    """Values for a screen, 0 to 1: linear radiance through the sRGB encoding (IEC 61966-2-1).

    Args:
        linear: radiance; one or three channels are shown as they are, others as their mean, NaN as black.
        white: the radiance that is shown as white.

    Example:
        >>> brdf.displayed(np.full((1, 1, 3), 0.5)).round(3)
        array([[[0.735, 0.735, 0.735]]], dtype=float32)
    """
    linear = np.asarray(linear, np.float32)
    if linear.shape[-1] != 3:
        linear = np.repeat(np.nan_to_num(linear).mean(axis=-1, keepdims=True), 3, axis=-1)
    return encode(np.clip(np.nan_to_num(linear / np.float32(white)), 0.0, 1.0), "srgb")


def lit_sphere(material: Material | Callable[[Any, Any], Any], size: int = 128) -> Float[np.ndarray, "H W 3"]:
    """A sphere of the material in one light from above left, as a screen shows it, on white.

    Args:
        material: any of the models, of known numbers; or f_r of directions to light and view, (P, 3) -> (P, C), in
            1/sr, whose tangent lies along the sphere's circles of latitude.
        size: pixels on a side.
    """
    place = 1.03 * ((np.arange(size) + 0.5) * 2 / size - 1)
    x, y = np.meshgrid(place, -place)
    inside = x * x + y * y < 1
    x, y = x[inside], y[inside]
    z = np.sqrt(1 - x * x - y * y)
    normal, tangent = np.stack([x, y, z], axis=-1), np.stack([z, 0 * x, -x], axis=-1) / np.hypot(x, z)[:, None]
    frame = np.stack([tangent, np.cross(normal, tangent), normal], axis=1)
    to_light = frame @ np.array([-0.5, 0.6, 0.8]) / math.sqrt(1.25)
    f_r: Any = getattr(material, "reflectance", material)
    lit = np.asarray(f_r(to_light, frame[:, :, 2])) * np.maximum(to_light[:, 2:], 0)
    image = np.ones((size, size, 3))
    image[inside] = displayed((0.2 * np.asarray(getattr(material, "k_a", 0.0)) + 0.9 * np.pi * lit)[None])[0]
    return image


def png_address(picture: Float[np.ndarray, "H W 3"]) -> str:
    """Values for a screen, 0 to 1, as a ``data:`` address that an ``<img>`` can show."""
    import matplotlib.image  # only where something is shown

    file = io.BytesIO()
    matplotlib.image.imsave(file, np.asarray(picture), format="png")
    return "data:image/png;base64," + base64.b64encode(file.getvalue()).decode()


def material_html(material: Material, undetermined: Container[str] = ()) -> str:
    """A material as HTML: a lit sphere and its numbers.

    Undetermined ones, such as "k_a[0]" or "n", are not shown where they are 0 for want of a value.
    """
    cell = f'<td style="{_CELL}">{{}}</td>'.format
    head = f'<th style="{_CELL}">{{}}</th>'.format
    rows = [["", *map(head, channel_names(np.asarray(material.k_d).size))]]
    for key in ("k_a", "k_d", "k_s", "n"):
        if hasattr(material, key):
            digits, values = 5 if key == "n" else 4, np.ravel(getattr(material, key))
            names = ["n"] if key == "n" else [f"{key}[{channel}]" for channel in range(len(values))]
            unknown = [name in undetermined and not value for name, value in zip(names, values, strict=True)]
            shown = ["–" if open_ else f"{value:.{digits}g}" for open_, value in zip(unknown, values, strict=True)]
            rows.append([key, *map(cell, shown)])
    table = "".join(f"<tr>{head(first)}{''.join(cells)}</tr>" for first, *cells in rows)
    picture = f'<img alt="a lit sphere" width="128" height="128" src="{png_address(lit_sphere(material))}">'
    style = "display:flex;flex-wrap:wrap;gap:1em;align-items:center"
    # A spectrum is wider than a page: the table scrolls, not the page.
    words = f'<div style="min-width:0;overflow-x:auto"><b>{html.escape(material.name)}</b><table>{table}</table></div>'
    return f'<div style="{style}">{picture}{words}</div>'


def report_html(report: Report) -> str:
    """A plausibility report as HTML."""
    rows = "".join(
        f'<tr><th style="{_CELL}">{name}</th><td style="{_CELL}">{_MARKS[finding.verdict]}</td>'
        f'<td style="padding:0.15em 0.8em;text-align:left">{html.escape(finding.sentence)}</td></tr>'
        for name, finding in report.findings.items()
    )
    nearest = html.escape(f"{report.nearest!r}")
    after = "" if report.nearest is None else f"<p>Its nearest plausible form is {nearest}.</p>"
    title = html.escape(report.title)
    return f'<div style="overflow-x:auto;overflow-wrap:anywhere"><b>{title}</b><table>{rows}</table>{after}</div>'
