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
# An error of 0, that of the reference itself, is drawn so far below the least one.
BELOW = 8.0


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
    rows = [row for row in tradeoff.rows if row.configuration is not None and np.isfinite(row.rms)]
    least = min([_error(row) for row in rows if _error(row) > 0] + [tradeoff.accuracy]) / BELOW
    for axis, (colour, marker) in LOOKS.items():
        chosen = [row for row in rows if row.axis == axis]
        if not chosen:
            continue
        times, errors = np.array([_place(row, least) for row in chosen]).T
        # Of another model only the picture can be compared.
        hollow = all(np.isinf(row.error) for row in chosen)
        axes.errorbar(
            times,
            errors,
            xerr=np.minimum([1e3 * row.spread for row in chosen], 0.5 * times),
            fmt=marker,
            color=colour,
            markerfacecolor="none" if hollow else colour,
            markersize=6,
            elinewidth=0.8,
            capsize=0,
            label=f"{axis} (picture only)" if hollow else axis,
            zorder=3,
        )
    front = np.array([_place(row, least) for row in tradeoff.front])
    if len(front):
        axes.step(front[:, 0], front[:, 1], where="post", color="0.6", linewidth=1.2, zorder=1, label="Pareto front")
    words: dict[Row, str] = {}
    best = tradeoff.recommended
    told = (best, "recommended") if best is not None else (tradeoff.closest, "most accurate")
    for row, word in ((tradeoff.default, "default"), told):
        if row is not None and np.isfinite(row.error):
            words[row] = f"{words[row]}, {word}" if row in words else word
    for row, word in words.items():
        _mark(axes, _place(row, least), word)
    exact = [_place(row, least) for row in rows if _error(row) == 0]
    for place in exact:
        axes.annotate(
            "0, the reference", place, xytext=(7, -3), textcoords="offset points", fontsize=8, color="0.3", zorder=5
        )
    label = f"accuracy {tradeoff.accuracy:g}"
    axes.axhline(tradeoff.accuracy, color="0.4", linewidth=0.8, linestyle=(0, (4, 3)), zorder=0, label=label)
    if rows:
        errors = [_place(row, least)[1] for row in rows]
        axes.set_ylim(min([*errors, tradeoff.accuracy]) / 4, max([*errors, tradeoff.accuracy]) * 5)
        ends = [1e3 * end for row in rows for end in (max(row.seconds - row.spread, row.seconds / 2), row.seconds)]
        axes.set_xlim(min(ends) / 2.5, max(ends) * 2.2)
    axes.set_xlabel("time of a fit, compiled (ms)")
    axes.set_ylabel("relative error of the fit")
    axes.grid(visible=True, which="major", color="0.9", linewidth=0.6)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False, fontsize=8, loc="upper left", bbox_to_anchor=(1.0, 1.0), borderaxespad=0.0)
    return figure


def _error(row: Row) -> float:
    return row.error if np.isfinite(row.error) else row.rms


def _place(row: Row, least: float) -> tuple[float, float]:
    return 1e3 * row.seconds, max(_error(row), least)


def _mark(axes: Any, place: tuple[float, float], word: str) -> None:
    """A ring about a mark, and a word below it, where nothing better was found."""
    axes.plot(*place, "o", markersize=11, markerfacecolor="none", markeredgecolor="0.1", markeredgewidth=1.1, zorder=4)
    axes.annotate(
        word,
        place,
        xytext=(-6, -26),
        textcoords="offset points",
        ha="center",
        fontsize=9,
        zorder=5,
        arrowprops={"arrowstyle": "-", "linewidth": 0.6, "shrinkB": 5},
    )
