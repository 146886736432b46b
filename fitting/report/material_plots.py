"""Pictures of a material: albedo against angle, the lobe, the reciprocity error, and the stability map.

Every function returns a matplotlib figure and shows nothing. Colours are those of Okabe and Ito (2008), which people
with any common colour blindness tell apart; line styles say the same again.
"""

import math
from collections.abc import Callable
from typing import Any

import matplotlib
import matplotlib.colors
import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from brdf import displayed, lit_sphere
from brdf.albedo import directional_albedo
from brdf.channels import channel_names
from brdf.models import Material, SpecularMaterial
from brdf.plausibility.numeric import Sampler, albedo_of
from brdf.plausibility.report import Report
from brdf.plausibility.stability import StabilityMap

PRINT: dict[Any, Any] = {"font.size": 8, "axes.titlesize": 9, "legend.fontsize": 7}

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00")
"""Blue, vermilion, green, purple, sky blue, orange."""

RGB = (1, 2, 0)
"""Which of them stand for red, green and blue."""

_STYLES = ("-", "--", "-.", ":")
Brdf = Material | Callable[[Any, Any], Any]


def overview(brdf: Brdf, report: Report | None = None) -> Figure:
    """A lit sphere, the lobe, the albedo and the reciprocity error on one page.

    Args:
        brdf: a material, or f_r(to_light, to_view) -> (C,).
        report: what ``brdf.check`` said of it.

    Returns:
        The figure.
    """
    with matplotlib.rc_context(PRINT):
        figure = Figure(figsize=(7.2, 6.0), layout="constrained")
        parts: Any = figure.subfigures(2, 2)
        first, second, third, fourth = parts.ravel()
        axes = first.add_subplot()
        axes.set_axis_off()
        if isinstance(brdf, Material):
            axes.imshow(lit_sphere(brdf, 256))
            axes.set_title(brdf.name if not isinstance(brdf, SpecularMaterial) else f"{brdf.name}, n = {brdf.n:.4g}")
        else:
            axes.imshow(_lit_function(_sampler(brdf)))
            axes.set_title(getattr(brdf, "__name__", type(brdf).__name__))
        plot_lobe(brdf, figure=second)
        plot_albedo(brdf, report, figure=third)
        plot_reciprocity(brdf, figure=fourth)
    return figure


def plot_albedo(brdf: Brdf, report: Report | None = None, figure: Any = None) -> Any:
    """Albedo against the angle of the light, per channel, with the limit 1.

    Args:
        brdf: a material, or f_r(to_light, to_view) -> (C,).
        report: what ``brdf.check`` said of it; marks the worst case and the angle at which the albedo crosses 1.
        figure: a figure or part of one to draw into; None makes one.

    Returns:
        The figure.
    """
    degrees = np.append(np.arange(0.0, 89.6, 0.5), [89.7, 89.8, 89.9, 89.95, 89.99])
    if isinstance(brdf, Material):
        albedo = np.asarray(directional_albedo(brdf, np.radians(degrees), precision="float64"))
    else:
        degrees = np.append(np.arange(0.0, 89.0, 2.0), [89.0, 89.5, 89.9])
        albedo = albedo_of(brdf, degrees)
    figure = figure or Figure(figsize=(6, 4), layout="constrained")
    axes = figure.add_subplot()
    axes.axhspan(1, 2, color="0.92", zorder=0)
    axes.axhline(1, color="black", linewidth=1)
    axes.annotate("more than arrives", (1, 1), (0, 4), textcoords="offset points", fontsize="small")
    names = channel_names(albedo.shape[1])
    for channel in range(albedo.shape[1]):
        look = _look(channel)
        if albedo.shape[1] == 3:
            look["color"] = COLOURS[RGB[channel]]
        axes.plot(degrees, albedo[:, channel], **look, label=names[channel])
    if albedo.shape[1] > 1:
        axes.legend(loc="best")
    if report is not None and report.energy.crossing:
        axes.axvline(report.energy.crossing, color="0.4", linestyle=":", linewidth=1)
        text = f"exceeds 1 beyond {report.energy.crossing:.4g}°"
        axes.annotate(text, (report.energy.crossing, 1.2), (-5, 0), textcoords="offset points", ha="right")
    if report is not None and report.energy.value < 1.5:
        axes.plot(report.energy.to_light.polar, report.energy.value, "ko", markerfacecolor="none", clip_on=False)
    axes.set(xlabel="angle of the light in degrees", ylabel="albedo", xlim=(0, 90), ylim=(0, 1.5))
    axes.set_title("Light reflected, of that arriving")
    return figure


def plot_lobe(brdf: Brdf, angles: tuple[float, ...] = (0.0, 30.0, 60.0), channel: int = 0, figure: Any = None) -> Any:
    """Polar plot of f_r (N.V) in the plane of incidence, for several angles of the light.

    Args:
        brdf: a material, or f_r(to_light, to_view) -> (C,).
        angles: angles of the light in degrees, from the normal.
        channel: which channel.
        figure: as for `plot_albedo`.

    Returns:
        The figure; radii grow with the root, so that the diffuse part shows beside a bright lobe.
    """
    sample = _sampler(brdf)
    figure = figure or Figure(figsize=(6, 4), layout="constrained")
    axes: Any = figure.add_subplot(projection="polar")
    for index, angle in enumerate(angles):
        # denser near the mirror direction, where narrow lobes are
        near = angle + np.concatenate([-np.geomspace(1e-3, 60, 400)[::-1], [0.0], np.geomspace(1e-3, 60, 400)])
        views = np.unique(np.concatenate([np.linspace(-90, 90, 721), near]))
        views = np.radians(views[np.abs(views) <= 90])
        light = np.array([-math.sin(math.radians(angle)), 0.0, math.cos(math.radians(angle))])
        view = np.stack([np.sin(views), 0 * views, np.cos(views)], -1)
        value = sample(light[None], view)[:, channel] * view[:, 2]
        axes.plot(views, np.sign(value) * np.abs(value) ** 0.5, **_look(index), label=f"light at {angle:g}°")
    axes.set_theta_zero_location("N")
    axes.set_theta_direction(-1)
    axes.set_thetalim(-np.pi / 2, np.pi / 2)
    axes.yaxis.set_major_locator(MaxNLocator(3))
    axes.yaxis.set_major_formatter(lambda r, _: f"{r * abs(r):.3g}")
    axes.legend(loc="lower center", ncols=len(angles), bbox_to_anchor=(0.5, 0.0))
    axes.set_title(f"Lobe f_r (N·V) in 1/sr, root scale{_of(sample, channel)}")
    return figure


def plot_reciprocity(brdf: Brdf, channel: int = 0, figure: Any = None) -> Any:
    """Map of the relative difference of f_r when light and view change places, on opposite sides of the normal.

    Args:
        brdf: a material, or f_r(to_light, to_view) -> (C,).
        channel: which channel.
        figure: as for `plot_albedo`.

    Returns:
        The figure: angle of the light across, angle of the view upwards.
    """
    sample = _sampler(brdf)
    angles = np.linspace(0, 89.5, 180)
    light, view = (x.ravel() for x in np.meshgrid(np.radians(angles), np.radians(angles), indexing="ij"))
    to_light = np.stack([np.sin(light), 0 * light, np.cos(light)], -1)
    to_view = np.stack([-np.sin(view), 0 * view, np.cos(view)], -1)
    there, back = sample(to_light, to_view)[:, channel], sample(to_view, to_light)[:, channel]
    largest = np.maximum(np.maximum(np.abs(there), np.abs(back)), 1e-300)
    difference = ((there - back) / largest).reshape(len(angles), -1)
    figure = figure or Figure(figsize=(5.2, 4.2), layout="constrained")
    axes = figure.add_subplot()
    bound = max(float(np.abs(difference).max()), 1e-6)
    image = axes.pcolormesh(angles, angles, difference.T, cmap="cividis", vmin=-bound, vmax=bound, rasterized=True)
    figure.colorbar(image, label="(f_r(light→view) − f_r(view→light)) / the larger")
    axes.set(xlabel="angle of the light in degrees", ylabel="angle of the view in degrees", aspect="equal")
    axes.set_title(f"Reciprocity error, at most {np.abs(difference).max():.2g}{_of(sample, channel)}")
    return figure


def plot_stability(maps: list[StabilityMap]) -> Figure:
    """Error of float32 over exponent and angle, a panel for each model; a cross where a derivative is not finite.

    Args:
        maps: from `brdf.stability_map`, one a model.

    Returns:
        The figure.
    """
    figure = Figure(figsize=(3.0 * len(maps) + 1, 3.4), layout="constrained")
    panels = figure.subplots(1, len(maps), sharey=True, squeeze=False)[0]
    scale = matplotlib.colors.LogNorm(1e-8, 1e-4)
    image = None
    for axes, found in zip(panels, maps, strict=True):
        rows, columns = np.arange(len(found.exponents) + 1), np.arange(len(found.angles) + 1)
        image = axes.pcolormesh(columns, rows, np.clip(found.error, 1e-8, None), norm=scale, cmap="cividis")
        bad = np.argwhere(~found.finite)
        axes.plot(bad[:, 1] + 0.5, bad[:, 0] + 0.5, "rx")
        across, up = columns[:-1:6], rows[:-1:3]
        axes.set_xticks(across + 0.5, [f"{found.angles[i]:g}" for i in across])
        axes.set_yticks(up + 0.5, [f"{found.exponents[i]:.3g}" for i in up])
        axes.set_title(
            f"{found.model}\n{'all derivatives finite' if not len(bad) else f'{len(bad)} not finite'}", fontsize=10
        )
        axes.set_xlabel("angle of the light in degrees")
    panels[0].set_ylabel("exponent n")
    if image is not None:
        figure.colorbar(image, ax=list(panels), label="error of float32, of the peak", extend="both")
    return figure


def _lit_function(sample: Sampler, size: int = 256) -> Float[np.ndarray, "H W 3"]:
    """A sphere of any BRDF in one light from above left, as a screen shows it, on white; as `lit_sphere` lights it.

    The tangent lies along the sphere's circles of latitude.
    """
    place = 1.03 * ((np.arange(size) + 0.5) * 2 / size - 1)
    x, y = np.meshgrid(place, -place)
    inside = x * x + y * y < 1
    normal = np.stack([x, y, np.sqrt(np.maximum(1 - x * x - y * y, 0))], -1)[inside]
    tangent = np.stack([normal[:, 2], 0 * normal[:, 0], -normal[:, 0]], -1)
    tangent = tangent / np.maximum(np.linalg.norm(tangent, axis=1, keepdims=True), 1e-12)
    frame = np.stack([tangent, np.cross(normal, tangent), normal], axis=1)
    light = np.array([-0.5, 0.6, 0.8]) / np.linalg.norm([-0.5, 0.6, 0.8])
    to_light, to_view = frame @ light, frame[:, :, 2]
    cosine = to_light[:, 2:]
    radiance = 0.9 * np.pi * sample(to_light, to_view) * np.maximum(cosine, 0)
    image = np.zeros((size, size, radiance.shape[-1]))
    image[inside] = np.where(cosine > 0, np.nan_to_num(radiance), 0.0)
    return np.where(inside[..., None], displayed(image), 1.0)


def _of(sample: Sampler, channel: int) -> str:
    """Which channel is shown, where there are several."""
    if sample.channels == 1:
        return ""
    return f", {channel_names(sample.channels)[channel] if sample.channels == 3 else f'channel {channel}'}"


def _sampler(brdf: Brdf) -> Sampler:
    return Sampler(brdf.reflectance if isinstance(brdf, Material) else brdf)


def _look(index: int) -> dict[str, Any]:
    return {"color": COLOURS[index % len(COLOURS)], "linestyle": _STYLES[index % len(_STYLES)], "linewidth": 1.8}
