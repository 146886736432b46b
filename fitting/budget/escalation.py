"""``fit(accuracy=...)`` and ``fit(seconds=...)``: the cheapest fit that is good enough, the best that is quick enough.

The first attempt is cheap: some 1000 pixels of a picture, more where its noise asks for more, all of a small one;
16 samples of a light with an extent; float32, but float64 where shadows have hard edges or the accuracy is fine. From
its own pixels it tells its error and what makes it (`fitting.budget.error_estimate`), so the next attempt changes just
that, until the estimate holds. Mostly one or two attempts do. The error is that against a fit of all pixels in float64
with `MOST_SAMPLES` samples of each light, the larger one of that of the parameters and that of the picture.
"""

import dataclasses
import time
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

import brdf
from brdf.errors import InputError
from brdf.models.base import SpecularMaterial
from fitting.budget.choice import Attempt, BudgetChoice
from fitting.budget.configurations import MOST_SAMPLES, Configuration, run, sample_counts
from fitting.budget.error_estimate import STEP, estimate
from fitting.budget.sampling import MadeLights
from fitting.problem import FitProblem
from fitting.result import FitResult

FIRST_PIXELS, FIRST_SAMPLES = 1024, 16
# Fits to an accuracy below this are in float64.
COARSE = 1e-4
# An attempt aims at this share of the accuracy in the pixels that it leaves out, at half of it in the other parts, and
# where pixels are all that it leaves out.
AIM, AIM_ALONE = 0.6, 0.8
# A sample of more than this share of the pixels is not worth the choosing and weighing, and all are taken: under lights
# of many samples or where only time counts, and under single lights.
WHOLE, WHOLE_IF_SINGLE = 0.4, 0.15
MOST_ATTEMPTS = 8
# What a fit takes whatever its size, in pixels times samples.
FIXED = 1e5
# An estimate is of first order. Where it is larger than this the parameters may be anywhere: the next attempt goes one
# step and searches all exponents.
SMALL_ERROR = 0.5
# Within this factor of the exponent found before the next attempt searches, where its 95 % interval is narrower.
NEAR, NEAR_AUTO = 4.0, 16.0

# Relative error (95 %) of the worst parameter, times the root of the number of pixels, over noise over the picture's
# root mean square: upper quartile of `python -m benchmarks.sample_noise`, since a few pixels more cost less than a
# second fit.
SPREAD = 60.0
# A sample that is crowded where highlights are holds so many times as many pixels as it is asked for.
CROWDED = 1.5
# A fit of so many pixels takes half as long again as one of the fewest.
MOST_FIRST_PIXELS = 1 << 13
# All pictures together, fitted whole, take about twice as long as the fewest pixels.
QUICK = 1 << 18
# Pictures under single lights that are fitted whole at once.
SMALL = 1 << 16
# What a fit of all pixels takes, compiled: seconds for a pixel, channel, light and kind of highlight. And what choosing
# among them takes beyond that in a process that compiled nothing of it yet, with programs from the compiler's cache;
# without, several times that.
EACH_PIXEL, CHOOSING = 3e-8, 0.3
# So many rows tell the noise: of a ball in 512² that is some 1400 pixels, whose median is known to 3 %.
ROWS = 4
# Of a Gaussian: its standard deviation over the median size; and the root of the sum of squares of 1, -2, 1.
MEDIAN, SECOND = 1.4826, np.sqrt(6.0)

# Why all pixels are fitted.
FEW = "choosing among so few takes as long as looking at them"
ONLY = "in a process of its own, compiling what chooses among them takes longer than looking at them"
NOISY = "by their noise a sample would have to hold too many of them"
TOO_MANY = "a sample would have to hold too many of them to be worth it"
EMPTY = "so few would not tell enough"


class OnlyFit(float):
    """An accuracy asked for in a process that fits once, and pays for all that is compiled: the command's."""


def fit_within(problem: FitProblem, accuracy: float | None, seconds: float | None) -> FitResult:
    """Fit to an accuracy, or within a time.

    Args:
        problem: pictures in memory; its precision is the least that is used.
        accuracy: relative error, above 0; None for as small as the time allows.
        seconds: time to spend, above 0; None for as long as it takes. The first attempt is always made.

    Raises:
        InputError: where one of them cannot be used.
    """
    start = time.perf_counter()
    check_above_zero(accuracy=accuracy, seconds=seconds)
    beside = {"loss": problem.loss != "squared", "noise": problem.noise is not None, "plausible": problem.plausible}
    for name, given in beside.items():
        if given:
            came = "cannot be combined with an accuracy or a time to spend, whose estimate is for plain squares"
            raise InputError(name, came, "Leave one of them out")
    scenes, precision = problem.scenes, problem.precision
    has_samples = any(sample_counts(scenes))
    hard_shadows = not has_samples and any(scene.lights and scene.occluders for scene in scenes)
    if hard_shadows or (accuracy or COARSE) < COARSE:
        # In float32 some pixels fall on the other side of a shadow's edge, each of which weighs much in a sample.
        precision = "float64"
    sizes = [target.pixels[..., 0].size for target in problem.targets]
    most = max(sizes) * (WHOLE_IF_SINGLE if accuracy is not None and not has_samples else WHOLE)
    pixels, reason = (FIRST_PIXELS, "") if has_samples else _first_pixels(problem, accuracy, sizes, most)
    now = Configuration(problem.model, precision, pixels, FIRST_SAMPLES if has_samples else None)
    lights: MadeLights = {}
    attempts, n_range = [], None
    while True:
        begun = time.perf_counter()
        done = run(problem, now, lights, n_range)
        if done.configuration != now:
            now, reason = done.configuration, reason or EMPTY
        told = estimate(done, lights)
        took = time.perf_counter() - begun
        attempts.append(Attempt(str(now), *told, took))
        after = _better(now, told, accuracy, most)
        if after is None or (accuracy is not None and told.bound <= accuracy) or len(attempts) == MOST_ATTEMPTS:
            break
        before, then = (FIXED * len(sizes) + how.work(max(sizes), scenes) for how in (now, after))
        if seconds is not None and time.perf_counter() - start + took * max(then / before, 1.0) > seconds:
            break
        reason = TOO_MANY if after.pixels is None and now.pixels is not None else reason
        now, n_range = after, near(done.result, told.bound, problem.n_range)
    fitted = [size if sample is None else sample.pixel.size for size, sample in zip(sizes, done.samples, strict=True)]
    met = None if accuracy is None else told.bound <= accuracy
    choice = BudgetChoice(accuracy, seconds, tuple(attempts), sum(fitted), sum(sizes), met, reason)
    return dataclasses.replace(done.result, choice=choice, seconds=time.perf_counter() - start)


def check_above_zero(**values: Any) -> None:
    """Refuse what is given and no number above 0, naming it."""
    for name, value in values.items():
        number = isinstance(value, int | float | np.number) and not isinstance(value, bool)
        if value is not None and not (number and 0 < value < np.inf):
            raise InputError(name, f"must be a number above 0, got {value!r}", "Give for example 0.001")


def _better(now, told, accuracy, most):
    """The next configuration to try; None where nothing is left to improve."""
    pixels = told.pixels if now.pixels else 0.0
    light = told.light if now.samples and now.samples < MOST_SAMPLES else 0.0
    rounding = told.rounding if now.precision == "float32" else 0.0
    worst = max(pixels, light, rounding)
    if worst == 0:
        return None
    # Without an accuracy the largest part of the error is taken down, four times per attempt.
    share = AIM if now.samples else AIM_ALONE
    aim = worst / 2.5 if accuracy is None else min(share * accuracy, 0.7 * worst)
    change: dict[str, Any] = {}
    if now.pixels and pixels > aim:
        more = now.pixels * _power_of_two((pixels / aim) ** 2)
        change["pixels"] = None if more > most else more
    if now.samples and light > aim / 2:
        factor = STEP if told.bound > SMALL_ERROR else min(_power_of_two(2 * light / aim), STEP**2)
        change["samples"] = min(now.samples * factor, MOST_SAMPLES)
    if rounding > aim / 2:
        change["precision"] = "float64"
    return dataclasses.replace(now, **change)


def _power_of_two(factor):
    """The next one up, at least 2, so that programs are compiled for few sizes."""
    return 2 ** max(1, int(np.ceil(np.log2(min(factor, 1e9)))))


def near(result: FitResult, error: float, n_range: tuple[float, float]) -> tuple[float, float] | None:
    """Bounds about the exponent found, where it is well known; None for those of the options.

    Args:
        result: of a cheap fit.
        error: its estimated error: the interval is of the noise alone, light samples left out can lead far away.
        n_range: bounds that were given.
    """
    factor = NEAR_AUTO if result.candidates else NEAR
    inner = np.sqrt(factor)
    for n in result.parameters:
        if n.name != "n" or n.value is None or n.interval is None or error > SMALL_ERROR:
            continue
        if n.value / inner <= n.interval[0] and n.interval[1] <= n.value * inner:
            return max(n_range[0], n.value / factor), min(n_range[1], n.value * factor)
    return None


def _first_pixels(problem, accuracy, sizes, most):
    """How many pixels of each picture to fit first under single lights; None for all, and why all.

    What the noise asks for, as long as that costs little, since relief may pass for noise. Where it asks for more, a
    picture that is quickly fitted whole is; of a larger one few pixels tell how many it takes.
    """
    counts = [size if mask is None else np.count_nonzero(mask) for size, mask in zip(sizes, problem.masks, strict=True)]
    if max(counts) <= SMALL:
        return None, FEW
    if accuracy is None:
        return FIRST_PIXELS, ""
    kinds = problem.targets[0].pixels.shape[2] * (2 if problem.model == "auto" else 1)
    work = kinds * sum(n * max(len(scene.lights), 1) for n, scene in zip(counts, problem.scenes, strict=True))
    if isinstance(accuracy, OnlyFit) and EACH_PIXEL * work < CHOOSING:
        return None, ONLY
    pictures = [target.pixels for target in problem.targets]
    asked = pixels_for_noise(pictures, problem.masks, problem.model, accuracy) / len(sizes)
    pixels = FIRST_PIXELS
    while pixels < min(asked, MOST_FIRST_PIXELS):
        pixels *= 2
    if asked <= pixels <= most:
        return pixels, ""
    return (None, NOISY) if sum(sizes) <= QUICK else (FIRST_PIXELS, "")


def pixels_for_noise(pictures: Sequence[Any], masks: Sequence[Any], model: str, accuracy: float) -> float:
    """How many pixels of all pictures together to ask `sample_pixels` for, by their noise.

    With M pixels of noise σ a parameter is off by some σ/√M, times a number that hangs on the scene.

    Args:
        pictures: (H, W, C) each.
        masks: pixels of each that count, (H, W); None for all.
        model: "auto" or the name of a model.
        accuracy: relative error, in 95 % of cases.
    """
    noise, size = np.sqrt(np.mean(np.array(list(map(noise_and_size, pictures, masks))) ** 2, axis=0))
    crowded = model == "auto" or issubclass(brdf.MODELS[model], SpecularMaterial)
    return (SPREAD * noise / max(size, np.finfo(float).tiny) / accuracy) ** 2 / (CROWDED if crowded else 1.0)


def noise_and_size(
    values: Float[np.ndarray, "H W C"], kept: Bool[np.ndarray, "H W"] | None = None
) -> tuple[float, float]:
    """Standard deviation of the noise in the channel that has most of it, root mean square of the brightest one.

    Fine relief and texture pass for noise; what is black is taken for background.

    Source: second differences along rows, their median size. Immerkær 1996, "Fast noise variance estimation", does
    the same with a mean over two axes.
    """
    step = max(1, values.shape[0] // ROWS)
    some = slice(step // 2, None, step)
    rows = np.asarray(values[some], np.float64)
    lit = np.isfinite(rows).all(axis=-1) & (rows != 0).any(axis=-1) & (True if kept is None else kept[some])
    with np.errstate(invalid="ignore"):
        change = np.abs(np.diff(rows, 2, axis=1)[lit[:, :-2] & lit[:, 1:-1] & lit[:, 2:]])
    if not change.size:
        return 0.0, 0.0
    deviation = MEDIAN * np.median(change, axis=0) / SECOND
    return float(np.max(deviation)), float(np.sqrt(np.max(np.mean(rows[lit] ** 2, axis=0))))
