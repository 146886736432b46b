"""Less of a scene: fewer samples of its lights, and some of its pixels, spread so that they see every exponent.

The picture is cut into equal squares; those whose pixel lies nearest to the middle of a highlight are cut into four,
and again, down to single pixels: a highlight of any width then lies on a good number of squares, and a lobe twice as
narrow sees as many. Of each square one pixel is taken at random (fixed seed) and stands for all of the square: its
weight is the square's number of pixels, the inverse of its probability (Horvitz and Thompson 1952, J. Am. Stat. Assoc.
47, 663). The work grows with the number of pixels taken and the logarithm of the picture's size.
"""

import dataclasses
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int

import brdf
from brdf.lights.base import Lighting, stacked
from brdf.lobes import basis_program
from brdf.models.base import SpecularMaterial
from brdf.precision import working_precision

# Of the squares of each size this share is cut further.
CUT = 1 / 12
# Which a picture of no more pixels than this is not worth.
FEWEST = 256


# By identity of a light and number of samples: the light itself, or another might come to have its identity, and what
# was made of it. A map is cut up anew for each number, which takes up to seconds.
MadeLights = dict[tuple[int, int], tuple[Any, Any]]


def with_samples(scene: brdf.Scene, samples: int | None, made: MadeLights | None = None) -> brdf.Scene:
    """The scene with so many samples in each of its lights with an extent.

    Args:
        scene: any.
        samples: at most so many; None leaves it as it is.
        made: lights made so far, and those made now.
    """
    if samples is None:
        return scene
    made, lights = {} if made is None else made, []
    for light in scene.lights:
        key = (id(light), samples)
        if getattr(light, "samples", samples) != samples and key not in made:
            made[key] = (light, _sampled(light, samples))
        lights.append(made[key][1] if key in made else light)
    return dataclasses.replace(scene, lights=tuple(lights))


def _sampled(light, samples):
    if not isinstance(light, brdf.EnvironmentMap):
        return dataclasses.replace(light, samples=max(samples, len(getattr(light, "triangles", ()))))
    plain = brdf.EnvironmentMap(light.pixels, samples=samples)
    return eqx.tree_at(lambda one: one.radiance, plain, plain.radiance * light.radiance)


class PixelSample(NamedTuple):
    """Some pixels of a picture.

    Attributes:
        pixel: which, row by row of the picture, (M,); neighbours in the list are mostly neighbours in the picture.
        stands_for: for how many pixels each stands, at least 1, (M,).
    """

    pixel: Int[np.ndarray, " M"]
    stands_for: Float[np.ndarray, " M"]


@eqx.filter_jit
def _peaks(points, lights, model):
    """The largest log cosine of the lobe at each pixel, of lights that nothing shadows."""
    lobe: Any = basis_program(model, points, Lighting(stacked(lights, points.position.dtype)))()[1]
    return lobe.peak


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
    while -(-height // (2 * side)) * -(-width // (2 * side)) >= max(size, FEWEST) * 3 // 4:
        side *= 2
    if side == 1:
        return None
    random, end = np.random.default_rng(0), np.array([[height], [width]])
    corner = side * _along_curve(-(-height // side), -(-width // side))
    lights = with_samples(scene, 1).lights
    lights = tuple(light for light in lights if light.type_name != "environment")
    has_peaks = bool(lights) and issubclass(model, SpecularMaterial)
    most = max(16, 4 * round(size * CUT / 4))
    pixels, areas = [], []
    while True:
        extent = np.minimum(side, end - corner)
        row, column = corner + (random.random(corner.shape) * extent).astype(int)
        pixel, area = row * width + column, np.prod(extent, axis=0).astype(np.float64)
        cut = np.zeros(pixel.size, bool)
        if has_peaks and side > 1 and pixel.size > most:
            # One shape for few sizes, so that few programs are compiled.
            padded = np.resize(pixel, 1 << int(pixel.size - 1).bit_length())
            points = dataclasses.replace(brdf.some_pixels(scene, padded).surface_points(), area=None)
            with working_precision("float32"):
                peak = np.asarray(_peaks(points, lights, model))[: pixel.size]
            cut[np.argpartition(-peak, most)[:most]] = True
        pixels.append(pixel[~cut])
        areas.append(area[~cut])
        if not cut.any():
            return PixelSample(np.concatenate(pixels), np.concatenate(areas))
        side //= 2
        quarters = side * np.array([[0, 0, 1, 1], [0, 1, 0, 1]])
        corner = (corner[:, cut, None] + quarters[:, None]).reshape(2, -1)
        corner = corner[:, np.all(corner < end, axis=0)]


def _along_curve(rows, columns):
    """Rows and columns of a table's entries along Morton's curve: what is near in the order is near in the table."""
    row, column = np.indices((rows, columns)).reshape(2, -1)
    key = np.zeros(row.shape, np.int64)
    for bit in range(17):
        key |= ((row >> bit) & 1) << (2 * bit + 1) | ((column >> bit) & 1) << (2 * bit)
    order = np.argsort(key, kind="stable")
    return np.stack([row[order], column[order]])
