"""What a scene offers to choose, and how far each choice is from the best that can be done.

Only what the scene has is varied: pixels where there are enough of them, light samples where a light has an extent,
shadows where a shape can cast one. A check has nothing to choose: its albedo is closed, and of a BRDF without a closed
one the adaptive rule tells its own error.

Fewer pixels are a stratified subsample, not a level of the picture's pyramid: averaged pixels blur a highlight, which
the fit takes for a smaller exponent. Of 36 fits (four exponents, three noises, three sizes) the subsample was closer
in 97 %, by a factor of 37 in the median (``python -m benchmarks.tradeoff_pyramid``).
"""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

import brdf
from brdf.models.base import SpecularMaterial
from brdf.precision import Precision
from fitting.budget.budget import MOST_SAMPLES, WHOLE
from fitting.budget.configurations import Configuration, casts_shadows, run, some_of_target, target_size
from fitting.budget.deviation import parameter_deviation
from fitting.budget.lamps import Lamps, extended
from fitting.budget.pixel_sampling import sample_pixels
from fitting.budget.reference import reference, under_many_samples
from fitting.budget.stopwatch import Taken
from fitting.result import FitResult
from fitting.speed_table import Row

PIXELS = (1024, 4096, 16384, 65536, 262144)
# Pixels of the reference under lights with an extent, and of the solvers that keep a Jacobian.
REFERENCE_PIXELS, SOLVER_PIXELS = 1024, 1024
# Pixels that pictures are compared at, under lights with an extent.
COMPARED_PIXELS = 1024
# Where the general solvers start.
START = 30.0
# Those, and the relative changes at which they stop.
SOLVERS = ("lm", 1e-8), ("lm", 1e-4), ("bfgs", 1e-8)


class Trial(NamedTuple):
    """One thing to run.

    Attributes:
        axis: what it is tried for.
        configuration: of a fit; None for the renderer.
        name: in words.
        run: does it.
        work: pixels times light samples, twice for float64.
        once: whether it compiles anew each time, so that a second run would take as long as the first.
    """

    axis: str
    configuration: Configuration | None
    name: str
    run: Callable[[], Any]
    work: float
    once: bool = False


class Bench:
    """The configurations that a scene offers, and the measure of their errors.

    Args:
        target: the picture.
        scene: what it shows.
        model: the name of a model, or "auto".
        options: further arguments of `fitting.fit`.
    """

    def __init__(self, target: Any, scene: brdf.Scene, model: str, options: dict[str, Any]):
        """Fit the reference."""
        self.target, self.scene, self.options, self.lamps = target, scene, options, Lamps()
        self.has_samples, self.pixels = extended(scene), target_size(target)
        self.samples = max((getattr(light, "samples", 1) for light in scene.lights), default=1)
        self.told = "float64, all pixels"
        if self.has_samples:
            pixels = REFERENCE_PIXELS if self.pixels > 2 * REFERENCE_PIXELS else None
            self.told = f"{MOST_SAMPLES} light samples, all pixels"
            if pixels is not None:
                self.told += f" (what so many samples change, told by about {2 * pixels} of the pixels)"
            self.best = under_many_samples(target, scene, model, options, self.lamps, pixels, min(self.samples, 64))
        else:
            self.best = reference([target], [scene], model, options, self.lamps)
        self.model = self.best.material.name if model == "auto" else model
        self.compared = self._compared()
        self.true = self._picture(self.best.material)

    def _compared(self) -> tuple[brdf.Scene, np.ndarray]:
        """Where pictures are compared: the whole one, or some pixels under many light samples; and their weights."""
        if not self.has_samples:
            return self.scene, np.ones((1, 1, 1))
        fine = self.lamps.with_samples(self.scene, MOST_SAMPLES)
        sample = sample_pixels(fine, brdf.BlinnPhong, COMPARED_PIXELS)
        if sample is None:
            return fine, np.ones((1, 1, 1))
        return brdf.some_pixels(fine, sample.pixel, precision="float64"), sample.stands_for[None, :, None]

    def _picture(self, material: brdf.Material) -> np.ndarray:
        return np.asarray(brdf.render(material, self.compared[0], precision="float64"))

    def trials(self) -> list[Trial]:
        """What there is to try, the most telling first."""
        default = Configuration(self.model)
        found = [("default", default)]
        sizes = [size for size in PIXELS if size <= WHOLE * self.pixels]
        found += [("pixels", dataclasses.replace(default, pixels=size)) for size in sizes]
        if self.has_samples:
            # Many samples are tried on few pixels: what they change does not hang on how many.
            few = dataclasses.replace(default, pixels=sizes[min(1, len(sizes) - 1)] if sizes else None)
            steps = [s for s in (4, 16, 64, 256, 1024) if s <= 4 * self.samples and s != self.samples]
            found += [("samples", dataclasses.replace(few, samples=samples)) for samples in steps]
            least = [s for s in (16, 64) if s < self.samples]
            found += [("samples", dataclasses.replace(default, samples=samples)) for samples in least[:1]]
        size = sizes[min(1, len(sizes) - 1)] if sizes else None
        if size is not None:
            found.append(("precision", Configuration(self.model, "float64", size)))
        if not (self.has_samples and self.pixels * self.samples > 1e7):
            found.append(("precision", Configuration(self.model, "float64")))
        if casts_shadows(self.scene):
            found.append(("shadows", dataclasses.replace(default, pixels=size, shadows=False)))
        others = [name for name in ("lambert", "phong", "blinn-phong") if name != self.model]
        found += [("model", dataclasses.replace(default, model=name, pixels=size)) for name in others]
        trials = [
            Trial(axis, how, str(how), functools.partial(self._fit, how), self._work(how))
            for axis, how in dict.fromkeys(found)
        ]
        return trials + self._solver_trials()

    def _fit(self, how: Configuration) -> FitResult:
        return run([self.target], [self.scene], how, self.options, self.lamps).result

    def _work(self, how: Configuration) -> float:
        pixels = self.pixels if how.pixels is None else how.pixels
        samples = sum(
            (how.samples or getattr(light, "samples", 1)) if hasattr(light, "samples") else 1
            for light in self.scene.lights
        )
        # What every fit takes whatever its size.
        return 4096 + pixels * max(samples, 1) * (2 if how.precision == "float64" else 1)

    def _solver_trials(self) -> list[Trial]:
        """Levenberg-Marquardt and BFGS on a few pixels, from a guess."""
        if not issubclass(type(self.best.material), SpecularMaterial):
            return []
        trials = []
        for solver, tolerance in SOLVERS:
            how = Configuration(self.model, "float64", SOLVER_PIXELS, None, True, solver, tolerance)
            work = 100 * self._work(how)
            trials.append(Trial("solver", how, str(how), functools.partial(self._solve, how), work, once=True))
        return trials

    def _solve(self, how: Configuration) -> Any:
        from fitting.joint import fit_jointly

        # Evenly spread: these solvers know no weights.
        sample = sample_pixels(self.scene, brdf.Lambert, how.pixels or SOLVER_PIXELS)
        # They leave out what the reference left out, such as pixels whose noise is cut off.
        target, scene, mask = self.target, self.scene, self.best.counted[0]
        if sample is not None:
            target = some_of_target(target, sample)
            scene = brdf.some_pixels(scene, sample.pixel, precision="float64")
            mask = mask.ravel()[sample.pixel][None]
        channels = self.best.material.k_d.shape[0]
        half = np.full(channels, 0.5)
        start = brdf.MODELS[self.model](k_a=half, k_d=half, k_s=half, n=START)  # pyright: ignore[reportCallIssue]
        free: Any = (lambda m, s: (m.k_d, m.k_s, m.n)) if scene.ambient is None else None
        free = free or (lambda m, s: (m.k_a, m.k_d, m.k_s, m.n))
        saturation = self.options["saturation"]
        found = fit_jointly(
            target,
            scene,
            start,
            free,
            solver=how.solver,  # pyright: ignore[reportArgumentType]
            tolerance=how.tolerance or 1e-8,
            mask=mask,
            saturation=saturation,
        )
        return dataclasses.replace(self.best, material=found.material)

    def render_trials(self) -> list[Trial]:
        """The renderer alone, in both precisions and with fewer light samples."""
        trials = []
        steps: Sequence[int | None] = [None]
        if self.has_samples:
            steps = [*steps, *(s for s in (4, 16, 64, 256) if s < self.samples)]
        precisions: tuple[Precision, ...] = ("float32", "float64")
        for precision in precisions:
            for samples in steps:
                place = self.lamps.with_samples(self.scene, samples)
                name = f"render, {precision}" + ("" if samples is None else f", {samples} light samples")
                work = self._work(Configuration(self.model, precision, None, samples))
                trials.append(Trial("render", None, name, functools.partial(self._render, place, precision), work))
        return trials

    def _render(self, scene: brdf.Scene, precision: Any) -> brdf.Scene:
        np.asarray(brdf.render(self.best.material, scene, precision=precision))
        return scene

    def row(self, trial: Trial, taken: Sequence[Taken], outcome: Any) -> Row:
        """What was measured.

        Args:
            trial: what ran.
            taken: by its runs. The first of several is left out: caches were cold.
            outcome: of the first one.
        """
        if isinstance(outcome, FitResult):
            change = self._picture(outcome.material) - self.true
            parameters = parameter_deviation(outcome, self.best)
        else:
            before = self.compared[0]
            now = outcome if before.resolution == outcome.resolution else None
            picture = self.true if now is None else np.asarray(brdf.render(self.best.material, now))
            change, parameters = picture - self.true, 0.0
        weight = self.compared[1]
        scale = float(np.sqrt(np.mean(weight * self.true**2)))
        rms, worst = float(np.sqrt(np.mean(weight * change**2))) / scale, float(np.max(np.abs(change))) / scale
        later = [one.seconds for one in taken[1:] or taken]
        low, median, high = np.quantile(later, [0.25, 0.5, 0.75])
        return Row(
            axis=trial.axis,
            configuration=trial.configuration,
            name=trial.name,
            compile_seconds=taken[0].compiling,
            seconds=float(median),
            spread=float(high - low) / 2,
            runs=len(later),
            peak=taken[min(1, len(taken) - 1)].peak,
            rms=rms,
            worst=worst,
            parameters=parameters,
            work=trial.work,
        )
