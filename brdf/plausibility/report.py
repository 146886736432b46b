"""What a plausibility check says: three findings, each with its worst case, its margin and its own error bound."""

import dataclasses
import math
from typing import Any, Literal

import numpy as np

from brdf import formatters
from brdf.materials.material_file import material_to_dict
from brdf.measured.table import to_angles
from brdf.models import Material

Verdict = Literal["pass", "fail", "cannot tell"]

ENERGY_LIMIT = 1.0 + 1e-6
"""The largest albedo that passes: exactly 1 is legal, so rounding must be."""

RECIPROCITY_LIMIT = 1e-6
"""The largest relative difference of f_r when light and view change places."""


GRAZING = 89.99
"""The largest angle from the normal, in degrees, that is looked at."""


@dataclasses.dataclass(frozen=True)
class Angles:
    """A direction in the local frame.

    Attributes:
        polar: angle from the normal in degrees, 0 to 90.
        azimuth: angle about the normal from +x towards +y in degrees, 0 to 360.
    """

    polar: float
    azimuth: float = 0.0

    @classmethod
    def of(cls, direction: Any) -> "Angles":
        """The angles of a direction, (3,)."""
        polar, azimuth = map(math.degrees, to_angles(direction))
        return cls(polar, azimuth % 360.0)

    def __str__(self) -> str:
        """The angles with a degree sign, below 90 where they are; the azimuth only where it is not zero."""
        left = 90.0 - self.polar
        digits = 3 - math.floor(math.log10(left)) if 0.0 < left < 0.1 else 4
        return f"{self.polar:.{digits}g}°" + (f" azimuth {self.azimuth:.4g}°" if round(self.azimuth, 3) % 360 else "")


@dataclasses.dataclass(frozen=True)
class Finding:
    """The outcome of one test.

    Attributes:
        verdict: "pass", "fail", or "cannot tell" where the error bound is wider than the margin.
        value: the worst value found: the least f_r in 1/sr (positivity), the largest relative difference of f_r when
            light and view change places (reciprocity), the largest albedo (energy).
        limit: what the value is held against.
        margin: how far the value lies on the right side of the limit; negative on the wrong side.
        error_bound: bound on the numerical error of the value.
        to_light: where the light of the worst case stands.
        to_view: where its view stands; None for the energy, which counts all views.
        channel: its channel, from 0.
        sentence: the finding in words.
        crossing: energy only: the angle of the light in degrees from which on the albedo exceeds 1, where there is one.
    """

    verdict: Verdict
    value: float
    limit: float
    margin: float
    error_bound: float
    to_light: Angles
    to_view: Angles | None
    channel: int
    sentence: str
    crossing: float | None = None


@dataclasses.dataclass(frozen=True)
class Report:
    """Whether a BRDF is physically plausible, and why.

    Attributes:
        subject: what was checked.
        positivity: whether f_r is nowhere negative.
        reciprocity: whether f_r stays the same when light and view change places.
        energy: whether from no direction more light is reflected than arrives.
        nearest: the nearest plausible material, where one is known and the material is not plausible itself.

    Example:
        >>> print(brdf.check(brdf.Lambert(k_d=0.5), name="grey"))
        grey: plausible
        ...
    """

    subject: str
    positivity: Finding
    reciprocity: Finding
    energy: Finding
    nearest: Material | None = None

    @property
    def findings(self) -> dict[str, Finding]:
        """The three findings by name."""
        return {"positivity": self.positivity, "reciprocity": self.reciprocity, "energy": self.energy}

    @property
    def plausible(self) -> bool | None:
        """True if all three pass, False if one fails, None if that cannot be told."""
        verdicts = {finding.verdict for finding in self.findings.values()}
        return False if "fail" in verdicts else None if "cannot tell" in verdicts else True

    @property
    def title(self) -> str:
        """What was checked, and whether it is plausible."""
        word = {True: "plausible", False: "not plausible", None: "cannot tell"}[self.plausible]
        return f"{self.subject}: {word}"

    def __str__(self) -> str:
        """A line for the whole, a sentence for each test."""
        lines = [self.title]
        for name, finding in self.findings.items():
            lines.append(f"  {name + ':':<13}{finding.verdict}; {finding.sentence}.")
            lines.append(f"{'':15}margin {finding.margin:.3g}, known to within {finding.error_bound:.1g}")
        if self.nearest is not None:
            lines.append(f"  Its nearest plausible form is {self.nearest!r}.")
        return "\n".join(lines)

    def _repr_html_(self) -> str:
        """For Jupyter."""
        return formatters.html["report"](self)

    def to_json(self) -> dict[str, Any]:
        """The report as plain numbers, strings and dictionaries, for ``json.dumps``."""
        content: dict[str, Any] = {"subject": self.subject, "plausible": self.plausible}
        for name, finding in self.findings.items():
            content[name] = dataclasses.asdict(finding)
            for key in ("value", "margin", "error_bound"):  # JSON knows no NaN
                content[name][key] = None if math.isnan(content[name][key]) else content[name][key]
        return content | {"nearest": None if self.nearest is None else material_to_dict(self.nearest)}


def judged(
    value: float,
    limit: float,
    bound: float,
    where: tuple[Angles, Angles | None, int],
    passed: str,
    failed: str | None = None,
    *,
    least: bool = False,
) -> Finding:
    """A finding, its verdict read off its numbers.

    The value may be ``limit`` at most, or with ``least`` at least; ``bound`` is on its error, ``where`` are light, view
    and channel. What failed is said in words of its own where there are such.
    """
    margin = value - limit if least else limit - value
    verdict: Verdict = "pass" if margin >= bound else "fail" if -margin > bound else "cannot tell"
    sentence = failed if failed and verdict == "fail" else passed
    return Finding(verdict, value, limit, margin, bound, *where, sentence)


def largest(values: np.ndarray) -> tuple[int, ...]:
    """Where the largest of some values stands."""
    return tuple(map(int, np.unravel_index(np.argmax(values), values.shape)))


def times(ratio: float) -> str:
    """A ratio in words, with as many digits as tell it from 1."""
    if ratio >= 1e6:
        return "a million times and more"
    digits = 2 if ratio >= 1.1 else 2 + math.ceil(-math.log10(max(ratio - 1.0, 1e-12)))
    return f"{ratio:.0f} times" if ratio >= 100 else f"{ratio:.{digits}g} times"
