"""The three tests of plausibility for a BRDF of which nothing is known but how to call it.

Where the lobes are, and how narrow, has to be found out. Values are taken on a grid of a quarter of a degree over the
hemisphere for several directions of the other vector, both ways round, and around the places where BRDFs have their
peaks (mirror, retro and normal direction, at all scales down to 1e-5 rad). The worst are then improved by a random
search with a fixed seed. For the energy the peaks found announce the lobes to the adaptive quadrature.

What that cannot see: a feature narrower than half a degree in light *and* view at once, away from those places.

Integrals over the hemisphere of any function, with a bound on their error.

The hemisphere is the upper half of a cube seen from its centre: five faces, each cut into squares that are halved again
and again where the function asks for it. Each square is integrated by a Gauss-Legendre product rule; a square whose
integral differs from the sum over its four quarters by more than a tolerance is refined. The sum of those differences
bounds the error, far on the safe side where the function is smooth: it is the error of the coarser rule.

A rule sees only what its nodes see. A narrow lobe must therefore be announced by its centre: squares around it are
refined down to ``FINEST`` before any difference is believed.
"""

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from brdf.channels import in_channel
from brdf.errors import InputError
from brdf.plausibility.report import (
    ENERGY_LIMIT,
    RECIPROCITY_LIMIT,
    Angles,
    Finding,
    Report,
    not_finite,
    times,
    verdict,
)

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


FINEST = 2.0**-13
"""Size of the squares around an announced centre, about 1e-4 rad: a lobe of n = 1e7 is 3e-4 wide."""

_NODES = 5
_CELLS = 4  # squares along the edge of a face at the start
_DEEPEST = 22  # times a square may be halved

Evaluate = Callable[[Int[np.ndarray, " m"], Float[np.ndarray, "m 3"]], Float[np.ndarray, "m C"]]


@dataclasses.dataclass(frozen=True)
class Integral:
    """Integrals with bounds on their errors.

    Attributes:
        value: (K, C).
        error_bound: (K, C), at least 0.
        evaluations: how many function values were needed.
    """

    value: Float[np.ndarray, "K C"]
    error_bound: Float[np.ndarray, "K C"]
    evaluations: int


# Columns: normal of the face, and its two axes. The upper face is whole, the others lack their lower half.
_FACES = np.array(
    [
        [[0, 0, 1], [1, 0, 0], [0, 1, 0]],
        [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
        [[-1, 0, 0], [0, 1, 0], [0, 0, 1]],
        [[0, 1, 0], [1, 0, 0], [0, 0, 1]],
        [[0, -1, 0], [1, 0, 0], [0, 0, 1]],
    ],
    dtype=np.float64,
)


@dataclasses.dataclass(frozen=True)
class _Squares:
    """Squares on the faces: which integral they belong to, face, lower corner, size, integral over them (m, C)."""

    of: np.ndarray
    face: np.ndarray
    corner: np.ndarray
    size: np.ndarray
    value: np.ndarray

    def __getitem__(self, which: np.ndarray) -> "_Squares":
        return _Squares(*(getattr(self, field.name)[which] for field in dataclasses.fields(self)))

    def __len__(self) -> int:
        return len(self.of)


def integrate(
    evaluate: Evaluate,
    count: int,
    centres: list[Float[np.ndarray, "_ 3"]],
    *,
    tolerance: float,
    budget: int,
) -> Integral:
    """Integrals of several functions over the hemisphere about +z.

    Args:
        evaluate: called with which function, (m,), and directions, (m, 3); returns values, (m, C).
        count: K, the number of functions.
        centres: for each function the directions (unit vectors) around which it may have narrow lobes.
        tolerance: the difference at which a square is refined no more.
        budget: the number of function values after which refinement stops.

    Returns:
        The integrals, with bounds that also cover whatever the budget left unrefined.
    """
    squares = _first(count)
    squares = dataclasses.replace(squares, value=_rule(evaluate, squares))
    channels = squares.value.shape[1]
    total, bound = np.zeros((count, channels)), np.zeros((count, channels))
    spent = len(squares) * _NODES**2
    for _ in range(_DEEPEST):
        if not len(squares):
            break
        quarters = _split(squares)
        quarters = dataclasses.replace(quarters, value=_rule(evaluate, quarters))
        spent += len(quarters) * _NODES**2
        sums = quarters.value.reshape(4, len(squares), channels).sum(axis=0)
        differences = np.abs(sums - squares.value)
        refine = np.max(differences, axis=1) > tolerance
        refine |= _around(squares, centres) & (squares.size > FINEST)
        if spent > budget:
            refine[:] = False
        np.add.at(total, squares.of[~refine], sums[~refine])
        np.add.at(bound, squares.of[~refine], differences[~refine])
        squares = quarters[np.tile(refine, 4)]
    np.add.at(total, squares.of, squares.value)
    np.add.at(bound, squares.of, np.abs(squares.value))
    rounding = 1e-15 * _NODES * np.abs(total)
    return Integral(total, bound + rounding, spent)


def _first(count: int) -> _Squares:
    faces, corners = [], []
    size = 2.0 / _CELLS
    for face in range(5):
        u, v = np.meshgrid(np.arange(_CELLS), np.arange(_CELLS), indexing="ij")
        corner = np.stack([u.ravel(), v.ravel()], -1) * size - 1.0
        corner = corner if face == 0 else corner[corner[:, 1] >= 0]
        corners.append(corner)
        faces.append(np.full(len(corner), face))
    face, corner = np.concatenate(faces), np.concatenate(corners)
    of = np.repeat(np.arange(count), len(face))
    face, corner = np.tile(face, count), np.tile(corner, (count, 1))
    return _Squares(of, face, corner, np.full(len(of), size), np.empty((len(of), 0)))


def _split(squares: _Squares) -> _Squares:
    """The four quarters of each square, quarter by quarter."""
    half = 0.5 * squares.size
    corners = [squares.corner + half[:, None] * np.array(offset) for offset in ((0, 0), (0, 1), (1, 0), (1, 1))]
    return _Squares(
        np.tile(squares.of, 4), np.tile(squares.face, 4), np.concatenate(corners), np.tile(half, 4), np.empty((0, 0))
    )


def _rule(evaluate: Evaluate, squares: _Squares) -> Float[np.ndarray, "m C"]:
    nodes, weights = np.polynomial.legendre.leggauss(_NODES)
    nodes, weights = 0.5 * (nodes + 1), 0.5 * weights
    u, v = (x.ravel() for x in np.meshgrid(nodes, nodes, indexing="ij"))
    weight = np.outer(weights, weights).ravel()
    a = squares.corner[:, :1] + squares.size[:, None] * u
    b = squares.corner[:, 1:] + squares.size[:, None] * v
    axes = _FACES[squares.face][:, None]  # (m, 1, 3 vectors, 3)
    directions = axes[:, :, 0] + a[..., None] * axes[:, :, 1] + b[..., None] * axes[:, :, 2]
    length = np.linalg.norm(directions, axis=-1)
    directions /= length[..., None]
    solid_angle = weight * squares.size[:, None] ** 2 / length**3
    values = evaluate(np.repeat(squares.of, len(weight)), directions.reshape(-1, 3))
    return np.einsum("mk,mkc->mc", solid_angle, values.reshape(*solid_angle.shape, -1))


def _around(squares: _Squares, centres: list[Float[np.ndarray, "_ 3"]]) -> np.ndarray:
    """Which squares lie within their own size of one of the centres of their function."""
    near = np.zeros(len(squares), bool)
    for index, points in enumerate(centres):
        mine = np.flatnonzero(squares.of == index)
        if not len(points) or not len(mine):
            continue
        axes = _FACES[squares.face[mine]]
        local = np.einsum("mij,pj->mpi", axes, points)
        in_front = local[..., 0] > 0.2  # beyond that a centre is on another face, and far from this one
        position = local[..., 1:] / np.where(in_front, local[..., 0], 1.0)[..., None]
        size = squares.size[mine][:, None, None]
        beyond = np.abs(position - (squares.corner[mine][:, None] + 0.5 * size)) - 0.5 * size
        near[mine] = np.any(in_front & np.all(beyond < size, axis=-1), axis=1)
    return near


_COARSE = 1e-5  # tolerance of the quadrature for directions that turn out not to matter


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
    sample = Sampler(f_r)
    random = np.random.default_rng(20)
    scan = Scan(sample, random)
    positivity = _positivity(sample, scan, random)
    reciprocity = _reciprocity(sample, scan, random)
    energy = _energy(sample, scan, random)
    if sample.not_finite is not None:
        light, view = (_angles(v) for v in sample.not_finite)
        positivity, reciprocity, energy = (not_finite(f, light, view) for f in (positivity, reciprocity, energy))
    return Report(subject, positivity, reciprocity, energy)


def _positivity(sample: Sampler, scan: Scan, random: np.random.Generator) -> Finding:
    light, view = improved(lambda a, b: -sample(a, b).min(axis=1), scan.negative, random)
    values = sample(light, view)
    row, channel = np.unravel_index(np.argmin(values), values.shape)
    value = float(values[row, channel])
    bound = _noise(lambda a, b: sample(a, b)[:, channel], light[row], view[row], sample, random)
    limit = -1e-9 * scan.scale
    to_light, to_view = _angles(light[row]), _angles(view[row])
    word = verdict(value - limit, bound)
    where = f"for light {to_light}, view {to_view}{_channel(sample, channel)}"
    sentence = (
        f"negative: f_r is {value:.4g}/sr {where}" if word == "fail" else f"the least f_r is {value:.4g}/sr {where}"
    )
    return Finding(word, value, limit, value - limit, bound, to_light, to_view, int(channel), sentence)


def _reciprocity(sample: Sampler, scan: Scan, random: np.random.Generator) -> Finding:
    def errors(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return inequality(sample(a, b), sample(b, a), scan.scale)

    light, view = improved(lambda a, b: errors(a, b).max(axis=1), scan.unequal, random)
    values = errors(light, view)
    row, channel = np.unravel_index(np.argmax(values), values.shape)
    value = float(values[row, channel])
    bound = _noise(lambda a, b: errors(a, b)[:, channel], light[row], view[row], sample, random)
    pair = [light[row], view[row]]
    there, back = (float(sample(a[None], b[None])[0, channel]) for a, b in (pair, pair[::-1]))
    if abs(there) < abs(back):
        pair, there, back = pair[::-1], back, there
    to_light, to_view = _angles(pair[0]), _angles(pair[1])
    margin = RECIPROCITY_LIMIT - value
    word = verdict(margin, bound)
    sentence = f"f_r changes by at most {value:.2g} of its value when light and view change places"
    if word == "fail":
        compared = f"{there:.4g}/sr, but {back:.4g}/sr the other way round"
        if 0 < back < there < 1e4 * back:
            compared = f"{times(there / back)} f_r({to_view} → {to_light})"
        sentence = f"not reciprocal: f_r({to_light} → {to_view}) is {compared}{_channel(sample, channel)}"
    return Finding(word, value, RECIPROCITY_LIMIT, margin, bound, to_light, to_view, int(channel), sentence)


def _noise(
    function: Callable[[np.ndarray, np.ndarray], np.ndarray],
    light: np.ndarray,
    view: np.ndarray,
    sample: Sampler,
    random: np.random.Generator,
) -> float:
    """How much a value scatters under changes of the directions by a few roundings, which are below all real change."""
    shake = 4 * sample.epsilon * random.standard_normal((2, 64, 3))
    values = function(lifted(light + shake[0]), lifted(view + shake[1]))
    return 2 * float(np.ptp(values)) + 4 * sample.epsilon * float(np.max(np.abs(values)))


def _energy(sample: Sampler, scan: Scan, random: np.random.Generator) -> Finding:
    polars = np.array([*np.arange(0, 90, 5.0), 88.0, 89.0, 89.9, *(90.0 - np.geomspace(1e-2, 1e-8, 4))])
    azimuths = np.array([0.0]) if _isotropic(sample, scan, random) else np.arange(8) * 45.0
    lights = np.array([direction(p, a) for p in polars for a in (azimuths if p else azimuths[:1])])
    lights = np.concatenate([lights, *(light[:1] for light, _ in scan.bright)])
    albedo, bound = _albedos(sample, scan, lights, random, _COARSE)
    for step in (2.5, 0.8, 0.25, 0.08):
        top = lights[np.argmax(albedo.max(axis=1))]
        polar, azimuth = degrees(top)
        around = [(p, 0.0) for p in (-1.0, -0.5, 0.5, 1.0)]
        if len(azimuths) > 1:
            around += [(p, a) for p in (-1.0, 0.0, 1.0) for a in (-4.0, -1.5, 1.5, 4.0)]
        angles = {(min(max(polar + step * p, 0.0), max(polar, GRAZING)), azimuth + step * a) for p, a in around}
        more = np.array([direction(*pair) for pair in sorted(angles)])
        found = _albedos(sample, scan, more, random, _COARSE)
        lights = np.concatenate([lights, more])
        albedo, bound = np.concatenate([albedo, found[0]]), np.concatenate([bound, found[1]])
    tolerance = np.full(len(lights), _COARSE)
    for _ in range(60):  # sharpen those that decide, as long as they do not
        row = int(np.argmax(np.max(albedo + bound, axis=1)))
        if not _undecided(albedo, bound) or tolerance[row] < 1e-11:
            break
        tolerance[row] *= 0.02
        albedo[row], bound[row] = (x[0] for x in _albedos(sample, scan, lights[row : row + 1], random, tolerance[row]))
    fails = np.any(albedo - bound > ENERGY_LIMIT)
    row, channel = np.unravel_index(np.argmax(albedo - bound if fails else albedo + bound), albedo.shape)
    value, error = float(albedo[row, channel]), float(bound[row, channel])
    to_light = _angles(lights[row])
    word = verdict(ENERGY_LIMIT - value, error)
    sentence = f"the largest albedo is {value:.6g} for light {to_light}{_channel(sample, channel)}"
    if word == "fail":
        sentence = f"does not conserve energy: {sentence}"
    return Finding(word, value, ENERGY_LIMIT, ENERGY_LIMIT - value, error, to_light, None, int(channel), sentence)


def albedo_of(f_r: Callable[[Any, Any], Any], polar: Float[np.ndarray, " K"]) -> Float[np.ndarray, "K C"]:
    """Albedo of any BRDF for lights in the plane of azimuth 0, to about 1e-4.

    Args:
        f_r: f_r(to_light, to_view) -> (C,), as for ``check_black_box``.
        polar: angles of the light in degrees, (K,).

    Returns:
        (K, C).
    """
    sample, random = Sampler(f_r), np.random.default_rng(20)
    lights = np.array([direction(p, 0.0) for p in polar])
    return _albedos(sample, Scan(sample, random), lights, random, _COARSE)[0]


def _undecided(albedo: np.ndarray, bound: np.ndarray) -> bool:
    return bool(np.any(albedo + bound > ENERGY_LIMIT) and not np.any(albedo - bound > ENERGY_LIMIT + 1e-3))


def _isotropic(sample: Sampler, scan: Scan, random: np.random.Generator) -> bool:
    light, view = (random.permutation(directions(2048)) for _ in range(2))
    light, view = np.concatenate([light, scan.bright[0][0]]), np.concatenate([view, scan.bright[0][1]])
    there = sample(light, view)
    for angle in (0.7, 2.0, 4.4):
        turn = np.array([[math.cos(angle), -math.sin(angle), 0], [math.sin(angle), math.cos(angle), 0], [0, 0, 1]])
        if inequality(there, sample(light @ turn.T, view @ turn.T), scan.scale).max() > 1e-5:
            return False
    return True


def _albedos(
    sample: Sampler, scan: Scan, lights: np.ndarray, random: np.random.Generator, tolerance: float
) -> tuple[np.ndarray, np.ndarray]:
    """Albedos (K, C) and bounds on their errors, for lights (K, 3)."""

    def evaluate(which: np.ndarray, views: np.ndarray) -> np.ndarray:
        return sample(lights[which], views) * views[:, 2:]

    centres = _centres(sample, scan, lights, random)
    budget = 3_000_000 + 60_000 * len(lights)
    result = integrate(evaluate, len(lights), centres, tolerance=tolerance, budget=budget)
    return result.value, result.error_bound + 50 * sample.epsilon * np.abs(result.value)


def _centres(sample: Sampler, scan: Scan, lights: np.ndarray, random: np.random.Generator) -> list[np.ndarray]:
    """For each light the views where a narrow lobe may sit: the typical places, and the brightest found near by."""
    coarse = directions(2**12)
    up = np.array([[0.0, 0.0, 1.0]])
    bright_light, bright_view = (np.concatenate([pair[side] for pair in scan.bright[:18:2]]) for side in (0, 1))
    halves = lifted(bright_light + bright_view)
    starts = []
    for light in lights:
        same_half = 2 * (halves @ light)[:, None] * halves - light
        places = [light * [[-1, -1, 1]], light[None], up, bright_view, same_half[same_half[:, 2] > 0]]
        candidates = np.concatenate([coarse, *places])
        value = (sample(light[None], candidates) * candidates[:, 2:]).max(axis=1)
        order = np.argsort(-value)[:6]
        starts.append(np.concatenate([candidates[order], light * [[-1, -1, 1]]]))
    each = len(starts[0])
    pairs = [(np.repeat(lights, each, axis=0), np.concatenate(starts))]
    _, found = improved(
        lambda a, b: (sample(a, b) * b[:, 2:]).max(axis=1), pairs, random, move_light=False, rounds=25, tries=12
    )
    return [
        np.concatenate([found[i * each : (i + 1) * each], light * [[-1, -1, 1]], light[None]])
        for i, light in enumerate(lights)
    ]


def _angles(direction: np.ndarray) -> Angles:
    return Angles(*degrees(direction))


def _channel(sample: Sampler, channel: Any) -> str:
    return in_channel(int(channel), sample.channels)
