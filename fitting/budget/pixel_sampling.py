"""Some pixels of a picture, spread so that they see every exponent, and none but those looked at.

The picture is cut into equal squares; those whose pixel lies nearest to the middle of a highlight are cut into four,
and again, down to single pixels: a highlight of any width then lies on a good number of squares, and a lobe twice as
narrow sees as many. Of each square one pixel is taken at random (fixed seed) and stands for all of the square: its
weight is the square's number of pixels, the inverse of its probability (Horvitz and Thompson 1952, J. Am. Stat. Assoc.
47, 663). The work grows with the number of pixels taken and the logarithm of the picture's size.
"""

from typing import Any, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float, Int

import brdf
from brdf.models.base import SpecularMaterial
from brdf.precision import working_precision
from brdf.rendering import basis
from fitting.budget.lamps import with_lights, with_samples

# Of the squares of each size this share is cut further.
CUT = 1 / 12
# Lights with an extent stand here for the place of their highlight.
FEW_SAMPLES = 4
# Which a picture of no more pixels than this is not worth.
FEWEST = 256


class PixelSample(NamedTuple):
    """Some pixels of a picture.

    Attributes:
        pixel: which, row by row of the picture, (M,); neighbours in the list are mostly neighbours in the picture.
        stands_for: for how many pixels each stands, at least 1, (M,).
    """

    pixel: Int[np.ndarray, " M"]
    stands_for: Float[np.ndarray, " M"]

    @property
    def complete(self) -> bool:
        """Whether it is the whole picture."""
        return bool(np.all(self.stands_for == 1))


class _Squares(NamedTuple):
    row: np.ndarray
    column: np.ndarray
    side: int

    def halves(self) -> "_Squares":
        side = self.side // 2
        shift = np.array([0, side])
        row = np.broadcast_to(self.row[:, None, None] + shift[:, None], (self.row.size, 2, 2)).ravel()
        column = np.broadcast_to(self.column[:, None, None] + shift, (self.row.size, 2, 2)).ravel()
        return _Squares(row, column, side)

    def inside(self, height: int, width: int) -> "_Squares":
        kept = (self.row < height) & (self.column < width)
        return _Squares(self.row[kept], self.column[kept], self.side)

    def some(self, kept: Bool[np.ndarray, " S"]) -> "_Squares":
        return _Squares(self.row[kept], self.column[kept], self.side)


def sample_pixels(scene: brdf.Scene, model: type[brdf.Material], size: int) -> PixelSample | None:
    """Choose about ``size`` pixels of a scene's picture.

    Args:
        scene: what the picture shows.
        model: the class of the material, which tells where its highlights are.
        size: how many; up to about the double where the picture is large and has highlights.

    Returns:
        The pixels; None where all of them are hardly more.
    """
    width, height = scene.resolution
    side = 1
    while (-(-height // (2 * side))) * (-(-width // (2 * side))) >= max(size, FEWEST) * 3 // 4:
        side *= 2
    if side == 1:
        return None
    random = np.random.default_rng(0)
    tops = np.arange(0, height, side), np.arange(0, width, side)
    order = _along_curve(tops[0].size, tops[1].size)
    grid = np.meshgrid(*tops, indexing="ij")
    squares = _Squares(grid[0].ravel()[order], grid[1].ravel()[order], side)
    lobes = _few_samples(scene) if issubclass(model, SpecularMaterial) else None
    kept: list[tuple[_Squares, np.ndarray]] = []
    most = max(16, 4 * round(size * CUT / 4))
    while True:
        pixel = _one_of_each(squares, height, width, random)
        if lobes is None or squares.side == 1 or squares.row.size <= most:
            kept.append((squares, pixel))
            break
        peak = _peaks(lobes, model, pixel)
        cut = np.zeros(pixel.size, bool)
        cut[np.argpartition(-peak, most)[:most]] = True
        kept.append((squares.some(~cut), pixel[~cut]))
        squares = squares.some(cut).halves().inside(height, width)
    pixel = np.concatenate([pixel for _, pixel in kept])
    stands_for = np.concatenate([_areas(squares, height, width) for squares, _ in kept])
    return PixelSample(pixel, stands_for)


def _along_curve(rows: int, columns: int) -> Int[np.ndarray, " S"]:
    """The order of a table's entries along Morton's curve: what is near in the order is near in the table."""
    row, column = np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij")
    key = np.zeros(row.shape, np.int64)
    for bit in range(17):
        key |= ((row >> bit) & 1) << (2 * bit + 1) | ((column >> bit) & 1) << (2 * bit)
    return np.argsort(key.ravel(), kind="stable")


def _areas(squares: _Squares, height: int, width: int) -> Float[np.ndarray, " S"]:
    rows = np.minimum(squares.side, height - squares.row)
    return (rows * np.minimum(squares.side, width - squares.column)).astype(np.float64)


def _one_of_each(squares: _Squares, height: int, width: int, random: Any) -> Int[np.ndarray, " S"]:
    rows = np.minimum(squares.side, height - squares.row)
    columns = np.minimum(squares.side, width - squares.column)
    row = squares.row + (random.random(rows.size) * rows).astype(int)
    column = squares.column + (random.random(rows.size) * columns).astype(int)
    return row * width + column


def _few_samples(scene: brdf.Scene) -> brdf.Scene | None:
    """The scene with as few samples as tell where highlights are; None where no light has a place."""
    lights = tuple(light for light in scene.lights if light.type_name != "environment")
    return with_samples(with_lights(scene, lights), FEW_SAMPLES) if lights else None


def _peaks(scene: brdf.Scene, model: type[brdf.Material], pixel: Int[np.ndarray, " S"]) -> Float[np.ndarray, " S"]:
    """The largest log cosine of the lobe at each pixel."""
    # One shape for few sizes, so that few programs are compiled.
    padded = np.zeros(1 << int(pixel.size - 1).bit_length(), np.int32)
    padded[: pixel.size] = pixel
    with working_precision("float32"):
        compiled = _compiled_peaks if traceable(scene) else _direct_peaks
        return np.asarray(compiled(model, scene, padded))[: pixel.size]


def traceable(scene: brdf.Scene) -> bool:
    """Whether `brdf.some_pixels` can be part of a compiled program: every pixel is traced on its own.

    Args:
        scene: any.
    """
    return scene.camera is not None and scene.camera.samples == 1 and not scene.visibility


def _direct_peaks(model: type[brdf.Material], scene: brdf.Scene, pixel: Any) -> Any:
    lobe = basis(model, brdf.cast(brdf.some_pixels(scene, pixel), "float32")).lobe
    assert lobe is not None
    return lobe.peak()


_compiled_peaks = eqx.filter_jit(_direct_peaks)
