"""How many light samples a fit takes, from what more of them would change: the error of light samples by two counts.

Some thousand pixels are fitted first, with a few samples of each light with an extent. At that fit the model is made of
16, 64, 256 ... samples at some pixels. What the next count changes is the error of a count; with the scores it makes,
J'(fine - coarse), the Hessian H tells how far that puts each number off. Taken is the least count whose error is below
a third of what noise leaves of all pixels, or below a thousandth of the number, and which leaves no structure in the
residual that noise would not hide, noise being what the best model leaves, or a tenth of it where it is all rounding;
fewer than the lights themselves say only where noise allows it. Where the residual shows that the picture was drawn
with the samples that its lights say, these are taken. Where an accuracy is asked for, the error is to be a small part
of that instead, told by the largest count. What remains is told in the errors, as is what more samples than the lights'
own change where the residual shows neither.

The first fit also says where n is, so that all pixels see their light samples in one pass (`brdf.lobes.Near`).
"""

import dataclasses
import math

import numpy as np

from brdf.errors import InputError
from brdf.lobes import STACKED_VALUES, STORED_SAMPLES, Near
from fitting.budget.configurations import Configuration, Run, run
from fitting.budget.error_estimate import Probes, is_dithered
from fitting.budget.sampling import sample_counts, with_samples
from fitting.problem import FitProblem, has_pixel_areas
from fitting.sample_error import MOST, SampleError, near_exponent
from fitting.solver.nnls import scaled_inverse
from fitting.solver.profile import UNSEEN
from fitting.uncertainty.covariance import LOST_IN_NOISE

# Pixels of the first fit, its samples, and those that are tried.
PIXELS, FIRST_SAMPLES = 1024, 64
MOST_SAMPLES = 4096
LADDER = (16, 36, 64, 144, 256, 576, 1024, 2048, MOST_SAMPLES)
# Of what noise leaves of a number, of the number, and of an accuracy.
OF_NOISE, OF_VALUE, OF_ACCURACY = 1 / 3, 1e-3, 0.2
# Models that leave so many times what the best one does are not asked how many they take.
AS_GOOD = 1.1
# Counts differ by such a factor at least.
APART = 1.5
# Of the noise, root mean square over pixels: less shows in no sum over blocks of them; more than the other is no noise.
HIDDEN, NO_NOISE = 0.02, 0.3
# Of the noise of codes that least squares sees, where there is hardly any before rounding: their likelihood sees less.
OF_CODES = 0.1
# A residual holds what one of two counts leaves out, or nothing of it: a share of 1 or 0, whose standard error is to be
# below this.
SHARE_ERROR = 0.2
# Each count changes at most so much of what the one before changed; those beyond the last one are taken to change so
# much at least.
SLOWEST, UNTRIED = 0.7, 0.5
# Where more samples move log n so far the first fit is made again, of more of them, but no more than so many.
FAR, MOST_FIRST = 0.1, 1024
# Up to so many values are kept rather than tabulated: exact, for every exponent.
KEPT = STACKED_VALUES >> 3
# To either side of n all pixels may find it by so many errors of the first fit; of log n at least.
ERRORS, LEAST = 6.0, 0.02


def with_enough_samples(problem: FitProblem, accuracy: float | None = None) -> FitProblem:
    """The problem with as many samples in its lights as it takes, and with what these leave out.

    Args:
        problem: any; returned as it is where it has no light of many samples.
        accuracy: relative error that is good enough, beside `MOST_SAMPLES` samples; None for what noise allows.
    """
    own = max((count for scene in problem.scenes for count in sample_counts(scene)), default=1)
    if problem.streamed or own <= STORED_SAMPLES or any(map(has_pixel_areas, problem.scenes)):
        return problem
    plain = dataclasses.replace(problem, loss="squared", noise=None, plausible=False)
    try:
        models = problem.families if problem.model == "auto" else (problem.model,)
        ladders = {model: _Ladder(plain, model, own, min(FIRST_SAMPLES, own), accuracy) for model in models}
        # What a worse model leaves beside that is no noise.
        noise = min(one.noise for one in ladders.values())
        ladders = {model: _refined(one, noise) for model, one in ladders.items()}
    except InputError:
        return problem  # the fit itself tells what is wrong
    noise = min(one.noise for one in ladders.values())
    good = [one for one in ladders.values() if one.noise <= AS_GOOD * noise]
    samples = max(one.enough(noise) for one in good)
    if accuracy is None and own < samples and min(good, key=lambda one: one.noise).shows(own, samples):
        samples = own
    scenes = [with_samples(scene, samples) for scene in problem.scenes]
    errors = {model: one.error(samples) for model, one in ladders.items()}
    return dataclasses.replace(problem, scenes=scenes, shown=problem.scenes, sample_errors=errors)


def _refined(found: "_Ladder", noise: float) -> "_Ladder":
    """The same from a first fit of more samples, where so few leave more than the picture's noise."""
    while True:
        first, own, noise = found.first, found.own, min(noise, found.noise)
        samples = found.enough(noise)
        # What its own samples leave out is no noise of the picture.
        enough = abs(found.move(samples)) <= FAR and found.missed(first)[1] <= NO_NOISE * noise
        most = min(samples, MOST_FIRST)
        if enough or most <= first:
            return found
        first = own if first < own <= most else most
        found = _Ladder(found.problem, found.model, own, first, found.accuracy)


def _matt(done: Run) -> Run:
    """Less a highlight that noise has put there: it may be narrower than any, and ask for no end of samples."""
    optimum = dataclasses.replace(done.optimum, x=done.optimum.x * [[1], [1], [0]])
    return done._replace(result=dataclasses.replace(done.result, optimum=optimum))


class _Ladder:
    """A model of more and more light samples at some pixels."""

    def __init__(self, problem: FitProblem, model: str, own: int, first: int, accuracy: float | None):
        """Fit some pixels under a first number of samples."""
        self.problem, self.model, self.own, self.first, self.accuracy = problem, model, own, first, accuracy
        done = run(problem, Configuration(model, problem.precision, PIXELS, first))
        if any(one.reason == LOST_IN_NOISE for one in done.result.parameters):
            done = _matt(done)
        self.done, self.optimum, self.x = done, done.optimum, done.optimum.x
        self.probes = Probes(done)
        # The search went up to the exponent that the nearest pixel sees a trace of.
        highest = np.max(self.optimum.grid, initial=0.0)
        self.peak = -UNSEEN / highest if 0 < highest < 0.999 * problem.n_range[1] else 0.0
        active = np.append((self.x > 0).ravel(), bool((self.x[2] > 0).any()))
        self.inverse = scaled_inverse(self.probes.hessian * np.outer(active, active))
        self.shown, self.noise = {first: self.probes.shown}, float(np.sqrt(np.mean(done.result.noise**2)))
        # What a count hardly larger than another one changes tells nothing of what both leave out.
        self.counts = sorted({own, *(some for some in LADDER if max(some / own, own / some) >= APART)})

    def enough(self, noise: float) -> int:
        """How many samples it takes where the picture has such a noise."""
        return next((count for count in self.counts if self._is_enough(count, noise)), self.counts[-1])

    def _picture(self, samples: int) -> np.ndarray:
        """What the first fit shows under so many samples, (M, C)."""
        if samples not in self.shown:
            self.shown[samples] = self.probes.under([with_samples(scene, samples) for scene in self.problem.scenes])
        return self.shown[samples]

    def _change(self, coarse: int, fine: int) -> tuple[np.ndarray, float]:
        """The scores of what other samples change, and its root mean square over pixels."""
        change, weight = self._picture(fine) - self._picture(coarse), self.probes.weight
        square = weight @ np.mean(change**2, axis=1) / np.sum(weight)
        return self.probes.scores(change).sum(axis=0), float(np.sqrt(square))

    def missed(self, samples: int) -> tuple[np.ndarray, float]:
        """Scores of what all samples beyond so many change, (K, U), and its root mean square over pixels.

        Beside an accuracy, of those up to `MOST_SAMPLES`, which is dearer and surer, and of those beyond.
        """
        if self.accuracy is None:
            return self._beyond(samples)
        (score, size), (more, beyond) = self._change(samples, self.counts[-1]), self._beyond(self.counts[-1])
        return np.vstack([score, more]), math.hypot(size, beyond)

    def _beyond(self, samples: int) -> tuple[np.ndarray, float]:
        """By the change to the next count, and those after it as changes fall off.

        Of a number that change may be next to nothing by chance: the one before, made as small, is as likely.
        """
        index, last = self.counts.index(samples), len(self.counts) - 2
        step = min(index, last)
        coarse, fine = self.counts[step : step + 2]
        score, size = self._change(coarse, fine)
        scores, fall = [score], coarse / fine
        if step:
            before, larger = self._change(self.counts[step - 1], coarse)
            fall = min(size / max(larger, np.finfo(float).tiny), SLOWEST)
            scores.append(fall * before)
        more = max(fall, UNTRIED) / (1.0 - max(fall, UNTRIED)) if index > last else 1.0 / (1.0 - fall)
        return more * np.stack(scores), more * size

    def _is_enough(self, samples: int, noise: float) -> bool:
        scores, size = self.missed(samples)
        if self.accuracy is not None:
            return bool(np.linalg.norm(self.probes.error(scores @ self.inverse)) <= OF_ACCURACY * self.accuracy)
        off = np.linalg.norm(scores @ self.inverse, axis=0)
        given, felt = samples >= self.own, noise
        if not is_dithered(noise, self.problem.widest_step):
            felt *= OF_CODES
        rest, value = felt * np.sqrt(np.diag(self.inverse)), np.append(self.x.ravel(), 1.0) * given
        hidden = size <= HIDDEN * felt or (given and size > NO_NOISE * noise)
        return hidden and bool(np.all(off <= np.maximum(OF_NOISE * rest, OF_VALUE * value)))

    def shows(self, samples: int, rival: int) -> bool:
        """Whether the residual tells that the picture was drawn with so many samples, and not with a rival number."""
        change = self._unexplained(self._picture(rival) - self._picture(samples))
        left = self._unexplained(self.probes.residual + self.probes.shown - self._picture(samples))
        weighted = self.probes.weight[:, None] * change
        square = np.sum(weighted * change)
        noise = np.sqrt(min(np.mean(left**2), np.mean((left - change) ** 2)))
        known = noise * np.linalg.norm(weighted) < SHARE_ERROR * square
        return bool(known and np.sum(weighted * left) < 0.5 * square)

    def _unexplained(self, change: np.ndarray) -> np.ndarray:
        """What no other material makes of a change of the picture, (M, C)."""
        move = self.inverse @ self.probes.scores(change).sum(axis=0)
        return change - self.probes.jacobian @ move

    def move(self, samples: int) -> float:
        """By how much so many samples move log n."""
        return float((self.inverse @ self._change(samples, self.first)[0])[-1])

    def near(self, samples: int) -> Near | None:
        """About the exponent that all pixels will find under so many samples; None where all terms may be kept."""
        if sum(math.prod(one.resolution) * (1 + one.channels) for one in self.problem.scenes) * samples <= KEPT:
            return None
        reach, value, move = math.inf, 1.0, float(np.clip(self.move(samples), -MOST, MOST))
        for one in self.done.result.parameters:
            if one.name == "n" and one.value is not None and one.error is not None:
                reach, value = max(ERRORS * one.error / one.value + abs(move), LEAST), one.value
        low, high = map(math.log, self._likely(samples))
        if reach <= MOST and high - low <= 2 * MOST:
            return near_exponent(value * math.exp(move), reach, self.peak)
        least, most = map(math.log, self.problem.n_range)
        return Near.between(max(low - MOST, least), min(high + MOST, most), self.peak)

    def _likely(self, samples: int) -> tuple[float, float]:
        """Between which exponents all pixels may find theirs.

        Of two valleys a few samples may show the wrong one as the lower: what they leave out may be all of its misfit
        and be missing in the other.
        """
        grid, cost = self.optimum.grid, self.optimum.profile
        if not grid.size:
            return self.problem.n_range
        missed = 3 * self._change(samples, self.first)[1] ** 2 * np.sum(self.optimum.pixels)
        some = grid[cost <= np.min(cost) * (1 + ERRORS**2 / (self.probes.weight.size * self.x.shape[1])) + missed]
        return float(np.min(some)), float(np.max(some))

    def error(self, samples: int) -> SampleError:
        """What so many samples leave out."""
        profile = np.stack([self.optimum.grid, self.optimum.profile])
        scores, size = self.missed(samples)
        if self.own < samples and not self.shows(samples, self.own):
            score, of_own = self._change(samples, self.own)
            scores, size = np.vstack([scores, score]), math.hypot(size, of_own)
        return SampleError(self.near(samples), self.probes.hessian, scores, profile, size)
