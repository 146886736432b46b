"""``fit(accuracy=...)`` and ``fit(seconds=...)``: the cheapest fit that is good enough, the best that is quick enough.

The light samples are chosen first (`fitting.budget.light_samples`). Where pixels times light samples are few, or few of
the pixels count, all are fitted. Else a first attempt takes some 1000 pixels of each picture, and tells from these its
error and what makes it (`fitting.budget.error_estimate`); the next one takes as many as it asks for, until the estimate
holds. Mostly one or two attempts do. Where shadows have hard edges, the accuracy is fine, or float32 is seen to be too
coarse, the fit is in float64. The error is that against a fit of all pixels in float64 with `MOST_SAMPLES` samples of
each light, the larger one of that of the parameters and that of the picture.
"""

import dataclasses
import math
import time

import numpy as np

from brdf.checks import positive
from brdf.errors import InputError
from fitting.budget.choice import Attempt, BudgetChoice
from fitting.budget.configurations import Configuration, run
from fitting.budget.error_estimate import estimate
from fitting.budget.light_samples import with_enough_samples
from fitting.budget.sampling import sample_counts
from fitting.problem import FitProblem
from fitting.result import FitResult

FIRST_PIXELS = 1024
# Pixels times light samples that are fitted whole at once: choosing among them takes about as long, and a process of a
# single fit pays for the programs that choose. And as how many of them one counts whose codes are looked at.
FEW, OF_CODES = 1 << 20, 16
# A sample of more than this share of the pixels is not worth the choosing and weighing, and all are taken.
WHOLE = 0.25
# Fits to an accuracy below this are in float64.
COARSE = 1e-4
# An attempt aims at this share of the accuracy in the pixels that it leaves out, where light samples are left out too
# and where none are; without an accuracy at this share of the error of the one before.
AIM, AIM_OF_PIXELS, LESS = 0.8, 0.95, 0.4

# Why all pixels are fitted.
REASON_FEW = "choosing among so few takes as long as looking at them"
REASON_MANY = "a sample would have to hold too many of them to be worth it"
REASON_EMPTY = "so few would not tell enough"


def fit_within(problem: FitProblem, accuracy: float | None, seconds: float | None) -> FitResult:
    """Fit to a relative accuracy, or within a time in seconds, both above 0; None for as good, or as long, as it gets.

    The problem's pictures are in memory, and its precision is the least that is used. The first attempt is always made.
    """
    start = time.perf_counter()
    limits = {"accuracy": accuracy, "seconds": seconds}
    accuracy, seconds = (None if value is None else float(positive(name, value)) for name, value in limits.items())
    if accuracy is not None and accuracy >= 1:
        raise InputError("accuracy", f"must be below 1, an error of all, got {accuracy:g}", "Give for example 1e-3")
    beside = {"loss": problem.loss != "squared", "noise": problem.noise is not None, "plausible": problem.plausible}
    for name, given in beside.items():
        if given:
            what = "cannot be combined with an accuracy or a time to spend, whose estimate is for plain squares"
            raise InputError(name, what, "Leave one of them out")
    problem = with_enough_samples(problem, accuracy)
    scenes, precision = problem.scenes, problem.precision
    hard_shadows = any(scene.lights and scene.occluders for scene in scenes) and problem.sample_errors is None
    if hard_shadows or (accuracy or COARSE) < COARSE:
        # In float32 some pixels fall on the other side of a shadow's edge, each of which weighs much in a sample.
        precision = "float64"
    sizes = [target.pixels[..., 0].size for target in problem.targets]
    work = 0
    for target, size, mask, scene in zip(problem.targets, sizes, problem.masks, scenes, strict=True):
        each = max(sum(sample_counts(scene)), 1) * (1 if target.codes is None else OF_CODES)
        work += each * (size if mask is None else np.count_nonzero(mask))
    now, attempts = Configuration(problem.model, precision, None if work <= FEW else FIRST_PIXELS), []
    while True:
        begun, done = time.perf_counter(), run(problem, now)
        now = now if any(done.samples) else dataclasses.replace(now, pixels=None)
        estimated = estimate(done)
        took = time.perf_counter() - begun
        attempts.append(dataclasses.replace(estimated, configuration=str(now), seconds=took))
        after = _better(now, estimated, accuracy, WHOLE * max(sizes))
        if after is None or (accuracy is not None and estimated.bound <= accuracy):
            break
        before, then = (sum(map(how.work, scenes)) for how in (now, after))
        if seconds is not None and time.perf_counter() - start + took * then / before > seconds:
            break
        now = after
    reason = ""
    if now.pixels is None:
        reason = REASON_FEW if work <= FEW else REASON_MANY if len(attempts) > 1 else REASON_EMPTY
    fitted = [size if sample is None else sample.pixel.size for size, sample in zip(sizes, done.samples, strict=True)]
    met = None if accuracy is None else estimated.bound <= accuracy
    choice = BudgetChoice(accuracy, seconds, tuple(attempts), sum(fitted), sum(sizes), met, reason)
    return dataclasses.replace(done.result, choice=choice, seconds=time.perf_counter() - start)


def _better(now: Configuration, estimated: Attempt, accuracy: float | None, most: float) -> Configuration | None:
    """The next configuration to try; None where nothing is left to improve."""
    if now.precision == "float32" and estimated.rounding > (accuracy or estimated.bound) / 8:
        return dataclasses.replace(now, precision="float64")
    aim = LESS * estimated.pixels if accuracy is None else (AIM if estimated.light else AIM_OF_PIXELS) * accuracy
    if now.pixels is None or estimated.pixels <= aim:
        return None
    # What least squares itself has no more pixels lessen, but the likelihood of all.
    drawn, aim = estimated.pixels - estimated.squares, aim - estimated.squares
    if aim <= 0:
        return dataclasses.replace(now, pixels=None)
    # A power of two, so that programs are compiled for few sizes.
    pixels = now.pixels << max(math.ceil(2 * math.log2(drawn / aim)), 1)
    return dataclasses.replace(now, pixels=pixels if pixels <= most else None)
