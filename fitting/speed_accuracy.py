"""Speed against accuracy, measured on the user's own scene.

What is tried is in `fitting.budget.trials`. Each configuration runs once with cold caches, once warm, and then in
rounds, every round in another order (fixed seed), so that a machine that grows slower or quicker favours none. The
compiler's time is taken out of every run. What takes long, or compiles anew each time, runs once.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

import brdf
from brdf.errors import InputError
from fitting.budget.stopwatch import Taken, take
from fitting.budget.trials import Bench, Trial
from fitting.speed_table import Tradeoff

MOST_ROUNDS = 9
# What takes longer than this is run once: beside it cold caches count for nothing.
LONG = 1.0
# Axes that are told for comparison: their fits leave something out of the picture.
BESIDE = ("model", "shadows", "render")


def tradeoff(
    target: Any,
    scene: brdf.Scene,
    *,
    model: str = "blinn-phong",
    mask: Any = None,
    saturation: float | None = None,
    accuracy: float = 1e-3,
    seconds: float = 45.0,
    render: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> Tradeoff:
    """Measure what the choices that a scene offers cost, and what error they make.

    Args:
        target: linear values, (H, W, C) or (H, W), or a `brdf.Picture`.
        scene: what the picture shows.
        model: the name of a model, or "auto".
        mask: (H, W), pixels to look at.
        saturation: see `fitting.fit`.
        accuracy: relative error that the recommendation is to keep.
        seconds: that the measuring may take: no new run begins after them. A running one is waited for.
        render: also measure the renderer alone.
        progress: called with the number of runs done and that of all.

    Returns:
        The table. Ctrl-C ends the measuring and keeps what was measured.

    Raises:
        InputError: where target, scene or a number cannot be used.
    """
    begun = time.perf_counter()
    for name, value in (("accuracy", accuracy), ("seconds", seconds)):
        if isinstance(value, bool) or not isinstance(value, int | float) or not 0 < value < np.inf:
            raise InputError(name, f"must be a number above 0, got {value!r}", "Give for example 0.001")
    if model != "auto" and model not in brdf.MODELS:
        raise InputError("model", f"is unknown, got {model!r}", f"Use auto or one of {', '.join(brdf.MODELS)}")
    # The front door says what is wrong with the picture, before anything is measured.
    options = {"mask": mask, "saturation": saturation, "n_range": (0.1, 1e6)}
    bench = Bench(target, scene, model, options)
    trials = bench.trials()
    if render:
        trials += bench.render_trials()
    taken: dict[int, list[Taken]] = {}
    found: dict[int, Any] = {}
    # Everything once, so that the errors, which decide what is recommended, are known however slow the compiler is:
    # first what can be recommended, from little to much work, so that what would take too long is known before, and
    # last what compiles anew each time. Then again, warm, and then in rounds, every one shuffled.
    by_work = sorted(range(len(trials)), key=lambda index: _turn(trials[index]))
    first = [*by_work, *by_work]
    again = [index for index, trial in enumerate(trials) if not trial.once]
    random = np.random.default_rng(0)
    order = [*first, *(index for _ in range(MOST_ROUNDS) for index in random.permutation(again))]
    try:
        for done, index in enumerate(map(int, order)):
            trial, before = trials[index], taken.get(index, [])
            left = seconds - (time.perf_counter() - begun)
            if before and (trial.once or before[-1].seconds > min(LONG, left)):
                continue
            if left < 0 or _expected(trial, trials, taken) > left:
                continue
            # The first run holds the compiler's memory too; the later ones are only timed.
            outcome, one = take(trial.run, trimmed=len(before) < 2)
            taken.setdefault(index, []).append(one)
            found.setdefault(index, outcome)
            if progress is not None:
                progress(done + 1, len(order))
    except KeyboardInterrupt:
        pass
    rows = [bench.row(trial, taken[i], found[i]) for i, trial in enumerate(trials) if i in taken]
    return Tradeoff(tuple(rows), bench.told, accuracy, len(trials), time.perf_counter() - begun)


def _turn(trial: Trial) -> tuple[bool, bool, float]:
    """What comes first: what can be recommended, then what is only to be compared with it."""
    return trial.once, trial.axis in BESIDE, trial.work


def _expected(trial: Trial, trials: Sequence[Trial], taken: Mapping[int, Sequence[Taken]]) -> float:
    """Seconds that a fit may take, by the one of the most work so far; 0 where nothing is known."""
    if trial.configuration is None or trial.once or not taken:
        return 0.0
    most = max(taken, key=lambda index: trials[index].work)
    return taken[most][-1].seconds * trial.work / trials[most].work
