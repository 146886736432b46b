"""What came out of a fit, how sure it is, and how it is told."""

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

import brdf
from fitting.separable import Optimum

NOT_DETERMINED = "not determined"


@dataclass(frozen=True)
class Parameter:
    """One number of the material.

    Attributes:
        name: "k_a", "k_d", "k_s" or "n".
        channel: of the picture; None for n.
        value: None where the picture does not determine it.
        error: standard error; where `at_bound`, that which the value would have without the bound.
        at_bound: the value is 0 because it may not be negative.
        reason: why it is not determined.
    """

    name: str
    channel: int | None
    value: float | None
    error: float | None
    at_bound: bool = False
    reason: str = ""

    def __str__(self) -> str:
        """Value ± error (relative), or why there is none."""
        if self.value is None:
            return f"{NOT_DETERMINED}: {self.reason}"
        if self.at_bound:
            return f"0 (at its bound; below {1.645 * self.error:.2g} with 95 %)"
        if not self.error:
            return f"{self.value:.6g}"
        return f"{_rounded(self.value, self.error)} ± {self.error:.2g} ({self.error / self.value:.2g})"


def _rounded(value: float, error: float) -> str:
    """The value to two digits of its error, at most twelve."""
    if value == 0 or not math.isfinite(error):
        return f"{value:.6g}"
    digits = math.floor(math.log10(abs(value))) - math.floor(math.log10(error)) + 2
    return f"{value:.{min(max(digits, 2), 12)}g}"


@dataclass(frozen=True)
class Candidate:
    """A model that was tried.

    Attributes:
        model: its name.
        unknowns: how many numbers it has.
        rms: root mean square of its residual, in the unit of the picture.
        bic: Bayesian information criterion, up to a constant of the picture; the smallest is the best.
        chosen: whether the fit chose it.
    """

    model: str
    unknowns: int
    rms: float
    bic: float
    chosen: bool


@dataclass(frozen=True)
class FitResult:
    """The outcome of a fit.

    Attributes:
        material: the fitted material; what is not determined is 0 in it, which changes no picture.
        parameters: value and error of each number, or why it has none.
        noise: standard deviation of the residual, (C,).
        residual: root mean square of the residual over that of the picture.
        pixels: how many pixels counted.
        left_out: how many did not, by reason.
        warnings: what a user should know before using the numbers.
        candidates: the models that were compared; one where the user named it.
        optimum: the engine's own result, in its units.
        precision: "float32" or "float64".
        seconds: how long the fit took.
        targets: the pictures, (H, W, C) each.
        scenes: their scenes.
        counted: which pixels counted, (H, W) each.
    """

    material: brdf.Material
    parameters: tuple[Parameter, ...]
    noise: Float[np.ndarray, " C"]
    residual: float
    pixels: int
    left_out: dict[str, int]
    warnings: tuple[str, ...]
    candidates: tuple[Candidate, ...]
    optimum: Optimum
    precision: str
    seconds: float
    targets: Sequence[np.ndarray] = field(repr=False)
    scenes: Sequence[brdf.Scene] = field(repr=False)
    counted: Sequence[np.ndarray] = field(repr=False)

    @property
    def undetermined(self) -> dict[str, str]:
        """What the picture does not determine, and why: "n", or "k_s[2]" for one channel."""
        return {_key(parameter): parameter.reason for parameter in self.parameters if parameter.value is None}

    def fitted(self, picture: int = 0) -> Float[np.ndarray, "H W C"]:
        """The picture that the fitted material makes.

        Args:
            picture: which of the scenes.
        """
        return np.asarray(brdf.render(self.material, self.scenes[picture], precision=self.precision))

    def __str__(self) -> str:
        """The report."""
        return report(self)

    def to_dict(self) -> dict[str, Any]:
        """The report as JSON holds it: what is not determined is None."""
        return {
            "material": brdf.material_to_dict(self.material, undetermined=self.undetermined),
            "parameters": [
                {
                    "name": parameter.name,
                    "channel": parameter.channel,
                    "value": parameter.value,
                    "error": parameter.error,
                    "at_bound": parameter.at_bound,
                    "reason": parameter.reason or None,
                }
                for parameter in self.parameters
            ],
            "residual": self.residual,
            "noise": self.noise.tolist(),
            "pixels": self.pixels,
            "left_out": self.left_out,
            "warnings": list(self.warnings),
            "candidates": [vars(candidate) for candidate in self.candidates],
            "precision": self.precision,
            "seconds": self.seconds,
        }

    def save(self, folder: str | Path, *, plot: bool = False) -> None:
        """Write material.json, material.mtl, fitted.exr and fit.json: all of them or none.

        Args:
            folder: made where missing. The MTL file is left out where the picture has neither 1 nor 3 channels.
            plot: also comparison.png.

        Raises:
            InputError: where the folder cannot be written.
        """
        with brdf.atomic_folder(folder) as stage:
            brdf.save_material(self.material, stage / "material.json", undetermined=self.undetermined)
            if self.material.k_d.shape[0] in (1, 3):
                brdf.save_material(self.material, stage / "material.mtl", undetermined=self.undetermined)
            brdf.write_image(stage / "fitted.exr", self.fitted())
            brdf.write_text(stage / "fit.json", json.dumps(self.to_dict(), indent=2) + "\n")
            if plot:
                figure = self.plot()
                figure.savefig(stage / "comparison.png", dpi=150)

    def plot(self, picture: int = 0) -> Any:
        """Target, fit and residual side by side.

        Args:
            picture: which of the pictures.

        Returns:
            A matplotlib figure.
        """
        from fitting.plots import comparison

        return comparison(self, picture)


def _key(parameter: Parameter) -> str:
    return parameter.name if parameter.channel is None else f"{parameter.name}[{parameter.channel}]"


def report(result: FitResult) -> str:
    """The text that a person reads.

    Args:
        result: of a fit.
    """
    channels = result.material.k_d.shape[0]
    count = f"{len(result.targets)} pictures, " if len(result.targets) > 1 else ""
    plural = "channel" if channels == 1 else "channels"
    lines = [
        f"{result.material.name} fitted to {count}{result.pixels} pixels x {channels} {plural} "
        f"in {result.seconds:.2g} s ({result.precision})"
    ]
    labels = ["red", "green", "blue"] if channels == 3 else [str(channel) for channel in range(channels)]
    for parameter in result.parameters:
        label = "" if parameter.channel is None or channels == 1 else labels[parameter.channel]
        lines.append(f"  {parameter.name:<4}{label:<6} {parameter}")
    lines.append(f"  residual    {100 * result.residual:.3g} % of the picture (rms)")
    for reason, pixels in result.left_out.items():
        if pixels:
            lines.append(f"  left out    {pixels} pixels {reason}")
    if len(result.candidates) > 1:
        lines.append("  what the scene requires:")
        for candidate in result.candidates:
            chosen = "<- chosen" if candidate.chosen else ""
            lines.append(
                f"    {candidate.model:<24}{candidate.unknowns:>3} unknowns   rms {candidate.rms:.3e}   "
                f"BIC {candidate.bic:>12.1f}   {chosen}".rstrip()
            )
    lines += [f"  warning: {warning}" for warning in result.warnings]
    return "\n".join(lines)
