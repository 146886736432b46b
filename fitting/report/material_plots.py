"""Pictures of a material: albedo against angle, the lobe, and the reciprocity error.

They return a matplotlib figure and show nothing.
"""

from collections.abc import Callable
from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from brdf.albedo import directional_albedo, has_other_lobe
from brdf.channels import channel_names, in_channel
from brdf.display import lit_sphere
from brdf.measured.table import MeasuredBRDF, from_angles
from brdf.models.base import Material, SpecularMaterial
from brdf.plausibility.numeric import Sampler, albedo_of
from brdf.plausibility.report import Angles, Report
from fitting.report.plots import CHANNEL_COLOURS, CHANNELS, OTHERS, PRINT, SIGNED, shown_channels

Brdf = Material | Callable[[Any, Any], Any]
PARTS = 60  # of the samples of a table, each a point of a line
LIGHT = "angle of the light in degrees"


@matplotlib.rc_context(PRINT)
def overview(brdf: Brdf, report: Report | None = None) -> Figure:
    """A lit sphere, the lobe, the albedo and the reciprocity error on one page.

    Args:
        brdf: a material, or f_r(to_light, to_view) -> (C,).
        report: what ``brdf.check`` said of it.

    Returns:
        The figure.

    Example:
        >>> fitting.overview(brdf.preset("gold")).savefig("gold.png")
    """
    figure: Any = Figure(figsize=(7.2, 6.0))
    (ball, lobe), (albedo, reciprocity) = figure.subfigures(2, 2)
    is_material = isinstance(brdf, Material)
    axes = ball.add_subplot()
    axes.set_axis_off()
    axes.imshow(lit_sphere(brdf if is_material else Sampler(brdf), 256))
    name = brdf.name if is_material else getattr(brdf, "__name__", type(brdf).__name__)
    axes.set_title(f"{name}, n = {brdf.n:.4g}" if isinstance(brdf, SpecularMaterial) else name)
    plot_lobe(brdf, figure=lobe)
    plot_albedo(brdf, report, figure=albedo)
    plot_reciprocity(brdf, figure=reciprocity)
    return figure


def plot_albedo(brdf: Brdf, report: Report | None = None, figure: Any = None) -> Any:
    """Albedo against the angle of the light, per channel, with the limit 1.

    Args:
        brdf: a material, or f_r(to_light, to_view) -> (C,).
        report: what ``brdf.check`` said of it; marks the worst case and the angle at which the albedo crosses 1.
        figure: a figure or part of one to draw into; None makes one.

    Returns:
        The figure.

    Example:
        >>> fitting.plot_albedo(brdf.preset("gold")).savefig("albedo.png")
    """
    last = [89.0, 89.5, 89.7, 89.8, 89.9, 89.95, 89.99]
    if isinstance(brdf, Material) and not has_other_lobe(type(brdf)):
        degrees = np.array([*np.arange(0.0, 89.0, 0.5), *last])
        albedo = np.asarray(directional_albedo(brdf, np.radians(degrees), precision="float64"))
    else:
        degrees = np.array([*np.arange(0.0, 89.0, 2.0), *last])
        albedo = albedo_of(brdf, degrees)
    count, shown = albedo.shape[1], shown_channels(albedo.shape[1])
    figure, axes = _axes(figure, (6, 4))
    axes.axhspan(1, 2, color="0.92", zorder=0)
    axes.axhline(1, color="black")
    axes.annotate("more than arrives", (1, 1), (0, 4), textcoords="offset points", fontsize="small")
    axes.set_prop_cycle(CHANNELS if count == 3 else OTHERS)
    axes.plot(degrees, albedo[:, shown], label=np.array(channel_names(count))[shown].tolist())
    if count > 1:
        axes.legend(loc="upper left", ncols=3, title=None if count == 3 else "channel")  # where curves seldom are
    energy = report.energy if report else None
    if energy and energy.crossing:
        axes.axvline(energy.crossing, color="0.4", linestyle=":")
        axes.text(energy.crossing - 1, 1.2, f"exceeds 1 beyond {Angles(energy.crossing)}", ha="right")
    if energy and energy.value < 1.5:
        axes.plot(energy.to_light.polar, energy.value, "ko", fillstyle="none", clip_on=False)
    axes.set(xlabel=LIGHT, ylabel="albedo", xlim=(0, 90), ylim=(0, 1.5), title="Light reflected, of that arriving")
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

    Example:
        >>> fitting.plot_lobe(brdf.preset("gold"), angles=(0, 45)).savefig("lobe.png")
    """
    sample = Sampler(brdf)
    figure, axes = _axes(figure, (6, 4), projection="polar")
    axes.set_prop_cycle(OTHERS)
    apart = np.geomspace(1e-3, 60, 400)  # denser near the mirror direction, where narrow lobes are
    for angle in angles:
        views = np.unique([*np.linspace(-90, 90, 721), *(angle - apart), angle, *(angle + apart)])
        views = np.radians(views[np.abs(views) <= 90])
        view = from_angles(views, 0.0)
        value = sample(from_angles(np.radians([-angle]), 0.0), view)[:, channel] * view[:, 2]
        axes.plot(views, np.sign(value) * np.abs(value) ** 0.5, label=f"light at {angle:g}°")
    axes.set_theta_zero_location("N")
    axes.set_theta_direction(-1)
    axes.set_thetalim(-np.pi / 2, np.pi / 2)
    axes.yaxis.set_major_locator(MaxNLocator(3))
    axes.yaxis.set_major_formatter(lambda r, _: f"{r * abs(r):.3g}")
    axes.legend(loc="lower center", ncols=len(angles), bbox_to_anchor=(0.5, 0.0))
    axes.set_title(f"Lobe f_r (N·V) in 1/sr, root scale{in_channel(channel, sample.channels)}")
    return figure


def plot_reciprocity(brdf: Brdf, channel: int = 0, figure: Any = None) -> Any:
    """Map of the relative difference of f_r when light and view change places, on opposite sides of the normal.

    Args:
        brdf: a material, or f_r(to_light, to_view) -> (C,).
        channel: which channel.
        figure: as for `plot_albedo`.

    Returns:
        The figure: angle of the light across, angle of the view upwards.

    Example:
        >>> fitting.plot_reciprocity(brdf.preset("gold")).savefig("reciprocity.png")
    """
    sample = Sampler(brdf)
    angles = np.linspace(0, 89.5, 180)
    to_light, to_view = from_angles(np.radians(np.meshgrid(angles, -angles, indexing="ij")).reshape(2, -1), 0.0)
    there, back = sample(to_light, to_view)[:, channel], sample(to_view, to_light)[:, channel]
    difference = (there - back) / np.max(np.abs([there, back]), axis=0, initial=1e-300)
    figure, axes = _axes(figure, (5.2, 4.2))
    most = np.abs(difference).max()
    bound = max(most, 1e-6)
    difference = difference.reshape(len(angles), -1)
    image = axes.pcolormesh(angles, angles, difference.T, cmap=SIGNED, vmin=-bound, vmax=bound, rasterized=True)
    figure.colorbar(image, label="(f_r(light→view) − f_r(view→light)) / the larger")
    axes.set(xlabel=LIGHT, ylabel="angle of the view in degrees", aspect="equal")
    axes.set_title(f"Reciprocity error to 89.5°:\n{most:.2g}{in_channel(channel, sample.channels)}")
    return figure


def _axes(figure, size, **how):
    """A figure, of some size where there is none yet, and axes that fill it."""
    figure = figure or Figure(figsize=size, layout="constrained")
    return figure, figure.add_subplot(**how)


@matplotlib.rc_context(PRINT)
def plot_table(table: MeasuredBRDF, material: Material, counted: np.ndarray) -> Figure:
    """A measured BRDF and the material fitted to it: f_r cos θ of the light over the angle of the half vector.

    Lines are medians; shaded is what the middle four fifths of the table's counted samples, (P,), at that angle show.
    """
    light, view, values = table.to_light[counted], table.to_view[counted], table.values[counted]
    half = light + view
    angle = np.degrees(np.arctan2(np.linalg.norm(half[:, :2], axis=1), half[:, 2]))
    fitted = np.broadcast_to(material.reflectance(light, view), values.shape)
    parts = np.array_split(np.argsort(angle), min(PARTS, len(angle)))
    across = [np.mean(angle[part]) for part in parts]
    figure, axes = _axes(None, (4.6, 3.2))
    axes.set(yscale="log", xlabel="half vector from the normal (°)", ylabel="f_r cos θ (1/sr)")
    for colour, channel in zip(CHANNEL_COLOURS, shown_channels(len(table.channels), 3), strict=False):
        measured, modelled = values[:, channel] * light[:, 2], fitted[:, channel] * light[:, 2]
        low, middle, high = np.transpose([np.quantile(measured[part], (0.1, 0.5, 0.9)) for part in parts])
        axes.fill_between(across, low, high, color=colour, alpha=0.2, linewidth=0)
        axes.plot(across, middle, color=colour, label=f"{table.channels[channel]}, table")
        axes.plot(across, [np.median(modelled[part]) for part in parts], "--", color=colour, label="fit")
    axes.set_title(f"{table.name}: {material.name}")
    axes.legend(bbox_to_anchor=(1.0, 1.0), loc="upper left")
    return figure
