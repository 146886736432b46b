"""The linear system of a fit's parameters at its optimum, from a few of its pixels.

With the residual r and the derivatives J of the model by the parameters at some pixels of weight w: the normal matrix
H = Σ w JᵀJ and its inverse, the Newton step's right-hand side Σ w Jᵀr, the variance of that sum by the choice of the
pixels, and what a shift of the parameters is relative to. What is wrong with a cheap fit is told with it in
`fitting.accuracy.sampling_error`, and a reference is refined by it in `fitting.accuracy.reference`.

The variance of a stratified sum with one pixel per stratum is taken from the differences of neighbouring strata
(Cochran 1977, Sampling Techniques, section 5A.12).
"""

from collections.abc import Sequence
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

import brdf
from fitting.accuracy.configurations import Run, casts_shadows, some_of_target, target_size
from fitting.accuracy.deviation import SMALLEST
from fitting.accuracy.lamps import Lamps
from fitting.accuracy.pixel_sampling import PixelSample, sample_pixels, traceable
from fitting.accuracy.probes import Probe, probe
from fitting.interpretation import coefficient_factors
from fitting.light_colour import take_colour_out
from fitting.uncertainty.covariance import TERMS

# Pixels that are looked at: under lights of many samples, and under lights of few.
PROBES, MOST_PROBES = 640, 512


def _some(sample: PixelSample, most: int) -> tuple[PixelSample, float]:
    """Every so many-th pixel of a sample, and how many."""
    stride = max(1, -(-sample.pixel.size // most))
    return PixelSample(sample.pixel[::stride], sample.stands_for[::stride] * stride), float(stride)


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
        masks = options.get("mask")
        masks = masks if isinstance(masks, list | tuple) else [masks] * len(targets)
        most = max(64, probes or (PROBES if self.many else MOST_PROBES) // len(targets))
        self.probes: list[Probe] = []
        self.skipped = False
        self.parts: list[tuple[PixelSample, np.ndarray, bool, float]] = []
        for index, (target, mask, sample) in enumerate(zip(targets, masks, run.samples, strict=True)):
            whole = sample if sample is not None else _every(run.scenes[index], self.model, most)
            some, stride = _some(whole, most)
            values = some_of_target(target, some)
            values = np.asarray(getattr(values, "pixels", values), np.float64).reshape(-1, self.channels)
            counted = result.counted[index].ravel()[some.pixel]
            if mask is not None:
                counted = counted & np.asarray(mask, bool).ravel()[some.pixel]
            weight = np.where(counted, some.stands_for, 0.0)
            # Every pixel of a picture that was fitted whole is no sample at all.
            skipped = some.pixel.size < (sample.pixel.size if sample is not None else target_size(target))
            self.skipped |= skipped
            self.parts.append((some, weight, sample is None, stride))
            self._add(index, values, weight)
        self._assemble()

    def place(self, index: int, samples: int | None, precision: brdf.Precision) -> brdf.Scene:
        """The probed pixels of a picture under lights of so many samples."""
        scene = self.lamps.with_samples(self.light.scenes[index], samples)
        sample = self.parts[index][0]
        return brdf.cast(brdf.some_pixels(scene, sample.pixel, precision=precision), precision)

    def _add(self, index: int, values: np.ndarray, weight: np.ndarray) -> None:
        with brdf.working_precision("float64"):
            # What is traced pixel by pixel becomes part of one program.
            scene, pixel = self.light.scenes[index], self.parts[index][0].pixel.astype(np.int32)
            if not traceable(scene):
                scene, pixel = self.place(index, None, "float64"), None
            n, x = np.float64(max(self.optimum.n, 1e-3)), self.optimum.x
            found = jax.device_get(probe(self.model, scene, pixel, values, weight, n, x))
        self.probes.append(found)

    def _assemble(self) -> None:
        """Normal matrix, scores and scales."""
        optimum, channels = self.optimum, self.channels
        size = 3 * channels + 1
        self.places = [[c, channels + c, 2 * channels + c, size - 1] for c in range(channels)]
        hessian, step, spread = np.zeros((size, size)), np.zeros(size), np.zeros((size, size))
        for (sample, _, complete, stride), found in zip(self.parts, self.probes, strict=True):
            scores = np.zeros((sample.pixel.size, size))
            for channel, place in enumerate(self.places):
                scale = np.array([1.0, 1.0, 1.0, optimum.x[2, channel]])
                hessian[np.ix_(place, place)] += found.gram[channel] * np.outer(scale, scale)
                step[place] += found.step[channel] * scale
                scores[:, place] += found.scores[:, channel] * scale
            if complete:
                continue
            # A pixel of a probe stands for `stride` pixels of the sample, whose own chance is what counts.
            chance = 1 - stride / np.maximum(sample.stands_for, stride)
            change = np.diff(scores / stride, axis=0)
            spread += 0.5 * stride * (change * np.minimum(chance[1:], chance[:-1])[:, None]).T @ change
        self.hessian, self.step, self.spread = hessian, step, spread
        self._scales()

    def _scales(self) -> None:
        """What a shift of each parameter is divided by, which are told, and how k_s follows x_s and n."""
        result, optimum, channels = self.run.result, self.optimum, self.channels
        factors = coefficient_factors(self.model, optimum.n, self.light.colour)
        specular = issubclass(self.model, brdf.SpecularMaterial) and not optimum.flat
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
        square = np.einsum("...i,ij,...j->...", shift, self.hessian, shift)
        picture = 0.0
        for channel, gram in enumerate(self._grams()):
            x = self.optimum.x[:, channel]
            picture += x @ gram[:3, :3] @ x
        return np.maximum(parameters, np.sqrt(np.maximum(square, 0.0) / max(picture, np.finfo(float).tiny)))

    def _grams(self) -> Float[np.ndarray, "C 4 4"]:
        return np.sum([found.gram for found in self.probes], axis=0)


def _every(scene: brdf.Scene, model: type[brdf.Material], most: int) -> PixelSample:
    """Some pixels of a picture all of which were fitted."""
    width, height = scene.resolution
    if width * height > most:
        found = sample_pixels(scene, model, most)
        if found is not None:
            return found
    return PixelSample(np.arange(width * height), np.ones(width * height))
