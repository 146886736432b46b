"""What is wrong with the scene: which of its numbers, a little different, would explain what the fit leaves.

Noise has no shape. Where the residual has one, something that the scene says is not so: a light that stands elsewhere,
a ball whose circle is off, a curve that was not undone. The renderer tells how the picture changes with each of them;
what of that change the material cannot follow is compared with the residual. That is a score test (Rao 1948, Proc.
Camb. Phil. Soc. 44, 50): one linear least squares for each cause, and nothing is fitted again. A mirrored picture is no
small change: it is fitted.

Pictures are compared in the codes of their file where it has a curve, since noise and rounding are even there.
"""

import dataclasses
import itertools
import math
import operator
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

import brdf
from brdf.images.encoding import encode
from brdf.precision import working_precision
from fitting.core import picture_of
from fitting.pixels import Tile
from fitting.result import Cause, FitResult
from fitting.solver.profile import search
from fitting.uncertainty.structure import Errors, over_blocks

# A cause is named where it explains this share of the structure, and is this many times its error.
LEAST_SHARE, LEAST_SIZE = 0.3, 5.0
# Two causes are not told apart where beside one the other explains no more than 2 standard errors would: chi squared,
# by how many numbers it has.
ALIKE = {1: 4.0, 2: 6.18}
# A change that the material follows, all but this share of the squares, says nothing.
FOLLOWED = 1e-6
# Half the difference of the pictures that make a derivative, in units of the cause: degrees, pixels, per cent.
STEP = 0.05
# Pixels on a side of the blocks within which errors go together.
BLOCK = 16
# Pixels on a side that are looked at, if it were one picture, and at least of each.
MOST_PIXELS, FEWEST_PIXELS = 256, 48
# So many pixels from the outline a small step of the circle makes no small change.
RIM = 1.5
# What is darker than so many standard deviations is left out where noise was cut off at 0.
DARK = 3.0
# Of a step between codes: noise below that is mostly rounding.
ROUNDED = 0.5
# A mirrored picture explains more than this share of the structure.
MIRRORED = 0.5
# Half the difference of the values that make the slope of a file's curve.
CURVED = 1e-4

Scenes = Sequence[brdf.Scene]


class _Change(NamedTuple):
    """A way in which scenes or pictures may be a little wrong.

    Attributes:
        name: of the cause.
        unit: of its size.
        remedy: what to do.
        most: a larger size, or error, is no small change.
        ways: for each direction, from a scene and a size to another scene; or from linear values to others.
        places: the pictures whose scene it changes; None where it changes the values of all.
    """

    name: str
    unit: str
    remedy: str
    most: float
    ways: tuple[Callable[[Any, float], Any], ...]
    places: Sequence[int] | None = None


class _Test(NamedTuple):
    """A cause; what of its change the material cannot follow, in units of noise; the squares that it explains."""

    cause: Cause
    columns: Float[np.ndarray, "P K"]
    gain: float
    inflation: float


def diagnose(result: FitResult) -> tuple[Cause, ...]:
    """Causes of the structure in a residual, likeliest first; none where none explains a good part of it.

    Args:
        result: of a fit.
    """
    with working_precision("float64"):
        residual = Residual(result)
        if residual.rounded and not any("structure" in words for words in result.warnings):
            return ()
        tests = [test for test in residual.tests() if _stands_out(test.cause)]
        tests = sorted([*tests, *residual.mirrored()], key=lambda test: -test.gain)
        if not tests:
            return ()
        alike = [test for test in tests[1:] if residual.alike(tests[0], test)]
    first, *others = (test.cause for test in tests)
    name = " or ".join([first.name, *(test.cause.name for test in alike)])
    return (dataclasses.replace(first, name=name), *others)


def _stands_out(cause: Cause) -> bool:
    return cause.share > LEAST_SHARE and abs(cause.size) > LEAST_SIZE * cause.error


class _Picture:
    """Some pixels of a picture, evenly spread, which of them count, and what the fitted material shows there."""

    def __init__(self, result: FitResult, index: int, side: float):
        self.material, self.scene = brdf.cast((result.material, result.scenes[index]), "float64")
        self.file = result.files[index] if result.files else None
        counted, target = result.counted[index], np.asarray(result.targets[index], np.float64)
        some = (slice(None, None, math.ceil(max(counted.shape) / side)),) * 2
        self.pixel, finite = np.arange(counted.size).reshape(counted.shape)[some], np.isfinite(target[some])
        self.counted, self.target = counted[some] & np.all(finite, axis=-1), np.where(finite, target[some], 0.0)
        self.fitted = self.shown(self.scene)

    def seen(self, scene: brdf.Scene) -> brdf.Scene:
        """These pixels of a scene."""
        whole = self.pixel.size == math.prod(scene.resolution)
        return scene if whole else brdf.some_pixels(scene, self.pixel, precision="float64")

    def basis(self, scene: brdf.Scene, n: float) -> Float[np.ndarray, "3 H W C"]:
        """What ambient, diffuse and specular term show of a scene; 0 where there is none."""
        images = brdf.basis_images(type(self.material), self.seen(scene), n)
        parts = (images.ambient, images.diffuse, images.specular)
        return np.stack([np.broadcast_to(0.0 if one is None else one, self.target.shape) for one in parts])

    def shown(self, scene: brdf.Scene) -> Float[np.ndarray, "H W C"]:
        """What the material shows of a scene."""
        k = [np.asarray(getattr(self.material, name, 0.0)) for name in ("k_a", "k_d", "k_s")]
        images = self.basis(scene, float(getattr(self.material, "n", 1.0)))
        return np.sum(list(map(operator.mul, k, images)), axis=0)

    def codes(self, values: Float[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
        """As the file holds them, full scale 1."""
        if self.file is None or self.file["encoding"] == "linear":
            return values
        return encode(np.maximum(values / np.asarray(self.file["factor"]), 0.0), self.file["encoding"])

    def slope(self, change: Callable[[float], np.ndarray], step: float) -> Float[np.ndarray, "*shape"]:
        """The derivative of the codes of what a size makes."""
        return (self.codes(change(step)) - self.codes(change(-step))) / (2 * step)

    def curve(self, values: Float[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
        """The derivative of the codes by the values."""
        return self.slope(lambda step: values + step, CURVED)


class Residual:
    """What all pictures leave, in units of their noise, and what of it the material cannot follow; in float64."""

    def __init__(self, result: FitResult):
        """Look at some of the pixels."""
        side = max(MOST_PIXELS / math.sqrt(len(result.scenes)), FEWEST_PIXELS)
        self.pictures = [_Picture(result, index, side) for index in range(len(result.scenes))]
        scenes = [picture.scene for picture in self.pictures]
        self.changes = [*_light_changes(scenes), *_ball_changes(scenes), *VALUE_CHANGES]
        # Pixels that a step of the circle would move beside the ball.
        for way in (way for change in self.changes if change.unit == "pixels" for way in change.ways):
            for picture, size in itertools.product(self.pictures, (RIM, -RIM)):
                picture.counted &= np.asarray(picture.seen(way(picture.scene, size)).surface_points().mask)
        raw = [picture.codes(picture.target) - picture.codes(picture.fitted) for picture in self.pictures]
        self.noise = _white_noise(raw, [picture.counted for picture in self.pictures])
        for picture in self.pictures:
            # Where noise was cut off at 0 dark pixels are too bright.
            if np.min(picture.target[picture.counted], initial=np.inf) == 0:
                picture.counted &= np.all(picture.codes(picture.fitted) > DARK * self.noise, axis=-1)
        self.tangent = self._material_tangent()
        self.left = self._unfollowed(self._flat(raw)).ravel()
        self.excess = float(np.sum(self.left**2)) - self.left.size

    @property
    def rounded(self) -> bool:
        """Whether rounding to codes is most of the noise: it has a shape of its own, as a wrong scene does."""
        for picture in self.pictures:
            used = np.unique(picture.codes(picture.target)[picture.counted].astype(np.float32))
            if used.size > 1 and ROUNDED * float(np.median(np.diff(used))) > float(np.max(self.noise)):
                return True
        return False

    def tests(self) -> Iterator[_Test]:
        """Each cause that the scenes determine, as large as it explains most."""
        for change in self.changes:
            columns = [self._unfollowed(column).ravel() for column in self._derivatives(change)]
            columns = np.array([column for column in columns if np.any(column)]).T
            if not columns.size:
                continue
            size, gain = self._explained(columns)
            along = size / max(float(np.linalg.norm(size)), np.finfo(float).tiny)
            column = columns @ along
            gram, inflation = column @ column, self._inflation(column * (self.left - columns @ size))
            error = math.sqrt(inflation / gram)
            length = float(size[0]) if len(size) == 1 else float(np.linalg.norm(size))
            if max(abs(length), error) < change.most:
                share = min(gain / max(self.excess, gain), 1.0)
                cause = Cause(change.name, length, error, change.unit, share, change.remedy)
                yield _Test(cause, columns, gain, inflation)

    def mirrored(self) -> Iterator[_Test]:
        """Whether the pictures show the scenes mirrored."""
        if self.excess < LEAST_SIZE**2:
            return
        for words, axis in (("left-right", 1), ("upside down", 0)):
            good = [picture.counted & np.flip(picture.counted, axis) for picture in self.pictures]
            size = sum(map(np.count_nonzero, good)) * self.noise.size
            if 2 * size < self.left.size:
                continue
            # Fitted alike: a picture that is its own mirror image gains nothing.
            before = self._least([picture.target for picture in self.pictures], good)
            gain = before - self._least([np.flip(picture.target, axis) for picture in self.pictures], good)
            share = min(gain / max(before - size, gain, 1.0), 1.0)
            if share > MIRRORED and gain > LEAST_SIZE**2:
                remedy = "flip the picture, or the lights and the shape"
                cause = Cause(f"mirrored {words}", 1.0, 0.0, "", share, remedy)
                yield _Test(cause, np.zeros((self.left.size, 0)), gain, 1.0)

    def alike(self, first: _Test, other: _Test) -> bool:
        """Whether the other cause would do as well: the first explains nothing beside it."""
        gain = other.gain
        if first.columns.size and other.columns.size:
            both = self._explained(np.concatenate([first.columns, other.columns], axis=1))[1]
            return both - gain < ALIKE[first.columns.shape[1]] * first.inflation
        return first.gain - gain < ALIKE[max(first.columns.shape[1], 1)] * first.inflation

    def _explained(self, columns: Float[np.ndarray, "P K"]) -> tuple[Float[np.ndarray, " K"], float]:
        """The sizes that explain most, and the squares that they explain."""
        gram, product = columns.T @ columns, columns.T @ self.left
        size = np.linalg.pinv(gram, rcond=1e-10, hermitian=True) @ product
        return size, float(size @ product)

    def _flat(self, images: Sequence[Float[np.ndarray, "H W C"]]) -> Float[np.ndarray, "P C"]:
        """Of the pixels that count, in units of the noise."""
        both = zip(images, self.pictures, strict=True)
        return np.concatenate([image[picture.counted] for image, picture in both]) / self.noise

    def _derivatives(self, change: _Change) -> Iterator[Float[np.ndarray, "P C"]]:
        """Of the pictures by each direction of a change."""
        for way in change.ways:
            images = []
            for index, picture in enumerate(self.pictures):
                if change.places is None:
                    images.append(picture.slope(partial(way, picture.fitted), STEP))
                elif index in change.places:
                    images.append(picture.slope(lambda size, p=picture, w=way: p.shown(w(p.scene, size)), STEP))
                else:
                    images.append(np.zeros_like(picture.target))
            yield self._flat(images)

    def _material_tangent(self) -> list[Float[np.ndarray, "P K"]]:
        """What the coefficients of each channel, and the exponent, move; orthonormal."""
        moves = []
        for picture in self.pictures:
            n, curve = float(getattr(picture.material, "n", 1.0)), picture.curve(picture.fitted)
            here, ahead, behind = (picture.basis(picture.scene, n * factor) for factor in (1.0, 1 + 1e-4, 1 - 1e-4))
            by_n = np.asarray(getattr(picture.material, "k_s", 0.0)) * (ahead[2] - behind[2]) / 1e-4
            moves.append([curve * image for image in (*here, by_n)])
        columns = list(map(self._flat, zip(*moves, strict=True)))
        tangents = []
        for channel in range(self.noise.size):
            matrix = np.stack([column[:, channel] for column in columns], axis=1)
            norm = np.linalg.norm(matrix, axis=0)
            vectors, values, _ = np.linalg.svd(matrix[:, norm > 0] / norm[norm > 0], full_matrices=False)
            tangents.append(vectors[:, values > 1e-6])
        return tangents

    def _least(self, targets: list[Float[np.ndarray, "H W C"]], good: list[Bool[np.ndarray, "H W"]]) -> float:
        """Squares that the model leaves of some pixels of pictures, in units of the noise."""
        solved, both = [], list(zip(self.pictures, targets, good, strict=True))
        for picture, target, some in both:
            seen, weight = picture.seen(picture.scene), some[..., None] * picture.curve(target) ** 2
            values, weight = (jnp.asarray(a.reshape(-1, self.noise.size)) for a in (target, weight))
            tile = Tile(values, weight, seen.surface_points(), seen)
            solved.append(picture_of(type(picture.material), tile))
        best, left = search(solved), 0.0
        for (picture, target, some), one in zip(both, solved, strict=True):
            shown = one.shown(best.n, best.x).reshape(target.shape)
            left += float(np.sum(((picture.codes(target) - picture.codes(shown))[some] / self.noise) ** 2))
        return left

    def _unfollowed(self, values: Float[np.ndarray, "P C"]) -> Float[np.ndarray, "P C"]:
        """What the material cannot follow; 0 where that is next to nothing."""
        parts = [value - basis @ (basis.T @ value) for value, basis in zip(values.T, self.tangent, strict=True)]
        left = np.stack(parts, axis=1)
        return left if np.sum(left**2) > FOLLOWED * np.sum(values**2) else np.zeros_like(left)

    def _inflation(self, scores: Float[np.ndarray, " P"]) -> float:
        """By how much their sum varies more than that of independent scores of its own size.

        Channels of a pixel, and pixels of a block, may err together: squares of their sums, over those of each.
        """
        every = [picture.counted for picture in self.pictures]
        ends, together = np.cumsum(list(map(np.count_nonzero, every)))[:-1], 0.0
        for counted, part in zip(every, np.split(scores.reshape(-1, self.noise.size), ends), strict=True):
            if len(part):
                errors = Errors(np.sum(part, axis=1, keepdims=True), np.flatnonzero(counted), counted.shape[1])
                together += float(np.sum(over_blocks(errors, BLOCK)[0] ** 2))
        return max(together / max(float(np.sum(scores**2)), np.finfo(float).tiny), 1.0)


def _white_noise(
    residuals: list[Float[np.ndarray, "H W C"]], counted: list[Bool[np.ndarray, "H W"]]
) -> Float[np.ndarray, " C"]:
    """Standard deviation of what single pixels err: from differences of neighbours, which know no wide structure."""
    total, count = 0.0, 0
    for residual, good in zip(residuals, counted, strict=True):
        for axis in (0, 1):
            one, other = (np.take(good, range(i, good.shape[axis] - 1 + i), axis) for i in (0, 1))
            differences = np.diff(residual, axis=axis)[one & other]
            total, count = total + np.sum(differences**2, axis=0), count + 2 * len(differences)
    scale = max(float(np.max(np.abs(residual), initial=0.0)) for residual in residuals)
    return np.sqrt(total / max(count, 1)) + np.float64(1e-7 * scale + np.finfo(float).tiny)


def _power(values: Any, percent: float) -> Any:
    return np.where(values > 0, np.where(values > 0, values, 1.0) ** (1 + percent / 100), 0.0)


def _raised(values: Any, percent: float) -> Any:
    return values + percent / 100


BLACK = (
    "subtract the camera's black level, or give the scene the [ambient] light that it lacks, a photograph --ambient, "
    "and k_a takes it up"
)
VALUE_CHANGES = (
    _Change("gamma", "%", "state how the file is encoded: --encoding srgb, linear or a gamma", math.inf, (_power,)),
    _Change("black", "% of white", BLACK, 50.0, (_raised,)),
)


def _light_changes(scenes: Scenes) -> Iterator[_Change]:
    """Of each light, shared by the pictures where it is the same in all."""
    for index in range(max(len(scene.lights) for scene in scenes)):
        having = [place for place, scene in enumerate(scenes) if index < len(scene.lights)]
        lights = [scenes[place].lights[index] for place in having]
        ways = [np.asarray(getattr(light, "direction", np.zeros(3))) for light in lights]
        same = all(type(light) is type(lights[0]) for light in lights) and all(np.array_equal(ways[0], w) for w in ways)
        which = f" {index}" if max(len(scene.lights) for scene in scenes) > 1 else ""
        for places in [having] if same else [[place] for place in having]:
            name = which if len(places) == len(scenes) else f"{which} of picture {places[0]}"
            if isinstance(scenes[places[0]].lights[index], brdf.DirectionalLight):
                remedy, turns = (
                    "free its direction: fit_jointly, --free light",
                    (partial(_turned, index, 0), partial(_turned, index, 1)),
                )
                yield _Change(f"light{name}", "degrees", remedy, 30.0, turns, places)
            remedy = "free it: fit_jointly or fit_lights, --free intensity"
            yield _Change(f"intensity{name}", "%", remedy, 100.0, (partial(_brighter, index),), places)


def _with_light(scene: brdf.Scene, index: int, light: Any) -> brdf.Scene:
    return dataclasses.replace(scene, lights=(*scene.lights[:index], light, *scene.lights[index + 1 :]))


def _turned(index: int, axis: int, scene: brdf.Scene, degrees: float) -> brdf.Scene:
    light: Any = scene.lights[index]
    direction, angle = np.asarray(light.direction), math.radians(degrees)
    across = np.linalg.svd(direction[None])[2][1 + axis] * np.linalg.norm(direction)
    turned = math.cos(angle) * direction + math.sin(angle) * across
    return _with_light(scene, index, dataclasses.replace(light, direction=turned))


def _brighter(index: int, scene: brdf.Scene, percent: float) -> brdf.Scene:
    light = scene.lights[index]
    emittance = np.asarray(light.emittance) * (1 + percent / 100)
    return _with_light(scene, index, eqx.tree_at(lambda one: one.emittance, light, emittance))


def _ball_changes(scenes: Scenes) -> Iterator[_Change]:
    """Where each picture shows one sphere and nothing else."""
    if any(len(scene.shapes) != 1 or not isinstance(scene.shapes[0], brdf.Sphere) for scene in scenes):
        return
    if any(scene.camera is None for scene in scenes):
        return
    most, places = 0.1 * min(scenes[0].resolution), range(len(scenes))
    for name, ways in {"ball": [(0, 1.0, 0.0), (1, 1.0, 0.0)], "radius": [(0, 0.0, 1.0)]}.items():
        remedy = f"find its circle again, or free it: fit_jointly, --free {name}"
        yield _Change(name, "pixels", remedy, most, tuple(partial(_moved, *way) for way in ways), places)


def _moved(axis: int, shift: float, growth: float, scene: brdf.Scene, pixels: float) -> brdf.Scene:
    sphere: Any = scene.shapes[0]
    camera: Any = scene.camera
    width, height = camera.resolution
    column, row = np.array([0.0, 1.0, 0.0]) + width / 2, np.array([0.0, 0.0, 1.0]) + height / 2
    origin, direction = (np.asarray(part.stacked(), np.float64) for part in camera.rays(column, row))
    far = origin + direction * np.linalg.norm(np.asarray(sphere.center) - np.asarray(camera.position))
    pixel = far[1 + axis] - far[0]
    centre = np.asarray(sphere.center) + shift * pixels * pixel
    radius = np.asarray(sphere.radius) + growth * pixels * np.linalg.norm(pixel)
    return dataclasses.replace(scene, shapes=(dataclasses.replace(sphere, center=centre, radius=radius),))
