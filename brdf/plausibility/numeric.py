"""The three tests of plausibility for a BRDF of which nothing is known but how to call it.

Where the lobes are, and how narrow, has to be found out. Values are taken on a grid of a quarter of a degree over the
hemisphere for several directions of the other vector, both ways round, and where BRDFs have their peaks (mirror, retro
and normal direction). The worst are then improved by a random search at all scales, with a fixed seed. For the energy
the peaks found announce the lobes to an adaptive quadrature.

What that cannot see, away from those places: a feature of light, view or half vector narrower than half a degree, and
one narrower than some ten degrees in light *and* view at once, of which 2^17 random pairs hardly one meets.

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
from brdf.models import Material
from brdf.plausibility.report import (
    ENERGY_LIMIT,
    GRAZING,
    RECIPROCITY_LIMIT,
    Angles,
    Finding,
    Report,
    judged,
    largest,
    times,
)

BRDF = Callable[[Any, Any], Any]
Evaluate = Callable[[Int[np.ndarray, " m"], Float[np.ndarray, "m 3"]], Float[np.ndarray, "m C"]]

FINEST = 2.0**-13
"""Size of the squares around an announced lobe, about 1e-4 rad: a lobe of n = 1e7 is 3e-4 wide."""

_LOWEST = math.cos(math.radians(GRAZING))
MIRRORED = np.array([-1.0, -1.0, 1.0])  # times a direction: its mirror direction about the normal
_TURN = math.pi * (3.0 - math.sqrt(5.0))  # the golden angle: directions that turn by it fill a circle evenly
_GRID = 2**18  # directions; any cap of 0.25 degree radius holds one
_FIXED = np.radians([0.0, 7.0, 20.0, 35.0, 50.0, 65.0, 78.0, 86.0, 89.5])
_KEPT = 12  # pairs of each look at the BRDF, for each test
# Angles of light at which the albedo is taken; where it diverges, it may do so late.
_POLAR = np.radians([*np.arange(0, 90, 2.5), 89.0, 89.9, *(90.0 - np.geomspace(1e-2, 1e-8, 4))])
_BATCH = 2**12  # one size, so one compilation
# Tolerance of the quadrature, and how many values it may take: for all directions, then where that does not decide.
_COARSE, _FINE = (1e-5, 200_000), (1e-10, 3_000_000)
_TOGETHER = 8  # lights whose albedos are refined together: fuller batches
_NODES = 5
_QUARTERS = np.array([(0, 0), (0, 1), (1, 0), (1, 1)])


def check_black_box(brdf: BRDF | Material, subject: str) -> Report:
    """Test positivity, reciprocity and energy conservation of any BRDF; see the module for how.

    Args:
        brdf: f_r(to_light, to_view) -> (C,), in 1/sr, of unit vectors in the local frame whose +z axis is the normal;
            or a material, which has such. It is traced by JAX, or refused, and evaluated in float64 where it lets
            itself be.
        subject: what to call it in the report.
    """
    scan = _Scan(brdf)
    findings = _positivity(scan), _reciprocity(scan), _energy(scan)
    if scan.sample.not_finite is not None:
        light, view = map(Angles.of, scan.sample.not_finite)
        sentence = f"f_r is not a finite number for light {light}, view {view}"
        where = light, view, 0
        findings = (judged(math.nan, finding.limit, math.nan, where, sentence) for finding in findings)
    return Report(subject, *findings, nearest=None)


def albedo_of(brdf: BRDF | Material, polar: Float[np.ndarray, " K"]) -> Float[np.ndarray, "K C"]:
    """Albedo of any BRDF, (K, C), for lights at angles in degrees, (K,), in the plane of azimuth 0, to about 1e-4."""
    return _albedos(_Scan(brdf), from_angles(np.radians(polar), 0.0))[0]


# -- values of f_r, and a first look at them everywhere ----------------------------------------------------------------


def fibonacci(count: int) -> np.ndarray:
    """A grid over the hemisphere."""
    index = np.arange(count)
    return from_angles(np.arccos(np.maximum((index + 0.5) / count, _LOWEST)), _TURN * index)


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def _lifted(vectors: np.ndarray) -> np.ndarray:
    """Unit vectors above the horizon."""
    vectors = _unit(vectors)
    vectors[..., 2] = np.maximum(np.abs(vectors[..., 2]), _LOWEST)
    return _unit(vectors)


class Sampler:
    """A BRDF as a function of arrays, in float64, in batches of one size.

    Attributes:
        channels: how many values it returns.
        epsilon: the rounding of their type.
        not_finite: light and view for which a value was not finite, once there was one.
    """

    def __init__(self, brdf: BRDF | Material):
        """Find out how many channels f_r(to_light, to_view) has: of two vectors (3,) it gives (C,) or a scalar.

        Raises:
            InputError: it cannot be traced by JAX, or returns something else.
        """
        f_r: Any = getattr(brdf, "reflectance", brdf)
        self._batch = jax.jit(jax.vmap(lambda pair: jnp.atleast_1d(f_r(*pair))))
        with jax.enable_x64(True):
            try:
                result = jax.eval_shape(self._batch, jax.ShapeDtypeStruct((1, 2, 3), jnp.float64))
            except Exception as error:
                reason = str(error).splitlines()[0] if str(error) else type(error).__name__
                what = f"cannot be called with two vectors of JAX: {reason}"
                raise InputError("f_r", what, "Write it with jax.numpy") from error
        _, *shape = result.shape
        if len(shape) > 1 or 0 in shape or not jnp.issubdtype(result.dtype, jnp.floating):
            raise InputError("f_r", f"must return one real number per channel, got {result.dtype}{shape}")
        (self.channels,) = shape
        self.epsilon = float(jnp.finfo(result.dtype).eps)
        self.not_finite: np.ndarray | None = None

    def __call__(self, to_light: np.ndarray, to_view: np.ndarray) -> Float[np.ndarray, "m C"]:
        """Values for directions (m, 3); where they are not finite that is remembered, and 0 stands for them."""
        pairs = np.stack(np.broadcast_arrays(to_light, to_view), axis=1)
        whole = np.pad(pairs, np.array([(0, -len(pairs) % _BATCH), (0, 0), (0, 0)]), mode="edge")
        with jax.enable_x64(True):
            # Channel after channel: what is compared are channels of many pairs.
            values = [np.asarray(self._batch(batch)).T for batch in whole.reshape(-1, _BATCH, 2, 3)]
        found = np.concatenate(values, axis=1)[:, : len(pairs)].T
        finite = np.isfinite(found).all(axis=1)
        if not finite.all():
            self.not_finite = pairs[np.argmin(finite)]
            found[~finite] = 0.0
        return found


class _Scan:
    """A BRDF, and what a first look at it found: pairs of light and view, (2, m, 3), ``_KEPT`` of each look.

    Attributes:
        sample: the BRDF.
        random: for directions that follow no pattern.
        scale: a typical value of f_r (N.V), against which a value is small or large.
        negative: the most negative pairs.
        unequal: the pairs that change most when light and view change places.
        bright: the brightest pairs, moved to where it is brightest around them.
    """

    def __init__(self, brdf: BRDF | Material):
        self.sample, self.random = Sampler(brdf), np.random.default_rng(20)
        light, view = (self.random.permutation(fibonacci(2**16)) for _ in range(2))
        self.scale = float(np.mean(np.abs(self.seen(light, view))))
        fixed, grid = from_angles(_FIXED, _TURN * np.arange(len(_FIXED))), fibonacci(_GRID)
        lights = np.concatenate([fixed, fibonacci(64)])
        looks = [(light, view), *((one, grid) for one in fixed)]
        looks += [(lights, peaks) for peaks in (lights * MIRRORED, lights, np.array([0.0, 0.0, 1.0]))]
        self.negative, self.unequal, bright = np.concatenate([self._look(*look) for look in looks], axis=2)
        self.bright = self.improved(lambda *pair: self.seen(*pair).max(axis=1), bright)

    def _look(self, light: np.ndarray, view: np.ndarray) -> np.ndarray:
        """The most negative, most unequal and brightest among some pairs, taken both ways round."""
        light, view = np.broadcast_arrays(light, view)
        pairs = np.stack([np.concatenate([light, view]), np.concatenate([view, light])])
        values = self.sample(*pairs)
        unequal = self.inequality(values, np.roll(values, len(light), axis=0))
        scores = (score.max(axis=1) for score in (-values, unequal, values * pairs[1, :, 2:]))
        return np.stack([pairs[:, np.argpartition(-score, _KEPT)[:_KEPT]] for score in scores])

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

        It moves some of them, and widens where it succeeds, narrows where it fails.
        """
        best, radius, each = score(*vectors), np.full(vectors.shape[1], 0.01), np.arange(vectors.shape[1])
        for _ in range(rounds):
            shape = *vectors.shape[:2], tries
            moves = radius[:, None] * (self.random.random(shape) < 0.6)
            tried = _lifted(vectors[:, :, None] + moves[..., None] * self.random.standard_normal((*shape, 3)))
            scores = score(*tried.reshape(len(vectors), -1, 3)).reshape(-1, tries)
            chosen = np.argmax(scores, axis=1)
            better = scores[each, chosen] > best
            vectors = np.where(better[:, None], tried[:, each, chosen], vectors)
            best = np.maximum(best, scores[each, chosen])
            radius = np.clip(radius * np.where(better, 1.5, 0.5), 1e-8, 0.5)
        return vectors


# -- the three tests ---------------------------------------------------------------------------------------------------


def _worst(scan: _Scan, function: Callable[..., np.ndarray], pairs: np.ndarray) -> tuple[float, float, np.ndarray, int]:
    """The largest value found of a function of light and view, its error bound, and where: the pair and channel."""
    found = scan.improved(lambda *pair: function(*pair).max(axis=1), pairs)
    values = function(*found)
    row, channel = largest(values)
    # Its error is how much it scatters under changes of the directions by a few roundings, which are below real change.
    epsilon = scan.sample.epsilon
    shaken = found[:, row, None] + 4 * epsilon * scan.random.standard_normal((2, 64, 3))
    near = function(*_lifted(shaken))[:, channel]
    bound = 2 * float(np.ptp(near)) + 4 * epsilon * float(np.max(np.abs(near)))
    return float(values[row, channel]), bound, found[:, row], channel


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
    failed = f"not reciprocal: f_r({light} → {view}) is {compared}{in_channel(channel, scan.sample.channels)}"
    return judged(value, RECIPROCITY_LIMIT, bound, (light, view, channel), passed, failed)


def _energy(scan: _Scan) -> Finding:
    # the lowest along an axis of the quadrature's square, which is halved less often there
    lights = from_angles(_POLAR, 0.75 * np.pi * np.arange(len(_POLAR)) * (_POLAR < _FIXED[-1]))
    lights = np.concatenate([lights, scan.bright[0, :: 4 * _KEPT]])
    known = _albedos(scan, lights)
    top = lights[np.argmax(known[0].max(axis=1))]
    (found,) = scan.improved(lambda tried: _albedos(scan, tried)[0].max(axis=1), top[None, None], rounds=10, tries=6)
    lights, (albedo, bound) = np.append(lights, found, axis=0), np.append(known, _albedos(scan, found), axis=1)
    score = albedo - bound
    if np.all(score <= ENERGY_LIMIT):
        for row in np.flatnonzero(np.any(albedo + bound > ENERGY_LIMIT, axis=1)):
            (albedo[row],), (bound[row],) = _albedos(scan, lights[[row]], *_FINE)
        score = albedo + bound
    row, channel = largest(score)
    value, light = float(albedo[row, channel]), Angles.of(lights[row])
    words = f"the largest albedo is {value:.7g} for light {light}{in_channel(channel, scan.sample.channels)}"
    where, failed = (light, None, channel), f"does not conserve energy: {words}"
    return judged(value, ENERGY_LIMIT, float(bound[row, channel]), where, words, failed)


# -- albedo ------------------------------------------------------------------------------------------------------------


def _albedos(
    scan: _Scan, lights: Float[np.ndarray, "K 3"], tolerance: float = _COARSE[0], budget: int = _COARSE[1]
) -> Float[np.ndarray, "2 K C"]:
    """Albedos for some lights, and bounds on their errors."""
    groups = (lights[first : first + _TOGETHER] for first in range(0, len(lights), _TOGETHER))
    return np.concatenate([_albedos_together(scan, some, tolerance, budget) for some in groups], axis=1)


def _albedos_together(scan: _Scan, lights: np.ndarray, tolerance: float, budget: int) -> np.ndarray:
    # A narrow lobe may sit where it is bright for other lights, too: about the same view or the same half vector.
    halves = _lifted(scan.bright.sum(axis=0))
    same_half = _lifted(2 * (lights @ halves.T)[..., None] * halves - lights[:, None])
    others = np.concatenate([scan.bright[1], fibonacci(3500)])
    views = np.concatenate([same_half, np.broadcast_to(others, (len(lights), *others.shape))], axis=1)
    seen = scan.seen(np.repeat(lights, views.shape[1], axis=0), views.reshape(-1, 3))
    brightest = np.argsort(seen.max(axis=1).reshape(len(lights), -1))[:, -5:, None]
    centres = [np.take_along_axis(views, brightest, axis=1), np.stack([lights * MIRRORED, lights], axis=1)]
    value, bound = integrate(
        lambda which, views: scan.seen(lights[which], views), np.concatenate(centres, axis=1), tolerance, budget
    )
    return np.stack([value, bound + 50 * scan.sample.epsilon * np.abs(value)])


def integrate(
    evaluate: Evaluate, centres: Float[np.ndarray, "K p 3"], tolerance: float, budget: int
) -> tuple[Float[np.ndarray, "K C"], Float[np.ndarray, "K C"]]:
    """Integrals of some functions over the hemisphere about +z.

    Args:
        evaluate: called with which function, (m,), and directions, (m, 3); returns values, (m, C).
        centres: of each function the directions (unit vectors) around which it may have narrow lobes.
        tolerance: the difference at which a square is refined no more.
        budget: the number of values of a function after which its refinement stops.

    Returns:
        The integrals, with bounds that also cover whatever the budget left unrefined.
    """
    size = 0.25
    edges, count = np.arange(-1, 1, size), len(centres)
    corner = np.tile(np.stack(np.meshgrid(edges, edges), axis=-1).reshape(-1, 2), (count, 1))
    which = np.repeat(np.arange(count), len(corner) // count)
    values = _rule(evaluate, which, corner, size)
    total, bound, left = np.zeros((count, values.shape[1])), np.zeros((count, values.shape[1])), np.full(count, budget)
    while len(corner):
        holds, size = _holds(centres[which], corner, size), 0.5 * size
        corner, whose = (corner[:, None] + size * _QUARTERS).reshape(-1, 2), np.repeat(which, 4)
        parts = _rule(evaluate, whose, corner, size)
        left -= np.bincount(whose, minlength=count) * _NODES**2
        sums = parts.reshape(len(which), 4, -1).sum(axis=1)
        differences = np.abs(sums - values)
        refine = ((np.max(differences, axis=1) > tolerance) | holds) & (left >= 0)[which]
        np.add.at(total, which[~refine], sums[~refine])
        np.add.at(bound, which[~refine], differences[~refine])
        again = np.repeat(refine, 4)
        corner, which, values = corner[again], whose[again], parts[again]
    return total, bound + 1e-15 * _NODES * np.abs(total)


def _holds(centres: np.ndarray, corner: np.ndarray, size: float) -> np.ndarray:
    """Whether squares that are not the finest hold one of their centres, (m, p, 3), or are beside one that does."""
    middle, _ = _from_square(*(corner.T + 0.5 * size))
    # the map stretches by 0.7 to 2
    return (np.min(np.linalg.norm(middle[:, None] - centres, axis=2), axis=1) < 2 * size) & (size > FINEST)


def _rule(evaluate: Evaluate, which: np.ndarray, corner: np.ndarray, size: float) -> np.ndarray:
    """Integrals over squares, (m, C)."""
    nodes, weights = gauss_legendre(_NODES)
    u, v = corner[:, 0, None, None] + size * nodes[:, None], corner[:, 1, None, None] + size * nodes
    directions, solid_angle = _from_square(u, v)
    weight = size**2 * solid_angle * np.outer(weights, weights)
    values = evaluate(np.repeat(which, _NODES**2), directions.reshape(-1, 3))
    return np.einsum("muv,muvc->mc", weight, values.reshape(*weight.shape, -1))


def _from_square(u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Directions of the hemisphere, and solid angle over area, of points of [-1, 1]^2.

    The elliptical map to the disc, then Lambert's equal-area map: smooth up to the horizon.
    """
    a, b = np.sqrt(1 - 0.5 * v * v), np.sqrt(1 - 0.5 * u * u)
    z = (1 - u * u) * (1 - v * v)
    stretch = np.sqrt(1 + z)
    return np.stack([u * a * stretch, v * b * stretch, z], axis=-1), (2 - u * u - v * v) / (a * b)
