"""The picture of a trade of speed for accuracy: error against time, both logarithmic."""

from typing import TYPE_CHECKING

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from fitting.report.plots import CHANNEL_COLOURS, PRINT, legible

if TYPE_CHECKING:
    from fitting.speed_accuracy import Tradeoff

# Marks that print in black and white, one for each axis.
MARKERS = "os^DXv*"
# An error of 0, that of the reference itself, is drawn so far below the least one.
BELOW = 8.0
# Of what is drawn, on either side: a part of its decades, and decades at least, for one fit alone has no width.
MARGIN, AT_LEAST = 0.12, 0.3


@matplotlib.rc_context(PRINT)
def error_against_time(tradeoff: "Tradeoff") -> Figure:
    """Draw it, as wide as a column of a paper or two.

    There is one mark for each fit, a ring about default and recommendation; the fits of the front have numbers.
    """
    figure = Figure(figsize=(6.4, 4.0))
    axes = figure.add_subplot()
    axes.set(xscale="log", yscale="log", xlabel="time of a fit, compiled (ms)", ylabel="relative error of the fit")
    rows = [row for row in tradeoff.rows if np.isfinite(row.error)]
    least = min([row.error for row in rows if row.error > 0] + [tradeoff.accuracy]) / BELOW
    points = {row: (1e3 * row.seconds, max(row.error, least)) for row in rows}
    axes.set(xlim=_about([time for time, _ in points.values()]))
    axes.set(ylim=_about([tradeoff.accuracy, *(error for _, error in points.values())]))
    axes.axhline(tradeoff.accuracy, color="0.2", ls="--", label=f"accuracy {tradeoff.accuracy:g}")
    kinds = dict.fromkeys(row.axis for row in rows)
    for axis, marker, colour in zip(kinds, MARKERS, ("black", *CHANNEL_COLOURS), strict=False):
        some = [row for row in rows if row.axis == axis]
        reach = [1e3 * min(row.spread, row.seconds / 2) for row in some]
        spot = {"fmt": marker, "color": colour, "fillstyle": "full", "label": axis}
        axes.errorbar(*zip(*map(points.get, some), strict=True), xerr=reach, **spot)
    if tradeoff.front:
        axes.step(*np.array([points[row] for row in tradeoff.front]).T, where="post", c="0.6", label="Pareto front")
    words = {row: tradeoff.marks(row).removesuffix("front").rstrip(", ") for row in rows}
    for number, row in enumerate(dict.fromkeys([*tradeoff.front, *filter(words.get, rows)]), start=1):
        axes.annotate(str(number), points[row], (-7, -5), textcoords="offset points", ha="right", va="top")
        name = tradeoff.brief(row) + (" = reference" if row.error == 0 else "")
        if words[row]:
            axes.plot(*points[row], "o", markersize=11, color="0.1")
            name += f"\n({words[row]})"
        axes.plot([], [], color="0.3", marker=f"${number}$", linestyle="", label=name)
    legible(axes.xaxis)
    axes.grid(color="0.9")
    axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), borderaxespad=0.0)
    return figure


def _about(values: list[float]) -> tuple[float, float]:
    logarithms = np.log10(values or [1.0])
    margin = max(MARGIN * np.ptp(logarithms), AT_LEAST)
    return 10 ** (logarithms.min() - margin), 10 ** (logarithms.max() + margin)
