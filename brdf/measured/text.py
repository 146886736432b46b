"""Measured BRDFs as text: Cornell's goniometer tables and ALTA's formats.

Cornell: ``#`` starts a comment; the number of wavelengths, the wavelengths in nm, then rows of
``theta_i phi_i theta_s phi_s v_1 .. v_N`` (radians, 1/sr).

ALTA: a header of ``#KEY value`` lines (``DIM``: numbers per row of input and output; ``PARAM_IN``, ``PARAM_OUT``;
``VS``: columns with a confidence interval follow), then rows. Parametrisations are those of ALTA's ``params.h``; those
that say nothing of the light are read as ALTA converts them: light along the normal, or both along the half vector.
Source: L. Belcour, R. Pacanowski and P. Barla, "ALTA: a BRDF analysis library", MAM 2014.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np
from jaxtyping import Float

from brdf.errors import InputError
from brdf.files import parse_number, read_text
from brdf.measured.table import LARGEST_ANGLE, MeasuredBRDF, from_angles, from_half_angles

MOST_CHANNELS = 4096
_NUMBERS = "Numbers have a decimal point and spaces between them; # starts a comment"
_Pair = tuple[Float[np.ndarray, "P 3"], Float[np.ndarray, "P 3"]]
# View and light from the file's name, the rows' lines and the columns, (A, P).
_Reader = Callable[[str, list[int], np.ndarray], _Pair]


def load(path: Path) -> MeasuredBRDF:
    """Read either format.

    Args:
        path: an ordinary file.

    Raises:
        InputError: naming file and line.
    """
    text = read_text(path)
    if any(line.startswith("#DIM") for line in text.splitlines()):
        return parse_alta(text, str(path), path.stem)
    return parse_cornell(text, str(path), path.stem)


def parse_cornell(text: str, place: str, name: str) -> MeasuredBRDF:
    """A table from the text of a Cornell file.

    Args:
        text: content.
        place: the file, for messages.
        name: of the material.

    Raises:
        InputError: naming the line.
    """
    words = [
        (number, word)
        for number, line in enumerate(text.splitlines(), start=1)
        for word in line.partition("#")[0].split()
    ]
    if not words:
        raise InputError(place, "holds no numbers", "Give a table of a measured BRDF")
    values = np.array([_number(place, line, word) for line, word in words])
    if not (1 <= values[0] <= MOST_CHANNELS and values[0] == int(values[0])):
        remedy = "The first number says how many wavelengths follow; ALTA files have a #DIM line"
        raise InputError(f"{place}: line {words[0][0]}", f"is no measured BRDF, got {words[0][1][:40]!r}", remedy)
    count = int(values[0])
    wavelengths, rows = values[1 : 1 + count], values[1 + count :]
    if len(wavelengths) < count or len(rows) == 0 or len(rows) % (4 + count):
        came = f"has {len(rows)} numbers after {count} wavelengths, not a multiple of {4 + count}"
        raise InputError(place, came, "Give rows of theta_i phi_i theta_s phi_s and a value per wavelength")
    lines = [line for line, _ in words[count:]]  # from the last word before the first row
    for start in range(1, len(lines), 4 + count):
        if lines[start] == lines[start - 1]:
            came = f"holds the end of a row and the start of the next, as if rows had {4 + count} numbers"
            remedy = "Give a row of theta_i phi_i theta_s phi_s and a value per wavelength on a line of its own"
            raise InputError(f"{place}: line {lines[start]}", came, remedy)
    table = rows.reshape(-1, 4 + count)
    row_lines = [words[1 + count + index * (4 + count)][0] for index in range(len(table))]
    _check_angles(place, row_lines, table[:, :4].T)
    light, view = from_angles(table[:, 0], table[:, 1]), from_angles(table[:, 2], table[:, 3])
    names = tuple(f"{wavelength:g} nm" for wavelength in wavelengths)
    return MeasuredBRDF.from_samples(light, view, table[:, 4:], name=name, channels=names)


def parse_alta(text: str, place: str, name: str) -> MeasuredBRDF:
    """A table from the text of an ALTA file.

    Args:
        text: content.
        place: the file, for messages.
        name: of the material.

    Raises:
        InputError: naming the line or the header's key.
    """
    header: dict[str, str] = {}
    rows: list[tuple[int, list[str]]] = []
    for number, line in enumerate(text.splitlines(), start=1):
        if line.startswith("#"):
            key, _, value = line[1:].partition(" ")
            if key.isupper():
                header.setdefault(key, value.strip())
        elif line.strip():
            rows.append((number, line.split()))
    if header.get("FORMAT", "text").lower() != "text":
        raise InputError(f"{place}: FORMAT", f"is {header['FORMAT']!r}, which is not read", "Save it as text with ALTA")
    inputs, outputs = _dimensions(place, header)
    directions = _parametrisation(place, header, inputs)
    extra = _confidence_columns(place, header) * outputs
    table = np.empty((len(rows), inputs + outputs))
    for index, (number, words) in enumerate(rows):
        if not inputs + outputs <= len(words) <= inputs + outputs + extra:
            came = f"has {len(words)} numbers instead of {inputs + outputs}"
            raise InputError(f"{place}: line {number}", came, "Give as many as the #DIM line says")
        table[index] = [_number(place, number, word) for word in words[: inputs + outputs]]
    if not rows:
        raise InputError(place, "holds no samples", "Give a table with rows of numbers")
    try:
        view, light = directions(place, [number for number, _ in rows], table[:, :inputs].T)
        values = table[:, inputs:]
        if header.get("PARAM_OUT") == "INV_STERADIAN_COSINE_FACTOR":
            values = values / np.where(view[:, 2:] > 0, view[:, 2:], 1.0)
        names = ("red", "green", "blue") if header.get("PARAM_OUT") == "RGB_COLOR" and outputs == 3 else None
        return MeasuredBRDF.from_samples(light, view, values, name=name, channels=names)
    except InputError as error:
        known = error.where == name or error.where.startswith(place)
        raise error if known else error.inside(place) from None


def _number(place: str, line: int, word: str) -> float:
    try:
        return parse_number(word)
    except ValueError:
        raise InputError(f"{place}: line {line}", f"must be a number, got {word[:40]!r}", _NUMBERS) from None


def _dimensions(place: str, header: dict[str, str]) -> tuple[int, int]:
    words = header["DIM"].split() if "DIM" in header else []
    if len(words) != 2 or not all(word.isascii() and word.isdigit() and len(word) < 6 for word in words):
        came = f"must be two whole numbers, got {header.get('DIM', '')[:40]!r}"
        raise InputError(f"{place}: DIM", came, "Write #DIM and the numbers of input and output columns")
    inputs, outputs = map(int, words)
    if not (1 <= inputs <= 6 and 1 <= outputs <= MOST_CHANNELS):
        came = f"says {inputs} and {outputs} columns"
        raise InputError(f"{place}: DIM", came, f"There are 1 to 6 inputs and 1 to {MOST_CHANNELS} outputs")
    known = ("INV_STERADIAN", "INV_STERADIAN_COSINE_FACTOR", "RGB_COLOR", "UNKNOWN_OUTPUT")
    kind = header.get("PARAM_OUT", "UNKNOWN_OUTPUT")
    if kind not in known:
        raise InputError(f"{place}: PARAM_OUT", f"is no BRDF value, got {kind[:40]!r}", f"Known: {', '.join(known)}")
    return inputs, outputs


def _confidence_columns(place: str, header: dict[str, str]) -> int:
    kind = header.get("VS", "0")
    if kind not in ("0", "1", "2"):
        raise InputError(f"{place}: VS", f"must be 0, 1 or 2, got {kind[:40]!r}", "Correct the header")
    return int(kind)


def _check_angles(place: str, lines: list[int], angles: Float[np.ndarray, "A P"]) -> None:
    wrong = ~(np.abs(angles) <= LARGEST_ANGLE + 1e-6)
    if wrong.any():
        row = int(np.argmax(wrong.any(axis=0)))
        came = f"has an angle of {angles[np.argmax(wrong[:, row]), row]:g}"
        raise InputError(f"{place}: line {lines[row]}", came, "Angles are in radians, at most 2 pi")


def _arc_cosine(place: str, lines: list[int], cosine: Float[np.ndarray, " P"]) -> Float[np.ndarray, " P"]:
    wrong = ~(np.abs(cosine) <= 1)
    if wrong.any():
        row = int(np.argmax(wrong))
        raise InputError(f"{place}: line {lines[row]}", f"has a cosine of {cosine[row]:g}", "It is within -1 and 1")
    return 2 * np.arctan2(np.sqrt(1 - cosine), np.sqrt(1 + cosine))


def _projected(polar_x: np.ndarray, polar_y: np.ndarray) -> Float[np.ndarray, "P 3"]:
    return from_angles(np.hypot(polar_x, polar_y), np.arctan2(polar_y, polar_x))


def _checked(formula: Callable[..., _Pair], inputs: int) -> tuple[int, _Reader]:
    """Number of columns, and view and light from columns of angles."""

    def directions(place: str, lines: list[int], columns: np.ndarray) -> _Pair:
        _check_angles(place, lines, columns)
        return formula(*columns)

    return inputs, directions


def _cosines_of_half(place: str, lines: list[int], columns: np.ndarray) -> _Pair:
    angles = [_arc_cosine(place, lines, column) for column in columns]
    return from_half_angles(angles[0], angles[1] if len(angles) > 1 else 0.0 * angles[0], 0.0)


def _cosine_about_normal(sign: float) -> _Reader:
    def directions(place: str, lines: list[int], columns: np.ndarray) -> _Pair:
        angle = _arc_cosine(place, lines, columns[0])
        return from_angles(sign * angle, 0.0), from_angles(0.0 * angle, 0.0)

    return directions


def _cartesian(place: str, lines: list[int], columns: np.ndarray) -> _Pair:
    sound = np.isfinite(columns).all(axis=0) & np.any(columns.reshape(2, 3, -1) != 0, axis=1).all(axis=0)
    if not sound.all():
        raise InputError(
            f"{place}: line {lines[np.argmin(sound)]}", "has a direction that is zero or not finite", "Correct the file"
        )
    return columns[:3].T, columns[3:].T


_PARAMETRISATIONS: dict[str, tuple[int, _Reader]] = {
    "COS_TH": (1, _cosines_of_half),
    "COS_TH_TD": (2, _cosines_of_half),
    "COS_TLV": (1, _cosine_about_normal(1.0)),
    "COS_TLR": (1, _cosine_about_normal(-1.0)),
    "RUSIN_TH_TD": _checked(lambda h, d: from_half_angles(h, d, 0.5 * np.pi), 2),
    "RUSIN_TH_TD_PD": _checked(from_half_angles, 3),
    "RUSIN_TH_PH_TD_PD": _checked(lambda h, ph, d, pd: from_half_angles(h, d, pd, ph), 4),
    "ISOTROPIC_TV_TL_DPHI": _checked(lambda v, light, phi: (from_angles(v, 0.0), from_angles(light, phi)), 3),
    "ISOTROPIC_TV_PROJ_DPHI": _checked(lambda x, y: (_projected(x, y), from_angles(0.0 * x, 0.0)), 2),
    "ISOTROPIC_TL_TV_PROJ_DPHI": _checked(lambda light, x, y: (_projected(x, y), from_angles(light, 0.0)), 3),
    "SPHERICAL_TL_PL_TV_PV": _checked(lambda tl, pl, tv, pv: (from_angles(tv, pv), from_angles(tl, pl)), 4),
    "CARTESIAN": (6, _cartesian),
}


def _parametrisation(place: str, header: dict[str, str], inputs: int) -> _Reader:
    kind = header.get("PARAM_IN", "")
    remedy = f"Known: {', '.join(_PARAMETRISATIONS)}"
    if not kind:
        raise InputError(f"{place}: PARAM_IN", "is missing", remedy)
    if kind not in _PARAMETRISATIONS:
        raise InputError(f"{place}: PARAM_IN", f"is not known, got {kind[:40]!r}", remedy)
    columns, directions = _PARAMETRISATIONS[kind]
    if columns != inputs:
        raise InputError(f"{place}: DIM", f"says {inputs} input columns, {kind} has {columns}", "Correct the header")
    return directions
