"""Finding the worst places of a BRDF of which nothing is known but how to call it; see ``black_box`` for the idea."""

import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from brdf.errors import InputError

Pair = tuple[Float[np.ndarray, "m 3"], Float[np.ndarray, "m 3"]]

GRAZING = 89.99
"""The largest angle from the normal, in degrees, that is looked at."""

_LOWEST = math.cos(math.radians(GRAZING))
_GRID = 2**18  # directions; any cap of 0.25 degree radius holds one
_FIXED = (0.0, 7.0, 20.0, 35.0, 50.0, 65.0, 78.0, 86.0, 89.5)
_CHUNKS = (2**12, 2**16)  # two sizes of batches, so two compilations
_GOLDEN = math.pi * (3.0 - math.sqrt(5.0))


class Sampler:
    """A BRDF as a function of arrays, in float64, in batches of few sizes."""

    def __init__(self, f_r: Callable[[Any, Any], Any]):
        """Find out how many channels there are.

        Args:
            f_r: f_r(to_light, to_view) -> (C,) or a scalar, of two vectors (3,).

        Raises:
            InputError: it cannot be traced by JAX, or returns something else.
        """

        def one(to_light: Array, to_view: Array) -> Array:
            return jnp.asarray(f_r(to_light, to_view))

        self._batch = jax.jit(jax.vmap(one))
        with jax.enable_x64(True):
            direction = jax.ShapeDtypeStruct((3,), jnp.float64)
            try:
                result = jax.eval_shape(one, direction, direction)
            except Exception as error:
                reason = str(error).splitlines()[0] if str(error) else type(error).__name__
                raise InputError(
                    "f_r", f"cannot be called with two vectors of JAX: {reason}", "Write it with jax.numpy"
                ) from error
        if len(result.shape) > 1 or 0 in result.shape or not jnp.issubdtype(result.dtype, jnp.floating):
            raise InputError("f_r", f"must return one real number per channel, got {result.dtype}{list(result.shape)}")
        self.channels = result.shape[0] if result.shape else 1
        self.epsilon = float(jnp.finfo(result.dtype).eps)
        self.not_finite: tuple[np.ndarray, np.ndarray] | None = None

    def __call__(self, to_light: Float[np.ndarray, "m 3"], to_view: Float[np.ndarray, "m 3"]) -> np.ndarray:
        """Values, (m, C); where they are not finite that is remembered, and 0 stands for them."""
        to_light, to_view = np.broadcast_arrays(to_light, to_view)
        count = len(to_light)
        values = np.empty((count, self.channels))
        small, large = _CHUNKS
        size = small if count <= 4 * small else large
        with jax.enable_x64(True):
            for start in range(0, count, size):
                light, view = to_light[start : start + size], to_view[start : start + size]
                filled = len(light)
                if filled < size:
                    light, view = (np.concatenate([x, np.tile(x[:1], (size - filled, 1))]) for x in (light, view))
                result = np.asarray(self._batch(light, view), np.float64)
                values[start : start + size] = result.reshape(size, -1)[:filled]
        finite = np.all(np.isfinite(values), axis=1)
        if not np.all(finite):
            first = int(np.argmin(finite))
            self.not_finite = (to_light[first], to_view[first])
            values = np.where(finite[:, None], values, 0.0)
        return values


class Scan:
    """What a first look found.

    Attributes:
        negative: the most negative pairs of light and view, place by place.
        unequal: the pairs that change most when light and view change places.
        bright: the brightest pairs.
        scale: a typical value of f_r, against which a value is small or large.
    """

    def __init__(self, sample: Sampler, random: np.random.Generator):
        """Look everywhere, and closer at the places where BRDFs have their peaks.

        Args:
            sample: the BRDF.
            random: for directions that follow no pattern.
        """
        self.negative: list[Pair] = []
        self.unequal: list[Pair] = []
        self.bright: list[Pair] = []
        anywhere = random.permutation(directions(2**16)), random.permutation(directions(2**16))
        self.scale = _typical(sample(*anywhere), anywhere)
        fixed, grid = (
            np.array([direction(polar, 40.0 + 137.5 * i) for i, polar in enumerate(_FIXED)]),
            directions(_GRID),
        )
        self.scale = float(np.mean([self._look(sample, (light[None], grid), keep=3) for light in fixed]))
        self._look(sample, anywhere, keep=12)
        for lights, keep in ((fixed, 24), (directions(64), 12)):
            around = np.concatenate([_structured(place, lights) for place in ("mirror", "retro", "normal")], axis=1)
            self._look(sample, (around[0], around[1]), keep)

    def _look(self, sample: Sampler, pair: Pair, keep: int) -> float:
        """Take in pairs, both ways round; returns a typical value of f_r among them."""
        to_light, to_view = np.broadcast_arrays(*pair)
        there, back = sample(to_light, to_view), sample(to_view, to_light)
        for values, (light, view) in ((there, (to_light, to_view)), (back, (to_view, to_light))):
            self.negative.append(_best(-values.min(axis=1), (light, view), keep))
            self.bright.append(_best((values * view[:, 2:]).max(axis=1), (light, view), keep))
        self.unequal.append(_best(inequality(there, back, self.scale).max(axis=1), (to_light, to_view), keep))
        return _typical(there, (to_light, to_view))


def inequality(there: np.ndarray, back: np.ndarray, scale: float) -> np.ndarray:
    """Relative difference of values of f_r, from 0 to 2.

    Values below a millionth of the typical one count as that: in the far tails of a lobe there is only rounding.
    """
    return np.abs(there - back) / (np.maximum(np.abs(there), np.abs(back)) + max(1e-6 * scale, 1e-300))


def _typical(values: np.ndarray, pair: Pair) -> float:
    return float(np.mean(np.abs(values) * pair[1][:, 2:]))


def _best(score: np.ndarray, pair: Pair, keep: int) -> Pair:
    chosen = np.argpartition(-score, min(keep, len(score) - 1))[:keep]
    chosen = chosen[np.argsort(-score[chosen])]
    return pair[0][chosen], pair[1][chosen]


def directions(count: int) -> np.ndarray:
    """A Fibonacci grid over the hemisphere."""
    index = np.arange(count)
    z = np.maximum((index + 0.5) / count, _LOWEST)
    radius = np.sqrt(1 - z * z)
    return np.stack([radius * np.cos(_GOLDEN * index), radius * np.sin(_GOLDEN * index), z], -1)


def _structured(place: str, lights: np.ndarray) -> np.ndarray:
    """Pairs (2, m, 3) whose view lies around a typical peak, at all scales."""
    centre = {"mirror": lights * [-1, -1, 1], "retro": lights, "normal": np.array([0.0, 0.0, 1.0]) + 0 * lights}[place]
    radii, azimuths = np.geomspace(1e-5, 0.3, 15), np.arange(12) * (2 * np.pi / 12)
    first, second = _tangents(centre)
    offsets = np.einsum("lk,ra->lrak", first, np.outer(radii, np.cos(azimuths)))
    offsets += np.einsum("lk,ra->lrak", second, np.outer(radii, np.sin(azimuths)))
    views = np.concatenate([centre[:, None], (centre[:, None, None] + offsets).reshape(len(lights), -1, 3)], axis=1)
    return np.stack([np.repeat(lights, views.shape[1], axis=0), lifted(views.reshape(-1, 3))])


def _tangents(directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    helper = np.where(np.abs(directions[:, 2:]) < 0.9, np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0]))
    first = np.cross(directions, helper)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return first, np.cross(directions, first)


def lifted(vectors: np.ndarray) -> np.ndarray:
    """Unit vectors above the horizon."""
    vectors = vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)
    z = np.maximum(np.abs(vectors[..., 2:]), _LOWEST)
    flat = vectors[..., :2]
    radius = np.linalg.norm(flat, axis=-1, keepdims=True)
    return np.concatenate([flat * (np.sqrt(1 - z * z) / np.where(radius > 0, radius, 1.0)), z], axis=-1)


def improved(
    score: Callable[[np.ndarray, np.ndarray], np.ndarray],
    pairs: list[Pair],
    random: np.random.Generator,
    *,
    move_light: bool = True,
    rounds: int = 45,
    tries: int = 24,
) -> Pair:
    """The pairs after a random search, each on its own, that widens where it succeeds and narrows where it fails."""
    light, view = (np.concatenate([pair[side] for pair in pairs]) for side in (0, 1))
    best = score(light, view)
    radius = np.full(len(light), 0.01)
    turn = np.arange(tries)[:, None] % 3  # 0: move both, 1: the view, 2: the light
    moves = (turn != 1, (turn != 2) | (not move_light))
    for _ in range(rounds):
        step = radius[:, None, None] * random.standard_normal((2, len(light), tries, 3))
        lights = lifted(light[:, None] + step[0] * moves[0]) if move_light else np.repeat(light[:, None], tries, axis=1)
        views = lifted(view[:, None] + step[1] * moves[1])
        scores = score(lights.reshape(-1, 3), views.reshape(-1, 3)).reshape(-1, tries)
        chosen = np.argmax(scores, axis=1)
        rows = np.arange(len(light))
        better = scores[rows, chosen] > best
        light = np.where(better[:, None], lights[rows, chosen], light)
        view = np.where(better[:, None], views[rows, chosen], view)
        best = np.where(better, scores[rows, chosen], best)
        radius = np.clip(radius * np.where(better, 1.5, 0.5), 1e-8, 0.5)
    return light, view


def direction(polar: float, azimuth: float) -> Float[np.ndarray, " 3"]:
    """The unit vector at an angle from the normal and an azimuth, in degrees."""
    polar, azimuth = math.radians(polar), math.radians(azimuth)
    return np.array([math.sin(polar) * math.cos(azimuth), math.sin(polar) * math.sin(azimuth), math.cos(polar)])


def degrees(direction: Float[np.ndarray, " 3"]) -> tuple[float, float]:
    """Angle from the normal, and azimuth from 0 to 360, in degrees."""
    x, y, z = (float(c) for c in direction)
    return math.degrees(math.atan2(math.hypot(x, y), z)), math.degrees(math.atan2(y, x)) % 360.0
