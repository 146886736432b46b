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
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

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
from fitting.problem import state_problem
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
MARKS = "front: no fit is both quicker and closer; recommended: a quick one of these that keeps {:g}"
WIDTH = 100


class Row(NamedTuple):
    """One configuration, measured.

    Attributes:
        axis: what it was tried for: "default", "pixels", "samples", ...
        name: the configuration in words.
        compile_seconds: of tracing and compiling in the first run.
        seconds: of a run without the compiler: the median of those after the first, whose caches were cold.
        spread: half the distance of their quartiles; 0 of a single run.
        rms: error of the picture, root mean square over that of the reference's picture.
        parameters: error of the parameters, see `parameter_deviation`.
        error: the larger of both.
        work: about what the time grows with.
    """

    axis: str
    name: str
    compile_seconds: float
    seconds: float
    spread: float
    rms: float
    parameters: float
    error: float
    work: float

    def __str__(self) -> str:
        """The configuration, its time and its error."""
        return f"{self.name} ({_milliseconds(self.seconds)} ms, error {self.error:.1g})"


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
        for row in sorted(self.rows, key=lambda row: (row.seconds, row.error)):
            if row.error < min([one.error for one in found], default=np.inf):
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
        words = f"recommended: {self.recommended}"
        if self.recommended is None:
            words = (
                f"nothing is recommended: no configuration that was measured keeps the accuracy of {self.accuracy:g}"
            )
            words += f"; the most accurate is {self.closest}" if self.closest else ""
        if not self.complete:
            words += f"\n{len(self.rows)} of {self.planned} configurations were measured; more time measures the others"
        return words

    def marks(self, row: Row) -> str:
        """What is to be said of a row.

        Args:
            row: of the table.
        """
        best = self.recommended
        marked = {"default": self.default, "recommended": best, "most accurate": None if best else self.closest}
        words = [word for word, one in marked.items() if one == row]
        return ", ".join([*words, "front"] if row in self.front and row != best else words)

    def brief(self, row: Row) -> str:
        """The pixels of a configuration, and in what else it differs from the default.

        Args:
            row: of the table.
        """
        usual = self.default.name.split(", ") if self.default else []
        return ", ".join(word for word in row.name.split(", ") if word not in usual or word.endswith("pixels"))

    def __str__(self) -> str:
        """The table as text, its numbers and marks explained beneath."""
        table = Table(box=SIMPLE_HEAD, show_edge=False, pad_edge=False)
        for name in ("configuration", *COLUMNS, ""):
            # Too wide a table would lose digits, but for what can go on in a line below.
            table.add_column(name, justify="right" if name in COLUMNS else "left", no_wrap=bool(name))
        for row in self.rows:
            name = row.name if row.axis == "default" else self.brief(row)
            taken = " ± ".join(map(_milliseconds, filter(None, (row.seconds, row.spread))))
            errors = f"{row.rms:.1e}", f"{row.parameters:.1e}"
            table.add_row(name, f"{row.compile_seconds:.2f}", taken, *errors, self.marks(row))
        text = io.StringIO()
        Console(file=text, width=WIDTH).print(table)
        lines = [line.rstrip() for line in text.getvalue().splitlines()]
        legend = [f"{name}: {words}" for name, words in COLUMNS.items()]
        return "\n".join([*lines, *legend, MARKS.format(self.accuracy), f"errors are against {self.reference}"])

    def _finite_rows(self):
        return [row._asdict() | {"marks": self.marks(row)} for row in self.rows]

    def to_dict(self) -> dict[str, Any]:
        """As JSON holds it; what is infinite is None."""
        names = ("reference", "accuracy", "complete", "planned", "seconds", "advice")
        rows = [
            {name: None if value == np.inf else value for name, value in row.items()} for row in self._finite_rows()
        ]
        return {name: getattr(self, name) for name in names} | {"rows": rows}

    def to_csv(self) -> str:
        """One line for each row, a header above."""
        stream = io.StringIO()
        writer = csv.DictWriter(stream, (*Row._fields, "marks"), lineterminator="\n")
        writer.writeheader()
        writer.writerows(self._finite_rows())
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
            for suffix in ("png", "pdf"):
                figure.savefig(stage / f"tradeoff.{suffix}", dpi=200)


def _milliseconds(seconds: float) -> str:
    return f"{1e3 * seconds:.{0 if seconds >= 0.1 else 1}f}"


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
        mask: (H, W), or a file: pixels that count.
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
    problem = state_problem(target, scene, mask, model=model, saturation=saturation)
    trials, measure, reference = _bench(problem, accuracy)
    # Everything once, so that the errors, which decide what is recommended, are known however slow the compiler is:
    # the default, twice, for its first run tells little; what can be recommended, from little to much work; last what
    # compiles anew each time. Then rounds, each shuffled.
    ranks, random = {"default": 0, "model": 2, "solver": 3}, np.random.default_rng(0)
    by_work = sorted(trials, key=lambda one: (ranks.get(one.axis, 1), one.work))
    again = [one for one in by_work if one.axis != "solver"]
    order = [by_work[0], *by_work, *(again[i] for _ in range(ROUNDS) for i in random.permutation(len(again)))]
    with contextlib.suppress(KeyboardInterrupt), waiting("measuring") as say:
        for done, trial in enumerate(order, start=1):
            measure(trial)
            say(f"measuring, {done} of {len(order)} runs")
            if progress is not None:
                progress(done, len(order))
            if time.perf_counter() - begun > seconds:
                break
    rows = tuple(trial.row() for trial in trials if trial.taken)
    return Tradeoff(rows, reference, accuracy, len(trials), time.perf_counter() - begun)


def parameter_deviation(material: brdf.Material, best: FitResult) -> float:
    """How far the parameters of a fit are from a reference: what an estimated error is an estimate of.

    Of a coefficient: its difference over the largest of its kind in the reference, see `sizes`; of n: the difference of
    its logarithms; infinite where the models differ in their highlight. What the reference does not determine is left
    out.
    """
    size, worst = dict(zip(TERMS, sizes(best), strict=True)), 0.0
    for one in best.parameters:
        if one.value is None:
            continue
        if one.name in size:
            value = np.broadcast_to(getattr(material, one.name, 0.0), best.material.k_d.shape)
            off = abs(value[one.channel] - one.value) / size[one.name]
        else:
            off = abs(np.log(material.n / one.value)) if type(material) is type(best.material) else np.inf
        worst = max(worst, float(off))
    return worst


class Taken(NamedTuple):
    """Seconds that a run took without the compiler, and those of the compiler."""

    seconds: float
    compiling: float


class Trial(NamedTuple):
    """A configuration that is being measured: what it took, run by run, and its errors, of picture and parameters."""

    axis: str
    configuration: Configuration
    work: float
    taken: list[Taken]
    errors: list[float]

    def row(self) -> Row:
        """What was measured so far."""
        times = [one.seconds for one in self.taken[1:] or self.taken]
        low, middle, high = np.quantile(times, [0.25, 0.5, 0.75]).tolist()
        name, compiling, spread = str(self.configuration), self.taken[0].compiling, (high - low) / 2
        rms, parameters = self.errors
        error = max(self.errors)
        return Row(self.axis, name, compiling, middle, spread, rms, parameters, error, self.work)


def _bench(problem, accuracy):
    """What there is to try on a scene, the function that runs a trial once more, and what errors are against.

    The reference is fitted in float64 to all pixels, with so many light samples that they err far less than is allowed.
    """
    dear = with_enough_samples(dataclasses.replace(problem, precision="float64"), accuracy / 2)
    scene, best = problem.scenes[0], fit_pictures(dear)
    reference, most = "float64, all pixels", max(sample_counts(dear.scenes[0]), default=1)
    if most > 1:
        reference += f", {most} light samples"
    # Pictures are compared at some pixels, by their weights.
    compared, weight = dear.scenes[0], 1.0
    if sample := sample_pixels(compared, brdf.BlinnPhong, FEW_PIXELS):
        compared, weight = brdf.some_pixels(compared, sample.pixel, precision="float64"), sample.stands_for[:, None]
    picture = functools.partial(brdf.render, scene=compared, precision="float64")
    true = np.asarray(picture(best.material))

    def measure(trial) -> None:
        function = _solved if trial.axis == "solver" else _fitted
        material, took = take(functools.partial(function, problem, trial.configuration, best))
        trial.taken.append(took)
        if not trial.errors:
            change = np.asarray(picture(material)) - true
            rms = float(np.sqrt(np.mean(weight * change**2) / np.mean(weight * true**2)))
            trial.errors.extend([rms, parameter_deviation(material, best)])

    model = best.material.name if problem.model == "auto" else problem.model
    change = functools.partial(dataclasses.replace, Configuration(model))
    counts = [count for count in PIXELS if count <= WHOLE * np.prod(scene.resolution)]
    few = (counts or [None])[:2][-1]
    # The most telling first. Light samples on few pixels: what they change does not hang on how many these are.
    axes = {
        "default": [change()],
        "pixels": [change(pixels=count) for count in counts],
        "samples": [change(pixels=few, samples=count) for count in SAMPLES if count < most],
        "precision": [change(precision="float64")],
        "rounding": [change(least_squares=True)] if problem.targets[0].codes is not None else [],
        "model": [change(model="lambert", pixels=few)] if model != "lambert" else [],
        "solver": [change(precision="float64", pixels=FEW_PIXELS, solver=name) for name in SOLVERS],
    }
    if not isinstance(best.material, SpecularMaterial):
        del axes["solver"]
    slower = {"solver": SLOWER}
    trials = [
        # Where no number is named as many light samples are chosen, up to the reference's.
        Trial(axis, how, (4096 + how.work(scene if how.samples else dear.scenes[0])) * slower.get(axis, 1), [], [])
        for axis, configurations in axes.items()
        for how in configurations
    ]
    return trials, measure, reference


def _fitted(problem, how, best):
    """By the separable solver, with as many light samples as a plain fit takes where no number is named."""
    problem = dataclasses.replace(problem, model=how.model)
    return run(with_enough_samples(problem) if how.samples is None else problem, how).result.material


def _solved(problem, how, best):
    """By Levenberg-Marquardt or BFGS on a few pixels, from a guess."""
    from fitting.joint import fit_jointly

    # They leave out what the reference left out, such as pixels whose noise is cut off.
    target, scene, mask = problem.targets[0].pixels, problem.scenes[0], best.counted[0]
    # Evenly spread: these solvers know no weights.
    if sample := sample_pixels(scene, brdf.Lambert, FEW_PIXELS):
        target, mask = sample.of(target), sample.of(mask)
        scene = brdf.some_pixels(scene, sample.pixel, precision="float64")
    names = (*TERMS[scene.ambient is None :], "n")
    half: dict[str, Any] = dict.fromkeys(TERMS, np.full(best.material.k_d.shape, 0.5))
    start = brdf.MODELS[how.model](**half, n=START)  # pyright: ignore[reportCallIssue]
    options: dict[str, Any] = {"solver": how.solver, "tolerance": TOLERANCE, "saturation": problem.saturation}
    freed = fit_jointly(
        target, scene, start, lambda one, _: [getattr(one, name) for name in names], mask=mask, **options
    )
    return freed.material


def take(run: Callable[[], Any]) -> tuple[Any, Taken]:
    """Run something: what it returned, and what it took."""
    spans: list[tuple[float, float]] = []

    def listen(event: str, duration_secs: float, **_) -> None:
        if event.startswith("/jax/core/compile/"):
            now = time.perf_counter()
            spans.append((now - duration_secs, now))

    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        start = time.perf_counter()
        outcome = run()
        seconds = time.perf_counter() - start
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)
    # Spans of tracing, lowering and compiling lie within each other.
    compiling, end = 0.0, 0.0
    for begin, stop in sorted(spans):
        compiling, end = compiling + max(stop - max(begin, end), 0.0), max(end, stop)
    return outcome, Taken(max(seconds - compiling, 0.0), compiling)
