"""What came out of a fit, and how sure it is: plain data. `fitting.report` tells, draws and writes it."""

import contextlib
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

import brdf
from brdf.channels import channel_names
from brdf.errors import InputError
from brdf.materials.material_file import material_to_dict
from brdf.precision import Precision
from fitting.budget.choice import BudgetChoice
from fitting.selection import Candidate
from fitting.solver.profile import Optimum
from fitting.tile import drawn

NOT_DETERMINED = "not determined"
# Beyond this relative error an interval of n is told: it is no longer symmetric.
LOPSIDED = 0.01

REPORTS: dict[str, Callable[..., Any]] = {}
"""What makes text, pictures and a diagnosis of a result; `fitting.report`, which stands above, enters it here."""

# What warnings of a fit begin with that a plausible material held.
HELD_PLAUSIBLE = "k_d + k_s is held at 1"


@dataclass(frozen=True)
class Cause:
    """What may be wrong with a scene or a picture, and would explain what the fit leaves.

    Attributes:
        name: "light" (its direction, or as seen from the ball), "distance" (of a near light), "intensity", "ball" (its
            centre), "radius", "gamma", "black", "mirrored left-right" or "mirrored upside down", "model phong" or
            another than was fitted; a light of several with its index, of one picture with that. "light or ball" where
            the picture does not tell them apart.
        size: how far off; of the first cause, if it is one of the scene, with the material fitted beside, of others in
            the first order; a length where there are several directions.
        error: standard error of the size.
        unit: of both; "" for a mirrored picture and a model.
        share: of the structure in the residual that it would explain, from 0 to 1.
        remedy: what to do.

    Example:
        >>> scene = brdf.Scene.load("scene.toml")
        >>> target = brdf.render(brdf.preset("gold"), scene) ** 1.02
        >>> cause = fitting.fit(target, scene, model="blinn-phong").diagnosis[0]
        >>> cause.name, round(cause.size), cause.unit
        ('gamma', 2, '%')
    """

    name: str
    size: float
    error: float
    unit: str
    share: float
    remedy: str

    def __str__(self) -> str:
        """In a line."""
        off = f" off by {self.size:.3g} ± {self.error:.2g} {self.unit}" if self.unit else ""
        return f"{self.name}{off} would explain {100 * self.share:.0f} % of the structure: {self.remedy}"


@dataclass(frozen=True)
class Parameter:
    """One number of the material.

    Attributes:
        name: "k_a", "k_d", "k_s" or "n".
        channel: of the picture; None for n.
        value: None where the picture does not determine it.
        error: standard error; where `at_bound`, that which the value would have without the bound.
        interval: lower and upper end of the 95 % interval; one-sided at a bound, infinite where there is no end; for n
            from the profile likelihood, also where n is not determined but bounded on one side.
        at_bound: the value is 0 because it may not be negative, or because the picture does not require it.
        reason: why it is not determined.
        direction: where the number is a direction, the unit vector; the value then is by how many degrees it has turned
            from where it started, and the error that angle's.

    Example:
        >>> result = fitting.fit(brdf.read_image("target.exr"), brdf.Scene.load("scene.toml"), model="blinn-phong")
        >>> n = result.parameters[-1]
        >>> n.name, round(n.value, 2), n.interval[0] < n.value < n.interval[1]
        ('n', 51.2, True)
    """

    name: str
    channel: int | None
    value: float | None
    error: float | None
    interval: tuple[float, float] | None = None
    at_bound: bool = False
    reason: str = ""
    direction: tuple[float, ...] | None = None

    @property
    def key(self) -> str:
        """Its name, with the channel where it has one: "n", "k_s[2]"."""
        return self.name if self.channel is None else f"{self.name}[{self.channel}]"

    def place(self, channels: int) -> int:
        """Where it stands among k_a, k_d, k_s, channel after channel each, and n.

        Args:
            channels: how many there are.
        """
        return (
            3 * channels if self.channel is None else ("k_a", "k_d", "k_s").index(self.name) * channels + self.channel
        )

    def label(self, channels: int) -> str:
        """The channel in words: its colour, or of a position its axis.

        Args:
            channels: of the picture.
        """
        if self.channel is None:
            return ""
        is_spectrum = self.name.endswith(("k_a", "k_d", "k_s", "intensity", "radiance", "ambient"))
        return channel_names(channels)[self.channel] if is_spectrum else "xyz"[self.channel]

    def to_dict(self) -> dict[str, Any]:
        """As JSON holds it: infinite ends of the interval are None."""
        ends = None if self.interval is None else [end if math.isfinite(end) else None for end in self.interval]
        return vars(self) | {"interval": ends, "reason": self.reason or None}

    def __float__(self) -> float:
        """The value; NaN where it is not determined."""
        return math.nan if self.value is None else float(self.value)

    def __format__(self, spec: str) -> str:
        """The value by a format of numbers; without one as `str` has it."""
        return format(float(self), spec) if spec else str(self)

    def __str__(self) -> str:
        """Value ± error (relative), or why there is none."""
        if self.value is None:
            return f"{NOT_DETERMINED}: {self.reason}"
        if self.direction is not None:
            towards = ", ".join(f"{value:.5f}" for value in self.direction)
            return f"{towards} ± {self.error:.2g}° (turned by {self.value:.3g}°)"
        if self.at_bound:
            return "0 (at its bound" + (f"; below {self.interval[1]:.2g} with 95 %)" if self.interval else ")")
        if not self.error:
            return f"{self.value:.6g}"
        text = f"{_rounded(self.value, self.error)} ± {self.error:.2g}"
        text += f" ({_percent(abs(self.error / self.value))})" if self.value else ""
        if self.interval and self.channel is None and self.error > LOPSIDED * self.value:
            text += f", 95 %: {self.interval[0]:.4g} to {self.interval[1]:.4g}"
        return text


def _percent(share: float) -> str:
    return f"{100 * share:.2g} %" if share < 0.995 else f"{100 * share:.0f} %"


def _rounded(value: float, error: float) -> str:
    """The value to two digits of its error, at most twelve."""
    if value == 0 or not math.isfinite(error):
        return f"{value:.6g}"
    digits = math.floor(math.log10(abs(value))) - math.floor(math.log10(error)) + 2
    return f"{value:.{min(max(digits, 2), 12)}g}"


class Parameters:
    """The numbers of a result by their names, as every result has them.

    Attributes:
        parameters: value and error of each number.
    """

    parameters: Any

    def __getitem__(self, name: str) -> Any:
        """The `Parameter` "n" or "k_d[0]"; of "k_d" the tuple of them, one for each channel.

        Raises:
            InputError: where there is none of that name.
        """
        exact = [one for one in self.parameters if one.key == name]
        found = exact or tuple(one for one in self.parameters if one.name == name)
        if not found:
            known = ", ".join(dict.fromkeys(one.name for one in self.parameters))
            raise InputError("result", f"has no number {name!r}", f"It has {known}")
        return exact[0] if exact else found

    def __iter__(self) -> Iterator[str]:
        """The names of the numbers."""
        return iter(dict.fromkeys(one.name for one in self.parameters))

    @property
    def undetermined(self) -> dict[str, str]:
        """What is not determined, and why: "n", or "k_s[2]" for one channel."""
        return {one.key: one.reason for one in self.parameters if one.value is None}

    def to_dataframe(self) -> Any:
        """The numbers as a pandas table: a row for each, named as `Parameter.key` has it.

        Returns:
            A `pandas.DataFrame`: value, error, low and high (ends of the 95 % interval), at_bound, reason.

        Raises:
            InputError: where pandas is not installed.
        """
        try:
            from pandas import DataFrame  # late: an extra
        except ImportError:
            raise InputError(
                "to_dataframe", "needs pandas, which is not here", "Install it: pip install pandas"
            ) from None
        rows = [
            {
                "value": float(one),
                "error": math.nan if one.error is None else one.error,
                **dict(zip(("low", "high"), one.interval or (math.nan, math.nan), strict=True)),
                "at_bound": one.at_bound,
                "reason": one.reason,
            }
            for one in self.parameters
        ]
        return DataFrame(rows, index=[one.key for one in self.parameters])

    @property
    def free_parameters(self) -> tuple[Parameter, ...]:
        """Those that are determined and that no bound holds."""
        return tuple(one for one in self.parameters if one.value is not None and not one.at_bound)


@dataclass(frozen=True, repr=False, eq=False, kw_only=True)
class FitResult(Parameters):
    """The outcome of a fit.

    Attributes:
        material: the fitted material; what is not determined is 0 in it, which changes no picture, or stands for a
            sum that is, which its reason states.
        parameters: value and error of each number, or why it has none.
        noise: standard deviation of the residual, (C,); with weights, that of the weighted residual.
        structure: correlation of neighbouring residuals.
        highlight_pixels: how many pixels carry the highlight; None without one.
        residual: root mean square of the residual over that of the picture.
        pixels: how many pixels counted in every channel.
        left_out: how many did not, or not in every channel, by reason.
        warnings: what a user should know before using the numbers.
        candidates: the models that were compared, simplest first; empty where the user named it.
        correlation: of the parameters that are determined and not at a bound, in the order of `free_parameters`.
        optimum: the engine's own result, in its units; the global one, also where noise hides its highlight and the
            material and the residual are those without it.
        loss: "squared" or one of the others.
        precision: "float32" or "float64".
        seconds: how long the fit took.
        targets: the pictures, (H, W, C) each.
        scenes: their scenes.
        counted: which pixels counted, (H, W) each.
        weights: how much they did, (H, W) each, or (H, W, C) where a pixel's channels count differently; None
            where all alike; () where no picture says.
        files: path, encoding and factor of each picture; None where it came without a file.
        levels: the files on whose levels all values of a float picture lie, in words: these are fitted as codes.
        choice: what an accuracy or a time to spend made of the fit; None without one.

    Example:
        >>> result = fitting.fit(brdf.read_image("target.exr"), brdf.Scene.load("scene.toml"), model="blinn-phong")
        >>> result.surface, result.pixels, result.warnings
        ('blinn-phong', 656, ())
        >>> round(float(result["n"]), 2), result["k_d"][0].at_bound
        (51.2, False)
        >>> result.save("out")
    """

    material: brdf.Material
    parameters: tuple[Parameter, ...]
    noise: Float[np.ndarray, " C"]
    structure: float
    residual: float
    pixels: int
    left_out: dict[str, int]
    warnings: tuple[str, ...]
    correlation: Float[np.ndarray, "F F"]
    loss: str
    precision: Precision
    targets: Sequence[np.ndarray]
    scenes: Sequence[brdf.Scene]
    counted: Sequence[np.ndarray]
    weights: Sequence[np.ndarray | None] = ()
    highlight_pixels: float | None = None
    candidates: tuple[Candidate, ...] = ()
    optimum: Optimum | None = None
    seconds: float = 0.0
    files: Sequence[dict[str, Any] | None] = ()
    levels: str = ""
    choice: BudgetChoice | None = None

    @property
    def surface(self) -> str:
        """The model in words: its name, or what is left of it where the picture requires neither shape nor light."""
        chosen = next((one.model for one in self.candidates if one.chosen), self.material.name)
        # Where no more than a sum is determined, ambient light alone shows as well what the material shows with k_d.
        words = {"none": "none (black)", "ambient": "ambient (no shading)"}
        return self.material.name if np.any(self.material.k_d) else words.get(chosen, chosen)

    @property
    def weighed(self) -> list[np.ndarray]:
        """How much each pixel counted: 0 or 1, or its weight, (H, W) each, or channel by channel, (H, W, C)."""
        weights = self.weights or [None] * len(self.counted)
        return [np.asarray(a if w is None else w) for a, w in zip(self.counted, weights, strict=True)]

    @cached_property
    def diagnosis(self) -> tuple[Cause, ...]:
        """What may be wrong with the scene, likeliest first, from score tests; empty where nothing explains much."""
        return REPORTS["diagnose"](self)

    def fitted(self, picture: int = 0) -> Float[np.ndarray, "H W C"]:
        """The picture that the fitted material makes.

        Args:
            picture: which of the scenes.
        """
        return drawn(self.material, self.scenes[picture], self.precision)

    @property
    def causes_of_structure(self) -> tuple[Cause, ...]:
        """The diagnosis where the residual has structure, which a warning says, and the picture is still there."""
        with contextlib.suppress(InputError):  # of a saved result whose picture has gone
            return self.diagnosis if any("structure" in words for words in self.warnings) else ()
        return ()

    def __repr__(self) -> str:
        """In a line; the report is what `print` shows."""
        return f"<FitResult: {self.surface}, {', '.join(f'{one.key} {one}' for one in self.parameters)}>"

    def __str__(self) -> str:
        """The report."""
        return REPORTS["text"](self)

    def _repr_html_(self) -> str:
        """For Jupyter."""
        return REPORTS["html"](self)

    def to_dict(self) -> dict[str, Any]:
        """The report as JSON holds it: what is not determined is None."""
        return {
            "material": material_to_dict(self.material, undetermined=self.undetermined),
            "parameters": [parameter.to_dict() for parameter in self.parameters],
            "residual": self.residual,
            "noise": self.noise.tolist(),
            "structure": self.structure,
            "highlight_pixels": self.highlight_pixels,
            "pixels": self.pixels,
            "left_out": self.left_out,
            "warnings": list(self.warnings),
            "diagnosis": [vars(cause) for cause in self.causes_of_structure],
            "candidates": [vars(candidate) for candidate in self.candidates],
            "correlation": {
                "parameters": [parameter.key for parameter in self.free_parameters],
                "matrix": self.correlation.tolist(),
            },
            "loss": self.loss,
            "precision": self.precision,
            "seconds": self.seconds,
            "levels": self.levels,
            "choice": None if self.choice is None else self.choice.to_dict(),
        }

    def save(self, folder: str | Path, *, plot: bool = False) -> None:
        """Write what `fitting.load_result` reads back, all of it or nothing.

        material.json, material.mtl, fitted.exr, fit.json and fit.npz; the scene as scene.toml; where the picture is in
        a file its path and digest, else target.exr. Those of further pictures are scene1.toml and so on.

        Args:
            folder: made where missing. The MTL file is left out where the picture has neither 1 nor 3 channels.
            plot: also comparison.png.

        Raises:
            InputError: where the folder cannot be written.
        """
        REPORTS["save"](self, folder, plot)

    def plot(self, picture: int | None = None) -> Any:
        """Target, fit and residual side by side.

        Args:
            picture: which of the pictures, from 0; None takes the one that is explained worst. The title says which.

        Returns:
            A matplotlib figure.
        """
        return REPORTS["plot"](self, picture)

    def view(self, picture: int | None = None) -> Any:
        """A page that turns: the surface in WebGL2, with its numbers, light and view to move.

        Args:
            picture: which of the pictures, from 0; None takes the one that is explained worst.

        Returns:
            A page, which Jupyter shows without a kernel and ``.save("page.html")`` writes: one file, no network.
        """
        return REPORTS["view"](self, picture)


def of_material_alone(result: FitResult) -> None:
    """Refuse the result of a fit that found numbers of the scenes too: their errors go together with the material's.

    And of one that a plausible material held: its numbers move along that bound.
    """
    if any(words.startswith(HELD_PLAUSIBLE) for words in result.warnings):
        raise InputError("result", f"has a bound: {HELD_PLAUSIBLE} in some channel", "Fit without plausible")
    others = [one.key for one in result.parameters if not hasattr(result.material, one.name)]
    if others:
        remedy = "Fit the material under the scenes that it found, with fitting.fit"
        raise InputError("result", f"is not of a material alone: it tells {others[0]} too", remedy)
