"""Pictures of a fit, for print: colour-blind-safe, readable in grey, linear values shown through the sRGB encoding.

Every function returns a matplotlib figure and shows nothing.
"""

from typing import Any

import matplotlib
import numpy as np
from jaxtyping import Bool, Float
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter

import brdf
from brdf.channels import channel_names
from brdf.models.base import SpecularMaterial
from fitting.result import FitResult

PRINT: dict[Any, Any] = {
    "font.size": 8,
    "axes.titlesize": 9,
    "axes.labelsize": 8,
    "legend.fontsize": 7,
    "figure.dpi": 120,
}
"""Sizes in points for a figure as wide as a page, 7.2 inches."""

CHANNEL_COLOURS = ("#D55E00", "#009E73", "#0072B2", "#CC79A7", "#E69F00", "#56B4E9")
"""Vermilion, green, blue, purple, orange, sky blue (Okabe and Ito 2008): told apart by the colour-blind."""

CHANNEL_STYLES = ("-", "--", "-.", ":")

SIGNED = "cividis"
"""For signed values: blue, grey at zero, yellow; lightness only grows, so that the sign survives printing in grey."""


def comparison(result: FitResult, picture: int | None = None) -> Figure:
    """Target, fit and signed residual; the highlight enlarged, a scanline through it, and the profile of n.

    Pixels left out are grey in the residual; margins without a pixel that counts are cropped. Without a specular term
    the second row is the scanline alone.

    Args:
        result: of a fit.
        picture: which of its pictures, from 0; None takes the one that is explained worst.

    Raises:
        InputError: where there is no such picture.
    """
    why = " (explained worst)" if picture is None else ""
    picture = explained_worst(result) if picture is None else picture
    title = named_picture(result, picture, why)
    target, fitted = np.asarray(result.targets[picture]), result.fitted(picture)
    counted = np.asarray(result.counted[picture])
    values = target[counted]
    white = max(float(np.quantile(values, 0.999)), 1e-12) if values.size else 1.0
    box = _highlight(result, picture, target, counted)
    specular = isinstance(result.material, SpecularMaterial) and bool(np.any(np.asarray(result.material.k_s)))
    with matplotlib.rc_context(PRINT):
        figure = Figure(figsize=(7.2, 4.9), layout="constrained")
        figure.suptitle(title, fontsize=PRINT["axes.titlesize"])
        grid = figure.add_gridspec(2, 3)
        above = [figure.add_subplot(grid[0, column]) for column in range(3)]
        for axes, image, title in zip(above, (target, fitted), ("target", f"fit, {result.surface}"), strict=False):
            axes.imshow(brdf.displayed(image, white))
            axes.set_title(title)
            axes.axhline(box.row, color="white", linewidth=0.6, linestyle=(0, (4, 4)))
        _residual(figure, above[2], target, fitted, counted)
        for axes in above:
            axes.set(xticks=[], yticks=[], **_around(counted))
        if specular:
            _enlarged(figure.add_subplot(grid[1, 0]), target, fitted, box, white)
            _scanline(figure.add_subplot(grid[1, 1]), target, fitted, counted, box.row, box.columns)
            _profile(figure.add_subplot(grid[1, 2]), result)
        else:
            _scanline(figure.add_subplot(grid[1, :]), target, fitted, counted, box.row, slice(0, target.shape[1]))
    return figure


def explained_worst(result: FitResult) -> int:
    """Which picture has the largest residual, as a share of itself.

    Args:
        result: of a fit.
    """
    if len(result.targets) == 1:
        return 0
    shares = []
    for index, (target, counted) in enumerate(zip(result.targets, result.counted, strict=True)):
        values, known = np.asarray(target, np.float64), np.asarray(counted)[..., None]
        left = np.sum((result.fitted(index) - values) ** 2, where=known)
        shares.append(left / max(float(np.sum(values**2, where=known)), np.finfo(float).tiny))
    return int(np.argmax(shares))


def named_picture(result: FitResult, picture: int, why: str = "") -> str:
    """Which picture is shown, in words; its name alone, or nothing, where it is the only one.

    Args:
        result: of a fit.
        picture: which, from 0.
        why: it is shown, to be added where there are several.

    Raises:
        InputError: where there is no such picture.
    """
    count = len(result.targets)
    if not 0 <= picture < count:
        raise brdf.InputError("picture", f"must be from 0 to {count - 1}, got {picture}", "Count the pictures from 0")
    name = result.names[picture] if result.names else ""
    return name if count == 1 else f"picture {picture + 1} of {count}{', ' if name else ''}{name}{why}"


def _around(counted: Bool[np.ndarray, "H W"]) -> dict[str, tuple[float, float]]:
    """Limits of axes that show what counts, and a margin around it: a thing may be small in its picture."""
    if not counted.any():
        return {}
    rows, columns = np.flatnonzero(counted.any(axis=1)), np.flatnonzero(counted.any(axis=0))
    height, width = counted.shape
    margin = 2 + max(np.ptp(rows), np.ptp(columns)) // 16
    return {
        "xlim": (max(columns[0] - margin, 0) - 0.5, min(columns[-1] + margin, width - 1) + 0.5),
        "ylim": (min(rows[-1] + margin, height - 1) + 0.5, max(rows[0] - margin, 0) - 0.5),
    }


class _Box:
    """Where the highlight is: its row, and the rows and columns worth enlarging."""

    def __init__(self, image: Float[np.ndarray, "H W"]):
        height, width = image.shape
        self.row, column = (int(i) for i in np.unravel_index(np.argmax(image), image.shape))
        bright = np.argwhere(image > 0.2 * image.max()) if image.max() > 0 else np.array([[0, 0]])
        reach = int(np.max(np.abs(bright - [self.row, column]))) + 2
        reach = min(max(reach, 8), max(height, width) // 2)
        self.rows = slice(max(self.row - reach, 0), min(self.row + reach + 1, height))
        self.columns = slice(max(column - reach, 0), min(column + reach + 1, width))


def _highlight(result: FitResult, picture: int, target: np.ndarray, counted: Bool[np.ndarray, "H W"]) -> _Box:
    material, scene = result.material, result.scenes[picture]
    image = np.nan_to_num(target).max(axis=-1)
    if isinstance(material, SpecularMaterial) and np.any(np.asarray(material.k_s)):
        dark = type(material)(k_d=0.0 * np.asarray(material.k_d), k_s=material.k_s, n=material.n)
        image = np.asarray(brdf.render(dark, scene, precision=result.precision)).max(axis=-1)
    return _Box(np.where(counted, image, 0.0))


def _residual(figure: Figure, axes: Any, target: np.ndarray, fitted: np.ndarray, counted: np.ndarray) -> None:
    """At each pixel the channel that is farthest off, with its sign: a mean could hide a wrong colour."""
    difference = np.where(counted[..., None], fitted - np.nan_to_num(target), 0.0)
    farthest = np.argmax(np.abs(difference), axis=-1)[..., None]
    signed = np.where(counted, np.take_along_axis(difference, farthest, axis=-1)[..., 0], np.nan)
    limit = max(float(np.nanquantile(np.abs(signed), 0.999)), 1e-12) if counted.any() else 1.0
    axes.set_facecolor("0.85")
    image = axes.imshow(signed, cmap=SIGNED, vmin=-limit, vmax=limit)
    axes.set_title("fit − target" + (", largest channel" if target.shape[-1] > 1 else ""))
    bar: Any = figure.colorbar(image, ax=axes, label="radiance", extend="both")
    bar.formatter.set_powerlimits((-2, 3))


def _enlarged(axes: Any, target: np.ndarray, fitted: np.ndarray, box: _Box, white: float) -> None:
    crop = np.concatenate([image[box.rows, box.columns] for image in (target, fitted)], axis=1)
    axes.imshow(brdf.displayed(crop, max(white, float(np.nanmax(crop)))), interpolation="nearest")
    half = box.columns.stop - box.columns.start
    axes.axvline(half - 0.5, color="white", linewidth=1)
    axes.set(xticks=[0.5 * half, 1.5 * half], xticklabels=["target", "fit"], yticks=[])
    axes.tick_params(length=0)
    axes.set_title(f"highlight, {half} pixels wide")


def _scanline(axes: Any, target: np.ndarray, fitted: np.ndarray, counted: np.ndarray, row: int, columns: slice) -> None:
    place = np.arange(columns.start, columns.stop)
    channels = target.shape[-1]
    names = channel_names(channels)
    step = max(1, len(place) // 30)
    seen = counted[row, columns] | np.any(fitted[row, columns] != 0, axis=-1)
    # Of a spectrum, as many channels as there are colours, from the first to the last.
    shown = np.unique(np.linspace(0, channels - 1, min(channels, len(CHANNEL_COLOURS))).round().astype(int))
    for index, channel in enumerate(shown):
        colour, style = CHANNEL_COLOURS[index], CHANNEL_STYLES[index % len(CHANNEL_STYLES)]
        known = np.where(counted[row, columns], target[row, columns, channel], np.nan)
        line = np.where(seen, fitted[row, columns, channel], np.nan)
        label = "fit" if channels == 1 else names[channel] if channels == 3 else f"channel {names[channel]}"
        axes.plot(place[::step], known[::step], "o", color=colour, markersize=2.5, markerfacecolor="none")
        axes.plot(place, line, style, color=colour, linewidth=1.2, label=label)
    axes.plot([], [], "o", color="0.3", markersize=2.5, markerfacecolor="none", label="target")
    axes.set(xlabel=f"column, in row {row}", ylabel="radiance (linear)", title="scanline")
    axes.legend(frameon=False, handlelength=2.2, ncols=2, loc="upper center", bbox_to_anchor=(0.5, -0.2))


def _profile(axes: Any, result: FitResult) -> None:
    """The least residual at each exponent: how deep the minimum is, and whether there are others."""
    optimum = result.optimum
    grid, profile = np.asarray(optimum.grid), np.asarray(optimum.profile)
    exact = float(np.sum(optimum.cost))
    if grid.size and not optimum.flat and exact < profile.min():  # the grid steps over a sharp minimum
        place = np.searchsorted(grid, optimum.n)
        grid, profile = np.insert(grid, place, optimum.n), np.insert(profile, place, exact)
    found = next((parameter for parameter in result.parameters if parameter.name == "n"), None)
    axes.set(xscale="log", xlabel="exponent n", title="profile of n")
    if grid.size > 1:
        percent = 100 * np.sqrt(np.maximum(profile, 0.0) / np.sum(optimum.square))
        axes.plot(grid, percent, color="black", linewidth=1.2)
        axes.set(ylabel="least residual, % of the picture", xlim=(grid[0], grid[-1]))
        if percent.max() > 5 * max(percent.min(), 1e-9):
            axes.set_yscale("log")
            axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            axes.yaxis.set_major_formatter("{x:g}")
            axes.yaxis.set_minor_formatter(NullFormatter())
    if found is None or found.value is None:
        axes.set_title("profile of n: not determined")
        return
    axes.axvline(found.value, color=CHANNEL_COLOURS[0], linewidth=1)
    text = f"n = {found.value:.5g}"
    if found.interval is not None:
        low, high = max(found.interval[0], 1e-3), min(found.interval[1], 1e9)
        axes.axvspan(low, high, color=CHANNEL_COLOURS[5], alpha=0.5, linewidth=0)
        text += f", 95 %:\n{found.interval[0]:.6g} to {found.interval[1]:.6g}"
    axes.set_xlabel(f"exponent n\n{text}")  # where no curve runs through it
