"""What a JPEG does to the colours of a picture, taken off before it is fitted.

A JPEG keeps brightness well and colours coarsely: in half the resolution, in large steps, and without the changes
within a block that are below half a step. That errs the same way all over a smoothly lit object, so that no residual
shows it and no error of blocks holds it. What it is a look-alike says: the prediction of a fit, with noise, through the
same codec. The mean of what that changes is taken off the codes and the rest fitted again, until the picture differs
from its look-alikes by no more than chance. How far numbers may be off until look-alikes show it is part of the errors.

Sources: C. Gourieroux, A. Monfort and E. Renault, "Indirect inference", J. Applied Econometrics 8 (1993) S85;
D. McFadden, "A method of simulated moments", Econometrica 57 (1989) 995.
"""

import dataclasses
import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from brdf.images.encoding import decode
from brdf.images.jpeg import Jpeg
from brdf.vectors import quotient
from fitting.likelihood import Bounds
from fitting.maximum_likelihood import bounds_of, change, most_likely
from fitting.model_fit import Evidence, ModelFit
from fitting.pixels import Observed
from fitting.problem import Target
from fitting.solver.nnls import scaled_inverse
from fitting.solver.normal_equations import Picture
from fitting.solver.profile import Optimum, refit
from fitting.solver.streams import each
from fitting.solver.tied import NormalEquations, design_of, join_channels

# In codes: the noise is that of these with which two look-alikes are nearest to the picture; their mean is of more.
NOISES, FIRST_NOISE = (0.0, 0.25, 0.35, 0.5, 0.7, 1.0, 1.4, 2.0, 2.8, 4.0, 5.6, 8.0), 3
COMPARED, LOOK_ALIKES = 2, 4
# Fits and shorter steps at most; the last is one that changes no number by more than this, in standard errors that the
# others leave, or brings the picture nearer to its look-alikes by less than this share.
MOST_FITS, ENOUGH_CHANGE, ENOUGH_NEARER = 8, 0.5, 2e-3
# What is still to come is up to so many times the last change.
APPROACH = 2.0
# Of more pixels than this a part is fitted first, in rows of the blocks of colours; then all, so often.
MANY, PART, BLOCK, MOST_WHOLE_FITS = 1 << 17, 4, 16, 2
# How far numbers are moved at first, in standard errors.
FIRST_STEP = 2.0
# Axes of less than this share of a variance, and directions that lower the cost by less than this share, are rounding.
LEAST_VARIANCE, LEAST_KNOWN = 1e-9, 1e-14
# Of a JPEG.
LARGEST_CODE = 255.0


def codec_of(target: Target) -> Jpeg | None:
    """How a picture in colour was compressed; None where it was not, or nobody knows how."""
    codes = target.codes
    return None if codes is None or codes.values.shape[2] != 3 else codes.jpeg


def without_codec_errors(observed: Observed, fit: ModelFit) -> tuple[ModelFit, Observed]:
    """The most likely fit to the pixels of a problem, less what compression does to look-alikes; and these pixels."""
    pictures, compressed = list(fit.pictures), list(map(_Compressed.of, observed.problem.targets))
    fit, most, count = fit._replace(pictures=pictures), MOST_FITS, LOOK_ALIKES
    if sum(len(one.shows) for one in compressed) > MANY and not any(picture.is_sampled for picture in pictures):
        some = list(map(_part, pictures))
        of_target = _parted(some, [one.shows for one in compressed])
        parts = [dataclasses.replace(one, shows=one.shows[own]) for one, own in zip(compressed, of_target, strict=True)]
        few = [picture.on_host(np.flatnonzero(own)) for picture, own in zip(pictures, some, strict=True)]
        fit = fit._replace(optimum=_nearest(fit._replace(pictures=few), parts, most, count).optimum)
        compressed = [
            dataclasses.replace(one, kind=part.kind, settled=True) for one, part in zip(compressed, parts, strict=True)
        ]
        most, count = MOST_WHOLE_FITS, COMPARED
    fit = _nearest(fit, compressed, most, count)
    tiles = each(lambda tile, own: tile._replace(target=own.target, bounds=own.bounds), observed.tiles, fit.pictures)
    return fit, observed._replace(tiles=tiles)


def allowing_for_codec(fit: ModelFit, observed: Observed, covariance: Float[np.ndarray, "U U"]) -> ModelFit:
    """A fit whose errors hold by how much its coefficients may be off before what the codec leaves shows it.

    Those of a term are moved along the axes of their covariance, both ways and twice as far each time, until the
    estimate from what comes back of such a picture moves by a standard error. Of large pictures many blocks tell, each
    by other steps of the codec: they are as they were.

    Args:
        fit: the most likely one, less what compression does to look-alikes.
        observed: its pixels.
        covariance: of x_a, x_d, x_s, channel after channel, and n.
    """
    evidence = fit.evidence
    if evidence is None or sum(len(picture.target) for picture in fit.pictures) > MANY:
        return fit
    moved, compressed = list(fit.moved), list(map(_Compressed.of, observed.problem.targets))
    response = _Response(fit, evidence, LookAlikes(compressed, COMPARED))
    for one in compressed:  # each of them has the noise of what was fitted
        one.settled = True
    for term in np.arange(fit.free.size).reshape(fit.free.shape):
        for axis, part in _axes(covariance, term):
            both = [response.distance(sign * axis, sign * part) for sign in (1.0, -1.0)]
            beyond = float(np.mean(both)) ** 2 - 1
            if beyond > 0:
                moved.append(math.sqrt(beyond) * axis)
    return fit._replace(moved=moved)


def _axes(
    covariance: Float[np.ndarray, "U U"], own: Int[np.ndarray, " K"]
) -> Iterator[tuple[Float[np.ndarray, " U"], Float[np.ndarray, " U"]]]:
    """The axes of the covariance of some unknowns, a standard error long each, and what of a change is along them."""
    error = np.sqrt(np.diag(covariance)[own])
    variances, axes = np.linalg.eigh(quotient(quotient(covariance[np.ix_(own, own)], error), error[:, None]))
    for variance, axis in zip(variances, axes.T, strict=True):
        if variance > LEAST_VARIANCE:
            step, part = np.zeros((2, len(covariance)))
            step[own], part[own] = error * axis * math.sqrt(variance), quotient(axis, error) / math.sqrt(variance)
            yield step, part


def _detection_distance(seen: Callable[[float], float], most: float) -> float:
    """How far, in standard errors and at most, a number has to be off until that is seen as one of them."""
    shorter, before, times = 0.0, 0.0, min(FIRST_STEP, most)
    while (now := seen(times)) < 1:
        if times == most:
            return most
        shorter, before, times = times, now, min(2 * times, most)
    return float(np.interp(1.0, [before, now], [shorter, times]))


class _Response:
    """How the estimate changes, to first order, when coefficients do and the picture comes back from its codec.

    Over x_a, x_d, x_s, channel after channel, and n.
    """

    def __init__(self, fit: ModelFit, evidence: Evidence, look_alikes: "LookAlikes"):
        """Of the pictures of a fit, by what these say."""
        at, channels = evidence.optimum, evidence.optimum.x.shape[1]
        self._at, self._pictures, self._look_alikes = at, fit.pictures, look_alikes
        self._precision = np.eye(channels) / evidence.noise**2 if evidence.precision is None else evidence.precision
        # Columns in units of the noise, and what makes codes such.
        self._columns, self._units, gram = [], [], np.zeros((channels, channels, 4, 4))
        for picture, weighed in zip(fit.pictures, evidence.pictures, strict=True):
            slope = bounds_of(picture).codes(np.asarray(picture.predict(at.n, at.x)))[1]
            root = np.sqrt(np.asarray(weighed.weights) / np.diag(self._precision))
            columns = weighed.columns(at.n) * root
            gram += np.einsum("kpc,lpd->cdkl", columns, columns, optimize=True) * self._precision[..., None, None]
            self._columns.append(columns)
            self._units.append(quotient(root, slope))
        self._gram, basis = gram, design_of(at.x > 0, fit.tied)
        hessian = self._joined(np.zeros((channels, 4))).gram
        self._inverse = basis @ scaled_inverse(basis.T @ hessian @ basis, LEAST_KNOWN) @ basis.T
        self._still = self._comes_back(at.x)

    def __call__(self, step: Float[np.ndarray, " U"]) -> Float[np.ndarray, " U"]:
        """The change of the estimate when coefficients change by so much."""
        product = np.zeros((len(self._precision), 4))
        back = self._comes_back(np.maximum(self._at.x + step[:-1].reshape(self._at.x.shape), 0.0))
        for columns, unit, now, still in zip(self._columns, self._units, back, self._still, strict=True):
            product += np.einsum("kpc,pc->ck", columns, (now - still) * unit @ self._precision)
        return self._inverse @ self._joined(product).product

    def distance(self, step: Float[np.ndarray, " U"], part: Float[np.ndarray, " U"]) -> float:
        """How many steps coefficients are off until the estimate is by one: ``part`` is what of a change is along it.

        At most until the first of them is 0, or the largest has doubled.
        """
        x, size = self._at.x.ravel(), step[:-1]
        most = np.max(x[size != 0]) / np.max(np.abs(size))
        most = min(most, np.min(x[size < 0] / -size[size < 0], initial=np.inf))
        return _detection_distance(lambda times: float(part @ self(times * step)), float(most))

    def _comes_back(self, x: Float[np.ndarray, "3 C"]) -> list[Float[np.ndarray, "P C"]]:
        return self._look_alikes.come_back(self._pictures, [one.predict(self._at.n, x) for one in self._pictures])

    def _joined(self, product: Float[np.ndarray, "C 4"]) -> NormalEquations:
        return join_channels(self._gram, product, product[:, 0], self._at.x[2])


def _part(picture: Picture) -> Bool[np.ndarray, " P"]:
    """Those whole rows of a picture, or of a band of it, that are nearest to the middle of the highlight."""
    width, count = int(bounds_of(picture).width), len(picture.target)
    size = min(width * max(BLOCK, count // width // PART // BLOCK * BLOCK), count)
    middle = 0 if picture.lobe is None else int(np.argmax(picture.lobe.peak))
    return np.arange(count) // size == min(middle // size, count // size - 1)


def _parted(parts: Sequence[np.ndarray], like: Sequence[np.ndarray]) -> list[np.ndarray]:
    """The same values of all pixels, parted as others are: bands of pictures, or whole ones."""
    return np.split(np.concatenate(parts), np.cumsum([len(one) for one in like])[:-1])


def _nearest(fit: ModelFit, compressed: Sequence["_Compressed"], most: int, count: int) -> ModelFit:
    """The fit whose look-alikes are nearest to the pictures, these less what compression does to those."""
    look_alikes, at, best, found = LookAlikes(compressed, count), fit.optimum, fit.optimum, fit
    for _ in range(most):
        if not look_alikes.are_nearer(fit.pictures, [picture.predict(at.n, at.x) for picture in fit.pictures]):
            # The steps of the codec bend what look-alikes show: nearer by it may be better.
            at = dataclasses.replace(at, x=(at.x + best.x) / 2, n=(at.n + best.n) / 2)
            continue
        pictures = look_alikes.taken_off(fit.pictures)
        found = fit._replace(pictures=pictures, optimum=refit(pictures, at, fit.free, fit.n_range, fit.tied))
        best, found = at, most_likely(found)
        at = found.optimum
        assert found.evidence is not None
        if change(best, found.evidence.optimum) < ENOUGH_CHANGE or look_alikes.enough:
            break
    evidence = found.evidence
    assert evidence is not None
    evidence = evidence._replace(widening=evidence.widening * look_alikes.widening)
    return found._replace(evidence=evidence, moved=(APPROACH * (_unknowns(found.optimum) - _unknowns(best)),))


class LookAlikes:
    """What codecs do to predictions of pictures, or of bands or tiles of such.

    Attributes:
        left: squares of what else the pictures show.
        enough: whether that hardly falls any more.
        widening: what to multiply errors by: the look-alikes' mean has a share of what each errs by, which is no more
            than what the picture errs by.
    """

    def __init__(self, compressed: Sequence["_Compressed"], count: int = LOOK_ALIKES):
        """So many of each picture."""
        self._compressed, self._count, self._parts = compressed, count, ()
        self.left, self.enough, self.widening = math.inf, False, 1.0

    @classmethod
    def of(cls, observed: Observed) -> "LookAlikes":
        """Of the whole pictures of a problem."""
        return cls(list(map(_Compressed.of, observed.problem.targets)))

    def are_nearer(self, pictures: Sequence[Any], radiance: Sequence[Float[np.ndarray, "P C"]]) -> bool:
        """Whether a prediction's look-alikes are nearer to the pictures than the last ones: then they are the ones."""
        shown, errors, left = self._through(pictures, radiance)
        if left > self.left:
            return False
        self.enough, self.left = self.left - left < ENOUGH_NEARER * left, left
        self.widening, self._parts = math.sqrt(1 + 1 / self._count), (shown, errors)
        return True

    def come_back(
        self, pictures: Sequence[Any], radiance: Sequence[Float[np.ndarray, "P C"]]
    ) -> list[Float[np.ndarray, "P C"]]:
        """What comes back of predictions, in codes; 0 of a value that says nothing."""
        shown, errors, _ = self._through(pictures, radiance)
        return list(map(np.add, map(np.nan_to_num, shown), errors))

    def _through(self, pictures: Sequence[Any], radiance: Sequence[Float[np.ndarray, "P C"]]) -> tuple[Any, Any, float]:
        """What is predicted, in codes; what compression does to it; and squares of what else the pictures show."""
        shown = list(map(_in_codes, map(bounds_of, pictures), radiance))
        both = zip(self._compressed, _parted(shown, [one.shows for one in self._compressed]), strict=True)
        errors, squares = zip(*(one.errors(some, self._count) for one, some in both), strict=True)
        return shown, _parted(errors, shown), math.fsum(squares)

    def taken_off(self, pictures: Sequence[Any]) -> Sequence[Any]:
        """The pictures less what compression does to them."""
        return list(map(_less, pictures, *self._parts)) if self._parts else pictures


def _unknowns(at: Optimum) -> Float[np.ndarray, " U"]:
    return np.append(at.x.ravel(), at.n)


def _in_codes(bounds: Bounds, radiance: Float[np.ndarray, "P C"]) -> Float[np.ndarray, "P C"]:
    """What is predicted; NaN where a value says nothing."""
    code, _ = bounds.codes(radiance.astype(np.float32))
    return np.where(bounds.ends > 0, code, np.float32(np.nan))


@dataclasses.dataclass
class _Compressed:
    """A picture, or some of its rows, and how it was compressed.

    Attributes:
        codec: None where it was not.
        shows: the codes, (P, C); of values that were taken out, as they were clipped, the largest.
        width: of the picture.
        unit: codes of a JPEG for one of the file's.
        kind: which of `NOISES` it has.
        settled: no other is tried.
        drawn: noise of deviation 1 of each look-alike, the same each time.
    """

    codec: Jpeg | None
    shows: Float[np.ndarray, "P C"]
    width: int
    unit: float
    kind: int = FIRST_NOISE
    settled: bool = False
    drawn: list[Float[np.ndarray, "P C"]] = dataclasses.field(default_factory=list, init=False)

    @classmethod
    def of(cls, target: Target) -> "_Compressed":
        """A whole picture."""
        shows, unit, width = np.asarray(target.pixels), 1.0, target.pixels.shape[1]
        if (codec := codec_of(target)) is not None and target.codes is not None:
            unit = LARGEST_CODE / target.codes.scale
            shows = np.nan_to_num(target.codes.values * unit, nan=LARGEST_CODE)
        return cls(codec, shows.reshape(-1, shows.shape[2]), width, unit)

    def errors(self, shown: Float[np.ndarray, "P C"], count: int) -> tuple[Float[np.ndarray, "P C"], float]:
        """What compression does to each code that is predicted, and the squares of what else the picture shows.

        Predictions are in codes, NaN where there is none; ``count`` is of look-alikes.
        """
        if self.codec is None:
            return np.zeros_like(shown), 0.0
        counts, known = np.isfinite(shown), {}
        clean = np.where(counts, shown * np.float32(self.unit), self.shows).astype(np.float32)
        while not self.settled:
            for kind in range(max(self.kind - 1, 0), min(self.kind + 2, len(NOISES))):
                if kind not in known:
                    known[kind] = self._look_alikes(clean, counts, NOISES[kind], COMPARED)[1]
            last, self.kind = self.kind, min(known, key=known.__getitem__)
            if last == self.kind:
                break
        errors, left = self._look_alikes(clean, counts, NOISES[self.kind], count)
        return errors / np.float32(self.unit), left

    def _look_alikes(
        self, clean: Float[np.ndarray, "P C"], counts: Bool[np.ndarray, "P C"], noise: float, count: int
    ) -> tuple[Float[np.ndarray, "P C"], float]:
        """Their mean change, and the squares of what the picture differs by from the mean of all there could be."""
        assert self.codec is not None
        shape, mean, off, squares = (-1, self.width, clean.shape[1]), np.zeros_like(clean), np.zeros_like(clean), 0.0
        for index in range(count):
            before = clean + counts * self._noise(index) * np.float32(noise)
            given = np.clip(np.rint(before), 0, LARGEST_CODE).astype(np.uint8)
            after = self.codec.through(given.reshape(shape)).reshape(clean.shape).astype(np.float32)
            mean += (after - before) / np.float32(count)
            after -= self.shows
            off, squares = off + after, squares + float(np.sum(np.where(counts, after, 0) ** 2, dtype=float))
        # Each look-alike has errors of its own: the product of two differences has neither's in the mean.
        together = float(np.sum(np.where(counts, off, 0) ** 2, dtype=float))
        return np.where(counts, mean, np.float32(0)), (together - squares) / (count * (count - 1))

    def _noise(self, index: int) -> Float[np.ndarray, "P C"]:
        """That of a look-alike; kept where it takes little memory."""
        if index < len(self.drawn):
            return self.drawn[index]
        found = np.random.default_rng([0, index]).standard_normal(self.shows.shape, np.float32)
        if len(found) <= MANY:
            self.drawn.append(found)
        return found


def _less(picture: Any, shown: Float[np.ndarray, "P C"], errors: Float[np.ndarray, "P C"]) -> Any:
    """A picture, or a tile, whose target and bounds are less what compression does where so much is predicted.

    Look-alikes are clipped as the picture is: of its values near an end only those are open that lie beyond it.
    """
    if not errors.any():
        return picture
    bounds, target = bounds_of(picture), np.asarray(picture.target)
    code, half = bounds.codes(target)[0], 0.5 * np.median(bounds.widths)
    open_end = bounds.ends == 1
    beyond = open_end & np.where(np.isinf(bounds.upper), shown >= bounds.scale, shown <= 0)
    errors = np.where(beyond, np.float32(0), errors)
    moved = decode(np.maximum(code - errors, 0.0) / bounds.scale, bounds.encoding) * bounds.unit
    lower, upper = (
        np.where(open_end & ~beyond, code + sign * half, end) - errors.astype(end.dtype)
        for sign, end in ((-1, bounds.lower), (1, bounds.upper))
    )
    moved = np.where(errors != 0, moved, target).astype(target.dtype)
    less = {"target": moved, "bounds": dataclasses.replace(bounds, lower=lower, upper=upper)}
    return dataclasses.replace(picture, **less) if isinstance(picture, Picture) else picture._replace(**less)
