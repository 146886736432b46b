"""The picture of a trade of speed for accuracy: error against time, both logarithmic."""

from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure

from fitting.report.plots import legible

if TYPE_CHECKING:
    from fitting.speed_accuracy import Tradeoff

# Colours that colour-blind readers tell apart (Okabe and Ito 2008), and marks that print in black and white.
MARKS = {
    "default": ("#000000", "o"),
    "pixels": ("#0072B2", "s"),
    "samples": ("#D55E00", "^"),
    "precision": ("#009E73", "D"),
    "solver": ("#56B4E9", "X"),
    "rounding": ("#CC79A7", "v"),
}
# An error of 0, that of the reference itself, is drawn so far below the least one.
BELOW = 8.0


def error_against_time(tradeoff: "Tradeoff") -> Figure:
    """Draw it: one mark for each fit, a ring about default and recommendation; the fits of the front have numbers.

    Args:
        tradeoff: what was measured.

    Returns:
        A matplotlib figure, as wide as a column of a paper or two.
    """
    figure = Figure(figsize=(6.4, 4.0), layout="constrained")
    axes = figure.add_subplot()
    axes.set(xscale="log", yscale="log", xlabel="time of a fit, compiled (ms)", ylabel="relative error of the fit")
    axes.axhline(tradeoff.accuracy, color="0.2", lw=0.9, ls="--", label=f"accuracy {tradeoff.accuracy:g}")
    rows = [row for row in tradeoff.rows if np.isfinite(row.error)]
    least = min([row.error for row in rows if row.error > 0] + [tradeoff.accuracy]) / BELOW
    points = {row: (1e3 * row.seconds, max(row.error, least)) for row in rows}
    for axis, (colour, mark) in MARKS.items():
        if some := [row for row in rows if row.axis == axis]:
            times, heights = np.array([points[row] for row in some]).T
            reach = np.minimum([1e3 * row.spread for row in some], 0.5 * times)
            axes.errorbar(times, heights, xerr=reach, fmt=mark, color=colour, elinewidth=0.8, zorder=3, label=axis)
    if tradeoff.front:
        front = np.array([points[row] for row in tradeoff.front]).T
        axes.step(*front, where="post", c="0.6", label="Pareto front")
    words = {row: tradeoff.marks(row).removesuffix("front").rstrip(", ") for row in rows}
    for number, row in enumerate(dict.fromkeys([*tradeoff.front, *filter(words.get, rows)]), start=1):
        axes.annotate(str(number), points[row], (-7, -5), textcoords="offset points", ha="right", va="top", fontsize=8)
        name = tradeoff.brief(row) + (" = reference" if row.error == 0 else "")
        if words[row]:
            axes.plot(*points[row], "o", markersize=11, markerfacecolor="none", markeredgecolor="0.1")
            name += f"\n({words[row]})"
        axes.plot([], [], color="0.3", marker=f"${number}$", linestyle="", label=name)
    axes.margins(0.12)
    legible(axes.xaxis)
    axes.grid(visible=True, color="0.9", linewidth=0.6)
    axes.legend(frameon=False, fontsize=8, loc="upper left", bbox_to_anchor=(1.0, 1.0), borderaxespad=0.0)
    return figure
