"""What is wrong with the scene: which of its numbers, a little different, would explain what the fit leaves.

Noise has no shape. Where the residual has one, something that the scene says is not so: a light that stands elsewhere,
a ball whose circle is off, a curve that was not undone. The renderer tells how the picture changes with each of them;
what of that change the material cannot follow is compared with the residual. That is a score test (Rao 1948, Proc.
Camb. Phil. Soc. 44, 50): one linear least squares for each cause, and nothing is fitted again. A mirrored picture is no
small change: it is fitted.

Pictures are compared in the codes of their file where it has a curve, since noise and rounding are even there.
"""

import dataclasses
import math
import operator
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

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

Images = list[Float[np.ndarray, "H W C"]]
Masks = Sequence[Bool[np.ndarray, "H W"]]
Scenes = Sequence[brdf.Scene]


class _Change(NamedTuple):
    """A way in which scenes or pictures may be a little wrong.

    Attributes:
        name: of the cause.
        unit: of its size.
        remedy: what to do.
        most: a larger size, or error, is no small change.
        scenes: for each direction, from a size to other scenes; those that stay are the same objects.
        values: from linear values and a size to others, where it is the picture that is wrong.
    """

    name: str
    unit: str
    remedy: str
    most: float
    scenes: tuple[Callable[[float], Scenes], ...] = ()
    values: Callable[[Any, float], Any] | None = None


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
        residual = _Residual(result)
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


def possible_causes(result: FitResult) -> tuple[Cause, ...]:
    """All small changes that the scenes determine, however small and whatever they explain.

    Args:
        result: of a fit.
    """
    with working_precision("float64"):
        return tuple(test.cause for test in _Residual(result).tests())


def _stands_out(cause: Cause) -> bool:
    return cause.share > LEAST_SHARE and abs(cause.size) > LEAST_SIZE * cause.error


class _Residual:
    """What all pictures leave, in units of their noise, and what of it the material cannot follow."""

    def __init__(self, result: FitResult):
        self.material = brdf.cast(result.material, "float64")
        self.scenes = [brdf.cast(scene, "float64") for scene in result.scenes]
        self.files = result.files or [None] * len(self.scenes)
        side = max(MOST_PIXELS / math.sqrt(len(self.scenes)), FEWEST_PIXELS)
        self.pixels = [_evenly(counted.shape, side) for counted in result.counted]
        self.counted = [counted.ravel()[pixel] for counted, pixel in zip(result.counted, self.pixels, strict=True)]
        self.targets = [
            np.asarray(target, np.float64).reshape(-1, target.shape[-1])[pixel]
            for target, pixel in zip(result.targets, self.pixels, strict=True)
        ]
        self.changes = [*_light_changes(self.scenes), *_ball_changes(self.scenes), *VALUE_CHANGES]
        self._leave_out_rims()
        self.fitted = self._rendered(self.scenes)
        raw = [one - other for one, other in zip(self._codes(self.targets), self._codes(self.fitted), strict=True)]
        self.noise = _white_noise(raw, self.counted)
        self._leave_out_dark()
        self.tangent = self._material_tangent()
        self.left = self._unfollowed(self._flat(raw)).ravel()
        self.excess = float(np.sum(self.left**2)) - self.left.size

    @property
    def rounded(self) -> bool:
        """Whether rounding to codes is most of the noise: it has a shape of its own, as a wrong scene does."""
        for codes, counted in zip(self._codes(self.targets), self.counted, strict=True):
            used = np.unique(codes[counted].astype(np.float32))
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
            good = [counted & np.flip(counted, axis) for counted in self.counted]
            if 2 * sum(map(np.count_nonzero, good)) < sum(map(np.count_nonzero, self.counted)):
                continue
            # Fitted alike: a picture that is its own mirror image gains nothing.
            before, size = self._least(self.targets, good)
            gain = before - self._least([np.flip(target, axis) for target in self.targets], good)[0]
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

    def _rendered(self, scenes: Scenes) -> Images:
        """Pictures of the fitted material; of scenes that stayed what they are already."""
        found, n = [], float(getattr(self.material, "n", 1.0))
        k = [np.asarray(getattr(self.material, name, 0.0), np.float64) for name in ("k_a", "k_d", "k_s")]
        for index, scene in enumerate(scenes):
            same = scene is self.scenes[index] and hasattr(self, "fitted")
            found.append(self.fitted[index] if same else sum(map(operator.mul, k, self._basis(index, n, scene))))
        return found

    def _codes(self, images: Images) -> Images:
        """As their files hold them, full scale 1."""
        return [
            image
            if file is None or file["encoding"] == "linear"
            else encode(np.maximum(image / np.asarray(file["factor"]), 0.0), file["encoding"])
            for image, file in zip(images, self.files, strict=True)
        ]

    def _flat(self, images: Images) -> Float[np.ndarray, "P C"]:
        """Of the pixels that count, in units of the noise."""
        return (
            np.concatenate([image[counted] for image, counted in zip(images, self.counted, strict=True)]) / self.noise
        )

    def _curves(self, images: Images) -> Images:
        """The derivatives of the codes by the values."""
        ahead, behind = (self._codes([image + step for image in images]) for step in (CURVED, -CURVED))
        return [(one - other) / (2 * CURVED) for one, other in zip(ahead, behind, strict=True)]

    def _slope(self, ahead: Images, behind: Images, step: float) -> Float[np.ndarray, "P C"]:
        both = zip(self._codes(ahead), self._codes(behind), strict=True)
        return self._flat([(one - other) / (2 * step) for one, other in both])

    def _derivatives(self, change: _Change) -> Iterator[Float[np.ndarray, "P C"]]:
        """Of the pictures by each direction of a change."""
        if change.values is not None:
            ahead, behind = ([change.values(image, step) for image in self.fitted] for step in (STEP, -STEP))
            yield self._slope(ahead, behind, STEP)
        for scenes in change.scenes:
            yield self._slope(self._rendered(scenes(STEP)), self._rendered(scenes(-STEP)), STEP)

    def _leave_out_rims(self) -> None:
        """Pixels that a step of the circle would move beside the ball, and those that are not finite."""
        self.counted = [
            counted & np.all(np.isfinite(target), axis=-1)
            for counted, target in zip(self.counted, self.targets, strict=True)
        ]
        for step in (step for change in self.changes if change.unit == "pixels" for step in change.scenes):
            for size in (RIM, -RIM):
                for index, scene in enumerate(step(size)):
                    seen = _seen(scene, self.pixels[index]).surface_points()
                    self.counted[index] &= np.asarray(seen.mask)
        self.targets = [np.where(np.isfinite(target), target, 0.0) for target in self.targets]

    def _leave_out_dark(self) -> None:
        """Where noise was cut off at 0 dark pixels are too bright."""
        for index, (target, counted) in enumerate(zip(self.targets, self.counted, strict=True)):
            least = np.min(target[counted], initial=np.inf)
            if least == 0:
                level = self._codes(self.fitted)[index]
                self.counted[index] = counted & np.all(level > DARK * self.noise, axis=-1)

    def _material_tangent(self) -> list[Float[np.ndarray, "P K"]]:
        """What the coefficients of each channel, and the exponent, move; orthonormal."""
        n, step = float(getattr(self.material, "n", 1.0)), 1e-4
        k_s = np.asarray(getattr(self.material, "k_s", 0.0), np.float64)
        moves = []
        for index in range(len(self.scenes)):
            here, ahead, behind = (self._basis(index, n * factor) for factor in (1.0, 1 + step, 1 - step))
            moves.append([*here, k_s * (ahead[2] - behind[2]) / step])
        curves = self._curves(self.fitted)
        columns = [
            self._flat([curve * image for curve, image in zip(curves, images, strict=True)])
            for images in zip(*moves, strict=True)
        ]
        tangents = []
        for channel in range(self.noise.size):
            matrix = np.stack([column[:, channel] for column in columns], axis=1)
            norm = np.linalg.norm(matrix, axis=0)
            vectors, values, _ = np.linalg.svd(matrix[:, norm > 0] / norm[norm > 0], full_matrices=False)
            tangents.append(vectors[:, values > 1e-6])
        return tangents

    def _basis(self, index: int, n: float, scene: brdf.Scene | None = None) -> tuple[np.ndarray, ...]:
        """What ambient, diffuse and specular term show of a scene, or of one in its place; 0 where there is none."""
        seen = _seen(scene or self.scenes[index], self.pixels[index])
        images = brdf.basis_images(type(self.material), seen, n)
        shape = self.targets[index].shape
        parts = (images.ambient, images.diffuse, images.specular)
        ambient, diffuse, specular = (np.zeros(shape) if one is None else np.broadcast_to(one, shape) for one in parts)
        return ambient, diffuse, specular

    def _squares(self, targets: Images, images: Images, good: Masks) -> tuple[float, int]:
        """Squares of what images leave of some pixels, in units of the noise, and how many values these are."""
        both = zip(self._codes(targets), self._codes(images), good, strict=True)
        left = np.concatenate([(one - other)[some] for one, other, some in both]) / self.noise
        return float(np.sum(left**2)), left.size

    def _least(self, targets: Images, good: Masks) -> tuple[float, int]:
        """Squares that the model leaves of some pixels of pictures, and how many values these are."""
        pictures = []
        both = zip(targets, good, self._curves(targets), self.scenes, self.pixels, strict=True)
        for target, some, curve, scene, pixel in both:
            seen = _seen(scene, pixel)
            values, weight = (a.reshape(-1, self.noise.size) for a in (target, some[..., None] * curve**2))
            tile = Tile(jnp.asarray(values), jnp.asarray(weight), seen.surface_points(), seen)
            pictures.append(picture_of(type(self.material), tile))
        best = search(pictures)
        images = [picture.shown(best.n, best.x) for picture in pictures]
        images = [image.reshape(target.shape) for image, target in zip(images, targets, strict=True)]
        return self._squares(targets, images, good)

    def _unfollowed(self, values: Float[np.ndarray, "P C"]) -> Float[np.ndarray, "P C"]:
        """What the material cannot follow; 0 where that is next to nothing."""
        parts = [value - basis @ (basis.T @ value) for value, basis in zip(values.T, self.tangent, strict=True)]
        left = np.stack(parts, axis=1)
        return left if np.sum(left**2) > FOLLOWED * np.sum(values**2) else np.zeros_like(left)

    def _inflation(self, scores: Float[np.ndarray, " P"]) -> float:
        """By how much their sum varies more than that of independent scores of its own size.

        Channels of a pixel, and pixels of a block, may err together: squares of their sums, over those of each.
        """
        ends = np.cumsum([np.count_nonzero(counted) for counted in self.counted])[:-1]
        together = 0.0
        for counted, part in zip(self.counted, np.split(scores.reshape(-1, self.noise.size), ends), strict=True):
            if len(part):
                errors = Errors(np.sum(part, axis=1, keepdims=True), np.flatnonzero(counted), counted.shape[1])
                together += float(np.sum(over_blocks(errors, BLOCK)[0] ** 2))
        return max(together / max(float(np.sum(scores**2)), np.finfo(float).tiny), 1.0)


def _evenly(shape: tuple[int, int], side: float) -> Int[np.ndarray, "H W"]:
    """Pixels of a picture, row by row, evenly spread."""
    stride = math.ceil(max(shape) / side)
    return np.arange(shape[0])[::stride, None] * shape[1] + np.arange(shape[1])[::stride]


def _seen(scene: brdf.Scene, pixel: Int[np.ndarray, "H W"]) -> brdf.Scene:
    return scene if pixel.size == math.prod(scene.resolution) else brdf.some_pixels(scene, pixel, precision="float64")


def _white_noise(residuals: Images, counted: Masks) -> Float[np.ndarray, " C"]:
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


VALUE_CHANGES = (
    _Change("gamma", "%", "state how the file is encoded: --encoding srgb, linear or a gamma", math.inf, (), _power),
    _Change(
        "black",
        "% of white",
        "subtract the camera's black level, or give the scene the ambient light that it lacks",
        50.0,
        (),
        lambda values, percent: values + percent / 100,
    ),
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
                turns = tuple(_turned(scenes, places, index, axis) for axis in (0, 1))
                yield _Change(f"light{name}", "degrees", "free its direction: fit_jointly, --free light", 30.0, turns)
            remedy = "free it: fit_jointly or fit_lights, --free intensity"
            yield _Change(f"intensity{name}", "%", remedy, 100.0, (_brighter(scenes, places, index),))


def _with_light(scenes: Scenes, places: Sequence[int], index: int, change: Callable[[Any], Any]) -> list[brdf.Scene]:
    changed = list(scenes)
    for place in places:
        lights = list(scenes[place].lights)
        lights[index] = change(lights[index])
        changed[place] = dataclasses.replace(scenes[place], lights=tuple(lights))
    return changed


def _turned(scenes: Scenes, places: Sequence[int], index: int, axis: int) -> Callable[[float], Scenes]:
    def turn(light: Any, degrees: float) -> Any:
        direction = np.asarray(light.direction, np.float64)
        across = np.linalg.svd(direction[None])[2][1 + axis] * np.linalg.norm(direction)
        angle = math.radians(degrees)
        return dataclasses.replace(light, direction=math.cos(angle) * direction + math.sin(angle) * across)

    return lambda degrees: _with_light(scenes, places, index, lambda light: turn(light, degrees))


def _brighter(scenes: Scenes, places: Sequence[int], index: int) -> Callable[[float], Scenes]:
    def change(light: Any, percent: float) -> Any:
        return eqx.tree_at(lambda one: one.emittance, light, np.asarray(light.emittance) * (1 + percent / 100))

    return lambda percent: _with_light(scenes, places, index, lambda light: change(light, percent))


def _ball_changes(scenes: Scenes) -> Iterator[_Change]:
    """Where each picture shows one sphere and nothing else."""
    if any(len(scene.shapes) != 1 or not isinstance(scene.shapes[0], brdf.Sphere) for scene in scenes):
        return
    if any(scene.camera is None for scene in scenes):
        return
    most = 0.1 * min(scenes[0].resolution)
    moves = tuple(_moved(scenes, axis, 1.0, 0.0) for axis in (0, 1))
    yield _Change("ball", "pixels", "find its circle again, or free it: fit_jointly, --free ball", most, moves)
    grows = (_moved(scenes, 0, 0.0, 1.0),)
    yield _Change("radius", "pixels", "find its circle again, or free it: fit_jointly, --free radius", most, grows)


def _moved(scenes: Scenes, axis: int, shift: float, growth: float) -> Callable[[float], Scenes]:
    def move(scene: brdf.Scene, pixels: float) -> brdf.Scene:
        sphere: Any = scene.shapes[0]
        camera: Any = scene.camera
        width, height = camera.resolution
        column, row = np.array([0.0, 1.0, 0.0]) + width / 2, np.array([0.0, 0.0, 1.0]) + height / 2
        origin, direction = (np.asarray(part, np.float64) for part in camera.rays(column, row))
        far = origin + direction * np.linalg.norm(np.asarray(sphere.center) - np.asarray(camera.position))
        pixel = far[1 + axis] - far[0]
        centre = np.asarray(sphere.center) + shift * pixels * pixel
        radius = np.asarray(sphere.radius) + growth * pixels * np.linalg.norm(pixel)
        return dataclasses.replace(scene, shapes=(dataclasses.replace(sphere, center=centre, radius=radius),))

    return lambda pixels: [move(scene, pixels) for scene in scenes]
