"""Pictures of a fit, for print: colour-blind-safe, readable in grey, linear values shown through the sRGB encoding.

They return a matplotlib figure and show nothing.
"""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import matplotlib
import numpy as np
from cycler import cycler
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter

import brdf
from brdf.channels import channel_names
from brdf.models.base import SpecularMaterial
from fitting.report.page import shown_picture, window

if TYPE_CHECKING:
    from fitting.result import FitResult

PRINT: dict[Any, Any] = {
    "font.size": 8,
    "axes.titlesize": 9,
    "legend.fontsize": 7,
    "legend.frameon": False,
    "lines.linewidth": 1.2,
    "markers.fillstyle": "none",
    "figure.dpi": 120,
    "figure.constrained_layout.use": True,
}
"""Sizes in points for a figure as wide as a page, 7.2 inches."""

CHANNEL_COLOURS = ("#D55E00", "#009E73", "#0072B2", "#CC79A7", "#E69F00", "#56B4E9")
"""Vermilion, green, blue, purple, orange, sky blue (Okabe and Ito 2008): told apart by the colour-blind."""

_LINE_STYLES = ("-", "--", "-.", ":", "-", "--")
CHANNELS = cycler(color=CHANNEL_COLOURS, linestyle=_LINE_STYLES)
"""Lines that are channels; the dashes say the same again."""

OTHERS = cycler(color=[CHANNEL_COLOURS[i] for i in (2, 0, 1, 3, 5, 4)], linestyle=_LINE_STYLES)
"""Lines that are none, so that their order of colours is not that of red, green and blue."""

SIGNED = "cividis"
"""For signed values: blue, grey at zero, yellow; lightness only grows, so that the sign survives printing in grey."""


@matplotlib.rc_context(PRINT)
def comparison(result: "FitResult", picture: int | None = None) -> Figure:
    """Target, fit and signed residual; the highlight enlarged, a scanline through it, and the profile of n.

    Pixels left out are grey in the residual; margins without a pixel that counts are cropped. Without a specular term
    the second row is the scanline alone.

    Args:
        result: of a fit.
        picture: which of its pictures, from 0; None takes the one that is explained worst.

    Raises:
        InputError: where there is no such picture.
    """
    count, why = len(result.targets), " (explained worst)" if picture is None else ""
    picture = shown_picture(result, picture)
    file = result.files[picture] if result.files else None
    name = Path(file["path"]).name if file else ""
    title = f"picture {picture + 1} of {count}{', ' if name else ''}{name}{why}" if count > 1 else name
    target, fitted, counted = np.asarray(result.targets[picture]), result.fitted(picture), result.counted[picture]
    white = max(float(np.quantile(target[counted], 0.999)), 1e-12) if counted.any() else 1.0
    specular = isinstance(result.material, SpecularMaterial) and bool(np.any(result.material.k_s))
    row, rows, columns = _highlight(result, picture, counted, specular)
    figure = Figure(figsize=(7.2, 4.9))
    figure.suptitle(title, fontsize=PRINT["axes.titlesize"])
    below = ["highlight", "scanline", "profile" if result.optimum else "scanline"] if specular else ["scanline"] * 3
    mosaic: Any = [["target", "fit", "residual"], below]
    panels: Any = figure.subplot_mosaic(mosaic)
    for key, image, title in ("target", target, "target"), ("fit", fitted, f"fit, {result.surface}"):
        panels[key].imshow(brdf.displayed(image, white))
        panels[key].axhline(row, color="white", linewidth=0.6, linestyle=(0, (4, 4)))
        panels[key].set_title(title)
    _residual(panels["residual"], target, fitted, counted)
    down, across = window(counted)
    for key in ("target", "fit", "residual"):
        panels[key].set_xlim(across.start - 0.5, across.stop - 0.5)
        panels[key].set_ylim(down.stop - 0.5, down.start - 0.5)
        panels[key].set(xticks=[], yticks=[])
    if specular:
        axes, width = panels["highlight"], columns.stop - columns.start
        crop = np.concatenate([image[rows, columns] for image in (target, fitted)], axis=1)
        axes.imshow(brdf.displayed(crop, max(white, float(np.nanmax(crop)))), interpolation="nearest")
        axes.axvline(width - 0.5, color="white")
        axes.set(xticks=[0.5 * width, 1.5 * width], xticklabels=["target", "fit"], yticks=[])
        axes.set_title(f"highlight, {width} pixels wide")
    if "profile" in panels:
        _profile(panels["profile"], result)
    _scanline(panels["scanline"], target, fitted, counted, row, columns)
    return figure


def _highlight(result, picture, counted, specular):
    """The row of the highlight's peak, and the rows and columns worth enlarging; all columns where there is none."""
    material = result.material
    image = np.nan_to_num(result.targets[picture])
    if specular:
        dark = type(material)(k_d=np.zeros_like(material.k_d), k_s=material.k_s, n=material.n)
        image = np.asarray(brdf.render(dark, result.scenes[picture], precision=result.precision))
    image = np.where(counted, image.max(axis=-1), 0.0)
    rows, columns = window(image > 0.2 * image.max())
    return np.argmax(image.max(axis=1)), rows, columns if specular else slice(0, image.shape[1])


def _residual(axes, target, fitted, counted):
    """At each pixel the channel that is farthest off, with its sign: a mean could hide a wrong colour."""
    difference = fitted - np.nan_to_num(target)
    farthest = np.argmax(np.abs(difference), axis=-1, keepdims=True)
    signed = np.where(counted, np.take_along_axis(difference, farthest, axis=-1)[..., 0], np.nan)
    limit = max(float(np.nanquantile(np.abs(signed), 0.999)), 1e-12) if counted.any() else 1.0
    axes.set_facecolor("0.85")
    image = axes.imshow(signed, cmap=SIGNED, vmin=-limit, vmax=limit)
    axes.set_title("fit − target" + (", largest channel" if target.shape[-1] > 1 else ""))
    bar = axes.figure.colorbar(image, ax=axes, label="radiance", extend="both")
    bar.formatter.set_powerlimits((-2, 3))


def _scanline(axes, target, fitted, counted, row, columns):
    """Lines are the fit, circles some of the pixels that count."""
    axes.set_prop_cycle(CHANNELS)
    target, fitted, counted = target[row, columns], fitted[row, columns], counted[row, columns, None]
    across, count = np.arange(columns.start, columns.stop), target.shape[-1]
    some = slice(None, None, max(1, len(across) // 30))
    fitted = np.where(counted | np.any(fitted != 0, axis=-1, keepdims=True), fitted, np.nan)
    target = np.where(counted, target, np.nan)
    circles: dict[str, Any] = {"marker": "o", "linestyle": "", "markersize": 2.5}
    for channel in shown_channels(count):
        label = {1: "fit", 3: channel_names(count)[channel]}.get(count, f"channel {channel}")
        (line,) = axes.plot(across, fitted[:, channel], label=label)
        axes.plot(across[some], target[some, channel], color=line.get_color(), **circles)
    axes.plot([], [], color="0.3", label="target", **circles)
    axes.set(xlabel=f"column, in row {row}", ylabel="radiance (linear)", title="scanline")
    axes.legend(ncols=2, loc="upper center", bbox_to_anchor=(0.5, -0.2))


def shown_channels(count: int, most: int = len(CHANNELS)) -> np.ndarray:
    """Of a spectrum as many channels as there are colours, from the first to the last."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(int))


def legible(axis: Any) -> None:
    """Numbers of a logarithmic axis that are read off: 20 and 50, not 2 × 10¹."""
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.set_major_formatter("{x:g}")
    axis.set_minor_formatter(NullFormatter())


def _profile(axes, result):
    """The least residual at each exponent: how deep the minimum is, and whether there are others."""
    optimum, found = result.optimum, result["n"]
    grid, profile, exact = optimum.grid, optimum.profile, np.sum(optimum.cost)
    if grid.size and not optimum.flat and exact < profile.min():  # the grid steps over a sharp minimum
        place = np.searchsorted(grid, optimum.n)
        grid, profile = np.insert(grid, place, optimum.n), np.insert(profile, place, exact)
    axes.set(xscale="log", xlabel="exponent n", title="profile of n")
    if grid.size > 1:
        percent = 100 * np.sqrt(np.maximum(profile, 0.0) / np.sum(optimum.square))
        axes.plot(grid, percent, color="black")
        axes.set(ylabel="least residual, % of the picture", xlim=(grid[0], grid[-1]))
        if percent.max() > 5 * max(percent.min(), 1e-9):
            axes.set_yscale("log")
            legible(axes.yaxis)
    if found.value is None:
        axes.set_title("profile of n: not determined")
        return
    axes.axvline(found.value, color=CHANNEL_COLOURS[0])
    text = f"exponent n\nn = {found.value:.5g}"
    if found.interval is not None:
        low, high = found.interval
        axes.axvspan(max(low, 1e-3), min(high, 1e9), color=CHANNEL_COLOURS[5], alpha=0.5, linewidth=0)
        text += f", 95 %:\n{low:.6g} to {high:.6g}"
    axes.set_xlabel(text)  # where no curve runs through it
