"""What an accuracy or a time to spend made of a fit, as the result tells it."""

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Attempt:
    """One configuration that was tried.

    Attributes:
        error: its estimated error, relative, the median; see `fitting.speed_accuracy.parameter_deviation`.
        bound: what the error does not exceed in 95 % of cases, by the estimate.
        pixels: the part of the pixels left out, of that bound.
        light: the part of the light samples left out.
        rounding: the part of rounding.
        configuration: in words.
        seconds: that fit and estimate took.
        squares: the part of that of the pixels which least squares has beside codes, however many are taken.
    """

    error: float
    bound: float
    pixels: float
    light: float
    rounding: float
    configuration: str = ""
    seconds: float = 0.0
    squares: float = 0.0


@dataclass(frozen=True)
class BudgetChoice:
    """What was chosen, what error it has by estimate, and what that rests on.

    Attributes:
        accuracy: the relative error that was asked for, or None.
        seconds: the time that was allowed, or None.
        attempts: what was tried, the last being what was chosen.
        pixels: how many pixels were fitted, of all pictures.
        of_pixels: of how many.
        met: whether the accuracy holds by the estimate; None where none was asked for.
        reason: why all pixels were fitted; empty where not all were.
    """

    accuracy: float | None
    seconds: float | None
    attempts: tuple[Attempt, ...]
    pixels: int
    of_pixels: int
    met: bool | None
    reason: str = ""

    @property
    def chosen(self) -> Attempt:
        """The attempt that was chosen."""
        return self.attempts[-1]

    @property
    def basis(self) -> str:
        """What the estimate rests on."""
        chosen, parts = self.chosen, []
        if self.pixels < self.of_pixels:
            parts.append(f"pixels left out {chosen.pixels:.1g} (information matrix)")
        if chosen.light:
            parts.append(f"light samples left out {chosen.light:.1g} (by more of them)")
        return ", ".join([*parts, f"rounding {chosen.rounding:.1g}"])

    def lines(self) -> list[str]:
        """For the report."""
        chosen = self.chosen
        share = f" ({self.pixels} of {self.of_pixels} pixels)" if self.pixels < self.of_pixels else ""
        reason = f": {self.reason}" if self.reason else ""
        error = f"{chosen.error:.2g} relative to the full fit, below {chosen.bound:.2g} with 95 %: {self.basis}"
        lines = [f"  chosen      {chosen.configuration}{share}{reason}", f"  its error   {error}"]
        if self.met is False:
            lines.append(f"  warning: the accuracy of {self.accuracy:g} is not reached")
        return lines

    def to_dict(self) -> dict[str, Any]:
        """As JSON holds it."""
        attempts = [vars(attempt) for attempt in self.attempts]
        return vars(self) | {"basis": self.basis, "attempts": attempts}
