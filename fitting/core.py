"""One fit: the pictures of a problem under one model, or under the simplest adequate one."""

import dataclasses
import itertools
import math
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

import brdf
from brdf.channels import channel_names
from brdf.errors import InputError
from brdf.lobes import Near
from brdf.precision import working_precision
from fitting.doubts import doubts
from fitting.growing_noise import Shown, as_it_grows, likeliest
from fitting.jpeg_errors import allowing_for_codec, codec_of, without_codec_errors
from fitting.light_colour import coefficient_factors
from fitting.maximum_likelihood import bounds_of, highlight_in_codes, most_likely, unexplained
from fitting.model_fit import ModelFit
from fitting.pixels import Observed, observe
from fitting.problem import FitProblem
from fitting.result import FitResult
from fitting.sample_error import MOST, between, near_exponent, nearer
from fitting.selection import FAMILIES, Choice, PixelNoise, choose, is_better, may_be_off
from fitting.solver.devices import placed
from fitting.solver.losses import reweight
from fitting.solver.nnls import inverse_diagonal, nonnegative_minima
from fitting.solver.normal_equations import Picture
from fitting.solver.profile import Optimum, refit, search, within_sight
from fitting.solver.refinement import TOLERANCE_DOUBLE
from fitting.solver.streams import Stream, each
from fitting.solver.tied import NormalEquations, design_of, join_channels, places_of
from fitting.tile import picture_of
from fitting.uncertainty.covariance import NO_TRACE, residual_noise, specular_gain
from fitting.uncertainty.interpretation import alone_covariance, interpret, shared_errors
from fitting.uncertainty.noise_model import weighted_sums
from fitting.uncertainty.residual import SOME_PIXELS, Residual, residual_statistics, variance_inflation
from fitting.uncertainty.structure import CHANCE, SIZES, Blocks, Errors, over_blocks, shared
from fitting.uneven_noise import evened, noise_of_each, with_bounds

# A residual above this share of the picture: what the scene says is probably not what the picture shows.
UNEXPLAINED = 0.5
# A highlight that explains less than this share of what errs together without it is none.
EXPLAINED = 0.35
# One that explains this share of all squares is one: sums over few blocks, as of a small picture, say little.
PLAIN = 0.9
# A highlight that changes no value by this share of a code is none: rounding hides it.
HIDDEN = 0.5
# A highlight in a colour JPEG has a colour where that is so many deviations of what the codec leaves.
COLOURED = 4.0
# As many independent values a picture has at least.
FEWEST_MEASUREMENTS = 30.0
# A highlight that leaves so many times the squares of another one is not made likelier than it by rounding.
HOPELESS = 3.0
# So often lobes of many light samples are tabulated, nearer to where n was found each time.
TRIALS = 4
# An exponent up to this multiple of the lower bound is at the bound.
WIDEST = 1.01
# There Lambert's law takes up what rounding makes of it.
ROUNDED_AWAY = "a highlight as wide as the search allows changes no value by a code"
# By so much rounding may lift a sum over its bound.
ROUNDING = 1e-12


_Fitted: TypeAlias = tuple[ModelFit, Choice | None, Observed, Residual | None]


def fit_pictures(problem: FitProblem) -> FitResult:
    """Fit a material: the global optimum over all pixels that count; refused where nothing is left to fit."""
    # Over the largest of them all, so that single precision holds them.
    largest = max((float(np.max(weight)) for weight in problem.weights if weight is not None), default=1.0)
    weights = [None if weight is None else weight / largest for weight in problem.weights]
    problem = dataclasses.replace(problem, weights=weights)

    with working_precision(problem.precision):
        seen = observe(problem)
        even = _fitted(_evenly_noisy(seen))
        fit, choice, observed, statistics = grown = _with_growing_noise(even, seen)
        fit = _held_plausible(fit, observed)
        if fit.capped or problem.loss != "squared":
            statistics = None
        result, optimum = _interpreted(fit, observed, choice, statistics=statistics), fit.optimum
        # Why there is a highlight in the numbers but none in the material.
        reasons = {one.reason for one in result.parameters if one.name in ("k_s", "n")}
        hidden = reasons.pop() if len(reasons) == 1 else ""
        widest = optimum.n <= WIDEST * problem.n_range[0]
        if widest and not hidden and highlight_in_codes(fit.pictures, optimum) < 1.0:
            hidden = ROUNDED_AWAY
        if hidden and not fit.capped and optimum.x[2].any():
            # Or ambient and diffuse would be the ones that go with the highlight. Weights of a robust loss are made
            # anew.
            free = fit.free & [[True], [True], [False]]
            pictures = fit.pictures if problem.loss == "squared" else None
            rest = _held_plausible(most_likely(_fit_model(fit.model, observed, free, pictures)), observed)
            stays = np.append((rest.optimum.x > 0).ravel(), False)
            moved, dropped = [stays * one for one in fit.moved], (_by_highlight(fit, rest, observed),)
            fit = rest._replace(moved=moved, dropped=dropped)
            result = _interpreted(fit, observed, choice, hidden)
    if grown is not even:
        # Of the picture as it is, not as noise weighs it.
        result = dataclasses.replace(result, residual=even[0].residual)
    candidates = () if choice is None else choice.candidates
    return dataclasses.replace(result, candidates=candidates, optimum=optimum)


def predictions(problem: FitProblem) -> tuple[list[Float[np.ndarray, "H W C"]], list[Bool[np.ndarray, "H W"]]]:
    """What the model that is asked for, or the simplest adequate one, shows of each picture, and which pixels counted.

    As `fit_pictures`, of noise that is even, without the errors of anything.
    """
    with working_precision(problem.precision):
        seen = observe(problem)
        fit, *_ = _fitted(_evenly_noisy(seen))
        shown: list[list[np.ndarray]] = [[] for _ in problem.targets]
        for picture, owner in zip(fit.pictures, seen.owner, strict=True):
            shown[owner].append(np.asarray(picture.predict(fit.optimum.n, fit.optimum.x)))
    shapes = [target.pixels.shape for target in problem.targets]
    return [np.concatenate(tiles).reshape(shape) for tiles, shape in zip(shown, shapes, strict=True)], seen.counted


def _with_growing_noise(first: _Fitted, seen: Observed) -> _Fitted:
    """A fit again, with noise that grows with brightness, where that makes the picture likelier."""

    def grown(last: _Fitted) -> _Fitted | None:
        uneven = _growing(seen, last[0])
        return None if uneven is None else _fitted(uneven)

    def value(one: _Fitted) -> float:
        return -math.inf if one[0].evidence is None else one[0].evidence.value

    def alike(one: _Fitted) -> tuple[bool, float]:
        assert one[0].evidence is not None
        found = shared_errors(one[0].evidence, seen)[1]
        return found.significant, found.excess

    return likeliest(first, grown, value, alike)


def _growing(seen: Observed, fit: ModelFit) -> Observed | None:
    """Weighed by noise that seems to grow beside what the fit shows; None where it does not."""

    def of(picture: Picture) -> Shown:
        def predicted(pixel: Any) -> np.ndarray:
            some = picture if pixel is ... else picture.in_double(pixel)
            # Behind them some of sampled lights are repeated.
            shown = np.asarray(some.predict(fit.optimum.n, fit.optimum.x), float)
            return shown if pixel is ... else shown[: pixel.size]

        return Shown(bounds_of(picture).spread, predicted)

    return None if fit.evidence is None else as_it_grows(seen, list(map(of, fit.pictures)), fit.evidence.noise)


def _fitted(observed: Observed) -> _Fitted:
    """The model that is named, or the simplest adequate one; the pixels less what a codec did, and what is left."""
    problem, fits = observed.problem, {}
    if problem.model != "auto":
        fit = _fit_model(brdf.MODELS[problem.model], observed)
        return *_less_codec_errors(fit, None, observed), None
    for name in problem.families if observed.reached(brdf.Lambert)[1].any() else ("lambert",):
        if isinstance(observed.tiles, Stream) and problem.loss == "squared" and not observed.limited:
            # The pictures of one model at a time are in memory; those of the others are made anew where asked for.
            fits = {
                done: fit._replace(pictures=each(partial(picture_of, fit.model), observed.tiles))
                for done, fit in fits.items()
            }
        fits[name] = _fit_model(brdf.MODELS[name], observed)
    by_squares = _best_first(fits)
    fits, least, precision, likeliest = dict(by_squares), next(iter(by_squares.values())).cost, None, -math.inf
    for name, fit in by_squares.items():
        if fit.cost <= HOPELESS * least:
            grey = coefficient_factors(fit.model, fit.optimum.n, observed.colour)[2]
            fits[name] = fit = most_likely(fit, grey=grey, precision=precision, rival=likeliest)
            precision = None if fit.evidence is None else fit.evidence.precision
            if fit.evidence is not None and not _too_wide(fit, problem):
                likeliest = max(likeliest, fit.evidence.value)
    fits = _comparable(fits, observed)
    fit, choice, tied, statistics = _simplest(fits, by_squares, observed)
    del fits, by_squares  # what is known of the others fills memory
    chosen = _as_chosen(fit, choice, tied)
    return *_less_codec_errors(chosen, choice, observed), statistics if chosen is fit else None


def _fit_model(
    model: type[brdf.Material],
    observed: Observed,
    free: np.ndarray | None = None,
    pictures: Sequence[Picture] | None = None,
) -> ModelFit:
    """One model by least squares, with the loss that is asked for.

    All that the light reaches is free where nothing else is said.
    """
    free, problem = observed.reached(model) if free is None else free, observed.problem
    limits = [observed.limits[picture] for picture in observed.owner]
    if pictures is not None:
        near = next((picture.lobe.near for picture in pictures if picture.lobe is not None), None)
        return _fit_about(model, observed, free, pictures, near, limits)
    error = problem.sample_error(model.name)
    near, trial = None if error is None else error.near, 0
    while True:
        trial += 1
        made = partial(picture_of, model, near=near)
        if problem.streamed:
            pictures = each(made, observed.tiles)
        else:
            pictures = list(map(placed, itertools.count(), map(made, observed.tiles)))
        fit = _fit_about(model, observed, free, pictures, near, limits)
        if (empty := np.flatnonzero(fit.optimum.pixels == 0)).size:
            clipped = ", ".join(channel_names(fit.optimum.pixels.size)[channel] for channel in empty)
            what = f"is clipped in channel {clipped} wherever it sees the object"
            raise InputError("target", what, "Give a darker exposure or a higher saturation")
        if fit.optimum.flat:
            break
        # Lobes are made anew for each exponent, and rounded values ask for many.
        anew = not problem.streamed and any(one.bounds is not None and one.is_sampled for one in pictures)
        if near is not None or anew:
            n, peak = fit.optimum.n, max(picture.nearest_peak for picture in pictures)
            last = trial + 1 >= TRIALS
            found = n, _error_of_log_n(fit, observed), problem.n_range, peak
            near = near_exponent(n, MOST, peak) if near is None else nearer(near, *found, last=last)
        if near is None:
            break
    if error is None or model.name not in (problem.sample_errors or {}) or not error.profile.size:
        return fit
    # All pixels were looked at near one exponent; the first fit's profile is over all.
    grid, profile = error.profile
    return fit._replace(optimum=dataclasses.replace(fit.optimum, grid=grid, profile=profile))


def _error_of_log_n(fit: ModelFit, observed: Observed) -> float:
    """Standard error under independent noise."""
    optimum = fit.optimum
    free = np.append((optimum.x > 0).ravel(), True)
    hessian = optimum.normal(residual_noise(optimum, observed.rounding) ** 2).gram * np.outer(free, free)
    return math.sqrt(inverse_diagonal(hessian)[-1]) / optimum.n


def _evenly_noisy(observed: Observed) -> Observed:
    """Pictures of different noise count by what they know, where the user does not say how."""
    problem = observed.problem
    weighed = problem.loss != "squared" or problem.noise is not None or any(w is not None for w in problem.weights)
    if weighed:
        return observed
    observed, noises = with_bounds(observed), []
    if len(problem.targets) == 1:
        return observed
    for name in problem.families if problem.model == "auto" else (problem.model,):
        model, some = brdf.MODELS[name], []
        for tile, owner in zip(observed.tiles, observed.owner, strict=True):
            picture = picture_of(model, tile)
            pixels = np.flatnonzero(picture.counts)[:: 1 + len(picture.target) * len(observed.owner) // SOME_PIXELS]
            some += [(picture.in_double(pixels), owner)] if pixels.size else []
        pictures, owner = zip(*some, strict=True)
        with jax.enable_x64(True):
            fitted = partial(_fit_about, model, observed, observed.reached(model))
            noises.append(noise_of_each(pictures, np.array(owner), observed.roundings, fitted))
    return evened(observed, min(noises, key=lambda noise: noise.cost))


def _fit_about(
    model: type[brdf.Material],
    observed: Observed,
    free: np.ndarray,
    pictures: Sequence[Picture],
    near: Near | None = None,
    limits: Sequence[tuple[float, float]] = (),
) -> ModelFit:
    """One model, whose lobe may be tabulated near some exponents."""
    n_range, loss = between(near, observed.problem.n_range), observed.problem.loss
    optimum, among = search(pictures, *within_sight(pictures, free, n_range)), (free, n_range)
    pictures, optimum, factor = reweight(pictures, optimum, among, loss, observed.rounding, limits)
    free, n_range = within_sight(pictures, free, n_range)
    about = {"owner": observed.owner, "copies": observed.copies}
    return ModelFit(model, pictures, optimum, free, n_range, noise_factor=factor, **about)


def _simplest(
    fits: Mapping[str, ModelFit], by_squares: Mapping[str, ModelFit], observed: Observed
) -> tuple[ModelFit, Choice, Float[np.ndarray, " C"] | None, Residual | None]:
    """Of fits of the families, the best first, the simplest adequate one; what its x_s are tied to; what it leaves."""
    best = next(iter(fits.values()))
    grey = {name: coefficient_factors(fit.model, fit.optimum.n, observed.colour)[2] for name, fit in fits.items()}
    errors, likely, statistics = _told_apart_by(fits, observed, grey[best.model.name])
    free = np.logical_or.reduce([fit.free for fit in fits.values()])
    choice = choose({name: fit.optimum for name, fit in fits.items()}, free, grey, errors, likely)
    statistics = statistics if choice.model == best.model.name else None
    if choice.model not in FAMILIES and not _explains_structure(fits[choice.model], observed, statistics):
        shown = fits[choice.model].optimum.x
        best = most_likely(_fit_model(brdf.Lambert, observed))
        fits = {"lambert": best}
        errors = errors._replace(colour_inflation=1.0)
        choice = choose({"lambert": best.optimum}, best.free, grey, errors, _likely_sums(fits))
        # It may be one after all.
        moved = np.where(best.optimum.x > 0, shown - best.optimum.x, 0.0)
        choice = choice._replace(dropped=np.append(moved.ravel(), 0.0))
    if choice.model in FAMILIES:
        chosen = list(fits.values())[-1]
        matt = each(lambda picture: dataclasses.replace(picture, lobe=None), chosen.pictures)
        chosen = chosen._replace(model=brdf.Lambert, pictures=matt if observed.problem.streamed else list(matt))
    else:
        chosen = fits[choice.model]
        if chosen.tied is not None and not choice.grey:
            # Where channels err together a highlight is looked for in brightness; its colour is each channel's own.
            chosen = by_squares[choice.model]
            if np.array_equal(choice.free, chosen.free):
                chosen = most_likely(chosen)
    return chosen, choice, grey[choice.model] if choice.grey else None, statistics


def _as_chosen(fit: ModelFit, choice: Choice, tied: Float[np.ndarray, " C"] | None) -> ModelFit:
    """A fit with the terms of a choice alone: again, unless it has no others."""
    pictures, optimum = fit.pictures, fit.optimum
    others = choice.model in FAMILIES or not np.array_equal(choice.free, fit.free)
    if not others and tied is None:
        return fit
    if others:
        optimum = search(pictures, choice.free, fit.n_range)
    if tied is not None:
        optimum = refit(pictures, optimum, choice.free, fit.n_range, tied)
    return most_likely(fit._replace(optimum=optimum, free=choice.free, tied=tied))


def _comparable(fits: Mapping[str, ModelFit], observed: Observed) -> dict[str, ModelFit]:
    """By weights that are the same for all, the best first; none whose lobe is too wide."""
    problem = observed.problem
    fits = {name: fit for name, fit in fits.items() if not _too_wide(fit, problem)}
    fits = fits or {"lambert": most_likely(_fit_model(brdf.Lambert, observed))}
    if problem.loss != "squared" or observed.limited:
        # Weights are part of what is minimised: those of the better family serve all, or costs could not be compared;
        # so do pixels that no family says to be near a limit.
        best = min(fits.values(), key=lambda fit: float(np.sum(residual_noise(fit.optimum, observed.rounding))))
        weights = each(_weight_of_all, best.pictures, *(fit.pictures for fit in fits.values()))
        for name, fit in fits.items():
            pictures = each(lambda one, weight: dataclasses.replace(one, weight=weight), fit.pictures, weights)
            fits[name] = fit._replace(pictures=pictures, optimum=search(pictures, fit.free, fit.n_range))
    return _best_first(fits)


def _weight_of_all(picture: Picture, *others: Picture) -> Array:
    """That of a picture, 0 where that of another one is."""
    count = np.logical_and.reduce([np.asarray(other.weights) > 0 for other in others])
    return jnp.where(count, picture.weights, 0)


def _told_apart_by(
    fits: Mapping[str, ModelFit], observed: Observed, grey: Float[np.ndarray, " C"]
) -> tuple[PixelNoise, dict[str, NormalEquations], Residual | None]:
    """How pixels err, by the best fit, the first; the sums of a likelihood, where that is not of squares alone.

    Last what the best leaves, where it was asked for.
    """
    best = next(iter(fits.values()))
    noise, likely, colour_inflation = residual_noise(best.optimum, observed.rounding), _likely_sums(fits), 1.0
    statistics = None
    if likely:
        inflation, colour_inflation = _inflation(best, observed, grey)
    else:
        statistics = residual_statistics(best.pictures, observed.widths, best.optimum, noise, observed.rounding)
        inflation = statistics.neighbours.inflation
        if not observed.copies:
            inflation *= variance_inflation(statistics.channels(noise > 2 * observed.rounding))
        growing = statistics.growing_noise(noise, observed.rounding)
        if growing is not None:
            # Each pixel by its own variance, or noise in bright pixels would pass for a highlight.
            for name, fit in fits.items():
                parts = weighted_sums(fit.pictures, fit.optimum, growing, inverse=True)
                likely[name] = join_channels(parts.gram, parts.product, parts.square, fit.optimum.x[2])
    if observed.copies:
        inflation *= np.sqrt(observed.colour.size)
    # However much errs together, the picture is not less than a few measurements.
    inflation = min(inflation, max(float(np.sqrt(np.sum(best.optimum.pixels) / FEWEST_MEASUREMENTS)), 1.0))
    return PixelNoise(noise, inflation, colour_inflation), likely, statistics


def _best_first(fits: Mapping[str, ModelFit]) -> dict[str, ModelFit]:
    """By least squares."""
    return dict(sorted(fits.items(), key=lambda one: one[1].cost))


def _too_wide(fit: ModelFit, problem: FitProblem) -> bool:
    """A lobe wider than the search allows is no highlight: it mends what Lambert's law leaves at the rim."""
    return not fit.optimum.flat and fit.optimum.n <= WIDEST * problem.n_range[0]


def _less_codec_errors(
    fit: ModelFit, choice: Choice | None, observed: Observed
) -> tuple[ModelFit, Choice | None, Observed]:
    """The same terms again, where compression erred in their colours, and the pixels without these errors.

    What a codec takes away its look-alike does not show: which terms there are is decided before. But a highlight that
    was found in brightness may have any colour, and by that its model shows. Grey saved as colour has none to lose.
    """
    # Of a picture that is read by bands the first tells.
    unrounded = any(picture.bounds is None for picture in fit.pictures)
    if observed.copies or fit.capped or unrounded or not any(bounds_of(picture).lossy for picture in fit.pictures):
        return most_likely(fit) if choice is None else fit, choice, observed
    known = any(map(codec_of, observed.problem.targets))
    if choice is not None and fit.tied is not None:
        fits = [_fit_model(brdf.MODELS[name], observed, fit.free) for name in observed.problem.families]
        found = [without_codec_errors(observed, one) if known else (most_likely(one), observed) for one in fits]
        # Each family is nearest to its own look-alikes: it is judged beside those of all.
        value = [sum(_value(one, clean) for _, clean in found) for one in fits]
        best, clean = found[int(np.argmax(value))]
        if _coloured(best, clean):
            best = _allowing_for_codec(best, clean) if known else best
            return best, choice.coloured(best.model.name, best.free), clean
    if known:
        fit, observed = without_codec_errors(observed, fit)
        fit = _allowing_for_codec(fit, observed)
    elif choice is None:
        fit = most_likely(fit)
    return fit, choice, observed


def _allowing_for_codec(fit: ModelFit, observed: Observed) -> ModelFit:
    """With errors that hold what the codec hides; in units of both covariances: of few blocks one says too little."""
    return fit if fit.evidence is None else allowing_for_codec(fit, observed, np.add(*_covariances(fit, observed)))


def _covariances(fit: ModelFit, observed: Observed) -> tuple[Float[np.ndarray, "U U"], Float[np.ndarray, "U U"]]:
    """Those of a fit's numbers by what rounded values say, if pixels erred alone and as they do."""
    assert fit.evidence is not None
    alone = alone_covariance(fit.evidence.normal, fit.evidence.optimum.x, fit.tied)
    scatter = shared_errors(fit.evidence, observed)[0]
    return alone, alone if scatter is None else alone @ scatter @ alone


def _value(fit: ModelFit, observed: Observed) -> float:
    """The logarithm of the likelihood of such a fit to some pixels."""
    evidence = most_likely(_fit_model(fit.model, observed, fit.free)).evidence
    return -math.inf if evidence is None else evidence.value


def _coloured(fit: ModelFit, observed: Observed) -> bool:
    """Whether the channels' k_s differ by more than their errors, and by more codes than a codec errs in colours."""
    evidence = fit.evidence
    if evidence is None or not np.all(evidence.optimum.x[2] > 0):
        return False
    lobe = slice(2 * observed.colour.size, -1)
    grey = coefficient_factors(fit.model, fit.optimum.n, observed.colour)[2]
    covariance = _covariances(fit, observed)[1][lobe, lobe] / np.outer(grey, grey)
    k_s, precision = evidence.optimum.x[2] / grey, np.linalg.pinv(covariance, hermitian=True)
    left = k_s - np.sum(precision @ k_s) / np.sum(precision)
    seen_as = highlight_in_codes(fit.pictures, fit.optimum)
    differs = seen_as * float(np.max(np.abs(left)) / np.max(k_s)) > COLOURED * evidence.noise
    return differs and is_better(float(left @ precision @ left), k_s.size - 1)


def _likely_sums(fits: Mapping[str, ModelFit]) -> dict[str, NormalEquations]:
    """Sums whose cost is minus twice the logarithm of the likelihood, beside that of the likeliest, and so above 0.

    Of fits, the best by least squares first. Of one whose likelihood was not asked for, those of least squares over the
    noise of the best; nothing where least squares is the whole answer for that.
    """
    best, found = next(iter(fits.values())), {}
    if best.evidence is None:
        return found
    evidence = [fit.evidence for fit in fits.values() if fit.evidence is not None]
    value, above = max(one.value for one in evidence), max(float(np.sum(one.optimum.pixels)) for one in evidence)
    noise = np.maximum(best.optimum.cost / best.optimum.pixels, np.finfo(float).tiny)
    for name, fit in fits.items():
        if fit.evidence is None:
            found[name] = fit.optimum.normal(noise)
            continue
        one, normal = fit.evidence.optimum, fit.evidence.normal
        normal = normal._replace(gram=normal.gram.copy(), product=normal.product.copy())
        at = np.append(one.x.ravel(), 0.0)
        # A channel all of whose values are surely inside their codes, as a black one, says nothing of small changes; of
        # large ones least squares does.
        for index, gram, squares in zip(places_of(one.x.shape[1]), one.gram, fit.optimum.gram, strict=True):
            if not gram.any():
                own = np.ix_(index[:3], index[:3])
                normal.gram[own] += squares[:3, :3] / np.max(noise)
                normal.product[index[:3]] += normal.gram[own] @ at[index[:3]]
        # The same above 0 in all: how many values lie near an edge is no part of the likelihood.
        least = 2 * (value - fit.evidence.value) + above
        found[name] = normal._replace(square=least + (2 * normal.product - normal.gram @ at) @ at)
    return found


def _inflation(fit: ModelFit, observed: Observed, grey: np.ndarray) -> tuple[float, float]:
    """By what factor errors are too small where neighbours err together: the largest of any number.

    Where channels err together that of a highlight, the same in all, and by what further factor those of their colours:
    these err more, but tell little of it.
    """
    evidence = fit.evidence
    assert evidence is not None
    scatter, _, channels = shared_errors(evidence, observed)
    if scatter is None:
        return variance_inflation(channels), 1.0

    def largest(tied: np.ndarray | None, some: slice) -> float:
        design = design_of(evidence.optimum.x > 0, tied)
        inverse = np.linalg.pinv(design.T @ evidence.normal.gram @ design, hermitian=True)
        together = np.diag(inverse @ design.T @ scatter @ design @ inverse)[some]
        ratio = together / np.maximum(np.diag(inverse)[some], np.finfo(float).tiny)
        return float(np.sqrt(np.max(ratio, initial=1.0)))

    every = largest(None, slice(None))
    if evidence.precision is None:
        return every, 1.0
    bright = largest(grey, slice(-2, None))
    return bright, max(every / bright, 1.0)


def _explains_structure(fit: ModelFit, observed: Observed, after: Residual | None) -> bool:
    """Whether a highlight can be seen, and explains a good part of what errs together without it, if something does.

    One that changes no value by a good part of a code, or none by more than a trace of the brightest, is hidden by
    rounding: normals that are a little off would do as well. Where the scene is not what it is said to be, or a codec
    has smoothed, a highlight however significant mends some of that: in trials up to a third of it, where true
    highlights of 1 % explained more.
    """
    optimum = fit.optimum
    if highlight_in_codes(fit.pictures, optimum) < HIDDEN:
        return False
    noise = residual_noise(optimum, observed.rounding)
    after = after or residual_statistics(fit.pictures, observed.widths, optimum, noise, observed.rounding)
    if after.highlight.share(optimum.x, observed.brightest) < NO_TRACE:
        return False
    if fit.evidence is not None and fit.evidence.precision is not None:
        return True  # what errs together has been weighed by the channels' covariance
    x = nonnegative_minima(
        optimum.gram[:, :2, :2], optimum.product[:, :2], np.zeros((1, 2)), fit.free[:2].T, TOLERANCE_DOUBLE
    )
    matt_cost = optimum.square + np.einsum("cij,ci,cj->c", optimum.gram[:, :2, :2], x, x)
    matt_cost -= 2 * np.sum(x * optimum.product[:, :2], axis=1)
    if np.sum(optimum.cost) < (1 - PLAIN) * np.sum(matt_cost):
        return True
    left, chance = shared(_unexplained(fit.pictures, optimum, observed, after))
    if left <= CHANCE * chance:  # both 0 where predictions lie within all the codes
        return True
    matt = dataclasses.replace(optimum, x=np.vstack([x.T, np.zeros((1, len(x)))]))
    before = residual_statistics(fit.pictures, observed.widths, matt, noise, observed.rounding)
    explained = shared(_unexplained(fit.pictures, matt, observed, before))[0] - left
    return explained > EXPLAINED * (explained + left)


def _unexplained(
    pictures: Sequence[Picture], optimum: Optimum, observed: Observed, statistics: Residual
) -> list[Blocks]:
    found = []
    for picture, width, blocks in zip(pictures, observed.widths, statistics.blocks, strict=True):
        if picture.bounds is None:
            found.append(blocks)
            continue
        with jax.enable_x64(True):
            values = unexplained(picture, optimum)
        found.append(over_blocks(Errors(values, np.arange(len(values)), width), SIZES[0]))
    return found


def _held_plausible(fit: ModelFit, observed: Observed) -> ModelFit:
    """With k_d + k_s <= 1 in every channel held inside the search, where that is asked for and not so by itself.

    The bound moves with n, since k_s is x_s over the lobe's scale(n); clipping the unbounded optimum afterwards would
    miss the best n. `brdf.check` allows 1e-6 more.
    """

    def cap(n: float) -> np.ndarray:
        return 1.0 / coefficient_factors(fit.model, n, observed.colour) * [[0], [1], [1]]

    optimum = fit.optimum
    if not observed.problem.plausible or np.all(np.sum(cap(optimum.n) * optimum.x, axis=0) <= 1.0 + ROUNDING):
        return fit
    optimum = search(fit.pictures, fit.free, fit.n_range, cap)
    # What the bound adds to the residual is no noise: that of the fit without it says what stands out.
    noise = fit.noise_factor * float(np.sqrt(fit.cost / np.sum(optimum.cost)))
    return fit._replace(optimum=optimum, tied=None, capped=True, noise_factor=noise, evidence=None)


def _by_highlight(fit: ModelFit, rest: ModelFit, observed: Observed) -> Float[np.ndarray, " U"]:
    """By how much a highlight that does not stand out may have moved the rest, were it there."""
    x, evidence = fit.optimum.x, fit.evidence
    normal = (
        fit.optimum.normal(residual_noise(fit.optimum, observed.rounding) ** 2) if evidence is None else evidence.normal
    )
    step = np.where(rest.optimum.x > 0, x - rest.optimum.x, 0.0)
    return may_be_off(np.append(step.ravel(), 0.0), specular_gain(normal.gram, x), 1 + int(np.count_nonzero(x[2])))


def _interpreted(
    fit: ModelFit, observed: Observed, choice: Choice | None, hidden: str = "", statistics: Residual | None = None
) -> FitResult:
    if choice is not None:
        fit = fit._replace(dropped=(*fit.dropped, choice.dropped))
    result = interpret(fit, observed, hidden, statistics)
    warnings, share = list(result.warnings), fit.residual
    structure = any("structure" in text for text in warnings)
    # What errs by itself is noise, however much.
    if structure and share > UNEXPLAINED:
        words = f"the model leaves {100 * share:.0f} % of the picture: are light, camera and encoding what they were?"
        warnings.insert(0, words)
    if choice is not None and choice.rivals:
        names = " and ".join(choice.rivals)
        words = f"{names} fits as well as {fit.model.name}: the picture does not tell the two highlights apart"
        warnings.append(words)
    warnings += doubts(fit, result.material, observed, _fit_model, structure=structure)
    return dataclasses.replace(result, warnings=tuple(warnings))
