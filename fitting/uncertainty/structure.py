"""What errs together: sums of residuals over blocks of pixels, against what independent errors give.

Independent errors of any size, also where they grow with brightness, have sums over a block whose square is in the mean
the sum of the squares. A light that stands elsewhere, a ball whose circle is off, the blocks of a JPEG make it larger.
"""

import math
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from fitting.solver.normal_equations import Picture
from fitting.solver.profile import Optimum
from fitting.solver.tied import places_of

SIZES = (8, 16, 32)
# Pixels on a side of the blocks of JPEG, whose errors go together by themselves.
CODED_BLOCK = 8
# Of sums over these, two on a side, how many on a side are looked at.
CODED_SIZES = (2, 4)
# Of those whose sums of scores tell how much errs together: the blocks of JPEG, and larger ones where there are many.
SCATTER_SIZES, FEWEST_BLOCKS = (8, 16, 32), 30
# So many standard deviations above what chance gives: in blocks of 8 x 8, and at any of the sizes.
CHANCE, SIGNIFICANT = 4.0, 3.2
# What a block holds of all unknowns together: with less its residual is as it is. More than the other share of a number
# is not taken for granted, or nothing would be known of it.
LEAST_HELD, MOST_HELD = 0.1, 0.75
# A block counts where this share of its pixels does, and where its errors are not this share of the usual squares:
# those of values that are surely clipped are next to nothing, and have one sign.
FULL, QUIET = 0.5, 0.05


class Errors(NamedTuple):
    """Errors of pixels of one picture, each in units of its noise.

    Attributes:
        values: residuals, 0 where a pixel does not count.
        pixel: index of each in the picture, row by row.
        width: of the picture.
    """

    values: Float[np.ndarray, "P C"]
    pixel: Int[np.ndarray, " P"]
    width: int

    def blocks(self, size: int) -> Int[np.ndarray, " P"]:
        """In which block of size x size pixels each lies."""
        row, column = np.divmod(self.pixel, self.width)
        return (row // size) * -(-self.width // size) + column // size


class Blocks(NamedTuple):
    """Sums over blocks of pixels.

    Attributes:
        sums: of errors.
        squares: of their squares.
        pixels: how many are not 0.
    """

    sums: Float[np.ndarray, "R Q C"]
    squares: Float[np.ndarray, "R Q C"]
    pixels: Float[np.ndarray, "R Q C"]

    def channels(self, some: Any) -> "Blocks":
        """The same of some channels."""
        return Blocks(*(part[..., some] for part in self))

    @property
    def stacked(self) -> Float[np.ndarray, "R Q 3*C"]:
        """All three, of each channel one after the other."""
        return np.stack(self, axis=-1).reshape(*self.sums.shape[:2], -1)


class Structure(NamedTuple):
    """How much errs together.

    Attributes:
        excess: of the squares of the blocks' sums over what independent errors give, in standard deviations; the
            largest over the sizes.
        unknown: the same less what is known to err together.
    """

    excess: float
    unknown: float

    @property
    def significant(self) -> bool:
        """Too large for chance."""
        return self.excess > SIGNIFICANT

    @property
    def known(self) -> bool:
        """Too large for chance, but not for what is known to err together."""
        return self.significant and not self.unknown > SIGNIFICANT


def structure(
    grids: Sequence[Blocks], sizes: Sequence[int] = SIZES, *, even: bool = True, missed: float = 0.0
) -> Structure:
    """Compare sums over blocks with independent errors.

    Args:
        grids: of each picture, over the smallest blocks.
        sizes: of the blocks, pixels on a side, each twice the one before.
        even: the noise is the same everywhere. Where it is not, blocks count by their noise: what least squares leaves
            where there is little of it is the noise of other places.
        missed: what is known to err together, root mean square, in the unit of the errors; for scores in that of what
            they are derivatives by.
    """
    excess, parts = np.full(2, -math.inf), [grid.stacked for grid in grids]
    for size in sizes:
        if size > sizes[0]:
            parts = [coarser(part, 2) for part in parts]
        if not even:
            excess = np.maximum(excess, _by_noise(parts, missed))
            continue
        joined, alone, pixels = np.concatenate([part.reshape(-1, 3) for part in parts]).T.astype(float)
        # In a block with few pixels the ratio says little.
        usual = np.sum(alone) / max(np.sum(pixels), 1.0)
        seen = (pixels >= FULL * size**2) & (alone > QUIET * usual * pixels)
        joined, alone, pixels = joined[seen], alone[seen], pixels[seen]
        if joined.size:
            squares = joined**2 - np.array([[0.0], [missed]]) ** 2 * alone**2
            # Wilson and Hilferty (1931): the cube root of chi squared is nearly normal.
            spread = np.sum(2 * (pixels - 1) / (pixels + 2)) / (9 * joined.size**2)
            found = (np.cbrt(np.mean(squares / alone, axis=1)) - (1 - spread)) / math.sqrt(spread)
            excess = np.maximum(excess, found)
    return Structure(*excess.tolist())


def _by_noise(parts: Sequence[np.ndarray], missed: float) -> Float[np.ndarray, "2"]:
    """The excess where blocks count by their noise; each picture in deviations of its own.

    One of more noise, as a picture has whose scene is not as stated, would be lost in what the others say.
    """
    deviations = []
    for part in parts:
        joined, alone, _ = part.reshape(-1, 3).T.astype(float)
        deviation = math.sqrt(np.sum(2 * alone**2))
        if deviation > 0:
            squares = joined**2 - np.array([[0.0], [missed]]) ** 2 * alone**2
            deviations.append(np.sum(squares - alone, axis=1) / deviation)
    return SIGNIFICANT / CHANCE * np.sum(deviations, axis=0) / math.sqrt(max(len(deviations), 1))


def of_coded_blocks(errors: Errors) -> Blocks:
    """Sums over the blocks of a codec, which are what its errors are independent in, each over two on a side."""
    # Colours have half the resolution.
    return _added(over_blocks(errors, CODED_BLOCK if errors.values.shape[1] == 1 else 2 * CODED_BLOCK).sums, 2)


def over_blocks(errors: Errors, size: int) -> Blocks:
    """Sums over blocks of so many pixels on a side."""
    values, width = errors.values, errors.width
    rows = int(np.max(errors.pixel, initial=0)) // width + 1
    if errors.pixel.size == rows * width:
        return _added(values.reshape(rows, width, -1), size)
    # Of a picture whose roundings leave nothing open it has no pixel, and few where little is open.
    shape = -(-rows // size), -(-width // size)
    block = errors.blocks(size)
    return Blocks(
        *(
            np.stack([np.bincount(block, one, math.prod(shape)).reshape(shape) for one in part.T], axis=-1)
            for part in (values, values**2, values != 0)
        )
    )


def _added(image: Float[np.ndarray, "H W C"], size: int) -> Blocks:
    return Blocks(*(coarser(part, size) for part in (image, image**2, image != 0)))


def coarser(grid: Float[np.ndarray, "H W C"], factor: int) -> Float[np.ndarray, "R Q C"]:
    """Sums over blocks of so many pixels on a side."""
    padded = np.pad(grid, np.array([(0, -grid.shape[0] % factor), (0, -grid.shape[1] % factor), (0, 0)]))
    # Rows first: their sums are as long as the picture is wide.
    rows = padded.reshape(-1, factor, padded.shape[1] * padded.shape[2]).sum(axis=1, dtype=np.float64)
    return rows.reshape(len(rows), -1, factor, padded.shape[2]).sum(axis=2)


def shared(grids: Sequence[Blocks]) -> tuple[float, float]:
    """What errs together within blocks: squares of sums less sums of squares; and what chance makes of it."""
    excess = sum(float(np.sum(grid.sums**2 - grid.squares)) for grid in grids)
    return excess, math.sqrt(sum(float(np.sum(2 * grid.squares**2)) for grid in grids))


def scatter(
    pictures: Iterable[Picture],
    optimum: Optimum,
    errors: Iterable[Errors],
    covariance: Float[np.ndarray, "U U"] | None = None,
) -> Float[np.ndarray, "U U"]:
    """Products of the scores by x_a, x_d, x_s, channel after channel, and n, summed over blocks of pixels first.

    That is what the Hessian would be if pixels of a block err together; weights are inverse variances. The covariance
    of independent pixels is for the residuals that blocks would have beside a fit without them: a highlight in few
    blocks is fitted to their errors, which leave little of themselves (the jackknife; R. M. Bell and D. F. McCaffrey,
    Survey Methodology 28 (2002) 169). None for those that they have.
    """
    total = 0.0
    for picture, own in zip(pictures, errors, strict=True):
        weights = np.broadcast_to(np.asarray(picture.weights), own.values.shape)
        counts = np.flatnonzero(np.any(weights > 0, axis=1))
        own = own._replace(values=own.values[counts], pixel=own.pixel[counts])
        slopes = picture.columns(optimum.n)[:, counts] * np.sqrt(weights[counts])
        slopes[3] *= optimum.x[2]
        terms = slopes * own.values
        by_x = np.concatenate(np.moveaxis(terms[:3], -1, 1))
        scores = np.concatenate([by_x, terms[3].sum(axis=1)[None]])
        fitted = None if covariance is None else (slopes, covariance, places_of(slopes.shape[2]))
        total = total + block_scatter(scores, own, fitted)
    return np.asarray(total)


def block_scatter(
    scores: Float[np.ndarray, "U P"], errors: Errors, fitted: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None
) -> Float[np.ndarray, "U U"]:
    """Products of sums of scores over blocks of pixels, of the size that gives most.

    ``fitted`` are derivatives by the unknowns that move a channel, (V, P, C), times the roots of weights, the
    covariance of `scatter`, and which unknowns these are, (C, V); None where the scores are to stay.
    """
    scatters = []
    for size in SCATTER_SIZES:
        blocks = errors.blocks(size)
        if scatters and np.unique(blocks).size < FEWEST_BLOCKS:
            break
        together = np.array([np.bincount(blocks, weights=row) for row in scores])
        if fitted is not None:
            together = _left_out(together, blocks, *fitted)
        scatters.append(together @ together.T)
    scale = np.maximum(np.diag(scatters[0]), np.finfo(float).tiny)
    return max(scatters, key=lambda sums: float(np.sum(np.diag(sums) / scale)))


def _left_out(
    together: Float[np.ndarray, "U B"],
    blocks: Int[np.ndarray, " P"],
    slopes: Float[np.ndarray, "V P C"],
    covariance: Float[np.ndarray, "U U"],
    index: Int[np.ndarray, "C V"],
) -> Float[np.ndarray, "U B"]:
    """Scores of blocks, each about the fit without it."""
    own = np.array([covariance[np.ix_(some, some)] for some in index])
    apart = np.moveaxis(slopes, 2, 0)
    held = np.sum(apart * (own @ apart), axis=(0, 1))
    root = np.linalg.svd(covariance, hermitian=True)
    root = root.U * np.sqrt(root.S)
    found, order = together.copy(), np.argsort(blocks, kind="stable")
    edges = np.append(0, np.cumsum(np.bincount(blocks)))
    for block in np.flatnonzero(np.bincount(blocks, weights=held) > LEAST_HELD):
        hessian, some = np.zeros_like(covariance), slopes[:, order[edges[block] : edges[block + 1]]]
        for c, place in enumerate(index):
            hessian[np.ix_(place, place)] += some[..., c] @ some[..., c].T
        values, vectors = np.linalg.eigh(root.T @ hessian @ root)
        growth = 1 / (1 - np.clip(values, 0.0, MOST_HELD))
        step = (growth - 1) / np.maximum(values, np.finfo(float).tiny)
        along = root @ vectors
        found[:, block] += hessian @ along @ (step * (along.T @ together[:, block]))
    return found
