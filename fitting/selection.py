"""The simplest adequate model: nothing, ambient light, Lambert, a highlight; grey or coloured; all from the same sums.

A candidate is a choice of terms. Its least squares need no pixel: the Gram matrix of the largest model at its optimum
holds that of every smaller one, and the exponent of a smaller one follows in the linearised model.

The criterion. Each candidate is judged by the squared error it is to be expected to show on pixels that were held out.
For least squares that has a closed form, no pixel is touched again: leaving each pixel out in turn gives the residual
sum of squares plus twice the noise variance for each unknown (Mallows 1973; Stone 1977). An exponent counts `SEARCHED`
unknowns instead of one, because the best of a whole range was searched for, and an invented highlight is the worse
mistake: on a matt ball with noise the best of all highlights gains 1.7 noise variances in the mean, but 7 in one case
of a hundred (``python -m benchmarks.selection --optimism --count 200 --size 64``). Candidates within one standard error
of the best are adequate (Breiman et al. 1984), and of these the simplest family is taken, in it the fewest unknowns.
The standard error is that of the difference of two candidates on the same pixels, 2 σ times the distance of their
pictures. Where neighbouring residuals go together, pixels count for less.

At the boundary: a coefficient that comes out as 0 is no unknown of that candidate. Next to the expected error the table
shows the Bayesian information criterion (Schwarz 1978), which asks more of large pictures.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from fitting.solver.nnls import nonnegative_minimum
from fitting.solver.profile import Optimum
from fitting.solver.tied import NormalEquations, design_of

# How many unknowns a searched exponent counts.
SEARCHED = 4.0
FAMILIES = ("none", "ambient", "lambert")
# So far, relative to n, the linearised model is trusted when a smaller one wants another exponent.
FARTHEST = 0.3


@dataclass(frozen=True)
class Candidate:
    """A model that was tried.

    Attributes:
        model: "none", "ambient", "lambert" or the name of a model with a highlight.
        ambient: whether it has an ambient term.
        highlight: "", "grey" (one k_s for all channels) or "coloured".
        unknowns: how many numbers are not 0 in it.
        rms: root mean square of its residual, in the unit of the picture.
        held_out: what that is to be expected on pixels that were held out.
        excess: squared error expected there, over that of the best candidate, in noise variances.
        excess_error: its standard error; where the excess is no larger, the candidate is adequate.
        bic: Bayesian information criterion over that of the best; the smallest is the best.
        chosen: whether the fit chose it.
    """

    model: str
    ambient: bool
    highlight: str
    unknowns: int
    rms: float
    held_out: float
    excess: float
    excess_error: float
    bic: float
    chosen: bool

    @property
    def name(self) -> str:
        """Model and terms in words."""
        words = [] if self.model in FAMILIES[:2] else ["with ambient" if self.ambient else "without ambient"]
        words += [f"{self.highlight} k_s"] if self.highlight else []
        return f"{self.model} {', '.join(words)}".strip()


class Choice(NamedTuple):
    """What the scene requires.

    Attributes:
        candidates: all that were tried, simplest first.
        model: of the chosen one.
        free: which coefficients it has, (3, C).
        grey: whether its k_s is the same in all channels.
        rivals: models with a highlight that the picture does not tell from the chosen one.
        dropped: by how much what was left out may have moved x_a, x_d, x_s, channel after channel, and n.
    """

    candidates: tuple[Candidate, ...]
    model: str
    free: Bool[np.ndarray, "3 C"]
    grey: bool
    rivals: tuple[str, ...]
    dropped: Float[np.ndarray, " U"]

    def coloured(self, model: str, free: Bool[np.ndarray, "3 C"]) -> "Choice":
        """The same terms with a coloured highlight."""
        wanted = model, bool(free[0].any()), "coloured"
        candidates = tuple(
            replace(one, chosen=(one.model, one.ambient, one.highlight) == wanted) for one in self.candidates
        )
        rivals = tuple(sorted({self.model, *self.rivals} - {model})) if self.rivals else ()
        return Choice(candidates, model, free, False, rivals, np.zeros_like(self.dropped))


def is_better(gain: float, unknowns: int) -> bool:
    """Whether so many further unknowns earn what they gain, in noise variances: a standard error, held out."""
    return gain - 2 * unknowns > 2 * np.sqrt(max(gain, 0.0))


class _Trial(NamedTuple):
    """A candidate solved from the sums; its unknowns are counted with `SEARCHED` in ``effective``."""

    model: str
    free: np.ndarray
    grey: bool
    unknowns: int
    effective: float
    solution: np.ndarray
    cost: float
    squares: float

    @property
    def rank(self) -> int:
        """Of its family, the simplest first."""
        return FAMILIES.index(self.model) if self.model in FAMILIES else len(FAMILIES)

    @property
    def expected(self) -> float:
        """Squared error on pixels that were held out, in noise variances."""
        return self.cost + 2 * self.effective


def _try(
    model: str, free: np.ndarray, tied: np.ndarray | None, normal: NormalEquations, plain: NormalEquations, n: float
) -> _Trial:
    design = design_of(free, tied)
    specular = bool(free[2].any())
    signed = np.zeros(design.shape[1], bool)
    signed[-1:] = specular
    gram, product = design.T @ normal.gram @ design, design.T @ normal.product
    highlight = slice(2 * free.shape[1], -1)
    x = nonnegative_minimum(gram, product, signed)
    if specular and (abs(x[-1]) > FARTHEST * n or not np.any((design @ x)[highlight] > 0)):
        # The lobe's derivative stands for a small change of n, not for a highlight of its own.
        for shift in (np.clip(x[-1], -FARTHEST * n, FARTHEST * n), 0.0):
            x = np.append(nonnegative_minimum(gram[:-1, :-1], product[:-1] - shift * gram[:-1, -1]), shift)
            if np.any((design @ x)[highlight] > 0):
                break
    solution = design @ x
    has_lobe = bool(np.any(solution[highlight] > 0))
    unknowns = int(np.count_nonzero(x[~signed] > 0)) + int(has_lobe)
    effective = unknowns + (SEARCHED - 1) * has_lobe
    cost, squares = (
        float(max(sums.square - 2 * sums.product @ solution + solution @ sums.gram @ solution, 0.0))
        for sums in (normal, plain)
    )
    return _Trial(model, free, tied is not None, unknowns, effective, solution, cost, squares)


class PixelNoise(NamedTuple):
    """How pixels err, as far as it tells candidates apart.

    Attributes:
        noise: that of the best fit.
        inflation: by so much the structure of its residual makes errors larger.
        colour_inflation: by so much more those of a highlight's colour.
    """

    noise: Float[np.ndarray, " C"]
    inflation: float
    colour_inflation: float = 1.0


def choose(
    fits: Mapping[str, Optimum],
    free: Bool[np.ndarray, "3 C"],
    grey: Mapping[str, Float[np.ndarray, " C"]],
    errors: PixelNoise,
    likely: Mapping[str, NormalEquations],
) -> Choice:
    """Choose the simplest adequate model.

    Of the optimum of each model with a highlight, or that of Lambert alone. ``grey`` are the x_s of a grey k_s, up to a
    factor, ``errors`` how pixels err by the best fit. ``likely`` are the sums of a likelihood, as with each pixel
    divided by its variance; empty where squares are all that counts.
    """
    channels = free.shape[1]
    no, ambient = np.zeros(channels, bool), bool(free[0].any())
    variance, inflation = (errors.noise * errors.inflation) ** 2, errors.inflation
    plain = {name: fit.normal() for name, fit in fits.items()}
    normals = {name: fit.normal(variance) for name, fit in fits.items()}
    for name, one in likely.items():
        normals[name] = NormalEquations(one.gram / inflation**2, one.product / inflation**2, one.square / inflation**2)
    first = next(iter(fits))
    terms = [("none", no, no), ("lambert", no, free[1])]
    terms += [("ambient", free[0], no), ("lambert", free[0], free[1])] if ambient else []
    trials = [_try(name, np.stack([*some, no]), None, normals[first], plain[first], 1.0) for name, *some in terms]
    for name, fit in fits.items():
        if name == "lambert" or fit.flat:
            continue
        for some in (no, free[0]) if ambient else (no,):
            wanted = np.stack([some, free[1], free[2]])
            cost = np.inf
            for tied in (np.where(free[2], grey[name], 0.0), None) if channels > 1 else (None,):
                trial = _try(name, wanted, tied, normals[name], plain[name], fit.n)
                if tied is not None:
                    cost = trial.cost
                elif cost > trial.cost and np.isfinite(cost):
                    trial = trial._replace(cost=cost - (cost - trial.cost) / errors.colour_inflation**2)
                # A highlight that comes out as nothing is Lambert's surface again.
                if np.any(trial.solution[2 * channels : -1] > 0):
                    trials.append(trial)
    return _decide(trials, normals, variance, float(np.sum(fits[first].pixels)))


def _decide(trials: list[_Trial], normals: Mapping[str, NormalEquations], variance: np.ndarray, count: float) -> Choice:
    trials = sorted(trials, key=lambda trial: (trial.rank, trial.model, trial.unknowns))
    best = min(trials, key=lambda trial: trial.expected)
    error = [2 * np.sqrt(_distance(trial, best, normals)) for trial in trials]
    bic = [trial.cost + trial.unknowns * np.log(count) for trial in trials]
    adequate = [trial for trial, margin in zip(trials, error, strict=True) if trial.expected - best.expected <= margin]

    def simplest(some: list[_Trial]) -> _Trial:
        return min(some, key=lambda trial: (trial.rank, trial.unknowns, trial.expected))

    chosen, rivals = simplest(adequate), set()
    if chosen.rank == len(FAMILIES):
        # Of two kinds of highlight the likelier one, be it the one with fewer unknowns or not.
        likelier = min(adequate, key=lambda trial: trial.expected).model
        chosen = simplest([trial for trial in adequate if trial.model == likelier])
        rivals = {trial.model for trial in adequate} - {likelier}
    count = max(count, 1.0)
    candidates = tuple(
        Candidate(
            model=trial.model,
            ambient=bool(trial.free[0].any()),
            highlight="" if not trial.free[2].any() else "grey" if trial.grey else "coloured",
            unknowns=trial.unknowns,
            rms=float(np.sqrt(trial.squares / count)),
            held_out=float(np.sqrt((trial.squares + 2 * trial.effective * np.mean(variance)) / count)),
            excess=float(trial.expected - best.expected),
            excess_error=float(margin),
            bic=float(criterion - min(bic)),
            chosen=trial is chosen,
        )
        for trial, margin, criterion in zip(trials, error, bic, strict=True)
    )
    return Choice(candidates, chosen.model, chosen.free, chosen.grey, tuple(sorted(rivals)), _dropped(chosen, trials))


def _dropped(chosen: _Trial, trials: list[_Trial]) -> Float[np.ndarray, " U"]:
    """By how much the likeliest term that was left out may have moved what stays."""
    fuller = [
        trial
        for trial in trials
        if trial.effective > chosen.effective and np.all(trial.free >= chosen.free) and trial.grey >= chosen.grey
    ]
    if not fuller:
        return np.zeros_like(chosen.solution)
    other = min(fuller, key=lambda trial: trial.expected)
    step = np.where(chosen.solution > 0, other.solution - chosen.solution, 0.0)
    return may_be_off(step, chosen.cost - other.cost, other.unknowns - chosen.unknowns)


def may_be_off(step: Float[np.ndarray, " U"], gain: float, unknowns: int) -> Float[np.ndarray, " U"]:
    """By how much a term of so many unknowns that was left out may have moved what stays.

    Its estimate moves it by the step, with an error of its own, and lowers the cost by the gain in noise variances; it
    is there as probably as Akaike's criterion says, by which nothing has to stand out (Buckland, Burnham and Augustin,
    Biometrics 53 (1997) 603: the variance of an average over models).
    """
    gain = max(gain, 1.0)
    odds = np.exp(np.clip(0.5 * gain - unknowns, -50.0, 50.0))
    return step * np.sqrt(odds / (1 + odds) * (1 + 1 / gain))


def _distance(one: _Trial, other: _Trial, normals: Mapping[str, NormalEquations]) -> float:
    """Squared distance of two candidates' pictures, in noise variances.

    Two models with different highlights share no Gram matrix; there the difference of their costs stands in, which is
    the same where one model holds the other.
    """
    specular = {trial.model for trial in (one, other) if trial.model not in FAMILIES}
    if len(specular) > 1:
        return abs(one.cost - other.cost)
    gram = normals[specular.pop() if specular else next(iter(normals))].gram
    step = one.solution - other.solution
    return max(float(step @ gram @ step), 0.0)
