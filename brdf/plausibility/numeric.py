"""The three tests of plausibility for a BRDF of which nothing is known but how to call it.

Where the lobes are, and how narrow, has to be found out. Values are taken on a grid of a quarter of a degree over the
hemisphere for several directions of the other vector, both ways round, and around the places where BRDFs have their
peaks (mirror, retro and normal direction, at all scales down to 1e-5 rad). The worst are then improved by a random
search with a fixed seed. For the energy the peaks found announce the lobes to an adaptive quadrature.

What that cannot see: a feature narrower than half a degree in light *and* view at once, away from those places.

The quadrature. The hemisphere is the upper half of a cube seen from its centre: five faces, each cut into squares that
are halved again and again where the function asks for it. Each square is integrated by a Gauss-Legendre product rule; a
square whose integral differs from the sum over its four quarters by more than a tolerance is refined. The sum of those
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
from jaxtyping import Array, Float, Int

from brdf.albedo import gauss_legendre
from brdf.channels import in_channel
from brdf.errors import InputError
from brdf.plausibility.report import ENERGY_LIMIT, GRAZING, RECIPROCITY_LIMIT, Angles, Finding, Report, times, verdict

Pair = tuple[Float[np.ndarray, "m 3"], Float[np.ndarray, "m 3"]]
Evaluate = Callable[[Int[np.ndarray, " m"], Float[np.ndarray, "m 3"]], Float[np.ndarray, "m C"]]

FINEST = 2.0**-13
"""Size of the squares around an announced lobe, about 1e-4 rad: a lobe of n = 1e7 is 3e-4 wide."""

_LOWEST = math.cos(math.radians(GRAZING))
_UP = np.array([0.0, 0.0, 1.0])
_MIRRORED = np.array([-1.0, -1.0, 1.0])  # times a direction: its mirror direction about the normal
_GRID = 2**18  # directions; any cap of 0.25 degree radius holds one
_FIXED = (0.0, 7.0, 20.0, 35.0, 50.0, 65.0, 78.0, 86.0, 89.5)
_BATCH = 2**13  # one size, so one compilation
_COARSE = 1e-5  # tolerance of the quadrature for directions that turn out not to matter
_NODES = 5
_CELLS = 4  # squares along the edge of a face at the start
_DEEPEST = 22  # times a square may be halved


def check_black_box(f_r: Callable[[Any, Any], Any], subject: str) -> Report:
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
    scan = Scan(Sampler(f_r))
    findings = [_positivity(scan), _reciprocity(scan), _energy(scan)]
    if scan.sample.not_finite is not None:
        light, view = map(Angles.of, scan.sample.not_finite)
        words = f"f_r is not a finite number for light {light}, view {view}"
        nan = math.nan
        findings = [Finding("cannot tell", nan, f.limit, nan, nan, light, view, 0, words) for f in findings]
    return Report(subject, *findings)


def albedo_of(f_r: Callable[[Any, Any], Any], polar: Float[np.ndarray, " K"]) -> Float[np.ndarray, "K C"]:
    """Albedo of any BRDF for lights in the plane of azimuth 0, to about 1e-4.

    Args:
        f_r: f_r(to_light, to_view) -> (C,), as for ``check_black_box``.
        polar: angles of the light in degrees, (K,).

    Returns:
        (K, C).
    """
    return _albedos(Scan(Sampler(f_r)), np.array([direction(angle) for angle in polar]), _COARSE)[0]


# -- directions --------------------------------------------------------------------------------------------------------


def direction(polar: float, azimuth: float = 0.0) -> Float[np.ndarray, " 3"]:
    """The unit vector at an angle from the normal and an azimuth, in degrees."""
    polar, azimuth = math.radians(polar), math.radians(azimuth)
    return np.array([math.sin(polar) * math.cos(azimuth), math.sin(polar) * math.sin(azimuth), math.cos(polar)])


def _fibonacci(count: int) -> Float[np.ndarray, "m 3"]:
    """A grid over the hemisphere."""
    index = np.arange(count)
    z = np.maximum((index + 0.5) / count, _LOWEST)
    radius, golden = np.sqrt(1 - z * z), math.pi * (3.0 - math.sqrt(5.0))
    return np.stack([radius * np.cos(golden * index), radius * np.sin(golden * index), z], -1)


def _lifted(vectors: np.ndarray) -> np.ndarray:
    """Unit vectors above the horizon."""
    vectors = vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)
    z = np.maximum(np.abs(vectors[..., 2:]), _LOWEST)
    flat = vectors[..., :2]
    radius = np.linalg.norm(flat, axis=-1, keepdims=True)
    return np.concatenate([flat * (np.sqrt(1 - z * z) / np.where(radius > 0, radius, 1.0)), z], axis=-1)


def _around(centres: Float[np.ndarray, "l 3"]) -> Float[np.ndarray, "l 181 3"]:
    """Each direction, and others around it at all scales."""
    radii, azimuths = np.geomspace(1e-5, 0.3, 15), np.arange(12) * (2 * np.pi / 12)
    first = np.cross(centres, np.where(np.abs(centres[:, 2:]) < 0.9, _UP, np.array([1.0, 0.0, 0.0])))
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    offsets = np.einsum("lk,ra->lrak", first, np.outer(radii, np.cos(azimuths)))
    offsets += np.einsum("lk,ra->lrak", np.cross(centres, first), np.outer(radii, np.sin(azimuths)))
    around = (centres[:, None, None] + offsets).reshape(len(centres), -1, 3)
    return _lifted(np.concatenate([centres[:, None], around], axis=1))


# -- values of f_r, and a first look at them everywhere ----------------------------------------------------------------


class Sampler:
    """A BRDF as a function of arrays, in float64, in batches of one size.

    Attributes:
        channels: how many values it returns.
        epsilon: the rounding of their type.
        not_finite: light and view for which a value was not finite, once there was one.
    """

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
            vector = jax.ShapeDtypeStruct((3,), jnp.float64)
            try:
                result = jax.eval_shape(one, vector, vector)
            except Exception as error:
                reason = str(error).splitlines()[0] if str(error) else type(error).__name__
                came = f"cannot be called with two vectors of JAX: {reason}"
                raise InputError("f_r", came, "Write it with jax.numpy") from error
        if len(result.shape) > 1 or 0 in result.shape or not jnp.issubdtype(result.dtype, jnp.floating):
            raise InputError("f_r", f"must return one real number per channel, got {result.dtype}{list(result.shape)}")
        self.channels = math.prod(result.shape)
        self.epsilon = float(jnp.finfo(result.dtype).eps)
        self.not_finite: Pair | None = None

    def __call__(self, to_light: Float[np.ndarray, "m 3"], to_view: Float[np.ndarray, "m 3"]) -> np.ndarray:
        """Values, (m, C); where they are not finite that is remembered, and 0 stands for them."""
        pairs = np.stack(np.broadcast_arrays(to_light, to_view))
        count = pairs.shape[1]
        batches = np.pad(pairs, ((0, 0), (0, -count % _BATCH), (0, 0)), mode="edge").reshape(2, -1, _BATCH, 3)
        with jax.enable_x64(True):
            parts = [np.asarray(self._batch(light, view), np.float64) for light, view in zip(*batches, strict=True)]
        values = np.concatenate(parts).reshape(-1, self.channels)[:count]
        finite = np.all(np.isfinite(values), axis=1)
        if not np.all(finite):
            self.not_finite = tuple(pairs[:, np.argmin(finite)])
        return np.where(finite[:, None], values, 0.0)


class Scan:
    """A BRDF, and what a first look at it found.

    Attributes:
        sample: the BRDF.
        random: for directions that follow no pattern.
        negative: the most negative pairs of light and view, place by place.
        unequal: the pairs that change most when light and view change places.
        bright: the brightest pairs.
        scale: a typical value of f_r, against which a value is small or large.
    """

    def __init__(self, sample: Sampler):
        """Look everywhere, and closer at the places where BRDFs have their peaks."""
        self.sample, self.random = sample, np.random.default_rng(20)
        self.negative: list[Pair] = []
        self.unequal: list[Pair] = []
        self.bright: list[Pair] = []
        light, view = (self.random.permutation(_fibonacci(2**16)) for _ in range(2))
        self.scale = _typical(sample(light, view), view)
        fixed, grid = np.array([direction(p, 40.0 + 137.5 * i) for i, p in enumerate(_FIXED)]), _fibonacci(_GRID)
        self.scale = float(np.mean([self._look(np.broadcast_to(one, grid.shape), grid, keep=3) for one in fixed]))
        self._look(light, view, keep=12)
        for lights, keep in ((fixed, 24), (_fibonacci(64), 12)):
            views = np.stack([_around(peak) for peak in (lights * _MIRRORED, lights, _UP + 0 * lights)])
            self._look(np.broadcast_to(lights[:, None], views.shape).reshape(-1, 3), views.reshape(-1, 3), keep)

    def _look(self, light: np.ndarray, view: np.ndarray, keep: int) -> float:
        """Take in pairs, both ways round; returns a typical value of f_r among them."""
        there, back = self.sample(light, view), self.sample(view, light)
        for values, pair in ((there, (light, view)), (back, (view, light))):
            self.negative.append(_largest(-values.min(axis=1), pair, keep))
            self.bright.append(_largest((values * pair[1][:, 2:]).max(axis=1), pair, keep))
        self.unequal.append(_largest(self.inequality(there, back).max(axis=1), (light, view), keep))
        return _typical(there, view)

    def inequality(self, there: np.ndarray, back: np.ndarray) -> np.ndarray:
        """Relative difference of values of f_r, from 0 to 2.

        Values below a millionth of the typical one count as that: in the far tails of a lobe there is only rounding.
        """
        return np.abs(there - back) / (np.maximum(np.abs(there), np.abs(back)) + max(1e-6 * self.scale, 1e-300))


def _typical(values: np.ndarray, view: np.ndarray) -> float:
    return float(np.mean(np.abs(values) * view[:, 2:]))


def _largest(score: np.ndarray, pair: Pair, keep: int) -> Pair:
    chosen = np.argpartition(-score, min(keep, len(score) - 1))[:keep]
    chosen = chosen[np.argsort(-score[chosen])]
    return pair[0][chosen], pair[1][chosen]


def _improved(
    scan: Scan,
    score: Callable[[np.ndarray, np.ndarray], np.ndarray],
    pair: Pair,
    *,
    move_light: bool = True,
    rounds: int = 45,
    tries: int = 24,
) -> Pair:
    """The pairs after a random search, each on its own, that widens where it succeeds and narrows where it fails."""
    light, view = pair
    best = score(light, view)
    radius, rows = np.full(len(light), 0.01), np.arange(len(light))
    turn = np.arange(tries)[:, None] % 3  # 0: move both, 1: the view, 2: the light
    for _ in range(rounds):
        step = radius[:, None, None] * scan.random.standard_normal((2, len(light), tries, 3))
        lights = _lifted(light[:, None] + step[0] * (turn != 1)) if move_light else np.repeat(light[:, None], tries, 1)
        views = _lifted(view[:, None] + step[1] * ((turn != 2) | (not move_light)))
        scores = score(lights.reshape(-1, 3), views.reshape(-1, 3)).reshape(-1, tries)
        chosen = np.argmax(scores, axis=1)
        better = scores[rows, chosen] > best
        light = np.where(better[:, None], lights[rows, chosen], light)
        view = np.where(better[:, None], views[rows, chosen], view)
        best = np.where(better, scores[rows, chosen], best)
        radius = np.clip(radius * np.where(better, 1.5, 0.5), 1e-8, 0.5)
    return light, view


def _joined(pairs: list[Pair]) -> Pair:
    return np.concatenate([light for light, _ in pairs]), np.concatenate([view for _, view in pairs])


# -- the three tests ---------------------------------------------------------------------------------------------------


def _worst(
    scan: Scan, function: Callable[[np.ndarray, np.ndarray], np.ndarray], pairs: list[Pair]
) -> tuple[float, float, np.ndarray, np.ndarray, int]:
    """The largest value found of a function of light and view, its error bound, and where: light, view and channel."""
    light, view = _improved(scan, lambda a, b: function(a, b).max(axis=1), _joined(pairs))
    values = function(light, view)
    row, channel = np.unravel_index(np.argmax(values), values.shape)
    light, view = light[row], view[row]
    # Its error is how much it scatters under changes of the directions by a few roundings, which are below real change.
    epsilon = scan.sample.epsilon
    shake = 4 * epsilon * scan.random.standard_normal((2, 64, 3))
    near = function(_lifted(light + shake[0]), _lifted(view + shake[1]))[:, channel]
    bound = 2 * float(np.ptp(near)) + 4 * epsilon * float(np.max(np.abs(near)))
    return float(values[row, channel]), bound, light, view, int(channel)


def _positivity(scan: Scan) -> Finding:
    found, bound, *where, channel = _worst(scan, lambda a, b: -scan.sample(a, b), scan.negative)
    light, view = map(Angles.of, where)
    limit = -1e-9 * scan.scale
    word = verdict(-found - limit, bound)
    sentence = "negative: f_r is" if word == "fail" else "the least f_r is"
    sentence += f" {-found:.4g}/sr for light {light}, view {view}{in_channel(channel, scan.sample.channels)}"
    return Finding(word, -found, limit, -found - limit, bound, light, view, channel, sentence)


def _reciprocity(scan: Scan) -> Finding:
    sample = scan.sample
    value, bound, *where, channel = _worst(scan, lambda a, b: scan.inequality(sample(a, b), sample(b, a)), scan.unequal)
    there, back = (float(sample(a[None], b[None])[0, channel]) for a, b in (where, where[::-1]))
    if abs(there) < abs(back):
        where, there, back = where[::-1], back, there
    light, view = map(Angles.of, where)
    word = verdict(RECIPROCITY_LIMIT - value, bound)
    sentence = f"f_r changes by at most {value:.2g} of its value when light and view change places"
    if word == "fail":
        compared = f"{there:.4g}/sr, but {back:.4g}/sr the other way round"
        if 0 < back < there < 1e4 * back:
            compared = f"{times(there / back)} f_r({view} → {light})"
        sentence = f"not reciprocal: f_r({light} → {view}) is {compared}{in_channel(channel, sample.channels)}"
    return Finding(word, value, RECIPROCITY_LIMIT, RECIPROCITY_LIMIT - value, bound, light, view, channel, sentence)


def _energy(scan: Scan) -> Finding:
    polars = np.array([*np.arange(0, 90, 5.0), 88.0, 89.0, 89.9, *(90.0 - np.geomspace(1e-2, 1e-8, 4))])
    azimuths = np.arange(1 if _isotropic(scan) else 8) * 45.0
    lights = [direction(p, a) for p in polars for a in (azimuths if p else azimuths[:1])]
    lights = np.concatenate([lights, *(light[:1] for light, _ in scan.bright)])
    albedo, bound = _albedos(scan, lights, _COARSE)
    nearby = [(p, 0.0) for p in (-1.0, -0.5, 0.5, 1.0)]
    if len(azimuths) > 1:
        nearby += [(p, a) for p in (-1.0, 0.0, 1.0) for a in (-4.0, -1.5, 1.5, 4.0)]
    for step in (2.5, 0.8, 0.25, 0.08):
        top = Angles.of(lights[np.argmax(albedo.max(axis=1))])
        highest = max(top.polar, GRAZING)
        angles = {(min(max(top.polar + step * p, 0.0), highest), top.azimuth + step * a) for p, a in nearby}
        more = np.array([direction(*pair) for pair in sorted(angles)])
        lights = np.concatenate([lights, more])
        albedo, bound = map(np.concatenate, zip((albedo, bound), _albedos(scan, more, _COARSE), strict=True))
    tolerance = np.full(len(lights), _COARSE)
    for _ in range(60):  # sharpen those that decide, as long as they do not
        row = int(np.argmax(np.max(albedo + bound, axis=1)))
        decided = np.all(albedo + bound <= ENERGY_LIMIT) or np.any(albedo - bound > ENERGY_LIMIT + 1e-3)
        if decided or tolerance[row] < 1e-11:
            break
        tolerance[row] *= 0.02
        (albedo[row],), (bound[row],) = _albedos(scan, lights[row : row + 1], tolerance[row])
    surely = albedo - bound
    score = surely if np.any(surely > ENERGY_LIMIT) else albedo + bound
    row, channel = np.unravel_index(np.argmax(score), score.shape)
    value, error, light = float(albedo[row, channel]), float(bound[row, channel]), Angles.of(lights[row])
    word = verdict(ENERGY_LIMIT - value, error)
    sentence = "does not conserve energy: " if word == "fail" else ""
    sentence += f"the largest albedo is {value:.6g} for light {light}{in_channel(int(channel), scan.sample.channels)}"
    return Finding(word, value, ENERGY_LIMIT, ENERGY_LIMIT - value, error, light, None, int(channel), sentence)


def _isotropic(scan: Scan) -> bool:
    random = [scan.random.permutation(_fibonacci(2048)) for _ in range(2)]
    light, view = _joined([tuple(random), scan.bright[0]])
    there = scan.sample(light, view)
    for angle in (0.7, 2.0, 4.4):
        turn = np.array([[math.cos(angle), -math.sin(angle), 0], [math.sin(angle), math.cos(angle), 0], [0, 0, 1]])
        if scan.inequality(there, scan.sample(light @ turn.T, view @ turn.T)).max() > 1e-5:
            return False
    return True


# -- albedo ------------------------------------------------------------------------------------------------------------


def _albedos(scan: Scan, lights: np.ndarray, tolerance: float) -> tuple[np.ndarray, np.ndarray]:
    """Albedos (K, C) and bounds on their errors, for lights (K, 3)."""

    def evaluate(which: np.ndarray, views: np.ndarray) -> np.ndarray:
        return _seen(scan.sample, lights[which], views)

    budget = 3_000_000 + 60_000 * len(lights)
    value, bound = integrate(evaluate, _peaks(scan, lights), tolerance=tolerance, budget=budget)
    return value, bound + 50 * scan.sample.epsilon * np.abs(value)


def _seen(sample: Sampler, light: np.ndarray, view: np.ndarray) -> np.ndarray:
    return sample(light, view) * view[:, 2:]


def _peaks(scan: Scan, lights: np.ndarray) -> Float[np.ndarray, "K p 3"]:
    """For each light the views where a narrow lobe may sit: the typical places, and the brightest found near by."""
    coarse = _fibonacci(2**12)
    bright_light, bright_view = _joined(scan.bright[:18:2])
    halves = _lifted(bright_light + bright_view)
    mirrored, starts = lights * _MIRRORED, []
    for light, mirror in zip(lights, mirrored, strict=True):
        same_half = 2 * (halves @ light)[:, None] * halves - light
        candidates = np.concatenate([coarse, [mirror, light, _UP], bright_view, same_half[same_half[:, 2] > 0]])
        value = _seen(scan.sample, light[None], candidates).max(axis=1)
        starts.append([*candidates[np.argsort(-value)[:6]], mirror])
    views = np.array(starts)
    pair = np.repeat(lights, views.shape[1], axis=0), views.reshape(-1, 3)

    def brightness(light: np.ndarray, view: np.ndarray) -> np.ndarray:
        return _seen(scan.sample, light, view).max(axis=1)

    _, found = _improved(scan, brightness, pair, move_light=False, rounds=25, tries=12)
    return np.concatenate([found.reshape(views.shape), mirrored[:, None], lights[:, None]], axis=1)


_X, _Y, _Z = np.eye(3)
# Normal of the face, and its two axes. The upper face is whole, the others lack their lower half.
_FACES = np.array([[_Z, _X, _Y], [_X, _Y, _Z], [-_X, _Y, _Z], [_Y, _X, _Z], [-_Y, _X, _Z]])
# Which integral a square belongs to, its face, lower corner and size.
_SQUARE = np.dtype([("of", int), ("face", int), ("corner", float, 2), ("size", float)])


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
    squares = _first_squares(len(centres))
    values = _rule(evaluate, squares)
    total = np.zeros((len(centres), values.shape[1]))
    bound, spent = np.zeros_like(total), len(squares) * _NODES**2
    for _ in range(_DEEPEST):
        if not len(squares):
            break
        quarters = _quarters(squares)
        parts = _rule(evaluate, quarters)
        spent += len(quarters) * _NODES**2
        sums = parts.reshape(4, *values.shape).sum(axis=0)
        differences = np.abs(sums - values)
        refine = np.max(differences, axis=1) > tolerance
        refine |= _announced(squares, centres) & (squares["size"] > FINEST)
        refine &= spent <= budget
        np.add.at(total, squares["of"][~refine], sums[~refine])
        np.add.at(bound, squares["of"][~refine], differences[~refine])
        again = np.tile(refine, 4)
        squares, values = quarters[again], parts[again]
    np.add.at(total, squares["of"], values)
    np.add.at(bound, squares["of"], np.abs(values))
    return total, bound + 1e-15 * _NODES * np.abs(total)


def _first_squares(count: int) -> np.ndarray:
    edges = np.arange(_CELLS) * (2.0 / _CELLS) - 1.0
    grid = [(face, (u, v)) for face in range(5) for u in edges for v in edges if face == 0 or v >= 0]
    squares = np.array([(0, *square, 2.0 / _CELLS) for square in grid] * count, _SQUARE)
    squares["of"] = np.repeat(np.arange(count), len(grid))
    return squares


def _quarters(squares: np.ndarray) -> np.ndarray:
    """The four quarters of each square, quarter by quarter."""
    quarters = np.tile(squares, 4)
    quarters["size"] *= 0.5
    offsets = np.repeat([(0, 0), (0, 1), (1, 0), (1, 1)], len(squares), axis=0)
    quarters["corner"] += quarters["size"][:, None] * offsets
    return quarters


def _rule(evaluate: Evaluate, squares: np.ndarray) -> Float[np.ndarray, "m C"]:
    nodes, weights = gauss_legendre(_NODES)
    u, v = (x.ravel() for x in np.meshgrid(nodes, nodes, indexing="ij"))
    weight = np.outer(weights, weights).ravel()
    size, corner, axes = squares["size"][:, None], squares["corner"], _FACES[squares["face"]][:, None]
    a, b = corner[:, :1] + size * u, corner[:, 1:] + size * v
    directions = axes[:, :, 0] + a[..., None] * axes[:, :, 1] + b[..., None] * axes[:, :, 2]
    length = np.linalg.norm(directions, axis=-1)
    directions /= length[..., None]
    solid_angle = weight * size**2 / length**3
    values = evaluate(np.repeat(squares["of"], len(weight)), directions.reshape(-1, 3))
    return np.einsum("mk,mkc->mc", solid_angle, values.reshape(*solid_angle.shape, -1))


def _announced(squares: np.ndarray, centres: Float[np.ndarray, "K p 3"]) -> np.ndarray:
    """Which squares lie within their own size of one of the centres of their function."""
    local = np.einsum("mij,mpj->mpi", _FACES[squares["face"]], centres[squares["of"]])
    in_front = local[..., 0] > 0.2  # beyond that a centre is on another face, and far from this one
    position = local[..., 1:] / np.where(in_front, local[..., 0], 1.0)[..., None]
    size = squares["size"][:, None, None]
    beyond = np.abs(position - (squares["corner"][:, None] + 0.5 * size)) - 0.5 * size
    return np.any(in_front & np.all(beyond < size, axis=-1), axis=1)
