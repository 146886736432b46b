"""Integrals over the hemisphere of any function, with a bound on their error.

The hemisphere is the upper half of a cube seen from its centre: five faces, each cut into squares that are halved again
and again where the function asks for it. Each square is integrated by a Gauss-Legendre product rule; a square whose
integral differs from the sum over its four quarters by more than a tolerance is refined. The sum of those differences
bounds the error, far on the safe side where the function is smooth: it is the error of the coarser rule.

A rule sees only what its nodes see. A narrow lobe must therefore be announced by its centre: squares around it are
refined down to ``FINEST`` before any difference is believed.
"""

import dataclasses
from collections.abc import Callable

import numpy as np
from jaxtyping import Float, Int

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
