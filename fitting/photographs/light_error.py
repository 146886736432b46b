"""What the error of a light that was found from shading does to the numbers of a fit."""

import dataclasses
import math
from collections.abc import Sequence

import numpy as np

from fitting.implicit import sensitivity
from fitting.result import FitResult, Parameter
from fitting.uncertainty.intervals import above_zero


def with_light_errors(result: FitResult, degrees: Sequence[float]) -> FitResult:
    """A fit whose errors hold those of its lights, to first order and as if they were independent of the picture's.

    Args:
        result: of pictures under one distant light each.
        degrees: standard error of each light's direction, root mean square of the angle.

    Raises:
        InputError: where the fit does not determine how its numbers move.
    """
    found = sensitivity(result, lambda scenes: [scene.lights[0].direction for scene in scenes])
    variance: dict[tuple[str, int | None], float] = {}
    for scene, moves, error in zip(result.scenes, found, degrees, strict=True):
        direction = np.asarray(scene.lights[0].direction, np.float64)  # pyright: ignore[reportAttributeAccessIssue]
        # Two small turns of it share the angle; it does not matter how long it is.
        turns = np.linalg.svd(direction[None])[2][1:] * np.linalg.norm(direction) * math.radians(error) / math.sqrt(2)
        for one in result.parameters:
            slope = getattr(moves, one.name)
            slope = slope if one.channel is None else slope[one.channel]
            variance[one.name, one.channel] = variance.get((one.name, one.channel), 0.0) + np.sum((turns @ slope) ** 2)
    parameters = [_widened(one, math.sqrt(variance[one.name, one.channel])) for one in result.parameters]
    return dataclasses.replace(result, parameters=tuple(parameters))


def _widened(one: Parameter, by: float) -> Parameter:
    if one.value is None or one.error is None or one.at_bound or one.interval is None:
        return one
    error = math.hypot(one.error, by)
    if one.name == "n":
        # Its interval need not be even about it: each end moves out by the same factor.
        ends = np.log(np.array(one.interval) / one.value) * error / one.error if one.error else np.zeros(2)
        interval = tuple((one.value * np.exp(ends)).tolist())
    else:
        interval = above_zero(one.value, error)
    return dataclasses.replace(one, error=error, interval=interval)
