"""Less of a scene: fewer samples of its lights, and some of its pixels, spread so that they see every exponent.

The picture is cut into equal squares, or pairs of such; those whose pixel lies nearest to the middle of a highlight are
cut into squares of half the longer side, and again, down to single pixels: a highlight of any width then lies on a good
number of them, and a lobe twice as narrow sees as many. Of each part one pixel is taken at random (fixed seed) and
stands for all of it: its weight is the part's number of pixels, the inverse of its probability (Horvitz and Thompson
1952, J. Am. Stat. Assoc. 47, 663). The work grows with the number of pixels taken and the logarithm of the picture's
size.
"""

import dataclasses
import weakref
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int

import brdf
from brdf.lights.base import Light, Lighting, stacked
from brdf.lobes import OneOf, diffuse_and_peak
from brdf.models.base import SpecularMaterial
from brdf.precision import working_precision

# Of the squares of each size this share is cut further.
CUT = 1 / 12
# Which a picture of no more pixels than this is not worth.
FEWEST = 256
# So many pixels and fewer go through one program.
PADDED = 2048

# By identity of a light, as long as there is one, and number of samples: to cut up a map takes up to seconds.
_made: dict[tuple[int, int], Light] = {}


def sample_counts(scene: brdf.Scene) -> list[int]:
    """The number of samples of each light, 1 of one without an extent and of a sky that needs none."""
    return [1 if scene.sees_whole(light) else getattr(light, "samples", 1) for light in scene.lights]


def with_samples(scene: brdf.Scene, samples: int) -> brdf.Scene:
    """The scene with at most so many samples in each of its lights with an extent."""
    return dataclasses.replace(scene, lights=tuple(_with_samples(light, samples) for light in scene.lights))


def _with_samples(light: Light, samples: int) -> Light:
    if getattr(light, "samples", samples) == samples:
        return light
    key = id(light), samples
    if key not in _made:
        if isinstance(light, brdf.EnvironmentMap):
            plain = brdf.EnvironmentMap(light.pixels, samples=samples)
            same = light.pixels, plain.radiance * light.radiance
            made = eqx.tree_at(lambda one: (one.pixels, one.radiance), plain, same)
        else:
            least = 2 if isinstance(light, brdf.ConstantEnvironment) else len(getattr(light, "triangles", ()))
            made = dataclasses.replace(light, samples=max(samples, least))
        _made[key] = made
        weakref.finalize(light, _made.pop, key)
    return _made[key]


def _middle(light: Light) -> Light:
    """A point in the middle of a light with an extent, about which its highlight lies."""
    if isinstance(light, brdf.RectangleLight | brdf.SphereLight):
        return brdf.PointLight(light.center, light.radiance)
    if isinstance(light, brdf.PolygonLight):
        return brdf.PointLight(light.vertices.mean(axis=0), light.radiance)
    return light


class PixelSample(NamedTuple):
    """Some pixels of a picture.

    Attributes:
        pixel: which, row by row of the picture, (M,).
        stands_for: for how many pixels each stands, at least 1, (M,).
    """

    pixel: Int[np.ndarray, " M"]
    stands_for: Float[np.ndarray, " M"]

    def of(self, values: Any) -> np.ndarray:
        """What belongs to the pixels, as a picture of one row; of values (H, W) or (H, W, C)."""
        values = np.asarray(values)
        return np.take(values.reshape(-1, *values.shape[2:]), self.pixel, axis=0)[None]


def sample_pixels(scene: brdf.Scene, model: type[brdf.Material], size: float) -> PixelSample | None:
    """Choose about ``size`` pixels of a scene's picture; None where all of them are hardly more.

    The class of the material tells where highlights are; where the picture is large and has some, up to 2.5 times as
    many are chosen.
    """
    width, height = scene.resolution
    rows, columns = 1, 1
    while -(-height // columns) * -(-width // (2 * rows)) >= 0.75 * max(size, FEWEST):
        rows, columns = columns, 2 * rows
    end, side = np.array([[height], [width]]), np.array([[rows], [columns]])
    if not np.any((side > 1) & (end > 1)):
        return None
    random = np.random.default_rng(0)
    corner = side * np.indices((-(-end // side)).ravel().tolist()).reshape(2, -1)
    lights = tuple(_middle(light) for light in scene.lights if light.type_name != "environment")
    has_peaks = bool(lights) and issubclass(model, SpecularMaterial)
    most = max(16, 4 * round(size * CUT / 4))
    pixels, areas = [], []
    while True:
        extent = np.minimum(side, end - corner)
        row, column = corner + (random.random(corner.shape) * extent).astype(int)
        pixel, area = row * width + column, np.prod(extent, axis=0).astype(np.float64)
        cut = np.zeros(pixel.size, bool)
        if has_peaks and side.max() > 1 and pixel.size > most:
            # One shape for most sizes, so that few programs are compiled.
            padded = np.resize(pixel, 1 << int(max(pixel.size, PADDED) - 1).bit_length())
            points = dataclasses.replace(brdf.some_pixels(scene, padded).surface_points(), area=None)
            with working_precision("float32"):
                lighting = Lighting(stacked(lights, points.position.dtype))
                lobe: Any = diffuse_and_peak(OneOf.of(model), points, lighting)[1]
            cut[np.argpartition(-np.asarray(lobe.peak)[: pixel.size], most)[:most]] = True
        pixels.append(pixel[~cut])
        areas.append(area[~cut])
        if not cut.any():
            return PixelSample(np.concatenate(pixels), np.concatenate(areas))
        whole, side = side, np.minimum(side, side.max() // 2)
        parts = side * np.indices((whole // side).ravel().tolist()).reshape(2, -1)
        corner = (corner[:, cut, None] + parts[:, None]).reshape(2, -1)
        corner = corner[:, np.all(corner < end, axis=0)]
