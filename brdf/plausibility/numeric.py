"""The three tests of plausibility for a BRDF of which nothing is known but how to call it.

Where the lobes are, and how narrow, has to be found out. Values are taken on a grid of a quarter of a degree over the
hemisphere for several directions of the other vector, both ways round, and around the places where BRDFs have their
peaks (mirror, retro and normal direction, at all scales down to 1e-5 rad). The worst are then improved by a random
search with a fixed seed. For the energy the peaks found announce the lobes to an adaptive quadrature.

What that cannot see: a feature narrower than half a degree in light *and* view at once, away from those places.

The quadrature. A smooth map carries the square [-1, 1]^2 to the hemisphere. It is cut into small ones, which are
halved again and again where the function asks for it. Each is integrated by a Gauss-Legendre product rule; a square
whose integral differs from the sum over its four quarters by more than a tolerance is refined. The sum of those
differences bounds the error, far on the safe side where the function is smooth: it is the error of the coarser rule.
A rule sees only what its nodes see, so squares around an announced lobe are refined down to ``FINEST`` before any
difference is believed.
"""

import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from brdf.albedo import gauss_legendre
from brdf.channels import in_channel
from brdf.errors import InputError
from brdf.measured.table import from_angles
from brdf.plausibility.report import ENERGY_LIMIT, GRAZING, RECIPROCITY_LIMIT, Angles, Finding, Report, judged, times

BRDF = Callable[[Any, Any], Any]
Evaluate = Callable[[Int[np.ndarray, " m"], Float[np.ndarray, "m 3"]], Float[np.ndarray, "m C"]]

FINEST = 2.0**-13
"""Size of the squares around an announced lobe, about 1e-4 rad: a lobe of n = 1e7 is 3e-4 wide."""

_LOWEST = math.cos(math.radians(GRAZING))
_UP = np.array([0.0, 0.0, 1.0])
_MIRRORED = np.array([-1.0, -1.0, 1.0])  # times a direction: its mirror direction about the normal
_TURN = math.pi * (3.0 - math.sqrt(5.0))  # the golden angle: directions that turn by it fill a circle evenly
_GRID = 2**18  # directions; any cap of 0.25 degree radius holds one
_FIXED = np.radians([0.0, 7.0, 20.0, 35.0, 50.0, 65.0, 78.0, 86.0, 89.5])
# Angles of light at which the albedo is taken; where it diverges, it may do so late.
_POLAR = np.radians([*np.arange(0, 90, 2.5), 89.0, 89.9, *(90.0 - np.geomspace(1e-2, 1e-8, 4))])
_BATCH = 2**13  # one size, so one compilation
_COARSE = 1e-5  # tolerance of the quadrature for directions that turn out not to matter
_NODES = 5
_QUARTERS = np.array([(0, 0), (0, 1), (1, 0), (1, 1)])
_SMALLEST = 2.0**-32  # of any square


def check_black_box(f_r: BRDF, subject: str) -> Report:
    """Test positivity, reciprocity and energy conservation of any BRDF; see the module for how.

    Args:
        f_r: f_r(to_light, to_view) -> (C,), in 1/sr, of unit vectors in the local frame whose +z axis is the normal.
            It is traced by JAX and evaluated in float64 where it lets itself be.
        subject: what to call it in the report.

    Returns:
        The report.

    Raises:
        InputError: f_r cannot be traced or does not return one number per channel.
    """
    scan = _Scan(f_r)
    findings = [_positivity(scan), _reciprocity(scan), _energy(scan)]
    if scan.sample.not_finite is not None:
        light, view = map(Angles.of, scan.sample.not_finite)
        sentence = f"f_r is not a finite number for light {light}, view {view}"
        findings = [judged(math.nan, f.limit, math.nan, (light, view, 0), sentence) for f in findings]
    return Report(subject, *findings)


def albedo_of(f_r: BRDF, polar: Float[np.ndarray, " K"]) -> Float[np.ndarray, "K C"]:
    """Albedo of any BRDF for lights in the plane of azimuth 0, to about 1e-4.

    Args:
        f_r: f_r(to_light, to_view) -> (C,), as for ``check_black_box``.
        polar: angles of the light in degrees, (K,).

    Returns:
        (K, C).
    """
    return _albedos(_Scan(f_r), from_angles(np.radians(polar), 0.0), _COARSE)[0]


# -- values of f_r, and a first look at them everywhere ----------------------------------------------------------------


def _fibonacci(count: int) -> np.ndarray:
    """A grid over the hemisphere."""
    index = np.arange(count)
    return from_angles(np.arccos(np.maximum((index + 0.5) / count, _LOWEST)), _TURN * index)


def _lifted(vectors: np.ndarray) -> np.ndarray:
    """Unit vectors above the horizon."""
    vectors = vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)
    vectors[..., 2] = np.maximum(np.abs(vectors[..., 2]), _LOWEST)
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


class Sampler:
    """A BRDF as a function of arrays, in float64, in batches of one size.

    Attributes:
        channels: how many values it returns.
        epsilon: the rounding of their type.
        not_finite: light and view for which a value was not finite, once there was one.
    """

    def __init__(self, f_r: BRDF):
        """Find out how many channels there are.

        Args:
            f_r: f_r(to_light, to_view) -> (C,) or a scalar, of two vectors (3,).

        Raises:
            InputError: it cannot be traced by JAX, or returns something else.
        """
        self._batch = jax.jit(jax.vmap(lambda to_light, to_view: jnp.atleast_1d(f_r(to_light, to_view))))
        with jax.enable_x64(True):
            vectors = jax.ShapeDtypeStruct((1, 3), jnp.float64)
            try:
                result = jax.eval_shape(self._batch, vectors, vectors)
            except Exception as error:
                reason = str(error).splitlines()[0] if str(error) else type(error).__name__
                came = f"cannot be called with two vectors of JAX: {reason}"
                raise InputError("f_r", came, "Write it with jax.numpy") from error
        _, *shape = result.shape
        if len(shape) > 1 or 0 in shape or not jnp.issubdtype(result.dtype, jnp.floating):
            raise InputError("f_r", f"must return one real number per channel, got {result.dtype}{shape}")
        (self.channels,) = shape
        self.epsilon = float(jnp.finfo(result.dtype).eps)
        self.not_finite: np.ndarray | None = None

    def __call__(self, to_light: Float[np.ndarray, "m 3"], to_view: Float[np.ndarray, "m 3"]) -> np.ndarray:
        """Values, (m, C); where they are not finite that is remembered, and 0 stands for them."""
        both = np.broadcast_arrays(to_light, to_view)
        count = len(both[0])
        values = np.empty((self.channels, count)).T  # channel by channel: what is compared are channels of many pairs
        with jax.enable_x64(True):
            for first in range(0, count, _BATCH):
                some = [vectors[first : first + _BATCH] for vectors in both]
                missing = np.array([(0, _BATCH - len(some[0])), (0, 0)])
                found = self._batch(*(np.pad(part, missing, mode="edge") if missing.any() else part for part in some))
                values[first : first + _BATCH] = np.asarray(found)[: len(some[0])]
        finite = np.isfinite(values)
        if not finite.all():
            good = np.all(finite, axis=1)
            self.not_finite = np.stack([vectors[np.argmin(good)] for vectors in both])
            values[~good] = 0.0
        return values


class _Scan:
    """A BRDF, and what a first look at it found; pairs of light and view are of shape (2, m, 3).

    Attributes:
        sample: the BRDF.
        random: for directions that follow no pattern.
        negative: the most negative pairs, look by look, worst first.
        unequal: the pairs that change most when light and view change places.
        bright: the brightest pairs.
        scale: a typical value of f_r, against which a value is small or large.
    """

    def __init__(self, f_r: BRDF):
        self.sample, self.random = Sampler(f_r), np.random.default_rng(20)
        self.negative, self.unequal, self.bright = self._found = [], [], []
        light, view = (self.random.permutation(_fibonacci(2**16)) for _ in range(2))
        self.scale = float(np.mean(np.abs(self.seen(light, view))))
        fixed, grid = from_angles(_FIXED, _TURN * np.arange(len(_FIXED))), _fibonacci(_GRID)
        self.scale = float(np.mean([self._look(one + 0 * grid, grid, keep=6) for one in fixed]))
        self._look(light, view, keep=24)
        lights = np.concatenate([fixed, _fibonacci(64)])[:, None]
        scales = np.append(0.0, np.geomspace(1e-5, 0.3, 180))[:, None]
        for peaks in (lights * _MIRRORED, lights, _UP + 0 * lights):
            views = _lifted(peaks + scales * self.random.standard_normal((len(peaks), len(scales), 3)))
            self._look((lights + 0 * views).reshape(-1, 3), views.reshape(-1, 3), keep=24)

    def _look(self, light: np.ndarray, view: np.ndarray, keep: int) -> float:
        """Take in pairs, both ways round; returns a typical value of f_r among them."""
        pairs = np.stack([np.concatenate([light, view]), np.concatenate([view, light])])
        values = self.sample(*pairs)
        seen = values * pairs[1, :, 2:]
        unequal = self.inequality(values, np.roll(values, len(light), axis=0))
        for found, scores in zip(self._found, (-values, unequal, seen), strict=True):
            score = scores.max(axis=1)
            best = np.argpartition(-score, keep)[:keep]
            found.append(pairs[:, best[np.argsort(-score[best])]])
        return float(np.mean(np.abs(seen)))

    def seen(self, light: np.ndarray, view: np.ndarray) -> np.ndarray:
        """f_r (N.V)."""
        return self.sample(light, view) * view[:, 2:]

    def inequality(self, there: np.ndarray, back: np.ndarray) -> np.ndarray:
        """Relative difference of values of f_r, from 0 to 2.

        Values below a millionth of the typical one count as that: in the far tails of a lobe there is only rounding.
        """
        return np.abs(there - back) / (np.maximum(np.abs(there), np.abs(back)) + max(1e-6 * self.scale, 1e-300))

    def improved(self, score: Callable[..., Any], vectors: np.ndarray, rounds: int = 45, tries: int = 24) -> np.ndarray:
        """The one or two directions, (1 or 2, m, 3), of larger score after a random search from each of the m.

        It moves both or one of them, and widens where it succeeds, narrows where it fails.
        """
        best, radius = score(*vectors), np.full(vectors.shape[1], 0.01)
        turn, own = np.arange(tries) % (len(vectors) + 1), np.arange(len(vectors))[:, None] + 1
        moves = ((turn == 0) | (turn == own))[:, None, :, None]
        for _ in range(rounds):
            step = radius[:, None, None] * self.random.standard_normal((*vectors.shape[:2], tries, 3))
            tried = _lifted(vectors[:, :, None] + moves * step)
            scores = score(*tried.reshape(len(vectors), -1, 3)).reshape(-1, tries)
            largest, chosen = np.max(scores, axis=1), np.argmax(scores, axis=1)
            better = largest > best
            vectors = np.where(better[:, None], tried[:, np.arange(len(best)), chosen], vectors)
            best = np.maximum(best, largest)
            radius = np.clip(radius * np.where(better, 1.5, 0.5), 1e-8, 0.5)
        return vectors


# -- the three tests ---------------------------------------------------------------------------------------------------


def _worst(
    scan: _Scan, function: Callable[..., np.ndarray], pairs: list[np.ndarray]
) -> tuple[float, float, np.ndarray, int]:
    """The largest value found of a function of light and view, its error bound, and where: the pair and channel."""
    found = scan.improved(lambda *pair: function(*pair).max(axis=1), np.concatenate(pairs, axis=1))
    values = function(*found)
    row, channel = np.unravel_index(np.argmax(values), values.shape)
    pair = found[:, row]
    # Its error is how much it scatters under changes of the directions by a few roundings, which are below real change.
    epsilon = scan.sample.epsilon
    shaken = pair[:, None] + 4 * epsilon * scan.random.standard_normal((2, 64, 3))
    near = function(*_lifted(shaken))[:, channel]
    bound = 2 * float(np.ptp(near)) + 4 * epsilon * float(np.max(np.abs(near)))
    return float(values[row, channel]), bound, pair, int(channel)


def _positivity(scan: _Scan) -> Finding:
    found, bound, pair, channel = _worst(scan, lambda a, b: -scan.sample(a, b), scan.negative)
    light, view = map(Angles.of, pair)
    words = f"f_r is {-found:.4g}/sr for light {light}, view {view}{in_channel(channel, scan.sample.channels)}"
    where = light, view, channel
    return judged(-found, -1e-9 * scan.scale, bound, where, f"the least {words}", f"negative: {words}", least=True)


def _reciprocity(scan: _Scan) -> Finding:
    sample = scan.sample
    value, bound, pair, channel = _worst(scan, lambda a, b: scan.inequality(sample(a, b), sample(b, a)), scan.unequal)
    both = sample(pair, pair[::-1])[:, channel]
    if abs(both[0]) < abs(both[1]):
        both, pair = both[::-1], pair[::-1]
    (there, back), (light, view) = map(float, both), map(Angles.of, pair)
    passed = f"f_r changes by at most {value:.2g} of its value when light and view change places"
    compared = f"{there:.4g}/sr, but {back:.4g}/sr the other way round"
    if 0 < back < there < 1e4 * back:
        compared = f"{times(there / back)} f_r({view} → {light})"
    failed = f"not reciprocal: f_r({light} → {view}) is {compared}{in_channel(channel, sample.channels)}"
    return judged(value, RECIPROCITY_LIMIT, bound, (light, view, channel), passed, failed)


def _energy(scan: _Scan) -> Finding:
    # the lowest along an axis of the quadrature's square, which is halved less often there
    lights = from_angles(_POLAR, 0.75 * np.pi * np.arange(len(_POLAR)) * (_POLAR < _FIXED[-1]))
    lights = np.concatenate([lights, *(light[:1] for light, _ in scan.bright)])
    found = _albedos(scan, lights)
    top = lights[np.argmax(found[0].max(axis=1))]
    better = scan.improved(lambda tried: _albedos(scan, tried)[0].max(axis=1), top[None, None], rounds=10, tries=6)[0]
    lights = np.append(lights, better, axis=0)
    albedo, bound = found = np.append(found, _albedos(scan, better), axis=1)
    tolerance = np.full(len(lights), _COARSE)
    for _ in range(60):  # sharpen those that decide, as long as they do not
        row = np.argmax(np.max(albedo + bound, axis=1))
        decided = np.all(albedo + bound <= ENERGY_LIMIT) or np.any(albedo - bound > ENERGY_LIMIT + 1e-3)
        if decided or tolerance[row] < 1e-11:
            break
        tolerance[row] *= 0.02
        found[:, [row]] = _albedos(scan, lights[[row]], tolerance[row])
    score = albedo - bound
    if np.all(score <= ENERGY_LIMIT):
        score = albedo + bound
    row, channel = map(int, np.unravel_index(np.argmax(score), score.shape))
    value, light = float(albedo[row, channel]), Angles.of(lights[row])
    words = f"the largest albedo is {value:.6g} for light {light}{in_channel(channel, scan.sample.channels)}"
    where, failed = (light, None, channel), f"does not conserve energy: {words}"
    return judged(value, ENERGY_LIMIT, float(bound[row, channel]), where, words, failed)


# -- albedo ------------------------------------------------------------------------------------------------------------


def _albedos(scan: _Scan, lights: np.ndarray, tolerance: float = _COARSE) -> np.ndarray:
    """Albedos and bounds on their errors, (2, K, C), for lights (K, 3)."""
    value, bound = integrate(
        lambda which, views: scan.seen(lights[which], views),
        _peaks(scan, lights),
        tolerance=tolerance,
        budget=3_000_000 + 60_000 * len(lights),
    )
    return np.stack([value, bound + 50 * scan.sample.epsilon * np.abs(value)])


def _peaks(scan: _Scan, lights: np.ndarray) -> np.ndarray:
    """For each light the views where a narrow lobe may sit, (K, p, 3): typical places, the brightest found near by."""
    coarse = _fibonacci(2**12)
    bright_light, bright_view = np.concatenate([pairs[:, :3] for pairs in scan.bright], axis=1)
    halves = _lifted(bright_light + bright_view)
    mirrored, starts = lights * _MIRRORED, []
    for light, mirror in zip(lights, mirrored, strict=True):
        same_half = _lifted(2 * (halves @ light)[:, None] * halves - light)
        candidates = np.concatenate([coarse, bright_view, same_half])
        value = scan.seen(light, candidates).max(axis=1)
        starts.append([*candidates[np.argsort(-value)[:5]], mirror])

    def brightness(views):
        return scan.seen(np.repeat(lights, len(views) // len(lights), axis=0), views).max(axis=1)

    views = np.array(starts)
    found = scan.improved(brightness, views.reshape(1, -1, 3), rounds=25, tries=12)
    return np.concatenate([found.reshape(views.shape), mirrored[:, None], lights[:, None]], axis=1)


def integrate(
    evaluate: Evaluate, centres: Float[np.ndarray, "K p 3"], *, tolerance: float, budget: int
) -> tuple[Float[np.ndarray, "K C"], Float[np.ndarray, "K C"]]:
    """Integrals of several functions over the hemisphere about +z.

    Args:
        evaluate: called with which function, (m,), and directions, (m, 3); returns values, (m, C).
        centres: for each of the K functions the directions (unit vectors) around which it may have narrow lobes.
        tolerance: the difference at which a square is refined no more.
        budget: the number of function values after which refinement stops.

    Returns:
        The integrals, with bounds that also cover whatever the budget left unrefined.
    """
    size = 0.25
    edges = np.arange(-1, 1, size)
    grid = np.stack(np.meshgrid(edges, edges), axis=-1).reshape(-1, 2)
    of, corner = np.repeat(np.arange(len(centres)), len(grid)), np.tile(grid, (len(centres), 1))
    values = _rule(evaluate, of, corner, size)
    total = np.zeros((len(centres), values.shape[1]))
    bound = np.zeros_like(total)
    while len(of):
        middle, _ = _from_square(*(corner.T + 0.5 * size))
        # the map stretches by 0.7 to 2: at least the square that holds the centre, and those around it
        announced = np.min(np.linalg.norm(middle[:, None] - centres[of], axis=2), axis=1) < 2 * size
        size *= 0.5
        quarters = corner[:, None] + size * _QUARTERS
        parts = _rule(evaluate, np.repeat(of, 4), quarters.reshape(-1, 2), size).reshape(len(of), 4, -1)
        sums = parts.sum(axis=1)
        differences = np.abs(sums - values)
        budget -= 4 * len(of) * _NODES**2
        refine = (np.max(differences, axis=1) > tolerance) | announced & (size >= FINEST)
        refine &= (budget >= 0) & (size > _SMALLEST)
        np.add.at(total, of[~refine], sums[~refine])
        np.add.at(bound, of[~refine], differences[~refine])
        of, corner = np.repeat(of[refine], 4), quarters[refine].reshape(-1, 2)
        values = parts[refine].reshape(-1, total.shape[1])
    return total, bound + 1e-15 * _NODES * np.abs(total)


def _rule(evaluate: Evaluate, of: np.ndarray, corner: np.ndarray, size: float) -> np.ndarray:
    """Integrals over squares, (m, C)."""
    nodes, weights = gauss_legendre(_NODES)
    u, v = corner[:, 0, None, None] + size * nodes[:, None], corner[:, 1, None, None] + size * nodes
    directions, solid_angle = _from_square(u, v)
    values = evaluate(np.repeat(of, _NODES**2), directions.reshape(-1, 3))
    weight = size**2 * solid_angle * np.outer(weights, weights)
    return np.einsum("muv,muvc->mc", weight, values.reshape(*weight.shape, -1))


def _from_square(u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Directions of the hemisphere, and solid angle over area, of points of [-1, 1]^2.

    The elliptical map to the disc, then Lambert's equal-area map: smooth up to the horizon.
    """
    a, b = np.sqrt(1 - 0.5 * v * v), np.sqrt(1 - 0.5 * u * u)
    z = (1 - u * u) * (1 - v * v)
    stretch = np.sqrt(1 + z)
    return np.stack([u * a * stretch, v * b * stretch, z], axis=-1), (2 - u * u - v * v) / (a * b)
