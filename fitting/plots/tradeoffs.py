"""The picture of a trade of speed for accuracy: error against time, both logarithmic."""

from typing import Any

import numpy as np

from fitting.accuracy.speed_table import Row, Tradeoff

# Colours that colour-blind readers tell apart (Okabe and Ito 2008), and marks that print in black and white.
LOOKS = {
    "default": ("#000000", "o"),
    "pixels": ("#0072B2", "s"),
    "samples": ("#D55E00", "^"),
    "precision": ("#009E73", "D"),
    "shadows": ("#CC79A7", "v"),
    "model": ("#E69F00", "P"),
    "solver": ("#56B4E9", "X"),
}
# Errors below this are rounding; they are drawn here.
LEAST = 1e-9


def error_against_time(tradeoff: Tradeoff) -> Any:
    """Draw it: one mark for each fit, the front, the default and the recommendation.

    Args:
        tradeoff: what was measured.

    Returns:
        A matplotlib figure, as wide as a column of a paper or two.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.4, 4.0), layout="constrained")
    axes = figure.add_subplot()
    axes.set_xscale("log")
    axes.set_yscale("log")
    rows = [row for row in tradeoff.rows if row.configuration is not None and np.isfinite(row.error)]
    for axis, (colour, marker) in LOOKS.items():
        chosen = [row for row in rows if row.axis == axis]
        if not chosen:
            continue
        times, errors = np.array([_place(row) for row in chosen]).T
        spread = np.minimum([1e3 * row.spread for row in chosen], 0.5 * times)
        axes.errorbar(
            times,
            errors,
            xerr=spread,
            fmt=marker,
            color=colour,
            markersize=6,
            elinewidth=0.8,
            capsize=0,
            label=axis,
            zorder=3,
        )
    front = np.array([_place(row) for row in tradeoff.front])
    if len(front):
        axes.step(front[:, 0], front[:, 1], where="post", color="0.6", linewidth=1.2, zorder=1, label="Pareto front")
    _mark(axes, tradeoff.recommended, "recommended", (12, 16))
    _mark(axes, tradeoff.default, "default", (-46, -22))
    axes.axhline(tradeoff.accuracy, color="0.4", linewidth=0.8, linestyle=(0, (4, 3)), zorder=0)
    axes.annotate(
        f"accuracy {tradeoff.accuracy:g}",
        (0.99, tradeoff.accuracy),
        xycoords=("axes fraction", "data"),
        ha="right",
        va="bottom",
        fontsize=8,
        color="0.3",
        zorder=0,
    )
    if tradeoff.floor > 0:
        axes.axhspan(LEAST / 10, tradeoff.floor, color="0.93", zorder=-1, linewidth=0, label="error of the reference")
    if rows:
        errors = [_place(row)[1] for row in rows]
        axes.set_ylim(min([*errors, tradeoff.accuracy]) / 4, max([*errors, tradeoff.accuracy]) * 5)
        ends = [1e3 * end for row in rows for end in (max(row.seconds - row.spread, row.seconds / 2), row.seconds)]
        axes.set_xlim(min(ends) / 1.5, max(ends) * 2.2)
    axes.set_xlabel("time of a fit, compiled (ms)")
    axes.set_ylabel("relative error of the fit")
    axes.grid(visible=True, which="major", color="0.9", linewidth=0.6)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False, fontsize=8, loc="upper left", bbox_to_anchor=(1.0, 1.0), borderaxespad=0.0)
    return figure


def _place(row: Row) -> tuple[float, float]:
    return 1e3 * row.seconds, max(row.error, LEAST)


def _mark(axes: Any, row: Row | None, word: str, offset: tuple[int, int]) -> None:
    """A ring about a mark, and a word beside it."""
    if row is None or not np.isfinite(row.error):
        return
    place = _place(row)
    size = 13 if word == "recommended" else 10
    axes.plot(
        *place, "o", markersize=size, markerfacecolor="none", markeredgecolor="0.1", markeredgewidth=1.1, zorder=4
    )
    axes.annotate(
        word,
        place,
        xytext=offset,
        textcoords="offset points",
        fontsize=9,
        bbox={"boxstyle": "square,pad=0.1", "facecolor": "white", "edgecolor": "none"},
        zorder=5,
        arrowprops={"arrowstyle": "-", "linewidth": 0.6, "shrinkB": 5},
    )
