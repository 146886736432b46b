"""The table and the plot of what was timed."""

from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt

from benchmarks.peers.catalogue import OTHERS, OURS, PEERS, TRF
from benchmarks.peers.problem import ACCURACY

Row = dict[str, Any]
MEASURES = {
    "seconds_to_accuracy": f"time to a worst relative error of {ACCURACY:g}",
    "seconds": "time to convergence",
}


def duration(seconds: float) -> str:
    """A time to three digits with its unit."""
    if seconds < 1:
        return f"{1e3 * seconds:.3g} ms"
    return f"{seconds:.3g} s"


def table(rows: list[Row], measure: str, sizes: list[int]) -> str:
    """One measure, peers by sizes; in parentheses passes at each size."""
    lines = [f"{MEASURES[measure]} (in passes)", f"{'':<26}" + "".join(f"{f'{size}²':>19}" for size in sizes)]
    for name in PEERS:
        own = {row["size"]: row for row in rows if row["peer"] == name and "size" in row}
        if own:
            lines.append(f"{name:<26}" + "".join(f"{_cell(own.get(size), measure):>19}" for size in sizes))
    return "\n".join(lines)


def _cell(row: Row | None, measure: str) -> str:
    if row is None:
        return ""
    if "seconds" not in row:
        return "stopped"
    if row[measure] is None or (measure == "seconds" and not row["converged"]):
        return "fails"
    return f"{duration(row[measure])} ({row[measure] / row['pass_seconds']:.3g})"


def remarks(rows: list[Row]) -> str:
    """Who is missing, who stopped and why, who failed."""
    lines = []
    for row in rows:
        if "missing" in row:
            lines.append(f"{row['peer']}: {row['missing']}")
        elif "stopped" in row:
            lines.append(f"{row['peer']}, {row['size']}²: {row['stopped']}")
        elif not row["converged"]:
            error = "not finite" if row["error"] is None else f"{row['error']:.1e}"
            lines.append(f"{row['peer']}, {row['size']}²: ends at a worst relative error of {error}; {row['says']}")
    return "\n".join(lines)


def ratios(rows: list[Row], size: int) -> str:
    """How many times faster this project is than SciPy's trf with an analytic Jacobian and than the best peer.

    Times in passes are compared, so that a change of the machine's speed between two peers touches neither.
    """
    lines = []
    for measure, title in MEASURES.items():
        passes = {
            row["peer"]: row[measure] / row["pass_seconds"]
            for row in rows
            if row.get("size") == size and row.get(measure) and row["converged"]
        }
        others = [peer.name for peer in OTHERS if peer.name in passes]
        if not others:
            continue
        best = min(others, key=passes.__getitem__)
        for ours in OURS:
            if ours.name in passes:
                told = [f"{passes[best] / passes[ours.name]:.3g} times faster than the best peer, {best}"]
                if TRF in passes:
                    told.insert(0, f"{passes[TRF] / passes[ours.name]:.3g} times faster than {TRF}")
                lines.append(f"{size}², {title}: {ours.name} is {' and '.join(told)}")
    return "\n".join(lines)


def plot(rows: list[Row], path: Path) -> None:
    """Both measures over the number of pixels, on logarithmic axes."""
    style = {"font.size": 9, "axes.spines.top": False, "axes.spines.right": False}
    with plt.rc_context(style):
        figure, panels = plt.subplots(1, 2, figsize=(10, 4.6), sharey=True, layout="constrained")
        for panel, (measure, title) in zip(panels, MEASURES.items(), strict=True):
            for name, peer in PEERS.items():
                own = [row for row in rows if row["peer"] == name and row.get(measure) and row["converged"]]
                own.sort(key=lambda row: row["size"])
                if own:
                    ours = peer in OURS
                    panel.loglog(
                        [row["size"] ** 2 for row in own],
                        [row[measure] for row in own],
                        peer.line,
                        color=peer.colour,
                        label=name,
                        linewidth=2.4 if ours else 1.2,
                        marker=peer.marker,
                        markersize=6 if ours else 4,
                    )
            units: dict[int, list[float]] = {}
            for row in rows:
                if "pass_seconds" in row:
                    units.setdefault(row["size"], []).append(row["pass_seconds"])
            middle = {size: sorted(each)[len(each) // 2] for size, each in sorted(units.items())}
            edge = [size**2 for size in middle]
            panel.loglog(edge, list(middle.values()), color="#bbbbbb", linewidth=5, zorder=0, label="one pass")
            panel.set_xticks(edge, [f"{size}²" for size in middle])
            panel.minorticks_off()
            panel.grid(color="#e5e5e5", linewidth=0.6)
            panel.set_axisbelow(True)
            panel.set_xlabel("pixels, three channels each")
            panel.set_title(title)
        panels[0].set_ylabel("seconds")
        handles, labels = panels[1].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside right center", frameon=False, fontsize=8)
        figure.savefig(path, dpi=200)
        plt.close(figure)
