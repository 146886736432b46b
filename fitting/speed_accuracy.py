"""Speed against accuracy, measured on the user's own scene.

Only what the scene has is varied: pixels where there are enough of them, light samples where a light has an extent,
least squares in place of the likelihood where the picture holds codes. A check has nothing to choose: its albedo is
closed, and of a BRDF without a closed one the adaptive rule tells its own error.

Fewer pixels are a stratified subsample, not a level of the picture's pyramid: averaged pixels blur a highlight, which
the fit takes for a smaller exponent.

Each configuration runs once with cold caches, once warm, and then in rounds, every round in another order (fixed seed),
so that a machine that grows slower or quicker favours none. The compiler's time is taken out of every run. What takes
long runs twice, what compiles anew each time once.
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
from typing import Any, NamedTuple, get_args

import jax.monitoring
import numpy as np

import brdf
from brdf.files import atomic_folder, write_text
from brdf.models.base import SpecularMaterial
from brdf.precision import Precision
from fitting.budget.configurations import MOST_SAMPLES, Configuration, run, sample_counts, some_of
from fitting.budget.error_estimate import SMALLEST
from fitting.budget.escalation import WHOLE, check_above_zero, near
from fitting.budget.sampling import MadeLights, sample_pixels, with_samples
from fitting.problem import FitProblem, state_problem
from fitting.progress import waiting
from fitting.result import FitResult
from fitting.uncertainty.covariance import TERMS

PIXELS, SAMPLES = (1024, 8192, 65536, 524288), (4, 16, 64, 256, 1024)
# Of the reference under lights with an extent, of pictures that are compared there, of solvers that keep a Jacobian.
FEW_PIXELS = 1024
# Light samples of the fit of all pixels that the reference starts from.
START_SAMPLES = 64
# Where the general solvers start, which they are, and the relative changes at which they stop.
START = 30.0
SOLVERS = ("lm", 1e-8), ("bfgs", 1e-8)
MOST_ROUNDS = 5
# As wide as the printed table may be, and as the command prints it into a pipe.
WIDTH = 100
# What takes longer than this is run twice.
LONG = 1.0
# Axes that are told for comparison: their fits leave something out of the picture.
BESIDE = ("model", "render")
# Among fits whose times are within this factor the least work is recommended, which is the same on every machine.
CLEARLY = 2.0
# The numbers of the printed table, and what its reader is told of them and of the marks.
COLUMNS = {
    "compile s": "tracing and compiling, in the first run only",
    "run ms": "a fit without that: median of its runs ± half the distance of their quartiles",
    "picture": "error of the picture that the fit draws, root mean square, relative",
    "parameters": "largest relative error of n and of the coefficients; inf: of another model",
}
MARKS = "front: no fit is both quicker and closer; recommended: a quick one of these that keeps {accuracy:g}"


@dataclasses.dataclass(frozen=True)
class Row:
    """One configuration, measured.

    Attributes:
        axis: what it was tried for: "default", "pixels", "samples", ...
        configuration: in which the fit ran; None for a row of the renderer.
        name: the configuration in words.
        compile_seconds: of tracing and compiling in the first run.
        seconds: median of the runs after the first, or the only one, without the compiler.
        spread: half the distance of their quartiles.
        runs: how many they were.
        rms: error of the picture, root mean square over that of the reference's picture.
        worst: its largest error, in the same unit.
        parameters: error of the parameters, see `parameter_deviation`.
        work: pixels times light samples, twice for float64: what the time grows with.
    """

    axis: str
    configuration: Configuration | None
    name: str
    compile_seconds: float
    seconds: float
    spread: float
    runs: int
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
        fits = [row for row in self.rows if row.configuration is not None and np.isfinite(row.error)]
        found: list[Row] = []
        for row in sorted(fits, key=lambda row: (row.seconds, row.error)):
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
        if best is not None:
            words = f"recommended: {best.name} ({_milliseconds(best.seconds)} ms, error {best.error:.1g})"
        elif closest is not None:
            words = (
                f"nothing is recommended: no configuration that was measured keeps the accuracy of {self.accuracy:g}; "
                f"the most accurate is {closest.name} ({_milliseconds(closest.seconds)} ms, error {closest.error:.1g})"
            )
        else:
            words = "nothing is recommended: no fit was measured"
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
        marked["front"] = row if row in self.front else None
        return ", ".join(word for word, one in marked.items() if one is row)

    def brief(self, row: Row) -> str:
        """The pixels of a configuration, and in what else it differs from the default.

        Args:
            row: of the table.
        """
        usual = [] if self.default is None else self.default.name.split(", ")
        return ", ".join(word for word in row.name.split(", ") if word not in usual or word.endswith("pixels"))

    def table(self) -> Any:
        """A table for `rich.print`; the rest that a row holds is in `to_csv`."""
        from rich.box import SIMPLE_HEAD
        from rich.table import Column, Table

        told = [*(f"{name}: {words}" for name, words in COLUMNS.items()), MARKS.format(accuracy=self.accuracy)]
        caption = "\n".join([*told, f"errors are against {self.reference}"])
        head = Column("configuration", overflow="fold"), *(Column(name, justify="right") for name in COLUMNS), ""
        table = Table(
            *head, box=SIMPLE_HEAD, padding=(0, 1, 0, 0), show_edge=False, caption=caption, caption_justify="left"
        )
        for row in self.rows:
            name = row.name if row is self.default else self.brief(row)
            times = [row.seconds, row.spread] if row.runs > 1 else [row.seconds]
            run = " ± ".join(map(_milliseconds, times))
            numbers = f"{row.compile_seconds:.2f}", run, f"{row.rms:.1e}", f"{row.parameters:.1e}"
            style = "bold green" if row is self.recommended else "bold" if row is self.default else None
            table.add_row(name, *numbers, self.marks(row).replace("recommended, front", "recommended"), style=style)
        return table

    def __str__(self) -> str:
        """The table as text."""
        from rich.console import Console

        stream = io.StringIO()
        Console(file=stream, width=WIDTH, color_system=None, force_jupyter=False).print(self.table())
        return stream.getvalue().rstrip()

    def to_dict(self) -> dict[str, Any]:
        """As JSON holds it; what is infinite is None."""
        rows = [dataclasses.asdict(row) | {"error": row.error, "marks": self.marks(row)} for row in self.rows]
        for row in rows:
            row |= {name: None for name, value in row.items() if value == np.inf}
        names = ("reference", "accuracy", "complete", "planned", "seconds", "advice")
        return {name: getattr(self, name) for name in names} | {"rows": rows}

    def to_csv(self) -> str:
        """One line for each row, a header above."""
        rows = [vars(row) | {"marks": self.marks(row)} for row in self.rows]
        names = [name for name in (*Row.__dataclass_fields__, "marks") if name != "configuration"]
        stream = io.StringIO()
        writer = csv.DictWriter(stream, names, extrasaction="ignore", lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
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


def tradeoff(
    target: Any,
    scene: brdf.Scene,
    *,
    model: str = "blinn-phong",
    mask: Any = None,
    saturation: float | None = None,
    accuracy: float = 1e-3,
    seconds: float = 15.0,
    render: bool = False,
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
        render: also measure the renderer alone.
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
    check_above_zero(accuracy=accuracy, seconds=seconds)
    bench = Bench(state_problem(target, scene, mask, model=model, saturation=saturation))
    trials = bench.trials(render=render)
    # Everything once, so that the errors, which decide what is recommended, are known however slow the compiler is:
    # the default, twice, for its first run tells little; what can be recommended, from little to much work, so that
    # what would take too long is known before; last what compiles anew each time. Then rounds, each shuffled.
    ranks = {"default": 0, "solver": 3} | dict.fromkeys(BESIDE, 2)
    by_work = sorted(trials, key=lambda trial: (ranks.get(trial.axis, 1), trial.work))
    random = np.random.default_rng(0)
    order = [
        by_work[0],
        *by_work,
        *(by_work[i] for _ in range(MOST_ROUNDS + 1) for i in random.permutation(len(by_work))),
    ]
    known: list[Trial] = []
    with contextlib.suppress(KeyboardInterrupt), waiting("measuring") as say:
        for done, trial in enumerate(order, start=1):
            once = trial.axis == "solver"
            left = seconds - (time.perf_counter() - begun)
            long = LONG if len(trial.taken) > 1 else np.inf
            if trial.taken and (once or trial.taken[-1].seconds > min(long, left)):
                continue
            expected = 0.0
            if known and trial.axis != "render":
                # What a fit may take is told by the one of the most work so far, and of a first by the compiler too.
                most = max(known, key=lambda trial: trial.work)
                compiler = 0.0 if trial.taken else max(trial.taken[0].compiling for trial in known)
                expected = most.taken[-1].seconds * trial.work / most.work + compiler
            if left < expected:
                continue
            outcome, one = take(functools.partial(bench.run, trial))
            if not trial.taken:
                trial.outcome = outcome
                known.append(trial)
            trial.taken.append(one)
            say(f"measuring, {done} of {len(order)} runs")
            if progress is not None:
                progress(done, len(order))
    rows = [bench.row(trial) for trial in trials if trial.taken]
    return Tradeoff(tuple(rows), bench.reference, accuracy, len(trials), time.perf_counter() - begun)


class Taken(NamedTuple):
    """Seconds that a run took without the compiler, and those of the compiler."""

    seconds: float
    compiling: float


@dataclasses.dataclass(eq=False)
class Trial:
    """A configuration to be measured.

    Attributes:
        axis: what it is tried for.
        how: the configuration.
        work: what the time grows with, and what every fit takes whatever its size.
        taken: by the runs so far.
        outcome: of the first: a material, or a picture.
    """

    axis: str
    how: Configuration
    work: float
    taken: list[Taken] = dataclasses.field(default_factory=list)
    outcome: Any = None


def reference(problem: FitProblem, lights: MadeLights, pixels: int | None = None) -> FitResult:
    """Fit as well as can be: in float64, all pixels, as many light samples as can be paid for.

    Under lights with an extent all pixels are fitted with a few samples, and what `MOST_SAMPLES` change is taken from
    some of the pixels. Both fits of these see the same noise, which is not in their difference.

    Args:
        problem: one picture.
        lights: made so far.
        pixels: how many under many light samples; None for all.
    """
    if not any(sample_counts(problem.scenes)):
        return run(problem, Configuration(problem.model, "float64"), lights).result
    few = Configuration(problem.model, "float32", None, START_SAMPLES)
    whole = run(problem, few, lights).result
    about, kind = near(whole, 0.0, problem.n_range), type(whole.material)
    few = dataclasses.replace(few, model=kind.name, pixels=pixels)
    fine = run(problem, dataclasses.replace(few, samples=MOST_SAMPLES), lights, about).result
    if pixels is None:
        return fine
    coarse = run(problem, few, lights, about).result
    values = {}
    for name in {parameter.name for parameter in whole.parameters}:
        value, before, after = (np.asarray(getattr(one.material, name)) for one in (whole, coarse, fine))
        changed = value * after / np.where(before > 0, before, 1.0) if name == "n" else value + after - before
        # What is not determined is 0 in the material.
        values[name] = np.where((value > 0) & (before > 0), np.maximum(changed, 0.0), value)
    return dataclasses.replace(whole, material=kind(**values))


def parameter_deviation(material: brdf.Material, best: FitResult) -> float:
    """How far the parameters of a fit are from a reference: what an estimated error is an estimate of.

    Of a coefficient: its difference over the largest channel of its kind in the reference (or over `SMALLEST` of its
    largest coefficient, if that is more); of n: the difference of its logarithms; infinite where the models differ in
    their highlight. What the reference does not determine is left out.
    """
    names = [name for name in TERMS if hasattr(best.material, name)]
    largest = {name: float(np.max(getattr(best.material, name))) for name in names}
    least = max(SMALLEST * max(largest.values()), np.finfo(float).tiny)
    worst = 0.0
    for parameter in best.parameters:
        name = parameter.name
        if parameter.value is None or (name == "n" and not largest["k_s"]):
            continue
        value, true = np.asarray(getattr(material, name, 0.0)), np.asarray(getattr(best.material, name))
        if name == "n":
            comparable = type(material) is type(best.material) and value > 0
            worst = max(worst, abs(float(np.log(value / true))) if comparable else np.inf)
        else:
            off = np.abs(value - true)[parameter.channel]
            worst = max(worst, float(off) / max(largest[name], least))
    return worst


class Bench:
    """The configurations that a scene offers, and the measure of their errors."""

    def __init__(self, problem: FitProblem):
        """Fit the reference."""
        self.problem, self.scene = problem, problem.scenes[0]
        self.lights: MadeLights = {}
        scene, self.pixels = self.scene, int(np.prod(self.scene.resolution))
        self.samples = max(filter(None, sample_counts([scene])), default=0)
        self.reference, pixels = "float64, all pixels", None
        # Where pictures are compared: the whole one, or some pixels under many light samples; and their weights.
        self.compared, self.weight = with_samples(scene, MOST_SAMPLES, self.lights), 1.0
        if self.samples:
            self.reference = f"{MOST_SAMPLES} light samples, all pixels"
            if self.pixels > 2 * FEW_PIXELS:
                pixels = FEW_PIXELS
                self.reference += f" (what so many samples change, told by about {2 * pixels} of the pixels)"
            if sample := sample_pixels(self.compared, brdf.BlinnPhong, FEW_PIXELS):
                self.compared = brdf.some_pixels(self.compared, sample.pixel, precision="float64")
                self.weight = sample.stands_for[None, :, None]
        self.best = reference(problem, self.lights, pixels)
        self.model = self.best.material.name if problem.model == "auto" else problem.model

    def trials(self, *, render: bool = False) -> list[Trial]:
        """What there is to try, and what for, the most telling first."""
        default, samples = Configuration(self.model), self.samples
        change = functools.partial(dataclasses.replace, default)
        sizes = [size for size in PIXELS if size <= WHOLE * self.pixels]
        few = (sizes or [None])[:2][-1]
        found = [("default", default), *(("pixels", change(pixels=size)) for size in sizes)]
        # Many samples are tried on few pixels: what they change does not hang on how many.
        steps = [count for count in SAMPLES if count <= 4 * samples and count != samples]
        found += [("samples", change(pixels=few, samples=count)) for count in steps]
        found += [("samples", change(samples=16))] if samples > 16 else []
        found += [("precision", change(precision="float64"))]
        if self.problem.targets[0].codes is not None:
            found += [("rounding", change(least_squares=True))]
        found += [("model", change(model="lambert", pixels=few))] if self.model != "lambert" else []
        if isinstance(self.best.material, SpecularMaterial):
            solver = functools.partial(change, precision="float64", pixels=FEW_PIXELS)
            found += [("solver", solver(solver=name, tolerance=tolerance)) for name, tolerance in SOLVERS]
        if render:
            counts = [None, *(count for count in steps if count < min(samples, 1024))]
            found += [("render", change(precision=p, samples=n)) for p in get_args(Precision) for n in counts]
        return [Trial(axis, how, self._work(axis, how)) for axis, how in dict.fromkeys(found)]

    def _work(self, axis: str, how: Configuration) -> float:
        return (4096 + how.work(self.pixels, [self.scene])) * (100 if axis == "solver" else 1)

    def run(self, trial: Trial) -> Any:
        """What a trial gives: a material, or a picture."""
        how = trial.how
        if trial.axis == "solver":
            return self.solve(how)
        if trial.axis == "render":
            scene = with_samples(self.scene, how.samples, self.lights)
            return np.asarray(brdf.render(self.best.material, scene, precision=how.precision))
        return run(self.problem, how, self.lights).result.material

    def solve(self, how: Configuration) -> brdf.Material:
        """Levenberg-Marquardt or BFGS on a few pixels, from a guess."""
        from fitting.joint import fit_jointly

        # Evenly spread: these solvers know no weights.
        sample = sample_pixels(self.scene, brdf.Lambert, FEW_PIXELS)
        # They leave out what the reference left out, such as pixels whose noise is cut off.
        target, scene, mask = self.problem.targets[0].pixels, self.scene, self.best.counted[0]
        if sample:
            target, mask = some_of(target, sample), some_of(mask, sample)
            scene = brdf.some_pixels(scene, sample.pixel, precision="float64")
        half = np.full(self.best.material.k_d.shape, 0.5)
        start = brdf.MODELS[self.model](k_a=half, k_d=half, k_s=half, n=START)  # pyright: ignore[reportCallIssue]
        names = ("k_d", "k_s", "n") if scene.ambient is None else ("k_a", "k_d", "k_s", "n")
        return fit_jointly(
            target,
            scene,
            start,
            lambda material, scenes: [getattr(material, name) for name in names],
            solver=how.solver,  # pyright: ignore[reportArgumentType]
            tolerance=how.tolerance or 1e-8,
            mask=mask,
            saturation=self.problem.saturation,
        ).material

    def row(self, trial: Trial) -> Row:
        """What was measured: of several runs the first is left out, for caches were cold."""
        how, taken, outcome, render = trial.how, trial.taken, trial.outcome, trial.axis == "render"
        # Rendered whole, under at most the scene's own samples.
        scene, weight = (self.scene, 1.0) if render else (self.compared, self.weight)
        picture = functools.partial(brdf.render, scene=scene, precision="float64")
        name, parameters = str(how), 0.0
        if render:
            name = ", ".join(["render", how.precision, *([f"{how.samples} light samples"] if how.samples else [])])
        else:
            parameters, outcome = parameter_deviation(outcome, self.best), np.asarray(picture(outcome))
        true = np.asarray(picture(self.best.material))
        change, scale = outcome - true, float(np.sqrt(np.mean(weight * true**2)))
        later = [one.seconds for one in taken[1:] or taken]
        low, median, high = np.quantile(later, [0.25, 0.5, 0.75])
        return Row(
            axis=trial.axis,
            configuration=None if render else how,
            name=name,
            compile_seconds=taken[0].compiling,
            seconds=float(median),
            spread=float(high - low) / 2,
            runs=len(later),
            rms=float(np.sqrt(np.mean(weight * change**2))) / scale,
            worst=float(np.max(np.abs(change))) / scale,
            parameters=parameters,
            work=trial.work,
        )


def take(run: Callable[[], Any]) -> tuple[Any, Taken]:
    """Run something: what it returned, and what it took."""
    spans: list[tuple[float, float]] = []

    def listen(event: str, duration_secs: float, **_: Any) -> None:
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
    compiling, end = 0.0, start
    # Spans of tracing, lowering and compiling lie within each other.
    for first, last in sorted(spans):
        compiling += max(0.0, last - max(first, end))
        end = max(end, last)
    return outcome, Taken(max(seconds - compiling, 0.0), compiling)
