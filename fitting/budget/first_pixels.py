"""How many pixels to look at first: as many as the picture's noise seems to ask for, before anything is fitted.

With M pixels of noise σ a parameter is off by some σ/√M, times a number that hangs on the scene. What else a sample may
miss, such as what the model does not explain, only the fit itself tells, and whether the guess was good.
"""

import contextlib
from collections.abc import Iterator, Mapping, Sequence
from contextvars import ContextVar
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

import brdf
from brdf.models.base import SpecularMaterial
from fitting.budget.configurations import one_each, share_counted, target_size
from fitting.problem import looked_at

FIRST_PIXELS = 1024
# Relative error (95 %) of the worst parameter, times √M, over noise over the picture's root mean square: upper quartile
# of `python -m benchmarks.sample_noise`, since a few pixels more cost less than a second fit.
SPREAD = 60.0
# A sample that is crowded where highlights are holds so many times as many pixels as it is asked for.
CROWDED = 1.5
# A fit of so many takes half as long again as one of the fewest.
MOST_FIRST_PIXELS = 1 << 13
# All pictures together, fitted whole, take about twice as long as the fewest pixels.
QUICK = 1 << 18
# Pictures under single lights that are fitted whole at once: choosing among so few pixels takes as long as looking at
# them.
SMALL = 1 << 16
# What a fit of all pixels takes, compiled: seconds for a pixel, channel, light and kind of highlight. And what choosing
# among them takes beyond that in a process that compiled nothing of it yet, with programs from the compiler's cache;
# without, several times that. Measured by `python -m benchmarks.tradeoff_fresh`.
EACH_PIXEL, CHOOSING = 3e-8, 0.3
TOO_MANY = "a sample would have to hold too many of them to be worth it"
NOISY = "by their noise a sample would have to hold too many of them"
# So many rows tell the noise: of a ball in 512² that is some 1400 pixels, whose median is known to 3 %.
ROWS = 4
# Of a Gaussian: its standard deviation over the median size; and the root of the sum of squares of 1, -2, 1.
MEDIAN, SECOND = 1.4826, np.sqrt(6.0)

_single: ContextVar[bool] = ContextVar("single", default=False)


@contextlib.contextmanager
def single_fit() -> Iterator[None]:
    """Within: the fit is the only one of its process, which therefore pays for all that is compiled."""
    before = _single.set(True)
    try:
        yield
    finally:
        _single.reset(before)


def noise_and_size(
    values: Float[np.ndarray, "H W C"], allowed: Bool[np.ndarray, "H W"] | None = None
) -> tuple[float, float]:
    """Standard deviation of the noise in the channel that has most of it, root mean square of the brightest one.

    Fine relief and texture pass for noise.

    Args:
        values: the picture; what is black is taken for background.
        allowed: pixels to look at, (H, W); None for all.

    Source: second differences along rows, their median size. Immerkær 1996, "Fast noise variance estimation", does
    the same with a mean over two axes.
    """
    step = max(1, values.shape[0] // ROWS)
    some = slice(step // 2, None, step)
    rows = np.asarray(values[some], np.float64)
    lit = np.isfinite(rows).all(axis=-1) & (rows != 0).any(axis=-1)
    if allowed is not None:
        lit &= allowed[some]
    inside = lit[:, :-2] & lit[:, 1:-1] & lit[:, 2:]
    if not inside.any():
        return 0.0, 0.0
    with np.errstate(invalid="ignore"):
        change = rows[:, :-2] - 2 * rows[:, 1:-1] + rows[:, 2:]
    deviation = MEDIAN * np.median(np.abs(change[inside].T), axis=1) / SECOND
    return float(np.max(deviation)), float(np.sqrt(np.max(np.mean(rows[lit] ** 2, axis=0))))


def pixels_for(targets: Sequence[Any], options: Mapping[str, Any], model: str, accuracy: float) -> float:
    """How many pixels of all pictures together to ask `sample_pixels` for, by their noise.

    Args:
        targets: the pictures, or their arrays.
        options: further arguments of `fitting.fit`: masks, weights, ...
        model: "auto" or the name of a model.
        accuracy: relative error, in 95 % of cases.
    """
    cuts = zip(*(one_each(options.get(name), len(targets)) for name in ("mask", "weight")), strict=True)
    found = [
        noise_and_size(np.atleast_3d(np.asarray(getattr(target, "pixels", target))), looked_at(*cut))
        for target, cut in zip(targets, cuts, strict=True)
    ]
    noise, size = np.sqrt(np.mean(np.square(found), axis=0))
    share = noise / max(size, np.finfo(float).tiny)
    crowded = model == "auto" or issubclass(brdf.MODELS[model], SpecularMaterial)
    return (SPREAD * share / accuracy) ** 2 / (CROWDED if crowded else 1.0)


def first_pixels(
    targets: Sequence[Any], options: Mapping[str, Any], model: str, accuracy: float, most: float
) -> int | None:
    """How many pixels of each picture to look at first; None for all.

    What the noise asks for, as long as that costs little, since relief may pass for noise. Where it asks for more, a
    picture that is quickly fitted whole is; of a larger one few pixels tell how many it takes.

    Args:
        targets: the pictures, or their arrays.
        options: further arguments of `fitting.fit`.
        model: "auto" or the name of a model.
        accuracy: relative error.
        most: pixels of a sample that is worth it.
    """
    asked = pixels_for(targets, options, model, accuracy) / len(targets)
    pixels = FIRST_PIXELS
    while pixels < min(asked, MOST_FIRST_PIXELS):
        pixels *= 2
    if asked <= pixels <= most:
        return pixels
    return None if sum(map(target_size, targets)) <= QUICK else FIRST_PIXELS


def reason_for_all(
    targets: Sequence[Any],
    scenes: Sequence[brdf.Scene],
    model: str,
    options: Mapping[str, Any],
    *,
    single: bool,
) -> str:
    """Why all pixels are looked at without choosing among them first; empty where choosing may pay.

    Args:
        targets: pictures.
        scenes: one for each, under single lights.
        model: "auto" or the name of a model.
        options: further arguments of `fitting.fit`: masks, weights, ...
        single: whether it counts that the fit may be the only one of its process.
    """
    cuts = zip(*(one_each(options.get(name), len(targets)) for name in ("mask", "weight")), strict=True)
    sizes = [target_size(target) * share_counted(*cut) for target, cut in zip(targets, cuts, strict=True)]
    if max(sizes) <= SMALL:
        return "choosing among so few takes as long as looking at them"
    if not (single and _single.get()):
        return ""
    work = 0.0
    for target, scene, size in zip(targets, scenes, sizes, strict=True):
        channels = (*np.shape(getattr(target, "pixels", target)), 1)[2]
        work += size * channels * max(len(scene.lights), 1) * (2 if model == "auto" else 1)
    if EACH_PIXEL * work < CHOOSING:
        return "in a process of its own, compiling what chooses among them takes longer than looking at them"
    return ""
