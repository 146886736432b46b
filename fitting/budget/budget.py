"""``fit(accuracy=...)`` and ``fit(seconds=...)``: the cheapest fit that is good enough, the best that is quick enough.

The first attempt is cheap: some 1000 pixels of a picture, more where its noise asks for more
(`fitting.budget.first_pixels`), all of a small one; 16 samples of a light with an extent; float32. From its own
pixels it tells its error and what makes it (`fitting.budget.sampling_error`), so the next attempt changes just that:
more pixels by the square of what is missing, more light samples as far as four times as many still change the answer,
float64 where rounding counts. Mostly one or two attempts do. The error is that against a fit of all pixels in float64
with `MOST_SAMPLES` samples of each light, and is the larger one of what `fitting.budget.deviation` says of the
parameters and of the picture.
"""

import dataclasses
import functools
import time
from collections.abc import Callable, Mapping, Sequence
from numbers import Real
from typing import Any, NamedTuple

import numpy as np

import brdf
from brdf.errors import InputError
from brdf.precision import Precision
from fitting.budget.budget_choice import Attempt, BudgetChoice
from fitting.budget.configurations import Configuration, Run, casts_shadows, run, target_size
from fitting.budget.first_pixels import FIRST_PIXELS, NOISY, TOO_MANY, first_pixels, reason_for_all
from fitting.budget.lamps import Lamps, extended
from fitting.budget.linear_system import System
from fitting.budget.sampling_error import (
    MARGIN,
    STEP,
    Estimate,
    estimate,
    light_error,
    nearly_dependent,
    rounding_by_rule,
)
from fitting.result import FitResult

FIRST_SAMPLES, MOST_SAMPLES = 16, 4096
# Down to this accuracy the order of magnitude of rounding is enough to know.
COARSE = 1e-4
# An attempt aims at this share of the accuracy in each of the parts that its error has.
AIM = 0.6
# The light samples may use this share of it where all pixels are looked at.
WHOLE_AIM = 0.9
# With N light samples their error is taken to fall no slower and no faster than N to these powers, downwards.
RATES = 0.5, 2.0
# A sample of more than this share of the pixels is not worth the choosing and weighing, and all are taken: under lights
# of many samples, whose work is in these, and under single ones.
WHOLE, WHOLE_IF_SINGLE = 0.4, 0.1
MOST_ATTEMPTS = 8
# An estimate is of first order. Where it is larger than this the parameters may be anywhere: the next attempt goes one
# step and searches all exponents.
SMALL_ERROR = 0.5
# Within this factor of the exponent found before the next attempt searches, where its 95 % interval is narrower.
NEAR, NEAR_AUTO = 4.0, 16.0


class _Step(NamedTuple):
    run: Run
    system: System | None
    estimate: Estimate


def fit_within(
    targets: Sequence[Any],
    scenes: Sequence[brdf.Scene],
    model: str,
    precision: Precision,
    options: Mapping[str, Any],
    beside: Mapping[str, bool],
    *,
    accuracy: float | None,
    seconds: float | None,
) -> FitResult:
    """Fit to an accuracy, or within a time.

    Args:
        targets: pictures.
        scenes: one for each.
        model: "auto" or the name of a model.
        precision: "float32" or "float64", the least that is used.
        options: further arguments of `fitting.fit`.
        beside: arguments that cannot be combined with this, and whether they were given.
        accuracy: relative error, above 0; None for as small as the time allows.
        seconds: time to spend, above 0; None for as long as it takes. The first attempt is always made.

    Raises:
        InputError: where one of them cannot be used.
    """
    start = time.perf_counter()
    for name, value in (("accuracy", accuracy), ("seconds", seconds)):
        if value is not None and (isinstance(value, bool) or not isinstance(value, Real) or not 0 < value < np.inf):
            raise InputError(name, f"must be a number above 0, got {value!r}", "Give for example 0.001")
    for name, given in beside.items():
        if given:
            came = "cannot be combined with an accuracy or a time to spend, whose estimate is for plain squares"
            raise InputError(name, came, "Leave one of them out")
    lamps, attempts = Lamps(), []
    has_samples = any(extended(scene) for scene in scenes)
    reason = "" if has_samples else reason_for_all(targets, scenes, model, options, single=accuracy is not None)
    hard = not has_samples and any(map(casts_shadows, scenes))
    # Where only time counts, more pixels are worth their price.
    share = WHOLE_IF_SINGLE if accuracy is not None and not has_samples else WHOLE
    most = share * max(map(target_size, targets))
    pixels = None if reason else FIRST_PIXELS
    # Where light samples are to be chosen too, or time is short, few pixels tell first.
    if pixels is not None and accuracy is not None and seconds is None and not has_samples:
        pixels = first_pixels(targets, options, model, accuracy, most)
        reason = "" if pixels is not None else NOISY
    first = _precision(precision, pixels, accuracy, hard=hard)
    now = Configuration(model, first, pixels, FIRST_SAMPLES if has_samples else None)
    n_range = None
    while True:
        begun = time.perf_counter()
        step = _attempt(targets, scenes, now, options, lamps, n_range, accuracy)
        took = time.perf_counter() - begun
        if now.pixels is not None and all(sample is None for sample in step.run.samples):
            now, reason = dataclasses.replace(now, pixels=None), reason or "so few would not tell enough"
        attempts.append(Attempt(str(now), *step.estimate, took))
        if accuracy is not None and step.estimate.bound <= accuracy:
            break
        after = _better(now, step, most, accuracy)
        if after is None or len(attempts) == MOST_ATTEMPTS:
            break
        growth = _work(after, step, targets) / _work(now, step, targets)
        if seconds is not None and time.perf_counter() - start + took * max(growth, 1.0) > seconds:
            break
        if now.pixels is not None and after.pixels is None:
            reason = TOO_MANY
            after = dataclasses.replace(after, precision=_precision(precision, None, accuracy, hard=hard))
        now, n_range = after, _near(step, options)
    looked = [target_size(t) if s is None else s.pixel.size for t, s in zip(targets, step.run.samples, strict=True)]
    choice = BudgetChoice(
        accuracy,
        seconds,
        tuple(attempts),
        sum(looked),
        sum(map(target_size, targets)),
        None if accuracy is None else step.estimate.bound <= accuracy,
        reason,
    )
    return dataclasses.replace(step.run.result, choice=choice, seconds=time.perf_counter() - start)


def _precision(least: Precision, pixels: int | None, accuracy: float | None, *, hard: bool) -> Precision:
    """In which to look at so many pixels.

    Under hard shadows float32 puts some pixels on the other side of an edge: a few in a million, each of which weighs
    much in a sample, and all together some 1e-4.
    """
    fine = pixels is not None or (accuracy is not None and accuracy <= COARSE)
    return "float64" if hard and fine else least


def _attempt(
    targets: Sequence[Any],
    scenes: Sequence[brdf.Scene],
    configuration: Configuration,
    options: Mapping[str, Any],
    lamps: Lamps,
    n_range: tuple[float, float] | None,
    accuracy: float | None,
) -> _Step:
    done = run(targets, scenes, configuration, options, lamps, n_range)
    if configuration.precision == "float32" and nearly_dependent(done.result.optimum):
        return _Step(done, None, Estimate(1.0, 1.0, 0.0, 0.0, 1.0))
    shadows = any(map(casts_shadows, scenes))
    rule = rounding_by_rule(done.result.optimum.n, configuration.precision)
    known = accuracy is not None and accuracy >= COARSE and 3 * rule < accuracy
    if known and configuration.pixels is None and configuration.samples is None and not shadows:
        return _Step(done, None, Estimate(rule, 3 * rule, 0.0, 0.0, rule))
    system = System(done, targets, dict(options), lamps)
    found = estimate(system, _finer(configuration.samples), rule=rule if known else None)
    return _Step(done, system, found)


def _finer(samples: int | None) -> int | None:
    """What so many light samples are compared with; None where there are none to choose, or as many as there may be."""
    return None if samples is None or samples >= MOST_SAMPLES else min(STEP * samples, MOST_SAMPLES)


def _better(now: Configuration, step: _Step, most: float, accuracy: float | None) -> Configuration | None:
    """The next configuration to try; None where nothing is left to improve."""
    told = step.estimate
    # Without an accuracy the largest part of the error is taken down, four times per attempt.
    aim = AIM * accuracy if accuracy is not None else max(told.pixels, told.light, told.rounding) / 2.5
    after = now
    if now.pixels is not None and told.pixels > aim:
        after = dataclasses.replace(after, pixels=_more_pixels(now.pixels, (told.pixels / aim) ** 2, most))
    # What the pixels left out need not share with the light samples, those may have.
    allowed = aim / 2 if accuracy is None or after.pixels is not None else WHOLE_AIM * accuracy / MARGIN
    if step.system is not None and now.samples is not None and told.light > allowed and now.samples < MOST_SAMPLES:
        left = functools.partial(light_error, step.system)
        after = dataclasses.replace(after, samples=_more_samples(now.samples, left, told, allowed))
    if now.precision == "float32" and told.rounding > aim / 2:
        after = dataclasses.replace(after, precision="float64")
    if after != now:
        return after
    parts = {"pixels": told.pixels, "samples": told.light, "precision": told.rounding}
    for name in sorted(parts, key=lambda name: -parts[name]):
        if name == "pixels" and now.pixels is not None and parts[name] > 0:
            return dataclasses.replace(now, pixels=_more_pixels(now.pixels, 2.0, most))
        if name == "samples" and now.samples is not None and now.samples < MOST_SAMPLES and parts[name] > 0:
            return dataclasses.replace(now, samples=min(STEP * now.samples, MOST_SAMPLES))
        if name == "precision" and now.precision == "float32" and parts[name] > 0:
            return dataclasses.replace(now, precision="float64")
    return None


def _more_samples(few: int, error: Callable[[int, int], float], told: Estimate, allowed: float) -> int:
    """As many light samples as leave an error that is allowed, by its fall from here to `STEP` times as many."""
    more = STEP * few
    if told.bound > SMALL_ERROR or more >= MOST_SAMPLES:
        return min(more, MOST_SAMPLES)
    left = max(error(more, min(STEP * more, MOST_SAMPLES)), np.finfo(float).tiny)
    rate = np.log(told.light / left) / np.log(STEP)
    if left > allowed:
        factor = STEP * (left / allowed) ** (1 / np.clip(rate, *RATES))
    else:
        factor = (told.light / allowed) ** (1 / rate)
    return min(few * _power_of_two(factor), MOST_SAMPLES)


def _power_of_two(factor: float) -> int:
    """The next one up, at least 2, so that programs are compiled for few sizes."""
    return 2 ** max(1, int(np.ceil(np.log2(min(factor, 1e9)))))


def _more_pixels(pixels: int, factor: float, most: float) -> int | None:
    """More pixels by a factor; None for all, where that is more than the most."""
    more = pixels * _power_of_two(factor)
    return None if more > most else more


def _work(configuration: Configuration, step: _Step, targets: Sequence[Any]) -> float:
    """Pixels times samples, with what every fit takes whatever its size."""
    whole = max(map(target_size, targets))
    pixels = whole if configuration.pixels is None else min(configuration.pixels, whole)
    work = pixels * (configuration.samples or 1) * (2 if configuration.precision == "float64" else 1)
    return work + 1e5 * len(step.run.scenes)


def _near(step: _Step, options: Mapping[str, Any]) -> tuple[float, float] | None:
    """Bounds about the exponent found, where it is well known; None for those of the options."""
    result = step.run.result
    n = next((parameter for parameter in result.parameters if parameter.name == "n"), None)
    if n is None or n.value is None or n.interval is None:
        return None
    factor = NEAR_AUTO if result.candidates else NEAR
    inner = np.sqrt(factor)
    # The interval is of the noise alone; light samples left out can lead far away.
    if n.interval[0] < n.value / inner or n.interval[1] > n.value * inner or step.estimate.bound > SMALL_ERROR:
        return None
    low, high = options["n_range"]
    return max(low, n.value / factor), min(high, n.value * factor)
