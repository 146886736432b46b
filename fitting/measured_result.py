"""What came out of fitting a measured BRDF, and how it is told."""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

import brdf
from brdf.files import atomic_folder
from brdf.materials.material_file import material_to_dict
from fitting.report.saving import write_report
from fitting.result import Parameter, undetermined

# A model that explains this share of the squares describes the peak, one that places this share of the light the body;
# where the mean of both is below, it does not describe the table.
HALF = 0.5
# Shares below this are rounding.
_ROUNDING = 1e-6


def _percent(share: float) -> str:
    if share < _ROUNDING:
        return f"{100 * _ROUNDING:g} %" if share > 0 else "0 %"
    return f"{100 * share:.{2 if share < 0.995 else 3}g} %"


def lowest_cosine(max_angle: float) -> float:
    """The cosine above which directions count.

    Args:
        max_angle: from the normal, in degrees; a table's angles carry rounding: one at the limit counts.
    """
    return float(np.cos(np.radians(max_angle + 1e-4))) if max_angle < 90 else 0.0


@dataclass(frozen=True)
class Losses:
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


@dataclass(frozen=True)
class BrdfCandidate:
    """A model that was tried.

    Attributes:
        model: its name.
        unknowns: how many of its numbers are not 0.
        loss: its deviation under the loss that was fitted.
        losses: its deviation under every loss.
        material: its best material.
    """

    model: str
    unknowns: int
    loss: float
    losses: Losses
    material: brdf.Material


@dataclass(frozen=True)
class BrdfFitResult:
    """The outcome of `fit_brdf`.

    Attributes:
        table: what was fitted.
        material: the fitted material.
        loss: which loss was least.
        parameters: value and error of each number, or why it has none; errors hold where the deviation is noise.
        losses: the deviation under each loss.
        candidates: all models tried.
        chosen: which of them.
        samples: how many samples counted.
        negative: how many of their values are below 0.
        left_out: how many entries did not count, by reason.
        max_angle: light and view further than this from the normal did not count, in degrees.
        seconds: how long it took.
    """

    table: brdf.MeasuredBRDF
    material: brdf.Material
    loss: str
    parameters: tuple[Parameter, ...]
    losses: Losses
    candidates: tuple[BrdfCandidate, ...]
    chosen: int
    samples: int
    negative: int
    left_out: dict[str, int]
    max_angle: float
    seconds: float

    @property
    def fits(self) -> bool:
        """Whether, on average of both, half of the squares are explained and half of the light is where it belongs."""
        return 0.5 * (self._explained + self._placed) >= HALF

    @property
    def _explained(self) -> float:
        return 1 - self.losses.cosine**2

    @property
    def _placed(self) -> float:
        return 1 - self.losses.misplaced

    @property
    def verdict(self) -> str:
        """The sentence that a person needs."""
        several = len(self.candidates) > 1
        within = f"{_percent(self.losses.cosine)} (rms; {_percent(self.losses.misplaced)} of the light goes elsewhere)"
        name = self.material.name
        if not self.fits:
            best = min(self.candidates, key=lambda candidate: candidate.loss)
            subject = "none of these models fits" if several else f"{name} does not fit"
            closest = f"the best, {best.model}," if several else "it"
            left = f"{_percent(best.losses.cosine)} of the table (rms)"
            return f"{subject}: {closest} leaves {left}; the brightest sample is {self._brightest()}"
        name = "Lambert" if name == "lambert" else name
        alone = next((one for one in self.candidates if one.model == "lambert"), None)
        rest = ""
        if several and name == "Lambert":
            lobe = min(self.candidates[1:], key=lambda candidate: candidate.loss)
            if self.losses.cosine > _ROUNDING:
                explained = 1 - (lobe.loss / self.candidates[0].loss) ** 2
                what = f"the best lobe, {lobe.model}, explains {_percent(explained)} of the squares that Lambert leaves"
                rest = f"; {what}" if explained > _ROUNDING else "; no lobe comes closer"
        elif several and alone is not None:
            rest = f"; Lambert alone within {_percent(alone.losses.cosine)}"
        if self._explained < HALF:
            placed = f"puts {_percent(self._placed)} of the light where it belongs"
            return f"{name} {placed}, but not the peak, and leaves {_percent(self.losses.cosine)} (rms){rest}"
        if self._placed < HALF:
            elsewhere = f"{_percent(self.losses.misplaced)} of the light goes elsewhere"
            return f"{name} comes within {_percent(self.losses.cosine)} (rms), but {elsewhere}{rest}"
        is_enough = several and name == "Lambert"
        return f"{name} {'is enough' if is_enough else 'describes it'} within {within}{rest}"

    def _brightest(self) -> str:
        near = np.minimum(self.table.to_light[:, 2], self.table.to_view[:, 2]) > lowest_cosine(self.max_angle)
        index = int(np.argmax(np.where(near, self.table.values.sum(axis=1), -np.inf)))
        light, view = self.table.to_light[index], self.table.to_view[index]

        def apart(a: Any, b: Any) -> float:
            return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b)))

        retro, mirror = apart(light, view), apart(light * [-1, -1, 1], view)
        polar = float(np.degrees(np.arctan2(np.hypot(light[0], light[1]), light[2])))
        if retro < mirror:
            return f"{retro:.2g}° from the direction back to the light, which stands at {polar:.3g}°"
        return f"{mirror:.2g}° from the mirror direction of the light, which stands at {polar:.3g}°"

    def __str__(self) -> str:
        """The report."""
        channels = len(self.table.channels)
        lines = [
            f"{self.material.name} fitted to {self.table.name}: {self.samples} samples x {channels} "
            f"{'channel' if channels == 1 else 'channels'}, {self.loss} loss, in {self.seconds:.2g} s"
        ]
        for parameter in self.parameters:
            label = "" if parameter.channel is None or channels == 1 else self.table.channels[parameter.channel]
            lines.append(f"  {parameter.name:<4}{label:<8} {parameter}")
        if self.negative:
            lines.append(f"  {self.negative} values are below 0; squared losses count them, the logarithm does not")
        lines += [f"  left out    {count} {reason}" for reason, count in self.left_out.items()]
        lines.append(f"  {'deviation of':<24}{'cosine':>10}{'squared':>10}{'log':>10}{'misplaced':>11}")
        for index, candidate in enumerate(self.candidates):
            mark = "   <- chosen" if index == self.chosen and len(self.candidates) > 1 else ""
            at = candidate.losses
            numbers = f"{100 * at.cosine:>8.2f} %{100 * at.squared:>8.2f} %{at.log:>10.4f}{100 * at.misplaced:>9.2f} %"
            lines.append(f"    {candidate.model:<22}{numbers}{mark}")
        lines.append(f"  {self.verdict}.")
        return "\n".join(lines)

    def to_dict(self) -> dict[str, Any]:
        """The report as JSON holds it."""
        return {
            "table": self.table.name,
            "channels": list(self.table.channels),
            "material": material_to_dict(self.material, undetermined=self.undetermined),
            "loss": self.loss,
            "parameters": [asdict(parameter) for parameter in self.parameters],
            "losses": asdict(self.losses),
            "candidates": [
                {
                    "model": candidate.model,
                    "unknowns": candidate.unknowns,
                    "losses": asdict(candidate.losses),
                    "material": material_to_dict(candidate.material),
                    "chosen": index == self.chosen,
                }
                for index, candidate in enumerate(self.candidates)
            ],
            "samples": self.samples,
            "negative": self.negative,
            "left_out": self.left_out,
            "fits": self.fits,
            "verdict": self.verdict,
            "seconds": self.seconds,
        }

    @property
    def undetermined(self) -> dict[str, str]:
        """What the table does not determine, and why."""
        return undetermined(self.parameters)

    def save(self, folder: str | Path) -> None:
        """Write material.json, material.mtl (1 or 3 channels) and fit.json: all of them or none.

        Args:
            folder: made where missing.

        Raises:
            InputError: where the folder cannot be written.
        """
        with atomic_folder(folder) as stage:
            write_report(stage, self)
