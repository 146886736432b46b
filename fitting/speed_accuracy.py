"""Speed against accuracy, measured on the user's own scene.

Only what the scene has is varied: pixels where there are enough of them, light samples where a light has an extent,
least squares in place of the likelihood where the picture holds codes. A check has nothing to choose: its albedo is
closed, and of a BRDF without a closed one the adaptive rule tells its own error.

Fewer pixels are a stratified subsample, not a level of the picture's pyramid: averaged pixels blur a highlight, which
the fit takes for a smaller exponent.

Each configuration runs once with cold caches, once warm, and then in rounds, every round in another order (fixed seed),
so that a machine that grows slower or quicker favours none. The compiler's time is taken out of every run. What
compiles anew each time runs once.
"""

import contextlib
import csv
import dataclasses
import functools
import io
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax.monitoring
import numpy as np

import brdf
from brdf.checks import positive
from brdf.files import atomic_folder, write_text
from brdf.models.base import SpecularMaterial
from fitting.budget.configurations import Configuration, run
from fitting.budget.error_estimate import sizes
from fitting.budget.escalation import WHOLE
from fitting.budget.light_samples import with_enough_samples
from fitting.budget.sampling import sample_counts, sample_pixels
from fitting.core import fit_pictures
from fitting.problem import FitProblem, state_problem
from fitting.progress import waiting
from fitting.result import FitResult
from fitting.uncertainty.covariance import TERMS

PIXELS, SAMPLES = (1024, 8192, 65536, 524288), (4, 16, 64, 256, 1024)
# Of pictures that are compared, and of solvers that keep a Jacobian.
FEW_PIXELS = 1024
# The general solvers, the exponent where they start, the relative change at which they stop, and how slow they may be.
SOLVERS = ("lm", "bfgs")
START, TOLERANCE, SLOWER = 30.0, 1e-8, 100
ROUNDS = 6
# Among fits whose times are within this factor the least work is recommended, which is the same on every machine.
CLEARLY = 2.0
# The numbers of the printed table, and what its reader is told of them and of the marks.
COLUMNS = {
    "compile s": "tracing and compiling, in the first run only",
    "run ms": "a fit without that: median of its runs ± half the distance of their quartiles",
    "picture": "error of the picture that the fit draws, root mean square, relative",
    "parameters": "largest relative error of n and of the coefficients; inf: of another model",
}
# Of a row, in files.
TOLD: tuple[str, ...] = (
    "axis",
    "name",
    "compile_seconds",
    "seconds",
    "spread",
    "runs",
    "rms",
    "parameters",
    "error",
    "work",
)
MARKS = "front: no fit is both quicker and closer; recommended: a quick one of these that keeps {:g}"


class Taken(NamedTuple):
    """Seconds that a run took without the compiler, and those of the compiler."""

    seconds: float
    compiling: float


@dataclasses.dataclass(eq=False)
class Row:
    """One configuration, measured.

    Attributes:
        axis: what it was tried for: "default", "pixels", "samples", ...
        configuration: in which the fit ran.
        work: about what the time grows with.
        taken: by the runs so far.
        rms: error of the picture, root mean square over that of the reference's picture.
        parameters: error of the parameters, see `parameter_deviation`.
    """

    axis: str
    configuration: Configuration
    work: float
    taken: list[Taken] = dataclasses.field(default_factory=list)
    rms: float = np.inf
    parameters: float = np.inf

    @property
    def name(self) -> str:
        """The configuration in words."""
        return str(self.configuration)

    @property
    def compile_seconds(self) -> float:
        """Of tracing and compiling in the first run."""
        return self.taken[0].compiling

    @property
    def times(self) -> list[float]:
        """Seconds without the compiler of the runs after the first, whose caches were cold, or of the only one."""
        return [one.seconds for one in self.taken[1:] or self.taken]

    @property
    def runs(self) -> int:
        """How many they are."""
        return len(self.times)

    @property
    def seconds(self) -> float:
        """Their median."""
        return float(np.median(self.times))

    @property
    def spread(self) -> float:
        """Half the distance of their quartiles."""
        return float(np.subtract(*np.quantile(self.times, [0.75, 0.25]))) / 2

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

    Example:
        >>> target, scene = brdf.read_image("target.exr"), brdf.Scene.load("scene.toml")
        >>> table = fitting.tradeoff(target, scene, seconds=0.1)
        >>> table.accuracy, table.complete
        (0.001, False)
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
        for row in sorted(
            filter(lambda row: np.isfinite(row.error), self.rows), key=lambda row: (row.seconds, row.error)
        ):
            if not found or row.error < found[-1].error:
                found.append(row)
        return tuple(found)

    @property
    def recommended(self) -> Row | None:
        """Of the fits on the front that keep the accuracy, the quickest, or one as quick that is less work.

        None where nothing that was measured keeps it.
        """
        good = [row for row in self.front if row.error <= self.accuracy]
        quick = (row for row in good if row.seconds <= CLEARLY * good[0].seconds)
        return min(quick, key=lambda row: (row.work, row.error), default=None)

    @property
    def closest(self) -> Row | None:
        """The least error; None where nothing was measured."""
        return self.front[-1] if self.front else None

    @property
    def advice(self) -> str:
        """What to use, in words; where nothing keeps the accuracy that is said, and what comes closest."""
        best, closest = self.recommended, self.closest
        words = f"nothing is recommended: no configuration that was measured keeps the accuracy of {self.accuracy:g}"
        if best is not None:
            words = f"recommended: {_result(best)}"
        elif closest is not None:
            words += f"; the most accurate is {_result(closest)}"
        if self.complete:
            return words
        measured = f"{len(self.rows)} of {self.planned} configurations were measured"
        return f"{words}\n{measured}; more time measures the others"

    def marks(self, row: Row) -> str:
        """What is to be said of a row.

        Args:
            row: of the table.
        """
        best = self.recommended
        marked = {"default": self.default, "recommended": best, "most accurate": None if best else self.closest}
        words = [word for word, one in marked.items() if one is row]
        return ", ".join([*words, "front"] if row in self.front and row is not best else words)

    def brief(self, row: Row) -> str:
        """The pixels of a configuration, and in what else it differs from the default.

        Args:
            row: of the table.
        """
        usual = [] if self.default is None else self.default.name.split(", ")
        return ", ".join(word for word in row.name.split(", ") if word not in usual or word.endswith("pixels"))

    def __str__(self) -> str:
        """The table as text, its numbers and marks explained beneath."""
        lines = [("configuration", *COLUMNS, "")]
        for row in self.rows:
            name = row.name if row is self.default else self.brief(row)
            times = [row.seconds, row.spread] if row.runs > 1 else [row.seconds]
            numbers = f"{row.compile_seconds:.2f}", " ± ".join(map(_milliseconds, times))
            lines.append((name, *numbers, f"{row.rms:.1e}", f"{row.parameters:.1e}", self.marks(row)))
        first, *widths, _ = (max(map(len, column)) for column in zip(*lines, strict=True))
        text = []
        for name, *numbers, marks in lines:
            cells = [f"{number:>{width}}" for number, width in zip(numbers, widths, strict=True)]
            text.append("  ".join([f"{name:<{first}}", *cells, marks]).rstrip())
        text.insert(1, "─" * max(map(len, text)))
        told = [f"{name}: {words}" for name, words in COLUMNS.items()]
        return "\n".join([*text, *told, MARKS.format(self.accuracy), f"errors are against {self.reference}"])

    def _told(self, row: Row) -> dict[str, Any]:
        return {name: getattr(row, name) for name in TOLD} | {"marks": self.marks(row)}

    def to_dict(self) -> dict[str, Any]:
        """As JSON holds it; what is infinite is None."""
        names = ("reference", "accuracy", "complete", "planned", "seconds", "advice")
        rows = [self._told(row) | {"configuration": vars(row.configuration)} for row in self.rows]
        finite = [{name: None if value == np.inf else value for name, value in row.items()} for row in rows]
        return {name: getattr(self, name) for name in names} | {"rows": finite}

    def to_csv(self) -> str:
        """One line for each row, a header above."""
        stream = io.StringIO()
        writer = csv.DictWriter(stream, (*TOLD, "marks"), lineterminator="\n")
        writer.writeheader()
        writer.writerows(map(self._told, self.rows))
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


def _milliseconds(seconds: float) -> str:
    return f"{1e3 * seconds:.{0 if seconds >= 0.1 else 1}f}"


def _result(row: Row) -> str:
    return f"{row.name} ({_milliseconds(row.seconds)} ms, error {row.error:.1g})"


def tradeoff(
    target: Any,
    scene: brdf.Scene,
    *,
    model: str = "blinn-phong",
    mask: Any = None,
    saturation: float | None = None,
    accuracy: float = 1e-3,
    seconds: float = 15.0,
    progress: Callable[[int, int], None] | None = None,
) -> Tradeoff:
    """Measure what the choices that a scene offers cost, and what error they make.

    Args:
        target: linear values, (H, W, C) or (H, W), or a `brdf.Picture`.
        scene: what the picture shows.
        model: the name of a model, or "auto".
        mask: (H, W), pixels that count.
        saturation: see `fitting.fit`.
        accuracy: relative error that the recommendation is to keep.
        seconds: that the measuring may take: no new run begins after them. A running one is waited for.
        progress: called with the number of runs done and that of all.

    Returns:
        The table. Ctrl-C ends the measuring and keeps what was measured.

    Raises:
        InputError: where target, scene or a number cannot be used.

    Example:
        >>> target, scene = brdf.read_image("target.exr"), brdf.Scene.load("scene.toml")
        >>> table = fitting.tradeoff(target, scene, accuracy=1e-2, seconds=0.1)  # a first glance; 15 s tell more
        >>> table.reference
        'float64, all pixels'
    """
    begun = time.perf_counter()
    positive("accuracy", accuracy)
    positive("seconds", seconds)
    bench = Bench(state_problem(target, scene, mask, model=model, saturation=saturation), accuracy)
    rows = bench.rows()
    # Everything once, so that the errors, which decide what is recommended, are known however slow the compiler is:
    # the default, twice, for its first run tells little; what can be recommended, from little to much work, so that
    # what would take too long is known before; last what compiles anew each time. Then rounds, each shuffled.
    ranks, random = {"default": 0, "model": 2, "solver": 3}, np.random.default_rng(0)
    by_work = sorted(rows, key=lambda row: (ranks.get(row.axis, 1), row.work))
    again = [row for row in by_work if row.axis != "solver"]
    order = [by_work[0], *by_work, *(again[i] for _ in range(ROUNDS) for i in random.permutation(len(again)))]
    with contextlib.suppress(KeyboardInterrupt), waiting("measuring") as say:
        for done, row in enumerate(order, start=1):
            known, expected = [one for one in rows if one.taken], 0.0
            if row.taken:
                expected = row.taken[-1].seconds
            elif known:
                # By the fit of the most work so far, and by the compiler.
                most = max(known, key=lambda one: one.work)
                expected = most.taken[-1].seconds * row.work / most.work + max(one.compile_seconds for one in known)
            if time.perf_counter() - begun + expected > seconds and known:
                continue
            bench.measure(row)
            say(f"measuring, {done} of {len(order)} runs")
            if progress is not None:
                progress(done, len(order))
    measured = tuple(row for row in rows if row.taken)
    return Tradeoff(measured, bench.reference, accuracy, len(rows), time.perf_counter() - begun)


def parameter_deviation(material: brdf.Material, best: FitResult) -> float:
    """How far the parameters of a fit are from a reference: what an estimated error is an estimate of.

    Of a coefficient: its difference over the largest of its kind in the reference, see `sizes`; of n: the difference of
    its logarithms; infinite where the models differ in their highlight. What the reference does not determine is left
    out.
    """
    size: dict[str, float] = dict(zip(TERMS, sizes(best), strict=True))
    worst = 0.0
    for one in best.parameters:
        if one.value is None:
            continue
        value = np.asarray(getattr(material, one.name, np.zeros(best.material.k_d.shape)))
        if one.name != "n":
            off = abs(float(value[one.channel]) - one.value) / size[one.name]
        elif type(material) is type(best.material):
            off = abs(float(np.log(value / one.value)))
        else:
            off = np.inf
        worst = max(worst, off)
    return worst


class Bench:
    """The configurations that a scene offers, and the measure of their errors."""

    def __init__(self, problem: FitProblem, accuracy: float):
        """Fit the reference: in float64, all pixels, so many light samples that they err far less than is allowed."""
        dear = with_enough_samples(dataclasses.replace(problem, precision="float64"), accuracy / 2)
        self.problem, self.scene, self.best = problem, problem.scenes[0], fit_pictures(dear)
        self.model = self.best.material.name if problem.model == "auto" else problem.model
        self.reference, self.samples = "float64, all pixels", max(sample_counts(dear.scenes[0]), default=1)
        if self.samples > 1:
            self.reference += f", {self.samples} light samples"
        # Pictures are compared at some pixels, by their weights.
        compared, weight = dear.scenes[0], 1.0
        if sample := sample_pixels(compared, brdf.BlinnPhong, FEW_PIXELS):
            compared, weight = brdf.some_pixels(compared, sample.pixel, precision="float64"), sample.stands_for[:, None]
        self.picture, self.weight = functools.partial(brdf.render, scene=compared, precision="float64"), weight

    def rows(self) -> list[Row]:
        """What there is to try, and what for, the most telling first."""
        default, found = Configuration(self.model), list[tuple[str, Configuration]]()
        change = functools.partial(dataclasses.replace, default)
        sizes = [size for size in PIXELS if size <= WHOLE * np.prod(self.scene.resolution)]
        few = (sizes or [None])[:2][-1]
        found += [("default", default), *(("pixels", change(pixels=size)) for size in sizes)]
        # On few pixels: what samples change does not hang on how many these are.
        found += [("samples", change(pixels=few, samples=count)) for count in SAMPLES if count < self.samples]
        found += [("precision", change(precision="float64"))]
        if self.problem.targets[0].codes is not None:
            found += [("rounding", change(least_squares=True))]
        found += [("model", change(model="lambert", pixels=few))] if self.model != "lambert" else []
        if isinstance(self.best.material, SpecularMaterial):
            solvers = (change(precision="float64", pixels=FEW_PIXELS, solver=name) for name in SOLVERS)
            found += [("solver", how) for how in solvers]
        return [
            Row(axis, how, (4096 + how.work(self.scene)) * (SLOWER if axis == "solver" else 1)) for axis, how in found
        ]

    def measure(self, row: Row) -> None:
        """Run a configuration once more; of the first run also the error is told."""
        first = not row.taken
        material, took = take(functools.partial(self.solve if row.axis == "solver" else self.fit, row.configuration))
        row.taken.append(took)
        if first:
            true = np.asarray(self.picture(self.best.material))
            change = np.asarray(self.picture(material)) - true
            row.rms = float(np.sqrt(np.mean(self.weight * change**2) / np.mean(self.weight * true**2)))
            row.parameters = parameter_deviation(material, self.best)

    def fit(self, how: Configuration) -> brdf.Material:
        """By the separable solver, with as many light samples as a plain fit takes where no number is named."""
        problem = dataclasses.replace(self.problem, model=how.model)
        return run(with_enough_samples(problem) if how.samples is None else problem, how).result.material

    def solve(self, how: Configuration) -> brdf.Material:
        """By Levenberg-Marquardt or BFGS on a few pixels, from a guess."""
        from fitting.joint import fit_jointly

        # They leave out what the reference left out, such as pixels whose noise is cut off.
        target, scene, mask = self.problem.targets[0].pixels, self.scene, self.best.counted[0]
        # Evenly spread: these solvers know no weights.
        if sample := sample_pixels(scene, brdf.Lambert, FEW_PIXELS):
            target, mask = sample.of(target), sample.of(mask)
            scene = brdf.some_pixels(scene, sample.pixel, precision="float64")
        half = np.full(self.best.material.k_d.shape, 0.5)
        names = (*TERMS[scene.ambient is None :], "n")
        start = brdf.MODELS[self.model](k_a=half, k_d=half, k_s=half, n=START)  # pyright: ignore[reportCallIssue]
        return fit_jointly(
            target,
            scene,
            start,
            lambda material, scenes: [getattr(material, name) for name in names],
            solver=how.solver,  # pyright: ignore[reportArgumentType]
            tolerance=TOLERANCE,
            mask=mask,
            saturation=self.problem.saturation,
        ).material


def take(run: Callable[[], Any]) -> tuple[Any, Taken]:
    """Run something: what it returned, and what it took."""
    spans: list[tuple[float, float]] = []

    def listen(event: str, duration_secs: float, **_: Any) -> None:
        if event.startswith("/jax/core/compile/"):
            now = time.perf_counter()
            # Spans of tracing, lowering and compiling lie within each other, and the inner ones end first.
            while spans and spans[-1][0] >= now - duration_secs:
                spans.pop()
            spans.append((now - duration_secs, now))

    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        start = time.perf_counter()
        outcome = run()
        seconds = time.perf_counter() - start
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)
    compiling = sum(end - begin for begin, end in spans)
    return outcome, Taken(max(seconds - compiling, 0.0), compiling)
