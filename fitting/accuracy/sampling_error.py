"""How far a cheap fit is from the dear one, told beforehand: from a few pixels of the cheap fit alone.

At the optimum θ of a cheap fit, with the residual r and the derivatives J of the model by the parameters at some of its
pixels, and the normal matrix H = Σ w JᵀJ, everything that makes the fit cheap is a shift of θ to first order:

* pixels left out: their scores w Jᵀr are missing. The variance of a stratified sum with one pixel per stratum, taken
  from the differences of neighbouring strata (Cochran 1977, Sampling Techniques, section 5A.12), gives the covariance
  H⁻¹ V H⁻¹ of θ. Where the model is exact and there is no noise, no pixel is missed.
* light samples left out: H⁻¹ Jᵀ (fine − coarse), the model with more light samples less the model with those used.
* rounding: the Newton step that is left when the model is evaluated in float64, or, where few pixels are looked at,
  H⁻¹ Jᵀ (double − single).

The first is random, and is told as the median and the 95 % quantile of what it does; the others are added to it.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

import brdf
from fitting.accuracy.configurations import Run, casts_shadows, some_of_target, target_size
from fitting.accuracy.deviation import SMALLEST
from fitting.accuracy.lamps import Lamps
from fitting.accuracy.pixel_sampling import PixelSample, sample_pixels, traceable
from fitting.accuracy.probes import Probe, columns_in, difference, probe
from fitting.interpretation import coefficient_factors
from fitting.light_colour import take_colour_out
from fitting.uncertainty.covariance import TERMS

DRAWS = 512
# Pixels that are looked at: under lights of many samples, and under lights of few.
PROBES, MOST_PROBES = 640, 512
# What float32 shadow rays make of the pixels at a shadow's edge, some of which fall on its other side.
AT_SHADOWS = 1e-4
# What light samples leave out is told to first order only: the bound allows for this factor.
MARGIN = 2.0
# What a sum of so many samples is compared with: the next step, as a factor.
STEP = 4


class Shifts(NamedTuple):
    """By how much the parameters of a cheap fit are off.

    The parameters are x_a, x_d, x_s, channel after channel each, and log n: (P,).

    Attributes:
        drawn: random shifts by the pixels left out, (D, P).
        light: shift by the light samples left out, (P,).
        rounding: by rounding, (P,).
    """

    drawn: Float[np.ndarray, "D P"]
    light: Float[np.ndarray, " P"]
    rounding: Float[np.ndarray, " P"]


class Estimate(NamedTuple):
    """The error of a cheap fit, relative: see `fitting.accuracy.deviation`.

    Attributes:
        error: its median.
        bound: not exceeded in 95 % of cases.
        pixels: the part (bound) of the pixels left out.
        light: the part of the light samples left out.
        rounding: the part of rounding.
    """

    error: float
    bound: float
    pixels: float
    light: float
    rounding: float


def _some(sample: PixelSample, most: int) -> tuple[PixelSample, float]:
    """Every so many-th pixel of a sample, and how many."""
    stride = max(1, -(-sample.pixel.size // most))
    return PixelSample(sample.pixel[::stride], sample.stands_for[::stride] * stride), float(stride)


def rounding_by_rule(n: float, precision: brdf.Precision, *, shadows: bool) -> float:
    """What rounding does to a fit of all pixels, of no more account than its order of magnitude.

    A few units in the last place, more for a lobe so narrow that the rounding of directions counts against its width.

    Args:
        n: exponent.
        precision: of the fit.
        shadows: whether shapes cast any.
    """
    rule = float(np.finfo(precision).eps * (2 + 0.02 * np.sqrt(max(n, 0.0))))
    return max(rule, AT_SHADOWS) if shadows and precision == "float32" else rule


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

    def _place(self, index: int, samples: int | None, precision: brdf.Precision) -> brdf.Scene:
        """The probed pixels of a picture under lights of so many samples."""
        scene = self.lamps.with_samples(self.light.scenes[index], samples)
        sample = self.parts[index][0]
        return brdf.cast(brdf.some_pixels(scene, sample.pixel, precision=precision), precision)

    def _add(self, index: int, values: np.ndarray, weight: np.ndarray) -> None:
        with brdf.working_precision("float64"):
            # What is traced pixel by pixel becomes part of one program.
            scene, pixel = self.light.scenes[index], self.parts[index][0].pixel.astype(np.int32)
            if not traceable(scene):
                scene, pixel = self._place(index, None, "float64"), None
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

    def shifts(self, finer: int | None = None, *, measured: bool = True) -> Shifts:
        """By how much the parameters are off.

        Args:
            finer: the number of light samples to compare with; None where no light has samples to choose.
            measured: whether what rounding does is measured; 0 where not.
        """
        # What the bound held back is part of it: without it such a coefficient would be off by chance alone.
        held = np.where(self.bound, self.step, 0.0)
        covariance = self.inverse @ self.spread @ self.inverse
        value, vector = np.linalg.eigh(covariance)
        root = vector * np.sqrt(np.maximum(value, 0.0))
        draws = np.random.default_rng(0).standard_normal((DRAWS, value.size)) @ root.T
        drawn = self._settled(draws + self.inverse @ held) - self._settled((self.inverse @ held)[None])
        nothing = np.zeros(value.size)
        light = nothing if finer is None else self.inverse @ self._of_light(None, finer)
        if not measured or self.run.result.precision == "float64":
            rounding = nothing
        elif self.many or self.skipped:
            rounding = self.inverse @ self._of_rounding()
        else:
            rounding = self.inverse @ np.where(self.bound, 0.0, self.step)
        return Shifts(drawn, light, rounding)

    def _settled(self, draws: Float[np.ndarray, "D P"]) -> Float[np.ndarray, "D P"]:
        """Coefficients at their bound leave it upwards only."""
        return np.where(self.bound, np.maximum(draws, 0.0), draws)

    def _of_light(self, coarse: int | None, fine: int) -> Float[np.ndarray, " P"]:
        """Products of the derivatives with what more light samples change."""
        total = np.zeros(3 * self.channels + 1)
        for index, (sample, weight, _, _) in enumerate(self.parts):
            with brdf.working_precision("float64"):
                scene, pixel = self.light.scenes[index], sample.pixel.astype(np.int32)
                if traceable(scene):
                    few, many = (self.lamps.with_samples(scene, samples) for samples in (coarse, fine))
                else:
                    few, many, pixel = *(self._place(index, samples, "float64") for samples in (coarse, fine)), None
                n, x = np.asarray(max(self.optimum.n, 1e-3)), self.optimum.x
                found = np.asarray(difference(self.model, few, many, pixel, weight, n, x))
            for channel, place in enumerate(self.places):
                total[place] += found[channel] * np.array([1.0, 1.0, 1.0, self.optimum.x[2, channel]])
        return total

    def _of_rounding(self) -> Float[np.ndarray, " P"]:
        """Products of the derivatives with what float64 changes."""
        return np.sum([self._of_single(index, weight) for index, (_, weight, _, _) in enumerate(self.parts)], axis=0)

    def _of_single(self, index: int, weight: np.ndarray) -> Float[np.ndarray, " P"]:
        """What float32 changes, told by the products of the columns with the model in both precisions."""
        found = []
        for precision in ("float64", "float32"):
            with brdf.working_precision(precision):
                scene, pixel = self.light.scenes[index], self.parts[index][0].pixel.astype(np.int32)
                if not traceable(scene):
                    scene, pixel = self._place(index, None, precision), None
                n = np.float64(max(self.optimum.n, 1e-3))
                shape = (weight.size, self.channels)
                columns, seen = jax.device_get(columns_in(self.model, scene, pixel, n, shape, precision))
            picture = np.einsum("mck,kc->mc", columns[..., :3].astype(np.float64), self.optimum.x)
            found.append((columns.astype(np.float64), picture, seen))
        (columns, double, seen), (_, single, _) = found
        products = np.einsum("m,mci,mc->ci", np.where(seen, weight, 0.0), columns, single - double)
        total = np.zeros(3 * self.channels + 1)
        for channel, place in enumerate(self.places):
            total[place] -= products[channel] * np.array([1.0, 1.0, 1.0, self.optimum.x[2, channel]])
        return total

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

    def light_error(self, samples: int, finer: int) -> float:
        """What so many samples of each light leave out, told by more of them at the parameters of this fit.

        Args:
            samples: of each light.
            finer: more of them.
        """
        return float(self.relative(self.inverse @ self._of_light(samples, finer)))

    def estimate(self, finer: int | None = None, *, rule: float | None = None) -> Estimate:
        """The error of the fit.

        Args:
            finer: as for `shifts`.
            rule: what rounding does, where its order of magnitude is enough to know; None measures it.
        """
        shifts = self.shifts(finer, measured=rule is None)
        alone = self.relative(shifts.drawn)
        together = self.relative(shifts.drawn + shifts.light + shifts.rounding)
        light, rounding = float(self.relative(shifts.light)), float(self.relative(shifts.rounding))
        if rule is None and self.shadows and self.run.result.precision == "float32":
            rule = AT_SHADOWS
        if rule is not None:
            together, rounding = np.hypot(together, rule), max(rounding, rule)
        pixels = float(np.quantile(alone, 0.95))
        bound = float(np.quantile(together, 0.95)) + (MARGIN - 1) * light
        return Estimate(float(np.median(together)), bound, pixels, light, rounding)


def _every(scene: brdf.Scene, model: type[brdf.Material], most: int) -> PixelSample:
    """Some pixels of a picture all of which were fitted."""
    width, height = scene.resolution
    if width * height > most:
        found = sample_pixels(scene, model, most)
        if found is not None:
            return found
    return PixelSample(np.arange(width * height), np.ones(width * height))
