"""The linear system of a fit's parameters at its optimum, from a few of its pixels.

With the residual r and the derivatives J of the model by the parameters at some pixels of weight w: the normal matrix
H = Σ w JᵀJ and its inverse, the Newton step's right-hand side Σ w Jᵀr, the variance of that sum by the choice of the
pixels, and what a shift of the parameters is relative to. What is wrong with a cheap fit is told with it in
`fitting.budget.sampling_error`, and a reference is refined by it in `fitting.budget.reference`.

The variance of a stratified sum with one pixel per stratum is taken from the differences of neighbouring strata
(Cochran 1977, Sampling Techniques, section 5A.12).
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

import brdf
from brdf.models.base import SpecularMaterial
from brdf.precision import Precision, working_precision
from fitting.budget.configurations import Run, casts_shadows, one_each, some_of_target, target_size
from fitting.budget.deviation import SMALLEST
from fitting.budget.lamps import Lamps
from fitting.budget.pixel_sampling import PixelSample, sample_pixels, traceable
from fitting.budget.probes import Probe, probe
from fitting.light_colour import coefficient_factors, take_colour_out
from fitting.uncertainty.covariance import TERMS

# Pixels that are looked at: under lights of many samples, and under lights of few.
PROBES, MOST_PROBES = 640, 512
# Fewer are filled up to a multiple of this.
FILLED = 128


class Part(NamedTuple):
    """The pixels of one picture that are probed.

    Attributes:
        sample: which, and for how many each stands; filled up with some that weigh nothing, so that few programs are
            compiled.
        weight: of each, (M,).
        real: how many are no filling.
        complete: whether all pixels of the picture were fitted.
        stride: for how many pixels that were fitted each stands.
    """

    sample: PixelSample
    weight: Float[np.ndarray, " M"]
    real: int
    complete: bool
    stride: float


class System:
    """The linear system of a fit's parameters, gathered over its pictures.

    Args:
        run: the fit.
        targets: its pictures.
        options: the further arguments it was given.
        lamps: the lights made so far.
        probes: at how many pixels of all pictures together to look at most; None for few.
    """

    def __init__(
        self, run: Run, targets: Sequence[Any], options: dict[str, Any], lamps: Lamps, probes: int | None = None
    ):
        """Probe the pixels."""
        self.run, self.lamps = run, lamps
        result = run.result
        self.optimum = result.optimum
        self.model = type(result.material)
        self.channels = self.optimum.x.shape[1]
        self.many = any(sum(getattr(light, "samples", 1) for light in scene.lights) > 4 for scene in run.scenes)
        self.light = take_colour_out(run.scenes, self.channels)
        self.shadows = any(map(casts_shadows, run.scenes))
        self.probes: list[Probe] = []
        self.parts: list[Part] = []
        # Whether some of the pixels that were fitted are not probed.
        self.skipped = False
        self.weights = one_each(options.get("weight"), len(targets))
        most = max(64, probes or (PROBES if self.many else MOST_PROBES) // len(targets))
        for index, (target, sample) in enumerate(zip(targets, run.samples, strict=True)):
            part = self.part(index, most, self.model)
            self.skipped |= part.stride > 1 or (sample is None and part.real < target_size(target))
            values = some_of_target(target, part.sample)
            values = np.asarray(getattr(values, "pixels", values), np.float64).reshape(-1, self.channels)
            self.parts.append(part)
            self._add(index, values, part.weight)
        self._assemble()

    def part(self, index: int, most: int, model: type[brdf.Material]) -> Part:
        """Some of the pixels that were fitted.

        Args:
            index: of the picture.
            most: how many, about.
            model: where its highlights are, they are crowded in a picture that was fitted whole.
        """
        counted, sample = self.run.result.counted[index].ravel(), self.run.samples[index]
        whole = sample
        if whole is None:
            whole = _every(self.run.scenes[index], model, round(most / max(float(np.mean(counted)), 1e-9)))
        return _part(whole, counted, self.weights[index], most, complete=sample is None)

    def place(self, index: int, part: Part, samples: int | None, precision: Precision) -> brdf.Scene:
        """The scene of some pixels of a picture, under lights of so many samples.

        Args:
            index: of the picture.
            part: which pixels.
            samples: of each light with an extent; None for those of the scene.
            precision: in which the pixels are traced.
        """
        scene = self.lamps.with_samples(self.light.scenes[index], samples)
        return brdf.cast(brdf.some_pixels(scene, part.sample.pixel, precision=precision), precision)

    def traced(self, index: int, part: Part, precision: Precision) -> tuple[brdf.Scene, np.ndarray | None]:
        """A scene, and which of its pixels a program is to trace; None where it is the scene of some pixels.

        Args:
            index: of the picture.
            part: which pixels.
            precision: in which the pixels are traced.
        """
        # What is traced pixel by pixel becomes part of one program.
        scene = self.light.scenes[index]
        if traceable(scene):
            return scene, part.sample.pixel.astype(np.int32)
        return self.place(index, part, None, precision), None

    def _add(self, index: int, values: np.ndarray, weight: np.ndarray) -> None:
        with working_precision("float64"):
            scene, pixel = self.traced(index, self.parts[index], "float64")
            n, x = np.float64(max(self.optimum.n, 1e-3)), self.optimum.x
            found = jax.device_get(probe(self.model, scene, pixel, values, weight, n, x))
        self.probes.append(found)

    def _assemble(self) -> None:
        """Normal matrix, scores and scales."""
        optimum, channels = self.optimum, self.channels
        size = 3 * channels + 1
        self.places = [[c, channels + c, 2 * channels + c, size - 1] for c in range(channels)]
        hessian, step, spread = np.zeros((size, size)), np.zeros(size), np.zeros((size, size))
        for part, found in zip(self.parts, self.probes, strict=True):
            scores = np.zeros((part.real, size))
            for channel, place in enumerate(self.places):
                scale = np.array([1.0, 1.0, 1.0, optimum.x[2, channel]])
                hessian[np.ix_(place, place)] += found.gram[channel] * np.outer(scale, scale)
                step[place] += found.step[channel] * scale
                scores[:, place] += found.scores[: part.real, channel] * scale
            if part.complete:
                continue
            # A pixel of a probe stands for `stride` pixels of the sample, whose own chance is what counts.
            chance = 1 - part.stride / np.maximum(part.sample.stands_for[: part.real], part.stride)
            change = np.diff(scores / part.stride, axis=0)
            spread += 0.5 * part.stride * (change * np.minimum(chance[1:], chance[:-1])[:, None]).T @ change
        self.hessian, self.step, self.spread = hessian, step, spread
        grams = np.sum([found.gram for found in self.probes], axis=0)[:, :3, :3]
        # Of the picture of the fit, which errors of the picture are relative to.
        self.square = max(float(np.einsum("kc,ckl,lc->", optimum.x, grams, optimum.x)), np.finfo(float).tiny)
        self._scales()

    def _scales(self) -> None:
        """What a shift of each parameter is divided by, which are told, and how k_s follows x_s and n."""
        result, optimum, channels = self.run.result, self.optimum, self.channels
        factors = coefficient_factors(self.model, optimum.n, self.light.colour)
        specular = issubclass(self.model, SpecularMaterial) and not optimum.flat
        k = optimum.x / factors
        largest = max(float(np.max(k[: 3 if specular else 2])), np.finfo(float).tiny)
        scale = np.maximum(np.max(k, axis=1), SMALLEST * largest)[:, None] * factors
        self.scale = np.concatenate([scale.ravel(), [1.0]])
        lost = set(result.undetermined)
        told = [
            not ({name, f"{name}[{channel}]"} & lost) and (specular or term < 2)
            for term, name in enumerate(TERMS)
            for channel in range(channels)
        ]
        self.told = np.array([*told, specular and "n" not in lost])
        self.bound = np.concatenate([(optimum.x <= 0).ravel(), [False]])
        self.slope = np.zeros(3 * channels + 1)
        if specular:
            step = 1e-4
            after = coefficient_factors(self.model, optimum.n * np.exp(step), self.light.colour)[2]
            self.slope[2 * channels : -1] = -optimum.x[2] * (after / factors[2] - 1) / step
        diagonal = np.diag(self.hessian)
        free = (diagonal > 0) & (self.told | ~self.bound)
        columns = [row for row in np.eye(free.size)[free]]
        chosen = [one for one in result.candidates if one.chosen]
        if chosen and chosen[0].highlight == "grey" and channels > 1:
            shared = np.zeros(free.size)
            shared[2 * channels : -1] = optimum.x[2]
            columns = [c for c in columns if not c[2 * channels : -1].any()] + ([shared] if optimum.x[2].any() else [])
        basis = np.stack(columns, axis=1) if columns else np.zeros((free.size, 0))
        reduced = basis.T @ self.hessian @ basis
        size = np.sqrt(np.maximum(np.diag(reduced), np.finfo(float).tiny))
        inverse = np.linalg.pinv(reduced / np.outer(size, size), rcond=1e-13, hermitian=True) / np.outer(size, size)
        self.inverse = basis @ inverse @ basis.T

    def relative(self, shift: Float[np.ndarray, "*D P"]) -> Float[np.ndarray, "*D"]:
        """The larger of the relative error of the picture and the largest one of a parameter.

        Args:
            shift: of the parameters.
        """
        k = shift + shift[..., -1:] * self.slope
        parameters = np.max(np.where(self.told, np.abs(k) / self.scale, 0.0), axis=-1)
        square = np.sum((shift @ self.hessian) * shift, axis=-1)
        return np.maximum(parameters, np.sqrt(np.maximum(square, 0.0) / self.square))


def _part(sample: PixelSample, counted: np.ndarray, given: Any, most: int, *, complete: bool) -> Part:
    """At most so many of the pixels of a sample that count, or that border on one that does in the sample's order."""
    counts = counted[sample.pixel]
    near = counts.copy()
    # What the borders of the object take from a sample is part of its chance.
    near[1:] |= counts[:-1]
    near[:-1] |= counts[1:]
    index = np.flatnonzero(near)
    count, stride = index.size, 1.0
    if count > most:
        index, stride = index[np.arange(most) * count // most], count / most
        count = most
    pixel, stands_for = sample.pixel[index], sample.stands_for[index] * stride
    weight = np.where(counts[index], stands_for, 0.0)
    if given is not None:
        weight = weight * np.asarray(given, np.float64).ravel()[pixel]
    filling = -count % FILLED if count else FILLED
    kept = PixelSample(_filled(pixel, filling), _filled(stands_for, filling, 1.0))
    return Part(kept, _filled(weight, filling), count, complete, stride)


def _filled(values: np.ndarray, filling: int, value: float = 0.0) -> np.ndarray:
    return np.concatenate([values, np.full(filling, value, values.dtype)])


def _every(scene: brdf.Scene, model: type[brdf.Material], most: int) -> PixelSample:
    """Some pixels of a picture all of which were fitted."""
    width, height = scene.resolution
    if width * height > most:
        found = sample_pixels(scene, model, most)
        if found is not None:
            return found
    return PixelSample(np.arange(width * height), np.ones(width * height))
