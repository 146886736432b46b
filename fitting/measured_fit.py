"""Fit a model to a measured BRDF: the table is the picture, each sample a pixel with its own directions.

f_r = [k_d + k_s S / (N.L)] / pi is linear in k_d and k_s, so the solver that fits pictures fits tables. What differs is
which deviations count, by one of three losses of the literature:

| loss | sum over samples of weight times | when |
| --- | --- | --- |
| "cosine" (default) | [(f - m) cos θ_i]² | Ngan et al. 2005: what pictures under one light show; the peak rules |
| "squared" | (f - m)² | as the table stands; grazing angles count in full |
| "log" | [log(1 + f cos θ_i) - log(1 + m cos θ_i)]² | Löw et al. 2012: high dynamic range, the tails count too |

The weight is the solid angle that a sample stands for, where the table's grid says it. Negative values count as they
are, where the logarithm has a value. Angles beyond 80 degrees are left out by default.
"""

import dataclasses
import time
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

import jax
import jax.numpy as jnp
import numpy as np

import brdf
from brdf.checks import number
from brdf.errors import InputError
from brdf.files import atomic_folder
from brdf.lobes import Lobe
from brdf.materials.material_file import material_to_dict
from brdf.models.base import SpecularMaterial
from fitting.joint_problem import degrees_between
from fitting.model_fit import N_RANGE, ModelFit
from fitting.problem import check_choice, model_name
from fitting.progress import waiting
from fitting.report.saving import outdated, write_report
from fitting.result import Parameter, Parameters
from fitting.solver.losses import weights
from fitting.solver.normal_equations import Picture
from fitting.solver.profile import search
from fitting.uncertainty.covariance import PixelErrors, residual_noise, uncertainty
from fitting.uncertainty.interpretation import material_and_parameters
from fitting.uncertainty.intervals import exponent_interval
from fitting.uncertainty.noise_model import sums_at

Loss = Literal["cosine", "squared", "log"]

# A lobe is worth its unknowns where it explains this share of the squares that Lambert leaves, or of the table's.
WORTH, WORTH_OF_TABLE = 0.5, 0.02
# By this much of twice the log-likelihood the best of all lobes gains on noise: one sample that stands out is enough.
BY_CHANCE = 20.0
# A sample that the fit follows altogether, and columns that depend on each other but for rounding.
_MOST_LEVERAGE, _DEPENDENT = 0.99, 1e-10
# A model that explains this share of the squares describes the peak, one that places this share of the light the body;
# where the mean of both is below, it does not describe the table.
HALF = 0.5
# What Lambert leaves of a table that it describes exactly; a lobe has nothing to explain then.
EXACT = 1e-12
# The search for the exponent stops at this share of a value: a diffuse coefficient below it, of the brightest, is 0.
SEARCH = 1e-9
# Shares below this are told as rounding.
ROUNDING = 1e-6
# Largest value in 1/sr, and inverse of the least that a table may have as its largest: squares and sums stay in range.
FAR = 1e50
# Of a cosine's logarithm: below the one the lobe does not reach the sample (see `brdf.vectors`), the other is as good
# as none and stays finite times n.
_DARK, _LEAST = -1e8, -1e4
# Reweighting ends when the loss changes by less than this share; it takes 2 to 10 rounds.
_ENOUGH, _MOST_ROUNDS = 1e-9, 50


class Losses(NamedTuple):
    """How far a model is from a table.

    Attributes:
        cosine: root mean square of the deviation times N.L, over that of the table.
        squared: the same without the cosine.
        log: root mean square of the difference of log(1 + f_r N.L).
        misplaced: the share of light that goes elsewhere: absolute deviations times N.L, summed, over f_r's.
    """

    cosine: float
    squared: float
    log: float
    misplaced: float


@dataclasses.dataclass(frozen=True)
class BrdfCandidate:
    """A model that was tried.

    Attributes:
        material: its best material.
        parameters: value and error of each number, or why it has none; errors by what is left of samples.
        losses: its deviation under every loss.
    """

    material: brdf.Material
    parameters: tuple[Parameter, ...]
    losses: Losses

    @property
    def model(self) -> str:
        """The model's name."""
        return self.material.name


@dataclasses.dataclass(frozen=True, eq=False)
class BrdfFitResult(Parameters):
    """The outcome of `fit_brdf`.

    Attributes:
        table: what was fitted.
        loss: which loss was least.
        candidates: all models tried.
        chosen: which of them.
        samples: how many samples counted.
        negative: how many of their values are below 0.
        left_out: how many entries did not count, by reason.
        max_angle: light and view further than this from the normal did not count, in degrees.
        seconds: how long it took.

    Example:
        >>> result = fitting.fit_brdf(brdf.load_measured("paint.txt"), model="lambert")
        >>> result.samples, result.fits
        (25, True)
    """

    table: brdf.MeasuredBRDF
    loss: Loss
    candidates: tuple[BrdfCandidate, ...]
    chosen: int
    samples: int
    negative: int
    left_out: dict[str, int]
    max_angle: float
    seconds: float

    @property
    def material(self) -> brdf.Material:
        """The fitted material."""
        return self.candidates[self.chosen].material

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Value and error of each of its numbers, or why it has none; errors by what is left of samples."""
        return self.candidates[self.chosen].parameters

    @property
    def losses(self) -> Losses:
        """Its deviation under each loss."""
        return self.candidates[self.chosen].losses

    @property
    def fits(self) -> bool:
        """Whether, on average of both, half of the squares are explained and half of the light is where it belongs."""
        return 0.5 * (1 - self.losses.cosine**2 + 1 - self.losses.misplaced) >= HALF

    @property
    def warnings(self) -> tuple[str, ...]:
        """What a user should know before using the numbers."""
        return () if self.fits else (self.verdict,)

    @property
    def verdict(self) -> str:
        """The sentence that a person needs."""
        losses = self.losses
        name = "Lambert" if self.material.name == "lambert" else self.material.name
        if not self.fits:
            best = min(self.candidates, key=self._loss)
            closest = f"{name} does not fit: it"
            if len(self.candidates) > 1:
                closest = f"none of these models fits: the best, {best.model},"
            left = f"{_percent(best.losses.cosine)} of the table (rms of f_r cos θ)"
            return f"{closest} leaves {left}; the brightest sample is {self._brightest()}"
        left, elsewhere = _percent(losses.cosine), f"{_percent(losses.misplaced)} of the light goes elsewhere"
        if losses.cosine**2 > HALF:
            placed = f"puts {_percent(1 - losses.misplaced)} of the light where it belongs, but not the peak"
            words = f"{placed}, and leaves {left} of the table (rms of f_r cos θ)"
        elif losses.misplaced > HALF:
            words = f"fits the peak, its f_r cos θ is off by {left} (rms), but {elsewhere}"
        else:
            words = f"is off by {left} of f_r cos θ (rms), and {elsewhere}"
        return f"{name} {words}{self._beside_lambert()}"

    def _loss(self, candidate):
        return getattr(candidate.losses, self.loss)

    def _beside_lambert(self):
        """What of the verdict compares lobes with Lambert, the first candidate."""
        alone, *lobes = self.candidates
        if not lobes or (not self.chosen and alone.losses.cosine <= ROUNDING):
            return ""
        if self.chosen:
            return f"; Lambert alone is off by {_percent(alone.losses.cosine)}"
        lobe = min(lobes, key=self._loss)
        explained = 1 - (self._loss(lobe) / self._loss(alone)) ** 2
        if explained <= ROUNDING:
            return "; no lobe comes closer"
        return f"; the best lobe, {lobe.model}, explains {_percent(explained)} of the squares that Lambert leaves"

    def _brightest(self):
        table, counted = self.table, _within(self.table, self.max_angle)
        index = np.argmax(np.where(counted, table.values.sum(axis=1), -np.inf))
        light, view = table.to_light[index], table.to_view[index]
        ways = {"direction back to the light": light, "mirror direction of the light": light * [-1, -1, 1]}
        name = min(ways, key=lambda way: degrees_between(ways[way], view))
        height = degrees_between(light, _NORMAL)
        return f"{degrees_between(ways[name], view):.2g}° from the {name}, which stands at {height:.3g}°"

    def __str__(self) -> str:
        """The report."""
        channels = self.table.channels
        plural = "channel" if len(channels) == 1 else "channels"
        lines = [
            f"{self.material.name} fitted to {self.table.name}: {self.samples} samples x {len(channels)} {plural}, "
            f"{self.loss} loss, in {self.seconds:.2g} s"
        ]
        for parameter in self.parameters:
            label = "" if parameter.channel is None or len(channels) == 1 else channels[parameter.channel]
            lines.append(f"  {parameter.name:<4}{label:<8} {parameter}")
        if self.negative:
            why = f", {self.table.below_zero}" if self.table.below_zero else ""
            lines.append(f"  {self.negative} values are below 0{why}; they count as they are")
        lines += [f"  left out    {count} {reason}" for reason, count in self.left_out.items()]
        lines.append(f"  {'deviation of':<24}{'cosine':>10}{'squared':>10}{'log':>10}{'misplaced':>11}")
        for index, candidate in enumerate(self.candidates):
            mark = "   <- chosen" if index == self.chosen and len(self.candidates) > 1 else ""
            cosine, squared, log, misplaced = candidate.losses
            numbers = f"{100 * cosine:>8.2f} %{100 * squared:>8.2f} %{log:>10.4f}{100 * misplaced:>9.2f} %"
            lines.append(f"    {candidate.model:<22}{numbers}{mark}")
        lines.append("    (cosine: of f_r cos θ; misplaced: the share of the light that goes elsewhere)")
        return "\n".join([*lines, f"  {self.verdict}."])

    def to_dict(self) -> dict[str, Any]:
        """The report as JSON holds it."""
        names = ("loss", "samples", "negative", "left_out", "fits", "verdict", "warnings", "seconds")
        return {name: getattr(self, name) for name in names} | {
            "table": self.table.name,
            "channels": list(self.table.channels),
            "material": material_to_dict(self.material, undetermined=self.undetermined),
            "parameters": [parameter.to_dict() for parameter in self.parameters],
            "losses": self.losses._asdict(),
            "candidates": [
                {
                    "model": candidate.model,
                    "losses": candidate.losses._asdict(),
                    "material": material_to_dict(candidate.material),
                    "chosen": index == self.chosen,
                }
                for index, candidate in enumerate(self.candidates)
            ],
        }

    def plot(self) -> Any:
        """The table and the fit over the angle of the half vector, as papers show measured BRDFs.

        Returns:
            A matplotlib figure.
        """
        from fitting.report.material_plots import plot_table  # Matplotlib takes long to load

        return plot_table(self.table, self.material, _within(self.table, self.max_angle))

    def save(self, folder: str | Path, *, plot: bool = False) -> None:
        """Write material.json, material.mtl (1 or 3 channels) and fit.json: all of them or none.

        Args:
            folder: made where missing.
            plot: also comparison.png.

        Raises:
            InputError: where the folder cannot be written.
        """
        with atomic_folder(folder, outdated(folder)) as stage:
            write_report(stage, self, plot)


_NORMAL = np.array([0.0, 0.0, 1.0])


def _percent(share):
    if share < ROUNDING:
        return f"{100 * ROUNDING:g} %" if share > 0 else "0 %"
    return f"{100 * share:.{2 if share < 0.995 else 3}g} %"


def _within(table, max_angle):
    """Which samples have light and view so near the normal; angles carry rounding: one at the limit counts."""
    return np.minimum(table.to_light[:, 2], table.to_view[:, 2]) > np.cos(np.radians(max_angle + 1e-4))


def fit_brdf(
    table: brdf.MeasuredBRDF,
    model: str | type[brdf.Material] = "auto",
    *,
    loss: Loss = "cosine",
    max_angle: float = 80.0,
    n_range: tuple[float, float] = N_RANGE,
) -> BrdfFitResult:
    """Fit a model to a measured BRDF: the global optimum, with no start to give.

    Args:
        table: what `brdf.load_measured` reads.
        model: the name of a model, or "auto": Lambert, unless a lobe explains half of the squares that it leaves, or
            2 % of the table's; then the form with the least loss.
        loss: "cosine", "squared" or "log"; see `fitting.measured_fit`.
        max_angle: light and view further than this from the normal are left out, in degrees, above 0 to 90.
        n_range: bounds of the exponent, 0 < lower < upper.

    Returns:
        The material with its errors, its deviation under every loss, and a verdict in a sentence.

    Raises:
        InputError: naming the argument.

    Example:
        >>> table = brdf.load_measured("paint.txt")
        >>> fitting.fit_brdf(table, model="lambert").material.k_d.round(3)
        array([0.5])

    Source: A. Ngan, F. Durand and W. Matusik, "Experimental analysis of BRDF models", EGSR 2005; J. Löw, J. Kronander,
    A. Ynnerman and J. Unger, "BRDF models for accurate and efficient rendering of glossy surfaces", TOG 31 (2012) 9.
    """
    start = time.perf_counter()
    if not isinstance(table, brdf.MeasuredBRDF):
        raise InputError("table", f"must be a brdf.MeasuredBRDF, got {type(table).__name__}", "Use brdf.load_measured")
    model = model_name(model)
    check_choice(loss, get_args(Loss), n_range)
    max_angle = float(number("max_angle", max_angle, above=0.0, high=90.0))
    samples = _samples(table, max_angle)
    (count, channels), negative = samples.values.shape, samples.negative
    left_out = table.left_out | {f"further than {max_angle:g}° from the normal": len(table.values) - count}
    if loss == "log":
        left_out |= {"values out of reach of the logarithm": np.count_nonzero(~_in_reach(samples))}
    left_out = {reason: int(number) for reason, number in left_out.items() if number}
    kinds = brdf.MODELS.values() if model == "auto" else [brdf.MODELS[model]]
    kinds = [
        kind for kind in kinds if count * channels > channels + issubclass(kind, SpecularMaterial) * (channels + 1)
    ]
    if not kinds:
        what = f"has {count} samples that count, no more than there are numbers to find"
        raise InputError(table.name, what, "Give a table with more samples, or a model with fewer numbers")
    with waiting(f"fitting {table.name}"):
        candidates = tuple(_fit_model(kind, samples, loss, n_range) for kind in kinds)
    chosen, seconds = _choose(candidates, loss, count), time.perf_counter() - start
    return BrdfFitResult(table, loss, candidates, chosen, count, negative, left_out, max_angle, seconds)


def _samples(table, max_angle):
    """The samples that count, their solid angles of mean 1."""
    near = _within(table, max_angle) & (table.solid_angle > 0)
    values, share = table.values[near], table.solid_angle[near]
    largest = np.max(np.abs(values), initial=0.0)
    within = f"within {max_angle:g}° of the normal"
    for fails, what, remedy in (
        (not values.size, f"has no sample {within}", "Raise max_angle"),
        (not largest, "is black", "Give a table with values"),
        (not np.any(values > 0), f"has no value above 0 {within}", "Check its sign"),
        (not 1 / FAR <= largest <= FAR, f"holds values of up to {largest:.3g}/sr, as no BRDF does", "Check its unit"),
    ):
        if fails:
            raise InputError(table.name, what, remedy)
    directions = {"to_light": table.to_light[near], "to_view": table.to_view[near]}
    return dataclasses.replace(table, **directions, values=values, solid_angle=share / np.mean(share))


def _fit_model(model, samples, loss, n_range):
    values, cosine, share = samples.values, samples.to_light[:, 2:], samples.solid_angle[:, None]
    channels, specular = values.shape[1], issubclass(model, SpecularMaterial)
    log_cos, reach = _lobe(model, samples) if specular else (0.0 * cosine, 0.0 * cosine)
    free = np.repeat([[False], [True], [specular]], channels, axis=1)
    brightest, value = np.pi * np.max(np.abs(values), axis=0), values * cosine

    def solve(modelled):
        """The least weighted squares; a diffuse coefficient that the search cannot tell from 0 is 0.

        The logarithm's are had by reweighting, as that of pictures, of values 1 + f cos. The first weights are those of
        a perfect model, which sees the tails that the peak would drown.
        """
        if loss == "log":
            weight = cosine**2 * weights("log", 1 + value, 1 + modelled, share * _in_reach(samples), np.zeros(1))
        else:
            weight = (share if loss == "squared" else share * cosine**2)[:, 0]
        with jax.enable_x64(True):
            lobe = Lobe.of_terms(((jnp.asarray(reach)[:, None], jnp.asarray(log_cos)),))
            ones, target = jnp.ones((len(values), 1)), jnp.asarray(np.pi * values)
            picture = Picture(target, ones, lobe, jnp.asarray(weight), ambient=jnp.zeros(1))
        optimum = search([picture], free, n_range)
        x = np.where(optimum.x > [[0], [SEARCH], [0]] * brightest, optimum.x, 0.0)
        highlight = x[2] * reach * np.exp(optimum.n * log_cos)
        return picture, dataclasses.replace(optimum, x=x), highlight, (x[1] + highlight) / np.pi

    picture, optimum, highlight, f_r = solve(np.maximum(value, 0.0))
    least = _losses(samples, f_r)
    for _ in range(_MOST_ROUNDS if loss == "log" else 0):
        closer = solve(f_r * cosine)
        losses = _losses(samples, closer[-1])
        if losses.log >= least.log * (1 - _ENOUGH):
            break
        (picture, optimum, highlight, f_r), least = closer, losses
    rounding, weight = brightest * np.finfo(float).eps, np.asarray(picture.weights)
    noise, left = residual_noise(optimum, rounding), np.pi * (values - f_r) * weight**0.5
    # Instruments err by a share of the value, and alike in all channels: what is left of each sample says so (White
    # 1980), not below rounding, as much larger as the fit has drawn it to itself (MacKinnon and White 1985).
    left = left / (1 - _leverage(log_cos, reach * np.exp(optimum.n * log_cos), weight))
    spread = sums_at([picture], optimum, [weight * np.maximum(left**2, rounding**2)]).gram
    left = left / np.maximum(np.linalg.norm(left, axis=0), 1 / FAR)
    visible = float(np.max(highlight) / np.max(brightest))
    fit = ModelFit(model, [], optimum, free, n_range)
    # A lobe that hardly reaches a sample needs a k_s whose square is out of range; it is found to be undetermined.
    with np.errstate(over="ignore", invalid="ignore"):
        pixels = PixelErrors(noise, spread, channels=left.T @ left)
        errors = uncertainty(fit, pixels, free, brightest, visible)
    interval = None
    if specular and not errors.n_reason:
        interval, _ = exponent_interval(fit, errors.n_error, errors.reach, errors.delta_cost, 0.0, parabolic=True)
        errors = errors._replace(n_reason=fit.held(n_range))
    material, parameters = material_and_parameters(fit, errors, np.ones(channels), interval)
    lobe, reasons = parameters[2 * channels :], {one.reason for one in parameters[2 * channels :]}
    if specular and len(reasons) == 1 and all(one.value is None for one in lobe):
        # Or k_d would be the one that goes with a highlight which the material does not have.
        matt = _fit_model(brdf.Lambert, samples, loss, n_range)
        material = dataclasses.replace(material, k_d=matt.material.k_d)
        return BrdfCandidate(material, (*matt.parameters, *lobe), matt.losses)
    return BrdfCandidate(material, tuple(one for one in parameters if one.name != "k_a"), least)


def _leverage(log_cos, lobe, weight):
    """How far a fit follows each sample, (P, 1): by the diffuse term, the lobe and the exponent, of all channels."""
    columns = np.concatenate([np.ones_like(lobe), lobe, lobe * log_cos], axis=1)
    columns = columns * np.mean(weight, axis=1, keepdims=True) ** 0.5
    columns = columns / np.maximum(np.linalg.norm(columns, axis=0), 1 / FAR)
    found, triangle = np.linalg.qr(columns)
    independent = np.abs(np.diag(triangle)) > _DEPENDENT
    return np.minimum(np.sum(found[:, : independent.size] ** 2 * independent, axis=1, keepdims=True), _MOST_LEVERAGE)


def _lobe(model, samples):
    """Logarithm of the lobe's cosine, and what multiplies the lobe: S / (N.L) without scale, (P, 1) each."""
    with jax.enable_x64(True):
        directions = (jnp.asarray(vectors) for vectors in (_NORMAL, samples.to_light, samples.to_view))
        log_cos = np.asarray(model.log_cosine(*directions))[:, None]
    reach = 1.0 if model.cosine_weighted else 1.0 / samples.to_light[:, 2:]
    return np.maximum(log_cos, _LEAST), np.where(log_cos > _DARK, reach, 0.0)


def _in_reach(samples):
    """Of which values the logarithmic loss is one: of 1 + f cos θ above 0."""
    return samples.values * samples.to_light[:, 2:] > -1


def _losses(samples, model):
    values, cosine, share = samples.values, samples.to_light[:, 2:], samples.solid_angle[:, None]
    counted = share * _in_reach(samples)
    logarithms = np.log1p(np.where(counted > 0, values * cosine, 0.0)) - np.log1p(model * cosine)

    def relative(weight, power=2):
        return float(np.sum(weight * np.abs(values - model) ** power) / np.sum(weight * np.abs(values) ** power))

    return Losses(
        cosine=relative(share * cosine**2) ** 0.5,
        squared=relative(share) ** 0.5,
        log=float(np.sum(counted * logarithms**2) / np.sum(counted)) ** 0.5,
        misplaced=relative(share * cosine, 1),
    )


def _choose(candidates, loss, count):
    """Lambert, which comes first, unless a lobe explains enough of the squares that it leaves, and more than chance."""
    losses = [getattr(candidate.losses, loss) for candidate in candidates]
    best, plain = int(np.argmin(losses)), candidates[0].losses
    worth = min(WORTH, WORTH_OF_TABLE / max(plain.squared if loss == "squared" else plain.cosine, EXACT) ** 2)
    worth = max(worth, 1 - np.exp(-BY_CHANCE / count))
    return best if losses[best] ** 2 + EXACT**2 <= (1 - worth) * losses[0] ** 2 else 0
