"""What an accuracy or a time to spend made of a fit, as the result tells it."""

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Attempt:
    """One configuration that was tried.

    Attributes:
        configuration: in words.
        error: its estimated error, the median.
        bound: what the error does not exceed in 95 % of cases, by the estimate.
        pixels: the part of the pixels left out, of that bound.
        light: the part of the light samples left out.
        rounding: the part of rounding.
        seconds: that fit and estimate took.
    """

    configuration: str
    error: float
    bound: float
    pixels: float
    light: float
    rounding: float
    seconds: float


@dataclass(frozen=True)
class BudgetChoice:
    """What was chosen, what error it has by estimate, and what that rests on.

    Attributes:
        accuracy: the relative error that was asked for, or None.
        seconds: the time that was allowed, or None.
        attempts: what was tried, the last being what was chosen.
        pixels: how many pixels were looked at, of all pictures.
        of_pixels: of how many.
        met: whether the accuracy holds by the estimate; None where none was asked for.
        reason: why all pixels were looked at; empty where not all were.
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
        one = self.chosen
        parts = [f"rounding {one.rounding:.1g}" if one.rounding else "float64"]
        if self.pixels < self.of_pixels:
            parts.insert(0, f"pixels left out {one.pixels:.1g} (information matrix)")
        if one.light:
            parts.insert(-1, f"light samples left out {one.light:.1g} (by four times as many)")
        return ", ".join(parts)

    def lines(self) -> list[str]:
        """For the report."""
        one = self.chosen
        looked = f" ({self.pixels} of {self.of_pixels} pixels)" if self.pixels < self.of_pixels else ""
        lines = [
            f"  chosen      {one.configuration}{looked}{': ' if self.reason else ''}{self.reason}",
            f"  its error   {one.error:.2g} relative to the full fit, below {one.bound:.2g} with 95 %: {self.basis}",
        ]
        if self.met is False:
            lines.append(f"  warning: the accuracy of {self.accuracy:g} is not reached")
        return lines

    def to_dict(self) -> dict[str, Any]:
        """As JSON holds it."""
        return {
            "accuracy": self.accuracy,
            "seconds": self.seconds,
            "met": self.met,
            "pixels": self.pixels,
            "of_pixels": self.of_pixels,
            "reason": self.reason,
            "basis": self.basis,
            "attempts": [vars(attempt) for attempt in self.attempts],
        }
