"""The table of speed against accuracy: one row for each configuration, what to recommend, and how it is told."""

import csv
import dataclasses
import io
import json
from pathlib import Path
from typing import Any

import numpy as np

from brdf.files import atomic_folder, write_text
from fitting.budget.configurations import Configuration

# From so many runs on a median decides.
STEADY = 3


@dataclasses.dataclass(frozen=True)
class Row:
    """One configuration, measured.

    Attributes:
        axis: what it was tried for: "default", "pixels", "samples", ...
        configuration: in which the fit ran; None for a row of the renderer or of the checks.
        name: the configuration in words.
        compile_seconds: of tracing and compiling in the first run.
        seconds: median of the runs after the first, or the only one, without the compiler.
        spread: half the distance of their quartiles.
        runs: how many they were.
        peak: bytes of resident memory that a run took beyond what was resident before it; None where unknown.
        rms: error of the picture, root mean square over that of the reference's picture.
        worst: its largest error, in the same unit.
        parameters: error of the parameters, see `fitting.budget.deviation`.
        work: pixels times light samples, twice for float64: what the time grows with.
    """

    axis: str
    configuration: Configuration | None
    name: str
    compile_seconds: float
    seconds: float
    spread: float
    runs: int
    peak: int | None
    rms: float
    worst: float
    parameters: float
    work: float

    @property
    def error(self) -> float:
        """The larger of the errors of picture (RMS) and parameters."""
        return max(self.rms, self.parameters)


@dataclasses.dataclass(frozen=True)
class Tradeoff:
    """What was measured on a scene.

    Attributes:
        rows: in the order of the axes.
        reference: what the errors are measured against, in words.
        accuracy: the error that the recommendation keeps.
        planned: how many rows there would be, had time and patience been enough for all.
        seconds: that the measuring took.
    """

    rows: tuple[Row, ...]
    reference: str
    accuracy: float
    planned: int
    seconds: float

    @property
    def complete(self) -> bool:
        """Whether everything was measured; False where it was interrupted, or took too long."""
        return len(self.rows) == self.planned

    @property
    def default(self) -> Row | None:
        """What a plain `fitting.fit` does."""
        return next((row for row in self.rows if row.axis == "default"), None)

    @property
    def front(self) -> tuple[Row, ...]:
        """The fits than which none is both quicker and closer, quickest first."""
        found: list[Row] = []
        for row in sorted(self._fits(), key=lambda row: (row.seconds, row.error)):
            if not found or row.error < found[-1].error:
                found.append(row)
        return tuple(found)

    @property
    def recommended(self) -> Row | None:
        """The least work that keeps the accuracy; None where nothing that was measured does.

        Errors and work are the same in every run, so the machine's mood does not decide; what was measured does where
        it says that another one takes less than half the time.
        """
        good = [row for row in self._fits() if row.error <= self.accuracy]
        if not good:
            return None
        first = min(good, key=lambda row: (row.work, row.error))
        steady = [row for row in good if row.runs >= STEADY]
        quickest = min(steady, key=lambda row: row.seconds, default=first)
        clearly = quickest.seconds + quickest.spread < 0.5 * (first.seconds - first.spread)
        return quickest if clearly and first.runs >= STEADY else first

    @property
    def closest(self) -> Row | None:
        """The least error, and of errors within a tenth of it the least work; None where nothing was measured."""
        fits = self._fits()
        if not fits:
            return None
        least = min(row.error for row in fits)
        return min((row for row in fits if row.error <= 1.1 * least), key=lambda row: row.work)

    @property
    def advice(self) -> str:
        """What to use, in words; where nothing keeps the accuracy that is said, and what comes closest."""
        best, closest = self.recommended, self.closest
        if best is not None:
            words = f"recommended: {best.name} ({1e3 * best.seconds:.3g} ms, error {best.error:.1g})"
        elif closest is not None:
            words = (
                f"nothing is recommended: no configuration that was measured keeps the accuracy of {self.accuracy:g}; "
                f"the most accurate is {closest.name} ({1e3 * closest.seconds:.3g} ms, error {closest.error:.1g})"
            )
        else:
            words = "nothing is recommended: no fit was measured"
        if self.complete:
            return words
        return (
            f"{words}\n{len(self.rows)} of {self.planned} configurations were measured; more time measures the others"
        )

    def _fits(self) -> list[Row]:
        return [row for row in self.rows if row.configuration is not None and np.isfinite(row.error)]

    def marks(self, row: Row) -> str:
        """What is to be said of a row.

        Args:
            row: of the table.
        """
        best = self.recommended
        told = {"default": self.default, "recommended": best, "most accurate": self.closest if best is None else None}
        words = [word for word, one in told.items() if one is row]
        return ", ".join([*words, *(["front"] if row in self.front else [])])

    def table(self) -> Any:
        """A table for `rich.print`."""
        from rich.table import Table

        table = Table(caption=f"errors against {self.reference}", title="speed against accuracy")
        table.add_column("axis")
        table.add_column("configuration", overflow="fold")
        for name in ("compile s", "run ms", "± ms", "memory MB", "rms", "worst", "parameters"):
            table.add_column(name, justify="right")
        table.add_column("")
        for row in self.rows:
            style = "bold green" if row is self.recommended else "bold" if row is self.default else None
            memory = "" if row.peak is None else f"{row.peak / 1e6:.0f}"
            table.add_row(
                row.axis,
                row.name,
                f"{row.compile_seconds:.2f}",
                f"{1e3 * row.seconds:.1f}",
                f"{1e3 * row.spread:.1f}" if row.runs > 1 else "",
                memory,
                f"{row.rms:.1e}",
                f"{row.worst:.1e}",
                f"{row.parameters:.1e}",
                self.marks(row),
                style=style,
            )
        return table

    def __str__(self) -> str:
        """The table as text."""
        from rich.console import Console

        stream = io.StringIO()
        Console(file=stream, width=150, color_system=None, force_jupyter=False).print(self.table())
        return stream.getvalue().rstrip()

    def to_dict(self) -> dict[str, Any]:
        """As JSON holds it; what is infinite is None."""
        rows = []
        for row in self.rows:
            values = {name: _finite(value) for name, value in vars(row).items() if name != "configuration"}
            values["configuration"] = None if row.configuration is None else vars(row.configuration)
            rows.append(values | {"error": _finite(row.error), "marks": self.marks(row)})
        said = {
            name: getattr(self, name) for name in ("reference", "accuracy", "complete", "planned", "seconds", "advice")
        }
        return said | {"rows": rows}

    def to_csv(self) -> str:
        """One line for each row, a header above."""
        names = [field.name for field in dataclasses.fields(Row) if field.name != "configuration"]
        stream = io.StringIO()
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow([*names, "marks"])
        for row in self.rows:
            writer.writerow([*(getattr(row, name) for name in names), self.marks(row)])
        return stream.getvalue()

    def plot(self) -> Any:
        """Error against time, a matplotlib figure."""
        from fitting.report.tradeoff_plot import error_against_time

        return error_against_time(self)

    def save(self, folder: str | Path) -> None:
        """Write tradeoff.csv, tradeoff.json, tradeoff.png and tradeoff.pdf: all of them or none.

        Args:
            folder: made where missing.

        Raises:
            InputError: where the folder cannot be written.
        """
        with atomic_folder(folder) as stage:
            write_text(stage / "tradeoff.csv", self.to_csv())
            write_text(stage / "tradeoff.json", json.dumps(self.to_dict(), indent=2) + "\n")
            figure = self.plot()
            figure.savefig(stage / "tradeoff.png", dpi=200)
            figure.savefig(stage / "tradeoff.pdf")


def _finite(value: Any) -> Any:
    return None if isinstance(value, float) and not np.isfinite(value) else value
