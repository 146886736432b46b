"""The picture of a trade of speed for accuracy: error against time, both logarithmic."""

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from fitting.speed_table import Row, Tradeoff

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


def error_against_time(tradeoff: "Tradeoff") -> Any:
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
    exact = [_place(row, least) for row in rows if _error(row) == 0]
    for place in exact:
        axes.annotate(
            "error 0: the reference",
            place,
            xytext=(9, -3),
            textcoords="offset points",
            fontsize=8,
            color="0.3",
            zorder=5,
        )
    label = f"accuracy {tradeoff.accuracy:g}"
    axes.axhline(tradeoff.accuracy, color="0.2", linewidth=0.9, linestyle=(0, (4, 3)), zorder=1, label=label)
    if rows:
        errors = [_place(row, least)[1] for row in rows]
        axes.set_ylim(min([*errors, tradeoff.accuracy]) / 4, max([*errors, tradeoff.accuracy]) * 5)
        ends = [1e3 * end for row in rows for end in (max(row.seconds - row.spread, row.seconds / 2), row.seconds)]
        # Room on the left for what the labels of the quickest fits say.
        axes.set_xlim(min(ends) * (min(ends) / max(ends)) ** 0.45 / 2.5, max(ends) * 2.2)
    axes.set_xlabel("time of a fit, compiled (ms)")
    axes.set_ylabel("relative error of the fit")
    axes.grid(visible=True, which="major", color="0.9", linewidth=0.6)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False, fontsize=8, loc="upper left", bbox_to_anchor=(1.0, 1.0), borderaxespad=0.0)
    _label(figure, axes, tradeoff, least)
    return figure


def _label(figure: Any, axes: Any, tradeoff: "Tradeoff", least: float) -> None:
    """Rings about default and recommendation, and below and left of each fit on the front, where nothing is, its name.

    A label that would meet one that matters more is left out.
    """
    best = tradeoff.recommended
    told = [(best, "recommended") if best is not None else (tradeoff.closest, "most accurate")]
    words: dict[Row, str] = {}
    for row, word in (*told, (tradeoff.default, "default")):
        if row is not None and np.isfinite(row.error):
            words[row] = f"{words[row]}, {word}" if row in words else word
    taken: list[Any] = []
    for row in [*words, *(row for row in tradeoff.front if row not in words)]:
        place, word = _place(row, least), words.get(row)
        if word:
            ring = {"markersize": 11, "markerfacecolor": "none", "markeredgecolor": "0.1", "markeredgewidth": 1.1}
            axes.plot(*place, "o", zorder=4, **ring)
        told_name = f"{word}: {_name(row, tradeoff)}" if word else _name(row, tradeoff)
        look: dict[str, Any] = {"fontsize": 8, "zorder": 2} if word else {"fontsize": 7, "color": "0.35", "zorder": 2}
        below = row in tradeoff.front
        look |= {"ha": "right", "va": "top"} if below else {"ha": "left", "va": "bottom"}
        offset = (-7, -5) if below else (7, 6)
        # Lines pass behind the words.
        look["bbox"] = {"facecolor": "white", "edgecolor": "none", "pad": 0.8, "alpha": 0.85}
        text = axes.annotate(told_name, place, xytext=offset, textcoords="offset points", **look)
        figure.draw_without_rendering()
        if text.get_window_extent().x1 > axes.get_window_extent().x1:
            # The legend is there.
            text.set_horizontalalignment("right")
            text.xyann = (-abs(offset[0]), offset[1])
            figure.draw_without_rendering()
        box = text.get_window_extent()
        if not word and any(box.overlaps(other) for other in taken):
            text.remove()
        else:
            taken.append(box)


def _name(row: "Row", tradeoff: "Tradeoff") -> str:
    """What of a configuration is not usual, in a few words."""
    how, default = row.configuration, tradeoff.default
    if how is None:
        return row.name
    words = ["all pixels" if how.pixels is None else f"{how.pixels} pixels"]
    words += [f"{how.samples} samples"] if how.samples is not None else []
    words += [how.precision] if how.precision != "float32" and how.solver == "separable" else []
    words += (
        [how.model]
        if default is not None and default.configuration and how.model != default.configuration.model
        else []
    )
    words += [how.solver.upper()] if how.solver != "separable" else []
    return ", ".join([*words, *([] if how.shadows else ["no shadows"])])


def _error(row: "Row") -> float:
    return row.error if np.isfinite(row.error) else row.rms


def _place(row: "Row", least: float) -> tuple[float, float]:
    return 1e3 * row.seconds, max(_error(row), least)
