"""How many light samples a fit takes, from what more of them would change: the error of light samples by two counts.

Some thousand pixels are fitted first, with a few samples of each light with an extent. At that fit the model is made of
16, 64, 256 ... samples at some pixels. What the next count changes is the error of a count; with the scores it makes,
J'(fine - coarse), the Hessian H tells how far that puts each number off. Taken is the least count whose error is below
a third of what noise leaves of all pixels, or below a thousandth of the number, and which leaves no structure in the
residual that noise would not hide; fewer than the lights themselves say only where noise allows it, so that a picture
without noise is fitted with the samples that it was drawn with. What remains is told in the errors.

The first fit also says where n is, so that all pixels see their light samples in one pass (`brdf.lobes.Near`).
"""

import dataclasses
import math

import numpy as np

import brdf
from brdf.errors import InputError
from brdf.lobes import STORED_SAMPLES, Near
from fitting.budget.configurations import MOST_SAMPLES, Configuration, run, sample_counts
from fitting.budget.error_estimate import at_probes, derivatives, filled, jacobian_places, probes
from fitting.budget.sampling import MadeLights, with_samples
from fitting.core import UNSEEN
from fitting.light_colour import take_colour_out
from fitting.problem import FitProblem, has_pixel_areas
from fitting.sample_error import MOST, SampleError, near_exponent
from fitting.solver.nnls import scaled_inverse

# Pixels of the first fit, of which so many tell the error; its samples, and those that are tried.
PIXELS, PROBES, FIRST_SAMPLES = 1024, 640, 64
LADDER = (16, 36, 64, 144, 256, 576, 1024, 2048, MOST_SAMPLES)
# Of what noise leaves of a number, and of the number.
OF_NOISE, OF_VALUE = 1 / 3, 1e-3
# Of the noise, root mean square over pixels: less shows in no sum over blocks of them; more than the other is no noise.
HIDDEN, NO_NOISE = 0.02, 0.3
# Each count changes at most so much of what the one before changed.
SLOWEST = 0.7
# Where more samples move log n so far the first fit is made again, of more of them, but no more than so many.
FAR, MOST_FIRST = 0.1, 1024
# To either side of n all pixels may find it by so many errors of the first fit; of log n at least.
ERRORS, LEAST = 6.0, 0.02


def with_enough_samples(problem: FitProblem) -> FitProblem:
    """The problem with as many samples in its lights as it takes, and with what these leave out.

    Args:
        problem: any; returned as it is where it has no light of many samples.
    """
    counts = [count for count in sample_counts(problem.scenes) if count]
    if problem.streamed or max(counts, default=0) <= STORED_SAMPLES or any(map(has_pixel_areas, problem.scenes)):
        return problem
    lights: MadeLights = {}
    plain = dataclasses.replace(problem, loss="squared", noise=None, plausible=False)
    try:
        models = problem.families if problem.model == "auto" else (problem.model,)
        told = {name: _ladder(plain, name, max(counts), lights) for name in models}
    except InputError:
        return problem  # the fit itself tells what is wrong
    samples = max(one.samples for one in told.values())
    scenes = [with_samples(scene, samples, lights) for scene in problem.scenes]
    errors = {name: one.error(samples) for name, one in told.items()}
    return dataclasses.replace(problem, scenes=scenes, shown=problem.scenes, sample_errors=errors)


def _ladder(problem: FitProblem, model: str, own: int, lights: MadeLights) -> "_Ladder":
    first = min(FIRST_SAMPLES, own)
    while True:
        found = _Ladder(problem, model, own, lights, first)
        if first >= min(found.samples, MOST_FIRST) or abs(found.move(found.samples)) <= FAR:
            return found
        first *= 4


class _Ladder:
    """A model of more and more light samples at some pixels."""

    def __init__(self, problem: FitProblem, model: str, own: int, lights: MadeLights, first: int):
        """Fit some pixels under a first number of samples, and find how many it takes."""
        self.problem, self.lights, self.own = problem, lights, own
        self.counts = sorted({*LADDER, own, first})
        self.first, self.made = first, dict[int, list[np.ndarray]]()
        done = run(problem, Configuration(model, problem.precision, PIXELS, self.first), lights)
        optimum = done.result.optimum
        assert optimum is not None
        self.result, self.kind, self.n, self.x = done.result, brdf.MODELS[model], max(optimum.n, 1e-3), optimum.x
        channels = self.x.shape[1]
        self.scenes = take_colour_out(problem.scenes, channels).scenes
        places, self.parts, self.seen = jacobian_places(optimum), [], []
        most = max(64, PROBES // len(self.scenes))
        each = zip(self.scenes, done.result.counted, done.samples, problem.weights, strict=True)
        for scene, counted, sample, weight in each:
            part, share, _ = probes(scene, self.kind, counted.ravel(), sample, weight, most)
            seen = brdf.some_pixels(scene, filled(part.pixel), precision="float64")
            columns = derivatives(with_samples(seen, self.first, lights), self.kind, self.n, channels)
            self.seen.append(seen)
            self.parts.append((part.pixel, share, np.einsum("mci,cip->mcp", columns[: share.size], places)))
        # The search went up to the exponent that the nearest pixel sees a trace of.
        highest = np.max(optimum.grid, initial=0.0)
        self.peak = -UNSEEN / highest if 0 < highest < 0.999 * problem.n_range[1] else 0.0
        hessians = [np.einsum("m,mcp,mcq->pq", share, by, by, optimize=True) for _, share, by in self.parts]
        self.hessian: np.ndarray = np.sum(hessians, axis=0)
        self.active = np.append((self.x > 0).ravel(), bool((self.x[2] > 0).any()))
        self.samples = next(filter(self._enough, self.counts), self.counts[-1])

    def _shown(self, samples: int) -> list[np.ndarray]:
        """What the fit shows at the pixels, under so many samples; made once."""
        if samples not in self.made:
            self.made[samples] = self._made(samples)
        return self.made[samples]

    def _made(self, samples: int) -> list[np.ndarray]:
        found = []
        for seen, (_, share, _) in zip(self.seen, self.parts, strict=True):
            columns = at_probes(with_samples(seen, samples, self.lights), self.kind, self.n, self.x.shape[1])
            found.append(np.einsum("mck,kc->mc", columns[: share.size], self.x))
        return found

    def _change(self, coarse: int, fine: int) -> tuple[np.ndarray, float]:
        """The scores of what other samples change, and its root mean square over pixels."""
        score, square, weight = np.zeros(self.active.size), 0.0, 0.0
        for (_, share, by), more, less in zip(self.parts, self._shown(fine), self._shown(coarse), strict=True):
            score += np.einsum("m,mcp,mc->p", share, by, more - less, optimize=True)
            square, weight = square + share @ np.mean((more - less) ** 2, axis=1), weight + np.sum(share)
        return score, float(np.sqrt(square / max(weight, 1.0)))

    def _missed(self, samples: int) -> tuple[np.ndarray, float]:
        """The same for all samples beyond so many: of the next count, and of those after it as changes fall off."""
        index, last = self.counts.index(samples), len(self.counts) - 1
        steps = list(zip(self.counts[:last], self.counts[1:], strict=True))
        (score, size), step = self._change(*steps[min(index, last - 1)]), steps[min(index, last - 1)]
        fall = step[0] / step[1]
        if index:
            before = self._change(*steps[min(index, last - 1) - 1])[1]
            fall = min(size / max(before, np.finfo(float).tiny), SLOWEST)
        more = (fall if index == last else 1.0) / (1.0 - fall)
        return more * score, more * size

    def _off(self, score: np.ndarray) -> np.ndarray:
        """How far off each number is."""
        return scaled_inverse(self.hessian[np.ix_(self.active, self.active)]) @ score[self.active]

    def _enough(self, samples: int) -> bool:
        score, size = self._missed(samples)
        noise, active = float(np.sqrt(np.mean(self.result.noise**2))), self.active
        rest, given = (
            noise * np.sqrt(np.diag(scaled_inverse(self.hessian[np.ix_(active, active)]))),
            samples >= self.own,
        )
        value = np.append(self.x.ravel(), 1.0)[active] * given
        off = np.abs(self._off(score))
        hidden = size <= HIDDEN * noise or (given and size > NO_NOISE * noise)
        return hidden and bool(np.all(off <= np.maximum(OF_NOISE * rest, OF_VALUE * value)))

    def move(self, samples: int) -> float:
        """By how much so many samples move log n."""
        return float(self._off(self._change(samples, self.first)[0])[-1]) if self.active[-1] else 0.0

    def near(self, samples: int) -> Near:
        """About the exponent that all pixels will find under so many samples."""
        low, high = (math.log(bound) for bound in self.problem.n_range)
        known = next((one for one in self.result.parameters if one.name == "n"), None)
        if known is None or known.value is None or known.error is None:
            return Near.between(low, high, self.peak)
        move = float(np.clip(self.move(samples), -MOST, MOST))
        reach = max(ERRORS * known.error / known.value + abs(move), LEAST)
        if reach > MOST:
            return Near.between(low, high, self.peak)
        return near_exponent(known.value * math.exp(move), reach, self.peak)

    def error(self, samples: int) -> SampleError:
        """What so many samples leave out, at least as many as were found to be enough."""
        told = samples if samples in self.counts else self.samples
        optimum = self.result.optimum
        assert optimum is not None
        profile = np.stack([optimum.grid, optimum.profile])
        return SampleError(self.near(told), self.hessian, self._missed(told)[0], profile)
