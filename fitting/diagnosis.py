"""What is wrong with the scene: which of its numbers, a little different, would explain what the fit leaves.

Noise has no shape. Where the residual has one, something that the scene says is not so: a light that stands elsewhere,
a ball whose circle is off, a curve that was not undone. The renderer tells how the picture changes with each of them;
what of that change the material cannot follow is compared with the residual. That is a score test (Rao 1948, Proc.
Camb. Phil. Soc. 44, 50): one linear least squares for each cause. Beside the likeliest the material is fitted again,
which tells its size; a mirrored picture and another model are no small changes, and are fitted, too.

Pictures are compared in the codes of their file where it has a curve, since noise and rounding are even there.
"""

import dataclasses
import functools
import itertools
import math
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

import brdf
from brdf.errors import InputError
from brdf.images.encoding import encode
from brdf.lobes import Near
from brdf.precision import working_precision
from brdf.rendering import basis_columns
from brdf.vectors import quotient
from fitting.budget.sampling import sample_counts, with_samples
from fitting.core import fit_pictures
from fitting.joint_problem import JointProblem, joint_problem, place_of, scene_leaves, turns
from fitting.likelihood import how_many_alike, weight_of_alike
from fitting.model_fit import N_RANGE
from fitting.problem import state_problem
from fitting.result import Cause, FitResult
from fitting.solver.normal_equations import Picture
from fitting.solver.profile import search, within_sight
from fitting.tile import Tile, picture_of

BLACK = (
    "subtract the camera's black level, or give the scene the [ambient] light that it lacks, a photograph --ambient, "
    "and k_a takes it up"
)
# Of each kind of cause the unit, what to do, and what size or error is no small change, of pixels the share of a side.
KINDS = {
    "light": ("degrees", "free it: fit_jointly, --free light", 30.0),
    "distance": ("%", "free its position: fit_jointly, --free distance", 50.0),
    "intensity": ("%", "free it: fit_jointly or fit_lights, --free intensity", 100.0),
    "ball": ("pixels", "find its circle again, or free it: fit_jointly, --free ball", 0.1),
    "radius": ("pixels", "find its circle again, or free it: fit_jointly, --free radius", 0.1),
    "gamma": ("%", "state how the file is encoded: --encoding srgb, linear or a gamma", math.inf),
    "black": ("% of white", BLACK, 50.0),
}
MIRRORED = {"mirrored left-right": 1, "mirrored upside down": 0}
# A cause is named where it explains this share of the structure, and is this many times its error.
LEAST_SHARE, LEAST_SIZE = 0.3, 5.0
FLIP = "flip the picture, or the lights and the shape"
# A mirrored picture, or another model, explains more than this share.
LEAST_REFITTED = 0.5
# Two causes are not told apart where beside one the other explains no more than 2 standard errors would: chi squared,
# by how many numbers it has.
ALIKE = {0: 4.0, 1: 4.0, 2: 6.18}
# A change that the material follows, all but this share of the squares, says nothing.
FOLLOWED = 1e-6
# Half the difference of the pictures that make a derivative, in units of the cause: degrees, pixels, per cent.
STEP = 0.05
# Of a size found by slopes the parts that are tried, how often, and how far each time leads at most.
ABOUT, REFINEMENTS, NEAR = np.array([0.9, 1.0, 1.1]), 2, np.array([0.5, 2.0])
# Pixels on a side of the blocks within which errors go together.
BLOCK = 16
# Pixels on a side that are looked at, if it were one picture, the same under lights of many samples, and at least of
# each picture.
MOST_PIXELS, MOST_SAMPLED, FEWEST_PIXELS = 256, 96, 48
# Of a ball's radius what is looked at where its circle may be far off, and the share that such a cause explains.
INNER, LEAST_INNER = 0.8, 0.6
# So many pixels from the outline a small step of the circle makes no small change.
RIM = 1.5
# Light samples, unless fewer, as the scene says, leave less: what these leave out has a shape too.
SAMPLES = 1024
# At most, where slopes are made of the difference of two pictures, which have the same.
SLOPE_SAMPLES = 256
# What these leave out of the pictures hides no other model where it is below this share of the structure.
HIDDEN = 0.1
# What is darker than so many standard deviations is left out where noise was cut off at 0.
DARK = 3.0
# Of a step between codes: noise below that is mostly rounding.
ROUNDED = 0.5
# Half the difference of the values that make the slope of a file's curve.
CURVED = 1e-4
TINY = np.finfo(float).tiny


class _Test(NamedTuple):
    """A cause, and what tells it.

    Attributes:
        cause: as it is told.
        columns: what of its change the material cannot follow, in units of noise.
        gain: the squares that it explains.
        inflation: of its error's square, by what errs together.
        sizes: of its moves.
    """

    cause: Cause
    columns: Float[np.ndarray, "P K"]
    gain: float
    inflation: float = 1.0
    sizes: Float[np.ndarray, " K"] = np.zeros(0)


def diagnose(result: FitResult) -> tuple[Cause, ...]:
    """Causes of the structure in a residual, likeliest first; none where none explains a good part of it."""
    found, balls = _causes(result), [_ball(scene) for scene in result.scenes]
    if found or None in balls or not any("structure" in words for words in result.warnings):
        return found
    # Pixels beside a ball whose circle is far off lead the fit astray: without what is near its outline.
    masks = []
    for ball, scene, counted in zip(balls, result.scenes, result.counted, strict=True):
        smaller = dataclasses.replace(ball, radius=ball.radius * INNER)
        masks.append(counted & np.asarray(dataclasses.replace(scene, shapes=(smaller,)).surface_points().mask))
    about = list(result.targets), list(result.scenes), masks
    problem = state_problem(*about, rounding=0, model=type(result.material).name)
    try:
        found = _causes(dataclasses.replace(fit_pictures(problem), files=result.files))
    except InputError:  # next to nothing is left
        return ()
    return tuple(cause for cause in found if cause.share > LEAST_INNER)


def _ball(scene: brdf.Scene) -> Any:
    """The sphere that is all of a scene's shapes; None where it is not."""
    return scene.shapes[0] if len(scene.shapes) == 1 and isinstance(scene.shapes[0], brdf.Sphere) else None


def _causes(result: FitResult) -> tuple[Cause, ...]:
    with working_precision("float64"):
        residual = Residual(result)
        if 1 < _most_samples(result) < SAMPLES:
            finer = [with_samples(scene, SAMPLES) for scene in result.scenes]
            residual = min(residual, Residual(dataclasses.replace(result, scenes=finer)), key=lambda one: one.square)
        # What a codec leaves has a shape of its own, as a wrong scene does.
        unspoilt = all(file is not None and not file.get("lossy", True) for file in result.files or [None])
        if residual.rounded and not unspoilt and not any("structure" in words for words in result.warnings):
            return ()
        found = [
            test
            for test in residual.tests()
            if test.cause.share > LEAST_SHARE and abs(test.cause.size) > LEAST_SIZE * test.cause.error
        ]
        tests = sorted([*found, *residual.refitted()], key=lambda test: -test.gain)
        alike = [test.cause.name for test in tests[1:] if residual.alike(tests[0], test)]
        causes = [*map(residual.refined, tests[:1]), *(test.cause for test in tests[1:])]
    if causes:
        causes[0] = dataclasses.replace(causes[0], name=" or ".join([causes[0].name, *alike]))
    return tuple(causes)


class _Picture:
    """Some pixels of a picture, evenly spread, which of them count, and what the fitted material shows there.

    Attributes:
        left: what is left of its codes.
        noise: of single pixels in each channel, in codes.
        moves: by the name of a cause what a change of size 1 adds to freed numbers, which are called by their leaves,
            or to what is shown.
    """

    def __init__(self, result: FitResult, index: int, side: float):
        self.scene, self.file = result.scenes[index], result.files[index] if result.files else None
        many = max(sample_counts(self.scene), default=1) > SLOPE_SAMPLES
        coarse = with_samples(self.scene, SLOPE_SAMPLES) if many else self.scene
        self._problem, self._coarse = (
            joint_problem(brdf.cast((result.material, [scene]), "float64"), _leaves) for scene in (self.scene, coarse)
        )
        counted, target = result.counted[index], np.asarray(result.targets[index], np.float64)
        some = (slice(None, None, math.ceil(max(counted.shape) / side)),) * 2
        self._pixel, finite = np.arange(counted.size).reshape(counted.shape)[some], np.isfinite(target[some])
        self.counted, self.target = counted[some] & np.all(finite, axis=-1), np.where(finite, target[some], 0.0)
        several = max(len(scene.lights) for scene in result.scenes) > 1
        one_of = f" of picture {index}" if len(result.scenes) > 1 else ""
        self.moves: dict[str, Sequence[Any]] = {}
        camera, ball = self.scene.camera, _ball(self.scene)
        middle = self._middle() if ball is None else ball.center
        for at, light in enumerate(self.scene.lights):
            which, leaf = (f" {at}" if several else "") + one_of, f"lights[{at}]"
            place = place_of(light)
            if place == "direction":
                self.moves[f"light{which}"] = [{f"{leaf}.direction": turn} for turn in math.radians(1) * np.eye(2)]
            elif place is not None:
                away = np.asarray(getattr(light, place), np.float64) - middle
                across = math.radians(1) * np.asarray(turns(jnp.asarray(away)))
                self.moves[f"light{which}"] = [{f"{leaf}.{place}": turn} for turn in across]
                self.moves[f"distance{which}"] = [{f"{leaf}.{place}": away / 100}]
            field = "intensity" if "intensity" in vars(light) else "radiance"
            self.moves[f"intensity{which}"] = [{f"{leaf}.{field}": np.asarray(light.emittance) / 100}]
        if camera is not None and ball is not None:
            width, height = camera.resolution
            corners = np.array([0.0, 1.0, 0.0]) + width / 2, np.array([0.0, 0.0, 1.0]) + height / 2
            origin, direction = (np.asarray(part, np.float64) for part in _rays(camera, *corners))
            far = origin + direction * np.linalg.norm(np.asarray(ball.center) - np.asarray(camera.position))
            pixels = far[1:] - far[0]
            self.moves["ball"] = [{"shapes[0].center": pixel} for pixel in pixels]
            self.moves["radius"] = [{"shapes[0].radius": np.linalg.norm(pixels[0])}]
            # Pixels that a step of the circle would move beside the ball.
            for move in (*self.moves["ball"], *self.moves["radius"]):
                for size in (RIM, -RIM):
                    self.counted &= np.asarray(self.moved(move, size)[1].surface_points().mask)
        self.fitted = self.shown({}, 0.0)
        codes = self.codes(self.fitted)
        self.left = self.codes(self.target) - codes
        self.noise, self.step = _white_noise(self.left, self.counted[..., None]), self._step()
        self.weight = np.ones(self.target.shape)
        if self.rounded:
            # Values that are predicted alike, as on an unlit side, share a rounding error: together they are one.
            alike = np.zeros(self.target.shape)
            alike[self.counted] = np.stack([how_many_alike(c / self.step) for c in codes[self.counted].T], axis=-1)
            self.noise = _white_noise(self.left, self.counted[..., None] & (alike == 0))
            self.weight = weight_of_alike(alike, self.noise / self.step)
        # Where noise was cut off at 0 dark pixels are too bright.
        if np.min(self.target[self.counted], initial=np.inf) == 0:
            self.counted &= np.all(codes > DARK * self.noise, axis=-1)
        logarithm = np.log(np.where(self.fitted > 0, self.fitted, 1.0))
        self.moves["gamma"] = [0.01 * self.fitted * logarithm]
        self.moves["black"] = [np.full(self.fitted.shape, 0.01)]

    def _middle(self) -> Float[np.ndarray, "3"]:
        """Of the surface that counts."""
        points = brdf.some_pixels(self.scene, self._pixel, precision="float64").surface_points()
        return np.asarray(points.position)[self.counted].sum(axis=0) / max(np.count_nonzero(self.counted), 1)

    def _step(self) -> float:
        """Between the codes that are used; 0 where there is only one."""
        used = np.unique(self.codes(self.target)[self.counted].astype(np.float32))
        return float(np.median(np.diff(used))) if used.size > 1 else 0.0

    @property
    def rounded(self) -> bool:
        """Whether rounding to codes is most of the noise."""
        return ROUNDED * self.step > float(np.max(self.noise))

    @functools.cached_property
    def missed(self) -> float:
        """Squares of what the light samples of slopes leave out, in units of the noise."""
        left = self.codes(np.asarray(brdf.render(*self.moved({}, 0.0, coarse=True)))) - self.codes(self.fitted)
        return float(np.sum((self.weight * (left / self.noise) ** 2)[self.counted]))

    def moved(self, move: dict[str, Any], size: float, *, coarse: bool = False) -> tuple[brdf.Material, brdf.Scene]:
        """The material, and these pixels of the scene, some numbers moved, or coarse, with the samples of slopes."""
        problem = self._coarse if move or coarse else self._problem
        vector = np.array(problem.start())
        for leaf in problem.freed:
            vector[leaf.numbers] += size * move.get(leaf.words, 0.0)
        material, (scene,) = _content(problem, vector)
        return material, brdf.some_pixels(scene, self._pixel, precision="float64")

    def shown(self, move: dict[str, Any], size: float) -> Float[np.ndarray, "H W C"]:
        """The picture with some numbers moved."""
        return np.asarray(brdf.render(*self.moved(move, size)))

    def lit(self, model: type[brdf.Material], coarse: bool, move: dict[str, Any] | None = None) -> Picture:
        """As the solver takes them, some numbers moved, with the light samples of slopes where coarse."""
        scene = self.moved(move or {}, 1.0, coarse=coarse)[1]
        target = jnp.asarray(self.target.reshape(-1, self.target.shape[-1]))
        every = Near.between(math.log(N_RANGE[0]), math.log(N_RANGE[1]), 0.0)
        return picture_of(model, Tile(target, None, scene.surface_points(), scene), every)

    def slopes(self, moves: Sequence[Any]) -> Float[np.ndarray, "K H W C"]:
        """The derivatives of the codes by the sizes of moves."""
        return self.curve(self.fitted) * np.stack(list(map(self._slope, moves)))

    def _slope(self, move: Any) -> Float[np.ndarray, "H W C"]:
        if not isinstance(move, dict):
            return move
        return (self.shown(move, STEP) - self.shown(move, -STEP)) / (2 * STEP)

    def material_slopes(self) -> Float[np.ndarray, "4 H W C"]:
        """Those by k_a, k_d, k_s and, but for a factor, n."""
        material, scene = self.moved({}, 0.0)
        found = np.array(basis_columns(material, scene))
        found[3] *= np.asarray(getattr(material, "k_s", 0.0))
        return self.curve(self.fitted) * found

    def codes(self, values: Float[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
        """As the file holds them, full scale 1."""
        if self.file is None or self.file["encoding"] == "linear":
            return values
        return encode(np.maximum(values / np.asarray(self.file["factor"]), 0.0), self.file["encoding"])

    def curve(self, values: Float[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
        """The derivative of the codes by the values."""
        return (self.codes(values + CURVED) - self.codes(values - CURVED)) / (2 * CURVED)


@eqx.filter_jit
def _rays(camera: Any, column: Any, row: Any) -> list[Any]:
    return [part.stacked() for part in camera.rays(column, row)]


@eqx.filter_jit
def _content(problem: JointProblem, vector: Any) -> Any:
    return problem.at(vector).content()


def _most_samples(result: FitResult) -> int:
    return max(count for scene in result.scenes for count in (1, *sample_counts(scene)))


def _leaves(material: brdf.Material, scenes: Sequence[brdf.Scene]) -> list[Any]:
    kinds = "light", "intensity", "ball", "radius"
    return [*jax.tree.leaves(material), *(leaf for kind in kinds for leaf in scene_leaves(kind, scenes[0]))]


class Residual:
    """What all pictures leave, in units of their noise, and what of it the material cannot follow; in float64."""

    def __init__(self, result: FitResult):
        """Look at some of the pixels."""
        most, self.model = MOST_PIXELS if _most_samples(result) == 1 else MOST_SAMPLED, type(result.material)
        side = max(most / math.sqrt(len(result.scenes)), FEWEST_PIXELS)
        self.pictures = [_Picture(result, index, side) for index in range(len(result.scenes))]
        self.channels = self.pictures[0].noise.size
        blocks = [
            np.insert(np.argwhere(picture.counted) // BLOCK, 0, index, axis=1)
            for index, picture in enumerate(self.pictures)
        ]
        self._block = np.unique(np.concatenate(blocks), axis=0, return_inverse=True)[1]

    @functools.cached_property
    def left(self) -> Float[np.ndarray, " N"]:
        """What the material cannot follow."""
        return self._unfollowed(self._flat([picture.left for picture in self.pictures]))

    @functools.cached_property
    def excess(self) -> float:
        """The squares that are no noise."""
        return float(np.sum(self.left**2) - sum(np.sum(one.weight[one.counted]) for one in self.pictures))

    @functools.cached_property
    def _material(self) -> tuple[Float[np.ndarray, "C P 4"], Float[np.ndarray, "C 4 P"]]:
        """What the coefficients of each channel, and the exponent, move; and the inverse of that."""
        moved = np.moveaxis(self._flat([picture.material_slopes() for picture in self.pictures]), 0, -1)
        moved = quotient(moved, np.linalg.norm(moved, axis=1, keepdims=True))
        return moved, np.linalg.pinv(moved, rcond=1e-6)

    @property
    def rounded(self) -> bool:
        """Whether rounding to codes is most of the noise of some picture."""
        return any(picture.rounded for picture in self.pictures)

    @property
    def square(self) -> float:
        """Of what is left of the codes."""
        return sum(float(np.sum(picture.left[picture.counted] ** 2)) for picture in self.pictures)

    def tests(self) -> Iterator[_Test]:
        """Each cause that the scenes determine, as large as it explains most."""
        for name in dict.fromkeys(name for picture in self.pictures for name in picture.moves):
            unit, remedy, most = KINDS[name.split()[0]]
            ways = max(len(picture.moves.get(name, ())) for picture in self.pictures)
            slopes = [
                picture.slopes(picture.moves.get(name, [np.zeros(picture.target.shape)] * ways))
                for picture in self.pictures
            ]
            unfollowed = np.array(list(map(self._unfollowed, self._flat(slopes))))
            moving = np.any(unfollowed, axis=1)
            columns, sizes = unfollowed[moving].T, np.zeros(ways)
            if not columns.size:
                continue
            sizes[moving], gain = self._explained(columns)
            length = float(np.linalg.norm(sizes))
            column, left = columns @ sizes[moving] / max(length, TINY), self.left - columns @ sizes[moving]
            # Channels of a pixel, and pixels of a block, may err together: squares of their sums, over those of each.
            scores = column * left
            together = np.bincount(self._block, scores.reshape(self.channels, -1).sum(axis=0))
            inflation = max(float(np.sum(together**2)) / max(float(np.sum(scores**2)), TINY), 1.0)
            error = math.sqrt(inflation / max(float(column @ column), TINY))
            most *= min(self.pictures[0].scene.resolution) if unit == "pixels" else 1
            if max(length, error) < most:
                size = float(sizes[moving][0]) if columns.shape[1] == 1 else length
                share = min(gain / max(self.excess, gain, TINY), 1.0)
                yield _Test(Cause(name, size, error, unit, share, remedy), columns, gain, inflation, sizes)

    def refined(self, test: _Test) -> Cause:
        """A cause as large as pictures are nearest to it, the material fitted beside; by slopes it is a first step."""
        cause, counted = test.cause, [picture.counted for picture in self.pictures]
        moves = [picture.moves.get(cause.name, ()) for picture in self.pictures]
        if not test.sizes.size or not all(isinstance(move, dict) for some in moves for move in some):
            return cause

        def left(times: float) -> float:
            lit = []
            for picture, some in zip(self.pictures, moves, strict=True):
                together: dict[str, Any] = {}
                for size, move in zip(test.sizes, some, strict=False):  # none of another picture's light
                    together |= {leaf: together.get(leaf, 0.0) + times * size * step for leaf, step in move.items()}
                lit.append(picture.lit(self.model, coarse=True, move=together))
            return self._least(lit, counted, [()] * len(lit))

        at = 1.0
        for _ in range(REFINEMENTS):
            times = at * ABOUT
            square, slope, _ = np.polyfit(times, list(map(left, times)), 2)
            if not square > 0:
                break
            last, at = at, float(np.clip(-slope / (2 * square), *(at * NEAR)))
            if abs((at - last) * cause.size) < cause.error:
                break
        size = at * cause.size
        # Directions move along a tangent.
        size = math.degrees(math.atan(math.radians(size))) if cause.unit == "degrees" else size
        return dataclasses.replace(cause, size=size)

    def refitted(self) -> Iterator[_Test]:
        """Whether the pictures, or one of several, show the scenes mirrored, or all show another model."""
        if self.excess <= LEAST_SIZE**2:
            return
        coarse = sum(picture.missed for picture in self.pictures) < HIDDEN * self.excess
        own = [picture.lit(self.model, coarse) for picture in self.pictures]
        several, as_they_are = range(len(own)) if len(own) > 1 else (), [()] * len(own)
        trials = []
        for (name, axis), one in itertools.product(MIRRORED.items(), (None, *several)):
            axes = [axis if one in (None, index) else () for index in range(len(own))]
            trials.append((name if one is None else f"{name} of picture {one}", FLIP, own, axes))
        for name, model in brdf.MODELS.items():
            # One without a highlight explains no more than one with.
            if model not in (self.model, brdf.Lambert):
                other = [picture.lit(model, coarse) for picture in self.pictures]
                trials.append((f"model {name}", f"fit that: --model {name}", other, as_they_are))
        for name, remedy, lit, axes in trials:
            both = list(zip(self.pictures, axes, strict=True))
            good = [picture.counted & np.flip(picture.counted, axis) for picture, axis in both]
            size = sum(map(np.count_nonzero, good)) * self.channels
            if 2 * size < self.left.size:
                continue
            # Fitted alike: a picture that is its own mirror image gains nothing.
            before = self._least(own, good, as_they_are)
            gain = before - self._least(lit, good, axes)
            share = float(min(gain / max(before - size, gain, 1.0), 1.0))
            if share > LEAST_REFITTED and gain > LEAST_SIZE**2:
                yield _Test(Cause(name, 1.0, 0.0, "", share, remedy), np.zeros((self.left.size, 0)), gain)

    def _least(self, lit: list[Picture], good: list[Bool[np.ndarray, "H W"]], axes: list[Any]) -> float:
        """Squares that the model leaves of some pixels of the pictures, flipped, in units of the noise."""
        solved = []
        for picture, basis, some, axis in zip(self.pictures, lit, good, axes, strict=True):
            target = np.flip(picture.target, axis)
            weight = some[..., None] * np.flip(picture.weight, axis) * (picture.curve(target) / picture.noise) ** 2
            values, weight = (jnp.asarray(a.reshape(-1, self.channels)) for a in (target, weight))
            solved.append(dataclasses.replace(basis, target=values, weight=weight))
        every = np.ones((3, self.channels), bool)
        return float(np.sum(search(solved, *within_sight(solved, every, N_RANGE)).cost))

    def alike(self, first: _Test, other: _Test) -> bool:
        """Whether the other cause would do as well: the first explains nothing beside it."""
        both = first.gain
        if first.columns.size and other.columns.size:
            both = self._explained(np.concatenate([first.columns, other.columns], axis=1))[1]
        return both - other.gain < ALIKE[first.columns.shape[1]] * first.inflation

    def _explained(self, columns: Float[np.ndarray, "P K"]) -> tuple[Float[np.ndarray, " K"], float]:
        """The sizes that explain most, and the squares that they explain."""
        product = columns.T @ self.left
        size = np.linalg.pinv(columns.T @ columns, rcond=1e-10, hermitian=True) @ product
        return size, float(size @ product)

    def _flat(self, images: Sequence[Float[np.ndarray, "*K H W C"]]) -> Float[np.ndarray, "*K C P"]:
        """Of the pixels that count, in units of the noise."""
        both = zip(images, self.pictures, strict=True)
        parts = [(image * np.sqrt(picture.weight))[..., picture.counted, :] / picture.noise for image, picture in both]
        return np.concatenate(parts, axis=-2).swapaxes(-1, -2)

    def _unfollowed(self, values: Float[np.ndarray, "C P"]) -> Float[np.ndarray, " N"]:
        """What the material cannot follow; 0 where that is next to nothing."""
        moved, inverse = self._material
        left = values - (moved @ (inverse @ values[..., None]))[..., 0]
        return left.ravel() * (np.sum(left**2) > FOLLOWED * np.sum(values**2))


def _white_noise(residual: Float[np.ndarray, "H W C"], some: Bool[np.ndarray, "H W #C"]) -> Float[np.ndarray, " C"]:
    """Standard deviation of what single pixels err: from differences of neighbours, which know no wide structure."""
    known = np.where(some, residual, np.nan)
    both = [np.diff(known, axis=axis).reshape(-1, known.shape[2]) for axis in (0, 1)]
    squares = np.concatenate(both) ** 2
    scale, count = float(np.max(np.abs(residual), initial=0.0)), np.count_nonzero(np.isfinite(squares), axis=0)
    return np.sqrt(np.nansum(squares, axis=0) / np.maximum(2 * count, 1)) + 1e-7 * (scale or 1.0)
